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
_TITLES = {
    "gap_speed": "Gap and roll speed",
    "cushioning_step": "Cushioning and time step",
    "exponent_step": "Elastic exponent and time step",
}
_ERROR_LEVELS = (0.0, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0, np.inf)


def stability(result: xr.Dataset) -> Figure:
    """Return the maps of outcomes, a panel each.

    Parameters
    ----------
    result : xarray.Dataset
        From `studies.guard.maps.maps`.
    """
    names = [name for name in _TITLES if f"{name}_outcome" in result]
    figure = Figure(figsize=(6.2 * len(names), 7.4), layout="constrained")
    seen: set[str] = set()
    for panel, name in zip(np.atleast_1d(figure.subplots(1, len(names))), names, strict=True):
        seen |= _outcomes(panel, result, name)
    patches = [
        Patch(facecolor=shade, edgecolor="black", label=words)
        for kind, (shade, words) in enumerate(zip(_SHADES, _WORDS, strict=True))
        if kind < 4 or any((result[f"{name}_outcome"] == kind).any() for name in names)
    ]
    figure.legend(handles=patches, loc="outside upper center", ncols=len(patches), fontsize=10)
    letters = ", ".join(f"{letter}: {meaning}" for letter, meaning in _LETTERS.values() if letter in seen)
    figure.supxlabel(
        f"Letters: {letters}. Refused: outside the range of the field, or too many substeps.\n"
        "Paper's rolls with a bed that begins at a gap of 500 mm; segregation and mixing on. Narrow gaps and small "
        "time steps bring points closer together: exchange then takes more substeps, and below 1 mm too many.\nRoll "
        "speed changes no outcome. Steps of 1/8 and longer miss the compaction near the gap. Exponents below 0 ask for "
        "tension at its onset once steps are small enough to see it. No scene ends without a word.",
        fontsize=10,
    )
    return figure


def _outcomes(panel, result: xr.Dataset, name: str) -> set[str]:
    """Draw one map of outcomes; return the letters in it."""
    outcome, bits, substeps = (result[f"{name}_{part}"] for part in ("outcome", "flags", "substeps"))
    columns, rows = (result[dim] for dim in outcome.dims)
    panel.imshow(outcome.values.T, cmap=ListedColormap(_SHADES), vmin=-0.5, vmax=4.5, origin="lower", aspect="auto")
    seen: set[str] = set()
    for i, j in np.ndindex(outcome.shape):
        kind, said = int(outcome[i, j]), int(bits[i, j])
        letters = "".join(_LETTERS[name][0] for name in flags.names(said) if name in _LETTERS)
        seen |= set(letters)
        number = str(int(substeps[i, j])) if kind == 2 else ""
        text = {0: "·", 3: "×", 4: "!"}.get(kind, "\n".join(filter(None, (number, letters))))
        panel.text(
            i,
            j,
            text,
            ha="center",
            va="center",
            fontsize=7.5,
            color="white" if kind >= 3 else "black",
            linespacing=0.95,
        )
    panel.set_xticks(np.arange(columns.size), _ticks(columns), rotation=90)
    panel.set_yticks(np.arange(rows.size), _ticks(rows))
    panel.set(title=_TITLES[name], xlabel=_label(columns), ylabel=_label(rows))
    _grid(panel, outcome.shape)
    return seen


def integrators(result: xr.Dataset) -> Figure:
    """Return the errors of the explicit rule beside those of the increments, over exponent, time step and strain.

    Parameters
    ----------
    result : xarray.Dataset
        From `studies.guard.maps.maps`.
    """
    figure = Figure(figsize=(13, 10.5), layout="constrained")
    panels = figure.subplots(2, 2, sharex=True)
    titles = {"euler": "Euler, the paper's explicit rule", "increment": "Increments of the state functions"}
    for column, integrator in zip(panels.T, result["integrator"].values, strict=True):
        for panel, name in zip(column, ("step", "strain"), strict=True):
            _errors(panel, result.sel(integrator=integrator), name)
        column[0].set_title(titles[str(integrator)])
        column[1].set_xlabel("elastic exponent c [-]")
    for panel in panels[:, 0]:
        panel.set_ylabel(panel.get_label())
    percents = [f"{100 * level:g}" for level in _ERROR_LEVELS[:-1]]
    bounds = [f"{low} to {high} %" for low, high in pairwise(percents)] + [f"above {percents[-1]} %"]
    shades = _error_shades()
    patches = [
        Patch(facecolor=shade, edgecolor="black", label=text) for shade, text in zip(shades, bounds, strict=True)
    ]
    patches.append(Patch(facecolor="white", edgecolor="black", hatch="////", label="no limit of small steps"))
    figure.legend(handles=patches, loc="outside upper center", ncols=len(patches), fontsize=9)
    figure.supxlabel(
        "Largest error of pressure at a material point [% of the largest pressure], against increments at 6,400 time "
        "steps. T: tension or reverse shear held at 0, flagged.\nHatched: the pressure has no limit: from 3,200 to "
        "6,400 steps it still changes by over 2 %; with exponents below 0 it grows with the number of steps.\n"
        "Paper's rolls; upper row: its bed (entry gap 1,140 mm); lower row: 40 time steps.",
        fontsize=10,
    )
    return figure


def _error_shades() -> list[str]:
    return [str(round(shade, 3)) for shade in np.linspace(1.0, 0.1, len(_ERROR_LEVELS) - 1)]


def _errors(panel, result: xr.Dataset, name: str) -> None:
    """Draw the error of one integrator over exponent and time step, or exponent and strain."""
    error = result[f"integrator_{name}_error"].values
    tension, settled = (result[f"integrator_{name}_{part}"].values for part in ("tension", "settled"))
    level = np.clip(np.searchsorted(_ERROR_LEVELS, error, side="right") - 1, 0, len(_ERROR_LEVELS) - 2)
    shades = _error_shades()
    panel.imshow(level.T, cmap=ListedColormap(shades), vmin=-0.5, vmax=len(shades) - 0.5, origin="lower", aspect="auto")
    for i, j in np.ndindex(error.shape):
        text, ink = "T" if tension[i, j] else "", "white" if level[i, j] >= 4 else "black"
        if settled[i, j]:
            text = f"{_percent(error[i, j])}\n{text}".strip()
        else:
            panel.fill(
                [i - 0.5, i + 0.5, i + 0.5, i - 0.5],
                [j - 0.5, j - 0.5, j + 0.5, j + 0.5],
                facecolor="white",
                hatch="///",
                edgecolor="0.6",
                linewidth=0,
            )
            ink = "black"
        panel.text(i, j, text, ha="center", va="center", fontsize=8, color=ink, linespacing=0.95)
    exponents = result["exponent"].values
    panel.set_xticks(np.arange(exponents.size), [f"{c:g}" for c in exponents])
    if name == "step":
        panel.set_yticks(np.arange(error.shape[1]), [f"1/{steps}" for steps in result["steps"].values])
        panel.set_label("time step dt [residence times]")
    else:
        pairs = zip(result["strain"].values, result["entry_gap"].values, strict=True)
        panel.set_yticks(np.arange(error.shape[1]), [f"{strain:.2g}\n({1e3 * gap:g} mm)" for strain, gap in pairs])
        panel.set_label("largest volumetric strain [-] (entry gap)")
    _grid(panel, error.shape)


def _percent(error: float) -> str:
    return f"{100 * error:.0f}" if error >= 0.0995 else f"{100 * error:.1f}"


def _grid(panel, shape: tuple[int, int]) -> None:
    panel.set_xticks(np.arange(shape[0] + 1) - 0.5, minor=True)
    panel.set_yticks(np.arange(shape[1] + 1) - 0.5, minor=True)
    panel.grid(which="minor", color="0.5", linewidth=0.5)
    panel.tick_params(which="minor", length=0)


def _ticks(axis: xr.DataArray) -> list[str]:
    if axis.attrs["scene_field"] == "resolution.points":
        return [f"1/{int(points) - 1}" if points > 2 else "1" for points in axis.values]
    factor = unit_shown(axis.attrs["units"])[1]
    return [f"{value * factor:.3g}" for value in axis.values]


def _label(axis: xr.DataArray) -> str:
    if axis.attrs["scene_field"] == "resolution.points":
        return "time step dt [residence times]"
    shown = unit_shown(axis.attrs["units"])[0]
    words = {
        "strength.cushioning": "cushioning constant n",
        "elasticity.exponent": "elastic exponent c",
        "rolls.gap": "gap",
        "rolls.speed": "roll speed",
    }[axis.attrs["scene_field"]]
    return f"{words} [{'-' if shown == '1' else shown}]"
