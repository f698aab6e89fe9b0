"""Tables as a laboratory hands them over: a sieve analysis, and the two tables of a series of pilot tests.

Columns are separated by commas, semicolons or tabs; without commas between them decimals may have one ("31,5"). Numbers
may carry a % sign. Lines that start with # are comments, unless a mesh number follows.
"""

import csv
import difflib
import itertools
import math
import os
import re
import stat
import warnings
from collections.abc import Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hpgr.fields import parse

_LARGEST, _MOST_LINES, _LONGEST_LINE = 10_000_000, 10_000, 10_000  # bytes, lines, characters of a table
_MOST_FAULTS = 50  # that are told at once
_MOST_RETAINED = 5.0  # percent on the coarsest sieve, up to which the next sieve of the series is added
_SERIES = (1, 1.12, 1.25, 1.4, 1.6, 1.8, 2, 2.24, 2.5, 2.8, 3.15, 3.55, 4, 4.5, 5, 5.6, 6.3, 7.1, 8, 9)  # R20, ISO 3
_FORMAT = 'a sieve table has a column of sizes and one of percent passing, like "size_mm,percent_passing", "31.5,97.6"'
_DECIMALS = "write decimals with a point, or columns apart by semicolons"
_COMMENT = re.compile(r"\s*#(?!\s*\d)")
_DECIMAL_COMMA = re.compile(r"([-+]?\d*),(\d+)(\s*%?)")
_SIZE_HEADER = re.compile(r"size|sieve|aperture|opening|screen|mesh", re.IGNORECASE)
_SIZE = re.compile(r"#?\s*(\d[\d./ e+-]*?|\.\d+)\s*([a-zµμ]*|\")", re.IGNORECASE)  # "1 1/2 in", "#200", "45 um"
_UNITS = {'"': "inch", "in": "inch", "inches": "inch", "micron": "um", "microns": "um", "no": "mesh"}
_NUMBERS = "4 5 6 7 8 10 12 14 16 18 20 25 30 35 40 45 50 60 70 80 100 120 140 170 200 230 270 325 400 450 500 635"
_APERTURES = (
    "4.75 4 3.35 2.8 2.36 2 1.7 1.4 1.18 1 .85 .71 .6 .5 .425 .355 .3 .25 .212 .18 .15 .125 .106 .09 .075 .063 .053 "
    ".045 .038 .032 .025 .02"
)
_MESH = dict(zip(_NUMBERS.split(), map(float, _APERTURES.split()), strict=True))  # ASTM E11, mm


def read_sieve_table(path: str | Path) -> list[tuple[float, float]]:
    """Return rows (size in m, percent passing) of a file, finest sieve first.

    The header names a column of sizes, with its unit ("size_mm", "Aperture [µm]", "mesh": ASTM E11) unless each size
    has one, and a column "passing", or else "retained" or "cumulative retained", in percent or as fractions. Other
    columns are left alone, and rows may stand in any order. If up to 5 % stay on the coarsest sieve, the next sieve of
    the series is added, with a warning.

    Raises
    ------
    OSError
        If the file cannot be opened.
    ValueError
        If the file cannot be read as such a table, naming the line.

    Examples
    --------
    >>> import hpgr
    >>> from hpgr import tables
    >>> rows = tables.read_sieve_table(hpgr.presets.DATA / "khd_porphyry_feed.csv")
    >>> rows[-1]
    (0.045, 100.0)
    """
    (head, header), *body = _lines(path)
    at = next((k for k, name in enumerate(header) if _SIZE_HEADER.search(name)), None)
    words = [(word, k) for word in ("pass", "finer", "retain") for k, name in enumerate(header) if word in name.lower()]
    if at is None or not words:
        lacks = "column of sizes" if at is None else "percent passing or retained"
        raise ValueError(f"{path}: line {head}, header {_short(','.join(header))}: it names no {lacks}; {_FORMAT}")
    unit, of, found = re.findall(r'[a-zµμ]+|"', header[at].lower())[-1], words[0][1], []
    for line, cells in body:
        try:
            if len(cells) != len(header):
                raise ValueError(f"got {len(cells)} cells, the header has {len(header)}; {_DECIMALS}")
            size = 0.0 if cells[at].lower() == "pan" else _metres(cells[at], _UNITS.get(unit, unit))
            found.append(_Row(line, "", {"size": size, "passing": _number(cells[of])}))
        except (ValueError, ArithmeticError) as error:
            raise ValueError(f"{path}: line {line} {_short(','.join(cells))}: {error}; {_FORMAT}") from None
    rows = _passing(found, header[of].lower())
    faults = list(_sieving_faults("the feed", rows, path, "size", ("passing",), 1e3))
    if faults:
        raise ValueError(f"{faults[0]}; {_FORMAT}")
    table = [(row.values["size"], row.values["passing"]) for row in rows]
    return table if table[-1][1] == 100 else [*table, (_next_sieve(path, rows, "size", 1e3), 100.0)]


def _metres(text: str, unit: str) -> float:
    """Return a size in m: a number, a fraction of an inch or a mesh number, with its own unit or the header's."""
    found = _SIZE.fullmatch(text)
    if not found:
        raise ValueError("its size must be a number, a fraction of an inch or a mesh number")
    own = _UNITS.get(found[2].lower(), found[2]) or ("mesh" if text.startswith("#") else unit)
    if own == "mesh" and found[1] not in _MESH:
        raise ValueError(f"its size must be a mesh number of ASTM E11: {', '.join(_MESH)}")
    if _SIZE_HEADER.fullmatch(own) and own != "mesh":
        raise ValueError("name the unit of the sizes in the header")
    if own == "mesh":
        return _MESH[found[1]] * 1e-3
    return sum(float(Fraction(part)) for part in found[1].split()) * parse(f"1 {own}", "m")


def _passing(rows: list["_Row"], name: str) -> list["_Row"]:
    """Return rows of percent passing, finest first and without the pan, of a column of this name."""
    rows = sorted(rows, key=lambda row: row.values["size"])
    values = np.array([row.values["passing"] for row in rows])
    if "retain" in name and "cum" not in name:
        values = np.cumsum(values[::-1])[::-1]
    if values.max(initial=0.0) < 1.01 and not re.search("%|percent|pct", name):  # fractions
        values = 100 * values
    if "retain" in name:
        values = np.clip(np.round(100 - values, 10), 0, 100)
    kept = zip(rows, values.tolist(), strict=True)
    return [row._replace(values=row.values | {"passing": value}) for row, value in kept if row.values["size"] > 0]


def _next_sieve(path: str | Path, rows: list["_Row"], size: str, to_mm: float) -> float:
    """Return the sieve above the coarsest of rows in their series, in their unit, and say that it is added."""
    below, coarsest = (row.values[size] for row in rows[-2:])
    wanted = coarsest**2 / below
    decade = math.floor(math.log10(wanted))
    known = [float(f"{number}e{power}") for power in (decade, decade + 1) for number in _SERIES]
    found = min((one for one in known if one > 1.01 * coarsest), key=lambda one: abs(math.log(one / wanted)))
    said = f"not all of the feed passes the coarsest sieve; the next of the series, {found * to_mm:g} mm, is added"
    warnings.warn(f"{path}: line {rows[-1].line}: {said}", stacklevel=3)
    return found


def _lines(path: str | Path) -> list[tuple[int, list[str]]]:
    """Return (line number, stripped cells) of every line that is neither blank nor a comment; at least one."""
    text = text_of(path)
    kept = [(n, line) for n, line in enumerate(text.splitlines(), start=1) if not _COMMENT.match(line)]
    if max((len(line) for _, line in kept), default=0) > _LONGEST_LINE or len(kept) > _MOST_LINES:
        raise ValueError(
            f"{path}: got {len(kept):,} lines; a table has at most {_MOST_LINES:,} lines of {_LONGEST_LINE:,} "
            "characters; give the table alone"
        )
    first = next((line for _, line in kept if line.strip()), "")
    separator = next((mark for mark in ";\t" if mark in first), ",")
    lines = [(n, [cell.strip() for cell in next(csv.reader([line], delimiter=separator), [])]) for n, line in kept]
    if separator != ",":
        lines = [(n, [_DECIMAL_COMMA.sub(r"\1.\2\3", cell) for cell in cells]) for n, cells in lines]
    lines = [(n, cells) for n, cells in lines if any(cells)]
    if not lines:
        raise ValueError(f"{path}: the table is empty; give a header and rows")
    return lines


def text_of(path: str | Path) -> str:
    """Return the text of a file that is a regular one, not too large, and text.

    OSError if it cannot be opened; ValueError if it is anything else.
    """
    try:
        status = os.stat(path)  # before it is opened: a pipe would make us wait, a device never end
    except OSError as error:
        raise type(error)(error.errno, f"{error.strerror}; give a file that can be read", str(path)) from None
    if not stat.S_ISREG(status.st_mode):
        raise ValueError(f"{path}: is no regular file; it must be one; save it as text")
    with open(path, "rb") as file:
        data = file.read(_LARGEST + 1)
    if len(data) > _LARGEST:
        raise ValueError(f"{path}: got more than {_LARGEST:,} bytes; it must be smaller; give what is asked for alone")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: byte {error.start} is not UTF-8; save it as text in UTF-8") from None
    if "\0" in text:
        raise ValueError(f"{path}: byte {data.index(0)} is 0, which no text has; save it as text in UTF-8")
    return text


def _number(text: str) -> float:
    try:
        value = float(text.rstrip("% "))
    except ValueError:
        raise ValueError("must be a number") from None
    if not math.isfinite(value):
        raise ValueError("must be a finite number")
    return value


def _short(text: str) -> str:
    return repr(text if len(text) <= 60 else f"{text[:57]}...")


class PilotTest(NamedTuple):
    """One steady run of a pilot machine. Arrays are (size,) and read-only; NaN is "not measured".

    `specific_throughput` is throughput / (diameter * width * surface speed).
    """

    name: str
    surface_speed: float  # m s-1
    specific_pressing_force: float  # Pa
    gap: float  # working gap, m
    cake_thickness: float  # flake, m
    throughput: float  # kg s-1
    specific_throughput: float  # kg m-3
    power: float  # W, both rolls
    specific_energy: float  # J kg-1
    hydraulic_pressure: float  # Pa
    moisture: float  # fraction
    diameter: float  # of the rolls, m; NaN of this and the next three: as in the scene
    width: float  # of the rolls, m
    solid_density: float  # kg m-3
    idle_power: float  # of both rolls without feed, W
    cake_density: float  # of the flake as weighed, kg m-3
    sizes: np.ndarray  # sieves, m, rising
    feed: np.ndarray  # fraction passing
    centre: np.ndarray  # fraction of the product from the middle of the rolls passing
    edge: np.ndarray  # fraction of the product from their two ends passing
    total: np.ndarray  # fraction of the whole product passing


class _Column(NamedTuple):
    field: str
    factor: float  # SI units per unit of the column
    required: bool = False
    least: float = 0.0
    open_below: bool = True  # the least itself is refused
    most: float = math.inf

    def bound(self) -> str:
        below = f"must be {'above' if self.open_below else 'at least'} {self.least:g}"
        return below if math.isinf(self.most) else f"{below} and at most {self.most:g}"

    def holds(self, value: float) -> bool:
        return (self.least < value if self.open_below else self.least <= value) and value <= self.most


_OPERATIONS = {
    "U_m_s": _Column("surface_speed", 1.0, required=True),
    "Fsp_N_mm2": _Column("specific_pressing_force", 1e6, required=True),
    "gap_mm": _Column("gap", 1e-3),
    "flake_mm": _Column("cake_thickness", 1e-3),
    "Q_tph": _Column("throughput", 1 / 3.6),
    "mdot": _Column("specific_throughput", 1 / 3.6),  # t s h-1 m-3, as printed
    "P_kW": _Column("power", 1e3),
    "W_kWh_t": _Column("specific_energy", 3600.0),
    "Rp_bar": _Column("hydraulic_pressure", 1e5),
    "moisture_pct": _Column("moisture", 1e-2, open_below=False, most=100.0),
    "D_mm": _Column("diameter", 1e-3),
    "L_mm": _Column("width", 1e-3),
    "solid_t_m3": _Column("solid_density", 1e3),
    "P_idle_kW": _Column("idle_power", 1e3, open_below=False),
    "flake_density_t_m3": _Column("cake_density", 1e3),
}
_PRODUCT = {
    "size_mm": _Column("sizes", 1e-3, required=True),
    "feed": _Column("feed", 1e-2, required=True, open_below=False, most=100.0),
    "centre": _Column("centre", 1e-2, open_below=False, most=100.0),
    "edge": _Column("edge", 1e-2, open_below=False, most=100.0),
    "total": _Column("total", 1e-2, required=True, open_below=False, most=100.0),
}


class _Row(NamedTuple):
    line: int  # in the file, counted from 1
    test: str
    values: dict[str, float]  # by column, as printed; NaN where the cell is empty or was refused


def read_pilot_tests(product: str | Path, operations: str | Path) -> tuple[PilotTest, ...]:
    """Return the tests of two CSV files, in the order of `operations`.

    Parameters
    ----------
    product
        One row per test and sieve: `test`, `size_mm`, and percent passing `feed`, `total` and, where
        measured, `centre` and `edge`.
    operations
        One row per test: `test`, `U_m_s` (surface speed), `Fsp_N_mm2` (specific pressing force) and,
        where measured, `gap_mm`, `flake_mm`, `Q_tph`, `mdot` (t s h-1 m-3), `P_kW` (the whole draw), `P_idle_kW` (that
        without feed), `W_kWh_t`, `Rp_bar`, `moisture_pct`, and of the machine and ore `D_mm`, `L_mm` (roll diameter and
        width), `solid_t_m3`, `flake_density_t_m3`.

    Columns and rows may stand in any order; an empty cell is "not measured"; other columns are refused.
    Lines starting with # are comments. Nothing is derived: a specific energy that is not in the table is
    NaN even where power and throughput are.

    Raises
    ------
    OSError
        If a file cannot be opened.
    ValueError
        If the tables are not such tests: one error that lists every fault with file, line, column, value,
        bound and remedy.

    Examples
    --------
    >>> import hpgr
    >>> from hpgr import tables
    >>> folder = hpgr.presets.DATA
    >>> [first, *_] = tables.read_pilot_tests(folder / "khd_porphyry_psd.csv", folder / "khd_porphyry_operations.csv")
    >>> first.name, first.surface_speed, float(first.total[-1])
    ('K-P1', 0.67, 1.0)
    """
    faults: list[str] = []
    sieves = _grouped(_rows(product, _PRODUCT, faults))
    runs = _grouped(_rows(operations, _OPERATIONS, faults))
    if sieves and runs:
        faults += _lonely_tests(sieves, runs, product, operations)
    for name, rows in sieves.items():
        faults += _sieving_faults(name, rows, product, "size_mm", ("feed", "centre", "edge", "total"), 1.0)
    for name, rows in runs.items():
        faults += [
            f"{operations}: line {row.line}, test: got {name!r} again (first in line {rows[0].line}); "
            "must be one row a test; rename or remove one"
            for row in rows[1:]
        ]
    if faults:
        told = [*faults[:_MOST_FAULTS], *(["..."] if len(faults) > _MOST_FAULTS else [])]
        raise ValueError(f"{len(faults)} fault(s) in the pilot tests:\n" + "\n".join(told))
    return tuple(_pilot_test(name, run, sieves[name], product) for name, [run] in runs.items())


def _rows(path: str | Path, columns: dict[str, _Column], faults: list[str]) -> list[_Row]:
    """Return the rows of a table that name a test; what is wrong in the table is appended to `faults`."""
    try:
        lines = _lines(path)
    except ValueError as error:
        faults.append(str(error))
        return []
    (head, header), *body = lines
    unfit = list(_header_faults(header, columns))
    faults += [f"{path}: line {head}, header: {fault}" for fault in unfit]
    if unfit:
        return []
    if not body:
        faults.append(f"{path}: no rows below the header; give one row per {'test' if 'U_m_s' in columns else 'sieve'}")
    found = (_row(line, header, cells, columns, path, faults) for line, cells in body)
    return [row for row in found if row is not None]


def _header_faults(header: list[str], columns: dict[str, _Column]) -> Iterator[str]:
    known = ["test", *columns]
    for name in dict.fromkeys(header):
        if header.count(name) > 1:
            yield f"got column {name!r} {header.count(name)} times; must be there once; remove the others"
        if name not in known:
            folded = {one.lower(): one for one in known}
            close = difflib.get_close_matches(name.lower(), folded, n=1, cutoff=0.5)
            guess = f"did you mean {folded[close[0]]!r}?" if close else "remove the column"
            yield f"got column {name!r}; must be one of {', '.join(known)}; {guess}"
    for name in known:
        if name not in header and (name == "test" or columns[name].required):
            yield f"column {name!r} is missing; it is required; add it"


def _row(line, header, cells, columns, path, faults) -> _Row | None:
    """Return the row, None if it names no test; what is wrong in it is appended to `faults`."""
    values = dict.fromkeys(columns, math.nan)
    texts = dict(zip(header, cells, strict=False))
    test = texts.pop("test", "")
    if not test:
        faults.append(f"{path}: line {line}, test: got an empty cell; must name the test; fill it in")
    if len(cells) != len(header):
        faults.append(
            f"{path}: line {line}: got {len(cells)} cells; must be {len(header)} as in the header; "
            f"leave cells not measured empty; {_DECIMALS}"
        )
        texts = {}
    for name, text in texts.items():
        try:
            values[name] = _value(text, columns[name])
        except ValueError as error:
            faults.append(f"{path}: line {line}, {name}: got {_short(text) if text else 'an empty cell'}; {error}")
    return _Row(line, test, values) if test else None


def _value(text: str, column: _Column) -> float:
    """Return the number in a cell, NaN where an optional cell is empty."""
    if not text:
        if column.required:
            raise ValueError("must be a number; fill it in or remove the row")
        return math.nan
    try:
        value = _number(text)
    except ValueError as error:
        raise ValueError(f"{error}; leave the cell empty if not measured") from None
    if not column.holds(value):
        raise ValueError(f"{column.bound()}; correct the cell")
    return value


def _grouped(rows: list[_Row]) -> dict[str, list[_Row]]:
    groups: dict[str, list[_Row]] = {}
    for row in rows:
        groups.setdefault(row.test, []).append(row)
    return groups


def _lonely_tests(sieves, runs, product, operations) -> Iterator[str]:
    for name in (name for name in sieves if name not in runs):
        yield f"{operations}: test {name!r} of {product} is missing; every test must be in both files; add its row"
    for name in (name for name in runs if name not in sieves):
        yield f"{product}: test {name!r} of {operations} is missing; every test must be in both files; add its sieves"


def _sieving_faults(
    name: str, rows: list[_Row], path: str | Path, size: str, columns: Sequence[str], to_mm: float
) -> Iterator[str]:
    """Yield why the rows of one test are not size distributions."""
    if len(rows) < 2:
        where = f"{path}: line {rows[0].line}, test" if rows else str(path)
        yield f"{where}: got {len(rows) or 'no'} sieve for {name}; must be at least two; add sieves"
        return
    rows = sorted((row for row in rows if row.values[size] > 0), key=lambda row: row.values[size])
    for finer, coarser in itertools.pairwise(rows):
        if finer.values[size] == coarser.values[size]:
            yield (
                f"{path}: line {coarser.line}, {size}: got {coarser.values[size] * to_mm:g} mm twice for {name} "
                f"(also in line {finer.line}); must differ from sieve to sieve; remove one"
            )
    for column in columns:
        measured = [row for row in rows if not math.isnan(row.values[column])]
        for finer, coarser in itertools.pairwise(measured):
            if coarser.values[column] < finer.values[column]:
                yield (
                    f"{path}: line {coarser.line}, {column}: got {coarser.values[column]:g} % at "
                    f"{coarser.values[size] * to_mm:g} mm in {name}; must not be below the "
                    f"{finer.values[column]:g} % of the finer sieve in line {finer.line}; correct one of them"
                )
        if measured and measured[-1] is rows[-1] and not 100 - _MOST_RETAINED <= rows[-1].values[column] <= 100:
            yield (
                f"{path}: line {rows[-1].line}, {column}: got {rows[-1].values[column]:g} at the coarsest sieve of "
                f"{name}; must be {100 - _MOST_RETAINED:g} to 100, in percent; add the next coarser sieve"
            )


def _pilot_test(name: str, run: _Row, sieves: list[_Row], path: str | Path) -> PilotTest:
    sieves = sorted(sieves, key=lambda row: row.values["size_mm"])
    if sieves[-1].values["feed"] < 100:
        top = {"size_mm": _next_sieve(path, sieves, "size_mm", 1.0), "feed": 100.0}
        sieves.append(_Row(sieves[-1].line, name, dict.fromkeys(_PRODUCT, math.nan) | top))
    measured = {column.field: run.values[key] * column.factor for key, column in _OPERATIONS.items()}
    for key, column in _PRODUCT.items():
        array = np.array([row.values[key] for row in sieves]) * column.factor
        array.flags.writeable = False
        measured[column.field] = array
    return PilotTest(name=name, **measured)
