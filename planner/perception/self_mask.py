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
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy import ndimage

from athlete_twin.errors import ConfigError
from athlete_twin.geometry.arrays import DepthMap, Mask, Points3, Vec3
from athlete_twin.geometry.open3d_loader import open3d
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.appearance import VisualPart
from planner.perception.stereo import DepthImage
from planner.perception.watershed import GROUND, height_above_ground, merge, segment

METHODS = ("watershed", "kinematic", "combined", "none")


@dataclass(frozen=True, kw_only=True)
class SelfMaskConfig:
    """How the robot is told from the terrain."""

    method: str = "combined"
    """"watershed", "kinematic", "combined" or "none" """
    ground_cut: float = 0.08
    """height above the fitted ground below which objects are not told apart [m]"""
    tyre_cut: float = 0.05
    """watershed alone: at a wheel's segment, what rises above the ground by more belongs to its tyre [m]"""
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
    leg_area: tuple[float, float] = (0.004, 6.0)
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
        labels = segment(
            depth,
            height,
            ground_cut=config.ground_cut,
            edge_px=config.edge_px,
            min_segment_px=config.min_segment_px,
        )
        if config.method == "combined":
            chosen = _overlapping(labels, robot, config)
            limit = beside_drawing(depth, expected, config=config, factor=config.growth)
        else:
            chosen = _leg_like(depth, labels, height, ground_in_hex, config)
            limit = np.ones_like(robot)
        taken = (np.isin(labels, chosen) & limit) if chosen else np.zeros_like(robot)
        if config.method == "watershed":
            taken = taken | _tyre_feet(depth, taken, height, ground_in_hex, config)
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
    # Where a fork is drawn the wheel behind it may be seen: what counts is the farthest part drawn nearby.
    size = 2 * int(np.ceil(np.median(reach[drawn]))) + 1
    farthest = cv2.dilate(np.where(drawn, expected, 0.0), np.ones((size, size), np.uint8))
    farthest = np.maximum(farthest, leg_depth)
    close = np.nan_to_num(depth.depth, nan=np.inf) <= farthest + config.depth_tolerance
    band = (outside <= reach) & (inside <= reach)
    return np.asarray((drawn & (inside > reach)) | (band & close))


def beside_drawing(depth: DepthImage, expected: DepthMap, *, config: SelfMaskConfig, factor: float) -> Mask:
    """Pixels on the drawn robot or within `factor` times the belief's tolerance beside it."""
    if not np.isfinite(expected).any():
        return np.zeros(expected.shape, dtype=bool)
    outside, _, reach = _outline(depth, expected, config)
    return np.asarray(outside <= factor * reach)


def _outline(
    depth: DepthImage, expected: DepthMap, config: SelfMaskConfig
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distance of every pixel from the drawing [px], depth of the nearest drawn pixel [m], the belief's tolerance [px]."""
    outside, nearest = ndimage.distance_transform_edt(np.isnan(expected), return_indices=True)
    leg_depth = expected[tuple(nearest)]
    reach = depth.eye.focal_px * (config.pose_tolerance / leg_depth + config.angle_tolerance) + config.dilate_px
    return outside, leg_depth, reach


def _overlapping(labels: np.ndarray, seed: Mask, config: SelfMaskConfig) -> tuple[int, ...]:
    sizes = np.bincount(labels.ravel())
    on_seed = np.bincount(labels.ravel(), weights=seed.ravel())
    chosen = np.flatnonzero(on_seed >= config.seed_overlap * np.maximum(sizes, 1))
    return tuple(int(n) for n in chosen if n > GROUND)


def _leg_like(
    depth: DepthImage, labels: np.ndarray, height: DepthMap, ground_in_hex: Points3, config: SelfMaskConfig
) -> tuple[int, ...]:
    """Segments of a leg's size that are too tall or hang too high for a rock, or that stand where a wheel stands."""
    group = merge(depth, labels, step_px=config.merge_step_px)
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


def _tyre_feet(
    depth: DepthImage, taken: Mask, height: DepthMap, ground_in_hex: Points3, config: SelfMaskConfig
) -> Mask:
    """Pixels of a tyre below the ground cut: low, beside its segment, and where the wheel is believed to stand."""
    if not taken.any() or len(ground_in_hex) == 0:
        return np.zeros_like(taken)
    low = np.nan_to_num(height, nan=-np.inf)
    below = (low > config.tyre_cut) & (low <= config.ground_cut)
    beside = ndimage.distance_transform_edt(~taken)
    # As many pixels as the cut is high where it is seen from the side.
    below &= (
        beside <= depth.eye.focal_px * config.ground_cut / np.nan_to_num(depth.depth, nan=np.inf) + config.dilate_px
    )
    points = depth.camera.hex_from_camera.apply(depth.points_in_camera()[below])[:, :2]
    steps = [np.linalg.norm(points - wheel, axis=1) for wheel in np.asarray(ground_in_hex)[:, :2]]
    out = np.zeros_like(taken)
    out[below] = np.min(steps, axis=0) < 0.75 * config.contact_radius
    return out


def _dilated_in_depth(depth: DepthImage, robot: Mask, config: SelfMaskConfig) -> Mask:
    """The mask grown by the matching's fattening, onto pixels that are no farther than the robot beside them."""
    if not robot.any():
        return robot
    outside, nearest = ndimage.distance_transform_edt(~robot, return_indices=True)
    beside = depth.depth[tuple(nearest)] + config.depth_tolerance
    close = np.nan_to_num(depth.depth, nan=np.inf) <= beside
    return np.asarray(robot | ((outside <= config.dilate_px) & close))
