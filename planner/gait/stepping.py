"""Stepping onto and over: a sequence of leg moves and chassis poses that takes all six wheels across a ledge, ditch or wall.

[SunSpiral2012] s1 claims a vertical step of 1.7 m for SDM-B, s5.3.4 that it climbs over ledges. The legs step in the reverse
wave; a footfall that would meet an edge goes to the nearest firm place. For every step the chassis (ahead, up, nose up or down)
must be where the swing goes: all legs reach with some to spare, the stability rule holds, no joint saturates (rigid, loads by
zero interaction). Between steps it moves over planted wheels from pose to neighbouring pose of a grid, each one checked the
same way. The whole is one shortest path through all these grids, layer after layer, and what its poses strike is taken out of
them until nothing strikes. Last links are plumb, swings go straight up, over and down.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

from athlete_twin.errors import PlanningError
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.reach import all_legs_ik, leg_ik
from athlete_twin.model.spec import LEGS, RobotSpec
from planner.gait.cycle import ALL_DOWN
from planner.gait.ground_profile import Profile
from planner.gait.skeleton import reverse_wave
from planner.motion.collision import BodyCollision, CollisionConfig
from planner.stability.rigid_stance import Footing, rigid_stances

ALONG = (0.0, 0.34, 0.67, 1.0)
"""where a wheel on its way over is judged"""
LEAST_STEP = 0.02
"""shorter ones are not made [m]"""
ROUNDS = 60
"""of taking out poses that strike something"""
TORQUE_COST = 2.0
"""of a step at the torque limit, in metres of chassis motion: easy poses are worth a detour [m]"""


@dataclass(frozen=True, kw_only=True)
class SteppingConfig:
    """How the robot goes, and the grid of chassis poses."""

    heading_deg: float
    """ahead, in the hex plane [deg]"""
    stride: float
    """of a cycle [m]"""
    foot_scale: float = 1.0
    """of the regular places, over the drawings' foot radius"""
    behind: float = 0.1
    """of the first wheels from where they may stand before the obstacle, as the manoeuvre begins [m]"""
    lift: float = 0.3
    """of a swinging wheel over where it leaves, at least, so that sag does not keep it down [m]"""
    clear: float = 0.15
    """over all that it passes and over where it lands [m]"""
    spare: float = 0.03
    """by which any wheel may be off and still be reached [m]"""
    torque: float = 0.9
    """largest static torque over its limit: the rest is for what a rigid plan does not know"""
    step: tuple[float, float] = (0.12, 0.1)
    """between chassis poses ahead and up [m]"""
    pitch_step_deg: float = 5.0
    """between pitches [deg]"""
    pitches: int = 2
    """to either side of level; last links leave the vertical sideways by as much"""
    span: tuple[float, float, float] = (0.6, 0.55, 1.3)
    """of chassis places: ahead and behind the middle of the feet [m], least and largest height over the mean ground under the
    feet, over the drawings' chassis height"""

    def __post_init__(self) -> None:
        lengths = (self.stride, self.foot_scale, *self.step, self.pitch_step_deg, *self.span, self.torque, self.lift)
        if not all(np.isfinite(v) and v > 0.0 for v in lengths) or self.pitches < 0 or self.spare < 0.0:
            raise PlanningError(f"lengths, spans and limits of stepping must be positive, got {lengths}")


@dataclass(frozen=True, eq=False, kw_only=True)
class LegStep:
    """One leg's move, and the chassis' way before it."""

    leg: int
    """index 0 to 5"""
    path: np.ndarray
    """of the axle: from, above, above where it goes, there, shape (4, 3), in world [m]"""
    poses: tuple[SE3, ...]
    """`world_from_hex` on the way from the last step's pose to this one's, which is the last"""


@dataclass(frozen=True, eq=False, kw_only=True)
class Crossing:
    """A whole manoeuvre."""

    spec: RobotSpec
    profile: Profile
    config: SteppingConfig
    axles: np.ndarray
    """as it begins, shape (6, 3), in world [m]"""
    begin: SE3
    """`world_from_hex`"""
    steps: tuple[LegStep, ...]
    peak: float
    """largest static joint torque over its limit while legs swing"""

    @property
    def largest_pitch(self) -> float:
        """Of the chassis, on its way [rad]."""
        tilts = [np.arccos(np.clip(pose.rotation[2, 2], -1.0, 1.0)) for step in self.steps for pose in step.poses]
        return float(max(tilts, default=0.0))


@dataclass(frozen=True, kw_only=True)
class NoCrossing:
    """The manoeuvre was not found."""

    reason: str


def cross(spec: RobotSpec, profile: Profile, config: SteppingConfig) -> Crossing | NoCrossing:
    """The manoeuvre that takes all wheels across with the least chassis motion and torque, or where it ends."""
    feet, steps = footfalls(spec, profile, config)
    layers = [_layer(spec, profile, config, axles, steps[k] if k < len(steps) else None) for k, axles in enumerate(feet)]
    for k, layer in enumerate(layers):
        if not layer.down.any():
            return NoCrossing(reason=f"before step {k + 1} of {len(steps)} no pose of the chassis has all legs reach and stands safely")
        if k < len(steps) and not layer.swings.any():
            leg, path = steps[k]
            return NoCrossing(
                reason=f"step {k + 1} of {len(steps)}: no pose lets leg {leg + 1} go from {path[0, 0]:.2f} to {path[3, 0]:.2f} m"
            )
    body = BodyCollision(spec, profile.grid(), CollisionConfig())
    looked: dict[tuple[int, int, bool], str | None] = {}
    graph = _Graph(layers, config)
    for _ in range(ROUNDS):
        way = graph.shortest()
        if way is None:
            struck = sorted({hit for hit in looked.values() if hit})
            return NoCrossing(reason="the poses of the steps do not join" + (f"; struck: {', '.join(struck[:3])}" if struck else ""))
        if not _strikes(spec, config, body, layers, feet, steps, way, looked):
            return _told(spec, profile, config, feet, steps, layers, way)
    return NoCrossing(reason=f"still strikes after {ROUNDS} rounds of taking poses out")


def footfalls(
    spec: RobotSpec, profile: Profile, config: SteppingConfig
) -> tuple[list[np.ndarray], list[tuple[int, np.ndarray]]]:
    """Axles before each step and after the last, (6, 3) each, and the steps: leg and its axle's path (4, 3), in world [m]."""
    holds = profile.footholds(spec.wheel.radius)
    heading = np.deg2rad(config.heading_deg)
    angles = spec.foot_azimuths - heading
    regular = config.foot_scale * spec.foot_radius * np.column_stack([np.cos(angles), np.sin(angles)])
    order = reverse_wave(spec, np.array([np.cos(heading), np.sin(heading)]))
    now = regular[:, 0] - regular[:, 0].max() + holds[0, 1] - config.behind
    beyond = holds[-1, 0]
    feet = [_axles(spec, profile, now, regular[:, 1])]
    steps: list[tuple[int, np.ndarray]] = []
    while now.min() < beyond:
        # A leg that an edge held back holds all back: nobody runs ahead of it by more than a stride.
        base = float((now - regular[:, 0]).min()) + config.stride
        for leg in order:
            place = _nearest(holds, base + float(regular[leg, 0]))
            if place < now[leg] + LEAST_STEP and now[leg] - regular[leg, 0] < base - config.stride + LEAST_STEP:
                place = _next(holds, float(now[leg]))  # it waits at the edge, and all wait for it
            if place < now[leg] + LEAST_STEP:
                continue
            after = now.copy()
            after[leg] = place
            old, new = feet[-1][leg], _axles(spec, profile, after, regular[:, 1])[leg]
            radius = spec.wheel.radius
            over = max(
                profile.top(old[0] - radius, new[0] + radius) + config.clear, old[2] - radius + config.lift
            ) + radius  # fmt: skip
            path = np.array([old, [old[0], old[1], over], [new[0], new[1], over], new])
            steps.append((leg, path))
            now = after
            feet.append(_axles(spec, profile, now, regular[:, 1]))
    return feet, steps


def _axles(spec: RobotSpec, profile: Profile, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.column_stack([x, y, profile.height(x) + spec.wheel.radius])


def _nearest(holds: np.ndarray, x: float) -> float:
    """The firm place closest to x [m]."""
    places = np.clip(x, holds[:, 0], holds[:, 1])
    return float(places[np.argmin(np.abs(places - x))])


def _next(holds: np.ndarray, x: float) -> float:
    """Where the next firm stretch begins; x itself on the last one [m]."""
    ahead = holds[holds[:, 0] > x, 0]
    return float(ahead[0]) if len(ahead) else x


@dataclass(frozen=True, eq=False, kw_only=True)
class _Layer:
    """Chassis poses over one stance."""

    index: np.ndarray
    """of each pose on the grid: ahead, up, pitch, shape (n, 3), whole numbers that all layers share"""
    down: np.ndarray
    """poses that stand safely with all wheels down, shape (n,)"""
    swings: np.ndarray
    """poses from which the step goes, shape (n,)"""
    peak: np.ndarray
    """largest torque over its limit while the leg swings, shape (n,)"""

    def rows_of(self, index: np.ndarray) -> np.ndarray:
        """Which row holds each of m grid places (m, 3); -1 where none does."""
        # Rows run over pitch, then ahead, then up, each without gaps.
        low, high = self.index.min(axis=0), self.index.max(axis=0)
        _, ups, _ = shape = high - low + 1
        at = index - low
        rows = (at[:, 2] * shape[0] + at[:, 0]) * ups + at[:, 1]
        return np.where(((at >= 0) & (at < shape)).all(axis=1), rows, -1)


def _layer(
    spec: RobotSpec, profile: Profile, config: SteppingConfig, axles: np.ndarray, step: tuple[int, np.ndarray] | None
) -> _Layer:
    """Judges all poses over one stance, and the step that leaves it."""
    dx, dz = config.step
    middle = 0.5 * (axles[:, 0].min() + axles[:, 0].max())
    ground = float(profile.height(axles[:, 0]).mean())
    low, high = (ground + share * spec.chassis_height for share in config.span[1:])
    ahead = np.arange(np.ceil((middle - config.span[0]) / dx), np.floor((middle + config.span[0]) / dx) + 1).astype(int)
    up = np.arange(np.ceil(low / dz), np.floor(high / dz) + 1).astype(int)
    pitches = np.arange(-config.pitches, config.pitches + 1)
    index, down, swings, peak = [], [], [], []
    flat = np.stack(np.meshgrid(ahead, up, indexing="ij"), axis=-1).reshape(-1, 2)
    for pitch in pitches:
        rows = np.column_stack([flat, np.full(len(flat), pitch)])
        turned = pose_of(config, rows[0]).rotation
        places = np.column_stack([dx * rows[:, 0], np.zeros(len(rows)), dz * rows[:, 1]])
        footing = Footing(normal=_unit(turned[2]), up=_unit(turned[2]))
        stands = (axles[None] - places[:, None]) @ turned
        index.append(rows)
        down.append(_safe(spec, stands[:, None], ALL_DOWN, footing, config)[0])
        if step is None:
            swings.append(np.zeros(len(rows), dtype=bool))
            peak.append(np.full(len(rows), np.inf))
            continue
        leg, path = step
        moments = np.repeat(axles[None], 2 + len(ALONG), axis=0)
        moments[:, leg] = [path[0], *(path[1] + s * (path[2] - path[1]) for s in ALONG), path[3]]
        swung = (moments[None] - places[:, None, None]) @ turned
        good, fraction = _safe(spec, swung, np.arange(LEGS) != leg, footing, config)
        after = _safe(spec, swung[:, -1:], ALL_DOWN, footing, config)[0]
        swings.append(good & down[-1] & after)
        peak.append(fraction)
    return _Layer(
        index=np.concatenate(index), down=np.concatenate(down), swings=np.concatenate(swings), peak=np.concatenate(peak)
    )  # fmt: skip


def _safe(
    spec: RobotSpec, axles_in_hex: np.ndarray, standing: np.ndarray, footing: Footing, config: SteppingConfig
) -> tuple[np.ndarray, np.ndarray]:
    """Whether n poses are safe at all of m moments (n, m, 6, 3), and their largest torque fraction, shapes (n,)."""
    n, m = axles_in_hex.shape[:2]
    reaches = np.ones(n, dtype=bool)
    for leg, hip in enumerate(spec.hips_in_hex):
        places = axles_in_hex[:, :, leg].reshape(-1, 3)
        away = places - hip
        outward = away * [1.0, 1.0, 0.0] / np.maximum(np.linalg.norm(away[:, :2], axis=1), 1e-9)[:, None]
        for off in (outward, -outward, footing.up, -footing.up):
            ok = leg_ik(spec, leg, places + config.spare * off, last_link_in_hex=-footing.up)[1]
            reaches &= ok.reshape(n, m).all(axis=1)
    good, peak = np.zeros(n, dtype=bool), np.full(n, np.inf)
    rows = np.flatnonzero(reaches)
    if len(rows):
        stances = rigid_stances(spec, axles_in_hex[rows].reshape(-1, LEGS, 3), standing=standing, footing=footing)
        margin = stances.cps_margin if standing.all() else stances.margin
        peak[rows] = stances.peak.reshape(-1, m).max(axis=1)
        good[rows] = (margin.reshape(-1, m).min(axis=1) >= spec.min_support_margin) & (peak[rows] <= config.torque)
    return good, peak


def pose_of(config: SteppingConfig, index: np.ndarray) -> SE3:
    """`world_from_hex` of a grid pose: ahead, up, pitch (nose up is positive)."""
    dx, dz = config.step
    pitch, heading = np.deg2rad(config.pitch_step_deg) * index[2], np.deg2rad(config.heading_deg)
    place = np.array([dx * index[0], 0.0, dz * index[1]])
    return SE3.from_rotvec(np.array([0.0, -pitch, 0.0]), place).compose(SE3.from_rotvec(np.array([0.0, 0.0, -heading]), np.zeros(3)))


class _Graph:
    """All layers' poses, each joined to its neighbours on the grid, and to itself in the next layer where the step goes."""

    def __init__(self, layers: Sequence[_Layer], config: SteppingConfig) -> None:
        self._layers = layers
        self._first = np.concatenate([[0], np.cumsum([len(layer.index) for layer in layers])])
        size = np.array([*config.step, np.deg2rad(config.pitch_step_deg) * 2.0])
        rows, columns, costs, swings = [], [], [], []
        for k, layer in enumerate(layers):
            for off in np.ndindex(3, 3, 3):
                to = layer.rows_of(layer.index + np.array(off) - 1)
                here = np.flatnonzero(to >= 0)
                if off == (1, 1, 1):
                    continue
                rows.append(self._first[k] + here)
                columns.append(self._first[k] + to[here])
                costs.append(np.full(len(here), float(np.linalg.norm((np.array(off) - 1) * size))))
                swings.append(np.zeros(len(here), dtype=bool))
            if k + 1 < len(layers):
                to = layers[k + 1].rows_of(layer.index)
                here = np.flatnonzero((to >= 0) & np.isfinite(layer.peak))
                rows.append(self._first[k] + here)
                columns.append(self._first[k + 1] + to[here])
                costs.append(1e-6 + TORQUE_COST * layer.peak[here] ** 2)
                swings.append(np.ones(len(here), dtype=bool))
        self._rows, self._columns = np.concatenate(rows), np.concatenate(columns)
        self._costs, self._swings = np.concatenate(costs), np.concatenate(swings)

    def shortest(self) -> list[list[int]] | None:
        """Rows of each layer's poses on the way through, from where its stance begins to where it is left; None without a way."""
        down = np.concatenate([layer.down for layer in self._layers])
        leaves = np.concatenate([layer.swings for layer in self._layers])
        open_ = down[self._rows] & down[self._columns] & (~self._swings | leaves[self._rows])
        start, begins = len(down), np.flatnonzero(self._layers[0].down)
        rows = np.concatenate([self._rows[open_], np.full(len(begins), start)])
        columns = np.concatenate([self._columns[open_], begins])
        costs = np.concatenate([self._costs[open_], np.full(len(begins), 1e-6)])
        graph = coo_matrix((costs, (rows, columns)), shape=(start + 1, start + 1)).tocsr()
        distance, before = dijkstra(graph, indices=start, return_predecessors=True)
        last = self._first[-2] + np.flatnonzero(self._layers[-1].down)
        if not len(last) or not np.isfinite(distance[last]).any():
            return None
        node = int(last[np.argmin(distance[last])])
        way: list[list[int]] = [[] for _ in self._layers]
        while node != start:
            k = int(np.searchsorted(self._first, node, side="right")) - 1
            way[k].insert(0, node - int(self._first[k]))
            node = int(before[node])
        return way


def _strikes(
    spec: RobotSpec, config: SteppingConfig, body: BodyCollision, layers: list[_Layer], feet: list[np.ndarray],
    steps: list[tuple[int, np.ndarray]], way: list[list[int]], looked: dict[tuple[int, int, bool], str | None],
) -> bool:  # fmt: skip
    """Takes out what strikes on a way, and says whether anything did."""
    struck = False
    for k, rows in enumerate(way):
        layer, stance = layers[k], feet[k]
        for row in rows:
            pose = pose_of(config, layer.index[row])
            swings = row == rows[-1] and k < len(steps)
            for swinging in (False, True) if swings else (False,):
                key = (k, row, swinging)
                if key not in looked:
                    looked[key] = _hit(spec, body, pose, stance, steps[k] if swinging else None)
                if looked[key] is not None:
                    struck = True
                    layer.swings[row] = False
                    if not swinging:
                        layer.down[row] = False
    return struck


def _told(
    spec: RobotSpec, profile: Profile, config: SteppingConfig, feet: list[np.ndarray], steps: list[tuple[int, np.ndarray]],
    layers: list[_Layer], way: list[list[int]],
) -> Crossing:  # fmt: skip
    """The way as a manoeuvre."""
    made, peak = [], 0.0
    for k, (leg, path) in enumerate(steps):
        # A layer begins in the pose that the last step was made from; the first one is where the robot begins.
        poses = tuple(pose_of(config, layers[k].index[row]) for row in way[k][1:])
        made.append(LegStep(leg=leg, path=path, poses=poses))
        peak = max(peak, float(layers[k].peak[way[k][-1]]))
    begin = pose_of(config, layers[0].index[way[0][0]])
    return Crossing(spec=spec, profile=profile, config=config, axles=feet[0], begin=begin, steps=tuple(made), peak=peak)


def _unit(v: np.ndarray) -> np.ndarray:
    return np.asarray(v / np.linalg.norm(v))


def _hit(
    spec: RobotSpec, body: BodyCollision, pose: SE3, axles: np.ndarray, step: tuple[int, np.ndarray] | None
) -> str | None:
    """What the robot strikes over a stance, or while a leg steps from it."""
    moments = axles[None] if step is None else np.repeat(axles[None], 2 + len(ALONG), axis=0)
    if step is not None:
        leg, path = step
        moments[:, leg] = [path[1] - [0.0, 0.0, 0.05], *(path[1] + s * (path[2] - path[1]) for s in ALONG), path[3]]
    inverse = pose.inverse()
    for at in moments:
        joints, reaches = all_legs_ik(spec, inverse.apply(at), last_link_in_hex=inverse.rotate(np.array([0.0, 0.0, -1.0])))
        if not reaches.all():
            return f"leg {int(np.argmin(reaches)) + 1} out of reach"
        hit = body.first_collision(joints, pose)
        if hit is not None:
            return hit
    return None


@dataclass(frozen=True, eq=False, kw_only=True)
class Largest:
    """The largest obstacle of a kind for which a crossing was found."""

    size: float
    """[m]; NaN where not even the first was"""
    crossing: Crossing | None
    ended_by: str
    """what the next larger one ended in, for the config tried last"""


def largest_crossing(
    spec: RobotSpec, make: Callable[[float], Profile], configs: Sequence[SteppingConfig], *, low: float, high: float, digit: float
) -> Largest:
    """By halving between `low` and `high` [m], to `digit`: the largest obstacle that any of the configs crosses.

    Args:
        spec: the drawings.
        make: the obstacle of a size.
        configs: tried in their order at each size.
        low: the least size tried; the answer is NaN where no config crosses it.
        high: the largest.
        digit: how closely.
    """
    if not (0.0 < low < high and digit > 0.0 and configs):
        raise PlanningError(f"need 0 < low < high, a positive digit and a config, got {low}, {high}, {digit}")
    found: Crossing | None = None
    at, ended = float("nan"), ""
    tried = low
    while True:
        got: Crossing | None = None
        for config in configs:
            answer = cross(spec, make(tried), config)
            if isinstance(answer, Crossing):
                got = answer
                break
            reason = answer.reason
        if got is None:
            if found is None:
                return Largest(size=at, crossing=None, ended_by=reason)
            high, ended = tried, reason
        else:
            found, at, low = got, tried, tried
        if high - low <= digit + 1e-9:
            return Largest(size=at, crossing=found, ended_by=ended)
        # Sizes stay on a ruler of whole digits above the first.
        tried = low + digit * max(1.0, np.floor(0.5 * (high - low) / digit + 1e-9))
