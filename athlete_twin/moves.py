"""The executive's motions, one control tick at a time: generators that yield motor angles and receive what was sensed.

Each generator checks its whole path for reach before it moves anything, so a command that cannot be finished is not
begun. A move goes as fast as the slowest joint allows, all joints in step. Joint moves speed up and slow down no faster than
their joints may; straight moves begin and end at their full speed, at most that of `WHEEL_SPEED`.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Generator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import wraps
from typing import Any, ParamSpec

import numpy as np

from athlete_twin.errors import KinematicsError
from athlete_twin.geometry.arrays import Joints, Vec3
from athlete_twin.messages import BodyMove, JointMove, LegMove
from athlete_twin.model.kinematics import GRAVITY, Kinematics
from athlete_twin.model.leg_timing import leg_timing
from athlete_twin.model.straight_moves import (
    BRANCH_TOLERANCE,
    DESCENT_SPEED,
    WHEEL_SPEED,
    BodyWay,
    LegWay,
    OutOfReachError,
)

PACING_TRIES = 20
"""to find a step within the joints' speed: at most half of the one before from the fourth on, so none is found only where joints jump"""
AIRBORNE_LOAD = 120.0
"""a wheel whose inferred load is below this counts as off the ground [N]"""


class MoveFailedError(Exception):
    """A move ends early; carries the fault's code. Caught by the executive, never seen outside."""

    def __init__(self, code: str, text: str, leg: int = -1) -> None:
        super().__init__(text)
        self.code, self.text, self.leg = code, text, leg


@dataclass(frozen=True, kw_only=True)
class Sensed:
    """What the robot measures of itself at one control tick."""

    joints: Joints
    """after the wind-up [rad]"""
    torques: Joints
    """[N m]"""
    attitude_rpy: Vec3
    """[rad]"""


Steps = Generator[Joints, Sensed, None]
Arguments = ParamSpec("Arguments")


class Move:
    """A motion under way that can be copied, which a generator cannot: the copy is led through what the original felt."""

    def __init__(self, steps: Callable[..., Steps], *args: Any, **kwargs: Any) -> None:
        self._make, self._args, self._kwargs = steps, args, kwargs
        self._steps = steps(*args, **kwargs)
        self._felt: list[Sensed | None] = []

    def __iter__(self) -> Move:
        return self

    def __next__(self) -> Joints:
        self._felt.append(None)
        return next(self._steps)

    def send(self, sensed: Sensed) -> Joints:
        """The next motor angles, shape (6, dof) [rad]; `StopIteration` when there are none."""
        self._felt.append(sensed)
        return self._steps.send(sensed)

    def __deepcopy__(self, memo: dict[int, Any]) -> Move:
        # Arrays that the motion writes to, as a drive the wheels' rates, are those of the copy's own executive.
        args, kwargs = copy.deepcopy((self._args, self._kwargs), memo)
        other = Move(self._make, *args, **kwargs)
        memo[id(self)] = other
        other._felt = list(self._felt)
        with suppress(StopIteration, MoveFailedError):
            for felt in self._felt:
                other._steps.send(felt)  # type: ignore[arg-type]  # the first is None: it begins
        return other


def copyable(steps: Callable[Arguments, Steps]) -> Callable[Arguments, Move]:
    """A motion written as a generator, made a `Move`."""

    @wraps(steps)
    def begin(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Move:
        return Move(steps, *args, **kwargs)

    return begin


def gravity_in_hex(attitude_rpy: Vec3) -> Vec3:
    """Gravity from the measured roll and pitch [m/s2]: the last row of the rotation matrix, turned round."""
    roll, pitch = float(attitude_rpy[0]), float(attitude_rpy[1])
    level = math.cos(pitch)
    return GRAVITY * np.array([math.sin(pitch), -level * math.sin(roll), -level * math.cos(roll)])


def vertical_load(kin: Kinematics, leg: int, sensed: Sensed) -> float:
    """Load on one wheel against gravity, inferred from the leg's torques [N]."""
    gravity = gravity_in_hex(sensed.attitude_rpy)
    force = kin.ground_force(leg, sensed.joints, sensed.torques[leg], gravity)
    return float(-force @ gravity / GRAVITY)


@copyable
def joint_move(kin: Kinematics, command: JointMove, start: Joints, dt: float) -> Steps:
    """One leg through way-points in joint space, as fast as the unloaded speed and acceleration allow."""
    spec, leg = kin.spec, command.leg
    if command.waypoints.shape[1] != spec.dof:
        raise MoveFailedError("bad_command", f"way-points have {command.waypoints.shape[1]} joints, need {spec.dof}", leg)
    beyond = (command.waypoints < spec.lower - 1e-9) | (command.waypoints > spec.upper + 1e-9)
    if beyond.any():
        row, joint = np.argwhere(beyond)[0]
        raise MoveFailedError(
            "unreachable",
            f"{spec.joint_names[joint]} of leg {leg + 1} at {np.rad2deg(command.waypoints[row, joint]):.1f} deg is beyond "
            f"{np.rad2deg(spec.lower[joint]):.0f} to {np.rad2deg(spec.upper[joint]):.0f} deg",
            leg,
        )
    waypoints = np.concatenate([start[leg][None], command.waypoints])
    try:
        timing = leg_timing(spec, waypoints, corner_tolerance=command.corner_tolerance, speed_scale=command.speed_scale)
    except KinematicsError as e:
        raise MoveFailedError("bad_command", f"leg {leg + 1}: {e}", leg) from e
    for row in timing.samples(dt):
        q = start.copy()
        q[leg] = row
        yield q


@copyable
def leg_move(kin: Kinematics, command: LegMove, start: Joints, dt: float) -> Steps:
    """One wheel along a straight line in hex, with its guard."""
    leg = command.leg
    with _faults():
        way = LegWay.of(kin, command, start)
    length = way.length
    loaded = command.guard != "none"
    speed = (DESCENT_SPEED if command.lands else WHEEL_SPEED) * command.speed_scale
    fraction, q = 0.0, start.copy()
    sensed = yield q
    posed = start.copy()
    posed[leg] = way.at(0.0)
    for q in _into_posture(start, posed, kin.spec.speed_loaded * command.speed_scale * dt):
        sensed = yield q
    tare = vertical_load(kin, leg, sensed) if command.guard == "contact" else 0.0
    while fraction < 1.0:
        rate = (kin.spec.speed_loaded if loaded else kin.spec.speed_unloaded) * command.speed_scale
        step = min(speed * dt / max(length, 1e-9), 1.0 - fraction)
        fraction, target = _paced(way.at, q[leg], fraction, step, rate * dt, leg)
        q = q.copy()
        q[leg] = target
        sensed = yield q
        if command.guard in ("none", "place"):
            continue
        load = vertical_load(kin, leg, sensed) - tare
        if command.guard == "break_contact":
            loaded = load > AIRBORNE_LOAD
        elif load >= command.contact_load:
            return
    if command.guard == "contact":
        load = vertical_load(kin, leg, sensed) - tare
        raise MoveFailedError(
            "no_contact", f"leg {leg + 1} came down {length:.2f} m and carries {load:.0f} of {command.contact_load:.0f} N", leg
        )
    if command.guard == "break_contact":
        for _ in range(int(0.5 / dt)):
            sensed = yield q
        load = vertical_load(kin, leg, sensed)
        if load > AIRBORNE_LOAD:
            raise MoveFailedError(
                "contact_not_broken", f"leg {leg + 1} was lifted {length:.2f} m and still carries {load:.0f} N", leg
            )


@copyable
def body_move(kin: Kinematics, command: BodyMove, start: Joints, dt: float) -> Steps:
    """The chassis along a line and about an axis; every wheel stays where it is, but for its commanded offset."""
    with _faults():
        way = BodyWay.of(kin, command, start)
        posed, size = way.at(0.0), way.length
    if size == 0.0:
        return
    q, fraction = start.copy(), 0.0
    limit = kin.spec.speed_loaded * command.speed_scale * dt
    for q in _into_posture(start, posed, limit):
        yield q
    while fraction < 1.0:
        step = min(WHEEL_SPEED * dt / size, 1.0 - fraction)
        fraction, q = _paced(way.at, q, fraction, step, limit, -1)
        yield q


def _into_posture(start: Joints, posed: Joints, limit: float) -> Generator[Joints, None, None]:
    """From where the joints are to the closed form's angles for the same place of the wheels, at most `limit` a tick [rad]."""
    ticks = int(np.ceil(np.abs(posed - start).max() / limit - 0.5))
    for k in range(1, ticks + 1):
        yield start + (posed - start) * (k / (ticks + 0.5))


def _paced(
    angles_at: Callable[[float], np.ndarray], now: np.ndarray, fraction: float, step: float, limit: float, leg: int
) -> tuple[float, np.ndarray]:
    """The next fraction of a straight way and its angles, none of which changes by more than `limit` [rad].

    The angles of a way may jump where a rule of the drawings takes over from another: such a small jump is spread over ticks.
    """
    for k in range(PACING_TRIES):
        with _faults():
            target = angles_at(fraction + step)
        change = float(np.abs(target - now).max())
        if change <= limit:
            return fraction + step, target
        step *= min(max(0.999 * limit / change, 0.1), 1.0 if k < 3 else 0.5)
    if change <= BRANCH_TOLERANCE:
        return fraction, now + (target - now) * (0.999 * limit / change)
    raise MoveFailedError(
        "unreachable", f"a joint would jump by {np.rad2deg(change):.1f} deg {100 * fraction:.0f} % along the way", leg
    )


@contextmanager
def _faults() -> Generator[None, None, None]:
    """What a way says of reach is the executive's fault."""
    try:
        yield
    except OutOfReachError as e:
        raise MoveFailedError("unreachable", str(e), e.leg) from e
