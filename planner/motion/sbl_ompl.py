"""SBL in OMPL's clothes: an `ompl.base.Planner` that OMPL's own tools set up, run and benchmark like any other.

Place in the flow: `planners.ompl_planner("sbl", ...)` -> OMPL. The search itself is `sbl.plan_sbl`, called with the problem
definition's start, goal, bounds and validity checker: the same seed gives the same path either way.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from planner.motion.checker import BudgetSpentError
from planner.motion.sbl import NoPath, SblConfig, plan_sbl


def sbl_in_ompl(space_information: Any, rng: np.random.Generator, config: SblConfig) -> Any:
    """SBL as an `ompl.base.Planner` over a real-vector space, for OMPL's own tools.

    Args:
        space_information: with bounds and a state validity checker.
        rng: all randomness comes from here.
        config: settings; `max_checks` bounds the states checked, besides OMPL's termination condition.
    """
    return _sbl_class()(space_information, rng, config)


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
            if first is None or last is None:
                status = ob.PlannerStatus
                return status(status.INVALID_START if first is None else status.INVALID_GOAL)
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
                path.append(ompl_state(info, q))
            self.getProblemDefinition().addSolutionPath(path, False, 0.0, "SBL")
            return ob.PlannerStatus(ob.PlannerStatus.EXACT_SOLUTION)

    return Sbl


def ompl_state(space_information: Any, q: np.ndarray) -> Any:
    """A state of OMPL's with the values of q."""
    state = space_information.allocState()
    for i, value in enumerate(q):
        state[i] = float(value)
    return state


def _status(ob: Any, refusal: NoPath) -> Any:
    known = {"start_collides": ob.PlannerStatus.INVALID_START, "goal_collides": ob.PlannerStatus.INVALID_GOAL}
    return known.get(refusal.reason, ob.PlannerStatus.TIMEOUT)
