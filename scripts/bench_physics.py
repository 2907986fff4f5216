"""How fast the twin is while a leg swings, in multiples of real time, beside a naive PyBullet set-up of the same robot.

    python scripts/bench_physics.py [--robots sdm_b t12] [--json]

Ours is the whole vehicle: physics at 240 Hz, executive at 24 Hz, sensors, collision watch. The peer is what PyBullet's
examples do: position motors on every joint, every link against the height field, 50 solver iterations, nothing else.
Both run in the same process one after the other; run it on a machine that does nothing else.
"""

from __future__ import annotations

import json
import sys
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
import tyro

from athlete_twin.athlete import Athlete
from athlete_twin.errors import AthleteError
from athlete_twin.messages import CommandSequence, JointMove, LegMove
from athlete_twin.model.reach import leg_ik
from athlete_twin.model.spec import RobotSpec, load_spec
from athlete_twin.model.stance import regular_stance
from athlete_twin.world.bullet_world import TICK, BulletWorld
from athlete_twin.world.scenario import load_scenario
from envs.provenance import provenance

TARGET = 10.0
"""x real time while a leg swings"""
NAIVE_ITERATIONS = 50


@dataclass(frozen=True, kw_only=True)
class Options:
    """Measures and prints one row a robot."""

    robots: tuple[str, ...] = ("sdm_b", "t12")
    scenario: str = "rock_field"
    json: bool = False
    """print one JSON object instead of the table"""


def main(arguments: list[str] | None = None) -> int:
    """Runs the script; the exit status."""
    options = tyro.cli(Options, args=arguments, description=__doc__)
    try:
        rows = [_row(robot, options.scenario) for robot in options.robots]
    except AthleteError as e:
        sys.stderr.write(f"bench_physics: {' '.join(str(e).split())}\n")
        return 2
    if options.json:
        sys.stdout.write(json.dumps({"rows": rows, "provenance": provenance()}) + "\n")
        return 0
    from rich.console import Console
    from rich.table import Table

    table = Table("what", "ours", "peer", "ratio", "target", "met")
    for row in rows:
        table.add_row(
            f"{row['name']} [{row['unit']}]", f"{row['ours']:.1f}", f"{row['peer']:.1f} ({row['peer_name']})",
            f"{row['ratio']:.1f}", row["target"], "yes" if row["met"] else "no",
        )  # fmt: skip
    Console().print(table)
    return 0


def _row(robot: str, scenario: str) -> dict[str, Any]:
    spec = load_spec(robot)
    athlete = Athlete(spec, load_scenario(scenario), 0)
    try:
        ours = _swing(athlete)
        peer = _naive(spec, athlete)
    finally:
        athlete.close()
    return {
        "name": f"{robot} leg swing", "ours": ours, "unit": "x real time", "peer_name": "naive PyBullet", "peer": peer,
        "ratio": ours / peer, "target": f">= {TARGET}", "met": ours >= TARGET,
    }  # fmt: skip


def _swing(athlete: Athlete) -> float:
    """Lifts leg 2, swings it forth and back, and times it."""
    spec, leg = athlete.spec, 1
    wheel = athlete.kin.leg_wheel(leg, athlete.executive.setpoint[leg]).translation
    up = wheel + np.array([0.0, 0.0, 1.5 * spec.wheel.radius])
    sides = [leg_ik(spec, leg, (up + np.array([dx, 0.0, 0.0]))[None])[0][0] for dx in (0.3, -0.3, 0.3, -0.3, 0.0)]
    _run(athlete, LegMove(leg=leg, wheel_in_hex=up, guard="break_contact"))
    start, before = time.perf_counter(), athlete.t
    _run(athlete, JointMove(leg=leg, waypoints=np.array(sides)))
    return (athlete.t - before) / (time.perf_counter() - start)


def _run(athlete: Athlete, *commands: Any) -> None:
    sequence = CommandSequence(seq=0, robot_id=athlete.robot_id, t=athlete.t, sequence_id=0, commands=commands)
    athlete.receive(sequence)
    while athlete.busy:
        athlete.advance(athlete.t + 5.0)


def _naive(spec: RobotSpec, athlete: Athlete, *, seconds: float = 5.0) -> float:
    """The same robot as PyBullet's examples would set it up, standing on the same ground."""
    from athlete_twin.assets import robot_dir

    with BulletWorld(athlete.terrain.grid) as world:
        b, client = world.bullet, world.client
        b.setPhysicsEngineParameter(numSolverIterations=NAIVE_ITERATIONS, physicsClientId=client)
        robot = b.loadURDF(
            str(robot_dir(spec.name) / "robot.urdf"),
            basePosition=[0.0, 0.0, spec.chassis_height + 0.1],
            flags=b.URDF_USE_INERTIA_FROM_FILE,
            physicsClientId=client,
        )
        stance = regular_stance(spec)
        targets = {f"leg{leg + 1}_{n}": stance[leg, k] for leg in range(6) for k, n in enumerate(spec.joint_names)}
        for i in range(b.getNumJoints(robot, physicsClientId=client)):
            name = b.getJointInfo(robot, i, physicsClientId=client)[1].decode()
            b.resetJointState(robot, i, targets.get(name, 0.0), physicsClientId=client)
            b.setJointMotorControl2(
                robot, i, b.POSITION_CONTROL, targetPosition=targets.get(name, 0.0), force=1e4, physicsClientId=client
            )
        ticks = round(seconds / TICK)
        start = time.perf_counter()
        for _ in range(ticks):
            b.stepSimulation(physicsClientId=client)
        return ticks * TICK / (time.perf_counter() - start)


if __name__ == "__main__":
    sys.exit(main())
