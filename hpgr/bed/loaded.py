"""Scene -> loaded bed: geometry, motion, stress, force and power, and Voronoi cells where grains are exchanged."""

import math
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hpgr.bed import kinematics, stress
from hpgr.bed.geometry import Geometry, between_rolls, centres
from hpgr.bed.kinematics import Kinematics, StepStrains
from hpgr.bed.stress import StressState
from hpgr.laws.elasticity import ElasticConstants, Elasticity
from hpgr.laws.flow import Flow, FlowConstants
from hpgr.laws.roll_width import RollWidth
from hpgr.scene import Scene

if TYPE_CHECKING:  # GEOS loads with it
    from hpgr.bed.tessellation import Tessellation


class BedInputs(NamedTuple):
    """All that a bed depends on, SI units: scenes of equal inputs share their bed."""

    diameter: float
    width: float
    gap: float
    entry_gap: float
    surface_speed: float
    flow: Flow
    elasticity: Elasticity
    feed_solid_fraction: float
    max_solid_fraction: float
    roll_width: RollWidth | None
    streamlines: int
    points: int
    tessellated: bool

    def between_rolls(self, xi: np.ndarray) -> Geometry:
        """Return the bed with the streamlines `xi`."""
        return between_rolls(self.diameter, self.gap, self.entry_gap, xi)

    def profile(self) -> FlowConstants:
        """Return the profile as the kernels take it."""
        return self.flow.constants(self.gap, self.diameter, self.feed_solid_fraction)

    def laws(self) -> tuple[FlowConstants, ElasticConstants, tuple[float, float]]:
        """Return profile, elastic law and solid fractions (feed, at most) as the kernels take them."""
        return self.profile(), self.elasticity.constants(), (self.feed_solid_fraction, self.max_solid_fraction)

    def mean_pressure(self, geometry: Geometry, y, power: float = 1.0):
        """Return the mean over the roll width of the pressure at height y to a power, relative to its middle's."""
        if self.roll_width is None:
            return 1.0
        return self.roll_width.mean_pressure(2 * geometry.outer(y), self.width, power)

    @property
    def stress_points(self) -> int:
        """Points on a streamline at which stress is known, substeps between."""
        return (self.points - 1) * self.elasticity.substeps + 1


def inputs_of(scene: Scene, tessellated: bool = False) -> BedInputs:
    """Return what the bed of `scene` depends on."""
    rolls, bed, grid = scene.rolls, scene.bed, scene.resolution
    machine = rolls.diameter, rolls.width, rolls.gap, rolls.entry_gap, rolls.surface_speed
    laws = scene.flow, scene.elasticity, bed.feed_solid_fraction, bed.max_solid_fraction, scene.roll_width
    return BedInputs(*machine, *laws, grid.streamlines, grid.points, tessellated)


class Pressed(NamedTuple):
    """What presses and drives the bed, per metre of roll width."""

    force: float  # pressing force per width, N/m
    power: float  # work done on the bed per width and time, both halves of the gap, W/m
    nip_angle: float  # at which compaction begins at the roll, rad; 0 if it never does


class LoadedBed(NamedTuple):
    """The bed under load at the scene's material points, (streamline, point)."""

    geometry: Geometry
    kinematics: Kinematics
    stress: StressState
    pressed: Pressed
    tessellation: "Tessellation | None"


def load_bed(inputs: BedInputs) -> LoadedBed:
    """Return the loaded bed; ValueError if material points coincide."""
    xi, every = centres(inputs.streamlines), inputs.elasticity.substeps
    walled = inputs.between_rolls(np.append(xi, 1.0))  # the roll itself, whose force and power are wanted
    motion, strains, state = bear(inputs, walled)
    bed = LoadedBed(
        walled._replace(xi=xi),
        motion._replace(time_step=every * motion.time_step, **_kept(motion, every)),
        state._replace(**_kept(state, every)),
        _press(inputs, walled, motion, strains, state),
        None,
    )
    return bed._replace(tessellation=_tessellated(inputs, bed)) if inputs.tessellated else bed


def _kept(part: NamedTuple, every: int) -> dict[str, np.ndarray]:
    """Return the fields (streamline, point) of `part` at every so many points, without the roll's streamline."""
    return {name: field[:-1, ::every] for name, field in part._asdict().items() if np.ndim(field) == 2}


def bear(inputs: BedInputs, geometry: Geometry) -> tuple[Kinematics, StepStrains, StressState]:
    """Return motion, strains of steps and stresses on the streamlines of `geometry`, at the points of stress."""
    flow, elastic, solid = inputs.laws()
    motion, strains = kinematics.move(geometry, flow, inputs.surface_speed, inputs.stress_points)
    return motion, strains, stress.load(elastic, solid, motion, strains)


def force_on_roll(inputs: BedInputs, geometry: Geometry, motion: Kinematics, state: StressState) -> float:
    """Return the pressing force per width, N/m: normal stress on the last streamline, the roll, over its height.

    Past the gap the cake follows the rolls apart until it has recovered; it then adds to the force.
    """
    y, normal = motion.y[-1], _on_roll(motion, state)
    low = np.minimum(y, kinematics.nip_height(geometry, inputs.profile()))
    pressing = normal * inputs.mean_pressure(geometry, y)
    recovering = inputs.elasticity.recovering_force(normal[-1], inputs.gap, geometry.radius)
    return float(
        (pressing[1:] + pressing[:-1]) @ (low[:-1] - low[1:]) / 2
        + recovering * inputs.mean_pressure(geometry, 0.0, 1.5)
    )


def _on_roll(motion: Kinematics, state: StressState) -> np.ndarray:
    """Return the normal stress on the last streamline (point,), Pa."""
    return state.pressure[-1] + 2 / 3 * state.shear_stress[-1] * motion.across[-1]


def _power(inputs: BedInputs, geometry: Geometry, motion: Kinematics, strains: StepStrains, state: StressState):
    """Return the work of stress on the compacting bed per width and time, less what the cake gives back, W/m.

    Of the mid-plane's side the area between two points is X |v_y| dt / N.
    """
    tubes = geometry.xi.size - 1

    def between(field):
        return field[:tubes, 1:] + field[:tubes, :-1]  # twice the mean

    volumetric, shear = (part[:tubes, 1:] for part in strains)
    work = between(state.pressure) * volumetric + between(state.shear_stress) * shear
    work *= between(motion.flux * inputs.mean_pressure(geometry, motion.y))
    given_back = inputs.elasticity.recovered_energy(_on_roll(motion, state)[-1])
    given_back *= inputs.gap * inputs.surface_speed * inputs.mean_pressure(geometry, 0.0, 2.0)
    done = 0.5 / tubes * work.sum(where=volumetric > 0)
    return float(max(done - given_back, 0.0))  # no cake gives back more than was put in


def _press(inputs: BedInputs, geometry: Geometry, motion: Kinematics, strains: StepStrains, state: StressState):
    onset = inputs.profile().nip_angle or math.asin(_onset(motion) / geometry.radius)
    force, power = force_on_roll(inputs, geometry, motion, state), _power(inputs, geometry, motion, strains, state)
    return Pressed(force, power, onset if (strains.volumetric[-1] > 0).any() else 0.0)


def _onset(motion: Kinematics) -> float:
    """Return the height at which the roll's streamline begins to compact, m, the rate linear between two points."""
    rate, y = motion.volumetric_rate[-1], motion.y[-1]
    first = int((rate > 0).argmax())
    return float(np.interp(0.0, rate[first - 1 : first + 1], y[first - 1 : first + 1]) if first else y[0])


def _tessellated(inputs: BedInputs, bed: LoadedBed) -> "Tessellation":
    from hpgr.bed.tessellation import tessellate  # late: only exchange and pictures need GEOS

    rim, _ = kinematics.move(bed.geometry._replace(xi=np.array([0.0, 1.0])), inputs.profile(), inputs.surface_speed, 2)
    return tessellate(bed.geometry, bed.geometry.x(bed.kinematics.y), bed.kinematics.y, rim.y[:, 0])


class Beds:
    """Loads beds and keeps the last `size` of them."""

    def __init__(self, size: int):
        self.load = lru_cache(size)(load_bed)
