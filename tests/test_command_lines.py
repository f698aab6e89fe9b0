"""The command lines of the sweeps, and what all studies share: options, files, refusals, exit codes."""

import re
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from support import SCENE_TOML as SCENE
from support import one_by_one

import hpgr
from hpgr.bed.machine import specific_pressing_force
from studies import command, feed_sweep, gap_sweep, speed_sweep
from studies.__main__ import commands
from studies.__main__ import main as any_study
from studies.show import report
from studies.sweep import run as running
from studies.sweep.study import Options
from studies.sweep.study import _default_values as default_values

SMALL = ["--cells", "60", "--points", "40", "--streamlines", "3"]
STUDIES = {"gap_sweep": gap_sweep, "speed_sweep": speed_sweep, "feed_sweep": feed_sweep}


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """Every command runs in an empty folder."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(autouse=True)
def own_client(client, monkeypatch):
    """Every sweep runs on one cluster, which takes half a second to start."""
    from contextlib import nullcontext

    monkeypatch.setattr(running, "own_client", lambda threads: nullcontext(client))


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


# ---- what a sweep does


@pytest.mark.parametrize(
    ("name", "axis", "own"),
    [("gap_sweep", "gap", 0.06), ("speed_sweep", "roll_speed", 19 * np.pi / 30), ("feed_sweep", "feed_top_size", 0.06)],
)
def test_defaults(run, folder, name, axis, own):
    plot = ["--no-plot"] * (name != "gap_sweep")
    code, out, err = run(*plot, study=STUDIES[name])
    assert code == 0, err
    if plot:
        assert files(folder) == [f"outputs/{name}.nc"]
    else:
        assert files(folder) == [f"outputs/{name}.nc", f"outputs/{name}.png"]
        assert (folder / "outputs" / f"{name}.png").read_bytes().startswith(b"\x89PNG")
        assert f"wrote outputs/{name}.nc and outputs/{name}.png" in out
    assert STUDIES[name].STUDY.caption in out
    result = opened(f"outputs/{name}.nc")
    assert result["p80_total"].dims == (axis, "replicate")
    assert result.sizes["replicate"] == 3
    assert result[axis].size >= 4
    assert (np.diff(result[axis]) > 0).all()
    assert np.isclose(result[axis], own, rtol=1e-3).sum() == 1  # the scene itself is one of the points
    assert (result["status"] == 0).all()
    assert result.attrs["history"] == " ".join([f"python -m studies.{name}", *SMALL, *plot])
    if name == "speed_sweep":
        assert "speed changes throughput and nothing else" in out


@pytest.mark.parametrize("preset", hpgr.presets.NAMES)
@pytest.mark.parametrize("name", STUDIES)
def test_no_default_of_a_preset_presses_the_bed_to_more_than_rock(run, name, preset):
    """Within twice the force of the scene's own gap; 30 mm of `industrial` would carry 300,000 times as much."""
    code, _, err = run("--scene", preset, "--cells", "0", "--replicates", "1", "--no-plot", study=STUDIES[name])
    assert code == 0, err
    force = opened(f"outputs/{name}.nc")["specific_pressing_force"]
    scene = hpgr.Scene.preset(preset).with_values({"resolution.points": 40})
    assert force.max() < 2.02 * specific_pressing_force(scene)
    assert name != "gap_sweep" or force.max() > 1.5 * force.min()


def test_default_gaps_are_those_that_every_scene_can_be_at(run, refused):
    assert run("--scene", "paper", "industrial", "--cells", "0", "--replicates", "1", "--no-plot")[0] == 0
    result = opened("outputs/gap_sweep.nc")
    assert 0.055 < float(result["gap"].min()) < 0.057
    assert result["specific_pressing_force"].max() < 7.2e6  # of `industrial`, twice 3.5 N/mm2
    message = refused("--scene", "khd_pilot", "industrial", "--out", "other.nc")
    assert "at least 55.5 mm and the first has 23.7 mm; such as --gap" in message


def test_default_gaps_too_close_for_three_digits_are_given_once():
    wide = hpgr.presets.industrial()
    scene = wide.with_values({"rolls.gap": 0.0556})
    assert default_values(gap_sweep.STUDY, [scene, wide]) == pytest.approx([0.0555, 0.0556, 0.0557])
    assert default_values(speed_sweep.STUDY, [scene])[2] == scene.rolls.speed


def test_further_axes_come_after_the_study_s_own(run):
    axes = ("--gap", "40 mm", "0.05 m", "--feed-top-size", "5 cm", "60 mm")
    code, out, _ = run(*axes, "--replicates", "1", "--no-plot", study=speed_sweep)
    assert code == 0
    result = opened("outputs/speed_sweep.nc")
    dims = ("roll_speed", "gap", "feed_top_size")
    assert result["p80_total"].dims == (*dims, "replicate")
    assert result["gap"].values.tolist() == [0.04, 0.05]
    assert result.sizes["roll_speed"] == 6
    assert result["feed_top_size"].values == pytest.approx([0.05, 0.06], rel=1e-12)
    headings = ["roll speed [rpm]", "gap [mm]", "feed top size [mm]"]
    assert re.split(r"\s{2,}", out.splitlines()[0].strip())[:3] == headings
    assert "±" not in out


def test_table_and_csv_agree_with_the_file(run, refused):
    code, out, _ = run("--gap", "40 mm", "60 mm", "--sieve", "2 mm", "--no-plot", "--csv", "table")
    assert code == 0
    assert "wrote outputs/gap_sweep.nc and table.csv" in out
    result = opened("outputs/gap_sweep.nc")
    assert report.table(result, 2e-3) in out
    pd.testing.assert_frame_equal(pd.read_csv("table.csv", encoding="utf-8-sig"), report.plant_table(result, 2e-3))
    assert "--csv: got table.csv, which is no whole result of a study; give --csv" in refused("--csv", "table")


def test_options_reach_the_result(run):
    for name, options in {"a": ["--seed", "7"], "b": ["--seed", "7", "--workers", "1"], "c": ["--seed", "8"]}.items():
        assert run("--gap", "40 mm", "--replicates", "2", "--no-plot", "--out", name, *options)[0] == 0
    a, b, c = (opened(f"{name}.nc") for name in "abc")
    assert a.attrs["seed"] == 7
    assert np.array_equal(a["passing"], b["passing"])
    assert not np.array_equal(a["passing"], c["passing"])
    grid = hpgr.Scene.model_validate_json(a.attrs["scene"]).resolution
    assert (grid.cells, grid.points, grid.streamlines) == (60, 40, 3)


def test_level_sets_the_resolution_and_nothing_else(folder):
    (folder / "mine.toml").write_text(SCENE + '\n[resolution]\nsieves = ["1 mm", "20 mm"]\n')
    options = Options(scene="mine.toml", level="draft", points=77)
    grid, draft = command.base_scene(options).resolution, hpgr.scene.levels()["draft"]
    assert (grid.streamlines, grid.points, grid.cells) == (draft.streamlines, 77, draft.cells)
    assert grid.sieves == (0.001, 0.02)
    assert command.base_scene(Options(scene="paper", level="draft")).resolution.level().startswith("draft")


def test_dry_run_lists_cases_and_writes_nothing(run, folder):
    axes = ("--gap", "40 mm", "1.2 m", "--roll-speed", "15 rpm", "19 rpm")
    code, out, err = run(*axes, "--dry-run")
    assert (code, err) == (0, "")
    assert list(folder.iterdir()) == []
    assert re.search(r"gap \[mm\]\s+roll speed \[rpm\]\s+memory\s+time", out)
    rows = [line for line in out.splitlines() if re.search(r"40 mm\s+1[59] rpm\s+[\d.]+ MB\s+[\d.]+ ms$", line)]
    assert len(rows) == 2
    assert len(re.findall(r"^refused: 1200 mm, 1[59] rpm: rolls.gap: got 1200 mm", out, re.MULTILINE)) == 2
    assert "12 cases (3 replicates each)" in out
    few, many = (
        [float(number) for number in re.search(r"([\d.]+) MB\s+([\d.]+) ms", text).groups()]
        for text in (out, run(*axes, "--dry-run", "--cells", "1000000")[1])
    )
    assert many[0] > 10 * few[0]
    assert many[1] > 10 * few[1]


def test_second_run_reads_every_case_back(run, folder, monkeypatch):
    gaps = ("--gap", "40 mm", "1.2 m", "60 mm", "--no-plot")
    code, out, err = run(*gaps)
    assert code == 1
    assert "0 of 9 cases read back from outputs/gap_sweep.cases" in err
    assert re.search(r"9 cases to compute on 1 thread: predicted [\d.e-]+ s, at most [\d.]+ MB a case", err)
    first = opened("outputs/gap_sweep.nc")
    before = sorted(folder.rglob("*"))
    told = run("--gap", "40 mm", "50 mm", "60 mm", "--replicates", "4", "--dry-run")[1]
    rows = [line.split()[-3:] for line in told.splitlines() if re.match(r"\s+[456]0 mm", line)]
    assert rows == [["3", "of", "4"], ["0", "of", "4"], ["3", "of", "4"]]
    assert "12 cases (4 replicates each), 6 of them finished already in outputs/gap_sweep.cases" in told
    assert sorted(folder.rglob("*")) == before
    assert "finished" not in run("--gap", "40 mm", "--dry-run", "--recompute")[1]
    monkeypatch.setattr(running, "run_together", None)  # calling it would fail the case
    again, out_again, err_again = run(*gaps)
    assert "6 of 9 cases read back from outputs/gap_sweep.cases" in err_again  # refused cases are not kept
    assert (again, out_again) == (code, out)
    xr.testing.assert_identical(opened("outputs/gap_sweep.nc"), first)
    code, _, err = run("--gap", "40 mm", "--no-plot", "--recompute")
    assert code == 1
    assert "failed: gap 40 mm, 3 of 3 replicates" in err  # nothing was read back


def test_scene_from_toml_and_json(run, folder):
    (folder / "mine.toml").write_text(SCENE)
    assert run("--scene", "mine.toml", "--no-plot", "--out", "toml")[0] == 0
    result = opened("toml.nc")
    scene = hpgr.Scene.model_validate_json(result.attrs["scene"])
    assert (scene.rolls.diameter, scene.feed.top_size) == (0.8, 0.02)
    assert np.isclose(result["gap"], 0.019).sum() == 1
    (folder / "again.json").write_text(result.attrs["scene"])  # a result's own scene is an input
    assert run("--scene", "again.json", "--no-plot", "--out", "json")[0] == 0
    xr.testing.assert_identical(opened("json.nc").assign_attrs(history=""), result.assign_attrs(history=""))


def test_preset_says_what_it_is_calibrated_on(run):
    code, out, _ = run("--scene", "khd_pilot", "--no-plot", "--replicates", "1")
    assert code == 0
    scene = hpgr.Scene.model_validate_json(opened("outputs/gap_sweep.nc").attrs["scene"])
    assert (scene.rolls.diameter, scene.rolls.width) == (0.8, 0.25)
    assert f": {scene.remark}" in out
    assert "seven pilot tests" in scene.remark


def test_feed_table_beside_the_scene_file(run, folder):
    (folder / "in").mkdir()
    (folder / "in" / "ore.csv").write_text("size_mm,percent_passing\n31.75,100\n10,50\n1,0\n")
    start = SCENE.partition("[feed]")[0]
    (folder / "in" / "mine.toml").write_text(start + '[feed]\nkind = "table"\ntable = "ore.csv"\n')
    # 31.75 mm is no round number: the default axis must not reach beyond it
    code, _, err = run("--scene", "in/mine.toml", "--no-plot", study=feed_sweep)
    assert (code, [line for line in err.splitlines() if "refused" in line]) == (0, [])


def test_lost_cases_are_named_and_exit_code_is_1(run, folder, monkeypatch):
    real = running.run_scene

    def run_scene(scene, seed, replicate, beds):
        if scene.rolls.gap == 0.05 and replicate == 1:
            raise RuntimeError("boom \x1b[2J")
        return real(scene, seed, replicate, beds)

    monkeypatch.setattr(running, "run_together", one_by_one(run_scene))
    code, out, err = run("--gap", "40 mm", "50 mm", "1.2 m")
    assert code == 1
    [line] = [line for line in err.splitlines() if line.startswith("refused")]
    assert line.startswith("refused: gap 1200 mm, 3 of 3 replicates: rolls.gap: got 1200 mm; must be at most")
    assert "entry gap 1140 mm" in line
    # nothing in a message steers the terminal
    assert r"failed: gap 50 mm, 1 of 3 replicates: RuntimeError: boom \x1b[2J" in err
    assert re.search(r"^\s+1200(\s+-)+$", out, re.MULTILINE)
    assert files(folder) == ["outputs/gap_sweep.nc", "outputs/gap_sweep.png"]


def test_no_result_at_all(run, folder):
    code, _, err = run("--gap", "1.2 m", "2 m")
    assert code == 1
    assert "no case holds a result" in err
    assert err.count("refused: gap") == 2
    assert files(folder) == []


def test_gap_floats_under_a_swept_pressing_force(run):
    forces = ("--press-force", "3 N/mm^2", "4.5 MPa", "10 kPa")
    code, out, err = run(*forces, "--scene", "industrial", "--replicates", "1")
    assert code == 1  # of the last
    assert "reachable" in err
    assert "gap floats under the pressing force" in out
    assert opened("outputs/gap_sweep.nc")["press_force"].values.tolist() == [3e6, 4.5e6, 1e4]
    for figure in ("gap [mm]", "Fsp [N/mm²]", "power [kW]", "W [kWh/t]", "torque [kN m]", "beta [deg]"):
        assert figure in out


# ---- what is refused


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--gap", "40"], ["gap", "'40'", "without a unit", "40 mm"]),
        (["--gap", "40 mm", "--press-force", "3 MPa"], ["--gap", "--press-force"]),
        (["--scene", "moon"], ["--scene", "'moon'", "paper", "khd_pilot", "industrial", ".toml"]),
        (["--scene", "gone.toml"], ["--scene", "gone.toml", "No such file"]),
        (["--workers", "0"], ["--workers: got 0", "from 1 to"]),
        (["--timeout", "nan"], ["--timeout: got nan", "0.1 to 1e6 s"]),
        (["--seed", "-1"], ["--seed", "-1", "from 0"]),
        (["--sieve", "3 m"], ["--sieve", "'3 m'", "1000 mm"]),
        (["--tolerance", "2"], ["--tolerance: got 2.0", "1e-4 to 0.5"]),
        (["--tolerance", "0.1"], ["--cells", "--tolerance", "one of them"]),
        (["--out", ""], ["--out", "must be the name of a file"]),
    ],
    ids=" ".join,
)
def test_bad_options_are_refused(refused, arguments, words):
    message = refused(*arguments)
    for word in words:
        assert word in message


@pytest.mark.parametrize("arguments", [["--cells", "many"], ["--cels", "60"], ["--seed"], ["surprise"]])
def test_unknown_options_are_refused(folder, capsys, arguments):
    with pytest.raises(SystemExit) as caught:
        gap_sweep.main(arguments)
    assert caught.value.code == 2
    said = capsys.readouterr()
    assert arguments[0] in said.out + said.err
    assert files(folder) == []


FAULTY = (
    SCENE.replace('"0.8 m"', "true").replace('"19 mm"', '"19"').replace("bottom_size", "botom_size")
    + "\n[flows]\nexponent = 1\n"
)


def test_impossible_scenes_are_refused_with_every_fault(refused, folder):
    (folder / "faulty.toml").write_text(FAULTY)
    message = refused("--scene", "faulty.toml")
    for words in ("rolls.diameter", "rolls.gap", "did you mean 'bottom_size'", "did you mean 'flow'"):
        assert words in message


def test_feed_of_one_size_has_no_top_size(refused, folder):
    single = SCENE.replace("uniform", "single").replace('bottom_size = "1 mm"\ntop_size', "size")
    (folder / "single.toml").write_text(single)
    message = refused("--scene", "single.toml", study=feed_sweep)
    assert "--feed-top-size" in message
    assert "of a single size" in message


def test_unreachable_scheduler_is_refused(folder, run, monkeypatch):
    import distributed

    def unreachable(address, timeout):
        raise OSError(f"Timed out trying to connect to {address} after {timeout}")

    monkeypatch.setattr(distributed, "Client", unreachable)
    code, _, err = run("--scheduler", "tcp://127.0.0.1:9")
    assert code == 2
    assert "tcp://127.0.0.1:9" in err
    assert not list(folder.iterdir())


def test_interrupt_says_how_to_go_on(run, monkeypatch):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("studies.sweep.sweep", interrupted)
    code, _, err = run("--gap", "40 mm")
    assert code == 130
    assert "finished cases are kept" in err


# ---- files that are there already


GAP = ("--gap", "40 mm", "--replicates", "1")


def test_out(run, folder):
    for given, made in (("deep/run.nc", "deep/run"), ("run", "run"), ("run.v2", "run.v2")):
        assert run(*GAP, "--no-plot", "--out", given)[0] == 0
        assert (folder / f"{made}.cases" / "lock").is_file()
    assert files(folder) == ["deep/run.nc", "run.nc", "run.v2.nc"]


def test_out_that_cannot_be_written(refused, folder):
    (folder / "file").write_text("not a folder")
    assert "could not write the result" in refused(*GAP, "--out", "file/run.nc")
    (folder / "run.nc").mkdir()
    assert "is a folder" in refused(*GAP, "--out", "run.nc")


def test_earlier_result_of_the_same_study_is_extended(run):
    assert run(*GAP, "--no-plot")[0] == 0
    assert run("--gap", "40 mm", "50 mm", "--replicates", "1", "--no-plot")[0] == 0
    assert opened("outputs/gap_sweep.nc").sizes["gap"] == 2


def test_file_that_is_not_the_study_s_own_is_replaced_only_if_asked(run, refused, folder):
    assert run(*GAP, "--out", "mine")[0] == 0
    own = {path: path.read_bytes() for path in (folder / "mine.nc", folder / "mine.png")}
    for given in (["--scene", "industrial"], ["--scene=khd_pilot"]):
        assert "the result of another command, `python -m studies.gap_sweep" in refused(*given, *GAP, "--out", "mine")
    assert "the result of another command" in refused(*GAP, "--out", "mine", study=speed_sweep)
    for path, content in own.items():
        for foreign in (b"notes", b"", content[: len(content) // 2], b"see python -m studies.gap_sweep"):
            if foreign.startswith(b"\x89PNG"):
                continue  # its mark is in its first half
            path.write_bytes(foreign)
            assert f"--out: got {path.name}, which is no whole result of a study" in refused(*GAP, "--out", "mine")
        path.write_bytes(content)
    (folder / "mine.nc").chmod(0o444)
    assert "read-only" in refused(*GAP, "--out", "mine")
    assert run(*GAP, "--out", "mine", "--overwrite", study=speed_sweep)[0] == 0
    assert opened("mine.nc").attrs["history"].startswith("python -m studies.speed_sweep")
    assert b"python -m studies.speed_sweep" in (folder / "mine.png").read_bytes()


# ---- one main for all


def test_main_writes_what_a_study_reports(folder, capsys):
    @dataclass
    class Options:
        overwrite: command.Overwrite = False
        seed: command.Seed = 0

    def write(path, line):
        path.write_text(f'<meta name="generator" content="{line}">')

    paths = [Path("a.nc"), Path("b.html"), Path("c.html")]

    @command.command("mine", "A study.", lambda options: paths)
    def main(options: Options) -> command.Report:
        faults = ["a fault"] if options.seed == 1 else []
        parts = [xr.Dataset({"a": ("x", [1.0])}), write, write, lambda *_: 1 / 0]
        return command.Report(["a line"], parts, faults)

    assert main([]) == 0
    assert capsys.readouterr().out == "a line\nwrote a.nc, b.html and c.html\n"
    assert opened("a.nc").attrs["history"] == "python -m studies.mine"
    assert main(["--seed", "1"]) == 1
    assert capsys.readouterr().err == "a fault\n"
    assert main(["--seed", "-1"]) == 2
    Path("b.html").write_text("<p>python -m studies.mine</p>")
    assert main([]) == 2
    assert main(["--overwrite"]) == 0


@pytest.mark.slow
def test_module_runs_as_a_command(folder, monkeypatch):
    # without the compiler NumPy speaks up when a 64-bit stream wraps, which is what it is there for
    monkeypatch.setenv("PYTHONWARNINGS", "ignore:overflow encountered in scalar:RuntimeWarning")
    done = python("-m", "studies.gap_sweep", *SMALL, "--gap", "40 mm", "1.2 m", "--out", "run.nc")
    assert done.returncode == 1, done.stderr
    assert "gap [mm]" in done.stdout
    assert "6 of 6 cases" in done.stderr  # progress in plain lines where no terminal is watching
    assert "Warning" not in done.stderr
    assert files(folder) == ["run.nc", "run.png"]
    line = f"python -m studies.gap_sweep {' '.join(SMALL)} --gap '40 mm' '1.2 m' --out run.nc"
    assert opened("run.nc").attrs["history"] == line


_LATE = {"numba", "xarray", "matplotlib", "distributed", "dask", "netCDF4", "h5py", "scipy", "pint"}


def test_help_loads_nothing_heavy():
    """What makes `--help` quick, counted in modules rather than seconds."""
    script = "import sys; from studies.gap_sweep import main\ntry: main(['--help'])\nfinally: print(*sys.modules)"
    *told, loaded = python("-c", script).stdout.splitlines()
    assert "studies.command" in loaded.split()
    assert not set(loaded.split()) & _LATE
    told = "\n".join(told)
    assert all(word in told for word in ("python -m studies.gap_sweep", "--tolerance", *hpgr.presets.NAMES))


@pytest.mark.parametrize("study", commands())
def test_help_explains_every_option_and_tells_no_default_that_is_none(study, capsys):
    with pytest.raises(SystemExit):
        any_study([study, "--help"])
    told = capsys.readouterr().out
    assert not re.search(r"default:\s*(None|False)?\)|\(repeatable\)", told)
    assert str(Path(hpgr.__file__).parent) not in re.sub(r"[\s│]", "", told)
    options = re.split(r"^[│ ] (?=-)", told, flags=re.MULTILINE)
    assert len(options) > 4
    for option in options[2:]:
        assert re.search(r"\s[A-Z]\w*[a-z]\w*,?\s.*\w\W*\.", option, re.DOTALL), option


def test_a_feed_sweep_of_a_fitted_ore_shows_what_its_tests_cannot_tell(run):
    few = ("--cells", "20", "--points", "20", "--streamlines", "2", "--replicates", "1", "--feed-top-size", "45 mm")
    code, out, _ = run("--scene", "industrial", "--no-plot", *few, study=feed_sweep)
    assert code == 0
    assert [out.count(f"industrial{name} ") > 0 for name in ("", ", k 0.31", ", k 0.54")] == [True] * 3
    assert "Tests of one feed tell k" in out
    code, out, _ = run("--scene", "paper", "--no-plot", "--overwrite", *few, study=feed_sweep)
    assert "Tests of one feed" not in out
