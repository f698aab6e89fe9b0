"""NetCDF files against the CF-1.11 compliance checker, where it is installed: pip install '.[cf]'."""

import json
import subprocess
import sys
from importlib.util import find_spec

import netCDF4
import numpy as np
import pytest
import xarray as xr
from support import paper
from test_accuracy import TINY

import hpgr
from studies import accuracy
from studies import paper as figures
from studies.sweep import netcdf, sweep

CHECKER = find_spec("compliance_checker") is not None
NO_CHECKER = "the compliance checker is not installed (pip install '.[cf]')"
# the checker subtracts the values of every coordinate, and gives this check up where they are text
TEXT = "check_coordinate_variables_strict_monotonicity: unsupported operand type(s) for -: 'str' and 'str'"
RUN = """
import json, sys
from compliance_checker.runner import CheckSuite

suite = CheckSuite()
suite.load_all_available_checkers()
found = {}
for path in sys.argv[1:]:
    with suite.load_dataset(path) as file:
        results, given_up = suite.run_all(file, ["cf:1.11"])["cf:1.11"]
    wrong = [result for result in results if result.value[0] < result.value[1]]
    found[path] = {
        "checks": len(results),
        "complaints": [message for result in wrong for message in result.msgs or [result.name]],
        "given_up": [f"{name}: {error}" for name, (error, *_) in given_up.items()],
    }
print(json.dumps(found))
"""


def datasets():
    small = {"resolution.streamlines": 2, "resolution.points": 21, "resolution.cells": 30}
    exchange = {"resolution.record": "distributions", "resolution.snapshots": 2, "exchange.startup": "feed"}
    return {
        "cells": hpgr.simulate(paper(small)),
        "distributions": hpgr.simulate(paper(small | exchange)),
        "stress": hpgr.simulate(paper(small | {"resolution.cells": 0})),
        "tolerance": hpgr.simulate(
            paper({"resolution.record": "product", "strength.cushioning": np.inf}), tolerance=0.1
        ),
        "gap_sweep": sweep(paper(small), {"rolls.gap": [0.04, 0.06, 1.2], "feed.top_size": [0.05, 0.06]}, replicates=2),
        "text_axis": sweep(paper(small), {"elasticity.integrator": ["euler", "increment"]}),
        "paper": figures.study(paper(small), 8),
        "accuracy": accuracy.study(paper(), TINY),
    }


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Every kind of file that is written, and one that should fail."""
    folder = tmp_path_factory.mktemp("files")
    for name, dataset in datasets().items():
        dataset.attrs.setdefault("history", "as the commands write it")
        netcdf.write_dataset(dataset, folder / f"{name}.nc")
    raw = hpgr.simulate(paper({"resolution.points": 11}))
    raw.to_netcdf(folder / "raw.nc", engine="netcdf4")  # with its time, which is none to the conventions
    return folder


@pytest.fixture(scope="module")
def checked(folder):
    """Return what the checker has to say on every file, by its name."""
    if not CHECKER:
        pytest.skip(NO_CHECKER)
    paths = sorted(folder.glob("*.nc"))
    done = subprocess.run([sys.executable, "-c", RUN, *map(str, paths)], capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    return {path.stem: found[str(path)] for path in paths}


NAMES = ("cells", "distributions", "stress", "tolerance", "gap_sweep", "text_axis", "paper", "accuracy")


@pytest.mark.parametrize("name", NAMES)
def test_checker_has_nothing_to_say(checked, name):
    """No errors, and no warnings or suggestions either; text coordinates make it give up one check."""
    assert checked[name]["complaints"] == []
    assert checked[name]["checks"] > 20
    assert checked[name]["given_up"] == ([TEXT] if name in ("text_axis", "accuracy") else [])


def test_checker_sees_what_is_wrong(checked):
    assert any("'time' should have standard_name" in message for message in checked["raw"]["complaints"])


def test_numbers_along_dimensions_are_in_order(folder):
    """The check that the checker gives up, of the coordinates that are numbers."""
    seen = 0
    for path in folder.glob("*.nc"):
        with netCDF4.Dataset(path) as file:
            for name in set(file.dimensions) & set(file.variables):
                if file[name].dtype is not str:
                    assert (np.diff(file[name][:]) > 0).all(), (path, name)
                    seen += 1
    assert seen > 10


def test_files_call_snapshots_so(folder):
    original = hpgr.simulate(paper({"resolution.streamlines": 2, "resolution.points": 21, "resolution.cells": 30}))
    with xr.open_dataset(folder / "cells.nc") as opened:
        opened.load()
    assert "time" not in opened.variables
    xr.testing.assert_identical(opened["size"].rename(snapshot="time").variable, original["size"].variable)
    # metrics take a file as it is
    for point in (-1, 12):
        found, exact = (hpgr.passing(one, [0.001, 0.02], point=point) for one in (opened, original))
        xr.testing.assert_identical(found.variable, exact.variable)
    assert float(hpgr.percentile_size(opened, 30, total=True)) == float(hpgr.percentile_size(original, 30, total=True))


def test_metrics_leave_the_startup_of_a_file_out(folder):
    with xr.open_dataset(folder / "distributions.nc") as opened:
        opened.load()
    assert opened["steady"].values.tolist() == [0, 0, 1, 1]
    found = hpgr.passing(opened, point=15).transpose("streamline", "sieve")
    exact = opened["mass_fraction"].values[2:, :, 15].astype(float).mean(axis=0).cumsum(axis=-1)
    np.testing.assert_allclose(found.values, exact, rtol=1e-5)
