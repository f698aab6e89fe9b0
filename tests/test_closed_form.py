import math

import numpy as np
import pytest
from scipy.integrate import quad
from support import KS, SIGMAS, critical_log_stress, draw, ks_distance, march, sized, streams

from hpgr.grains.closed_form import crushed_passing, expected_breaks, percentile
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


@each
@pytest.mark.parametrize("critical", [0.002, 0.02])
def test_expected_breaks_by_another_quadrature(feed, critical):
    """Mean of 1 + gamma ln(s0 / s_c) over the feed above s_c, by quadrature over its quantiles."""
    start, gamma = float(feed.passing(critical)), 0.35

    def breaks(fraction):
        return 1 + gamma * math.log(float(feed.quantile(fraction)) / critical)

    kinks = [f for f in (0.3, 0.6) if f > start]
    wanted = quad(breaks, start, 1 - 1e-12, points=kinks or None, limit=200)[0]
    assert float(expected_breaks(feed, critical, gamma)) == pytest.approx(wanted, rel=1e-3)


def test_expected_breaks_of_one_size():
    """A2: 1 + gamma ln(s0 / s_c), exactly."""
    found = expected_breaks(FEEDS["single"], np.array([0.06 / math.e, 0.006, 0.1]), 2.0)
    assert found == pytest.approx([3.0, 1 + 2 * math.log(10), 0.0], rel=1e-12)


def test_far_above_the_critical_size_a_steep_exponent_overflows_in_silence():
    assert crushed_passing(FEEDS["uniform"], np.array([1e-9, 0.01]), 1e-8, 1e6).tolist() == [0.0, 1.0]
