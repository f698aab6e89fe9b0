"""Dataset -> Figure; the only matplotlib.

Lines differ by marker, dash and lightness, so that every figure can be read in black and white.
"""

import cmcrameri.cm as maps
import numpy as np
import xarray as xr
from matplotlib.collections import PolyCollection
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullFormatter

from hpgr import units
from hpgr.flow import Motion
from hpgr.geometry import Geometry
from hpgr.scene import Scene
from hpgr.tessellation import Tessellation
from studies import report

_MOST_LINES = 7  # operating points a panel shows; more are thinned evenly, and the figure says so
_MARKERS = "os^Dv<>"
_DASHES = ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)), (0, (1, 1)), (0, (7, 2)))


def sweep_figure(result: xr.Dataset, field: str, sieve: float, caption: str) -> Figure:
    """Return the figure of a sweep: fineness across the gap, product sizes, and figures against the axis.

    Parameters
    ----------
    result : xarray.Dataset
        From `studies.sweep.sweep`.
    field : str
        Scene field of the main axis, such as "rolls.gap".
    sieve : float
        Sieve in m whose percent passing is shown.
    caption : str
        Sentence under the figure.
    """
    axis = next(name for name in report.axes_of(result) if result[name].attrs["scene_field"] == field)
    values = report.figures(result, sieve)
    headings = [heading for heading in ("throughput [t/h]", "P80 [mm]", "peak pressure [MPa]") if heading in values]
    sizes = "passing" in result
    figure = Figure(figsize=(13, 8.6) if sizes else (9, 4.5), layout="constrained")
    panels = figure.subplots(2 if sizes else 1, len(headings), squeeze=False)
    thinned = False
    if sizes:
        thinned = fineness_across_gap(panels[0, 0], panels[0, 1], result, sieve)
        product_sizes(panels[0, 2], result)
    for panel, heading in zip(panels[-1], headings, strict=True):
        thinned |= against_axis(panel, values[heading], result[axis], heading)
    words = [caption] if caption else []
    if thinned:
        words.append(f"Panels show at most {_MOST_LINES} of the operating points, evenly chosen.")
    if result.sizes["replicate"] > 1:
        words.append(f"Mean of {result.sizes['replicate']} replicates; bars: ± one standard deviation.")
    words += [line[0].upper() + line[1:] + "." for line in report.flags(result)]
    note = Scene.model_validate_json(result.attrs["scene"]).note
    figure.supxlabel("\n".join([*words, *([f"Scene: {note}."] if note else [])]), fontsize=9)
    return figure


def tessellation_figure(bed: Geometry, motion: Motion, cells: Tessellation) -> Figure:
    """Return the Voronoi cells of the material points, mirrored, with the rolls: the paper's figure 3d."""
    figure = Figure(figsize=(8, 8.6), layout="constrained")
    panel = figure.subplots()
    outlines = [np.asarray(part.exterior.coords) for cell in cells.cells for part in getattr(cell, "geoms", [cell])]
    pieces = [len(getattr(cell, "geoms", [cell])) for cell in cells.cells]  # the concave rim may cut a cell in two
    volumes = 1e6 * np.repeat(cells.volume.ravel(), pieces)
    for side in (-1, 1):
        drawn = PolyCollection(
            [1e3 * outline * (side, 1) for outline in outlines], array=volumes, cmap=maps.batlow,
            norm=LogNorm(), edgecolors="0.2", linewidths=0.25,
        )  # fmt: skip
        panel.add_collection(drawn)
        panel.plot(side * 1e3 * motion.x, 1e3 * motion.y, ".k", markersize=0.8)
        height = np.linspace(0, bed.height, 200)
        panel.fill_betweenx(
            1e3 * height,
            side * 1e3 * bed.roll_surface(height),
            side * 1.1e3 * bed.outer(bed.height),
            color="0.8",
            zorder=0,
        )
    panel.set(xlabel="x across the gap [mm]", ylabel="height above the minimum gap [mm]", aspect="equal")
    panel.set_title("Volume of the material points")
    figure.colorbar(drawn, label="volume per roll width [mm²]", shrink=0.8)
    return figure


def fineness_across_gap(left, right, result: xr.Dataset, sieve: float) -> bool:
    """Draw P80 and percent passing against position, roll to roll; return whether points were left out."""
    points, labels, thinned = _shown_points(result)
    passing = report.percent_passing(points, sieve, total=False)
    for k, label in enumerate(labels):
        style = _style(k, len(labels))
        for panel, values in ((left, points["p80"] * 1e3), (right, passing)):
            one = values.isel(operating_point=k)
            position, mean = _mirrored(result["xi"].values, one.mean("replicate").values)
            _, bars = _mirrored(result["xi"].values, report.spread(one).values)
            panel.errorbar(position, mean, None if np.isnan(bars).all() else bars, label=label, **style)
    left.set(ylabel="P80 [mm]", title="Product size across the gap")
    right.set(ylabel=f"below {units.show(sieve, 'm')} [%]", title="Fineness across the gap")
    for panel in (left, right):
        panel.set_xlabel("position across the gap, roll to roll [half gaps]")
        panel.set_xlim(-1, 1)
        panel.set_xticks([-1, -0.5, 0, 0.5, 1])
        for roll in (-1, 1):
            panel.axvline(roll, color="0.3", linewidth=2)
        panel.grid(color="0.9")
    handles, names = left.get_legend_handles_labels()
    title = _joined(report.axes_of(result))
    left.figure.legend(handles, names, title=title, loc="outside upper center", ncols=len(names), fontsize=9)
    return thinned


def product_sizes(panel, result: xr.Dataset) -> None:
    """Draw the cumulative size distributions of the whole product on log axes."""
    points, labels, _ = _shown_points(result)
    sieves = result["sieve"].values * 1e3
    for k, label in enumerate(labels):
        percent = 100 * points["passing_total"].isel(operating_point=k).mean("replicate").values
        seen = percent > 0
        panel.plot(sieves[seen], percent[seen], label=label, **_style(k, len(labels)) | {"markevery": (k, 7)})
    panel.set(xscale="log", yscale="log", xlabel="sieve [mm]", ylabel="passing [%]", title="Product of the whole gap")
    panel.set_ylim(0.1, 130)
    across = [name for name in points["passing_total"].dims if name != "sieve"]
    finest, coarsest = points["passing_total"].max(across).values, points["passing_total"].min(across).values
    panel.set_xlim(sieves[np.argmax(finest > 1e-3)], sieves[np.argmax(coarsest > 0.999)] * 1.3)
    panel.grid(color="0.9", which="both")


def against_axis(panel, values: xr.DataArray, axis: xr.DataArray, heading: str) -> bool:
    """Draw a figure against the swept axis, a line per value of the other axes; return whether some were left out."""
    others = [name for name in values.dims if name not in (axis.name, "replicate")]
    lines = values.stack(line=others, create_index=False) if others else values.expand_dims("line")
    shown = report.shown_values(axis)
    numeric = axis.dtype.kind in "fiu"
    order = np.argsort(shown) if numeric else np.arange(shown.size)
    total = lines.sizes["line"]
    lines = lines.isel(line=_thinned(np.arange(total)))
    for k in range(lines.sizes["line"]):
        one = lines.isel(line=k).transpose(axis.name, "replicate")
        bars = report.spread(one).values
        label = ", ".join(_value(lines[name].values[k], values[name]) for name in others)
        style = _style(k, lines.sizes["line"]) | {"color": str(0.6 * k / max(lines.sizes["line"] - 1, 1))}
        error = None if np.isnan(bars).all() else bars[order]
        panel.errorbar(shown[order], one.mean("replicate").values[order], error, label=label or None, **style)
    panel.set(xlabel=report.axis_label(axis), ylabel=heading, title=heading.partition(" [")[0])
    if values.max() > 0:
        low, high = panel.get_ylim()
        if low > 0 and low > 0.8 * high:  # a flat curve must look flat
            panel.set_ylim(0.8 * low, 1.2 * high)
    panel.ticklabel_format(axis="y", useOffset=False)
    panel.grid(color="0.9")
    if others:
        panel.legend(fontsize=8, title=_joined(others))
    return lines.sizes["line"] < total


def _shown_points(result: xr.Dataset) -> tuple[xr.Dataset, list[str], bool]:
    """Return the operating points that hold a result, at most a handful, with labels."""
    points = report.operating_points(result)
    held = np.flatnonzero(points["p80_total"].notnull().any("replicate").values)
    chosen = _thinned(held)
    axes = report.axes_of(result)
    labels = [", ".join(_value(points[name].values[k], result[name]) for name in axes) for k in chosen]
    return points.isel(operating_point=chosen), labels, chosen.size < held.size


def _thinned(numbers: np.ndarray) -> np.ndarray:
    """Return at most a handful of the numbers, evenly chosen."""
    places = np.linspace(0, numbers.size - 1, min(numbers.size, _MOST_LINES)).round().astype(int)
    return numbers[np.unique(places)]


def _joined(names: list[str]) -> str:
    return ", ".join(name.replace("_", " ") for name in names)


def _value(value, axis: xr.DataArray) -> str:
    return units.show(float(value), axis.attrs["units"]) if axis.dtype.kind in "fiu" else str(value)


def _mirrored(xi: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return positions and values of both halves of the gap, from roll to roll."""
    return np.concatenate([-xi[::-1], xi]), np.concatenate([values[::-1], values])


def _style(k: int, count: int) -> dict:
    return {
        "color": maps.batlow(0.7 * k / max(count - 1, 1)),
        "marker": _MARKERS[k % len(_MARKERS)],
        "linestyle": _DASHES[k % len(_DASHES)],
        "markersize": 4.5,
        "linewidth": 1.4,
    }


_LADDER_PANELS = (  # ladder, variant, title
    ("points", "scene", "Points (dt), the scene as it is"),
    ("points", "n = 0.5", "Points (dt), n = 0.5: slow"),
    ("points", None, "Points (dt), the other integrator"),
    ("streamlines", "", "Streamlines N"),
    ("cells", "", "Cells M"),
    ("photographs", "", "Photographs"),
)
_ERROR_LINES = (  # quantity, kind, label, marker, dash, lightness
    ("p80", "bias", "bias of P80", "o", "-", "0.0"),
    ("p80", "noise", "noise of P80", "s", "--", "0.0"),
    ("below_1mm", "bias", "bias of percent below 1 mm", "^", "-", "0.45"),
    ("below_1mm", "noise", "noise of percent below 1 mm", "v", "--", "0.45"),
    ("peak_pressure", "bias", "bias of peak pressure", "D", ":", "0.65"),
)


def accuracy_figure(result: xr.Dataset) -> Figure:
    """Return the work-precision figure: the grid with its Pareto front and levels, and a panel per ladder.

    Parameters
    ----------
    result : xarray.Dataset
        From `studies.accuracy.study`.
    """
    figure = Figure(figsize=(16, 9), layout="constrained")
    left, right = figure.subfigures(1, 2, width_ratios=(1, 1.35))
    work_precision(left.subplots(), result)
    panels = right.subplots(2, 3)
    variants = list(result["variant"].values)
    for panel, (name, variant, title) in zip(panels.flat, _LADDER_PANELS, strict=True):
        if name != "points":
            ladder_errors(panel, result, name, title)
        elif variant is None:
            ladder_errors(panel, result.sel(variant=variants[-1]), name, f"Points (dt), {variants[-1]}")
        elif variant in variants:
            ladder_errors(panel, result.sel(variant=variant), name, title)
        else:
            panel.set_axis_off()
    handles, labels = panels[0, 0].get_legend_handles_labels()
    right.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=9)
    figure.supxlabel(
        "Errors are relative. Bias: mean over replicates less the limit (points) or the finest; not drawn below its "
        f"standard error. Noise: standard deviation over {result.attrs['replicates']} replicates. "
        f"Ladders: {result.attrs['held']} where not refined.",
        fontsize=9,
    )
    return figure


def work_precision(panel, result: xr.Dataset) -> None:
    """Draw the error of every combination against its wall time, the Pareto front, and the named levels."""
    milliseconds = 1e3 * result["combination_wall_time"].values
    error = np.maximum(100 * result["combination_worst_error"].values, 1e-4)  # none at all has no place on log axes
    lines, points = result["combination_streamlines"].values, result["combination_points"].values
    every = np.unique(points)
    for k, count in enumerate(np.unique(lines)):
        for j, points_now in enumerate(every):
            mine = (lines == count) & (points == points_now)
            shade = str(1 - j / max(every.size - 1, 1))
            panel.scatter(
                milliseconds[mine], error[mine], marker=_MARKERS[k % len(_MARKERS)], c=shade, edgecolors="0.2", s=42
            )
        panel.scatter([], [], marker=_MARKERS[k % len(_MARKERS)], c="0.7", edgecolors="0.2", label=f"N = {count}")
    for j, points_now in enumerate(every):
        shade = str(1 - j / max(every.size - 1, 1))
        panel.scatter([], [], marker="o", c=shade, edgecolors="0.2", label=f"P = {points_now}")
    front = np.flatnonzero(result["combination_on_front"].values)
    front = front[np.argsort(milliseconds[front])]
    panel.plot(milliseconds[front], error[front], "-", color="0.2", linewidth=1.2, zorder=0, label="Pareto front")
    for k in np.flatnonzero(result["combination_level"].values != ""):
        where = (milliseconds[k], error[k])
        panel.plot(*where, marker="o", markersize=15, fillstyle="none", color="black", markeredgewidth=1.6)
        panel.annotate(str(result["combination_level"].values[k]), where, (55, 28), textcoords="offset points",
                       fontweight="bold", arrowprops={"arrowstyle": "-", "shrinkB": 8})  # fmt: skip
    panel.set(xscale="log", yscale="log", xlabel="median wall time of a run [ms]")
    panel.set_ylim(0.8 * error.min(), 2 * error.max())
    panel.set_ylabel("largest error of P50, P80 and percent below 1 mm: |bias| + 2 standard errors [%]")
    panel.set_title("Work and precision: streamlines N, points P, cells M")
    panel.grid(color="0.9", which="both")
    panel.set_axisbelow(True)
    _plain_numbers(panel)
    panel.legend(fontsize=9, loc="upper right")


def ladder_errors(panel, result: xr.Dataset, name: str, title: str) -> None:
    """Draw bias and noise of a ladder against its wall time, each rung marked by its number."""
    rungs = result[name].values
    milliseconds = 1e3 * result[f"{name}_wall_time"].values
    highest = 0.0
    for quantity, kind, label, marker, dash, lightness in _ERROR_LINES:
        one = result.sel(quantity=quantity)
        values = 100 * np.abs(one[f"{name}_{kind}"].values)
        least = 100 * one[f"{name}_bias_error"].values if kind == "bias" else np.zeros(values.size)
        seen = (values > least) & (values > 1e-9)
        panel.plot(milliseconds[seen], values[seen], marker=marker, linestyle=dash, color=lightness, label=label,
                   markersize=4.5, linewidth=1.2)  # fmt: skip
        highest = max(highest, values[seen].max(initial=0.0))
    panel.set(xscale="log", title=title, xlim=(milliseconds.min() / 1.1, milliseconds.max() * 1.1))
    panel.set_xlabel("wall time of a run [ms]", labelpad=1)
    panel.set_ylabel("error [%]")
    if highest > 0:  # a scene in which nothing changes has nothing to draw
        panel.set_yscale("log")
        panel.set_ylim(1e-3 * highest, 6 * highest)
    _number_rungs(panel, rungs, milliseconds)
    panel.grid(color="0.9", which="both")
    _plain_numbers(panel)


def _number_rungs(panel, rungs: np.ndarray, places: np.ndarray) -> None:
    """Write the rungs along the upper edge, each at its place; of those that would overlap only the first."""
    low, high = np.log(panel.get_xlim())
    across = (np.log(places) - low) / (high - low)
    taken: list[float] = []
    for rung, where, place in zip(rungs, places, across, strict=True):
        if all(abs(place - other) > 0.05 for other in taken):
            taken.append(place)
            panel.annotate(str(rung), (where, 0.985), xycoords=("data", "axes fraction"), rotation=90, fontsize=8,
                           ha="center", va="top")  # fmt: skip


def _plain_numbers(panel) -> None:
    """Write 0.1, 0.2, 0.5, 1 along log axes, and numbers between them along short ones."""
    for axis in (panel.xaxis, panel.yaxis):
        if axis.get_scale() == "log":
            low, high = axis.get_view_interval()
            steps = (1, 2, 5) if high > 5 * low else (1, 1.5, 2, 3, 4, 5, 6, 8)
            decades = range(int(np.floor(np.log10(low))), int(np.ceil(np.log10(high))))
            axis.set_major_locator(FixedLocator([step * 10.0**k for k in decades for step in steps]))
            axis.set_major_formatter("{x:g}")
            axis.set_minor_formatter(NullFormatter())
            axis.set_view_interval(low, high, ignore=True)
