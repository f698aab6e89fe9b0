"""Scenes cast for the kernels: constants, bounds, and the first cells of a parcel."""

import numpy as np

from hpgr import feed, kernels
from hpgr.scene import Scene


def constants(scene: Scene) -> tuple[float, float, float, float, float]:
    """Return slope, cushion, inverse_gamma, strength_size and size_floor, as `hpgr.kernels.crush` takes them."""
    ore = scene.material
    cushion = 1 / (2 * ore.cushioning * ore.cushioning)  # a power would raise where the product is inf
    return 3 / ore.weibull_modulus, cushion, 1 / ore.fragment_exponent, ore.strength_size, ore.size_floor


def size_scale(scene: Scene) -> tuple[float, float]:
    """Return inverse_unit and size_floor, as `hpgr.kernels.first_reach` takes them."""
    slope, *_, strength_size, size_floor = constants(scene)
    return (1 / strength_size if slope > 0 else 0.0), size_floor


def reach_needed(scene: Scene, log_stress: np.ndarray) -> np.ndarray:
    """Return the least reach that breaks at log(sigma_a / sigma_m); inf where there is no stress."""
    slope = 3 / scene.material.weibull_modulus
    with np.errstate(over="ignore"):  # a vanishing stress needs an infinite reach: nothing breaks
        return np.exp(-log_stress / (slope or 1.0))


def first_cells(scene: Scene, seed: int, keys: list[tuple[int, ...]]) -> tuple[np.ndarray, np.ndarray]:
    """Return sizes (float32, m) and random streams (uint64) of the cells of parcels of feed, (parcel, cell).

    A parcel's key (replicate, streamline, front) and `seed` decide every bit of both. Sizes are the feed's quantiles
    at stratified uniforms, in random cell order: one uniform in each of as many equal strata represents the feed
    with a lower variance than plain sampling.
    """
    sources = [np.random.SeedSequence(seed, spawn_key=key) for key in keys]
    bases = np.array([source.generate_state(2, np.uint64) for source in sources])
    shape = (len(keys), scene.resolution.cells)
    uniforms, streams = np.empty(shape), np.empty(shape, np.uint64)
    kernels.start_parcels(bases, uniforms, streams)
    sizes = feed.quantile(scene.feed, uniforms).astype(np.float32)
    return np.maximum(sizes, np.float32(kernels.SMALLEST), out=sizes), streams
