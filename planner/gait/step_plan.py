"""One step, planned: everything that is needed to command it, to show it and to judge it afterwards."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

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

    def swayed_so_far(self, before: SE3, now: SE3) -> Vec3:
        """What it has displaced the chassis from its path by if it broke off, in world [m]: as much as it went of its way.

        Args:
            before: chassis in world as the shift began.
            now: where it stopped.
        """
        way = before.rotate(self.translation_in_hex)[:2]
        gone = (now.translation - before.translation)[:2]
        share = float(np.clip(gone @ way / max(way @ way, 1e-9), 0.0, 1.0)) if way @ way > 1e-4 else 0.0
        return np.asarray(share * before.rotate(self.sway_in_hex))

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
    companion: StepPlan | None = None
    """the step of the opposite leg, in the air together with this one; it lands second, and the shift is this plan's"""

    @property
    def parts(self) -> tuple[StepPlan, ...]:
        """The steps of all legs that it moves, in the order of their landing."""
        return (self,) if self.companion is None else (self, self.companion)

    @property
    def legs(self) -> tuple[int, ...]:
        """Indices of the legs that it moves, in the order of their landing."""
        return tuple(part.leg for part in self.parts)

    def of_leg(self, leg: int) -> StepPlan:
        """The part that moves a leg, for itself; the first where none does."""
        return replace(next((part for part in self.parts if part.leg == leg), self), companion=None)
