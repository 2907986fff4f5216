"""Depth -> depth without the robot itself: legs left in the map are false rocks where the wheels stand.

Three methods, after [SunSpiral2012] s5.2:

- `watershed` looks at the depth map alone. Its Laplacian is high at depth edges; segments grow from the Laplacian's
  minima through ever higher pixels until they meet ("a simplified form of the watershed"). What is near the camera,
  of the right size and not connected to the ground is leg. In our walk all six wheels often stand, so "not connected"
  is made of two cuts: depth edges, and the height above the fitted ground, below which everything is ground.
- `kinematic` draws the believed legs into the image. It never quite fits: camera poses, encoder zeros and sag are
  off.
- `combined`, what the paper recommends: the drawn legs are the seed, and segments that lie on the seed are taken
  whole.

Model: the Laplacian is taken of the inverse depth, scaled to pixels of disparity, because there a plane has none at
any slant and the noise is the same everywhere. Heights are along gravity, measured from a ground surface fitted to
this image.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import no_type_check

import cv2
import numba
import numpy as np
from scipy import ndimage

from athlete_twin.errors import ConfigError
from athlete_twin.geometry.arrays import DepthMap, Mask, Points3, Vec3
from athlete_twin.geometry.open3d_loader import open3d
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.appearance import VisualPart
from planner.perception.stereo import DepthImage

METHODS = ("watershed", "kinematic", "combined", "none")
UNKNOWN, GROUND = 0, 1
"""labels of pixels without depth and of pixels too low to tell from ground; objects count from 2"""
LEVELS = 256


@dataclass(frozen=True, kw_only=True)
class SelfMaskConfig:
    """How the robot is told from the terrain."""

    method: str = "combined"
    """"watershed", "kinematic", "combined" or "none" """
    ground_cut: float = 0.08
    """height above the fitted ground below which objects are not told apart [m]"""
    edge_px: float = 1.5
    """Laplacian of the disparity that counts as an edge, well above the noise of matching [px]"""
    min_segment_px: int = 12
    """smaller segments join a neighbour"""
    merge_step_px: float = 1.5
    """watershed alone: neighbours whose disparity differs by less along their border are one object [px]"""
    leg_height: float = 0.75
    """watershed alone: an object that rises this far above the ground is no rock [m]"""
    hanging_height: float = 0.35
    """watershed alone: nor one whose lowest part is this high [m]"""
    contact_radius: float = 0.40
    """watershed alone: what stands this near to where a wheel is believed to stand is that wheel, never a rock [m]"""
    leg_reach: float = 4.5
    """watershed alone: farther from the chassis' axis there is no leg [m]"""
    leg_area: tuple[float, float] = (0.01, 6.0)
    """watershed alone: visible surface of a leg, least and most [m2]"""
    seed_overlap: float = 0.5
    """combined: a segment with this part of its pixels on the drawn legs is taken"""
    growth: float = 4.0
    """combined: but no farther from the drawing than this many times the belief's tolerance"""
    pose_tolerance: float = 0.03
    """by which a leg's drawn place may miss the true one [m]"""
    angle_tolerance: float = 0.005
    """by which the camera's drawn direction may [rad]"""
    depth_tolerance: float = 0.15
    """beside the drawn leg, what lies within this of its depth or nearer is leg [m]"""
    dilate_px: int = 2
    """matching fattens edges by about half its window [px]"""

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise ConfigError(f"self_mask method {self.method!r} is not one of {', '.join(METHODS)}")


@dataclass(frozen=True, eq=False, kw_only=True)
class MaskedDepth:
    """A depth image without the robot."""

    depth: DepthImage
    """NaN where the robot is, and where it was NaN before"""
    mask: Mask
    """pixels taken for the robot, shape (h, w)"""
    labels: np.ndarray
    """segments, shape (h, w): 0 unknown, 1 ground, 2.. objects; all 0 where the method makes none"""
    robot_labels: tuple[int, ...]
    """segments that were taken for the robot"""
    expected: DepthMap
    """depth of the robot as drawn at the believed pose, NaN elsewhere and where the method does not draw [m]"""


def remove_self(
    depth: DepthImage,
    *,
    config: SelfMaskConfig,
    parts: Sequence[VisualPart],
    hex_from_link: Mapping[str, SE3],
    up_in_hex: Vec3,
    ground_in_hex: Points3,
) -> MaskedDepth:
    """The depth image with the robot's own pixels unknown.

    Args:
        depth: as matched.
        config: method and limits.
        parts: the drawn robot; only the methods that draw need it.
        hex_from_link: believed pose of every link that has a part.
        up_in_hex: direction against gravity, from the measured attitude.
        ground_in_hex: points believed on the ground, such as the planted wheels' contacts, shape (n, 3) [m].
    """
    nothing = np.full(depth.depth.shape, np.nan)
    labels = np.zeros(depth.depth.shape, dtype=np.int32)
    robot = np.zeros(depth.depth.shape, dtype=bool)
    chosen: tuple[int, ...] = ()
    if config.method == "none":
        return MaskedDepth(depth=depth, mask=robot, labels=labels, robot_labels=chosen, expected=nothing)
    expected = nothing
    if config.method in ("kinematic", "combined"):
        expected = draw_robot(depth, parts, hex_from_link)
        robot = near_drawing(depth, expected, config=config)
    if config.method in ("watershed", "combined"):
        height = height_above_ground(depth, up_in_hex, ground_in_hex)
        labels = segment(depth, height, config=config)
        if config.method == "combined":
            chosen = _overlapping(labels, robot, config)
            limit = beside_drawing(depth, expected, config=config, factor=config.growth)
        else:
            chosen = _leg_like(depth, labels, height, ground_in_hex, config)
            limit = np.ones_like(robot)
        taken = (np.isin(labels, chosen) & limit) if chosen else np.zeros_like(robot)
        robot = robot | _dilated_in_depth(depth, taken, config)
    masked = replace(depth, depth=np.where(robot, np.nan, depth.depth), sigma=np.where(robot, np.nan, depth.sigma))
    return MaskedDepth(depth=masked, mask=robot, labels=labels, robot_labels=chosen, expected=expected)


def draw_robot(depth: DepthImage, parts: Sequence[VisualPart], hex_from_link: Mapping[str, SE3]) -> DepthMap:
    """Depth of the drawn robot at the believed pose as this camera would see it, NaN where it is not [m]."""
    o3d = open3d()
    camera_from_hex = depth.camera.hex_from_camera.inverse()
    scene = o3d.t.geometry.RaycastingScene()
    for part in parts:
        camera_from_part = camera_from_hex.compose(hex_from_link[part.link]).compose(part.link_from_part)
        vertices = camera_from_part.apply(part.vertices)
        scene.add_triangles(
            o3d.core.Tensor(np.ascontiguousarray(vertices, dtype=np.float32)),
            o3d.core.Tensor(np.ascontiguousarray(part.triangles, dtype=np.uint32)),
        )
    directions = depth.eye.rays().astype(np.float32)
    rays = np.concatenate([np.zeros_like(directions), directions], axis=-1)
    # Directions have z = 1, so the ray's parameter is the depth.
    hit = scene.cast_rays(o3d.core.Tensor(rays))["t_hit"].numpy().astype(np.float64)
    return np.where(np.isfinite(hit), hit, np.nan)


def near_drawing(depth: DepthImage, expected: DepthMap, *, config: SelfMaskConfig) -> Mask:
    """Pixels on the drawn robot, and pixels beside it that lie as near as it does.

    Well inside the drawing all is robot. In the band along its outline, as wide as the belief may be wrong, the depth
    decides: terrain behind the leg stays, and so does terrain that the drawing covers only because it is displaced.
    """
    drawn = np.isfinite(expected)
    if not drawn.any():
        return np.zeros(drawn.shape, dtype=bool)
    outside, leg_depth, reach = _outline(depth, expected, config)
    inside = cv2.distanceTransform(drawn.astype(np.uint8), cv2.DIST_L2, 5)
    close = np.nan_to_num(depth.depth, nan=np.inf) <= leg_depth + config.depth_tolerance
    band = (outside <= reach) & (inside <= reach)
    return np.asarray((drawn & (inside > reach)) | (band & close))


def beside_drawing(depth: DepthImage, expected: DepthMap, *, config: SelfMaskConfig, factor: float) -> Mask:
    """Pixels on the drawn robot or within `factor` times the belief's tolerance beside it."""
    if not np.isfinite(expected).any():
        return np.zeros(expected.shape, dtype=bool)
    outside, _, reach = _outline(depth, expected, config)
    return np.asarray(outside <= factor * reach)


def _outline(depth: DepthImage, expected: DepthMap, config: SelfMaskConfig) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distance of every pixel from the drawing [px], depth of the nearest drawn pixel [m], the belief's tolerance [px]."""
    outside, nearest = ndimage.distance_transform_edt(np.isnan(expected), return_indices=True)
    leg_depth = expected[tuple(nearest)]
    reach = depth.eye.focal_px * (config.pose_tolerance / leg_depth + config.angle_tolerance) + config.dilate_px
    return outside, leg_depth, reach


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


def segment(depth: DepthImage, height: DepthMap, *, config: SelfMaskConfig) -> np.ndarray:
    """Watershed of the depth map: labels 0 unknown, 1 ground, 2.. objects above the ground, shape (h, w)."""
    known = np.isfinite(depth.depth)
    constant = depth.eye.focal_px * depth.camera.baseline
    disparity = np.where(known, constant / np.where(known, depth.depth, 1.0), 0.0).astype(np.float32)
    # Unknown pixels have disparity 0, so the border of the known is an edge, as it mostly is in the world.
    smooth = cv2.medianBlur(disparity, 5)
    edge = np.abs(cv2.Laplacian(smooth, cv2.CV_32F, ksize=3))
    level = np.clip(edge / config.edge_px * 16.0, 0.0, LEVELS - 1).astype(np.uint8)
    tall = known & (height > config.ground_cut)
    markers = np.where(known & ~tall, GROUND, UNKNOWN).astype(np.int32)
    # The minima: connected areas without an edge. The noise makes thousands of strict minima, so flat ones are pooled.
    count, parts, stats, _ = cv2.connectedComponentsWithStats((tall & (level < 16)).astype(np.uint8), connectivity=4)
    big = np.flatnonzero(stats[:, cv2.CC_STAT_AREA] >= config.min_segment_px)
    number = np.zeros(count, dtype=np.int32)
    number[big[big > 0]] = np.arange(2, 2 + int((big > 0).sum()))
    markers += number[parts]
    labels = _flood(markers, level, tall)
    # Tall pixels that no flood reached are islands of their own: thin or shattered, so each is a segment.
    count, islands = cv2.connectedComponents((tall & (labels == UNKNOWN)).astype(np.uint8), connectivity=8)
    labels = np.where(islands > 0, islands + labels.max(), labels)
    return np.asarray(labels, dtype=np.int32)


def _overlapping(labels: np.ndarray, seed: Mask, config: SelfMaskConfig) -> tuple[int, ...]:
    sizes = np.bincount(labels.ravel())
    on_seed = np.bincount(labels.ravel(), weights=seed.ravel())
    chosen = np.flatnonzero(on_seed >= config.seed_overlap * np.maximum(sizes, 1))
    return tuple(int(n) for n in chosen if n > GROUND)


def _leg_like(
    depth: DepthImage, labels: np.ndarray, height: DepthMap, ground_in_hex: Points3, config: SelfMaskConfig
) -> tuple[int, ...]:
    """Segments of a leg's size that are too tall or hang too high for a rock, or that stand where a wheel stands."""
    group = _merged(depth, labels, config)
    objects = labels > GROUND
    if not objects.any():
        return ()
    which = group[labels]
    index = np.unique(which[objects])
    pixel_area = (np.nan_to_num(depth.depth) / depth.eye.focal_px) ** 2
    area = ndimage.sum_labels(pixel_area, np.where(objects, which, 0), index)
    points = depth.camera.hex_from_camera.apply(depth.points_in_camera())[objects][:, :2]
    away = np.linalg.norm(points, axis=1)
    steps = [np.linalg.norm(points - wheel, axis=1) for wheel in np.asarray(ground_in_hex)[:, :2]]
    from_wheel = np.min(steps, axis=0) if steps else np.full(len(points), np.inf)
    distances = ndimage.median(away, which[objects], index)
    wheel_distances = ndimage.median(from_wheel, which[objects], index)
    chosen: list[int] = []
    order = np.argsort(which[objects], kind="stable")
    values = height[objects][order]
    edges = [*np.searchsorted(which[objects][order], index, side="left").tolist(), len(values)]
    for k, g in enumerate(index):
        low, high = np.quantile(values[edges[k] : edges[k + 1]], [0.05, 0.95])
        sized = config.leg_area[0] <= area[k] <= config.leg_area[1]
        like_leg = high > config.leg_height or low > config.hanging_height
        at_wheel = wheel_distances[k] < config.contact_radius
        if sized and distances[k] < config.leg_reach and (like_leg or at_wheel):
            chosen.extend(int(n) for n in np.flatnonzero(group == g) if n > GROUND)
    return tuple(chosen)


def _merged(depth: DepthImage, labels: np.ndarray, config: SelfMaskConfig) -> np.ndarray:
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
        for pair in pairs[(borders < config.merge_step_px) & (lengths >= 4)]:
            a, b = _root(parent, int(pair // count)), _root(parent, int(pair % count))
            parent[max(a, b)] = min(a, b)
    return np.array([_root(parent, n) for n in range(count)])


def _root(parent: np.ndarray, n: int) -> int:
    while parent[n] != n:
        n = int(parent[n])
    return n


def _dilated_in_depth(depth: DepthImage, robot: Mask, config: SelfMaskConfig) -> Mask:
    """The mask grown by the matching's fattening, onto pixels that are no farther than the robot beside them."""
    if not robot.any():
        return robot
    outside, nearest = ndimage.distance_transform_edt(~robot, return_indices=True)
    beside = depth.depth[tuple(nearest)] + config.depth_tolerance
    close = np.nan_to_num(depth.depth, nan=np.inf) <= beside
    return np.asarray(robot | ((outside <= config.dilate_px) & close))


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
