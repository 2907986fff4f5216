"""Depth -> depth without the robot itself: legs left in the map are false rocks where the wheels stand.

Four methods behind one function, in the order in which the papers had them ([SunSpiral2012] s4.3, s5.2):

- `kinematic` draws the believed legs into the image. It never quite fits: camera poses, encoder zeros and sag are off.
- `flatten` (2008) lets the picture be and lays the ground round each planted wheel flat.
- `watershed` (2010) looks at the depth map alone: segments between depth edges, of which some look like a leg.
- `combined`, what the paper recommends: the drawn legs are the seed, moved onto the picture first, and the watershed finds
  their edge, in the image where depth fails.

Whatever the method, the product is the depth image with the robot unknown. `flatten` alone changes depths instead: the pixels
that it laid flat are in the mask and keep a depth.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from athlete_twin.errors import ConfigError
from athlete_twin.geometry.arrays import DepthMap, Mask, Points3, Vec3
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.appearance import VisualPart
from planner.perception.flatten import flattened
from planner.perception.ground_surface import ground_surface, height_above_ground
from planner.perception.kinematic_mask import KinematicConfig, kinematic_mask
from planner.perception.leg_like import LegLikeConfig, leg_like_mask
from planner.perception.robot_drawing import draw_robot
from planner.perception.seeded_mask import ROBOT, SeedConfig, seeded_mask
from planner.perception.stereo import DepthImage

METHODS = ("flatten", "kinematic", "watershed", "combined", "none")
DRAWING_METHODS = ("kinematic", "combined")
"""those that need the drawn robot"""


@dataclass(frozen=True, kw_only=True)
class SelfMaskConfig:
    """How the robot is told from the terrain."""

    method: str = "combined"
    """"flatten", "kinematic", "watershed", "combined" or "none" """
    flatten_radius: float = 0.60
    """flatten: of the ground laid flat round a contact; EST, a wheel, its fork and a leg that leans a little [m]"""
    kinematic: KinematicConfig = field(default_factory=KinematicConfig)
    watershed: LegLikeConfig = field(default_factory=LegLikeConfig)
    combined: SeedConfig = field(default_factory=SeedConfig)

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise ConfigError(f"self_mask method {self.method!r} is not one of {', '.join(METHODS)}")
        if not self.flatten_radius > 0.0:
            raise ConfigError(f"flatten_radius is {self.flatten_radius} m, must be positive, such as 0.6")


@dataclass(frozen=True, eq=False, kw_only=True)
class MaskedDepth:
    """A depth image without the robot."""

    depth: DepthImage
    """NaN where the robot is, and where it was NaN before; laid flat round the wheels by `flatten`"""
    mask: Mask
    """pixels taken for the robot, shape (h, w)"""
    labels: np.ndarray
    """segments, shape (h, w), int32: 0 unknown, 1 ground, 2.. objects; of `combined` 2 robot and 3 terrain in the band that
    was flooded; all 0 where the method makes none"""
    robot_labels: tuple[int, ...]
    """segments that were taken for the robot"""
    expected: DepthMap
    """depth of the robot as drawn, by `combined` where it was moved to, NaN elsewhere and where the method does not draw [m]"""
    true_from_drawn: SE3 = field(default_factory=SE3.identity)
    """motion that `combined` found to put the drawn robot where the picture shows it, in the camera's frame"""


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
    made = _Made(depth)
    if config.method == "flatten":
        flat, made.mask = flattened(depth, up_in_hex, ground_in_hex, radius=config.flatten_radius)
        made.depth = replace(depth, depth=flat, sigma=np.where(np.isfinite(flat), depth.sigma, np.nan))
        return made.product()
    if config.method == "kinematic":
        made.expected = draw_robot(depth, parts, hex_from_link)
        made.mask = kinematic_mask(depth, made.expected, config=config.kinematic)
    elif config.method == "watershed":
        height = height_above_ground(depth, up_in_hex, ground_in_hex)
        made.mask, made.labels, made.robot_labels = leg_like_mask(depth, height, ground_in_hex, config=config.watershed)
    elif config.method == "combined":
        surface = ground_surface(depth, up_in_hex, ground_in_hex)
        seeded = seeded_mask(depth, parts, hex_from_link, surface, config=config.combined)
        made.mask, made.labels, made.robot_labels = seeded.mask, seeded.labels, (ROBOT,)
        made.expected, made.true_from_drawn = seeded.expected, seeded.fit.true_from_drawn
    if made.mask.any():
        gone = made.mask
        made.depth = replace(depth, depth=np.where(gone, np.nan, depth.depth), sigma=np.where(gone, np.nan, depth.sigma))
    return made.product()


class _Made:
    """The product while it is made; at first that of a method that does nothing."""

    def __init__(self, depth: DepthImage) -> None:
        self.depth = depth
        self.mask = np.zeros(depth.depth.shape, dtype=bool)
        self.labels = np.zeros(depth.depth.shape, dtype=np.int32)
        self.robot_labels: tuple[int, ...] = ()
        self.expected = np.full(depth.depth.shape, np.nan)
        self.true_from_drawn = SE3.identity()

    def product(self) -> MaskedDepth:
        return MaskedDepth(
            depth=self.depth, mask=self.mask, labels=self.labels, robot_labels=self.robot_labels, expected=self.expected,
            true_from_drawn=self.true_from_drawn,
        )  # fmt: skip
