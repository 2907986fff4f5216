"""Static joint torques of one leg in many configurations at once, with gravity of every link and a force on the wheel.

The same as Pinocchio's `Kinematics.gravity_torques`, which takes one configuration of the whole robot.
"""

from __future__ import annotations

from typing import no_type_check

import numba
import numpy as np

from athlete_twin.model.spec import RobotSpec


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
