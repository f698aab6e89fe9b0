"""Finished cases on disk: addressed by what decides their bits, checksummed, and shared by drivers.

A folder of cases holds

- `*.seg`: segments, each the records of the cases that finished within about half a second. A segment is written
  under a temporary name, synced, then renamed, so it is there whole or not at all; every record has a checksum.
- `<address>.nc`: a case recorded whole (cells or distributions). Its record in a segment has the file's checksum.
- `lock`: byte-range locks on addresses, by which drivers tell each other what they are computing. The system drops
  the locks of a process that dies.
- `sweep.json`: the grid of the latest sweep that recorded cases whole, for `studies.open_cases`.

A case counts as done if its record is intact, has its address, and the file it names, if any, has the checksum it
tells. Nothing is unpickled.
"""

import fcntl
import functools
import hashlib
import json
import math
import os
import secrets
import struct
import sys
import time
import zlib
from collections.abc import Callable, Iterator, Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from pydantic import BaseModel

import hpgr
from hpgr import schema
from hpgr.scene import Scene
from studies import store
from studies.bench import Job, Outcome

_MAGIC = b"hpgrcase"
_HEAD = struct.Struct("<8sIQ16s")  # magic, bytes of header, bytes of payload, checksum of both; then a CRC of these
_CRC = struct.Struct("<I")  # so that a damaged size is noticed before that many bytes are read
_FLUSH_SECONDS = 0.5  # of work that a killed driver loses at most, beside what it is computing
_FLUSH_BYTES = 8_000_000  # held in memory at most before they are written


class Damaged(ValueError):
    """Bytes that are no intact record."""


# ---- addresses


@functools.cache
def code_version() -> str:
    """Return a hash of all that decides the bits of a case beside its inputs: code, and libraries that compute.

    Every byte of hpgr's modules and data counts, and of the module that sums up a case, so an edited comment
    computes anew: the safe side. Processors are not told apart.
    """
    digest = hashlib.blake2b(digest_size=16)
    package = Path(hpgr.__file__).parent
    sources = [*sorted(package.rglob("*.py")), *sorted(package.rglob("*.csv")), Path(__file__).with_name("bench.py")]
    for path in sources:
        digest.update(f"{path.name} {path.stat().st_size}\n".encode() + path.read_bytes())
    versions = {name: _version(name) for name in ("hpgr", "numpy", "numba", "llvmlite", "scipy", "shapely")}
    digest.update(repr((versions, os.environ.get("NUMBA_DISABLE_JIT", "0"))).encode())
    return digest.hexdigest()


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "unknown"


class Addresses:
    """Addresses of the cases of a job: 32 hex digits of everything that decides their bits.

    That is every field of the case's own scene (its note apart), the seed, the replicate, the tolerance with its
    limit of cost, and `code_version`. What else is in the sweep, and in which order, is not part of it.
    """

    def __init__(self, job: Job):
        self._base = job.base
        self._fields = _flat(job.base)
        asked = (job.tolerance, job.max_cost if job.tolerance is not None else None)
        self._common = repr((job.code or code_version(), job.seed, asked))
        self._values: Mapping[str, Any] | None = None
        self._point = ""

    def of(self, values: Mapping[str, Any], replicate: int) -> str:
        """Return the address of the case of these axis values; cheap for the replicates of one operating point."""
        if values != self._values:
            self._point, self._values = self._text(values), dict(values)
        return hashlib.blake2b(f"{self._point}\n{replicate}".encode(), digest_size=16).hexdigest()

    def _text(self, values: Mapping[str, Any]) -> str:
        # A field that is there already is replaced as `Scene.with_values` would, at a tenth of the cost.
        # The resolution's fields decide about each other (levels), and parts may be absent: there the scene is made.
        if all("." in name and name in self._fields and not name.startswith("resolution.") for name in values):
            fields = self._fields | {name: repr(value) for name, value in values.items()}
        else:
            try:
                fields = _flat(self._base.with_values(values))
            except ValueError:  # refused, and so never kept: any address that is no other's will do
                fields = self._fields | {"refused": repr(values)}
        return f"{self._common}\n" + "\n".join(map("=".join, fields.items()))


def _flat(scene: Scene) -> dict[str, str]:
    """Return every field that decides bits by dotted name, its value as text that tells every bit."""
    flat = {}
    for name in type(scene).model_fields:
        part = getattr(scene, name)
        if isinstance(part, BaseModel):
            flat |= {f"{name}.{key}": repr(value) for key, value in part}
        elif name != "note":
            flat[name] = repr(part)
    return flat


# ---- records


def pack(header: dict[str, Any], arrays: Mapping[str, np.ndarray]) -> bytes:
    """Return a header and arrays as one checksummed record."""
    arrays = {name: np.asarray(value, order="C") for name, value in arrays.items()}
    listed = [[name, value.dtype.newbyteorder("<").str, value.shape] for name, value in arrays.items()]
    text = json.dumps(header | {"arrays": listed}).encode()
    payload = b"".join(value.astype(value.dtype.newbyteorder("<"), copy=False).tobytes() for value in arrays.values())
    head = _HEAD.pack(_MAGIC, len(text), len(payload), _checksum(text, payload))
    return head + _CRC.pack(zlib.crc32(head)) + text + payload


def read_packed(file: BinaryIO) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return header and arrays of the record that begins where `file` stands.

    Raises
    ------
    EOFError
        If the file ends here, or within the record.
    Damaged
        If these bytes are no intact record.
    """
    head, crc = _exactly(file, _HEAD.size), _exactly(file, _CRC.size)
    magic, text_size, payload_size, checksum = _HEAD.unpack(head)
    if magic != _MAGIC or _CRC.unpack(crc) != (zlib.crc32(head),):
        raise Damaged("no record begins here")
    text, payload = _exactly(file, text_size), _exactly(file, payload_size)
    if _checksum(text, payload) != checksum:
        raise Damaged("checksum differs")
    header = json.loads(text)
    arrays, start = {}, 0
    for name, kind, shape in header.pop("arrays"):
        dtype, count = np.dtype(kind), math.prod(shape)
        arrays[name] = np.frombuffer(payload, dtype, count, start).reshape(shape)
        start += dtype.itemsize * count
    return header, arrays


def _exactly(file: BinaryIO, size: int) -> bytes:
    found = file.read(size)
    if len(found) < size:
        raise EOFError("ends within a record" if found else "no further record")
    return found


def _checksum(text: bytes, payload: bytes) -> bytes:
    digest = hashlib.blake2b(text, digest_size=16)
    digest.update(payload)
    return digest.digest()


def pack_outcome(outcome: Outcome, **header: Any) -> bytes:
    """Return an outcome as a record; with its whole variables, unless they are in a file that the header names."""
    told = {"status": outcome.status, "message": outcome.message, "notes": outcome.notes, **header}
    arrays = {name: value for name, (_, value) in outcome.summary.items()}
    if outcome.whole is not None and "file" not in header:
        told["attrs"] = outcome.attrs
        arrays |= {f"whole {name}": value for name, value in outcome.whole.items()}
    return pack(told, arrays)


def outcome_of(header: Mapping[str, Any], arrays: Mapping[str, np.ndarray], index: tuple[int, ...]) -> Outcome:
    """Return the outcome that a record holds."""
    known = schema.COORDINATES | schema.VARIABLES
    summary = {name: (known[name].dims, value) for name, value in arrays.items() if not name.startswith("whole ")}
    whole = {name.partition(" ")[2]: value for name, value in arrays.items() if name.startswith("whole ")}
    return Outcome(
        index, header["status"], header["message"], summary, header["notes"], whole or None, header.get("attrs")
    )


# ---- folders


class Found(NamedTuple):
    """A record that was read from a folder."""

    address: str
    header: dict[str, Any]
    arrays: dict[str, np.ndarray]


def read_folder(
    folder: Path, wanted: Callable[[str], bool], seen: set[str] | None = None, mend: "CaseFolder | None" = None
) -> Iterator[Found]:
    """Yield the intact records of wanted addresses, newest segments first.

    Segments named in `seen` are passed over, and those read are added. What is damaged is told on standard error; if
    `mend` is given, its intact records are saved there and the segment is set aside.
    """
    seen = set() if seen is None else seen
    try:
        names = sorted((entry.name for entry in os.scandir(folder) if entry.name.endswith(".seg")), reverse=True)
    except FileNotFoundError:
        return
    for name in names:
        if name not in seen:
            seen.add(name)
            yield from _read_segment(folder / name, wanted, mend)


def _read_segment(path: Path, wanted: Callable[[str], bool], mend: "CaseFolder | None") -> Iterator[Found]:
    intact: list[bytes] = []
    try:
        with path.open("rb") as file:
            size = os.fstat(file.fileno()).st_size
            while (start := file.tell()) < size:
                header, arrays = read_packed(file)
                if mend is not None:
                    intact.append(_between(file, start))
                address = header["address"]
                if wanted(address) and _file_is_whole(path.parent, header.get("file")):
                    yield Found(address, header, arrays)
    except FileNotFoundError:  # another driver has just set it aside
        return
    except (Damaged, EOFError) as error:
        say(f"{path}: damaged at byte {start:,} of {size:,} ({error}); what it held from there on is computed again")
        if mend is not None:
            mend.set_aside(path, b"".join(intact))


def _between(file: BinaryIO, start: int) -> bytes:
    stop = file.tell()
    file.seek(start)
    return file.read(stop - start)


def _file_is_whole(folder: Path, told: Mapping[str, Any] | None) -> bool:
    """Return whether the file that a record names is there, byte for byte; say so if it is not."""
    if told is None:
        return True
    path = folder / told["name"]
    try:
        whole = file_checksum(path) == told["checksum"]
    except FileNotFoundError:
        whole = False
    if not whole:
        say(f"{path}: missing, damaged or cut short; the case is computed again")
    return whole


def file_checksum(path: Path) -> str:
    """Return the checksum of a file's bytes."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, lambda: hashlib.blake2b(digest_size=16)).hexdigest()


def say(text: str) -> None:
    """Tell the user what must not go unnoticed."""
    print(text, file=sys.stderr)


class CaseFolder:
    """A folder of finished cases that this driver reads and adds to.

    Parameters
    ----------
    folder : Path
        Made if it is not there.
    afresh : bool
        Whether to pass over what is in it already, so that everything is computed again.

    Raises
    ------
    OSError
        If it cannot be written to.
    """

    def __init__(self, folder: str | Path, afresh: bool = False):
        self.folder = Path(folder)
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            self._lock = os.open(self.folder / "lock", os.O_RDWR | os.O_CREAT, 0o666)
        except OSError as error:
            raise OSError(f"could not keep cases in {self.folder}: {error.strerror or error}") from error
        self._seen: set[str] = set()
        self._scanned = -1
        self._held: set[str] = set()
        self._waiting: list[bytes] = []
        self._waiting_bytes, self._waiting_held, self._flushed = 0, set(), time.monotonic()
        if _lock(self._lock, fcntl.F_WRLCK, 0):  # no other driver is here: what is half written is nobody's
            for part in self.folder.glob(".*"):
                part.unlink(missing_ok=True)
        _lock(self._lock, fcntl.F_RDLCK, 0)
        if afresh:
            self._seen |= {path.name for path in self.folder.glob("*.seg")}

    def __enter__(self):
        return self

    def __exit__(self, *_):
        try:
            self.flush()
        finally:
            os.close(self._lock)  # and with it every lock

    def read(self, wanted: Callable[[str], bool]) -> Iterator[Found]:
        """Yield the records of wanted addresses that were not read before; cheap if the folder has not changed."""
        changed = self.folder.stat().st_mtime_ns
        if changed == self._scanned:
            return
        # the clock of files is coarse: a change within the same tick as the look leaves no trace, so look again
        self._scanned = changed if time.time_ns() - changed > 50_000_000 else -1
        yield from read_folder(self.folder, wanted, self._seen, self)

    def claim(self, address: str) -> bool:
        """Return whether the case is now this driver's to compute; False if another driver is at it."""
        if not _lock(self._lock, fcntl.F_WRLCK, _place(address)):
            return False
        self._held.add(address)
        return True

    def release(self, address: str) -> None:
        """Give up a case, which another driver may then compute."""
        if address in self._held:
            self._held.discard(address)
            _lock(self._lock, fcntl.F_UNLCK, _place(address))

    def put(self, address: str, outcome: Outcome, write: Callable[[Path], None] | None = None) -> None:
        """Keep a finished case; it is on disk after the next flush, and released then.

        `write` makes the file of a case that is recorded whole.
        """
        header = {"address": address}
        if write is not None:
            path = self.folder / f"{address}.nc"
            write(path)
            header["file"] = {"name": path.name, "checksum": file_checksum(path)}
        record = pack_outcome(outcome, **header)
        self._waiting.append(record)
        self._waiting_held.add(address)
        self._waiting_bytes += len(record)
        if self._waiting_bytes > _FLUSH_BYTES or time.monotonic() - self._flushed > _FLUSH_SECONDS:
            self.flush()

    def flush(self) -> None:
        """Put on disk what is waiting.

        Raises
        ------
        OSError
            If that fails; what was on disk before is as it was.
        """
        if self._waiting:
            self._write(b"".join(self._waiting))
            self._waiting, self._waiting_bytes = [], 0
        for address in self._waiting_held:
            self.release(address)
        self._waiting_held = set()
        self._flushed = time.monotonic()

    def _write(self, content: bytes) -> None:
        name = f"{time.time_ns():020d}-{secrets.token_hex(4)}.seg"
        try:
            store.replace(self.folder / name, lambda part: part.write_bytes(content))
        except OSError as error:
            raise OSError(f"could not keep finished cases in {self.folder}: {error.strerror or error}") from error
        self._seen.add(name)

    def set_aside(self, path: Path, intact: bytes) -> None:
        """Rename a damaged segment, and keep its intact records in a new one."""
        if intact:
            self._write(intact)
        try:
            path.rename(path.with_suffix(".damaged"))
        except FileNotFoundError:  # another driver was quicker
            return


def _place(address: str) -> int:
    """Return the byte of the lock file that stands for an address; byte 0 stands for the drivers."""
    return 1 + (int(address[:16], 16) >> 2)


def _lock(file: int, kind: int, start: int) -> bool:
    """Lock or unlock one byte; return False if another driver holds it."""
    try:
        if hasattr(fcntl, "F_OFD_SETLK"):  # Linux: the lock belongs to the open file, so threads exclude each other too
            fcntl.fcntl(file, fcntl.F_OFD_SETLK, struct.pack("hhqqi4x", kind, os.SEEK_SET, start, 1, 0))
        else:
            command = {fcntl.F_WRLCK: fcntl.LOCK_EX, fcntl.F_RDLCK: fcntl.LOCK_SH, fcntl.F_UNLCK: fcntl.LOCK_UN}[kind]
            fcntl.lockf(file, command | (0 if command == fcntl.LOCK_UN else fcntl.LOCK_NB), 1, start)
    except (BlockingIOError, PermissionError):
        return False
    return True
