"""SBL: a single-query, bi-directional sampling planner that checks edges only when a path hangs on them.

Place in the flow: swing (start and goal of a leg) -> SBL -> smoothing. The core is plain numpy so that one seed gives
one path; `sbl_ompl` puts it beside OMPL's planners, none of which is SBL.

Two trees of milestones grow from start and goal. A milestone is drawn from a random cell of a coarse grid over two
random joints, so that crowded regions are not preferred; a neighbour of it is sampled in a box that shrinks until a
collision-free one is found; the newest milestone is bridged to the nearest one of the other tree. Only then are the
edges of that start-to-goal path checked, coarse to fine, always the least certain edge first. A colliding edge is cut,
and the part beyond it changes to the other tree through the bridge: no milestone is lost.

Reference: Sanchez & Latombe 2003, as used by [SunSpiral2012] s3.4.1.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from athlete_twin.errors import PlanningError
from athlete_twin.geometry.arrays import LegJoints, LegPath
from planner.motion.checker import BudgetSpentError, CountingChecker, EdgeCheck, IsFree, told


@dataclass(frozen=True, kw_only=True)
class NoPath:
    """Why no path was found."""

    reason: str
    """short code, such as "start_collides", "goal_collides", "budget" """
    checks: int
    """configurations that were checked for collision"""
    detail: str = ""
    """what stood in the way, where known"""
    refused: Mapping[str, int] = field(default_factory=dict)
    """configurations that each check refused, by its name, such as "joint_limits", "own_leg", "terrain" """


@dataclass(frozen=True, kw_only=True)
class SblConfig:
    """Settings of SBL. Lengths named "of the box" are fractions of the sampling box's side."""

    neighbourhood: float = 0.2
    """largest step of a new milestone from its parent, of the box (KrisLibrary: 0.2)"""
    shrink_steps: int = 10
    """samples around one milestone, the i-th within neighbourhood / i (KrisLibrary: 10)"""
    cell: float = 0.1
    """edge of the cells that even out the density, of the box (KrisLibrary: 0.1)"""
    reproject_every: int = 50
    """new milestones after which the grid's two joints are drawn again (KrisLibrary: 50)"""
    connect_distance: float = math.inf
    """longest bridge tried between the trees, of the box (KrisLibrary: no limit)"""
    resolution: float = 0.01
    """an edge is safe once its checked points are no further apart [rad] ([SunSpiral2012] s3.4.1)"""
    max_checks: int = 20_000
    """collision checks after which the search gives up: about a second at 50 us a check"""

    def __post_init__(self) -> None:
        positive = (self.neighbourhood, self.cell, self.connect_distance, self.resolution)
        if not all(value > 0.0 for value in positive):
            raise PlanningError(f"neighbourhood, cell, connect_distance, resolution must be positive, got {positive}")
        if min(self.shrink_steps, self.reproject_every, self.max_checks) < 1:
            counts = (self.shrink_steps, self.reproject_every, self.max_checks)
            raise PlanningError(f"shrink_steps, reproject_every, max_checks must be at least 1, got {counts}")


def plan_sbl(
    start: LegJoints,
    goal: LegJoints,
    lower: LegJoints,
    upper: LegJoints,
    is_free: IsFree | CountingChecker,
    rng: np.random.Generator,
    config: SblConfig,
) -> LegPath | NoPath:
    """A path in joint space from start to goal, shape (k, dof) [rad], free at every `config.resolution`.

    Args:
        start: first configuration.
        goal: last configuration.
        lower: lower corner of the sampling box; start and goal lie inside.
        upper: upper corner.
        is_free: whether a configuration collides with nothing; a `CountingChecker` also tells why not.
        rng: all randomness comes from here.
        config: settings; `max_checks` bounds the calls of `is_free`.
    """
    check_problem(start, goal, lower, upper)
    checker = CountingChecker(is_free, config.max_checks, box=(lower, upper))
    try:
        if not checker(start):
            return no_path("start_collides", checker)
        if not checker(goal):
            return no_path("goal_collides", checker)
        return _Search(start, goal, lower, upper, checker, rng, config).run()
    except BudgetSpentError:
        return no_path("budget", checker, f"no path within {config.max_checks} checks")


def no_path(reason: str, checker: CountingChecker, detail: str = "") -> NoPath:
    """A refusal with the samples that each check refused, in its detail too."""
    detail = "; ".join(part for part in (detail, told(checker.refused)) if part)
    return NoPath(reason=reason, checks=checker.count, detail=detail, refused=dict(checker.refused))


def check_problem(start: np.ndarray, goal: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> None:
    """Refuse a planning problem whose shapes differ or whose ends lie outside the box."""
    shapes = {np.shape(a) for a in (start, goal, lower, upper)}
    if len(shapes) != 1 or len(next(iter(shapes))) != 1:
        raise PlanningError(f"start, goal, lower and upper need one shape (dof,), got {sorted(shapes)}")
    for name, q in (("start", start), ("goal", goal)):
        if not np.isfinite(q).all() or (q < lower).any() or (q > upper).any():
            box = f"{np.round(lower, 4)} to {np.round(upper, 4)}"
            raise PlanningError(f"{name} {np.round(q, 4)} is outside the box {box}")


class _Search:
    """Both trees. Milestones are numbered as they come, 0 the start, 1 the goal; `side` says whose tree one is in."""

    def __init__(
        self,
        start: np.ndarray,
        goal: np.ndarray,
        lower: np.ndarray,
        upper: np.ndarray,
        checker: CountingChecker,
        rng: np.random.Generator,
        config: SblConfig,
    ) -> None:
        self.lower, self.upper = np.asarray(lower, dtype=float), np.asarray(upper, dtype=float)
        self.scale = np.maximum(self.upper - self.lower, 1e-9)
        self.checker, self.rng, self.config = checker, rng, config
        dof = len(start)
        self.q = np.zeros((64, dof))
        self.side = np.zeros(64, dtype=np.int8)
        self.parent: list[int] = []
        self.children: list[list[int]] = []
        self.edge: list[EdgeCheck | None] = []
        """from a milestone to its parent; None at the roots"""
        self.grids: list[dict[tuple[int, ...], list[int]]] = [{}, {}]
        self.axes = np.arange(min(2, dof))
        self._draw_axes()
        self._add(np.asarray(start, dtype=float), side=0, parent=-1)
        self._add(np.asarray(goal, dtype=float), side=1, parent=-1)

    def run(self) -> np.ndarray | NoPath:
        """Grow and bridge until a path holds; the checker's budget ends an endless search."""
        path = self._bridge(0, 1)
        while path is None:
            newest = self._expand(int(self.rng.integers(2)))
            if len(self.parent) % self.config.reproject_every == 0:
                self._draw_axes()
            path = self._connect(newest)
        return path

    def _expand(self, side: int) -> int:
        """Number of a new milestone in one tree."""
        while True:
            grid = self.grids[side]
            cells = list(grid)
            cell = grid[cells[int(self.rng.integers(len(cells)))]]
            parent = cell[int(self.rng.integers(len(cell)))]
            centre = self.q[parent]
            for i in range(1, self.config.shrink_steps + 1):
                reach = self.config.neighbourhood / i * self.scale
                low, high = np.maximum(centre - reach, self.lower), np.minimum(centre + reach, self.upper)
                q = low + (high - low) * self.rng.random(len(centre))
                if self.checker(q):
                    return self._add(q, side=side, parent=parent)

    def _connect(self, newest: int) -> np.ndarray | None:
        """Bridge the newest milestone to the nearest one of the other tree, in the largest-joint metric of the box."""
        others = np.flatnonzero(self.side[: len(self.parent)] != self.side[newest])
        distance = np.max(np.abs(self.q[others] - self.q[newest]) / self.scale, axis=1)
        best = int(np.argmin(distance))
        if distance[best] > self.config.connect_distance:
            return None
        ends = (newest, int(others[best]))
        return self._bridge(*(ends if self.side[newest] == 0 else ends[::-1]))

    def _bridge(self, a: int, b: int) -> np.ndarray | None:
        """The path through a bridge from a (start's tree) to b (goal's tree) when all its edges hold."""
        bridge = EdgeCheck(self.q[a].copy(), self.q[b].copy())
        up, down = self._to_root(a), self._to_root(b)
        owners = [n for n in reversed(up) if self.parent[n] >= 0] + [-1] + [n for n in down if self.parent[n] >= 0]
        edges = [bridge if n < 0 else self._edge(n) for n in owners]
        heap = [(-e.spacing, i) for i, e in enumerate(edges) if e.spacing > self.config.resolution]
        heapq.heapify(heap)
        while heap:
            _, i = heapq.heappop(heap)
            if not edges[i].refine(self.checker):
                if owners[i] >= 0:
                    self._hand_over(owners[i], inner=a if self.side[owners[i]] == 0 else b, a=a, b=b, bridge=bridge)
                return None
            if edges[i].spacing > self.config.resolution:
                heapq.heappush(heap, (-edges[i].spacing, i))
        return self.q[list(reversed(up)) + down].copy()

    def _hand_over(self, cut: int, *, inner: int, a: int, b: int, bridge: EdgeCheck) -> None:
        """Cut the edge above `cut` and hang its subtree, turned over at `inner`, to the other tree by the bridge."""
        outer = b if inner == a else a
        self.children[self.parent[cut]].remove(cut)
        new_side = self.side[outer]
        stack = [cut]
        while stack:
            n = stack.pop()
            self.side[n] = new_side
            stack.extend(self.children[n])
        node, above, edge = inner, outer, bridge
        while True:
            old_parent, old_edge = self.parent[node], self.edge[node]
            self.parent[node], self.edge[node] = above, edge
            self.children[above].append(node)
            if node == cut:
                break
            assert old_edge is not None  # only roots have none, and a root is never below a cut
            self.children[old_parent].remove(node)
            node, above, edge = old_parent, node, old_edge
        self._fill_grids()

    def _add(self, q: np.ndarray, *, side: int, parent: int) -> int:
        n = len(self.parent)
        if n == len(self.q):
            self.q = np.concatenate([self.q, np.zeros_like(self.q)])
            self.side = np.concatenate([self.side, np.zeros_like(self.side)])
        self.q[n], self.side[n] = q, side
        self.parent.append(parent)
        self.children.append([])
        self.edge.append(EdgeCheck(self.q[parent].copy(), q) if parent >= 0 else None)
        if parent >= 0:
            self.children[parent].append(n)
        self.grids[side].setdefault(self._cell(n), []).append(n)
        return n

    def _edge(self, n: int) -> EdgeCheck:
        edge = self.edge[n]
        assert edge is not None  # asked only of milestones with a parent
        return edge

    def _to_root(self, n: int) -> list[int]:
        chain = [n]
        while self.parent[chain[-1]] >= 0:
            chain.append(self.parent[chain[-1]])
        return chain

    def _cell(self, n: int) -> tuple[int, ...]:
        axes = self.axes
        unit = (self.q[n, axes] - self.lower[axes]) / self.scale[axes]
        return tuple(int(u) for u in np.floor(unit / self.config.cell))

    def _draw_axes(self) -> None:
        dof = self.q.shape[1]
        self.axes = np.sort(self.rng.permutation(dof)[: min(2, dof)])
        self._fill_grids()

    def _fill_grids(self) -> None:
        self.grids = [{}, {}]
        for n in range(len(self.parent)):
            self.grids[int(self.side[n])].setdefault(self._cell(n), []).append(n)
