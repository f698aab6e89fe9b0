"""Tables of `studies.accuracy`, those of docs/accuracy.md."""

import numpy as np
import xarray as xr

from hpgr.fields import unit_shown
from studies.convergence import SAFETY, jackknife, observed_order, richardson
from studies.show.report import aligned


def in_words(result: xr.Dataset, markdown: bool) -> str:
    """Return the tables for a terminal, convergence in dt and which resolution to take; or all, as markdown."""
    found = [_convergence(result), _choice(result)]
    if markdown:
        points = [
            _ladder(result.sel(variant=name), "points", f"Points, scene{'' if name == 'scene' else f' with {name}'}")
            for name in result["variant"].values
        ]
        others = [_ladder(result, name, name.capitalize()) for name in ("streamlines", "cells", "snapshots")]
        solvers = _ladder(result, "solver", "Solvers without cushioning, bias from the first")
        found = [*points, found[0], *others, solvers, found[1]]
    title = "**{}**\n\n{}" if markdown else "{}\n{}"
    return "\n\n".join(title.format(name, aligned(*table, markdown, words=1)) for name, table in found)


def _shown(result: xr.Dataset) -> list[str]:
    return [result[f"points_{name}"].attrs["long_name"].partition(",")[0] for name in result["quantity"].values]


def _percent(value: float) -> str:
    return "-" if np.isnan(value) else f"{100 * value:.3f}"


def _signed(value: float, error: float) -> str:
    return f"{100 * value:+.3f} ± {100 * error:.3f}"


def _ladder(result: xr.Dataset, name: str, title: str):
    rows, shown, sampled = [], _shown(result), result.attrs["sampled_quantities"]
    for k, rung in enumerate(result[name].values):
        bias, error, noise = (result[f"{name}_{key}"].values[k] for key in ("bias", "bias_error", "noise"))
        cost = f"{1e3 * float(result[f'{name}_wall_time'][k]):.3g}"
        rows.append([str(rung), cost, *map(_signed, bias, error), *map(_percent, noise[:sampled])])
    noisy = [f"noise of {each} [%]" for each in shown[:sampled]]
    return f"{title}: bias ± its standard error", (
        [name, "time [ms]", *(f"{each} [%]" for each in shown), *noisy],
        rows,
    )


def _convergence(result: xr.Dataset):
    """Return observed orders, limits and grid convergence indices of the three finest rungs of points."""
    rows = []
    for variant in result["variant"].values:
        one = result.sel(variant=variant)
        for k, (name, shown) in enumerate(zip(result["quantity"].values, _shown(result), strict=True)):
            samples = one[f"points_{name}"].values[-3:, :, None]
            grids, (unit, factor) = samples.mean(axis=1), unit_shown(one[f"points_{name}"].attrs["units"])
            order, error = observed_order(*grids).item(), jackknife(lambda part: observed_order(*part), samples).item()
            seen = "-" if np.isnan(order) else f"{order:.2f}" + ("" if np.isnan(error) else f" ± {error:.2f}")
            limit, bias = richardson(*grids).item(), float(one["points_bias"][-1, k])
            errors = map(_percent, (bias, SAFETY * abs(bias)))
            rows.append([variant, shown, seen, f"{limit * factor:.5g} {unit}", *errors])
    headings = ["variant", "quantity", "order", "limit", "bias of finest [%]", f"GCI, Fs = {SAFETY} [%]"]
    return "Convergence in dt at {}, {}, {} points".format(*result["points"].values[-3:]), (headings, rows)


def _choice(result: xr.Dataset):
    """Return the combinations on the Pareto front, and the named levels."""
    level, seconds = result["combination_level"].values, result["combination_wall_time"].values
    chosen = np.flatnonzero((result["combination_on_front"].values == 1) | (level != ""))
    sampled, rows = result.attrs["sampled_quantities"], []
    for k in chosen[np.argsort(seconds[chosen])]:
        grid = [str(int(result[f"combination_{axis}"][k])) for axis in ("streamlines", "points", "cells")]
        bias, noise = (np.abs(result[f"combination_{key}"].values[k, :sampled]).max() for key in ("bias", "noise"))
        errors = map(_percent, (bias, noise, float(result["combination_worst_error"][k])))
        rows.append([level[k], *grid, f"{1e3 * seconds[k]:.3g}", *errors])
    finest = [np.abs(result[f"reference_{key}"].values[-1, :sampled]).max() for key in ("bias", "bias_error")]
    title = (
        "Cheapest resolution for an error, and levels (worst of P50, P80, below 1 mm; "
        "the reference's finest grid: bias {} %, standard error {} %)"
    ).format(*map(_percent, finest))
    return title, (["level", "N", "P", "M", "time [ms]", "bias [%]", "noise [%]", "error [%]"], rows)
