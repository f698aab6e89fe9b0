import math

import numpy as np
import pytest
from support import KS, SIGMAS, critical_log_stress, draw, ks_distance, laws, march, paper, sized, streams

from hpgr import simulate
from hpgr.grains.closed_form import _cascade, crushed, crushed_passing, expected_breaks, percentile
from hpgr.laws.feed import PowerLawFeed, RosinRammlerFeed, SingleFeed, TableFeed, UniformFeed

INF = math.inf
FEEDS = {
    "uniform": UniformFeed(bottom_size=0.008, top_size=0.06),
    "single": SingleFeed(size=0.06),
    "power law": PowerLawFeed(top_size=0.06, exponent=0.7),
    "rosin-rammler": RosinRammlerFeed(size=0.02, exponent=1.3, top_size=0.06),
    "table": TableFeed(table=((0.001, 0.0), (0.004, 30.0), (0.016, 60.0), (0.06, 100.0))),
}
each = pytest.mark.parametrize("feed", FEEDS.values(), ids=FEEDS)


@each
@pytest.mark.parametrize(("gamma", "critical"), [(0.35, 0.002), (1.0, 0.02), (4.0, 0.02)])
def test_closed_form_is_the_march_run_to_completion(feed, gamma, critical):
    """A1 and A3. The feed is stratified, so KS for plain sampling bounds it: by chance once in a million."""
    cells = sized(50_000, 1_000)
    drawn = draw(feed, cells, np.random.SeedSequence(61))
    found, _, breaks = march(drawn, streams(cells, 61), [critical_log_stress(critical)] * 80, n=INF, gamma=gamma)
    assert ks_distance(found, lambda x: crushed_passing(feed, x, critical, gamma)) < KS / math.sqrt(cells)
    # A2: a broken grain's number of breaks has the variance of its mean's Poisson part and of its feed size
    expected = float(expected_breaks(feed, critical, gamma))
    longest = 1 + gamma * math.log(0.06 / critical)
    quadrature = 2e-3  # kinks of tables and bounds between the 200 nodes
    assert abs(breaks / cells - expected) < SIGMAS * math.sqrt((longest + longest**2 / 4) / cells) + quadrature


@each
def test_closed_form_is_a_distribution_and_without_stress_the_feed(feed):
    sizes = np.geomspace(1e-9, 1, 500)
    for critical in (0.001, 0.03, 0.06, 0.1):
        found = crushed_passing(feed, sizes, critical, 0.35)
        assert np.all(np.diff(found) >= 0)
        assert np.all((found >= 0) & (found <= 1))
        assert np.all(found[sizes >= critical] == 1)
    assert np.array_equal(crushed_passing(feed, sizes, INF, 1.0), feed.passing(sizes))
    assert expected_breaks(feed, INF, 1.0) == 0


@pytest.mark.parametrize("name", ["uniform", "power law", "rosin-rammler", "table"])
def test_percentile_inverts_the_closed_form(name):
    def law(size):
        return crushed_passing(FEEDS[name], size, np.array([0.002, 0.02]), 0.7)

    for fraction in (0.01, 0.5, 0.99):
        found = percentile(law, np.full(2, fraction), 0.06)
        assert found.shape == (2,)
        assert law(found) == pytest.approx(fraction, rel=1e-9)


def test_percentiles_of_a_power_law_product_and_of_a_step():
    """A1: P80 = 0.8^(1/gamma) s_c. The feed of one size is a step."""
    for gamma in (0.35, 1.0, 4.0):
        found = percentile(
            lambda size, gamma=gamma: crushed_passing(FEEDS["single"], size, 0.004, gamma), np.array(0.8), 0.06
        )
        assert found == pytest.approx(0.8 ** (1 / gamma) * 0.004, rel=1e-12)
    assert percentile(FEEDS["single"].passing, np.array(0.5), 0.06) == pytest.approx(0.06, rel=1e-12)


def test_expected_breaks_of_one_size():
    """A2: 1 + gamma ln(s0 / s_c), exactly."""
    found = expected_breaks(FEEDS["single"], np.array([0.06 / math.e, 0.006, 0.1]), 2.0)
    assert found == pytest.approx([3.0, 1 + 2 * math.log(10), 0.0], rel=1e-12)


def test_far_above_the_critical_size_a_steep_exponent_overflows_in_silence():
    assert crushed_passing(FEEDS["uniform"], np.array([1e-9, 0.01]), 1e-8, 1e6).tolist() == [0.0, 1.0]


@pytest.mark.parametrize(
    "constants",
    [{"k": 1.0, "gamma": 0.4}, {"k": 0.3, "gamma": 1.5, "nu": 2.0}, {"nu": 0.7, "gamma": 0.3}, {"k": 0.15, "nu": -0.4}],
)
def test_scatter_and_parents_of_the_closed_form_are_the_march_run_to_completion(constants):
    """A16, A17. KS for plain sampling: by chance once in a million; the cascade's own error is below 1e-4.

    Below a twentieth of the size floor, where parents of 1 um may leave much, it is told by the finest class.
    """
    cells, critical, feed = sized(50_000, 1_000), 0.007, FEEDS["uniform"]
    law = laws(**constants)
    passing, breaks = crushed(feed, law.strength, law.fragments, np.array([critical]))
    drawn = draw(feed, cells, np.random.SeedSequence(62))
    level = critical_log_stress(critical)
    found, _, count = march(drawn, streams(cells, 62), [level] * 150, n=INF, **constants)
    sizes = np.geomspace(1e-7, 0.06, 2000)
    shares = np.searchsorted(np.sort(found), sizes) / cells
    assert np.abs(shares - passing(size=sizes[:, None])[:, 0]).max() < KS / math.sqrt(cells) + 1e-4
    assert count / cells == pytest.approx(float(breaks()[0]), abs=SIGMAS * math.sqrt(12 / cells))


@each
def test_cascade_has_the_papers_law_as_its_limit(feed):
    """A3 and A2 for k = inf and nu = 0, by classes; scatter of a large k tends to it."""
    sizes, critical = np.geomspace(2e-6, 0.05, 60), np.array([0.002, 0.02])
    exact = crushed_passing(feed, sizes[:, None], critical, 0.35)
    law = laws(gamma=0.35)
    (edges, _, cumulative, _), breaks = _cascade(feed, law.strength, law.fragments, critical)
    found = np.array([np.interp(np.log(sizes), edges, cumulative[:, line]) for line in range(2)]).T
    apart = np.abs(np.log(sizes[:, None] / critical)) > edges[1] - edges[0]  # not within the class of s_c
    assert np.abs(found - exact)[apart].max() < 3e-4
    assert breaks == pytest.approx(expected_breaks(feed, critical, 0.35), abs=3e-3)
    sharp = crushed(feed, laws(k=100.0).strength, law.fragments, critical)[0](size=sizes[:, None])
    assert np.abs(sharp - exact).max() < 0.02


def test_where_nothing_breaks_the_classes_leave_the_feed_itself():
    values = {"strength.cushioning": math.inf, "fragments.size_exponent": 0.3, "resolution.record": "product"}
    dataset = simulate(paper(values | {"strength.reference_strength": 1e15}))
    expected = paper().feed.passing(dataset["sieve"].values).astype(np.float32)
    assert np.array_equal(dataset["passing_total"], expected)
    for floor in ("59.9 mm", "60 mm", "100 mm"):  # once a negative number of classes
        dataset = simulate(paper(values | {"strength.scatter": 3.0, "fragments.size_floor": floor}))
        np.testing.assert_allclose(dataset["passing_total"], expected, atol=2e-3)


@pytest.mark.parametrize("size", [0.008, 0.03, 0.04, 0.08])
def test_cascade_holds_all_of_a_feed_of_one_size(size):
    """exp(log(size)) may be less than the size, which no grain of the feed passes: the product was then the feed."""
    law = laws(gamma=0.4, nu=1e-12)
    passing, breaks = crushed(SingleFeed(size=size), law.strength, law.fragments, np.array([size / 10]))
    assert float(breaks()[0]) == pytest.approx(1 + 0.4 * math.log(10), abs=1e-3)
    assert float(passing(size=np.array([size / 100]))[0]) == pytest.approx(0.1**0.4, rel=1e-2)


@pytest.mark.parametrize("k", [2.0, 20.0])
def test_cascade_breaks_one_size_by_its_own_chance(k):
    """What is never broken is 1 - B(s0): once B of the middle of the size's class, 1.7 % finer."""
    law, size, critical = laws(k=k, gamma=0.05), 0.04, np.array([0.035, 0.04, 0.05])
    passing, breaks = crushed(SingleFeed(size=size), law.strength, law.fragments, critical)
    broken = -np.expm1(-((size / critical) ** (3 * k / law.strength.weibull_modulus)))
    assert passing(size=np.full(3, 0.93 * size)) == pytest.approx(broken, abs=5e-3)  # few fragments are as coarse
    assert np.all(breaks() > broken)
    assert passing(size=np.full(3, 0.9999 * size)) == pytest.approx(broken, abs=1e-5)  # the rest passes its own size
    assert np.array_equal(passing(size=np.full(3, size)), np.ones(3))


@pytest.mark.parametrize("nu", [0.0, 0.7])
def test_cascade_leaves_the_feed_where_it_is_within_a_class(nu):
    """Two sizes, in intervals narrower than a class: once up to half of the feed too much passed the lower edge."""
    law, critical, sizes = laws(k=2.0, gamma=0.5, nu=nu), np.array([0.01, 0.04]), np.geomspace(0.001, 0.04, 200)
    table = TableFeed(table=((0.00999, 0.0), (0.01, 50.0), (0.03996, 50.0), (0.04, 100.0)))
    one, two, both = (
        crushed(feed, law.strength, law.fragments, critical)[0](size=sizes[:, None])
        for feed in (SingleFeed(size=0.01), SingleFeed(size=0.04), table)
    )
    apart = (np.abs(sizes - 0.00999) > 2e-5) & (np.abs(sizes - 0.03996) > 2e-5)
    assert both[apart] == pytest.approx((one + two)[apart] / 2, abs=0.01)


def test_cascade_knows_where_the_size_floor_is():
    """All that comes near the floor of 1 um breaks: none is left above it, from whatever size the classes count."""
    law = laws(gamma=0.4, nu=1e-12)
    for top in (0.0123, 0.03, 0.0611):
        feed = UniformFeed(bottom_size=0.001, top_size=top)
        passing, _ = crushed(feed, law.strength, law.fragments, np.array([1e-9]))
        assert passing(size=np.array([1e-6]))[0] == pytest.approx(1.0, abs=1e-6)


def test_scattered_strengths_under_a_stress_that_breaks_finer_grains_than_the_floor():
    """B(s) = 1 - exp(-(s/s_c)^m) is 1 at the floor where s_c is far below it: nothing above the floor is left."""
    values = {"strength.cushioning": math.inf, "strength.scatter": 2.0, "strength.reference_strength": 1.0}
    dataset = simulate(paper(values | {"resolution.record": "product", "resolution.sieves": [1.1e-6, 1e-3]}))
    assert dataset["passing"].values == pytest.approx(1.0, abs=1e-6)  # once 0.97


def test_far_below_the_size_floor_passing_is_a_power_of_size():
    """A1 with s_c at the floor, 1 um: once as much passed any finer size as a twentieth of it, and P50 was 1e-30 m."""
    law = laws(gamma=0.1, nu=1e-12)
    passing, _ = crushed(FEEDS["uniform"], law.strength, law.fragments, np.array([1e-9]))
    sizes = np.geomspace(1e-25, 1e-6, 40)
    assert passing(size=sizes[:, None])[:, 0] == pytest.approx((sizes / 1e-6) ** 0.1, rel=1e-3)
    assert percentile(passing, np.array([0.2]), 0.06) == pytest.approx(0.2**10 * 1e-6, rel=1e-2)


@pytest.mark.parametrize("critical", [0.0019, 0.00193, 0.00196, 0.002])
def test_cascade_without_scatter_ends_at_the_critical_size(critical):
    """A3 within the class of s_c, wherever in it s_c lies: once up to 2e-3 too little passed."""
    law, sizes = laws(gamma=0.5, nu=1e-12), critical * np.array([0.97, 0.99, 0.999, 1.001])
    passing, _ = crushed(FEEDS["uniform"], law.strength, law.fragments, np.array([critical]))
    exact = crushed_passing(FEEDS["uniform"], sizes, critical, 0.5)
    assert passing(size=sizes[:, None])[:, 0] == pytest.approx(exact, abs=1e-4)
