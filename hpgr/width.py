"""Along the roll width: pressure falls from the middle to the ends of the rolls, and slices are crushed apart.

Not to be mistaken for x, across the gap from roll to roll.
"""

from typing import NamedTuple

import numpy as np

from hpgr.scene import Scene


class Slices(NamedTuple):
    """Slices of half the roll width, from its middle to its end; arrays are (slice,).

    Attributes
    ----------
    position : ndarray
        Distance of each slice from the middle over half the width, 2 z / L.
    pressure : ndarray
        Pressure there relative to that of the middle, 1 - kappa (2 z / L)**2 (model page, Real machines).
    share : ndarray
        Part of the product from each slice; they sum to 1.
    at_edge : ndarray of bool
        Whether the slice's product counts as edge product.
    """

    position: np.ndarray
    pressure: np.ndarray
    share: np.ndarray
    at_edge: np.ndarray


def slices_of(scene: Scene) -> Slices:
    """Return the slices of `scene`: as many of the centre as of the edge, or a single one for the whole width."""
    wishes = scene.roll_width
    if wishes is None:
        return Slices(np.zeros(1), np.ones(1), np.ones(1), np.zeros(1, bool))
    middles, edge = (np.arange(wishes.slices) + 0.5) / wishes.slices, wishes.edge_share
    position = np.concatenate([(1 - edge) * middles, 1 - edge + edge * middles])
    share = np.repeat([(1 - edge) / wishes.slices, edge / wishes.slices], wishes.slices)
    at_edge = np.repeat([False, True], wishes.slices)
    return Slices(position, 1 - wishes.pressure_drop * position**2, share, at_edge)


def mean_pressure(scene: Scene) -> float:
    """Return the mean pressure over the roll width relative to that of its middle, 1 - kappa / 3."""
    return 1.0 if scene.roll_width is None else 1 - scene.roll_width.pressure_drop / 3
