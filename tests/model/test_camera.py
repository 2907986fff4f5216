"""Where cameras sit: on the chassis, and riding on a leg."""

from dataclasses import replace

import numpy as np
import pytest

from athlete_twin.errors import CameraError
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.kinematics import kinematics
from athlete_twin.model.spec import load_spec
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
