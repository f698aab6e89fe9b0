"""The reduced lattice against the whole one, run after run: nice python -m benchmarks.exchange [runs] (default 30)

Every figure's difference of means over its standard error, z, for P50, P80 and the fraction below 1 mm of every
streamline and of all. Were both solvers the same, |z| would exceed 2 in 5 % of the figures. The whole lattice is read
when it is steady and once more one residence time later: were it not steady, the first would differ. About 3 s a run
and scene.
"""

import sys
import time

import numpy as np

import hpgr

TWO_SIZES = {"kind": "table", "table": ((0.0099, 0.0), (0.01, 50.0), (0.0399, 50.0), (0.04, 100.0))}
SCENES = {
    "default": {},
    "strong mixing": {"exchange.mixing": 1.0},
    "two sizes that segregate": {"feed": TWO_SIZES, "exchange.segregation": 1.0, "exchange.mixing": 0.02},
}
FIGURES = ("P50", "P80", "below 1 mm")


def figures(sizes):
    """Return the figures of sizes (streamline, cell), m, figure by figure, each of all lines and then of all cells."""
    rows = [*sizes, sizes.ravel()]
    return np.ravel([[*np.quantile(row, (0.5, 0.8)), np.mean(row <= np.float32(0.001))] for row in rows], order="F")


def reduced_figures(scene, seed):
    """Return the figures of a run of the reduced lattice, of one snapshot."""
    ds = hpgr.simulate(scene, seed=seed)
    assert ds.attrs["solver"] == "reduced lattice"
    passing = [hpgr.passing(ds, ["1 mm"], total=total) for total in (False, True)]
    each = [[ds["p50"], ds["p50_total"]], [ds["p80"], ds["p80_total"]], passing]
    return np.hstack([np.ravel(part) for figure in each for part in figure])


def whole_figures(scene, seed):
    """Return the figures of a run of the whole lattice, (snapshot, figure)."""
    grid = {"record": "cells", "snapshots": 2}
    ds = hpgr.simulate(scene.with_values({"resolution": grid, "exchange.interval": scene.resolution.points}), seed=seed)
    assert ds.attrs["solver"] == "lattice"
    return [figures(snapshot) for snapshot in ds["size"].values[:, :, -1]]


def timed(function, scene, seeds):
    """Return what a function gives for every seed, and its least processor time, s."""
    found, used = [], []
    for seed in seeds:
        start = time.process_time()
        found.append(function(scene, seed))
        used.append(time.process_time() - start)
    return np.array(found), min(used)


def show(what, reduced, whole, lines):
    """Print z of every figure."""
    error = np.sqrt(reduced.var(axis=0, ddof=1) / len(reduced) + whole.var(axis=0, ddof=1) / len(whole))
    z = (reduced.mean(axis=0) - whole.mean(axis=0)) / error
    beyond, largest, spread = np.sum(abs(z) > 2), abs(z).max(), np.sqrt(np.mean(z * z))
    print(
        f"  {what}: |z| > 2 in {beyond} of {z.size} figures, largest {largest:.2f}, root mean square {spread:.2f};",
        end=" ",
    )
    print(f"largest standard error {np.max(error / whole.mean(axis=0)):.2%}")
    for name, each in zip(FIGURES, z.reshape(len(FIGURES), lines + 1), strict=True):
        print(f"    {name}, line by line to the outermost, and of all:", *(f"{one:+.1f}" for one in each), flush=True)


def main():
    """Print z of every figure of each scene."""
    runs = int(sys.argv[1]) if len(sys.argv) > 1 else 30
    for name, values in SCENES.items():
        scene = hpgr.presets.paper().with_values({"exchange": {}, "resolution.record": "product"}).with_values(values)
        reduced, short = timed(reduced_figures, scene, range(runs))
        whole, long = timed(whole_figures, scene, range(runs, 2 * runs))
        print(f"{name}, {runs} + {runs} runs of {short:.2f} and {long:.2f} s of processor time:")
        for k, which in enumerate(("first snapshot", "a residence time later")):
            show(which, reduced, whole[:, k], scene.resolution.streamlines)


if __name__ == "__main__":
    main()
