"""Axes x replicates -> cases -> dask futures -> one Dataset.

A case is one scene with one replicate number. Finished cases are kept in a folder, if one is given, and read back
instead of being computed again. Whatever a case does, only its own place in the result is left NaN, with its status
and message beside it.
"""

import itertools
from collections import Counter, deque
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from pydantic import ValidationError

import hpgr
from hpgr import budget, schema
from hpgr.keys import refuse_key
from hpgr.scene import Scene, field_info, field_value, level_text
from studies import recorded, runner
from studies.bench import LIBRARIES, STATUS, Case, Job, Outcome
from studies.cases import Addresses, CaseFolder, code_version, outcome_of, read_folder, say
from studies.progress import progress_bar

if TYPE_CHECKING:
    import xarray as xr

# Names of the dims of the main axes (design page); others are called after their field.
_DIMS = {
    "rolls.gap": "gap", "rolls.speed": "roll_speed", "feed.top_size": "feed_top_size",
    "rolls.specific_pressing_force": "press_force",
}  # fmt: skip
_BATCH = 32  # cases a task holds at most: dask's cost of about 1 ms per task is then under 1 % of a case's
_BATCH_SECONDS = 2.0  # predicted for a task at most, so that progress shows and little is lost with a worker
_PREDICTED = 100  # operating points whose cost is predicted; that of more is scaled up


def sweep(
    scene: Scene,
    axes: Mapping[str, Iterable],
    replicates: int = 1,
    seed: int = 0,
    client: Any = None,
    threads: int = 2,
    progress: bool = False,
    tolerance: float | None = None,
    max_cost: float = 60.0,
    folder: str | Path | None = None,
    force: bool = False,
    timeout: float | None = None,
    record: Literal["product", "distributions", "cells"] = "product",
) -> "xr.Dataset":
    """Run `scene` at every combination of `axes`, and return the summaries as one Dataset.

    Parameters
    ----------
    scene : Scene
        Base scene; what is recorded of it is `record`.
    axes : mapping
        Scene fields by dotted name, each with its values: SI numbers or text with a unit, as in
        ``{"rolls.gap": ["40 mm", "60 mm"], "feed.top_size": [0.04, 0.06]}``.
    replicates : int
        Independent repetitions of every case.
    seed : int
        Seed of all randomness. Operating points share their random numbers, so curves are smooth.
    client : distributed.Client, optional
        A dask cluster to run on; default threads of this process.
    threads : int
        Threads if no client is given.
    progress : bool
        Whether to show on standard error what is read back, the predicted cost, and progress.
    tolerance : float, optional
        Wanted relative error, as in `hpgr.simulate`: every operating point gets a resolution of its own, and
        its estimated errors. Where streamlines differ, variables along them are left out.
    max_cost : float
        Predicted seconds that meeting the tolerance may take at an operating point.
    folder : path, optional
        Where finished cases are kept, for this sweep and later ones; default: nowhere. Cases that it holds already are
        read back. Sweeps may share a folder, also at the same time: none computes what another is computing.
    force : bool
        Whether to compute cases that the folder holds already.
    timeout : float, optional
        Seconds that a case may take. Cases then run in processes of their own, so that one that hangs or dies loses
        only itself; starting them takes about 2 s.
    record : {"product", "distributions", "cells"}
        What is kept of every case; other than the product, each case is a file in the folder, and
        `studies.open_cases` opens them together. The result holds the summaries either way.

    Returns
    -------
    xarray.Dataset
        Dims: the axes (gap, roll_speed, feed_top_size, or the field's name), replicate, streamline, sieve.
        Every summary variable of `hpgr.simulate`; `status` and `message` of every case. A case that was
        refused or failed holds NaN. Bits do not depend on threads, workers or order, nor on what was read back.

    Raises
    ------
    ValueError
        If an axis is no scene field, has no or doubled values, or a value that its field refuses; if cases are to be
        recorded whole and no folder is given.
    OSError
        If finished cases cannot be kept, or the scheduler is lost; what was kept before is as it was.

    Examples
    --------
    >>> import hpgr
    >>> from studies.sweep import sweep
    >>> base = hpgr.presets.paper().with_values({"resolution.cells": 100, "resolution.points": 50})
    >>> result = sweep(base, {"rolls.gap": ["40 mm", "60 mm"]}, replicates=2)
    >>> dict(result["p80_total"].sizes)
    {'gap': 2, 'replicate': 2}
    """
    grid = axis_values(axes)
    if "rolls.gap" in grid and (scene.rolls.specific_pressing_force or "rolls.specific_pressing_force" in grid):
        raise ValueError(
            "rolls.gap: got it beside rolls.specific_pressing_force, under which the gap floats; give one of them"
        )
    refuse_key("seed", seed)
    for name, value in {"replicates": replicates, "threads": threads}.items():
        if value < 1:
            raise ValueError(f"{name}: got {value}; must be at least 1; such as {name}=2")
    if timeout is not None and not 0.1 <= timeout <= 1e6:
        raise ValueError(f"timeout: got {timeout:g}; must be 0.1 to 1,000,000 s; such as timeout=60")
    if record != "product" and folder is None:
        raise ValueError(f"folder: got None; record={record!r} needs a folder, which takes a file of each case")
    base = scene.with_values({"resolution.record": record})
    job = Job(base, seed, tolerance, max_cost, timeout, code_version())
    with ExitStack() as stack:
        kept = None if folder is None else stack.enter_context(CaseFolder(folder, afresh=force))
        plan = _Plan(job, grid, replicates, kept)
        return _assemble(job, grid, replicates, _outcomes(plan, client, threads, progress), plan)


def axis_values(axes: Mapping[str, Iterable]) -> dict[str, list]:
    """Return the axes with their values in SI, refusing what no scene could take.

    Raises
    ------
    ValueError
        Naming the axis, the value and the remedy.
    """
    grid = {name: [_axis_value(name, value) for value in _listed(name, values)] for name, values in axes.items()}
    for name, values in grid.items():
        if not values:
            raise ValueError(f"{name}: got no values; an axis needs at least one; give values or leave the axis out")
        double = next((value for k, value in enumerate(values) if value in values[:k]), None)
        if double is not None:
            raise ValueError(f"{name}: got {double!r} twice; values must differ; use replicates to repeat a case")
    return grid


def _listed(name: str, values: Any) -> list:
    if isinstance(values, str) or not isinstance(values, Iterable):
        raise ValueError(f"{name}: got {values!r}; an axis is a list of values; such as [{values!r}]")
    return list(values)


def _axis_value(name: str, value: Any) -> Any:
    found = field_value(name, value)
    if not isinstance(found, int | float | str):
        raise ValueError(f"{name}: got {value!r}; an axis takes numbers or words, no lists; sweep one scene for each")
    return found


def enumerate_cases(grid: Mapping[str, list], replicates: int) -> Iterator[Case]:
    """Yield every case of the grid, replicates fastest."""
    shape = [range(len(values)) for values in grid.values()]
    for index in itertools.product(*shape, range(replicates)):
        values = {name: grid[name][k] for name, k in zip(grid, index[:-1], strict=True)}
        yield Case(index, values, index[-1])


def finished_cases(
    scene: Scene, axes: Mapping[str, Iterable], replicates: int, folder: str | Path, seed: int = 0,
    tolerance: float | None = None, max_cost: float = 60.0,
) -> dict[tuple[int, ...], int]:  # fmt: skip
    """Return how many replicates of each operating point, by its index, `folder` holds intact; nothing is written."""
    grid = axis_values(axes)
    addresses = Addresses(Job(scene, seed, tolerance, max_cost, code=code_version()))
    cases = {addresses.of(case.values, case.replicate): case.index[:-1] for case in enumerate_cases(grid, replicates)}
    found = {record.address for record in read_folder(Path(folder), cases.__contains__)}
    counted = Counter(cases[address] for address in found)
    return {index: counted[index] for index in cases.values()}


def dim_of(name: str) -> str:
    """Return the name of the dimension that a scene field has in a sweep."""
    section, _, key = name.partition(".")
    return _DIMS.get(name) or (key if section in {"material", "resolution"} else f"{section}_{key}")


class _Plan:
    """What is left to do of a sweep, and where finished cases go."""

    def __init__(self, job: Job, grid: Mapping[str, list], replicates: int, kept: CaseFolder | None):
        self.job, self.kept = job, kept
        self._grid, self._replicates = grid, replicates
        self.shape = (*(len(values) for values in grid.values()), replicates)
        self.total = int(np.prod(self.shape))
        addresses = Addresses(job)
        self.addresses = [addresses.of(case.values, case.replicate) for case in enumerate_cases(grid, replicates)]
        self._numbers = {address: number for number, address in enumerate(self.addresses)}  # of those not yet here
        self._queue = deque(range(self.total))
        self._elsewhere: deque[int] = deque()  # what other drivers are computing
        self._fresh: list[Outcome] = []  # read back, and not yet told
        self.batch = 1

    @property
    def left(self) -> int:
        """Number of cases without an outcome."""
        return len(self._numbers)

    def is_open(self) -> bool:
        """Return whether there are cases that neither this driver nor the folder has yet."""
        return bool(self._queue or self._elsewhere)

    def next_batch(self) -> list[Case]:
        """Return cases to compute, now this driver's; none if there are none to be had now."""
        if not self._queue:
            self._queue, self._elsewhere = self._elsewhere, deque()
        batch: list[int] = []
        while self._queue and len(batch) < self.batch:
            number = self._queue[0]
            if batch and self.job.tolerance is not None and number // self._replicates != batch[0] // self._replicates:
                break  # the replicates of an operating point share its refinement
            self._queue.popleft()
            address = self.addresses[number]
            if address not in self._numbers:  # read back
                continue
            if self.kept is None or self.kept.claim(address):
                batch.append(number)
            else:
                self._elsewhere.append(number)
        self._fresh += self._read()  # what another driver finished before this one claimed it
        return [self.case(number) for number in batch if self.addresses[number] in self._numbers]

    def case(self, number: int) -> Case:
        """Return a case by its number in the order of the axes, replicates fastest."""
        index = tuple(map(int, np.unravel_index(number, self.shape)))
        values = {name: self._grid[name][k] for name, k in zip(self._grid, index[:-1], strict=True)}
        return Case(index, values, index[-1])

    def read_back(self) -> Iterator[Outcome]:
        """Yield the outcomes that have come into the folder since the last call."""
        fresh, self._fresh = self._fresh, []
        yield from fresh
        yield from self._read()

    def _read(self) -> Iterator[Outcome]:
        if self.kept is None:
            return
        for found in self.kept.read(self._numbers.__contains__):
            index = np.unravel_index(self._numbers.pop(found.address), self.shape)
            self.kept.release(found.address)
            yield outcome_of(found.header, found.arrays, tuple(map(int, index)))

    def settle(self, outcome: Outcome) -> Outcome:
        """Keep a computed outcome if it is well; return it without what has gone to a file."""
        address = self.addresses[int(np.ravel_multi_index(outcome.index, self.shape))]
        self._numbers.pop(address, None)
        if self.kept is None:
            return outcome
        if outcome.status != "ok":  # never counts as done
            self.kept.release(address)
            return outcome
        write = (lambda path: recorded.write_case(outcome, address, path)) if outcome.whole is not None else None
        self.kept.put(address, outcome, write)
        return outcome._replace(whole=None, attrs=None)


def _outcomes(plan: _Plan, client: Any, threads: int, progress: bool) -> Iterator[Outcome]:
    """Yield the outcome of every case: first those read back, then the others as they come in."""
    yield from plan.read_back()
    if progress and plan.kept is not None:
        say(f"{plan.total - plan.left} of {plan.total} cases read back from {plan.kept.folder}")
    if not plan.left:
        return
    if client is None:
        with runner.own_client(threads) as own:
            yield from _computed(plan, own, progress)
    else:
        yield from _computed(plan, client, progress)


def _computed(plan: _Plan, client: Any, progress: bool) -> Iterator[Outcome]:
    workers = runner.workers_of(client)
    plan.batch = _batch_size(plan, workers)
    if progress:
        say(_prediction(plan, workers))
    with progress_bar(plan.total, progress, "cases", "{rate_fmt}, {remaining} left", plan.total - plan.left) as bar:
        for outcome in runner.outcomes(plan.job, plan, client):
            yield plan.settle(outcome)
            bar.update(plan.total - plan.left - bar.n)


def _batch_size(plan: _Plan, workers: int) -> int:
    if plan.job.whole:  # a case at a time, or the driver's memory would grow with the batch
        return 1
    if plan.job.tolerance is not None:
        return plan.shape[-1]
    quick = int(_BATCH_SECONDS / budget.predict(plan.job.base).seconds)
    return max(1, min(_BATCH, quick, plan.left // (4 * workers)))


def _prediction(plan: _Plan, workers: int) -> str:
    """Return in words what the cases that are left are predicted to cost."""
    points, replicates = plan.total // plan.shape[-1], plan.shape[-1]
    costs = []
    for point in np.unique(np.linspace(0, points - 1, min(points, _PREDICTED)).astype(int)):
        try:
            costs.append(budget.predict(plan.job.base.with_values(plan.case(int(point) * replicates).values)))
        except ValidationError:
            continue  # refused, which costs nothing
    seconds = plan.left * sum(cost.seconds for cost in costs) / max(len(costs), 1) / workers
    most = max((cost.bytes for cost in costs), default=0)
    before = ", before refinement" if plan.job.tolerance is not None else ""
    return (
        f"{plan.left} cases to compute on {workers} thread{'s' * (workers > 1)}: predicted {seconds:.2g} s, "
        f"at most {most / 1e6:.3g} MB a case{before}"
    )


def _assemble(job: Job, grid, replicates: int, outcomes: Iterable[Outcome], plan: _Plan) -> "xr.Dataset":
    """Return one Dataset of all outcomes over the axes and replicates, the same whatever their order."""
    import xarray as xr

    dims = (*(dim_of(name) for name in grid), "replicate")
    shape = plan.shape
    status = np.full(shape, STATUS["failed"], np.int8)
    messages, notes = np.full(shape, "", object), np.full(shape, "", object)
    stacks: dict[str, np.ndarray] = {}
    along: dict[str, np.ndarray] = {}  # coordinates, the same for every case that has them
    uneven: set[str] = set()
    for outcome in outcomes:
        status[outcome.index] = STATUS[outcome.status]
        messages[outcome.index], notes[outcome.index] = outcome.message, outcome.notes
        for name, (_, value) in outcome.summary.items():
            if name in schema.COORDINATES:
                known = along.setdefault(name, value)
            else:
                if name not in stacks:
                    stacks[name] = _blank((*shape, *value.shape), value.dtype)
                stacks[name][outcome.index] = value if value.shape == stacks[name].shape[len(shape) :] else 0
                known = stacks[name][outcome.index]
            if known.shape != value.shape:  # an axis over the number of streamlines or sieves makes it ragged
                uneven.add(name)
    dataset = xr.Dataset(attrs=_attributes(job, grid, replicates, uneven))
    for name, values in grid.items():
        info = field_info(name)
        attrs = {"units": info.unit, "long_name": info.text, "scene_field": name}
        dataset.coords[dim_of(name)] = (dim_of(name), np.array(values), attrs if info.unit else {})
    attrs = {"standard_name": "realization", "units": "1", "long_name": "independent repetition"}
    dataset.coords["replicate"] = ("replicate", np.arange(replicates, dtype=np.int32), attrs)
    for name in (name for name in schema.COORDINATES if name in along and name not in uneven):
        dataset.coords[name] = (schema.COORDINATES[name].dims, along[name], schema.attributes(name))
    for name in (name for name in schema.VARIABLES if name in stacks and name not in uneven):
        dataset[name] = ((*dims, *schema.VARIABLES[name].dims), stacks[name], schema.attributes(name))
    dataset["status"] = (dims, status, recorded.status_attributes())
    dataset["message"] = (dims, messages, {"long_name": "why a case holds no result"})
    dataset["notes"] = (dims, notes, {"long_name": "which limits a case hit, in words"})
    if job.whole:
        manifest = {name: value for name, value in dataset.attrs.items() if name != "left_out"}
        recorded.write_manifest(plan.kept.folder, dims[:-1], grid, replicates, plan.addresses, status, manifest)
    return dataset


def _blank(shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
    """Return an array of NaN, or of zeros for integers, whose status tells that they are none."""
    return np.full(shape, np.nan if dtype.kind == "f" else 0, dtype)


def _attributes(job: Job, grid, replicates: int, uneven: set[str]) -> dict[str, Any]:
    found = {
        "Conventions": "CF-1.11",
        "title": "Parametric study of comminution in high pressure grinding rolls",
        "source": f"hpgr {hpgr.__version__}",
        "scene": job.base.model_dump_json(),
        "axes": ", ".join(grid),
        "seed": job.seed,
        "replicates": replicates,
        "left_out": ", ".join(sorted(uneven)),
        "level": level_text(job.base.resolution.level),
        "versions": ", ".join(f"{name} {version(name)}" for name in LIBRARIES),
    }
    return found if job.tolerance is None else found | {"tolerance": job.tolerance}
