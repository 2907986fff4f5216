"""One interface to all joint-space planners: our SBL, and OMPL's beside it for comparison.

Place in the flow: swing -> `plan(method, ...)` -> smoothing. Whatever the method, the answer is a path whose edges were
checked to the same resolution, or a `NoPath` that tells what refused the samples; the work is bounded by the number of
state checks, never by a clock, and one seed gives one path. OMPL's PRM is left out: it looks for its path in a thread of
its own, so that one seed gives many.
"""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

from athlete_twin.errors import PlanningError
from athlete_twin.geometry.arrays import LegJoints, LegPath
from planner.motion.checker import BudgetSpentError, CountingChecker, EdgeCheck, IsFree
from planner.motion.sbl import NoPath, SblConfig, check_problem, no_path, plan_sbl
from planner.motion.sbl_ompl import ompl_state, sbl_in_ompl

OMPL_PLANNERS = {
    "rrtconnect": "RRTConnect",
    "bkpiece": "BKPIECE1",
    "lbkpiece": "LBKPIECE1",
    "kpiece": "KPIECE1",
    "bitstar": "BITstar",
}
"""our name of a planner and OMPL's"""
METHODS = ("sbl", *OMPL_PLANNERS)


def plan(
    method: str,
    start: LegJoints,
    goal: LegJoints,
    lower: LegJoints,
    upper: LegJoints,
    is_free: IsFree | CountingChecker,
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
    _known(method)
    check_problem(start, goal, lower, upper)
    return _plan_ompl(method, start, goal, lower, upper, is_free, rng, config)


def ompl_planner(method: str, space_information: Any, rng: np.random.Generator, config: SblConfig) -> Any:
    """The named method, SBL included, as an `ompl.base.Planner` without a problem yet.

    Args:
        method: one of `METHODS`.
        space_information: of a real-vector space, with bounds and a state validity checker.
        rng: SBL's randomness, or the seed of OMPL's, which is one for the whole process.
        config: for SBL.
    """
    from ompl import geometric as og
    from ompl import util as ou

    if method == "sbl":
        return sbl_in_ompl(space_information, rng, config)
    # OMPL logs an error at every setSeed but the first, and obeys it all the same.
    ou.noOutputHandler()
    ou.RNG.setSeed(int(rng.integers(1, 2**31 - 1)))
    planner = getattr(og, _known(method))(space_information)
    if method == "bitstar":
        # It would go on to shorten its path until the budget is spent.
        planner.setStopOnSolnImprovement(True)
    return planner


def _known(method: str) -> str:
    if method not in OMPL_PLANNERS:
        raise PlanningError(f"planner {method!r} is not known; known: {', '.join(METHODS)}")
    return OMPL_PLANNERS[method]


def _plan_ompl(
    method: str,
    start: np.ndarray,
    goal: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
    is_free: IsFree | CountingChecker,
    rng: np.random.Generator,
    config: SblConfig,
) -> np.ndarray | NoPath:
    from ompl import base as ob

    checker = CountingChecker(is_free, config.max_checks, box=(lower, upper))
    name, spent = OMPL_PLANNERS[method], f"{OMPL_PLANNERS[method]}: no path within {config.max_checks} checks"
    dof = len(start)

    def free(state: Any) -> bool:
        # Beyond the budget nothing is free: a motion cut off by the budget must not count as checked.
        if checker.count >= config.max_checks:
            return False
        return checker(np.array([state[i] for i in range(dof)]))

    try:
        for end, q in (("start", start), ("goal", goal)):
            if not checker(q):
                return no_path(f"{end}_collides", checker)
        info = _space(lower, upper, config.resolution, free)
        definition = ob.ProblemDefinition(info)
        definition.setStartAndGoalStates(ompl_state(info, start), ompl_state(info, goal))
        planner = ompl_planner(method, info, rng, config)
        planner.setProblemDefinition(definition)
        planner.setup()
        planner.solve(ob.PlannerTerminationCondition(lambda: checker.count >= config.max_checks))
        if not definition.hasExactSolution():
            return no_path("budget", checker, spent)
        states = definition.getSolutionPath().getStates()
        path = np.array([[s[i] for i in range(dof)] for s in states])
        # OMPL's resolution is of the space's largest extent and rounded: the path is checked again by our own measure.
        for a, b in itertools.pairwise(path):
            if not EdgeCheck(a, b).is_free(checker, config.resolution):
                return no_path("recheck", checker, f"{name}: an edge collides at our resolution")
    except BudgetSpentError:
        return no_path("budget", checker, spent)
    return path


def _space(lower: np.ndarray, upper: np.ndarray, resolution: float, free: Any) -> Any:
    """OMPL's picture of the sampling box, with the check of a state."""
    from ompl import base as ob

    space = ob.RealVectorStateSpace(len(lower))
    bounds = ob.RealVectorBounds(len(lower))
    # OMPL refuses a dimension of no width.
    high = np.maximum(upper, np.asarray(lower) + 1e-6)
    for i, (a, b) in enumerate(zip(lower, high, strict=True)):
        bounds.setLow(i, float(a))
        bounds.setHigh(i, float(b))
    space.setBounds(bounds)
    info = ob.SpaceInformation(space)
    info.setStateValidityChecker(free)
    info.setStateValidityCheckingResolution(resolution / space.getMaximumExtent())
    info.setup()
    return info
