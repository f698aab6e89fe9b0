"""Every compiled loop, and nothing else: crushing of cell lines (paper eqs. 1 and 2), swaps between them (eq. 3).

The kernels take arrays and scalars. Sizes are stored as float32; whatever decides a break is float64.

How a break is decided. A cell of size s with neighbourhood mean sbar breaks when
log(sigma_a / sigma_m) >= -k log(s / s_m) + log(s / sbar)^2 / (2 n^2), k = 3 / w, or, the same, when its reach
s / s_m exp(-log(s / sbar)^2 / (2 n^2 k)) is at least `reach_needed` = (sigma_a / sigma_m)^(-1/k).
Each cell keeps an upper bound of its reach: s / s_m while its neighbourhood is new (cushioning only strengthens),
and a tight one once it has been seen to hold. Blocks of cells keep the largest bound within, so a step passes over
blocks that cannot break. Rational bounds of log and exp decide most of the rest, and logarithms what they leave
open. The bounds only ever skip tests whose answer is known: the sizes are those of the plain loop, bit for bit.
"""

import math

import numpy as np
from numba import njit

BLOCK = 16  # cells; on the paper's scene at 1,600 points 8 gains 5 % and 32 loses 20 %, at 200 points all are alike
DENSE = 1 / 64  # swap probability of an edge from which deciding every cell is cheaper than skipping
SMALLEST = 1e-30  # m; a fragment is never 0 nor denormal in float32, and counted as below the size floor

_MARGIN = 1.0 + 1e-6  # covers the rounding of a reach to float32, 6e-8, and of its exponential
_NEVER = -1.0  # bound of a cell that may not break, below every reach needed
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
def fragment_ratio(state, inverse_gamma):
    """Return X = U^(1/gamma) with U in (0, 1) from the 52 upper bits of a stream's number."""
    uniform = (np.float64(mix(state) >> _SHIFT_12) + 0.5) * 2.0**-52
    if inverse_gamma == 1.0:
        return uniform
    return uniform**inverse_gamma


@njit(cache=True, nogil=True)
def start_streams(base, streams):
    """Fill `streams` with the first state of each cell's own stream, from a 64-bit base."""
    for p in range(streams.size):
        streams[p] = mix(base + np.uint64(p + 1) * _GOLDEN)


@njit(cache=True, nogil=True)
def stratify(state, uniforms):
    """Fill `uniforms` with one uniform in each of as many equal strata, in random order (Fisher & Yates)."""
    cells = uniforms.size
    for p in range(cells):
        uniforms[p] = p
    for p in range(cells - 1, 0, -1):
        state += _GOLDEN
        q = np.int64(fragment_ratio(state, 1.0) * (p + 1))
        uniforms[p], uniforms[q] = uniforms[q], uniforms[p]
    for p in range(cells):
        state += _GOLDEN
        uniforms[p] = (uniforms[p] + fragment_ratio(state, 1.0)) / cells


@njit(cache=True, nogil=True)
def start_parcels(bases, uniforms, streams):
    """Fill uniforms and streams (parcel, cell) of parcels from two 64-bit bases each, (parcel, 2)."""
    for k in range(bases.shape[0]):
        start_streams(bases[k, 0], streams[k])
        stratify(bases[k, 1], uniforms[k])


@njit(cache=True, nogil=True)
def passing_counts(rows, sieves, counts):
    """Fill counts (row, sieve) with the cells of each sorted row that are no larger than each sieve."""
    for k in range(rows.shape[0]):
        row = rows[k]
        for m in range(sieves.size):
            low, high = 0, row.size
            while low < high:
                middle = (low + high) // 2
                if row[middle] <= sieves[m]:
                    low = middle + 1
                else:
                    high = middle
            counts[k, m] = low


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
def _new_reach(size, inverse_unit, size_floor):
    """Return the bound of a cell whose neighbourhood is new; nothing below the floor ever breaks."""
    if size < size_floor:
        return np.float32(_NEVER)
    if inverse_unit == 0.0:  # strength without size effect: every size may break
        return np.float32(_MARGIN)
    return np.float32(size * inverse_unit * _MARGIN)


@njit(cache=True, nogil=True)
def first_reach(sizes, reach, block_reach, inverse_unit, size_floor):
    """Set the bounds of a line of cells whose neighbourhoods are all new.

    Parameters
    ----------
    sizes : float32 (cell,)
        Sizes in m.
    reach, block_reach : float32 (block x BLOCK,), (block,)
        Set; places beyond the last cell never break.
    inverse_unit, size_floor : float
        1 / s_m, or 0 if strength knows no size; the size floor in m.
    """
    reach[:] = _NEVER
    for p in range(sizes.size):
        reach[p] = _new_reach(sizes[p], inverse_unit, size_floor)
    for block in range(block_reach.size):
        block_reach[block] = reach[block * BLOCK : (block + 1) * BLOCK].max()


@njit(cache=True, nogil=True)
def _renew(q, sizes, reach, block_reach, inverse_unit, size_floor):
    """Reset the bound of cell `q`, whose neighbourhood has changed."""
    bound = _new_reach(sizes[q], inverse_unit, size_floor)
    reach[q] = bound
    block_reach[q // BLOCK] = max(bound, block_reach[q // BLOCK])


@njit(cache=True, nogil=True)
def crush(
    sizes, streams, reach, block_reach, broken, active, sieves, counts,
    log_stress, reach_needed, slope, cushion, inverse_gamma, strength_size, size_floor,
):  # fmt: skip
    """Break each cell of one line once where the stress exceeds its strength; return how many broke.

    Parameters
    ----------
    sizes : float32 (cell,)
        Sizes in m, updated synchronously: every strength is that of the sizes on entry.
    streams : uint64 (cell,)
        State of each cell's random stream; a break draws one number of the cell's own.
    reach, block_reach : float32 (block x BLOCK,), (block,)
        Bounds, see the module's head; updated.
    broken, active : uint32 (block x BLOCK + 1,), (block + 1,)
        Work space; on return the head of `broken` lists the cells that broke. Unsigned, or every index read from
        them would be tested for being negative (157 -> 149 ns a cell).
    sieves, counts : float64 (sieve,), int64 (sieve + 1,)
        Sieve classes to keep counted; none if `sieves` is empty.
    log_stress, reach_needed : float
        log(sigma_a / sigma_m), and the least reach that breaks under it.
    slope, cushion, inverse_gamma, strength_size, size_floor : float
        3 / w, 1 / (2 n^2), 1 / gamma, s_m and the size floor in m.
    """
    cells = sizes.size
    scale = slope if slope > 0.0 else 1.0
    inverse_unit = 1.0 / strength_size if slope > 0.0 else 0.0
    stiff = cushion / scale
    # a reach that has underflowed decides nothing: then only the logarithms do
    trusted = reach_needed > 1e-200
    surely = reach_needed * (1.0 + 1e-9) if trusted else np.inf
    hardly = reach_needed * (1.0 - 1e-9) if trusted else 0.0
    needed = np.float32(min(reach_needed, 3e38))  # float32 ends there, beyond every reach

    # lists are filled without branches: a mispredicted one costs more than the test (196 -> 151 ns a cell)
    rows = reach.reshape(-1, BLOCK)
    actives = 0
    for block in range(block_reach.size):
        active[actives] = block
        actives += block_reach[block] >= needed
    candidates = 0
    for k in range(actives):
        first = active[k] * BLOCK
        row = rows[active[k]]
        for q in range(BLOCK):
            broken[candidates] = first + q
            candidates += row[q] >= needed

    found = 0
    for k in range(candidates):
        p = broken[k]
        size = np.float64(sizes[p])
        left = sizes[p - 1] if p > 0 else sizes[cells - 1]
        right = sizes[p + 1] if p + 1 < cells else sizes[0]
        # neighbours first: their sum is the same bits in a mirrored line
        total = (np.float64(left) + np.float64(right)) + size
        ratio = size * inverse_unit if slope > 0.0 else 1.0
        # log(s / sbar) = 2 artanh(z) between low and, up to zz = 1/2, high; exp(-y) between the two cubics.
        # Two divisions: one for sbar and one for the series' rest, zz^2 / (5 - 5 zz), would cost 15 ns a cell
        z = (3.0 * size - total) / (3.0 * size + total)
        zz = z * z
        low = 2.0 * z * (1.0 + zz * (1.0 / 3.0))
        high = 2.0 * z * (1.0 + zz * (1.0 / 3.0 + zz * (0.2 + 0.4 * zz)))
        y = stiff * (low * low)
        most = ratio / (1.0 + y * (1.0 + y * (0.5 + y * (1.0 / 6.0))))
        y = stiff * (high * high)
        least = ratio * (1.0 - y * (1.0 - y * (0.5 - y * (1.0 / 6.0)))) if zz <= 0.5 else 0.0
        breaks = least >= surely
        # one comparison, not "and": the usual answer of both together is predictable (151 -> 114 ns a cell)
        if breaks != (most >= hardly):
            unlike = math.log(size / (total / 3.0))
            strength = cushion * unlike * unlike - slope * math.log(size / strength_size)
            breaks = log_stress >= strength
            most = math.exp(-strength / scale)
        reach[p] = np.float32(most * _MARGIN)
        broken[found] = p
        found += breaks

    for k in range(found):
        p = broken[k]
        streams[p] += _GOLDEN
        size = np.float32(max(sizes[p] * fragment_ratio(streams[p], inverse_gamma), SMALLEST))
        if sieves.size:
            counts[sieve_class(sieves, sizes[p])] -= 1
            counts[sieve_class(sieves, size)] += 1
        sizes[p] = size
        reach[p] = _new_reach(size, inverse_unit, size_floor)  # its block's maximum is taken anew below
    for k in range(found):
        p = broken[k]
        _renew(p - 1 if p > 0 else cells - 1, sizes, reach, block_reach, inverse_unit, size_floor)
        _renew(p + 1 if p + 1 < cells else 0, sizes, reach, block_reach, inverse_unit, size_floor)
    for k in range(actives):
        row = rows[active[k]]
        highest = row[0]
        for q in range(1, BLOCK):
            highest = max(highest, row[q])
        block_reach[active[k]] = highest
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
    blocks = (sizes.size + BLOCK - 1) // BLOCK
    reach = np.empty(blocks * BLOCK, np.float32)
    block_reach = np.empty(blocks, np.float32)
    broken = np.empty(blocks * BLOCK + 1, np.uint32)
    active = np.empty(blocks + 1, np.uint32)
    counts = np.zeros(sieves.size + 1, np.int64)
    first_reach(sizes, reach, block_reach, 1.0 / strength_size if slope > 0.0 else 0.0, size_floor)
    if sieves.size:
        classify(sizes, sieves, counts)
    breaks = 0
    for j in range(log_stress.size):
        if reach_needed[j] < np.inf:
            breaks += crush(
                sizes, streams, reach, block_reach, broken, active, sieves, counts,
                log_stress[j], reach_needed[j], slope, cushion, inverse_gamma, strength_size, size_floor,
            )  # fmt: skip
        if snapshots.size:
            snapshots[j] = sizes
        if classes.size:
            classes[j] = counts
    return breaks


@njit(cache=True, nogil=True)
def march_parcels(
    sizes, streams, lines, log_stress, reach_needed, sieves, snapshots, classes, breaks,
    slope, cushion, inverse_gamma, strength_size, size_floor,
):  # fmt: skip
    """March several parcels, each along its streamline, in one call: a thread that waits for its turn between
    short calls would lose what a second core gains (2 threads: 1.0 -> 1.7 times one).

    Parameters
    ----------
    sizes, streams : float32, uint64 (parcel, cell)
        As in `march`.
    lines : int64 (parcel,)
        Streamline of each parcel.
    log_stress, reach_needed : float64 (streamline, point)
        As in `march`.
    sieves : float64 (sieve,)
        As in `march`.
    snapshots, classes : (parcel, point, cell) or (0, 0, 0), (parcel, point, sieve + 1) or (0, 0, 0)
        As in `march`.
    breaks : int64 (parcel,)
        Set to the number of breaks.
    slope, cushion, inverse_gamma, strength_size, size_floor : float
        As in `crush`.
    """
    no_snapshots, no_classes = np.empty((0, 0), np.float32), np.empty((0, 0), np.int64)
    for k in range(lines.size):
        breaks[k] = march(
            sizes[k], streams[k], log_stress[lines[k]], reach_needed[lines[k]], sieves,
            snapshots[k] if snapshots.size else no_snapshots, classes[k] if classes.size else no_classes,
            slope, cushion, inverse_gamma, strength_size, size_floor,
        )  # fmt: skip


@njit(cache=True, nogil=True)
def _largest_bits(sizes):
    """Return the bits of the largest of a line of sizes; positive floats order like their bits."""
    bits = sizes.view(np.int32)  # a maximum of integers is vectorised, one of floats is not
    highest = np.int32(0)
    for p in range(bits.size):
        highest = max(highest, bits[p])
    return highest


@njit(cache=True, nogil=True)
def _total(sizes):
    """Return the sum of a line of sizes; eight partial sums are vectorised where one is not (1.0 -> 0.2 ns a cell)."""
    a = b = c = d = e = f = g = h = 0.0
    whole = sizes.size // 8
    for k in range(whole):
        p = 8 * k
        a += np.float64(sizes[p])
        b += np.float64(sizes[p + 1])
        c += np.float64(sizes[p + 2])
        d += np.float64(sizes[p + 3])
        e += np.float64(sizes[p + 4])
        f += np.float64(sizes[p + 5])
        g += np.float64(sizes[p + 6])
        h += np.float64(sizes[p + 7])
    for p in range(8 * whole, sizes.size):
        a += np.float64(sizes[p])
    return ((a + b) + (c + d)) + ((e + f) + (g + h))


@njit(cache=True, nogil=True)
def crush_lattice(
    sizes, streams, reach, block_reach, stale, breaks, slots, log_stress, reach_needed,
    slope, cushion, inverse_gamma, strength_size, size_floor,
):  # fmt: skip
    """Crush every parcel of the lattice once, each under the stress of the point it is at.

    Parameters
    ----------
    sizes, streams, reach, block_reach : (slot, ...)
        The parcels, as in `crush`.
    stale : bool (slot,)
        Whether a parcel's bounds are to be set anew before they are used.
    breaks : int64 (slot,)
        Breaks of each parcel, added to.
    slots : int64 (number of points,)
        Slot of the parcel at each point, streamline by streamline.
    log_stress, reach_needed : float64 (number of points,)
        As in `crush`, at every point.
    slope, cushion, inverse_gamma, strength_size, size_floor : float
        As in `crush`.
    """
    broken = np.empty(reach.shape[1] + 1, np.uint32)
    active = np.empty(block_reach.shape[1] + 1, np.uint32)
    no_sieves, no_counts = np.empty(0), np.zeros(1, np.int64)
    for point in range(slots.size):
        if reach_needed[point] == np.inf:
            continue
        slot = slots[point]
        if stale[slot]:
            inverse_unit = 1.0 / strength_size if slope > 0.0 else 0.0
            first_reach(sizes[slot], reach[slot], block_reach[slot], inverse_unit, size_floor)
            stale[slot] = False
        breaks[slot] += crush(
            sizes[slot], streams[slot], reach[slot], block_reach[slot], broken, active, no_sieves, no_counts,
            log_stress[point], reach_needed[point], slope, cushion, inverse_gamma, strength_size, size_floor,
        )  # fmt: skip


@njit(cache=True, nogil=True)
def measure(sizes, slots, means, largest):
    """Fill the mean size at every point and the largest size of every slot, m."""
    for point in range(slots.size):
        slot = slots[point]
        means[point] = _total(sizes[slot]) / sizes.shape[1]
        largest.view(np.int32)[slot] = _largest_bits(sizes[slot])


@njit(cache=True, nogil=True)
def classify_lattice(sizes, slots, sieves, classes):
    """Count the cells of each sieve class at every point into `classes` (number of points, sieve + 1)."""
    for point in range(slots.size):
        classify(sizes[slots[point]], sieves, classes[point])


@njit(cache=True, nogil=True)
def _swap_densely(below, above, streams_below, streams_above, state, rise, mixing, mean_below, mean_above):
    """Decide every cell of an edge in turn, without branches; return the number of swaps."""
    swaps = 0
    for p in range(below.size):
        a, b = below[p], above[p]
        chance = mixing + rise * (max(a - mean_below, 0.0) + max(mean_above - b, 0.0))
        number = mix(state + np.uint64(p + 1) * _GOLDEN)
        hit = np.float64(np.int64(number >> _SHIFT_12)) < chance * 2.0**52
        below[p], above[p] = b if hit else a, a if hit else b
        s, t = streams_below[p], streams_above[p]
        streams_below[p], streams_above[p] = t if hit else s, s if hit else t
        swaps += hit
    return swaps


@njit(cache=True, nogil=True)
def swap(
    sizes, streams, reach, block_reach, stale, largest, slots, crushing, pairs, rise, mixing, passes, most_passes,
    means, number, key, inverse_unit, size_floor,
):  # fmt: skip
    """Pass once over the edges and swap cells of equal index across each; return the number of swaps.

    A cell of size a below and one of size b above an edge swap with probability
    mixing + rise [(a - mean below)+ + (mean above - b)+]. Where swaps are rare, candidates are drawn by
    geometric skipping with the largest probability of the edge and then thinned, so that the cost follows the
    swaps, not the cells; where they are frequent, every cell is decided in turn.

    Parameters
    ----------
    sizes, streams, reach, block_reach, stale : (slot, ...)
        The parcels, as in `crush_lattice`; cells move with their streams.
    largest : float32 (slot,)
        Bound of each parcel's sizes, m; kept up to date.
    slots : int64 (number of points,)
        Slot of the parcel at each point.
    crushing : bool (number of points,)
        Where grains may break: there bounds are mended cell by cell, elsewhere the parcel turns stale.
    pairs : int64 (edge, 2)
        Points below and above each edge.
    rise, mixing : float64 (edge,)
        Probabilities of a swap by segregation, per m, and by mixing, in a pass.
    passes, most_passes : int64 (edge,), int
        In how many of the time step's passes each edge takes part, evenly spread, and the number of all.
    means : float64 (number of points,)
        Mean size of each parcel, m, held during the time step.
    number, key : int, uint64
        Number of the pass and its key; edge e draws from a stream of its own.
    inverse_unit, size_floor : float
        As in `first_reach`.
    """
    cells = sizes.shape[1]
    swaps = 0
    for e in range(pairs.shape[0]):
        if (number + 1) * passes[e] // most_passes == number * passes[e] // most_passes:
            continue
        lower, upper = slots[pairs[e, 0]], slots[pairs[e, 1]]
        mean_below, mean_above = means[pairs[e, 0]], means[pairs[e, 1]]
        most = mixing[e] + rise[e] * (max(largest[lower] - mean_below, 0.0) + mean_above)
        if most <= 0.0:
            continue
        state = mix(key + np.uint64(e + 1) * _GOLDEN)
        if most > DENSE:
            swaps += _swap_densely(
                sizes[lower], sizes[upper], streams[lower], streams[upper], state,
                rise[e], mixing[e], mean_below, mean_above,
            )  # fmt: skip
            stale[lower] = stale[upper] = True
            largest[lower] = largest[upper] = max(largest[lower], largest[upper])
            continue
        uniform = fragment_ratio(state, 1.0)
        if uniform < 1.0 - cells * most:  # then the first candidate lies past the last cell: no logarithm needed
            continue
        mend_lower = crushing[pairs[e, 0]] and not stale[lower]
        mend_upper = crushing[pairs[e, 1]] and not stale[upper]
        per_cell = 1.0 / math.log1p(-most)
        skip = math.log(uniform) * per_cell
        p = np.int64(skip) if skip < cells else cells
        before = swaps
        while p < cells:
            below, above = sizes[lower, p], sizes[upper, p]
            chance = mixing[e] + rise[e] * (max(below - mean_below, 0.0) + max(mean_above - above, 0.0))
            state += _GOLDEN
            if fragment_ratio(state, 1.0) * most < chance:
                sizes[lower, p], sizes[upper, p] = above, below
                streams[lower, p], streams[upper, p] = streams[upper, p], streams[lower, p]
                largest[lower] = max(largest[lower], above)
                largest[upper] = max(largest[upper], below)
                left, right = p - 1 if p > 0 else cells - 1, p + 1 if p + 1 < cells else 0
                if mend_lower:
                    for q in (left, p, right):
                        _renew(q, sizes[lower], reach[lower], block_reach[lower], inverse_unit, size_floor)
                if mend_upper:
                    for q in (left, p, right):
                        _renew(q, sizes[upper], reach[upper], block_reach[upper], inverse_unit, size_floor)
                swaps += 1
            state += _GOLDEN
            skip = math.log(fragment_ratio(state, 1.0)) * per_cell
            p += 1 + (np.int64(skip) if skip < cells else cells)
        if swaps > before:
            stale[lower] = stale[lower] or not mend_lower
            stale[upper] = stale[upper] or not mend_upper
    return swaps
