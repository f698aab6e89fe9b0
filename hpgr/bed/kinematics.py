"""Motion of the bed: material points marched backwards from the exit, and strain rates (paper figure 3b, c)."""

from typing import NamedTuple

import numpy as np

from hpgr.bed import kernels
from hpgr.bed.geometry import Geometry
from hpgr.laws.flow import FlowConstants

_CLOSEST = 1e-9  # spacing of points, as a fraction of the bed's height, below which they are one point


class Kinematics(NamedTuple):
    """Material points and how the bed deforms there; arrays are (streamline, point), entry to exit.

    Attributes
    ----------
    x, y : ndarray
        Distance from the mid-plane and height above the minimum gap, m.
    residence_time : ndarray
        (point,) time since the first point, s; the same on every streamline.
    speed : ndarray
        Speed along the streamline, m/s.
    volumetric_rate, shear_rate : ndarray
        Rates of volumetric (compaction positive) and triaxial shear strain, 1/s.
    time_step : float
        Time between neighbouring points, s.
    """

    x: np.ndarray
    y: np.ndarray
    residence_time: np.ndarray
    speed: np.ndarray
    volumetric_rate: np.ndarray
    shear_rate: np.ndarray
    time_step: float


class StepStrains(NamedTuple):
    """Volumetric and shear strain past the onset of compaction of the step that ends at each (streamline, point)."""

    volumetric: np.ndarray
    shear: np.ndarray


def move(geometry: Geometry, flow: FlowConstants, surface_speed: float, points: int) -> tuple[Kinematics, StepStrains]:
    """Lay `points` material points on each streamline, equal time steps apart, the last at the exit.

    Raises
    ------
    ValueError
        If neighbouring points are closer than 1e-9 of the bed's height.
    """
    y, speed, volumetric_rate, shear_rate, volumetric, shear = np.zeros((6, geometry.xi.size, points))
    time_step = 0.0
    if geometry.height > 0:
        rates = volumetric_rate, shear_rate
        time_step, closest = kernels.lay(geometry, flow, surface_speed, y, speed, *rates, volumetric, shear)
        _refuse_coinciding(closest / geometry.height, points, flow.entry_fraction)
    else:  # gap = entry gap: no bed to compact; every point is the exit
        speed += surface_speed
    steps = np.arange(points) / (points - 1)
    kinematics = Kinematics(
        x=geometry.xi[:, None] * geometry.outer(y),
        y=y,
        residence_time=steps * (time_step * (points - 1)),
        speed=speed,
        volumetric_rate=volumetric_rate,
        shear_rate=shear_rate,
        time_step=time_step,
    )
    return kinematics, StepStrains(volumetric, shear)


def _refuse_coinciding(spacing: float, points: int, entry_fraction: float) -> None:
    if not spacing >= _CLOSEST:
        raise ValueError(
            f"flow.entry_fraction: got {entry_fraction:g} with {points} points and substeps; neighbouring material "
            f"points would be {spacing:.1e} of the bed's height apart, must be at least {_CLOSEST:g}; "
            "raise flow.entry_fraction or use fewer points"
        )
