"""Addresses, records and the folder that holds them."""

import errno
import hashlib
import io
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from support import paper

import hpgr
from studies import cases
from studies.bench import Job, Outcome
from studies.cases import Addresses, CaseFolder, Damaged, code_version, pack, read_folder, read_packed

EVERY = {  # another value of every field that the paper's scene has, alone
    "rolls.diameter": 6.5, "rolls.width": 2.0, "rolls.gap": 0.05, "rolls.entry_gap": 1.2, "rolls.speed": 3.0,
    "feed.bottom_size": 0.009, "feed.top_size": 0.05, "material.solid_density": 2700.0, "material.strength": 1e6,
    "material.strength_size": 0.05, "material.weibull_modulus": 3.0, "material.cushioning": np.inf,
    "material.fragment_exponent": 0.5, "material.size_floor": 2e-6, "material.bulk_modulus": 3e7,
    "material.shear_modulus": 1e7, "material.elastic_exponent": 0.6, "material.feed_solid_fraction": 0.55,
    "material.max_solid_fraction": 0.95, "flow.exponent": 1.5, "flow.entry_fraction": 0.03,
    "stress.integrator": "euler", "stress.substeps": 2, "stress.crushing": "major", "resolution.streamlines": 4,
    "resolution.points": 60, "resolution.cells": 65, "resolution.photographs": 2, "resolution.record": "product",
    "resolution.sieves": (0.001, 0.01), "exchange": {}, "resolution.level": "draft",
}  # fmt: skip


def address(scene, values=None, replicate=0, **job):
    return Addresses(Job(scene, **job)).of(values or {}, replicate)


def test_address_tells_every_field_apart():
    base = paper()
    found = [address(base), *(address(base.with_values({name: value})) for name, value in EVERY.items())]
    assert len(set(found)) == len(found)
    assert all(len(one) == 32 for one in found)


@pytest.mark.parametrize("name", EVERY)
def test_address_is_that_of_the_final_scene_however_it_is_reached(name):
    """An axis value and the same value in the base scene are the same case."""
    base, value = paper(), EVERY[name]
    if isinstance(value, int | float | str) or name in ("exchange", "resolution.sieves"):
        assert address(base, {name: value}) == address(base.with_values({name: value}))
        assert address(base, {name: value, "rolls.gap": 0.055}) == address(
            base.with_values({name: value, "rolls.gap": 0.055})
        )


def test_levels_do_not_collide():
    # of a level with another number of points, and of that level on a base with those points, one is custom
    draft, custom = paper().with_values({"resolution.level": "draft"}), paper({"resolution.points": 100})
    assert address(draft, {"resolution.points": 200}) != address(custom, {"resolution.level": "draft"})


def test_address_tells_seed_replicate_tolerance_and_code_apart():
    base = paper()
    found = [
        address(base), address(base, replicate=1), address(base, seed=1), address(base, tolerance=0.01),
        address(base, tolerance=0.02), address(base, tolerance=0.01, max_cost=30.0), address(base, code="other"),
    ]  # fmt: skip
    assert len(set(found)) == len(found)
    assert address(base) == address(base, max_cost=30.0)  # which decides nothing without a tolerance
    assert address(base) == address(base, timeout=3.0)
    assert address(base) == address(base.with_values({"note": "another"}))


def test_address_is_the_same_in_another_process():
    script = "from support import paper; from studies.cases import Addresses; from studies.bench import Job\n"
    script += "print(Addresses(Job(paper())).of({'rolls.gap': 0.05}, 1))"
    path = os.pathsep.join([str(Path(__file__).parent), *sys.path])
    done = subprocess.run(
        [sys.executable, "-c", script], env=os.environ | {"PYTHONPATH": path, "PYTHONHASHSEED": "7"},
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert done.stdout.strip() == address(paper(), {"rolls.gap": 0.05}, 1)


@pytest.mark.parametrize("file", ["kernels.py", "stress.py", "data/khd_porphyry_feed.csv"])
def test_code_version_changes_with_the_code_though_the_version_does_not(tmp_path, monkeypatch, file):
    copy = tmp_path / "hpgr"
    shutil.copytree(Path(hpgr.__file__).parent, copy, ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(hpgr, "__file__", str(copy / "__init__.py"))
    assert code_version.__wrapped__() == code_version()
    content = bytearray((copy / file).read_bytes())
    content[len(content) // 2] ^= 1
    (copy / file).write_bytes(content)
    assert code_version.__wrapped__() != code_version()


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


def test_every_flipped_byte_is_noticed():
    record = pack({"a": 1}, ARRAYS)
    for place in range(len(record)):
        for bit in (1, 128):
            broken = bytearray(record)
            broken[place] ^= bit
            with pytest.raises((Damaged, EOFError)):
                read_packed(io.BytesIO(broken))


def test_every_truncation_is_noticed():
    record = pack({"a": 1}, ARRAYS)
    for size in range(len(record)):
        with pytest.raises(EOFError):
            read_packed(io.BytesIO(record[:size]))


def outcome(number):
    return Outcome((number,), "ok", "", {"throughput": ((), np.array(number, np.float32))}, f"note {number}")


A, B, C = (hashlib.blake2b(bytes([k]), digest_size=16).hexdigest() for k in range(3))


def addresses(folder):
    return sorted(found.address for found in read_folder(folder, lambda _: True))


def test_what_is_put_is_found_after_a_flush(tmp_path, monkeypatch):
    monkeypatch.setattr(cases, "_FLUSH_SECONDS", 1e9)
    with CaseFolder(tmp_path / "deep" / "x.cases") as kept:
        kept.put(A, outcome(1))
        assert addresses(kept.folder) == []
        kept.flush()
        assert addresses(kept.folder) == [A]
        kept.put(B, outcome(2))
    assert addresses(kept.folder) == sorted([A, B])
    [found] = read_folder(kept.folder, B.__eq__)
    back = cases.outcome_of(found.header, found.arrays, (7,))
    assert (back.index, back.status, back.notes) == ((7,), "ok", "note 2")
    assert back.summary["throughput"][1] == 2


def test_newest_record_wins(tmp_path):
    with CaseFolder(tmp_path) as kept:
        for number in (1, 2):
            kept.put(A, outcome(number))
            kept.flush()
        first = next(iter(read_folder(tmp_path, A.__eq__)))
        assert first.arrays["throughput"] == 2


def test_a_driver_sees_what_another_puts(tmp_path):
    with CaseFolder(tmp_path) as one, CaseFolder(tmp_path) as other:
        assert list(one.read(lambda _: True)) == []
        for number in range(5):
            other.put(f"{number:032x}", outcome(number))
            other.flush()  # at once after the look: within the same tick of the file system's clock
            assert [found.arrays["throughput"] for found in one.read(lambda _: True)] == [number]
        assert list(one.read(lambda _: True)) == []


def test_a_change_within_a_tick_of_the_file_system_clock_is_seen(tmp_path, monkeypatch):
    with CaseFolder(tmp_path) as one, CaseFolder(tmp_path) as other:
        stamp = tmp_path.stat().st_mtime_ns
        monkeypatch.setattr(cases.time, "time_ns", lambda: stamp + 1_000_000)  # the look comes 1 ms after the change
        assert list(one.read(lambda _: True)) == []
        other.put(A, outcome(1))
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
        one.put(A, outcome(1))
        assert not other.claim(A)
        one.flush()
        assert other.claim(A)
        assert [found.address for found in other.read(A.__eq__)] == [A]


def test_leftovers_of_killed_drivers_are_removed_but_not_those_of_living_ones(tmp_path):
    with CaseFolder(tmp_path):
        (tmp_path / ".half-written.seg").write_bytes(b"x")
        with CaseFolder(tmp_path):
            assert (tmp_path / ".half-written.seg").exists()
    with CaseFolder(tmp_path):
        assert not (tmp_path / ".half-written.seg").exists()


def test_damaged_segment_is_told_and_set_aside_and_its_intact_records_are_saved(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(cases, "_FLUSH_SECONDS", 1e9)
    with CaseFolder(tmp_path) as kept:
        for number, one in enumerate((A, B, C)):
            kept.put(one, outcome(number))
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
    kept.put(A, outcome(1))
    kept.flush()
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    kept.put(B, outcome(2))
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
