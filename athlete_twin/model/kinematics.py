"""Forward kinematics, centre of mass and gravity torques of the drawn robot, by Pinocchio from the generated URDF.

The chassis is rigid here: T12's docks are drawn at zero, wheels are locked. What the docks really do is the truth's.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import pinocchio as pin

from athlete_twin.assets import robot_dir
from athlete_twin.errors import AssetError, KinematicsError
from athlete_twin.geometry.arrays import Joints, LegJoints, Points3, Vec3, Wheels
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.spec import LEGS, RobotSpec, load_spec

GRAVITY = 9.81
"""[m/s2]"""


class Kinematics:
    """Pinocchio's model of one robot with the hex frame fixed. Holds scratch memory: one object a thread."""

    def __init__(self, spec: RobotSpec) -> None:
        self.spec = spec
        urdf = robot_dir(spec.name) / "robot.urdf"
        if not urdf.is_file():
            raise AssetError(f"{urdf.name} of {spec.name} is missing; run scripts/build_assets.py")
        # Links and joints share their names in the URDF; Pinocchio's reduction looks frames up by name alone.
        text = urdf.read_text().replace('<joint name="', '<joint name="joint_')
        full = pin.buildModelFromXML(text)
        locked = [full.getJointId(n) for n in full.names if n.startswith(("joint_wheel", "joint_dock"))]
        self.pin_model: Any = pin.buildReducedModel(full, locked, pin.neutral(full))
        self.pin_data: Any = self.pin_model.createData()
        model = self.pin_model
        self._q_of = np.array(
            [[model.joints[model.getJointId(f"joint_leg{leg + 1}_{n}")].idx_q for n in spec.joint_names] for leg in range(LEGS)]
        )
        self._wheel_frames = [model.getFrameId(f"wheel{leg + 1}", pin.FrameType.BODY) for leg in range(LEGS)]
        chassis = model.inertias[0]
        pin.centerOfMass(model, self.pin_data, pin.neutral(model))
        self._moving = float(self.pin_data.mass[0])
        self.chassis_mass, self.chassis_moment = float(chassis.mass), chassis.mass * np.asarray(chassis.lever)
        self._top = np.array([0.0, 0.0, spec.top_in_hex])
        self._link_frames = {f.name: i for i, f in enumerate(model.frames) if f.type == pin.FrameType.BODY}

    def pin_q(self, joints: Joints) -> np.ndarray:
        """Pinocchio's configuration vector of joint angles (6, dof) [rad]."""
        joints = np.asarray(joints, dtype=float)
        if joints.shape != (LEGS, self.spec.dof) or not np.isfinite(joints).all():
            raise KinematicsError(f"joints have shape {joints.shape}, need finite ({LEGS}, {self.spec.dof})")
        q = np.zeros(self.pin_model.nq)
        q[self._q_of] = joints
        return q

    def wheels_in_hex(self, joints: Joints) -> Wheels:
        """Axle centres in hex, shape (6, 3) [m]."""
        self._place(joints)
        placed = self.pin_data.oMf
        return np.array([placed[frame].translation for frame in self._wheel_frames])

    def leg_wheel(self, leg: int, q: LegJoints) -> SE3:
        """`hex_from_wheel` of one leg, the others being anywhere."""
        joints = np.zeros((LEGS, self.spec.dof))
        joints[leg] = q
        self._place(joints)
        placed = self.pin_data.oMf[self._wheel_frames[leg]]
        return SE3(placed.rotation, placed.translation)

    def leg_jacobian(self, leg: int, q: LegJoints) -> np.ndarray:
        """Derivative of the axle's position in hex by the leg's joints, shape (3, dof) [m/rad]."""
        joints = np.zeros((LEGS, self.spec.dof))
        joints[leg] = q
        full = pin.computeFrameJacobian(
            self.pin_model, self.pin_data, self.pin_q(joints), self._wheel_frames[leg], pin.LOCAL_WORLD_ALIGNED
        )
        return np.asarray(full[:3, self._q_of[leg]])

    def com_in_hex(self, joints: Joints, payload_kg: float = 0.0) -> Vec3:
        """Centre of mass in hex [m]; a payload sits on the deck plane's centre."""
        if not 0.0 <= payload_kg < np.inf:
            raise KinematicsError(f"payload is {payload_kg} kg, must be 0 or more")
        legs = np.asarray(pin.centerOfMass(self.pin_model, self.pin_data, self.pin_q(joints)))
        # Pinocchio counts what moves; the chassis, which it holds fixed, is added here.
        moment = self._moving * legs + self.chassis_moment + payload_kg * self._top
        return np.asarray(moment / (self._moving + self.chassis_mass + payload_kg))

    def link_poses(self, joints: Joints) -> dict[str, SE3]:
        """`hex_from_link` of every link by its URDF name."""
        self._place(joints)
        placed = self.pin_data.oMf
        return {n: SE3(placed[i].rotation, placed[i].translation) for n, i in self._link_frames.items()}

    def gravity_torques(self, joints: Joints, gravity_in_hex: Vec3, wheel_forces_in_hex: Wheels, contact_in_hex: Points3) -> Joints:
        """Torques that the joints must give to hold the legs against gravity and ground, shape (6, dof) [N m].

        Args:
            joints: angles, shape (6, dof) [rad].
            gravity_in_hex: acceleration of gravity, about (0, 0, -9.81) on a level chassis [m/s2].
            wheel_forces_in_hex: forces of the ground on the wheels, shape (6, 3) [N].
            contact_in_hex: where these act, shape (6, 3) [m].
        """
        q = self.pin_q(joints)
        self.pin_model.gravity.linear = np.asarray(gravity_in_hex, dtype=float)
        torques = np.asarray(pin.computeGeneralizedGravity(self.pin_model, self.pin_data, q))[self._q_of]
        # The joints' screws at the origin of hex, each against the force on its own leg's wheel and the force's moment there.
        screws = np.asarray(pin.computeJointJacobians(self.pin_model, self.pin_data, q))[:, self._q_of]
        moments = _crossed(contact_in_hex, wheel_forces_in_hex)
        for k in range(3):
            torques -= screws[k] * wheel_forces_in_hex[:, k, None] + screws[3 + k] * moments[:, k, None]
        return np.asarray(torques)

    def ground_force(self, leg: int, joints: Joints, torques: LegJoints, gravity_in_hex: Vec3) -> Vec3:
        """Force of the ground on one wheel that the leg's torques speak of, in hex [N], least squares.

        The force is taken to act a wheel's radius below the axle along gravity, where the patch of a standing wheel is.
        """
        q = self.pin_q(joints)
        self.pin_model.gravity.linear = np.asarray(gravity_in_hex, dtype=float)
        gravity = np.asarray(pin.computeGeneralizedGravity(self.pin_model, self.pin_data, q))[self._q_of[leg]]
        patch = self._patch(leg, q, gravity_in_hex)
        return np.asarray(np.linalg.lstsq(patch.T, gravity - torques, rcond=None)[0])

    def patch_jacobian(self, leg: int, joints: Joints, gravity_in_hex: Vec3) -> np.ndarray:
        """Derivative of the wheel's lowest point, held to its fork, in hex by the leg's joints, shape (3, dof) [m/rad]."""
        return self._patch(leg, self.pin_q(joints), gravity_in_hex)

    def _patch(self, leg: int, q: np.ndarray, gravity_in_hex: Vec3) -> np.ndarray:
        full = pin.computeFrameJacobian(self.pin_model, self.pin_data, q, self._wheel_frames[leg], pin.LOCAL_WORLD_ALIGNED)
        jacobian = full[:, self._q_of[leg]]
        arm = self.spec.wheel.radius * gravity_in_hex / np.linalg.norm(gravity_in_hex)
        return np.asarray(jacobian[:3] - _crossed(arm, jacobian[3:].T).T)

    def _place(self, joints: Joints) -> None:
        pin.forwardKinematics(self.pin_model, self.pin_data, self.pin_q(joints))
        pin.updateFramePlacements(self.pin_model, self.pin_data)


@lru_cache(maxsize=8)
def kinematics(robot: str) -> Kinematics:
    """A shared `Kinematics` of a robot by its name, for single-threaded use."""
    return Kinematics(load_spec(robot))


def _crossed(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """`np.cross` of vectors (..., 3), to the last bit, in less than half of its time: the executive asks at every tick."""
    x, y, z = a[..., 0], a[..., 1], a[..., 2]
    u, v, w = b[..., 0], b[..., 1], b[..., 2]
    out = np.empty(np.broadcast_shapes(a.shape, b.shape))
    out[..., 0], out[..., 1], out[..., 2] = y * w - z * v, z * u - x * w, x * v - y * u
    return out
