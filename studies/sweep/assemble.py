"""Results of cases -> one labelled Dataset: of summaries as they come in, and of cases recorded whole, lazily."""

import hashlib
import json
import re
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from hpgr.fields import path_of
from hpgr.results import metrics, schema
from hpgr.scene import Scene
from studies.sweep import netcdf
from studies.sweep.run import Plan
from studies.sweep.space import AXES, SCENE, Axis, CaseResult, Space, SweepSpec, dim_of, plain

_MANIFEST = "sweep.json"
_MOST_BYTES = 100_000_000  # of a manifest that is read: two million cases
_FORMAT = 3
_ADDRESS = re.compile("[0-9a-f]{32}")
_IN_FILES = {"time": "snapshot"}  # names that differ in files, see `netcdf.write_dataset`


def assemble(
    spec: SweepSpec, space: Space, results: Iterable[CaseResult], more: Mapping[str, schema.Variable] = {}
) -> xr.Dataset:
    """Return one Dataset of all results over the space, the same whatever their order.

    Variables that no simulation has are in `more`.
    """
    values: dict[str, Any] = {
        "status": np.full(space.shape, schema.STATUS["failed"], np.int8),
        "message": np.full(space.shape, "", object),
        "diagnostics": np.full(space.shape, "", object),
    }
    uneven: set[str] = set()
    for result in results:
        values["status"][result.index] = schema.STATUS[result.status]
        values["message"][result.index], values["diagnostics"][result.index] = result.message, result.diagnostics
        for name, value in result.summary.items():
            if name in schema.COORDINATES:  # the same for every case that has it
                known = values.setdefault(name, value)
            else:
                if name not in values:
                    values[name] = _blank((*space.shape, *value.shape), value.dtype)
                known = values[name][result.index]
                values[name][result.index] = value if known.shape == value.shape else 0
            if known.shape != value.shape:  # an axis over the number of streamlines or sieves makes it ragged
                uneven.add(name)
    attrs = schema.dataset_attributes(
        "Parametric study of comminution in high pressure grinding rolls",
        scene=spec.base.model_dump_json(),
        axes=", ".join(space.fields),
        seed=spec.seed,
        replicates=space.replicates,
        left_out=", ".join(sorted(uneven)),
        level=spec.base.resolution.level(),
    )
    attrs |= {} if spec.tolerance is None else {"tolerance": spec.tolerance}
    if SCENE in space.axes:
        attrs["scenes"] = json.dumps({name: one.model_dump_json() for name, one in space.bases(spec.base).items()})
    order = [*schema.COORDINATES, *more, *schema.VARIABLES, *schema.SWEEP]
    found = {name: values[name] for name in order if name in values and name not in uneven}
    return _labelled(space, found, attrs, more).assign_coords(_held(spec.base, space))


def coordinates(space: Space) -> xr.Dataset:
    """Return a Dataset of the coordinates along the dimensions of a sweep: fields, and what places are called."""
    found = {}
    for dim, axis in space.axes.items():
        if axis.labels is not None:
            found[dim] = xr.Variable((dim,), np.array(axis.labels), {"long_name": f"{dim} number or name"})
        for field in axis.fields:
            entry = schema.field_axis(field, dim)
            found[dim_of(field)] = xr.Variable((dim,), [place[field] for place in axis.places], entry.attributes())
    numbers = np.arange(space.replicates, dtype=np.int32)
    found["replicate"] = xr.Variable(("replicate",), numbers, schema.attributes("replicate"))
    return xr.Dataset(coords=found)


def _labelled(
    space: Space, values: dict[str, Any], attrs: dict[str, Any], more: Mapping[str, schema.Variable] = {}
) -> xr.Dataset:
    """Return arrays over the dimensions of a sweep and those of a simulation as a Dataset."""
    own = {
        name: entry._replace(dims=(*space.dims, *entry.dims))
        for name, entry in {**schema.COORDINATES, **schema.VARIABLES, **schema.SWEEP, **more}.items()
        if name not in space.dims and not _common(name)
    }
    # what a mean over replicates has no sense of is a coordinate, which xarray leaves out of it
    apart = [name for name in (*schema.SWEEP, "flags") if name in values]
    return schema.to_dataset(values, attrs, own).set_coords(apart).assign_coords(coordinates(space).coords)


def _common(name: str) -> bool:
    """Return whether a variable of a simulation is a coordinate that is the same for every case."""
    dims = schema.COORDINATES[name].dims if name in schema.COORDINATES else ("point",)
    return name in dims or not {"point", "time"} & set(dims)


def _held(base: Scene, space: Space) -> dict[str, xr.Variable]:
    """Return what a sweep holds fixed of gap, force, speed and feed top size, as scalar coordinates."""
    first, *others = (_figures(one, space) for one in space.bases(base).values())
    return {
        dim: xr.Variable((), value, schema.field_axis(AXES[dim], dim).attributes())
        for dim, value in first.items()
        if value is not None and AXES[dim] not in space.fields and all(other[dim] == value for other in others)
    }


def _figures(scene: Scene, space: Space) -> dict[str, float | None]:
    """Return gap, force, speed and feed top size of a scene, None where the space or the force decides them."""
    floating = scene.rolls.specific_pressing_force or AXES["press_force"] in space.fields
    fed = any(name.startswith("feed") for name in space.fields)
    return {
        "gap": None if floating else scene.rolls.gap,
        "press_force": scene.rolls.specific_pressing_force,
        "roll_speed": scene.rolls.speed,
        "feed_top_size": None if fed else scene.feed.largest_grain,
    }


def _blank(shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
    """Return an array of NaN, or of zeros for integers, whose status tells that they are none."""
    return np.full(shape, np.nan if dtype.kind == "f" else 0, dtype)


# ---- cases recorded whole


def write_manifest(plan: Plan, result: xr.Dataset) -> None:
    """Write what `open_cases` needs: axes, and the address and status of every case.

    OSError if it cannot be written; the one of an earlier sweep is then left as it was.
    """
    told = {
        "axes": json.loads(json.dumps({dim: axis._asdict() for dim, axis in plan.space.axes.items()}, default=plain)),
        "replicates": plan.space.replicates,
        "addresses": plan.addresses,
        "status": result["status"].values.ravel().tolist(),
        "attrs": {name: value for name, value in result.attrs.items() if name != "left_out"},
    }
    text = json.dumps({"format": _FORMAT, "checksum": _checksum(told), "sweep": told})
    netcdf.replace(plan.kept.folder / _MANIFEST, lambda part: part.write_text(text, encoding="utf-8"))


def _checksum(told: Any) -> str:
    return hashlib.blake2b(json.dumps(told).encode(), digest_size=16).hexdigest()


def open_cases(folder: str | Path) -> xr.Dataset:
    """Open the cases that a sweep has recorded whole, as one lazy Dataset.

    Parameters
    ----------
    folder : path
        Folder of cases of a sweep with record "distributions" or "cells", such as ``outputs/gap_sweep.cases``.

    Returns
    -------
    xarray.Dataset
        Dims: the axes of the latest such sweep, replicate, then those of `hpgr.simulate`. Every variable is a dask
        array with one chunk per case, read when it is needed, one file at a time. A case that holds no result is
        NaN (0 for integers; see `status`). A variable whose shape differs from case to case is left out, and named
        in the attribute `left_out`.

    Raises
    ------
    ValueError
        If the folder has no such sweep, or a file is not the case that its name tells.
    OSError
        If a file cannot be read, or is damaged.

    Examples
    --------
    >>> import tempfile
    >>> import hpgr, studies
    >>> from studies.sweep import sweep
    >>> base = hpgr.presets.paper().with_values({"resolution.cells": 100, "resolution.points": 50})
    >>> folder = tempfile.TemporaryDirectory()
    >>> _ = sweep(base, {"rolls.gap": ["40 mm", "60 mm"]}, record="distributions", folder=folder.name)
    >>> cases = studies.open_cases(folder.name)
    >>> cases["mass_fraction"].chunksizes["gap"]
    (1, 1)
    >>> folder.cleanup()
    """
    folder = path_of("folder", folder)
    told = _manifest(folder / _MANIFEST)
    space = Space({dim: Axis(**axis) for dim, axis in told["axes"].items()}, told["replicates"])
    values: dict[str, Any] = {"status": np.array(told["status"]).reshape(space.shape)}
    paths = [
        str(folder / f"{address}.nc") if code == schema.STATUS["ok"] else ""
        for address, code in zip(told["addresses"], told["status"], strict=True)
    ]
    files = [path for path in paths if path]
    same_grid = SCENE not in space.axes and not any(one.startswith(("resolution", "exchange")) for one in space.fields)
    shapes = _shapes(files[:1] if same_grid else files)
    left_out = sorted(name for name, sizes in shapes.items() if sizes is None)
    lazy = _lazily(np.array(paths, object).reshape(space.shape))
    for name in (name for name in shapes if name not in left_out):
        entry = schema.COORDINATES.get(name) or schema.VARIABLES[name]
        if _common(name):
            values[name] = netcdf.read_variable(files[0], _IN_FILES.get(name, name))
        else:
            values[name] = lazy(name, shapes[name], np.dtype(entry.dtype))
    found = _labelled(space, values, told["attrs"] | {"left_out": ", ".join(left_out)})
    return found.assign_coords(_held(metrics.scene_of(found), space))


def _manifest(path: Path) -> dict[str, Any]:
    """Return what a folder's manifest tells, if it is whole and ours."""
    remedy = "run the sweep again, which writes it anew"
    if not path.is_file():
        raise ValueError(
            f"{path.parent}: holds no cases recorded whole; sweep with record='distributions' or 'cells' first"
        )
    if path.stat().st_size > _MOST_BYTES:
        raise ValueError(f"{path}: has more than {_MOST_BYTES:,} bytes; {remedy}")
    try:
        told = json.loads(path.read_text(encoding="utf-8"))
        if told["format"] != _FORMAT:
            raise ValueError(f"format {told['format']!r} is not known, must be {_FORMAT}")
        if told["checksum"] != _checksum(told["sweep"]):
            raise ValueError("its checksum differs")
        outside = next((each for each in told["sweep"]["addresses"] if not _ADDRESS.fullmatch(each)), None)
        if outside is not None:
            raise ValueError(f"{outside!r} is no address of a case")
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        raise ValueError(f"{path}: damaged ({error}); {remedy}") from None
    return told["sweep"]


def _shapes(paths: list[str]) -> dict[str, tuple[int, ...] | None]:
    """Return the shape of every variable, or None if the files differ in it."""
    shapes: dict[str, tuple[int, ...] | None] = {}
    own = {stored: name for name, stored in _IN_FILES.items()}
    for path in paths:
        for stored, shape in netcdf.shapes_in(path).items():
            name = own.get(stored, stored)
            if name in schema.COORDINATES or name in schema.VARIABLES:
                shapes[name] = shape if shapes.get(name, shape) == shape else None
    return shapes


def _lazily(paths: np.ndarray) -> Callable[[str, tuple[int, ...], np.dtype], Any]:
    """Return what makes of a variable of all cases a dask array, one chunk per case."""
    import dask.array as da

    files = da.from_array(paths, chunks=1)

    def lazy(name: str, shape: tuple[int, ...], dtype: np.dtype) -> Any:
        axes = list(range(files.ndim, files.ndim + len(shape)))
        chunks = files.chunks + tuple((size,) for size in shape)
        meta = np.empty((0,) * (files.ndim + len(shape)), dtype)
        return da.map_blocks(_read, files, name, shape, dtype, chunks=chunks, new_axis=axes, dtype=dtype, meta=meta)

    return lazy


def _read(path: np.ndarray, name: str, shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
    """Return one variable of one case, or blanks for a case without a result."""
    lead = (1,) * path.ndim
    [path] = path.ravel().tolist()
    if not path:
        return _blank((*lead, *shape), dtype)
    found = netcdf.read_variable(path, name, address=Path(path).stem)
    return found.astype(dtype, copy=False).reshape(*lead, *shape)
