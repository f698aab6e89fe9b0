"""Ask for an error instead of a grid: refine a scene until the estimated error of its results is small enough.

The error of a run has two parts that are estimated apart. Bias, from time step and streamlines, shows when the
grid is refined with the same random numbers; noise, from the number of cells, shows when the run is repeated with
others. The estimate is |bias| + 2 standard errors, relative, for P80, the fraction below 1 mm and peak pressure.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from hpgr import cost
from hpgr.bed.loaded import Beds
from hpgr.fields import check_number
from hpgr.grains import solve
from hpgr.results import schema
from hpgr.scene import Scene

Run = Callable[..., Any]  # of scene, seed, replicate, beds; its result has `values`

QUANTITIES = ("p80", "fineness", "peak_pressure")
FINENESS_SIEVE = 1e-3  # m
_LEAST_FINENESS = 0.05  # mass fraction; less is judged as if it were this much, or no error would be small enough

_REPLICATES = 8  # of a pilot run; their scatter knows the noise to about a quarter
_NOISE_SAFETY = 1.5  # for that quarter, and for taking noise to fall as 1 / sqrt(cells)
_FIRST_POINTS = 51
_SLOWEST = 0.85  # ratio of successive differences taken at most: n < 1 converges about so slowly
_FASTEST = 0.5  # and at least, first order, whatever the figures seem to say
_SAFETY = 1.5  # on differences that stand for a bias


class Estimate(NamedTuple):
    """A resolution and the error estimated for it."""

    scene: Scene  # at the chosen resolution
    bias: dict[str, float]  # what is left of it, by quantity, relative
    noise: dict[str, float]  # one standard error, likewise

    def errors(self) -> dict[str, float]:
        """Return bias + 2 standard errors by quantity, relative."""
        return {name: self.bias[name] + 2 * self.noise[name] for name in self.bias}

    def variables(self) -> dict[str, float]:
        """Return errors and resolution under the names they have in a Dataset."""
        grid = self.scene.resolution
        used = {"streamlines_used": grid.streamlines, "points_used": grid.points, "cells_used": grid.cells}
        return {schema.ERRORS[name]: error for name, error in self.errors().items()} | used


def refine(scene: Scene, tolerance: float, run: Run, max_cost: float = 60.0, seed: int = 0) -> Estimate:
    """Return the resolution at which the estimated error of `scene` is within `tolerance`, 1e-4 to 0.5, relative.

    The scene's streamlines are the fewest taken, its points and cells are chosen anew; more than one snapshot makes the
    noise smaller than estimated. `run` is `hpgr.run.run_scene`, which this module lies below; `max_cost` the predicted
    seconds that pilot and final run may take together. ValueError if the tolerance is out of range, or cannot be met
    under `max_cost`; the message has the predicted cost.
    """
    check_number("tolerance", tolerance)
    spent = _Purse(run, tolerance, max_cost)
    kept = {f"resolution.{name}": getattr(scene.resolution, name) for name in ("record", "snapshots")}
    scene = scene.with_values({"resolution.snapshots": 1})
    coarse, bias_lines = _enough_streamlines(scene, tolerance / 4, spent)
    coarse, bias_steps, scatter = _enough_points(coarse, tolerance / 2, spent, seed)
    bias = {name: bias_lines[name] + bias_steps[name] for name in bias_steps}
    cells = coarse.resolution.cells
    for name, found in scatter.items():
        cells = max(cells, found.cells_for((tolerance - bias[name]) / 2))
    chosen = coarse.with_values({"resolution.cells": cells, **kept})
    noise = {name: scatter[name].noise(cells) if name in scatter else 0.0 for name in bias}
    spent.allow(cost.predict(chosen).seconds, chosen)
    return Estimate(chosen, bias, noise)


class _Scatter(NamedTuple):
    """Relative scatter of a figure: variance over cells of what breaks at random, and error of counting whole cells.

    A parcel of feed has a cell in each of M equal parts of its mass, so that its number of cells below a sieve is right
    to one cell, which is there or not: a standard deviation of at most 1/2 cell, whatever the other cells tell of it.
    """

    variance: float
    counting: float

    def noise(self, cells: int) -> float:
        """Return one standard error of a run with so many cells."""
        return math.sqrt(self.variance / cells + (self.counting / cells) ** 2)

    def cells_for(self, noise: float) -> int:
        """Return how many cells make the standard error this small."""
        half = self.variance / (2 * noise**2)
        return math.ceil(half + math.sqrt(half**2 + (self.counting / noise) ** 2))


class _Purse:
    """Runs scenes; what they were predicted to cost so far is held against the limit before each."""

    def __init__(self, run: Run, tolerance: float, max_cost: float):
        self._run, self._tolerance, self._max_cost = run, tolerance, max_cost
        self.seconds = 0.0

    def figures(self, scene: Scene, seed: int = 0, replicate: int = 0, beds: Beds | None = None) -> dict[str, float]:
        """Return the judged figures of a run that was allowed."""
        return figures_of(self._run(scene, seed, replicate, beds).values)

    def allow(self, seconds: float, scene: Scene) -> None:
        if not self.seconds + seconds <= self._max_cost:
            grid = scene.resolution
            raise ValueError(
                f"tolerance: got {self._tolerance:g}; needs at least {grid.streamlines} streamlines x {grid.points} "
                f"points x {grid.cells} cells, predicted to cost {self.seconds + seconds:,.3g} s; must be at most "
                f"max_cost = {self._max_cost:g} s; raise max_cost or the tolerance"
            )
        self.seconds += seconds


def _enough_streamlines(scene: Scene, wanted: float, spent: _Purse) -> tuple[Scene, dict[str, float]]:
    """Return the scene with enough streamlines, and the bias they leave."""
    while True:
        lines = scene.resolution.streamlines
        here, finer = (_smooth_figures(scene, count, 201, spent) for count in (lines, 2 * lines))
        # midpoint rule, second order: 4/3 of the difference is the bias
        bias = dict.fromkeys(QUANTITIES if scene.resolution.cells else QUANTITIES[-1:], 0.0)
        bias |= {name: _SAFETY * 4 / 3 * abs(relative(here, finer, name)) for name in here}
        if max(bias.values()) <= wanted:
            return scene, bias
        scene = scene.with_values({"resolution.streamlines": 2 * lines})


def _enough_points(scene: Scene, wanted: float, spent: _Purse, seed: int):
    """Return the scene with enough points and pilot cells, the bias they leave, and the scatter of a run of it.

    The bias has two parts. Sampling the stress at points misses the sharp peak by an amount that depends on where
    the points happen to lie; it is read off a much finer bed. Breaking once per step is what remains: its bias
    falls steadily, and is read off the changes between grids with common random numbers.
    """
    cells = 0 if scene.resolution.cells == 0 else min(max(round(0.01 / wanted * 1000), 300), 30_000)
    product = scene.with_values({"resolution.record": "product"})
    if solve.choose(product) == solve.choose(scene):  # else cells are wanted of a scene whose product has a closed form
        scene = product
    points, runs, earlier = _FIRST_POINTS, [], None
    while True:
        one = scene.with_values({"resolution.points": points, "resolution.cells": cells})
        sampling = _sampling_bias(one, spent)
        if solve.choose(one) in ("stress only", "closed form"):
            if max(sampling.values()) <= wanted:
                return one, sampling, {}
        else:
            spent.allow(_REPLICATES * cost.predict(one).seconds, one)
            beds = Beds(1)
            runs.append([spent.figures(one, seed, replicate, beds) for replicate in range(_REPLICATES)])
            steps = {name: _step(runs[-2], runs[-1], name) for name in ("p80", "fineness")} if len(runs) > 1 else None
            if earlier:
                stepping = {name: _left(steps[name], earlier[name]) for name in steps}
                bias = {name: sampling.get(name, 0.0) + stepping.get(name, 0.0) for name in QUANTITIES}
                if max(bias.values()) <= wanted:
                    return one, bias, _scatter(runs[-1], one)
            earlier = steps
        points = 2 * points - 1


def _sampling_bias(scene: Scene, spent: _Purse) -> dict[str, float]:
    lines, points = scene.resolution.streamlines, scene.resolution.points
    finest = max(2 * points - 1, min(8 * points - 7, 12_801))
    here, finer = (_smooth_figures(scene, lines, count, spent) for count in (points, finest))
    return {name: _SAFETY * abs(relative(here, finer, name)) for name in here}


def _smooth_figures(scene: Scene, streamlines: int, points: int, spent: _Purse) -> dict[str, float]:
    """Return the figures of a scene without cushioning and exchange, whose closed form has no noise.

    The profile of stress across the gap and along the streamlines acts on both alike.
    """
    grid = {"resolution.streamlines": streamlines, "resolution.points": points, "resolution.record": "product"}
    smooth = scene.with_values(grid | {"strength.cushioning": math.inf, "exchange": None})
    if solve.choose(smooth) == "march":  # strength without size effect has no closed form: judge the pressure
        smooth = smooth.with_values({"resolution.cells": 0})
    spent.allow(2.5e-3 + 2e-6 * streamlines * points, smooth)
    return spent.figures(smooth)


def _step(coarse: list[dict], fine: list[dict], name: str) -> tuple[float, float]:
    """Return the relative change from one grid to the next, and its standard error, over paired replicates."""
    changes = np.array([relative(a, b, name) for a, b in zip(coarse, fine, strict=True)])
    return float(changes.mean()), float(changes.std(ddof=1)) / math.sqrt(changes.size)


def _left(step: tuple[float, float], earlier: tuple[float, float]) -> float:
    """Return the bias left after a refinement: the geometric tail of the changes, with the doubt about them."""
    (change, error), (before, doubt) = step, earlier
    ratio = (abs(change) + error) / max(abs(before) - doubt, 1e-30)
    ratio = min(max(ratio, _FASTEST), _SLOWEST)
    return (abs(change) + error) * ratio / (1 - ratio)


def _scatter(runs: list[dict], scene: Scene) -> dict[str, _Scatter]:
    """Return the scatter of one run of `scene`, by quantity."""
    grid, found = scene.resolution, {}
    for name in runs[0]:
        values = np.array([run[name] for run in runs])
        scale = max(abs(values.mean()), _LEAST_FINENESS if name == "fineness" else 1e-300)
        spread = _NOISE_SAFETY * float(values.std(ddof=1)) / scale
        counting = 0.5 / scale / math.sqrt(grid.streamlines) if name == "fineness" else 0.0
        found[name] = _Scatter(grid.cells * spread**2, counting)
    return found


def relative(a: dict[str, float], b: dict[str, float], name: str) -> float:
    """Return how far figure `name` of `a` is from that of `b`, relative to the latter."""
    scale = max(abs(b[name]), _LEAST_FINENESS if name == "fineness" else 1e-300)
    return (a[name] - b[name]) / scale


def figures_of(values: dict[str, Any]) -> dict[str, float]:
    """Return the judged figures among the variables of a run: P80 m, fraction below 1 mm, peak pressure Pa."""
    found = {"peak_pressure": float(values["peak_pressure"])}
    if values.get("p80_total") is not None:
        found["p80"] = float(values["p80_total"])
        logs = np.log(np.asarray(values["sieve"], dtype=float))
        found["fineness"] = float(np.interp(math.log(FINENESS_SIEVE), logs, values["passing_total"]))
    return found
