"""Every compiled loop of the grains: crushing of lines of cells (paper eqs. 1 and 2), swaps between them (eq. 3).

The kernels take arrays, scalars and named tuples of these. Sizes are stored as float32; whatever decides a break is
float64. A line of cells is periodic: its places 1 to M hold the cells, 0 and M + 1 copies of the far ends.

How a break is decided. A cell of size s with neighbourhood mean sbar breaks when
log(sigma_a / sigma_m) >= -k log(s / s_m) + log(s / sbar)^2 / (2 n^2), k = 3 / w, or, the same, when its effective size
over s_m, s / s_m exp(-log(s / sbar)^2 / (2 n^2 k)), is at least the critical size ratio (sigma_a / sigma_m)^(-1/k).
Each cell keeps an upper bound of its effective size: s / s_m while its neighbourhood is new (cushioning only
strengthens), and a tight one once it has been seen to hold. Blocks of cells keep the largest bound within, so a step
passes over blocks that cannot break. Rational bounds of log and exp decide most of the rest, and logarithms what they
leave open. The bounds only ever skip tests whose answer is known: the sizes are those of the plain loop, bit for bit.

A step goes through the cells in short loops, each over a whole list, so that compilers make vectors of them.
"""

import math
from typing import NamedTuple

import numpy as np
from llvmlite import ir
from numba import config, njit, types
from numba.core import cgutils
from numba.extending import intrinsic

from hpgr.laws.fragments import HELD, POWER_LAW
from hpgr.laws.strength import SIZE_EFFECT

_compiled = njit(cache=True, nogil=True, error_model="numpy")
_inlined = njit(cache=True, nogil=True, error_model="numpy", forceinline=True)  # handing arrays over costs as much

BLOCK = 16  # cells; as many as the vectors below
DENSE = 1 / 64  # swap probability of an edge from which deciding every cell is cheaper than skipping
SMALLEST = 1e-30  # m; a fragment is never 0 nor denormal in float32, and counted as below the size floor

_MARGIN = 1.0 + 1e-6  # covers the rounding of an effective size to float32, 6e-8, and of its exponential
_NEVER = np.float32(-1.0)  # bound of a cell that may not break, below every critical size ratio
_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX_2 = np.uint64(0x94D049BB133111EB)
_SHIFT_30, _SHIFT_27, _SHIFT_31 = np.uint64(30), np.uint64(27), np.uint64(31)
_SHIFT_12 = np.uint64(12)
_1 = np.uint64(1)  # places are unsigned, or every one of them would be tested for being negative


class Ore(NamedTuple):
    """The constants of a law of strength, then those of a law of fragments."""

    strength: int  # tag
    slope: float  # 3 / w
    cushion: float  # 1 / (2 n^2)
    reference_size: float  # m
    scatter: float  # k
    fragments: int  # tag
    inverse_exponent: float  # 1 / gamma
    size_exponent: float  # nu
    parent_size: float  # s_r, m
    size_floor: float  # m


class Parcels(NamedTuple):
    """Lines of cells, (slot, ...), or one of them."""

    sizes: np.ndarray  # float32 (cell + 2,), m
    streams: np.ndarray  # uint64 (cell + 2,), state of each cell's random stream
    weakness: np.ndarray  # float32 (cell + 2,), what a grain's own strength makes of its effective size; (0,): 1
    unshielded: np.ndarray  # float32 (cell + 2,), bounds of cells that nothing is known of but themselves
    bounds: np.ndarray  # float32 (block x BLOCK + 2,), upper bounds of effective size over s_m
    block_bounds: np.ndarray  # float32 (block, to the next BLOCK), the largest in each block


class Path(NamedTuple):
    """What loads a parcel, (..., point)."""

    log_stress: np.ndarray  # log(sigma_a / sigma_m)
    critical_ratio: np.ndarray  # least effective size over s_m that breaks


class Record(NamedTuple):
    """What is kept of every point; empty arrays keep nothing."""

    sieves: np.ndarray  # float64 (sieve,), m
    snapshots: np.ndarray  # float32 (..., point, cell), sizes, m
    classes: np.ndarray  # int64 (..., point, sieve + 1), cells of each sieve class


class Work(NamedTuple):
    """Work space of a step: lists of blocks and of candidates for a break, and what is known of the latter."""

    active: np.ndarray  # uint32 (block,)
    places: np.ndarray  # uint32 (candidate,)
    sizes: np.ndarray  # float64, m; then the fragment ratios
    totals: np.ndarray  # float64, size and those of both neighbours, m; then exponents
    ratios: np.ndarray  # float64, effective size over s_m without neighbours; then work space of `_raise`
    states: np.ndarray  # uint64, of the streams
    bounds: np.ndarray  # float32
    breaks: np.ndarray  # uint8
    unsure: np.ndarray  # uint8


class Edges(NamedTuple):
    """Edges between material points, (edge, ...), with the probabilities of one exchange substep."""

    pairs: np.ndarray  # int64 (edge, 2), points below and above
    rise: np.ndarray  # float64, of a swap by segregation, 1/m
    mixing: np.ndarray  # float64, of a swap by mixing
    substeps: np.ndarray  # int64, in how many of the time step's substeps an edge takes part, evenly spread


# --- vectors ------------------------------------------------------------------------------------------------


def _plain_list_above(level, bounds, first, base, found, count):
    """Append to `found` base + k of each of BLOCK bounds, from place `first`, that is at least `level`.

    Return the number of places found so far; what lies beyond it is overwritten. At 1,600 points of the paper's scene
    the compiled loop costs 57 ns a cell, the vectors 15.
    """
    for k in range(BLOCK):
        found[count] = base + np.uint32(k)
        count += bounds[first + k] >= level
    return count


def _plain_largest(bounds, first):
    """Return the largest of BLOCK bounds from place `first`."""
    highest = bounds[first]
    for k in range(1, BLOCK):
        highest = max(highest, bounds[first + k])
    return highest


# for every byte the numbers of its bits that are set, packed one a byte
_BITS_SET = [sum(bit << 8 * k for k, bit in enumerate(b for b in range(8) if byte >> b & 1)) for byte in range(256)]


def _vector(context, builder, array, values, kind):
    """Return BLOCK elements of an array, given with the first's place, as a vector of LLVM."""
    data = builder.gep(context.make_array(array)(context, builder, values[0]).data, [values[1]])
    return builder.load(builder.bitcast(data, ir.VectorType(kind, BLOCK).as_pointer()), align=4)


def _filled(builder, value, lanes):
    """Return a vector of equal elements."""
    empty = ir.Constant(ir.VectorType(value.type, lanes), ir.Undefined)
    first = builder.insert_element(empty, value, ir.Constant(ir.IntType(32), 0))
    return builder.shuffle_vector(first, empty, ir.Constant(ir.VectorType(ir.IntType(32), lanes), [0] * lanes))


@intrinsic
def _list_above(typing_context, level, bounds, first, base, found, count):
    def generate(context, builder, signature, values):
        level, bounds, first, base, found, count = values
        byte, word, long = ir.IntType(8), ir.IntType(32), ir.IntType(64)
        row = _vector(context, builder, signature.args[1], (bounds, first), ir.FloatType())
        mask = builder.bitcast(builder.fcmp_ordered(">=", row, _filled(builder, level, BLOCK)), ir.IntType(16))
        table = cgutils.global_constant(
            builder.module, "bits_set", ir.Constant(ir.ArrayType(long, 256), [ir.Constant(long, k) for k in _BITS_SET])
        )
        places = context.make_array(signature.args[4])(context, builder, found).data
        for shift in (0, 8):
            part = builder.trunc(builder.lshr(mask, ir.Constant(mask.type, shift)), byte)
            entry = builder.load(builder.gep(table, [ir.Constant(long, 0), builder.zext(part, long)]))
            bits = builder.zext(builder.bitcast(entry, ir.VectorType(byte, 8)), ir.VectorType(word, 8))
            start = _filled(builder, builder.add(base, ir.Constant(word, shift)), 8)
            target = builder.bitcast(builder.gep(places, [count]), ir.VectorType(word, 8).as_pointer())
            builder.store(builder.add(bits, start), target, align=4)
            count = builder.add(count, builder.zext(builder.ctpop(part), long))
        return count

    return types.int64(level, bounds, types.int64, types.uint32, found, types.int64), generate


@intrinsic
def _largest(typing_context, bounds, first):
    def generate(context, builder, signature, values):
        # bounds order like their bits, taken for integers: only _NEVER is negative
        row = _vector(context, builder, signature.args[0], values, ir.IntType(32))
        kind = ir.FunctionType(ir.IntType(32), [row.type])
        reduce = cgutils.get_or_insert_function(builder.module, kind, f"llvm.vector.reduce.smax.v{BLOCK}i32")
        return builder.bitcast(builder.call(reduce, [row]), ir.FloatType())

    return types.float32(bounds, types.int64), generate


if config.DISABLE_JIT:  # nothing is compiled
    _list_above, _largest = _plain_list_above, _plain_largest


# --- random streams -----------------------------------------------------------------------------------------


@_compiled
def mix(state):
    """Return the output of SplitMix64 for a state (Steele, Lea & Flood 2014)."""
    z = (state ^ (state >> _SHIFT_30)) * _MIX_1
    z = (z ^ (z >> _SHIFT_27)) * _MIX_2
    return z ^ (z >> _SHIFT_31)


@_compiled
def uniform(state):
    """Return U in (0, 1) from the 52 upper bits of a stream's number."""
    return (np.float64(np.int64(mix(state) >> _SHIFT_12)) + 0.5) * 2.0**-52


@_compiled
def start_parcels(bases, uniforms, streams):
    """Fill uniforms (parcel, cell) and streams (parcel, cell + 2) of parcels from two 64-bit bases each, (parcel, 2).

    A stream starts at the mix of the first base and the cell's place. Of the uniforms there is one in each of as many
    equal strata, in random order (Fisher & Yates).
    """
    cells = uniforms.shape[1]
    for k in range(bases.shape[0]):
        for p in range(1, cells + 1):
            streams[k, p] = mix(bases[k, 0] + np.uint64(p) * _GOLDEN)
        row, state = uniforms[k], bases[k, 1]
        for p in range(cells):
            row[p] = p
        for p in range(cells - 1, 0, -1):
            state += _GOLDEN
            q = np.int64(uniform(state) * (p + 1))
            row[p], row[q] = row[q], row[p]
        for p in range(cells):
            state += _GOLDEN
            row[p] = (row[p] + uniform(state)) / cells


# --- sieves -------------------------------------------------------------------------------------------------


@_compiled
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


@_compiled
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


@_compiled
def _count(sizes, places, found, sieves, step, counts):
    """Add `step` to the sieve class (sieve + 1) of each of the first `found` places."""
    for k in range(found):
        counts[sieve_class(sieves, sizes[places[k]])] += step


@_compiled
def classify(sizes, slots, sieves, classes):
    """Count the cells of each sieve class in the parcels of these slots into `classes` (slot, sieve + 1)."""
    for k in range(slots.size):
        row = sizes[slots[k]]
        for m in range(sieves.size + 1):
            classes[k, m] = 0
        for p in range(1, row.size - 1):
            classes[k, sieve_class(sieves, row[p])] += 1


# --- crushing -----------------------------------------------------------------------------------------------


# Powers in plain arithmetic, which unlike calls becomes vectors (40 -> 3 ns a value) and has the same bits everywhere,
# to about 1e-13: `_split`, `_exponentiate` and `_join` make v^e = 2^(e log2 v) of values v > 0, one loop each.


@_inlined
def _split(count, bits, powers):
    """Split numbers, given by their bits, into mantissas between sqrt(1/2) and sqrt(2) and powers of 2."""
    for k in range(count):
        power = (bits[k] - np.int64(0x3FE6A09E667F3BCD)) >> np.int64(52)
        bits[k] -= power << np.int64(52)
        powers[k] = power


@_inlined
def _exponentiate(count, values, exponents, powers):
    """Raise split numbers: log2 by artanh of the mantissa, 2^r by its series up to r = 1/2."""
    for k in range(count):
        z = (values[k] - 1.0) / (values[k] + 1.0)
        y = z * z
        series = 2 / 9 + y * (2 / 11 + y * (2 / 13 + y * (2 / 15 + y * (2 / 17 + y * (2 / 19)))))
        logarithm = z * (2.0 + y * (2 / 3 + y * (2 / 5 + y * (2 / 7 + y * series))))
        exponent = (np.float64(powers[k]) + logarithm * 1.4426950408889634) * exponents[k]
        exponent = min(max(exponent, -1000.0), 100.0)
        whole = np.floor(exponent + 0.5)
        r = (exponent - whole) * 0.6931471805599453
        series = 1 / 5040 + r * (1 / 40320 + r * (1 / 362880 + r * (1 / 3628800 + r * (1 / 39916800))))
        series = 1.0 + r * (0.5 + r * (1 / 6 + r * (1 / 24 + r * (1 / 120 + r * (1 / 720 + r * series)))))
        values[k] = 1.0 + r * series
        powers[k] = (np.int64(whole) + np.int64(1023)) << np.int64(52)


@_inlined
def _join(count, values, powers):
    """Multiply mantissas by powers of 2."""
    for k in range(count):
        values[k] *= powers[k]


@_compiled
def _scale(ore):
    """Return 3 / w, by which effective size answers to strength; without size effect it is 1 / strength."""
    return ore.slope if ore.slope > 0.0 else 1.0


@_compiled
def _draw_weakness(streams, ore, weakness):
    """Set the weakness zeta^(-w/3) of each cell, P(zeta > x) = exp(-x^k), by the mix of its stream's last number."""
    for p in range(1, weakness.size - 1):
        weakness[p] = _weakness(streams[p], ore)


@_compiled
def _weakness(state, ore):
    power = (-math.log(uniform(mix(state)))) ** (-1.0 / (ore.scatter * _scale(ore)))
    return np.float32(min(max(power, 1e-30), 1e30))


@_inlined
def _unshielded(size, bound_per_size, size_floor):
    """Return the bound of a cell whose neighbourhood is new; nothing below the floor ever breaks."""
    # without size effect every size may break
    bound = np.float32(size * bound_per_size) if bound_per_size != 0.0 else np.float32(_MARGIN)
    return _NEVER if size < size_floor else bound


@_compiled
def _bound_per_size(ore):
    return _MARGIN / ore.reference_size if ore.slope > 0.0 else 0.0


@_compiled
def _close(line):
    """Copy the ends of a periodic line to the places beyond them."""
    line[0], line[line.size - 1] = line[line.size - 2], line[1]


@_compiled
def set_bounds(parcel, ore):
    """Set the bounds of a line of cells whose neighbourhoods are all new."""
    sizes, _, weakness, unshielded, bounds, block_bounds = parcel
    cells = sizes.size - 2
    bound_per_size, size_floor = _bound_per_size(ore), ore.size_floor
    unshielded[0] = unshielded[cells + 1] = _NEVER
    for p in range(1, cells + 1):
        unshielded[p] = _unshielded(np.float64(sizes[p]), bound_per_size, size_floor)
    if weakness.size:
        for p in range(1, cells + 1):
            unshielded[p] *= weakness[p]
    for p in range(bounds.size):
        bounds[p] = unshielded[p] if p <= cells else _NEVER
    for block in range(block_bounds.size):
        block_bounds[block] = _largest(bounds, block * BLOCK + 1) if block * BLOCK < cells else _NEVER


@_compiled
def workspace(cells):
    """Return the work space for lines of this many cells; lists are written and read in whole vectors."""
    most = cells + 2 * BLOCK
    return Work(
        np.empty(most, np.uint32),
        np.empty(most, np.uint32),
        np.ones(most),
        np.ones(most),
        np.ones(most),
        np.empty(most, np.uint64),
        np.empty(most, np.float32),
        np.empty(most, np.uint8),
        np.empty(most, np.uint8),
    )


@_inlined
def _list_blocks(needed, block_bounds, active):
    """List the blocks whose largest bound reaches what is needed; return their number."""
    actives = 0
    for block in range(0, block_bounds.size, BLOCK):
        actives = _list_above(needed, block_bounds, block, np.uint32(block), active, actives)
    return actives


@_inlined
def _list_candidates(needed, bounds, active, actives, places):
    """List the places in active blocks whose bounds reach what is needed; return their number."""
    candidates = 0
    for k in range(actives):
        first = active[k] * np.uint32(BLOCK) + np.uint32(1)
        candidates = _list_above(needed, bounds, np.int64(first), first, places, candidates)
    return candidates


@_inlined
def _gather(sizes, weakness, places, candidates, ore, found, totals, ratios):
    """Fill sizes found, their sums with both neighbours, and effective sizes over s_m without neighbours."""
    inverse_size = 1.0 / ore.reference_size if ore.slope > 0.0 else 0.0
    for k in range(candidates):
        p = np.uint64(places[k])
        size = np.float64(sizes[p])
        # neighbours first: their sum is the same bits in a mirrored line
        totals[k] = (np.float64(sizes[p - _1]) + np.float64(sizes[p + _1])) + size
        found[k] = size
        ratios[k] = size * inverse_size if inverse_size > 0.0 else 1.0
    if weakness.size:
        for k in range(candidates):
            ratios[k] *= np.float64(weakness[np.uint64(places[k])])


@_inlined
def _decide(count, sizes, totals, ratios, cushion, critical_ratio, bounds, breaks, unsure):
    """Decide breaks by rational bounds of the size-effect law and tighten the bounds; return whether any is unsure."""
    # an effective size that has underflowed decides nothing: then only the logarithms do
    trusted = critical_ratio > 1e-200
    surely = critical_ratio * (1.0 + 1e-9) if trusted else np.inf
    hardly = critical_ratio * (1.0 - 1e-9) if trusted else 0.0
    doubts = np.int64(0)
    for k in range(count):
        size, total, ratio = sizes[k], totals[k], ratios[k]
        # log(s / sbar) = 2 artanh(z) between low and, up to zz = 1/2, high; exp(-y) between the two cubics.
        # Two divisions: one for sbar and one for the series' rest, zz^2 / (5 - 5 zz), would cost 15 ns a cell
        z = (3.0 * size - total) / (3.0 * size + total)
        zz = z * z
        low = 2.0 * z * (1.0 + zz * (1.0 / 3.0))
        high = 2.0 * z * (1.0 + zz * (1.0 / 3.0 + zz * (0.2 + 0.4 * zz)))
        y = cushion * (low * low)
        most = ratio / (1.0 + y * (1.0 + y * (0.5 + y * (1.0 / 6.0))))
        y = cushion * (high * high)
        least = ratio * (1.0 - y * (1.0 - y * (0.5 - y * (1.0 / 6.0))))
        sure = (least if zz <= 0.5 else 0.0) >= surely
        doubt = np.uint8(sure != (most >= hardly))
        breaks[k] = sure
        unsure[k] = doubt
        doubts += np.int64(doubt)
        bounds[k] = np.float32(most * _MARGIN)
    return doubts > 0


@_compiled
def _decide_by_logarithms(candidates, sizes, totals, weakness, places, ore, log_stress, bounds, breaks, unsure):
    """Decide the breaks that are unsure."""
    for k in range(candidates):
        if unsure[k]:
            unlike = math.log(sizes[k] / (totals[k] / 3.0))
            strength = ore.cushion * unlike * unlike - ore.slope * math.log(sizes[k] / ore.reference_size)
            if weakness.size:
                strength -= _scale(ore) * math.log(weakness[places[k]])
            breaks[k] = log_stress >= strength
            bounds[k] = np.float32(math.exp(-strength / _scale(ore)) * _MARGIN)


@_inlined
def _list_breaks(candidates, found_bounds, breaks, bounds, places):
    """Store the bounds found and leave in `places` those that break; return their number."""
    # without branches: a mispredicted one costs more than the store
    found = np.int64(0)
    for k in range(candidates):
        p = places[k]
        bounds[np.uint64(p)] = found_bounds[k]
        places[found] = p
        found += breaks[k]
    return found


@_inlined
def _draw(streams, places, found, states, ratios):
    """Draw a uniform number for each cell that breaks."""
    for k in range(found):
        p = np.uint64(places[k])
        states[k] = streams[p] + _GOLDEN
        streams[p] = states[k]
    for k in range(found):
        ratios[k] = uniform(states[k])


@_compiled
def _exponents(sizes, places, found, ore, powers, exponents, work):
    """Fill the exponents 1 / gamma(s) of the parents' fragment ratios."""
    for k in range(found):
        powers[k], exponents[k] = ore.size_exponent, np.float64(sizes[places[k]]) / ore.parent_size
    _split(found, exponents.view(np.int64), work.view(np.int64))
    _exponentiate(found, exponents, powers, work.view(np.int64))
    _join(found, exponents, work)
    for k in range(found):
        exponents[k] = min(max(ore.inverse_exponent / exponents[k], 1.0 / HELD[1]), 1.0 / HELD[0])


@_inlined
def _fill(exponents, count, inverse_exponent):
    for k in range(count):
        exponents[k] = inverse_exponent


@_inlined
def _settle_powers(sizes, streams, places, found, ratios, exponents):
    """Take the library's power, which the bits are defined by, where ours may give another float32: next to a half."""
    for k in range(found):
        p = np.uint64(places[k])
        if np.float32(sizes[p] * (ratios[k] * (1.0 - 1e-12))) != np.float32(sizes[p] * (ratios[k] * (1.0 + 1e-12))):
            ratios[k] = uniform(streams[p]) ** exponents[k]


@_inlined
def _break(sizes, unshielded, places, found, ore, ratios):
    """Replace each cell that breaks by its fragment."""
    bound_per_size, size_floor = _bound_per_size(ore), ore.size_floor
    for k in range(found):
        p = np.uint64(places[k])
        size = np.float32(max(sizes[p] * ratios[k], SMALLEST))
        sizes[p] = size
        unshielded[p] = _unshielded(np.float64(size), bound_per_size, size_floor)
    _close(sizes)


@_compiled
def _draw_strength(streams, weakness, unshielded, places, found, ore):
    """Draw the strength of each fragment."""
    for k in range(found):
        p = np.uint64(places[k])
        weakness[p] = _weakness(streams[p], ore)
        unshielded[p] *= weakness[p]


@_inlined
def _renew(unshielded, bounds, places, found):
    """Set anew the bounds of the cells that broke and of their neighbours but across the ends of the line."""
    for k in range(found):
        p = np.uint64(places[k])
        bounds[p - _1], bounds[p], bounds[p + _1] = unshielded[p - _1], unshielded[p], unshielded[p + _1]


@_inlined
def _renew_ends(unshielded, bounds, first, last):
    """Set anew the bound of each end of the line beside which a cell broke, by the first and last place that did."""
    cells = unshielded.size - 2
    right, left = bounds[cells], bounds[1]
    bounds[cells] = unshielded[cells] if first == 1 else right
    bounds[1] = unshielded[1] if last == cells else left


@_inlined
def _renew_blocks(bounds, block_bounds, active, actives):
    """Take the largest bounds of the active blocks anew."""
    for k in range(actives):
        block_bounds[active[k]] = _largest(bounds, np.int64(active[k]) * BLOCK + 1)


@_inlined
def _renew_seams(bounds, block_bounds, active, actives, cells):
    """Raise the largest bounds of the blocks beside the active ones, where a seam was crossed."""
    last = (cells - 1) // BLOCK
    for k in range(actives):
        block = np.int64(active[k])
        before, after = block - 1 if block > 0 else last, block + 1 if block < last else 0
        end = (before + 1) * BLOCK if before < last else cells
        block_bounds[before] = max(block_bounds[before], bounds[end])
        block_bounds[after] = max(block_bounds[after], bounds[after * BLOCK + 1])


@_compiled
def crush(parcel, path, ore, work, record):
    """Crush one line of cells at each point of a path; return its number of breaks.

    Every break of a point is decided on the sizes before it, and a cell breaks once at a point. A break draws one
    number of the cell's own stream. One call for all points: handing over the tuples costs as much as a step.
    """
    sizes, streams, weakness, unshielded, bounds, block_bounds = parcel
    active, places, chosen, totals, ratios, states, tight, breaking, unsure = work
    log_stress, critical_ratio = path
    sieves, snapshots, classes = record
    bits, ratio_bits = chosen.view(np.int64), ratios.view(np.int64)
    cushion = ore.cushion / _scale(ore)
    powers = ore.fragments == POWER_LAW and (ore.inverse_exponent != 1.0 or ore.size_exponent != 0.0)
    counts = np.zeros(sieves.size + 1, np.int64)
    if sieves.size:
        for p in range(1, sizes.size - 1):
            counts[sieve_class(sieves, sizes[p])] += 1
    breaks = 0
    for j in range(log_stress.size):
        critical = critical_ratio[j]
        if critical < np.inf:
            needed = np.float32(min(critical, 3e38))  # float32 ends there, beyond every effective size
            actives = _list_blocks(needed, block_bounds, active)
            count = _list_candidates(needed, bounds, active, actives, places)
            _gather(sizes, weakness, places, count, ore, chosen, totals, ratios)
            if ore.strength == SIZE_EFFECT:
                # in whole vectors; what is decided beyond the last candidate is not read
                whole = (count + BLOCK - 1) // BLOCK * BLOCK
                if _decide(whole, chosen, totals, ratios, cushion, critical, tight, breaking, unsure):
                    _decide_by_logarithms(
                        count, chosen, totals, weakness, places, ore, log_stress[j], tight, breaking, unsure
                    )
            found = _list_breaks(count, tight, breaking, bounds, places)
            if sieves.size:
                _count(sizes, places, found, sieves, -1, counts)
            _draw(streams, places, found, states, chosen)
            if powers:
                if ore.size_exponent != 0.0:
                    _exponents(sizes, places, found, ore, ratios, totals, states.view(np.float64))
                else:
                    _fill(totals, found + 7, ore.inverse_exponent)
                whole = (found + 7) // 8 * 8
                _split(whole, bits, ratio_bits)
                _exponentiate(whole, chosen, totals, ratio_bits)
                _join(whole, chosen, ratios)
                _settle_powers(sizes, streams, places, found, chosen, totals)
            _break(sizes, unshielded, places, found, ore, chosen)
            if weakness.size:
                _draw_strength(streams, weakness, unshielded, places, found, ore)
            if sieves.size:
                _count(sizes, places, found, sieves, 1, counts)
            _renew(unshielded, bounds, places, found)
            if found:
                _renew_ends(unshielded, bounds, places[0], places[found - 1])
            _renew_blocks(bounds, block_bounds, active, actives)
            _renew_seams(bounds, block_bounds, active, actives, sizes.size - 2)
            breaks += found
        if snapshots.size:
            for p in range(1, sizes.size - 1):
                snapshots[j, p - 1] = sizes[p]
        if classes.size:
            for m in range(counts.size):
                classes[j, m] = counts[m]
    return breaks


@_compiled
def march(sizes, streams, lines, path, ore, record, breaks):
    """Crush several parcels, each along its streamline, in one call: a thread that waits for its turn between short
    calls would lose what a second core gains (2 threads: 1.0 -> 1.7 times one).

    Parameters
    ----------
    sizes, streams : float32, uint64 (parcel, cell + 2)
        The parcels on entry; on return as they leave.
    lines : int64 (parcel,)
        Streamline of each parcel.
    path : Path
        (streamline, point).
    ore : Ore
        Constants of its laws.
    record : Record
        Filled at every point, (parcel, point, ...).
    breaks : int64 (parcel,)
        Set to the number of breaks.
    """
    cells = sizes.shape[1] - 2
    blocks = (cells + BLOCK - 1) // BLOCK
    weakness = np.empty(cells + 2 if ore.scatter < np.inf else 0, np.float32)
    unshielded, bounds = np.empty(cells + 2, np.float32), np.empty(blocks * BLOCK + 2, np.float32)
    block_bounds = np.empty((blocks + BLOCK - 1) // BLOCK * BLOCK, np.float32)
    work = workspace(cells)
    no_snapshots, no_classes = np.empty((0, 0), np.float32), np.empty((0, 0), np.int64)
    for k in range(lines.size):
        parcel = Parcels(sizes[k], streams[k], weakness, unshielded, bounds, block_bounds)
        _draw_weakness(parcel.streams, ore, weakness)
        _close(parcel.sizes)
        set_bounds(parcel, ore)
        own = Path(path.log_stress[lines[k]], path.critical_ratio[lines[k]])
        snapshots = record.snapshots[k] if record.snapshots.size else no_snapshots
        classes = record.classes[k] if record.classes.size else no_classes
        breaks[k] = crush(parcel, own, ore, work, Record(record.sieves, snapshots, classes))


# --- the lattice --------------------------------------------------------------------------------------------


@_compiled
def crush_lattice(parcels, bounds_outdated, breaks, slots, path, ore):
    """Crush every parcel of the lattice once, each under the stress of the point it is at.

    Parameters
    ----------
    parcels : Parcels
        (slot, ...).
    bounds_outdated : bool (slot,)
        Whether a parcel's bounds are to be set anew before they are used.
    breaks : int64 (slot,)
        Breaks of each parcel, added to.
    slots : int64 (number of points,)
        Slot of the parcel at each point, streamline by streamline.
    path : Path
        (number of points,).
    ore : Ore
        Constants of its laws.
    """
    work = workspace(parcels.sizes.shape[1] - 2)
    record = Record(np.empty(0), np.empty((0, 0), np.float32), np.empty((0, 0), np.int64))
    for point in range(slots.size):
        if path.critical_ratio[point] == np.inf:
            continue
        slot = slots[point]
        parcel = Parcels(
            parcels.sizes[slot],
            parcels.streams[slot],
            parcels.weakness[slot],
            parcels.unshielded[slot],
            parcels.bounds[slot],
            parcels.block_bounds[slot],
        )
        if bounds_outdated[slot]:
            _draw_weakness(parcel.streams, ore, parcel.weakness)
            _close(parcel.sizes)
            set_bounds(parcel, ore)
            bounds_outdated[slot] = False
        here = Path(path.log_stress[point : point + 1], path.critical_ratio[point : point + 1])
        breaks[slot] += crush(parcel, here, ore, work, record)


@_compiled
def _largest_bits(sizes):
    """Return the bits of the largest of a line of sizes; positive floats order like their bits."""
    bits = sizes.view(np.int32)  # a maximum of integers is vectorised, one of floats is not
    highest = np.int32(0)
    for p in range(1, bits.size - 1):
        highest = max(highest, bits[p])
    return highest


@_compiled
def _total(sizes):
    """Return the sum of a line of sizes; eight partial sums are vectorised where one is not (1.0 -> 0.2 ns a cell)."""
    a = b = c = d = e = f = g = h = 0.0
    cells = sizes.size - 2
    whole = cells // 8
    for k in range(whole):
        p = 8 * k + 1
        a += np.float64(sizes[p])
        b += np.float64(sizes[p + 1])
        c += np.float64(sizes[p + 2])
        d += np.float64(sizes[p + 3])
        e += np.float64(sizes[p + 4])
        f += np.float64(sizes[p + 5])
        g += np.float64(sizes[p + 6])
        h += np.float64(sizes[p + 7])
    for p in range(8 * whole + 1, cells + 1):
        a += np.float64(sizes[p])
    return ((a + b) + (c + d)) + ((e + f) + (g + h))


@_compiled
def measure(sizes, slots, means, largest):
    """Fill the mean size at every point and the largest size of every slot, m."""
    for point in range(slots.size):
        slot = slots[point]
        means[point] = _total(sizes[slot]) / (sizes.shape[1] - 2)
        largest.view(np.int32)[slot] = _largest_bits(sizes[slot])


@_compiled
def _swap_densely(below, above, streams_below, streams_above, state, rise, mixing, mean_below, mean_above):
    """Decide every cell of an edge in turn, without branches; return the number of swaps."""
    swaps = 0
    for p in range(1, below.size - 1):
        a, b = below[p], above[p]
        chance = mixing + rise * (max(a - mean_below, 0.0) + max(mean_above - b, 0.0))
        number = mix(state + np.uint64(p) * _GOLDEN)
        hit = np.float64(np.int64(number >> _SHIFT_12)) < chance * 2.0**52
        below[p], above[p] = b if hit else a, a if hit else b
        s, t = streams_below[p], streams_above[p]
        streams_below[p], streams_above[p] = t if hit else s, s if hit else t
        swaps += hit
    return swaps


@_compiled
def _skipped(number, per_cell, cells):
    """Return how many cells a geometric skip passes over, from a uniform number and 1 / log(1 - P)."""
    skip = math.log(number) * per_cell
    return np.int64(skip) if skip < cells else np.int64(cells)


@_compiled
def swap(parcels, bounds_outdated, largest, slots, edges, means, number, most_substeps, key):
    """Pass once over the edges and swap cells of equal index across each; return the number of swaps.

    A cell of size a below and one of size b above an edge swap with probability
    mixing + rise [(a - mean below)+ + (mean above - b)+]. Where swaps are rare, candidates are drawn by geometric
    skipping with the largest probability of the edge and then thinned, so that the cost follows the swaps, not the
    cells; where they are frequent, every cell is decided in turn.

    Parameters
    ----------
    parcels, bounds_outdated : (slot, ...)
        As in `crush_lattice`; cells move with their streams.
    largest : float32 (slot,)
        Bound of each parcel's sizes, m; kept up to date.
    slots : int64 (number of points,)
        Slot of the parcel at each point.
    edges : Edges
        Edges and their probabilities.
    means : float64 (number of points,)
        Mean size of each parcel, m, held during the time step.
    number, most_substeps, key : int, int, uint64
        Number of the substep, the number of all, and its key; edge e draws from a stream of its own.
    """
    sizes, streams = parcels.sizes, parcels.streams
    cells = sizes.shape[1] - 2
    swaps = 0
    for e in range(edges.pairs.shape[0]):
        substeps, rise, mixing = edges.substeps[e], edges.rise[e], edges.mixing[e]
        if (number + 1) * substeps // most_substeps == number * substeps // most_substeps:
            continue
        lower, upper = slots[edges.pairs[e, 0]], slots[edges.pairs[e, 1]]
        mean_below, mean_above = means[edges.pairs[e, 0]], means[edges.pairs[e, 1]]
        most = mixing + rise * (max(largest[lower] - mean_below, 0.0) + mean_above)
        if most <= 0.0:
            continue
        state = mix(key + np.uint64(e + 1) * _GOLDEN)
        if most > DENSE:
            swaps += _swap_densely(
                sizes[lower], sizes[upper], streams[lower], streams[upper], state, rise, mixing, mean_below, mean_above
            )
            bounds_outdated[lower] = bounds_outdated[upper] = True
            largest[lower] = largest[upper] = max(largest[lower], largest[upper])
            continue
        first = uniform(state)
        if first < 1.0 - cells * most:  # then the first candidate lies past the last cell: no logarithm needed
            continue
        per_cell = 1.0 / math.log1p(-most)
        p = 1 + _skipped(first, per_cell, cells)
        while p <= cells:
            below, above = sizes[lower, p], sizes[upper, p]
            chance = mixing + rise * (max(below - mean_below, 0.0) + max(mean_above - above, 0.0))
            state += _GOLDEN
            if uniform(state) * most < chance:
                sizes[lower, p], sizes[upper, p] = above, below
                streams[lower, p], streams[upper, p] = streams[upper, p], streams[lower, p]
                largest[lower], largest[upper] = max(largest[lower], above), max(largest[upper], below)
                bounds_outdated[lower] = bounds_outdated[upper] = True
                swaps += 1
            state += _GOLDEN
            p += 1 + _skipped(uniform(state), per_cell, cells)
    return swaps


# --- the closed form ----------------------------------------------------------------------------------------


@_compiled
def cascade(ever, leaving, stay):
    """Carry the fragments of every size class down to the finer ones, from the coarsest on.

    Parameters
    ----------
    ever : float64 (class, line)
        Mass of the feed in each class, of equal widths in log size, finest first; on return all that ever was there.
    leaving : float64 (class, line)
        Part of the mass ever in a class that breaks and leaves it.
    stay : float64 (class,)
        Probability that a fragment that has left a class passes the next finer one as well.
    """
    gone = np.empty(ever.shape[1])
    for i in range(ever.shape[0] - 1, 0, -1):
        for line in range(gone.size):
            gone[line] = ever[i, line] * leaving[i, line]
        passing = 1.0
        for j in range(i - 1, -1, -1):
            share = passing * (1.0 - stay[i]) if j > 0 else passing
            for line in range(gone.size):
                ever[j, line] += share * gone[line]
            passing *= stay[i]
