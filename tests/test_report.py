import math
import re

import numpy as np
import pytest
import xarray as xr
from support import paper

from hpgr.schema import FLAGS
from studies import report
from studies.sweep import STATUS, sweep


@pytest.fixture(scope="module")
def swept():
    """Speed before gap: neither order of the alphabet nor of the scene."""
    base = paper({"resolution.streamlines": 3, "resolution.points": 40, "resolution.cells": 60})
    return sweep(base, {"rolls.speed": ["10 rpm", "20 rpm", "30 rpm"], "rolls.gap": ["60 mm", "40 mm"]}, replicates=3)


@pytest.fixture
def result(swept):
    return swept.copy(deep=True)


def lose(result, message, status="failed", **place):
    """Make cases of a result lost, as a sweep would."""
    for name in result.data_vars:
        if result[name].dtype.kind == "f":
            result[name][place] = np.nan
    result["status"][place] = STATUS[status]
    result["message"][place] = message


def replicates(*values):
    return xr.DataArray(np.array(values), dims="replicate")


def sieved(*rows):
    """A result of sieves 1, 10 and 100 mm."""
    total = xr.DataArray(np.array(rows), dims=("gap", "sieve"), coords={"sieve": [1e-3, 1e-2, 1e-1]})
    return xr.Dataset({"passing_total": total, "passing": total.expand_dims(streamline=2) * [[[1.0]], [[0.5]]]})


def test_percent_passing_by_hand():
    result = sieved([0.2, 0.6, 1.0], [0.0, 0.5, 0.9])
    # sqrt(10) mm is half way from 1 to 10 mm in the log
    assert report.percent_passing(result, math.sqrt(10) * 1e-3).values == pytest.approx([40, 25], rel=1e-12)
    assert report.percent_passing(result, 1e-2).values == pytest.approx([60, 50], rel=1e-12)
    assert report.percent_passing(result, 1e-3).values == pytest.approx([20, 0], abs=1e-12)
    assert report.percent_passing(result, 1e-1).values == pytest.approx([100, 90], rel=1e-12)
    quarter = 10 ** (1.25 - 3)  # a quarter of the way from 10 to 100 mm
    assert report.percent_passing(result, quarter).values == pytest.approx([70, 60], rel=1e-12)


def test_percent_passing_per_streamline():
    found = report.percent_passing(sieved([0.2, 0.6, 1.0]), 1e-2, total=False)
    assert found.dims == ("streamline", "gap")
    assert found.values[:, 0] == pytest.approx([60, 30], rel=1e-12)
    assert found.attrs == {"units": "percent", "long_name": "product below 10 mm"}


def test_percent_passing_of_lost_cases():
    found = report.percent_passing(sieved([np.nan] * 3, [0.2, 0.6, 1.0]), 2e-3)
    assert np.isnan(found.values[0])
    assert found.values[1] == pytest.approx(20 + 40 * math.log10(2), rel=1e-12)


def test_spread_is_the_sample_standard_deviation():
    # mean 7/3, squares 16/9 + 1/9 + 25/9 = 42/9, over n - 1 = 2
    assert report.spread(replicates(1.0, 2.0, 4.0)).item() == pytest.approx(math.sqrt(7 / 3), rel=1e-15)


def test_spread_of_equal_replicates_is_zero():
    values = replicates(0.1, 0.1, 0.1)
    assert values.std("replicate", ddof=1) > 0  # rounding of the mean, which must not be shown
    assert report.spread(values).item() == 0


def test_spread_of_one_replicate_is_unknown():
    assert np.isnan(report.spread(replicates(1.0)))
    assert np.isnan(report.spread(replicates(1.0, np.nan)))
    assert np.isnan(report.spread(replicates(np.nan, np.nan)))
    assert report.spread(replicates(1.0, np.nan, 3.0)).item() == pytest.approx(math.sqrt(2), rel=1e-15)


def test_figures_are_in_the_units_people_use(result):
    found = report.figures(result, 1e-3)
    scale = {"throughput [t/h]": ("throughput", 3.6), "P50 [mm]": ("p50_total", 1e3), "P80 [mm]": ("p80_total", 1e3)}
    scale["peak pressure [MPa]"] = ("peak_pressure", 1e-6)
    assert set(found) == {*scale, "below 1 mm [%]"}
    for heading, (name, factor) in scale.items():
        assert found[heading].values == pytest.approx(result[name].values.astype(float) * factor, rel=1e-14)
    k = int(np.flatnonzero(np.isclose(result["sieve"], 1e-3))[0])
    exact = 100 * result["passing_total"].isel(sieve=k).astype(float)
    assert found["below 1 mm [%]"].values == pytest.approx(exact.values, rel=1e-12)


def test_axes_keep_their_order(result):
    assert report.axes_of(result) == ["roll_speed", "gap"]


def test_table_holds_every_operating_point_in_order(result):
    product, machine = report.table(result, 1e-3).split("\n\n")
    *machine, last = machine.splitlines()
    assert last == "(mean ± standard deviation of 3 replicates)"
    for lines in (product.splitlines(), machine):
        assert len({len(line) for line in lines}) == 1  # columns are aligned
        assert lines[0].split("  ")[0] == "roll speed [rpm]"
        rows = [line.split()[:2] for line in lines[1:]]
        assert rows == [["10", "60"], ["10", "40"], ["20", "60"], ["20", "40"], ["30", "60"], ["30", "40"]]
        assert all("±" in line for line in lines[1:])


def test_table_has_force_power_and_energy_in_the_units_people_use(result):
    one = result.isel(roll_speed=[0], gap=[0], replicate=[0])
    heading, row = report.table(one, 1e-3).split("\n\n")[1].splitlines()
    shown = dict(zip(re.split(r"\s{2,}", heading.strip()), row.split(), strict=True))
    for name, (column, factor) in {
        "specific_pressing_force": ("Fsp [N/mm²]", 1e-6), "pressing_force": ("force [kN]", 1e-3),
        "torque": ("torque [kN m]", 1e-3), "power": ("power [kW]", 1e-3), "specific_energy": ("W [kWh/t]", 1 / 3600),
        "specific_throughput": ("mdot [t s/(h m³)]", 3.6), "nip_angle": ("nip [deg]", 180 / np.pi),
        "force_angle": ("beta [deg]", 180 / np.pi),
    }.items():  # fmt: skip
        assert float(shown[column]) == pytest.approx(float(one[name].item()) * factor, rel=1e-3), name


def test_table_of_one_replicate_has_no_spread(result):
    assert "±" not in report.table(result.isel(replicate=[0]), 1e-3)


def test_table_with_lost_cases(result):
    lose(result, "boom", roll_speed=0, gap=0)
    lose(result, "boom", roll_speed=1, gap=0, replicate=[0, 2])
    lines = report.table(result, 1e-3).splitlines()
    assert lines[1].split() == ["10", "60", "-", "-", "-", "-", "-"]
    alone = result["p80_total"].values[1, 0, 1] * 1e3
    assert lines[3].split()[4] == f"{alone:.4g}"
    assert "±" not in lines[3]  # one replicate is left, and has no spread
    assert "±" in lines[2]


def test_table_without_results(result):
    lose(result, "boom")
    assert report.table(result, 1e-3) == "no case holds a result"
    assert not report.any_result(result)


def test_table_without_axes(swept):
    base = paper({"resolution.streamlines": 2, "resolution.points": 20, "resolution.cells": 0})
    product, machine = (part.splitlines() for part in report.table(sweep(base, {}), 1e-3).split("\n\n"))
    assert product[0].split("  ") == ["throughput [t/h]", "peak pressure [MPa]"]
    assert machine[0].startswith("Fsp [N/mm²]")
    assert len(product) == len(machine) == 2


def test_lost_cases_are_grouped_by_place_and_reason(result):
    assert report.lost_cases(result) == []
    lose(result, "boom", roll_speed=1, gap=0, replicate=[0, 2])
    lose(result, "other", roll_speed=1, gap=0, replicate=1)
    lose(result, "too wide", "refused", roll_speed=2, gap=1)
    assert report.lost_cases(result) == [
        "failed: roll speed 20 rpm, gap 60 mm, 2 of 3 replicates: boom",
        "failed: roll speed 20 rpm, gap 60 mm, 1 of 3 replicates: other",
        "refused: roll speed 30 rpm, gap 40 mm, 3 of 3 replicates: too wide",
    ]


def test_lost_cases_of_a_text_axis():
    base = paper({"resolution.streamlines": 2, "resolution.points": 20, "resolution.cells": 0})
    result = sweep(base, {"stress.integrator": ["euler"], "rolls.gap": ["1.2 m"]})
    [line] = report.lost_cases(result)
    assert line.startswith("refused: stress integrator euler, gap 1200 mm, 1 of 1 replicates: rolls.gap: got 1200 mm")


def test_notes(result):
    result["flags"][:] = 0
    result["notes"][:] = "no_breakage: whole\nfew_cells: too few"
    assert report.notes(result) == []
    result["flags"][{"roll_speed": 0, "gap": 1, "replicate": 2}] = FLAGS["no_breakage"] | FLAGS["few_cells"]
    result["flags"][{"roll_speed": 2}] = FLAGS["few_cells"]
    assert report.notes(result) == [
        "flag no_breakage at 1 of 6 operating points; the first: whole",
        "flag few_cells at 3 of 6 operating points; the first: too few",
    ]
    result.attrs["scene"] = result.attrs["scene"].replace('"note":""', '"note":"not calibrated"')
    assert report.notes(result)[0] == "note: not calibrated"


def test_labels(result):
    assert report.axis_label(result["roll_speed"]) == "roll speed [rpm]"
    assert report.axis_label(result["gap"]) == "gap [mm]"
    assert report.shown_values(result["roll_speed"]) == pytest.approx([10, 20, 30], rel=1e-12)
    plain = xr.DataArray(["a"], dims="stress_integrator", name="stress_integrator", attrs={"units": "1"})
    assert report.axis_label(plain) == "stress integrator"
    assert report.shown_values(plain).tolist() == ["a"]
