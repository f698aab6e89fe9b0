"""What a study says in the terminal: tables, the limits that were hit, and the cases that were lost."""

import json
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from hpgr.fields import show, unit_shown
from hpgr.results import flags, metrics
from hpgr.results.metrics import scene_of
from hpgr.results.schema import ERRORS, STATUS
from studies.sweep.space import SCENE

FIGURES = {  # variable -> heading, how many of its unit make one SI unit
    "operating_gap": ("gap [mm]", 1e3),
    "throughput": ("throughput [t/h]", 3.6),
    "p50_total": ("P50 [mm]", 1e3),
    "p80_total": ("P80 [mm]", 1e3),
    "passing_total": ("below {} [%]", 100.0),
    "specific_energy": ("W [kWh/t]", 1 / 3600),
    "peak_pressure": ("peak pressure [MPa]", 1e-6),
    "specific_pressing_force": ("Fsp [N/mm²]", 1e-6),
    "pressing_force": ("force [kN]", 1e-3),
    "power": ("power [kW]", 1e-3),
    "torque": ("torque [kN m]", 1e-3),
    "specific_throughput": ("mdot [t s/(h m³)]", 3.6),
    "nip_angle": ("nip [deg]", 180 / np.pi),
    "force_angle": ("beta [deg]", 180 / np.pi),
}
_WIDEST, _LONGEST = 118, 26  # characters and rows of a table in the terminal


def aligned(headings: Sequence[str], rows: Iterable[Sequence[str]], markdown: bool = False, words: int = 0) -> str:
    """Return rows of text as a table with aligned columns, or as markdown; the first `words` columns are flush left.

    Examples
    --------
    >>> from studies.show.report import aligned
    >>> print(aligned(["gap [mm]", "P80 [mm]"], [["60", "1.7"]]))
    gap [mm]  P80 [mm]
          60       1.7
    """
    rows = [list(headings), *map(list, rows)]
    if markdown:
        rows.insert(1, ["---" if k < max(words, 1) else "---:" for k in range(len(headings))])
        return "\n".join("| " + " | ".join(row) + " |" for row in rows)
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    flush = [str.ljust if k < words else str.rjust for k in range(len(widths))]
    lines = ("  ".join(put(*each) for put, *each in zip(flush, row, widths, strict=True)) for row in rows)
    return "\n".join(line.rstrip() for line in lines)


def axes_of(result: xr.Dataset) -> list[str]:
    """Return the swept dims of a study result, in order."""
    return [name for name in result["status"].dims if name not in ("replicate", "operating_point")]


def swept(result: xr.Dataset, dim: str) -> list[xr.DataArray]:
    """Return what varies along a swept dim, that of its own name first: fields, and what its places are called."""
    along = [value for value in result.coords.values() if value.dims == (dim,)]
    return sorted(along, key=lambda value: value.name != dim)


def places(result: xr.Dataset, dim: str) -> list[dict[str, Any]]:
    """Return what each place along a swept dim changes in the scene: fields, or every section of a named scene."""
    if dim == SCENE:
        texts = json.loads(result.attrs["scenes"])
        scenes = [scene_of(result.assign_attrs(scene=texts[name])) for name in result[SCENE].values.tolist()]
        return [{name: part for name, part in scene if name not in ("remark", "resolution")} for scene in scenes]
    fields = {axis.attrs["scene_field"]: axis.values.tolist() for axis in swept(result, dim) if is_field(axis)}
    return [dict(zip(fields, row, strict=True)) for row in zip(*fields.values(), strict=True)]


def is_field(axis: xr.DataArray) -> bool:
    """Return whether a coordinate has the values of a scene field."""
    return "scene_field" in axis.attrs


def place_text(result: xr.Dataset, dim: str, index: int) -> str:
    """Return a place along a swept dim in words: the value of each field, or what it is called."""
    along = swept(result, dim)
    if along[0].dtype.kind == "i" and len(along) > 1 and not is_field(along[0]):  # a mere number
        along = along[1:]
    told = value_text if len(along) == 1 else lambda axis, _: _place(axis, index)
    return ", ".join(told(axis, axis.values[index]) for axis in along)


def point_names(result: xr.Dataset, chosen: Iterable[int]) -> list[str]:
    """Return operating points, by their numbers in `operating_points`, in words."""
    axes = axes_of(result)
    every = list(np.ndindex(*(result.sizes[name] for name in axes)))
    told = ([place_text(result, name, k) for name, k in zip(axes, every[number], strict=True)] for number in chosen)
    return [", ".join(texts) for texts in told]


def operating_points(result: xr.Dataset) -> xr.Dataset:
    """Return the result with its swept dims stacked into one dimension `operating_point`."""
    axes = axes_of(result)
    if not axes:  # coordinates of cases take no new dimension by themselves
        cases = [name for name, value in result.coords.items() if "replicate" in value.dims and name != "replicate"]
        return result.reset_coords(cases).expand_dims("operating_point").set_coords(cases)
    return result.stack(operating_point=axes, create_index=False)


def percent_passing(result: xr.Dataset, sieve: float, total: bool = True) -> xr.DataArray:
    """Return the percent of the product passing `sieve` (m), linear in log size between recorded sieves."""
    fractions = result["passing_total" if total else "passing"].astype(float)
    found = 100 * metrics.between_sieves(fractions, np.array([sieve])).isel(sieve=0, drop=True)
    found.attrs = {"units": "percent", "long_name": f"product below {show(sieve, 'm')}"}
    return found


def figures(result: xr.Dataset, sieve: float) -> dict[str, xr.DataArray]:
    """Return the figures a study is read by, by heading, in the units people use."""
    found = {}
    for name, (heading, factor) in FIGURES.items():
        if name == "passing_total" and name in result:
            found[heading.format(show(sieve, "m"))] = percent_passing(result, sieve)
        elif name in result:
            found[heading] = result[name].astype(float) * factor
    return found


def spread(values: xr.DataArray) -> xr.DataArray:
    """Return the sample standard deviation over replicates; NaN where there is only one."""
    if values.sizes["replicate"] < 2:
        return values.isel(replicate=0) * np.nan
    deviation = values.std("replicate", ddof=1)
    return deviation.where(values.max("replicate") > values.min("replicate"), deviation * 0)  # not its rounding


def table(result: xr.Dataset, sieve: float) -> str:
    """Return the operating points as fit a screen: what varies in columns, axes first, what does not in a line."""
    if not any_result(result):
        return "no case holds a result"
    points = operating_points(result)
    return points_table(result, points, figures(points, sieve))


def points_table(result: xr.Dataset, points: xr.Dataset, found: dict[str, xr.DataArray]) -> str:
    """Return figures of operating points, by heading, as `table` does; mean ± standard deviation over replicates."""
    along = (axis.name for dim in axes_of(result) for axis in swept(result, dim))
    axes = {axis_label(points[name]): _axis_texts(points[name]) for name in along}
    columns = {}
    for heading, values in found.items():
        means, spreads = values.mean("replicate").values, spread(values).values
        columns[heading] = [_mean_and_spread(*each) for each in zip(means, spreads, strict=True)]
    columns = {name: texts for name, texts in columns.items() if texts not in axes.values()}  # a force that was set
    count = points.sizes["operating_point"]
    same = {name: texts[0] for name, texts in (axes | columns).items() if count > 1 and len(set(texts)) == 1}
    axes, columns = ({name: each for name, each in part.items() if name not in same} for part in (axes, columns))
    blocks = _blocks(axes, columns)
    rows = np.linspace(0, count - 1, min(count, _LONGEST // len(blocks) - 2)).round().astype(int)
    parts = [aligned(list(block), ([texts[k] for texts in block.values()] for k in rows)) for block in blocks]
    told = [f"the same everywhere: {', '.join(f'{name} {text}' for name, text in same.items())}"] if same else []
    if rows.size < count:
        told.append(f"{rows.size} of {count} operating points, evenly chosen; the file has all, and --csv writes them")
    if result.sizes["replicate"] > 1:
        told.append(f"(mean ± standard deviation of {result.sizes['replicate']} replicates)")
    return "\n".join(["\n\n".join(parts), *told])


def _blocks(axes: dict[str, list[str]], columns: dict[str, list[str]]) -> list[dict[str, list[str]]]:
    """Return the columns in tables that a screen is wide enough for, each after the axes."""
    blocks, width = [dict(axes)], 0
    axes_width = sum(2 + max(map(len, (key, *each))) for key, each in axes.items())
    for name, texts in columns.items():
        own = 2 + max(map(len, (name, *texts)))
        width += own
        if axes_width + width > _WIDEST and len(blocks[-1]) > len(axes):
            blocks.append(dict(axes))
            width = own
        blocks[-1][name] = texts
    return blocks


def plant_table(result: xr.Dataset, sieve: float) -> pd.DataFrame:
    """Return a row for every operating point: axes, replicates, mean and spread of every figure."""
    points = operating_points(result)
    along = [points[axis.name] for dim in axes_of(result) for axis in swept(result, dim)]
    columns = {axis_label(axis): shown_values(axis) for axis in along}
    columns["replicates"] = (points["status"] == STATUS["ok"]).sum("replicate").values
    for heading, values in figures(points, sieve).items():
        name, bracket, unit = heading.partition(" [")
        columns |= {heading: values.mean("replicate").values, f"{name} sd{bracket}{unit}": spread(values).values}
    return pd.DataFrame(columns)


def _mean_and_spread(mean: float, deviation: float) -> str:
    if np.isnan(mean):
        return "-"
    return f"{mean:.4g}" + (f" ± {deviation:.2g}" if deviation > 0 else "")


def remarks(result: xr.Dataset, every_flag: bool = False) -> list[str]:
    """Return a line for the scene's own remark, for estimated errors, and for the limits that were hit."""
    own = scene_of(result).remark
    lines = [f"remark: {own}"] if own else []
    worst = {name: 100 * float(result[error].max()) for name, error in ERRORS.items() if error in result}
    if worst:
        told = ", ".join(f"{name.replace('_', ' ')} {error:.2g} %" for name, error in worst.items())
        lines.append(f"estimated errors of a run (bias + 2 standard errors), at most: {told}")
    if result.attrs.get("left_out"):
        lines.append(f"left out, being of another shape from case to case: {result.attrs['left_out']}")
    if "exchange_substeps" in result:
        swaps, top = float(result["swaps_per_cell"].mean()), int(result["exchange_substeps"].max())
        lines.append(f"exchange: {swaps:.3g} swaps of a cell in one residence time; at most {top} substeps a time step")
    return lines + (flagged(result) if every_flag else flag_line(result))


def flag_line(result: xr.Dataset) -> list[str]:
    """Return one line on all limits that were hit, if any were; before it a value that was meant in another unit."""
    if "flags" not in result:
        return []
    points = operating_points(result)
    hit = {flag.name: int(((points["flags"] & flag.bit) > 0).any("replicate").sum()) for flag in flags.FLAGS}
    texts = (line for text in points["diagnostics"].values.ravel() for line in str(text).splitlines())
    meant = [f"check the unit: {line.partition(': ')[2]}" for line in texts if "is read in" in line][:1]
    told = ", ".join(f"{name.replace('_', ' ')} ({count})" for name, count in hit.items() if count)
    total = points.sizes["operating_point"]
    line = f"limits of the model that were hit, at how many of {total} operating points: {told}"
    return [*meant, line] if told else []


def flagged(result: xr.Dataset) -> list[str]:
    """Return a line for each limit that operating points have hit, with the words of the first that did."""
    if "flags" not in result:
        return []
    points, lines = operating_points(result), []
    for name, mask in flags.BITS.items():
        hit = (points["flags"] & mask) > 0
        if hit.any():
            texts = points["diagnostics"].transpose(*hit.dims).values[hit.values]
            told = next(line for line in str(texts[0]).splitlines() if line.startswith(name)).partition(": ")[2]
            count, total = int(hit.any("replicate").sum()), points.sizes["operating_point"]
            lines.append(f"flag {name} at {count} of {total} operating points; the first: {told}")
    return lines


def change(result: xr.Dataset, field: str) -> list[str]:
    """Return a line on how much P80 changes from end to end of the axis of a scene field, if it can be told.

    Replicates share their random numbers along an axis, so the change is that of pairs; the mean over other axes.
    """
    axes = (result[name] for name in axes_of(result) if result[name].attrs.get("scene_field") == field)
    axis = next(axes, None)
    if axis is None or "p80_total" not in result or axis.size < 2 or axis.dtype.kind not in "fiu":
        return []
    order = np.argsort(axis.values)
    p80 = result["p80_total"].astype(float).isel({axis.name: order})
    ratio = 100 * (p80.isel({axis.name: -1}) / p80.isel({axis.name: 0}) - 1)
    others = [name for name in ratio.dims if name != "replicate"]
    ratio = ratio.mean(others)
    count = int(ratio.notnull().sum())
    if not count:
        return []
    ends = f"{_place(axis, order[0])} to {_place(axis, order[-1])}"
    if (np.abs(ratio) < 1e-4).all():  # of a percent: rounding
        return [f"P80 does not change from {ends}."]
    error = f" ± {float(ratio.std(ddof=1)) / np.sqrt(count):.2g}" if count > 1 else ""
    told = " (mean ± standard error of pairs)" if error else ""
    over = f", on average over {' and '.join(others).replace('_', ' ')}" if others else ""
    return [f"P80 changes by {float(ratio.mean()):+.3g}{error} % from {ends}{told}{over}."]


def lost_cases(result: xr.Dataset) -> list[str]:
    """Return a line for every operating point that lost replicates: status, where, why."""
    words, axes = {number: word for word, number in STATUS.items()}, axes_of(result)
    lost: dict[tuple, int] = {}
    for *index, replicate in np.argwhere(result["status"].values != STATUS["ok"]):
        case = result.isel({**dict(zip(axes, index, strict=True)), "replicate": replicate})
        key = (*index, int(case["status"]), str(case["message"].values))
        lost[key] = lost.get(key, 0) + 1
    lines = []
    for (*index, status, message), count in lost.items():
        along = [(axis, k) for name, k in zip(axes, index, strict=True) for axis in swept(result, name)]
        place = [_place(axis, k) for axis, k in along]
        place.append(f"{count} of {result.sizes['replicate']} replicates")
        lines.append(f"{words[status]}: {', '.join(place)}: {message}")
    return lines


def any_result(result: xr.Dataset) -> bool:
    """Return whether at least one case is well."""
    return bool((result["status"] == STATUS["ok"]).any())


def joined(names: Iterable[str]) -> str:
    """Return names of axes in words, one after the other."""
    return ", ".join(name.replace("_", " ") for name in names)


def axis_label(axis: xr.DataArray) -> str:
    """Return a swept coordinate's name with the unit it is shown in."""
    name, unit = axis.name.replace("_", " "), _unit(axis)
    return f"{name} [{unit}]" if unit else name


def shown_values(axis: xr.DataArray) -> np.ndarray:
    """Return a swept coordinate's values in the unit it is shown in."""
    return axis.values * unit_shown(axis.attrs.get("units", "1"))[1] if axis.dtype.kind in "fiu" else axis.values


def value_text(axis: xr.DataArray, value) -> str:
    """Return a value of a swept coordinate as text with its unit."""
    if axis.dtype.kind not in "fiu":
        return str(value)
    return f"{float(value) * unit_shown(axis.attrs.get('units', '1'))[1]:.6g} {_unit(axis)}".rstrip()


def _unit(axis: xr.DataArray) -> str:
    """Return the unit that a swept coordinate is shown in; a pressing force over an area is no stress."""
    if axis.attrs.get("scene_field") == "rolls.specific_pressing_force":
        return "N/mm²"
    return unit_shown(axis.attrs.get("units", "1"))[0].removeprefix("1")


def _place(axis: xr.DataArray, index: int) -> str:
    return f"{axis.name.replace('_', ' ')} {value_text(axis, axis.values[index])}"


def _axis_texts(axis: xr.DataArray) -> list[str]:
    return [f"{value:.6g}" if axis.dtype.kind in "fiu" else str(value) for value in shown_values(axis)]
