import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support import paper

from hpgr import Rolls
from hpgr.bed.geometry import between_rolls, centres


def rolls(diameter=6.0, gap=0.06, entry_gap=1.14):
    return Rolls(diameter=diameter, width=1.0, gap=gap, entry_gap=entry_gap, speed=2.0)


def bed_of(machine):
    return between_rolls(machine.diameter, machine.gap, machine.entry_gap, centres(2))


def roll_surface(machine, y):
    """Half gap at height y, written from the circle's equation."""
    radius = machine.diameter / 2
    return machine.gap / 2 + radius - np.sqrt(radius**2 - y**2)


any_rolls = st.builds(
    lambda diameter, gap, angle: rolls(diameter, gap, gap + diameter * (1 - math.cos(math.radians(angle)))),
    st.floats(0.1, 10.0),
    st.floats(1e-4, 0.5),
    st.floats(0.1, 59.9),
)


def test_paper_machine_has_the_published_bed():
    bed = bed_of(paper().rolls)
    assert bed.height == pytest.approx(1.71709, abs=5e-6)
    assert math.degrees(math.asin(bed.height / bed.radius)) == pytest.approx(34.915, abs=5e-4)
    assert bed.half_gap == 0.03


@given(any_rolls)
def test_outermost_streamline_meets_the_roll_in_value_and_slope(machine):
    bed = bed_of(machine)
    top, radius = bed.height, machine.diameter / 2
    assert bed.outer(0.0) == machine.gap / 2
    assert bed.slope(0.0) == 0.0
    assert roll_surface(machine, top) == pytest.approx(machine.entry_gap / 2, rel=1e-9)
    assert bed.outer(top) == pytest.approx(machine.entry_gap / 2, rel=1e-9)
    assert bed.slope(top) == pytest.approx(top / math.sqrt(radius**2 - top**2), rel=1e-7)
    y, h = np.linspace(0.01, 0.99, 99) * top, 1e-30
    assert np.all(bed.slope(y) > 0)  # it widens all the way up
    assert bed.outer(y + 1j * h).imag / h == pytest.approx(bed.slope(y), rel=1e-12)


def test_outermost_streamline_leaves_the_papers_roll_by_a_few_mm_into_the_gap():
    bed = bed_of(rolls())
    y = np.linspace(0, bed.height, 1001)
    outside = roll_surface(rolls(), y) - bed.outer(y)
    assert outside.min() > -1e-12  # never into the roll
    assert outside.max() == pytest.approx(5.33e-3, abs=5e-6)
    assert bed.deviation() == pytest.approx(outside.max(), rel=1e-3)


def test_streamlines_are_centres_of_equal_tubes():
    assert centres(1) == pytest.approx([0.5])
    assert centres(4) == pytest.approx([0.125, 0.375, 0.625, 0.875], rel=1e-15)


def test_gap_equal_to_entry_gap_has_no_bed():
    bed = bed_of(rolls(gap=0.06, entry_gap=0.06))
    assert bed.height == bed.b == bed.c == bed.deviation() == 0
    assert bed.outer(0.0) == 0.03


def test_a_hair_of_compaction_keeps_its_digits():
    """R^2 - (R - rise)^2 would cancel: the bed's height here is sqrt(2 R rise) to 1e-9."""
    rise = 2.0**-40
    machine = rolls(diameter=4.0, gap=0.0625, entry_gap=0.0625 + 2 * rise)
    bed = bed_of(machine)
    assert bed.height == pytest.approx(math.sqrt(4 * rise), rel=1e-9)
    assert bed.b == pytest.approx(1 / 4, rel=1e-6)  # the parabola under a circle: y^2 / 2R
