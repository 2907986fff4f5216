"""Shorter paths: Dijkstra over all free shortcuts, then bisection for new nodes, until the length stops improving.

Place in the flow: SBL -> smoothing -> swing. Sampled paths are feasible and jerky; this keeps the ends, checks every
new edge to the planner's resolution and can only shorten; the finished path is looked at once more, finely.
Reference: [SunSpiral2012] s3.4.2, figure 4.
"""

from __future__ import annotations

import heapq
import itertools
from dataclasses import dataclass

import numpy as np

from athlete_twin.errors import PlanningError
from athlete_twin.geometry.arrays import LegPath
from planner.motion.checker import CountingChecker, EdgeCheck, IsFree


@dataclass(frozen=True, kw_only=True)
class SmoothingConfig:
    """Settings of the shortcut-and-bisect smoother."""

    resolution: float = 0.01
    """of edge checks [rad] ([SunSpiral2012] s3.4.1)"""
    fine_resolution: float = 0.002
    """of the last check of the finished path [rad]: what is thinner than `resolution` may hide from all checks before"""
    min_improvement: float = 0.01
    """relative gain in length of one round below which the rounds end"""
    max_rounds: int = 8
    """each round doubles the nodes at most; gains fade after three or four"""
    max_nodes: int = 48
    """edges tried grow with the square of the nodes: a path with more is not bisected further"""

    def __post_init__(self) -> None:
        positive = min(self.resolution, self.fine_resolution) > 0.0 and self.min_improvement >= 0.0
        if not (positive and self.max_rounds >= 1 and self.max_nodes >= 2):
            raise PlanningError(f"smoothing needs positive settings, got {self}")


@dataclass(frozen=True, eq=False, kw_only=True)
class SmoothPath:
    """A smoothed path and what it took."""

    waypoints: LegPath
    """shape (k, dof) [rad]"""
    lengths: tuple[float, ...]
    """joint-space length before, and after each round [rad]"""
    checks: int
    """configurations checked for collision"""
    confirmed: bool = True
    """whether the finished path is free at the fine resolution; if not, it is the one given, and no way through its nodes is"""


def smooth(path: LegPath, is_free: IsFree, config: SmoothingConfig) -> SmoothPath:
    """The path with needless nodes left out, ends kept. Edges of `path` itself are taken to be free already."""
    nodes = np.asarray(path, dtype=float)
    if nodes.ndim != 2 or len(nodes) < 2 or not np.isfinite(nodes).all():
        raise PlanningError(f"a path needs finite shape (k, dof) with k >= 2, got {nodes.shape}")
    edges = _Edges(CountingChecker(is_free), config.resolution)
    for a, b in itertools.pairwise(nodes):
        edges.trust(a, b)
    lengths = [path_length(nodes)]
    pool = nodes
    for round_ in range(config.max_rounds):
        shortest = _shortest(pool, edges)
        assert shortest is not None  # the path given is one
        nodes = shortest
        lengths.append(path_length(nodes))
        gain = lengths[-2] - lengths[-1]
        # The first round only drops nodes of the raw path: the bisection after it may gain where it could not.
        if len(nodes) == 2 or 2 * len(nodes) - 1 > config.max_nodes:
            break
        if round_ > 0 and gain <= config.min_improvement * lengths[-2]:
            break
        if round_ < config.max_rounds - 1:
            pool = _bisected(nodes, edges)
    finished = _confirmed(nodes, (pool, _bisected(np.asarray(path, dtype=float), edges)), edges, config.fine_resolution)
    return SmoothPath(
        waypoints=_without_straight(np.asarray(path, dtype=float) if finished is None else finished),
        lengths=tuple(lengths),
        checks=edges.checker.count,
        confirmed=finished is not None,
    )


def _confirmed(
    nodes: np.ndarray, pools: tuple[np.ndarray, ...], edges: _Edges, resolution: float
) -> np.ndarray | None:
    """The path, or the shortest other one through the nodes it came from, free at a fine resolution; None where there is none."""
    if edges.confirm(nodes, resolution):
        return nodes
    for pool in pools:
        while (found := _shortest(pool, edges)) is not None:
            if edges.confirm(found, resolution):
                return found
    return None


def path_length(path: LegPath) -> float:
    """Euclidean length in joint space [rad]."""
    return float(np.sum(np.linalg.norm(np.diff(path, axis=0), axis=1)))


class _Edges:
    """Whether straight edges are free, each checked once."""

    def __init__(self, checker: CountingChecker, resolution: float) -> None:
        self.checker = checker
        self._resolution = resolution
        self._known: dict[tuple[bytes, bytes], bool] = {}
        self._fine: dict[tuple[bytes, bytes], bool] = {}

    def trust(self, a: np.ndarray, b: np.ndarray) -> None:
        self._known[a.tobytes(), b.tobytes()] = True

    def free(self, a: np.ndarray, b: np.ndarray) -> bool:
        key = (a.tobytes(), b.tobytes())
        if key not in self._known:
            self._known[key] = EdgeCheck(a, b).is_free(self.checker, self._resolution)
        return self._known[key]

    def confirm(self, nodes: np.ndarray, resolution: float) -> bool:
        """Whether all edges of a path are free at another resolution; the first that is not counts as colliding from now on."""
        for a, b in itertools.pairwise(nodes):
            key = (a.tobytes(), b.tobytes())
            if key not in self._fine:
                self._fine[key] = EdgeCheck(a, b).is_free(self.checker, resolution)
            if not self._fine[key]:
                self._known[key] = False
                return False
        return True


def _shortest(nodes: np.ndarray, edges: _Edges) -> np.ndarray | None:
    """Shortest way from the first to the last node by free edges forward along the path; None where there is none.

    Dijkstra with the straight distance to the end as a lower bound (A*), and an edge is checked only when the search
    would use it: most shortcuts are never touched.
    """
    n = len(nodes)
    to_end = np.linalg.norm(nodes - nodes[-1], axis=1)
    best = np.full(n, np.inf)
    parent = np.full(n, -1)
    done = np.zeros(n, dtype=bool)
    best[0] = 0.0
    # Entries: bound, length so far, node, the node before. Edges are checked when an entry is popped.
    heap: list[tuple[float, float, int, int]] = [(float(to_end[0]), 0.0, 0, -1)]
    while heap:
        _, length, i, before = heapq.heappop(heap)
        if done[i] or (before >= 0 and not edges.free(nodes[before], nodes[i])):
            continue
        done[i], best[i], parent[i] = True, length, before
        if i == n - 1:
            break
        for j in range(i + 1, n):
            if not done[j]:
                reach = length + float(np.linalg.norm(nodes[j] - nodes[i]))
                heapq.heappush(heap, (reach + float(to_end[j]), reach, j, i))
    if not done[-1]:
        return None
    chain = [n - 1]
    while chain[-1] != 0:
        chain.append(int(parent[chain[-1]]))
    return nodes[chain[::-1]]


def _bisected(nodes: np.ndarray, edges: _Edges) -> np.ndarray:
    """The path with the middle of each edge as a new node: N - 1 more."""
    out = np.empty((2 * len(nodes) - 1, nodes.shape[1]))
    out[0::2] = nodes
    out[1::2] = 0.5 * (nodes[:-1] + nodes[1:])
    for a, b in itertools.pairwise(out):
        edges.trust(a, b)
    return out


def _without_straight(nodes: np.ndarray) -> np.ndarray:
    """The same curve without nodes that lie on the straight line between their neighbours."""
    keep = [0]
    for i in range(1, len(nodes) - 1):
        a, b = nodes[i] - nodes[keep[-1]], nodes[i + 1] - nodes[i]
        la, lb = float(np.linalg.norm(a)), float(np.linalg.norm(b))
        if la > 0.0 and lb > 0.0 and float(np.linalg.norm(a / la - b / lb)) > 1e-9:
            keep.append(i)
    keep.append(len(nodes) - 1)
    return nodes[keep]
