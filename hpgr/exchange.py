"""Segregation and mixing: swap rates on the edges between material points (paper eq. 3, closure ours).

Eq. 3 gives f = l / (rho_b V) (F . n). With F = rho_b [A gammadot (s - sbar) up - B gammadot sbar^2 grad] and one
parcel mass m = rho_b V for all, a cell of size s below an edge rises over it at l rho_b A gammadot n_y (s - sbar)+ / m,
one above it sinks at the same with (sbar - s)+, and cells mix at l rho_b B gammadot sbar^2 / (d m) both ways.
sbar is the mean size of the parcel, the local mean of its mixture.

Each rate is proportional to the shear rate and so to roll speed, as is everything else: probabilities per time step
do not depend on speed.
"""

from typing import NamedTuple

import numpy as np

from hpgr.flow import Motion
from hpgr.scene import Scene
from hpgr.stress import Load
from hpgr.tessellation import Tessellation

LARGEST_SUM = 0.5  # of the swap probabilities of a cell in one pass; above it swaps overshoot their equilibrium
MOST_PASSES = 1000  # per time step; a scene that needs more is refused
_SECONDS_PER_EDGE = 1e-8  # of one pass over an edge without swaps


class SwapRates(NamedTuple):
    """Probabilities of a swap per time step and edge, before the sizes are known.

    Attributes
    ----------
    pairs : ndarray
        (edge, 2) numbers of the points below and above, streamline by streamline.
    rise : ndarray
        (edge,) probability of segregation per m of size difference, 1/m.
    mixing : ndarray
        (edge,) probability of mixing per squared mean size, 1/m2.
    """

    pairs: np.ndarray
    rise: np.ndarray
    mixing: np.ndarray


def swap_rates(scene: Scene, motion: Motion, state: Load, cells: Tessellation) -> SwapRates:
    """Return the swap rates on the edges of a tessellation, per time step."""
    exchange, rolls = scene.exchange, scene.rolls
    lower, upper = cells.pairs.T

    def between(field):
        return (field.ravel()[lower] + field.ravel()[upper]) / 2

    tube = rolls.gap / (2 * scene.resolution.streamlines)
    # m / rho_b: what a tube lets through in a time step, at the local density
    parcel = tube * rolls.speed * rolls.diameter / 2 * motion.time_step * state.solid_fraction[:, -1].mean()
    sheared = cells.length * np.sqrt(3) * between(motion.shear_rate) * motion.time_step * between(state.solid_fraction)
    return SwapRates(
        pairs=cells.pairs,
        rise=exchange.segregation * sheared * cells.normal[:, 1] / parcel,
        mixing=exchange.mixing * sheared / (cells.distance * parcel),
    )


def passes_needed(rates: SwapRates, mixing: np.ndarray, means: np.ndarray, largest: float) -> np.ndarray:
    """Return in how many passes of a time step each edge takes part, with its probability split between them.

    As many as the needier of its two parcels must have: then the probabilities of any cell sum to at most 1/2
    in each pass.

    Parameters
    ----------
    rates : SwapRates
        Swap rates per time step.
    mixing : ndarray
        (edge,) probability of a swap by mixing per time step.
    means : ndarray
        Mean size of the parcel at each point, m.
    largest : float
        Size of the largest grain anywhere, m.
    """
    lower, upper = rates.pairs.T
    most = mixing + rates.rise * (np.maximum(largest - means[lower], 0) + means[upper])
    sums = np.bincount(lower, most, means.size) + np.bincount(upper, most, means.size)
    needed = np.maximum(np.ceil(sums / LARGEST_SUM), 1.0)
    return np.maximum(needed[lower], needed[upper]).astype(np.int64)


def refuse_passes(scene: Scene, rates: SwapRates, passes: int) -> None:
    """Raise ValueError with the predicted cost if a time step needs absurdly many passes."""
    if passes > MOST_PASSES:
        seconds = passes * rates.pairs.shape[0] * scene.resolution.points * _SECONDS_PER_EDGE
        raise ValueError(
            f"exchange: got segregation {scene.exchange.segregation:g} and mixing {scene.exchange.mixing:g}; they need "
            f"{passes:,} passes per time step to keep swap probabilities at {LARGEST_SUM:g}, must be at most "
            f"{MOST_PASSES:,}; predicted cost above {seconds:,.0f} s; use fewer points or streamlines, a larger "
            "flow.entry_fraction, or weaker exchange"
        )
