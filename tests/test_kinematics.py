"""Motion of the bed: the kernels against the velocity fields that the laws of flow write out in NumPy."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad
from support import paper, sized

from hpgr.bed import kinematics, machine
from hpgr.bed.loaded import inputs_of
from hpgr.laws.flow import NipFlow, cake_nip_angle, densest_ratio

PILOT = {"rolls.diameter": 0.8, "rolls.gap": 0.0237, "rolls.entry_gap": 0.06, "feed.top_size": 0.03}
STEEP = PILOT | {"rolls.entry_gap": 0.2, "rolls.gap": 0.05}
TOP = PILOT | {"rolls.gap": 0.06 - 0.8 * (1 - np.cos(np.radians(12))) - 1e-15}
POWERS = {
    "paper": {},
    "steep": {"rolls.entry_gap": 3.0},
    "slow start": {"flow.exponent": 2.0, "flow.entry_fraction": 0.05},
    "plug": {"flow.exponent": 0.3},
    "flat": {"rolls.entry_gap": 0.0601, "flow.entry_fraction": 0.99},
}
NIPS = {
    "pilot": PILOT | {"flow": NipFlow(nip_angle="9.1 deg")},
    "from the cake": PILOT | {"flow": NipFlow(cake_solid_fraction=0.85)},
    "steep nip": STEEP | {"flow": NipFlow(nip_angle="20 deg")},
    "slip": PILOT | {"flow": NipFlow(nip_angle="14 deg", slip=0.33)},
    "nip at the top": TOP | {"flow": NipFlow(nip_angle="12 deg")},
}
each = pytest.mark.parametrize("values", (POWERS | NIPS).values(), ids=POWERS | NIPS)
each_nip = pytest.mark.parametrize("values", NIPS.values(), ids=NIPS)


def moved(scene, points=21, xi=(0.1, 0.5, 0.9)):
    """Return geometry, motion and strains of steps on the streamlines `xi` of a scene's bed."""
    inputs = inputs_of(scene)
    bed = inputs.between_rolls(np.array(xi))
    return bed, *kinematics.move(bed, inputs.laws()[0], inputs.surface_speed, points)


def nip_of(scene, bed):
    """Return the height of the nip, of the bed where there is none."""
    if scene.flow.kind == "power":
        return bed.height
    return bed.radius * np.sin(scene.flow.angle(2 * bed.half_gap, 2 * bed.radius, scene.bed.feed_solid_fraction))


def velocity(scene, bed, x, y):
    """Return v_x and v_y of the law's field, in x and y alone, m/s."""
    tangent, nip = x / bed.outer(y) * bed.slope(y), nip_of(scene, bed)
    if scene.flow.kind == "power":
        fall = scene.flow.vertical_speed(1 - y / bed.height, tangent)
    else:
        at_nip = x / bed.outer(y) * bed.slope(nip), bed.outer(nip)
        fall = scene.flow.vertical_speed(y / nip, tangent, bed.outer(y), *at_nip)
    fall = scene.rolls.surface_speed * fall
    return -tangent * fall, -fall


# --- the laws ----------------------------------------------------------------------------------------------


def test_power_speed_is_the_power_of_depth():
    law, slope = paper({"flow.exponent": 2.0}).flow, np.array([0.0, 0.75])
    assert law.vertical_speed(0.5, slope) * np.sqrt(1 + slope**2) == pytest.approx(0.25, rel=1e-15)


def test_nip_bed_moves_with_the_rolls_below_and_keeps_its_flux_above():
    height, slope, width = np.array([0.5, 1.5]), np.array([0.75, 0.0]), np.array([0.1, 0.3])
    for slip in (0.0, 0.4):
        found = NipFlow(nip_angle=0.2, slip=slip).vertical_speed(height, slope, width, 0.75, 0.2)
        assert found == pytest.approx([(1 - slip / 4) * 0.8, (1 - slip) * 0.8 * 2 / 3], rel=1e-15)


def test_nip_angle_of_the_published_worked_case():
    """Torres & Casali 2009: D 1 m, gap 0.03 m, cake 2.3 and feed 1.6 t/m3; 9.504 degrees with unrounded arithmetic."""
    law = NipFlow(cake_solid_fraction=2.3 / 2.7)
    assert np.degrees(law.angle(0.03, 1.0, 1.6 / 2.7)) == pytest.approx(9.504, abs=5e-4)
    assert NipFlow(nip_angle=0.1).angle(0.03, 1.0, 1.6 / 2.7) == 0.1
    assert NipFlow(cake_solid_fraction=0.7, slip=0.3).angle(0.03, 1.0, 0.6) == cake_nip_angle(0.03, 1.0, 0.7 / 0.6, 0.3)


@given(st.floats(1e-3, 0.2), st.floats(0.0, 1.0), st.sampled_from([0.0, 0.3]))
def test_nip_angle_keeps_mass_from_nip_to_gap(gap, share, slip):
    densest = densest_ratio(gap, 1.0, slip)
    ratio = (1 - slip) + share * (densest - (1 - slip))
    angle = cake_nip_angle(gap, 1.0, ratio, slip)
    assert (1 - slip) * (gap + 1 - np.cos(angle)) * np.cos(angle) == pytest.approx(ratio * gap, rel=1e-7)


# --- both profiles -----------------------------------------------------------------------------------------


@each
def test_strain_rates_are_those_of_the_velocity_field(values):
    """The gradient by complex steps, which have no rounding of differences."""
    scene = paper(values)
    bed, motion, _ = moved(scene, 41)
    x, y, h = bed.x(motion.y), motion.y, 1e-30
    gradient = np.zeros((*x.shape, 3, 3))
    for axis, (dx, dy) in enumerate(((1j * h, 0), (0, 1j * h))):
        for component, part in enumerate(velocity(scene, bed, x + dx, y + dy)):
            gradient[..., component, axis] = part.imag / h
    strain = (gradient + np.swapaxes(gradient, -1, -2)) / 2
    volumetric = -np.trace(strain, axis1=-2, axis2=-1)
    deviator = strain + volumetric[..., None, None] / 3 * np.eye(3)
    shear = np.sqrt(2 / 3 * np.sum(deviator**2, axis=(-2, -1)))
    scale = np.abs(shear).max()
    assert motion.volumetric_rate == pytest.approx(volumetric, abs=1e-10 * scale)
    assert motion.shear_rate == pytest.approx(shear, abs=1e-10 * scale)
    tangent = bed.xi[:, None] * bed.slope(y)
    normal = np.stack([np.ones(y.shape), -tangent, np.zeros(y.shape)], axis=-1) / np.sqrt(1 + tangent**2)[..., None]
    across = -np.einsum("...i,...ij,...j", normal, deviator, normal)
    assert motion.across * motion.shear_rate == pytest.approx(across, abs=1e-10 * scale)
    above = motion.y > nip_of(scene, bed)
    assert not motion.volumetric_rate[above].any()  # exactly: the feed keeps its density


def assert_one_time_step_apart(scene, points):
    """Time between neighbours by quadrature of the fall's inverse over height."""
    bed, motion, _ = moved(scene, points)
    nip = nip_of(scene, bed)

    def slowness(y, xi):
        return -1 / velocity(scene, bed, xi * bed.outer(y), y)[1]

    for line, xi in enumerate(bed.xi):
        for upper, lower in zip(motion.y[line, :-1], motion.y[line, 1:], strict=True):
            kink = [nip] if lower < nip < upper else None
            time = quad(slowness, lower, upper, xi, epsrel=1e-11, points=kink)[0]
            assert time == pytest.approx(motion.time_step, rel=1e-7)


@each
def test_points_are_one_time_step_apart(values):
    assert_one_time_step_apart(paper(values), sized(21, 9))


def test_points_are_one_time_step_apart_where_a_quartic_does_not_carry():
    """The fall varies so much within a panel that Newton's method must take over."""
    flow = {"flow.exponent": 5.0, "flow.entry_fraction": 1e-3}
    assert_one_time_step_apart(paper(flow), sized(401, 101))


@each
def test_points_end_at_the_exit_and_run_along_their_streamlines(values):
    scene = paper(values)
    bed, motion, _ = moved(scene)
    assert np.all(motion.y[:, -1] == 0)
    assert np.all(np.diff(motion.y) < 0)
    assert motion.speed == pytest.approx(np.hypot(*velocity(scene, bed, bed.x(motion.y), motion.y)), rel=1e-8)
    assert np.all(motion.speed[:, -1] == scene.rolls.surface_speed)


# --- the paper's profile ------------------------------------------------------------------------------------


def test_centre_streamline_starts_at_the_entry_fraction():
    bed, motion, _ = moved(paper(), xi=(0.0, 0.5))
    assert 1 - motion.y[0, 0] / bed.height == pytest.approx(0.02, rel=1e-12)
    assert motion.y[1, 0] < motion.y[0, 0]  # a longer way in the same time
    # v = U (1 - y/H) on a straight line: T = H/U ln(1 / 0.02)
    duration = motion.time_step * (motion.y.shape[1] - 1)
    assert duration == pytest.approx(bed.height / motion.speed[0, -1] * np.log(50), rel=1e-12)


def test_bed_dilates_first_and_compacts_low_down():
    """On the mid-plane eps_v rate = U/H [(X'/X) (H - y) - 1], by hand: it changes sign twice."""
    bed, motion, _ = moved(paper(), 401, xi=(0.0, 0.95))
    by_hand = bed.slope(motion.y[0]) / bed.outer(motion.y[0]) * (bed.height - motion.y[0]) - 1 > 0
    assert np.array_equal(motion.volumetric_rate[0] > 0, by_hand)
    assert np.count_nonzero(np.diff(by_hand.astype(int))) == 2
    assert not by_hand[0]
    # at the exit X' = 0, so only the vertical stretch at rate U/H is left
    assert motion.volumetric_rate[:, -1] == pytest.approx(-motion.speed[:, -1] / bed.height, rel=1e-12)


def test_strain_of_the_papers_bed_converges_at_second_order_from_the_onset_in_its_step():
    def strains(points):
        _, _, steps = moved(paper(), points)
        return np.cumsum(steps.volumetric, axis=1).max(axis=1)

    exact = strains(6401)
    coarse, fine = (np.abs(strains(points) / exact - 1) for points in (101, 401))
    assert np.all(coarse < 4e-3)  # counted from the first point that compacts it would be a tenth
    assert np.all(fine < coarse / 10)


@pytest.mark.parametrize("entry_fraction", [1e-9, 1 - 1e-9])
def test_coinciding_points_are_refused_with_value_bound_and_remedy(entry_fraction):
    words = r"flow.entry_fraction: got 1.* with 2001 points .* at least 1e-09; raise .* or use fewer points"
    with pytest.raises(ValueError, match=words):
        moved(paper({"flow.entry_fraction": entry_fraction}), 2001)


def test_no_bed_means_every_point_is_the_exit():
    scene = paper({"rolls.gap": 0.06, "rolls.entry_gap": 0.06})
    bed, motion, strains = moved(scene, 5)
    assert motion.time_step == 0
    assert np.all(bed.x(motion.y) == bed.xi[:, None] * 0.03)
    for part in (motion.y, motion.volumetric_rate, motion.shear_rate, *strains):
        assert not part.any()
    assert np.all(motion.speed == scene.rolls.surface_speed)


# --- the profile of real machines ---------------------------------------------------------------------------


@each_nip
def test_nip_bed_compacts_from_the_nip_down_at_the_speed_of_the_rolls(values):
    scene = paper(values)
    bed, motion, _ = moved(scene, 201)
    below = motion.y <= nip_of(scene, bed)
    assert below.any(axis=1).all()
    lag = scene.flow.slip * (motion.y[below] / nip_of(scene, bed)) ** 2
    assert motion.speed[below] == pytest.approx(scene.rolls.surface_speed * (1 - lag), rel=1e-14)
    assert scene.flow.slip or np.all(motion.volumetric_rate[below & (motion.y > 0)] > 0)
    assert not motion.volumetric_rate[:, -1].any()  # exactly: at the exit nothing crushes


def strain_error(values, points):
    """Largest error of the volumetric strain against ln of the tube's density ratio, and the largest strain."""
    scene = paper(values)
    bed, motion, strains = moved(scene, points)
    xi, nip = bed.xi[:, None], nip_of(scene, bed)

    def flux(y):
        return bed.outer(y) / np.sqrt(1 + (xi * bed.slope(y)) ** 2)

    def speed(y):
        return 1 - scene.flow.slip * (y / nip) ** 2

    low = np.minimum(motion.y, nip)
    exact = np.log(flux(nip) * speed(nip) / (flux(low) * speed(low)))
    return np.abs(np.cumsum(strains.volumetric, axis=1) - exact).max(), exact.max()


@each_nip
def test_volumetric_strain_is_the_logarithm_of_the_density_ratio(values):
    points = (101, 201, 401, 801)
    errors, strains = zip(*(strain_error(values, count) for count in points), strict=True)
    assert strains[-1] > 0.2  # a real compaction
    assert errors[-1] < 1e-5
    order = np.polyfit(np.log(points), np.log(errors), 1)[0]
    assert order == pytest.approx(-2, abs=0.25)  # trapezoid rule


@pytest.mark.parametrize("values", [NIPS["pilot"], {}], ids=["nip", "power"])
def test_force_does_not_jump_as_the_onset_of_compaction_crosses_a_point(values):
    """The number of points that compact changes between two gaps 1e-13 apart; force and strain do not."""
    gap = paper(values).rolls.gap

    def compacting(gap):
        scene = paper(values | {"rolls.gap": gap, "resolution.points": 41})
        _, motion, strains = moved(scene, 41, xi=(1.0,))
        return np.count_nonzero(motion.volumetric_rate > 0), scene, strains.volumetric.sum()

    gaps = gap * np.linspace(0.4, 2.0, 60)
    counts = [compacting(gap)[0] for gap in gaps]
    crossings = np.flatnonzero(np.diff(counts))
    assert crossings.size >= 2
    for k in crossings[:3]:
        low, high = gaps[k], gaps[k + 1]
        while high - low > 1e-13:
            middle = (low + high) / 2
            low, high = (middle, high) if compacting(middle)[0] == counts[k] else (low, middle)
        (first, scene, strain), (second, other, others) = compacting(low), compacting(high)
        assert first != second
        assert others == pytest.approx(strain, rel=1e-6)
        force = machine.specific_pressing_force(scene)
        assert machine.specific_pressing_force(other) == pytest.approx(force, rel=1e-6)
