"""Depth image -> segments: the watershed of the depth map.

Model: the Laplacian is taken of the inverse depth, scaled to pixels of disparity, because there a plane has none at any
slant and the noise is the same everywhere. Segments start at its minima and take ever higher pixels until they meet
([SunSpiral2012] s5.2, after Gonzalez and Woods). Heights are those above the surface fitted to this
image (`ground_surface`); what is lower than the cut cannot be told from the ground and bounds the segments below. The same
flood, from given markers, cuts the drawn robot's edge (`seeded_mask`).
"""

from __future__ import annotations

from typing import no_type_check

import cv2
import numba
import numpy as np
from scipy import ndimage

from athlete_twin.geometry.arrays import DepthMap, Image
from planner.perception.stereo import DepthImage

UNKNOWN, GROUND = 0, 1
"""labels of pixels without depth and of pixels too low to tell from ground; objects count from 2"""
LEVELS = 256
EDGE_LEVEL = 16
"""of what counts as an edge"""
WHOLE = (slice(None), slice(None))


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
    level = depth_edges(depth, WHOLE, edge_px=edge_px)
    tall = known & (height > ground_cut)
    markers = np.where(known & ~tall, GROUND, UNKNOWN).astype(np.int32)
    # The minima: connected areas without an edge. The noise makes thousands of strict minima, so flat ones are pooled.
    count, parts, stats, _ = cv2.connectedComponentsWithStats((tall & (level < EDGE_LEVEL)).astype(np.uint8), connectivity=4)
    big = np.flatnonzero(stats[:, cv2.CC_STAT_AREA] >= min_segment_px)
    number = np.zeros(count, dtype=np.int32)
    number[big[big > 0]] = np.arange(2, 2 + int((big > 0).sum()))
    markers += number[parts]
    labels = flood(markers, level, tall)
    # Tall pixels that no flood reached are islands of their own: thin or shattered, so each is a segment.
    count, islands = cv2.connectedComponents((tall & (labels == UNKNOWN)).astype(np.uint8), connectivity=8)
    labels = np.where(islands > 0, islands + labels.max(), labels)
    return np.asarray(labels, dtype=np.int32)


def depth_edges(depth: DepthImage, window: tuple[slice, slice], *, edge_px: float) -> np.ndarray:
    """Laplacian of the disparity in a window of the image, `edge_px` as level 16 of 255, shape (h, w), uint8."""
    part = depth.depth[window]
    known = np.isfinite(part)
    constant = depth.eye.focal_px * depth.camera.baseline
    disparity = np.where(known, constant / np.where(known, part, 1.0), 0.0).astype(np.float32)
    # Unknown pixels have disparity 0, so the border of the known is an edge, as it mostly is in the world.
    edge = np.abs(cv2.Laplacian(cv2.medianBlur(disparity, 5), cv2.CV_32F, ksize=3))
    return np.asarray(np.clip(edge / edge_px * EDGE_LEVEL, 0.0, LEVELS - 1).astype(np.uint8))


def image_edges(grey: Image, *, edge_grey: float) -> np.ndarray:
    """Gradient of the image, a step of `edge_grey` as level 16 of 255, shape (h, w), uint8."""
    smooth = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), 1.0)
    across, down = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, scale=0.25), cv2.Sobel(smooth, cv2.CV_32F, 0, 1, scale=0.25)
    return np.asarray(np.clip(np.hypot(across, down) / edge_grey * EDGE_LEVEL, 0.0, LEVELS - 1).astype(np.uint8))


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


@numba.njit(cache=True)
@no_type_check
def flood(markers, level, allowed):
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
