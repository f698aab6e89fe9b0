"""Figure of `studies.accuracy`: error against cost."""

from itertools import cycle

import numpy as np
import xarray as xr
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatter

from studies.show.plots.sweeps import MARKERS

_ERROR_LINES = (  # quantity, kind, label, marker, dash, lightness
    ("p80", "bias", "bias of P80", "o", "-", "0.0"),
    ("p80", "noise", "noise of P80", "s", "--", "0.0"),
    ("below_1mm", "bias", "bias of percent below 1 mm", "^", "-", "0.45"),
    ("below_1mm", "noise", "noise of percent below 1 mm", "v", "--", "0.45"),
    ("peak_pressure", "bias", "bias of peak pressure", "D", ":", "0.65"),
)


def accuracy_figure(result: xr.Dataset) -> Figure:
    """Return the work-precision figure: the grid with its Pareto front and levels, and a panel per ladder."""
    figure = Figure(figsize=(16, 9), layout="constrained")
    left, right = figure.subfigures(1, 2, width_ratios=(1, 1.35))
    _work_precision(left.subplots(), result)
    ladders = {f"Points (dt), {name}": (result.sel(variant=name), "points") for name in result["variant"].values}
    ladders |= {name.capitalize(): (result, name) for name in ("streamlines", "cells", "snapshots")}
    panels = right.subplots(2, 3).ravel()
    for panel, (title, (part, name)) in zip(panels, ladders.items(), strict=False):
        _ladder(panel, part, name, title)
    for panel in panels[len(ladders) :]:
        panel.set_axis_off()
    handles, labels = panels[0].get_legend_handles_labels()
    right.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=9)
    figure.supxlabel(
        "Errors are relative. Bias: mean over replicates less the limit (points) or the finest; not drawn below its "
        f"standard error. Noise: standard deviation over {result.attrs['replicates']} replicates. "
        f"Ladders: {result.attrs['held']} where not refined.",
        fontsize=9,
    )
    return figure


def _work_precision(panel, result: xr.Dataset) -> None:
    """Draw the error of every combination against its wall time, the Pareto front, and the named levels."""
    milliseconds = 1e3 * result["combination_wall_time"].values
    error = np.maximum(100 * result["combination_worst_error"].values, 1e-4)  # none at all has no place on log axes
    lines, points = result["combination_streamlines"].values, result["combination_points"].values
    every = np.unique(points)
    shades = {count: str(1 - j / max(every.size - 1, 1)) for j, count in enumerate(every)}
    for count, marker in zip(np.unique(lines), cycle(MARKERS), strict=False):
        mine = lines == count
        colours = [shades[each] for each in points[mine]]
        panel.scatter(milliseconds[mine], error[mine], marker=marker, c=colours, edgecolors="0.2", s=42)
        panel.scatter([], [], marker=marker, c="0.7", edgecolors="0.2", label=f"N = {count}")
    for count, shade in shades.items():
        panel.scatter([], [], marker="o", c=shade, edgecolors="0.2", label=f"P = {count}")
    front = np.flatnonzero(result["combination_on_front"].values)
    front = front[np.argsort(milliseconds[front])]
    panel.plot(milliseconds[front], error[front], "-", color="0.2", linewidth=1.2, zorder=0, label="Pareto front")
    for k in np.flatnonzero(result["combination_level"].values != ""):
        where, arrow = (milliseconds[k], error[k]), {"arrowstyle": "-", "shrinkB": 8}
        panel.plot(*where, marker="o", markersize=15, fillstyle="none", color="black", markeredgewidth=1.6)
        name = str(result["combination_level"].values[k])
        panel.annotate(name, where, (55, 28), textcoords="offset points", fontweight="bold", arrowprops=arrow)
    panel.set(xscale="log", yscale="log", xlabel="median wall time of a run [ms]")
    panel.set_ylabel("largest error of P50, P80 and percent below 1 mm: |bias| + 2 standard errors [%]")
    panel.set_title("Work and precision: streamlines N, points P, cells M")
    panel.grid(color="0.9", which="both")
    panel.set_axisbelow(True)
    panel.legend(fontsize=9, loc="upper right")
    _plain_numbers(panel)


def _ladder(panel, result: xr.Dataset, name: str, title: str) -> None:
    """Draw bias and noise of a ladder against its wall time, each rung marked by its number at the top."""
    milliseconds, highest = 1e3 * result[f"{name}_wall_time"].values, 0.0
    for quantity, kind, label, marker, dash, lightness in _ERROR_LINES:
        one = result.sel(quantity=quantity)
        values = 100 * np.abs(one[f"{name}_{kind}"].values)
        least = 100 * one[f"{name}_bias_error"].values if kind == "bias" else 0.0
        seen = (values > least) & (values > 1e-9)
        style = {"marker": marker, "linestyle": dash, "color": lightness, "markersize": 4.5, "linewidth": 1.2}
        panel.plot(milliseconds[seen], values[seen], label=label, **style)
        highest = max(highest, values[seen].max(initial=0.0))
    panel.set(xscale="log", title=title, xlim=(milliseconds.min() / 1.1, milliseconds.max() * 1.1))
    panel.set(xlabel="wall time of a run [ms]", ylabel="error [%]")
    if highest > 0:  # a scene in which nothing changes has nothing to draw
        panel.set_yscale("log")
        panel.set_ylim(1e-3 * highest, 6 * highest)
    last = 0.0
    for k in np.argsort(milliseconds):  # of those that would overlap only the first
        if milliseconds[k] > last:
            last, at = 1.05 * milliseconds[k], (milliseconds[k], 0.985)
            text = str(result[name].values[k])
            panel.annotate(text, at, xycoords=("data", "axes fraction"), rotation=90, fontsize=8, ha="center", va="top")
    panel.grid(color="0.9", which="both")
    _plain_numbers(panel)


def _plain_numbers(panel) -> None:
    """Write the numbers along log axes in full, those between decades too where there is room."""
    for axis in (panel.xaxis, panel.yaxis):
        if axis.get_scale() == "log":
            axis.set_major_formatter("{x:g}")
            axis.set_minor_formatter(_Plain(minor_thresholds=(2, 0.5)))


class _Plain(LogFormatter):
    def _num_to_string(self, x, vmin, vmax):
        return f"{x:g}"
