"""Sieve tables: a CSV of size and percent passing, as a laboratory hands it over."""

import csv
import re
from pathlib import Path

from hpgr import units

_UNIT_IN_HEADER = re.compile(r"^\s*(?:size|sieve|aperture)\w*?[\s_]*[\[(]?\s*([a-zµμ]+)\s*[\])]?\s*$", re.IGNORECASE)


def read_sieve_table(path: str | Path) -> list[tuple[float, float]]:
    """Return rows (size in m, percent passing) of a CSV file, finest sieve first.

    The file has a header and two columns: the sieve size, its unit named in the header ("size_mm",
    "size [mm]"), and the percent passing. Rows may run from fine to coarse or the other way.
    Lines starting with # are comments.

    Raises
    ------
    ValueError
        If the file cannot be read as such a table, naming the row. Whether the numbers make a
        distribution is the feed's own check.
    """
    with open(path, newline="", encoding="utf-8-sig") as file:
        lines = [line for line in file if line.strip() and not line.lstrip().startswith("#")]
    if not lines:
        raise ValueError(f"{path}: the table is empty; give a header and rows of size, percent passing")
    header, *rows = csv.reader(lines)
    metres = _metres_per_unit(header, path)
    table = [_numbers(row, number, path) for number, row in enumerate(rows, start=1)]
    table = [(size * metres, percent) for size, percent in table]
    return table[::-1] if len(table) > 1 and table[0][0] > table[-1][0] else table


def _metres_per_unit(header: list[str], path) -> float:
    found = _UNIT_IN_HEADER.match(header[0]) if len(header) == 2 else None
    if not found or "passing" not in header[1].lower():
        raise ValueError(
            f"{path}: header {','.join(header)!r} is not 'size_<unit>,percent_passing'; "
            "name the unit of the sizes, for example 'size_mm,percent_passing'"
        )
    try:
        return units.parse(f"1 {found[1]}", "m")
    except ValueError as error:
        raise ValueError(f"{path}: header {header[0]!r}: {error}; use a length such as mm") from None


def _numbers(row: list[str], number: int, path) -> tuple[float, float]:
    try:
        size, percent = map(float, row)
    except ValueError:
        raise ValueError(f"{path}: row {number} {','.join(row)!r} is not two numbers (size, percent passing)") from None
    return size, percent
