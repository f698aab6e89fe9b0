"""The optimum against fine grids and against points that are known, and what it says where there is none."""

import numpy as np
import pytest
import xarray as xr
from support import plain_industrial

import hpgr
from studies.optimum import as_toml, main, optimise
from studies.quantities import quantity_of, with_sieves
from studies.show.plots.optimum import optimum_figure
from studies.sweep import sweep

SMOOTH = {"resolution.points": 40, "resolution.streamlines": 2, "strength.cushioning": float("inf")}
NOISY = {"resolution.points": 30, "resolution.streamlines": 2, "resolution.cells": 100}
FORCE, NIP = ("2 N/mm^2", "5 N/mm^2"), ("7 deg", "10 deg")


def industrial(values):
    return plain_industrial().with_values(values)


def grid(scene, axes, limits, client, replicates):
    """Least specific energy on a fine grid where every figure is at least its limit."""
    wanted = [quantity_of(name) for name in ("specific energy", *limits)]
    found = sweep(with_sieves(scene, wanted), axes, replicates, client=client)
    energy, *figures = (one.of(found).astype(float).mean("replicate") for one in wanted)
    for values, least in zip(figures, limits.values(), strict=True):
        energy = energy.where(values >= least)
    return float(energy.min())


@pytest.mark.parametrize(
    ("values", "replicates", "fine"),
    [pytest.param(SMOOTH, 1, 85, id="closed form"), pytest.param(NOISY, 4, 65, id="march", marks=pytest.mark.slow)],
)
def test_never_worse_than_a_fine_grid(client, values, replicates, fine):
    """Two fields, two bounds of which one or both bind: the energy is at most that of a grid, but for its error."""
    scene = industrial(values)
    bounds = {"passing 6 mm": f">= {fine} %", "throughput": ">= 800 t/h"}
    over = {"press_force": FORCE, "flow.nip_angle": NIP}
    best = optimise(scene, over, "specific energy", None, bounds, client=client)
    axes = {"press_force": np.linspace(2e6, 5e6, 16), "flow.nip_angle": np.radians(np.linspace(7, 10, 13))}
    least = grid(scene, axes, {"passing 6 mm": fine / 100, "throughput": 800 / 3.6}, client, replicates)
    energy, error = best.figures["specific energy"]
    assert energy <= least + error
    assert error < 0.02 * energy
    passing, passing_error = best.figures["passing 6 mm"]
    assert passing >= fine / 100 - 2 * passing_error
    assert best.scene == scene.with_values(best.values)


def test_one_force_meets_a_bound_and_speed_does_not_matter(client):
    """Energy and fineness both grow with force: the least energy is where the bound binds."""
    scene = industrial(SMOOTH)
    over = {"press_force": FORCE, "roll_speed": ("10 rpm", "20 rpm")}
    best = optimise(scene, over, minimise="energy", subject_to={"passing 6 mm": ">= 80 %"}, client=client)
    assert best.binding == ["passing 6 mm >= 80 %"]
    assert best.figures["passing 6 mm"][0] == pytest.approx(0.8, abs=2e-3)
    assert best.without_effect == ["rolls.speed does not matter to specific energy, passing 6 mm; it is not varied"]
    assert best.values["rolls.speed"] == scene.rolls.speed
    assert best.figures["throughput"][1] < 0.01 * best.figures["throughput"][0]
    front = best.tradeoff["best_energy"].values.astype(bool)
    passing = quantity_of("passing 6 mm").of(best.tradeoff).values[:, 0]
    assert front[passing.argmax()]
    energy, fine = quantity_of("energy").of(best.tradeoff).values[front, 0], passing[front]
    assert (np.diff(energy[np.argsort(fine)]) >= 0).all()
    assert len(optimum_figure(best).axes) == 2


def test_the_most_throughput_lies_at_the_end_of_the_range(client):
    over = {"press_force": FORCE, "roll_speed": ("10 rpm", "20 rpm")}
    best = optimise(industrial(SMOOTH), over, maximise="throughput", subject_to={}, client=client)
    assert sorted(best.binding) == [
        "rolls.specific_pressing_force at the lowest of its range",
        "rolls.speed at the highest of its range",
    ]
    assert best.values == pytest.approx({"rolls.specific_pressing_force": 2e6, "rolls.speed": 20 * np.pi / 30})
    finest = best.tradeoff["p80_total"].values[:, 0]
    assert best.tradeoff["best_throughput"].values[finest == finest.min()].any()
    assert not best.tradeoff["best_throughput"].values.all()


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        ({"subject_to": {"P80": "<= 0.1 mm"}}, r"got P80 <= 0.1 mm; [\d.]+ mm to [\d.]+ mm is reached within"),
        ({"subject_to": {"passing 6 mm": ">= 85 %", "energy": "<= 0.7 kWh/t"}}, "is reached, but not together"),
        ({"subject_to": {"P80": "5 mm"}}, "must be a bound"),
        ({"maximise": "throughput"}, "one to maximise"),
        ({"over": {"press_force": ("900 N/mm^2", "990 N/mm^2")}}, "are lost.*reachable"),
    ],
)
def test_refused(client, asked, words):
    given = {"over": {"press_force": FORCE}, "minimise": "energy"} | asked
    with pytest.raises(ValueError, match=words):
        optimise(industrial(SMOOTH), client=client, **given)


def test_a_scene_file_gives_the_scene_back(tmp_path):
    extra = {"roll_width": {}, "resolution.record": "product", "remark": 'a "quoted" µ'}
    for name in hpgr.presets.NAMES:
        scene = hpgr.Scene.preset(name).with_values(extra | {"strength.cushioning": float("inf")})
        (tmp_path / "scene.toml").write_text(as_toml(scene), encoding="utf-8")
        assert hpgr.Scene.from_file(tmp_path / "scene.toml") == scene


@pytest.mark.slow
def test_command_line(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    arguments = ["--vary", "press_force=2 N/mm^2..5 N/mm^2", "--minimise", "energy", "--cells", "60", "--points", "30"]
    bound = ["--subject-to", "passing 6 mm >= 70 %", "throughput >= 500 t/h"]
    assert main([*arguments, *bound, "--streamlines", "2"]) == 0
    assert "binding: passing 6 mm >= 70 %" in capsys.readouterr().out
    scene = hpgr.Scene.from_file("outputs/optimum.toml")
    assert 2e6 < scene.rolls.specific_pressing_force < 5e6
    with xr.open_dataset("outputs/optimum.nc") as tradeoff:
        assert tradeoff["press_force"].dims == ("sample",)
    assert main([*arguments, "--streamlines", "2"]) == 0  # its own files are replaced
    assert main([*arguments, "--subject-to", "P80 <= 1 um"]) == 2
    assert "is reached" in capsys.readouterr().err
