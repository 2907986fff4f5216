"""The on-board executive: runs one command sequence at a time, tick by tick, guards it and says what became of it.

It knows the drawings and what the robot senses, nothing else. A sequence is refused or stopped whole: after a fault
the legs stay where they are, the queue is empty, and the next sequence starts afresh.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field, replace

import numpy as np

from athlete_twin.driving import drive_move
from athlete_twin.errors import MessageError
from athlete_twin.geometry.arrays import Joints, PerLeg
from athlete_twin.messages import (
    BodyMove,
    Command,
    CommandSequence,
    Drive,
    ImageRequest,
    JointMove,
    LegMove,
    Stop,
    Wait,
    decode,
)
from athlete_twin.model.kinematics import GRAVITY, Kinematics
from athlete_twin.model.spec import LEGS
from athlete_twin.moves import Move, MoveFailedError, Sensed, body_move, gravity_in_hex, joint_move, leg_move

CONTROL_PERIOD = 1.0 / 24.0
"""of the executive: ten physics ticks [s]"""
TORQUE_FILTER = 0.1
"""time constant of the torque guard [s]"""
RECOVERY = 0.03
"""a joint that is beyond its limit when a sequence begins may go so much further: the way out must not be barred"""
SWING_FORCE = 0.03
"""of the robot's weight: a wheel in the air that feels more has struck something. Inertia
and encoders together show below 0.02 in free swings of both robots"""
SETTLING_TIME = 1.0
"""at the end of each sequence, before it counts as completed [s]"""
IMAGING_TIME = 0.5
"""the robot stands still that long for a set of pictures [s]"""
QUEUE_LIMIT = 8
LEG_PHASES = {"break_contact": "lift_off", "contact": "descent", "place": "descent", "none": "swing"}
"""what a straight move of a wheel is while it lasts, by its guard"""
LARGEST_SEQ_STEP = 1000
"""from one sequence to the next: more than a link loses, and one wild number does not shut the robot to all later ones"""


@dataclass(frozen=True, kw_only=True)
class Event:
    """Something to tell the ground: becomes a `Receipt`, a `Fault` or pictures."""

    kind: str
    """"receipt", "fault" or "capture" """
    sequence_id: int
    command_index: int
    status: str = ""
    text: str = ""
    cause: str = ""
    """of a refusal"""
    leg: int = -1
    request: ImageRequest | None = None


@dataclass(kw_only=True)
class _Running:
    sequence: CommandSequence
    index: int = 0
    move: Move | None = None
    dwell: float = 0.0


@dataclass(kw_only=True)
class Executive:
    """Queue, guards and the command in execution. `tick` is called every `CONTROL_PERIOD`."""

    kin: Kinematics
    setpoint: Joints
    """motor angles commanded last, shape (6, dof) [rad]"""
    state: str = "idle"
    sequence_id: int = -1
    command_index: int = 0
    newest_seq: int = -1
    """highest `seq` of the sequences taken so far"""
    heard_seq: int = -1
    """highest `seq` of the sequences heard, those that the queue had no room for among them"""
    stopped_t: float = -np.inf
    """when the latest stop was made, mission time of its sender, but not later than it arrived [s]"""
    phases: list[str] = field(default_factory=lambda: ["stance"] * LEGS)
    """per leg "stance", "lift_off", "swing" or "descent", as the executive itself sees it"""
    wheel_rates: PerLeg = field(default_factory=lambda: np.zeros(LEGS))
    """of the wheels on their forks [rad/s]"""
    _queue: deque[CommandSequence] = field(default_factory=deque)
    _running: _Running | None = None
    ratcheted: set[tuple[int, int]] = field(default_factory=set)
    """legs and joints told to have read more torque than their gears can hold, indices: they read wrong from then on"""
    _fraction: np.ndarray = field(default_factory=lambda: np.zeros(0))
    _allowed_fraction: np.ndarray = field(default_factory=lambda: np.zeros(0))
    _swing_force: np.ndarray | None = None
    """on the wheel that moves through the air, low-passed, in hex; None until it is off the ground [N]"""

    @property
    def rolling(self) -> bool:
        """Whether the wheels are driven; they are locked otherwise."""
        return bool(self.wheel_rates.any())

    @property
    def busy(self) -> bool:
        """Whether anything is in execution or waiting."""
        return self._running is not None or bool(self._queue)

    @property
    def told_state(self) -> str:
        """State as telemetry tells it: a sequence that waits is as good as one in execution."""
        return "executing" if self.busy else self.state

    def accept(self, message: CommandSequence | Stop, t: float = np.inf) -> list[Event]:
        """Take what came up the link at mission time `t` [s]."""
        if message.robot_id != self.kin.spec.name:
            return [self.refuse("misaddressed", f"the message is for {message.robot_id!r}, this is {self.kin.spec.name}", message)]
        if isinstance(message, Stop):
            # A stop that claims to be of the future shuts the robot no longer than until now.
            return self._stop(replace(message, t=min(message.t, t)))
        if message.seq <= self.newest_seq:
            cause = "repeated" if message.seq == self.newest_seq else "stale"
            return [self.refuse(cause, f"seq {message.seq} comes after {self.newest_seq}; each sequence counts on", message)]
        newest = max(self.newest_seq, self.heard_seq)
        if message.seq > newest + LARGEST_SEQ_STEP:
            text = f"seq {message.seq} is more than {LARGEST_SEQ_STEP} after {newest}; no later one could be taken"
            return [self.refuse("stale", text, message)]
        if message.t < self.stopped_t:
            text = f"the sequence was made at {message.t:.3f} s, before the stop of {self.stopped_t:.3f} s that overtook it"
            return [self.refuse("stale", text, message)]
        self.heard_seq = max(self.heard_seq, message.seq)
        if len(self._queue) >= QUEUE_LIMIT:
            return [self.refuse("queue_full", f"queue is full with {QUEUE_LIMIT} sequences", message)]
        self.newest_seq = message.seq
        self._queue.append(message)
        return [Event(kind="receipt", sequence_id=message.sequence_id, command_index=-1, status="queued")]

    def accept_raw(self, raw: bytes, t: float = np.inf) -> list[Event]:
        """Take bytes that came up the link at mission time `t` [s]: what is no command for this robot is refused."""
        try:
            message = decode(raw)
        except MessageError as e:
            return [self.refuse("damaged", str(e))]
        if not isinstance(message, CommandSequence | Stop):
            return [self.refuse("damaged", f"{message.topic} is not for a robot")]
        return self.accept(message, t)

    @staticmethod
    def refuse(cause: str, text: str, message: CommandSequence | Stop | None = None) -> Event:
        """The receipt of what was not taken; without a message nobody knows of which sequence."""
        sequence_id = message.sequence_id if isinstance(message, CommandSequence) else -1
        return Event(kind="receipt", sequence_id=sequence_id, command_index=-1, status="refused", text=text, cause=cause)

    def brown_out(self) -> list[Event]:
        """Power is lost: the sequence and the queue with it. Brakes hold; what to tell once power is back."""
        run = self._running
        sequence_id, index = (run.sequence.sequence_id, run.index) if run else (-1, -1)
        cancelled = [self._receipt(s.sequence_id, -1, "cancelled", "power was lost") for s in self._queue]
        self._running, self.state = None, "fault"
        self._queue.clear()
        self.wheel_rates[:] = 0.0
        text = "power was lost: the sequence in execution and the queue are gone"
        events = [Event(kind="fault", sequence_id=sequence_id, command_index=index, status="brown_out", text=text)]
        return [*events, *([self._receipt(sequence_id, index, "failed", text)] if run else []), *cancelled]

    def tick(self, sensed: Sensed) -> list[Event]:
        """Advance by one control period: new `setpoint`, and what there is to tell."""
        slips = self._feel_gears(sensed)
        if slips:
            return slips
        if self._running is None:
            if not self._queue:
                return []
            sequence = self._queue.popleft()
            self._running = _Running(sequence=sequence)
            self.state, self.sequence_id, self.command_index = "executing", sequence.sequence_id, 0
            self._fraction = np.abs(sensed.torques) / self.kin.spec.torque_limits
            self._allowed_fraction = np.maximum(sequence.max_torque_fraction, self._fraction + RECOVERY)
        try:
            self._guard(self._running, sensed)
            self._guard_swing(self._running, sensed)
            return self._advance(self._running, sensed)
        except MoveFailedError as failure:
            return self._fail(failure)

    def _advance(self, run: _Running, sensed: Sensed) -> list[Event]:
        commands = run.sequence.commands
        if run.index >= len(commands):
            run.dwell += CONTROL_PERIOD
            if run.dwell < SETTLING_TIME:
                return []
            self._running, self.state = None, "idle"
            return [self._receipt(run.sequence.sequence_id, -1, "completed")]
        command = commands[run.index]
        events: list[Event] = []
        if isinstance(command, ImageRequest):
            self._check_cameras(command)
        if isinstance(command, ImageRequest | Wait):
            run.dwell += CONTROL_PERIOD
            if run.dwell < (command.duration if isinstance(command, Wait) else IMAGING_TIME):
                return []
            if isinstance(command, ImageRequest):
                sequence_id = run.sequence.sequence_id
                events.append(Event(kind="capture", sequence_id=sequence_id, command_index=run.index, request=command))
        else:
            if run.move is None:
                move = self._begin(command)
                self.setpoint = next(move, self.setpoint)
                run.move = move
                return []
            try:
                self.setpoint = run.move.send(sensed)
            except StopIteration:
                self._end(command)
            else:
                return []
        events.append(self._receipt(run.sequence.sequence_id, run.index, "completed"))
        run.index, run.move, run.dwell = run.index + 1, None, 0.0
        self.command_index = run.index
        return events

    def _check_cameras(self, command: ImageRequest) -> None:
        known = [camera.name for camera in self.kin.spec.cameras]
        for name in command.cameras:
            if name not in known:
                text = f"camera {name!r} is not on {self.kin.spec.name}; it has {', '.join(known)}"
                raise MoveFailedError("bad_command", text)

    def _begin(self, command: Command) -> Move:
        self._swing_force = None
        if isinstance(command, JointMove):
            self.phases[command.leg] = "swing"
            return joint_move(self.kin, command, self.setpoint, CONTROL_PERIOD)
        if isinstance(command, LegMove):
            self.phases[command.leg] = LEG_PHASES[command.guard]
            return leg_move(self.kin, command, self.setpoint, CONTROL_PERIOD)
        if isinstance(command, BodyMove):
            return body_move(self.kin, command, self.setpoint, CONTROL_PERIOD)
        if isinstance(command, Drive):
            return drive_move(self.kin, command, self.setpoint, CONTROL_PERIOD, self.wheel_rates)
        raise MoveFailedError("bad_command", f"{type(command).__name__} is no motion")

    def _end(self, command: Command) -> None:
        if isinstance(command, LegMove) and command.lands:
            self.phases[command.leg] = "stance"
        elif isinstance(command, LegMove | JointMove):
            self.phases[command.leg] = "swing"

    def _feel_gears(self, sensed: Sensed) -> list[Event]:
        """Faults of gears that must have skipped a tooth, each joint once; what is in execution stops.

        A gear that ratchets lets go of what is above its torque, so a sound one never reads more, however it is struck.
        After a tooth its reading is off by the tooth's worth for good. This shows where the load stayed on; a slip that
        relieved the joint goes unnoticed. Nothing is corrected: the robot cannot know by how many teeth it is off.
        """
        spec = self.kin.spec
        if spec.ratchet is None:
            return []
        fraction = sensed.torques / spec.torque_limits
        beyond = np.abs(fraction) > spec.ratchet
        if not beyond.any():
            return []
        found = {(int(leg), int(joint)) for leg, joint in np.argwhere(beyond)}
        events: list[Event] = []
        for leg, joint in sorted(found - self.ratcheted):
            text = (
                f"{spec.joint_names[joint]} of leg {leg + 1} reads {100 * fraction[leg, joint]:.0f} % of its limit, its gear holds "
                f"{100 * spec.ratchet:.0f} %: a tooth slipped or an encoder is off, and its torque is wrong from now on"
            )
            if self._running is not None:
                events += self._fail(MoveFailedError("ratchet_slip", text, leg))
            else:
                events.append(
                    Event(kind="fault", sequence_id=-1, command_index=-1, status="ratchet_slip", text=text, leg=leg)
                )
        self.ratcheted |= found
        return events

    def _guard(self, run: _Running, sensed: Sensed) -> None:
        spec = self.kin.spec
        fraction = np.abs(sensed.torques) / spec.torque_limits
        self._fraction += (fraction - self._fraction) * min(1.0, CONTROL_PERIOD / TORQUE_FILTER)
        if (self._fraction > self._allowed_fraction).any():
            worst = np.unravel_index(np.argmax(self._fraction - self._allowed_fraction), self._fraction.shape)
            leg, joint = int(worst[0]), int(worst[1])
            raise MoveFailedError(
                "torque_limit",
                f"{spec.joint_names[joint]} of leg {leg + 1} at {100 * self._fraction[leg, joint]:.0f} % of its limit, "
                f"allowed {100 * run.sequence.max_torque_fraction:.0f} %",
                leg,
            )
        tilt = math.hypot(sensed.attitude_rpy[0], sensed.attitude_rpy[1])
        if tilt > run.sequence.max_tilt:
            raise MoveFailedError(
                "tilt", f"chassis tilts by {np.rad2deg(tilt):.1f} deg, allowed {np.rad2deg(run.sequence.max_tilt):.1f}"
            )

    def _guard_swing(self, run: _Running, sensed: Sensed) -> None:
        """A wheel that was free and feels a force has met what nobody foresaw: stop before the leg pushes."""
        command = run.sequence.commands[run.index] if run.index < len(run.sequence.commands) else None
        if run.move is None or not isinstance(command, JointMove | LegMove):
            return
        if isinstance(command, LegMove) and command.guard != "none":
            return
        gravity = gravity_in_hex(sensed.attitude_rpy)
        force = self.kin.ground_force(command.leg, sensed.joints, sensed.torques[command.leg], gravity)
        allowed = run.sequence.max_swing_force or SWING_FORCE * self.kin.spec.mass * GRAVITY
        if self._swing_force is None:
            # A leg that is led out of a contact, or moved on the ground, is watched once it is free.
            self._swing_force = force if np.linalg.norm(force) < allowed else None
            return
        self._swing_force = self._swing_force + (force - self._swing_force) * min(1.0, CONTROL_PERIOD / TORQUE_FILTER)
        felt = float(np.linalg.norm(self._swing_force))
        if felt > allowed:
            raise MoveFailedError(
                "swing_contact", f"leg {command.leg + 1} struck something: {felt:.0f} N, allowed {allowed:.0f} N", command.leg
            )

    def _fail(self, failure: MoveFailedError) -> list[Event]:
        run = self._running
        sequence_id, index = (run.sequence.sequence_id, run.index) if run else (-1, -1)
        self._running, self.state = None, "fault"
        self.wheel_rates[:] = 0.0
        cancelled = [self._receipt(s.sequence_id, -1, "cancelled") for s in self._queue]
        self._queue.clear()
        fault = Event(
            kind="fault", sequence_id=sequence_id, command_index=index, status=failure.code, text=failure.text, leg=failure.leg
        )
        return [fault, self._receipt(sequence_id, index, "failed", failure.text), *cancelled]

    def _stop(self, message: Stop) -> list[Event]:
        events = [self._receipt(s.sequence_id, -1, "cancelled", message.reason) for s in self._queue]
        if self._running is not None:
            events.insert(
                0, self._receipt(self._running.sequence.sequence_id, self._running.index, "cancelled", message.reason)
            )
        self._queue.clear()
        self.stopped_t = max(self.stopped_t, message.t)
        self._running, self.state = None, "stopped"
        self.wheel_rates[:] = 0.0
        return events

    @staticmethod
    def _receipt(sequence_id: int, index: int, status: str, text: str = "") -> Event:
        return Event(kind="receipt", sequence_id=sequence_id, command_index=index, status=status, text=text)
