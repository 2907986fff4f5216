"""What PyBullet's examples do with a robot, as a peer to measure against: the same robot on the same ground.

Position motors on every joint, every link against the height field, 50 solver iterations, nothing else.
"""

from __future__ import annotations

import time

from athlete_twin.assets import robot_dir
from athlete_twin.geometry.grid import HeightGrid
from athlete_twin.model.spec import LEGS, RobotSpec
from athlete_twin.model.stance import regular_stance
from athlete_twin.world.bullet_world import TICK, BulletWorld

ITERATIONS = 50
DROP = 0.1
"""above the stance, so that no link starts inside the ground [m]"""


def naive_speed(spec: RobotSpec, ground: HeightGrid, *, seconds: float = 5.0) -> float:
    """Simulated seconds a processor second at 240 Hz, over so much simulated time [s]."""
    with BulletWorld(ground) as world:
        b, client = world.bullet, world.client
        b.setPhysicsEngineParameter(numSolverIterations=ITERATIONS, physicsClientId=client)
        robot = b.loadURDF(
            str(robot_dir(spec.name) / "robot.urdf"),
            basePosition=[0.0, 0.0, spec.chassis_height + DROP],
            flags=b.URDF_USE_INERTIA_FROM_FILE,
            physicsClientId=client,
        )
        stance = regular_stance(spec)
        targets = {f"leg{leg + 1}_{n}": stance[leg, k] for leg in range(LEGS) for k, n in enumerate(spec.joint_names)}
        for i in range(b.getNumJoints(robot, physicsClientId=client)):
            name = b.getJointInfo(robot, i, physicsClientId=client)[1].decode()
            b.resetJointState(robot, i, targets.get(name, 0.0), physicsClientId=client)
            b.setJointMotorControl2(
                robot, i, b.POSITION_CONTROL, targetPosition=targets.get(name, 0.0), force=1e4, physicsClientId=client
            )
        ticks = round(seconds / TICK)
        start = time.process_time()
        for _ in range(ticks):
            b.stepSimulation(physicsClientId=client)
        return ticks * TICK / (time.process_time() - start)
