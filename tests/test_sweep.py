import contextlib
import json
import os
import subprocess
import sys
import time

import numpy as np
import pytest
import xarray as xr
from support import paper

import hpgr
from hpgr import pipeline, schema
from studies import runner
from studies import sweep as module
from studies.gap_sweep import main
from studies.sweep import STATUS, sweep

SMALL = {"resolution.streamlines": 3, "resolution.points": 40, "resolution.cells": 60}
GAPS = ["40 mm", "50 mm", "60 mm"]


@pytest.fixture(scope="module")
def base():
    return paper(SMALL)


@pytest.fixture(scope="module")
def client():
    from distributed import Client, LocalCluster

    with (
        LocalCluster(
            processes=False, n_workers=1, threads_per_worker=1, memory_limit=0,
            dashboard_address="127.0.0.1:0", worker_dashboard_address="127.0.0.1:0",
        ) as cluster,
        Client(cluster) as own,
    ):  # fmt: skip
        yield own


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
    assert dict(grid["passing"].sizes) == {
        "roll_speed": 2, "feed_top_size": 2, "gap": 2, "replicate": 2, "streamline": 3, "sieve": 61,
    }  # fmt: skip
    assert grid["gap"].values.tolist() == [0.06, 0.04]  # the order given, not sorted
    assert grid["roll_speed"].values == pytest.approx([15 * np.pi / 30, 19 * np.pi / 30], rel=1e-12)
    assert grid["feed_top_size"].values.tolist() == [0.05, 0.06]
    assert grid["replicate"].values.tolist() == [0, 1]
    fields = {
        "gap": ("m", "rolls.gap"),
        "roll_speed": ("rad s-1", "rolls.speed"),
        "feed_top_size": ("m", "feed.top_size"),
    }
    for name, (unit, field) in fields.items():
        assert grid[name].attrs["units"] == unit
        assert grid[name].attrs["scene_field"] == field
        assert grid[name].attrs["long_name"]
    assert (grid["status"] == STATUS["ok"]).all()
    assert hpgr.Scene.model_validate_json(grid.attrs["scene"]) == base.with_values({"resolution.record": "product"})
    assert (grid.attrs["seed"], grid.attrs["replicates"]) == (3, 2)
    assert grid.attrs["axes"] == "rolls.speed, feed.top_size, rolls.gap"


def test_every_place_holds_its_own_case(grid, base):
    for speed in (0, 1):
        for top in (0, 1):
            for gap in (0, 1):
                for replicate in (0, 1):
                    values = {
                        "rolls.speed": grid["roll_speed"].values[speed],
                        "feed.top_size": grid["feed_top_size"].values[top],
                        "rolls.gap": grid["gap"].values[gap],
                        "resolution.record": "product",
                    }
                    alone = hpgr.simulate(base.with_values(values), seed=3, replicate=replicate)
                    place = grid.isel(roll_speed=speed, feed_top_size=top, gap=gap, replicate=replicate)
                    for name in ("throughput", "peak_pressure", "p80_total", "passing", "breaks_per_cell", "flags"):
                        assert np.array_equal(place[name].values, alone[name].values), name


def test_every_summary_of_a_simulation_is_kept(base, client):
    alone = hpgr.simulate(base.with_values({"resolution.record": "product"}))
    result = sweep(base, {"rolls.gap": [0.06]}, client=client)
    kept = {name for name, value in alone.data_vars.items() if not {"point", "cell", "time"} & set(value.dims)}
    assert kept == set(result.data_vars) - {"status", "message", "notes"}
    for name in kept:
        assert result[name].attrs.keys() == alone[name].attrs.keys()
        assert result[name].dtype == alone[name].dtype
    for name in ("xi", "sieve"):
        assert np.array_equal(result[name], alone[name])
        assert result[name].attrs == schema.attributes(name)


def test_replicates_differ_in_the_product_only(grid):
    one, other = grid.isel(replicate=0), grid.isel(replicate=1)
    assert np.array_equal(one["peak_pressure"], other["peak_pressure"])
    assert not (one["p80_total"] == other["p80_total"]).any()


def test_bits_do_not_depend_on_threads_order_or_company(base, client):
    two = sweep(base, {"rolls.gap": GAPS}, replicates=3, seed=7)
    one = sweep(base, {"rolls.gap": GAPS}, replicates=3, seed=7, threads=1)
    same_bits(one, two)
    turned = sweep(base, {"rolls.gap": GAPS[::-1]}, replicates=3, seed=7, client=client)
    same_bits(turned.isel(gap=[2, 1, 0]), two)
    longer = sweep(base, {"rolls.gap": ["35 mm", *GAPS, "70 mm"]}, replicates=4, seed=7, client=client)
    same_bits(longer.isel(gap=[1, 2, 3], replicate=[0, 1, 2]), two)
    wider = sweep(base, {"feed.top_size": [0.05, 0.06], "rolls.gap": GAPS}, replicates=3, seed=7, client=client)
    same_bits(wider.isel(feed_top_size=1).drop_vars("feed_top_size"), two)


def test_seed_decides_the_bits(base, client):
    one, other = (sweep(base, {"rolls.gap": [0.05]}, seed=seed, client=client) for seed in (0, 1))
    assert not np.array_equal(one["passing"], other["passing"])


def test_speed_changes_throughput_and_power_only(base, client):
    speed = 19 * np.pi / 30
    result = sweep(base, {"rolls.speed": [speed, 2 * speed, 4 * speed, 1.37 * speed]}, 2, client=client)
    for name in result.data_vars:
        if name not in ("throughput", "power", "message"):
            first = result[name].isel(roll_speed=0)
            changed = [k for k in range(4) if not np.array_equal(result[name].isel(roll_speed=k), first)]
            assert not changed, name
    for name in ("throughput", "power"):  # in proportion to speed, by energy and mass per roll turn
        flow = result[name].values
        assert np.array_equal(flow[1], 2 * flow[0])  # doubling is exact in binary
        assert np.array_equal(flow[2], 4 * flow[0])
        assert flow[3] == pytest.approx(1.37 * flow[0], rel=2**-23)  # one rounding of float32


def test_other_fields_as_axes(base, client):
    result = sweep(
        base, {"material.cushioning": [0.5, np.inf], "stress.integrator": ["increment", "euler"]}, client=client
    )
    assert result["p80_total"].dims == ("cushioning", "stress_integrator", "replicate")
    assert result["cushioning"].values.tolist() == [0.5, np.inf]
    assert result["stress_integrator"].values.tolist() == ["increment", "euler"]
    assert result["stress_integrator"].dtype.kind == "U"
    assert (result["status"] == 0).all()
    pressure = result["peak_pressure"].isel(replicate=0)
    assert np.array_equal(pressure[0], pressure[1])  # cushioning is no elasticity
    assert (pressure[:, 0] != pressure[:, 1]).all()
    alone = hpgr.simulate(base.with_values({"material.cushioning": np.inf, "resolution.record": "product"}))
    assert result["p80_total"].values[1, 0, 0] == alone["p80_total"]


def test_ragged_variables_are_left_out_and_named(base, client):
    result = sweep(base, {"resolution.streamlines": [2, 3]}, client=client)
    left_out = result.attrs["left_out"].split(", ")
    assert {"passing", "p80", "xi", "streamline_peak_pressure"} <= set(left_out)
    assert not set(left_out) & set(result.variables)
    assert "streamline" not in result.dims
    assert result["p80_total"].notnull().all()
    assert result["passing_total"].notnull().all()
    assert sweep(base, {"rolls.gap": [0.05]}, client=client).attrs["left_out"] == ""


def test_axis_over_cells_with_stress_only(base, client):
    # the stress-only case has no sieves: the coordinate must come from one that has
    result = sweep(base, {"resolution.cells": [0, 60]}, client=client)
    assert (result["status"] == 0).all()
    assert result["p80_total"].isnull().values[:, 0].tolist() == [True, False]
    assert result["peak_pressure"].notnull().all()
    assert np.array_equal(result["sieve"], base.resolution.sieves)


def test_stress_only_sweep(base, client):
    result = sweep(base.with_values({"resolution.cells": 0}), {"rolls.gap": GAPS}, client=client)
    assert "passing" not in result
    assert "sieve" not in result.dims
    assert (np.diff(result["peak_pressure"].values[:, 0]) < 0).all()  # a wider gap presses less


def test_no_axes(base, client):
    result = sweep(base, {}, replicates=2, client=client)
    assert result["p80_total"].dims == ("replicate",)


@pytest.mark.parametrize(
    ("axes", "words"),
    [
        ({"rolls.gap": [0.04, "40 mm"]}, ["rolls.gap", "0.04", "twice", "replicates"]),
        ({"rolls.gap": []}, ["rolls.gap", "no values"]),
        ({"rolls.gaps": [0.04]}, ["rolls.gaps", "did you mean", "rolls.gap"]),
        ({"gap": [0.04]}, ["'gap'", "rolls.gap"]),
        ({"rolls": [0.04]}, ["'rolls'", "did you mean"]),
        ({"rolls.gap": ["40"]}, ["rolls.gap", "without a unit", "40 mm"]),
        ({"rolls.gap": ["40 s"]}, ["rolls.gap", "'40 s'"]),
        ({"rolls.gap": [float("nan")]}, ["rolls.gap", "NaN"]),
        ({"rolls.gap": [float("inf")]}, ["rolls.gap", "inf"]),
        ({"rolls.gap": [-0.04]}, ["rolls.gap", "-40 mm", "at least"]),
        ({"resolution.cells": [10.5]}, ["resolution.cells", "10.5", "whole number"]),
        ({"stress.integrator": ["runge"]}, ["stress.integrator", "'runge'", "'euler'"]),
    ],
)
def test_bad_axes_are_refused_before_anything_runs(base, monkeypatch, axes, words):
    monkeypatch.setattr(module, "_outcomes", None)  # calling it would raise a TypeError
    with pytest.raises(ValueError) as caught:  # noqa: PT011, the words are checked below
        sweep(base, axes)
    for word in words:
        assert word in str(caught.value)


@pytest.mark.parametrize(
    ("field", "values"),
    [("resolution.sieves", [(0.001, 1.0), (0.002, 1.0)]), ("feed.table", [((0.001, 0.0), (0.05, 100.0))])],
)
def test_fields_that_are_lists_are_refused_before_anything_runs(base, monkeypatch, field, values):
    # a coordinate holds one number or text per label
    monkeypatch.setattr(module, "_outcomes", None)
    with pytest.raises(ValueError, match=field):
        sweep(base, {field: values})


def test_replicates_below_one_are_refused(base):
    with pytest.raises(ValueError, match="replicates: got 0"):
        sweep(base, {"rolls.gap": [0.05]}, replicates=0)


@pytest.fixture
def good(base, client):
    return sweep(base, {"rolls.gap": GAPS}, replicates=4, client=client)


def lost_only(result, good, place, status, *words):
    """Assert that one place holds NaN, status and message, and that all others are as in `good`."""
    keep = np.ones(good["status"].shape, bool)
    keep[place] = False
    assert (result["status"].values[place] == STATUS[status]).all()
    for word in words:
        assert all(word in message for message in np.atleast_1d(result["message"].values[place]))
    assert (result["status"].values[keep] == STATUS["ok"]).all()
    assert (result["message"].values[keep] == "").all()
    for name in set(good.data_vars) - {"status", "message", "notes"}:
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
        (ZeroDivisionError("by zero"), "failed", ["ZeroDivisionError", "by zero"]),
        (MemoryError("predicted 9 bytes"), "refused", ["predicted 9 bytes"]),
    ],
)
def test_raising_case_loses_itself_only(base, client, good, monkeypatch, raised, status, words):
    real = pipeline.crush

    def crush(scene, prepared, seed, replicate):
        if scene.rolls.gap == 0.05 and replicate == 2:
            raise raised
        return real(scene, prepared, seed, replicate)

    monkeypatch.setattr(pipeline, "crush", crush)
    # 12 cases on one thread: batches of 3, so the others share a batch with the one that raises
    result = sweep(base, {"rolls.gap": GAPS}, replicates=4, client=client)
    lost_only(result, good, (1, 2), status, *words)


def test_case_that_is_not_finite_loses_itself_only(base, client, good, monkeypatch):
    real = pipeline.crush

    def crush(scene, prepared, seed, replicate):
        found = real(scene, prepared, seed, replicate)
        if scene.rolls.gap == 0.06 and replicate == 0:
            found["p80"][1] = np.nan
            found["throughput"] = found["throughput"] * np.inf
        return found

    monkeypatch.setattr(pipeline, "crush", crush)
    result = sweep(base, {"rolls.gap": GAPS}, replicates=4, client=client)
    lost_only(result, good, (2, 0), "failed", "not finite", "p80", "throughput")
    assert "p50" not in result["message"].values[2, 0]


def test_lost_task_loses_its_batch_only(base, client, monkeypatch):
    good = sweep(base, {"rolls.gap": GAPS}, client=client)
    real = runner.run_case

    def run_case(bench, case):
        if case.index == (1, 0):
            raise SystemError("worker lost")
        return real(bench, case)

    monkeypatch.setattr(runner, "run_case", run_case)
    result = sweep(base, {"rolls.gap": GAPS}, client=client)
    lost_only(result, good, (1, 0), "failed", "SystemError", "worker lost")


def test_every_case_lost(base, client):
    result = sweep(base, {"rolls.gap": ["1.2 m", "2 m"]}, client=client)
    assert (result["status"] == STATUS["refused"]).all()
    assert set(result.data_vars) == {"status", "message", "notes"}


def test_given_client_stays_open(base, client):
    sweep(base, {"rolls.gap": [0.05]}, client=client)
    assert client.status == "running"
    assert client.submit(sum, [1, 2]).result(timeout=30) == 3


def test_default_cluster_listens_on_loopback_only_and_is_closed(base, monkeypatch):
    import distributed

    seen = []

    class Spy(distributed.LocalCluster):
        def __init__(self, **options):
            super().__init__(**options)
            seen.append((self, options))

    monkeypatch.setattr(distributed, "LocalCluster", Spy)
    sweep(base, {"rolls.gap": [0.05]}, threads=1)
    [(cluster, options)] = seen
    assert cluster.status == distributed.Status.closed
    assert options["dashboard_address"] == options["worker_dashboard_address"] == "127.0.0.1:0"
    assert options["threads_per_worker"] == 1
    assert not options["processes"]


@contextlib.contextmanager
def process(*arguments, cwd):
    """Run a python module beside the test, and stop it whatever happens."""
    with open(cwd / f"{arguments[0]}.log", "wb") as log:
        running = subprocess.Popen([sys.executable, "-m", *arguments], cwd=cwd, stdout=log, stderr=log)
        try:
            yield running
        finally:
            running.terminate()
            try:
                running.wait(10)
            except subprocess.TimeoutExpired:
                running.kill()
                running.wait()


def address_in(file, running):
    """Return the address that the scheduler writes into its file when it is up."""
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline and running.poll() is None:
        if file.exists():
            with contextlib.suppress(ValueError):  # half written
                return json.loads(file.read_text())["address"]
        time.sleep(0.05)
    raise AssertionError("the dask scheduler did not start")


def test_running_scheduler_gives_the_same_bits(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(sys.path))  # the worker finds what this process finds
    command = ["--gap", "40 mm", "1.2 m", "50 mm", "--replicates", "2", "--seed", "5", "--no-plot"]
    command += ["--cells", "60", "--points", "40", "--streamlines", "3"]
    file = tmp_path / "scheduler.json"
    common = ["--host", "127.0.0.1", "--no-dashboard"]
    with process(
        "distributed.cli.dask_scheduler", *common, "--port", "0", "--scheduler-file", str(file), cwd=tmp_path
    ) as scheduler:
        address = address_in(file, scheduler)
        assert address.startswith("tcp://127.0.0.1:")
        worker = [*common, "--nthreads", "1", "--no-nanny", "--local-directory", str(tmp_path), "--death-timeout", "60"]
        with process("distributed.cli.dask_worker", address, *worker, cwd=tmp_path):
            assert main([*command, "--scheduler", address, "--out", "far.nc"]) == 1  # the 1.2 m gap is refused
    assert main([*command, "--out", "near.nc"]) == 1
    capsys.readouterr()
    with xr.open_dataset("far.nc") as far, xr.open_dataset("near.nc") as near:
        assert far["status"].values.tolist() == [[0, 0], [1, 1], [0, 0]]
        far.attrs["history"] = near.attrs["history"]
        xr.testing.assert_identical(far.load(), near.load())


def test_unreachable_scheduler_is_refused(tmp_path, monkeypatch, capsys):
    import distributed

    def unreachable(address, timeout):
        raise OSError(f"Timed out trying to connect to {address} after {timeout}")

    monkeypatch.setattr(distributed, "Client", unreachable)
    monkeypatch.chdir(tmp_path)
    assert main(["--cells", "60", "--scheduler", "tcp://127.0.0.1:9"]) == 2
    assert "tcp://127.0.0.1:9" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("tolerance", [None, 0.2])
def test_gap_floats_under_a_swept_pressing_force(client, tolerance):
    small = {"resolution.points": 40, "resolution.streamlines": 2, "resolution.cells": 50}
    scene = hpgr.presets.khd_pilot().with_values(small | {"resolution.record": "product"})
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
