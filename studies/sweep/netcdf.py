"""The only writer and the only reader of files: written whole or not at all, read as if they were an enemy's."""

import hashlib
import math
import os
import re
import secrets
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import h5py
import netCDF4
import numpy as np
import xarray as xr
from xarray.backends.locks import HDF5_LOCK, NETCDFC_LOCK, combine_locks

_TEMPORARY = re.compile(r"\.hpgr-[0-9a-f]{16}(\.\w+)?")
_SEAL = b"hpgr-blake2b:"  # behind the last byte of a file of ours, where HDF5 looks for nothing; then the checksum
_DIGEST = 16  # bytes
_CLASSIC = {b"CDF\x01", b"CDF\x02", b"CDF\x05"}  # how NetCDF-3 begins; any other start is left to HDF5
_HARMLESS_FILTERS = range(1, 7)  # deflate, shuffle, fletcher32, szip, nbit, scaleoffset
_MOST_ITEMS, _DEEPEST = 10_000, 8  # variables and groups, attributes of each; groups in groups: ours have none
_MOST_TEXTS = 100  # in an attribute: one, stored once, may stand at any number of places
_MOST_BYTES, _MOST_RATIO = 250_000_000, 100  # what a variable may unpack to: this much, or this many times the file


class _LibraryLock:
    """The NetCDF and HDF5 libraries stand no two threads at once, whichever files these are at.

    xarray holds locks of its own while it reads values, but none while it opens a file. Whoever holds this one holds
    those too; the thread that holds it may take it again. In another process it is that process's lock.
    """

    def __init__(self):
        self._own, self._theirs, self._depth = threading.RLock(), combine_locks([NETCDFC_LOCK, HDF5_LOCK]), 0

    def __enter__(self):
        self._own.acquire()
        if self._depth == 0:
            self._theirs.__enter__()
        self._depth += 1

    def __exit__(self, *_):
        self._depth -= 1
        if self._depth == 0:
            self._theirs.__exit__(None, None, None)
        self._own.release()

    def __reduce__(self):
        return "_LIBRARY"


_LIBRARY = _LibraryLock()
# files found harmless, and not changed since, for a look reads them whole; and what the library should take them for
_looked_at: dict[tuple[int, ...], str] = {}


# ---- writing


def write_dataset(dataset: xr.Dataset, path: str | Path) -> None:
    """Write `dataset` as compressed, checksummed NetCDF; the file at `path` is replaced whole or not at all.

    In the file the dimension `time` is called `snapshot`: it counts snapshots, and CF keeps the other name for
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
    >>> from studies.sweep.netcdf import write_dataset
    >>> dataset = hpgr.simulate(hpgr.presets.paper().with_values({"resolution.cells": 0}))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_dataset(dataset, Path(folder) / "stresses.nc")
    ...     with xr.open_dataset(Path(folder) / "stresses.nc") as read:
    ...         read["pressure"].dims
    ('streamline', 'point')
    """
    if "time" in dataset.dims:
        dataset = dataset.rename(time="snapshot")
    encoding = {name: _encoding(variable) for name, variable in dataset.variables.items()}

    def write(part: Path) -> None:
        try:
            dataset.to_netcdf(part, engine="netcdf4", format="NETCDF4", encoding=encoding)
        except RuntimeError as error:  # all that the library says of a full disk is "HDF error"
            _append(part, bytes(1_000_000))  # which a full disk refuses in its own words
            raise OSError(error) from error
        with part.open("rb") as file:
            checksum = _checksum(file, part.stat().st_size)
        _append(part, _SEAL + checksum)

    replace(path, write)


def _encoding(variable: xr.Variable) -> dict:
    # None: no value of ours means "missing"; NaN does, and is one already
    encoding = {"_FillValue": None} if variable.dtype.kind in "fiu" else {}
    if variable.ndim and variable.dtype.kind in "fiu":
        encoding |= {"zlib": True, "complevel": 1, "shuffle": True, "fletcher32": True}
    if variable.dtype == np.float64 and variable.ndim > 1:
        encoding["dtype"] = "float32"
    return encoding


def probe(path: str | Path) -> None:
    """Raise OSError if a file at `path` could not be written: better before hours of work than after."""
    path = Path(path)
    home = next(folder for folder in path.absolute().parents if folder.exists())
    if not home.is_dir() or not os.access(home, os.W_OK):
        raise OSError(f"could not write the result: {home} is no folder that can be written to; choose another --out")
    if path.is_dir():
        raise OSError(f"could not write the result: {path} is a folder; give --out the name of a file")


def temporary_name(suffix: str = "") -> str:
    """Return a name that no other file has, and that `remove_leftovers` knows for ours."""
    return f".hpgr-{secrets.token_hex(8)}{suffix}"


def remove_leftovers(folder: Path) -> None:
    """Remove what killed processes have left half written: regular files of `temporary_name` alone."""
    for entry in os.scandir(folder):
        if _TEMPORARY.fullmatch(entry.name) and entry.is_file(follow_symlinks=False):
            Path(entry.path).unlink(missing_ok=True)


def replace(path: str | Path, write: Callable[[Path], object]) -> None:
    """Let `write` make a file under a temporary name, then put it in the place of `path`.

    OSError if the folder or the file cannot be written; nothing is left behind.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(temporary_name(path.suffix))
    os.close(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666))  # whose mode the umask decides
    try:
        write(part)
        _sync(part)
        os.replace(part, path)
    except BaseException:
        part.unlink(missing_ok=True)
        raise
    _sync(path.parent)


def _append(path: Path, content: bytes) -> None:
    with path.open("ab") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


# ---- reading


def open_result(path: str | Path) -> xr.Dataset:
    """Open a NetCDF file that may be anybody's, lazily.

    Raises
    ------
    ValueError
        If it would have the library read other files, load filters or take more memory than it is worth, or is no
        NetCDF file.
    OSError
        If it cannot be read, or is a file of ours and damaged.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import hpgr
    >>> from studies.sweep.netcdf import open_result, write_dataset
    >>> small = hpgr.presets.paper().with_values({"resolution.cells": 50, "resolution.points": 40})
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_dataset(hpgr.simulate(small), Path(folder) / "one.nc")
    ...     with open_result(Path(folder) / "one.nc") as dataset:
    ...         dataset["p80"].dims
    ('streamline',)
    """
    with _LIBRARY, _opened(path):
        return xr.open_dataset(Path(path).absolute(), engine="netcdf4", lock=_LIBRARY)


def read_variable(path: str | Path, name: str, address: str | None = None) -> np.ndarray:
    """Return one variable of a NetCDF file, looked at as by `open_result`; any number of threads may call this.

    ValueError if the file is foreign or, where an address is given, is not the case with that address; OSError if it
    cannot be read, or its checksums tell of damage.
    """
    with _opened(path) as file:
        if address is not None and getattr(file, "address", None) != address:
            raise ValueError(f"{path}: is not the case that its name tells; run the sweep again")
        if name not in file.variables:
            raise ValueError(f"{path}: has no variable {name!r}; give a file that a study has written")
        file.set_auto_mask(False)
        return np.asarray(file[name][...])


def shapes_in(path: str | Path) -> dict[str, tuple[int, ...]]:
    """Return the shape of every variable of a NetCDF file, looked at as by `open_result`."""
    with _opened(path) as file:
        return {name: variable.shape for name, variable in file.variables.items()}


@contextmanager
def _opened(path: str | Path) -> Iterator[Any]:
    """Open a file by the NetCDF library after a look at what it would make the library do."""
    path = Path(path).absolute()  # the library takes other names for addresses on a network
    looked = _look(path)
    with _LIBRARY:
        try:
            with netCDF4.Dataset(path) as file:
                fault = next(_unlike(file, path, *looked), None)
                if fault is not None:
                    raise ValueError(f"{path}: {fault}; refused unread; only open files that a study has written")
                yield file
        except RuntimeError as error:  # how the library tells of a checksum that differs
            raise OSError(f"{path}: damaged ({error}); run the study again, which computes it anew") from error


def _unlike(file: Any, path: Path, identity: tuple[int, ...], model: str) -> Iterator[str]:
    """Yield how a file that is open is not what it was looked at as, or unpacks to more than it is worth."""
    state = path.stat()
    if _identity(state) != identity or not file.data_model.startswith(model):
        yield "is not what it was a moment ago"
    for name, variable in file.variables.items():
        size = variable.size * np.dtype(variable.dtype).itemsize
        if size > max(_MOST_BYTES, _MOST_RATIO * state.st_size):
            yield f"{name} would unpack to {size:,} bytes from {state.st_size:,}"


def _identity(state: os.stat_result) -> tuple[int, ...]:
    return state.st_dev, state.st_ino, state.st_size, state.st_mtime_ns, state.st_ctime_ns


def _look(path: Path) -> tuple[tuple[int, ...], str]:
    """Return a file's identity and format, after a look for damage and for what no file of ours has.

    HDF5, in which NetCDF-4 is stored, can take values from any file that the reader may read (external storage,
    virtual datasets, external links), and load filters as code; and links in a circle keep its readers for ever.
    Only names and layouts are looked at here, no values. ValueError naming the variable and what is wrong with it, or
    if it is no NetCDF file; OSError if it cannot be read, or its checksum tells of damage.
    """
    identity = _identity(path.stat())
    if identity in _looked_at:
        return identity, _looked_at[identity]
    if not path.is_file():  # a pipe would have its reader wait
        raise ValueError(f"{path}: is no file; give a NetCDF file that a study has written")
    with path.open("rb") as file:
        model = "NETCDF3" if file.read(4) in _CLASSIC else "NETCDF4"
        _refuse_damaged(path, file)
    fault = _fault(path) if model == "NETCDF4" else None  # NetCDF-3 has no such things
    if fault is not None:
        raise ValueError(f"{path}: {fault}; refused unread; only open files whose values are their own")
    if len(_looked_at) > 100_000:
        _looked_at.clear()
    _looked_at[identity] = model
    return identity, model


def _checksum(file: BinaryIO, size: int) -> bytes:
    """Return the checksum of the first `size` bytes of a file."""
    file.seek(0)
    digest = hashlib.blake2b(digest_size=_DIGEST)
    for start in range(0, size, 1 << 20):
        digest.update(file.read(min(size - start, 1 << 20)))
    return digest.digest()


def _refuse_damaged(path: Path, file: BinaryIO) -> None:
    """Raise OSError if a file has a checksum of ours that is not its own."""
    end = os.fstat(file.fileno()).st_size - len(_SEAL) - _DIGEST
    file.seek(max(end, 0))
    sealed = file.read(len(_SEAL)) == _SEAL
    if sealed and file.read() != _checksum(file, end):
        raise OSError(f"{path}: damaged, its checksum differs; run the study again, which computes it anew")


def _fault(path: Path) -> str | None:
    """Return what in an HDF5 file lies elsewhere, or is not to be walked through."""
    with _LIBRARY:
        try:
            with h5py.File(path, "r") as file:
                return next(_faults(file["/"], path.stat().st_size, set(), _DEEPEST), None)
        except (OSError, RuntimeError, KeyError, TypeError, ValueError) as error:
            raise ValueError(f"{path}: cannot be read as NetCDF; it is no such file, or damaged ({error})") from error


def _faults(item: Any, size: int, seen: set, depth: int) -> Iterator[str]:
    """Yield what about an HDF5 group or variable, and in it, is as in no file of ours."""
    place, info = item.name, h5py.h5o.get_info(item.id)
    if (info.fileno, info.addr) in seen:
        yield f"{place} is in two places at once"
    seen.add((info.fileno, info.addr))
    if len(seen) > _MOST_ITEMS or len(item.attrs) > _MOST_ITEMS:
        yield f"{place} is one of more than {_MOST_ITEMS:,} groups, variables or attributes"
    attributes = (item.attrs.get_id(name) for name in item.attrs)
    if any(each.dtype == object and math.prod(each.shape) > _MOST_TEXTS for each in attributes):
        yield f"{place} has an attribute of more than {_MOST_TEXTS} texts"
    if isinstance(item, h5py.Dataset):
        yield from _foreign(place, item.id.get_create_plist())
        if item.dtype == object and _unpacked(item) > max(_MOST_BYTES, _MOST_RATIO * size):
            yield f"{place} would unpack to more than {_MOST_BYTES:,} bytes"
    elif isinstance(item, h5py.Group):
        if depth == 0:
            yield f"{place} is in too many groups"
        for name in item:
            if not isinstance(item.get(name, getlink=True), h5py.HardLink):
                yield f"{place.rstrip('/')}/{name} is a link to another place"
            yield from _faults(item[name], size, seen, depth - 1)


def _unpacked(texts: Any) -> int:
    """Return the bytes of a variable of texts, which may be one in many places; counted until it is too much."""
    total, batch = 0, 1000
    for start in range(0, texts.size, batch):
        places = np.arange(start, min(start + batch, texts.size))
        found, within = np.empty(places.size, texts.dtype), texts.id.get_space()
        if texts.shape:
            within.select_elements(np.stack(np.unravel_index(places, texts.shape), axis=1).astype(np.uint64))
        texts.id.read(h5py.h5s.create_simple(found.shape), within, found)
        total += sum(map(len, found)) + 64 * places.size  # of memory that even nothing takes
        if total > _MOST_BYTES:
            return total
    return total


def _foreign(place: str, plist: Any) -> Iterator[str]:
    """Yield what about the storage of a variable needs other files or code."""
    if plist.get_external_count() or plist.get_layout() == h5py.h5d.VIRTUAL:
        yield f"{place} has its values in other files"
    foreign = [plist.get_filter(k)[0] for k in range(plist.get_nfilters())]
    foreign = [code for code in foreign if code not in _HARMLESS_FILTERS]
    if foreign:
        yield f"{place} needs the filter {foreign[0]}, which is code to be loaded"
