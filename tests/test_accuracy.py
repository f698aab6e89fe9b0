import io

import numpy as np
import pytest
import xarray as xr
from support import paper, plain_industrial

import hpgr
from hpgr.run import run_scene
from studies import accuracy
from studies.convergence import jackknife, observed_order, richardson, unbeaten
from studies.show import accuracy_tables as tables
from studies.show.plots.accuracy import accuracy_figure

TINY = accuracy.Plan((2, 26, 24), (11, 21, 41), 24, (1, 2, 4), 16, (4, 8, 16, 32), (1, 2, 4), 8)._replace(
    grid=((2,), (11, 21), (8, 16)), levels=(), reference=(3, 32), replicates=4
)


@pytest.fixture(scope="module")
def measured():
    return accuracy.study(paper(), TINY)


def test_order_and_limit_of_manufactured_data():
    """f = 3 + 2 h^p on h = 4, 2, 1: the order is p, the limit 3."""
    for p in (0.5, 1.0, 1.7, 2.0):
        grids = [3 + 2 * h**p for h in (4.0, 2.0, 1.0)]
        assert observed_order(*grids) == pytest.approx(p, abs=1e-12)
        assert richardson(*grids) == pytest.approx(3, abs=1e-12)
    steep = [3 + 2 * h**5 for h in (4.0, 2.0, 1.0)]
    assert observed_order(*steep) == pytest.approx(5)
    assert richardson(*steep) == pytest.approx(steep[2] + (steep[2] - steep[1]) / 3)  # held at order 2: 2^2 - 1


def test_no_order_where_changes_differ_in_sign_or_are_none():
    assert np.isnan(observed_order(1.0, 2.0, 1.5))
    assert richardson(1.0, 2.0, 1.5) == pytest.approx(1.5 - 0.5 / (2**0.5 - 1))  # the lowest order
    assert np.isnan(observed_order(7.0, 7.0, 7.0))
    assert richardson(7.0, 7.0, 7.0) == 7
    assert np.isnan(observed_order(7.0, 7.0 * (1 - 2e-16), 7.0 * (1 - 4e-16)))  # rounding is no change


def test_jackknife_of_a_mean_is_its_standard_error():
    samples = np.random.default_rng(1).normal(size=(3, 9, 2))
    found = jackknife(lambda means: means, samples)
    np.testing.assert_allclose(found, samples.std(axis=1, ddof=1) / 3, rtol=1e-12)


def test_pareto_by_hand():
    # 2 is cheaper than none but more accurate; 3 is no better than 2, 4 worse; equals stay, what is not known goes
    cost, error = np.array([1, 2, 2, 3, 4, 5, 5, 0]), np.array([9, 7, 6, 6, 8, 1, 1, np.nan])
    assert unbeaten(-cost, -error).tolist() == [True, False, True, False, False, True, True, False]


def test_the_lattice_without_swaps_is_the_march(measured):
    for name in accuracy.QUANTITIES:
        solved = measured[f"solver_{name}"]
        assert (solved.sel(solver="lattice") == solved.sel(solver="march")).all()
    assert measured["solver"].values.tolist() == ["closed form", "march", "lattice"]
    assert list(accuracy._solvers(paper({"strength.weibull_modulus": "inf"}))) == ["march", "lattice"]


def test_replicates_share_their_random_numbers_over_points():
    """Grains that do not cushion each other draw the same fragments whatever the time step, if it is small enough."""
    plan = TINY._replace(points=(101, 201, 401), many_cells=60, replicates=6)
    scenes = accuracy._ladders(paper({"strength.cushioning": accuracy._FREE}), plan)["points"].scenes[1:3]
    p80 = [[run_scene(scene, 0, replicate).values["p80_total"] for replicate in range(6)] for scene in scenes]
    assert np.diff(p80, axis=0).std() < 0.5 * np.std(p80[1])


def test_bias_noise_and_error_are_those_of_the_samples(measured):
    samples = measured["cells_p80"].values
    found = measured.sel(quantity="p80")
    scale = samples[-1].mean()
    np.testing.assert_allclose(found["cells_bias"], (samples.mean(axis=1) - scale) / scale, atol=1e-15)
    np.testing.assert_allclose(found["cells_noise"], samples.std(axis=1, ddof=1) / scale)
    stress = measured["cells_noise"].sel(quantity=["peak_pressure", "throughput"])
    assert (stress == 0).all()  # no cells in them
    limit = richardson(*measured["points_p80"].sel(variant="scene").values.mean(axis=1))
    bias = (measured["points_p80"].sel(variant="scene").mean("replicate") - limit) / abs(limit)
    np.testing.assert_allclose(measured["points_bias"].sel(variant="scene", quantity="p80"), bias)
    error = np.abs(measured["combination_bias"]) + 2 * measured["combination_noise"]
    worst = error.sel(quantity=["p50", "p80", "below_1mm"]).max("quantity")
    np.testing.assert_allclose(measured["combination_worst_error"], worst)
    assert measured.sizes["combination"] == 4


def test_a_machine_with_a_pressing_force_is_measured_at_the_gap_that_carries_it():
    """The gap given is 55 mm, at which the force would be 3.83 N/mm2."""
    industrial = plain_industrial().with_values({"resolution.cells": 64})
    plan = TINY._replace(points=(41, 81, 161))
    forced = industrial.with_values({"rolls.specific_pressing_force": "4 N/mm^2"})
    result = accuracy.study(forced, plan)
    scene = hpgr.Scene.model_validate_json(result.attrs["scene"])
    assert scene.rolls.gap == pytest.approx(0.0537, abs=1e-4)
    by_gap = accuracy.study(industrial.with_values({"rolls.gap": scene.rolls.gap}), plan)
    for name in ("points_throughput", "points_peak_pressure"):
        finest = (each[name].sel(variant="scene", points=161) for each in (result, by_gap))
        np.testing.assert_allclose(*finest, rtol=5e-3)


@pytest.mark.parametrize(
    ("values", "silent"),
    [
        pytest.param({"strength.cushioning": "inf"}, True, marks=pytest.mark.slow),  # closed form: no noise
        pytest.param(
            {"strength.reference_strength": "1e14 Pa", "feed": {"kind": "single", "size": 0.02}},
            True,
            marks=pytest.mark.slow,
        ),
        ({"rolls.entry_gap": 0.06, "strength.cushioning": 0.5}, False),  # no pressure: 0 / 0 is no error
    ],
)
def test_scenes_in_which_little_happens_have_errors_too(values, silent):
    result = accuracy.study(paper(values), TINY)
    assert np.isfinite(result["combination_worst_error"]).all()
    if silent:
        assert (result["cells_noise"] == 0).all()
    if "rolls.entry_gap" in values:
        assert (result["points_bias"].sel(quantity="peak_pressure") == 0).all()
        assert result["variant"].values.tolist() == ["scene", "euler"]  # the scene's own n = 0.5 is not run twice
    accuracy_figure(result).savefig(io.BytesIO(), dpi=20)
    for markdown in (False, True):
        assert "-" in tables.in_words(result, markdown)


@pytest.fixture
def run(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(accuracy, "QUICK", TINY)

    def call(*arguments):
        code = accuracy.main(["--quick", *arguments])
        return (code, *capsys.readouterr())

    return call


@pytest.mark.slow
def test_command(run, tmp_path, measured):
    code, out, err = run("--replicates", "4", "--markdown")
    assert code == 0, err
    assert "wrote outputs/accuracy.nc and outputs/accuracy.png" in out
    assert "| points | time [ms] | P50 [%] |" in out
    with xr.open_dataset(tmp_path / "outputs/accuracy.nc") as dataset:
        result = dataset.load()
    assert result.attrs["history"] == "python -m studies.accuracy --quick --replicates 4 --markdown"
    assert set(result.variables) == set(measured.variables)
    for name, variable in measured.variables.items():
        assert result[name].attrs == variable.attrs, name
        assert variable.attrs["long_name"], name
        assert "units" in variable.attrs or variable.dtype.kind == "U", name
    assert np.isfinite(result["points_p80"]).all()
    panels = accuracy_figure(result).axes
    assert len(panels) == 7
    assert all(panel.get_xlabel().endswith("[ms]") and "%" in panel.get_ylabel() for panel in panels)


@pytest.mark.parametrize(
    ("values", "arguments", "words"),
    [
        ({"resolution.cells": 0}, (), "resolution.cells 0"),
        ({"resolution.cells": 1}, (), "resolution.cells 1"),
        ({"exchange": {}}, (), "exchange"),
        ({}, ("--replicates", "1"), "--replicates: got 1"),
    ],
)
def test_refused(run, tmp_path, values, arguments, words):
    path = tmp_path / "scene.json"
    path.write_text(paper(values).model_dump_json())
    code, out, err = run("--scene", "scene.json", *arguments)
    assert code == 2
    assert out == ""
    assert words in err
    assert list(tmp_path.iterdir()) == [path]
