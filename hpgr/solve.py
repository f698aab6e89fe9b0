"""Picks the cheapest solver the scene allows, runs it, and sums up the product (docs/model.md, Solvers)."""

import math
import os
import threading
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np

from hpgr import kernels, limits, parcels, width
from hpgr.exchange import SwapRates
from hpgr.lattice import Lattice
from hpgr.scene import Scene

_NO_SIEVES = np.empty(0)
_NO_SNAPSHOTS = np.empty((0, 0, 0), np.float32)
_NO_CLASSES = np.empty((0, 0, 0), np.int64)
_LARGE = 200_000  # cells of all parcels from which they are marched one by one, on all cores; fewer go at once


class Exchanged(NamedTuple):
    """What only the lattice knows.

    Attributes
    ----------
    elapsed_time : ndarray
        (time,) time of each photograph since the first fill, s.
    steady : ndarray of bool
        (time,) whether it was taken after one residence time; the product is that of these photographs.
    passes : int
        Most passes a time step was split into to keep the swap probabilities of a cell at 1/2.
    swaps_per_cell : float
        Mean number of swaps a cell takes part in during one residence time.
    """

    elapsed_time: np.ndarray
    steady: np.ndarray
    passes: int
    swaps_per_cell: float


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


FRACTIONS = (0.5, 0.8)  # of the percentiles every product is summarised by


def choose(scene: Scene) -> str:
    """Return the name of the cheapest solver: "stress only", "closed form", "march" or "lattice"."""
    if scene.resolution.cells == 0:
        return "stress only"
    if scene.exchange is not None and scene.rolls.gap < scene.rolls.entry_gap:  # equal gaps: nothing moves or mixes
        return "lattice"
    ore = scene.material
    if math.isinf(ore.cushioning) and not math.isinf(ore.weibull_modulus) and scene.resolution.record != "cells":
        return "closed form"
    return "march"


def crush(
    scene: Scene, stress: np.ndarray, time_step: float, rates: SwapRates | None, seed: int, replicate: int
) -> Crushed | None:
    """Crush the feed of `scene`; None for a stress-only scene.

    Parameters
    ----------
    scene : Scene
        What is simulated.
    stress : ndarray
        (streamline, point) stress that crushes, Pa.
    time_step : float
        Time between points, s.
    rates : SwapRates, optional
        Swap rates per time step; the lattice needs them.
    seed, replicate : int
        Keys of the randomness.
    """
    solver = choose(scene)
    if solver == "stress only":
        return None
    with np.errstate(divide="ignore"):  # no stress: -inf, breaks nothing
        log_stress = np.log(stress / scene.material.strength)
    if solver == "closed form":
        return _closed_form(scene, log_stress)
    if solver == "lattice":
        return _run_lattice(scene, log_stress, time_step, rates, seed, replicate)
    return _march(scene, log_stress, seed, replicate)


def _closed_form(scene: Scene, log_stress: np.ndarray) -> Crushed:
    ore, grid, slices = scene.material, scene.resolution, width.slices_of(scene)
    highest = np.maximum.accumulate(log_stress, axis=1)
    # (slice, streamline): a stream tube of each slice leaves with the product of its own critical size
    at_exit = limits.critical_size(highest[:, -1] + np.log(slices.pressure)[:, None], ore)
    sieves = np.array(grid.sieves)

    def passing(size, share=slices.share):  # size (..., streamline)
        each = limits.crushed_passing(scene.feed, size[..., None, :], at_exit, ore.fragment_exponent)
        return np.einsum("s,...sn->...n", share, each)

    def total_passing(size, share=slices.share):
        return passing(size, share).mean(axis=-1, keepdims=True)

    coarsest, fractions = scene.feed.coarsest, np.array(FRACTIONS)[:, None]
    mass = None
    if grid.record == "distributions":
        critical = limits.critical_size(highest, ore)
        everywhere = limits.crushed_passing(scene.feed, sieves, critical[..., None], ore.fragment_exponent)
        mass = np.diff(everywhere, axis=-1, prepend=0.0)[None]
    return Crushed(
        breaks=slices.share @ limits.expected_breaks(scene.feed, at_exit, ore.fragment_exponent),
        below_floor=passing(np.full(at_exit.shape[1], np.nextafter(ore.size_floor, 0.0))),
        passing=passing(np.tile(sieves[:, None], at_exit.shape[1])).T,
        percentiles=limits.percentile(passing, np.tile(fractions, at_exit.shape[1]), coarsest),
        total_percentiles=limits.percentile(total_passing, fractions, coarsest)[:, 0],
        mass_fraction=mass,
        along_width=None if scene.roll_width is None else _closed_along_width(slices, total_passing, sieves, scene),
    )


def _closed_along_width(slices: width.Slices, total_passing, sieves: np.ndarray, scene: Scene) -> AlongWidth:
    fractions, each = np.array(FRACTIONS)[:, None], np.eye(slices.share.size)
    zones = [_zone(slices, at_edge) for at_edge in (False, True)]
    return AlongWidth(
        np.array([total_passing(sieves[:, None], one)[:, 0] for one in each]),
        *(total_passing(sieves[:, None], zone)[:, 0] for zone in zones),
        *(
            limits.percentile(lambda size, zone=zone: total_passing(size, zone), fractions, scene.feed.coarsest)[:, 0]
            for zone in zones
        ),
    )


def _zone(slices: width.Slices, at_edge: bool) -> np.ndarray:
    """Return the shares of the slices in the centre or edge product, 0 outside it."""
    share = np.where(slices.at_edge == at_edge, slices.share, 0.0)
    return share / share.sum()


def _march(scene: Scene, log_stress: np.ndarray, seed: int, replicate: int) -> Crushed:
    """March one parcel per streamline and photograph; each is keyed, so their order does not matter."""
    grid, slices, tubes = scene.resolution, width.slices_of(scene), log_stress.shape[0]
    # every slice marches the same parcels under its own pressure, so that slices differ by that alone
    log_stress = (log_stress + np.log(slices.pressure)[:, None, None]).reshape(-1, log_stress.shape[1])
    shape = (grid.photographs, *log_stress.shape)
    product = np.empty((*shape[:2], grid.cells), np.float32)
    size = np.empty((*shape, grid.cells), np.float32) if grid.record == "cells" else None
    sieves = _cell_sieves(scene) if grid.record == "distributions" else _NO_SIEVES
    classes = np.empty((*shape, sieves.size + 1), np.int64) if sieves.size else None
    columns = list(np.ndindex(*shape[:2]))
    keys = [(replicate, line % tubes, photograph) for photograph, line in columns]
    lines, counts = np.array([line for _, line in columns]), np.empty(len(columns), np.int64)
    reach_needed = parcels.reach_needed(scene, log_stress)
    cells = product.reshape(len(columns), -1)
    snapshots = _NO_SNAPSHOTS if size is None else size.reshape(len(columns), shape[2], -1)
    counted = _NO_CLASSES if classes is None else classes.reshape(len(columns), shape[2], -1)

    def march(part: slice) -> None:
        cells[part], streams = parcels.first_cells(scene, seed, keys[part])
        kernels.march_parcels(
            cells[part], streams, lines[part], log_stress, reach_needed, sieves, snapshots[part], counted[part],
            counts[part], *parcels.constants(scene),
        )  # fmt: skip

    large = product.size >= _LARGE
    parts = [slice(k, k + 1) for k in range(len(columns))] if large else [slice(None)]
    # only for a caller of hpgr.simulate: the worker threads of a study have the cores already
    if large and threading.current_thread() is threading.main_thread():
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            list(pool.map(march, parts))
    else:
        for part in parts:
            march(part)
    breaks = counts.reshape(shape[:2]).sum(axis=0).astype(float)
    return _summarised(scene, product, breaks, size, classes)


def _run_lattice(scene, log_stress, time_step, rates, seed, replicate) -> Crushed:
    """Run the lattice through one residence time to the steady photographs, and the start-up's if wished."""
    grid, wishes = scene.resolution, scene.exchange
    last = grid.points - 1  # the step at which the first parcel that entered is at the exit
    steady = [last + k * wishes.interval for k in range(grid.photographs)]
    steps = [*(range(0, last, wishes.interval) if wishes.record_startup else ()), *steady]
    machine = Lattice(scene, log_stress, rates, seed, replicate, {step: k for k, step in enumerate(steady)})
    shape = (len(steps), *log_stress.shape)
    product = np.empty((len(steady), shape[1], grid.cells), np.float32)
    size = np.empty((*shape, grid.cells), np.float32) if grid.record == "cells" else None
    sieves = _cell_sieves(scene)
    classes = np.empty((*shape, sieves.size + 1), np.int64) if grid.record == "distributions" else None
    breaks = np.zeros(shape[1])
    taken = 0
    for step in range(steps[-1] + 1):
        machine.advance(step)
        if step != steps[taken]:
            continue
        if size is not None:
            size[taken] = machine.sizes[machine.slots]
        if classes is not None:
            classes[taken] = machine.classes(sieves)
        if step >= last:
            at_exit = machine.slots[:, -1]
            product[taken - len(steps)] = machine.sizes[at_exit]
            breaks += machine.breaks[at_exit]
        taken += 1
    residences = (steps[-1] + 1) / grid.points
    exchanged = Exchanged(
        elapsed_time=np.array(steps) * time_step,
        steady=np.array(steps) >= last,
        passes=machine.most_passes,
        swaps_per_cell=2 * machine.swaps / (machine.sizes.size * residences),
    )
    return _summarised(scene, product, breaks, size, classes)._replace(exchanged=exchanged)


def _summarised(scene, product, breaks, size, classes) -> Crushed:
    """Sum up the product (photograph, slice x streamline, cell), photographs pooled; breaks come as their total."""
    slices = width.slices_of(scene)
    pooled = np.sort(product.transpose(1, 0, 2).reshape(product.shape[1], -1), axis=1)
    below_floor = np.nextafter(scene.material.size_floor, 0.0)
    passing = np.empty((pooled.shape[0], 1 + len(scene.resolution.sieves)), np.int64)
    kernels.passing_counts(pooled, np.append(below_floor, _cell_sieves(scene)), passing)
    # (slice, streamline, ...)
    breaks, passing, pooled = (
        part.reshape(slices.share.size, -1, *part.shape[1:]) for part in (breaks, passing, pooled)
    )
    passing, breaks = passing / pooled.shape[-1], breaks / pooled.shape[-1]
    combined = np.tensordot(slices.share, passing, axes=1)
    return Crushed(
        breaks=slices.share @ breaks,
        below_floor=combined[:, 0],
        passing=combined[:, 1:],
        percentiles=np.stack([_percentiles(pooled[:, line], slices.share) for line in range(pooled.shape[1])], axis=-1),
        total_percentiles=_percentiles(pooled, slices.share),
        size=size,
        mass_fraction=None if classes is None else classes[..., :-1] / scene.resolution.cells,
        along_width=None if scene.roll_width is None else _along_width(slices, passing[..., 1:], pooled),
    )


def _along_width(slices: width.Slices, passing: np.ndarray, pooled: np.ndarray) -> AlongWidth:
    each = passing.mean(axis=1)
    zones = [_zone(slices, at_edge) for at_edge in (False, True)]
    return AlongWidth(each, *(zone @ each for zone in zones), *(_percentiles(pooled, zone) for zone in zones))


def _percentiles(cells: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Return the percentiles (fraction,) of sorted rows of cells (slice, ..., cell), each slice with its share of mass.

    Of one slice linear between cells as np.quantile's are; of several the first size that reaches the fraction.
    """
    if share.size > 1:
        weights = np.broadcast_to(share.reshape(-1, *(1,) * (cells.ndim - 1)), cells.shape)
        return np.quantile(cells, FRACTIONS, weights=weights, method="inverted_cdf").astype(float)
    ordered = cells.ravel() if cells.size == cells.shape[-1] else np.sort(cells, axis=None)
    place = np.array(FRACTIONS) * (ordered.size - 1)
    before = place.astype(int)
    after = np.minimum(before + 1, ordered.size - 1)
    low, high = (ordered[k].astype(float) for k in (before, after))
    return low + (high - low) * (place - before)


def _cell_sieves(scene: Scene) -> np.ndarray:
    """Return the sieves rounded as the cells are, so that a grain of just a sieve's size passes it."""
    return np.array(scene.resolution.sieves, np.float32).astype(float)
