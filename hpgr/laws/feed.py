"""Size distribution of the feed, by mass: the passing F0(s), and its inverse.

Sizes are in m, fractions 0 to 1, of any shape.
"""

import itertools
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, Field
from pydantic_core import PydanticCustomError

from hpgr import tables
from hpgr.fields import Fault, Frozen, Metres, Number, quantity, show

_FINEST = math.log(1e-9)  # m, at or above which the slope of a table's fine end must reach zero


class _Distribution(Frozen):
    @property
    def largest_grain(self) -> float:
        """Size of the largest grain, m."""
        return self.top_size

    def passing(self, size) -> np.ndarray:
        """Return the mass fraction of the feed no larger than `size`.

        Examples
        --------
        >>> import hpgr
        >>> hpgr.presets.paper().feed.passing([0.008, 0.034, 0.06])
        array([0. , 0.5, 1. ])
        """
        return self._passing(np.asarray(size, dtype=float))

    def quantile(self, fraction) -> np.ndarray:
        """Return the size that the mass fraction `fraction` of the feed passes.

        Examples
        --------
        >>> import hpgr
        >>> float(hpgr.presets.paper().feed.quantile(0.5).round(3))
        0.034
        """
        return np.minimum(self._quantile(np.asarray(fraction, dtype=float)), self.largest_grain)


class UniformFeed(_Distribution):
    """Uniform in size between bottom_size and top_size (the paper's feed)."""

    kind: Literal["uniform"] = "uniform"
    bottom_size: Metres = quantity(symbol="s_min", unit="m", source="feed", example="8 mm", ge=0, le=10)
    """Smallest grain."""
    top_size: Metres = quantity(symbol="s_max", unit="m", source="feed", example="60 mm", ge=1e-6, le=10)
    """Largest grain."""

    @classmethod
    def _impossible(cls, known: dict[str, Any]) -> Iterator[Fault]:
        bottom, top = known.get("bottom_size"), known.get("top_size")
        if bottom is not None and top is not None and bottom >= top:
            bound = f"must be less than top_size {show(top, 'm')}"
            yield Fault("bottom_size", show(bottom, "m"), bound, "give a range, or use kind 'single'")

    def _passing(self, size):
        return np.minimum(np.maximum((size - self.bottom_size) / (self.top_size - self.bottom_size), 0.0), 1.0)

    def _quantile(self, fraction):
        return self.bottom_size + (self.top_size - self.bottom_size) * fraction


class SingleFeed(_Distribution):
    """All grains of one size."""

    kind: Literal["single"] = "single"
    size: Metres = quantity(symbol="s_0", unit="m", source="feed", example="40 mm", ge=1e-6, le=10)
    """Size of every grain."""

    @property
    def largest_grain(self) -> float:
        """Size of the largest grain, m."""
        return self.size

    def _passing(self, size):
        return (size >= self.size).astype(float)

    def _quantile(self, fraction):
        return np.full(fraction.shape, self.size)


class PowerLawFeed(_Distribution):
    """Gates-Gaudin-Schuhmann: passing = (s / top_size)**exponent."""

    kind: Literal["power_law"] = "power_law"
    top_size: Metres = quantity(symbol="s_max", unit="m", source="feed", example="60 mm", ge=1e-6, le=10)
    """Largest grain."""
    exponent: Number = quantity(symbol="m", source="feed", example=0.7, ge=0.1, le=100)
    """Exponent of the distribution."""

    def _passing(self, size):
        return np.clip(size / self.top_size, 0.0, 1.0) ** self.exponent

    def _quantile(self, fraction):
        return self.top_size * fraction ** (1 / self.exponent)


class RosinRammlerFeed(_Distribution):
    """Rosin-Rammler: passing = 1 - exp(-(s / size)**exponent), renormalised below top_size."""

    kind: Literal["rosin_rammler"] = "rosin_rammler"
    size: Metres = quantity(symbol="s_0", unit="m", source="feed", example="40 mm", ge=1e-6, le=10)
    """Size that 63.2 % passes."""
    exponent: Number = quantity(symbol="m", source="feed", example=0.7, ge=0.1, le=100)
    """Exponent of the distribution."""
    top_size: Metres = quantity(symbol="s_max", unit="m", source="feed", example="60 mm", ge=1e-6, le=10)
    """Largest grain."""

    def _passing(self, size):
        return np.clip(self._unscalped(size) / self._unscalped(self.top_size), 0.0, 1.0)

    def _quantile(self, fraction):
        scaled = fraction * self._unscalped(self.top_size)
        with np.errstate(divide="ignore"):  # far below the top all of it passes: inf, held at top_size
            return self.size * (-np.log1p(-scaled)) ** (1 / self.exponent)

    def _unscalped(self, size):
        with np.errstate(over="ignore"):  # far above the size all of it passes: exp(-inf) is 0
            return -np.expm1(-((np.maximum(size, 0.0) / self.size) ** self.exponent))


def _sieve_rows(value: Any) -> Any:
    """Read a table given as the path of a CSV file."""
    if not isinstance(value, str | Path):
        return value
    try:
        return tables.read_sieve_table(value)
    except OSError as error:
        reason = f"the file cannot be read ({error.strerror})"
        raise PydanticCustomError("table", "{reason}", {"reason": reason}) from None
    except ValueError as error:
        raise PydanticCustomError("table", "{reason}", {"reason": str(error)}) from None


class TableFeed(_Distribution):
    """Sieve table, linear in log size; rows (size, percent passing) or the path of a CSV file.

    Examples
    --------
    >>> from hpgr.laws.feed import TableFeed
    >>> TableFeed(table=[("1 mm", 10), ("5 mm", 60), ("20 mm", 100)]).largest_grain
    0.02
    """

    kind: Literal["table"] = "table"
    table: Annotated[tuple[tuple[Metres, Number], ...], BeforeValidator(_sieve_rows)] = quantity(
        symbol="F_0", unit="m, %", source="feed", example=[["5 mm", 60], ["20 mm", 100]]
    )
    """Rows (size, percent passing), or the path of a CSV file."""
    top_size: Metres | None = quantity(None, symbol="s_max", unit="m", source="feed", example="60 mm", ge=1e-6, le=10)
    """Size at which the table is scalped."""

    @property
    def largest_grain(self) -> float:
        """Size of the largest grain, m."""
        return self.top_size or next(size for size, percent in self.table if percent >= 100)

    @classmethod
    def _impossible(cls, known: dict[str, Any]) -> Iterator[Fault]:
        if "table" in known:
            yield from _table_faults(known["table"], known.get("top_size"))

    def _passing(self, size):
        log_size, fraction = self._logs()
        with np.errstate(divide="ignore"):  # log 0 = -inf lies left of every sieve
            found = np.interp(np.log(size), log_size, fraction)
        return found if self.top_size is None else np.minimum(found / self._kept(), 1.0)

    def _quantile(self, fraction):
        log_size, passing = self._logs()
        if self.top_size is not None:
            fraction = fraction * self._kept()
        return np.exp(np.interp(fraction, *_rising(passing, log_size)))

    def _kept(self) -> float:
        """Return the fraction of the table that is left below the scalping size."""
        return float(np.interp(np.log(self.top_size), *self._logs()))

    def _logs(self) -> tuple[np.ndarray, np.ndarray]:
        """Return log size and passing fraction, the lowest segment extended to zero passing.

        A fine end so flat that this would be under 1 nm says nothing of what is below it, which then spans a decade.
        """
        size, percent = np.array(self.table).T
        log_size, fraction = np.log(size), percent / 100
        if fraction[0] > 0:
            with np.errstate(divide="ignore"):
                slope = (fraction[1] - fraction[0]) / (log_size[1] - log_size[0])
                lowest = log_size[0] - fraction[0] / slope
            lowest = lowest if lowest >= _FINEST else log_size[0] - math.log(10)
            log_size = np.concatenate([[lowest], log_size])
            fraction = np.concatenate([[0.0], fraction])
        return log_size, fraction


def _rising(fraction: np.ndarray, log_size: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the table for inverse interpolation: sieves that hold no mass are jumped over."""
    keep = np.ones(fraction.size, dtype=bool)
    # of a run of equal passings only its ends matter, and np.interp takes the last of equal abscissae
    keep[1:-1] = (fraction[1:-1] != fraction[:-2]) | (fraction[1:-1] != fraction[2:])
    return fraction[keep], log_size[keep]


def _table_faults(table: tuple[tuple[float, float], ...], top_size: float | None) -> Iterator[Fault]:
    """Yield what keeps the rows from being a cumulative distribution, naming each row."""
    if len(table) < 2:
        yield Fault("table", f"{len(table)} row", "must have at least 2 rows", "give the whole sieve analysis")
        return
    rows = [f"row {number} ({show(size, 'm')}, {percent:g} %)" for number, (size, percent) in enumerate(table, 1)]
    for row, (size, percent) in zip(rows, table, strict=True):
        if not 0 < size <= 10:
            yield Fault("table", row, "its size must be above 0 and at most 10 m", "correct the sieve or its unit")
        if not 0 <= percent <= 100:
            yield Fault("table", row, "its passing must lie within 0 to 100 %", "correct the row")
    for row, ((size, percent), (next_size, next_percent)) in zip(rows[1:], itertools.pairwise(table), strict=True):
        if next_size <= size:
            bound = f"its size must exceed the row before it, {show(size, 'm')}"
            yield Fault("table", row, bound, "sort the rows by size and remove doubles")
        if next_percent < percent:
            bound = f"its passing must be at least the row before it, {percent:g} %"
            yield Fault("table", row, bound, "cumulative percent passing grows with size; correct the row")
    if table[-1][1] != 100:
        got = f"row {len(table)} ({table[-1][1]:g} %)"
        yield Fault("table", got, "the coarsest sieve must pass 100 %", "add the sieve that everything passes")
    empty = max((size for size, percent in table if percent <= 0), default=table[0][0])
    if top_size is not None and not empty < top_size <= table[-1][0]:
        bound = f"must lie within the table, above {show(empty, 'm')} to {show(table[-1][0], 'm')}"
        yield Fault("top_size", show(top_size, "m"), bound, "scalping only removes coarse grains")


Feed = Annotated[UniformFeed | SingleFeed | PowerLawFeed | RosinRammlerFeed | TableFeed, Field(discriminator="kind")]
