"""Picks the cheapest solver the scene allows, runs it, and sums up the product (docs/model.md, Solvers)."""

import math
from typing import NamedTuple

import numpy as np

from hpgr.bed.loaded import LoadedBed
from hpgr.grains import closed_form, kernels, lattice, march
from hpgr.grains.lattice import Exchanged
from hpgr.grains.march import Cells
from hpgr.laws.roll_width import WHOLE, Slices
from hpgr.scene import Scene

_AT_ONCE = 4000  # points whose closed form is taken at once: each takes up to 20 kB
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


def crushing_stress(scene: Scene, bed: LoadedBed) -> np.ndarray:
    """Return the stress that crushes, (streamline, point), Pa: 0 where the bed does not compact (paper eq. 1)."""
    stress = scene.strength.crushing_stress(bed.stress.pressure, bed.stress.shear_stress)
    return np.where(bed.kinematics.volumetric_rate > 0, stress, 0.0)


def crush(scene: Scene, bed: LoadedBed, seed: int, replicate: int) -> Crushed | None:
    """Crush the feed of `scene` in its loaded bed; None for a stress-only scene.

    Parameters
    ----------
    scene : Scene
        What is simulated.
    bed : LoadedBed
        Its bed, tessellated if the lattice is the solver.
    seed, replicate : int
        Keys of the randomness.
    """
    solver = choose(scene)
    if solver == "stress only":
        return None
    log_stress = scene.strength.log_stress(crushing_stress(scene, bed))
    slices = WHOLE if scene.roll_width is None else scene.roll_width.cut(scene.rolls.gap, scene.rolls.width)
    if solver == "closed form":
        return _closed_form(scene, log_stress, slices)
    if solver in ("lattice", "reduced lattice"):
        cells, exchanged = lattice.run(scene, log_stress, bed, seed, replicate, reduced=solver != "lattice")
        return _summarised(scene, cells, slices)._replace(exchanged=exchanged)
    return _summarised(scene, march.march(scene, log_stress, slices, seed, replicate), slices)


def _closed_form(scene: Scene, log_stress: np.ndarray, slices: Slices) -> Crushed:
    feed, grid = scene.feed, scene.resolution
    highest = np.maximum.accumulate(log_stress, axis=1)

    def crushed(level):
        critical = np.maximum(scene.strength.critical_size(level), scene.fragments.size_floor)
        return closed_form.crushed(feed, scene.strength, scene.fragments, critical)

    # (slice, streamline): a stream tube of each slice leaves with the product of its own critical size
    at_exit, breaks = crushed(highest[:, -1] + np.log(slices.pressure)[:, None])
    sieves, tubes = np.array(grid.sieves), log_stress.shape[0]

    def passing(size, share=slices.share):  # size (..., streamline)
        return np.einsum("s,...sn->...n", share, at_exit(size=size[..., None, :]))

    def total_passing(size, share=slices.share):
        return passing(np.repeat(size, tubes, axis=-1), share).mean(axis=-1, keepdims=True)

    fractions = np.array(FRACTIONS)[:, None]
    mass = None
    if grid.record == "distributions":
        parts = np.array_split(highest, -(-highest.size // _AT_ONCE), axis=1)
        everywhere = np.concatenate([crushed(part)[0](size=sieves[:, None, None]) for part in parts], axis=-1)
        mass = np.diff(np.moveaxis(everywhere, 0, -1), axis=-1, prepend=0.0)[None]
    return Crushed(
        breaks=slices.share @ breaks,
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


def _summarised(scene: Scene, cells: Cells, slices: Slices) -> Crushed:
    """Sum up the product, snapshots pooled."""
    product = cells.product
    pooled = np.sort(product.transpose(1, 0, 2).reshape(product.shape[1], -1), axis=1)
    below_floor = np.nextafter(scene.fragments.size_floor, 0.0)
    counts = np.empty((pooled.shape[0], 1 + len(scene.resolution.sieves)), np.int64)
    kernels.passing_counts(pooled, np.append(below_floor, march.cell_sieves(scene)), counts)
    # (slice, streamline, ...)
    breaks, passing, pooled = (
        part.reshape(slices.share.size, -1, *part.shape[1:]) for part in (cells.breaks.astype(float), counts, pooled)
    )
    passing, breaks = passing / pooled.shape[-1], breaks / pooled.shape[-1]
    combined = np.tensordot(slices.share, passing, axes=1)
    return Crushed(
        breaks=slices.share @ breaks,
        below_floor=combined[:, 0],
        passing=combined[:, 1:],
        percentiles=_percentiles(pooled, slices.share),
        total_percentiles=_percentiles(_whole(pooled), slices.share)[:, 0],
        size=cells.size,
        mass_fraction=None if cells.classes is None else cells.classes[..., :-1] / scene.resolution.cells,
        along_width=None if scene.roll_width is None else _along_width(slices, passing[..., 1:], pooled),
    )


def _along_width(slices: Slices, passing: np.ndarray, pooled: np.ndarray) -> AlongWidth:
    each, whole = passing.mean(axis=1), _whole(pooled)
    zones = [_zone(slices, at_edge) for at_edge in (False, True)]
    return AlongWidth(each, *(zone @ each for zone in zones), *(_percentiles(whole, zone)[:, 0] for zone in zones))


def _whole(cells: np.ndarray) -> np.ndarray:
    """Return the cells (slice, line, cell) of all lines of each slice as those of one, sorted."""
    return np.sort(cells.reshape(cells.shape[0], 1, -1), axis=-1)


def _percentiles(cells: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Return the percentiles (fraction, line) of sorted cells (slice, line, cell), each slice with its share of mass.

    Of one slice linear between cells as np.quantile's are; of several the first size that reaches the fraction.
    """
    if share.size > 1:
        cells, share = cells[share > 0], share[share > 0]
        return np.array([_weighted(cells[:, line], share) for line in range(cells.shape[1])]).T
    place = np.array(FRACTIONS) * (cells.shape[2] - 1)
    before = place.astype(int)
    after = np.minimum(before + 1, cells.shape[2] - 1)
    low, high = (cells[0][:, k].astype(float) for k in (before, after))
    return (low + (high - low) * (place - before)).T


def _weighted(cells: np.ndarray, share: np.ndarray) -> np.ndarray:
    order = np.argsort(cells, axis=None)
    reached = share[order // cells.shape[1]]
    np.cumsum(reached, out=reached)  # np.quantile with weights takes twice the memory and three times as long
    reached /= reached[-1]
    return cells.ravel()[order[np.searchsorted(reached, FRACTIONS)]].astype(float)
