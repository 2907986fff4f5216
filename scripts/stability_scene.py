"""The ground and the stance that the stability map is measured and drawn on: a seeded rock field, the robot in its normal stance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from athlete_twin.geometry.arrays import Joints
from athlete_twin.geometry.grid import HeightGrid
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.kinematics import Kinematics
from athlete_twin.model.spec import load_spec
from athlete_twin.model.stance import regular_stance, stance_wheels_in_hex
from athlete_twin.world.scenario import load_scenario
from athlete_twin.world.terrain import build_terrain
from planner.footfall import FootfallConfig, FootfallMap, score_footfalls
from planner.motion.collision import CollisionConfig
from planner.stability.ground_map import GroundMapConfig
from planner.stability.stability_map import StabilityConfig

SIZES = {"sdm_b": (6.0, 0.05), "t12": (12.0, 0.10)}
"""of the map: its edge and a cell's [m]; T12 reaches farther"""
CLEAR_RADIUS = 0.45
"""round each wheel no rock lies [m], as in a trial"""
SIGMA = 0.01
"""of the heights, as fused stereo has it within reach [m]"""


@dataclass(frozen=True, eq=False, kw_only=True)
class StabilityScene:
    """What a map is made of."""

    kinematics: Kinematics
    joints: Joints
    world_from_hex: SE3
    terrain: HeightGrid
    footfalls: FootfallMap

    def config(self, *, collision: bool) -> GroundMapConfig:
        """The limits of the stability rule and of the joints."""
        return GroundMapConfig(
            stability=StabilityConfig(min_margin=self.kinematics.spec.min_support_margin),
            collision=CollisionConfig() if collision else None,
        )


def stability_scene(robot: str, seed: int) -> StabilityScene:
    """A robot standing in one rock field, its wheels on the ground."""
    spec = load_spec(robot)
    kin = Kinematics(spec)
    stance = stance_wheels_in_hex(spec)
    truth = build_terrain(load_scenario("rock_field"), seed, clear_xy=stance[:, :2], clear_radius=CLEAR_RADIUS).grid
    size, cell = SIZES[robot]
    centres = cell * (np.arange(round(size / cell)) + 0.5) - 0.5 * size
    xy = np.stack(np.meshgrid(centres, centres, indexing="ij"), axis=-1)
    terrain = HeightGrid(origin_x=float(centres[0]), origin_y=float(centres[0]), cell=cell, heights=truth.sample(xy))
    level = float(np.mean(truth.sample(stance[:, :2])))
    footfalls = score_footfalls(
        terrain, np.full(terrain.shape, SIGMA**2), wheel_radius=spec.wheel.radius, config=FootfallConfig()
    )
    return StabilityScene(
        kinematics=kin, joints=regular_stance(spec), terrain=terrain, footfalls=footfalls,
        world_from_hex=SE3.from_translation(np.array([0.0, 0.0, spec.chassis_height + level])),
    )  # fmt: skip
