"""The reduced lattice against the whole one, run after run: nice python -m benchmarks.exchange [runs] (default 30)

Every figure's difference of means over its standard error, z, for P50, P80, the fraction below 1 mm and the breaks of
every streamline and of all. Were both solvers the same, |z| would exceed 2 in 5 % of the figures. About 1 s a run and
scene, 5 s of the strongest.
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
    "strong exchange": {"exchange.segregation": 1.0, "exchange.mixing": 1.0},
}
FIGURES = ("P50", "P80", "below 1 mm", "breaks")
RECORDS = {"reduced lattice": "product", "lattice": "distributions"}


def figures(scene, seed, solver):
    """Return the figures of a run, figure by figure, each of all lines and then of all cells."""
    ds = hpgr.simulate(scene.with_values({"resolution.record": RECORDS[solver]}), seed=seed)
    assert ds.attrs["solver"] == solver
    passing = [hpgr.passing(ds, ["1 mm"], total=total) for total in (False, True)]
    breaks = ds["breaks_per_cell"], ds["breaks_per_cell"].mean()
    each = [[ds["p50"], ds["p50_total"]], [ds["p80"], ds["p80_total"]], passing, breaks]
    return np.hstack([np.ravel(part) for figure in each for part in figure])


def timed(scene, seeds, solver):
    """Return the figures for every seed, and the least processor time of a run, s."""
    found, used = [], []
    for seed in seeds:
        start = time.process_time()
        found.append(figures(scene, seed, solver))
        used.append(time.process_time() - start)
    return np.array(found), min(used)


def show(reduced, whole, lines):
    """Print z of every figure."""
    error = np.sqrt(reduced.var(axis=0, ddof=1) / len(reduced) + whole.var(axis=0, ddof=1) / len(whole))
    z = (reduced.mean(axis=0) - whole.mean(axis=0)) / error
    beyond, largest, spread = np.sum(abs(z) > 2), abs(z).max(), np.sqrt(np.mean(z * z))
    print(
        f"  |z| > 2 in {beyond} of {z.size} figures, largest {largest:.2f}, root mean square {spread:.2f};",
        f"largest standard error {np.max(error / whole.mean(axis=0)):.2%}",
    )
    for name, each in zip(FIGURES, z.reshape(len(FIGURES), lines + 1), strict=True):
        print(f"    {name}, line by line to the outermost, and of all:", *(f"{one:+.1f}" for one in each), flush=True)


def main():
    """Print z of every figure of each scene."""
    runs = int(sys.argv[1]) if len(sys.argv) > 1 else 30
    for name, values in SCENES.items():
        scene = hpgr.presets.paper().with_values({"exchange": {}}).with_values(values)
        reduced, short = timed(scene, range(runs), "reduced lattice")
        whole, long = timed(scene, range(runs, 2 * runs), "lattice")
        print(f"{name}, {runs} + {runs} runs of {short:.2f} and {long:.2f} s of processor time:")
        show(reduced, whole, scene.resolution.streamlines)


if __name__ == "__main__":
    main()
