"""Figures of `studies.accuracy`: error against cost."""

import itertools

import numpy as np
import xarray as xr
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullFormatter

from studies.show.plots.sweeps import MARKERS

_LADDER_PANELS = (  # ladder, variant, title
    ("points", "scene", "Points (dt), the scene as it is"),
    ("points", "n = 0.5", "Points (dt), n = 0.5: slow"),
    ("points", None, "Points (dt), the other integrator"),
    ("streamlines", "", "Streamlines N"),
    ("cells", "", "Cells M"),
    ("snapshots", "", "Snapshots"),
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
    shades = {points_now: str(1 - j / max(every.size - 1, 1)) for j, points_now in enumerate(every)}
    for count, marker in zip(np.unique(lines), itertools.cycle(MARKERS), strict=False):
        for points_now, shade in shades.items():
            mine = (lines == count) & (points == points_now)
            panel.scatter(milliseconds[mine], error[mine], marker=marker, c=shade, edgecolors="0.2", s=42)
        panel.scatter([], [], marker=marker, c="0.7", edgecolors="0.2", label=f"N = {count}")
    for points_now, shade in shades.items():
        panel.scatter([], [], marker="o", c=shade, edgecolors="0.2", label=f"P = {points_now}")
    front = np.flatnonzero(result["combination_on_front"].values)
    front = front[np.argsort(milliseconds[front])]
    panel.plot(milliseconds[front], error[front], "-", color="0.2", linewidth=1.2, zorder=0, label="Pareto front")
    for k in np.flatnonzero(result["combination_level"].values != ""):
        where = (milliseconds[k], error[k])
        panel.plot(*where, marker="o", markersize=15, fillstyle="none", color="black", markeredgewidth=1.6)
        panel.annotate(
            str(result["combination_level"].values[k]),
            where,
            (55, 28),
            textcoords="offset points",
            fontweight="bold",
            arrowprops={"arrowstyle": "-", "shrinkB": 8},
        )
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
        panel.plot(
            milliseconds[seen],
            values[seen],
            marker=marker,
            linestyle=dash,
            color=lightness,
            label=label,
            markersize=4.5,
            linewidth=1.2,
        )
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
            panel.annotate(
                str(rung),
                (where, 0.985),
                xycoords=("data", "axes fraction"),
                rotation=90,
                fontsize=8,
                ha="center",
                va="top",
            )


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
