"""What a robot is to whoever commands it: messages in, messages out, mission time as an argument.

The twin (`athlete.Athlete`) and the mock (`mock.MockAthlete`) keep it; a real machine behind a radio could.
"""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from athlete_twin.messages import CommandSequence, Message, Stop


@runtime_checkable
class Robot(Protocol):
    """A vehicle with its on-board executive.

    The cadence of telemetry is the robot's own: once a second of mission time while a sequence runs, and whenever its
    executive changes state.
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

    def advance(self, until: float) -> list[Message]:
        """Run to mission time `until` [s], or until something goes down, whichever comes first; what goes down.

        Time may pass `until` by less than one control period.
        """

    def close(self) -> None:
        """Free what it holds."""
