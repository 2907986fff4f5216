"""The skeleton of the gait: which leg steps next, and where its wheel would go on open ground.

[SunSpiral2012] s5.3.1: a discontinuous gait; feet step from front to rear, the left side first (reverse wave), and the
chassis shifts with all wheels down. Here it shifts after every step by a sixth of the stride, so on open ground steps
and shifts are alike from the second cycle on. A foot steps to half a stride ahead of its regular place: by its next
turn the chassis has carried it half a stride behind.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from athlete_twin.errors import ConfigError
from athlete_twin.geometry.arrays import Points2, Vec2
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.spec import LEGS, RobotSpec
from athlete_twin.model.stance import stance_wheels_in_hex

GAITS = ("reverse_wave", "single_steps")
ON_AXIS = 1e-3
"""a hip this close to the line of travel counts as left, robot facts 12a [m]"""


@dataclass(frozen=True, kw_only=True)
class GaitConfig:
    """How the robot strides."""

    method: str = "reverse_wave"
    stride_fraction: float = 1.0
    """of the drawings' stride"""
    arrival_distance: float = 0.12
    """from the goal at which the ground declares arrival; truth counts 0.30 m [m]"""
    min_step: float = 0.05
    """a footfall nearer to the wheel's present place is no step [m]"""

    def __post_init__(self) -> None:
        if self.method not in GAITS:
            raise ConfigError(f"gait {self.method!r} is not one of {', '.join(GAITS)}")
        if not 0.1 <= self.stride_fraction <= 1.5:
            raise ConfigError(f"stride_fraction is {self.stride_fraction}, must be within 0.1 to 1.5")


def reverse_wave(spec: RobotSpec, heading_in_hex: Vec2) -> tuple[int, ...]:
    """Leg indices in the order of stepping: front to rear, left side first."""
    along = spec.hips_in_hex[:, :2] @ heading_in_hex
    left = spec.hips_in_hex[:, :2] @ np.array([-heading_in_hex[1], heading_in_hex[0]])
    side = left > -ON_AXIS
    return tuple(sorted(range(LEGS), key=lambda leg: (not side[leg], -along[leg])))


def regular_places(spec: RobotSpec, world_from_hex: SE3) -> Points2:
    """Where the wheels of the regular stance would stand below this chassis, shape (6, 2) [m]."""
    yaw = float(np.arctan2(world_from_hex.rotation[1, 0], world_from_hex.rotation[0, 0]))
    c, s = np.cos(yaw), np.sin(yaw)
    wheels = stance_wheels_in_hex(spec)[:, :2]
    return np.asarray(world_from_hex.translation[:2] + wheels @ np.array([[c, s], [-s, c]]))


def stride(spec: RobotSpec, config: GaitConfig) -> float:
    """Advance of the chassis in one cycle on open ground [m]."""
    return spec.stride * config.stride_fraction


def shift_per_step(spec: RobotSpec, config: GaitConfig, *, remaining: float, behind: float) -> float:
    """Advance of the chassis after one step [m].

    Args:
        spec: the drawings.
        config: of the gait.
        remaining: distance to the goal [m].
        behind: what earlier shifts were cut short by; at most half a shift of it is made up for at a time [m].
    """
    regular = stride(spec, config) / LEGS
    return min(regular + min(behind, 0.5 * regular), remaining)


def nominal_footfall(
    spec: RobotSpec, config: GaitConfig, *, leg: int, world_from_hex: SE3, heading: Vec2, remaining: float
) -> Vec2:
    """Where a leg would step on open ground [m]; towards the goal no further than the chassis still has to go."""
    ahead = min(0.5 * stride(spec, config), remaining)
    return np.asarray(regular_places(spec, world_from_hex)[leg] + ahead * heading)
