"""A small picture of the true scene from above, for `render_mode="rgb_array"`. For people; no agent sees it."""

from __future__ import annotations

import cv2
import numpy as np

from athlete_twin.geometry.grid import HeightGrid
from athlete_twin.robot import SimulatedRobot

PIXELS_PER_METRE = 50.0
REACH = 5.0
"""shown to each side of the chassis [m]"""


def top_view(robot: SimulatedRobot, grid: HeightGrid, goal: tuple[float, float]) -> np.ndarray:
    """Heights, path, wheels (green when loaded), chassis and goal, RGB, x up and y to the left, shape (h, w, 3)."""
    truth = robot.truth()
    centre = truth.world_from_hex.translation[:2]
    n = int(2 * REACH * PIXELS_PER_METRE)
    offsets = REACH - (np.arange(n) + 0.5) / PIXELS_PER_METRE
    xy = np.stack(np.meshgrid(centre[0] + offsets, centre[1] + offsets, indexing="ij"), axis=-1)
    heights = grid.sample(xy)
    light = np.clip(150.0 + 60.0 * np.gradient(heights, axis=1) * PIXELS_PER_METRE + 80.0 * heights, 40, 235)
    image = np.repeat(light.astype(np.uint8)[..., None], 3, axis=2)

    def pixel(point: np.ndarray) -> tuple[int, int]:
        row, column = (REACH - (np.asarray(point)[:2] - centre)) * PIXELS_PER_METRE
        return int(np.clip(column, -4 * n, 5 * n)), int(np.clip(row, -4 * n, 5 * n))

    path = np.array([pixel(p.world_from_hex.translation) for p in robot.track], dtype=np.int32)
    cv2.polylines(image, [path.reshape(-1, 1, 2)], False, (60, 60, 200), 2)
    for wheel, load in zip(truth.wheels_in_world, truth.wheel_loads, strict=True):
        cv2.line(image, pixel(centre), pixel(wheel), (90, 90, 90), 3)
        cv2.circle(image, pixel(wheel), 10, (60, 170, 60) if load > 0.0 else (220, 120, 40), -1)
    nose = truth.world_from_hex.apply(np.array([0.8, 0.0, 0.0]))
    cv2.arrowedLine(image, pixel(centre), pixel(nose), (30, 30, 30), 3)
    cv2.drawMarker(image, pixel(np.array(goal)), (200, 40, 40), cv2.MARKER_STAR, 24, 3)
    return image
