"""A regular grid of heights over the world's x-y plane: the shape of both the true ground and the believed one.

Cells are addressed `[ix, iy]`: the first index runs along x. A height belongs to the cell's centre; between centres the
height is bilinear, so slope and normal are defined everywhere inside.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from athlete_twin.errors import TerrainError
from athlete_twin.geometry.arrays import Cells


@dataclass(frozen=True, eq=False, kw_only=True)
class HeightGrid:
    """Heights on a regular grid; NaN where unknown (the true ground has none)."""

    origin_x: float
    """x of the centre of cell [0, 0] [m]"""
    origin_y: float
    """y of the centre of cell [0, 0] [m]"""
    cell: float
    """edge of a cell [m]"""
    heights: Cells
    """height at each cell's centre, shape (nx, ny) [m]"""

    def __post_init__(self) -> None:
        if not (np.isfinite(self.cell) and self.cell > 0.0):
            raise TerrainError(f"cell size is {self.cell} m, must be positive")
        if self.heights.ndim != 2 or min(self.heights.shape) < 2:
            raise TerrainError(f"heights have shape {self.heights.shape}, need (nx, ny) with both at least 2")

    @property
    def shape(self) -> tuple[int, int]:
        """Cells along x and y."""
        return (int(self.heights.shape[0]), int(self.heights.shape[1]))

    def centres(self) -> tuple[np.ndarray, np.ndarray]:
        """Coordinates x and y of the cells' centres, shapes (nx,) and (ny,) [m]."""
        nx, ny = self.shape
        return self.origin_x + self.cell * np.arange(nx), self.origin_y + self.cell * np.arange(ny)

    def index(self, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Nearest cell of points (..., 2): ix, iy clipped to the grid, and whether the point was inside."""
        xy = np.asarray(xy, dtype=float)
        nx, ny = self.shape
        ix = np.rint((xy[..., 0] - self.origin_x) / self.cell).astype(np.int64)
        iy = np.rint((xy[..., 1] - self.origin_y) / self.cell).astype(np.int64)
        inside = (ix >= 0) & (ix < nx) & (iy >= 0) & (iy < ny)
        return np.clip(ix, 0, nx - 1), np.clip(iy, 0, ny - 1), inside

    def sample(self, xy: np.ndarray) -> np.ndarray:
        """Bilinear height under points (..., 2) [m]; clamped at the border, NaN next to unknown cells."""
        xy = np.asarray(xy, dtype=float)
        nx, ny = self.shape
        u = np.clip((xy[..., 0] - self.origin_x) / self.cell, 0.0, nx - 1 - 1e-9)
        v = np.clip((xy[..., 1] - self.origin_y) / self.cell, 0.0, ny - 1 - 1e-9)
        i, j = u.astype(np.int64), v.astype(np.int64)
        a, b = u - i, v - j
        h = self.heights
        low = h[i, j] * (1 - a) + h[i + 1, j] * a
        high = h[i, j + 1] * (1 - a) + h[i + 1, j + 1] * a
        return np.asarray(low * (1 - b) + high * b)

    def normal(self, xy: np.ndarray) -> np.ndarray:
        """Upward unit normal of the bilinear surface under points (..., 2), by central differences of one cell."""
        xy = np.asarray(xy, dtype=float)
        step = 0.5 * self.cell
        ex, ey = np.array([step, 0.0]), np.array([0.0, step])
        gx = (self.sample(xy + ex) - self.sample(xy - ex)) / (2 * step)
        gy = (self.sample(xy + ey) - self.sample(xy - ey)) / (2 * step)
        n = np.stack([-gx, -gy, np.ones_like(gx)], axis=-1)
        return np.asarray(n / np.linalg.norm(n, axis=-1, keepdims=True))
