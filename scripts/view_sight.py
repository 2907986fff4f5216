"""What the cameras of a robot see of flat ground: sight lines from both eyes of each pair, past the robot's own drawings.

A cell counts as seen by a pair when its centre lies in both pictures and nothing of the robot stands between it and
either eye: only then is there a depth. What is in both pictures but behind the robot is hidden.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from athlete_twin.geometry.open3d_loader import open3d
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.appearance import visual_parts
from athlete_twin.model.camera import StereoCamera
from athlete_twin.model.kinematics import kinematics
from athlete_twin.model.reach import leg_ik
from athlete_twin.model.spec import RobotSpec
from athlete_twin.model.stance import regular_stance

NEAR = 0.03
"""the renderer's: what is nearer is the camera's own housing [m]"""
LIFT = 0.5
"""of a wheel whose leg is raised out of the way [m]"""


@dataclass(frozen=True, eq=False, kw_only=True)
class Sight:
    """Which cells of flat ground which pair sees, the robot in its regular stance."""

    spec: RobotSpec
    cameras: tuple[StereoCamera, ...]
    """on the chassis, those of legs resolved; in the drawings' order"""
    groups: tuple[str, ...]
    """of each camera"""
    x: np.ndarray
    """of the cells' centres along hex x, shape (n,) [m]"""
    y: np.ndarray
    """shape (n,) [m]"""
    framed: np.ndarray
    """cell lies in both pictures of the pair, shape (cameras, n, n)"""
    seen: np.ndarray
    """and nothing of the robot hides it from either eye, shape (cameras, n, n)"""

    def by(self, *groups: str) -> np.ndarray:
        """Cells seen by any pair of some groups, shape (n, n)."""
        return np.asarray(self.seen[self._of(groups)].any(axis=0))

    def framed_by(self, *groups: str) -> np.ndarray:
        """Cells in the pictures of any pair of some groups, hidden or not, shape (n, n)."""
        return np.asarray(self.framed[self._of(groups)].any(axis=0))

    def radius(self) -> np.ndarray:
        """Distance of each cell from the hex's axis, shape (n, n) [m]."""
        return np.asarray(np.hypot(self.x[:, None], self.y[None, :]))

    def _of(self, groups: tuple[str, ...]) -> np.ndarray:
        return np.array([g in groups for g in self.groups])


def sight(spec: RobotSpec, *, cell: float, size: float, lifted: int | None = None) -> Sight:
    """Sight lines on a square of ground round the robot. Cost grows with its cells times the cameras.

    Args:
        spec: the drawings.
        cell: edge of a cell [m].
        size: edge of the square [m].
        lifted: index of a leg whose wheel is `LIFT` above its place; none by default.
    """
    joints = regular_stance(spec)
    kin = kinematics(spec.name)
    if lifted is not None:
        up = kin.leg_wheel(lifted, joints[lifted]).translation + np.array([0.0, 0.0, LIFT])
        joints[lifted] = leg_ik(spec, lifted, up[None])[0][0]
    hex_from_link = kin.link_poses(joints)
    scene = _scene(spec, hex_from_link)
    cameras = tuple(c.riding(hex_from_link) for c in spec.cameras)
    n = round(size / cell)
    at = (np.arange(n) + 0.5) * cell - 0.5 * size
    ground = np.stack(np.broadcast_arrays(at[:, None], at[None, :], -spec.chassis_height), axis=-1)
    framed, seen = np.zeros((2, len(cameras), n, n), dtype=bool)
    for k, camera in enumerate(cameras):
        eyes = (camera.hex_from_camera, camera.hex_from_right())
        framed[k] = np.all([_in_picture(camera, eye, ground) for eye in eyes], axis=0)
        seen[k][framed[k]] = np.all([_free(scene, eye, ground[framed[k]]) for eye in eyes], axis=0)
    return Sight(
        spec=spec, cameras=cameras, groups=tuple(c.group for c in spec.cameras), x=at, y=at, framed=framed, seen=seen
    )


def _scene(spec: RobotSpec, hex_from_link: dict[str, SE3]) -> object:
    o3d = open3d()
    scene = o3d.t.geometry.RaycastingScene()
    for part in visual_parts(spec):
        placed = hex_from_link[part.link].compose(part.link_from_part).apply(part.vertices)
        scene.add_triangles(
            o3d.core.Tensor(placed.astype(np.float32)), o3d.core.Tensor(np.asarray(part.triangles, dtype=np.uint32))
        )
    return scene


def _in_picture(camera: StereoCamera, hex_from_eye: SE3, points: np.ndarray) -> np.ndarray:
    pixel, depth = camera.eye.project(hex_from_eye.inverse().apply(points))
    inside = (pixel >= -0.5) & (pixel <= np.array([camera.eye.width_px, camera.eye.height_px]) - 0.5)
    return np.asarray((depth > 0.0) & inside.all(axis=-1))


def _free(scene: object, hex_from_eye: SE3, points: np.ndarray) -> np.ndarray:
    o3d = open3d()
    eye = hex_from_eye.translation
    span = points - eye
    length = np.linalg.norm(span, axis=-1, keepdims=True)
    rays = np.concatenate([eye + NEAR * span / length, span * (1.0 - NEAR / length)], axis=-1).astype(np.float32)
    return ~scene.test_occlusions(o3d.core.Tensor(rays), tnear=0.0, tfar=0.999).numpy()  # type: ignore[attr-defined, no-any-return]
