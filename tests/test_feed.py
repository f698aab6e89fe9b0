import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support import draw, sized

from hpgr.laws import feed as feeds

TABLE = ((0.001, 10.0), (0.002, 30.0), (0.004, 30.0), (0.008, 100.0))
FEEDS = {
    "uniform": feeds.UniformFeed(bottom_size=0.008, top_size=0.06),
    "from zero": feeds.UniformFeed(bottom_size=0.0, top_size=0.06),
    "power law": feeds.PowerLawFeed(top_size=0.06, exponent=0.7),
    "rosin-rammler": feeds.RosinRammlerFeed(size=0.02, exponent=1.3, top_size=0.06),
    "table": feeds.TableFeed(table=TABLE),
    "scalped": feeds.TableFeed(table=TABLE, top_size=0.006),
}
each = pytest.mark.parametrize("given_feed", FEEDS.values(), ids=FEEDS)


@each
@given(st.floats(1e-6, 1 - 1e-6))
def test_passing_inverts_quantile(given_feed, fraction):
    assert given_feed.passing(given_feed.quantile(fraction)) == pytest.approx(fraction, rel=1e-9)


@each
def test_passing_rises_from_0_to_1_at_the_top_size(given_feed):
    sizes = np.geomspace(1e-9, 1, 2001)
    found = given_feed.passing(sizes)
    assert np.all(np.diff(found) >= 0)
    assert found[0] < 1e-4
    assert np.all(found[sizes >= given_feed.largest_grain] == 1.0)
    assert given_feed.passing(0.999 * given_feed.largest_grain) < 1
    assert given_feed.passing(math.inf) == 1.0
    assert given_feed.passing(0.0) == 0.0


def test_known_values():
    assert FEEDS["uniform"].passing(0.034) == pytest.approx(0.5, rel=1e-14)
    assert FEEDS["uniform"].quantile([0, 1]) == pytest.approx([0.008, 0.06], rel=1e-15)
    assert FEEDS["power law"].passing(0.03) == pytest.approx(0.5**0.7, rel=1e-14)
    rest = 1 - math.exp(-(3.0**1.3))
    assert FEEDS["rosin-rammler"].passing(0.02) == pytest.approx((1 - 1 / math.e) / rest, rel=1e-14)
    assert FEEDS["table"].passing([0.001, 0.002, 0.003, 0.008]) == pytest.approx([0.1, 0.3, 0.3, 1.0], rel=1e-14)
    # linear in log size: half way between 1 and 2 mm is their geometric mean
    assert FEEDS["table"].passing(0.001 * math.sqrt(2)) == pytest.approx(0.2, rel=1e-14)


def test_single_size_steps_at_its_size():
    single = feeds.SingleFeed(size=0.02)
    assert list(single.passing([0.0199, 0.02, 0.0201])) == [0, 1, 1]
    assert np.all(single.quantile([0.0, 0.3, 1.0]) == 0.02)
    assert single.largest_grain == 0.02


def test_table_is_extended_to_zero_along_its_first_slope():
    # 20 % per factor 2: the 10 % below 1 mm end at 1 mm / sqrt(2)
    assert FEEDS["table"].quantile(0.0) == pytest.approx(0.001 / math.sqrt(2), rel=1e-12)
    assert FEEDS["table"].passing(0.0007) == 0.0
    to_zero = feeds.TableFeed(table=((0.001, 0.0), (0.008, 100.0)))
    assert to_zero.quantile(0.0) == pytest.approx(0.001, rel=1e-12)


def test_sieves_without_mass_hold_no_grains():
    drawn = draw(FEEDS["table"], 2000, np.random.SeedSequence(1))
    assert not np.any((drawn > 0.00201) & (drawn < 0.00399))


def test_scalping_removes_what_is_coarser_and_rescales_the_rest():
    whole, scalped = FEEDS["table"], FEEDS["scalped"]
    left = float(whole.passing(0.006))
    sizes = np.array([0.0008, 0.0015, 0.005])
    assert scalped.passing(sizes) == pytest.approx(whole.passing(sizes) / left, rel=1e-14)
    assert scalped.quantile(1.0) == pytest.approx(0.006, rel=1e-12)
    assert scalped.largest_grain == 0.006


@each
@pytest.mark.parametrize("cells", [1, 2, 17, sized(10_000, 500)])
def test_draw_is_stratified(given_feed, cells):
    """One uniform per stratum keeps the KS distance below 1 / M for certain; plain sampling has 0.9 / sqrt(M)."""
    drawn = draw(given_feed, cells, np.random.SeedSequence(7))
    assert drawn.dtype == np.float32
    ordered = np.sort(drawn.astype(float))
    exact = given_feed.passing(ordered)
    count = np.arange(cells + 1) / cells
    slack = 1 / cells + 1e-5  # rounding of a size to float32 moves its passing by less than 1e-5
    assert np.max(np.abs(exact - count[1:])) <= slack
    assert np.max(np.abs(exact - count[:-1])) <= slack


def test_draw_order_is_random_and_follows_the_source():
    first = draw(FEEDS["uniform"], 1000, np.random.SeedSequence(1))
    assert np.array_equal(first, draw(FEEDS["uniform"], 1000, np.random.SeedSequence(1)))
    second = draw(FEEDS["uniform"], 1000, np.random.SeedSequence(2))
    assert not np.array_equal(np.argsort(first), np.argsort(second))
    # neighbours are uncorrelated: |r| sqrt(M) is beyond 5 once in 1.7 million
    assert abs(np.corrcoef(first[1:], first[:-1])[0, 1]) * math.sqrt(1000) < 5


@pytest.mark.parametrize(
    "given_feed",
    [
        feeds.RosinRammlerFeed(size=0.01, exponent=1.0, top_size=1.0),
        feeds.TableFeed(table=TABLE, top_size=0.003),  # scalped where the table is flat
    ],
    ids=["rosin-rammler far below its top", "scalped on a flat part"],
)
def test_no_quantile_is_above_the_top_size(given_feed):
    assert float(given_feed.quantile(1.0)) <= given_feed.largest_grain * (1 + 1e-9)


def test_largest_grain_is_the_finest_sieve_that_passes_everything():
    """A laboratory's table may hold several sieves that pass 100 %; no grain is as coarse as the coarsest of them."""
    table = feeds.TableFeed(table=((0.001, 0.0), (0.002, 50.0), (0.004, 100.0), (0.008, 100.0)))
    assert table.largest_grain == 0.004
    assert table.quantile(1.0) == pytest.approx(0.004, rel=1e-12)


def test_scalping_below_all_mass_is_refused():
    with pytest.raises(ValueError, match="top_size"):
        feeds.TableFeed(table=((0.001, 0.0), (0.002, 0.0), (0.004, 100.0)), top_size=0.0015)


BAD = {
    "one row": (((0.001, 100.0),), "1 row;"),
    "size repeated": (((0.001, 0.0), (0.001, 50.0), (0.002, 100.0)), r"row 2 \(1 mm, 50 %\).*exceed the row before"),
    "falling": (((0.001, 0.0), (0.002, 50.0), (0.003, 40.0), (0.004, 100.0)), r"row 3 \(3 mm, 40 %\).*at least"),
    "above 100": (((0.001, 0.0), (0.002, 101.0), (0.003, 100.0)), r"row 2 \(2 mm, 101 %\).*0 to 100"),
    "negative": (((0.001, -1.0), (0.003, 100.0)), r"row 1 \(1 mm, -1 %\).*0 to 100"),
    "zero size": (((0.0, 0.0), (0.003, 100.0)), r"row 1 \(0 mm, 0 %\).*above 0"),
    "ends early": (((0.001, 0.0), (0.003, 99.0)), r"row 2 \(99 %\).*pass 100 %"),
}


@pytest.mark.parametrize(("table", "words"), BAD.values(), ids=BAD)
def test_bad_tables_are_refused_naming_the_row(table, words):
    with pytest.raises(ValueError, match=words):
        feeds.TableFeed(table=table)


def test_every_bad_row_is_named_at_once():
    with pytest.raises(ValueError, match="row 2") as error:
        feeds.TableFeed(table=((0.001, 0.0), (0.0005, -5.0), (0.003, 120.0), (0.004, 90.0)))
    for row in ("row 2 (0.5 mm, -5 %)", "row 3 (3 mm, 120 %)", "row 4 (4 mm, 90 %)", "row 4 (90 %)"):
        assert row in str(error.value)


def test_scalping_outside_the_table_is_refused():
    for top in (0.0009, 0.009):
        with pytest.raises(ValueError, match="must lie within the table, above 1 mm to 8 mm"):
            feeds.TableFeed(table=TABLE, top_size=top)


def test_a_steep_rosin_rammler_feed_far_finer_than_its_top_overflows_in_silence():
    """(s / size) ** exponent is inf there, and all of it passes."""
    steep = feeds.RosinRammlerFeed(size=1e-5, exponent=100.0, top_size=0.04)
    assert steep.passing([0.0, 0.04]).tolist() == [0.0, 1.0]
    assert steep.quantile([0.5]) == pytest.approx(1e-5 * math.log(2) ** 0.01, rel=1e-12)


def test_a_flat_fine_end_spans_a_decade_below_its_finest_sieve():
    feed = feeds.TableFeed(table=((0.001, 20.0), (0.002, 20.0), (0.004, 100.0)))
    assert feed.passing([1e-4, 1e-3, 2e-3]) == pytest.approx([0.0, 0.2, 0.2])
    assert feed.quantile([0.0, 0.1, 0.2]) == pytest.approx([1e-4, 1e-3 / 10**0.5, 2e-3])
