import numpy as np
import pytest

from athlete_twin.geometry.se3 import SE3
from athlete_twin.messages import BodyMove, LegMove
from athlete_twin.model.kinematics import GRAVITY, kinematics
from athlete_twin.model.reach import all_legs_ik
from athlete_twin.model.stance import stance_wheels_in_hex
from planner.belief import Belief
from planner.gait.level_lift import lift_commands, pose_before_lift
from planner.sag.lift_pose import LiftPose, NoPose, PoseConfig
from planner.sag.sag_model import FootSprings, solve_sag

TENTH_OF_A_MILLIMETRE, TEN_MICRORADIANS = 1e-4, 1e-5
DOWN = np.array([0.0, 0.0, -1.0])


def _believed(robot, unsagged: SE3, springs, planted=None):
    """A robot on level ground whose chassis was commanded to a pose and has sagged from there."""
    kin = kinematics(robot)
    contacts = stance_wheels_in_hex(kin.spec) + [0.0, 0.0, kin.spec.chassis_height]
    axles = unsagged.inverse().apply(contacts)
    motors, reached = all_legs_ik(kin.spec, axles, last_link_in_hex=unsagged.inverse().rotate(DOWN))
    assert reached.all()
    sag = solve_sag(
        axles, kin.com_in_hex(motors), kin.spec.mass * GRAVITY, stiffness_z=springs.stiffness_z,
        lateral_ratio=springs.lateral_ratio, lifts=np.zeros(6), gravity_in_hex=unsagged.inverse().rotate(DOWN),
    )  # fmt: skip
    assert sag.converged
    return Belief(
        t=0.0, joints=motors, motors=motors, world_from_hex=unsagged.compose(sag.unsagged_from_sagged),
        contacts_in_world=contacts - [0.0, 0.0, kin.spec.wheel.radius],
        planted=np.ones(6, dtype=bool) if planted is None else planted,
        loads=sag.forces[:, 2], interaction=np.zeros((6, 3)), fit_rmse=0.0,
    )  # fmt: skip


@pytest.mark.parametrize("robot", ["sdm_b", "t12"])
def test_a_tilted_low_robot_is_level_at_the_drawn_height_once_the_leg_is_up(robot):
    kin = kinematics(robot)
    drawn = FootSprings.from_spec(kin.spec)
    springs = FootSprings(stiffness_z=drawn.stiffness_z * [1.1, 0.9, 1.0, 1.05, 0.95, 1.0], lateral_ratio=drawn.lateral_ratio)
    unsagged = SE3.from_rpy(0.02, -0.03, 0.1, np.array([0.3, -0.1, kin.spec.chassis_height - 0.04]))
    belief = _believed(robot, unsagged, springs)
    pose = pose_before_lift(kin, springs, belief, 0, clearance=0.2, config=PoseConfig(), payload_kg=0.0)
    assert isinstance(pose, LiftPose), pose
    world_from_commanded = unsagged.compose(SE3.from_rotvec(pose.move.rotvec_in_hex, pose.move.translation_in_hex))
    chassis = world_from_commanded.compose(pose.airborne.unsagged_from_sagged)
    assert chassis.translation[2] == pytest.approx(kin.spec.chassis_height, abs=TENTH_OF_A_MILLIMETRE)
    assert chassis.rotation[:, 2] == pytest.approx([0.0, 0.0, 1.0], abs=TEN_MICRORADIANS)
    assert np.linalg.norm(chassis.translation[:2] - unsagged.translation[:2]) <= 0.1 + TENTH_OF_A_MILLIMETRE
    axle = chassis.apply(pose.lift_in_hex)
    assert axle - belief.contacts_in_world[0] == pytest.approx([0.0, 0.0, kin.spec.wheel.radius + 0.2], abs=TENTH_OF_A_MILLIMETRE)


def test_commands_are_the_move_and_a_guarded_lift():
    kin = kinematics("sdm_b")
    springs = FootSprings.from_spec(kin.spec)
    belief = _believed("sdm_b", SE3.from_translation(np.array([0.0, 0.0, kin.spec.chassis_height])), springs)
    pose = pose_before_lift(kin, springs, belief, 3, clearance=0.2, config=PoseConfig(), payload_kg=0.0)
    move, lift = lift_commands(pose)
    assert isinstance(move, BodyMove) and move is pose.move
    assert isinstance(lift, LegMove) and lift.guard == "break_contact" and lift.leg == 3


def test_a_robot_that_cannot_stand_gets_a_reason():
    kin = kinematics("sdm_b")
    springs = FootSprings.from_spec(kin.spec)
    pose = SE3.from_translation(np.array([0.0, 0.0, kin.spec.chassis_height]))
    belief = _believed("sdm_b", pose, springs, planted=np.array([True, True, True, False, False, False]))
    answer = pose_before_lift(kin, springs, belief, 0, clearance=0.2, config=PoseConfig(), payload_kg=0.0)
    assert isinstance(answer, NoPose)
    assert answer.reason == "the springs say tips as the robot stands"
