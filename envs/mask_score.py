"""How well the ground told the robot from the terrain, judged by what its pictures truly showed.

Judged are pixels that stereo gave a depth, two pixels of every outline left out: there one pixel shows both.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np

from athlete_twin.robot import ViewTruth
from envs.scoring import Summary
from planner.eyes import Look

ROBOT = 3
"""label of the robot in `ViewTruth.label`; ground and rock are below, sky is 0"""
OUTLINE_PX = 2
NEAR_WHEEL = 0.4
"""terrain so near to an axle, horizontally, is beside a wheel: a rock there must survive [m]"""


@dataclass(kw_only=True)
class MaskScore:
    """Counts pixels over a trial: hand it the truth of every view and every look of the ground."""

    robot: int = 0
    """pixels of the robot with a depth"""
    robot_removed: int = 0
    terrain: int = 0
    terrain_removed: int = 0
    near: int = 0
    """of the terrain, beside a wheel"""
    near_removed: int = 0
    _views: dict[tuple[str, float], ViewTruth] = field(default_factory=dict)

    def saw(self, view: ViewTruth) -> None:
        """What a picture truly shows; kept until the ground has looked at it."""
        self._views[view.camera, view.t] = view

    def looked(self, look: Look) -> None:
        """What the ground made of a picture."""
        view = self._views.pop((look.camera, look.t), None)
        if view is None:
            return
        robot = (view.label == ROBOT).astype(np.uint8)
        kernel = np.ones((2 * OUTLINE_PX + 1,) * 2, dtype=np.uint8)
        outline = cv2.dilate(robot, kernel) != cv2.erode(robot, kernel)
        judged = np.isfinite(look.matched.depth) & ~outline
        removed = ~np.isfinite(look.masked.depth.depth)
        terrain = judged & ((view.label == 1) | (view.label == 2))
        self.robot += int(np.sum(judged & (robot > 0)))
        self.robot_removed += int(np.sum(judged & (robot > 0) & removed))
        self.terrain += int(np.sum(terrain))
        self.terrain_removed += int(np.sum(terrain & removed))
        beside = np.zeros(view.label.shape, dtype=bool)
        for wheel in view.wheels_in_world:
            offset = view.points_in_world[..., :2] - wheel[:2]
            with np.errstate(invalid="ignore"):
                beside |= np.einsum("ijk,ijk->ij", offset, offset) < NEAR_WHEEL**2
        self.near += int(np.sum(terrain & beside))
        self.near_removed += int(np.sum(terrain & beside & removed))

    def summary(self) -> Summary:
        """Shares over all looks: of the robot's pixels removed, of the terrain's lost, and the same beside wheels."""
        return {
            "recall": _share(self.robot_removed, self.robot),
            "terrain_lost": _share(self.terrain_removed, self.terrain),
            "lost_near_wheels": _share(self.near_removed, self.near),
        }


def _share(part: int, whole: int) -> float | None:
    return part / whole if whole else None
