"""Scene -> loaded bed: geometry, motion, stress, force and power, and Voronoi cells where grains are exchanged."""

import math
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hpgr.bed import kernels, kinematics, stress
from hpgr.bed.geometry import Geometry, between_rolls, centres
from hpgr.bed.kinematics import Kinematics, StepStrains
from hpgr.bed.stress import StressState
from hpgr.laws.elasticity import Elasticity
from hpgr.laws.flow import Flow, FlowConstants
from hpgr.scene import Scene

if TYPE_CHECKING:  # GEOS loads with it
    from hpgr.bed.tessellation import Tessellation


class BedInputs(NamedTuple):
    """All that a bed depends on, SI units: scenes of equal inputs share their bed."""

    diameter: float
    gap: float
    entry_gap: float
    speed: float
    flow: Flow
    elasticity: Elasticity
    feed_solid_fraction: float
    max_solid_fraction: float
    streamlines: int
    points: int
    tessellated: bool

    def between_rolls(self, xi: np.ndarray) -> Geometry:
        """Return the bed with the streamlines `xi`."""
        return between_rolls(self.diameter, self.gap, self.entry_gap, xi)

    def laws(self) -> tuple:
        """Return profile, elastic law and solid fractions as the kernels take them."""
        flow = self.flow.constants(self.gap, self.diameter, self.feed_solid_fraction)
        return flow, self.elasticity.constants(), self.feed_solid_fraction, self.max_solid_fraction

    @property
    def surface_speed(self) -> float:
        """Speed of the roll surface, m/s."""
        return self.speed * self.diameter / 2

    @property
    def stress_points(self) -> int:
        """Points on a streamline at which stress is known, substeps between."""
        return (self.points - 1) * self.elasticity.substeps + 1


def inputs_of(scene: Scene, tessellated: bool = False) -> BedInputs:
    """Return what the bed of `scene` depends on."""
    rolls, bed, grid = scene.rolls, scene.bed, scene.resolution
    machine = rolls.diameter, rolls.gap, rolls.entry_gap, rolls.speed
    laws = scene.flow, scene.elasticity, bed.feed_solid_fraction, bed.max_solid_fraction
    return BedInputs(*machine, *laws, grid.streamlines, grid.points, tessellated)


class Pressed(NamedTuple):
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


class LoadedBed(NamedTuple):
    """The bed under load at the scene's material points, (streamline, point)."""

    geometry: Geometry
    kinematics: Kinematics
    stress: StressState
    pressed: Pressed
    tessellation: "Tessellation | None"


def load_bed(inputs: BedInputs) -> LoadedBed:
    """Return the loaded bed.

    Raises
    ------
    ValueError
        If material points coincide.

    Examples
    --------
    >>> import hpgr
    >>> from hpgr.bed.loaded import inputs_of, load_bed
    >>> bed = load_bed(inputs_of(hpgr.presets.industrial()))
    >>> 1e6 < bed.pressed.force < 1e8  # N per m of roll width
    True
    """
    xi, every = centres(inputs.streamlines), inputs.elasticity.substeps
    walled = inputs.between_rolls(np.append(xi, 1.0))  # the roll itself, whose force and power are wanted
    flow, *elastic = inputs.laws()
    motion, strains = kinematics.move(walled, flow, inputs.surface_speed, inputs.stress_points)
    state = stress.load(*elastic, motion, strains)
    bed = LoadedBed(
        walled._replace(xi=xi),
        motion._replace(
            residence_time=motion.residence_time[::every], time_step=every * motion.time_step, **_kept(motion, every)
        ),
        state._replace(continuity_solid_fraction=state.continuity_solid_fraction[:-1], **_kept(state, every)),
        _press(walled, flow, motion, strains, state),
        None,
    )
    return bed._replace(tessellation=_tessellated(inputs, bed)) if inputs.tessellated else bed


def _kept(part: NamedTuple, every: int) -> dict[str, np.ndarray]:
    """Return the fields (streamline, point) of `part` at every so many points, without the roll's streamline."""
    return {name: field[:-1, ::every] for name, field in part._asdict().items() if np.ndim(field) == 2}


def _press(walled: Geometry, flow: FlowConstants, motion: Kinematics, strains: StepStrains, state: StressState):
    if walled.height == 0:
        return Pressed(0.0, 0.0, 0.0)
    pressure, shear_stress = state.pressure, state.shear_stress
    first = int((motion.volumetric_rate[-1] > 0).argmax())
    onset = flow.nip_angle or math.asin(motion.y[-1, first] / walled.radius)
    return Pressed(
        kernels.wall_force(walled, flow, motion.y[-1], pressure[-1], shear_stress[-1]),
        kernels.power(walled, flow, motion.y, motion.speed, *strains, pressure, shear_stress),
        onset if (strains.volumetric[-1] > 0).any() else 0.0,
    )


def _tessellated(inputs: BedInputs, bed: LoadedBed) -> "Tessellation":
    from hpgr.bed.tessellation import tessellate  # late: only exchange and pictures need GEOS

    rim, _ = kinematics.move(bed.geometry._replace(xi=np.array([0.0, 1.0])), inputs.laws()[0], inputs.surface_speed, 2)
    return tessellate(bed.geometry, bed.kinematics.x, bed.kinematics.y, rim.y[:, 0])


class Beds:
    """Loads beds and keeps the last `size` of them."""

    def __init__(self, size: int):
        self.load = lru_cache(size)(load_bed)
