import numpy as np
import pytest

from athlete_twin.errors import PlanningError
from athlete_twin.geometry.grid import HeightGrid
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.kinematics import kinematics
from athlete_twin.model.spec import load_spec
from athlete_twin.model.stance import regular_stance
from planner.motion.body_shift import BodyPath, BodyShiftConfig, plan_body_shift
from planner.motion.collision import BodyCollision, CollisionConfig
from planner.motion.sbl import NoPath

ROBOTS = ("sdm_b", "t12")
NOTHING = np.zeros(3)
PLANTED = 1e-6
"""[m]"""


def ground(height=lambda x, y: 0.0 * x) -> HeightGrid:
    x, y = np.meshgrid(-5 + 0.1 * np.arange(101), -5 + 0.1 * np.arange(101), indexing="ij")
    return HeightGrid(origin_x=-5.0, origin_y=-5.0, cell=0.1, heights=np.asarray(height(x, y), dtype=float))


def shift(robot, translation, *, rotvec=NOTHING, offsets=None, heights=None, config=None, joints=None):
    spec = load_spec(robot)
    return plan_body_shift(
        kinematics(robot),
        regular_stance(spec) if joints is None else joints,
        SE3.from_rpy(0.0, 0.0, 0.4, np.array([0.1, 0.2, spec.chassis_height])),
        translation_in_hex=np.asarray(translation, dtype=float),
        rotvec_in_hex=np.asarray(rotvec, dtype=float),
        wheel_offsets_in_hex=np.zeros((6, 3)) if offsets is None else offsets,
        collision=BodyCollision(spec, ground() if heights is None else heights, CollisionConfig()),
        config=BodyShiftConfig() if config is None else config,
    )


@pytest.mark.parametrize("robot", ROBOTS)
def test_wheels_stay_and_last_links_keep_their_direction(robot):
    kin = kinematics(robot)
    path = shift(robot, [0.12, -0.05, 0.04], rotvec=[0.02, -0.03, 0.05])
    assert isinstance(path, BodyPath), path
    wheels = np.array([p.apply(kin.wheels_in_hex(q)) for p, q in zip(path.world_from_hex, path.joints, strict=True)])
    assert np.abs(wheels - wheels[0]).max() < PLANTED
    # A leg's plane turns with its yaw, and the chassis with the shift: within the plane the last link stays vertical.
    last = kin.link_poses(path.joints[-1])["wheel3"].rotation[:, 0]
    assert path.world_from_hex[-1].rotate(last)[2] < -np.cos(np.deg2rad(3.5))


@pytest.mark.parametrize("robot", ROBOTS)
def test_the_chassis_moves_on_a_straight_line_to_the_target(robot):
    path = shift(robot, [0.1, 0.05, 0.0])
    at = np.array([p.translation for p in path.world_from_hex])
    expected = path.world_from_hex[0].apply(np.array([0.1, 0.05, 0.0]))
    np.testing.assert_allclose(at[-1], expected, atol=1e-12)
    np.testing.assert_allclose(np.diff(at, n=2, axis=0), 0.0, atol=1e-12)
    assert np.linalg.norm(np.diff(at, axis=0), axis=1).max() <= 0.025 + 1e-9
    assert path.checks == len(at)


def test_wheel_offsets_arrive_at_the_end():
    kin = kinematics("sdm_b")
    offsets = np.zeros((6, 3))
    offsets[2] = [0.0, 0.0, 0.03]
    path = shift("sdm_b", NOTHING, offsets=offsets)
    moved = kin.wheels_in_hex(path.joints[-1]) - kin.wheels_in_hex(path.joints[0])
    np.testing.assert_allclose(moved, offsets, atol=1e-9)


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_shift_beyond_reach_names_the_leg(robot):
    refusal = shift(robot, [3.0, 0.0, 0.0])
    assert isinstance(refusal, NoPath) and refusal.reason == "unreachable"
    assert "cannot put its wheel" in refusal.detail and "% of the way" in refusal.detail


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_chassis_lowered_onto_a_rock_is_refused(robot):
    spec = load_spec(robot)
    solids = [*spec.body_parts, *(deck.part for deck in spec.decks)]
    underside = min(float(part.centre[2] - part.size[2] / 2) for part in solids if part.shape == "box") if spec.decks else -0.217
    top = spec.chassis_height + underside - 0.15
    column = ground(lambda x, y: np.where(np.hypot(x - 0.1, y - 0.2) < 1.08, top, 0.0))
    assert isinstance(shift(robot, NOTHING, heights=column), BodyPath)
    refusal = shift(robot, [0.0, 0.0, -0.2], heights=column)
    assert isinstance(refusal, NoPath) and refusal.reason == "collides"
    assert "terrain" in refusal.detail and ("hex" in refusal.detail or "deck" in refusal.detail)


def test_a_posture_that_the_executive_would_refuse_is_refused_here():
    joints = regular_stance(load_spec("sdm_b"))
    joints[2, 3] += 0.1
    assert shift("sdm_b", [0.1, 0.0, 0.0], joints=joints).reason == "off_branch"


def test_joints_that_race_are_named():
    refusal = shift("sdm_b", [0.1, 0.0, 0.0], config=BodyShiftConfig(max_joint_step=0.005))
    assert refusal.reason == "joint_step" and "of leg" in refusal.detail


def test_impossible_settings_are_refused():
    with pytest.raises(PlanningError, match="must be positive"):
        BodyShiftConfig(step=0.0)
