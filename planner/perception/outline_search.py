"""Where the outline of the drawn robot lies in a depth image: the second half of the evidence that places the drawing.

Depth on a leg's surface says how far the leg is, but little of how it lies across the picture. The outline does: from each
drawn outline point a short line is searched across the outline for the place where depths like the leg's give way to the
terrain behind. Where the leg meets what is as near as itself, as a tyre does at its contact, there is no such place, and
nothing is claimed.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from athlete_twin.geometry.arrays import DepthMap
from planner.perception.robot_drawing import DrawnView

NEAR, FAR = 0.12, 0.25
"""depths within NEAR of the leg's are leg, those FAR or more behind it are terrain [m]"""
SIDE = 4
"""samples on each side of the sought place that have a say"""
LEAST_SCORE = 5
"""agreeing less contradicting samples, of 2 x SIDE, for a place that counts"""


@dataclass(frozen=True, eq=False, kw_only=True)
class Outline:
    """Points of the drawn robot behind which the picture shows something else."""

    pixels: np.ndarray
    """column and row in the coarse drawing, shape (n, 2)"""
    outward: np.ndarray
    """unit vectors in the picture, away from the robot, shape (n, 2)"""


def drawn_outline(view: DrawnView, *, limit: int) -> Outline:
    """At most `limit` points on the drawing's outline, evenly taken; the picture's border is no outline."""
    drawn = view.drawn.astype(np.uint8)
    inner = (drawn > 0) & (cv2.erode(drawn, np.ones((3, 3), np.uint8), borderValue=1) == 0)
    inner[[0, -1]] = False
    inner[:, [0, -1]] = False
    smooth = cv2.GaussianBlur(drawn.astype(np.float32), (0, 0), 1.5)
    across, down = cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1)
    rows, columns = np.nonzero(inner)
    if len(rows) > limit:
        keep = np.linspace(0, len(rows) - 1, limit).astype(np.int64)
        rows, columns = rows[keep], columns[keep]
    outward = -np.column_stack([across[rows, columns], down[rows, columns]]).astype(float)
    length = np.linalg.norm(outward, axis=1)
    clear = length > 0.2
    return Outline(
        pixels=np.column_stack([columns, rows])[clear].astype(float), outward=outward[clear] / length[clear, None]
    )


def search(depth: DepthMap, places: np.ndarray, outward: np.ndarray, leg_depth: np.ndarray, *, reach: int, stride: float) -> np.ndarray:
    """How far outward of where it was drawn the outline lies, NaN where nothing tells, shape (n,) [px].

    Args:
        depth: as matched [m].
        places: drawn outline points in this image, column and row, shape (n, 2) [px].
        outward: unit vectors, shape (n, 2).
        leg_depth: of the robot just inside, shape (n,) [m].
        reach: steps searched to each side.
        stride: length of a step [px].
    """
    steps = np.arange(-reach - SIDE, reach + SIDE + 1)
    at = places[:, None, :] + stride * steps[None, :, None] * outward[:, None, :]
    column, row = np.rint(at[..., 0]).astype(np.int64), np.rint(at[..., 1]).astype(np.int64)
    height, width = depth.shape
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    seen = np.where(inside, depth[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)], np.nan)
    behind = seen - leg_depth[:, None]
    with np.errstate(invalid="ignore"):
        vote = np.where(np.abs(behind) < NEAR, 1.0, np.where(behind > FAR, -1.0, 0.0))
    total = np.concatenate([np.zeros((len(places), 1)), np.cumsum(vote, axis=1)], axis=1)
    # The boundary lies before sample k: what is inside votes for the leg, what is outside against it.
    k = np.arange(SIDE, len(steps) - SIDE + 1)
    score = (total[:, k] - total[:, k - SIDE]) - (total[:, k + SIDE] - total[:, k])
    best = np.argmax(score, axis=1)
    top = np.take_along_axis(score, best[:, None], axis=1)[:, 0]
    # A plateau, where pixels without depth lie between, is taken at its middle.
    last = score.shape[1] - 1 - np.argmax(score[:, ::-1], axis=1)
    offset = stride * (0.5 * (steps[k[best]] + steps[k[last]]) - 0.5)
    return np.where((top >= LEAST_SCORE) & (last - best <= SIDE), offset, np.nan)
