"""Where the ground may lie in its own shadow: what the sun surely sees needs no shadow ray.

The shadow's upper edge over each cell is the highest line to the sun from any ground before it: a surface of height
max_s h(x + s u) - s tan(elevation), u pointing to the sun in plan. It is found once a terrain by doubling: the edge after
steps of 1, 2, 4, ... cells. Cells take the highest of their neighbourhood, so that the edge is never too low, and where
the ground is steeper than the sun stands, which alone can shade what is nearer than a cell and a half, it is infinite. Rays are
then cast for points below the edge alone, and what they answer is as exact as before.
"""

from __future__ import annotations

from typing import no_type_check

import numba
import numpy as np
from scipy import ndimage

from athlete_twin.geometry.arrays import Vec3
from athlete_twin.geometry.grid import HeightGrid

MARGIN = 0.002
"""above the edge below which a point is still asked about [m]"""
SUN_ALLOWANCE = 0.002
"""by which the edge of the sun's drawn disc may stand lower than its middle [rad]"""
STEEPEST = float(np.deg2rad(85.0))
"""sun above which shadows are as short as the grid is coarse: nothing is left out there [rad]"""


class SunCover:
    """The upper edge of the ground's own shadow, and whether a point may lie below it."""

    def __init__(self, ground: HeightGrid, beyond: np.ndarray, sun_in_world: Vec3) -> None:
        """Finds the edge.

        Args:
            ground: true surface.
            beyond: corners of the triangles beyond the grid's border, shape (m, 3, 3) [m].
            sun_in_world: unit vector towards the sun.
        """
        self._ground = ground
        plan = float(np.hypot(sun_in_world[0], sun_in_world[1]))
        elevation = float(np.arctan2(sun_in_world[2], plan))
        self.edge: np.ndarray | None = None
        """height below which a point of the grid may be in shadow, shape (nx, ny), float32 [m]; None without one"""
        if SUN_ALLOWANCE < elevation < STEEPEST:
            slope = float(np.tan(elevation - SUN_ALLOWANCE))
            highest = float(np.max(_height_at_border(ground, beyond, slope), initial=-np.inf))
            self.edge = self._found(sun_in_world[:2] / plan, slope, highest).astype(np.float32)

    def may_shade(self, points: np.ndarray) -> np.ndarray:
        """Whether each point may be shaded by the ground; always true outside the grid.

        Args:
            points: shape (n, 3 or more); what stands beyond the third column is not looked at [m].
        """
        if self.edge is None:
            return np.ones(len(points), dtype=bool)
        g = self._ground
        may: np.ndarray = _below(points, self.edge, g.origin_x, g.origin_y, g.cell, MARGIN)
        return may

    def _found(self, to_sun: np.ndarray, slope: float, highest: float) -> np.ndarray:
        g = self._ground
        # A point between cells, and one a rounding off, is covered by the highest of the cells around it.
        high = ndimage.maximum_filter(g.heights, size=5, mode="nearest")
        along, across = (0, 1) if abs(to_sun[0]) >= abs(to_sun[1]) else (1, 0)
        sign = int(np.sign(to_sun[along]))
        lean = float(to_sun[across] / abs(to_sun[along]))
        fall = slope * g.cell * float(np.hypot(1.0, lean))
        edge = np.full(high.shape, -np.inf)
        step, reached = 1, high - 0.0
        rows = high.shape[along]
        # `reached` is the edge of all ground from 0 to `step` - 1 cells towards the sun; beyond the border all may stand.
        while step < rows:
            moved = _towards(reached, step, sign, lean, along) - step * fall
            reached = np.maximum(reached, moved)
            step *= 2
        edge = _towards(reached, 1, sign, lean, along) - fall
        from_border = _steps_to_border(high.shape, sign, along, across, lean)
        edge = np.maximum(edge, highest - from_border * fall)
        return np.where(_steep(g, slope), np.inf, edge)


@no_type_check
@numba.njit(nogil=True, cache=True)
def _below(points, edge, origin_x, origin_y, cell, margin):  # type: ignore[no-untyped-def]
    out = np.ones(points.shape[0], dtype=np.bool_)
    for i in range(points.shape[0]):
        ix, iy = int(np.rint((points[i, 0] - origin_x) / cell)), int(np.rint((points[i, 1] - origin_y) / cell))
        if 0 <= ix < edge.shape[0] and 0 <= iy < edge.shape[1]:
            out[i] = points[i, 2] < edge[ix, iy] + margin
    return out


def _steep(ground: HeightGrid, slope: float) -> np.ndarray:
    """Cells with ground in their surroundings that may rise towards the sun as steeply as it stands, shape (nx, ny)."""
    rise_x = np.zeros(ground.shape)
    rise_y = np.zeros(ground.shape)
    rise_x[1:] = np.abs(np.diff(ground.heights, axis=0))
    rise_y[:, 1:] = np.abs(np.diff(ground.heights, axis=1))
    rise = np.hypot(ndimage.maximum_filter(rise_x, 5), ndimage.maximum_filter(rise_y, 5))
    return np.asarray(rise > 0.95 * slope * ground.cell)


def _height_at_border(ground: HeightGrid, beyond: np.ndarray, slope: float) -> np.ndarray:
    """How high a wall on the border would throw the shadow that each triangle beyond it can throw inside, shape (m,) [m]."""
    x, y = ground.centres()
    out_x = np.maximum(np.maximum(x[0] - beyond[..., 0], beyond[..., 0] - x[-1]), 0.0)
    out_y = np.maximum(np.maximum(y[0] - beyond[..., 1], beyond[..., 1] - y[-1]), 0.0)
    # A triangle that spans a corner of the border comes a little nearer to it than its own corners do.
    nearest = 0.9 * np.hypot(out_x, out_y).min(axis=1)
    return np.asarray(beyond[..., 2].max(axis=1) - nearest * slope)


def _towards(surface: np.ndarray, cells: int, sign: int, lean: float, along: int) -> np.ndarray:
    """For every cell the highest value `cells` cells nearer to the sun, and beside that by one more for its lean."""
    shift = cells * lean
    low = int(np.floor(shift))
    out = np.full(surface.shape, -np.inf)
    for side in (low, low + 1):
        moved = _shifted(_shifted(surface, sign * cells, along), side, 1 - along)
        out = np.maximum(out, moved)
    return out


def _shifted(surface: np.ndarray, cells: int, axis: int) -> np.ndarray:
    """`surface[i + cells]` along an axis, minus infinity outside."""
    out = np.full(surface.shape, -np.inf)
    n = surface.shape[axis]
    if abs(cells) >= n:
        return out
    source, target = [slice(None)] * 2, [slice(None)] * 2
    source[axis] = slice(max(cells, 0), n + min(cells, 0))
    target[axis] = slice(max(-cells, 0), n + min(-cells, 0))
    out[tuple(target)] = surface[tuple(source)]
    return out


def _steps_to_border(shape: tuple[int, ...], sign: int, along: int, across: int, lean: float) -> np.ndarray:
    """Cells that lie between each cell and the grid's border towards the sun, by the main axis of that way."""
    index = np.indices(shape)
    main = shape[along] - 1 - index[along] if sign > 0 else index[along]
    if lean == 0.0:
        return np.asarray(main, dtype=float)
    side = shape[across] - 1 - index[across] if lean > 0.0 else index[across]
    return np.asarray(np.minimum(main, side / abs(lean)), dtype=float)
