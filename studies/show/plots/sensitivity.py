"""Figure of `studies.sensitivity`: a bar for every field, in a panel for every figure."""

import cmcrameri.cm as colours
import numpy as np
import xarray as xr
from matplotlib.figure import Figure


def sensitivity_figure(result: xr.Dataset) -> Figure:
    """Return bars of first-order and total indices with their intervals; hatched: total."""
    names, fields = result["figure"].values, result["field"].values
    figure = Figure(figsize=(3 + 2.6 * names.size, 1.6 + 0.55 * fields.size), layout="constrained")
    for panel, name in zip(figure.subplots(1, names.size, sharey=True, squeeze=False)[0], names, strict=True):
        _bars(panel, result.sel(figure=name))
        panel.set_title(str(name), fontsize=10)
    panel.invert_yaxis()
    handles, labels = panel.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=2)
    figure.supxlabel("part of the variance; bars: 95 % by bootstrap. Fields vary independently.", fontsize=9)
    return figure


def _bars(panel, one: xr.Dataset) -> None:
    place = np.arange(one.sizes["field"])
    if one["total_order"].isnull().all():
        panel.text(0.5, 0.5, "the same everywhere", ha="center", transform=panel.transAxes)
    for k, (order, label) in enumerate({"first_order": "alone", "total_order": "with others"}.items()):
        value, low, high = (one[f"{order}{end}"].values.astype(float) for end in ("", "_low", "_high"))
        error = np.abs(np.nan_to_num([value - low, high - value]))
        style = {"color": colours.batlow(0.2 + 0.5 * k), "hatch": "//" if k else "", "edgecolor": "w"}
        panel.barh(place + 0.2 * (2 * k - 1), value, 0.38, xerr=error, label=label, ecolor="0.2", capsize=2, **style)
    panel.set_yticks(place, one["field"].values)
    panel.set_xlim(0, 1.1)
    panel.grid(axis="x", color="0.9")
    panel.set_axisbelow(True)
