"""How well the ground told the robot from the terrain, judged by what its pictures truly showed.

Judged are pixels that stereo gave a depth, two pixels of every outline left out: there one pixel shows both.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field, fields

import cv2
import numpy as np

from athlete_twin.geometry.arrays import DepthMap, Image, Mask, Wheels
from athlete_twin.robot import ViewTruth
from envs.scoring import Summary
from planner.eyes import Look

ROBOT = 3
"""label of the robot in `ViewTruth.label`; ground and rock are below, sky is 0"""
OUTLINE_PX = 2
NEAR_WHEEL = 0.4
"""terrain so near to an axle, horizontally, is beside a wheel: a rock there must survive [m]"""


@dataclass(frozen=True, kw_only=True)
class MaskCounts:
    """Judged pixels of one or many views, and how many of each kind the ground removed; counts add."""

    robot: int = 0
    robot_removed: int = 0
    standing: int = 0
    """of the robot, on legs on the ground"""
    standing_removed: int = 0
    raised: int = 0
    """of the robot, on legs in the air"""
    raised_removed: int = 0
    terrain: int = 0
    terrain_removed: int = 0
    near: int = 0
    """of the terrain, beside a wheel"""
    near_removed: int = 0

    def __add__(self, other: MaskCounts) -> MaskCounts:
        return MaskCounts(**{f.name: getattr(self, f.name) + getattr(other, f.name) for f in fields(self)})

    def share(self, kind: str) -> float | None:
        """Removed over judged pixels of a kind, such as "standing"; None where none was judged."""
        whole = getattr(self, kind)
        return getattr(self, f"{kind}_removed") / whole if whole else None


def judged_pixels(label: Image, matched: DepthMap) -> Mask:
    """Pixels with a depth that are not on the robot's outline."""
    robot = (label == ROBOT).astype(np.uint8)
    kernel = np.ones((2 * OUTLINE_PX + 1,) * 2, dtype=np.uint8)
    outline = cv2.dilate(robot, kernel) != cv2.erode(robot, kernel)
    return np.asarray(np.isfinite(matched) & ~outline)


def beside_wheels(points_in_world: np.ndarray, wheels_in_world: Wheels) -> Mask:
    """Pixels that show a place beside a wheel, from what each shows, shape (h, w, 3) to (h, w)."""
    beside = np.zeros(points_in_world.shape[:2], dtype=bool)
    for wheel in wheels_in_world:
        offset = points_in_world[..., :2] - wheel[:2]
        with np.errstate(invalid="ignore"):
            beside |= np.einsum("ijk,ijk->ij", offset, offset) < NEAR_WHEEL**2
    return beside


def count_mask(
    *,
    label: Image,
    matched: DepthMap,
    removed: Mask,
    beside: Mask,
    leg: np.ndarray | None = None,
    raised: Collection[int] = (),
) -> MaskCounts:
    """What a mask removed of one view.

    Args:
        label: what each pixel truly shows: 0 sky, 1 ground, 2 rock, 3 robot.
        matched: depth before the mask [m].
        removed: pixels that the ground took for the robot.
        beside: pixels beside a wheel.
        leg: index of the leg that a pixel shows, -1 for none; without it no leg is told apart.
        raised: indices of the legs in the air.
    """
    judged = judged_pixels(label, matched)
    robot, terrain = judged & (label == ROBOT), judged & ((label == 1) | (label == 2))
    on_leg = robot & (leg >= 0) if leg is not None else np.zeros_like(robot)
    in_air = on_leg & np.isin(leg, list(raised)) if leg is not None else on_leg
    kinds = {"robot": robot, "standing": on_leg & ~in_air, "raised": in_air, "terrain": terrain, "near": terrain & beside}
    counts = {name: int(np.count_nonzero(kind)) for name, kind in kinds.items()}
    return MaskCounts(**counts, **{f"{name}_removed": int(np.count_nonzero(kind & removed)) for name, kind in kinds.items()})


@dataclass(kw_only=True)
class MaskScore:
    """Counts pixels over a trial: hand it the truth of every view and every look of the ground."""

    counts: MaskCounts = field(default_factory=MaskCounts)
    """so far"""
    _views: dict[tuple[str, float], ViewTruth] = field(default_factory=dict)

    def saw(self, view: ViewTruth) -> None:
        """What a picture truly shows; kept until the ground has looked at it."""
        self._views[view.camera, view.t] = view

    def looked(self, look: Look) -> None:
        """What the ground made of a picture."""
        view = self._views.pop((look.camera, look.t), None)
        if view is None:
            return
        # What was laid flat keeps a depth, but not what was seen.
        removed = ~np.isfinite(look.masked.depth.depth) | look.masked.mask
        self.counts += count_mask(
            label=view.label, matched=look.matched.depth, removed=removed,
            beside=beside_wheels(view.points_in_world, view.wheels_in_world),
        )  # fmt: skip

    def summary(self) -> Summary:
        """Shares over all looks: of the robot's pixels removed, of the terrain's lost, and the same beside wheels."""
        return {
            "recall": self.counts.share("robot"),
            "terrain_lost": self.counts.share("terrain"),
            "lost_near_wheels": self.counts.share("near"),
        }
