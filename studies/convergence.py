"""What refinement tells of an error: order and limit of three grids, and which choices are worth their cost."""

from collections.abc import Callable

import numpy as np

SAFETY = 1.25  # of the grid convergence index; the customary factor for three grids
ORDERS = (0.5, 2.0)  # an observed order is held within these before anything is extrapolated with it
ROUNDING = 1e-12  # relative differences below it are none


def observed_order(coarse, medium, fine) -> np.ndarray:
    """Return the order of convergence seen on three grids, each twice as fine as the one before.

    NaN where nothing changes, or where the two changes differ in sign: there is no order to see.
    """
    first, second = np.asarray(medium - coarse, float), np.asarray(fine - medium, float)
    known = (first * second > 0) & (np.abs(second) > ROUNDING * np.abs(fine))
    ratio = np.divide(first, second, out=np.ones_like(second), where=known)
    return np.where(known, np.log2(ratio), np.nan)


def richardson(coarse, medium, fine) -> np.ndarray:
    """Return the limit of three grids, fine + (fine - medium) / (2^p - 1).

    p is the observed order held within `ORDERS`, the lowest of them if there is none.
    """
    order = np.clip(np.nan_to_num(observed_order(coarse, medium, fine), nan=ORDERS[0]), *ORDERS)
    return fine + (fine - medium) / (2**order - 1)


def unbeaten(*figures: np.ndarray) -> np.ndarray:
    """Return which choices no other beats in every figure, the larger the better."""
    every = np.stack(figures, axis=-1)
    better = (every[None] >= every[:, None]).all(-1) & (every[None] > every[:, None]).any(-1)
    return ~better.any(axis=1) & np.isfinite(every).all(axis=1)


def jackknife(statistic: Callable[[np.ndarray], np.ndarray], samples: np.ndarray) -> np.ndarray:
    """Return the standard error of `statistic` of means, from samples (rung, replicate, quantity)."""
    count = samples.shape[1]
    left_out = (samples.sum(axis=1, keepdims=True) - samples) / (count - 1)  # means, each without one replicate
    found = np.stack([statistic(left_out[:, k]) for k in range(count)])
    return np.sqrt((count - 1) / count * ((found - found.mean(axis=0)) ** 2).sum(axis=0))
