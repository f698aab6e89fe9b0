"""Text with a unit -> SI numbers, and SI numbers -> text in the unit people use."""

import re
from functools import cache

# What a person reads, per SI unit: (unit shown, how many of it make one SI unit).
SHOWN = {
    "m": ("mm", 1e3),
    "Pa": ("MPa", 1e-6),
    "rad s-1": ("rpm", 60 / (2 * 3.141592653589793)),
    "rad": ("deg", 180 / 3.141592653589793),
    "kg s-1": ("t/h", 3.6),
    "N": ("kN", 1e-3),
    "N m": ("kN m", 1e-3),
    "W": ("kW", 1e-3),
    "J kg-1": ("kWh/t", 1 / 3600),
}

# pint's spelling of the CF-style units that fields carry
_PINT = {"rad s-1": "rad/s", "kg m-3": "kg/m^3", "m": "m", "Pa": "Pa", "rad": "rad", "N m": "N*m"}
_EXAMPLES = {
    "rad s-1": "19 rpm",
    "kg m-3": "2.7 g/cm^3",
    "m": "60 mm",
    "Pa": "0.84 MPa",
    "rad": "9 deg",
    "N m": "2 kN*m",
}

# stricter than pint, which reads past what it does not understand ("60; mm") and sums up ("60 mm + 1 m")
_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:e[+-]?\d+)?|[+-]?(?:nan|inf)(?=\s)"
_QUANTITY = re.compile(rf"\s*({_NUMBER})\s*([a-zµμ][\w*/^.-]*)?\s*", re.IGNORECASE)
_FAULTS = {"UndefinedUnitError": "is not known", "DimensionalityError": "measures something else"}  # pint's names
_ANGLE = re.compile("rpm|rad|deg|rev|turn")  # pint takes 1 Hz for 1 rad/s


@cache
def _registry():
    import pint  # late: building the registry costs 0.2 s that plain numbers need not pay

    return pint.UnitRegistry()


def parse(text: str, unit: str) -> float:
    """Return the value of `text`, such as "60 mm", in the SI unit `unit`.

    Raises
    ------
    ValueError
        If the text is not one number and its unit, or the unit has another dimension.
    """
    from pint.errors import PintError

    shown = SHOWN.get(unit, (unit, 1.0))[0]
    found = _QUANTITY.fullmatch(text)
    if not found:
        raise ValueError(f"not a number and a unit; write it like '{_EXAMPLES[unit]}'")
    number, named = float(found[1]), (found[2] or "").strip()
    if not named:
        raise ValueError(f"text without a unit; write it as '{text.strip()} {shown}', or as a number in {unit}")
    if unit == "rad s-1" and not _ANGLE.search(named):
        raise ValueError("not a rate of turning; write it like '19 rpm' or '2 rad/s'")
    try:
        return float((number * _registry().Unit(named)).to(_PINT[unit]).magnitude)
    except (PintError, ArithmeticError, AttributeError, TypeError, ValueError, AssertionError) as error:
        fault = _FAULTS.get(type(error).__name__, "does not make a number")
        raise ValueError(f"not a quantity in {shown}: its unit {named!r} {fault}") from None


def show(value: float, unit: str, digits: int = 6) -> str:
    """Return `value`, given in the SI unit `unit`, as short text in the unit people use."""
    shown, factor = SHOWN.get(unit, (unit, 1.0))
    return f"{value * factor:.{digits}g}" + ("" if shown == "1" else f" {shown}")
