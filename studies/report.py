"""What a study says in the terminal: a table of operating points, notes, and the cases that were lost."""

import numpy as np
import xarray as xr

from hpgr import metrics, units
from hpgr.scene import Scene
from hpgr.schema import ERRORS, FLAGS
from studies.sweep import STATUS


def axes_of(result: xr.Dataset) -> list[str]:
    """Return the swept dims of a study result, in order."""
    return [name for name, value in result.coords.items() if "scene_field" in value.attrs]


def operating_points(result: xr.Dataset) -> xr.Dataset:
    """Return the result with its swept dims stacked into one dimension `operating_point`."""
    axes = axes_of(result)
    if not axes:
        return result.expand_dims("operating_point")
    return result.stack(operating_point=axes, create_index=False)


def percent_passing(result: xr.Dataset, sieve: float, total: bool = True) -> xr.DataArray:
    """Return the percent of the product passing `sieve` (m), linear in log size between recorded sieves."""
    fractions = result["passing_total" if total else "passing"]
    found = 100 * metrics.between_sieves(fractions, np.array([sieve])).isel(sieve=0, drop=True)
    found.attrs = {"units": "percent", "long_name": f"product below {units.show(sieve, 'm')}"}
    return found


READ = ("throughput", "p50_total", "p80_total", "passing_total", "peak_pressure")


def figures(result: xr.Dataset, sieve: float) -> dict[str, xr.DataArray]:
    """Return the figures a study is read by, by heading, in the units people use."""
    result = result[[name for name in READ if name in result]].astype(float)
    found = {"throughput [t/h]": result["throughput"] * 3.6}
    if "p80_total" in result:
        found["P50 [mm]"] = result["p50_total"] * 1e3
        found["P80 [mm]"] = result["p80_total"] * 1e3
        found[f"below {units.show(sieve, 'm')} [%]"] = percent_passing(result, sieve)
    found["peak pressure [MPa]"] = result["peak_pressure"] * 1e-6
    return found


_MACHINE = {  # variable -> heading, how many of its unit make one SI unit
    "operating_gap": ("gap [mm]", 1e3),
    "specific_pressing_force": ("Fsp [N/mm²]", 1e-6),
    "pressing_force": ("force [kN]", 1e-3),
    "torque": ("torque [kN m]", 1e-3),
    "power": ("power [kW]", 1e-3),
    "specific_energy": ("W [kWh/t]", 1 / 3600),
    "specific_throughput": ("mdot [t s/(h m³)]", 3.6),
    "nip_angle": ("nip [deg]", 180 / np.pi),
    "force_angle": ("beta [deg]", 180 / np.pi),
}


def machine_figures(result: xr.Dataset) -> dict[str, xr.DataArray]:
    """Return force, power and their like, by heading, in the units people use."""
    return {
        heading: result[name].astype(float) * factor for name, (heading, factor) in _MACHINE.items() if name in result
    }


def spread(values: xr.DataArray) -> xr.DataArray:
    """Return the sample standard deviation over replicates; NaN where there is only one."""
    if values.sizes["replicate"] < 2:
        return values.isel(replicate=0) * np.nan
    deviation = values.std("replicate", ddof=1)
    return deviation.where(values.max("replicate") > values.min("replicate"), deviation * 0)  # not its rounding


def table(result: xr.Dataset, sieve: float) -> str:
    """Return one line per operating point: axes, then mean +- standard deviation over the replicates."""
    if not any_result(result):
        return "no case holds a result"
    points = operating_points(result)
    tables = [_columns(result, points, found) for found in (figures(points, sieve), machine_figures(points)) if found]
    lines = [line for part in tables for line in (*part, "")][:-1]
    if result.sizes["replicate"] > 1:
        lines.append(f"(mean ± standard deviation of {result.sizes['replicate']} replicates)")
    return "\n".join(lines)


def _columns(result: xr.Dataset, points: xr.Dataset, found: dict[str, xr.DataArray]) -> list[str]:
    """Return the lines of a table: the axes, then each figure."""
    columns = {axis_label(points[name]): _axis_texts(points[name]) for name in axes_of(result)}
    for heading, values in found.items():
        means, spreads = values.mean("replicate").values, spread(values).values
        columns[heading] = [_figure(mean, deviation) for mean, deviation in zip(means, spreads, strict=True)]
    widths = [max(map(len, (heading, *texts))) for heading, texts in columns.items()]
    rows = [columns, *zip(*columns.values(), strict=True)]
    return ["  ".join(text.rjust(width) for text, width in zip(row, widths, strict=True)) for row in rows]


def notes(result: xr.Dataset) -> list[str]:
    """Return a line for the scene's own note, and for each limit that operating points have hit."""
    own = Scene.model_validate_json(result.attrs["scene"]).note
    lines = [f"note: {own}"] if own else []
    if "p80_total_error" in result:
        worst = {name: 100 * float(result[error].max()) for name, error in ERRORS.items() if error in result}
        told = ", ".join(f"{name.replace('_', ' ')} {error:.2g} %" for name, error in worst.items())
        lines.append(f"estimated errors of a run (bias + 2 standard errors), at most: {told}")
    if result.attrs.get("left_out"):
        lines.append(f"left out, being of another shape from case to case: {result.attrs['left_out']}")
    if "exchange_passes" in result:
        swaps = float(result["swaps_per_cell"].mean())
        lines.append(
            f"exchange: {swaps:.3g} swaps of a cell in one residence time; "
            f"at most {int(result['exchange_passes'].max())} passes a time step"
        )
    return lines + flags(result)


def flags(result: xr.Dataset) -> list[str]:
    """Return a line for each limit that operating points have hit, with the words of the first that did."""
    if "flags" not in result:
        return []
    points = operating_points(result)
    lines = []
    for name, mask in FLAGS.items():
        hit = (points["flags"] & mask) > 0
        if hit.any():
            texts = points["notes"].transpose(*hit.dims).values[hit.values]
            told = next(line for line in str(texts[0]).splitlines() if line.startswith(name)).partition(": ")[2]
            count = int(hit.any("replicate").sum())
            lines.append(
                f"flag {name} at {count} of {points.sizes['operating_point']} operating points; the first: {told}"
            )
    return lines


def change(result: xr.Dataset, field: str) -> list[str]:
    """Return a line on how much P80 changes from end to end of the axis of a scene field, if it can be told.

    Replicates share their random numbers along an axis, so the change is that of pairs; other axes are averaged.
    """
    axis = next(value for value in result.coords.values() if value.attrs.get("scene_field") == field)
    if "p80_total" not in result or axis.size < 2 or axis.dtype.kind not in "fiu":
        return []
    order = np.argsort(axis.values)
    p80 = result["p80_total"].astype(float).isel({axis.name: order})
    ratio = p80.isel({axis.name: -1}) / p80.isel({axis.name: 0}) - 1
    ratio = 100 * ratio.mean([name for name in ratio.dims if name != "replicate"])
    if not ratio.notnull().any():
        return []
    size = int(ratio.notnull().sum())
    error = f" ± {float(ratio.std(ddof=1)) / np.sqrt(size):.2g}" if size > 1 else ""
    ends = f"{_place(axis, order[0])} to {_place(axis, order[-1])}"
    told = " (mean ± standard error of pairs)" if error else ""
    return [f"P80 changes by {float(ratio.mean()):+.3g}{error} % from {ends}{told}."]


def lost_cases(result: xr.Dataset) -> list[str]:
    """Return a line for every operating point that lost replicates: status, where, why."""
    words = {number: word for word, number in STATUS.items()}
    axes = axes_of(result)
    lost: dict[tuple, list[int]] = {}
    for *index, replicate in np.argwhere(result["status"].values != STATUS["ok"]):
        case = result.isel({**dict(zip(axes, index, strict=True)), "replicate": replicate})
        lost.setdefault((*index, int(case["status"]), str(case["message"].values)), []).append(int(replicate))
    lines = []
    for (*index, status, message), replicates in lost.items():
        place = [_place(result[name], k) for name, k in zip(axes, index, strict=True)]
        place.append(f"{len(replicates)} of {result.sizes['replicate']} replicates")
        lines.append(f"{words[status]}: {', '.join(place)}: {message}")
    return lines


def _place(axis: xr.DataArray, index: int) -> str:
    value = axis.values[index]
    text = units.show(float(value), axis.attrs["units"]) if axis.dtype.kind in "fiu" else str(value)
    return f"{axis.name.replace('_', ' ')} {text}"


def any_result(result: xr.Dataset) -> bool:
    """Return whether at least one case is well."""
    return bool((result["status"] == STATUS["ok"]).any())


def axis_label(axis: xr.DataArray) -> str:
    """Return a swept coordinate's name with the unit it is shown in."""
    name = axis.name.replace("_", " ")
    unit = units.SHOWN.get(axis.attrs["units"], (axis.attrs["units"],))[0]
    return name if unit == "1" else f"{name} [{unit}]"


def shown_values(axis: xr.DataArray) -> np.ndarray:
    """Return a swept coordinate's values in the unit it is shown in."""
    factor = units.SHOWN.get(axis.attrs["units"], ("", 1.0))[1]
    return axis.values * factor if axis.dtype.kind in "fiu" else axis.values


def _axis_texts(axis: xr.DataArray) -> list[str]:
    return [f"{value:.6g}" if axis.dtype.kind in "fiu" else str(value) for value in shown_values(axis)]


def _figure(mean: float, deviation: float) -> str:
    if np.isnan(mean):
        return "-"
    return f"{mean:.4g}" + ("" if np.isnan(deviation) else f" ± {deviation:.2g}")
