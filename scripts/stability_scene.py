"""The ground and the stance that the stability map is measured and drawn on: a seeded rock field, the robot in its normal stance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from athlete_twin.errors import SupportError
from athlete_twin.geometry.arrays import Joints, Wheels
from athlete_twin.geometry.grid import HeightGrid
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.kinematics import Kinematics
from athlete_twin.model.reach import leg_ik
from athlete_twin.model.spec import LEGS, RobotSpec, load_spec
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

    @property
    def tilt_deg(self) -> float:
        """Of the chassis from level, roll and pitch together [deg]."""
        up = self.world_from_hex.rotate(np.array([0.0, 0.0, 1.0]))
        return float(np.rad2deg(np.arctan2(np.hypot(up[0], up[1]), up[2])))

    def config(self, *, collision: bool) -> GroundMapConfig:
        """The limits of the stability rule and of the joints."""
        return GroundMapConfig(
            stability=StabilityConfig(min_margin=self.kinematics.spec.min_support_margin),
            collision=CollisionConfig() if collision else None,
        )


def stability_scene(robot: str, seed: int, *, roll_deg: float = 0.0, pitch_deg: float = 0.0) -> StabilityScene:
    """A robot standing in one rock field, its wheels on the ground: in the normal stance, or where that stands on a tilted chassis."""
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
    place = np.array([0.0, 0.0, spec.chassis_height + level])
    pose = SE3.from_rpy(np.deg2rad(roll_deg), np.deg2rad(pitch_deg), 0.0, place)
    axles = SE3.from_translation(place).apply(stance)
    joints = regular_stance(spec) if roll_deg == pitch_deg == 0.0 else _standing(spec, pose, axles)
    return StabilityScene(kinematics=kin, joints=joints, terrain=terrain, footfalls=footfalls, world_from_hex=pose)


def _standing(spec: RobotSpec, world_from_hex: SE3, axles: Wheels) -> Joints:
    """Joints that put all axles at their places in world, the last links as plumb as the legs' planes allow."""
    hex_from_world = world_from_hex.inverse()
    down = hex_from_world.rotate(np.array([0.0, 0.0, -1.0]))
    joints = np.empty((LEGS, spec.dof))
    for leg, axle in enumerate(hex_from_world.apply(axles)):
        angles, reached = leg_ik(spec, leg, axle[None], last_link_in_hex=down)
        if not reached[0]:
            raise SupportError(f"leg {leg + 1} of {spec.name} does not reach its place on a chassis tilted so far; tilt it less")
        joints[leg] = angles[0]
    return joints
