"""The planner's contact-spring model held against the true robot's corner heights, as [SunSpiral2012] s5.1.2-5.1.3 did.

The springs stand in the commanded, unsagged robot; one constant for all feet is searched over the measured stances, up to that
of the stiffest tyre in them: legs and joints in series with a tyre only add compliance. Tyres stiffen, so it is one that
carries most. Corners are the points where the legs are attached; of T12 these lie on decks that flex in
truth.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from validate_runs import FOOT_RADIUS, LIFT, Rest

from athlete_twin.geometry.arrays import PerLeg
from athlete_twin.model.kinematics import GRAVITY, kinematics
from athlete_twin.model.spec import load_spec
from athlete_twin.model.stance import stance_wheels_in_hex
from planner.sag.identify import MeasuredStance, identify_stiffness, predict_heights

STEP = 250.0
"""between constants that the search tries [N/m]"""


@dataclass(frozen=True, eq=False, kw_only=True)
class SagFit:
    """How well one constant under every foot explains the measured corners."""

    stiffness: float
    """[N/m]"""
    errors: tuple[PerLeg, ...]
    """predicted less measured height, of every corner of every stance [m]"""
    bound: float = math.inf
    """where the search for it ended [N/m]; infinite when there was none"""

    @property
    def at_bound(self) -> bool:
        """Whether the search ended at its bound: a stiffer constant might have explained more."""
        return self.stiffness + STEP > self.bound

    @property
    def mean(self) -> float:
        """Mean absolute error [m]."""
        return float(np.abs(self.errors).mean())

    @property
    def largest(self) -> float:
        """Largest absolute error [m]."""
        return float(np.abs(self.errors).max())


def best_fit(robot: str, rests: Sequence[Rest]) -> SagFit:
    """The constant with the least mean error over the stances, found as the planner finds it."""
    spec = load_spec(robot)
    bound = stiffest_tyre(robot, rests)
    fit = identify_stiffness(
        [_stance(robot, rest) for rest in rests],
        upper=bound,
        lower=0.25 * spec.believed_foot_stiffness,
        step=STEP,
        lateral_ratio=spec.believed_lateral_ratio,
    )
    return replace(fit_with(robot, rests, fit.stiffness), bound=bound)


PRESSED = 1e-3
"""a wheel pressed in by less tells nothing of its tyre [m]"""


def stiffest_tyre(robot: str, rests: Sequence[Rest]) -> float:
    """Largest load over pressed-in depth of a wheel in the stances [N/m], as axle heights over level ground at z = 0 tell it."""
    spec = load_spec(robot)
    return max(
        float(np.max(rest.loads[on] * spec.mass * GRAVITY / (spec.wheel.radius - rest.axles[on, 2])))
        for rest in rests
        for on in (rest.supporting & (rest.loads > 0.0) & (spec.wheel.radius - rest.axles[:, 2] > PRESSED),)
        if on.any()
    )


def fit_with(robot: str, rests: Sequence[Rest], stiffness: float) -> SagFit:
    """Errors of a given constant [N/m]."""
    errors = tuple(predicted_corners(robot, rest, stiffness) - rest.corner_heights for rest in rests)
    return SagFit(stiffness=stiffness, errors=errors)


def predicted_corners(robot: str, rest: Rest, stiffness: float) -> PerLeg:
    """Corner heights that the springs predict for a stance [m]."""
    ratio = load_spec(robot).believed_lateral_ratio
    return predict_heights(_stance(robot, rest), stiffness_z=np.full(6, stiffness), lateral_ratio=ratio)


def _stance(robot: str, rest: Rest) -> MeasuredStance:
    spec = load_spec(robot)
    feet = stance_wheels_in_hex(spec, FOOT_RADIUS[robot])
    feet[:, 2] -= spec.wheel.radius
    lifts = np.where(rest.supporting, 0.0, LIFT)
    feet[:, 2] += lifts
    return MeasuredStance(
        feet_in_hex=feet,
        com_in_hex=kinematics(robot).com_in_hex(rest.commands),
        weight=spec.mass * GRAVITY,
        lifts=lifts,
        corners_in_hex=np.array(spec.hips_in_hex),
        heights=rest.corner_heights,
        origin_height=spec.chassis_height,
    )
