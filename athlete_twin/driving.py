"""Driving on the wheels: all six are steered across the way, roll, and are steered back.

With the last link vertical the ankle roll is the steering axis, so a wheel can roll any way without moving a foot.
"""

from __future__ import annotations

import numpy as np

from athlete_twin.geometry.arrays import Joints, LegJoints, PerLeg, Vec3, Wheels
from athlete_twin.messages import Drive
from athlete_twin.model.kinematics import GRAVITY, Kinematics
from athlete_twin.model.spec import LEGS, RobotSpec
from athlete_twin.moves import MoveFailedError, Steps, copyable

ACCELERATION = 0.3
"""of the chassis [m/s2]"""
HALT = 0.3
"""between rolling and steering back, for the chassis to come to rest [s]"""
PATCH_DEPTH = 0.2
"""a tyre pressed in by d rolls on R - 0.2 d: the mean height of its patch, weighted by depth"""


@copyable
def drive_move(kin: Kinematics, command: Drive, start: Joints, dt: float, wheel_rates: PerLeg) -> Steps:
    """All wheels along one line. Writes the wheels' rates on their forks into `wheel_rates`, shape (6,) [rad/s]."""
    spec = kin.spec
    if command.speed > spec.drive_speed * (1 + 1e-9):
        raise MoveFailedError(
            "bad_command", f"drive speed {command.speed:.2f} m/s is above {spec.name}'s {spec.drive_speed:.2f} m/s"
        )
    length = float(np.linalg.norm(command.translation_in_hex))
    steered = start.copy()
    if length > 0.0:
        way = np.append(command.translation_in_hex / length, 0.0)
        for leg in range(LEGS):
            steered[leg] = steered_along(kin, leg, start[leg], way)
    yield from _steer(spec, start, steered, dt)
    along = _rolling_in_hex(kin, steered)
    turn = np.sign(along @ way) / rolling_radius(spec) if length > 0.0 else np.zeros(LEGS)
    speed = covered = 0.0
    while covered < length:
        brake = np.sqrt(2.0 * ACCELERATION * (length - covered))
        speed = min(speed + ACCELERATION * dt, command.speed, max(brake, ACCELERATION * dt))
        covered += speed * dt
        wheel_rates[:] = turn * speed
        yield steered
    wheel_rates[:] = 0.0
    for _ in range(round(HALT / dt)):
        yield steered
    yield from _steer(spec, steered, start, dt)


def steered_along(kin: Kinematics, leg: int, q: LegJoints, way: Vec3) -> LegJoints:
    """The leg's angles with its ankle rolled so that the wheel rolls along `way` in hex, forwards or backwards [rad]."""
    axle = kin.leg_wheel(leg, q).rotation[:, 1]
    across = np.arctan2(way[0], -way[1])
    turn = (np.arctan2(axle[1], axle[0]) - across + 0.5 * np.pi) % np.pi - 0.5 * np.pi
    out = q.copy()
    out[-1] += turn
    if not kin.spec.lower[-1] <= out[-1] <= kin.spec.upper[-1]:
        raise MoveFailedError("unreachable", f"leg {leg + 1} cannot steer to {np.rad2deg(out[-1]):.0f} deg", leg)
    return out


def rolling_radius(spec: RobotSpec) -> float:
    """Of a wheel that carries its share of the weight, as believed [m]."""
    return float(spec.wheel.radius - PATCH_DEPTH * spec.mass * GRAVITY / (LEGS * spec.believed_tyre_stiffness))


def rolling_velocities(kin: Kinematics, joints: Joints, wheel_rates: PerLeg) -> Wheels:
    """Velocities of the axles over the ground in hex, nothing slipping, shape (6, 3) [m/s]."""
    return np.asarray(_rolling_in_hex(kin, joints) * (wheel_rates * rolling_radius(kin.spec))[:, None])


def _rolling_in_hex(kin: Kinematics, joints: Joints) -> Wheels:
    """Horizontal direction in which each wheel rolls for a positive rate on its fork, shape (6, 3)."""
    axles = np.array([kin.leg_wheel(leg, joints[leg]).rotation[:, 1] for leg in range(LEGS)])
    along = np.cross(axles, [0.0, 0.0, 1.0])
    return np.asarray(along / np.linalg.norm(along, axis=1, keepdims=True))


def _steer(spec: RobotSpec, origin: Joints, target: Joints, dt: float) -> Steps:
    ticks = int(np.ceil(np.abs(target - origin).max() / (spec.speed_loaded * dt)))
    for k in range(1, ticks + 1):
        yield origin + (target - origin) * (k / ticks)


