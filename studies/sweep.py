"""Axes x replicates -> cases -> dask futures -> one Dataset.

A case is one scene with one replicate number. Cases are sent to dask in batches, and whatever a case does,
only its own place in the result is left NaN, with its status and message beside it.
"""

import itertools
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from importlib.metadata import version
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from pydantic import ValidationError

import hpgr
from hpgr import budget, machine, pipeline, schema
from hpgr import tolerance as tolerances
from hpgr.keys import refuse_key
from hpgr.scene import Scene, faults_of, field_info, field_value, level_text

if TYPE_CHECKING:
    import xarray as xr

_LIBRARIES = ("numpy", "numba", "xarray", "netCDF4", "dask", "distributed", "scipy")  # that decide the bits

STATUS = {"ok": 0, "refused": 1, "failed": 2}  # refused: bad input; failed: anything else

# Names of the dims of the main axes (design page); others are called after their field.
_DIMS = {"rolls.gap": "gap", "rolls.speed": "roll_speed", "feed.top_size": "feed_top_size"}
_BATCH = 32  # cases a task holds at most: dask's cost of about 1 ms per task is then under 1 % of a case's
_BATCH_SECONDS = 2.0  # predicted for a task at most, so that progress shows and little is lost with a worker


class Case(NamedTuple):
    """One scene to run: where its result belongs, and the values that make it."""

    index: tuple[int, ...]
    values: dict[str, Any]
    replicate: int


class Outcome(NamedTuple):
    """What became of a case: its summary by variable name and the limits it hit, or why there is none."""

    index: tuple[int, ...]
    status: str
    message: str
    summary: dict[str, tuple[tuple[str, ...], np.ndarray]]
    notes: str = ""


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
) -> "xr.Dataset":
    """Run `scene` at every combination of `axes`, and return the summaries as one Dataset.

    Parameters
    ----------
    scene : Scene
        Base scene; only its product is recorded.
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
        Whether to show progress on standard error.
    tolerance : float, optional
        Wanted relative error, as in `hpgr.simulate`: every operating point gets a resolution of its own, and
        its estimated errors. Where streamlines differ, variables along them are left out.
    max_cost : float
        Predicted seconds that meeting the tolerance may take at an operating point.

    Returns
    -------
    xarray.Dataset
        Dims: the axes (gap, roll_speed, feed_top_size, or the field's name), replicate, streamline, sieve.
        Every summary variable of `hpgr.simulate`; `status` and `message` of every case. A case that was
        refused or failed holds NaN. Bits do not depend on threads, workers or order.

    Raises
    ------
    ValueError
        If an axis is no scene field, has no or doubled values, or a value that its field refuses.

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
    refuse_key("seed", seed)
    for name, value in {"replicates": replicates, "threads": threads}.items():
        if value < 1:
            raise ValueError(f"{name}: got {value}; must be at least 1; such as {name}=2")
    base = scene.with_values({"resolution.record": "product"})
    cases = list(enumerate_cases(grid, replicates))
    outcomes = _outcomes((base, seed, tolerance, max_cost), cases, client, threads, progress)
    result = _assemble(base, grid, replicates, seed, outcomes)
    return result if tolerance is None else result.assign_attrs(tolerance=tolerance)


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


def dim_of(name: str) -> str:
    """Return the name of the dimension that a scene field has in a sweep."""
    section, _, key = name.partition(".")
    return _DIMS.get(name) or (key if section in {"material", "resolution"} else f"{section}_{key}")


class Bench:
    """Runs the cases of a batch one after the other, and keeps what the next may share: scene and loaded bed."""

    def __init__(self, base: Scene, seed: int, tolerance: float | None, max_cost: float):
        self._base, self._seed, self._tolerance, self._max_cost = base, seed, tolerance, max_cost
        self._values: dict[str, Any] | None = None
        self._scene, self._key, self._prepared = base, None, None
        self._chosen: dict[str, float] = {}
        self._room = budget.available_memory()

    def simulate(self, case: Case) -> dict[str, Any]:
        """Return the variables of a case by name, as `hpgr.simulate` would."""
        if case.values != self._values:
            self._scene, self._values = machine.at_operating_gap(self._base.with_values(case.values)), None
            if self._tolerance is not None:
                estimate = tolerances.refine(self._scene, self._tolerance, self._max_cost, self._seed)
                self._scene, self._chosen = machine.at_operating_gap(estimate.scene), estimate.variables()
            budget.refuse_too_large(self._scene, self._room)
            self._values = case.values  # now only: a refused scene must not be taken for the next replicate's
        key = pipeline.bed_key(self._scene)
        if key != self._key:
            self._prepared, self._key = pipeline.prepare(self._scene), key
        return pipeline.crush(self._scene, self._prepared, self._seed, case.replicate) | self._chosen


def run_case(bench: Bench, case: Case) -> Outcome:
    """Simulate one case; whatever happens is told in the outcome, never raised."""
    try:
        values = bench.simulate(case)
        summary = summarise(values)
    except ValidationError as error:
        return Outcome(case.index, "refused", faults_of(error), {})
    except (ValueError, MemoryError) as error:
        return Outcome(case.index, "refused", str(error), {})
    except Exception as error:  # a fault in one case must not lose the others
        return Outcome(case.index, "failed", f"{type(error).__name__}: {error}", {})
    broken = [name for name, (_, value) in summary.items() if not np.isfinite(value).all()]
    if broken:
        return Outcome(case.index, "failed", f"not finite: {', '.join(broken)}", {})
    return Outcome(case.index, "ok", "", summary, values["notes"])


def summarise(values: Mapping[str, Any]) -> dict[str, tuple[tuple[str, ...], np.ndarray]]:
    """Return the variables of a simulation that have neither points nor cells, with their dims."""
    return {
        name: (entry.dims, np.asarray(values[name], entry.dtype))
        for name, entry in (schema.COORDINATES | schema.VARIABLES).items()
        if values.get(name) is not None and not {"point", "cell", "time"} & set(entry.dims)
    }


def _run_batch(bench_of: tuple, cases: list[Case]) -> list[Outcome]:
    bench = Bench(*bench_of)
    return [run_case(bench, case) for case in cases]


def _outcomes(bench_of, cases, client, threads, progress) -> Iterator[Outcome]:
    """Yield the outcome of every case as it comes in, in no particular order."""
    from distributed import Client, LocalCluster, as_completed  # late: importing costs 0.5 s

    if client is None:
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
            Client(cluster) as own,
            _short_turns(),
        ):
            yield from _outcomes(bench_of, cases, own, threads, progress)
        return
    workers = max(1, sum(client.nthreads().values()))
    quick = int(_BATCH_SECONDS / budget.predict(bench_of[0]).seconds)
    size = max(1, min(_BATCH, quick, len(cases) // (4 * workers)))
    if bench_of[2] is not None:  # a tolerance: the replicates of an operating point share its refinement
        size = 1 + max(case.replicate for case in cases)
    batches = [cases[start : start + size] for start in range(0, len(cases), size)]
    futures = client.map(_run_batch, [bench_of] * len(batches), batches, pure=False)
    sent = dict(zip(futures, batches, strict=True))
    with _bar(len(cases), progress) as bar:
        for future in as_completed(futures, raise_errors=False):
            batch = sent.pop(future)
            if future.status == "finished":
                yield from future.result()
            else:
                reason = f"{type(future.exception()).__name__}: {future.exception()}"
                yield from (Outcome(case.index, "failed", reason, {}) for case in batch)
            future.release()
            bar.update(len(batch))


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


def _bar(total: int, progress: bool):
    """Return a progress bar; where no terminal is watching, a plain line every few seconds."""
    from tqdm import tqdm

    if sys.stderr.isatty():
        return tqdm(total=total, unit=" cases", disable=not progress)
    line = "{n_fmt} of {total_fmt} cases, {rate_fmt}, {remaining} left\n"
    return tqdm(total=total, unit=" cases", disable=not progress, bar_format=line, mininterval=5)


def _assemble(base, grid, replicates, seed, outcomes) -> "xr.Dataset":
    """Return one Dataset of all outcomes over the axes and replicates."""
    import xarray as xr

    dims = (*(dim_of(name) for name in grid), "replicate")
    shape = (*(len(values) for values in grid.values()), replicates)
    status = np.full(shape, STATUS["failed"], np.int8)
    messages, notes = np.full(shape, "", object), np.full(shape, "", object)
    stacks: dict[str, tuple[tuple[str, ...], np.ndarray]] = {}
    uneven: set[str] = set()
    for outcome in outcomes:
        status[outcome.index] = STATUS[outcome.status]
        messages[outcome.index], notes[outcome.index] = outcome.message, outcome.notes
        for name, (own_dims, value) in outcome.summary.items():
            stack = stacks.get(name)
            if stack is None:
                stack = stacks[name] = (own_dims, _blank((*shape, *value.shape), value.dtype))
            if stack[1].shape[len(shape) :] == value.shape:
                stack[1][outcome.index] = value
            else:  # an axis over the number of streamlines or sieves makes it ragged
                uneven.add(name)
    dataset = xr.Dataset(attrs=_attributes(base, grid, replicates, seed, uneven))
    for name, values in grid.items():
        info = field_info(name)
        attrs = {"units": info.unit, "long_name": info.text, "scene_field": name}
        dataset.coords[dim_of(name)] = (dim_of(name), np.array(values), attrs if info.unit else {})
    attrs = {"units": "1", "long_name": "independent repetition", "standard_name": "realization"}
    dataset.coords["replicate"] = ("replicate", np.arange(replicates, dtype=np.int32), attrs)
    for name, (own_dims, stack) in stacks.items():
        if name in uneven:
            continue
        if name in schema.COORDINATES:  # the same for every case that has one
            first = stack.reshape(-1, *stack.shape[len(shape) :])
            first = first[np.isfinite(first).all(axis=1)][0]
            dataset.coords[name] = (own_dims, first, schema.attributes(name))
        else:
            dataset[name] = ((*dims, *own_dims), stack, schema.attributes(name))
    dataset["status"] = (dims, status, {
        "units": "1", "long_name": "what became of the case",
        "flag_values": np.array(list(STATUS.values()), np.int8), "flag_meanings": " ".join(STATUS),
    })  # fmt: skip
    dataset["message"] = (dims, messages, {"long_name": "why a case holds no result"})
    dataset["notes"] = (dims, notes, {"long_name": "which limits a case hit, in words"})
    return dataset


def _blank(shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
    """Return an array of NaN, or of zeros for integers, whose status tells that they are none."""
    return np.full(shape, np.nan if dtype.kind == "f" else 0, dtype)


def _attributes(base, grid, replicates, seed, uneven) -> dict[str, Any]:
    return {
        "Conventions": "CF-1.11",
        "title": "Parametric study of comminution in high pressure grinding rolls",
        "source": f"hpgr {hpgr.__version__}",
        "scene": base.model_dump_json(),
        "axes": ", ".join(grid),
        "seed": seed,
        "replicates": replicates,
        "left_out": ", ".join(sorted(uneven)),
        "level": level_text(base.resolution.level),
        "versions": ", ".join(f"{name} {version(name)}" for name in _LIBRARIES),
    }
