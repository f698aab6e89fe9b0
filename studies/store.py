"""The only writer of files: NetCDF summaries and figures, whole or not at all; and a reader that trusts none."""

import os
import tempfile
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import xarray as xr
from xarray.backends.locks import HDF5_LOCK, NETCDFC_LOCK, combine_locks


class _LibraryLock:
    """The NetCDF and HDF5 libraries stand no two threads at once, whichever files these are at.

    xarray holds locks of its own while it reads values, but none while it opens a file. Whoever holds this one holds
    those too; the thread that holds it may take it again. In another process it is that process's lock.
    """

    def __init__(self):
        self._own, self._theirs, self._depth = threading.RLock(), combine_locks([NETCDFC_LOCK, HDF5_LOCK]), 0

    def acquire(self, *arguments, **options):
        self._own.acquire()
        if self._depth == 0:
            self._theirs.__enter__()
        self._depth += 1
        return True

    def release(self):
        self._depth -= 1
        if self._depth == 0:
            self._theirs.__exit__(None, None, None)
        self._own.release()

    def locked(self):
        return self._depth > 0

    def __enter__(self):
        self.acquire()

    def __exit__(self, *_):
        self.release()

    def __reduce__(self):
        return "_LIBRARY"


_LIBRARY = _LibraryLock()
_looked_at: set[tuple[int, ...]] = set()  # files found harmless, and not changed since: a look costs milliseconds
_HARMLESS_FILTERS = {1: "deflate", 2: "shuffle", 3: "fletcher32", 4: "szip", 5: "nbit", 6: "scaleoffset"}


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
    >>> import tempfile
    >>> from pathlib import Path
    >>> import xarray as xr
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


def open_result(path: str | Path) -> xr.Dataset:
    """Open a NetCDF file that may be anybody's, lazily, after `refuse_foreign_storage`.

    Raises
    ------
    ValueError
        If it would have the library read other files or load filters, or is no NetCDF file.
    OSError
        If it cannot be read.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import hpgr
    >>> from studies.store import open_result, write_dataset
    >>> small = hpgr.presets.paper().with_values({"resolution.cells": 50, "resolution.points": 40})
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_dataset(hpgr.simulate(small), Path(folder) / "one.nc")
    ...     with open_result(Path(folder) / "one.nc") as dataset:
    ...         dataset["p80"].dims
    ('streamline',)
    """
    refuse_foreign_storage(path)
    with _LIBRARY:
        return xr.open_dataset(path, engine="netcdf4", lock=_LIBRARY)


def read_variable(path: str | Path, name: str, address: str | None = None) -> np.ndarray:
    """Return one variable of a NetCDF file, after `refuse_foreign_storage`; any number of threads may call this.

    Raises
    ------
    ValueError
        If the file is foreign or, where an address is given, is not the case with that address.
    OSError
        If it cannot be read, or its checksums tell of damage.
    """
    import netCDF4

    refuse_foreign_storage(path)
    with _LIBRARY:
        try:
            with netCDF4.Dataset(path) as file:
                if address is not None and getattr(file, "address", None) != address:
                    raise ValueError(f"{path}: is not the case that its name tells; run the sweep again")
                file.set_auto_mask(False)
                return np.asarray(file[name][...])
        except RuntimeError as error:  # how the library tells of a checksum that differs
            raise OSError(f"{path}: damaged ({error}); run the sweep again, which computes it anew") from error


def shapes_in(path: str | Path) -> dict[str, tuple[int, ...]]:
    """Return the shape of every variable of a NetCDF file, after `refuse_foreign_storage`."""
    import netCDF4

    refuse_foreign_storage(path)
    with _LIBRARY, netCDF4.Dataset(path) as file:
        return {name: variable.shape for name, variable in file.variables.items()}


def refuse_foreign_storage(path: str | Path) -> None:
    """Refuse a NetCDF file whose values lie in other files, or need filters beyond the library's own.

    HDF5, in which NetCDF-4 is stored, can take values from any file that the reader may read (external storage,
    virtual datasets, external links), and load filters as code. Nothing of ours does. Only names and layouts are
    looked at here, no values.

    Raises
    ------
    ValueError
        Naming the variable and what is wrong with it, or if it is no NetCDF file.
    OSError
        If it cannot be read.
    """
    with open(path, "rb") as file:  # and so never an address on a network
        state = os.fstat(file.fileno())
        seen = (state.st_dev, state.st_ino, state.st_size, state.st_mtime_ns, state.st_ctime_ns)
        if seen in _looked_at or file.read(3) == b"CDF":  # NetCDF-3 has no such things
            return
    import h5py

    with _LIBRARY:
        try:
            with h5py.File(path, "r") as file:
                fault = next(_faults(file, set()), None)
        except OSError as error:
            raise ValueError(f"{path}: cannot be read as NetCDF; it is no such file, or damaged ({error})") from error
    if fault is not None:
        raise ValueError(f"{path}: {fault}; refused unread; only open files whose values are their own")
    if len(_looked_at) > 100_000:
        _looked_at.clear()
    _looked_at.add(seen)


def _faults(group, seen: set) -> Iterator[str]:
    """Yield what in an HDF5 group and below it lies elsewhere."""
    import h5py

    for name in group:
        place = f"{group.name.rstrip('/')}/{name}"
        if not isinstance(group.get(name, getlink=True), h5py.HardLink):
            yield f"{place} is a link to another place"
            continue
        item = group[name]
        key = (h5py.h5o.get_info(item.id).fileno, h5py.h5o.get_info(item.id).addr)
        if key in seen:
            continue
        seen.add(key)
        if isinstance(item, h5py.Group):
            yield from _faults(item, seen)
        elif isinstance(item, h5py.Dataset):
            plist = item.id.get_create_plist()
            if plist.get_external_count() or plist.get_layout() == h5py.h5d.VIRTUAL:
                yield f"{place} has its values in other files"
            foreign = [plist.get_filter(k)[0] for k in range(plist.get_nfilters())]
            foreign = [code for code in foreign if code not in _HARMLESS_FILTERS]
            if foreign:
                yield f"{place} needs the filter {foreign[0]}, which is code to be loaded"


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
