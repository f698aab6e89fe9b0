"""Every compiled loop of the grains: crushing of lines of cells (paper eqs. 1 and 2), swaps between them (eq. 3).

The kernels take arrays, scalars and named tuples of these. Sizes are stored as float32; whatever decides a break is
float64. A line of cells is periodic: its places 1 to M hold the cells, 0 and M + 1 copies of the far ends.

How a break is decided. A cell of size s with neighbourhood mean sbar breaks when
log(sigma_a / sigma_m) >= -k log(s / s_m) + log(s / sbar)^2 / (2 n^2), k = 3 / w, or, the same, when its effective size
over s_m, s / s_m exp(-log(s / sbar)^2 / (2 n^2 k)), is at least the critical size ratio (sigma_a / sigma_m)^(-1/k).
Each cell keeps an upper bound of its effective size: s / s_m while its neighbourhood is new (cushioning only
strengthens), and a tight one once it has been seen to hold. Blocks of cells keep the largest bound within, so a step
passes over blocks that cannot break. A polynomial in ((s - sbar) / (s + sbar))^2 decides most of the rest, logarithms
what it leaves open. The bounds only ever skip tests whose answer is known: the sizes are those of the plain loop, bit
for bit.

A step goes through the cells in short loops, each over a whole list, so that compilers make vectors of them.
"""

import math
from typing import NamedTuple

import numpy as np
from llvmlite import ir
from numba import config, types
from numba.core import cgutils
from numba.extending import intrinsic

from hpgr import compiler
from hpgr.laws.fragments import HELD, POWER_LAW
from hpgr.laws.strength import SIZE_EFFECT

# Handing the arrays of a step over costs as much as a short loop. A function costs 15 ms to compile, a `min` or `max`
# of new types 40
_compiled, _inner, _inlined = compiler.compiled(), compiler.inner(), compiler.inner(forceinline=True)

BLOCK = 16  # cells; as many as the vectors below
DENSE = 1 / 64  # swap probability of an edge from which deciding every cell is cheaper than skipping
SMALLEST = 1e-30  # m; a fragment is never 0 nor denormal in float32, and counted as below the size floor

_MARGIN = 1.0 + 1e-6  # covers the rounding of an effective size to float32, 6e-8, and of its exponential
_LEAST_EXPONENT, _MOST_EXPONENT = 1.0 / HELD[1], 1.0 / HELD[0]  # 1 / gamma(s)
_NEVER = np.float32(-1.0)  # bound of a cell that may not break, below every critical size ratio
_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX_2 = np.uint64(0x94D049BB133111EB)
_SHIFT_30, _SHIFT_27, _SHIFT_31 = np.uint64(30), np.uint64(27), np.uint64(31)
_SHIFT_12 = np.uint64(12)
_0F, _1F, _3F = np.float32(0.0), np.float32(1.0), np.float32(3.0)
_LOST, _MORE = np.float32(1e-37), np.float32(1.0 + 3e-6)
_TO_BITS = 1.5 * 2.0**52 + 1023.0
_1 = np.uint64(1)  # places are unsigned, or every one of them would be tested for being negative


class Ore(NamedTuple):
    """The constants of a law of strength, then those of a law of fragments."""

    strength: int  # tag
    slope: float  # 3 / w
    scale: float  # 3 / w, by which effective size answers to strength; without size effect 1
    cushion: float  # 1 / (2 n^2)
    cushioned: tuple[np.float32, ...]  # polynomial of what cushioning leaves of the effective size, its error, 1 / m
    reference_size: float  # m
    inverse_size: float  # 1 / reference_size; without size effect 0
    scatter: float  # k
    fragments: int  # tag
    inverse_exponent: float | None  # 1 / gamma; None where fragments are uniform
    size_exponent: float  # nu
    parent_size: float  # s_r, m
    size_floor: float  # m


class Parcels(NamedTuple):
    """Lines of cells, (slot, ...)."""

    sizes: np.ndarray  # float32 (slot, cell + 2), m
    streams: np.ndarray  # uint64 (slot, cell + 2), state of the random stream of each place
    weakness: np.ndarray | None  # float32 (slot, cell + 2), by which a grain's own strength multiplies its effective
    # size; None where strengths do not scatter
    bounds: np.ndarray  # float32 (slot, block x BLOCK + 2), upper bounds of effective size over s_m
    block_bounds: np.ndarray  # float32 (slot, block, to the next BLOCK), the largest in each block
    bounds_outdated: np.ndarray  # bool (slot,), whether bounds are to be set anew before they are used
    breaks: np.ndarray  # int64 (slot,), breaks so far


class Shares(NamedTuple):
    """The cells of all parcels in shares of their places, as they swap; a share is swapped by one thread.

    Each share has its array: threads that write to the same rows wait for each other's cache lines (1.4 times as long).
    """

    sizes: np.ndarray  # float32 (share, slot, place), m
    weakness: np.ndarray | None  # float32 (share, slot, place), as of parcels
    totals: np.ndarray  # int64 (share, slot), sum of the sizes, each in whole parts
    swapped: np.ndarray  # bool (share, slot), whether cells have swapped since `gather`


class Path(NamedTuple):
    """What loads the parcels, (line, point)."""

    log_stress: np.ndarray  # log(sigma_a / sigma_m)
    critical_ratio: np.ndarray  # least effective size over s_m that breaks


class Passage(NamedTuple):
    """Where parcels are crushed, int64 (parcel,): on which streamline, from which point to before which."""

    slots: np.ndarray
    lines: np.ndarray
    first: np.ndarray
    last: np.ndarray


class Record(NamedTuple):
    """What is kept of every point of a passage; None keeps nothing."""

    sieves: np.ndarray | None = None  # float64 (sieve,), m
    counts: np.ndarray | None = None  # int64 (parcel, sieve + 1), of the point each is at
    classes: np.ndarray | None = None  # int64 (parcel, point, sieve + 1), cells of each sieve class
    snapshots: np.ndarray | None = None  # float32 (parcel, point, cell), sizes, m


class Work(NamedTuple):
    """Work space of a step: lists of blocks and of candidates for a break, and what is known of the latter."""

    active: np.ndarray  # uint32 (block,)
    places: np.ndarray  # uint32 (candidate,), as all that follows; then those that break
    before: np.ndarray  # float32, size of the neighbour before, m; then tight bounds
    own: np.ndarray  # float32, size, m
    after: np.ndarray  # float32, size of the neighbour after, m
    weak: np.ndarray  # float32, weakness
    verdicts: np.ndarray  # uint8, 1: breaks, 2: unsure
    states: np.ndarray  # uint64, of the streams of those that break
    ratios: np.ndarray  # float64, of fragments
    exponents: np.ndarray  # float64


class Edges(NamedTuple):
    """Edges between material points, (edge, ...), and in which order they swap in a time step."""

    pairs: np.ndarray  # int64 (edge, 2), points below and above
    rise: np.ndarray  # float64, probability of a swap by segregation in an exchange substep, 1/m
    mixing: np.ndarray  # float64, by mixing
    ceiling: np.ndarray  # float64, what holds segregation, m^-1/2; 0: nothing
    turns: np.ndarray  # int64 (turn,), edges of one substep after the other


def make_parcels(count: int, cells: int, scattered: bool) -> Parcels:
    """Return parcels without cells."""
    blocks = -(-cells // BLOCK)
    return Parcels(
        np.zeros((count, cells + 2), np.float32),
        np.zeros((count, cells + 2), np.uint64),
        np.empty((count, cells + 2), np.float32) if scattered else None,
        np.empty((count, blocks * BLOCK + 2), np.float32),
        np.empty((count, -(-blocks // BLOCK) * BLOCK), np.float32),
        np.ones(count, bool),
        np.zeros(count, np.int64),
    )


def make_shares(count: int, cells: int, share: int, scattered: bool) -> Shares:
    """Return shares without cells, of at most so many places each."""
    shape = -(-cells // share), count, min(share, cells)
    sizes, weakness = np.empty(shape, np.float32), np.empty(shape, np.float32) if scattered else None
    return Shares(sizes, weakness, np.zeros(shape[:2], np.int64), np.zeros(shape[:2], bool))


def make_work(cells: int) -> Work:
    """Return work space for lines of this many cells; lists are written and read in whole vectors."""
    most = cells + 2 * BLOCK
    lists, known = np.empty((2, most), np.uint32), np.ones((4, most), np.float32)
    return Work(*lists, *known, np.empty(most, np.uint8), np.zeros(most, np.uint64), *np.ones((2, most)))


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


@_inner
def uniform(state):
    """Return U in (0, 1) from the 52 upper bits of a stream's number."""
    return (np.float64(np.int64(mix(state) >> _SHIFT_12)) + 0.5) * 2.0**-52


@_inner
def _weakness(state, ore):
    """Return zeta^(-w/3), P(zeta > x) = exp(-x^k), by the number after the one that a stream is at."""
    power = (-math.log(uniform(mix(state)))) ** (-1.0 / (ore.scatter * ore.scale))
    power = power if power > 1e-30 else 1e-30
    return np.float32(power if power < 1e30 else 1e30)


@_compiled
def start_parcels(bases, ore, slots, uniforms, streams, weakness):
    """Fill uniforms (parcel, cell), and slots of streams and weakness, from two 64-bit bases each, (parcel, 2).

    A stream starts at the mix of the first base and the cell's place. Of the uniforms there is one in each of as many
    equal strata, in random order (Fisher & Yates).
    """
    cells = uniforms.shape[1]
    for k in range(slots.size):
        slot = slots[k]
        for p in range(cells):
            uniforms[k, p] = p
            streams[slot, p + 1] = mix(bases[k, 0] + np.uint64(p + 1) * _GOLDEN)
            if weakness is not None:
                weakness[slot, p + 1] = _weakness(streams[slot, p + 1], ore)
        state = bases[k, 1]
        for p in range(cells - 1, 0, -1):
            state += _GOLDEN
            q = np.int64(uniform(state) * (p + 1))
            uniforms[k, p], uniforms[k, q] = uniforms[k, q], uniforms[k, p]
        for p in range(cells):
            state += _GOLDEN
            uniforms[k, p] = (uniforms[k, p] + uniform(state)) / cells


# --- sieves -------------------------------------------------------------------------------------------------


@compiler.deferred()
def passing_counts(rows, sizes, counts):
    """Fill counts (row, size) with the cells of each sorted row that are no larger than sizes (size, row or 1).

    All sizes halve their rows in step, without branches: 7 ns a size, one after the other 44.
    """
    for k in range(rows.shape[0]):
        row, own, left = rows[k], k if sizes.shape[1] > 1 else 0, rows.shape[1]
        for m in range(sizes.shape[0]):
            counts[k, m] = 0
        while left > 0:
            half = (left + 1) >> 1
            for m in range(sizes.shape[0]):
                low = counts[k, m]
                if row[np.uint64(low + half - 1)] <= sizes[m, own]:
                    low += half
                counts[k, m] = low
            left -= half


@_inner
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


@_inner
def _count(sizes, places, found, sieves, k, step, counts):
    """Add `step` to the sieve class of parcel k, counts (parcel, sieve + 1), of each of the first `found` places."""
    if sieves is not None:
        for n in range(found):
            counts[k, sieve_class(sieves, sizes[places[n]])] += step


@_compiled
def classify(sizes, slot, sieves, k, counts):
    """Count the cells of each sieve class in the parcel of a slot into `counts` (parcel, sieve + 1) of parcel k."""
    if sieves is not None:
        for m in range(counts.shape[1]):
            counts[k, m] = 0
        for p in range(1, sizes.shape[1] - 1):
            counts[k, sieve_class(sieves, sizes[slot, p])] += 1


# --- crushing -----------------------------------------------------------------------------------------------


@_inlined
def _power(value, exponent):
    """Return value^exponent, v^e = 2^(e log2 v), of a value in 0 to 1 and an exponent > 0, to 6e-11.

    In plain arithmetic, which unlike calls becomes vectors (10 -> 2 ns a value); series in pairs of terms, for a step
    raises few numbers and would wait for a sum of one term after the other.
    """
    bits = np.float64(value).view(np.int64)
    shift = (bits - np.int64(0x3FE6A09E667F3BCD)) >> np.int64(52)  # mantissa between sqrt(1/2) and sqrt(2), power of 2
    mantissa = np.int64(bits - (shift << np.int64(52))).view(np.float64)
    z = (mantissa - 1.0) / (mantissa + 1.0)
    y = z * z
    y2 = y * y
    first, second = 2.0 + y * (2 / 3) + y2 * (2 / 5 + y * (2 / 7)), 2 / 9 + y * (2 / 11) + y2 * (2 / 13 + y * (2 / 15))
    wanted = (np.float64(shift) + z * (first + y2 * y2 * second) * 1.4426950408889634) * exponent
    power = wanted if wanted > -1000.0 else -1000.0
    near = power + _TO_BITS  # whose lowest bits are the whole power of 2, as an exponent has it
    r = (power - (near - _TO_BITS)) * 0.34657359027997264
    r2 = r * r
    first, second = 1.0 + r + r2 * (1 / 2 + r * (1 / 6)), 1 / 24 + r * (1 / 120) + r2 * (1 / 720 + r * (1 / 5040))
    root = first + r2 * r2 * second
    return root * root * np.int64(np.float64(near).view(np.int64) << np.int64(52)).view(np.float64)


@_inlined
def _unshielded(sizes, weakness, slot, p, ore):
    """Return the bound of a cell whose neighbourhood is new.

    The constants are float32: what of them is rounded, the margin covers.
    """
    # without size effect every size may break
    bound = sizes[p] * np.float32(ore.inverse_size * _MARGIN) + np.float32(0.0 if ore.inverse_size > 0.0 else _MARGIN)
    if weakness is not None:
        bound *= weakness[slot, p]
    return bound


@_inner
def _set_bounds(sizes, weakness, slot, bounds, block_bounds, ore):
    """Set the bounds of a line of cells whose neighbourhoods are all new."""
    cells = sizes.size - 2
    sizes[0], sizes[cells + 1] = sizes[cells], sizes[1]
    for p in range(bounds.size):
        bounds[p] = _unshielded(sizes, weakness, slot, np.uint64(p), ore) if 1 <= p <= cells else _NEVER
    for block in range(block_bounds.size):
        block_bounds[block] = _largest(bounds, block * BLOCK + 1) if block * BLOCK < cells else _NEVER


@_inlined
def _list_blocks(needed, block_bounds, active):
    """List the blocks whose largest bound reaches what is needed; return their number."""
    actives = 0
    for block in range(0, block_bounds.size, BLOCK):
        actives = _list_above(needed, block_bounds, block, np.uint32(block), active, actives)
    return actives


@_inlined  # one function of both lists is 4 % of a march slower
def _list_candidates(needed, bounds, active, actives, places):
    """List the places in active blocks whose bounds reach what is needed; return their number."""
    candidates = 0
    for k in range(actives):
        first = active[k] * np.uint32(BLOCK) + np.uint32(1)
        candidates = _list_above(needed, bounds, np.int64(first), first, places, candidates)
    return candidates


@_inlined
def _gather(sizes, weakness, slot, places, candidates, before, own, after, weak):
    """Fill the sizes of candidates and of both their neighbours, and how weak they are."""
    for k in range(candidates):
        p = places[k]
        before[k], own[k], after[k] = sizes[p - _1], sizes[p], sizes[p + _1]
    if weakness is not None:
        for k in range(candidates):
            weak[k] = weakness[slot, places[k]]
    for k in range(BLOCK):  # what a whole vector has beyond the last raises no doubts
        own[candidates + k] = np.float32(SMALLEST)


@_inlined
def _decide(count, before, own, after, weakness, weak, ore, critical_ratio, verdicts):
    """Decide breaks by the size-effect law; return whether any is unsure.

    Verdicts are 1 of a cell that breaks and 2 of one that is unsure; its tight bound takes the place of the neighbour
    before: loops test their arrays for overlap before they run, and two arrays more cost a march of 1,600 points 15 %.

    In float32, whose vectors are twice as long and divide four times as fast; what is compared has room for its
    rounding, 1e-6. Of 1.9 breaks a cell (gamma 0.35, 1,600 points) 0.0013 are left to logarithms.
    """
    per_size, flat = np.float32(ore.inverse_size), _0F if ore.inverse_size > 0.0 else _1F
    # what may leave the range of float32 decides nothing: then only the logarithms do
    trusted = 1e-25 < critical_ratio < 1e25
    surely = np.float32(critical_ratio * (1.0 + 3e-6) if trusted else np.inf)
    hardly = np.float32(critical_ratio * (1.0 - 3e-6) if trusted else 0.0)
    floor = np.float32(ore.size_floor)  # nothing below ever breaks; to ask at every new bound would take 4 % longer
    c0, c1, c2, c3, c4, c5, c6, wrong, per_square = ore.cushioned
    doubts = np.int32(0)
    for k in range(count):
        size = own[k]
        ratio = size * per_size + flat
        if weakness is not None:
            ratio *= weak[k]
        total = (before[k] + after[k]) + size
        z = (_3F * size - total) / (_3F * size + total)
        part = z * z * per_square
        y = part if part < _1F else _1F
        y2 = y * y
        left = (c0 + y * c1) + y2 * ((c2 + y * c3) + y2 * ((c4 + y * c5) + y2 * c6))
        most = ratio * (left + wrong)
        sure = (ratio * (left - wrong) if part < _1F else _0F) >= surely
        doubt = (sure != (most >= hardly)) & (size >= floor)
        verdicts[k] = np.uint8(sure & (size >= floor)) + np.uint8(2) * np.uint8(doubt)
        doubts = np.int32(doubts + np.int32(doubt))
        before[k] = most * _MORE + _LOST if size >= floor else _NEVER
    return doubts > 0


@_inner
def _decide_by_logarithms(count, sizes, weakness, slot, places, ore, log_stress, bounds, verdicts):
    """Decide the breaks that are unsure."""
    for k in range(count):
        if verdicts[k] > 1:
            p = places[k]
            size = np.float64(sizes[p])
            # neighbours first: their sum is the same bits in a mirrored line
            mean = ((np.float64(sizes[p - _1]) + np.float64(sizes[p + _1])) + size) / 3.0
            unlike = math.log(size / mean)
            strength = ore.cushion * unlike * unlike - ore.slope * math.log(size / ore.reference_size)
            if weakness is not None:
                strength -= ore.scale * math.log(np.float64(weakness[slot, p]))
            verdicts[k] = log_stress >= strength
            bounds[k] = np.float32(math.exp(-strength / ore.scale) * _MARGIN)


@_inlined
def _list_breaks(candidates, found_bounds, verdicts, bounds, places):
    """Store the bounds found and leave in `places` those that break; return their number."""
    # without branches: a mispredicted one costs more than the store
    found = np.int64(0)
    for k in range(candidates):
        p = places[k]
        bounds[p] = found_bounds[k]
        places[found] = p
        found += verdicts[k]
    return found


@_inlined
def _draw(sizes, streams, places, found, whole, own, states, ratios):
    """Gather sizes and draw uniform numbers of the cells that break; what is beyond, in whole vectors, is lost."""
    for k in range(found):
        p = places[k]
        own[k], states[k] = sizes[p], streams[p] + _GOLDEN
        streams[p] = states[k]
    for k in range(whole):
        ratios[k] = uniform(states[k])


@_inlined
def _exponent_of(exponent, size, ore):
    """Return the exponent 1 / gamma(s) of the fragment ratios of a parent of size s, m."""
    power = (np.float64(size) / ore.parent_size) ** ore.size_exponent
    wanted = exponent / power if exponent / power > _LEAST_EXPONENT else _LEAST_EXPONENT
    return wanted if wanted < _MOST_EXPONENT else _MOST_EXPONENT


@_inner
def _fill(exponents, exponent):
    """Fill the exponents of fragment ratios, if there are any, where they do not depend on the parent."""
    if exponent is not None:
        for k in range(exponents.size):
            exponents[k] = exponent


@_inlined
def _raise_ratios(exponent, own, streams, places, found, whole, ore, ratios, exponents):
    """Raise the fragment ratios to the exponents of their parents, where there are any.

    The library's power, which the bits are defined by, is taken where ours may give another float32: next to a half.
    """
    if exponent is not None:
        doubts = np.int64(0)
        if ore.size_exponent != 0.0:
            for k in range(found):
                exponents[k] = _exponent_of(exponent, own[k], ore)
        for k in range(whole):
            ratio = _power(ratios[k], exponents[k])
            size = own[k] * ratio
            doubt = np.float32(size * (1.0 - 1e-10)) != np.float32(size * (1.0 + 1e-10))
            ratios[k] = -ratio if doubt else ratio
            doubts += doubt
        for k in range(found if doubts else 0):
            if ratios[k] < 0.0:
                ratios[k] = uniform(streams[places[k]]) ** exponents[k]


@_inlined
def _break(sizes, weakness, slot, bounds, places, found, ore, own, ratios):
    """Replace each cell that breaks by its fragment; set anew its bound and its neighbours', around the ends too."""
    cells = sizes.size - 2
    for k in range(found):
        p, size = np.uint64(places[k]), own[k] * ratios[k]  # one kind of place to compile `_unshielded` for
        sizes[p] = np.float32(size if size > SMALLEST else SMALLEST)
        bounds[p - _1] = _unshielded(sizes, weakness, slot, p - _1, ore)
        bounds[p] = _unshielded(sizes, weakness, slot, p, ore)
        bounds[p + _1] = _unshielded(sizes, weakness, slot, p + _1, ore)
    sizes[0], sizes[cells + 1] = sizes[cells], sizes[1]
    bounds[0] = bounds[cells + 1] = _NEVER
    if found and places[0] == 1:
        bounds[cells] = _unshielded(sizes, weakness, slot, np.uint64(cells), ore)
    if found and places[found - 1] == cells:
        bounds[1] = _unshielded(sizes, weakness, slot, _1, ore)


@_inner
def _draw_strength(streams, weakness, slot, places, found, ore):
    """Draw the strength of each fragment."""
    if weakness is not None:
        for k in range(found):
            p = places[k]
            weakness[slot, p] = _weakness(streams[p], ore)


@_inner
def _keep(sizes, counts, k, j, snapshots, classes):
    """Keep the sizes and the counts of sieve classes of parcel k at point j."""
    if snapshots is not None:
        for p in range(snapshots.shape[2]):
            snapshots[k, j, p] = sizes[p + 1]
    if classes is not None:
        for m in range(classes.shape[2]):
            classes[k, j, m] = counts[k, m]


@_inlined
def _renew_blocks(bounds, block_bounds, active, actives, cells):
    """Take the largest bounds of the active blocks anew; raise those beside them, where a seam was crossed."""
    last = (cells - 1) // BLOCK
    for k in range(actives):
        block = np.int64(active[k])
        block_bounds[block] = _largest(bounds, block * BLOCK + 1)
        before, after = block - 1 if block > 0 else last, block + 1 if block < last else 0
        end, start = bounds[(before + 1) * BLOCK if before < last else cells], bounds[after * BLOCK + 1]
        block_bounds[before] = end if end > block_bounds[before] else block_bounds[before]
        block_bounds[after] = start if start > block_bounds[after] else block_bounds[after]


@_compiled
def crush(parcels, passage, path, ore, work, record):
    """Crush parcels at every point of their passages.

    Every break of a point is decided on the sizes before it, and a cell breaks once at a point. A break draws one
    number of its place's stream. One call for many parcels: a thread that waits for its turn between short calls would
    lose what a second core gains (2 threads: 1.0 -> 1.7 times one).
    """
    active, places, before, own, after, weak, verdicts, states, ratios, exponents = work
    log_stress, critical_ratio = path
    sieves, counts = record.sieves, record.counts
    cells = parcels.sizes.shape[1] - 2
    _fill(exponents, ore.inverse_exponent)
    for k in range(passage.slots.size):
        slot, line = passage.slots[k], passage.lines[k]
        sizes, streams = parcels.sizes[slot], parcels.streams[slot]
        weakness, bounds, block_bounds = parcels.weakness, parcels.bounds[slot], parcels.block_bounds[slot]
        classify(parcels.sizes, slot, sieves, k, counts)
        for j in range(passage.first[k], passage.last[k]):
            critical = critical_ratio[line, j]
            actives = 0
            if critical < np.inf:
                if parcels.bounds_outdated[slot]:
                    _set_bounds(sizes, weakness, slot, bounds, block_bounds, ore)
                    parcels.bounds_outdated[slot] = False
                needed = np.float32(critical if critical < 3e38 else 3e38)  # beyond every effective size of float32
                actives = _list_blocks(needed, block_bounds, active)
            if actives:
                count = _list_candidates(needed, bounds, active, actives, places)
                _gather(sizes, weakness, slot, places, count, before, own, after, weak)
                if ore.strength == SIZE_EFFECT:
                    # in whole vectors; what is decided beyond the last candidate is not read
                    whole = (count + BLOCK - 1) // BLOCK * BLOCK
                    if _decide(whole, before, own, after, weakness, weak, ore, critical, verdicts):
                        level = log_stress[line, j]
                        _decide_by_logarithms(count, sizes, weakness, slot, places, ore, level, before, verdicts)
                found = _list_breaks(count, before, verdicts, bounds, places)
                _count(sizes, places, found, sieves, k, np.int64(-1), counts)
                whole = (found + 7) // 8 * 8
                _draw(sizes, streams, places, found, whole, own, states, ratios)
                if ore.fragments == POWER_LAW:
                    exponent = ore.inverse_exponent
                    _raise_ratios(exponent, own, streams, places, found, whole, ore, ratios, exponents)
                _draw_strength(streams, weakness, slot, places, found, ore)
                _break(sizes, weakness, slot, bounds, places, found, ore, own, ratios)
                _count(sizes, places, found, sieves, k, np.int64(1), counts)
                _renew_blocks(bounds, block_bounds, active, actives, cells)
                parcels.breaks[slot] += found
            _keep(sizes, counts, k, j, record.snapshots, record.classes)


@_compiled
def complete(sizes, streams, weakness, critical_ratios, exponent, ore, places):
    """Break cells (slot, cell + 2) on, without cushioning, until each is below its parcel's critical ratio, (slot,).

    Cushioning only strengthens, and a cell's fragments draw the numbers of its own stream in order. So what broke
    before would have broken without cushioning too, into the same fragments: what is left are the breaks that it held,
    3 % of all in the paper's scene. `places`, (cell,), is work space.
    """
    for k in range(critical_ratios.size):
        critical = critical_ratios[k]
        surely_below = np.float32(critical * ore.reference_size * 0.999999 if weakness is None else 0.0)
        listed = 0
        for p in range(1, sizes.shape[1] - 1):  # without branches, for none of them can be foreseen
            places[listed] = p
            listed += sizes[k, p] >= surely_below
        for n in range(listed):
            p = places[n]
            size, weak = sizes[k, p], 1.0
            if weakness is not None:
                weak = np.float64(weakness[k, p])
            while size * ore.inverse_size * weak >= critical and size >= ore.size_floor:
                streams[k, p] += _GOLDEN
                ratio = uniform(streams[k, p])
                if exponent is not None:
                    ratio **= exponent if ore.size_exponent == 0.0 else _exponent_of(exponent, size, ore)
                size = np.float32(size * ratio if size * ratio > SMALLEST else SMALLEST)
                if weakness is not None:
                    weak = np.float64(_weakness(streams[k, p], ore))
            sizes[k, p] = size


# --- exchange -----------------------------------------------------------------------------------------------


@_compiled
def split(pairs, rise, mixing, means, largest, largest_sum, sums, substeps):
    """Fill in how many substeps each edge takes part (edge,); `sums` (point,) are of the probabilities of a cell."""
    for e in range(substeps.size):
        lower, upper = pairs[e, 0], pairs[e, 1]
        most = mixing[e] + rise[e] * (max(largest - means[lower], 0.0) + means[upper])
        sums[lower] += most
        sums[upper] += most
    for e in range(substeps.size):
        most = max(sums[pairs[e, 0]], sums[pairs[e, 1]])
        substeps[e] = max(math.ceil(min(most / largest_sum, 1e18)), 1.0)  # beyond 9e18 no integer would hold it


@_compiled
def take_turns(substeps, most, credits, turns):
    """Fill the turns of edges that take part in so many of `most` substeps, spread evenly; 8 times as fast as NumPy."""
    taken = 0
    for _ in range(most):
        for e in range(substeps.size):
            credits[e] += substeps[e]
            if credits[e] >= most:
                credits[e] -= most
                turns[taken] = e
                taken += 1


@_inner
def _total(sizes, places, per_size):
    """Return the sum of sizes in whole parts: one of integers is the same in any order, and so vectors take it."""
    total = np.int64(0)  # 0.47 -> 0.2 ns a cell
    for p in range(places):
        total += np.int64(np.int32(sizes[np.uint64(p)] * per_size))
    return total


@_inner
def _copy(rows, values, part, slot, places, back):
    """Copy a parcel's cells, if there are any, to a share of the places, or back."""
    if rows is not None:
        start = part * values.shape[2] + 1
        for p in range(places):
            if back:
                rows[slot, start + p] = values[part, slot, p]
            else:
                values[part, slot, p] = rows[slot, start + p]


@_compiled
def spread(parcels, slots, shares, per_size):
    """Copy the cells of these parcels to the shares."""
    cells, share = parcels.sizes.shape[1] - 2, shares.sizes.shape[2]
    for slot in slots:
        for part in range(shares.totals.shape[0]):
            places = min(share, cells - part * share)
            _copy(parcels.sizes, shares.sizes, part, slot, places, False)
            _copy(parcels.weakness, shares.weakness, part, slot, places, False)
            shares.totals[part, slot] = _total(shares.sizes[part, slot], places, per_size)


@_compiled
def gather(shares, slots, parcels):
    """Copy what has swapped in these parcels from the shares."""
    cells, share = parcels.sizes.shape[1] - 2, shares.sizes.shape[2]
    for slot in slots:
        for part in range(shares.totals.shape[0]):
            if shares.swapped[part, slot]:
                shares.swapped[part, slot], parcels.bounds_outdated[slot] = False, True
                places = min(share, cells - part * share)
                _copy(parcels.sizes, shares.sizes, part, slot, places, True)
                _copy(parcels.weakness, shares.weakness, part, slot, places, True)


@_inlined
def _fill_numbers(numbers, state):
    """Fill random numbers of 64 bits, each for four cells."""
    for k in range(numbers.size):
        numbers[k] = mix(state + np.uint64(k + 1) * _GOLDEN)


@_inlined
def _drive(rise, mixing, below, above, ceiling):
    """Return what `_chance` takes beside the sizes, given the mean sizes below and above an edge."""
    if ceiling == 0.0:  # then without roots
        return rise, mixing, below, above, 0.0, 0.0
    return rise, mixing, below, above, ceiling / math.sqrt(below), ceiling / math.sqrt(above)


@_inlined
def _chance(a, b, drive):
    """Return the probability that cells of sizes a below and b above an edge swap."""
    rise, mixing, below, above, held_below, held_above = drive
    up, down = a - below if a > below else 0.0, above - b if above > b else 0.0
    if held_below == 0.0:  # then without quotients
        return mixing + rise * (up + down)
    return mixing + rise * (up / (1.0 + held_below * up) + down / (1.0 + held_above * down))


@_inlined
def _swap_densely(sizes, lower, upper, places, drive, quarters, hits):
    """Decide the cells of an edge in turn, without branches; return the number of swaps.

    Chances are float32, as sizes are, of numbers of 16 bits: more of either would take longer. A seventeenth number in
    0 to 1, the same for all these cells and new every time, is what lies between two of them: no chance is rounded.
    """
    rise, mixing, below, above, held_below, held_above = drive
    between = np.float64(quarters[places]) * 2.0**-16
    per_size, chance_of_all = np.float32(rise * 2.0**16), np.float32(mixing * 2.0**16 - between)
    mean_below, mean_above, zero, one = np.float32(below), np.float32(above), np.float32(0.0), np.float32(1.0)
    held, held_up, held_down = held_below > 0.0, np.float32(held_below), np.float32(held_above)
    swaps = np.int32(0)
    for k in range(places):
        p = np.uint64(k)
        a, b = sizes[lower, p], sizes[upper, p]
        up, down = max(a - mean_below, zero), max(mean_above - b, zero)
        if held:
            up, down = up / (one + held_up * up), down / (one + held_down * down)
        hit = np.float32(quarters[k]) < chance_of_all + per_size * (up + down)
        sizes[lower, p], sizes[upper, p] = b if hit else a, a if hit else b
        if hits is not None:
            hits[k] = hit
        swaps += np.int32(hit)
    return swaps


@_inlined
def _follow(values, part, lower, upper, places, hits):
    """Swap what belongs to the cells that have swapped, if anything does."""
    if values is not None:
        for k in range(places):
            p = np.uint64(k)
            a, b = values[part, lower, p], values[part, upper, p]
            values[part, lower, p], values[part, upper, p] = b if hits[k] else a, a if hits[k] else b


@_inner
def _skipped(number, per_cell, cells):
    """Return how many cells a geometric skip passes over, from a uniform number and 1 / log(1 - P)."""
    skip = math.log(number) * per_cell
    return np.int64(skip) if skip < cells else np.int64(cells)


@_inner
def _swap_sparsely(sizes, weakness, part, lower, upper, places, number, state, drive, most):
    """Swap cells of an edge, candidates drawn by geometric skipping with its largest probability and then thinned.

    `number` draws the first, `state` is the stream of all that follows.
    """
    per_cell, swaps = 1.0 / math.log1p(-most), 0
    p = _skipped(number, per_cell, places)
    while p < places:
        a, b = sizes[lower, p], sizes[upper, p]
        state += _GOLDEN
        if uniform(state) * most < _chance(a, b, drive):
            sizes[lower, p], sizes[upper, p] = b, a
            if weakness is not None:
                a, b = weakness[part, lower, p], weakness[part, upper, p]
                weakness[part, lower, p], weakness[part, upper, p] = b, a
            swaps += 1
        state += _GOLDEN
        p += 1 + _skipped(uniform(state), per_cell, places)
    return swaps


@_compiled
def swap(shares, part, places, slots, edges, means, largest, per_size, key, numbers, quarters, hits):
    """Swap cells of equal index across the edges in a share of the places; return the number of swaps.

    A cell of size a below and one of size b above an edge swap with probability
    mixing + rise [(a - mean below)+ + (mean above - b)+], each part held where percolation has a ceiling. Where swaps
    are rare, the cost follows the swaps, not the cells. Cells of other indices never meet these, so threads may share
    the places between them.

    Parameters
    ----------
    shares : Shares
        Sizes swap, each with its grain's strength, while random streams stay at their places.
    part, places : int
        Which share, and how many places it has.
    slots : int64 (number of points,)
        Slot of the parcel at each point.
    edges : Edges
        Edges, their probabilities, and their turns.
    means : float64 (number of points,)
        Mean size of each parcel, m, held during the time step.
    largest, per_size, key : float, float32, uint64
        Bound of all sizes, m; parts in which sizes are summed, 1/m; key of the time step, of which every share makes a
        stream of its own.
    numbers, quarters, hits : uint64 (share / 4 + 1,), uint16 (share + 4,), bool (share,)
        Work space; `quarters` are the bits of `numbers`; no `hits` where strengths do not scatter.
    """
    sizes, swapped, totals = shares.sizes[part], shares.swapped[part], shares.totals[part]
    stream, total = mix(key + np.uint64(part * sizes.shape[1] + 1) * _GOLDEN), 0
    for turn in range(edges.turns.size):
        e = edges.turns[turn]
        lower, upper = slots[edges.pairs[e, 0]], slots[edges.pairs[e, 1]]
        below, above = means[edges.pairs[e, 0]], means[edges.pairs[e, 1]]
        drive = _drive(edges.rise[e], edges.mixing[e], below, above, edges.ceiling[e])
        most = _chance(largest, 0.0, drive)
        if most <= 0.0:
            continue
        swaps, state = 0, stream + np.uint64(turn + 1) * _GOLDEN
        if most > DENSE:
            _fill_numbers(numbers, mix(state))
            swaps = np.int64(_swap_densely(sizes, lower, upper, places, drive, quarters, hits))
            _follow(shares.weakness, part, lower, upper, places, hits)
        else:
            number = uniform(state)
            if number >= 1.0 - places * most:  # or the first candidate lies past the last: no logarithm needed
                state = mix(state)
                swaps = _swap_sparsely(sizes, shares.weakness, part, lower, upper, places, number, state, drive, most)
        if swaps > 0:
            swapped[lower] = swapped[upper] = True
            total += swaps
    for slot in range(totals.size):
        if swapped[slot]:
            totals[slot] = _total(sizes[slot], places, per_size)
    return total


@_compiled
def swap_mean_field(fractions, sizes, edges, means, swaps, ups, downs):
    """Swap as the lattice does in the limit of many cells.

    Parameters
    ----------
    fractions : float64 (number of points, class)
        Part of the cells at each point in each size class.
    sizes : float64 (class,)
        Mean sizes, m.
    edges, means : Edges, float64 (number of points,)
        As in `swap`.
    swaps : float64 (edge,)
        Expected swaps of a cell index across each edge, added to.
    ups, downs : float64 (class,)
        Work space.
    """
    for turn in range(edges.turns.size):
        e = edges.turns[turn]
        lower, upper, mixing = edges.pairs[e, 0], edges.pairs[e, 1], edges.mixing[e]
        drive = _drive(edges.rise[e], mixing, means[lower], means[upper], edges.ceiling[e])
        rise, mixing, below, above, held_below, held_above = drive
        for c in range(sizes.size):
            ups[c], downs[c] = max(sizes[c] - below, 0.0), max(above - sizes[c], 0.0)
        if held_below > 0.0:  # or else without quotients, which take as long as all the rest
            for c in range(sizes.size):
                ups[c], downs[c] = ups[c] / (1.0 + held_below * ups[c]), downs[c] / (1.0 + held_above * downs[c])
        rising = sinking = 0.0
        for c in range(sizes.size):
            rising += fractions[lower, c] * ups[c]
            sinking += fractions[upper, c] * downs[c]
        rising, sinking = mixing + rise * rising, mixing + rise * sinking
        for c in range(sizes.size):
            flow = fractions[lower, c] * (rise * ups[c] + sinking) - fractions[upper, c] * (rising + rise * downs[c])
            fractions[lower, c] -= flow
            fractions[upper, c] += flow
        swaps[e] += rising + sinking - mixing


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
