"""Figures of the bed between the rolls."""

import cmcrameri.cm as maps
import numpy as np
from matplotlib.collections import PolyCollection
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from hpgr.flow import Motion
from hpgr.geometry import Geometry
from hpgr.tessellation import Tessellation


def tessellation_figure(bed: Geometry, motion: Motion, cells: Tessellation) -> Figure:
    """Return the Voronoi cells of the material points, mirrored, with the rolls: the paper's figure 3d."""
    figure = Figure(figsize=(8, 8.6), layout="constrained")
    panel = figure.subplots()
    outlines = [np.asarray(part.exterior.coords) for cell in cells.cells for part in getattr(cell, "geoms", [cell])]
    pieces = [len(getattr(cell, "geoms", [cell])) for cell in cells.cells]  # the concave rim may cut a cell in two
    volumes = 1e6 * np.repeat(cells.volume.ravel(), pieces)
    drawn = draw_cells(panel, outlines, volumes, LogNorm(volumes.min(), volumes.max()))
    for side in (-1, 1):
        panel.plot(side * 1e3 * motion.x, 1e3 * motion.y, ".k", markersize=0.8)
    draw_rolls(panel, bed.radius, bed.half_gap + bed.radius, bed.outer(bed.height), bed.height)
    panel.set_title("Volume of the material points")
    figure.colorbar(drawn[0], label="volume per roll width [mm²]", shrink=0.8)
    return figure


def draw_cells(
    panel, outlines: list[np.ndarray], values: np.ndarray, norm: Normalize, cmap=maps.batlow
) -> list[PolyCollection]:
    """Draw cells of the right half (outlines in m), coloured by `values`, and their mirror images; return both."""
    drawn = []
    for side in (1, -1):
        part = PolyCollection(
            [1e3 * outline * (side, 1) for outline in outlines], array=values, cmap=cmap, norm=norm,
            edgecolors="0.2", linewidths=0.25,
        )  # fmt: skip
        panel.add_collection(part)
        drawn.append(part)
    return drawn


def draw_rolls(panel, radius: float, axis: float, half_width: float, height: float) -> None:
    """Draw both rolls (lengths in m) behind a bed of this size, and set the panel's limits, aspect and labels in mm.

    `axis` is the distance of the roll axes from the mid-plane, `half_width` that of the bed at its top.
    """
    for side in (-1, 1):
        panel.add_patch(Circle((side * 1e3 * axis, 0), 1e3 * radius, facecolor="0.85", edgecolor="0.3", zorder=0))
    panel.set(
        xlabel="x across the gap [mm]",
        ylabel="height above the minimum gap [mm]",
        xlim=(-1.25e3 * half_width, 1.25e3 * half_width),
        ylim=(-0.06e3 * height, 1.04e3 * height),
        aspect="equal",
    )
