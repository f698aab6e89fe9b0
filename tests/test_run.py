import doctest
import importlib
import itertools
import math
import pkgutil
import re
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from support import first_cells, paper, plain_industrial, sized

import hpgr
from hpgr import Scene, cost, presets, simulate
from hpgr.bed import loaded
from hpgr.fields import values_of
from hpgr.grains import closed_form, kernels
from hpgr.results import flags as limits
from hpgr.results import schema
from hpgr.run import load, run_scene, run_together
from hpgr.scene import fields
from studies import close_circuit, open_cases, optimise
from studies.circuit import Screen
from studies.guard.invariants import violations
from studies.sweep import sweep

INF = math.inf
EQUAL_GAPS = {"rolls.gap": 0.06, "rolls.entry_gap": 0.06}


def flags(ds):
    """Names of the flags that are set."""
    return set(limits.names(int(ds["flags"])))


def same_bits(first, second, names=None):
    return all(np.array_equal(first[name], second[name]) for name in names or first.data_vars)


def product_sizes(ds):
    return ds["size"].values[:, :, -1]


def feed_sizes(scene, seed=0, replicate=0):
    lines, snapshots = range(scene.resolution.streamlines), range(scene.resolution.snapshots)
    return np.array([[first_cells(scene, seed, (replicate, i, t))[0] for i in lines] for t in snapshots])


# --- determinism -------------------------------------------------------------------------------------------


def test_same_seed_same_bits_other_seed_other_bits():
    first = simulate(paper(), seed=5)
    assert first.identical(simulate(paper(), seed=5))
    assert first.identical(simulate(paper(), seed=np.int64(5)))
    for seed, replicate in ((6, 0), (5, 1), (6, 1), (0, 5)):
        other = simulate(paper(), seed=seed, replicate=replicate)
        assert not np.array_equal(first["size"], other["size"])
        assert np.array_equal(first["pressure"], other["pressure"])  # nothing random there


def test_threads_give_the_bits_of_a_serial_run():
    scenes = [paper({"rolls.gap": gap, "resolution.cells": 300}) for gap in (0.04, 0.05, 0.06, 0.07)] * 2
    serial = [simulate(scene, seed=3) for scene in scenes]
    with ThreadPoolExecutor(2) as pool:
        threaded = list(pool.map(lambda scene: simulate(scene, seed=3), scenes))
    assert all(one.identical(other) for one, other in zip(serial, threaded, strict=True))


def test_snapshots_are_independent():
    """Correlation of two snapshots' cells: |r| sqrt(M) beyond 5 once in 1.7 million, 3 streamlines."""
    cells = sized(2000, 300)
    scene = paper({"resolution.snapshots": 2, "resolution.cells": cells, "resolution.points": 31})
    first, second = product_sizes(simulate(scene))
    for line in range(3):
        assert abs(np.corrcoef(first[line], second[line])[0, 1]) * math.sqrt(cells) < 5
    assert np.array_equal(first, product_sizes(simulate(scene.with_values({"resolution.snapshots": 1})))[0])


@pytest.mark.parametrize("name", ["seed", "replicate"])
def test_bad_seeds_are_refused(name):
    for value in (-1, 1.0, True, None, "1", 2**63):  # NetCDF could not hold the last
        with pytest.raises(ValueError, match=f"{name}: got .*; must be a whole number .*; such as {name}=0"):
            simulate(paper({"resolution.cells": 0}), **{name: value})


# --- conservation ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "values",
    [
        {},
        {"fragments.exponent": 1e-3},
        {"strength.cushioning": INF, "strength.weibull_modulus": INF},
        {"strength.reference_strength": 1.0},
        {"resolution.points": 2},
        {"resolution.cells": 1},
        {"fragments.size_floor": 0.02},
        {"strength.stress": "major", "elasticity.integrator": "euler"},
        {"feed": {"kind": "power_law", "top_size": 0.06, "exponent": 0.1}},
    ],
    ids=str,
)
def test_grains_only_get_finer_from_the_feed_on_and_every_invariant_holds(values):
    scene = paper(values | {"resolution.snapshots": 2})
    ds = simulate(scene)
    assert violations(ds) == []
    size, start = ds["size"].values, feed_sizes(scene)
    assert np.all(size[:, :, 0] <= start)
    assert np.all(ds["passing_total"][-1] == 1)
    if ds.sizes["point"] == 61 and not np.isinf(scene.strength.cushioning):  # a cell whose size changed has broken
        assert np.all(ds["breaks_per_cell"] >= np.mean(size[:, :, -1] < start, axis=(0, 2)))


def test_distributions_hold_all_mass_at_every_point():
    ds = simulate(paper({"resolution.record": "distributions", "resolution.snapshots": 2}))
    assert np.all(ds["mass_fraction"] >= 0)
    assert ds["mass_fraction"].sum("sieve").values == pytest.approx(1.0, abs=1e-6)
    finer = ds["mass_fraction"].cumsum("sieve").diff("point")
    assert finer.values.min() >= -1e-6  # grains only get finer


# --- bit-exact relations -----------------------------------------------------------------------------------

SIZES = ("size", "breaks_per_cell", "below_floor")


@pytest.mark.parametrize(("record", "cushioning"), [("cells", 1.0), ("distributions", INF)])
def test_stress_and_strength_times_8_give_the_same_product(record, cushioning):
    scene = paper({"resolution.record": record, "strength.cushioning": cushioning})
    names = ("strength.reference_strength", "elasticity.bulk_modulus", "elasticity.shear_modulus")
    known = values_of(scene)
    stiff = scene.with_values({name: 8 * known[name] for name in names})
    first, second = simulate(scene), simulate(stiff)
    stresses = {name for name in first.data_vars if schema.VARIABLES[name].units == "Pa"}
    stresses |= {"pressing_force", "torque", "power", "specific_energy"}  # all in proportion to stress
    assert same_bits(first, second, set(first.data_vars) - stresses)
    assert all(np.array_equal(second[name], 8 * first[name]) for name in stresses)


def test_one_cell_has_no_cushion():
    one = {"resolution.cells": 1, "resolution.snapshots": 20}
    cushioned, free = simulate(paper(one)), simulate(paper(one | {"strength.cushioning": INF}))
    assert same_bits(cushioned, free, SIZES)
    assert "few_cells" not in flags(cushioned)


# --- extremes: the table of the model page, section 10 -----------------------------------------------------


@pytest.mark.parametrize(
    ("values", "told"),
    [
        (EQUAL_GAPS, "no_compaction: the gap equals the entry gap"),
        ({"strength.reference_strength": 1e15}, "no_breakage: no grain broke: the product is the feed"),
    ],
    ids=["equal gaps", "strong"],
)
def test_where_nothing_breaks_the_product_is_the_feed_bit_for_bit(values, told):
    scene = paper(values | {"resolution.snapshots": 2})
    ds = simulate(scene)
    assert np.array_equal(product_sizes(ds), feed_sizes(scene))
    first = "no_compaction" if values is EQUAL_GAPS else "solid_fraction_capped"
    assert flags(ds) == {first, "no_breakage", "unusual_machine"}  # rolls of 6 m
    assert told in ds.attrs["diagnostics"]
    assert not ds["breaks_per_cell"].any()
    assert ds["pressure"].any() == (values is not EQUAL_GAPS)
    for name in ds.variables:
        assert np.all(np.isfinite(ds[name])), name


@pytest.mark.parametrize("values", [EQUAL_GAPS, {"strength.reference_strength": 1e15}], ids=["equal gaps", "strong"])
def test_closed_form_gives_the_feed_where_nothing_breaks(values):
    for record in ("distributions", "product"):
        scene = paper(values | {"strength.cushioning": INF, "resolution.record": record})
        ds = simulate(scene)
        assert "no_breakage" in flags(ds)
        exact = scene.feed.passing(ds["sieve"].values).astype(np.float32)
        assert np.array_equal(ds["passing_total"], exact)
        assert float(ds["p80_total"]) == pytest.approx(float(scene.feed.quantile(0.8)), rel=1e-6)


def test_exit_solid_fraction_above_its_limit_is_flagged_with_the_figure():
    ds = simulate(presets.paper().with_values({"resolution.cells": 0}))
    assert "solid_fraction_capped" in flags(ds)
    assert "a solid fraction of 1.68 at the exit; held at max_solid_fraction 0.9" in ds.attrs["diagnostics"]
    assert float(ds["continuity_solid_fraction"].max()) == pytest.approx(1.68, abs=0.01)
    loose = simulate(paper({"resolution.cells": 0, "bed.feed_solid_fraction": 0.3}))
    assert "solid_fraction_capped" not in flags(loose)


MEANT = {
    "rolls.speed": (20, "surface speed 22 .* rolls.speed 20 is read in rad s-1, 191 rpm; for 20 rpm write '20 rpm'"),
    "bed.solid_density": (2.74, r"solid density 2.74 .* for 2.74 g/cm\^3 write '2.74 g/cm\^3'"),
    "elasticity.bulk_modulus": (675, "bulk modulus 0.000675 MPa .* for 675 MPa write '675 MPa'"),
    "elasticity.shear_modulus": (312, "shear modulus .* for 312 MPa write '312 MPa'"),
}


@pytest.mark.parametrize("field", MEANT)
def test_a_number_in_another_unit_is_flagged_before_all_else_with_the_unit_meant(field):
    usual = plain_industrial().with_values({"resolution.cells": 0})
    assert not flags(simulate(usual))
    value, words = MEANT[field]
    said = simulate(usual.with_values({field: value})).attrs["diagnostics"]
    assert re.match(f"unusual_machine: .*{words}", said)


def test_feed_that_no_stress_breaks_is_flagged_with_its_share():
    fine = plain_industrial().with_values({"feed.top_size": "8 mm", "strength.scatter": INF})
    ds = simulate(fine)
    assert "feed_below_critical" in flags(ds)
    share = re.search(r"feed_below_critical: ([\d.]+) of the feed is finer than ([\d.]+) mm", ds.attrs["diagnostics"])
    assert float(share[1]) == pytest.approx(float(fine.feed.passing(float(share[2]) / 1000)), rel=2e-3)
    assert float(ds["breaks_per_cell"].mean()) < 1 - float(share[1])
    assert "feed_below_critical" not in flags(simulate(paper()))
    assert "feed_below_critical" not in flags(simulate(fine.with_values({"strength.scatter": 3})))


def test_fragment_exponents_that_are_held_are_flagged_with_the_parents():
    steep = {"fragments.size_exponent": 3.0, "fragments.exponent": 4.0, "fragments.reference_size": 0.05}
    ds = simulate(paper(steep))
    assert "fragment_exponent_held" in flags(ds)
    assert "is held at 0.05 for parents of" in ds.attrs["diagnostics"]
    assert "and 5 for parents of 60 mm" in ds.attrs["diagnostics"]
    assert "fragment_exponent_held" not in flags(simulate(paper({"fragments.size_exponent": 0.1})))


def test_grains_below_the_floor_are_counted_and_flagged():
    ds = simulate(paper({"fragments.size_floor": "1 mm"}))
    share = np.mean(product_sizes(ds)[0] < 0.001, axis=1)
    assert np.array_equal(ds["below_floor"].values, share.astype(np.float32))
    assert "size_floor_reached" in flags(ds)
    assert f"{share.mean():.3g} of the product is below the size floor" in ds.attrs["diagnostics"]


def test_too_many_cells_are_refused_before_anything_is_computed(monkeypatch):
    def refuse(*args, **kwargs):
        raise AssertionError("computed")

    monkeypatch.setattr(loaded, "load_bed", refuse)
    scene = paper({"resolution.cells": 2_000_000_000, "resolution.points": 100_000})
    with pytest.raises(MemoryError, match=f"predicted {cost.predict(scene).bytes:,} bytes"):
        simulate(scene)


def test_single_feed_passes_the_sieve_of_its_own_size():
    """Cells are float32, and float32(0.1) > 0.1: the grain must still pass the 100 mm sieve."""
    for cushioning in (1.0, INF):
        scene = paper(
            {"feed": {"kind": "single", "size": 0.1}}
            | {"strength.reference_strength": 1e15, "strength.cushioning": cushioning, "resolution.record": "product"}
        )
        assert float(hpgr.passing(simulate(scene), [0.1], total=True)[0]) == 1


# --- only what is asked for --------------------------------------------------------------------------------


def test_stress_only_does_no_cell_work(monkeypatch):
    whole = simulate(paper())

    def refuse(*args, **kwargs):
        raise AssertionError("cell work")

    for room, name in ((kernels, "crush"), (kernels, "start_parcels"), (closed_form, "crushed_passing")):
        monkeypatch.setattr(room, name, refuse)
    ds = simulate(paper({"resolution.cells": 0}))
    cells_only = {name for name, entry in schema.VARIABLES.items() if {"cell", "sieve"} & set(entry.dims)}
    assert not cells_only & set(ds.variables)
    assert {"cell", "sieve", "time"}.isdisjoint(ds.dims)
    assert same_bits(ds, whole, set(ds.data_vars) - {"flags"})
    with pytest.raises(AssertionError, match="cell work"):
        simulate(paper())


def test_product_record_keeps_nothing_else_and_snapshots_are_numbered():
    for record in ("cells", "distributions", "product"):
        ds = simulate(paper({"resolution.record": record, "resolution.snapshots": 3}))
        assert ("time" in ds.dims) is (record != "product")
        assert "time" not in ds.dims or ds["time"].values.tolist() == [0, 1, 2]
        assert ("cell" in ds.dims) is (record == "cells")
    assert ds["passing"].dims == ("streamline", "sieve")


# --- substeps ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("values", [{}, EQUAL_GAPS], ids=["paper", "equal gaps"])
def test_substeps_refine_the_stress_and_keep_the_points(values):
    """Strains of 61 points with 20 substeps are those of 1201 points."""
    values = values | {"resolution.cells": 0}
    coarse = simulate(paper(values))
    refined = simulate(paper(values | {"elasticity.substeps": 20}))
    fine = simulate(paper(values | {"resolution.points": 1201}))
    assert refined.sizes == coarse.sizes
    for name in ("x", "height", "residence_time", "speed", "volumetric_strain_rate"):
        assert refined[name].values == pytest.approx(coarse[name].values, rel=1e-5, abs=1e-9)
    assert refined.attrs["time_step_s"] == pytest.approx(coarse.attrs["time_step_s"], rel=1e-12)
    assert np.array_equal(refined["pressure"], fine["pressure"].isel(point=slice(None, None, 20)))
    assert simulate(paper({"elasticity.substeps": 5})).sizes["point"] == 61
    assert np.array_equal(refined["continuity_solid_fraction"], fine["continuity_solid_fraction"])


# --- what scenes share ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("base", [paper(), plain_industrial()], ids=["paper", "industrial"])
def test_scenes_that_run_together_come_to_what_they_come_to_alone(base):
    """Each field of a scene in turn is another by a tenth: what one has must not be taken for the other's."""
    base = base.with_values({"resolution.record": "product", "strength.cushioning": 1.0})
    numbers = {
        name: value for name, value in values_of(base).items() if isinstance(value, float) and math.isfinite(value)
    }
    others = {"strength.stress": "major", "strength.scatter": 2.0, "rolls.specific_pressing_force": 3e6}
    scenes = [base]
    for name, value in ({name: 0.9 * value for name, value in numbers.items()} | others).items():
        try:
            scenes.append(base.with_values({name: value}))
        except ValueError:  # no scene, such as of a negative exponent
            continue
    assert len(scenes) > 15
    together = [result for [result] in run_together([(scene, [0]) for scene in scenes], 0)]
    for scene, one in zip(scenes, together, strict=True):
        alone = run_scene(scene)
        for name in ("passing_total", "p80_total", "peak_pressure", "power", "flags"):
            assert np.array_equal(one.values[name], alone.values[name]), (name, scene)


# --- what is no argument ----------------------------------------------------------------------------------------

PRODUCT, OPERATIONS = (hpgr.presets.DATA / f"khd_porphyry_{name}.csv" for name in ("psd", "operations"))
NO_ARGUMENTS = {
    "tolerance: got '1%'; must be within 1e-4 to 0.5; such as tolerance=0.01": lambda s, d: simulate(s, tolerance="1%"),
    "max_cost: got 'x'; must be within 0 to inf s; such as": lambda s, d: simulate(s, tolerance=0.1, max_cost="x"),
    "scene: got 'x'; must be a scene; such as": lambda s, d: hpgr.operating_gap("x", 4e6),
    "scene: got 'x.toml'; must be a scene; such as hpgr.Scene.from_file": lambda s, d: simulate("x.toml"),
    "specific_pressing_force: got None; must be": lambda s, d: hpgr.operating_gap(s, None),
    "scene: got 'y'; must be a scene; such as": lambda s, d: hpgr.calibrate("y", None, "product", "operations"),
    "scene: got 'z'; must be a scene; such as": lambda s, d: sweep("z", {"gap": [0.04]}),
    "space: got None; must be fields": lambda s, d: sweep(s, None),
    "tolerance: got 2; must be": lambda s, d: sweep(s, {"gap": [0.04]}, tolerance=2),
    "max_cost: got -1; must be": lambda s, d: sweep(s, {"gap": [0.04]}, max_cost=-1),
    "timeout: got 'x'; must be within 0.1 to 1e6 s": lambda s, d: sweep(s, {"gap": [0.04]}, timeout="x"),
    "percent: got '80'; must be within 0 to 100; such as percent=80": lambda s, d: hpgr.percentile_size(d, "80"),
    "percent: got None; must be": lambda s, d: hpgr.reduction_ratio(d, None),
    "point: got 1.5; must be a whole number": lambda s, d: hpgr.passing(d, ["1 mm"], point=1.5),
    "point: got True; must be a whole number": lambda s, d: hpgr.percentile_size(d, 80, True),
    "sieves: got [1000": lambda s, d: hpgr.passing(d, [10**400]),
    "values: got 3; must be values by name; such as {'rolls.gap'": lambda s, d: s.with_values(3),
    "values: got {3: 0.04}; must be values by name": lambda s, d: s.with_values({3: 0.04}),
    "1 validation error for Scene\nexchange\n  got []": lambda s, d: s.with_values(
        {"exchange": [], "exchange.mixing": 1}
    ),
    "1 validation error for Scene\nflow\n  got array(": lambda s, d: s.with_values({"flow.kind": np.zeros(2)}),
    "path: got 3; must be a path; such as path='outputs/mine'": lambda s, d: hpgr.Scene.from_file(3),
    "path: got 'a\\x00'; must be a path": lambda s, d: hpgr.Scene.from_file("a\0"),
    f"{Path(__file__).parent}: is no regular file": lambda s, d: hpgr.Scene.from_file(Path(__file__).parent),
    "[Errno 2] No such file or directory; give a file that can be read: 'gone'": lambda s, d: Scene.from_file("gone"),
    "base: got array(": lambda s, d: hpgr.Scene.preset(np.zeros(2)),
    "scene: got 'alike'; must be a scene": lambda s, d: hpgr.presets.fitting_alike("alike"),
    "product: got None; must be a path": lambda s, d: hpgr.calibrate(s, None, None, OPERATIONS),
    "operations: got True; must be a path": lambda s, d: hpgr.calibrate(s, None, PRODUCT, True),
    "tests: got 'K-P1'; must be a list of names; such as tests=['K-P1']": lambda s, d: hpgr.calibrate(
        s, None, PRODUCT, OPERATIONS, tests="K-P1"
    ),
    "fit: got 3; must be a list of names; such as fit=['sigma_m']": lambda s, d: hpgr.calibrate(
        s, None, PRODUCT, OPERATIONS, 3
    ),
    "1 validation error for Scene\nfeed\n  got no kind": lambda s, d: hpgr.calibrate(
        s, {}, PRODUCT, OPERATIONS, ["gamma"], ["K-P1"]
    ),
    "client: got 'x'; must be a dask client; such as": lambda s, d: sweep(s, {"gap": [0.04]}, client="x"),
    "folder: got 3; must be a path": lambda s, d: sweep(s, {"gap": [0.04]}, folder=3),
    "folder: got 4; must be a path": lambda s, d: open_cases(4),
    "replicates: got 1000": lambda s, d: sweep(s, {"gap": [0.04]}, replicates=10**400),
    "a scene has no field 3; did you mean": lambda s, d: sweep(s, {3: [0.04]}),
    "rolls.gap: got b'x'; an axis is a list": lambda s, d: sweep(s, {"gap": b"x"}),
    "rolls.gap, rolls.speed: got [3]; must be a value of each": lambda s, d: sweep(s, {("gap", "speed"): [3]}),
    "scene: got 'best'; must be a scene": lambda s, d: optimise("best", {"gap": (0.04, 0.06)}, "energy"),
    "ranges: got 3; must be fields, each with two ends": lambda s, d: optimise(s, 3, "energy"),
    "over: got no fields; give ranges; such as": lambda s, d: optimise(s, {}, "energy"),
    "resolution.cells: got 0 (stress only); must be at least 1 for P80": lambda s, d: optimise(
        s.with_values({"resolution.cells": 0}), {"gap": (0.04, 0.06)}, "energy"
    ),
    "gap: got 0.04; must be lowest and highest value": lambda s, d: optimise(s, {"gap": 0.04}, "energy"),
    "a run has no figure 3; give": lambda s, d: optimise(s, {"gap": (0.04, 0.06)}, maximise=3),
    "subject_to: got 'x'; must be bounds": lambda s, d: optimise(s, {"gap": (0.04, 0.06)}, "energy", subject_to="x"),
    "scene: got 'loop'; must be a scene": lambda s, d: close_circuit("loop", Screen(cut_size="6 mm")),
    "returned: got '6 mm'; must be what separates": lambda s, d: close_circuit(s, "6 mm"),
    "space: got []; must be fields": lambda s, d: close_circuit(s, Screen(cut_size="6 mm"), []),
    "replicates: got 0; must be": lambda s, d: close_circuit(s, Screen(cut_size="6 mm"), replicates=0),
    "dataset: got 3; must be a Dataset; such as": lambda s, d: hpgr.passing(3),
    "dataset: got 4; must be a Dataset; such as": lambda s, d: hpgr.throughput(4),
    "dataset: got 5; must be a Dataset; such as": lambda s, d: hpgr.peak_pressure(5),
    "dataset: got 6; must be a Dataset; such as": lambda s, d: hpgr.reduction_ratio(6),
    "dataset: has no 'throughput'; must be": lambda s, d: hpgr.throughput(d.drop_vars("throughput")),
}


@pytest.fixture(scope="module")
def small():
    scene = paper({"resolution.cells": 8})
    return scene, simulate(scene)


@pytest.mark.parametrize("words", NO_ARGUMENTS)
def test_what_is_no_argument_is_refused_by_its_name(small, words):
    with pytest.raises((TypeError, ValueError, OSError), match=f"^{re.escape(words)}"):
        NO_ARGUMENTS[words](*small)


# --- the one door ------------------------------------------------------------------------------------------

HELD = {"rolls.specific_pressing_force": "4 N/mm^2", "resolution.cells": 0}


def test_every_caller_runs_the_machine_whose_gap_carries_the_force():
    """55.0 mm and 3.83 N/mm2 are the machine as given; 53.7 mm carries 4.00."""
    scene = plain_industrial().with_values(HELD)
    result = run_scene(scene)
    assert result.scene.rolls.gap == pytest.approx(53.78e-3, abs=1e-5)
    assert result.scene.rolls.gap == hpgr.operating_gap(scene, 4e6)
    assert float(result.values["specific_pressing_force"]) == pytest.approx(4e6, rel=1e-6)
    given = run_scene(scene.with_values({"rolls.specific_pressing_force": None}))
    assert float(given.values["specific_pressing_force"]) == pytest.approx(3.83e6, rel=5e-3)
    swept = sweep(scene, {"rolls.speed": [scene.rolls.speed]}, progress=False).isel(roll_speed=0, replicate=0)
    refined = simulate(scene, tolerance=0.05)
    for found in (simulate(scene), swept, refined):
        assert float(found["specific_pressing_force"]) == pytest.approx(4e6, rel=1e-6)
    assert float(swept["operating_gap"]) == np.float32(result.scene.rolls.gap)


@pytest.mark.parametrize("name", ["march", "control variate", "width", "closed form", "exchange", "stress only"])
def test_a_case_has_the_same_bits_alone_and_beside_others(name):
    product = {"resolution.record": "product"}
    scene = paper(
        {
            "march": {},
            "control variate": product,
            "width": product | {"roll_width": {}},  # slices are summed in one order
            "closed form": product | {"strength.cushioning": INF},
            "exchange": product | {"exchange": {}},
            "stress only": {"resolution.cells": 0},
        }[name]
    )
    # an operating point of another feed, another one of another gap, and one that shares no call of the kernels
    others = {"feed.top_size": 0.05}, {"rolls.gap": 0.055}, {"fragments.exponent": 0.5}
    scenes = [scene, *map(scene.with_values, others)]
    found = run_together([(one, [4, 0, 2]) for one in scenes], 3)
    every = [(one, replicate) for one in scenes for replicate in (4, 0, 2)]
    for (one, replicate), together in zip(every, itertools.chain(*found), strict=True):
        alone = run_scene(one, 3, replicate)
        assert together.diagnostics == alone.diagnostics
        assert together.values.keys() == alone.values.keys()
        for key, value in alone.values.items():
            np.testing.assert_array_equal(together.values[key], value, err_msg=key)


def test_loading_a_floated_scene_again_changes_nothing():
    scene, bed = load(plain_industrial().with_values(HELD))
    again, same = load(scene)
    assert again == scene
    assert np.array_equal(same.stress.pressure, bed.stress.pressure)


SMALL = {"resolution.streamlines": 2, "resolution.points": 31, "resolution.cells": 20, "resolution.snapshots": 2}
BASES = {
    "exchange": SMALL
    | {"exchange": {"startup": "feed", "interval": 7}, "resolution.record": "distributions"}
    | {"resolution.cells": 100, "fragments.size_floor": "2 mm", "fragments.size_exponent": 0.3},
    "nip": SMALL | {"flow": {"kind": "nip", "nip_angle": "12 deg"}, "rolls.specific_pressing_force": "0.2 N/mm^2"},
    "cake": SMALL | {"flow": {"kind": "nip", "cake_solid_fraction": 0.8}},
    "width": SMALL | {"roll_width": {"slices": 2}, "resolution.record": "product"},
    "hill": SMALL | {"roll_width": {"kind": "friction_hill", "slices": 2}, "resolution.record": "product"},
    "single": SMALL | {"feed": {"kind": "single", "size": "40 mm"}},
    "power": SMALL | {"feed": {"kind": "power_law", "top_size": "60 mm", "exponent": 0.7}},
    "weibull": SMALL | {"feed": {"kind": "rosin_rammler", "size": "30 mm", "exponent": 1.2, "top_size": "60 mm"}},
    "table": SMALL | {"feed": {"kind": "table", "table": ((0.001, 0.0), (0.05, 100.0)), "top_size": "40 mm"}},
}
OTHER = {
    "elasticity.integrator": "euler",
    "elasticity.recovery_modulus": 1e9,
    "strength.stress": "major",
    "exchange.startup": "crushed",
    "exchange.percolation": "gravity",
    "feed.table": ((0.002, 0.0), (0.05, 100.0)),
    "resolution.sieves": (0.001, 0.01, 0.1),
    "remark": "other",
    "rolls.entry_gap": 1.1,
}
OF_THE_BED = {"diameter", "gap", "entry_gap", "speed", "feed_solid_fraction", "max_solid_fraction", "streamlines"}
MAY_NOT_MATTER = {"remark"}


def other_value(name, value):
    if name == "resolution.record":
        return "cells" if value == "distributions" else None
    if name in OTHER or isinstance(value, str | None):
        return OTHER.get(name)
    if isinstance(value, bool):
        return not value
    return value + 1 if isinstance(value, int) else 3.0 if math.isinf(value) else 0.95 * value or 0.5


@pytest.mark.plumbing
def test_no_field_of_a_scene_is_forgotten():
    """Each is changed in turn: bed, address of a finished case, and result react, unless it is of those listed."""
    from studies.sweep.cases import Addresses
    from studies.sweep.space import SweepSpec

    seen, mattered = set(), set()
    for values in BASES.values():
        base = presets.paper().with_values(values)
        first, address = run_scene(base), Addresses(SweepSpec(base)).of({}, 0)
        for name, value in values_of(base).items():
            other = other_value(name, value)
            seen |= {name} - {"exchange", "roll_width"}  # named so where a scene has none
            if other is None:
                continue
            changed = base.with_values({name: other})
            assert (Addresses(SweepSpec(changed)).of({}, 0) != address) is (name != "remark"), name
            found = run_scene(changed)
            section, _, key = name.partition(".")
            bed = section in {"flow", "elasticity"} or key in OF_THE_BED | {"points"}
            along = section == "roll_width" or key == "width"  # laws of the roll width may, or may not, reach the bed
            if base.rolls.specific_pressing_force is None and not along:  # else the gap floats with much else, too
                same = loaded.inputs_of(changed, True) == loaded.inputs_of(base, True)
                assert same is not bed, name
            if any(not np.array_equal(first.values.get(k), found.values.get(k)) for k in first.values | found.values):
                mattered.add(name)
    assert seen - mattered == MAY_NOT_MATTER | {name for name in seen if name.endswith(".kind")}
    assert seen == set(fields()) | {"remark"}


# --- the whole ---------------------------------------------------------------------------------------------


def test_attributes_tell_how_it_was_made():
    ds = simulate(paper(), seed=7, replicate=2)
    assert (ds.attrs["seed"], ds.attrs["replicate"]) == (7, 2)
    assert ds.attrs["Conventions"].startswith("CF-")
    assert "seed=7, replicate=2" in ds.attrs["history"]
    assert hpgr.__version__ in ds.attrs["source"]
    again = simulate(Scene.model_validate_json(ds.attrs["scene"]), ds.attrs["seed"], ds.attrs["replicate"])
    assert again.identical(ds)
    _, bed = load(paper())
    assert ds.attrs["time_step_s"] == bed.kinematics.time_step
    assert ds.attrs["streamline_deviation_m"] == bed.geometry.deviation()


@pytest.mark.parametrize("name", presets.NAMES)
def test_every_preset_runs(name):
    small = {"resolution.streamlines": 2, "resolution.points": 41, "resolution.cells": 50}
    ds = simulate(Scene.preset(name).with_values(small))
    assert 0 < float(ds["p80_total"]) < 0.06
    assert float(ds["peak_pressure"]) > 1e6


def test_public_names_load_on_first_use():
    for name in hpgr.__all__:
        assert getattr(hpgr, name) is not None
    assert dir(hpgr) == sorted(hpgr.__all__)
    assert callable(hpgr.simulate)
    with pytest.raises(AttributeError, match="no attribute 'simulated'"):
        hpgr.simulated  # noqa: B018 - the access is the test


@pytest.mark.parametrize("name", sorted(module.name for module in pkgutil.walk_packages(hpgr.__path__, "hpgr.")))
def test_examples_in_docstrings(name):
    """They bring their own imports, so that a reader can paste them."""
    assert doctest.testmod(importlib.import_module(name), globs={}).failed == 0
