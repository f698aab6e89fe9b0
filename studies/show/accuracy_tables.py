"""Tables of `studies.accuracy`, those of docs/accuracy.md."""

from typing import NamedTuple

import numpy as np
import xarray as xr

from hpgr.fields import unit_shown
from studies.convergence import SAFETY, jackknife, noise_exponent, observed_order, richardson
from studies.show.report import aligned

TARGETS = (0.05, 0.02, 0.005)  # relative errors for which the cheapest resolution is named

_COMBINATION = ["N", "P", "M", "time [ms]", "bias [%]", "noise [%]", "error of P80 [%]", "error [%]"]


class Table(NamedTuple):
    """A table to print: title, headings, rows of text."""

    title: str
    headings: list[str]
    rows: list[list[str]]


def short(result: xr.Dataset) -> list[Table]:
    """Return the tables for a terminal: convergence in dt, noise, and which resolution to take."""
    return [_convergence(result), _noise(result), _choice(result)]


def every(result: xr.Dataset) -> list[Table]:
    """Return every table."""
    found = []
    for name in result["variant"].values:
        words = "the scene" + (" as it is" if name == "scene" else f" with {name}")
        found.append(_ladder(result.sel(variant=name), "points", f"Points, {words}: bias"))
    found.append(_convergence(result))
    found += [
        _ladder(result, name, f"{name.capitalize()}: bias from the last row")
        for name in ("streamlines", "cells", "snapshots")
    ]
    found += [_noise(result), _ladder(result, "solver", "Solvers without cushioning: bias from the first row")]
    found.append(_ladder(result, "storage", "Cells stored, plain NumPy rule: bias from the last row"))
    return [*found, _pareto(result), _choice(result)]


def in_words(found: list[Table], markdown: bool) -> str:
    """Return tables as text, or as markdown."""
    title = "**{}**\n" if markdown else "{}"
    return "\n\n".join(
        f"{title.format(each.title)}\n{aligned(each.headings, each.rows, markdown, words=1)}" for each in found
    )


def chosen(result: xr.Dataset, target: float) -> int | None:
    """Return the number of the cheapest combination whose worst error is at most `target`; None if there is none."""
    seconds = result["combination_wall_time"].values
    good = np.flatnonzero(result["combination_worst_error"].values <= target)
    return int(good[seconds[good].argmin()]) if good.size else None


def _shown(result: xr.Dataset) -> list[str]:
    """Return the names of the quantities as they are shown."""
    return [result[f"points_{name}"].attrs["long_name"].partition(",")[0] for name in result["quantity"].values]


def _sampled(result: xr.Dataset) -> int:
    """Return how many of the quantities, the first ones, depend on cells."""
    return int(result.attrs["sampled_quantities"])


def _percent(value: float) -> str:
    return "-" if np.isnan(value) else f"{100 * value:.3f}"


def _signed(value: float, error: float) -> str:
    return "-" if np.isnan(value) else f"{100 * value:+.3f} ± {100 * error:.3f}"


def _number(value: float, error: float) -> str:
    if np.isnan(value):
        return "-"
    return f"{value:.2f}" + ("" if np.isnan(error) else f" ± {error:.2f}")


def _milliseconds(seconds: float) -> str:
    return f"{1e3 * seconds:.3g}"


def _ladder(result: xr.Dataset, name: str, title: str) -> Table:
    rows, sampled, shown = [], _sampled(result), _shown(result)
    for k, rung in enumerate(result[name].values):
        bias, error, noise = (result[f"{name}_{key}"].values[k] for key in ("bias", "bias_error", "noise"))
        cost = _milliseconds(float(result[f"{name}_wall_time"][k]))
        rows.append([str(rung), cost, *map(_signed, bias, error), *map(_percent, noise[:sampled])])
    noisy = [f"noise of {each} [%]" for each in shown[:sampled]]
    headings = [name, "time [ms]", *(f"{each} [%]" for each in shown), *noisy]
    return Table(f"{title} ± its standard error", headings, rows)


def _convergence(result: xr.Dataset) -> Table:
    """Return observed orders, limits and grid convergence indices of the three finest rungs of points."""
    rows = []
    for variant in result["variant"].values:
        one = result.sel(variant=variant)
        for k, (name, shown) in enumerate(zip(result["quantity"].values, _shown(result), strict=True)):
            unit, factor = unit_shown(result[f"points_{name}"].attrs["units"])
            samples = one[f"points_{name}"].values[-3:, :, None]
            grids = samples.mean(axis=1)
            order = observed_order(*grids).item(), jackknife(lambda part: observed_order(*part), samples).item()
            limit, bias = richardson(*grids).item(), float(one["points_bias"][-1, k])
            value, errors = f"{limit * factor:.5g} {unit}", (bias, SAFETY * abs(bias))
            rows.append([variant, shown, _number(*order), value, *map(_percent, errors)])
    headings = ["variant", "quantity", "order", "limit", "bias of finest [%]", f"GCI, Fs = {SAFETY} [%]"]
    return Table("Convergence in dt at {}, {}, {} points".format(*result["points"].values[-3:]), headings, rows)


def _noise(result: xr.Dataset) -> Table:
    rows = []
    for name in ("streamlines", "cells", "snapshots"):
        noise, count = result[f"{name}_noise"].values.T[: _sampled(result)], result.sizes["replicate"]
        rows.append([name, *(_number(*noise_exponent(result[name].values, each, count)) for each in noise)])
    return Table("Exponent of the noise", ["against", *_shown(result)[: _sampled(result)]], rows)


def _combination(result: xr.Dataset, k: int) -> list[str]:
    grid = [str(int(result[f"combination_{axis}"][k])) for axis in ("streamlines", "points", "cells")]
    bias, noise = (result[f"combination_{key}"].values[k, : _sampled(result)] for key in ("bias", "noise"))
    worst, p80 = float(result["combination_worst_error"][k]), float(result["combination_error"][k, 1])
    cost = _milliseconds(float(result["combination_wall_time"][k]))
    return [*grid, cost, *map(_percent, (np.abs(bias).max(), noise.max(), p80, worst))]


def _pareto(result: xr.Dataset) -> Table:
    front = np.flatnonzero(result["combination_on_front"].values)
    order = front[np.argsort(result["combination_wall_time"].values[front])]
    rows = [[str(result["combination_level"].values[k]), *_combination(result, k)] for k in order]
    return Table("Pareto front (worst of P50, P80, below 1 mm)", ["level", *_COMBINATION], rows)


def _choice(result: xr.Dataset) -> Table:
    named = {f"cheapest within {100 * target:g} %": chosen(result, target) for target in TARGETS}
    levels = result["combination_level"].values
    named |= {f"level {levels[k]}": k for k in np.flatnonzero(levels != "")}
    blank = ["-"] * len(_COMBINATION)
    rows = [[name, *(blank if k is None else _combination(result, k))] for name, k in named.items()]
    finest = {
        key: np.abs(result[f"reference_{key}"].values[-1, : _sampled(result)]).max() for key in ("bias", "bias_error")
    }
    title = (
        "Which resolution (worst of P50, P80, below 1 mm; the finest grid of the reference: bias "
        f"{_percent(finest['bias'])} %, standard error {_percent(finest['bias_error'])} %)"
    )
    return Table(title, ["", *_COMBINATION], rows)
