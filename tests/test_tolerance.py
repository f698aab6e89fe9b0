"""tolerance: the stated error holds, is reached, and is refused with its cost where it cannot be."""

import math

import numpy as np
import pytest
from support import COMPILED

import hpgr
from hpgr import tolerance
from hpgr.run import run_scene

WANTED = 0.03


def random_scenes(count):
    """Yield scenes between mild and hard: cushioned or not, single-size to wide feeds, shallow to steep beds."""
    source = np.random.default_rng(20261123)
    for _ in range(count):
        gap = source.uniform(0.03, 0.08)
        yield hpgr.presets.paper().with_values(
            {
                "rolls.gap": gap,
                "rolls.entry_gap": gap * source.uniform(14, 22),
                "feed.top_size": source.uniform(0.03, 0.07),
                "strength.cushioning": source.choice([0.5, 0.7, 1.0, 2.0, math.inf]) if COMPILED else math.inf,
                "strength.weibull_modulus": source.uniform(2.5, 5),
                "fragments.exponent": source.uniform(0.4, 1.5),
                "flow.exponent": source.uniform(0.9, 1.1),
                "resolution.record": "product",
            }
        )


def plant_scenes(count):
    """Yield scenes of five classes in turn: nip profile, table feeds, weak crushing, roll width, exchange."""
    uniform, choice = np.random.default_rng(20261126).uniform, np.random.default_rng(20261127).choice
    for k in range(count):
        base = (hpgr.presets.khd_pilot(), hpgr.presets.industrial())[k // 5 % 2]
        strength = base.strength.reference_strength
        values = {
            "resolution.record": "product",
            "flow.nip_angle": math.radians(uniform(8, 10)),
            "strength.cushioning": choice([0.5, 1.0, 2.0, math.inf]),
        }
        sizes, percent = np.geomspace(2e-4, uniform(0.02, 0.05), 7).tolist(), sorted(uniform(0, 100, 6).tolist())
        values |= {
            "nip": {"rolls.gap": base.rolls.gap * uniform(0.9, 1.2)},
            "table": {"feed": {"kind": "table", "table": [*zip(sizes, [*percent, 100.0], strict=True)]}},
            "weak": {"strength.reference_strength": strength * uniform(3, 20)},
            "width": {"roll_width": {"pressure_drop": uniform(0.3, 1), "slices": 2}},
            "exchange": {"exchange": {"segregation": uniform(0, 0.3), "mixing": uniform(0, 0.3)}},
        }[CLASSES[k % 5]]
        if CLASSES[k % 5] == "exchange":  # what the lattice runs in seconds
            base = hpgr.presets.paper()
            gap = {"rolls.gap": uniform(0.04, 0.08), "resolution.streamlines": 3}
            values = gap | {name: values[name] for name in ("exchange", "resolution.record")}
        yield base.with_values(values)


CLASSES = ("nip", "table", "weak", "width", "exchange")


def reference(scene):
    """Return the figures of a run an order of magnitude finer than a tolerance of 3 % asks for."""
    lattice = scene.exchange is not None
    fine = {
        "resolution.points": 301 if lattice else 12_801 if COMPILED else 3201,
        "resolution.streamlines": 4 if lattice else 20,
        "resolution.cells": 1500 if lattice else 5000,
    }
    return tolerance.figures_of(run_scene(scene.with_values(fine), 99).values)


@pytest.mark.slow
@pytest.mark.parametrize(("scenes", "count"), [(random_scenes, 40), (plant_scenes, 60)])
def test_true_error_is_within_the_stated_one_on_random_scenes(scenes, count):
    # 3 figures a scene. The estimate is bias + 2 standard errors: 5 % may miss by design. The seeds are fixed, so the
    # outcome is too; over 100 other scenes 2 of 300 figures missed, and with 120 figures that miss with probability
    # 0.7 % each more than 6 misses have a chance of 4e-6.
    hits, figures, refused = 0, 0, 0
    for scene in scenes(count if COMPILED else 6):
        wanted = WANTED if scene.exchange is None else 0.2  # the lattice costs a hundred times as much
        try:
            estimate = tolerance.refine(scene, wanted, run_scene)
        except ValueError:
            refused += 1
            continue
        found, true = tolerance.figures_of(run_scene(estimate.scene).values), reference(scene)
        for name, stated in estimate.errors().items():
            assert stated <= wanted
            hits += abs(tolerance.relative(found, true, name)) <= stated
            figures += 1
    assert hits >= 0.95 * figures, (hits, figures)
    assert refused <= 3


@pytest.mark.plumbing
def test_pilot_cells_are_never_undercut_and_the_feeds_own_cells_count():
    """A scene that hardly breaks: its scatter over replicates is that of the feed's strata, which may vanish."""
    weak = hpgr.presets.industrial().with_values(
        {"resolution.record": "product", "strength.reference_strength": "30 MPa", "strength.cushioning": 1.0}
    )
    estimate = tolerance.refine(weak, WANTED, run_scene)
    cells, lines = estimate.scene.resolution.cells, estimate.scene.resolution.streamlines
    fineness = tolerance.figures_of(run_scene(estimate.scene).values)["fineness"]
    assert estimate.noise["fineness"] >= 0.99 * 0.5 / (cells * math.sqrt(lines) * fineness)
    assert 300 <= cells < 10_000


def test_smaller_tolerance_takes_a_finer_grid():
    scene = next(iter(random_scenes(1)))
    coarse, fine = (tolerance.refine(scene, wanted, run_scene).scene.resolution for wanted in (0.1, 0.005))
    assert fine.points > coarse.points


@pytest.mark.skipif(not COMPILED, reason="the ladder at n = 0.5 needs millions of crushing tests")
def test_strong_cushioning_takes_more_steps():
    # model page, section 11: at n = 0.5 P80 still moves by 2 % between 800 and 1,600 points
    scene = hpgr.presets.paper().with_values({"resolution.record": "product"})
    mild = tolerance.refine(scene, 0.02, run_scene).scene.resolution.points
    strong = tolerance.refine(scene.with_values({"strength.cushioning": 0.5}), 0.02, run_scene).scene.resolution.points
    assert strong > 1601 > mild


def test_result_carries_its_errors_and_resolution():
    scene = hpgr.presets.paper().with_values({"strength.cushioning": math.inf, "resolution.record": "product"})
    dataset = hpgr.simulate(scene, tolerance=0.02)
    for name in ("p80_total_error", "fineness_error", "peak_pressure_error"):
        assert 0 < dataset[name] <= 0.02
        assert dataset[name].attrs["units"] == "1"
    used = hpgr.Scene.model_validate_json(dataset.attrs["scene"]).resolution
    assert used.points == dataset.sizes["point"] > 51
    assert "p80_total_error" not in hpgr.simulate(scene)


def test_stress_alone_has_the_error_of_its_pressure_only():
    dataset = hpgr.simulate(hpgr.presets.paper().with_values({"resolution.cells": 0}), tolerance=0.01)
    assert 0 < dataset["peak_pressure_error"] <= 0.01
    assert "p80_total_error" not in dataset
    # the reference peak pressure of the mid-most tube, model page, section 3
    assert float(dataset["peak_pressure"]) == pytest.approx(26.65e6, rel=0.01)


def test_wanted_cells_of_a_scene_without_cushioning_are_judged_as_cells():
    # its product alone would have the closed form, without noise
    scene = hpgr.presets.paper().with_values({"strength.cushioning": math.inf})
    if not COMPILED:
        scene = scene.with_values({"resolution.streamlines": 1})
    estimate = tolerance.refine(scene, 0.2 if not COMPILED else 0.05, run_scene)
    assert estimate.noise["p80"] > 0
    assert estimate.scene.resolution.record == "cells"


def test_impossible_tolerance_is_refused_with_its_cost():
    scene = hpgr.presets.paper().with_values({"resolution.record": "product"})
    with pytest.raises(ValueError, match=r"tolerance: got 0\.001; .*predicted to cost .* s; must be at most max_cost"):
        hpgr.simulate(scene, tolerance=0.001, max_cost=0.05)


def test_tail_of_changes_on_manufactured_sequences():
    # first order: changes 8, 4 leave 4; half order (ratio 2^-1/2): 8, 5.657 leave 5.657 x 2.414
    assert tolerance._left((4.0, 0.0), (8.0, 0.0)) == pytest.approx(4.0)
    assert tolerance._left((8 / math.sqrt(2), 0.0), (8.0, 0.0)) == pytest.approx(8 / (math.sqrt(2) - 1) / math.sqrt(2))
    # faster than first order counts as first order, slower than 0.85 as 0.85
    assert tolerance._left((1.0, 0.0), (8.0, 0.0)) == pytest.approx(1.0)
    assert tolerance._left((8.0, 0.0), (8.0, 0.0)) == pytest.approx(8 * 0.85 / 0.15)
