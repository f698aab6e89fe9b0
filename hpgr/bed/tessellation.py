"""Voronoi cells of the material points, clipped to the bed: volumes, edges and neighbours (paper figure 3d).

Only scenes with exchange, and pictures, come here.
"""

from typing import NamedTuple

import numpy as np
import shapely

from hpgr.bed.geometry import Geometry

_OUTLINE = 512  # chords of the outermost streamline; it is convex near the gap, so none cuts off a point there
_CLOSED = 1e-9  # of the domain's area, to which the cells must sum


class Tessellation(NamedTuple):
    """Voronoi cells of the material points, numbered streamline by streamline, entry to exit."""

    volume: np.ndarray  # (streamline, point) area of each cell, m2: volume per unit roll width
    pairs: np.ndarray  # (edge, 2) numbers of the two points an edge lies between, the lower point first
    length: np.ndarray  # (edge,) length of the edge within the bed, m
    normal: np.ndarray  # (edge, 2) unit normal from the first to the second point; its y is never negative
    distance: np.ndarray  # (edge,) between the two points, m
    cells: np.ndarray  # (streamline x point,) of shapely.Polygon
    domain: shapely.Polygon  # the bed: mid-plane, outermost streamline, entry and exit rows


def tessellate(geometry: Geometry, x: np.ndarray, y: np.ndarray, rim: np.ndarray) -> Tessellation:
    """Return the Voronoi cells of material points (streamline, point), m, clipped to the bed.

    `rim` holds the heights of the entry row on the mid-plane and on the outermost streamline, m. ValueError if the
    cells do not tile the bed to 1e-9 of its area, or a point has no cell: the points lie too close together for double
    precision.
    """
    points = np.column_stack([x.ravel(), y.ravel()])
    try:
        domain = _domain(geometry, x, y, rim)
        whole = _voronoi(points, domain)
        pairs, ends = _shared_edges(whole)
        length = _length_within(domain, ends)
        cells = _clipped(domain, whole)
    except shapely.errors.GEOSException:  # in words of its own, such as TopologyException
        raise ValueError(_lost("their cells cannot be told apart", len(points))) from None
    kept = length > 0
    pairs, length = pairs[kept], length[kept]
    volume = shapely.area(cells)
    excess = abs(volume.sum() / domain.area - 1)
    if not excess <= _CLOSED or not (volume > 0).all():
        raise ValueError(_lost(f"the cells miss the bed's area by {excess:.1e}", len(points)))
    step = points[pairs[:, 1]] - points[pairs[:, 0]]
    upward = step[:, 1] < 0
    pairs[upward] = pairs[upward, ::-1]
    step[upward] *= -1
    distance = np.hypot(*step.T)
    return Tessellation(volume.reshape(x.shape), pairs, length, step / distance[:, None], distance, cells, domain)


def _domain(geometry: Geometry, x: np.ndarray, y: np.ndarray, rim: np.ndarray) -> shapely.Polygon:
    """Return the bed as a polygon: up the mid-plane, along the entry row, down the outermost streamline."""
    # heights graded as the cube towards the gap, where the bed is narrow
    heights = rim[1] * np.linspace(1.0, 0.0, _OUTLINE + 1) ** 3
    outer = np.column_stack([geometry.outer(heights), heights])
    entry = np.column_stack([x[:, 0], y[:, 0]])
    return shapely.Polygon(np.concatenate([[[0.0, 0.0], [0.0, rim[0]]], entry, outer]))


def _voronoi(points: np.ndarray, domain: shapely.Polygon) -> np.ndarray:
    """Return the Voronoi cells of the points, in their order, beyond the domain."""
    around = domain.buffer(0.1 * domain.length)
    cells = shapely.get_parts(shapely.voronoi_polygons(shapely.multipoints(points), extend_to=around, ordered=True))
    if cells.size != len(points):
        raise ValueError(_lost(f"{len(points) - cells.size} of {len(points)} points have no cell", len(points)))
    return cells


def _shared_edges(cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return pairs of cells and the end points (edge, 2, 2) of the edge between them.

    Neighbours share their corners bit for bit: each is one circumcentre.
    """
    corners, owner = shapely.get_coordinates(cells, return_index=True)
    same = owner[1:] == owner[:-1]
    start, end, owner = corners[:-1][same], corners[1:][same], owner[1:][same]
    _, number = np.unique(np.concatenate([start, end]), axis=0, return_inverse=True)
    first, second = number[: len(start)], number[len(start) :]
    key = np.minimum(first, second) * np.int64(number.max() + 1) + np.maximum(first, second)
    order = np.argsort(key, kind="stable")
    twin = np.flatnonzero(key[order][1:] == key[order][:-1])
    one, other = order[twin], order[twin + 1]
    return np.column_stack([owner[one], owner[other]]), np.stack([start[one], end[one]], axis=1)


def _length_within(domain: shapely.Polygon, ends: np.ndarray) -> np.ndarray:
    """Return the length of each edge inside the domain."""
    lines = shapely.linestrings(ends)
    shapely.prepare(domain)
    cut = ~shapely.contains_properly(domain, lines)  # 6,000 edges: clipping those alone takes 2 of 60 ms
    lines[cut] = shapely.intersection(lines[cut], domain)
    return shapely.length(lines)


def _clipped(domain: shapely.Polygon, cells: np.ndarray) -> np.ndarray:
    cells = cells.copy()
    cut = ~shapely.contains_properly(domain, cells)
    cells[cut] = shapely.intersection(cells[cut], domain)
    return cells


def _lost(what: str, points: int) -> str:
    return (
        f"resolution.points: got {points} points on all streamlines; tessellation: {what}; "
        "the material points lie too close together for double precision; "
        "use fewer streamlines or points, or a larger flow.entry_fraction"
    )
