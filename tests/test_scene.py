import json
import math
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError
from support import paper

from hpgr import Resolution, Rolls, Scene, presets
from hpgr.fields import kinds_of, parts_of
from hpgr.scene import field_info, field_value, fields, levels

INF = math.inf
ROLLS = {"diameter": 0.8, "width": 0.25, "gap": 0.019, "entry_gap": 0.06, "speed": 1.7}
FEED = {"kind": "uniform", "bottom_size": 0.001, "top_size": 0.02}
FIELDS = {name: field for name, (_, field) in fields().items() if not name.endswith(".kind")}
COUNTS = {"streamlines", "points", "cells", "snapshots", "substeps", "interval", "slices"}
FLOATS = [
    name
    for name, field in FIELDS.items()
    if "unit" in (field.json_schema_extra or {}) and name.split(".")[1] not in COUNTS | {"table", "sieves"}
]
# where inf is a limit with a meaning
MAY_BE_INF = {name for name in FLOATS if any(getattr(one, "allow_inf_nan", False) for one in FIELDS[name].metadata)}
# fields that the law meant by default has not, with the kind of one that has them
DEFAULTS = {"feed": "uniform", "flow": "power", "roll_width": "parabola"}
OWN_KIND = {
    f"{section}.{key}": kinds_of(law)[0]
    for section, default in DEFAULTS.items()
    for law in reversed(parts_of(Scene.model_fields[section]))
    for key in law.model_fields
    if not any(
        key in other.model_fields for other in parts_of(Scene.model_fields[section]) if default in kinds_of(other)
    )
}


def faults(values=None, **sections):
    """Return {dotted name: messages} of a refused scene."""
    data = {"rolls": dict(ROLLS), "feed": dict(FEED)} | sections
    for name, value in (values or {}).items():
        section, key = name.split(".")
        data[section] = dict(data.get(section, {})) | {key: value}
        if name in OWN_KIND:
            data[section]["kind"] = OWN_KIND[name]
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


@pytest.mark.parametrize(
    ("name", "value", "shown", "bound"),
    [
        ("rolls.gap", "-5 mm", "-5 mm", "must be at least 0.001 mm"),
        ("rolls.gap", 0.061, "61 mm", "must be at most the entry gap 60 mm"),
        ("rolls.entry_gap", 0.42, "420 mm", "must be less than gap + 0.5 x diameter = 419 mm"),
        ("rolls.entry_gap", 0.9, "900 mm", "must be less than gap + 0.5 x diameter"),
        ("rolls.speed", 0, "0 rpm", "must be at least 9.5493e-06 rpm"),
        ("rolls.diameter", 2e3, "2e+06 mm", "must be at most 1e+06 mm"),
        ("bed.max_solid_fraction", 0.5, "0.5", "must be at least feed_solid_fraction 0.6"),
        ("elasticity.exponent", -1, "-1", "must be greater than -1"),
        ("feed.bottom_size", 0.03, "30 mm", "must be less than top_size 20 mm"),
        ("feed.top_size", 0.07, "70 mm", "must be at most the entry gap rolls.entry_gap 60 mm"),
        ("flow.entry_fraction", 1, "1", "must be less than 1"),
    ],
)
def test_refusals_name_field_value_bound_and_remedy(name, value, shown, bound):
    found = faults({name: value})
    assert set(found) == {name}
    got, told, remedy = parts(found[name][0])
    assert got == shown
    assert told.startswith(bound)
    assert len(remedy) > 10


def test_nan_inf_and_wrong_types_are_refused_in_every_field():
    for name in FLOATS:
        wrong = [math.nan, -INF, True, [1], {}, object(), 10**400, np.float32(np.nan)]
        for value in wrong + ([] if name in MAY_BE_INF else [INF]):
            _shown, bound, remedy = parts(faults({name: value})[name][0])
            assert bound.startswith(("must ", "a ")), (name, value)
            assert "such as" in remedy
    assert {"strength.weibull_modulus", "strength.cushioning"} <= MAY_BE_INF
    for name in MAY_BE_INF:
        section, key = name.split(".")
        assert Scene(rolls=ROLLS, feed=FEED, **{section: {key: INF}})


def test_counts_are_whole_numbers():
    for name in (name for name in FIELDS if name.split(".")[1] in COUNTS):
        for value in (10.0, "10", math.nan, True):
            assert "must be a whole number" in faults({name: value})[name][0]


@pytest.mark.parametrize(
    ("section", "wrong", "hint"),
    [
        ("rolls", "gpa", "did you mean 'gap'?"),
        ("strength", "weibul_modulus", "did you mean 'weibull_modulus'?"),
        ("feed", "zzz", "known fields: kind, bottom_size"),
        ("feed", "size", "did you mean 'top_size'?"),
    ],
)
def test_unknown_keys_are_refused_with_the_likely_name(section, wrong, hint):
    data = {"rolls": ROLLS, "feed": FEED, "strength": {}}
    (message,) = faults(**data | {section: data[section] | {wrong: 1}})[f"{section}.{wrong}"]
    assert "unknown field" in message
    assert hint in message


def test_unknown_sections_are_refused():
    assert "did you mean 'rolls'?" in faults(rols={})["rols"][0]


@pytest.mark.parametrize(
    ("name", "value"),
    [("elasticity.integrator", "rk4"), ("strength.stress", "max"), ("resolution.record", "x"), ("strength.stress", 3)],
)
def test_choices_are_listed(name, value):
    message = faults({name: value})[name][0]
    assert repr(value) in message
    assert "must be one of '" in message


def test_kinds_are_listed_and_another_kind_has_other_fields():
    assert "got 'plug'; its kind must be one of 'power', 'nip'" in faults(flow={"kind": "plug"})["flow"][0]
    assert "its kind must be one of 'uniform', 'single', 'power_law'" in faults(feed={})["feed"][0]
    assert "known fields: entry_fraction, kind, exponent" in faults(flow={"nip_angle": 0.1})["flow.nip_angle"][0]


@pytest.mark.parametrize("data", ["x", 3, None, [1, 2]])
def test_sections_of_a_wrong_type_are_refused(data):
    assert "must be a table of fields" in faults(strength=data)["strength"][0]
    assert "must be a table of fields; give its fields: entry_fraction, kind" in faults(flow=data)["flow"][0]
    assert "rolls" in faults(rolls=data)


def test_missing_sections_and_fields_are_told():
    with pytest.raises(ValidationError) as error:
        Scene()
    assert {fault["loc"] for fault in error.value.errors()} == {("rolls",), ("feed",)}
    assert "it is required; give its fields: kind, bottom_size" in str(error.value)
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
            "strength.weibull_modulus": 0,
            "strength.cushioning": "soft",
            "bed.feed_solid_fraction": 0.95,
            "flow.entry_fraction": 1.0,
            "elasticity.integrator": "rk4",
            "resolution.cells": True,
            "resolution.sieves": [0.1, 0.01],
        }
    )
    expected = "rolls.gap rolls.speed rolls.width rolls.colour feed.top_size strength.weibull_modulus "
    expected += "strength.cushioning bed.max_solid_fraction flow.entry_fraction elasticity.integrator "
    expected += "resolution.cells resolution.sieves"
    assert set(found) == set(expected.split())
    assert all(len(messages) == 1 for messages in found.values())


def test_combinations_are_judged_on_valid_values_only():
    """The bad width hides neither the gap above the entry gap nor the top size above it."""
    found = faults({"rolls.width": -1, "rolls.gap": 0.07, "feed.top_size": 0.08, "feed.bottom_size": "x"})
    assert set(found) == {"rolls.width", "rolls.gap", "feed.top_size", "feed.bottom_size"}
    found = faults({"rolls.gap": -1, "rolls.entry_gap": INF})
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
    assert "m, %" not in found["feed.table.1.1"][0]


@pytest.mark.parametrize(
    ("values", "refused", "words"),
    [
        ({"cake_solid_fraction": 0.5}, "flow.cake_solid_fraction", "must lie within feed_solid_fraction 0.6 to"),
        (
            {"cake_solid_fraction": 0.6},
            "flow.cake_solid_fraction",
            "a nip angle of 0 deg; must give at least 0.0573 deg",
        ),
        ({"nip_angle": "20 deg"}, "rolls.entry_gap", "must be at least 67.2459 mm, the roll distance at the nip"),
        ({"nip_angle": "9 deg", "cake_solid_fraction": 0.8}, "flow.nip_angle", "must be one of nip_angle and cake"),
        ({}, "flow.nip_angle", "got nothing; must be one of nip_angle and cake_solid_fraction"),
    ],
)
def test_a_nip_that_does_not_lie_in_the_bed_is_refused(values, refused, words):
    assert words in faults(flow={"kind": "nip"} | values)[refused][0]


def test_text_with_units_numbers_and_numpy_scalars_mean_the_same():
    plain = Scene(rolls=ROLLS | {"speed": 19 * 2 * math.pi / 60}, feed=FEED)
    text = Scene(
        rolls={"diameter": "80 cm", "width": "250 mm", "gap": "19 mm", "entry_gap": "60mm", "speed": "19 rpm"},
        feed={"kind": "uniform", "bottom_size": "1 mm", "top_size": "20 mm"},
    )
    for section in ("rolls", "feed"):
        first, second = (
            getattr(scene, section).model_dump(exclude_none=True, exclude={"kind"}) for scene in (plain, text)
        )
        assert first == pytest.approx(second, rel=1e-14)
    rolls = {name: np.float64(value) for name, value in ROLLS.items()}
    numpy = Scene(rolls=rolls, feed=FEED, resolution={"cells": np.int64(5), "points": np.uint8(7)})
    assert type(numpy.rolls.gap) is float
    assert (numpy.resolution.cells, type(numpy.resolution.points)) == (5, int)
    assert type(Rolls(**ROLLS | {"diameter": np.int32(1)}).diameter) is float


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("rolls.gap", "60 kg", "got '60 kg'; not a quantity in mm: its unit 'kg' measures something else; give"),
        ("strength.cushioning", "1", "must be a number, not text"),
        ("rolls.gap", "inf mm", "must be finite"),
        ("elasticity.exponent", "inf", "must be finite"),
    ],
)
def test_bad_text_is_refused(name, value, words):
    found = faults({name: value})
    assert set(found) == {name}
    assert words in found[name][0]
    assert not re.search(r"Error|Errno|see the field", found[name][0])


def test_sieves_rise_and_carry_units():
    assert Resolution(sieves=["1 mm", 0.01]).sieves == (0.001, 0.01)
    message = faults({"resolution.sieves": [0.1, 0.01]})["resolution.sieves"][0]
    assert "got sieve 2 of 10 mm; must exceed 100 mm" in message
    for wrong in ([], [-1.0, 1.0], [0.0, 1.0]):
        assert "resolution.sieves" in faults({"resolution.sieves": wrong})
    assert (len(Resolution().sieves), Resolution().sieves[0], Resolution().sieves[-1]) == (61, 1e-6, 1.0)


def test_defaults_are_the_papers_quartz():
    scene = Scene(rolls=ROLLS, feed=FEED)
    strength, elasticity, bed = scene.strength, scene.elasticity, scene.bed
    assert (strength.reference_strength, strength.reference_size, strength.weibull_modulus) == (0.84e6, 0.06, 3.04)
    assert (strength.cushioning, strength.stress) == (1, "mean")
    assert (elasticity.bulk_modulus, elasticity.shear_modulus, elasticity.exponent) == (28.3e6, 13.1e6, 0.5)
    assert (elasticity.integrator, elasticity.substeps) == ("increment", 1)
    assert (scene.fragments.exponent, scene.fragments.size_floor) == (1, 1e-6)
    assert (bed.solid_density, bed.feed_solid_fraction, bed.max_solid_fraction) == (2650, 0.6, 0.9)
    assert (scene.flow.kind, scene.flow.exponent, scene.flow.entry_fraction) == ("power", 1, 0.02)
    assert (scene.exchange, scene.roll_width) == (None, None)


def test_papers_machine():
    rolls, feed = presets.paper().rolls, presets.paper().feed
    assert (rolls.diameter, rolls.width, rolls.gap, rolls.entry_gap) == (6, 1, 0.06, 1.14)
    assert rolls.speed * 60 / (2 * math.pi) == pytest.approx(19)
    assert (feed.kind, feed.bottom_size, feed.top_size) == ("uniform", 0.008, 0.06)


def test_presets_are_data_with_a_source_beside_every_value():
    assert presets.NAMES == ("industrial", "khd_pilot", "paper")
    for name in presets.NAMES:
        assert Scene.preset(name) == getattr(presets, name)()
        assert len(repr(Scene.preset(name))) < 120
        for row in (presets.DATA / "presets" / f"{name}.toml").read_text(encoding="utf-8").splitlines():
            number = re.search(r'= *(?:\d|"\d)', row)
            assert not number or "#" in row, row
    with pytest.raises(ValueError, match="base: got 'papre'; must be one of 'industrial', 'khd_pilot', 'paper'"):
        Scene.preset("papre")


def test_scenes_are_frozen_and_equal_by_value():
    scene = paper()
    with pytest.raises(ValidationError, match="frozen"):
        scene.rolls.gap = 0.01
    assert scene == paper()
    assert hash(scene) == hash(paper())
    assert scene != paper({"rolls.gap": 0.05})
    assert Scene.model_validate(scene) is scene


def test_named_resolutions():
    assert set(levels()) == {"draft", "standard", "fine"}
    exchange = {}
    fine = paper({"resolution.record": "product"}).with_values(
        {"resolution": "fine", "resolution.cells": 32_000, "exchange": exchange, "exchange.mixing": 0}
    )
    assert (fine.resolution.points, fine.resolution.record) == (800, "product")
    assert (fine.exchange.mixing, exchange) == (0, {})
    assert fine.resolution.level().startswith("fine: P50, P80")
    assert paper().resolution.level() == "custom"
    with pytest.raises(ValidationError, match="resolution\n  got 'finest'"):
        paper().with_values({"resolution": "finest", "resolution.cells": 3})


TABLE = {"kind": "table", "table": ((0.001, 10.0), (0.05, 100.0)), "top_size": 0.02}


@pytest.mark.parametrize(
    "values",
    [
        {"strength.cushioning": INF, "strength.weibull_modulus": INF},
        {"feed": TABLE, "exchange": {}, "flow": {"kind": "power", "exponent": 2}},
        {"resolution.sieves": (0.001, 0.01), "rolls.gap": 0.1 + 0.2 - 0.24, "remark": "é"},
    ],
    ids=["infinite", "laws", "awkward floats"],
)
def test_json_and_back(values, tmp_path):
    scene = paper(values)
    text = scene.model_dump_json()
    assert Scene.model_validate_json(text) == scene
    json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))
    (tmp_path / "scene.json").write_text(text, encoding="utf-8")
    assert Scene.from_file(tmp_path / "scene.json") == scene


@given(st.floats(1e-3, 0.5), st.floats(1e-3, 1e6), st.floats(0.01, 100) | st.just(INF))
def test_json_keeps_every_bit(gap, gamma, n):
    scene = paper({"rolls.gap": gap, "fragments.exponent": gamma, "strength.cushioning": n})
    assert Scene.model_validate_json(scene.model_dump_json()) == scene


TOML = """
[rolls]
diameter = "0.8 m"
width = "0.25 m"
gap = "19 mm"
entry_gap = 0.06
speed = "16 rpm"
[strength]
cushioning = inf
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
    scene = Scene.from_file(str(path))
    assert scene.rolls.gap == pytest.approx(0.019)
    assert scene.feed.table == ((0.001, 0.0), (0.01, 60.0), (0.02, 100.0))
    assert math.isinf(scene.strength.cushioning)
    assert Scene.model_validate_json(scene.model_dump_json()) == scene


def test_a_scene_file_may_begin_with_a_preset(tmp_path):
    text = 'base = "industrial"\n[rolls]\ngap = "50 mm"\n[feed]\nkind = "single"\nsize = "30 mm"\n[exchange]\n'
    scene = Scene.from_file(scene_file(tmp_path, text))
    feed = {"kind": "single", "size": 0.03}
    assert scene == presets.industrial().with_values({"rolls.gap": 0.05, "feed": feed, "exchange": {}})
    with pytest.raises(ValueError, match="base: got 'mine'; must be one of 'industrial'"):
        Scene.from_file(scene_file(tmp_path, 'base = "mine"'))


def test_toml_faults_come_at_once(tmp_path):
    text = TOML.replace('"19 mm"', '"190 mm"').replace("cells = 100", "cels = 100").replace("ore.csv", "none.csv")
    with pytest.raises(ValidationError) as error:
        Scene.from_file(scene_file(tmp_path, text))
    names = {".".join(map(str, fault["loc"])) for fault in error.value.errors()}
    assert names == {"rolls.gap", "resolution.cels", "feed.table"}
    assert re.search(r"none.csv'; the file cannot be read \(No such file", str(error.value))


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.json", b"{", r"a\.json: not JSON: .* line 1"),
        ("a.toml", b"[rolls\ngap =", r"a\.toml: not TOML"),
        ("a.toml", b"", "rolls"),
        ("a.toml", b"x = " + b"[" * 5000 + b"]" * 5000, r"a\.toml: nested too deep; a scene has sections of fields"),
        ("a.toml", b".".join([b"a"] * 20_000) + b" = 1", r"a\.toml: nested too deep"),
        ("a.toml", b"x = {" + b".".join([b"'a'"] * 1000) + b" = 1}", r"a\.toml: nested too deep"),
        ("a.toml", b"a.b.c.d.e.f.g.h.i.j = 1", r"a\.toml: nested too deep"),
        ("a.json", b'{"rolls":' * 5000 + b"1" + b"}" * 5000, r"a\.json: nested too deep"),
        ("a.json", b"9" * 5000, r"a\.json: not JSON"),
    ],
    ids=lambda value: value[:20] if isinstance(value, bytes) else "",
)
def test_files_that_are_no_scene_name_themselves(tmp_path, name, content, words):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=words):
        Scene.from_file(tmp_path / name)


def test_with_values_changes_only_these():
    scene = presets.khd_pilot()
    changed = scene.with_values({"rolls.gap": "25 mm", "resolution.cells": 7})
    assert (changed.rolls.gap, changed.resolution.cells) == (0.025, 7)
    back = changed.with_values({"rolls.gap": scene.rolls.gap, "resolution.cells": scene.resolution.cells})
    assert back == scene == presets.khd_pilot()


def test_another_kind_of_law_drops_what_it_has_not():
    scene = paper({"flow.kind": "nip", "flow.nip_angle": "9 deg", "flow.entry_fraction": 0.03})
    assert scene.flow.kind == "nip"
    back = scene.with_values({"flow.kind": "power"})
    assert (back.flow.exponent, back.flow.entry_fraction) == (1, 0.03)
    assert paper({"feed.kind": "power_law", "feed.exponent": 0.7}).feed.top_size == 0.06


def test_with_values_lists_every_fault():
    with pytest.raises(ValidationError) as error:
        paper().with_values({"rolls.gpa": 3, "rolls.gap": "2 m", "bogus": 1, "x.y": 2})
    names = {".".join(map(str, fault["loc"])) for fault in error.value.errors()}
    assert names == {"rolls.gpa", "rolls.gap", "bogus", "x"}


def test_every_field_is_described_and_every_number_carries_symbol_unit_source_and_example():
    schema = Scene.model_json_schema()
    for part in (schema, *schema["$defs"].values()):
        assert all("description" in field for key, field in part["properties"].items() if key != "kind")
    for name, field in FIELDS.items():
        if field.json_schema_extra:
            assert field.json_schema_extra["source"]
            assert field.json_schema_extra["example"] is not None
            info = field_info(name)
            assert info.unit
            assert info.symbol
            assert not re.search("[;:]", info.text)


def test_examples_of_fields_are_accepted():
    for name in FLOATS:
        field_value(name, FIELDS[name].json_schema_extra["example"])


def test_a_field_judges_a_value_alone():
    assert field_value("rolls.gap", "40 mm") == 0.04
    assert field_value("resolution.cells", np.int64(3)) == 3
    assert field_value("flow.nip_angle", "9 deg") == pytest.approx(math.radians(9))
    for name, value, words in (
        ("rolls.gap", -1, "rolls.gap: got -1000 mm; must be at least 0.001 mm; give a value such as '20 mm'"),
        ("rolls.gap", INF, "must be finite"),
        ("rolls.gap", "3 s", "not a quantity in mm"),
        ("rolls.gpa", 1, "did you mean 'rolls.gap'"),
        ("qqqqqq", 1, "did you mean"),
    ):
        with pytest.raises(ValueError, match=words):
            field_value(name, value)


def test_speed_of_the_roll_surface_is_taken_with_its_unit():
    scene = presets.industrial().with_values({"rolls.diameter": "2 m", "rolls.speed": "1.5 m/s"})
    assert scene.rolls.speed == 1.5
    with pytest.raises(ValidationError, match=r"rolls.speed\n.*got '1.5 m/s'"):
        presets.industrial().with_values({"rolls.diameter": "x", "rolls.speed": "1.5 m/s"})
