"""Largest static joint torque of many stances that differ in where one leg stands, by rigid zero-interaction loads.

Two stances are judged of each place: the five others carrying while the leg is in the air above the place, as far lifted as the
caller says, and all six with the wheel down. The other legs' torques are linear in their wheels' forces, so their matrices are taken from
Pinocchio once; the moving leg's own are summed over its links here, for all places at once.
"""

from __future__ import annotations

import numpy as np

from athlete_twin.errors import SupportError
from athlete_twin.geometry.arrays import Joints, Points3
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.kinematics import GRAVITY, Kinematics
from athlete_twin.model.leg_torques import leg_torques
from athlete_twin.model.spec import LEGS
from athlete_twin.model.statics import wheel_loads
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
    lifted: np.ndarray | None = None,
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
        lifted: the leg's angles in the air above each place, shape (n, dof), finite [rad]; None for a wheel just off the ground.
        payload_kg: [kg]
    """
    in_air = q if lifted is None else lifted
    if in_air.shape != q.shape:
        raise SupportError(f"lifted angles have shape {in_air.shape}, the landed ones {q.shape}; each place needs both")
    spec, n = kinematics.spec, len(q)
    hex_from_world = world_from_hex.inverse()
    down = hex_from_world.rotate(-UP)
    contacts = np.broadcast_to(kinematics.wheels_in_hex(joints) + spec.wheel.radius * down, (n, LEGS, 3)).copy()
    contacts[:, leg] = hex_from_world.apply(places)
    weight = (spec.mass + payload_kg) * GRAVITY
    held, push = _other_legs(kinematics, joints, leg, down)
    others = [other for other in range(LEGS) if other != leg]
    # Five wheels that balance no moment are the same five for all places: refused once, by name.
    at_others = kinematics.wheels_in_hex(joints)[others] + spec.wheel.radius * down
    wheel_loads(at_others, kinematics.com_in_hex(joints, payload_kg), weight=weight, gravity_direction=down)
    peak = np.zeros(n)
    for standing, angles in ((others, in_air), (list(range(LEGS)), q)):
        com = com_with_leg(kinematics, joints, leg, angles, payload_kg)
        forces = zero_interaction(contacts[:, standing], com, weight=weight, down=down)
        on_others = forces[:, [standing.index(other) for other in others]]
        torques = held + np.einsum("ojk,nok->noj", push, on_others)
        peak = np.maximum(peak, np.abs(torques / spec.torque_limits).max(axis=(1, 2)))
        own = forces[:, standing.index(leg)] if leg in standing else np.zeros((n, 3))
        mine = leg_torques(spec, leg, angles, force_in_hex=own, contact_in_hex=contacts[:, leg], gravity_in_hex=GRAVITY * down)
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
