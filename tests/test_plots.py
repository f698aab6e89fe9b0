import io
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from matplotlib.container import ErrorbarContainer
from support import lose, paper

from studies.show import plots, report
from studies.show.plots.sweeps import sweep_figure
from studies.sweep import sweep

BASE = {"resolution.streamlines": 3, "resolution.points": 40, "resolution.cells": 60}
WORDS = "While the gap varies, the entry gap is held."


@pytest.fixture(scope="module")
def swept():
    axes = {"rolls.gap": ["60 mm", "40 mm", "50 mm"], "rolls.speed": ["10 rpm", "20 rpm"]}
    return sweep(paper(BASE), axes, replicates=2)


@pytest.fixture(scope="module")
def figure(swept):
    return draw(swept)


def lines_of(panel):
    """Return the lines that carry data."""
    bars = [each.lines[0] for each in panel.containers if isinstance(each, ErrorbarContainer)]
    return bars or list(panel.lines)


def draw(result, field="rolls.gap"):
    """Return the figure, drawn once so that whatever cannot be drawn raises here."""
    figure = sweep_figure(result, field, 1e-3, WORDS)
    figure.savefig(io.BytesIO(), dpi=20)
    return figure


def styles(panel):
    return {(line.get_marker(), line.get_linestyle()) for line in lines_of(panel)}


def texts(legend):
    return [text.get_text() for text in legend.get_texts()]


def test_curves_are_told_apart_without_colour_and_alike_ones_drawn_once(figure):
    """Speed changes the throughput alone: of 3 gaps x 2 speeds three products are apart."""
    upper, lower = figure.axes[:3], figure.axes[3:]
    for panel in upper[:2]:
        assert len(lines_of(panel)) == len(styles(panel)) == 3
    assert len(lines_of(upper[2])) == 4  # and the feed
    assert [len(lines_of(panel)) for panel in lower] == [2] * 5
    assert all(len(styles(panel)) == 2 for panel in lower)
    assert [panel.get_title() for panel in lower[:2]] == ["Throughput", "P80 (all curves coincide)"]
    products, speeds = sorted(figure.legends, key=lambda legend: len(legend.get_texts()), reverse=True)
    assert texts(products) == [f"{gap} mm, 10 rpm (and 1 alike)" for gap in (60, 40, 50)]
    assert "swept: gap, roll speed" in products.get_title().get_text()
    assert (speeds.get_title().get_text(), texts(speeds)) == ("roll speed", ["10 rpm", "20 rpm"])


def test_labels_have_units(swept, figure):
    for panel in figure.axes:
        for label in (panel.get_xlabel(), panel.get_ylabel()):
            assert re.search(r"\w.* \[.+\]$", label)
        assert panel.get_title()
    by_speed = draw(swept, "rolls.speed").axes[3:]
    assert {panel.get_xlabel() for panel in by_speed} == {"roll speed [rpm]"}
    wanted = ["throughput [t/h]", "P80 [mm]", "below 1 mm [%]", "W [kWh/t]", "peak pressure [MPa]"]
    assert [panel.get_ylabel() for panel in by_speed] == wanted


def test_fineness_is_drawn_where_it_was_measured(swept, figure):
    left, right = figure.axes[:2]
    points = report.operating_points(swept)
    passing = report.percent_passing(points, 1e-3, total=False).mean("replicate")
    for panel, values in ((left, points["p80"].mean("replicate") * 1e3), (right, passing)):
        assert panel.get_xlim() == (0, 1)
        for k, line in enumerate(lines_of(panel)):
            assert line.get_xdata() == pytest.approx(swept["xi"].values)
            expected = values.isel(operating_point=2 * k).transpose("streamline").values
            assert line.get_ydata() == pytest.approx(expected, rel=1e-6)
    flat = swept.copy(deep=True)
    flat["p80"] = flat["p80"].mean("streamline") + 0 * flat["p80"]
    assert draw(flat).axes[0].get_title() == "Product size to the roll, flat within its noise"


def test_curves_hold_the_numbers(swept, figure):
    found = report.figures(swept, 1e-3)
    for panel in figure.axes[3:]:
        values = found[panel.get_ylabel()].isel(gap=[1, 2, 0])
        for k, (line, bars) in enumerate(zip(lines_of(panel), panel.containers, strict=True)):
            if not len(line.get_xdata()):
                continue  # coincides
            assert line.get_xdata() == pytest.approx([40, 50, 60])  # sorted, though swept as 60, 40, 50
            one = values.isel(roll_speed=k)
            assert line.get_ydata() == pytest.approx(one.mean("replicate").values, rel=1e-12)
            low, high = np.array([each[:, 1] for each in bars.lines[2][0].get_segments()]).T
            assert (high - low) / 2 == pytest.approx(report.spread(one).values, rel=1e-6, abs=1e-9)
    means = report.operating_points(swept)["passing_total"].astype(float).mean("replicate")
    known = dict(zip(1e3 * swept["sieve"].values, 100 * means.isel(operating_point=0).values, strict=True))
    first = figure.axes[2].lines[0]
    assert first.get_ydata() == pytest.approx([known[size] for size in first.get_xdata()], rel=1e-6)
    fed = figure.axes[2].lines[-1]
    uniform = 100 * np.clip((fed.get_xdata() / 1e3 - 0.008) / 0.052, 0, 1)
    assert fed.get_ydata() == pytest.approx(uniform)


def test_caption_tells_replicates_and_remark(swept, figure):
    text = figure.get_supxlabel()
    assert text.startswith(WORDS)
    assert "Mean of 2 replicates; bars: ± one standard deviation." in text
    assert "evenly chosen" not in text
    remarked = swept.assign_attrs(scene=swept.attrs["scene"].replace('"remark":""', '"remark":"not calibrated"'))
    assert "Scene: not calibrated." in draw(remarked).get_supxlabel()


@pytest.mark.slow
def test_many_points_are_thinned_and_it_says_so():
    base = paper(BASE | {"resolution.cells": 20, "resolution.streamlines": 1})
    figure = draw(sweep(base, {"rolls.gap": np.linspace(0.03, 0.1, 11)}))
    assert "at most 7 of the operating points, evenly chosen" in figure.get_supxlabel()
    for panel in figure.axes[:2]:
        assert len(lines_of(panel)) == len(styles(panel)) == 7
    labels = texts(figure.legends[0])
    assert (labels[0], labels[-1]) == ("30 mm", "100 mm")
    for panel in figure.axes[3:]:
        assert len(lines_of(panel)[0].get_xdata()) == 11  # against the axis nothing is left out
    assert "replicates" not in figure.get_supxlabel()  # there is one


@pytest.mark.slow
@pytest.mark.parametrize(
    ("field", "values", "labels"),
    [
        ("elasticity.integrator", ["increment", "euler"], ["increment", "euler"]),
        ("strength.cushioning", [0.5, 1.0, np.inf], ["0.5", "1", "inf"]),
    ],
)
def test_axes_that_are_text_or_infinite(field, values, labels):
    result = sweep(paper(BASE), {field: values}, replicates=2)
    figure = draw(result, field)
    assert texts(figure.legends[0]) == labels
    for panel in figure.axes[3:]:
        assert panel.get_xlabel() == report.axis_label(result[report.axes_of(result)[0]])
        assert list(lines_of(panel)[0].get_xdata()) == values


def test_stress_only_has_no_empty_panel_and_a_flat_curve_looks_flat():
    base = paper(BASE | {"resolution.cells": 0})
    speeds = [f"{rpm} rpm" for rpm in range(10, 19)]
    figure = draw(sweep(base, {"rolls.gap": [0.04, 0.05], "rolls.speed": speeds}), "rolls.speed")
    assert [panel.get_ylabel() for panel in figure.axes] == ["throughput [t/h]", "W [kWh/t]", "peak pressure [MPa]"]
    low, high = figure.axes[2].get_ylim()
    assert np.ptp(lines_of(figure.axes[2])[0].get_ydata()) == 0  # speed does not change pressure
    assert high - low > 0.3 * low
    panel = draw(sweep(base, {"rolls.gap": [0.04, 0.05], "rolls.speed": speeds})).axes[0]
    assert len(styles(panel)) == len(lines_of(panel)) == 7  # more than seven lines of another axis are thinned


def test_lost_points_are_left_out(swept):
    result = swept.copy(deep=True)
    lose(result, "boom", gap=1, roll_speed=1)
    lose(result, "boom", gap=0, roll_speed=0, replicate=0)
    figure = draw(result)
    shown = max((texts(legend) for legend in figure.legends), key=len)
    assert shown == ["60 mm, 10 rpm", "60 mm, 20 rpm", "40 mm, 10 rpm", "50 mm, 10 rpm (and 1 alike)"]
    for panel in figure.axes[:2]:
        assert len(lines_of(panel)) == 4
        assert all(np.isfinite(line.get_ydata()).all() for line in lines_of(panel))
    slow, fast = (line.get_ydata() for line in lines_of(figure.axes[4]))
    assert np.isnan(fast).tolist() == [True, False, False]  # 40, 50, 60 mm
    assert slow[2] == pytest.approx(float(result["p80_total"][0, 0, 1]) * 1e3)  # the replicate that is left


def test_figures_are_not_kept_by_pyplot(figure):
    # pyplot keeps every figure alive, and looks for a screen
    pyplot = sys.modules.get("matplotlib.pyplot")  # the colour maps load it
    assert pyplot is None or pyplot.get_fignums() == []
    for path in Path(plots.__file__).parent.glob("*.py"):
        assert "pyplot" not in path.read_text(encoding="utf-8"), path.name
