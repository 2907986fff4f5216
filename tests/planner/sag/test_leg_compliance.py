"""A leg's compliance at its patch: by finite differences through the statics, and the forces of held wheels by balance."""

import numpy as np
import pytest

from athlete_twin.errors import SagError
from athlete_twin.model.kinematics import GRAVITY, kinematics
from athlete_twin.model.spec import load_spec
from athlete_twin.model.stance import regular_stance
from planner.sag.leg_compliance import held_response, patch_compliance, series_stiffness

LEVEL = np.array([0.0, 0.0, -GRAVITY])
ROBOTS = pytest.mark.parametrize("robot", ["sdm_b", "t12"])


def stance(robot, seed=0):
    spec = load_spec(robot)
    rng = np.random.default_rng(seed)
    return spec, kinematics(robot), regular_stance(spec) + rng.normal(0.0, 0.05, (6, spec.dof))


def patch(kin, leg, joints, gravity):
    """Lowest point of the wheel as its fork carries it: fixed to the fork as it is at `joints`."""
    down = gravity / np.linalg.norm(gravity)
    fixed = kin.leg_wheel(leg, joints[leg])
    arm = fixed.rotation.T @ (kin.spec.wheel.radius * down)
    return lambda q: kin.leg_wheel(leg, q).apply(arm)


@ROBOTS
def test_the_patch_moves_as_its_jacobian_says(robot):
    spec, kin, joints = stance(robot)
    gravity = np.array([0.5, -0.3, -9.79])
    for leg in range(6):
        at = patch(kin, leg, joints, gravity)
        slopes = np.array([(at(joints[leg] + d) - at(joints[leg] - d)) / 2e-6 for d in 1e-6 * np.eye(spec.dof)]).T
        np.testing.assert_allclose(kin.patch_jacobian(leg, joints, gravity), slopes, atol=1e-6)


@ROBOTS
def test_compliance_is_what_winding_joints_and_a_tyre_give_way(robot):
    """A force on the patch loads each joint by the statics' own torque; each winds up by torque over stiffness."""
    spec, kin, joints = stance(robot, 1)
    k = np.random.default_rng(2).uniform(3e4, 1e5, spec.dof)
    found = patch_compliance(kin, joints, k, LEVEL)
    contacts = kin.wheels_in_hex(joints) + spec.wheel.radius * LEVEL / GRAVITY
    for leg in (0, 3):
        for axis in range(3):
            pushed = np.zeros((6, 3))
            pushed[leg, axis] = 1e-3
            with_push, without = (kin.gravity_torques(joints, LEVEL, f, contacts)[leg] for f in (pushed, np.zeros((6, 3))))
            # The joints hold `with_push`: they are wound back by what the push asks.
            moved = patch(kin, leg, joints, LEVEL)(joints[leg] - (with_push - without) / k) - patch(kin, leg, joints, LEVEL)(joints[leg])
            tyre = np.eye(3)[axis] / (spec.believed_tyre_stiffness * (1.0 if axis == 2 else spec.believed_lateral_ratio))
            np.testing.assert_allclose(found[leg, :, axis], moved / 1e-3 + tyre, rtol=1e-3, atol=1e-9)


@ROBOTS
def test_rigid_joints_leave_the_tyre(robot):
    spec, kin, joints = stance(robot)
    found = patch_compliance(kin, joints, np.full(spec.dof, np.inf), LEVEL)
    k, lateral = spec.believed_tyre_stiffness, spec.believed_lateral_ratio
    np.testing.assert_allclose(found, np.broadcast_to(np.diag([1 / (lateral * k), 1 / (lateral * k), 1 / k]), (6, 3, 3)), atol=1e-15)


@ROBOTS
def test_held_wheels_answer_in_balance_and_go_nowhere_but_with_the_chassis(robot):
    spec, kin, joints = stance(robot, 3)
    compliance = patch_compliance(kin, joints, np.full(spec.dof, 4e4), LEVEL)
    contacts = kin.wheels_in_hex(joints) + spec.wheel.radius * LEVEL / GRAVITY
    standing = np.arange(6) != 4
    change = np.where(standing, np.random.default_rng(4).uniform(-1e3, 3e3, 6), 0.0)
    held = held_response(compliance, change, contacts, standing, LEVEL)
    forces = held.forces
    assert not forces[4].any() and forces[:, 2] == pytest.approx(0.0, abs=1e-9)
    scale = np.abs(forces).sum()
    assert np.abs(forces.sum(axis=0)).max() < 1e-9 * scale
    assert abs(np.cross(contacts, forces)[:, 2].sum()) < 1e-9 * scale
    # Each patch goes aside by the same motion of the chassis: two ways and a turn explain all of it.
    whole = forces + change[:, None] * [0.0, 0.0, 1.0]
    aside = np.einsum("nij,nj->ni", compliance, whole)[standing, :2]
    x, y = contacts[standing, 0], contacts[standing, 1]
    rows = np.concatenate([np.column_stack([np.ones(5), np.zeros(5), -y]), np.column_stack([np.zeros(5), np.ones(5), x])])
    went = aside.T.ravel()
    left = went - rows @ np.linalg.lstsq(rows, went, rcond=None)[0]
    assert np.abs(left).max() < 1e-12
    # ... which is the motion told: a foot that the ground holds goes the other way in hex.
    moved = held.hex_from_moved
    expected = -moved.translation - np.cross(moved.rotvec(), contacts[standing])
    np.testing.assert_allclose(aside, expected[:, :2], atol=1e-12)


@ROBOTS
def test_what_a_lifted_wheel_held_goes_to_the_others_and_moves_the_chassis_that_way(robot):
    spec, kin, joints = stance(robot, 5)
    compliance = patch_compliance(kin, joints, np.full(spec.dof, 4e4), LEVEL)
    contacts = kin.wheels_in_hex(joints) + spec.wheel.radius * LEVEL / GRAVITY
    standing = np.arange(6) != 1
    released = np.zeros((6, 3))
    released[1] = [-300.0, 200.0, 3000.0]
    held = held_response(compliance, np.zeros(6), contacts, standing, LEVEL, released=released)
    np.testing.assert_allclose(held.forces.sum(axis=0), [-300.0, 200.0, 0.0], atol=1e-9)
    turn = np.cross(contacts, held.forces)[:, 2].sum()
    assert turn == pytest.approx(np.cross(contacts[1], [-300.0, 200.0, 0.0])[2])
    # The ground pushed the wheel, and through it the chassis, that way: without it the chassis goes the other way.
    assert held.hex_from_moved.translation @ released[1] < 0.0


def test_stiffness_is_torque_over_wind_up_and_infinite_where_nothing_winds():
    k = np.array([1e5, 5e4, 3e4])
    wind_up = np.array([[1e-3, 2e-2, 0.0], [-3e-3, 1e-5, 5e-5]] * 3)
    np.testing.assert_allclose(series_stiffness(wind_up * k, wind_up), [1e5, 5e4, np.inf])


def test_stiffness_that_is_none_is_refused():
    spec, kin, joints = stance("sdm_b")
    with pytest.raises(SagError, match="must be positive"):
        patch_compliance(kin, joints, np.zeros(spec.dof), LEVEL)
