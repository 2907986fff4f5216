"""What has become of the sequence that was sent: told by receipts, and by telemetry where receipts were lost on the way down.

A link may lose, double, delay or damage what it carries. So each message counts once, telemetry that is older than what is known
counts for nothing, and a receipt counts only for the sequence it names. A sequence of which nothing is heard is sent again as it
was: the robot that has it refuses it as repeated and tells how far it is, the robot that has it not takes it. Nothing runs twice.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from athlete_twin.messages import CommandSequence, Fault, Message, Receipt, StereoPair, Telemetry
from planner.gait.aside import AsidePlan
from planner.gait.step_plan import StepPlan
from planner.route.drive import DrivePlan

SILENCE = 60.0
"""without a word of a sequence before it is sent again, or before pictures are given up: three round trips over the slowest
link, and the wait for the largest picture [s]"""


@dataclass(kw_only=True)
class Underway:
    """A sequence that is up there, or on its way."""

    sequence: CommandSequence
    pairs_awaited: int
    plan: StepPlan | None = None
    lift: StepPlan | None = None
    """the step of which only the lift-off was sent, to see what its leg hid"""
    drive: DrivePlan | None = None
    aside: AsidePlan | None = None
    pairs: list[StereoPair] = field(default_factory=list)
    landed: set[int] = field(default_factory=set)
    """legs whose descent is known to be completed, indices"""
    heard: bool = False
    """whether the robot is known to have it"""
    outcome: str = ""
    """ "completed", "failed", "cancelled" or "refused"; empty while it may still run"""
    fault: Fault | None = None
    ended_at: float = -np.inf
    """robot time of the word that told the outcome: telemetry from then on shows what came of it [s]"""
    _completed: int = 0
    """commands known to be completed: the first so many"""
    _last_word: float | None = None
    """when it was sent or heard of last, mission time [s]"""
    _repeated_at: float | None = None
    """when the robot refused it as one that it has had, robot time [s]"""

    def take(self, message: Message, t: float) -> range:
        """Take what came down at mission time `t` [s]; indices of the commands that are thereby known to be completed."""
        self._last_word = t
        before, running = self._completed, not self.outcome
        if isinstance(message, StereoPair):
            if message.state.sequence_id == self.sequence.sequence_id:
                self.pairs.append(message)
        elif isinstance(message, Fault) and message.sequence_id == self.sequence.sequence_id:
            self.heard, self.fault = True, message
            self._completed = max(before, message.command_index)
        elif isinstance(message, Receipt) and message.sequence_id == self.sequence.sequence_id:
            self._receipt(message)
        elif isinstance(message, Telemetry) and message.sequence_id == self.sequence.sequence_id:
            self._telemetry(message)
        elif isinstance(message, Telemetry) and self._repeated_at is not None and message.t >= self._repeated_at:
            self._gone(message)
        if running and self.outcome:
            self.ended_at = message.t
        self._completed = min(self._completed, len(self.sequence.commands))
        return range(before, max(before, self._completed))

    def sent(self, t: float) -> None:
        """It went up, once more perhaps, at mission time `t` [s]."""
        self._last_word = t

    def silent(self, t: float) -> bool:
        """Whether nothing has come down for too long at mission time `t` [s]."""
        last = self.sequence.t if self._last_word is None else self._last_word
        return t - last > SILENCE

    def _receipt(self, receipt: Receipt) -> None:
        if receipt.status == "refused" and receipt.cause == "repeated":
            self.heard, self._repeated_at = True, receipt.t  # it was there before: what became of it the telemetry says
            return
        self.heard = True
        if receipt.status == "completed":
            whole = receipt.command_index < 0
            self._completed = max(self._completed, len(self.sequence.commands) if whole else receipt.command_index + 1)
            if whole:
                self.outcome = "completed"
        elif receipt.status in ("failed", "cancelled", "refused"):
            self.outcome = receipt.status
            if self.fault is None and receipt.status != "refused":
                self.fault = self._unreported(receipt.command_index, receipt.text or receipt.status, receipt)

    def _telemetry(self, telemetry: Telemetry) -> None:
        """The executive's state where its receipts are missing; they come first on a link that keeps the order."""
        self.heard = True
        self._completed = max(self._completed, telemetry.command_index)
        if self.outcome or telemetry.executive_state == "executing":
            return
        if telemetry.executive_state == "idle":
            self.outcome = "completed"
            return
        self.outcome = "failed" if telemetry.executive_state == "fault" else "cancelled"
        if self.fault is None:
            self.fault = self._unreported(telemetry.command_index, f"the executive is in state {telemetry.executive_state}", telemetry)

    def _gone(self, telemetry: Telemetry) -> None:
        """The robot had it, has never begun it and does nothing: it was cancelled in the queue, and that receipt was lost."""
        if self.outcome or telemetry.executive_state == "executing":
            return
        self.outcome = "cancelled"
        if self.fault is None:
            self.fault = self._unreported(-1, "the robot had the sequence and never began it", telemetry)

    def _unreported(self, index: int, text: str, message: Message) -> Fault:
        """A fault of which the robot's own report is missing."""
        commands = self.sequence.commands
        leg = getattr(commands[index], "leg", -1) if 0 <= index < len(commands) else -1
        return Fault(
            seq=message.seq, robot_id=message.robot_id, t=message.t, code="unreported", text=text,
            sequence_id=self.sequence.sequence_id, command_index=index, leg=leg,
        )  # fmt: skip


class Inbox:
    """Lets each message through once, and telemetry only if it is newer than what came before."""

    def __init__(self) -> None:
        self._seen: set[tuple[str, int]] = set()
        self._newest = -1

    def admits(self, message: Message) -> bool:
        """Whether the message tells something new."""
        if isinstance(message, Telemetry):
            new = message.seq > self._newest
            self._newest = max(self._newest, message.seq)
            return new
        key = (message.topic, message.seq)
        new = key not in self._seen
        self._seen.add(key)
        return new
