import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from athlete_twin.errors import SupportError
from athlete_twin.geometry.polygon import (
    area,
    conservative_distance,
    conservative_distances,
    convex_hull,
    intersect_convex,
    signed_distance,
    signed_distances,
)

MICROMETRE = 1e-6
SQUARE = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [0.0, 2.0]])
coordinates = st.floats(-3.0, 3.0, allow_nan=False).map(lambda v: round(v, 3))
clouds = st.lists(st.tuples(coordinates, coordinates), min_size=3, max_size=8, unique=True).map(np.array)


def _distance_by_sampling(point: np.ndarray, corners: np.ndarray) -> float:
    """Unsigned distance to the border, walking along it."""
    hull = corners[convex_hull(corners)]
    t = np.linspace(0.0, 1.0, 4001)[:, None]
    border = np.concatenate([a + t * (b - a) for a, b in zip(hull, np.roll(hull, -1, axis=0), strict=True)])
    return float(np.linalg.norm(border - point, axis=1).min())


def test_distance_is_positive_inside_zero_on_the_border_and_negative_outside():
    assert signed_distance(np.array([0.5, 1.0]), SQUARE) == pytest.approx(0.5)
    assert signed_distance(np.array([2.0, 1.0]), SQUARE) == pytest.approx(0.0)
    assert signed_distance(np.array([3.0, 3.0]), SQUARE) == pytest.approx(-np.sqrt(2.0))


def test_order_of_corners_and_points_inside_do_not_matter():
    shuffled = np.vstack([SQUARE[[2, 0, 3, 1]], [[1.0, 1.2]], [[1.0, 0.0]]])
    assert signed_distance(np.array([0.7, 1.0]), shuffled) == pytest.approx(0.7)


def test_points_on_one_line_have_no_inside():
    line = np.array([[0.0, 0.0], [1.0, 1.0], [3.0, 3.0]])
    assert signed_distance(np.array([2.0, 2.0]), line) == pytest.approx(0.0, abs=MICROMETRE)
    assert signed_distance(np.array([1.0, 0.0]), line) == pytest.approx(-np.sqrt(0.5))
    assert signed_distance(np.array([4.0, 4.0]), line) == pytest.approx(-np.sqrt(2.0))
    assert signed_distance(np.array([1.0, 0.0]), np.zeros((3, 2))) == pytest.approx(-1.0)


@settings(max_examples=60, deadline=None)
@given(clouds)
def test_hull_has_the_area_and_corners_of_qhull(cloud):
    if np.linalg.matrix_rank(cloud - cloud[0], tol=1e-2) < 2:
        return
    ours, theirs = convex_hull(cloud), ConvexHull(cloud)
    assert area(cloud[ours]) == pytest.approx(theirs.volume, abs=1e-6)
    assert set(ours) <= set(theirs.vertices)


@settings(max_examples=60, deadline=None)
@given(clouds, coordinates, coordinates)
def test_distance_equals_a_walk_along_the_border(cloud, x, y):
    point = np.array([x, y])
    value = signed_distance(point, cloud)
    assert abs(value) == pytest.approx(_distance_by_sampling(point, cloud), abs=2e-3)
    if np.linalg.matrix_rank(cloud - cloud[0], tol=1e-2) == 2:
        beyond = ConvexHull(cloud).equations @ [x, y, 1.0]
        assert (value > 1e-6) == bool((beyond < -1e-6).all())


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(coordinates, coordinates), min_size=4, max_size=6, unique=True).map(np.array), st.floats(0, 6.28))
def test_distances_are_invariant_under_rotation(cloud, angle):
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, -s], [s, c]])
    point = cloud.mean(axis=0) + 0.05
    assert signed_distance(turn @ point, cloud @ turn.T) == pytest.approx(signed_distance(point, cloud), abs=1e-6)
    before = conservative_distance(point, cloud)
    assert conservative_distance(turn @ point, cloud @ turn.T) == pytest.approx(before, abs=1e-6)


@settings(max_examples=40, deadline=None)
@given(st.lists(st.floats(0.6, 1.6), min_size=6, max_size=6), coordinates, coordinates)
def test_conservative_distance_inside_is_the_distance_to_the_clipped_polygon(radii, x, y):
    angles = np.deg2rad(60.0 * np.arange(6))
    cloud = np.array(radii)[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])
    clipped = None
    for removed in range(6):
        rest = np.delete(cloud, removed, axis=0)
        hull = rest[convex_hull(rest)]
        clipped = hull if clipped is None else intersect_convex(clipped, hull)
    point = 0.2 * np.array([x, y])
    value = conservative_distance(point, cloud)
    if value > 1e-3:
        assert signed_distance(point, clipped) == pytest.approx(value, abs=1e-6)
    elif len(clipped) >= 3:
        assert signed_distance(point, clipped) <= 1e-3


def test_batches_equal_single_calls():
    rng = np.random.default_rng(3)
    points, corners = rng.normal(size=(50, 2)), rng.normal(size=(50, 6, 2))
    assert np.array_equal(
        signed_distances(points, corners), [signed_distance(p, c) for p, c in zip(points, corners, strict=True)]
    )
    assert np.array_equal(
        conservative_distances(points, corners),
        [conservative_distance(p, c) for p, c in zip(points, corners, strict=True)],
    )


def test_clipping_disjoint_polygons_leaves_nothing():
    assert len(intersect_convex(SQUARE, SQUARE + 5.0)) == 0
    assert area(intersect_convex(SQUARE, SQUARE + 0.5)) == pytest.approx(1.5**2)


def test_a_corner_that_is_not_finite_is_refused():
    with pytest.raises(SupportError, match="finite"):
        signed_distance(np.zeros(2), np.array([[0.0, np.nan], [1.0, 1.0]]))
    with pytest.raises(SupportError, match="row by row"):
        signed_distances(np.zeros((3, 2)), np.zeros((2, 4, 2)))
