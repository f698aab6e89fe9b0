"""What every result satisfies, over scenes that hypothesis chooses (derandomised, see conftest.py: the same every run);
that the checker sees each kind of fault; and the scale relations, bit for bit.
"""

import json
import math
import re
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import paper, sized

from hpgr import simulate
from hpgr.fields import values_of
from hpgr.results.flags import BITS
from hpgr.scene import field_info
from studies.guard import judge, ranges
from studies.guard.invariants import INVARIANTS, violations

INF = math.inf
SMALL = {"resolution.streamlines": 2, "resolution.points": sized(31, 16), "resolution.cells": sized(16, 6)}
SMALL |= {"rolls.entry_gap": 0.5}
KNOWN = ranges.numeric_fields()
WALKED = {
    name: known
    for name, known in KNOWN.items()
    if name.partition(".")[0] not in ("resolution", "feed") and name not in ("elasticity.substeps", "exchange.interval")
}

CHOSEN = ("resolution.record", "elasticity.integrator", "strength.stress")


@pytest.mark.slow
@settings(max_examples=sized(40, 10))
@given(
    st.dictionaries(st.sampled_from(sorted(WALKED)), st.floats(0, 1), max_size=8),
    st.sampled_from(sorted(judge.SAMPLES["feed"])),
    st.fixed_dictionaries({name: st.sampled_from(ranges.choices()[name]) for name in CHOSEN}),
    st.integers(1, 3),
    st.booleans(),
    st.sampled_from([None, 0.5, 2.0]),
)
def test_any_scene_ends_well_flagged_or_refused(places, kind, chosen, snapshots, exchange, force):
    values = {name: WALKED[name].at(place) for name, place in places.items()}
    values = {name: value for name, value in values.items() if exchange or not name.startswith("exchange.")}
    values |= chosen | {"resolution.snapshots": snapshots, "feed.kind": kind}
    values |= {"exchange.interval": 2} if exchange else {"exchange": None}
    for hosted in judge.hosts(values)[:1]:  # none, where the fields are of laws that exclude each other
        found = SMALL | hosted
        outcome = judge.judge(found if force is None else ranges.near_force(judge.base(), found, force))
        assert outcome.kind != "fault", outcome.message


# --- the checker sees each kind of fault ---------------------------------------------------------------------

STILL = {"exchange": {"interval": 1}, "resolution.snapshots": 3}
STILL |= {"strength.reference_strength": 1e15, "strength.weibull_modulus": INF}
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
    size[-1, 0, -1, 0] = size[-1, 0, -1, 1]  # far from where feed enters


@cache
def sound(values):
    """Return a Dataset without a fault, of a scene with these values as JSON."""
    dataset = simulate(paper(SMALL | json.loads(values)))
    assert violations(dataset) == []
    return dataset


LAST = (..., -1)
PLAIN = {"resolution.control_variate": False}
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
    ("energy", {}, scaled("power", 1.001)),
    ("energy", {}, scaled("torque", 1.001)),
    ("energy", {"rolls.specific_pressing_force": 1e6}, scaled("pressing_force", 1.001)),
    ("sizes positive and never growing", {}, put("size", 0.0, (0, 0, 4, 2))),
    ("sizes positive and never growing", {}, put("size", 1e-40, (0, 0, 4, 2))),
    ("sizes positive and never growing", {}, scaled("size", 1.001, (0, 0, -1, 2))),
    ("sizes positive and never growing", {}, scaled("size", 0.9, (0, 1, 4, 2))),
    ("never coarser than the feed", {}, scaled("p80_total", 100)),
    ("never coarser than the feed", {}, put("size", np.nextafter(np.float32(0.06), np.float32(1)), (0, 0, 0, 0))),
    ("never coarser than the feed", PLAIN | {"resolution.record": "product"}, scaled("passing", 0.5)),
    ("never coarser than the feed", {"exchange": {}}, put("size", 0.07, (0, 0, 0, 0))),
    ("distributions rise from 0 to 1", {}, scaled("passing", 0.9, LAST)),
    ("distributions rise from 0 to 1", DISTRIBUTIONS, put("mass_fraction", -0.1, (0, 0, 0, 40))),
    ("distributions rise from 0 to 1", DISTRIBUTIONS, scaled("mass_fraction", 0.9)),
    ("distributions rise from 0 to 1", {}, scaled("passing_total", 1.001, LAST)),
    ("distributions rise from 0 to 1", {}, scaled("p50", 100)),
    ("distributions rise from 0 to 1", PLAIN, scaled("size", 0.25, (0, 1, -1))),
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


def test_a_scene_that_is_refused_when_read_back_is_a_fault():
    dataset = sound("{}").copy(deep=True)
    dataset.attrs["scene"] = dataset.attrs["scene"].replace('"gap":0.06', '"gap":6.0')
    assert violations(dataset)[0].startswith("a scene that can be read back: rolls.gap: got 6000 mm")


def test_every_invariant_has_a_planted_fault():
    assert {name for name, *_ in PLANTED} == set(INVARIANTS)


# --- relations between scenes, over random scenes of the whole declared ranges -----------------------------------

BASE_UNITS = {  # powers of length, stress and rate; densities stay, so mass is a volume
    "m": (1, 0, 0),
    "s": (0, 0, -1),
    "kg": (3, 0, 0),
    "Pa": (0, 1, 0),
    "N": (2, 1, 0),
    "W": (3, 1, 1),
    "J": (3, 1, 0),
}


def scale_of(unit, length=1.0, pressure=1.0, rate=1.0):
    """Return the factor of a unit where lengths, stresses and rates take theirs."""
    powers = np.zeros(3)
    for name, power in re.findall(r"([A-Za-z]+)(-?\d*)", unit):
        powers += np.array(BASE_UNITS.get(name, (0, 0, 0))) * int(power or 1)
    return float(np.prod(np.array([length, pressure, rate]) ** powers))


def drawn(count, exchange=False, **values):
    """Yield random scenes that run; they record cells, for the quadrature of the closed form knows the metre."""
    values = {"resolution.record": "cells", "roll_width": None} | values
    for number in range(count):
        found = ranges.draw(judge.base(), np.random.default_rng([number, exchange]), exchange, 0.02)
        found = {name: value for name, value in found.items() if not name.startswith("roll_width")}
        scene = accepted(lambda found=found: judge.base(found | values))
        if scene is not None and accepted(lambda scene=scene: simulate(scene)) is not None:
            yield scene


def accepted(make):
    """Return what `make` does, a scene or a result; None where it is refused."""
    try:
        return make()
    except (ValueError, MemoryError):
        return None


def assert_scaled(first, second, scale):
    """Assert that every variable differs by just the power of two of its unit, where float32 has all its digits."""
    assert set(first.variables) == set(second.variables)
    for name, variable in first.variables.items():
        one, other = variable.values, second[name].values
        if name == "flags":  # what is unusual of a machine knows the metre
            one, other = one & ~BITS["unusual_machine"], other & ~BITS["unusual_machine"]
        if one.dtype == np.float32:
            full = ((np.abs(one) > 1e-30) & (np.abs(one) < 1e30)) | (one == 0)
            one, other = np.where(full, one, 0), np.where(full, other, 0)
        assert np.array_equal(one * one.dtype.type(scale_of(variable.attrs["units"], **scale)), other), name


@pytest.mark.parametrize("exchange", [False, pytest.param(True, marks=pytest.mark.slow)])
@pytest.mark.parametrize("scale", [{"length": 4.0}, {"pressure": 8.0}, {"rate": 1024.0}], ids=str)
def test_scaled_scenes_give_scaled_results(scale, exchange):
    """Lengths times 4 give sizes times 4; moduli and strength times 8 pressures times 8; speed changes rates only.

    Bit for bit, but for a table feed, which is read in logarithms, and for percolation under gravity, which knows the
    metre and the second. Under a pressing force the gap is a root: to 1e-6.
    """
    judged = 0
    for scene in drawn(sized(40, 10), exchange):
        known = values_of(scene)
        factors = {name: scale_of(field_info(name).unit, **scale) for name in KNOWN}
        changed = {name: known[name] * factor for name, factor in factors.items() if factor != 1 and known.get(name)}
        changed["resolution.sieves"] = [scale_of("m", **scale) * sieve for sieve in scene.resolution.sieves]
        other = accepted(lambda scene=scene, changed=changed: scene.with_values(changed))
        gravity = scene.exchange is not None and scene.exchange.percolation == "gravity" and "pressure" not in scale
        if other is None or scene.feed.kind == "table" or gravity:
            continue  # beyond a field's range
        first, second = simulate(scene), simulate(other)
        if scene.rolls.specific_pressing_force:
            for name in ("operating_gap", "pressing_force", "throughput"):
                expected = float(first[name]) * scale_of(first[name].attrs["units"], **scale)
                assert float(second[name]) == pytest.approx(expected, rel=2e-6)
        elif "size" not in first or first["size"].min() > 1e-28:  # below it sizes are held
            assert_scaled(first, second, scale)
        judged += 1
    assert judged > sized(5, 0)


@pytest.mark.parametrize("exchange", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_vanishing_cushioning_is_none(exchange):
    """n = inf, and n so large that cushioning is lost in rounding, give the same sizes bit for bit."""
    for scene in drawn(sized(15, 6), exchange, **PLAIN, **{"strength.cushioning": INF}):
        first, second = simulate(scene), simulate(scene.with_values({"strength.cushioning": 1e150}))
        for name in first.variables:
            assert np.array_equal(first[name], second[name]), name
