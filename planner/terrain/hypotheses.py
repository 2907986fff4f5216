"""What views say of a cell -> the height that is believed, and the one that contradicts it.

Model: two hypotheses a cell, each a scalar Kalman filter with a trust that counts the views that agreed with it. A view
within the gate of the believed height sharpens it. One outside feeds the challenger and takes from the trust; a
challenger that is trusted as much takes over. So a piece of a leg seen once is gone after one clean view, ground that
was seen often survives a piece of a leg, and views that contradict the ground *and each other* never add up.

Evidence also comes from rays: one that reached ground behind a cell's top has passed through it, so what stood there is
not there. Cells that a view measured are left to the measurement. A hypothesis without trust is forgotten, and the cell
is unknown again where there is no other.

All arrays are flat, `ix * ny + iy`; the functions change them in place.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import no_type_check

import numba
import numpy as np

from planner.terrain.elevation import CellHeights, GridLayout


@dataclass(eq=False, kw_only=True)
class CellStates:
    """The state of all cells."""

    height: np.ndarray
    """believed, NaN where unknown [m]"""
    variance: np.ndarray
    """of what averaging removes, infinite where unknown [m2]"""
    trust: np.ndarray
    """views that agreed, less those that did not"""
    count: np.ndarray
    """views that measured the cell, 0 where unknown"""
    seen: np.ndarray
    """when the cell was last measured, minus infinity where unknown [s]"""
    other_height: np.ndarray
    """the challenger, NaN where there is none [m]"""
    other_variance: np.ndarray
    other_trust: np.ndarray

    @staticmethod
    def empty(cells: int) -> CellStates:
        """Nothing known."""
        return CellStates(
            height=np.full(cells, np.nan), variance=np.full(cells, np.inf), trust=np.zeros(cells, dtype=np.int64),
            count=np.zeros(cells, dtype=np.int64), seen=np.full(cells, -np.inf), other_height=np.full(cells, np.nan),
            other_variance=np.full(cells, np.inf), other_trust=np.zeros(cells, dtype=np.int64),
        )  # fmt: skip

    def moved(self, before: GridLayout, after: GridLayout) -> CellStates:
        """The same cells under another layout of the same cell size; what falls outside is forgotten."""
        dx = round((after.origin_x - before.origin_x) / before.cell)
        dy = round((after.origin_y - before.origin_y) / before.cell)
        out = CellStates.empty(after.nx * after.ny)
        old_x, old_y = slice(max(dx, 0), min(after.nx + dx, before.nx)), slice(max(dy, 0), min(after.ny + dy, before.ny))
        if old_x.start >= old_x.stop or old_y.start >= old_y.stop:
            return out
        new_x, new_y = slice(old_x.start - dx, old_x.stop - dx), slice(old_y.start - dy, old_y.stop - dy)
        for name, values in vars(self).items():
            there = getattr(out, name).reshape(after.nx, after.ny)
            there[new_x, new_y] = values.reshape(before.nx, before.ny)[old_x, old_y]
        return out


def take_in(
    state: CellStates, cells: CellHeights, *, t: float, gate_sigma: float, gate_floor: float, drift_variance: float,
    trust_limit: int,
) -> None:  # fmt: skip
    """Update the cells that one view measured.

    Args:
        state: changed in place.
        cells: what the view says.
        t: of the view [s].
        gate_sigma: differences beyond so many sigma contradict.
        gate_floor: and beyond so much [m].
        drift_variance: added to a hypothesis between two views [m2].
        trust_limit: no hypothesis is trusted more.
    """
    _take_in(
        cells.index, cells.height, cells.variance, t, gate_sigma, gate_floor, drift_variance, trust_limit,
        state.height, state.variance, state.trust, state.count, state.seen,
        state.other_height, state.other_variance, state.other_trust,
    )  # fmt: skip


def pass_through(
    state: CellStates, origin: np.ndarray, points: np.ndarray, measured: np.ndarray, *, layout: GridLayout,
    margin: float, gate_sigma: float, least_rays: int,
) -> int:  # fmt: skip
    """Take trust from cells that rays passed below the top of; how many cells lost some.

    Args:
        state: changed in place.
        origin: of the rays, in world, shape (3,) [m].
        points: that they reached, shape (n, 3) [m].
        measured: flat indices of cells that the same view measured: they are left alone.
        layout: the cells.
        margin: a ray counts when it passes so far below the believed height [m].
        gate_sigma: and so many sigma, these at most twice the margin.
        least_rays: fewer are chance.
    """
    if len(points) == 0 or not np.isfinite(state.height).any():
        return 0
    top = float(np.nanmax(state.height))
    return int(
        _pass_through(
            np.asarray(origin, dtype=np.float64), np.ascontiguousarray(points), measured, top, layout.origin_x,
            layout.origin_y, layout.cell, layout.nx, layout.ny, margin, gate_sigma, least_rays,
            state.height, state.variance, state.trust, state.count, state.seen,
            state.other_height, state.other_variance, state.other_trust,
        )
    )  # fmt: skip


@numba.njit(cache=True)
@no_type_check
def _take_in(index, zs, vs, t, gate_sigma, floor, drift, limit, height, variance, trust, count, seen, other_h, other_v, other_t):
    for k in range(len(index)):
        c = index[k]
        z, v = zs[k], vs[k]
        if not (np.isfinite(z) and v > 0.0 and np.isfinite(v)):
            continue
        seen[c] = max(t, seen[c])
        count[c] += 1
        if not np.isfinite(height[c]):
            height[c], variance[c], trust[c] = z, v, 1
            continue
        prior = variance[c] + drift
        if abs(z - height[c]) <= max(gate_sigma * np.sqrt(prior + v), floor):
            gain = prior / (prior + v)
            height[c] += gain * (z - height[c])
            variance[c] = (1.0 - gain) * prior
            trust[c] = min(trust[c] + 1, limit)
            other_t[c] -= 1
            if other_t[c] <= 0:
                other_h[c], other_v[c], other_t[c] = np.nan, np.inf, 0
            continue
        trust[c] -= 1
        prior = other_v[c] + drift
        if other_t[c] > 0 and abs(z - other_h[c]) <= max(gate_sigma * np.sqrt(prior + v), floor):
            gain = prior / (prior + v)
            other_h[c] += gain * (z - other_h[c])
            other_v[c] = (1.0 - gain) * prior
            other_t[c] = min(other_t[c] + 1, limit)
        else:
            other_t[c] -= 1
            if other_t[c] <= 0:
                other_h[c], other_v[c], other_t[c] = z, v, 1
        if other_t[c] >= trust[c]:
            h, s, n = height[c], variance[c], trust[c]
            height[c], variance[c], trust[c] = other_h[c], other_v[c], other_t[c]
            if n > 0:
                other_h[c], other_v[c], other_t[c] = h, s, n
            else:
                other_h[c], other_v[c], other_t[c] = np.nan, np.inf, 0


@numba.njit(cache=True)
@no_type_check
def _pass_through(
    origin, points, measured, top, x0, y0, cell, nx, ny, margin, gate, least,
    height, variance, trust, count, seen, other_h, other_v, other_t,
):  # fmt: skip
    hits = np.zeros(nx * ny, np.int32)
    for k in range(len(points)):
        dx, dy, dz = origin[0] - points[k, 0], origin[1] - points[k, 1], origin[2] - points[k, 2]
        flat = np.sqrt(dx * dx + dy * dy)
        if dz <= 0.0 or flat < 1e-6:
            continue
        # From two cells before the end, where the surface itself begins, up to where nothing stands.
        step = 0.5 * cell / flat
        s = 2.0 * cell / flat
        last = -1
        while s < 1.0:
            z = points[k, 2] + s * dz
            if z > top:
                break
            u = (points[k, 0] + s * dx - x0) / cell
            v = (points[k, 1] + s * dy - y0) / cell
            ix, iy = int(np.rint(u)), int(np.rint(v))
            s += step
            if ix < 0 or iy < 0 or ix >= nx or iy >= ny or abs(u - ix) > 0.35 or abs(v - iy) > 0.35:
                continue
            c = ix * ny + iy
            if c == last:
                continue
            last = c
            # A steep cell's wide variance does not shield it: it says where in the cell the rock stands, not how high.
            if height[c] - z > margin + min(gate * np.sqrt(variance[c]), 2.0 * margin):
                hits[c] += 1
    for c in measured:
        hits[c] = 0
    lost = 0
    for c in range(nx * ny):
        if hits[c] < least:
            continue
        lost += 1
        trust[c] -= 1
        if trust[c] > 0:
            continue
        if other_t[c] > 0:
            height[c], variance[c], trust[c] = other_h[c], other_v[c], other_t[c]
        else:
            height[c], variance[c], trust[c], count[c], seen[c] = np.nan, np.inf, 0, 0, -np.inf
        other_h[c], other_v[c], other_t[c] = np.nan, np.inf, 0
    return lost
