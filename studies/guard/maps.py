"""Maps for `studies.extremes`: how scenes end over two parameters, and how far each integrator is off."""

import functools
import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from studies import Late
from studies.command import progress_bar
from studies.guard.judge import KINDS, Outcome, base

if TYPE_CHECKING:
    import xarray as xr

run, flags, schema = Late("hpgr.run"), Late("hpgr.results.flags"), Late("hpgr.results.schema")

_INF = math.inf
_FINEST = 6400  # time steps of the bed that errors are measured against
_SETTLED = 0.02  # relative change at most, from half as many steps, of a pressure that has a limit
_STEPS = (5, 10, 20, 40, 80, 160, 320, 640, 1280)
_EXPONENTS = (-0.9, -0.5, -0.25, -0.1, 0.0, 0.1, 0.25, 0.5, 1.0, 2.0, 5.0, 10.0)
INTEGRATORS = ("euler", "increment")
MAPS: dict[str, dict[str, tuple[float, ...]]] = {  # the two fields of each and their values, from low to high
    "gap_speed": {
        "rolls.gap": (0.0, 9e-7, 1e-6, 1e-4, 1e-3, 0.003, 0.01, 0.02, 0.03, 0.04, 0.06, 0.09, 0.2, 0.5, 0.51),
        "rolls.speed": (0.0, 1e-6, 1e-3, 0.1, 1.0, 2.0, 10.0, 1e3, 1e6, 2e6),
    },
    "cushioning_step": {
        "strength.cushioning": (5e-7, 1e-6, 1e-3, 0.03, 0.1, 0.3, 0.5, 1.0, 3.0, 10.0, 1e3, 1e300, _INF),
        "resolution.points": (2, 3, 5, 9, 17, 33, 65, 129),
    },
    "exponent_step": {
        "elasticity.exponent": (-1.5, -1.0, -0.99, *_EXPONENTS, 10.5),
        "resolution.points": (2, 3, 5, 9, 17, 33, 65, 129),
    },
}


def outcome_variables(prefix: str, dims: tuple[str, ...], outcomes: Sequence[Outcome], shape: tuple[int, ...]):
    """Return values, and the table of their variables, of outcome, flags and exchange substeps."""
    meanings = {"flag_values": np.arange(len(KINDS), dtype=np.int8), "flag_meanings": " ".join(KINDS)}
    found = np.array([[KINDS.index(each.kind), each.flags, each.substeps] for each in outcomes]).T.reshape(3, *shape)
    own = {
        f"{prefix}outcome": schema.Variable(dims, "1", "how the scene ended", "", np.int8, meanings),
        f"{prefix}flags": schema.Variable(dims, "1", "limits that were hit", "", np.int32, flags.ATTRIBUTES),
        f"{prefix}substeps": schema.Variable(dims, "1", "exchange substeps per time step", dtype=np.int32),
    }
    return dict(zip(own, found, strict=True)), own


def maps(judge: Callable[..., Outcome], thin: int = 1, progress: bool = False) -> "xr.Dataset":
    """Return every map, of scenes with exchange, taking every `thin`-th value of each axis."""
    import xarray as xr

    thinned = {name: {field: values[::thin] for field, values in axes.items()} for name, axes in MAPS.items()}
    total = sum(math.prod(map(len, axes.values())) for axes in thinned.values())
    with progress_bar(total, progress, "scenes of the maps") as bar:
        found = [_map(name, axes, judge, bar) for name, axes in thinned.items()]
    return xr.merge([*found, _integrators(thin)])


def _map(name: str, axes: dict[str, tuple[float, ...]], judge: Callable[..., Outcome], bar: Any) -> "xr.Dataset":
    dims, shape = tuple(f"{name}_{field.partition('.')[2]}" for field in axes), tuple(map(len, axes.values()))
    outcomes = []
    for place in np.ndindex(shape):
        outcomes.append(judge({"exchange": {}} | {field: axes[field][k] for field, k in zip(axes, place, strict=True)}))
        bar.update()
    values, own = outcome_variables(f"{name}_", dims, outcomes, shape)
    own |= {dim: schema.field_axis(field, dim)._replace(dtype=float) for dim, field in zip(dims, axes, strict=True)}
    return schema.to_dataset(values | dict(zip(dims, axes.values(), strict=True)), {}, own)


def faults(result: "xr.Dataset") -> int:
    """Return how many scenes of the maps ended in a silent fault."""
    return sum(int((result[f"{name}_outcome"].values == KINDS.index("fault")).sum()) for name in MAPS)


def _integrators(thin: int) -> "xr.Dataset":
    """Return the error of each integrator over exponent and time step."""
    exponents, steps = _EXPONENTS[::thin], _STEPS[::thin]
    found = np.array([[_errors(c, count) for count in steps] for c in exponents])  # (exponent, steps, 5)
    dims, about = ("integrator", "exponent", "steps"), "at a point, over the largest pressure"
    own = {
        "integrator": schema.Variable(dims[:1], "", "how stress is integrated", dtype=None),
        "exponent": schema.field_axis("elasticity.exponent", "exponent"),
        "steps": schema.Variable(dims[2:], "1", "time steps per residence time", dtype=None),
        "integrator_error": schema.Variable(dims, "1", "largest error of pressure", about, np.float64),
        "integrator_tension": schema.Variable(dims, "1", "whether tension was held at 0", "or reverse shear", np.int8),
        "integrator_settled": schema.Variable(dims[1:], "1", "whether small time steps have a limit", dtype=np.int8),
    }
    values = {"integrator": INTEGRATORS, "exponent": exponents, "steps": steps}
    error, tension = np.moveaxis(found[..., :4].reshape(*found.shape[:2], 2, 2), (2, 3), (0, 1))
    measured = {"integrator_error": error, "integrator_tension": tension, "integrator_settled": found[..., 4]}
    return schema.to_dataset(values | measured, {}, own)


def _stress(c: float, steps: int, integrator: str) -> Any:
    bed = {"rolls.entry_gap": 1.14, "resolution.points": steps + 1, "resolution.cells": 0}
    return run.load(base({"elasticity.exponent": c, "elasticity.integrator": integrator} | bed))[1].stress


@functools.cache
def _limit(c: float) -> tuple[np.ndarray, bool]:
    """Return the pressure at many time steps, and whether half as many give the same."""
    fine, half = (_stress(c, steps, "increment").pressure for steps in (_FINEST, _FINEST // 2))
    return fine, bool(abs(fine[:, ::2] - half).max() <= _SETTLED * max(fine.max(), 1e-300))


def _errors(c: float, steps: int) -> list[float]:
    """Return the relative error of each integrator, whether each held tension at 0, and whether there is a limit."""
    limit, settled = _limit(c)
    states = [_stress(c, steps, integrator) for integrator in INTEGRATORS]
    away = [abs(state.pressure - limit[:, :: _FINEST // steps]).max() / max(limit.max(), 1e-300) for state in states]
    return [*away, *(state.tension_clamped for state in states), settled]
