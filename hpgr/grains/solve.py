"""Picks the cheapest solver the scene allows, runs it, and sums up the product (docs/model.md, Solvers)."""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from hpgr.bed.loaded import LoadedBed
from hpgr.grains import closed_form, kernels, lattice, march
from hpgr.grains.lattice import Exchanged
from hpgr.grains.march import Cells
from hpgr.laws.roll_width import WHOLE, Slices
from hpgr.scene import Scene

_AT_ONCE = 4000  # points whose closed form is taken at once: each takes up to 20 kB
_ROUNDED = 1 + 1.2e-7  # covers the rounding of a size to float32
FRACTIONS = (0.5, 0.8)  # of the percentiles every product is summarised by


class AlongWidth(NamedTuple):
    """Product along the roll width.

    Attributes
    ----------
    passing : ndarray
        (slice, sieve) mass fraction of the product of each slice passing each sieve.
    centre_passing, edge_passing : ndarray
        (sieve,) of the product called centre and edge.
    centre_percentiles, edge_percentiles : ndarray
        (2,) P50 and P80 of these, m.
    """

    passing: np.ndarray
    centre_passing: np.ndarray
    edge_passing: np.ndarray
    centre_percentiles: np.ndarray
    edge_percentiles: np.ndarray


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
    exchanged : Exchanged
        What only a scene with exchange has.
    along_width : AlongWidth
        What only a scene with a roll width has; all else is then combined over the width.
    """

    breaks: np.ndarray
    below_floor: np.ndarray
    passing: np.ndarray
    percentiles: np.ndarray
    total_percentiles: np.ndarray
    size: np.ndarray | None = None
    mass_fraction: np.ndarray | None = None
    exchanged: Exchanged | None = None
    along_width: AlongWidth | None = None


def choose(scene: Scene) -> str:
    """Return the name of the cheapest solver.

    One of "stress only", "closed form", "march", "lattice", and "reduced lattice", which begins above the first break.
    """
    if scene.resolution.cells == 0:
        return "stress only"
    if scene.exchange is not None and scene.rolls.gap < scene.rolls.entry_gap:  # equal gaps: nothing moves or mixes
        moving = scene.exchange.segregation > 0 or scene.exchange.mixing > 0
        product_only = scene.resolution.record == "product" and not scene.exchange.record_startup
        return "reduced lattice" if moving and product_only else "lattice"
    strength = scene.strength
    if math.isinf(strength.cushioning) and math.isfinite(strength.weibull_modulus):
        return "march" if scene.resolution.record == "cells" else "closed form"
    return "march"


def is_controlled(scene: Scene) -> bool:
    """Return whether the product of the march is corrected by the closed form (docs/model.md, Solvers)."""
    strength = scene.strength
    known = math.isfinite(strength.cushioning) and math.isfinite(strength.weibull_modulus)
    return known and scene.resolution.control_variate and choose(scene) == "march"


def crushing_stress(scene: Scene, bed: LoadedBed) -> np.ndarray:
    """Return the stress that crushes, (streamline, point), Pa: 0 where the bed does not compact (paper eq. 1)."""
    stress = scene.strength.crushing_stress(bed.stress.pressure, bed.stress.shear_stress)
    return np.where(bed.kinematics.volumetric_rate > 0, stress, 0.0)


def crush(scene: Scene, bed: LoadedBed, seed: int, replicates: Sequence[int]) -> list[Crushed | None]:
    """Crush the feed of `scene` in its loaded bed, once for every replicate; None for a stress-only scene.

    Parameters
    ----------
    scene : Scene
        What is simulated.
    bed : LoadedBed
        Its bed, tessellated if the lattice is the solver.
    seed : int
        Key of the randomness, with the replicates.
    replicates : sequence of int
        Independent repetitions, which share what is known without random numbers.
    """
    solver = choose(scene)
    if solver == "stress only":
        return [None] * len(replicates)
    log_stress = scene.strength.log_stress(crushing_stress(scene, bed))
    slices = WHOLE if scene.roll_width is None else scene.roll_width.cut(scene.rolls.gap, scene.rolls.width)
    if solver == "closed form":
        return [_closed_form(scene, log_stress, slices)] * len(replicates)
    if solver.endswith("lattice"):
        found = [lattice.run(scene, log_stress, bed, seed, one, reduced=solver != "lattice") for one in replicates]
        return [_summarised(scene, [cells], slices)[0]._replace(exchanged=exchanged) for cells, exchanged in found]
    complete = _complete(scene, log_stress.max(axis=1)[None], slices)[0] if is_controlled(scene) else None
    found = march.march(scene, log_stress, slices, seed, replicates, complete is not None)
    return _summarised(scene, list(found), slices, complete)


def _complete(scene: Scene, highest: np.ndarray, slices: Slices) -> tuple[Callable, Callable]:
    """Return what is known of crushing without cushioning at the highest stress of each slice and streamline."""
    critical = scene.strength.critical_size(highest + np.log(slices.pressure).reshape(-1, *(1,) * highest.ndim))
    critical = np.maximum(critical, scene.fragments.size_floor)
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
    return Crushed(
        breaks=slices.share @ breaks(),
        below_floor=passing(np.full(tubes, np.nextafter(scene.fragments.size_floor, 0.0))),
        passing=passing(np.tile(sieves[:, None], tubes)).T,
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


def _summarised(
    scene: Scene, replicates: list[Cells], slices: Slices, exact: Callable | None = None
) -> list[Crushed | None]:
    """Sum up the products, snapshots pooled; corrected by what complete crushing comes to, if that is known."""
    floor = np.nextafter(scene.fragments.size_floor, 0.0)
    pooled = _pooled([cells.product for cells in replicates], slices)
    passing = _passing(pooled, np.append(floor, march.cell_sieves(scene)))
    control = None
    if exact is not None:
        control = Control(_pooled([cells.complete for cells in replicates], slices), exact)
        # not what is below the floor: a limit is hit by cells, not in the mean
        passing[..., 1:] = control.corrected(passing[..., 1:], np.array(scene.resolution.sieves))
    combined = np.tensordot(slices.share, passing, axes=1)
    percentiles = _percentiles(pooled, slices.share, control)
    whole = _whole(pooled)
    total = _percentiles(whole, slices.share, control)[..., 0]
    zones = [_zone(slices, at_edge) for at_edge in (False, True)] if scene.roll_width else []
    apart = [_percentiles(whole, zone, control)[..., 0] for zone in zones]

    def along_width(k: int) -> AlongWidth:
        each = passing[:, k, :, 1:].mean(axis=1)
        return AlongWidth(each, *(zone @ each for zone in zones), *(part[:, k] for part in apart))

    return [
        Crushed(
            breaks=slices.share @ cells.breaks.reshape(slices.share.size, -1) / pooled.shape[-1],
            below_floor=combined[k, :, 0],
            passing=combined[k, :, 1:],
            percentiles=percentiles[:, k],
            total_percentiles=total[:, k],
            size=cells.size,
            mass_fraction=None if cells.classes is None else cells.classes[..., :-1] / scene.resolution.cells,
            along_width=along_width(k) if zones else None,
        )
        for k, cells in enumerate(replicates)
    ]


def _pooled(products: list[np.ndarray], slices: Slices) -> np.ndarray:
    """Return the cells (slice, replicate, streamline, cell) of products (snapshot, line, cell), sorted."""
    by_line = np.stack(products).transpose(2, 0, 1, 3)
    by_line = by_line.reshape(slices.share.size, -1, *by_line.shape[1:]).transpose(0, 2, 1, 3, 4)
    return np.sort(by_line.reshape(*by_line.shape[:3], -1), axis=-1)


def _passing(pooled: np.ndarray, sieves: np.ndarray) -> np.ndarray:
    """Return the part of the sorted cells (..., cell) that passes each sieve, (..., sieve)."""
    counts = np.empty((*pooled.shape[:-1], sieves.size), np.int64)
    kernels.passing_counts(pooled.reshape(-1, pooled.shape[-1]), sieves, counts.reshape(-1, sieves.size))
    return counts / pooled.shape[-1]


def _whole(cells: np.ndarray) -> np.ndarray:
    """Return the cells (slice, replicate, line, cell) of all lines as those of one, sorted."""
    return np.sort(cells.reshape(*cells.shape[:2], 1, -1), axis=-1)


def _percentiles(cells: np.ndarray, share: np.ndarray, control: "Control | None") -> np.ndarray:
    """Return the percentiles (fraction, replicate, line) of sorted cells (slice, replicate, line, cell).

    Each slice has its share of mass.
    """
    fractions = np.empty((len(FRACTIONS), *cells.shape[1:3]))
    fractions[:] = np.array(FRACTIONS)[:, None, None]
    found = _quantiles(cells, share, fractions)
    return found if control is None else _quantiles(cells, share, control.to_read(found, fractions, share))


def _quantiles(cells: np.ndarray, share: np.ndarray, fractions: np.ndarray) -> np.ndarray:
    """Return the quantiles at fractions (fraction, replicate, line).

    Of one slice linear between cells as np.quantile's are; of several the first size that reaches the fraction.
    """
    if share.size > 1:
        cells, share, found = cells[share > 0], share[share > 0], np.empty_like(fractions)
        for k, line in np.ndindex(fractions.shape[1:]):
            found[:, k, line] = _weighted(cells[:, k, line], share, fractions[:, k, line])
        return found
    place = fractions * (cells.shape[-1] - 1)
    before = place.astype(int)
    after = np.minimum(before + 1, cells.shape[-1] - 1)
    replicate, line = np.ogrid[: cells.shape[1], : cells.shape[2]]
    low, high = (cells[0][replicate, line, k].astype(float) for k in (before, after))
    return low + (high - low) * (place - before)


def _weighted(cells: np.ndarray, share: np.ndarray, fractions: np.ndarray) -> np.ndarray:
    order = np.argsort(cells, axis=None)
    reached = share[order // cells.shape[1]]
    np.cumsum(reached, out=reached)  # np.quantile with weights takes twice the memory and three times as long
    reached /= reached[-1]
    return cells.ravel()[order[np.searchsorted(reached, fractions)]].astype(float)


class Control(NamedTuple):
    """The same cells without cushioning as a control variate.

    A grain ends no coarser without cushioning than with it: F = P(X <= x | Y <= x) P(Y <= x). The second factor is
    known exactly and the first, which scatters less, is counted: F is the cells' own, times the exact passing of Y
    over theirs. That is the regression on Y <= x, whose slope is P(X <= x) / P(Y <= x) here.

    Attributes
    ----------
    complete : ndarray
        (slice, replicate, streamline, cell) sorted sizes Y, m.
    exact : callable
        Passing of Y, (..., slice, replicate or 1, streamline), as a function of size, m.
    """

    complete: np.ndarray
    exact: Callable

    def corrected(self, passing: np.ndarray, sieves: np.ndarray) -> np.ndarray:
        """Return the passing (slice, replicate, streamline, sieve)."""
        counted = _passing(self.complete, sieves.astype(np.float32).astype(float))
        exact = np.moveaxis(self.exact(size=sieves[:, None, None, None]), 0, -1)
        # where no cell tells, the ratio is that of the next coarser sieve: 0 would be too little in the mean
        coarser = np.where(counted > 0, np.arange(sieves.size), sieves.size - 1)
        coarser = np.minimum.accumulate(coarser[..., ::-1], axis=-1)[..., ::-1]
        ratio = np.divide(passing, counted, out=np.zeros_like(passing), where=counted > 0)
        return np.maximum.accumulate(np.take_along_axis(ratio, coarser, axis=-1) * exact, axis=-1)

    def to_read(self, sizes: np.ndarray, fractions: np.ndarray, share: np.ndarray) -> np.ndarray:
        """Return the fractions (fraction, replicate, line) at which to read percentiles that are about `sizes`."""
        reached = sizes[:, None] * _ROUNDED  # (fraction, slice, replicate, streamline, or one for all)
        counted = np.count_nonzero(self.complete <= reached[..., None], axis=-1) / self.complete.shape[-1]
        exact = self.exact(size=np.broadcast_to(reached, counted.shape))
        counted, exact = (np.tensordot(share, part, axes=(0, 1)) for part in (counted, exact))
        if sizes.shape[-1] == 1:
            counted, exact = (part.mean(axis=-1, keepdims=True) for part in (counted, exact))
        ratio = np.divide(counted, exact, out=np.ones_like(exact), where=exact > 0)
        return np.maximum.accumulate(np.minimum(fractions * ratio, 1.0))
