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
from typing import no_type_check

import numba
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
    starts, ends, limits = _links(spec, hex_from_link, config)
    # What a leg can reach, with its wheel: nothing there hangs higher than the hips but the robot.
    reach = float(np.linalg.norm(spec.hips_in_hex[0])) + sum(float(np.linalg.norm(j.offset)) for j in spec.joints)
    pose = depth.camera.hex_from_camera
    eye = np.array([depth.eye.focal_px, depth.eye.cx_px, depth.eye.cy_px])
    floor = float((ground_in_hex @ up_in_hex).min()) + config.min_height
    gone = _without(
        depth.depth, eye, pose.rotation, pose.translation, np.asarray(up_in_hex, dtype=float), floor, reach, -config.headroom,
        starts, ends, limits,
    )  # fmt: skip
    return replace(depth, depth=gone, sigma=np.where(np.isfinite(gone), depth.sigma, np.nan))


def _links(
    spec: RobotSpec, hex_from_link: Mapping[str, SE3], config: SelfClearanceConfig
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Axes of the links between pitch joints and wheels, shapes (n, 3), and how near a point may hang (n,) [m]."""
    starts, ends, limits = [], [], []
    joints = [n for n in spec.joint_names if n.endswith("pitch")]
    for leg in range(LEGS):
        chain = [hex_from_link[f"leg{leg + 1}_{n}"].translation for n in joints]
        chain.append(hex_from_link[f"wheel{leg + 1}"].translation)
        for k, (a, b) in enumerate(pairwise(chain)):
            starts.append(a)
            ends.append(b)
            limits.append((config.last_link_distance if k == len(chain) - 2 else config.distance) * spec.wheel.radius)
    return np.array(starts), np.array(ends), np.array(limits)


@numba.njit(cache=True)
@no_type_check
def _without(depth, eye, rotation, origin, up, floor, reach, ceiling, starts, ends, limits):
    """The depth with NaN where the point lies higher than `floor` along `up` and beside a link, or high within reach."""
    out = depth.copy()
    for row in range(depth.shape[0]):
        for column in range(depth.shape[1]):
            z = depth[row, column]
            if not np.isfinite(z):
                continue
            cx, cy = (column - eye[1]) / eye[0] * z, (row - eye[2]) / eye[0] * z
            x = rotation[0, 0] * cx + rotation[0, 1] * cy + rotation[0, 2] * z + origin[0]
            y = rotation[1, 0] * cx + rotation[1, 1] * cy + rotation[1, 2] * z + origin[1]
            h = rotation[2, 0] * cx + rotation[2, 1] * cy + rotation[2, 2] * z + origin[2]
            if not x * up[0] + y * up[1] + h * up[2] > floor:
                continue
            if h > ceiling and x * x + y * y < reach * reach:
                out[row, column] = np.nan
                continue
            for k in range(len(limits)):
                sx, sy, sz = ends[k, 0] - starts[k, 0], ends[k, 1] - starts[k, 1], ends[k, 2] - starts[k, 2]
                px, py, pz = x - starts[k, 0], y - starts[k, 1], h - starts[k, 2]
                along = (px * sx + py * sy + pz * sz) / max(sx * sx + sy * sy + sz * sz, 1e-12)
                along = min(max(along, 0.0), 1.0)
                dx, dy, dz = px - along * sx, py - along * sy, pz - along * sz
                if dx * dx + dy * dy + dz * dz < limits[k] * limits[k]:
                    out[row, column] = np.nan
                    break
    return out
