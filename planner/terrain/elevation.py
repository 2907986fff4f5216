"""Points of one view -> height, variance and count per cell of a world-fixed grid.

Model: within a cell the points scatter by the stereo's noise and, at a rock's edge, by the rock itself. On flat
ground the height is the median, which has no bias; where the upper quantile stands out of the expected noise the cell
is steep, and the excess is added, so that a rock is never averaged away while a single stray point cannot raise the
cell.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import no_type_check

import numba
import numpy as np

from athlete_twin.errors import ConfigError, TerrainError
from athlete_twin.geometry.arrays import AnyPoints3
from athlete_twin.geometry.grid import HeightGrid


@dataclass(frozen=True, kw_only=True)
class GridLayout:
    """Where the cells of a map lie, without their content."""

    origin_x: float
    """x of the centre of cell [0, 0] [m]"""
    origin_y: float
    """y of the centre of cell [0, 0] [m]"""
    cell: float
    """edge of a cell [m]"""
    nx: int
    ny: int

    def __post_init__(self) -> None:
        if not (np.isfinite(self.cell) and self.cell > 0.0) or min(self.nx, self.ny) < 2:
            raise TerrainError(f"map of {self.nx} x {self.ny} cells of {self.cell} m; needs 2 x 2 of a positive size")

    @staticmethod
    def centred(x: float, y: float, *, size_x: float, size_y: float, cell: float) -> GridLayout:
        """A map of `size_x` by `size_y` [m] around a place, its cell centres on whole multiples of `cell`."""
        nx, ny = max(int(np.ceil(size_x / cell)), 2), max(int(np.ceil(size_y / cell)), 2)
        first_x, first_y = np.rint(x / cell - 0.5 * nx), np.rint(y / cell - 0.5 * ny)
        return GridLayout(origin_x=float(first_x * cell), origin_y=float(first_y * cell), cell=cell, nx=nx, ny=ny)

    def grid(self, heights: np.ndarray) -> HeightGrid:
        """A height grid of this layout."""
        return HeightGrid(origin_x=self.origin_x, origin_y=self.origin_y, cell=self.cell, heights=heights)

    def flat_index(self, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Flat cell index ix * ny + iy of points (n, 2), and whether each lies inside."""
        flat = _flat_index(np.asarray(xy, dtype=np.float64), self.origin_x, self.origin_y, self.cell, self.nx, self.ny)
        return flat, flat >= 0


@dataclass(frozen=True, kw_only=True)
class ElevationConfig:
    """How the points of a cell become its height."""

    min_points: int = 3
    """fewer are no measurement: a stray point or two must not make a cell"""
    upper_quantile: float = 0.85
    """of the points' heights: what a steep cell's height comes from"""
    noise_allowance: float = 1.3
    """the upper quantile may exceed the median by this many sigma before the cell counts as steep; 1.04 is expected"""
    correlated_points: float = 9.0
    """neighbouring pixels share a matching window: this many carry the information of one"""
    sigma_floor: float = 0.006
    """of a cell's height, from what averaging does not remove: camera pose, calibration [m]"""
    steep_fraction: float = 0.5
    """of a steep cell's excess that counts as one sigma of its height"""

    def __post_init__(self) -> None:
        if self.min_points < 1:
            raise ConfigError(f"min_points is {self.min_points}, must be at least 1")
        if not 0.5 <= self.upper_quantile < 1.0:
            raise ConfigError(f"upper_quantile is {self.upper_quantile}, must be in [0.5, 1)")


@dataclass(frozen=True, eq=False, kw_only=True)
class CellHeights:
    """What one view says of the cells it saw."""

    index: np.ndarray
    """flat indices ix * ny + iy, ascending, shape (n,)"""
    height: np.ndarray
    """[m]"""
    variance: np.ndarray
    """of the height [m2]"""
    count: np.ndarray
    """points in the cell"""
    centroid: np.ndarray
    """mean x and y of the cell's points, shape (n, 2) [m]"""


def measure_cells(
    points_in_world: AnyPoints3, sigma_z: np.ndarray, *, layout: GridLayout, config: ElevationConfig
) -> CellHeights:
    """Robust height of every cell that at least `min_points` points fell into.

    Args:
        points_in_world: shape (n, 3), finite [m].
        sigma_z: one sigma of each point's height, shape (n,) [m].
        layout: the cells.
        config: the statistics.
    """
    points = np.ascontiguousarray(points_in_world, dtype=np.float64).reshape(-1, 3)
    sigma = np.ascontiguousarray(sigma_z, dtype=np.float64).reshape(-1)
    if len(sigma) != len(points):
        raise TerrainError(f"{len(points)} points need as many sigmas, got {len(sigma)}")
    flat, _ = layout.flat_index(points[:, :2])
    index, height, variance, count, centroid = _cell_statistics(
        points,
        sigma,
        flat,
        layout.nx * layout.ny,
        config.min_points,
        config.upper_quantile,
        config.noise_allowance,
        config.correlated_points,
        config.sigma_floor,
        config.steep_fraction,
    )
    return CellHeights(index=index, height=height, variance=variance, count=count, centroid=centroid)


@numba.njit(cache=True)
@no_type_check
def _flat_index(xy, origin_x, origin_y, cell, nx, ny):
    flat = np.empty(len(xy), np.int64)
    for k in range(len(xy)):
        x, y = np.rint((xy[k, 0] - origin_x) / cell), np.rint((xy[k, 1] - origin_y) / cell)
        inside = x >= 0 and x < nx and y >= 0 and y < ny
        flat[k] = int(x) * ny + int(y) if inside else -1
    return flat


@numba.njit(cache=True)
@no_type_check
def _cell_statistics(points, sigma, flat, cells, min_points, upper, allowance, correlated, floor, steep):
    """Counting sort of the points by cell, then the statistics cell by cell."""
    counts = np.zeros(cells + 1, np.int64)
    for k in range(len(flat)):
        if flat[k] >= 0:
            counts[flat[k] + 1] += 1
    used = 0
    for c in range(cells):
        if counts[c + 1] >= min_points:
            used += 1
    starts = np.cumsum(counts)
    cursor = starts[:-1].copy()
    # One pass in the points' own order: reading them cell by cell would fetch each from a place of its own.
    heights = np.empty(starts[-1])
    sums = np.zeros((cells, 3))
    for k in range(len(flat)):
        c = flat[k]
        if c >= 0:
            heights[cursor[c]] = points[k, 2]
            cursor[c] += 1
            sums[c, 0] += points[k, 0]
            sums[c, 1] += points[k, 1]
            sums[c, 2] += 1.0 / (sigma[k] * sigma[k])
    index = np.empty(used, np.int64)
    height = np.empty(used)
    variance = np.empty(used)
    count = np.empty(used, np.int64)
    centroid = np.empty((used, 2))
    at = 0
    for c in range(cells):
        n = starts[c + 1] - starts[c]
        if n < min_points:
            continue
        z = heights[starts[c] : starts[c + 1]]
        z.sort()
        median = 0.5 * (z[(n - 1) // 2] + z[n // 2])
        # Of few points the quantile is the last but one: one stray point never decides.
        high = z[max(min(int(np.ceil(upper * n)) - 1, n - 2), n // 2)]
        point_variance = n / sums[c, 2]
        excess = max(high - median - allowance * np.sqrt(point_variance), 0.0)
        independent = max(n / correlated, 1.0)
        index[at] = c
        height[at] = median + excess
        variance[at] = point_variance / independent + floor * floor + (steep * excess) ** 2
        count[at] = n
        centroid[at, 0] = sums[c, 0] / n
        centroid[at, 1] = sums[c, 1] / n
        at += 1
    return index, height, variance, count, centroid
