"""Depth image -> segments: the watershed of the depth map, and the ground surface that it is cut at.

Model: the Laplacian is taken of the inverse depth, scaled to pixels of disparity, because there a plane has none at any
slant and the noise is the same everywhere. Segments start at its minima and take ever higher pixels until they meet
([SunSpiral2012] s5.2, after Gonzalez and Woods). Heights are along gravity, measured from a surface fitted to this image;
what is lower than the cut cannot be told from the ground and bounds the segments below.
"""

from __future__ import annotations

from typing import no_type_check

import cv2
import numba
import numpy as np
from scipy import ndimage

from athlete_twin.geometry.arrays import DepthMap, Points3, Vec3
from planner.perception.stereo import DepthImage

UNKNOWN, GROUND = 0, 1
"""labels of pixels without depth and of pixels too low to tell from ground; objects count from 2"""
LEVELS = 256


def height_above_ground(depth: DepthImage, up_in_hex: Vec3, ground_in_hex: Points3) -> DepthMap:
    """Height of every pixel above a ground surface fitted to this image, NaN where unknown [m].

    The surface is a plane through the points known on the ground, or through the image's lower points where fewer
    than three are known, and on it the low quantile of patches, opened so that what is narrower than a metre does
    not lift it.
    """
    points = depth.camera.hex_from_camera.apply(depth.points_in_camera())
    up = np.asarray(up_in_hex) / np.linalg.norm(up_in_hex)
    level = _level(up)
    at = points @ level.T
    known = np.isfinite(at[..., 2])
    if not known.any():
        return np.full(depth.depth.shape, np.nan)
    base = _plane(np.asarray(ground_in_hex) @ level.T if len(ground_in_hex) >= 3 else _low_points(at[known]))
    rise = at[..., 2] - (at[..., :2] @ base[:2] + base[2])
    patch = 0.25
    low = at[known][:, :2].min(axis=0)
    index = np.floor((at[known][:, :2] - low) / patch).astype(np.int64)
    index = np.minimum(index, 199)
    shape = (int(index[:, 0].max()) + 1, int(index[:, 1].max()) + 1)
    flat = index[:, 0] * shape[1] + index[:, 1]
    surface = _quantile_by_cell(flat, rise[known], shape[0] * shape[1]).reshape(shape)
    surface = np.clip(surface, -0.6, 0.6)
    surface = _opened(surface)
    out = np.full(depth.depth.shape, np.nan)
    place = (at[known][:, :2] - low) / patch - 0.5
    out[known] = rise[known] - ndimage.map_coordinates(surface, place.T, order=1, mode="nearest")
    return out


def segment(
    depth: DepthImage, height: DepthMap, *, ground_cut: float, edge_px: float, min_segment_px: int
) -> np.ndarray:
    """Watershed of the depth map: labels 0 unknown, 1 ground, 2.. objects above the ground, shape (h, w).

    Args:
        depth: as matched.
        height: of every pixel above the ground [m].
        ground_cut: what is lower is ground [m].
        edge_px: Laplacian of the disparity that counts as an edge [px].
        min_segment_px: fewer pixels without an edge start no segment.
    """
    known = np.isfinite(depth.depth)
    constant = depth.eye.focal_px * depth.camera.baseline
    disparity = np.where(known, constant / np.where(known, depth.depth, 1.0), 0.0).astype(np.float32)
    # Unknown pixels have disparity 0, so the border of the known is an edge, as it mostly is in the world.
    smooth = cv2.medianBlur(disparity, 5)
    edge = np.abs(cv2.Laplacian(smooth, cv2.CV_32F, ksize=3))
    level = np.clip(edge / edge_px * 16.0, 0.0, LEVELS - 1).astype(np.uint8)
    tall = known & (height > ground_cut)
    markers = np.where(known & ~tall, GROUND, UNKNOWN).astype(np.int32)
    # The minima: connected areas without an edge. The noise makes thousands of strict minima, so flat ones are pooled.
    count, parts, stats, _ = cv2.connectedComponentsWithStats((tall & (level < 16)).astype(np.uint8), connectivity=4)
    big = np.flatnonzero(stats[:, cv2.CC_STAT_AREA] >= min_segment_px)
    number = np.zeros(count, dtype=np.int32)
    number[big[big > 0]] = np.arange(2, 2 + int((big > 0).sum()))
    markers += number[parts]
    labels = _flood(markers, level, tall)
    # Tall pixels that no flood reached are islands of their own: thin or shattered, so each is a segment.
    count, islands = cv2.connectedComponents((tall & (labels == UNKNOWN)).astype(np.uint8), connectivity=8)
    labels = np.where(islands > 0, islands + labels.max(), labels)
    return np.asarray(labels, dtype=np.int32)


def merge(depth: DepthImage, labels: np.ndarray, *, step_px: float) -> np.ndarray:
    """Group number of every label: objects whose disparities meet along most of their border are one."""
    constant = depth.eye.focal_px * depth.camera.baseline
    disparity = constant / np.where(np.isfinite(depth.depth), depth.depth, np.inf)
    count = int(labels.max()) + 1
    codes, steps = [], []
    for first, second, here, there in (
        (labels[:, :-1], labels[:, 1:], disparity[:, :-1], disparity[:, 1:]),
        (labels[:-1], labels[1:], disparity[:-1], disparity[1:]),
    ):
        border = (first > GROUND) & (second > GROUND) & (first != second)
        low, high = np.minimum(first[border], second[border]), np.maximum(first[border], second[border])
        codes.append(low.astype(np.int64) * count + high)
        steps.append(np.abs(here - there)[border])
    code, step = np.concatenate(codes), np.concatenate(steps)
    parent = np.arange(count)
    if len(code):
        pairs, where = np.unique(code, return_inverse=True)
        borders = ndimage.median(step, where, np.arange(len(pairs)))
        lengths = np.bincount(where)
        for pair in pairs[(borders < step_px) & (lengths >= 4)]:
            a, b = _root(parent, int(pair // count)), _root(parent, int(pair % count))
            parent[max(a, b)] = min(a, b)
    return np.array([_root(parent, n) for n in range(count)])


def _root(parent: np.ndarray, n: int) -> int:
    while parent[n] != n:
        n = int(parent[n])
    return n


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


def _quantile_by_cell(flat: np.ndarray, values: np.ndarray, cells: int, quantile: float = 0.1) -> np.ndarray:
    """Low quantile of the values in each cell, NaN in cells with fewer than 12."""
    order = np.lexsort((values, flat))
    counts = np.bincount(flat, minlength=cells)
    starts = np.concatenate([[0], np.cumsum(counts)[:-1]])
    pick = starts + (quantile * np.maximum(counts - 1, 0)).astype(np.int64)
    out = values[order][np.minimum(pick, len(values) - 1)]
    return np.where(counts >= 12, out, np.nan)


@numba.njit(cache=True)
@no_type_check
def _flood(markers, level, allowed):
    """Labels grown from the markers over allowed pixels, lowest level first: a queue a level, as rain would fill it."""
    height, width = markers.shape
    labels = markers.copy()
    total = height * width
    head = np.full(256, -1, np.int64)
    tail = np.full(256, -1, np.int64)
    following = np.full(total, -1, np.int64)
    queued = np.zeros(total, np.bool_)
    for start in range(total):
        if labels[start // width, start % width] > 1:
            queued[start] = True
            at = level[start // width, start % width]
            if tail[at] < 0:
                head[at] = start
            else:
                following[tail[at]] = start
            tail[at] = start
    current = 0
    while current < 256:
        pixel = head[current]
        if pixel < 0:
            current += 1
            continue
        head[current] = following[pixel]
        if head[current] < 0:
            tail[current] = -1
        row, column = pixel // width, pixel % width
        for k in range(4):
            r = row + (1 if k == 0 else (-1 if k == 1 else 0))
            c = column + (1 if k == 2 else (-1 if k == 3 else 0))
            if r < 0 or c < 0 or r >= height or c >= width:
                continue
            other = r * width + c
            if queued[other] or labels[r, c] != 0 or not allowed[r, c]:
                continue
            labels[r, c] = labels[row, column]
            queued[other] = True
            following[other] = -1
            # A pixel below the water's present level is flooded at once.
            at = max(level[r, c], current)
            if tail[at] < 0:
                head[at] = other
            else:
                following[tail[at]] = other
            tail[at] = other
    return labels
