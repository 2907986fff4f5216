"""Straight ways by forward kinematics: the wheel where it is led, the wheels that stay where they stood, and a leg for each refusal."""

import numpy as np
import pytest

from athlete_twin.geometry.se3 import SE3
from athlete_twin.messages import BodyMove, LegMove
from athlete_twin.model.kinematics import kinematics
from athlete_twin.model.spec import load_spec
from athlete_twin.model.stance import regular_stance
from athlete_twin.model.straight_moves import BodyWay, LegWay, OutOfReachError

ROBOTS = ("sdm_b", "t12")


@pytest.fixture(params=ROBOTS)
def stance(request):
    return kinematics(request.param), regular_stance(load_spec(request.param))


def test_a_wheel_goes_along_its_line_and_the_last_link_keeps_its_direction(stance):
    kin, joints = stance
    axle = kin.leg_wheel(2, joints[2])
    target = axle.translation + np.array([0.05, -0.1, 0.2])
    way = LegWay.of(kin, LegMove(leg=2, wheel_in_hex=target), joints)
    assert way.length == pytest.approx(np.linalg.norm([0.05, -0.1, 0.2]))
    for fraction in (0.0, 0.3, 1.0):
        pose = kin.leg_wheel(2, way.at(fraction))
        assert pose.translation == pytest.approx(axle.translation + fraction * (target - axle.translation), abs=1e-9)
        assert pose.rotation[:, 0] == pytest.approx(axle.rotation[:, 0], abs=1e-9)


def test_wheels_stay_while_the_chassis_moves_but_for_their_offsets(stance):
    kin, joints = stance
    offsets = np.zeros((6, 3))
    offsets[4] = (0.0, 0.0, -0.02)
    move = BodyMove(
        translation_in_hex=np.array([0.05, 0.03, -0.02]), rotvec_in_hex=np.array([0.01, 0.0, 0.02]), wheel_offsets_in_hex=offsets
    )
    way, stood = BodyWay.of(kin, move, joints), kin.wheels_in_hex(joints)
    for fraction in (0.0, 0.5, 1.0):
        chassis = SE3.from_rotvec(fraction * move.rotvec_in_hex, fraction * move.translation_in_hex)
        assert np.allclose(way.start_from_hex(fraction).matrix(), chassis.matrix())
        moved = chassis.apply(kin.wheels_in_hex(way.at(fraction)))
        assert np.abs(moved - stood - fraction * chassis.rotate(offsets)).max() < 1e-9


def test_what_is_out_of_reach_or_in_another_posture_names_its_leg(stance):
    kin, joints = stance
    with pytest.raises(OutOfReachError, match="leg 4 cannot put its wheel") as refused:
        LegWay.of(kin, LegMove(leg=3, wheel_in_hex=np.array([9.0, 0.0, 0.0])), joints)
    assert refused.value.leg == 3
    with pytest.raises(OutOfReachError, match="cannot put its wheel"):
        BodyWay.of(kin, BodyMove(translation_in_hex=np.array([0.0, 0.0, 4.0])), joints)
    rolled = joints.copy()
    rolled[1, -1] += 0.2
    with pytest.raises(OutOfReachError, match=r"leg 2 is 11\.5 deg off the posture of straight moves"):
        BodyWay.of(kin, BodyMove(translation_in_hex=np.array([0.0, 0.0, 0.01])), rolled)
