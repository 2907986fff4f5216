from itertools import combinations

import numpy as np
import pytest

from athlete_twin.errors import KinematicsError, SupportError
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.kinematics import GRAVITY, kinematics
from athlete_twin.model.stance import regular_stance
from athlete_twin.model.statics import peak_torque_fraction, stance_loads, wheel_loads

ANGLES = np.deg2rad(60.0 * np.arange(6))
HEXAGON = np.column_stack([1.95 * np.cos(ANGLES), 1.95 * np.sin(ANGLES), np.zeros(6)])
COM = np.array([0.0, 0.0, 0.9])
WEIGHT = 850.0 * GRAVITY
POINT = 0.02
"""two points of a per cent"""


def test_six_wheels_of_a_hexagon_carry_a_sixth_each():
    forces = wheel_loads(HEXAGON, COM, weight=WEIGHT)
    assert forces[:, 2] / WEIGHT == pytest.approx(np.full(6, 1 / 6))
    assert np.abs(forces[:, :2]).max() < 1e-9 * WEIGHT


def test_with_one_leg_lifted_neighbours_carry_most():
    forces = wheel_loads(HEXAGON[1:], COM, weight=WEIGHT)
    assert forces[:, 2] / WEIGHT == pytest.approx([5 / 18, 1 / 6, 1 / 9, 1 / 6, 5 / 18])


def test_with_two_opposite_legs_lifted_four_carry_a_quarter_each():
    forces = wheel_loads(HEXAGON[[1, 2, 4, 5]], COM, weight=WEIGHT)
    assert forces[:, 2] / WEIGHT == pytest.approx(np.full(4, 0.25))


def test_no_two_wheels_work_against_each_other_on_any_ground():
    rng = np.random.default_rng(1)
    for count in (3, 4, 5, 6):
        contacts = HEXAGON[:count] + rng.normal(0.0, 0.2, (count, 3))
        gravity = np.array([0.1, -0.2, -1.0])
        forces = wheel_loads(contacts, COM, weight=WEIGHT, gravity_direction=gravity)
        for i, j in combinations(range(count), 2):
            line = contacts[i] - contacts[j]
            assert (forces[i] - forces[j]) @ line == pytest.approx(0.0, abs=1e-8 * WEIGHT)


def test_forces_and_moments_balance():
    rng = np.random.default_rng(2)
    contacts = HEXAGON + rng.normal(0.0, 0.3, (6, 3))
    gravity = np.array([0.2, 0.1, -0.9])
    forces = wheel_loads(contacts, COM, weight=WEIGHT, gravity_direction=gravity)
    down = gravity / np.linalg.norm(gravity)
    assert np.abs(forces.sum(axis=0) + WEIGHT * down).max() < 1e-9 * WEIGHT
    assert np.abs(np.cross(contacts - COM, forces).sum(axis=0)).max() < 1e-9 * WEIGHT


def test_turning_the_frame_turns_the_forces():
    turn = SE3.from_rpy(0.3, -0.2, 1.0)
    contacts = HEXAGON[1:]
    expected = turn.rotate(wheel_loads(contacts, COM, weight=WEIGHT))
    down = turn.rotate(np.array([0.0, 0.0, -1.0]))
    turned = wheel_loads(turn.apply(contacts), turn.apply(COM), weight=WEIGHT, gravity_direction=down)
    assert turned == pytest.approx(expected, abs=1e-6)


def test_too_few_wheels_or_wheels_on_a_line_are_refused():
    with pytest.raises(SupportError, match="at least 3"):
        wheel_loads(HEXAGON[:2], COM, weight=WEIGHT)
    with pytest.raises(SupportError, match="on one line"):
        wheel_loads(np.outer(np.arange(4.0), [1.0, 0.0, 0.0]), COM, weight=WEIGHT)
    with pytest.raises(SupportError, match="weight"):
        wheel_loads(HEXAGON, COM, weight=0.0)
    with pytest.raises(SupportError, match="no length"):
        wheel_loads(HEXAGON, COM, weight=1.0, gravity_direction=np.zeros(3))
    with pytest.raises(SupportError, match="1 values of contacts are not"):
        wheel_loads(np.where(np.arange(18).reshape(6, 3) == 7, np.nan, HEXAGON), COM, weight=1.0)
    with pytest.raises(SupportError, match="must be finite"):
        wheel_loads(HEXAGON, np.full(3, np.nan), weight=1.0)


def test_payloads_and_gravities_that_cannot_be_are_refused():
    sdm = kinematics("sdm_b")
    joints, standing = regular_stance(sdm.spec), np.ones(6, dtype=bool)
    for payload in (-1.0, np.nan, np.inf):
        with pytest.raises(KinematicsError, match="payload is"):
            stance_loads(sdm, joints, supporting=standing, payload_kg=payload)
    with pytest.raises(SupportError, match="has no direction"):
        peak_torque_fraction(sdm, joints, supporting=standing, gravity_in_hex=np.zeros(3))


def test_one_leg_lifted_asks_for_more_torque_than_two_as_published():
    """FF12 fig. 16: 50.28 and 43.43 per cent; the foot radius is fitted, so the pair is the test."""
    sdm = kinematics("sdm_b")
    joints = regular_stance(sdm.spec, foot_radius=1.793, chassis_height=1.75)
    one, two = np.ones(6, dtype=bool), np.ones(6, dtype=bool)
    one[0] = False
    two[[0, 3]] = False
    assert peak_torque_fraction(sdm, joints, supporting=one) == pytest.approx(0.5028, abs=POINT)
    assert peak_torque_fraction(sdm, joints, supporting=two) == pytest.approx(0.4343, abs=POINT)


def test_least_torque_lies_near_two_metres_of_foot_radius():
    sdm = kinematics("sdm_b")
    one = np.ones(6, dtype=bool)
    one[0] = False
    peaks = {
        radius: peak_torque_fraction(sdm, regular_stance(sdm.spec, radius, 1.75), supporting=one)
        for radius in (1.8, 2.0, 2.3)
    }
    assert peaks[2.0] == pytest.approx(0.275, abs=POINT)
    assert peaks[2.0] < min(peaks[1.8], peaks[2.3])


def test_payload_and_weight_arrive_on_the_wheels():
    sdm = kinematics("sdm_b")
    joints = regular_stance(sdm.spec)
    supporting = np.array([True, True, False, True, True, True])
    forces, contacts = stance_loads(sdm, joints, supporting=supporting, payload_kg=300.0)
    assert forces[:, 2].sum() == pytest.approx((sdm.spec.mass + 300.0) * GRAVITY)
    assert not forces[2].any()
    assert contacts[:, 2] == pytest.approx(np.full(6, -sdm.spec.chassis_height))
