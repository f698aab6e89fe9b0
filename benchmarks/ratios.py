"""How long today's code takes over that of before, side by side: python -m benchmarks.ratios [ROW ...]

Both are in this process and take turns, so that what else the machine does meets both. Times are of the processor,
medians of repeats after one that warms up; of two threads, wall times. Cold starts are fresh processes.
"""

import math
import os
import platform
import resource
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from itertools import count
from pathlib import Path

import numpy as np

import hpgr
from benchmarks.before import FOLDER, Before
from hpgr.bed.loaded import inputs_of, load_bed
from hpgr.grains import kernels, march, solve
from studies.sweep import run, space, sweep

BEFORE = Before()
PRODUCT = {"resolution.record": "product"}
PLAIN = PRODUCT | {"resolution.control_variate": False}
CASES = 128  # a batch of a sweep


def scenes(values=None, before=None, preset="paper"):
    """Return the same scene to the code of before and to that of today."""
    values = values or {}
    with BEFORE:
        old = getattr(BEFORE.hpgr.presets, preset)().with_values(values if before is None else before)
    return old, getattr(hpgr.presets, preset)().with_values(values)


def turns(before, now, repeats, clock=time.process_time):
    """Return the median times, s, of two functions without arguments that take turns."""
    times = [], []
    for _ in range(repeats + 1):
        with BEFORE:
            start = clock()
            before()
            times[0].append(clock() - start)
        start = clock()
        now()
        times[1].append(clock() - start)
    return [statistics.median(each[1:]) for each in times]


def show(what, before, now, goal, unit="ms"):
    """Print a row of the table."""
    scale = {"ms": 1e3, "s": 1.0, "ns": 1e9}[unit]
    ratio = now / before
    told = "" if goal is None else f"{goal:.2f} | {'met' if ratio <= goal else '**missed**'}"
    print(
        f"| {what} | {scale * before:.3g} {unit} | {scale * now:.3g} {unit} | {ratio:.2f} | {told or ' | '} |",
        flush=True,
    )


# --- rows ---------------------------------------------------------------------------------------------------


def crushing():
    """March of ten lines, by points; the cells are made outside the time."""
    with BEFORE:
        parcels, old_kernels = BEFORE.hpgr.parcels, BEFORE.hpgr.kernels
    nothing = np.empty(0), np.empty((0, 0, 0), np.float32), np.empty((0, 0, 0), np.int64)
    for n, gamma in ((1.0, 1.0), (np.inf, 1.0), (1.0, 3.0), (1.0, 0.35)):
        for points, cells in ((200, 1_000), (1600, 1_000), (3200, 1_000), (200, 100_000)):
            if gamma != 1.0 and (points, cells) != (200, 1_000):
                continue
            size = {"resolution.points": points, "resolution.cells": cells, "fragments.exponent": gamma}
            old_size = {k: v for k, v in size.items() if k != "fragments.exponent"} | {
                "material.fragment_exponent": gamma
            }
            old, new = scenes(size, old_size)
            log_stress = new.strength.log_stress(solve.crushing_stress(new, load_bed(inputs_of(new))))
            path, ore = march.path(new, log_stress), march.ore(new.with_values({"strength.cushioning": n}))
            with BEFORE:
                needed, constants = parcels.reach_needed(old, log_stress), list(parcels.constants(old))
            constants[1] = 0.5 / n**2
            lines, keys = np.arange(10), [(0, line, 0) for line in range(10)]
            passage = kernels.Passage(lines, lines, 0 * lines, 0 * lines + points)
            work, breaks = kernels.make_work(cells), np.empty(10, np.int64)
            times = [], []
            for _ in range(5 if cells > 1_000 else 40):
                with BEFORE:
                    sizes, streams = parcels.first_cells(old, 0, keys)
                    start = time.process_time()
                    old_kernels.march_parcels(sizes, streams, lines, log_stress, needed, *nothing, breaks, *constants)
                    times[0].append(time.process_time() - start)
                fresh = march.first_cells(new, 0, keys)
                start = time.process_time()
                kernels.crush(fresh, passage, path, ore, work, kernels.Record())
                times[1].append(time.process_time() - start)
                assert np.array_equal(fresh.sizes[:, 1:-1], sizes)
            before, now = (statistics.median(each[1:]) / (10 * cells) for each in times)
            what = f"march a cell, n = {n:g}, gamma = {gamma:g}, {points:,} points, {cells:,} cells"
            goal = (0.5 if points == 200 else 0.55) if gamma == 1.0 else None
            show(f"{what} ({breaks.sum() / (10 * cells):.2f} breaks)", before, now, goal, "ns")


def _march(gamma, harder=0.0):
    """Return a function that marches ten lines and returns the time, s, and the breaks, both a cell."""
    scene = hpgr.presets.paper().with_values({"fragments.exponent": gamma})
    log_stress = scene.strength.log_stress(solve.crushing_stress(scene, load_bed(inputs_of(scene)))) + harder
    path, ore, lines = march.path(scene, log_stress), march.ore(scene), np.arange(10)
    passage = kernels.Passage(lines, lines, 0 * lines, 0 * lines + log_stress.shape[1])
    work, cells = kernels.make_work(scene.resolution.cells), 10 * scene.resolution.cells

    def run():
        parcels = march.first_cells(scene, 0, [(0, line, 0) for line in lines])
        start = time.process_time()
        kernels.crush(parcels, passage, path, ore, work, kernels.Record())
        return (time.process_time() - start) / cells, parcels.breaks.sum() / cells

    return run


def fragments():
    """A break of other fragments over one of gamma = 1, under the same force, and under one that breaks as often."""
    for gamma in (0.35, 3.0):
        other = _march(gamma)
        low, high, wanted = -5.0, 12.0, other()[1]
        while high - low > 1e-3:
            middle = (low + high) / 2
            low, high = (middle, high) if _march(1.0, middle)()[1] < wanted else (low, middle)
        for harder, what in ((0.0, "the same force"), (high, f"{math.exp(high):.2g} times the force")):
            plain = _march(1.0, harder)
            pairs = [[np.divide(*run()) for run in (plain, other)] for _ in range(101)][1:]
            breaks = plain()[1], wanted
            show(
                f"a break of gamma = {gamma:g} over one of 1, {what} ({breaks[1]:.2f}, {breaks[0]:.2f} breaks a cell)",
                *np.median(pairs, axis=0),
                1.2,
                "ns",
            )


def case():
    """Cases of a sweep, 10 x 200 x 1,000, and two threads."""
    old, new = scenes(PLAIN, PRODUCT)
    controlled = new.with_values({"resolution.control_variate": True})
    gaps = np.linspace(0.05, 0.07, CASES)

    def before(numbers, apart=False):
        bench = BEFORE.bench.Bench(BEFORE.bench.Job(old))
        for k in numbers:
            BEFORE.bench.run_case(bench, BEFORE.bench.Case((0,), {"rolls.gap": gaps[k] if apart else 0.06}, k))

    def now(numbers, apart=False, scene=new):
        cases = [space.Case((0,), {"rolls.gap": gaps[k] if apart else 0.06}, k) for k in numbers]
        run.run_batch(space.SweepSpec(scene), cases)

    every, halves = range(CASES), (range(CASES // 2), range(CASES // 2, CASES))
    with ThreadPoolExecutor(1) as worker, ThreadPoolExecutor(2) as workers:  # as the worker threads of sweeps

        def alone(**how):
            worker.submit(now, every, **how).result()

        times = turns(lambda: before(every), alone, 15)
        show("case of a sweep, replicates of a point", *(each / CASES for each in times), 0.35)
        times = turns(lambda: before(every), lambda: alone(scene=controlled), 15)
        show("the same with the control variate", *(each / CASES for each in times), 0.35 * 1.15)
        times = turns(lambda: before(every, True), lambda: alone(apart=True), 15)
        show("case of a sweep, each at another gap", *(each / CASES for each in times), 0.35)
        for scene, what in ((new, ""), (controlled, ", control variate")):
            one, two = turns(
                lambda scene=scene: alone(scene=scene),
                lambda scene=scene: list(workers.map(lambda part: now(part, scene=scene), halves)),
                15,
                time.perf_counter,
            )
            show(f"today, replicates{what}: one thread, two, wall", one / CASES, two / CASES, 1 / 1.9)


def many():
    """Whole sweeps of a thousand cases with their files."""
    old, new = scenes(PRODUCT)
    grids = {
        "50 gaps x 20 feeds": (
            {"rolls.gap": np.linspace(0.03, 0.1, 50), "feed.top_size": np.linspace(0.03, 0.06, 20)},
            1,
        ),
        "200 gaps x 5 replicates": ({"rolls.gap": np.linspace(0.03, 0.1, 200)}, 5),
    }
    for what, (axes, replicates) in grids.items():
        with tempfile.TemporaryDirectory() as folder:
            fresh = count()

            def swept(function, scene, axes=axes, replicates=replicates, folder=folder, fresh=fresh):
                function(scene, axes, replicates, threads=2, folder=Path(folder) / str(next(fresh)))

            for clock, name in ((time.process_time, "processor"), (time.perf_counter, "wall")):
                times = turns(lambda: swept(BEFORE.sweep.sweep, old), lambda: swept(sweep, new), 3, clock)
                show(f"1,000 cases with files, {what}, {name}", *times, 0.5, "s")


def exchange():
    """Exchange: the product of two snapshots, and the whole lattice."""
    snapshots = {"exchange": {}, "resolution.snapshots": 2}
    old, new = scenes(PRODUCT | snapshots, PRODUCT | {"exchange": {}, "resolution.photographs": 2})
    seed = count()
    times = turns(lambda: BEFORE.hpgr.simulate(old, next(seed)), lambda: hpgr.simulate(new, next(seed)), 3)
    show("exchange, product, two snapshots", *times, 0.15, "s")
    old, new = (scene.with_values({"resolution.record": "cells"}) for scene in (old, new))
    worker = ThreadPoolExecutor(1)  # in which all runs on one thread
    times = turns(
        lambda: worker.submit(BEFORE.hpgr.simulate, old).result(), lambda: worker.submit(hpgr.simulate, new).result(), 3
    )
    show("whole lattice, cells recorded, one thread", *times, 0.5, "s")
    times = turns(lambda: BEFORE.hpgr.simulate(old), lambda: hpgr.simulate(new), 3, time.perf_counter)
    show("whole lattice, cells recorded, both cores, wall", *times, None, "s")


def gap():
    """The floating gap, of another force or another machine each time, as what was found is remembered."""
    for preset in ("paper", "industrial", "khd_pilot"):
        force, others = 1e5 if preset == "paper" else 3e6, 1 + 1e-4 * np.arange(41)
        diameter = scenes(preset=preset)[1].rolls.diameter
        machines = [scenes({"rolls.diameter": diameter * other}, preset=preset) for other in others]
        for what, cases in (
            ("another force", [(*machines[0], force * other) for other in others]),
            ("another machine", [(*machine, force) for machine in machines]),
        ):
            mine, theirs = iter(cases), iter(cases)

            def before(mine=mine):
                old, _, wanted = next(mine)
                BEFORE.hpgr.operating_gap(old, wanted)

            def now(theirs=theirs):
                _, new, wanted = next(theirs)
                hpgr.operating_gap(new, wanted)

            show(f"operating_gap, {preset}, {what} each time", *turns(before, now, 40), 0.1)


def simulate():
    """One simulation, warm."""
    for what, values, goal in (("product", PRODUCT, 0.5), ("stress only", {"resolution.cells": 0}, 0.4)):
        old, new = scenes(values)
        gaps = 0.06 * (1 + 1e-4 * np.arange(101))
        others = [[scene.with_values({"rolls.gap": gap}) for gap in gaps] for scene in (old, new)]
        for again, each in (
            (", the same scene again", [[old] * 101, [new] * 101]),
            (", another gap each time", others),
        ):
            mine, theirs = map(iter, each)
            times = turns(
                lambda mine=mine: BEFORE.hpgr.simulate(next(mine)),
                lambda theirs=theirs: hpgr.simulate(next(theirs)),
                100,
            )
            show(f"simulate, {what}{again}", *times, goal)


def control():
    """Scatter of the product with the control variate over that without, and its time."""
    for n in (0.5, 1.0, 2.0):
        _, new = scenes(PRODUCT | {"strength.cushioning": n}, {})
        found, spent = {}, {}
        for used in (False, True):
            scene = new.with_values({"resolution.control_variate": used})
            bed, sieve = load_bed(inputs_of(scene)), scene.resolution.sieves.index(0.001)
            solve.crush([solve.Loaded(scene, bed, range(1000))], 0)  # loads the kernels, and takes the memory
            start = time.process_time()
            [crushed] = solve.crush([solve.Loaded(scene, bed, range(1000))], 0)
            spent[used] = time.process_time() - start
            found[used] = [[*one.total_percentiles, one.passing[:, sieve].mean()] for one in crushed]
        scatter = {used: np.std(each, axis=0) / np.mean(each, axis=0) for used, each in found.items()}
        for name, before, now, goal in zip(
            ("P50", "P80", "passing 1 mm"), *scatter.values(), (0.5, 0.8, 0.5), strict=True
        ):
            told = f"{goal} | {'met' if now / before <= goal else '**missed**'}" if n == 1.0 else " | "
            print(f"| scatter of {name}, n = {n:g} | {before:.3%} | {now:.3%} | {now / before:.2f} | {told} |")
        show(f"time of a replicate, n = {n:g}, without and with", spent[False] / 1000, spent[True] / 1000, 1.15)


_RUN = "import hpgr; hpgr.simulate({scene})"
_COLD = {
    "first simulate, cold: paper": ("-c", _RUN.format(scene="hpgr.presets.paper()"), 0.6),
    "first simulate, cold: industrial": ("-c", _RUN.format(scene="hpgr.presets.industrial()"), 0.6),
    "import hpgr, and its simulate": ("-c", "import hpgr; hpgr.simulate", 0.75 / 1.05),
    "gap_sweep --help": ("-m", "studies.gap_sweep --help", 1.0),
}


def cold():
    """Fresh processes; those that simulate find no compiled code."""
    for what, (flag, words, goal) in _COLD.items():
        command = [sys.executable, flag, *([words] if flag == "-c" else words.split())]
        times = [], []
        for _ in range(3):
            for each, folder in zip(times, (FOLDER, Path.cwd()), strict=True):
                cache = tempfile.mkdtemp()
                start = resource.getrusage(resource.RUSAGE_CHILDREN)
                environment = os.environ | {"NUMBA_CACHE_DIR": cache, "PYTHONPATH": str(folder)}
                environment["PYTHONDONTWRITEBYTECODE"] = ""  # the first of three keeps it, as with any user
                subprocess.run(command, cwd=folder, env=environment, check=True, capture_output=True)
                end = resource.getrusage(resource.RUSAGE_CHILDREN)
                each.append(end.ru_utime + end.ru_stime - start.ru_utime - start.ru_stime)
                shutil.rmtree(cache)
        show(what, *map(statistics.median, times), goal, "s")


ROWS = {each.__name__: each for each in (crushing, fragments, case, many, exchange, gap, simulate, control, cold)}


def main():
    """Print the rows that are named, or all."""
    names = sys.argv[1:] or list(ROWS)
    unknown = [name for name in names if name not in ROWS]
    if unknown:
        raise SystemExit(f"no row {unknown[0]}; there are {', '.join(ROWS)}")
    load = os.getloadavg()[0]
    print(f"{platform.machine()}, {os.cpu_count()} cores, load {load:.1f}; Python {platform.python_version()}\n")
    print("| what | before | now | ratio | goal | |\n|---|---|---|---|---|---|")
    for name in names:
        ROWS[name]()


if __name__ == "__main__":
    main()
