"""What a sweep is: its axes and replicates, the cases they make, what all cases share, and what becomes of one."""

import math
from collections.abc import Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

from hpgr.scene import Scene, field_value

if TYPE_CHECKING:
    import numpy as np

# Dimensions with a name of their own, which is also that of the command lines' option, and the scene fields along them.
AXES = {
    "gap": "rolls.gap",
    "press_force": "rolls.specific_pressing_force",
    "roll_speed": "rolls.speed",
    "feed_top_size": "feed.top_size",
}
_DIMS = {field: dim for dim, field in AXES.items()}
_PLAIN = {"bed", "resolution"}  # sections whose fields no other section's can be taken for


class SweepSpec(NamedTuple):
    """What all cases of a sweep have in common.

    Attributes
    ----------
    base : Scene
        Base scene; its `resolution.record` decides whether cases are told whole or in summary.
    seed : int
        Seed of all randomness.
    tolerance, max_cost : float
        As in `hpgr.simulate`.
    timeout : float or None
        Seconds that a case may take; cases then run in processes of their own (`studies.sweep.isolated`).
    code : str
        `studies.sweep.cases.code_version` of the driver; a worker with other code refuses to work.
    """

    base: Scene
    seed: int = 0
    tolerance: float | None = None
    max_cost: float = 60.0
    timeout: float | None = None
    code: str = ""

    @property
    def whole(self) -> bool:
        """Whether cases are told whole: every recorded variable, not only the summary."""
        return self.base.resolution.record != "product"


class Case(NamedTuple):
    """One scene to run: where its result belongs, and the values that make it."""

    index: tuple[int, ...]
    values: dict[str, Any]
    replicate: int


class CaseResult(NamedTuple):
    """What became of a case: its summary by variable name and the limits it hit, or why there is none.

    Of a sweep that records more than the product, `whole` has every variable by name, and `attrs` what its file
    says of it.
    """

    index: tuple[int, ...]
    status: str
    message: str
    summary: "dict[str, np.ndarray]"
    diagnostics: str = ""
    whole: "dict[str, np.ndarray] | None" = None
    attrs: dict[str, Any] | None = None


class Space(NamedTuple):
    """Axes, by scene field, and replicates; cases are numbered in the order of the axes, replicates fastest."""

    grid: dict[str, list]
    replicates: int

    @property
    def dims(self) -> tuple[str, ...]:
        """Dimensions of a sweep's result, before those of a simulation."""
        return (*map(dim_of, self.grid), "replicate")

    @property
    def shape(self) -> tuple[int, ...]:
        """Length of each dimension."""
        return (*map(len, self.grid.values()), self.replicates)

    @property
    def total(self) -> int:
        """Number of cases."""
        return math.prod(self.shape)

    def case(self, number: int) -> Case:
        """Return a case by its number."""
        index = []
        for length in reversed(self.shape):
            number, place = divmod(number, length)
            index.append(place)
        *places, replicate = reversed(index)
        values = {name: self.grid[name][place] for name, place in zip(self.grid, places, strict=True)}
        return Case((*places, replicate), values, replicate)

    def number(self, index: tuple[int, ...]) -> int:
        """Return the number of the case at this index."""
        found = 0
        for place, length in zip(index, self.shape, strict=True):
            found = found * length + place
        return found

    def cases(self) -> Iterator[Case]:
        """Yield every case in its order."""
        return map(self.case, range(self.total))


def dim_of(field: str) -> str:
    """Return the name of the dimension that a scene field has in a sweep."""
    section, _, key = field.partition(".")
    return _DIMS.get(field) or (key if section in _PLAIN else f"{section}_{key}")


def axis_values(axes: Mapping[str, Iterable]) -> dict[str, list]:
    """Return the axes with their values in SI, refusing what no scene could take.

    Raises
    ------
    ValueError
        Naming the axis, the value and the remedy.
    """
    grid = {name: [_axis_value(name, value) for value in _listed(name, values)] for name, values in axes.items()}
    for name, values in grid.items():
        if not values:
            raise ValueError(f"{name}: got no values; an axis needs at least one; give values or leave the axis out")
        double = next((value for k, value in enumerate(values) if value in values[:k]), None)
        if double is not None:
            raise ValueError(f"{name}: got {double!r} twice; values must differ; use replicates to repeat a case")
    return grid


def _listed(name: str, values: Any) -> list:
    if isinstance(values, str) or not isinstance(values, Iterable):
        raise ValueError(f"{name}: got {values!r}; an axis is a list of values; such as [{values!r}]")
    return list(values)


def _axis_value(name: str, value: Any) -> Any:
    found = field_value(name, value)
    if not isinstance(found, int | float | str):
        raise ValueError(f"{name}: got {value!r}; an axis takes numbers or words, no lists; sweep one scene for each")
    return found
