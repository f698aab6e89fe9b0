"""Sweeps in one process: labels, bits, and cases that are lost alone."""

import numpy as np
import pytest
from support import one_by_one, paper, plain_pilot

import hpgr
from hpgr.results import schema
from hpgr.results.schema import STATUS
from studies.sweep import run, sweep
from studies.sweep.space import AXES, Space, axes_of, dim_of

SMALL = {"resolution.streamlines": 3, "resolution.points": 40, "resolution.cells": 60}
GAPS = ["40 mm", "50 mm", "60 mm"]


@pytest.fixture(scope="module")
def base():
    return paper(SMALL)


@pytest.fixture(scope="module")
def grid(base, client):
    """Three axes in an order that is neither alphabetical nor the scene's."""
    axes = {"rolls.speed": ["15 rpm", "19 rpm"], "feed.top_size": [0.05, 0.06], "rolls.gap": np.array([0.06, 0.04])}
    return sweep(base, axes, replicates=2, seed=3, client=client)


def same_bits(one, other):
    """Assert that two results hold the same variables, bit for bit (the sign of zero and NaN included)."""
    assert set(one.data_vars) == set(other.data_vars)
    for name in one.variables:
        left, right = one[name].values, other[name].values
        assert left.dtype == right.dtype, name
        assert np.array_equal(left, right, equal_nan=left.dtype.kind == "f"), name


def test_labelled_grid(grid, base):
    assert list(grid["p80_total"].dims) == ["roll_speed", "feed_top_size", "gap", "replicate"]
    assert list(grid["passing"].dims)[-2:] == ["streamline", "sieve"]
    assert grid["passing"].shape == (2, 2, 2, 2, 3, 61)
    assert grid["gap"].values.tolist() == [0.06, 0.04]  # the order given, not sorted
    assert grid["roll_speed"].values == pytest.approx([15 * np.pi / 30, 19 * np.pi / 30], rel=1e-12)
    assert grid["feed_top_size"].values.tolist() == [0.05, 0.06]
    assert grid["replicate"].values.tolist() == [0, 1]
    units = {"gap": "m", "roll_speed": "rad s-1", "feed_top_size": "m"}
    for name, unit in units.items():
        assert (grid[name].attrs["units"], grid[name].attrs["scene_field"]) == (unit, AXES[name])
        assert grid[name].attrs["long_name"]
    assert (grid["status"] == STATUS["ok"]).all()
    assert hpgr.Scene.model_validate_json(grid.attrs["scene"]) == base.with_values({"resolution.record": "product"})
    assert (grid.attrs["seed"], grid.attrs["replicates"]) == (3, 2)
    assert grid.attrs["axes"] == "rolls.speed, feed.top_size, rolls.gap"
    assert not {name for name, value in grid.coords.items() if value.ndim == 0}


def test_every_place_holds_its_own_case(grid, base):
    space = Space(axes_of({dim: grid[dim] for dim in ("roll_speed", "feed_top_size", "gap")}), 2)
    for case in space.cases():
        values = case.values | {"resolution.record": "product"}
        alone = hpgr.simulate(base.with_values(values), seed=3, replicate=case.replicate)
        for name in ("throughput", "peak_pressure", "p80_total", "passing", "breaks_per_cell", "flags"):
            assert np.array_equal(grid[name].values[case.index], alone[name].values), name


def test_cases_are_numbered_in_the_order_of_the_axes():
    space = Space(axes_of({"rolls.gap": [1.0, 2.0], "rolls.speed": [3.0, 4.0, 5.0]}), 2)
    assert [case.index for case in space.cases()] == list(np.ndindex(2, 3, 2))
    assert [space.number(case.index) for case in space.cases()] == list(range(space.total))
    assert space.case(9) == ((1, 1, 1), {"rolls.gap": 2.0, "rolls.speed": 4.0}, 1)


def test_what_is_held_fixed_is_told_as_scalar_coordinates(base, client):
    swept = sweep(base, {"rolls.gap": [0.05]}, client=client)
    assert {name: float(value) for name, value in swept.coords.items() if value.ndim == 0} == {
        "roll_speed": base.rolls.speed,
        "feed_top_size": 0.06,
    }
    assert swept["roll_speed"].attrs["units"] == "rad s-1"
    floating = base.with_values({"rolls.specific_pressing_force": 3e6, "resolution.cells": 0})
    held = sweep(floating, {"feed.bottom_size": [0.001]}, client=client)
    assert {name for name, value in held.coords.items() if value.ndim == 0} == {"press_force", "roll_speed"}


def test_every_summary_of_a_simulation_is_kept(base, client):
    alone = hpgr.simulate(base.with_values({"resolution.record": "product"}))
    result = sweep(base, {"rolls.gap": [0.06]}, client=client)
    kept = {name for name, value in alone.data_vars.items() if not {"point", "cell", "time"} & set(value.dims)}
    assert kept == set(result.data_vars) | {"flags"}
    for name in kept:
        assert result[name].attrs.keys() == alone[name].attrs.keys()
        assert result[name].dtype == alone[name].dtype
    for name in ("xi", "sieve"):
        assert np.array_equal(result[name], alone[name])
        assert result[name].attrs == schema.attributes(name)


def test_bits_do_not_depend_on_threads_order_or_company(base, client):
    two = sweep(base, {"rolls.gap": GAPS}, replicates=3, seed=7)
    same_bits(sweep(base, {"rolls.gap": GAPS}, replicates=3, seed=7, client=client), two)
    turned = sweep(base, {"rolls.gap": GAPS[::-1]}, replicates=3, seed=7, client=client)
    same_bits(turned.isel(gap=[2, 1, 0]), two)
    longer = sweep(base, {"rolls.gap": ["35 mm", *GAPS, "70 mm"]}, replicates=4, seed=7, client=client)
    same_bits(longer.isel(gap=[1, 2, 3], replicate=[0, 1, 2]), two)
    wider = sweep(base, {"feed.top_size": [0.05, 0.06], "rolls.gap": GAPS}, replicates=3, seed=7, client=client)
    same_bits(wider.isel(feed_top_size=1), two.assign_coords(feed_top_size=0.06))
    other = sweep(base, {"rolls.gap": GAPS}, replicates=3, seed=8, client=client)
    assert not np.array_equal(other["passing"], two["passing"])


def test_other_fields_as_axes(base, client):
    axes = {"strength.cushioning": [0.5, np.inf], "elasticity.integrator": ["increment", "euler"]}
    result = sweep(base, axes, client=client)
    assert result["p80_total"].dims == ("strength_cushioning", "elasticity_integrator", "replicate")
    assert result["strength_cushioning"].values.tolist() == [0.5, np.inf]
    assert result["elasticity_integrator"].values.tolist() == ["increment", "euler"]
    assert result["elasticity_integrator"].dtype.kind == "U"
    assert (result["status"] == 0).all()
    pressure = result["peak_pressure"].isel(replicate=0)
    assert np.array_equal(pressure[0], pressure[1])  # cushioning is no elasticity
    assert (pressure[:, 0] != pressure[:, 1]).all()
    alone = hpgr.simulate(base.with_values({"strength.cushioning": np.inf, "resolution.record": "product"}))
    assert result["p80_total"].values[1, 0, 0] == alone["p80_total"]
    assert [dim_of(name) for name in ("bed.solid_density", "resolution.points")] == ["solid_density", "points"]


def test_ragged_variables_are_left_out_and_named(base, client):
    result = sweep(base, {"resolution.streamlines": [2, 3]}, client=client)
    left_out = result.attrs["left_out"].split(", ")
    assert {"passing", "p80", "xi", "streamline_peak_pressure"} <= set(left_out)
    assert not set(left_out) & set(result.variables)
    assert "streamline" not in result.dims
    assert result["p80_total"].notnull().all()
    assert result["passing_total"].notnull().all()
    assert sweep(base, {"rolls.gap": [0.05]}, client=client).attrs["left_out"] == ""


def test_stress_only_and_cells_in_one_sweep(base, client):
    # the stress-only case has no sieves: the coordinate must come from one that has
    result = sweep(base, {"resolution.cells": [0, 60]}, client=client)
    assert (result["status"] == 0).all()
    assert result["p80_total"].isnull().values[:, 0].tolist() == [True, False]
    assert result["peak_pressure"].notnull().all()
    assert np.array_equal(result["sieve"], base.resolution.sieves)


def test_no_axes_and_no_cells(base, client):
    result = sweep(base.with_values({"resolution.cells": 0}), {}, replicates=2, client=client)
    assert result["peak_pressure"].dims == ("replicate",)
    assert not {"passing", "sieve"} & set(result.variables)


@pytest.mark.parametrize(
    ("axes", "words"),
    [
        ({"rolls.gap": []}, ["rolls.gap", "no values"]),
        ({"rolls.gap": "40 mm"}, ["rolls.gap", "a list of values"]),
        ({"rolls.gap": ["40"]}, ["rolls.gap", "without a unit", "40 mm"]),
        ({"rolls.gap": [-0.04]}, ["rolls.gap", "-40 mm", "at least"]),
        # a coordinate holds one number or text per label
        ({"resolution.sieves": [(0.001, 1.0), (0.002, 1.0)]}, ["resolution.sieves", "no lists"]),
        ({"rolls.gap": [0.04], "rolls.specific_pressing_force": [3e6]}, ["rolls.gap", "floats", "one of them"]),
    ],
)
def test_bad_axes_are_refused_before_anything_runs(base, monkeypatch, axes, words):
    monkeypatch.setattr(run, "results", None)  # calling it would raise a TypeError
    with pytest.raises(ValueError) as caught:  # noqa: PT011, the words are checked below
        sweep(base, axes)
    for word in words:
        assert word in str(caught.value)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"threads": 0}, "threads: got 0"),
        ({"seed": -1}, "seed: got -1"),
        ({"record": "cells"}, "folder: got None; record='cells'"),
    ],
)
def test_bad_options_are_refused(base, options, words):
    with pytest.raises(ValueError, match=words):
        sweep(base, {"rolls.gap": [0.05]}, **options)


@pytest.fixture(scope="module")
def good(base, client):
    return sweep(base, {"rolls.gap": GAPS}, replicates=4, client=client)


@pytest.fixture
def run_scene(monkeypatch):
    """Have every case run by another function, which is given the real one."""

    def patch(other):
        real = run.run_scene
        monkeypatch.setattr(run, "run_together", one_by_one(lambda *case: other(real, *case)))

    return patch


def lost_only(result, good, place, status, *words):
    """Assert that one place holds NaN, status and message, and that all others are as in `good`."""
    keep = np.ones(good["status"].shape, bool)
    keep[place] = False
    assert (result["status"].values[place] == STATUS[status]).all()
    for word in words:
        assert all(word in message for message in np.atleast_1d(result["message"].values[place]))
    assert (result["status"].values[keep] == STATUS["ok"]).all()
    assert (result["message"].values[keep] == "").all()
    for name in good.data_vars:
        assert np.array_equal(result[name].values[keep], good[name].values[keep]), name
        if result[name].dtype.kind == "f":
            assert np.isnan(result[name].values[place]).all(), name


def test_refused_case_loses_itself_only(base, client):
    good = sweep(base, {"rolls.gap": [0.04, 0.05]}, replicates=2, client=client)
    result = sweep(base, {"rolls.gap": [0.04, "1.2 m", 0.05]}, replicates=2, client=client)
    lost_only(result, good.reindex(gap=[0.04, 1.2, 0.05]), (1,), "refused", "rolls.gap", "1200 mm", "entry gap")


@pytest.mark.parametrize(
    ("raised", "status", "words"),
    [
        (RuntimeError("boom"), "failed", ["RuntimeError", "boom"]),
        (MemoryError("predicted 9 bytes"), "refused", ["predicted 9 bytes"]),
    ],
)
def test_raising_case_loses_itself_only(base, client, good, run_scene, raised, status, words):
    def other(real, scene, seed, replicate, beds):
        if scene.rolls.gap == 0.05 and replicate == 2:
            raise raised
        return real(scene, seed, replicate, beds)

    run_scene(other)
    # 12 cases on one thread: batches of 3, so the others share a batch with the one that raises
    lost_only(sweep(base, {"rolls.gap": GAPS}, replicates=4, client=client), good, (1, 2), status, *words)


def test_case_that_is_not_finite_loses_itself_only(base, client, good, run_scene):
    def other(real, scene, seed, replicate, beds):
        found = real(scene, seed, replicate, beds)
        if scene.rolls.gap == 0.06 and replicate == 0:
            found.values["p80"][1] = np.nan
            found.values["throughput"] *= np.inf
        return found

    run_scene(other)
    result = sweep(base, {"rolls.gap": GAPS}, replicates=4, client=client)
    lost_only(result, good, (2, 0), "failed", "not finite", "p80", "throughput")
    assert "p50" not in result["message"].values[2, 0]


def test_lost_task_loses_its_batch_only(base, client, good, monkeypatch):
    real = run.run_cases

    def run_cases(runner, cases):
        if (1, 0) in (case.index for case in cases):
            raise SystemError("worker lost")
        return real(runner, cases)

    monkeypatch.setattr(run, "run_cases", run_cases)
    result = sweep(base, {"rolls.gap": GAPS}, replicates=4, client=client)
    lost_only(result, good, (1, 0), "failed", "SystemError", "worker lost")


@pytest.mark.parametrize(("cells", "together"), [(1, 1), (10**6, 3)])
def test_cases_run_at_once_as_far_as_memory_goes(base, client, good, monkeypatch, cells, together):
    real, most = run.run_together, []

    def run_together(points, seed, beds):
        most.append(sum(len(replicates) for _, replicates in points))
        return real(points, seed, beds)

    monkeypatch.setattr(run, "run_together", run_together)
    monkeypatch.setattr(run, "_TOGETHER", cells)
    assert sweep(base, {"rolls.gap": GAPS}, replicates=4, client=client).identical(good)
    assert max(most) == together  # of batches of three


def test_every_case_lost(base, client):
    result = sweep(base, {"rolls.gap": ["1.2 m", "2 m"]}, client=client)
    assert (result["status"] == STATUS["refused"]).all()
    assert not result.data_vars
    assert client.status == "running"  # a given client stays open
    assert client.submit(sum, [1, 2]).result(timeout=30) == 3


def test_a_sweep_leaves_the_process_as_it_was(base, client, tmp_path, monkeypatch):
    """Neither the turns of threads nor the mask of new files is another thread's to change."""
    import os
    import sys

    def refuse(*_):
        raise AssertionError("changes the whole process")

    monkeypatch.setattr(sys, "setswitchinterval", refuse)
    monkeypatch.setattr(os, "umask", refuse)
    sweep(base, {"rolls.gap": [0.05]}, threads=2, folder=tmp_path, record="distributions")


@pytest.mark.parametrize("tolerance", [None, 0.2])
def test_gap_floats_under_a_swept_pressing_force(client, tolerance):
    small = {"resolution.points": 40, "resolution.streamlines": 2, "resolution.cells": 50}
    scene = plain_pilot().with_values(small | {"resolution.record": "product"})
    forces = [2.5e6, 3.5e6, 9e9]
    result = sweep(scene, {"rolls.specific_pressing_force": forces}, 2, client=client, tolerance=tolerance)
    assert result["status"].values.tolist() == [[0, 0], [0, 0], [1, 1]]
    assert "must lie within the reachable" in str(result["message"].values[2, 0])
    for k in (0, 1):
        held = scene.with_values({"rolls.specific_pressing_force": forces[k]})
        alone = hpgr.simulate(held, tolerance=tolerance)
        for name in ("operating_gap", "specific_pressing_force", "throughput", "power", "p80_total"):
            assert np.array_equal(result[name].values[k, 0], alone[name].values), name
        assert result["specific_pressing_force"].values[k] == pytest.approx(forces[k], rel=1e-5)
