"""When a grain breaks: strength by size, cushioned by unlike neighbours (paper eqs. 1 and 2); its scatter is ours."""

import math
from functools import lru_cache
from typing import Literal, NamedTuple

import numpy as np

from hpgr.fields import Frozen, Metres, Number, Pascals, quantity

SIZE_EFFECT = 0  # tag of the law in the kernels
_HELD = 5.0  # y of exp(-y), by which cushioning holds a grain, beyond which the kernels ask for logarithms


class StrengthConstants(NamedTuple):
    """A law as the kernels take it."""

    strength: int
    slope: float  # 3 / w
    scale: float  # 3 / w, by which effective size answers to strength; without size effect 1
    cushion: float  # 1 / (2 n^2)
    cushioned: tuple[np.float32, ...]  # see `_cushioned`
    reference_size: float  # m
    inverse_size: float  # 1 / reference_size, 1/m; without size effect 0
    scatter: float  # k


@lru_cache
def _cushioned(stiffness: float) -> tuple[np.float32, ...]:
    """Return the coefficients of a polynomial, its error and 1 / m, in float32.

    It is exp(-stiffness log(s / sbar)^2), by which cushioning multiplies the effective size, of z^2 / m from 0 to 1,
    z = (s - sbar) / (s + sbar). Beyond, grains are finer than a ninth of their neighbourhood, or hardly ever break.
    The error holds whatever the stiffness.
    """
    stiffness = min(stiffness, 1e30)  # float32 holds it; the error has long been above 1, by which nothing is decided
    most = min(math.tanh(math.sqrt(_HELD / max(stiffness, 1e-9)) / 2), 0.8) ** 2

    def exact(parts):
        return np.exp(-stiffness * (2 * np.arctanh(np.sqrt(most * parts))) ** 2)

    nodes, parts = (1 - np.cos(np.pi * (np.arange(7) + 0.5) / 7)) / 2, np.linspace(0, 1, 1001)
    terms = np.linalg.solve(np.vander(nodes, increasing=True), exact(nodes))
    wrong = 2 * np.abs(np.vander(parts, 7, increasing=True) @ terms - exact(parts)).max()
    # rounding: of the coefficients and the sum 15 times 6e-8 of its terms, and of z 3e-7, at the steepest slope
    wrong += 1e-6 * (np.abs(terms).sum() + math.sqrt(stiffness))
    return tuple(np.float32([*terms, wrong, 1 / most]))


class SizeEffectStrength(Frozen):
    """ln sigma_s = ln sigma_m - (3/w) ln(s/s_m) + (ln(s/sbar)/n)^2 / 2, sbar the mean over a cell and its neighbours.

    Bound: cushioning only strengthens, by a factor of at most exp((ln 3)^2 / (2 n^2)) for a grain among finer ones.
    Closed limit: without cushioning (n = inf) a grain breaks until it is finer than the `critical_size`. With a scatter
    sigma_s is multiplied by zeta, P(zeta > x) = exp(-x^k), drawn anew for every fragment: without cushioning a grain
    then breaks with the `chance` 1 - exp(-(s/s_c)^m), m = 3 k / w.

    Examples
    --------
    >>> from hpgr.laws.strength import SizeEffectStrength
    >>> SizeEffectStrength(reference_strength="2 MPa", cushioning=float("inf")).reference_strength
    2000000.0
    """

    kind: Literal["size_effect"] = "size_effect"
    reference_strength: Pascals = quantity(
        0.84e6,
        symbol="sigma_m",
        unit="Pa",
        source="paper section 3 (quartz, 0.84 MPa)",
        example="0.84 MPa",
        ge=1,
        le=1e15,
    )
    """Crushing strength of a grain of the reference size."""
    reference_size: Metres = quantity(
        0.06, symbol="s_m", unit="m", source="paper section 3 (60 mm)", example="60 mm", ge=1e-6, le=10
    )
    """Grain size at which the reference strength holds."""
    weibull_modulus: Number = quantity(
        3.04, symbol="w", source="paper section 3 (quartz, 3.04)", example=3, ge=1e-3, allow_inf_nan=True
    )
    """Weibull modulus of grain strength; inf: strength without size effect."""
    cushioning: Number = quantity(
        1.0, symbol="n", source="paper eq. 2; value ours", example=1, ge=1e-6, allow_inf_nan=True
    )
    """Cushioning constant: small n shields grains unlike their neighbours; inf: no cushioning."""
    scatter: Number = quantity(
        math.inf, symbol="k", source="ours (Weibull); inf: the paper", example=3, ge=0.01, allow_inf_nan=True
    )
    """Scatter of the strengths of equal grains: the smaller, the wider; w: Weibull's weakest link; inf: none."""
    stress: Literal["mean", "major"] = "mean"
    """Stress that crushes: 'mean' is p (the paper's figures), 'major' is p + 2 q / 3."""

    def crushing_stress(self, pressure, shear_stress):
        """Return the stress that crushes, from mean stress p and triaxial shear stress q, all Pa."""
        return pressure if self.stress == "mean" else pressure + 2 * shear_stress / 3

    def log_stress(self, stress):
        """Return ln(sigma_a / sigma_m) of a crushing stress in Pa; -inf, which breaks nothing, where there is none."""
        with np.errstate(divide="ignore"):
            return np.log(stress / self.reference_strength)

    def log_strength(self, sizes):
        """Return ln(sigma_s / sigma_m) of the cells of periodic lines (..., cell), m."""
        sizes = np.asarray(sizes, float)
        mean = (np.roll(sizes, 1, axis=-1) + np.roll(sizes, -1, axis=-1) + sizes) / 3
        cushion = (np.log(sizes / mean) / self.cushioning) ** 2 / 2
        return cushion - 3 / self.weibull_modulus * np.log(sizes / self.reference_size)

    def zeta(self, uniform):
        """Return the factors of scattered strength that uniform numbers in (0, 1) stand for; 1 without scatter."""
        return (-np.log(uniform)) ** (1 / self.scatter)

    def critical_size(self, log_stress):
        """Return the size in m above which grains break at ln(sigma_a / sigma_m) without cushioning; inf at -inf.

        Examples
        --------
        >>> import numpy as np
        >>> from hpgr.laws.strength import SizeEffectStrength
        >>> SizeEffectStrength(weibull_modulus=3).critical_size(np.log([1.0, 2.0, 4.0]))
        array([0.06 , 0.03 , 0.015])
        """
        with np.errstate(over="ignore"):  # a vanishing stress breaks no size: inf is the answer
            return self.reference_size * np.exp(-np.asarray(log_stress) * (self.weibull_modulus / 3))

    def chance(self, size, critical):
        """Return the probability that a grain of `size` breaks where s_c is the critical size, both m."""
        with np.errstate(over="ignore"):
            return -np.expm1(-((size / critical) ** (3 * self.scatter / self.weibull_modulus)))

    def critical_size_ratio(self, log_stress):
        """Return the least effective size over s_m that breaks at ln(sigma_a / sigma_m); inf at -inf.

        The effective size of a grain is the one that without cushioning would be as strong. Without size effect
        (w = inf) its ratio is exp(-ln(sigma_s / sigma_m)) instead.
        """
        with np.errstate(over="ignore"):
            return np.exp(-log_stress / (3 / self.weibull_modulus or 1.0))

    def constants(self) -> StrengthConstants:
        """Return the law as the kernels take it."""
        cushion = 1 / (2 * self.cushioning * self.cushioning)  # a power would raise where the product is inf
        slope, inverse_size = 3 / self.weibull_modulus, 1 / self.reference_size
        scale, inverse_size = (slope, inverse_size) if slope > 0 else (1.0, 0.0)
        cushioning = cushion, _cushioned(cushion / scale)
        return StrengthConstants(
            SIZE_EFFECT, slope, scale, *cushioning, self.reference_size, inverse_size, self.scatter
        )


Strength = SizeEffectStrength
