"""The chassis pose before a lift from what the ground believes: telemetry's motors and attitude, the wheels it holds planted.

Belief -> `planner.sag.pose` -> one `BodyMove` and one lift. What a belief says of gravity it says of the sagged chassis;
the springs are asked in the frame that the robot would have without weight, so attitude and height are turned there first.
"""

from __future__ import annotations

import numpy as np

from athlete_twin.geometry.se3 import SE3
from athlete_twin.messages import Command, LegMove
from athlete_twin.model.kinematics import GRAVITY, Kinematics
from planner.belief import Belief
from planner.sag.lift_pose import LiftPose, NoPose, PoseConfig
from planner.sag.pose import level_pose, optimise_pose
from planner.sag.sag_model import AIRBORNE, FootSprings, solve_sag

ROUNDS = 5
"""of turning gravity to the unsagged frame: sag depends little on the direction, each round gains two digits"""


def pose_before_lift(
    kin: Kinematics,
    springs: FootSprings,
    belief: Belief,
    leg: int,
    *,
    clearance: float,
    config: PoseConfig,
    payload_kg: float,
) -> LiftPose | NoPose:
    """The move after which the chassis is level and at the drawings' height while one leg of the believed robot is up.

    Args:
        kin: of the robot.
        springs: the believed springs.
        belief: the robot, with the leg planted.
        leg: index 0 to 5.
        clearance: of the lifted wheel over its place [m].
        config: bounds.
        payload_kg: on the deck.
    """
    axles, lifts = kin.wheels_in_hex(belief.motors), np.where(belief.planted, 0.0, AIRBORNE)
    com, weight = kin.com_in_hex(belief.motors, payload_kg), (kin.spec.mass + payload_kg) * GRAVITY
    sagged_gravity = belief.gravity_in_hex()
    gravity = sagged_gravity
    for _ in range(ROUNDS):
        sag = solve_sag(
            axles, com, weight, stiffness_z=springs.stiffness_z, lateral_ratio=springs.lateral_ratio, lifts=lifts,
            gravity_in_hex=gravity,
        )  # fmt: skip
        if not sag.converged:
            return NoPose(reason=f"the springs say {sag.status} as the robot stands")
        gravity = sag.unsagged_from_sagged.rotate(sagged_gravity)
    level, up = level_pose(gravity), -gravity / GRAVITY
    height = kin.spec.wheel.radius - float(np.mean((axles @ up)[belief.planted]))
    wanted = SE3(level.rotation, level.translation + (kin.spec.chassis_height - height) * up)
    return optimise_pose(
        kin, belief.motors, leg, springs=springs, clearance=clearance, config=config, lifts=lifts,
        gravity_in_hex=gravity, wanted_in_hex=wanted, payload_kg=payload_kg,
    )  # fmt: skip


def lift_commands(pose: LiftPose) -> list[Command]:
    """The chassis move and the lift itself."""
    return [pose.move, LegMove(leg=pose.leg, wheel_in_hex=pose.lift_in_hex, guard="break_contact")]
