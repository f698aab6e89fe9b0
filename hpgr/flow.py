"""Motion of the bed: speed, material points marched backwards from the exit, strain rates (paper figure 3b, c).

Heights are carried as depth fractions f = 1 - y/H = exp(-lam): v is a power of f, and marching in lam stays
exact however close the entry comes to the stagnation point at f = 0.
"""

from typing import NamedTuple

import numpy as np

from hpgr.geometry import Geometry
from hpgr.scene import Scene

_PANELS = 64  # 5-point Gauss on 64 panels: travel times to 1e-13 for every entry_fraction down to 1e-9
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(5)
_NODES, _WEIGHTS = (_NODES + 1) / 2, _WEIGHTS / 2
_CLOSEST = 1e-9  # spacing of points, as a fraction of the bed's height, below which they are one point


class Motion(NamedTuple):
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


def move(scene: Scene, geometry: Geometry, points: int) -> Motion:
    """Lay `points` material points on each streamline, equal time steps apart, the last at the exit.

    Raises
    ------
    ValueError
        If neighbouring points are closer than 1e-9 of the bed's height.
    """
    surface_speed = scene.rolls.speed * scene.rolls.diameter / 2
    if geometry.height == 0:  # gap = entry gap: no bed to compact; every point is the exit
        flat = np.zeros((geometry.xi.size, points))
        x = geometry.xi[:, None] * geometry.half_gap + flat
        return Motion(x, flat, np.zeros(points), flat + surface_speed, flat, flat, 0.0)
    exponent = scene.flow.exponent
    lam, duration = _march_back(geometry, exponent, scene.flow.entry_fraction, points)
    unit_time = geometry.height / surface_speed
    depth, y = np.exp(-lam), -geometry.height * np.expm1(-lam)
    _refuse_coinciding(y, geometry.height, scene)
    volumetric, shear = strain_rates(geometry, y, depth, exponent)
    steps = np.arange(points) / (points - 1)
    return Motion(
        x=geometry.xi[:, None] * geometry.outer(y),
        y=y,
        residence_time=steps * (duration * unit_time),
        speed=surface_speed * depth**exponent,
        volumetric_rate=volumetric / unit_time,
        shear_rate=shear / unit_time,
        time_step=duration * unit_time / (points - 1),
    )


def _march_back(geometry: Geometry, exponent: float, entry_fraction: float, points: int):
    """Return lam (streamline, point) and the residence time, in units of H/U.

    The travel time to the exit is tau(lam) = int sqrt(1 + (xi X')^2) exp((m-1) lam) d lam. It is tabulated
    by panels, and each point's lam follows by Newton's method inside its panel.
    """
    xi = geometry.xi[:, None]
    edges = np.linspace(0.0, -np.log(entry_fraction), _PANELS + 1)
    panel = edges[1]

    def travel(xi, start, length):
        lam = start[..., None] + length[..., None] * _NODES
        slope = xi[..., None] * geometry.slope(-geometry.height * np.expm1(-lam))
        return length * (np.sqrt(1 + slope * slope) * np.exp((exponent - 1) * lam) @ _WEIGHTS)

    def table(xi):
        return np.cumsum(np.pad(travel(xi, edges[:-1], np.full(_PANELS, panel)), ((0, 0), (1, 0))), axis=1)

    duration = table(np.zeros((1, 1)))[0, -1]
    wanted = duration * (np.arange(points - 1, -1, -1) / (points - 1))
    known = table(xi)
    start = np.stack([np.searchsorted(row, wanted, side="right") - 1 for row in known]).clip(0, _PANELS - 1)
    start_time = np.take_along_axis(known, start, axis=1)
    panel_time = np.take_along_axis(known, start + 1, axis=1) - start_time
    base = edges[start]
    length = panel * (wanted - start_time) / panel_time
    for _ in range(4):  # the linear guess is within 1e-2 of a panel; each pass squares the error
        lam = base + length
        slope = xi * geometry.slope(-geometry.height * np.expm1(-lam))
        rate = np.sqrt(1 + slope * slope) * np.exp((exponent - 1) * lam)
        length = length - (start_time + travel(xi, base, length) - wanted) / rate
    return base + length, duration


def strain_rates(geometry: Geometry, y: np.ndarray, depth: np.ndarray, exponent: float):
    """Return volumetric and triaxial shear strain rates, in units of U/H, from the analytic gradient.

    Parameters
    ----------
    geometry : Geometry
        The bed; its xi label the rows of `y`.
    y, depth : ndarray
        (streamline, point) heights in m and depth fractions 1 - y/H.
    exponent : float
        Exponent m of the speed profile |v| = U depth**m.

    Notes
    -----
    The velocity follows the streamline x = xi X(y); its direction varies with x at fixed y because xi does.
    Formulas: model page, section 2; tested against finite differences of the velocity.
    """
    xi, height = geometry.xi[:, None], geometry.height
    outer, slope, curvature = geometry.outer(y), geometry.slope(y), geometry.curvature(y)
    speed = height * depth**exponent  # times U/H, so that velocity gradients come in units of U/H
    speed_gradient = -exponent * depth ** (exponent - 1)
    t = xi * slope
    g = 1 / np.sqrt(1 + t * t)
    t_x, t_y = slope / outer, xi * (curvature - slope * slope / outer)
    turn = speed * t * g**3
    v_y = -speed * g
    v_yx, v_yy = turn * t_x, turn * t_y - speed_gradient * g
    v_xx, v_xy = t_x * v_y + t * v_yx, t_y * v_y + t * v_yy
    trace = v_xx + v_yy
    e_xx, e_yy, e_zz, e_xy = v_xx - trace / 3, v_yy - trace / 3, -trace / 3, (v_xy + v_yx) / 2
    return -trace, np.sqrt(2 / 3 * (e_xx**2 + e_yy**2 + e_zz**2 + 2 * e_xy**2))


def _refuse_coinciding(y: np.ndarray, height: float, scene: Scene) -> None:
    spacing = float(np.min(y[:, :-1] - y[:, 1:])) / height
    if not spacing >= _CLOSEST:
        raise ValueError(
            f"flow.entry_fraction: got {scene.flow.entry_fraction:g} with {scene.resolution.points} points; "
            f"neighbouring material points would be {spacing:.1e} of the bed's height apart, must be at least "
            f"{_CLOSEST:g}; raise flow.entry_fraction or use fewer points"
        )
