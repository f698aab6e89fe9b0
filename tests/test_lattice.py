import math

import numpy as np
import pytest
from support import GOLDEN, SIGMAS, first_cells, paper, sized, split_mix

from hpgr import cost, simulate
from hpgr.bed import tessellation
from hpgr.bed.loaded import inputs_of, load_bed
from hpgr.grains import kernels, solve
from hpgr.grains import lattice as rooms
from hpgr.grains.lattice import Lattice
from hpgr.results import metrics

INF = math.inf
PRODUCT = ("passing", "passing_total", "p50", "p80", "p50_total", "p80_total", "breaks_per_cell", "below_floor")
MARCH_ONLY = {"exchange.segregation": 0.0, "exchange.mixing": 0.0}
STRONG = {"exchange.segregation": 1.0, "exchange.mixing": 0.3}


def small(values=None):
    grid = {"resolution.streamlines": 3, "resolution.points": sized(24, 12), "resolution.cells": sized(40, 20)}
    return paper(grid | (values or {}))


def mixed(values=None):
    return small({"exchange.segregation": 0.1, "exchange.mixing": 0.1} | (values or {}))


def loads(scene):
    """log(sigma_a / sigma_m) at the points of a scene."""
    bed = load_bed(inputs_of(scene))
    return scene.strength.log_stress(solve.crushing_stress(scene, bed))


def lattice(scene, seed=0, replicate=0, steady=None):
    """A lattice of this scene that is full from the start."""
    scene = scene.with_values({"exchange.startup": "feed"})
    bed = load_bed(inputs_of(scene, tessellated=True))
    return Lattice(scene, loads(scene), rooms.swap_rates(scene, bed), seed, replicate, steady or {})


def sizes_in(machine):
    """Sizes of all cells at (streamline, point, cell)."""
    return machine.keep(machine.slots, np.empty((*machine.slots.shape, machine._scene.resolution.cells), np.float32))


def refill(machine, sizes):
    """Put other sizes (slot, cell) into the slots of a lattice."""
    machine.parcels.sizes[:, 1:-1] = sizes
    kernels.spread(machine.parcels, np.arange(machine.slots.size), machine._shares, machine._per_size)


PLAIN = {"resolution.control_variate": False}  # which the lattice has not


# --- only what a scene requires ----------------------------------------------------------------------------


@pytest.mark.parametrize("n", [0.5, 1.0, INF])
@pytest.mark.parametrize("cells", [1, 16, 37])
def test_exchange_of_zero_is_the_march_bit_for_bit(n, cells):
    """A = B = 0: every snapshot's parcel has the key it has without exchange. All snapshots, any interval."""
    still = small(PLAIN | {"strength.cushioning": n, "resolution.cells": cells, "resolution.snapshots": 3})
    wanted = simulate(still, seed=5, replicate=1)
    assert float(wanted["breaks_per_cell"].min()) > 0.5
    for interval in (1, 7, 40):
        found = simulate(still.with_values(MARCH_ONLY | {"exchange.interval": interval}), seed=5, replicate=1)
        assert found.attrs["solver"] == "lattice"
        assert wanted.attrs["solver"] == "march"
        assert np.array_equal(found["size"][:, :, -1], wanted["size"][:, :, -1])
        for name in PRODUCT:
            assert np.array_equal(found[name], wanted[name]), name
        assert float(found["swaps_per_cell"]) == 0
        assert int(found["exchange_substeps"]) == 1


@pytest.mark.parametrize("n", [1.0, INF])
def test_exchange_of_zero_records_the_distributions_of_the_march(n, monkeypatch):
    still = small(PLAIN | {"strength.cushioning": n, "resolution.record": "distributions", "resolution.snapshots": 2})
    found = simulate(still.with_values(MARCH_ONLY), seed=6)
    monkeypatch.setattr(solve, "choose", lambda scene: "march")  # n = inf: not the closed form
    wanted = simulate(still, seed=6)
    for name in PRODUCT:
        assert np.array_equal(found[name], wanted[name]), name
    assert np.array_equal(found["mass_fraction"][:, :, -1], wanted["mass_fraction"][:, :, -1])


@pytest.mark.parametrize("values", [{"exchange.startup": "crushed"}, {"exchange.startup": "feed"}])
def test_start_and_start_up_do_not_touch_the_steady_product(values):
    still = small(PLAIN | {"resolution.snapshots": 2})
    wanted = simulate(still, seed=7)
    found = simulate(still.with_values(MARCH_ONLY | {"exchange.interval": 5} | values), seed=7)
    for name in PRODUCT:
        assert np.array_equal(found[name], wanted[name]), name
    assert np.array_equal(found["size"][-2:, :, -1], wanted["size"][:, :, -1])


def settling(scene):
    """By how many points at most grains move away from their parcels."""
    rates = lattice(scene)._rates
    return rooms.settling(scene, rates, rooms.first_break(scene, loads(scene)), scene.resolution.points)


def fill_key(line, point, last):
    """Key of the parcel that fills a point at the start, and its line of those that share the key.

    The first of all have those of the first steady snapshot.
    """
    return ((0, 0, 0, 1 + last - point), line) if point else ((0, line, 0), 0)


def test_crushed_start_of_zero_exchange_is_steady_from_the_start():
    """Each parcel of the fill is what the plain march makes of the feed up to its point, so snapshot 0 is steady."""
    scene = small(MARCH_ONLY | {"exchange.startup": "crushed"})
    startup = simulate(scene, seed=8)["size"].values[0]
    log_stress = loads(scene)
    for line, point in np.ndindex(startup.shape[:2]):
        cells = [part[None] for part in first_cells(scene, 8, *fill_key(line, point, startup.shape[1] - 1))]
        for level in log_stress[line, : point + 1]:
            cells = plain_crush(*cells, level, scene)
        assert np.array_equal(startup[line, point], cells[0][0])


def raising(*args, **kwargs):
    raise AssertionError("computed though the scene does not require it")


@pytest.mark.parametrize("record", ["cells", "distributions", "product"])
def test_scene_enters_only_the_solver_it_requires(record, monkeypatch):
    still = small({"resolution.record": record})
    with monkeypatch.context() as without:
        without.setattr(tessellation, "tessellate", raising)
        without.setattr(solve.lattice, "run", raising)
        for n in (1.0, INF):
            simulate(still.with_values({"strength.cushioning": n}))
        simulate(still.with_values({"resolution.cells": 0, "exchange": {}}))
        with pytest.raises(AssertionError, match="does not require"):
            simulate(still.with_values({"exchange": {}}))
    monkeypatch.setattr(solve, "_closed_form", raising)
    monkeypatch.setattr(solve.march, "march", raising)
    for n in (1.0, INF):
        scene = mixed({"strength.cushioning": n, "resolution.record": record})
        assert simulate(scene).attrs["solver"] == ("reduced lattice" if record == "product" else "lattice")
        assert simulate(scene.with_values({"exchange.startup": "feed"})).attrs["solver"] == "lattice"


@pytest.mark.parametrize("record", ["cells", "distributions", "product"])
def test_equal_gaps_give_the_feed_bit_for_bit(record):
    scene = mixed({"rolls.entry_gap": 0.06, "resolution.record": record, "exchange.startup": "feed"})
    found = simulate(scene, seed=9)
    wanted = simulate(small({"rolls.entry_gap": 0.06, "resolution.record": record}), seed=9)
    for name in PRODUCT:
        assert np.array_equal(found[name], wanted[name]), name
    if record == "cells":
        for line in range(3):
            assert np.array_equal(found["size"][0, line, -1], first_cells(scene, 9, (0, line, 0))[0])


# --- step by step against plain NumPy ----------------------------------------------------------------------


def plain_crush(sizes, streams, log_stress, scene):
    """One crushing step by the laws' own equations on the parcel at each point; returns sizes and streams."""
    breaks = (np.reshape(log_stress, (-1, 1)) >= scene.strength.log_strength(sizes)) & (
        sizes.astype(float) >= scene.fragments.size_floor
    )
    moved = np.where(breaks, streams + np.uint64(GOLDEN), streams)
    uniform = [((split_mix(int(state)) >> 12) + 0.5) / 2**52 for state in moved[breaks]]
    broken = sizes.copy()
    fragment = sizes[breaks].astype(float) * scene.fragments.quantile(uniform)
    broken[breaks] = np.maximum(fragment, 1e-30).astype(np.float32)
    return broken, moved


class Watched:
    """Run a lattice; compare every crushing step with plain NumPy, and every swap with what it must keep."""

    def __init__(self, monkeypatch, scene, **wishes):
        self.machine = lattice(scene, **wishes)
        self.broken = self.kept = self.swaps = 0
        crush, swap = kernels.crush, kernels.swap

        def watched_crush(parcels, passage, path, *rest):
            before, counts = cells_of(parcels, passage.slots), parcels.breaks[passage.slots].copy()
            self.kept += np.sum(~parcels.bounds_outdated[passage.slots])
            crush(parcels, passage, path, *rest)
            wanted = plain_crush(*before, path.log_stress[passage.lines, passage.first], scene)
            for found, plain in zip(cells_of(parcels, passage.slots), wanted, strict=True):
                assert np.array_equal(found, plain)
            broken = np.sum(before[1] != wanted[1], axis=1)
            assert np.array_equal(parcels.breaks[passage.slots] - counts, broken)
            self.broken += broken.sum()

        def watched_swap(shares, part, places, *rest):
            before, were = shares.sizes[part, :, :places].copy(), shares.swapped[part].copy()
            shares.swapped[part] = False
            count = swap(shares, part, places, *rest)
            after = shares.sizes[part, :, :places]
            # of every index the sizes, bit for bit, and so the mass of each size class
            assert np.array_equal(np.sort(after, axis=0), np.sort(before, axis=0))
            assert shares.swapped[part, np.any(before != after, axis=1)].all()
            shares.swapped[part] |= were
            self.swaps += count
            return count

        monkeypatch.setattr(kernels, "crush", watched_crush)
        monkeypatch.setattr(kernels, "swap", watched_swap)


def cells_of(parcels, slots):
    """Sizes and streams of the parcels of these slots, without the ends of the periodic lines."""
    return parcels.sizes[slots, 1:-1], parcels.streams[slots, 1:-1]


SCENES = {  # exchange, cushioning n
    "dense": ({"exchange.segregation": 1.0, "exchange.mixing": 1.0}, 1.0),
    "usual": ({"exchange.segregation": 0.1, "exchange.mixing": 0.1}, 1.0),
    "rare": ({"exchange.segregation": 0.001, "exchange.mixing": 0.0005}, 0.3),
    "mixing only": ({"exchange.segregation": 0.0, "exchange.mixing": 0.02}, 0.5),
    "segregation only": ({"exchange.segregation": 0.05, "exchange.mixing": 0.0}, INF),
}


@pytest.mark.parametrize("interrupted", [False, True])
@pytest.mark.parametrize("name", SCENES)
def test_every_step_is_the_plain_one_bit_for_bit(name, interrupted, monkeypatch):
    """The bounds that skip cells and blocks stay right when cells come and go, by rare swaps and by frequent ones.

    Interrupted: no stress at every third point, so that parcels whose bounds are known swap where nothing crushes.
    """
    values, n = SCENES[name]
    scene = small(values | {"resolution.cells": sized(150, 40), "strength.cushioning": n})
    watched = Watched(monkeypatch, scene, seed=10)
    if interrupted:
        watched.machine._path.log_stress[:, ::3], watched.machine._path.critical_ratio[:, ::3] = -INF, INF
    steps = 2 * scene.resolution.points + 3
    for step in range(steps):
        watched.machine.advance(step)
    cells = scene.resolution.streamlines * scene.resolution.cells
    assert watched.broken > cells
    assert watched.swaps == watched.machine.swaps > sized(cells / 20, 0)
    if name == "dense":
        assert watched.machine.most_substeps > 2
    if name == "rare":
        assert watched.kept > sized(20, -1)  # parcels crushed on bounds they carried through the step


def test_both_ways_of_swapping_meet_in_one_scene(monkeypatch):
    """Edges above and below the density at which every cell is decided, in the same substeps."""
    kinds, swap = set(), kernels.swap

    def counting(shares, part, places, slots, edges, means, largest, *rest):
        lower, upper = edges.pairs.T
        most = edges.mixing + edges.rise * (np.maximum(largest - means[lower], 0) + means[upper])
        kinds.update((most > kernels.DENSE).tolist())
        return swap(shares, part, places, slots, edges, means, largest, *rest)

    monkeypatch.setattr(kernels, "swap", counting)
    machine = lattice(mixed({"exchange.mixing": 0.02, "exchange.segregation": 0.02}), seed=11)
    for step in range(3):
        machine.advance(step)
    assert kinds == {True, False}


def test_shares_are_the_parcels_they_came_from(monkeypatch):
    """Cells go to the shares and back, with their strengths; sums are those of the sizes, to 3e-8 of the largest."""
    monkeypatch.setattr(rooms, "_SHARE", 16)
    machine = lattice(mixed({"resolution.cells": 45, "strength.scatter": 2.0}), seed=25)
    machine.advance(0)
    machine._swap(1, machine._rates)  # so that rows and shares differ
    shares, every = machine._shares, np.arange(machine.slots.size)
    sizes = machine.keep(every, np.empty((every.size, 45), np.float32))
    assert np.mean(sizes != machine.parcels.sizes[:, 1:-1]) > 0.1
    kernels.gather(shares, every, machine.parcels)
    assert np.array_equal(machine.parcels.sizes[:, 1:-1], sizes)
    assert not shares.swapped.any()
    strengths = machine.parcels.weakness[:, 1:-1].copy()
    assert np.array_equal(shares.weakness.swapaxes(0, 1).reshape(every.size, -1)[:, :45], strengths)
    totals = shares.totals.sum(axis=0) / machine._per_size
    assert np.allclose(totals, sizes.sum(axis=1, dtype=float), rtol=0, atol=45 * 3e-8 * 0.06)
    machine.parcels.sizes[:, 1:-1] /= 2
    kernels.spread(machine.parcels, every[::2], shares, machine._per_size)
    halved = np.where(every[:, None] % 2 == 0, sizes / 2, sizes)
    assert np.array_equal(machine.keep(every, sizes), halved)


# --- determinism -------------------------------------------------------------------------------------------


def test_all_cores_give_the_bits_of_one(monkeypatch):
    """Cells in more than one share, which threads take in any order."""
    scene = mixed(STRONG | {"resolution.cells": sized(600, 40), "resolution.points": 8})
    alone = simulate(scene, seed=24)
    monkeypatch.setattr(rooms, "_SHARE", sized(256, 16))
    shared = simulate(scene, seed=24)
    monkeypatch.setattr(rooms.march, "_LARGE", 1)
    assert shared.identical(simulate(scene, seed=24))
    assert not shared.identical(alone)  # each share draws its own numbers


def test_swaps_of_seeds_replicates_and_steps_differ(monkeypatch):
    """No two time steps of any of these runs draw from the same key; nor do turns, each of which has its own of it."""
    keys, swap = [], kernels.swap
    monkeypatch.setattr(kernels, "swap", lambda *values: keys.append(int(values[8])) or swap(*values))
    for seed, replicate in ((0, 0), (1, 0), (0, 1)):
        machine = lattice(mixed({"exchange.mixing": 1.0, "resolution.cells": 4}), seed, replicate)
        for step in range(4):
            machine.advance(step)
        assert machine.most_substeps > 1
    assert len(set(keys)) == len(keys) == 12


def test_what_is_recorded_does_not_touch_the_product():
    """Neither the record, nor how often a steady snapshot follows another."""
    scene = mixed(STRONG | {"exchange.interval": 4})
    wanted = simulate(scene, seed=16)
    for values in ({"resolution.record": "distributions"}, {"exchange.interval": 9}):
        found = simulate(scene.with_values(values), seed=16)
        for name in PRODUCT:
            assert np.array_equal(found[name], wanted[name]), (values, name)


def test_recorded_distributions_are_those_of_the_recorded_cells():
    sieves = tuple(np.geomspace(1e-5, 0.06, 30))
    scene = mixed(STRONG | {"resolution.snapshots": 2, "exchange.interval": 3, "resolution.sieves": sieves})
    size = simulate(scene, seed=17)["size"].values
    found = simulate(scene.with_values({"resolution.record": "distributions"}), seed=17)["mass_fraction"]
    passing = np.mean(size[..., None] <= np.array(sieves, np.float32), axis=3)
    assert np.allclose(found.cumsum("sieve"), passing, atol=1e-6)
    assert size.shape[0] == 2


# --- start-up and snapshots ------------------------------------------------------------------------------


def started(values=None, **wishes):
    return simulate(
        mixed({"exchange.startup": "feed", "exchange.interval": 5, "resolution.snapshots": 3} | (values or {})),
        **wishes,
    )


@pytest.mark.parametrize("record", ["cells", "distributions"])
def test_start_up_is_snapshoted_at_the_interval_and_then_the_steady_machine(record):
    found = started({"resolution.record": record})
    last = found.sizes["point"] - 1 + settling(mixed())
    steps = [*range(0, last, 5), last, last + 5, last + 10]
    time_step = found.attrs["time_step_s"]
    assert np.allclose(found["elapsed_time"], np.array(steps) * time_step, rtol=1e-12)
    assert found["steady"].values.tolist() == [int(step >= last) for step in steps]
    assert found["time"].values.tolist() == list(range(len(steps)))
    plain = simulate(mixed({"exchange.interval": 5, "resolution.snapshots": 3, "resolution.record": record}))
    assert plain["steady"].values.tolist() == [1, 1, 1]
    assert np.array_equal(plain["elapsed_time"], found["elapsed_time"][-3:])


def test_start_up_begins_with_the_feed_where_nothing_crushes(monkeypatch):
    """Fill "feed": snapshot 0 holds at every point whole parcels of feed; only cells under stress have broken.

    Without exchange the parcels are checked one by one; with it, the feed is there up to swaps.
    """
    scene = small(MARCH_ONLY | {"exchange.startup": "feed"})
    first = simulate(scene, seed=18)["size"].values[0]
    log_stress = loads(scene)
    for line, point in np.ndindex(first.shape[:2]):
        feed = [part[None] for part in first_cells(scene, 18, *fill_key(line, point, first.shape[1] - 1))]
        assert np.array_equal(first[line, point], plain_crush(*feed, log_stress[line, point], scene)[0][0])
    assert np.isneginf(log_stress).sum() >= 9
    monkeypatch.setattr(rooms, "settling", lambda *values: 0)  # or the first steady snapshot shares no parcel
    swapped = simulate(scene.with_values(STRONG), seed=18)["size"].values[0]
    assert not np.array_equal(swapped, first)
    assert np.array_equal(
        np.sort(swapped.reshape(-1, first.shape[-1]), axis=0), np.sort(first.reshape(-1, first.shape[-1]), axis=0)
    )


def test_product_is_pooled_from_the_steady_snapshots_only():
    found = started(STRONG)
    steady = found["size"].values[-3:, :, -1]
    pooled = np.sort(steady.transpose(1, 0, 2).reshape(3, -1), axis=1)
    sieves = found["sieve"].values.astype(np.float32)
    wanted = np.stack([np.searchsorted(row, sieves, side="right") / row.size for row in pooled])
    assert np.allclose(found["passing"], wanted, atol=1e-7)
    assert np.allclose(metrics.passing(found), wanted, atol=1e-7)
    assert np.allclose(found["p80"], np.quantile(pooled, 0.8, axis=1), rtol=1e-6)
    assert np.allclose(metrics.percentile_size(found, 35), np.quantile(pooled, 0.35, axis=1), rtol=1e-6)
    everything = found["size"].values[:, :, -1].transpose(1, 0, 2).reshape(3, -1)
    assert not np.allclose(found["p80"], np.quantile(everything, 0.8, axis=1), rtol=1e-3)
    middle = found.sizes["point"] - 2
    inner = found["size"].values[-3:, :, middle].transpose(1, 0, 2).reshape(3, -1)
    assert np.allclose(metrics.percentile_size(found, 35, point=middle), np.quantile(inner, 0.35, axis=1), rtol=1e-6)
    shares = started(STRONG | {"resolution.record": "distributions"})
    steady = shares["mass_fraction"].values[-3:, :, middle].mean(axis=0).cumsum(axis=1)
    assert np.allclose(metrics.passing(shares, point=middle), steady, atol=1e-6)


def test_dataset_tells_substeps_and_swaps(monkeypatch):
    """Swaps per cell in one residence time: two cells a swap, over all cells, in the steps of a full machine."""
    counts, edges_of, swap, most = [], rooms.edges_of, kernels.swap, []
    monkeypatch.setattr(kernels, "swap", lambda *values: counts.append(swap(*values)) or counts[-1])
    monkeypatch.setattr(rooms, "edges_of", lambda *values: most.append(edges_of(*values)) or most[-1])
    scene = mixed(STRONG | {"resolution.snapshots": 2, "exchange.interval": 6})
    found = simulate(scene, seed=19)
    assert int(found["exchange_substeps"]) == max(substeps for _, substeps in most) > 1
    points = scene.resolution.points
    assert len(counts) == points + settling(scene) + 6
    wanted = 2 * np.mean(counts[points - 1 :]) / (3 * scene.resolution.cells)
    assert float(found["swaps_per_cell"]) == pytest.approx(wanted, rel=1e-6)
    assert found["exchange_substeps"].attrs["units"] == found["swaps_per_cell"].attrs["units"] == "1"


def test_dataset_without_exchange_has_none_of_it():
    found = simulate(small())
    assert not {"swaps_per_cell", "exchange_substeps", "volume", "elapsed_time", "steady"} & set(found.variables)


# --- the steady machine ------------------------------------------------------------------------------------

TWO_SIZES = {"kind": "table", "table": ((0.0099, 0.0), (0.01, 50.0), (0.0399, 50.0), (0.04, 100.0))}


def reduced(values=None):
    grid = {"resolution.points": 60, "resolution.cells": 100, "resolution.record": "product"}
    return mixed(grid | (values or {}))


def test_settling_by_hand():
    """Three points in a row on one of two streamlines, the third where grains break; one edge leads across."""
    feed = {"kind": "single", "size": 0.04}
    scene = mixed({"feed": feed})
    pairs = np.array([[1, 0], [2, 1], [5, 1]])
    rates = rooms.SwapRates(pairs, np.array([100.0, 50.0, 0.0]), np.array([1000.0, 2000.0, 500.0]), np.zeros(3))
    variance = 0.04**2 * (2 * 1000 + 2 * 2000 + 500)  # the edge across leads one point along both its streamlines
    assert rooms.settling(scene, rates, 2, 3) == math.ceil(50 * 0.04 + 2 * math.sqrt(variance)) == 9
    assert rooms.settling(scene, rates, 1, 3) == math.ceil((100 + 50) * 0.04 + 2 * math.sqrt(variance)) == 13
    assert rooms.settling(scene, rooms.within(rates, 3, 0, 1), 1, 1) == 0


@pytest.mark.slow
@pytest.mark.parametrize("record", ["product", "distributions"])
def test_first_snapshot_is_steady(record, monkeypatch):
    """Breaks, P80 and fines of two sizes that segregate are those of a machine that has run on four times as far.

    Within 5 standard errors of the paired differences: once in 300,000 tests. Read one residence time after it began
    to fill, the reduced lattice has 11 % fewer breaks, the whole one 22 %.
    """
    figures = ("breaks_per_cell", "p80_total", "passing_total")
    scene = reduced(
        {"feed": TWO_SIZES, "exchange.segregation": 1.0, "exchange.mixing": 0.02, "resolution.record": record}
    )

    def runs():
        found = [simulate(scene, seed=27, replicate=k) for k in range(sized(60, 3))]
        return np.array([[float(one[name].mean()) for name in figures] for one in found])

    first, settle = runs(), rooms.settling
    monkeypatch.setattr(rooms, "settling", lambda *values: 4 * settle(*values))
    change = runs() - first
    assert np.all(abs(change.mean(axis=0)) < SIGMAS * change.std(axis=0, ddof=1) / math.sqrt(len(change)))
    assert np.all(change.std(axis=0, ddof=1) / math.sqrt(len(change)) < sized(0.006, 1) * first.mean(axis=0))


# --- what exchange does ------------------------------------------------------------------------------------


def closed_lattice(values, cells, seed):
    """A lattice of feed in which nothing breaks and, but for swaps, nothing moves."""
    unbroken = {"strength.reference_strength": 1e15, "resolution.cells": cells, "resolution.points": 8}
    scene = mixed(unbroken | values)
    machine = lattice(scene, seed=seed)
    machine.advance(0)
    sizes = machine.parcels.sizes[:, 1:-1]
    refill(machine, np.random.default_rng(seed).permutation(sizes.ravel()).reshape(sizes.shape))
    return machine, load_bed(inputs_of(scene)).kinematics.y


def test_segregation_lifts_large_grains():
    """A swap lifts the larger of two cells oftener: mean height weighted by size grows, beyond its scatter.

    Before, sizes know no height: the weighted mean's standard deviation is sd(s) sd(y) / (mean(s) sqrt(cells)).
    """
    machine, height = closed_lattice({"exchange.mixing": 0.0, "exchange.segregation": 2.0}, sized(500, 60), seed=21)

    def lifted():
        weight = sizes_in(machine).astype(float)
        noise = weight.std() * height.std() / (weight.mean() * math.sqrt(weight.size))
        return (np.sum(weight.sum(axis=2) * height) / weight.sum() - height.mean()) / noise

    assert abs(lifted()) < SIGMAS
    for step in range(10):
        machine._swap(step, machine._rates)
    assert lifted() > 2 * SIGMAS


def test_the_lattice_keeps_probabilities_at_one_half(monkeypatch):
    """What every substep of a strong scene is given, with the largest grain there is anywhere."""
    swap, sums = kernels.swap, []

    def watched(shares, part, places, slots, edges, means, largest, *rest):
        lower, upper = edges.pairs.T
        most = edges.mixing + edges.rise * (np.maximum(largest - means[lower], 0) + means[upper])
        for turns in np.split(edges.turns, np.flatnonzero(np.diff(edges.turns) <= 0) + 1):  # one substep each, or two
            points = np.concatenate([lower[turns], upper[turns]])
            sums.append(np.bincount(points, np.tile(most[turns], 2)).max(initial=0))
        return swap(shares, part, places, slots, edges, means, largest, *rest)

    monkeypatch.setattr(kernels, "swap", watched)
    simulate(mixed({"exchange.segregation": 2.0, "exchange.mixing": 2.0, "resolution.cells": 8}))
    assert 0.4 < max(sums) <= 0.5 + 1e-9


# --- the reduced lattice -----------------------------------------------------------------------------------


@pytest.mark.parametrize("segregation", [0.1, 1.0])
def test_the_mean_field_is_the_mean_of_the_lattice(segregation, monkeypatch):
    """Unbroken feed, two sizes that segregate: steady class shares of every point within the noise of cells.

    Binomial, 5 sigma of 3 lines x 30 points: by chance once in 19,000 tests.
    """
    monkeypatch.setattr(rooms, "settling", lambda *values: 30)
    states, swap = [], kernels.swap_mean_field
    monkeypatch.setattr(kernels, "swap_mean_field", lambda *values: swap(*values) or states.append(values[0].copy()))
    unbroken = {"strength.reference_strength": 1e15, "resolution.points": 30, "resolution.cells": sized(4000, 100)}
    scene = mixed(unbroken | {"feed": TWO_SIZES, "exchange.segregation": segregation, "exchange.mixing": 0.02})
    machine = lattice(scene, seed=22)
    for step in range(60):
        machine.advance(step)
    rooms.settle(scene, machine._rates, machine.slots.shape, 1)
    steady = states[59]  # after it come the edges between what is above the lattice and the lattice
    found, coarse = np.mean(sizes_in(machine) > 0.02, axis=2), steady[:, steady.shape[1] // 2 :].sum(axis=1)
    coarse = coarse.reshape(found.shape)
    noise = SIGMAS * np.sqrt(coarse * (1 - coarse) / scene.resolution.cells)
    assert np.all(np.abs(found - coarse) < noise + 1 / scene.resolution.cells)
    assert np.ptp(coarse) > 0.2 * segregation  # and they do segregate


@pytest.mark.parametrize("ceiling", [0.0, 2.0])
def test_the_mean_field_swaps_every_pair_of_classes_with_its_chance(ceiling):
    """One edge, against the sum over all pairs of a class below and a class above."""
    sizes, shares = np.array([0.01, 0.02, 0.05]), np.array([[0.2, 0.3, 0.5], [0.6, 0.3, 0.1]])
    means, rise, mixing = shares @ sizes, 4.0, 0.2
    up, down = (np.maximum(part, 0) for part in (sizes - means[0], means[1] - sizes))
    up, down = (part / (1 + ceiling * part / math.sqrt(mean)) for part, mean in zip((up, down), means, strict=True))
    swapped = shares[0][:, None] * shares[1] * (mixing + rise * (up[:, None] + down))
    wanted = shares + np.array([[1], [-1]]) * (swapped.sum(axis=0) - swapped.sum(axis=1))
    edges = kernels.Edges(np.array([[0, 1]]), *(np.array([one]) for one in (rise, mixing, ceiling)), np.array([0]))
    swaps = np.zeros(1)
    kernels.swap_mean_field(shares, sizes, edges, means, swaps, *np.empty((2, 3)))
    assert np.allclose(shares, wanted, rtol=1e-12)
    assert swaps[0] == pytest.approx(swapped.sum(), rel=1e-12)


def test_the_mean_field_has_become_steady(monkeypatch):
    """What enters is within 2 % of what four times as many steps give, of feed that segregates.

    Half the settling would leave 9 %.
    """
    scene = mixed(
        {"resolution.points": 60, "exchange.segregation": 1.0, "exchange.mixing": 0.02, "resolution.cells": 2}
    )
    rates = lattice(scene)._rates
    found = rooms.settle(scene, rates, (3, 60), 50).entering
    monkeypatch.setattr(rooms, "range", lambda steps: range(4 * steps), raising=False)
    assert np.allclose(found, rooms.settle(scene, rates, (3, 60), 50).entering, rtol=0.02)


def test_what_enters_all_lines_together_is_the_feed():
    """As the machine is steady: class by class, where swaps across the lattice's first points are many."""
    scene = mixed(STRONG | {"resolution.points": 60, "resolution.cells": 2})
    entering = rooms.settle(scene, lattice(scene)._rates, (3, 60), 50).entering
    assert np.allclose(entering.mean(axis=0), 1 / entering.shape[1], rtol=1e-6)
    assert np.allclose(entering.sum(axis=1), 1, rtol=1e-12)
    assert np.ptp(entering, axis=0).max() > 0.1 / entering.shape[1]


@pytest.mark.slow
def test_reduced_lattice_has_the_products_of_the_whole():
    """Means over replicates, of the total and of each line, within 5 standard errors: once in 100,000 tests."""
    names, runs = ("p50", "p80", "p50_total", "p80_total", "breaks_per_cell", "swaps_per_cell"), range(sized(24, 4))
    means, errors = [], []
    for values in ({}, {"resolution.record": "distributions"}):
        found = [simulate(reduced(values), seed=23, replicate=k) for k in runs]
        rows = np.array([np.hstack([np.atleast_1d(one[name]) for name in names]) for one in found])
        means.append(rows.mean(axis=0))
        errors.append(rows.std(axis=0, ddof=1) / math.sqrt(len(runs)))
    assert np.all(np.abs(means[0] - means[1]) < SIGMAS * np.hypot(*errors) + 0.01 * means[1])


def test_reduced_lattice_begins_above_the_first_break():
    scene = reduced()
    first = rooms.first_break(scene, loads(scene))
    assert 8 < first < 55
    level = loads(scene)[:, :first]
    assert scene.strength.critical_size(level).min() > 0.06  # nothing breaks before it
    assert scene.strength.critical_size(loads(scene)[:, first]).min() <= 0.06
    assert np.isfinite(
        loads(scene)[:, rooms.first_break(scene.with_values({"strength.scatter": 2}), loads(scene))]
    ).any()


# --- memory ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("strength", [{}, {"exchange.segregation": sized(30, 3)}, {"exchange.mixing": sized(10, 0.3)}])
def test_predicted_memory_counts_the_start_up_snapshots(strength):
    for record, part in (("cells", "size"), ("distributions", "mass_fraction")):
        scene = mixed({"exchange.startup": "feed", "exchange.interval": 1, "resolution.record": record} | strength)
        kept = simulate(scene)[part].nbytes
        scant = simulate(scene.with_values({"exchange.startup": None}))[part].nbytes
        more = cost.predict(scene).bytes - cost.predict(scene.with_values({"exchange.startup": None})).bytes
        assert more >= kept - scant
