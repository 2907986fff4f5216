"""What the ground believes of the robot, against motions whose truth is known."""

from dataclasses import replace

import numpy as np
import pytest

from athlete_twin.geometry.se3 import SE3
from athlete_twin.messages import Telemetry
from athlete_twin.model.kinematics import GRAVITY, Kinematics
from athlete_twin.model.reach import all_legs_ik
from athlete_twin.model.spec import load_spec
from athlete_twin.model.stance import regular_stance
from athlete_twin.model.statics import stance_loads
from planner.belief import BeliefFilter
from planner.perception.localise import WheelFitConfig
from planner.sag.sag_model import FootSprings

ROBOTS = ("sdm_b", "t12")


def telemetry(joints: np.ndarray, rpy=(0.0, 0.0, 0.0), torques: np.ndarray | None = None) -> Telemetry:
    return Telemetry(
        seq=0, robot_id="x", t=0.0, joints=joints, motors=joints, torques=np.zeros_like(joints) if torques is None else torques,
        attitude_rpy=np.array(rpy), rates=np.zeros(3), acceleration=np.array([0.0, 0.0, GRAVITY]), executive_state="idle",
        sequence_id=-1, command_index=0,
    )  # fmt: skip


def filter_of(robot: str) -> BeliefFilter:
    spec = load_spec(robot)
    return BeliefFilter(Kinematics(spec), FootSprings.from_spec(spec), payload_kg=0.0, config=WheelFitConfig())


@pytest.mark.parametrize("robot", ROBOTS)
def test_the_start_defines_the_world(robot):
    belief = filter_of(robot).update(telemetry(regular_stance(load_spec(robot))))
    assert belief.world_from_hex.translation[:2] == pytest.approx([0.0, 0.0])
    assert belief.contacts_in_world[:, 2].mean() == pytest.approx(0.0, abs=1e-9)
    assert belief.loads.sum() == pytest.approx(load_spec(robot).mass * GRAVITY, rel=1e-6)


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_chassis_shift_over_planted_wheels_is_seen_by_the_joints(robot):
    spec, filtered = load_spec(robot), filter_of(robot)
    joints = regular_stance(spec)
    first = filtered.update(telemetry(joints))
    wheels = Kinematics(spec).wheels_in_hex(joints)
    move = SE3.from_rpy(0.0, 0.0, 0.02, np.array([0.10, -0.05, -0.03]))
    moved, ok = all_legs_ik(spec, move.inverse().apply(wheels))
    assert ok.all()
    second = filtered.update(telemetry(moved))
    change = first.world_from_hex.inverse().compose(second.world_from_hex)
    assert change.translation == pytest.approx(move.translation, abs=3e-3)
    assert change.rpy()[2] == pytest.approx(0.02, abs=2e-3)
    assert second.fit_rmse < 5e-3


def test_a_wheel_that_came_down_gets_its_anchor_where_it_stands():
    spec, filtered = load_spec("sdm_b"), filter_of("sdm_b")
    joints = regular_stance(spec)
    first = filtered.update(telemetry(joints))
    wheels = Kinematics(spec).wheels_in_hex(joints)
    wheels[0] += [0.3, 0.1, 0.0]
    stepped, ok = all_legs_ik(spec, wheels)
    assert ok.all()
    filtered.lift(0)
    in_air = filtered.update(telemetry(stepped))
    assert not in_air.planted[0]
    assert in_air.loads[0] == 0.0
    filtered.land(0)
    landed = filtered.update(telemetry(stepped))
    assert landed.contacts_in_world[0, :2] - first.contacts_in_world[0, :2] == pytest.approx([0.3, 0.1], abs=5e-3)
    assert landed.world_from_hex.translation == pytest.approx(first.world_from_hex.translation, abs=0.02)


def test_a_wheel_that_was_told_to_stand_and_does_not_keeps_its_last_contact():
    """A descent was completed, and a fault after it shows that the wheel hangs: nobody has seen it stand anywhere else."""
    filtered, joints = filter_of("sdm_b"), regular_stance(load_spec("sdm_b"))
    first = filtered.update(telemetry(joints))
    filtered.lift(2)
    filtered.land(2)
    filtered.lift(2)
    hanging = filtered.update(telemetry(joints))
    assert not hanging.planted[2]
    np.testing.assert_array_equal(hanging.contacts_in_world[2], first.contacts_in_world[2])


def test_legs_that_fight_are_told_from_their_torques():
    spec, filtered = load_spec("sdm_b"), filter_of("sdm_b")
    kin, joints = Kinematics(spec), regular_stance(spec)
    gravity = np.array([0.0, 0.0, -GRAVITY])
    share = spec.mass * GRAVITY / 6
    forces = np.tile([0.0, 0.0, share], (6, 1))
    forces[0, 0] += 200.0  # leg 1 pushed outward, leg 4 as much the other way
    forces[3, 0] -= 200.0
    contacts = kin.wheels_in_hex(joints) - [0.0, 0.0, spec.wheel.radius]
    belief = filtered.update(telemetry(joints, torques=kin.gravity_torques(joints, gravity, forces, contacts)))
    wanted = np.zeros((6, 3))
    wanted[0, 0], wanted[3, 0] = 200.0, -200.0
    assert belief.interaction == pytest.approx(wanted, abs=2.0)


def test_the_map_can_move_the_world_under_the_robot():
    filtered = filter_of("sdm_b")
    joints = regular_stance(load_spec("sdm_b"))
    before = filtered.update(telemetry(joints))
    filtered.shift_world(SE3.from_translation(np.array([0.02, -0.01, 0.0])))
    after = filtered.update(telemetry(joints))
    moved = after.world_from_hex.translation - before.world_from_hex.translation
    assert moved == pytest.approx([0.02, -0.01, 0.0], abs=1e-3)


def test_loads_of_a_stance_that_the_springs_do_not_hold_are_those_of_rigid_balance():
    """Wheels 1 to 3 alone: the centre of mass lies outside. What the balance has pushing is believed, what it has pulling is not."""
    spec, filtered = load_spec("sdm_b"), filter_of("sdm_b")
    joints = regular_stance(spec)
    filtered.update(telemetry(joints))
    for leg in (3, 4, 5):
        filtered.lift(leg)
    told = telemetry(joints)
    gravity = np.array([0.0, 0.0, -GRAVITY])
    assert not filtered.stance(joints, gravity, filtered.planted).converged
    belief = filtered.update(told)
    rigid, _ = stance_loads(Kinematics(spec), joints, supporting=filtered.planted)
    assert rigid[:, 2].min() < 0.0
    np.testing.assert_allclose(belief.loads, np.maximum(rigid[:, 2], 0.0), rtol=0.01, atol=10.0)


@pytest.mark.parametrize("robot", ["sdm_b", "t12"])
def test_the_stiffness_of_joints_is_read_from_torques_and_wind_up(robot):
    spec, filtered = load_spec(robot), filter_of(robot)
    joints = regular_stance(spec)
    stiffness = np.linspace(3e4, 1e5, spec.dof)
    wind_up = np.random.default_rng(0).uniform(-0.02, 0.02, joints.shape)
    wound = replace(telemetry(joints, torques=wind_up * stiffness), motors=joints + wind_up)
    np.testing.assert_allclose(filtered.update(wound).joint_stiffness, stiffness, rtol=1e-9)
    assert np.isinf(filtered.update(telemetry(joints)).joint_stiffness).all()
