"""With exchange: the whole lattice in motion. Each step all parcels shift by one point, are crushed, and swap cells."""

import math
from typing import NamedTuple

import numpy as np

from hpgr.bed.loaded import LoadedBed
from hpgr.grains import kernels, march
from hpgr.grains.kernels import Edges, Parcels, Record
from hpgr.grains.march import Cells
from hpgr.scene import Scene

LARGEST_SUM = 0.5  # of the swap probabilities of a cell in one substep; above it swaps overshoot their equilibrium
MOST_SUBSTEPS = 1000  # per time step; a scene that needs more is refused
_SECONDS_PER_EDGE = 1e-8  # of one substep of an edge without swaps


class SwapRates(NamedTuple):
    """Probabilities of a swap per time step and edge, before the sizes are known.

    Attributes
    ----------
    pairs : ndarray
        (edge, 2) numbers of the points below and above, streamline by streamline.
    rise : ndarray
        (edge,) probability of segregation per m of size difference, 1/m.
    mixing : ndarray
        (edge,) probability of mixing per squared mean size, 1/m2.
    """

    pairs: np.ndarray
    rise: np.ndarray
    mixing: np.ndarray


class Exchanged(NamedTuple):
    """What only the lattice knows.

    Attributes
    ----------
    elapsed_time : ndarray
        (time,) time of each snapshot since the first fill, s.
    steady : ndarray of bool
        (time,) whether it was taken after one residence time; the product is that of these snapshots.
    substeps : int
        Most substeps a time step was split into to keep the swap probabilities of a cell at 1/2.
    swaps_per_cell : float
        Mean number of swaps a cell takes part in during one residence time.
    """

    elapsed_time: np.ndarray
    steady: np.ndarray
    substeps: int
    swaps_per_cell: float


def swap_rates(scene: Scene, bed: LoadedBed) -> SwapRates:
    """Return the swap rates on the edges of a tessellated bed, per time step."""
    exchange, rolls, cells = scene.exchange, scene.rolls, bed.tessellation
    time_step, solid_fraction = bed.kinematics.time_step, bed.stress.solid_fraction
    lower, upper = cells.pairs.T

    def between(field):
        return (field.ravel()[lower] + field.ravel()[upper]) / 2

    tube = rolls.gap / (2 * scene.resolution.streamlines)
    # m / rho_b: what a tube lets through in a time step, at the local density
    parcel = tube * rolls.speed * rolls.diameter / 2 * time_step * solid_fraction[:, -1].mean()
    sheared = cells.length * np.sqrt(3) * between(bed.kinematics.shear_rate) * time_step * between(solid_fraction)
    return SwapRates(
        pairs=cells.pairs,
        rise=exchange.percolation(sheared, cells.normal[:, 1], parcel),
        mixing=exchange.diffusion(sheared, cells.distance, parcel),
    )


def substeps_needed(rates: SwapRates, mixing: np.ndarray, means: np.ndarray, largest: float) -> np.ndarray:
    """Return in how many substeps of a time step each edge takes part, with its probability split between them.

    As many as the needier of its two parcels must have: then the probabilities of any cell sum to at most 1/2
    in each substep.

    Parameters
    ----------
    rates : SwapRates
        Swap rates per time step.
    mixing : ndarray
        (edge,) probability of a swap by mixing per time step.
    means : ndarray
        Mean size of the parcel at each point, m.
    largest : float
        Size of the largest grain anywhere, m.
    """
    lower, upper = rates.pairs.T
    most = mixing + rates.rise * (np.maximum(largest - means[lower], 0) + means[upper])
    sums = np.bincount(lower, most, means.size) + np.bincount(upper, most, means.size)
    needed = np.maximum(np.ceil(sums / LARGEST_SUM), 1.0)
    return np.maximum(needed[lower], needed[upper]).astype(np.int64)


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

    Attributes
    ----------
    slots : ndarray
        (streamline, point) slot of the parcel that is there now.
    parcels : Parcels
        (slot, ...) their cells.
    breaks : ndarray
        (slot,) breaks of each parcel's cells since it entered.
    swaps, most_substeps : int
        Swaps so far, and the most substeps a time step has needed.
    """

    def __init__(
        self, scene: Scene, log_stress: np.ndarray, rates: SwapRates, seed: int, replicate: int, steady: dict[int, int]
    ):
        self._scene, self._rates, self._steady = scene, rates, steady
        self._seed, self._replicate = seed, replicate
        self._path, self._ore = march.path(scene, log_stress), march.ore(scene)
        count, cells = log_stress.size, scene.resolution.cells
        blocks = -(-cells // kernels.BLOCK)
        self.parcels = Parcels(
            np.zeros((count, cells + 2), np.float32),
            np.zeros((count, cells + 2), np.uint64),
            np.empty((count, 0 if math.isinf(scene.strength.scatter) else cells + 2), np.float32),
            np.empty((count, cells + 2), np.float32),
            np.empty((count, blocks * kernels.BLOCK + 2), np.float32),
            np.empty((count, -(-blocks // kernels.BLOCK) * kernels.BLOCK), np.float32),
        )
        self._bounds_outdated, self._largest = np.ones(count, bool), np.empty(count, np.float32)
        self.breaks = np.zeros(count, np.int64)
        self._home = np.arange(count).reshape(log_stress.shape)
        self.slots = self._home
        self.swaps, self.most_substeps = 0, 0
        source = np.random.SeedSequence(seed, spawn_key=(replicate,))
        self._swap_key = int(source.generate_state(1, np.uint64)[0])

    def advance(self, step: int) -> None:
        """Take time step `step`: at 0 fill the machine, later shift all parcels and let feed in; crush; swap."""
        self.slots = np.roll(self._home, step, axis=1)
        entering = self.slots[:, :1] if step else self.slots
        self._let_in(step, entering)
        self.breaks[entering], self._bounds_outdated[entering] = 0, True
        everywhere = kernels.Path(*(part.ravel() for part in self._path))
        kernels.crush_lattice(
            self.parcels, self._bounds_outdated, self.breaks, self.slots.ravel(), everywhere, self._ore
        )
        self._swap(step)

    def sizes(self) -> np.ndarray:
        """Return the sizes of all cells, (streamline, point, cell), m."""
        return self.parcels.sizes[self.slots, 1:-1]

    def classes(self, sieves: np.ndarray) -> np.ndarray:
        """Return the cells of each sieve class, (streamline, point, sieve + 1)."""
        counts = np.empty((self.slots.size, sieves.size + 1), np.int64)
        kernels.classify(self.parcels.sizes, self.slots.ravel(), sieves, counts)
        return counts.reshape(*self.slots.shape, -1)

    def _let_in(self, step: int, entering: np.ndarray) -> None:
        """Put new parcels in the first points; at the first fill as the bed would have brought them there."""
        for line, slots in enumerate(entering):
            keys = [self._key(line, step - point) for point in range(slots.size)]
            self.parcels.sizes[slots], self.parcels.streams[slots] = march.first_cells(self._scene, self._seed, keys)
        if step == 0 and self._scene.exchange.start == "crushed":
            for point in range(1, entering.shape[1]):
                self._crush_before(entering[:, point], point)

    def _crush_before(self, slots: np.ndarray, point: int) -> None:
        """Crush the parcels of these slots, one per streamline, at all points before `point`."""
        sizes, streams = self.parcels.sizes[slots], self.parcels.streams[slots]
        before = kernels.Path(*(np.ascontiguousarray(part[:, :point]) for part in self._path))
        nothing = Record(np.empty(0), np.empty((0, 0, 0), np.float32), np.empty((0, 0, 0), np.int64))
        kernels.march(sizes, streams, np.arange(slots.size), before, self._ore, nothing, np.empty(slots.size, np.int64))
        self.parcels.sizes[slots], self.parcels.streams[slots] = sizes, streams

    def _key(self, line: int, entered: int) -> tuple[int, ...]:
        """Return the random key of the parcel that entered a streamline at a step, which may lie before the first."""
        last = self._home.shape[1] - 1
        snapshot = self._steady.get(entered + last)
        if snapshot is not None:
            return self._replicate, line, snapshot
        # a fourth number keeps other parcels apart from those that share their key with the march
        return self._replicate, line, 0, 1 + entered + last

    def _swap(self, step: int) -> None:
        """Swap cells across all edges, in as many substeps as keep the probabilities of a cell at 1/2."""
        slots, rates = self.slots.ravel(), self._rates
        means = np.empty(slots.size)
        kernels.measure(self.parcels.sizes, slots, means, self._largest)
        lower, upper = rates.pairs.T
        mixing = rates.mixing * ((means[lower] + means[upper]) / 2) ** 2
        substeps = substeps_needed(rates, mixing, means, self._scene.feed.largest_grain)
        most = int(substeps.max())
        refuse_substeps(self._scene, rates, most)
        self.most_substeps = max(self.most_substeps, most)
        edges = Edges(rates.pairs, rates.rise / substeps, mixing / substeps, substeps)
        for number in range(most):
            counter = (step << 20) + number + 1  # unique: the substeps of a step are far fewer than 2^20
            key = np.uint64(kernels.mix(np.uint64((self._swap_key + counter * 0xD1342543DE82EF95) % 2**64)))
            self.swaps += kernels.swap(
                self.parcels, self._bounds_outdated, self._largest, slots, edges, means, number, most, key
            )


def run(scene: Scene, log_stress: np.ndarray, bed: LoadedBed, seed: int, replicate: int) -> tuple[Cells, Exchanged]:
    """Run the lattice through one residence time to the steady snapshots, and the start-up's if wished."""
    grid, wishes = scene.resolution, scene.exchange
    last = grid.points - 1  # the step at which the first parcel that entered is at the exit
    steady = [last + k * wishes.interval for k in range(grid.snapshots)]
    steps = [*(range(0, last, wishes.interval) if wishes.record_startup else ()), *steady]
    rates = swap_rates(scene, bed)
    lattice = Lattice(scene, log_stress, rates, seed, replicate, {step: k for k, step in enumerate(steady)})
    sieves = march.cell_sieves(scene)
    sizes, classes, product, breaks = [], [], [], np.zeros(log_stress.shape[0], np.int64)
    for step in range(steps[-1] + 1):
        lattice.advance(step)
        if step not in steps:
            continue
        if grid.record == "cells":
            sizes.append(lattice.sizes())
        if grid.record == "distributions":
            classes.append(lattice.classes(sieves))
        if step >= last:
            at_exit = lattice.slots[:, -1]
            product.append(lattice.parcels.sizes[at_exit, 1:-1])
            breaks += lattice.breaks[at_exit]
    residences = (steps[-1] + 1) / grid.points
    exchanged = Exchanged(
        elapsed_time=np.array(steps) * bed.kinematics.time_step,
        steady=np.array(steps) >= last,
        substeps=lattice.most_substeps,
        swaps_per_cell=2 * lattice.swaps / (log_stress.size * grid.cells * residences),
    )
    cells = Cells(np.stack(product), breaks, np.stack(sizes) if sizes else None, np.stack(classes) if classes else None)
    return cells, exchanged
