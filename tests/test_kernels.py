import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numba import njit
from scipy import stats
from support import (
    GOLDEN,
    KS,
    SIGMAS,
    critical_log_stress,
    ks_distance,
    laws,
    line,
    march,
    plain,
    sized,
    split_mix,
    streams,
    weakness,
)

from hpgr.grains import kernels

INF = math.inf
MASK = 2**64 - 1


# --- the plain reference -----------------------------------------------------------------------------------


def reference(sizes, streams, log_stress, **constants):
    """The march of the model page, section 4, by the laws' own equations: every cell is looked at in every step."""
    sizes, states, breaks, every = sizes.copy(), [int(state) for state in streams], 0, []
    law = laws(**constants)
    scale = 3 / law.strength.weibull_modulus or 1.0

    def log_zeta(state):
        return -scale * math.log(weakness(law.strength, [state])[0])

    scattered = np.array([log_zeta(state) for state in states])
    for level in log_stress:
        strength = law.strength.log_strength(sizes) + scattered
        for p in np.flatnonzero((level >= strength) & (sizes.astype(float) >= law.fragments.size_floor)):
            states[p] = (states[p] + GOLDEN) & MASK
            uniform = ((split_mix(states[p]) >> 12) + 0.5) / 2**52
            ratio = law.fragments.quantile(uniform, float(sizes[p]))
            sizes[p] = np.float32(max(float(sizes[p]) * float(ratio), 1e-30))
            scattered[p] = log_zeta(states[p])
            breaks += 1
        every.append(sizes.copy())
    return sizes, np.array(states, np.uint64), breaks, np.array(every).reshape(-1, sizes.size)


def same(sizes, states, history, **constants):
    found = march(sizes, states, history, every=True, **constants)
    wanted = reference(sizes, states, history, **constants)
    return all(np.array_equal(found[k], wanted[k]) for k in range(4))


def histories(steps, seed):
    """A rising, a falling, a wandering and an interrupted stress history, as log(sigma_a / sigma_m)."""
    generator = np.random.default_rng(seed)
    rising = np.linspace(-0.5, 3.4, steps)
    wandering = generator.uniform(-1.0, 3.4, steps)
    interrupted = np.where(generator.random(steps) < 0.3, -np.inf, rising)
    return {"rising": rising, "falling": rising[::-1], "wandering": wandering, "interrupted": interrupted}


@pytest.mark.parametrize("cells", [1, 2, 3, 16, 17, 257])
def test_march_is_the_plain_reference_bit_for_bit(cells):
    """Lines of less than a block, of whole blocks, and of more blocks than a vector holds."""
    sizes, states = line(cells, seed=cells)
    for history in histories(sized(40, 20), seed=cells).values():
        assert same(sizes, states, history, n=0.5, gamma=0.35)


@pytest.mark.parametrize("w", [0.05, 1.0, 60.0, 100.0, 300.0, 700.0, 1e4, 1e8])
def test_march_is_the_plain_reference_for_every_weibull_modulus(w):
    """Towards w = inf, exp(-strength w / 3) leaves the range of float32, then of float64."""
    sizes, states = line(200, seed=1)
    for n in (0.3, 1.0, INF):
        for history in histories(30, seed=1).values():
            assert same(sizes, states, history, n=n, w=w)


@pytest.mark.parametrize(("k", "w", "nu"), [(0.5, 3.04, 0.0), (math.inf, 3.04, 0.7), (0.1, 3.04, -0.4), (3, INF, 2)])
def test_scattered_strengths_and_fragments_by_parent_are_the_plain_reference(k, w, nu):
    sizes, states = line(200, seed=2)
    for history in histories(30, seed=2).values():
        for n in (0.5, INF):
            assert same(sizes, states, history, n=n, k=k, w=w, nu=nu, gamma=0.5)


@given(
    st.lists(st.floats(1e-7, 1.0), min_size=1, max_size=40),
    st.lists(st.floats(-3, 6) | st.just(-INF), min_size=1, max_size=12),
    st.sampled_from([0.1, 0.3, 1.0, 5.0, INF]),
    st.sampled_from([0.5, 3.04, 20.0, INF]),
    st.sampled_from([0.1, 0.35, 1.0, 4.0]),
    st.sampled_from([1e-6, 1e-3, 0.02]),
)
def test_march_is_the_plain_reference_on_any_line(sizes, history, n, w, gamma, floor):
    sizes = np.array(sizes, np.float32)
    assert same(sizes, streams(sizes.size, 5), history, n=n, w=w, gamma=gamma, floor=floor)


@pytest.mark.parametrize("n", [1e-6, 1e-3, 0.1, 1.0, 30.0, INF])
@pytest.mark.parametrize("k", [2.0, INF])
def test_stresses_next_to_a_cells_strength_are_decided_as_by_the_plain_reference(n, k):
    """Where float32 would round to the other side: stresses that cells just bear, or not, of like and unlike sizes."""
    for like, seed in ((1e-6, 1), (1e-3, 2), (1.0, 3)):
        sizes, states = line(48, seed, 0.02, 0.02 * (1 + like))
        law = laws(n=n, k=k).strength
        strengths = law.log_strength(sizes) - 3 / law.weibull_modulus * np.log(weakness(law, states).astype(float))
        level = float(np.sort(strengths)[24])
        for off in 10.0 ** np.arange(-11, -4):  # less is the rounding of float64
            for side in (off, -off):
                assert same(sizes, states, [level + side * max(1.0, abs(level))], n=n, k=k)


def test_grains_that_are_below_the_floor_by_rounding_do_not_break():
    """float32(0.7) is less than 0.7, and so is what is stored of a grain of 0.7 m; the next larger is not."""
    below = np.float32(0.7)
    sizes = np.array([below, np.nextafter(below, np.float32(1))] * 8)
    assert below.item() < 0.7 < sizes[1].item()
    _, _, breaks = march(sizes, streams(16), [50.0], n=INF, floor=0.7)
    assert breaks == 8
    assert same(sizes, streams(16), [50.0], n=INF, floor=0.7)


def test_reference_is_not_idle():
    """The comparisons above are of lines that do break, and not everywhere."""
    sizes, states = line(100, seed=3)
    for history in histories(40, seed=3).values():
        crushed, _, breaks, _ = reference(sizes, states, history)
        assert 100 < breaks < 100 * 40
        assert 0.2 < np.mean(crushed < sizes) <= 1


# --- vectors -----------------------------------------------------------------------------------------------


@njit
def listed(level, bounds, first, base, found, count):
    return kernels._list_above(level, bounds, first, base, found, count)


@njit
def largest(bounds, first):
    return kernels._largest(bounds, first)


@given(st.lists(st.sampled_from([-1.0, 0.0, 1e-30, 0.5, 1.0, 3e38]), min_size=20, max_size=20), st.integers(0, 4))
def test_vectors_are_their_plain_loops(values, first):
    bounds = np.array(values, np.float32)
    vector, loop = np.zeros(60, np.uint32), np.zeros(60, np.uint32)
    for level in np.float32([0.0, 0.5, 3e38]):
        count = listed(level, bounds, first, np.uint32(32), vector, 3)
        assert count == kernels._plain_list_above(level, bounds, first, np.uint32(32), loop, 3)
        assert np.array_equal(vector[3:count], loop[3:count])
    assert largest(bounds, first) == kernels._plain_largest(bounds, first)


# --- random streams ----------------------------------------------------------------------------------------


def test_mix_is_split_mix_64():
    # published first outputs of SplitMix64 seeded with 1234567
    wanted = [6457827717110365317, 3203168211198807973, 9817491932198370423, 4593380528125082431, 16408922859458223821]
    states = [(1234567 + k * GOLDEN) & MASK for k in range(1, 6)]
    assert [int(kernels.mix(np.uint64(state))) for state in states] == [split_mix(state) for state in states] == wanted


def test_uniforms_stay_inside_the_unit_interval(monkeypatch):
    uniform = plain(kernels.uniform)
    monkeypatch.setattr(kernels, "mix", lambda state: state)
    assert uniform(np.uint64(0)) == 2.0**-53
    assert uniform(np.uint64(MASK)) == 1 - 2.0**-53


@pytest.mark.parametrize("gamma", [0.35, 1.0, 4.0])
def test_fragments_follow_their_law(gamma):
    """One break of each of many equal cells. Fails by chance once in a million (KS)."""
    samples = sized(20_000, 2_000)
    sizes = np.full(samples, 0.5, np.float32)
    found, _, breaks = march(sizes, streams(samples, 11), [10.0], n=INF, gamma=gamma)
    assert breaks == samples
    assert ks_distance(found / sizes, laws(gamma=gamma).fragments.passing) < KS / math.sqrt(samples)


# --- exact results of the model page, section 9 ------------------------------------------------------------


def single(cells, size, seed):
    return np.full(cells, size, np.float32), streams(cells, seed)


def break_counts(before, after, most=200):
    """Number of breaks of every cell, from how often its stream has moved on."""
    states = before[:, None] + np.arange(most, dtype=np.uint64) * np.uint64(GOLDEN)
    assert np.all((states == after[:, None]).sum(axis=1) == 1)
    return (states == after[:, None]).argmax(axis=1)


@pytest.mark.parametrize("gamma", [0.35, 1.0, 4.0])
def test_a2_breaks_are_one_plus_a_poisson_number(gamma):
    """Chi-square at 1e-6 over the counts, classes of less than 10 expected cells pooled at the end."""
    cells, critical = sized(50_000, 2_000), 0.004
    sizes, states = single(cells, 0.06, 22)
    _, after, breaks = march(sizes, states, [critical_log_stress(critical)] * 80, n=INF, gamma=gamma)
    counts = break_counts(states, after)
    assert counts.sum() == breaks
    assert counts.min() >= 1
    law = stats.poisson(gamma * math.log(0.06 / critical))
    last = int(law.isf(10 / cells))
    observed = np.bincount(np.minimum(counts - 1, last), minlength=last + 1)
    expected = cells * np.append(law.pmf(np.arange(last)), law.sf(last - 1))
    keep = expected > 5
    statistic = np.sum((observed - expected)[keep] ** 2 / expected[keep])
    assert statistic < stats.chi2.isf(1e-6, keep.sum() - 1)


def test_a4_only_the_smallest_critical_size_met_matters():
    """A grain's sizes are s0, s0 X1, s0 X1 X2, ... whenever it breaks, so the product is the same bit for bit."""
    sizes, states = line(300, seed=24)
    top, done = critical_log_stress(0.002), [critical_log_stress(0.002)] * 100
    direct = march(sizes, states, done, n=INF)
    for history in histories(40, seed=24).values():
        found = march(sizes, states, [*np.minimum(history, top), *done], n=INF)
        assert np.array_equal(found[0], direct[0])
        assert np.array_equal(found[1], direct[1])
        after = march(sizes, states, [*done, *np.minimum(history, top)], n=INF)
        assert np.array_equal(after[0], direct[0])


def test_a5_unfinished_fraction_after_k_attempts():
    """P(Poisson(gamma ln(s0 / s_c)) >= K); binomial, 5 sigma: 6e-7 a comparison, 6 comparisons."""
    cells, critical = sized(50_000, 2_000), 0.004
    law = stats.poisson(math.log(0.06 / critical))
    for attempts in (1, 2, 3, 4, 5, 7):
        found, _, _ = march(*single(cells, 0.06, 25), [critical_log_stress(critical)] * attempts, n=INF)
        share = law.sf(attempts - 1)
        assert abs(np.mean(found >= critical) - share) < SIGMAS * math.sqrt(share * (1 - share) / cells)


@pytest.mark.parametrize(("gamma", "attempts"), [(0.35, 2), (1.0, 5), (4.0, 5)])
def test_a6_equal_strengths_break_in_step(gamma, attempts):
    """w = n = inf: after K breaks -ln(s / s0) ~ Gamma(K, gamma). Fails by chance once in a million (KS)."""
    cells = sized(50_000, 2_000)
    sizes, states = single(cells, 0.06, 26)
    found, _, breaks = march(sizes, states, [0.0] * attempts, w=INF, n=INF, gamma=gamma, floor=0.0)
    assert breaks == cells * attempts
    drop = -np.log(found.astype(float) / float(np.float32(0.06)))
    assert ks_distance(drop, stats.gamma(attempts, scale=1 / gamma).cdf) < KS / math.sqrt(cells)
    unbroken, _, _ = march(sizes, states, [np.nextafter(0.0, -1.0) - 1e-5], w=INF, n=INF)
    assert np.array_equal(unbroken, sizes)


def half_every_time(monkeypatch):
    """Run the real march in Python with X = 1/2."""
    for name, function in list(vars(kernels).items()):
        monkeypatch.setattr(kernels, name, plain(function))
    monkeypatch.setattr(kernels, "_list_above", kernels._plain_list_above)
    monkeypatch.setattr(kernels, "_largest", kernels._plain_largest)
    monkeypatch.setattr(kernels, "uniform", lambda state: 0.5)
    return plain(kernels.crush)


@pytest.mark.parametrize("critical", [0.05, 0.011, 0.0003])
def test_a7_halving_grains_end_below_the_critical_size(monkeypatch, critical):
    """X = 1/2 always: s = s0 2^-(floor(log2(s0 / s_c)) + 1) for s0 >= s_c, bit for bit."""
    kernel = half_every_time(monkeypatch)
    sizes, states = line(100, seed=27)
    found, _, breaks = march(sizes, states, [critical_log_stress(critical)] * 20, n=INF, kernel=kernel)
    halvings = np.maximum(np.floor(np.log2(sizes.astype(float) / critical)) + 1, 0)
    assert np.array_equal(found, (sizes * 2.0**-halvings).astype(np.float32))
    assert breaks == halvings.sum()


@pytest.mark.parametrize("n", [0.3, 1.0, 3.0])
def test_a15_dust_shields_a_coarse_grain_by_at_most_its_factor(n):
    """Cushioning factor at most exp((ln 3)^2 / (2 n^2)), reached among dust."""
    sizes = np.full(5, 2e-12, np.float32)
    sizes[2] = 0.03
    bound = critical_log_stress(float(sizes[2])) + math.log(3) ** 2 / (2 * n**2)
    assert march(sizes, streams(5), [bound * (1 + 1e-6)], n=n)[2] == 1
    assert march(sizes, streams(5), [bound * (1 - 1e-6)], n=n)[2] == 0


# --- what holds always -------------------------------------------------------------------------------------


@pytest.mark.parametrize("gamma", [1e-3, 0.35, 1e6])
def test_sizes_never_grow_and_stay_normal_numbers(gamma):
    sizes, states = line(200, seed=41)
    *_, snapshots, _ = march(sizes, states, [5.0] * 50, n=INF, gamma=gamma, floor=0.0, every=True)
    everything = np.concatenate([sizes[None], snapshots])
    assert np.all(np.diff(everything, axis=0) <= 0)
    assert everything.min() >= np.finfo(np.float32).tiny
    assert np.all(everything >= np.float32(kernels.SMALLEST))


def test_hundreds_of_breaks_end_at_the_smallest_size():
    sizes, states = line(20, seed=42)
    found, _, breaks = march(sizes, states, [200.0] * 400, w=INF, n=INF, floor=0.0)
    assert breaks == 20 * 400
    assert np.all(found == np.float32(kernels.SMALLEST))


def test_stress_equal_to_the_strength_breaks():
    sizes = np.full(4, 0.06, np.float32)
    level = -(3 / 3.04) * math.log(float(sizes[0]) / 0.06)
    assert march(sizes, streams(4), [level])[2] == 4
    assert march(sizes, streams(4), [level - 1e-12])[2] == 0


# --- sieve classes -----------------------------------------------------------------------------------------


@given(st.lists(st.floats(1e-6, 1.0), min_size=1, max_size=10, unique=True), st.floats(1e-7, 2.0))
def test_sieve_class_counts_the_finer_sieves(sieves, size):
    sieves = np.sort(sieves)
    assert plain(kernels.sieve_class)(sieves, size) == np.sum(sieves < size)
    assert plain(kernels.sieve_class)(sieves, sieves[-1]) == sieves.size - 1  # a grain of the sieve's size passes it


@pytest.mark.parametrize("cells", [1, 17, 200])
def test_classes_are_those_of_the_sizes_after_every_step(cells):
    sizes, states = line(cells, seed=51)
    sieves = np.geomspace(1e-5, 0.04, 12)
    for history in histories(30, seed=51).values():
        *_, snapshots, classes = march(sizes, states, history, sieves=sieves, every=True)
        assert np.all(classes.sum(axis=1) == cells)
        for row, counts in zip(snapshots, classes, strict=True):
            passing = np.searchsorted(np.sort(row), sieves, side="right")
            assert np.array_equal(np.cumsum(counts[:-1]), passing)


@given(st.lists(st.floats(0.1, 10.0), min_size=2, max_size=8))
def test_recording_changes_nothing(history):
    sizes, states = line(30, seed=52)
    bare = march(sizes, states, history)
    recorded = march(sizes, states, history, sieves=[0.001, 0.01], every=True)
    assert np.array_equal(bare[0], recorded[0])
    assert bare[2] == recorded[2]
    assert np.array_equal(recorded[3][-1], bare[0])
