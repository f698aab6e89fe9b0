"""Cases to dask and back: a bounded number in flight, and a case that takes its worker down loses only itself."""

import queue
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Protocol

from studies.bench import Bench, Case, Job, Outcome, run_case
from studies.cases import code_version
from studies.isolated import run_isolated

_AHEAD = 4  # batches in flight for each thread of the workers: enough that none waits for the driver
_AHEAD_WHOLE = 2  # the same where cases are told whole, which takes memory
_TICK = 0.2  # s between looks at what other drivers have finished


class OtherCode(RuntimeError):
    """A worker whose code differs from the driver's: its bits would not be those that the address tells."""


class Plan(Protocol):
    """What the runner asks about the work: see `studies.sweep`."""

    def next_batch(self) -> list[Case]:
        """Return cases to compute, or none if there are none to be had now."""

    def is_open(self) -> bool:
        """Return whether there are cases that neither this driver nor the folder has yet."""

    def read_back(self) -> Iterator[Outcome]:
        """Yield the outcomes that other drivers have put on disk meanwhile."""


def run_batch(job: Job, cases: list[Case]) -> list[Outcome]:
    """Run cases one after the other; this is a task of a worker."""
    if job.code and job.code != code_version():
        raise OtherCode("a worker's hpgr or libraries differ from the driver's; install the same on both")
    at_once = _threads_here()
    if job.timeout is not None:
        return run_isolated(job, cases, at_once)
    bench = Bench(job, at_once)
    return [run_case(bench, case) for case in cases]


def _threads_here() -> int:
    """Return how many tasks this process may run at once, which share its memory."""
    from distributed import get_worker

    try:
        return get_worker().state.nthreads
    except ValueError:  # no worker
        return 1


@contextmanager
def own_client(threads: int) -> Iterator[Any]:
    """Start a dask cluster in this process; it listens on loopback only."""
    from distributed import Client, LocalCluster  # late: importing costs 0.5 s

    # one process: the kernels release the lock; its dashboards would listen on every interface
    with (
        LocalCluster(
            processes=False,
            n_workers=1,
            threads_per_worker=threads,
            dashboard_address="127.0.0.1:0",
            worker_dashboard_address="127.0.0.1:0",
            memory_limit=0,
        ) as cluster,
        Client(cluster) as client,
        _short_turns(),
    ):
        yield client


@contextmanager
def _short_turns() -> Iterator[None]:
    """Let threads take turns at the interpreter every 0.2 ms instead of 5 ms, as long as a case's own Python.

    A thread that comes back from its kernel then waits less: 2 threads gain 1.6 instead of 1.4 times one.
    """
    usual = sys.getswitchinterval()
    sys.setswitchinterval(2e-4)
    try:
        yield
    finally:
        sys.setswitchinterval(usual)


def workers_of(client: Any) -> int:
    """Return the threads of the client's workers, at least 1."""
    return max(1, sum(client.nthreads().values()))


def outcomes(job: Job, plan: Plan, client: Any) -> Iterator[Outcome]:
    """Yield the outcome of every case of the plan as it comes in, in no particular order.

    Raises
    ------
    ConnectionError
        If the scheduler is lost.
    OtherCode
        If a worker has other code than the driver.
    """
    finished: queue.SimpleQueue = queue.SimpleQueue()
    flying: dict[Any, list[Case]] = {}
    again: list[list[Case]] = []  # cases of batches that were lost, to be run one by one
    window = (_AHEAD_WHOLE if job.whole else _AHEAD) * workers_of(client)
    try:
        while True:
            while len(flying) < window:
                batch = again.pop() if again else plan.next_batch()
                if not batch:
                    break
                future = client.submit(run_batch, job, batch, pure=False)
                flying[future] = batch
                future.add_done_callback(finished.put)
            yield from plan.read_back()
            if not flying and not plan.is_open():
                return
            try:
                future = finished.get(timeout=_TICK)
            except queue.Empty:  # nothing yet, or only other drivers are at work
                window = max(window, _AHEAD * workers_of(client)) if not job.whole else window
                continue
            batch = flying.pop(future)
            yield from _settle(future, batch, again)
            future.release()
            del future
    finally:
        for future in flying:
            future.cancel()


def _settle(future: Any, batch: list[Case], again: list[list[Case]]) -> Iterator[Outcome]:
    """Yield the outcomes of a batch that has come to an end; if it was lost, its cases are tried one by one."""
    from distributed import KilledWorker

    if future.status == "finished":
        yield from future.result()
        return
    if future.status != "error":
        raise ConnectionError(
            f"lost the dask scheduler ({future.status}); finished cases are kept; run the same command again"
        )
    error = future.exception()
    if isinstance(error, OtherCode):
        raise error
    if len(batch) > 1:
        again.extend([case] for case in reversed(batch))
        return
    status = "worker_lost" if isinstance(error, KilledWorker) else "failed"
    yield Outcome(batch[0].index, status, f"{type(error).__name__}: {error}", {})
