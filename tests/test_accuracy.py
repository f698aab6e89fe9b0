import io
import subprocess
import sys

import numpy as np
import pytest
import xarray as xr
from support import SCENE_TOML, SIGMAS, feed_values, paper

from hpgr import kernels, parcels, pipeline
from studies import accuracy
from studies.plots import accuracy as plots

TINY = accuracy.Plan(
    held=(2, 26, 24),
    points=(11, 21, 41),
    many_cells=24,
    streamlines=(1, 2, 4),
    streamline_cells=16,
    cells=(4, 8, 16, 32),
    photographs=(1, 2, 4),
    photograph_cells=8,
    grid=((2,), (11, 21), (8, 16)),
    levels=(),
    reference=(3, 32),
    replicates=4,
)


@pytest.fixture(scope="module")
def measured():
    return accuracy.study(paper(), TINY)


def test_order_limit_and_index_of_manufactured_data():
    """f = 3 + 2 h^p on h = 4, 2, 1: the order is p, the limit 3, and the index 1.25 x 2, the true error."""
    for p in (0.5, 1.0, 1.7, 2.0):
        grids = [3 + 2 * h**p for h in (4.0, 2.0, 1.0)]
        assert accuracy.observed_order(*grids) == pytest.approx(p, abs=1e-12)
        assert accuracy.richardson(*grids) == pytest.approx(3, abs=1e-12)
        assert accuracy.convergence_index(*grids) == pytest.approx(1.25 * 2, abs=1e-12)


def test_orders_are_held_before_they_extrapolate():
    steep = [3 + 2 * h**5 for h in (4.0, 2.0, 1.0)]
    assert accuracy.observed_order(*steep) == pytest.approx(5)
    assert accuracy.richardson(*steep) == pytest.approx(steep[2] + (steep[2] - steep[1]) / 3)  # order 2: 2^2 - 1


def test_no_order_where_changes_differ_in_sign_or_are_none():
    assert np.isnan(accuracy.observed_order(1.0, 2.0, 1.5))
    assert accuracy.convergence_index(1.0, 2.0, 1.5) == pytest.approx(1.25 * 0.5 / (2**0.5 - 1))  # the lowest order
    assert np.isnan(accuracy.observed_order(7.0, 7.0, 7.0))
    assert accuracy.convergence_index(7.0, 7.0, 7.0) == 0
    assert np.isnan(accuracy.observed_order(7.0, 7.0 * (1 - 2e-16), 7.0 * (1 - 4e-16)))  # rounding is no change


def test_noise_exponent():
    """An exact power law gives its exponent; sampled noise leaves +-5 standard errors once in 1.7 million times."""
    sizes = np.array([10, 20, 40, 80])
    slope, _ = accuracy.noise_exponent(sizes, 3 / np.sqrt(sizes), 8)
    assert slope == pytest.approx(-0.5, abs=1e-12)
    generator = np.random.default_rng(0)
    means = [[generator.normal(size=size).mean() for _ in range(200)] for size in sizes]
    slope, error = accuracy.noise_exponent(sizes, np.std(means, axis=1, ddof=1), 200)
    assert abs(slope + 0.5) < SIGMAS * error
    assert error < 0.06
    assert np.isnan(accuracy.noise_exponent(sizes, np.zeros(4), 8)).all()


def test_jackknife_of_a_mean_is_its_standard_error():
    samples = np.random.default_rng(1).normal(size=(3, 9, 2))
    found = accuracy.jackknife(lambda means: means, samples)
    np.testing.assert_allclose(found, samples.std(axis=1, ddof=1) / 3, rtol=1e-12)


def test_pareto_by_hand():
    cost = [1, 2, 2, 3, 4, 5, 5]
    error = [9, 7, 6, 6, 8, 1, 1]
    # 2 is cheaper than none but more accurate; 3 is no better than 2, 4 worse; of the equals 5 and 6 the first
    assert accuracy.pareto(cost, error).tolist() == [True, False, True, False, False, True, False]


def test_plain_rule_is_the_kernels_bit_for_bit():
    scene = paper({"resolution.cells": 40, "material.fragment_exponent": 1.0})
    log_stress = np.log(pipeline.prepare(scene).crushing[1].clip(1e-300) / scene.material.strength)
    (sizes,), (streams,) = parcels.first_cells(scene, 0, [(0, 1, 0)])
    plain, plain_streams = sizes.copy(), streams.copy()
    accuracy.plain_march(scene, plain, plain_streams, log_stress)
    none, no_classes = np.empty((0, 0), np.float32), np.empty((0, 0), np.int64)
    needed = parcels.reach_needed(scene, log_stress)
    breaks = kernels.march(
        sizes, streams, log_stress, needed, np.empty(0), none, no_classes, *parcels.constants(scene)
    )  # fmt: skip
    assert breaks > 40
    np.testing.assert_array_equal(plain, sizes)
    np.testing.assert_array_equal(plain_streams, streams)


def test_storage_differs_by_its_rounding(measured):
    """Unless a decision falls the other way, a size has taken at most one rounding of 6e-8 for every break."""
    assert (measured["storage_cells_apart"] == 0).all()
    assert 0 < np.abs(measured["storage_difference"].sel(sampled_quantity=["p50", "p80"])).max() < 30 * 6e-8


def test_lattice_without_exchange_is_the_march(measured):
    assert (measured["lattice_less_march"] == 0).all()
    assert measured["solver"].values.tolist() == ["closed form", "march", "lattice"]


def test_marched_without_cushioning_tends_to_the_closed_form():
    """Points refined: the bias of P50 and P80 falls, and at 641 points is within 5 standard errors of the finest."""
    closed = paper({"material.cushioning": "inf", "resolution.points": 641, "resolution.record": "product"})
    marched = closed.with_values({"material.cushioning": accuracy._FREE, "resolution.cells": 60})
    exact = pipeline.crush(closed, pipeline.prepare(closed), 0, 0)["p80_total"]
    found = []
    for points in (11, 41, 641):
        scene = marched.with_values({"resolution.points": points})
        bed = pipeline.prepare(scene)
        found.append([pipeline.crush(scene, bed, 0, replicate)["p80_total"] for replicate in range(6)])
    bias = np.abs(np.mean(found, axis=1) / exact - 1)
    assert bias[0] > bias[1] > bias[2]
    assert bias[2] < SIGMAS * np.std(found[2], ddof=1) / np.sqrt(6) / exact + 0.01


def test_so_weak_a_cushioning_is_none():
    """The same bits as n = inf, which has to record cells to be marched."""
    scene = paper({"material.cushioning": "inf", "resolution.record": "cells"})
    free = scene.with_values({"material.cushioning": accuracy._FREE})
    one, other = (pipeline.crush(each, pipeline.prepare(each), 0, 0)["size"] for each in (scene, free))
    np.testing.assert_array_equal(one, other)


def test_replicates_share_their_random_numbers_over_points():
    """Grains that do not cushion each other draw the same fragments whatever the time step, if it is small enough."""
    plan = TINY._replace(points=(101, 201, 401), many_cells=60, replicates=6)
    ladder = accuracy._ladders(paper({"material.cushioning": accuracy._FREE}), plan)["points: scene"]
    p80 = [[accuracy._run(scene, 0, replicate)[0][1] for replicate in range(6)] for scene in ladder.scenes[1:]]
    assert np.diff(p80, axis=0).std() < 0.5 * np.std(p80[1])


def test_bias_and_noise_are_those_of_the_samples(measured):
    samples = measured["cells_p80"].values
    found = measured.sel(quantity="p80")
    scale = samples[-1].mean()
    np.testing.assert_allclose(found["cells_bias"], (samples.mean(axis=1) - scale) / scale, atol=1e-15)
    np.testing.assert_allclose(found["cells_noise"], samples.std(axis=1, ddof=1) / scale)
    stress = measured["cells_noise"].sel(quantity=["peak_pressure", "throughput"])
    assert (stress == 0).all()  # no cells in them
    limit = accuracy.richardson(*measured["points_p80"].sel(variant="scene").values.mean(axis=1))
    np.testing.assert_allclose(measured["limit_p80"].sel(variant="scene"), limit)


def test_error_of_a_combination(measured):
    error = np.abs(measured["combination_bias"]) + 2 * measured["combination_noise"]
    np.testing.assert_allclose(measured["combination_error"], error)
    worst = error.sel(quantity=["p50", "p80", "below_1mm"]).max("quantity")
    np.testing.assert_allclose(measured["combination_worst_error"], worst)
    assert measured.sizes["combination"] == 4
    assert accuracy.chosen(measured, float(worst.max())) == int(measured["combination_wall_time"].values.argmin())
    assert accuracy.chosen(measured, 0.0) is None


def test_same_seed_same_figures(measured):
    again = accuracy.study(paper(), TINY)
    names = [name for name in measured if not name.endswith("wall_time") and "front" not in name]
    xr.testing.assert_identical(measured[names], again[names])


def test_a_scene_in_which_nothing_breaks_has_errors_too():
    hard = paper({"material.strength": "1e14 Pa"})
    result = accuracy.study(hard, TINY)
    assert (result["points_bias"] == 0).sel(quantity=["p50", "p80", "below_1mm"]).all()  # every rung has the same feed
    assert np.isfinite(result["combination_error"]).all()
    assert np.isnan(result["cells_noise_exponent"].sel(quantity="below_1mm"))
    draw(result)
    accuracy.in_words(accuracy.tables(result), markdown=True)


def test_flat_bed_and_half_cushioning():
    """No pressure at all: 0 / 0 is no error. The scene's own n = 0.5 is not run twice."""
    scene = paper({"rolls.entry_gap": 0.06, "material.cushioning": 0.5})
    result = accuracy.study(scene, TINY)
    assert (result["points_bias"].sel(quantity="peak_pressure") == 0).all()
    assert result["variant"].values.tolist() == ["scene", "euler"]
    draw(result)


@pytest.mark.parametrize(
    "values",
    [
        {"material.cushioning": "inf"},  # closed form: no noise
        {"material.strength": "1e14 Pa"} | feed_values(kind="single", size=0.02),  # no error of any kind
    ],
)
def test_scenes_without_noise(values):
    result = accuracy.study(paper(values), TINY)
    assert (result["cells_noise"] == 0).all()
    assert np.isnan(result["cells_noise_exponent"]).all()
    draw(result)
    assert "-" in accuracy.in_words(accuracy.short_tables(result), markdown=False)


def test_without_size_effect_there_is_no_closed_form():
    scene = paper({"material.weibull_modulus": "inf", "material.size_floor": "1 mm"})
    assert list(accuracy._solvers(scene, 2)) == ["march", "lattice"]


def draw(result):
    figure = plots.accuracy_figure(result)
    figure.savefig(io.BytesIO(), dpi=20)
    return figure


def test_figure(measured):
    panels = draw(measured).axes
    assert len(panels) == 7
    assert all(panel.get_xlabel().endswith("[ms]") for panel in panels)
    assert all("%" in panel.get_ylabel() for panel in panels)


def test_every_variable_is_labelled(measured):
    for name, variable in measured.variables.items():
        assert variable.attrs["long_name"], name
        assert "units" in variable.attrs or variable.dtype.kind == "U", name
    for name in ("scene", "seed", "replicates", "versions", "safety_factor"):
        assert name in measured.attrs


@pytest.fixture
def run(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(accuracy, "QUICK", TINY)

    def call(*arguments):
        code = accuracy.main(["--quick", *arguments])
        return (code, *capsys.readouterr())

    return call


def test_command(run, tmp_path, measured):
    code, out, err = run("--replicates", "4", "--markdown")
    assert code == 0
    assert "wrote outputs/accuracy.nc and outputs/accuracy.png" in out
    assert "runs" in err
    assert "| points | time [ms] | P50 [%] |" in out
    with xr.open_dataset(tmp_path / "outputs/accuracy.nc") as dataset:
        result = dataset.load()
    assert result.attrs["history"] == "python -m studies.accuracy --quick --replicates 4 --markdown"
    assert set(result.variables) == set(measured.variables)
    for name, variable in measured.variables.items():
        assert result[name].attrs == variable.attrs, name
        assert result[name].dims == variable.dims, name
    again = result["combination_worst_error"]
    assert again.dtype == np.float64
    assert np.isfinite(result["points_p80"]).all()
    assert (tmp_path / "outputs/accuracy.png").read_bytes().startswith(b"\x89PNG")


def test_command_without_a_picture(run, tmp_path):
    code, out, _ = run("--no-plot", "--out", "here", "--scene", "khd_pilot", "--replicates", "2")
    assert code == 0
    assert [path.name for path in tmp_path.iterdir()] == ["here.nc"]
    assert "Which resolution" in out
    assert "|" not in out


SCENE = "{head}" + SCENE_TOML + "\n{tail}\n"


@pytest.mark.parametrize(
    ("arguments", "tail", "words"),
    [
        ((), "[resolution]\ncells = 0", "resolution.cells 0"),
        ((), "[resolution]\ncells = 1", "resolution.cells 1"),
        ((), "[exchange]", "exchange"),
        (("--replicates", "1"), "", "--replicates: got 1"),
        (("--seed", "-1"), "", "--seed"),
    ],
)
def test_refused(run, tmp_path, arguments, tail, words):
    path = tmp_path / "scene.toml"
    path.write_text(SCENE.format(head="", tail=tail))
    code, out, err = run("--scene", "scene.toml", *arguments)
    assert code == 2
    assert out == ""
    assert err.startswith("error: ")
    assert words in err
    assert list(tmp_path.iterdir()) == [path]


def test_unknown_scene_is_refused(run):
    code, _, err = run("--scene", "nothing")
    assert code == 2
    assert "paper" in err


def test_help_needs_neither_compiler_nor_xarray_nor_matplotlib():
    code = (
        "import sys\nfrom studies import accuracy\n"
        "try:\n    accuracy.main(['--help'])\nexcept SystemExit as done:\n    assert done.code == 0\n"
        "print(sorted({'numba', 'xarray', 'matplotlib'} & set(sys.modules)))"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert found.returncode == 0, found.stderr
    assert found.stdout.splitlines()[-1] == "[]"
