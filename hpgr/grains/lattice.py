"""With exchange: the lattice in motion. Each time step all parcels shift by one point, are crushed, and swap cells.

Where only the product is wanted, the lattice begins a little above the first point at which anything can break. Above
it, among unbroken feed, the mean field of the same swaps is exact in the limit of many cells and has no noise.
"""

import math
from collections.abc import Callable
from functools import partial
from itertools import cycle
from typing import NamedTuple

import numpy as np

from hpgr.bed.loaded import LoadedBed
from hpgr.grains import kernels, march
from hpgr.grains.kernels import Edges, Passage, Path, Record
from hpgr.grains.march import Cells
from hpgr.scene import Scene

LARGEST_SUM = 0.5  # of the swap probabilities of a cell in one substep; above it swaps overshoot their equilibrium
MOST_SUBSTEPS = 1000  # per time step; a scene that needs more is refused
_SECONDS_PER_EDGE = 1e-8  # of one substep of an edge without swaps
_SHARE = 512  # places of a thread's share of the swaps; never fewer threads nor more change a bit
_MARGIN = 8  # points between the first that breaks anything and the lattice's first
_CLASSES = 24  # of equal mass that the mean field is made of


class SwapRates(NamedTuple):
    """Probabilities of a swap per time step and edge, before the sizes are known."""

    pairs: np.ndarray  # (edge, 2) numbers of the points below and above, streamline by streamline
    rise: np.ndarray  # (edge,) probability of segregation per m of size difference, 1/m
    mixing: np.ndarray  # (edge,) probability of mixing per squared mean size, 1/m2
    ceiling: np.ndarray  # (edge,) what holds segregation, see `hpgr.laws.exchange.Exchange.ceiling`; 0: nothing


class Exchanged(NamedTuple):
    """What only the lattice knows."""

    elapsed_time: np.ndarray  # (time,) time of each snapshot since the start, s
    steady: np.ndarray  # (time,) of bool, whether the start was forgotten: the product is that of these
    substeps: int  # most that a time step was split into to keep the swap probabilities of a cell at 1/2
    swaps_per_cell: float  # mean number of swaps a cell takes part in during one residence time


def parcel_of(scene: Scene, time_step: float, solid_fraction: np.ndarray) -> float:
    """Return m / rho_b, what a tube lets through in a time step, m2 of solid; solid fraction (streamline, point)."""
    tube = scene.rolls.gap / (2 * scene.resolution.streamlines)
    return tube * scene.rolls.speed * scene.rolls.diameter / 2 * time_step * solid_fraction[:, -1].mean()


def swap_rates(scene: Scene, bed: LoadedBed) -> SwapRates:
    """Return the swap rates on the edges of a tessellated bed, per time step."""
    exchange, cells = scene.exchange, bed.tessellation
    time_step, solid_fraction = bed.kinematics.time_step, bed.stress.solid_fraction
    lower, upper = cells.pairs.T

    def between(field):
        return (field.ravel()[lower] + field.ravel()[upper]) / 2

    parcel = parcel_of(scene, time_step, solid_fraction)
    shear_rate = np.sqrt(3) * between(bed.kinematics.shear_rate)
    sheared = cells.length * shear_rate * time_step * between(solid_fraction)
    return SwapRates(
        pairs=cells.pairs,
        rise=exchange.rising(sheared, cells.normal[:, 1], parcel),
        mixing=exchange.diffusion(sheared, cells.distance, parcel),
        ceiling=exchange.ceiling(shear_rate),
    )


def substeps_needed(rates: SwapRates, mixing: np.ndarray, means: np.ndarray, largest: float) -> np.ndarray:
    """Return in how many substeps of a time step each edge takes part, with its probability split between them.

    As many as the needier of its two parcels must have: then the probabilities of any cell sum to at most 1/2
    in each substep. Given the probability of a swap by mixing per time step (edge,), the mean size of the parcel at
    each point, m, and that of the largest grain anywhere, m.
    """
    substeps = np.empty(mixing.size, np.int64)
    kernels.split(rates.pairs, rates.rise, mixing, means, largest, LARGEST_SUM, np.zeros(means.size), substeps)
    return substeps


def refuse_substeps(scene: Scene, rates: SwapRates, substeps: int) -> None:
    """Raise ValueError with the predicted cost if a time step needs absurdly many substeps."""
    if substeps > MOST_SUBSTEPS:
        seconds = substeps * rates.pairs.shape[0] * scene.resolution.points * _SECONDS_PER_EDGE
        raise ValueError(
            f"exchange: got segregation {scene.exchange.segregation:g} and mixing {scene.exchange.mixing:g}; they need "
            f"{substeps:,} substeps per time step to keep swap probabilities at {LARGEST_SUM:g}, must be at most "
            f"{MOST_SUBSTEPS:,}; predicted cost above {seconds:,.0f} s; use fewer points or streamlines, a larger "
            "flow.entry_fraction, or weaker exchange"
        )


def edges_of(scene: Scene, rates: SwapRates, means: np.ndarray) -> tuple[Edges, int]:
    """Return the edges with the probabilities of one substep of a time step, given mean sizes, m, and the substeps."""
    lower, upper = rates.pairs.T
    mixing = rates.mixing * ((means[lower] + means[upper]) / 2) ** 2
    substeps = substeps_needed(rates, mixing, means, scene.feed.largest_grain)
    most = int(substeps.max(initial=1))
    refuse_substeps(scene, rates, most)
    turns = np.empty(substeps.sum(), np.int64)
    kernels.take_turns(substeps, most, np.zeros_like(substeps), turns)
    return Edges(rates.pairs, rates.rise / substeps, mixing / substeps, rates.ceiling, turns), most


def within(rates: SwapRates, points: int, first: int, last: int) -> SwapRates:
    """Return the rates of the edges between points `first` to before `last` of each streamline, numbered anew."""
    line, point = np.divmod(rates.pairs, points)
    inside = np.all((point >= first) & (point < last), axis=1)
    return of_edges(rates._replace(pairs=line * (last - first) + point - first), inside)


def of_edges(rates: SwapRates, which: np.ndarray) -> SwapRates:
    """Return the rates of these edges."""
    return SwapRates(*(part[which] for part in rates))


class Lattice:
    """All parcels between the rolls, in slots that stay put while the parcels shift from point to point.

    Parameters
    ----------
    scene : Scene
        What is simulated.
    log_stress : ndarray
        (streamline, point) log(sigma_a / sigma_m).
    rates : SwapRates
        Swap rates per time step.
    seed, replicate : int
        Keys of the randomness.
    steady : dict
        Time step -> number of the steady snapshot taken then. The parcel that is at the exit then has the key of the
        same snapshot without exchange, so that both share their random numbers.
    cores : Cores
        What the work is shared between.
    entering : callable, optional
        Quantile function of what enters, for rows of fractions of each streamline in turn; the feed's if not given.

    Attributes
    ----------
    slots : ndarray
        (streamline, point) slot of the parcel that is there now.
    parcels : Parcels
        (slot, ...) their cells.
    swaps, most_substeps : int
        Swaps so far, and the most substeps a time step has needed.
    """

    def __init__(
        self,
        scene: Scene,
        log_stress: np.ndarray,
        rates: SwapRates,
        seed: int,
        replicate: int,
        steady: dict[int, int],
        cores: march.Cores = march.ONE,
        entering: Callable | None = None,
    ):
        self._scene, self._rates, self._steady, self._each = scene, rates, steady, cores.each
        self._full = scene.exchange.startup is not None
        self._seed, self._replicate = seed, replicate
        self._path, self._ore = march.path(scene, log_stress), march.ore(scene)
        self._breaking = np.flatnonzero(can_break(scene, self._path))
        cells, scattered = scene.resolution.cells, math.isfinite(scene.strength.scatter)
        self.parcels = kernels.make_parcels(log_stress.size, cells, scattered)
        self._shares = kernels.make_shares(log_stress.size, cells, _SHARE, scattered)
        self._per_size = np.float32(2.0**30 / scene.feed.largest_grain)  # parts in which sizes are summed, to 3e-8
        self._works = [kernels.make_work(cells) for _ in range(cores.count)]
        self._home = np.arange(log_stress.size).reshape(log_stress.shape)
        self._lines, self._points = np.divmod(self._home.ravel(), log_stress.shape[1])
        self._beyond = self._points[rates.pairs].max(axis=1)  # of each edge, the further of its two points
        self.slots = self._home
        self._entering = entering
        self.swaps, self.most_substeps = 0, 0
        source = np.random.SeedSequence(seed, spawn_key=(replicate,))
        self._swap_key = int(source.generate_state(1, np.uint64)[0])

    def advance(self, step: int) -> None:
        """Take time step `step`: shift all parcels, let feed in; crush; swap.

        An empty machine fills point by point; where the start-up is recorded, all of it at step 0.
        """
        self.slots = np.roll(self._home, step, axis=1)
        self._let_in(step)
        breaking, rates = self._breaking, self._rates
        if not self._full and step < self._home.shape[1] - 1:
            breaking = breaking[self._points[breaking] <= step]
            rates = of_edges(rates, self._beyond <= step)
        at = self._points[breaking]
        self._crush(breaking, at, at + 1)
        self._swap(step, rates)

    def keep(self, slots: np.ndarray, sizes: np.ndarray) -> np.ndarray:
        """Copy the sizes of all cells in these slots to `sizes`, (..., cell), m, and return them."""
        for part, share in enumerate(self._shares.sizes):
            kept = sizes[..., part * _SHARE : (part + 1) * _SHARE]
            kept[...] = share[slots, : kept.shape[-1]]
        return sizes

    def classes(self, sieves: np.ndarray) -> np.ndarray:
        """Return the cells of each sieve class, (streamline, point, sieve + 1)."""
        kernels.gather(self._shares, self.slots.ravel(), self.parcels)
        counts = np.empty((self.slots.size, sieves.size + 1), np.int64)
        for place, slot in enumerate(self.slots.ravel()):
            kernels.classify(self.parcels.sizes, slot, sieves, place, counts)
        return counts.reshape(*self.slots.shape, -1)

    def _crush(self, places: np.ndarray, first: np.ndarray, last: np.ndarray) -> None:
        """Crush the parcels at these places at points from `first` to before `last`, shared between the cores."""
        passages = self.slots.ravel()[places], self._lines[places], first, last
        parts = np.array_split(np.arange(places.size), len(self._works))

        def crush(work, part):
            passage = Passage(*(each[part] for each in passages))
            kernels.gather(self._shares, passage.slots, self.parcels)
            kernels.crush(self.parcels, passage, self._path, self._ore, work, Record())
            kernels.spread(self.parcels, passage.slots, self._shares, self._per_size)

        list(self._each(crush, self._works, parts))

    def _let_in(self, step: int) -> None:
        """Put new parcels in the first points; at a fill of all as the bed would have brought them there."""
        fills = self._full and step == 0
        slots = self.slots if fills else self.slots[:, :1]
        at_once = max(march.AT_ONCE // (len(slots) * self._scene.resolution.cells), 1)
        for first in range(0, slots.shape[1], at_once):
            part = slots[:, first : first + at_once].T
            bases = np.concatenate([self._bases(step - first - point) for point in range(len(part))])
            march.fill(self.parcels, part.ravel(), self._scene, bases, self._entering)
        kernels.spread(self.parcels, slots.ravel(), self._shares, self._per_size)
        if fills and self._scene.exchange.startup == "crushed":
            self._crush(self._home.ravel(), 0 * self._points, self._points)

    def _bases(self, entered: int) -> np.ndarray:
        """Return the bases of the streams of what entered all streamlines at a step, which may lie before the first."""
        lines, points = self._home.shape
        snapshot = self._steady.get(entered + points - 1)
        if snapshot is not None:
            return march.bases(self._seed, [(self._replicate, line, snapshot) for line in range(lines)])
        # a fourth number keeps other parcels apart from those that share their key with the march
        source = np.random.SeedSequence(self._seed, spawn_key=(self._replicate, 0, 0, entered + points))
        return source.generate_state(2 * lines, np.uint64).reshape(lines, 2)

    def _swap(self, step: int, rates: SwapRates) -> None:
        """Swap cells across these edges, in as many substeps as keep the probabilities of a cell at 1/2."""
        slots, cells = self.slots.ravel(), self._scene.resolution.cells
        totals = self._shares.totals.sum(axis=0)[slots]
        means = (totals + 0.5 * cells) / (float(self._per_size) * cells)
        edges, most = edges_of(self._scene, rates, means)
        self.most_substeps = max(self.most_substeps, most)
        largest, per_size = self._scene.feed.largest_grain, self._per_size
        key = np.uint64(kernels.mix(np.uint64((self._swap_key + (step + 1) * 0xD1342543DE82EF95) % 2**64)))

        def swap(part):
            places = min(_SHARE, cells - part * _SHARE)
            numbers = np.empty(_SHARE // 4 + 1, np.uint64)
            hits = None if self.parcels.weakness is None else np.empty(_SHARE, bool)
            how = means, largest, per_size, key, numbers, numbers.view(np.uint16), hits
            return kernels.swap(self._shares, part, places, slots, edges, *how)

        self.swaps += sum(self._each(swap, range(self._shares.totals.shape[0])))


def settling(scene: Scene, rates: SwapRates, unbroken: int, points: int) -> int:
    """Return by how many points at most grains move away from their parcels on the way to the exit.

    That far behind the first parcels of a start nothing is left of what they lacked in neighbours. Large grains rise by
    their own probability, faster where the mean is no longer the feed's; mixing counts with two standard deviations.
    """
    line, point = np.divmod(rates.pairs, points)
    mean, apart = class_sizes(scene).mean(), np.abs(np.diff(point)).ravel()
    rises = rates.rise * (scene.feed.largest_grain - np.where(point[:, 0] < unbroken, mean, 0.0)) * apart
    mixes = rates.mixing * (mean * apart) ** 2
    variance = np.bincount(line[:, 0], mixes) + np.bincount(line[:, 1], mixes)
    return math.ceil((np.bincount(line[:, 0], rises) + 2 * np.sqrt(variance)).max(initial=0))


class Above(NamedTuple):
    """What the steady mean field of unbroken feed gives to a lattice that begins at a point of it."""

    entering: np.ndarray  # (streamline, class) part of each class of the feed, of equal mass, in what enters
    swaps: float  # expected of a cell index in a time step above the lattice
    substeps: int  # most that a time step has needed


def settle(scene: Scene, rates: SwapRates, shape: tuple[int, int], first: int) -> Above:
    """Return what enters a lattice at point `first` of a bed (streamline, point) where nothing breaks."""
    sizes, fractions, most = class_sizes(scene), np.full((*shape, _CLASSES), 1 / _CLASSES), 1
    flat, swaps, work = fractions.reshape(-1, _CLASSES), np.zeros(len(rates.pairs)), np.empty((2, _CLASSES))

    def shift(rates):
        fractions[:, 1:], fractions[:, 0] = fractions[:, :-1].copy(), 1 / _CLASSES
        means = flat @ sizes
        return *edges_of(scene, rates, means), means

    beyond = (rates.pairs % shape[1]).max(axis=1)
    for step in range(shape[1] + settling(scene, rates, shape[1], shape[1])):
        edges, substeps, means = shift(rates if step >= shape[1] else of_edges(rates, beyond <= step))
        kernels.swap_mean_field(flat, sizes, edges, means, swaps, *work)
        most = max(most, substeps)
    # The lattice swaps within itself, and not with what is above: its first parcels have done that when they enter.
    # Or large grains, which rise, would be carried in and never out
    edges, _, means = shift(rates)
    outside = (rates.pairs % shape[1] < first).sum(axis=1)[edges.turns]  # points of an edge above the lattice
    swaps[:] = 0
    kernels.swap_mean_field(flat, sizes, edges._replace(turns=edges.turns[outside == 1]), means, swaps, *work)
    entering = fractions[:, first].copy()
    for _ in range(20):  # of all lines together it is the feed: edges in another order than among all leave 1 % open
        entering *= len(entering) / (_CLASSES * entering.sum(axis=0))
        entering /= entering.sum(axis=1, keepdims=True)
    kernels.swap_mean_field(flat, sizes, edges._replace(turns=edges.turns[outside == 2]), means, swaps, *work)
    return Above(entering, swaps.sum(), most)


def class_sizes(scene: Scene) -> np.ndarray:
    """Return the mean sizes of the feed's classes of equal mass, finest first, m."""
    return scene.feed.quantile((np.arange(8 * _CLASSES) + 0.5) / (8 * _CLASSES)).reshape(_CLASSES, 8).mean(axis=1)


def can_break(scene: Scene, path: Path) -> np.ndarray:
    """Return whether anything can break at (streamline, point)."""
    if math.isinf(scene.strength.scatter) and math.isfinite(scene.strength.weibull_modulus):
        return path.critical_ratio <= scene.feed.largest_grain / scene.strength.reference_size * (1 + 1e-6)
    return np.isfinite(path.critical_ratio)


def first_break(scene: Scene, log_stress: np.ndarray) -> int:
    """Return the first point at which anything can break on any streamline; the number of points if none does."""
    breaking = can_break(scene, march.path(scene, log_stress)).any(axis=0)
    return int(np.argmax(breaking)) if breaking.any() else breaking.size


def run(
    scene: Scene, log_stress: np.ndarray, bed: LoadedBed, seed: int, replicate: int, reduced: bool
) -> tuple[Cells, Exchanged]:
    """Run the lattice until it is steady, and through its snapshots; through the start-up's before them if wished.

    It is steady when the parcel at the exit was `settling` points behind the first that entered. A reduced one begins
    above the first break, with cells drawn from the mean field of what is above it.
    """
    grid, wishes = scene.resolution, scene.exchange
    rates, entering, swaps, substeps = swap_rates(scene, bed), None, 0.0, 1
    unbroken = first_break(scene, log_stress)
    first = max(min(unbroken, grid.points - 1) - _MARGIN, 0) if reduced else 0
    if first > 0:
        above = settle(scene, within(rates, grid.points, 0, unbroken), (grid.streamlines, unbroken), first)
        swaps, substeps, entering = above.swaps, above.substeps, _quantile_of(scene, above.entering)
        rates = within(rates, grid.points, first, grid.points)
    full = grid.points - 1 - first  # the step at which the first parcel that entered is at the exit
    last = full + settling(scene, rates, unbroken - first, grid.points - first)
    steady = [last + k * wishes.interval for k in range(grid.snapshots)]
    steps = [*(range(0, last, wishes.interval) if wishes.startup else ()), *steady]
    sieves, mine = march.cell_sieves(scene), np.ascontiguousarray(log_stress[:, first:])
    product = np.empty((len(steady), grid.streamlines, grid.cells), np.float32)
    shape = (len(steps), *mine.shape, grid.cells)
    sizes, classes = np.empty(shape, np.float32) if grid.record == "cells" else None, []
    breaks = np.zeros(grid.streamlines, np.int64)
    with march.cores(mine.size * grid.cells) as cores:
        numbers = {step: k for k, step in enumerate(steady)}
        lattice = Lattice(scene, mine, rates, seed, replicate, numbers, cores, entering)
        for step in range(steps[-1] + 1):
            if step == full:
                before = lattice.swaps
            lattice.advance(step)
            if step not in steps:
                continue
            if sizes is not None:
                lattice.keep(lattice.slots, sizes[steps.index(step)])
            if grid.record == "distributions":
                classes.append(lattice.classes(sieves))
            if step >= last:
                lattice.keep(lattice.slots[:, -1], product[numbers[step]])
                breaks += lattice.parcels.breaks[lattice.slots[:, -1]]
    swaps += (lattice.swaps - before) / grid.cells / (steps[-1] + 1 - full)
    exchanged = Exchanged(
        elapsed_time=np.array(steps) * bed.kinematics.time_step,
        steady=np.array(steps) >= last,
        substeps=max(lattice.most_substeps, substeps),
        swaps_per_cell=2 * swaps / grid.streamlines,
    )
    kept = None if sizes is None else sizes[None], np.stack(classes)[None] if classes else None
    return Cells(product[None], breaks[None], *kept), exchanged


def _quantile_of(scene: Scene, shares: np.ndarray) -> Callable:
    """Return the quantile function of mixtures (streamline, class) of the feed's classes, for rows of each in turn."""
    passing = np.pad(np.cumsum(shares, axis=1), ((0, 0), (1, 0)))
    feed = np.linspace(0, 1, passing.shape[1])
    mixed = [partial(np.interp, xp=each / each[-1], fp=feed) for each in passing]
    return lambda rows: scene.feed.quantile(np.stack([one(row) for one, row in zip(cycle(mixed), rows)]))
