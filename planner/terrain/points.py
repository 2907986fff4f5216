"""One masked depth image -> points of the terrain in the world, each with one sigma of its height.

Far, vague and stray pixels are left out, and pixels whose depth or sigma is no number. The gap between rows of pixels on
far ground is bridged where both lie on one surface.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

from athlete_twin.geometry.arrays import Points3
from athlete_twin.geometry.open3d_loader import open3d
from athlete_twin.geometry.se3 import SE3
from planner.perception.stereo import DepthImage

if TYPE_CHECKING:
    from planner.terrain.fusion import FusionConfig


def points_in_world(depth: DepthImage, world_from_camera: SE3, *, config: FusionConfig) -> tuple[Points3, np.ndarray]:
    """Terrain points of a depth image and one sigma of their heights [m]; far, vague and stray pixels are left out."""
    with np.errstate(invalid="ignore"):
        use = (depth.depth > 0.0) & (depth.depth <= config.max_depth)
        use &= (depth.sigma >= 0.0) & (depth.sigma <= config.max_sigma)
    if config.outliers == "neighbours":
        use &= _supported(depth)
    rays, inverse, sigma = _bridged(depth, use, config)
    z = 1.0 / inverse
    rays_in_world = world_from_camera.rotate(rays)
    points = rays_in_world * z[:, None] + world_from_camera.translation
    # A wrong depth moves the point along its ray; on ground seen at a slant that is mostly sideways.
    sigma_z = np.maximum(sigma * np.abs(rays_in_world[:, 2]), 1e-4)
    if config.outliers == "statistical":
        return _statistical(points, sigma_z, config)
    return points, sigma_z


def _bridged(depth: DepthImage, use: np.ndarray, config: FusionConfig) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rays, inverse depths and sigmas of the used pixels and of points between them and the pixels below.

    The inverse depth is linear along a plane's image, so the points between lie on the plane through both.
    """
    rays = depth.eye.rays()
    safe = np.where(use, depth.depth, 1.0)
    inverse = 1.0 / safe
    out = [(rays[use], inverse[use], depth.sigma[use])]
    shift = depth.eye.focal_px * depth.camera.baseline
    joined = use[:-1] & use[1:] & (np.abs(inverse[:-1] - inverse[1:]) * shift < config.bridge_step_px)
    upper, lower = rays[:-1][joined], rays[1:][joined]
    first, second = inverse[:-1][joined], inverse[1:][joined]
    sigma = np.maximum(depth.sigma[:-1], depth.sigma[1:])[joined]
    gap = np.linalg.norm(upper / first[:, None] - lower / second[:, None], axis=1)
    # Points half a cell apart leave no cell of the gap empty.
    pieces = np.minimum(np.ceil(gap / (0.5 * config.cell)), config.bridge)
    for k in range(1, config.bridge):
        some = pieces > k
        at = (k / pieces[some])[:, None]
        ray = (1.0 - at) * upper[some] + at * lower[some]
        between = (1.0 - at[:, 0]) * first[some] + at[:, 0] * second[some]
        out.append((ray, between, sigma[some]))
    return (
        np.concatenate([o[0] for o in out]),
        np.concatenate([o[1] for o in out]),
        np.concatenate([o[2] for o in out]),
    )


def _supported(depth: DepthImage) -> np.ndarray:
    """Pixels that lie within the noise of the median of their 5 x 5 neighbourhood: stray ones hang between surfaces."""
    good = np.isfinite(depth.depth) & (depth.depth > 0.0)
    inverse = np.where(good, 1.0 / np.where(good, depth.depth, 1.0), 0.0).astype(np.float32)
    known = (inverse > 0.0).astype(np.float32)
    neighbours = cv2.boxFilter(known, cv2.CV_32F, (5, 5), normalize=False)
    # Half of the window must be known, so that the median is of known pixels.
    median = cv2.medianBlur(inverse, 5)
    shift = depth.eye.focal_px * depth.camera.baseline
    return np.asarray((known > 0) & (neighbours >= 14.0) & (np.abs(inverse - median) * shift <= 1.0))


def _statistical(points: np.ndarray, sigma_z: np.ndarray, config: FusionConfig) -> tuple[np.ndarray, np.ndarray]:
    """Open3D's voxel filter at half a cell, then its statistical outlier filter. The sigma travels as a colour."""
    if len(points) == 0:
        return points, sigma_z
    o3d = open3d()
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    cloud.colors = o3d.utility.Vector3dVector(np.repeat(sigma_z[:, None], 3, axis=1))
    cloud = cloud.voxel_down_sample(0.5 * config.cell)
    cloud, _ = cloud.remove_statistical_outlier(8, 2.5)
    return np.asarray(cloud.points).copy(), np.asarray(cloud.colors)[:, 0].copy()
