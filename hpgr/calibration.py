"""Calibrate ore and machine to pilot tests, and predict other tests.

Force and speed of a test are set, as on the machine; the gap follows. Moduli, nip angle and idle torque are fitted to
throughput, power and cake thickness, by the least squares of the percent they are missed by; strength, fragments and
the fall of pressure along the roll width to the percent passing of the product at centre and edge of the width and in
total, where measured. Every evaluation draws the same random numbers, so the objective is smooth.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import least_squares

from hpgr.bed import machine
from hpgr.bed.loaded import Beds
from hpgr.fields import show
from hpgr.grains import solve
from hpgr.laws.feed import Feed, TableFeed
from hpgr.run import load, run_scene
from hpgr.scene import Scene, field_info
from hpgr.tables import PilotTest, read_pilot_tests

_PARTS, _MEASURED = ("centre", "edge", "total"), ("throughput", "power", "cake_thickness")
_PRODUCT = "percent passing"
_OF_MACHINE = ("K", "alpha", "T_0")  # fitted to what is measured of the machine; the others to the product
_ROUNDS = 2
_STEPS = (0.03, 0.01)  # of central differences, in the units below: wide first, or counting cells would show
_LOST = 1e3  # percent that a trial is off whose force no gap carries: it is never taken
_CONFIDENCE = 0.95
_MODULI = ("bulk_modulus", "shear_modulus")
_CRITICAL = 0.9  # part of the product below the size that the middle of the roll width just breaks, to start from
_CUSHIONINGS = (1.0, 0.5)  # n to start from; from 1 alone the fit to the KHD tests ends 2 % above its minimum
_BEDS = 64  # loaded beds kept while fitting
_UNDETERMINED = 1e-6  # least singular value over the largest below which tests do not tell parameters apart


class Parameter(NamedTuple):
    """A parameter that can be fitted.

    Attributes
    ----------
    field : str
        Scene field.
    low, high : float
        Bounds, in the field's unit.
    logarithmic : bool
        Whether its logarithm is fitted; else the value in units of `high`.
    follower : str
        Scene field that keeps its ratio to this one.
    """

    field: str
    low: float
    high: float
    logarithmic: bool = True
    follower: str = ""

    def scaled(self, value: float) -> float:
        """Return the number that is fitted."""
        return math.log(value) if self.logarithmic else value / self.high

    def value(self, scaled: float) -> float:
        """Return the field's value of a fitted number."""
        return math.exp(scaled) if self.logarithmic else scaled * self.high


PARAMETERS = {
    "sigma_m": Parameter("strength.reference_strength", 1e3, 1e10),
    "w": Parameter("strength.weibull_modulus", 0.05, 100.0),
    "gamma": Parameter("fragments.exponent", 0.02, 20.0),
    "n": Parameter("strength.cushioning", 0.05, 100.0),
    "K": Parameter("elasticity.bulk_modulus", 1e5, 1e12, follower="elasticity.shear_modulus"),
    "alpha": Parameter("flow.nip_angle", math.radians(1), math.radians(45)),
    "kappa": Parameter("roll_width.pressure_drop", 0.0, 1.0, logarithmic=False),
    "T_0": Parameter("rolls.idle_torque", 0.0, 1e6, logarithmic=False),
}


class Estimate(NamedTuple):
    """A fitted value with its 95 % confidence interval, in SI; the interval is infinite where tests do not tell."""

    value: float
    low: float
    high: float
    unit: str


class Prediction(NamedTuple):
    """What a scene says of a test: SI; size distributions (size,) at the test's sieves, fractions.

    `centre` and `edge` are of the roll width, None for a scene without one; all three for one that is stress only.
    """

    gap: float
    throughput: float
    power: float
    specific_energy: float
    centre: np.ndarray | None
    edge: np.ndarray | None
    total: np.ndarray | None


class Calibration(NamedTuple):
    """A scene fitted to pilot tests.

    Attributes
    ----------
    scene : Scene
        The scene with the fitted values; its feed, speed and force are those of the first test.
    estimates : dict
        Fitted values by symbol.
    residuals : dict
        By test and measured quantity ("centre", "edge", "total": percent passing, (size,); "throughput", "power",
        "cake_thickness": percent), predicted less measured.
    at_bound : tuple
        Symbols of the fitted values that ended at a bound.
    undetermined : tuple
        Symbols whose values the tests do not tell apart.
    """

    scene: Scene
    estimates: dict[str, Estimate]
    residuals: dict[str, dict[str, np.ndarray]]
    at_bound: tuple[str, ...]
    undetermined: tuple[str, ...]

    def predict(self, test: PilotTest) -> Prediction:
        """Return what the fitted scene says of a test, from its feed, speed and force alone."""
        return predict(self.scene, test)

    def __str__(self) -> str:
        lines = [f"calibrated on {', '.join(self.residuals)}"]
        for name, found in self.estimates.items():
            value, low, high = (show(one, found.unit) for one in found[:3])
            spread = f"{low} to {high}" if math.isfinite(found.high) else "any value"
            told = " (at its bound)" if name in self.at_bound else ""
            lines.append(f"{name:>8} = {value} ({spread}){told}")
        if self.undetermined:
            lines.append(f"the tests do not tell apart {', '.join(self.undetermined)}")
        return "\n".join(lines)


def calibrate(
    scene: Scene,
    feed: Feed | None,
    product: str | Path,
    operations: str | Path,
    fit: Sequence[str] = ("sigma_m", "w", "gamma", "K"),
    tests: Sequence[str] | None = None,
) -> Calibration:
    """Fit parameters of `scene` to the pilot tests of two CSV files.

    Parameters
    ----------
    scene : Scene
        Machine, ore and resolution to start from. With flow "nip" it needs a nip angle or a cake density, and with
        `roll_width` centre and edge of the width are told apart.
    feed : Feed, optional
        Feed of all tests; default each test's own.
    product, operations : path
        Tables as `hpgr.tables.read_pilot_tests` takes them.
    fit : sequence of str
        Symbols to fit: sigma_m, w, gamma, n, K (G keeps its ratio to it), alpha (nip angle), kappa (roll width), T_0
        (idle torque).
    tests : sequence of str, optional
        Names of the tests to fit to; default all.

    Returns
    -------
    Calibration
        Estimates with 95 % confidence intervals from the curvature at the minimum. They take residuals as independent,
        which those of one cumulative curve are not: they are too narrow rather than too wide.

    Raises
    ------
    OSError, ValueError
        If a table cannot be read, a name is unknown, there are fewer measured values than parameters, or the scene
        cannot carry the tests' forces to begin with.

    Examples
    --------
    >>> import hpgr
    >>> folder = hpgr.presets.DATA
    >>> coarse = {"resolution.points": 40, "resolution.streamlines": 1, "strength.cushioning": float("inf")}
    >>> scene = hpgr.presets.khd_pilot().with_values(coarse)
    >>> product, operations = folder / "khd_porphyry_psd.csv", folder / "khd_porphyry_operations.csv"
    >>> found = hpgr.calibrate(scene, None, product, operations, fit=["sigma_m", "gamma"], tests=["K-P1"])
    >>> list(found.estimates)
    ['sigma_m', 'gamma']
    """
    known = {test.name: test for test in read_pilot_tests(product, operations)}
    wanted = list(known) if tests is None else list(tests)
    unknown = [repr(name) for name in wanted if name not in known]
    if unknown or not wanted:
        told = ", ".join(unknown) or "none"
        raise ValueError(f"tests: got {told}; must be among {', '.join(known)}; correct the names, or leave it out")
    return fit_tests(scene, [known[name] for name in wanted], fit, feed)


def fit_tests(scene: Scene, tests: Sequence[PilotTest], fit: Sequence[str], feed: Feed | None = None) -> Calibration:
    """Fit parameters of `scene` to tests, as `calibrate` does to those of files."""
    names = _known_names(scene, fit)
    scene = _started(scene.with_values({"resolution.record": "product"}), names, tests[0], feed)
    trial = _Trial(scene, [_at_test(scene, test, feed) for test in tests], tests, names)
    fitted = [PARAMETERS[name] for name in names]
    bounds = np.array([[one.scaled(one.low) for one in fitted], [one.scaled(one.high) for one in fitted]])
    place = np.array([one.scaled(_value_of(scene, name)) for one, name in zip(fitted, names, strict=True)])
    machine_part = [k for k, name in enumerate(names) if name in _OF_MACHINE]
    product_part = [k for k, name in enumerate(names) if name not in _OF_MACHINE]
    trial.refuse_unfit(place, machine_part, product_part)
    # kappa, of the product, takes part of the force: a second round settles both
    for turn in range(_ROUNDS if machine_part and product_part else 1):
        place = _minimise(trial.machine, place, bounds, machine_part, _STEPS)
        place = _fit_product(trial, place, bounds, product_part, first=turn == 0)
    return _calibration(trial, place, bounds, [(trial.machine, machine_part), (trial.product, product_part)])


def _fit_product(trial: "_Trial", place: np.ndarray, bounds: np.ndarray, free: list[int], first: bool) -> np.ndarray:
    if first and solve.choose(trial.scene) == "march":  # the closed form gives the starting point
        smooth = [k for k in free if trial.names[k] != "n"]
        place = _minimise(trial.smooth_product, place, bounds, smooth, _STEPS[:1])
    if first and "n" in trial.names:
        place = _best_start(trial.product, place, bounds, free, trial.names.index("n"))
    return _minimise(trial.product, place, bounds, free, _STEPS if first else _STEPS[-1:])


class _Trial:
    """Residuals of trial values, given as the numbers that are fitted; NaN-free, for those measured."""

    def __init__(self, scene: Scene, cases: list[Scene], tests: Sequence[PilotTest], names: list[str]):
        self.scene, self.cases, self.tests, self.names = scene, cases, tests, names
        self._beds = Beds(_BEDS)

    def machine(self, place: np.ndarray) -> np.ndarray:
        """Return by how many percent throughput, power and cake thickness are missed."""
        return self._missed(place, _MEASURED, {"resolution.cells": 0})

    def product(self, place: np.ndarray) -> np.ndarray:
        """Return by how many percent passing the product is missed."""
        return self._missed(place, _PARTS, {})

    def smooth_product(self, place: np.ndarray) -> np.ndarray:
        """Return the same without cushioning, by the closed form."""
        return self._missed(place, _PARTS, {"strength.cushioning": math.inf})

    def refuse_unfit(self, place: np.ndarray, machine_part: list[int], product_part: list[int]) -> None:
        """Raise ValueError if there is too little to fit to, or no gap carries the forces to begin with."""
        for free, found, what in (
            (machine_part, self.machine(place), "throughput, power and cake thickness"),
            (product_part, self.smooth_product(place), _PRODUCT),
        ):
            symbols = ", ".join(self.names[k] for k in free)
            if found.size < len(free):
                raise ValueError(
                    f"fit: got {symbols}, fitted to {what}; must be at most as many as the {found.size} values of "
                    f"these; {_more_values(self.scene, what)}"
                )
            if (found == _LOST).any():
                raise ValueError(
                    "scene: no gap carries the force of every test with the moduli and nip angle that the fit begins "
                    "with; one must; give another elasticity.bulk_modulus, such as '600 MPa', or flow.nip_angle"
                )

    def _missed(self, place: np.ndarray, names: Sequence[str], extra: dict[str, Any]) -> np.ndarray:
        values = _values(self.scene, self.names, place) | extra
        parts = [self._of_test(case, test, values, names) for case, test in zip(self.cases, self.tests, strict=True)]
        return np.concatenate(parts)

    def _of_test(self, case: Scene, test: PilotTest, values: dict[str, Any], names: Sequence[str]) -> np.ndarray:
        try:
            off = _residuals(_predict(case.with_values(values), self._beds), test)
        except ValueError:  # no gap carries the force
            off = {name: np.full(np.size(getattr(test, name)), _LOST) for name in self._compared(test)}
        flat = np.concatenate([off[name] for name in names if name in off] or [np.empty(0)])
        return flat[~np.isnan(flat)]

    def _compared(self, test: PilotTest) -> list[str]:
        apart = ("centre", "edge") if self.scene.roll_width is not None else ()
        return [name for name in (*apart, "total", *_MEASURED) if not np.isnan(getattr(test, name)).all()]


def predict(scene: Scene, test: PilotTest, feed: Feed | None = None, floating: bool = True) -> Prediction:
    """Return what `scene` says of a test, from its feed, speed and force.

    With `floating` off, the gap is the test's cake thickness, or its working gap where that was not measured, and the
    force follows instead.

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
    return _predict(_at_test(scene.with_values({"resolution.record": "product"}), test, feed, floating))


def _at_test(scene: Scene, test: PilotTest, feed: Feed | None, floating: bool = True) -> Scene:
    """Return the scene at the speed, force and feed of a test, with its sieves."""
    table = tuple((size, 100 * part) for size, part in zip(test.sizes.tolist(), test.feed.tolist(), strict=True))
    known = ~np.isnan(test.feed)
    values: dict[str, Any] = {
        "rolls.speed": test.surface_speed / (scene.rolls.diameter / 2),
        "rolls.specific_pressing_force": test.specific_pressing_force if floating else None,
        "feed": feed or TableFeed(table=[row for row, here in zip(table, known, strict=True) if here]),
        "resolution.sieves": tuple(test.sizes.tolist()),
    }
    if (
        getattr(scene.flow, "cake_solid_fraction", None) is not None
    ):  # the angle is the ore's; it is held while the gap floats
        values |= {"flow.nip_angle": _nip_angle(scene), "flow.cake_solid_fraction": None}
    if not floating:
        values["rolls.gap"] = test.gap if math.isnan(test.cake_thickness) else test.cake_thickness
    return scene.with_values(values)


def _predict(scene: Scene, beds: Beds | None = None) -> Prediction:
    """Predict; `beds` keeps the loaded beds of trials, which those of another strength share (2 x faster)."""
    found = run_scene(scene, beds=beds)
    names = ("passing_width_centre", "passing_width_edge", "passing_total")
    products = [None if found.values.get(name) is None else np.asarray(found.values[name]) for name in names]
    figures = (float(found.values[name]) for name in ("throughput", "power", "specific_energy"))
    return Prediction(found.scene.rolls.gap, *figures, *products)


def _residuals(found: Prediction, test: PilotTest) -> dict[str, np.ndarray]:
    """Return by what each measured quantity is missed, in percent passing or percent."""
    off = {}
    for name in _PARTS:
        part, measured = getattr(found, name), getattr(test, name)
        if part is not None and not np.isnan(measured).all():
            off[name] = 100 * (part - measured)
    for name, value in (("throughput", found.throughput), ("power", found.power), ("cake_thickness", found.gap)):
        measured = getattr(test, name)
        if not math.isnan(measured):
            off[name] = np.array([100 * (value / measured - 1)])
    return off


def _started(scene: Scene, names: Sequence[str], test: PilotTest, feed: Feed | None) -> Scene:
    """Return the scene with starting values that a test tells by itself: nip angle, moduli, strength."""
    cake = test.gap if math.isnan(test.cake_thickness) else test.cake_thickness
    if math.isnan(cake):
        return scene
    if "alpha" in names and not math.isnan(test.throughput):
        bed = scene.bed
        solid = test.throughput / (bed.solid_density * cake * scene.rolls.width * test.surface_speed)
        if bed.feed_solid_fraction < solid <= bed.max_solid_fraction:  # else the working gap was no cake's thickness
            values = {"rolls.gap": cake, "flow.cake_solid_fraction": solid, "flow.nip_angle": None}
            angle = _nip_angle(scene.with_values(values | {"rolls.specific_pressing_force": 1.0}))
            scene = scene.with_values({"flow.nip_angle": angle, "flow.cake_solid_fraction": None})
    here = _at_test(scene, test, feed, floating=False).with_values({"resolution.cells": 0})
    if "K" in names:
        force = machine.specific_pressing_force(here)  # proportional to the moduli
        if force > 0:
            factor = test.specific_pressing_force / force
            stiffer = {f"elasticity.{name}": factor * getattr(scene.elasticity, name) for name in _MODULI}
            scene, here = scene.with_values(stiffer), here.with_values(stiffer)
    if "sigma_m" in names:
        pressure = float(solve.crushing_stress(*load(here)).max())
        critical = float(np.interp(_CRITICAL, test.total, test.sizes))
        slope = 3 / scene.strength.weibull_modulus
        if pressure > 0:
            strength = pressure * (critical / scene.strength.reference_size) ** slope
            scene = scene.with_values({"strength.reference_strength": min(max(strength, 1e4), 1e9)})
    return scene


def _best_start(function, start: np.ndarray, bounds: np.ndarray, free: list[int], cushioning: int) -> np.ndarray:
    """Return the best of the minima reached from several strengths of cushioning: the valley is shallow and bent."""
    found = []
    for value in _CUSHIONINGS:
        place = start.copy()
        place[cushioning] = PARAMETERS["n"].scaled(value)
        found.append(_minimise(function, place, bounds, free, _STEPS[:1]))
    return min(found, key=lambda place: float(np.sum(function(place) ** 2)))


def _minimise(function, start: np.ndarray, bounds: np.ndarray, free, steps) -> np.ndarray:
    """Return the place of the least squares over the free numbers, with ever narrower differences."""
    place = start.copy()
    if not free:
        return place

    def at(part: np.ndarray) -> np.ndarray:
        whole = place.copy()
        whole[free] = part
        return whole

    for step in steps:

        def slopes(part: np.ndarray, step: float = step) -> np.ndarray:
            return _slopes(function, at(part), bounds, free, step)

        limits = {"bounds": bounds[:, free], "xtol": 1e-4, "ftol": 1e-5, "max_nfev": 40}
        place = at(least_squares(lambda part: function(at(part)), place[free], slopes, **limits).x)
    return place


def _slopes(function, place: np.ndarray, bounds: np.ndarray, free, step: float) -> np.ndarray:
    """Return the derivatives (residual, free) by central differences that stay within the bounds."""
    columns = []
    for k in free:
        ends = [place.copy(), place.copy()]
        ends[0][k], ends[1][k] = max(place[k] - step, bounds[0, k]), min(place[k] + step, bounds[1, k])
        low, high = (function(end) for end in ends)
        columns.append((high - low) / (ends[1][k] - ends[0][k]))
    return np.array(columns).T


def _calibration(trial: _Trial, place: np.ndarray, bounds: np.ndarray, parts) -> Calibration:
    """Return what was found; `parts` are the functions minimised with the numbers that each was free in."""
    names, spread, lost = trial.names, np.zeros(place.size), np.zeros(place.size, bool)
    for function, free in parts:
        if free:
            spread[free], lost[free] = _spread(function(place), _slopes(function, place, bounds, free, _STEPS[0]))
    estimates = {}
    for k, name in enumerate(names):
        parameter = PARAMETERS[name]
        ends = (parameter.value(min(max(place[k] + side * spread[k], -700.0), 700.0)) for side in (-1, 1))
        low, high = ends if math.isfinite(spread[k]) else (0.0, math.inf)
        estimates[name] = Estimate(parameter.value(place[k]), max(low, 0.0), high, field_info(parameter.field).unit)
    values = _values(trial.scene, names, place)
    fitted = [one.with_values(values) for one in trial.cases]
    close = 1e-3 * (bounds[1] - bounds[0])
    return Calibration(
        fitted[0],
        estimates,
        {test.name: _residuals(_predict(one), test) for one, test in zip(fitted, trial.tests, strict=True)},
        tuple(name for k, name in enumerate(names) if min(place[k] - bounds[0, k], bounds[1, k] - place[k]) < close[k]),
        tuple(name for name, k in zip(names, lost, strict=True) if k),
    )


def _spread(residual: np.ndarray, slopes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return half the width of each confidence interval, and which numbers the tests do not determine."""
    from scipy.stats import t  # late: importing it costs 0.3 s

    _, singular, axes = np.linalg.svd(slopes, full_matrices=False)
    told = singular > _UNDETERMINED * singular[0]
    freedom = residual.size - singular.size
    if freedom == 0:  # as many values as numbers: met exactly, with no telling how well
        return np.full(singular.size, math.inf), np.zeros(singular.size, bool)
    variance = residual @ residual / freedom
    inverse = np.where(told, 1 / np.where(told, singular, 1.0), 0.0)
    spread = t.ppf((1 + _CONFIDENCE) / 2, freedom) * np.sqrt(variance * ((inverse[:, None] * axes) ** 2).sum(axis=0))
    lost = (np.abs(axes[~told]) > 0.1).any(axis=0) if not told.all() else np.zeros(singular.size, bool)
    return np.where(lost, math.inf, spread), lost


def _more_values(scene: Scene, what: str) -> str:
    """Return what to do where there are fewer values than parameters."""
    if what == _PRODUCT and not scene.resolution.cells:
        return "resolution.cells = 0 has no product to compare: give the scene cells"
    return "fit fewer, or give more tests"


def _known_names(scene: Scene, fit: Sequence[str]) -> list[str]:
    names = list(dict.fromkeys(fit))
    unknown = [name for name in names if name not in PARAMETERS]
    if unknown or not names:
        told = ", ".join(unknown) or "nothing"
        raise ValueError(f"fit: got {told}; must be among {', '.join(PARAMETERS)}; correct the symbols, or name some")
    if "alpha" in names and scene.flow.kind != "nip":
        raise ValueError("fit: got alpha; must be fitted with flow.kind = 'nip'; leave it out or take that flow")
    if "kappa" in names and scene.roll_width is None:
        raise ValueError("fit: got kappa; must be fitted with a roll_width; leave it out or give the scene one")
    return names


def _nip_angle(scene: Scene) -> float:
    return scene.flow.angle(scene.rolls.gap, scene.rolls.diameter, scene.bed.feed_solid_fraction)


def _value_of(scene: Scene, name: str) -> float:
    """Return the value to start from."""
    if name == "alpha":
        return _nip_angle(scene)
    part, key = PARAMETERS[name].field.split(".")
    value = getattr(getattr(scene, part), key)
    return min(max(value, PARAMETERS[name].low), PARAMETERS[name].high if name != "n" else 1.0)


def _values(scene: Scene, names: Sequence[str], scaled: np.ndarray) -> dict[str, Any]:
    """Return the scene fields of fitted numbers, followers included."""
    values = {}
    for name, number in zip(names, scaled, strict=True):
        parameter = PARAMETERS[name]
        values[parameter.field] = parameter.value(float(number))
        if parameter.follower:
            part, key = parameter.follower.split(".")
            ratio = getattr(getattr(scene, part), key) / _value_of(scene, name)
            values[parameter.follower] = ratio * values[parameter.field]
    return values
