"""Scores of one trial from the truth, as DESIGN.md defines them. The truth judges; it never tells the ground.

A figure that was never measured is None. Samples come at least twice a second while the robot moves, and at every
message it sends, so that each lift-off and touch-down is seen.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from athlete_twin.geometry.grid import HeightGrid
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.spec import LEGS, RobotSpec
from athlete_twin.robot import TrackView, TruthView
from planner.decisions import Proposal
from planner.stability.margin import cps_margin, support_margin, tip_over_energy

LOADED = 50.0
"""a wheel that carries less counts as off the ground [N]: under 1 % of either robot's weight"""
ARRIVED = 0.30
"""horizontal distance of the true chassis from the goal that counts as reached [m], DESIGN.md"""
TIPPED = float(np.deg2rad(30.0))
"""true tilt that counts as tipped over [rad]"""
MAP_REACH = 2.5
"""the believed map is judged within so much of the true path [m]: a leg's reach to either side"""

Summary = dict[str, float | None]


@dataclass(frozen=True, kw_only=True)
class Margins:
    """Stability of one instant, from true loads and the true centre of mass."""

    support: float
    """plain support margin of the loaded wheels [m]"""
    cps: float
    """margin to the conservative support polygon [m]"""
    energy: float
    """tip-over energy per weight [m]"""


@dataclass(kw_only=True)
class Scorer:
    """Gathers one trial's scores."""

    spec: RobotSpec
    grid: HeightGrid
    """true surface"""
    goal: np.ndarray
    """in world, shape (2,) [m]"""
    start: np.ndarray
    """true chassis origin at the start, shape (2,) [m]"""
    datum: float
    """true mean height of the ground under the wheels at the start: where the ground puts its z = 0 [m]"""
    steps_of_leg: np.ndarray = field(default_factory=lambda: np.zeros(LEGS, dtype=int))
    least: Margins | None = None
    peak_torque_fraction: float | None = None
    _sag_errors: list[float] = field(default_factory=list)
    _touchdown_errors: list[float] = field(default_factory=list)
    _localisation_errors: list[float] = field(default_factory=list)
    _map: HeightGrid | None = None

    def sample(self, truth: TruthView) -> Margins:
        """Take in one instant; its margins."""
        now = true_margins(self.spec, truth)
        before = self.least or now
        self.least = Margins(
            support=min(before.support, now.support),
            cps=min(before.cps, now.cps),
            energy=min(before.energy, now.energy),
        )
        self.peak_torque_fraction = truth.peak_torque_fraction
        return now

    def proposed(self, proposal: Proposal, truth: TruthView) -> None:
        """Take in what the ground believed when it proposed."""
        error = proposal.world_from_hex.translation - truth.world_from_hex.translation + [0.0, 0.0, self.datum]
        self._localisation_errors.append(float(np.linalg.norm(error)))
        self._map = proposal.terrain

    def completed(self, proposal: Proposal, truth: TruthView) -> None:
        """Take in the end of a motion that was proposed and carried out.

        Args:
            proposal: as it was approved.
            truth: when the executive reported the sequence completed.
        """
        if proposal.kind == "step":
            for leg, footfall in [(proposal.leg, proposal.footfall_in_world), *((p.leg, p.footfall_in_world) for p in proposal.together)]:
                self.steps_of_leg[leg] += 1
                miss = truth.wheels_in_world[leg, :2] - footfall[:2]
                self._touchdown_errors.append(float(np.linalg.norm(miss)))
        preview = proposal.preview
        believed = _height_over_ground(preview.world_from_hex[-1], preview.wheels_in_world[-1], proposal.terrain)
        true = _height_over_ground(truth.world_from_hex, truth.wheels_in_world, self.grid)
        if np.isfinite(believed - true):
            self._sag_errors.append(abs(believed - true))

    @property
    def gait_cycles(self) -> int:
        """How often every leg has stepped."""
        return int(self.steps_of_leg.min())

    @property
    def steps_taken(self) -> int:
        """Of all legs."""
        return int(self.steps_of_leg.sum())

    def goal_distance(self, truth: TruthView) -> float:
        """Horizontal distance of the true chassis origin from the goal [m]."""
        return float(np.linalg.norm(truth.world_from_hex.translation[:2] - self.goal))

    def progress(self, truth: TruthView) -> float:
        """Net true displacement along start to goal [m]."""
        along = self.goal - self.start
        return float((truth.world_from_hex.translation[:2] - self.start) @ along / np.linalg.norm(along))

    def at_goal(self, truth: TruthView) -> bool:
        """Whether the true robot stands at the goal with every wheel loaded."""
        return self.goal_distance(truth) <= ARRIVED and not self.unloaded(truth)

    @staticmethod
    def unloaded(truth: TruthView) -> list[int]:
        """Numbers of the wheels, 1 to 6, that carry next to nothing."""
        return [int(leg) + 1 for leg in np.flatnonzero(truth.wheel_loads <= LOADED)]

    def sag_error(self) -> Summary:
        """Chassis height over the ground under its wheels, believed against true, at the end of each motion [m]."""
        return mean_max(self._sag_errors)

    def touchdown_error(self) -> Summary:
        """Horizontal distance of the axle from the footfall asked for, at the end of each step [m]."""
        return mean_max(self._touchdown_errors)

    def localisation_error(self) -> Summary:
        """Distance of the believed chassis from the true one at each proposal [m]."""
        return mean_max(self._localisation_errors)

    def map_error(self, path_xy: np.ndarray) -> Summary:
        """Believed height against true, over the cells within `MAP_REACH` of the true path (n, 2) [m]."""
        if self._map is None or len(path_xy) == 0:
            return dict.fromkeys(("median", "rmse", "p95", "coverage"))
        return map_error(self._map, self.grid, path_xy, datum=self.datum)


def true_margins(spec: RobotSpec, truth: TruthView) -> Margins:
    """Margins over the wheels that carry load; on fewer than three they are zero at best."""
    contacts = truth.wheels_in_world - np.array([0.0, 0.0, spec.wheel.radius])
    down = contacts[truth.wheel_loads > LOADED]
    if len(down) < 3:
        return Margins(support=0.0, cps=0.0, energy=0.0)
    com = truth.com_in_world
    return Margins(support=support_margin(com, down), cps=cps_margin(com, down), energy=tip_over_energy(com, down))


def tilt(world_from_hex: SE3) -> float:
    """Angle between the chassis' and the world's z axis [rad]."""
    return math.acos(min(max(float(world_from_hex.rotation[2, 2]), -1.0), 1.0))


def map_error(believed: HeightGrid, true: HeightGrid, path_xy: np.ndarray, *, datum: float) -> Summary:
    """Median, RMS and 95th percentile of the absolute height error, and the share of cells known.

    Args:
        believed: heights, NaN where unknown.
        true: the true surface.
        path_xy: cells within `MAP_REACH` of any of these points count, shape (n, 2) [m].
        datum: true height of what the believed map calls zero [m].
    """
    x, y = believed.centres()
    xy = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
    near = np.zeros(believed.shape, dtype=bool)
    for point in _thinned(path_xy, 0.25 * MAP_REACH):
        near |= np.sum((xy - point) ** 2, axis=-1) <= MAP_REACH**2
    known = near & np.isfinite(believed.heights)
    if not known.any():
        return {"median": None, "rmse": None, "p95": None, "coverage": 0.0 if near.any() else None}
    error = np.abs(believed.heights[known] + datum - true.sample(xy[known]))
    return {
        "median": float(np.median(error)),
        "rmse": float(np.sqrt(np.mean(error**2))),
        "p95": float(np.percentile(error, 95)),
        "coverage": float(known.sum() / near.sum()),
    }


def mean_max(values: list[float]) -> Summary:
    """Mean and largest of what was measured; None of nothing."""
    if not values:
        return {"mean": None, "max": None}
    return {"mean": float(np.mean(values)), "max": float(np.max(values))}


def path_of(track: list[TrackView]) -> np.ndarray:
    """Chassis origins in plan view along a track, shape (n, 2) [m]."""
    return np.array([p.world_from_hex.translation[:2] for p in track]).reshape(-1, 2)


def _height_over_ground(world_from_hex: SE3, wheels_in_world: np.ndarray, grid: HeightGrid) -> float:
    return float(world_from_hex.translation[2] - np.mean(grid.sample(wheels_in_world[:, :2])))


def _thinned(points: np.ndarray, spacing: float) -> list[np.ndarray]:
    """Points along a path, at least `spacing` apart [m]."""
    kept: list[np.ndarray] = []
    for p in points:
        if not kept or np.linalg.norm(p - kept[-1]) >= spacing:
            kept.append(p)
    return kept
