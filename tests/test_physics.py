"""An exam of the physics over sweep output: which way figures go, and in what proportion.

Where the model is known to disagree with measurements the test asserts what the model does, and says so.
"""

import numpy as np
import pytest
from support import paper, plain_industrial, plain_pilot

from hpgr import Scene, simulate
from hpgr.bed import machine
from hpgr.bed.loaded import inputs_of, load_bed
from studies.sweep import sweep

SMALL = {"resolution.points": 101, "resolution.streamlines": 5, "resolution.cells": 60, "resolution.record": "product"}
CLOSED = {"strength.cushioning": float("inf")}  # smooth in every axis: no cell is counted
FORCES = [2.0e6, 2.8e6, 3.6e6, 4.4e6]
REAL = {"khd_pilot": plain_pilot, "industrial": plain_industrial}
each_real = pytest.mark.parametrize("preset", REAL.values(), ids=REAL)


def real(preset, values=None):
    return preset().with_values(SMALL | CLOSED | (values or {}))


@pytest.fixture(scope="module", params=REAL.values(), ids=REAL)
def pressed(request):
    """The real machines over their pressing force, the gap floating."""
    result = sweep(real(request.param), {"rolls.specific_pressing_force": FORCES}, threads=1).isel(replicate=0)
    assert not result["status"].any()
    return result


def throughput_of(scene):
    """Throughput in double precision."""
    solid_fraction = load_bed(inputs_of(scene)).stress.solid_fraction
    return machine.gap_throughput(scene, float(solid_fraction[:, -1].mean()))


# --- throughput ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "scene", [paper(), real(plain_pilot), real(plain_industrial)], ids=["paper", "khd_pilot", "industrial"]
)
def test_throughput_and_power_are_linear_in_speed(scene):
    speeds = scene.rolls.speed * np.array([1.0, 2.0, 4.0])
    result = sweep(scene, {"rolls.speed": speeds}, threads=1).isel(replicate=0)
    for name in ("throughput", "power"):
        assert np.array_equal(result[name].values, result[name].values[0] * np.array([1, 2, 4]))
    for name in ("p80_total", "specific_energy", "specific_throughput", "pressing_force"):
        assert np.all(result[name] == result[name][0])  # the model knows no rate


def test_throughput_of_the_papers_machine_is_linear_in_the_gap():
    """Its cake is as dense as phi_max allows at every gap, so Q = rho_s phi_max s_b L U."""
    gaps = np.array([0.03, 0.06, 0.09])
    result = sweep(paper(), {"rolls.gap": gaps}, threads=1).isel(replicate=0)
    assert result["throughput"].values == pytest.approx(2650 * 0.9 * gaps * 5.9690, rel=1e-5)
    assert all("held at max_solid_fraction" in words for words in result["diagnostics"].values)


@each_real
def test_throughput_past_a_nip_is_what_the_nip_takes_in(preset):
    """Q = rho_s phi_feed cos(alpha) (s_b + D (1 - cos alpha)) L U, a straight line in the gap.

    The model's is larger by the mean of 1/cos(theta) over its streamlines, which are vertical on the mid-plane and at
    alpha only at the roll, about alpha^2/3, and by the cubic's departure from the roll.
    """
    gaps = np.array([0.025, 0.027, 0.029]) * preset().rolls.diameter
    scenes = [real(preset, {"rolls.gap": gap}) for gap in gaps]
    found = np.array([throughput_of(scene) for scene in scenes])
    rolls, ore, angle = scenes[0].rolls, scenes[0].bed, scenes[0].flow.nip_angle
    nip = gaps + rolls.diameter * (1 - np.cos(angle))
    exact = ore.solid_density * ore.feed_solid_fraction * np.cos(angle) * nip * rolls.width * rolls.surface_speed
    bed = load_bed(inputs_of(scenes[0])._replace(streamlines=400, points=2)).geometry
    steep = bed.slope(rolls.diameter / 2 * np.sin(angle))
    mean = np.mean(1 / np.sqrt(1 + (bed.xi * steep) ** 2)) / np.cos(angle)
    assert mean == pytest.approx(1 + angle**2 / 3, abs=2e-3)
    assert found / exact == pytest.approx(mean, abs=3e-3)
    assert np.diff(found, 2) == pytest.approx(0, abs=1e-3 * np.diff(found)[0])
    # not in proportion: a nip of fixed angle also takes in what does not depend on the gap
    assert found[0] / gaps[0] > 1.02 * found[-1] / gaps[-1]


# --- force --------------------------------------------------------------------------------------------------


def exponent(x, y):
    return np.diff(np.log(y.values)) / np.diff(np.log(x.values))


def test_more_force_narrows_the_gap_and_takes_less_through(pressed):
    assert np.all(np.diff(pressed["operating_gap"]) < 0)
    assert np.all(np.diff(pressed["specific_throughput"]) < 0)
    assert pressed["specific_pressing_force"].values == pytest.approx(FORCES, rel=1e-6)
    assert np.all(np.diff(pressed["peak_pressure"]) > 0)


def test_specific_energy_grows_nearly_in_proportion_to_force(pressed):
    """Exponent of W on Fsp: 1.10 to 1.12 with the pilot's idle torque, 1.24 to 1.27 of the bed alone.

    Those of the KHD pilot tests fall below proportion, ln(2.40/1.44) / ln(4.7/2.5) = 0.81 from P1 to P5: the model
    disagrees. It has the gap fall faster with force, -0.56, than the cake thickness of the tests.
    """
    powers = exponent(pressed["specific_pressing_force"], pressed["specific_energy"])
    idling = Scene.model_validate_json(pressed.attrs["scene"]).rolls.idle_torque > 0
    low, high = (0.7, 1.2) if idling else (1.0, 1.3)
    assert np.all((powers > low) & (powers < high)), powers
    assert np.all(np.diff(pressed["force_angle"]) < 0)  # measured too: 4.06 degrees at 2.5 N/mm2, 3.3 at 4.7


def test_specific_energy_over_force_is_that_of_real_machines():
    """0.4 to 0.7 kWh/t per N/mm2 of the calibrated machine, idle torque included."""
    result = sweep(real(plain_pilot), {"rolls.specific_pressing_force": FORCES}, threads=1).isel(replicate=0)
    ratio = result["specific_energy"] / 3600 / (result["specific_pressing_force"] / 1e6)
    assert np.all((ratio > 0.4) & (ratio < 0.7)), ratio.values


def test_more_force_gives_a_finer_product_with_ever_less_gain(pressed):
    steps = np.diff(pressed["p80_total"])
    assert np.all(steps < 0)
    assert np.all(np.diff(steps) > 0)  # equal steps of force


def test_pressure_peaks_at_the_gap_past_a_nip_and_slightly_above_it_in_the_papers_flow(pressed):
    """Measurements have the peak slightly above the minimum gap. The nip profile has |v| = U down to the gap and no
    extrusion past it, so its bed compacts right to the exit: it disagrees with them."""
    assert np.all(pressed["peak_pressure_height"] == 0)
    found = simulate(paper({"resolution.cells": 0, "resolution.points": 801}))
    assert 0 < float(found["peak_pressure_height"]) < 0.05 * 1.717


# --- product ------------------------------------------------------------------------------------------------


def test_coarser_feed_gives_a_slightly_finer_product_at_the_same_pressure():
    """Plants see a coarser product from a coarser feed; the model has it a little finer, and so disagrees.

    Without cushioning F(x) = F0(x) + (1 - F0(s_c)) (x/s_c)^gamma below the critical size s_c: grains above it are
    crushed to the same sizes whatever their own, and those below it, of which a coarser feed has fewer, stay as they
    are, coarser than what is crushed. Stress knows nothing of grain size.
    """
    tops = [0.025, 0.035, 0.045]
    result = sweep(real(plain_pilot), {"feed.top_size": tops}, threads=1).isel(replicate=0)
    p80 = result["p80_total"].values
    assert np.all(np.diff(p80) < 0)
    assert p80[-1] > 0.9 * p80[0]
    for name in ("peak_pressure", "pressing_force", "power", "throughput"):
        assert np.all(result[name] == result[name][0])
    # of grains that all start above the critical size no more is left than gamma
    tops = [0.03, 0.04, 0.06]
    alone = real(plain_pilot, {"feed": {"kind": "single", "size": 0.03}})
    result = sweep(alone, {"feed.size": tops}, threads=1).isel(replicate=0)
    assert result["p80_total"].values == pytest.approx(float(result["p80_total"][0]), rel=1e-6)
    assert np.all(np.diff(result["breaks_per_cell"].mean("streamline")) > 0)


def test_softer_ore_is_crushed_finer_by_the_same_machine():
    strengths = plain_pilot().strength.reference_strength * np.array([0.5, 1.0, 2.0])
    result = sweep(real(plain_pilot), {"strength.reference_strength": strengths}, threads=1).isel(replicate=0)
    assert np.all(np.diff(result["p80_total"]) > 0)
    assert np.all(result["power"] == result["power"][0])  # the model's bed does not know what breaks in it
