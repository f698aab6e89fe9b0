import math
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from support import SIGMAS, first_cells, paper, sized

from hpgr import budget, exchange, flow, geometry, kernels, metrics, parcels, simulate, solve, stress, tessellation
from hpgr.lattice import Lattice

INF = math.inf
PRODUCT = ("passing", "passing_total", "p50", "p80", "p50_total", "p80_total", "breaks_per_cell", "below_floor")
MARCH_ONLY = {"exchange.segregation": 0.0, "exchange.mixing": 0.0}
STRONG = {"exchange.segregation": 1.0, "exchange.mixing": 0.3}


def small(values=None):
    grid = {"resolution.streamlines": 3, "resolution.points": sized(24, 12), "resolution.cells": sized(40, 20)}
    return paper(grid | (values or {}))


def mixed(values=None):
    return small({"exchange.segregation": 0.1, "exchange.mixing": 0.1} | (values or {}))


def loaded(scene):
    """Bed, motion, load and crushing stress."""
    bed = geometry.bed(scene.rolls, scene.resolution.streamlines)
    motion = flow.move(scene, bed, scene.resolution.points)
    state = stress.load(scene, motion)
    return bed, motion, state, stress.crushing_stress(scene, motion, state)


def lattice(scene, seed=0, replicate=0, photographed=None):
    bed, motion, state, crushing = loaded(scene)
    rates = exchange.swap_rates(scene, motion, state, tessellation.tessellate(scene, bed, motion))
    with np.errstate(divide="ignore"):
        log_stress = np.log(crushing / scene.material.strength)
    return Lattice(scene, log_stress, rates, seed, replicate, photographed or {})


# --- only what a scene requires ----------------------------------------------------------------------------


@pytest.mark.parametrize("n", [0.5, 1.0, INF])
@pytest.mark.parametrize("cells", [1, 16, 37])
def test_exchange_of_zero_is_the_march_bit_for_bit(n, cells):
    """A = B = 0: every photograph's parcel has the key it has without exchange. All photographs, any interval."""
    still = small({"material.cushioning": n, "resolution.cells": cells, "resolution.photographs": 3})
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
        assert int(found["exchange_passes"]) == 1


@pytest.mark.parametrize("n", [1.0, INF])
@pytest.mark.parametrize("record", ["product", "distributions"])
def test_exchange_of_zero_records_the_product_of_the_march(record, n, monkeypatch):
    still = small({"material.cushioning": n, "resolution.record": record, "resolution.photographs": 2})
    found = simulate(still.with_values(MARCH_ONLY), seed=6)
    monkeypatch.setattr(solve, "choose", lambda scene: "march")  # n = inf: not the closed form
    wanted = simulate(still, seed=6)
    for name in PRODUCT:
        assert np.array_equal(found[name], wanted[name]), name
    if record == "distributions":
        assert np.array_equal(found["mass_fraction"][:, :, -1], wanted["mass_fraction"][:, :, -1])


@pytest.mark.parametrize("values", [{"exchange.fill": "crushed"}, {"exchange.record_startup": True}])
def test_fill_and_start_up_do_not_touch_the_steady_product(values):
    still = small({"resolution.photographs": 2})
    wanted = simulate(still, seed=7)
    found = simulate(still.with_values(MARCH_ONLY | {"exchange.interval": 5} | values), seed=7)
    for name in PRODUCT:
        assert np.array_equal(found[name], wanted[name]), name
    assert np.array_equal(found["size"][-2:, :, -1], wanted["size"][:, :, -1])


def test_crushed_fill_of_zero_exchange_is_steady_from_the_start():
    """Each parcel of the fill is what the march makes of the feed up to its point, so photograph 0 is steady.

    Parcel at point j of the first photograph has its own key; every one is checked against the march.
    """
    scene = small(MARCH_ONLY | {"exchange.fill": "crushed", "exchange.record_startup": True})
    startup = simulate(scene, seed=8)["size"].values[0]
    last = scene.resolution.points - 1
    machine = lattice(scene, seed=8)
    for line in range(3):
        for point in range(last + 1):
            sizes, states = first_cells(scene, 8, fill_key(line, point, last))
            log_stress = machine._log_stress[line, : point + 1]
            kernels.march(
                sizes, states, log_stress, parcels.reach_needed(scene, log_stress), np.empty(0),
                np.empty((0, 0), np.float32), np.empty((0, 0), np.int64), *parcels.constants(scene),
            )  # fmt: skip
            assert np.array_equal(startup[line, point], sizes)


def fill_key(line, point, last):
    """Key of the parcel that fills a point at the start; the first of all is that of the first steady photograph."""
    return (0, line, 0, 1 + last - point) if point else (0, line, 0)


def raising(*args, **kwargs):
    raise AssertionError("computed though the scene does not require it")


@pytest.mark.parametrize("n", [1.0, INF])
@pytest.mark.parametrize("record", ["cells", "distributions", "product"])
def test_scene_without_exchange_enters_neither_tessellation_nor_lattice(record, n, monkeypatch):
    monkeypatch.setattr(tessellation, "tessellate", raising)
    monkeypatch.setattr(exchange, "swap_rates", raising)
    monkeypatch.setattr(solve, "Lattice", raising)
    for name in ("swap", "crush_lattice", "measure", "classify_lattice"):
        monkeypatch.setattr(kernels, name, raising)
    scene = small({"material.cushioning": n, "resolution.record": record})
    simulate(scene)
    simulate(scene.with_values({"resolution.cells": 0}))
    with pytest.raises(AssertionError, match="does not require"):
        simulate(scene.with_values({"exchange.mixing": 0.1}))


@pytest.mark.parametrize("record", ["cells", "distributions", "product"])
def test_scene_with_exchange_enters_neither_closed_form_nor_march(record, monkeypatch):
    monkeypatch.setattr(solve, "_closed_form", raising)
    monkeypatch.setattr(solve, "_march", raising)
    for n in (1.0, INF):
        found = simulate(mixed({"material.cushioning": n, "resolution.record": record}))
        assert found.attrs["solver"] == "lattice"


def test_stress_only_scene_with_exchange_does_no_cell_work(monkeypatch):
    monkeypatch.setattr(tessellation, "tessellate", raising)
    monkeypatch.setattr(solve, "Lattice", raising)
    monkeypatch.setattr(parcels, "first_cells", raising)
    found = simulate(mixed({"resolution.cells": 0}))
    assert found.attrs["solver"] == "stress only"
    wanted = simulate(small({"resolution.cells": 0}))
    assert set(found.variables) == set(wanted.variables)
    assert np.array_equal(found["pressure"], wanted["pressure"])


@pytest.mark.parametrize("record", ["cells", "distributions", "product"])
def test_equal_gaps_give_the_feed_bit_for_bit(record):
    scene = mixed({"rolls.entry_gap": 0.06, "resolution.record": record, "exchange.record_startup": True})
    found = simulate(scene, seed=9)
    wanted = simulate(small({"rolls.entry_gap": 0.06, "resolution.record": record}), seed=9)
    for name in PRODUCT:
        assert np.array_equal(found[name], wanted[name]), name
    if record == "cells":
        for line in range(3):
            feed = first_cells(scene, 9, (0, line, 0))[0]
            assert np.array_equal(found["size"][0, line, -1], feed)


# --- step by step against plain NumPy ----------------------------------------------------------------------

GOLDEN, MIX_1, MIX_2 = (np.uint64(k) for k in (0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB))


def plain_crush(sizes, streams, log_stress, scene):
    """One crushing step of the model page, section 4, on the parcel at each point; returns sizes and streams."""
    ore = scene.material
    size = sizes.astype(float)
    mean = (np.roll(size, 1, axis=1) + np.roll(size, -1, axis=1) + size) / 3
    strength = -(3 / ore.weibull_modulus) * np.log(size / ore.strength_size)
    strength = strength + (np.log(size / mean) / ore.cushioning) ** 2 / 2
    breaks = (log_stress[:, None] >= strength) & (size >= ore.size_floor)
    moved = streams + GOLDEN
    z = (moved ^ (moved >> np.uint64(30))) * MIX_1
    z = (z ^ (z >> np.uint64(27))) * MIX_2
    uniform = (((z ^ (z >> np.uint64(31))) >> np.uint64(12)).astype(float) + 0.5) / 2**52
    fragment = np.maximum(size * uniform ** (1 / ore.fragment_exponent), 1e-30).astype(np.float32)
    return np.where(breaks, fragment, sizes), np.where(breaks, moved, streams)


class Watched:
    """Run a lattice; compare every crushing step with plain NumPy, and every swap with what it must keep."""

    def __init__(self, monkeypatch, scene, **wishes):
        self.scene, self.machine = scene, lattice(scene, **wishes)
        self.broken = self.crushes = self.dense = self.sparse = self.mended = self.trusted = self.swaps = 0
        crush, swap = kernels.crush_lattice, kernels.swap

        def crush_lattice(sizes, streams, reach, block_reach, stale, breaks, slots, log_stress, *rest):
            before, counts = (sizes[slots], streams[slots]), breaks[slots]
            self.trusted += np.sum(~stale[slots] & (log_stress > -INF) & (sizes[slots].max(axis=1) > 0))
            crush(sizes, streams, reach, block_reach, stale, breaks, slots, log_stress, *rest)
            wanted = plain_crush(*before, log_stress, scene)
            assert np.array_equal(sizes[slots], wanted[0])
            assert np.array_equal(streams[slots], wanted[1])
            broken = np.sum(before[1] != wanted[1], axis=1)
            assert np.array_equal(breaks[slots] - counts, broken)
            self.broken += broken.sum()
            self.crushes += 1

        def watched_swap(sizes, streams, reach, block_reach, stale, largest, slots, crushing, *rest):
            before, were_stale = sorted_pairs(sizes, streams), stale.copy()
            reaches = reach.copy()
            count = swap(sizes, streams, reach, block_reach, stale, largest, slots, crushing, *rest)
            after = sorted_pairs(sizes, streams)
            assert np.array_equal(before[0], after[0])  # sizes, bit for bit, and so the mass of each size class
            assert np.array_equal(before[1], after[1])  # each with its stream
            assert np.all(largest >= sizes.max(axis=1))
            changed = np.any(reaches != reach, axis=1) & ~were_stale & ~stale  # stale bounds may hold anything
            self.mended += changed.sum()
            self.dense += np.sum(stale & ~were_stale)
            self.swaps += count
            return count

        monkeypatch.setattr(kernels, "crush_lattice", crush_lattice)
        monkeypatch.setattr(kernels, "swap", watched_swap)


def sorted_pairs(sizes, streams):
    """(size, stream) of every cell, in the order of the streams' and sizes' bits; per cell index."""
    order = np.lexsort((streams, sizes), axis=0)
    return np.take_along_axis(sizes, order, 0), np.take_along_axis(streams, order, 0)


SCENES = {  # exchange, cushioning n
    "dense": ({"exchange.segregation": 1.0, "exchange.mixing": 1.0}, 1.0),
    "usual": ({"exchange.segregation": 0.1, "exchange.mixing": 0.1}, 1.0),
    "sparse": ({"exchange.segregation": 0.01, "exchange.mixing": 0.005}, 1.0),
    "rare": ({"exchange.segregation": 0.001, "exchange.mixing": 0.0005}, 0.5),
    "mixing only": ({"exchange.segregation": 0.0, "exchange.mixing": 0.02}, 0.5),
    "segregation only": ({"exchange.segregation": 0.05, "exchange.mixing": 0.0}, 1.0),
    "strong cushioning": ({"exchange.segregation": 0.02, "exchange.mixing": 0.01}, 0.3),
    "no cushioning": ({"exchange.segregation": 0.02, "exchange.mixing": 0.01}, INF),
}


@pytest.mark.parametrize("interrupted", [False, True])
@pytest.mark.parametrize("name", SCENES)
def test_every_step_is_the_plain_one_bit_for_bit(name, interrupted, monkeypatch):
    """The bounds that skip cells and blocks stay right when cells come and go: dense, sparse, stale and mended.

    Interrupted: no stress at every third point, so that parcels whose bounds are known swap where nothing crushes.
    """
    values, n = SCENES[name]
    scene = small(values | {"resolution.cells": sized(300, 40), "material.cushioning": n})
    watched = Watched(monkeypatch, scene, seed=10)
    if interrupted:
        watched.machine._log_stress[:, ::3], watched.machine._reach_needed[:, ::3] = -INF, INF
    steps = 2 * scene.resolution.points + 3
    for step in range(steps):
        watched.machine.advance(step)
    assert watched.crushes == steps
    cells = scene.resolution.streamlines * scene.resolution.cells
    assert watched.broken > cells
    assert watched.swaps == watched.machine.swaps > sized(cells / 20, 0)
    if name == "dense":
        assert watched.machine.most_passes > 2
        assert watched.dense > 0
    if name in ("sparse", "rare", "mixing only"):
        assert watched.mended > sized(20, -1)  # bounds mended cell by cell
        assert watched.trusted > sized(20, -1)  # parcels crushed on bounds they carried through swaps


def test_both_ways_of_swapping_meet_in_one_scene(monkeypatch):
    """Edges above and below the density at which every cell is decided, in the same passes."""
    kinds = set()
    swap = kernels.swap

    def counting(*values):
        rise, mixing, means, pairs = values[9], values[10], values[13], values[8]
        most = mixing + rise * (
            np.maximum(values[5][values[6]][pairs[:, 0]] - means[pairs[:, 0]], 0) + means[pairs[:, 1]]
        )
        kinds.update((most > kernels.DENSE).tolist())
        return swap(*values)

    watched = Watched(monkeypatch, mixed({"exchange.mixing": 0.02, "exchange.segregation": 0.02}), seed=11)
    swap = kernels.swap
    monkeypatch.setattr(kernels, "swap", counting)
    for step in range(watched.scene.resolution.points + 1):
        watched.machine.advance(step)
    assert kinds == {True, False}
    assert watched.mended > sized(20, -1)
    assert watched.dense > 0


def test_parcels_shift_one_point_per_step():
    machine = lattice(small(MARCH_ONLY))
    machine.advance(0)
    points = machine.slots.shape[1]
    for step in range(1, points + 3):
        before, sizes = machine.slots.copy(), machine.sizes.copy()
        machine.advance(step)
        assert np.array_equal(machine.slots[:, 1:], before[:, :-1])
        assert np.array_equal(machine.slots[:, 0], before[:, -1])  # feed takes the place of what left
        assert np.array_equal(np.sort(machine.slots, axis=None), np.arange(machine.slots.size))
        moved = machine.slots[:, 1:]
        assert np.all(machine.sizes[moved] <= sizes[moved])  # only crushed


def test_feed_enters_fresh_at_every_step():
    scene = small(MARCH_ONLY)
    machine, entered = lattice(scene, seed=12), []
    for step in range(5):
        machine.advance(step)
        entered.append(machine.sizes[machine.slots[:, 0]].copy())
        assert (entered[-1] >= np.float32(0.008)).all()
        assert (entered[-1] <= np.float32(0.06)).all()
    entered = np.sort(np.array(entered).reshape(15, -1), axis=1)
    assert len({row.tobytes() for row in entered}) == 15


# --- determinism -------------------------------------------------------------------------------------------


def test_same_seed_same_bits_other_seed_other_bits():
    scene = mixed(STRONG)
    first = simulate(scene, seed=13)
    assert first.identical(simulate(scene, seed=13))
    for seed, replicate in ((14, 0), (13, 1), (14, 1)):
        assert not np.array_equal(first["size"], simulate(scene, seed=seed, replicate=replicate)["size"])


def test_swaps_of_seeds_replicates_steps_and_passes_differ(monkeypatch):
    """No two passes of any of these runs draw from the same key."""
    keys, swap = [], kernels.swap
    monkeypatch.setattr(kernels, "swap", lambda *values: keys.append(int(values[15])) or swap(*values))
    for seed, replicate in ((0, 0), (1, 0), (0, 1)):
        machine = lattice(mixed({"exchange.mixing": 1.0, "resolution.cells": 4}), seed, replicate)
        for step in range(4):
            machine.advance(step)
        assert machine.most_passes > 1
    assert len(set(keys)) == len(keys) > 12


def test_threads_give_the_bits_of_a_serial_run():
    scenes = [mixed(STRONG | {"rolls.gap": gap}) for gap in (0.04, 0.05, 0.06, 0.07)]
    serial = [simulate(scene, seed=15) for scene in scenes]
    with ThreadPoolExecutor(2) as pool:
        threaded = list(pool.map(lambda scene: simulate(scene, seed=15), scenes))
    assert all(one.identical(other) for one, other in zip(serial, threaded, strict=True))


def test_what_is_recorded_does_not_touch_the_product():
    """Neither the record, nor the start-up's photographs, nor how often a steady one follows another."""
    scene = mixed(STRONG | {"exchange.interval": 4})
    wanted = simulate(scene, seed=16)
    for values in (
        {"resolution.record": "distributions"},
        {"resolution.record": "product"},
        {"exchange.record_startup": True},
        {"exchange.interval": 9},
    ):
        found = simulate(scene.with_values(values), seed=16)
        for name in PRODUCT:
            assert np.array_equal(found[name], wanted[name]), (values, name)


def test_recorded_distributions_are_those_of_the_recorded_cells():
    sieves = tuple(np.geomspace(1e-5, 0.06, 30))
    scene = mixed(STRONG | {"resolution.photographs": 2, "exchange.interval": 3, "resolution.sieves": sieves})
    size = simulate(scene, seed=17)["size"].values
    found = simulate(scene.with_values({"resolution.record": "distributions"}), seed=17)["mass_fraction"]
    passing = np.mean(size[..., None] <= np.array(sieves, np.float32), axis=3)
    assert np.allclose(found.cumsum("sieve"), passing, atol=1e-6)
    assert size.shape[0] == 2


# --- start-up and photographs ------------------------------------------------------------------------------


def started(values=None, **wishes):
    return simulate(
        mixed({"exchange.record_startup": True, "exchange.interval": 5, "resolution.photographs": 3} | (values or {})),
        **wishes,
    )


@pytest.mark.parametrize("record", ["cells", "distributions"])
def test_start_up_is_photographed_at_the_interval_and_then_the_steady_machine(record):
    found = started({"resolution.record": record})
    last = found.sizes["point"] - 1
    steps = [*range(0, last, 5), last, last + 5, last + 10]
    time_step = found.attrs["time_step_s"]
    assert np.allclose(found["elapsed_time"], np.array(steps) * time_step, rtol=1e-12)
    assert found["steady"].values.tolist() == [int(step >= last) for step in steps]
    assert found["time"].values.tolist() == list(range(len(steps)))
    # one residence time: the parcel that leaves has seen the whole machine
    assert np.isclose(float(found["elapsed_time"][found["steady"] == 1][0]), float(found["residence_time"][0, -1]))
    name = {"cells": "size", "distributions": "mass_fraction"}[record]
    plain = simulate(mixed({"exchange.interval": 5, "resolution.photographs": 3, "resolution.record": record}))
    assert plain["steady"].values.tolist() == [1, 1, 1]
    assert np.array_equal(plain[name], found[name][-3:])
    assert np.array_equal(plain["elapsed_time"], found["elapsed_time"][-3:])


def test_start_up_begins_with_the_feed_where_nothing_crushes():
    """Fill "feed": photograph 0 holds at every point whole parcels of feed; only cells under stress have broken.

    Without exchange the parcels are checked one by one; with it, the feed is there up to swaps.
    """
    scene = small(MARCH_ONLY | {"exchange.record_startup": True})
    first = simulate(scene, seed=18)["size"].values[0]
    pressure = loaded(scene)[3]
    last = scene.resolution.points - 1
    untouched = 0
    for line in range(3):
        for point in range(last + 1):
            feed, states = first_cells(scene, 18, fill_key(line, point, last))
            if pressure[line, point] == 0:
                assert np.array_equal(first[line, point], feed)
                untouched += 1
            else:
                with np.errstate(divide="ignore"):
                    level = np.log(pressure[line, point : point + 1] / scene.material.strength)
                wanted, _ = plain_crush(feed[None], states[None], level, scene)
                assert np.array_equal(first[line, point], wanted[0])
    assert untouched >= 9
    swapped = simulate(scene.with_values(STRONG), seed=18)["size"].values[0]
    assert not np.array_equal(swapped, first)
    assert np.array_equal(np.sort(swapped.reshape(-1, first.shape[-1]), axis=0),
                          np.sort(first.reshape(-1, first.shape[-1]), axis=0))  # fmt: skip


def test_product_becomes_finer_through_the_start_up():
    """At the exit the first fill has been crushed once, the last parcel all the way."""
    size = started({"exchange.interval": 3})["size"].values[:, :, -1].reshape(-1, 3 * sized(40, 20))
    means = size.mean(axis=1)
    assert means[0] > 1.5 * means[-3:].mean()
    crushed = started({"exchange.interval": 3, "exchange.fill": "crushed"})["size"].values[:, :, -1]
    assert crushed[0].mean() < 0.7 * means[0]


def test_product_is_pooled_from_the_steady_photographs_only():
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


def test_dataset_tells_passes_and_swaps(monkeypatch):
    """Swaps per cell in one residence time: two cells a swap, over all cells and all steps."""
    counts, swap = [], kernels.swap

    def counting(*values):
        counts.append((values[14], values[12], swap(*values)))
        return counts[-1][2]

    monkeypatch.setattr(kernels, "swap", counting)
    scene = mixed(STRONG | {"resolution.photographs": 2, "exchange.interval": 6})
    found = simulate(scene, seed=19)
    assert int(found["exchange_passes"]) == max(most for _, most, _ in counts) > 1
    points, cells = scene.resolution.points, 3 * scene.resolution.points * scene.resolution.cells
    steps = points + 6
    assert sum(number == 0 for number, _, _ in counts) == steps
    swaps = sum(count for _, _, count in counts)
    assert float(found["swaps_per_cell"]) == pytest.approx(2 * swaps / cells / (steps / points), rel=1e-6)
    assert found["exchange_passes"].attrs["units"] == found["swaps_per_cell"].attrs["units"] == "1"


def test_dataset_without_exchange_has_none_of_it():
    found = simulate(small())
    assert not {"swaps_per_cell", "exchange_passes", "volume", "elapsed_time", "steady"} & set(found.variables)


# --- what exchange does ------------------------------------------------------------------------------------


def closed_lattice(values, cells, seed):
    """A lattice of feed in which nothing breaks and, but for swaps, nothing moves."""
    scene = mixed({"material.strength": 1e15, "resolution.cells": cells, "resolution.points": 8} | values)
    machine = lattice(scene, seed=seed)
    machine.advance(0)
    np.random.default_rng(seed).shuffle(machine.sizes.reshape(-1))
    return machine, loaded(scene)[1].y.ravel()


def test_mixing_spreads_marked_cells_over_all_points():
    """One streamline of grains of its own. The scatter of their share over points falls from 0.47 to under 0.2."""
    cells = sized(500, 60)
    machine, _ = closed_lattice({"exchange.mixing": 2.0, "exchange.segregation": 0.0}, cells, seed=20)
    marked = np.full((3, 8, cells), 0.01, np.float32)
    marked[0] = 0.05
    machine.sizes[machine.slots.ravel()] = marked.reshape(24, cells)
    scatter = []
    for step in range(sized(60, 30)):
        machine._swap(step)
        scatter.append(np.std(np.mean(machine.sizes[machine.slots] == np.float32(0.05), axis=2)))
    assert np.mean(machine.sizes == np.float32(0.05)) == 1 / 3
    assert scatter[0] < math.sqrt(2) / 3
    assert 0 < scatter[-1] < 0.2


def test_segregation_lifts_large_grains():
    """A swap lifts the larger of two cells oftener: mean height weighted by size grows, beyond its scatter.

    Before, sizes know no height: the weighted mean's standard deviation is sd(s) sd(y) / (mean(s) sqrt(cells)).
    """
    cells = sized(500, 60)
    machine, height = closed_lattice({"exchange.mixing": 0.0, "exchange.segregation": 2.0}, cells, seed=21)

    def lifted():
        weight = machine.sizes[machine.slots.ravel()].astype(float)
        noise = weight.std() * height.std() / (weight.mean() * math.sqrt(weight.size))
        return (weight.sum(axis=1) @ height / weight.sum() - height.mean()) / noise

    assert abs(lifted()) < SIGMAS
    for step in range(10):
        machine._swap(step)
    assert lifted() > 2 * SIGMAS


def test_the_lattice_keeps_probabilities_at_one_half(monkeypatch):
    """Replayed from what each pass of a strong scene is given, with the largest grain there is anywhere."""
    swap, sums = kernels.swap, []

    def watched(*values):
        pairs, rise, mixing, passes, most, means, number = values[8:15]
        lower, upper = pairs.T
        part = (number + 1) * passes // most != number * passes // most
        chance = np.where(part, mixing + rise * (np.maximum(0.06 - means[lower], 0) + means[upper]), 0)
        sums.append((np.bincount(lower, chance, means.size) + np.bincount(upper, chance, means.size)).max())
        return swap(*values)

    monkeypatch.setattr(kernels, "swap", watched)
    simulate(mixed({"exchange.segregation": 2.0, "exchange.mixing": 2.0, "resolution.cells": 8}))
    assert 0.4 < max(sums) <= 0.5 + 1e-9


# --- memory ------------------------------------------------------------------------------------------------


def test_predicted_memory_of_the_lattice_is_that_of_its_arrays():
    """Within a factor of 2, from what the prediction adds per cell to what the arrays add per cell."""
    few, many = (mixed({"resolution.cells": cells, "resolution.record": "product"}) for cells in (16, 4016))

    def held(scene):
        parts = vars(lattice(scene)).values()
        return sum(part.nbytes for part in parts if isinstance(part, np.ndarray))

    predicted = budget.predict(many).bytes - budget.predict(few).bytes
    allocated = held(many) - held(few)
    assert allocated > 15 * 4000 * 3 * many.resolution.points
    assert 0.5 < predicted / allocated < 2
    assert budget.predict(many).bytes > held(many)
    assert budget.predict(small()).bytes < budget.predict(mixed()).bytes


def test_predicted_memory_counts_the_start_up_photographs():
    for record, part in (("cells", "size"), ("distributions", "mass_fraction")):
        scene = mixed({"exchange.record_startup": True, "exchange.interval": 1, "resolution.record": record})
        kept = simulate(scene)[part].nbytes
        scant = simulate(scene.with_values({"exchange.record_startup": False}))[part].nbytes
        more = budget.predict(scene).bytes - budget.predict(scene.with_values({"exchange.record_startup": False})).bytes
        assert more >= kept - scant
