import math

import numpy as np
import pytest
from scipy.integrate import quad
from support import KS, SIGMAS, critical_log_stress, draw, ks_distance, march, sized, streams

from hpgr import Feed, Material, feed, limits

INF = math.inf
TABLE = ((0.001, 0.0), (0.004, 30.0), (0.016, 60.0), (0.06, 100.0))
FEEDS = {
    "uniform": Feed(kind="uniform", bottom_size=0.008, top_size=0.06),
    "single": Feed(kind="single", size=0.06),
    "power law": Feed(kind="power_law", top_size=0.06, exponent=0.7),
    "rosin-rammler": Feed(kind="rosin_rammler", size=0.02, exponent=1.3, top_size=0.06),
    "table": Feed(kind="table", table=TABLE),
}
each = pytest.mark.parametrize("given_feed", FEEDS.values(), ids=FEEDS)


@pytest.mark.parametrize("w", [1.0, 3.04, 30.0])
def test_critical_size_is_where_strength_meets_stress(w):
    ore = Material(weibull_modulus=w)
    for log_stress in (-1.0, 0.0, 1.5, 3.4):
        critical = float(limits.critical_size(log_stress, ore))
        if critical > ore.size_floor:
            assert -(3 / w) * math.log(critical / ore.strength_size) == pytest.approx(log_stress, abs=1e-12)


def test_critical_size_has_its_limits():
    ore = Material()
    assert limits.critical_size(-INF, ore) == INF
    assert limits.critical_size(0.0, ore) == pytest.approx(0.06, rel=1e-15)
    assert limits.critical_size(100.0, ore) == ore.size_floor
    assert limits.critical_size(np.array([[0.0, -INF]]), ore).shape == (1, 2)


@each
@pytest.mark.parametrize("gamma", [0.35, 1.0, 4.0])
@pytest.mark.parametrize("critical", [0.002, 0.02])
def test_closed_form_is_the_march_run_to_completion(given_feed, gamma, critical):
    """A1 and A3. The feed is stratified, so KS for plain sampling bounds it: by chance once in a million."""
    cells = sized(50_000, 1_000)
    drawn = draw(given_feed, cells, np.random.SeedSequence(61))
    found, _, breaks = march(drawn, streams(cells, 61), [critical_log_stress(critical)] * 80, n=INF, gamma=gamma)
    distance = ks_distance(found, lambda x: limits.crushed_passing(given_feed, x, critical, gamma))
    assert distance < KS / math.sqrt(cells)
    # A2: a broken grain's number of breaks has the variance of its mean's Poisson part and of its feed size
    expected = float(limits.expected_breaks(given_feed, critical, gamma))
    variance = (1 + gamma * math.log(0.06 / critical)) * 1.0 + (1 + gamma * math.log(0.06 / critical)) ** 2 / 4
    quadrature = 2e-3  # kinks of tables and bounds between the 200 nodes
    assert abs(breaks / cells - expected) < SIGMAS * math.sqrt(variance / cells) + quadrature


@each
def test_without_stress_the_closed_form_is_the_feed(given_feed):
    sizes = np.geomspace(1e-5, 0.1, 50)
    assert np.array_equal(limits.crushed_passing(given_feed, sizes, INF, 1.0), feed.passing(given_feed, sizes))
    assert limits.expected_breaks(given_feed, INF, 1.0) == 0


@each
def test_closed_form_is_a_distribution(given_feed):
    sizes = np.geomspace(1e-9, 1, 500)
    for critical in (0.001, 0.03, 0.06, 0.1):
        found = limits.crushed_passing(given_feed, sizes, critical, 0.35)
        assert np.all(np.diff(found) >= 0)
        assert np.all((found >= 0) & (found <= 1))
        assert np.all(found[sizes >= critical] == 1)


@pytest.mark.parametrize("fraction", [0.01, 0.5, 0.8, 0.99])
@pytest.mark.parametrize("name", ["uniform", "power law", "rosin-rammler", "table"])
def test_percentile_inverts_the_closed_form(name, fraction):
    def law(size):
        return limits.crushed_passing(FEEDS[name], size, np.array([0.002, 0.02]), 0.7)

    found = limits.percentile(law, np.full(2, fraction), 0.06)
    assert found.shape == (2,)
    assert law(found) == pytest.approx(fraction, rel=1e-9)


def test_percentiles_of_a_power_law_product():
    """A1: P80 = 0.8^(1/gamma) s_c."""
    for gamma in (0.35, 1.0, 4.0):
        found = limits.percentile(
            lambda size, gamma=gamma: limits.crushed_passing(FEEDS["single"], size, 0.004, gamma), np.array(0.8), 0.06
        )
        assert found == pytest.approx(0.8 ** (1 / gamma) * 0.004, rel=1e-12)


def test_percentile_of_a_step_is_the_step():
    found = limits.percentile(lambda size: limits.crushed_passing(FEEDS["single"], size, INF, 1.0), np.array(0.5), 0.06)
    assert found == pytest.approx(0.06, rel=1e-12)


@pytest.mark.parametrize("gamma", [0.35, 1.0, 4.0])
@pytest.mark.parametrize("critical", [0.002, 0.02, 0.05])
@each
def test_expected_breaks_by_another_quadrature(given_feed, critical, gamma):
    """Mean of 1 + gamma ln(s0 / s_c) over the feed above s_c, by quadrature over its quantiles."""
    start = float(feed.passing(given_feed, critical))

    def breaks(fraction):
        return 1 + gamma * math.log(float(feed.quantile(given_feed, fraction)) / critical)

    kinks = [f for f in (0.3, 0.6) if f > start]
    wanted = quad(breaks, start, 1 - 1e-12, points=kinks or None, limit=200)[0]
    assert float(limits.expected_breaks(given_feed, critical, gamma)) == pytest.approx(wanted, rel=1e-3)


def test_expected_breaks_of_one_size():
    """A2: 1 + gamma ln(s0 / s_c), exactly."""
    found = limits.expected_breaks(FEEDS["single"], np.array([0.06 / math.e, 0.006, 0.1]), 2.0)
    assert found == pytest.approx([3.0, 1 + 2 * math.log(10), 0.0], rel=1e-12)


def test_far_above_the_critical_size_a_steep_exponent_overflows_in_silence():
    found = limits.crushed_passing(FEEDS["uniform"], np.array([1e-9, 0.01]), 1e-8, 1e6)
    assert found.tolist() == [0.0, 1.0]
