"""Sweeps that are killed, damaged, shared, extended or starved of disk, and go on: same data every time."""

import contextlib
import os
import re
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from support import one_by_one, paper, sized

from hpgr.results.schema import STATUS
from studies.sweep import cases, netcdf, run, sweep
from studies.sweep.space import Space, SweepSpec, axes_of

SMALL = {"resolution.streamlines": 2, "resolution.points": 20, "resolution.cells": 16}
GAPS = [0.04, 0.05, 0.06]


@pytest.fixture(scope="module")
def base():
    return paper(SMALL)


@pytest.fixture
def counted(monkeypatch):
    """Gap and replicate of every case that is computed."""
    real, seen = run.run_scene, []

    def run_scene(scene, seed, replicate, beds):
        seen.append((scene.rolls.gap, replicate))
        return real(scene, seed, replicate, beds)

    monkeypatch.setattr(run, "run_together", one_by_one(run_scene))
    return seen


def test_extending_and_reordering_compute_what_is_new_only(base, client, tmp_path, counted):
    old = sweep(base, {"rolls.gap": GAPS}, 2, client=client, folder=tmp_path)
    counted.clear()
    axes = {"feed.top_size": [0.06, 0.05], "rolls.gap": [0.055, *GAPS[::-1]]}
    new = sweep(base, axes, 3, client=client, folder=tmp_path)
    assert len(counted) == 2 * 4 * 3 - 6  # the base's own top size is 60 mm
    part = new.isel(feed_top_size=0, gap=[3, 2, 1], replicate=[0, 1])
    for name in old.variables:
        assert np.array_equal(part[name].values, old[name].values, equal_nan=old[name].dtype.kind == "f"), name
    counted.clear()
    xr.testing.assert_identical(sweep(base, axes, 3, client=client, folder=tmp_path), new)
    assert counted == []


def test_another_seed_scene_tolerance_or_code_is_another_case(base, client, tmp_path, counted, monkeypatch):
    first = sweep(base, {"rolls.gap": [0.05]}, client=client, folder=tmp_path)
    other = base.with_values({"rolls.speed": 3})
    for scene, options in [(base, {"seed": 1}), (other, {}), (base, {"tolerance": 0.3}), (base, {"recompute": True})]:
        counted.clear()
        again = sweep(scene, {"rolls.gap": [0.05]}, client=client, folder=tmp_path, **options)
        assert counted
    xr.testing.assert_identical(again, first)
    for module in (cases, run):
        monkeypatch.setattr(module, "code_version", lambda: "edited")
    counted.clear()
    sweep(base, {"rolls.gap": [0.05]}, client=client, folder=tmp_path)
    assert len(counted) == 1


def test_worker_with_other_code_is_refused(base, client, monkeypatch):
    monkeypatch.setattr(run, "code_version", lambda: "other")
    with pytest.raises(run.OtherCode, match="install the same"):
        sweep(base, {"rolls.gap": [0.05]}, client=client)


def test_lost_cases_are_tried_again(base, client, tmp_path, monkeypatch):
    real = run.run_scene

    def run_scene(scene, *rest):
        if scene.rolls.gap == 0.05:
            raise RuntimeError("boom")
        return real(scene, *rest)

    with monkeypatch.context() as patch:
        patch.setattr(run, "run_together", one_by_one(run_scene))
        first = sweep(base, {"rolls.gap": [*GAPS, 1.2]}, client=client, folder=tmp_path)
    assert first["status"].values[:, 0].tolist() == [0, STATUS["failed"], 0, STATUS["refused"]]
    second = sweep(base, {"rolls.gap": [*GAPS, 1.2]}, client=client, folder=tmp_path)
    assert second["status"].values[:, 0].tolist() == [0, 0, 0, STATUS["refused"]]
    xr.testing.assert_identical(second, sweep(base, {"rolls.gap": [*GAPS, 1.2]}, client=client))


def test_full_disk_ends_the_sweep_and_keeps_what_is_there(base, client, tmp_path, monkeypatch):
    sweep(base, {"rolls.gap": [0.04]}, client=client, folder=tmp_path)
    before = {path: path.read_bytes() for path in tmp_path.glob("*.seg")}

    def full(path, write):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(netcdf, "replace", full)
        with pytest.raises(OSError, match=r"could not keep finished cases in .*No space left"):
            sweep(base, {"rolls.gap": GAPS}, client=client, folder=tmp_path)
    assert {path: path.read_bytes() for path in tmp_path.glob("*.seg")} == before
    assert client.submit(sum, [1]).result(timeout=30) == 1  # the client goes on


@pytest.mark.parametrize("record", ["product", pytest.param("distributions", marks=pytest.mark.slow)])
def test_damage_anywhere_is_noticed_and_computed_again(base, client, tmp_path, capsys, counted, record, monkeypatch):
    """A byte flipped, and the file cut, at many places of every file."""
    monkeypatch.setattr(cases, "_FLUSH_SECONDS", 0.0)  # a segment of each case
    options = {"replicates": 1, "client": client, "folder": tmp_path, "record": record}
    good = sweep(base, {"rolls.gap": GAPS[:2]}, **options)
    whole = {path: path.read_bytes() for path in tmp_path.iterdir() if path.suffix in (".seg", ".nc")}
    assert len(whole) == (2 if record == "product" else 4)
    source = np.random.default_rng(0)

    def damaged(content):
        for place in source.integers(0, len(content), sized(12, 3)):
            broken = bytearray(content)
            broken[place] ^= 1 << int(source.integers(0, 8))
            yield bytes(broken)
        for size in (0, 1, len(content) // 2, len(content) - 1):
            yield content[:size]

    for path, content in whole.items():
        for broken in damaged(content):
            for other in tmp_path.iterdir():
                if other.suffix != "" and other not in whole:
                    other.unlink()
            for other, bytes_of in whole.items():
                other.write_bytes(bytes_of)
            path.write_bytes(broken)
            counted.clear()
            capsys.readouterr()
            again = sweep(base, {"rolls.gap": GAPS[:2]}, **options)
            xr.testing.assert_identical(again, good)
            assert len(counted) == 1  # the other case is read back
            if broken:
                assert str(path) in capsys.readouterr().err
            counted.clear()
            xr.testing.assert_identical(sweep(base, {"rolls.gap": GAPS[:2]}, **options), good)
            assert counted == []  # mended


def test_a_file_that_only_exists_counts_for_nothing(base, client, tmp_path, counted, capsys):
    options = {"client": client, "folder": tmp_path, "record": "distributions"}
    sweep(base, {"rolls.gap": GAPS[:2]}, **options)
    one, other = sorted(tmp_path.glob("*.nc"))
    one.write_bytes(other.read_bytes())  # a good file, of another case
    counted.clear()
    sweep(base, {"rolls.gap": GAPS[:2]}, **options)
    assert len(counted) == 1
    assert f"{one}: missing, damaged or cut short" in capsys.readouterr().err
    other.unlink()
    counted.clear()
    sweep(base, {"rolls.gap": GAPS[:2]}, **options)
    assert len(counted) == 1


def test_driver_that_waits_says_for_whom_and_takes_over_from_the_silent(base, client, tmp_path, monkeypatch):
    """Another driver is stopped while it holds a case: it keeps its lock, and gives no sign of life."""
    told = []

    def say(text):
        told.append(text)
        monkeypatch.setattr(cases, "_SILENT_SECONDS", -1.0)  # the other has been silent for too long from now on

    monkeypatch.setattr(run, "say", say)
    monkeypatch.setattr(run, "_PATIENCE", 0.0)
    monkeypatch.setattr(cases, "_SILENT_SECONDS", np.inf)
    case = Space(axes_of({"rolls.gap": GAPS})).case(1)
    spec = SweepSpec(base.with_values({"resolution.record": "product"}))
    with cases.CaseFolder(tmp_path) as stopped:
        assert stopped.claim(cases.Addresses(spec).of(case.values, case.replicate))
        found = sweep(base, {"rolls.gap": GAPS}, client=client, folder=tmp_path)
    words = rf"waiting for 1 cases that other drivers hold: process {os.getpid()} on .*, last sign of life \d+ s ago"
    assert re.fullmatch(words, told[0])
    xr.testing.assert_identical(found, sweep(base, {"rolls.gap": GAPS}, client=client))


@pytest.mark.slow
def test_interrupt_ends_in_one_line_and_the_same_command_goes_on(tmp_path):
    options = ["--gap", "40 mm", "60 mm", "--replicates", "40000", "--no-plot"]
    command = [sys.executable, "-m", "studies.gap_sweep", *options]
    heard = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)  # what is started in the background may ignore it
    with subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True, preexec_fn=heard) as driver:
        while not list(tmp_path.rglob("*.seg")):
            assert driver.poll() is None
            time.sleep(0.05)
        told, tries = None, 0
        while told is None:  # one that falls into a callback of the garbage collector is lost: a user tries again
            driver.send_signal(signal.SIGINT)
            tries += 1
            with contextlib.suppress(subprocess.TimeoutExpired):
                told = driver.communicate(timeout=20)[1]
    assert driver.returncode == 130, told
    said = [line for line in told.splitlines() if line.strip() and "cases" not in line.split("; ")[0]]
    assert said[-1] == "interrupted; a sweep's finished cases are kept, and the same command goes on from there"
    assert len(said) == 1 or tries > 1  # a lost one is told by Python
    assert list(tmp_path.rglob("*.seg"))
    assert not list(tmp_path.rglob(".hpgr-*"))


# ---- cases that misbehave, in processes of their own


PATCHED = """
import os, time
import hpgr.run

real = hpgr.run.run_together

def run_together(points, seed, beds=None):
    [[result]] = real(points, seed, beds)
    [[scene, replicates]] = points
    if replicates == [1]:
        if scene.rolls.gap == 0.04: time.sleep(3600)
        if scene.rolls.gap == 0.045: os._exit(3)
        if scene.rolls.gap == 0.05: raise RuntimeError("boom")
        if scene.rolls.gap == 0.055: result.values["p80_total"] = float("nan")
        if scene.rolls.gap == 0.058: os.kill(os.getpid(), 11)
    return [[result]]

hpgr.run.run_together = run_together
"""


@pytest.fixture
def patched(tmp_path, monkeypatch):
    """Have processes that start from here on run cases that misbehave."""

    def write(text):
        (tmp_path / "patch").mkdir()
        (tmp_path / "patch" / "sitecustomize.py").write_text(text)
        monkeypatch.syspath_prepend(str(tmp_path / "patch"))
        monkeypatch.setenv("PYTHONPATH", os.pathsep.join(sys.path))
        monkeypatch.setenv("PYTHONWARNINGS", "ignore")

    return write


@pytest.mark.slow
def test_case_that_hangs_dies_raises_or_is_not_finite_loses_itself_only(base, client, tmp_path, patched):
    gaps = [0.04, 0.045, 0.05, 0.055, 0.058, 0.06]
    good = sweep(base, {"rolls.gap": gaps}, replicates=3, client=client)
    patched(PATCHED)
    result = sweep(base, {"rolls.gap": gaps}, 3, client=client, folder=tmp_path / "kept", timeout=sized(8.0, 16.0))
    wanted = np.zeros((6, 3), int)
    wanted[:5, 1] = [STATUS[name] for name in ("timeout", "worker_lost", "failed", "failed", "worker_lost")]
    assert result["status"].values.tolist() == wanted.tolist()
    words = ["longer than the timeout of", "exit code 3", "RuntimeError: boom", "not finite: p80_total", "by signal 11"]
    for place, word in enumerate(words):
        assert word in result["message"].values[place, 1]
    well = wanted == 0
    for name in good.data_vars:
        assert np.array_equal(result[name].values[well], good[name].values[well]), name
    # without the patch the five that were lost are computed, and no other
    (tmp_path / "patch" / "sitecustomize.py").write_text("")
    counts = tmp_path / "kept"
    held = {found.address for found in cases.read_folder(counts, lambda _: True)}
    assert len(held) == 18 - 5
    xr.testing.assert_identical(sweep(base, {"rolls.gap": gaps}, 3, client=client, folder=counts, timeout=60.0), good)
    assert len({found.address for found in cases.read_folder(counts, lambda _: True)}) == 18


# ---- drivers that are killed, and drivers side by side


def digest(result):
    """Return a checksum of every value of a result."""
    import hashlib

    found = hashlib.blake2b()
    for name in sorted(result.variables):
        values = result[name].values
        content = repr(values.tolist()).encode() if values.dtype == object else values.tobytes()
        found.update(f"{name} {values.dtype} {values.shape}".encode() + content)
    return found.hexdigest()


_KILLED = """
import os, random, signal, sys, time
sys.path[:0] = [{tests!r}]
import distributed, netCDF4, xarray  # warm, so that a driver forked from here starts at once
from support import paper
from test_resume import AXES_KILLED, digest
from studies.sweep import cases, sweep

kills, record, folder = int(sys.argv[1]), sys.argv[2], sys.argv[3]
base = paper({small!r})
from hpgr import simulate
simulate(base)
cases._FLUSH_SECONDS = 0.02
os.fsync = lambda file: None  # what a killed process wrote is in the kernel's hands; the disk would set the pace
kept, done, source = 0, 0, random.Random(1)

def drive(to):
    process = os.fork()
    if process:
        return process
    try:
        # a case recorded whole is a file of its own, and takes longer
        result = sweep(base, AXES_KILLED, 4 if record == "product" else 1, seed=2, folder=to, record=record)
        with open(to + ".part", "w") as file:
            file.write(digest(result))
        os.replace(to + ".part", to + ".digest")  # whole, or not there
    finally:
        os._exit(0)

start = time.monotonic()
os.waitpid(drive(folder + "/undisturbed"), 0)
length = time.monotonic() - start
wanted = open(folder + "/undisturbed.digest").read()
number = killed = 0
while killed < kills:
    to = f"{{folder}}/{{number}}"
    process = drive(to)
    time.sleep(source.uniform(0, length))
    os.kill(process, signal.SIGKILL)
    os.waitpid(process, 0)
    killed += 1
    if os.path.exists(to + ".digest"):  # it was quicker, in one go or after resuming: judge it and begin another
        number += 1
for k in range(number + 1):
    to = f"{{folder}}/{{k}}"
    if not os.path.exists(to + ".digest"):
        os.waitpid(drive(to), 0)
    found = open(to + ".digest").read()
    assert found == wanted, (k, found, wanted)
print(killed, number, round(length, 2))
"""
AXES_KILLED = {"rolls.gap": [0.04, 0.045, 0.05, 0.055, 0.06], "feed.top_size": [0.05, 0.055, 0.06]}


@pytest.mark.slow
@pytest.mark.parametrize("record", ["product", "distributions"])
def test_driver_killed_at_random_moments(tmp_path, record):
    """SIGKILL, again and again; HPGR_KILLS sets how often (default 12 for each kind of record)."""
    kills = os.environ.get("HPGR_KILLS", str(sized(12, 3)))
    script = _KILLED.format(tests=str(Path(__file__).parent), small=SMALL)
    command = [sys.executable, "-W", "ignore", "-c", script, kills, record, str(tmp_path)]
    env = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(command, capture_output=True, text=True, timeout=3000, env=env)
    assert done.returncode == 0, done.stderr[-3000:]
    assert done.stdout.split()[0] == kills
    print(done.stdout)


_LOGGED = """
import os, time
import hpgr.run

real = hpgr.run.run_together
log = os.open(os.environ["HPGR_LOG"], os.O_WRONLY | os.O_APPEND | os.O_CREAT)

def run_together(points, seed, beds=None):
    for scene, replicate in [(scene, one) for scene, replicates in points for one in replicates]:
        case = f"{scene.rolls.gap} {scene.feed.top_size} {replicate}"
        os.write(log, f"{os.getpid()} {case} {time.monotonic_ns()}\\n".encode())
        time.sleep(0.05)
    while len({line.split()[0] for line in open(os.environ["HPGR_LOG"])}) < 2:  # until the other is at work too
        time.sleep(0.02)
    return real(points, seed, beds)

hpgr.run.run_together = run_together
"""
_DRIVER = """
import sys
sys.path[:0] = [{tests!r}]
from support import paper
from test_resume import AXES_KILLED, digest
from studies.sweep import sweep
print(digest(sweep(paper({small!r}), AXES_KILLED, replicates=4, seed=2, folder=sys.argv[1])))
"""


@pytest.mark.slow
@pytest.mark.parametrize("kill", [False, True])
def test_two_drivers_on_one_folder(base, client, tmp_path, patched, monkeypatch, kill):
    patched(_LOGGED)
    log, folder = tmp_path / "log", tmp_path / "kept"
    monkeypatch.setenv("HPGR_LOG", str(log))
    script = _DRIVER.format(tests=str(Path(__file__).parent), small=SMALL)
    command = [sys.executable, "-c", script, str(folder)]
    with contextlib.ExitStack() as stack:
        drivers = [
            stack.enter_context(subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True))
            for _ in range(2)
        ]
        stack.callback(lambda: [driver.kill() for driver in drivers])
        if kill:
            deadline = time.monotonic() + 120
            while not (log.exists() and len({line.split()[0] for line in log.read_text().splitlines()}) == 2):
                assert time.monotonic() < deadline
                time.sleep(0.02)
            time.sleep(0.3)
            drivers[0].send_signal(signal.SIGKILL)
            killed = time.monotonic_ns()
        told = [driver.communicate(timeout=200) for driver in drivers]
    wanted = digest(sweep(base, AXES_KILLED, replicates=4, seed=2, client=client))
    for driver, (out, err) in list(zip(drivers, told, strict=True))[kill:]:
        assert driver.returncode == 0, err[-3000:]
        assert out.strip() == wanted
    runs = {}
    for line in log.read_text().splitlines():
        process, *case, moment = line.split()
        runs.setdefault(tuple(case), []).append((int(process), int(moment)))
    assert len(runs) == 60
    assert {process for run in runs.values() for process, _ in run} == {driver.pid for driver in drivers}
    twice = [run for run in runs.values() if len(run) > 1]
    if not kill:
        assert not twice
    for runs in twice:  # what the killed driver had begun, begun again by the other when it was dead
        assert [process for process, _ in runs] == [drivers[0].pid, drivers[1].pid]
        assert runs[1][1] > killed
