"""One masked depth image -> points of the terrain in the world, each with one sigma of its height.

Far, vague and stray pixels are left out, and pixels whose depth or sigma is no number. The gap between rows of pixels on
far ground is bridged where both lie on one surface.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, no_type_check

import cv2
import numba
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
    eye, step = depth.eye, config.bridge_step_px / (depth.eye.focal_px * depth.camera.baseline)
    points, sigma_z = _bridged(
        depth.depth, depth.sigma, use, eye.focal_px, eye.cx_px, eye.cy_px, step, 0.5 * config.cell, config.bridge,
        np.ascontiguousarray(world_from_camera.rotation), world_from_camera.translation,
    )  # fmt: skip
    if config.outliers == "statistical":
        return _statistical(points, sigma_z, config)
    return points, sigma_z


@numba.njit(cache=True)
@no_type_check
def _bridged(depth, sigma, use, focal, cx, cy, most_step, spacing, most_pieces, rotation, translation):
    """Used pixels and points between them and the pixels below, in world, and one sigma of their heights.

    The inverse depth is linear along a plane's image, so the points between lie on the plane through both. They are half
    a cell apart, which leaves no cell of the gap empty. Order: pixels row by row, then each gap's first point, second, ...
    """
    rows, columns = depth.shape
    pieces = np.zeros((rows, columns), np.int16)
    sizes = np.zeros(max(most_pieces, 1), np.int64)
    for r in range(rows):
        for c in range(columns):
            if not use[r, c]:
                continue
            sizes[0] += 1
            if r + 1 == rows or not use[r + 1, c]:
                continue
            a, b = depth[r, c], depth[r + 1, c]
            if abs(1.0 / a - 1.0 / b) >= most_step:
                continue
            u, va, vb = (c - cx) / focal, (r - cy) / focal, (r + 1 - cy) / focal
            gap = np.sqrt((u * a - u * b) ** 2 + (va * a - vb * b) ** 2 + (a - b) ** 2)
            n = min(int(np.ceil(gap / spacing)), most_pieces)
            pieces[r, c] = n
            for k in range(1, n):
                sizes[k] += 1
    ends = np.cumsum(sizes)
    at = ends - sizes
    points = np.empty((ends[-1], 3))
    sigma_z = np.empty(ends[-1])
    for r in range(rows):
        for c in range(columns):
            if not use[r, c]:
                continue
            u = (c - cx) / focal
            for k in range(max(int(pieces[r, c]), 1)):
                part = k / max(int(pieces[r, c]), 1)
                v = (r + part - cy) / focal
                z, s = depth[r, c], sigma[r, c]
                if k > 0:
                    z = 1.0 / ((1.0 - part) / depth[r, c] + part / depth[r + 1, c])
                    s = max(s, sigma[r + 1, c])
                i = at[k]
                at[k] += 1
                for axis in range(3):
                    along = rotation[axis, 0] * u + rotation[axis, 1] * v + rotation[axis, 2]
                    points[i, axis] = along * z + translation[axis]
                # A wrong depth moves the point along its ray; on ground seen at a slant that is mostly sideways.
                sigma_z[i] = max(s * abs(along), 1e-4)
    return points, sigma_z


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
