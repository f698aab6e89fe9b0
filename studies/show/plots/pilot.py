"""Figures of `studies.pilot`: measured against predicted."""

import cmcrameri.cm as maps
import numpy as np
import xarray as xr
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

_MARKERS = {"centre": "o", "edge": "^", "total": "s"}
_LINES = ("-", "--", "-.", ":")


def pilot_figure(result: xr.Dataset) -> Figure:
    """Return a panel of size distributions per test of `studies.pilot.assemble`, and one of errors of figures."""
    tests, sources = result["test"].values, list(result["source"].values[1:])
    columns = min(3, tests.size + 1)
    rows = -(-(tests.size + 1) // columns)
    figure = Figure(figsize=(4.6 * columns, 3.9 * rows + 0.8), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for panel, test in zip(panels, tests, strict=False):
        distributions(panel, result.sel(test=test), sources)
    figure_errors(panels[tests.size], result, sources)
    for panel in panels[tests.size + 1 :]:
        panel.set_axis_off()
    seen = [part for part in _MARKERS if result["passing"].sel(source="measured", part=part).notnull().any()]
    parts = [
        Line2D([], [], marker=mark, color=_colour(k), linestyle="none", label=f"measured, {part}")
        for k, (part, mark) in enumerate(_MARKERS.items())
        if part in seen
    ]
    lines = [Line2D([], [], color="0.3", linestyle=_LINES[k % len(_LINES)], label=one) for k, one in enumerate(sources)]
    figure.legend(handles=parts + lines, loc="outside upper center", ncols=4, fontsize=9)
    figure.supxlabel(
        "Lines: predicted, with 90 % intervals; centre and edge are of the roll width. Other models: the total only.",
        fontsize=9,
    )
    return figure


def distributions(panel, one: xr.Dataset, sources: list[str]) -> None:
    """Draw measured and predicted size distributions of one test."""
    sieves = 1e3 * one["sieve"].values
    for k, (part, mark) in enumerate(_MARKERS.items()):
        measured = 100 * one["passing"].sel(source="measured", part=part).values
        panel.plot(sieves, measured, mark, color=_colour(k), markersize=4.5)
        for j, name in enumerate(sources):
            if j == 0 or part == "total":
                values = 100 * one["passing"].sel(source=name, part=part).values
                seen = np.isfinite(values)
                panel.plot(sieves[seen], values[seen], _LINES[j % len(_LINES)], color=_colour(k), linewidth=1.2)
        ends = [100 * one[f"passing_{side}"].sel(source=sources[0], part=part).values for side in ("lower", "upper")]
        panel.fill_between(sieves, *ends, where=np.isfinite(ends[0]), color=_colour(k), alpha=0.15, linewidth=0)
    told = "blind" if one["blind"].item() else "fitted"
    rmse = {part: one["rmse"].sel(source=sources[0], part=part).item() for part in _MARKERS}
    errors = ", ".join(f"{part} {value:.1f}" for part, value in rmse.items() if np.isfinite(value)) or "none"
    panel.set_title(f"{one['test'].item()} ({told}); RMSE {errors}", fontsize=10)
    panel.set(xscale="log", xlabel="sieve [mm]", ylabel="passing [%]", ylim=(0, 103))
    panel.grid(color="0.9", which="both")


def figure_errors(panel, result: xr.Dataset, sources: list[str]) -> None:
    """Draw by how many percent throughput, power and specific energy of every test are missed."""
    names = ("throughput", "power", "specific_energy")
    measured, tests = result.sel(source="measured"), result["test"].values
    place = np.arange(tests.size)
    for k, (name, mark) in enumerate(zip(names, "oD^", strict=True)):
        for j, source in enumerate(sources):
            off = 100 * (result[name].sel(source=source) / measured[name] - 1).values
            if np.isfinite(off).any():
                shift = 0.12 * (k - 1) + 0.035 * (j - 1)
                own = {"fillstyle": "none"} if j else {"label": name.replace("_", " ")}
                panel.plot(place + shift, off, mark, color=_colour(k), markersize=6, **own)
    for side in (-10, 10):
        panel.axhline(side, color="0.6", linewidth=0.8, linestyle=":")
    panel.axhline(0, color="0.3", linewidth=0.8)
    named = [f"{name}{'' if blind else ' (fitted)'}" for name, blind in zip(tests, result["blind"].values, strict=True)]
    panel.set_xticks(place, named, rotation=30, fontsize=8)
    panel.set(ylabel="predicted over measured - 1 [%]")
    panel.set_title(f"full: {sources[0]}; hollow: other models; dotted: 10 %", fontsize=10)
    panel.legend(fontsize=8)
    panel.grid(color="0.9")


def _colour(k: int):
    return maps.batlow(0.1 + 0.35 * k)
