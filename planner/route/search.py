"""The cheapest way over the places: where to, on foot or on wheels, and how long it takes; or why there is none.

`Places` -> `Route | NoRoute`. Dijkstra of SciPy over two layers of the same grid, one on foot and one on wheels; starting
to drive costs its own seconds, so short hops on wheels are not worth it. Edges go to the sixteen nearest neighbours (grid
bias at most 2.8 %), and what they find is pulled straight as far as the ground allows it. Time grows as n log n with
the number of places.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph

from athlete_twin.errors import PlanningError
from athlete_twin.geometry.arrays import Points2, Vec2
from planner.route.places import REASONS, Places

NEIGHBOURS = ((1, 0), (0, 1), (1, 1), (1, -1), (2, 1), (1, 2), (2, -1), (1, -2))
"""one of each pair of opposite edges"""
LONGEST_PULL = 60
"""places that are pulled straight at once"""
SAMPLE = 0.25
"""of a cell, between samples of a straight piece's pace"""


@dataclass(frozen=True, eq=False, kw_only=True)
class Route:
    """A polyline to the goal."""

    points: Points2
    """start first, goal last, shape (k + 1, 2) [m]"""
    modes: tuple[str, ...]
    """"walk" or "drive", one a piece"""
    seconds: tuple[float, ...]
    """foreseen for each piece; every piece on wheels holds what starting it costs: wheels are steered anew at each bend"""

    @property
    def cost(self) -> float:
        """Foreseen for all of it [s]."""
        return float(sum(self.seconds))

    @property
    def lengths(self) -> np.ndarray:
        """Of the pieces [m]."""
        return np.asarray(np.linalg.norm(np.diff(self.points, axis=0), axis=1))

    @property
    def length(self) -> float:
        """Of the whole [m]."""
        return float(self.lengths.sum())

    def point_at(self, distance: float) -> Vec2:
        """The point so far along the route, the goal beyond its end [m]."""
        reached = np.concatenate([[0.0], np.cumsum(self.lengths)])
        return np.array([np.interp(distance, reached, self.points[:, axis]) for axis in (0, 1)])

    def heading(self, ahead: float) -> Vec2:
        """Unit vector from the start to the point so far along the route."""
        way = self.point_at(ahead) - self.points[0]
        return np.asarray(way / np.linalg.norm(way))


@dataclass(frozen=True, kw_only=True)
class NoRoute:
    """Nothing leads there, as the map has it."""

    reason: str


def find_route(ground: Places, start: Vec2, goal: Vec2) -> Route | NoRoute:
    """The cheapest route from the chassis' place to the goal.

    Args:
        ground: paces.
        start: where the chassis is [m].
        goal: [m]

    Raises:
        PlanningError: a start or goal that is not finite or off the grid, or a way of no length.
    """
    start, goal = np.asarray(start, dtype=float), np.asarray(goal, dtype=float)
    _check(ground, start=start, goal=goal)
    if float(np.linalg.norm(goal - start)) < 1e-9:
        raise PlanningError(f"the route from {start} to {goal} m has no length: a goal elsewhere would do")
    ny, count = ground.shape[1], ground.walk.size
    first, last = (int(ix) * ny + int(iy) for ix, iy in map(ground.index, (start, goal)))
    if not np.isfinite(ground.walk.ravel()[last]):
        return NoRoute(reason=f"the goal's place is refused: {ground.why(goal)}")
    if not np.isfinite(ground.walk.ravel()[first]):
        return NoRoute(reason=f"the start's place is refused: {ground.why(start)}")
    distances, before = csgraph.dijkstra(time_graph(ground), indices=first, return_predecessors=True)
    end = last if distances[last] <= distances[count + last] else count + last
    if not np.isfinite(distances[end]):
        shut = ", ".join(f"{REASONS[k]}: {int(n)}" for k, n in enumerate(np.bincount(ground.refusal.ravel())) if k and n)
        return NoRoute(reason=f"refused places shut the goal off ({shut}, of {count})")
    nodes = [end]
    while nodes[-1] != first:
        nodes.append(int(before[nodes[-1]]))
    return _straightened(ground, _runs(ground, nodes[::-1]), start, goal)


def _check(ground: Places, **points: np.ndarray) -> None:
    for name, point in points.items():
        if point.shape != (2,) or not np.isfinite(point).all():
            raise PlanningError(f"the route's {name} is {point}, need two finite lengths [m]")
        off = (point - ground.origin) / ground.cell
        if (off < -0.5).any() or (off > np.array(ground.shape) - 0.5).any():
            far = ground.origin + ground.cell * (np.array(ground.shape) - 1)
            raise PlanningError(f"the route's {name} {point} m is off the places from {ground.origin} to {far} m")


def time_graph(ground: Places) -> sparse.csr_array:
    """Seconds of every edge: walking nodes first, then driving nodes, both in C order; starting a drive leads from one to the other."""
    (nx, ny), count = ground.shape, ground.walk.size
    number = np.arange(count).reshape(nx, ny)
    rows, columns, seconds = [], [], []
    for layer, pace in ((0, ground.walk), (count, ground.drive)):
        for dx, dy in NEIGHBOURS:
            a, b = _ends(nx, ny, dx, dy)
            mean = 0.5 * (pace[a] + pace[b])
            if max(dx, abs(dy)) == 2:
                # Between its ends such an edge passes between two other places.
                sides = [_shifted(a, *s) for s in _beside(dx, dy)]
                mean = 0.5 * mean + 0.25 * (pace[sides[0]] + pace[sides[1]])
            open_ = np.isfinite(mean)
            length = ground.cell * float(np.hypot(dx, dy))
            rows.append(layer + number[a][open_])
            columns.append(layer + number[b][open_])
            seconds.append(length * mean[open_])
    one, other, time = np.concatenate(rows), np.concatenate(columns), np.concatenate(seconds)
    both = number[np.isfinite(ground.walk) & np.isfinite(ground.drive)]
    # Stopping costs nothing, but an explicit zero is no edge to a sparse graph.
    free, begin = np.full(len(both), 1e-9), np.full(len(both), max(ground.drive_start, 1e-9))
    return sparse.csr_array(
        (
            np.concatenate([time, time, begin, free]),
            (np.concatenate([one, other, both, count + both]), np.concatenate([other, one, count + both, both])),
        ),
        shape=(2 * count, 2 * count),
    )


def _ends(nx: int, ny: int, dx: int, dy: int) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """Where an edge may begin, and where it then ends."""
    low = max(0, -dy)
    return (slice(0, nx - dx), slice(low, ny - max(dy, 0))), (slice(dx, nx), slice(low + dy, ny - max(dy, 0) + dy))


def _beside(dx: int, dy: int) -> tuple[tuple[int, int], tuple[int, int]]:
    sign = int(np.sign(dy))
    return ((1, 0), (1, sign)) if dx == 2 else ((0, sign), (1, sign))


def _shifted(at: tuple[slice, slice], dx: int, dy: int) -> tuple[slice, slice]:
    return slice(at[0].start + dx, at[0].stop + dx), slice(at[1].start + dy, at[1].stop + dy)


def _runs(ground: Places, nodes: Sequence[int]) -> list[tuple[str, np.ndarray]]:
    """The path as runs of one mode: mode and places (k, 2) [m]; a run begins where the one before ends."""
    count = ground.walk.size
    runs: list[tuple[str, list[int]]] = []
    for a, b in pairwise(nodes):
        if (a < count) != (b < count):
            continue
        mode = "walk" if a < count else "drive"
        if not runs or runs[-1][0] != mode:
            runs.append((mode, [a % count]))
        runs[-1][1].append(b % count)
    return [(mode, ground.xy(*np.unravel_index(np.array(at), ground.shape))) for mode, at in runs]


def _straightened(ground: Places, runs: list[tuple[str, np.ndarray]], start: Vec2, goal: Vec2) -> Route:
    """The runs pulled straight, beginning and ending exactly at start and goal."""
    points, modes, seconds = [start], [], []
    if not runs:  # start and goal share a place
        runs = [("walk", np.array([start, goal]))]
    runs[0][1][0], runs[-1][1][-1] = start, goal
    for mode, way in runs:
        pace = ground.walk if mode == "walk" else ground.drive
        # What the first pass cuts at its longest the second joins.
        kept, times = _pulled(ground, pace, way)
        kept, times = _pulled(ground, pace, kept, times)
        points += list(kept[1:])
        modes += [mode] * len(times)
        seconds += [float(t) + (ground.drive_start if mode == "drive" else 0.0) for t in times]
    return Route(points=np.array(points), modes=tuple(modes), seconds=tuple(seconds))


def _pulled(
    ground: Places, pace: np.ndarray, way: Points2, times: Sequence[float] | None = None
) -> tuple[Points2, list[float]]:
    """The way with every point left out that a straight piece does without at no more cost, and the pieces' seconds."""
    if times is None:
        times = [_line(ground, pace, a, b, edge=True) for a, b in pairwise(way)]
    along = np.concatenate([[0.0], np.cumsum(times)])
    kept, out, at = [0], [], 0
    while at < len(way) - 1:
        to, time = at + 1, float(times[at])
        for further in range(min(len(way) - 1, at + LONGEST_PULL), at + 1, -1):
            direct = _line(ground, pace, way[at], way[further])
            if direct <= along[further] - along[at] + 1e-9:
                to, time = further, direct
                break
        kept.append(to)
        out.append(time)
        at = to
    return np.asarray(way[kept]), out


def _line(ground: Places, pace: np.ndarray, a: np.ndarray, b: np.ndarray, *, edge: bool = False) -> float:
    """Seconds of a straight piece, by the paces of the places it passes; of an edge of the graph a refused corner is left out."""
    length = float(np.linalg.norm(b - a))
    n = max(2, int(np.ceil(length / (SAMPLE * ground.cell))))
    ix, iy = ground.index(a + ((np.arange(n) + 0.5) / n)[:, None] * (b - a))
    passed = pace[ix, iy]
    if edge and np.isfinite(passed).any():
        passed = passed[np.isfinite(passed)]
    return length * float(passed.mean())
