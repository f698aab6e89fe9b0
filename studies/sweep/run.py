"""Cases to dask and back: a bounded number in flight, and a case that takes its worker down loses only itself."""

import itertools
import logging
import queue
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from hpgr import cost
from hpgr.bed.loaded import Beds
from hpgr.fields import faults_of
from hpgr.grains import kernels
from hpgr.results import schema
from hpgr.run import Result, attributes, run_scene, run_together
from hpgr.tolerance import refine
from studies.sweep.cases import Addresses, CaseFolder, code_version, result_of, say
from studies.sweep.space import Case, CaseResult, Space, SweepSpec

Task = Callable[[SweepSpec, list[Case]], list[CaseResult]]

_KNOWN = schema.COORDINATES | schema.VARIABLES
_SUMMARY = {name: entry for name, entry in _KNOWN.items() if not {"point", "cell", "time"} & set(entry.dims)}
_AHEAD = 4  # batches in flight for each thread of the workers: enough that none waits for the driver
_AHEAD_WHOLE = 2  # the same where cases are told whole, which takes memory
_BATCH = 128  # cases a task holds at most: dask takes 3 ms a task (1,000 cases with files: 32 -> 128 x 0.87)
_TOGETHER = 200_000  # points of cases run at once, whose beds are all held
_BATCH_SECONDS = 2.0  # predicted for a task at most, so that progress shows and little is lost with a worker
_PREDICTED = 100  # operating points whose cost is predicted; that of more is scaled up
_TICK = 0.2  # s between looks at what other drivers have finished
_PATIENCE = 5.0  # s of waiting for other drivers before the user is told of them; then twice as long each time


class OtherCode(RuntimeError):
    """A worker whose code differs from the driver's: its bits would not be those that the address tells."""


# ---- cases


class Runner:
    """Runs cases, and keeps what the next may share: scene and bed."""

    def __init__(self, spec: SweepSpec, at_once: int = 1):
        self.spec = spec
        self._scene, self._chosen = spec.base, {}
        self._values: dict[str, Any] | None = None
        self._beds = Beds(1)
        self._room = partial(_room, at_once)

    def run(self, cases: list[Case]) -> list[list[Result]]:
        """Return the results of cases, by operating point, as `hpgr.simulate` would."""
        points, chosen = [], []
        for values, point in itertools.groupby(cases, lambda case: case.values):
            if values != self._values:
                self._values = None  # a refused scene must not be taken for the next case's
                self._prepare(values)
                self._values = values
            points.append((self._scene, [case.replicate for case in point]))
            chosen.append(self._chosen)
        found = run_together(points, self.spec.seed, self._beds)
        return [
            [one._replace(values=one.values | more) for one in results] if more else results
            for results, more in zip(found, chosen, strict=True)
        ]

    def _prepare(self, values: dict[str, Any]) -> None:
        spec = self.spec
        self._scene, self._chosen = spec.base.with_values(values), {}
        if spec.tolerance is not None:
            estimate = refine(self._scene, spec.tolerance, run_scene, spec.max_cost, spec.seed)
            self._scene, self._chosen = estimate.scene, estimate.variables()
        cost.refuse_too_large(self._scene, self._room)


def _room(at_once: int) -> tuple[int, str]:
    """Return the memory that each of `at_once` cases may count on, and the limit that sets it."""
    available, limit = cost.available_memory()
    shared = f"{limit}, shared by {at_once} cases at once," if at_once > 1 else limit
    return available // at_once, shared


def run_cases(runner: Runner, cases: list[Case]) -> list[CaseResult]:
    """Simulate cases at once; whatever happens is told in their results, never raised."""
    try:
        points = runner.run(cases)
    except Exception as error:  # a fault in one case must not lose the others
        if len(cases) > 1:
            half = len(cases) // 2
            return run_cases(runner, cases[:half]) + run_cases(runner, cases[half:])
        refused = isinstance(error, ValueError | MemoryError)
        told = faults_of(error) if isinstance(error, ValidationError) else str(error)
        words = told if refused else f"{type(error).__name__}: {told}"
        return [CaseResult(cases[0].index, "refused" if refused else "failed", words, {})]
    each = iter(cases)
    return [told for results in points for told in _told(runner.spec, each, results)]


def _told(spec: SweepSpec, cases: Iterator[Case], results: list[Result]) -> Iterator[CaseResult]:
    """Yield what is told of cases of an operating point that came to results."""
    title = "Comminution in high pressure grinding rolls, heterarchical model: one case of a study"
    shared, own = {}, {}  # by replicates, which share most; those of each are stored at once, (replicate, ...)
    for name, entry in (_KNOWN if spec.whole else _SUMMARY).items():
        every = [result.values.get(name) for result in results]
        if any(one is not every[0] for one in every):
            own[name] = np.array(every, entry.dtype)
        elif every[0] is not None:
            shared[name] = np.asarray(every[0], entry.dtype)
    alike = [value.ravel() for name, value in shared.items() if name in _SUMMARY]
    finite = np.full(len(results), np.isfinite(np.concatenate(alike)).all())  # one by one takes three times as long
    for value in own.values():
        finite &= np.isfinite(value).reshape(len(results), -1).all(axis=1)
    for k, (result, case) in enumerate(zip(results, cases, strict=False)):  # of cases no more are taken
        stored = shared | {name: value[k, ...] for name, value in own.items()}
        summary = {name: value for name, value in stored.items() if name in _SUMMARY} if spec.whole else stored
        if not finite[k]:
            broken = [name for name, value in summary.items() if not np.isfinite(value).all()]
            yield CaseResult(case.index, "failed", f"not finite: {', '.join(broken)}", {})
        elif not spec.whole:
            yield CaseResult(case.index, "ok", "", summary, result.diagnostics)
        else:
            attrs = attributes(result, title, spec.seed, case.replicate)
            yield CaseResult(case.index, "ok", "", summary, result.diagnostics, stored, attrs)


def run_batch(spec: SweepSpec, cases: list[Case]) -> list[CaseResult]:
    """Run cases, some at once; this is a task of a worker."""
    if spec.code and spec.code != code_version():
        raise OtherCode("a worker's hpgr or libraries differ from the driver's; install the same on both")
    runner, grid = Runner(spec, threads_here()), spec.base.resolution
    step = max(1, _TOGETHER // (grid.streamlines * grid.points))
    parts = (cases[first : first + step] for first in range(0, len(cases), step))
    return [result for part in parts for result in run_cases(runner, part)]


def threads_here() -> int:
    """Return how many tasks this process may run at once, which share its memory."""
    from distributed import get_worker

    try:
        return get_worker().state.nthreads
    except ValueError:  # no worker
        return 1


# ---- what is left to do


class Plan:
    """What is left to do of a sweep, and where finished cases go."""

    def __init__(self, spec: SweepSpec, space: Space, kept: CaseFolder | None):
        self.spec, self.space, self.kept = spec, space, kept
        addresses = Addresses(spec)
        self.addresses = [addresses.of(case.values, case.replicate) for case in space.cases()]
        self._numbers: dict[str, list[int]] = {}  # of those not yet here; samples may repeat an operating point
        for number, address in enumerate(self.addresses):
            self._numbers.setdefault(address, []).append(number)
        self._queue = deque(range(space.total))
        self._elsewhere: deque[int] = deque()  # what other drivers are computing
        self._fresh: list[CaseResult] = []  # read back, and not yet told
        self.batch = 1

    @property
    def left(self) -> int:
        """Number of cases without a result."""
        return sum(map(len, self._numbers.values()))

    def is_open(self) -> bool:
        """Return whether there are cases that neither this driver nor the folder has yet."""
        return bool(self._queue or self._elsewhere)

    def next_batch(self) -> list[Case]:
        """Return cases to compute, now this driver's; none if there are none to be had now."""
        if not self._queue:
            self._queue, self._elsewhere = self._elsewhere, deque()
        replicates = self.space.replicates
        batch: list[int] = []
        while self._queue and len(batch) < self.batch:
            number = self._queue[0]
            another = batch and number // replicates != batch[-1] // replicates
            if another and len(batch) + replicates > self.batch:
                break  # the replicates of an operating point share its bed, calls of the kernels, refinement
            self._queue.popleft()
            address = self.addresses[number]
            if number != self._numbers.get(address, [None])[0]:  # read back, or run for another place
                continue
            if self.kept is None or self.kept.claim(address):
                batch.append(number)
            else:
                self._elsewhere.append(number)
        self._fresh += self._read()  # what another driver finished before this one claimed it
        return [self.space.case(number) for number in batch if self.addresses[number] in self._numbers]

    def read_back(self) -> Iterator[CaseResult]:
        """Yield the results that have come into the folder since the last call."""
        fresh, self._fresh = self._fresh, []
        yield from fresh
        yield from self._read()

    def _read(self) -> Iterator[CaseResult]:
        if self.kept is None:
            return
        for found in self.kept.read(self._numbers.__contains__):
            self.kept.release(found.address)
            yield from self._everywhere(result_of(found.header, found.arrays, ()), found.address)

    def settle(self, result: CaseResult) -> Iterator[CaseResult]:
        """Keep a computed result if it is well; yield it without what has gone to a file."""
        address = self.addresses[self.space.number(result.index)]
        if self.kept is not None and result.status != "ok":  # never counts as done
            self.kept.release(address)
        elif self.kept is not None:
            self.kept.put(address, result)
            result = result._replace(whole=None, attrs=None)
        yield from self._everywhere(result, address)

    def _everywhere(self, result: CaseResult, address: str) -> Iterator[CaseResult]:
        """Yield the result of an address at every place it has, which then have it."""
        for number in self._numbers.pop(address, []):
            yield result._replace(index=self.space.case(number).index)


def results(plan: Plan, client: Any, threads: int, task: Task, progress: bool) -> Iterator[CaseResult]:
    """Yield the result of every case: first those read back, then the others as they come in."""
    yield from plan.read_back()
    if progress and plan.kept is not None:
        say(f"{plan.space.total - plan.left} of {plan.space.total} cases read back from {plan.kept.folder}")
    if not plan.left:
        return
    client = active_client() if client is None else client
    with own_client(threads) if client is None else nullcontext(client) as used:
        yield from _computed(plan, used, task, progress)


def _computed(plan: Plan, client: Any, task: Task, progress: bool) -> Iterator[CaseResult]:
    from studies.command import progress_bar  # late: workers do without a command line

    workers = workers_of(client)
    plan.batch = _batch_size(plan, workers)
    total = plan.space.total
    if progress:
        say(_prediction(plan, workers))
        if _to_compile():
            say("the first run compiles the model, which takes some ten seconds, once")
    with progress_bar(total, progress, "cases", "{rate_fmt}, {remaining} left", total - plan.left) as bar:
        for result in dispatched(plan, client, task):
            yield result
            bar.update(total - plan.left - bar.n)


def _batch_size(plan: Plan, workers: int) -> int:
    if plan.spec.whole:  # a case at a time, or the driver's memory would grow with the batch
        return 1
    if plan.spec.tolerance is not None:
        return plan.space.replicates
    quick = int(_BATCH_SECONDS / cost.predict(plan.spec.base).seconds)
    return max(1, min(_BATCH, quick, plan.left // (4 * workers)))


def _to_compile() -> bool:
    """Return whether the compiler has left nothing on disk yet that a run could load."""
    stats = getattr(kernels.crush, "stats", None)  # which plain Python has not
    return stats is not None and not list(Path(stats.cache_path).glob("kernels.crush*.nbi"))


def _prediction(plan: Plan, workers: int) -> str:
    """Return in words what the cases that are left are predicted to cost."""
    replicates = plan.space.replicates
    points = plan.space.total // replicates
    costs = []
    for point in np.unique(np.linspace(0, points - 1, min(points, _PREDICTED)).astype(int)):
        try:
            costs.append(cost.predict(plan.spec.base.with_values(plan.space.case(int(point) * replicates).values)))
        except ValidationError:
            continue  # refused, which costs nothing
    seconds = plan.left * sum(each.seconds for each in costs) / max(len(costs), 1) / workers
    most = max((each.bytes for each in costs), default=0)
    before = ", before refinement" if plan.spec.tolerance is not None else ""
    return (
        f"{plan.left} cases to compute on {workers} thread{'s' * (workers > 1)}: predicted {seconds:.2g} s, "
        f"at most {most / 1e6:.3g} MB a case{before}"
    )


# ---- dask


def check_client(client: Any) -> None:
    """Raise TypeError if an argument is no dask client."""
    from distributed import Client

    if not isinstance(client, Client):
        raise TypeError(f"client: got {client!r:.80}; must be a dask client; such as distributed.Client(address)")


def active_client() -> Any:
    """Return the client that this process has made the default; None if there is none."""
    from distributed import default_client

    try:
        return default_client()
    except ValueError:
        return None


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
            silence_logs=logging.ERROR,  # an interrupt would have it warn of every case on its way
        ) as cluster,
        Client(cluster, set_as_default=False) as client,  # which another sweep must not take for the user's
    ):
        yield client


def workers_of(client: Any) -> int:
    """Return the threads of the client's workers, at least 1."""
    return max(1, sum(client.nthreads().values()))


def dispatched(plan: Plan, client: Any, task: Task) -> Iterator[CaseResult]:
    """Yield the result of every case of the plan as it comes in, computed or read back, in no particular order.

    ConnectionError if the scheduler is lost; OtherCode if a worker has other code than the driver.
    """
    finished: queue.SimpleQueue = queue.SimpleQueue()
    flying: dict[Any, list[Case]] = {}
    again: list[list[Case]] = []  # cases of batches that were lost, to be run one by one
    window = (_AHEAD_WHOLE if plan.spec.whole else _AHEAD) * workers_of(client)
    idle_since, patience = time.monotonic(), _PATIENCE
    try:
        while True:
            while len(flying) < window:
                batch = again.pop() if again else plan.next_batch()
                if not batch:
                    break
                future = client.submit(task, plan.spec, batch, pure=False)
                flying[future] = batch
                future.add_done_callback(finished.put)
            yield from plan.read_back()
            if not flying and not plan.is_open():
                return
            try:
                future = finished.get(timeout=_TICK)
            except queue.Empty:  # nothing yet, or only other drivers are at work
                window = max(window, _AHEAD * workers_of(client)) if not plan.spec.whole else window
                if flying:
                    idle_since = time.monotonic()
                elif time.monotonic() - idle_since > patience:
                    say(f"waiting for {plan.left} cases that other drivers hold: {plan.kept.others()}")
                    patience *= 2
                continue
            batch = flying.pop(future)
            for result in _settle(future, batch, again):
                yield from plan.settle(result)
            future.release()
            del future
    finally:
        for future in flying:
            future.cancel()


def _settle(future: Any, batch: list[Case], again: list[list[Case]]) -> Iterator[CaseResult]:
    """Yield the results of a batch that has come to an end; if it was lost, its cases are tried one by one."""
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
    yield CaseResult(batch[0].index, status, f"{type(error).__name__}: {error}", {})
