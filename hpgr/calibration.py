"""Calibrate ore and machine to pilot tests, and predict other tests with their uncertainty.

Force and speed of a test are set, as on the machine; the gap follows. All parameters are fitted together, by the least
squares of what is missed of the percent passing of the product (centre and edge of the roll width, and total) and of
throughput, power and opening. Ore constants are shared by all tests; those of the machine, nip angle, moduli and idle
torque, belong to a machine and a feed. Every evaluation draws the same random numbers, so the objective is smooth.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from hpgr.bed import machine
from hpgr.bed.loaded import Beds
from hpgr.fields import names_of, path_of, show, values_of
from hpgr.grains import solve
from hpgr.laws.feed import Feed, TableFeed
from hpgr.laws.flow import NipFlow, cake_nip_angle, densest_ratio
from hpgr.run import load, run_scene
from hpgr.scene import Scene, check_scene, field_info
from hpgr.tables import PilotTest, read_pilot_tests

PARTS, FIGURES = ("centre", "edge", "total"), ("throughput", "power", "specific_energy")
_OF_MACHINE = ("throughput", "power", "gap")  # what is measured of the machine and fitted to
_WEIGHTS = {"centre": 1.0, "edge": 1.0, "total": 3.0, "throughput": 2.0, "power": 2.0, "gap": 2.0}  # of residuals
_ERROR = 3.0  # percent (passing) that a model is typically off: the unit of residuals beside what is believed before
_CORRELATED = 1.0  # nepers of size over which the residuals of one curve are correlated
_STEP = 0.01  # of differences, in spreads
_LOST = 60.0  # percent that a trial is off whose force no gap carries
_TOLD = 0.6  # posterior over prior spread above which the tests do not tell a parameter
_ALIKE = 1e-3  # of passing, within which two feeds are one
_GAP, _SOLID = 0.027, 0.83  # opening over diameter, and solid fraction there, of usual machines, to start from
_CRITICAL = 0.9  # part of the product below the size that the middle of the roll width just breaks, to start from
_BEDS = 256  # loaded beds kept while fitting
_LEVEL = 1.645  # standard deviations of a 90 % interval
_FEWEST = 3  # tests from which the discrepancy is told by leaving one out
_MACHINES = ("alpha", "K", "T_0")


class Parameter(NamedTuple):
    """A parameter that can be fitted: its scene field and bounds there."""

    field: str
    low: float
    high: float
    spread: float  # standard deviation of the fitted number, around its start, that is believed before any test
    logarithmic: bool = True  # whether the logarithm is fitted
    follower: str = ""  # scene field that keeps its ratio to this one

    def scaled(self, value: float) -> float:
        """Return the number that is fitted."""
        value = min(max(value, self.low), self.high)
        return math.log(value) if self.logarithmic else value

    def value(self, scaled: float) -> float:
        """Return the field's value of a fitted number."""
        return math.exp(scaled) if self.logarithmic else scaled


PARAMETERS = {
    "sigma_m": Parameter("strength.reference_strength", 1e3, 1e12, 2.0),
    "w": Parameter("strength.weibull_modulus", 0.05, 100.0, 1.0),
    "k": Parameter("strength.scatter", 0.05, 50.0, 0.8),
    "n": Parameter("strength.cushioning", 0.05, 100.0, 1.0),
    "gamma": Parameter("fragments.exponent", 0.02, 20.0, 1.0),
    "nu": Parameter("fragments.size_exponent", -5.0, 5.0, 1.5, logarithmic=False),
    "K": Parameter("elasticity.bulk_modulus", 1e3, 1e12, 2.0, follower="elasticity.shear_modulus"),
    "alpha": Parameter("flow.nip_angle", math.radians(1), math.radians(45), 0.2),
    "epsilon": Parameter("roll_width.edge_ratio", 1e-3, 1.0, 1.0),
    "kappa": Parameter("roll_width.pressure_drop", 0.0, 1.0, 0.3, logarithmic=False),
    "T_0": Parameter("rolls.idle_torque", 0.0, 1e6, 5e3, logarithmic=False),
}
FIT = ("sigma_m", "w", "k", "gamma", "nu", "epsilon", "alpha", "K")


class Prediction(NamedTuple):
    """What a scene says of a test, SI; size distributions (size,) at the test's sieves, fractions, None if not known.

    `lower` and `upper` have the ends of the 90 % interval of every quantity by name, for a calibration.
    """

    gap: float
    throughput: float
    power: float
    specific_energy: float
    centre: np.ndarray | None
    edge: np.ndarray | None
    total: np.ndarray | None
    lower: Mapping[str, Any] = MappingProxyType({})
    upper: Mapping[str, Any] = MappingProxyType({})


class Estimate(NamedTuple):
    """A fitted value with its 95 % interval, in SI."""

    value: float
    low: float
    high: float
    unit: str

    def __str__(self) -> str:
        if self.low <= 0 < self.value or self.high > 10 * self.low > 0:
            return f"{show(self.value, self.unit, 4)} (not determined by these tests)"
        return f"{show(self.value, self.unit, 4)} ({show(self.low, self.unit, 3)} to {show(self.high, self.unit, 3)})"


class Calibration(NamedTuple):
    """A scene fitted to pilot tests.

    Attributes
    ----------
    scene : Scene
        The scene with the fitted values; its machine, feed, speed and force are those of the first test.
    estimates : dict
        Fitted values by symbol; those of a machine and feed beyond the first by symbol and first test, "K of B1".
    residuals : dict
        By test and measured quantity ("centre", "edge", "total": percent passing, (size,); "throughput", "power",
        "gap": percent), predicted less measured.
    covariance : ndarray
        Of the numbers that are fitted, (estimate, estimate): logarithms, except of kappa, nu and T_0.
    undetermined : tuple
        Names of the estimates that the tests do not tell: left at their start.
    at_bound : tuple
        Names of the estimates that ended at a bound.
    discrepancy : dict
        By quantity what the model misses of tests it has not seen, as a standard deviation: of figures a fraction, of
        distributions F the factor of 2 sqrt(F (1 - F)).
    """

    scene: Scene
    estimates: dict[str, Estimate]
    residuals: dict[str, dict[str, np.ndarray]]
    covariance: np.ndarray
    undetermined: tuple[str, ...]
    at_bound: tuple[str, ...]
    discrepancy: dict[str, float]
    problem: "_Problem"
    place: np.ndarray

    def predict(self, test: PilotTest, intervals: bool = True) -> Prediction:
        """Return what the fitted scene says of a test, from its machine, feed, speed and force alone, with intervals.

        A machine and feed that were not fitted take the constants of the first that was.
        """
        found = self.problem.predict(self.place, test)
        if not intervals:
            return found
        moved = [self.problem.moved(self.place, k) for k in range(self.place.size)]
        aside = [(self.problem.predict(place, test), step) for place, step in moved]
        lower, upper = {}, {}
        for name in (*PARTS, *FIGURES, "gap"):
            value = getattr(found, name)
            if value is None:
                continue
            change = np.array([(getattr(said, name) - value) / step for said, step in aside])
            variance = np.einsum("i...,ij,j...->...", change, self.covariance, change)
            off = self.discrepancy.get(name, 0.0) * _scale(value, name)
            reach, most = _LEVEL * np.sqrt(variance + off**2), 1.0 if name in PARTS else math.inf
            lower[name], upper[name] = np.clip(value - reach, 0, most), np.clip(value + reach, 0, most)
        return found._replace(lower=lower, upper=upper)

    def sample(self, n: int, seed: int) -> list[Scene]:
        """Return `n` scenes that the tests leave possible: parameters drawn with their covariance."""
        drawn = np.random.default_rng(seed).multivariate_normal(self.place, self.covariance, n)
        drawn = np.clip(drawn, self.problem.low, self.problem.high)
        return [self.scene.with_values(self.problem.values(place, 0)) for place in drawn]

    def __str__(self) -> str:
        lines = [f"calibrated on {', '.join(self.residuals)}"]
        for name, found in self.estimates.items():
            left = f"{show(found.value, found.unit, 4)} (not determined by these tests, left at its start)"
            told = " (at its bound)" if name in self.at_bound else ""
            lines.append(f"{name:>8} = {left if name in self.undetermined else found}{told}")
        return "\n".join(lines)


def calibrate(
    scene: Scene,
    feed: Feed | None,
    product: str | Path,
    operations: str | Path,
    fit: Sequence[str] | None = None,
    tests: Sequence[str] | None = None,
) -> Calibration:
    """Fit parameters of `scene` to the pilot tests of two CSV files.

    Parameters
    ----------
    scene : Scene
        Machine, ore and resolution to start from; with `roll_width` centre and edge of the width are told apart. What
        the tests tell of their machine (roll diameter and width, solid density, idle power) takes its place.
    feed : Feed, optional
        Feed of all tests; default each test's own.
    product, operations : path
        Tables as `hpgr.tables.read_pilot_tests` takes them.
    fit : sequence of str, optional
        Symbols to fit, of `PARAMETERS` (G keeps its ratio to K); default those of `FIT` that the scene has.
    tests : sequence of str, optional
        Names of the tests to fit to; default all.

    Returns
    -------
    Calibration
        Estimates with 95 % intervals from the curvature at the minimum and what is believed before any test, a broad
        normal distribution around the start; residuals of one curve are taken as correlated. With three tests or more
        the discrepancy is told by leaving out one at a time, else by those of the fit, twice, and at least 3 %.

    Raises
    ------
    TypeError
        If `scene` is none.
    OSError, ValueError
        If a table cannot be read or a name is unknown, or the scene lacks what is to be fitted.

    Examples
    --------
    >>> import hpgr
    >>> folder = hpgr.presets.DATA
    >>> scene = hpgr.presets.khd_pilot().with_values({"resolution.points": 40, "resolution.streamlines": 1})
    >>> product, operations = folder / "khd_porphyry_psd.csv", folder / "khd_porphyry_operations.csv"
    >>> found = hpgr.calibrate(scene, None, product, operations, fit=["sigma_m", "gamma"], tests=["K-P1"])
    >>> list(found.estimates)
    ['sigma_m', 'gamma']
    """
    check_scene(scene)
    tables = path_of("product", product), path_of("operations", operations)
    known = {test.name: test for test in read_pilot_tests(*tables)}
    wanted = list(known) if tests is None else names_of("tests", tests, next(iter(known)))
    unknown = [repr(name) for name in wanted if name not in known]
    if unknown or not wanted:
        told = ", ".join(unknown) or "none"
        raise ValueError(f"tests: got {told}; must be among {', '.join(known)}; correct the names, or leave it out")
    found = fit_tests(scene, [known[name] for name in wanted], fit, feed)
    return validated(found) if len(wanted) >= _FEWEST else found


def fit_tests(
    scene: Scene,
    tests: Sequence[PilotTest],
    fit: Sequence[str] | None = None,
    feed: Feed | None = None,
    near: Calibration | None = None,
) -> Calibration:
    """Fit parameters of `scene` to tests, as `calibrate` does to those of files; quicker from one `near` by."""
    names = _known_names(scene, fit)
    problem = _Problem(scene.with_values({"resolution.record": "product"}), list(tests), names, feed)
    start = problem.start()
    known = {} if near is None else dict(zip(near.problem.labels, near.place, strict=True))
    place = np.array([known.get(label, number) for label, number in zip(problem.labels, start, strict=True)])
    free = list(range(start.size))
    while True:  # one after another is left at its start, until the tests tell the rest
        place = problem.minimise(place, start, free)
        slopes = problem.slopes(place)
        doubt = np.sqrt(np.diag(problem.covariance(place, slopes, free))) / problem.spreads[free]
        if not free or doubt.max() < _TOLD:
            break
        place[free[int(doubt.argmax())]] = start[free[int(doubt.argmax())]]
        free.pop(int(doubt.argmax()))
    return _calibration(problem, place, slopes, free)


def validated(found: Calibration) -> Calibration:
    """Return the calibration with the discrepancy that leaving out one test at a time tells."""
    problem, pairs = found.problem, []
    for k, test in enumerate(problem.tests):
        others = problem.tests[:k] + problem.tests[k + 1 :]
        fitted = fit_tests(problem.scene, others, problem.names, problem.feed, near=found)
        pairs.append((test, fitted._replace(discrepancy={}).predict(test)))
    return found._replace(discrepancy=discrepancy(pairs))


def discrepancy(pairs: list[tuple[PilotTest, Prediction]], factor: float = 1.0, least: float = 0.0) -> dict[str, float]:
    """Return by quantity the standard deviation of measured tests about their predictions, as in `Calibration`.

    What the predictions' own intervals tell is taken off, at most three quarters of the variance.
    """
    found = {}
    for name in (*PARTS, *FIGURES, "gap"):
        both = [_both(said, test, name) for test, said in pairs]
        off, scale, known = (sum(np.sum(one[k] ** 2) for one in both) for k in range(3))
        if scale > 0:
            found[name] = max(factor * math.sqrt(max(off - known, off / 4) / scale), least)
    return found


def _scale(value: np.ndarray, name: str) -> np.ndarray:
    """Return what a discrepancy is a part of: the figure itself; 2 sqrt(F (1 - F)) of a distribution."""
    return 2 * np.sqrt(np.clip(value * (1 - value), 0, None)) if name in PARTS else value


def predict(scene: Scene, test: PilotTest) -> Prediction:
    """Return what `scene` says of a test, from its machine, feed, speed and force.

    Examples
    --------
    >>> import hpgr
    >>> from hpgr import calibration
    >>> from hpgr.tables import read_pilot_tests
    >>> folder = hpgr.presets.DATA
    >>> [first, *_] = read_pilot_tests(folder / "khd_porphyry_psd.csv", folder / "khd_porphyry_operations.csv")
    >>> stress_only = hpgr.presets.khd_pilot().with_values({"resolution.cells": 0})
    >>> said = calibration.predict(stress_only, first)
    >>> abs(said.power / first.power - 1) < 0.1
    True
    """
    return _predict(_at_test(scene.with_values({"resolution.record": "product"}), test))


class _Problem:
    """Tests, and the numbers that are fitted to them: a column for every symbol, or every symbol and group of tests."""

    def __init__(self, scene: Scene, tests: list[PilotTest], names: list[str], feed: Feed | None):
        self.scene, self.tests, self.names, self.feed = scene, tests, names, feed
        self._beds, self._found = Beds(_BEDS), {}
        self.groups = [next(k for k, other in enumerate(tests) if _one_machine(test, other)) for test in tests]
        groups = sorted(set(self.groups))
        self.columns = [(name, group) for name in names for group in (groups if name in _MACHINES else [0])]
        self.labels = [name if group == 0 else f"{name} of {tests[group].name}" for name, group in self.columns]
        fitted = [PARAMETERS[name] for name, _ in self.columns]
        self.low = np.array([one.scaled(one.low) for one in fitted])
        self.high = np.array([one.scaled(one.high) for one in fitted])
        self.spreads = np.array([one.spread for one in fitted])

    def values(self, place: np.ndarray, group: int) -> dict[str, Any]:
        """Return the scene fields of a group of tests, followers included."""
        values = {}
        for (name, column), number in zip(self.columns, place, strict=True):
            parameter = PARAMETERS[name]
            if name not in _MACHINES or column == group:
                values[parameter.field] = parameter.value(float(number))
                if parameter.follower:
                    ratio = values_of(self.scene)[parameter.follower] / values_of(self.scene)[parameter.field]
                    values[parameter.follower] = ratio * values[parameter.field]
        return values

    def start(self) -> np.ndarray:
        """Return the place to start from: beds that carry the tests' forces near their gaps."""
        started = {group: _started(self.scene, self.names, self.tests[group], self.feed) for group in set(self.groups)}
        return np.array(
            [PARAMETERS[name].scaled(values_of(started[group])[PARAMETERS[name].field]) for name, group in self.columns]
        )

    def predict(self, place: np.ndarray, test: PilotTest) -> Prediction:
        """Return what the model says of a test, which may be none of those fitted."""
        group = next((k for k in self.groups if _one_machine(test, self.tests[k])), 0)
        values = self.values(place, group)
        key = *test[: test._fields.index("sizes")], test.sizes.tobytes(), test.feed.tobytes(), *values.values()
        if key not in self._found:
            if len(self._found) > 64 * len(self.tests):
                self._found.clear()
            self._found[key] = _predict(_at_test(self.scene, test, self.feed).with_values(values), self._beds)
        return self._found[key]

    def moved(self, place: np.ndarray, k: int) -> tuple[np.ndarray, float]:
        """Return the place with number `k` a step further, within its bounds, and the step."""
        moved, step = place.copy(), _STEP * self.spreads[k]
        moved[k] += -step if place[k] + step > self.high[k] else step
        return moved, moved[k] - place[k]

    def residuals(self, place: np.ndarray) -> np.ndarray:
        """Return the weighted residuals of all tests, in units of a typical error."""
        found = [np.empty(0)]
        for test in self.tests:
            compared = self._compared(test)
            try:
                off = _residuals(self.predict(place, test), test)
            except ValueError:  # no gap carries the force
                off = {name: np.full(len(sizes), _LOST) for name, sizes in compared}
            found += [_WEIGHTS[name] / _ERROR * off[name] for name, _ in compared]
        return np.concatenate(found)

    def _compared(self, test: PilotTest) -> list[tuple[str, np.ndarray]]:
        """Return what a test and the scene have both, and the sizes at which it was measured, 1 m of a figure."""
        apart = PARTS if self.scene.roll_width is not None else ("total",)
        names = (*(apart if self.scene.resolution.cells else ()), *_OF_MACHINE)
        sizes = {name: test.sizes if name in PARTS else np.ones(1) for name in names}
        found = [(name, sizes[name][np.isfinite(measured(test, name))]) for name in names]
        return [(name, one) for name, one in found if one.size]

    def slopes(self, place: np.ndarray) -> np.ndarray:
        """Return the derivatives (residual, number) by differences that stay within the bounds."""
        here, moved = self.residuals(place), [self.moved(place, k) for k in range(place.size)]
        return np.array([(self.residuals(one) - here) / step for one, step in moved]).T

    def minimise(self, place: np.ndarray, start: np.ndarray, free: list[int]) -> np.ndarray:
        """Return the place of the least squares over the free numbers, each drawn to its start by its spread."""
        from scipy.optimize import least_squares  # late: loading it takes 0.3 s

        if not free:
            return place
        low, high, spreads = self.low[free], self.high[free], self.spreads[free]

        def at(part: np.ndarray) -> np.ndarray:
            whole = place.copy()
            whole[free] = part
            return whole

        found = least_squares(
            lambda part: np.append(self.residuals(at(part)), (part - start[free]) / spreads),
            np.clip(place[free], low, high),
            lambda part: np.vstack([self.slopes(at(part))[:, free], np.diag(1 / spreads)]),
            bounds=(low, high),
            x_scale=spreads,
            xtol=1e-4,
            ftol=1e-4,
            max_nfev=40,
        )
        return at(found.x)

    def covariance(self, place: np.ndarray, slopes: np.ndarray, free: list[int]) -> np.ndarray:
        """Return the covariance of the free numbers: the residuals of a curve are correlated, and scatter as found."""
        slopes, before, off = slopes[:, free], np.diag(self.spreads[free] ** -2.0), self.residuals(place)
        variance = off @ off / max(off.size - len(free), 1)
        inverse = np.linalg.inv(slopes.T @ slopes + before)
        return inverse @ (variance * slopes.T @ self._correlation() @ slopes + before) @ inverse

    def _correlation(self) -> np.ndarray:
        """Return the correlation of the residuals: within a curve it falls with the ratio of sizes."""
        curves = [(k, name, one) for k, test in enumerate(self.tests) for name, one in self._compared(test)]
        where = np.log(np.concatenate([one for *_, one in curves] or [np.empty(0)]))
        curve = np.repeat(np.arange(len(curves)), [one.size for *_, one in curves])
        apart = np.abs(np.subtract.outer(where, where)) / _CORRELATED
        return np.exp(-apart) * np.equal.outer(curve, curve)


def _calibration(problem: _Problem, place: np.ndarray, slopes: np.ndarray, free: list[int]) -> Calibration:
    labels, low, high, every = problem.labels, problem.low, problem.high, list(range(place.size))
    covariance = problem.covariance(place, slopes, every)
    estimates = {}
    for k, (name, _) in enumerate(problem.columns):
        parameter, reach = PARAMETERS[name], 1.96 * math.sqrt(covariance[k, k])
        ends = [parameter.value(min(max(place[k] + side * reach, low[k]), high[k])) for side in (-1, 1)]
        estimates[labels[k]] = Estimate(parameter.value(place[k]), *ends, field_info(parameter.field).unit)
    said = [(test, _carried(problem, place, test)) for test in problem.tests]
    at_bound = np.minimum(place - low, high - place) < 1e-3 * (high - low)
    return Calibration(
        _at_test(problem.scene, problem.tests[0], problem.feed).with_values(problem.values(place, 0)),
        estimates,
        {test.name: _residuals(one, test) for test, one in said},
        covariance,
        tuple(labels[k] for k in every if k not in free),
        tuple(labels[k] for k in free if at_bound[k]),
        discrepancy(said, factor=2.0, least=_ERROR / 100),
        problem,
        place,
    )


def _carried(problem: _Problem, place: np.ndarray, test: PilotTest) -> Prediction:
    try:
        return problem.predict(place, test)
    except ValueError as error:
        rolls = _at_test(problem.scene, test, problem.feed).rolls
        raise ValueError(
            f"test {test.name}: found no values with which rolls of {show(rolls.diameter, 'm')} x "
            f"{show(rolls.width, 'm')} carry its force ({error}); check the rolls, give D_mm and L_mm, or other laws"
        ) from None


def _one_machine(test: PilotTest, other: PilotTest) -> bool:
    """Return whether two tests are of one machine and one feed."""
    if (test.diameter, test.width) != (other.diameter, other.width) and not math.isnan(test.diameter):
        return False
    apart = np.interp(np.log(other.sizes), np.log(test.sizes), test.feed) - other.feed
    return bool(np.nanmax(np.abs(apart)) < _ALIKE)


def measured(test: PilotTest, name: str) -> np.ndarray:
    """Return what was measured of a quantity, NaN where it was not.

    The gap is the working gap where the throughput fits through it below the density of rock, else the cake's.
    """
    if name == "gap":
        solid = test.throughput / (test.gap * test.width * test.surface_speed * test.solid_density)
        return np.atleast_1d(test.gap if solid < 1 or math.isnan(test.cake_thickness) else test.cake_thickness)
    if name == "specific_energy" and math.isnan(test.specific_energy):
        return np.atleast_1d(test.power / test.throughput)
    return np.atleast_1d(getattr(test, name))


def _both(said: Prediction, test: PilotTest, name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return predicted less measured where both are known, what a discrepancy is a part of, and what intervals tell."""
    value, seen = getattr(said, name), measured(test, name)
    kept = np.isfinite(seen) & (value is not None)
    value = np.broadcast_to(np.nan if value is None else value, seen.shape)[kept]
    reach = np.asarray(said.upper.get(name, 0.0)) - said.lower.get(name, 0.0)
    return value - seen[kept], _scale(value, name), np.broadcast_to(reach / (2 * _LEVEL), seen.shape)[kept]


def _at_test(scene: Scene, test: PilotTest, feed: Feed | None = None) -> Scene:
    """Return the scene at the machine, speed, force and feed of a test, with its sieves."""
    known, rolls = ~np.isnan(test.feed), scene.rolls
    diameter = rolls.diameter if math.isnan(test.diameter) else test.diameter
    speed = test.surface_speed / (diameter / 2)
    table = list(zip(test.sizes[known].tolist(), (100 * test.feed[known]).tolist(), strict=True))
    own = {"rolls.width": test.width, "bed.solid_density": test.solid_density}
    told = own | {"rolls.idle_torque": test.idle_power / speed}
    return scene.with_values(
        {name: value for name, value in told.items() if not math.isnan(value)}
        | {
            "rolls.diameter": diameter,
            "rolls.entry_gap": rolls.entry_gap * diameter / rolls.diameter,
            "rolls.speed": speed,
            "rolls.specific_pressing_force": test.specific_pressing_force,
            "feed": TableFeed(table=table) if feed is None else feed,
            "resolution.sieves": tuple(test.sizes.tolist()),
            "flow": scene.flow.held(rolls.gap, rolls.diameter, scene.bed.feed_solid_fraction),
        }
    )


def _predict(scene: Scene, beds: Beds | None = None) -> Prediction:
    """Predict; `beds` keeps the loaded beds of trials, which those of another strength share."""
    found = run_scene(scene, beds=beds)
    names = ("passing_width_centre", "passing_width_edge", "passing_total")
    products = [None if found.values.get(name) is None else np.asarray(found.values[name]) for name in names]
    return Prediction(found.scene.rolls.gap, *(float(found.values[name]) for name in FIGURES), *products)


def _residuals(said: Prediction, test: PilotTest) -> dict[str, np.ndarray]:
    """Return by what each measured quantity is missed, percent passing or percent; of power beside the net power."""
    off = {}
    for name in (*PARTS, *_OF_MACHINE):
        missed, *_ = _both(said, test, name)
        if missed.size:
            idle = test.idle_power if name == "power" and not math.isnan(test.idle_power) else 0.0
            off[name] = 100 * missed / (1.0 if name in PARTS else measured(test, name) - idle)
    return off


def _started(scene: Scene, names: Sequence[str], test: PilotTest, feed: Feed | None) -> Scene:
    """Return the scene with starting values that a test tells by itself: moduli that carry its force, and strength."""
    for name in ("k", "n"):
        if name in names and math.isinf(values_of(scene)[PARAMETERS[name].field]):
            scene = scene.with_values({PARAMETERS[name].field: 1.0})
    here = _at_test(scene, test, feed)
    rolls, bed = here.rolls, here.bed
    through = test.throughput / (_SOLID * bed.solid_density * rolls.width * test.surface_speed)
    gap = next(one for one in (float(measured(test, "gap")[0]), through, _GAP * rolls.diameter) if not math.isnan(one))
    densest, feed_solid = here.elasticity.densest(bed.max_solid_fraction), bed.feed_solid_fraction
    if "alpha" in names:
        solid = test.throughput / (gap * bed.solid_density * rolls.width * test.surface_speed)
        solid = solid if feed_solid < solid < densest else _SOLID
        angle = _nip_angle(here.flow, gap / rolls.diameter, feed_solid, solid, densest)
        scene, here = (one.with_values({PARAMETERS["alpha"].field: angle}) for one in (scene, here))
    narrowest, _ = here.flow.narrowest_gap(rolls.diameter, feed_solid, densest)
    values = {"rolls.gap": max(gap, 1.05 * narrowest), "rolls.specific_pressing_force": None, "resolution.cells": 0}
    here = here.with_values(values)
    if "K" in names:
        for _ in range(8):  # the force is near proportional to the moduli
            force = machine.specific_pressing_force(here)
            if not 0 < force < math.inf:
                break
            factor = test.specific_pressing_force / force
            stiffer = {one: factor * values_of(here)[one] for one in (PARAMETERS["K"].field, PARAMETERS["K"].follower)}
            scene, here = scene.with_values(stiffer), here.with_values(stiffer)
    if "sigma_m" in names:
        pressure = float(solve.crushing_stress(*load(here)).max())
        known = ~np.isnan(test.total)
        critical = float(np.interp(_CRITICAL, test.total[known], test.sizes[known]))
        slope = 3 / scene.strength.weibull_modulus
        if pressure > 0:
            strength = pressure * (critical / scene.strength.reference_size) ** slope
            scene = scene.with_values({"strength.reference_strength": min(max(strength, 1e4), 1e9)})
    return scene


def _nip_angle(flow: NipFlow, gap: float, feed_solid: float, solid: float, densest: float) -> float:
    """Return the nip angle, or that of a cake of fraction `solid` if it compacts nothing or too much.

    The gap is in diameters.
    """
    kept = (1 - flow.slip) * (gap + 1 - math.cos(flow.nip_angle)) * math.cos(flow.nip_angle) / gap
    if 1 < kept < densest / feed_solid:
        return flow.nip_angle
    return cake_nip_angle(gap, 1.0, min(solid / feed_solid, densest_ratio(gap, 1.0, flow.slip)), flow.slip)


def _known_names(scene: Scene, fit: Sequence[str] | None) -> list[str]:
    kind = None if scene.roll_width is None else scene.roll_width.kind
    lacking = {
        "alpha": "flow.kind = 'nip'" * (scene.flow.kind != "nip"),
        "kappa": "roll_width.kind = 'parabola'" * (kind != "parabola"),
        "epsilon": "roll_width.kind = 'friction_hill'" * (kind != "friction_hill"),
    }
    if fit is None:
        return [name for name in FIT if not lacking.get(name)]
    names = list(dict.fromkeys(names_of("fit", fit, "sigma_m")))
    unknown = [name for name in names if name not in PARAMETERS]
    if unknown or not names:
        told = ", ".join(unknown) or "nothing"
        raise ValueError(f"fit: got {told}; must be among {', '.join(PARAMETERS)}; correct the symbols, or name some")
    for name in names:
        if lacking.get(name):
            raise ValueError(f"fit: got {name}; must be fitted with {lacking[name]}; leave it out, or change the scene")
    return names
