import numpy as np
import pytest
import xarray as xr
from PIL import Image
from support import paper, plain_industrial, plain_pilot, sized

import hpgr
from hpgr.bed.geometry import between_rolls
from hpgr.grains.solve import crushing_stress
from hpgr.run import load
from studies import paper as study
from studies.show.plots import paper as plots

SMALL = {"resolution.streamlines": 4, "resolution.points": sized(81, 41), "resolution.cells": sized(400, 100)}
SHOWN = 24
CHANCE = 1e-6  # of a false alarm, in every sampled comparison here


@pytest.fixture(scope="module")
def scene():
    return paper(SMALL)


@pytest.fixture(scope="module")
def result(scene):
    return study.study(scene, SHOWN, seed=3, assumptions=False)


@pytest.fixture(scope="module")
def alone(scene):
    return hpgr.simulate(scene, seed=3)


@pytest.mark.slow
def test_command_makes_every_file(tmp_path, capsys):
    small = ["--streamlines", "2", "--points", "21", "--cells", "30", "--shown-points", "8"]
    assert study.main([*small, "--out", str(tmp_path / "new")]) == 0
    told = capsys.readouterr().out
    names = {"paper.nc", *study.FIGURES, study.ANIMATION}
    assert {path.name for path in (tmp_path / "new").iterdir()} == names
    for name in names:
        assert str(tmp_path / "new" / name) in told
    for name in study.FIGURES:
        with Image.open(tmp_path / "new" / name) as picture:
            assert min(picture.size) > 500
    with (
        xr.open_dataset(tmp_path / "new" / "paper.nc") as opened,
        Image.open(tmp_path / "new" / study.ANIMATION) as gif,
    ):
        assert gif.n_frames == opened.sizes["snapshot"] == 8
        assert gif.info["comment"].decode() == opened.attrs["history"]
        assert opened.attrs["history"].startswith("python -m studies.paper --streamlines 2")
        assert hpgr.Scene.model_validate_json(opened.attrs["scene"]).resolution.points == 21
        lines = [line for line in told.splitlines() if line.startswith(tuple(opened["assumption"].values))]
        assert len(lines) == opened.sizes["variant"] > 8
        for name, variable in opened.variables.items():
            assert variable.attrs["long_name"], name
            assert "units" in variable.attrs or variable.dtype.kind in "UO", name


def bed_of(scene):
    rolls = scene.rolls
    return between_rolls(rolls.diameter, rolls.gap, rolls.entry_gap, np.ones(1))


def test_halves_are_mirror_images(result):
    for name in ("xi", "x", "shown_x"):
        values = result[name].values
        assert np.array_equal(values, -values[::-1]), name
        assert (np.diff(values, axis=0) > 0).all(), name  # the left roll to the right one
    for name in ("height", "shown_height", "speed", "pressure", "shear_stress", "volume"):
        values = result[name].values
        assert np.array_equal(values, values[::-1]), name
    assert result["xi"].values[[0, 4, 5, 6, -1]].tolist() == [-1.0, -0.125, 0.0, 0.125, 1.0]
    assert result["shown_x"].shape == (8, SHOWN)


def test_fields_are_those_of_the_simulation(result, alone):
    """The stream tubes' centres, beside mid-plane and rim, hold what hpgr.simulate has there."""
    for side in (slice(6, 10), slice(4, 0, -1)):
        for name in ("pressure", "shear_stress", "speed", "volumetric_strain_rate"):
            np.testing.assert_allclose(result[name].values[side], alone[name].values, rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(np.abs(result["x"].values[side]), alone["x"].values, rtol=1e-12)


def test_mid_gap_pressure(result, alone, scene):
    """Pressure is even in x: from two stream tubes at xi and 3 xi it is (9 p(xi) - p(3 xi)) / 8 on the mid-plane."""
    pressure = alone["pressure"].values.astype(float)
    between = (9 * pressure[0] - pressure[1]) / 8
    found = result["pressure"].values[5].astype(float)
    np.testing.assert_allclose(found, between, atol=2e-3 * found.max())
    assert abs(found - pressure[0]).max() > abs(found - between).max()  # it is not just the first stream tube's
    depth = result["mid_gap_depth"].values
    assert depth[-1] == pytest.approx(bed_of(scene).height)
    assert depth[0] == pytest.approx(0.02 * depth[-1])
    assert (np.diff(depth) > 0).all()


def test_pressure_is_as_the_paper_says(result):
    """A sharp rise with depth, largest at mid-gap and lower towards the roll."""
    pressure = result["pressure"].values
    loaded = pressure[5] > 0.05 * pressure.max()
    assert (np.diff(pressure[5:, loaded], axis=0) < 0).all()
    begin, most = study.crossing_heights(result.isel(streamline=5), (0.1, 0.9))
    assert 0.1 < most < begin < 0.75
    along, height = pressure[5], result["height"].values[5]
    assert (along[height > begin] <= 0.1 * along.max()).all()
    assert along[height == most] > 0.9 * along.max()


def test_outlines_enclose_the_volumes(result):
    corners = np.column_stack([result["corner_x"].values, result["corner_height"].values])
    owner = result["corner_outline"].values
    areas = np.zeros(4 * SHOWN)
    for outline, cell in enumerate(result["outline_cell"].values):
        x, y = corners[owner == outline].T
        areas[cell] += abs(np.dot(x[:-1], y[1:]) - np.dot(x[1:], y[:-1])) / 2
    np.testing.assert_allclose(areas, result["volume"].values[4:].ravel(), rtol=1e-9)


def test_distributions_are_those_of_the_simulation():
    scene = paper(SMALL | {"resolution.control_variate": False})  # cells count
    result, alone = study.study(scene, SHOWN, seed=3, assumptions=False), hpgr.simulate(scene, seed=3)
    expected = hpgr.passing(alone, result["sieve"].values)
    np.testing.assert_allclose(result["passing"].values, expected.values, atol=1e-6)
    cells = np.sort(alone["size"].values[0, :, -1], axis=-1)
    np.testing.assert_allclose(result["p80"].values, np.quantile(cells, 0.8, axis=-1), rtol=1e-6)
    np.testing.assert_allclose(result["p50"].values, np.quantile(cells, 0.5, axis=-1), rtol=1e-6)
    uniform = np.clip((result["sieve"].values - 0.008) / 0.052, 0, 1)
    np.testing.assert_allclose(result["feed_passing"].values, uniform, atol=1e-7)


def test_centre_is_finer_than_the_edge():
    """First-order stochastic dominance, innermost over outermost stream tube.

    Without cushioning it is exact: the tube with the larger peak stress has the smaller critical size. Sampled, two
    samples of M independent cells differ against it by more than sqrt(ln(1 / CHANCE) / M) with probability CHANCE at
    most (one-sided Dvoretzky-Kiefer-Wolfowitz bound for two equal samples, exp(-M d^2)); cells are stratified, and
    depend on their neighbours only.
    """
    scene = paper(SMALL | {"strength.cushioning": "inf"})
    exact = study.study(scene, SHOWN, animation=False, assumptions=False)
    inner, outer = exact["passing"].values[[0, -1]]
    assert (inner >= outer).all()
    assert (inner - outer).max() > 0.03
    cells = sized(20_000, 1000)
    sampled = study.study(paper(SMALL | {"resolution.cells": cells}), SHOWN, animation=False, assumptions=False)
    inner, outer = sampled["passing"].values[[0, -1]].astype(float)
    threshold = np.sqrt(np.log(1 / CHANCE) / cells)
    assert (outer - inner).max() < threshold
    if cells == 20_000:
        assert (inner - outer).max() > 2 * threshold
        assert float(sampled["p80"][0]) < float(sampled["p80"][-1])


def test_startup_begins_with_feed_and_ends_steady(result, scene, alone):
    """Where nothing is stressed the first snapshot holds feed, whose P80 stratified sampling knows to a stratum."""
    snapshots = result["startup_p80"].values
    cells = min(SMALL["resolution.cells"], 400)
    coarse = paper(SMALL | {"resolution.points": SHOWN})
    still = study.mirrored(crushing_stress(*load(coarse)) == 0)
    assert still.any()
    assert not still.all()
    p80 = float(scene.feed.quantile(0.8))
    stratum = 0.052 / cells
    np.testing.assert_allclose(snapshots[0][still], p80, atol=2 * stratum)
    assert snapshots[0].min() > 0.2 * p80  # one break at most
    assert snapshots[-1].min() < 0.2 * p80
    assert result["steady"].values.tolist() == [0] * (len(snapshots) - 1) + [1]
    elapsed = result["elapsed_time"].values
    assert elapsed[0] == 0
    assert elapsed[-1] == pytest.approx(float(alone["residence_time"][0, -1]))
    np.testing.assert_allclose(np.diff(elapsed), float(result["shown_time_step"]))
    # steady, and without exchange: what a simulation without the lattice has at the exit
    same = hpgr.simulate(coarse.with_values({"resolution.record": "product"}), seed=3)
    np.testing.assert_allclose(snapshots[-1][4:, -1], same["p80"].values, rtol=1e-6)


def test_assumptions_change_one_thing_each(scene):
    first, *others = study.variants(scene).values()
    assert first == scene.with_values({"resolution.record": "product"})
    assert len(others) >= 11
    for other in others:
        assert len({key for key, part in dict(first).items() if dict(other)[key] != part} - {"resolution"}) == 1
    assert "n = inf" not in study.variants(scene.with_values({"strength.cushioning": "inf"}))
    assert not any("speed exponent" in name for name in study.variants(plain_industrial()))  # a nip has none


def test_assumed_figures_are_of_the_simulations(scene, monkeypatch):
    few = {"as it is": scene, "c = 1": scene.with_values({"elasticity.exponent": 1.0})}
    monkeypatch.setattr(study, "variants", lambda _: few)
    result = study.study(scene, SHOWN, seed=5, animation=False)
    assert result["assumption"].values.tolist() == list(few)
    for k, other in enumerate(few.values()):
        run = hpgr.simulate(other.with_values({"resolution.record": "product"}), seed=5)
        for name, place in {"mid_gap": 0, "roll": -1}.items():
            assert result[f"assumed_peak_pressure_{name}"][k] == run["streamline_peak_pressure"][place]
            assert result[f"assumed_p80_{name}"][k] == run["p80"][place]


def test_all_is_drawn_at_the_gap_that_carries_the_force():
    """The gap given is 55 mm, at which the force would be 3.83 N/mm2; fields, points and products are one machine's."""
    small = {"resolution.streamlines": 2, "resolution.points": 61, "resolution.cells": 40}
    forced = small | {"rolls.specific_pressing_force": "4 N/mm^2"}
    scene = plain_industrial().with_values(forced)
    result = study.study(scene, 20, assumptions=False)
    gap = hpgr.operating_gap(scene, "4 N/mm^2")
    assert gap == pytest.approx(0.0537, abs=2e-4)
    assert hpgr.Scene.model_validate_json(result.attrs["scene"]).rolls.gap == gap
    assert float(2 * (result["roll_axis_x"] - result["roll_radius"])) == pytest.approx(gap)
    alone = hpgr.simulate(scene)
    np.testing.assert_allclose(result["pressure"].values[4:6], alone["pressure"].values, rtol=1e-6, atol=1e-3)
    np.testing.assert_array_equal(result["p80"], alone["p80"])
    wall = result["x"].values[-1, -1]
    assert wall == pytest.approx(gap / 2)
    assert result["shown_x"].values[-1, -1] == pytest.approx(0.75 * wall)  # the middle of the outer of two tubes


def test_words_put_the_figures_of_the_dataset_beside_the_papers(result):
    words = "\n".join(study.findings(result))
    peak = 1e-6 * result["pressure"].values[5].astype(float).max()
    assert f"peaks with {peak:.4g} MPa" in words
    assert "falls all the way" in words
    p80 = 1e3 * result["p80"].values
    assert f"P80 is {p80[0]:.4g} mm in the innermost stream tube and {p80[-1]:.4g} mm in the outermost" in words
    flat = result.assign(pressure=result["pressure"] * 0 + 1.0)
    assert "does not fall all the way" in "\n".join(study.findings(flat))


def test_exchange_reaches_product_and_startup(scene):
    small = scene.with_values({"exchange": {}, "resolution.points": 31, "resolution.cells": 50})
    result = study.study(small, 12, seed=1, assumptions=False)
    alone = hpgr.simulate(small.with_values({"resolution.record": "product"}), seed=1)
    np.testing.assert_allclose(result["p80"].values, alone["p80"].values, rtol=1e-6)
    assert result.attrs["solver"].endswith("lattice")
    still = study.study(small.with_values({"exchange": None}), 12, seed=1, assumptions=False)
    assert not np.array_equal(result["startup_p80"].values, still["startup_p80"].values)


@pytest.mark.parametrize(
    ("arguments", "message"), [(["--cells", "0"], "--cells: got 0"), (["--shown-points", "2"], "--shown-points: got 2")]
)
def test_what_cannot_be_is_refused(arguments, message, tmp_path, capsys):
    assert study.main([*arguments, "--out", str(tmp_path / "new")]) == 2
    out, err = capsys.readouterr()
    assert not out
    assert message in err
    assert not (tmp_path / "new").exists()


def test_no_bed_is_refused(scene):
    with pytest.raises(ValueError, match=r"rolls.gap: got the entry gap"):
        study.study(scene.with_values({"rolls.gap": 1.14}), SHOWN)


@pytest.mark.slow
def test_scenes_in_which_nothing_happens_are_drawn(tmp_path):
    """No pressure at all, hence no contour lines, no crushing, and one size everywhere in the animation."""
    small = {"resolution.streamlines": 1, "resolution.points": 11, "resolution.cells": 20}
    small |= {"flow.kind": "power", "flow.exponent": 2.0, "rolls.entry_gap": 0.163}
    scene = plain_pilot().with_values(small)
    result = study.study(scene, 6, assumptions=False)
    assert not result["pressure"].any()
    assert "the bed is not compacted" in study.findings(result)[0]
    for draw in (plots.figure3, plots.figure4, plots.figure5):
        draw(result).savefig(tmp_path / "figure.png", dpi=30)
    plots.startup_animation(result, tmp_path / "startup.gif")
    with Image.open(tmp_path / "startup.gif") as gif:
        assert gif.info["duration"] >= 400
