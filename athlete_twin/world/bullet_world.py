"""One Bullet client with the ground in it. The ground stops hulls; tyres are forces of our own and pass through it."""

from __future__ import annotations

import ctypes
import importlib
import os
import sys
from functools import cache
from types import TracebackType
from typing import Any

from athlete_twin.errors import PhysicsError
from athlete_twin.geometry.grid import HeightGrid
from athlete_twin.model.kinematics import GRAVITY

TICK = 1.0 / 240.0
"""default physics tick, and the coarsest: the gains of servos and tyres are made for it [s]"""
SOLVER_ITERATIONS = 20
"""only hull contacts make constraint rows, and few at a time"""


@cache
def _bullet() -> Any:
    """PyBullet, without the line about its build that its import writes to standard output from C."""
    sys.stdout.flush()
    kept, sink = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    os.dup2(sink, 1)
    try:
        module = importlib.import_module("pybullet")
        ctypes.CDLL(None).fflush(None)  # the line waits in C's own buffer
        return module
    finally:
        os.dup2(kept, 1)
        os.close(kept)
        os.close(sink)


class BulletWorld:
    """Owns one DIRECT client; every call names it. Rebuilt, never reset: only a rebuilt world is bit-exact."""

    def __init__(self, ground: HeightGrid, *, tick: float = TICK) -> None:
        if not 0.0 < tick <= TICK:
            raise PhysicsError(f"tick is {tick} s, must be above 0 and at most {TICK:.6f} s (240 Hz)")
        pybullet = _bullet()
        self.tick = tick
        """[s]"""
        self.bullet: Any = pybullet
        self.client: int = pybullet.connect(pybullet.DIRECT)
        pybullet.setGravity(0.0, 0.0, -GRAVITY, physicsClientId=self.client)
        pybullet.setPhysicsEngineParameter(
            fixedTimeStep=tick,
            numSolverIterations=SOLVER_ITERATIONS,
            deterministicOverlappingPairs=1,
            physicsClientId=self.client,
        )
        self.ground = ground
        self.ground_body = self._load_ground(ground)

    def __enter__(self) -> BulletWorld:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """Free the client; a second call does nothing."""
        if self.client >= 0:
            self.bullet.disconnect(physicsClientId=self.client)
            self.client = -1

    def save(self) -> int:
        """Bullet's number for a snapshot of its state, to be given to `restore` and at last to `forget`."""
        number = int(self.bullet.saveState(physicsClientId=self.client))
        if number < 0:
            raise PhysicsError("Bullet could not save its state")
        return number

    def restore(self, number: int) -> None:
        """Back to a snapshot."""
        self.bullet.restoreState(stateId=number, physicsClientId=self.client)

    def forget(self, number: int) -> None:
        """Free a snapshot; after `close` there is nothing left to free."""
        if self.client >= 0:
            self.bullet.removeState(number, physicsClientId=self.client)

    def _load_ground(self, ground: HeightGrid) -> int:
        nx, ny = ground.shape
        heights = ground.heights
        shape = self.bullet.createCollisionShape(
            self.bullet.GEOM_HEIGHTFIELD,
            meshScale=[ground.cell, ground.cell, 1.0],
            heightfieldData=heights.T.ravel().tolist(),
            numHeightfieldRows=nx,
            numHeightfieldColumns=ny,
            physicsClientId=self.client,
        )
        # Bullet centres a height field on the middle of its bounding box, in height as well.
        centre = [
            ground.origin_x + 0.5 * (nx - 1) * ground.cell,
            ground.origin_y + 0.5 * (ny - 1) * ground.cell,
            float(0.5 * (heights.min() + heights.max())),
        ]
        # Without a look of its own Bullet makes a mesh of the whole field for its own renderer: 1 s and 200 MB for 800 x 800.
        look = self.bullet.createVisualShape(self.bullet.GEOM_SPHERE, radius=0.01, physicsClientId=self.client)
        body = self.bullet.createMultiBody(0, shape, look, basePosition=centre, physicsClientId=self.client)
        self.bullet.changeDynamics(body, -1, lateralFriction=0.6, physicsClientId=self.client)
        return int(body)

