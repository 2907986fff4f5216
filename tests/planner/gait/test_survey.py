"""Looking around: cameras that see a place, and a chassis that comes back to where it was."""

import numpy as np
import pytest

from athlete_twin.geometry.se3 import SE3
from athlete_twin.messages import BodyMove, ImageRequest
from athlete_twin.model.kinematics import kinematics
from athlete_twin.model.spec import load_spec
from athlete_twin.model.stance import regular_stance
from planner.belief import Belief
from planner.gait.survey import SurveyConfig, facing, seeing, survey_commands


def belief(robot: str) -> Belief:
    spec = load_spec(robot)
    joints = regular_stance(spec)
    pose = SE3.from_translation(np.array([0.0, 0.0, spec.chassis_height]))
    contacts = pose.apply(kinematics(robot).wheels_in_hex(joints)) - [0.0, 0.0, spec.wheel.radius]
    return Belief(
        t=0.0, joints=joints, motors=joints, world_from_hex=pose, contacts_in_world=contacts, planted=np.ones(6, dtype=bool),
        loads=np.ones(6), interaction=np.zeros((6, 3)), forces=np.zeros((6, 3)),
        joint_stiffness=np.full(spec.dof, np.inf), fit_rmse=0.0,
    )  # fmt: skip


@pytest.mark.parametrize("robot", ["sdm_b", "t12"])
def test_a_survey_ends_where_it_began(robot):
    commands = survey_commands(kinematics(robot), belief(robot), np.array([1.0, 0.0]), SurveyConfig())
    pose = SE3.identity()
    for command in commands:
        if isinstance(command, BodyMove):
            pose = pose.compose(SE3.from_rotvec(command.rotvec_in_hex, command.translation_in_hex))
    assert pose.matrix() == pytest.approx(np.eye(4), abs=1e-9)
    assert sum(isinstance(c, ImageRequest) for c in commands) >= 2


@pytest.mark.parametrize("robot", ["sdm_b", "t12"])
def test_the_first_look_takes_every_camera_on_the_chassis(robot):
    first = survey_commands(kinematics(robot), belief(robot), np.array([1.0, 0.0]), SurveyConfig())[0]
    assert isinstance(first, ImageRequest)
    assert set(first.cameras) == {c.name for c in load_spec(robot).cameras if c.on_chassis}


def test_seeing_names_cameras_in_whose_picture_the_point_lies():
    spec = load_spec("sdm_b")
    point = np.array([2.0, 0.0, -1.75])
    names = seeing(spec, point, most=3)
    assert names[0] == "hazcam_2"  # across the body from leg 1
    for name in names:
        camera = spec.camera(name)
        pixel, depth = camera.eye.project(camera.hex_from_camera.inverse().apply(point))
        assert depth > 0.0
        assert 0 <= pixel[0] < camera.eye.width_px
        assert 0 <= pixel[1] < camera.eye.height_px
    assert seeing(spec, np.array([0.0, 0.0, 5.0]), most=3) == ()


def test_facing_puts_the_best_aligned_camera_first():
    assert set(facing(load_spec("sdm_b"), np.array([1.0, 0.0]), group="navcam", most=2)) == {"navcam_1", "navcam_6"}
    assert facing(load_spec("t12"), np.array([1.0, 0.0]), group="navcam", most=1) == ("navcam_1",)
