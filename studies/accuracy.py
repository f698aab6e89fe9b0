"""Error against wall time, knob by knob and together: `python -m studies.accuracy`.

Bias and noise are kept apart. Bias is what refinement changes: differences between means over replicates that share
their random numbers. Noise is the standard deviation of one run over replicates. Both are divided by the reference
value of their quantity; percent below 1 mm by at least 1 %, and a reference of 0 by 1, so that a scene in which
little or nothing breaks has errors too.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import numpy as np
import tyro

from hpgr.scene import Scene, levels
from studies.command import (
    Out,
    Overwrite,
    Plot,
    Quick,
    Report,
    SceneName,
    Seed,
    base_scene,
    command,
    figure,
    progress_bar,
    shown_as,
)
from studies.convergence import ORDERS, ROUNDING, SAFETY, jackknife, pareto, richardson

if TYPE_CHECKING:
    import xarray as xr

_SIEVE = 1e-3  # m, of the percent below 1 mm
_LEAST_PERCENT = 1.0  # that errors of the percent below 1 mm are divided by
_FREE = 1e150  # cushioning so weak that it is lost in rounding: n = inf, but marched
_GOLDEN = np.uint64(0x9E3779B97F4A7C15)  # step of a SplitMix64 stream


class Quantity(NamedTuple):
    """What errors are measured of: its variable in the Dataset, and its name in tables."""

    variable: str
    shown: str


QUANTITIES = {
    "p50": Quantity("p50_total", "P50"),
    "p80": Quantity("p80_total", "P80"),
    "below_1mm": Quantity("passing_total", "below 1 mm"),
    "peak_pressure": Quantity("peak_pressure", "peak pressure"),
    "throughput": Quantity("throughput", "throughput"),
}
SAMPLED = 3  # the first of them, which depend on cells


class Plan(NamedTuple):
    """What is run. Where a knob is not the one refined it is held at `held`: (streamlines, points, cells)."""

    held: tuple[int, int, int]
    points: tuple[int, ...]
    many_cells: int  # while points are refined
    streamlines: tuple[int, ...]
    streamline_cells: int  # while streamlines are refined
    cells: tuple[int, ...]
    snapshots: tuple[int, ...]
    snapshot_cells: int
    grid: tuple[tuple[int, ...], tuple[int, ...], tuple[int, ...]]
    levels: tuple[str, ...]
    reference: tuple[int, int]  # streamlines and cells; its points are the last three of `points`
    replicates: int


FULL = Plan(
    held=(10, 201, 1000),
    points=(51, 101, 201, 401, 801, 1601),
    many_cells=20_000,
    streamlines=(1, 2, 5, 10, 20, 40),
    streamline_cells=5000,
    cells=(50, 100, 200, 400, 800, 1600, 3200, 6400, 12_800),
    snapshots=(1, 2, 4, 8, 16, 32),
    snapshot_cells=500,
    grid=((2, 5, 10, 20), (100, 200, 400, 800), (500, 2000, 8000, 32_000)),
    levels=("draft", "standard", "fine"),
    reference=(20, 20_000),
    replicates=32,
)
QUICK = Plan(
    held=(2, 51, 100),
    points=(26, 51, 101),
    many_cells=400,
    streamlines=(1, 2, 4),
    streamline_cells=100,
    cells=(25, 50, 100, 200),
    snapshots=(1, 2, 4),
    snapshot_cells=50,
    grid=((2, 4), (26, 51, 101), (50, 200)),
    levels=("draft",),
    reference=(4, 500),
    replicates=8,
)


class Ladder(NamedTuple):
    """Scenes to run along the axes (the last one fastest), each with the replicates from `first` on.

    `limit` takes means (rung, quantity) to what their bias is measured from; without it that is the reference.
    """

    axes: dict[str, list]
    scenes: list[Scene]
    replicates: int
    limit: Callable[[np.ndarray], np.ndarray] | None
    first: int = 0


class Samples(NamedTuple):
    """Quantities (rung, replicate, quantity) of a ladder and their wall times in s (rung, replicate)."""

    values: np.ndarray
    seconds: np.ndarray


@dataclass(frozen=True)
class Options:
    """Options of the study; the scene's own streamlines, points and cells do not matter, the ladders are fixed."""

    scene: SceneName = "paper"
    replicates: Annotated[int | None, shown_as("N")] = None
    """Independent repetitions of every run, at least 2 (default: 32, with --quick 8)."""
    seed: Seed = 0
    quick: Quick = False
    markdown: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print every table, as markdown, instead of the short ones."""
    out: Out = Path("outputs/accuracy.nc")
    plot: Plot = True
    overwrite: Overwrite = False


@command("accuracy", __doc__)
def main(options: Options) -> Report:
    """Run the study of the command line."""
    plan = QUICK if options.quick else FULL
    if options.replicates is not None:
        plan = plan._replace(replicates=options.replicates)
    result = study(base_scene(options.scene), plan, options.seed, progress=True)
    from studies.show import accuracy_tables as tables
    from studies.show.plots.accuracy import accuracy_figure

    chosen = tables.every(result) if options.markdown else tables.short(result)
    lines = tables.in_words(chosen, options.markdown).splitlines()
    return Report(lines, [result, figure(lambda: accuracy_figure(result), dpi=150)])


def study(scene: Scene, plan: Plan, seed: int = 0, progress: bool = False) -> "xr.Dataset":
    """Return the errors and wall times of `scene` over every ladder and the grid of `plan`.

    Raises
    ------
    ValueError
        If the scene has no cells, a single one, or exchange; or there are fewer than 2 replicates.
    """
    from hpgr import run
    from hpgr.results import schema

    _refuse(scene, plan)
    scene = scene.with_values({"resolution.record": "product", "resolution.sieves": [_SIEVE]})
    ladders = _ladders(scene, plan)
    with progress_bar(sum(len(one.scenes) * one.replicates for one in ladders.values()), progress, "runs") as bar:
        samples = {name: _climb(ladder, seed, bar) for name, ladder in ladders.items()}
    ladders["storage"] = Ladder({"storage": ["float32", "float64"]}, [], plan.replicates, _last)
    samples["storage"] = _store(_at(scene, *plan.held), seed, plan.replicates)
    reference, found = _limit(samples["reference"].values.mean(axis=1)), {}
    for name, ladder in ladders.items():
        found |= _variables(name, ladder, samples[name], reference, plan.replicates)
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


def _limit(means: np.ndarray) -> np.ndarray:
    return richardson(*means[-3:])


def _first(means: np.ndarray) -> np.ndarray:
    return means[0]


def _last(means: np.ndarray) -> np.ndarray:
    return means[-1]


def _at(scene: Scene, streamlines: int, points: int, cells: int, **values: Any) -> Scene:
    grid = {"streamlines": streamlines, "points": points, "cells": cells} | values
    return scene.with_values({f"resolution.{name}": value for name, value in grid.items()})


def _ladders(scene: Scene, plan: Plan) -> dict[str, Ladder]:
    """Return every ladder by name."""
    lines, points, _ = plan.held
    count, few = plan.replicates, max(2, plan.replicates // 4)
    changed, solvers, finest = variants(scene), _solvers(_at(scene, *plan.held)), list(plan.points[-3:])
    steps = [_at(other, lines, p, plan.many_cells) for other in changed.values() for p in plan.points]
    across = [_at(scene, n, points, plan.streamline_cells) for n in plan.streamlines]
    counts = [_at(scene, lines, points, m) for m in plan.cells]
    shots = [_at(scene, lines, points, plan.snapshot_cells, snapshots=n) for n in plan.snapshots]
    grid = [_at(scene, *combination) for combination in combinations(plan)]
    reference = [_at(scene, plan.reference[0], p, plan.reference[1]) for p in finest]
    return {
        "points": Ladder({"variant": list(changed), "points": list(plan.points)}, steps, count, _limit),
        "streamlines": Ladder({"streamlines": list(plan.streamlines)}, across, count, _last),
        "cells": Ladder({"cells": list(plan.cells)}, counts, count, _last),
        "snapshots": Ladder({"snapshots": list(plan.snapshots)}, shots, count, _last),
        "solver": Ladder({"solver": list(solvers)}, list(solvers.values()), few, _first),
        "combination": Ladder({"combination": list(range(len(grid)))}, grid, count, None),
        # replicates that the grid does not have: its errors are then not those of its own random numbers
        "reference": Ladder({"reference_points": finest}, reference, few, _limit, first=count),
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
    marched = scene.with_values({"strength.cushioning": _FREE})
    still = marched.with_values({"exchange": {"segregation": 0.0, "mixing": 0.0}})
    closed = {"closed form": scene.with_values({"strength.cushioning": "inf"})}
    return (closed if np.isfinite(scene.strength.weibull_modulus) else {}) | {"march": marched, "lattice": still}


def _climb(ladder: Ladder, seed: int, bar: Any) -> Samples:
    """Run every rung of a ladder, one run after the other; what compiles is run once before."""
    small = _at(ladder.scenes[0], 1, 5, 2).with_values({"rolls.specific_pressing_force": None})
    _run(small, seed, 0)  # at the gap given: so few points may carry no force
    runs = []
    for scene in ladder.scenes:
        for replicate in range(ladder.first, ladder.first + ladder.replicates):
            runs.append(_run(scene, seed, replicate))
            bar.update()
    shape = (len(ladder.scenes), ladder.replicates)
    values, seconds = zip(*runs, strict=True)
    return Samples(np.array(values).reshape(*shape, -1), np.array(seconds).reshape(shape))


def _run(scene: Scene, seed: int, replicate: int) -> tuple[list[float], float]:
    """Return the quantities of one run, unrounded by a Dataset, and its wall time in s."""
    from hpgr import cost, run

    cost.refuse_too_large(scene)
    begun = time.perf_counter()
    values = run.run_scene(scene, seed, replicate).values
    seconds = time.perf_counter() - begun
    values |= {"passing_total": 100 * values["passing_total"][0]}
    return [float(values[quantity.variable]) for quantity in QUANTITIES.values()], seconds


def _store(scene: Scene, seed: int, replicates: int) -> Samples:
    """Crush the same feed with cells stored as float32 and as float64, in plain NumPy."""
    from hpgr import run
    from hpgr.grains import march, solve

    scene, bed = run.load(scene)
    log_stress = scene.strength.log_stress(solve.crushing_stress(scene, bed))
    values, seconds = np.full((2, replicates, len(QUANTITIES)), np.nan), np.empty((2, replicates))
    for k, replicate in np.ndindex(seconds.shape):
        begun = time.perf_counter()
        keys = [(replicate, line, 0) for line in range(len(log_stress))]
        sizes, streams = (part[:, 1:-1].copy() for part in march.first_cells(scene, seed, keys))
        sizes = sizes.astype((np.float32, np.float64)[k])
        for line, stress in enumerate(log_stress):
            plain_march(scene, sizes[line], streams[line], stress)
        percent = 100 * (sizes <= np.float64(np.float32(_SIEVE))).mean()
        values[k, replicate, :SAMPLED] = [*np.quantile(sizes, (0.5, 0.8)), percent]
        seconds[k, replicate] = time.perf_counter() - begun
    return Samples(values, seconds)


def plain_march(scene: Scene, sizes: np.ndarray, streams: np.ndarray, log_stress: np.ndarray) -> None:
    """Crush one line of cells along a streamline in plain NumPy, sizes stored as their array stores them.

    The rule of the compiled march, for storage in another precision than its float32; in float32 it gives the
    march's sizes. `sizes` and `streams` are updated.
    """
    from hpgr.grains import kernels

    mix = getattr(kernels.mix, "py_func", kernels.mix)  # the Python function takes arrays as well
    fragments = scene.fragments
    for stress in log_stress[np.isfinite(log_stress)]:
        wide = sizes.astype(float)
        hit = (stress >= scene.strength.log_strength(wide)) & (wide >= fragments.size_floor)
        streams[hit] += _GOLDEN
        uniform = ((mix(streams[hit]) >> np.uint64(12)).astype(float) + 0.5) * 2.0**-52
        sizes[hit] = np.maximum(wide[hit] * uniform ** (1 / fragments.exponent), kernels.SMALLEST)


def _variables(name: str, ladder: Ladder, samples: Samples, reference: np.ndarray, count: int) -> dict[str, tuple]:
    """Return the table entry and the values of samples, wall time, bias and noise of a ladder, and of its axes."""
    from hpgr.results.schema import VARIABLES, Variable

    dims, shape = tuple(ladder.axes), tuple(map(len, ladder.axes.values()))
    # only ladders of as many replicates share a dimension
    replicate = "replicate" if ladder.replicates == count else f"{name}_replicate"
    found: dict[str, tuple] = {}
    for axis, rungs in ladder.axes.items():
        units = "" if isinstance(rungs[0], str) else "1"
        found[axis] = Variable((axis,), units, axis.replace("_", " "), dtype=None), rungs
    for k, (quantity, entry) in enumerate(QUANTITIES.items()):
        units = "percent" if quantity == "below_1mm" else VARIABLES[entry.variable].units
        own = Variable((*dims, replicate), units, f"{entry.shown}, over {name}", dtype=None)
        found[f"{name}_{quantity}"] = own, samples.values[..., k].reshape(*shape, -1)
    errors = []
    limit = ladder.limit or (lambda means: reference)
    for row in samples.values.reshape(-1, shape[-1], *samples.values.shape[1:]):
        means = row.mean(axis=1)
        scale, away = _scales(limit(means)), jackknife(lambda part: part - limit(part), row)
        errors.append(((means - limit(means)) / scale, away / scale, _noise(row, scale)))
    words = {
        "bias": "bias, relative",
        "bias_error": "standard error of the bias, relative",
        "noise": "standard deviation of one run over replicates, relative",
    }
    for (key, what), each in zip(words.items(), zip(*errors, strict=True), strict=True):
        own = Variable((*dims, "quantity"), "1", f"{what}, over {name}", dtype=None)
        found[f"{name}_{key}"] = own, np.reshape(each, (*shape, len(QUANTITIES)))
    own = Variable(dims, "s", f"median wall time of a run, over {name}", dtype=None)
    found[f"{name}_wall_time"] = own, np.median(samples.seconds, axis=-1).reshape(shape)
    return found


def _scales(values: np.ndarray) -> np.ndarray:
    """Return what errors of the quantities (..., quantity) are divided by."""
    least = [_LEAST_PERCENT if name == "below_1mm" else 0.0 for name in QUANTITIES]
    size = np.maximum(np.abs(values), least)
    return np.where(size > 0, size, 1.0)


def _noise(samples: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Return the relative standard deviation over replicates of (..., replicate, quantity); rounding is none."""
    found = samples.std(axis=-2, ddof=1) / scale
    return np.where(found > ROUNDING, found, 0.0)


def _front(plan: Plan, found: dict[str, tuple]) -> dict[str, tuple]:
    """Return the work-precision grid: streamlines, points, cells and level, errors, and the Pareto front."""
    from functools import partial

    from hpgr.results.schema import Variable

    entry, rows = partial(Variable, ("combination",), "1", dtype=None), combinations(plan)
    axes = zip(("streamlines", "points", "cells"), np.array(rows, np.int32).T, strict=True)
    grid = {f"combination_{axis}": (entry(f"{axis} of the combination"), column) for axis, column in axes}
    names = {_grid_of(name): name for name in plan.levels}
    error = np.abs(found["combination_bias"][1]) + 2 * found["combination_noise"][1]
    worst = error[:, :SAMPLED].max(axis=1)
    front = pareto(found["combination_wall_time"][1], worst).astype(np.int8)
    words = "largest error of P50, P80 and percent below 1 mm, relative"
    return grid | {
        "quantity": (Variable(("quantity",), "", "quantity an error is of", dtype=None), list(QUANTITIES)),
        "combination_level": (entry("named level, if any")._replace(units=""), [names.get(row, "") for row in rows]),
        "combination_error": (
            entry("|bias| + 2 standard errors of one run, relative")._replace(dims=("combination", "quantity")),
            error,
        ),
        "combination_worst_error": (entry(words), worst),
        "combination_on_front": (entry("whether no other combination is as cheap and as accurate"), front),
    }


def _attributes(scene: Scene, plan: Plan, seed: int) -> dict[str, Any]:
    import os
    import platform

    from hpgr.results import schema

    points = ", ".join(map(str, plan.points[-3:]))
    return schema.dataset_attributes(
        "Accuracy against cost of comminution in high pressure grinding rolls",
        scene=scene.model_dump_json(),
        seed=seed,
        replicates=plan.replicates,
        sampled_quantities=SAMPLED,
        held="streamlines {}, points {}, cells {}".format(*plan.held),
        cells_while_refined=f"points {plan.many_cells}, streamlines {plan.streamline_cells}, "
        f"snapshots {plan.snapshot_cells}",
        reference_grid="streamlines {}, cells {}, points ".format(*plan.reference)
        + f"{points}, extrapolated; replicates {plan.replicates} on",
        safety_factor=SAFETY,
        orders_held_within=list(ORDERS),
        scale=f"errors are relative to the reference; below 1 mm to at least {_LEAST_PERCENT:g} %; 0 counts as 1",
        wall_time="bed, crushing and summary of one run, large ones on all cores; hpgr.simulate adds its Dataset",
        machine=f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}",
    )


if __name__ == "__main__":
    raise SystemExit(main())
