import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad
from support import paper, sized

from hpgr import flow, geometry

SCENES = {
    "paper": {},
    "steep": {"rolls.entry_gap": 3.0},
    "flat": {"rolls.entry_gap": 0.0601},
    "slow start": {"flow.exponent": 2.0, "flow.entry_fraction": 0.05},
    "plug": {"flow.exponent": 0.3},
    "from the exit": {"flow.entry_fraction": 0.99},
}
each = pytest.mark.parametrize("values", SCENES.values(), ids=SCENES)


def move(values, streamlines=3, points=21):
    scene = paper(values)
    bed = geometry.bed(scene.rolls, streamlines)
    return scene, bed, flow.move(scene, bed, points)


def half_width(scene):
    """Return X and X' of the outermost streamline, from four conditions on a cubic."""
    rolls = scene.rolls
    radius = rolls.diameter / 2
    height = np.sqrt(radius**2 - (radius - (rolls.entry_gap - rolls.gap) / 2) ** 2)
    rows = [[1, 0, 0, 0], [0, 1, 0, 0], [1, height, height**2, height**3], [0, 1, 2 * height, 3 * height**2]]
    cubic = np.linalg.solve(rows, [rolls.gap / 2, 0, rolls.entry_gap / 2, height / np.sqrt(radius**2 - height**2)])
    polynomial = np.polynomial.Polynomial(cubic)
    return height, polynomial, polynomial.deriv()


def velocity(scene, x, y):
    """The velocity field of the model page, section 2, in x and y alone."""
    height, outer, slope = half_width(scene)
    speed = scene.rolls.speed * scene.rolls.diameter / 2 * (1 - y / height) ** scene.flow.exponent
    tangent = x / outer(y) * slope(y)
    down = -speed / np.sqrt(1 + tangent**2)
    return tangent * down, down


@each
def test_strain_rates_are_those_of_the_velocity_field(values):
    scene, bed, motion = move(values)
    x, y = motion.x[:, :-1], motion.y[:, :-1]  # the field is not defined below the exit
    h = 1e-5 * np.minimum(bed.height - y, np.minimum(y, bed.half_gap))
    x_plus, x_minus = velocity(scene, x + h, y), velocity(scene, x - h, y)
    y_plus, y_minus = velocity(scene, x, y + h), velocity(scene, x, y - h)
    xx, yx = ((p - m) / (2 * h) for p, m in zip(x_plus, x_minus, strict=True))
    xy, yy = ((p - m) / (2 * h) for p, m in zip(y_plus, y_minus, strict=True))
    gradient = np.zeros((*x.shape, 3, 3))
    gradient[..., 0, 0], gradient[..., 0, 1], gradient[..., 1, 0], gradient[..., 1, 1] = xx, xy, yx, yy
    strain = (gradient + np.swapaxes(gradient, -1, -2)) / 2
    volumetric = -np.trace(strain, axis1=-2, axis2=-1)
    deviator = strain + volumetric[..., None, None] / 3 * np.eye(3)
    shear = np.sqrt(2 / 3 * np.sum(deviator**2, axis=(-2, -1)))
    scale = np.abs(shear).max()
    assert motion.volumetric_rate[:, :-1] == pytest.approx(volumetric, abs=1e-6 * scale)
    assert motion.shear_rate[:, :-1] == pytest.approx(shear, abs=1e-6 * scale)


@each
def test_points_are_one_time_step_apart(values):
    """Time between neighbours by quadrature of arc length over speed, in height."""
    scene, bed, motion = move(values, points=sized(21, 9))
    height, _, slope = half_width(scene)
    surface_speed = scene.rolls.speed * scene.rolls.diameter / 2

    for line in range(3):

        def slowness(y, xi=bed.xi[line]):
            return np.sqrt(1 + (xi * slope(y)) ** 2) / (surface_speed * (1 - y / height) ** scene.flow.exponent)

        for upper, lower in zip(motion.y[line, :-1], motion.y[line, 1:], strict=True):
            assert quad(slowness, lower, upper, epsrel=1e-11)[0] == pytest.approx(motion.time_step, rel=1e-7)


@each
def test_points_end_at_the_exit_and_lie_on_their_streamlines(values):
    scene, bed, motion = move(values)
    height, outer, _ = half_width(scene)
    assert np.all(motion.y[:, -1] == 0)
    assert motion.x == pytest.approx(bed.xi[:, None] * outer(motion.y), rel=1e-6)
    assert np.all(np.diff(motion.y) < 0)
    depth = 1 - motion.y / height
    surface_speed = scene.rolls.speed * scene.rolls.diameter / 2
    assert motion.speed == pytest.approx(surface_speed * depth**scene.flow.exponent, rel=1e-5)
    assert np.all(motion.speed[:, -1] == surface_speed)


def test_paper_machine_runs_at_the_published_speed():
    _, _, motion = move({})
    assert motion.speed[0, -1] == pytest.approx(5.9690, abs=5e-5)


def test_centre_streamline_starts_at_the_entry_fraction():
    scene, bed, _ = move({})
    centre = flow.move(scene, bed._replace(xi=np.array([0.0, 0.5])), 21)
    assert 1 - centre.y[0, 0] / bed.height == pytest.approx(0.02, rel=1e-12)
    assert centre.y[1, 0] < centre.y[0, 0]  # a longer way in the same time
    # v = U (1 - y/H) on a straight line: T = H/U ln(1 / 0.02)
    assert centre.residence_time[-1] == pytest.approx(bed.height / centre.speed[0, -1] * np.log(50), rel=1e-12)
    assert centre.residence_time[0] == 0
    assert np.diff(centre.residence_time) == pytest.approx(centre.time_step, rel=1e-10)


def test_bed_dilates_first_and_compacts_low_down():
    """On the centre line eps_v rate = U/H [(X'/X) (H - y) - 1], by hand: it changes sign twice."""
    scene, bed, motion = move({}, streamlines=10, points=401)
    compacting = motion.volumetric_rate > 0
    assert not compacting[:, 0].any()
    height, outer, slope = half_width(scene)
    centre = flow.move(scene, bed._replace(xi=np.array([1e-9])), 401)
    by_hand = slope(centre.y) / outer(centre.y) * (height - centre.y) - 1 > 0
    assert np.array_equal(centre.volumetric_rate > 0, by_hand)
    assert np.count_nonzero(np.diff(by_hand[0].astype(int))) == 2
    assert np.all(motion.shear_rate > 0)
    # at the exit X' = 0, so only the vertical stretch at rate U/H is left
    assert motion.volumetric_rate[:, -1] == pytest.approx(-motion.speed[:, -1] / 1.71709, rel=1e-5)


@given(st.floats(0.01, 5.0), st.floats(1e-6, 0.999), st.floats(0.0601, 3.05))
def test_any_machine_gives_finite_falling_points(exponent, entry_fraction, entry_gap):
    values = {"flow.exponent": exponent, "flow.entry_fraction": entry_fraction, "rolls.entry_gap": entry_gap}
    try:
        _, bed, motion = move(values, points=11)
    except ValueError as error:
        assert "flow.entry_fraction" in str(error)  # noqa: PT017 - the only refusal there is
        return
    assert motion.onset is None  # compaction begins gradually in this profile
    assert all(np.all(np.isfinite(part)) for part in motion if part is not None)
    assert np.all(np.diff(motion.y) < 0)
    assert np.all(motion.y <= bed.height)


@pytest.mark.parametrize("points", [2, 3])
def test_two_points_are_enough(points):
    _, _, motion = move({}, points=points)
    assert motion.y.shape == (3, points)


def test_coinciding_points_are_refused_with_value_bound_and_remedy():
    scene = paper({"flow.entry_fraction": 1e-9})
    bed = geometry.bed(scene.rolls, 3)
    with pytest.raises(ValueError, match=r"flow.entry_fraction: got 1e-09 with .* at least 1e-09; raise") as error:
        flow.move(scene, bed, 2001)
    assert "fewer points" in str(error.value)
    late = paper({"flow.entry_fraction": 1 - 1e-9})
    with pytest.raises(ValueError, match=r"flow\.entry_fraction"):
        flow.move(late, bed, 2001)


def test_no_bed_means_every_point_is_the_exit():
    scene, bed, motion = move({"rolls.gap": 0.06, "rolls.entry_gap": 0.06}, points=5)
    assert motion.time_step == 0
    assert np.all(motion.x == bed.xi[:, None] * 0.03)
    for part in (motion.y, motion.volumetric_rate, motion.shear_rate, motion.residence_time):
        assert not part.any()
    assert np.all(motion.speed == scene.rolls.speed * 3)


def test_doubling_the_roll_speed_halves_times_and_nothing_else():
    scene, bed, slow = move({})
    fast = flow.move(scene.with_values({"rolls.speed": 2 * scene.rolls.speed}), bed, 21)
    assert np.array_equal(fast.x, slow.x)
    assert np.array_equal(fast.y, slow.y)
    assert np.array_equal(fast.volumetric_rate, 2 * slow.volumetric_rate)
    assert np.array_equal(fast.shear_rate, 2 * slow.shear_rate)
    assert np.array_equal(fast.residence_time, slow.residence_time / 2)
    assert fast.time_step == slow.time_step / 2
