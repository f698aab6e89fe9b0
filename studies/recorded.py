"""Cases recorded whole: one NetCDF file each, and all of them as one lazy Dataset."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hpgr import schema
from hpgr.scene import field_info
from studies import store
from studies.bench import STATUS, Outcome

if TYPE_CHECKING:
    import xarray as xr

_MANIFEST = "sweep.json"
_FORMAT = 1
_IN_FILES = {"time": "photograph"}  # names that differ in files, see `store.write_dataset`


def write_case(outcome: Outcome, address: str, path: Path) -> None:
    """Write every variable of a case as NetCDF.

    Raises
    ------
    OSError
        If it cannot be written; nothing is left behind.
    """
    attrs = {name: value for name, value in outcome.attrs.items() if value is not None}
    store.write_dataset(schema.to_dataset(outcome.whole, attrs | {"address": address}), path)


def write_manifest(
    folder: Path, dims: Sequence[str], axes: Mapping[str, list], replicates: int, addresses: Sequence[str],
    status: np.ndarray, attrs: Mapping[str, Any],
) -> None:  # fmt: skip
    """Write what `open_cases` needs: axes, and the address and status of every case, replicates fastest.

    Raises
    ------
    OSError
        If it cannot be written; the one of an earlier sweep is then left as it was.
    """
    told = {
        "format": _FORMAT, "dims": list(dims), "axes": dict(axes), "replicates": replicates,
        "addresses": list(addresses), "status": status.ravel().tolist(), "attrs": dict(attrs),
    }  # fmt: skip
    store.replace(folder / _MANIFEST, lambda part: part.write_text(json.dumps(told), encoding="utf-8"))


def open_cases(folder: str | Path) -> "xr.Dataset":
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
        If a file cannot be read.

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
    import xarray as xr

    folder = Path(folder)
    told = _manifest(folder)
    shape = (*(len(values) for values in told["axes"].values()), told["replicates"])
    dims, status = (*told["dims"], "replicate"), np.array(told["status"], np.int8).reshape(shape)
    paths = [
        str(folder / f"{address}.nc") if code == STATUS["ok"] else ""
        for address, code in zip(told["addresses"], told["status"], strict=True)
    ]
    found = xr.Dataset(attrs=told["attrs"])
    for (field, values), dim in zip(told["axes"].items(), told["dims"], strict=True):
        info = field_info(field)
        found.coords[dim] = (dim, np.array(values), {"units": info.unit, "long_name": info.text, "scene_field": field})
    found.coords["replicate"] = ("replicate", np.arange(told["replicates"], dtype=np.int32))
    found["status"] = (dims, status, status_attributes())
    first = next((path for path in paths if path), None)
    if first is None:
        return found
    same_grid = not any(name.startswith(("resolution.", "exchange.")) or "." not in name for name in told["axes"])
    shapes = _shapes([first] if same_grid else [path for path in paths if path])
    left_out = sorted(name for name, sizes in shapes.items() if sizes is None)
    files = _files(np.array(paths, object).reshape(shape))
    for name in (name for name in shapes if name not in left_out):
        entry = schema.COORDINATES.get(name) or schema.VARIABLES[name]
        variable = ((*dims, *entry.dims), _lazy(files, name, shapes[name], np.dtype(entry.dtype)))
        if name in ("xi", "sieve", "time"):  # the same for every case
            values = store.read_variable(first, _IN_FILES.get(name, name))
            found.coords[name] = (entry.dims, values, schema.attributes(name))
        elif name in schema.COORDINATES:
            found.coords[name] = (*variable, schema.attributes(name))
        else:
            found[name] = (*variable, schema.attributes(name))
    return found.assign_attrs(left_out=", ".join(left_out))


def status_attributes() -> dict[str, Any]:
    """Return the CF attributes of the status of cases."""
    return {
        "units": "1", "long_name": "what became of the case",
        "flag_values": np.array(list(STATUS.values()), np.int8), "flag_meanings": " ".join(STATUS),
    }  # fmt: skip


def _manifest(folder: Path) -> dict[str, Any]:
    try:
        told = json.loads((folder / _MANIFEST).read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ValueError(
            f"{folder}: holds no cases recorded whole; sweep with record='distributions' or 'cells' first"
        ) from None
    except ValueError as error:
        raise ValueError(
            f"{folder / _MANIFEST}: damaged ({error}); run the sweep again, which writes it anew"
        ) from None
    if told.get("format") != _FORMAT:
        raise ValueError(f"{folder / _MANIFEST}: format {told.get('format')!r} is not known; must be {_FORMAT}")
    return told


def _shapes(paths: list[str]) -> dict[str, tuple[int, ...] | None]:
    """Return the shape of every variable, or None if the files differ in it."""
    shapes: dict[str, tuple[int, ...] | None] = {}
    for path in paths:
        for name, shape in store.shapes_in(path).items():
            name = {stored: own for own, stored in _IN_FILES.items()}.get(name, name)
            if name in schema.COORDINATES or name in schema.VARIABLES:
                shapes[name] = shape if shapes.get(name, shape) == shape else None
    return shapes


def _files(paths: np.ndarray):
    """Return the paths as a dask array of one chunk each."""
    import dask.array as da

    return da.from_array(paths, chunks=1)


def _lazy(files, name: str, shape: tuple[int, ...], dtype: np.dtype):
    """Return a variable of all cases as a dask array, one chunk per case."""
    import dask.array as da

    axes = list(range(files.ndim, files.ndim + len(shape)))
    chunks = files.chunks + tuple((size,) for size in shape)
    meta = np.empty((0,) * (files.ndim + len(shape)), dtype)
    return da.map_blocks(_read, files, name, shape, dtype, chunks=chunks, new_axis=axes, dtype=dtype, meta=meta)


def _read(path: np.ndarray, name: str, shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
    """Return one variable of one case, or blanks for a case without a result."""
    lead = (1,) * path.ndim
    [path] = path.ravel().tolist()
    if not path:
        return np.full((*lead, *shape), np.nan if dtype.kind == "f" else 0, dtype)
    return store.read_variable(path, name, address=Path(path).stem).astype(dtype, copy=False).reshape(*lead, *shape)
