"""Segregation and mixing: how often cells swap across an edge between material points (paper eq. 3; closure ours).

Eq. 3 gives f = l / (rho_b V) (F . n). With F = rho_b [A gammadot (s - sbar) up - B gammadot sbar^2 grad] and one
parcel mass m = rho_b V for all, a cell of size s below an edge rises over it at l rho_b A gammadot n_y (s - sbar)+ / m,
one above it sinks at the same with (sbar - s)+, and cells mix at l rho_b B gammadot sbar^2 / (d m) both ways.
sbar is the mean size of the parcel, the local mean of its mixture.

Under percolation "shear" each rate is proportional to the shear rate and so to roll speed, as is everything else:
probabilities per time step do not depend on speed. Under "gravity" no grain percolates faster than it falls between
its neighbours, sqrt(g sbar): the one place where speed enters. Its closed limit at low shear rate is "shear".
"""

import math
from typing import Literal

from hpgr.fields import Count, Frozen, Number, quantity

_G = 9.81  # m s-2


class Exchange(Frozen):
    """Segregation and mixing between neighbouring material points, by swaps of cells.

    `sheared` is edge length l x shear rate gammadot x time step x solid fraction, m; `parcel` the mass of a parcel
    over the density of the grains, m2.

    Examples
    --------
    >>> import hpgr
    >>> hpgr.presets.paper().with_values({"exchange": hpgr.Exchange(mixing=0)}).exchange.segregation
    0.1
    """

    segregation: Number = quantity(0.1, symbol="A", source="ours", example=0.1, ge=0, le=100)
    """Percolation velocity over shear rate and size difference: large grains rise, small ones sink."""
    mixing: Number = quantity(0.1, symbol="B", source="ours", example=0.1, ge=0, le=100)
    """Shear-induced self-diffusion over shear rate and mean size squared."""
    percolation: Literal["shear", "gravity"] = "shear"
    """What limits percolation: the shear rate alone, or also how fast gravity lets a grain fall."""
    interval: Count = quantity(20, symbol="n_s", source="ours", example=20, ge=1, le=1_000_000)
    """Time steps between snapshots."""
    startup: Literal["feed", "crushed"] | None = None
    """Records the start-up, before the steady snapshots, of a machine full of 'feed', or of the bed as 'crushed'."""

    def ceiling(self, shear_rate):
        """Return c = A gammadot / sqrt(g) of v = A gammadot |s - sbar| / (1 + c |s - sbar| / sqrt(sbar)), m^-1/2.

        It is 0 where percolation has no ceiling.
        """
        return self.segregation * shear_rate / math.sqrt(_G) if self.percolation == "gravity" else 0.0 * shear_rate

    def rising(self, sheared, upward, parcel):
        """Return the probability per time step and m of size difference that a cell rises over an edge, 1/m.

        `upward` is the vertical part of the edge's unit normal.
        """
        return self.segregation * sheared * upward / parcel

    def diffusion(self, sheared, distance, parcel):
        """Return the probability per time step and squared mean size that two cells mix across an edge, 1/m2.

        `distance` is that of the two points in m.
        """
        return self.mixing * sheared / (distance * parcel)
