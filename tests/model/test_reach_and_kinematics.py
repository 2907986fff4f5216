"""Kinematics against the published sizes, finite differences, virtual work, and inverse against forward."""

import numpy as np
import pytest

from athlete_twin.errors import KinematicsError
from athlete_twin.model.kinematics import GRAVITY, kinematics
from athlete_twin.model.reach import all_legs_ik, leg_ik
from athlete_twin.model.spec import load_spec
from athlete_twin.model.stance import regular_stance, stance_wheels_in_hex

ROBOTS = ("sdm_b", "t12")
MILLIMETRE = 1e-3


def straight(robot: str, hip_pitch: float) -> np.ndarray:
    joints = np.zeros((6, load_spec(robot).dof))
    joints[:, 1] = hip_pitch
    return joints


def test_sdm_b_straight_legs_reach_the_published_height():
    """Robot facts 10, item 1: ring underside 1.98 m, topside 2.20 m with the legs straight down; reach 3.42 m."""
    spec, kin = load_spec("sdm_b"), kinematics("sdm_b")
    top = -kin.wheels_in_hex(straight("sdm_b", np.pi / 2))[:, 2] + spec.wheel.radius
    assert top == pytest.approx(np.full(6, 2.20), abs=5 * MILLIMETRE)
    ring = spec.body_parts[0].size[2]
    assert top - ring == pytest.approx(np.full(6, 1.98), abs=5 * MILLIMETRE)
    reach = np.linalg.norm(kin.wheels_in_hex(straight("sdm_b", 0.0))[:, :2], axis=1) + spec.wheel.radius
    assert reach == pytest.approx(np.full(6, 3.42), abs=5 * MILLIMETRE)


def test_t12_straight_legs_reach_the_published_height():
    """Robot facts 10, item 4: 4.02 m at the deck plane; reach 5.98 m."""
    spec, kin = load_spec("t12"), kinematics("t12")
    deck = -kin.wheels_in_hex(straight("t12", np.pi / 2))[:, 2] + spec.wheel.radius + spec.top_in_hex
    assert deck == pytest.approx(np.full(6, 4.02), abs=5 * MILLIMETRE)
    reach = np.linalg.norm(kin.wheels_in_hex(straight("t12", 0.0))[:, :2], axis=1) + spec.wheel.radius
    assert reach == pytest.approx(np.full(6, 5.98), abs=10 * MILLIMETRE)


@pytest.mark.parametrize(("robot", "mass"), [("sdm_b", 850.0), ("t12", 2300.0)])
def test_masses_are_the_published_ones(robot, mass):
    assert load_spec(robot).mass == pytest.approx(mass, rel=1e-3)


@pytest.mark.parametrize("robot", ROBOTS)
def test_inverse_kinematics_puts_the_axle_where_asked(robot):
    spec, kin = load_spec(robot), kinematics(robot)
    rng = np.random.default_rng(1)
    home = stance_wheels_in_hex(spec)
    for leg in range(6):
        wanted = home[leg] + rng.uniform(-0.5, 0.5, (40, 3)) * np.array([1.0, 1.0, 0.6])
        down = np.array([0.05, -0.03, -1.0])
        q, ok = leg_ik(spec, leg, wanted, last_link_in_hex=down)
        assert ok.mean() > 0.6
        for point, angles in zip(wanted[ok], q[ok], strict=True):
            pose = kin.leg_wheel(leg, angles)
            assert np.linalg.norm(pose.translation - point) < 1e-9
            assert pose.rotation[:, 0] @ down / np.linalg.norm(down) > np.cos(0.06)
            assert (angles >= spec.lower).all()
            assert (angles <= spec.upper).all()


@pytest.mark.parametrize("robot", ROBOTS)
def test_out_of_reach_is_an_answer_not_a_guess(robot):
    q, ok = leg_ik(load_spec(robot), 0, np.array([[9.0, 0.0, -1.0], [0.0, 0.0, 3.0]]))
    assert not ok.any()
    assert np.isnan(q).all()


@pytest.mark.parametrize("robot", ROBOTS)
def test_inverse_kinematics_is_smooth_along_a_stride(robot):
    spec = load_spec(robot)
    home = stance_wheels_in_hex(spec)
    for leg in range(6):
        line = home[leg] + np.linspace(-0.5, 0.5, 101)[:, None] * spec.stride * np.array([1.0, 0.0, 0.0])
        q, ok = leg_ik(spec, leg, line)
        assert ok.all()
        assert np.abs(np.diff(q, axis=0)).max() < 0.05


@pytest.mark.parametrize("robot", ROBOTS)
def test_regular_stance_stands_on_its_circle(robot):
    spec, kin = load_spec(robot), kinematics(robot)
    wheels = kin.wheels_in_hex(regular_stance(spec))
    assert np.linalg.norm(wheels[:, :2], axis=1) == pytest.approx(np.full(6, spec.foot_radius), abs=1e-9)
    assert wheels[:, 2] == pytest.approx(np.full(6, spec.wheel.radius - spec.chassis_height), abs=1e-9)


def test_an_impossible_stance_says_what_works():
    with pytest.raises(KinematicsError, match=r"cannot stand with foot radius 5.0 m.*1.95 m at 1.75 m works"):
        regular_stance(load_spec("sdm_b"), foot_radius=5.0)


@pytest.mark.parametrize("robot", ROBOTS)
def test_jacobian_is_the_derivative_of_the_axle(robot):
    spec, kin = load_spec(robot), kinematics(robot)
    q = regular_stance(spec)[2] + 0.1
    jacobian, step = kin.leg_jacobian(2, q), 1e-6
    for k in range(spec.dof):
        ahead, behind = q.copy(), q.copy()
        ahead[k] += step
        behind[k] -= step
        slope = (kin.leg_wheel(2, ahead).translation - kin.leg_wheel(2, behind).translation) / (2 * step)
        assert jacobian[:, k] == pytest.approx(slope, abs=1e-6)


@pytest.mark.parametrize("robot", ROBOTS)
def test_ground_force_is_read_back_from_the_torques_it_makes(robot):
    spec, kin = load_spec(robot), kinematics(robot)
    joints = regular_stance(spec)
    gravity = np.array([0.3, -0.2, -GRAVITY])
    force = np.zeros((6, 3))
    force[4] = [120.0, -80.0, 1500.0]
    contact = kin.wheels_in_hex(joints) + spec.wheel.radius * gravity / np.linalg.norm(gravity)
    torques = kin.gravity_torques(joints, gravity, force, contact)
    assert kin.ground_force(4, joints, torques[4], gravity) == pytest.approx(force[4], abs=1e-6)
    assert kin.ground_force(1, joints, torques[1], gravity) == pytest.approx(np.zeros(3), abs=1e-6)


def test_gravity_torque_is_the_slope_of_the_potential():
    spec, kin = load_spec("sdm_b"), kinematics("sdm_b")
    joints, step = regular_stance(spec) + 0.05, 1e-6
    torques = kin.gravity_torques(joints, np.array([0.0, 0.0, -GRAVITY]), np.zeros((6, 3)), np.zeros((6, 3)))
    for leg, k in ((0, 1), (3, 2), (5, 4)):
        ahead, behind = joints.copy(), joints.copy()
        ahead[leg, k] += step
        behind[leg, k] -= step
        rise = kin.com_in_hex(ahead)[2] - kin.com_in_hex(behind)[2]
        assert torques[leg, k] == pytest.approx(spec.mass * GRAVITY * rise / (2 * step), rel=1e-4)


def test_wrong_shapes_are_refused():
    with pytest.raises(KinematicsError, match="need finite"):
        kinematics("sdm_b").pin_q(np.full((6, 6), np.nan))


@pytest.mark.parametrize("robot", ROBOTS)
def test_all_legs_agree_with_one_by_one(robot):
    spec = load_spec(robot)
    wheels = stance_wheels_in_hex(spec)
    joints, ok = all_legs_ik(spec, wheels)
    assert ok.all()
    for leg in range(6):
        assert np.array_equal(joints[leg], leg_ik(spec, leg, wheels[leg : leg + 1])[0][0])
