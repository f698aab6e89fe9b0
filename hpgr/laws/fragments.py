"""What a broken grain leaves: the distribution of the fragment's size over its parent's."""

from typing import Literal, NamedTuple

import numpy as np

from hpgr.fields import Frozen, Metres, Number, quantity

POWER_LAW = 0  # tag of the law in the kernels
HELD = 0.05, 5.0  # where exponents that depend on the parent stay


class FragmentConstants(NamedTuple):
    """A law as the kernels take it."""

    fragments: int
    inverse_exponent: float | None  # 1 / gamma; None where fragments are uniform
    size_exponent: float  # nu
    parent_size: float  # s_r, m
    size_floor: float  # m; up to the next float32, as which sizes are compared with it


class PowerLawFragments(Frozen):
    """The fragment ratio X has the distribution X^gamma, 0 < X < 1; of a parent of size s, gamma(s) = gamma (s/s_r)^nu.

    Bound: where nu is not 0, gamma(s) is held within 0.05 to 5.

    Closed limit: with nu = 0, a grain that breaks until it is below s_c ends at x with the probability (x / s_c)^gamma.

    Examples
    --------
    >>> from hpgr.laws.fragments import PowerLawFragments
    >>> law = PowerLawFragments(exponent=0.5)
    >>> float(law.passing(0.25)), float(law.quantile(0.5))
    (0.5, 0.25)
    """

    kind: Literal["power_law"] = "power_law"
    exponent: Number = quantity(1.0, symbol="gamma", source="ours (uniform)", example=1, ge=1e-3, le=1e6)
    """Exponent of the fragment ratio: 1 is uniform, 0.3 to 0.4 usual in packed beds; 3 - fractal dimension."""
    size_exponent: Number = quantity(0.0, symbol="nu", source="ours; 0: the paper", example=0.7, ge=-5, le=5)
    """How the exponent grows with the size of the parent: above 0 coarse grains leave coarse fragments."""
    reference_size: Metres = quantity(0.06, symbol="s_r", unit="m", source="ours", example="60 mm", ge=1e-6, le=10)
    """Size of the parent at which the exponent holds."""
    size_floor: Metres = quantity(
        1e-6, symbol="s_floor", unit="m", source="ours (1 um, the grinding limit)", example="1 um", ge=1e-9, le=1
    )
    """Grains below this size do not break."""

    def exponent_of(self, size):
        """Return gamma(s) of parents of these sizes, m."""
        if self.size_exponent == 0:
            return np.full(np.shape(size), self.exponent)
        return np.clip(self.exponent * (np.asarray(size) / self.reference_size) ** self.size_exponent, *HELD)

    def passing(self, ratio, size=0.06):
        """Return the probability of a fragment ratio of at most `ratio`, 0 to 1, of parents of `size`, m."""
        return np.asarray(ratio) ** self.exponent_of(size)

    def quantile(self, fraction, size=0.06):
        """Return the fragment ratio that a share `fraction` of the fragments of parents of `size` does not exceed."""
        return np.asarray(fraction) ** (1 / self.exponent_of(size))

    def constants(self) -> FragmentConstants:
        """Return the law as the kernels take it."""
        inverse = None if self.exponent == 1 and self.size_exponent == 0 else 1 / self.exponent
        floor = np.float32(self.size_floor)
        floor = floor if float(floor) >= self.size_floor else np.nextafter(floor, np.float32(np.inf))
        return FragmentConstants(POWER_LAW, inverse, self.size_exponent, self.reference_size, float(floor))


Fragments = PowerLawFragments
