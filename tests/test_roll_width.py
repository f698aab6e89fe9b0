import math

import numpy as np
import pytest
from pydantic import ValidationError
from support import SIGMAS, plain_pilot, sized

from hpgr import simulate
from hpgr.laws.roll_width import WHOLE, FrictionHill, Parabola

INF = math.inf
PRODUCT = {"resolution.record": "product", "resolution.points": 61, "resolution.streamlines": 3}
CLOSED = {"strength.cushioning": INF}


def pilot(values=None, **fields):
    """The pilot rolls with a roll width of these fields."""
    return plain_pilot().with_values(PRODUCT | {"roll_width": fields} | (values or {}))


def test_slices_share_the_width():
    for slices, edge_share in ((1, 0.05), (4, 0.2), (7, 0.9)):
        found = Parabola(slices=slices, edge_share=edge_share).cut(0.02, 1.0)
        assert found.share.sum() == pytest.approx(1, rel=1e-14)
        assert found.share[found.at_edge].sum() == pytest.approx(edge_share, rel=1e-14)
        assert np.count_nonzero(found.at_edge) == np.count_nonzero(~found.at_edge) == slices
        assert np.all((found.position > 1 - edge_share) == found.at_edge)
        # a slice is as wide as its share: its middle lies half its share past those before it
        assert found.position == pytest.approx(np.cumsum(found.share) - found.share / 2, rel=1e-14)
    assert [part.tolist() for part in WHOLE] == [[0], [1], [1], [False]]


def test_pressure_is_the_parabola_and_its_mean():
    means = []
    for slices in (4, 8, 16):
        law = Parabola(pressure_drop=0.8, slices=slices)
        found = law.cut(0.02, 1.0)
        assert found.pressure == pytest.approx(1 - 0.8 * found.position**2, rel=1e-14)
        means.append(abs(found.share @ found.pressure - law.mean_pressure(0.02, 1.0)))
    assert law.mean_pressure(0.02, 1.0) == pytest.approx(1 - 0.8 / 3, rel=1e-14)
    assert means[0] < 0.01
    assert np.array(means[:-1]) / means[1:] == pytest.approx(4, rel=1e-6)  # midpoint rule of a parabola


LAWS = [Parabola(pressure_drop=0.8), FrictionHill(edge_ratio=0.1), FrictionHill(edge_ratio=0.8)]
LAWS += [FrictionHill(edge_ratio=1e-3, friction=0.02)]


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("power", [1.0, 1.5, 2.0])
def test_mean_pressure_is_the_mean_over_the_width(law, power):
    """Also where the hill is still rising in the middle of the rolls."""
    position, thickness = (np.arange(100_000) + 0.5) / 100_000, 0.02
    exact = (law.pressure(position, thickness, 0.5) ** power).mean()
    assert law.mean_pressure(thickness, 0.5, power) == pytest.approx(exact, rel=1e-7)
    relative = law.mean_pressure(np.array([thickness, 2 * thickness]), 0.5, power)
    assert np.all(np.asarray(relative) <= law.mean_pressure(thickness, 0.5, power))


def test_an_edge_as_pressed_as_the_middle_is_no_hill():
    law = FrictionHill(edge_ratio=1.0)
    assert law.mean_pressure(0.02, 0.5, 1.5) == 1
    assert np.all(law.pressure(np.linspace(0, 1, 11), 0.02, 0.5) == 1)


@pytest.mark.parametrize("cushioning", [1.0, INF])
def test_no_drop_is_the_scene_without_roll_width(cushioning):
    """Every slice then marches the same cells under the same stress: equal bits, but for rounding of shares."""
    small = {"strength.cushioning": cushioning, "resolution.cells": 200}
    sliced = simulate(pilot(small, pressure_drop=0.0, slices=2))
    plain = simulate(plain_pilot().with_values(PRODUCT | small))
    for row in sliced["passing_slice"].values:
        assert np.array_equal(row, plain["passing_total"])
    for name in ("passing_width_centre", "passing_width_edge", "passing_total", "passing"):
        assert sliced[name].values == pytest.approx(
            plain["passing" if name == "passing" else "passing_total"].values, abs=2e-7
        )
    for name in ("pressing_force", "power", "throughput", "pressure"):
        assert np.array_equal(sliced[name], plain[name])
    # percentiles of several slices are sizes of cells, not between them
    tolerance = 1e-6 if math.isinf(cushioning) else 0.02
    for name in ("p80_total", "p80_width_edge", "p80_width_centre"):
        assert float(sliced[name]) == pytest.approx(float(plain["p80_total"]), rel=tolerance)


@pytest.mark.parametrize("cushioning", [0.6, INF])
def test_total_is_centre_and_edge_in_their_shares(cushioning):
    found = simulate(pilot(CLOSED | {"strength.cushioning": cushioning, "resolution.cells": 200}, edge_share=0.3))
    parts = 0.7 * found["passing_width_centre"] + 0.3 * found["passing_width_edge"]
    assert found["passing_total"].values == pytest.approx(parts.values, abs=1e-6)
    assert found["passing"].mean("streamline").values == pytest.approx(found["passing_total"].values, abs=1e-6)
    for part, slices in {"centre": slice(4), "edge": slice(4, None)}.items():
        mean = found["passing_slice"][slices].mean("slice").values
        assert mean == pytest.approx(found[f"passing_width_{part}"].values, abs=1e-6)


FEEDS = {
    "table": {},
    "single": {"feed": {"kind": "single", "size": 0.03}},
    "power law": {"feed": {"kind": "power_law", "top_size": 0.03, "exponent": 0.7}},
}


@pytest.mark.parametrize("feed", FEEDS.values(), ids=FEEDS)
def test_the_farther_out_the_coarser(feed):
    """Without cushioning less stress breaks less, of every size: each slice passes at most what the one within does."""
    found = simulate(pilot(CLOSED | feed, pressure_drop=0.9))
    rows = found["passing_slice"].values
    assert np.all(np.diff(rows, axis=0) <= 1e-7)
    assert np.all(found["passing_width_edge"] <= found["passing_width_centre"])
    assert float(found["p80_width_edge"]) > 1.05 * float(found["p80_width_centre"])
    assert float(found["p50_width_centre"]) < float(found["p50_total"]) < float(found["p50_width_edge"])


@pytest.mark.parametrize("feed", FEEDS.values(), ids=FEEDS)
def test_sampling_of_slices_agrees_with_the_closed_form(feed):
    """A huge n, no cushioning, is marched; n = inf is the closed form. Binomial error of 3 lines' cells, all slices the
    same cells: |deviation| > 5 sigma once in 1.7 million, at fewer than 200 sieves and zones."""
    cells = sized(4000, 300)
    small = feed | {"resolution.cells": cells, "resolution.points": 31}
    sampled = {"strength.cushioning": 100.0, "resolution.control_variate": False}
    marched = simulate(pilot(small | sampled, pressure_drop=0.9, slices=2))
    exact = simulate(pilot(small | CLOSED, pressure_drop=0.9, slices=2))
    assert (marched.attrs["solver"], exact.attrs["solver"]) == ("march", "closed form")
    for name in ("passing_total", "passing_width_centre", "passing_width_edge"):
        fraction = exact[name].values
        sigma = np.sqrt(fraction * (1 - fraction) / (3 * cells))
        # sizes of several breaks within one passage have no more attempts than points: cells hardly fall short
        assert np.all(np.abs(marched[name].values - fraction) <= SIGMAS * sigma + 2e-3), name
    for name in ("p80_total", "p80_width_centre", "p80_width_edge"):
        assert float(marched[name]) == pytest.approx(float(exact[name]), rel=sized(0.03, 0.15))


def test_stress_only_scenes_have_force_over_the_width_and_no_product():
    found = simulate(pilot({"resolution.cells": 0}, pressure_drop=0.9))
    whole = simulate(plain_pilot().with_values(PRODUCT | {"resolution.cells": 0}))
    assert "passing_slice" not in found
    assert float(found["pressing_force"]) == pytest.approx(0.7 * float(whole["pressing_force"]), rel=1e-6)
    assert np.array_equal(found["pressure"], whole["pressure"])  # that of the middle of the width


def test_same_bits_with_and_without_other_slices_of_the_same_place():
    """The middle slice of 1 and of 3 slices a zone lie at the same place, so they crush the same."""
    small = {"resolution.cells": 100}
    one, three = (simulate(pilot(small, slices=slices)) for slices in (1, 3))
    assert np.array_equal(one["passing_slice"][0], three["passing_slice"][1])
    assert np.array_equal(one["passing_slice"][1], three["passing_slice"][4])


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"exchange": {}}, "must not be given beside exchange, which is not simulated slice by slice"),
        ({"resolution.record": "cells"}, "must be 'product' with a roll_width; take record = 'product'"),
        ({"resolution.record": "distributions"}, "must be 'product' with a roll_width"),
    ],
)
def test_impossible_roll_widths_are_refused(values, words):
    with pytest.raises(ValidationError, match=words):
        pilot(values)
