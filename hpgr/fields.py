"""Quantities of a scene: symbol, unit, source and bounds of a field; text with a unit in and out; all faults at once.

A field takes an SI number, or text with a unit ("60 mm", "19 rpm"). Bad input raises one `pydantic.ValidationError`
that lists every fault, each with field, value, bound and remedy.
"""

import ast
import difflib
import inspect
import math
import numbers
import operator
import re
from collections.abc import Iterable, Iterator, Mapping
from functools import cache, lru_cache, partial
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, NamedTuple, Self, get_args

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, create_model, model_validator
from pydantic_core import InitErrorDetails, PydanticCustomError


class Unit(NamedTuple):
    """How a person reads and writes an SI unit."""

    shown: str
    factor: float  # how many of the shown unit make one SI unit
    pint: str  # as the parser of units spells it
    example: str


UNITS = {
    "m": Unit("mm", 1e3, "m", "60 mm"),
    "Pa": Unit("MPa", 1e-6, "Pa", "0.84 MPa"),
    "rad s-1": Unit("rpm", 60 / (2 * math.pi), "rad/s", "19 rpm"),
    "rad": Unit("deg", 180 / math.pi, "rad", "9 deg"),
    "kg m-3": Unit("kg m-3", 1.0, "kg/m^3", "2.7 g/cm^3"),
    "N m": Unit("kN m", 1e-3, "N*m", "2 kN*m"),
    "m s-1": Unit("m/s", 1.0, "m/s", "0.7 m/s"),
    "kg s-1": Unit("t/h", 3.6, "kg/s", "200 t/h"),
    "N": Unit("kN", 1e-3, "N", "900 kN"),
    "W": Unit("kW", 1e-3, "W", "300 kW"),
    "J kg-1": Unit("kWh/t", 1 / 3600, "J/kg", "1.5 kWh/t"),
}

# stricter than pint, which reads past what it does not understand ("60; mm") and sums up ("60 mm + 1 m")
_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:e[+-]?\d+)?|[+-]?(?:nan|inf)(?=\s)"
_QUANTITY = re.compile(rf"\s*({_NUMBER})\s*((?:1/)?[a-zµμ][\w*/^.·-]*)?\s*", re.IGNORECASE)
_POWER = re.compile(r"(?<=[a-zµμ])(?=[23](?!\d))")  # "N/mm2" is N/mm^2
_WRITTEN = str.maketrans("²³·", "23*")
_TURNS = {"1/min", "min-1", "min^-1", "U/min"}  # as plants write rpm
_FAULTS = {"UndefinedUnitError": "is not known", "DimensionalityError": "measures something else"}  # pint's names
_ANGLE = re.compile("rpm|rad|deg|rev|turn")  # pint takes 1 Hz for 1 rad/s


def unit_shown(unit: str) -> tuple[str, float]:
    """Return the unit that a person reads in place of the SI unit `unit`, and how many of it make one."""
    return UNITS[unit][:2] if unit in UNITS else (unit, 1.0)


def show(value: float, unit: str, digits: int = 6) -> str:
    """Return `value`, given in the SI unit `unit`, as short text in the unit people use."""
    shown, factor = unit_shown(unit)
    return f"{value * factor:.{digits}g}" + ("" if shown == "1" else f" {shown}")


@cache
def _registry():
    import pint

    return pint.UnitRegistry()


@lru_cache
def _factor(named: str, known: Unit) -> float:
    """Return how many SI units one of the unit `named` is; ValueError if it has another dimension."""
    if named in (known.pint, known.shown):
        return 1.0 if named == known.pint else 1 / known.factor
    from pint.errors import PintError  # late: with its registry 0.3 s, that numbers and usual units need not pay

    try:
        return float((1.0 * _registry().Unit(named)).to(known.pint).magnitude)
    except (PintError, ArithmeticError, AttributeError, TypeError, ValueError, AssertionError) as error:
        fault = _FAULTS.get(type(error).__name__, "does not make a number")
        raise ValueError(f"not a quantity in {known.shown}: its unit {named!r} {fault}") from None


def parse(text: str, unit: str) -> float:
    """Return the value of `text`, such as "60 mm", in the SI unit `unit`.

    Raises
    ------
    ValueError
        If the text is not one number and its unit, or the unit has another dimension.
    """
    known = UNITS[unit]
    found = isinstance(text, str) and _QUANTITY.fullmatch(text)
    if not found:
        raise ValueError(f"not a number and a unit; write it like '{known.example}'")
    number, named = float(found[1]), _POWER.sub("^", (found[2] or "").translate(_WRITTEN))
    if not named:
        raise ValueError(f"text without a unit; write it as '{text.strip()} {known.shown}', or as a number in {unit}")
    if unit == "rad s-1":
        named = "rpm" if named in _TURNS else named
        if not _ANGLE.search(named):
            raise ValueError("not a rate of turning; write it like '19 rpm' or '2 rad/s'")
    magnitude = number * _factor(named, known)
    return float(f"{magnitude:.15g}")  # "13 mm" is the float 0.013, not its neighbour that 13 times 1e-3 gives


_SEED = (0, 2**63 - 1, "a whole number from 0 to 2**63 - 1", 0)  # which a result file can hold
_COUNT = (1, 10**6, "a whole number from 1 to 1,000,000", 2)
_RANGES = {  # of numbers that functions take beside a scene: least, most, both in words, and an example
    "tolerance": (1e-4, 0.5, "within 1e-4 to 0.5", 0.01),
    "max_cost": (0, math.inf, "within 0 to inf s", 60),
    "timeout": (0.1, 1e6, "within 0.1 to 1e6 s", 60),
    "percent": (0, 100, "within 0 to 100", 80),
    "seed": _SEED,
    "replicate": _SEED,
    "replicates": _COUNT,
    "threads": _COUNT,
    "workers": _COUNT,
}


def check_number(name: str, value: Any) -> None:
    """Raise ValueError if an argument of a public function, or an option, is not a number in its range."""
    least, most, words, example = _RANGES[name.strip("-").replace("-", "_")]
    kind = numbers.Integral if "whole" in words else numbers.Real
    if isinstance(value, bool) or not isinstance(value, kind) or not least <= value <= most:
        raise ValueError(f"{name}: got {value!r:.80}; must be {words}; such as {name}={example}")


def path_of(name: str, value: Any) -> Path:
    """Return the path that an argument of a public function is; ValueError if it is none."""
    if not isinstance(value, str | Path) or "\0" in str(value):
        raise ValueError(f"{name}: got {value!r:.80}; must be a path; such as {name}='outputs/mine'")
    return Path(value)


def names_of(name: str, value: Any, example: str) -> list[str]:
    """Return the names that an argument of a public function lists; ValueError if it lists none, or is one itself."""
    found = list(value) if isinstance(value, Iterable) and not isinstance(value, str) else [None]
    if not all(isinstance(one, str) for one in found):
        raise ValueError(f"{name}: got {value!r:.80}; must be a list of names; such as {name}=[{example!r}]")
    return found


def _number(value: Any, unit: str) -> float:
    """Return `value`, an SI number or text with a unit, as a float in `unit`."""
    if isinstance(value, str):
        if unit == "1":
            if value.strip().lower().lstrip("+") in {"inf", "infinity"}:
                return math.inf  # how inf is written in JSON, which has no number for it
            raise PydanticCustomError("text", "must be a number, not text")
        try:
            value = parse(value, unit)
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


Metres = Annotated[float, BeforeValidator(partial(_number, unit="m"))]
RadiansPerSecond = Annotated[float, BeforeValidator(partial(_number, unit="rad s-1"))]
Pascals = Annotated[float, BeforeValidator(partial(_number, unit="Pa"))]
Radians = Annotated[float, BeforeValidator(partial(_number, unit="rad"))]
NewtonMetres = Annotated[float, BeforeValidator(partial(_number, unit="N m"))]
Density = Annotated[float, BeforeValidator(partial(_number, unit="kg m-3"))]
Number = Annotated[float, BeforeValidator(partial(_number, unit="1"))]
Count = Annotated[int, BeforeValidator(_integer)]


def quantity(default: Any = ..., *, symbol: str, source: str, example: Any, unit: str = "1", **bounds: Any) -> Any:
    """Return a pydantic field that also carries symbol, SI unit, source and an example of its value.

    What it means is the docstring below it, a sentence whose first part says what it is.
    """
    extra = {"symbol": symbol, "unit": unit, "source": source, "example": example}
    return Field(default, json_schema_extra=extra, **bounds)


def default_kind(kind: str) -> BeforeValidator:
    """Return what makes a law of a union the one that is meant where no kind is given."""

    def with_kind(data: Any) -> Any:
        return {"kind": kind} | dict(data) if isinstance(data, Mapping) else data

    return BeforeValidator(with_kind)


class Fault(NamedTuple):
    """One reason to refuse a scene."""

    field: str
    value: str
    bound: str
    remedy: str

    def __str__(self) -> str:
        return f"got {self.value}; {self.bound}; {self.remedy}"


def faults_of(error: ValidationError, separator: str = "; ") -> str:
    """Return the faults of a refused scene as text, each with its field."""
    return separator.join(f"{'.'.join(map(str, fault['loc']))}: {fault['msg']}" for fault in error.errors())


class Frozen(BaseModel):
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
            known = values_of(model)
        except ValidationError as error:
            errors = [_explained(cls, fault) for fault in error.errors(include_url=False)]
            known = cls._known_values(data)
        faults = cls._impossible(known)
        errors += [_refused(str(fault), tuple(fault.field.split(".")), fault.value) for fault in faults]
        if errors:
            raise ValidationError.from_exception_data(cls.__name__, errors, hide_input=True)
        return model

    @classmethod
    def __get_pydantic_json_schema__(cls, core: Any, handler: Any) -> dict[str, Any]:
        found = handler.resolve_ref_schema(handler(core))
        for name, text in meanings(cls).items():
            found["properties"][name]["description"] = text
        return found

    @classmethod
    def _impossible(cls, known: dict[str, Any]) -> Iterator[Fault]:
        """Yield the faults of combinations, judged on the values that are valid alone."""
        yield from ()

    @classmethod
    def _known_values(cls, data: Any) -> dict[str, Any]:
        """Return the values of refused input that are valid alone, by dotted name."""
        if isinstance(data, BaseModel):
            return values_of(data)
        known: dict[str, Any] = {}
        for name, field in cls.model_fields.items():
            raw = data.get(name, field.default) if isinstance(data, Mapping) else None
            parts = parts_of(field)
            if parts:
                part = _meant(parts, raw)
                inner = part._known_values(raw) if raw is not None else {}
                known |= {f"{name}.{key}": value for key, value in inner.items()}
                continue
            try:
                known[name] = valid_alone(cls, name, raw)
            except ValidationError:
                continue
        return known


def parts_of(field: Any) -> list[type[Frozen]]:
    """Return the models that a field may hold, be it optional or a union of laws; none if it holds a plain value."""
    pending, found = [field.annotation], []
    while pending:
        kind = pending.pop(0)
        if isinstance(kind, type) and issubclass(kind, Frozen):
            found.append(kind)
        pending += [each for each in get_args(kind) if isinstance(each, type) or get_args(each)]
    return found


@cache
def meanings(part: type[Frozen]) -> dict[str, str]:
    """Return what the fields of a model mean, the docstring below each; pydantic would read all at import, in 40 ms."""
    found: dict[str, str] = {}
    for kind in part.__mro__[: part.__mro__.index(Frozen)]:
        for field, below in pairwise(ast.parse(inspect.getsource(kind)).body[0].body):
            if isinstance(field, ast.AnnAssign) and isinstance(below, ast.Expr):
                found.setdefault(field.target.id, " ".join(below.value.value.split()))
    return found


def _meant(parts: list[type[Frozen]], data: Any) -> type[Frozen]:
    """Return the law of a union that `data` names by its kind, or else the first."""
    if isinstance(data, Frozen):
        return type(data)
    named = data.get("kind") if isinstance(data, Mapping) else None
    return next((part for part in parts if isinstance(named, str) and named in kinds_of(part)), parts[0])


def kinds_of(law: type[Frozen]) -> tuple[str, ...]:
    """Return the kind of a law, in a tuple; empty for a model that is no law."""
    return get_args(law.model_fields["kind"].annotation) if "kind" in law.model_fields else ()


def valid_alone(part: type[Frozen], name: str, value: Any) -> Any:
    """Return `value` validated against one field of a model.

    Raises
    ------
    pydantic.ValidationError
        If the field refuses it.
    """
    return _carrier(part, name).model_validate({"value": value}).value


@cache
def _carrier(part: type[Frozen], name: str) -> type[BaseModel]:
    """Return a model of one field alone; made once, for making one takes a millisecond."""
    field = part.model_fields[name]
    return create_model("Alone", __config__=ConfigDict(allow_inf_nan=False), value=(field.annotation, field))


def values_of(model: BaseModel) -> dict[str, Any]:
    """Return the values of a model and its parts by dotted name."""
    flat: dict[str, Any] = {}
    for name, value in vars(model).items():  # a third of the time that the model's own iterator takes
        if isinstance(value, BaseModel):
            flat |= {f"{name}.{key}": inner for key, inner in values_of(value).items()}
        else:
            flat[name] = value
    return flat


def _refused(text: str, location: tuple, value: Any) -> InitErrorDetails:
    kind = PydanticCustomError("refused", "{text}", {"text": text})
    return InitErrorDetails(type=kind, loc=location, input=value)


_BOUNDS = {
    "greater_than": ("must be greater than", "gt"),
    "greater_than_equal": ("must be at least", "ge"),
    "less_than": ("must be less than", "lt"),
    "less_than_equal": ("must be at most", "le"),
}


def _explained(cls: type[Frozen], error: Any) -> InitErrorDetails:
    """Return pydantic's fault with value, bound and remedy in words; one told already is kept."""
    location = _without_kinds(cls, error["loc"])
    text = error["msg"] if error["type"] == "refused" else str(fault_in_words(cls, location, error))
    return _refused(text, location, error["input"])


def _without_kinds(cls: type[Frozen], location: tuple) -> tuple:
    """Return the place of a fault without the kind of law that pydantic puts between field and field."""
    field = cls.model_fields.get(location[0]) if location else None
    kinds = {kind for part in parts_of(field) for kind in kinds_of(part)} if field else set()
    return (location[0], *location[2:]) if len(location) > 1 and location[1] in kinds else location


def fault_in_words(cls: type[Frozen], location: tuple, error: Any) -> Fault:
    """Return one of pydantic's faults of `cls` with value, bound and remedy."""
    kind, value = error["type"], error["input"]
    field = cls.model_fields.get(location[0]) if location else None
    extra = (field.json_schema_extra if field else None) or {}
    unit, remedy = extra.get("unit", "1"), _remedy(cls, field)
    in_table = location[:1] == ("table",)
    text = repr(value) if in_table else _given(value, unit)
    if in_table and len(location) > 1:
        text = f"{text} in row {location[1] + 1}"
    if kind == "extra_forbidden":
        close = difflib.get_close_matches(str(location[-1]), cls.model_fields, n=1)
        remedy = f"did you mean {close[0]!r}?" if close else f"known fields: {', '.join(cls.model_fields)}"
        return Fault("", "an unknown field", "it does nothing here", remedy)
    if kind == "missing":
        return Fault("", "nothing", "it is required", remedy)
    if kind in _BOUNDS:
        words, key = _BOUNDS[kind]
        return Fault("", text, f"{words} {show(error['ctx'][key], unit)}", remedy)
    if kind in {"model_type", "model_attributes_type", "dict_type"}:
        return Fault("", text, "must be a table of fields", remedy)
    if kind == "finite_number":
        return Fault("", text, "must be finite", remedy)
    if kind == "literal_error":
        return Fault("", text, f"must be one of {error['ctx']['expected']}", "choose one of these")
    if kind.startswith("union_tag"):
        known = ", ".join(repr(each) for part in parts_of(field) for each in kinds_of(part))
        named = repr(value.get("kind")) if isinstance(value, Mapping) and "kind" in value else "no kind"
        return Fault("", named, f"its kind must be one of {known}", "choose one of these")
    return Fault("", text, error["msg"][0].lower() + error["msg"][1:], remedy)


def _given(value: Any, unit: str) -> str:
    """Return refused input as the user should see it: a number, or text that reads as one, in the unit people use."""
    if isinstance(value, str) and unit in UNITS:
        try:
            return show(parse(value, unit), unit)
        except ValueError:
            return repr(value)
    plain = isinstance(value, float) or (isinstance(value, int) and not isinstance(value, bool) and abs(value) < 1e300)
    return show(value, unit) if plain else repr(value)


def _remedy(cls: type[Frozen], field: Any) -> str:
    """Return what to give: an example of the field's values, one of its words, or the fields of a part."""
    example = (field.json_schema_extra or {}).get("example") if field else None
    if example is not None:
        return f"give a value such as {example!r}"
    parts = parts_of(field) if field else [cls]
    if parts:
        return f"give its fields: {', '.join(parts[0].model_fields)}"
    words = [repr(word) for word in get_args(field.annotation)]
    return f"choose one of {', '.join(words)}" if words else "see the field's description"
