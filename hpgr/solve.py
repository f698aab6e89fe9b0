"""Picks the cheapest solver the scene allows, casts once, and calls the kernels (model page, section 6)."""

import math
from typing import NamedTuple

import numpy as np

from hpgr import feed, kernels, limits
from hpgr.scene import Scene

_NO_SIEVES = np.empty(0)
_NO_SNAPSHOTS = np.empty((0, 0), np.float32)
_NO_CLASSES = np.empty((0, 0), np.int64)


class Crushed(NamedTuple):
    """What crushing left behind; what was not asked for is None.

    Attributes
    ----------
    breaks : ndarray
        (streamline,) mean number of breaks per cell.
    below_floor : ndarray
        (streamline,) fraction of the product below the size floor, where nothing breaks.
    passing : ndarray
        (streamline, sieve) mass fraction of the product passing each sieve.
    percentiles, total_percentiles : ndarray
        (2, streamline) and (2,), P50 and P80 of the product, m.
    size : ndarray
        (time, streamline, point, cell) float32, m.
    mass_fraction : ndarray
        (time, streamline, point, sieve) mass fraction between each sieve and the next finer one.
    """

    breaks: np.ndarray
    below_floor: np.ndarray
    passing: np.ndarray
    percentiles: np.ndarray
    total_percentiles: np.ndarray
    size: np.ndarray | None = None
    mass_fraction: np.ndarray | None = None


FRACTIONS = (0.5, 0.8)  # of the percentiles every product is summarised by


def choose(scene: Scene) -> str:
    """Return the name of the cheapest solver: "stress only", "closed form" or "march"."""
    if scene.resolution.cells == 0:
        return "stress only"
    ore = scene.material
    if math.isinf(ore.cushioning) and not math.isinf(ore.weibull_modulus) and scene.resolution.record != "cells":
        return "closed form"
    return "march"


def crush(scene: Scene, stress: np.ndarray, seed: int, replicate: int) -> Crushed | None:
    """Crush the feed of `scene` under `stress` (streamline, point), Pa; None for a stress-only scene."""
    solver = choose(scene)
    if solver == "stress only":
        return None
    with np.errstate(divide="ignore"):  # no stress: -inf, breaks nothing
        log_stress = np.log(stress / scene.material.strength)
    if solver == "closed form":
        return _closed_form(scene, log_stress)
    return _march(scene, log_stress, seed, replicate)


def _closed_form(scene: Scene, log_stress: np.ndarray) -> Crushed:
    ore, grid = scene.material, scene.resolution
    critical = limits.critical_size(np.maximum.accumulate(log_stress, axis=1), ore)
    at_exit = critical[:, -1]
    sieves = np.array(grid.sieves)

    def passing(size):
        return limits.crushed_passing(scene.feed, size, at_exit, ore.fragment_exponent)

    coarsest = scene.feed.coarsest
    mass = None
    if grid.record == "distributions":
        everywhere = limits.crushed_passing(scene.feed, sieves, critical[..., None], ore.fragment_exponent)
        mass = np.diff(everywhere, axis=-1, prepend=0.0)[None]
    return Crushed(
        breaks=limits.expected_breaks(scene.feed, at_exit, ore.fragment_exponent),
        below_floor=passing(np.nextafter(ore.size_floor, 0.0)),
        passing=limits.crushed_passing(scene.feed, sieves, at_exit[:, None], ore.fragment_exponent),
        percentiles=np.stack([limits.percentile(passing, f, coarsest, at_exit.shape) for f in FRACTIONS]),
        total_percentiles=np.stack(
            [limits.percentile(lambda size: passing(size).mean(), f, coarsest, ()) for f in FRACTIONS]
        ),
        mass_fraction=mass,
    )


def _march(scene: Scene, log_stress: np.ndarray, seed: int, replicate: int) -> Crushed:
    """March one parcel per streamline and photograph; each is keyed, so their order does not matter."""
    ore, grid = scene.material, scene.resolution
    shape = (grid.photographs, *log_stress.shape)
    product = np.empty((*shape[:2], grid.cells), np.float32)
    size = np.empty((*shape, grid.cells), np.float32) if grid.record == "cells" else None
    sieves = np.array(grid.sieves) if grid.record == "distributions" else _NO_SIEVES
    classes = np.empty((*shape, sieves.size + 1), np.int64) if sieves.size else None
    breaks = np.zeros(shape[1])
    slope = 3 / ore.weibull_modulus
    with np.errstate(over="ignore"):  # a vanishing stress needs an infinite reach: nothing breaks
        reach_needed = np.exp(-log_stress / (slope or 1.0))
    constants = (
        slope, 1 / (2 * ore.cushioning**2), 1 / ore.fragment_exponent, ore.strength_size, ore.size_floor,
    )  # fmt: skip
    for photograph in range(shape[0]):
        for line in range(shape[1]):
            product[photograph, line], streams = first_cells(scene, seed, (replicate, line, photograph))
            breaks[line] += kernels.march(
                product[photograph, line], streams, log_stress[line], reach_needed[line], sieves,
                _NO_SNAPSHOTS if size is None else size[photograph, line],
                _NO_CLASSES if classes is None else classes[photograph, line],
                *constants,
            )  # fmt: skip
    pooled = np.sort(product.transpose(1, 0, 2).reshape(shape[1], -1), axis=1)
    return Crushed(
        breaks=breaks / pooled.shape[1],
        below_floor=_passing(pooled, [np.nextafter(ore.size_floor, 0.0)])[:, 0],
        passing=_passing(pooled, grid.sieves),
        percentiles=np.quantile(pooled, FRACTIONS, axis=1),
        total_percentiles=np.quantile(pooled, FRACTIONS),
        size=size,
        mass_fraction=None if classes is None else classes[..., :-1] / grid.cells,
    )


def first_cells(scene: Scene, seed: int, key: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Return sizes (float32, m) and random streams (uint64) of the cells of a parcel of feed.

    The parcel's `key` (replicate, streamline, front) and `seed` decide every bit of both.
    """
    source = np.random.SeedSequence(seed, spawn_key=key)
    streams = np.empty(scene.resolution.cells, np.uint64)
    kernels.start_streams(source.generate_state(1, np.uint64)[0], streams)
    return np.maximum(feed.draw(scene.feed, streams.size, source), kernels.SMALLEST), streams


def _passing(rows: np.ndarray, sieves) -> np.ndarray:
    """Return the fraction of each sorted row that is no larger than each sieve, (row, sieve)."""
    return np.stack([np.searchsorted(row, sieves, side="right") for row in rows]) / rows.shape[1]
