"""Builds the two sides of a trial from names: the robot in its scenario, and the ground with its variant.

Everything heavy (Bullet, Open3D, OMPL) is imported here at the moment it is needed.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from athlete_twin.assets import robot_names
from athlete_twin.errors import ConfigError
from athlete_twin.geometry.grid import HeightGrid
from athlete_twin.mock import MockAthlete
from athlete_twin.model.spec import RobotSpec, load_spec
from athlete_twin.robot import SimulatedRobot
from athlete_twin.world.scenario import Scenario
from athlete_twin.world.terrain import Terrain, bare_terrain
from envs.variants import OutsidePlanner, TomlVariant, variant_named
from planner.decisions import GroundAgent, StageTimer, untimed

if TYPE_CHECKING:
    from planner.config import PlannerConfig

OUTSIDE_STREAM = 7004
"""of a planner from outside, beside the trial's seed"""
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
    variant: str | TomlVariant | OutsidePlanner,
    *,
    goal: tuple[float, float],
    seed: int,
    payload_kg: float = 0.0,
    timer: StageTimer = untimed,
    on_look: Callable[[Any], None] | None = None,
) -> GroundAgent:
    """The ground with a variant, or a planner from outside; by one of the names that `envs.variants` tells of, or what it means.

    `on_look` is told of every `planner.eyes.Look` at a picture, for whoever keeps scores; a planner from outside that has no
    `planner.eyes.Eyes` as its `eyes` tells of none.
    """
    from planner.agent import GroundAgent as PlanningAgent
    from planner.eyes import Eyes

    found = variant_named(variant) if isinstance(variant, str) else variant
    goal_in_world = np.array(goal, dtype=float)
    if isinstance(found, OutsidePlanner):
        # A seed of its own: the trial's would draw the same ground and the same robot once more.
        own_seed = int(np.random.SeedSequence([seed, OUTSIDE_STREAM]).generate_state(1)[0])
        agent = found.agent(spec=spec, goal_in_world=goal_in_world, seed=own_seed, payload_kg=payload_kg, timer=timer)
    else:
        config = _config(found, spec)
        agent = PlanningAgent(spec, config, goal_in_world=goal_in_world, seed=seed, payload_kg=payload_kg, timer=timer)
    eyes = getattr(agent, "eyes", None)
    if isinstance(eyes, Eyes):
        eyes.on_look = on_look
    if not isinstance(found, OutsidePlanner):
        return agent
    from envs.charged import ChargedGround

    return ChargedGround(agent)


def check_variant(name: str) -> None:
    """Refuses a name that means no planner, and a variant that this project's planner would not take for each robot."""
    found = variant_named(name)
    if isinstance(found, TomlVariant):
        for robot in robot_names():
            _config(found, load_spec(robot))


def variant_content(variant: str) -> tuple[Path, dict[str, Any]]:
    """File and content of a variant, its base laid under it."""
    found = variant_named(variant)
    if isinstance(found, OutsidePlanner):
        raise ConfigError(f"variant {variant!r} is a planner from outside and has no TOML file; a variant's name would have worked")
    return found.path, found.content


def _config(variant: TomlVariant, spec: RobotSpec) -> PlannerConfig:
    from planner.config import planner_config

    try:
        return planner_config(variant.content, spec, name=variant.path.stem)
    except ConfigError as e:
        raise ConfigError(f"{variant.path}: {e}") from e


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
