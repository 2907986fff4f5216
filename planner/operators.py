"""Operators that need nobody: one that judges by thresholds, one that is slow, one whose mind is elsewhere.

Stand-ins for people, to measure what a ground planner asks of them. What they draw comes from the generator they are given;
each answer draws the same numbers, used or not, so that two of one seed stay paired. The seconds they take are a choice, not
a measurement: nobody published think-times of ATHLETE's operators.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from athlete_twin.errors import ConfigError
from athlete_twin.model.spec import load_spec
from planner.decisions import ApproveAll, Decision, Operator, Proposal

SCRIPTED_OPERATORS = ("approve_all", "cautious", "slow", "distracted")


@dataclass(frozen=True, kw_only=True)
class Cautious:
    """Rejects, with the reasons, what comes nearer to a limit than it likes and what the preview finds a fault in.

    What nobody foresaw (NaN) it cannot judge.

    At a threshold itself it approves.
    """

    margin_above_rule: float = 0.05
    """of the least stability margin in the whole motion over the robot's rule, which the planner itself keeps [m]"""
    max_torque_fraction: float = 0.90
    """of a joint's limit, in the whole motion; the executive stops at 1"""
    min_clearance: float = 0.05
    """of the lifted wheel above the ground; fused stereo errs by 1-2 cm within reach (one sigma) [m]"""
    max_unknown_share: float = 0.05
    """of the ground under the wheel that nobody saw; the planner itself allows 0.10 of it"""
    seconds: float = 10.0
    """taken for every answer [s]"""

    def __post_init__(self) -> None:
        for name in ("margin_above_rule", "max_torque_fraction", "min_clearance", "max_unknown_share", "seconds"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0.0):
                raise ConfigError(f"cautious operator: {name} is {value}, must be finite and 0 or more")

    def decide(self, proposal: Proposal, _t: float) -> tuple[Decision, float]:
        """Approval, or a rejection that names every threshold crossed with its figure."""
        least = load_spec(proposal.sequence.robot_id).min_support_margin + self.margin_above_rule
        # The planner's figures are of a leg in the air; the preview's of all that moves. The worse counts.
        margin = float(np.fmin.reduce(proposal.preview.margins, initial=proposal.predicted_margin))
        torque = float(np.fmax.reduce(proposal.preview.torque_fractions, initial=proposal.predicted_torque_fraction))
        too_little = (
            ("margin", margin, least, "m"),
            ("clearance", proposal.predicted_clearance, self.min_clearance, "m"),
        )
        too_much = (
            ("torque", torque, self.max_torque_fraction, "of the limit"),
            ("unknown ground", proposal.unknown_share, self.max_unknown_share, "of the footfall"),
        )
        reasons = [f"{name} {value:.3f} {of}, wants at least {limit:g}" for name, value, limit, of in too_little if value < limit]
        reasons += [f"{name} {value:.3f} {of}, wants at most {limit:g}" for name, value, limit, of in too_much if value > limit]
        reasons += [f"{fault.code}: {fault.text}" for fault in proposal.preview.faults]
        if reasons:
            return Decision(kind="reject", reason="; ".join(reasons)), self.seconds
        return Decision(kind="approve"), self.seconds


@dataclass(frozen=True, kw_only=True)
class ThinkTime:
    """How long an answer takes: lognormal, as times of human decisions are."""

    median: float
    """[s]"""
    spread: float
    """standard deviation of the logarithm"""
    longest: float = 600.0
    """nobody thinks longer [s]"""

    def __post_init__(self) -> None:
        if not (0.0 < self.median <= self.longest < np.inf):
            raise ConfigError(f"median think-time is {self.median} s, must be above 0 and at most {self.longest} s")
        if not (np.isfinite(self.spread) and self.spread >= 0.0):
            raise ConfigError(f"spread of the think-time is {self.spread}, must be finite and 0 or more")

    def seconds(self, deviate: float) -> float:
        """The time that belongs to a standard normal deviate [s]."""
        return float(min(self.median * np.exp(self.spread * deviate), self.longest))


@dataclass(frozen=True, kw_only=True)
class Slow:
    """Approves whatever is proposed, after some thought."""

    rng: np.random.Generator
    think: ThinkTime = ThinkTime(median=30.0, spread=0.6)

    def decide(self, _proposal: Proposal, _t: float) -> tuple[Decision, float]:
        """Approval, late."""
        return Decision(kind="approve"), self.think.seconds(float(self.rng.standard_normal()))


@dataclass(frozen=True, kw_only=True)
class Distracted:
    """Answers late and sometimes wrong: rejects good proposals, moves good footfalls, has to be asked again."""

    rng: np.random.Generator
    think: ThinkTime = ThinkTime(median=60.0, spread=1.0)
    rejects: float = 0.10
    """share of proposals rejected for no good reason"""
    misplaces: float = 0.10
    """share of footfalls moved to a wrong place"""
    away: float = 0.10
    """share of proposals that must be shown again"""
    misplaced_by: float = 0.3
    """standard deviation along x and y of a wrong place [m]"""
    wait: float = 60.0
    """until it looks again [s]"""

    def __post_init__(self) -> None:
        shares = (self.rejects, self.misplaces, self.away)
        if not (min(shares) >= 0.0 and sum(shares) <= 1.0):
            raise ConfigError(f"distracted operator: shares {shares} must be 0 or more and together at most 1")

    def decide(self, proposal: Proposal, _t: float) -> tuple[Decision, float]:
        """Mostly approval; always late."""
        deviate, along_x, along_y = (float(v) for v in self.rng.standard_normal(3))
        fate = float(self.rng.random())
        seconds = self.think.seconds(deviate)
        if fate < self.rejects:
            return Decision(kind="reject", reason="did not look closely"), seconds
        if fate < self.rejects + self.misplaces and proposal.kind == "step":
            place = proposal.footfall_in_world + self.misplaced_by * np.array([along_x, along_y, 0.0])
            return Decision(kind="edit_footfall", reason="took it for another place", footfall_in_world=place), seconds
        if self.rejects + self.misplaces <= fate < self.rejects + self.misplaces + self.away:
            return Decision(kind="wait", reason="was called away", duration=self.wait), seconds
        return Decision(kind="approve"), seconds


def scripted_operator(name: str, *, rng: np.random.Generator) -> Operator:
    """An operator that needs nobody, by its name; `rng` is all it draws from."""
    if name == "approve_all":
        return ApproveAll()
    if name == "cautious":
        return Cautious()
    if name == "slow":
        return Slow(rng=rng)
    if name == "distracted":
        return Distracted(rng=rng)
    raise ConfigError(f"operator {name!r} is not known; known: {', '.join((*SCRIPTED_OPERATORS, 'human'))}")
