"""Which segments of a depth image look like a leg: the watershed method by itself, as in 2010.

[SunSpiral2012] s5.2 took "the segment that is the right size and not connected to the ground" of pictures with one leg raised.
In our walk all six wheels often stand, so "not connected" is made of two cuts: depth edges, and the height above the fitted
ground, below which everything is ground. Segments of a leg's size are legs if they are too tall or hang too high for a rock,
or stand where a wheel is believed to stand; there a rock that touches the wheel goes with it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from athlete_twin.geometry.arrays import DepthMap, Mask, Points3
from planner.perception.stereo import DepthImage
from planner.perception.watershed import GROUND, merge, segment


@dataclass(frozen=True, kw_only=True)
class LegLikeConfig:
    """What a leg looks like to the depth map alone."""

    ground_cut: float = 0.08
    """height above the fitted ground below which objects are not told apart [m]"""
    tyre_cut: float = 0.05
    """at a wheel's segment, what rises above the ground by more belongs to its tyre [m]"""
    edge_px: float = 1.5
    """Laplacian of the disparity that counts as an edge, well above the noise of matching [px]"""
    min_segment_px: int = 12
    """smaller segments join a neighbour"""
    merge_step_px: float = 1.5
    """neighbours whose disparity differs by less along their border are one object [px]"""
    leg_height: float = 0.75
    """an object that rises this far above the ground is no rock [m]"""
    hanging_height: float = 0.35
    """nor one whose lowest part is this high [m]"""
    contact_radius: float = 0.40
    """what stands this near to where a wheel is believed to stand is that wheel, never a rock [m]"""
    leg_reach: float = 4.5
    """farther from the chassis' axis there is no leg [m]"""
    leg_area: tuple[float, float] = (0.004, 6.0)
    """visible surface of a leg, least and most [m2]"""
    depth_tolerance: float = 0.15
    """beside a segment, what lies no farther behind it is matching's fattening of it [m]"""
    dilate_px: int = 2
    """matching fattens edges by about half its window [px]"""


def leg_like_mask(
    depth: DepthImage, height: DepthMap, ground_in_hex: Points3, *, config: LegLikeConfig
) -> tuple[Mask, np.ndarray, tuple[int, ...]]:
    """Pixels of segments that look like a leg, the segments, and which of them were taken.

    Args:
        depth: as matched.
        height: of every pixel above the ground [m].
        ground_in_hex: where wheels are believed to stand, shape (n, 3) [m].
        config: what a leg looks like.
    """
    labels = segment(
        depth, height, ground_cut=config.ground_cut, edge_px=config.edge_px, min_segment_px=config.min_segment_px
    )
    chosen = _leg_like(depth, labels, height, ground_in_hex, config)
    taken = np.isin(labels, chosen) if chosen else np.zeros(labels.shape, dtype=bool)
    taken = taken | _tyre_feet(depth, taken, height, ground_in_hex, config)
    return _dilated_in_depth(depth, taken, config), labels, chosen


def _leg_like(
    depth: DepthImage, labels: np.ndarray, height: DepthMap, ground_in_hex: Points3, config: LegLikeConfig
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
    depth: DepthImage, taken: Mask, height: DepthMap, ground_in_hex: Points3, config: LegLikeConfig
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


def _dilated_in_depth(depth: DepthImage, robot: Mask, config: LegLikeConfig) -> Mask:
    """The mask grown by the matching's fattening, onto pixels that are no farther than the robot beside them."""
    if not robot.any():
        return robot
    outside, nearest = ndimage.distance_transform_edt(~robot, return_indices=True)
    beside = depth.depth[tuple(nearest)] + config.depth_tolerance
    close = np.nan_to_num(depth.depth, nan=np.inf) <= beside
    return np.asarray(robot | ((outside <= config.dilate_px) & close))
