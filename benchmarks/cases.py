"""Cost of cases: one warm run, a thousand in a sweep, the lattice, a large case. Run: python -m benchmarks.cases

Every figure is the median of repeats in this one process; ratios are of figures measured side by side. Run it on a
quiet machine, from a clone.
"""

import os
import platform
import resource
import statistics
import subprocess
import sys
import time

import numpy as np

import hpgr
from hpgr.bed.loaded import Beds, inputs_of, load_bed
from hpgr.grains import kernels, march, solve
from hpgr.run import run_scene
from studies.sweep import sweep


def median_ms(function, repeats=30):
    """Return the median time of a call in ms, after one that warms up."""
    function()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return 1e3 * statistics.median(times)


def kernel_ms(scene, bed):
    """Return the median time in the crushing kernel of one run, with fresh cells each time."""
    path = march.path(scene, scene.strength.log_stress(solve.crushing_stress(scene, bed)))
    lines, points = np.arange(path.log_stress.shape[0]), path.log_stress.shape[1]
    passage = kernels.Passage(lines, lines, 0 * lines, 0 * lines + points)
    work, record, times = kernels.make_work(scene.resolution.cells), kernels.Record(), []
    for replicate in range(31):
        parcels = march.first_cells(scene, 0, [(replicate, line, 0) for line in lines])
        start = time.perf_counter()
        kernels.crush(parcels, passage, path, march.ore(scene), work, record)
        times.append(time.perf_counter() - start)
    return 1e3 * statistics.median(times[1:])


def sweep_ratio(what, scene, gaps):
    """Print the time of a sweep on one thread and on two, in turns."""
    axes = {"rolls.gap": np.linspace(0.03, 0.1, gaps), "feed.top_size": np.linspace(0.03, 0.06, 20)}
    timed = {}
    for threads in (1, 2, 1, 2, 1, 2):
        start = time.perf_counter()
        sweep(scene, axes, threads=threads)
        timed.setdefault(threads, []).append(time.perf_counter() - start)
    one, two = (statistics.median(timed[threads]) for threads in (1, 2))
    print(f"sweep, {what}: {one:.2f} s on 1 thread, {two:.2f} s on 2 (ratio {one / two:.2f})")


def main():
    """Print every figure."""
    print(f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}")
    scene = hpgr.presets.paper().with_values({"resolution.record": "product"})
    inputs, beds = inputs_of(scene), Beds(1)
    print(f"simulate, 10 x 200 x 1,000, product: {median_ms(lambda: hpgr.simulate(scene)):.2f} ms")
    print(f"  of which the kernel:               {kernel_ms(scene, load_bed(inputs)):.2f} ms")
    print(f"  of which bed and stress:           {median_ms(lambda: load_bed(inputs)):.2f} ms")
    print(f"a case that shares its bed:          {median_ms(lambda: run_scene(scene, beds=beds)):.2f} ms")
    tessellated = median_ms(lambda: load_bed(inputs._replace(tessellated=True)), 5)
    print(f"tessellation, 10 x 200:              {tessellated - median_ms(lambda: load_bed(inputs)):.0f} ms")

    sweep_ratio("1,000 cases of 10 x 200 x 1,000, 50 gaps x 20 feeds", scene, 50)
    sweep_ratio("4,000 cases of 10 x 200 x 1,000, 200 gaps x 20 feeds", scene, 200)
    sweep_ratio("200 cases of 10 x 200 x 10,000", scene.with_values({"resolution.cells": 10_000}), 10)

    mixed = scene.with_values({"exchange": {}})
    seconds = median_ms(lambda: hpgr.simulate(mixed), 3) / 1e3
    swaps = float(hpgr.simulate(mixed)["swaps_per_cell"]) * 10 * 200 * 1000 / 2
    print(f"lattice, one residence time: {seconds:.2f} s, {1e9 * seconds / swaps:.1f} ns per swap, all else included")
    twice = mixed.with_values({"exchange.interval": 199, "resolution.snapshots": 2})
    print(f"lattice, two residence times: {median_ms(lambda: hpgr.simulate(twice), 1) / 1e3:.2f} s")
    still = scene.with_values({"exchange.mixing": 0, "exchange.segregation": 0})
    print(f"lattice without swaps, one residence time: {median_ms(lambda: hpgr.simulate(still), 3) / 1e3:.2f} s")

    large = scene.with_values({"resolution.cells": 1_000_000})
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    many = median_ms(lambda: hpgr.simulate(large), 1) / 1e3
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    march._LARGE, kept = float("inf"), march._LARGE
    alone = median_ms(lambda: hpgr.simulate(large), 1) / 1e3
    march._LARGE = kept
    print(f"10 x 200 x 1,000,000: {alone:.2f} s on one core, {many:.2f} s on all; {grown:.0f} MiB above before")

    for arguments in (["--help"], ["--no-plot", "--out", "outputs/benchmark.nc"], ["--out", "outputs/benchmark.nc"]):
        start = time.perf_counter()
        subprocess.run([sys.executable, "-m", "studies.gap_sweep", *arguments], check=True, capture_output=True)
        print(f"python -m studies.gap_sweep {' '.join(arguments)}: {time.perf_counter() - start:.2f} s")


if __name__ == "__main__":
    main()
