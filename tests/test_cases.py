"""Addresses, records and the folder that holds them."""

import errno
import hashlib
import io
import json
import os
import shutil
import time
from pathlib import Path

import numpy as np
import pytest
from support import paper

import hpgr
from studies.sweep import cases, netcdf
from studies.sweep.cases import Addresses, CaseFolder, Damaged, code_version, pack, read_folder, read_packed
from studies.sweep.space import CaseResult, SweepSpec

EVERY = {  # another value of some field of every part of the scene
    "rolls.gap": 0.05,
    "rolls.specific_pressing_force": 3e6,
    "feed.top_size": 0.05,
    "bed.solid_density": 2700.0,
    "flow.exponent": 1.5,
    "elasticity.integrator": "euler",
    "strength.cushioning": np.inf,
    "fragments.exponent": 0.5,
    "exchange": {},
    "roll_width": {},
    "resolution.snapshots": 2,
    "resolution.record": "product",
    "resolution.sieves": (0.001, 0.01),
}


def address(scene, values=None, replicate=0, **spec):
    return Addresses(SweepSpec(scene, **spec)).of(values or {}, replicate)


def test_address_tells_fields_apart_and_is_that_of_the_final_scene():
    """An axis value and the same value in the base scene are the same case."""
    base = paper({"resolution.cells": 0})
    found = {"": address(base)}
    for name, value in EVERY.items():
        found[name] = address(base.with_values({name: value}))
        assert address(base, {name: value}) == found[name], name
    assert len(set(found.values())) == len(EVERY) + 1
    assert all(len(one) == 32 for one in found.values())


def test_address_tells_seed_replicate_tolerance_and_code_apart():
    base = paper()
    found = [
        address(base),
        address(base, replicate=1),
        address(base, seed=1),
        address(base, tolerance=0.01),
        address(base, tolerance=0.02),
        address(base, tolerance=0.01, max_cost=30.0),
        address(base, code="other"),
    ]
    assert len(set(found)) == len(found)
    assert address(base) == address(base, max_cost=30.0)  # which decides nothing without a tolerance
    assert address(base) == address(base, timeout=3.0)
    assert address(base) == address(base.with_values({"remark": "another"}))


@pytest.mark.parametrize("file", ["bed/kernels.py", "data/khd_porphyry_feed.csv"])
def test_code_version_changes_with_the_code_though_the_version_does_not(tmp_path, monkeypatch, file):
    copy = tmp_path / "hpgr"
    shutil.copytree(Path(hpgr.__file__).parent, copy, ignore=shutil.ignore_patterns("__pycache__"))
    own = code_version.__wrapped__()
    monkeypatch.setattr(hpgr, "__file__", str(copy / "__init__.py"))
    assert code_version.__wrapped__() == own
    content = bytearray((copy / file).read_bytes())
    content[len(content) // 2] ^= 1
    (copy / file).write_bytes(content)
    assert code_version.__wrapped__() != own


def test_code_version_changes_with_a_library(monkeypatch):
    real = cases.version
    monkeypatch.setattr(cases, "version", lambda name: "0.0" if name == "numpy" else real(name))
    assert code_version.__wrapped__() != code_version()


ARRAYS = {
    "p80": np.array([1.5, -0.0, np.nan], np.float32),
    "flags": np.array(5, np.int32),
    "sieve": np.linspace(0, 1, 4).reshape(2, 2),
    "none": np.empty((0, 3), np.int8),
}


def test_record_comes_back_bit_for_bit():
    header, arrays = read_packed(io.BytesIO(pack({"a": "ä", "b": [1]}, ARRAYS)))
    assert header == {"a": "ä", "b": [1]}
    assert list(arrays) == list(ARRAYS)
    for name, value in ARRAYS.items():
        assert (arrays[name].dtype, arrays[name].shape) == (value.dtype, value.shape)
        assert arrays[name].tobytes() == value.tobytes()


def test_every_flipped_byte_and_truncation_is_noticed():
    record = pack({"a": 1}, ARRAYS)
    for place in range(len(record)):
        broken = bytearray(record)
        broken[place] ^= 1
        with pytest.raises((Damaged, EOFError)):
            read_packed(io.BytesIO(broken))
        with pytest.raises(EOFError):
            read_packed(io.BytesIO(record[:place]))


@pytest.mark.parametrize(
    "header",
    [b"[]", b"{}", b"[" * 100_000, b'{"arrays": [["a", "O", [1]]]}', b'{"arrays": [["a", "<f8", [99]]]}', b"\xff"],
)
def test_whole_records_that_are_none_of_ours_are_damage(header):
    head = cases._HEAD.pack(cases._MAGIC, len(header), 0, cases._checksum(header, b""))
    with pytest.raises(Damaged):
        read_packed(io.BytesIO(head + cases._CRC.pack(cases.zlib.crc32(head)) + header))


def test_record_that_tells_of_more_bytes_than_there_can_be_is_damage(tmp_path, capsys):
    head = cases._HEAD.pack(cases._MAGIC, 1, 2**62, bytes(16))
    (tmp_path / "huge.seg").write_bytes(head + cases._CRC.pack(cases.zlib.crc32(head)) + b"x")
    assert addresses(tmp_path) == []
    assert "damaged at byte 0" in capsys.readouterr().err


def result(number):
    return CaseResult((number,), "ok", "", {"throughput": np.array(number, np.float32)}, f"note {number}")


A, B, C = (hashlib.blake2b(bytes([k]), digest_size=16).hexdigest() for k in range(3))


def addresses(folder):
    return sorted(found.address for found in read_folder(folder, lambda _: True))


def test_what_is_put_is_found_after_a_flush(tmp_path, monkeypatch):
    monkeypatch.setattr(cases, "_FLUSH_SECONDS", 1e9)
    with CaseFolder(tmp_path / "deep" / "x.cases") as kept:
        kept.put(A, result(1))
        assert addresses(kept.folder) == []
        kept.flush()
        assert addresses(kept.folder) == [A]
        kept.put(B, result(2))
    assert addresses(kept.folder) == sorted([A, B])
    [found] = read_folder(kept.folder, B.__eq__)
    back = cases.result_of(found.header, found.arrays, (7,))
    assert (back.index, back.status, back.diagnostics) == ((7,), "ok", "note 2")
    assert back.summary["throughput"] == 2


def test_what_an_idle_driver_holds_comes_to_disk(tmp_path, monkeypatch):
    """Two drivers that each wait for the other's last cases would otherwise wait for ever."""
    monkeypatch.setattr(cases, "_FLUSH_SECONDS", 1e9)
    with CaseFolder(tmp_path) as one, CaseFolder(tmp_path) as other:
        one.put(A, result(1))
        assert addresses(tmp_path) == []
        monkeypatch.setattr(cases, "_FLUSH_SECONDS", -1.0)
        assert list(one.read(B.__eq__)) == []
        assert [found.address for found in other.read(A.__eq__)] == [A]


def test_newest_record_wins(tmp_path):
    with CaseFolder(tmp_path) as kept:
        for number in (1, 2):
            kept.put(A, result(number))
            kept.flush()
        first = next(iter(read_folder(tmp_path, A.__eq__)))
        assert first.arrays["throughput"] == 2


def test_a_driver_sees_what_another_puts(tmp_path):
    with CaseFolder(tmp_path) as one, CaseFolder(tmp_path) as other:
        assert list(one.read(lambda _: True)) == []
        for number in range(5):
            other.put(f"{number:032x}", result(number))
            other.flush()  # at once after the look: within the same tick of the file system's clock
            assert [found.arrays["throughput"] for found in one.read(lambda _: True)] == [number]
        assert list(one.read(lambda _: True)) == []


def test_a_change_within_a_tick_of_the_file_system_clock_is_seen(tmp_path, monkeypatch):
    with CaseFolder(tmp_path) as one, CaseFolder(tmp_path) as other:
        stamp = tmp_path.stat().st_mtime_ns
        monkeypatch.setattr(cases.time, "time_ns", lambda: stamp + 1_000_000)  # the look comes 1 ms after the change
        assert list(one.read(lambda _: True)) == []
        other.put(A, result(1))
        other.flush()
        os.utime(tmp_path, ns=(stamp, stamp))
        assert [found.address for found in one.read(lambda _: True)] == [A]


def test_claims_exclude_other_drivers_and_vanish_with_them(tmp_path):
    with CaseFolder(tmp_path) as one:
        with CaseFolder(tmp_path) as other:
            assert other.claim(A)
            assert not one.claim(A)
            assert one.claim(B)
            assert not other.claim(B)
            other.release(A)
            assert one.claim(A)
            assert other.claim(C)
            assert not one.claim(C)
        assert one.claim(C)  # the other is gone


def test_claim_is_held_until_the_case_is_on_disk(tmp_path, monkeypatch):
    monkeypatch.setattr(cases, "_FLUSH_SECONDS", 1e9)
    with CaseFolder(tmp_path) as one, CaseFolder(tmp_path) as other:
        assert one.claim(A)
        one.put(A, result(1))
        assert not other.claim(A)
        one.flush()
        assert other.claim(A)
        assert [found.address for found in other.read(A.__eq__)] == [A]


def test_leftovers_of_killed_drivers_are_removed_but_not_those_of_living_ones(tmp_path):
    leftover = tmp_path / netcdf.temporary_name(".seg")
    with CaseFolder(tmp_path):
        leftover.write_bytes(b"half")
        with CaseFolder(tmp_path):
            assert leftover.exists()
    with CaseFolder(tmp_path):
        assert not leftover.exists()


def test_opening_a_folder_takes_nobody_elses_files(tmp_path):
    """Any folder may be given, a home or a clone among them: only our own temporary files are ours to remove."""
    (tmp_path / ".git").mkdir()
    for name in (".env", ".bashrc", ".gitignore", ".hpgr-notes", ".hpgr-0123456789abcdef.d/x", "mine.seg.txt"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("mine")
    (tmp_path / ".hpgr-00000000000000ff.seg").symlink_to(tmp_path / ".env")
    before = sorted(tmp_path.rglob("*"))
    with CaseFolder(tmp_path):
        pass
    assert sorted({*tmp_path.rglob("*")} - {tmp_path / "lock"}) == before
    target = tmp_path / ".git"  # nor is what lies behind a link
    (target / ".hpgr-00000000000000aa.seg").write_text("half")
    (tmp_path / "x.cases").symlink_to(target)
    with CaseFolder(tmp_path / "x.cases"):
        pass
    assert (target / ".hpgr-00000000000000aa.seg").exists()


def test_driver_that_starts_while_another_looks_for_leftovers_waits_for_its_own_lock(tmp_path, monkeypatch):
    """Or a third, finding no lock, would take its temporary files for leftovers."""
    first = CaseFolder(tmp_path)
    first.__exit__()
    looking = os.open(tmp_path / "lock", os.O_RDWR)
    assert cases._lock(looking, cases.fcntl.F_WRLCK, 0)
    done = []
    monkeypatch.setattr(cases.time, "sleep", lambda _: done.append(os.close(looking)))  # while this one waits
    with CaseFolder(tmp_path) as kept:
        assert done
        third = os.open(tmp_path / "lock", os.O_RDWR)
        assert not cases._lock(third, cases.fcntl.F_WRLCK, 0)
        os.close(third)
        assert kept.claim(A)


def test_cases_of_a_driver_that_gives_no_sign_of_life_are_taken_over(tmp_path, monkeypatch):
    """It may be stopped, or dead on another machine whose locks a network keeps."""
    monkeypatch.setattr(cases, "_SIGN_SECONDS", -1)
    with CaseFolder(tmp_path) as stopped, CaseFolder(tmp_path) as other:
        assert stopped.claim(A)
        assert not other.claim(A)
        words = other.others()
        assert f"process {os.getpid()} on " in words
        assert f"at work since {time.strftime('%Y-')}" in words
        assert "last sign of life 0 s ago" in words
        old = time.time() - 2 * cases._SILENT_SECONDS
        os.utime(stopped._sign, (old, old))
        assert list(stopped.read(A.__eq__)) == []  # at work again
        assert not other.claim(A)
        os.utime(stopped._sign, (old, old))
        assert other.claim(A)
        assert other.claim(B)
        stopped.put(A, result(1))  # it was not dead after all
        other.put(A, result(1))
    assert set(addresses(tmp_path)) == {A}  # twice, and the same
    assert not list(tmp_path.glob(".hpgr-*"))


def test_driver_who_leaves_nonsense_is_no_driver(tmp_path):
    with CaseFolder(tmp_path) as kept:
        for number, text in enumerate(["", "{", "[" * 50_000, "3\n", json.dumps({"host": 1})]):
            (tmp_path / f".hpgr-{number:016x}.driver").write_text(text)
        assert kept.others() == "nobody who has left a name"


def test_damaged_segment_is_told_and_set_aside_and_its_intact_records_are_saved(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(cases, "_FLUSH_SECONDS", 1e9)
    with CaseFolder(tmp_path) as kept:
        for number, one in enumerate((A, B, C)):
            kept.put(one, result(number))
    [segment] = tmp_path.glob("*.seg")
    content = bytearray(segment.read_bytes())
    content[-1] ^= 1
    segment.write_bytes(content)
    assert addresses(tmp_path) == sorted([A, B])  # a look alone changes nothing
    assert f"{segment}: damaged at byte" in capsys.readouterr().err
    assert segment.exists()
    with CaseFolder(tmp_path) as kept:
        assert sorted(found.address for found in kept.read(lambda _: True)) == sorted([A, B])
    assert "damaged" in capsys.readouterr().err
    assert not segment.exists()
    assert segment.with_suffix(".damaged").exists()
    assert addresses(tmp_path) == sorted([A, B])
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("name", ["fsync", "replace"])
def test_full_disk_leaves_what_was_there(tmp_path, monkeypatch, name):
    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(cases, "_FLUSH_SECONDS", 1e9)
    kept = CaseFolder(tmp_path)
    kept.put(A, result(1))
    kept.flush()
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    kept.put(B, result(2))
    with monkeypatch.context() as patch:
        patch.setattr(os, name, full)
        with pytest.raises(OSError, match=r"could not keep finished cases in .*: No space left"):
            kept.flush()
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before
    kept.flush()  # there is room again
    assert addresses(tmp_path) == sorted([A, B])
    kept.__exit__()


def test_folder_that_cannot_be_made_is_refused(tmp_path):
    (tmp_path / "file").write_text("not a folder")
    with pytest.raises(OSError, match="could not keep cases in"):
        CaseFolder(tmp_path / "file" / "x.cases")
