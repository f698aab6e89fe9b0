"""Figure of `studies.circuit`: size distributions around the circuit, and its load against what was swept."""

import cmcrameri.cm as colours
import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from studies.show import report

_STREAMS = {
    "feed_passing": ("feed of the rolls", "--"),
    "passing_total": ("product of the rolls", "-"),
    "recycle_passing": ("recycle", ":"),
    "product_passing": ("product of the circuit", "-."),
}


def circuit_figure(result: xr.Dataset) -> Figure:
    """Return the distributions of the first operating point with a steady state, and load and energy of every one."""
    points = report.operating_points(result)
    held = np.flatnonzero(points["circulating_load"].notnull().any("replicate").values)
    figure = Figure(figsize=(11, 4.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    _distributions(left, points.isel(operating_point=held[0]).mean("replicate"))
    labels = report.point_names(result, range(points.sizes["operating_point"]))
    for k, (name, factor) in enumerate({"circulating_load": 100, "product_energy": 1 / 3600}.items()):
        panel = right if k == 0 else right.twinx()
        values = points[name].astype(float) * factor
        style = {"color": colours.batlow(0.2 + 0.5 * k), "marker": "os"[k]}
        style["linestyle"] = "-" if len(labels) > 1 else "none"
        panel.errorbar(np.arange(len(labels)), values.mean("replicate"), report.spread(values), **style)
        panel.set_ylabel(("circulating load [%], circles", "energy of the product [kWh/t], squares")[k])
    right.set_xticks(np.arange(len(labels)), labels, rotation=20, ha="right")
    right.set_xlabel(report.joined(report.axes_of(result)))
    figure.supxlabel(f"Left: {labels[held[0]] or 'the scene'}. Returned: {result.attrs['returned']}.", fontsize=9)
    return figure


def _distributions(panel, one: xr.Dataset) -> None:
    for k, (name, (label, line)) in enumerate(_STREAMS.items()):
        percent = 100 * one[name].values
        seen = percent > 0
        style = {"color": colours.batlow(0.25 * k), "linestyle": line, "label": label}
        panel.plot(1e3 * one["sieve"].values[seen], percent[seen], **style)
    panel.set(xscale="log", xlabel="sieve [mm]", ylabel="passing [%]")
    coarse = one["sieve"].values[np.argmax(one["feed_passing"].values > 0.9999)]
    panel.set_xlim(1e3 * coarse / 1000, 1.3e3 * coarse)
    panel.grid(color="0.9", which="both")
    panel.legend(fontsize=8)
