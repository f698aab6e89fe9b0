"""The paper's figures 3, 4 and 5, and the animation of the start-up, from the Dataset of `studies.paper`.

Lines differ by dash and lightness, and fields carry contour lines, so that every figure can be read in black and white.
"""

from pathlib import Path

import cmcrameri.cm as maps
import numpy as np
import xarray as xr
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PolyCollection
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.ticker import NullFormatter
from PIL import Image

from hpgr.fields import show
from hpgr.scene import Scene
from studies.show.plots.sweeps import folded

_POSITIONS = 5  # of the stream tubes, at most, whose product is drawn
_DASHES = ("-", (0, (6, 1.5)), (0, (3, 1.2)), (0, (4, 1, 1, 1)), (0, (1, 1)))
_SLOW, _FIRST, _FRAME, _LAST = 10, 400, 60, 2500  # the first frames, and ms that they, others and the last are shown
_COLOURS = 128  # of the animation


def figure3(result: xr.Dataset) -> Figure:
    """Return the paper's figure 3: streamlines, speed, material points, and their volumes."""
    figure = Figure(figsize=(10.4, 12.4), layout="constrained")
    panels = figure.subplots(2, 2).ravel()
    for panel in panels:
        _rolls(panel, result)
    _streamlines(panels[0], result)
    speed = _field(panels[1], result, result["speed"], maps.davos_r, "{:g}")
    figure.colorbar(speed, ax=panels[1], label="speed [m/s]", shrink=0.85)
    panels[1].set_title("(b) Speed")
    x, height = (1e3 * result[name].values for name in ("shown_x", "shown_height"))
    panels[2].plot(x.T, height.T, "-", color="0.75", linewidth=0.5)
    panels[2].plot(x, height, ".k", markersize=1.6)
    step = 1e3 * float(result["shown_time_step"])
    panels[2].set_title(f"(c) Material points, Δt = {step:.3g} ms apart")
    outlines, volumes = _outlines(result, 1e6 * result["volume"].values)
    drawn = _draw_cells(panels[3], outlines, volumes, LogNorm(volumes.min(), volumes.max()))
    bar = figure.colorbar(drawn[0], ax=panels[3], label="volume per roll width [mm²]", shrink=0.85)
    _plain(bar)
    panels[3].set_title("(d) Volumes of the material points")
    leaves = show(float(f"{result.attrs['streamline_deviation_m']:.2g}"), "m")
    _caption(figure, result, f"Grey: rolls, which the outermost streamline, a cubic, leaves by {leaves} at most.")
    return figure


def figure4(result: xr.Dataset) -> Figure:
    """Return the paper's figure 4: mean and shear stress, mean stress along the mid-gap, and, ours, across the gap."""
    figure = Figure(figsize=(10.4, 11.6), layout="constrained")
    panels = figure.subplots(2, 2, height_ratios=(1.35, 1)).ravel()
    fields = {"pressure": "(a) Mean stress p", "shear_stress": "(b) Triaxial shear stress q"}
    for panel, (name, title) in zip(panels[:2], fields.items(), strict=True):
        _rolls(panel, result)
        drawn = _field(panel, result, 1e-6 * result[name], maps.lipari_r, "{:g}")
        _compacting(panel, result)
        figure.colorbar(drawn, ax=panel, label=f"{title[4:]} [MPa]", shrink=0.85)
        panel.set_title(title)
    _along_mid_gap(panels[2], result)
    _across_gap(panels[3], result)
    dashed = (
        "Dashed: between the two lines the bed compacts, and can crush (eq. 1's Heaviside function); above them it "
        "dilates and carries no stress."
    )
    words = f"Grey: rolls. {dashed}" if (result["volumetric_strain_rate"] > 0).any() else "Grey: rolls."
    _caption(figure, result, words, limits=True)
    return figure


def figure5(result: xr.Dataset) -> Figure:
    """Return the paper's figure 5, product distributions at positions across the gap, and, ours, P50 and P80 there."""
    figure = Figure(figsize=(11.4, 5.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    _distributions(left, result)
    _sizes_across(right, result)
    _caption(figure, result, "", limits=True)
    return figure


def _distributions(panel, result: xr.Dataset) -> None:
    """Draw the size distributions, and their upper part enlarged."""
    sieves, xi = 1e3 * result["sieve"].values, result["product_xi"].values
    chosen = np.unique(np.linspace(0, xi.size - 1, min(xi.size, _POSITIONS)).round().astype(int))
    passing, feed = result["passing"].values, result["feed_passing"].values
    enlarged = panel.inset_axes((0.06, 0.17, 0.31, 0.4))
    for k, number in enumerate(chosen):
        place = {0: " (mid-gap)", xi.size - 1: " (at the roll)"}.get(number, "") if xi.size > 1 else ""
        style = {"color": maps.batlow(0.75 * k / max(chosen.size - 1, 1)), "linestyle": _DASHES[k]}
        panel.plot(sieves, passing[number], linewidth=1.6, label=f"± {xi[number]:.2f}{place}", **style)
        enlarged.plot(sieves, passing[number], linewidth=1.6, **style)
    panel.plot(sieves, feed, color="0.5", linewidth=3, alpha=0.6, label="feed")
    low = int(np.argmax(passing.max(axis=0) > 0.005))
    panel.set(xscale="log", xlabel="grain size [mm]", ylabel="cumulative distribution (mass fraction finer)")
    panel.set(xlim=(sieves[max(low - 1, 0)], 1.2 * sieves[np.argmax(feed > 0.999)]), ylim=(0, 1.02))
    panel.xaxis.set_major_formatter("{x:g}")
    panel.legend(title="position, half gaps from mid-gap", fontsize=9, loc="upper left")
    panel.set_title("Product at positions across the gap")
    p50, p80 = 1e3 * float(result["p50"].min()), 1e3 * float(result["p80"].max())
    enlarged.set(xlim=(0.95 * p50, 1.15 * p80), ylim=(0.45, 0.92))
    enlarged.tick_params(labelsize=8)
    for axes in (panel, enlarged):
        axes.grid(color="0.9", which="both")
    for connector in panel.indicate_inset_zoom(enlarged, edgecolor="0.4").connectors:
        connector.set_visible(False)  # they would cross the legend
    enlarged.set_title("enlarged", fontsize=9, pad=3)


def _sizes_across(panel, result: xr.Dataset) -> None:
    xi = result["product_xi"].values
    across = np.concatenate([-xi[::-1], xi])
    for name, marker, dash, lightness in (("p80", "o", "-", "0"), ("p50", "s", "--", "0.45")):
        values = 1e3 * result[name].values
        style = {"marker": marker, "linestyle": dash, "color": lightness, "markersize": 4}
        panel.plot(across, np.concatenate([values[::-1], values]), label=name.upper(), **style)
    for roll in (-1, 1):
        panel.axvline(roll, color="0.3", linewidth=3)
    panel.set(xlabel="position across the gap, roll to roll [half gaps]", ylabel="product size [mm]", xlim=(-1, 1))
    panel.set_ylim(0, 1.25e3 * float(result["p80"].max()))
    panel.set_title("Product size across the gap (ours)")
    panel.legend(loc="upper right")
    panel.grid(color="0.9")


def startup_animation(result: xr.Dataset, path: Path, comment: str = "") -> None:
    """Write the GIF of local P80 from the first fill to the steady machine, a frame per snapshot."""
    figure = Figure(figsize=(5.2, 5.9), dpi=100)
    canvas = FigureCanvasAgg(figure)
    panel = figure.add_axes((0.14, 0.155, 0.66, 0.77))
    _rolls(panel, result)
    frames = 1e3 * result["startup_p80"].values
    norm = LogNorm(frames.min(), frames.max())
    outlines, first = _outlines(result, frames[0])
    cells = _draw_cells(panel, outlines, first, norm)
    for part in cells:
        part.set(edgecolors="face", linewidths=0.3)
    bar = figure.colorbar(cells[0], cax=figure.add_axes((0.83, 0.2, 0.035, 0.68)), label="local P80 [mm]")
    _plain(bar)
    title = figure.text(0.47, 0.955, "", ha="center", fontsize=11)
    figure.text(0.47, 0.012, _startup_words(result), ha="center", va="bottom", fontsize=7)
    images = []
    for frame, elapsed, steady in zip(frames, result["elapsed_time"].values, result["steady"].values, strict=True):
        for part in cells:
            part.set_array(_outlines(result, frame)[1])
        title.set_text(f"{elapsed:.2f} s after the fill" + (", steady" if steady else ""))
        canvas.draw()
        images.append(Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB"))
    palette = images[len(images) // 2].quantize(_COLOURS)  # one for all: frames then differ only where the bed does
    indexed = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    shown = [_FIRST if k < _SLOW else _FRAME for k in range(len(indexed) - 1)] + [_LAST]
    indexed[0].save(
        path, format="GIF", save_all=True, append_images=indexed[1:], duration=shown, loop=0, comment=comment.encode()
    )


def _startup_words(result: xr.Dataset) -> str:
    exchange = Scene.model_validate_json(result.attrs["scene"]).exchange
    how = "without exchange" if exchange is None else f"A = {exchange.segregation:g}, B = {exchange.mixing:g}"
    step = 1e3 * float(result["shown_time_step"])
    return (
        f"Filled with feed, then turning until it is steady; {how}. Grains break once per time\n"
        f"step of {step:.3g} ms at most, which paces the first frames; the first of them shows one such step."
    )


def _draw_cells(panel, outlines: list[np.ndarray], values: np.ndarray, norm: Normalize) -> list[PolyCollection]:
    """Draw cells of the right half (outlines in m), coloured by `values`, and their mirror images; return both."""
    style = {"array": values, "cmap": maps.batlow, "norm": norm, "edgecolors": "0.2", "linewidths": 0.25}
    drawn = [PolyCollection([1e3 * outline * (side, 1) for outline in outlines], **style) for side in (1, -1)]
    for part in drawn:
        panel.add_collection(part)
    return drawn


def _rolls(panel, result: xr.Dataset) -> None:
    """Draw both rolls behind the bed, and set the panel's limits, aspect and labels in mm."""
    height, half_width = 1e3 * float((result["height"] + result["mid_gap_depth"]).max()), 1e3 * float(result["x"].max())
    radius, axis = 1e3 * float(result["roll_radius"]), 1e3 * float(result["roll_axis_x"])
    for side in (-1, 1):
        panel.add_patch(Circle((side * axis, 0), radius, facecolor="0.85", edgecolor="0.3", zorder=0))
    panel.set(xlabel="x across the gap [mm]", ylabel="height above the minimum gap [mm]", aspect="equal")
    panel.set(xlim=(-1.25 * half_width, 1.25 * half_width), ylim=(-0.06 * height, 1.04 * height))


def _streamlines(panel, result: xr.Dataset) -> None:
    """Draw the mid-plane, the outermost streamlines, and every other one between them, with arrows downwards."""
    x, height = 1e3 * result["x"].values, 1e3 * result["height"].values
    last = len(x) - 1
    for line in sorted({0, last // 2, last, *range(1, last // 2, 2), *range(last - 1, last // 2, -2)}):
        across, up = x[line], height[line]
        panel.plot(across, up, "-", color="0.1", linewidth=1.6 if line in (0, last) else 0.8)
        k = int(np.argmax(up < 0.62 * up[0]))
        if line not in (0, last) and 0 < k < up.size - 1:
            head = {"arrowstyle": "-|>", "color": "0.1", "mutation_scale": 10, "linewidth": 0}
            panel.annotate("", (across[k + 1], up[k + 1]), (across[k - 1], up[k - 1]), arrowprops=head)
    panel.set_title("(a) Streamlines")


def _field(panel, result: xr.Dataset, values: xr.DataArray, cmap, form: str):
    """Draw a field from roll to roll with labelled contour lines; return what a colour bar is for."""
    x, height, shown = 1e3 * result["x"].values, 1e3 * result["height"].values, values.values.astype(float)
    drawn = panel.pcolormesh(x, height, shown, cmap=cmap, shading="gouraud", vmin=0, vmax=shown.max() or 1.0)
    if shown.max() > shown.min():
        step = _round_step(float(shown.max()) / 5)
        levels = np.arange(step, shown.max(), step)
        panel.contour(x, height, shown, levels=levels, colors="black", linewidths=0.7)
        inner = len(x) // 2
        for level in levels:  # beside the bed, on the right roll: the bed is too narrow for numbers
            k = int(np.argmax(shown[inner] > level))
            place = x[-1, k], height[inner, k]
            if k:
                panel.annotate(form.format(level), place, (6, 0), textcoords="offset points", fontsize=8, va="center")
    return drawn


def _round_step(step: float) -> float:
    """Return the largest of 1, 2, 5 times a power of ten below `step`."""
    power = 10.0 ** np.floor(np.log10(step))
    return float(power * max(m for m in (1, 2, 5) if m * power <= step * (1 + 1e-9)))


def _compacting(panel, result: xr.Dataset) -> None:
    """Mark where compaction begins and ends."""
    place = (1e3 * result["x"].values, 1e3 * result["height"].values, result["volumetric_strain_rate"].values)
    for style in ({"colors": "white", "linewidths": 2.4}, {"colors": "0.15", "linewidths": 1.2, "linestyles": "--"}):
        panel.contour(*place, levels=[0], **style)


def _along_mid_gap(panel, result: xr.Dataset) -> None:
    middle, height = result.sizes["streamline"] // 2, 1e3 * result["height"].values
    top = 1e3 * float(result["mid_gap_depth"][0]) + height[middle, 0]
    for name, line, style, label in (
        ("pressure", middle, {"color": "k", "linewidth": 1.8}, "p at mid-gap"),
        ("pressure", -1, {"color": "0.35", "linewidth": 1.4, "linestyle": "--"}, "p at the roll"),
        ("shear_stress", middle, {"color": "0.35", "linewidth": 1.6, "linestyle": ":"}, "q at mid-gap"),
    ):
        panel.plot(1e-6 * result[name].values[line], top - height[line], label=label, **style)
    panel.set(ylim=(top, 0), xlabel="stress [MPa]", ylabel="depth below the top of the bed [mm]")
    panel.set_xlim(left=0)
    panel.set_title("(c) Mean stress along the mid-gap")
    panel.legend(loc="upper right")
    panel.grid(color="0.9")


def _across_gap(panel, result: xr.Dataset) -> None:
    x = 1e3 * result["x"].values[:, -1]
    for name, label, dash, lightness in (("pressure", "p", "-", "0"), ("shear_stress", "q", ":", "0.35")):
        style = {"linestyle": dash, "color": lightness, "marker": "o", "markersize": 3}
        panel.plot(x, 1e-6 * result[name].values[:, -1], label=label, **style)
    for roll in (x[0], x[-1]):
        panel.axvline(roll, color="0.3", linewidth=3)
    panel.set(xlim=(x[0], x[-1]), xlabel="x across the gap [mm]", ylabel="stress [MPa]")
    panel.set_ylim(0, 1.3e-6 * float(max(result[name].max() for name in ("shear_stress", "pressure"))) or 1.0)
    panel.set_title("(d) Stresses across the minimum gap (ours)")
    panel.legend(loc="lower center", ncols=2)
    panel.grid(color="0.9")


def _outlines(result: xr.Dataset, values: np.ndarray) -> tuple[list[np.ndarray], np.ndarray]:
    """Return the outlines of the right half's cells, m, and the value of each; values are (shown streamline, point)."""
    corners = np.column_stack([result["corner_x"].values, result["corner_height"].values])
    starts = np.flatnonzero(np.diff(result["corner_outline"].values)) + 1
    right = values[values.shape[0] // 2 :]
    return np.split(corners, starts), right.ravel()[result["outline_cell"].values]


def _plain(bar) -> None:
    """Write the numbers of a logarithmic colour bar in full."""
    low, high = bar.norm.vmin, bar.norm.vmax
    ticks = [step * 10.0**k for k in range(-9, 10) for step in (1, 2, 5) if low <= step * 10.0**k <= high]
    bar.set_ticks(ticks)
    bar.ax.yaxis.set_major_formatter("{x:g}")
    bar.ax.yaxis.set_minor_formatter(NullFormatter())


def _caption(figure: Figure, result: xr.Dataset, words: str, limits: bool = False) -> None:
    """Write under the figure what it is of: scene, own words, and, if wished, the limits that were hit."""
    scene = Scene.model_validate_json(result.attrs["scene"])
    rolls = scene.rolls
    exchange = "without exchange" if scene.exchange is None else "with segregation and mixing"
    about = (
        f"Rolls {show(rolls.diameter, 'm')}, gap {show(rolls.gap, 'm')}, entry gap "
        f"{show(rolls.entry_gap, 'm')}, {30 / np.pi * rolls.speed:.3g} rpm; {scene.feed.kind} feed to "
        f"{show(scene.feed.largest_grain, 'm')}; {exchange}."
    )
    hit = [line.partition(": ")[2] for line in result.attrs["diagnostics"].splitlines()] if limits else []
    hit = [line[0].upper() + line[1:] + "." for line in hit]
    remark = [f"Scene: {scene.remark}."] if scene.remark else []
    figure.supxlabel(folded(figure, [line for line in (about, words, *hit, *remark) if line]), fontsize=8)
