"""How the bed is loaded: granular elasticity (paper eq. 4). Compression is positive."""

import math
from typing import Literal, NamedTuple

import numpy as np

from hpgr.fields import Count, Frozen, Number, Pascals, quantity


class ElasticConstants(NamedTuple):
    """A law as the kernels take it."""

    euler: bool
    largest_shear_ratio: float
    bulk_modulus: float  # Pa
    shear_modulus: float  # Pa
    exponent: float
    densification: float


class GranularElasticity(Frozen):
    """Stresses that derive from psi = phi^3 eps_v^c [K eps_v^2 / ((c+1)(c+2)) + 3/2 G eps_s^2] at fixed phi.

    Eq. 4 of the paper is the Hessian of psi when its eta is eps_s / eps_v; the paper's words have that ratio upside
    down. Bound: psi is convex up to `largest_shear_ratio`; shear beyond it is taken as plastic. Closed limit: at
    constant phi any path adds up to `stiffness` times the state functions. Densification and recovery are ours, for
    real machines; without them the law is the paper's.
    """

    kind: Literal["granular"] = "granular"
    bulk_modulus: Pascals = quantity(
        28.3e6, symbol="K", unit="Pa", source="paper section 3 (Fontainebleau sand)", example="28.3 MPa", ge=1, le=1e15
    )
    """Scaling of the bed's bulk modulus."""
    shear_modulus: Pascals = quantity(
        13.1e6, symbol="G", unit="Pa", source="paper section 3 (Fontainebleau sand)", example="13.1 MPa", ge=1, le=1e15
    )
    """Scaling of the bed's shear modulus."""
    exponent: Number = quantity(0.5, symbol="c", source="paper eq. 4; value ours (Hertz)", example=0.5, gt=-1, le=10)
    """Pressure sensitivity of granular elasticity."""
    densification: Number = quantity(0.0, symbol="k_d", source="ours (0, the paper; 3 fitted)", example=3, ge=0, le=4)
    """How the bed stiffens as pores close: phi^3 gains [(1 - phi_feed/phi_max) / (1 - phi/phi_max)]^k_d."""
    recovery_modulus: Pascals | None = quantity(
        None, symbol="E_r", unit="Pa", source="ours (none; 3.3 GPa fitted)", example="3.3 GPa", ge=1e7, le=1e15
    )
    """Modulus of the cake past the gap, which follows the rolls apart until its stress is gone; None: it does not."""
    integrator: Literal["increment", "euler"] = "increment"
    """'increment': increments of the state functions, exact at constant solid fraction (ours); 'euler': the paper's
    explicit rule.
    """
    substeps: Count = quantity(1, symbol="k", source="ours", example=1, ge=1, le=10_000)
    """Stress steps per time step."""

    def pressure(self, eps_v, eps_s):
        """Return p / phi^3 = K eps_v^(c+1)/(c+1) + 3/2 G c eps_v^(c-1) eps_s^2, Pa; 0 at eps_v = 0."""
        c, eta = self.exponent, _ratio(eps_s, eps_v)
        return _power(eps_v, c + 1) * (self.bulk_modulus / (c + 1) + 1.5 * self.shear_modulus * c * eta**2)

    def shear_stress(self, eps_v, eps_s):
        """Return q / phi^3 = 3 G eps_v^c eps_s, Pa; 0 at eps_v = 0."""
        return 3 * self.shear_modulus * _power(eps_v, self.exponent + 1) * _ratio(eps_s, eps_v)

    def tangent(self, eps_v, eps_s):
        """Return the moduli of eq. 4 over phi^3, Pa: dp/d eps_v, dp/d eps_s = dq/d eps_v, dq/d eps_s."""
        c, shear, eta = self.exponent, self.shear_modulus, _ratio(eps_s, eps_v)
        scale = _power(eps_v, c)
        return (
            scale * (self.bulk_modulus + 1.5 * shear * c * (c - 1) * eta**2),
            scale * 3 * shear * c * eta,
            scale * 3 * shear,
        )

    def stiffness(self, phi, feed_solid_fraction: float, max_solid_fraction: float):
        """Return what state functions and moduli are multiplied by: phi^3, and what it gains as pores close."""
        closing = (1 - feed_solid_fraction / max_solid_fraction) / (1 - phi / max_solid_fraction)
        return phi**3 * closing**self.densification

    def densest(self, max_solid_fraction: float) -> float:
        """Return the solid fraction beyond which nothing can be pressed."""
        return max_solid_fraction if self.densification > 0 else 1.0

    def recovering_force(self, normal: float, gap: float, radius: float) -> float:
        """Return the force per width past the gap of a cake pressed to the stress `normal` there, N/m.

        Stress falls linearly with the strain over the angle theta, theta^2 = s_b normal / (E_r R): 2/3 R theta normal.
        """
        if self.recovery_modulus is None or normal <= 0:
            return 0.0
        return 2 / 3 * math.sqrt(gap * radius * normal / self.recovery_modulus) * normal

    def recovered_energy(self, normal: float) -> float:
        """Return the energy that such a cake gives back to the rolls per volume, J/m3."""
        return 0.0 if self.recovery_modulus is None else normal * normal / (2 * self.recovery_modulus)

    def largest_shear_ratio(self) -> float:
        """Return eta_max = sqrt(2 K / (3 G c (c+1))), where the energy stops being convex; inf for c <= 0."""
        c = self.exponent
        return math.sqrt(2 * self.bulk_modulus / (3 * self.shear_modulus * c * (c + 1))) if c > 0 else math.inf

    def constants(self) -> ElasticConstants:
        """Return the law as the kernels take it."""
        moduli = self.bulk_modulus, self.shear_modulus, self.exponent, self.densification
        return ElasticConstants(self.integrator == "euler", self.largest_shear_ratio(), *moduli)


def _ratio(eps_s, eps_v):
    """Return eta = eps_s / eps_v, 0 at eps_v = 0."""
    eps_s, eps_v = np.asarray(eps_s, float), np.asarray(eps_v, float)
    return np.divide(eps_s, eps_v, out=np.zeros(np.broadcast(eps_s, eps_v).shape), where=eps_v > 0)


def _power(eps_v, exponent):
    """Return eps_v ** exponent; at eps_v = 0 a negative exponent counts as 0, the bed being free of stress."""
    eps_v = np.asarray(eps_v, float)
    start = np.full_like(eps_v, 1.0 if exponent == 0 else 0.0)
    return np.power(eps_v, exponent, out=start, where=eps_v > 0)


Elasticity = GranularElasticity
