"""What one command makes the motors do, and how long that takes, if nothing stops it.

Place in the flow: command and motors before it -> `Stretch` -> `standing` says where that puts the robot. The ways are those that the
executive follows (`model.straight_moves`, `model.leg_timing`); its pacing is repeated here piece by piece instead of tick by tick.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from athlete_twin.errors import KinematicsError
from athlete_twin.geometry.arrays import Joints
from athlete_twin.messages import BodyMove, Command, Drive, ImageRequest, JointMove, LegMove, Wait
from athlete_twin.model.kinematics import Kinematics
from athlete_twin.model.leg_timing import leg_timing
from athlete_twin.model.spec import LEGS, RobotSpec
from athlete_twin.model.straight_moves import DESCENT_SPEED, WHEEL_SPEED, BodyWay, LegWay, OutOfReachError

SWING_SPACING = 0.04
"""between samples of a leg's way through the air at most, over its joints [rad]: 12 cm of SDM-B's wheel at full stretch"""
STRAIGHT_SPACING = 0.05
"""between samples of a straight way at most [m]"""
MOST_SAMPLES = 200
"""of one command"""
IMAGING_TIME, SETTLING_TIME, BREAK_HOLD = 0.5, 1.0, 0.5
"""the executive's: of a set of pictures, at the end of a sequence, and after a lift-off until it is sure of it [s]"""
AIRBORNE_LOAD = 120.0
"""on a wheel that is lifted off, below which the executive takes it for free and goes faster [N]"""
TICK = 1.0 / 24.0
"""of the executive, which takes one to begin a motion and one to find it done [s]"""
PACES = 4
"""parts of a piece of a straight way that are paced one by one: the fastest joint changes along it"""
DRIVE_ACCELERATION, HALT = 0.3, 0.3
"""of the chassis [m/s2], and until it is at rest before the wheels are steered back [s]: the executive's"""


class BadCommandError(KinematicsError):
    """A command that the executive would refuse to begin."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Stretch:
    """One command as the executive carries it out."""

    command: Command
    times: np.ndarray
    """after its begin, from 0, shape (n,), n >= 1 [s]"""
    motors: np.ndarray
    """at these, shape (n, 6, dof) [rad]"""
    free_times: np.ndarray | None = None
    """of a lift-off, what `times` would be without load [s]"""

    def cut(self, position: float) -> Stretch:
        """The part up to a sample, which may lie between two: 2.5 is half-way from the third to the fourth."""
        k, rest = int(position), position - int(position)
        times, motors = self.times[: k + 1], self.motors[: k + 1]
        if rest > 0.0:
            times = np.append(times, times[-1] + rest * (self.times[k + 1] - self.times[k]))
            motors = np.concatenate([motors, (motors[-1] + rest * (self.motors[k + 1] - self.motors[k]))[None]])
        return Stretch(command=self.command, times=times, motors=motors)


    def hastened(self, position: float, free_times: np.ndarray) -> Stretch:
        """The same, from a sample on, or from between two, at the pace of other times."""
        pieces, free, share = np.diff(self.times), np.diff(free_times), np.clip(np.arange(1, len(self.times)) - position, 0.0, 1.0)
        times = np.concatenate([[0.0], np.cumsum((1.0 - share) * pieces + share * free)])
        return Stretch(command=self.command, times=times, motors=self.motors, free_times=free_times)

    def held(self, seconds: float) -> Stretch:
        """The same, and so long at its end."""
        times, motors = np.append(self.times, self.times[-1] + seconds), np.concatenate([self.motors, self.motors[-1:]])
        return Stretch(command=self.command, times=times, motors=motors)


def stretch(kin: Kinematics, command: Command, motors: Joints) -> Stretch:
    """What the motors do for one command, shape (6, dof) before it [rad].

    Raises `OutOfReachError` where a leg cannot follow, and `BadCommandError` for what no robot of this kind does.
    """
    if isinstance(command, JointMove):
        return _swing(kin.spec, command, motors)
    if isinstance(command, LegMove):
        return _straight_leg(kin, command, motors)
    if isinstance(command, BodyMove):
        return _straight_body(kin, command, motors)
    if isinstance(command, Drive):
        return _drive(kin, command, motors)
    seconds = command.duration if isinstance(command, Wait) else IMAGING_TIME
    if isinstance(command, ImageRequest):
        known = [camera.name for camera in kin.spec.cameras]
        strange = [name for name in command.cameras if name not in known]
        if strange:
            raise BadCommandError(f"camera {strange[0]!r} is not on {kin.spec.name}; it has {', '.join(known)}")
    return Stretch(command=command, times=np.array([0.0, seconds]), motors=np.array([motors, motors]))


def _swing(spec: RobotSpec, command: JointMove, motors: Joints) -> Stretch:
    leg, waypoints = command.leg, command.waypoints
    if waypoints.shape[1] != spec.dof:
        raise BadCommandError(f"way-points have {waypoints.shape[1]} joints, {spec.name}'s legs have {spec.dof}")
    beyond = (waypoints < spec.lower - 1e-9) | (waypoints > spec.upper + 1e-9)
    if beyond.any():
        row, joint = np.argwhere(beyond)[0]
        low, high = np.rad2deg(spec.lower[joint]), np.rad2deg(spec.upper[joint])
        raise KinematicsError(
            f"{spec.joint_names[joint]} of leg {leg + 1} at {np.rad2deg(waypoints[row, joint]):.1f} deg is beyond "
            f"{low:.0f} to {high:.0f} deg"
        )
    path = np.concatenate([motors[leg][None], waypoints])
    timing = leg_timing(spec, path, corner_tolerance=command.corner_tolerance, speed_scale=command.speed_scale)
    length = float(np.abs(np.diff(path, axis=0)).max(axis=1).sum())
    times = np.linspace(0.0, timing.duration, 1 + _pieces(length, SWING_SPACING))
    out = np.repeat(motors[None], len(times), axis=0)
    out[:, leg] = timing.at(times)
    out[-1, leg] = waypoints[-1]
    return Stretch(command=command, times=times, motors=out)


def _straight_leg(kin: Kinematics, command: LegMove, motors: Joints) -> Stretch:
    way = LegWay.of(kin, command, motors)
    fractions = np.linspace(0.0, 1.0, 1 + PACES * _pieces(way.length, STRAIGHT_SPACING))
    out = np.repeat(motors[None], len(fractions), axis=0)
    out[:, command.leg] = [way.at(float(f)) for f in fractions]
    speed = (DESCENT_SPEED if command.lands else WHEEL_SPEED) * command.speed_scale
    spans = fractions * way.length / speed
    free, loaded = (_paced(spans, out, r * command.speed_scale) for r in (kin.spec.speed_unloaded, kin.spec.speed_loaded))
    posed = _posed(out[0], motors, kin.spec.speed_loaded * command.speed_scale)
    free[1:], loaded[1:] = free[1:] + posed + TICK, loaded[1:] + posed + TICK
    free, loaded, out = free[::PACES], loaded[::PACES], out[::PACES]
    if command.guard == "none":
        return Stretch(command=command, times=free, motors=out)
    return Stretch(command=command, times=loaded, motors=out, free_times=free if command.guard == "break_contact" else None)


def _straight_body(kin: Kinematics, command: BodyMove, motors: Joints) -> Stretch:
    way = BodyWay.of(kin, command, motors)
    if way.length == 0.0:
        return Stretch(command=command, times=np.zeros(1), motors=motors[None].copy())
    fractions = np.linspace(0.0, 1.0, 1 + PACES * _pieces(way.length, STRAIGHT_SPACING))
    out = np.array([way.at(float(f)) for f in fractions])
    rate = kin.spec.speed_loaded * command.speed_scale
    times = _paced(fractions * way.length / WHEEL_SPEED, out, rate)
    times[1:] += _posed(out[0], motors, rate) + TICK
    return Stretch(command=command, times=times[::PACES], motors=out[::PACES])


def _drive(kin: Kinematics, command: Drive, motors: Joints) -> Stretch:
    """Steers, rolls from rest to rest and steers back; sampled evenly along the way, the turned ankles left out of the posture."""
    spec = kin.spec
    if command.speed > spec.drive_speed * (1 + 1e-9):
        raise BadCommandError(f"drive speed {command.speed:.2f} m/s is above {spec.name}'s {spec.drive_speed:.2f} m/s")
    length = float(np.linalg.norm(command.translation_in_hex))
    covered = np.linspace(0.0, length, 1 + _pieces(length, 4.0 * STRAIGHT_SPACING))
    top = min(command.speed, float(np.sqrt(DRIVE_ACCELERATION * length)))
    ramp = min(0.5 * top**2 / DRIVE_ACCELERATION, 0.5 * length)

    def up_to(way: float) -> float:
        if way <= ramp:
            return float(np.sqrt(2.0 * way / DRIVE_ACCELERATION))
        return top / DRIVE_ACCELERATION + (way - ramp) / top

    half = up_to(0.5 * length)
    steer = _steering(kin, command, motors) / spec.speed_loaded if length > 0.0 else 0.0
    times = np.array([up_to(c) if c <= 0.5 * length else 2.0 * half - up_to(length - c) for c in covered]) + steer
    times[0], times[-1] = 0.0, times[-1] + HALT + steer
    return Stretch(command=command, times=times, motors=np.repeat(motors[None], len(times), axis=0))


def _steering(kin: Kinematics, command: Drive, motors: Joints) -> float:
    """By how much the ankle turns that has to turn most, so that all wheels roll along the way [rad]."""
    across, turns = float(np.arctan2(command.translation_in_hex[0], -command.translation_in_hex[1])), []
    for leg in range(LEGS):
        axle = kin.leg_wheel(leg, motors[leg]).rotation[:, 1]
        turn = float((np.arctan2(axle[1], axle[0]) - across + 0.5 * np.pi) % np.pi - 0.5 * np.pi)
        angle = motors[leg, -1] + turn
        if not kin.spec.lower[-1] <= angle <= kin.spec.upper[-1]:
            raise OutOfReachError(f"leg {leg + 1} cannot steer to {np.rad2deg(angle):.0f} deg", leg)
        turns.append(abs(turn))
    return max(turns)


def _pieces(length: float, spacing: float) -> int:
    return int(np.clip(np.ceil(length / spacing), 1, MOST_SAMPLES))


def _posed(begin: Joints, motors: Joints, rate: float) -> float:
    """Until the joints have the closed form's angles for where the wheels are [s]."""
    return float(np.abs(begin - motors).max()) / rate


def _paced(times: np.ndarray, motors: np.ndarray, rate: float) -> np.ndarray:
    """The times, each piece as long as its fastest joint needs [s]."""
    turned = np.abs(np.diff(motors, axis=0)).reshape(len(motors) - 1, -1).max(axis=1)
    return np.concatenate([[0.0], np.cumsum(np.maximum(np.diff(times), turned / rate))])


