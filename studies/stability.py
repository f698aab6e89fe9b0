"""Maps for `studies.extremes`: how scenes end over two parameters, and how far each integrator is off."""

import functools
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

from hpgr.scene import field_info
from studies import extremes
from studies.progress import progress_bar

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
        Axis("material.cushioning", (5e-7, 1e-6, 1e-3, 0.03, 0.1, 0.3, 0.5, 1.0, 3.0, 10.0, 1e3, 1e300, _INF)),
        _STEP_AXIS,
    ),
    "exponent_step": (
        Axis("material.elastic_exponent", (-1.5, -1.0, -0.99, *_EXPONENTS, 10.5)),
        _STEP_AXIS,
    ),
}


def maps(judge: Callable[..., "extremes.Outcome"], thin: int = 1, progress: bool = False) -> "xr.Dataset":
    """Return every map, of scenes with exchange, taking every `thin`-th value of each axis.

    Parameters
    ----------
    judge : callable
        Values of a scene -> how it ends; `studies.extremes.judge`.
    thin : int
        Step through the values of an axis.
    progress : bool
        Whether to show how far it is.
    """
    import numpy as np
    import xarray as xr

    from hpgr import schema

    thinned = {name: [axis._replace(values=axis.values[::thin]) for axis in axes] for name, axes in MAPS.items()}
    result = xr.Dataset(attrs={"title": "Numerical extremes: outcomes and stability maps", "Conventions": "CF-1.11"})
    total = sum(math.prod(len(axis.values) for axis in axes) for axes in thinned.values())
    with progress_bar(total, progress, "scenes of the maps") as bar:
        for name, axes in thinned.items():
            dims = [f"{name}_{axis.field.partition('.')[2]}" for axis in axes]
            shape = tuple(len(axis.values) for axis in axes)
            found = np.empty(shape, dtype=object)
            for place in np.ndindex(shape):
                values = {axis.field: axis.values[k] for axis, k in zip(axes, place, strict=True)}
                found[place] = judge({"exchange": {}, **values})
                bar.update()
            for dim, axis in zip(dims, axes, strict=True):
                info = field_info(axis.field)
                words = {"units": info.unit, "long_name": info.text, "scene_field": axis.field}
                result.coords[dim] = (dim, np.array(axis.values, float), words)
            kinds = np.vectorize(lambda each: extremes.KINDS.index(each.kind), otypes=[np.int8])(found)
            result[f"{name}_outcome"] = (dims, kinds, extremes.meanings())
            flags = np.vectorize(lambda each: each.flags, otypes=[np.int32])(found)
            result[f"{name}_flags"] = (dims, flags, schema.attributes("flags"))
            passes = np.vectorize(lambda each: each.passes, otypes=[np.int32])(found)
            result[f"{name}_passes"] = (dims, passes, {"units": "1", "long_name": "exchange passes per time step"})
    _add_integrators(result, thin)
    return result


def faults(result: "xr.Dataset") -> int:
    """Return how many scenes of the maps ended in a silent fault."""
    wrong = extremes.KINDS.index("fault")
    return sum(int((result[f"{name}_outcome"].values == wrong).sum()) for name in MAPS)


def _add_integrators(result: "xr.Dataset", thin: int) -> None:
    """Add the error of each integrator over exponent and time step, and over exponent and entry gap (strain)."""
    import numpy as np

    exponents, steps, entries = (_EXPONENTS[::thin], _STEPS[::thin], _ENTRY_GAPS[::thin])
    result.coords["integrator"] = ("integrator", list(INTEGRATORS), {"long_name": "how stress is integrated"})
    words = {"units": "1", "long_name": "elastic exponent c"}
    result.coords["exponent"] = ("exponent", np.array(exponents), words)
    result.coords["steps"] = ("steps", np.array(steps), {"units": "1", "long_name": "time steps per residence time"})
    result.coords["entry_gap"] = ("entry_gap", np.array(entries), {"units": "m", "long_name": "entry gap"})
    result["strain"] = ("entry_gap", [_strain(entry) for entry in entries],
                        {"units": "1", "long_name": "largest volumetric strain at this entry gap"})  # fmt: skip
    for name, axis, values in (("step", "steps", steps), ("strain", "entry_gap", entries)):
        shape = (len(INTEGRATORS), len(exponents), len(values))
        error, flagged = np.empty(shape), np.zeros(shape, np.int8)
        settled = np.zeros(shape[1:], np.int8)
        for j, c in enumerate(exponents):
            for k, value in enumerate(values):
                entry, count = (1.14, value) if axis == "steps" else (value, _HELD_STEPS)
                limit, settled[j, k] = _limit(c, entry)
                for i, integrator in enumerate(INTEGRATORS):
                    error[i, j, k], flagged[i, j, k] = _error(c, entry, count, integrator, limit)
        dims = ("integrator", "exponent", axis)
        result[f"integrator_{name}_error"] = (dims, error, {
            "units": "1", "long_name": "largest error of pressure at a point over the largest pressure"})  # fmt: skip
        result[f"integrator_{name}_tension"] = (dims, flagged, {
            "units": "1", "long_name": "whether tension or reverse shear was held at 0"})  # fmt: skip
        result[f"integrator_{name}_settled"] = (dims[1:], settled, {
            "units": "1", "long_name": "whether the pressure has a limit of small time steps"})  # fmt: skip


def _load(c: float, entry_gap: float, steps: int, integrator: str) -> Any:
    from hpgr import pipeline

    values = {"material.elastic_exponent": c, "rolls.entry_gap": entry_gap, "stress.integrator": integrator,
              "resolution.points": steps + 1, "resolution.cells": 0}  # fmt: skip
    return pipeline.prepare(extremes.base(values)).state


@functools.cache
def _limit(c: float, entry_gap: float) -> tuple["np.ndarray", bool]:
    """Return the pressure at many time steps, and whether half as many give the same."""
    fine, half = (_load(c, entry_gap, steps, "increment").pressure for steps in (_FINEST, _FINEST // 2))
    change = abs(fine[:, ::2] - half).max() / max(fine.max(), 1e-300)
    return fine, bool(change <= _SETTLED)


def _error(c: float, entry_gap: float, steps: int, integrator: str, limit: "np.ndarray") -> tuple[float, bool]:
    """Return the largest error at the points that the limit's bed has too, relative; and whether it was flagged."""
    state = _load(c, entry_gap, steps, integrator)
    error = abs(state.pressure - limit[:, :: _FINEST // steps]).max()
    return float(error / limit.max()) if limit.max() > 0 else 0.0, state.tension_clamped


def _strain(entry_gap: float) -> float:
    return float(_load(0.5, entry_gap, _FINEST, "increment").volumetric_strain.max())
