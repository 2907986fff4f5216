"""Routes over grids of paces: against closed forms and a second implementation of shortest paths."""

import heapq

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.sparse import csgraph

from athlete_twin.errors import PlanningError
from planner.route.places import Places
from planner.route.search import NoRoute, Route, find_route, time_graph

CELL = 0.2
WALK, DRIVE, START = 500.0, 2.0, 60.0


def grid(walk: np.ndarray, drive: np.ndarray | None = None) -> Places:
    shape = walk.shape
    return Places(
        origin=np.zeros(2), cell=CELL, walk=walk, drive=np.full(shape, np.inf) if drive is None else drive,
        drive_start=START, refusal=np.where(np.isfinite(walk), 0, 1).astype(np.uint8), leg=np.full(shape, 2, np.int8),
    )  # fmt: skip


def at(ix: float, iy: float) -> np.ndarray:
    return CELL * np.array([ix, iy], dtype=float)


@given(st.integers(0, 59), st.integers(0, 39), st.floats(-0.09, 0.09), st.floats(-0.09, 0.09))
def test_on_an_empty_map_the_route_is_the_straight_line_at_the_open_grounds_pace(ix, iy, dx, dy):
    start, goal = at(30, 20), at(ix, iy) + [dx, dy]
    length = float(np.linalg.norm(goal - start))
    if length < 0.02:
        return
    route = find_route(grid(np.full((60, 40), WALK)), start, goal)
    assert isinstance(route, Route)
    assert route.modes == ("walk",)
    np.testing.assert_array_equal(route.points, [start, goal])
    np.testing.assert_allclose(route.cost, WALK * length, rtol=1e-12)


def test_through_a_gap_in_a_wall_the_route_is_as_long_as_two_straight_lines():
    walk = np.full((61, 41), WALK)
    walk[30, :] = np.inf
    walk[30, 34:37] = WALK
    route = find_route(grid(walk), at(0, 10), at(60, 10))
    assert isinstance(route, Route)
    least = 2 * CELL * np.hypot(29.5, 23.5)  # by the corner of the gap's nearest free place
    assert least <= route.length < 1.03 * least
    np.testing.assert_allclose(route.cost, WALK * route.length, rtol=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_the_graphs_distances_are_those_of_a_second_dijkstra(seed):
    rng = np.random.default_rng(seed)
    walk, drive = rng.uniform(1.0, 9.0, (9, 7)), rng.uniform(0.1, 1.0, (9, 7))
    walk[rng.random((9, 7)) < 0.25] = np.inf
    drive[rng.random((9, 7)) < 0.4] = np.inf
    walk[0, 0] = 1.0
    ground = grid(walk, drive)
    ours = csgraph.dijkstra(time_graph(ground), indices=0)
    np.testing.assert_allclose(ours[: walk.size].reshape(9, 7), peer(ground)[0], rtol=1e-6)
    np.testing.assert_allclose(ours[walk.size :].reshape(9, 7), peer(ground)[1], rtol=1e-6)


def peer(ground: Places) -> tuple[np.ndarray, np.ndarray]:
    """Seconds from place (0, 0) on foot: a priority queue over both layers, every edge worked out on the spot."""
    pace = (ground.walk, ground.drive)
    best = np.full((2, *ground.shape), np.inf)
    best[0, 0, 0] = 0.0
    queue = [(0.0, 0, 0, 0)]
    moves = [(dx, dy) for dx in range(-2, 3) for dy in range(-2, 3) if abs(dx) + abs(dy) in (1, 3) or abs(dx) == abs(dy) == 1]
    while queue:
        time, layer, x, y = heapq.heappop(queue)
        if time > best[layer, x, y]:
            continue
        ahead = [(time + (START if layer == 0 else 0.0), 1 - layer, x, y)] if np.isfinite(pace[1 - layer][x, y]) else []
        for dx, dy in moves:
            # The places an edge passes: its ends, and for a knight's move the two between.
            middle = [(x + round(dx / 2 - 0.1), y + round(dy / 2 - 0.1)), (x + round(dx / 2 + 0.1), y + round(dy / 2 + 0.1))]
            passed = [(x, y), *(middle if abs(dx) + abs(dy) == 3 else []), (x + dx, y + dy)]
            if all(0 <= i < ground.shape[0] and 0 <= j < ground.shape[1] for i, j in passed):
                mean = np.mean([pace[layer][p] for p in passed])
                ahead.append((time + CELL * np.hypot(dx, dy) * mean, layer, x + dx, y + dy))
        for found in ahead:
            if found[0] < best[found[1:]]:
                best[found[1:]] = found[0]
                heapq.heappush(queue, found)
    return best[0], best[1]


@pytest.mark.parametrize("length, modes", [(1, ("walk",)), (20, ("walk", "drive", "walk"))])
def test_wheels_are_used_where_the_smooth_stretch_is_worth_the_seconds_of_starting(length, modes):
    """One place of drive saves 0.2 m x 500 s/m = 100 s less 60 s at most, two half places of it are walked: not worth it."""
    drive = np.full((41, 5), np.inf)
    drive[10 : 10 + length] = DRIVE
    route = find_route(grid(np.full((41, 5), WALK), drive), at(0, 2), at(40, 2))
    assert isinstance(route, Route)
    assert route.modes == modes
    if len(modes) == 3:
        rolled = CELL * (length - 1)
        np.testing.assert_allclose(route.cost, START + DRIVE * rolled + WALK * (8.0 - rolled), rtol=0.03)
        assert route.seconds[1] == pytest.approx(START + DRIVE * rolled)


def test_a_shut_off_goal_and_a_refused_one_say_why():
    walk = np.full((21, 11), WALK)
    walk[10, :] = np.inf
    shut = find_route(grid(walk), at(2, 5), at(18, 5))
    assert isinstance(shut, NoRoute)
    assert shut.reason == "refused places shut the goal off (no_footfall: 11, of 231)"
    refused = find_route(grid(walk), at(2, 5), at(10, 5))
    assert isinstance(refused, NoRoute)
    assert refused.reason == "the goal's place is refused: no_footfall for leg 3"


def test_look_ahead_runs_along_the_route_and_ends_at_the_goal():
    route = Route(points=np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 2.0]]), modes=("walk", "walk"), seconds=(1.0, 2.0))
    np.testing.assert_allclose(route.point_at(1.5), [1.0, 0.5])
    np.testing.assert_allclose(route.point_at(9.0), [1.0, 2.0])
    np.testing.assert_allclose(route.heading(0.5), [1.0, 0.0])
    assert route.length == 3.0


@pytest.mark.parametrize(
    "start, goal, message",
    [
        ([0.0, 0.0], [np.nan, 1.0], r"goal is \[nan  1\.\], need two finite"),
        ([np.inf, 0.0], [1.0, 1.0], r"start is \[inf  0\.\], need two finite"),
        ([1.0, 1.0], [1.0, 1.0], "has no length"),
        ([1.0, 1.0], [99.0, 1.0], "off the places"),
    ],
)
def test_ways_that_are_not_finite_have_no_length_or_leave_the_grid_are_refused_by_name(start, goal, message):
    with pytest.raises(PlanningError, match=message):
        find_route(grid(np.full((20, 20), WALK)), np.array(start), np.array(goal))


def test_paces_that_are_not_positive_are_refused():
    with pytest.raises(PlanningError, match=r"walk has a pace of 0\.0"):
        grid(np.zeros((4, 4)))
