"""Tables as a laboratory hands them over: a sieve table, and the two tables of a series of pilot tests."""

import csv
import difflib
import itertools
import math
import os
import re
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hpgr.fields import parse

_UNIT_IN_HEADER = re.compile(r"^\s*(?:size|sieve|aperture)\w*?[\s_]*[\[(]?\s*([a-zµμ]+)\s*[\])]?\s*$", re.IGNORECASE)
_LARGEST, _MOST_LINES, _LONGEST_LINE = 10_000_000, 10_000, 10_000  # bytes, lines, characters of a table
_MOST_FAULTS = 50  # that are told at once


def read_sieve_table(path: str | Path) -> list[tuple[float, float]]:
    """Return rows (size in m, percent passing) of a CSV file, finest sieve first.

    The file has a header and two columns: the sieve size, its unit named in the header ("size_mm",
    "size [mm]"), and the percent passing. Rows may run from fine to coarse or the other way.
    Lines starting with # are comments.

    Raises
    ------
    OSError
        If the file cannot be opened.
    ValueError
        If the file cannot be read as such a table, naming the line. Whether the numbers make a
        distribution is the feed's own check.

    Examples
    --------
    >>> import hpgr
    >>> from hpgr import tables
    >>> rows = tables.read_sieve_table(hpgr.presets.DATA / "khd_porphyry_feed.csv")
    >>> rows[-1]
    (0.045, 100.0)
    """
    (_, header), *rows = _lines(path)
    metres = _metres_per_unit(header, path)
    table = [_numbers(cells, number, path) for number, cells in rows]
    table = [(size * metres, percent) for size, percent in table]
    return table[::-1] if len(table) > 1 and table[0][0] > table[-1][0] else table


def _lines(path: str | Path) -> list[tuple[int, list[str]]]:
    """Return (line number, stripped cells) of every line that is neither blank nor a comment; at least one."""
    text = _text_of(path)
    kept = [(n, line) for n, line in enumerate(text.splitlines(), start=1) if not line.lstrip().startswith("#")]
    if max((len(line) for _, line in kept), default=0) > _LONGEST_LINE or len(kept) > _MOST_LINES:
        raise ValueError(
            f"{path}: got {len(kept):,} lines; a table has at most {_MOST_LINES:,} lines of {_LONGEST_LINE:,} "
            "characters; give the table alone"
        )
    lines = [(n, [cell.strip() for cell in next(csv.reader([line]), [])]) for n, line in kept]
    lines = [(n, cells) for n, cells in lines if any(cells)]
    if not lines:
        raise ValueError(f"{path}: the table is empty; give a header and rows")
    return lines


def _text_of(path: str | Path) -> str:
    status = os.stat(path)  # before it is opened: a pipe would make us wait, a device never end
    if not stat.S_ISREG(status.st_mode):
        raise ValueError(f"{path}: is no regular file; a table must be one; save it as CSV")
    with open(path, "rb") as file:
        data = file.read(_LARGEST + 1)
    if len(data) > _LARGEST:
        raise ValueError(f"{path}: got more than {_LARGEST:,} bytes; a table must be smaller; give the table alone")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: byte {error.start} is not UTF-8; save the table as CSV in UTF-8") from None
    if "\0" in text:
        raise ValueError(f"{path}: byte {data.index(0)} is 0, which no text has; save the table as CSV in UTF-8")
    return text


def _metres_per_unit(header: list[str], path: str | Path) -> float:
    found = _UNIT_IN_HEADER.match(header[0]) if len(header) == 2 else None
    if not found or "passing" not in header[1].lower():
        raise ValueError(
            f"{path}: header {_short(','.join(header))} is not 'size_<unit>,percent_passing'; "
            "name the unit of the sizes, for example 'size_mm,percent_passing'"
        )
    try:
        return parse(f"1 {found[1]}", "m")
    except ValueError as error:
        raise ValueError(f"{path}: header {header[0]!r}: {error}; use a length such as mm") from None


def _numbers(cells: list[str], line: int, path: str | Path) -> tuple[float, float]:
    try:
        size, percent = map(float, cells)
    except ValueError:
        text = _short(",".join(cells))
        raise ValueError(
            f"{path}: line {line} {text} is not two numbers (size, percent passing); correct or remove it"
        ) from None
    return size, percent


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
        where measured, `gap_mm`, `flake_mm`, `Q_tph`, `mdot` (t s h-1 m-3), `P_kW`, `W_kWh_t`, `Rp_bar`,
        `moisture_pct`.

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
        faults += _sieving_faults(name, rows, product)
    for name, rows in runs.items():
        faults += [
            f"{operations}: line {row.line}, test: got {name!r} again (first in line {rows[0].line}); "
            "must be one row a test; rename or remove one"
            for row in rows[1:]
        ]
    if faults:
        told = [*faults[:_MOST_FAULTS], *(["..."] if len(faults) > _MOST_FAULTS else [])]
        raise ValueError(f"{len(faults)} fault(s) in the pilot tests:\n" + "\n".join(told))
    return tuple(_pilot_test(name, run, sieves[name]) for name, [run] in runs.items())


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
            "leave cells not measured empty, and write decimals with a point"
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
        value = float(text)
    except ValueError:
        raise ValueError("must be a number; leave the cell empty if not measured") from None
    if not math.isfinite(value):
        raise ValueError("must be a finite number; leave the cell empty if not measured")
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


def _sieving_faults(name: str, rows: list[_Row], path: str | Path) -> Iterator[str]:
    """Yield why the rows of one test are not size distributions."""
    if len(rows) < 2:
        yield f"{path}: line {rows[0].line}, test: got one sieve for {name}; must be at least two; add sieves"
    rows = sorted((row for row in rows if row.values["size_mm"] > 0), key=lambda row: row.values["size_mm"])
    for finer, coarser in itertools.pairwise(rows):
        if finer.values["size_mm"] == coarser.values["size_mm"]:
            yield (
                f"{path}: line {coarser.line}, size_mm: got {coarser.values['size_mm']:g} twice for {name} "
                f"(also in line {finer.line}); must differ from sieve to sieve; remove one"
            )
    for column in ("feed", "centre", "edge", "total"):
        measured = [row for row in rows if not math.isnan(row.values[column])]
        for finer, coarser in itertools.pairwise(measured):
            if coarser.values[column] < finer.values[column]:
                yield (
                    f"{path}: line {coarser.line}, {column}: got {coarser.values[column]:g} % at "
                    f"{coarser.values['size_mm']:g} mm in {name}; must not be below the "
                    f"{finer.values[column]:g} % of the finer sieve in line {finer.line}; correct one of them"
                )
        if measured and measured[-1] is rows[-1] and rows[-1].values[column] != 100:
            yield (
                f"{path}: line {rows[-1].line}, {column}: got {rows[-1].values[column]:g} at the coarsest sieve of "
                f"{name}; must be 100, in percent; add the next coarser sieve, which all of it passes"
            )


def _pilot_test(name: str, run: _Row, sieves: list[_Row]) -> PilotTest:
    sieves = sorted(sieves, key=lambda row: row.values["size_mm"])
    measured = {column.field: run.values[key] * column.factor for key, column in _OPERATIONS.items()}
    for key, column in _PRODUCT.items():
        array = np.array([row.values[key] for row in sieves]) * column.factor
        array.flags.writeable = False
        measured[column.field] = array
    return PilotTest(name=name, **measured)
