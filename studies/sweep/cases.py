"""Finished cases on disk: addressed by what decides their bits, checksummed, and shared by drivers.

A folder of cases holds

- `*.seg`: segments, each the records of the cases that finished within about half a second. A segment is written
  under a temporary name, synced, then renamed, so it is there whole or not at all; every record has a checksum.
- `<address>.nc`: a case recorded whole (cells or distributions). Its record in a segment has the file's checksum.
- `lock`: byte-range locks on addresses, by which drivers tell each other what they are computing. The system drops
  the locks of a process that dies.
- `.hpgr-*.driver`: of each driver at work, who it is, since when, and what it has claimed; touched every second.
- `sweep.json`: the grid of the latest sweep that recorded cases whole, for `studies.open_cases`.

A case counts as done if its record is intact, has its address, and the file of its address, if any, has the checksum
it tells. Nothing is unpickled.
"""

import contextlib
import fcntl
import functools
import hashlib
import json
import math
import os
import secrets
import socket
import struct
import sys
import time
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

import hpgr
from hpgr.results import schema
from studies.sweep import netcdf
from studies.sweep.space import CaseResult, Space, SweepSpec

_MAGIC = b"hpgrcase"
_HEAD = struct.Struct("<8sIQ16s")  # magic, bytes of header, bytes of payload, checksum of both; then a CRC of these
_CRC = struct.Struct("<I")  # so that a damaged size is noticed before that many bytes are read
_FLUSH_SECONDS = 0.5  # of work that a killed driver loses at most, beside what it is computing
_FLUSH_BYTES = 8_000_000  # held in memory at most before they are written
_SIGN_SECONDS = 1.0  # between a driver's signs of life
_SILENT_SECONDS = 60.0  # without a sign after which a driver's cases are taken over; computed twice, they agree


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
    data = (path for path in package.rglob("*") if path.suffix in {".py", ".csv", ".toml"})
    for path in [*sorted(data), Path(__file__).with_name("run.py")]:
        digest.update(f"{path.name} {path.stat().st_size}\n".encode() + path.read_bytes())
    versions = {name: version(name) for name in ("hpgr", "numpy", "numba", "llvmlite", "scipy", "shapely")}
    digest.update(repr((versions, os.environ.get("NUMBA_DISABLE_JIT", "0"))).encode())
    return digest.hexdigest()


class Addresses:
    """Addresses of the cases of a sweep: 32 hex digits of everything that decides their bits.

    That is the case's own scene (its remark apart), the seed, the replicate, the tolerance with its limit of cost,
    and `code_version`. What else is in the sweep, and in which order, is not part of it.
    """

    def __init__(self, spec: SweepSpec):
        self._base = spec.base.with_values({"remark": ""})
        asked = (spec.tolerance, spec.max_cost if spec.tolerance is not None else None)
        self._common = repr((spec.code or code_version(), spec.seed, asked))
        self._values: Mapping[str, Any] | None = None
        self._point = ""

    def of(self, values: Mapping[str, Any], replicate: int) -> str:
        """Return the address of the case of these axis values; cheap for the replicates of one operating point."""
        if values != self._values:
            try:
                self._point = self._base.with_values(values).model_dump_json()
            except ValueError:  # refused, and so never kept: any address that is no other's will do
                self._point = f"refused {values!r} of {self._base.model_dump_json()}"
            self._values = dict(values)
        return hashlib.blake2b(f"{self._common}\n{self._point}\n{replicate}".encode(), digest_size=16).hexdigest()


def finished(spec: SweepSpec, space: Space, folder: Path) -> Counter[tuple[int, ...]]:
    """Return how many replicates of each operating point, by its index, `folder` holds intact; nothing is written."""
    addresses = Addresses(spec)
    cases = {addresses.of(case.values, case.replicate): case.index[:-1] for case in space.cases()}
    return Counter(cases[each] for each in {record.address for record in read_folder(folder, cases.__contains__)})


# ---- records


def pack(header: dict[str, Any], arrays: Mapping[str, np.ndarray]) -> bytes:
    """Return a header and arrays as one checksummed record."""
    arrays = {name: np.asarray(value, order="C") for name, value in arrays.items()}
    listed = [[name, _little(value.dtype).str, value.shape] for name, value in arrays.items()]
    text = json.dumps(header | {"arrays": listed}).encode()
    payload = b"".join(value.astype(_little(value.dtype), copy=False).tobytes() for value in arrays.values())
    head = _HEAD.pack(_MAGIC, len(text), len(payload), _checksum(text, payload))
    return head + _CRC.pack(zlib.crc32(head)) + text + payload


@functools.cache  # making one takes as long as packing a scalar
def _little(dtype: np.dtype) -> np.dtype:
    return dtype.newbyteorder("<")


def read_packed(file: BinaryIO) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return header and arrays of the record that begins where `file` stands.

    EOFError if the file ends here, or within the record; Damaged if these bytes are no intact record.
    """
    head, crc = _exactly(file, _HEAD.size), _exactly(file, _CRC.size)
    magic, text_size, payload_size, checksum = _HEAD.unpack(head)
    if magic != _MAGIC or _CRC.unpack(crc) != (zlib.crc32(head),):
        raise Damaged("no record begins here")
    text, payload = _exactly(file, text_size), _exactly(file, payload_size)
    if _checksum(text, payload) != checksum:
        raise Damaged("checksum differs")
    try:
        return _unpacked(json.loads(text), payload)
    except (ValueError, TypeError, AttributeError, KeyError, RecursionError) as error:  # whole, and not ours
        raise Damaged(f"no record of a case: {error}") from error


def _unpacked(header: dict[str, Any], payload: bytes) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    arrays, start = {}, 0
    for name, kind, shape in header.pop("arrays"):
        dtype, count = np.dtype(kind), math.prod(shape)
        arrays[name] = np.frombuffer(payload, dtype, count, start).reshape(shape)
        start += dtype.itemsize * count
    return header, arrays


def _exactly(file: BinaryIO, size: int) -> bytes:
    try:
        found = file.read(size)
    except (MemoryError, OverflowError):
        raise Damaged(f"tells of {size:,} bytes") from None
    if len(found) < size:
        raise EOFError("ends within a record" if found else "no further record")
    return found


def _checksum(text: bytes, payload: bytes) -> bytes:
    return hashlib.blake2b(text + payload, digest_size=16).digest()


def pack_result(result: CaseResult, **header: Any) -> bytes:
    """Return a case's result as a record; with its whole variables, unless the header tells of their file."""
    told = {"status": result.status, "message": result.message, "diagnostics": result.diagnostics, **header}
    arrays = dict(result.summary)
    if result.whole is not None and "file" not in header:
        told["attrs"] = result.attrs
        arrays |= {f"whole {name}": value for name, value in result.whole.items()}
    return pack(told, arrays)


def result_of(header: Mapping[str, Any], arrays: Mapping[str, np.ndarray], index: tuple[int, ...]) -> CaseResult:
    """Return the result of a case that a record holds."""
    summary = {name: value for name, value in arrays.items() if not name.startswith("whole ")}
    whole = {name.partition(" ")[2]: value for name, value in arrays.items() if name.startswith("whole ")}
    told = (header["status"], header["message"], summary, header["diagnostics"])
    return CaseResult(index, *told, whole or None, header.get("attrs"))


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
                    length = file.tell() - start
                    file.seek(start)
                    intact.append(file.read(length))
                address = header.get("address")
                if wanted(address) and _file_is_whole(path.with_name(f"{address}.nc"), header.get("file")):
                    yield Found(address, header, arrays)
    except FileNotFoundError:  # another driver has just set it aside
        return
    except (Damaged, EOFError) as error:
        say(f"{path}: damaged at byte {start:,} of {size:,} ({error}); what it held from there on is computed again")
        if mend is not None:
            mend.set_aside(path, b"".join(intact))


def _file_is_whole(path: Path, checksum: str | None) -> bool:
    """Return whether the file of a case recorded whole is there, byte for byte; say so if it is not."""
    if checksum is None:
        return True
    try:
        whole = file_checksum(path) == checksum
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


class Driver(NamedTuple):
    """A driver at work in a folder: in words, the cases it has claimed, and seconds since its last sign of life."""

    words: str
    claimed: set[str]
    silence: float


class CaseFolder:
    """A folder of finished cases that this driver reads and adds to, made if it is not there.

    With `recompute` what is in it already is passed over, so that everything is computed again. OSError if it cannot be
    written to.
    """

    def __init__(self, folder: str | Path, recompute: bool = False):
        self.folder = Path(folder)
        self._seen: set[str] = set()
        self._scanned = -1
        self._held: set[str] = set()
        self._waiting: list[bytes] = []
        self._waiting_bytes, self._waiting_held, self._flushed = 0, set(), time.monotonic()
        self._drivers: list[Driver] = []
        self._signed = self._looked = -math.inf
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            self._lock = os.open(self.folder / "lock", os.O_RDWR | os.O_CREAT, 0o666)
            self._enter()
        except OSError as error:
            raise OSError(f"could not keep cases in {self.folder}: {error.strerror or error}") from error
        if recompute:
            self._seen |= {path.name for path in self.folder.glob("*.seg")}

    def _enter(self) -> None:
        """Join the drivers of the folder; if there are none, what is half written is nobody's."""
        if _lock(self._lock, fcntl.F_WRLCK, 0) and not self.folder.is_symlink():
            netcdf.remove_leftovers(self.folder)
        while not _lock(self._lock, fcntl.F_RDLCK, 0):  # another driver is just looking for leftovers
            time.sleep(0.01)
        self._sign = self.folder / netcdf.temporary_name(".driver")
        who = {"host": socket.gethostname(), "process": os.getpid(), "since": time.strftime("%Y-%m-%d %H:%M:%S")}
        self._sign.write_text(json.dumps(who) + "\n", encoding="utf-8")
        self._claims = os.open(self._sign, os.O_WRONLY | os.O_APPEND)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        try:
            self.flush()
        finally:
            os.close(self._claims)
            self._sign.unlink(missing_ok=True)
            os.close(self._lock)  # and with it every lock

    def read(self, wanted: Callable[[str], bool]) -> Iterator[Found]:
        """Yield the records of wanted addresses that were not read before; cheap if the folder has not changed.

        Called again and again, this is also the driver's sign of life, and puts on disk what others may wait for.
        """
        if time.monotonic() - self._flushed > _FLUSH_SECONDS:
            self.flush()
        if time.monotonic() - self._signed > _SIGN_SECONDS:
            self._signed = time.monotonic()
            os.utime(self._sign)
        changed = self.folder.stat().st_mtime_ns
        if changed == self._scanned:
            return
        # the clock of files is coarse: a change within the same tick as the look leaves no trace, so look again
        self._scanned = changed if time.time_ns() - changed > 50_000_000 else -1
        yield from read_folder(self.folder, wanted, self._seen, self)

    def claim(self, address: str) -> bool:
        """Return whether the case is now this driver's to compute; False if a living driver is at it."""
        free = _lock(self._lock, fcntl.F_WRLCK, _place(address))
        if not free and not any(address in one.claimed and one.silence > _SILENT_SECONDS for one in self._look()):
            return False
        self._held.add(address)
        os.write(self._claims, f"{address}\n".encode())
        return True

    def _look(self) -> list[Driver]:
        """Return the other drivers, as they were a second ago at most."""
        if time.monotonic() - self._looked > _SIGN_SECONDS:
            self._looked = time.monotonic()
            os.utime(self._sign)
            now = self._sign.stat().st_mtime  # by the clock of the file system, which drivers share
            signs = (path for path in self.folder.glob(".hpgr-*.driver") if path != self._sign)
            self._drivers = [driver for path in signs if (driver := _driver(path, now)) is not None]
        return self._drivers

    def others(self) -> str:
        """Return in words who else is at work here."""
        return "; ".join(driver.words for driver in self._look()) or "nobody who has left a name"

    def release(self, address: str) -> None:
        """Give up a case, which another driver may then compute."""
        if address in self._held:
            self._held.discard(address)
            _lock(self._lock, fcntl.F_UNLCK, _place(address))

    def put(self, address: str, result: CaseResult) -> None:
        """Keep a finished case, if recorded whole in a file; it is on disk after the next flush, and released then."""
        header = {"address": address}
        if result.whole is not None:
            path = self.folder / f"{address}.nc"
            netcdf.write_dataset(schema.to_dataset(result.whole, result.attrs | header), path)
            header["file"] = file_checksum(path)
        record = pack_result(result, **header)
        self._waiting.append(record)
        self._waiting_held.add(address)
        self._waiting_bytes += len(record)
        if self._waiting_bytes > _FLUSH_BYTES or time.monotonic() - self._flushed > _FLUSH_SECONDS:
            self.flush()

    def flush(self) -> None:
        """Put on disk what is waiting; OSError if that fails; what was on disk before is as it was."""
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
            netcdf.replace(self.folder / name, lambda part: part.write_bytes(content))
        except OSError as error:
            raise OSError(f"could not keep finished cases in {self.folder}: {error.strerror or error}") from error
        self._seen.add(name)

    def set_aside(self, path: Path, intact: bytes) -> None:
        """Rename a damaged segment, and keep its intact records in a new one."""
        if intact:
            self._write(intact)
        with contextlib.suppress(FileNotFoundError):  # another driver was quicker
            path.rename(path.with_suffix(".damaged"))


def _driver(path: Path, now: float) -> Driver | None:
    """Return the driver that gives its signs of life at `path`; None if it has just gone."""
    try:
        first, *claimed = path.read_text(encoding="utf-8").splitlines()
        silence = now - path.stat().st_mtime
        told = json.loads(first)
        words = f"process {told['process']} on {told['host']}, at work since {told['since']}"
    except (OSError, ValueError, TypeError, KeyError, RecursionError):
        return None
    return Driver(f"{words}, last sign of life {max(silence, 0):.0f} s ago", set(claimed), silence)


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
