"""Closed forms of crushing without cushioning (n = inf), run to completion.

Without cushioning a grain breaks until it is finer than the critical size s_c, or, where strengths scatter, until it
withstands the stress; only the smallest s_c it has met matters. They serve scenes with n = inf as a solver without
sampling, and everything else as an oracle. They are the limit of small time steps: the march breaks a grain once per
step, the closed forms as often as it takes.
"""

import math
from collections.abc import Callable
from functools import cache, partial
from typing import NamedTuple

import numpy as np

from hpgr.grains import kernels
from hpgr.laws.feed import Feed, SingleFeed
from hpgr.laws.fragments import Fragments
from hpgr.laws.strength import Strength

_nodes = cache(np.polynomial.legendre.leggauss)  # they cost more than the rest of a case
_PARTS = 16  # that an interval is divided into while searching
_FINEST = 1e-30  # m, below any grain; where percentiles are searched from
_CLASSES = 30  # per factor e in size; passing is then right to 1e-4
_BELOW_FLOOR = 3.0  # nepers from the size floor down to the finest class of the cascade


def crushed(feed: Feed, strength: Strength, fragments: Fragments, critical: np.ndarray) -> tuple[Callable, Callable]:
    """Return the product of complete crushing: its passing as a function of size, m, and what gives breaks per grain.

    `critical` is any array of critical sizes, m; sizes are broadcast against it. It is held at the size floor, but not
    where strengths scatter: there the chance of a grain above the floor goes on rising as it falls below the floor.
    """
    scattered = math.isfinite(strength.scatter)
    critical = np.maximum(critical, _FINEST if scattered else fragments.size_floor)
    if not scattered and fragments.size_exponent == 0:
        passing = partial(_crushed_passing, feed, critical, fragments.exponent, 1 - feed.passing(critical))
        return passing, partial(expected_breaks, feed, critical, fragments.exponent)
    classes, breaks = _cascade(feed, strength, fragments, critical.ravel())
    breaks = breaks.reshape(critical.shape)
    if not breaks.any():  # the feed itself, not its classes
        critical = np.full(critical.shape, np.inf)
        return partial(crushed_passing, feed, critical=critical, gamma=fragments.exponent), lambda: breaks
    whole = np.minimum(math.inf if scattered else critical, feed.largest_grain)
    product, left = (each.reshape(-1, *critical.shape) for each in (classes.product, classes.left))
    return partial(_between, feed, classes._replace(product=product, left=left), whole), lambda: breaks


class _Classes(NamedTuple):
    """Size classes of equal widths in log size."""

    edges: np.ndarray  # (edge,) log of sizes in m
    feed: np.ndarray  # (edge,) passing of the feed there
    product: np.ndarray  # (edge, line) and of the product
    left: np.ndarray  # (class, line) part of the feed of a class that is left in it


def _cascade(feed: Feed, strength: Strength, fragments: Fragments, critical: np.ndarray) -> tuple[_Classes, np.ndarray]:
    """Return the classes of the product, and the breaks per grain (line,).

    A16, A17: g(s) = f0(s) + int_s^inf g(t) B(t) gamma(t) s^(gamma(t)-1) t^-gamma(t) dt is all grains ever made. Within
    a class, of width h in log size and reached evenly, chance b and exponent gamma are those of its middle. Of grains
    that enter, the part b (1 - exp(-a)) / a, a = gamma (1 - b) h, then leaves it in the end.
    """
    top = math.log(feed.largest_grain)
    floor = min(math.log(fragments.size_floor), top - 1)  # an edge; of a feed below the floor nothing breaks
    above = math.ceil((top - floor) * _CLASSES)
    width = (top - floor) / above
    edges = top - width * np.arange(above + math.ceil(_BELOW_FLOOR / width), -1, -1)
    middle = np.exp((edges[1:] + edges[:-1]) / 2)[:, None]
    gamma = fragments.exponent_of(middle)
    if math.isinf(strength.scatter):  # a step: the part of the class above s_c breaks
        chance = np.clip((edges[1:, None] - np.log(critical)) / width, 0.0, 1.0)
    else:
        chance = np.where(middle < fragments.size_floor, 0.0, strength.chance(middle, critical))
    kept = np.maximum(gamma * (1 - chance) * width, 1e-9)
    within = -np.expm1(-kept) / kept
    leaving = np.pad(chance * within, ((1, 0), (0, 0)))
    left = np.where(chance > 0, 0.0, 1.0) if math.isinf(strength.scatter) else 1 - leaving[1:]
    sizes = np.append(np.exp(edges[:-1]), feed.largest_grain)  # exp(log(s)) may be less than s, which no grain passes
    of_feed = feed.passing(sizes)
    feed_passing, first = np.repeat(of_feed[:, None], critical.size, axis=1), 0.0
    if isinstance(feed, SingleFeed):  # no class: its chance is its own, and what is left of it passes the last edge
        broken = top >= np.log(critical) if math.isinf(strength.scatter) else strength.chance(sizes[-1], critical)
        first = np.where(sizes[-1] < fragments.size_floor, 0.0, broken)
        feed_passing = first * (sizes[:, None] / sizes[-1]) ** fragments.exponent_of(sizes[-1])
        left[-1] = 1 - first
    ever = np.diff(feed_passing, prepend=0.0, axis=0)
    kernels.cascade(ever, leaving, np.pad(np.exp(-gamma[:, 0] * width), (1, 0)))
    tries = chance * (1 + chance * (1 - within) / np.maximum(1 - chance, 1e-9 / (gamma * width)))
    cumulative = np.minimum(np.cumsum(ever * (1 - leaving), axis=0), 1.0)
    cumulative[-1] = 1.0  # but for rounding
    return _Classes(edges, of_feed, cumulative, left), first + np.sum(ever[1:] * tries, axis=0)


def _between(feed: Feed, classes: _Classes, whole: np.ndarray, size) -> np.ndarray:
    """Return passing at sizes (..., *line), m, from that at the edges of the cascade's classes.

    Within a class fragments are even in log size, and what is left of the feed lies as in the feed. All passes `whole`,
    m, the end of the last class that holds anything. Below the edges, where nothing breaks, passing goes on as the
    power of size that it is across the finest class: exact for fragments of one exponent.
    """
    edges, of_feed, cumulative, left = classes
    size = np.broadcast_to(size, np.broadcast_shapes(np.shape(size), cumulative.shape[1:]))
    axes = size.shape[size.ndim - cumulative.ndim + 1 :]
    cumulative, left = (np.broadcast_to(each, each.shape[:1] + axes) for each in (cumulative, left))
    place, end = ((np.log(each) - edges[0]) / (edges[1] - edges[0]) for each in (size, whole))
    before = np.clip(place.astype(int), 0, edges.size - 2)
    lines = np.ogrid[tuple(slice(n) for n in size.shape)][size.ndim - cumulative.ndim + 1 :]
    low, high = cumulative[(before, *lines)], cumulative[(before + 1, *lines)]
    beside = np.divide(low, high, out=np.zeros_like(low), where=high > 0)
    within = low + (high - low) * (place - before) / np.clip(end - before, 1e-9, 1.0)
    even = of_feed[before] + (of_feed[before + 1] - of_feed[before]) * (place - before)
    within += left[(before, *lines)] * (feed.passing(size) - even)
    found = np.where(place < 0, low * beside ** np.maximum(-place, 0.0), within)
    return np.where(size < whole, found, 1.0)


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
    critical = np.asarray(critical, dtype=float)
    return _crushed_passing(feed, critical, gamma, 1 - feed.passing(critical), np.asarray(size, dtype=float))


def _crushed_passing(feed: Feed, critical: np.ndarray, gamma: float, coarse: np.ndarray, size) -> np.ndarray:
    """As `crushed_passing`, given the coarse part of the feed, 1 - F0(s_c)."""
    crushed = coarse * np.minimum(size / critical, 1.0) ** gamma  # 0 where s_c is inf
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
    nodes, weights = _nodes(200)
    size = np.exp(start[..., None] + length[..., None] * (nodes + 1) / 2)
    tail = (1 - feed.passing(size)) @ (weights / 2) * length
    breaks = 1 - feed.passing(np.minimum(critical, largest)) + gamma * tail
    return np.where(critical <= largest, breaks, 0.0)
