import itertools
import math

import numpy as np
import pytest
import shapely
from support import paper

from hpgr.bed import kinematics, tessellation
from hpgr.bed.loaded import inputs_of, load_bed

# (gap, streamlines, points): from 1 um to 10 m, from one cell across or two along to many
BEDS = [(1e-6, 1, 2), (1e-6, 10, 40), (1e-4, 40, 10), (0.06, 1, 200), (0.06, 3, 21), (1.0, 2, 3), (10.0, 200, 2)]
each = pytest.mark.parametrize(("gap", "streamlines", "points"), BEDS)


def scene_of(gap=0.06, streamlines=3, points=21):
    """A bed whose rolls stay as curved as the paper's, with grains small enough to enter."""
    rolls = {"rolls.gap": gap, "rolls.entry_gap": gap + 1.08}
    return paper(rolls | {"resolution.streamlines": streamlines, "resolution.points": points})


def laid(scene):
    """Geometry, x and y of the points, and the heights of the entry row on mid-plane and roll."""
    inputs = inputs_of(scene)
    bed = load_bed(inputs)
    edges = bed.geometry._replace(xi=np.array([0.0, 1.0]))
    rim, _ = kinematics.move(edges, inputs.laws()[0], inputs.surface_speed, inputs.points)
    return bed.geometry, bed.geometry.x(bed.kinematics.y), bed.kinematics.y, rim.y[:, 0]


def tiled(scene):
    """Points (streamline x point, 2) and their tessellation."""
    bed = load_bed(inputs_of(scene, tessellated=True))
    x, y = bed.geometry.x(bed.kinematics.y), bed.kinematics.y
    return np.column_stack([x.ravel(), y.ravel()]), bed.tessellation


def clipped_bisectors(points, domain):
    """Lengths of the edges by their definition: the bisector of two points, cut by all other bisectors and the bed.

    Coordinates are relative to the middle of each pair, where nothing cancels.
    """
    found = {}
    for i, j in itertools.combinations(range(len(points)), 2):
        middle, step = (points[i] + points[j]) / 2, points[j] - points[i]
        along = np.array([-step[1], step[0]]) / math.hypot(*step)
        others = np.delete(points, [i, j], axis=0)
        # middle + t along is at least as close to i as to k: t a <= b
        a = (others - points[i]) @ along
        b = ((others - points[i]) * (others + points[i] - 2 * middle)).sum(axis=1) / 2
        with np.errstate(divide="ignore", invalid="ignore"):
            cut = b / a
        if (b[a == 0] < 0).any():
            continue
        last, first = cut[a > 0].min(initial=20.0), cut[a < 0].max(initial=-20.0)
        if first < last:
            line = shapely.LineString([middle + first * along, middle + last * along])
            found[i, j] = shapely.length(shapely.intersection(line, domain))
    return found


# --- the tiling, from 1 um to 10 m -------------------------------------------------------------------------


@each
def test_cells_tile_the_bed_and_each_holds_its_point(streamlines, points, gap):
    places, found = tiled(scene_of(gap, streamlines, points))
    assert found.volume.shape == (streamlines, points)
    assert abs(found.volume.sum() / found.domain.area - 1) < 1e-9
    assert (found.volume > 0).all()
    assert np.allclose(shapely.area(found.cells).reshape(streamlines, points), found.volume, rtol=1e-12)
    # entry and exit rows lie on the rim of the bed, hence the tolerance
    assert shapely.distance(found.cells, shapely.points(places)).max() <= 1e-12 * found.domain.length
    # no other point is as close to the middle of a cell as its own
    middle = shapely.get_coordinates(shapely.point_on_surface(found.cells))
    own = np.hypot(*(middle - places).T)
    for k in range(0, len(places), max(1, len(places) // 50)):
        assert own[k] <= np.hypot(*(middle[k] - places).T).min() * (1 + 1e-9)


@each
def test_edges_are_unique_and_point_upwards(streamlines, points, gap):
    places, found = tiled(scene_of(gap, streamlines, points))
    lower, upper = found.pairs.T
    assert (lower != upper).all()
    assert len({frozenset(pair) for pair in found.pairs.tolist()}) == len(found.pairs)
    assert found.pairs.min() >= 0
    assert found.pairs.max() < len(places)
    step = places[upper] - places[lower]
    assert (step[:, 1] >= 0).all()
    assert (found.normal[:, 1] >= 0).all()
    assert np.allclose(np.hypot(*found.normal.T), 1, rtol=1e-12)
    assert np.allclose(found.distance, np.hypot(*step.T), rtol=1e-12)
    assert np.allclose(found.normal * found.distance[:, None], step, rtol=1e-12, atol=0)
    assert (found.length > 0).all()
    # every point has a neighbour, and all hang together: cells can get from any point to any other
    linked = np.arange(len(places))
    for _ in range(len(places)):
        before = linked.copy()
        np.minimum.at(linked, lower, linked[upper])
        np.minimum.at(linked, upper, linked[lower])
        if np.array_equal(linked, before):
            break
    assert (linked == 0).all()


@pytest.mark.parametrize(
    ("gap", "streamlines", "points"), [(1e-6, 6, 10), (1e-4, 1, 30), (0.06, 3, 21), (1.0, 2, 3), (10.0, 20, 3)]
)
def test_edges_are_the_bisectors_cut_by_all_others_and_the_bed(streamlines, points, gap):
    places, found = tiled(scene_of(gap, streamlines, points))
    wanted = clipped_bisectors(places, found.domain)
    lengths = {tuple(sorted(pair)): length for pair, length in zip(found.pairs.tolist(), found.length, strict=True)}
    for pair in wanted.keys() | lengths.keys():
        # rounding of a circumcentre moves an end by about an ulp of the bed's size per angle between bisectors
        assert abs(lengths.get(pair, 0.0) - wanted.get(pair, 0.0)) < 1e-9 * found.domain.length


# --- by hand -----------------------------------------------------------------------------------------------


def test_squares_by_hand():
    """Squares of side 1, points (i + 1/2, j), the lowest row on the exit and the entry row on the top of a duct."""
    x, y = np.meshgrid(np.arange(3) + 0.5, np.arange(3, -1, -1.0), indexing="ij")
    duct = laid(scene_of())[0]._replace(half_gap=3.0, b=0.0, c=0.0, height=4.0)
    found = tessellation.tessellate(duct, x, y, np.array([3.0, 3.0]))
    assert np.allclose(found.volume, [[0.5, 1, 1, 0.5]] * 3, rtol=1e-12)
    assert found.domain.area == pytest.approx(9, rel=1e-12)
    # points are numbered streamline by streamline from the entry, row 3, to the exit, row 0
    sides = {(4 * i + j, 4 * (i + 1) + j): 0.5 if j in (0, 3) else 1.0 for i in range(2) for j in range(4)}
    heights = {(4 * i + j + 1, 4 * i + j): 1.0 for i in range(3) for j in range(3)}
    by_pair = {tuple(pair): k for k, pair in enumerate(found.pairs.tolist())}
    for pair, length in sides.items():
        k = by_pair[pair if pair in by_pair else pair[::-1]]
        assert found.length[k] == pytest.approx(length, rel=1e-12)
        assert abs(found.normal[k]) == pytest.approx([1, 0], abs=1e-12)
    for pair, length in heights.items():  # the lower point first
        k = by_pair[pair]
        assert found.length[k] == pytest.approx(length, rel=1e-12)
        assert found.normal[k] == pytest.approx([0, 1], abs=1e-12)
    assert np.allclose(found.distance, 1)
    assert len(by_pair) == len(sides) + len(heights)  # cells that meet in a corner share no edge


def test_domain_is_the_bed():
    """Area between mid-plane and X(y), above the exit and below the entry row, to the outline's 512 chords."""
    scene = scene_of(0.06, 10, 40)
    bed, x, y, rim = laid(scene)
    _, found = tiled(scene)

    def area_below(height):
        return bed.half_gap * height + bed.b * height**3 / 3 + bed.c * height**4 / 4

    top = np.concatenate([[rim[0]], y[:, 0], [rim[1]]])
    across = np.concatenate([[0.0], x[:, 0], [bed.outer(rim[1])]])
    above = np.sum((top[1:] + top[:-1] - 2 * rim[1]) / 2 * np.diff(across))  # the entry row dips towards the roll
    assert found.domain.area == pytest.approx(area_below(rim[1]) + above, rel=1e-5)
    low_x, low_y, high_x, high_y = found.domain.bounds
    assert (low_x, low_y) == (0, 0)
    assert high_x == pytest.approx(bed.outer(rim[1]), rel=1e-12)
    assert high_y == pytest.approx(rim[0], rel=1e-12)


# --- refused -----------------------------------------------------------------------------------------------


def test_points_that_coincide_are_refused():
    bed, x, y, rim = laid(scene_of())
    x[1, 7], y[1, 7] = x[0, 7], y[0, 7]
    with pytest.raises(ValueError, match=r"tessellation: .* lie too close together .* use fewer streamlines"):
        tessellation.tessellate(bed, x, y, rim)


def test_points_outside_the_bed_are_refused():
    bed, x, y, rim = laid(scene_of())
    x[2, 7] += 3.0
    with pytest.raises(ValueError, match="tessellation: the cells miss the bed's area"):
        tessellation.tessellate(bed, x, y, rim)


def test_lost_points_are_refused(monkeypatch):
    """GEOS merges points that are one to it: the tessellation counts."""
    whole = shapely.voronoi_polygons
    lossy = lambda points, **wishes: whole(shapely.multipoints(shapely.get_parts(points)[:-2]), **wishes)  # noqa: E731
    monkeypatch.setattr(tessellation.shapely, "voronoi_polygons", lossy)
    with pytest.raises(ValueError, match=r"tessellation: 2 of 63 points have no cell; .* use fewer streamlines"):
        tiled(scene_of())


def test_a_gap_below_double_precision_is_refused_or_tiled():
    """At some gap, neighbours on the exit row are one point to GEOS: an error, never a silent hole."""
    outcomes = set()
    for gap in 10.0 ** -np.arange(8, 21, 2):
        narrow = inputs_of(scene_of(0.06, 50, 5), tessellated=True)._replace(gap=float(gap))  # refused by a scene
        try:
            found = load_bed(narrow).tessellation
        except ValueError as error:
            outcomes.add(str(error).split("; ")[2])
        else:
            assert abs(found.volume.sum() / found.domain.area - 1) < 1e-9
            assert (found.volume > 0).all()
            outcomes.add("tiled")
    assert outcomes - {"tiled"} == {"the material points lie too close together for double precision"}
