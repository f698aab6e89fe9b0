"""What is simulated: one machine, one law per phenomenon and a resolution, frozen and validated as a whole."""

import difflib
import itertools
import json
import math
import re
import tomllib
from collections.abc import Iterator, Mapping
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, Self

from pydantic import BaseModel, BeforeValidator, ValidationError, model_validator

from hpgr import tables
from hpgr.fields import (
    Count,
    Density,
    Fault,
    Frozen,
    Metres,
    NewtonMetres,
    Number,
    Pascals,
    RadiansPerSecond,
    fault_in_words,
    kinds_of,
    meanings,
    parse,
    parts_of,
    path_of,
    quantity,
    show,
    valid_alone,
)
from hpgr.laws.elasticity import Elasticity, GranularElasticity
from hpgr.laws.exchange import Exchange
from hpgr.laws.feed import Feed
from hpgr.laws.flow import LEAST_NIP_ANGLE, Flow, PowerFlow, cake_nip_angle, densest_ratio
from hpgr.laws.fragments import Fragments, PowerLawFragments
from hpgr.laws.roll_width import RollWidth
from hpgr.laws.strength import SizeEffectStrength, Strength

DATA = Path(str(files("hpgr") / "data"))  # presets, resolutions, pilot tests
LEAST_GAP = 1e-6  # m
_DEEPEST = 8  # levels of a scene file
_LONG_KEY = re.compile(r"""(?:(?:(?<![\w-])[\w-]++|"[^"\n]*+"|'[^'\n]*+')\s*+\.\s*+){30}""")
# The largest entry angle the cubic streamlines allow: above it their half width no longer grows with height.
STEEPEST_ENTRY = 0.5  # (entry gap - gap) / diameter, reached at an entry angle of 60 degrees


class Rolls(Frozen):
    """Two equal counter-rotating rolls and the bed between them (paper section 2.2, figure 1).

    Examples
    --------
    >>> import hpgr
    >>> rolls = hpgr.Rolls(diameter="0.8 m", width="25 cm", gap=0.019, entry_gap="60 mm", speed="16 rpm")
    >>> round(rolls.speed, 3)  # rad/s
    1.676
    """

    diameter: Metres = quantity(symbol="D", unit="m", source="machine", example="0.8 m", ge=1e-3, le=1e3)
    """Roll diameter."""
    width: Metres = quantity(symbol="L", unit="m", source="machine", example="0.25 m", ge=1e-4, le=1e3)
    """Roll width, along the roll axes."""
    gap: Metres = quantity(symbol="s_b", unit="m", source="machine", example="20 mm", ge=LEAST_GAP, le=1e3)
    """Gap where the rolls are closest."""
    entry_gap: Metres = quantity(symbol="s_t", unit="m", source="machine", example="100 mm", ge=1e-6, le=1e3)
    """Distance between the roll surfaces where the modelled bed begins."""
    speed: RadiansPerSecond = quantity(
        symbol="omega", unit="rad s-1", source="machine", example="19 rpm", ge=1e-6, le=1e6
    )
    """Roll speed."""
    specific_pressing_force: Pascals | None = quantity(
        None, symbol="F_sp", unit="Pa", source="machine", example="3.5 N/mm^2", ge=1, le=1e12
    )
    """Pressing force over D L, held by the machine while the gap floats; the gap given is then only where the nip angle
    is taken from a cake density.
    """
    idle_torque: NewtonMetres = quantity(
        0.0, symbol="T_0", unit="N m", source="machine (calibrated); 0: none", example="2 kN*m", ge=0, le=1e9
    )
    """Torque of both drives that does not go into the bed."""

    @model_validator(mode="before")
    @classmethod
    def _of_surface(cls, data: Any) -> Any:
        """Return the fields with a speed of the roll surface, such as "1.5 m/s", as that of the roll."""
        speed = data.get("speed") if isinstance(data, Mapping) else None
        if not isinstance(speed, str) or not speed.rstrip().endswith("m/s"):
            return data
        try:
            diameter = valid_alone(cls, "diameter", data.get("diameter"))
            return {**data, "speed": 2 * parse(speed, "m s-1") / diameter}
        except ValueError:  # told of the field itself
            return data

    @property
    def surface_speed(self) -> float:
        """Speed of the roll surface, U = omega D / 2, m/s."""
        return self.speed * self.diameter / 2

    @classmethod
    def _impossible(cls, known: dict[str, Any]) -> Iterator[Fault]:
        gap, entry_gap, diameter = (known.get(name) for name in ("gap", "entry_gap", "diameter"))
        if gap is None or entry_gap is None:
            return
        if gap > entry_gap:
            bound = f"must be at most the entry gap {show(entry_gap, 'm')}"
            yield Fault("gap", show(gap, "m"), bound, "narrow the gap or raise the entry gap")
        elif diameter is not None and entry_gap - gap >= STEEPEST_ENTRY * diameter:
            bound = (
                f"must be less than gap + {STEEPEST_ENTRY:g} x diameter = "
                f"{show(gap + STEEPEST_ENTRY * diameter, 'm')} (an entry angle of 60 degrees, above which a "
                "cubic streamline turns back; at gap + diameter the rolls end)"
            )
            yield Fault("entry_gap", show(entry_gap, "m"), bound, "begin the bed lower")


class Bed(Frozen):
    """Density of the grains, and how densely the bed packs.

    Examples
    --------
    >>> import hpgr
    >>> hpgr.Bed(solid_density=2740.0).max_solid_fraction
    0.9
    """

    solid_density: Density = quantity(
        2650.0, symbol="rho_s", unit="kg m-3", source="quartz, 2650 kg/m3", example=2700, ge=1, le=1e5
    )
    """Density of the grains."""
    feed_solid_fraction: Number = quantity(0.6, symbol="phi_feed", source="ours", example=0.6, ge=1e-3, le=1)
    """Solid fraction of the feed where compaction begins."""
    max_solid_fraction: Number = quantity(0.9, symbol="phi_max", source="ours", example=0.9, ge=1e-3, le=1)
    """Solid fraction that the bed cannot exceed."""

    @classmethod
    def _impossible(cls, known: dict[str, Any]) -> Iterator[Fault]:
        feed, limit = known.get("feed_solid_fraction"), known.get("max_solid_fraction")
        if feed is not None and limit is not None and feed > limit:
            bound = f"must be at least feed_solid_fraction {feed:g}"
            yield Fault("max_solid_fraction", f"{limit:g}", bound, "raise it, or lower the feed's")


class Level(NamedTuple):
    """A named resolution, and what it was measured to give on the paper's scene: |bias| + 2 standard errors of a
    run, and its time (docs/accuracy.md). Other scenes differ; with n < 1 no level holds.
    """

    streamlines: int
    points: int
    cells: int
    measured: str

    def values(self) -> dict[str, int]:
        """Return the fields of `Resolution` that a level sets."""
        return {name: getattr(self, name) for name in ("streamlines", "points", "cells")}


@cache
def levels() -> dict[str, Level]:
    """Return the named resolutions, coarsest first."""
    with open(DATA / "resolutions.toml", "rb") as file:
        return {name: Level(**level) for name, level in tomllib.load(file).items()}


class Resolution(Frozen):
    """How finely the scene is computed, and what is kept of it.

    Where a scene takes its resolution, the name of a level ("draft", "standard", "fine") stands for its values.

    Examples
    --------
    >>> import hpgr
    >>> hpgr.presets.paper().with_values({"resolution": "fine"}).resolution.points
    800
    """

    streamlines: Count = quantity(10, symbol="N", source="ours", example=10, ge=1, le=10_000)
    """Streamlines from the mid-plane to the roll."""
    points: Count = quantity(200, symbol="P", source="ours", example=200, ge=2, le=10_000_000)
    """Material points on a streamline, one time step apart."""
    cells: Count = quantity(1000, symbol="M", source="paper fig. 2", example=1000, ge=0, le=2_000_000_000)
    """Cells of a material point, each an equal mass of grains of one size; 0: stress only."""
    snapshots: Count = quantity(1, symbol="n_t", source="ours", example=1, ge=1, le=1_000_000)
    """Independent snapshots of the steady machine."""
    record: Literal["cells", "distributions", "product"] = "cells"
    """What is kept: 'cells' (every size), 'distributions' (mass per sieve at every point), 'product' (size distribution
    at the exit).
    """
    control_variate: bool = True
    """Whether the product that cells sample is corrected by what the same cells come to without cushioning, of which
    the mean is known; what is recorded of the cells themselves is never corrected.
    """
    sieves: tuple[Metres, ...] = quantity(
        tuple(float(f"{10 ** (k / 10 - 6):.6g}") for k in range(61)),
        symbol="s_k",
        unit="m",
        source="ours (R10 series, 1 um to 1 m)",
        example=["1 mm", "10 mm"],
        min_length=1,
        max_length=10_000,
    )
    """Sieves of the recorded distributions, finest first."""

    @classmethod
    def _impossible(cls, known: dict[str, Any]) -> Iterator[Fault]:
        sieves = known.get("sieves", ())
        for number, (finer, coarser) in enumerate(itertools.pairwise((0.0, *sieves)), start=1):
            if not finer < coarser:
                got, bound = f"sieve {number} of {show(coarser, 'm')}", f"must exceed {show(finer, 'm')}"
                yield Fault("sieves", got, bound, "sort the sieves from fine to coarse")

    def level(self) -> str:
        """Return the level of these values with its measured error and cost, or "custom"."""
        for name, level in levels().items():
            if level.values().items() <= vars(self).items():
                return f"{name}: {level.measured}, measured on the paper's scene"
        return "custom"


def _level(value: Any) -> Level | None:
    """Return the level that `value` names, if it names one."""
    return levels().get(value) if isinstance(value, str) else None


def _of_level(value: Any) -> Any:
    """Return the values of a level given by its name; anything else as it is."""
    level = _level(value)
    return value if level is None else level.values()


class Scene(Frozen):
    """One operating point of one machine with one ore: everything `hpgr.simulate` needs to know.

    Raises
    ------
    pydantic.ValidationError
        If any field or combination is impossible; it lists every fault at once.

    Examples
    --------
    >>> import hpgr
    >>> scene = hpgr.Scene(
    ...     rolls=dict(diameter="0.8 m", width="0.25 m", gap="19 mm", entry_gap="60 mm", speed="16 rpm"),
    ...     feed=dict(kind="uniform", bottom_size="1 mm", top_size="20 mm"),
    ... )
    >>> scene
    <hpgr.Scene: rolls 800 mm x 250 mm, gap 19 mm, 16 rpm; uniform feed to 20 mm; 10 x 200 x 1000>
    """

    rolls: Rolls
    """The machine."""
    feed: Feed
    """Size distribution of the feed."""
    bed: Bed = Bed()
    """Density and packing of the bed."""
    flow: Flow = PowerFlow()
    """How the bed moves."""
    elasticity: Elasticity = GranularElasticity()
    """How the bed is loaded; default: the paper's sand."""
    strength: Strength = SizeEffectStrength()
    """When a grain breaks; default: the paper's quartz."""
    fragments: Fragments = PowerLawFragments()
    """What a broken grain leaves."""
    exchange: Exchange | None = None
    """Segregation and mixing; None switches both off."""
    roll_width: RollWidth | None = None
    """Pressure along the roll width; None: the same all along."""
    resolution: Annotated[Resolution, BeforeValidator(_of_level)] = Resolution()
    """How finely, and what is kept; or the name of a level."""
    remark: str = ""
    """What a reader of the results should know, such as what is not calibrated."""

    @classmethod
    def _impossible(cls, known: dict[str, Any]) -> Iterator[Fault]:
        yield from _feed_faults(known)
        yield from _nip_faults(known)
        yield from _width_faults(known)

    @classmethod
    def from_file(cls, path: str | Path) -> Self:
        """Read a scene from a TOML file, or from a JSON file as `model_dump_json` writes it.

        A TOML file may begin with ``base = "industrial"`` (any preset) and give what differs. The path of a feed
        table in it is relative to the file.

        Raises
        ------
        OSError
            If the file cannot be read.
        ValueError
            If it is no path, or neither TOML nor JSON, or not a scene (pydantic.ValidationError, every fault listed).

        Examples
        --------
        >>> from pathlib import Path
        >>> from tempfile import TemporaryDirectory
        >>> import hpgr
        >>> with TemporaryDirectory() as folder:
        ...     path = Path(folder) / "mine.toml"
        ...     _ = path.write_text('base = "paper"\\n[rolls]\\ngap = "50 mm"\\n')
        ...     hpgr.Scene.from_file(path).rolls.gap
        0.05
        """
        path = path_of("path", path)
        text, kind = tables.text_of(path), "JSON" if path.suffix == ".json" else "TOML"
        try:
            if kind == "TOML" and _LONG_KEY.search(text):  # reading those takes memory by the square of their parts
                raise RecursionError
            data = _shallow(json.loads(text) if kind == "JSON" else tomllib.loads(text))
        except RecursionError:
            raise ValueError(f"{path}: nested too deep; a scene has sections of fields; see the README") from None
        except ValueError as error:
            remedy = "write it by Scene.model_dump_json()" if kind == "JSON" else "see the README for a scene file"
            raise ValueError(f"{path}: not {kind}: {error}; {remedy}") from None
        if kind == "JSON":
            return cls.model_validate_json(text)
        feed = data.get("feed")
        if isinstance(feed, dict) and isinstance(feed.get("table"), str):
            feed["table"] = str(path.parent / feed["table"])
        if "base" not in data:
            return cls.model_validate(data)
        return cls.preset(data.pop("base")).with_values(_dotted(data))

    @classmethod
    def preset(cls, name: str) -> Self:
        """Return a ready scene by its name; `hpgr.presets` lists them.

        Raises
        ------
        ValueError
            If there is no such preset.
        """
        if not isinstance(name, str) or name not in preset_names():
            known = ", ".join(map(repr, preset_names()))
            raise ValueError(f"base: got {name!r}; must be one of {known}; choose one of these, or leave it out")
        return cls.from_file(DATA / "presets" / f"{name}.toml")

    def with_values(self, values: Mapping[str, Any]) -> Self:
        """Return the scene with other values, given by dotted name, validated as a whole.

        A name without a dot replaces a whole part: ``{"exchange": None}``, ``{"exchange": {}}`` for its defaults. The
        name of a level, ``{"resolution": "fine"}``, sets streamlines, points and cells alone.
        Another kind of law drops the values of fields that it has not.

        Examples
        --------
        >>> import hpgr
        >>> hpgr.presets.paper().with_values({"rolls.gap": "40 mm", "resolution.cells": 0}).rolls.gap
        0.04

        Raises
        ------
        ValueError
            If values have no names, a name is unknown, or the scene is impossible with these values
            (pydantic.ValidationError, every fault listed).
        """
        if not isinstance(values, Mapping) or not all(isinstance(name, str) for name in values):
            raise ValueError(f"values: got {values!r:.80}; must be values by name; such as {{'rolls.gap': '40 mm'}}")
        data: dict[str, Any] = dict(self)  # parts left alone stay models, which are not validated again
        data |= {name: whole for name, whole in values.items() if "." not in name}
        level = _level(data["resolution"])
        if level is not None:  # what is kept of the results stays
            data["resolution"] = dict(self.resolution) | level.values()
        for name in {name.partition(".")[0] for name in values if "." in name}:
            part = {} if data.get(name) is None else data[name]
            if not isinstance(part, BaseModel | Mapping):
                continue  # refused below
            data[name] = dict(part)
            kind = values.get(f"{name}.kind")
            law = next((law for law in laws().get(name, []) if isinstance(kind, str) and kind in kinds_of(law)), None)
            if law:
                data[name] = {key: value for key, value in data[name].items() if key in law.model_fields}
        for name, value in values.items():
            section, _, key = name.partition(".")
            if key and isinstance(data[section], dict):
                data[section][key] = value
        return type(self).model_validate(data)

    def __repr__(self) -> str:
        rolls, grid = self.rolls, self.resolution
        return (
            f"<hpgr.Scene: rolls {show(rolls.diameter, 'm')} x {show(rolls.width, 'm')}, "
            f"gap {show(rolls.gap, 'm')}, {show(rolls.speed, 'rad s-1')}; "
            f"{self.feed.kind} feed to {show(self.feed.largest_grain, 'm')}; "
            f"{grid.streamlines} x {grid.points} x {grid.cells}>"
        )

    __str__ = __repr__


def check_scene(scene: Any) -> None:
    """Raise TypeError if an argument is no scene, such as the path of one."""
    if not isinstance(scene, Scene):
        raise TypeError(f"scene: got {scene!r:.80}; must be a scene; such as hpgr.Scene.from_file('my_machine.toml')")


def preset_names() -> tuple[str, ...]:
    """Return the names of the ready scenes."""
    return tuple(sorted(path.stem for path in (DATA / "presets").glob("*.toml")))


def _shallow(data: Any) -> Any:
    """Return what was read from a scene file, refusing what is nested deeper than the rows of a feed table."""
    level = [data]
    for _ in range(_DEEPEST):
        inner = [each.values() if isinstance(each, dict) else each for each in level if isinstance(each, dict | list)]
        level = [each for part in inner for each in part]
    if any(isinstance(each, dict | list) for each in level):
        raise RecursionError
    return data


def _dotted(data: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of a scene file by dotted name; a part without values by its own."""
    found: dict[str, Any] = {}
    for name, part in data.items():
        nested = isinstance(part, Mapping) and part
        found |= {f"{name}.{key}": value for key, value in part.items()} if nested else {name: part}
    return found


def _feed_faults(known: dict[str, Any]) -> Iterator[Fault]:
    """Yield grains that do not fit between the rolls."""
    entry_gap = known.get("rolls.entry_gap")
    if entry_gap is None:
        return
    bound = f"must be at most the entry gap rolls.entry_gap {show(entry_gap, 'm')}"
    for name in ("bottom_size", "top_size", "size"):
        size = known.get(f"feed.{name}")
        if size is not None and size > entry_gap:
            yield Fault(
                f"feed.{name}", show(size, "m"), bound, "crush or scalp the feed first, or begin the bed higher"
            )
    largest = next((size for size, percent in known.get("feed.table") or () if percent >= 100), 0.0)
    if known.get("feed.top_size") is None and largest > entry_gap:
        got = f"largest grain {show(largest, 'm')}"
        yield Fault("feed.table", got, bound, "scalp it with feed.top_size, or begin the bed higher")


def _nip_faults(known: dict[str, Any]) -> Iterator[Fault]:
    """Yield what keeps the nip from lying in the bed."""
    cake, feed = known.get("flow.cake_solid_fraction"), known.get("bed.feed_solid_fraction")
    gap, entry_gap, diameter = (known.get(f"rolls.{name}") for name in ("gap", "entry_gap", "diameter"))
    limit = known.get("bed.max_solid_fraction")
    if cake is not None and feed is not None and limit is not None and not feed <= cake <= limit:
        bound = f"must lie within feed_solid_fraction {feed:g} to max_solid_fraction {limit:g}"
        yield Fault("flow.cake_solid_fraction", f"{cake:g}", bound, "rolls compact the feed, and no further than that")
        return
    if None in (gap, entry_gap, diameter):
        return
    angle = known.get("flow.nip_angle")
    if cake is not None and feed is not None:
        slip = known.get("flow.slip", 0.0)
        densest = feed * densest_ratio(gap, diameter, slip)
        if cake > densest:
            bound = f"must be at most {densest:.3g}, beyond which no nip angle feeds the cake"
            yield Fault("flow.cake_solid_fraction", f"{cake:g}", bound, "give a lighter cake or a narrower gap")
            return
        angle = cake_nip_angle(gap, diameter, cake / feed, slip)
        if angle < LEAST_NIP_ANGLE:
            got, bound = f"{cake:g}, a nip angle of {show(angle, 'rad', 3)}", "must give at least "
            yield Fault("flow.cake_solid_fraction", got, bound + show(LEAST_NIP_ANGLE, "rad", 3), "give a denser cake")
            return
    if angle is not None and known.get("rolls.specific_pressing_force") is None and gap < entry_gap:
        nip = gap + diameter * (1 - math.cos(angle))
        if nip > entry_gap:
            bound = f"must be at least {show(nip, 'm')}, the roll distance at the nip angle {show(angle, 'rad')}"
            yield Fault("rolls.entry_gap", show(entry_gap, "m"), bound, "begin the bed higher")


def _width_faults(known: dict[str, Any]) -> Iterator[Fault]:
    """Yield what cannot be combined with slices along the roll width."""
    if not known.get("roll_width.slices"):
        return
    if known.get("exchange.interval"):
        bound = "must not be given beside exchange, which is not simulated slice by slice"
        yield Fault("roll_width", "slices", bound, "leave roll_width or exchange out")
    record = known.get("resolution.record", "product")
    if record != "product" and known.get("resolution.cells") != 0:
        bound = "must be 'product' with a roll_width"
        yield Fault("resolution.record", repr(record), bound, "take record = 'product', or leave roll_width out")


class FieldInfo(NamedTuple):
    """Unit, symbol and meaning of a scene field."""

    unit: str
    symbol: str
    text: str


def field_info(name: str) -> FieldInfo:
    """Return unit, symbol and meaning of the scene field with this dotted name.

    Raises
    ------
    ValueError
        If a scene has no such field; the message lists the closest names.
    """
    part, field = _find_field(name)
    key, extra = name.rpartition(".")[2], field.json_schema_extra or {}
    text = re.split("[;:]", meanings(part).get(key, key).rstrip("."))[0]
    return FieldInfo(extra.get("unit", "1"), extra.get("symbol", key), text)


def field_value(name: str, value: Any) -> Any:
    """Return `value` as the scene field with this dotted name holds it: SI, checked against the field alone.

    Examples
    --------
    >>> from hpgr.scene import field_value
    >>> field_value("rolls.gap", "40 mm")
    0.04

    Raises
    ------
    ValueError
        If a scene has no such field, or the field refuses the value.
    """
    part, _ = _find_field(name)
    section, _, key = name.partition(".")
    kinds = [kind for law in laws().get(section, []) for kind in kinds_of(law)] if key == "kind" else []
    if isinstance(value, str) and value in kinds:
        return value
    if kinds:
        raise ValueError(
            f"{name}: got {value!r:.80}; must be one of {', '.join(map(repr, kinds))}; choose one of these"
        )
    try:
        return valid_alone(part, key, value)
    except ValidationError as error:
        raise ValueError(f"{name}: {fault_in_words(part, (key,), error.errors(include_url=False)[0])}") from None


@cache
def laws() -> dict[str, list[type[Frozen]]]:
    """Return the models that each section of a scene may hold, by name; one for a section that is no union."""
    found = {name: parts_of(field) for name, field in Scene.model_fields.items()}
    return {name: parts for name, parts in found.items() if parts}


@cache
def fields() -> dict[str, tuple[type[Frozen], Any]]:
    """Return model and field of every field of a section by dotted name; of a union of laws the first that has it."""
    found: dict[str, tuple[type[Frozen], Any]] = {}
    for section, law in ((section, law) for section, every in laws().items() for law in every):
        for key, field in law.model_fields.items():
            found.setdefault(f"{section}.{key}", (law, field))
    return found


def _find_field(name: str) -> tuple[type[Frozen], Any]:
    """Return the model and the field with this dotted name."""
    if name not in fields():
        close = difflib.get_close_matches(str(name), fields(), n=3, cutoff=0.3) or ["rolls.gap"]
        raise ValueError(f"a scene has no field {name!r}; did you mean {' or '.join(map(repr, close))}?")
    return fields()[name]
