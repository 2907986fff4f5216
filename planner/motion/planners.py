"""One interface to all joint-space planners: our SBL, and OMPL's beside it for comparison.

Place in the flow: swing -> `plan(method, ...)` -> smoothing. Whatever the method, the answer is a path whose edges were
checked to the same resolution, or a `NoPath`; the work is bounded by the number of collision checks, never by a clock,
and one seed gives one path.
"""

from __future__ import annotations

import itertools
from functools import lru_cache
from typing import Any

import numpy as np

from athlete_twin.errors import PlanningError
from athlete_twin.geometry.arrays import LegJoints, LegPath
from planner.motion.sbl import (
    BudgetSpentError,
    CountingChecker,
    EdgeCheck,
    IsFree,
    NoPath,
    SblConfig,
    check_problem,
    plan_sbl,
)

OMPL_PLANNERS = {
    "rrtconnect": "RRTConnect",
    "bkpiece": "BKPIECE1",
    "lbkpiece": "LBKPIECE1",
    "kpiece": "KPIECE1",
}
METHODS = ("sbl", *OMPL_PLANNERS)


def plan(
    method: str,
    start: LegJoints,
    goal: LegJoints,
    lower: LegJoints,
    upper: LegJoints,
    is_free: IsFree,
    rng: np.random.Generator,
    config: SblConfig,
) -> LegPath | NoPath:
    """A path in joint space from start to goal by the named method, shape (k, dof) [rad].

    Args:
        method: one of `METHODS`.
        start: first configuration.
        goal: last configuration.
        lower: lower corner of the sampling box.
        upper: upper corner.
        is_free: whether a configuration collides with nothing.
        rng: all randomness comes from here.
        config: `resolution` and `max_checks` hold for every method, the rest for SBL.
    """
    if method == "sbl":
        return plan_sbl(start, goal, lower, upper, is_free, rng, config)
    if method not in OMPL_PLANNERS:
        raise PlanningError(f"planner {method!r} is not known; known: {', '.join(METHODS)}")
    check_problem(start, goal, lower, upper)
    return _plan_ompl(OMPL_PLANNERS[method], start, goal, lower, upper, is_free, rng, config)


def sbl_in_ompl(space_information: Any, rng: np.random.Generator, config: SblConfig) -> Any:
    """SBL as an `ompl.base.Planner` over a real-vector space, for OMPL's own tools."""
    return _sbl_class()(space_information, rng, config)


def _plan_ompl(
    name: str,
    start: np.ndarray,
    goal: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
    is_free: IsFree,
    rng: np.random.Generator,
    config: SblConfig,
) -> np.ndarray | NoPath:
    from ompl import base as ob
    from ompl import geometric as og
    from ompl import util as ou

    checker = CountingChecker(is_free)
    for end, q in (("start", start), ("goal", goal)):
        if not checker(q):
            return NoPath(reason=f"{end}_collides", checks=checker.count)
    # OMPL logs an error at every setSeed but the first, and obeys it all the same.
    ou.noOutputHandler()
    ou.RNG.setSeed(int(rng.integers(1, 2**31 - 1)))
    space = ob.RealVectorStateSpace(len(start))
    bounds = ob.RealVectorBounds(len(start))
    # OMPL refuses a dimension of no width.
    high = np.maximum(upper, np.asarray(lower) + 1e-6)
    for i, (a, b) in enumerate(zip(lower, high, strict=True)):
        bounds.setLow(i, float(a))
        bounds.setHigh(i, float(b))
    space.setBounds(bounds)
    info = ob.SpaceInformation(space)
    dof = len(start)

    def free(state: Any) -> bool:
        # Beyond the budget nothing is free: a motion cut off by the budget must not count as checked.
        if checker.count >= config.max_checks:
            return False
        return checker(np.array([state[i] for i in range(dof)]))

    info.setStateValidityChecker(free)
    info.setStateValidityCheckingResolution(config.resolution / space.getMaximumExtent())
    info.setup()
    definition = ob.ProblemDefinition(info)
    definition.setStartAndGoalStates(_state(info, start), _state(info, goal))
    planner = getattr(og, name)(info)
    planner.setProblemDefinition(definition)
    planner.setup()
    planner.solve(ob.PlannerTerminationCondition(lambda: checker.count >= config.max_checks))
    if not definition.hasExactSolution():
        detail = f"{name}: no path within {config.max_checks} checks"
        return NoPath(reason="budget", checks=checker.count, detail=detail)
    states = definition.getSolutionPath().getStates()
    path = np.array([[s[i] for i in range(dof)] for s in states])
    # OMPL's resolution is of the space's largest extent and rounded: the path is checked again by our own measure.
    for a, b in itertools.pairwise(path):
        if not EdgeCheck(a, b).is_free(checker, config.resolution):
            return NoPath(reason="recheck", checks=checker.count, detail=f"{name}: an edge collides at our resolution")
    return path


@lru_cache(maxsize=1)
def _sbl_class() -> Any:
    from ompl import base as ob
    from ompl import geometric as og

    class Sbl(ob.Planner):  # type: ignore[misc,unused-ignore]
        """Single-query, bi-directional, lazy in collision checking."""

        def __init__(self, space_information: Any, rng: np.random.Generator, config: SblConfig) -> None:
            super().__init__(space_information, "SBL")
            self._rng = rng
            self._config = config

        def solve(self, terminate: Any) -> Any:
            """Plan from the first start state to the first goal state of the problem definition."""
            info = self.getSpaceInformation()
            bounds = info.getStateSpace().getBounds()
            dof = info.getStateDimension()
            lower, upper = np.array([bounds.low[i] for i in range(dof)]), np.array([bounds.high[i] for i in range(dof)])
            # Asking the problem definition for its start state hands out ownership and crashes later; these do not.
            inputs = self.getPlannerInputStates()
            first, last = inputs.nextStart(), inputs.nextGoal()
            start, goal = (np.array([s[i] for i in range(dof)]) for s in (first, last))
            scratch = info.allocState()

            def free(q: np.ndarray) -> bool:
                if terminate():
                    raise BudgetSpentError
                for i, value in enumerate(q):
                    scratch[i] = float(value)
                return bool(info.isValid(scratch))

            found = plan_sbl(start, goal, lower, upper, free, self._rng, self._config)
            if isinstance(found, NoPath):
                return ob.PlannerStatus(_status(ob, found))
            path = og.PathGeometric(info)
            for q in found:
                path.append(_state(info, q))
            self.getProblemDefinition().addSolutionPath(path, False, 0.0, "SBL")
            return ob.PlannerStatus(ob.PlannerStatus.EXACT_SOLUTION)

    return Sbl


def _status(ob: Any, refusal: NoPath) -> Any:
    known = {"start_collides": ob.PlannerStatus.INVALID_START, "goal_collides": ob.PlannerStatus.INVALID_GOAL}
    return known.get(refusal.reason, ob.PlannerStatus.TIMEOUT)


def _state(info: Any, q: np.ndarray) -> Any:
    state = info.allocState()
    for i, value in enumerate(q):
        state[i] = float(value)
    return state
