"""Transforms against SciPy's rotations."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from athlete_twin.geometry.se3 import SE3

ANGLES = st.floats(-3.1, 3.1)
PITCHES = st.floats(-1.57, 1.57)


@given(ANGLES, PITCHES, ANGLES)
def test_roll_pitch_yaw_are_scipys_extrinsic_xyz(roll, pitch, yaw):
    pose = SE3.from_rpy(roll, pitch, yaw)
    theirs = Rotation.from_matrix(pose.rotation).as_euler("xyz", suppress_warnings=True)
    again = SE3.from_rpy(*pose.rpy())
    assert np.abs(again.rotation - pose.rotation).max() < 1e-9
    if abs(pitch) < 1.5:
        assert np.abs(pose.rpy() - theirs).max() < 1e-9


@given(ANGLES, PITCHES, ANGLES, st.floats(-5, 5), st.floats(-5, 5))
def test_a_transform_and_its_inverse_cancel(roll, pitch, yaw, x, z):
    pose = SE3.from_rpy(roll, pitch, yaw, np.array([x, 1.0, z]))
    back = pose.compose(pose.inverse())
    assert np.abs(back.matrix() - np.eye(4)).max() < 1e-9
    point = np.array([0.3, -2.0, 1.1])
    assert np.abs(pose.inverse().apply(pose.apply(point)) - point).max() < 1e-9
