"""Spaces: grids, samples, operating points and named scenes are one thing, whatever they are given as."""

import numpy as np
import pytest
import xarray as xr
from support import paper

import hpgr
from hpgr.results.schema import STATUS
from studies import open_cases
from studies.command import varied
from studies.gap_sweep import main
from studies.show import page, report
from studies.show.plots import maps
from studies.sweep import netcdf, sweep
from studies.sweep.space import Space, axes_of, between, ends_of, field_of, sobol_design, sobol_points

GAPS, SPEEDS = [0.04, 0.06], [1.5, 2.0]


@pytest.fixture(scope="module")
def base():
    return paper({"resolution.cells": 30, "resolution.points": 30})


def fields(space):
    """What each case of a space changes, in order."""
    return [case.values for case in Space(axes_of(space)).cases()]


def test_names_dotted_plain_and_of_dimensions():
    assert field_of("rolls.gap") == field_of("gap") == "rolls.gap"
    assert field_of("roll_speed") == field_of("speed") == "rolls.speed"
    assert field_of("cushioning") == field_of("strength_cushioning") == "strength.cushioning"
    assert field_of("points") == "resolution.points"
    with pytest.raises(ValueError, match=r"exponent: .* feed\.exponent, flow\.exponent"):
        field_of("exponent")
    with pytest.raises(ValueError, match="no field 'gapp'"):
        field_of("gapp")


def test_every_way_to_give_values_is_the_same():
    import pint

    unit = pint.UnitRegistry()
    wanted = fields({"rolls.gap": GAPS})
    for values in (
        ["40 mm", "6 cm"],
        np.array(GAPS),
        [40 * unit.mm, 6 * unit.cm],
        [40, 60] * unit.mm,
        xr.DataArray(GAPS),
        xr.DataArray([40.0, 60.0], dims="gap", attrs={"units": "mm"}),
    ):
        assert fields({"gap": values}) == wanted
    assert fields(xr.Dataset({"rolls.gap": ("gap", GAPS)})) == fields(xr.Dataset(coords={"gap": GAPS})) == wanted
    assert fields({"strength.cushioning": [0.5 * unit.dimensionless]}) == [{"strength.cushioning": 0.5}]


def test_fields_of_a_tuple_or_of_one_dimension_vary_together():
    rows = list(zip(GAPS, SPEEDS, strict=True))
    wanted = [{"rolls.gap": gap, "rolls.speed": speed} for gap, speed in rows]
    assert fields({("gap", "roll_speed"): rows}) == wanted
    assert fields({("gap", "roll_speed"): np.array(rows)}) == wanted
    both = xr.Dataset({"gap": ("shift", GAPS), "rolls.speed": ("shift", SPEEDS)}, {"shift": ["day", "night"]})
    assert fields(both) == fields(dict(both)) == wanted
    assert axes_of(both)["shift"].labels == ["day", "night"]
    assert list(axes_of({("gap", "roll_speed"): rows})) == ["sample"]
    product = {("gap", "roll_speed"): rows, "cushioning": [0.5, 1.0, 2.0]}
    assert Space(axes_of(product), 4).shape == (2, 3, 4)
    assert len({str(case) for case in fields(product)}) == 6


@pytest.mark.parametrize(
    ("space", "words"),
    [
        ({"rolls.gap": [0.04, "40 mm"]}, "twice"),
        ({("gap", "speed"): [(0.04,)]}, r"rolls.gap, rolls.speed: got \[0.04\]; must be a value of each"),
        ({"gap": GAPS, ("gap", "speed"): [(0.04, 2.0)]}, "rolls.gap: got it along gap and along sample"),
        ({"gap": xr.DataArray(GAPS, dims="sample"), "speed": xr.DataArray([2.0], dims="sample")}, "got 1 values along"),
        ({"gap": xr.DataArray([GAPS], dims=("a", "b"))}, "lies along one"),
        ({"gap": xr.DataArray(GAPS, dims="point")}, "'point', which results have"),
        ({"speed": xr.DataArray(SPEEDS, dims="gap")}, "gap: is a dimension without rolls.gap"),
        ({"gap": xr.DataArray([0.04, np.nan], dims="sample")}, "NaN"),
        ({"scene": ["paper"]}, "must be named scenes"),
        ({"gap": [[0.04]]}, "rolls.gap"),
    ],
)
def test_what_is_no_space_is_refused(space, words):
    with pytest.raises(ValueError, match=words):
        axes_of(space)


def test_laws_are_an_axis_by_their_kinds(base, client):
    with pytest.raises(ValueError, match=r"feed\.kind: got 'square'; must be one of 'uniform', 'single', 'power_law'"):
        axes_of({"feed.kind": ["square"]})
    found = sweep(base, {"flow.kind": ["power", "nip"]}, client=client)
    assert found["flow_kind"].values.tolist() == ["power", "nip"]
    assert [int(status) == STATUS["ok"] for status in found["status"].values.ravel()] == [True, False]
    assert "nip_angle" in found["message"].values[1, 0]  # which the paper's scene has not


def test_a_sample_is_a_sweep_like_any_other(base, client, tmp_path):
    """Every place holds its own case, in the result, in the file, read back, opened whole and on the page."""
    rows = [(0.05, 2.0), (0.04, 1.5), (0.05, 2.0)]  # the last is the first again, as of a posterior
    space = {("gap", "roll_speed"): rows}
    whole = {"record": "distributions", "folder": tmp_path / "cases", "client": client}
    result = sweep(base, space, replicates=2, **whole)
    assert result["p80_total"].dims == ("sample", "replicate")
    assert result["gap"].dims == result["roll_speed"].dims == ("sample",)
    assert result["gap"].attrs["scene_field"] == "rolls.gap"
    assert (result["status"] == STATUS["ok"]).all()
    for k, (gap, speed) in enumerate(rows):
        alone = hpgr.simulate(base.with_values({"rolls.gap": gap, "rolls.speed": speed}), replicate=1)
        assert result["p80_total"].values[k, 1] == alone["p80_total"]
    grid = sweep(base, {"gap": [0.04, 0.05]}, client=client)
    assert np.array_equal(grid["passing"].values[1], result["passing"].values[0, :1])
    assert sweep(base, space, replicates=2, **whole).identical(result)
    cases = open_cases(tmp_path / "cases")
    assert cases["gap"].values.tolist() == [gap for gap, _ in rows]
    assert np.array_equal(cases["passing"].values, result["passing"].values)
    netcdf.write_dataset(result, tmp_path / "r.nc")
    with netcdf.open_result(tmp_path / "r.nc") as read:
        assert report.table(read, 1e-3) == report.table(result, 1e-3)
        [axis] = page.page_data(read, 1e-3, "r")["axes"]
    assert axis["texts"][1] == "gap 40 mm, roll speed 14.3239 rpm"
    assert axis["raw"][1] == {"rolls.gap": 0.04, "rolls.speed": 1.5}
    assert report.place_text(result, "sample", 1) == axis["texts"][1]


def test_named_scenes_are_compared(base, client):
    hard = base.with_values({"strength.reference_strength": "2 MPa", "exchange": None, "remark": "hard"})
    result = sweep(base, {"scene": {"soft": base, "hard": hard}, "gap": [0.05, 1.2]}, client=client)
    assert result["p80_total"].dims == ("scene", "gap", "replicate")
    assert result["scene"].values.tolist() == ["soft", "hard"]
    for name, scene in {"soft": base, "hard": hard}.items():
        alone = hpgr.simulate(scene.with_values({"rolls.gap": 0.05}))
        assert result["p80_total"].sel(scene=name, gap=0.05).item() == alone["p80_total"]
    assert "scene hard, gap 1200 mm" in report.lost_cases(result)[1]
    assert result["roll_speed"] == base.rolls.speed  # the same in both
    other = sweep(base, {"scene": {"slow": base, "fast": base.with_values({"rolls.speed": 3.0})}}, client=client)
    assert "roll_speed" not in other.coords
    assert page.page_data(result, 1e-3, "r")["axes"][0]["changes"][1] == {"strength.reference_strength": 2e6}
    floating = base.with_values({"rolls.specific_pressing_force": 3e6})
    with pytest.raises(ValueError, match="gap floats"):
        sweep(base, {"scene": {"one": base, "other": floating}, "gap": [0.05]})


def test_an_active_client_is_used(base):
    from distributed import Client, LocalCluster

    quiet = {"dashboard_address": "127.0.0.1:0", "worker_dashboard_address": "127.0.0.1:0", "memory_limit": 0}
    with LocalCluster(processes=False, n_workers=1, threads_per_worker=1, **quiet) as cluster, Client(cluster) as own:
        before = own.run_on_scheduler(lambda dask_scheduler: len(dask_scheduler.transition_log))
        sweep(base, {"gap": [0.05]})
        assert own.run_on_scheduler(lambda dask_scheduler: len(dask_scheduler.transition_log)) > before


def test_designs_fill_their_ranges_evenly():
    unit = sobol_points(2, 64, 3)
    assert np.array_equal(sobol_points(2, 64, 3), unit)
    assert not np.array_equal(sobol_points(2, 64, 4), unit)
    assert (np.histogram2d(*unit.T, bins=8, range=[[0, 1], [0, 1]])[0] == 1).all()  # a (0, 6, 2)-net
    ends = ends_of({"gap": ("40 mm", "60 mm"), "resolution.cells": (10, 20)})
    assert between(ends, np.array([[0.5, 0.26], [1.0, 0.0]])) == [(0.05, 13), (0.06, 10)]
    [rows] = sobol_design({"gap": ("40 mm", "60 mm"), "roll_speed": (1.0, 2.0)}, 5).values()
    assert len(rows) == 5
    for name, ends in {"gap": ("60 mm", "40 mm"), "cushioning": (1.0, float("inf")), "roll_speed": (1.0, 1.0)}.items():
        with pytest.raises(ValueError, match="lowest first"):
            ends_of({name: ends})


def test_what_vary_takes():
    assert varied("gap=40 mm, 60 mm") == ("rolls.gap", ["40 mm", "60 mm"])
    assert varied("gap=40 mm..60 mm:3") == ("rolls.gap", [0.04, 0.05, 0.06])
    assert varied("gap=40 mm..60 mm") == ("rolls.gap", (0.04, 0.06))
    assert varied("strength.cushioning=0.5,inf") == ("strength.cushioning", [0.5, float("inf")])
    assert varied("resolution.cells=10..20:3") == ("resolution.cells", [10, 15, 20])
    assert varied("elasticity.integrator=euler,increment")[1] == ["euler", "increment"]
    wrong = {"gap": "field and its values", "gap=1 mm..2 mm:x": "number of values", "gap=1..2": "unit"}
    for text, words in wrong.items():
        with pytest.raises(ValueError, match=words):
            varied(text)


def test_two_axes_of_numbers_make_a_map(base, client):
    axes = {"gap": [0.06, 0.04, 0.05], "press_force": None, "roll_speed": [1.0, 1.5, 2.0]}
    result = sweep(base, {name: values for name, values in axes.items() if values}, client=client)
    assert maps.is_map(result)
    assert not maps.is_map(result.isel(gap=slice(2)))
    figure = maps.maps_figure(result, 1e-3, "words")
    titles = [panel.get_title() for panel in figure.axes]
    assert titles == ["below 1 mm [%]", "W [kWh/t]", "throughput [t/h]", "P80 [mm]"]
    [dots] = [line for line in figure.axes[2].lines if line.get_marker() == "."]
    assert sorted(zip(*dots.get_data(), strict=True))[0] == pytest.approx((40, 30 / np.pi))
    assert "words" in figure.get_supxlabel()
    top = next(part for part in figure.axes[2].collections if part.get_array() is not None).get_paths()[-1]
    assert top.vertices[:, 0].mean() > 50  # most throughput at wide gaps and high speed
    assert top.vertices[:, 1].mean() > 45 / np.pi
    fineness = np.concatenate([part.get_array() for part in figure.axes[0].collections if part.get_array() is not None])
    assert np.ptp(fineness) > 1


def test_command_line_of_a_space(capsys):
    """Scenes, a grid and a design make one space; what does not fit together is refused."""
    tiny = ["--dry-run", "--replicates", "1", "--cells", "20", "--points", "20", "--streamlines", "2"]
    design = ["--vary", "gap=50 mm..60 mm", "--vary", "roll_speed=15 rpm..19 rpm", "--sample", "4"]
    assert main([*tiny, *design, "--vary", "cushioning=0.5,inf", "--scene", "paper", "industrial"]) == 0
    lines = capsys.readouterr().out.splitlines()
    headings = "scene sample gap [mm] roll speed [rpm] strength cushioning memory time"
    assert " ".join(lines[2].split()) == headings
    assert sum("inf" in line for line in lines) == 8
    assert any(line.startswith("16 cases") for line in lines)
    assert main([*tiny, "--vary", "feed.top_size=40 mm..60 mm:3"]) == 0  # beside the study's own axis
    assert "18 cases" in capsys.readouterr().out
    for given, words in {
        ("--vary", "gap=50 mm..60 mm"): "--sample go together",
        ("--sample", "4"): "--sample go together",
        ("--gap", "50 mm", "--vary", "gap=60 mm"): "twice",
        ("--vary", "press_force=3 MPa", "--gap", "50 mm"): "gap floats",
        ("--scene", "paper", "paper"): "different names",
    }.items():
        assert main([*tiny, *given]) == 2
        assert words in capsys.readouterr().err


@pytest.mark.slow
def test_command_line_draws_a_design_and_compares_scenes(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    tiny = ["--replicates", "1", "--cells", "20", "--points", "20", "--streamlines", "2"]
    design = ["--vary", "gap=50 mm..60 mm", "--vary", "roll_speed=15 rpm..19 rpm", "--sample", "4"]
    assert main([*tiny, *design]) == 0
    assert "4 cases to compute" in capsys.readouterr().err
    assert main([*tiny, "--gap", "50 mm", "--scene", "paper", "industrial", "--out", "both"]) == 0


def test_bands_of_a_calibration_apart_from_chance(tmp_path, monkeypatch, capsys):
    """Density moves throughput alone, by as much as it scatters; chance moves P80 alone."""
    from studies.show.plots.bands import bands, bands_figure

    monkeypatch.chdir(tmp_path)
    drawn = {"bed.solid_density": np.linspace(2400, 3000, 40), "strength.reference_strength": np.full(40, 8.4e5)}
    file = xr.Dataset({name: ("sample", values) for name, values in drawn.items()} | {"other": ("test", [1.0])})
    netcdf.write_dataset(file, "posterior.nc")
    tiny = ["--replicates", "2", "--cells", "30", "--points", "20", "--streamlines", "2"]
    tiny += ["--scene", "paper", "--calibration", "posterior.nc"]
    assert main([*tiny, "--gap", "50 mm", "60 mm"]) == 0
    assert " to " in capsys.readouterr().out.splitlines()[1]
    with xr.open_dataset("outputs/gap_sweep.nc") as result:
        assert result["p80_total"].dims == ("gap", "sample", "replicate")
        found = bands(result.load(), 1e-3)
    throughput, p80 = found["throughput [t/h]"], found["P80 [mm]"]
    width = ((throughput.high - throughput.low) / throughput.mean).values
    assert width == pytest.approx(0.95 * np.ptp(drawn["bed.solid_density"][:32]) / 2638, rel=0.02)
    assert (throughput.noise == 0).all()
    assert (p80.high == p80.low).all()
    assert (p80.noise > 0).all()
    assert len(bands_figure(result, 1e-3, "words").axes) == 4
    assert main([*tiny[:-1], "outputs/gap_sweep.nc", "--out", "other"]) == 2
    assert "no samples" in capsys.readouterr().err
