"""Cases recorded whole and opened together; files that would have the library read elsewhere."""

import sys
import threading
import time

import dask
import numpy as np
import psutil
import pytest
import xarray as xr
from support import paper, sized

import hpgr
import studies
from hpgr import pipeline
from studies import runner, store
from studies.bench import STATUS
from studies.sweep import sweep

SMALL = {"resolution.streamlines": 2, "resolution.points": 12, "resolution.cells": 16}
AXES = {"rolls.gap": [0.04, 0.05, 1.2, 0.06], "rolls.speed": [2.0, 3.0]}  # a gap of 1.2 m is refused


@pytest.fixture(scope="module")
def base():
    return paper(SMALL)


@pytest.fixture(scope="module")
def client():
    with runner.own_client(1) as own:
        yield own


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
    lost = cases.isel(gap=2)
    assert lost["pressure"].isnull().all()


def test_nothing_is_read_before_it_is_needed_and_a_chunk_is_a_case(folder, monkeypatch):
    read = []
    real = store.read_variable
    monkeypatch.setattr(store, "read_variable", lambda path, name, **k: read.append(name) or real(path, name, **k))
    cases = studies.open_cases(folder)
    assert set(read) <= {"xi", "sieve", "photograph"}  # what the time is called in files
    read.clear()
    for name, variable in cases.data_vars.items():
        if name != "status":
            assert all(size == 1 for dim in ("gap", "roll_speed", "replicate") for size in variable.chunksizes[dim])
    cases["pressure"].isel(gap=0, roll_speed=1, replicate=0).max().compute()
    assert read == ["pressure"]


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
            with store.open_result(some) as opened:
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


def test_cases_need_a_folder(base):
    with pytest.raises(ValueError, match="folder: got None; record='cells'"):
        sweep(base, {}, record="cells")


def test_folder_without_cases_is_refused(base, client, tmp_path):
    with pytest.raises(ValueError, match="holds no cases recorded whole"):
        studies.open_cases(tmp_path)
    sweep(base, {}, client=client, folder=tmp_path)
    with pytest.raises(ValueError, match="holds no cases recorded whole"):
        studies.open_cases(tmp_path)
    (tmp_path / "sweep.json").write_text("{")
    with pytest.raises(ValueError, match="damaged"):
        studies.open_cases(tmp_path)
    (tmp_path / "sweep.json").write_text('{"format": 99}')
    with pytest.raises(ValueError, match="format 99"):
        studies.open_cases(tmp_path)


def test_file_of_another_case_is_refused(base, client, tmp_path):
    sweep(base, {"rolls.gap": [0.04, 0.05]}, client=client, folder=tmp_path, record="distributions")
    one, other = sorted(tmp_path.glob("*.nc"))
    one.write_bytes(other.read_bytes())
    with pytest.raises(ValueError, match="is not the case that its name tells"):
        studies.open_cases(tmp_path)["pressure"].sum().compute()


def test_cases_in_flight_are_few(base, client, tmp_path, monkeypatch):
    """The driver is handed whole cases no faster than it writes them."""
    running, most = set(), [0]
    real_crush = pipeline.crush

    def crush(scene, prepared, seed, replicate):
        running.add((scene.rolls.gap, replicate))
        most[0] = max(most[0], len(running))
        return real_crush(scene, prepared, seed, replicate)

    def write_case(outcome, address, path):
        time.sleep(0.02)
        running.discard((hpgr.Scene.model_validate_json(outcome.attrs["scene"]).rolls.gap, outcome.attrs["replicate"]))

    monkeypatch.setattr(pipeline, "crush", crush)
    monkeypatch.setattr("studies.recorded.write_case", lambda *a: (write_case(*a), a[2].write_bytes(b"x")))
    sweep(base, {"rolls.gap": [0.04, 0.05, 0.06]}, 10, client=client, folder=tmp_path, record="cells")
    assert not running
    assert most[0] <= 4  # 2 for the one thread, one being written, one just begun


# ---- trust


def plain(path):
    store.write_dataset(xr.Dataset({"a": (("x",), np.arange(4.0, dtype=np.float32))}), path)
    return path


def test_own_files_are_opened(tmp_path):
    with store.open_result(plain(tmp_path / "a.nc")) as opened:
        assert opened["a"].values.tolist() == [0, 1, 2, 3]
    assert store.read_variable(tmp_path / "a.nc", "a").tolist() == [0, 1, 2, 3]


def external_dataset(file, secret):
    file.create_dataset("b", (4,), "u1", external=[(str(secret), 0, 4)])


def external_link(file, secret):
    import h5py

    file["b"] = h5py.ExternalLink(str(secret.with_name("other.nc")), "/a")


def soft_link(file, secret):
    import h5py

    file["b"] = h5py.SoftLink("/a")


def virtual_dataset(file, secret):
    import h5py

    layout = h5py.VirtualLayout((4,), "f4")
    layout[:] = h5py.VirtualSource(str(secret.with_name("other.nc")), "a", (4,))
    file.create_virtual_dataset("b", layout)


def user_filter(file, secret):
    file.create_dataset("b", (4,), "f4", chunks=(4,), compression="lzf")  # which the NetCDF library does not have


def below(make):
    def nested(file, secret):
        make(file.create_group("deep/deeper"), secret)

    nested.__name__ = f"nested {make.__name__}"
    return nested


KINDS = [external_dataset, external_link, soft_link, virtual_dataset, user_filter, below(external_dataset)]


@pytest.mark.parametrize("make", KINDS, ids=lambda make: make.__name__)
def test_files_that_reach_elsewhere_are_refused_unread(tmp_path, make, monkeypatch):
    import h5py

    secret = tmp_path / "secret"
    secret.write_bytes(b"key!")
    plain(tmp_path / "other.nc")
    path = plain(tmp_path / "a.nc")
    with h5py.File(path, "r+") as file:
        make(file, secret)
    monkeypatch.setattr(xr, "open_dataset", None)  # calling it would raise a TypeError
    for read in (store.open_result, lambda path: store.read_variable(path, "a"), store.shapes_in):
        with pytest.raises(ValueError, match="refused unread"):
            read(path)


def test_cases_that_reach_elsewhere_are_refused(base, client, tmp_path):
    import h5py

    sweep(base, {"rolls.gap": [0.04]}, client=client, folder=tmp_path, record="distributions")
    [path] = tmp_path.glob("*.nc")
    (tmp_path / "secret").write_bytes(b"key!")
    with h5py.File(path, "r+") as file:
        external_dataset(file, tmp_path / "secret")
    with pytest.raises(ValueError, match="/b has its values in other files"):
        studies.open_cases(tmp_path)


def test_what_is_no_netcdf_is_refused(tmp_path):
    (tmp_path / "a.nc").write_bytes(b"\x80\x04\x95pickle")
    with pytest.raises(ValueError, match="cannot be read as NetCDF"):
        store.open_result(tmp_path / "a.nc")
    with pytest.raises(OSError, match="No such file"):
        store.open_result("http://127.0.0.1:9/a.nc")


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
    for module in ("cases", "recorded", "store", "isolated"):
        assert "pickle" not in vars(sys.modules[f"studies.{module}"])


@pytest.mark.parametrize("timeout", [None, 60.0])
def test_nothing_listens_beyond_loopback(base, monkeypatch, timeout, tmp_path):
    seen = []
    real = runner.outcomes

    def outcomes(*arguments):
        for outcome in real(*arguments):
            for process in (psutil.Process(), *psutil.Process().children(recursive=True)):
                seen.extend(one for one in process.net_connections("inet") if one.status == psutil.CONN_LISTEN)
            yield outcome

    monkeypatch.setattr(runner, "outcomes", outcomes)
    sweep(base, {"rolls.gap": [0.04]}, folder=tmp_path, timeout=timeout)
    assert seen  # the dashboards, or the test looks at nothing
    assert {one.laddr.ip for one in seen} <= {"127.0.0.1", "::1"}
