import contextlib
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hpgr import units


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
    ],
)
def test_text_with_a_unit_becomes_si(text, unit, value):
    assert units.parse(text, unit) == pytest.approx(value, rel=1e-14)


@pytest.mark.parametrize("text", ["60", "0.06", "1e-3"])
def test_text_without_a_unit_is_refused_with_the_remedy(text):
    with pytest.raises(ValueError, match=r"without a unit; write it as .* mm'") as error:
        units.parse(text, "m")
    assert text in str(error.value)


@pytest.mark.parametrize("text", ["3 s", "5 MPa", "1 m^2", "1 m/s", "20 degC"])
def test_wrong_dimension_is_refused(text):
    with pytest.raises(ValueError, match="not a quantity in mm"):
        units.parse(text, "m")


@pytest.mark.parametrize("text", ["", "  ", "abc def", "60 mmm", "'", "--", "60/0 mm", "lambda: 1", "a.b"])
def test_nonsense_is_a_value_error(text):
    with pytest.raises(ValueError, match=r"."):
        units.parse(text, "m")


@pytest.mark.parametrize("text", ["(60 mm", "60 mm)", "60 mm]"])
def test_unbalanced_text_is_a_value_error(text):
    with pytest.raises(ValueError, match=r"."):
        units.parse(text, "m")


@pytest.mark.parametrize("text", ["60 mm # gap", "60; mm", "[60] mm", "60 @ mm", "60 mm!", "mm", "60 mm + 1 m", "60 %"])
def test_text_is_one_number_and_one_unit(text):
    with pytest.raises(ValueError, match=r"."):
        units.parse(text, "m")


@given(st.text(alphabet="0123456789.e+- mMPax/()[]{}'\"#\\\n;:,µ²", max_size=12))
def test_any_text_gives_a_number_or_a_value_error(text):
    if "**" in text:
        return
    with contextlib.suppress(ValueError):
        assert isinstance(units.parse(text, "m"), float)


@given(st.floats(1e-9, 1e9))
def test_shown_values_are_read_back(value):
    for unit in ("m", "Pa", "rad s-1", "kg m-3"):
        shown = units.show(value, unit)
        if unit != "kg m-3":  # its CF spelling is not pint's
            assert units.parse(shown, unit) == pytest.approx(value, rel=1e-5)


@pytest.mark.parametrize("text", ["1 Hz", "1 1/s", "0.67 m/s"])
def test_roll_speed_is_a_rate_of_turning(text):
    # 1 Hz would be read as 1 rad/s, a sixth of the turn per second that its writer means
    with pytest.raises(ValueError, match="19 rpm"):
        units.parse(text, "rad s-1")


def test_values_are_shown_in_the_unit_people_use():
    assert units.show(0.06, "m") == "60 mm"
    assert units.show(0.84e6, "Pa") == "0.84 MPa"
    assert units.show(2 * math.pi, "rad s-1") == "60 rpm"
    assert units.show(10.0, "kg s-1") == "36 t/h"
    assert units.show(0.5, "1") == "0.5"
    assert units.show(2650.0, "kg m-3") == "2650 kg m-3"
    assert units.show(float("inf"), "m") == "inf mm"
