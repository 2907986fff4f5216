"""What twin and mock have in common: they hear what comes up the link, and turn what the executive notes into messages."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable

from athlete_twin.executive import Event, Executive
from athlete_twin.messages import CommandSequence, Fault, ImageRequest, Message, Receipt, Stop, Telemetry


class Commanded(ABC):
    """A robot with an on-board executive at the end of a link."""

    executive: Executive
    t: float
    """mission time it has reached [s]"""

    def __init__(self, robot_id: str) -> None:
        self.robot_id = robot_id
        self._counts: dict[str, int] = {}
        """messages of each kind so far"""

    def receive(self, message: CommandSequence | Stop) -> list[Message]:
        """Take what came up the link; returns what answers it at once."""
        return [] if self._deaf() else self._answers(self.executive.accept(message, self.t))

    def receive_raw(self, raw: bytes) -> list[Message]:
        """Take bytes that came up the link; what is no command for this robot is refused with a receipt, and telemetry behind it."""
        return [] if self._deaf() else self._answers(self.executive.accept_raw(raw, self.t))

    def _deaf(self) -> bool:
        """Whether it hears nothing now."""
        return False

    @abstractmethod
    def _telemetry(self) -> Telemetry:
        """What it measures of itself now."""

    @abstractmethod
    def _capture(self, request: ImageRequest) -> list[Message]:
        """The pictures asked for."""

    def _answers(self, events: list[Event]) -> list[Message]:
        """What answers a message at once. Whoever stops the robot or is refused wants to know how far it is."""
        made = self._tell(events)
        if self.executive.state == "stopped" or any(e.status == "refused" for e in events):
            made.append(self._telemetry())
        return made

    def _tell(self, events: Iterable[Event]) -> list[Message]:
        out: list[Message] = []
        for e in events:
            if e.request is not None:
                out.extend(self._capture(e.request))
            elif e.kind == "fault":
                out.append(
                    Fault(
                        seq=self._next("fault"), robot_id=self.robot_id, t=self.t, code=e.status, text=e.text,
                        sequence_id=e.sequence_id, command_index=e.command_index, leg=e.leg,
                    )
                )  # fmt: skip
            else:
                out.append(
                    Receipt(
                        seq=self._next("receipt"), robot_id=self.robot_id, t=self.t, sequence_id=e.sequence_id,
                        command_index=e.command_index, status=e.status, text=e.text, cause=e.cause,
                    )
                )  # fmt: skip
        return out

    def _next(self, kind: str) -> int:
        count = self._counts.get(kind, 0)
        self._counts[kind] = count + 1
        return count
