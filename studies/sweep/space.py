"""What a sweep is: its space and replicates, the cases they make, what all cases share, and what becomes of one.

A space is a product of axes. Along an axis one field varies, or several together (samples, operating points), or whole
scenes take turns: grids, designs and comparisons differ in nothing else.
"""

import math
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from hpgr.scene import Scene, field_info, field_value, fields

if TYPE_CHECKING:
    import xarray as xr

# Dimensions with a name of their own, which is also that of the command lines' option, and the scene fields along them.
AXES = {
    "gap": "rolls.gap",
    "press_force": "rolls.specific_pressing_force",
    "roll_speed": "rolls.speed",
    "feed_top_size": "feed.top_size",
}
SAMPLE = "sample"  # dimension of fields that vary together, if the user names none
SCENE = "scene"  # dimension of named scenes
_DIMS = {field: dim for dim, field in AXES.items()}
_PLAIN = {"bed", "resolution"}  # sections whose fields no other section's can be taken for
_TAKEN = {"time", "snapshot", "streamline", "point", "cell", "sieve", "slice", "replicate", "operating_point"}


class SweepSpec(NamedTuple):
    """What all cases of a sweep have in common; `tolerance` and `max_cost` as in `hpgr.simulate`."""

    base: Scene  # whose `resolution.record` decides whether cases are told whole or in summary
    seed: int = 0  # of all randomness
    tolerance: float | None = None
    max_cost: float = 60.0
    timeout: float | None = None  # s that a case may take; each then runs in a process (`studies.sweep.isolated`)
    code: str = ""  # `studies.sweep.cases.code_version` of the driver; a worker with other code refuses to work

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
    summary: dict[str, np.ndarray]
    diagnostics: str = ""
    whole: dict[str, np.ndarray] | None = None
    attrs: dict[str, Any] | None = None


class Axis(NamedTuple):
    """A dimension of a sweep."""

    # what is changed in the scene at each place along it, by dotted name; of a named scene, every section
    places: list[dict[str, Any]]
    labels: list | None = None  # what the places are called, where no field gives the dimension its name

    @property
    def fields(self) -> list[str]:
        """Fields that vary along the axis."""
        return [name for name in self.places[0] if "." in name]


class Space(NamedTuple):
    """Axes by dimension, and replicates; cases are numbered in the order of the axes, replicates fastest."""

    axes: dict[str, Axis]
    replicates: int = 1

    @property
    def dims(self) -> tuple[str, ...]:
        """Dimensions of a sweep's result, before those of a simulation."""
        return (*self.axes, "replicate")

    @property
    def shape(self) -> tuple[int, ...]:
        """Length of each dimension."""
        return (*(len(axis.places) for axis in self.axes.values()), self.replicates)

    @property
    def total(self) -> int:
        """Number of cases."""
        return math.prod(self.shape)

    @property
    def fields(self) -> list[str]:
        """Fields that vary."""
        return [field for axis in self.axes.values() for field in axis.fields]

    def case(self, number: int) -> Case:
        """Return a case by its number."""
        *places, replicate = index = tuple(map(int, np.unravel_index(number, self.shape)))
        values: dict[str, Any] = {}
        for axis, place in zip(self.axes.values(), places, strict=True):
            values |= axis.places[place]
        return Case(index, values, replicate)

    def number(self, index: tuple[int, ...]) -> int:
        """Return the number of the case at this index."""
        return int(np.ravel_multi_index(index, self.shape))

    def cases(self) -> Iterator[Case]:
        """Yield every case in its order."""
        return map(self.case, range(self.total))

    def bases(self, base: Scene) -> dict[str, Scene]:
        """Return the scenes that the fields are changed in, by name: those of the scene axis, or `base`."""
        axis = self.axes.get(SCENE)
        if axis is None:
            return {"": base}
        return {label: base.with_values(place) for label, place in zip(axis.labels, axis.places, strict=True)}


def plain(section: Any) -> Any:
    """Return a section of a scene as JSON can hold it."""
    return section.model_dump(mode="json")


# ---- names


def dim_of(field: str) -> str:
    """Return the name of the dimension that a scene field has in a sweep."""
    section, _, key = field.partition(".")
    return _DIMS.get(field) or (key if section in _PLAIN else f"{section}_{key}")


@cache
def _fields_by_name() -> dict[str, list[str]]:
    found: dict[str, dict[str, None]] = {}
    for field in fields():
        for name in (field, dim_of(field), field.partition(".")[2]):
            found.setdefault(name, {})[field] = None
    return {name: list(fields) for name, fields in found.items()}


def field_of(name: str) -> str:
    """Return the dotted name of the scene field that a dotted or plain name means, such as "gap".

    ValueError if there is none, or several.
    """
    known = _fields_by_name().get(name, [])
    if not known:
        field_info(name)  # which refuses it, and lists the closest names
    if len(known) > 1:
        raise ValueError(f"{name}: is the name of {len(known)} fields; give one of {', '.join(known)}")
    return known[0]


# ---- what users give -> axes


class _Column(NamedTuple):
    """A field and its values, SI, along a dimension."""

    field: str
    dim: str
    values: list
    labels: list | None


def axes_of(space: "Mapping[Any, Any] | xr.Dataset") -> dict[str, Axis]:
    """Return the axes of a space, as `studies.sweep.sweep` takes it, their values in SI.

    What no scene could take is refused by a ValueError that names the field, the value and the remedy.
    """
    if not isinstance(space, Mapping):
        raise ValueError(
            f"space: got {space!r:.80}; must be fields and their values; such as {{'gap': ['40 mm', '60 mm']}}"
        )
    axes: dict[str, Axis] = {}
    for name, values in _given(space):
        if name == SCENE:
            axes[SCENE] = _scene_axis(values)
            continue
        for column in _columns(name, values):
            _refuse_taken(column, axes)
            axes[column.dim] = _joined(axes.get(column.dim), column)
    wrong = next((dim for dim, axis in axes.items() if dim in AXES and AXES[dim] not in axis.fields), None)
    if wrong is not None:
        raise ValueError(f"{wrong}: is a dimension without {AXES[wrong]} along it; call it {SAMPLE!r}")
    return axes


def _given(space: Any) -> Iterator[tuple[Any, Any]]:
    """Yield names and values of a space; of a Dataset also the coordinates that are fields."""
    yield from space.items()
    if hasattr(space, "data_vars"):
        yield from ((name, value) for name, value in space.coords.items() if value.dims and name in _fields_by_name())


def _scene_axis(scenes: Any) -> Axis:
    if not isinstance(scenes, Mapping) or not scenes or not all(isinstance(one, Scene) for one in scenes.values()):
        raise ValueError(
            f"{SCENE}: got {scenes!r:.80}; must be named scenes; such as {{'soft': one_scene, 'hard': another_scene}}"
        )
    parts = [name for name in Scene.model_fields if name not in ("remark", "resolution")]  # compared at one resolution
    return Axis([{part: getattr(scene, part) for part in parts} for scene in scenes.values()], list(map(str, scenes)))


def _columns(name: Any, values: Any) -> Iterator[_Column]:
    if isinstance(name, tuple):
        fields = [field_of(each) for each in name]
        rows = [list(row) if isinstance(row, Iterable) else [row] for row in _listed(name, values)]
        uneven = next((row for row in rows if len(row) != len(fields)), None)
        if uneven is not None:
            raise ValueError(f"{', '.join(fields)}: got {uneven}; must be a value of each of the {len(fields)} fields")
        for field, column in zip(fields, zip(*rows, strict=True), strict=True):
            yield _Column(field, SAMPLE, [_axis_value(field, value) for value in column], None)
        return
    field = field_of(name)
    if not hasattr(values, "dims"):
        yield _Column(field, dim_of(field), [_axis_value(field, each) for each in _listed(field, values)], None)
        return
    if len(values.dims) != 1:
        raise ValueError(
            f"{name}: got dimensions {values.dims}; a field lies along one; stack them: .stack(sample=...)"
        )
    [dim] = values.dims
    own = dim.startswith("dim_") or _fields_by_name().get(dim) == [field]
    labels = values.coords.get(dim)
    yield _Column(
        field,
        dim_of(field) if own else dim,
        [_axis_value(field, each) for each in _with_unit(field, values)],
        None if own or labels is None or dim in _fields_by_name() else list(map(_label, labels.values.tolist())),
    )


def _label(value: Any) -> Any:
    return value if isinstance(value, int | float | str) else str(value)


def _with_unit(field: str, values: Any) -> list:
    """Return the values of a DataArray, as text with their unit where that is not the field's own."""
    unit, plain = values.attrs.get("units", "1"), values.values.tolist()
    return plain if unit in ("1", "", field_info(field).unit) else [f"{value!r} {unit}" for value in plain]


def _listed(name: Any, values: Any) -> list:
    if isinstance(values, str | bytes) or not isinstance(values, Iterable):
        raise ValueError(f"{name}: got {values!r:.80}; an axis is a list of values; such as [{values!r}]")
    found = list(values)
    if not found:
        raise ValueError(f"{name}: got no values; an axis needs at least one; give values or leave the axis out")
    return found


def _axis_value(field: str, value: Any) -> Any:
    if hasattr(value, "magnitude"):  # of pint
        value = value.magnitude if value.dimensionless else f"{float(value.magnitude)!r} {value.units:~C}"
    found = field_value(field, value)
    if not isinstance(found, int | float | str):
        raise ValueError(f"{field}: got {value!r}; an axis takes numbers or words, no lists; sweep one scene for each")
    return found


def _refuse_taken(column: _Column, axes: Mapping[str, Axis]) -> None:
    from hpgr.results import schema  # late: `--help` does without

    if column.dim in _TAKEN | {SCENE} | set(schema.VARIABLES):
        raise ValueError(f"{column.field}: lies along {column.dim!r}, which results have; call it {SAMPLE!r}")
    other = next((dim for dim, axis in axes.items() if column.field in axis.fields), None)
    if other is not None:
        raise ValueError(f"{column.field}: got it along {other} and along {column.dim}; give it once")


def _joined(axis: Axis | None, column: _Column) -> Axis:
    """Return an axis with one more field along it."""
    field, dim, values, labels = column
    if dim == dim_of(field):
        double = next((value for k, value in enumerate(values) if value in values[:k]), None)
        if double is not None:
            raise ValueError(f"{field}: got {double!r} twice; values must differ; use replicates to repeat a case")
    elif labels is None and axis is None:
        labels = list(range(len(values)))
    if axis is None:
        return Axis([{field: value} for value in values], labels)
    if len(axis.places) != len(values):
        raise ValueError(
            f"{field}: got {len(values)} values along {dim}, where {axis.fields[0]} has {len(axis.places)}; "
            "fields that vary together have a value at each place"
        )
    places = [place | {field: value} for place, value in zip(axis.places, values, strict=True)]
    return Axis(places, None if dim == dim_of(field) else axis.labels)


# ---- ranges and designs


def ends_of(ranges: Mapping[str, tuple[Any, Any]]) -> dict[str, tuple[float, float]]:
    """Return lowest and highest value of fields by dotted name, SI.

    ValueError if a field is none, or its range is none.
    """
    if not isinstance(ranges, Mapping):
        raise ValueError(
            f"ranges: got {ranges!r:.80}; must be fields, each with two ends; such as {{'gap': (0.04, 0.06)}}"
        )
    found = {}
    for name, ends in ranges.items():
        if not isinstance(ends, tuple | list) or len(ends) != 2:
            raise ValueError(f"{name}: got {ends!r:.80}; must be lowest and highest value; such as ('40 mm', '60 mm')")
        low, high = found[field_of(name)] = tuple(_axis_value(field_of(name), end) for end in ends)
        if isinstance(low, str) or isinstance(high, str) or not -math.inf < low < high < math.inf:
            raise ValueError(f"{name}: got {ends[0]!r} to {ends[1]!r}; must be a range of numbers, lowest first")
    return found


def between(ends: Mapping[str, tuple[float, float]], unit: np.ndarray) -> list[tuple]:
    """Return a row of values of the fields for each point of the unit cube, (point, field)."""
    whole = [isinstance(low, int) and isinstance(high, int) for low, high in ends.values()]
    rows = ([low + x * (high - low) for x, (low, high) in zip(at, ends.values(), strict=True)] for at in unit.tolist())
    return [tuple(round(value) if k else value for value, k in zip(row, whole, strict=True)) for row in rows]


def sobol_points(fields: int, count: int, seed: int) -> np.ndarray:
    """Return the first `count` points of a scrambled Sobol sequence in the unit cube, (point, field)."""
    from scipy.stats import qmc  # late: `--help` does without

    return qmc.Sobol(fields, rng=seed).random_base2(math.ceil(math.log2(count)))[:count]


def sobol_design(ranges: Mapping[str, tuple[Any, Any]], count: int, seed: int = 0) -> dict[tuple[str, ...], list]:
    """Return a space of `count` points spread evenly over ranges of fields, a power of two most evenly.

    Examples
    --------
    >>> from studies.sweep.space import sobol_design
    >>> [rows] = sobol_design({"rolls.gap": ("40 mm", "60 mm"), "rolls.speed": ("15 rpm", "19 rpm")}, 8).values()
    >>> len(rows), all(0.04 <= gap <= 0.06 for gap, _ in rows)
    (8, True)
    """
    ends = ends_of(ranges)
    if not 1 <= count <= 1_000_000:
        raise ValueError(f"sample: got {count}; must be 1 to 1,000,000 points; such as 256")
    return {tuple(ends): between(ends, sobol_points(len(ends), count, seed))}
