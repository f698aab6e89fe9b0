"""Feed size distributions: passing, and its inverse."""

import numpy as np

from hpgr.scene import Feed


def passing(feed: Feed, size) -> np.ndarray:
    """Return the mass fraction of the feed no larger than `size` (m, any shape).

    Examples
    --------
    >>> import hpgr
    >>> from hpgr import feed
    >>> feed.passing(hpgr.presets.paper().feed, [0.008, 0.034, 0.06])
    array([0. , 0.5, 1. ])
    """
    size = np.asarray(size, dtype=float)
    if feed.kind == "uniform":
        return np.clip((size - feed.bottom_size) / (feed.top_size - feed.bottom_size), 0.0, 1.0)
    if feed.kind == "single":
        return (size >= feed.size).astype(float)
    if feed.kind == "power_law":
        return np.clip(size / feed.top_size, 0.0, 1.0) ** feed.exponent
    if feed.kind == "rosin_rammler":
        return np.clip(_rosin_rammler(feed, size) / _rosin_rammler(feed, feed.top_size), 0.0, 1.0)
    log_size, fraction = _table(feed)
    with np.errstate(divide="ignore"):  # log 0 = -inf lies left of every sieve
        found = np.interp(np.log(size), log_size, fraction)
    if feed.top_size is None:
        return found
    return np.minimum(found / _scalped(feed), 1.0)


def quantile(feed: Feed, fraction) -> np.ndarray:
    """Return the size in m that the mass fraction `fraction` (0 to 1, any shape) of the feed passes.

    Examples
    --------
    >>> import hpgr
    >>> from hpgr import feed
    >>> float(feed.quantile(hpgr.presets.paper().feed, 0.5).round(3))
    0.034
    """
    return np.minimum(_quantile(feed, np.asarray(fraction, dtype=float)), feed.coarsest)


def _quantile(feed: Feed, fraction: np.ndarray) -> np.ndarray:
    if feed.kind == "uniform":
        return feed.bottom_size + (feed.top_size - feed.bottom_size) * fraction
    if feed.kind == "single":
        return np.full(fraction.shape, feed.size)
    if feed.kind == "power_law":
        return feed.top_size * fraction ** (1 / feed.exponent)
    if feed.kind == "rosin_rammler":
        scaled = fraction * _rosin_rammler(feed, feed.top_size)
        with np.errstate(divide="ignore"):  # far below the top all of it passes: inf, held at top_size
            return feed.size * (-np.log1p(-scaled)) ** (1 / feed.exponent)
    log_size, table = _table(feed)
    if feed.top_size is not None:
        fraction = fraction * _scalped(feed)
    return np.exp(np.interp(fraction, *_rising(table, log_size)))


def _rosin_rammler(feed: Feed, size):
    with np.errstate(over="ignore"):  # far above the size all of it passes: exp(-inf) is 0
        return -np.expm1(-((np.maximum(size, 0.0) / feed.size) ** feed.exponent))


def _scalped(feed: Feed) -> float:
    """Return the fraction of the table that is left below the scalping size."""
    return float(np.interp(np.log(feed.top_size), *_table(feed)))


def _table(feed: Feed) -> tuple[np.ndarray, np.ndarray]:
    """Return log size and passing fraction, the lowest segment extended to zero passing."""
    size, percent = np.array(feed.table).T
    log_size, fraction = np.log(size), percent / 100
    if fraction[0] > 0:
        slope = (fraction[1] - fraction[0]) / (log_size[1] - log_size[0])
        log_size = np.concatenate([[log_size[0] - fraction[0] / slope], log_size])
        fraction = np.concatenate([[0.0], fraction])
    return log_size, fraction


def _rising(fraction: np.ndarray, log_size: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the table for inverse interpolation: sieves that hold no mass are jumped over."""
    keep = np.ones(fraction.size, dtype=bool)
    # of a run of equal passings only its ends matter, and np.interp takes the last of equal abscissae
    keep[1:-1] = (fraction[1:-1] != fraction[:-2]) | (fraction[1:-1] != fraction[2:])
    return fraction[keep], log_size[keep]
