"""Collision checks as planners use them: counted, tallied by what refused, bounded, and along edges by bisection.

Place in the flow: `LegCollision.refusal` -> `CountingChecker` -> any planner, smoother or edge check. One budget of state
checks holds for every planner, so that their effort compares without a clock.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping

import numpy as np

IsFree = Callable[[np.ndarray], bool]
Refusal = Callable[[np.ndarray], str | None]
JOINT_LIMITS = "joint_limits"
"""name of the check that a sample lies in the sampling box, which lies within the joints' limits"""
BOX_SLACK = 2e-6
"""by which a sample may lie outside the box: rounding, and the width that OMPL wants of a joint that does not move [rad]"""
COLLISION = "collision"
"""name of a check that does not say which part of it refused"""


class BudgetSpentError(Exception):
    """The number of collision checks allowed is used up. Caught inside the planner, never seen by a caller."""


class CountingChecker:
    """A collision check that counts its calls, remembers what refused, and does not go beyond a budget."""

    def __init__(
        self,
        is_free: IsFree | CountingChecker | None = None,
        budget: int | None = None,
        *,
        refusal: Refusal | None = None,
        box: tuple[np.ndarray, np.ndarray] | None = None,
    ) -> None:
        """Wrap one check.

        Args:
            is_free: whether a configuration is free; another `CountingChecker` goes on counting and tells why not.
            budget: calls that are allowed; any number when None.
            refusal: in place of `is_free`, the name of the check that refuses a configuration, or None when it is free.
            box: lower and upper corner; what lies outside is refused as "joint_limits" and not asked further.
        """
        if (is_free is None) == (refusal is None):
            raise TypeError("a checker needs is_free or refusal, one of them")
        if isinstance(is_free, CountingChecker):
            refusal = is_free.refusal
        self._is_free, self._refusal, self._budget = is_free, refusal, budget
        self._box = None if box is None else (box[0] - BOX_SLACK, box[1] + BOX_SLACK)
        self.count = 0
        self.refused: Counter[str] = Counter()
        """configurations refused, by the name of the check"""

    def __call__(self, q: np.ndarray) -> bool:
        """Whether q is free; raises `BudgetSpentError` instead of a check too many."""
        return self.refusal(q) is None

    def refusal(self, q: np.ndarray) -> str | None:
        """Name of the check that refuses q, None when it is free; raises `BudgetSpentError` instead of a check too many."""
        if self._budget is not None and self.count >= self._budget:
            raise BudgetSpentError
        self.count += 1
        why = self._why(q)
        if why is not None:
            self.refused[why] += 1
        return why

    def _why(self, q: np.ndarray) -> str | None:
        if self._box is not None and ((q < self._box[0]).any() or (q > self._box[1]).any()):
            return JOINT_LIMITS
        if self._refusal is not None:
            return self._refusal(q)
        assert self._is_free is not None  # one of the two was given
        return None if self._is_free(q) else COLLISION


def told(refused: Mapping[str, int]) -> str:
    """What refused how many samples, the most first: "refused: terrain 812, own_leg 40"; empty when nothing did."""
    order = sorted(refused.items(), key=lambda item: (-item[1], item[0]))
    return "refused: " + ", ".join(f"{name} {count}" for name, count in order) if order else ""


class EdgeCheck:
    """How far a straight edge between two free configurations has been checked: bisected level by level."""

    __slots__ = ("_a", "_span", "level", "spacing")

    def __init__(self, a: np.ndarray, b: np.ndarray) -> None:
        self._a = a
        self._span = b - a
        self.level = 0
        self.spacing = float(np.linalg.norm(self._span))
        """between neighbouring checked points [rad]"""

    def refine(self, checker: Callable[[np.ndarray], bool]) -> bool:
        """Check the middles of all unchecked pieces; False when one collides."""
        pieces = 1 << self.level
        for i in range(pieces):
            if not checker(self._a + ((i + 0.5) / pieces) * self._span):
                return False
        self.level += 1
        self.spacing *= 0.5
        return True

    def is_free(self, checker: Callable[[np.ndarray], bool], resolution: float) -> bool:
        """Check down to the resolution at once; False at the first collision."""
        while self.spacing > resolution:
            if not self.refine(checker):
                return False
        return True
