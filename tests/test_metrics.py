import numpy as np
import pytest
from support import paper, sized

from hpgr import passing, peak_pressure, percentile_size, reduction_ratio, simulate, throughput
from hpgr.bed import machine


def run(record, values=None):
    cells = {"resolution.cells": sized(400, 64), "resolution.record": record, "resolution.snapshots": 2}
    return simulate(paper(cells | (values or {})), seed=81)


@pytest.fixture(scope="module")
def cells():
    return run("cells")


@pytest.fixture(scope="module")
def distributions():
    return run("distributions")


@pytest.fixture(scope="module")
def product():
    return run("product")


def product_sizes(ds, point=-1):
    """(streamline, time x cell) sizes at a point."""
    return np.moveaxis(ds["size"].values[:, :, point], 1, 0).reshape(ds.sizes["streamline"], -1)


def test_passing_counts_the_cells_that_are_no_larger(cells):
    sizes = product_sizes(cells)
    sieves = [0.0005, float(np.float32(sizes[0, 3])), 0.01]
    found = passing(cells, sieves)
    assert found.dims == ("streamline", "sieve")
    assert found["sieve"].values.tolist() == sieves
    assert np.array_equal(found.values, np.stack([np.mean(sizes <= s, axis=1) for s in sieves], axis=1))


def test_sieves_may_be_texts_with_a_unit_and_what_is_none_is_refused(cells, product):
    for ds in (cells, product):
        assert passing(ds, ["1 mm", 0.002]).identical(passing(ds, [0.001, 0.002]))
        assert passing(ds, "1 mm").identical(passing(ds, 0.001))
        for sieves in (["6 apples"], ["6"], [0], [None], ["6 kg"], [float("nan")]):
            with pytest.raises(ValueError, match=r"sieves: got .*; such as \['1 mm'\]"):
                passing(ds, sieves)


def test_whole_gap_is_the_mean_of_its_equal_tubes(cells):
    assert passing(cells, [0.001], total=True).values == pytest.approx(passing(cells, [0.001]).values.mean(axis=0))
    assert passing(cells, [0.001], total=True).dims == ("sieve",)
    pooled = np.quantile(product_sizes(cells).astype(float), 0.3)
    assert float(percentile_size(cells, 30, total=True)) == pytest.approx(pooled, rel=1e-6)


def test_records_agree_with_each_other_exactly(cells, distributions, product):
    """What is kept changes nothing of what is computed."""
    assert set(product.data_vars) < set(distributions.data_vars)
    for name in product.data_vars:
        assert np.array_equal(product[name], cells[name]), name
        assert np.array_equal(product[name], distributions[name]), name
    for ds in (cells, distributions, product):
        assert np.array_equal(passing(ds).values.astype(np.float32), product["passing"].values)
        for percent in (50, 80):
            for total in (False, True):
                assert np.array_equal(
                    percentile_size(ds, percent, total=total), percentile_size(product, percent, total=total)
                )


def test_distributions_are_the_counted_cells_at_every_point():
    cells, distributions = (run(record, {"resolution.control_variate": False}) for record in ("cells", "distributions"))
    sieves = distributions["sieve"].values
    for point in (0, 30, -1):
        ordered = np.sort(cells["size"].values[:, :, point], axis=-1)
        for time in range(2):
            for line in range(3):
                counted = np.searchsorted(ordered[time, line], sieves, side="right") / ordered.shape[-1]
                found = np.cumsum(distributions["mass_fraction"].values[time, line, point].astype(float))
                assert found == pytest.approx(counted, abs=1e-6)
        coarse, fine = passing(distributions, point=point), passing(cells, sieves, point=point)
        assert coarse.values == pytest.approx(fine.values, abs=1e-6)


def test_inner_points_are_those_of_their_cells(cells):
    sizes = product_sizes(cells, point=40).astype(float)
    assert percentile_size(cells, 80, point=40).values == pytest.approx(np.quantile(sizes, 0.8, axis=1), rel=1e-6)
    assert np.array_equal(percentile_size(cells, 80, point=60), cells["p80"])  # the last point is the exit


def test_between_sieves_passing_is_linear_in_log_size(product):
    sieves = product["sieve"].values
    middle = np.sqrt(sieves[30] * sieves[31])
    found = passing(product, [middle, sieves[30]])
    assert found.values[:, 0] == pytest.approx(product["passing"].values[:, 30:32].mean(axis=1), rel=1e-6)
    assert found.values[:, 1] == pytest.approx(product["passing"].values[:, 30], rel=1e-6)


@pytest.mark.parametrize("percent", [20, 65, 90])
def test_other_percentiles_are_interpolated_between_sieves(cells, distributions, product, percent):
    """R10 sieves are 26 % apart: the exact percentile is in the same interval."""
    exact = percentile_size(cells, percent).values
    for ds in (distributions, product):
        assert percentile_size(ds, percent).values == pytest.approx(exact, rel=0.26)
        there = passing(ds, percentile_size(ds, percent).values)
        assert np.diag(there) == pytest.approx(percent / 100, abs=1e-6)
        total = float(percentile_size(ds, percent, total=True))
        assert float(passing(ds, [total], total=True)[0]) == pytest.approx(percent / 100, abs=1e-6)


def test_100_percent_pass_the_finest_sieve_that_passes_all(product):
    found = percentile_size(product, 100).values
    sieves = product["sieve"].values
    for line in range(3):
        assert found[line] == pytest.approx(sieves[np.argmax(product["passing"].values[line] == 1)], rel=1e-6)


def test_bounds_of_percentiles(cells):
    sizes = product_sizes(cells)
    assert np.array_equal(percentile_size(cells, 100), sizes.max(axis=1))
    assert np.array_equal(percentile_size(cells, 0), sizes.min(axis=1))


def test_what_was_not_recorded_is_refused_with_the_remedy(product):
    with pytest.raises(ValueError, match=r"point: got 3; only the exit .* 'distributions' or 'cells'"):
        passing(product, point=3)
    with pytest.raises(ValueError, match=r"point: got 3"):
        percentile_size(product, 80, point=3)
    with pytest.raises(ValueError, match=r"sieves: got 2 m; must lie within the recorded 1e-06 to 1 m"):
        passing(product, [0.001, 2.0])
    coarse = run("product", {"resolution.sieves": (0.001, 0.002)})
    with pytest.raises(
        ValueError, match=r"percent: got 1; must lie within what the recorded .* extend resolution.sieves"
    ):
        percentile_size(coarse, 1)


def test_stress_only_has_no_sizes():
    bare = simulate(paper({"resolution.cells": 0}))
    for call in (lambda: passing(bare), lambda: percentile_size(bare, 80), lambda: reduction_ratio(bare)):
        with pytest.raises(ValueError, match="stress only"):
            call()
    assert throughput(bare, total=True) > 0
    assert peak_pressure(bare)["peak_pressure"].dims == ("streamline",)


def test_throughput_is_that_of_the_formula(product):
    """Q = rho_s phi_exit s_b L U; by hand for the paper's machine at phi = 0.9."""
    assert product["solid_fraction"].values[:, -1] == pytest.approx(0.9)
    by_hand = 2650 * 0.9 * 0.06 * 1.0 * (19 * 2 * np.pi / 60 * 3)
    assert float(throughput(product, total=True)) == pytest.approx(by_hand, rel=1e-6)
    tubes = throughput(product)
    assert tubes.dims == ("streamline",)
    assert tubes.values == pytest.approx(by_hand / 3, rel=1e-6)
    assert tubes.attrs["units"] == "kg s-1"
    scene = paper({"rolls.width": 0.5, "rolls.gap": 0.03, "bed.solid_density": 1000})
    assert machine.gap_throughput(scene, 0.7) == pytest.approx(1000 * 0.7 * 0.03 * 0.5 * 5.96903, rel=1e-6)


def test_peak_pressure_is_the_largest_of_the_field(product):
    pressure, height = product["pressure"].values, product["height"].values
    peaks = peak_pressure(product)
    for line in range(3):
        at = pressure[line].argmax()
        assert peaks["peak_pressure"].values[line] == pressure[line, at]
        assert peaks["peak_pressure_height"].values[line] == np.float32(height[line, at])
    total = peak_pressure(product, total=True)
    assert float(total["peak_pressure"]) == pressure.max()
    assert float(total["peak_pressure_height"]) == np.float32(height.flat[pressure.argmax()])


@pytest.mark.parametrize("percent", [50, 80])
def test_reduction_ratio_is_feed_over_product(product, percent):
    scene = paper()
    wanted = float(scene.feed.quantile(percent / 100)) / product[f"p{percent}"].values
    assert reduction_ratio(product, percent).values == pytest.approx(wanted, rel=1e-6)
    total = reduction_ratio(product, percent, total=True)
    assert float(total) == pytest.approx(wanted.mean(), rel=0.1)
    assert total.dims == ()
    assert reduction_ratio(product, percent).attrs["units"] == "1"


def test_metrics_are_labelled_and_leave_their_dataset_alone(cells):
    before = cells.copy(deep=True)
    for found in (passing(cells, [0.001], total=True), percentile_size(cells, 33), throughput(cells)):
        assert {"units", "long_name"} <= set(found.attrs)
    assert reduction_ratio(cells).attrs["units"] == "1"
    assert cells.identical(before)


@pytest.mark.parametrize("record", ["product", "cells"])
def test_extra_dims_of_a_study_are_kept(record):
    import xarray as xr

    swept = xr.concat([run(record), run(record, {"rolls.gap": 0.05})], xr.Variable("gap", [0.06, 0.05]))
    assert set(passing(swept, [0.001]).dims) == {"gap", "streamline", "sieve"}
    assert set(percentile_size(swept, 65).dims) == {"gap", "streamline"}
    assert percentile_size(swept, 80, total=True).dims == ("gap",)


def test_points_beyond_the_bed_are_refused():
    ds = simulate(paper({"resolution.points": 41}))
    for point in (41, -42, 1000):
        with pytest.raises(ValueError, match=rf"point: got {point}; must be within -41 to 40"):
            passing(ds, point=point)
    assert passing(ds, point=-41).identical(passing(ds, point=0))
