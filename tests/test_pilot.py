import csv
import math

import numpy as np
import pytest
import xarray as xr
from support import COMPILED

from hpgr import presets, tables
from hpgr.calibration import predict
from studies import pilot
from studies.pilot import main

FORCES = {"A": 2.5, "B": 3.7, "C": 4.7}  # N/mm2
SIZES = [0.125, 0.5, 1.0, 2.8, 5.6, 11.2, 16.0, 22.4, 31.5, 45.0]  # mm
PRODUCT, OPERATIONS = presets.DATA / "khd_porphyry_psd.csv", presets.DATA / "khd_porphyry_operations.csv"
GRID = ["--streamlines", "1", "--points", "40", "--cells", "300"]
FIT = ["--fit", "sigma_m", "w", "gamma", "K", "alpha", "kappa", "T_0"]  # without n: the closed form, which is quick
PLANTED = {
    "strength.cushioning": math.inf,
    "strength.reference_strength": 3e6,
    "strength.weibull_modulus": 1.5,
    "fragments.exponent": 0.4,
    "rolls.idle_torque": 4000.0,
    "resolution.record": "product",
    "resolution.streamlines": 1,
    "resolution.points": 40,
    "resolution.cells": 300,
    "roll_width": {"pressure_drop": 0.7, "edge_share": 0.22, "slices": 2},
}


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def truth():
    return presets.khd_pilot().with_values(PLANTED)


@pytest.fixture
def written(folder, truth):
    """Three tests that the model itself has made, and the scene they were made by, as files."""
    feed = tables.read_pilot_tests(PRODUCT, OPERATIONS)[0]
    rows, runs = [], []
    for name, force in FORCES.items():
        share = np.interp(np.log(SIZES), np.log(feed.sizes * 1e3), feed.feed)
        blank = feed._replace(
            name=name, specific_pressing_force=force * 1e6, sizes=np.array(SIZES) / 1e3, feed=share, surface_speed=0.5
        )
        made = predict(truth, blank)
        for k, size in enumerate(SIZES):
            parts = (100 * part[k] for part in (share, made.centre, made.edge, made.total))
            rows.append([name, size, *parts])
        runs.append([name, 0.5, force, made.gap * 1e3, made.throughput * 3.6, made.power / 1e3])
    for path, header, body in (
        ("psd.csv", ["test", "size_mm", "feed", "centre", "edge", "total"], rows),
        ("runs.csv", ["test", "U_m_s", "Fsp_N_mm2", "flake_mm", "Q_tph", "P_kW"], runs),
    ):
        with open(path, "w", newline="") as file:
            csv.writer(file).writerows([header, *body])
    start = truth.with_values({"strength.reference_strength": 1e6, "fragments.exponent": 1.0, "roll_width": None})
    (folder / "mine.json").write_text(start.model_dump_json())
    return ["--tests", "psd.csv", "--operations", "runs.csv", "--scene", "mine.json", *GRID, *FIT]


@pytest.mark.slow
def test_tests_that_the_model_has_made_are_predicted_blind(written, capsys):
    assert main([*written, "--calibrate-on", "A", "B", "--no-baselines"]) == 0
    out = capsys.readouterr().out
    with xr.open_dataset("outputs/pilot.nc") as opened:
        result = opened.load()
    assert result["test"].values.tolist() == list("ABC")
    assert result["blind"].values.tolist() == [0, 0, 1]
    blind = result.sel(test="C", source="hpgr")
    assert float(blind["rmse"].max()) < 0.1  # percent passing
    for name in pilot.FIGURES:
        measured = result[name].sel(test="C", source="measured")
        assert float(blind[name] / measured) == pytest.approx(1, abs=2e-3), name
    assert "hpgr: median" in out
    for symbol, unit in (("sigma_m", "MPa"), ("alpha", "deg"), ("T_0", "kN m")):
        assert any(symbol in line and unit in line for line in out.splitlines()), symbol
    assert (xr.open_dataset("outputs/pilot.nc").attrs["models"]).startswith("hpgr: calibrated on A, B")


def test_edge_share_is_read_off_the_distributions(written):
    tests = tables.read_pilot_tests("psd.csv", "runs.csv")
    assert pilot.edge_share(tests) == pytest.approx(0.22, abs=1e-6)


def test_tests_without_parts_and_power(written, folder, capsys):
    for path, dropped in (("psd.csv", ("centre", "edge")), ("runs.csv", ("P_kW",))):
        with open(path, newline="") as file:
            rows = list(csv.DictReader(file))
        kept = [name for name in rows[0] if name not in dropped]
        with open(path, "w", newline="") as file:
            csv.writer(file).writerows([kept, *([row[name] for name in kept] for row in rows)])
    assert main([*written, "--calibrate-on", "A", "B", "--no-plot", "--no-baselines"]) == 0
    out = capsys.readouterr().out
    assert "fitting sigma_m, w, gamma, K, alpha to A, B" in out
    with xr.open_dataset("outputs/pilot.nc") as result:
        one = result.sel(source="hpgr", test="C")
        assert np.isnan(one["rmse"].sel(part="edge"))
        assert float(one["rmse"].sel(part="total")) < 3


@pytest.mark.slow
def test_force_that_no_gap_carries_loses_its_test_only(written, folder, capsys):
    runs = folder / "runs.csv"
    runs.write_text(runs.read_text().replace("C,0.5,4.7", "C,0.5,900"))
    assert main([*written, "--calibrate-on", "A", "B", "--no-plot", "--no-baselines"]) == 0
    assert "reachable" in capsys.readouterr().out
    with xr.open_dataset("outputs/pilot.nc") as result:
        assert "900 MPa" in str(result["failure"].sel(source="hpgr", test="C").values)
        assert np.isnan(result["throughput"].sel(source="hpgr", test="C"))
        assert np.isfinite(result["throughput"].sel(source="hpgr", test="B"))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--calibrate-on", "K-P9"], ["--calibrate-on", "K-P9", "K-P1, K-P2"]),
        (["--tests", "none.csv"], ["cannot read none.csv: No such file", "--tests"]),
        (["--cells", "0"], ["--cells", "at least 1"]),
        (["--fit", "sigma"], ["fit", "sigma", "sigma_m"]),
    ],
)
def test_bad_input_is_refused(arguments, words, capsys, folder):
    assert main([*GRID, "--no-baselines", *arguments]) == 2
    err = capsys.readouterr().err
    assert err.startswith("error: ")
    assert all(word in err for word in words), err
    assert not list(folder.glob("outputs/*"))


@pytest.mark.slow
@pytest.mark.skipif(not COMPILED, reason="takes minutes without the compiler")
def test_porphyry_is_predicted_within_the_stated_errors(capsys):
    """The figures of docs/validation.md, to the digits that matter there."""
    assert main(["--no-plot", "--no-baselines"]) == 0
    with xr.open_dataset("outputs/pilot.nc") as result:
        blind = result.sel(source="hpgr", test=["K-P2", "K-P4", "K-P5"])
        total = blind["rmse"].sel(part="total")
        assert float(total.median()) < 2.5
        assert float(total.max()) < 5
        for name in ("throughput", "power"):
            measured = result[name].sel(source="measured", test=blind["test"].values)
            assert float(abs(blind[name] / measured - 1).max()) < 0.1, name
