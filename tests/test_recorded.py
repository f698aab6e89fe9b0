"""Cases recorded whole and opened together."""

import contextlib
import json
import sys
import threading
import time

import dask
import numpy as np
import pytest
import xarray as xr
from support import one_by_one, paper, sized

import hpgr
import studies
from hpgr.results.schema import STATUS
from studies.sweep import assemble, netcdf, run, sweep

SMALL = {"resolution.streamlines": 2, "resolution.points": 12, "resolution.cells": 16}
AXES = {"rolls.gap": [0.04, 0.05, 1.2, 0.06], "rolls.speed": [2.0, 3.0]}  # a gap of 1.2 m is refused


@pytest.fixture(scope="module")
def base():
    return paper(SMALL)


@pytest.fixture(scope="module", params=["distributions", "cells"])
def record(request):
    return request.param


@pytest.fixture(scope="module")
def folder(base, client, record, tmp_path_factory):
    path = tmp_path_factory.mktemp("kept")
    sweep(base, AXES, replicates=2, seed=3, client=client, folder=path, record=record)
    return path


def alone(base, record, gap, speed, replicate):
    values = {"rolls.gap": gap, "rolls.speed": speed, "resolution.record": record}
    return hpgr.simulate(base.with_values(values), seed=3, replicate=replicate)


def test_every_case_is_what_simulate_gives(base, folder, record):
    cases = studies.open_cases(folder)
    assert cases["status"].values[:, 0, 0].tolist() == [0, 0, STATUS["refused"], 0]
    for gap, speed, replicate in ((0, 1, 0), (3, 0, 1)):
        place = cases.isel(gap=gap, roll_speed=speed, replicate=replicate).load()
        single = alone(base, record, AXES["rolls.gap"][gap], AXES["rolls.speed"][speed], replicate)
        for name in single.data_vars:
            assert np.array_equal(place[name].values, single[name].values), name
            assert place[name].dims == single[name].dims
            assert place[name].attrs.keys() == single[name].attrs.keys()
        for name in single.coords:
            assert np.allclose(place[name].values, single[name].values, rtol=1e-7), name
        for figure in (lambda one: hpgr.percentile_size(one, 70), lambda one: hpgr.passing(one, ["1 mm"], point=3)):
            found = figure(cases).isel(gap=gap, roll_speed=speed, replicate=replicate)
            assert found.values == pytest.approx(figure(single).values, rel=1e-6)
    lost = cases.isel(gap=2)
    assert lost["pressure"].isnull().all()
    assert hpgr.passing(lost, ["1 mm"], point=3).isnull().all()


def test_nothing_is_read_before_it_is_needed_and_a_chunk_is_a_case(folder, monkeypatch):
    read = []
    real = netcdf.read_variable
    monkeypatch.setattr(netcdf, "read_variable", lambda path, name, **k: read.append(name) or real(path, name, **k))
    cases = studies.open_cases(folder)
    assert set(read) <= {"xi", "sieve", "snapshot"}  # what the time is called in files
    read.clear()
    for name, variable in cases.data_vars.items():
        if name != "status":
            assert all(size == 1 for dim in ("gap", "roll_speed", "replicate") for size in variable.chunksizes[dim])
    cases["pressure"].isel(gap=0, roll_speed=1, replicate=0).max().compute()
    assert sorted(read) == ["flags", "pressure"]  # the flags being its coordinate


def test_reductions_over_two_threads(folder, record):
    """What a user does with it, on two threads beside a third that reads through xarray itself."""
    name = {"distributions": "mass_fraction", "cells": "size"}[record]
    cases = studies.open_cases(folder)
    used = [name, "pressure", "solid_fraction"]
    loaded = xr.Dataset({key: (cases[key].dims, cases[key].values) for key in used})
    some = next(folder.glob("*.nc"))
    stop = threading.Event()

    def read_beside():
        while not stop.is_set():
            with netcdf.open_result(some) as opened:
                opened["pressure"].values  # noqa: B018

    beside = threading.Thread(target=read_beside)
    beside.start()
    try:
        with dask.config.set(scheduler="threads", num_workers=2):
            for _ in range(sized(2, 1)):
                mean = cases[name].mean(["replicate", "streamline"]).compute()
                peak = cases["pressure"].max(["point", "streamline"]).compute()
                both = (cases["pressure"] * cases["solid_fraction"]).std("gap").compute()
    finally:
        stop.set()
        beside.join()
    np.testing.assert_allclose(mean, loaded[name].mean(["replicate", "streamline"]), rtol=2e-6)
    assert np.array_equal(peak, loaded["pressure"].max(["point", "streamline"]), equal_nan=True)
    np.testing.assert_allclose(both, (loaded["pressure"] * loaded["solid_fraction"]).std("gap"), rtol=1e-4)


def test_summary_is_that_of_a_sweep_of_products(base, folder, record, client):
    whole = sweep(base, AXES, replicates=2, seed=3, client=client, folder=folder, record=record)
    product = sweep(base, AXES, replicates=2, seed=3, client=client)
    for name in product.data_vars:
        same = product[name].dtype.kind == "f"
        assert np.array_equal(whole[name].values, product[name].values, equal_nan=same), name


def test_variables_of_uneven_shape_are_left_out_and_named(base, client, tmp_path):
    sweep(base, {"resolution.points": [10, 12]}, client=client, folder=tmp_path, record="distributions")
    cases = studies.open_cases(tmp_path)
    assert "pressure" in cases.attrs["left_out"].split(", ")
    assert "pressure" not in cases
    assert cases["p80_total"].notnull().all()


def test_folder_without_cases_is_refused(base, client, tmp_path):
    with pytest.raises(ValueError, match="holds no cases recorded whole"):
        studies.open_cases(tmp_path)
    sweep(base, {}, client=client, folder=tmp_path)
    with pytest.raises(ValueError, match="holds no cases recorded whole"):
        studies.open_cases(tmp_path)


def test_manifest_that_is_damaged_or_somebody_elses_is_refused(base, client, tmp_path):
    sweep(base, {"rolls.gap": [0.04]}, client=client, folder=tmp_path, record="distributions")
    good = (tmp_path / "sweep.json").read_text()
    told = json.loads(good)

    def forged(**values):
        sweep = told["sweep"] | values
        return json.dumps({"format": assemble._FORMAT, "checksum": assemble._checksum(sweep), "sweep": sweep})

    outside = forged(addresses=["../" * 10 + "etc/passwd"])
    for text in ("{", "[" * 200_000, '{"format": 99}', "3", outside, forged(addresses=[3]), forged(addresses=3)):
        (tmp_path / "sweep.json").write_text(text)
        with pytest.raises(ValueError, match=r"damaged .*run the sweep again"):
            studies.open_cases(tmp_path)
    silent = []
    for place in range(0, len(good), 7):
        broken = good[:place] + chr(ord(good[place]) ^ 1) + good[place + 1 :]
        (tmp_path / "sweep.json").write_text(broken)
        with contextlib.suppress(ValueError):
            silent += [] if assemble._manifest(tmp_path / "sweep.json") == told["sweep"] else [place]
    assert not silent


def test_file_of_another_case_is_refused(base, client, tmp_path):
    sweep(base, {"rolls.gap": [0.04, 0.05]}, client=client, folder=tmp_path, record="distributions")
    one, other = sorted(tmp_path.glob("*.nc"))
    one.write_bytes(other.read_bytes())
    with pytest.raises(ValueError, match="is not the case that its name tells"):
        studies.open_cases(tmp_path)["pressure"].sum().compute()


def test_cases_in_flight_are_few(base, client, tmp_path, monkeypatch):
    """The driver is handed whole cases no faster than it writes them."""
    running, most = set(), [0]
    real = run.run_scene

    def run_scene(scene, seed, replicate, beds):
        running.add((scene.rolls.gap, replicate))
        most[0] = max(most[0], len(running))
        return real(scene, seed, replicate, beds)

    def write(dataset, path):
        time.sleep(0.02)
        running.discard((json.loads(dataset.attrs["scene"])["rolls"]["gap"], dataset.attrs["replicate"]))
        path.write_bytes(b"x")

    monkeypatch.setattr(run, "run_together", one_by_one(run_scene))
    monkeypatch.setattr(netcdf, "write_dataset", write)
    sweep(base, {"rolls.gap": [0.04, 0.05, 0.06]}, 10, client=client, folder=tmp_path, record="cells")
    assert not running
    assert most[0] <= 4  # 2 for the one thread, one being written, one just begun


def test_nothing_is_unpickled_from_disk(base, client, tmp_path, monkeypatch):
    """Reading back, opening and dry runs never reach for pickle, nor for what would on their behalf."""
    import pickle

    sweep(base, {"rolls.gap": [0.04]}, client=client, folder=tmp_path, record="distributions")

    def refuse(*_, **__):
        raise AssertionError("unpickled")

    for owner, name in ((pickle, "load"), (pickle, "Unpickler"), (np, "load")):
        monkeypatch.setattr(owner, name, refuse)
    sweep(base, {"rolls.gap": [0.04]}, client=client, folder=tmp_path, record="distributions")
    assert studies.open_cases(tmp_path).sizes["gap"] == 1
    for module in ("cases", "assemble", "netcdf", "isolated"):
        assert "pickle" not in vars(sys.modules[f"studies.sweep.{module}"])
