"""Blended paths against what they are made of: distance from the polyline, closed forms, finite differences."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from athlete_twin.errors import KinematicsError
from athlete_twin.geometry.blended_path import SAME, blended

TOLERANCE = 0.01


def polyline(seed: int, *, count: int, scale: float, dof: int = 6) -> np.ndarray:
    return scale * np.random.default_rng(seed).standard_normal((count, dof))


def distance_to_polyline(points: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """Brute force: every point to every edge."""
    best = np.full(len(points), np.inf)
    for a, b in itertools.pairwise(nodes):
        span = b - a
        along = np.clip((points - a) @ span / max(float(span @ span), 1e-300), 0.0, 1.0)
        best = np.minimum(best, np.linalg.norm(points - a - along[:, None] * span, axis=1))
    return best


paths = st.fixed_dictionaries(
    {"seed": st.integers(0, 2**32 - 1), "count": st.integers(2, 12), "scale": st.sampled_from([1e-4, 3e-3, 0.02, 0.3, 1.5])}
)


@settings(max_examples=60, deadline=None)
@given(path=paths, tolerance=st.sampled_from([0.0, 1e-3, TOLERANCE]))
def test_the_path_stays_by_the_polyline_and_passes_all_way_points(path, tolerance):
    nodes = polyline(**path)
    cut = blended(nodes, tolerance)
    points = cut.at(np.linspace(0.0, cut.length, 4001))
    assert distance_to_polyline(points, nodes).max() <= tolerance + 1e-12
    spacing = cut.length / 4000
    for node in nodes:
        assert np.linalg.norm(points - node, axis=1).min() <= tolerance + spacing
    np.testing.assert_allclose(points[[0, -1]], nodes[[0, -1]], atol=1e-12)
    np.testing.assert_array_equal(cut.end, nodes[-1])


@settings(max_examples=40, deadline=None)
@given(path=paths)
def test_position_and_direction_are_continuous_where_the_path_does_not_stop(path):
    cut = blended(polyline(**path), TOLERANCE)
    lengths = np.diff(cut.knots)[:, None]
    ends = cut.origins + lengths * (cut.directions + 0.5 * lengths * cut.bends)
    turned = cut.directions + lengths * cut.bends
    np.testing.assert_allclose(ends[:-1], cut.origins[1:], atol=1e-12)
    np.testing.assert_allclose(turned[:-1], cut.directions[1:], atol=1e-9)
    np.testing.assert_array_equal(cut.stops, [True, *[False] * (len(cut.stops) - 2), True])


def test_a_right_angle_is_cut_by_the_parabola_of_the_closed_form():
    """Between points at equal distance from the corner a parabola is half as near to it as their chord."""
    cut = blended(np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]]), TOLERANCE)
    width = cut.knots[2] - cut.knots[1]
    ((corner, blend),) = cut.blends(0.002)
    assert corner == 1 and len(blend) % 2 == 1
    assert np.linalg.norm(blend[len(blend) // 2] - [1.0, 0.0]) == pytest.approx(TOLERANCE)
    assert 0.5 * width == pytest.approx(2.0 * np.sqrt(2.0) * TOLERANCE)
    x, y = 1.0 - blend[:, 0], blend[:, 1]
    np.testing.assert_allclose(np.sqrt(x) + np.sqrt(y), np.sqrt(0.5 * width), atol=1e-9)  # its equation between the two lines
    assert np.linalg.norm(np.diff(blend, axis=0), axis=1).max() <= 0.002


def test_short_pieces_are_cut_by_half_of_themselves_at_most():
    cut = blended(np.array([[0.0, 0.0], [0.004, 0.0], [0.004, 1.0]]), TOLERANCE)
    assert cut.knots[1] == pytest.approx(0.002) and cut.knots[2] - cut.knots[1] == pytest.approx(0.004)


def test_way_points_that_repeat_or_lie_on_the_line_change_nothing():
    nodes = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]])
    plain = blended(nodes, TOLERANCE)
    again = blended(np.array([nodes[0], nodes[0], nodes[1], nodes[1] + 0.5 * SAME, [1.0, 0.5], nodes[2], nodes[2]]), TOLERANCE)
    s = np.linspace(0.0, plain.length, 500)
    np.testing.assert_allclose(again.at(s), plain.at(s), atol=2.0 * SAME)
    assert not again.stops[1:-1].any()
    assert [corner for corner, _ in again.blends(0.002)] == [2]


@pytest.mark.parametrize("nodes", [[[0.3, 0.1]], [[0.3, 0.1], [0.3, 0.1]], [[0.3, 0.1], [0.3, 0.1 + 0.5 * SAME]]])
def test_a_path_of_one_place_has_no_pieces(nodes):
    cut = blended(np.array(nodes), TOLERANCE)
    assert cut.length == 0.0 and len(cut.origins) == 0


def test_turning_right_round_and_corners_without_tolerance_are_stops():
    back = blended(np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 0.0]]), TOLERANCE)
    np.testing.assert_array_equal(back.stops, [True, True, True])
    assert blended(np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]]), 0.0).stops.all()
    assert not back.blends(0.002)


@pytest.mark.parametrize("nodes", [np.zeros((0, 6)), np.full((2, 6), np.nan)])
def test_way_points_that_are_none_are_refused(nodes):
    with pytest.raises(KinematicsError, match="needs finite way-points of shape"):
        blended(nodes, TOLERANCE)


@pytest.mark.parametrize("tolerance", [-0.1, np.nan, np.inf])
def test_a_tolerance_that_is_none_is_refused(tolerance):
    with pytest.raises(KinematicsError, match="must be finite and not negative"):
        blended(np.zeros((2, 6)), tolerance)
