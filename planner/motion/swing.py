"""One leg's step: straight up, through the air, straight down, with every part checked before a command is written.

Place in the flow: footfall and inverse kinematics -> swing -> sequence (a straight move with a guard, a joint move
through way-points, a guarded straight descent). All steps pass points straight above lift-off and touchdown, so that a
wheel breaks contact although the chassis sags ([SunSpiral2012] s3.3); these are checked for reach too. Between them the
straight line in joint space is tried first, then over a few raised points, then the sampling planner, smoothed. The
executive cuts its corners, by as much as was found free of collisions too.

The straight ways are solved as the executive will solve them: closed form, the last link keeping its direction. The
sampling box surrounds both ends by a padding within the limits, so rolls stay near zero and no joint passes its limits.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from athlete_twin.errors import PlanningError
from athlete_twin.geometry.arrays import LegJoints, Vec3
from athlete_twin.messages import CORNER_TOLERANCE, MOST_CORNER_TOLERANCE
from athlete_twin.model.reach import leg_ik
from athlete_twin.model.spec import RobotSpec
from planner.motion.checker import CountingChecker, EdgeCheck
from planner.motion.collision import LegCollision
from planner.motion.cornering import free_corner_tolerance
from planner.motion.planners import plan
from planner.motion.relief import ReliefConfig, hanging_torque, relieve
from planner.motion.sbl import NoPath, SblConfig, no_path
from planner.motion.smoothing import SmoothingConfig, path_length, smooth


@dataclass(frozen=True, kw_only=True)
class SwingConfig:
    """Settings of a leg's step."""

    sbl: SblConfig = field(default_factory=SblConfig)
    smoothing: SmoothingConfig = field(default_factory=SmoothingConfig)
    relief: ReliefConfig | None = None
    """of joint torques after smoothing; None for the shortest path"""
    vertical_step: float = 0.025
    """between checked points of a straight way: half of the terrain clearance [m]"""
    branch_tolerance: float = 0.03
    """largest difference of a given posture from the closed form's; the executive refuses more [rad]"""
    max_joint_step: float = 0.25
    """largest joint motion between two points of a straight way: more is a jump to another branch, or full stretch [rad]"""
    extra_heights: tuple[float, ...] = (0.0, 0.1, 0.2, 0.35, 0.5)
    """tried above the given way-points: where a wheel stands beside a rock, and for steps over one [m]"""
    padding_deg: tuple[float, float, float] = (5.0, 40.0, 20.0)
    """of the sampling box beyond both ends, for joints about x (rolls), y (pitches) and z (yaw) [deg]"""
    corner_tolerance: float = CORNER_TOLERANCE
    """by which the executive may cut corners at most; less where that collides, 0: it stops at each [rad]"""

    def __post_init__(self) -> None:
        if not (self.vertical_step > 0.0 and self.branch_tolerance > 0.0 and self.max_joint_step > 0.0):
            raise PlanningError("vertical_step, branch_tolerance and max_joint_step must be positive")
        if not 0.0 <= self.corner_tolerance <= MOST_CORNER_TOLERANCE:
            raise PlanningError(f"corner_tolerance {self.corner_tolerance} rad is outside 0 to {MOST_CORNER_TOLERANCE}")
        if not self.extra_heights or min(self.extra_heights) < 0.0 or min(self.padding_deg) < 0.0:
            raise PlanningError(f"extra_heights {self.extra_heights} and padding_deg {self.padding_deg} must not be negative")


@dataclass(frozen=True, kw_only=True)
class SwingStats:
    """How a path came about."""

    method: str
    """ "direct", "raised" or the sampling planner's name"""
    raised_by: float
    """how far above the given way-points the leg leaves and arrives, the larger of both [m]"""
    raw_length: float
    """joint-space length before smoothing [rad]"""
    smoothing_rounds: int


@dataclass(frozen=True, eq=False, kw_only=True)
class SwingPath:
    """A leg's step that reaches and collides nowhere."""

    lift: Float[np.ndarray, "n dof"]
    """straight up from the start to the lift way-point, shape (n, dof) [rad]"""
    waypoints: Float[np.ndarray, "k dof"]
    """through the air, from the lift to the touchdown way-point, shape (k, dof) [rad]"""
    descent: Float[np.ndarray, "m dof"]
    """straight down to the goal, shape (m, dof) [rad]"""
    lengths: tuple[float, float, float]
    """joint-space lengths of the three [rad]"""
    corner_tolerance: float
    """by which the executive may cut the corners of `waypoints`: so cut, they are free [rad]"""
    checks: int
    """configurations checked for collision"""
    stats: SwingStats


def plan_swing(
    collision: LegCollision,
    spec: RobotSpec,
    q_start: LegJoints,
    q_goal: LegJoints,
    *,
    lift_waypoint_q: LegJoints,
    touchdown_waypoint_q: LegJoints,
    planner: str,
    rng: np.random.Generator,
    config: SwingConfig,
) -> SwingPath | NoPath:
    """Path of one leg from its stance to the next, or which check refused it.

    Args:
        collision: of this leg, the robot standing.
        spec: the drawings.
        q_start: planted, as the leg stands [rad].
        q_goal: planted at the new footfall [rad].
        lift_waypoint_q: straight above the start [rad].
        touchdown_waypoint_q: straight above the goal [rad].
        planner: name of the sampling planner, one of `planners.METHODS`.
        rng: for the sampling planner alone.
        config: settings.
    """
    ends = {"start": q_start, "goal": q_goal, "lift way-point": lift_waypoint_q, "touch-down way-point": touchdown_waypoint_q}
    for name, q in ends.items():
        if q.shape != (spec.dof,) or not np.isfinite(q).all():
            raise PlanningError(f"the swing's {name} is {q} rad, must be {spec.dof} finite angles")
    legs = _Straight(collision, spec, config)
    lift = legs.between(q_start, lift_waypoint_q, posture=q_start, name="lift")
    if isinstance(lift, NoPath):
        return lift
    descent = legs.between(touchdown_waypoint_q, q_goal, posture=touchdown_waypoint_q, name="touchdown")
    if isinstance(descent, NoPath):
        return descent
    sink = collision.wheel_sink(q_goal)
    if sink > collision.config.max_wheel_sink:
        detail = f"the wheel would stand {sink:.3f} m inside the terrain, allowed {collision.config.max_wheel_sink:.3f} m"
        return NoPath(reason="touchdown_sinks", checks=legs.checks, detail=detail)
    first, last = legs.climb(lift_waypoint_q, name="lift"), legs.climb(touchdown_waypoint_q, name="touchdown")
    if isinstance(first, NoPath):
        return first
    if isinstance(last, NoPath):
        return last
    checker = CountingChecker(refusal=collision.refusal)
    crossing = _cross(first.path[-1], last.path[-1], checker, legs, planner, rng, config)
    if isinstance(crossing, NoPath):
        return replace(crossing, checks=legs.checks + crossing.checks)
    middle, method, raw_length, rounds = crossing
    waypoints = np.concatenate([first.path[:-1], middle, last.path[::-1][1:]])
    climbing = CountingChecker(collision.is_free_near_ground)
    tolerance = free_corner_tolerance(
        waypoints,
        [climbing] * (len(first.path) - 1) + [checker] * (len(middle) - 1) + [climbing] * (len(last.path) - 1),
        most=config.corner_tolerance,
        spacing=config.smoothing.fine_resolution,
    )
    return SwingPath(
        lift=lift,
        waypoints=waypoints,
        descent=descent,
        lengths=(path_length(lift), path_length(waypoints), path_length(descent)),
        corner_tolerance=tolerance,
        checks=legs.checks + checker.count + climbing.count,
        stats=SwingStats(
            method=method, raised_by=max(first.height, last.height), raw_length=raw_length, smoothing_rounds=rounds
        ),
    )


@dataclass(frozen=True, eq=False)
class _Climb:
    """Straight up from a way-point to where the leg keeps its full clearance."""

    path: np.ndarray
    height: float


class _Straight:
    """Straight ways of the wheel in world, solved as the executive solves them."""

    def __init__(self, collision: LegCollision, spec: RobotSpec, config: SwingConfig) -> None:
        self.collision, self.spec, self.config = collision, spec, config
        self.checks = 0

    def between(self, q_from: np.ndarray, q_to: np.ndarray, *, posture: np.ndarray, name: str) -> np.ndarray | NoPath:
        """Joint path along the wheel's straight line, checked near the ground; the ends must be on the same branch."""
        a, b = self.collision.wheel_in_hex(q_from), self.collision.wheel_in_hex(q_to)
        path = self._solve(a, b, posture)
        if isinstance(path, str):
            return NoPath(reason=f"{name}_unreachable", checks=self.checks, detail=path)
        for given, solved in ((q_from, path[0]), (q_to, path[-1])):
            off = float(np.abs(given - solved).max())
            if off > self.config.branch_tolerance:
                detail = f"{np.rad2deg(off):.1f} deg off the closed form, allowed {np.rad2deg(self.config.branch_tolerance):.1f}"
                return NoPath(reason=f"{name}_off_branch", checks=self.checks, detail=detail)
        path[0], path[-1] = q_from, q_to
        free = [self.collision.is_free_near_ground(q) for q in path]
        self.checks += len(path)
        blocked = [i for i, ok in enumerate(free) if not ok]
        # The leg is where it is, whatever the map says of it: it may leave a contact on its way up, never enter one.
        if name == "lift" and not free[0] and free[-1]:
            blocked = [i for i in blocked if any(free[:i])]
        if blocked:
            hit = str(self.collision.first_collision_near_ground(path[blocked[0]]))
            return NoPath(reason=f"{name}_collides", checks=self.checks, detail=hit)
        return path

    def climb(self, q: np.ndarray, *, name: str) -> _Climb | NoPath:
        """The lowest of the extra heights above a way-point at which the leg keeps its full clearance."""
        hit = ""
        for height in self.config.extra_heights:
            path = self.raised(q, height)
            if path is None:
                hit += f"; {height:.2f} m higher is out of reach"
                break
            self.checks += len(path)
            if all(self.collision.is_free_near_ground(p) for p in path) and self.collision.is_free(path[-1]):
                return _Climb(path, height)
            hit = str(self.collision.first_collision(path[-1]))
        return NoPath(reason=f"{name}_waypoint_collides", checks=self.checks, detail=hit)

    def raised(self, q: np.ndarray, height: float) -> np.ndarray | None:
        """Joint path straight up by a height from q, q first; None out of reach."""
        if height == 0.0:
            return q[None].copy()
        a = self.collision.wheel_in_hex(q)
        b = a + height * self.collision.world_from_hex.rotation[2]
        path = self._solve(a, b, q)
        if isinstance(path, str) or float(np.abs(path[0] - q).max()) > self.config.branch_tolerance:
            return None
        path[0] = q
        return path

    def _solve(self, a: Vec3, b: Vec3, posture: np.ndarray) -> np.ndarray | str:
        """Joint angles along a straight line of the wheel in hex; else what is wrong."""
        n = 1 + max(1, int(np.ceil(np.linalg.norm(b - a) / self.config.vertical_step)))
        points = a + np.linspace(0.0, 1.0, n)[:, None] * (b - a)
        direction = self.collision.last_link_in_hex(posture)
        q, ok = leg_ik(self.spec, self.collision.leg, points, last_link_in_hex=direction)
        if not ok.all():
            return f"leg {self.collision.leg + 1} cannot put its wheel at {np.round(points[np.argmin(ok)], 3)} in hex"
        step = float(np.abs(np.diff(q, axis=0)).max())
        if step > self.config.max_joint_step:
            return f"a joint moves {np.rad2deg(step):.0f} deg in one step of {self.config.vertical_step} m"
        return q


def _cross(
    a: np.ndarray,
    b: np.ndarray,
    checker: CountingChecker,
    straight: _Straight,
    planner: str,
    rng: np.random.Generator,
    config: SwingConfig,
) -> tuple[np.ndarray, str, float, int] | NoPath:
    """Path through the air between two free configurations: its nodes, the method, its raw length, smoothing rounds."""
    resolution = config.sbl.resolution
    for height in config.extra_heights:
        ups = straight.raised(a, height), straight.raised(b, height)
        if ups[0] is None or ups[1] is None:
            break
        nodes = np.concatenate([ups[0], ups[1][::-1]])
        if height == 0.0 and not (a != b).any():
            return nodes, "direct", 0.0, 0
        # The straight way is driven as it is; others are looked at finely once they are smoothed.
        spacing = config.smoothing.fine_resolution if height == 0.0 else resolution
        if all(EdgeCheck(p, q).is_free(checker, spacing) for p, q in _longest_first(nodes)):
            if height == 0.0:
                return _relieved(nodes, checker, straight, rng, config), "direct", path_length(nodes), 0
            smoothed = smooth(nodes, checker, config.smoothing)
            if not smoothed.confirmed:
                continue
            return _relieved(smoothed.waypoints, checker, straight, rng, config), "raised", smoothed.lengths[0], len(smoothed.lengths) - 1
    lower, upper = sampling_box(straight.spec, a, b, config)
    found = plan(planner, a, b, lower, upper, checker, rng, config.sbl)
    if isinstance(found, NoPath):
        return replace(found, checks=checker.count, detail=f"{planner}: {found.detail}")
    smoothed = smooth(found, checker, config.smoothing)
    if not smoothed.confirmed:
        return no_path("thin", checker, f"{planner}: something thinner than {resolution} rad lies across the path")
    return _relieved(smoothed.waypoints, checker, straight, rng, config), planner, smoothed.lengths[0], len(smoothed.lengths) - 1


def _relieved(
    nodes: np.ndarray, checker: CountingChecker, straight: _Straight, rng: np.random.Generator, config: SwingConfig
) -> np.ndarray:
    if config.relief is None:
        return nodes
    spec, collision = straight.spec, straight.collision
    peak = hanging_torque(spec, collision.leg, collision.world_from_hex)
    return relieve(nodes, peak, checker, spec.lower, spec.upper, rng, config.relief).waypoints


def _longest_first(nodes: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Edges, the one through the air first: it is the one that collides."""
    return sorted(itertools.pairwise(nodes), key=lambda edge: -float(np.linalg.norm(edge[1] - edge[0])))


def sampling_box(spec: RobotSpec, a: LegJoints, b: LegJoints, config: SwingConfig) -> tuple[LegJoints, LegJoints]:
    """Lower and upper corner [rad]: both ends padded by kind of joint, within the limits (an end may lie on one, or a hair beyond)."""
    padding = np.deg2rad([config.padding_deg[int(np.argmax(np.abs(joint.axis)))] for joint in spec.joints])
    low, high = np.minimum(a, b), np.maximum(a, b)
    lower = np.minimum(np.maximum(low - padding, spec.lower), low)
    upper = np.maximum(np.minimum(high + padding, spec.upper), high)
    return lower, upper
