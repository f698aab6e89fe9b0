"""The declared range of every scene field, read off the fields themselves: ends, values just outside, draws.

A field or a law that a scene gains later is walked and drawn without a line here.
"""

import math
from collections.abc import Mapping
from functools import cache
from typing import Any, Literal, NamedTuple, get_args, get_origin

import numpy as np
from pydantic import ValidationError

from hpgr.fields import kinds_of, values_of
from hpgr.scene import Scene, fields, laws
from studies import Late

cost, machine = Late("hpgr.cost"), Late("hpgr.bed.machine")

_DECADES = 9  # over which values are drawn where a range begins at 0 or has no upper end


class Range(NamedTuple):
    """Declared range of a numeric field; the ends are refused where they are open."""

    low: float
    high: float  # inf where none is declared
    low_open: bool
    high_open: bool
    whole: bool  # only whole numbers are allowed
    infinite: bool  # inf is a value with a meaning
    optional: bool  # the field may be left out

    def ends(self) -> list[float]:
        """Return the lowest and highest value that are allowed, and inf where it is."""
        low = self._next(self.low, math.inf) if self.low_open else self.low
        high = self._next(self.high, -math.inf) if self.high_open else min(self.high, 1e300)
        return [int(end) if self.whole else end for end in (low, high)] + [math.inf] * self.infinite

    def outside(self) -> list[float]:
        """Return the values nearest to the ends that are not allowed."""
        low = self.low if self.low_open else self._next(self.low, -math.inf)
        high = self.high if self.high_open else self._next(self.high, math.inf)
        return [int(value) if self.whole else value for value in (low, high) if math.isfinite(value)]

    def at(self, place: float) -> float:
        """Return the value at `place`, 0 to 1, along the range: in the logarithm where it spans decades."""
        low, high = self.ends()[:2]
        if math.isinf(self.high):
            high = max(low, 1.0) * 10**_DECADES
        if self.low < 0 or high <= 100 * self.low:
            value = low + place * (high - low)
        else:
            start = low if self.low > 0 else high / 10**_DECADES
            value = start * (high / start) ** place if place else low
        value = min(max(value, low), high)
        return round(value) if self.whole else value

    def draw(self, generator: np.random.Generator) -> float:
        """Return a value within the range, at one of its ends once in ten."""
        ends = self.ends()
        return ends[generator.integers(len(ends))] if generator.random() < 0.1 else self.at(generator.random())

    def _next(self, value: float, towards: float) -> float:
        return value + math.copysign(1, towards) if self.whole else math.nextafter(value, towards)


@cache
def numeric_fields() -> dict[str, Range]:
    """Return the range of every field that holds one number, by dotted name."""
    found = {name: _range(field) for name, (_, field) in fields().items()}
    return {name: known for name, known in found.items() if known is not None}


@cache
def choices() -> dict[str, tuple]:
    """Return the words or truth values of every field that is a choice, by dotted name; kinds of laws are one."""
    found = {f"{name}.kind": tuple(kind for law in each for kind in kinds_of(law)) for name, each in laws().items()}
    for name, (_, field) in fields().items():
        if field.annotation is bool:
            found[name] = (False, True)
        elif get_origin(field.annotation) is Literal:
            found.setdefault(name, get_args(field.annotation))
    return {name: words for name, words in found.items() if words}


def _range(field: Any) -> Range | None:
    keys = ("gt", "ge", "lt", "le", "allow_inf_nan")
    known = {key: getattr(one, key) for one in field.metadata for key in keys if getattr(one, key, None) is not None}
    inner = {each for kind in (field.annotation, *get_args(field.annotation)) for each in (kind, *get_args(kind)[:1])}
    if get_origin(field.annotation) is tuple or not {"gt", "ge"} & known.keys():
        return None
    low, high = known.get("gt", known.get("ge")), known.get("lt", known.get("le", math.inf))
    opened, infinite, optional = ("gt" in known, "lt" in known), "allow_inf_nan" in known, type(None) in inner
    return Range(float(low), float(high), *opened, int in inner, infinite, optional)


# --- random scenes --------------------------------------------------------------------------------------------------


def draw(base: Scene, generator: np.random.Generator, exchange: bool, most_seconds: float) -> dict[str, Any]:
    """Return the values of a random scene by dotted name, for `base.with_values`, predicted to cost `most_seconds`.

    Half of the scenes draw every field over its whole range; the other half draw a few, which leaves more of the
    machine working. Gaps and grain sizes are drawn so that they fit each other, or hardly any scene would run; once
    in four the gap floats under a force near that which the drawn gap carries. The resolution is small, or, once in
    ten, one of its fields is drawn over its whole range too; counts are then halved until the cost is low enough.
    """
    chance = 1.0 if generator.random() < 0.5 else 0.15
    width, forced = not exchange and generator.random() < 0.5, generator.random() < 0.25
    drawn: dict[str, Any] = {}
    for section in ("rolls", "bed", "flow", "elasticity", "strength", "fragments"):
        drawn |= _draw_section(section, chance, generator)
    for section, wanted in (("exchange", exchange), ("roll_width", width)):
        drawn |= _draw_section(section, chance, generator) or {section: {}} if wanted else {section: None}
    drawn |= _draw_gaps(drawn.get("rolls.diameter", base.rolls.diameter), 1e-3 if forced else 1e-6, generator)
    names = ("bed.feed_solid_fraction", "bed.max_solid_fraction")  # the feed's is at most the largest
    fractions = [drawn.get(name, getattr(base.bed, name.partition(".")[2])) for name in names]
    drawn |= dict(zip(names, sorted(fractions), strict=True))
    drawn |= _draw_feed(drawn["rolls.entry_gap"], generator)
    drawn |= _draw_resolution(exchange, width, generator)
    if drawn["flow.kind"] == "nip":
        drawn |= _draw_nip(drawn.get("rolls.diameter", base.rolls.diameter), drawn, generator)
    drawn = _affordable(base, drawn, most_seconds)
    return near_force(base, drawn, _log_uniform(0.5, 2, generator)) if forced else drawn


def near_force(base: Scene, values: dict[str, Any], factor: float) -> dict[str, Any]:
    """Return the values with `factor` times the pressing force that the scene's own gap carries, if it carries any."""
    try:
        force = factor * machine.specific_pressing_force(base.with_values(values))
    except ValueError:
        return values  # it will not be run
    known = numeric_fields()["rolls.specific_pressing_force"]
    return values | ({"rolls.specific_pressing_force": force} if known.low <= force <= known.high else {})


def _draw_section(section: str, chance: float, generator: np.random.Generator) -> dict[str, Any]:
    """Return a kind of law and values of its fields, each over its whole range with this chance."""
    each = laws()[section]
    law = each[generator.integers(len(each))]
    drawn: dict[str, Any] = {f"{section}.kind": kind for kind in kinds_of(law)}
    for name in (f"{section}.{key}" for key in law.model_fields):
        known, words = numeric_fields().get(name), choices().get(name)
        if known is not None and generator.random() < (0.1 if known.optional else chance):
            drawn[name] = known.draw(generator)
        elif words and not name.endswith(".kind"):
            drawn[name] = words[generator.integers(len(words))]
    return drawn


def _draw_nip(diameter: float, drawn: Mapping[str, Any], generator: np.random.Generator) -> dict[str, Any]:
    """Return a nip angle within the bed, or, once in two, the cake's solid fraction that has such a nip."""
    gap, entry_gap = drawn["rolls.gap"], drawn["rolls.entry_gap"]
    feed, densest = (drawn[f"bed.{name}_solid_fraction"] for name in ("feed", "max"))
    steepest = math.acos(max(1 - (entry_gap - gap) / diameter, 0.5))
    angle = min(max(steepest * generator.random(), 1e-3), 1.0)
    cake = feed * math.cos(angle) * (gap + diameter * (1 - math.cos(angle))) / gap  # continuity, as NipFlow has it
    by_cake = generator.random() < 0.5 and feed <= cake <= densest
    return {"flow.nip_angle": None if by_cake else angle, "flow.cake_solid_fraction": cake if by_cake else None}


def _log_uniform(low: float, high: float, generator: np.random.Generator) -> float:
    return low * (high / low) ** generator.random()


def _draw_gaps(diameter: float, narrowest: float, generator: np.random.Generator) -> dict[str, Any]:
    """Return a gap, from `narrowest` diameters, and an entry gap that the rolls allow, once in fifty equal."""
    known = numeric_fields()["rolls.gap"]
    gap = max(diameter * _log_uniform(narrowest, 1.0, generator), known.low)
    rise = 0.0 if generator.random() < 0.02 else diameter * _log_uniform(1e-4, 0.5, generator)
    return {"rolls.gap": gap, "rolls.entry_gap": min(gap + rise, known.high)}


def _draw_feed(entry_gap: float, generator: np.random.Generator) -> dict[str, Any]:
    """Return a feed of any kind that is no coarser than the entry gap."""
    kinds, known = choices()["feed.kind"], numeric_fields()
    kind = kinds[generator.integers(len(kinds))]
    top = min(
        max(_log_uniform(1e-3 * entry_gap, entry_gap, generator), known["feed.top_size"].low),
        known["feed.top_size"].high,
    )
    size = _log_uniform(known["feed.size"].low, top, generator)
    exponent = known["feed.exponent"].draw(generator)
    percents = np.sort(generator.uniform(0, 100, 4)) * [0.1 * generator.integers(2), 1, 1, 1]
    rows = zip(top * np.array([0.01, 0.1, 0.3, 0.6, 1.0]), [*percents, 100.0], strict=True)
    values = {
        "uniform": {"bottom_size": top * generator.random(), "top_size": top},
        "single": {"size": top},
        "power_law": {"top_size": top, "exponent": exponent},
        "rosin_rammler": {"size": size, "exponent": exponent, "top_size": top},
        "table": {"table": [(float(s), float(f)) for s, f in rows], "top_size": None},
    }[kind]
    return {"feed.kind": kind} | {f"feed.{name}": value for name, value in values.items()}


def _draw_resolution(exchange: bool, width: bool, generator: np.random.Generator) -> dict[str, Any]:
    records = ("product",) if width else choices()["resolution.record"]
    few = generator.integers(0, 4)
    drawn = {
        "resolution.streamlines": int(generator.integers(1, 5 if exchange else 7)),
        "resolution.points": int(generator.integers(2, 41 if exchange else 101)),
        "resolution.cells": int(few if generator.random() < 0.3 else generator.integers(4, 65 if exchange else 201)),
        "resolution.snapshots": int(generator.integers(1, 4)),
        "resolution.record": records[generator.integers(len(records))],
        "resolution.control_variate": bool(generator.random() < 0.8),
    } | ({"exchange.interval": int(generator.integers(1, 6))} if exchange else {})
    if generator.random() < 0.1:
        counted = [name for name in drawn if name in numeric_fields()]
        name = counted[generator.integers(len(counted))]
        drawn[name] = numeric_fields()[name].draw(generator)
    return drawn


def _affordable(base: Scene, values: dict[str, Any], most_seconds: float) -> dict[str, Any]:
    """Return the values with the largest count halved until the predicted cost is low enough."""
    counted = [name for name, known in numeric_fields().items() if known.whole]
    while True:
        try:
            scene = base.with_values(values)
        except ValidationError:
            return values  # it will not be run
        known = values_of(scene)
        largest = max((name for name in counted if name in known), key=known.get)
        if cost.predict(scene).seconds <= most_seconds or known[largest] <= 4:
            return values
        values = values | {largest: known[largest] // 2}
