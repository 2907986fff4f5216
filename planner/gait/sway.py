"""Sway gait: where the chassis should be in each phase of a cycle so that the joints keep the most margin to saturation.

[SunSpiral2012] s5.3.2: the chassis is displaced in three dimensions, the footfalls stay, loads by zero interaction. With the
footfalls given, what a swing asks of the joints depends on that phase's displacement alone: three numbers, found on a grid that
closes in on the best place, phase by phase. The joints' largest fraction is a maximum of smooth functions, with creases that
gradients do not like and grids do not mind. Then the way between the phases is pulled straight, as far as the margin gained
allows. The shifts between phases are judged too: reach, torques and the stability rule with all wheels down.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from athlete_twin.errors import PlanningError
from athlete_twin.geometry.arrays import Vec2, Vec3
from athlete_twin.model.spec import RobotSpec
from planner.gait.cycle import ALL_DOWN, CycleVerdict, GaitCycle, gait_cycle, judge_cycle
from planner.stability.rigid_stance import rigid_stances

TIE = 1e-6
"""fractions within this of the best count as equal; the smaller displacement is taken"""


@dataclass(frozen=True, kw_only=True)
class SwayConfig:
    """How far to sway, and how finely to search."""

    span: float = 0.35
    """largest displacement along each axis, over the chassis height"""
    points: int = 7
    """of the grid along each axis; odd, so that its middle is the best so far"""
    shrink: float = 0.55
    """of the grid from round to round"""
    resolution: float = 0.001
    """of the search: it ends when grid points are closer [m]"""
    slack: float = 0.01
    """fraction of the limits that an easy phase may give away for a shorter way; no phase goes beyond the worst one's best"""
    sweeps: int = 40
    """over all phases, pulling the way straight"""

    def __post_init__(self) -> None:
        if not (0.0 < self.span < 1.0 and 0.0 < self.shrink < 1.0 and self.resolution > 0.0 and self.slack >= 0.0):
            raise PlanningError("span and shrink must be within 0 to 1, resolution positive, slack not negative")
        if self.points < 3 or self.points % 2 == 0 or self.sweeps < 0:
            raise PlanningError(f"points is {self.points} and sweeps {self.sweeps}, need an odd number from 3 and 0 or more")


@dataclass(frozen=True, eq=False, kw_only=True)
class SwayGait:
    """A cycle with its displacements, and what both gaits ask of the robot."""

    cycle: GaitCycle
    displacements: np.ndarray
    """of the chassis in each phase, shape (k, 3), in its axes [m]"""
    reference: CycleVerdict
    """without displacements"""
    sway: CycleVerdict

    @property
    def gain(self) -> float:
        """By how much the least margin to saturation grows, over the reference's; 0.2 is 20 % more."""
        return self.sway.margin_to_saturation / self.reference.margin_to_saturation - 1.0


@dataclass(frozen=True, kw_only=True)
class NoSway:
    """No displacements let the robot walk this cycle."""

    reason: str


def sway_gait(cycle: GaitCycle, config: SwayConfig | None = None, *, payload_kg: float = 0.0) -> SwayGait | NoSway:
    """The displacements that leave the most margin to saturation, or why there are none."""
    config = SwayConfig() if config is None else config
    best = [_best_place(cycle, k, config, payload_kg) for k in range(cycle.phases)]
    lost = [k + 1 for k, (_, fraction) in enumerate(best) if not np.isfinite(fraction)]
    if lost:
        least = cycle.spec.min_support_margin
        reason = f"no place of the chassis in phase {lost[0]} has all legs reach and a support margin of {least:.2f} m"
        return NoSway(reason=reason)
    places, fractions = np.array([place for place, _ in best]), np.array([fraction for _, fraction in best])
    allowed = np.minimum(fractions + config.slack, fractions.max())
    smooth = _pulled_straight(cycle, places, allowed, config, payload_kg)
    for displacements in (smooth, places):
        verdict = judge_cycle(cycle, displacements, payload_kg=payload_kg)
        refusal = verdict.refusal(cycle.spec)
        if not refusal:
            reference = judge_cycle(cycle, payload_kg=payload_kg)
            return SwayGait(cycle=cycle, displacements=displacements, reference=reference, sway=verdict)
    return NoSway(reason=f"on the way between phases: {refusal}")


def phase_fractions(cycle: GaitCycle, phase: int, displacements: np.ndarray, *, payload_kg: float = 0.0) -> np.ndarray:
    """Largest torque fraction of one phase for n displacements (n, 3), shape (n,); infinite where the phase cannot be.

    A phase is its swing and the stances before and after it; it cannot be where a leg does not reach, the ground would have to
    pull, or the stability rule forbids it.
    """
    least, n = cycle.spec.min_support_margin, len(displacements)
    out = np.zeros(n)
    swing = (cycle.swing_axles(phase), cycle.standing(phase))
    ends = (np.array([cycle.start[phase], cycle.goal[phase]]), ALL_DOWN)
    for axles, standing in (swing, ends):
        in_hex = axles - (cycle.chassis[phase] + displacements)[:, None, None]
        stances = rigid_stances(
            cycle.spec, in_hex.reshape(-1, *axles.shape[1:]), standing=standing, footing=cycle.footing, payload_kg=payload_kg
        )
        margin = stances.cps_margin if standing.all() else stances.margin
        fraction = np.where(margin >= least, stances.peak, np.inf)
        out = np.maximum(out, fraction.reshape(n, -1).max(axis=1))
    return out


def _best_place(cycle: GaitCycle, phase: int, config: SwayConfig, payload_kg: float) -> tuple[np.ndarray, float]:
    """Displacement with the least fraction, and that fraction; infinite if none is possible."""
    limit = np.full(3, config.span * cycle.spec.chassis_height)
    return least_on_grid(
        lambda places: phase_fractions(cycle, phase, places, payload_kg=payload_kg),
        low=-limit, high=limit, points=config.points, shrink=config.shrink, resolution=config.resolution,
    )  # fmt: skip


def least_on_grid(
    judge: Callable[[np.ndarray], np.ndarray], *, low: Vec3, high: Vec3, points: int, shrink: float, resolution: float
) -> tuple[Vec3, float]:
    """The displacement that is judged least, on a grid that closes in on it, and that least; infinite if none is possible.

    Args:
        judge: of n displacements (n, 3), shape (n,); of equal ones the smallest is taken.
        low: least displacement along each axis [m].
        high: largest [m].
        points: of the grid along each axis; odd.
        shrink: of the grid from round to round.
        resolution: the search ends when grid points are closer [m].
    """
    axis = np.linspace(-1.0, 1.0, points)
    grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    centre, least, half = np.zeros(3), np.inf, float(max(high.max(), -low.min()))
    while True:
        places = np.clip(centre + half * grid, low, high)
        fractions = judge(places)
        equal = fractions <= fractions.min() + TIE
        place = places[equal][np.argmin(np.linalg.norm(places[equal], axis=1))]
        if fractions.min() < least or not np.isfinite(least):
            centre, least = place, float(fractions.min())
        if not np.isfinite(least) or 2.0 * half / (points - 1) < resolution:
            return centre, least
        half *= shrink


def _pulled_straight(
    cycle: GaitCycle, places: np.ndarray, allowed: np.ndarray, config: SwayConfig, payload_kg: float
) -> np.ndarray:
    """Displacements that differ less from phase to phase, each phase within the fraction it is allowed."""
    steps = np.array([1.0, 0.75, 0.5, 0.25, 0.1])[:, None]
    places = places.copy()
    for _ in range(config.sweeps):
        moved = 0.0
        for k in range(cycle.phases):
            middle = 0.5 * (places[k - 1] + places[(k + 1) % cycle.phases])
            tried = places[k] + steps * (middle - places[k])
            good = phase_fractions(cycle, k, tried, payload_kg=payload_kg) <= allowed[k] + TIE
            if good.any():
                chosen = tried[int(np.argmax(good))]
                moved = max(moved, float(np.linalg.norm(chosen - places[k])))
                places[k] = chosen
        if moved < config.resolution:
            break
    return places


@dataclass(frozen=True, eq=False, kw_only=True)
class ConstantPose:
    """The best gait that does not sway: one chassis height and one foot radius for the whole cycle."""

    chassis_height: float
    """[m]"""
    foot_radius: float
    """[m]"""
    cycle: GaitCycle
    verdict: CycleVerdict


def best_constant_pose(
    spec: RobotSpec,
    heading: Vec2,
    *,
    stride: float,
    foot_radius: float | None = None,
    config: SwayConfig | None = None,
    payload_kg: float = 0.0,
) -> ConstantPose | NoSway:
    """Height and foot radius with the most margin to saturation, the chassis going straight ahead.

    Args:
        spec: the drawings.
        heading: in the hex plane, of length 1.
        stride: advance in a cycle [m].
        foot_radius: kept where given, so that only the height is sought [m].
        config: span of both about the drawings', and how finely to search.
        payload_kg: [kg]
    """
    config = SwayConfig() if config is None else config
    centre = np.array([spec.chassis_height, spec.foot_radius if foot_radius is None else foot_radius])
    limits = config.span * np.array([spec.chassis_height, 0.0 if foot_radius is not None else spec.foot_radius])
    low, high = centre - limits, centre + limits
    axis = np.linspace(-1.0, 1.0, config.points)
    found: ConstantPose | None = None
    half = 1.0
    while True:
        tried = np.clip(centre + half * limits * np.stack(np.meshgrid(axis, axis, indexing="ij"), -1).reshape(-1, 2), low, high)
        for height, radius in np.unique(tried, axis=0):
            cycle = gait_cycle(spec, heading, stride=stride, foot_radius=float(radius), chassis_height=float(height))
            verdict = judge_cycle(cycle, payload_kg=payload_kg)
            if verdict.refusal(spec) or (found is not None and verdict.peak >= found.verdict.peak):
                continue
            found = ConstantPose(chassis_height=float(height), foot_radius=float(radius), cycle=cycle, verdict=verdict)
        if found is None:
            return NoSway(reason=f"no chassis height and foot radius within {100 * config.span:.0f} % walk a stride of {stride} m")
        centre = np.array([found.chassis_height, found.foot_radius])
        if 2.0 * half * limits.max() / (config.points - 1) < config.resolution:
            return found
        half *= config.shrink
