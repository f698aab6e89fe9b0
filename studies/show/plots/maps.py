"""Maps of a sweep over two axes: contours of fineness, energy, throughput and product size over both."""

import cmcrameri.cm as colours
import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from hpgr.results import flags
from studies.show import report
from studies.show.plots.sweeps import caption_under

_FEWEST = 3  # values of an axis that make a map


def is_map(result: xr.Dataset) -> bool:
    """Return whether a sweep has just two axes, of numbers, with values enough to draw contours."""
    axes = [result[name] for name in report.axes_of(result)]
    return len(axes) == 2 and all(
        report.is_field(axis) and axis.dtype.kind in "fiu" and np.isfinite(axis).all() and axis.size >= _FEWEST
        for axis in axes
    )


def maps_figure(result: xr.Dataset, sieve: float, caption: str) -> Figure:
    """Return four maps over both axes of a sweep, as `is_map` wants it; operating points of an unusual machine are
    hatched, and the percent passing of the sieve (m) is shown.
    """
    known = report.figures(result, sieve)
    below = [heading for heading in known if heading.startswith("below")]
    headings = [name for name in (*below, "W [kWh/t]", "throughput [t/h]", "P80 [mm]") if name in known]
    across, up = (result[name] for name in report.axes_of(result))
    figure = Figure(figsize=(11, 9 if len(headings) > 2 else 5), layout="constrained")
    for panel, heading in zip(figure.subplots(-(-len(headings) // 2), 2).ravel(), headings, strict=True):
        _map(panel, result, known[heading].mean("replicate"), across, up)
        panel.set_title(heading)
    usual = "Dots: operating points that were run; hatched: outside usual machines and operation."
    caption_under(figure, result, f"{caption}\n{usual}" if caption else usual)
    return figure


def _map(panel, result: xr.Dataset, values: xr.DataArray, across: xr.DataArray, up: xr.DataArray) -> None:
    """Draw filled contours of a figure, labelled lines on them, where it was run and where that is unusual."""
    x, y = report.shown_values(across), report.shown_values(up)
    columns, rows = np.argsort(x), np.argsort(y)
    unusual = (result["flags"] & flags.BITS["unusual_machine"]).any("replicate")
    heights, unusual = (
        each.transpose(up.name, across.name).values[np.ix_(rows, columns)].astype(float) for each in (values, unusual)
    )
    x, y, heights = x[columns], y[rows], np.ma.masked_invalid(heights)
    panel.set(xlabel=report.axis_label(across), ylabel=report.axis_label(up))
    if heights.count() and np.ptp(heights.compressed()) > 1e-6 * np.abs(heights).max():  # else all of it is rounding
        panel.contourf(x, y, heights, levels=12, cmap=colours.batlow, alpha=0.85)
        lines = panel.contour(x, y, heights, levels=7, colors="k", linewidths=0.7)
        panel.clabel(lines, fmt=lambda value: f"{value:.4g}", fontsize=8)
    else:
        panel.text(0.5, 0.5, f"the same everywhere: {heights.mean():.4g}", ha="center", transform=panel.transAxes)
    if unusual.any():
        panel.contourf(x, y, unusual, levels=[0.5, 1.5], colors="none", hatches=["//"])
    up_places, across_places = np.nonzero(~np.ma.getmaskarray(heights))
    style = {"color": "w", "markeredgecolor": "k", "markersize": 5, "markeredgewidth": 0.5, "clip_on": False}
    panel.plot(x[across_places], y[up_places], ".", **style)
