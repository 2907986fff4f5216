"""Plans to command sequences: the last thing the ground does before the link.

A step goes up as one sequence, so it costs one command cycle: lift-off, swing, descent (guarded or to its planned end), chassis
shift, pictures for the next step. The executive stops it at the first fault.
"""

from __future__ import annotations

import numpy as np

from athlete_twin.geometry.arrays import LegJoints, Vec3
from athlete_twin.messages import BodyMove, Command, CommandSequence, ImageRequest, JointMove, LegMove
from athlete_twin.model.kinematics import Kinematics
from athlete_twin.model.reach import leg_ik
from planner.gait.step_plan import BodyShift, StepPlan

SMALLEST_SHIFT = 1e-3
"""below this in metres and radians a shift is left out"""


def step_commands(plan: StepPlan) -> list[Command]:
    """Lift-off, swing, descent and shift of one step."""
    commands: list[Command] = []
    if plan.lift_in_hex is not None:
        commands.append(LegMove(leg=plan.leg, wheel_in_hex=plan.lift_in_hex, guard="break_contact"))
    commands.append(JointMove(leg=plan.leg, waypoints=plan.swing, corner_tolerance=plan.swing_corner_tolerance))
    commands += lower_commands(plan, plan.descent_in_hex)
    return commands + shift_commands(plan.shift)


def shift_commands(shift: BodyShift) -> list[Command]:
    """The chassis shift, if it is worth a command."""
    parts = (shift.translation_in_hex, shift.rotvec_in_hex, shift.wheel_offsets_in_hex)
    if max(float(np.abs(part).max()) for part in parts) < SMALLEST_SHIFT:
        return []
    return [
        BodyMove(
            translation_in_hex=shift.translation_in_hex,
            rotvec_in_hex=shift.rotvec_in_hex,
            wheel_offsets_in_hex=shift.wheel_offsets_in_hex,
        )
    ]


def lower_commands(plan: StepPlan, axle_in_hex: Vec3) -> list[Command]:
    """The descent of a step alone, at most to `axle_in_hex` [m]: the ground may lie lower than the map said."""
    return [LegMove(leg=plan.leg, wheel_in_hex=axle_in_hex, guard=plan.descent_guard, contact_load=plan.contact_load)]


def straighten_commands(
    kinematics: Kinematics, leg: int, motors: LegJoints, down_in_hex: Vec3, *, tolerance: float
) -> list[Command]:
    """Brings a leg to the posture of straight moves where its wheel is; nothing where it has it, or does not reach it.

    A leg that a fault stopped on a sampled way through the air has its rolls turned; the executive goes straight only with
    rolls at zero and the last link plumb.

    Args:
        kinematics: of the robot.
        leg: index 0 to 5.
        motors: of the leg, shape (dof,) [rad].
        down_in_hex: where gravity points.
        tolerance: a posture so near is straight [rad].
    """
    axle = kinematics.leg_wheel(leg, motors).translation
    q, reached = leg_ik(kinematics.spec, leg, axle[None], last_link_in_hex=down_in_hex)
    if not reached[0] or float(np.abs(q[0] - motors).max()) <= tolerance:
        return []
    return [JointMove(leg=leg, waypoints=q)]


def as_sequence(
    commands: list[Command],
    *,
    robot_id: str,
    sequence_id: int,
    t: float,
    cameras: tuple[str, ...] = (),
    binning: int = 2,
    max_torque_fraction: float = 1.0,
    max_tilt: float = 0.35,
) -> CommandSequence:
    """Commands, and pictures after them, as one sequence to send up at mission time `t` [s]."""
    all_commands = [*commands, ImageRequest(cameras=cameras, binning=binning)] if cameras else commands
    return CommandSequence(
        seq=sequence_id,
        robot_id=robot_id,
        t=t,
        sequence_id=sequence_id,
        commands=tuple(all_commands),
        max_torque_fraction=max_torque_fraction,
        max_tilt=max_tilt,
    )
