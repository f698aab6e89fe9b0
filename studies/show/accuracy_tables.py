"""Tables of `studies.accuracy`, those of docs/accuracy.md."""

from typing import NamedTuple

import numpy as np
import xarray as xr

from studies.accuracy import QUANTITIES, SAMPLED
from studies.convergence import SAFETY
from studies.show.report import aligned

TARGETS = (0.05, 0.02, 0.005)  # relative errors for which the cheapest resolution is named

_SHOWN = [quantity.shown for quantity in QUANTITIES.values()]
_COMBINATION = ["N", "P", "M", "time [ms]", "bias [%]", "noise [%]", "error of P80 [%]", "error [%]"]


class Table(NamedTuple):
    """A table to print: title, headings, rows of text."""

    title: str
    headings: list[str]
    rows: list[list[str]]


def short(result: xr.Dataset) -> list[Table]:
    """Return the tables for a terminal: convergence in dt, noise, and which resolution to take."""
    return [_convergence_table(result), _noise_table(result), _choice_table(result)]


def every(result: xr.Dataset) -> list[Table]:
    """Return every table, those of docs/accuracy.md."""
    found = []
    for name in result["variant"].values:
        words = "the scene" + (" as it is" if name == "scene" else f" with {name}")
        title = f"Points, {words}: bias ± its standard error"
        found.append(_ladder_table(result.sel(variant=name), "points", title))
    found.append(_convergence_table(result))
    for name in ("streamlines", "cells", "snapshots"):
        title = f"{name.capitalize()}: bias from the last row ± its standard error"
        found.append(_ladder_table(result, name, title))
    rest = (_noise_table, _solver_table, _storage_table, _front_table, _choice_table)
    return found + [table(result) for table in rest]


def in_words(found: list[Table], markdown: bool) -> str:
    """Return tables as text, or as markdown."""
    title = "**{}**\n" if markdown else "{}"
    return "\n\n".join(f"{title.format(each.title)}\n{aligned(each.headings, each.rows, markdown, words=1)}" for each in found)


def _percent(value: float) -> str:
    return "-" if np.isnan(value) else f"{100 * value:.3f}"


def _signed(value: float, error: float) -> str:
    return "-" if np.isnan(value) else f"{100 * value:+.3f} ± {100 * error:.3f}"


def _either(value: float, error: float) -> str:
    if np.isnan(value):
        return "-"
    return f"{value:.2f}" + ("" if np.isnan(error) else f" ± {error:.2f}")


def _milliseconds(seconds: float) -> str:
    return f"{1e3 * seconds:.3g}"


def _ladder_table(result, name: str, title: str) -> Table:
    rows = []
    for k, rung in enumerate(result[name].values):
        bias, error, noise = (result[f"{name}_{key}"].values[k] for key in ("bias", "bias_error", "noise"))
        cost = _milliseconds(float(result[f"{name}_wall_time"][k]))
        rows.append([str(rung), cost, *map(_signed, bias, error), *map(_percent, noise[:SAMPLED])])
    noisy = [f"noise of {shown} [%]" for shown in _SHOWN[:SAMPLED]]
    return Table(title, [name, "time [ms]", *(f"{shown} [%]" for shown in _SHOWN), *noisy], rows)


def _convergence_table(result) -> Table:
    rows = []
    for variant in result["variant"].values:
        one = result.sel(variant=variant)
        for k, (name, quantity) in enumerate(QUANTITIES.items()):
            order = _either(float(one["order"][-1, k]), float(one["order_error"][k]))
            value = f"{float(one[f'limit_{name}']) * quantity.factor:.5g} {quantity.unit}"
            errors = float(one["points_bias"][-1, k]), float(one["convergence_index"][k])
            rows.append([variant, quantity.shown, order, value, *map(_percent, errors)])
    headings = ["variant", "quantity", "order", "limit", "bias of finest [%]", f"GCI, Fs = {SAFETY} [%]"]
    return Table("Convergence in dt at {}, {}, {} points".format(*result["points"].values[-3:]), headings, rows)


def _noise_table(result) -> Table:
    rows = []
    for name in ("streamlines", "cells", "snapshots"):
        pairs = (result[f"{name}_noise_exponent{key}"].values[:SAMPLED] for key in ("", "_error"))
        rows.append([name, *map(_either, *pairs)])
    return Table("Exponent of the noise", ["against", *_SHOWN[:SAMPLED]], rows)


def _solver_table(result) -> Table:
    rows, sampled = [], _SHOWN[:SAMPLED]
    for k, name in enumerate(result["solver"].values):
        errors = np.concatenate([result[f"solver_{key}"].values[k, :SAMPLED] for key in ("bias", "noise")])
        apart = _percent(float(result["lattice_less_march"].max())) if name == "lattice" else ""
        cost = _milliseconds(float(result["solver_wall_time"][k]))
        rows.append([name, str(int(result["solver_replicates"][k])), cost, *map(_percent, errors), apart])
    columns = [*(f"{name} [%]" for name in sampled), *(f"noise of {name} [%]" for name in sampled)]
    title = f"Solvers without cushioning, less the {result['solver'].values[0]} ({result.attrs['held']})"
    return Table(title, ["solver", "replicates", "time [ms]", *columns, "less march, same replicates [%]"], rows)


def _storage_table(result) -> Table:
    apart = np.abs(result["storage_difference"].values).T
    parts = {QUANTITIES[name].shown: row for name, row in zip(result["sampled_quantity"].values, apart, strict=True)}
    parts["cells of another size, fraction"] = result["storage_cells_apart"].values
    rows = [[name, f"{np.median(each):.1e}", f"{each.max():.1e}"] for name, each in parts.items()]
    title = "Cells stored as float32 against float64, relative difference over replicates"
    return Table(title, ["", "median", "largest"], rows)


def _combination_row(result, k: int) -> list[str]:
    grid = [str(int(result[f"combination_{axis}"][k])) for axis in ("streamlines", "points", "cells")]
    bias, noise = (result[f"combination_{key}"].values[k, :SAMPLED] for key in ("bias", "noise"))
    worst, p80 = float(result["combination_worst_error"][k]), float(result["combination_error"][k, 1])
    cost = _milliseconds(float(result["combination_wall_time"][k]))
    return [*grid, cost, *map(_percent, (np.abs(bias).max(), noise.max(), p80, worst))]


def _front_table(result) -> Table:
    front = np.flatnonzero(result["combination_on_front"].values)
    order = front[np.argsort(result["combination_wall_time"].values[front])]
    rows = [[*_combination_row(result, k), str(result["combination_level"].values[k])] for k in order]
    return Table("Pareto front (worst of P50, P80, below 1 mm)", [*_COMBINATION, "level"], rows)


def _choice_table(result) -> Table:
    named = {f"cheapest within {100 * target:g} %": chosen(result, target) for target in TARGETS}
    levels = result["combination_level"].values
    named |= {f"level {levels[k]}": k for k in np.flatnonzero(levels != "")}
    blank = ["-"] * len(_COMBINATION)
    rows = [[name, *(blank if k is None else _combination_row(result, k))] for name, k in named.items()]
    index, error = (result[f"reference_{key}"].values[:SAMPLED].max() for key in ("convergence_index", "error"))
    title = (
        "Which resolution (worst of P50, P80, below 1 mm; the reference itself: grid convergence index "
        f"{_percent(index)} %, standard error {_percent(error)} %)"
    )
    return Table(title, ["", *_COMBINATION], rows)


def chosen(result: xr.Dataset, target: float) -> int | None:
    """Return the number of the cheapest combination whose worst error is at most `target`; None if there is none."""
    seconds = result["combination_wall_time"].values
    good = np.flatnonzero(result["combination_worst_error"].values <= target)
    return int(good[seconds[good].argmin()]) if good.size else None
