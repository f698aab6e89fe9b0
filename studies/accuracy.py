"""Error against wall time, knob by knob and together: `python -m studies.accuracy`.

Bias and noise are kept apart. Bias is what refinement changes: differences between means over replicates that share
their random numbers. Noise is the standard deviation of one run over replicates. Both are divided by the reference
value of their quantity; percent below 1 mm by at least 1 %, and a reference of 0 by 1, so that a scene in which
little or nothing breaks has errors too.
"""

import os
import platform
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import numpy as np

from hpgr.scene import Scene, levels
from studies import Late
from studies import command as cli
from studies.convergence import ROUNDING, jackknife, richardson, unbeaten

if TYPE_CHECKING:
    import xarray as xr

cost, run, schema = Late("hpgr.cost"), Late("hpgr.run"), Late("hpgr.results.schema")

_SIEVE = 1e-3  # m, of the percent below 1 mm
_LEAST_PERCENT = 1.0  # that errors of the percent below 1 mm are divided by
_FREE = 1e150  # cushioning so weak that it is lost in rounding: n = inf, but marched

QUANTITIES = {  # what errors are measured of: variable of a Dataset, and name in tables
    "p50": ("p50_total", "P50"),
    "p80": ("p80_total", "P80"),
    "below_1mm": ("passing_total", "below 1 mm"),
    "peak_pressure": ("peak_pressure", "peak pressure"),
    "throughput": ("throughput", "throughput"),
}
SAMPLED = 3  # the first of them, which depend on cells


class Plan(NamedTuple):
    """What is run. Where a knob is not the one refined it is held at `held`: (streamlines, points, cells)."""

    held: tuple[int, int, int] = (10, 201, 1000)
    points: tuple[int, ...] = (51, 101, 201, 401, 801, 1601)
    many_cells: int = 20_000  # while points are refined
    streamlines: tuple[int, ...] = (1, 2, 5, 10, 20, 40)
    streamline_cells: int = 5000  # while streamlines are refined
    cells: tuple[int, ...] = (50, 100, 200, 400, 800, 1600, 3200, 6400, 12_800)
    snapshots: tuple[int, ...] = (1, 2, 4, 8, 16, 32)
    snapshot_cells: int = 500
    grid: tuple[tuple[int, ...], ...] = ((2, 5, 10, 20), (100, 200, 400, 800), (500, 2000, 8000, 32_000))
    levels: tuple[str, ...] = ("draft", "standard", "fine")
    reference: tuple[int, int] = (20, 20_000)  # streamlines and cells; its points are the last three of `points`
    replicates: int = 32


FULL = Plan()
QUICK = Plan((2, 51, 100), (26, 51, 101), 400, (1, 2, 4), 100, (25, 50, 100, 200), (1, 2, 4), 50)._replace(
    grid=((2, 4), (26, 51, 101), (50, 200)), levels=("draft",), reference=(4, 500), replicates=8
)


class Ladder(NamedTuple):
    """Scenes to run along the axes (the last one fastest), each with the replicates from `first` on.

    `limit` takes means (rung, quantity) to what their bias is measured from.
    """

    axes: dict[str, list]
    scenes: list[Scene]
    replicates: int
    limit: Callable[[np.ndarray], np.ndarray]
    first: int = 0


@dataclass(frozen=True)
class Options:
    """Options of the study; the scene's own streamlines, points and cells do not matter, the ladders are fixed."""

    scene: cli.SceneName = "paper"
    replicates: Annotated[int | None, cli.shown_as("N")] = None
    """Independent repetitions of every run, at least 2 (default: 32, with --quick 8)."""
    seed: cli.Seed = 0
    quick: cli.Quick = False
    markdown: cli.Flag = False
    """Print every table, as markdown, instead of the short ones."""
    out: cli.Out = Path("outputs/accuracy.nc")
    plot: cli.Plot = True
    overwrite: cli.Overwrite = False


@cli.command("accuracy", __doc__)
def main(options: Options) -> cli.Report:
    """Run the study of the command line."""
    plan = QUICK if options.quick else FULL
    if options.replicates is not None:
        plan = plan._replace(replicates=options.replicates)
    result = study(cli.base_scene(options), plan, options.seed, progress=True)
    from studies.show import accuracy_tables as tables
    from studies.show.plots.accuracy import accuracy_figure

    text = tables.in_words(result, options.markdown)
    return cli.Report(text.splitlines(), [result, cli.figure(lambda: accuracy_figure(result), dpi=150)])


def study(scene: Scene, plan: Plan, seed: int = 0, progress: bool = False) -> "xr.Dataset":
    """Return the errors and wall times of `scene` over every ladder and the grid of `plan`.

    ValueError if the scene has no cells, a single one, or exchange; or there are fewer than 2 replicates.
    """
    _refuse(scene, plan)
    scene = scene.with_values({"resolution.record": "product", "resolution.sieves": [_SIEVE]})
    ladders, found = _ladders(scene, plan), {}
    with cli.progress_bar(sum(len(one.scenes) * one.replicates for one in ladders.values()), progress, "runs") as bar:
        for name, ladder in ladders.items():
            values, seconds = _climb(ladder, seed, bar)
            if name == "reference":  # the first, for the bias of every combination
                reference = ladder.limit(values.mean(axis=1))
            limit = ladder.limit or (lambda means, known=reference: known)
            found |= _variables(name, ladder._replace(limit=limit), values, seconds)
    found |= _front(plan, found)
    values, own = ({name: entry[k] for name, entry in found.items()} for k in (1, 0))
    return schema.to_dataset(values, _attributes(run.load(scene)[0], plan, seed), own)


def _refuse(scene: Scene, plan: Plan) -> None:
    if plan.replicates < 2:
        raise ValueError(f"--replicates: got {plan.replicates}; must be at least 2; noise is the spread of replicates")
    if scene.resolution.cells < 2:
        raise ValueError(
            f"--scene: got resolution.cells {scene.resolution.cells} (0 is stress only, 1 has no neighbours, hence no "
            "cushioning); must be at least 2: the study measures crushing; give the scene cells"
        )
    if scene.exchange is not None:
        raise ValueError(
            "--scene: got a scene with exchange; it must have none: a run of the whole lattice costs hundreds of "
            "times as much, the ladders hours; remove [exchange]"
        )


def _at(scene: Scene, streamlines: int, points: int, cells: int, **values: Any) -> Scene:
    grid = {"streamlines": streamlines, "points": points, "cells": cells} | values
    return scene.with_values({f"resolution.{name}": value for name, value in grid.items()})


def _ladders(scene: Scene, plan: Plan) -> dict[str, Ladder]:
    lines, points, _ = plan.held
    count, few, finest = plan.replicates, max(2, plan.replicates // 4), list(plan.points[-3:])
    changed, solvers = variants(scene), _solvers(_at(scene, *plan.held))
    steps = [_at(other, lines, p, plan.many_cells) for other in changed.values() for p in plan.points]
    grid = [_at(scene, *combination) for combination in combinations(plan)]
    reference = [_at(scene, plan.reference[0], p, plan.reference[1]) for p in finest]

    def limit(means):
        return richardson(*means[-3:])

    def ladder(name, scenes):
        return Ladder({name: list(getattr(plan, name))}, scenes, count, lambda means: means[-1])

    return {
        # replicates that the grid does not have: its errors are then not those of its own random numbers
        "reference": Ladder({"reference_points": finest}, reference, few, limit, first=count),
        "points": Ladder({"variant": list(changed), "points": list(plan.points)}, steps, count, limit),
        "streamlines": ladder("streamlines", [_at(scene, n, points, plan.streamline_cells) for n in plan.streamlines]),
        "cells": ladder("cells", [_at(scene, lines, points, m) for m in plan.cells]),
        "snapshots": ladder(
            "snapshots", [_at(scene, lines, points, plan.snapshot_cells, snapshots=n) for n in plan.snapshots]
        ),
        "solver": Ladder({"solver": list(solvers)}, list(solvers.values()), few, lambda means: means[0]),
        "combination": Ladder({"combination": list(range(len(grid)))}, grid, count, None),
    }


def variants(scene: Scene) -> dict[str, Scene]:
    """Return the scenes whose points are refined, by what is changed in them."""
    other = "euler" if scene.elasticity.integrator == "increment" else "increment"
    found = {"scene": scene, "n = 0.5": scene.with_values({"strength.cushioning": 0.5})}
    if found["n = 0.5"] == scene:
        del found["n = 0.5"]
    return found | {other: scene.with_values({"elasticity.integrator": other})}


def combinations(plan: Plan) -> list[tuple[int, int, int]]:
    """Return the (streamlines, points, cells) of the work-precision grid, those of the levels included."""
    grid = [(n, p, m) for n in plan.grid[0] for p in plan.grid[1] for m in plan.grid[2]]
    return list(dict.fromkeys([*grid, *map(_grid_of, plan.levels)]))


def _grid_of(level: str) -> tuple[int, ...]:
    return tuple(levels()[level].values().values())


def _solvers(scene: Scene) -> dict[str, Scene]:
    """Return the scene without cushioning by solver; the closed form needs a finite Weibull modulus."""
    marched = scene.with_values({"strength.cushioning": _FREE, "resolution.control_variate": False})
    still = marched.with_values({"exchange": {"segregation": 0.0, "mixing": 0.0}})
    closed = {"closed form": scene.with_values({"strength.cushioning": "inf"})}
    return (closed if np.isfinite(scene.strength.weibull_modulus) else {}) | {"march": marched, "lattice": still}


def _climb(ladder: Ladder, seed: int, bar: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return quantities (rung, replicate, quantity) and wall times; what compiles is run once before."""
    small = _at(ladder.scenes[0], 1, 5, 2).with_values({"rolls.specific_pressing_force": None})
    _run(small, seed, 0)  # at the gap given: so few points may carry no force
    runs = []
    for scene in ladder.scenes:
        for replicate in range(ladder.first, ladder.first + ladder.replicates):
            runs.append(_run(scene, seed, replicate))
            bar.update()
    values, seconds = (np.array(part) for part in zip(*runs, strict=True))
    shape = (len(ladder.scenes), ladder.replicates)
    return values.reshape(*shape, -1), seconds.reshape(shape)


def _run(scene: Scene, seed: int, replicate: int) -> tuple[list[float], float]:
    """Return the quantities of one run, unrounded by a Dataset, and its wall time in s."""
    cost.refuse_too_large(scene)
    begun = time.perf_counter()
    values = run.run_scene(scene, seed, replicate).values
    seconds = time.perf_counter() - begun
    values |= {"passing_total": 100 * values["passing_total"][0]}
    return [float(values[variable]) for variable, _ in QUANTITIES.values()], seconds


def _variables(name: str, ladder: Ladder, values: np.ndarray, seconds: np.ndarray) -> dict[str, tuple]:
    """Return table entry and values of samples, wall time, bias and noise of a ladder, and of its axes."""
    entry = partial(schema.Variable, dtype=None)
    dims, shape = tuple(ladder.axes), tuple(map(len, ladder.axes.values()))
    replicate = "few_replicates" if name in ("solver", "reference") else "replicate"
    found: dict[str, tuple] = {}
    for axis, rungs in ladder.axes.items():
        found[axis] = entry((axis,), "" if isinstance(rungs[0], str) else "1", axis.replace("_", " ")), rungs
    for k, (quantity, (variable, shown)) in enumerate(QUANTITIES.items()):
        unit = "percent" if quantity == "below_1mm" else schema.VARIABLES[variable].units
        own = entry((*dims, replicate), unit, f"{shown}, over {name}")
        found[f"{name}_{quantity}"] = own, values[..., k].reshape(*shape, -1)
    errors = []
    for row in values.reshape(-1, shape[-1], *values.shape[1:]):
        means = row.mean(axis=1)
        away, scale = means - ladder.limit(means), _scales(ladder.limit(means))
        noise = row.std(axis=1, ddof=1) / scale
        error = jackknife(lambda part: part - ladder.limit(part), row) / scale
        errors.append((away / scale, error, np.where(noise > ROUNDING, noise, 0.0)))
    words = {"bias": "bias", "bias_error": "standard error of the bias", "noise": "standard deviation of one run"}
    for (key, what), each in zip(words.items(), zip(*errors, strict=True), strict=True):
        own = entry((*dims, "quantity"), "1", f"{what}, relative, over {name}")
        found[f"{name}_{key}"] = own, np.reshape(each, (*shape, len(QUANTITIES)))
    own = entry(dims, "s", f"median wall time of a run, over {name}")
    return found | {f"{name}_wall_time": (own, np.median(seconds, axis=-1).reshape(shape))}


def _scales(values: np.ndarray) -> np.ndarray:
    """Return what errors of the quantities (..., quantity) are divided by."""
    least = [_LEAST_PERCENT if name == "below_1mm" else 0.0 for name in QUANTITIES]
    size = np.maximum(np.abs(values), least)
    return np.where(size > 0, size, 1.0)


def _front(plan: Plan, found: dict[str, tuple]) -> dict[str, tuple]:
    """Return the work-precision grid: streamlines, points, cells and level, errors, and the Pareto front."""
    entry, rows = partial(schema.Variable, ("combination",), "1", dtype=None), combinations(plan)
    names, axes = {_grid_of(name): name for name in plan.levels}, ("streamlines", "points", "cells")
    error = np.abs(found["combination_bias"][1]) + 2 * found["combination_noise"][1]
    worst = error[:, :SAMPLED].max(axis=1)
    front = unbeaten(-found["combination_wall_time"][1], -worst).astype(np.int8)
    words = "largest error of P50, P80 and percent below 1 mm: |bias| + 2 standard errors, relative"
    return {
        **{f"combination_{axis}": (entry(axis), column) for axis, column in zip(axes, np.array(rows).T, strict=True)},
        "quantity": (schema.Variable(("quantity",), "", "quantity an error is of", dtype=None), list(QUANTITIES)),
        "combination_level": (entry("named level, if any")._replace(units=""), [names.get(row, "") for row in rows]),
        "combination_worst_error": (entry(words), worst),
        "combination_on_front": (entry("whether no other is as cheap and as accurate"), front),
    }


def _attributes(scene: Scene, plan: Plan, seed: int) -> dict[str, Any]:
    return schema.dataset_attributes(
        "Accuracy against cost of comminution in high pressure grinding rolls",
        scene=scene.model_dump_json(),
        seed=seed,
        replicates=plan.replicates,
        sampled_quantities=SAMPLED,
        held="streamlines {}, points {}, cells {}".format(*plan.held),
        plan=str(plan),
        scale=f"errors are relative to the reference; below 1 mm to at least {_LEAST_PERCENT:g} %; 0 counts as 1",
        wall_time="bed, crushing and summary of one run, large ones on all cores; hpgr.simulate adds its Dataset",
        machine=f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}",
    )


if __name__ == "__main__":
    raise SystemExit(main())
