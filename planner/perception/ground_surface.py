"""The ground below one depth image: what the heights of things in it are measured from.

A plane through the points known on the ground, or through the image's lower points where fewer than three are known, and
on it the low quantile of patches, opened so that what is narrower than a metre does not lift it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from athlete_twin.geometry.arrays import DepthMap, Mat3, Points3, Vec3
from planner.perception.stereo import DepthImage

PATCH = 0.25
"""edge of a patch [m]"""
QUANTILE = 0.1
"""of the heights in a patch that is its ground"""
LEAST_POINTS = 12
"""in a patch that is known"""
ROUGHNESS = 0.6
"""by which the ground may depart from the plane [m]"""
SPARSE_PX = 256
"""width of the picture from which the surface is made: a patch has points enough [px]"""


@dataclass(frozen=True, eq=False, kw_only=True)
class GroundSurface:
    """Height of the ground over places in hex."""

    level_from_hex: Mat3
    """turns hex to a frame whose z is against gravity"""
    plane: Vec3
    """a, b, c of z = a x + b y + c in the level frame"""
    low: np.ndarray
    """corner of the patches in the level frame, shape (2,) [m]"""
    patches: DepthMap
    """height above the plane by patch [m]"""

    def height(self, points_in_hex: np.ndarray) -> np.ndarray:
        """Height of points above the ground, shape (n, 3) to (n,) [m]."""
        at = points_in_hex @ self.level_from_hex.T
        rise = at[:, 2] - (at[:, :2] @ self.plane[:2] + self.plane[2])
        place = (at[:, :2] - self.low) / PATCH - 0.5
        return np.asarray(rise - ndimage.map_coordinates(self.patches, place.T, order=1, mode="nearest"))


def ground_surface(depth: DepthImage, up_in_hex: Vec3, ground_in_hex: Points3) -> GroundSurface:
    """The ground fitted to a depth image.

    Args:
        depth: with or without the robot in it.
        up_in_hex: direction against gravity.
        ground_in_hex: points known on the ground, shape (n, 3) [m].
    """
    step = max(1, depth.eye.width_px // SPARSE_PX)
    level = _level(np.asarray(up_in_hex) / np.linalg.norm(up_in_hex))
    eye, z = depth.eye, depth.depth[::step, ::step]
    rows, columns = np.nonzero(np.isfinite(z))
    z = z[rows, columns]
    x, y = (columns * step - eye.cx_px) / eye.focal_px * z, (rows * step - eye.cy_px) / eye.focal_px * z
    points = np.column_stack([x, y, z])
    at = depth.camera.hex_from_camera.apply(points) @ level.T
    if len(at) == 0:
        return GroundSurface(level_from_hex=level, plane=np.zeros(3), low=np.zeros(2), patches=np.zeros((1, 1)))
    plane = _plane(np.asarray(ground_in_hex) @ level.T if len(ground_in_hex) >= 3 else _low_points(at))
    rise = at[:, 2] - (at[:, :2] @ plane[:2] + plane[2])
    low = at[:, :2].min(axis=0)
    index = np.minimum(np.floor((at[:, :2] - low) / PATCH).astype(np.int64), 199)
    shape = (int(index[:, 0].max()) + 1, int(index[:, 1].max()) + 1)
    heights = _quantile_by_cell(index[:, 0] * shape[1] + index[:, 1], rise, shape[0] * shape[1]).reshape(shape)
    return GroundSurface(level_from_hex=level, plane=plane, low=low, patches=_opened(np.clip(heights, -ROUGHNESS, ROUGHNESS)))


def height_above_ground(depth: DepthImage, up_in_hex: Vec3, ground_in_hex: Points3) -> DepthMap:
    """Height of every pixel above the ground fitted to this image, NaN where unknown [m]."""
    known = np.isfinite(depth.depth)
    out = np.full(depth.depth.shape, np.nan)
    points = depth.eye.rays()[known] * depth.depth[known][:, None]
    if len(points):
        surface = ground_surface(depth, up_in_hex, ground_in_hex)
        out[known] = surface.height(depth.camera.hex_from_camera.apply(points))
    return out


def _level(up: np.ndarray) -> np.ndarray:
    """Rotation that takes hex to a frame whose z is `up`."""
    x = np.array([1.0, 0.0, 0.0]) - up[0] * up
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(up, x), up])


def _low_points(at: np.ndarray) -> np.ndarray:
    """Lowest point of each of a few dozen patches: most of them are ground."""
    index = np.floor(at[:, :2] / 0.5).astype(np.int64)
    _, where = np.unique(index, axis=0, return_inverse=True)
    order = np.lexsort((at[:, 2], where.ravel()))
    first = np.searchsorted(where.ravel()[order], np.arange(where.max() + 1))
    return np.asarray(at[order[first]])


def _plane(points: np.ndarray) -> np.ndarray:
    """(a, b, c) of z = a x + b y + c by least absolute deviations, reweighted ten times."""
    design = np.column_stack([points[:, :2], np.ones(len(points))])
    weights = np.ones(len(points))
    solution = np.zeros(3)
    for _ in range(10):
        # A small pull to level: three points in a row do not fix a plane.
        hessian = design.T @ (design * weights[:, None]) + np.diag([1e-6, 1e-6, 0.0])
        solution = np.linalg.solve(hessian, design.T @ (weights * points[:, 2]))
        weights = 1.0 / np.maximum(np.abs(points[:, 2] - design @ solution), 0.02)
    return solution


def _opened(surface: np.ndarray) -> np.ndarray:
    """Unknown patches take their nearest neighbour's height; then an opening of one metre and a light smoothing."""
    unknown = np.isnan(surface)
    if unknown.all():
        return np.zeros_like(surface)
    nearest = ndimage.distance_transform_edt(unknown, return_distances=False, return_indices=True)
    filled = surface[tuple(nearest)]
    opened = ndimage.grey_opening(filled, size=(5, 5), mode="nearest")
    return np.asarray(ndimage.uniform_filter(opened, 3, mode="nearest"))


def _quantile_by_cell(flat: np.ndarray, values: np.ndarray, cells: int) -> np.ndarray:
    """Low quantile of the values in each cell, NaN in cells with too few."""
    order = np.lexsort((values, flat))
    counts = np.bincount(flat, minlength=cells)
    starts = np.concatenate([[0], np.cumsum(counts)[:-1]])
    pick = starts + (QUANTILE * np.maximum(counts - 1, 0)).astype(np.int64)
    out = values[order][np.minimum(pick, len(values) - 1)]
    return np.where(counts >= LEAST_POINTS, out, np.nan)
