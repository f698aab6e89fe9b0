"""What every result satisfies, over scenes that hypothesis chooses (derandomised, see conftest.py: the same every run);
that the checker sees each kind of fault; and the scale relations, bit for bit.
"""

import json
import math
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import paper, sized

from hpgr import simulate
from hpgr.fields import values_of
from studies.guard import judge, ranges
from studies.guard.invariants import INVARIANTS, violations

INF = math.inf
SMALL = {
    "resolution.streamlines": 2,
    "resolution.points": sized(31, 16),
    "resolution.cells": sized(16, 6),
    "rolls.entry_gap": 0.5,
}
KNOWN = {
    name: known
    for name, known in ranges.numeric_fields().items()
    if name.partition(".")[0] not in ("resolution", "feed") and name not in ("elasticity.substeps", "exchange.interval")
}

CHOSEN = ("resolution.record", "elasticity.integrator", "strength.stress")


@settings(max_examples=sized(40, 10))
@given(
    st.dictionaries(st.sampled_from(sorted(KNOWN)), st.floats(0, 1), max_size=8),
    st.sampled_from(sorted(judge.SAMPLES["feed"])),
    st.fixed_dictionaries({name: st.sampled_from(ranges.choices()[name]) for name in CHOSEN}),
    st.integers(1, 3),
    st.booleans(),
)
def test_any_scene_ends_well_flagged_or_refused(places, kind, chosen, snapshots, exchange):
    values = {name: KNOWN[name].at(place) for name, place in places.items()}
    values = {name: value for name, value in values.items() if exchange or not name.startswith("exchange.")}
    values |= chosen | {"resolution.snapshots": snapshots, "feed.kind": kind}
    values |= {"exchange.interval": 2} if exchange else {"exchange": None}
    for hosted in judge.hosts(values)[:1]:  # none, where the fields are of laws that exclude each other
        outcome = judge.judge(SMALL | hosted)
        assert outcome.kind != "fault", outcome.message


@given(st.floats(0, 1), st.floats(0, 1), st.floats(1e-3, 1e3), st.sampled_from([0, 1, 2, 3, 17]), st.booleans())
def test_any_rolls_end_well_flagged_or_refused(gap_place, rise_place, diameter, cells, exchange):
    gap = diameter * 10 ** (6 * (gap_place - 1))
    values = {
        "rolls.diameter": diameter,
        "rolls.gap": gap,
        "rolls.entry_gap": gap + 0.5 * diameter * rise_place**3,
        "feed.bottom_size": 0.1 * min(gap, 1.0),
        "feed.top_size": min(gap, 1.0),
        "exchange": {} if exchange else None,
        "resolution.cells": cells,
    }
    outcome = judge.judge(SMALL | values)
    assert outcome.kind != "fault", outcome.message


# --- the checker sees each kind of fault ---------------------------------------------------------------------

STILL = {
    "exchange": {"interval": 1},
    "resolution.snapshots": 3,
    "strength.reference_strength": 1e15,
    "strength.weibull_modulus": INF,
}
DISTRIBUTIONS = {"resolution.record": "distributions"}


def changed(name, change, place):
    def plant(dataset):
        values = dataset[name].values.copy()
        values[place] = change(values[place])
        dataset[name] = (dataset[name].dims, values, dataset[name].attrs)

    return plant


def scaled(name, factor, place=...):
    return changed(name, lambda values: values * factor, place)


def put(name, value, place=...):
    return changed(name, lambda values: value, place)


def flipped(flag):
    def plant(dataset):
        dataset["flags"] = dataset["flags"] ^ flag

    return plant


def without(name):
    def plant(dataset):
        del dataset[name]

    return plant


def swapped(dataset):
    """Let a cell of the last snapshot be lost in a swap, and another be there twice."""
    size = dataset["size"].values
    size[-1, 0, 1, 0] = size[-1, 0, 1, 1]


@cache
def sound(values):
    """Return a Dataset without a fault, of a scene with these values as JSON."""
    dataset = simulate(paper(SMALL | json.loads(values)))
    assert violations(dataset) == []
    return dataset


LAST = (..., -1)
PLANTED = [
    ("complete", {}, without("p80")),
    ("complete", {"exchange": {}}, without("volume")),
    ("complete", DISTRIBUTIONS, without("mass_fraction")),
    ("finite", {}, put("pressure", np.nan, (0, 3))),
    ("finite", {}, put("throughput", INF)),
    ("points in order", {}, put("height", 0.0, (0, -2))),
    ("points in order", {}, put("residence_time", 0.0, (1, 1))),
    ("points in order", {}, put("x", 0.0, (1, 1))),
    ("stresses not negative", {}, scaled("pressure", -1)),
    ("stresses not negative", {}, scaled("shear_stress", -1)),
    ("stresses not negative", {}, scaled("volumetric_strain", -1)),
    ("stresses not negative", {}, scaled("peak_pressure", 1.01)),
    ("tension told", {}, put("shear_stress", 0.0, (0, -1))),
    ("tension told", {"elasticity.exponent": -0.5}, flipped(64)),
    ("shear within its limit", {}, scaled("shear_strain", 1.5)),
    ("solid fraction within its limits", {}, put("solid_fraction", 0.91, (0, -1))),
    ("solid fraction within its limits", {}, put("solid_fraction", 0.59, (0, 0))),
    ("throughput", {}, put("throughput", 0.0)),
    ("throughput", {}, scaled("throughput", 1.001)),
    ("sizes positive and never growing", {}, put("size", 0.0, (0, 0, 4, 2))),
    ("sizes positive and never growing", {}, put("size", 1e-40, (0, 0, 4, 2))),
    ("sizes positive and never growing", {}, scaled("size", 1.001, (0, 0, -1, 2))),
    ("sizes positive and never growing", {}, scaled("size", 0.9, (0, 1, 4, 2))),
    ("never coarser than the feed", {}, scaled("p80_total", 100)),
    ("never coarser than the feed", {}, put("size", np.nextafter(np.float32(0.06), np.float32(1)), (0, 0, 0, 0))),
    ("never coarser than the feed", {"resolution.record": "product"}, scaled("passing", 0.5)),
    ("never coarser than the feed", {"exchange": {}}, put("size", 0.07, (0, 0, 0, 0))),
    ("distributions rise from 0 to 1", {}, scaled("passing", 0.9, LAST)),
    ("distributions rise from 0 to 1", DISTRIBUTIONS, put("mass_fraction", -0.1, (0, 0, 0, 40))),
    ("distributions rise from 0 to 1", DISTRIBUTIONS, scaled("mass_fraction", 0.9)),
    ("distributions rise from 0 to 1", {}, scaled("passing_total", 1.001, LAST)),
    ("distributions rise from 0 to 1", {}, scaled("p50", 100)),
    ("distributions rise from 0 to 1", {}, scaled("size", 0.25, (0, 1, -1))),
    ("counts", {}, put("below_floor", 1.1, (0,))),
    ("counts", {}, put("breaks_per_cell", -1.0, (0,))),
    ("counts", {}, put("breaks_per_cell", 1000.0, (0,))),
    ("counts", {"exchange": {}}, put("exchange_substeps", 0)),
    ("counts", {"exchange": {}}, put("volume", 0.0, (1, 3))),
    ("no stress leaves the feed", {"strength.reference_strength": 1e15}, scaled("size", np.float32(1 - 2.0**-20))),
    ("no stress leaves the feed", {"rolls.entry_gap": 0.06}, scaled("passing", 0.999)),
    ("no stress leaves the feed", {"strength.reference_strength": 1e15}, put("breaks_per_cell", 1.0)),
    ("swaps conserve every size", STILL, swapped),
    *(("flags", {}, flipped(flag)) for flag in (1, 2, 4, 8, 16, 32, 64)),
]


@pytest.mark.parametrize(("name", "values", "plant"), PLANTED, ids=[f"{k}-{row[0]}" for k, row in enumerate(PLANTED)])
def test_a_planted_fault_is_seen(name, values, plant):
    dataset = sound(json.dumps(values)).copy(deep=True)
    plant(dataset)
    assert name in {line.partition(":")[0] for line in violations(dataset)}


def test_every_invariant_has_a_planted_fault():
    assert {name for name, *_ in PLANTED} == set(INVARIANTS)


# --- scale relations, bit for bit ------------------------------------------------------------------------------

DIMENSIONS = {  # unit -> powers of length, stress and rate; densities stay
    "1": (0, 0, 0),
    "m": (1, 0, 0),
    "m2": (2, 0, 0),
    "s": (0, 0, -1),
    "s-1": (0, 0, 1),
    "m s-1": (1, 0, 1),
    "kg s-1": (3, 0, 1),
    "kg m-3": (0, 0, 0),
    "Pa": (0, 1, 0),
    "N": (2, 1, 0),
    "N m": (3, 1, 0),
    "W": (3, 1, 1),
    "J kg-1": (0, 1, 0),
    "rad": (0, 0, 0),
    "rad s-1": (0, 0, 1),
    "degree": (0, 0, 0),
    "N m-1": (1, 1, 0),
}
LENGTHS = (
    "rolls.diameter",
    "rolls.width",
    "rolls.gap",
    "rolls.entry_gap",
    "feed.bottom_size",
    "feed.top_size",
    "feed.size",
    "strength.reference_size",
    "fragments.size_floor",
)
STRESSES = ("elasticity.bulk_modulus", "elasticity.shear_modulus", "strength.reference_strength")
any_scene = st.fixed_dictionaries(
    {
        "rolls.gap": st.floats(0.02, 0.1),
        "rolls.entry_gap": st.floats(0.3, 2.0),
        "strength.weibull_modulus": st.sampled_from([2.0, 3.04, 10.0, INF]),
        "strength.cushioning": st.sampled_from([0.3, 1.0, INF]),
        "fragments.exponent": st.sampled_from([0.35, 1.0, 3.0]),
        "elasticity.exponent": st.sampled_from([-0.3, 0.0, 0.5, 1.0]),
        "flow.exponent": st.floats(0.5, 2.0),
        "elasticity.integrator": st.sampled_from(["increment", "euler"]),
        "strength.stress": st.sampled_from(["mean", "major"]),
        "exchange": st.sampled_from([None, None, {}, {"start": "crushed"}]),
        "feed.kind": st.sampled_from(["uniform", "single", "power_law", "rosin_rammler"]),
    }
)


def built(values):
    """Cells, so that nothing takes the closed form, whose quadrature knows the metre."""
    hosted = judge.hosts({"feed.kind": values["feed.kind"]})[0]
    return paper(SMALL | hosted | values | {"resolution.record": "cells"})


def assert_scaled(first, second, length=1.0, pressure=1.0, rate=1.0):
    """Assert that every variable differs by just the power of two that its unit has."""
    assert set(first.variables) == set(second.variables)
    for name, variable in first.variables.items():
        lengths, pressures, rates = DIMENSIONS[variable.attrs["units"]]
        factor = variable.dtype.type(length**lengths * pressure**pressures * rate**rates)
        assert np.array_equal(variable.values * factor, second[name].values), name


RELATIONS = {  # what is multiplied, by what, and the argument of `assert_scaled` that it is
    "length": (LENGTHS, 4.0),
    "pressure": (STRESSES, 8.0),
    "rate": (("rolls.speed",), 1024.0),
}


@pytest.mark.parametrize("dimension", RELATIONS)
@settings(max_examples=sized(20, 6))
@given(values=any_scene, up=st.booleans(), seed=st.integers(0, 3))
def test_scaled_scenes_give_scaled_results(dimension, values, up, seed):
    """Lengths times 4 give sizes times 4; moduli and strength times 8 pressures times 8; speed changes rates only."""
    names, factor = RELATIONS[dimension]
    scene, factor = built(values), factor if up else 1 / factor
    known = values_of(scene)
    changed = {name: factor * known[name] for name in names if known.get(name) is not None}
    if dimension == "length":
        changed["resolution.sieves"] = [factor * sieve for sieve in scene.resolution.sieves]
    assert_scaled(simulate(scene, seed), simulate(scene.with_values(changed), seed), **{dimension: factor})
