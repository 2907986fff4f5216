"""The legs as drawn, projected into the picture at the believed, sagged pose: the method of [SunSpiral2012] s4.3.

It never quite fits, so a band along the outline as wide as the belief may be wrong is decided by depth.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from athlete_twin.errors import ConfigError
from athlete_twin.geometry.arrays import DepthMap, Mask
from planner.perception.robot_drawing import beside_drawn
from planner.perception.stereo import DepthImage


@dataclass(frozen=True, kw_only=True)
class KinematicConfig:
    """How far the drawing may be trusted."""

    pose_tolerance: float = 0.03
    """by which a leg's drawn place may miss the true one [m]"""
    angle_tolerance: float = 0.005
    """by which the camera's drawn direction may [rad]"""
    depth_tolerance: float = 0.15
    """beside the drawn leg, what lies within this of its depth or nearer is leg [m]"""
    dilate_px: int = 2
    """matching fattens edges by about half its window [px]"""

    def __post_init__(self) -> None:
        if min(self.pose_tolerance, self.angle_tolerance, self.depth_tolerance, self.dilate_px) < 0:
            raise ConfigError(f"tolerances must not be negative, got {self}")


def kinematic_mask(depth: DepthImage, expected: DepthMap, *, config: KinematicConfig) -> Mask:
    """Pixels on the drawn robot, and pixels beside it that lie as near as it does.

    Well inside the drawing all is robot. In the band along its outline the depth decides: terrain behind the leg stays, and
    so does terrain that the drawing covers only because it is displaced.

    Args:
        depth: as matched.
        expected: of the robot as drawn, NaN where it is not [m].
        config: width of the band.
    """
    drawn = np.isfinite(expected)
    if not drawn.any():
        return np.zeros(drawn.shape, dtype=bool)
    outside, leg_depth = beside_drawn(expected)
    reach = depth.eye.focal_px * (config.pose_tolerance / leg_depth + config.angle_tolerance) + config.dilate_px
    inside = cv2.distanceTransform(drawn.astype(np.uint8), cv2.DIST_L2, 5)
    # Where a fork is drawn the wheel behind it may be seen: what counts is the farthest part drawn nearby.
    size = 2 * int(np.ceil(np.median(reach[drawn]))) + 1
    farthest = cv2.dilate(np.where(drawn, expected, 0.0), np.ones((size, size), np.uint8))
    farthest = np.maximum(farthest, leg_depth)
    close = np.nan_to_num(depth.depth, nan=np.inf) <= farthest + config.depth_tolerance
    band = (outside <= reach) & (inside <= reach)
    return np.asarray((drawn & (inside > reach)) | (band & close))
