import json
import math
import warnings

import numpy as np
import pytest
import xarray as xr
from support import sized

import hpgr
from hpgr import cost
from hpgr.fields import Frozen, Metres, quantity
from hpgr.scene import field_value
from studies import extremes
from studies.guard import judge, maps, ranges
from studies.guard.judge import KINDS, Outcome, Row, as_wanted
from studies.show.plots import extremes as plots

INF = math.inf
KNOWN = ranges.numeric_fields()
COSTLY = {"elasticity.substeps", "exchange.segregation", "exchange.mixing"}
COSTLY |= {"resolution.streamlines", "resolution.points", "resolution.cells"}


# --- the catalogue, row by row, and each field to its ends -------------------------------------------------------


@pytest.mark.parametrize("row", judge.catalogue(), ids=lambda row: row.name)
def test_catalogue(row):
    outcome = as_wanted(row, judge.judge(row.values))
    assert outcome.kind != "fault", outcome.message


def test_an_outcome_that_is_not_the_wanted_one_is_a_fault():
    assert {row.wanted for row in judge.catalogue()} == set(KINDS) - {"fault"}
    found = judge.judge({})
    assert found.kind == "ok"
    assert set(found.message.split(", ")) <= judge.NO_LIMITS
    assert as_wanted(Row("as it is", {}, "ok"), found) == found
    for row in (Row("refused?", {}, "refused"), Row("said?", {}, "ok", "no_breakage")):
        assert as_wanted(row, found).kind == "fault"


@pytest.mark.parametrize("section", ranges.laws())
def test_each_field_to_its_ends_and_beyond(section):
    """Ends are allowed, alone and in a scene; values along the range lie within it; what is outside is refused."""
    for name in (name for name in KNOWN if name.startswith(f"{section}.")):
        known = KNOWN[name]
        for end in known.ends():
            assert field_value(name, end) == end
            for values in judge.hosts({name: end}) if name not in COSTLY else ():
                outcome = judge.judge(values)
                assert outcome.kind != "fault", (values, outcome.message)
        for value in known.outside():
            with pytest.raises(ValueError, match=f"{name}: got .*; must be "):
                field_value(name, value)
        along = [known.at(place) for place in np.linspace(0, 1, 11)]
        assert along == sorted(along)
        assert along[0] == known.ends()[0]
        assert [field_value(name, value) for value in along] == along


def test_fields_added_later_are_walked(monkeypatch):
    words = {"symbol": "x", "source": "x", "example": 1}

    class Later(Frozen):
        pressing: Metres | None = quantity(None, **words, gt=0, le=1e9)
        slices: int = quantity(1, **words, ge=1, lt=100)
        shape: bool = False

    monkeypatch.setattr(ranges, "laws", lambda: {"later": [Later]})
    every = {f"later.{key}": (Later, field) for key, field in Later.model_fields.items()}
    monkeypatch.setattr(ranges, "fields", lambda: every)
    found = ranges.numeric_fields.__wrapped__()
    assert set(found) == {"later.pressing", "later.slices"}
    assert found["later.pressing"].ends() == [5e-324, 1e9]
    assert found["later.pressing"].outside() == [0.0, math.nextafter(1e9, INF)]
    assert found["later.pressing"].optional
    assert found["later.slices"].ends() == [1, 99]
    assert found["later.slices"].outside() == [0, 100]
    assert ranges.choices.__wrapped__() == {"later.shape": (False, True)}


def test_hosts_are_the_laws_that_have_the_field():
    assert [one["feed.kind"] for one in judge.hosts({"feed.exponent": 2.0})] == ["power_law", "rosin_rammler"]
    assert judge.hosts({"flow.nip_angle": 0.1}) == [{"flow.kind": "nip", "flow.nip_angle": 0.1}]
    assert judge.hosts({"flow.cake_solid_fraction": 0.8}) == [{"flow.kind": "nip", "flow.cake_solid_fraction": 0.8}]
    assert judge.hosts({"flow.exponent": 1.0, "flow.nip_angle": 0.1}) == []  # of laws that exclude each other
    assert judge.hosts({"rolls.gap": 0.1}) == [{"rolls.gap": 0.1}]


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
        (raising(ValueError("math domain error")), "a refusal without field, value, bound or remedy"),
        (raising(ValueError("rolls.gap: got 3 mm; must be at least 4 mm")), "a refusal without"),
        (raising(ValueError("speed: got 3; must be at least 4; turn faster")), "a refusal without"),
        (raising(MemoryError()), "a refusal without"),
        (warning, "RuntimeWarning: invalid value"),
        (corrupted("pressure", math.nan), "finite: pressure holds nan"),
        (corrupted("flags", 0), "flags: flags say none, diagnostics say"),
        (corrupted("flags", 0), "flags: few_cells is missing"),
        (corrupted("throughput", 0.0), "throughput: throughput is 0"),
    ],
)
def test_a_silent_fault_is_seen(monkeypatch, simulate, says):
    monkeypatch.setattr(hpgr, "simulate", simulate)
    found = judge.judge({"resolution.cells": 2})
    assert found.kind == "fault"
    assert says in found.message


def test_a_refusal_in_its_form_is_none(monkeypatch):
    refusal = ValueError("rolls.gap: got 3 mm; must be at least 4 mm; widen the gap")
    monkeypatch.setattr(hpgr, "simulate", raising(refusal))
    assert judge.judge({}) == Outcome("refused", message=str(refusal))


def test_swaps_are_judged_apart_with_nothing_to_break(monkeypatch):
    genuine = hpgr.simulate

    def losing(scene, seed=0):
        result = genuine(scene, seed)
        if scene.strength.reference_strength == 1e15:
            result["size"].values[-1, 0, 1, 0] = result["size"].values[-1, 0, 1, 1]
        return result

    monkeypatch.setattr(hpgr, "simulate", losing)
    found = judge.judge({"exchange": {}, "resolution.points": 9})
    assert found.kind == "fault"
    assert "with nothing to break: swaps conserve every size" in found.message


# --- random scenes ----------------------------------------------------------------------------------------------


def test_random_scenes_are_fixed_of_every_kind_and_mostly_run():
    assert json.dumps(extremes.random_values(5)) == json.dumps(extremes.random_values(5))
    assert extremes.random_values(5, seed=1) != extremes.random_values(5)
    drawn = [extremes.random_values(number) for number in range(200)]
    for name, words in ranges.choices().items():
        assert {values[name] for values in drawn if name in values} == set(words), name
    assert {values["resolution.cells"] for values in drawn} >= {0, 1, 2, 3}
    assert sum(values.get("exchange", {}) is not None for values in drawn) == 50
    assert any(math.isinf(values.get("strength.cushioning", 0)) for values in drawn)
    assert any(values.get("elasticity.exponent", 1) <= 0 for values in drawn)
    assert any(values["rolls.gap"] == values["rolls.entry_gap"] for values in drawn)
    refused = 0
    for values in drawn:
        try:
            scene = judge.base(values)
        except ValueError:
            refused += 1
            continue
        grid = scene.resolution
        assert cost.predict(scene).seconds <= 0.15 or max(grid.streamlines, grid.points, grid.cells) <= 4
    assert refused < 20


@pytest.mark.parametrize("number", range(sized(12, 4)))
def test_random_scenes_end_well_flagged_or_refused(number):
    outcome = judge.judge(extremes.random_values(number, seed=7))
    assert outcome.kind != "fault", outcome.message


# --- the study: table, file, figures, exit codes -----------------------------------------------------------------


@pytest.fixture
def small(tmp_path, monkeypatch):
    """A study of seconds in an empty folder: few scenes, small maps."""
    steps = {"resolution.points": (2, 9)}
    small = {
        "gap_speed": {"rolls.gap": (0.0, 0.03, 0.5), "rolls.speed": (1.0, 2e6)},
        "cushioning_step": {"strength.cushioning": (1.0, INF)} | steps,
        "exponent_step": {"elasticity.exponent": (-1.0, 0.5)} | steps,
    }
    values = {"MAPS": small, "_EXPONENTS": (-0.5, 0.5), "_STEPS": (10, 160), "_FINEST": 640}
    for name, value in values.items():
        monkeypatch.setattr(maps, name, value)
    maps._limit.cache_clear()
    rows = [row for row in judge.catalogue() if row.name in ("gap of 0", "M = 1", "M = 2", "swap sum above 1/2")]
    monkeypatch.setattr(extremes, "catalogue", lambda: sorted(rows, key=lambda row: row.name))
    monkeypatch.setattr(ranges, "numeric_fields", lambda: {"rolls.gap": KNOWN["rolls.gap"]})
    monkeypatch.setattr(ranges, "choices", dict)
    monkeypatch.setattr(extremes, "random_values", lambda number, seed: {"rolls.gap": 0.05 + number / 100})
    monkeypatch.chdir(tmp_path)
    yield tmp_path
    maps._limit.cache_clear()


def test_study(small, capsys):
    assert extremes.main(["--scenes", "3"]) == 0
    out, _ = capsys.readouterr()
    assert "silent faults: 0" in out
    rows = {line.split()[0]: line.split()[1:] for line in out.splitlines()[1:6]}
    assert rows["catalogue"] == ["4", "1", "1", "1", "1", "0"]
    assert rows["outside"] == ["2", "0", "0", "0", "2", "0"]
    assert rows["random"][0] == "3"
    assert "refused for: rolls.gap" in out
    assert "few_cells 1" in out
    assert "wrote outputs/extremes.nc, outputs/extremes.png and outputs/extremes_euler.png" in out
    with xr.open_dataset("outputs/extremes.nc") as result:
        result.load()
    assert result.attrs["history"] == "python -m studies.extremes --scenes 3"
    assert result["outcome"].attrs["flag_meanings"].split() == list(KINDS)
    assert [KINDS[kind] for kind in result["outcome"].values[:4]] == ["ok", "flagged", "refused", "substepped"]
    assert result["message"].values[2].startswith("rolls.gap: got 0 mm; must be at least 0.001 mm; give")
    assert result["substeps"].values[3] > 1
    assert json.loads(str(result["values"].values[-1])) == {"rolls.gap": 0.07}
    assert (result["gap_speed_outcome"].sel(gap_speed_speed=2e6) == KINDS.index("refused")).all()


def test_silent_faults_are_printed_with_their_scene_and_exit_with_1(small, capsys, monkeypatch):
    genuine = judge.judge
    wrong = Outcome("fault", message="finite: pressure holds nan")
    monkeypatch.setattr(extremes, "judge", lambda values, seed=0: wrong if 0.03 in values.values() else genuine(values))
    monkeypatch.setattr(extremes, "random_values", lambda number, seed: {"rolls.gap": 0.03, "strength.cushioning": INF})
    assert extremes.main(["--no-plot", "--scenes", "1"]) == 1
    out, err = capsys.readouterr()
    assert "silent faults: 3" in out  # one of the walk, two of the map
    told = err[err.index("FAULT in random, scene 0: finite: pressure holds nan") :].splitlines()
    assert judge.base(json.loads(told[1])).strength.cushioning == INF
    assert "FAULT in 2 scenes of the maps" in err


def test_too_many_scenes_are_refused(small, capsys):
    assert extremes.main(["--scenes", "-1"]) == 2
    assert "--scenes: got -1; must be within 0 to 1,000,000" in capsys.readouterr().err
    assert list(small.iterdir()) == []


def test_maps_and_their_figures(small):
    result = maps.maps(judge.judge)
    kinds = [KINDS[kind] for kind in result["gap_speed_outcome"].sel(gap_speed_speed=1.0).values]
    assert kinds == ["refused", "substepped", "flagged"]
    assert maps.faults(result) == 0
    error = result["integrator_error"]
    euler, increment = (error.sel(integrator=name, exponent=0.5).values for name in maps.INTEGRATORS)
    assert euler[1] < 0.1 < euler[0]
    assert increment[1] < 0.2 * euler[1]  # second order against first
    assert result["integrator_settled"].sel(exponent=0.5).values.all()
    assert not result["integrator_settled"].sel(exponent=-0.5).values.any()
    assert result["integrator_tension"].sel(exponent=-0.5, steps=160).values.all()
    figure = plots.stability(result)
    written = {text.get_text() for axes in figure.axes for text in axes.texts}
    assert "×" in written
    assert any("CN" in text for text in written)
    labels = [(axes.get_xlabel(), axes.get_ylabel()) for axes in figure.axes]
    assert labels[0] == ("rolls gap [mm]", "rolls speed [rpm]")
    assert labels[2] == ("exponent c [-]", "time step dt [-]")
    figure = plots.integrators(result)
    assert figure.axes[0].get_title() == "Euler, the paper's explicit rule"
    written = "".join(text.get_text() for text in figure.axes[0].texts)
    assert f"{100 * euler[0]:.1f}" in written
    assert "no limit\nT" in written
