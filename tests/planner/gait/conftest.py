"""A robot that stands on flat ground as the ground on Earth believes it, and maps with a rock where a test wants one."""

from __future__ import annotations

from functools import lru_cache
from types import SimpleNamespace

import numpy as np
import pytest

from athlete_twin.assets import named_toml, read_toml
from athlete_twin.geometry.grid import HeightGrid
from athlete_twin.messages import Telemetry
from athlete_twin.mock import MockAthlete
from athlete_twin.model.kinematics import kinematics
from athlete_twin.model.spec import load_spec
from planner.belief import BeliefFilter
from planner.config import planner_config
from planner.footfall import score_footfalls
from planner.gait.step_search import Ground
from planner.sag.sag_model import FootSprings

HALF = 4.5
CELL = 0.05


def heights(rock: tuple[float, float, float, float] | None = None) -> HeightGrid:
    """Flat ground around the robot; a rock is x, y, radius and height [m]."""
    n = 2 * round(HALF / CELL) + 1
    x = -HALF + CELL * np.arange(n)
    ground = np.zeros((n, n))
    if rock is not None:
        away = np.hypot(x[:, None] - rock[0], x[None, :] - rock[1]) / rock[2]
        ground = rock[3] * np.sqrt(np.maximum(1.0 - away**2, 0.0))
    return HeightGrid(origin_x=-HALF, origin_y=-HALF, cell=CELL, heights=ground)


@lru_cache(maxsize=4)
def standing(robot: str) -> SimpleNamespace:
    """Kinematics, springs, settings of the plain variant, and the belief after the first telemetry."""
    spec, kin = load_spec(robot), kinematics(robot)
    config, springs = planner_config(read_toml(named_toml("variants", "blind")), spec, name="blind"), FootSprings.from_spec(spec)
    (hello,) = MockAthlete(spec).advance(1.0)
    assert isinstance(hello, Telemetry)
    belief = BeliefFilter(kin, springs, payload_kg=0.0, config=config.wheel_fit).update(hello)
    return SimpleNamespace(spec=spec, kin=kin, springs=springs, config=config, belief=belief)


@pytest.fixture(params=["sdm_b", "t12"])
def robot(request) -> SimpleNamespace:
    return standing(request.param)


@pytest.fixture
def on():
    """Makes the `Ground` of a map that is known all over."""

    def make(robot: SimpleNamespace, grid: HeightGrid) -> Ground:
        known = np.zeros(grid.shape)
        footfalls = score_footfalls(grid, known, wheel_radius=robot.spec.wheel.radius, config=robot.config.footfall)
        return Ground(heights=grid, filled=grid, cautious=grid, footfalls=footfalls)

    return make


@pytest.fixture
def field():
    """Makes the map."""
    return heights
