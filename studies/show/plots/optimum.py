"""Figure of `studies.optimum`: what the operating points trade, and the best of them."""

from typing import TYPE_CHECKING

import cmcrameri.cm as colours
import numpy as np
from matplotlib.figure import Figure

from studies.quantities import Quantity, quantity_of
from studies.show import report

if TYPE_CHECKING:
    from studies.optimum import Optimum


def optimum_figure(best: "Optimum") -> Figure:
    """Return energy and throughput against fineness, of every point of the design, and the best point."""
    fineness = next(one for one in map(quantity_of, best.figures) if one.of_product)
    figure = Figure(figsize=(11, 4.8), layout="constrained")
    for panel, name in zip(figure.subplots(1, 2), ("specific energy", "throughput"), strict=True):
        _tradeoff(panel, best, fineness, quantity_of(name))
    handles, labels = panel.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=3)
    point = str(best).splitlines()[: len(best.values)]
    words = [", ".join(point), f"binding: {'; '.join(best.binding) or 'nothing'}", "Bars: two standard errors."]
    figure.supxlabel("\n".join([*words, *best.without_effect]), fontsize=9)
    return figure


def _tradeoff(panel, best: "Optimum", across: Quantity, up: Quantity) -> None:
    result = best.tradeoff
    unbeaten = result[f"best_{up.words.rpartition(' ')[2]}"].values.astype(bool)
    each = [one.of(result).astype(float) * one.shown[1] for one in (across, up)]
    bars = [np.nan_to_num(2 * report.spread(values) / result.sizes["replicate"] ** 0.5) for values in each]
    (x, y), (xerr, yerr) = (values.mean("replicate").values for values in each), bars
    for chosen, style in ((~unbeaten, {"color": "0.7", "label": "another is finer and better"}), (unbeaten, _UNBEATEN)):
        errors = {"xerr": xerr[chosen], "yerr": yerr[chosen]}
        panel.errorbar(x[chosen], y[chosen], **errors, fmt="o", markersize=4, linewidth=0.8, **style)
    place = (best.figures[one.words][0] * one.shown[1] for one in (across, up))
    panel.plot(*place, "*", color=colours.batlow(0.75), markeredgecolor="k", markersize=15, label="best")
    panel.set(xlabel=across.label, ylabel=up.label)
    panel.grid(color="0.9")


_UNBEATEN = {"color": colours.batlow(0.2), "label": "no other is finer and better"}
