"""Torque-aware smoothing: a smoothed path bent so that its largest static joint torque is less, at little more length.

Place in the flow: smoothing -> relief -> swing. [SunSpiral2012] s3.4.2 shortens; s7.1 wants motions that a strong joint carries.
The path becomes layers of nodes, each node with kicked neighbours beside it. Among all ways through the layers that are no longer
than allowed, the one whose worst torque is least is found by halving: a bound on the torque leaves a graph, whose shortest way
Dijkstra's rule gives layer by layer. Only edges of a way that would be taken are checked for collisions; those that collide are
cut, and the search goes on. Then again about the new path, with smaller kicks, until the gain is insignificant.

Cost: layers x kicks^2 torques a round, a microsecond each, and the collision checks of a few paths.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from athlete_twin.errors import PlanningError
from athlete_twin.geometry.arrays import LegJoints, LegPath
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.kinematics import GRAVITY
from athlete_twin.model.leg_torques import leg_torques
from athlete_twin.model.spec import RobotSpec
from planner.motion.checker import CountingChecker, EdgeCheck, IsFree
from planner.motion.smoothing import path_length

PeakTorque = Callable[[Float[np.ndarray, "n dof"]], Float[np.ndarray, " n"]]
DOWN = np.array([0.0, 0.0, -1.0])
SLOPE_STEP = 1e-4
"""of the finite differences of the torque [rad]"""


@dataclass(frozen=True, kw_only=True)
class ReliefConfig:
    """How far a path goes out of its way for the sake of its joints."""

    max_extra: float = 0.10
    """length over that of the path given"""
    layers: int = 5
    """of nodes between the ends"""
    kicks: int = 40
    """neighbours of each node, of each of three kinds"""
    spread: float = 0.35
    """of the kicks in the first round; half of it in each that follows [rad]"""
    rounds: int = 12
    min_gain: float = 0.005
    """of the torque over its limit in one round below which the rounds end"""
    edge_points: int = 5
    """at which the torque of an edge is looked at"""
    halvings: int = 10
    """of the bound on the torque"""
    resolution: float = 0.002
    """of edge checks [rad]: nothing looks at the path after"""
    max_cuts: int = 300
    """colliding ways looked at in one round before what is found so far is taken"""

    def __post_init__(self) -> None:
        if not (0.0 <= self.max_extra < np.inf and 0.0 < self.spread < np.inf and 0.0 < self.resolution < np.inf and self.min_gain >= 0.0):
            raise PlanningError(f"relief needs finite, positive lengths and angles, got {self}")
        if min(self.layers, self.kicks, self.rounds, self.halvings, self.max_cuts) < 1 or self.edge_points < 2:
            raise PlanningError(f"relief needs counts of 1 or more, and 2 points an edge, got {self}")


@dataclass(frozen=True, eq=False, kw_only=True)
class RelievedPath:
    """A path that asks less of its joints, or the one given where nothing was gained."""

    waypoints: LegPath
    peaks: tuple[float, ...]
    """largest torque over its limit before, and after each round"""
    checks: int
    """configurations checked for collision"""


def hanging_torque(spec: RobotSpec, leg: int, world_from_hex: SE3) -> PeakTorque:
    """Largest static torque over its limit of a leg that hangs in the air, for many configurations at once."""
    gravity = GRAVITY * world_from_hex.inverse().rotate(DOWN)

    def peak(q: np.ndarray) -> np.ndarray:
        nothing = np.zeros((len(q), 3))
        torques = leg_torques(spec, leg, q, force_in_hex=nothing, contact_in_hex=nothing, gravity_in_hex=gravity)
        return np.asarray(np.abs(torques / spec.torque_limits).max(axis=1))

    return peak


def relieve(
    path: LegPath, peak: PeakTorque, is_free: IsFree, lower: LegJoints, upper: LegJoints, rng: np.random.Generator, config: ReliefConfig
) -> RelievedPath:
    """The path bent for less torque, its ends kept. Edges of `path` itself are taken to be free already.

    Args:
        path: smoothed, shape (k, dof), k >= 2 [rad].
        peak: largest torque over its limit, for many configurations.
        is_free: whether a configuration is free.
        lower: limits of the joints [rad].
        upper: the same.
        rng: of the kicks.
        config: how far.
    """
    nodes = np.asarray(path, dtype=float)
    if nodes.ndim != 2 or len(nodes) < 2 or not np.isfinite(nodes).all():
        raise PlanningError(f"a path needs finite shape (k, dof) with k >= 2, got {nodes.shape}")
    checker = CountingChecker(is_free)
    longest = (1.0 + config.max_extra) * path_length(nodes)
    floor = float(peak(nodes[[0, -1]]).max())
    peaks = [path_peak(nodes, peak)]
    spread = config.spread
    for _ in range(config.rounds):
        if peaks[-1] <= floor or longest == 0.0:
            break
        bent = _bend(nodes, peak, checker, lower, upper, rng, config, spread, longest, floor, peaks[-1])
        gained = np.inf if bent is None else peaks[-1] - path_peak(bent, peak)
        if bent is not None and gained > 0.0:
            nodes = bent
            peaks.append(peaks[-1] - gained)
        if bent is None or gained <= config.min_gain:
            spread *= 0.5
            if spread < 0.1 * config.spread:
                break
            continue
        spread *= 0.5
    return RelievedPath(waypoints=nodes, peaks=tuple(peaks), checks=checker.count)


def path_peak(path: LegPath, peak: PeakTorque, *, spacing: float = 0.02) -> float:
    """Largest torque over its limit anywhere on the path, looked at every `spacing` [rad]."""
    points = [path[:1]]
    for a, b in itertools.pairwise(path):
        n = max(1, int(np.ceil(np.linalg.norm(b - a) / spacing)))
        points.append(a + (np.arange(1, n + 1) / n)[:, None] * (b - a))
    return float(peak(np.concatenate(points)).max())


def _bend(
    nodes: np.ndarray,
    peak: PeakTorque,
    checker: CountingChecker,
    lower: np.ndarray,
    upper: np.ndarray,
    rng: np.random.Generator,
    config: ReliefConfig,
    spread: float,
    longest: float,
    floor: float,
    ceiling: float,
) -> np.ndarray | None:
    """The best way through the layers about a path; None where none is better that is free."""
    layers = [
        np.array([q for n, q in enumerate(layer) if n == 0 or checker(q)])
        for layer in _layers(nodes, peak, rng, config, spread, lower, upper)
    ]
    lengths = [np.linalg.norm(b[None] - a[:, None], axis=2) for a, b in itertools.pairwise(layers)]
    torques = [_edge_peaks(a, b, peak, config.edge_points) for a, b in itertools.pairwise(layers)]
    known: dict[tuple[int, int, int], bool] = {}
    found, low, high, cuts = None, floor, ceiling, 0
    for _ in range(config.halvings):
        bound = 0.5 * (low + high)
        way = None
        while cuts < config.max_cuts:
            way = _shortest_below(lengths, torques, bound, longest)
            if way is None:
                break
            hit = _first_hit(layers, way, known, checker, config.resolution)
            if hit is None:
                break
            n, i, j = hit
            lengths[n][i, j] = np.inf
            cuts += 1
            way = None
        if way is None:
            low = bound
        else:
            found = np.array([layers[n][i] for n, i in enumerate(way)])
            high = bound
        if cuts >= config.max_cuts:
            break
    return found


def _layers(
    nodes: np.ndarray,
    peak: PeakTorque,
    rng: np.random.Generator,
    config: ReliefConfig,
    spread: float,
    lower: np.ndarray,
    upper: np.ndarray,
) -> list[np.ndarray]:
    """The path's nodes, and as many between as are wanted, each with its neighbours; the ends alone.

    A third of the kicks are the same for all layers, so that a way may run beside the path without winding about it; a third go down
    the torque's slope from where each layer is, by more and less; a third go anywhere.
    """
    at = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(nodes, axis=0), axis=1))])
    places = np.unique(np.concatenate([at, np.linspace(0.0, at[-1], config.layers + 2)]))
    # Neighbours of two nodes that nearly coincide would do the same work twice.
    keep = np.concatenate([[True], np.diff(places) > 0.02 * at[-1]])
    keep[-1] = True
    on_path = np.array([[np.interp(s, at, nodes[:, j]) for j in range(nodes.shape[1])] for s in places[keep]])
    on_path[0], on_path[-1] = nodes[0], nodes[-1]
    dof, count = nodes.shape[1], config.kicks
    common = _kicks(rng, count, dof, spread)
    steps = np.eye(dof) * SLOPE_STEP
    out = [on_path[:1]]
    for node in on_path[1:-1]:
        slope = peak(np.concatenate([node + steps, node - steps])).reshape(2, dof)
        down = slope[1] - slope[0]
        down /= max(float(np.linalg.norm(down)), 1e-12)
        along = spread * rng.uniform(0.1, 2.0, (count, 1)) * down + 0.2 * spread * rng.standard_normal((count, dof))
        beside = node + np.concatenate([common, along, _kicks(rng, count, dof, spread)])
        out.append(np.concatenate([node[None], np.clip(beside, lower, upper)]))
    return [*out, on_path[-1:]]


def _kicks(rng: np.random.Generator, count: int, dof: int, spread: float) -> np.ndarray:
    return np.asarray(spread * rng.uniform(0.1, 1.0, (count, 1)) * rng.standard_normal((count, dof)))


def _edge_peaks(a: np.ndarray, b: np.ndarray, peak: PeakTorque, points: int) -> np.ndarray:
    """Largest torque on each straight edge from a row of `a` to one of `b`, shape (len(a), len(b))."""
    s = np.linspace(0.0, 1.0, points)[:, None, None, None]
    on_edges = a[None, :, None] + s * (b[None, None] - a[None, :, None])
    return np.asarray(peak(on_edges.reshape(-1, a.shape[1])).reshape(points, len(a), len(b)).max(axis=0))


def _shortest_below(lengths: list[np.ndarray], torques: list[np.ndarray], bound: float, longest: float) -> list[int] | None:
    """Node of each layer on the shortest way whose edges stay below a torque; None where it is longer than allowed."""
    reach, before = np.zeros(1), []
    for length, torque in zip(lengths, torques, strict=True):
        total = reach[:, None] + np.where(torque <= bound, length, np.inf)
        before.append(total.argmin(axis=0))
        reach = total.min(axis=0)
    if not reach[0] <= longest:
        return None
    way = [0]
    for step in reversed(before):
        way.append(int(step[way[-1]]))
    return way[::-1]


def _first_hit(
    layers: list[np.ndarray], way: list[int], known: dict[tuple[int, int, int], bool], checker: CountingChecker, resolution: float
) -> tuple[int, int, int] | None:
    """The first edge of a way that collides, longest first; None where all are free."""
    edges = [(n, i, j) for n, (i, j) in enumerate(itertools.pairwise(way))]
    ends = {e: (layers[e[0]][e[1]], layers[e[0] + 1][e[2]]) for e in edges}
    for edge in sorted(edges, key=lambda e: -float(np.linalg.norm(ends[e][1] - ends[e][0]))):
        if edge not in known:
            a, b = ends[edge]
            known[edge] = EdgeCheck(a, b).is_free(checker, resolution)
        if not known[edge]:
            return edge
    return None
