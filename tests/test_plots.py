import io
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from matplotlib.container import ErrorbarContainer
from support import paper

from studies import report
from studies.plots import sweeps as plots
from studies.plots.sweeps import sweep_figure
from studies.sweep import STATUS, sweep

BASE = {"resolution.streamlines": 3, "resolution.points": 40, "resolution.cells": 60}
WORDS = "While the gap varies, the entry gap is held."


@pytest.fixture(scope="module")
def swept():
    return sweep(
        paper(BASE), {"rolls.gap": ["60 mm", "40 mm", "50 mm"], "rolls.speed": ["10 rpm", "20 rpm"]}, replicates=2
    )


def lines_of(panel):
    """Return the lines that carry data."""
    bars = [each.lines[0] for each in panel.containers if isinstance(each, ErrorbarContainer)]
    return bars or list(panel.lines)


def draw(result, field="rolls.gap", caption=WORDS):
    """Return the figure, drawn once so that whatever cannot be drawn raises here."""
    figure = sweep_figure(result, field, 1e-3, caption)
    figure.savefig(io.BytesIO(), dpi=20)
    return figure


def styles(panel):
    return {(line.get_marker(), line.get_linestyle()) for line in lines_of(panel)}


def test_figure_is_a_picture(swept):
    target = io.BytesIO()
    sweep_figure(swept, "rolls.gap", 1e-3, WORDS).savefig(target, format="png", dpi=40)
    assert target.getvalue().startswith(b"\x89PNG")
    assert len(target.getvalue()) > 10_000


def test_a_line_for_every_operating_point_told_apart_without_colour(swept):
    figure = draw(swept)
    upper, lower = figure.axes[:3], figure.axes[3:]
    assert len(lower) == 3
    for panel in upper:
        assert len(lines_of(panel)) == 6  # 3 gaps x 2 speeds
        assert len(styles(panel)) == 6
    for panel in lower:
        assert len(lines_of(panel)) == 2  # a line per speed
        assert len(styles(panel)) == 2
        assert [text.get_text() for text in panel.get_legend().get_texts()] == ["10 rpm", "20 rpm"]
    [legend] = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == [
        f"{gap} mm, {speed} rpm" for gap in (60, 40, 50) for speed in (10, 20)
    ]
    assert legend.get_title().get_text() == "gap, roll speed"


def test_more_than_seven_lines_of_another_axis_are_told_apart():
    base = paper(BASE | {"resolution.cells": 0})
    speeds = [f"{rpm} rpm" for rpm in range(10, 19)]
    for panel in draw(sweep(base, {"rolls.gap": [0.04, 0.05], "rolls.speed": speeds})).axes:
        assert len(styles(panel)) == len(lines_of(panel))


def test_labels_have_units(swept):
    for panel in draw(swept).axes:
        for label in (panel.get_xlabel(), panel.get_ylabel()):
            assert re.search(r"\w.* \[.+\]$", label)
        assert panel.get_title()
    by_speed = draw(swept, "rolls.speed").axes[3:]
    assert {panel.get_xlabel() for panel in by_speed} == {"roll speed [rpm]"}
    assert [panel.get_ylabel() for panel in by_speed] == ["throughput [t/h]", "P80 [mm]", "peak pressure [MPa]"]


def test_fineness_is_mirrored_roll_to_roll(swept):
    left, right = draw(swept).axes[:2]
    points = report.operating_points(swept)
    passing = report.percent_passing(points, 1e-3, total=False).mean("replicate")
    expected = {left: points["p80"].mean("replicate") * 1e3, right: passing}
    for panel, values in expected.items():
        assert panel.get_xlim() == (-1, 1)
        for k, line in enumerate(lines_of(panel)):
            x, y = np.array(line.get_xdata(), float), np.array(line.get_ydata(), float)
            assert np.array_equal(x, -x[::-1])
            assert (np.diff(x) > 0).all()
            assert np.array_equal(y, y[::-1])
            assert np.array_equal(x[3:], swept["xi"])
            assert y[3:] == pytest.approx(values.isel(operating_point=k).values, rel=1e-6)
    assert right.get_ylabel() == "below 1 mm [%]"


def test_curves_against_the_axis_hold_the_numbers(swept):
    figure = draw(swept)
    found = report.figures(swept, 1e-3)
    for panel, heading in zip(figure.axes[3:], ["throughput [t/h]", "P80 [mm]", "peak pressure [MPa]"], strict=True):
        for k, (line, bars) in enumerate(zip(lines_of(panel), panel.containers, strict=True)):
            assert line.get_xdata() == pytest.approx([40, 50, 60])  # sorted, though swept as 60, 40, 50
            values = found[heading].isel(roll_speed=k, gap=[1, 2, 0])
            assert line.get_ydata() == pytest.approx(values.mean("replicate").values, rel=1e-12)
            low, high = np.array([each[:, 1] for each in bars.lines[2][0].get_segments()]).T
            assert (high - low) / 2 == pytest.approx(report.spread(values).values, rel=1e-6, abs=1e-9)


def test_product_sizes_hold_the_numbers(swept):
    panel = draw(swept).axes[2]
    assert (panel.get_xscale(), panel.get_yscale()) == ("log", "log")
    means = report.operating_points(swept)["passing_total"].mean("replicate")
    for k, line in enumerate(panel.lines):
        percent = 100 * means.isel(operating_point=k).values
        assert line.get_ydata() == pytest.approx(percent[percent > 0], rel=1e-6)
        assert line.get_xdata() == pytest.approx(swept["sieve"].values[percent > 0] * 1e3, rel=1e-12)


def test_caption_tells_replicates_and_note(swept):
    text = draw(swept).get_supxlabel()
    assert text.startswith(WORDS)
    assert "Mean of 2 replicates; bars: ± one standard deviation." in text
    assert "evenly chosen" not in text
    noted = swept.assign_attrs(scene=swept.attrs["scene"].replace('"note":""', '"note":"not calibrated"'))
    assert "Scene: not calibrated." in draw(noted).get_supxlabel()


def test_many_points_are_thinned_and_it_says_so():
    gaps = np.linspace(0.03, 0.1, 11)
    figure = draw(sweep(paper(BASE), {"rolls.gap": gaps}))
    assert "at most 7 of the operating points, evenly chosen" in figure.get_supxlabel()
    for panel in figure.axes[:3]:
        assert len(lines_of(panel)) == len(styles(panel)) == 7
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels[0] == "30 mm"
    assert labels[-1] == "100 mm"
    for panel in figure.axes[3:]:
        assert len(lines_of(panel)[0].get_xdata()) == 11  # against the axis nothing is left out
    assert "replicates" not in figure.get_supxlabel()  # there is one


@pytest.mark.parametrize(
    ("field", "values", "labels"),
    [
        ("stress.integrator", ["increment", "euler"], ["increment", "euler"]),
        ("material.cushioning", [0.5, 1.0, np.inf], ["0.5", "1", "inf"]),
    ],
)
def test_axes_that_are_text_or_infinite(field, values, labels):
    figure = draw(sweep(paper(BASE), {field: values}, replicates=2), field)
    assert [text.get_text() for text in figure.legends[0].get_texts()] == labels
    for panel in figure.axes[3:]:
        assert panel.get_xlabel() == field.replace("material.", "").replace(".", " ")
        assert list(lines_of(panel)[0].get_xdata()) == values


def test_stress_only_has_no_empty_panel():
    base = paper(BASE | {"resolution.cells": 0})
    figure = draw(sweep(base, {"rolls.gap": [0.04, 0.05]}, replicates=2))
    assert [panel.get_ylabel() for panel in figure.axes] == ["throughput [t/h]", "peak pressure [MPa]"]
    for panel in figure.axes:
        assert np.isfinite(lines_of(panel)[0].get_ydata()).all()


def test_lost_points_are_left_out(swept):
    result = swept.copy(deep=True)
    for name in result.data_vars:
        if result[name].dtype.kind == "f":
            result[name][{"gap": 1, "roll_speed": 1}] = np.nan
            result[name][{"gap": 0, "roll_speed": 0, "replicate": 0}] = np.nan
    result["status"][{"gap": 1, "roll_speed": 1}] = STATUS["failed"]
    figure = draw(result)
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels == ["60 mm, 10 rpm", "60 mm, 20 rpm", "40 mm, 10 rpm", "50 mm, 10 rpm", "50 mm, 20 rpm"]
    for panel in figure.axes[:3]:
        assert len(lines_of(panel)) == 5
        assert all(np.isfinite(line.get_ydata()).all() for line in lines_of(panel))
    slow, fast = (line.get_ydata() for line in lines_of(figure.axes[4]))
    assert np.isnan(fast).tolist() == [True, False, False]  # 40, 50, 60 mm
    assert slow[2] == pytest.approx(float(result["p80_total"][0, 0, 1]) * 1e3)  # the replicate that is left


def test_flat_curve_looks_flat(swept):
    by_speed = draw(sweep(paper(BASE), {"rolls.speed": ["10 rpm", "20 rpm"]}), "rolls.speed")
    low, high = by_speed.axes[5].get_ylim()  # peak pressure, which speed does not change
    [line] = lines_of(by_speed.axes[5])
    assert np.ptp(line.get_ydata()) == 0
    assert high - low > 0.3 * low


def test_figures_are_not_kept_by_pyplot(swept):
    # pyplot keeps every figure alive, and looks for a screen
    draw(swept)
    pyplot = sys.modules.get("matplotlib.pyplot")  # the colour maps load it
    assert pyplot is None or pyplot.get_fignums() == []
    for path in Path(plots.__file__).parent.glob("*.py"):
        assert "pyplot" not in path.read_text(encoding="utf-8"), path.name
