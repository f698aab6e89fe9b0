"""Overhead per case of sweeps from 10 to 20,000 cases, with the folder and without. Run: python -m benchmarks.scaling

The cases are nearly empty (stress only, 2 streamlines of 10 points), so what they take beside their own few tenths of
a millisecond is overhead. Every figure is the median of repeats in this one process, ratios are of figures measured
in turns; in brackets the same of processor time, which other work on the machine disturbs less. Start-up of the
default cluster, about a quarter of a second, is included.
"""

import gc
import os
import platform
import shutil
import statistics
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
import psutil

import hpgr
from hpgr.run import run_scene
from studies.sweep import netcdf, sweep

COUNTS = {10: 5, 100: 3, 1000: 3, 10_000: 1, 20_000: 1}  # cases: repeats


class Peak:
    """The largest resident memory of this process while it is open, above what it was, in MB."""

    def __enter__(self):
        gc.collect()
        self._process, self._open = psutil.Process(), True
        self._before = self.most = self._process.memory_info().rss
        self._thread = threading.Thread(target=self._watch)
        self._thread.start()
        return self

    def _watch(self):
        while self._open:
            self.most = max(self.most, self._process.memory_info().rss)
            time.sleep(0.02)

    def __exit__(self, *_):
        self._open = False
        self._thread.join()
        self.megabytes = (self.most - self._before) / 1e6


def axes_of(count):
    """Return two axes of gaps and feeds with `count` cases."""
    gaps = max(1, count // 20)
    return {"rolls.gap": np.linspace(0.03, 0.1, gaps), "feed.top_size": np.linspace(0.03, 0.06, count // gaps)}


def timed(function):
    """Return the wall time, the processor time of all threads, and what the function returned."""
    start, used = time.perf_counter(), time.process_time()
    result = function()
    return time.perf_counter() - start, time.process_time() - used, result


def own_ms(scene):
    """Return the time of one case alone: scene, bed and summary."""
    times = []
    for k in range(200):
        start = time.perf_counter()
        one = scene.with_values({"rolls.gap": 0.03 + 1e-4 * k})
        run_scene(one)
        times.append(time.perf_counter() - start)
    return 1e3 * statistics.median(times)


def main():
    """Print every figure."""
    print(f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}")
    scene = hpgr.presets.paper().with_values(
        {"resolution.streamlines": 2, "resolution.points": 10, "resolution.cells": 0}
    )
    sweep(scene, axes_of(40))
    print(f"a case alone: {own_ms(scene):.2f} ms")
    print("ms a case, wall (processor):")
    print(
        f"{'cases':>6} {'no folder':>16} {'folder':>16} {'ratio':>12} {'read back':>16}   peak MB: computing, reading"
    )
    home = Path(tempfile.mkdtemp(dir="."))
    try:
        for count, repeats in COUNTS.items():
            figures = []
            for _ in range(repeats):
                *without, _ = timed(lambda: sweep(scene, axes_of(count)))  # noqa: B023
                folder = home / "kept"
                with Peak() as computing:
                    *kept, _ = timed(lambda: sweep(scene, axes_of(count), folder=folder))  # noqa: B023
                with Peak() as reading:
                    *back, _ = timed(lambda: sweep(scene, axes_of(count), folder=folder))  # noqa: B023
                shutil.rmtree(folder)
                ratios = kept[0] / without[0], kept[1] / without[1]
                figures.append((*without, *kept, *ratios, *back, computing.megabytes, reading.megabytes))
            figures = [statistics.median(column) for column in zip(*figures, strict=True)]
            figures = [1e3 * value / count if k in (0, 1, 2, 3, 6, 7) else value for k, value in enumerate(figures)]
            line = "{:6d} {:8.2f} ({:5.2f}) {:8.2f} ({:5.2f}) {:5.2f} ({:4.2f}) {:8.3f} ({:5.3f}) {:8.0f} {:8.0f}"
            print(line.format(count, *figures), flush=True)
        full = hpgr.presets.paper()
        axes, folder = axes_of(1000), home / "full"
        ratios = []
        for _ in range(3):
            *without, _ = timed(lambda: sweep(full, axes))
            *kept, _ = timed(lambda: sweep(full, axes, folder=folder, recompute=True))
            ratios.append((*without, *kept, kept[0] / without[0], kept[1] / without[1]))
        figures = [statistics.median(column) for column in zip(*ratios, strict=True)]
        line = "{:.2f} ({:.2f}) without folder, {:.2f} ({:.2f}) with, ratio {:.2f} ({:.2f})"
        print(f"1,000 cases of the paper's scene, s: {line.format(*figures)}", flush=True)
        few = full.with_values({"resolution.points": 10, "resolution.cells": 10})
        axes = axes_of(20_000)
        with Peak() as computing:
            seconds, used, _ = timed(lambda: sweep(few, axes, folder=home / "many"))
        print(f"20,000 cases with summaries of full size: {seconds:.0f} s ({used:.0f} s)")
        print(f"  peak {computing.megabytes:.0f} MB above before")
        with Peak() as reading:
            seconds, used, result = timed(lambda: sweep(few, axes, folder=home / "many"))
        print(f"  read back and assembled: {seconds:.1f} s ({used:.1f} s)")
        print(f"  peak {reading.megabytes:.0f} MB above before, of which the result {result.nbytes / 1e6:.0f} MB")
        seconds, used, _ = timed(lambda: netcdf.write_dataset(result, home / "many.nc"))
        kept = sum(path.stat().st_size for path in (home / "many").iterdir())
        segments = len(list((home / "many").glob("*.seg")))
        print(f"  written in {seconds:.1f} s ({used:.1f} s): {(home / 'many.nc').stat().st_size / 1e6:.0f} MB")
        print(f"  finished cases on disk: {kept / 1e6:.0f} MB in {segments} segments")
    finally:
        shutil.rmtree(home)


if __name__ == "__main__":
    main()
