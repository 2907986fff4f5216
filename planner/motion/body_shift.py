"""Shifts of the chassis over planted wheels, checked for reach, joint steps and collisions before a command is written.

Place in the flow: gait -> body shift -> sequence (one `BodyMove`). The chassis moves on a straight line and about one
axis while every wheel stays where it is and every last link keeps its direction in world (vertical, if it was): just as
the executive will do it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from athlete_twin.errors import PlanningError
from athlete_twin.geometry.arrays import Joints, Vec3, Wheels
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.kinematics import Kinematics
from athlete_twin.model.reach import leg_ik
from athlete_twin.model.spec import LEGS
from planner.motion.collision import BodyCollision
from planner.motion.sbl import NoPath


@dataclass(frozen=True, kw_only=True)
class BodyShiftConfig:
    """Settings of body shifts."""

    step: float = 0.025
    """between checked poses [m]; a turn counts by its arc at one metre"""
    max_joint_step: float = 0.15
    """largest joint motion between two poses: more means a leg near full stretch [rad]"""
    branch_tolerance: float = 0.03
    """largest difference of the legs' posture from the closed form's; the executive refuses more [rad]"""

    def __post_init__(self) -> None:
        if not (self.step > 0.0 and self.max_joint_step > 0.0 and self.branch_tolerance > 0.0):
            raise PlanningError("step, max_joint_step and branch_tolerance must be positive")


@dataclass(frozen=True, eq=False, kw_only=True)
class BodyPath:
    """A shift of the chassis that reaches and collides nowhere."""

    joints: np.ndarray
    """at each pose, the start first, shape (k, 6, dof) [rad]"""
    world_from_hex: tuple[SE3, ...]
    """k poses of the chassis"""
    checks: int
    """poses checked for collision"""


def plan_body_shift(
    kinematics: Kinematics,
    joints: Joints,
    world_from_hex: SE3,
    *,
    translation_in_hex: Vec3,
    rotvec_in_hex: Vec3,
    wheel_offsets_in_hex: Wheels,
    collision: BodyCollision,
    config: BodyShiftConfig,
) -> BodyPath | NoPath:
    """Path of the whole robot during a `BodyMove` with the same arguments, or which check refused it.

    Args:
        kinematics: of the drawn robot.
        joints: as it stands, shape (6, dof) [rad].
        world_from_hex: as it stands.
        translation_in_hex: of the chassis, in its frame at the start [m].
        rotvec_in_hex: rotation of the chassis, in its frame at the start [rad].
        wheel_offsets_in_hex: shift of each axle by the end, shape (6, 3) [m].
        collision: of the whole robot.
        config: settings.
    """
    placed = [kinematics.leg_wheel(leg, joints[leg]) for leg in range(LEGS)]
    wheels = np.array([p.translation for p in placed])
    directions = np.array([p.rotation[:, 0] for p in placed])
    size = max(float(np.linalg.norm(v)) for v in (translation_in_hex, rotvec_in_hex, *wheel_offsets_in_hex))
    fractions = np.linspace(0.0, 1.0, 1 + max(1, int(np.ceil(size / config.step))))
    start_from_hex = [SE3.from_rotvec(s * rotvec_in_hex, s * translation_in_hex) for s in fractions]
    path = np.empty((len(fractions), LEGS, kinematics.spec.dof))
    for n, (s, moved) in enumerate(zip(fractions, start_from_hex, strict=True)):
        hex_from_start = moved.inverse()
        targets = hex_from_start.apply(wheels) + s * wheel_offsets_in_hex
        solved = _all_legs(kinematics, targets, hex_from_start.rotate(directions))
        if isinstance(solved, str):
            return NoPath(reason="unreachable", checks=0, detail=f"{solved}, {100 * s:.0f} % of the way")
        path[n] = solved
    off = float(np.abs(path[0] - joints).max())
    if off > config.branch_tolerance:
        detail = f"a leg is {np.rad2deg(off):.1f} deg off the closed form, allowed {np.rad2deg(config.branch_tolerance):.1f}"
        return NoPath(reason="off_branch", checks=0, detail=detail)
    steps = np.abs(np.diff(path, axis=0))
    if steps.max() > config.max_joint_step:
        _, leg, joint = np.unravel_index(int(np.argmax(steps)), steps.shape)
        name = kinematics.spec.joint_names[int(joint)]
        detail = f"{name} of leg {leg + 1} moves {np.rad2deg(steps.max()):.1f} deg within {config.step} m of shift"
        return NoPath(reason="joint_step", checks=0, detail=detail)
    poses = tuple(world_from_hex.compose(moved) for moved in start_from_hex)
    for n, (row, pose) in enumerate(zip(path, poses, strict=True)):
        hit = collision.first_collision(row, pose)
        if hit is not None:
            return NoPath(reason="collides", checks=n + 1, detail=f"{hit}, {100 * fractions[n]:.0f} % of the way")
    return BodyPath(joints=path, world_from_hex=poses, checks=len(poses))


def _all_legs(kinematics: Kinematics, targets: np.ndarray, directions: np.ndarray) -> np.ndarray | str:
    """Joint angles (6, dof) that put the axles at the targets; else who cannot."""
    spec = kinematics.spec
    out = np.empty((LEGS, spec.dof))
    for leg in range(LEGS):
        at = targets[leg : leg + 1]
        q, ok = leg_ik(spec, leg, at, last_link_in_hex=directions[leg])
        if not ok[0]:
            return f"leg {leg + 1} cannot put its wheel at {np.round(at[0], 3)} in hex"
        out[leg] = q[0]
    return out
