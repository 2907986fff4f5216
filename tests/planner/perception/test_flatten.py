"""The method of 2008: what lies in the column over a contact is put on the contact's level, and nothing else changes."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from athlete_twin.errors import ConfigError
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.camera import Pinhole, StereoCamera
from planner.perception.flatten import flattened
from planner.perception.self_mask import SelfMaskConfig
from planner.perception.stereo import DepthImage

UP = np.array([0.0, 0.0, 1.0])
CONTACT = np.array([[2.0, 0.1, 0.04]])
MICROMETRE = 1e-6


def plane_image():
    """A level plane 1.5 m below a camera that looks 42 deg down, in closed form."""
    p = np.deg2rad(42.0)
    forward, right = np.array([np.cos(p), 0.0, -np.sin(p)]), np.array([0.0, -1.0, 0.0])
    pose = SE3(np.column_stack([right, np.cross(forward, right), forward]), np.array([0.0, 0.0, 1.5]))
    eye = Pinhole.from_fov(256, 192, np.deg2rad(70.0))
    camera = StereoCamera(name="hazcam_1", group="hazcam", baseline=0.15, eye=eye, link_from_camera=pose)
    with np.errstate(divide="ignore"):
        depth = -1.5 / pose.rotate(eye.rays())[..., 2]
    depth = np.where((depth > 0.0) & (depth < 20.0), depth, np.nan)
    return DepthImage(camera=camera, eye=eye, depth=depth, sigma=0.01 * depth, grey=np.zeros(depth.shape, np.uint8), t=0.0)


PLANE = plane_image()


def depth_of(synth, cylinders, height=1.5, pitch=42.0):
    camera = synth.looking(height, pitch)
    depth, grey, what = synth.Scene(cylinders).trace(camera.hex_from_camera, camera.eye)
    image = DepthImage(camera=camera, eye=camera.eye, depth=depth, sigma=0.01 * depth, grey=grey.astype(np.uint8), t=0.0)
    return image, what


def points(image, depth):
    return image.camera.hex_from_camera.apply(image.eye.rays() * depth[..., None])


def test_every_point_inside_the_radius_has_the_contacts_height(synth):
    image, _ = depth_of(synth, [synth.Cylinder(2.0, 0.1, 0.2, 0.0, 0.9), synth.Cylinder(1.9, 0.45, 0.1, 0.0, 0.2)])
    flat, mask = flattened(image, UP, CONTACT, radius=0.5)
    at = points(image, flat)
    inside = np.hypot(*(at[..., :2] - CONTACT[0, :2]).transpose(2, 0, 1)) < 0.5
    assert inside.sum() > 1000
    assert np.abs(at[inside][:, 2] - 0.04).max() < MICROMETRE
    assert (mask[inside]).all()


@settings(max_examples=15, deadline=None)
@given(
    radius=st.floats(0.1, 0.9), roll=st.floats(-0.2, 0.2), pitch=st.floats(-0.2, 0.2), x=st.floats(1.2, 2.6), z=st.floats(-0.1, 0.1)
)
def test_on_any_slope_the_column_stands_along_gravity(radius, roll, pitch, x, z):
    image = PLANE
    up = SE3.from_rpy(roll, pitch, 0.0).rotate(UP)
    contact = np.array([[x, 0.0, z]])
    flat, mask = flattened(image, up, contact, radius=radius)
    off = points(image, flat) - contact[0]
    away = np.linalg.norm(off - (off @ up)[..., None] * up, axis=-1)
    inside = away < radius - MICROMETRE
    assert np.all(np.abs((off @ up)[inside]) < MICROMETRE)
    np.testing.assert_array_equal(flat[~mask], image.depth[~mask])


def test_outside_the_columns_nothing_changes_and_a_rock_within_is_lost(synth):
    image, what = depth_of(synth, [synth.Cylinder(2.0, 0.45, 0.1, 0.0, 0.2), synth.Cylinder(2.0, -0.8, 0.1, 0.0, 0.2)])
    flat, mask = flattened(image, UP, CONTACT, radius=0.6)
    assert mask[what == 1].all(), "the paper's complaint: a rock beside the wheel is flattened away"
    assert not mask[what == 2].any()
    np.testing.assert_array_equal(flat[~mask], image.depth[~mask])


def test_without_a_planted_wheel_nothing_is_flattened(synth):
    image, _ = depth_of(synth, [])
    flat, mask = flattened(image, UP, np.zeros((0, 3)), radius=0.6)
    np.testing.assert_array_equal(flat, image.depth)
    assert not mask.any()


def test_a_radius_of_nothing_is_refused():
    with pytest.raises(ConfigError, match=r"flatten_radius is 0.0 m, must be positive, such as 0.6"):
        SelfMaskConfig(method="flatten", flatten_radius=0.0)
