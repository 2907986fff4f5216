"""All legs placed at once: axles, centre of mass, and what then holds them, for who asks at every control tick.

The same as `Kinematics`, which asks Pinocchio part by part and spends most of its time handing arrays over. Here each joint's axis,
its place and the moment of all that hangs behind it are kept from the placing, and the torques follow from them by cross products.
"""

from __future__ import annotations

from typing import NamedTuple, no_type_check

import numba
import numpy as np

from athlete_twin.geometry.arrays import Joints, Points3, Vec3, Wheels
from athlete_twin.model.kinematics import Kinematics


class Placed(NamedTuple):
    """Legs in one posture, in hex."""

    wheels: Wheels
    """axles, shape (6, 3) [m]"""
    com: Vec3
    """centre of mass of the whole robot, without payload [m]"""
    screws: np.ndarray
    """of each joint its axis, its place [m], and mass [kg] times place [kg m] of what it moves, the mass last, shape (6, dof, 10)"""


class LegChains:
    """The drawn legs of one robot."""

    def __init__(self, kin: Kinematics) -> None:
        spec = kin.spec
        joints = spec.joints
        self._drawn = (
            np.array([joint.axis for joint in joints], dtype=np.float64),
            np.array([*(joint.offset for joint in joints), spec.wheel.offset], dtype=np.float64),
            np.array([*(joint.link_mass for joint in joints), spec.wheel.mass], dtype=np.float64),
            np.array([*(joint.link_com for joint in joints), np.zeros(3)], dtype=np.float64),
            np.ascontiguousarray(spec.hips_in_hex, dtype=np.float64),
            np.ascontiguousarray(spec.hip_azimuths, dtype=np.float64),
            kin.chassis_mass,
            np.ascontiguousarray(kin.chassis_moment),
        )

    def placed(self, joints: Joints) -> Placed:
        """The legs with their joints at these angles, shape (6, dof) [rad]."""
        return Placed(*_placed(np.ascontiguousarray(joints, dtype=np.float64), *self._drawn))

    @staticmethod
    def held(placed: Placed, gravity_in_hex: Vec3, wheel_forces_in_hex: Wheels, contact_in_hex: Points3) -> Joints:
        """`Kinematics.gravity_torques` of a posture, shape (6, dof) [N m]."""
        return np.asarray(_held(placed.screws, gravity_in_hex, wheel_forces_in_hex, contact_in_hex))


@no_type_check
@numba.njit(cache=True)
def _placed(joints, axes, offsets, masses, coms, hips, azimuths, chassis_mass, chassis_moment):  # type: ignore[no-untyped-def]
    legs, dof = joints.shape
    wheels, screws = np.empty((legs, 3)), np.empty((legs, dof, 10))
    turn, step, turned, at, moment = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty(3), chassis_moment.copy()
    weight = chassis_mass
    for leg in range(legs):
        c, s = np.cos(azimuths[leg]), np.sin(azimuths[leg])
        turn[:] = 0.0
        turn[0, 0], turn[0, 1], turn[1, 0], turn[1, 1], turn[2, 2] = c, -s, s, c, 1.0
        at[:] = hips[leg]
        for j in range(dof):
            for a in range(3):
                at[a] += turn[a, 0] * offsets[j, 0] + turn[a, 1] * offsets[j, 1] + turn[a, 2] * offsets[j, 2]
            # Rodrigues' formula about the joint's own axis.
            x, y, z = axes[j, 0], axes[j, 1], axes[j, 2]
            c, s = np.cos(joints[leg, j]), np.sin(joints[leg, j])
            v = 1.0 - c
            step[0, 0], step[0, 1], step[0, 2] = c + x * x * v, x * y * v - z * s, x * z * v + y * s
            step[1, 0], step[1, 1], step[1, 2] = y * x * v + z * s, c + y * y * v, y * z * v - x * s
            step[2, 0], step[2, 1], step[2, 2] = z * x * v - y * s, z * y * v + x * s, c + z * z * v
            for a in range(3):
                screws[leg, j, a] = turn[a, 0] * x + turn[a, 1] * y + turn[a, 2] * z
                screws[leg, j, 3 + a] = at[a]
                for b in range(3):
                    turned[a, b] = turn[a, 0] * step[0, b] + turn[a, 1] * step[1, b] + turn[a, 2] * step[2, b]
            turn[:] = turned
            for a in range(3):
                com = at[a] + turn[a, 0] * coms[j, 0] + turn[a, 1] * coms[j, 1] + turn[a, 2] * coms[j, 2]
                screws[leg, j, 6 + a] = masses[j] * com
            screws[leg, j, 9] = masses[j]
        for a in range(3):
            wheels[leg, a] = at[a] + turn[a, 0] * offsets[dof, 0] + turn[a, 1] * offsets[dof, 1] + turn[a, 2] * offsets[dof, 2]
        for a in range(3):
            behind = masses[dof] * wheels[leg, a]
            for j in range(dof - 1, -1, -1):
                behind += screws[leg, j, 6 + a]
                screws[leg, j, 6 + a] = behind
            moment[a] += behind
        behind = masses[dof]
        for j in range(dof - 1, -1, -1):
            behind += screws[leg, j, 9]
            screws[leg, j, 9] = behind
        weight += behind
    return wheels, moment / weight, screws


@no_type_check
@numba.njit(cache=True)
def _held(screws, gravity, forces, contacts):  # type: ignore[no-untyped-def]
    """Each joint holds what hangs behind it: -(axis . ((m (c - p)) x g + (contact - p) x f)), c the CoM of all behind."""
    legs, dof, _ = screws.shape
    out = np.empty((legs, dof))
    for leg in range(legs):
        fx, fy, fz = forces[leg, 0], forces[leg, 1], forces[leg, 2]
        for j in range(dof):
            lx, ly, lz = screws[leg, j, 0], screws[leg, j, 1], screws[leg, j, 2]
            px, py, pz = screws[leg, j, 3], screws[leg, j, 4], screws[leg, j, 5]
            mx, my, mz, mass = screws[leg, j, 6], screws[leg, j, 7], screws[leg, j, 8], screws[leg, j, 9]
            ax, ay, az = mx - mass * px, my - mass * py, mz - mass * pz
            bx, by, bz = contacts[leg, 0] - px, contacts[leg, 1] - py, contacts[leg, 2] - pz
            tx = ay * gravity[2] - az * gravity[1] + by * fz - bz * fy
            ty = az * gravity[0] - ax * gravity[2] + bz * fx - bx * fz
            tz = ax * gravity[1] - ay * gravity[0] + bx * fy - by * fx
            out[leg, j] = -(lx * tx + ly * ty + lz * tz)
    return out
