"""One cycle of the regular gait on even ground: who swings when, where all wheels stand meanwhile, and what it asks of the robot.

[SunSpiral2012] s5.3.1: a discontinuous gait, steps with the chassis standing, then a shift with all wheels down; periodic from
the second cycle on, and this is that period. Several legs may swing at once. The chassis may be displaced in each phase: the
footfalls stay ([SunSpiral2012] s5.3.2).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from athlete_twin.errors import PlanningError
from athlete_twin.geometry.arrays import Vec2
from athlete_twin.model.spec import LEGS, RobotSpec
from planner.gait.skeleton import reverse_wave
from planner.stability.rigid_stance import FLAT, Footing, Stances, rigid_stances

ALL_DOWN = np.ones(LEGS, dtype=bool)
SWING = ((0.0, 0.0), (0.0, 1.0), (0.5, 1.0), (1.0, 1.0), (1.0, 0.0), (1.0, -0.15))
"""where a swinging wheel is judged: how far along its step, and how much of the lift; barely off the ground before and after,
and last below it, where a guarded descent still feels for ground: 5 cm on both robots"""
SHIFT = (0.25, 0.5, 0.75)
"""where a shift of the chassis is judged besides its ends"""
LIFT = 0.2
"""of a swinging wheel over its footfalls, over the chassis height: 0.35 m on both robots, as sag needs it"""


@dataclass(frozen=True, eq=False, kw_only=True)
class GaitCycle:
    """A period of the gait, in the axes of the chassis, whose attitude does not change."""

    spec: RobotSpec
    footing: Footing
    groups: tuple[tuple[int, ...], ...]
    """indices of the legs that swing in each of k phases"""
    chassis: np.ndarray
    """hex origin in each phase when it does not sway, shape (k, 3) [m]"""
    start: np.ndarray
    """axles as the phase begins, shape (k, 6, 3) [m]"""
    goal: np.ndarray
    """and as it ends, shape (k, 6, 3) [m]"""
    advance: np.ndarray
    """of everything in one cycle, shape (3,) [m]"""
    lift: float
    """of swinging wheels [m]"""

    @property
    def phases(self) -> int:
        """How many."""
        return len(self.groups)

    def standing(self, phase: int) -> np.ndarray:
        """Which wheels carry while the phase's legs swing, shape (6,)."""
        return ~np.isin(np.arange(LEGS), self.groups[phase])

    def swing_axles(self, phase: int) -> np.ndarray:
        """Axles at the judged moments of a phase's swing, shape (m, 6, 3) [m]."""
        swinging = ~self.standing(phase)
        out = np.repeat(self.start[phase][None], len(SWING), axis=0)
        for row, (along, up) in zip(out, SWING, strict=True):
            step = along * (self.goal[phase] - self.start[phase]) + up * self.lift * self.footing.up
            row[swinging] += step[swinging]
        return out


def gait_cycle(
    spec: RobotSpec,
    heading: Vec2,
    *,
    stride: float,
    groups: Sequence[tuple[int, ...]] | None = None,
    foot_radius: float | None = None,
    foot_plan: np.ndarray | None = None,
    chassis_height: float | None = None,
    footing: Footing = FLAT,
    lift: float | None = None,
) -> GaitCycle:
    """The periodic cycle along a heading.

    A foot steps to half a stride ahead of its regular place; after each phase the chassis goes on by a sixth of the stride for
    every leg that has stepped.

    Args:
        spec: the drawings.
        heading: in the hex plane, of length 1.
        stride: advance in a cycle, along the ground [m].
        groups: legs that swing together; by default one after the other, in the reverse wave.
        foot_radius: of the regular places, in the hex plane; the drawings' by default [m].
        foot_plan: the regular places in the hex plane, shape (6, 2), instead of that circle [m].
        chassis_height: of the hex origin over the ground below it, along hex z; the drawings' by default [m].
        footing: how the ground lies.
        lift: of a swinging wheel over its footfalls [m].
    """
    order = tuple((leg,) for leg in reverse_wave(spec, heading)) if groups is None else tuple(groups)
    if sorted(leg for group in order for leg in group) != list(range(LEGS)):
        raise PlanningError(f"groups {order} must hold each leg 0 to {LEGS - 1} once")
    if not abs(float(np.linalg.norm(heading)) - 1.0) < 1e-6:
        raise PlanningError(f"heading {heading} has length {np.linalg.norm(heading):g}, must be 1")
    if not (np.isfinite(stride) and stride >= 0.0):
        raise PlanningError(f"stride is {stride} m, must be 0 or more")
    radius = spec.foot_radius if foot_radius is None else foot_radius
    height = spec.chassis_height if chassis_height is None else chassis_height
    slope = -footing.normal[:2] / footing.normal[2]
    along = np.append(heading, slope @ heading)
    advance = stride * along / np.linalg.norm(along)
    circle = radius * np.column_stack([np.cos(spec.foot_azimuths), np.sin(spec.foot_azimuths)])
    plan = circle if foot_plan is None else np.asarray(foot_plan, dtype=float)
    places = np.column_stack([plan, plan @ slope]) + spec.wheel.radius * footing.normal
    gone = np.cumsum([0] + [len(group) for group in order]) / LEGS
    # A leg's footfall during a cycle: behind before its turn, one stride further after it.
    behind = np.zeros((LEGS, 3))
    for done, group in zip(gone, order, strict=False):
        for leg in group:
            behind[leg] = places[leg] + (done - 0.5) * advance
    start, goal, now = [], [], behind.copy()
    for group in order:
        start.append(now.copy())
        now[list(group)] += advance
        goal.append(now.copy())
    chassis = gone[:-1, None] * advance + np.array([0.0, 0.0, height])
    return GaitCycle(
        spec=spec, footing=footing, groups=order, chassis=chassis, start=np.array(start), goal=np.array(goal),
        advance=advance, lift=LIFT * spec.chassis_height if lift is None else lift,
    )  # fmt: skip


@dataclass(frozen=True, eq=False, kw_only=True)
class CycleVerdict:
    """What a cycle asks of the robot, moment by moment in their order."""

    phase: np.ndarray
    """index of each moment, shape (m,)"""
    swinging: np.ndarray
    """whether legs are in the air, shape (m,)"""
    fraction: np.ndarray
    """largest joint torque over its limit, shape (m,); infinite where a leg does not reach or the ground would have to pull"""
    margin: np.ndarray
    """plain support margin, shape (m,) [m]"""
    cps_margin: np.ndarray
    """to the conservative polygon, shape (m,) [m]"""
    reaches: np.ndarray
    """by leg, shape (m, 6)"""

    @property
    def peak(self) -> float:
        """Largest joint torque over its limit in the cycle."""
        return float(self.fraction.max())

    @property
    def margin_to_saturation(self) -> float:
        """What is left of the limit at the worst moment."""
        return 1.0 - self.peak

    @property
    def swing_margin(self) -> float:
        """Least support margin while legs swing [m]."""
        return float(self.margin[self.swinging].min())

    @property
    def standing_cps_margin(self) -> float:
        """Least CPS margin with all wheels down [m]."""
        return float(self.cps_margin[~self.swinging].min())

    def phase_peaks(self) -> np.ndarray:
        """Largest fraction while the legs of each phase swing, shape (k,)."""
        count = int(self.phase.max()) + 1
        return np.array([self.fraction[self.swinging & (self.phase == k)].max() for k in range(count)])

    def blocked(self, spec: RobotSpec) -> str:
        """What forbids the cycle whatever the joints can hold: reach, the stability rule, ground that would have to pull."""
        if not self.reaches.all():
            moment, leg = np.argwhere(~self.reaches)[0]
            return f"leg {leg + 1} does not reach in phase {self.phase[moment] + 1}"
        least = spec.min_support_margin
        if self.swing_margin < least:
            return f"support margin {self.swing_margin:.3f} m is below {least:.2f} m while legs swing"
        if self.standing_cps_margin < least:
            return f"CPS margin {self.standing_cps_margin:.3f} m is below {least:.2f} m with all wheels down"
        if not np.isfinite(self.fraction).all():
            moment = int(np.argmin(np.isfinite(self.fraction)))
            return f"zero interaction would have the ground pull a wheel in phase {self.phase[moment] + 1}"
        return ""

    def refusal(self, spec: RobotSpec) -> str:
        """Why the robot may not walk like this; empty where it may: `blocked`, or a joint is asked for too much."""
        blocked = self.blocked(spec)
        if blocked or self.peak <= 1.0:
            return blocked
        return f"a joint is asked for {100.0 * self.peak:.0f} % of its limit"


def judge_cycle(cycle: GaitCycle, displacements: np.ndarray | None = None, *, payload_kg: float = 0.0) -> CycleVerdict:
    """Judge a cycle, the chassis displaced in each phase by (k, 3) [m]; by nothing when None."""
    places = cycle.chassis if displacements is None else cycle.chassis + displacements
    return _judged([cycle], [places], payload_kg)[0]


def judge_cycles(cycles: Sequence[GaitCycle], *, payload_kg: float = 0.0) -> list[CycleVerdict]:
    """Judge cycles that differ in where feet and chassis are; robot, footing and groups are those of the first: many in one go."""
    for cycle in cycles[1:]:
        if cycle.spec is not cycles[0].spec or cycle.footing is not cycles[0].footing or cycle.groups != cycles[0].groups:
            raise PlanningError("cycles that are judged together must share robot, footing and groups")
    return _judged(cycles, [cycle.chassis for cycle in cycles], payload_kg) if cycles else []


def _judged(cycles: Sequence[GaitCycle], places: Sequence[np.ndarray], payload_kg: float) -> list[CycleVerdict]:
    """Verdicts on n cycles, the chassis of each at (k, 3)."""
    n, kinds = len(cycles), cycles[0]
    following = [np.concatenate([at[1:], at[:1] + cycle.advance]) for cycle, at in zip(cycles, places, strict=True)]
    phase, swinging, parts = [], [], []
    for k in range(kinds.phases):
        swing = [cycle.swing_axles(k) - at[k] for cycle, at in zip(cycles, places, strict=True)]
        before = [(cycle.start[k] - at[k])[None] for cycle, at in zip(cycles, places, strict=True)]
        shift = []
        for cycle, at, then in zip(cycles, places, following, strict=True):
            path = at[k] + np.array([0.0, *SHIFT, 1.0])[:, None] * (then[k] - at[k])
            shift.append(cycle.goal[k][None] - path[:, None])
        for axles, standing in ((before, ALL_DOWN), (swing, kinds.standing(k)), (shift, ALL_DOWN)):
            stances = rigid_stances(
                kinds.spec, np.concatenate(axles), standing=standing, footing=kinds.footing, payload_kg=payload_kg
            )
            moments = len(axles[0])
            phase += [k] * moments
            swinging += [not standing.all()] * moments
            parts.append([value.reshape(n, moments, *value.shape[1:]) for value in _values(stances)])
    fraction, margin, cps_margin, reaches = (np.concatenate(column, axis=1) for column in zip(*parts, strict=True))
    return [
        CycleVerdict(
            phase=np.array(phase), swinging=np.array(swinging), fraction=fraction[i], margin=margin[i], cps_margin=cps_margin[i],
            reaches=reaches[i],
        )
        for i in range(n)
    ]  # fmt: skip


def _values(stances: Stances) -> tuple[np.ndarray, ...]:
    return stances.peak, stances.margin, stances.cps_margin, stances.reaches
