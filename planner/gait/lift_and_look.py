"""How high a leg goes after its lift-off so that cameras see what it hid, [SunSpiral2012] s5.2.1.

The lift-off of a step clears the ground by a hand, and the leg then still hides nearly all of the place it will step to
(`scripts/view_analysis.py`): the wheel goes on straight up.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from athlete_twin.errors import ConfigError
from athlete_twin.geometry.arrays import LegPath
from athlete_twin.model.kinematics import GRAVITY, Kinematics
from athlete_twin.model.reach import leg_ik
from planner.belief import Belief
from planner.gait.step_plan import StepPlan
from planner.motion.collision import LegCollision
from planner.stability.margin import support_margin

SPACING = 0.025
"""of way-points along the straight line [m]"""


@dataclass(frozen=True, kw_only=True)
class LookConfig:
    """How far out of the way a leg is lifted before its step is planned."""

    lift: float = 0.5
    """of the wheel over where it stood; less where the leg does not reach or would touch something [m]"""

    def __post_init__(self) -> None:
        if not 0.0 <= self.lift <= 2.0:
            raise ConfigError(f"a look lifts the wheel by {self.lift} m, must be within 0 to 2 m")


def raised_path(
    kin: Kinematics, plan: StepPlan, belief: Belief, collision: LegCollision, *, config: LookConfig, payload_kg: float
) -> LegPath:
    """Motor angles straight up from the lift-off's end, as far as the leg reaches and nothing is near, shape (k, dof) [rad].

    The first is the lift-off's end itself; one way-point alone means that the leg goes no higher.

    Args:
        kin: of the robot.
        plan: the step whose lift-off is done first; its first preview in the air is the lift-off's end.
        belief: the robot before the lift-off.
        collision: of the plan's leg, the chassis where it is believed during the swing.
        config: how high.
        payload_kg: on the deck.
    """
    leg, start = plan.leg, plan.preview_joints[1, plan.leg]
    up = -belief.gravity_in_hex() / GRAVITY
    stood, lifted = kin.leg_wheel(leg, belief.motors[leg]), kin.leg_wheel(leg, start)
    done = float(up @ (lifted.translation - stood.translation))
    heights = np.arange(SPACING, config.lift - done + 1e-9, SPACING)
    if len(heights) == 0:
        return np.asarray(start[None])
    axles = lifted.translation + heights[:, None] * up
    q, reached = leg_ik(kin.spec, leg, axles, last_link_in_hex=stood.rotation[:, 0])
    others = np.delete(belief.contacts_in_world, leg, axis=0)
    joints, path = belief.joints.copy(), [start]
    for row, reaches in zip(q, reached, strict=True):
        if not reaches or not collision.is_free_near_ground(row):
            break
        joints[leg] = row
        com = plan.world_from_hex_swing.apply(kin.com_in_hex(joints, payload_kg))
        if support_margin(com, others) < kin.spec.min_support_margin:
            break
        path.append(row)
    return np.array(path)
