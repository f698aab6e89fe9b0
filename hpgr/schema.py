"""One table of every variable (dims, units, meaning, storage), and the Dataset made by it."""

from typing import Any, NamedTuple

import numpy as np
import xarray as xr


class Variable(NamedTuple):
    """Dims, CF units, long name and storage type of one variable."""

    dims: tuple[str, ...]
    units: str
    long_name: str
    dtype: type = np.float32


_POINT = ("streamline", "point")

COORDINATES = {
    "time": Variable(("time",), "1", "number of the photograph", np.int32),
    "elapsed_time": Variable(("time",), "s", "time of the photograph since the machine was filled", np.float64),
    "steady": Variable(("time",), "1", "whether the photograph was taken after one residence time", np.int8),
    "xi": Variable(
        ("streamline",), "1", "distance from the mid-plane over that of the outermost streamline", np.float64
    ),
    "x": Variable(_POINT, "m", "distance from the mid-plane, across the gap", np.float64),
    "height": Variable(_POINT, "m", "height above the minimum gap", np.float64),
    "residence_time": Variable(_POINT, "s", "time since the first material point", np.float64),
    "sieve": Variable(("sieve",), "m", "sieve size", np.float64),
    "width_position": Variable(
        ("slice",), "1", "distance from the middle of the roll width over half of it", np.float64
    ),
}

VARIABLES = {
    "size": Variable(("time", *_POINT, "cell"), "m", "grain size of the cell"),
    "mass_fraction": Variable(
        ("time", *_POINT, "sieve"), "1", "mass fraction between this sieve and the next finer one"
    ),
    "speed": Variable(_POINT, "m s-1", "speed along the streamline"),
    "volumetric_strain_rate": Variable(_POINT, "s-1", "volumetric strain rate, compaction positive"),
    "shear_strain_rate": Variable(_POINT, "s-1", "triaxial shear strain rate"),
    "volumetric_strain": Variable(_POINT, "1", "volumetric strain since the onset of compaction"),
    "shear_strain": Variable(_POINT, "1", "elastic triaxial shear strain since the onset of compaction"),
    "solid_fraction": Variable(_POINT, "1", "solid fraction"),
    "pressure": Variable(_POINT, "Pa", "mean stress p, compression positive"),
    "shear_stress": Variable(_POINT, "Pa", "triaxial shear stress q"),
    "on_shear_limit": Variable(_POINT, "1", "whether shear beyond the convexity limit was taken as plastic", np.int8),
    "throughput": Variable((), "kg s-1", "solids through the whole gap"),
    "pressing_force": Variable((), "N", "force that presses the rolls on the bed"),
    "specific_pressing_force": Variable((), "Pa", "pressing force over roll diameter times width"),
    "torque": Variable((), "N m", "torque of both drives"),
    "power": Variable((), "W", "power of both drives"),
    "specific_energy": Variable((), "J kg-1", "power over throughput"),
    "specific_throughput": Variable((), "kg m-3", "throughput over roll diameter, width and surface speed"),
    "nip_angle": Variable((), "rad", "roll angle above the minimum gap at which compaction begins"),
    "force_angle": Variable((), "rad", "angle at which the pressing force would take the bed's power"),
    "operating_gap": Variable((), "m", "gap that carries the pressing force"),
    "peak_pressure": Variable((), "Pa", "largest mean stress in the bed"),
    "peak_pressure_height": Variable((), "m", "height of the largest mean stress above the minimum gap"),
    "streamline_peak_pressure": Variable(("streamline",), "Pa", "largest mean stress on the streamline"),
    "streamline_peak_pressure_height": Variable(("streamline",), "m", "height of the streamline's largest mean stress"),
    "continuity_solid_fraction": Variable(
        ("streamline",), "1", "solid fraction that mass continuity would need at the exit"
    ),
    "shear_limit_fraction": Variable((), "1", "fraction of the material points on the shear limit"),
    "passing": Variable(("streamline", "sieve"), "1", "mass fraction of the product passing"),
    "passing_total": Variable(("sieve",), "1", "mass fraction of the product passing, whole gap"),
    "p50": Variable(("streamline",), "m", "product size that 50 % of the mass passes"),
    "p80": Variable(("streamline",), "m", "product size that 80 % of the mass passes"),
    "p50_total": Variable((), "m", "product size that 50 % of the mass passes, whole gap"),
    "p80_total": Variable((), "m", "product size that 80 % of the mass passes, whole gap"),
    "passing_slice": Variable(("slice", "sieve"), "1", "mass fraction of the product of a slice of the width passing"),
    "passing_width_centre": Variable(("sieve",), "1", "mass fraction of the product passing, centre of the roll width"),
    "passing_width_edge": Variable(("sieve",), "1", "mass fraction of the product passing, edge of the roll width"),
    "p50_width_centre": Variable((), "m", "product size that 50 % of the mass passes, centre of the roll width"),
    "p80_width_centre": Variable((), "m", "product size that 80 % of the mass passes, centre of the roll width"),
    "p50_width_edge": Variable((), "m", "product size that 50 % of the mass passes, edge of the roll width"),
    "p80_width_edge": Variable((), "m", "product size that 80 % of the mass passes, edge of the roll width"),
    "breaks_per_cell": Variable(("streamline",), "1", "mean number of breaks of a cell"),
    "below_floor": Variable(("streamline",), "1", "fraction of the product below the size floor, where nothing breaks"),
    "volume": Variable(_POINT, "m2", "area of the Voronoi cell of the material point, volume per roll width"),
    "swaps_per_cell": Variable((), "1", "mean number of swaps of a cell in one residence time"),
    "exchange_passes": Variable((), "1", "most passes a time step of exchange was split into", np.int32),
    "streamlines_used": Variable((), "1", "streamlines chosen for the wanted tolerance", np.int32),
    "points_used": Variable((), "1", "material points per streamline chosen for the wanted tolerance", np.int32),
    "cells_used": Variable((), "1", "cells per material point chosen for the wanted tolerance", np.int32),
    "p80_total_error": Variable((), "1", "estimated relative error of p80_total: bias + 2 standard errors"),
    "fineness_error": Variable((), "1", "estimated relative error of the part below 1 mm: bias + 2 standard errors"),
    "peak_pressure_error": Variable((), "1", "estimated relative error of peak_pressure: bias + 2 standard errors"),
    "flags": Variable((), "1", "limits that were hit", np.int32),
}

ERRORS = {"p80": "p80_total_error", "fineness": "fineness_error", "peak_pressure": "peak_pressure_error"}

FLAGS = {
    "no_breakage": 1,
    "no_compaction": 2,
    "solid_fraction_capped": 4,
    "single_particle_nipping": 8,
    "size_floor_reached": 16,
    "few_cells": 32,
    "tension_clamped": 64,
    "unusual_machine": 128,
    "no_force_angle": 256,
    "no_limit_of_steps": 512,
}


def attributes(name: str) -> dict[str, Any]:
    """Return the CF attributes of a variable or coordinate."""
    entry = VARIABLES.get(name) or COORDINATES[name]
    found: dict[str, Any] = {"units": entry.units, "long_name": entry.long_name}
    if name == "flags":
        found["flag_masks"] = np.array(list(FLAGS.values()), np.int32)
        found["flag_meanings"] = " ".join(FLAGS)
    return found


def to_dataset(values: dict[str, Any], attrs: dict[str, Any]) -> xr.Dataset:
    """Return arrays by name as a labelled Dataset; None is left out.

    Raises
    ------
    KeyError
        If a name is not in the tables of this module.
    """
    made: dict[str, dict[str, Any]] = {"coords": {}, "data": {}}
    for name, value in values.items():
        if value is None:
            continue
        kind, table = ("coords", COORDINATES) if name in COORDINATES else ("data", VARIABLES)
        entry = table[name]
        made[kind][name] = xr.Variable(entry.dims, np.asarray(value, dtype=entry.dtype), attributes(name))
    return xr.Dataset(made["data"], made["coords"], attrs)
