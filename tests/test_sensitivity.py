"""Sobol indices on a function and on a scene that are known in closed form."""

import re

import numpy as np
import pytest
import xarray as xr
from support import paper

from studies.sensitivity import indices, main, sensitivity, table
from studies.show.plots.sensitivity import sensitivity_figure

STRESS_ONLY = {"resolution.cells": 0, "resolution.points": 30}


def ishigami(unit):
    x, y, z = (2 * unit.T - 1) * np.pi
    return np.array([np.sin(x) + 7 * np.sin(y) ** 2 + 0.1 * z**4 * np.sin(x), 0 * x + 3])


def test_ishigami():
    """Ishigami & Homma 1990, a = 7, b = 0.1: 0.3139, 0.4424, 0 alone and 0.5576, 0.4424, 0.2437 with others."""
    found = indices(ishigami, 3, 1024)
    assert found.shape == (2, 3, 2, 3)
    wanted = [[0.3139, 0.4424, 0.0], [0.5576, 0.4424, 0.2437]]
    assert found[:, 0, 0] == pytest.approx(np.array(wanted), abs=0.01)  # the same points at every run
    low, high = found[:, 1, 0], found[:, 2, 0]
    assert ((low < wanted) & (wanted < high)).all()
    assert np.isnan(found[:, :, 1]).all()  # the same everywhere
    assert np.array_equal(indices(ishigami, 3, 1024), found, equal_nan=True)


def test_throughput_is_a_product_of_independent_fields(client):
    """Q = rho_s phi s_b L U: of a product the first index is v_i prod(m_j^2) / V, with v its variance, m its mean."""
    over = {"bed.solid_density": (2000.0, 3500.0), "rolls.width": (0.5, 1.5), "roll_speed": (1.0, 1.2)}
    found = sensitivity(paper(STRESS_ONLY), over, ["throughput", "peak pressure"], count=256, client=client)
    low, high = np.array(list(over.values())).T
    mean, variance = (low + high) / 2, (high - low) ** 2 / 12
    every = np.prod(variance + mean**2) - np.prod(mean**2)
    first = [variance[k] * np.prod(np.delete(mean, k) ** 2) / every for k in range(3)]
    total = [variance[k] * np.prod(np.delete(mean**2 + variance, k)) / every for k in range(3)]
    assert found["first_order"].sel(figure="throughput").values == pytest.approx(np.array(first), abs=0.02)
    assert found["total_order"].sel(figure="throughput").values == pytest.approx(np.array(total), abs=0.02)
    assert found["total_order"].sel(figure="peak pressure").isnull().all()
    assert "it is the same everywhere" in table(found)
    assert table(found).splitlines()[1].split()[1] == "rolls.width"  # what matters most comes first
    assert len(sensitivity_figure(found).axes) == 2


def test_samples_stand_for_a_range(client):
    over = xr.Dataset({"rolls.width": ("sample", np.linspace(0.5, 1.5, 400)), "rolls.speed": ("sample", [1.0] * 400)})
    ranges = {"rolls.width": (0.5, 1.5), "rolls.speed": (1.0, 1.0 + 1e-9)}
    scene = paper(STRESS_ONLY)
    drawn, given = (sensitivity(scene, one, ["throughput"], count=16, client=client) for one in (over, ranges))
    assert drawn["total_order"].values == pytest.approx(given["total_order"].values, abs=1e-4)


def test_what_does_not_matter_has_no_index_at_all(client):
    scene = paper({"resolution.cells": 40, "resolution.points": 30, "resolution.streamlines": 2})
    over = {"gap": ("50 mm", "60 mm"), "roll_speed": ("15 rpm", "19 rpm")}
    found = sensitivity(scene, over, ["p80", "passing 3 mm"], count=8, client=client)
    assert (found["total_order"].sel(field="rolls.speed") == 0).all()  # the same random numbers: the same bits
    assert (found["total_order"].sel(field="rolls.gap") > 0.1).all()


@pytest.mark.parametrize(
    ("over", "figures", "count", "words"),
    [
        ({"gap": (0.05, 2.0)}, ["throughput"], 8, "10 of 24 cases are lost.*entry gap"),
        ({"gap": (0.05, 0.06)}, ["throughputs"], 8, "no figure 'throughputs'.*passing 6 mm.*throughput"),
        ({"gap": (0.05, 0.06)}, ["throughput"], 12, "power of two"),
        ({}, ["throughput"], 8, "no fields"),
        ({"gap": [0.05, np.nan, 0.06]}, ["throughput"], 8, "not finite"),
    ],
)
def test_refused(client, over, figures, count, words):
    with pytest.raises(ValueError, match=words):
        sensitivity(paper(STRESS_ONLY), over, figures, count=count, client=client)


@pytest.mark.slow
def test_command_line(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    small = ["--sample", "8", "--cells", "20", "--points", "30", "--streamlines", "2"]
    assert main(["--vary", "gap=50 mm..60 mm", "--vary", "roll_speed=15 rpm..19 rpm", *small]) == 0
    printed = capsys.readouterr().out
    assert "rolls.gap" in printed
    assert "passing 1 mm" in printed
    posterior = xr.Dataset({"rolls.gap": ("sample", np.linspace(0.05, 0.06, 50))})
    posterior.to_netcdf("posterior.nc")
    assert main(["--posterior", "posterior.nc", "--scene", "paper", "--figures", "power", "--out", "p", *small]) == 0
    with xr.open_dataset("p.nc") as read:
        assert read["total_order"].values == pytest.approx(1, abs=0.3)
    assert main(["--vary", "gap=50 mm,60 mm"]) == main(["--vary", "gap=5 mm..6 mm", "--vary", "gap=5 mm..7 mm"]) == 2
    assert re.search("'gap=50 mm,60 mm'; must be ranges.*\n.*gap twice; must be ranges", capsys.readouterr().err)
