"""Stresses and strains of the bed, marched along every streamline from the onset of compaction (paper eq. 4)."""

from typing import NamedTuple

import numpy as np

from hpgr.bed import kernels
from hpgr.bed.kinematics import Kinematics, StepStrains
from hpgr.laws.elasticity import ElasticConstants

_TENSION_NOISE = 1e-9  # of the largest stress; less is rounding of the running sum


class StressState(NamedTuple):
    """State of the bed at the material points; arrays are (streamline, point)."""

    volumetric_strain: np.ndarray  # since the onset of compaction
    shear_strain: np.ndarray  # elastic, triaxial, since then
    solid_fraction: np.ndarray  # at most the bed's maximum
    pressure: np.ndarray  # mean stress p, Pa
    shear_stress: np.ndarray  # triaxial, q, Pa
    on_shear_limit: np.ndarray  # of bool, whether shear beyond the convexity limit has been taken as plastic here
    tension_clamped: bool  # whether tension, or shear against the flow, was asked for somewhere: stresses are then 0


def continuity_solid_fraction(state: StressState, feed_solid_fraction: float) -> np.ndarray:
    """Return the solid fraction (streamline,) that mass continuity would need at the exit; it may exceed 1."""
    return feed_solid_fraction * np.exp(state.volumetric_strain[:, -1])


def load(
    elastic: ElasticConstants, solid: tuple[float, float], kinematics: Kinematics, strains: StepStrains
) -> StressState:
    """Return stresses and strains at the material points; `solid` is the solid fraction of the feed and at most."""
    rate = kinematics.volumetric_rate
    fields = (*np.empty((5, *rate.shape)), np.empty(rate.shape, bool))
    lowest = kernels.load(elastic, solid, kinematics.time_step, rate, *strains, *fields)
    # explicit steps from zero strain miss what the state functions say there; they do so for c < 0 only
    tension = zip(lowest, fields[3:5], strict=False) if min(lowest) < 0 else ()
    clamped = lowest[2] < 0 or any(-least > _TENSION_NOISE * stress.max() for least, stress in tension)
    return StressState(*fields, clamped)
