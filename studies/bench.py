"""One case of a sweep: what it is, how it is run, and what is told of it. This is what workers run."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from pydantic import ValidationError

import hpgr
from hpgr import budget, machine, pipeline, schema, solve
from hpgr import tolerance as tolerances
from hpgr.scene import Scene, faults_of, level_text

# refused: bad input; failed: an exception, or a result that is not finite; timeout: longer than allowed;
# worker_lost: its process died
STATUS = {"ok": 0, "refused": 1, "failed": 2, "timeout": 3, "worker_lost": 4}

LIBRARIES = ("numpy", "numba", "xarray", "netCDF4", "dask", "distributed", "scipy")  # whose versions results tell


class Job(NamedTuple):
    """What all cases of a sweep have in common.

    Attributes
    ----------
    base : Scene
        Base scene; its `resolution.record` decides whether cases are told whole or in summary.
    seed : int
        Seed of all randomness.
    tolerance, max_cost : float
        As in `hpgr.simulate`.
    timeout : float or None
        Seconds that a case may take; cases then run in a process apart (`studies.isolated`).
    code : str
        `studies.cases.code_version` of the driver; a worker with other code refuses to work.
    """

    base: Scene
    seed: int = 0
    tolerance: float | None = None
    max_cost: float = 60.0
    timeout: float | None = None
    code: str = ""

    @property
    def whole(self) -> bool:
        """Whether cases are told whole: every recorded variable, not only the summary."""
        return self.base.resolution.record != "product"


class Case(NamedTuple):
    """One scene to run: where its result belongs, and the values that make it."""

    index: tuple[int, ...]
    values: dict[str, Any]
    replicate: int


class Outcome(NamedTuple):
    """What became of a case: its summary by variable name and the limits it hit, or why there is none.

    Of a sweep that records more than the product, `whole` has every variable by name, and `attrs` what its file
    says of it.
    """

    index: tuple[int, ...]
    status: str
    message: str
    summary: dict[str, tuple[tuple[str, ...], np.ndarray]]
    notes: str = ""
    whole: dict[str, np.ndarray] | None = None
    attrs: dict[str, Any] | None = None


class Bench:
    """Runs the cases of a batch one after the other, and keeps what the next may share: scene and loaded bed."""

    def __init__(self, job: Job, at_once: int = 1):
        self.job = job
        self.scene = job.base
        self._values: dict[str, Any] | None = None
        self._key, self._prepared = None, None
        self._chosen: dict[str, float] = {}
        self._room = room(at_once)

    def simulate(self, case: Case) -> dict[str, Any]:
        """Return the variables of a case by name, as `hpgr.simulate` would."""
        job = self.job
        if case.values != self._values:
            self.scene, self._values = machine.at_operating_gap(job.base.with_values(case.values)), None
            if job.tolerance is not None:
                estimate = tolerances.refine(self.scene, job.tolerance, job.max_cost, job.seed)
                self.scene, self._chosen = machine.at_operating_gap(estimate.scene), estimate.variables()
            budget.refuse_too_large(self.scene, self._room)
            self._values = case.values  # now only: a refused scene must not be taken for the next replicate's
        key = pipeline.bed_key(self.scene)
        if key != self._key:
            self._prepared, self._key = pipeline.prepare(self.scene), key
        return pipeline.crush(self.scene, self._prepared, job.seed, case.replicate) | self._chosen


def room(at_once: int) -> tuple[int, str]:
    """Return the memory that each of `at_once` cases may count on, and the limit that sets it."""
    available, limit = budget.available_memory()
    shared = f"{limit}, shared by {at_once} cases at once," if at_once > 1 else limit
    return available // at_once, shared


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
    if not bench.job.whole:
        return Outcome(case.index, "ok", "", summary, values["notes"])
    known = schema.COORDINATES | schema.VARIABLES
    whole = {name: np.asarray(values[name], known[name].dtype) for name in known if values.get(name) is not None}
    return Outcome(case.index, "ok", "", summary, values["notes"], whole, _attributes(bench, case, values["notes"]))


def summarise(values: Mapping[str, Any]) -> dict[str, tuple[tuple[str, ...], np.ndarray]]:
    """Return the variables of a simulation that have neither points nor cells, with their dims."""
    return {
        name: (entry.dims, np.asarray(values[name], entry.dtype))
        for name, entry in (schema.COORDINATES | schema.VARIABLES).items()
        if values.get(name) is not None and not {"point", "cell", "time"} & set(entry.dims)
    }


def _attributes(bench: Bench, case: Case, notes: str) -> dict[str, Any]:
    scene = bench.scene
    return {
        "Conventions": "CF-1.11",
        "title": "Comminution in high pressure grinding rolls, heterarchical model: one case of a study",
        "source": f"hpgr {hpgr.__version__}",
        "scene": scene.model_dump_json(),
        "level": level_text(scene.resolution.level),
        "seed": bench.job.seed,
        "replicate": case.replicate,
        "solver": solve.choose(scene),
        "notes": notes,
    }
