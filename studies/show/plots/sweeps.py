"""Figures of a sweep.

Lines differ by marker, dash and lightness, so that every figure can be read in black and white.
"""

import textwrap

import cmcrameri.cm as maps
import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from hpgr.fields import show
from hpgr.results.metrics import scene_of
from studies.show import report
from studies.sweep.space import SCENE

_MOST_LINES = 7  # operating points a panel shows; more are thinned evenly, and the figure says so
_SAME = 1e-6  # relative difference of curves that are drawn as one
MARKERS = "os^Dv<>"
_DASHES = ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)), (0, (1, 1)), (0, (7, 2)))


def sweep_figure(result: xr.Dataset, field: str, sieve: float, caption: str) -> Figure:
    """Return the figure of a sweep: fineness across the gap, product sizes, and figures against the axis of a field.

    The percent passing of the sieve (m) is shown; the caption is a sentence under the figure.
    """
    along = (axis for dim in report.axes_of(result) for axis in report.swept(result, dim))
    axis = next(axis for axis in along if axis.attrs.get("scene_field") == field)
    known, below = report.figures(result, sieve), f"below {show(sieve, 'm')} [%]"
    wanted = ("throughput [t/h]", "P80 [mm]", below, "W [kWh/t]", "peak pressure [MPa]")
    headings, sizes = [heading for heading in wanted if heading in known], "passing" in result
    figure = Figure(figsize=(17, 9.2) if sizes else (12, 4.8), layout="constrained")
    panels = figure.subplots(2 if sizes else 1, 4 if sizes else len(headings), squeeze=False).ravel()
    thinned = _products(panels[:3], result, sieve) if sizes else False
    for panel, heading in zip(panels[3 * sizes :], headings, strict=True):
        thinned |= against_axis(panel, known[heading], axis, heading)
    handles, names = panels[-1].get_legend_handles_labels()
    if names:
        others = [name for name in report.axes_of(result) if name not in axis.dims]
        figure.legend(handles, names, title=report.joined(others), loc="outside right upper", fontsize=9)
    if not sizes:
        figure.suptitle(_title(result), fontsize=11)
    words = [caption] if caption else []
    if thinned:
        words.append(f"Panels show at most {_MOST_LINES} of the operating points, evenly chosen.")
    if result.sizes["replicate"] > 1:
        words.append(f"Mean of {result.sizes['replicate']} replicates; bars: ± one standard deviation.")
    caption_under(figure, result, "\n".join(words))
    return figure


def _title(result: xr.Dataset) -> str:
    """Return machine, ore and feed, unless there are several, and what is swept."""
    scene, swept = scene_of(result), report.joined(report.axes_of(result)) or "nothing"
    if SCENE in report.axes_of(result):
        return f"swept: {swept}"
    rolls, ore, feed = scene.rolls, scene.strength, scene.feed
    return (
        f"Rolls {show(rolls.diameter, 'm')} x {show(rolls.width, 'm')}; ore of "
        f"{show(ore.reference_strength, 'Pa', 3)} at {show(ore.reference_size, 'm')}, w {ore.weibull_modulus:.3g}; "
        f"{feed.kind.replace('_', ' ')} feed to {show(feed.largest_grain, 'm')}; swept: {swept}"
    )


def caption_under(figure: Figure, result: xr.Dataset, words: str) -> None:
    """Write under a figure its own words, the limits that were hit, and the remark of the scene."""
    lines = [words, *(line[0].upper() + line[1:] + "." for line in report.flag_line(result))]
    remark = scene_of(result).remark
    lines += [f"Scene: {remark}."] if remark else []
    figure.supxlabel(folded(figure, lines), fontsize=9)


def folded(figure: Figure, lines: list[str]) -> str:
    """Return the lines of a caption, each folded to the width of the figure."""
    width = int(14 * figure.get_figwidth())  # letters
    return "\n".join(textwrap.fill(line, width) for line in "\n".join(lines).splitlines())


def _products(panels, result: xr.Dataset, sieve: float) -> bool:
    """Draw the product across half the gap and by size; return whether operating points were left out."""
    points, labels, thinned = _shown_points(result)
    passing = report.percent_passing(points, sieve, total=False)
    values = xr.Dataset({"p80": points["p80"].astype(float) * 1e3, "passing": passing})
    across = values.transpose("operating_point", "replicate", "streamline")
    groups = _alike(np.concatenate([each.values.reshape(len(labels), -1) for each in across.values()], axis=1))
    chosen = [group[0] for group in groups]
    named = [labels[group[0]] + (f" (and {len(group) - 1} alike)" if len(group) > 1 else "") for group in groups]
    drawn = (("p80", "Product size", "P80 [mm]"), ("passing", "Fineness", f"below {show(sieve, 'm')} [%]"))
    for panel, (name, title, unit) in zip(panels, drawn, strict=False):
        flat = _across_half_gap(panel, across[name].isel(operating_point=chosen), result["xi"].values, named)
        panel.set(title=f"{title} to the roll" + (", flat within its noise" if flat else ""), ylabel=unit)
    handles, names = panels[0].get_legend_handles_labels()
    columns = max(200 // (10 + max(map(len, names), default=1)), 1)  # that the figure is wide enough for
    place = {"loc": "outside upper center", "ncols": min(columns, len(names)), "fontsize": 9, "frameon": False}
    panels[0].figure.legend(handles, names, title=_title(result), **place)
    of_all = "feed of the first scene" if SCENE in report.axes_of(result) else "feed of the scene"
    _product_sizes(panels[2], points.isel(operating_point=chosen), scene_of(result).feed, of_all)
    return thinned


def _across_half_gap(panel, values: xr.DataArray, xi: np.ndarray, labels: list[str]) -> bool:
    """Draw a figure of every stream tube where it was measured; return whether it is flat within its noise."""
    flat = True
    for k, label in enumerate(labels):
        one = values.isel(operating_point=k)
        mean, bars = one.mean("replicate").values, report.spread(one).values
        known = not np.isnan(bars).all()
        panel.errorbar(xi, mean, bars if known else None, label=label, **_style(k, len(labels)))
        flat &= known and bool((np.abs(mean - mean.mean()) <= 2 * bars.max() / np.sqrt(one.sizes["replicate"])).all())
    panel.set(xlabel="distance from mid-gap [half gaps]", xlim=(0, 1))
    panel.axvline(1, color="0.3", linewidth=3)  # the roll
    panel.grid(color="0.9")
    return flat


def _product_sizes(panel, points: xr.Dataset, feed, name: str) -> None:
    """Draw the size distributions of the whole product at the recorded sieves, and that of the feed, on log axes."""
    sieves, count = points["sieve"].values, points.sizes["operating_point"]
    passing = 100 * points["passing_total"].astype(float).mean("replicate").transpose("operating_point", "sieve").values
    fed = 100 * feed.passing(sieves)
    for k, percent in enumerate(passing):
        seen = (percent > 0) & (np.cumsum(percent >= 100) <= 1)  # beyond the first that all passes nothing is told
        panel.plot(1e3 * sieves[seen], percent[seen], **_style(k, count) | {"markersize": 3})
    seen = (fed > 0) & (np.cumsum(fed >= 100) <= 1)
    panel.plot(1e3 * sieves[seen], fed[seen], color="0.6", linewidth=3, alpha=0.7, zorder=0)
    # in the corner that no curve of passing reaches
    panel.text(0.98, 0.02, f"grey: {name}", color="0.4", fontsize=9, ha="right", transform=panel.transAxes)
    panel.set(xscale="log", yscale="log", xlabel="sieve [mm]", ylabel="passing [%]", title="Product of the whole gap")
    panel.set_ylim(0.1, 130)
    low = sieves[np.argmax(passing.max(axis=0) > 0.1)]
    panel.set_xlim(1e3 * low, 1.3e3 * feed.largest_grain)
    panel.grid(color="0.9", which="both")


def against_axis(panel, values: xr.DataArray, axis: xr.DataArray, heading: str) -> bool:
    """Draw a figure against the swept axis, a line per value of the other axes; return whether some were left out."""
    [dim] = axis.dims
    others = [name for name in values.dims if name not in (dim, "replicate")]
    lines = values.stack(line=others, create_index=False) if others else values.expand_dims("line")
    lines = lines.transpose("line", dim, "replicate")
    shown, total = report.shown_values(axis), lines.sizes["line"]
    order = np.argsort(shown) if axis.dtype.kind in "fiu" else np.arange(shown.size)
    lines = lines.isel(line=_thinned(np.arange(total)))
    groups, count = _alike(lines.values.reshape(lines.sizes["line"], -1)), lines.sizes["line"]
    for k in range(count):
        one = lines.isel(line=k)
        label = ", ".join(report.value_text(values[name], lines[name].values[k]) for name in others)
        bars = report.spread(one).values
        style = _style(k, count) | {"color": str(0.6 * k / max(count - 1, 1))}
        style |= {} if dim == axis.name else {"linestyle": "none"}  # other fields vary along it too
        error = None if np.isnan(bars).all() else bars[order]
        if k in [group[0] for group in groups]:
            panel.errorbar(shown[order], one.mean("replicate").values[order], error, label=label or None, **style)
        else:  # in the legend alone: what it coincides with is drawn
            panel.errorbar([], [], [], label=label, **style)
    alike = "all curves coincide" if len(groups) == 1 else f"{len(groups)} of {count} curves differ"
    alike = f" ({alike})" if len(groups) < count else ""
    panel.set(xlabel=report.axis_label(axis), ylabel=heading, title=_panel_title(heading) + alike)
    if values.max() > 0:
        low, high = panel.get_ylim()
        if low > 0 and low > 0.8 * high:  # a flat curve must look flat
            panel.set_ylim(0.8 * low, 1.2 * high)
    panel.ticklabel_format(axis="y", useOffset=False)
    panel.grid(color="0.9")
    return count < total


def _panel_title(heading: str) -> str:
    name = heading.partition(" [")[0]
    return {"W": "Specific energy"}.get(name, name[0].upper() + name[1:])


def _alike(rows: np.ndarray) -> list[list[int]]:
    """Return the numbers of rows in groups that are the same but for rounding."""
    groups: list[list[int]] = []
    for k, row in enumerate(rows):
        scale = _SAME * np.nanmax(np.abs(row), initial=0.0)
        same = (group for group in groups if np.allclose(rows[group[0]], row, rtol=0, atol=scale, equal_nan=True))
        group = next(same, None)
        groups.append([k]) if group is None else group.append(k)
    return groups


def _shown_points(result: xr.Dataset) -> tuple[xr.Dataset, list[str], bool]:
    """Return the operating points that hold a result, at most a handful, with labels."""
    points = report.operating_points(result)
    held = np.flatnonzero(points["p80_total"].notnull().any("replicate").values)
    chosen = _thinned(held)
    return points.isel(operating_point=chosen), report.point_names(result, chosen), chosen.size < held.size


def _thinned(numbers: np.ndarray) -> np.ndarray:
    """Return at most a handful of the numbers, evenly chosen."""
    places = np.linspace(0, numbers.size - 1, min(numbers.size, _MOST_LINES)).round().astype(int)
    return numbers[np.unique(places)]


def _style(k: int, count: int) -> dict:
    return {
        "color": maps.batlow(0.7 * k / max(count - 1, 1)),
        "marker": MARKERS[k % len(MARKERS)],
        "linestyle": _DASHES[k % len(_DASHES)],
        "markersize": 4.5,
        "linewidth": 1.4,
    }
