"""Picks the cheapest solver the scene allows, runs it, and sums up the product (docs/model.md, Solvers)."""

import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from hpgr.bed.loaded import LoadedBed
from hpgr.grains import closed_form, kernels, lattice, march
from hpgr.grains.lattice import Exchanged
from hpgr.grains.march import Cells
from hpgr.laws.roll_width import WHOLE, Slices
from hpgr.scene import Scene

_AT_ONCE = 4000  # points whose closed form is taken at once: each takes up to 20 kB
_CONTROLLED_EXPONENT = 10.0  # of fragments; completion takes breaks in proportion to it: seconds at 1e6
_ROUNDED = 1 + 1.2e-7  # covers the rounding of a size to float32
FRACTIONS = (0.5, 0.8)  # of the percentiles every product is summarised by


class AlongWidth(NamedTuple):
    """Product along the roll width."""

    passing: np.ndarray  # (slice, sieve) mass fraction of the product of each slice passing each sieve
    centre_passing: np.ndarray  # (sieve,) of the product called centre
    edge_passing: np.ndarray  # and of that called edge
    centre_percentiles: np.ndarray  # (2,) P50 and P80 of these, m
    edge_percentiles: np.ndarray


class Crushed(NamedTuple):
    """What crushing left behind; what was not asked for is None."""

    breaks: np.ndarray  # (streamline,) mean number of breaks per cell
    below_floor: np.ndarray  # (streamline,) fraction of the product below the size floor, where nothing breaks
    passing: np.ndarray  # (streamline, sieve) mass fraction of the product passing each sieve
    total_passing: np.ndarray  # (sieve,)
    percentiles: np.ndarray  # (2, streamline) P50 and P80 of the product, m
    total_percentiles: np.ndarray  # (2,)
    size: np.ndarray | None = None  # (time, streamline, point, cell) float32, m
    mass_fraction: np.ndarray | None = None  # (time, streamline, point, sieve) between a sieve and the next finer one
    exchanged: Exchanged | None = None  # what only a scene with exchange has
    along_width: AlongWidth | None = None  # of a scene with a roll width; all else is then combined over the width


def choose(scene: Scene) -> str:
    """Return the name of the cheapest solver.

    One of "stress only", "closed form", "march", "lattice", and "reduced lattice", which begins above the first break.
    """
    if scene.resolution.cells == 0:
        return "stress only"
    if scene.exchange is not None and scene.rolls.gap < scene.rolls.entry_gap:  # equal gaps: nothing moves or mixes
        moving = scene.exchange.segregation > 0 or scene.exchange.mixing > 0
        product_only = scene.resolution.record == "product" and scene.exchange.startup is None
        return "reduced lattice" if moving and product_only else "lattice"
    strength = scene.strength
    if math.isinf(strength.cushioning) and math.isfinite(strength.weibull_modulus):
        return "march" if scene.resolution.record == "cells" else "closed form"
    return "march"


def is_controlled(scene: Scene) -> bool:
    """Return whether the product of the march is corrected by the closed form (docs/model.md, Solvers)."""
    strength = scene.strength
    known = math.isfinite(strength.cushioning) and math.isfinite(strength.weibull_modulus)
    known = known and scene.fragments.exponent <= _CONTROLLED_EXPONENT
    return known and scene.resolution.control_variate and choose(scene) == "march"


def crushing_stress(scene: Scene, bed: LoadedBed) -> np.ndarray:
    """Return the stress that crushes, (streamline, point), Pa: 0 where the bed does not compact (paper eq. 1)."""
    stress = scene.strength.crushing_stress(bed.stress.pressure, bed.stress.shear_stress)
    return np.where(bed.kinematics.volumetric_rate > 0, stress, 0.0)


class Loaded(NamedTuple):
    """A scene, its bed, tessellated if the lattice is the solver, and the independent repetitions to run."""

    scene: Scene
    bed: LoadedBed
    replicates: Sequence[int]


def crush(points: Iterable[Loaded], seed: int) -> list[list[Crushed | None]]:
    """Crush the feed of each scene in its bed, once for every replicate; None for a stress-only scene.

    Neighbours that differ by feed, load and reference strength alone share calls of the kernels, and replicates what is
    known without random numbers. `seed` is the key of the randomness, with the replicates.
    """
    found: list[list[Crushed | None]] = []
    for together, group in itertools.groupby(points, lambda one: _marched_with(one.scene)):
        alike = list(group)
        found += _crush_together(alike, seed) if together else [_crush_alone(one, seed) for one in alike]
    return found


def _marched_with(scene: Scene) -> tuple | None:
    """Return what scenes must have in common to be marched in the same calls; None for those that are not."""
    if choose(scene) != "march":
        return None
    slices = scene.roll_width and (scene.roll_width, scene.rolls.width, scene.rolls.gap)
    return march.ore(scene), scene.resolution, is_controlled(scene), slices


def _slices(scene: Scene) -> Slices:
    return WHOLE if scene.roll_width is None else scene.roll_width.cut(scene.rolls.gap, scene.rolls.width)


def _crush_alone(point: Loaded, seed: int) -> list[Crushed | None]:
    scene, bed, replicates = point
    solver = choose(scene)
    if solver == "stress only":
        return [None] * len(replicates)
    log_stress, slices = scene.strength.log_stress(crushing_stress(scene, bed)), _slices(scene)
    if solver == "closed form":
        return [_closed_form(scene, log_stress, slices)] * len(replicates)
    found = [lattice.run(scene, log_stress, bed, seed, one, reduced=solver != "lattice") for one in replicates]
    return [_summarised(scene, cells, slices)[0]._replace(exchanged=exchanged) for cells, exchanged in found]


def _crush_together(points: list[Loaded], seed: int) -> list[list[Crushed]]:
    scenes, slices = [one.scene for one in points], _slices(points[0].scene)
    grid = scenes[0].resolution
    # points that differ by their feed have the same load: 7 % of a case
    alike = [list(same) for _, same in itertools.groupby(points, lambda one: (id(one.bed), one.scene.strength))]
    log_stress = np.stack([one.scene.strength.log_stress(crushing_stress(one.scene, one.bed)) for one, *_ in alike])
    of_point = [number for number, same in enumerate(alike) for _ in same]
    of_slices = [log_stress + np.log(pressure) for pressure in slices.pressure]
    loads = march.path(scenes[0], np.concatenate(of_slices, axis=1))
    complete = None
    if is_controlled(scenes[0]):
        highest = log_stress.max(axis=2)[of_point, None]
        complete = [_complete(*one, slices)[0] for one in zip(scenes, highest, strict=True)]
    runs = [(number, of_point[number], replicate) for number, one in enumerate(points) for replicate in one.replicates]
    step = max(march.AT_ONCE // (slices.share.size * grid.streamlines * grid.snapshots * grid.cells), 1)
    found = []
    for k in range(0, len(runs), step):
        part = runs[k : k + step]
        cells = march.march(scenes, loads, seed, part, complete is not None)
        exact = None if complete is None else partial(_of_runs, [complete[number] for number, _, _ in part])
        found += _summarised(scenes[0], cells, slices, exact)
    each = iter(found)
    return [list(itertools.islice(each, len(one.replicates))) for one in points]


def _of_runs(passings: list[Callable], size: np.ndarray) -> np.ndarray:
    """Return passings (..., slice, run, streamline), each run's own, at sizes that are broadcast against these, m."""
    found, start = [], 0
    for passing, same in itertools.groupby(passings):
        count = len(list(same))
        own = passing(size=size if size.shape[-2] == 1 else size[..., start : start + count, :])
        found.append(np.broadcast_to(own, (*own.shape[:-2], count, own.shape[-1])))
        start += count
    return np.concatenate(found, axis=-2)


def _complete(scene: Scene, highest: np.ndarray, slices: Slices) -> tuple[Callable, Callable]:
    """Return what is known of crushing without cushioning at the highest stress of each slice and streamline."""
    critical = scene.strength.critical_size(highest + np.log(slices.pressure).reshape(-1, *(1,) * highest.ndim))
    return closed_form.crushed(scene.feed, scene.strength, scene.fragments, critical)


def _closed_form(scene: Scene, log_stress: np.ndarray, slices: Slices) -> Crushed:
    feed, grid = scene.feed, scene.resolution
    highest = np.maximum.accumulate(log_stress, axis=1)
    # (slice, streamline): a stream tube of each slice leaves with the product of its own critical size
    at_exit, breaks = _complete(scene, highest[:, -1], slices)
    sieves, tubes = np.array(grid.sieves), log_stress.shape[0]

    def passing(size, share=slices.share):  # size (..., streamline)
        return np.einsum("s,...sn->...n", share, at_exit(size=size[..., None, :]))

    def total_passing(size, share=slices.share):
        return passing(np.repeat(size, tubes, axis=-1), share).mean(axis=-1, keepdims=True)

    fractions = np.array(FRACTIONS)[:, None]
    mass = None
    if grid.record == "distributions":
        parts = np.array_split(highest, -(-highest.size // _AT_ONCE), axis=1)
        points = [_complete(scene, part, WHOLE)[0](size=sieves[:, None, None, None])[:, 0] for part in parts]
        mass = np.diff(np.moveaxis(np.concatenate(points, axis=-1), 0, -1), axis=-1, prepend=0.0)[None]
    of_tubes = passing(np.tile(sieves[:, None], tubes)).T
    return Crushed(
        breaks=slices.share @ breaks(),
        below_floor=passing(np.full(tubes, np.nextafter(scene.fragments.size_floor, 0.0))),
        passing=of_tubes,
        total_passing=of_tubes.mean(axis=0),
        percentiles=closed_form.percentile(passing, np.tile(fractions, tubes), feed.largest_grain),
        total_percentiles=closed_form.percentile(total_passing, fractions, feed.largest_grain)[:, 0],
        mass_fraction=mass,
        along_width=None if scene.roll_width is None else _closed_along_width(slices, at_exit, total_passing, scene),
    )


def _closed_along_width(slices: Slices, at_exit, total_passing, scene: Scene) -> AlongWidth:
    fractions, sieves = np.array(FRACTIONS)[:, None], np.array(scene.resolution.sieves)
    zones = [_zone(slices, at_edge) for at_edge in (False, True)]
    largest = scene.feed.largest_grain
    return AlongWidth(
        at_exit(size=sieves[:, None, None]).mean(axis=-1).T,
        *(total_passing(sieves[:, None], zone)[:, 0] for zone in zones),
        *(
            closed_form.percentile(lambda size, zone=zone: total_passing(size, zone), fractions, largest)[:, 0]
            for zone in zones
        ),
    )


def _zone(slices: Slices, at_edge: bool) -> np.ndarray:
    """Return the shares of the slices in the centre or edge product, 0 outside it."""
    share = np.where(slices.at_edge == at_edge, slices.share, 0.0)
    return share / share.sum()


def _summarised(scene: Scene, cells: Cells, slices: Slices, exact: Callable | None = None) -> list[Crushed | None]:
    """Sum up the products, snapshots pooled; corrected by what complete crushing comes to, if that is known."""
    pooled = _pooled(cells.product, slices)
    whole = np.sort(pooled.reshape(*pooled.shape[:2], 1, -1), axis=-1)  # all lines as those of one
    zones = [_zone(slices, at_edge) for at_edge in (False, True)] if scene.roll_width else []
    shares = [slices.share, slices.share, *zones]
    mixed = [*_mixed(pooled, shares[:1]), *_mixed(whole, shares[1:])]
    percentiles = [quantiles(one, _fractions(one.sizes.shape[:2])) for one in mixed]
    below_floor = np.nextafter(scene.fragments.size_floor, 0.0)
    counts = _count(pooled, np.append(below_floor, march.cell_sieves(scene))[:, None])
    passing = counts / pooled.shape[-1]
    if exact is not None:
        control = Control(_pooled(cells.complete, slices), exact)
        # not what is below the floor: a limit is hit by cells, not in the mean
        passing[..., 1:] = control.passing(counts[..., 1:], np.array(scene.resolution.sieves))
        for _ in range(2):  # the first read is off by the cells' own scatter, the second by little
            fractions = control.fractions(percentiles, shares)
            percentiles = [quantiles(one, at) for one, at in zip(mixed, fractions, strict=True)]
    by_run = np.ascontiguousarray(
        passing.swapaxes(0, 1)
    )  # each run's product of its own: their number leaves bits alone
    combined = (slices.share @ by_run.reshape(*by_run.shape[:2], -1)).reshape(by_run.shape[0], *by_run.shape[2:])
    breaks = slices.share @ (cells.breaks.reshape(len(cells.breaks), slices.share.size, -1) / pooled.shape[-1])
    total_passing = combined[..., 1:].mean(axis=1)
    of_all, of_whole, *of_zones = percentiles

    def along_width(k: int) -> AlongWidth:
        each = passing[:, k, :, 1:].mean(axis=1)
        return AlongWidth(each, *(zone @ each for zone in zones), *(part[:, k, 0] for part in of_zones))

    return [
        Crushed(
            breaks=breaks[k],
            below_floor=combined[k, :, 0],
            passing=combined[k, :, 1:],
            total_passing=total_passing[k],
            percentiles=of_all[:, k],
            total_percentiles=of_whole[:, k, 0],
            size=None if cells.size is None else cells.size[k],
            mass_fraction=None if cells.classes is None else cells.classes[k, ..., :-1] / scene.resolution.cells,
            along_width=along_width(k) if zones else None,
        )
        for k in range(len(breaks))
    ]


def _pooled(product: np.ndarray, slices: Slices) -> np.ndarray:
    """Return cells (replicate, snapshot, line, cell) as (slice, replicate, streamline, cell), sorted."""
    replicates, snapshots, _, cells = product.shape
    by_slice = product.reshape(replicates, snapshots, slices.share.size, -1, cells).transpose(2, 0, 3, 1, 4)
    pooled = by_slice.reshape(*by_slice.shape[:3], -1)
    pooled.sort(axis=-1)
    return pooled


def _count(pooled: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Return how many of the sorted cells (..., cell) are no larger than sizes (size, line or 1), (..., size)."""
    counts = np.empty((*pooled.shape[:-1], len(sizes)), np.int64)
    kernels.passing_counts(pooled.reshape(-1, pooled.shape[-1]), sizes, counts.reshape(-1, len(sizes)))
    return counts


def _fractions(shape: tuple[int, ...]) -> np.ndarray:
    """Return the fractions that percentiles are of, (fraction, *shape)."""
    fractions = np.empty((len(FRACTIONS), *shape))
    fractions.T[:] = FRACTIONS
    return fractions


class Mixed(NamedTuple):
    """Cells of all slices together, each slice with its share of the mass."""

    sizes: np.ndarray  # (replicate, line, cell) sorted, m
    reached: np.ndarray | None = None  # mass fraction up to each cell; None of one slice


def _mixed(cells: np.ndarray, shares: list[np.ndarray]) -> list[Mixed]:
    """Return sorted cells (slice, replicate, line, cell) mixed by each of the shares."""
    if cells.shape[0] == 1:
        return [Mixed(cells[0])] * len(shares)
    together = np.moveaxis(cells, 0, 2).reshape(*cells.shape[1:3], -1)
    order = np.argsort(together, axis=-1)  # once: it costs more than all that is read
    sizes, order = np.take_along_axis(together, order, axis=-1), order // cells.shape[-1]
    found = []
    for share in shares:
        reached = share[order]
        np.cumsum(reached, axis=-1, out=reached)  # np.quantile with weights takes twice the memory, three times as long
        reached /= reached[..., -1:]
        found.append(Mixed(sizes, reached))
    return found


def quantiles(mixed: Mixed, fractions: np.ndarray) -> np.ndarray:
    """Return the quantiles at fractions (fraction, replicate, line).

    Of one slice linear between cells as np.quantile's are; of several the first size that reaches the fraction.
    """
    if mixed.reached is None:
        rows = mixed.sizes.reshape(-1, mixed.sizes.shape[-1])
        place = fractions.reshape(-1, len(rows)) * (rows.shape[1] - 1)
        before, each = place.astype(int), np.arange(len(rows))
        low, high = (
            rows[each, before].astype(float),
            rows[each, np.minimum(before + 1, rows.shape[1] - 1)].astype(float),
        )
        return (low + (high - low) * (place - before)).reshape(fractions.shape)
    found = np.empty_like(fractions)
    for k, line in np.ndindex(fractions.shape[1:]):
        places = np.searchsorted(mixed.reached[k, line], fractions[:, k, line])
        found[:, k, line] = mixed.sizes[k, line, places]
    return found


class Control(NamedTuple):
    """The same cells without cushioning as a control variate.

    A grain ends no coarser without cushioning than with it: F = P(X <= x | Y <= x) P(Y <= x). The second factor is
    known exactly and the first, which scatters less, is counted: F is the cells' own, times the exact passing of Y
    over theirs. That is the regression on Y <= x, whose slope is P(X <= x) / P(Y <= x) here.
    """

    complete: np.ndarray  # (slice, replicate, streamline, cell) sorted sizes Y, m
    exact: Callable  # passing of Y, (..., slice, replicate or 1, streamline), as a function of size, m

    def passing(self, counts: np.ndarray, sieves: np.ndarray) -> np.ndarray:
        """Return the passing (slice, replicate, streamline, sieve), given how many cells of the product pass."""
        complete = _count(self.complete, sieves.astype(np.float32).astype(float)[:, None])
        exact = np.broadcast_to(self.exact(size=sieves[:, None, None, None]), (sieves.size, *counts.shape[:-1]))
        return corrected(counts, complete, exact.transpose(1, 2, 3, 0))

    def fractions(self, sizes: list[np.ndarray], shares: list[np.ndarray]) -> list[np.ndarray]:
        """Return the fractions at which to read percentiles that are about sizes (fraction, replicate, line or 1)."""
        at = np.empty((len(sizes), len(FRACTIONS), *self.complete.shape[:-1]))
        for k, about in enumerate(sizes):
            np.multiply(about[:, None], _ROUNDED, out=at[k])
        at = at.reshape(-1, *self.complete.shape[:-1])
        passing, found = np.empty((2, *at.shape)), []
        passing[0] = _count(self.complete, at.reshape(len(at), -1)).transpose(3, 0, 1, 2)
        passing[0] /= self.complete.shape[-1]
        passing[1] = self.exact(size=at)
        for k, (about, share) in enumerate(zip(sizes, shares, strict=True)):
            parts = share[:, None, None] * passing[:, k * len(FRACTIONS) : (k + 1) * len(FRACTIONS)]
            if about.shape[-1] == 1:  # all lines together
                parts = parts.swapaxes(3, 4).reshape(*parts.shape[:2], -1, parts.shape[3], 1)
            # one after the other: the order of np.sum depends on the number of replicates
            counted, known = parts.cumsum(axis=2)[:, :, -1]
            wanted = _fractions(about.shape[1:])
            np.divide(wanted * counted, known, out=wanted, where=known > 0)
            found.append(np.maximum.accumulate(np.minimum(wanted, 1.0)))
        return found


def corrected(counts: np.ndarray, complete: np.ndarray, exact: np.ndarray) -> np.ndarray:
    """Return the exact passing (..., sieve) times counts over those of the complete product, held rising.

    Where no cell of the latter passes, the ratio is that of the next coarser sieve, 1 above all: 0 would be too little
    in the mean.
    """
    known = complete > 0
    ratio = np.divide(counts, complete, out=np.ones(counts.shape), where=known)
    finest = np.take_along_axis(ratio, known.argmax(axis=-1)[..., None], axis=-1)
    return np.maximum.accumulate(exact * np.where(known, ratio, finest), axis=-1)
