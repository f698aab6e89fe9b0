"""Laws of strength, fragments and exchange against arithmetic done by hand."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hpgr.laws.exchange import Exchange
from hpgr.laws.fragments import Fragments
from hpgr.laws.strength import Strength

INF = math.inf


def test_strength_by_hand():
    """Eq. 2: of cells 2, 1, 6 mm and so on the mean beside the second is 3 mm."""
    law = Strength(reference_size=0.004, weibull_modulus=1.5, cushioning=2.0)
    found = law.log_strength(np.array([0.002, 0.001, 0.006, 0.004]))
    assert found[1] == pytest.approx(2 * math.log(4) + (math.log(3) / 2) ** 2 / 2)
    assert found[3] == pytest.approx(0.0)  # the reference size beside 2 and 6 mm, whose mean it is
    assert law.log_strength([[0.002]]) == pytest.approx(2 * math.log(2))  # its own neighbour on both sides


@given(st.lists(st.floats(1e-4, 0.06), min_size=1, max_size=8), st.floats(0.3, 5))
def test_cushioning_only_strengthens_and_by_a_bounded_factor_among_finer_grains(sizes, cushioning):
    cushioned, plain = (Strength(cushioning=n).log_strength(sizes) for n in (cushioning, INF))
    assert np.all(cushioned >= plain)
    largest = np.argmax(sizes)
    assert cushioned[largest] <= plain[largest] + math.log(3) ** 2 / (2 * cushioning**2) + 1e-9


@pytest.mark.parametrize("n", [1e-6, 1e-3, 0.1, 0.5, 1.0, 30.0, INF])
@pytest.mark.parametrize("w", [3.04, 1e100, 1e308, INF])
def test_polynomial_of_cushioning_is_as_wrong_as_it_says(n, w):
    law = Strength(cushioning=n, weibull_modulus=w)
    mean, size = np.float32(0.01), np.geomspace(0.0005, 0.03, 5000, dtype=np.float32)
    size = np.concatenate([size, mean * np.float32(1 + 1e-6 * np.linspace(-1, 1, 50))])
    constants = law.constants()
    *terms, wrong, per_square = constants.cushioned
    assert wrong < (1e-3 if w == 3.04 and n >= 0.1 else 1e10)
    z = (size - mean) / (size + mean)
    part = z * z * per_square
    found = np.polynomial.polynomial.polyval(np.minimum(part, np.float32(1)), terms)
    assert found.dtype == np.float32
    with np.errstate(over="ignore"):
        exact = np.exp(-(constants.cushion * np.log(size.astype(float) / float(mean)) ** 2) / constants.scale)
    assert np.all(abs(found - exact)[part < 1] <= wrong)
    assert np.all(exact <= found + wrong)


@pytest.mark.parametrize("w", [1.0, 3.04, 30.0])
def test_critical_size_is_where_strength_meets_stress(w):
    law = Strength(weibull_modulus=w, cushioning=INF)
    levels = np.array([-1.0, 0.0, 1.5, 3.4])
    assert law.log_strength(law.critical_size(levels)[:, None])[:, 0] == pytest.approx(levels, abs=1e-12)
    assert law.critical_size_ratio(levels) == pytest.approx(law.critical_size(levels) / law.reference_size)
    assert law.critical_size(-INF) == law.critical_size_ratio(np.float64(-INF)) == INF


def test_stress_that_crushes():
    """Mean p, or major p + 2 q / 3; the log is over the reference strength, and none breaks nothing."""
    assert Strength().crushing_stress(3.0, 6.0) == 3.0
    assert Strength(stress="major").crushing_stress(3.0, 6.0) == 7.0
    assert Strength(reference_strength=2.0).log_stress(np.array([0.0, 2.0, 2 * math.e])).tolist() == [-INF, 0.0, 1.0]


def test_fragments_by_hand_and_back():
    law = Fragments(exponent=0.5)
    assert law.passing([0.04, 0.25, 1.0]) == pytest.approx([0.2, 0.5, 1.0])
    ratios = np.linspace(0.01, 1, 20)
    assert law.quantile(law.passing(ratios)) == pytest.approx(ratios)


def test_percolation_under_gravity_is_never_faster_than_a_grain_falls():
    """v = A gammadot |s - sbar| / (1 + A gammadot |s - sbar| / sqrt(g sbar)), from `ceiling`."""
    law, difference, mean = Exchange(segregation=0.2, percolation="gravity"), 0.01, 0.02
    for shear_rate in (1e-3, 1.0, 1e6):
        free = 0.2 * shear_rate * difference
        held = free / (1 + law.ceiling(shear_rate) * difference / math.sqrt(mean))
        assert held == pytest.approx(free / (1 + free / math.sqrt(9.81 * mean)), rel=1e-14)
        assert held < math.sqrt(9.81 * mean)
    assert held == pytest.approx(math.sqrt(9.81 * mean), rel=1e-3)
    assert Exchange().ceiling(5.0) == 0
