"""What leg swings are measured against: pieces at constant speed with jumps between, and the toppra library on the same path."""

from __future__ import annotations

import itertools
import time
from typing import Any

import numpy as np

from athlete_twin.geometry.blended_path import BlendedPath
from athlete_twin.geometry.time_optimal import TimedPath
from athlete_twin.model.spec import RobotSpec

GRID_POINTS = 400
"""that toppra puts on a path at least"""


def constant_speed(waypoints: np.ndarray, speed: float, period: float) -> np.ndarray:
    """Each straight piece at the speed of its fastest joint, velocities jumping at its ends: samples, shape (n, dof) [rad]."""
    out = []
    for a, b in itertools.pairwise(waypoints):
        ticks = max(1, int(np.ceil(np.abs(b - a).max() / (speed * period))))
        out.append(a + (np.arange(1, ticks + 1) / ticks)[:, None] * (b - a))
    return np.concatenate(out)


def peak_acceleration(samples: np.ndarray, start: np.ndarray, period: float) -> float:
    """Largest second difference of a commanded motion from rest to rest [rad/s2]."""
    return float(np.abs(np.diff(np.concatenate([[start, start], samples, samples[-1:]]), 2, axis=0)).max() / period**2)


def toppra_figures(motion: TimedPath, spec: RobotSpec) -> tuple[float, float]:
    """Duration of the same path by toppra, on a grid of its own, and what it took to find [s]; NaN where it found none."""
    import toppra
    from toppra.algorithm import TOPPRA
    from toppra.constraint import DiscretizationType, JointAccelerationConstraint, JointVelocityConstraint

    limits = np.tile([-1.0, 1.0], (spec.dof, 1))
    start = time.perf_counter()
    path = _as_toppra(motion.path)
    constraints = [
        JointVelocityConstraint(spec.speed_unloaded * limits),
        JointAccelerationConstraint(spec.acceleration_unloaded * limits, discretization_scheme=DiscretizationType.Interpolation),
    ]
    grid = np.asarray(toppra.interpolator.propose_gridpoints(path, min_nb_points=GRID_POINTS))
    _, speeds, _ = TOPPRA(constraints, path, gridpoints=grid, solver_wrapper="seidel").compute_parameterization(0.0, 0.0)
    seconds = time.perf_counter() - start
    if speeds is None or not np.isfinite(speeds).all():
        return float("nan"), seconds
    return float((2.0 * np.diff(grid) / (speeds[1:] + speeds[:-1])).sum()), seconds


def _as_toppra(path: BlendedPath) -> Any:
    import toppra

    class Path(toppra.interpolator.AbstractGeometricPath):
        path_interval = np.array([0.0, path.length])
        dof = path.origins.shape[1]

        def __call__(self, s: Any, order: int = 0) -> np.ndarray:
            at = np.atleast_1d(np.asarray(s, dtype=float))
            i = np.clip(np.searchsorted(path.knots, at, side="right") - 1, 0, len(path.origins) - 1)
            along = (at - path.knots[i])[:, None]
            out = (path.at(at), path.directions[i] + along * path.bends[i], path.bends[i])[order]
            return np.asarray(out if np.ndim(s) else out[0])

    return Path()
