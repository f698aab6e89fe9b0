"""Error against wall time, knob by knob and together: `python -m studies.accuracy`.

Bias and noise are kept apart. Bias is what refinement changes: differences between means over replicates that share
their random numbers. Noise is the standard deviation of one run over replicates. Both are divided by the reference
value of their quantity; percent below 1 mm by at least 1 %, and a reference of 0 by 1, so that a scene in which
little or nothing breaks has errors too.
"""

import time
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
from studies.convergence import (
    ORDERS,
    ROUNDING,
    SAFETY,
    convergence_index,
    jackknife,
    noise_exponent,
    observed_order,
    pareto,
    richardson,
)

if TYPE_CHECKING:
    import xarray as xr

_SIEVE = 1e-3  # m, of the percent below 1 mm
_LEAST_PERCENT = 1.0  # that errors of the percent below 1 mm are divided by
_FREE = 1e150  # cushioning so weak that it is lost in rounding: n = inf, but marched
_LATTICE_REPLICATES = 2  # a run of the lattice takes seconds
_GOLDEN = np.uint64(0x9E3779B97F4A7C15)  # step of a SplitMix64 stream


class Quantity(NamedTuple):
    """What errors are measured of: its variable in the Dataset, its name and unit in tables, and their factor."""

    variable: str
    shown: str
    unit: str
    factor: float


QUANTITIES = {
    "p50": Quantity("p50_total", "P50", "mm", 1e3),
    "p80": Quantity("p80_total", "P80", "mm", 1e3),
    "below_1mm": Quantity("passing_total", "below 1 mm", "%", 1.0),
    "peak_pressure": Quantity("peak_pressure", "peak pressure", "MPa", 1e-6),
    "throughput": Quantity("throughput", "throughput", "t/h", 3.6),
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
_AXES = {
    "points": "material points on a streamline",
    "streamlines": "streamlines from the mid-plane to the roll",
    "cells": "cells of a material point",
    "snapshots": "snapshots of the steady machine",
}


class Ladder(NamedTuple):
    """Scenes to run, each with the replicates from `first` on."""

    scenes: list[Scene]
    replicates: int
    first: int = 0


class Samples(NamedTuple):
    """Quantities (..., rung, replicate, quantity) and wall times in s (..., rung, replicate) of ladders."""

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

    _refuse(scene, plan)
    scene = scene.with_values({"resolution.record": "product", "resolution.sieves": [_SIEVE]})
    ladders = _ladders(scene, plan)
    total = sum(len(ladder.scenes) * ladder.replicates for ladder in ladders.values())
    with progress_bar(total, progress, "runs") as bar:
        samples = {name: _climb(ladder, seed, bar) for name, ladder in ladders.items()}
        stored = _storage(_at(scene, *plan.held), seed, plan.replicates)
    return _dataset(run.load(scene)[0], plan, seed, samples, stored)


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
    """Return every ladder by name; of those over points and of those of solvers the name is "points: <variant>"."""
    (lines, points, cells), count = plan.held, plan.replicates
    found = {
        f"points: {name}": [_at(other, lines, p, plan.many_cells) for p in plan.points]
        for name, other in variants(scene).items()
    }
    found["streamlines"] = [_at(scene, n, points, plan.streamline_cells) for n in plan.streamlines]
    found["cells"] = [_at(scene, lines, points, m) for m in plan.cells]
    found["snapshots"] = [_at(scene, lines, points, plan.snapshot_cells, snapshots=n) for n in plan.snapshots]
    found["combination"] = [_at(scene, *combination) for combination in combinations(plan)]
    ladders = {name: Ladder(scenes, count) for name, scenes in found.items()}
    for name, other in _solvers(_at(scene, *plan.held)).items():
        ladders[f"solver: {name}"] = Ladder([other], _LATTICE_REPLICATES if name == "lattice" else count)
    lines, cells = plan.reference
    # replicates that the grid does not have: its errors are then not those of its own random numbers
    reference = [_at(scene, lines, p, cells) for p in plan.points[-3:]]
    return ladders | {"reference": Ladder(reference, max(2, count // 4), first=count)}


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


def _storage(scene: Scene, seed: int, replicates: int) -> dict[str, np.ndarray]:
    """Return what storing cells as float64 instead of float32 changes, by replicate; the feed is the same.

    `difference` (replicate, quantity) is relative; `cells_apart` the fraction of cells that end more than rounding
    apart, as a decision fell the other way.
    """
    from hpgr import run
    from hpgr.grains import march, solve

    scene, bed = run.load(scene)
    log_stress = scene.strength.log_stress(solve.crushing_stress(scene, bed))
    products = np.empty((2, replicates, len(log_stress), scene.resolution.cells))
    for k, dtype in enumerate((np.float32, np.float64)):
        for replicate, line in np.ndindex(products.shape[1:3]):
            sizes, streams = (part[0, 1:-1] for part in march.first_cells(scene, seed, [(replicate, line, 0)]))
            sizes = sizes.astype(dtype)
            plain_march(scene, sizes, streams, log_stress[line])
            products[k, replicate, line] = sizes
    p50, p80 = np.quantile(products, (0.5, 0.8), axis=(2, 3))
    below = 100 * (products <= np.float64(np.float32(_SIEVE))).mean(axis=(2, 3))
    single, double = np.stack([p50, p80, below], axis=-1)
    apart = np.abs(products[0] - products[1]) > 1e-4 * products[1]
    return {
        "difference": (single - double) / np.maximum(double, [0, 0, _LEAST_PERCENT]),
        "cells_apart": apart.mean(axis=(1, 2)),
    }


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


def _limit(means: np.ndarray) -> np.ndarray:
    return richardson(*means[-3:])


def _last(means: np.ndarray) -> np.ndarray:
    return means[-1]


def _scales(values: np.ndarray) -> np.ndarray:
    """Return what errors of the quantities (..., quantity) are divided by."""
    least = [_LEAST_PERCENT if name == "below_1mm" else 0.0 for name in QUANTITIES]
    size = np.maximum(np.abs(values), least)
    return np.where(size > 0, size, 1.0)


def _noise(samples: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Return the relative standard deviation over replicates of (..., replicate, quantity); rounding is none."""
    found = samples.std(axis=-2, ddof=1) / scale
    return np.where(found > ROUNDING, found, 0.0)


class _Sheet:
    """The study's variables by name, each with its dims, unit and words."""

    def __init__(self):
        self.values: dict[str, Any] = {}
        self.own: dict[str, Any] = {}

    def put(self, name: str, dims: tuple[str, ...], values: Any, long_name: str, units: str = "1") -> None:
        from hpgr.results.schema import Variable

        self.values[name], self.own[name] = values, Variable(dims, units, long_name, dtype=None)

    def put_each(self, name: str, dims: tuple[str, ...], values: np.ndarray, words: str) -> None:
        """Put values (..., quantity) in the unit of each quantity, under `name`_<quantity>."""
        from hpgr.results.schema import VARIABLES

        for k, (quantity, entry) in enumerate(QUANTITIES.items()):
            units = "percent" if quantity == "below_1mm" else VARIABLES[entry.variable].units
            self.put(f"{name}_{quantity}", dims, values[..., k], f"{entry.shown}, {words}", units)


def _dataset(scene: Scene, plan: Plan, seed: int, samples: dict[str, Samples], stored) -> "xr.Dataset":
    """Return everything measured, and what follows from it, labelled."""
    from hpgr.results import schema

    sheet, limit = _Sheet(), _limit(samples["reference"].values.mean(axis=1))
    by = {
        kind: {name.removeprefix(f"{kind}: "): one for name, one in samples.items() if name.startswith(f"{kind}: ")}
        for kind in ("points", "solver")
    }
    sheet.put("quantity", ("quantity",), list(QUANTITIES), "quantity an error is of", "")
    sheet.put("variant", ("variant",), list(by["points"]), "scene as it is, or with one value changed", "")
    sheet.put("solver", ("solver",), list(by["solver"]), "solver of the scene without cushioning", "")
    for name, what in _AXES.items():
        sheet.put(name, (name,), np.array(getattr(plan, name), np.int32), what)
    points = Samples(*(np.stack(part) for part in zip(*by["points"].values(), strict=True)))
    _put_ladder(sheet, "points", ("variant", "points"), points, _limit)
    for name in ("streamlines", "cells", "snapshots"):
        _put_ladder(sheet, name, (name,), samples[name], _last)
        noises = sheet.values[f"{name}_noise"].T
        exponents = [noise_exponent(getattr(plan, name), one, plan.replicates) for one in noises]
        for ending, column in zip(("", "_error"), np.transpose(exponents), strict=True):
            words = f"{'standard error of the ' if ending else ''}exponent of noise against {name}"
            sheet.put(f"{name}_noise_exponent{ending}", ("quantity",), column, words)
    _put_convergence(sheet, points.values)
    _put_solvers(sheet, list(by["solver"].values()))
    _put_storage(sheet, stored)
    _put_reference(sheet, samples["reference"].values, limit)
    _put_combinations(sheet, plan, samples["combination"], limit)
    return schema.to_dataset(sheet.values, _attributes(scene, plan, seed), sheet.own)


def _put_ladder(sheet: _Sheet, name: str, dims: tuple[str, ...], samples: Samples, limit) -> None:
    """Put samples, wall time, bias and noise; bias is measured from `limit` of the means."""
    sheet.put_each(name, (*dims, "replicate"), samples.values, f"over {name}")
    found = []
    for row in samples.values.reshape(-1, *samples.values.shape[-3:]):
        means = row.mean(axis=1)
        away, scale = limit(means), _scales(limit(means))
        error = jackknife(lambda part: part - limit(part), row)
        found.append(((means - away) / scale, error / scale, _noise(row, scale)))
    words = {
        "bias": "bias, relative",
        "bias_error": "standard error of the bias, relative",
        "noise": "standard deviation of one run over replicates, relative",
    }
    shape = (*samples.seconds.shape[:-1], len(QUANTITIES))
    for (key, what), each in zip(words.items(), zip(*found, strict=True), strict=True):
        sheet.put(f"{name}_{key}", (*dims, "quantity"), np.reshape(each, shape), f"{what}, over {name}")
    median = np.median(samples.seconds, axis=-1)
    sheet.put(f"{name}_wall_time", dims, median, f"median wall time of a run, over {name}", "s")


def _put_convergence(sheet: _Sheet, values: np.ndarray) -> None:
    """Put observed orders at every rung but the first two, Richardson's limit, and the grid convergence index."""
    means = values.mean(axis=2)
    order = np.full(means.shape, np.nan)
    order[:, 2:] = observed_order(means[:, :-2], means[:, 1:-1], means[:, 2:])
    last = np.array([jackknife(lambda part: observed_order(*part[-3:]), row) for row in values])
    finest = means[:, -3:].transpose(1, 0, 2)
    limit = richardson(*finest)
    index, dims = convergence_index(*finest) / _scales(limit), ("variant", "quantity")
    words = "observed order of convergence in the time step, this rung the finest of three"
    sheet.put("order", ("variant", "points", "quantity"), order, words)
    sheet.put("order_error", dims, last, "standard error of the order at the finest rung")
    sheet.put("convergence_index", dims, index, f"grid convergence index, safety factor {SAFETY}, relative")
    sheet.put_each("limit", ("variant",), limit, "Richardson's limit over points")


def _put_solvers(sheet: _Sheet, samples: list[Samples]) -> None:
    """Put wall time of the solvers, and their difference from the first and from the march."""
    first = samples[0].values[0].mean(axis=0)
    scale, dims = _scales(first), ("solver", "quantity")
    march, lattice = (each.values[0] for each in samples[-2:])
    shared = min(len(march), len(lattice))
    apart = np.abs(lattice[:shared] - march[:shared]).max(axis=0) / scale
    bias = np.array([(each.values[0].mean(axis=0) - first) / scale for each in samples])
    noise = np.array([_noise(each.values[0], scale) for each in samples])
    sheet.put("solver_bias", dims, bias, "mean less that of the first solver, relative")
    sheet.put("solver_noise", dims, noise, "standard deviation of one run over replicates, relative")
    sheet.put("lattice_less_march", ("quantity",), apart, "largest difference of the lattice from the march, relative")
    sheet.put("solver_replicates", ("solver",), [each.seconds.size for each in samples], "replicates run")
    sheet.put("solver_wall_time", ("solver",), [np.median(each.seconds) for each in samples], "median wall time", "s")


def _put_storage(sheet: _Sheet, stored: dict[str, np.ndarray]) -> None:
    names = list(QUANTITIES)[:SAMPLED]
    sheet.put("sampled_quantity", ("sampled_quantity",), names, "quantity that depends on cells", "")
    words = "cells stored as float32 less as float64, plain NumPy rule, relative"
    sheet.put("storage_difference", ("replicate", "sampled_quantity"), stored["difference"], words)
    words = "fraction of cells that storage brings to another size, beyond rounding"
    sheet.put("storage_cells_apart", ("replicate",), stored["cells_apart"], words)


def _put_reference(sheet: _Sheet, values: np.ndarray, limit: np.ndarray) -> None:
    index, scale = convergence_index(*values.mean(axis=1)), _scales(limit)
    sheet.put_each("reference", (), limit, "reference of the work-precision grid")
    error = jackknife(_limit, values) / scale
    sheet.put("reference_error", ("quantity",), error, "standard error of the reference, relative")
    words = f"grid convergence index of the reference, safety factor {SAFETY}, relative"
    sheet.put("reference_convergence_index", ("quantity",), index / scale, words)


def _put_combinations(sheet: _Sheet, plan: Plan, samples: Samples, limit: np.ndarray) -> None:
    """Put the work-precision grid: bias, noise and error of every combination, wall time, and the Pareto front."""
    rows, dims = combinations(plan), ("combination",)
    for axis, column in zip(("streamlines", "points", "cells"), np.array(rows, np.int32).T, strict=True):
        sheet.put(f"combination_{axis}", dims, column, f"{_AXES[axis]}, of the combination")
    names = {_grid_of(name): name for name in plan.levels}
    level = [names.get(row, "") for row in rows]
    sheet.put("combination_level", dims, level, "named level of the combination, if any", "")
    _put_ladder(sheet, "combination", dims, samples, lambda means: limit)
    error = np.abs(sheet.values["combination_bias"]) + 2 * sheet.values["combination_noise"]
    sheet.put("combination_error", (*dims, "quantity"), error, "|bias| + 2 standard errors of one run, relative")
    worst = error[:, :SAMPLED].max(axis=1)
    words = "largest error of P50, P80 and percent below 1 mm, relative"
    sheet.put("combination_worst_error", dims, worst, words)
    front = pareto(sheet.values["combination_wall_time"], worst).astype(np.int8)
    sheet.put("combination_on_front", dims, front, "whether no other combination is as cheap and as accurate")


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
