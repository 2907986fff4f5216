"""One step, planned: everything that is needed to command it, to show it and to judge it afterwards."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from athlete_twin.geometry.arrays import LegPath, Vec3, Wheels
from athlete_twin.geometry.se3 import SE3


@dataclass(frozen=True, eq=False, kw_only=True)
class BodyShift:
    """Where the chassis goes once the wheel is down, in the hex frame before the shift."""

    translation_in_hex: Vec3
    """[m]"""
    rotvec_in_hex: Vec3
    """[rad]"""
    wheel_offsets_in_hex: Wheels
    """by which each axle moves meanwhile, so that legs stop working against each other, shape (6, 3) [m]"""
    fraction: float
    """of the wanted shift that reach, stability and terrain allow"""
    cut_by: str
    """what forbade the whole of it, height and attitude included; empty when nothing did"""
    sway_in_hex: Vec3 = field(default_factory=lambda: np.zeros(3))
    """the part of the translation that displaces the chassis from its straight path, or brings it back [m]"""

    @staticmethod
    def none() -> BodyShift:
        """The chassis stays."""
        still = np.zeros(3)
        return BodyShift(
            translation_in_hex=still, rotvec_in_hex=still, wheel_offsets_in_hex=np.zeros((6, 3)), fraction=0.0, cut_by=""
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class StepPlan:
    """A step of one leg and the shift after it. Motor angles and unsagged wheel places, as the executive takes them."""

    leg: int
    """index 0 to 5"""
    footfall_in_world: Vec3
    """believed contact point [m]"""
    lift_in_hex: Vec3 | None
    """axle after lift-off; None when the leg is in the air already [m]"""
    swing: LegPath
    """way-points from above lift-off to above the footfall, shape (k, dof) [rad]"""
    swing_corner_tolerance: float
    """by which the executive may cut their corners [rad]"""
    swing_time: float
    """that the executive takes for them, from rest to rest [s]"""
    descent_in_hex: Vec3
    """lowest axle position the guarded descent may go to [m]"""
    descent_guard: str
    """"contact": the descent ends where the wheel carries its load; "place": it ends at `descent_in_hex"""
    reload: float
    """how far past its first touch the wheel has to go down until it carries its share, as the sag method says [m]"""
    contact_load: float
    """vertical load at which the descent ends [N]"""
    shift: BodyShift
    world_from_hex_swing: SE3
    """believed chassis while the leg is in the air"""
    world_from_leg_swing: SE3
    """hex frame of what carries the leg meanwhile: the chassis, or the leg's deck twisted on its dock"""
    preview_joints: np.ndarray
    """shape (k, 6, dof) [rad]"""
    preview_world_from_hex: tuple[SE3, ...]
    lift_clearance: float
    """of the wheel above the ground after lift-off, sag taken off [m]"""
    swing_margin: float
    """plain support margin while the leg is in the air [m]"""
    landed_margin: float
    """CPS margin with the wheel down [m]"""
    sag: float
    """by which the chassis drops at its origin or turns at a hip while the leg is in the air, the larger [m]"""
    peak_torque_fraction: float
    """believed, while the leg is in the air"""
    planner_checks: int
    """collision checks spent on the path"""
