import errno
import os
import re
import subprocess
import sys

import netCDF4
import numpy as np
import pytest
import xarray as xr
from support import paper

from studies import store
from studies.gap_sweep import main
from studies.sweep import STATUS, sweep

SMALL = ["--cells", "60", "--points", "40", "--streamlines", "3"]


@pytest.fixture(scope="module")
def result():
    """Two axes, one of text, with refused cases among the good ones."""
    base = paper({"resolution.streamlines": 3, "resolution.points": 40, "resolution.cells": 60})
    axes = {"stress.integrator": ["increment", "euler"], "rolls.gap": [0.05, 1.2, 0.04]}
    return sweep(base, axes, replicates=2, seed=1)


@pytest.fixture
def path(result, tmp_path):
    store.write_dataset(result, tmp_path / "result.nc")
    return tmp_path / "result.nc"


def test_file_equals_memory(result, path):
    with xr.open_dataset(path) as opened:  # plain, and every warning is an error here
        opened.load()
    xr.testing.assert_identical(opened, result)
    for name, variable in result.variables.items():
        if variable.dtype.kind in "fiu":
            assert opened[name].dtype == variable.dtype


def test_status_and_messages_survive(result, path):
    with xr.open_dataset(path) as opened:
        assert opened["status"].values[:, :, 0].tolist() == [[0, STATUS["refused"], 0]] * 2
        assert opened["message"].values[0, 0, 0] == ""
        assert "entry gap" in opened["message"].values[1, 1, 1]
        assert opened["p80_total"].isnull().values[:, :, 1].tolist() == [[False, True, False]] * 2


def test_numbers_are_packed_and_checksummed(path):
    with netCDF4.Dataset(path) as file:
        assert file.data_model == "NETCDF4"
        checked = 0
        for name, variable in file.variables.items():
            if variable.dtype is str:
                continue
            filters = variable.filters()
            assert filters["zlib"], name
            assert filters["shuffle"], name
            assert filters["fletcher32"], name
            assert "_FillValue" not in variable.ncattrs(), name
            if name not in ("gap", "replicate", "xi", "sieve", "status", "flags"):
                assert variable.dtype == np.float32, name
                checked += 1
        assert checked > 10


def test_doubles_become_floats_but_coordinates_stay(tmp_path):
    values = np.linspace(0, 1, 6).reshape(2, 3)
    store.write_dataset(xr.Dataset({"a": (("x", "y"), values)}, {"x": [0.1, 0.2]}), tmp_path / "a.nc")
    with xr.open_dataset(tmp_path / "a.nc") as opened:
        assert opened["a"].dtype == np.float32
        assert np.array_equal(opened["a"], values.astype(np.float32))
        assert opened["x"].values.tolist() == [0.1, 0.2]


def test_damage_is_noticed(result, tmp_path):
    noise = np.random.default_rng(0).random((64, 64)).astype(np.float32)
    path = tmp_path / "noise.nc"
    store.write_dataset(xr.Dataset({"noise": (("x", "y"), noise)}), path)
    content = bytearray(path.read_bytes())
    content[-4000] ^= 1  # one bit, near the end of the noise
    path.write_bytes(content)
    with xr.open_dataset(path) as opened, pytest.raises((RuntimeError, OSError)):
        opened.load()


def test_attributes_follow_cf(path):
    with netCDF4.Dataset(path) as file:
        assert file.Conventions == "CF-1.11"
        for name in ("title", "source", "scene", "seed", "replicates", "versions", "axes"):
            assert name in file.ncattrs()
        assert "numpy" in file.versions
        for name, variable in file.variables.items():
            assert variable.long_name, name
            if variable.dtype is not str:
                assert variable.units, name
        for name in ("gap", "replicate", "xi", "sieve"):
            assert name in file.variables
        flags, status = file["flags"], file["status"]
        assert flags.flag_masks.dtype == flags.dtype  # CF 3.5: of the variable's own type
        assert len(flags.flag_meanings.split()) == flags.flag_masks.size
        assert np.array_equal(flags.flag_masks, 2 ** np.arange(flags.flag_masks.size))
        assert status.flag_values.dtype == status.dtype
        assert dict(zip(status.flag_meanings.split(), status.flag_values.tolist(), strict=True)) == STATUS


def test_units_are_units(path):
    import pint

    registry = pint.UnitRegistry()
    with netCDF4.Dataset(path) as file:
        for variable in file.variables.values():
            if variable.dtype is not str:
                # CF writes "kg s-1": a number straight after a unit is its exponent
                words = [re.sub(r"(-?\d+)$", r"^\1", w) if w != "1" else w for w in variable.units.split()]
                registry.parse_units(" * ".join(words) if words != ["1"] else "")


def test_same_command_gives_the_same_data(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    kept = []
    for _ in range(2):
        assert main(["--gap", "40 mm", "60 mm", "--seed", "4", "--no-plot", *SMALL]) == 0
        with xr.open_dataset("outputs/gap_sweep.nc") as opened:
            kept.append(opened.load())
    capsys.readouterr()
    xr.testing.assert_identical(*kept)


def full(*_, **__):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def half_written(self, path, **_):
    path.write_bytes(b"half")
    full()


@pytest.mark.parametrize(
    ("owner", "name", "breaks"),
    [(xr.Dataset, "to_netcdf", half_written), (os, "fsync", full), (os, "replace", full)],
    ids=["write", "sync", "rename"],
)
def test_failed_write_leaves_the_old_file_alone(result, path, monkeypatch, owner, name, breaks):
    before = path.read_bytes()
    with monkeypatch.context() as patch:
        patch.setattr(owner, name, breaks)
        with pytest.raises(OSError, match="No space left"):
            store.write_dataset(result.isel(gap=[0]), path)
    assert path.read_bytes() == before
    assert [entry.name for entry in path.parent.iterdir()] == ["result.nc"]


def test_interrupt_leaves_nothing_behind(tmp_path):
    def interrupted(part):
        part.write_bytes(b"half")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        store.replace(tmp_path / "a.png", interrupted)
    assert not list(tmp_path.iterdir())


def test_file_is_synced_before_it_takes_its_name(tmp_path, monkeypatch):
    order = []
    real_sync, real_replace = os.fsync, os.replace
    monkeypatch.setattr(os, "fsync", lambda handle: (order.append("sync"), real_sync(handle)))
    monkeypatch.setattr(os, "replace", lambda *names: (order.append("rename"), real_replace(*names)))
    store.replace(tmp_path / "a.txt", lambda part: part.write_text("whole"))
    assert order == ["sync", "rename", "sync"]  # the file, then its name, then the folder that holds the name
    assert (tmp_path / "a.txt").read_text() == "whole"


def test_file_is_readable_for_others(path):
    mask = os.umask(0)
    os.umask(mask)
    assert path.stat().st_mode & 0o777 == 0o666 & ~mask


def test_folders_are_made(tmp_path):
    store.replace(tmp_path / "new" / "deep" / "a.txt", lambda part: part.write_text("x"))
    assert (tmp_path / "new" / "deep" / "a.txt").read_text() == "x"


def test_netcdf_error_is_an_os_error(result, path, monkeypatch):
    # the NetCDF library reports a full disk as RuntimeError("NetCDF: HDF error")
    def broken(self, path, **_):
        raise RuntimeError("NetCDF: HDF error")

    monkeypatch.setattr(xr.Dataset, "to_netcdf", broken)
    with pytest.raises(OSError, match="HDF error"):
        store.write_dataset(result, path)


_FULL_DISK = """
import resource, sys
import hpgr
from studies.gap_sweep import main
small = {"resolution.cells": 10, "resolution.points": 10, "resolution.record": "product"}
hpgr.simulate(hpgr.presets.paper().with_values(small))  # the compiler writes its cache before the disk is full
resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))  # a write beyond fails, as on a full disk
sys.exit(main(sys.argv[1:]))
"""


@pytest.mark.skipif(os.name != "posix", reason="file size limits are a matter of POSIX")
def test_disk_that_fills_up(tmp_path):
    (tmp_path / "old.nc").write_bytes(b"old")
    command = [sys.executable, "-c", _FULL_DISK, "--gap", "40 mm", "--out", "old.nc", "--no-plot", *SMALL]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert done.returncode == 2, done.stderr
    assert "could not write" in done.stderr
    assert "Traceback" not in done.stderr
    assert (tmp_path / "old.nc").read_bytes() == b"old"
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["old.cases", "old.nc"]
