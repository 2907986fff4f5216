"""Where cameras sit: on the chassis, and riding on a leg."""

from dataclasses import replace

import numpy as np
import pytest

from athlete_twin.assets import read_toml, robot_dir
from athlete_twin.errors import CameraError, ConfigError
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.kinematics import kinematics
from athlete_twin.model.spec import load_spec, spec_from_content
from athlete_twin.model.stance import regular_stance


def test_a_camera_on_a_leg_moves_with_it():
    spec, kin = load_spec("sdm_b"), kinematics("sdm_b")
    camera = replace(spec.cameras[0], name="toolcam_1", link="wheel1", link_from_camera=SE3.from_translation(np.array([0.1, 0.0, 0.0])))
    joints = regular_stance(spec)
    links = kin.link_poses(joints)
    seen = camera.riding(links)
    assert np.allclose(seen.hex_from_camera.translation, links["wheel1"].apply(np.array([0.1, 0.0, 0.0])))
    lifted = joints.copy()
    lifted[0, 1] -= 0.3
    assert camera.riding(kin.link_poses(lifted)).hex_from_camera.translation[2] > seen.hex_from_camera.translation[2] + 0.1


def test_a_camera_on_the_chassis_rides_on_nothing():
    camera = load_spec("t12").cameras[0]
    assert camera.riding({}) is camera


def test_a_camera_on_a_leg_has_no_place_in_hex_by_itself():
    camera = replace(load_spec("sdm_b").cameras[0], name="toolcam_1", link="wheel1")
    with pytest.raises(CameraError, match="toolcam_1 rides on wheel1"):
        _ = camera.hex_from_camera
    with pytest.raises(CameraError, match="not among the given links"):
        camera.riding({})


def test_toolcams_ride_beside_the_wheels_of_some_legs():
    spec = load_spec("sdm_b")
    links = kinematics("sdm_b").link_poses(regular_stance(spec))
    tools = [c for c in spec.cameras if c.group == "toolcam"]
    assert [c.link for c in tools] == ["leg1_ankle_roll", "leg3_ankle_roll", "leg5_ankle_roll"]
    for camera in tools:
        wheel = links[f"wheel{camera.link[3]}"]
        left = wheel.inverse().compose(camera.riding(links).hex_from_camera)
        right = wheel.inverse().compose(camera.riding(links).hex_from_right())
        assert np.linalg.norm(left.translation - right.translation) == pytest.approx(camera.baseline)
        for eye in (left, right):
            assert eye.translation[1] > 0.5 * spec.wheel.width  # beside the tyre
            assert eye.rotation[0, 2] > 0.8  # looks along the last link, to the ground


def test_an_unknown_key_of_a_camera_group_is_refused():
    content = read_toml(robot_dir("sdm_b") / "spec.toml")
    content["camera"][-1]["azimuth_deg"] = {"value": [0.0], "unit": "deg"}
    with pytest.raises(ConfigError, match="'toolcam' on legs: key 'azimuth_deg' is not known"):
        spec_from_content(content)
