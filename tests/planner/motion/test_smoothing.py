import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from athlete_twin.errors import PlanningError
from planner.motion.sbl import SblConfig, plan_sbl
from planner.motion.smoothing import SmoothingConfig, path_length, smooth

RADIUS = 0.3
CENTRE = np.array([0.5, 0.5])


def around_disc(q: np.ndarray) -> bool:
    return bool(np.linalg.norm(q - CENTRE) > RADIUS)


def shortest_around_disc(a: np.ndarray, b: np.ndarray) -> float:
    """Closed form: two tangents and an arc."""
    da, db = np.linalg.norm(a - CENTRE), np.linalg.norm(b - CENTRE)
    between = np.arccos(np.dot(a - CENTRE, b - CENTRE) / (da * db))
    arc = between - np.arccos(RADIUS / da) - np.arccos(RADIUS / db)
    return float(np.sqrt(da**2 - RADIUS**2) + np.sqrt(db**2 - RADIUS**2) + RADIUS * arc)


def samples(path: np.ndarray, step: float = 0.01) -> np.ndarray:
    parts = [np.linspace(a, b, 2 + int(np.linalg.norm(b - a) / step)) for a, b in itertools.pairwise(path)]
    return np.concatenate(parts)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_smoothing_keeps_the_ends_stays_free_and_never_lengthens(seed):
    start, goal = np.array([0.05, 0.1]), np.array([0.95, 0.9])
    rng = np.random.default_rng(seed)
    raw = plan_sbl(start, goal, np.zeros(2), np.ones(2), around_disc, rng, SblConfig())
    smoothed = smooth(raw, around_disc, SmoothingConfig())
    np.testing.assert_array_equal(smoothed.waypoints[[0, -1]], [start, goal])
    assert all(later <= earlier + 1e-12 for earlier, later in itertools.pairwise(smoothed.lengths))
    assert smoothed.lengths[-1] == pytest.approx(path_length(smoothed.waypoints))
    # An edge may cut a corner of the disc between two checked points: sagitta of a chord of one resolution.
    depth = RADIUS - np.linalg.norm(samples(smoothed.waypoints) - CENTRE, axis=1)
    assert depth.max() <= 0.01**2 / (8 * RADIUS) + 1e-4


def test_smoothing_comes_within_a_tenth_of_the_shortest_way():
    start, goal = np.array([0.05, 0.1]), np.array([0.95, 0.9])
    best = shortest_around_disc(start, goal)
    for seed in range(6):
        rng = np.random.default_rng(seed)
        raw = plan_sbl(start, goal, np.zeros(2), np.ones(2), around_disc, rng, SblConfig())
        smoothed = smooth(raw, around_disc, SmoothingConfig())
        assert best - 1e-3 <= smoothed.lengths[-1] <= 1.1 * best


def test_the_first_round_is_dijkstra_over_all_free_edges():
    """Against every subset of the inner nodes."""
    rng = np.random.default_rng(4)
    raw = plan_sbl(
        np.array([0.05, 0.1]), np.array([0.95, 0.9]), np.zeros(2), np.ones(2), around_disc, rng, SblConfig()
    )
    raw = raw[:: max(1, len(raw) // 9)] if len(raw) > 12 else raw
    fine = lambda a, b: all(around_disc(q) for q in np.linspace(a, b, 50))  # noqa: E731
    legal = lambda p: all(fine(a, b) for a, b in itertools.pairwise(p))  # noqa: E731
    if not legal(raw):
        pytest.skip("the thinned path is no path")
    lengths = []
    for k in range(len(raw) - 1):
        for inner in itertools.combinations(range(1, len(raw) - 1), k):
            chain = raw[[0, *inner, len(raw) - 1]]
            if legal(chain):
                lengths.append(path_length(chain))
    once = smooth(raw, around_disc, SmoothingConfig(max_rounds=1))
    assert once.lengths[-1] == pytest.approx(min(lengths))


def test_an_open_room_leaves_the_straight_line():
    zigzag = np.array([[0.0, 0.0], [0.3, 0.9], [0.6, 0.1], [1.0, 1.0]])
    smoothed = smooth(zigzag, lambda q: True, SmoothingConfig())
    np.testing.assert_array_equal(smoothed.waypoints, zigzag[[0, -1]])


def test_edges_are_checked_once():
    seen = []
    zigzag = np.array([[0.0, 0.0], [0.3, 0.9], [0.6, 0.1], [1.0, 1.0]])

    def counted(q):
        seen.append(tuple(np.round(q, 12)))
        return around_disc(q)

    smoothed = smooth(zigzag, counted, SmoothingConfig())
    assert smoothed.checks == len(seen)


def test_a_path_of_one_node_is_refused():
    with pytest.raises(PlanningError, match="k >= 2"):
        smooth(np.zeros((1, 3)), around_disc, SmoothingConfig())
    with pytest.raises(PlanningError, match="positive settings"):
        SmoothingConfig(resolution=0.0)
