"""How the bed moves: the speed along a streamline (paper section 2.2; profile of real machines ours).

The velocity has the direction of the streamline everywhere. A profile gives its vertical component, from which the
compiled bed (hpgr/bed/kernels.py) takes speed, travel time and strain rates.
"""

import math
from collections.abc import Iterator
from typing import Annotated, Any, Literal, NamedTuple, Self

import numpy as np
from pydantic import Field

from hpgr.fields import Fault, Frozen, Number, Radians, default_kind, quantity

POWER, NIP = 0, 1  # tags of the profiles in the kernels
LEAST_NIP_ANGLE = 1e-3  # rad


class FlowConstants(NamedTuple):
    """A profile as the kernels take it; `nip_angle` is 0 where compaction begins gradually, below a stagnant entry."""

    law: int
    entry_fraction: float
    nip_angle: float = 0.0  # rad
    exponent: float = 0.0
    slip: float = 0.0


class _Profile(Frozen):
    entry_fraction: Number = quantity(0.02, symbol="y_0/H", source="ours", example=0.02, ge=1e-9, lt=1)
    """Depth of the first material point as a fraction of the bed's height (v = 0 at depth 0); less near a nip."""

    def held(self, gap: float, diameter: float, feed_solid_fraction: float) -> Self:
        """Return the profile with what is held while the gap floats; by default nothing."""
        return self

    def narrowest_gap(self, diameter: float, feed_solid_fraction: float, densest: float) -> tuple[float, str]:
        """Return the gap to which the held profile reaches down, m, and what is below it; by default any gap is."""
        return 0.0, ""

    def widest_gap(self, diameter: float, entry_gap: float) -> float:
        """Return the largest gap at which the held profile leaves a bed, m."""
        return entry_gap * (1 - 1e-9)


class PowerFlow(_Profile):
    """Speed |v| = U (1 - y/H)**exponent on every streamline (the paper's; m = 1 is its linear law).

    Bound: v = 0 at the entry is a stagnation point, so the bed begins at the depth `entry_fraction`. Closed limit:
    at m = 1 the mid-plane is travelled in T = (H/U) ln(1 / entry_fraction).
    """

    kind: Literal["power"] = "power"
    exponent: Number = quantity(1.0, symbol="m", source="paper section 2.2", example=1, ge=0.01, le=5)
    """Exponent of the speed profile; 1 is the paper's linear law."""

    def vertical_speed(self, depth, slope):
        """Return |v_y| / U at the depth fraction 1 - y/H, where the streamline has the slope dx/dy."""
        return depth**self.exponent / np.sqrt(1 + slope * slope)

    def constants(self, gap: float, diameter: float, feed_solid_fraction: float) -> FlowConstants:
        """Return the profile as the kernels take it; it does not depend on the arguments."""
        return FlowConstants(POWER, self.entry_fraction, exponent=self.exponent)


class NipFlow(_Profile):
    """The rolls carry the bed from the nip down, and it keeps the feed's density above (real machines).

    The nip lies at the height y_n = R sin(alpha). Below it |v| = U [1 - slip (y/y_n)^2]; above it continuity fixes
    the vertical speed on a streamline that passes the nip with the slope t_n: |v_y| = U (1 - slip) (1 + t_n^2)^(-1/2)
    X_n / X, X the half width of the bed. Closed limit: without slip |v| = U below the nip, and the volumetric strain is
    the logarithm of the tube's density ratio. Bound: see `densest_ratio`.

    Source: nip and cake of Torres & Casali, Minerals Engineering 22 (2009) 1137-1146; speeds ours.
    """

    kind: Literal["nip"] = "nip"
    nip_angle: Radians | None = quantity(
        None, symbol="alpha", unit="rad", source="machine and ore", example="9 deg", ge=LEAST_NIP_ANGLE, lt=math.pi / 3
    )
    """Nip angle: where the rolls grip the bed."""
    cake_solid_fraction: Number | None = quantity(
        None, symbol="phi_cake", source="Torres & Casali 2009", example=0.85, gt=0, le=1
    )
    """Solid fraction of the pressed cake, from which the nip angle follows."""

    slip: Number = quantity(0.0, symbol="lambda", source="ours (0; 0.33 fitted)", example=0.33, ge=0, le=0.9)
    """Part of the rolls' speed by which the bed lags behind them at the nip."""

    @classmethod
    def _impossible(cls, known: dict[str, Any]) -> Iterator[Fault]:
        names = ("nip_angle", "cake_solid_fraction")
        given = [name for name in names if known.get(name) is not None]
        if len(given) != 1 and known.keys() >= set(names):
            bound = "must be one of nip_angle and cake_solid_fraction with kind 'nip'"
            yield Fault(
                names[0], " and ".join(given) or "nothing", bound, "give one, such as cake_solid_fraction = 0.85"
            )

    def vertical_speed(self, height, slope, half_width, nip_slope, nip_half_width):
        """Return |v_y| / U at the height y/y_n, where the streamline has the slope dx/dy and the bed a half width.

        `nip_slope` and `nip_half_width` are those of the streamline and of the bed at the nip.
        """
        kept = (1 - self.slip) * nip_half_width / half_width / np.sqrt(1 + nip_slope * nip_slope)
        return np.where(np.real(height) > 1, kept, (1 - self.slip * height * height) / np.sqrt(1 + slope * slope))

    def angle(self, gap: float, diameter: float, feed_solid_fraction: float) -> float:
        """Return the nip angle, as given or from the cake's solid fraction, rad."""
        if self.nip_angle is not None:
            return self.nip_angle
        return cake_nip_angle(gap, diameter, self.cake_solid_fraction / feed_solid_fraction, self.slip)

    def narrowest_gap(self, diameter: float, feed_solid_fraction: float, densest: float) -> tuple[float, str]:
        """Return the gap at which the nip angle given makes a cake as dense as can be, m, and what is below it."""
        kept = (1 - self.slip) * feed_solid_fraction / densest * math.cos(self.nip_angle)
        gap = kept * diameter * (1 - math.cos(self.nip_angle)) / (1 - kept) if kept < 1 else math.inf
        return gap, "the cake would be denser than " + ("rock" if densest == 1 else f"max_solid_fraction {densest:g}")

    def widest_gap(self, diameter: float, entry_gap: float) -> float:
        """Return the gap at which the nip angle given reaches the top of the bed, m."""
        return entry_gap - diameter * (1 - math.cos(self.nip_angle))

    def held(self, gap: float, diameter: float, feed_solid_fraction: float) -> Self:
        """Return the profile with what is held while the gap floats: its nip angle at this gap."""
        held = {"nip_angle": self.angle(gap, diameter, feed_solid_fraction), "cake_solid_fraction": None}
        return self if self.cake_solid_fraction is None else self.model_copy(update=held)

    def constants(self, gap: float, diameter: float, feed_solid_fraction: float) -> FlowConstants:
        """Return the profile as the kernels take it."""
        return FlowConstants(NIP, self.entry_fraction, self.angle(gap, diameter, feed_solid_fraction), slip=self.slip)


def cake_nip_angle(gap: float, diameter: float, ratio: float, slip: float = 0.0) -> float:
    """Return the nip angle of a cake `ratio` times as dense as the feed, at most `densest_ratio`, rad.

    From continuity between nip and gap, (1 - slip) (s_b + D (1 - cos alpha)) cos alpha = ratio s_b (Torres & Casali
    2009, without slip).
    """
    room = max((gap + diameter) ** 2 - 4 * gap * diameter * ratio / (1 - slip), 0.0)
    return math.acos(min(((gap + diameter) + math.sqrt(room)) / (2 * diameter), 1.0))


def densest_ratio(gap: float, diameter: float, slip: float = 0.0) -> float:
    """Return the largest density of cake over feed that any nip angle makes."""
    return (1 - slip) * (gap + diameter) ** 2 / (4 * gap * diameter)


Flow = Annotated[PowerFlow | NipFlow, Field(discriminator="kind"), default_kind("power")]
