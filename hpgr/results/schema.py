"""One table of every variable (dims, units, meaning, storage), and the Datasets made by it."""

from collections.abc import Mapping
from functools import cache, lru_cache
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from hpgr import __version__
from hpgr.results import flags
from hpgr.scene import field_info

if TYPE_CHECKING:
    import xarray as xr

_LIBRARIES = ("numpy", "numba", "scipy", "shapely", "xarray", "netCDF4", "dask", "distributed")


class Variable(NamedTuple):
    """Dims, CF attributes and storage type of one variable."""

    dims: tuple[str, ...]  # a sweep puts its own before them
    units: str  # empty for text
    long_name: str  # what it is, short enough for the axis of a plot
    comment: str = ""  # what else a reader should know
    dtype: type | None = np.float32  # None: as the values are
    extra: Mapping[str, Any] = {}  # further CF attributes

    __hash__ = object.__hash__  # as a key it is itself

    def attributes(self) -> dict[str, Any]:
        """Return the CF attributes."""
        given = {"units": self.units, "long_name": self.long_name, "comment": self.comment}
        return {name: text for name, text in given.items() if text} | dict(self.extra)


# refused: bad input; failed: an exception, or a result that is not finite; timeout: longer than allowed;
# worker_lost: its process died
STATUS = {"ok": 0, "refused": 1, "failed": 2, "timeout": 3, "worker_lost": 4}

_LINE, _POINT = ("streamline",), ("streamline", "point")
_WHOLE, _ESTIMATE = "whole gap", "estimated: bias + 2 standard errors"
_STATUS_ATTRIBUTES = {"flag_values": np.array(list(STATUS.values()), np.int8), "flag_meanings": " ".join(STATUS)}

COORDINATES = {
    "time": Variable(("time",), "1", "snapshot number", "snapshots of the steady machine", np.int32),
    "elapsed_time": Variable(("time",), "s", "time since the machine began to fill", dtype=np.float64),
    "steady": Variable(("time",), "1", "whether the snapshot is steady", "its start is forgotten", np.int8),
    "xi": Variable(_LINE, "1", "position of the streamline", "0 mid-plane, 1 roll", np.float64),
    "x": Variable(_POINT, "m", "distance from the mid-plane", "across the gap", np.float64),
    "height": Variable(_POINT, "m", "height above the minimum gap", dtype=np.float64),
    "residence_time": Variable(_POINT, "s", "residence time", "since the first material point", np.float64),
    "sieve": Variable(("sieve",), "m", "sieve size", dtype=np.float64),
    "width_position": Variable(("slice",), "1", "position along the roll width", "0 middle, 1 end", np.float64),
}

VARIABLES = {
    "size": Variable(("time", *_POINT, "cell"), "m", "grain size"),
    "mass_fraction": Variable(("time", *_POINT, "sieve"), "1", "mass fraction retained", "above the next finer sieve"),
    "speed": Variable(_POINT, "m s-1", "speed", "along the streamline"),
    "volumetric_strain_rate": Variable(_POINT, "s-1", "volumetric strain rate", "compaction positive"),
    "shear_strain_rate": Variable(_POINT, "s-1", "shear strain rate", "triaxial"),
    "volumetric_strain": Variable(_POINT, "1", "volumetric strain", "since the onset of compaction"),
    "shear_strain": Variable(_POINT, "1", "elastic shear strain", "triaxial, since the onset of compaction"),
    "solid_fraction": Variable(_POINT, "1", "solid fraction"),
    "pressure": Variable(_POINT, "Pa", "mean stress p", "compression positive; in the middle of the roll width"),
    "shear_stress": Variable(_POINT, "Pa", "shear stress q", "triaxial; in the middle of the roll width"),
    "on_shear_limit": Variable(
        _POINT, "1", "whether on the shear limit", "shear beyond it is taken as plastic", np.int8
    ),
    "throughput": Variable((), "kg s-1", "throughput", "solids through the whole gap"),
    "pressing_force": Variable((), "N", "pressing force", "presses the rolls on the bed"),
    "specific_pressing_force": Variable((), "Pa", "specific pressing force", "over roll diameter times width"),
    "torque": Variable((), "N m", "torque", "of both drives"),
    "power": Variable((), "W", "power", "of both drives"),
    "specific_energy": Variable((), "J kg-1", "specific energy", "power over throughput"),
    "specific_throughput": Variable((), "kg m-3", "specific throughput", "over roll diameter, width and surface speed"),
    "nip_angle": Variable((), "rad", "nip angle", "roll angle above the minimum gap at which compaction begins"),
    "force_angle": Variable((), "rad", "force angle", "at which the pressing force would take the bed's power"),
    "operating_gap": Variable((), "m", "operating gap", "carries the specific pressing force of the scene"),
    "peak_pressure": Variable((), "Pa", "peak pressure", "largest mean stress in the bed"),
    "peak_pressure_height": Variable((), "m", "height of the peak pressure", "above the minimum gap"),
    "streamline_peak_pressure": Variable(_LINE, "Pa", "peak pressure of the streamline", "largest mean stress on it"),
    "streamline_peak_pressure_height": Variable(_LINE, "m", "height of the streamline's peak", "above the minimum gap"),
    "continuity_solid_fraction": Variable(_LINE, "1", "solid fraction by continuity", "that it would need at the exit"),
    "shear_limit_fraction": Variable((), "1", "fraction of points on the shear limit", "of all material points"),
    "passing": Variable(("streamline", "sieve"), "1", "mass fraction passing", "product of the stream tube"),
    "passing_total": Variable(("sieve",), "1", "mass fraction passing", "product of the whole gap"),
    "p50": Variable(_LINE, "m", "product P50", "size that 50 % of the stream tube's product passes"),
    "p80": Variable(_LINE, "m", "product P80", "size that 80 % of the stream tube's product passes"),
    "p50_total": Variable((), "m", f"product P50, {_WHOLE}", "size that 50 % of the mass passes"),
    "p80_total": Variable((), "m", f"product P80, {_WHOLE}", "size that 80 % of the mass passes"),
    "passing_slice": Variable(("slice", "sieve"), "1", "mass fraction passing", "product of the slice"),
    "passing_width_centre": Variable(("sieve",), "1", "mass fraction passing", "centre of the roll width"),
    "passing_width_edge": Variable(("sieve",), "1", "mass fraction passing", "edge of the roll width"),
    "p50_width_centre": Variable((), "m", "centre product P50", "of the centre of the roll width"),
    "p80_width_centre": Variable((), "m", "centre product P80", "of the centre of the roll width"),
    "p50_width_edge": Variable((), "m", "edge product P50", "of the edge of the roll width"),
    "p80_width_edge": Variable((), "m", "edge product P80", "of the edge of the roll width"),
    "breaks_per_cell": Variable(_LINE, "1", "breaks per cell", "mean number"),
    "below_floor": Variable(
        _LINE, "1", "product below the size floor", "mass fraction; nothing breaks below the floor"
    ),
    "volume": Variable(_POINT, "m2", "volume per roll width", "area of the material point's Voronoi cell"),
    "swaps_per_cell": Variable((), "1", "swaps per cell", "mean number in one residence time"),
    "exchange_substeps": Variable((), "1", "exchange substeps", "most that a time step was split into", np.int32),
    "streamlines_used": Variable((), "1", "streamlines used", "chosen for the wanted tolerance", np.int32),
    "points_used": Variable((), "1", "points used", "per streamline, chosen for the wanted tolerance", np.int32),
    "cells_used": Variable((), "1", "cells used", "per material point, chosen for the wanted tolerance", np.int32),
    "p80_total_error": Variable((), "1", "relative error of P80", _ESTIMATE),
    "fineness_error": Variable((), "1", "relative error of the fineness", f"below 1 mm; {_ESTIMATE}"),
    "peak_pressure_error": Variable((), "1", "relative error of the peak pressure", _ESTIMATE),
    "flags": Variable((), "1", "limits that were hit", "in words: diagnostics", np.int32, flags.ATTRIBUTES),
}

# what a sweep adds to each of its cases
SWEEP = {
    "replicate": Variable(
        ("replicate",), "1", "independent repetition", "", np.int32, {"standard_name": "realization"}
    ),
    "status": Variable((), "1", "what became of the case", dtype=np.int8, extra=_STATUS_ATTRIBUTES),
    "message": Variable((), "", "why the case holds no result", dtype=object),
    "diagnostics": Variable((), "", "limits that the case hit, in words", dtype=object),
}

_TABLE = COORDINATES | VARIABLES | SWEEP
ERRORS = {"p80": "p80_total_error", "fineness": "fineness_error", "peak_pressure": "peak_pressure_error"}


def attributes(name: str) -> dict[str, Any]:
    """Return the CF attributes of a variable or coordinate.

    Examples
    --------
    >>> from hpgr.results import schema
    >>> schema.attributes("power")
    {'units': 'W', 'long_name': 'power', 'comment': 'of both drives'}
    """
    return _TABLE[name].attributes()


def field_axis(field: str, dim: str) -> Variable:
    """Return the coordinate that a sweep over the scene field of this dotted name has along `dim`."""
    info = field_info(field)
    return Variable((dim,), info.unit, info.text, dtype=None, extra={"scene_field": field})


def dataset_attributes(title: str, **more: Any) -> dict[str, Any]:
    """Return the attributes of a Dataset with this title: conventions, source and versions, and `more`."""
    return {
        "Conventions": "CF-1.11",
        "title": title,
        "source": f"hpgr {__version__}",
        "versions": ", ".join(f"{name} {_version(name)}" for name in _LIBRARIES),
    } | more


@cache  # asking takes a millisecond
def _version(library: str) -> str:
    try:
        return version(library)
    except PackageNotFoundError:
        return "unknown"


def to_dataset(values: Mapping[str, Any], attrs: Mapping[str, Any], own: Mapping[str, Variable] = {}) -> "xr.Dataset":
    """Return arrays by name as a labelled Dataset, None left out; KeyError if a name is in no table.

    `own` has the variables of a study that no simulation has; one along a dimension of its own name is a coordinate.
    """
    import xarray as xr  # late: 0.4 s that a sweep's cases and a machine's gap need not wait for

    table = {**_TABLE, **own}
    arrays = {name: _stored(value, table[name].dtype) for name, value in values.items() if value is not None}
    axes = {name: (tuple(array.tolist()), array.dtype) for name, array in arrays.items() if table[name].dims == (name,)}
    found = _labels(tuple((name, table[name], arrays[name].shape, axes.get(name)) for name in arrays)).copy()
    variables = found.variables
    for name in arrays.keys() - axes.keys():
        # as a Variable, lest xarray ask whether the array is of dask or pint, whose import takes 0.4 s
        variables[name].data = xr.Variable(table[name].dims, arrays[name], fastpath=True)
    found.attrs.update(attrs)
    return found


@lru_cache(8)  # a copy takes a third of the time
def _labels(known: tuple) -> "xr.Dataset":
    """Return a Dataset whose values are those of its axes alone, given names, variables, shapes and axes."""
    import pandas as pd
    import xarray as xr

    made = {}
    for name, row, shape, axis in known:
        stored = np.broadcast_to(0.0, shape) if axis is None else np.array(*axis)
        if axis is not None and stored.dtype.kind in "if":
            stored.flags.writeable = False  # all copies share it
            made[name] = xr.Variable(row.dims, pd.Index(stored), row.attributes())
        else:
            made[name] = xr.Variable(row.dims, stored, row.attributes(), fastpath=True)
    # all as coordinates first: xr.Dataset(data, coords), which looks for what must be merged, takes a sixth longer
    data = [name for name, row, *_ in known if name not in COORDINATES and name not in row.dims]
    return xr.Coordinates(made).to_dataset().reset_coords(data)


def _stored(value: Any, dtype: type | None) -> Any:
    """Return `value` as an array of its storage type; one of dask stays lazy."""
    return value.astype(dtype or value.dtype) if hasattr(value, "__dask_graph__") else np.asarray(value, dtype)
