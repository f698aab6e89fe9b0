import math
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from support import SIGMAS, crush, first_cells, paper, sized, under

from hpgr import presets, simulate
from hpgr.bed.loaded import inputs_of, load_bed
from hpgr.grains import kernels, march, solve
from hpgr.grains.closed_form import crushed_passing

INF = math.inf
NO_CUSHION = 1e9  # as good as inf, for which the closed form would take over
PLAIN = {"resolution.record": "product", "resolution.control_variate": False}


def load(scene, points=61):
    scene = scene.with_values({"resolution.points": points})
    return solve.crushing_stress(scene, load_bed(inputs_of(scene)))


@pytest.mark.parametrize(
    ("values", "solver"),
    [
        ({"resolution.cells": 0}, "stress only"),
        ({"resolution.cells": 0, "strength.cushioning": INF, "resolution.record": "product"}, "stress only"),
        ({}, "march, control variate"),
        ({"strength.cushioning": INF}, "march"),  # cells are wanted
        ({"strength.cushioning": INF, "resolution.record": "product"}, "closed form"),
        ({"strength.cushioning": INF, "resolution.record": "distributions"}, "closed form"),
        (
            {"strength.cushioning": INF, "strength.weibull_modulus": INF, "resolution.record": "product"},
            "march",  # without size effect there is no critical size
        ),
        ({"strength.cushioning": 100.0, "resolution.record": "product"}, "march, control variate"),
        ({"strength.cushioning": 100.0, "resolution.record": "product", "resolution.control_variate": False}, "march"),
    ],
)
def test_the_cheapest_solver_is_chosen_and_told(values, solver):
    scene = paper(values)
    assert solve.choose(scene) == solver.split(",")[0]
    assert simulate(scene).attrs["solver"] == solver


def test_only_compacting_points_crush():
    """Eq. 1's Heaviside: pressure that is left while the bed dilates crushes nothing."""
    bed = under(np.full((1, 3), 5e6))
    bed.kinematics.volumetric_rate[0, 1] = -1.0
    assert solve.crushing_stress(paper(), bed).tolist() == [[5e6, 0.0, 5e6]]


def test_total_percentiles_are_those_of_the_mixture():
    scene = paper({"strength.cushioning": INF, "resolution.record": "product"})
    history = load(scene)
    found = crush(scene, history, 0, 0)
    critical = scene.strength.critical_size(np.log(history.max(axis=1) / 0.84e6))
    for fraction, size in zip((0.5, 0.8), found.total_percentiles, strict=True):
        mixture = crushed_passing(scene.feed, size, critical, 1.0).mean()
        assert mixture == pytest.approx(fraction, rel=1e-9)
    assert np.all(found.percentiles[:, 0] < found.total_percentiles)
    assert np.all(found.total_percentiles < found.percentiles[:, -1])


def test_closed_form_distributions_are_cumulative_along_the_path():
    """A4: at every point the smallest critical size met so far decides, also past the peak."""
    scene = paper({"strength.cushioning": INF, "resolution.record": "distributions"})
    found = crush(scene, load(scene), 0, 0)
    passing = np.cumsum(found.mass_fraction[0], axis=-1)
    assert np.all(np.diff(passing, axis=1) >= -1e-12)
    assert passing[:, -1] == pytest.approx(found.passing, abs=1e-12)


def test_a_streamline_does_not_depend_on_the_others():
    """Keyed by (replicate, streamline, snapshot): the first streamlines of many are those of few, bit for bit."""
    scene = paper({"resolution.snapshots": 2})
    history = load(scene)
    whole = crush(scene, history, 3, 1)
    for count in (1, 2):
        part = crush(scene, history[:count], 3, 1)
        assert np.array_equal(part.size, whole.size[:, :count])
        assert np.array_equal(part.passing, whole.passing[:count])
        assert np.array_equal(part.percentiles, whole.percentiles[:, :count])
        assert np.array_equal(part.breaks, whole.breaks[:count])


def test_streamlines_under_the_same_stress_are_independent():
    """Correlation of their products: |r| sqrt(M) beyond 5 once in 1.7 million, and no cells in common."""
    cells = sized(2000, 300)
    scene = paper({"resolution.cells": cells})
    product = crush(scene, np.repeat(load(scene)[:1], 3, axis=0), 0, 0).size[0, :, -1]
    for first, second in ((0, 1), (0, 2), (1, 2)):
        assert abs(np.corrcoef(product[first], product[second])[0, 1]) * math.sqrt(cells) < 5
        assert np.intersect1d(product[first], product[second]).size < 5


def test_keys_tell_every_parcel_apart():
    """The package's parcels are those of plain Python, and no two of them share a stream."""
    scene = paper({"resolution.cells": 500})
    keys = [(0, (0, 0, 0)), (1, (0, 0, 0)), (0, (1, 0, 0)), (0, (0, 1, 0)), (0, (0, 0, 1)), (2**64, (0, 0, 0))]
    parcels = [march.first_cells(scene, seed, [key]) for seed, key in keys]
    for (seed, key), found in zip(keys, parcels, strict=True):
        wanted = first_cells(scene, seed, key)
        assert np.array_equal(found.sizes[0, 1:-1], wanted[0])
        assert np.array_equal(found.streams[0, 1:-1], wanted[1])
    assert len({found.sizes.tobytes() for found in parcels}) == len(keys)
    assert np.unique([found.streams[0, 1:-1] for found in parcels]).size == 500 * len(keys)


def test_a_feed_from_zero_holds_no_grain_of_size_zero():
    scene = paper({"feed": {"kind": "power_law", "top_size": 0.06, "exponent": 0.1}, "resolution.cells": 5000})
    assert march.first_cells(scene, 0, [(0, 0, 0)]).sizes[:, 1:-1].min() >= np.float32(kernels.SMALLEST)


def test_summaries_are_those_of_the_recorded_cells():
    grid = {"resolution.snapshots": 2, "resolution.control_variate": False}
    scene = paper(grid | {"fragments.size_floor": "1 mm"})
    found = crush(scene, load(scene), 0, 0)
    product = found.size[:, :, -1].transpose(1, 0, 2).reshape(3, -1).astype(float)
    assert found.percentiles == pytest.approx(np.quantile(product, [0.5, 0.8], axis=1), rel=1e-6)
    assert found.total_percentiles == pytest.approx(np.quantile(product, [0.5, 0.8]), rel=1e-6)
    below = np.mean(product < 0.001, axis=1)
    assert np.array_equal(found.below_floor, below)
    assert 0 < below[0] < 1
    sieves = np.array(scene.resolution.sieves)
    assert np.array_equal(found.passing, np.mean(product[:, :, None] <= sieves, axis=1))


# Section 11 of the model page: figures of a separate program with 1,601 points and 400,000 cells.
REFERENCE = {
    INF: ((0.921, 0.938, 1.012), (1.470, 1.504, 1.619), (3.79, 3.78, 3.71)),
    1.0: ((1.028, 1.052, 1.131), (1.642, 1.680, 1.810), (3.68, 3.66, 3.59)),
}


def machine_history(points, lines=(0, 4, 9)):
    scene = presets.paper().with_values({"resolution.streamlines": 10})
    return load(scene, points)[list(lines)]


def ordered_error(cells):
    """Relative standard errors of P50 and P80, and that of breaks per cell.

    For a uniform product (n = inf, gamma = 1) they are 1 / sqrt(M) and 0.5 / sqrt(M) exactly; the product with
    cushioning is nearly so. The breaks have the variance of a Poisson number, 2.7, and of the feed, 0.3.
    """
    return 1 / math.sqrt(cells), 0.5 / math.sqrt(cells), math.sqrt(3 / cells)


@pytest.mark.parametrize("n", REFERENCE)
def test_converged_figures_of_the_papers_machine(n):
    """5 sigma of both programs' sampling, and the rounding of the printed figures."""
    cells = sized(100_000, 1_000)
    scene = paper({"strength.cushioning": min(n, NO_CUSHION), "resolution.cells": cells} | PLAIN)
    found = crush(scene, machine_history(1601), 71, 0)
    p50, p80, breaks = REFERENCE[n]
    both = zip(ordered_error(cells), ordered_error(4e5), strict=True)
    errors = [SIGMAS * math.hypot(*pair) for pair in both]
    assert found.percentiles[0] * 1e3 == pytest.approx(p50, rel=errors[0] + 0.0005)
    assert found.percentiles[1] * 1e3 == pytest.approx(p80, rel=errors[1] + 0.0004)
    assert found.breaks == pytest.approx(breaks, abs=errors[2] + 0.005)


def test_strong_cushioning_needs_small_time_steps():
    """n = 1/2: P80 at xi = 0.05 still moves with dt. 5 sigma of sampling and the rounding of the figures."""
    cells = sized(100_000, 2_000)
    scene = paper({"strength.cushioning": 0.5, "resolution.cells": cells} | PLAIN)
    found = []
    figures = sized({101: 2.29, 201: 2.47, 401: 2.61, 801: 2.69, 1601: 2.75}, {101: 2.29, 401: 2.61})
    for points, figure in figures.items():
        p80 = 1e3 * crush(scene, machine_history(points, (0,)), 72, 0).percentiles[1, 0]
        # cushioning widens the product's upper end: its P80 scatters up to twice as much as the uniform law's
        assert p80 == pytest.approx(figure, rel=SIGMAS * 2 * ordered_error(cells)[1] + 0.0025)
        found.append(p80)
    assert np.all(np.diff(found) > 0)


def test_large_case_marched_on_all_cores_or_one_by_one_has_the_same_bits(monkeypatch):
    scene = paper({"resolution.snapshots": 2, "resolution.record": "distributions"})
    at_once = crush(scene, load(scene), 5, 1)
    monkeypatch.setattr(march, "_LARGE", 1)
    on_all_cores = crush(scene, load(scene), 5, 1)
    with ThreadPoolExecutor(1) as pool:  # a worker thread of a study
        one_by_one = pool.submit(crush, scene, load(scene), 5, 1).result()
    for found in (on_all_cores, one_by_one):
        for mine, other in zip(found, at_once, strict=True):
            assert (mine is None and other is None) or np.array_equal(mine, other)
