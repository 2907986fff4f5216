"""What the executive drives is free: corners are cut only as far as nothing is in the way."""

import itertools

import numpy as np
import pytest

from athlete_twin.messages import CORNER_TOLERANCE
from athlete_twin.model.leg_timing import leg_timing
from athlete_twin.model.spec import load_spec
from planner.motion.cornering import HALVINGS, free_corner_tolerance

SPACING = 0.002
CORNER = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]])


def inside_of_corner(depth: float):
    """Something fills the inside of the angle but for a strip along both lines, `depth` wide."""
    return lambda q: bool(min(1.0 - q[0], q[1]) <= depth)


@pytest.mark.parametrize("halvings", range(HALVINGS + 1))
def test_the_tolerance_is_the_largest_of_the_halves_that_is_free(halvings):
    """The parabola passes the corner at t, so its middle is t / sqrt(2) away from both lines: the strip lets just that through."""
    tolerance = CORNER_TOLERANCE * 0.5**halvings
    free = inside_of_corner(tolerance / np.sqrt(2.0) + 1e-9)
    assert free_corner_tolerance(CORNER, [free, free], most=CORNER_TOLERANCE, spacing=SPACING) == tolerance


def test_where_nothing_is_free_but_the_polyline_the_leg_stops_at_the_corner():
    free = inside_of_corner(1e-7)
    assert free_corner_tolerance(CORNER, [free, free], most=CORNER_TOLERANCE, spacing=SPACING) == 0.0
    assert free_corner_tolerance(CORNER, [free, free], most=0.0, spacing=SPACING) == 0.0


def test_each_half_of_a_blend_must_pass_what_its_edge_must():
    asked: list[list[np.ndarray]] = [[], []]

    def asks(edge: int):
        return lambda q: asked[edge].append(q) is None

    assert free_corner_tolerance(CORNER, [asks(0), asks(1)], most=CORNER_TOLERANCE, spacing=SPACING) == CORNER_TOLERANCE
    before, after = (np.array(points) for points in asked)
    # The line through the corner that halves the angle divides what belongs to the two edges.
    assert (1.0 - before[:, 0] >= before[:, 1] - 1e-12).all() and (after[:, 1] >= 1.0 - after[:, 0] - 1e-12).all()


def test_a_leg_led_through_random_way_points_is_where_it_was_checked():
    """The planner's blends and the executive's samples are one path: every sample is on a line or between two checked points."""
    spec = load_spec("sdm_b")
    ways = 0.2 * np.random.default_rng(2).standard_normal((5, spec.dof))
    checked: list[np.ndarray] = [*ways]
    tolerance = free_corner_tolerance(ways, [lambda q: checked.append(q) is None] * 4, most=CORNER_TOLERANCE, spacing=SPACING)
    lines = [a + s * (b - a) for a, b in itertools.pairwise(ways) for s in np.linspace(0, 1, 2 + int(np.linalg.norm(b - a) / SPACING))]
    near = np.array(checked + lines)
    for q in leg_timing(spec, ways, corner_tolerance=tolerance).samples(1.0 / 24.0):
        assert np.linalg.norm(near - q, axis=1).min() <= 0.5 * SPACING + 1e-12
