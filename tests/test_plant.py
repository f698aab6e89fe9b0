"""`ds.hpgr`: units of a plant, table and figure; and what xarray makes of a sweep's files."""

import numpy as np
import pytest
import xarray as xr
from support import plain_industrial

import hpgr
import studies.show.plant  # noqa: F401
from studies.show.report import operating_points
from studies.sweep import netcdf, sweep


@pytest.fixture(scope="module")
def sweeps():
    small = {"resolution.streamlines": 2, "resolution.points": 40, "resolution.cells": 50}
    base = plain_industrial().with_values(small)
    return [
        sweep(base, {name: values}, 2)
        for name, values in {"rolls.gap": ["50 mm", "55 mm"], "rolls.speed": ["10 rpm", "13 rpm"]}.items()
    ]


def test_plant_units(sweeps):
    gaps, speeds = (result.hpgr.plant_units() for result in sweeps)
    assert gaps["gap"].values.tolist() == [50, 55]
    assert speeds.sel(roll_speed=13)["gap"] == 55
    for name, unit, factor in (
        ("throughput", "t/h", 3.6),
        ("specific_pressing_force", "N/mm^2", 1e-6),
        ("specific_energy", "kWh/t", 1 / 3600),
        ("specific_throughput", "t s h-1 m-3", 3.6),
    ):
        assert gaps[name].attrs["units"] == unit
        np.testing.assert_allclose(gaps[name], factor * sweeps[0][name], rtol=1e-6)
    assert sweeps[0]["gap"].attrs["units"] == "m"


def test_reduction_ratio_of_a_sweep_is_that_of_its_cases(sweeps):
    """The feed is the same everywhere; where it is not, the base scene's must not be taken for all."""
    base = hpgr.Scene.model_validate_json(sweeps[0].attrs["scene"])
    alone = hpgr.reduction_ratio(hpgr.simulate(base.with_values({"rolls.gap": "55 mm"})), total=True)
    assert hpgr.reduction_ratio(sweeps[0], total=True).sel(gap=0.055, replicate=0) == pytest.approx(
        float(alone), rel=1e-6
    )
    for space in ({"scene": {"one": base, "same": base}}, {"feed.top_size": ["30 mm", "40 mm"]}):
        with pytest.raises(ValueError, match=r"the Dataset sweeps \w+, but holds the feed of its base"):
            hpgr.reduction_ratio(sweep(base, space))


def test_table_and_figure(sweeps):
    assert "throughput [t/h]" in sweeps[0].hpgr.table("6 mm")
    assert sweeps[0].hpgr.plot().axes
    for wrong in (sweeps[0].hpgr.plant_units(), sweeps[0].drop_attrs()):
        with pytest.raises(ValueError, match="must be one; such as sweep"):
            wrong.hpgr.table()
    with pytest.raises(ValueError, match="got sieves in another unit; must be in m"):
        hpgr.reduction_ratio(sweeps[0].hpgr.plant_units())
    with pytest.raises(ValueError, match="got a sweep of no axis"):
        sweeps[0].assign_attrs(axes="").hpgr.plot()
    with pytest.raises(ValueError, match="sieve: got 3; not a number and a unit"):
        sweeps[0].hpgr.plot(3)


def test_means_leave_flags_and_words_out(sweeps):
    assert not {"flags", "status", "message", "diagnostics"} & set(sweeps[0].mean("replicate").variables)


def test_sweeps_open_together(sweeps, tmp_path):
    paths = [tmp_path / "gaps.nc", tmp_path / "speeds.nc"]
    for result, path in zip(sweeps, paths, strict=True):
        netcdf.write_dataset(result, path)
    with xr.open_mfdataset(
        paths, combine="nested", concat_dim="operating_point", data_vars="all", preprocess=operating_points
    ) as both:
        assert both["gap"].values.round(3).tolist() == [0.05, 0.055, 0.055, 0.055]
        one, other = (both["p80_total"].isel(operating_point=k).values for k in (1, 3))  # the same in both
    assert np.array_equal(one, other)


def test_quantities_with_units(sweeps):
    pytest.importorskip("pint_xarray")
    pytest.importorskip("cf_xarray.units")
    assert str(sweeps[0].pint.quantify()["throughput"].pint.to("t/h").pint.units) == "metric_ton / hour"
