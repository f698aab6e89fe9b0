import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError
from scipy.integrate import quad
from support import paper, sized

from hpgr import flow, geometry, machine, stress

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


# --- profile "nip" of real machines -------------------------------------------------------------------------

PILOT = {"flow.profile": "nip", "rolls.diameter": 0.8, "rolls.gap": 0.0237, "rolls.entry_gap": 0.06}
NIPS = {
    "pilot": PILOT | {"flow.nip_angle": "9.1 deg"},
    "from the cake": PILOT | {"flow.cake_solid_fraction": 0.85},
    "steep": PILOT | {"flow.nip_angle": "20 deg", "rolls.entry_gap": 0.2, "rolls.gap": 0.05},
    "nip at the top": PILOT | {"flow.nip_angle": "12.0 deg", "rolls.gap": 0.06 - 0.8 * (1 - np.cos(np.radians(12.0)))},
}
each_nip = pytest.mark.parametrize("values", NIPS.values(), ids=NIPS)


def nipped(values, streamlines=3, points=41):
    return move(values | {"feed.top_size": 0.03}, streamlines, points)


def nip_of(scene):
    return scene.rolls.diameter / 2 * np.sin(flow.nip_angle(scene))


def nip_velocity(scene, x, y, below):
    """The velocity field of the model page, section Real machines, below or above the nip, in x and y alone."""
    _, outer, slope = half_width(scene)
    speed, nip = scene.rolls.speed * scene.rolls.diameter / 2, nip_of(scene)
    tangent = x / outer(y) * slope(y)
    if below:
        down = -speed / np.sqrt(1 + tangent**2)
    else:
        down = -speed / np.sqrt(1 + (x / outer(y) * slope(nip)) ** 2) * outer(nip) / outer(y)
    return tangent * down, down


def test_nip_angle_of_the_published_worked_case():
    """Torres & Casali 2009: D 1 m, gap 0.03 m, cake 2.3 and feed 1.6 t/m3; 9.504 degrees with unrounded arithmetic."""
    cake = {"flow.profile": "nip", "flow.cake_solid_fraction": 2.3 / 2.7, "material.feed_solid_fraction": 1.6 / 2.7}
    scene = paper({"rolls.diameter": 1.0, "rolls.gap": 0.03, "rolls.entry_gap": 0.1} | cake)
    assert np.degrees(flow.nip_angle(scene)) == pytest.approx(9.504, abs=5e-4)


def test_nip_angle_keeps_mass_from_nip_to_gap():
    scene = paper(NIPS["from the cake"])
    angle, rolls = flow.nip_angle(scene), scene.rolls
    at_nip = scene.material.feed_solid_fraction * (rolls.gap + rolls.diameter * (1 - np.cos(angle))) * np.cos(angle)
    assert at_nip == pytest.approx(0.85 * rolls.gap, rel=1e-12)
    assert flow.nip_angle(paper(NIPS["pilot"])) == np.radians(9.1)


@each_nip
def test_nip_strain_rates_are_those_of_the_velocity_field(values):
    """Gradient by complex steps, which have no rounding of differences, in both zones."""
    scene, bed, _ = nipped(values)
    nip, height, h = flow.nip_height(scene, bed), bed.height, 1e-30
    for below, y in ((True, np.linspace(0, nip, 9)), (False, nip * np.linspace(1.001, 1.1, 9))):
        y = np.tile(y, (3, 1))
        x = bed.xi[:, None] * half_width(scene)[1](y)
        found = flow.velocity_gradient(scene, bed, y, 1 - y / height)
        unit = scene.rolls.speed * scene.rolls.diameter / 2 / height
        (xx, yx), (xy, yy) = (
            [part.imag / h for part in nip_velocity(scene, x + dx, y + dy, below)]
            for dx, dy in ((1j * h, 0), (0, 1j * h))
        )
        scale = max(np.abs(xx).max(), np.abs(yy).max())
        for name, exact in (("v_xx", xx), ("v_xy", xy), ("v_yx", yx), ("v_yy", yy)):
            assert unit * getattr(found, name) == pytest.approx(exact, abs=1e-9 * scale), (name, below)
        if not below:
            assert xx + yy == pytest.approx(0, abs=1e-12 * scale)  # the feed keeps its density


@each_nip
def test_nip_bed_runs_at_the_speed_of_the_rolls_below_and_keeps_its_flux_above(values):
    scene, bed, motion = nipped(values, points=201)
    _, outer, slope = half_width(scene)
    surface_speed, nip = scene.rolls.speed * scene.rolls.diameter / 2, nip_of(scene)
    below = motion.y <= nip
    assert below.any(axis=1).all()
    assert np.all(motion.speed[below] == surface_speed)
    # X |v_y| of every tube is that at the nip
    xi = bed.xi[:, None]
    flux = outer(motion.y) * motion.speed / np.sqrt(1 + (xi * slope(motion.y)) ** 2)
    at_nip = outer(nip) * surface_speed / np.sqrt(1 + (xi * slope(nip)) ** 2)
    assert flux[~below] == pytest.approx(np.broadcast_to(at_nip, flux.shape)[~below], rel=1e-12)
    assert np.all(motion.volumetric_rate[~below] == 0)
    assert np.all(motion.volumetric_rate[below & (motion.y > 0)] > 0)


@each_nip
def test_nip_points_are_one_time_step_apart(values):
    scene, bed, motion = nipped(values, points=sized(21, 9))
    _, outer, slope = half_width(scene)
    nip = nip_of(scene)
    for line in range(3):

        def slowness(y, xi=bed.xi[line]):
            vx, vy = nip_velocity(scene, xi * outer(y), y, y <= nip)
            return np.hypot(vx, vy) ** -1 * np.sqrt(1 + (xi * slope(y)) ** 2)

        for upper, lower in zip(motion.y[line, :-1], motion.y[line, 1:], strict=True):
            kink = [nip] if lower < nip < upper else None
            assert quad(slowness, lower, upper, epsrel=1e-11, points=kink)[0] == pytest.approx(
                motion.time_step, rel=1e-7
            )


def strain_error(values, points):
    """Largest error of the volumetric strain against ln of the tube's density ratio."""
    scene, bed, motion = nipped(values, points=points)
    _, outer, slope = half_width(scene)
    xi, nip = bed.xi[:, None], nip_of(scene)

    def flux(y):
        return outer(y) / np.sqrt(1 + (xi * slope(y)) ** 2)

    exact = np.log(flux(nip) / flux(np.minimum(motion.y, nip)))
    volumetric, _ = stress.strain_increments(motion)
    return np.abs(flow.running_sum(volumetric) - exact).max(), exact.max()


@each_nip
def test_volumetric_strain_is_the_logarithm_of_the_density_ratio(values):
    points = (101, 201, 401, 801)
    errors = [strain_error(values, count)[0] for count in points]
    assert strain_error(values, 801)[1] > 0.3  # a real compaction
    assert errors[-1] < 1e-5
    order = np.polyfit(np.log(points), np.log(errors), 1)[0]
    assert order == pytest.approx(-2, abs=0.25)  # trapezoid rule


def test_force_does_not_jump_as_the_nip_crosses_a_point():
    """The number of points below the nip changes by one between two gaps 1e-13 apart; force and strain do not."""

    def below(gap):
        scene, _, motion = nipped(NIPS["pilot"] | {"rolls.gap": gap, "resolution.points": 41}, 1)
        return np.count_nonzero(motion.y <= nip_of(scene)), scene, motion

    gaps = np.linspace(0.020, 0.030, 60)
    counts = [below(gap)[0] for gap in gaps]
    crossings = np.flatnonzero(np.diff(counts))
    assert crossings.size >= 2
    for k in crossings[:3]:
        low, high = gaps[k], gaps[k + 1]
        while high - low > 1e-13:
            middle = (low + high) / 2
            low, high = (middle, high) if below(middle)[0] == counts[k] else (low, middle)
        (first, scene, one), (second, other, two) = below(low), below(high)
        assert first != second
        strains = [stress.strain_increments(motion)[0].sum() for motion in (one, two)]
        assert strains[1] == pytest.approx(strains[0], rel=1e-7)
        assert machine.pressing_force(other) == pytest.approx(machine.pressing_force(scene), rel=1e-6)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        (PILOT, r"flow.nip_angle.*\n.*got nothing; must be one of nip_angle"),
        (PILOT | {"flow.nip_angle": 0.1, "flow.cake_solid_fraction": 0.8}, "got nip_angle and cake_solid_fraction"),
        ({"flow.nip_angle": 0.1}, "must not be given with profile 'power', which has no nip; leave it out"),
        (PILOT | {"flow.cake_solid_fraction": 0.95}, "must lie within feed_solid_fraction 0.6 to max_solid_fraction"),
        (PILOT | {"flow.cake_solid_fraction": 0.5}, "must lie within feed_solid_fraction 0.6 to"),
        (
            PILOT | {"flow.cake_solid_fraction": 0.9, "rolls.gap": 0.3, "rolls.entry_gap": 0.5},
            "must be at most 0.756, beyond which no nip angle feeds the cake; give a lighter cake or a narrower",
        ),
        (PILOT | {"flow.nip_angle": "20 deg"}, "rolls.entry_gap\n.*at least 71.9.* mm, the roll distance at the nip"),
        (PILOT | {"flow.nip_angle": "61 deg"}, "must be less than 60 deg"),
    ],
)  # fmt: skip
def test_impossible_nips_are_refused(values, words):
    with pytest.raises(ValidationError, match=words):
        nipped(values)
