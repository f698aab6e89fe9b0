"""The only writer of files: NetCDF summaries and figures, whole or not at all."""

import os
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import xarray as xr


def write_dataset(dataset: xr.Dataset, path: str | Path) -> None:
    """Write `dataset` as compressed, checksummed NetCDF; the file at `path` is replaced whole or not at all.

    In the file the dimension `time` is called `photograph`: it counts photographs, and CF keeps the other name for
    times since a date.

    Raises
    ------
    OSError
        If it cannot be written; a file that stood at `path` before is left as it was.

    Examples
    --------
    >>> import hpgr
    >>> from studies.store import write_dataset
    >>> dataset = hpgr.simulate(hpgr.presets.paper().with_values({"resolution.cells": 0}))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_dataset(dataset, Path(folder) / "stresses.nc")
    ...     with xr.open_dataset(Path(folder) / "stresses.nc") as read:
    ...         read["pressure"].dims
    ('streamline', 'point')
    """
    if "time" in dataset.dims:
        dataset = dataset.rename(time="photograph")
    encoding = {name: _encoding(variable) for name, variable in dataset.variables.items()}

    def write(part: Path) -> None:
        try:
            dataset.to_netcdf(part, engine="netcdf4", format="NETCDF4", encoding=encoding)
        except RuntimeError as error:  # how the library tells of a full disk
            raise OSError(error) from error

    replace(path, write)


def probe(path: str | Path) -> None:
    """Raise OSError if a file at `path` could not be written: better before hours of work than after."""
    path = Path(path)
    existing = next(folder for folder in path.absolute().parents if folder.exists())
    if not existing.is_dir() or not os.access(existing, os.W_OK):
        raise OSError(
            f"could not write the result: {existing} is no folder that can be written to; choose another --out"
        )
    if path.is_dir():
        raise OSError(f"could not write the result: {path} is a folder; give --out the name of a file")


def replace(path: str | Path, write: Callable[[Path], object]) -> None:
    """Let `write` make a file under a temporary name, then put it in the place of `path`.

    Raises
    ------
    OSError
        If the folder or the file cannot be written; nothing is left behind.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(prefix=f".{path.stem}-", suffix=path.suffix, dir=path.parent)
    os.close(handle)
    part = Path(name)
    try:
        write(part)
        _sync(part)
        part.chmod(0o666 & ~_umask())  # mkstemp makes private files; a result is for others too
        os.replace(part, path)
    except BaseException:
        part.unlink(missing_ok=True)
        raise
    _sync(path.parent)


def _encoding(variable: xr.Variable) -> dict:
    # None: no value of ours means "missing"; NaN does, and is one already
    encoding = {"_FillValue": None} if variable.dtype.kind in "fiu" else {}
    if variable.ndim and variable.dtype.kind in "fiu":
        encoding |= {"zlib": True, "complevel": 1, "shuffle": True, "fletcher32": True}
    if variable.dtype == np.float64 and variable.ndim > 1:
        encoding["dtype"] = "float32"
    return encoding


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
