"""What is simulated: the one door through which parameters come in, frozen and validated.

A `Scene` is made of small frozen models. Each field takes an SI number, or text with a unit ("60 mm",
"19 rpm"), and carries its symbol, unit and source. Bad input raises one `pydantic.ValidationError` that
lists every fault at once, each with field, value, bound and remedy.
"""

import difflib
import itertools
import json
import math
import numbers
import operator
import tomllib
from collections.abc import Iterator, Mapping
from functools import cache, partial
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, Self, get_args

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    create_model,
    model_validator,
)
from pydantic_core import InitErrorDetails, PydanticCustomError

from hpgr import tables, units

LEAST_GAP = 1e-6  # m
# The largest entry angle the cubic streamlines allow: above it their half width no longer grows with height.
_STEEPEST_ENTRY = 0.5  # (entry gap - gap) / diameter, reached at an entry angle of 60 degrees


class Fault(NamedTuple):
    """One reason to refuse a scene."""

    field: str
    value: str
    bound: str
    remedy: str

    def __str__(self) -> str:
        return f"got {self.value}; {self.bound}; {self.remedy}"


def _number(value: Any, unit: str) -> float:
    """Return `value`, an SI number or text with a unit, as a float in `unit`."""
    if isinstance(value, str):
        if unit == "1":
            if value.strip().lower().lstrip("+") in {"inf", "infinity"}:
                return math.inf  # how inf is written in JSON, which has no number for it
            raise PydanticCustomError("text", "must be a number, not text")
        try:
            value = units.parse(value, unit)
        except ValueError as error:
            raise PydanticCustomError("text", "{reason}", {"reason": str(error)}) from None
    if isinstance(value, bool) or not isinstance(value, numbers.Real):
        raise PydanticCustomError("number", "must be a number in {unit}", {"unit": unit})
    try:
        value = float(value)
    except OverflowError:
        raise PydanticCustomError("number", "must be a number that fits double precision") from None
    if math.isnan(value):
        raise PydanticCustomError("nan", "must not be NaN")
    return value


def _integer(value: Any) -> int:
    """Return `value` as an int; NumPy integers are integers, 10.0 and True are not."""
    try:
        if not isinstance(value, bool):
            return operator.index(value)
    except TypeError:
        pass
    raise PydanticCustomError("integer", "must be a whole number")


def _sieve_rows(value: Any) -> Any:
    """Read a table given as the path of a CSV file."""
    if isinstance(value, str | Path):
        try:
            return tables.read_sieve_table(value)
        except OSError as error:
            reason = f"the file cannot be read ({error.strerror})"
            raise PydanticCustomError("table", "{reason}", {"reason": reason}) from None
        except ValueError as error:
            raise PydanticCustomError("table", "{reason}", {"reason": str(error)}) from None
    return value


Metres = Annotated[float, BeforeValidator(partial(_number, unit="m"))]
RadiansPerSecond = Annotated[float, BeforeValidator(partial(_number, unit="rad s-1"))]
Pascals = Annotated[float, BeforeValidator(partial(_number, unit="Pa"))]
Radians = Annotated[float, BeforeValidator(partial(_number, unit="rad"))]
NewtonMetres = Annotated[float, BeforeValidator(partial(_number, unit="N m"))]
Density = Annotated[float, BeforeValidator(partial(_number, unit="kg m-3"))]
Number = Annotated[float, BeforeValidator(partial(_number, unit="1"))]
Count = Annotated[int, BeforeValidator(_integer)]


def _field(symbol: str, unit: str, text: str, source: str, remedy: str, default: Any = ..., **bounds: Any) -> Any:
    """Return a pydantic field that also carries symbol, unit, source and remedy."""
    extra = {"symbol": symbol, "unit": unit, "source": source, "remedy": remedy}
    description = f"{text} ({symbol}, {unit}). Source: {source}."
    return Field(default, description=description, json_schema_extra=extra, **bounds)


class _Frozen(BaseModel):
    """Frozen model that reports every fault of its input at once."""

    model_config = ConfigDict(
        frozen=True,
        extra="forbid",
        allow_inf_nan=False,
        ser_json_inf_nan="strings",
        hide_input_in_errors=True,
    )

    @model_validator(mode="wrap")
    @classmethod
    def _report_every_fault(cls, data: Any, handler: Any) -> Self:
        if isinstance(data, cls):
            return data
        errors: list[InitErrorDetails] = []
        try:
            model = handler(data)
            known = _values(model)
        except ValidationError as error:
            errors = [_explained(cls, fault) for fault in error.errors(include_url=False)]
            known = cls._known_values(data)
        errors += [_as_error(fault) for fault in cls._impossible(known)]
        if errors:
            raise ValidationError.from_exception_data(cls.__name__, errors, hide_input=True)
        return model

    @classmethod
    def _impossible(cls, known: dict[str, Any]) -> Iterator[Fault]:
        """Yield the faults of combinations, judged on the values that are valid alone."""
        yield from ()

    @classmethod
    def _known_values(cls, data: Any) -> dict[str, Any]:
        """Return the values of refused input that are valid alone, by dotted name."""
        if isinstance(data, BaseModel):
            return _values(data)
        known: dict[str, Any] = {}
        for name, field in cls.model_fields.items():
            raw = data.get(name, field.default) if isinstance(data, Mapping) else None
            part = _part(field)
            if part is not None:
                if raw is not None:
                    known |= {f"{name}.{key}": value for key, value in part._known_values(raw).items()}
                continue
            try:
                known[name] = _valid_alone(cls, name, raw)
            except ValidationError:
                continue
        return known


def _valid_alone(part: type["_Frozen"], name: str, value: Any) -> Any:
    """Return `value` validated against one field of a model."""
    return _carrier(part, name).model_validate({"value": value}).value


@cache
def _carrier(part: type["_Frozen"], name: str) -> type[BaseModel]:
    """Return a model of one field alone; made once, for making one takes a millisecond."""
    field = part.model_fields[name]
    return create_model("Alone", __config__=ConfigDict(allow_inf_nan=False), value=(field.annotation, field))


def _part(field: Any) -> type["_Frozen"] | None:
    """Return the model that a field holds, be it optional, or None if it holds a plain value."""
    for kind in (field.annotation, *get_args(field.annotation)):
        if isinstance(kind, type) and issubclass(kind, _Frozen):
            return kind
    return None


def _values(model: BaseModel) -> dict[str, Any]:
    """Return the values of a model and its parts by dotted name."""
    flat: dict[str, Any] = {}
    for name in type(model).model_fields:
        value = getattr(model, name)
        if isinstance(value, BaseModel):
            flat |= {f"{name}.{key}": inner for key, inner in _values(value).items()}
        else:
            flat[name] = value
    return flat


def _as_error(fault: Fault) -> InitErrorDetails:
    kind = PydanticCustomError("impossible", "{text}", {"text": str(fault)})
    return InitErrorDetails(type=kind, loc=tuple(fault.field.split(".")), input=fault.value)


_BOUNDS = {
    "greater_than": ("must be greater than", "gt"),
    "greater_than_equal": ("must be at least", "ge"),
    "less_than": ("must be less than", "lt"),
    "less_than_equal": ("must be at most", "le"),
}


def _explained(cls: type[_Frozen], error: Any) -> InitErrorDetails:
    """Return pydantic's fault with value, bound and remedy in words; one told already is kept."""
    location, kind = error["loc"], error["type"]
    if kind in {"impossible", "refused"}:
        return InitErrorDetails(
            type=PydanticCustomError(kind, "{text}", {"text": error["msg"]}),
            loc=location,
            input=error["input"],
        )
    field = cls.model_fields.get(location[0]) if location else None
    extra = (field.json_schema_extra if field else None) or {}
    unit, remedy, value = (
        extra.get("unit", "1"),
        extra.get("remedy") or _remedy(cls, field),
        error["input"],
    )
    plain = isinstance(value, float) or (isinstance(value, int) and not isinstance(value, bool) and abs(value) < 1e300)
    in_table = location[:1] == ("table",)
    text = units.show(value, unit) if plain and not in_table else repr(value)
    if in_table and len(location) > 1:
        text = f"{text} in row {location[1] + 1}"
    if kind == "extra_forbidden":
        text, bound = "an unknown field", "it does nothing here"
        close = difflib.get_close_matches(str(location[-1]), cls.model_fields, n=1)
        remedy = f"did you mean {close[0]!r}?" if close else f"known fields: {', '.join(cls.model_fields)}"
    elif kind == "missing":
        text, bound = "nothing", "it is required"
    elif kind in _BOUNDS:
        words, key = _BOUNDS[kind]
        limit = units.parse(value, unit) if isinstance(value, str) and unit != "1" else None
        text = units.show(limit, unit) if limit is not None else text
        bound = f"{words} {units.show(error['ctx'][key], unit)}"
    elif kind in {"model_type", "model_attributes_type"}:
        bound = "must be a table of fields"
    elif kind == "finite_number":
        bound = "must be finite"
    elif kind == "literal_error":
        bound, remedy = f"must be one of {error['ctx']['expected']}", "choose one of these"
    else:
        bound = error["msg"][0].lower() + error["msg"][1:]
    fault = Fault("", text, bound, remedy)
    return InitErrorDetails(
        type=PydanticCustomError("refused", "{text}", {"text": str(fault)}), loc=location, input=value
    )


def _remedy(cls: type[_Frozen], field: Any) -> str:
    """Return what to give where no remedy is carried: a field that is a part, a word or a switch, or `cls` itself."""
    part = _part(field) if field else cls
    if part is not None:
        return f"give its fields: {', '.join(part.model_fields)}"
    words = [repr(word) for word in get_args(field.annotation)]
    return f"choose one of {', '.join(words)}" if words else "see the field's description"


class Rolls(_Frozen):
    """Two equal counter-rotating rolls and the bed between them (paper section 2.2, figure 1).

    Examples
    --------
    >>> import hpgr
    >>> rolls = hpgr.Rolls(diameter="0.8 m", width="25 cm", gap=0.019, entry_gap="60 mm", speed="16 rpm")
    >>> round(rolls.speed, 3)  # rad/s
    1.676
    """

    diameter: Metres = _field(
        "D", "m", "Roll diameter", "machine", "give the roll diameter, such as '0.8 m'", ge=1e-3, le=1e3
    )
    width: Metres = _field(
        "L",
        "m",
        "Roll width, along the roll axes",
        "machine",
        "give the roll width, such as '0.25 m'",
        ge=1e-4,
        le=1e3,
    )
    gap: Metres = _field(
        "s_b",
        "m",
        "Gap where the rolls are closest",
        "machine",
        "measure the working gap, such as '20 mm'",
        ge=LEAST_GAP,
        le=1e3,
    )
    entry_gap: Metres = _field(
        "s_t", "m", "Distance between the roll surfaces where the modelled bed begins", "machine",
        "give the height of the modelled bed as the gap there, such as '100 mm'", ge=1e-6, le=1e3,
    )  # fmt: skip
    speed: RadiansPerSecond = _field(
        "omega", "rad s-1", "Roll speed", "machine", "give the roll speed, such as '19 rpm'", ge=1e-6, le=1e6
    )
    specific_pressing_force: Pascals | None = _field(
        "F_sp", "Pa", "Pressing force over D L, held by the machine while the gap floats; the gap given is then only "
        "where the nip angle is taken from a cake density", "machine",
        "give the pressing force over diameter x width, such as '3.5 N/mm^2'", None, ge=1, le=1e12,
    )  # fmt: skip
    idle_torque: NewtonMetres = _field(
        "T_0", "N m", "Torque of both drives that does not go into the bed", "machine (calibrated); 0: none",
        "measure the drives with the rolls apart, such as '2 kN*m'", 0.0, ge=0, le=1e9,
    )  # fmt: skip

    @classmethod
    def _impossible(cls, known: dict[str, Any]) -> Iterator[Fault]:
        gap, entry_gap, diameter = (known.get(name) for name in ("gap", "entry_gap", "diameter"))
        if gap is None or entry_gap is None:
            return
        if gap > entry_gap:
            yield Fault("gap", units.show(gap, "m"), f"must be at most the entry gap {units.show(entry_gap, 'm')}",
                        "narrow the gap or raise the entry gap")  # fmt: skip
        elif diameter is not None and entry_gap - gap >= _STEEPEST_ENTRY * diameter:
            yield Fault(
                "entry_gap", units.show(entry_gap, "m"),
                f"must be less than gap + {_STEEPEST_ENTRY:g} x diameter = "
                f"{units.show(gap + _STEEPEST_ENTRY * diameter, 'm')} (an entry angle of 60 degrees, above which a "
                "cubic streamline turns back; at gap + diameter the rolls end)",
                "begin the bed lower",
            )  # fmt: skip


class Material(_Frozen):
    """Ore: density, strength, fragments and the elasticity of the bed. Defaults: the paper's quartz.

    Examples
    --------
    >>> import hpgr
    >>> hpgr.Material(strength="2 MPa", cushioning=float("inf")).strength
    2000000.0
    """

    solid_density: Density = _field(
        "rho_s", "kg m-3", "Density of the grains", "quartz, 2650 kg/m3", "weigh the ore, such as 2700",
        2650.0, ge=1, le=1e5,
    )  # fmt: skip
    strength: Pascals = _field(
        "sigma_m", "Pa", "Crushing strength of a grain of size strength_size", "paper section 3 (quartz, 0.84 MPa)",
        "measure it on single grains, such as '0.84 MPa'", 0.84e6, ge=1, le=1e15,
    )  # fmt: skip
    strength_size: Metres = _field(
        "s_m", "m", "Grain size at which `strength` holds", "paper section 3 (60 mm)",
        "give the size the strength was measured at, such as '60 mm'", 0.06, ge=1e-6, le=10,
    )  # fmt: skip
    weibull_modulus: Number = _field(
        "w", "1", "Weibull modulus of grain strength; inf: strength without size effect",
        "paper section 3 (quartz, 3.04)", "give the Weibull modulus, such as 3, or inf", 3.04, ge=1e-3,
        allow_inf_nan=True,
    )  # fmt: skip
    cushioning: Number = _field(
        "n", "1", "Cushioning constant: small n shields grains unlike their neighbours; inf: no cushioning",
        "paper eq. 2; value ours", "give n, such as 1, or inf", 1.0, ge=1e-6, allow_inf_nan=True,
    )  # fmt: skip
    fragment_exponent: Number = _field(
        "gamma", "1", "Fragment ratio X has the distribution X**gamma; gamma = 3 - fractal dimension", "ours (uniform)",
        "give gamma: 1 is uniform, 0.3 to 0.4 is usual in packed beds", 1.0, ge=1e-3, le=1e6,
    )  # fmt: skip
    size_floor: Metres = _field(
        "s_floor", "m", "Grains below this size do not break", "ours (1 um, the grinding limit)",
        "give the finest size that still breaks, such as '1 um'", 1e-6, ge=1e-9, le=1,
    )  # fmt: skip
    bulk_modulus: Pascals = _field(
        "K", "Pa", "Scaling of the bed's bulk modulus", "paper section 3 (Fontainebleau sand)",
        "give K, such as '28.3 MPa'", 28.3e6, ge=1, le=1e15,
    )  # fmt: skip
    shear_modulus: Pascals = _field(
        "G", "Pa", "Scaling of the bed's shear modulus", "paper section 3 (Fontainebleau sand)",
        "give G, such as '13.1 MPa'", 13.1e6, ge=1, le=1e15,
    )  # fmt: skip
    elastic_exponent: Number = _field(
        "c", "1", "Pressure sensitivity of granular elasticity", "paper eq. 4; value ours (Hertz)",
        "give c, such as 0.5", 0.5, gt=-1, le=10,
    )  # fmt: skip
    feed_solid_fraction: Number = _field(
        "phi_feed", "1", "Solid fraction of the feed where compaction begins", "ours", "give a fraction such as 0.6",
        0.6, ge=1e-3, le=1,
    )  # fmt: skip
    max_solid_fraction: Number = _field(
        "phi_max", "1", "Solid fraction that the bed cannot exceed", "ours", "give a fraction such as 0.9",
        0.9, ge=1e-3, le=1,
    )  # fmt: skip

    @classmethod
    def _impossible(cls, known: dict[str, Any]) -> Iterator[Fault]:
        feed, limit = known.get("feed_solid_fraction"), known.get("max_solid_fraction")
        if feed is not None and limit is not None and feed > limit:
            yield Fault("max_solid_fraction", f"{limit:g}", f"must be at least feed_solid_fraction {feed:g}",
                        "raise it, or lower the feed's")  # fmt: skip


_FEED_FIELDS = {
    "uniform": {"bottom_size", "top_size"},
    "single": {"size"},
    "power_law": {"top_size", "exponent"},
    "rosin_rammler": {"size", "exponent", "top_size"},
    "table": {"table"},
}
_OPTIONAL_FEED_FIELDS = {"table": {"top_size"}}


class Feed(_Frozen):
    """Size distribution of the feed, by mass.

    Each kind has its own fields; any other is refused.

    - "uniform": uniform in size between bottom_size and top_size (the paper's feed)
    - "single": all grains of `size`
    - "power_law": passing = (s / top_size)**exponent (Gates-Gaudin-Schuhmann)
    - "rosin_rammler": passing = 1 - exp(-(s / size)**exponent), renormalised below top_size
    - "table": sieve table, linear in log size; rows (size, percent passing) or the path of a CSV file;
      top_size, if given, scalps the table there

    Examples
    --------
    >>> import hpgr
    >>> hpgr.Feed(kind="table", table=[("1 mm", 10), ("5 mm", 60), ("20 mm", 100)]).coarsest
    0.02
    """

    kind: Literal["uniform", "single", "power_law", "rosin_rammler", "table"] = Field(
        description="Kind of distribution: uniform, single, power_law, rosin_rammler or table"
    )
    bottom_size: Metres | None = _field(
        "s_min", "m", "Smallest grain", "feed", "give the smallest size, such as '8 mm'", None, ge=0, le=10
    )
    top_size: Metres | None = _field(
        "s_max", "m", "Largest grain", "feed", "give the largest size, such as '60 mm'", None, ge=1e-6, le=10
    )
    size: Metres | None = _field(
        "s_0", "m", "The size (single), or the size that 63.2 % passes (rosin_rammler)", "feed",
        "give the size, such as '40 mm'", None, ge=1e-6, le=10,
    )  # fmt: skip
    exponent: Number | None = _field(
        "m",
        "1",
        "Exponent of the distribution",
        "feed",
        "give the exponent, such as 0.7",
        None,
        ge=0.1,
        le=100,
    )
    table: Annotated[tuple[tuple[Metres, Number], ...] | None, BeforeValidator(_sieve_rows)] = _field(
        "F_0", "m, %", "Rows (size, percent passing), or the path of a CSV file", "feed",
        "give the CSV file of a sieve analysis", None,
    )  # fmt: skip

    @property
    def coarsest(self) -> float:
        """Size of the largest grain in m."""
        if self.top_size is not None:
            return self.top_size
        if self.table is None:
            return self.size
        return next(size for size, percent in self.table if percent >= 100)

    @classmethod
    def _impossible(cls, known: dict[str, Any]) -> Iterator[Fault]:
        kind = known.get("kind")
        if kind is None:
            return
        wanted = _FEED_FIELDS[kind]
        allowed = wanted | _OPTIONAL_FEED_FIELDS.get(kind, set())
        given = {name for name, value in known.items() if name != "kind" and value is not None}
        for name in sorted(wanted - given):
            if name in known:  # absent, rather than refused for another reason
                remedy = cls.model_fields[name].json_schema_extra["remedy"]
                yield Fault(name, "nothing", f"a {kind} feed needs it", remedy)
        for name in sorted(given - allowed):
            yield Fault(name, repr(known[name]), f"a {kind} feed has no such field",
                        f"remove it; a {kind} feed has {', '.join(sorted(allowed))}")  # fmt: skip
        bottom, top = known.get("bottom_size"), known.get("top_size")
        if kind == "uniform" and bottom is not None and top is not None and bottom >= top:
            yield Fault("bottom_size", units.show(bottom, "m"), f"must be less than top_size {units.show(top, 'm')}",
                        "give a range, or use kind 'single'")  # fmt: skip
        if kind == "table" and known.get("table") is not None:
            yield from _table_faults(known["table"], top)


def _table_faults(table: tuple[tuple[float, float], ...], top_size: float | None) -> Iterator[Fault]:
    """Yield what keeps the rows from being a cumulative distribution, naming each row."""
    if len(table) < 2:
        yield Fault("table", f"{len(table)} row", "must have at least 2 rows", "give the whole sieve analysis")
        return
    for number, (size, percent) in enumerate(table, start=1):
        row = f"row {number} ({units.show(size, 'm')}, {percent:g} %)"
        if not 0 < size <= 10:
            yield Fault("table", row, "its size must be above 0 and at most 10 m", "correct the sieve or its unit")
        if not 0 <= percent <= 100:
            yield Fault("table", row, "its passing must lie within 0 to 100 %", "correct the row")
    for number, ((size, percent), (next_size, next_percent)) in enumerate(itertools.pairwise(table), start=2):
        row = f"row {number} ({units.show(next_size, 'm')}, {next_percent:g} %)"
        if next_size <= size:
            yield Fault("table", row, f"its size must exceed the row before it, {units.show(size, 'm')}",
                        "sort the rows by size and remove doubles")  # fmt: skip
        if next_percent < percent:
            yield Fault("table", row, f"its passing must be at least the row before it, {percent:g} %",
                        "cumulative percent passing grows with size; correct the row")  # fmt: skip
    if table[-1][1] != 100:
        yield Fault("table", f"row {len(table)} ({table[-1][1]:g} %)", "the coarsest sieve must pass 100 %",
                    "add the sieve that everything passes")  # fmt: skip
    (size, percent), (next_size, next_percent) = table[:2]
    if percent > 0 and 0 < size < next_size:
        slope = (next_percent - percent) / math.log(next_size / size)
        if slope <= 0 or size * math.exp(-min(percent / slope, 700.0)) < 1e-9:
            yield Fault("table", f"row 1 ({units.show(size, 'm')}, {percent:g} %)",
                        "its slope extended below it reaches 0 % only under 1 nm",
                        "add a finer row with 0 % passing")  # fmt: skip
    empty = max((size for size, percent in table if percent <= 0), default=table[0][0])
    if top_size is not None and not empty < top_size <= table[-1][0]:
        yield Fault("top_size", units.show(top_size, "m"),
                    f"must lie within the table, above {units.show(empty, 'm')} to {units.show(table[-1][0], 'm')}",
                    "scalping only removes coarse grains")  # fmt: skip


class Flow(_Frozen):
    """How the bed moves between the rolls (paper section 2.2; profiles ours).

    Examples
    --------
    >>> import hpgr
    >>> round(hpgr.Flow(profile="nip", nip_angle="9 deg").nip_angle, 3)  # rad
    0.157
    """

    profile: Literal["power", "nip"] = Field(
        "power",
        description="Speed along a streamline: 'power', |v| = U (1 - y/H)**exponent (the paper's); "
        "'nip', U below the nip and the feed's density above it (real machines)",
    )
    exponent: Number = _field(
        "m", "1", "Exponent of the speed profile; 1 is the paper's linear law", "paper section 2.2",
        "give an exponent, such as 1", 1.0, ge=0.01, le=5,
    )  # fmt: skip
    entry_fraction: Number = _field(
        "y_0/H", "1", "Depth of the first material point as a fraction of the bed's height (v = 0 at depth 0)",
        "ours", "give a fraction such as 0.02", 0.02, ge=1e-9, lt=1,
    )  # fmt: skip
    nip_angle: Radians | None = _field(
        "alpha", "rad", "Nip angle of profile 'nip': where the rolls grip the bed", "machine and ore",
        "give the nip angle, such as '9 deg'", None, ge=1e-3, lt=math.pi / 3,
    )  # fmt: skip
    cake_solid_fraction: Number | None = _field(
        "phi_cake", "1", "Solid fraction of the pressed cake, from which the nip angle of profile 'nip' follows",
        "Torres & Casali 2009", "give cake density over solid density, such as 0.85", None, gt=0, le=1,
    )  # fmt: skip

    @classmethod
    def _impossible(cls, known: dict[str, Any]) -> Iterator[Fault]:
        given = [name for name in ("nip_angle", "cake_solid_fraction") if known.get(name) is not None]
        if known.get("profile") == "power":
            for name in given:
                yield Fault(name, f"{known[name]:g}", "must not be given with profile 'power', which has no nip",
                            "leave it out, or take profile 'nip'")  # fmt: skip
        if known.get("profile") == "nip" and len(given) != 1 and {"nip_angle", "cake_solid_fraction"} <= known.keys():
            yield Fault("nip_angle", " and ".join(given) or "nothing",
                        "must be one of nip_angle and cake_solid_fraction with profile 'nip'",
                        "give one of them, such as cake_solid_fraction = 0.85")  # fmt: skip


class RollWidth(_Frozen):
    """How pressure falls from the middle of the roll width to its ends; not to be mistaken for across the gap.

    The pressure at distance z from the middle is that of the middle times 1 - pressure_drop (2 z / L)**2
    (model page, section Real machines).
    """

    pressure_drop: Number = _field(
        "kappa", "1", "Part of the pressure that is lost at the ends of the rolls", "Torres & Casali 2009 (1); fitted",
        "give a fraction such as 0.8", 0.8, ge=0, le=1,
    )  # fmt: skip
    edge_share: Number = _field(
        "e", "1", "Part of the roll width whose product is called edge product", "Torres & Casali 2009",
        "give a fraction such as 0.2", 0.2, ge=1e-3, le=0.999,
    )  # fmt: skip
    slices: Count = _field(
        "N_z", "1", "Slices of the centre, and as many of the edge, that are crushed apart", "ours",
        "give a whole number such as 4", 4, ge=1, le=1000,
    )  # fmt: skip


class Stress(_Frozen):
    """How granular elasticity is integrated and which stress crushes (paper eqs. 1 and 4).

    Examples
    --------
    >>> import hpgr
    >>> hpgr.Stress(integrator="euler").crushing
    'mean'
    """

    integrator: Literal["increment", "euler"] = Field(
        "increment",
        description="'increment': increments of the state functions, exact at constant solid fraction (ours); "
        "'euler': the paper's explicit rule",
    )
    substeps: Count = _field(
        "k", "1", "Stress steps per time step", "ours", "give a whole number such as 1", 1, ge=1, le=10_000
    )
    crushing: Literal["mean", "major"] = Field(
        "mean", description="Stress that crushes: 'mean' is p (the paper's figures), 'major' is p + 2 q / 3"
    )


class Exchange(_Frozen):
    """Segregation and mixing between neighbouring material points, by swaps of cells (paper eq. 3; closure ours).

    Examples
    --------
    >>> import hpgr
    >>> hpgr.presets.paper().with_values({"exchange": hpgr.Exchange(mixing=0)}).exchange.segregation
    0.1
    """

    segregation: Number = _field(
        "A", "1", "Percolation velocity over shear rate and size difference: large grains rise, small ones sink",
        "ours", "give A, such as 0.1, or 0", 0.1, ge=0, le=100,
    )  # fmt: skip
    mixing: Number = _field(
        "B", "1", "Shear-induced self-diffusion over shear rate and mean size squared", "ours",
        "give B, such as 0.1, or 0", 0.1, ge=0, le=100,
    )  # fmt: skip
    fill: Literal["feed", "crushed"] = Field(
        "feed",
        description="What the machine is filled with at the start: 'feed', or the bed as 'crushed' without exchange",
    )
    interval: Count = _field(
        "n_s", "1", "Time steps between photographs", "ours", "give a whole number such as 20", 20, ge=1, le=1_000_000
    )
    record_startup: bool = Field(
        False, description="Whether photographs of the start-up, from the first fill on, come before the steady ones"
    )


def _default_sieves() -> tuple[float, ...]:
    """Return 1 um to 1 m in the R10 series (ten sieves a decade, ISO 3)."""
    return tuple(float(f"{10 ** (k / 10 - 6):.6g}") for k in range(61))


class Level(NamedTuple):
    """A named resolution, and what it was measured to give on the paper's scene: |bias| + 2 standard errors of a
    run, and its time (docs/accuracy.md). Other scenes differ; with n < 1 no level holds.
    """

    streamlines: int
    points: int
    cells: int
    measured: str


LEVELS = {
    "draft": Level(5, 100, 500, "P50, P80 and percent below 1 mm within 4 %, about 1 ms a case"),
    "standard": Level(10, 200, 2000, "P50, P80 and percent below 1 mm within 2 %, about 4 ms a case"),
    "fine": Level(10, 800, 32_000, "P50, P80 and percent below 1 mm within 0.5 %, about 40 ms a case"),
}


def level_text(level: str) -> str:
    """Return a level with its measured error and cost, for a reader of results."""
    return level if level == "custom" else f"{level}: {LEVELS[level].measured}, measured on the paper's scene"


_LEVEL_FIELDS = ("streamlines", "points", "cells")


class Resolution(_Frozen):
    """How finely the scene is computed, and what is kept of it.

    `level` names a measured choice of streamlines, points and cells, which are then not given.

    Examples
    --------
    >>> import hpgr
    >>> hpgr.Resolution(level="fine").points
    800
    """

    level: Literal["custom", "draft", "standard", "fine"] = Field(
        "custom", description="Named resolution; 'custom' takes streamlines, points and cells as given"
    )
    streamlines: Count = _field(
        "N",
        "1",
        "Streamlines from the mid-plane to the roll",
        "ours",
        "give a whole number such as 10",
        10,
        ge=1,
        le=10_000,
    )
    points: Count = _field(
        "P", "1", "Material points on a streamline, one time step apart", "ours", "give a whole number such as 200",
        200, ge=2, le=10_000_000,
    )  # fmt: skip
    cells: Count = _field(
        "M", "1", "Cells of a material point, each an equal mass of grains of one size; 0: stress only", "paper fig. 2",
        "give a whole number such as 1000, or 0", 1000, ge=0, le=2_000_000_000,
    )  # fmt: skip
    photographs: Count = _field(
        "n_t", "1", "Independent photographs of the steady machine", "ours", "give a whole number such as 1", 1, ge=1,
        le=1_000_000,
    )  # fmt: skip
    record: Literal["cells", "distributions", "product"] = Field(
        "cells",
        description="What is kept: 'cells' (every size), 'distributions' (mass per sieve at every point), "
        "'product' (size distribution at the exit)",
    )
    sieves: tuple[Metres, ...] = _field(
        "s_k", "m", "Sieves of the recorded distributions, finest first", "ours (R10 series, 1 um to 1 m)",
        "give rising sizes, such as ['1 mm', '10 mm']", _default_sieves(), min_length=1, max_length=10_000,
    )  # fmt: skip

    @model_validator(mode="before")
    @classmethod
    def _take_level(cls, data: Any) -> Any:
        named = LEVELS.get(data.get("level")) if isinstance(data, Mapping) else None
        if named is None:
            return data
        return {name: getattr(named, name) for name in _LEVEL_FIELDS} | dict(data)

    @classmethod
    def _impossible(cls, known: dict[str, Any]) -> Iterator[Fault]:
        named = LEVELS.get(known.get("level", ""))
        for name in _LEVEL_FIELDS if named else ():
            if known.get(name) not in (None, getattr(named, name)):
                yield Fault(name, str(known[name]), f"level {known['level']!r} has {getattr(named, name)}",
                            f"leave {name} or the level out")  # fmt: skip
        sieves = known.get("sieves", ())
        for number, (finer, coarser) in enumerate(zip((0.0, *sieves), sieves, strict=False), start=1):
            if not finer < coarser:
                yield Fault("sieves", f"sieve {number} of {units.show(coarser, 'm')}",
                            f"must exceed {units.show(finer, 'm')}", "sort the sieves from fine to coarse")  # fmt: skip


class Scene(_Frozen):
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

    rolls: Rolls = Field(description="The machine")
    feed: Feed = Field(description="Size distribution of the feed")
    material: Material = Field(Material(), description="The ore and its bed; default: the paper's quartz")
    flow: Flow = Field(Flow(), description="How the bed moves")
    stress: Stress = Field(Stress(), description="How the bed is loaded")
    exchange: Exchange | None = Field(None, description="Segregation and mixing; None switches both off")
    roll_width: RollWidth | None = Field(None, description="Pressure along the roll width; None: the same all along")
    resolution: Resolution = Field(Resolution(), description="How finely, and what is kept")
    note: str = Field("", description="What a reader of the results should know, such as what is not calibrated")

    @classmethod
    def _impossible(cls, known: dict[str, Any]) -> Iterator[Fault]:
        entry_gap = known.get("rolls.entry_gap")
        for name in ("bottom_size", "top_size", "size"):
            size = known.get(f"feed.{name}")
            if size is not None and entry_gap is not None and size > entry_gap:
                yield Fault(f"feed.{name}", units.show(size, "m"),
                            f"must be at most the entry gap rolls.entry_gap {units.show(entry_gap, 'm')}",
                            "crush or scalp the feed first, or begin the bed higher")  # fmt: skip
        yield from _nip_faults(known)
        if known.get("roll_width.slices") and known.get("exchange.interval"):
            yield Fault("roll_width", "slices",
                        "must not be given beside exchange, which is not simulated slice by slice",
                        "leave roll_width or exchange out")  # fmt: skip
        whole = known.get("resolution.record", "product") != "product" and known.get("resolution.cells") != 0
        if known.get("roll_width.slices") and whole:
            yield Fault("resolution.record", repr(known["resolution.record"]), "must be 'product' with a roll_width",
                        "take record = 'product', or leave roll_width out")  # fmt: skip
        table, top_size = known.get("feed.table"), known.get("feed.top_size")
        coarsest = next((size for size, percent in table or () if percent >= 100), 0.0)
        if entry_gap is not None and top_size is None and coarsest > entry_gap:
            yield Fault("feed.table", f"coarsest grain {units.show(coarsest, 'm')}",
                        f"must be at most the entry gap rolls.entry_gap {units.show(entry_gap, 'm')}",
                        "scalp it with feed.top_size, or begin the bed higher")  # fmt: skip

    @classmethod
    def from_file(cls, path: str | Path) -> Self:
        """Read a scene from a TOML file, or from a JSON file as `model_dump_json` writes it.

        The path of a feed table in it is relative to the file.

        Raises
        ------
        OSError
            If the file cannot be read.
        ValueError
            If it is neither TOML nor JSON, or not a scene (pydantic.ValidationError, every fault listed).

        Examples
        --------
        >>> from pathlib import Path
        >>> from tempfile import TemporaryDirectory
        >>> import hpgr
        >>> with TemporaryDirectory() as folder:
        ...     path = Path(folder) / "mine.json"
        ...     _ = path.write_text(hpgr.presets.paper().model_dump_json())
        ...     hpgr.Scene.from_file(path) == hpgr.presets.paper()
        True
        """
        path = Path(path)
        try:
            text = path.read_text(encoding="utf-8")
        except UnicodeDecodeError as error:
            raise ValueError(f"{path}: byte {error.start} is not UTF-8; save the scene as text in UTF-8") from None
        if path.suffix == ".json":
            try:
                json.loads(text)
            except json.JSONDecodeError as error:
                raise ValueError(f"{path}: not JSON: {error}; write it by Scene.model_dump_json()") from None
            return cls.model_validate_json(text)
        try:
            data = tomllib.loads(text)
        except tomllib.TOMLDecodeError as error:
            raise ValueError(f"{path}: not TOML: {error}; see the README for a scene file") from None
        feed = data.get("feed")
        if isinstance(feed, dict) and isinstance(feed.get("table"), str):
            feed["table"] = str(path.parent / feed["table"])
        return cls.model_validate(data)

    def with_values(self, values: Mapping[str, Any]) -> Self:
        """Return the scene with other values, given by dotted name, validated as a whole.

        A name without a dot replaces a whole part: ``{"exchange": None}``, ``{"exchange": {}}`` for its defaults.

        Examples
        --------
        >>> import hpgr
        >>> hpgr.presets.paper().with_values({"rolls.gap": "40 mm", "resolution.cells": 0}).rolls.gap
        0.04

        Raises
        ------
        pydantic.ValidationError
            If a name is unknown, or the scene is impossible with these values.
        """
        touched = {name.partition(".")[0] for name in values}
        data: dict[str, Any] = {  # parts left alone stay models, which are not validated again
            name: dict(part) if isinstance(part, BaseModel) and name in touched else part for name, part in self
        }
        if "resolution.level" in values:
            data["resolution"] = {k: v for k, v in data["resolution"].items() if k not in _LEVEL_FIELDS}
        elif any(f"resolution.{name}" in values for name in _LEVEL_FIELDS):
            data["resolution"]["level"] = "custom"
        for name, value in values.items():
            section, _, key = name.partition(".")
            data[section] = (data.get(section) or {}) | {key: value} if key else value
        return type(self).model_validate(data)

    def __repr__(self) -> str:
        rolls, grid = self.rolls, self.resolution
        return (
            f"<hpgr.Scene: rolls {units.show(rolls.diameter, 'm')} x {units.show(rolls.width, 'm')}, "
            f"gap {units.show(rolls.gap, 'm')}, {units.show(rolls.speed, 'rad s-1')}; "
            f"{self.feed.kind} feed to {units.show(self.feed.coarsest, 'm')}; "
            f"{grid.streamlines} x {grid.points} x {grid.cells}>"
        )

    __str__ = __repr__


def _nip_faults(known: dict[str, Any]) -> Iterator[Fault]:
    """Yield what keeps the nip from lying in the bed."""
    cake, feed = known.get("flow.cake_solid_fraction"), known.get("material.feed_solid_fraction")
    gap, entry_gap, diameter = (known.get(f"rolls.{name}") for name in ("gap", "entry_gap", "diameter"))
    limit = known.get("material.max_solid_fraction")
    if cake is not None and feed is not None and limit is not None and not feed <= cake <= limit:
        yield Fault("flow.cake_solid_fraction", f"{cake:g}",
                    f"must lie within feed_solid_fraction {feed:g} to max_solid_fraction {limit:g}",
                    "rolls compact the feed, and no further than that")  # fmt: skip
        return
    if None in (gap, entry_gap, diameter):
        return
    angle = known.get("flow.nip_angle")
    if cake is not None and feed is not None:
        room = (gap + diameter) ** 2 - 4 * gap * diameter * cake / feed
        if room < 0:
            densest = feed * (gap + diameter) ** 2 / (4 * gap * diameter)
            yield Fault("flow.cake_solid_fraction", f"{cake:g}",
                        f"must be at most {densest:.3g}, beyond which no nip angle feeds the cake",
                        "give a lighter cake or a narrower gap")  # fmt: skip
            return
        angle = math.acos(min((gap + diameter + math.sqrt(room)) / (2 * diameter), 1.0))
    if angle is not None and known.get("rolls.specific_pressing_force") is None and gap < entry_gap:
        nip = gap + diameter * (1 - math.cos(angle))
        if nip > entry_gap:
            yield Fault("rolls.entry_gap", units.show(entry_gap, "m"),
                        f"must be at least {units.show(nip, 'm')}, the roll distance at the nip angle "
                        f"{units.show(angle, 'rad')}", "begin the bed higher")  # fmt: skip


def faults_of(error: ValidationError, separator: str = "; ") -> str:
    """Return the faults of a refused scene as text, each with its field."""
    return separator.join(f"{'.'.join(map(str, fault['loc']))}: {fault['msg']}" for fault in error.errors())


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
    _, field = _find_field(name)
    extra = field.json_schema_extra or {}
    symbol = extra.get("symbol", name.rpartition(".")[2])
    return FieldInfo(extra.get("unit", "1"), symbol, field.description.split(" (")[0].split(":")[0])


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
    try:
        return _valid_alone(part, name.rpartition(".")[2], value)
    except ValidationError as error:
        fault = error.errors(include_url=False)[0] | {"loc": (name.rpartition(".")[2],)}
        raise ValueError(f"{name}: {_explained(part, fault)['type'].message()}") from None


def _find_field(name: str) -> tuple[type[_Frozen], Any]:
    fields = {
        f"{section}.{key}": (part, field)
        for section, part in ((name, _part(field)) for name, field in Scene.model_fields.items())
        if part is not None
        for key, field in part.model_fields.items()
    }
    if name not in fields:
        close = difflib.get_close_matches(name, fields, n=3, cutoff=0.3) or ["rolls.gap"]
        raise ValueError(f"a scene has no field {name!r}; did you mean {' or '.join(map(repr, close))}?")
    return fields[name]
