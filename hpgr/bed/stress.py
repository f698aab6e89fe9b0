"""Stresses and strains of the bed, marched along every streamline from the onset of compaction (paper eq. 4)."""

from typing import NamedTuple

import numpy as np

from hpgr.bed import kernels
from hpgr.bed.kinematics import Kinematics, StepStrains
from hpgr.laws.elasticity import ElasticConstants


class StressState(NamedTuple):
    """State of the bed at the material points; arrays are (streamline, point).

    Attributes
    ----------
    volumetric_strain, shear_strain : ndarray
        Volumetric and elastic triaxial shear strain since the onset of compaction.
    solid_fraction : ndarray
        Solid fraction, at most the bed's maximum.
    pressure, shear_stress : ndarray
        Mean stress p and triaxial shear stress q, Pa.
    on_shear_limit : ndarray of bool
        Whether shear beyond the convexity limit has been taken as plastic here.
    continuity_solid_fraction : ndarray
        (streamline,) solid fraction that mass continuity would need at the exit; may exceed 1.
    tension_clamped : bool
        Whether the law asked for tension, or for shear against the flow, somewhere: stresses are held at 0 then.
    """

    volumetric_strain: np.ndarray
    shear_strain: np.ndarray
    solid_fraction: np.ndarray
    pressure: np.ndarray
    shear_stress: np.ndarray
    on_shear_limit: np.ndarray
    continuity_solid_fraction: np.ndarray
    tension_clamped: bool


def load(
    elastic: ElasticConstants,
    feed_solid_fraction: float,
    max_solid_fraction: float,
    kinematics: Kinematics,
    strains: StepStrains,
) -> StressState:
    """Return stresses and strains at the material points of `kinematics`."""
    rate = kinematics.volumetric_rate
    state = (*np.empty((5, *rate.shape)), np.empty(rate.shape, bool))
    solid = feed_solid_fraction, max_solid_fraction
    clamped = kernels.load(elastic, *solid, kinematics.time_step, rate, *strains, state)
    return StressState(*state, feed_solid_fraction * np.exp(state[0][:, -1]), clamped)
