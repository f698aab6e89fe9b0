import math
import re

import numpy as np
import pytest
import xarray as xr
from support import lose, paper

from hpgr.results.flags import BITS
from studies.show import report
from studies.sweep import sweep


@pytest.fixture(scope="module")
def swept():
    """Speed before gap: neither order of the alphabet nor of the scene."""
    base = paper({"resolution.streamlines": 3, "resolution.points": 40, "resolution.cells": 60})
    return sweep(base, {"rolls.speed": ["10 rpm", "20 rpm", "30 rpm"], "rolls.gap": ["60 mm", "40 mm"]}, replicates=3)


@pytest.fixture
def result(swept):
    return swept.copy(deep=True)


def replicates(*values):
    return xr.DataArray(np.array(values), dims="replicate")


def test_aligned_columns_and_markdown():
    rows = [["a", "1.5"], ["long name", "-12"]]
    assert report.aligned(["what", "x"], rows, words=1) == "what         x\na          1.5\nlong name  -12"
    markdown = report.aligned(["what", "x"], rows, markdown=True).splitlines()
    assert markdown[:3] == ["| what | x |", "| --- | ---: |", "| a | 1.5 |"]


def test_percent_passing_by_hand():
    """Sieves of 1, 10 and 100 mm; the second case is lost."""
    rows = np.array([[0.2, 0.6, 1.0], [np.nan] * 3])
    total = xr.DataArray(rows, dims=("gap", "sieve"), coords={"sieve": [1e-3, 1e-2, 1e-1]})
    result = xr.Dataset({"passing_total": total, "passing": total.expand_dims(streamline=2) * [[[1.0]], [[0.5]]]})
    # sqrt(10) mm is half way from 1 to 10 mm in the log, 10**1.25 a quarter from 10 to 100
    for sieve, percent in {1e-3: 20, 10**-2.5: 40, 1e-2: 60, 10**-1.75: 70, 1e-1: 100}.items():
        found = report.percent_passing(result, sieve)
        assert found.values == pytest.approx([percent, np.nan], rel=1e-12, nan_ok=True)
    found = report.percent_passing(result, 1e-2, total=False)
    assert found.dims == ("streamline", "gap")
    assert found.values[:, 0] == pytest.approx([60, 30], rel=1e-12)
    assert found.attrs == {"units": "percent", "long_name": "product below 10 mm"}


def test_spread_is_the_sample_standard_deviation():
    # mean 7/3, squares 16/9 + 1/9 + 25/9 = 42/9, over n - 1 = 2
    assert report.spread(replicates(1.0, 2.0, 4.0)).item() == pytest.approx(math.sqrt(7 / 3), rel=1e-15)
    assert report.spread(replicates(1.0, np.nan, 3.0)).item() == pytest.approx(math.sqrt(2), rel=1e-15)
    equal = replicates(0.1, 0.1, 0.1)
    assert equal.std("replicate", ddof=1) > 0  # rounding of the mean, which must not be shown
    assert report.spread(equal).item() == 0
    assert np.isnan(report.spread(replicates(1.0)))
    assert np.isnan(report.spread(replicates(1.0, np.nan)))


def test_table_holds_what_varies_in_the_units_people_use(result):
    assert report.axes_of(result) == ["roll_speed", "gap"]
    *parts, last = report.table(result, 1e-3).split("\n\n")
    *last, replicates = last.splitlines()
    assert replicates == "(mean ± standard deviation of 3 replicates)"
    units = {
        "throughput [t/h]": ("throughput", 3.6),
        "P50 [mm]": ("p50_total", 1e3),
        "P80 [mm]": ("p80_total", 1e3),
        "W [kWh/t]": ("specific_energy", 1 / 3600),
        "peak pressure [MPa]": ("peak_pressure", 1e-6),
        "Fsp [N/mm²]": ("specific_pressing_force", 1e-6),
        "force [kN]": ("pressing_force", 1e-3),
        "power [kW]": ("power", 1e-3),
        "torque [kN m]": ("torque", 1e-3),
        "mdot [t s/(h m³)]": ("specific_throughput", 3.6),
        "nip [deg]": ("nip_angle", 180 / np.pi),
        "beta [deg]": ("force_angle", 180 / np.pi),
    }
    below = 100 * result["passing_total"].sel(sieve=1e-3).astype(float)
    seen = set()
    for lines in (*(part.splitlines() for part in parts), last):
        headings, *rows = (re.split(r"\s{2,}", line.strip()) for line in lines)
        assert [row[:2] for row in rows] == [[speed, gap] for speed in ("10", "20", "30") for gap in ("60", "40")]
        for k, heading in enumerate(headings[2:], start=2):
            name, factor = units.get(heading, (None, None))
            one = (below if name is None else result[name].astype(float) * factor).isel(roll_speed=0, gap=1)
            mean, _, deviation = rows[1][k].partition(" ± ")
            assert float(mean) == pytest.approx(float(one.mean()), rel=1e-3), heading
            assert float(deviation or 0) == pytest.approx(float(report.spread(one)), rel=0.1), heading
            assert deviation != "0"
        seen |= set(headings)
    assert seen == {"roll speed [rpm]", "gap [mm]", "below 1 mm [%]", *units}
    assert "±" not in report.table(result.isel(replicate=[0]), 1e-3)
    slow = report.table(result.isel(roll_speed=[0]), 1e-3)
    assert "the same everywhere: roll speed [rpm] 10" in slow


def test_a_long_table_fits_a_screen():
    base = paper({"resolution.streamlines": 1, "resolution.points": 20, "resolution.cells": 10})
    result = sweep(base, {"rolls.gap": np.linspace(0.03, 0.1, 60)})
    lines = report.table(result, 1e-3).splitlines()
    assert len(lines) <= 30
    assert max(map(len, lines)) <= 120
    assert "11 of 60 operating points, evenly chosen; the file has all, and --csv writes them" in lines
    rows = report.plant_table(result, 1e-3)
    assert len(rows) == 60
    assert list(rows)[:4] == ["gap [mm]", "replicates", "throughput [t/h]", "throughput sd [t/h]"]
    assert rows.iloc[0, :3].tolist() == pytest.approx([30, 1, 3.6 * float(result["throughput"][0, 0])])


def test_table_with_lost_cases(result):
    lose(result, "boom", roll_speed=0, gap=0)
    lose(result, "boom", roll_speed=1, gap=0, replicate=[0, 2])
    lines = report.table(result, 1e-3).splitlines()
    assert set(lines[1].split()[2:]) == {"-"}
    alone = result["p80_total"].values[1, 0, 1] * 1e3
    assert lines[3].split()[4] == f"{alone:.4g}"
    assert "±" not in lines[3]  # one replicate is left, and has no spread
    assert "±" in lines[2]
    lose(result, "boom")
    assert report.table(result, 1e-3) == "no case holds a result"


def test_table_without_axes_and_cells():
    base = paper({"resolution.streamlines": 2, "resolution.points": 20, "resolution.cells": 0})
    heading, _, *_ = report.table(sweep(base, {}), 1e-3).splitlines()
    assert heading.startswith("throughput [t/h]  W [kWh/t]  peak pressure [MPa]  Fsp [N/mm²]")


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


def test_remarks_tell_limits_and_the_scene_s_own(result):
    result["flags"][:] = 0
    result["diagnostics"][:] = "no_breakage: whole\nfew_cells: too few"
    assert report.remarks(result) == []
    result["flags"][{"roll_speed": 0, "gap": 1, "replicate": 2}] = BITS["no_breakage"] | BITS["few_cells"]
    result["flags"][{"roll_speed": 2}] = BITS["few_cells"]
    result.attrs["scene"] = result.attrs["scene"].replace('"remark":""', '"remark":"not calibrated"')
    told = [
        "flag no_breakage at 1 of 6 operating points; the first: whole",
        "flag few_cells at 3 of 6 operating points; the first: too few",
    ]
    remark, line = report.remarks(result)
    assert remark == "remark: not calibrated"
    assert line.endswith("at how many of 6 operating points: no breakage (1), few cells (3)")
    assert report.remarks(result, every_flag=True) == [remark, *told]


def test_change_is_that_of_pairs(result):
    """Half the sizes at 40 mm, to within a spread that replicates do not share: -50 % from wide to narrow."""
    noise = xr.DataArray([0.99, 1.0, 1.01], dims="replicate")
    result["p80_total"] = xr.ones_like(result["p80_total"]) * 0.001 * noise
    result["p80_total"][{"gap": 0}] *= 2
    assert report.change(result, "rolls.gap") == [
        "P80 changes by +100 ± 0 % from gap 40 mm to gap 60 mm (mean ± standard error of pairs), "
        "on average over roll speed."
    ]


def test_a_value_meant_in_another_unit_is_told_before_the_limits():
    """A bare 20 in a scene file is 191 rpm; the table alone does not show it."""
    base = paper({"resolution.cells": 0, "resolution.points": 30, "rolls.speed": 20})
    first, second = report.flag_line(sweep(base, {"rolls.gap": ["50 mm", "60 mm"]}))
    assert first.startswith("check the unit: ")
    assert "rolls.speed 20 is read in rad s-1, 191 rpm; for 20 rpm write '20 rpm'" in first
    assert second.startswith(
        "limits of the model that were hit, at how many of 2 operating points: unusual machine (2)"
    )
