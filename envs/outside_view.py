"""The robot on its ground as an onlooker sees it, for `render_mode` "rgb_array" and "human". For people; no agent sees it.

The onlooker stands beside the sun and follows with his lens, not his feet, so that only what moves is drawn anew; when the
robot leaves his picture plane he steps along. True ground, rocks, sun and shadows; the mock's ground is flat and bare.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.camera import Pinhole
from athlete_twin.model.spec import RobotSpec
from athlete_twin.robot import SimulatedRobot
from athlete_twin.sensors.onlooker import FIELD_OF_VIEW, Canvas, looking, stand_point
from athlete_twin.world.terrain import Terrain

SIZE = (640, 360)
"""width and height of a picture [px]"""
MARGIN = (320, 180)
"""by which the picture plane is wider to each side, for the lens to follow [px]"""
LOOK_AT = 0.42
"""height in the robot that a picture is centred on, as a share of the chassis' height"""


class OutsideView:
    """Pictures of one robot on one ground."""

    def __init__(self, terrain: Terrain, spec: RobotSpec) -> None:
        self._terrain, self._spec = terrain, spec
        self._canvas: Canvas | None = None
        self._camera_from_world = SE3.identity()
        self._frame = Pinhole.from_fov(*SIZE, FIELD_OF_VIEW)
        self._plane = replace(
            self._frame,
            width_px=SIZE[0] + 2 * MARGIN[0],
            height_px=SIZE[1] + 2 * MARGIN[1],
            cx_px=self._frame.cx_px + MARGIN[0],
            cy_px=self._frame.cy_px + MARGIN[1],
        )

    def picture(self, robot: SimulatedRobot) -> np.ndarray:
        """Red, green, blue, 8 bit, shape (360, 640, 3)."""
        below = (1.0 - LOOK_AT) * self._spec.chassis_height
        target = robot.truth().world_from_hex.translation - np.array([0.0, 0.0, below])
        canvas, (u, v) = self._canvas, self._left_top(target)
        if canvas is None or not (0 <= u <= 2 * MARGIN[0] and 0 <= v <= 2 * MARGIN[1]):
            canvas, (u, v) = self._stood(target), MARGIN
        canvas.show(robot.link_poses())
        return np.ascontiguousarray(canvas.picture[v : v + SIZE[1], u : u + SIZE[0], ::-1])

    def _stood(self, target: np.ndarray) -> Canvas:
        """The picture plane of an onlooker who has come to see a robot at `target` [m]."""
        world_from_camera = looking(stand_point(self._terrain, self._spec, target), target)
        painter = None if self._canvas is None else self._canvas.painter
        self._camera_from_world = world_from_camera.inverse()
        self._canvas = Canvas(self._terrain, self._spec, world_from_camera, self._plane, painter=painter)
        return self._canvas

    def _left_top(self, target: np.ndarray) -> tuple[int, int]:
        """Corner of the window on the picture plane that has `target` in its middle."""
        pixels, _ = self._frame.project(self._camera_from_world.apply(target[None]))
        u, v = np.rint(pixels[0] - [self._frame.cx_px, self._frame.cy_px]).astype(int)
        return int(u) + MARGIN[0], int(v) + MARGIN[1]
