"""What pose optimisation is asked for and what comes out: bounds, a chassis move before a lift, or a reasoned no."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from athlete_twin.errors import SagError
from athlete_twin.geometry.arrays import Joints, Vec3
from athlete_twin.geometry.se3 import SE3
from athlete_twin.messages import BodyMove
from athlete_twin.model.spec import LEGS
from planner.sag.sag_model import SagSolution


@dataclass(frozen=True, kw_only=True)
class PoseConfig:
    """How far the chassis may go to make a lift level."""

    max_shift: float = 0.10
    """sideways and lengthwise, towards even loads; zero to stay [m]"""
    max_rise: float = 0.35
    """of the commanded chassis over the wanted height: T12 with its full payload sinks 0.15 m and the lift adds half [m]"""
    max_tilt: float = 0.15
    """of the commanded chassis against the wanted attitude [rad]"""
    max_offset: float = 0.05
    """of a single wheel up or down; zero for a rigid move [m]"""
    min_load_fraction: float = 0.02
    """of the weight, left on each standing wheel: beyond the first millimetres of contact, where it might slip"""
    min_margin: float | None = None
    """support margin with the leg in the air, CPS margin before; the drawings' when None [m]"""

    def __post_init__(self) -> None:
        for name, limit in (("max_shift", 1.0), ("max_rise", 1.0), ("max_tilt", 0.5), ("max_offset", 0.5)):
            value = getattr(self, name)
            if not 0.0 <= value <= limit:
                raise SagError(f"{name} is {value}, must be within 0 to {limit}")
        if not 0.0 <= self.min_load_fraction < 1.0 / LEGS:
            raise SagError(f"min_load_fraction is {self.min_load_fraction}, must be within 0 to 1/{LEGS}")
        if self.min_margin is not None and not np.isfinite(self.min_margin):
            raise SagError(f"min_margin is {self.min_margin} m, must be finite, or None for the drawings'")


@dataclass(frozen=True, eq=False, kw_only=True)
class LiftPose:
    """A chassis move before a lift, and what the believed springs make of it."""

    leg: int
    """index 0 to 5"""
    move: BodyMove
    """with all wheels planted"""
    lift_in_hex: Vec3
    """axle of the leg in the hex frame after the move that clears its ground by what was asked [m]"""
    motors: Joints
    """angles after move and lift, shape (6, dof) [rad]"""
    standing: SagSolution
    """after the move, before the lift; in the unsagged hex frame after the move"""
    airborne: SagSolution
    """with the leg in the air; in the same frame"""
    sagged_from_wanted: SE3
    """what is left of the pose error while the leg is in the air"""
    peak_load: float
    """largest vertical load of a standing wheel [N]"""
    limited_by: tuple[str, ...]
    """what kept the loads from being more even, such as "shift of 0.10 m"; empty when nothing did"""
    rounds: int
    """of the iteration"""


@dataclass(frozen=True, kw_only=True)
class NoPose:
    """No pose makes the lift level within the bounds."""

    reason: str
    """the first check that failed, with value and limit"""
