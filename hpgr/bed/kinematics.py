"""Motion of the bed: material points marched backwards from the exit, and strain rates (paper figure 3b, c)."""

import math
from typing import NamedTuple

import numpy as np

from hpgr.bed import kernels
from hpgr.bed.geometry import Geometry
from hpgr.laws.flow import FlowConstants

_PANELS = np.linspace(0.0, 1.0, 65)  # panels of quadrature, see hpgr.bed.kernels
_TO_NIP, _TO_TOP = 1 - abs(1 - 2 * _PANELS), np.maximum(2 * _PANELS - 1, 0.0)  # half of them below a nip
_CLOSEST = 1e-9  # spacing of points, as a fraction of the bed's height, below which they are one point


class Kinematics(NamedTuple):
    """Material points and how the bed deforms there; arrays are (streamline, point), entry to exit.

    `across` is, normal to the streamline, the deviator of the strain rate over the shear rate: 1 in uniaxial
    compaction. With stress and strain rate coaxial the normal stress on the streamline is p + 2 q / 3 times this.
    """

    y: np.ndarray  # height above the minimum gap, m
    speed: np.ndarray  # along the streamline, m/s
    volumetric_rate: np.ndarray  # of strain, 1/s; compaction positive
    shear_rate: np.ndarray  # of triaxial shear strain, 1/s
    across: np.ndarray
    flux: np.ndarray  # X |v_y|, area that sinks per time here between mid-plane and roll at the speed here, m2/s
    time_step: float  # between neighbouring points, s


class StepStrains(NamedTuple):
    """Volumetric and shear strain past the onset of compaction of the step that ends at each (streamline, point)."""

    volumetric: np.ndarray
    shear: np.ndarray


def move(geometry: Geometry, flow: FlowConstants, surface_speed: float, points: int) -> tuple[Kinematics, StepStrains]:
    """Lay `points` material points on each streamline, equal time steps apart, the last at the exit.

    ValueError if neighbouring points are closer than 1e-9 of the bed's height.
    """
    fields = y, speed, *rates, across, flux, volumetric, shear = np.empty((8, geometry.xi.size, points))
    if geometry.height > 0:
        nip = nip_height(geometry, flow)
        edges, places = _panels(geometry, flow, nip), np.empty(points)
        time_step, closest = kernels.lay(geometry, nip, flow, surface_speed, edges, places, *fields)
        if not closest >= _CLOSEST * geometry.height:
            raise ValueError(
                f"flow.entry_fraction: got {flow.entry_fraction:g} with {points} points and substeps; neighbouring "
                f"material points would be {closest / geometry.height:.1e} of the bed's height apart, must be at least "
                f"{_CLOSEST:g}; raise flow.entry_fraction or use fewer points"
            )
    else:  # gap = entry gap: no bed to compact; every point is the exit
        fields[:], speed[:], time_step = 0.0, surface_speed, 0.0
    return Kinematics(y, speed, *rates, across, flux, time_step), StepStrains(volumetric, shear)


def nip_height(geometry: Geometry, flow: FlowConstants) -> float:
    """Return the height of the nip, R sin(alpha), m, or of the bed if there is none."""
    return min(geometry.radius * math.sin(flow.nip_angle), geometry.height) if flow.nip_angle else geometry.height


def _panels(geometry: Geometry, flow: FlowConstants, nip: float) -> np.ndarray:
    """Return the places between panels, exit to entry, on the mid-plane; the speed has a kink at the nip."""
    if flow.nip_angle == 0:
        return _PANELS * -math.log(flow.entry_fraction)
    # high enough, on the mid-plane, that in the same time no tube begins below the nip, already compacted
    top = max(geometry.height * (1 - flow.entry_fraction), nip * math.hypot(1, geometry.slope(nip)))
    return _TO_NIP * (nip / geometry.height) + _TO_TOP * (top / geometry.height)
