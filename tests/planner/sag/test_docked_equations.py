"""The compiled rotation and placing against scipy and the plain transforms."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from athlete_twin.geometry.se3 import SE3
from planner.sag.docked_equations import placed, turned

angles = st.floats(-3.0, 3.0) | st.floats(-1e-3, 1e-3) | st.just(0.0)


@given(x=angles, y=angles, z=angles)
def test_turns_are_scipys(x, y, z):
    rotvec = np.array([x, y, z])
    assert np.abs(turned(rotvec) - Rotation.from_rotvec(rotvec).as_matrix()).max() < 1e-12


def test_points_of_a_piece_turn_about_its_dock_and_all_go_with_the_pallet():
    x = np.array([0.1, -0.2, 0.05, 0.02, -0.03, 0.01, 0.04])
    points, hung = np.array([[1.0, 2.0, 0.3], [0.5, -1.0, 0.0]]), np.array([0, -1])
    place, axis = np.array([[0.0, 1.0, 0.2]]), np.array([[0.0, 1.0, 0.0]])
    out = placed(points, hung, x, place, axis)
    pallet = SE3.from_rotvec(x[3:6], x[:3])
    twisted = Rotation.from_rotvec(0.04 * axis[0]).apply(points[0] - place[0]) + place[0]
    assert np.abs(out - [pallet.apply(twisted), pallet.apply(points[1])]).max() < 1e-12
