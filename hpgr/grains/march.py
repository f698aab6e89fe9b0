"""Without exchange: every parcel is marched once along its streamline, keyed by its own random numbers."""

import itertools
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np

from hpgr.grains import kernels
from hpgr.grains.kernels import Ore, Parcels, Passage, Path, Record
from hpgr.laws.feed import Feed
from hpgr.scene import Scene

_LARGE = 200_000  # cells of all parcels from which they are crushed on all cores
AT_ONCE = 300_000  # cells of the parcels of a call: with 50,000 two threads, waiting for each other, take 13 % longer

# Of what is freed, glibc keeps as much as twice the largest block that was ever freed. Else a call would take the pages
# of its work space from the system anew: 12 % of a case, 20 % with two threads
np.empty(2_000_000)


class Cells(NamedTuple):
    """What solvers that draw cells leave; a line is a streamline of a slice of the roll width."""

    product: np.ndarray  # (replicate, snapshot, line, cell) float32, sizes at the exit, m
    breaks: np.ndarray  # (replicate, line) breaks of all cells of the product
    size: np.ndarray | None  # (replicate, time, line, point, cell) float32, m
    classes: np.ndarray | None  # (replicate, time, line, point, sieve + 1) cells of each sieve class
    complete: np.ndarray | None = None  # as `product`, sizes that the same cells come to without cushioning


def ore(scene: Scene) -> Ore:
    """Return the laws of strength and fragments as the kernels take them."""
    return Ore(*scene.strength.constants(), *scene.fragments.constants())


def path(scene: Scene, log_stress: np.ndarray) -> Path:
    """Return what loads parcels at log(sigma_a / sigma_m)."""
    return Path(log_stress, scene.strength.critical_size_ratio(log_stress))


def cell_sieves(scene: Scene) -> np.ndarray:
    """Return the sieves rounded as the cells are, so that a grain of just a sieve's size passes it."""
    return np.array(scene.resolution.sieves, np.float32).astype(float)


@lru_cache(maxsize=20_000)  # a case of a sweep has the keys of the one before, and they cost a fifth of crushing it
def _bases(seed: int, key: tuple[int, ...]) -> tuple[int, int]:
    first, second = np.random.SeedSequence(seed, spawn_key=key).generate_state(2, np.uint64)
    return int(first), int(second)


def bases(seed: int, keys: list[tuple[int, ...]]) -> np.ndarray:
    """Return the two 64-bit numbers, (parcel, 2), that decide every bit of parcels, by (replicate, line, snapshot)."""
    return np.array([_bases(seed, key) for key in keys], np.uint64)


def fill(parcels: Parcels, slots: np.ndarray, scene: Scene, bases: np.ndarray, quantile: Callable | None) -> None:
    """Put parcels of feed, each with its bases, in these slots.

    Sizes are the quantiles of the feed, or those given, at stratified uniforms in random cell order: one uniform in
    each of as many equal strata represents the feed with a lower variance than plain sampling.
    """
    uniforms = np.empty((slots.size, scene.resolution.cells))
    kernels.start_parcels(bases, ore(scene), slots, uniforms, parcels.streams, parcels.weakness)
    sizes = (quantile or scene.feed.quantile)(uniforms)
    parcels.sizes[slots, 1:-1] = np.maximum(sizes, kernels.SMALLEST, out=sizes)  # one array more: 1 % of a case
    parcels.bounds_outdated[slots], parcels.breaks[slots] = True, 0


def first_cells(scene: Scene, seed: int, keys: list[tuple[int, ...]], quantile: Callable | None = None) -> Parcels:
    """Return parcels of feed, a slot for each key; see `bases` and `fill`."""
    parcels = kernels.make_parcels(len(keys), scene.resolution.cells, np.isfinite(scene.strength.scatter))
    fill(parcels, np.arange(len(keys)), scene, bases(seed, keys), quantile)
    return parcels


def _quantiles(feeds: list[tuple[Feed, int]], uniforms: np.ndarray) -> np.ndarray:
    """Return the sizes that uniforms (parcel, cell) stand for, given each feed and the number of its parcels."""
    ends = itertools.accumulate(count for _, count in feeds)
    found = [feed.quantile(uniforms[end - count : end]) for (feed, count), end in zip(feeds, ends, strict=True)]
    return found[0] if len(found) == 1 else np.concatenate(found)  # replicates have one: 3 % of a case


class Cores(NamedTuple):
    """Threads that share work, and the map over its parts."""

    count: int
    each: Callable


ONE = Cores(1, map)


@contextmanager
def cores(cells: int) -> Iterator[Cores]:
    """Give all cores where there are many cells, and nobody else has the cores."""
    # only for a caller of hpgr.simulate: the worker threads of a study have the cores already
    if cells >= _LARGE and threading.current_thread() is threading.main_thread():
        count = os.cpu_count() or 1
        with ThreadPoolExecutor(count) as pool:
            yield Cores(count, pool.map)
    else:
        yield ONE


def march(
    scenes: Sequence[Scene], loads: Path, seed: int, runs: Sequence[tuple[int, int, int]], complete: bool = False
) -> Cells:
    """March one parcel per slice, streamline and snapshot of each run.

    Each parcel is keyed, by `seed` and replicate, so their order does not matter. Runs share calls of the kernels: the
    Python between the calls costs as much as crushing a thousand cells. Scenes may differ in their feed and what loads
    it: `loads` are of shape (load, line, point), the streamlines of one slice of the roll width after the other. Runs
    are numbers of a scene, those of one together, of what loads it, and of an independent repetition. `complete` asks
    for what the cells come to without cushioning, too.
    """
    scene, grid, points = scenes[0], scenes[0].resolution, loads.log_stress.shape[2]
    shape = (len(runs), grid.snapshots, loads.log_stress.shape[1])
    loads = Path(*(each.reshape(-1, points) for each in loads))
    columns = list(itertools.product(runs, range(shape[1]), range(shape[2])))
    # every slice marches the same parcels under its own pressure, so that slices differ by that alone
    keys = [(replicate, line % grid.streamlines, snapshot) for (_, _, replicate), snapshot, line in columns]
    lines = np.array([load * shape[2] + line for (_, load, _), _, line in columns])
    product, breaks = np.empty((len(keys), grid.cells), np.float32), np.empty(len(keys), np.int64)
    ends, least = None, None
    if complete:
        ends, first = np.empty_like(product), lines.min()
        least = loads.critical_ratio[first : lines.max() + 1].min(axis=1)[lines - first]
    record, laws = Record(), ore(scene)
    if grid.record == "cells":
        record = Record(snapshots=np.empty((len(keys), points, grid.cells), np.float32))
    if grid.record == "distributions":
        sieves = cell_sieves(scene)
        kept = np.empty((len(keys), points, sieves.size + 1), np.int64)
        record = Record(sieves, np.empty((len(keys), sieves.size + 1), np.int64), kept)

    def crush(part: slice) -> None:
        feeds = [
            (scenes[number].feed, len(list(same)))
            for number, same in itertools.groupby(columns[part], lambda one: one[0][0])
        ]
        parcels = first_cells(scene, seed, keys[part], partial(_quantiles, feeds))
        slots = np.arange(parcels.breaks.size)
        passage = Passage(slots, lines[part], 0 * slots, 0 * slots + points)
        own = Record(record.sieves, *(None if kept is None else kept[part] for kept in record[1:]))
        work = kernels.make_work(grid.cells)
        kernels.crush(parcels, passage, loads, laws, work, own)
        product[part], breaks[part] = parcels.sizes[:, 1:-1], parcels.breaks
        if ends is not None:
            kernels.complete(*parcels[:3], least[part], laws.inverse_exponent, laws, work.places)
            ends[part] = parcels.sizes[:, 1:-1]

    with cores(product.size) as shared:
        most = max(AT_ONCE // (shared.count * grid.cells), 1)
        calls = min(shared.count * -(-len(keys) // (shared.count * most)), len(keys))  # as many for each core
        bounds = [len(keys) * k // calls for k in range(calls + 1)]
        list(shared.each(crush, map(slice, bounds, bounds[1:])))
    breaks = breaks.reshape(shape).sum(axis=1)
    parts = product, record.snapshots, record.classes, ends
    product, *kept = (None if part is None else part.reshape(*shape, *part.shape[1:]) for part in parts)
    return Cells(product, breaks, *kept)
