"""What a camera would see of the robot if the drawings and the believed pose were right: depth, surface, which leg.

One ray-casting scene in the hex frame serves all cameras of a pose. Rays are cast where asked for: a coarse look finds the
legs, a fine one is limited to their neighbourhood, since the robot covers but a small part of most pictures.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from athlete_twin.geometry.arrays import DepthMap, Mask
from athlete_twin.geometry.open3d_loader import open3d
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.appearance import CHASSIS, VisualPart, leg_of
from athlete_twin.model.camera import Pinhole
from planner.perception.stereo import DepthImage

START = 0.10
"""rays begin so far from the lens: nearer is the camera's own mounting, and a lens believed a few centimetres off may lie
inside of what it hangs under [m along the boresight]"""


@dataclass(frozen=True, eq=False, kw_only=True)
class DrawnView:
    """The drawn robot in one picture, NaN or -2 where it is not."""

    depth: DepthMap
    """along the boresight, shape (h, w) [m]"""
    normals: np.ndarray
    """of the drawn pixels' surface in the camera's frame, towards the camera, in the order of `numpy.nonzero(drawn)`, shape (n, 3)"""
    leg: np.ndarray
    """index of the leg, -1 for the chassis, -2 for no robot, shape (h, w), int8"""

    @property
    def drawn(self) -> Mask:
        """Pixels on the drawn robot."""
        return np.asarray(self.leg > CHASSIS - 1)


class RobotDrawing:
    """The drawn robot at one believed pose, ready for rays."""

    def __init__(self, parts: Sequence[VisualPart], hex_from_link: Mapping[str, SE3]) -> None:
        """Places the parts.

        Args:
            parts: the drawn robot; none is a robot that cannot be seen.
            hex_from_link: believed pose of every link that has a part.
        """
        self._scene: Any = None
        self._leg_of_triangle = np.zeros(0, dtype=np.int8)
        if not parts:
            return
        vertices, triangles, legs, count = [], [], [], 0
        for part in parts:
            vertices.append(hex_from_link[part.link].compose(part.link_from_part).apply(part.vertices))
            triangles.append(np.asarray(part.triangles) + count)
            legs.append(np.full(len(part.triangles), leg_of(part.link), dtype=np.int8))
            count += len(part.vertices)
        o3d = open3d()
        self._scene = o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(
            o3d.core.Tensor(np.concatenate(vertices).astype(np.float32)),
            o3d.core.Tensor(np.concatenate(triangles).astype(np.uint32)),
        )
        self._leg_of_triangle = np.concatenate(legs)

    def view(self, hex_from_camera: SE3, eye: Pinhole, *, only: Mask | None = None) -> DrawnView:
        """The robot as a camera sees it, in the pixels of `only` where given."""
        shape = (eye.height_px, eye.width_px)
        depth = np.full(shape, np.nan)
        leg = np.full(shape, CHASSIS - 1, dtype=np.int8)
        rows, columns = np.indices(shape).reshape(2, -1) if only is None else np.nonzero(only)
        if self._scene is None or len(rows) == 0:
            return DrawnView(depth=depth, normals=np.zeros((0, 3)), leg=leg)
        rays = np.empty((len(rows), 6), dtype=np.float32)
        # Directions have z = 1 in the camera, so the ray's parameter is the depth.
        x = ((columns - eye.cx_px) / eye.focal_px).astype(np.float32)
        y = ((rows - eye.cy_px) / eye.focal_px).astype(np.float32)
        turn = hex_from_camera.rotation.astype(np.float32)
        for k in range(3):
            rays[:, 3 + k] = turn[k, 0] * x + turn[k, 1] * y + turn[k, 2]
            rays[:, k] = np.float32(hex_from_camera.translation[k]) + np.float32(START) * rays[:, 3 + k]
        found = self._scene.cast_rays(open3d().core.Tensor(rays))
        t = found["t_hit"].numpy()
        hit = np.isfinite(t)
        at = rows[hit], columns[hit]
        depth[at] = t[hit] + START
        normals = found["primitive_normals"].numpy()[hit].astype(float) @ turn
        directions = np.column_stack([x[hit], y[hit], np.ones(int(hit.sum()))])
        normals[np.einsum("ij,ij->i", normals, directions) > 0.0] *= -1.0
        leg[at] = self._leg_of_triangle[found["primitive_ids"].numpy()[hit]]
        return DrawnView(depth=depth, normals=normals, leg=leg)


def draw_robot(depth: DepthImage, parts: Sequence[VisualPart], hex_from_link: Mapping[str, SE3]) -> DepthMap:
    """Depth of the drawn robot at the believed pose as this camera would see it, NaN where it is not [m]."""
    return RobotDrawing(parts, hex_from_link).view(depth.camera.hex_from_camera, depth.eye).depth


def beside_drawn(expected: DepthMap) -> tuple[np.ndarray, np.ndarray]:
    """Distance of every pixel from the drawing [px] and depth of the drawn pixel nearest to it [m], each shape (h, w).

    `expected` is NaN where nothing is drawn, and somewhere something is.
    """
    drawn = np.isfinite(expected)
    outside, owner = cv2.distanceTransformWithLabels(
        (~drawn).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    of_owner = np.zeros(int(owner.max()) + 1)
    of_owner[owner[drawn]] = expected[drawn]
    return np.asarray(outside), of_owner[owner]
