"""The one writer and the one checked door: damage is noticed, and no hostile file reads, runs or fills anything."""

import errno
import json
import os
import subprocess
import sys
import zlib

import h5py
import netCDF4
import numpy as np
import pytest
import xarray as xr
from support import paper

from hpgr.results.metrics import scene_of
from hpgr.results.schema import STATUS
from studies.sweep import netcdf, sweep
from studies.sweep.netcdf import open_result, read_variable, replace, shapes_in, write_dataset


@pytest.fixture(scope="module")
def result(client):
    """Two axes, one of text, with refused cases among the good ones."""
    base = paper({"resolution.points": 40})
    axes = {"elasticity.integrator": ["increment", "euler"], "rolls.gap": [0.05, 1.2, 0.04]}
    return sweep(base, axes, replicates=2, seed=1, client=client)


@pytest.fixture
def path(result, tmp_path):
    write_dataset(result, tmp_path / "result.nc")
    return tmp_path / "result.nc"


# ---- what is written


def test_file_equals_memory(result, path):
    with xr.open_dataset(path) as opened:  # plain, and every warning is an error here
        opened.load()
    xr.testing.assert_identical(opened, result)
    for name, variable in result.variables.items():
        if variable.dtype.kind in "fiu":
            assert opened[name].dtype == variable.dtype
    with open_result(path) as checked:
        xr.testing.assert_identical(checked.load(), result)
    assert checked["status"].values[:, :, 0].tolist() == [[0, STATUS["refused"], 0]] * 2
    assert "entry gap" in checked["message"].values[1, 1, 1]
    assert scene_of(checked) == paper({"resolution.points": 40, "resolution.record": "product"})


def test_numbers_are_packed_and_checksummed(path):
    with netCDF4.Dataset(path) as file:
        assert file.data_model == "NETCDF4"
        for name, variable in file.variables.items():
            if variable.dtype is str or not variable.ndim:
                continue
            filters = variable.filters()
            assert filters["zlib"], name
            assert filters["shuffle"], name
            assert filters["fletcher32"], name
            assert "_FillValue" not in variable.ncattrs(), name
            if variable.dtype == np.float64:
                assert name in ("gap", "xi", "sieve")  # coordinates alone keep their double precision


def test_doubles_become_floats_but_coordinates_stay(tmp_path):
    values = np.linspace(0, 1, 6).reshape(2, 3)
    write_dataset(xr.Dataset({"a": (("x", "y"), values)}, {"x": [0.1, 0.2]}), tmp_path / "a.nc")
    with open_result(tmp_path / "a.nc") as opened:
        assert opened["a"].dtype == np.float32
        assert np.array_equal(opened["a"], values.astype(np.float32))
        assert opened["x"].values.tolist() == [0.1, 0.2]


def test_attributes_follow_cf(path):
    with netCDF4.Dataset(path) as file:
        assert file.Conventions == "CF-1.11"
        assert {"title", "source", "scene", "seed", "replicates", "versions", "axes"} <= set(file.ncattrs())
        assert {"gap", "replicate", "xi", "sieve", "roll_speed", "feed_top_size"} <= set(file.variables)
        for name, variable in file.variables.items():
            assert variable.long_name, name
            assert variable.dtype is str or variable.units, name
        flags, status = file["flags"], file["status"]
        assert flags.flag_masks.dtype == flags.dtype  # CF 3.5: of the variable's own type
        assert len(flags.flag_meanings.split()) == flags.flag_masks.size
        assert status.flag_values.dtype == status.dtype
        assert dict(zip(status.flag_meanings.split(), status.flag_values.tolist(), strict=True)) == STATUS


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
            write_dataset(result.isel(gap=[0]), path)
    assert path.read_bytes() == before
    assert [entry.name for entry in path.parent.iterdir()] == ["result.nc"]


def test_interrupt_leaves_nothing_behind(tmp_path):
    def interrupted(part):
        part.write_bytes(b"half")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        replace(tmp_path / "a.png", interrupted)
    assert not list(tmp_path.iterdir())


def test_file_is_synced_before_it_takes_its_name_in_folders_that_are_made(tmp_path, monkeypatch):
    order = []
    real_sync, real_replace = os.fsync, os.replace
    monkeypatch.setattr(os, "fsync", lambda handle: (order.append("sync"), real_sync(handle)))
    monkeypatch.setattr(os, "replace", lambda *names: (order.append("rename"), real_replace(*names)))
    path = tmp_path / "new" / "deep" / "a.txt"
    replace(path, lambda part: part.write_text("whole"))
    assert order == ["sync", "rename", "sync"]  # the file, then its name, then the folder that holds the name
    assert path.read_text() == "whole"


def test_file_has_the_mode_that_the_mask_leaves(tmp_path):
    script = "import os, pathlib; os.umask(0o027); from studies.sweep.netcdf import replace; "
    script += "replace(pathlib.Path('a.txt'), lambda part: part.write_text('x'))"
    subprocess.run([sys.executable, "-c", script], cwd=tmp_path, check=True)
    assert (tmp_path / "a.txt").stat().st_mode & 0o777 == 0o640


def test_full_disk_is_told_in_its_own_words(result, path, monkeypatch):
    """All that the NetCDF library says of it is "NetCDF: HDF error"."""
    real = type(path).open

    def opened(self, mode="r", **options):
        return full() if mode == "ab" else real(self, mode, **options)

    def broken(self, path, **_):
        raise RuntimeError("NetCDF: HDF error")

    monkeypatch.setattr(xr.Dataset, "to_netcdf", broken)
    with pytest.raises(OSError, match="HDF error"):  # the disk is not full: it is something else
        write_dataset(result, path)
    monkeypatch.setattr(type(path), "open", opened)
    with pytest.raises(OSError, match="No space left on device"):
        write_dataset(result, path)


_FULL_DISK = """
import resource, sys
import hpgr
from studies.gap_sweep import main
small = {"resolution.cells": 10, "resolution.points": 10, "resolution.record": "product"}
hpgr.simulate(hpgr.presets.paper().with_values(small))  # the compiler writes its cache before the disk is full
resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))  # a write beyond fails, as on a full disk
sys.exit(main(sys.argv[1:]))
"""


@pytest.mark.slow
def test_disk_that_fills_up(tmp_path):
    options = ["--gap", "40 mm", "--out", "new.nc", "--no-plot", "--cells", "60", "--points", "40"]
    done = subprocess.run(
        [sys.executable, "-c", _FULL_DISK, *options], cwd=tmp_path, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 2, done.stderr
    assert "could not write the result: [Errno 27] File too large" in done.stderr
    assert "Traceback" not in done.stderr
    assert [entry.name for entry in tmp_path.iterdir()] == ["new.cases"]


# ---- damage


def test_every_flipped_byte_is_noticed_or_harmless(result, path):
    """Numbers, texts, attributes and layout: the checksum is of every byte; where it is lost, so is what it covers."""
    content = path.read_bytes()
    seal = len(content) - len(netcdf._SEAL) - netcdf._DIGEST
    places = np.random.default_rng(0).integers(0, len(content), 200)
    for place in [*places.tolist(), content.index(b"entry gap"), seal - 1, len(content) - 1]:
        broken = bytearray(content)
        broken[place] ^= 1
        path.write_bytes(broken)
        if seal <= place < seal + len(netcdf._SEAL):  # no checksum is told of any more, and nothing else is changed
            with open_result(path) as opened:
                xr.testing.assert_identical(opened.load(), result)
        else:
            with pytest.raises((OSError, ValueError)):
                open_result(path)
    for size in (0, 3, 1000, len(content) - 50):
        path.write_bytes(content[:size])
        with pytest.raises((OSError, ValueError)):
            open_result(path)


# ---- files that are somebody else's


def plain(path):
    write_dataset(xr.Dataset({"a": (("x",), np.arange(4.0, dtype=np.float32))}), path)
    return path


def external_dataset(file, secret):
    file.create_dataset("b", (4,), "u1", external=[(str(secret), 0, 4)])


def virtual_dataset(file, secret):
    layout = h5py.VirtualLayout((4,), "f4")
    layout[:] = h5py.VirtualSource(str(secret.with_name("other.nc")), "a", (4,))
    file.create_virtual_dataset("b", layout)


def linked(item):
    """Return what puts an item of a file, or a link, at another place of it."""

    def make(file, secret):
        file["b"] = item(file, secret)

    return make


def many_groups(file, secret):
    for k in range(50):
        file.create_group(f"b{k}")


def many_attributes(file, secret):
    for k in range(50):
        file["a"].attrs[f"b{k}"] = k


def bomb(file, secret):
    found = file.create_dataset("b", (2**33,), "f4", chunks=(2**20,), compression="gzip")
    found[: 2**20] = 0


def one_text_at_many_places(file, secret):
    kind = h5py.string_dtype()
    file.create_dataset("b", (2**22,), kind, chunks=(2**12,), compression="gzip")
    file["b"][0] = "x" * 1000
    found = file["b"].id.read_direct_chunk((0,))
    raw = zlib.decompress(found[1])
    for k in range(0, 2**22, 2**12):
        file["b"].id.write_direct_chunk((k,), zlib.compress(raw[:16] * 2**12))


HOSTILE = {
    "external dataset": external_dataset,
    "external link": linked(lambda file, secret: h5py.ExternalLink(str(secret.with_name("other.nc")), "/a")),
    "soft link": linked(lambda file, secret: h5py.SoftLink("/a")),
    "virtual dataset": virtual_dataset,
    # which the NetCDF library does not have
    "user filter": lambda file, secret: file.create_dataset("b", (4,), "f4", chunks=(4,), compression="lzf"),
    "nested": lambda file, secret: external_dataset(file.create_group("deep/deeper"), secret),
    "cycle": linked(lambda file, secret: file["/"]),
    "two places": linked(lambda file, secret: file["a"]),
    "depth": lambda file, secret: file.create_group("/".join("b" * 30)),
    "one text at many places": one_text_at_many_places,
    "many groups": many_groups,
    "many attributes": many_attributes,
    "many texts": lambda file, secret: file.attrs.create("b", ["x"] * 200, dtype=h5py.string_dtype()),
    "bomb": bomb,
    "never written": lambda file, secret: file.create_dataset("b", (2**40,), "f4", chunks=(2**20,)),
}


@pytest.mark.parametrize("make", HOSTILE.values(), ids=HOSTILE)
def test_hostile_files_are_refused_unread(tmp_path, make, monkeypatch):
    secret = tmp_path / "secret"
    secret.write_bytes(b"key!")
    plain(tmp_path / "other.nc")
    path = plain(tmp_path / "a.nc")
    with h5py.File(path, "r+") as file:
        make(file, secret)
    monkeypatch.setattr(xr, "open_dataset", None)  # calling it would raise a TypeError
    monkeypatch.setattr(netcdf, "_MOST_ITEMS", 40)
    for read in (open_result, lambda path: read_variable(path, "a"), shapes_in):
        with pytest.raises(ValueError, match="refused unread"):
            read(path)


def classic(dims, values=b""):
    """Return a file of NetCDF-3: one dimension, one variable of float32 along it."""
    name = (1).to_bytes(4, "big") + b"x\0\0\0"
    dimension = (10).to_bytes(4, "big") + (1).to_bytes(4, "big") + name + dims.to_bytes(4, "big")
    variable = (11).to_bytes(4, "big") + (1).to_bytes(4, "big") + (1).to_bytes(4, "big") + b"a\0\0\0"
    variable += (1).to_bytes(4, "big") + bytes(4) + bytes(8) + (5).to_bytes(4, "big")
    size = min(4 * dims, 2**32 - 1).to_bytes(4, "big")
    head = b"CDF\x01" + bytes(4) + dimension + bytes(8) + variable + size
    return head + (len(head) + 4).to_bytes(4, "big") + values


def test_netcdf3_is_read_as_what_it_is(tmp_path):
    path = tmp_path / "a.nc"
    path.write_bytes(classic(3, np.array([1, 2, 3], ">f4").tobytes()))
    assert read_variable(path, "a").tolist() == [1, 2, 3]
    with open_result(path) as opened:
        assert opened["a"].values.tolist() == [1, 2, 3]
    path.write_bytes(classic(2**30 - 1))  # 4 GB in 80 bytes
    with pytest.raises(ValueError, match="would unpack to"):
        read_variable(path, "a")


def test_file_that_begins_like_netcdf3_but_holds_hdf5_is_looked_at_as_hdf5(tmp_path):
    """The library finds HDF5 at byte 512 too."""
    (tmp_path / "secret").write_bytes(b"key!")
    path = tmp_path / "a.nc"
    with h5py.File(path, "w", userblock_size=512) as file:
        external_dataset(file, tmp_path / "secret")
    for start in (b"CDFX", b"CDF\x03", b"CDF\x01"):
        with path.open("r+b") as file:
            file.write(start)
        with pytest.raises(ValueError, match=r"refused unread|has no variable 'b'"):
            read_variable(path, "b")


def test_file_that_changes_between_the_look_and_the_opening_is_refused(tmp_path, monkeypatch):
    path, other = plain(tmp_path / "a.nc"), plain(tmp_path / "b.nc")
    real = netcdf._look

    def look(path):
        found = real(path)
        os.replace(other, path)
        return found

    monkeypatch.setattr(netcdf, "_look", look)
    with pytest.raises(ValueError, match="not what it was a moment ago"):
        open_result(path)


def test_what_is_no_netcdf_is_refused(tmp_path):
    path = tmp_path / "a.nc"
    for content in (b"", b"\x80\x04\x95pickle", zlib.compress(b"x"), b"CDF\x01"):
        path.write_bytes(content)
        with pytest.raises((ValueError, OSError)):
            open_result(path)
    path.unlink()
    os.mkfifo(path)  # whose reader would wait for ever
    with pytest.raises(ValueError, match="is no file"):
        open_result(path)
    for name in ("http://127.0.0.1:9/a.nc", "/dev/zero"):
        with pytest.raises((OSError, ValueError), match=r"No such file|is no file"):
            open_result(name)


@pytest.mark.parametrize(
    "told",
    [
        "[" * 100_000,
        json.dumps({"feed": {"table": "/etc/passwd"}}),
        "[]",
        "{}",
        '{"feed": 3}',
        "not JSON",
        " " * 2_000_000,
        7,
    ],
    ids=range(8),
)
def test_scene_of_a_foreign_file_opens_nothing_and_ends_in_one_refusal(told, monkeypatch):
    import builtins

    monkeypatch.setattr(builtins, "open", None)  # calling it would raise a TypeError
    with pytest.raises(ValueError, match=r"scene|feed\.table"):
        scene_of(xr.Dataset(attrs={"scene": told}))
