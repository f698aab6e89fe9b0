"""The control variate: the product of the march, corrected by what its cells come to without cushioning."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import paper, sized

from hpgr import passing, percentile_size, simulate
from hpgr.grains import march, solve
from hpgr.grains.solve import Loaded
from hpgr.run import load

REPLICATES = 200
LIMIT = 4.5  # standard errors; a normal deviate leaves them once in 147,000
BASE = {"resolution.record": "product", "resolution.points": 60}
TABLE = {"kind": "table", "table": [[0.001, 0], [0.004, 30], [0.02, 60], [0.06, 100]]}
SCENES = {
    "paper": {},
    "much shielding": {"strength.cushioning": 0.5},
    "little shielding": {"strength.cushioning": 2.0},
    "feed of a laboratory": {"feed": TABLE, "strength.cushioning": 0.5},
    "scatter": {"strength.scatter": 2.0},
    "fragments by parent": {
        "fragments.size_exponent": 0.7,
        "fragments.reference_size": 0.01,
        "strength.cushioning": 2.0,
    },
    "fines": {"fragments.exponent": 0.35},
    "roll width": {"roll_width": {"slices": 2, "pressure_drop": 0.8}},
}
SIEVES = (8, 18, 24, 30, 33)  # 6 um, 63 um, 0.25, 1 and 2 mm


def products(values, cells, replicates=REPLICATES, **more):
    """Products of a scene in its bed, with the control variate and without."""
    scene, bed = load(paper(BASE | {"resolution.cells": cells} | values))
    for used in (True, False):
        chosen = scene.with_values({"resolution.control_variate": used})
        [crushed] = solve.crush([Loaded(chosen, bed, range(replicates))], 0)
        yield crushed


def figures(crushed):
    return [
        [*one.total_percentiles, *one.passing.mean(axis=0)[list(SIEVES)], *one.percentiles[:, -1]] for one in crushed
    ]


@pytest.mark.parametrize("values", SCENES.values(), ids=SCENES)
def test_the_mean_stays(values):
    """Pairs of the same cells; 9 figures of 8 scenes leave `LIMIT` standard errors by chance once in 2,000 runs.

    A ratio of counts is off by less than its error over the square root of the cells, of which 200 means see little.
    """
    corrected, plain = (np.array(figures(found)) for found in products(values, sized(1000, 100), sized(REPLICATES, 20)))
    off = corrected - plain
    error = off.std(axis=0, ddof=1) / np.sqrt(len(off))
    assert np.all(np.abs(off.mean(axis=0)) <= LIMIT * error + 1e-12)


def test_the_scatter_falls():
    """The ratio of standard deviations of 200 is known to 7 %: 0.51, 0.8 and 0.46 pass the bounds once in 10,000."""
    corrected, plain = (np.array(figures(found)) for found in products({}, sized(1000, 200), sized(REPLICATES, 40)))
    p50, p80, *passing = corrected.std(axis=0) / plain.std(axis=0)
    slack = sized(1.0, 1.3)
    assert p50 < 0.66 * slack
    assert p80 < 1.0 * slack
    assert passing[3] < 0.6 * slack  # 1 mm


@settings(max_examples=sized(40, 5), deadline=None)
@given(
    st.sampled_from(
        [*SCENES.values(), {"feed": {"kind": "single", "size": "50 mm"}}, {"strength.reference_strength": 1e12}]
    ),
    st.sampled_from([0.2, 1.0, 30.0]),
    st.sampled_from([1, 2, 3, 17, 250]),
    st.sampled_from([1, 3]),
)
def test_passing_rises_within_0_and_1(values, cushioning, cells, snapshots):
    values = values | {"strength.cushioning": cushioning, "resolution.snapshots": snapshots}
    for crushed in next(products(values, cells, replicates=3)):
        for found in (crushed.passing, crushed.passing.mean(axis=0)):
            assert np.all(np.diff(found, axis=-1) >= 0)
            assert np.all((found >= 0) & (found <= 1))
        assert np.all(crushed.passing[:, -1] == 1)  # 1 m
        assert np.all(crushed.total_percentiles > 0)
        assert np.all(np.diff(crushed.percentiles, axis=0) >= 0)


def marched(values, complete):
    scene, bed = load(paper(BASE | values))
    log_stress = scene.strength.log_stress(solve.crushing_stress(scene, bed))
    found = march.march([scene], march.path(scene, log_stress[None]), 0, [(0, 0, 0)], complete)
    return scene, log_stress, found


@pytest.mark.parametrize("values", [SCENES[name] for name in ("paper", "fines", "scatter", "fragments by parent")])
def test_cells_run_on_to_what_they_come_to_without_cushioning(values):
    """Bit for bit what a march without cushioning leaves, whose bed stays at its peak long enough."""
    scene, log_stress, found = marched(values, complete=True)
    assert np.all(found.complete <= found.product)
    assert np.any(found.complete < found.product)
    still = np.repeat(log_stress.max(axis=1, keepdims=True), 100, axis=1)
    free = scene.with_values({"strength.cushioning": "inf"})
    wanted = march.march([free], march.path(free, np.hstack([log_stress, still])[None]), 0, [(0, 0, 0)])
    assert np.array_equal(found.complete, wanted.product)


def test_fragments_nearly_as_large_as_their_parents_are_not_completed():
    """Completion takes breaks in proportion to the exponent: 5 million a cell at its upper bound."""
    for exponent, used in ((10.0, True), (10.1, False), (1e6, False)):
        assert solve.is_controlled(paper({"fragments.exponent": exponent})) == used
    result = simulate(paper(BASE | {"fragments.exponent": 1e6, "resolution.cells": 50}))
    assert result.attrs["solver"] == "march"


def test_little_cushioning_is_the_closed_form():
    """What every cell comes to without cushioning is known exactly, so little is left to chance."""
    corrected, plain = (
        next(iter(found)) for found in products({"strength.cushioning": 100.0, "resolution.points": 400}, 50, 1)
    )
    _, bed = load(paper(BASE | {"resolution.points": 400}))
    free = paper(BASE | {"resolution.points": 400, "strength.cushioning": "inf"})
    [[exact]] = solve.crush([Loaded(free, bed, [0])], 0)
    off, before = (np.abs(found.passing - exact.passing).max() for found in (corrected, plain))
    assert off < 0.03 < before


@pytest.mark.parametrize("record", ["cells", "distributions"])
def test_what_is_recorded_is_not_corrected(record):
    """The product is the same whatever is recorded; the cells and their distributions are those without correction."""
    scene = paper({"resolution.points": 40, "resolution.cells": 60, "resolution.snapshots": 2})
    found = {
        (kept, used): simulate(scene.with_values({"resolution.record": kept, "resolution.control_variate": used}))
        for kept in ("product", record)
        for used in (True, False)
    }
    for used, solver in ((True, "march, control variate"), (False, "march")):
        for name in ("passing", "passing_total", "p50", "p80", "p80_total", "below_floor"):
            assert np.array_equal(found["product", used][name], found[record, used][name]), name
        assert found[record, used].attrs["solver"] == solver
    corrected, plain = found[record, True], found[record, False]
    kept = "size" if record == "cells" else "mass_fraction"
    assert np.array_equal(corrected[kept], plain[kept])
    assert not np.array_equal(corrected["passing"], plain["passing"])
    assert np.array_equal(passing(corrected), corrected["passing"])
    assert percentile_size(corrected, 80, total=True) == corrected["p80_total"]


@pytest.mark.parametrize("values", SCENES.values(), ids=SCENES)
def test_percentiles_and_passing_agree(values):
    """Of a streamline, of the total: what passes the size read as P50 is half, but for a few cells."""
    cells = sized(500, 100)
    [found] = next(products(values, cells, replicates=1))
    for k, fraction in enumerate(solve.FRACTIONS):
        for sizes, passes in (
            (found.percentiles[k, :1], lambda one: one.passing[0]),
            (found.total_percentiles[k : k + 1], lambda one: one.passing.mean(axis=0)),
        ):
            [again] = next(products(values | {"resolution.sieves": sizes.tolist()}, cells, replicates=1))
            assert passes(again)[0] == pytest.approx(fraction, abs=5 / cells)


def test_exact_passing_is_corrected_by_counts():
    counts, complete = np.array([[0, 0, 2, 8], [0, 3, 3, 8]]), np.array([[0, 1, 4, 8], [0, 4, 8, 8]])
    exact = np.array([[0.05, 0.2, 0.4, 1.0], [0.02, 0.5, 0.9, 1.0]])
    # below every cell the ratio is that of the next sieve; 3 / 4 x 0.5 is more than 3 / 8 x 0.9
    wanted = [[0.0, 0.0, 0.2, 1.0], [0.75 * 0.02, 0.375, 0.375, 1.0]]
    assert solve.corrected(counts, complete, exact) == pytest.approx(np.array(wanted))
    assert np.array_equal(solve.corrected(0 * counts, 0 * complete, exact), exact)  # every cell is too coarse


def test_quantiles_are_those_of_numpy():
    rows = np.sort(np.random.default_rng(0).random((3, 17)).astype(np.float32), axis=1)
    fractions = np.array([[0.0, 0.5, 0.3], [0.8, 1.0, 0.31]])
    found = solve.quantiles(solve.Mixed(rows[None]), fractions[:, None])[:, 0]
    wanted = [[np.quantile(row.astype(float), at) for row, at in zip(rows, each, strict=True)] for each in fractions]
    assert found == pytest.approx(np.array(wanted), rel=1e-12)
