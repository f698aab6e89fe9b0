import re
import subprocess
import sys

import numpy as np
import pytest
import xarray as xr
from support import SCENE_TOML as SCENE

import hpgr
from hpgr import pipeline
from studies import feed_sweep, gap_sweep, speed_sweep

SMALL = ["--cells", "60", "--points", "40", "--streamlines", "3"]
STUDIES = {"gap_sweep": gap_sweep, "speed_sweep": speed_sweep, "feed_sweep": feed_sweep}
SINGLE = SCENE.replace("uniform", "single").replace('bottom_size = "1 mm"\ntop_size', "size")


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """Every command runs in an empty folder."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def run(capsys):
    """Run a study; return its exit code, standard output and standard error."""

    def call(*arguments, study=gap_sweep):
        code = study.main([*SMALL, *arguments])
        return (code, *capsys.readouterr())

    return call


@pytest.fixture
def refused(run, folder, monkeypatch):
    """Assert that a command is refused before anything runs, and return its message."""

    def call(*arguments, study=gap_sweep):
        before = sorted(folder.rglob("*"))
        with monkeypatch.context() as patch:
            patch.setattr("studies.sweep.sweep", None)  # calling it would raise a TypeError
            code, out, err = run(*arguments, study=study)
        assert code == 2
        assert out == ""
        assert err.startswith("error: ")
        assert sorted(folder.rglob("*")) == before
        return err

    return call


def files(folder):
    """Names of all files but finished cases, which are beside the result in a folder of their own."""
    paths = (path.relative_to(folder) for path in folder.rglob("*") if path.is_file())
    return sorted(str(path) for path in paths if path.parent.suffix != ".cases")


def opened(path):
    with xr.open_dataset(path) as dataset:
        return dataset.load()


def python(*arguments):
    return subprocess.run([sys.executable, *arguments], capture_output=True, text=True, timeout=300)


@pytest.mark.parametrize("name", STUDIES)
def test_defaults(run, folder, name):
    code, out, err = run(study=STUDIES[name])
    assert code == 0, err
    assert files(folder) == [f"outputs/{name}.nc", f"outputs/{name}.png"]
    assert sorted(path.name for path in (folder / "outputs").iterdir()) == [
        f"{name}{end}" for end in (".cases", ".nc", ".png")
    ]
    assert (folder / "outputs" / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    assert f"wrote outputs/{name}.nc and outputs/{name}.png" in out
    assert STUDIES[name].STUDY.caption in out
    result = opened(f"outputs/{name}.nc")
    axis, own = {
        "gap_sweep": ("gap", 0.06),
        "speed_sweep": ("roll_speed", 19 * np.pi / 30),
        "feed_sweep": ("feed_top_size", 0.06),
    }[name]
    assert result["p80_total"].dims == (axis, "replicate")
    assert result.sizes["replicate"] == 3
    assert result[axis].size >= 4
    assert (np.diff(result[axis]) > 0).all()
    assert np.isclose(result[axis], own, rtol=1e-3).sum() == 1  # the scene itself is one of the points
    assert (result["status"] == 0).all()
    assert result.attrs["history"] == f"python -m studies.{name} {' '.join(SMALL)}"


def test_speed_study_says_that_only_throughput_changes(run):
    _, out, _ = run("--no-plot", study=speed_sweep)
    assert "speed changes throughput and nothing else" in out


@pytest.mark.parametrize(
    ("name", "dims"),
    [
        ("gap_sweep", ["gap", "roll_speed", "feed_top_size"]),
        ("speed_sweep", ["roll_speed", "gap", "feed_top_size"]),
        ("feed_sweep", ["feed_top_size", "gap", "roll_speed"]),
    ],
)
def test_further_axes(run, name, dims):
    code, out, _ = run(
        "--gap", "40 mm", "0.05 m", "--roll-speed", "15 rpm", "2 rad/s", "--feed-top-size", "5 cm", "60 mm",
        "--replicates", "1", "--out", "all", study=STUDIES[name],
    )  # fmt: skip
    assert code == 0
    result = opened("all.nc")
    assert result["p80_total"].dims == (*dims, "replicate")
    assert result["gap"].values.tolist() == [0.04, 0.05]
    assert result["roll_speed"].values == pytest.approx([np.pi / 2, 2], rel=1e-12)
    assert result["feed_top_size"].values == pytest.approx([0.05, 0.06], rel=1e-12)
    heading = {"gap": "gap [mm]", "roll_speed": "roll speed [rpm]", "feed_top_size": "feed top size [mm]"}
    assert re.split(r"\s{2,}", out.splitlines()[0].strip())[:3] == [heading[name] for name in dims]
    assert "±" not in out


def test_default_main_axis_comes_before_further_axes(run):
    assert run("--gap", "40 mm", "50 mm", "--replicates", "1", "--no-plot", study=speed_sweep)[0] == 0
    result = opened("outputs/speed_sweep.nc")
    assert result["throughput"].dims == ("roll_speed", "gap", "replicate")
    assert result.sizes["roll_speed"] == 6


def test_table_agrees_with_the_file(run):
    _, out, _ = run("--gap", "40 mm", "60 mm", "--sieve", "2 mm", "--no-plot")
    heading, *rows = [re.split(r"\s{2,}", line.strip()) for line in out.splitlines()[:3]]
    assert heading == [
        "gap [mm]", "throughput [t/h]", "P50 [mm]", "P80 [mm]", "below 2 mm [%]", "peak pressure [MPa]",
    ]  # fmt: skip
    result = opened("outputs/gap_sweep.nc")
    logs = np.log(result["sieve"].values)
    for k, (gap, *shown) in enumerate(rows):
        case = result.isel(gap=k)
        assert float(gap) == pytest.approx(float(case["gap"]) * 1e3)
        below = [100 * np.interp(np.log(2e-3), logs, one) for one in case["passing_total"].values]
        columns = [case["throughput"] * 3.6, case["p50_total"] * 1e3, case["p80_total"] * 1e3, below]
        columns.append(case["peak_pressure"] / 1e6)
        for text, values in zip(shown, columns, strict=True):
            mean, spread = map(float, text.split(" ± "))
            values = np.asarray(values, float)
            assert mean == pytest.approx(values.mean(), rel=6e-4)  # 4 digits are shown
            assert spread == pytest.approx(values.std(ddof=1), rel=0.06, abs=1e-12 * mean)  # 2 digits
    assert all(float(row[1].split(" ± ")[1]) == 0 for row in rows)  # throughput knows no chance
    assert all(float(row[3].split(" ± ")[1]) > 0 for row in rows)
    assert "(mean ± standard deviation of 3 replicates)" in out


def test_no_plot(run, folder):
    code, out, _ = run("--gap", "40 mm", "--no-plot")
    assert code == 0
    assert files(folder) == ["outputs/gap_sweep.nc"]
    assert ".png" not in out


@pytest.mark.parametrize(
    ("given", "made"),
    [("deep/run.nc", "deep/run"), ("run", "run"), ("run.v2", "run.v2")],
)
def test_out(run, folder, given, made):
    code, _, _ = run("--gap", "40 mm", "--replicates", "1", "--out", given)
    assert code == 0
    assert f"{made}.nc" in files(folder)
    assert f"{made}.png" in files(folder)
    assert (folder / f"{made}.cases" / "lock").is_file()
    assert len(files(folder)) == 2


def test_older_files_are_replaced(run, folder):
    (folder / "outputs").mkdir()
    for name in ("gap_sweep.nc", "gap_sweep.png"):
        (folder / "outputs" / name).write_bytes(b"old")
    assert run("--gap", "40 mm", "--replicates", "1")[0] == 0
    assert (folder / "outputs" / "gap_sweep.png").read_bytes().startswith(b"\x89PNG")
    assert opened("outputs/gap_sweep.nc")["gap"].values.tolist() == [0.04]
    assert len(files(folder)) == 2


def test_seed_and_replicates(run):
    for name, options in {"a": ["--seed", "7"], "b": ["--seed", "7", "--workers", "1"], "c": ["--seed", "8"]}.items():
        assert run("--gap", "40 mm", "--replicates", "2", "--no-plot", "--out", name, *options)[0] == 0
    a, b, c = (opened(f"{name}.nc") for name in "abc")
    assert a.attrs["seed"] == 7
    assert np.array_equal(a["passing"], b["passing"])
    assert not np.array_equal(a["passing"], c["passing"])


def test_resolution_options_reach_the_scene(run):
    run("--gap", "40 mm", "--replicates", "1", "--no-plot")
    grid = hpgr.Scene.model_validate_json(opened("outputs/gap_sweep.nc").attrs["scene"]).resolution
    assert (grid.cells, grid.points, grid.streamlines) == (60, 40, 3)


def test_stress_only(run, folder):
    code, out, _ = run("--gap", "40 mm", "50 mm", "--cells", "0")
    assert code == 0
    assert re.split(r"\s{2,}", out.splitlines()[0].strip()) == ["gap [mm]", "throughput [t/h]", "peak pressure [MPa]"]
    assert files(folder) == ["outputs/gap_sweep.nc", "outputs/gap_sweep.png"]
    assert "passing" not in opened("outputs/gap_sweep.nc")


def test_dry_run_lists_cases_and_writes_nothing(run, folder, monkeypatch):
    monkeypatch.setattr(hpgr, "simulate", None)
    code, out, err = run("--gap", "40 mm", "1.2 m", "--roll-speed", "15 rpm", "19 rpm", "--dry-run")
    assert (code, err) == (0, "")
    assert files(folder) == []
    rows = [line for line in out.splitlines() if re.match(r"\s+(40|1200) mm", line)]
    assert len(rows) == 4
    assert re.search(r"gap \[mm\]\s+roll speed \[rpm\]\s+memory\s+time", out)
    assert all(re.search(r"40 mm\s+1[59] rpm\s+[\d.]+ MB\s+[\d.]+ ms$", row) for row in rows[:2])
    assert all("refused: rolls.gap: got 1200 mm" in row for row in rows[2:])
    assert "12 cases (3 replicates each)" in out


def test_second_run_reads_every_case_back(run, folder, monkeypatch):
    code, out, err = run("--gap", "40 mm", "1.2 m", "60 mm", "--no-plot")
    assert code == 1
    assert "0 of 9 cases read back from outputs/gap_sweep.cases" in err
    assert re.search(r"9 cases to compute on 2 threads: predicted [\d.e-]+ s, at most [\d.]+ MB a case", err)
    first = opened("outputs/gap_sweep.nc")
    monkeypatch.setattr(pipeline, "crush", None)  # calling it would fail the case
    again, out_again, err_again = run("--gap", "40 mm", "1.2 m", "60 mm", "--no-plot")
    assert "6 of 9 cases read back from outputs/gap_sweep.cases" in err_again  # refused cases are not kept
    assert (again, out_again) == (code, out)
    xr.testing.assert_identical(opened("outputs/gap_sweep.nc"), first)
    code, _, err = run("--gap", "40 mm", "--no-plot", "--force")
    assert code == 1
    assert "failed: gap 40 mm, 3 of 3 replicates" in err  # nothing was read back


def test_dry_run_says_what_is_finished(run, folder):
    assert run("--gap", "40 mm", "60 mm", "--replicates", "2", "--no-plot")[0] == 0
    before = sorted(folder.rglob("*"))
    code, out, err = run("--gap", "40 mm", "50 mm", "60 mm", "--dry-run")
    assert (code, err) == (0, "")
    rows = [line.split()[-3:] for line in out.splitlines() if re.match(r"\s+[456]0 mm", line)]
    assert rows == [["2", "of", "3"], ["0", "of", "3"], ["2", "of", "3"]]
    assert "9 cases (3 replicates each), 4 of them finished already in outputs/gap_sweep.cases" in out
    assert sorted(folder.rglob("*")) == before
    assert "finished" not in run("--gap", "40 mm", "--dry-run", "--force")[1]


def test_interrupt_says_how_to_go_on(run, monkeypatch):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("studies.sweep.sweep", interrupted)
    code, _, err = run("--gap", "40 mm")
    assert code == 130
    assert "finished cases are kept" in err


def test_cases_recorded_whole(run, folder):
    import studies

    assert run("--gap", "40 mm", "60 mm", "--replicates", "2", "--no-plot", "--record", "distributions")[0] == 0
    cases = studies.open_cases("outputs/gap_sweep.cases")
    assert dict(cases["mass_fraction"].sizes)["gap"] == 2
    total = cases["mass_fraction"].sum("sieve").compute()
    assert np.allclose(total, 1, atol=1e-6)


def test_dry_run_predicts_more_for_more_cells(run):
    def time(cells):
        _, out, _ = run("--gap", "40 mm", "--dry-run", "--cells", cells)
        memory, time = re.search(r"([\d.]+) MB\s+([\d.]+) ms", out).groups()
        return float(memory), float(time)

    few, many = time("1000"), time("1000000")
    assert many[0] > 10 * few[0]
    assert many[1] > 10 * few[1]


def test_scene_from_toml_and_json(run, folder):
    (folder / "mine.toml").write_text(SCENE)
    assert run("--scene", "mine.toml", "--no-plot", "--out", "toml")[0] == 0
    result = opened("toml.nc")
    scene = hpgr.Scene.model_validate_json(result.attrs["scene"])
    assert (scene.rolls.diameter, scene.feed.top_size) == (0.8, 0.02)
    assert np.isclose(result["gap"], 0.019).sum() == 1
    (folder / "again.json").write_text(result.attrs["scene"])  # a result's own scene is an input
    assert run("--scene", "again.json", "--no-plot", "--out", "json")[0] == 0
    again = opened("json.nc")
    again.attrs["history"] = result.attrs["history"]
    xr.testing.assert_identical(again, result)


@pytest.mark.parametrize("name", STUDIES)
def test_khd_pilot_says_what_it_is_calibrated_on(run, name):
    code, out, _ = run("--scene", "khd_pilot", "--no-plot", "--replicates", "1", study=STUDIES[name])
    assert code == 0
    note = "ore and machine as fitted to pilot tests P1 and P3"
    assert f"note: {note}" in out
    scene = hpgr.Scene.model_validate_json(opened(f"outputs/{name}.nc").attrs["scene"])
    assert (scene.rolls.diameter, scene.rolls.width) == (0.8, 0.25)
    assert scene.note.startswith(note)


def test_feed_table_beside_the_scene_file(run, folder):
    (folder / "in").mkdir()
    (folder / "in" / "ore.csv").write_text("size_mm,percent_passing\n31.75,100\n10,50\n1,0\n")
    start = SCENE.partition("[feed]")[0]
    (folder / "in" / "mine.toml").write_text(start + '[feed]\nkind = "table"\ntable = "ore.csv"\n')
    assert run("--scene", "in/mine.toml", "--no-plot")[0] == 0
    # 31.75 mm is no round number: the default axis must not reach beyond it
    code, _, err = run("--scene", "in/mine.toml", "--no-plot", study=feed_sweep)
    assert (code, [line for line in err.splitlines() if "refused" in line]) == (0, [])


def test_lost_cases_are_named_and_exit_code_is_1(run, folder):
    code, out, err = run("--gap", "40 mm", "1.2 m")
    assert code == 1
    [line] = [line for line in err.splitlines() if line.startswith("refused")]
    assert line.startswith("refused: gap 1200 mm, 3 of 3 replicates: rolls.gap: got 1200 mm; must be at most")
    assert "entry gap 1140 mm" in line
    assert re.search(r"^\s+1200(\s+-){5}$", out, re.MULTILINE)
    assert files(folder) == ["outputs/gap_sweep.nc", "outputs/gap_sweep.png"]


def test_failing_case_is_named(run, monkeypatch):
    real = pipeline.crush

    def crush(scene, prepared, seed, replicate):
        if replicate == 1:
            raise RuntimeError("boom")
        return real(scene, prepared, seed, replicate)

    monkeypatch.setattr(pipeline, "crush", crush)
    code, out, err = run("--gap", "40 mm", "--no-plot")
    assert code == 1
    assert "failed: gap 40 mm, 1 of 3 replicates: RuntimeError: boom" in err
    assert "±" in out  # of the two that are left


def test_no_result_at_all(run, folder):
    code, out, err = run("--gap", "1.2 m", "2 m")
    assert code != 0
    assert "no case holds a result" in out + err
    assert err.count("refused: gap") == 2
    assert "outputs/gap_sweep.png" not in files(folder)


def test_feed_of_one_size_has_no_top_size(run, folder):
    (folder / "single.toml").write_text(SINGLE)
    code, _, err = run("--scene", "single.toml", study=feed_sweep)
    assert code == 2
    assert "--feed-top-size" in err
    assert "of a single size" in err
    assert run("--scene", "single.toml", "--no-plot", study=gap_sweep)[0] == 0


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--gap", "40"], ["gap", "'40'", "without a unit", "40 mm"]),
        (["--gap", "40 parsnips"], ["gap", "40 parsnips"]),
        (["--gap", "40 kg"], ["gap", "40 kg", "mm"]),
        (["--gap", "-40 mm"], ["gap", "-40 mm", "at least 0.001 mm"]),
        (["--gap", "40 mm", "4 cm"], ["gap", "0.04", "twice"]),
        (["--roll-speed", "3 m"], ["speed", "3 m", "rpm"]),
        (["--feed-top-size", "nan mm"], ["top_size", "NaN"]),
        (["--scene", "moon"], ["--scene", "'moon'", "paper", "khd_pilot", ".toml"]),
        (["--scene", "gone.toml"], ["gone.toml"]),
        (["--scene", "gone.json"], ["gone.json"]),
        (["--workers", "0"], ["--workers", "0", "at least 1"]),
        (["--replicates", "0"], ["--replicates", "0", "at least 1"]),
        (["--timeout", "0"], ["--timeout", "0", "0.1", "1,000,000"]),
        (["--timeout", "nan"], ["--timeout", "nan"]),
        (["--seed", "-1"], ["--seed", "-1", "from 0"]),
        (["--sieve", "3 m"], ["--sieve", "'3 m'", "1000 mm"]),
        (["--sieve", "1 nm"], ["--sieve", "'1 nm'", "0.001 mm"]),
        (["--sieve", "1"], ["--sieve", "without a unit"]),
        (["--sieve", "1 s"], ["--sieve"]),
        (["--cells", "-1"], ["cells", "-1", "at least 0"]),
        (["--points", "1"], ["points", "at least 2"]),
        (["--streamlines", "0"], ["streamlines", "at least 1"]),
    ],
)
def test_bad_options_are_refused(refused, arguments, words):
    message = refused(*arguments)
    for word in words:
        assert word in message


def test_seed_that_no_file_can_hold(run, folder):
    # NetCDF attributes are 64 bits: either refused at once, or written whole, but no sweep run in vain
    code, _, err = run("--gap", "40 mm", "--no-plot", "--seed", str(2**70))
    if code == 2:
        assert "--seed" in err
        assert files(folder) == []
    else:
        assert (code, str(opened("outputs/gap_sweep.nc").attrs["seed"])) == (0, str(2**70))


@pytest.mark.parametrize("arguments", [["--cells", "many"], ["--cels", "60"], ["--seed"], ["surprise"]])
def test_unknown_options_are_refused(folder, capsys, arguments):
    with pytest.raises(SystemExit) as caught:
        gap_sweep.main(arguments)
    assert caught.value.code == 2
    said = capsys.readouterr()
    assert arguments[0] in said.out + said.err
    assert files(folder) == []


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("bad.toml", "[rolls\n", ["bad.toml", "not TOML", "line 1"]),
        ("bad.json", "{", ["bad.json", "not JSON", "line 1"]),
        ("empty.toml", "", ["rolls", "feed", "required"]),
        (
            "faulty.toml",
            SCENE.replace('"0.8 m"', "true").replace('"19 mm"', '"19"').replace('"16 rpm"', '"-16 rpm"')
            .replace("bottom_size", "botom_size").replace('"20 mm"', '"200 mm"') + "\n[flows]\nexponent = 1\n",
            ["rolls.diameter", "rolls.gap", "rolls.speed", "feed.botom_size", "feed.bottom_size", "flows",
             "did you mean 'bottom_size'", "did you mean 'flow'", "feed.top_size", "entry gap"],
        ),
        ("wide.toml", SCENE.replace('"19 mm"', '"190 mm"'), ["rolls.gap", "190 mm", "163 mm", "narrow the gap"]),
    ],
)  # fmt: skip
def test_impossible_scenes_are_refused_with_every_fault(refused, folder, name, content, words):
    (folder / name).write_text(content)
    message = refused("--scene", name)
    for word in words:
        assert word in message


def test_scene_too_large_for_this_machine(run):
    code, _, err = run("--gap", "40 mm", "--cells", "2000000000", "--streamlines", "10000", "--replicates", "1")
    assert code != 0
    assert "predicted" in err
    assert "bytes" in err


def test_out_that_cannot_be_written(run, folder):
    (folder / "file").write_text("not a folder")
    code, _, err = run("--gap", "40 mm", "--replicates", "1", "--out", "file/run.nc")
    assert code == 2
    assert "could not write the result" in err
    assert files(folder) == ["file"]


def test_module_runs_as_a_command(folder, monkeypatch):
    # without the compiler NumPy speaks up when a 64-bit stream wraps, which is what it is there for
    monkeypatch.setenv("PYTHONWARNINGS", "ignore:overflow encountered in scalar:RuntimeWarning")
    done = python("-m", "studies.gap_sweep", *SMALL, "--gap", "40 mm", "1.2 m", "--out", "run.nc")
    assert done.returncode == 1, done.stderr
    assert "gap [mm]" in done.stdout
    assert "6 of 6 cases" in done.stderr  # progress in plain lines where no terminal is watching
    assert "Warning" not in done.stderr
    assert files(folder) == ["run.nc", "run.png"]
    result = opened("run.nc")
    assert (
        result.attrs["history"] == f"python -m studies.gap_sweep {' '.join(SMALL)} --gap '40 mm' '1.2 m' --out run.nc"
    )


@pytest.mark.parametrize("name", STUDIES)
def test_help_explains_every_option(name):
    done = python("-m", f"studies.{name}", "--help")
    assert done.returncode == 0
    for option in [
        "--gap", "--roll-speed", "--feed-top-size", "--scene", "--replicates", "--cells", "--points", "--streamlines",
        "--sieve", "--workers", "--scheduler", "--seed", "--out", "--no-plot", "--dry-run", "--force", "--timeout",
        "--record",
    ]:  # fmt: skip
        assert re.search(rf"{option}\b", done.stdout), option
    assert f"python -m studies.{name}" in done.stdout


_LATE = ("numba", "xarray", "matplotlib", "distributed", "dask", "netCDF4", "scipy", "pint")


def test_import_loads_nothing_heavy():
    # what makes `--help` quick, counted in modules rather than seconds
    done = python("-c", "import studies.gap_sweep, sys; print(*sys.modules)")
    loaded = set(done.stdout.split())
    assert "studies.command" in loaded
    assert not loaded & set(_LATE)


def test_gap_floats_under_a_swept_pressing_force(run):
    code, out, err = run("--press-force", "3 N/mm^2", "4.5 MPa", "--scene", "industrial", "--replicates", "1")
    assert code == 0, err
    assert "gap floats under the pressing force" in out
    result = opened("outputs/gap_sweep.nc")
    assert result["p80_total"].dims == ("press_force", "replicate")
    assert result["press_force"].values.tolist() == [3e6, 4.5e6]
    assert result["specific_pressing_force"].values[:, 0] == pytest.approx([3e6, 4.5e6], rel=1e-6)
    gaps = result["operating_gap"].values[:, 0]
    assert 0.02 < gaps[1] < gaps[0] < 0.1
    heading = next(line for line in out.splitlines() if "Fsp" in line)
    for figure in ("gap [mm]", "Fsp [N/mm²]", "power [kW]", "W [kWh/t]", "torque [kN m]", "beta [deg]"):
        assert figure in heading


def test_pressing_force_is_a_further_axis_of_the_other_sweeps(run):
    code, _, err = run(
        "--press-force", "3 MPa", "--roll-speed", "10 rpm", "20 rpm", "--scene", "industrial", "--replicates", "1",
        "--no-plot", study=speed_sweep,
    )  # fmt: skip
    assert code == 0, err
    result = opened("outputs/speed_sweep.nc")
    assert result["power"].dims == ("roll_speed", "press_force", "replicate")
    assert result["power"].values[1, 0, 0] == pytest.approx(2 * result["power"].values[0, 0, 0], rel=1e-6)


def test_force_that_no_gap_carries_is_named_with_the_reachable_range(run):
    code, _, err = run("--press-force", "3 MPa", "80 MPa", "--scene", "industrial", "--replicates", "1", "--no-plot")
    assert code == 1
    assert "80 MPa" in err
    assert "reachable" in err


def test_gap_beside_a_pressing_force_is_refused(refused, folder):
    assert "--press-force" in refused("--gap", "40 mm", "--press-force", "3 MPa")
    assert "MPa" in refused("--press-force", "3")
    assert "specific_pressing_force" in refused("--press-force", "3 mm")


def test_gap_sweep_of_a_scene_whose_gap_floats_is_refused(run, folder):
    floating = SCENE.replace('gap = "19 mm"', 'gap = "19 mm"\nspecific_pressing_force = "2 N/mm^2"')
    (folder / "mine.toml").write_text(floating)
    code, _, err = run("--scene", "mine.toml")
    assert code == 2
    assert "rolls.gap" in err
    assert "floats" in err
