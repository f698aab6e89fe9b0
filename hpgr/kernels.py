"""Every compiled loop, and nothing else: crushing of cell lines (paper eqs. 1 and 2).

The kernels take arrays and scalars. Sizes are stored as float32; whatever decides a break is float64.

How a break is decided. A cell of size s with neighbourhood mean sbar breaks when
log(sigma_a / sigma_m) >= -k log(s / s_m) + log(s / sbar)^2 / (2 n^2), k = 3 / w. Cushioning only
strengthens, so a cell can only break where s / s_m >= (sigma_a / sigma_m)^(-1/k): `reach_needed`. Each cell
keeps an upper bound of the left side of that test, its `reach`: s / s_m while its neighbourhood is new, and
once it has been seen to hold, exp(-strength / k), which decides all later steps until it or a neighbour
breaks. Blocks of cells keep the largest reach within, so steps pass over blocks that cannot break. The
bounds only ever skip tests that would fail: the sizes are those of the plain loop, bit for bit.
"""

import math

import numpy as np
from numba import njit

BLOCK = 16  # cells; of 8, 16, 32, 64 the fastest on the paper's scene at 200 points (benchmarks/kernel.py)
SMALLEST = 1e-30  # m; a fragment is never 0 nor denormal in float32, and counted as below the size floor

_MARGIN = 1.0 + 1e-6  # covers the rounding of a reach to float32, 6e-8, and of its exponential
_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX_2 = np.uint64(0x94D049BB133111EB)
_SHIFT_30, _SHIFT_27, _SHIFT_31 = np.uint64(30), np.uint64(27), np.uint64(31)
_SHIFT_12 = np.uint64(12)


@njit(cache=True, nogil=True)
def mix(state):
    """Return the output of SplitMix64 for a state (Steele, Lea & Flood 2014)."""
    z = (state ^ (state >> _SHIFT_30)) * _MIX_1
    z = (z ^ (z >> _SHIFT_27)) * _MIX_2
    return z ^ (z >> _SHIFT_31)


@njit(cache=True, nogil=True)
def start_streams(base, streams):
    """Fill `streams` with the first state of each cell's own stream, from a 64-bit base."""
    for p in range(streams.size):
        streams[p] = mix(base + np.uint64(p + 1) * _GOLDEN)


@njit(cache=True, nogil=True)
def fragment_ratio(state, inverse_gamma):
    """Return X = U^(1/gamma) with U in (0, 1) from the 52 upper bits of a stream's number."""
    uniform = (np.float64(mix(state) >> _SHIFT_12) + 0.5) * 2.0**-52
    if inverse_gamma == 1.0:
        return uniform
    return uniform**inverse_gamma


@njit(cache=True, nogil=True)
def sieve_class(sieves, size):
    """Return how many of the rising `sieves` are finer than `size`."""
    low, high = 0, sieves.size
    while low < high:
        middle = (low + high) // 2
        if sieves[middle] < size:
            low = middle + 1
        else:
            high = middle
    return low


@njit(cache=True, nogil=True)
def classify(sizes, sieves, counts):
    """Count the cells of each sieve class into `counts` (sieves.size + 1)."""
    counts[:] = 0
    for p in range(sizes.size):
        counts[sieve_class(sieves, sizes[p])] += 1


@njit(cache=True, nogil=True)
def first_reach(sizes, reach, block_reach, size_unit, size_floor):
    """Set the bounds of a line of cells whose neighbourhoods are all new."""
    block_reach[:] = 0.0
    for p in range(sizes.size):
        reach[p] = _new_reach(sizes[p], size_unit, size_floor)
        block_reach[p // BLOCK] = max(block_reach[p // BLOCK], reach[p])


@njit(cache=True, nogil=True)
def _new_reach(size, size_unit, size_floor):
    """Return the reach of a cell whose neighbourhood is new; nothing below the floor reaches a break."""
    if size < size_floor:
        return np.float32(0.0)
    if size_unit == 0.0:  # strength without size effect: every size may break
        return np.float32(_MARGIN)
    return np.float32(size / size_unit * _MARGIN)


@njit(cache=True, nogil=True)
def crush(
    sizes, streams, reach, block_reach, broken, sieves, counts,
    log_stress, reach_needed, slope, cushion, inverse_gamma, strength_size, size_floor,
):  # fmt: skip
    """Break each cell of one line once where the stress exceeds its strength; return how many broke.

    Parameters
    ----------
    sizes : float32 (cell,)
        Sizes in m, updated synchronously: every strength is that of the sizes on entry.
    streams : uint64 (cell,)
        State of each cell's random stream; a break draws one number of the cell's own.
    reach, block_reach : float32 (cell,), (block,)
        Bounds, see the module's head; updated.
    broken : int64 (cell,)
        Work space; on return its head lists the cells that broke.
    sieves, counts : float64 (sieve,), int64 (sieve + 1,)
        Sieve classes to keep counted; none if `sieves` is empty.
    log_stress, reach_needed : float
        log(sigma_a / sigma_m), and the least reach that can break under it.
    slope, cushion, inverse_gamma, strength_size, size_floor : float
        3 / w, 1 / (2 n^2), 1 / gamma, s_m and the size floor in m.
    """
    cells = sizes.size
    size_unit = strength_size if slope > 0.0 else 0.0
    scale = slope if slope > 0.0 else 1.0
    found = 0
    for block in range(block_reach.size):
        if block_reach[block] < reach_needed:
            continue
        highest = np.float32(0.0)
        for p in range(block * BLOCK, min((block + 1) * BLOCK, cells)):
            if reach[p] >= reach_needed:
                size = np.float64(sizes[p])
                left = sizes[p - 1] if p > 0 else sizes[cells - 1]
                right = sizes[p + 1] if p + 1 < cells else sizes[0]
                # neighbours first: their sum, and so the mean, is the same bits in a mirrored line
                mean = ((np.float64(left) + np.float64(right)) + size) / 3.0
                unlike = math.log(size / mean)
                strength = cushion * unlike * unlike - slope * math.log(size / strength_size)
                if log_stress >= strength:
                    broken[found] = p
                    found += 1
                    continue
                reach[p] = np.float32(math.exp(-strength / scale) * _MARGIN)
            highest = max(highest, reach[p])
        block_reach[block] = highest
    for k in range(found):
        p = broken[k]
        streams[p] += _GOLDEN
        size = np.float32(max(sizes[p] * fragment_ratio(streams[p], inverse_gamma), SMALLEST))
        if sieves.size:
            counts[sieve_class(sieves, sizes[p])] -= 1
            counts[sieve_class(sieves, size)] += 1
        sizes[p] = size
    for k in range(found):
        p = broken[k]
        for q in (p - 1 if p > 0 else cells - 1, p, p + 1 if p + 1 < cells else 0):
            reach[q] = _new_reach(sizes[q], size_unit, size_floor)
            block_reach[q // BLOCK] = max(block_reach[q // BLOCK], reach[q])
    return found


@njit(cache=True, nogil=True)
def march(
    sizes, streams, log_stress, reach_needed, sieves, snapshots, classes,
    slope, cushion, inverse_gamma, strength_size, size_floor,
):  # fmt: skip
    """Carry one parcel along a streamline, crushing it at every point; return its number of breaks.

    Parameters
    ----------
    sizes, streams : float32 (cell,), uint64 (cell,)
        The parcel on entry; on return as it leaves.
    log_stress, reach_needed : float64 (point,)
        As in `crush`, at every point.
    sieves : float64 (sieve,)
        Sieves of `classes`; empty to count none.
    snapshots : float32 (point, cell) or (0, 0)
        Filled with the sizes at every point, unless empty.
    classes : int64 (point, sieve + 1) or (0, 0)
        Filled with the cells per sieve class at every point, unless empty.
    slope, cushion, inverse_gamma, strength_size, size_floor : float
        As in `crush`.
    """
    reach = np.empty(sizes.size, np.float32)
    block_reach = np.empty((sizes.size + BLOCK - 1) // BLOCK, np.float32)
    broken = np.empty(sizes.size, np.int64)
    counts = np.zeros(sieves.size + 1, np.int64)
    first_reach(sizes, reach, block_reach, strength_size if slope > 0.0 else 0.0, size_floor)
    if sieves.size:
        classify(sizes, sieves, counts)
    breaks = 0
    for j in range(log_stress.size):
        if reach_needed[j] < np.inf:
            breaks += crush(
                sizes, streams, reach, block_reach, broken, sieves, counts,
                log_stress[j], reach_needed[j], slope, cushion, inverse_gamma, strength_size, size_floor,
            )  # fmt: skip
        if snapshots.size:
            snapshots[j] = sizes
        if classes.size:
            classes[j] = counts
    return breaks
