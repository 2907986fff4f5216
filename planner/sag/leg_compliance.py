"""How a standing leg gives way: its joints' springs and its tyre, seen at the patch, as its posture has them.

Place in the flow: belief (stiffness, posture) -> what a force between feet and ground stretches -> `gait.relax`, predicted torques.

The robot reads its torques from the wind-up of its joints, so telemetry tells the stiffness: torque over wind-up. At the patch
the springs of all joints and of the tyre add up to a 3 x 3 compliance. It is far from the point springs of [SunSpiral2012] eq. 3:
sideways a leg is many times softer than its tyre, and where its knee lies beside the line of force, weight alone drives a wheel
aside. A wheel that the ground holds answers with a force that loads the knee; the more weight it takes over, the more.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from athlete_twin.errors import SagError
from athlete_twin.geometry.arrays import Joints, LegJoints, PerLeg, PerLegFlag, Vec3, Wheels
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.kinematics import Kinematics
from athlete_twin.model.spec import LEGS

Compliances = Float[np.ndarray, "6 3 3"]

WOUND = 1e-4
"""of a joint below which its wind-up is not told from the encoders' steps [rad]"""


def series_stiffness(torques: Joints, wind_up: Joints) -> LegJoints:
    """Of each joint of a leg, all legs alike, shape (dof,) [N m/rad]; infinite where no leg shows any wind-up.

    Args:
        torques: as the robot reads them, shape (6, dof) [N m].
        wind_up: motor angles less joint angles, the same shape [rad].
    """
    wound = np.abs(wind_up) > WOUND
    work = np.sum(np.where(wound, torques * wind_up, 0.0), axis=0)
    square = np.sum(np.where(wound, wind_up**2, 0.0), axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        found = work / square
    return np.asarray(np.where((square > 0.0) & (found > 0.0), found, np.inf))


def patch_compliance(
    kinematics: Kinematics, joints: Joints, joint_stiffness: LegJoints, gravity_in_hex: Vec3
) -> Compliances:
    """By how much each wheel's patch gives way under a force on it, the chassis held, in hex, shape (6, 3, 3) [m/N].

    Args:
        kinematics: of the drawings.
        joints: shape (6, dof) [rad].
        joint_stiffness: shape (dof,) [N m/rad]; infinite for a rigid joint.
        gravity_in_hex: where gravity points.
    """
    spec = kinematics.spec
    if not (joint_stiffness > 0.0).all():  # NaN too
        raise SagError(f"joint stiffnesses are {list(joint_stiffness)} N m/rad, must be positive")
    up = -gravity_in_hex / np.linalg.norm(gravity_in_hex)
    vertical = np.outer(up, up)
    tyre = (vertical + (np.eye(3) - vertical) / spec.believed_lateral_ratio) / spec.believed_tyre_stiffness
    jacobians = [kinematics.patch_jacobian(leg, joints, gravity_in_hex) for leg in range(LEGS)]
    return np.array([tyre + (jacobian / joint_stiffness) @ jacobian.T for jacobian in jacobians])


@dataclass(frozen=True, eq=False, kw_only=True)
class HeldResponse:
    """What a change of loads brings sideways while the ground holds the wheels."""

    forces: Wheels
    """horizontal ones that come on top, in hex, shape (6, 3) [N]"""
    hex_from_moved: SE3
    """by which the chassis goes along, horizontally and about the vertical"""


def held_response(
    compliance: Compliances,
    load_change: PerLeg,
    contacts_in_hex: Wheels,
    standing: PerLegFlag,
    gravity_in_hex: Vec3,
    *,
    released: Wheels | None = None,
) -> HeldResponse:
    """Horizontal forces, and the chassis' motion, that come with a change of the wheels' loads, nothing slipping.

    Each leg would go aside as its load changes; the ground holds its wheel. The chassis goes along, horizontally and about the
    vertical, until the forces balance.

    Args:
        compliance: `patch_compliance` of the stance.
        load_change: of the vertical loads, shape (6,) [N].
        contacts_in_hex: shape (6, 3) [m].
        standing: which wheels the ground holds, shape (6,).
        gravity_in_hex: where gravity points.
        released: forces of the ground on wheels that leave it, which the others take over, shape (6, 3) [N]; none by default.
    """
    up = -gravity_in_hex / np.linalg.norm(gravity_in_hex)
    across = horizontal(up)
    # By which chassis motions a foot goes aside in hex: two ways, and a turn about the vertical.
    turns = np.cross(up, contacts_in_hex) @ across
    follows = np.array([np.column_stack([-np.eye(2), -turn]) for turn in turns])
    stiff = np.linalg.inv(across.T @ compliance @ across)
    aside = (compliance @ up) @ across * load_change[:, None]
    on = np.flatnonzero(standing)
    # F = K (follows m - aside); what the others take over is what was released.
    normal = sum(follows[leg].T @ stiff[leg] @ follows[leg] for leg in on)
    driven = sum(follows[leg].T @ stiff[leg] @ aside[leg] for leg in on)
    if released is not None:
        driven = driven + sum(follows[leg].T @ (across.T @ released[leg]) for leg in np.flatnonzero(~standing))
    motion = np.linalg.lstsq(normal, driven, rcond=1e-9)[0]
    forces = np.zeros((LEGS, 3))
    for leg in on:
        forces[leg] = across @ (stiff[leg] @ (follows[leg] @ motion - aside[leg]))
    return HeldResponse(forces=forces, hex_from_moved=SE3.from_rotvec(motion[2] * up, across @ motion[:2]))


def horizontal(up: Vec3) -> Float[np.ndarray, "3 2"]:
    """Two unit vectors across `up`, as columns."""
    first = np.cross(up, [0.0, 1.0, 0.0])
    first /= np.linalg.norm(first)
    return np.column_stack([first, np.cross(up, first)])
