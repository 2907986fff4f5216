"""What the ground remembers between a fault and the step that ends it, and what it does differently the next time.

A wheel that kept its load is lifted higher; one that found no ground goes further down; one that struck something in
the air goes back the way it came, pictures are taken, and it steps elsewhere; after any other fault it steps elsewhere.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from athlete_twin.geometry.arrays import LegJoints, Points2, Vec2
from athlete_twin.messages import Fault, Telemetry
from athlete_twin.model.kinematics import GRAVITY, Kinematics
from planner.gait.step_plan import StepPlan

RETRY_LIFT = 0.10
"""added to a lift that did not break contact [m]"""
MAX_EXTRA_LIFT = 0.30
"""[m]"""
MAX_ATTEMPTS = 6
"""faults at one and the same step before the ground gives up"""
LOWERINGS = 2
"""further descents after a wheel found no ground, before it steps elsewhere"""
STANDING_LOAD = 150.0
"""after a fault, a wheel whose torques speak of more than this stands [N]"""


@dataclass(kw_only=True)
class Recovery:
    """State of one step that met faults; `reset` when it is done."""

    attempts: int = 0
    extra_lift: float = 0.0
    """[m]"""
    lowerings: int = 0
    retreat: Float[np.ndarray, "n dof"] | None = None
    """the way back to the lift-off way-point after a wheel struck something, shape (n, dof) [rad]"""
    _refused: list[Vec2] = field(default_factory=list)

    @property
    def exhausted(self) -> bool:
        """Whether the ground gives up."""
        return self.attempts >= MAX_ATTEMPTS

    @property
    def lowers(self) -> bool:
        """Whether the wheel shall come further down where it is."""
        return 0 < self.lowerings <= LOWERINGS

    @property
    def refused_xy(self) -> Points2:
        """Footfalls not to be tried again, shape (n, 2) [m]."""
        return np.array(self._refused).reshape(-1, 2)

    def refuse(self, plan: StepPlan) -> None:
        """Step elsewhere the next time."""
        self._refused += [part.footfall_in_world[:2] for part in plan.parts]

    def reject(self, plan: StepPlan) -> None:
        """The operator does not want it: step elsewhere, and where a wheel would go further down, not here."""
        self.refuse(plan)
        if self.lowerings:
            self.lowerings = LOWERINGS + 1

    def fault(self, fault: Fault, plan: StepPlan, leg_motors: LegJoints) -> None:
        """Take note of a fault of a step, the leg's motors standing at `leg_motors` [rad]."""
        self.attempts += 1
        if fault.code == "contact_not_broken":
            self.extra_lift = min(self.extra_lift + RETRY_LIFT, MAX_EXTRA_LIFT)
        elif fault.code == "no_contact":
            self.lowerings += 1
            if self.lowerings > LOWERINGS:
                self.refuse(plan)
        else:
            self.refuse(plan)
        if fault.code == "swing_contact":
            self.retreat = way_back(plan.swing, leg_motors)

    def reset(self) -> None:
        """The step is done."""
        self.attempts, self.extra_lift, self.lowerings, self.retreat, self._refused = 0, 0.0, 0, None, []


def way_back(waypoints: Float[np.ndarray, "k dof"], leg_motors: LegJoints) -> Float[np.ndarray, "n dof"]:
    """Way-points back to the first from where a leg stopped on its way through them, shape (n, dof) [rad].

    What has been passed is known to be free: no map is asked.
    """
    if len(waypoints) == 1:
        return waypoints.copy()
    a, span = waypoints[:-1], np.diff(waypoints, axis=0)
    along = np.einsum("ij,ij->i", leg_motors - a, span) / np.maximum(np.einsum("ij,ij->i", span, span), 1e-12)
    nearest = a + np.clip(along, 0.0, 1.0)[:, None] * span
    passed = int(np.argmin(np.linalg.norm(leg_motors - nearest, axis=1)))
    return waypoints[passed::-1].copy()


def stands(kin: Kinematics, leg: int, telemetry: Telemetry) -> bool:
    """After a fault nobody knows whether the wheel stands: its torques do."""
    roll, pitch = float(telemetry.attitude_rpy[0]), float(telemetry.attitude_rpy[1])
    gravity = GRAVITY * np.array([np.sin(pitch), -np.sin(roll) * np.cos(pitch), -np.cos(roll) * np.cos(pitch)])
    force = kin.ground_force(leg, telemetry.joints, telemetry.torques[leg], gravity)
    return float(-force @ gravity / GRAVITY) > STANDING_LOAD
