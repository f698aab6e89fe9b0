"""Error against wall time, knob by knob and together: `python -m studies.accuracy`.

Bias and noise are kept apart. Bias is what refinement changes: differences between means over replicates that share
their random numbers. Noise is the standard deviation of one run over replicates. Both are divided by the reference
value of their quantity; percent below 1 mm by at least 1 %, and a reference of 0 by 1, so that a scene in which
little or nothing breaks has errors too.
"""

import shlex
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import numpy as np
import tyro

from hpgr.keys import refuse_key
from hpgr.scene import LEVELS, Scene
from studies.command import base_scene, refusing, shown_as
from studies.progress import progress_bar

if TYPE_CHECKING:
    import xarray as xr

SAFETY = 1.25  # of the grid convergence index; the customary factor for three grids
ORDERS = (0.5, 2.0)  # an observed order is held within these before anything is extrapolated with it
TARGETS = (0.05, 0.02, 0.005)  # relative errors for which the cheapest resolution is named

_SIEVE = 1e-3  # m, of the percent below 1 mm
_LEAST_PERCENT = 1.0  # that errors of the percent below 1 mm are divided by
_ROUNDING = 1e-12  # relative differences below it are none
_FREE = 1e150  # cushioning so weak that it is lost in rounding: n = inf, but marched
_LATTICE_REPLICATES = 2  # a run of the lattice takes seconds
_GOLDEN = np.uint64(0x9E3779B97F4A7C15)  # step of a SplitMix64 stream


class Quantity(NamedTuple):
    """What errors are measured of: its variable in `hpgr.schema`, its name and unit in tables, and their factor."""

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
_SAMPLED = 3  # the first of them, which depend on cells


class Plan(NamedTuple):
    """What is run. Where a knob is not the one refined it is held at `held`: (streamlines, points, cells)."""

    held: tuple[int, int, int]
    points: tuple[int, ...]
    many_cells: int  # while points are refined
    streamlines: tuple[int, ...]
    streamline_cells: int  # while streamlines are refined
    cells: tuple[int, ...]
    photographs: tuple[int, ...]
    photograph_cells: int
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
    photographs=(1, 2, 4, 8, 16, 32),
    photograph_cells=500,
    grid=((2, 5, 10, 20), (100, 200, 400, 800), (500, 2000, 8000, 32_000)),
    levels=tuple(LEVELS),
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
    photographs=(1, 2, 4),
    photograph_cells=50,
    grid=((2, 4), (26, 51, 101), (50, 200)),
    levels=("draft",),
    reference=(4, 500),
    replicates=8,
)


@dataclass(frozen=True)
class Options:
    """Options of the study; the scene's own streamlines, points and cells do not matter, the ladders are fixed."""

    scene: Annotated[str, shown_as("PRESET|FILE")] = "paper"
    """Scene: a preset (paper, khd_pilot), or the path of a .toml or .json scene file; without exchange."""
    replicates: Annotated[int | None, shown_as("N")] = None
    """Independent repetitions of every run, at least 2 (default: 32, with --quick 8)."""
    seed: Annotated[int, shown_as("N")] = 0
    """Seed of all randomness; the same seed gives the same figures, wall times apart."""
    quick: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Short, coarse ladders: seconds instead of minutes, to see what comes out."""
    markdown: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print every table, as markdown, instead of the short ones."""
    out: Annotated[Path, shown_as("FILE")] = Path("outputs/accuracy.nc")
    """NetCDF file to write; the figure goes beside it as .png."""
    plot: bool = True
    """Draw the figure, or not."""


@refusing
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study and return its exit code, 0 or 2; `arguments` default to the command line's."""
    options = tyro.cli(Options, prog="python -m studies.accuracy", description=__doc__, args=arguments)
    plan = QUICK if options.quick else FULL
    if options.replicates is not None:
        plan = plan._replace(replicates=options.replicates)
    result = study(base_scene(options.scene), plan, options.seed, progress=True)
    given = sys.argv[1:] if arguments is None else arguments
    result.attrs["history"] = f"python -m studies.accuracy {shlex.join(given)}".strip()
    written = _write(result, options)
    print(in_words(tables(result) if options.markdown else short_tables(result), options.markdown))
    print("wrote " + " and ".join(map(str, written)))
    return 0


def study(scene: Scene, plan: Plan, seed: int = 0, progress: bool = False) -> "xr.Dataset":
    """Return the errors and wall times of `scene` over every ladder and the grid of `plan`.

    Raises
    ------
    ValueError
        If the scene has no cells, a single one, or exchange; or the seed or replicates are refused.
    """
    _refuse(scene, plan, seed)
    scene = scene.with_values({"resolution.record": "product", "resolution.sieves": [_SIEVE]})
    ladders = _ladders(scene, plan)
    total = sum(len(ladder.scenes) * ladder.replicates for ladder in ladders.values())
    with progress_bar(total, progress, "runs") as bar:
        samples = {name: _climb(ladder, seed, bar) for name, ladder in ladders.items()}
        stored = _storage(_at(scene, *plan.held), seed, plan.replicates)
    return _dataset(scene, plan, seed, ladders, samples, stored)


def observed_order(coarse, medium, fine) -> np.ndarray:
    """Return the order of convergence seen on three grids, each twice as fine as the one before.

    NaN where nothing changes, or where the two changes differ in sign: there is no order to see.
    """
    first, second = np.asarray(medium - coarse, float), np.asarray(fine - medium, float)
    known = (first * second > 0) & (np.abs(second) > _ROUNDING * np.abs(fine))
    ratio = np.divide(first, second, out=np.ones_like(second), where=known)
    return np.where(known, np.log2(ratio), np.nan)


def held_order(order) -> np.ndarray:
    """Return the order that extrapolations use: the observed one within `ORDERS`, the lowest if there is none."""
    return np.clip(np.nan_to_num(order, nan=ORDERS[0]), *ORDERS)


def richardson(coarse, medium, fine) -> np.ndarray:
    """Return the limit of three grids, fine + (fine - medium) / (2^p - 1), p the held order."""
    return fine + (fine - medium) / (2 ** held_order(observed_order(coarse, medium, fine)) - 1)


def convergence_index(coarse, medium, fine) -> np.ndarray:
    """Return the grid convergence index of the finest of three grids, SAFETY |fine - medium| / (2^p - 1).

    In the quantity's own unit; p is the held order.
    """
    return SAFETY * np.abs(richardson(coarse, medium, fine) - fine)


def noise_exponent(sizes, noise, replicates: int) -> tuple[float, float]:
    """Return the exponent of noise against `sizes`, and its standard error; NaN if there is no noise.

    A standard deviation of R replicates is known to 1 / sqrt(2 (R - 1)) of itself.
    """
    sizes, noise = np.log(np.asarray(sizes, float)), np.asarray(noise, float)
    if not (noise > _ROUNDING).all():
        return np.nan, np.nan
    away = sizes - sizes.mean()
    slope = float(away @ np.log(noise) / (away @ away))
    return slope, float(1 / np.sqrt(2 * (replicates - 1) * (away @ away)))


def pareto(cost, error) -> np.ndarray:
    """Return where nothing else is at most as costly and at most as wrong; of equals the first."""
    cost, error = np.asarray(cost, float), np.asarray(error, float)
    front, least = np.zeros(cost.size, bool), np.inf
    for k in np.lexsort((error, cost)):
        front[k] = error[k] < least
        least = min(least, error[k])
    return front


def jackknife(statistic: Callable[[np.ndarray], np.ndarray], samples: np.ndarray) -> np.ndarray:
    """Return the standard error of `statistic` of means, from samples (rung, replicate, quantity)."""
    count = samples.shape[1]
    left_out = (samples.sum(axis=1, keepdims=True) - samples) / (count - 1)  # means, each without one replicate
    found = np.stack([statistic(left_out[:, k]) for k in range(count)])
    return np.sqrt((count - 1) / count * ((found - found.mean(axis=0)) ** 2).sum(axis=0))


def plain_march(scene: Scene, sizes: np.ndarray, streams: np.ndarray, log_stress: np.ndarray) -> None:
    """Crush one line of cells along a streamline in plain NumPy, sizes stored as their array stores them.

    The rule of `hpgr.kernels.crush`, for storage in another precision than its float32; in float32 it gives the
    kernel's sizes. `sizes` and `streams` are updated.
    """
    from hpgr import kernels, parcels

    mix = getattr(kernels.mix, "py_func", kernels.mix)  # the Python function takes arrays as well
    slope, cushion, inverse_gamma, strength_size, size_floor = parcels.constants(scene)
    for stress in log_stress[np.isfinite(log_stress)]:
        wide = sizes.astype(float)
        mean = ((np.roll(wide, 1) + np.roll(wide, -1)) + wide) / 3
        strength = cushion * np.log(wide / mean) ** 2 - slope * np.log(wide / strength_size)
        hit = (stress >= strength) & (wide >= size_floor)
        streams[hit] += _GOLDEN
        uniform = ((mix(streams[hit]) >> np.uint64(12)).astype(float) + 0.5) * 2.0**-52
        sizes[hit] = np.maximum(wide[hit] * uniform**inverse_gamma, kernels.SMALLEST)


class Ladder(NamedTuple):
    """Scenes to run, each with the replicates from `first` on."""

    scenes: list[Scene]
    replicates: int
    first: int = 0


class Samples(NamedTuple):
    """Quantities (rung, replicate, quantity) and wall times in s (rung, replicate) of a ladder."""

    values: np.ndarray
    seconds: np.ndarray


def _refuse(scene: Scene, plan: Plan, seed: int) -> None:
    refuse_key("--seed", seed)
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
    grid = {"resolution.streamlines": streamlines, "resolution.points": points, "resolution.cells": cells}
    return scene.with_values(grid | {name.replace("__", "."): value for name, value in values.items()})


def _ladders(scene: Scene, plan: Plan) -> dict[str, Ladder]:
    """Return every ladder by name; those over points are called "points: <variant>"."""
    lines, points, cells = plan.held
    count, few = plan.replicates, max(2, plan.replicates // 4)
    found = {
        f"points: {name}": Ladder([_at(scene, lines, p, plan.many_cells, **values) for p in plan.points], count)
        for name, values in variants(scene).items()
    }
    found["streamlines"] = Ladder([_at(scene, n, points, plan.streamline_cells) for n in plan.streamlines], count)
    found["cells"] = Ladder([_at(scene, lines, points, m) for m in plan.cells], count)
    found["photographs"] = Ladder(
        [
            _at(scene, lines, points, plan.photograph_cells, resolution__photographs=photographs)
            for photographs in plan.photographs
        ],
        count,
    )
    found |= {f"solver: {name}": ladder for name, ladder in _solvers(_at(scene, *plan.held), count).items()}
    found["combination"] = Ladder([_at(scene, *combination) for combination in combinations(plan)], count)
    lines, cells = plan.reference
    # replicates that the grid does not have: its errors are then not those of its own random numbers
    found["reference"] = Ladder([_at(scene, lines, p, cells) for p in plan.points[-3:]], few, first=count)
    return found


def variants(scene: Scene) -> dict[str, dict[str, Any]]:
    """Return what is changed in the scene while points are refined, by name."""
    other = "euler" if scene.stress.integrator == "increment" else "increment"
    found = {"scene": {}, "n = 0.5": {"material__cushioning": 0.5}, other: {"stress__integrator": other}}
    if scene.material.cushioning == 0.5:
        del found["n = 0.5"]
    return found


def combinations(plan: Plan) -> list[tuple[int, int, int]]:
    """Return the (streamlines, points, cells) of the work-precision grid, those of the levels included."""
    grid = [(n, p, m) for n in plan.grid[0] for p in plan.grid[1] for m in plan.grid[2]]
    named = [(LEVELS[name].streamlines, LEVELS[name].points, LEVELS[name].cells) for name in plan.levels]
    return list(dict.fromkeys([*grid, *named]))


def _solvers(scene: Scene, replicates: int) -> dict[str, Ladder]:
    """Return the solvers of the scene without cushioning; the closed form needs a finite Weibull modulus."""
    marched = scene.with_values({"material.cushioning": _FREE})
    still = marched.with_values({"exchange": {"segregation": 0.0, "mixing": 0.0}})
    found = {"march": Ladder([marched], replicates), "lattice": Ladder([still], _LATTICE_REPLICATES)}
    if np.isfinite(scene.material.weibull_modulus):
        found = {"closed form": Ladder([scene.with_values({"material.cushioning": "inf"})], replicates)} | found
    return found


def _climb(ladder: Ladder, seed: int, bar: Any) -> Samples:
    """Run every rung of a ladder, one run after the other; what compiles is run once before."""
    _run(_at(ladder.scenes[0], 1, 5, 2), seed, 0)
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
    from hpgr import budget, pipeline

    budget.refuse_too_large(scene)
    begun = time.perf_counter()
    values = pipeline.crush(scene, pipeline.prepare(scene), seed, replicate)
    seconds = time.perf_counter() - begun
    sizes = (values["p50_total"], values["p80_total"], 100 * values["passing_total"][0])
    return [*map(float, sizes), float(values["peak_pressure"]), float(values["throughput"])], seconds


def _storage(scene: Scene, seed: int, replicates: int) -> dict[str, np.ndarray]:
    """Return what storing cells as float64 instead of float32 changes, by replicate.

    The feed is the same, of float32 sizes. `difference` (replicate, quantity) is relative; `cells_apart` the fraction
    of cells that end more than rounding apart, as a decision fell the other way.
    """
    from hpgr import parcels, pipeline

    stress = pipeline.prepare(scene).crushing
    with np.errstate(divide="ignore"):  # no stress: -inf, breaks nothing
        log_stress = np.log(stress / scene.material.strength)
    products = np.empty((2, replicates, len(stress), scene.resolution.cells))
    for k, dtype in enumerate((np.float32, np.float64)):
        for replicate, line in np.ndindex(products.shape[1:3]):
            (sizes,), (streams,) = parcels.first_cells(scene, seed, [(replicate, line, 0)])
            sizes = sizes.astype(dtype)
            plain_march(scene, sizes, streams, log_stress[line])
            products[k, replicate, line] = sizes
    p50, p80 = np.quantile(products, (0.5, 0.8), axis=(2, 3))
    below = 100 * (products <= np.float64(np.float32(_SIEVE))).mean(axis=(2, 3))
    single, double = np.stack([p50, p80, below], axis=-1)
    scale = np.maximum(double, [0, 0, _LEAST_PERCENT])
    apart = np.abs(products[0] - products[1]) > 1e-4 * products[1]
    return {"difference": (single - double) / scale, "cells_apart": apart.mean(axis=(1, 2))}


def _limit(means: np.ndarray) -> np.ndarray:
    return richardson(*means[-3:])


def _dataset(scene, plan, seed, ladders, samples, stored) -> "xr.Dataset":
    """Return everything measured, and what follows from it, labelled."""
    import xarray as xr

    points = {name.partition(": ")[2]: name for name in ladders if name.startswith("points: ")}
    solvers = {name.partition(": ")[2]: name for name in ladders if name.startswith("solver: ")}
    limit = _limit(samples["reference"].values.mean(axis=1))
    scale = _scales(limit)
    result = xr.Dataset(attrs=_attributes(scene, plan, seed))
    result.coords["quantity"] = ("quantity", list(QUANTITIES), {"long_name": "quantity an error is of"})
    result.coords["variant"] = ("variant", list(points), {"long_name": "scene as it is, or with one value changed"})
    result.coords["solver"] = ("solver", list(solvers), {"long_name": "solver of the scene without cushioning"})
    for name, what in _AXES.items():
        values = getattr(plan, name)
        result.coords[name] = (name, np.array(values, np.int32), {"units": "1", "long_name": what})
    by_variant = Samples(*(np.stack([getattr(samples[name], part) for name in points.values()]) for part in _PARTS))
    _add_ladder(result, "points", ("variant", "points"), by_variant, _limit)
    for name in ("streamlines", "cells", "photographs"):
        _add_ladder(result, name, (name,), samples[name], lambda means: means[-1])
        _add_exponent(result, name, plan)
    _add_convergence(result, by_variant.values)
    _add_solvers(result, [samples[name] for name in solvers.values()])
    _add_storage(result, stored)
    _add_reference(result, samples["reference"].values, limit, scale)
    _add_combinations(result, plan, samples["combination"], limit, scale)
    return result


_PARTS = ("values", "seconds")
_AXES = {
    "points": "material points on a streamline",
    "streamlines": "streamlines from the mid-plane to the roll",
    "cells": "cells of a material point",
    "photographs": "photographs of the steady machine",
}


def _attributes(scene: Scene, plan: Plan, seed: int) -> dict[str, Any]:
    import os
    import platform
    from importlib.metadata import version

    import hpgr

    libraries = ("numpy", "numba", "xarray", "netCDF4", "scipy")
    return {
        "Conventions": "CF-1.11",
        "title": "Accuracy against cost of comminution in high pressure grinding rolls",
        "source": f"hpgr {hpgr.__version__}",
        "scene": scene.model_dump_json(),
        "seed": seed,
        "replicates": plan.replicates,
        "held": "streamlines {}, points {}, cells {}".format(*plan.held),
        "cells_while_points_are_refined": plan.many_cells,
        "cells_while_streamlines_are_refined": plan.streamline_cells,
        "cells_while_photographs_are_added": plan.photograph_cells,
        "reference_grid": "streamlines {}, cells {}, points ".format(*plan.reference)
        + f"{', '.join(map(str, plan.points[-3:]))}, extrapolated; replicates {plan.replicates} on",
        "safety_factor": SAFETY,
        "orders_held_within": list(ORDERS),
        "scale": f"errors are relative to the reference; below 1 mm to at least {_LEAST_PERCENT:g} %; 0 counts as 1",
        "wall_time": "geometry, stress, crushing and summary of one run, large ones on all cores; "
        "hpgr.simulate adds its Dataset, about 1 ms",
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}",
        "versions": ", ".join(f"{name} {version(name)}" for name in libraries),
    }


def _scales(values: np.ndarray) -> np.ndarray:
    """Return what errors of the quantities (..., quantity) are divided by."""
    size = np.abs(values)
    size = np.maximum(size, [_LEAST_PERCENT if name == "below_1mm" else 0.0 for name in QUANTITIES])
    return np.where(size > 0, size, 1.0)


def _unit_of(name: str) -> dict[str, str]:
    from hpgr import schema

    if name == "below_1mm":
        return {"units": "percent", "long_name": "product below 1 mm, whole gap"}
    return schema.attributes(QUANTITIES[name].variable)


def _noise(samples: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Return the relative standard deviation over replicates of (..., replicate, quantity); rounding is none."""
    found = samples.std(axis=-2, ddof=1) / scale
    return np.where(found > _ROUNDING, found, 0.0)


def _add_ladder(result, name, dims, samples, limit) -> None:
    """Add samples, wall time, and bias and noise of a ladder; its bias is measured from `limit` of its means."""
    for k, quantity in enumerate(QUANTITIES):
        result[f"{name}_{quantity}"] = ((*dims, "replicate"), samples.values[..., k], _unit_of(quantity))
    rows = samples.values.reshape(-1, *samples.values.shape[-3:])
    bias, error, noise = [], [], []
    for row in rows:
        means = row.mean(axis=1)
        scale = _scales(limit(means))
        bias.append((means - limit(means)) / scale)
        error.append(jackknife(lambda part: part - limit(part), row) / scale)
        noise.append(_noise(row, scale))
    shape = (*samples.seconds.shape[:-1], len(QUANTITIES))
    words = {
        "bias": ("bias, relative", bias),
        "bias_error": ("standard error of the bias, relative", error),
        "noise": ("standard deviation of one run over replicates, relative", noise),
    }
    for key, (what, found) in words.items():
        attrs = {"units": "1", "long_name": f"{what}, over {name}"}
        result[f"{name}_{key}"] = ((*dims, "quantity"), np.reshape(found, shape), attrs)
    result[f"{name}_wall_time"] = (dims, np.median(samples.seconds, axis=-1), _seconds(name))


def _seconds(name: str) -> dict[str, str]:
    return {"units": "s", "long_name": f"median wall time of a run, over {name}"}


def _add_exponent(result, name, plan) -> None:
    noise = result[f"{name}_noise"].values
    found = np.array([noise_exponent(getattr(plan, name), each, plan.replicates) for each in noise.T])
    for column, (key, what) in enumerate({"": "exponent of noise", "_error": "its standard error"}.items()):
        attrs = {"units": "1", "long_name": f"{what}, against {name}"}
        result[f"{name}_noise_exponent{key}"] = ("quantity", found[:, column], attrs)


def _add_convergence(result, values) -> None:
    """Add observed orders at every rung but the first two, Richardson's limit, and the grid convergence index."""
    means = values.mean(axis=2)
    order = np.full(means.shape, np.nan)
    order[:, 2:] = observed_order(means[:, :-2], means[:, 1:-1], means[:, 2:])
    last = [jackknife(lambda part: observed_order(*part[-3:]), row) for row in values]
    result["order"] = (
        ("variant", "points", "quantity"), order,
        {"units": "1", "long_name": "observed order of convergence in the time step, this rung the finest of three"},
    )  # fmt: skip
    result["order_error"] = (
        ("variant", "quantity"), np.array(last),
        {"units": "1", "long_name": "standard error of the order at the finest rung"},
    )  # fmt: skip
    finest = means[:, -3:].transpose(1, 0, 2)
    limit = richardson(*finest)
    result["convergence_index"] = (
        ("variant", "quantity"), convergence_index(*finest) / _scales(limit),
        {"units": "1", "long_name": f"grid convergence index of the finest rung, safety factor {SAFETY}, relative"},
    )  # fmt: skip
    for k, quantity in enumerate(QUANTITIES):
        attrs = _unit_of(quantity)
        attrs |= {"long_name": f"{attrs['long_name']}, Richardson's limit over points"}
        result[f"limit_{quantity}"] = ("variant", limit[:, k], attrs)


def _add_solvers(result, samples) -> None:
    """Add wall time of the solvers, and their difference from the first and from the march."""
    scale = _scales(samples[0].values[0].mean(axis=0))
    bias = [(each.values[0].mean(axis=0) - samples[0].values[0].mean(axis=0)) / scale for each in samples]
    march, lattice = (each.values[0] for each in samples[-2:])
    shared = min(len(march), len(lattice))
    apart = np.abs(lattice[:shared] - march[:shared]).max(axis=0)
    dims = ("solver", "quantity")
    words = {"units": "1", "long_name": f"mean less that of the {result['solver'].values[0]}, relative"}
    result["solver_bias"] = (dims, np.array(bias), words)
    words = {"units": "1", "long_name": "standard deviation of one run over replicates, relative"}
    result["solver_noise"] = (dims, np.array([_noise(each.values[0], scale) for each in samples]), words)
    result["lattice_less_march"] = (
        "quantity", apart / scale,
        {"units": "1", "long_name": "largest difference of the lattice without exchange from the march, relative"},
    )  # fmt: skip
    counts = [each.seconds.size for each in samples]
    result["solver_replicates"] = ("solver", counts, {"units": "1", "long_name": "replicates run with the solver"})
    result["solver_wall_time"] = ("solver", [np.median(each.seconds) for each in samples], _seconds("solver"))


def _add_storage(result, stored) -> None:
    names = list(QUANTITIES)[:_SAMPLED]
    result.coords["sampled_quantity"] = ("sampled_quantity", names, {"long_name": "quantity that depends on cells"})
    result["storage_difference"] = (
        ("replicate", "sampled_quantity"), stored["difference"],
        {"units": "1", "long_name": "cells stored as float32 less as float64, plain NumPy rule, relative"},
    )  # fmt: skip
    result["storage_cells_apart"] = (
        "replicate", stored["cells_apart"],
        {"units": "1", "long_name": "fraction of cells that storage brings to another size, beyond rounding"},
    )  # fmt: skip


def _add_reference(result, values, limit, scale) -> None:
    finest = values.mean(axis=1)
    for k, quantity in enumerate(QUANTITIES):
        attrs = _unit_of(quantity)
        attrs |= {"long_name": f"{attrs['long_name']}, reference of the work-precision grid"}
        result[f"reference_{quantity}"] = ((), limit[k], attrs)
    result["reference_error"] = (
        "quantity", jackknife(_limit, values) / scale,
        {"units": "1", "long_name": "standard error of the reference, relative"},
    )  # fmt: skip
    result["reference_convergence_index"] = (
        "quantity", convergence_index(*finest) / scale,
        {"units": "1", "long_name": f"grid convergence index of the reference, safety factor {SAFETY}, relative"},
    )  # fmt: skip


def _add_combinations(result, plan, samples, limit, scale) -> None:
    """Add the work-precision grid: bias, noise and error of every combination, wall time, and the Pareto front."""
    rows = combinations(plan)
    names = {(LEVELS[name].streamlines, LEVELS[name].points, LEVELS[name].cells): name for name in plan.levels}
    for k, axis in enumerate(("streamlines", "points", "cells")):
        attrs = {"units": "1", "long_name": f"{_AXES[axis]}, of the combination"}
        result.coords[f"combination_{axis}"] = ("combination", np.array([row[k] for row in rows], np.int32), attrs)
    level = [names.get(row, "") for row in rows]
    result.coords["combination_level"] = ("combination", level, {"long_name": "named level of the combination, if any"})
    bias = (samples.values.mean(axis=1) - limit) / scale
    noise = _noise(samples.values, scale)
    error = np.abs(bias) + 2 * noise
    worst = error[:, :_SAMPLED].max(axis=1)
    seconds = np.median(samples.seconds, axis=1)
    words = {
        "bias": ("mean less reference, relative", bias),
        "noise": ("standard deviation of one run over replicates, relative", noise),
        "error": ("|bias| + 2 standard errors of one run, relative", error),
    }
    for key, (what, found) in words.items():
        dims = ("combination", "quantity")
        result[f"combination_{key}"] = (dims, found, {"units": "1", "long_name": what})
    result["combination_worst_error"] = (
        "combination", worst, {"units": "1", "long_name": "largest error of P50, P80 and percent below 1 mm, relative"}
    )  # fmt: skip
    result["combination_wall_time"] = ("combination", seconds, _seconds("combination"))
    result["combination_on_front"] = (
        "combination", pareto(seconds, worst).astype(np.int8),
        {"units": "1", "long_name": "whether no other combination is as cheap and as accurate"},
    )  # fmt: skip


def chosen(result: "xr.Dataset", target: float) -> int | None:
    """Return the number of the cheapest combination whose worst error is at most `target`; None if there is none."""
    seconds = result["combination_wall_time"].values
    good = np.flatnonzero(result["combination_worst_error"].values <= target)
    return int(good[seconds[good].argmin()]) if good.size else None


class Table(NamedTuple):
    """A table to print: title, headings, rows of text."""

    title: str
    headings: list[str]
    rows: list[list[str]]


def in_words(found: list[Table], markdown: bool) -> str:
    """Return tables as text, or as markdown."""
    return "\n\n".join(_markdown(table) if markdown else _text(table) for table in found)


def _markdown(table: Table) -> str:
    rows = [table.headings, ["---", *["---:"] * (len(table.headings) - 1)], *table.rows]
    return "\n".join([f"**{table.title}**", "", *("| " + " | ".join(row) + " |" for row in rows)])


def _text(table: Table) -> str:
    rows = [table.headings, *table.rows]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["  ".join(text.rjust(width) for text, width in zip(row, widths, strict=True)) for row in rows]
    return "\n".join([table.title, *lines])


def short_tables(result: "xr.Dataset") -> list[Table]:
    """Return the tables for a terminal: convergence in dt, noise, and which resolution to take."""
    return [_convergence_table(result), _noise_table(result), _choice_table(result)]


def tables(result: "xr.Dataset") -> list[Table]:
    """Return every table, those of docs/accuracy.md."""
    points = [
        _ladder_table(result.sel(variant=name), "points", f"Points, {_variant_words(name)}: bias ± its standard error")
        for name in result["variant"].values
    ]
    others = [
        _ladder_table(result, name, f"{name.capitalize()}: bias from the last row ± its standard error")
        for name in ("streamlines", "cells", "photographs")
    ]
    return [
        *points, _convergence_table(result), *others, _noise_table(result), _solver_table(result),
        _storage_table(result), _front_table(result), _choice_table(result),
    ]  # fmt: skip


def _variant_words(name: str) -> str:
    return "the scene as it is" if name == "scene" else f"the scene with {name}"


def _percent(value: float, error: float | None = None) -> str:
    if np.isnan(value):
        return "-"
    return f"{100 * value:.3f}" if error is None else f"{100 * value:+.3f} ± {100 * error:.3f}"


def _milliseconds(seconds: float) -> str:
    return f"{1e3 * seconds:.3g}"


def _ladder_table(result, name: str, title: str) -> Table:
    shown = [f"{quantity.shown} [%]" for quantity in QUANTITIES.values()]
    noisy = [f"noise of {quantity.shown} [%]" for quantity in list(QUANTITIES.values())[:_SAMPLED]]
    rows = []
    for k, rung in enumerate(result[name].values):
        bias, error, noise = (result[f"{name}_{key}"].values[k] for key in ("bias", "bias_error", "noise"))
        cost = _milliseconds(float(result[f"{name}_wall_time"][k]))
        pairs = zip(bias, error, strict=True)
        rows.append([str(rung), cost, *(_percent(*pair) for pair in pairs), *map(_percent, noise[:_SAMPLED])])
    return Table(title, [name, "time [ms]", *shown, *noisy], rows)


def _convergence_table(result) -> Table:
    rows = []
    for variant in result["variant"].values:
        one = result.sel(variant=variant)
        for k, (name, quantity) in enumerate(QUANTITIES.items()):
            order, error = float(one["order"].values[-1, k]), float(one["order_error"].values[k])
            seen = "-" if np.isnan(order) else f"{order:.2f}" + ("" if np.isnan(error) else f" ± {error:.2f}")
            value = float(one[f"limit_{name}"]) * quantity.factor
            finest = float(one["points_bias"].values[-1, k])
            index = float(one["convergence_index"].values[k])
            row = [variant, quantity.shown, seen, f"{value:.5g} {quantity.unit}", _percent(finest), _percent(index)]
            rows.append(row)
    points = result["points"].values
    heading = f"GCI, Fs = {SAFETY} [%]"
    title = f"Convergence in dt at {points[-3]}, {points[-2]}, {points[-1]} points"
    return Table(title, ["variant", "quantity", "order", "limit", "bias of finest [%]", heading], rows)


def _noise_table(result) -> Table:
    rows = []
    for name in ("streamlines", "cells", "photographs"):
        row = [name]
        for k in range(_SAMPLED):
            slope, error = (float(result[f"{name}_noise_exponent{key}"][k]) for key in ("", "_error"))
            row.append("-" if np.isnan(slope) else f"{slope:.2f} ± {error:.2f}")
        rows.append(row)
    headings = [quantity.shown for quantity in list(QUANTITIES.values())[:_SAMPLED]]
    return Table("Exponent of the noise", ["against", *headings], rows)


def _solver_table(result) -> Table:
    names = list(result["solver"].values)
    rows = []
    for k, name in enumerate(names):
        bias, noise = (result[f"solver_{key}"].values[k, :_SAMPLED] for key in ("bias", "noise"))
        apart = _percent(float(result["lattice_less_march"].max())) if name == "lattice" else ""
        cost = _milliseconds(float(result["solver_wall_time"][k]))
        count = str(int(result["solver_replicates"][k]))
        rows.append([name, count, cost, *map(_percent, bias), *map(_percent, noise), apart])
    sampled = [quantity.shown for quantity in list(QUANTITIES.values())[:_SAMPLED]]
    columns = [*(f"{name} [%]" for name in sampled), *(f"noise of {name} [%]" for name in sampled)]
    title = f"Solvers without cushioning, less the {names[0]} ({result.attrs['held']})"
    return Table(title, ["solver", "replicates", "time [ms]", *columns, "less march, same replicates [%]"], rows)


def _storage_table(result) -> Table:
    apart = np.abs(result["storage_difference"].values)
    rows = [
        [QUANTITIES[name].shown, f"{np.median(column):.1e}", f"{column.max():.1e}"]
        for name, column in zip(result["sampled_quantity"].values, apart.T, strict=True)
    ]
    cells = result["storage_cells_apart"].values
    rows.append(["cells of another size, fraction", f"{np.median(cells):.1e}", f"{cells.max():.1e}"])
    title = "Cells stored as float32 against float64, relative difference over replicates"
    return Table(title, ["", "median", "largest"], rows)


def _combination_row(result, k: int) -> list[str]:
    grid = [str(int(result[f"combination_{axis}"][k])) for axis in ("streamlines", "points", "cells")]
    bias, noise = (result[f"combination_{key}"].values[k, :_SAMPLED] for key in ("bias", "noise"))
    worst, p80 = float(result["combination_worst_error"][k]), float(result["combination_error"][k, 1])
    cost = _milliseconds(float(result["combination_wall_time"][k]))
    return [*grid, cost, *(_percent(value) for value in (np.abs(bias).max(), noise.max(), p80, worst))]


_COMBINATION = ["N", "P", "M", "time [ms]", "bias [%]", "noise [%]", "error of P80 [%]", "error [%]"]


def _front_table(result) -> Table:
    front = np.flatnonzero(result["combination_on_front"].values)
    order = front[np.argsort(result["combination_wall_time"].values[front])]
    rows = [[*_combination_row(result, k), str(result["combination_level"].values[k])] for k in order]
    return Table("Pareto front (worst of P50, P80, below 1 mm)", [*_COMBINATION, "level"], rows)


def _choice_table(result) -> Table:
    rows = []
    for target in TARGETS:
        k = chosen(result, target)
        blank = ["-"] * len(_COMBINATION)
        rows.append([f"cheapest within {100 * target:g} %", *(blank if k is None else _combination_row(result, k))])
    for k in np.flatnonzero(result["combination_level"].values != ""):
        rows.append([f"level {result['combination_level'].values[k]}", *_combination_row(result, k)])
    index, error = (result[f"reference_{key}"].values[:_SAMPLED].max() for key in ("convergence_index", "error"))
    title = (
        "Which resolution (worst of P50, P80, below 1 mm; the reference itself: grid convergence index "
        f"{_percent(index)} %, standard error {_percent(error)} %)"
    )
    return Table(title, ["", *_COMBINATION], rows)


def _write(result: "xr.Dataset", options: Options) -> list[Path]:
    """Write the NetCDF file and the figure; return their paths."""
    from studies import store

    out = options.out if options.out.suffix == ".nc" else options.out.with_name(options.out.name + ".nc")
    try:
        store.write_dataset(result, out)
        if not options.plot:
            return [out]
        from studies.plots import accuracy as plots

        figure = plots.accuracy_figure(result)
        store.replace(out.with_suffix(".png"), lambda part: figure.savefig(part, dpi=150))
    except OSError as error:
        raise OSError(f"could not write the result: {error}") from error
    return [out, out.with_suffix(".png")]


if __name__ == "__main__":
    raise SystemExit(main())
