import re

import numpy as np
import pytest
import xarray as xr
from support import feed_values, paper

from hpgr import Scene, presets, schema, simulate

RECORDS = ("cells", "distributions", "product", "stress only")
WITH_EXCHANGE = ("exchange",) if "exchange" in Scene.model_fields else ()


def dataset(record):
    if record == "stress only":
        return simulate(paper({"resolution.cells": 0}))
    if record == "exchange":
        return simulate(paper({"exchange.mixing": 0.1, "resolution.points": 11}))
    return simulate(paper({"resolution.record": record, "resolution.photographs": 2}))


@pytest.fixture(scope="module", params=RECORDS + WITH_EXCHANGE)
def ds(request):
    return dataset(request.param)


def test_every_variable_has_units_and_a_long_name(ds):
    for name in ds.variables:
        assert ds[name].attrs["units"], name
        assert len(ds[name].attrs["long_name"]) > 5, name


def test_every_variable_is_as_the_table_says(ds):
    for name, variable in ds.variables.items():
        entry = (schema.VARIABLES | schema.COORDINATES)[name]
        assert variable.dims == entry.dims
        assert variable.dtype == entry.dtype
        assert variable.attrs["units"] == entry.units
    assert set(ds.coords) <= set(schema.COORDINATES)


def test_table_holds_nothing_that_no_simulation_produces():
    produced = set().union(*(set(dataset(record).variables) for record in RECORDS + WITH_EXCHANGE))
    scene = paper({"resolution.record": "product", "material.cushioning": np.inf})
    produced |= set(simulate(scene, tolerance=0.1).variables)
    produced |= set(simulate(paper({"resolution.record": "product", "roll_width": {}})).variables)
    held = {"rolls.specific_pressing_force": 2.5e6, "resolution.cells": 0}
    produced |= set(simulate(presets.khd_pilot().with_values(held)).variables)
    assert produced == set(schema.VARIABLES) | set(schema.COORDINATES)


def test_units_are_read_by_pint():
    import pint

    registry = pint.UnitRegistry()
    for entry in (schema.VARIABLES | schema.COORDINATES).values():
        spelled = re.sub(r"([a-z])(-?\d)", r"\1^\2", entry.units).replace(" ", "*")
        registry.parse_units("" if spelled == "1" else spelled)


def test_dims_run_time_streamline_point_cell():
    assert dataset("cells")["size"].dims == ("time", "streamline", "point", "cell")
    assert dataset("distributions")["mass_fraction"].dims == ("time", "streamline", "point", "sieve")


def test_attributes_survive_netcdf(ds, tmp_path):
    for value in ds.attrs.values():
        assert isinstance(value, str | int | float | np.number)
        assert not isinstance(value, bool)
    path = tmp_path / "scene.nc"
    ds.to_netcdf(path, engine="netcdf4")
    with xr.open_dataset(path, engine="netcdf4", decode_times=False) as back:
        assert back.attrs == ds.attrs
        assert Scene.model_validate_json(back.attrs["scene"]) == Scene.model_validate_json(ds.attrs["scene"])
        assert set(back.variables) == set(ds.variables)
        assert np.array_equal(back["pressure"], ds["pressure"])


@pytest.mark.parametrize(
    "values",
    [
        {},
        {"material.cushioning": float("inf"), "material.weibull_modulus": float("inf")},
        feed_values(kind="table", table=((0.001, 0.0), (0.05, 100.0))),
    ],
    ids=["paper", "with inf", "with a table"],
)
def test_scene_attribute_rebuilds_the_scene(values):
    scene = paper(values | {"resolution.cells": 0})
    assert Scene.model_validate_json(simulate(scene).attrs["scene"]) == scene


def test_flags_are_masks_with_meanings():
    flags = schema.attributes("flags")
    masks = flags["flag_masks"].tolist()
    assert masks == [2**k for k in range(len(masks))]
    assert len(flags["flag_meanings"].split()) == len(masks)
    assert dict(zip(flags["flag_meanings"].split(), masks, strict=True)) == schema.FLAGS


def test_unknown_names_are_refused_and_none_is_left_out():
    with pytest.raises(KeyError, match="pressure_drop"):
        schema.to_dataset({"pressure_drop": 1.0}, {})
    assert "p50" not in schema.to_dataset({"throughput": 1.0, "p50": None}, {})


def test_values_are_cast_once_to_their_storage_type():
    made = schema.to_dataset({"throughput": 1.0, "flags": 3, "xi": np.array([0.1, 0.2])}, {"a": 1})
    assert made["throughput"].dtype == np.float32
    assert made["flags"].dtype == np.int32
    assert made["xi"].dtype == np.float64
    assert made.attrs == {"a": 1}
