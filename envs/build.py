"""Builds the two sides of a trial from names: the robot in its scenario, and the ground with its variant.

Everything heavy (Bullet, Open3D, OMPL) is imported here at the moment it is needed.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from athlete_twin.assets import named_toml, read_toml
from athlete_twin.errors import ConfigError
from athlete_twin.geometry.grid import HeightGrid
from athlete_twin.mock import MockAthlete
from athlete_twin.model.spec import RobotSpec
from athlete_twin.robot import SimulatedRobot
from athlete_twin.world.scenario import Scenario
from athlete_twin.world.terrain import Terrain, bare_terrain
from planner.decisions import GroundAgent, StageTimer, untimed

FLAT_CELL = 0.1
"""of the mock's flat ground [m]"""


def twin(
    spec: RobotSpec, scenario: Scenario, seed: int, *, payload_kg: float = 0.0
) -> tuple[SimulatedRobot, HeightGrid]:
    """The twin in its scenario, standing, and the true surface under it."""
    from athlete_twin.athlete import Athlete

    check_payload(spec, payload_kg)
    robot = Athlete(spec, scenario, seed, payload_kg=payload_kg)
    return robot, robot.terrain.grid


def mock(spec: RobotSpec, scenario: Scenario) -> tuple[SimulatedRobot, HeightGrid]:
    """The mock, standing, and flat ground of the scenario's size. Nothing breaks in it: a scenario with faults is refused."""
    check_unbroken(scenario)
    nx, ny = (int(np.ceil(size / FLAT_CELL)) + 1 for size in scenario.size)
    grid = HeightGrid(
        origin_x=scenario.x_min, origin_y=-0.5 * scenario.size[1], cell=FLAT_CELL, heights=np.zeros((nx, ny))
    )
    return MockAthlete(spec), grid


def drawn_ground(robot: SimulatedRobot, scenario: Scenario, grid: HeightGrid) -> Terrain:
    """What an onlooker sees a robot stand on: the twin's ground, or the mock's, which has a surface and no rocks."""
    if isinstance(robot, MockAthlete):
        return bare_terrain(scenario, grid)
    from athlete_twin.athlete import Athlete

    if not isinstance(robot, Athlete):
        raise ConfigError(f"{type(robot).__name__} has no ground to draw; a twin or a mock has")
    return robot.terrain


def ground_agent(
    spec: RobotSpec,
    variant: str,
    *,
    goal: tuple[float, float],
    seed: int,
    payload_kg: float = 0.0,
    timer: StageTimer = untimed,
    on_look: Callable[[Any], None] | None = None,
) -> GroundAgent:
    """The ground with a variant, by its name in the assets or by a path ending in .toml.

    `on_look` is told of every `planner.eyes.Look` at a picture, for whoever keeps scores.
    """
    from planner.agent import GroundAgent as PlanningAgent
    from planner.config import planner_config

    path, content = variant_content(variant)
    try:
        config = planner_config(content, spec, name=path.stem)
    except ConfigError as e:
        raise ConfigError(f"{path}: {e}") from e
    agent = PlanningAgent(
        spec, config, goal_in_world=np.array(goal, dtype=float), seed=seed, payload_kg=payload_kg, timer=timer
    )
    agent.eyes.on_look = on_look
    return agent


def variant_content(variant: str) -> tuple[Path, dict[str, Any]]:
    """File and content of a variant."""
    path = named_toml("variants", variant)
    return path, read_toml(path)


def check_payload(spec: RobotSpec, payload_kg: float) -> None:
    """Refuses a payload that the robot may not carry."""
    if not (np.isfinite(payload_kg) and 0.0 <= payload_kg <= spec.payload_limit):
        raise ConfigError(f"payload is {payload_kg} kg, {spec.name} carries 0 to {spec.payload_limit} kg")


def check_unbroken(scenario: Scenario) -> None:
    """Refuses a scenario whose faults a mock would not show."""
    if scenario.faults:
        kinds = ", ".join(sorted({fault.kind for fault in scenario.faults}))
        raise ConfigError(
            f"scenario {scenario.name!r} injects {kinds}: nothing breaks in the mock, which has no physics; "
            "take the twin, by the id without '-Mock', or body='twin'"
        )
