"""Granular elasticity of the bed: state functions, limits, and the march along a streamline (paper eq. 4).

Compression is positive. The stresses derive from the energy
psi = phi^3 eps_v^c [K eps_v^2 / ((c+1)(c+2)) + 3/2 G eps_s^2] at fixed solid fraction phi, of which eq. 4 is
the Hessian when its eta is eps_s / eps_v; the paper's words have that ratio upside down.
"""

import math
from typing import NamedTuple

import numpy as np

from hpgr.flow import Motion, running_sum
from hpgr.scene import Material, Scene

_TENSION_NOISE = 1e-9  # of the peak pressure; less is rounding of the running sum


class Load(NamedTuple):
    """State of the bed at the material points; arrays are (streamline, point).

    Attributes
    ----------
    volumetric_strain, shear_strain : ndarray
        Volumetric and elastic triaxial shear strain since the onset of compaction.
    solid_fraction : ndarray
        Solid fraction, at most the material's maximum.
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


def state_pressure(eps_v, eps_s, material: Material):
    """Return p / phi^3 = K eps_v^(c+1)/(c+1) + 3/2 G c eps_v^(c-1) eps_s^2, Pa; 0 at eps_v = 0."""
    c = material.elastic_exponent
    eta = _ratio(eps_s, eps_v)
    power = _power(eps_v, c + 1)
    return power * (material.bulk_modulus / (c + 1) + 1.5 * material.shear_modulus * c * eta**2)


def state_shear(eps_v, eps_s, material: Material):
    """Return q / phi^3 = 3 G eps_v^c eps_s, Pa; 0 at eps_v = 0."""
    c = material.elastic_exponent
    return 3 * material.shear_modulus * _power(eps_v, c + 1) * _ratio(eps_s, eps_v)


def largest_shear_ratio(material: Material) -> float:
    """Return eta_max = sqrt(2 K / (3 G c (c+1))), where the energy stops being convex; inf for c <= 0."""
    c = material.elastic_exponent
    if c <= 0:
        return math.inf
    return math.sqrt(2 * material.bulk_modulus / (3 * material.shear_modulus * c * (c + 1)))


def load(scene: Scene, motion: Motion) -> Load:
    """Return stresses and strains at the material points of `motion`, marched from the onset of compaction.

    `motion` holds `scene.stress.substeps` steps per time step; the result has its points.
    """
    material = scene.material
    compacting = _compacting(motion)
    d_eps_v, d_eps_s = strain_increments(motion)
    eps_v, _ = _sum_above_zero(d_eps_v)
    eps_s, limited = _sum_below(d_eps_s, eps_v, largest_shear_ratio(material))
    phi = np.minimum(material.feed_solid_fraction * np.exp(eps_v), material.max_solid_fraction)
    if scene.stress.integrator == "increment":
        stiffness = ((phi[:, 1:] + phi[:, :-1]) / 2) ** 3
        d_p = stiffness * np.diff(state_pressure(eps_v, eps_s, material), axis=1)
        d_q = stiffness * np.diff(state_shear(eps_v, eps_s, material), axis=1)
    else:
        d_p, d_q = _euler_increments(material, motion, compacting, eps_v, eps_s, phi)
    pressure, tension = _sum_above_zero(d_p)
    shear_stress, reversal = _sum_above_zero(d_q)
    return Load(
        volumetric_strain=eps_v,
        shear_strain=eps_s,
        solid_fraction=phi,
        pressure=pressure,
        shear_stress=shear_stress,
        on_shear_limit=limited,
        continuity_solid_fraction=material.feed_solid_fraction * np.exp(eps_v[:, -1]),
        tension_clamped=(
            tension > _TENSION_NOISE * pressure.max(initial=0.0)
            or reversal > _TENSION_NOISE * shear_stress.max(initial=0.0)
            # explicit steps from zero strain miss what the state functions say there; they do so for c < 0 only
            or bool((state_pressure(eps_v, eps_s, material) < 0).any())
        ),
    )


def crushing_stress(scene: Scene, motion: Motion, state: Load) -> np.ndarray:
    """Return the stress that crushes, Pa: zero where the bed does not compact (paper eq. 1, Heaviside)."""
    stress = state.pressure
    if scene.stress.crushing == "major":
        stress = stress + 2 * state.shear_stress / 3
    return np.where(motion.volumetric_rate > 0, stress, 0.0)


def _euler_increments(material, motion, compacting, eps_v, eps_s, phi):
    """Return the increments of p and q by eq. 4 with the state at the start of each step.

    The shear rate is that of the elastic shear strain: what the convexity limit has taken as plastic loads nothing.
    """
    c, bulk, shear = material.elastic_exponent, material.bulk_modulus, material.shear_modulus
    eta = _ratio(eps_s, eps_v)
    scale = np.where(compacting, phi**3 * _power(eps_v, c), 0.0)
    scale, eta = scale[:, :-1], eta[:, :-1]
    d_v, d_s = motion.volumetric_rate[:, :-1] * motion.time_step, np.diff(eps_s, axis=1)
    d_p = scale * ((bulk + 1.5 * shear * c * (c - 1) * eta**2) * d_v + 3 * shear * c * eta * d_s)
    d_q = scale * 3 * shear * (c * eta * d_v + d_s)
    return d_p, d_q


def strain_increments(motion: Motion) -> tuple[np.ndarray, np.ndarray]:
    """Return the increments (streamline, point - 1) of volumetric and shear strain past the onset of compaction.

    By the trapezoid rule between points; of the step with the nip only what lies past it counts.
    """
    past = np.where(_compacting(motion)[:, :-1], motion.time_step / 2, 0.0)
    starts = motion.volumetric_rate[:, :-1], motion.shear_rate[:, :-1]
    if motion.onset is not None:
        past = motion.onset.fraction * (motion.time_step / 2)
        within = motion.onset.fraction < 1
        at_nip = motion.onset.volumetric_rate, motion.onset.shear_rate
        starts = (np.where(within, nip, start) for nip, start in zip(at_nip, starts, strict=True))
    ends = motion.volumetric_rate[:, 1:], motion.shear_rate[:, 1:]
    volumetric, shear = ((end + start) * past for end, start in zip(ends, starts, strict=True))
    return volumetric, shear


def _compacting(motion: Motion) -> np.ndarray:
    """Return where (streamline, point) compaction has begun."""
    return np.cumsum(motion.volumetric_rate > 0, axis=1) > 0


def _sum_above_zero(increments):
    """Return the running sums from 0 that are held at zero when they would fall below, and by how much."""
    total = running_sum(increments)
    lowest = np.minimum.accumulate(total, axis=1)
    return total - lowest, -float(lowest.min())


def _sum_below(increments, eps_v, ratio):
    """Return the running sums from 0 that are held at ratio * eps_v, and where they are held.

    min(s + d, limit) at every step is D + running minimum of (limit - D), D the plain sum.
    """
    total = running_sum(increments)
    if math.isinf(ratio):
        return total, np.zeros(total.shape, dtype=bool)
    room = ratio * eps_v - total
    lowest = np.minimum.accumulate(np.minimum(room, 0.0), axis=1)
    # where the limit is tiny beside the plain sum, rounding would carry their difference past it
    return np.clip(total + lowest, 0.0, ratio * eps_v), (room <= lowest) & (eps_v > 0)


def _ratio(eps_s, eps_v):
    """Return eta = eps_s / eps_v, 0 at eps_v = 0."""
    return np.divide(eps_s, eps_v, out=np.zeros_like(np.asarray(eps_s, dtype=float)), where=np.asarray(eps_v) > 0)


def _power(eps_v, exponent):
    """Return eps_v ** exponent; at eps_v = 0 a negative exponent counts as 0, the bed being free of stress."""
    eps_v = np.asarray(eps_v, dtype=float)
    start = np.full_like(eps_v, 1.0 if exponent == 0 else 0.0)
    return np.power(eps_v, exponent, out=start, where=eps_v > 0)
