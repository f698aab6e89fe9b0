"""Without exchange: every parcel is marched once along its streamline, keyed by its own random numbers."""

import os
import threading
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np

from hpgr.grains import kernels
from hpgr.grains.kernels import Ore, Path, Record
from hpgr.laws.roll_width import Slices
from hpgr.scene import Scene

_LARGE = 200_000  # cells of all parcels from which they are marched one by one, on all cores; fewer go at once


class Cells(NamedTuple):
    """What solvers that draw cells leave.

    Attributes
    ----------
    product : ndarray
        (snapshot, line, cell) float32, sizes at the exit, m; a line is a streamline of a slice of the roll width.
    breaks : ndarray
        (line,) breaks of all cells of the product.
    size : ndarray or None
        (time, line, point, cell) float32, m.
    classes : ndarray or None
        (time, line, point, sieve + 1) cells of each sieve class.
    """

    product: np.ndarray
    breaks: np.ndarray
    size: np.ndarray | None
    classes: np.ndarray | None


def ore(scene: Scene) -> Ore:
    """Return the laws of strength and fragments as the kernels take them."""
    return Ore(*scene.strength.constants(), *scene.fragments.constants())


def path(scene: Scene, log_stress: np.ndarray) -> Path:
    """Return what loads a parcel at log(sigma_a / sigma_m)."""
    return Path(log_stress, scene.strength.critical_size_ratio(log_stress))


def cell_sieves(scene: Scene) -> np.ndarray:
    """Return the sieves rounded as the cells are, so that a grain of just a sieve's size passes it."""
    return np.array(scene.resolution.sieves, np.float32).astype(float)


def first_cells(scene: Scene, seed: int, keys: list[tuple[int, ...]]) -> tuple[np.ndarray, np.ndarray]:
    """Return sizes (float32, m) and random streams (uint64) of the cells of parcels of feed, (parcel, cell + 2).

    A parcel's key (replicate, streamline, front) and `seed` decide every bit of both. Sizes are the feed's quantiles
    at stratified uniforms, in random cell order: one uniform in each of as many equal strata represents the feed
    with a lower variance than plain sampling.
    """
    sources = [np.random.SeedSequence(seed, spawn_key=key) for key in keys]
    bases = np.array([source.generate_state(2, np.uint64) for source in sources])
    cells = scene.resolution.cells
    uniforms, streams = np.empty((len(keys), cells)), np.zeros((len(keys), cells + 2), np.uint64)
    kernels.start_parcels(bases, uniforms, streams)
    sizes = np.zeros((len(keys), cells + 2), np.float32)
    sizes[:, 1:-1] = np.maximum(scene.feed.quantile(uniforms).astype(np.float32), np.float32(kernels.SMALLEST))
    return sizes, streams


def march(scene: Scene, log_stress: np.ndarray, slices: Slices, seed: int, replicate: int) -> Cells:
    """March one parcel per slice, streamline and snapshot; each is keyed, so their order does not matter.

    Parameters
    ----------
    scene : Scene
        What is simulated.
    log_stress : ndarray
        (streamline, point) log(sigma_a / sigma_m) in the middle of the roll width.
    slices : Slices
        The slices along the roll width.
    seed, replicate : int
        Keys of the randomness.
    """
    grid, tubes = scene.resolution, log_stress.shape[0]
    # every slice marches the same parcels under its own pressure, so that slices differ by that alone
    loads = path(scene, (log_stress + np.log(slices.pressure)[:, None, None]).reshape(-1, log_stress.shape[1]))
    shape = (grid.snapshots, *loads.log_stress.shape)
    columns = list(np.ndindex(*shape[:2]))
    keys = [(replicate, line % tubes, snapshot) for snapshot, line in columns]
    lines, breaks = np.array([line for _, line in columns]), np.empty(len(columns), np.int64)
    product = np.empty((len(columns), grid.cells), np.float32)
    record = _record(scene, (len(columns), shape[2]))

    def crush(part: slice) -> None:
        sizes, streams = first_cells(scene, seed, keys[part])
        kept = Record(record.sieves, record.snapshots[part], record.classes[part])
        kernels.march(sizes, streams, lines[part], loads, ore(scene), kept, breaks[part])
        product[part] = sizes[:, 1:-1]

    _for_each(crush, len(columns), product.size)
    return Cells(
        product.reshape(*shape[:2], -1),
        breaks.reshape(shape[:2]).sum(axis=0),
        record.snapshots.reshape(*shape, -1) if record.snapshots.size else None,
        record.classes.reshape(*shape, -1) if record.classes.size else None,
    )


def _record(scene: Scene, shape: tuple[int, int]) -> Record:
    """Return arrays (parcel, point, ...) for what the scene records of every point, empty for what it does not."""
    wanted, sieves = scene.resolution.record, np.empty(0)
    snapshots = np.empty((*shape, scene.resolution.cells) if wanted == "cells" else (0, 0, 0), np.float32)
    if wanted == "distributions":
        sieves = cell_sieves(scene)
    return Record(sieves, snapshots, np.empty((*shape, sieves.size + 1) if sieves.size else (0, 0, 0), np.int64))


def _for_each(crush, parcels: int, cells: int) -> None:
    """Call `crush` with slices of the parcels: all at once, or one by one if there are many cells."""
    large = cells >= _LARGE
    parts = [slice(k, k + 1) for k in range(parcels)] if large else [slice(None)]
    # only for a caller of hpgr.simulate: the worker threads of a study have the cores already
    if large and threading.current_thread() is threading.main_thread():
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            list(pool.map(crush, parts))
    else:
        for part in parts:
            crush(part)
