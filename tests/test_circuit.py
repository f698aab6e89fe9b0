"""Closed circuits against balances, a linear system solved apart, and limits that are known."""

import numpy as np
import pytest
import xarray as xr
from support import plain_industrial

import hpgr
from hpgr.results.schema import STATUS
from studies.circuit import EdgeRecycle, Screen, close_circuit, main, steady, table
from studies.show.plots.circuit import circuit_figure

SMOOTH = {"resolution.points": 40, "resolution.streamlines": 2, "strength.cushioning": float("inf")}
FORCE = {"rolls.specific_pressing_force": "4 N/mm^2"}


@pytest.fixture(scope="module")
def scene():
    return plain_industrial().with_values(SMOOTH | FORCE)


def test_efficiency_of_the_screen():
    """Half at the cut, all of the coarse, the bypass of the finest; a sharp screen is a step."""
    screen = Screen(cut_size="6 mm", sharpness=5, bypass=0.1)
    assert screen.oversize([1e-9, 6e-3, 1.0]) == pytest.approx([0.1, 0.55, 1.0], abs=1e-6)
    assert (np.diff(screen.oversize(np.geomspace(1e-6, 1, 200))) >= 0).all()
    assert Screen(cut_size=6e-3, sharpness=1000).oversize([5.9e-3, 6.1e-3]) == pytest.approx([0, 1], abs=1e-6)
    with pytest.raises(ValueError, match=r"at most 0\.9"):
        Screen(cut_size="6 mm", bypass=1.0)


def test_steady_state_closes_its_balances(scene):
    screen = Screen(cut_size="8 mm", sharpness=6, bypass=0.05)
    found = steady(scene, screen)
    assert found.fresh.sum() == pytest.approx(1, abs=1e-12)
    assert found.product.sum() == pytest.approx(1, abs=1e-9)
    assert found.residual < 1e-9
    assert found.iterations <= 12
    # what goes back is what the screen takes out of the product of what went in, class by class
    rolls = np.diff(found.values["passing_total"], prepend=0.0) * (1 + found.load)
    assert found.back + found.product == pytest.approx(rolls, abs=1e-9)
    none = steady(scene, Screen(cut_size="1 m", sharpness=100))
    assert none.load == pytest.approx(0, abs=1e-6)
    alone = hpgr.simulate(scene.with_values({"resolution.record": "product"}))
    assert none.values["specific_energy"] == pytest.approx(float(alone["specific_energy"]), rel=1e-6)


def test_the_fixed_point_is_that_of_plain_rounds(scene):
    """Without cushioning crushing is linear in the feed, so rounds without acceleration end at the same recycle."""
    from studies import circuit

    screen = Screen(cut_size="10 mm", sharpness=6)
    found = steady(scene, screen)
    fine = scene.with_values({"resolution.sieves": circuit._SIEVES.tolist(), "resolution.record": "product"})
    back, fresh = np.zeros(circuit._SIEVES.size), found.fresh
    for _ in range(25):
        feed = circuit._table(fresh + back)
        values = hpgr.simulate(fine.with_values({"feed": feed}))
        over, _ = screen.split(fine, {"passing_total": values["passing_total"].values})
        back = over * (1 + back.sum())
    assert found.back == pytest.approx(back, abs=1e-6)  # passing is float32 here


def test_load_falls_with_the_cut_and_with_the_force(scene):
    loads = [steady(scene, Screen(cut_size=cut)).load for cut in ("7 mm", "9 mm", "12 mm")]
    assert loads == sorted(loads, reverse=True)
    assert loads[0] > 2 * loads[-1] > 0
    found = close_circuit(scene, Screen(cut_size="8 mm"), {"press_force": ["3 N/mm^2", "5 N/mm^2"]})
    assert found["circulating_load"].dims == ("press_force", "replicate")
    low, high = found["circulating_load"].values[:, 0]
    assert low > high
    load = 1 + found["circulating_load"]
    assert (found["fresh_feed"] * load).values == pytest.approx(found["throughput"].values, rel=1e-5)
    assert (found["specific_energy"] * load).values == pytest.approx(found["product_energy"].values, rel=1e-5)
    assert np.abs(found["mass_balance"]).max() < 1e-9
    assert (found["product_passing"] >= found["passing_total"]).all()  # finer than what the rolls make
    p80 = float(np.interp(0.8, found["product_passing"][0, 0], found["sieve"]))
    assert found["product_p80"].values[0, 0] == pytest.approx(p80, rel=0.03)


def test_a_load_without_end_is_refused(scene):
    """What stays above a cut of 1 mm is finer than any stress of this bed breaks."""
    with pytest.raises(ValueError, match=r"more than 2000 % of the fresh feed.*coarser than [\d.]+ mm.*cut coarser"):
        steady(scene, Screen(cut_size="1 mm"))
    some = close_circuit(scene, Screen(cut_size="5 mm"), {"press_force": ["2 N/mm^2", "6 N/mm^2"]})
    assert some["status"].values.ravel().tolist() == [STATUS["refused"], STATUS["ok"]]
    assert "cut coarser" in str(some["message"].values[0, 0])
    assert np.isnan(some["circulating_load"].values).ravel().tolist() == [True, False]
    assert "-" in table(some).splitlines()[1]
    with pytest.raises(ValueError, match=r"resolution\.cells"):
        steady(scene.with_values({"resolution.cells": 0}), Screen(cut_size="8 mm"))


def test_edges_go_back(scene):
    """A fixed share goes back whatever is in it: load = e / (1 - e); the centre is the product, finer than the edge."""
    wide = scene.with_values({"roll_width.edge_share": 0.25, "resolution.record": "product"})
    found = steady(wide, EdgeRecycle())
    assert found.load == pytest.approx(1 / 3, abs=1e-9)
    back, product = (np.cumsum(part) / part.sum() for part in (found.back, found.product))
    assert (product >= back - 1e-12).all()
    with pytest.raises(ValueError, match="roll_width: got none"):
        steady(scene, EdgeRecycle())


def test_grains_that_break_at_random_settle(scene):
    noisy = scene.with_values({"strength.cushioning": 1.0, "resolution.cells": 100})
    found = close_circuit(noisy, Screen(cut_size="10 mm"), replicates=2)
    assert np.abs(found["mass_balance"]).max() < 1e-9
    assert np.ptp(found["circulating_load"].values) < 0.2 * found["circulating_load"].values.min()
    figure = circuit_figure(found)
    assert len(figure.axes) == 3


@pytest.mark.slow
def test_command_line(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    small = ["--cells", "60", "--points", "30", "--streamlines", "2"]
    assert main(["--cut", "8 mm", "--vary", "press_force=3 N/mm^2..5 N/mm^2:2", *small]) == 0
    assert capsys.readouterr().out.splitlines()[0].split()[:2] == ["press", "force"]
    with xr.open_dataset("outputs/circuit.nc") as read:
        assert read["product_passing"].dims == ("press_force", "replicate", "sieve")
    assert main(["--cut", "8 mm", "--edge-recycle"]) == main(["--cut", "8 mm", "--vary", "gap=50 mm..60 mm"]) == 2
    assert "'gap=50 mm..60 mm'; must be values; such as 'gap=40 mm..60 mm:5'" in capsys.readouterr().err
    assert main(["--edge-recycle", *small, "--overwrite"]) == 2
    assert "roll_width" in capsys.readouterr().err
