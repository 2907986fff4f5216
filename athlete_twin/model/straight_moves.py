"""Straight moves of a wheel or of the chassis, as joint angles: the same on the robot and on the ground.

The executive follows these ways one control tick at a time; the preview says beforehand where they lead, and whether they can be
followed at all. A wheel goes along a line in hex, its last link keeping its direction; the chassis goes along a line and about an
axis, every wheel staying where it is but for its commanded offset.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from athlete_twin.errors import KinematicsError
from athlete_twin.geometry.arrays import Joints, LegJoints, Vec3, Wheels
from athlete_twin.geometry.se3 import SE3
from athlete_twin.messages import BodyMove, LegMove
from athlete_twin.model.kinematics import Kinematics
from athlete_twin.model.reach import all_legs_ik, leg_ik
from athlete_twin.model.spec import LEGS

WHEEL_SPEED = 0.15
"""of straight moves at most [m/s]"""
DESCENT_SPEED = 0.06
"""of a guarded descent: a tyre takes 1 kN/m x 0.06 m/s x one tick more than asked for [m/s]"""
BRANCH_TOLERANCE = 0.03
"""a straight move starts only where the closed-form solution agrees with the joints this well [rad]"""
CHECKED_POINTS = 16
"""of a way checked for reach before it begins"""


class OutOfReachError(KinematicsError):
    """A straight move leads where a leg cannot follow, or begins in a posture that straight moves do not have."""

    def __init__(self, text: str, leg: int) -> None:
        super().__init__(text)
        self.leg = leg


@dataclass(frozen=True, eq=False, kw_only=True)
class LegWay:
    """The way of one wheel along a line in hex."""

    kin: Kinematics
    leg: int
    origin_in_hex: Vec3
    """axle at its begin [m]"""
    last_link_in_hex: Vec3
    """direction of the last link, all the way"""
    span_in_hex: Vec3
    """from begin to end [m]"""

    @staticmethod
    def of(kin: Kinematics, command: LegMove, start: Joints) -> LegWay:
        """The way of a command from where the motors are, (6, dof) [rad]; raises `OutOfReachError` if it cannot be gone."""
        pose = kin.leg_wheel(command.leg, start[command.leg])
        way = LegWay(
            kin=kin, leg=command.leg, origin_in_hex=pose.translation, last_link_in_hex=pose.rotation[:, 0],
            span_in_hex=command.wheel_in_hex - pose.translation,
        )  # fmt: skip
        _check_posture(command.leg, way.at(0.0), start[command.leg])
        for fraction in np.linspace(0.0, 1.0, CHECKED_POINTS)[1:]:
            way.at(float(fraction))
        return way

    @property
    def length(self) -> float:
        """From begin to end [m]."""
        return float(np.linalg.norm(self.span_in_hex))

    def at(self, fraction: float) -> LegJoints:
        """Motor angles of the leg after so much of the way, shape (dof,) [rad]."""
        place = self.origin_in_hex + fraction * self.span_in_hex
        q, ok = leg_ik(self.kin.spec, self.leg, place[None], last_link_in_hex=self.last_link_in_hex)
        if not ok[0]:
            raise _out_of_reach(self.leg, place)
        return np.asarray(q[0])


@dataclass(frozen=True, eq=False, kw_only=True)
class BodyWay:
    """The way of the chassis over wheels that stay."""

    kin: Kinematics
    command: BodyMove
    wheels_in_hex: Wheels
    """axles at its begin [m]"""
    last_links_in_hex: Wheels
    """directions of the last links there"""

    @staticmethod
    def of(kin: Kinematics, command: BodyMove, start: Joints) -> BodyWay:
        """The way of a command from where the motors are, (6, dof) [rad]; raises `OutOfReachError` if it cannot be gone."""
        poses = [kin.leg_wheel(leg, start[leg]) for leg in range(LEGS)]
        way = BodyWay(
            kin=kin, command=command, wheels_in_hex=np.array([p.translation for p in poses]),
            last_links_in_hex=np.array([p.rotation[:, 0] for p in poses]),
        )  # fmt: skip
        posed = way.at(0.0)
        for leg in range(LEGS):
            _check_posture(leg, posed[leg], start[leg])
        for fraction in np.linspace(0.0, 1.0, CHECKED_POINTS)[1:]:
            way.at(float(fraction))
        return way

    @property
    def length(self) -> float:
        """Of the longest way of a part: a turn counts at 2 m from its axis [m]."""
        command = self.command
        size = max(float(np.linalg.norm(command.translation_in_hex)), 2.0 * float(np.linalg.norm(command.rotvec_in_hex)))
        return max(size, float(np.abs(command.wheel_offsets_in_hex).max()))

    def start_from_hex(self, fraction: float) -> SE3:
        """The chassis after so much of the way, in its own frame at the begin."""
        return SE3.from_rotvec(fraction * self.command.rotvec_in_hex, fraction * self.command.translation_in_hex)

    def at(self, fraction: float) -> Joints:
        """Motor angles of all legs after so much of the way, shape (6, dof) [rad]."""
        hex_from_start = self.start_from_hex(fraction).inverse()
        targets = hex_from_start.apply(self.wheels_in_hex) + fraction * self.command.wheel_offsets_in_hex
        joints, ok = all_legs_ik(self.kin.spec, targets, last_link_in_hex=hex_from_start.rotate(self.last_links_in_hex))
        if not ok.all():
            leg = int(np.argmin(ok))
            raise _out_of_reach(leg, targets[leg])
        return joints


def _out_of_reach(leg: int, wheel_in_hex: Vec3) -> OutOfReachError:
    return OutOfReachError(f"leg {leg + 1} cannot put its wheel at {np.round(wheel_in_hex, 3)} in hex", leg)


def _check_posture(leg: int, solved: LegJoints, now: LegJoints) -> None:
    off = float(np.abs(solved - now).max())
    if off > BRANCH_TOLERANCE:
        raise OutOfReachError(
            f"leg {leg + 1} is {np.rad2deg(off):.1f} deg off the posture of straight moves (rolls zero, knee up); "
            "bring it there with a joint move first",
            leg,
        )
