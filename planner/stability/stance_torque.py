"""Largest static joint torque of many stances that differ in where one leg stands, by rigid zero-interaction loads.

Two stances are judged of each place: the five others carrying while the leg is in the air, its mass above the place, and all
six with the wheel down. The other legs' torques are linear in their wheels' forces, so their matrices are taken from
Pinocchio once; the moving leg's own are summed over its links here, for all places at once.
"""

from __future__ import annotations

from typing import no_type_check

import numba
import numpy as np

from athlete_twin.geometry.arrays import Joints, Points3
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.kinematics import GRAVITY, Kinematics
from athlete_twin.model.spec import LEGS, RobotSpec
from planner.stability.stability_map import com_with_leg

UP = np.array([0.0, 0.0, 1.0])


def peak_torques(
    kinematics: Kinematics,
    joints: Joints,
    leg: int,
    q: np.ndarray,
    *,
    places: Points3,
    world_from_hex: SE3,
    payload_kg: float = 0.0,
) -> np.ndarray:
    """Largest joint torque over its limit, with the leg in the air and on the ground, the larger, shape (n,).

    Args:
        kinematics: of the drawings.
        joints: of all legs, shape (6, dof) [rad]; the leg's own row does not matter.
        leg: index 0 to 5.
        q: the leg's angles with its wheel on each place, shape (n, dof), finite [rad].
        places: contacts in world, shape (n, 3) [m].
        world_from_hex: the chassis.
        payload_kg: [kg]
    """
    spec, n = kinematics.spec, len(q)
    hex_from_world = world_from_hex.inverse()
    down = hex_from_world.rotate(-UP)
    contacts = np.broadcast_to(kinematics.wheels_in_hex(joints) + spec.wheel.radius * down, (n, LEGS, 3)).copy()
    contacts[:, leg] = hex_from_world.apply(places)
    com = com_with_leg(kinematics, joints, leg, q, payload_kg)
    weight = (spec.mass + payload_kg) * GRAVITY
    held, push = _other_legs(kinematics, joints, leg, down)
    others = [other for other in range(LEGS) if other != leg]
    peak = np.zeros(n)
    for standing in (others, list(range(LEGS))):
        forces = zero_interaction(contacts[:, standing], com, weight=weight, down=down)
        on_others = forces[:, [standing.index(other) for other in others]]
        torques = held + np.einsum("ojk,nok->noj", push, on_others)
        peak = np.maximum(peak, np.abs(torques / spec.torque_limits).max(axis=(1, 2)))
        own = forces[:, standing.index(leg)] if leg in standing else np.zeros((n, 3))
        mine = leg_torques(spec, leg, q, force_in_hex=own, contact_in_hex=contacts[:, leg], gravity_in_hex=GRAVITY * down)
        peak = np.maximum(peak, np.abs(mine / spec.torque_limits).max(axis=1))
    return peak


def zero_interaction(contacts: np.ndarray, com: np.ndarray, *, weight: float, down: np.ndarray) -> np.ndarray:
    """Least-norm forces on m wheels of n stances, shape (n, m, 3) [N]: `model.statics.wheel_loads` for many at once.

    Args:
        contacts: shape (n, m, 3) [m].
        com: shape (n, 3) [m].
        weight: [N]
        down: where gravity points, of length 1.
    """
    arms = contacts - com[:, None]
    n, m = arms.shape[:2]
    balance = np.zeros((n, 6, 3 * m))
    for wheel in range(m):
        x, y, z = arms[:, wheel].T
        columns = balance[:, :, 3 * wheel : 3 * wheel + 3]
        columns[:, :3] = np.eye(3)
        columns[:, 3, 1], columns[:, 3, 2] = -z, y
        columns[:, 4, 0], columns[:, 4, 2] = z, -x
        columns[:, 5, 0], columns[:, 5, 1] = -y, x
    wanted = np.concatenate([-weight * down, np.zeros(3)])
    square = balance @ balance.transpose(0, 2, 1)
    multipliers = np.linalg.solve(square, np.broadcast_to(wanted[:, None], (n, 6, 1)))
    return np.asarray((balance.transpose(0, 2, 1) @ multipliers)[..., 0].reshape(n, m, 3))


def leg_torques(
    spec: RobotSpec,
    leg: int,
    q: np.ndarray,
    *,
    force_in_hex: np.ndarray,
    contact_in_hex: np.ndarray,
    gravity_in_hex: np.ndarray,
) -> np.ndarray:
    """Torques that one leg's joints must give in n configurations, shape (n, dof) [N m], with gravity of every link.

    Args:
        spec: the drawings.
        leg: index 0 to 5.
        q: shape (n, dof) [rad].
        force_in_hex: of the ground on the wheel, shape (n, 3) [N].
        contact_in_hex: where it acts, shape (n, 3) [m].
        gravity_in_hex: [m/s2]
    """
    return np.asarray(
        _torques(
            np.ascontiguousarray(q, dtype=np.float64),
            np.array([joint.axis for joint in spec.joints], dtype=np.float64),
            np.array([joint.offset for joint in spec.joints], dtype=np.float64),
            np.array([joint.link_mass for joint in spec.joints], dtype=np.float64),
            np.array([joint.link_com for joint in spec.joints], dtype=np.float64),
            np.array(spec.wheel.offset, dtype=np.float64),
            float(spec.wheel.mass),
            np.array(spec.hips_in_hex[leg], dtype=np.float64),
            float(spec.hip_azimuths[leg]),
            np.ascontiguousarray(force_in_hex, dtype=np.float64),
            np.ascontiguousarray(contact_in_hex, dtype=np.float64),
            np.array(gravity_in_hex, dtype=np.float64),
        )
    )


def _other_legs(kinematics: Kinematics, joints: Joints, leg: int, down: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Torques of the five other legs without forces (5, dof), and their change by each wheel's force (5, dof, 3)."""
    spec = kinematics.spec
    contacts = kinematics.wheels_in_hex(joints) + spec.wheel.radius * down
    others = [other for other in range(LEGS) if other != leg]
    held = kinematics.gravity_torques(joints, GRAVITY * down, np.zeros((LEGS, 3)), contacts)[others]
    push = np.empty((len(others), held.shape[1], 3))
    for axis in range(3):
        unit = np.zeros((LEGS, 3))
        unit[:, axis] = 1.0
        push[:, :, axis] = kinematics.gravity_torques(joints, GRAVITY * down, unit, contacts)[others] - held
    return held, push


@numba.njit(cache=True)
@no_type_check
def _torques(q, axes, offsets, masses, coms, wheel_offset, wheel_mass, hip, azimuth, force, contact, gravity):
    """Each joint holds what hangs behind it: -(axis . ((m (c - p)) x g + (contact - p) x f)), c the CoM of all behind."""
    n, dof = q.shape
    out = np.empty((n, dof))
    turn, next_turn, step = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    places, lines, centres, at = np.empty((dof, 3)), np.empty((dof, 3)), np.empty((dof + 1, 3)), np.empty(3)
    for k in range(n):
        c, s = np.cos(azimuth), np.sin(azimuth)
        turn[:] = 0.0
        turn[0, 0], turn[0, 1], turn[1, 0], turn[1, 1], turn[2, 2] = c, -s, s, c, 1.0
        at[:] = hip
        for j in range(dof + 1):
            for a in range(3):
                for b in range(3):
                    at[a] += turn[a, b] * (offsets[j, b] if j < dof else wheel_offset[b])
            if j == dof:
                centres[j] = at
                break
            # Rodrigues' formula about the joint's own axis.
            x, y, z = axes[j, 0], axes[j, 1], axes[j, 2]
            c, s = np.cos(q[k, j]), np.sin(q[k, j])
            v = 1.0 - c
            step[0, 0], step[0, 1], step[0, 2] = c + x * x * v, x * y * v - z * s, x * z * v + y * s
            step[1, 0], step[1, 1], step[1, 2] = y * x * v + z * s, c + y * y * v, y * z * v - x * s
            step[2, 0], step[2, 1], step[2, 2] = z * x * v - y * s, z * y * v + x * s, c + z * z * v
            for a in range(3):
                places[j, a] = at[a]
                lines[j, a] = turn[a, 0] * x + turn[a, 1] * y + turn[a, 2] * z
                for b in range(3):
                    next_turn[a, b] = turn[a, 0] * step[0, b] + turn[a, 1] * step[1, b] + turn[a, 2] * step[2, b]
            turn[:] = next_turn
            for a in range(3):
                centres[j, a] = at[a] + turn[a, 0] * coms[j, 0] + turn[a, 1] * coms[j, 1] + turn[a, 2] * coms[j, 2]
        mass, mx, my, mz = wheel_mass, wheel_mass * at[0], wheel_mass * at[1], wheel_mass * at[2]
        fx, fy, fz = force[k, 0], force[k, 1], force[k, 2]
        for i in range(dof - 1, -1, -1):
            mass += masses[i]
            mx += masses[i] * centres[i, 0]
            my += masses[i] * centres[i, 1]
            mz += masses[i] * centres[i, 2]
            px, py, pz = places[i, 0], places[i, 1], places[i, 2]
            ax, ay, az = mx - mass * px, my - mass * py, mz - mass * pz
            bx, by, bz = contact[k, 0] - px, contact[k, 1] - py, contact[k, 2] - pz
            tx = ay * gravity[2] - az * gravity[1] + by * fz - bz * fy
            ty = az * gravity[0] - ax * gravity[2] + bz * fx - bx * fz
            tz = ax * gravity[1] - ay * gravity[0] + bx * fy - by * fx
            out[k, i] = -(lines[i, 0] * tx + lines[i, 1] * ty + lines[i, 2] * tz)
    return out
