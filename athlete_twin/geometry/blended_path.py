"""Way-points in joint space as a path without corners: straight lines, and a parabola where two of them meet.

A polyline cannot be followed without a stop at each corner or an infinite acceleration. Here each corner is cut by a parabola that
touches both lines, so the direction turns continuously (C1); its second derivative is constant, which makes the limits along it
linear in the squared speed (`time_optimal.py`). The parabola is as wide as the tolerance and half of the shorter line allow. Where
the path turns right round there is nothing to cut, and where the tolerance is zero nothing may be: there it stops.

Reference: [Kunz2012] "Time-optimal trajectory generation for path following with bounded acceleration and velocity", which cuts
corners by arcs of circles; the parabola keeps the second derivative constant, as LSPB does in time.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Integer

from athlete_twin.errors import KinematicsError

SAME = 1e-6
"""way-points as near as this are one [rad]"""
STRAIGHT = 1e-9
"""directions that differ by less need no blend, and a path that turns right round by all but this stops"""


@dataclass(frozen=True, eq=False, kw_only=True)
class BlendedPath:
    """Pieces in a row, each `origin + s direction + s^2 / 2 bend`; s runs along the path, [rad] where it is straight."""

    origins: Float[np.ndarray, "m dof"]
    """where the pieces begin [rad]"""
    directions: Float[np.ndarray, "m dof"]
    """first derivative at their beginnings; of length 1 on lines"""
    bends: Float[np.ndarray, "m dof"]
    """second derivative; zero on lines [1/rad]"""
    corners: Integer[np.ndarray, " m"]
    """way-point that a blend passes; -1 on lines"""
    knots: Float[np.ndarray, " m+1"]
    """ends of the pieces along the path, from 0 [rad]"""
    stops: Bool[np.ndarray, " m+1"]
    """knots at which the direction jumps, and the two ends"""
    end: Float[np.ndarray, " dof"]
    """the last way-point [rad]"""

    @property
    def length(self) -> float:
        """Where the path ends; the polyline's length, less what the blends leave open [rad]."""
        return float(self.knots[-1])

    def at(self, s: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n dof"]:
        """Configurations at places along the path [rad]."""
        i = self._pieces(s)
        along = (s - self.knots[i])[:, None]
        return np.asarray(self.origins[i] + along * (self.directions[i] + 0.5 * along * self.bends[i]))

    def blends(self, spacing: float) -> list[tuple[int, Float[np.ndarray, "n dof"]]]:
        """For each blend the index of its way-point, and configurations on it no farther apart than `spacing` [rad].

        The first and the last are where it begins and ends, the middle one of their odd number is nearest to the way-point.
        """
        out = []
        for i in np.flatnonzero(self.corners >= 0):
            first, last = self.knots[i], self.knots[i + 1]
            halves = max(1, int(np.ceil(0.5 * (last - first) / spacing)))
            out.append((int(self.corners[i]), self.at(np.linspace(first, last, 1 + 2 * halves))))
        return out

    def _pieces(self, s: np.ndarray) -> np.ndarray:
        return np.clip(np.searchsorted(self.knots, s, side="right") - 1, 0, len(self.origins) - 1)


def blended(waypoints: Float[np.ndarray, "k dof"], tolerance: float) -> BlendedPath:
    """The path through way-points that leaves the polyline by at most `tolerance` (Euclidean, [rad]) and ends on the last.

    Args:
        waypoints: shape (k, dof), k >= 1, from where the path begins [rad].
        tolerance: distance of each parabola from its corner; zero stops at every corner [rad].
    """
    given = np.asarray(waypoints, dtype=float)
    if len(given) < 1 or not np.isfinite(given).all():
        raise KinematicsError(f"a path needs finite way-points of shape (k, dof) with k >= 1, got {given.shape}")
    if not (np.isfinite(tolerance) and tolerance >= 0.0):
        raise KinematicsError(f"corner tolerance {tolerance} rad must be finite and not negative")
    kept = _distinct(given)
    nodes = given[kept]
    spans = np.diff(nodes, axis=0)
    lengths = np.linalg.norm(spans, axis=1)
    units = spans / lengths[:, None]
    # At a corner the parabola leaves the lines `cuts` before and after it and passes it at cuts / 2 x sin(half the turn).
    half_turns = 0.5 * np.linalg.norm(units[1:] - units[:-1], axis=1)
    room = 0.5 * np.minimum(lengths[:-1], lengths[1:])
    cuts = np.minimum(room, 2.0 * tolerance / np.maximum(half_turns, STRAIGHT))
    straight, stops = half_turns < STRAIGHT, (half_turns > 1.0 - STRAIGHT) | (tolerance == 0.0)
    cuts = np.where(straight | stops, 0.0, cuts)
    return _pieces(nodes, kept, units, lengths, cuts, stops & ~straight, given[-1])


def _distinct(nodes: np.ndarray) -> list[int]:
    """Indices of way-points without those where the path is already; the first is among them, and the last where it moves at all."""
    kept = [0]
    for i, node in enumerate(nodes):
        if np.linalg.norm(node - nodes[kept[-1]]) > SAME:
            kept.append(i)
    if len(kept) > 1:
        kept[-1] = len(nodes) - 1
    return kept


def _pieces(
    nodes: np.ndarray, kept: list[int], units: np.ndarray, lengths: np.ndarray, cuts: np.ndarray, stops: np.ndarray, end: np.ndarray
) -> BlendedPath:
    """Line, blend, line, and so on; lines of which the blends left nothing are left out."""
    knots, origins, directions, bends, halts = [0.0], [], [], [], [True]
    corners: list[int] = []
    nothing = np.zeros(nodes.shape[1])
    before, after = np.concatenate([[0.0], cuts]), np.concatenate([cuts, [0.0]])
    for i, unit in enumerate(units):
        line = lengths[i] - before[i] - after[i]
        if line > 1e-3 * SAME:
            knots.append(knots[-1] + line)
            origins.append(nodes[i] + before[i] * unit)
            directions.append(unit)
            bends.append(nothing)
            corners.append(-1)
            halts.append(i == len(units) - 1 or bool(stops[i]))
        if after[i] > 0.0:
            knots.append(knots[-1] + 2.0 * after[i])
            origins.append(nodes[i + 1] - after[i] * unit)
            directions.append(unit)
            bends.append((units[i + 1] - unit) / (2.0 * after[i]))
            corners.append(kept[i + 1])
            halts.append(False)
    halts[-1] = True
    shape = (len(origins), nodes.shape[1])
    return BlendedPath(
        knots=np.array(knots),
        origins=np.array(origins).reshape(shape),
        directions=np.array(directions).reshape(shape),
        bends=np.array(bends).reshape(shape),
        corners=np.array(corners, dtype=int),
        stops=np.array(halts),
        end=end.copy(),
    )
