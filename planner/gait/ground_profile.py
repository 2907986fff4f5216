"""A ground that changes along the heading only: level stretches with edges between, such as a ledge, a ditch or a wall.

Place in the flow: what `stepping` plans over. Wheels stand on the level stretches that may be stood on, off their edges.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from athlete_twin.errors import PlanningError
from athlete_twin.geometry.grid import HeightGrid

EDGE = 0.6
"""of a wheel's radius that its axle keeps behind an edge that falls off: half its patch and what it may slip"""
WALL_GAP = 0.1
"""between a wheel and a face that rises beside it [m]"""
CELL, SIDE, MARGIN = 0.05, 7.0, 9.0
"""of the ground as heights: cells, half its width, and how far it goes on before and behind [m]"""


@dataclass(frozen=True, eq=False, kw_only=True)
class Profile:
    """Level stretches along x, first to last."""

    name: str
    edges: np.ndarray
    """where one stretch ends and the next begins, ascending, shape (n - 1,) [m]"""
    heights: np.ndarray
    """of the stretches, shape (n,) [m]"""
    firm: np.ndarray
    """which of them wheels may stand on, shape (n,)"""

    def __post_init__(self) -> None:
        if not (len(self.heights) == len(self.firm) == len(self.edges) + 1 and (np.diff(self.edges) > 0.0).all()):
            raise PlanningError(f"{len(self.heights)} stretches need {len(self.heights) - 1} ascending edges, got {self.edges}")
        if not (np.isfinite(self.heights).all() and np.isfinite(self.edges).all() and self.firm[0] and self.firm[-1]):
            raise PlanningError("heights and edges must be finite, and the first and last stretch firm")

    def height(self, x: np.ndarray | float) -> np.ndarray:
        """Of the ground [m]."""
        return np.asarray(self.heights[np.searchsorted(self.edges, x, side="right")])

    def top(self, low: float, high: float) -> float:
        """Highest ground between two places [m]."""
        first, last = np.searchsorted(self.edges, [low, high], side="right")
        return float(self.heights[first : last + 1].max())

    def footholds(self, wheel_radius: float) -> np.ndarray:
        """Where axles may stand: rows of begin and end, shape (k, 2) [m]."""
        ends = np.concatenate([[-np.inf], self.edges, [np.inf]])
        out = []
        for i in np.flatnonzero(self.firm):
            low, high = ends[i], ends[i + 1]
            if i > 0:
                low += wheel_radius + WALL_GAP if self.heights[i - 1] > self.heights[i] else EDGE * wheel_radius
            if i + 1 < len(self.heights):
                high -= wheel_radius + WALL_GAP if self.heights[i + 1] > self.heights[i] else EDGE * wheel_radius
            if low <= high:
                out.append((low, high))
        return np.array(out)

    def grid(self) -> HeightGrid:
        """As heights over x and y."""
        x = np.arange(self.edges[0] - MARGIN, self.edges[-1] + MARGIN, CELL)
        wide = np.repeat(self.height(x)[:, None], round(2 * SIDE / CELL) + 1, axis=1)
        return HeightGrid(origin_x=float(x[0]), origin_y=-SIDE, cell=CELL, heights=wide)


def ledge(height: float) -> Profile:
    """The ground goes on higher (or lower) from x = 0 on."""
    return Profile(
        name=f"a ledge of {height:.2f} m", edges=np.array([0.0]), heights=np.array([0.0, height]), firm=np.array([True, True])
    )


def ditch(width: float, depth: float = 1.0) -> Profile:
    """A gap from x = 0 on in which no wheel stands."""
    return Profile(
        name=f"a ditch of {width:.2f} m", edges=np.array([0.0, width]), heights=np.array([0.0, -depth, 0.0]),
        firm=np.array([True, False, True]),
    )  # fmt: skip


def wall(height: float, thickness: float = 0.4) -> Profile:
    """A rock across the way from x = 0 on, on which no wheel stands."""
    return Profile(
        name=f"a wall of {height:.2f} m", edges=np.array([0.0, thickness]), heights=np.array([0.0, height, 0.0]),
        firm=np.array([True, False, True]),
    )  # fmt: skip
