import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from athlete_twin.errors import PlanningError
from planner.motion.checker import JOINT_LIMITS, CountingChecker
from planner.motion.planners import METHODS, plan
from planner.motion.sbl import NoPath, SblConfig, check_problem, plan_sbl
from planner.motion.sbl_ompl import sbl_in_ompl

RESOLUTION = 0.01
LOWER, UPPER = np.zeros(2), np.ones(2)
START, GOAL = np.array([0.1, 0.1]), np.array([0.9, 0.9])


def through_gap(q: np.ndarray) -> bool:
    """A wall of 0.2 with a passage of 0.06: 1.2 % of the box."""
    return not (0.4 < q[0] < 0.6 and not 0.27 < q[1] < 0.33)


def enclosed(q: np.ndarray) -> bool:
    """The goal sits in a closed ring."""
    return not 0.1 < np.abs(q - GOAL).max() < 0.15


def assert_path_is_free(path: np.ndarray, is_free, gap: float = RESOLUTION) -> None:
    """Every edge, at 20 times the planner's resolution, allowing nothing thinner than the resolution to hide."""
    for a, b in itertools.pairwise(path):
        n = max(2, int(np.ceil(np.linalg.norm(b - a) / gap * 20)))
        hits = [not is_free(a + s * (b - a)) for s in np.linspace(0, 1, n)]
        longest = run = 0
        for hit in hits:
            run = run + 1 if hit else 0
            longest = max(longest, run)
        assert longest * gap / 20 <= gap


@pytest.mark.parametrize("seed", range(5))
def test_sbl_finds_the_narrow_passage_and_its_edges_hold(seed):
    path = plan_sbl(START, GOAL, LOWER, UPPER, through_gap, np.random.default_rng(seed), SblConfig())
    assert isinstance(path, np.ndarray)
    np.testing.assert_array_equal(path[0], START)
    np.testing.assert_array_equal(path[-1], GOAL)
    assert_path_is_free(path, through_gap)


@pytest.mark.parametrize("connect_distance", [0.2, np.inf])
def test_sbl_gives_up_on_an_enclosed_goal_within_its_budget(connect_distance):
    calls = []

    def counted(q):
        calls.append(1)
        return enclosed(q)

    config = SblConfig(max_checks=1500, connect_distance=connect_distance)
    answer = plan_sbl(START, GOAL, LOWER, UPPER, counted, np.random.default_rng(0), config)
    assert isinstance(answer, NoPath)
    assert answer.reason == "budget" and "1500 checks" in answer.detail
    assert len(calls) == answer.checks == 1500


def test_ends_in_collision_are_named():
    blocked = lambda q: q[0] < 0.5  # noqa: E731
    rng = np.random.default_rng(0)
    assert plan_sbl(START, GOAL, LOWER, UPPER, blocked, rng, SblConfig()).reason == "goal_collides"
    assert plan_sbl(GOAL, START, LOWER, UPPER, blocked, rng, SblConfig()).reason == "start_collides"


def test_a_goal_outside_the_box_is_refused():
    with pytest.raises(PlanningError, match=r"goal .* is outside the box"):
        plan_sbl(START, GOAL + 1, LOWER, UPPER, through_gap, np.random.default_rng(0), SblConfig())
    with pytest.raises(PlanningError, match="one shape"):
        check_problem(START, np.zeros(3), LOWER, UPPER)
    with pytest.raises(PlanningError, match="must be positive"):
        SblConfig(resolution=0.0)
    with pytest.raises(PlanningError, match="at least 1"):
        SblConfig(max_checks=0)


def test_an_open_room_costs_no_milestone():
    path = plan_sbl(START, GOAL, LOWER, UPPER, lambda q: True, np.random.default_rng(0), SblConfig())
    np.testing.assert_array_equal(path, [START, GOAL])


@settings(max_examples=12, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), dof=st.integers(1, 7))
def test_sbl_passes_random_balls_in_any_dimension(seed, dof):
    """Start and goal are kept clear of the balls, and no ball can close off a corner of the box."""
    rng = np.random.default_rng(seed)
    centres = rng.uniform(0.35, 0.65, (3, dof))
    is_free = lambda q: bool((np.linalg.norm(centres - q, axis=1) > 0.12).all()) or dof == 1  # noqa: E731
    start, goal = np.full(dof, 0.05), np.full(dof, 0.95)
    path = plan_sbl(start, goal, np.zeros(dof), np.ones(dof), is_free, rng, SblConfig())
    assert isinstance(path, np.ndarray)
    assert_path_is_free(path, is_free)


@pytest.mark.parametrize("method", METHODS)
def test_every_planner_answers_alike_and_repeats_itself(method):
    config = SblConfig(max_checks=30_000)
    wide = lambda q: not (0.4 < q[0] < 0.6 and not 0.2 < q[1] < 0.5)  # noqa: E731
    paths = [
        plan(method, START, GOAL, LOWER, UPPER, wide, np.random.default_rng(seed), config) for seed in (7, 8, 7)
    ]
    assert all(isinstance(p, np.ndarray) for p in paths)
    np.testing.assert_array_equal(paths[0], paths[2])
    assert paths[0].shape != paths[1].shape or (paths[0] != paths[1]).any()
    assert_path_is_free(paths[0], wide)
    np.testing.assert_allclose(paths[0][[0, -1]], [START, GOAL])


@pytest.mark.parametrize("method", METHODS)
def test_every_planner_gives_up_on_an_enclosed_goal(method):
    answer = plan(
        method, START, GOAL, LOWER, UPPER, enclosed, np.random.default_rng(0), SblConfig(max_checks=800)
    )
    assert isinstance(answer, NoPath) and answer.reason == "budget"
    assert answer.checks <= 800 + 2


@pytest.mark.parametrize("method", METHODS)
def test_every_planner_names_an_end_in_collision(method):
    rng = np.random.default_rng(0)
    answer = plan(method, START, GOAL, LOWER, UPPER, lambda q: q[0] < 0.5, rng, SblConfig())
    assert isinstance(answer, NoPath) and answer.reason == "goal_collides"


def test_an_unknown_planner_is_refused_with_the_known_ones():
    with pytest.raises(PlanningError, match="known: sbl, rrtconnect"):
        plan("prm", START, GOAL, LOWER, UPPER, through_gap, np.random.default_rng(0), SblConfig())


@pytest.mark.parametrize("passable", ["open", "enclosed"])
def test_sbl_works_as_a_planner_of_ompl(passable):
    from ompl import base as ob
    from ompl import util as ou

    ou.noOutputHandler()
    is_free = {"open": through_gap, "enclosed": enclosed}[passable]
    space = ob.RealVectorStateSpace(2)
    bounds = ob.RealVectorBounds(2)
    bounds.setLow(0.0)
    bounds.setHigh(1.0)
    space.setBounds(bounds)
    info = ob.SpaceInformation(space)
    info.setStateValidityChecker(lambda s: is_free(np.array([s[0], s[1]])))
    info.setup()
    definition = ob.ProblemDefinition(info)
    ends = [info.allocState(), info.allocState()]
    for state, q in zip(ends, (START, GOAL), strict=True):
        state[0], state[1] = q
    definition.setStartAndGoalStates(*ends)
    planner = sbl_in_ompl(info, np.random.default_rng(3), SblConfig(max_checks=3000))
    planner.setProblemDefinition(definition)
    planner.setup()
    status = planner.solve(ob.PlannerTerminationCondition(lambda: False))
    if passable == "enclosed":
        assert status.asString() == "Timeout" and not definition.hasExactSolution()
        return
    assert status.asString() == "Exact solution"
    path = np.array([[s[0], s[1]] for s in definition.getSolutionPath().getStates()])
    direct = plan_sbl(START, GOAL, LOWER, UPPER, through_gap, np.random.default_rng(3), SblConfig(max_checks=3000))
    np.testing.assert_array_equal(path, direct)


@pytest.mark.parametrize("method", METHODS)
def test_no_says_how_many_samples_each_check_refused(method):
    """Two checks of two names: what a planner reports is what a tally beside it counts."""
    tally = {"wall": 0, "ring": 0}

    def why(q):
        found = "wall" if q[0] < 0.05 else None if enclosed(q) else "ring"
        if found is not None:
            tally[found] += 1
        return found

    checker = CountingChecker(refusal=why)
    answer = plan(method, START, GOAL, LOWER, UPPER, checker, np.random.default_rng(1), SblConfig(max_checks=800))
    assert isinstance(answer, NoPath)
    told = {name: count for name, count in answer.refused.items() if name != JOINT_LIMITS}
    assert told == {name: count for name, count in tally.items() if count}
    assert told["ring"] > 0 and f"ring {told['ring']}" in answer.detail


def test_bit_star_stops_at_its_first_solution():
    """It is a planner that goes on improving: here it answers long before its budget is spent."""
    checker = CountingChecker(lambda q: not (0.4 < q[0] < 0.6 and not 0.2 < q[1] < 0.5))
    path = plan("bitstar", START, GOAL, LOWER, UPPER, checker, np.random.default_rng(0), SblConfig(max_checks=200_000))
    assert isinstance(path, np.ndarray) and checker.count < 20_000
