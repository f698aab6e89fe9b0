"""Cases in a process of their own, so that one that hangs or dies loses only itself.

The worker's thread sends a case to its child and waits; a child that takes too long is killed, and one that died is
replaced. Down the pipe go lines of JSON, up come packed records (`studies.sweep.cases.pack`): nothing is unpickled.
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

from hpgr.run import run_scene
from hpgr.scene import Scene
from studies.sweep.cases import code_version, pack_result, read_packed, result_of
from studies.sweep.run import Runner, run_cases, threads_here
from studies.sweep.space import Case, CaseResult, SweepSpec, plain

_START = 300.0  # s that a child may take to start: it may have to compile
_IDLE = 60.0  # s without work after which a child ends itself
_GRACE = 10.0  # s beyond the timeout after which an orphaned child ends itself

_OWN = threading.local()  # the child of each worker thread


def run_isolated(spec: SweepSpec, cases: list[Case]) -> list[CaseResult]:
    """Run cases one after the other in this thread's child; this is a task of a worker.

    Each case that hangs or dies is told as such.
    """
    at_once = threads_here()
    return [_run(spec, case, at_once) for case in cases]


def _run(spec: SweepSpec, case: Case, at_once: int) -> CaseResult:
    child = getattr(_OWN, "child", None)
    if child is None or not child.serves(spec, at_once):
        if child is not None:
            child.end()
        child = _OWN.child = Child(spec, at_once)
    result = child.run(case)
    if child.dead:
        child.end()
        _OWN.child = None
    return result


class Child:
    """A process that runs cases of one sweep."""

    def __init__(self, spec: SweepSpec, at_once: int):
        self._spec, self._at_once = spec, at_once
        env = os.environ | {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
        command = [sys.executable, "-c", "from studies.sweep.isolated import serve; serve()"]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=env, bufsize=-1)
        self._last = time.monotonic()
        self.dead = False
        told = spec._asdict() | {"base": spec.base.model_dump_json(), "at_once": at_once}
        if self._ask(told, _START) is None:
            self.end()
            raise RuntimeError("a process for cases did not start; its words are on standard error")

    def serves(self, spec: SweepSpec, at_once: int) -> bool:
        """Return whether the child is alive and made for this sweep."""
        fresh = time.monotonic() - self._last < _IDLE / 2
        return fresh and not self.dead and (spec, at_once) == (self._spec, self._at_once)

    def run(self, case: Case) -> CaseResult:
        """Run one case; the child is dead afterwards if the case hung or killed it."""
        limit = self._spec.timeout
        start = time.monotonic()
        found = self._ask({"values": case.values, "replicate": case.replicate}, limit)
        if found is not None:
            return result_of(*found, case.index)
        self.dead = True
        if self._expired:
            message = f"took longer than the timeout of {limit:g} s, and was stopped"
            return CaseResult(case.index, "timeout", message, {})
        code = self._process.wait(10)
        how = f"by signal {-code}" if code < 0 else f"with exit code {code}"
        return CaseResult(
            case.index, "worker_lost", f"its process ended {how} after {time.monotonic() - start:.1f} s", {}
        )

    def _ask(self, message: dict, limit: float):
        """Send a message; return the record that answers it, or None if the child died or took too long."""
        self._expired = False
        timer = threading.Timer(limit, self._expire)
        timer.daemon = True
        timer.start()
        try:
            self._process.stdin.write(json.dumps(message, default=plain).encode() + b"\n")
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
    """Be a child: read what a sweep's cases share, then cases, until the pipe closes or nothing comes for a while."""
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what a case prints must not go between the answers
    questions = sys.stdin.buffer
    spec = json.loads(questions.readline())
    at_once = spec.pop("at_once")
    spec = SweepSpec(**spec | {"base": Scene.model_validate_json(spec["base"])})
    if spec.code and spec.code != code_version():
        sys.exit("hpgr or its libraries have changed since the sweep began; start it again")
    _warm_up(spec.base)
    runner = Runner(spec, at_once)
    _answer(answers, CaseResult((), "ok", "ready", {}))
    while True:
        ready, _, _ = select.select([questions], [], [], _IDLE)
        line = questions.readline() if ready else b""
        if not line:
            return
        faulthandler.dump_traceback_later(spec.timeout + _GRACE, exit=True)  # if the driver was killed meanwhile
        case = json.loads(line)
        [result] = run_cases(runner, [Case((), case["values"], case["replicate"])])
        faulthandler.cancel_dump_traceback_later()
        _answer(answers, result)


def _answer(answers: BinaryIO, result: CaseResult) -> None:
    answers.write(pack_result(result))
    answers.flush()


def _warm_up(base: Scene) -> None:
    """Load or compile the kernels, which must not count against the first case."""
    size = base.resolution
    small = {"points": min(size.points, 10), "cells": min(size.cells, 4), "streamlines": min(size.streamlines, 2)}
    with contextlib.suppress(ValueError):  # if too coarse for this scene, its cases will warm up themselves
        run_scene(base.with_values({f"resolution.{name}": value for name, value in small.items()}))
