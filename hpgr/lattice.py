"""The whole lattice in motion: every time step all parcels shift by one point, are crushed, and swap cells."""

import numpy as np

from hpgr import exchange, kernels, parcels
from hpgr.exchange import SwapRates
from hpgr.scene import Scene

_NO_SIEVES, _NO_SNAPSHOTS, _NO_CLASSES = np.empty(0), np.empty((0, 0), np.float32), np.empty((0, 0), np.int64)


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
    photographed : dict
        Time step -> number of the steady photograph taken then. The parcel that is at the exit then has the
        key of the same photograph without exchange, so that both share their random numbers.

    Attributes
    ----------
    slots : ndarray
        (streamline, point) slot of the parcel that is there now.
    sizes, streams : ndarray
        (slot, cell) sizes, m, and random streams.
    breaks : ndarray
        (slot,) breaks of each parcel's cells since it entered.
    swaps, most_passes : int
        Swaps so far, and the most passes a time step has needed.
    """

    def __init__(
        self,
        scene: Scene,
        log_stress: np.ndarray,
        rates: SwapRates,
        seed: int,
        replicate: int,
        photographed: dict[int, int],
    ):
        self._scene, self._rates, self._photographed = scene, rates, photographed
        self._seed, self._replicate = seed, replicate
        self._log_stress, self._reach_needed = log_stress, parcels.reach_needed(scene, log_stress)
        count, cells = log_stress.size, scene.resolution.cells
        blocks = -(-cells // kernels.BLOCK)
        self.sizes, self.streams = np.empty((count, cells), np.float32), np.empty((count, cells), np.uint64)
        self._reach = np.empty((count, blocks * kernels.BLOCK), np.float32)
        self._block_reach = np.empty((count, blocks), np.float32)
        self._stale, self._largest = np.empty(count, bool), np.empty(count, np.float32)
        self.breaks = np.zeros(count, np.int64)
        self._home = np.arange(count).reshape(log_stress.shape)
        self.slots = self._home
        self.swaps, self.most_passes = 0, 0
        source = np.random.SeedSequence(seed, spawn_key=(replicate,))
        self._swap_key = int(source.generate_state(1, np.uint64)[0])
        self._constants, self._size_scale = parcels.constants(scene), parcels.size_scale(scene)

    def advance(self, step: int) -> None:
        """Take time step `step`: at 0 fill the machine, later shift all parcels and let feed in; crush; swap."""
        self.slots = np.roll(self._home, step, axis=1)
        entering = self.slots[:, :1] if step else self.slots
        self._let_in(step, entering)
        self.breaks[entering], self._stale[entering] = 0, True
        kernels.crush_lattice(
            self.sizes, self.streams, self._reach, self._block_reach, self._stale, self.breaks, self.slots.ravel(),
            self._log_stress.ravel(), self._reach_needed.ravel(), *self._constants,
        )  # fmt: skip
        self._swap(step)

    def classes(self, sieves: np.ndarray) -> np.ndarray:
        """Return the cells of each sieve class, (streamline, point, sieve + 1)."""
        counts = np.empty((self.slots.size, sieves.size + 1), np.int64)
        kernels.classify_lattice(self.sizes, self.slots.ravel(), sieves, counts)
        return counts.reshape(*self.slots.shape, -1)

    def _let_in(self, step: int, entering: np.ndarray) -> None:
        """Put new parcels in the first points; at the first fill as the bed would have brought them there."""
        for line, slots in enumerate(entering):
            keys = [self._key(line, step - point) for point in range(slots.size)]
            self.sizes[slots], self.streams[slots] = parcels.first_cells(self._scene, self._seed, keys)
        if step == 0 and self._scene.exchange.fill == "crushed":
            for line, point in np.ndindex(entering.shape):
                kernels.march(
                    self.sizes[entering[line, point]], self.streams[entering[line, point]],
                    self._log_stress[line, :point], self._reach_needed[line, :point],
                    _NO_SIEVES, _NO_SNAPSHOTS, _NO_CLASSES, *self._constants,
                )  # fmt: skip

    def _key(self, line: int, entered: int) -> tuple[int, ...]:
        """Return the random key of the parcel that entered a streamline at a step, which may lie before the first."""
        last = self._home.shape[1] - 1
        photograph = self._photographed.get(entered + last)
        if photograph is not None:
            return self._replicate, line, photograph
        # a fourth number keeps other parcels apart from those that share their key with the march
        return self._replicate, line, 0, 1 + entered + last

    def _swap(self, step: int) -> None:
        """Swap cells across all edges, in as many passes as keep the probabilities of a cell at 1/2."""
        slots, rates = self.slots.ravel(), self._rates
        means = np.empty(slots.size)
        kernels.measure(self.sizes, slots, means, self._largest)
        lower, upper = rates.pairs.T
        mixing = rates.mixing * ((means[lower] + means[upper]) / 2) ** 2
        passes = exchange.passes_needed(rates, mixing, means, self._scene.feed.coarsest)
        most = int(passes.max())
        exchange.refuse_passes(self._scene, rates, most)
        self.most_passes = max(self.most_passes, most)
        crushing = np.isfinite(self._reach_needed.ravel())
        for number in range(most):
            counter = (step << 20) + number + 1  # unique: the passes of a step are far fewer than 2^20
            key = np.uint64(kernels.mix(np.uint64((self._swap_key + counter * 0xD1342543DE82EF95) % 2**64)))
            self.swaps += kernels.swap(
                self.sizes, self.streams, self._reach, self._block_reach, self._stale, self._largest, slots, crushing,
                rates.pairs, rates.rise / passes, mixing / passes, passes, most, means, number, key,
                *self._size_scale,
            )  # fmt: skip
