"""Figures of the bed between the rolls."""

import cmcrameri.cm as maps
import numpy as np
from matplotlib.collections import PolyCollection
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

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
    for side in (-1, 1):
        drawn = PolyCollection(
            [1e3 * outline * (side, 1) for outline in outlines], array=volumes, cmap=maps.batlow,
            norm=LogNorm(), edgecolors="0.2", linewidths=0.25,
        )  # fmt: skip
        panel.add_collection(drawn)
        panel.plot(side * 1e3 * motion.x, 1e3 * motion.y, ".k", markersize=0.8)
        height = np.linspace(0, bed.height, 200)
        panel.fill_betweenx(
            1e3 * height,
            side * 1e3 * bed.roll_surface(height),
            side * 1.1e3 * bed.outer(bed.height),
            color="0.8",
            zorder=0,
        )
    panel.set(xlabel="x across the gap [mm]", ylabel="height above the minimum gap [mm]", aspect="equal")
    panel.set_title("Volume of the material points")
    figure.colorbar(drawn, label="volume per roll width [mm²]", shrink=0.8)
    return figure
