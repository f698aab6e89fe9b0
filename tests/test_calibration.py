import math

import numpy as np
import pytest

import hpgr
from hpgr import calibration, presets
from hpgr.calibration import PARAMETERS, fit_tests, predict
from hpgr.laws.feed import SingleFeed
from hpgr.tables import read_pilot_tests

PSD, OPERATIONS = presets.DATA / "khd_porphyry_psd.csv", presets.DATA / "khd_porphyry_operations.csv"
# n = inf is the closed form: quick, exact, and smooth in every parameter
SMALL = {"resolution.points": 21, "resolution.streamlines": 1, "strength.cushioning": math.inf,
         "resolution.record": "product"}  # fmt: skip
PLANTED = {"sigma_m": 3.1e6, "w": 2.4, "gamma": 0.45, "K": 1150e6, "alpha": math.radians(9.5), "kappa": 0.7, "T_0": 3e3}


@pytest.fixture(scope="module")
def pilot_tests():
    return {test.name: test for test in read_pilot_tests(PSD, OPERATIONS)}


def start(roll_width=True, values=None):
    wide = {"roll_width": {"slices": 1}} if roll_width else {}
    return presets.khd_pilot().with_values(SMALL | wide | (values or {}))


def planted(names, roll_width=True, values=None):
    """The starting scene with planted values; G keeps its ratio to K."""
    fields = {PARAMETERS[name].field: PLANTED[name] for name in names}
    if "K" in names:
        ore = presets.khd_pilot().elasticity
        fields["elasticity.shear_modulus"] = PLANTED["K"] * ore.shear_modulus / ore.bulk_modulus
    return start(roll_width, fields | (values or {}))


def measured(scene, test, noise=0.0, seed=0):
    """The test as the scene would have it, with a normal error of `noise` percent passing or percent."""
    found, generator = predict(scene, test), np.random.default_rng(seed)

    def off(value, relative=False):
        if value is None:
            return np.full(test.sizes.size, np.nan)
        error = noise / 100 * generator.normal(size=np.shape(value))
        return value * (1 + error) if relative else np.clip(value + error, 0, 1)

    apart = {name: off(getattr(found, name)) for name in ("centre", "edge", "total")}
    return test._replace(
        **apart, throughput=float(off(found.throughput, True)), power=float(off(found.power, True)),
        cake_thickness=float(off(found.gap, True)),
    )  # fmt: skip


@pytest.mark.parametrize("names", [["K", "alpha", "T_0"], ["sigma_m", "w", "gamma"], ["kappa", "K", "sigma_m"]],
                         ids=["machine", "ore", "both"])  # fmt: skip
def test_planted_parameters_are_recovered(pilot_tests, names):
    wide = "kappa" in names
    known = ("K-P1", "K-P3")[: 1 if wide else 2]  # centre and edge are two pressures in one test
    tests = [measured(planted(names, wide), pilot_tests[name]) for name in known]
    found = fit_tests(start(wide), tests, names)
    for name in names:
        # strength and its size effect trade off along a valley, whose bottom the fit follows until it is flat
        assert found.estimates[name].value == pytest.approx(PLANTED[name], rel=1e-2), name
        assert found.estimates[name].unit == hpgr.scene.field_info(PARAMETERS[name].field).unit
    assert not found.undetermined
    assert not found.at_bound
    residuals = np.concatenate([part for test in found.residuals.values() for part in test.values()])
    assert np.abs(residuals).max() < 0.2
    # it then predicts a test it has not seen
    unseen = measured(planted(names, wide), pilot_tests["K-P4"])
    assert found.predict(unseen).total == pytest.approx(unseen.total, abs=4e-3)
    assert found.predict(unseen).power == pytest.approx(unseen.power, rel=5e-3)


def test_intervals_cover_the_planted_values_and_tell_the_noise(pilot_tests):
    """Of 2 parameters in 3 samples, 6 intervals of 95 %: fewer than 4 cover by chance twice in 1,000."""
    names = ["sigma_m", "gamma"]
    scene = planted(names, roll_width=False)
    covered, widths = 0, []
    for seed in range(3):
        test = measured(scene, pilot_tests["K-P1"], noise=0.5, seed=seed)
        found = fit_tests(start(False), [test], names)
        covered += sum(found.estimates[name].low <= PLANTED[name] <= found.estimates[name].high for name in names)
        widths.append(found.estimates["gamma"].high / found.estimates["gamma"].low - 1)
    assert covered >= 4
    assert 0.005 < np.median(widths) < 0.2


def test_residuals_are_predicted_less_measured(pilot_tests):
    names = ["sigma_m"]
    scene = planted(names, roll_width=False)
    test = measured(scene, pilot_tests["K-P1"])
    more = test._replace(throughput=2 * test.throughput, power=test.power / 2)
    found = fit_tests(start(False), [more], names).residuals["K-P1"]
    assert found["throughput"] == pytest.approx(-50, abs=1e-3)
    assert found["power"] == pytest.approx(100, abs=1e-3)
    assert found["cake_thickness"] == pytest.approx(0, abs=1e-3)
    coarse = test._replace(total=np.full(test.sizes.size, 0.0))
    assert np.all(fit_tests(start(False), [coarse], names).residuals["K-P1"]["total"] >= 0)


def test_what_tests_do_not_tell_apart_is_named(pilot_tests):
    """Without cushioning one test tells one critical size: strength and its size effect give the same one."""
    test = pilot_tests["K-P1"]
    found = fit_tests(start(False), [test], ["sigma_m", "w", "gamma"])
    assert set(found.undetermined) == {"sigma_m", "w"}
    assert math.isinf(found.estimates["w"].high)
    assert math.isfinite(found.estimates["gamma"].high)
    assert "the tests do not tell apart sigma_m, w" in str(found)
    assert found.predict(test).total == pytest.approx(test.total, abs=0.1)  # a fit all the same


def test_same_input_gives_the_same_bits(pilot_tests):
    scene = start(False, {"strength.cushioning": 1.0, "resolution.cells": 60, "resolution.points": 21})
    first, again = (fit_tests(scene, [pilot_tests["K-P1"]], ["sigma_m", "gamma"]) for _ in range(2))
    assert first.estimates == again.estimates
    assert first.scene == again.scene
    assert first.scene.strength.reference_strength == first.estimates["sigma_m"].value


def test_tables_without_what_was_not_measured_will_do(tmp_path):
    product, operations = tmp_path / "psd.csv", tmp_path / "operations.csv"
    product.write_text("test,size_mm,feed,total\nmine,31.5,100,100\nmine,16,40,85\nmine,8,20,60\nmine,1,5,25\n")
    operations.write_text("test,U_m_s,Fsp_N_mm2\nmine,0.67,2.5\n")
    found = hpgr.calibrate(start(), None, product, operations, fit=["sigma_m", "gamma"])
    assert list(found.residuals) == ["mine"]
    assert list(found.residuals["mine"]) == ["total"]
    assert np.abs(found.residuals["mine"]["total"]).max() < 20
    assert found.scene.rolls.specific_pressing_force == 2.5e6
    with pytest.raises(ValueError, match="fit: got K, fitted to throughput, power and cake thickness; must"):
        hpgr.calibrate(start(), None, product, operations, fit=["sigma_m", "K"])
    other = SingleFeed(size="30 mm")
    assert hpgr.calibrate(start(), other, product, operations, fit=["sigma_m", "gamma"]).scene.feed == other


def test_report_is_short_and_has_units(pilot_tests):
    found = fit_tests(start(False), [pilot_tests["K-P1"]], ["sigma_m", "gamma", "alpha"])
    rows = str(found).splitlines()
    assert rows[0] == "calibrated on K-P1"
    assert len(rows) == 4
    assert "MPa (" in rows[1]
    assert "deg (" in rows[3]
    assert all(len(row) < 100 for row in rows)


@pytest.mark.parametrize(
    ("fit", "values", "words"),
    [
        (
            ["sigma"],
            {},
            "fit: got sigma; must be among sigma_m, w, gamma, n, K, alpha, kappa, T_0; correct the symbols",
        ),
        ([], {}, "fit: got nothing"),
        (["kappa"], {}, "fit: got kappa; must be fitted with a roll_width"),
        (["alpha"], {"flow": {}}, "fit: got alpha; must be fitted with flow.kind = 'nip'"),
        (
            ["sigma_m"],
            {"elasticity.bulk_modulus": 1e5, "elasticity.shear_modulus": 5e4},
            "scene: no gap carries the force",
        ),
        (["K", "alpha", "T_0", "sigma_m"], {}, "fit: got K, alpha, T_0, fitted to"),
    ],
)
def test_what_cannot_be_fitted_is_refused(pilot_tests, fit, values, words):
    test = pilot_tests["K-P1"]
    if len(fit) == 4:
        test = test._replace(power=math.nan, cake_thickness=math.nan)
    with pytest.raises(ValueError, match=words):
        fit_tests(start(False, values), [test], fit)


def test_unknown_tests_are_refused():
    with pytest.raises(ValueError, match="tests: got 'K-P9'; must be among K-P1, K-P2, K-P3, K-P4, K-P5; correct"):
        hpgr.calibrate(start(), None, PSD, OPERATIONS, tests=["K-P1", "K-P9"])


def test_prediction_at_a_measured_gap_needs_no_force(pilot_tests):
    scene, test = start(), pilot_tests["K-P1"]
    floating, fixed = (predict(scene, test, floating=one) for one in (True, False))
    assert fixed.gap == test.cake_thickness
    assert floating.gap != fixed.gap
    assert predict(scene, test._replace(cake_thickness=math.nan), floating=False).gap == test.gap
    assert fixed.specific_energy == pytest.approx(fixed.power / fixed.throughput, rel=1e-12)
    assert fixed.total == pytest.approx(0.8 * fixed.centre + 0.2 * fixed.edge, abs=1e-6)


def test_bounds_and_scales_go_there_and_back():
    for name, parameter in PARAMETERS.items():
        for value in (parameter.low, PLANTED.get(name, 1.0), parameter.high):
            assert parameter.value(parameter.scaled(value)) == pytest.approx(value, rel=1e-12, abs=1e-12)
    assert calibration.PARAMETERS["K"].follower == "elasticity.shear_modulus"


def test_no_tests_and_no_product_to_fit_to_are_refused(pilot_tests):
    with pytest.raises(ValueError, match="tests: got none; must be among K-P1"):
        hpgr.calibrate(start(), None, PSD, OPERATIONS, tests=[])
    with pytest.raises(ValueError, match=r"0 values of these; resolution\.cells = 0 has no product"):
        fit_tests(start(values={"resolution.cells": 0}), [pilot_tests["K-P1"]], ["gamma"])
