import re

import numpy as np
import pint
import pytest
from support import paper

from hpgr import presets, simulate
from hpgr.results import flags, schema

TABLE = schema.COORDINATES | schema.VARIABLES
SCENES = {
    "stress only": {"resolution.cells": 0},
    "exchange": {"exchange.mixing": 0.1, "resolution.points": 11},
    "roll width": {"resolution.record": "product", "roll_width": {}},
    **{name: {"resolution.record": name, "resolution.snapshots": 2} for name in ("cells", "distributions", "product")},
}


@pytest.fixture(scope="module")
def datasets():
    found = {name: simulate(paper(values)) for name, values in SCENES.items()}
    smooth = paper({"resolution.record": "product", "strength.cushioning": np.inf})
    held = {"rolls.specific_pressing_force": 2.5e6, "resolution.cells": 0}
    found["tolerance"] = simulate(smooth, tolerance=0.1)
    found["floating gap"] = simulate(presets.khd_pilot().with_values(held))
    return found


def test_every_variable_is_as_the_table_says(datasets):
    for dataset in datasets.values():
        for name, variable in dataset.variables.items():
            entry = TABLE[name]
            assert (variable.dims, variable.dtype, variable.attrs["units"]) == (entry.dims, entry.dtype, entry.units)
        assert set(dataset.coords) <= set(schema.COORDINATES)
        for value in dataset.attrs.values():  # as NetCDF can hold them
            assert isinstance(value, str | int | float | np.number)
            assert not isinstance(value, bool)
    assert datasets["cells"]["size"].dims == ("time", "streamline", "point", "cell")
    assert datasets["distributions"]["mass_fraction"].dims == ("time", "streamline", "point", "sieve")


def test_table_holds_nothing_that_no_simulation_produces(datasets):
    assert set().union(*(dataset.variables for dataset in datasets.values())) == set(TABLE)


def test_names_are_short_enough_for_an_axis_and_units_are_read_by_pint():
    registry = pint.UnitRegistry()
    for name, entry in (TABLE | schema.SWEEP).items():
        assert 4 < len(entry.long_name) <= 40, name
        assert entry.attributes().keys() >= ({"long_name", "units"} if entry.dtype is not object else {"long_name"})
        spelled = re.sub(r"([a-z])(-?\d)", r"\1^\2", entry.units).replace(" ", "*")
        registry.parse_units("" if spelled == "1" else spelled)


def test_flags_are_masks_with_meanings():
    found = schema.attributes("flags")
    masks, meanings = found["flag_masks"].tolist(), found["flag_meanings"].split()
    assert masks == [2**k for k in range(len(masks))]
    assert dict(zip(meanings, masks, strict=True)) == flags.BITS
    assert flags.names(sum(masks)) == meanings
    assert all(flag.meaning for flag in flags.FLAGS)


def test_unknown_names_are_refused_none_is_left_out_and_values_are_cast_to_their_storage_type():
    with pytest.raises(KeyError, match="pressure_drop"):
        schema.to_dataset({"pressure_drop": 1.0}, {})
    own = {"steps": schema.Variable(("steps",), "1", "time steps", dtype=np.int32)}
    values = {"throughput": 1.0, "flags": 3, "p50": None, "steps": [1, 2]}
    made = schema.to_dataset(values, {"a": 1}, own)
    stored = {name: variable.dtype for name, variable in made.variables.items()}
    assert stored == {"throughput": np.float32, "flags": np.int32, "steps": np.int32}
    assert list(made.coords) == ["steps"]
    assert made.attrs == {"a": 1}


def test_datasets_of_equal_names_and_shapes_share_nothing_that_can_be_written_to():
    def made():
        return schema.to_dataset({"p50": np.arange(3.0), "x": np.ones((3, 2)), "sieve": [1.0, 2.0], "power": 5.0}, {})

    spoilt, wanted = made(), made().copy(deep=True)
    assert list(spoilt.coords) == ["x", "sieve"]
    for variable in spoilt.variables.values():
        if variable.values.flags.writeable:
            variable.values[...] = -1
        variable.attrs.clear()
        variable.encoding["dtype"] = "int8"
    assert spoilt["p50"].values.tolist() == [-1, -1, -1]
    spoilt.attrs["a"] = 1
    del spoilt["power"]
    assert made().identical(wanted)
    assert made()["p50"].encoding == {}


def test_axes_and_datasets_have_their_attributes_from_here():
    axis = schema.field_axis("rolls.gap", "gap")
    assert axis.dims == ("gap",)
    assert axis.attributes().items() >= {"units": "m", "scene_field": "rolls.gap"}.items()
    found = schema.dataset_attributes("A study", seed=3)
    assert (found["Conventions"], found["seed"]) == ("CF-1.11", 3)
    assert "numba " in found["versions"]
