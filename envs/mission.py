"""Robot, two links and ground on one mission clock: the loop under the trial runner and under both environments.

Ground and robot work side by side; the ground is serial. A message that has arrived waits until the ground is free;
what the ground computes takes the seconds its table charges, and a proposal stands when they are over. Each second of
mission time falls in one bin, the first that applies: the robot executes (motion), the ground computes (ground), the
operator decides (operator), everybody waits for the link (link).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from athlete_twin.errors import ConfigError, MessageError
from athlete_twin.link import DelayedLink
from athlete_twin.messages import CommandSequence, Fault, Message, Receipt, Stop, Telemetry, decode
from athlete_twin.robot import SimulatedRobot, TruthView
from envs.recorder import Recorder
from planner.decisions import Arrived, Decision, GroundAgent, NoStep, Proposal, Uplink
from planner.underway import SILENCE

SAMPLE_PERIOD = 0.5
"""of the truth while the robot executes [s]"""
ASK_AGAIN = 10.0
"""a ground that waits is asked again that often, so that it can notice a lost message [s]"""
NANO = 1_000_000_000

Bin = Literal["motion", "ground", "operator", "link"]


@dataclass(kw_only=True)
class Counts:
    """What happened so far."""

    uplinks: int = 0
    command_cycles: int = 0
    """uplinks followed by the telemetry that ends them"""
    decisions: int = 0
    rejections: int = 0
    e_stops: int = 0
    faults: int = 0
    damaged: int = 0
    """messages from the robot that arrived damaged"""


class Mission:
    """One robot commanded over two links, by an agent, or by whoever calls `send`."""

    def __init__(
        self,
        robot: SimulatedRobot,
        *,
        up: DelayedLink,
        down: DelayedLink,
        agent: GroundAgent | None = None,
        recorder: Recorder | None = None,
        on_truth: Callable[[TruthView], None] | None = None,
    ) -> None:
        """Start at mission time 0, with the robot at rest.

        Args:
            robot: at mission time 0.
            up: link from ground to robot.
            down: link from robot to ground.
            agent: the ground; without one nothing is decided here and arrived messages wait in `inbox`.
            recorder: takes everything that crosses the link or is decided; None for no recording.
            on_truth: called with samples of the truth.
        """
        self.robot, self.up, self.down, self.agent = robot, up, down, agent
        self.recorder = recorder
        self.t = 0.0
        self.counts = Counts()
        self.inbox: deque[tuple[float, Message]] = deque()
        """arrived and not yet looked at, with the time of arrival [s]"""
        self.standing: Proposal | None = None
        """shown to the operator, to be answered"""
        self.approved: dict[int, Proposal] = {}
        """what was approved and sent, by its sequence's id"""
        self.arrived: Arrived | None = None
        self.no_step: NoStep | None = None
        self.last_fault: Fault | None = None
        self.stopped = False
        """whether the operator ended it: the ground does nothing any more"""
        self.waiting_for = ""
        """what the ground awaits, for a progress display"""
        self.completed: deque[tuple[int, TruthView]] = deque()
        """sequences that the executive reported completed, and the truth then; taken by whoever scores"""
        self._on_truth = on_truth
        self._nanos: dict[Bin, int] = {"motion": 0, "ground": 0, "operator": 0, "link": 0}
        self._clock = 0
        self._ground_free_at = 0.0
        self._operator_free_at = 0.0
        self._charged = agent.ground_s if agent else 0.0
        self._ask_at = 0.0
        self._coming: Proposal | None = None
        self._answer: Decision | None = None
        self._open_cycles = 0
        self._stop: Stop | None = None
        """sent, and not known to have arrived"""
        self._stop_again_at = math.inf

    # --- what the outside does ------------------------------------------------------------------------------------

    def send(self, message: CommandSequence | Stop) -> None:
        """Put a message on the uplink now."""
        self.counts.e_stops += isinstance(message, Stop)
        self._transmit(message)

    def _transmit(self, message: CommandSequence | Stop) -> None:
        raw = self.up.send(message, self.t)
        self.counts.uplinks += 1
        self._open_cycles += 1
        if self.recorder:
            self.recorder.link(message, raw, self.t)

    def stop(self, reason: str) -> None:
        """Send a stop, again and again until telemetry says that the robot has stopped; the ground does nothing any more."""
        self.stopped = True
        self.standing = self._coming = self._answer = None
        self._stop = Stop(seq=self.counts.e_stops, robot_id=self.robot.robot_id, t=self.t, reason=reason)
        self._stop_again_at = self.t + SILENCE
        self.send(self._stop)

    def answer(self, decision: Decision, *, seconds: float = 0.0) -> None:
        """The operator's answer to the standing proposal, which took so many seconds of mission time."""
        if self.standing is None:
            raise ConfigError(f"decision {decision.kind!r} answers no proposal: none stands at {self.t:.1f} s")
        if not (math.isfinite(seconds) and seconds >= 0.0):
            raise ConfigError(f"a decision took {seconds} s, must be 0 or more")
        self._answer = decision
        self._operator_free_at = self.t + seconds + (decision.duration if decision.kind == "wait" else 0.0)
        self.counts.decisions += 1
        self.counts.rejections += decision.kind == "reject"
        if self.recorder:
            self.recorder.decision(self.standing, decision, self.t + seconds, seconds=seconds)

    def advance(self, until: float, *, stop_at_downlink: bool = False) -> list[Message]:
        """Run to mission time `until` [s]; ends early when a proposal stands, the ground has finished, or, if asked, at a downlink.

        Returns:
            What arrived from the robot meanwhile.
        """
        seen: list[Message] = []
        while True:
            seen += self._arrivals()
            self._ground()
            self._insist()
            if self.t >= until or self.finished or self.wants_answer:
                return seen
            if stop_at_downlink and seen:
                return seen
            self._pass_time(until)

    @property
    def finished(self) -> bool:
        """Whether the ground has said its last word: arrived, or no step."""
        return self.arrived is not None or self.no_step is not None

    @property
    def stop_under_way(self) -> bool:
        """Whether a stop was sent of which telemetry has not yet told that the robot has stopped."""
        return self._stop is not None

    @property
    def wants_answer(self) -> bool:
        """Whether a proposal stands and nobody has answered it."""
        return self.standing is not None and self._answer is None

    # --- accounts -------------------------------------------------------------------------------------------------

    def seconds(self, bin_: Bin) -> float:
        """Mission time that fell in one bin [s]."""
        return self._nanos[bin_] / NANO

    @property
    def mission_time(self) -> float:
        """Sum of the bins [s]."""
        return sum(self._nanos.values()) / NANO

    # --- internals ------------------------------------------------------------------------------------------------

    def _arrivals(self) -> list[Message]:
        for raw in self.up.receive_raw(self.t):
            self._downward(self.robot.receive_raw(raw))
        seen = []
        for raw in self.down.receive_raw(self.t):
            try:
                message = decode(raw)
            except MessageError as e:  # the ground cannot ask for it again; what it awaits it will miss
                self.counts.damaged += 1
                if self.recorder:
                    self.recorder.ground_says("DamagedDownlink", str(e), self.t)
                continue
            if self.recorder:
                self.recorder.link(message, raw, self.t)
            self._count(message)
            seen.append(message)
            if self.agent is not None:
                self.inbox.append((self.t, message))
        return seen

    def _count(self, message: Message) -> None:
        if isinstance(message, Fault):
            self.last_fault = message
        if isinstance(message, Telemetry) and self._stop and message.executive_state == "stopped" and message.t >= self._stop.t:
            self._stop, self._stop_again_at = None, math.inf
        ends = isinstance(message, Telemetry) and message.executive_state != "executing"
        if ends and self._open_cycles:
            self.counts.command_cycles += self._open_cycles
            self._open_cycles = 0

    def _downward(self, messages: list[Message]) -> None:
        for message in messages:
            if isinstance(message, Fault):
                self.counts.faults += 1
            if isinstance(message, Receipt) and message.command_index == -1 and message.status == "completed":
                self.completed.append((message.sequence_id, self.robot.truth()))
            self.down.send(message, max(message.t, self.t))

    def _ground(self) -> None:
        """Let the ground work until it computes, asks the operator or waits."""
        agent = self.agent
        while (
            agent is not None
            and not (self.finished or self.stopped)
            and self.t >= max(self._ground_free_at, self._operator_free_at)
        ):
            if self._coming is not None:
                self.standing, self._coming = self._coming, None
                if self.recorder:
                    self.recorder.proposal(self.standing, self.t)
            elif self.standing is not None and self._answer is not None:
                self._decided(agent, self.standing, self._answer)
            elif self.standing is not None:
                return
            elif self.inbox:
                _, message = self.inbox.popleft()
                agent.observe(message, self.t)
                self._ask_at = self.t
                self._charge(agent)
            elif self.t >= self._ask_at:
                self._ask(agent)
            else:
                return

    def _insist(self) -> None:
        """A link may lose a stop too; to stop twice does no harm."""
        if self._stop is not None and self.t >= self._stop_again_at:
            self._stop_again_at = self.t + SILENCE
            self._transmit(self._stop)

    def _decided(self, agent: GroundAgent, proposal: Proposal, decision: Decision) -> None:
        sequence = agent.decide(decision, self.t)
        self.standing = self._answer = None
        self._ask_at = self.t
        if decision.kind == "stop":
            self.stop("operator")
        if sequence is not None:
            self.approved[sequence.sequence_id] = proposal
            self.send(sequence)
        self._charge(agent)

    def _ask(self, agent: GroundAgent) -> None:
        heard = len(agent.unusable_pairs)
        action = agent.next(self.t)
        if self.recorder:
            for reason in agent.unusable_pairs[heard:]:
                self.recorder.ground_says("UnusablePair", reason, self.t)
        self._charge(agent)
        if isinstance(action, Proposal):
            self._coming = action
            self.waiting_for = "the ground computes"
        elif isinstance(action, Uplink):
            self.send(action.sequence)
            self.waiting_for = "the link"
        elif isinstance(action, Arrived):
            self.arrived = action
        elif isinstance(action, NoStep):
            self.no_step = action
        else:
            self.waiting_for = action.reason
            self._ask_at = self.t + ASK_AGAIN
            return
        if self.recorder and not isinstance(action, Proposal | Uplink):
            text = action.text if isinstance(action, Arrived) else action.reason
            refused = {} if isinstance(action, Arrived) else dict(action.refused)
            self.recorder.ground_says(type(action).__name__, text, self.t, refused=refused)

    def _charge(self, agent: GroundAgent) -> None:
        self._ground_free_at = max(self._ground_free_at, self.t) + agent.ground_s - self._charged
        self._charged = agent.ground_s

    def _pass_time(self, until: float) -> None:
        """To the next event, whatever it is, and into the bin that applies meanwhile."""
        busy = self.robot.busy
        events = [until, self.up.next_arrival(), self.down.next_arrival(), self._stop_again_at]
        if busy:
            events.append(self.t + SAMPLE_PERIOD)
        if self.agent is not None:
            events += [e for e in (self._ground_free_at, self._operator_free_at, self._ask_at) if e > self.t]
        target = max(min(events), self.t)
        made = self.robot.advance(target)
        now = max(self.t, self.robot.t) if made else max(target, self.robot.t)
        self._book(busy, now)
        self._downward(made)
        if busy and self._on_truth:
            self._on_truth(self.robot.truth())

    def _book(self, busy: bool, now: float) -> None:
        """The time since the last event, cut where the ground or the operator becomes free."""
        cuts = sorted({min(max(e, self.t), now) for e in (self._ground_free_at, self._operator_free_at)} | {now})
        begin = self.t
        for end in cuts:
            bin_: Bin = (
                "motion"
                if busy
                else "ground"
                if begin < self._ground_free_at
                else "operator"
                if begin < self._operator_free_at
                else "link"
            )
            nanos = round(end * NANO)
            self._nanos[bin_] += nanos - self._clock
            if self.recorder:
                self.recorder.booked(bin_, begin, end)
            self._clock = nanos
            begin = end
        self.t = now
