"""Closed forms of crushing without cushioning (n = inf), run to completion.

Without cushioning a grain breaks until it is finer than the critical size
s_c = s_m (sigma_a / sigma_m)^(-w/3), and only the smallest s_c it has met matters. They serve scenes with
n = inf as a solver without sampling, and everything else as an oracle. They are the limit of small time
steps: the lattice breaks a grain once per step, the closed forms as often as it takes.
"""

import numpy as np

from hpgr import feed as feeds
from hpgr.scene import Feed, Material

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(200)  # made once: they cost more than the rest of a case
_PARTS = 16  # that an interval is divided into while searching
_FINEST = 1e-30  # m, below any grain; where percentiles are searched from


def critical_size(log_stress, material: Material) -> np.ndarray:
    """Return the size in m above which grains break at log(sigma_a / sigma_m), at least the size floor.

    inf where there is no stress (log_stress = -inf).

    Examples
    --------
    >>> import numpy as np
    >>> import hpgr
    >>> from hpgr import limits
    >>> ore = hpgr.Material(weibull_modulus=3)
    >>> limits.critical_size(np.log([1.0, 2.0, 4.0]), ore)
    array([0.06 , 0.03 , 0.015])
    """
    with np.errstate(over="ignore"):  # a vanishing stress breaks no size: inf is the answer
        size = material.strength_size * np.exp(-np.asarray(log_stress) * (material.weibull_modulus / 3))
    return np.maximum(size, material.size_floor)


def crushed_passing(feed: Feed, size, critical, gamma: float) -> np.ndarray:
    """Return F(x) = F0(x) + (1 - F0(s_c)) (x / s_c)^gamma for x < s_c, and 1 above.

    Parameters
    ----------
    feed : Feed
        The feed, F0.
    size, critical : array_like
        x and s_c in m, broadcast against each other; s_c = inf leaves the feed as it is.
    gamma : float
        Fragment exponent.

    Examples
    --------
    >>> import hpgr
    >>> from hpgr import limits
    >>> boulders = hpgr.Feed(kind="single", size="50 mm")
    >>> limits.crushed_passing(boulders, [1e-3, 4e-3, 8e-3], 8e-3, gamma=1)
    array([0.125, 0.5  , 1.   ])
    """
    size, critical = np.broadcast_arrays(np.asarray(size, dtype=float), np.asarray(critical, dtype=float))
    crushed = (1 - feeds.passing(feed, critical)) * np.minimum(size / critical, 1.0) ** gamma  # 0 where s_c is inf
    return np.where(size < critical, feeds.passing(feed, size) + crushed, 1.0)


def percentile(passing, fraction, coarsest: float) -> np.ndarray:
    """Return the sizes in m at which `passing` reaches `fraction`, in the shape of the latter.

    `passing` rises with size and takes any axes before those of `fraction`.

    Examples
    --------
    >>> import numpy as np
    >>> from hpgr import limits
    >>> limits.percentile(lambda size: size / 0.01, np.array([0.5, 0.8]), coarsest=0.01)
    array([0.005, 0.008])
    """
    low, high = np.full_like(fraction, np.log(_FINEST)), np.full_like(fraction, np.log(coarsest))
    inner = np.arange(1, _PARTS).reshape(-1, *(1,) * fraction.ndim) / _PARTS
    for _ in range(13):  # 16^13 = 2^52: narrows 70 nepers to rounding, in a quarter of the time of halving
        width = high - low
        below = np.sum(passing(np.exp(low + width * inner)) < fraction, axis=0)  # passing rises
        low, high = low + width * (below / _PARTS), low + width * ((below + 1) / _PARTS)
    return np.exp(high)


def expected_breaks(feed: Feed, critical, gamma: float) -> np.ndarray:
    """Return the mean number of breaks per grain, the mean of 1 + gamma ln(s0 / s_c) over s0 >= s_c.

    Integrated by parts: (1 - F0(s_c)) + gamma int_{s_c} (1 - F0(s)) d ln s.

    Examples
    --------
    >>> import numpy as np
    >>> import hpgr
    >>> from hpgr import limits
    >>> boulders = hpgr.Feed(kind="single", size=0.05)
    >>> float(limits.expected_breaks(boulders, 0.05 / np.e**2, gamma=1).round(6))  # 1 + gamma ln(s0/s_c)
    3.0
    """
    critical = np.asarray(critical, dtype=float)
    start = np.log(np.minimum(critical, feed.coarsest))
    length = np.log(feed.coarsest) - start
    size = np.exp(start[..., None] + length[..., None] * (_NODES + 1) / 2)
    tail = (1 - feeds.passing(feed, size)) @ (_WEIGHTS / 2) * length
    reached = critical <= feed.coarsest
    return np.where(reached, 1 - feeds.passing(feed, np.minimum(critical, feed.coarsest)) + gamma * tail, 0.0)
