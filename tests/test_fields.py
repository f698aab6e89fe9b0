import contextlib
import math
from fractions import Fraction

import pint
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hpgr.fields import UNITS, check_number, parse, show


@pytest.mark.parametrize(
    ("text", "unit", "value"),
    [
        ("60 mm", "m", 0.06),
        ("1 um", "m", 1e-6),
        ("2.5in", "m", 0.0635),
        ("0.84 MPa", "Pa", 0.84e6),
        ("19 rpm", "rad s-1", 19 * 2 * math.pi / 60),
        ("2 rad/s", "rad s-1", 2.0),
        ("2.65 g/cm^3", "kg m-3", 2650.0),
        ("2.65 t/m3", "kg m-3", 2650.0),
        ("3.5 N/mm2", "Pa", 3.5e6),
        ("3.5 N/mm²", "Pa", 3.5e6),
        ("19 1/min", "rad s-1", 19 * 2 * math.pi / 60),
        ("1.5 kWh/t", "J kg-1", 5400.0),
    ],
)
def test_text_with_a_unit_becomes_si(text, unit, value):
    assert parse(text, unit) == pytest.approx(value, rel=1e-14)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("60", "text without a unit; write it as '60 mm'"),
        ("3 s", "not a quantity in mm: its unit 's' measures something else"),
        ("20 degC", "not a quantity in mm"),
        ("60 mmm", "its unit 'mmm' is not known"),
        ("60/0 mm", "not a number and a unit; write it like '60 mm'"),
        ("60 mm)", "not a number and a unit"),
        ("60 mm + 1 m", "not a number and a unit"),
        ("mm", "not a number and a unit"),
    ],
)
def test_text_is_one_number_and_one_unit(text, words):
    with pytest.raises(ValueError) as error:  # noqa: PT011
        parse(text, "m")
    assert words in str(error.value)


@given(st.text(alphabet="0123456789.e+- mMPax/()[]{}'\"#\\\n;:,µ²", max_size=12))
def test_any_text_gives_a_number_or_a_value_error(text):
    if "**" in text:
        return
    with contextlib.suppress(ValueError):
        assert isinstance(parse(text, "m"), float)


@pytest.mark.parametrize(
    ("named", "unit", "per_si"),
    [
        ("mm", "m", 1000),
        ("cm", "m", 100),
        ("um", "m", 10**6),
        ("MPa", "Pa", Fraction(1, 10**6)),
        ("N/mm^2", "Pa", Fraction(1, 10**6)),
        ("kN*m", "N m", Fraction(1, 1000)),
        ("g/cm^3", "kg m-3", Fraction(1, 1000)),
    ],
)
def test_text_gives_the_float_of_the_number_written_out(named, unit, per_si):
    """Thousands of whole numbers and tenths, in every unit: text and numbers select the same place of a sweep."""
    for tenths in [*range(1, 5000), *range(10**6, 10**6 + 50)]:
        assert parse(f"{tenths / 10:.10g} {named}", unit) == float(Fraction(tenths, 10) / per_si)


@given(st.floats(1e-9, 1e9))
def test_shown_values_are_read_back(value):
    for unit in ("m", "Pa", "rad s-1", "rad"):
        assert parse(show(value, unit), unit) == pytest.approx(value, rel=1e-5)


@pytest.mark.parametrize("text", ["1 Hz", "1 1/s", "0.67 m/s"])
def test_roll_speed_is_a_rate_of_turning(text):
    # 1 Hz would be read as 1 rad/s, a sixth of the turn per second that its writer means
    with pytest.raises(ValueError, match="19 rpm"):
        parse(text, "rad s-1")


def test_values_are_shown_in_the_unit_people_use():
    assert show(0.06, "m") == "60 mm"
    assert show(2 * math.pi, "rad s-1") == "60 rpm"
    assert show(10.0, "kg s-1") == "36 t/h"
    assert show(0.5, "1") == "0.5"
    assert show(2650.0, "kg m-3") == "2650 kg m-3"
    assert show(math.inf, "m") == "inf mm"


@pytest.mark.parametrize("unit", UNITS)
def test_usual_units_are_those_of_pint(unit):
    """They are read without its registry, which takes long to build."""
    known, registry = UNITS[unit], pint.UnitRegistry()
    for named in {known.shown, known.pint} - {"kg m-3", "kN m"}:  # which are not read
        for number in (1.0, 0.7, 14.96, 19.0, 1140.0):
            wanted = registry.Quantity(number, named).to(known.pint).magnitude
            assert parse(f"{number} {named}", unit) == float(f"{wanted:.15g}")


def test_examples_of_units_are_read():
    assert all(parse(entry.example, unit) > 0 for unit, entry in UNITS.items())


def test_good_seeds_pass():
    for value in (0, 2**63 - 1):
        check_number("seed", value)
