"""What a broken grain leaves: the distribution of the fragment's size over its parent's."""

from typing import Literal, NamedTuple

import numpy as np

from hpgr.fields import Frozen, Metres, Number, quantity

POWER_LAW = 0  # tag of the law in the kernels


class FragmentConstants(NamedTuple):
    """A law as the kernels take it."""

    fragments: int
    inverse_exponent: float  # 1 / gamma
    size_floor: float  # m


class PowerLawFragments(Frozen):
    """The fragment ratio X has the distribution X^gamma, 0 < X < 1.

    Closed limit: a grain that breaks until it is below s_c ends at x with the probability (x / s_c)^gamma.

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
    size_floor: Metres = quantity(
        1e-6, symbol="s_floor", unit="m", source="ours (1 um, the grinding limit)", example="1 um", ge=1e-9, le=1
    )
    """Grains below this size do not break."""

    def passing(self, ratio):
        """Return the probability of a fragment ratio of at most `ratio`, 0 to 1."""
        return np.asarray(ratio) ** self.exponent

    def quantile(self, fraction):
        """Return the fragment ratio that a share `fraction` of all fragments does not exceed."""
        return np.asarray(fraction) ** (1 / self.exponent)

    def constants(self) -> FragmentConstants:
        """Return the law as the kernels take it."""
        return FragmentConstants(POWER_LAW, 1 / self.exponent, self.size_floor)


Fragments = PowerLawFragments
