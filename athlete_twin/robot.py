"""What a robot is to whoever commands it: messages in, messages out, mission time as an argument.

The twin (`athlete.Athlete`) and the mock (`mock.MockAthlete`) keep it; a real machine behind a radio could.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from athlete_twin.geometry.arrays import DepthMap, Image, Joints, PerLeg, Vec3, Wheels
from athlete_twin.geometry.se3 import SE3
from athlete_twin.messages import CommandSequence, Message, Stop
from athlete_twin.moment import Moment
from athlete_twin.world.injected import InjectedFault


@runtime_checkable
class Robot(Protocol):
    """A vehicle with its on-board executive.

    The cadence of telemetry is the robot's own: once at the start, once a second of mission time while a sequence runs,
    whenever its executive changes state and whenever a sequence has ended, be it in its first moment.
    """

    @property
    def robot_id(self) -> str:
        """Name that stands in each of its messages."""

    @property
    def t(self) -> float:
        """Mission time it has reached [s]."""

    @property
    def busy(self) -> bool:
        """Whether its executive has anything to do."""

    def receive(self, message: CommandSequence | Stop) -> list[Message]:
        """Take what came up; what goes down at once, such as the receipt."""

    def receive_raw(self, raw: bytes) -> list[Message]:
        """The same with bytes as they came; what is damaged, or no command, is refused with a receipt."""

    def advance(self, until: float) -> list[Message]:
        """Run to mission time `until` [s], or until something goes down, whichever comes first; what goes down.

        Time may pass `until` by less than one physics tick (1/240 s).
        """

    def close(self) -> None:
        """Free what it holds."""


@runtime_checkable
class TruthView(Protocol):
    """What is really so with a simulated robot: for scores, recordings and films, never for the ground."""

    @property
    def t(self) -> float:
        """Mission time [s]."""

    @property
    def world_from_hex(self) -> SE3:
        """The chassis."""

    @property
    def joints(self) -> Joints:
        """Angles after the wind-up [rad]."""

    @property
    def torques(self) -> Joints:
        """[N m]."""

    @property
    def wheel_loads(self) -> PerLeg:
        """Along the ground's normal [N]."""

    @property
    def wheels_in_world(self) -> Wheels:
        """Axle centres [m]."""

    @property
    def com_in_world(self) -> Vec3:
        """Centre of mass [m]."""

    @property
    def phases(self) -> tuple[str, ...]:
        """Per leg "stance", "lift_off", "swing" or "descent"."""

    @property
    def peak_torque_fraction(self) -> float:
        """Largest so far, low-passed at 0.1 s."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ViewTruth:
    """What the left image of one stereo pair truly shows."""

    t: float
    """when it was taken, as its pair says [s]"""
    camera: str
    label: Image
    """0 sky, 1 ground, 2 rock, 3 robot, shape (h, w)"""
    leg: np.ndarray
    """index 0 to 5 of the leg that a pixel shows, -1 elsewhere, shape (h, w), int8"""
    depth: DepthMap
    """along the boresight, NaN for sky [m]"""
    points_in_world: np.ndarray
    """what each pixel shows, shape (h, w, 3), NaN for sky [m]"""
    wheels_in_world: Wheels
    """axle centres [m]"""


@runtime_checkable
class TrackView(Protocol):
    """One sample of the true motion."""

    @property
    def t(self) -> float:
        """Mission time [s]."""

    @property
    def world_from_hex(self) -> SE3:
        """The chassis."""

    @property
    def joints(self) -> Joints:
        """Angles after the wind-up [rad]."""


@runtime_checkable
class CollisionView(Protocol):
    """One contact episode of a part that should touch nothing."""

    @property
    def t(self) -> float:
        """When it began [s]."""

    @property
    def part(self) -> str:
        """Link that touched."""

    @property
    def other(self) -> str:
        """What it touched."""

    @property
    def place_in_world(self) -> Vec3:
        """[m]."""

    @property
    def force(self) -> float:
        """At its beginning [N]."""


@runtime_checkable
class SimulatedRobot(Robot, Protocol):
    """A robot whose truth can be asked."""

    on_view: Callable[[ViewTruth], None] | None
    """called with the truth of every pair it takes; None, the default, spares the work"""

    @property
    def track(self) -> Sequence[TrackView]:
        """True motion so far, sampled at fixed times while moving."""

    @property
    def collisions(self) -> Sequence[CollisionView]:
        """Contact episodes so far."""

    @property
    def injected(self) -> Sequence[InjectedFault]:
        """What the scenario has broken so far."""

    def truth(self) -> TruthView:
        """What is really so now."""

    def link_poses(self) -> dict[str, SE3]:
        """True `world_from_link` of every link."""

    def save(self) -> Moment:
        """This moment, to come back to; `PhysicsError` where it cannot be saved."""

    def restore(self, moment: Moment) -> None:
        """Back to a moment that this robot saved: what follows is the same to the last bit."""
