"""Figures of `studies.extremes`: where the model is stable, and how far each integrator is off.

Every cell of a map carries its outcome as a shade and as letters, so that it reads in black and white.
"""

from itertools import pairwise

import numpy as np
import xarray as xr
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from hpgr.fields import unit_shown
from hpgr.results import flags

_LETTERS = {  # flag -> letter in a map, and its meaning
    "solid_fraction_capped": ("C", "solid fraction capped"),
    "single_particle_nipping": ("N", "single grains nipped"),
    "no_compaction": ("D", "no compaction"),
    "no_breakage": ("B", "no grain breaks"),
    "size_floor_reached": ("F", "size floor reached"),
    "tension_clamped": ("T", "tension held at 0"),
    "few_cells": ("M", "few cells"),
    "no_limit_of_steps": ("L", "no limit of small steps"),
}
_SHADES = ("white", "0.86", "0.68", "0.35", "black")  # ok, flagged, substepped, refused, fault
_WORDS = ("·  ok", "flagged (letters)", "substepped (number of substeps, letters)", "×  refused", "!  silent fault")
_ERROR_LEVELS = (0.0, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0, np.inf)
_ERROR_SHADES = [str(round(shade, 3)) for shade in np.linspace(1.0, 0.1, len(_ERROR_LEVELS) - 1)]
_SAID = {"resolution.points": "time step dt", "strength.cushioning": "cushioning n"}
_SAID |= {"elasticity.exponent": "exponent c"}


def stability(result: xr.Dataset) -> Figure:
    """Return the maps of outcomes of `studies.guard.maps.maps`, a panel each."""
    names = [name.removesuffix("_outcome") for name in result if name.endswith("_outcome")]
    figure = Figure(figsize=(6.2 * len(names), 7.4), layout="constrained")
    seen: set[str] = set()
    for panel, name in zip(np.atleast_1d(figure.subplots(1, len(names))), names, strict=True):
        seen |= _outcomes(panel, result, name)
    faulty = any((result[f"{name}_outcome"] == 4).any() for name in names)
    shown = list(zip(_SHADES, _WORDS, strict=True))[: 5 if faulty else 4]
    patches = [Patch(facecolor=shade, edgecolor="black", label=words) for shade, words in shown]
    figure.legend(handles=patches, loc="outside upper center", ncols=len(patches), fontsize=10)
    letters = ", ".join(f"{letter}: {meaning}" for letter, meaning in _LETTERS.values() if letter in seen)
    figure.supxlabel(
        f"Letters: {letters}. Refused: outside the range of the field, or too many substeps.\n"
        "Paper's rolls with a bed that begins at a gap of 500 mm; exchange on. Time steps in residence times.",
        fontsize=10,
    )
    return figure


def _outcomes(panel, result: xr.Dataset, name: str) -> set[str]:
    """Draw one map of outcomes; return the letters in it."""
    outcome, bits, substeps = (result[f"{name}_{part}"] for part in ("outcome", "flags", "substeps"))
    texts, seen = np.empty(outcome.shape, object), set()
    for place in np.ndindex(outcome.shape):
        kind = int(outcome[place])
        letters = "".join(_LETTERS[flag][0] for flag in flags.names(int(bits[place])) if flag in _LETTERS)
        seen |= set(letters)
        number = str(int(substeps[place])) if kind == 2 else ""
        texts[place] = {0: "·", 3: "×", 4: "!"}.get(kind, "\n".join(filter(None, (number, letters))))
    columns, rows = (result[dim] for dim in outcome.dims)
    _cells(panel, outcome.values, _SHADES, texts, dark=3)
    panel.set_xticks(np.arange(columns.size), _ticks(columns), rotation=90)
    panel.set_yticks(np.arange(rows.size), _ticks(rows))
    panel.set(xlabel=_label(columns), ylabel=_label(rows))
    return seen


def _cells(panel, level: np.ndarray, shades, texts: np.ndarray, dark: int) -> None:
    """Draw a map of levels as shades with texts, which are white from level `dark` on."""
    style = {"cmap": ListedColormap(shades), "vmin": -0.5, "vmax": len(shades) - 0.5}
    panel.imshow(level.T, origin="lower", aspect="auto", **style)
    for i, j in np.ndindex(level.shape):
        ink = "white" if level[i, j] >= dark else "black"
        panel.text(i, j, texts[i, j], ha="center", va="center", fontsize=7.5, color=ink, linespacing=1.1)
    panel.set_xticks(np.arange(level.shape[0] + 1) - 0.5, minor=True)
    panel.set_yticks(np.arange(level.shape[1] + 1) - 0.5, minor=True)
    panel.grid(which="minor", color="0.5", linewidth=0.5)
    panel.tick_params(which="minor", length=0)


def _ticks(axis: xr.DataArray) -> list[str]:
    if axis.attrs["scene_field"] == "resolution.points":
        return [f"1/{int(points) - 1}" for points in axis.values]
    return [f"{value * unit_shown(axis.attrs['units'])[1]:.3g}" for value in axis.values]


def _label(axis: xr.DataArray) -> str:
    field, shown = axis.attrs["scene_field"], unit_shown(axis.attrs["units"])[0]
    return f"{_SAID.get(field, field.replace('.', ' '))} [{'-' if shown == '1' else shown}]"


def integrators(result: xr.Dataset) -> Figure:
    """Return the errors of the paper's explicit rule beside those of the increments, over exponent and time step."""
    figure = Figure(figsize=(13, 6), layout="constrained")
    titles = {"euler": "Euler, the paper's explicit rule", "increment": "Increments of the state functions"}
    for panel, integrator in zip(figure.subplots(1, 2, sharey=True), result["integrator"].values, strict=True):
        one = result.sel(integrator=integrator)
        error, tension, settled = (one[f"integrator_{part}"].values for part in ("error", "tension", "settled"))
        level = np.clip(np.searchsorted(_ERROR_LEVELS, error, side="right") - 1, 0, len(_ERROR_SHADES) - 1)
        told = np.where(settled == 1, [[f"{100 * e:.1f}\n" for e in row] for row in error], "no limit\n")
        texts = np.char.add(told, np.where(tension == 1, "T", ""))
        _cells(panel, np.where(settled == 1, level, 0), _ERROR_SHADES, texts, dark=4)
        panel.set_xticks(np.arange(level.shape[0]), [f"{c:g}" for c in one["exponent"].values])
        panel.set_yticks(np.arange(level.shape[1]), [f"1/{steps}" for steps in one["steps"].values])
        panel.set(title=titles[str(integrator)], xlabel="exponent c [-]", ylabel="time step dt [residence times]")
    percents = [f"{100 * level:g}" for level in _ERROR_LEVELS[:-1]]
    bounds = [f"{low} to {high} %" for low, high in pairwise(percents)] + [f"above {percents[-1]} %"]
    patches = [Patch(facecolor=s, edgecolor="black", label=b) for s, b in zip(_ERROR_SHADES, bounds, strict=True)]
    figure.legend(handles=patches, loc="outside upper center", ncols=len(patches), fontsize=9)
    figure.supxlabel(
        "Largest error of pressure at a material point [% of the largest pressure], against increments at 6,400 time "
        "steps on the paper's bed. T: tension or reverse shear held at 0, flagged.\nNo limit: from 3,200 to 6,400 "
        "steps the pressure still changes by over 2 %; with exponents below 0 it grows with the number of steps.",
        fontsize=10,
    )
    return figure
