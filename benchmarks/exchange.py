"""The reduced lattice against the whole one, run after run: nice python -m benchmarks.exchange [runs] (default 30)

Every figure's difference of means over its standard error, z, for P50, P80 and breaks of every streamline and of the
whole product; about 3 s a run and scene. Were both solvers the same, |z| would exceed 2 in 5 % of the figures.
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
LINES, TOTALS = ("p50", "p80", "breaks_per_cell"), ("p50_total", "p80_total")


def figures(scene, seed):
    """Return the figures of a run, those of lines first, the total breaks last, and its processor time, s."""
    start = time.process_time()
    ds = hpgr.simulate(scene, seed=seed)
    used = time.process_time() - start
    return np.hstack(
        [*(ds[name] for name in LINES), *(ds[name] for name in TOTALS), ds["breaks_per_cell"].mean()]
    ), used


def main():
    """Print z of every figure of each scene."""
    runs = int(sys.argv[1]) if len(sys.argv) > 1 else 30
    for name, values in SCENES.items():
        scene = hpgr.presets.paper().with_values({"exchange": {}}).with_values(values)
        found, used = [], []
        for number, record in enumerate(("product", "distributions")):  # of distributions the whole lattice is needed
            each = [figures(scene.with_values({"resolution.record": record}), number * runs + k) for k in range(runs)]
            found.append(np.array([figure for figure, _ in each]))
            used.append(min(seconds for _, seconds in each))
        reduced, whole = found
        error = np.sqrt((reduced.var(axis=0, ddof=1) + whole.var(axis=0, ddof=1)) / runs)
        z = (reduced.mean(axis=0) - whole.mean(axis=0)) / error
        print(f"{name}, {runs} + {runs} runs of {used[0]:.2f} and {used[1]:.2f} s of processor time:")
        beyond, largest, spread = np.sum(abs(z) > 2), abs(z).max(), np.sqrt(np.mean(z * z))
        print(
            f"  |z| > 2 in {beyond} of {z.size} figures, largest {largest:.2f}, root mean square {spread:.2f};", end=" "
        )
        print(f"largest standard error {np.max(error / whole.mean(axis=0)):.2%}")
        lines = scene.resolution.streamlines
        for k, what in enumerate(LINES):
            print(
                f"  {what}, line by line to the outermost:", *(f"{one:+.1f}" for one in z[k * lines : (k + 1) * lines])
            )
        print("  P50, P80 and breaks of all:", *(f"{one:+.1f}" for one in z[-3:]), flush=True)


if __name__ == "__main__":
    main()
