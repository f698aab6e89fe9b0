"""What the machine feels of the bed: pressing force, torque, power, specific energy, and the gap that floats.

Real machines set force and speed, and the gap follows (model page, section Real machines).
"""

import math
from functools import cache
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq

from hpgr import flow, geometry, stress, units, width
from hpgr.flow import Motion
from hpgr.geometry import Geometry
from hpgr.scene import LEAST_GAP, Scene
from hpgr.stress import Load

# Usual machines and operation (design figures of makers, as collected in the mission of this package; phi ours)
USUAL = {
    "roll diameter": (0.5, 2.8, "m"),
    "specific pressing force": (1e6, 9e6, "Pa"),
    "specific energy": (3600.0, 10800.0, "J kg-1"),
    "gap over diameter": (0.02, 0.03, "1"),
    "exit solid fraction": (0.75, 0.92, "1"),
}
_NARROWEST = 1e-4  # gap over diameter below which no operating gap is looked for
_GAP_PRECISION = 1e-9  # relative, of an operating gap
_NO_FORCE = 1e-6  # of the wanted force; less counts as this much


class Press(NamedTuple):
    """What presses and drives the bed, per metre of a roll width with the same pressure all along.

    Attributes
    ----------
    force : float
        Pressing force per width, the integral of the normal stress on the outermost streamline, N/m.
    power : float
        Work done on the compacting bed per width and time, both halves of the gap, W/m.
    nip_angle : float
        Angle at which compaction begins at the roll, rad; 0 if it never does.
    """

    force: float
    power: float
    nip_angle: float


def press(scene: Scene, walled: Geometry, motion: Motion, state: Load) -> Press:
    """Return force, power and nip angle from the loaded bed.

    Parameters
    ----------
    scene : Scene
        What is simulated.
    walled : Geometry
        The bed with one more streamline than it has tubes, the last at the roll (xi = 1).
    motion, state : Motion, Load
        Material points and stresses on all of these streamlines.

    Notes
    -----
    The normal stress on the roll is p + 2 q / 3 times `hpgr.flow.Gradient.across`, stress and strain rate being
    coaxial. Power is the integral of p eps_v rate + q eps_s rate over the bed where it compacts; of the mid-plane's
    side the area between two points is X |v_y| dt / N.

    Examples
    --------
    >>> import numpy as np
    >>> import hpgr
    >>> from hpgr import flow, geometry, machine, stress
    >>> scene = hpgr.presets.industrial()
    >>> bed = geometry.bed(scene.rolls, 4)
    >>> walled = bed._replace(xi=np.append(bed.xi, 1.0))
    >>> motion = flow.move(scene, walled, points=200)
    >>> pressed = machine.press(scene, walled, motion, stress.load(scene, motion))
    >>> 1e6 < pressed.force < 1e8  # N per m of roll width
    True
    """
    if walled.height == 0:
        return Press(0.0, 0.0, 0.0)
    d_eps_v, d_eps_s = stress.strain_increments(motion)
    compacting = d_eps_v > 0
    return Press(
        force=_wall_force(scene, walled, motion, state),
        power=_bed_power(walled, motion, state, np.where(compacting, d_eps_v, 0), np.where(compacting, d_eps_s, 0)),
        nip_angle=_onset_angle(scene, walled, motion, compacting[-1]),
    )


def _wall_force(scene: Scene, walled: Geometry, motion: Motion, state: Load) -> float:
    wall = walled._replace(xi=walled.xi[-1:])
    y = motion.y[-1:]
    gradient = flow.velocity_gradient(scene, wall, y, 1 - y / walled.height)
    normal = state.pressure[-1] + 2 / 3 * state.shear_stress[-1] * gradient.across(walled.slope(y))[0]
    return float(np.trapezoid(normal, -np.minimum(y[0], flow.nip_height(scene, walled))))


def _bed_power(walled: Geometry, motion: Motion, state: Load, d_eps_v, d_eps_s) -> float:
    tubes = walled.xi.size - 1
    slope = walled.xi[:, None] * walled.slope(motion.y)
    flux = walled.outer(motion.y) * motion.speed / np.sqrt(1 + slope * slope)  # X |v_y|, m2/s

    def between(values):
        return (values[:tubes, 1:] + values[:tubes, :-1]) / 2

    work = between(state.pressure) * d_eps_v[:tubes] + between(state.shear_stress) * d_eps_s[:tubes]
    return float(2 / tubes * (between(flux) * work).sum())


def _onset_angle(scene: Scene, walled: Geometry, motion: Motion, compacting: np.ndarray) -> float:
    if not compacting.any():
        return 0.0
    if scene.flow.profile == "nip":
        return flow.nip_angle(scene)
    return math.asin(motion.y[-1, int(compacting.argmax())] / walled.radius)


class Figures(NamedTuple):
    """What a machine of this width feels and takes, under the names of the Dataset, SI units."""

    pressing_force: float
    specific_pressing_force: float
    torque: float
    power: float
    specific_energy: float
    specific_throughput: float
    nip_angle: float
    force_angle: float


def figures(scene: Scene, pressed: Press, throughput: float) -> Figures:
    """Return force, torque (of both drives), power and their specific figures for the whole roll width.

    The force angle beta is that of sin(beta) = P / (2 F U), so that W = 2000 Fsp sin(beta) / mdot holds for
    W in kWh/t, Fsp in N/mm2 and mdot = Q / (D L U) in t s/(h m3), as far as power goes into the bed (idle_torque = 0).
    It is 0 where nothing is pressed.

    Examples
    --------
    >>> import hpgr
    >>> from hpgr import machine
    >>> found = machine.figures(hpgr.presets.industrial(), machine.Press(8e6, 4e5, 0.159), throughput=200.0)
    >>> round(found.specific_pressing_force / 1e6, 2), found.specific_energy  # N/mm2, J/kg
    (3.64, 2000.0)
    """
    rolls = scene.rolls
    surface_speed = rolls.speed * rolls.diameter / 2
    carried = rolls.width * width.mean_pressure(scene)
    force, bed_power = pressed.force * carried, pressed.power * carried
    power = bed_power + rolls.idle_torque * rolls.speed
    return Figures(
        pressing_force=force,
        specific_pressing_force=force / (rolls.diameter * rolls.width),
        torque=power / rolls.speed,
        power=power,
        specific_energy=power / throughput,
        specific_throughput=throughput / (rolls.diameter * rolls.width * surface_speed),
        nip_angle=pressed.nip_angle,
        force_angle=math.asin(min(bed_power / (2 * force * surface_speed), 1.0)) if force > 0 else 0.0,
    )


def unusual(scene: Scene, found: Figures, exit_solid_fraction: float) -> str:
    """Return in words what leaves the range of usual machines, or nothing.

    Examples
    --------
    >>> import hpgr
    >>> from hpgr import machine
    >>> scene = hpgr.presets.industrial()
    >>> found = machine.figures(scene, machine.Press(8e6, 4e5, 0.159), throughput=200.0)
    >>> machine.unusual(scene, found, exit_solid_fraction=0.85)
    'specific energy 0.5556 kWh/t (usual 1 kWh/t to 3 kWh/t)'
    """
    values = {
        "roll diameter": scene.rolls.diameter,
        "specific pressing force": found.specific_pressing_force,
        "specific energy": found.specific_energy,
        "gap over diameter": scene.rolls.gap / scene.rolls.diameter,
        "exit solid fraction": exit_solid_fraction,
    }
    return "; ".join(
        f"{name} {units.show(values[name], unit, 4)} (usual {units.show(low, unit)} to {units.show(high, unit)})"
        for name, (low, high, unit) in USUAL.items()
        if not low <= values[name] <= high
    )


def pressing_force(scene: Scene) -> float:
    """Return the specific pressing force of `scene` at its own gap, Pa, from the stress alone.

    Examples
    --------
    >>> import hpgr
    >>> from hpgr import machine
    >>> 1e6 < machine.pressing_force(hpgr.presets.industrial()) < 9e6
    True
    """
    wall = geometry.bed(scene.rolls, 1)._replace(xi=np.ones(1))
    if wall.height == 0:
        return 0.0
    points = (scene.resolution.points - 1) * scene.stress.substeps + 1
    motion = flow.move(scene, wall, points)
    force = _wall_force(scene, wall, motion, stress.load(scene, motion))
    return force * width.mean_pressure(scene) / scene.rolls.diameter


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
    ValueError
        If no gap carries that force; the message has the reachable range.

    Examples
    --------
    >>> import hpgr
    >>> scene = hpgr.presets.industrial()
    >>> narrow, wide = (hpgr.operating_gap(scene, force) for force in ("5 N/mm^2", "3 N/mm^2"))
    >>> 0.01 < narrow < wide < 0.1
    True
    """
    held = scene.with_values({"rolls.specific_pressing_force": specific_pressing_force})
    return at_operating_gap(held).rolls.gap


def at_operating_gap(scene: Scene) -> Scene:
    """Return the scene with the gap at which its specific pressing force is carried; as it is if it has none.

    Raises
    ------
    ValueError
        If no gap carries that force.

    Examples
    --------
    >>> import hpgr
    >>> from hpgr import machine
    >>> scene = hpgr.presets.industrial().with_values({"rolls.specific_pressing_force": "4 N/mm^2"})
    >>> round(machine.at_operating_gap(scene).rolls.gap, 4)
    0.0538
    """
    wanted = scene.rolls.specific_pressing_force
    if wanted is None:
        return scene
    angle = flow.nip_angle(scene) if scene.flow.profile == "nip" else None
    held = scene.flow.model_copy(update={"nip_angle": angle, "cake_solid_fraction": None})
    narrow, wide = _gap_range(scene, angle)

    def at(log_gap: float) -> Scene:  # copies skip validation, which would cost more than the bed: bounds are ours
        rolls = scene.rolls.model_copy(update={"gap": math.exp(log_gap)})
        return scene.model_copy(update={"rolls": rolls, "flow": held})

    @cache
    def excess(log_gap: float) -> float:  # nearly straight in logs; without any force it is far below
        return math.log(max(pressing_force(at(log_gap)) / wanted, _NO_FORCE))

    if narrow >= wide:
        raise ValueError(
            f"rolls.entry_gap: got {units.show(scene.rolls.entry_gap, 'm')}; must be above "
            f"{units.show(scene.rolls.entry_gap + narrow - wide, 'm')} for the gap to float below it, the narrowest "
            f"gap being {units.show(narrow, 'm')}, below which {_why_no_narrower(scene)}; begin the bed higher"
        )
    ends = math.log(narrow), math.log(wide)
    if not excess(ends[0]) >= 0 >= excess(ends[1]):
        reach = [pressing_force(at(end)) for end in ends]
        raise ValueError(
            f"rolls.specific_pressing_force: got {units.show(wanted, 'Pa')}; must lie within the reachable "
            f"{units.show(reach[1], 'Pa')} (gap {units.show(wide, 'm')}) to {units.show(reach[0], 'Pa')} (gap "
            f"{units.show(narrow, 'm')}, below which {_why_no_narrower(scene)}); choose a force within, or another "
            "bulk modulus, nip angle or entry gap"
        )
    return at(brentq(excess, *ends, xtol=_GAP_PRECISION, rtol=4 * np.finfo(float).eps))


def _gap_range(scene: Scene, angle: float | None) -> tuple[float, float]:
    """Return the narrowest and the widest gap that can be: solid rock at the exit, and the nip at the bed's top."""
    rolls, feed = scene.rolls, scene.material.feed_solid_fraction
    least = max(_NARROWEST * rolls.diameter, LEAST_GAP)
    if angle is None:
        steepest = rolls.entry_gap - 0.4999 * rolls.diameter  # what a scene allows, see hpgr.scene.Rolls
        return max(least, steepest), rolls.entry_gap * (1 - 1e-9)
    rise, kept = rolls.diameter * (1 - math.cos(angle)), feed * math.cos(angle)
    solid = kept * rise / (1 - kept) if kept < 1 else math.inf
    return max(least, solid), rolls.entry_gap - rise


def _why_no_narrower(scene: Scene) -> str:
    return "the cake would be denser than rock" if scene.flow.profile == "nip" else "the model ends"
