"""The declared range of every scene field, read off the fields themselves: ends, values just outside, draws.

A field that a scene gains later is walked and drawn without a line here.
"""

import math
from collections.abc import Iterator, Mapping
from typing import Any, Literal, NamedTuple, get_args, get_origin

import numpy as np
from pydantic import BaseModel, ValidationError

from hpgr import budget
from hpgr.scene import Scene

_DECADES = 9  # over which values are drawn where a range begins at 0 or has no upper end


class Range(NamedTuple):
    """Declared range of a numeric field.

    Attributes
    ----------
    low, high : float
        Lower and upper end; `high` is inf where none is declared.
    low_open, high_open : bool
        Whether the end itself is refused.
    whole : bool
        Whether only whole numbers are allowed.
    infinite : bool
        Whether inf is a value with a meaning.
    optional : bool
        Whether the field may be left out.
    """

    low: float
    high: float
    low_open: bool
    high_open: bool
    whole: bool
    infinite: bool
    optional: bool

    def ends(self) -> list[float]:
        """Return the lowest and highest value that are allowed, and inf where it is."""
        low = self._next(self.low, math.inf) if self.low_open else self.low
        high = self._next(self.high, -math.inf) if self.high_open else self.high
        ends = [low, high if math.isfinite(high) else 1e300, *([math.inf] if self.infinite else [])]
        return [int(end) if self.whole else end for end in ends]

    def outside(self) -> list[float]:
        """Return the values nearest to the ends that are not allowed."""
        low = self.low if self.low_open else self._next(self.low, -math.inf)
        beyond = [low]
        if math.isfinite(self.high):
            beyond.append(self.high if self.high_open else self._next(self.high, math.inf))
        return [int(value) if self.whole else value for value in beyond]

    def at(self, place: float) -> float:
        """Return the value at `place`, 0 to 1, along the range: in the logarithm where it spans decades."""
        low, high = self.ends()[:2]
        if math.isinf(self.high):
            high = max(low, 1.0) * 10**_DECADES
        if self.low < 0 or high <= 100 * self.low:
            value = low + place * (high - low)
        elif place == 0:
            value = low
        else:
            start = low if self.low > 0 else high / 10**_DECADES
            value = start * (high / start) ** place
        value = min(max(value, low), high)
        return round(value) if self.whole else value

    def _next(self, value: float, towards: float) -> float:
        if self.whole:
            return value + math.copysign(1, towards)
        return math.nextafter(value, towards)


def parts() -> dict[str, type[BaseModel]]:
    """Return the models a scene is made of by name, those that may be None too."""
    found = {}
    for name, field in Scene.model_fields.items():
        for kind in (field.annotation, *get_args(field.annotation)):
            if isinstance(kind, type) and issubclass(kind, BaseModel):
                found[name] = kind
    return found


def numeric_fields() -> dict[str, Range]:
    """Return the range of every field that holds one number, by dotted name."""
    found = {name: _range(field) for name, field in _fields() if _holds(field, float) or _holds(field, int)}
    return {name: known for name, known in found.items() if known is not None}


def choices() -> dict[str, tuple]:
    """Return the words or truth values of every field that is a choice, by dotted name."""
    found = {}
    for name, field in _fields():
        if get_origin(field.annotation) is Literal:
            found[name] = get_args(field.annotation)
        elif field.annotation is bool:
            found[name] = (False, True)
    return found


def _fields() -> Iterator[tuple[str, Any]]:
    for section, part in parts().items():
        for key, field in part.model_fields.items():
            yield f"{section}.{key}", field


def _holds(field: Any, kind: type) -> bool:
    """Return whether a field holds one number of this kind, be it optional."""
    held = [field.annotation, *get_args(field.annotation)] if get_origin(field.annotation) is not tuple else []
    return any(each is kind or (get_args(each) or (None,))[0] is kind for each in held if get_origin(each) is not tuple)


def _range(field: Any) -> Range | None:
    known = {}
    for bound in field.metadata:
        for key in ("gt", "ge", "lt", "le", "allow_inf_nan"):
            if getattr(bound, key, None) is not None:
                known[key] = getattr(bound, key)
    if not {"gt", "ge"} & set(known):
        return None
    return Range(
        low=float(known.get("gt", known.get("ge"))),
        high=float(known.get("lt", known.get("le", math.inf))),
        low_open="gt" in known,
        high_open="lt" in known,
        whole=_holds(field, int),
        infinite=bool(known.get("allow_inf_nan")),
        optional=type(None) in get_args(field.annotation),
    )


def draw(base: Scene, generator: np.random.Generator, exchange: bool, most_seconds: float) -> dict[str, Any]:
    """Return the values of a random scene by dotted name, for `base.with_values`.

    Half of the scenes draw every field over its whole range; the other half draw a few, which leaves more of the
    machine working. Gaps and grain sizes are drawn so that they fit each other, or hardly any scene would run;
    the resolution is small, and stress steps and points are halved until the predicted cost is low enough.

    Parameters
    ----------
    base : Scene
        Gives the fields that are not drawn.
    generator : numpy.random.Generator
        Source of all choices.
    exchange : bool
        Whether the scene has exchange.
    most_seconds : float
        Most that a run may cost by `hpgr.budget.predict`.
    """
    chance = 1.0 if generator.random() < 0.5 else 0.15
    apart = {"feed", "resolution"} | (set() if exchange else {"exchange"})  # drawn otherwise, or not at all
    drawn: dict[str, Any] = {} if exchange else {"exchange": None}
    for name, known in numeric_fields().items():
        if name.partition(".")[0] not in apart and generator.random() < (0.1 if known.optional else chance):
            drawn[name] = _draw_number(known, generator)
    for name, words in choices().items():
        if name.partition(".")[0] not in apart:
            drawn[name] = words[generator.integers(len(words))]
    drawn |= _draw_gaps(drawn.get("rolls.diameter", base.rolls.diameter), generator)
    ore = base.material  # the feed's solid fraction is at most the largest
    fractions = {"material.feed_solid_fraction": ore.feed_solid_fraction,
                 "material.max_solid_fraction": ore.max_solid_fraction}  # fmt: skip
    fractions |= {name: drawn[name] for name in fractions if name in drawn}
    drawn |= zip(fractions, sorted(fractions.values()), strict=True)
    drawn |= _draw_feed(drawn.get("rolls.entry_gap", base.rolls.entry_gap), generator)
    drawn |= _draw_resolution(exchange, generator)
    _reconcile(base, drawn, exchange, generator)
    return _affordable(base, drawn, most_seconds)


def _reconcile(base: Scene, drawn: dict[str, Any], exchange: bool, generator: np.random.Generator) -> None:
    """Take out what excludes each other: two nips or none, slices of the roll width with exchange or whole records."""
    for name in ("flow.nip_angle", "flow.cake_solid_fraction"):
        drawn.pop(name, None)
    if drawn.get("flow.profile") == "nip":
        drawn |= _draw_nip(base, drawn, generator)
    width = [name for name in drawn if name.startswith("roll_width.")]
    if exchange or generator.random() < 0.5:
        for name in width:
            del drawn[name]
    elif width:
        drawn["resolution.record"] = "product"


def _draw_nip(base: Scene, drawn: Mapping[str, Any], generator: np.random.Generator) -> dict[str, float]:
    """Return a nip angle within the bed, or, once in two, the cake's solid fraction that has such a nip."""
    diameter = drawn.get("rolls.diameter", base.rolls.diameter)
    gap, entry_gap = drawn["rolls.gap"], drawn["rolls.entry_gap"]
    feed, densest = (drawn[f"material.{name}_solid_fraction"] for name in ("feed", "max"))
    steepest = math.acos(max(1 - (entry_gap - gap) / diameter, 0.5))
    angle = min(max(steepest * generator.random(), 1e-3), 1.0)
    cake = feed * math.cos(angle) * (gap + diameter * (1 - math.cos(angle))) / gap  # as hpgr.flow.nip_angle has it
    if generator.random() < 0.5 and feed <= cake <= densest:
        return {"flow.cake_solid_fraction": cake}
    return {"flow.nip_angle": angle}


def _draw_number(known: Range, generator: np.random.Generator) -> float:
    """Return a value within the range, at one of its ends once in ten."""
    if generator.random() < 0.1:
        ends = known.ends()
        return ends[generator.integers(len(ends))]
    return known.at(generator.random())


def _log_uniform(low: float, high: float, generator: np.random.Generator) -> float:
    return low * (high / low) ** generator.random()


def _draw_gaps(diameter: float, generator: np.random.Generator) -> dict[str, Any]:
    """Return a gap and an entry gap that the rolls allow, once in fifty equal."""
    known = numeric_fields()["rolls.gap"]
    gap = max(diameter * _log_uniform(1e-6, 1.0, generator), known.low)
    rise = 0.0 if generator.random() < 0.02 else diameter * _log_uniform(1e-4, 0.5, generator)
    return {"rolls.gap": gap, "rolls.entry_gap": min(gap + rise, known.high)}


def _draw_feed(entry_gap: float, generator: np.random.Generator) -> dict[str, Any]:
    """Return a feed of any kind that is no coarser than the entry gap."""
    fields = parts()["feed"].model_fields
    kind = choices()["feed.kind"][generator.integers(len(choices()["feed.kind"]))]
    known = {name: ranged for name, ranged in numeric_fields().items() if name.startswith("feed.")}
    top = min(max(_log_uniform(1e-3 * entry_gap, entry_gap, generator), 1e-6), 10.0)
    size = _log_uniform(1e-6, max(top, 1e-6), generator)
    exponent = _draw_number(known["feed.exponent"], generator)
    percents = np.sort(generator.uniform(0, 100, 4)) * [0.1 * generator.integers(2), 1, 1, 1]
    table = list(zip(top * np.array([0.01, 0.1, 0.3, 0.6]), percents, strict=True))
    values = {
        "uniform": {"bottom_size": top * generator.random(), "top_size": top},
        "single": {"size": top},
        "power_law": {"top_size": top, "exponent": exponent},
        "rosin_rammler": {"size": size, "exponent": exponent, "top_size": top},
        "table": {"table": [*((float(s), float(f)) for s, f in table), (top, 100.0)]},
    }[kind]
    return {f"feed.{name}": values.get(name) for name in fields} | {"feed.kind": kind}


def _draw_resolution(exchange: bool, generator: np.random.Generator) -> dict[str, Any]:
    records = choices()["resolution.record"]
    few = generator.integers(0, 4)
    return {
        "resolution.streamlines": int(generator.integers(1, 5 if exchange else 7)),
        "resolution.points": int(generator.integers(2, 41 if exchange else 101)),
        "resolution.cells": int(few if generator.random() < 0.3 else generator.integers(4, 65 if exchange else 201)),
        "resolution.photographs": int(generator.integers(1, 4)),
        "resolution.record": records[generator.integers(len(records))],
    } | ({"exchange.interval": int(generator.integers(1, 6))} if exchange else {})


def _affordable(base: Scene, values: dict[str, Any], most_seconds: float) -> dict[str, Any]:
    """Return the values with stress steps, then points, halved until the predicted cost is low enough."""
    while True:
        try:
            scene = base.with_values(values)
        except ValidationError:
            return values  # it will not be run
        if budget.predict(scene).seconds <= most_seconds or scene.resolution.points <= 2:
            return values
        name, count = "stress.substeps", scene.stress.substeps
        if count == 1:
            name, count = "resolution.points", scene.resolution.points
        values = values | {name: count // 2}
