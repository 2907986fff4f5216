"""What the ground asks and what the operator answers: proposals and decisions, and the simplest operators.

The last stage before the link. The agent hands out one of five actions; only a `Proposal` needs an answer. Operators that
judge, dawdle or err are in `operators.py`; one that asks a person reads a terminal and lives with the scripts.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from typing import Literal, Protocol, get_args, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float

from athlete_twin.errors import ConfigError
from athlete_twin.geometry.arrays import Vec3
from athlete_twin.geometry.grid import HeightGrid
from athlete_twin.geometry.se3 import SE3
from athlete_twin.messages import CommandSequence, Message
from athlete_twin.model.spec import RobotSpec
from planner.preview.preview import Preview

DecisionKind = Literal["approve", "reject", "edit_footfall", "choose_leg", "choose_cameras", "wait", "stop"]
DECISIONS: tuple[str, ...] = get_args(DecisionKind)
MAX_WAIT = 3600.0
"""longest wait an operator may order, as the executive's [s]"""


@dataclass(frozen=True, eq=False, kw_only=True)
class Landing:
    """Where a leg comes down."""

    leg: int
    """index 0 to 5"""
    footfall_in_world: Vec3
    """believed contact point [m]"""


@dataclass(frozen=True, eq=False, kw_only=True)
class Proposal:
    """One step or chassis shift the ground wants to command, with all the operator needs to judge it."""

    index: int
    """counts proposals from 0"""
    t: float
    """when it was ready, mission time [s]"""
    kind: Literal["step", "shift"]
    leg: int
    """index 0 to 5 of the leg that swings, -1 for a shift"""
    footfall_in_world: Vec3
    """believed contact point the wheel shall come down on; of a shift, the hex origin at its end [m]"""
    sequence: CommandSequence
    """what goes up when it is approved, sag-compensated"""
    preview: Preview
    """the robot over the time of the sequence, and what would go wrong"""
    terrain: HeightGrid
    """believed ground, NaN where unknown"""
    footfall_ok: Bool[np.ndarray, "nx ny"]
    """green cells of the terrain, where a wheel may stand; the others are red"""
    cost: Float[np.ndarray, "nx ny"]
    """of a footfall in each cell, NaN where vetoed or unknown"""
    world_from_hex: SE3
    """believed chassis before the motion"""
    predicted_margin: float
    """least stability margin along the motion [m]"""
    predicted_sag: float
    """largest sag of the chassis along the motion [m]"""
    text: str
    """one line that says what will happen and why"""
    predicted_torque_fraction: float = float("nan")
    """largest joint torque over its limit while the leg is in the air; NaN where nothing was foreseen, as below"""
    predicted_clearance: float = float("nan")
    """of the lifted wheel above the ground under it [m]"""
    unknown_share: float = float("nan")
    """of the ground under the wheel at its footfall, so much was never seen, 0 to 1"""
    together: tuple[Landing, ...] = ()
    """of a step, the other legs that step with it"""

    def __post_init__(self) -> None:
        for name in ("footfall_ok", "cost"):
            shape = getattr(self, name).shape
            if shape != self.terrain.shape:
                raise ConfigError(f"{name} has shape {shape}, the terrain has {self.terrain.shape}")


@dataclass(frozen=True, eq=False, kw_only=True)
class Decision:
    """The operator's answer to a proposal."""

    kind: DecisionKind
    reason: str = ""
    """in the operator's words; of any kind, meant for "reject" """
    footfall_in_world: Vec3 | None = None
    """of "edit_footfall": where the wheel shall come down instead [m]"""
    leg: int | None = None
    """of "choose_leg": index 0 to 5 of the leg that shall step instead"""
    cameras: tuple[str, ...] = ()
    """of "choose_cameras": pairs to take before anything moves"""
    duration: float = 0.0
    """of "wait" [s]"""

    def __post_init__(self) -> None:
        if self.kind not in DECISIONS:
            raise ConfigError(f"decision {self.kind!r} is not one of {', '.join(DECISIONS)}")
        footfall = self.footfall_in_world
        if self.kind == "edit_footfall" and (footfall is None or not np.isfinite(footfall).all()):
            raise ConfigError(f"decision 'edit_footfall' needs a finite footfall_in_world, got {footfall}")
        if self.kind == "choose_leg" and self.leg not in range(6):
            raise ConfigError(f"decision 'choose_leg' needs a leg index 0 to 5, got {self.leg}")
        if self.kind == "choose_cameras" and not self.cameras:
            raise ConfigError("decision 'choose_cameras' names no camera")
        if self.kind == "wait" and not (np.isfinite(self.duration) and 0.0 < self.duration <= MAX_WAIT):
            raise ConfigError(f"decision 'wait' of {self.duration} s is outside 0 to {MAX_WAIT:.0f} s")


def check_cameras(decision: Decision, spec: RobotSpec) -> None:
    """Refuse the choice of a camera that the robot does not have."""
    known = [camera.name for camera in spec.cameras]
    unknown = [name for name in decision.cameras if name not in known]
    if unknown:
        raise ConfigError(f"camera {unknown[0]!r} is not one of {spec.name}'s; known: {', '.join(known)}")


@dataclass(frozen=True, kw_only=True)
class Uplink:
    """Something to send that needs no approval: an image request."""

    sequence: CommandSequence


@dataclass(frozen=True, kw_only=True)
class Waiting:
    """Nothing to do before more has come down."""

    reason: str
    """what is awaited"""


@dataclass(frozen=True, kw_only=True)
class Arrived:
    """The ground believes that the robot stands at the goal."""

    text: str


@dataclass(frozen=True, kw_only=True)
class NoStep:
    """The ground found nothing it may command."""

    reason: str
    refused: Mapping[str, int] = field(default_factory=dict)
    """how many candidates each check refused"""


Action = Proposal | Uplink | Arrived | NoStep | Waiting


@runtime_checkable
class GroundAgent(Protocol):
    """The ground side as the environments see it: messages in, actions out. Mission time is an argument."""

    @property
    def ground_s(self) -> float:
        """Computing time charged so far, from the fixed table [s]. It only grows."""

    @property
    def unusable_pairs(self) -> Sequence[str]:
        """Why pictures were left out so far, one line each; it only grows, and stays empty without eyes."""

    def observe(self, message: Message, t: float) -> None:
        """Take one message that came down and arrived at mission time `t` [s]."""

    def next(self, t: float) -> Action:
        """What to do now. The same `Proposal` (same index) stands until it was decided."""

    def decide(self, decision: Decision, t: float) -> CommandSequence | None:
        """Apply the operator's answer to the standing proposal; the sequence to send, or None when nothing goes up.

        A wait decides nothing: `next` gives the same proposal again. A stop is sent by whoever runs the loop.
        """


@runtime_checkable
class StageTimer(Protocol):
    """Measures how long a stage takes; handed to the agent, since the planner reads no clock."""

    def __call__(self, stage: str, /) -> AbstractContextManager[None]:
        """Context in which `stage` runs."""


def untimed(_stage: str, /) -> AbstractContextManager[None]:
    """A `StageTimer` that measures nothing."""
    return nullcontext()


@runtime_checkable
class Operator(Protocol):
    """Whoever answers proposals."""

    def decide(self, proposal: Proposal, t: float) -> tuple[Decision, float]:
        """The answer to a proposal shown at mission time `t` [s], and the seconds it took, charged to the mission."""


@dataclass(frozen=True)
class ApproveAll:
    """Approves whatever is proposed, at once."""

    def decide(self, _proposal: Proposal, _t: float) -> tuple[Decision, float]:
        """Approval, after 0 s."""
        return Decision(kind="approve"), 0.0


@dataclass(frozen=True, kw_only=True)
class RejectSome:
    """Rejects the proposals with the given indices and approves the others: for tests of the way back."""

    rejected: frozenset[int]
    seconds: float = 5.0
    """taken for every answer [s]"""

    def decide(self, proposal: Proposal, _t: float) -> tuple[Decision, float]:
        """Rejection of the named ones, approval of the others."""
        kind: DecisionKind = "reject" if proposal.index in self.rejected else "approve"
        return Decision(kind=kind), self.seconds
