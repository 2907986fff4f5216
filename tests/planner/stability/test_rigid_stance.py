"""Many rigid stances at once against Pinocchio, one at a time: reach, torques of every joint, margins along gravity."""

import numpy as np
import pytest

from athlete_twin.errors import SupportError
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.kinematics import GRAVITY, kinematics
from athlete_twin.model.reach import all_legs_ik
from athlete_twin.model.stance import stance_wheels_in_hex
from athlete_twin.model.statics import torque_fractions, wheel_loads
from planner.stability.margin import cps_margin, support_margin
from planner.stability.rigid_stance import FLAT, Footing, coms_in_hex, rigid_stances

STEEP = SE3.from_rpy(0.10, -0.14, 0.0).rotation @ np.array([0.0, 0.0, 1.0])
FOOTINGS = {
    "flat": FLAT,
    "level deck on a slope": Footing(normal=STEEP),
    "deck parallel to a slope": Footing(up=STEEP),
}
LIFTED = {"none": (), "one": (1,), "two": (0, 3)}


@pytest.fixture(params=["sdm_b", "t12"])
def robot(request):
    return kinematics(request.param)


def _axles(robot, footing, n=12, seed=0):
    """Wheels about their regular places on the ground's plane."""
    spec, rng = robot.spec, np.random.default_rng(seed)
    axles = np.repeat(stance_wheels_in_hex(spec)[None], n, axis=0)
    axles[..., :2] += rng.uniform(-0.15, 0.15, (n, 6, 2)) * spec.foot_radius
    axles[..., 2] += axles[..., :2] @ (-footing.normal[:2] / footing.normal[2])
    return axles


@pytest.mark.parametrize("payload", [0.0, 300.0])
@pytest.mark.parametrize("lifted", LIFTED.values(), ids=LIFTED)
@pytest.mark.parametrize("footing", FOOTINGS.values(), ids=FOOTINGS)
def test_every_stance_is_what_pinocchio_says_of_it(robot, footing, lifted, payload):
    standing, down = ~np.isin(np.arange(6), lifted), -footing.up
    axles = _axles(robot, footing)
    judged = rigid_stances(robot.spec, axles, standing=standing, footing=footing, payload_kg=payload)
    level = _level(footing.up)
    held = 0
    for row, places in enumerate(axles):
        joints, reaches = all_legs_ik(robot.spec, places, last_link_in_hex=down)
        assert (judged.reaches[row] == reaches).all()
        if not reaches.all():
            assert judged.peak[row] == np.inf and judged.margin[row] == -np.inf
            continue
        com = robot.com_in_hex(joints, payload)
        np.testing.assert_allclose(coms_in_hex(robot.spec, joints[None], payload)[0], com, atol=1e-9)
        contacts = places - robot.spec.wheel.radius * footing.normal
        forces = np.zeros((6, 3))
        weight = (robot.spec.mass + payload) * GRAVITY
        forces[standing] = wheel_loads(contacts[standing], com, weight=weight, gravity_direction=down)
        fractions = torque_fractions(
            robot, joints, wheel_forces_in_hex=forces, contact_in_hex=contacts, gravity_in_hex=GRAVITY * down
        )
        if (forces[standing] @ footing.normal >= 0.0).all():
            np.testing.assert_allclose(judged.fraction[row], np.abs(fractions).max(axis=1), atol=1e-9)
            held += 1
        else:
            assert np.isinf(judged.fraction[row]).all()
        seen = contacts[standing] @ level.T
        assert judged.margin[row] == pytest.approx(support_margin(level @ com, seen), abs=1e-9)
        assert judged.cps_margin[row] == pytest.approx(cps_margin(level @ com, seen), abs=1e-9)
    assert held >= 3


def _level(up):
    """Rotation to a frame whose z is against gravity."""
    axis = np.cross(up, [0.0, 0.0, 1.0])
    size = np.linalg.norm(axis)
    angle = np.arctan2(size, up[2])
    return SE3.from_rotvec(axis * (angle / size if size > 0.0 else 0.0), np.zeros(3)).rotation


def test_two_wheels_and_a_ground_above_the_chassis_are_refused(robot):
    with pytest.raises(SupportError, match="2 wheels stand, at least 3"):
        rigid_stances(robot.spec, _axles(robot, FLAT), standing=np.arange(6) < 2)
    with pytest.raises(SupportError, match="points down"):
        Footing(normal=np.array([0.0, 0.0, -1.0]))
    with pytest.raises(SupportError, match="must be 1"):
        Footing(up=np.array([0.0, 0.0, 2.0]))
