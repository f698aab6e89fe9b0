"""What a study is asked about, by name: "throughput", "specific energy", "P80", "passing 6 mm"; with values as text."""

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

from hpgr.fields import parse, show, unit_shown
from hpgr.scene import Scene

if TYPE_CHECKING:
    import xarray as xr

_NAMES = {"p50": "p50_total", "p80": "p80_total", "energy": "specific_energy"}
_PASSING = "passing"


class Quantity(NamedTuple):
    """A figure of a run."""

    variable: str  # that it is, or is part of
    unit: str  # SI
    words: str  # what it is called, by which `quantity_of` finds it
    sieve: float | None = None  # m, of a mass fraction passing

    @property
    def of_product(self) -> bool:
        """Whether it needs grains: everything else is told by stress alone."""
        return self.variable.endswith("_total")

    @property
    def shown(self) -> tuple[str, float]:
        """The unit that it is shown in, and how many of it make one SI unit."""
        return ("%", 100.0) if self.sieve is not None else unit_shown(self.unit)

    @property
    def label(self) -> str:
        """Words with the unit."""
        return f"{self.words} [{self.shown[0]}]"

    def of(self, values: Mapping[str, Any]) -> Any:
        """Return the figure of a run's values or of a Dataset of many, of a scene that `with_sieves` has made."""
        found = values[self.variable]
        if self.sieve is None:
            return found
        sieves = [float(sieve) for sieve in values["sieve"]]
        return found[..., min(range(len(sieves)), key=lambda k: abs(sieves[k] - self.sieve))]

    def value(self, text: str) -> float:
        """Return the value of text such as "60 %" or "1.5 kWh/t", SI."""
        if self.unit == "1":
            number = text.strip().removesuffix("%")
            return float(number) / (1 if number == text.strip() else 100)
        return parse(text, self.unit)

    def told(self, value: float, digits: int = 4) -> str:
        """Return a value as text in the unit it is shown in."""
        return show(value * 100, "1", digits) + " %" if self.sieve is not None else show(value, self.unit, digits)


def quantity_of(name: str) -> Quantity:
    """Return the figure with this name; ValueError if a run has none of that name.

    Examples
    --------
    >>> from studies.quantities import quantity_of
    >>> quantity_of("passing 6 mm").sieve, quantity_of("throughput").value("360 t/h")
    (0.006, 100.0)
    """
    from hpgr.results import schema  # late: `--help` does without

    first, _, size = str(name).strip().partition(" ")
    if first == _PASSING and size:
        sieve = parse(size, "m")
        return Quantity("passing_total", "1", f"passing {show(sieve, 'm')}", sieve)
    variable = str(name).strip().lower().replace(" ", "_")
    variable = _NAMES.get(variable, variable)
    entry = schema.VARIABLES.get(variable)
    if entry is None or entry.dims or variable == "flags":
        known = [one for one, entry in schema.VARIABLES.items() if not entry.dims and entry.units != "1"]
        raise ValueError(f"a run has no figure {name!r}; give 'passing 6 mm', or one of {', '.join(known)}")
    words = {"p50_total": "P50", "p80_total": "P80"}.get(variable, variable.replace("_", " "))
    return Quantity(variable, entry.units, words)


def with_sieves(scene: Scene, quantities: Iterable[Quantity]) -> Scene:
    """Return the scene as these figures need it: with their sieves, so that none is interpolated; without cells if none
    is of the product.
    """
    quantities = list(quantities)
    sieves = {one.sieve for one in quantities if one.sieve is not None}
    values = {"resolution.sieves": sorted({*scene.resolution.sieves, *sieves}), "resolution.record": "product"}
    product = next((one for one in quantities if one.of_product), None)
    if product is None:
        values["resolution.cells"] = 0
    elif scene.resolution.cells == 0:
        raise ValueError(f"resolution.cells: got 0 (stress only); must be at least 1 for {product.words}; such as 1000")
    return scene.with_values(values)


def refuse_lost(result: "xr.Dataset") -> None:
    """Raise ValueError if a case of a sweep holds no result."""
    from studies.show import report

    lost = report.lost_cases(result)
    if lost:
        raise ValueError(
            f"{len(lost)} of {result['status'].size} cases are lost; narrow the ranges; the first: {lost[0]}"
        )
