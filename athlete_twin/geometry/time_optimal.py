"""The fastest way along a blended path, from rest to rest, no joint faster or accelerating more than it may.

Reachability analysis as in TOPP-RA [Pham2018] "A new approach to time-optimal path parameterization based on reachability
analysis": the path is cut into cells, in each of which the path's acceleration u is constant, so its squared speed x is linear
along the path. A sweep from the end finds the largest x at each cell from which the rest of the path can still be done; a sweep
from the start goes as fast as these allow. In a cell of a line or parabola a joint's acceleration, q'' x + q' u, is linear along
the path too: held at both ends of the cell it holds everywhere in it, and not at grid points alone. So do the samples: a second
difference over a period is a mean of the acceleration.

The toppra library solves the same cells and is what the tests compare with. It is not used here: it loads a plotting library into
the robot, takes tens of milliseconds where this takes one, holds limits at grid points, and ends each step by up to 1e-8 below
what it found, which on cells of microradians asks for more acceleration than there is.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import no_type_check

import numba
import numpy as np
from jaxtyping import Float

from athlete_twin.errors import KinematicsError
from athlete_twin.geometry.blended_path import BlendedPath

CELLS_PER_RAMP = 16
"""cells on the way from rest to full speed: their ends are where the acceleration may change"""
CELLS_PER_LINE, CELLS_PER_BLEND = 4, 8
"""at least: on pieces shorter than a ramp"""
SAMPLED_AT_ONCE = 24
"""samples: two dozen cost little more than one"""
NEWTON_STEPS = 100
"""more than there are limits on a cell, so never used up"""


@dataclass(frozen=True, eq=False, kw_only=True)
class TimedPath:
    """A path and when it is where."""

    path: BlendedPath
    grid: Float[np.ndarray, " n"]
    """ends of the cells along the path [rad]"""
    speeds: Float[np.ndarray, " n"]
    """along the path at these [rad/s]"""
    times: Float[np.ndarray, " n"]
    """when it is there, from 0 [s]"""

    @property
    def duration(self) -> float:
        """From rest to rest [s]."""
        return float(self.times[-1])

    def at(self, t: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n dof"]:
        """Configurations at times from 0 to the duration [rad]."""
        i = np.clip(np.searchsorted(self.times, t, side="right") - 1, 0, len(self.grid) - 2)
        since = np.asarray(t) - self.times[i]
        rate = np.diff(self.speeds)[i] / np.diff(self.times)[i]
        return self.path.at(self.grid[i] + since * (self.speeds[i] + 0.5 * since * rate))

    def ticks(self, period: float) -> int:
        """Samples `period` [s] apart that the motion takes; one where there is nothing to move."""
        return max(1, int(np.ceil(self.duration / period * (1.0 - 1e-12))))

    def samples(self, period: float) -> Iterator[Float[np.ndarray, " dof"]]:
        """Configurations each `period` [s] after the start, the last one the path's end [rad].

        The motion is slowed down to fill the last period, by less than one period in all. Some at a time: a slow motion has
        as many as its hours have ticks.
        """
        n = self.ticks(period)
        for first in range(1, n, SAMPLED_AT_ONCE):
            yield from self.at(np.arange(first, min(first + SAMPLED_AT_ONCE, n)) * (self.duration / n))
        yield self.path.end.copy()


def time_optimal(path: BlendedPath, *, speed: float, acceleration: float) -> TimedPath:
    """The path as fast as joints with these limits follow it, from rest to rest.

    Args:
        path: of joints.
        speed: limit of every joint [rad/s].
        acceleration: limit of every joint [rad/s2].
    """
    if not (0.0 < speed < np.inf and 0.0 < acceleration < np.inf):
        raise KinematicsError(f"speed {speed} rad/s and acceleration {acceleration} rad/s2 must be positive and finite")
    if len(path.origins) == 0:
        return TimedPath(path=path, grid=np.zeros(1), speeds=np.zeros(1), times=np.zeros(1))
    steps, piece, along = _cells(path, speed**2 / (2.0 * acceleration) / CELLS_PER_RAMP)
    bends = path.bends[piece]
    first = path.directions[piece] + along[:, None] * bends
    last = first + steps[:, None] * bends
    grid = np.concatenate([[0.0], np.cumsum(steps)])
    caps = _speed_caps(path, piece, first, last, speed)
    squares = _fastest(steps, first, last, bends, caps, acceleration)
    speeds = np.sqrt(squares)
    between = speeds[:-1] + speeds[1:]
    if not (np.isfinite(speeds).all() and (between > 0.0).all()):
        raise KinematicsError(f"no speeds were found along a path of {path.length:.6g} rad with {len(piece)} cells")
    times = np.concatenate([[0.0], np.cumsum(2.0 * steps / between)])
    return TimedPath(path=path, grid=grid, speeds=speeds, times=times)


def _cells(path: BlendedPath, longest: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lengths of the cells, the piece of each, and where in its piece each begins."""
    lengths = np.diff(path.knots)
    least = np.where(path.bends.any(axis=1), CELLS_PER_BLEND, CELLS_PER_LINE)
    counts = np.maximum(least, np.ceil(lengths / longest).astype(int))
    piece = np.repeat(np.arange(len(lengths)), counts)
    steps = (lengths / counts)[piece]
    number = np.arange(len(piece)) - np.repeat(np.cumsum(counts) - counts, counts)
    return steps, piece, number * steps


def _speed_caps(path: BlendedPath, piece: np.ndarray, first: np.ndarray, last: np.ndarray, speed: float) -> np.ndarray:
    """Squared speed at the cells' ends that keeps every joint within its speed in the cells beside; zero where the path stops."""
    # A joint's direction is linear in a cell, so it is largest at an end; so is the squared speed.
    steepest = np.maximum(np.abs(first), np.abs(last)).max(axis=1)
    caps = (speed / np.concatenate([steepest[:1], np.maximum(steepest[:-1], steepest[1:]), steepest[-1:]])) ** 2
    begins = np.searchsorted(piece, np.arange(len(path.origins)))
    caps[np.append(begins, len(piece))[path.stops]] = 0.0
    return np.asarray(caps)


@no_type_check
@numba.njit(cache=True)
def _fastest(steps, first, last, bends, caps, most):  # type: ignore[no-untyped-def]
    """Squared speeds at the cells' ends: the largest that can still be slowed down from, then the largest reached."""
    n = len(steps)
    slowable = np.zeros(n + 1)
    for i in range(n - 1, -1, -1):
        x = caps[i]
        for _ in range(NEWTON_STEPS):
            low, low_slope, high, high_slope, x = _room(steps[i], first[i], last[i], bends[i], most, slowable[i + 1], x)
            # The room for u shrinks ever faster with x: Newton's steps come down to where there is just none left.
            if high - low >= -1e-13 * (abs(high) + abs(low)):
                break
            x = max(x - (high - low) / (high_slope - low_slope), 0.0)
        slowable[i] = x
    squares = np.zeros(n + 1)
    for i in range(n):
        _, _, high, _, x = _room(steps[i], first[i], last[i], bends[i], most, slowable[i + 1], squares[i])
        squares[i + 1] = min(max(x + 2.0 * steps[i] * high, 0.0), slowable[i + 1])
    return squares


@no_type_check
@numba.njit(cache=True)
def _room(step, first, last, bend, most, following, x):  # type: ignore[no-untyped-def]
    """Least and largest u of a cell entered at x, how both change with x, and x, reduced where a joint allows no such x at all."""
    for j in range(len(bend)):
        for a in (first[j], last[j] + 2.0 * step * bend[j]):
            if a == 0.0 and abs(bend[j]) * x > most:
                x = most / abs(bend[j])
    low, low_slope = -x / (2.0 * step), -1.0 / (2.0 * step)
    high, high_slope = (following - x) / (2.0 * step), -1.0 / (2.0 * step)
    for j in range(len(bend)):
        for a in (first[j], last[j] + 2.0 * step * bend[j]):
            if a == 0.0:
                continue
            middle, half = -bend[j] * x / a, most / abs(a)
            if middle - half > low:
                low, low_slope = middle - half, -bend[j] / a
            if middle + half < high:
                high, high_slope = middle + half, -bend[j] / a
    return low, low_slope, high, high_slope, x
