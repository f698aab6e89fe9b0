"""Text with a unit -> SI numbers, and SI numbers -> text in the unit people use."""

from functools import cache

# What a person reads, per SI unit: (unit shown, how many of it make one SI unit).
SHOWN = {
    "m": ("mm", 1e3),
    "Pa": ("MPa", 1e-6),
    "rad s-1": ("rpm", 60 / (2 * 3.141592653589793)),
    "kg s-1": ("t/h", 3.6),
}

# pint's spelling of the CF-style units that fields and variables carry
_PINT = {"rad s-1": "rad/s", "kg m-3": "kg/m^3", "m": "m", "Pa": "Pa", "1": ""}


@cache
def _registry():
    import pint  # late: building the registry costs 0.2 s that plain numbers need not pay

    return pint.UnitRegistry()


def parse(text: str, unit: str) -> float:
    """Return the value of `text`, such as "60 mm", in the SI unit `unit`.

    Raises
    ------
    ValueError
        If the text is no number with a unit, or its unit has another dimension.
    """
    import pint
    from pint.errors import PintError

    shown = SHOWN.get(unit, (unit, 1.0))[0]
    try:
        quantity = _registry().Quantity(text)
        bare = not isinstance(quantity, pint.Quantity) or quantity.dimensionless
        if bare and unit != "1":
            raise ValueError(f"text without a unit; write it as '{text.strip()} {shown}', or as a number in {unit}")
        return float(quantity.to(_PINT[unit]).magnitude)
    except (PintError, ArithmeticError, AttributeError, TypeError, AssertionError, SyntaxError) as error:
        raise ValueError(f"not a quantity in {shown} ({type(error).__name__})") from None


def show(value: float, unit: str) -> str:
    """Return `value`, given in the SI unit `unit`, as short text in the unit people use."""
    shown, factor = SHOWN.get(unit, (unit, 1.0))
    return f"{value * factor:.6g}" + ("" if shown == "1" else f" {shown}")
