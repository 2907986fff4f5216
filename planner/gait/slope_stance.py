"""The stance that climbs the steepest: where on a slope the feet should stand, and how high the chassis.

[SunSpiral2012] s5.3.4 walked 7 and 14 degrees with the deck level, the uphill legs folded and the downhill ones stretched. A
regular circle of feet gives this away early: here the feet stand on a figure of three lengths, a radius across the slope and
one each uphill and downhill, under a chassis of any height, headed with a leg or between two. Searched from coarse to fine,
slope by slope: all figures of a grid in one go, then finer grids about those that climbed highest. What passes is judged whole
(`cycle.judge_cycles`, `clearance`), so each figure found is one that walks; steeper ones may exist between the grid's.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from athlete_twin.errors import PlanningError
from athlete_twin.geometry.arrays import Vec2
from athlete_twin.model.spec import RobotSpec
from planner.gait.clearance import first_strike, ground_of, reaches_with_spare
from planner.gait.cycle import CycleVerdict, GaitCycle, gait_cycle, judge_cycles
from planner.gait.limits import footing_on
from planner.motion.collision import CollisionConfig

AXES = ("across", "uphill", "downhill", "height")


@dataclass(frozen=True, kw_only=True)
class SlopeSearch:
    """Where stances are sought, and how finely."""

    low: float = 0.5
    """shortest lengths tried, over the drawings' foot radius and chassis height"""
    high: float = 1.3
    """longest"""
    points: int = 8
    """of the first grid along each axis"""
    shrink: float = 0.5
    """of the grid from round to round"""
    rounds: int = 4
    """of grids"""
    keep: int = 4
    """figures about which the next round looks"""
    step_deg: float = 4.0
    """between slopes in the first round, halved in each further one [deg]"""
    spare: float = 0.0
    """by which any wheel may be off and still be reached [m]"""
    clearance: float = 0.01
    """of all parts but wheels from the ground [m]"""
    looked_at: int = 40
    """figures of a grid that are checked for strikes at most, those with the least torque first"""
    steepest_deg: float = 44.0
    """tried [deg]"""
    directions_deg: tuple[float, ...] = (0.0, 30.0)
    """of uphill in hex, tried: along a leg of SDM-B and between two [deg]"""

    def __post_init__(self) -> None:
        if not (0.0 < self.low < self.high and 0.0 < self.shrink < 1.0 and 0.0 < self.step_deg <= self.steepest_deg < 90.0):
            raise PlanningError("need 0 < low < high, shrink within 0 to 1 and 0 < step_deg <= steepest_deg < 90")
        if self.points < 2 or self.rounds < 1 or self.keep < 1 or not self.directions_deg:
            raise PlanningError(f"points {self.points}, rounds {self.rounds}, keep {self.keep} must be 2, 1, 1 or more")


@dataclass(frozen=True, eq=False, kw_only=True)
class SlopeStance:
    """A figure of feet under a chassis, and the slope that it walks."""

    angle: float
    """of the slope [rad]"""
    heading: Vec2
    """uphill, in the hex plane"""
    lengths: np.ndarray
    """radius of the feet across the slope, uphill and downhill, and height of the chassis, shape (4,) [m]"""
    cycle: GaitCycle
    verdict: CycleVerdict


@dataclass(frozen=True, kw_only=True)
class NoSlopeStance:
    """No figure that was tried walks the slope."""

    tried: int
    reason: str
    """how many figures each check refused"""


def foot_figure(spec: RobotSpec, heading: Vec2, lengths: np.ndarray) -> np.ndarray:
    """Regular places in the hex plane, shape (6, 2): a circle stretched across, uphill and downhill by `lengths` [m]."""
    angles = spec.foot_azimuths
    circle = np.column_stack([np.cos(angles), np.sin(angles)])
    across = np.array([-heading[1], heading[0]])
    along = circle @ heading
    stretched = np.where(along >= 0.0, lengths[1], lengths[2]) * along
    return np.asarray(stretched[:, None] * heading + lengths[0] * (circle @ across)[:, None] * across)


def walks(
    spec: RobotSpec,
    angle: float,
    heading: Vec2,
    lengths: np.ndarray,
    *,
    stride: float,
    deck: str,
    lift: float | None = None,
    payload_kg: float = 0.0,
) -> tuple[list[GaitCycle], list[CycleVerdict], list[str]]:
    """Cycles straight up a slope with n figures (n, 4), their verdicts, and why each may not be walked; empty where it may.

    Args:
        spec: the drawings.
        angle: of the slope [rad].
        heading: uphill, in the hex plane, of length 1.
        lengths: across, uphill, downhill and height of each figure [m].
        stride: advance in a cycle, along the ground [m].
        deck: "level" to gravity, or "parallel" to the ground.
        lift: of a swinging wheel over its footfalls [m].
        payload_kg: [kg]
    """
    footing = footing_on(angle, heading, deck=deck)
    cycles = [
        gait_cycle(
            spec, heading, stride=stride, foot_plan=foot_figure(spec, heading, row), chassis_height=float(row[3]),
            footing=footing, lift=lift,
        )
        for row in lengths
    ]  # fmt: skip
    verdicts = judge_cycles(cycles, payload_kg=payload_kg)
    return cycles, verdicts, [verdict.refusal(spec) for verdict in verdicts]


def steepest_stance(
    spec: RobotSpec,
    *,
    stride: float,
    deck: str,
    search: SlopeSearch | None = None,
    lift: float | None = None,
    payload_kg: float = 0.0,
) -> SlopeStance | NoSlopeStance:
    """The steepest slope that any figure walks straight up, with the least torque among equals; arguments as of `walks`."""
    search = SlopeSearch() if search is None else search
    best: SlopeStance | NoSlopeStance = NoSlopeStance(tried=0, reason="nothing was tried")
    for degrees in search.directions_deg:
        heading = np.array([np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))])
        found = _steepest(spec, heading, stride, deck, search, lift, payload_kg)
        better = isinstance(found, SlopeStance) and (isinstance(best, NoSlopeStance) or found.angle > best.angle + 1e-9)
        if better or (isinstance(best, NoSlopeStance) and best.tried == 0):
            best = found
    return best


def stance_on(
    spec: RobotSpec,
    angle: float,
    *,
    stride: float,
    deck: str,
    search: SlopeSearch | None = None,
    lift: float | None = None,
    payload_kg: float = 0.0,
    hint: SlopeStance | None = None,
) -> SlopeStance | NoSlopeStance:
    """The figure that walks one slope with the least peak torque; arguments as of `walks`, and a figure that may do."""
    search = SlopeSearch() if search is None else search
    best: SlopeStance | None = None
    refused: dict[str, int] = {}
    tried = 0
    for degrees in search.directions_deg:
        heading = np.array([np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))])
        grid, half = _first_grid(spec, search)
        if hint is not None and np.allclose(hint.heading, heading):
            grid = np.vstack([grid, hint.lengths])
        for _ in range(search.rounds):
            cycles, verdicts, why = walks(
                spec, angle, heading, grid, stride=stride, deck=deck, lift=lift, payload_kg=payload_kg
            )  # fmt: skip
            tried += len(grid)
            for text in why:
                refused[_kind(text)] = refused.get(_kind(text), 0) + 1
            good, struck = _free(cycles, verdicts, why, search)
            for text in struck:
                refused[text] = refused.get(text, 0) + 1
            if not good:
                break
            i = good[0]
            if best is None or verdicts[i].peak < best.verdict.peak:
                best = SlopeStance(angle=angle, heading=heading, lengths=grid[i], cycle=cycles[i], verdict=verdicts[i])
            grid, half = _finer(grid[good], half, search)
    if best is None:
        told = ", ".join(f"{count} {kind}" for kind, count in sorted(refused.items(), key=lambda pair: -pair[1]) if kind)
        return NoSlopeStance(tried=tried, reason=f"of {tried} stances {told}")
    return best


def _steepest(
    spec: RobotSpec, heading: Vec2, stride: float, deck: str, search: SlopeSearch, lift: float | None, payload_kg: float
) -> SlopeStance | NoSlopeStance:
    """The search along one direction of the hex."""
    grid, half = _first_grid(spec, search)
    step, angle, tried = np.deg2rad(search.step_deg), 0.0, 0
    best: SlopeStance | None = None
    for _ in range(search.rounds):
        good: np.ndarray | None = None
        while angle <= np.deg2rad(search.steepest_deg) + 1e-9:
            cycles, verdicts, why = walks(
                spec, angle, heading, grid, stride=stride, deck=deck, lift=lift, payload_kg=payload_kg
            )  # fmt: skip
            tried += len(grid)
            passed, _ = _free(cycles, verdicts, why, search)
            if not passed:
                break
            i = passed[0]
            best = SlopeStance(angle=angle, heading=heading, lengths=grid[i], cycle=cycles[i], verdict=verdicts[i])
            good = grid[passed]
            angle += step
        if best is None:
            return NoSlopeStance(tried=tried, reason=f"none of {tried} stances walks on level ground with a stride of {stride:g} m")
        kept = best.lengths[None] if good is None else np.vstack([best.lengths, good])
        grid, half = _finer(kept, half, search)
        step *= 0.5
        angle = best.angle + step
    assert best is not None  # the first round found one or returned
    return best


def _free(
    cycles: list[GaitCycle], verdicts: list[CycleVerdict], why: list[str], search: SlopeSearch
) -> tuple[list[int], list[str]]:
    """Indices of the few with the least torque that strike nothing, and what others on the way there strike."""
    good: list[int] = []
    struck: list[str] = []
    looked = 0
    body = ground_of(cycles[0], CollisionConfig(near_ground_clearance=search.clearance))
    for i in sorted((i for i in range(len(cycles)) if not why[i]), key=lambda i: (verdicts[i].peak, i)):
        if search.spare > 0.0 and not reaches_with_spare(cycles[i], search.spare):
            struck.append("leave no reach to spare")
            continue
        if looked == search.looked_at:
            break
        looked += 1
        hit = first_strike(cycles[i], body)
        if hit is None:
            good.append(i)
        else:
            struck.append("strike the ground" if "terrain" in hit else "strike themselves")
        if len(good) == search.keep:
            break
    return good, struck


def _first_grid(spec: RobotSpec, search: SlopeSearch) -> tuple[np.ndarray, np.ndarray]:
    """All figures of the first round, shape (n, 4), and half of what lies between them [m]."""
    scale = np.array([spec.foot_radius] * 3 + [spec.chassis_height])
    axis = np.linspace(search.low, search.high, search.points)
    grid = np.stack(np.meshgrid(*[axis] * 4, indexing="ij"), axis=-1).reshape(-1, 4) * scale
    return grid, 0.5 * (search.high - search.low) / (search.points - 1) * scale


def _finer(kept: np.ndarray, half: np.ndarray, search: SlopeSearch) -> tuple[np.ndarray, np.ndarray]:
    """Figures about those kept, half a grid away, and the new half."""
    axis = np.array([-1.0, 0.0, 1.0])
    about = np.stack(np.meshgrid(*[axis] * 4, indexing="ij"), axis=-1).reshape(-1, 4)
    grid = np.unique(np.round((kept[:, None] + half * about[None]).reshape(-1, 4), 6), axis=0)
    return grid, half * search.shrink


def _kind(text: str) -> str:
    """A refusal without its numbers."""
    kinds = {"reach": "do not reach", "support": "tip", "CPS": "would tip if a wheel gave way", "pull": "would pull at the ground"}
    return next((told for word, told in kinds.items() if word in text), "saturate a joint") if text else ""
