"""The load-bearing workspace: where a leg can carry, which is less than where it can reach ([SunSpiral2012] s7.1).

A leg that carries stands with its last link plumb, and its static torques, gravity of every link included, stay within the
joints' limits. The load is taken to act through the wheel's patch, straight against gravity.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from athlete_twin.errors import SupportError
from athlete_twin.geometry.arrays import Points3, Vec3
from athlete_twin.model.kinematics import GRAVITY
from athlete_twin.model.leg_torques import leg_torques
from athlete_twin.model.reach import leg_ik
from athlete_twin.model.spec import LEGS, RobotSpec

DOWN = np.array([0.0, 0.0, -1.0])


@dataclass(frozen=True, eq=False, kw_only=True)
class LoadBearing:
    """What one leg can do at n places."""

    joints: np.ndarray
    """angles with the last link plumb, shape (n, dof), NaN where it does not reach [rad]"""
    torque_fraction: np.ndarray
    """largest static joint torque over its limit under the load, shape (n,), NaN where it does not reach"""
    reaches: np.ndarray
    """shape (n,)"""
    carries: np.ndarray
    """reaches, and no joint is beyond the fraction that was allowed, shape (n,)"""


def load_bearing(
    spec: RobotSpec,
    leg: int,
    wheels_in_hex: Points3,
    *,
    load: float,
    max_torque_fraction: float = 1.0,
    gravity_direction: Vec3 = DOWN,
) -> LoadBearing:
    """Where one leg can carry a load.

    Args:
        spec: the drawings.
        leg: index 0 to 5.
        wheels_in_hex: axle centres, shape (n, 3) [m].
        load: on the wheel, against gravity [N]; a sixth of the weight on six wheels, up to a third on five.
        max_torque_fraction: of each joint's limit.
        gravity_direction: in hex; any length.
    """
    if not 0 <= leg < LEGS:
        raise SupportError(f"leg index {leg} is outside 0 to 5")
    if not (np.isfinite(load) and load >= 0.0):
        raise SupportError(f"load is {load} N, must be 0 or more")
    if not max_torque_fraction > 0.0:
        raise SupportError(f"max_torque_fraction is {max_torque_fraction}, must be positive; 1.0 is the joints' limit")
    size = float(np.linalg.norm(gravity_direction))
    if not (np.isfinite(size) and size > 0.0):
        raise SupportError(f"gravity direction {gravity_direction} has no length")
    bad = int(np.sum(~np.isfinite(wheels_in_hex)))
    if bad:
        raise SupportError(f"{bad} values of the wheels' places are not finite, all must be")
    down = np.asarray(gravity_direction, dtype=float) / size
    joints, reaches = leg_ik(spec, leg, wheels_in_hex, last_link_in_hex=down)
    found = np.flatnonzero(reaches)
    torques = leg_torques(
        spec, leg, joints[found], force_in_hex=np.broadcast_to(-load * down, (len(found), 3)),
        contact_in_hex=np.asarray(wheels_in_hex)[found] + spec.wheel.radius * down, gravity_in_hex=GRAVITY * down,
    )  # fmt: skip
    fraction = np.full(len(joints), np.nan)
    fraction[found] = np.abs(torques / spec.torque_limits).max(axis=1)
    return LoadBearing(
        joints=joints, torque_fraction=fraction, reaches=reaches, carries=reaches & (fraction <= max_torque_fraction)
    )
