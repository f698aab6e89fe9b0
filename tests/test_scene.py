import json
import math
import re
from typing import get_args

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import BaseModel, ValidationError
from support import feed_values, paper

from hpgr import Feed, Flow, Material, Resolution, Rolls, Scene, Stress, presets
from hpgr.scene import field_info, field_value

INF = math.inf
ROLLS = {"diameter": 0.8, "width": 0.25, "gap": 0.019, "entry_gap": 0.06, "speed": 1.7}
FEED = {"kind": "uniform", "bottom_size": 0.001, "top_size": 0.02}
# Fields in which inf is a limit with a meaning.
MAY_BE_INF = {"material.weibull_modulus", "material.cushioning"}


def numeric_fields():
    """Dotted names of every field that holds one number, with its unit."""
    found = {}
    for section, part in Scene.model_fields.items():
        if not (isinstance(part.annotation, type) and issubclass(part.annotation, BaseModel)):
            continue
        for key, field in part.annotation.model_fields.items():
            extra = field.json_schema_extra or {}
            if "unit" in extra and key not in {"table", "sieves"}:
                found[f"{section}.{key}"] = extra["unit"]
    return found


FIELDS = numeric_fields()
FLOATS = [name for name in FIELDS if name.split(".")[1] not in
          {"streamlines", "points", "cells", "photographs", "substeps"}]  # fmt: skip


def faults(values=None, **sections):
    """Return {dotted name: messages} of a refused scene."""
    data = {"rolls": dict(ROLLS), "feed": dict(FEED)} | sections
    for name, value in (values or {}).items():
        section, key = name.split(".")
        data[section] = dict(data.get(section, {})) | {key: value}
    with pytest.raises(ValidationError) as error:
        Scene(**data)
    found = {}
    for fault in error.value.errors():
        found.setdefault(".".join(map(str, fault["loc"])), []).append(fault["msg"])
    return found


def parts(message):
    """Split "got <value>; <bound>; <remedy>"."""
    value, bound, remedy = message.split("; ", 2)
    assert value.startswith("got ")
    return value[4:], bound, remedy


# --- what is refused ---------------------------------------------------------------------------------------

REFUSED = [
    ("rolls.gap", 0, "0 mm", "must be at least 0.001 mm"),
    ("rolls.gap", "-5 mm", "-5 mm", "must be at least 0.001 mm"),
    ("rolls.gap", 5e-324, "4.94066e-321 mm", "must be at least 0.001 mm"),
    ("rolls.entry_gap", 5e-324, "4.94066e-321 mm", "must be at least 0.001 mm"),
    ("rolls.gap", 0.061, "61 mm", "must be at most the entry gap 60 mm"),
    ("rolls.entry_gap", 0.42, "420 mm", "must be less than gap + 0.5 x diameter = 419 mm"),
    ("rolls.entry_gap", 0.9, "900 mm", "must be less than gap + 0.5 x diameter"),
    ("rolls.speed", 0, "0 rpm", "must be at least 9.5493e-06 rpm"),
    ("rolls.speed", -1.0, "-9.5493 rpm", "must be at least 9.5493e-06 rpm"),
    ("rolls.speed", 5e-324, "4.94066e-323 rpm", "must be at least 9.5493e-06 rpm"),
    ("rolls.width", 0, "0 mm", "must be at least 0.1 mm"),
    ("rolls.diameter", 0, "0 mm", "must be at least 1 mm"),
    ("rolls.diameter", 2e3, "2e+06 mm", "must be at most 1e+06 mm"),
    ("material.solid_density", 0, "0 kg m-3", "must be at least 1 kg m-3"),
    ("material.solid_density", -2650, "-2650 kg m-3", "must be at least 1 kg m-3"),
    ("material.strength", 0, "0 MPa", "must be at least 1e-06 MPa"),
    ("material.strength_size", 0, "0 mm", "must be at least 0.001 mm"),
    ("material.weibull_modulus", 0, "0", "must be at least 0.001"),
    ("material.weibull_modulus", -3, "-3", "must be at least 0.001"),
    ("material.cushioning", 0, "0", "must be at least 1e-06"),
    ("material.cushioning", 9e-7, "9e-07", "must be at least 1e-06"),
    ("material.fragment_exponent", 0, "0", "must be at least 0.001"),
    ("material.size_floor", 0, "0 mm", "must be at least 1e-06 mm"),
    ("material.bulk_modulus", 0, "0 MPa", "must be at least 1e-06 MPa"),
    ("material.shear_modulus", -1, "-1e-06 MPa", "must be at least 1e-06 MPa"),
    ("material.elastic_exponent", -1, "-1", "must be greater than -1"),
    ("material.feed_solid_fraction", 1.1, "1.1", "must be at most 1"),
    ("material.max_solid_fraction", 0.5, "0.5", "must be at least feed_solid_fraction 0.6"),
    ("feed.bottom_size", 0.03, "30 mm", "must be less than top_size 20 mm"),
    ("feed.bottom_size", -0.001, "-1 mm", "must be at least 0 mm"),
    ("feed.top_size", 0.07, "70 mm", "must be at most the entry gap rolls.entry_gap 60 mm"),
    ("flow.exponent", 0, "0", "must be at least 0.01"),
    ("flow.entry_fraction", 0, "0", "must be at least 1e-09"),
    ("flow.entry_fraction", 5e-324, "4.94066e-324", "must be at least 1e-09"),
    ("flow.entry_fraction", 1, "1", "must be less than 1"),
    ("stress.substeps", 0, "0", "must be at least 1"),
    ("resolution.streamlines", 0, "0", "must be at least 1"),
    ("resolution.points", 1, "1", "must be at least 2"),
    ("resolution.cells", -1, "-1", "must be at least 0"),
    ("resolution.photographs", 0, "0", "must be at least 1"),
]


@pytest.mark.parametrize(("name", "value", "shown", "bound"), REFUSED, ids=[f"{n}={v}" for n, v, *_ in REFUSED])
def test_refusals_name_field_value_bound_and_remedy(name, value, shown, bound):
    found = faults({name: value})
    assert set(found) == {name}
    got, told, remedy = parts(found[name][0])
    assert got == shown
    assert told.startswith(bound)
    assert len(remedy) > 10


@pytest.mark.parametrize("name", FLOATS)
@pytest.mark.parametrize("value", [math.nan, INF, -INF], ids=str)
def test_nan_and_inf_are_refused_where_they_mean_nothing(name, value):
    if name in MAY_BE_INF and value == INF:
        assert Scene(rolls=ROLLS, feed=FEED, material={name.split(".")[1]: INF})
        return
    found = faults({name: value})
    assert name in found
    shown, bound, remedy = parts(found[name][0])
    assert shown.startswith(("nan", "inf", "-inf"))
    assert bound.startswith("must ")
    assert remedy


@pytest.mark.parametrize("value", [np.float32(np.nan), np.float64(np.nan), np.float32(np.inf)], ids=str)
def test_numpys_nan_and_inf_are_refused_too(value):
    assert set(faults({"rolls.gap": value})) == {"rolls.gap"}


@pytest.mark.parametrize("name", FIELDS)
@pytest.mark.parametrize("value", [True, None, [1], {}, object()], ids=["true", "none", "list", "dict", "object"])
def test_wrong_types_are_refused(name, value):
    section, key = name.split(".")
    if value is None and type(None) in get_args(Scene.model_fields[section].annotation.model_fields[key].annotation):
        return  # how a field that is not needed is left out
    assert name in faults({name: value})


@pytest.mark.parametrize("name", [name for name in FIELDS if name not in FLOATS])
@pytest.mark.parametrize("value", [10.0, "10", 2.5, math.nan])
def test_counts_are_whole_numbers(name, value):
    assert "must be a whole number" in faults({name: value})[name][0]


def test_numbers_too_large_for_a_float_are_refused():
    for name in FLOATS:
        assert name in faults({name: 10**400})


@pytest.mark.parametrize(
    ("section", "wrong", "hint"),
    [
        ("rolls", "gpa", "did you mean 'gap'?"),
        ("material", "strenght", "did you mean 'strength'?"),
        ("feed", "zzz", "known fields: kind, bottom_size"),
        ("resolution", "cell", "did you mean 'cells'?"),
        ("stress", "integrater", "did you mean 'integrator'?"),
    ],
)
def test_unknown_keys_are_refused_with_the_likely_name(section, wrong, hint):
    message = faults({f"{section}.{wrong}": 1})[f"{section}.{wrong}"][0]
    assert "unknown field" in message
    assert hint in message


def test_unknown_sections_are_refused():
    assert "did you mean 'rolls'?" in faults(rols={})["rols"][0]


@pytest.mark.parametrize(
    ("name", "value"),
    [("flow.profile", "plug"), ("stress.integrator", "rk4"), ("stress.crushing", "max"), ("resolution.record", "all"),
     ("feed.kind", "gaussian"), ("stress.crushing", 3)],
)  # fmt: skip
def test_choices_are_listed(name, value):
    message = faults({name: value})[name][0]
    assert repr(value) in message
    assert "must be one of '" in message


@pytest.mark.parametrize("data", ["x", 3, None, [1, 2]])
def test_sections_of_a_wrong_type_are_refused(data):
    assert "material" in faults(material=data)
    assert "rolls" in faults(rolls=data)


def test_missing_sections_and_fields_are_told():
    with pytest.raises(ValidationError) as error:
        Scene()
    assert {fault["loc"] for fault in error.value.errors()} == {("rolls",), ("feed",)}
    found = faults(rolls={"gap": 0.02})
    assert set(found) == {f"rolls.{name}" for name in ("diameter", "width", "entry_gap", "speed")}
    assert all("it is required" in messages[0] for messages in found.values())


def test_all_faults_come_at_once():
    """Field faults, unknown keys, wrong types and impossible combinations, in every section."""
    found = faults(
        {
            "rolls.gap": "-5 mm",
            "rolls.speed": math.nan,
            "rolls.width": INF,
            "rolls.colour": "red",
            "feed.top_size": "70 mm",
            "feed.size": 0.01,
            "material.weibull_modulus": 0,
            "material.cushioning": "soft",
            "material.strength": "0.84",
            "material.feed_solid_fraction": 0.95,
            "flow.entry_fraction": 1.0,
            "stress.integrator": "rk4",
            "resolution.cells": True,
            "resolution.sieves": [0.1, 0.01],
        }
    )
    assert set(found) == {
        "rolls.gap", "rolls.speed", "rolls.width", "rolls.colour", "feed.top_size", "feed.size",
        "material.weibull_modulus", "material.cushioning", "material.strength", "material.max_solid_fraction",
        "flow.entry_fraction", "stress.integrator", "resolution.cells", "resolution.sieves",
    }  # fmt: skip
    assert all(len(messages) == 1 for messages in found.values())


def test_combinations_are_judged_beside_faults_of_other_fields():
    """The bad width hides neither the gap above the entry gap nor the top size above it."""
    found = faults({"rolls.width": -1, "rolls.gap": 0.07, "feed.top_size": 0.08, "feed.bottom_size": "x"})
    assert set(found) == {"rolls.width", "rolls.gap", "feed.top_size", "feed.bottom_size"}


def test_combinations_are_not_judged_on_refused_values():
    found = faults({"rolls.gap": -1, "rolls.entry_gap": INF})
    assert set(found) == {"rolls.gap", "rolls.entry_gap"}
    assert all(len(messages) == 1 for messages in found.values())


def test_a_fault_reads_in_one_line():
    with pytest.raises(ValidationError) as error:
        Scene(rolls=ROLLS | {"gap": 0.07}, feed=FEED)
    text = str(error.value)
    assert "rolls.gap\n  got 70 mm; must be at most the entry gap 60 mm; narrow the gap or raise the entry gap" in text
    assert "https://" not in text


def test_bounds_themselves_are_allowed():
    Scene(rolls=ROLLS | {"gap": 0.06}, feed=FEED)  # gap = entry gap
    Scene(rolls=ROLLS | {"entry_gap": 0.41}, feed=FEED)
    Scene(rolls=ROLLS, feed=FEED | {"top_size": 0.06})
    Scene(rolls=ROLLS, feed=FEED, material={"cushioning": 1e-6, "max_solid_fraction": 0.6, "elastic_exponent": -0.99})
    Scene(rolls=ROLLS, feed=FEED, resolution={"cells": 0, "points": 2, "streamlines": 1})


# --- feeds -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "needed"),
    [
        ("uniform", {"bottom_size", "top_size"}),
        ("single", {"size"}),
        ("power_law", {"top_size", "exponent"}),
        ("rosin_rammler", {"size", "exponent", "top_size"}),
        ("table", {"table"}),
    ],
)
def test_each_kind_of_feed_has_its_own_fields(kind, needed):
    found = faults(feed={"kind": kind})
    assert set(found) == {f"feed.{name}" for name in needed}
    assert all(f"a {kind} feed needs it" in messages[0] for messages in found.values())
    everything = {"bottom_size": 0.001, "top_size": 0.02, "size": 0.01, "exponent": 0.7,
                  "table": ((0.001, 0.0), (0.03, 100.0))}  # fmt: skip
    allowed = needed | ({"top_size"} if kind == "table" else set())
    found = faults(feed={"kind": kind} | everything)
    assert set(found) == {f"feed.{name}" for name in set(everything) - allowed}
    assert all("has no such field; remove it" in messages[0] for messages in found.values())


@pytest.mark.parametrize(
    "feed",
    [
        {"kind": "single", "size": 0.07},
        {"kind": "power_law", "top_size": 0.07, "exponent": 1},
        {"kind": "table", "table": ((0.001, 0.0), (0.07, 100.0))},
        {"kind": "table", "table": ((0.001, 0.0), (0.08, 100.0)), "top_size": 0.07},
    ],
    ids=lambda feed: feed["kind"],
)
def test_feeds_coarser_than_the_entry_gap_are_refused(feed):
    (message,) = (text for texts in faults(feed=feed).values() for text in texts)
    assert "70 mm; must be at most the entry gap rolls.entry_gap 60 mm" in message


def test_scalped_tables_may_be_coarser_than_the_entry_gap():
    Scene(rolls=ROLLS, feed={"kind": "table", "table": ((0.001, 0.0), (0.08, 100.0)), "top_size": 0.05})


def test_refused_table_entries_name_row_and_column():
    found = faults(feed={"kind": "table", "table": ((0.001, 0.0), (0.002, math.nan), ("3 s", 100.0))})
    assert set(found) == {"feed.table.1.1", "feed.table.2.0"}


def test_table_entries_are_shown_with_one_unit():
    (message,) = faults(feed={"kind": "table", "table": ((0.001, 0.0), (0.002, math.nan), (0.003, 100.0))})[
        "feed.table.1.1"
    ]
    assert "m, %" not in message


# --- what is accepted --------------------------------------------------------------------------------------


def test_text_with_units_numbers_and_numpy_scalars_mean_the_same():
    plain = Scene(rolls=ROLLS | {"speed": 19 * 2 * math.pi / 60}, feed=FEED)
    text = Scene(
        rolls={"diameter": "80 cm", "width": "250 mm", "gap": "19 mm", "entry_gap": "60mm", "speed": "19 rpm"},
        feed={"kind": "uniform", "bottom_size": "1 mm", "top_size": "20 mm"},
    )
    for first, second in zip(flat(plain), flat(text), strict=True):
        assert first == pytest.approx(second, rel=1e-14)
    numpy = Scene(
        rolls={name: np.float64(value) for name, value in ROLLS.items()},
        feed=FEED,
        resolution={"cells": np.int64(5), "points": np.uint8(7)},
    )
    assert numpy.rolls.gap == 0.019
    assert type(numpy.rolls.gap) is float
    assert (numpy.resolution.cells, numpy.resolution.points) == (5, 7)
    assert type(numpy.resolution.cells) is int
    assert type(Rolls(**ROLLS | {"diameter": np.int32(1)}).diameter) is float


def flat(scene):
    for name, unit in FIELDS.items():
        section, key = name.split(".")
        value = getattr(getattr(scene, section), key)
        if value is not None and unit != "1":
            yield value


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("rolls.gap", "19", "text without a unit; write it as '19 mm'"),
        ("rolls.gap", "3 s", "not a quantity in mm"),
        ("rolls.speed", "0.67 m/s", "not a rate of turning"),
        ("material.strength", "840 mm", "not a quantity in MPa"),
        ("material.solid_density", "2650", "text without a unit"),
        ("material.cushioning", "1", "must be a number, not text"),
        ("material.cushioning", "nan", "must be a number, not text"),
        ("rolls.gap", "abc", "not a number and a unit"),
        ("rolls.gap", "inf mm", "must be finite"),
        ("material.elastic_exponent", "inf", "must be finite"),
    ],
)
def test_bad_text_is_refused(name, value, words):
    found = faults({name: value})
    assert set(found) == {name}
    assert words in found[name][0]


def test_unbalanced_text_is_a_fault_like_any_other():
    assert set(faults({"rolls.gap": "19 mm)"})) == {"rolls.gap"}


def test_sieves_rise_and_carry_units():
    assert Resolution(sieves=["1 mm", 0.01]).sieves == (0.001, 0.01)
    assert (
        "got sieve 2 of 10 mm; must exceed 100 mm" in faults({"resolution.sieves": [0.1, 0.01]})["resolution.sieves"][0]
    )
    assert "resolution.sieves" in faults({"resolution.sieves": []})
    assert "resolution.sieves" in faults({"resolution.sieves": [-1.0, 1.0]})
    assert "resolution.sieves" in faults({"resolution.sieves": [0.0, 1.0]})
    assert len(Resolution().sieves) == 61
    assert Resolution().sieves[0] == 1e-6
    assert Resolution().sieves[-1] == 1.0


def test_defaults_are_the_papers_quartz():
    ore = Material()
    assert (ore.solid_density, ore.strength, ore.strength_size, ore.weibull_modulus) == (2650, 0.84e6, 0.06, 3.04)
    assert (ore.bulk_modulus, ore.shear_modulus, ore.elastic_exponent) == (28.3e6, 13.1e6, 0.5)
    assert (ore.cushioning, ore.fragment_exponent, ore.size_floor) == (1, 1, 1e-6)
    assert (ore.feed_solid_fraction, ore.max_solid_fraction) == (0.6, 0.9)
    assert (Flow().exponent, Flow().entry_fraction) == (1, 0.02)
    assert (Stress().integrator, Stress().crushing) == ("increment", "mean")


def test_papers_machine():
    rolls, feed = presets.paper().rolls, presets.paper().feed
    assert (rolls.diameter, rolls.gap, rolls.entry_gap) == (6, 0.06, 1.14)
    assert rolls.speed * 60 / (2 * math.pi) == pytest.approx(19)
    assert (feed.kind, feed.bottom_size, feed.top_size) == ("uniform", 0.008, 0.06)


def test_scenes_are_frozen_and_equal_by_value():
    scene = paper()
    with pytest.raises(ValidationError, match="frozen"):
        scene.rolls.gap = 0.01
    with pytest.raises(ValidationError, match="frozen"):
        scene.rolls = scene.rolls
    assert scene == paper()
    assert scene != paper({"rolls.gap": 0.05})
    assert Scene.model_validate(scene) is scene


def test_repr_is_short():
    assert repr(presets.paper()) == (
        "<hpgr.Scene: rolls 6000 mm x 1000 mm, gap 60 mm, 19 rpm; uniform feed to 60 mm; 10 x 200 x 1000>"
    )
    assert str(presets.paper()) == repr(presets.paper())
    for preset in presets.PRESETS.values():
        assert len(repr(preset())) < 120


# --- in and out --------------------------------------------------------------------------------------------

INFINITE = {"material.cushioning": INF, "material.weibull_modulus": INF}


@pytest.mark.parametrize(
    "values",
    [
        {},
        INFINITE,
        feed_values(kind="table", table=((0.001, 10.0), (0.05, 100.0)), top_size=0.02),
        {"resolution.sieves": (0.001, 0.01), "rolls.gap": 0.1 + 0.2 - 0.24},
    ],
    ids=["paper", "infinite", "table", "awkward floats"],
)
def test_json_and_back(values, tmp_path):
    scene = paper(values)
    text = scene.model_dump_json()
    assert Scene.model_validate_json(text) == scene
    json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))
    path = tmp_path / "scene.json"
    path.write_text(text, encoding="utf-8")
    assert Scene.from_file(path) == scene


@given(st.floats(1e-3, 0.5), st.floats(1e-6, 1e6), st.floats(0.01, 100) | st.just(INF))
def test_json_keeps_every_bit(gap, gamma, n):
    scene = paper(
        {"rolls.gap": gap, "material.fragment_exponent": min(max(gamma, 1e-3), 1e6), "material.cushioning": n}
    )
    assert Scene.model_validate_json(scene.model_dump_json()) == scene


TOML = """
[rolls]
diameter = "0.8 m"
width = "0.25 m"
gap = "19 mm"
entry_gap = 0.06
speed = "16 rpm"
[material]
cushioning = inf
weibull_modulus = inf
[feed]
kind = "table"
table = "feeds/ore.csv"
[resolution]
cells = 100
"""


def scene_file(tmp_path, text=TOML):
    (tmp_path / "feeds").mkdir(exist_ok=True)
    table = "size_mm,percent_passing\n20,100\n10,60\n1,0\n"
    (tmp_path / "feeds" / "ore.csv").write_text(table, encoding="utf-8")
    path = tmp_path / "scene.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_toml_in_with_a_table_beside_it_and_json_out(tmp_path, monkeypatch):
    path = scene_file(tmp_path)
    monkeypatch.chdir("/")  # the table's path is relative to the file, not to where the program runs
    scene = Scene.from_file(path)
    assert scene.rolls.gap == pytest.approx(0.019)
    assert scene.feed.table == ((0.001, 0.0), (0.01, 60.0), (0.02, 100.0))
    assert math.isinf(scene.material.cushioning)
    assert math.isinf(scene.material.weibull_modulus)
    assert Scene.from_file(str(path)) == scene
    assert Scene.model_validate_json(scene.model_dump_json()) == scene


def test_toml_faults_come_at_once(tmp_path):
    text = TOML.replace('"19 mm"', '"190 mm"').replace("cells = 100", "cels = 100").replace("ore.csv", "none.csv")
    with pytest.raises(ValidationError) as error:
        Scene.from_file(scene_file(tmp_path, text))
    names = {".".join(map(str, fault["loc"])) for fault in error.value.errors()}
    assert names == {"rolls.gap", "resolution.cels", "feed.table"}
    assert "none.csv" in str(error.value)


@pytest.mark.parametrize("name", FLOATS)
def test_inf_in_toml_is_refused_but_where_it_is_a_limit(name, tmp_path):
    if name in MAY_BE_INF or name.startswith("feed."):
        return
    section, key = name.split(".")
    rows = {"rolls": dict(ROLLS), "feed": dict(FEED), "material": {}, "flow": {}}
    rows[section][key] = INF
    text = "\n".join(
        f"[{part}]\n" + "\n".join(f"{k} = {json.dumps(v) if v != INF else 'inf'}" for k, v in values.items())
        for part, values in rows.items()
    )
    with pytest.raises(ValidationError, match=key):
        Scene.from_file(scene_file(tmp_path, text))


def test_unreadable_files(tmp_path):
    with pytest.raises(OSError, match=r"none\.toml"):
        Scene.from_file(tmp_path / "none.toml")
    with pytest.raises(ValueError, match="not TOML") as error:
        Scene.from_file(scene_file(tmp_path, "[rolls\ngap ="))
    assert "scene.toml" in str(error.value)
    bad = tmp_path / "bad.json"
    bad.write_text("{", encoding="utf-8")
    with pytest.raises(ValueError, match="JSON"):
        Scene.from_file(bad)
    with pytest.raises(ValidationError, match="rolls"):
        Scene.from_file(scene_file(tmp_path, ""))


def test_with_values_changes_only_these():
    scene = presets.khd_pilot()
    changed = scene.with_values({"rolls.gap": "25 mm", "resolution.cells": 7})
    assert (changed.rolls.gap, changed.resolution.cells) == (0.025, 7)
    back = changed.with_values({"rolls.gap": scene.rolls.gap, "resolution.cells": scene.resolution.cells})
    assert back == scene
    assert scene.with_values({}) == scene
    assert scene == presets.khd_pilot()


def test_with_values_lists_every_fault():
    with pytest.raises(ValidationError) as error:
        paper().with_values({"rolls.gpa": 3, "rolls.gap": "2 m", "bogus": 1, "x.y": 2})
    names = {".".join(map(str, fault["loc"])) for fault in error.value.errors()}
    assert names == {"rolls.gpa", "rolls.gap", "bogus", "x"}


@pytest.mark.parametrize("name", FIELDS)
def test_every_number_carries_symbol_unit_and_source(name):
    section, key = name.split(".")
    field = Scene.model_fields[section].annotation.model_fields[key]
    assert "Source: " in field.description
    info = field_info(name)
    assert info.unit == FIELDS[name]
    assert info.symbol
    assert info.text
    assert field.json_schema_extra["remedy"]


def test_every_field_is_described():
    for section, part in Scene.model_fields.items():
        assert part.description, section
        if isinstance(part.annotation, type) and issubclass(part.annotation, BaseModel):
            for key, field in part.annotation.model_fields.items():
                assert field.description, f"{section}.{key}"


def test_unknown_field_names_get_suggestions():
    with pytest.raises(ValueError, match=r"no field 'rolls.gpa'; did you mean 'rolls.gap'"):
        field_info("rolls.gpa")
    with pytest.raises(ValueError, match="did you mean"):
        field_info("qqqqqq")


def test_a_field_judges_a_value_alone():
    assert field_value("rolls.gap", "40 mm") == 0.04
    assert field_value("resolution.cells", np.int64(3)) == 3
    assert math.isinf(field_value("material.cushioning", INF))
    for name, value, words in (
        ("rolls.gap", -1, "rolls.gap: got -1000 mm; must be at least 0.001 mm; measure"),
        ("rolls.gap", INF, "must be finite"),
        ("rolls.gap", "3 s", "not a quantity in mm"),
        ("rolls.gpa", 1, "did you mean 'rolls.gap'"),
    ):
        with pytest.raises(ValueError, match=words):
            field_value(name, value)


@pytest.mark.parametrize("name", presets.PRESETS)
def test_presets_name_their_sources(name):
    """Every figure of a preset carries a comment with its source, and the scene is possible."""
    import inspect

    preset = presets.PRESETS[name]
    assert isinstance(preset(), Scene)
    assert any(word in inspect.getdoc(preset) for word in ("paper", "Torres"))
    for row in inspect.getsource(preset).splitlines():
        given = row.partition("=")[2].partition("#")[0]
        if not row.lstrip().startswith("note=") and any(character.isdigit() for character in given):
            assert "#" in row, row


def test_feed_says_its_coarsest_size():
    assert Feed(**FEED).coarsest == 0.02
    assert Feed(kind="single", size=0.01).coarsest == 0.01
    assert Feed(kind="table", table=((0.001, 0.0), (0.03, 100.0))).coarsest == 0.03
    assert Feed(kind="rosin_rammler", size=0.01, exponent=1, top_size=0.05).coarsest == 0.05


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"rolls.gap": "60 kg"}, "got '60 kg'; not a quantity in mm: its unit 'kg' measures something else; measure"),
        ({"rolls.gap": "60 foos"}, "its unit 'foos' is not known"),
        ({"rolls": 3}, "got 3; must be a table of fields; give its fields: diameter, width, gap"),
        ({"feed": {}}, "got nothing; it is required; choose one of 'uniform', 'single'"),
        ({"feed": {"kind": "table", "table": "no.csv"}}, r"got 'no.csv'; the file cannot be read \(No such file"),
    ],
)
def test_messages_say_what_to_give(values, words):
    with pytest.raises(ValidationError, match=words) as refused:
        presets.paper().with_values(values)
    assert not re.search(r"Error|Errno|see the field", str(refused.value).split("for Scene")[1])


def test_missing_parts_are_named_with_their_fields():
    with pytest.raises(ValidationError, match="it is required; give its fields: kind, bottom_size"):
        Scene(rolls=presets.paper().rolls)


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.json", b"{", r"a\.json: not JSON: .* line 1"),
        ("a.toml", b"note = '\xe9'", r"a\.toml: byte 8 is not UTF-8; save"),
    ],
)
def test_files_that_are_no_text_name_themselves(tmp_path, name, content, words):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=words):
        Scene.from_file(tmp_path / name)
