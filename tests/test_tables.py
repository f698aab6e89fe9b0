import math
import os
from importlib.resources import files

import pytest

from hpgr import presets, tables
from hpgr.laws.feed import TableFeed


def write(path, text):
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("text", "table"),
    [
        ("size_mm,percent_passing\n1,10\n2,100\n", [(1e-3, 10), (2e-3, 100)]),
        ("Size (mm),wet,passing %\n4,,100 %\n1,3,10%\n2,3,50\n", [(1e-3, 10), (2e-3, 50), (4e-3, 100)]),
        ("sieve_size_m\tcum. finer\n0.001\t0.1\n0.002\t1\n", [(1e-3, 10), (2e-3, 100)]),
        ("aperture [µm];passing\n500,5;12,5\n1000;100\n", [(500.5e-6, 12.5), (1e-3, 100)]),
        ("\ufeff# a comment\n\nsize_inch,passing\n  # another\n1 1/2,100\n0.5,10\n\n", [(12.7e-3, 10), (38.1e-3, 100)]),
        ("mesh,passing\n10,100\n#200,12\n", [(75e-6, 12), (2e-3, 100)]),
        ('sieve,passing\n"3/4""",100\n#4,50\n45 um,3\n', [(45e-6, 3), (4.75e-3, 50), (19.05e-3, 100)]),
        ("size_mm,retained_pct,moisture_pct\n8,0,4\n4,30,4\n2,20,4\npan,50,4\n", [(2e-3, 50), (4e-3, 70), (8e-3, 100)]),
        ("size_mm;cumulative retained\n4;0,3\n8;0\n", [(4e-3, 70), (8e-3, 100)]),
    ],
)
def test_tables_of_laboratories_are_read(tmp_path, text, table):
    found = tables.read_sieve_table(write(tmp_path / "t.csv", text))
    assert [row for pair in found for row in pair] == pytest.approx([row for pair in table for row in pair])


def test_next_sieve_is_added_above_up_to_5_percent_and_said(tmp_path):
    path = write(tmp_path / "t.csv", "size_mm,passing\n31.5,96.32\n22.4,57.6\n16,40\n")
    with pytest.warns(UserWarning, match=r"t\.csv: line 2: .* the next of the series, 45 mm, is added"):
        assert tables.read_sieve_table(path)[-2:] == [(pytest.approx(0.0315), 96.32), (pytest.approx(0.045), 100.0)]
    with pytest.raises(ValueError, match=r"t\.csv: line 2, passing: got 94.9 .*; must be 95 to 100"):
        tables.read_sieve_table(write(path, "size_mm,passing\n31.5,94.9\n22.4,57.6\n"))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "empty"),
        ("size,percent_passing\n1,2\n", "line 2 '1,2': name the unit of the sizes"),
        ("1,2\n3,4\n", "line 1, header '1,2': it names no column of sizes"),
        ("size_mm,percent\n1,2\n", "it names no percent passing or retained"),
        ("size_kg,percent_passing\n1,2\n", "line 2 '1,2': not a quantity in mm: its unit 'kg' measures something else"),
        ("size_foo,percent_passing\n1,2\n", "'foo' is not known"),
        ("size_mm,percent_passing\n1,10\nx,100\n", "line 3 'x,100': its size must be a number, a fraction"),
        ("size_mm,percent_passing\n1,10\n2,\n", "line 3 '2,': must be a number"),
        ("size_mm,percent_passing\n1,10\n31,5,97,6\n", "line 3 .*: got 4 cells, the header has 2; write decimals"),
        ("mesh,passing\n10,100\n11,50\n", "line 3 '11,50': its size must be a mesh number of ASTM E11"),
        ("size_mm,passing\n1,10\n2,60\n1,100\n", "line 4, size: got 1 mm twice .*also in line 2"),
        ("size_mm,passing\n1,10\n4,100\n2,5\n", "line 4, passing: got 5 % at 2 mm .* finer sieve in line 2"),
        ("size_mm,passing\n1,100\n", "line 2, test: got 1 sieve"),
    ],
)
def test_unreadable_tables_are_refused_with_line_and_format(tmp_path, text, words):
    path = write(tmp_path / "t.csv", text)
    with pytest.raises(ValueError, match=words) as error:
        tables.read_sieve_table(path)
    assert str(path) in str(error.value)
    assert "size_mm,percent_passing" in str(error.value) or "empty" in words


def test_missing_file_is_an_os_error_and_the_feeds_fault(tmp_path):
    path = tmp_path / "none.csv"
    for read in (tables.read_sieve_table, lambda path: tables.read_pilot_tests(path, path)):
        with pytest.raises(OSError, match=r"none\.csv"):
            read(path)
    with pytest.raises(ValueError, match=r"the file cannot be read \(No such file"):
        TableFeed(table=path)


def test_shipped_table_is_the_published_one():
    table = presets.khd_pilot().feed.table
    assert len(table) == 13
    assert table[0] == (pytest.approx(0.125e-3), 2.58)
    assert table[-1] == (pytest.approx(45e-3), 100.0)


PRODUCT = "test,size_mm,feed,centre,edge,total\nA,4,100,100,100,100\nA,1,10,40,20,35\nA,2,50,,60,70\n"
OPERATIONS = "test,U_m_s,Fsp_N_mm2,P_kW,Q_tph\nA,0.5,2.5,36,18\n"


def read_tests(tmp_path, product=PRODUCT, operations=OPERATIONS):
    return tables.read_pilot_tests(write(tmp_path / "p.csv", product), write(tmp_path / "o.csv", operations))


def refused(tmp_path, product=PRODUCT, operations=OPERATIONS):
    """Return the faults, one a line."""
    with pytest.raises(ValueError, match="pilot tests") as error:
        read_tests(tmp_path, product, operations)
    count, *faults = str(error.value).splitlines()
    assert count.startswith(f"{len(faults)} fault")
    return faults


def test_shipped_pilot_tests_are_the_published_ones():
    data = files("hpgr") / "data"
    tests = tables.read_pilot_tests(data / "khd_porphyry_psd.csv", data / "khd_porphyry_operations.csv")
    assert [test.name for test in tests] == [f"K-P{number}" for number in range(1, 8)]
    assert {len(test.sizes) for test in tests} == {13}
    fourth = tests[3]
    assert fourth[1:11] == pytest.approx(
        (0.97, 3.7e6, 0.0167, 0.0217, 43.8e3 / 3600, 227e3 / 3600, 89.6e3, 2.04 * 3600, 60e5, 0.035)
    )
    assert fourth.sizes[[0, -1]] == pytest.approx([0.125e-3, 45e-3])
    for array, percent in zip(fourth[-4:], (5.16, 27.81, 9.76, 24.76), strict=True):
        assert array[[3, -1]] == pytest.approx([percent / 100, 1.0])


def test_tests_of_a_minimal_table_leave_the_rest_unmeasured(tmp_path):
    product, operations = (
        "test,size_mm,feed,total\nA,1,10,35\nA,4,100,100\n",
        "test,U_m_s,Fsp_N_mm2,moisture_pct\nA,1,2,0\n",
    )
    [test] = read_tests(tmp_path, product, operations)
    assert [math.isnan(value) for value in test[3:10]] == [True] * 7
    assert test.moisture == 0.0  # dry, which is measured
    assert all(math.isnan(value) for value in (*test.centre, *test.edge))
    assert test.total == pytest.approx([0.35, 1.0])


def test_nothing_is_derived_and_single_empty_cells_stay_nan(tmp_path):
    [test] = read_tests(tmp_path)
    assert (test.power, test.throughput) == pytest.approx((36e3, 5.0))
    assert math.isnan(test.specific_energy)
    assert test.centre == pytest.approx([0.4, math.nan, 1.0], nan_ok=True)


def test_order_of_rows_and_columns_comments_and_byte_order_mark_do_not_matter(tmp_path):
    plain = read_tests(tmp_path)
    product = "\ufeff# by the laboratory\r\ntotal,test, size_mm ,feed,edge,centre\r\n\r\n70,A,2,50,60,\r\n"
    product += "# half way\r\n100,A,4,100,100,100\r\n35,A,1,10,20,40\r\n,,,,,\r\n"
    [other] = read_tests(tmp_path, product, "\ufeff" + OPERATIONS)
    for one, two in zip(plain[0][1:], other[1:], strict=True):
        assert one == pytest.approx(two, nan_ok=True)


def test_tests_stand_in_the_order_of_the_operations(tmp_path):
    product = PRODUCT + PRODUCT.replace("A,", "B,").partition("\n")[2]
    tests = read_tests(tmp_path, product, OPERATIONS.replace("A,", "B,") + "A,1,3,,\n")
    assert [(test.name, test.surface_speed) for test in tests] == [("B", 0.5), ("A", 1.0)]


def test_next_sieve_of_a_test_has_all_of_the_feed_and_no_product(tmp_path):
    with pytest.warns(UserWarning, match=r"p\.csv: line 2: .* 8 mm, is added"):
        [test] = read_tests(tmp_path, PRODUCT.replace("A,4,100", "A,4,96.32"))
    assert test.sizes == pytest.approx([1e-3, 2e-3, 4e-3, 8e-3])
    assert test.feed[-2:] == pytest.approx([0.9632, 1.0])
    assert test.total == pytest.approx([0.35, 0.7, 1.0, math.nan], nan_ok=True)


def test_pilot_tables_may_have_semicolons_and_decimal_commas(tmp_path):
    [plain] = read_tests(tmp_path)
    text = OPERATIONS.replace(",", ";").replace(".", ",")
    [other] = read_tests(tmp_path, PRODUCT.replace(",", ";"), text)
    assert plain[1:3] == other[1:3]


def test_arrays_of_a_test_are_read_only(tmp_path):
    [test] = read_tests(tmp_path)
    with pytest.raises(ValueError, match="read-only"):
        test.total[0] = 0.0


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("A,1,10,40", "A,1,10,-40", "p.csv: line 3, centre: got '-40'; must be at least 0 and at most 100"),
        ("A,2,50", "A,2,101", "p.csv: line 4, feed: got '101'; must be at least 0 and at most 100"),
        ("A,1,10", "A,1,55", "p.csv: line 4, feed: got 50 % at 2 mm in A; must not be below the 55 %"),
        ("A,4,100", "A,4,94", "p.csv: line 2, feed: got 94 at the coarsest sieve of A; must be 95 to 100"),
        ("A,2,", "A,1,", "p.csv: line 4, size_mm: got 1 mm twice for A (also in line 3)"),
        ("A,2,", "A,0,", "p.csv: line 4, size_mm: got '0'; must be above 0"),
        ("A,2,", "A,,", "p.csv: line 4, size_mm: got an empty cell; must be a number"),
        ("A,2,", ",2,", "p.csv: line 4, test: got an empty cell"),
        ("A,2,", "A,nan,", "p.csv: line 4, size_mm: got 'nan'; must be a finite number"),
        ("A,2,50,,60,70", "A,2,50,,60", "p.csv: line 4: got 5 cells; must be 6"),
        (",total", ",Total", "p.csv: line 1, header: got column 'Total'; must be one of test, size_mm"),
        (",total", ",Total", "column 'total' is missing"),
        ("centre", "feed", "got column 'feed' 2 times"),
        (PRODUCT, "test,size_mm,feed,total\nA,4,100,100\n", "line 2, test: got 1 sieve for A; must be at least two"),
    ],
)
def test_impossible_products_are_refused(tmp_path, old, new, words):
    assert old in PRODUCT
    assert any(words in fault for fault in refused(tmp_path, PRODUCT.replace(old, new)))


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("A,0.5", "A,0", "o.csv: line 2, U_m_s: got '0'; must be above 0; correct the cell"),
        ("0.5,", ",", "o.csv: line 2, U_m_s: got an empty cell"),
        (",36,", ",inf,", "o.csv: line 2, P_kW: got 'inf'; must be a finite number"),
        ("U_m_s", "U_ms", "did you mean 'U_m_s'?"),
        ("P_kW", "colour", "got column 'colour'; must be one of test, U_m_s, Fsp_N_mm2, gap_mm"),
        ("A,0.5", "B,0.5", "o.csv: test 'A' of"),
        ("A,0.5", "B,0.5", "p.csv: test 'B' of"),
        ("A,0.5,2.5,36,18\n", "A,0.5,2.5,36,18\nA,1,2,,\n", "o.csv: line 3, test: got 'A' again (first in line 2)"),
        ("A,0.5,2.5,36,18\n", "", "o.csv: no rows below the header"),
        (OPERATIONS, "# nothing\n", "o.csv: the table is empty"),
    ],
)
def test_impossible_operations_are_refused(tmp_path, old, new, words):
    assert old in OPERATIONS
    assert any(words in fault for fault in refused(tmp_path, operations=OPERATIONS.replace(old, new)))


def test_faults_of_both_files_come_at_once_and_only_once(tmp_path):
    product = PRODUCT.replace("A,1,10,40", "A,1,10,140") + "B,1,5,,,50\nB,2,90,,,100\n"
    faults = refused(tmp_path, product, OPERATIONS.replace("A,0.5,2.5", "A,-0.5,x"))
    assert len(faults) == 5
    for fault, words in zip(faults, ("centre", "U_m_s", "Fsp_N_mm2", "test 'B'", "90"), strict=True):
        assert words in fault


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"size_\xe9,percent_passing\n1,2\n", "byte 5 is not UTF-8; save it as text in UTF-8"),
        (b"\x7fELF\0\0", "byte 4 is 0, which no text has"),
        (b"1" * 11_000_000, "got more than 10,000,000 bytes; it must be smaller"),
        (b"1" * 200_000, "got 1 lines; a table has at most 10,000 lines of 10,000 characters"),
        (b"1,2\n" * 10_001, "got 10,001 lines; a table has"),
        (b"size_mm,percent_passing\n1,2\n" + b"x" * 9000, r"line 3 'x{57}\.\.\.': got 1 cells"),
        (b"test,feed" + b",q" * 1000 + b"\n", "."),
    ],
    ids=["latin", "binary", "huge", "one line", "many lines", "long cell", "many columns"],
)
def test_what_is_no_table_gets_one_short_refusal(tmp_path, data, words):
    path = tmp_path / "a.csv"
    path.write_bytes(data)
    for read in (tables.read_sieve_table, lambda path: tables.read_pilot_tests(path, path)):
        with pytest.raises(ValueError, match=r"a\.csv: ") as error:
            read(path)
        assert len(str(error.value)) < 12_000
    with pytest.raises(ValueError, match=words):
        tables.read_sieve_table(path)


def test_pipes_and_devices_are_refused_unread(tmp_path):
    os.mkfifo(tmp_path / "pipe.csv")
    for path in (tmp_path / "pipe.csv", "/dev/zero", tmp_path):
        with pytest.raises(ValueError, match="is no regular file; it must be one"):
            tables.read_sieve_table(path)
        with pytest.raises(ValueError, match="is no regular file"):
            TableFeed(table=path)
