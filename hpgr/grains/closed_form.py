"""Closed forms of crushing without cushioning (n = inf), run to completion.

Without cushioning a grain breaks until it is finer than the critical size s_c, and only the smallest s_c it has met
matters. They serve scenes with n = inf as a solver without sampling, and everything else as an oracle. They are the
limit of small time steps: the march breaks a grain once per step, the closed forms as often as it takes.
"""

import numpy as np

from hpgr.laws.feed import Feed

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(200)  # made once: they cost more than the rest of a case
_PARTS = 16  # that an interval is divided into while searching
_FINEST = 1e-30  # m, below any grain; where percentiles are searched from


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
    >>> from hpgr.grains import closed_form
    >>> from hpgr.laws.feed import SingleFeed
    >>> closed_form.crushed_passing(SingleFeed(size="50 mm"), [1e-3, 4e-3, 8e-3], 8e-3, gamma=1)
    array([0.125, 0.5  , 1.   ])
    """
    size, critical = np.broadcast_arrays(np.asarray(size, dtype=float), np.asarray(critical, dtype=float))
    crushed = (1 - feed.passing(critical)) * np.minimum(size / critical, 1.0) ** gamma  # 0 where s_c is inf
    return np.where(size < critical, feed.passing(size) + crushed, 1.0)


def percentile(passing, fraction, largest: float) -> np.ndarray:
    """Return the sizes in m at which `passing` reaches `fraction`, in the shape of the latter; all passes `largest`.

    `passing` rises with size and takes any axes before those of `fraction`.

    Examples
    --------
    >>> import numpy as np
    >>> from hpgr.grains import closed_form
    >>> closed_form.percentile(lambda size: size / 0.01, np.array([0.5, 0.8]), largest=0.01)
    array([0.005, 0.008])
    """
    low, high = np.full_like(fraction, np.log(_FINEST)), np.full_like(fraction, np.log(largest))
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
    >>> from hpgr.grains import closed_form
    >>> from hpgr.laws.feed import SingleFeed
    >>> float(closed_form.expected_breaks(SingleFeed(size=0.05), 0.05 / np.e**2, gamma=1).round(6))
    3.0
    """
    critical, largest = np.asarray(critical, dtype=float), feed.largest_grain
    start = np.log(np.minimum(critical, largest))
    length = np.log(largest) - start
    size = np.exp(start[..., None] + length[..., None] * (_NODES + 1) / 2)
    tail = (1 - feed.passing(size)) @ (_WEIGHTS / 2) * length
    breaks = 1 - feed.passing(np.minimum(critical, largest)) + gamma * tail
    return np.where(critical <= largest, breaks, 0.0)
