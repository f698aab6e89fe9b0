"""Along the roll width: pressure falls from the middle to the ends of the rolls, and slices are crushed apart.

Not to be mistaken for x, across the gap from roll to roll.
"""

import math
from functools import cache
from typing import Annotated, Literal, NamedTuple

import numpy as np
from pydantic import Field

from hpgr.fields import Count, Frozen, Number, default_kind, quantity


@cache  # late: a fiftieth of what a study's --help takes
def _nodes() -> tuple[np.ndarray, np.ndarray]:
    """Return nodes and weights of means over half the width."""
    nodes, weights = np.polynomial.legendre.leggauss(20)
    return (nodes + 1) / 2, weights / 2


class Slices(NamedTuple):
    """Slices of half the roll width, from its middle to its end; arrays are (slice,).

    Attributes
    ----------
    position : ndarray
        Distance of each slice from the middle over half the width, 2 z / L.
    pressure : ndarray
        Pressure there relative to that of the middle.
    share : ndarray
        Part of the product from each slice; they sum to 1.
    at_edge : ndarray of bool
        Whether the slice's product counts as edge product.
    """

    position: np.ndarray
    pressure: np.ndarray
    share: np.ndarray
    at_edge: np.ndarray


WHOLE = Slices(np.zeros(1), np.ones(1), np.ones(1), np.zeros(1, bool))  # one slice: the same pressure all along


class _RollWidth(Frozen):
    edge_share: Number = quantity(0.2, symbol="e", source="Torres & Casali 2009", example=0.2, ge=1e-3, le=0.999)
    """Part of the roll width whose product is called edge product."""
    slices: Count = quantity(4, symbol="N_z", source="ours", example=4, ge=1, le=1000)
    """Slices of the centre, and as many of the edge, that are crushed apart."""

    def cut(self, gap: float, width: float) -> Slices:
        """Return slices, as many of the centre as of the edge, with their pressure at the gap; lengths in m."""
        middles, edge = (np.arange(self.slices) + 0.5) / self.slices, self.edge_share
        position = np.concatenate([(1 - edge) * middles, 1 - edge + edge * middles])
        share = np.repeat([(1 - edge) / self.slices, edge / self.slices], self.slices)
        at_edge = np.repeat([False, True], self.slices)
        return Slices(position, self.pressure(position, gap, width), share, at_edge)


class Parabola(_RollWidth):
    """Pressure falls as 1 - pressure_drop (2 z / L)**2 at distance z from the middle (Torres & Casali 2009)."""

    kind: Literal["parabola"] = "parabola"
    pressure_drop: Number = quantity(
        0.8, symbol="kappa", source="Torres & Casali 2009 (1); fitted", example=0.8, ge=0, le=1
    )
    """Part of the pressure that is lost at the ends of the rolls."""

    def pressure(self, position, thickness, width: float):
        """Return the pressure at 2 z / L = `position` relative to the middle's; the thickness does not matter."""
        return 1 - self.pressure_drop * position**2

    def mean_pressure(self, thickness, width: float, power: float = 1.0):
        """Return the mean over the roll width of the pressure to a power, relative to the middle's; 1 - kappa / 3."""
        if power == 1:
            return 1 - self.pressure_drop / 3
        nodes, weights = _nodes()
        return weights @ (1 - self.pressure_drop * nodes**2) ** power


class FrictionHill(_RollWidth):
    """Pressure rises from the ends by friction on the rolls, p = p_c min[1, epsilon exp(2 mu (L/2 - |z|) / s)] (ours).

    s is the local thickness of the bed. The edge zone grows with the gap and not with the width. The bed is as dense
    at the ends as in the middle, so its unconfined strength is a part epsilon of the pressure there. Closed limit:
    epsilon = 1 is the same pressure all along.
    """

    kind: Literal["friction_hill"] = "friction_hill"
    edge_ratio: Number = quantity(0.2, symbol="epsilon", source="ours; fitted", example=0.2, ge=1e-6, le=1)
    """Pressure at the ends of the rolls over that of the middle."""
    friction: Number = quantity(0.4, symbol="mu", source="ours", example=0.4, ge=1e-3, le=10)
    """Coefficient of friction between bed and rolls."""

    def pressure(self, position, thickness, width: float):
        """Return the pressure at 2 z / L = `position` relative to the middle's, in a bed of this thickness, m."""
        rise = self.friction * width / thickness * (1 - position)
        return np.exp(np.minimum(rise + math.log(self.edge_ratio), 0.0))

    def mean_pressure(self, thickness, width: float, power: float = 1.0):
        """Return the mean over the roll width of the pressure to a power, relative to p_c, in beds so thick, m.

        The hill rises over the part s T / (mu L) of the width to p_c, or to what it reaches in the middle.
        """
        whole = self.friction * width / thickness  # rise in logs from the end to the middle
        rise = np.minimum(-math.log(self.edge_ratio), whole)
        top, foot = np.exp(power * (rise + math.log(self.edge_ratio))), self.edge_ratio**power
        return top * (1 - rise / whole) + (top - foot) / (power * whole)


RollWidth = Annotated[Parabola | FrictionHill, Field(discriminator="kind"), default_kind("parabola")]
