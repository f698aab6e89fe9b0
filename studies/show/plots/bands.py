"""What a calibration leaves open of a sweep, apart from what chance does: a table and a figure."""

from typing import NamedTuple

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from studies.show import report
from studies.show.plots.sweeps import caption_under
from studies.sweep.space import SAMPLE

_SHOWN = ("below", "W [", "throughput [", "P80 [")


class Band(NamedTuple):
    """A figure over the samples of a calibration: mean, 95 % of them, two standard errors of chance."""

    mean: xr.DataArray
    low: xr.DataArray
    high: xr.DataArray
    noise: xr.DataArray


def bands(result: xr.Dataset, sieve: float) -> dict[str, Band]:
    """Return the bands of the figures of a sweep over the samples of a calibration, by heading.

    Samples share their random numbers, so that what differs between them is the calibration's; how far replicates of
    one sample differ is chance.
    """
    found = {}
    for heading, values in report.figures(result, sieve).items():
        if heading.startswith(_SHOWN):
            each = values.mean("replicate")
            low, high = (each.quantile(part, SAMPLE) for part in (0.025, 0.975))
            noise = 2 * report.spread(values).mean(SAMPLE) / result.sizes["replicate"] ** 0.5
            found[heading] = Band(each.mean(SAMPLE), low, high, noise.fillna(0.0))
    return found


def bands_table(result: xr.Dataset, sieve: float) -> str:
    """Return a line for each operating point: mean (95 % of the samples) ± two standard errors of chance."""
    first = result.isel({SAMPLE: 0}, drop=True)
    points = report.operating_points(first)
    along = [points[axis.name] for dim in report.axes_of(first) for axis in report.swept(first, dim)]
    columns = {report.axis_label(axis): [f"{value:.6g}" for value in report.shown_values(axis)] for axis in along}
    for heading, band in bands(result, sieve).items():
        rows = zip(*(part.values.ravel().tolist() for part in band), strict=True)
        columns[heading] = ["{:.4g} ({:.4g} to {:.4g}) ± {:.2g}".format(*row) for row in rows]
    told = "(mean; in brackets 95 % of what the calibration leaves; ± two standard errors of chance)"
    return f"{report.aligned(list(columns), zip(*columns.values(), strict=True))}\n{told}"


def bands_figure(result: xr.Dataset, sieve: float, caption: str) -> Figure:
    """Return the figures against the first axis: the band of the calibration, and bars of chance."""
    first, *others = (name for name in report.axes_of(result) if name != SAMPLE)
    figure = Figure(figsize=(10, 7), layout="constrained")
    for panel, (heading, band) in zip(figure.subplots(2, 2).ravel(), bands(result, sieve).items(), strict=False):
        mean, low, high, noise = (part.isel(dict.fromkeys(others, 0)).values for part in band)
        x = report.shown_values(result[first])
        order = np.argsort(x)
        panel.fill_between(x[order], low[order], high[order], color="0.8", label="95 % of what the calibration leaves")
        panel.errorbar(x[order], mean[order], noise[order], color="k", marker="o", markersize=4, label="mean; chance")
        panel.set(xlabel=report.axis_label(result[first]), ylabel=heading)
        panel.grid(color="0.9")
    figure.legend(*panel.get_legend_handles_labels(), loc="outside upper center", ncols=2)
    words = (
        f"Bands: {result.sizes[SAMPLE]} samples of what the tests of the calibration leave possible; what the model "
        "misses of tests it has not seen comes on top."
    )
    caption_under(figure, result, f"{caption}\n{words}")
    return figure
