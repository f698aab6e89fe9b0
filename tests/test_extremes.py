import json
import math
import subprocess
import sys
import warnings

import numpy as np
import pytest
import xarray as xr
from pydantic import BaseModel, Field
from support import sized

import hpgr
from hpgr.scene import field_value
from hpgr.schema import FLAGS
from studies import extremes, ranges, stability
from studies.extremes import KINDS, Outcome, Row, Walked, judge
from studies.plots import extremes as plots

INF = math.inf
KNOWN = ranges.numeric_fields()
COSTLY = {
    "stress.substeps",
    "exchange.segregation",
    "exchange.mixing",
    "resolution.streamlines",
    "resolution.points",
    "resolution.cells",
}


# --- the catalogue, row by row, and each field to its ends -------------------------------------------------------


@pytest.mark.parametrize("row", extremes.catalogue(), ids=lambda row: row.name)
def test_catalogue(row):
    outcome = judge(row.values)
    assert outcome.kind == row.wanted, outcome.message
    for words in row.says:
        assert words in outcome.message


def test_catalogue_has_an_outcome_of_every_kind():
    assert {row.wanted for row in extremes.catalogue()} == set(KINDS) - {"fault"}


def test_an_outcome_that_is_not_the_wanted_one_is_a_fault():
    found = judge({})
    assert found == Outcome("ok", FLAGS["unusual_machine"], message="unusual_machine")  # no limit of the model
    assert extremes._as_wanted(Row("as it is", {}, "ok"), found) == found
    for row in (Row("refused?", {}, "refused"), Row("said?", {}, "ok", ("no_breakage",))):
        assert extremes._as_wanted(row, found).kind == "fault"


@pytest.mark.parametrize("name", sorted(set(KNOWN) - COSTLY))
def test_each_field_alone_to_its_ends(name):
    for end in KNOWN[name].ends():
        for values in extremes.hosts({name: end}):
            outcome = judge(values)
            assert outcome.kind != "fault", (end, outcome.message)


@pytest.mark.parametrize("name", KNOWN)
def test_ends_are_allowed_and_what_lies_outside_is_not(name):
    for end in KNOWN[name].ends():
        assert field_value(name, end) == end
    for value in KNOWN[name].outside():
        with pytest.raises(ValueError, match=f"{name}: got .*; must be "):
            field_value(name, value)


@pytest.mark.parametrize("name", KNOWN)
def test_values_along_a_range_lie_within_it(name):
    places = np.linspace(0, 1, 11)
    values = [KNOWN[name].at(place) for place in places]
    assert values == sorted(values)
    assert values[0] == KNOWN[name].ends()[0]
    assert [field_value(name, value) for value in values] == values


def test_fields_added_later_are_walked(monkeypatch):
    class Later(BaseModel):
        pressing: float | None = Field(None, gt=0, le=1e9)
        slices: int = Field(1, ge=1, lt=100)
        shape: bool = False

    monkeypatch.setattr(ranges, "parts", lambda: {"later": Later})
    found = ranges.numeric_fields()
    assert set(found) == {"later.pressing", "later.slices"}
    assert found["later.pressing"].ends() == [5e-324, 1e9]
    assert found["later.pressing"].outside() == [0.0, math.nextafter(1e9, INF)]
    assert found["later.pressing"].optional
    assert found["later.slices"].ends() == [1, 99]
    assert found["later.slices"].outside() == [0, 100]
    assert ranges.choices() == {"later.shape": (False, True)}


# --- what must not happen is a fault -----------------------------------------------------------------------------


def raising(error):
    def simulate(scene, seed=0):
        raise error

    return simulate


def warning(scene, seed=0):
    warnings.warn("invalid value", RuntimeWarning, stacklevel=1)


def corrupted(name, value):
    genuine = hpgr.simulate

    def simulate(scene, seed=0):
        result = genuine(scene, seed)
        result[name] = result[name] * value
        return result

    return simulate


@pytest.mark.parametrize(
    ("simulate", "says"),
    [
        (raising(ZeroDivisionError("float division by zero")), "ZeroDivisionError: float division by zero"),
        (raising(KeyError("p80")), "KeyError"),
        (raising(ValueError("math domain error")), "a refusal without field, value, bound or remedy"),
        (raising(ValueError("rolls.gap: got 3 mm")), "a refusal without"),
        (raising(ValueError("rolls.gap: got 3 mm; must be at least 4 mm")), "a refusal without"),
        (raising(ValueError("speed: got 3; must be at least 4; turn faster")), "a refusal without"),
        (raising(MemoryError()), "a refusal without"),
        (warning, "RuntimeWarning: invalid value"),
        (corrupted("pressure", math.nan), "finite: pressure holds nan"),
        (corrupted("pressure", -1.0), "stresses not negative: pressure falls to"),
        (corrupted("flags", 0), "flags: flags say none, notes say unusual_machine"),
        (corrupted("throughput", 0.0), "throughput: throughput is 0"),
    ],
)
def test_a_silent_fault_is_seen(monkeypatch, simulate, says):
    monkeypatch.setattr(hpgr, "simulate", simulate)
    found = judge({})
    assert found.kind == "fault"
    assert says in found.message


def test_a_limit_that_is_not_flagged_is_seen(monkeypatch):
    monkeypatch.setattr(hpgr, "simulate", corrupted("flags", 0))
    found = judge({"resolution.cells": 2})
    assert found.kind == "fault"
    assert "flags: few_cells is missing" in found.message


def test_a_refusal_in_its_form_is_none(monkeypatch):
    refusal = ValueError("rolls.gap: got 3 mm; must be at least 4 mm; widen the gap")
    monkeypatch.setattr(hpgr, "simulate", raising(refusal))
    assert judge({}) == Outcome("refused", message=str(refusal))


def test_swaps_are_judged_apart_with_nothing_to_break(monkeypatch):
    genuine = hpgr.simulate

    def losing(scene, seed=0):
        result = genuine(scene, seed)
        if scene.material.strength == 1e15:
            result["size"].values[-1, 0, 1, 0] = result["size"].values[-1, 0, 1, 1]
        return result

    monkeypatch.setattr(hpgr, "simulate", losing)
    found = judge({"exchange": {}, "resolution.points": 9})
    assert found.kind == "fault"
    assert "with nothing to break: swaps conserve every size" in found.message


# --- random scenes ----------------------------------------------------------------------------------------------


def test_random_scenes_are_fixed_by_seed_and_number():
    first, again, other, seeded = (json.dumps(extremes.random_values(*key)) for key in ((5, 0), (5, 0), (6, 0), (5, 1)))
    assert first == again
    assert len({first, other, seeded}) == 3


def test_random_scenes_are_of_every_kind_and_mostly_run():
    drawn = [extremes.random_values(number) for number in range(200)]
    for name, words in ranges.choices().items():
        if name not in ("resolution.level",):
            assert {values[name] for values in drawn if name in values} == set(words)
    assert {values["resolution.cells"] for values in drawn} >= {0, 1, 2, 3}
    assert sum(values.get("exchange", {}) is not None for values in drawn) == 50
    assert any(math.isinf(values.get("material.cushioning", 0)) for values in drawn)
    assert any(values.get("material.elastic_exponent", 1) <= 0 for values in drawn)
    assert any(values["rolls.gap"] == values["rolls.entry_gap"] for values in drawn)
    refused = 0
    for values in drawn:
        try:
            scene = extremes.base(values)
        except ValueError:
            refused += 1
            continue
        assert hpgr.budget.predict(scene).seconds <= 0.15 or scene.resolution.points <= 2
    assert refused < 20


@pytest.mark.parametrize("number", range(sized(12, 4)))
def test_random_scenes_end_well_flagged_or_refused(number):
    outcome = judge(extremes.random_values(number, seed=7))
    assert outcome.kind != "fault", outcome.message


# --- the study: table, file, figures, exit codes -----------------------------------------------------------------


@pytest.fixture
def small(tmp_path, monkeypatch):
    """A study of seconds in an empty folder: few scenes, small maps."""
    gaps = stability.Axis("rolls.gap", (0.0, 0.03, 0.5))
    speeds = stability.Axis("rolls.speed", (1.0, 2e6))
    steps = stability.Axis("resolution.points", (2, 9))
    monkeypatch.setattr(stability, "MAPS", {
        "gap_speed": (gaps, speeds),
        "cushioning_step": (stability.Axis("material.cushioning", (1.0, INF)), steps),
        "exponent_step": (stability.Axis("material.elastic_exponent", (-1.0, 0.5)), steps),
    })  # fmt: skip
    monkeypatch.setattr(stability, "_EXPONENTS", (-0.5, 0.5))
    monkeypatch.setattr(stability, "_STEPS", (10, 160))
    monkeypatch.setattr(stability, "_ENTRY_GAPS", (0.5, 1.14))
    monkeypatch.setattr(stability, "_FINEST", 640)
    stability._limit.cache_clear()
    monkeypatch.setattr(stability, "_HELD_STEPS", 40)
    rows = {row.name: row for row in extremes.catalogue()}
    chosen = [rows[name] for name in ("gap of 0", "M = 1", "M = 2", "swap sum above 1/2")]

    def walk(scenes, seed, every, progress):
        for row in chosen:
            yield Walked("catalogue", row.name, row.values, judge(row.values, seed))
        for number in range(scenes):
            values = extremes.random_values(number, seed)
            yield Walked("random", f"scene {number}", values, judge(values, seed))

    monkeypatch.setattr(extremes, "walk", walk)
    monkeypatch.chdir(tmp_path)
    yield tmp_path
    stability._limit.cache_clear()


def test_study(small, capsys):
    assert extremes.main(["--scenes", "3"]) == 0
    out, err = capsys.readouterr()
    assert err == "" or "scenes" in err  # progress
    assert "silent faults: 0" in out
    rows = {line.split()[0]: line.split()[1:] for line in out.splitlines()[1:6]}
    assert rows["catalogue"] == ["4", "1", "1", "1", "1", "0"]
    assert rows["random"][0] == "3"
    assert "refused for: " in out
    assert "rolls.gap 1" in out
    assert "few_cells " in out
    assert "wrote outputs/extremes.nc and outputs/extremes.png and outputs/extremes_euler.png" in out
    with xr.open_dataset("outputs/extremes.nc") as result:
        result.load()
    assert result.attrs["history"] == "python -m studies.extremes --scenes 3"
    assert result["outcome"].attrs["flag_meanings"].split() == list(KINDS)
    assert [KINDS[kind] for kind in result["outcome"].values[:4]] == ["refused", "ok", "flagged", "substepped"]
    assert result["message"].values[0].startswith("rolls.gap: got 0 mm; must be at least 0.001 mm; measure")
    assert result["passes"].values[3] > 1
    assert result["value"].sel(field="resolution.cells").values[:3].tolist() == pytest.approx(
        [math.nan, 1, 2], nan_ok=True
    )
    assert (result["gap_speed_outcome"].sel(gap_speed_speed=2e6) == KINDS.index("refused")).all()
    assert (small / "outputs" / "extremes.png").read_bytes().startswith(b"\x89PNG")


def test_a_silent_fault_is_printed_with_its_scene_and_exits_with_1(small, capsys, monkeypatch):
    values = {"rolls.gap": 0.05, "material.cushioning": INF}
    fault = Walked("random", "scene 0", values, Outcome("fault", message="finite: pressure holds nan"))
    monkeypatch.setattr(extremes, "walk", lambda *_, **__: iter([fault]))
    assert extremes.main(["--no-plot"]) == 1
    out, err = capsys.readouterr()
    assert "silent faults: 1" in out
    told = err[err.index("FAULT in random, scene 0: finite: pressure holds nan") :].splitlines()
    assert json.loads(told[1]) == values
    assert extremes.base(json.loads(told[1])).material.cushioning == INF


def test_a_fault_in_a_map_exits_with_1(small, capsys, monkeypatch):
    genuine = judge
    wrong = lambda values, seed=0: Outcome("fault") if values.get("rolls.gap") == 0.03 else genuine(values, seed)  # noqa: E731
    monkeypatch.setattr(extremes, "judge", wrong)
    assert extremes.main(["--scenes", "0"]) == 1
    assert "silent faults: 2" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--scenes", "-1"], "--scenes: got -1; must be within 0 to 1,000,000"),
        (["--seed", "-1"], "--seed: got -1; must be a whole number"),
        (["--scenes", "0", "--out", "."], "could not write the result"),
    ],
)
def test_refused_options(small, capsys, arguments, says):
    assert extremes.main(arguments) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert says in err
    assert list(small.iterdir()) == []


def test_help_loads_nothing_heavy():
    code = (
        "import sys; from studies import extremes\n"
        "try: extremes.main(['--help'])\nexcept SystemExit: print(*sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300)
    for option in ("--scenes", "--seed", "--quick", "--out", "--no-plot"):
        assert option in done.stdout
    assert not {"numba", "xarray", "matplotlib", "distributed", "dask", "netCDF4", "scipy", "pint"} & set(
        done.stdout.split()
    )


# --- maps and figures -------------------------------------------------------------------------------------------


def test_maps_and_their_figures(small):
    result = stability.maps(judge)
    kinds = [KINDS[kind] for kind in result["gap_speed_outcome"].sel(gap_speed_speed=1.0).values]
    assert kinds == ["refused", "substepped", "flagged"]
    assert stability.faults(result) == 0
    error = result["integrator_step_error"]
    euler, increment = (error.sel(integrator=name, exponent=0.5).values for name in stability.INTEGRATORS)
    assert euler[1] < 0.1 < euler[0]
    assert increment[1] < 0.2 * euler[1]  # second order against first
    assert result["integrator_step_settled"].sel(exponent=0.5).values.all()
    assert not result["integrator_step_settled"].sel(exponent=-0.5).values.any()
    assert result["integrator_step_tension"].sel(exponent=-0.5, steps=160).values.all()
    assert result["strain"].values == pytest.approx([0.39, 1.03], abs=0.05)
    figure = plots.stability_figure(result)
    titles = [axes.get_title() for axes in figure.axes]
    assert titles == ["Gap and roll speed", "Cushioning and time step", "Elastic exponent and time step"]
    written = {text.get_text() for axes in figure.axes for text in axes.texts}
    assert "×" in written
    assert any("CN" in text for text in written)
    assert figure.axes[0].get_xlabel() == "gap [mm]"
    assert figure.axes[1].get_ylabel() == "time step dt [residence times]"
    figure = plots.integrator_figure(result)
    assert figure.axes[0].get_title() == "Euler, the paper's explicit rule"
    assert f"{100 * euler[0]:.0f}" in {text.get_text() for text in figure.axes[0].texts}
    assert "T" in {text.get_text() for text in figure.axes[0].texts}
