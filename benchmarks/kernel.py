"""Cost of the crushing kernel on the paper's scene, against plain versions of its rule and the machine's limits.

Run by hand, from the root of the repository: `python -m benchmarks.kernel`. About a minute; one core.
Every repeat marches fresh copies of the same cells along the central streamline, all in one process.
"""

import ast
import functools
import inspect
import math
import os
import platform
import statistics
import textwrap
import time
from pathlib import Path

import numba
import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic

from hpgr import presets
from hpgr.bed.loaded import inputs_of, load_bed
from hpgr.grains import kernels, march, solve

POINTS = (100, 200, 400, 800, 1600, 3200)
EXPONENTS = (0.5, 1.0, math.inf)
CELLS = (1_000, 100_000)
PLAIN_POINTS = 200  # the plain versions cost the same at every point, but for the breaks
CELLS_PER_TIMING = 100_000  # short lines are marched several times per timing
REPEATS, PLAIN_REPEATS = 15, 3
GAMMA = 1.0
DECIDED = 1.4  # cells decided for one that breaks, at 200 points
GOLDEN = np.uint64(0x9E3779B97F4A7C15)


def case(points, cells):
    """Return a parcel, and log(sigma_a / sigma_m) along the streamline."""
    scene = presets.paper().with_values({"resolution.points": points, "resolution.cells": cells})
    log_stress = scene.strength.log_stress(solve.crushing_stress(scene, load_bed(inputs_of(scene))))
    return march.first_cells(scene, 0, [(0, 0, 0)]), log_stress[:1]


@functools.cache
def ore(n):
    """Return the paper's scene with exponent n and the constants of its laws."""
    scene = presets.paper().with_values({"strength.cushioning": n, "fragments.exponent": GAMMA})
    return scene, march.ore(scene)


def copied(parcels):
    return kernels.Parcels(*(None if array is None else array.copy() for array in parcels))


def bounded(parcels, log_stress, n):
    scene, laws = ore(n)
    one = np.zeros(1, int)
    passage = kernels.Passage(one, one, one, one + log_stress.shape[1])
    work = kernels.make_work(parcels.sizes.shape[1] - 2)
    kernels.crush(parcels, passage, march.path(scene, log_stress), laws, work, kernels.Record())


@njit
def _compiled(sizes, streams, log_stress, ore):
    cells, breaking = sizes.size, np.empty(sizes.size, np.bool_)
    for level in log_stress:
        for p in range(cells):
            size = np.float64(sizes[p])
            left, right = sizes[p - 1 if p > 0 else cells - 1], sizes[p + 1 if p + 1 < cells else 0]
            mean = ((np.float64(left) + np.float64(right)) + size) / 3.0
            unlike = math.log(size / mean)
            strength = ore.cushion * unlike * unlike - ore.slope * math.log(size / ore.reference_size)
            breaking[p] = (level >= strength) & (size >= ore.size_floor)
        for p in range(cells):
            if breaking[p]:
                streams[p] += GOLDEN
                size = sizes[p] * kernels.uniform(streams[p])
                sizes[p] = np.float32(max(size, kernels.SMALLEST))


def compiled(parcels, log_stress, n):
    _compiled(parcels.sizes[0, 1:-1], parcels.streams[0, 1:-1], log_stress[0], ore(n)[1])


def vectorised(parcels, log_stress, n):
    laws, sizes, streams = ore(n)[1], parcels.sizes[0, 1:-1], parcels.streams[0, 1:-1]
    for level in log_stress[0]:
        size = sizes.astype(float)
        mean = (np.roll(size, 1) + np.roll(size, -1) + size) / 3
        strength = laws.cushion * np.log(size / mean) ** 2 - laws.slope * np.log(size / laws.reference_size)
        broken = np.flatnonzero((level >= strength) & (size >= laws.size_floor))
        streams[broken] += GOLDEN
        uniform = ((mixed(streams[broken]) >> np.uint64(12)) + 0.5) * 2.0**-52
        sizes[broken] = np.maximum(size[broken] * uniform, kernels.SMALLEST)


def mixed(state):
    """Return the output of SplitMix64 for an array of states."""
    z = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


@njit(error_model="numpy")
def _floor(sizes, streams, places, first, states, found, totals, ratios, answers):
    """Do only what no march can do without, in loops of its own: numbers, fragments and decisions of known breaks."""
    for j in range(first.size - 1):
        count = first[j + 1] - first[j]
        for k in range(count):
            p = np.uint64(places[first[j] + k])
            states[k] = streams[p] + GOLDEN
            streams[p] = states[k]
            found[k] = sizes[p]
            totals[k] = np.float64(sizes[p - np.uint64(1)]) + np.float64(sizes[p + np.uint64(1)])
        for k in range(count):
            ratios[k] = kernels.uniform(states[k])
        for k in range(count):
            sizes[np.uint64(places[first[j] + k])] = np.float32(found[k] * ratios[k])
        for k in range(np.int64(DECIDED * count)):
            z = (2.0 * found[k] - totals[k]) / (4.0 * found[k] + totals[k])
            low = 2.0 * z * (1.0 + z * z / 3.0)
            y = low * low
            answers[k] = found[k] >= (1.0 + y * (1.0 + y * (0.5 + y / 6.0))) * 1e-3


def floor(line, n):
    """Return a march that knows beforehand which cells break at which point, and the breaks a cell."""
    parcels, log_stress = line
    cells, broken = parcels.sizes.shape[1] - 2, []
    followed = copied(parcels)
    for level in log_stress[0]:
        before = followed.streams[0].copy()
        vectorised(followed, np.full((1, 1), level), n)
        broken.append(np.flatnonzero(followed.streams[0] != before))
    places, first = np.concatenate(broken).astype(np.uint32), np.cumsum([0, *map(len, broken)])
    work = np.empty(2 * cells, np.uint64), *np.ones((3, 2 * cells)), np.empty(2 * cells, bool)

    def march_of_known_breaks(fresh, *_):
        _floor(fresh.sizes[0], fresh.streams[0], places, first, *work)

    return march_of_known_breaks, len(places) / cells


@intrinsic
def _cycles(typing_context):
    def generate(context, builder, signature, values):
        kind = ir.FunctionType(ir.IntType(64), [])
        return builder.call(cgutils.get_or_insert_function(builder.module, kind, "llvm.readcyclecounter"), [])

    return types.int64(), generate


def measured_crush():
    """Return the kernel with a clock after every statement of its step, which adds to ticks, and what they call."""
    tree = ast.parse(textwrap.dedent(inspect.getsource(kernels.crush.py_func)))
    function = tree.body[0]
    function.decorator_list, arguments = [], function.args.args
    arguments.append(ast.arg("ticks"))
    step = next(part for part in ast.walk(function) if isinstance(part, ast.If) and ast.unparse(part.test) == "actives")
    called = [
        [call.func.id for call in ast.walk(part) if isinstance(call, ast.Call) and isinstance(call.func, ast.Name)]
        for part in step.body
    ]
    clock = "now = _cycles()\nticks[{0}] += now - then\nthen = now"
    body = ast.parse("then = _cycles()").body
    for k, part in enumerate(step.body):
        body += [part, *ast.parse(clock.format(k)).body]
    step.body = body
    names = vars(kernels) | {"_cycles": _cycles}
    exec(compile(ast.fix_missing_locations(tree), "measured", "exec"), names)
    return njit(nogil=True, error_model="numpy")(names["crush"]), called


def shares(points, cells, n):
    """Return the part of the march's time that each loop of a step takes, by its name."""
    crush, called = measured_crush()
    scene, laws = ore(n)
    parcels, log_stress = case(points, cells)
    one, ticks = np.zeros(1, int), np.zeros(len(called), np.int64)
    passage = kernels.Passage(one, one, one, one + points)
    work, path = kernels.make_work(cells), march.path(scene, log_stress)
    for _ in range(3):
        ticks[:] = 0  # of the first, which compiles
        crush(copied(parcels), passage, path, laws, work, kernels.Record(), ticks)
    found = {}
    for names, spent in zip(called, ticks, strict=True):
        loop = next((name for name in names if name.startswith("_")), "the rest")
        found[loop] = found.get(loop, 0.0) + spent / ticks.sum()
    return found


@njit
def _read(bits, times):
    total = 0
    for k in range(times):
        part = np.int32(k)
        for p in range(bits.size):
            part ^= bits[p]
        total += part
    return total


@njit
def _compare(values, needed, times):
    total = 0
    for k in range(times):
        level = np.float32(needed + k)
        hits = np.int32(0)
        for p in range(values.size):
            hits += np.int32(values[p] >= level)
        total += hits
    return total


def timed(version, line, cells, n, repeats):
    """Return the nanoseconds per cell of each of `repeats` marches over fresh data; the first is left out."""
    parcels, log_stress = line
    lines = max(1, CELLS_PER_TIMING // cells)
    found = []
    for _ in range(repeats + 1):
        fresh = [copied(parcels) for _ in range(lines)]
        start = time.perf_counter()
        for each in fresh:
            version(each, log_stress, n)
        found.append((time.perf_counter() - start) / (lines * cells) * 1e9)
    return found[1:]


def rate(kernel, cells):
    """Return the median nanoseconds per cell of a kernel that is told how often to pass over the cells."""
    times, found = 20_000_000 // cells, []
    for _ in range(REPEATS + 1):
        start = time.perf_counter()
        kernel(times)
        found.append((time.perf_counter() - start) / (times * cells) * 1e9)
    return statistics.median(found[1:])


def check(line, n):
    """Refuse to compare versions that do not give the same sizes and streams, bit for bit."""
    results = []
    for version in (bounded, compiled, vectorised):
        parcels = copied(line[0])
        version(parcels, line[1], n)
        results.append((parcels.sizes, parcels.streams))
    for pair in results[1:]:
        for mine, other in zip(results[0], pair, strict=True):
            assert np.array_equal(mine[:, 1:-1], other[:, 1:-1])


def processor():
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(":")[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor()


def main():
    print(f"{processor()}, {os.cpu_count()} cores, one used; load {os.getloadavg()[0]:.1f} on start")
    print(f"Python {platform.python_version()}, NumPy {np.__version__}, Numba {numba.__version__}")
    print(f"medians (least) of {REPEATS} repeats, {PLAIN_REPEATS} of the plain versions; gamma = {GAMMA}\n")
    lines = functools.cache(case)

    print("| n | cells | " + " | ".join(f"{points} points" for points in POINTS) + " | 800 -> 1,600 |")
    print("|---|---|" + "---|" * (len(POINTS) + 1))
    for n in EXPONENTS:
        for cells in CELLS:
            found = [timed(bounded, lines(points, cells), cells, n, REPEATS) for points in POINTS]
            medians = [statistics.median(times) for times in found]
            row = [f"{median:.0f} ({min(times):.0f})" for median, times in zip(medians, found, strict=True)]
            print(f"| {n} | {cells:,} | " + " | ".join(row) + f" | x {medians[4] / medians[3]:.2f} |", flush=True)
    print("\nns per cell for the whole march\n")

    print("| n | cells | plain NumPy | plain compiled loop |")
    print("|---|---|---|---|")
    for n in EXPONENTS:
        for cells in CELLS:
            line = lines(PLAIN_POINTS, cells)
            check(line, n)
            costs = [timed(version, line, cells, n, PLAIN_REPEATS) for version in (vectorised, compiled)]
            row = [f"{statistics.median(times) / PLAIN_POINTS:.1f}" for times in costs]
            print(f"| {n} | {cells:,} | " + " | ".join(row) + " |", flush=True)
    print(f"\nns per cell and point, measured at {PLAIN_POINTS} points; sizes and streams bit for bit the kernel's\n")

    print("| n | cells | breaks a cell | the floor | today | today over the floor |")
    print("|---|---|---|---|---|---|")
    for n in EXPONENTS[1:]:
        for cells in CELLS:
            line = lines(PLAIN_POINTS, cells)
            known, breaks = floor(line, n)
            least, now = (statistics.median(timed(each, line, cells, n, REPEATS)) for each in (known, bounded))
            print(f"| {n} | {cells:,} | {breaks:.2f} | {least:.0f} | {now:.0f} | {now / least:.2f} |", flush=True)
    print(f"\nns per cell at {PLAIN_POINTS} points; the floor knows which cells break, and decides {DECIDED} a break\n")

    found = [shares(points, CELLS[1], 1.0) for points in (200, 1600)]
    print("| loop of a step | 200 points | 1,600 points |")
    print("|---|---|---|")
    for loop in sorted((loop for loop in found[0] if found[0][loop] > 5e-3), key=found[0].get, reverse=True):
        print(f"| {loop} | " + " | ".join(f"{each[loop]:.0%}" for each in found) + " |")
    print(f"\nshares of the time of a march, n = 1, {CELLS[1]:,} cells\n", flush=True)

    print("| cells | read | compare | one compare of every cell at every one of 1,600 points |")
    print("|---|---|---|---|")
    for cells in CELLS:
        sizes = lines(PLAIN_POINTS, cells)[0].sizes[0, 1:-1]
        read = rate(functools.partial(_read, sizes.view(np.int32)), cells)
        compare = rate(functools.partial(_compare, sizes, 0.0), cells)
        print(f"| {cells:,} | {4 / read:.0f} GB/s | {1 / compare:.0f} per ns | {1600 * compare:.0f} ns per cell |")


if __name__ == "__main__":
    main()
