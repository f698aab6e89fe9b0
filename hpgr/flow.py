"""Motion of the bed: speed, material points marched backwards from the exit, strain rates (paper figure 3b, c).

Two profiles of speed. "power" is the paper's: |v| = U (1 - y/H)**m on every streamline. "nip" is that of real
machines: |v| = U from the nip down, and above it the bed keeps the feed's density, which fixes the speed by
continuity: v_y = -U cos(theta_n) X_n / X on the streamline that passes the nip at the angle theta_n.
"""

import math
from typing import NamedTuple

import numpy as np

from hpgr.geometry import Geometry
from hpgr.scene import Scene

_PANELS = 64  # 5-point Gauss on 64 panels: travel times to 1e-13 for every entry_fraction down to 1e-9
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(5)
_NODES, _WEIGHTS = (_NODES + 1) / 2, _WEIGHTS / 2
_CLOSEST = 1e-9  # spacing of points, as a fraction of the bed's height, below which they are one point


class Onset(NamedTuple):
    """Where compaction begins between two points: at the nip.

    Attributes
    ----------
    fraction : ndarray
        (streamline, point - 1) part of each step that lies past the nip, 0 to 1.
    volumetric_rate, shear_rate : ndarray
        (streamline, 1) rates just past the nip, 1/s.
    """

    fraction: np.ndarray
    volumetric_rate: np.ndarray
    shear_rate: np.ndarray


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
    onset : Onset or None
        The nip of the profile "nip"; None where compaction begins gradually.
    """

    x: np.ndarray
    y: np.ndarray
    residence_time: np.ndarray
    speed: np.ndarray
    volumetric_rate: np.ndarray
    shear_rate: np.ndarray
    time_step: float
    onset: Onset | None = None


class Gradient(NamedTuple):
    """Velocity gradient in units of U/H: v_xy is the change of v_x with y."""

    v_xx: np.ndarray
    v_xy: np.ndarray
    v_yx: np.ndarray
    v_yy: np.ndarray

    def rates(self) -> tuple[np.ndarray, np.ndarray]:
        """Return volumetric (compaction positive) and triaxial shear strain rates of the plane flow."""
        e_xx, e_yy, e_zz, e_xy = self._deviator()
        return -(self.v_xx + self.v_yy), np.sqrt(2 / 3 * (e_xx**2 + e_yy**2 + e_zz**2 + 2 * e_xy**2))

    def across(self, slope: np.ndarray) -> np.ndarray:
        """Return n.(-e').n / eps_s rate, n normal to a streamline of dx/dy = `slope`: 1 in uniaxial compaction.

        With stress and strain rate coaxial the normal stress there is p + 2 q / 3 times this.
        """
        e_xx, e_yy, _, e_xy = self._deviator()
        _, shear = self.rates()
        normal = (e_xx - 2 * slope * e_xy + slope**2 * e_yy) / (1 + slope**2)
        return np.divide(-normal, shear, out=np.zeros_like(normal), where=shear > 0)

    def _deviator(self):
        third = (self.v_xx + self.v_yy) / 3
        return self.v_xx - third, self.v_yy - third, -third, (self.v_xy + self.v_yx) / 2


def nip_height(scene: Scene, geometry: Geometry) -> float:
    """Return the height of the nip above the minimum gap, R sin(alpha), m; the whole bed's for profile "power"."""
    if scene.flow.profile == "power":
        return geometry.height
    return min(geometry.radius * math.sin(nip_angle(scene)), geometry.height)


def nip_angle(scene: Scene) -> float:
    """Return the nip angle alpha of profile "nip", as given or from the cake's solid fraction, rad.

    From continuity between nip and gap, phi_feed (s_b + D (1 - cos alpha)) cos alpha = phi_cake s_b
    (Torres & Casali 2009).

    Examples
    --------
    >>> import hpgr
    >>> from hpgr.flow import nip_angle
    >>> cake = {"flow.nip_angle": None, "flow.cake_solid_fraction": 0.84}
    >>> round(nip_angle(hpgr.presets.khd_pilot().with_values(cake)), 3)
    0.16
    """
    if scene.flow.nip_angle is not None:
        return scene.flow.nip_angle
    gap, diameter = scene.rolls.gap, scene.rolls.diameter
    ratio = scene.flow.cake_solid_fraction / scene.material.feed_solid_fraction
    return math.acos(
        ((gap + diameter) + math.sqrt((gap + diameter) ** 2 - 4 * gap * diameter * ratio)) / (2 * diameter)
    )


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
    unit_time = geometry.height / surface_speed
    nipped = scene.flow.profile == "nip"
    lay = _lay_nip if nipped else _lay_power
    y, depth, relative_speed, duration = lay(scene, geometry, points)
    _refuse_coinciding(y, geometry.height, scene)
    volumetric, shear = velocity_gradient(scene, geometry, y, depth).rates()
    if nipped:
        volumetric[y > nip_height(scene, geometry)] = 0.0  # by construction; what is left is rounding
    steps = np.arange(points) / (points - 1)
    motion = Motion(
        x=geometry.xi[:, None] * geometry.outer(y),
        y=y,
        residence_time=steps * (duration * unit_time),
        speed=surface_speed * relative_speed,
        volumetric_rate=volumetric / unit_time,
        shear_rate=shear / unit_time,
        time_step=duration * unit_time / (points - 1),
    )
    return motion._replace(onset=_onset(scene, geometry, motion)) if nipped else motion


def _lay_power(scene: Scene, geometry: Geometry, points: int):
    """Return heights (streamline, point), depth fractions, speeds over U, and the residence time in units of H/U.

    Heights are carried as depth fractions f = 1 - y/H = exp(-lam): v is a power of f, and marching in lam stays
    exact however close the entry comes to the stagnation point at f = 0.
    """
    exponent = scene.flow.exponent

    def slowness(xi, lam):
        slope = xi * geometry.slope(-geometry.height * np.expm1(-lam))
        return np.sqrt(1 + slope * slope) * np.exp((exponent - 1) * lam)

    edges = np.linspace(0.0, -np.log(scene.flow.entry_fraction), _PANELS + 1)
    lam, duration = _march_back(geometry.xi, slowness, edges, points)
    depth = np.exp(-lam)
    return -geometry.height * np.expm1(-lam), depth, depth**exponent, duration


def _lay_nip(scene: Scene, geometry: Geometry, points: int):
    """Return the same for profile "nip"; panels end at the nip, where the speed has a kink."""
    height, nip = geometry.height, nip_height(scene, geometry)
    wide = geometry.outer(nip)
    # high enough, on the mid-plane, that in the same time no tube begins below the nip, already compacted
    top = max(height * (1 - scene.flow.entry_fraction), nip * math.hypot(1, geometry.slope(nip)))

    def slowness(xi, place):
        y = place * height
        slope = xi * geometry.slope(np.minimum(y, nip))
        steep = np.sqrt(1 + slope * slope)
        return steep * np.where(y <= nip, 1.0, geometry.outer(y) / wide)

    half = _PANELS // 2
    edges = np.concatenate([np.linspace(0.0, nip, half + 1), np.linspace(nip, top, half + 1)[1:]]) / height
    place, duration = _march_back(geometry.xi, slowness, edges, points)
    y = height * place
    slope, own = geometry.xi[:, None] * geometry.slope(nip), geometry.xi[:, None] * geometry.slope(y)
    above = np.sqrt((1 + own * own) / (1 + slope * slope)) * wide / geometry.outer(y)
    return y, 1 - place, np.where(y <= nip, 1.0, above), duration


def _march_back(xi: np.ndarray, slowness, edges: np.ndarray, points: int):
    """Return the place of every point (streamline, point), and the residence time, in units of H/U.

    The travel time from the exit, the integral of slowness(xi, place) over the place, is tabulated between `edges`,
    and each point's place follows by Newton's method inside its panel.
    """
    lines, panels = xi[:, None], np.diff(edges)

    def travel(xi, start, length):
        return length * (slowness(xi[..., None], start[..., None] + length[..., None] * _NODES) @ _WEIGHTS)

    def table(xi):
        return running_sum(travel(xi, edges[:-1], panels))

    duration = table(np.zeros((1, 1)))[0, -1]
    wanted = duration * (np.arange(points - 1, -1, -1) / (points - 1))
    known = table(lines)
    start = np.stack([np.searchsorted(row, wanted, side="right") - 1 for row in known]).clip(0, panels.size - 1)
    start_time = np.take_along_axis(known, start, axis=1)
    panel_time = np.take_along_axis(known, start + 1, axis=1) - start_time
    base = edges[start]
    length = panels[start] * (wanted - start_time) / panel_time
    for _ in range(4):  # the linear guess is within 1e-2 of a panel; each pass squares the error
        length = length - (start_time + travel(lines, base, length) - wanted) / slowness(lines, base + length)
    return base + length, duration


def running_sum(increments: np.ndarray) -> np.ndarray:
    """Return the sums (line, k + 1) of the first 0 to k increments; np.pad would cost five times the sum."""
    total = np.zeros((increments.shape[0], increments.shape[1] + 1))
    np.cumsum(increments, axis=1, out=total[:, 1:])
    return total


def velocity_gradient(scene: Scene, geometry: Geometry, y: np.ndarray, depth: np.ndarray) -> Gradient:
    """Return the analytic velocity gradient, in units of U/H.

    Parameters
    ----------
    scene : Scene
        Its `flow` is the speed profile.
    geometry : Geometry
        The bed; its xi label the rows of `y`.
    y, depth : ndarray
        (streamline, point) heights in m and depth fractions 1 - y/H.

    Notes
    -----
    The velocity follows the streamline x = xi X(y); its direction varies with x at fixed y because xi does.
    Formulas: model page, sections Flow and Real machines; tested against finite differences of the velocity.
    """
    xi, height = geometry.xi[:, None], geometry.height
    outer, slope, curvature = geometry.outer(y), geometry.slope(y), geometry.curvature(y)
    t = xi * slope
    t_x, t_y = slope / outer, xi * (curvature - slope * slope / outer)
    nip = nip_height(scene, geometry)
    v_y, v_yx, v_yy = _fall(scene, height, depth, t, t_x, t_y)
    if scene.flow.profile == "nip":
        kept = _kept_fall(geometry, xi, outer, slope, nip)
        v_y, v_yx, v_yy = (np.where(y <= nip, a, b) for a, b in zip((v_y, v_yx, v_yy), kept, strict=True))
    return Gradient(t_x * v_y + t * v_yx, t_y * v_y + t * v_yy, v_yx, v_yy)


def _fall(scene: Scene, height: float, depth, t, t_x, t_y):
    """Return v_y and its derivatives by x and y where |v| is a function of depth, times 1/U and H/U."""
    exponent = scene.flow.exponent if scene.flow.profile == "power" else 0.0
    g = 1 / np.sqrt(1 + t * t)
    speed = height * depth**exponent
    speed_gradient = -exponent * depth ** (exponent - 1) if exponent else 0.0
    turn = speed * t * g**3
    return -speed * g, turn * t_x, turn * t_y - speed_gradient * g


def _kept_fall(geometry: Geometry, xi, outer, slope, nip: float):
    """Return the same above the nip, where the bed keeps its density: v_y = -U g_n(xi) X_n / X."""
    steep, wide = geometry.slope(nip), geometry.height * geometry.outer(nip)
    g = 1 / np.sqrt(1 + (xi * steep) ** 2)
    g_xi = -xi * steep**2 * g**3
    return -wide * g / outer, -wide * g_xi / outer**2, wide * slope / outer**2 * (g + xi * g_xi)


def _onset(scene: Scene, geometry: Geometry, motion: Motion) -> Onset:
    """Return how much of each step lies past the nip, and the rates just past it."""
    nip = np.full((geometry.xi.size, 1), nip_height(scene, geometry))
    unit_time = geometry.height / (scene.rolls.speed * geometry.radius)
    volumetric, shear = velocity_gradient(scene, geometry, nip, 1 - nip / geometry.height).rates()
    # below the nip |v| = U, so time is arc length over U; the chord of a step is 1e-6 short of its arc
    x_nip = geometry.xi[:, None] * geometry.outer(nip)
    arc = np.hypot(motion.x[:, 1:] - x_nip, motion.y[:, 1:] - nip)
    whole = motion.speed[:, 1:] * motion.time_step
    fraction = np.where(
        motion.y[:, :-1] <= nip, 1.0, np.where(motion.y[:, 1:] < nip, np.minimum(arc / whole, 1.0), 0.0)
    )
    return Onset(fraction, volumetric / unit_time, shear / unit_time)


def _refuse_coinciding(y: np.ndarray, height: float, scene: Scene) -> None:
    spacing = float(np.min(y[:, :-1] - y[:, 1:])) / height
    if not spacing >= _CLOSEST:
        raise ValueError(
            f"flow.entry_fraction: got {scene.flow.entry_fraction:g} with {scene.resolution.points} points; "
            f"neighbouring material points would be {spacing:.1e} of the bed's height apart, must be at least "
            f"{_CLOSEST:g}; raise flow.entry_fraction or use fewer points"
        )
