"""Points of a depth image, with the gaps between far rows bridged."""

from dataclasses import replace

import numpy as np
import pytest

from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.camera import Pinhole, StereoCamera
from planner.perception.stereo import DepthImage
from planner.terrain.fusion import FusionConfig, points_in_world

EYE = Pinhole.from_fov(96, 72, np.deg2rad(77.0))
CAMERA = StereoCamera(name="eye", group="hazcam", baseline=0.3, eye=EYE, link_from_camera=SE3.identity())
TILTED = SE3(SE3.from_rpy(np.deg2rad(-105.0), 0.1, 0.4).rotation, np.array([0.4, -0.3, 1.8]))
"""world from a camera that looks down at a slant"""
GREY = np.zeros((72, 96), dtype=np.uint8)
PLAIN = FusionConfig(outliers="none", max_depth=9.0)


@pytest.fixture
def plane() -> DepthImage:
    """Flat ground at height 0, seen by `TILTED`."""
    rays = TILTED.rotate(EYE.rays().reshape(-1, 3)).reshape(72, 96, 3)
    with np.errstate(divide="ignore"):
        depth = -TILTED.translation[2] / rays[..., 2]
    depth[(depth <= 0.0) | (depth > 8.0)] = np.nan
    sigma = np.where(np.isfinite(depth), 0.02, np.nan)
    return DepthImage(depth=depth, sigma=sigma, eye=EYE, camera=CAMERA, grey=GREY, t=0.0)


def test_points_and_those_between_lie_on_the_plane(plane):
    points, sigma_z = points_in_world(plane, TILTED, config=PLAIN)
    np.testing.assert_allclose(points[:, 2], 0.0, atol=1e-9)
    assert len(points) > 1.5 * np.isfinite(plane.depth).sum()
    assert ((sigma_z > 0.0) & (sigma_z <= 0.02 * 1.6)).all()


def test_without_bridging_the_points_are_those_of_the_pixels(plane):
    points, sigma_z = points_in_world(plane, TILTED, config=replace(PLAIN, bridge=1))
    known = np.isfinite(plane.depth)
    rays = TILTED.rotate(EYE.rays()[known])
    np.testing.assert_allclose(points, rays * plane.depth[known][:, None] + TILTED.translation, atol=1e-12)
    np.testing.assert_allclose(sigma_z, np.maximum(0.02 * np.abs(rays[:, 2]), 1e-4), atol=1e-15)


def test_a_step_between_two_surfaces_is_not_bridged():
    depth = np.full((72, 96), 2.0)
    depth[36:] = 6.0
    sigma = np.full(depth.shape, 0.02)
    image = DepthImage(depth=depth, sigma=sigma, eye=EYE, camera=CAMERA, grey=GREY, t=0.0)
    points, _ = points_in_world(image, SE3.identity(), config=PLAIN)
    assert set(np.unique(np.round(points[:, 2], 9))) == {2.0, 6.0}
