import itertools
import math
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import special, stats
from support import COMPILED, GOLDEN, SIGMAS, paper, sized, split_mix

from hpgr import presets, simulate
from hpgr.bed.loaded import inputs_of, load_bed
from hpgr.grains import kernels, lattice
from hpgr.grains.kernels import Edges
from hpgr.grains.lattice import SwapRates, swap_rates
from hpgr.run import run_scene

INF = math.inf


def prepared(scene):
    return load_bed(inputs_of(scene, tessellated=True))


def mixed(values=None):
    return paper({"exchange.segregation": 0.1, "exchange.mixing": 0.1} | (values or {}))


# --- swap rates --------------------------------------------------------------------------------------------


def bed_of(shear_rate, time_step, solid_fraction, pairs, length, normal, distance):
    """Return as much of a loaded bed as swap rates are made of."""
    return SimpleNamespace(
        kinematics=SimpleNamespace(shear_rate=np.array(shear_rate), time_step=time_step),
        stress=SimpleNamespace(solid_fraction=np.array(solid_fraction)),
        tessellation=SimpleNamespace(pairs=np.array(pairs), length=length, normal=normal, distance=distance),
    )


def one_edge(segregation, mixing):
    """Two points 0.2 m apart, the edge 0.3 m long and tilted, in a stream tube of 5 mm."""
    exchange = {"segregation": segregation, "mixing": mixing}
    scene = paper({"exchange": exchange, "resolution.streamlines": 2, "rolls.gap": 0.02, "rolls.speed": 2.0})
    shear_rate, solid_fraction = [[4.0, 6.0], [0.0, 0.0]], [[0.6, 0.8], [0.7, 0.9]]
    edge = [[1, 0]], np.array([0.3]), np.array([[0.6, 0.8]]), np.array([0.2])
    return swap_rates(scene, bed_of(shear_rate, 0.01, solid_fraction, *edge))


def test_rates_of_one_edge_by_hand():
    """f dt = l dt gammadot phi A n_y / (m / rho_s) per m, and l dt gammadot phi B / (d m / rho_s) per m2.

    Shear rate sqrt(3) (4 + 6) / 2 = 8.66 /s and solid fraction 0.7 at the edge; tube 0.02 / 4 = 5 mm at the
    exit, roll surface 2 x 3 = 6 m/s, solid fraction (0.8 + 0.9) / 2 there: m / rho_s = 0.005 x 6 x 0.01 x 0.85.
    """
    found = one_edge(0.1, 0.2)
    sheared = 0.3 * math.sqrt(3) * 5 * 0.01 * 0.7
    parcel = 0.005 * 6 * 0.01 * 0.85
    assert found.rise == pytest.approx([0.1 * sheared * 0.8 / parcel], rel=1e-12)
    assert found.mixing == pytest.approx([0.2 * sheared / (0.2 * parcel)], rel=1e-12)
    assert found.pairs.tolist() == [[1, 0]]


def test_rates_are_never_negative():
    for gap in (1e-6, 0.06, 1.0):
        scene = mixed({"rolls.gap": gap, "rolls.entry_gap": gap + 1.08})
        found = swap_rates(scene, prepared(scene))
        for rate in (found.rise, found.mixing):
            assert np.isfinite(rate).all()
            assert (rate >= 0).all()
        assert (found.mixing > 0).all()


# Speed. Every rate of the closure is a shear rate times lengths, and so are the rates of eqs. 1, 2 and 4 by time
# not entering at all. The bed's motion is prescribed: its shear rate is omega times a function of place, and a
# parcel stays at a place for a time proportional to 1 / omega. Probability = rate x time then holds no omega: with
# A and B pure numbers there is no other time in the model (no gravity, no grain inertia, no viscosity) that could
# make a dimensionless group with omega. So the product of a scene with exchange cannot depend on roll speed. A
# closure that has speed in it needs another time scale, such as sqrt(s / g) of percolation under gravity.


@pytest.mark.parametrize("record", ["cells", "distributions"])
def test_product_with_exchange_does_not_know_the_speed(record):
    slow = mixed({"resolution.points": 16, "resolution.cells": 24, "resolution.record": record})
    fast = slow.with_values({"rolls.speed": 2 * slow.rolls.speed})
    one, other = simulate(slow, seed=1), simulate(fast, seed=1)
    assert float(one["swaps_per_cell"]) > 0.5
    product = "size" if record == "cells" else "mass_fraction"
    for name in (product, "passing", "p50", "p80", "breaks_per_cell", "swaps_per_cell", "exchange_substeps", "volume"):
        assert np.array_equal(one[name], other[name]), name
    assert float(other["throughput"]) == pytest.approx(2 * float(one["throughput"]))
    assert float(other["elapsed_time"][0]) == pytest.approx(float(one["elapsed_time"][0]) / 2)


@pytest.mark.skipif(not COMPILED, reason="a percent of swaps takes more cells than Python can swap")
def test_percolation_under_gravity_knows_the_speed():
    """Slow rolls segregate as under "shear", fast ones ever less: grains have no time to fall."""
    base = mixed({"exchange.mixing": 0.0, "resolution.points": 31, "resolution.cells": 400})
    swaps = []
    for percolation, factor in (("shear", 1.0), ("gravity", 1e-4), ("gravity", 1.0), ("gravity", 100.0)):
        values = {"exchange.percolation": percolation, "rolls.speed": factor * base.rolls.speed}
        swaps.append(float(simulate(base.with_values(values), seed=3)["swaps_per_cell"]))
    assert swaps[1] == pytest.approx(swaps[0], rel=2e-3)
    assert 0.95 * swaps[1] < swaps[2] < 0.99 * swaps[1]  # of the paper's machine, at 6 m/s
    assert swaps[3] < 0.5 * swaps[1]


@pytest.mark.slow
def test_speed_hardly_shows_in_the_product_of_a_grinding_zone_of_a_tenth_of_a_second():
    """From a crawl to a hundred times the paper's speed under "gravity", ten replicates that share random numbers.

    Swaps fall by 4.6 % +- 0.1 %, P80 changes by 0.0 % +- 0.3 %; judged at 6 standard errors.
    """
    grid = {"resolution.points": 60, "resolution.cells": 500, "resolution.record": "product"}
    base = presets.paper().with_values(grid | {"exchange": {"percolation": "gravity"}})

    def figures(factor):
        scene = base.with_values({"rolls.speed": factor * base.rolls.speed})
        results = [run_scene(scene, seed=1, replicate=k).values for k in range(10)]
        return np.array([[float(one[name]) for name in ("p80_total", "swaps_per_cell")] for one in results])

    change = figures(100.0) / figures(1e-4) - 1
    mean, error = change.mean(axis=0), change.std(axis=0, ddof=1) / np.sqrt(10)
    assert abs(mean[0]) < 6 * error[0] < 0.03
    assert mean[1] == pytest.approx(-0.046, abs=6 * error[1])


# --- substeps ------------------------------------------------------------------------------------------------


def takes_part(number, substeps, most):
    """Which edges swap in a substep of all, so that their turns are evenly spread."""
    return (number + 1) * substeps // most != number * substeps // most


def random_rates(seed, points=12, edges=40, scale=1.0):
    generator = np.random.default_rng(seed)
    pairs = np.array([generator.choice(points, 2, replace=False) for _ in range(edges)])
    rise, mixing = scale * generator.exponential(5, edges), scale * generator.exponential(0.1, edges)
    return SwapRates(pairs, rise, mixing, np.zeros(edges)), generator.uniform(0.001, 0.06, points)


def squared(rates, means):
    """The squared mean size at each edge."""
    return ((means[rates.pairs[:, 0]] + means[rates.pairs[:, 1]]) / 2) ** 2


@pytest.mark.parametrize("scale", [1e-3, 0.3, 3.0, 30.0])
def test_probabilities_of_a_cell_sum_to_at_most_half_in_every_substep(scale):
    """The worst cells that could be there: every edge at its largest probability."""
    busiest = 0.0
    for seed in range(5):
        rates, means = random_rates(seed, scale=scale)
        largest = 0.06
        substeps = lattice.substeps_needed(rates, rates.mixing, means, largest)
        lower, upper = rates.pairs.T
        worst = rates.mixing + rates.rise * (largest - means[lower] + means[upper])
        most = substeps.max()
        times, spread = np.zeros(lower.size, int), np.zeros(lower.size)
        for number in range(most):
            part = takes_part(number, substeps, most)
            times += part
            chance = np.where(part, worst / substeps, 0)
            spread += chance
            sums = np.bincount(lower, chance, means.size) + np.bincount(upper, chance, means.size)
            busiest = max(busiest, sums.max())
            assert sums.max() <= 0.5 + 1e-12
        assert np.array_equal(times, substeps)  # every edge takes part as often as its probability was split
        assert np.allclose(spread, worst, rtol=1e-12)  # and no probability is lost or clipped
        edges, count = lattice.edges_of(mixed(), rates._replace(mixing=rates.mixing / squared(rates, means)), means)
        turns = [np.flatnonzero(takes_part(number, substeps, most)) for number in range(most)]
        assert (count, edges.turns.tolist()) == (most, np.concatenate(turns).tolist())
        assert edges.mixing * substeps == pytest.approx(rates.mixing)
    if scale >= 3:
        assert busiest > 0.4  # no more substeps than needed
    assert (scale > 1e-3) or most == 1


def test_substeps_by_hand():
    """Three points in a row, sums 0.3, 1.2 and 0.9: 1, 3 and 2 substeps, an edge as many as its needier point."""
    rates = SwapRates(np.array([[0, 1], [1, 2]]), np.zeros(2), np.array([0.3, 0.9]), np.zeros(2))
    assert lattice.substeps_needed(rates, rates.mixing, np.full(3, 0.02), 0.06).tolist() == [3, 3]
    rates = SwapRates(np.array([[0, 1], [2, 3]]), np.zeros(2), np.array([0.5, 0.51]), np.zeros(2))
    assert lattice.substeps_needed(rates, rates.mixing, np.full(4, 0.02), 0.06).tolist() == [1, 2]
    assert lattice.substeps_needed(rates, np.full(2, 1e25), np.full(4, 0.02), 0.06).min() == 10**18  # and no wrap


def test_segregation_counts_with_the_largest_grain_below_and_dust_above():
    rates = SwapRates(np.array([[0, 1]]), np.array([10.0]), np.zeros(1), np.zeros(1))
    means = np.array([0.01, 0.03])
    assert lattice.substeps_needed(rates, np.zeros(1), means, 0.06).tolist() == [2]  # 10 (0.05 + 0.03) = 0.8
    assert lattice.substeps_needed(rates, np.zeros(1), means, 0.02).tolist() == [1]  # 10 (0.01 + 0.03) = 0.4
    assert lattice.substeps_needed(rates, np.zeros(1), means, 0.001).tolist() == [1]  # none below the mean: 0.3


def test_absurd_exchange_is_refused_with_its_cost():
    scene = mixed({"resolution.streamlines": 40, "resolution.points": 200, "resolution.cells": 2})
    with pytest.raises(ValueError, match=r"exchange: .*mixing 100; they need .* substeps per time step") as refused:
        simulate(scene.with_values({"exchange.mixing": 100}))
    for part in ("must be at most 1,000", "predicted cost above", " s; use fewer points"):
        assert part in str(refused.value)


def test_the_last_number_of_passes_that_is_not_refused():
    rates = SwapRates(np.array([[0, 1]]), np.zeros(1), np.ones(1), np.zeros(1))
    lattice.refuse_substeps(mixed(), rates, lattice.MOST_SUBSTEPS)
    with pytest.raises(ValueError, match=f"{lattice.MOST_SUBSTEPS + 1:,} substeps"):
        lattice.refuse_substeps(mixed(), rates, lattice.MOST_SUBSTEPS + 1)


# --- swaps: a column of parcels ----------------------------------------------------------------------------


class Column:
    """Parcels with edges between them, one substep after the other under held probabilities.

    Strengths scatter, and each grain's own is a number of its own, by which it is known.
    """

    def __init__(self, sizes, pairs=None, rise=0.0, mixing=0.0, means=None, seed=0, ceiling=0.0, shares=1):
        sizes = np.array(sizes, np.float32)
        points, cells = sizes.shape
        self.shares = kernels.make_shares(points, cells, -(-cells // shares), scattered=True)
        for mine, values in zip(self.shares[:2], (sizes, np.arange(points * cells)), strict=True):
            mine[:] = values.reshape(points, shares, -1).swapaxes(0, 1)
        self.slots = np.arange(points)
        self.pairs = np.array([(k, k + 1) for k in range(points - 1)] if pairs is None else pairs)
        rates = (np.broadcast_to(rate, len(self.pairs)).astype(float) for rate in (rise, mixing, ceiling))
        self.rise, self.mixing, self.ceiling = rates
        self.means = sizes.mean(axis=1, dtype=float) if means is None else np.broadcast_to(means, points).copy()
        self.keys = (np.uint64(split_mix((seed << 32) + number * GOLDEN)) for number in itertools.count())

    @property
    def sizes(self):
        """Sizes (point, cell)."""
        return np.concatenate(self.shares.sizes, axis=1)

    @property
    def marks(self):
        """Numbers of the grains (point, cell)."""
        return np.concatenate(self.shares.weakness, axis=1)

    def swap(self, times=1, order=1):
        """Return the number of swaps of `times` substeps, the shares in this order."""
        swaps, (parts, _, places) = 0, self.shares.sizes.shape
        edges = Edges(self.pairs, self.rise, self.mixing, self.ceiling, np.arange(len(self.pairs)))
        numbers, hits = np.empty(places // 4 + 1, np.uint64), np.empty(places, bool)
        for _ in range(times):
            before, key = self.shares.sizes.copy(), next(self.keys)
            self.shares.swapped[:] = False
            how = edges, self.means, before.max(), np.float32(1.0), key, numbers, numbers.view(np.uint16), hits
            for part in range(parts)[::order]:
                swaps += kernels.swap(self.shares, part, places, self.slots, *how)
            assert self.shares.swapped[np.any(before != self.shares.sizes, axis=2)].all()
        return swaps


SPARSE, DENSEST = kernels.DENSE / 2, 0.3  # a probability on either branch of kernels.swap


def halves(cells, **wishes):
    """Two boxes, the upper all of size 2 and the lower all of size 1."""
    return Column(np.repeat([[1.0], [2.0]], cells, axis=1), means=1.5, **wishes)


@pytest.mark.parametrize("chance", [0.002, SPARSE, kernels.DENSE * 1.01, DENSEST, 0.5])
def test_a8_two_boxes_mix_exponentially(chance):
    """c - 1/2 = (1 - 2P)^t / 2: cells are independent, so the count is binomial at every t.

    10 times, 5 sigma: by chance once in 170,000 tests. At P = 1/2 they are mixed at once.
    """
    cells = sized(40_000, 1_000)
    column = halves(cells, mixing=chance, seed=1)
    for t in range(1, 11):
        column.swap()
        expected = 0.5 + (1 - 2 * chance) ** t / 2
        found = np.mean(column.sizes[1] == 2)
        assert abs(found - expected) < SIGMAS * math.sqrt(expected * (1 - expected) / cells)
    assert np.mean(column.sizes[0] == 1) == found


def agrees(counts, probabilities):
    """Chi-square of counts at 1e-6, classes of less than 8 expected pooled."""
    counts, expected = np.asarray(counts, float), np.sum(counts) * np.asarray(probabilities, float)
    order = np.argsort(-expected)
    counts, expected = counts[order], expected[order]
    keep = max(1, int(np.sum(expected >= 8)))
    counts = np.append(counts[:keep], counts[keep:].sum())
    expected = np.append(expected[:keep], expected[keep:].sum())
    used = expected > 1e-9
    assert counts[~used].sum() == 0
    return np.sum((counts - expected)[used] ** 2 / expected[used]) < stats.chi2.isf(1e-6, used.sum() - 1)


@pytest.mark.parametrize("cells", [1, 7, 100])
@pytest.mark.parametrize("chance", [0.001, SPARSE, kernels.DENSE, kernels.DENSE * 1.001, DENSEST])
def test_number_of_swaps_of_an_edge_is_binomial(chance, cells):
    """Geometric skipping is exact: in either branch the number of swaps follows Binomial(M, P). 1e-6 a test."""
    trials = sized(4000, 400)
    column = halves(cells, mixing=chance, seed=cells)
    counts = np.bincount([column.swap() for _ in range(trials)], minlength=cells + 1)
    assert agrees(counts, stats.binom(cells, chance).pmf(np.arange(cells + 1)))


@pytest.mark.parametrize("chance", [kernels.DENSE, DENSEST])
def test_neighbouring_cells_swap_independently(chance):
    """Both of two neighbours with P^2: skipping leaves none out. 6 sigma: by chance once in 10^8."""
    cells, trials = 100, sized(4000, 300)
    pairs = 0
    for seed in range(trials // 100):
        column = Column(np.arange(2.0 * cells).reshape(2, cells) + 1, mixing=chance, means=1.0, seed=seed)
        for _ in range(100):
            before = column.sizes[0].copy()
            column.swap()
            moved = before != column.sizes[0]
            pairs += np.sum(moved[1:] & moved[:-1])
    expected = trials * (cells - 1) * chance**2
    # neighbouring pairs share a cell: variance n P^2 (1 - P^2) + 2 n (P^3 - P^4)
    noise = math.sqrt(expected * (1 - chance**2 + 2 * chance * (1 - chance)))
    assert abs(pairs - expected) < 6 * noise


@pytest.mark.parametrize("chance", [SPARSE, DENSEST])
def test_each_cell_swaps_as_often_as_any_other(chance):
    """Counts of swaps per place are binomial over the substeps: also the first and the last cell. 1e-6 a test."""
    cells, substeps = 20, sized(20_000, 1_000)
    column = Column(np.arange(2.0 * cells).reshape(2, cells) + 1, mixing=chance, means=1.0, seed=3)
    moved = np.zeros(cells)
    for _ in range(substeps):
        before = column.sizes[0].copy()
        column.swap()
        moved += before != column.sizes[0]
    statistic = np.sum((moved - substeps * chance) ** 2 / (substeps * chance * (1 - chance)))
    assert statistic < stats.chi2.isf(1e-6, cells)
    assert statistic > stats.chi2.isf(1 - 1e-6, cells)


@pytest.mark.parametrize("ceiling", [0.0, 20.0])
def test_swap_chance_of_every_pair_of_sizes(ceiling):
    """mixing + rise ((a - mean below)+ + (mean above - b)+), each held by the ceiling, thinned or decided in turn.

    Binomial, 5 sigma, 32 comparisons: by chance once in 54,000 tests.
    """

    def held(difference, mean):
        return np.maximum(difference, 0) / (1 + ceiling * np.maximum(difference, 0) / math.sqrt(mean))

    kinds, trials = np.array([0.01, 0.02, 0.03, 0.04]), sized(20_000, 800)
    below, above = (grid.ravel() for grid in np.meshgrid(kinds, kinds + 0.001, indexing="ij"))
    for scale in (0.1, 1.0):
        rise, mixing, means = scale * 2.0, scale * 0.01, np.array([0.022, 0.031])
        most = mixing + rise * (held(0.04 - 0.022, 0.022) + held(0.031, 0.031))
        assert (most > kernels.DENSE) == (scale == 1.0)
        column = Column(
            [np.repeat(below, trials), np.repeat(above, trials)], None, rise, mixing, means, seed=4, ceiling=ceiling
        )
        first = column.sizes[0].copy()
        column.swap()
        swapped = (column.sizes[0] != first).reshape(16, trials).mean(axis=1)
        chance = mixing + rise * (held(below - means[0], means[0]) + held(means[1] - above, means[1]))
        assert np.all(abs(swapped - chance) < SIGMAS * np.sqrt(chance * (1 - chance) / trials))


# --- A9: a chain of boxes ----------------------------------------------------------------------------------


def mean_field(values, pairs, chances):
    """One substep: E s <- prod_e (I - P L_e) E s, edges in order."""
    values = np.array(values, float)
    for (i, j), chance in zip(pairs, chances, strict=True):
        flow = chance * (values[j] - values[i])
        values[i] += flow
        values[j] -= flow
    return values


RING = [(0, 1), (2, 1), (2, 3), (4, 3), (0, 4), (1, 3)]


@pytest.mark.parametrize("scale", [0.03, 1.0])
def test_a9_mean_sizes_follow_the_mean_field(scale):
    """A network of five boxes, a probability for each edge. Counts of one size in a box are binomial.

    5 boxes, 8 substeps, 5 sigma: by chance once in 43,000 tests.
    """
    cells = sized(20_000, 800)
    chances = scale * np.array([0.1, 0.25, 0.4, 0.05, 0.3, 0.15])
    boxes = np.repeat([[2.0], [1.0], [1.0], [1.0], [1.0]], cells, axis=1)
    column = Column(boxes, RING, mixing=chances, means=1.0, seed=5)
    share = np.array([1.0, 0, 0, 0, 0])
    for _ in range(8):
        column.swap()
        share = mean_field(share, RING, chances)
        found = np.mean(column.sizes == 2, axis=1)
        assert np.all(abs(found - share) < SIGMAS * np.sqrt(share * (1 - share) / cells) + 1e-12)
    assert share.sum() == pytest.approx(1)


@pytest.mark.parametrize("rise", [0.0, 3.0])
@pytest.mark.parametrize("mixing", [0.0, SPARSE, DENSEST])
def test_a9_cells_are_conserved_bit_for_bit_and_their_strengths_travel_with_them(mixing, rise):
    """Of every index: the multiset of (size, strength) pairs; so the mass of every size class, exactly."""
    generator = np.random.default_rng(6)
    sizes = generator.uniform(0.008, 0.06, (5, 100)).astype(np.float32)
    column = Column(sizes, RING, rise=rise, mixing=mixing, seed=6, shares=2)
    swaps = column.swap(20)
    assert (swaps > 50) == (rise > 0 or mixing > 0)
    moved = np.mean(column.sizes != sizes)
    assert (moved > 0.2) == (swaps > 0)
    assert np.array_equal(np.sort(column.sizes, axis=0), np.sort(sizes, axis=0))
    assert np.array_equal(np.sort(column.marks, axis=0), np.arange(500).reshape(5, 100))
    assert np.array_equal(sizes.ravel()[column.marks.astype(int)], column.sizes)


def test_slots_decide_which_parcels_swap():
    """Parcels stay in their slots while points shift: edge and means are of points."""
    straight = Column(np.arange(1.0, 301).reshape(3, 100), [(0, 1)], mixing=0.2, means=[1, 2, 3], seed=7)
    turned = Column(np.roll(straight.sizes, 1, axis=0), [(0, 1)], mixing=0.2, means=[1, 2, 3], seed=7)
    turned.slots = np.array([1, 2, 0])
    straight.swap(3)
    turned.swap(3)
    assert np.array_equal(turned.sizes[turned.slots], straight.sizes)
    assert np.array_equal(straight.sizes[2], np.arange(201.0, 301))


@pytest.mark.parametrize("mixing", [SPARSE, DENSEST])
def test_shares_of_the_places_do_not_know_of_each_other(mixing):
    """So threads may take them in any order, or all at once."""
    sizes = np.random.default_rng(13).uniform(0.008, 0.06, (5, 128))
    forward, backward = (Column(sizes, RING, rise=3.0, mixing=mixing, means=0.03, seed=13, shares=2) for _ in range(2))
    forward.swap()
    backward.swap(order=-1)
    assert np.array_equal(forward.sizes, backward.sizes)
    assert not np.array_equal(forward.sizes, np.float32(sizes))


# --- diffusion against the error function ------------------------------------------------------------------


def chain_rate(number, shear, time_step):
    """Probability of a swap between boxes of a uniform column, from swap_rates itself, and box height d.

    Squares: edges as long as the tube is wide, points as far apart as the tube feeds in a time step.
    """
    scene = paper({"exchange.segregation": 0, "exchange.mixing": 0.2, "resolution.streamlines": 2})
    speed = scene.rolls.speed * scene.rolls.diameter / 2
    width, height = scene.rolls.gap / 4, speed * time_step
    flat = np.zeros((2, number))
    pairs = np.column_stack([np.arange(number - 1), np.arange(1, number)])
    edge = pairs, np.full(len(pairs), width), np.tile([0.0, 1.0], (len(pairs), 1)), np.full(len(pairs), height)
    bed = bed_of(flat + shear / math.sqrt(3), time_step, flat + 0.7, *edge)
    return swap_rates(scene, bed).mixing[0], height


MEAN = 0.02
DIFFUSIVITY = 0.2 * 30.0 * MEAN**2  # B gammadot sbar^2, m2/s


def test_rate_of_a_uniform_column_is_diffusivity_times_dt_over_d2():
    """l rho_b D / (d m) dt with m = rho_b l d is D dt / d2, D = B gammadot sbar^2."""
    for time_step in (1e-3, 2e-3):
        rate, height = chain_rate(5, 30.0, time_step)
        assert rate * MEAN**2 == pytest.approx(DIFFUSIVITY * time_step / height**2, rel=1e-12)


def step_profile(boxes, chance, substeps):
    share = np.repeat([1.0, 0.0], boxes // 2)
    pairs = [(k, k + 1) for k in range(boxes - 1)]
    for _ in range(substeps):
        share = mean_field(share, pairs, [chance] * (boxes - 1))
    return share


def error_function(boxes, spread):
    """Exact share of a step that has diffused: averages over boxes of erfc(x / spread) / 2, spread = 2 sqrt(D t)."""
    edges = (np.arange(boxes + 1) - boxes // 2) / spread
    integral = edges * special.erfc(edges) - np.exp(-(edges**2)) / math.sqrt(math.pi)
    return np.diff(integral) * spread / 2


@pytest.mark.parametrize(("square", "substeps"), [(4.0, 400), (4.0, 40)])
def test_swaps_diffuse_a_tracer_as_the_error_function(square, substeps):
    """Every box within 5 sigma of the mean field and, with the mean field's own error added, of erfc.

    P = 0.01 is drawn by skipping, P = 0.1 cell by cell. 40 boxes, 5 sigma: by chance once in 40,000 tests.
    """
    boxes, cells = 40, sized(4_000, 100)
    substeps = substeps if COMPILED else substeps // 2
    chance = square / substeps
    rate, _ = chain_rate(boxes, 30.0, 1e-3)
    mean = math.sqrt(chance / rate)  # the mean size at which the column of swap_rates has this probability
    column = Column(
        np.repeat(np.repeat([2.0, 1.0], boxes // 2)[:, None], cells, axis=1), mixing=rate * mean**2, means=1.5, seed=9
    )
    assert column.mixing[0] == pytest.approx(chance)
    column.swap(substeps)
    found = np.mean(column.sizes == 2, axis=1)
    expected = step_profile(boxes, chance, substeps)
    noise = SIGMAS * np.sqrt(expected * (1 - expected) / cells) + 2 / cells
    assert np.all(abs(found - expected) < noise)
    exact = error_function(boxes, 2 * math.sqrt(square))
    assert np.all(abs(found - exact) < noise + np.abs(expected - exact))
    assert np.abs(expected - exact).max() < 0.3 * chance + 0.003


# --- segregation against diffusion: the exact balance ------------------------------------------------------


def weights_of(configurations, steps_up):
    """Product over the large grains of the weight of their box."""
    heights = np.concatenate([[1.0], np.cumprod(steps_up)])
    return np.prod(np.where(configurations, heights, 1.0), axis=1)


@pytest.mark.parametrize("speed", ["sparse", "dense"])
@pytest.mark.parametrize("large", [1, 2])
def test_segregation_and_diffusion_reach_their_exact_balance(large, speed):
    """Two sizes S < L on a closed column, means held: each index is a chain of its own among configurations.

    Across an edge, a large grain below a small one rises at mixing + rise (L - m_below + m_above - S), and one
    above sinks at mixing, so every edge keeps the weights w_up / w_down = 1 + rise Delta / mixing, and so does
    a substep over all edges. Counts of configurations against those weights, chi-square at 1e-6.
    """
    small, big, boxes = 0.01, 0.04, 4
    means = np.array([0.02, 0.022, 0.025, 0.028])
    delta = big - small + means[1:] - means[:-1]
    mixing, rise = np.array([0.2, 0.1, 0.15]), np.array([4.0, 5.0, 1.0])
    substeps, cells = 60, sized(20_000, 600)
    if speed == "sparse":  # the same balance at probabilities that are skipped through
        mixing, rise, substeps, cells = mixing / 40, rise / 40, sized(2400, 1600), sized(20_000, 150)
        assert (mixing + rise * (big - means[:-1] + means[1:])).max() < kernels.DENSE
    sizes = np.full((boxes, cells), small)
    sizes[:large] = big  # all large grains start at the bottom
    column = Column(sizes, rise=rise, mixing=mixing, means=means, seed=10 + large)
    column.swap(substeps)
    at = column.sizes == np.float32(big)
    assert (at.sum(axis=0) == large).all()
    number = (at * 2 ** np.arange(boxes)[:, None]).sum(axis=0)
    known = np.array([k for k in range(2**boxes) if k.bit_count() == large])
    configurations = (known[:, None] >> np.arange(boxes)) & 1
    weights = weights_of(configurations.astype(bool), 1 + rise * delta / mixing)
    counts = np.array([np.sum(number == k) for k in known])
    assert agrees(counts, weights / weights.sum())
    assert not agrees(counts, np.full(known.size, 1 / known.size))  # and the test can tell


def test_equal_sizes_do_not_segregate():
    column = Column(np.full((2, 100), 0.02), rise=10.0, mixing=0.0, means=np.float64(np.float32(0.02)), seed=12)
    assert column.swap(50) == 0
