"""Along the roll width: pressure falls from the middle to the ends of the rolls, and slices are crushed apart.

Not to be mistaken for x, across the gap from roll to roll.
"""

from typing import Literal, NamedTuple

import numpy as np

from hpgr.fields import Count, Frozen, Number, quantity


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


class Parabola(Frozen):
    """Pressure falls as 1 - pressure_drop (2 z / L)**2 at distance z from the middle (Torres & Casali 2009)."""

    kind: Literal["parabola"] = "parabola"
    pressure_drop: Number = quantity(
        0.8, symbol="kappa", source="Torres & Casali 2009 (1); fitted", example=0.8, ge=0, le=1
    )
    """Part of the pressure that is lost at the ends of the rolls."""
    edge_share: Number = quantity(0.2, symbol="e", source="Torres & Casali 2009", example=0.2, ge=1e-3, le=0.999)
    """Part of the roll width whose product is called edge product."""
    slices: Count = quantity(4, symbol="N_z", source="ours", example=4, ge=1, le=1000)
    """Slices of the centre, and as many of the edge, that are crushed apart."""

    def cut(self) -> Slices:
        """Return the slices, as many of the centre as of the edge."""
        middles, edge = (np.arange(self.slices) + 0.5) / self.slices, self.edge_share
        position = np.concatenate([(1 - edge) * middles, 1 - edge + edge * middles])
        share = np.repeat([(1 - edge) / self.slices, edge / self.slices], self.slices)
        at_edge = np.repeat([False, True], self.slices)
        return Slices(position, 1 - self.pressure_drop * position**2, share, at_edge)

    def mean_pressure(self) -> float:
        """Return the mean pressure over the roll width relative to that of its middle, 1 - kappa / 3."""
        return 1 - self.pressure_drop / 3


RollWidth = Parabola
