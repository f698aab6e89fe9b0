"""What the machine does to the bed: pressing force, torque, power, specific energy, and the gap that floats.

Real machines set force and speed, and the gap follows (model page, section Real machines).
"""

import math
from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from hpgr.bed.loaded import BedInputs, Pressed, bear, force_on_roll, inputs_of, load_bed
from hpgr.fields import show
from hpgr.scene import LEAST_GAP, STEEPEST_ENTRY, Scene, check_scene, field_value

_NARROWEST = 1e-4  # gap over diameter below which no operating gap is looked for
_PRECISION = 1e-9  # relative, of the force that an operating gap is found for
_NO_FORCE = 1e-6  # of the wanted force; less counts as this much
_CARRIED = 1e-6  # relative error of the force at the gap found
_TRIED = 65  # gaps among which the bed that presses most is looked for
_FIRST = 4  # of a search are among these, the same for any force nearby
_NEAREST = 4  # values that are interpolated between
_SHALLOW = 1e-3  # depth of the entry below which other streamlines may have coinciding points where the roll has none
_ROLL = np.ones(1)  # its streamline


class Performance(NamedTuple):
    """Force, torque, power and throughput of a machine of this width, under the names of the Dataset, SI units."""

    pressing_force: float
    specific_pressing_force: float
    torque: float
    power: float
    specific_energy: float
    specific_throughput: float
    nip_angle: float
    force_angle: float


def gap_throughput(scene: Scene, exit_solid_fraction: float) -> float:
    """Return the solids through the whole gap, Q = rho_s phi_exit s_b L U, kg/s."""
    rolls = scene.rolls
    return scene.bed.solid_density * exit_solid_fraction * rolls.gap * rolls.width * rolls.surface_speed


def performance(scene: Scene, pressed: Pressed, throughput: float) -> Performance:
    """Return force, torque (of both drives), power and their specific figures for the whole roll width.

    The force angle beta is that of sin(beta) = P / (2 F U), so that W = 2000 Fsp sin(beta) / mdot holds for
    W in kWh/t, Fsp in N/mm2 and mdot = Q / (D L U) in t s/(h m3), as far as power goes into the bed (idle_torque = 0).
    It is 0 where nothing is pressed, and held at 90 degrees where the bed takes more than the force can give.
    """
    rolls = scene.rolls
    force, bed_power = pressed.force * rolls.width, pressed.power * rolls.width
    most = 2 * force * rolls.surface_speed  # power that the force could give at an angle of 90 degrees
    power = bed_power + rolls.idle_torque * rolls.speed
    return Performance(
        pressing_force=force,
        specific_pressing_force=force / (rolls.diameter * rolls.width),
        torque=power / rolls.speed,
        power=power,
        specific_energy=power / throughput,
        specific_throughput=throughput / (rolls.diameter * rolls.width * rolls.surface_speed),
        nip_angle=pressed.nip_angle,
        force_angle=math.asin(bed_power / most) if bed_power < most else math.pi / 2 * (bed_power > 0),
    )


def specific_pressing_force(scene: Scene) -> float:
    """Return the specific pressing force F/(D L) of `scene` at its own gap, Pa, from the roll's streamline alone."""
    return _force_over_diameter(inputs_of(scene))


def _force_over_diameter(inputs: BedInputs) -> float:
    roll = inputs.between_rolls(_ROLL)
    motion, _, state = bear(inputs, roll)
    return force_on_roll(inputs, roll, motion, state) / inputs.diameter


def operating_gap(scene: Scene, specific_pressing_force: float | str) -> float:
    """Return the gap in m at which the bed carries a specific pressing force F/(D L).

    The nip angle is held while the gap floats: that given, or that of the cake density at the scene's own gap.

    Parameters
    ----------
    scene : Scene
        The machine; its gap only matters where the nip angle follows from a cake density.
    specific_pressing_force : float or str
        In Pa, or text with a unit.

    Raises
    ------
    TypeError
        If `scene` is none.
    ValueError
        If the force is none, no gap carries it (the message has the reachable range), or material points coincide.

    Examples
    --------
    >>> import hpgr
    >>> scene = hpgr.presets.industrial()
    >>> narrow, wide = (hpgr.operating_gap(scene, force) for force in ("5 N/mm^2", "3 N/mm^2"))
    >>> 0.01 < narrow < wide < 0.1
    True
    """
    check_scene(scene)
    if specific_pressing_force is None:  # which a scene may have, as its gap is then its own
        raise ValueError("specific_pressing_force: got None; must be a pressure; such as '3.5 N/mm^2'")
    inputs, depth = _floating(scene), scene.flow.entry_fraction
    gap = _gap_carrying(inputs, field_value("rolls.specific_pressing_force", specific_pressing_force))
    if min(depth, 1 - depth) < _SHALLOW:  # three times as long as the search
        load_bed(inputs._replace(gap=gap))  # refuses what `simulate` does
    return gap


def float_gap(scene: Scene) -> Scene:
    """Return the scene with the gap at which its specific pressing force is carried; as it is if it has none.

    ValueError if no gap carries that force.
    """
    wanted = scene.rolls.specific_pressing_force
    if wanted is None:
        return scene
    inputs = _floating(scene)
    rolls = scene.rolls.model_copy(update={"gap": _gap_carrying(inputs, wanted)})
    # copies skip validation, which would cost more than the root: its bounds are a scene's
    return scene.model_copy(update={"rolls": rolls, "flow": inputs.flow})


def _floating(scene: Scene) -> BedInputs:
    """Return what the bed depends on beside the gap, which is 0; what is held while it floats is that of the scene."""
    flow = scene.flow.held(scene.rolls.gap, scene.rolls.diameter, scene.bed.feed_solid_fraction)
    return inputs_of(scene)._replace(gap=0.0, flow=flow)


@lru_cache(256)
def _gap_carrying(inputs: BedInputs, wanted: float) -> float:
    """Return the gap at which a bed carries the specific pressing force `wanted`, Pa; the gap of `inputs` is unused."""
    narrow, below = _narrowest(inputs)
    wide = inputs.flow.widest_gap(inputs.diameter, inputs.entry_gap)
    if narrow >= wide:
        raise ValueError(
            f"rolls.entry_gap: got {show(inputs.entry_gap, 'm')}; must be above "
            f"{show(inputs.entry_gap + narrow - wide, 'm')} for the gap to float below it, the narrowest gap being "
            f"{show(narrow, 'm')}, below which {below}; begin the bed higher"
        )

    force, low, high = _force_at(inputs), math.log(narrow), math.log(wide)

    def excess(log_gap: float) -> float:  # without any force it is far below
        return math.log(max(force(log_gap) / wanted, _NO_FORCE))

    def misses(log_gap: float, error: float) -> bool:
        return not abs(force(log_gap) / wanted - 1) <= error

    found = _root(excess, low, high)
    if misses(found, _PRECISION) and force(low) < wanted:  # a bed so narrow that it lies between points is not pressed
        low, below = max(np.linspace(low, high, _TRIED).tolist(), key=force), "points are too few, or " + below
        found = _root(excess, low, high)
    refused = f"rolls.specific_pressing_force: got {show(wanted, 'Pa')}; must lie"
    if misses(found, _PRECISION) and not force(low) >= wanted >= force(high):
        raise ValueError(
            f"{refused} within the reachable {show(force(high), 'Pa')} (gap {show(wide, 'm')}) to "
            f"{show(force(low), 'Pa')} (gap {show(math.exp(low), 'm')}, below which {below}); choose a force within, "
            "or another bulk modulus (the default is that of loose sand; base = 'industrial' has an ore's), nip angle "
            "or entry gap"
        )
    if misses(found, _CARRIED):
        jump = [show(force(found + side * _PRECISION), "Pa") for side in (1, -1)]
        raise ValueError(
            f"{refused} outside {jump[0]} to {jump[1]}, between which the force jumps at a gap of "
            f"{show(math.exp(found), 'm')}; choose a force outside, or elasticity.exponent above 0"
        )
    return math.exp(found)


@lru_cache(16)
def _force_at(inputs: BedInputs) -> Callable[[float], float]:
    """Return the force over diameter and width, Pa, as a function of the log of the gap, m; it keeps what it has found.

    Of the five to seven gaps that a search takes, four are the same for any force nearby.
    """
    return lru_cache(64)(lambda log_gap: _force_over_diameter(inputs._replace(gap=math.exp(log_gap))))


def _root(function: Callable[[float], float], start: float, end: float) -> float:
    """Return where a function falls past 0, else the end next to it, by inverse interpolation in log(place - start).

    First at places of a grid, which do not depend on how far it has to fall. Where interpolation leads nowhere or does
    not gain, as at a jump, to an end not yet seen, then by halves.
    """
    known: dict[float, float] = {}  # by place, from 0 at the start to 1 at the end
    low, high, guess, last, gains = 0.0, 1.0, 0.5, math.inf, True
    while True:
        value = known[guess] = function(start + guess * (end - start))
        low, high = (guess, high) if value > 0 else (low, guess)
        nearest = sorted(known, key=lambda at: abs(known[at]))
        if abs(value) < _PRECISION or high - low < _PRECISION / 10_000:
            return start + next(at for at in nearest if at in (low, high)) * (end - start)
        gains, last = not gains or len(known) <= _FIRST or abs(value) <= abs(last) / 2, value
        logs = [(known[at], math.log(at)) for at in nearest[:_NEAREST] if at > 0]
        between = math.exp(min(_inverse(logs), 1.0))
        on_grid = between - math.remainder(between, 1 / (_TRIED - 1))
        guess = on_grid if len(known) < _FIRST and low < on_grid < high else between
        if len(known) == 1 or not gains or not low < guess < high:
            unseen = [at for at in (low, high) if at not in known and len(known) > 1]
            guess = unseen[0] if unseen else (low + high) / 2


def _inverse(known: list[tuple[float, float]]) -> float:
    """Return the place at which the polynomial through values at places is 0, taken as a function of the value."""
    values, places = map(list, zip(*known, strict=True))
    if len(set(values)) < len(values):
        return math.nan
    for span in range(1, len(known)):  # Neville's scheme
        for k, (first, last) in enumerate(zip(values, values[span:], strict=False)):
            places[k] = (first * places[k + 1] - last * places[k]) / (first - last)
    return places[0]


def _narrowest(inputs: BedInputs) -> tuple[float, str]:
    """Return the narrowest gap that can be, and what is below it."""
    densest = inputs.elasticity.densest(inputs.max_solid_fraction)
    steepest = inputs.entry_gap - 0.9998 * STEEPEST_ENTRY * inputs.diameter
    return max(
        (max(_NARROWEST * inputs.diameter, LEAST_GAP), "no operating gap is looked for"),
        (steepest, "the bed would begin above 60 degrees, where a cubic streamline turns back"),
        inputs.flow.narrowest_gap(inputs.diameter, inputs.feed_solid_fraction, densest),
    )
