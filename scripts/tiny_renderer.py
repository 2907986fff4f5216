"""The peer of `bench_render.py`: PyBullet's software renderer on the same robot, the same ground and the same eyes."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from types import TracebackType
from typing import Any

import numpy as np

from athlete_twin.assets import robot_dir
from athlete_twin.geometry.arrays import Joints
from athlete_twin.geometry.grid import HeightGrid
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.camera import Pinhole
from athlete_twin.model.solids import Mesh, obj_text
from athlete_twin.model.spec import LEGS, RobotSpec

NEAR, FAR = 0.03, 60.0
"""clipping planes [m]"""


class TinyScene:
    """One robot in one posture on one ground, in a client of its own."""

    def __init__(self, spec: RobotSpec, ground: HeightGrid, world_from_hex: SE3, joints: Joints) -> None:
        import pybullet

        self._bullet: Any = pybullet
        self._client = pybullet.connect(pybullet.DIRECT)
        with TemporaryDirectory() as folder:
            path = Path(folder) / "ground.obj"
            path.write_text(obj_text(_mesh(ground)))
            shape = pybullet.createVisualShape(
                pybullet.GEOM_MESH, fileName=str(path), rgbaColor=[0.6, 0.5, 0.4, 1.0], physicsClientId=self._client
            )
        pybullet.createMultiBody(baseVisualShapeIndex=shape, physicsClientId=self._client)
        self._robot = pybullet.loadURDF(
            str(robot_dir(spec.name) / "robot.urdf"), useFixedBase=True, physicsClientId=self._client,
            basePosition=world_from_hex.translation.tolist(),
        )  # fmt: skip
        names = [f"leg{leg + 1}_{n}" for leg in range(LEGS) for n in spec.joint_names]
        angle = dict(zip(names, joints.ravel().tolist(), strict=True))
        for i in range(pybullet.getNumJoints(self._robot, physicsClientId=self._client)):
            link = pybullet.getJointInfo(self._robot, i, physicsClientId=self._client)[12].decode()
            if link in angle:
                pybullet.resetJointState(self._robot, i, angle[link], physicsClientId=self._client)

    def picture(self, world_from_camera: SE3, eye: Pinhole) -> np.ndarray:
        """What an eye sees: red, green, blue, alpha, 8 bit, shape (h, w, 4)."""
        return np.asarray(self._drawn(world_from_camera, eye)[2]).reshape(eye.height_px, eye.width_px, 4)

    def robot(self, world_from_camera: SE3, eye: Pinhole) -> np.ndarray:
        """Which pixels show the robot, shape (h, w)."""
        owner = np.asarray(self._drawn(world_from_camera, eye)[4]).reshape(eye.height_px, eye.width_px)
        return np.asarray(owner == self._robot)

    def _drawn(self, world_from_camera: SE3, eye: Pinhole) -> Any:
        b = self._bullet
        place = world_from_camera.translation
        view = b.computeViewMatrix(
            place.tolist(), (place + world_from_camera.rotation[:, 2]).tolist(), (-world_from_camera.rotation[:, 1]).tolist()
        )
        vertical = 2.0 * np.rad2deg(np.arctan(0.5 * eye.height_px / eye.focal_px))
        projection = b.computeProjectionMatrixFOV(float(vertical), eye.width_px / eye.height_px, NEAR, FAR)
        return b.getCameraImage(
            eye.width_px, eye.height_px, view, projection, shadow=0, renderer=b.ER_TINY_RENDERER, physicsClientId=self._client
        )

    def __enter__(self) -> TinyScene:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None) -> None:
        self._bullet.disconnect(self._client)


def _mesh(ground: HeightGrid) -> Mesh:
    """The ground as triangles, two a cell."""
    x, y = ground.centres()
    nx, ny = ground.shape
    vertices = np.stack([*np.meshgrid(x, y, indexing="ij"), ground.heights], axis=-1).reshape(-1, 3)
    a = (np.arange(nx - 1)[:, None] * ny + np.arange(ny - 1)[None, :]).ravel()
    triangles = np.concatenate([np.column_stack([a, a + ny, a + ny + 1]), np.column_stack([a, a + ny + 1, a + 1])])
    return Mesh(vertices=vertices, triangles=triangles)
