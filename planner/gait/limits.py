"""How far the regular gait can be stretched on even ground: the longest stride, the steepest slope, and what ends them.

[SunSpiral2012] s5.3.1: the step length is found by successive inverse-kinematics tests for a start and a direction; s5.3.4:
on slopes the level deck leaves the uphill legs no room and stretches the downhill ones. Here the whole cycle is tested
(`cycle.judge_cycle`): reach first, then the stability rule, then the joints. A limit is the last value, coming from the easy
side, up to which every test passed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from athlete_twin.errors import PlanningError
from athlete_twin.geometry.arrays import Vec2, Vec3
from athlete_twin.model.spec import RobotSpec
from planner.gait.cycle import CycleVerdict, gait_cycle, judge_cycle
from planner.stability.rigid_stance import Footing

STRIDE_STEP, STRIDE_DIGIT = 0.1, 0.005
"""between tested strides, and how closely the last is found [m]"""
SLOPE_STEP, SLOPE_DIGIT = np.deg2rad(2.0), np.deg2rad(0.1)
"""the same of slopes [rad]"""
STEEPEST = np.deg2rad(45.0)
"""tested [rad]"""
DECKS = ("level", "parallel")


@dataclass(frozen=True, eq=False, kw_only=True)
class Limit:
    """The last value that passed."""

    value: float
    """[m] or [rad]; NaN where not even the first passed"""
    ended_by: str
    """what refused the next one"""
    verdict: CycleVerdict | None
    """of the last that passed"""


def longest_stride(
    spec: RobotSpec,
    heading: Vec2,
    *,
    groups: Sequence[tuple[int, ...]] | None = None,
    foot_radius: float | None = None,
    chassis_height: float | None = None,
    footing: Footing | None = None,
    saturates: bool = True,
    payload_kg: float = 0.0,
) -> Limit:
    """The longest advance in a cycle [m].

    Args:
        spec: the drawings.
        heading: in the hex plane, of length 1.
        groups: legs that swing together; one after the other by default.
        foot_radius: of the regular places; the drawings' by default [m].
        chassis_height: the drawings' by default [m].
        footing: how the ground lies; flat by default.
        saturates: whether torque ends it too; else reach and the stability rule alone.
        payload_kg: [kg]
    """
    ground = Footing() if footing is None else footing

    def tried(stride: float) -> CycleVerdict:
        cycle = gait_cycle(
            spec, heading, stride=stride, groups=groups, foot_radius=foot_radius, chassis_height=chassis_height, footing=ground
        )
        return judge_cycle(cycle, payload_kg=payload_kg)

    return _last(spec, tried, 0.0, 4.0 * spec.foot_radius, STRIDE_STEP, STRIDE_DIGIT, saturates)


def steepest_slope(
    spec: RobotSpec,
    heading: Vec2,
    *,
    stride: float,
    deck: str,
    foot_radius: float | None = None,
    chassis_height: float | None = None,
    saturates: bool = True,
    payload_kg: float = 0.0,
) -> Limit:
    """The steepest even slope that the cycle climbs straight [rad].

    Args:
        spec: the drawings.
        heading: uphill, in the hex plane, of length 1.
        stride: advance in a cycle, along the ground [m].
        deck: "level" to gravity, or "parallel" to the ground.
        foot_radius: of the regular places; the drawings' by default [m].
        chassis_height: of the hex origin over the ground below it, along hex z; the drawings' by default [m].
        saturates: whether torque ends it too; else reach and the stability rule alone.
        payload_kg: [kg]
    """

    def tried(angle: float) -> CycleVerdict:
        cycle = gait_cycle(
            spec, heading, stride=stride, foot_radius=foot_radius, chassis_height=chassis_height,
            footing=footing_on(angle, heading, deck=deck),
        )  # fmt: skip
        return judge_cycle(cycle, payload_kg=payload_kg)

    return _last(spec, tried, 0.0, STEEPEST, SLOPE_STEP, SLOPE_DIGIT, saturates)


def footing_on(angle: float, uphill: Vec2, *, deck: str) -> Footing:
    """Ground that rises by an angle [rad] along a direction of the hex plane, under a deck "level" or "parallel" to it."""
    if deck not in DECKS:
        raise PlanningError(f"deck {deck!r} is not one of {', '.join(DECKS)}")
    if not (np.isfinite(angle) and abs(angle) < 0.5 * np.pi):
        raise PlanningError(f"slope is {np.rad2deg(angle):.1f} deg, must be within 90")
    tilted: Vec3 = np.append(-np.sin(angle) * np.asarray(uphill, dtype=float), np.cos(angle))
    # Under a level deck the ground's normal leans downhill; to a deck that lies on the slope, gravity's back leans uphill.
    return Footing(normal=tilted) if deck == "level" else Footing(up=tilted * np.array([-1.0, -1.0, 1.0]))


def _last(
    spec: RobotSpec, tried: Callable[[float], CycleVerdict], first: float, end: float, step: float, digit: float, saturates: bool
) -> Limit:
    """Steps from the first value on until one is refused, then halves the last step."""

    def judged(value: float) -> tuple[CycleVerdict, str]:
        verdict = tried(value)
        refusal = verdict.refusal(spec)
        saturated_alone = bool(refusal) and not verdict.blocked(spec)
        return verdict, "" if saturated_alone and not saturates else refusal

    verdict, refusal = judged(first)
    if refusal:
        return Limit(value=float("nan"), ended_by=refusal, verdict=None)
    low, high = first, first
    while not refusal:
        low, passed = high, verdict
        if high >= end:
            return Limit(value=low, ended_by="nothing up to there", verdict=passed)
        high = min(high + step, end)
        verdict, refusal = judged(high)
    while high - low > digit:
        middle = 0.5 * (low + high)
        verdict, why = judged(middle)
        if why:
            high, refusal = middle, why
        else:
            low, passed = middle, verdict
    return Limit(value=low, ended_by=refusal, verdict=passed)
