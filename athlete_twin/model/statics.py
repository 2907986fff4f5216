"""Static loads of a stance, with rigid contacts: wheel forces by zero interaction, and the joint torques they ask for.

Six equations of balance leave the forces on more than two wheels open. The smallest forces in the least-squares sense
(the pseudo-inverse) are the zero-interaction solution ([SunSpiral2012] s5.1.1): along the line between any two wheels
their forces have equal projections, so no leg works against another. It knows neither friction nor that ground cannot
pull: far off the centre of the polygon a force may come out negative.
"""

from __future__ import annotations

import numpy as np

from athlete_twin.errors import SupportError
from athlete_twin.geometry.arrays import Joints, PerLegFlag, Points3, Vec3, Wheels
from athlete_twin.model.kinematics import GRAVITY, Kinematics

DOWN = np.array([0.0, 0.0, -1.0])


def wheel_loads(
    contacts: Points3, com: Vec3, *, weight: float, gravity_direction: Vec3 = DOWN
) -> Points3:
    """Zero-interaction forces of the ground on the supporting wheels, shape (n, 3) [N], in the frame of the arguments.

    Args:
        contacts: points where the wheels are supported, shape (n, 3) [m]; at least three, not on one line.
        com: centre of mass [m].
        weight: of the robot with payload [N].
        gravity_direction: where gravity points; any length.
    """
    contacts = np.asarray(contacts, dtype=float)
    if contacts.ndim != 2 or contacts.shape[1] != 3 or len(contacts) < 3:
        raise SupportError(f"contacts have shape {contacts.shape}, at least 3 wheels carry a robot")
    if not (np.isfinite(weight) and weight > 0.0):
        raise SupportError(f"weight is {weight} N, must be positive")
    size = float(np.linalg.norm(gravity_direction))
    if not size > 0.0:
        raise SupportError(f"gravity direction {gravity_direction} has no length")
    up = -np.asarray(gravity_direction, dtype=float) / size
    if not (np.isfinite(contacts).all() and np.isfinite(com).all()):
        bad = int(np.sum(~np.isfinite(contacts)))
        raise SupportError(f"contacts and centre of mass {com} must be finite, {bad} values of contacts are not")
    wanted = np.concatenate([up, np.zeros(3)])
    forces, _, rank, _ = np.linalg.lstsq(balance_matrix(contacts, com), wanted, rcond=1e-9)
    if rank < 6:
        raise SupportError(f"{len(contacts)} wheels on one line balance no moment; move one of them sideways")
    return np.asarray(weight * forces.reshape(-1, 3))


def balance_matrix(contacts: Points3, com: Vec3) -> np.ndarray:
    """Sum of forces and of moments about the centre of mass, by the forces on m wheels, shape (6, 3 m)."""
    return np.concatenate([np.concatenate([np.eye(3), _cross_matrix(p - com)]) for p in contacts], axis=1)


def stance_loads(
    kinematics: Kinematics,
    joints: Joints,
    *,
    supporting: PerLegFlag,
    gravity_in_hex: Vec3 | None = None,
    payload_kg: float = 0.0,
) -> tuple[Wheels, Wheels]:
    """Zero-interaction forces on all wheels (6, 3) [N], zero in the air, and where they act (6, 3) [m], in hex.

    The contact is taken a wheel's radius below the axle along gravity: the tyre's unloaded patch on level ground.
    """
    gravity = GRAVITY * DOWN if gravity_in_hex is None else np.asarray(gravity_in_hex, dtype=float)
    contacts = patches_in_hex(kinematics, joints, gravity)
    weight = (kinematics.spec.mass + payload_kg) * float(np.linalg.norm(gravity))
    com = kinematics.com_in_hex(joints, payload_kg)
    forces = np.zeros((6, 3))
    forces[supporting] = wheel_loads(contacts[supporting], com, weight=weight, gravity_direction=gravity)
    return forces, contacts


def patches_in_hex(kinematics: Kinematics, joints: Joints, gravity_in_hex: Vec3) -> Wheels:
    """Where the ground touches the wheels, a radius below the axles along gravity, shape (6, 3) [m]."""
    size = float(np.linalg.norm(gravity_in_hex))
    if not (np.isfinite(size) and size > 0.0):
        raise SupportError(f"gravity {gravity_in_hex} m/s2 has no direction")
    return np.asarray(kinematics.wheels_in_hex(joints) + kinematics.spec.wheel.radius * gravity_in_hex / size)


def torque_fractions(
    kinematics: Kinematics,
    joints: Joints,
    *,
    wheel_forces_in_hex: Wheels,
    contact_in_hex: Wheels,
    gravity_in_hex: Vec3 | None = None,
) -> Joints:
    """Static joint torques over their limits, shape (6, dof); the sign is the torque's."""
    gravity = GRAVITY * DOWN if gravity_in_hex is None else np.asarray(gravity_in_hex, dtype=float)
    torques = kinematics.gravity_torques(joints, gravity, wheel_forces_in_hex, contact_in_hex)
    return np.asarray(torques / kinematics.spec.torque_limits)


def peak_torque_fraction(
    kinematics: Kinematics,
    joints: Joints,
    *,
    supporting: PerLegFlag,
    gravity_in_hex: Vec3 | None = None,
    payload_kg: float = 0.0,
) -> float:
    """Largest joint torque of a stance over its limit, with zero-interaction wheel forces."""
    forces, contacts = stance_loads(
        kinematics, joints, supporting=supporting, gravity_in_hex=gravity_in_hex, payload_kg=payload_kg
    )
    fractions = torque_fractions(
        kinematics, joints, wheel_forces_in_hex=forces, contact_in_hex=contacts, gravity_in_hex=gravity_in_hex
    )
    return float(np.abs(fractions).max())


def _cross_matrix(v: Vec3) -> np.ndarray:
    """The matrix whose product with a force is the moment of that force acting at `v`."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
