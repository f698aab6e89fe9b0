"""Sweeps on real dask clusters on loopback: bits as in one process, also when a worker is killed on the way."""

import contextlib
import gc
import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import psutil
import pytest
import xarray as xr
from support import paper, sized

from hpgr.results.schema import STATUS
from studies.gap_sweep import main
from studies.sweep import run, sweep

pytestmark = pytest.mark.slow

SMALL = {"resolution.streamlines": 2, "resolution.points": 20, "resolution.cells": 16}
AXES = {"rolls.gap": [0.04 + 0.001 * k for k in range(20)]}

# slows every case down, so that a worker can be killed on the way; and one gap kills the process it runs in
PATCH = """
import os, time
import hpgr.run

real = hpgr.run.run_together

def run_together(points, seed, beds=None):
    for scene, replicates in points:
        time.sleep(0.05 * len(replicates))
        if scene.rolls.gap == 0.0405: os._exit(7)
    return real(points, seed, beds)

hpgr.run.run_together = run_together
"""


@pytest.fixture(scope="module")
def base():
    return paper(SMALL)


@contextlib.contextmanager
def process(*arguments, cwd, env):
    with open(cwd / "log", "ab") as log:
        running = subprocess.Popen([sys.executable, "-m", *arguments], cwd=cwd, env=env, stdout=log, stderr=log)
        try:
            yield running
        finally:
            with contextlib.suppress(psutil.NoSuchProcess):
                for child in psutil.Process(running.pid).children(recursive=True):
                    with contextlib.suppress(psutil.NoSuchProcess):
                        child.kill()
            running.kill()
            running.wait()


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    """Client of a scheduler and two workers (the second without a nanny), and the processes of the workers."""
    from distributed import Client

    cwd = tmp_path_factory.mktemp("cluster")
    (cwd / "patch").mkdir()
    (cwd / "patch" / "sitecustomize.py").write_text(PATCH)
    path = os.pathsep.join([str(cwd / "patch"), *sys.path])
    env = os.environ | {"PYTHONPATH": path, "PYTHONWARNINGS": "ignore"}
    file = cwd / "scheduler.json"
    common = ["--host", "127.0.0.1", "--no-dashboard"]
    worker = [*common, "--nthreads", "1", "--local-directory", str(cwd), "--death-timeout", "60"]
    plain = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    with contextlib.ExitStack() as stack:
        asked = f"--port 0 --scheduler-file {file}".split()
        scheduler = stack.enter_context(process("distributed.cli.dask_scheduler", *common, *asked, cwd=cwd, env=plain))
        deadline = time.monotonic() + 120
        address = None
        while address is None:
            assert time.monotonic() < deadline, (cwd / "log").read_text()
            assert scheduler.poll() is None, (cwd / "log").read_text()
            with contextlib.suppress(OSError, ValueError):  # not yet, or half written
                address = json.loads(file.read_text())["address"]
            time.sleep(0.05)
        stack.enter_context(process("distributed.cli.dask_worker", address, *worker, cwd=cwd, env=env))
        second = stack.enter_context(
            process("distributed.cli.dask_worker", address, "--no-nanny", *worker, cwd=cwd, env=env)
        )
        client = stack.enter_context(Client(address, set_as_default=False))
        client.wait_for_workers(2, timeout=120)
        yield client, second, address


def test_case_that_kills_its_worker_is_named(base, cluster):
    """With a timeout cases run in processes of their own: the worker lives on, and only the guilty case is lost."""
    client, *_ = cluster
    axes = {"rolls.gap": [0.04, 0.0405, 0.041]}
    result = sweep(base, axes, replicates=2, client=client, timeout=30.0)
    assert result["status"].values.tolist() == [[0, 0], [STATUS["worker_lost"]] * 2, [0, 0]]
    assert "exit code 7" in result["message"].values[1, 0]
    good = sweep(base, axes, replicates=2)
    for name in good.data_vars:
        assert np.array_equal(result[name].values[[0, 2]], good[name].values[[0, 2]]), name
    assert len(client.nthreads()) == 2


def test_running_scheduler_gives_the_same_bits(cluster, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    command = ["--gap", "40 mm", "1.2 m", "50 mm", "--replicates", "2", "--seed", "5", "--no-plot"]
    command += ["--cells", "60", "--points", "40", "--streamlines", "3"]
    address = cluster[-1]
    assert address.startswith("tcp://127.0.0.1:")
    assert main([*command, "--scheduler", address, "--out", "far.nc"]) == 1  # the 1.2 m gap is refused
    assert main([*command, "--out", "near.nc"]) == 1
    capsys.readouterr()
    with xr.open_dataset("far.nc") as far, xr.open_dataset("near.nc") as near:
        assert far["status"].values.tolist() == [[0, 0], [1, 1], [0, 0]]
        far.attrs["history"] = near.attrs["history"]
        xr.testing.assert_identical(far.load(), near.load())


def test_worker_killed_on_the_way_changes_no_bit(base, cluster, tmp_path):
    client, victim, _ = cluster
    calls = []

    real = run._settle

    def settle(future, batch, again):
        calls.append(len(batch))
        if len(calls) == 3:
            victim.send_signal(signal.SIGKILL)
        return real(future, batch, again)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run, "_settle", settle)
        far = sweep(base, AXES, replicates=sized(4, 2), seed=5, client=client, folder=tmp_path)
    assert victim.wait(60) == -signal.SIGKILL
    near = sweep(base, AXES, replicates=sized(4, 2), seed=5)
    xr.testing.assert_identical(far, near)
    assert (far["status"] == 0).all()
    again = sweep(base, AXES, replicates=sized(4, 2), seed=5, folder=tmp_path)  # read back without the cluster
    xr.testing.assert_identical(again, near)


def test_lost_scheduler_is_told_and_finished_cases_are_kept(base, tmp_path):
    with run.own_client(1) as client:
        real, submit = run._settle, client.submit
        calls, sent = [], []

        def settle(future, batch, again):
            calls.append(batch)
            if len(calls) == 3:
                client.cancel(sent)  # what a client does when its scheduler has gone
            return real(future, batch, again)

        def submit_seen(*arguments, **options):
            sent.append(submit(*arguments, **options))
            return sent[-1]

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(run, "_settle", settle)
            patch.setattr(client, "submit", submit_seen)
            with pytest.raises(ConnectionError, match=r"lost the dask scheduler.*run the same command again"):
                sweep(base, AXES, client=client, folder=tmp_path)
    assert list(tmp_path.glob("*.seg"))


@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")
def test_dask_jobqueue(base, tmp_path, monkeypatch):
    """The path of docs/scaling.md to SLURM, with jobs that are processes of this machine."""
    jobqueue = pytest.importorskip("dask_jobqueue.local", reason="dask-jobqueue is not installed (extra hpc)")
    from distributed import Client

    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(sys.path))
    monkeypatch.setenv("PYTHONWARNINGS", "ignore")
    job = {"cores": 1, "processes": 1, "memory": "2GB", "python": sys.executable}
    loopback = {"worker_extra_args": ["--host", "127.0.0.1"]}
    loopback["scheduler_options"] = {"host": "127.0.0.1", "dashboard_address": "127.0.0.1:0"}
    with (
        jobqueue.LocalCluster(**job, local_directory=str(tmp_path), interface=None, **loopback) as cluster,
        Client(cluster, set_as_default=False) as client,
    ):
        cluster.scale(jobs=2)
        client.wait_for_workers(1, timeout=120)
        far = sweep(base, {"rolls.gap": [0.04, 0.05]}, replicates=2, client=client)
    xr.testing.assert_identical(far, sweep(base, {"rolls.gap": [0.04, 0.05]}, replicates=2))
    gc.collect()  # dask-jobqueue leaves processes and pipes to the collector, which warns of them


def listening():
    """Return addresses on which this process and its children wait for others."""
    processes = (psutil.Process(), *psutil.Process().children(recursive=True))
    found = (one for process in processes for one in process.net_connections("inet"))
    return {one.laddr for one in found if one.status == psutil.CONN_LISTEN}


@pytest.mark.parametrize("timeout", [None, 60.0])
def test_nothing_listens_beyond_loopback(base, monkeypatch, timeout, tmp_path):
    before, seen, real = listening(), set(), run._settle

    def settle(*arguments):
        seen.update(listening() - before)
        return real(*arguments)

    monkeypatch.setattr(run, "_settle", settle)
    sweep(base, {"rolls.gap": [0.04]}, folder=tmp_path, timeout=timeout)
    assert seen  # the dashboards, or the test looks at nothing
    assert {one.ip for one in seen} <= {"127.0.0.1", "::1"}
