"""Depth that hangs in the air beside a believed leg is leg, not terrain: the last sieve before the map.

Stereo fattens the outline of near things: pixels beside a leg get depths between the leg's and the ground's, and make
lumps of "terrain" where the leg will want to move ([SunSpiral2012] s4.3, fig. 8). The mask works in the picture; this
works in space. A point well above the ground and within a hand's breadth of a drawn link's axis cannot be terrain: the
robot stands there.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from athlete_twin.errors import ConfigError
from athlete_twin.geometry.arrays import Points3, Vec3
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.spec import LEGS, RobotSpec
from planner.perception.stereo import DepthImage


@dataclass(frozen=True, kw_only=True)
class SelfClearanceConfig:
    """How near to a leg's axis a point may hang."""

    enabled: bool = True
    """variants of 2008 had nothing of the kind"""
    distance: float = 1.25
    """from the axis of thigh or shank, over the wheel's radius: its own, the outline's fattening, the pose's error"""
    last_link_distance: float = 0.85
    """from the axis of the last link, over the wheel's radius: fork and half the wheel; a rock may stand beside it"""
    headroom: float = 0.25
    """below the hip plane; within the legs' reach nothing higher than that can be terrain, the robot swings there [m]"""
    min_height: float = 0.15
    """above the lowest wheel's contact: what is lower may well be ground [m]"""

    def __post_init__(self) -> None:
        if min(self.distance, self.last_link_distance, self.min_height, self.headroom) < 0.0:
            raise ConfigError(f"distances and heights must not be negative, got {self}")


def without_hanging_points(
    depth: DepthImage,
    spec: RobotSpec,
    hex_from_link: Mapping[str, SE3],
    *,
    up_in_hex: Vec3,
    ground_in_hex: Points3,
    config: SelfClearanceConfig,
) -> DepthImage:
    """The depth image with points unknown that hang beside a drawn leg.

    Args:
        depth: the robot's own pixels removed already.
        spec: the drawings.
        hex_from_link: believed pose of every link.
        up_in_hex: direction against gravity.
        ground_in_hex: contacts of the planted wheels, shape (n, 3) [m].
        config: distances.
    """
    if not config.enabled:
        return depth
    rows, columns = np.nonzero(np.isfinite(depth.depth))
    points = depth.camera.hex_from_camera.apply(depth.points_in_camera()[rows, columns])
    floor = float((ground_in_hex @ up_in_hex).min())
    high = points @ up_in_hex > floor + config.min_height
    rows, columns, points = rows[high], columns[high], points[high]
    near = np.zeros(len(points), dtype=bool)
    for leg in range(LEGS):
        joints = [n for n in spec.joint_names if n.endswith("pitch")]
        chain = [hex_from_link[f"leg{leg + 1}_{n}"].translation for n in joints] + [
            hex_from_link[f"wheel{leg + 1}"].translation
        ]
        for k, (a, b) in enumerate(pairwise(chain)):
            limit = config.last_link_distance if k == len(chain) - 2 else config.distance
            near |= _distance_to_segment(points, a, b) < limit * spec.wheel.radius
    reach = float(np.linalg.norm(spec.hips_in_hex[0])) + sum(float(np.linalg.norm(j.offset)) for j in spec.joints)
    near |= (np.hypot(points[:, 0], points[:, 1]) < reach) & (points[:, 2] > -config.headroom)
    gone = depth.depth.copy()
    gone[rows[near], columns[near]] = np.nan
    return replace(depth, depth=gone, sigma=np.where(np.isfinite(gone), depth.sigma, np.nan))


def _distance_to_segment(points: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    span = b - a
    along = np.clip((points - a) @ span / max(float(span @ span), 1e-12), 0.0, 1.0)
    return np.asarray(np.linalg.norm(points - a - along[:, None] * span, axis=1))
