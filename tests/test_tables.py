import pytest

from hpgr import Feed, presets, tables


def write(path, text):
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("header", "metres"),
    [
        ("size_mm", 1e-3),
        ("size [mm]", 1e-3),
        ("Size (mm)", 1e-3),
        ("sieve_um", 1e-6),
        ("aperture [µm]", 1e-6),
        ("sieve_size_mm", 1e-3),
        ("size_m", 1.0),
        ("size_inch", 0.0254),
    ],
)
def test_unit_is_read_from_the_header(tmp_path, header, metres):
    path = write(tmp_path / "t.csv", f"{header},percent_passing\n1,10\n2,100\n")
    table = tables.read_sieve_table(path)
    assert table == [(pytest.approx(metres), 10.0), (pytest.approx(2 * metres), 100.0)]


def test_rows_come_out_finest_first_whatever_their_order(tmp_path):
    rising = write(tmp_path / "a.csv", "size_mm,percent_passing\n1,10\n2,50\n4,100\n")
    falling = write(tmp_path / "b.csv", "size_mm,percent_passing\n4,100\n2,50\n1,10\n")
    assert tables.read_sieve_table(rising) == tables.read_sieve_table(falling)


def test_comments_blank_lines_and_byte_order_mark_are_skipped(tmp_path):
    path = write(tmp_path / "t.csv", "\ufeff# a comment\n\nsize_mm,percent_passing\n  # another\n1,10\n\n2,100\n")
    assert len(tables.read_sieve_table(path)) == 2


def test_shuffled_rows_are_left_for_the_feed_to_refuse(tmp_path):
    path = write(tmp_path / "t.csv", "size_mm,percent_passing\n1,10\n4,100\n2,50\n")
    assert [percent for _, percent in tables.read_sieve_table(path)] == [10, 100, 50]
    with pytest.raises(ValueError, match=r"row 3 \(2 mm, 50 %\)"):
        Feed(kind="table", table=path)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "empty"),
        ("# only a comment\n", "empty"),
        ("size,percent_passing\n1,2\n", "name the unit"),
        ("1,2\n3,4\n", "name the unit"),
        ("size_mm,percent\n1,2\n", "percent_passing"),
        ("size_mm,percent_passing,n\n1,2,3\n", "name the unit"),
        ("size_kg,percent_passing\n1,2\n", "use a length"),
        ("size_foo,percent_passing\n1,2\n", "use a length"),
        ("size_mm,percent_passing\n1,10\nx,100\n", r"row 2 'x,100' is not two numbers"),
        ("size_mm,percent_passing\n1,10\n2\n", r"row 2 '2' is not two numbers"),
        ("size_mm,percent_passing\n1,10,3\n", r"row 1 '1,10,3' is not two numbers"),
    ],
)
def test_unreadable_tables_are_refused_naming_file_and_row(tmp_path, text, words):
    path = write(tmp_path / "t.csv", text)
    with pytest.raises(ValueError, match=words) as error:
        tables.read_sieve_table(path)
    assert str(path) in str(error.value)


def test_missing_file_is_an_os_error_and_the_feeds_fault(tmp_path):
    path = tmp_path / "none.csv"
    with pytest.raises(OSError, match=r"none\.csv"):
        tables.read_sieve_table(path)
    with pytest.raises(ValueError, match=r"none\.csv"):
        Feed(kind="table", table=path)


def test_shipped_table_is_the_published_one():
    table = presets.khd_pilot().feed.table
    assert len(table) == 13
    assert table[0] == (pytest.approx(0.125e-3), 2.58)
    assert table[-1] == (pytest.approx(45e-3), 100.0)
