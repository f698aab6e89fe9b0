"""Figures of a sweep.

Lines differ by marker, dash and lightness, so that every figure can be read in black and white.
"""

import textwrap

import cmcrameri.cm as maps
import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from hpgr.fields import show
from studies.show import report
from studies.sweep.netcdf import scene_of

_MOST_LINES = 7  # operating points a panel shows; more are thinned evenly, and the figure says so
MARKERS = "os^Dv<>"
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
    along = (axis for dim in report.axes_of(result) for axis in report.swept(result, dim))
    axis = next(axis for axis in along if axis.attrs.get("scene_field") == field)
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
        thinned |= against_axis(panel, values[heading], axis, heading)
    words = [caption] if caption else []
    if thinned:
        words.append(f"Panels show at most {_MOST_LINES} of the operating points, evenly chosen.")
    if result.sizes["replicate"] > 1:
        words.append(f"Mean of {result.sizes['replicate']} replicates; bars: ± one standard deviation.")
    caption_under(figure, result, "\n".join(words))
    return figure


def caption_under(figure: Figure, result: xr.Dataset, words: str) -> None:
    """Write under a figure its own words, the limits that were hit, and the remark of the scene."""
    lines = [words, *(line[0].upper() + line[1:] + "." for line in report.flagged(result))]
    remark = scene_of(result).remark
    lines += [f"Scene: {remark}."] if remark else []
    width = int(14 * figure.get_figwidth())  # letters
    folded = [textwrap.fill(line, width) for line in "\n".join(lines).splitlines()]
    figure.supxlabel("\n".join(folded), fontsize=9)


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
    right.set(ylabel=f"below {show(sieve, 'm')} [%]", title="Fineness across the gap")
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
    [dim] = axis.dims
    others = [name for name in values.dims if name not in (dim, "replicate")]
    lines = values.stack(line=others, create_index=False) if others else values.expand_dims("line")
    shown = report.shown_values(axis)
    numeric = axis.dtype.kind in "fiu"
    order = np.argsort(shown) if numeric else np.arange(shown.size)
    total = lines.sizes["line"]
    lines = lines.isel(line=_thinned(np.arange(total)))
    for k in range(lines.sizes["line"]):
        one = lines.isel(line=k).transpose(dim, "replicate")
        bars = report.spread(one).values
        label = ", ".join(report.value_text(values[name], lines[name].values[k]) for name in others)
        style = _style(k, lines.sizes["line"]) | {"color": str(0.6 * k / max(lines.sizes["line"] - 1, 1))}
        style |= {} if dim == axis.name else {"linestyle": "none"}  # other fields vary along it too
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
    places = np.unravel_index(chosen, [result.sizes[name] for name in axes])
    labels = [
        ", ".join(report.place_text(result, name, k) for name, k in zip(axes, place, strict=True))
        for place in zip(*places, strict=True)
    ]
    return points.isel(operating_point=chosen), labels, chosen.size < held.size


def _thinned(numbers: np.ndarray) -> np.ndarray:
    """Return at most a handful of the numbers, evenly chosen."""
    places = np.linspace(0, numbers.size - 1, min(numbers.size, _MOST_LINES)).round().astype(int)
    return numbers[np.unique(places)]


def _joined(names: list[str]) -> str:
    return ", ".join(name.replace("_", " ") for name in names)


def _mirrored(xi: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return positions and values of both halves of the gap, from roll to roll."""
    return np.concatenate([-xi[::-1], xi]), np.concatenate([values[::-1], values])


def _style(k: int, count: int) -> dict:
    return {
        "color": maps.batlow(0.7 * k / max(count - 1, 1)),
        "marker": MARKERS[k % len(MARKERS)],
        "linestyle": _DASHES[k % len(_DASHES)],
        "markersize": 4.5,
        "linewidth": 1.4,
    }
