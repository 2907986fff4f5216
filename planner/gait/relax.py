"""Shifts of planted wheels by which legs stop working against each other, and meet the next lift unstrained.

Place in the flow: belief (measured forces, stiffness) -> offsets that the chassis shift carries along.

[SunSpiral2012] s5.1.1: feet shall not fight. Position-controlled legs with stuck feet keep whatever stretch each landing left, and
weight alone drives a bent leg's wheel aside; the torques tell of it. When the next leg lifts, its neighbours take its load over,
and the ground answers what that drives aside too: beforehand their wheels are set so that the two cancel while the leg is in the air.
A wheel on which the ground pushes by F more than is wanted goes C F that way, C its leg's compliance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from athlete_twin.errors import ConfigError
from athlete_twin.geometry.arrays import Joints, PerLeg, Wheels
from athlete_twin.model.kinematics import Kinematics
from athlete_twin.model.spec import LEGS
from athlete_twin.model.statics import patches_in_hex
from planner.belief import Belief
from planner.sag.leg_compliance import held_response, patch_compliance


@dataclass(frozen=True, kw_only=True)
class RelaxConfig:
    """How much of the strain one shift takes back."""

    gain: float = 0.7
    """of the measured interaction forces; 0 leaves them"""
    anticipation: float = 1.0
    """of the horizontal forces that the next lift will bring; 0 for none"""
    max_offset: float = 0.12
    """of one wheel in one shift [m]"""

    def __post_init__(self) -> None:
        for name in ("gain", "anticipation"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ConfigError(f"{name} is {getattr(self, name)}, must be within 0 to 1")
        if not 0.0 <= self.max_offset <= 0.5:
            raise ConfigError(f"max_offset is {self.max_offset} m, must be within 0 to 0.5 m")


def relaxing_offsets(
    kin: Kinematics,
    belief: Belief,
    landed_joints: Joints,
    *,
    leg: int,
    next_leg: int | None,
    next_change: PerLeg,
    config: RelaxConfig,
) -> Wheels:
    """By which each axle moves during the shift, in hex, shape (6, 3) [m].

    Args:
        kin: of the drawings.
        belief: before the step.
        landed_joints: after it, shape (6, dof) [rad].
        leg: index 0 to 5 of the leg that steps; what its landing leaves is not measured yet, so that only what is coming counts.
        next_leg: that will lift next, left where it is; None when nobody knows.
        next_change: of the wheels' loads when it does, shape (6,) [N].
        config: how much.
    """
    gravity = belief.gravity_in_hex()
    compliance = patch_compliance(kin, landed_joints, belief.joint_stiffness, gravity)
    force = config.gain * belief.interaction
    force[leg] = 0.0
    standing = np.arange(LEGS) != next_leg
    if next_leg is not None and config.anticipation > 0.0:
        contacts = patches_in_hex(kin, landed_joints, gravity)
        coming = held_response(compliance, np.where(standing, next_change, 0.0), contacts, standing, gravity)
        force = force + config.anticipation * coming.forces
    offsets = np.einsum("nij,nj->ni", compliance, force)
    size = np.linalg.norm(offsets, axis=1, keepdims=True)
    return np.asarray(offsets * np.minimum(1.0, config.max_offset / np.maximum(size, 1e-12)))
