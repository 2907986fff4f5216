"""Depth that hangs beside a leg goes; the ground, and rocks beside a wheel, stay."""

import numpy as np
import pytest

from athlete_twin.errors import ConfigError
from athlete_twin.model.camera import Pinhole, StereoCamera, mounted
from athlete_twin.model.kinematics import kinematics
from athlete_twin.model.spec import load_spec
from athlete_twin.model.stance import regular_stance
from planner.perception.self_clearance import SelfClearanceConfig, without_hanging_points
from planner.perception.stereo import DepthImage

UP = np.array([0.0, 0.0, 1.0])


def seen(point_in_hex: np.ndarray) -> tuple[DepthImage, tuple[int, int]]:
    """A depth image with a single known pixel, at a point in hex, by a camera that looks at the robot from the front."""
    eye = Pinhole.from_fov(512, 384, 1.2)
    pose = mounted(0.0, 9.0, 0.0, "inward", 0.15, 0.2)
    camera = StereoCamera(name="onlooker_1", group="navcam", link_from_camera=pose, baseline=0.2, eye=eye)
    pixel, depth = eye.project(pose.inverse().apply(point_in_hex))
    column, row = np.rint(pixel).astype(int)
    assert depth > 0.0
    assert 0 <= row < eye.height_px
    assert 0 <= column < eye.width_px
    image = np.full((eye.height_px, eye.width_px), np.nan)
    image[row, column] = float(depth)
    sigma = np.where(np.isfinite(image), 0.01, np.nan)
    grey = np.zeros(image.shape, dtype=np.uint8)
    return DepthImage(camera=camera, eye=eye, depth=image, sigma=sigma, grey=grey, t=0.0), (row, column)


def kept(robot: str, point_in_hex: np.ndarray, **config) -> bool:
    spec, kin = load_spec(robot), kinematics(robot)
    joints = regular_stance(spec)
    ground = kin.wheels_in_hex(joints) - spec.wheel.radius * UP
    depth, (row, column) = seen(point_in_hex)
    clear = without_hanging_points(
        depth, spec, kin.link_poses(joints), up_in_hex=UP, ground_in_hex=ground, config=SelfClearanceConfig(**config)
    )
    return bool(np.isfinite(clear.depth[row, column]))


@pytest.mark.parametrize("robot", ["sdm_b", "t12"])
def test_a_point_beside_the_shank_is_not_terrain(robot):
    links = kinematics(robot).link_poses(regular_stance(load_spec(robot)))
    knee, ankle = (links[f"leg1_{n}_pitch"].translation for n in ("knee", "ankle"))
    beside = 0.5 * (knee + ankle) + np.array([0.05, 0.12, 0.0])
    assert not kept(robot, beside)
    assert kept(robot, beside, enabled=False)


@pytest.mark.parametrize("robot", ["sdm_b", "t12"])
def test_ground_and_a_rock_a_stride_beyond_the_wheel_stay(robot):
    wheel = kinematics(robot).wheels_in_hex(regular_stance(load_spec(robot)))[0]
    radius = load_spec(robot).wheel.radius
    beyond = wheel * np.array([1.5, 1.5, 1.0])
    assert kept(robot, beyond - [0.0, 0.0, radius - 0.01])
    assert kept(robot, beyond)


def test_silly_distances_are_refused():
    with pytest.raises(ConfigError, match="must not be negative"):
        SelfClearanceConfig(distance=-1.0)
