"""Cases in a process of their own, so that one that hangs or dies loses only itself.

The worker's thread sends a case to its child and waits; a child that takes too long is killed, and one that died is
replaced. Down the pipe go lines of JSON, up come packed records (`studies.cases.pack`): nothing is unpickled.
"""

import contextlib
import faulthandler
import json
import os
import select
import subprocess
import sys
import threading
import time
from typing import BinaryIO

from hpgr import pipeline
from hpgr.scene import Scene
from studies.bench import Bench, Case, Job, Outcome, run_case
from studies.cases import code_version, outcome_of, pack_outcome, read_packed

_START = 300.0  # s that a child may take to start: it may have to compile
_IDLE = 60.0  # s without work after which a child ends itself
_GRACE = 10.0  # s beyond the timeout after which an orphaned child ends itself

_OWN = threading.local()  # the child of each worker thread


def run_isolated(job: Job, cases: list[Case], at_once: int) -> list[Outcome]:
    """Run cases one after the other in this thread's child; each that hangs or dies is told as such."""
    return [_run(job, case, at_once) for case in cases]


def _run(job: Job, case: Case, at_once: int) -> Outcome:
    child = getattr(_OWN, "child", None)
    if child is None or not child.serves(job, at_once):
        if child is not None:
            child.end()
        child = _OWN.child = Child(job, at_once)
    outcome = child.run(case)
    if child.dead:
        child.end()
        _OWN.child = None
    return outcome


class Child:
    """A process that runs cases of one job."""

    def __init__(self, job: Job, at_once: int):
        self._job, self._at_once = job, at_once
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
        command = [sys.executable, "-c", "from studies.isolated import serve; serve()"]
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment, bufsize=-1
        )
        self._last = time.monotonic()
        self.dead = False
        told = job._asdict() | {"base": job.base.model_dump_json(), "at_once": at_once}
        if self._ask(told, _START) is None:
            self.end()
            raise RuntimeError("a process for cases did not start; its words are on standard error")

    def serves(self, job: Job, at_once: int) -> bool:
        """Return whether the child is alive and made for this job."""
        fresh = time.monotonic() - self._last < _IDLE / 2
        return fresh and not self.dead and (job, at_once) == (self._job, self._at_once)

    def run(self, case: Case) -> Outcome:
        """Run one case; the child is dead afterwards if the case hung or killed it."""
        limit = self._job.timeout
        start = time.monotonic()
        found = self._ask({"values": case.values, "replicate": case.replicate}, limit)
        if found is not None:
            return outcome_of(*found, case.index)
        self.dead = True
        if self._expired:
            message = f"took longer than the timeout of {limit:g} s, and was stopped"
            return Outcome(case.index, "timeout", message, {})
        code = self._process.wait(10)
        how = f"by signal {-code}" if code < 0 else f"with exit code {code}"
        return Outcome(case.index, "worker_lost", f"its process ended {how} after {time.monotonic() - start:.1f} s", {})

    def _ask(self, message: dict, limit: float):
        """Send a message; return the record that answers it, or None if the child died or took too long."""
        self._expired = False
        timer = threading.Timer(limit, self._expire)
        timer.daemon = True
        timer.start()
        try:
            self._process.stdin.write(json.dumps(message).encode() + b"\n")
            self._process.stdin.flush()
            return read_packed(self._process.stdout)
        except (BrokenPipeError, EOFError):
            return None
        finally:
            timer.cancel()
            self._last = time.monotonic()

    def _expire(self) -> None:
        self._expired = True
        self._process.kill()

    def end(self) -> None:
        """Stop the child."""
        self.dead = True
        self._process.kill()
        self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            with contextlib.suppress(BrokenPipeError):
                pipe.close()

    def __del__(self):
        if hasattr(self, "_process"):
            self.end()


def serve() -> None:
    """Be a child: read a job, then cases, until the pipe closes or nothing comes for a while."""
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what a case prints must not go between the answers
    questions = sys.stdin.buffer
    job = json.loads(questions.readline())
    at_once = job.pop("at_once")
    job = Job(**job | {"base": Scene.model_validate_json(job["base"])})
    if job.code and job.code != code_version():
        sys.exit("hpgr or its libraries have changed since the sweep began; start it again")
    _warm_up(job.base)
    bench = Bench(job, at_once)
    _answer(answers, Outcome((), "ok", "ready", {}))
    while True:
        ready, _, _ = select.select([questions], [], [], _IDLE)
        line = questions.readline() if ready else b""
        if not line:
            return
        faulthandler.dump_traceback_later(job.timeout + _GRACE, exit=True)  # if the driver was killed meanwhile
        case = json.loads(line)
        outcome = run_case(bench, Case((), case["values"], case["replicate"]))
        faulthandler.cancel_dump_traceback_later()
        _answer(answers, outcome)


def _answer(answers: BinaryIO, outcome: Outcome) -> None:
    answers.write(pack_outcome(outcome))
    answers.flush()


def _warm_up(base: Scene) -> None:
    """Load or compile the kernels, which must not count against the first case."""
    size = base.resolution
    small = {"points": min(size.points, 10), "cells": min(size.cells, 4), "streamlines": min(size.streamlines, 2)}
    with contextlib.suppress(ValueError):  # if too coarse for this scene, its cases will warm up themselves
        scene = base.with_values({f"resolution.{name}": value for name, value in small.items()})
        pipeline.crush(scene, pipeline.prepare(scene), 0, 0)
