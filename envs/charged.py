"""A planner from outside, charged for its computing time by the same fixed table as this project's own.

DESIGN.md: 2 s a plan, 1 s a stereo pair, so that mission times neither depend on the machine nor on what a planner says of itself.
What asks for an answer or goes up is a plan. A planner that tells of more than the table is charged what it tells.
"""

from __future__ import annotations

from collections.abc import Sequence

from athlete_twin.messages import CommandSequence, Message, StereoPair
from planner.agent import SECONDS_PER_PAIR, SECONDS_PER_PLAN
from planner.decisions import Action, Decision, GroundAgent, Proposal, Uplink


class ChargedGround:
    """The same ground, its `ground_s` at least what the table says."""

    def __init__(self, ground: GroundAgent) -> None:
        self.ground = ground
        self._table_s = 0.0
        self._newest = -1

    @property
    def ground_s(self) -> float:
        """Computing time charged so far [s]."""
        return max(float(self.ground.ground_s), self._table_s)

    @property
    def unusable_pairs(self) -> Sequence[str]:
        """As the planner's."""
        return self.ground.unusable_pairs

    def observe(self, message: Message, t: float) -> None:
        """As the planner's; a stereo pair is charged."""
        if isinstance(message, StereoPair):
            self._table_s += SECONDS_PER_PAIR
        self.ground.observe(message, t)

    def next(self, t: float) -> Action:
        """As the planner's; a new proposal and an uplink are charged."""
        action = self.ground.next(t)
        if isinstance(action, Uplink) or (isinstance(action, Proposal) and action.index != self._newest):
            self._table_s += SECONDS_PER_PLAN
        if isinstance(action, Proposal):
            self._newest = action.index
        return action

    def decide(self, decision: Decision, t: float) -> CommandSequence | None:
        """As the planner's."""
        return self.ground.decide(decision, t)
