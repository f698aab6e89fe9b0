"""Maps for `studies.extremes`: how scenes end over two parameters, and how far each integrator is off."""

import functools
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

from studies.command import progress_bar
from studies.guard.judge import KINDS, Outcome, base

if TYPE_CHECKING:
    import numpy as np
    import xarray as xr

_INF = math.inf
_FINEST = 6400  # time steps of the bed that errors are measured against
_SETTLED = 0.02  # relative change at most, from half as many steps, of a pressure that has a limit
_STEPS = (5, 10, 20, 40, 80, 160, 320, 640, 1280)
_HELD_STEPS = 40  # while strain is varied
_EXPONENTS = (-0.9, -0.5, -0.25, -0.1, 0.0, 0.1, 0.25, 0.5, 1.0, 2.0, 5.0, 10.0)
_ENTRY_GAPS = (0.3, 0.35, 0.4, 0.5, 0.6, 0.8, 1.14, 1.6, 2.2, 3.0)
INTEGRATORS = ("euler", "increment")


class Axis(NamedTuple):
    """One parameter of a map: its field and values, from low to high."""

    field: str
    values: tuple[float, ...]


_STEP_AXIS = Axis("resolution.points", (2, 3, 5, 9, 17, 33, 65, 129))
MAPS = {
    "gap_speed": (
        Axis("rolls.gap", (0.0, 9e-7, 1e-6, 1e-4, 1e-3, 0.003, 0.01, 0.02, 0.03, 0.04, 0.06, 0.09, 0.2, 0.5, 0.51)),
        Axis("rolls.speed", (0.0, 1e-6, 1e-3, 0.1, 1.0, 2.0, 10.0, 1e3, 1e6, 2e6)),
    ),
    "cushioning_step": (
        Axis("strength.cushioning", (5e-7, 1e-6, 1e-3, 0.03, 0.1, 0.3, 0.5, 1.0, 3.0, 10.0, 1e3, 1e300, _INF)),
        _STEP_AXIS,
    ),
    "exponent_step": (
        Axis("elasticity.exponent", (-1.5, -1.0, -0.99, *_EXPONENTS, 10.5)),
        _STEP_AXIS,
    ),
}


def outcome_meanings() -> dict[str, Any]:
    """Return the CF attributes of a variable of outcomes beside unit and name."""
    import numpy as np

    return {"flag_values": np.arange(len(KINDS), dtype=np.int8), "flag_meanings": " ".join(KINDS)}


def maps(judge: Callable[..., Outcome], thin: int = 1, progress: bool = False) -> "xr.Dataset":
    """Return every map, of scenes with exchange, taking every `thin`-th value of each axis.

    Parameters
    ----------
    judge : callable
        Values of a scene -> how it ends; `studies.guard.judge.judge`.
    thin : int
        Step through the values of an axis.
    progress : bool
        Whether to show how far it is.
    """
    import xarray as xr

    thinned = {name: [axis._replace(values=axis.values[::thin]) for axis in axes] for name, axes in MAPS.items()}
    total = sum(math.prod(len(axis.values) for axis in axes) for axes in thinned.values())
    with progress_bar(total, progress, "scenes of the maps") as bar:
        found = [_map(name, axes, judge, bar) for name, axes in thinned.items()]
    return xr.merge([*found, _integrators(thin)])


def _map(name: str, axes: list[Axis], judge: Callable[..., Outcome], bar: Any) -> "xr.Dataset":
    """Return the outcomes over two parameters."""
    import numpy as np

    from hpgr.results import flags, schema

    dims = tuple(f"{name}_{axis.field.partition('.')[2]}" for axis in axes)
    shape = tuple(len(axis.values) for axis in axes)
    outcomes = []
    for place in np.ndindex(shape):
        values = {axis.field: axis.values[k] for axis, k in zip(axes, place, strict=True)}
        outcomes.append(judge({"exchange": {}, **values}))
        bar.update()
    own = {dim: schema.field_axis(axis.field, dim)._replace(dtype=float) for dim, axis in zip(dims, axes, strict=True)}
    own[f"{name}_outcome"] = schema.Variable(dims, "1", "how the scene ended", dtype=np.int8, extra=outcome_meanings())
    own[f"{name}_flags"] = schema.Variable(dims, "1", "limits that were hit", dtype=np.int32, extra=flags.ATTRIBUTES)
    own[f"{name}_substeps"] = schema.Variable(dims, "1", "exchange substeps per time step", dtype=np.int32)
    found = [[KINDS.index(each.kind), each.flags, each.substeps] for each in outcomes]
    kinds, bits, substeps = np.array(found).T.reshape(3, *shape)
    values = {f"{name}_outcome": kinds, f"{name}_flags": bits, f"{name}_substeps": substeps}
    return schema.to_dataset({dim: axis.values for dim, axis in zip(dims, axes, strict=True)} | values, {}, own)


def faults(result: "xr.Dataset") -> int:
    """Return how many scenes of the maps ended in a silent fault."""
    wrong = KINDS.index("fault")
    return sum(int((result[f"{name}_outcome"].values == wrong).sum()) for name in MAPS)


def _integrators(thin: int) -> "xr.Dataset":
    """Return the error of each integrator over exponent and time step, and over exponent and entry gap (strain)."""
    import numpy as np

    from hpgr.results.schema import Variable, field_axis, to_dataset

    exponents, steps, entries = _EXPONENTS[::thin], _STEPS[::thin], _ENTRY_GAPS[::thin]
    own = {
        "integrator": Variable(("integrator",), "", "how stress is integrated", dtype=None),
        "exponent": field_axis("elasticity.exponent", "exponent"),
        "steps": Variable(("steps",), "1", "time steps per residence time", dtype=None),
        "entry_gap": field_axis("rolls.entry_gap", "entry_gap"),
        "strain": Variable(("entry_gap",), "1", "largest volumetric strain", "at this entry gap", dtype=None),
    }
    values: dict[str, Any] = {"integrator": INTEGRATORS, "exponent": exponents, "steps": steps, "entry_gap": entries}
    values["strain"] = [_strain(entry) for entry in entries]
    words = {
        "error": ("largest error of pressure", "at a point, over the largest pressure", np.float64),
        "tension": ("whether tension was held at 0", "or reverse shear", np.int8),
        "settled": ("whether the pressure has a limit of small time steps", "", np.int8),
    }
    for name, axis, along in (
        ("step", "steps", [(1.14, steps_now) for steps_now in steps]),
        ("strain", "entry_gap", [(entry, _HELD_STEPS) for entry in entries]),
    ):
        found = np.array([[_errors(c, *place) for place in along] for c in exponents])  # (c, along, 5)
        values[f"integrator_{name}_error"] = np.moveaxis(found[..., 0:2], -1, 0)
        values[f"integrator_{name}_tension"] = np.moveaxis(found[..., 2:4], -1, 0)
        values[f"integrator_{name}_settled"] = found[..., 4]
        for key, entry in words.items():
            dims = ("integrator", "exponent", axis) if key != "settled" else ("exponent", axis)
            own[f"integrator_{name}_{key}"] = Variable(dims, "1", *entry)
    return to_dataset(values, {}, own)


def _stress(c: float, entry_gap: float, steps: int, integrator: str) -> Any:
    from hpgr import run

    values = {
        "elasticity.exponent": c,
        "rolls.entry_gap": entry_gap,
        "elasticity.integrator": integrator,
        "resolution.points": steps + 1,
        "resolution.cells": 0,
    }
    return run.load(base(values))[1].stress


@functools.cache
def _limit(c: float, entry_gap: float) -> tuple["np.ndarray", bool]:
    """Return the pressure at many time steps, and whether half as many give the same."""
    fine, half = (_stress(c, entry_gap, steps, "increment").pressure for steps in (_FINEST, _FINEST // 2))
    change = abs(fine[:, ::2] - half).max() / max(fine.max(), 1e-300)
    return fine, bool(change <= _SETTLED)


def _errors(c: float, entry_gap: float, steps: int) -> list[float]:
    """Return the largest error of each integrator at the points that the limit's bed has too, relative; whether each
    held tension at 0; and whether there is a limit.
    """
    limit, settled = _limit(c, entry_gap)
    states = [_stress(c, entry_gap, steps, integrator) for integrator in INTEGRATORS]
    away = [abs(state.pressure - limit[:, :: _FINEST // steps]).max() / max(limit.max(), 1e-300) for state in states]
    return [*away, *(state.tension_clamped for state in states), settled]


def _strain(entry_gap: float) -> float:
    return float(_stress(0.5, entry_gap, _FINEST, "increment").volumetric_strain.max())
