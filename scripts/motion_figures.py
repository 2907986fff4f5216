"""What `bench_motion.py` measures: every planner on every problem of the frozen set, smoothed, relieved, and checked finely."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from bench_table import Row, row
from leg_problems import LegProblem
from swing_peers import constant_speed, peak_acceleration, toppra_figures

from athlete_twin.geometry.blended_path import blended
from athlete_twin.messages import CORNER_TOLERANCE
from athlete_twin.model.leg_timing import leg_timing
from athlete_twin.model.spec import RobotSpec, load_spec
from planner.motion.checker import CountingChecker, EdgeCheck
from planner.motion.cornering import free_corner_tolerance
from planner.motion.planners import plan
from planner.motion.relief import ReliefConfig, hanging_torque, path_peak, relieve
from planner.motion.sbl import NoPath, SblConfig
from planner.motion.smoothing import SmoothingConfig, path_length, smooth

SOLVED, MEDIAN, P95, SHORTER = ">= 0.99", "<= 0.05", "<= 0.5", ">= 0.25"
"""of SBL: share of the problems, seconds, and by how much smoothing shortens"""
HALVED, EXTRA, STATIC = "<= 0.5", "<= 0.1", "< 1.0"
"""of the torque-aware mode: excess over that of the shortest path, length on top of it, torque over its limit"""
FINE = 0.002
"""at which finished paths are checked again [rad]"""
EXCESS = 0.05
"""of a path's peak torque over that of its ends, over the limit: below it there is nothing to relieve"""
PEER = "rrtconnect"
PERIOD = 1.0 / 24.0
"""of the executive's control [s]"""


@dataclass(frozen=True, kw_only=True)
class SwingTime:
    """How long a smoothed path takes the executive, and by other means."""

    duration: float
    """[s]"""
    timing_seconds: float
    """that finding it takes"""
    peak: float
    """largest acceleration that is commanded [rad/s2]"""
    constant_speed: float
    """duration with velocities that jump [s]"""
    constant_speed_peak: float
    toppra: float
    """duration by toppra, NaN where it finds none [s]"""
    toppra_seconds: float


@dataclass(frozen=True, kw_only=True)
class Run:
    """One planner on one problem."""

    solved: bool
    reason: str
    seconds: float
    checks: int
    raw: float = np.nan
    """length before smoothing [rad]"""
    smoothed: float = np.nan
    smoothing_seconds: float = np.nan
    collides: bool = False
    """when looked at finely, as a polyline and as it is driven, its corners cut"""
    corner_tolerance: float = np.nan
    """by which they are [rad]"""
    swing: SwingTime | None = None
    """of the smoothed path; None where it was not asked for"""
    ends: float = np.nan
    """larger static torque of the two ends over its limit"""
    peak: float = np.nan
    """largest of the smoothed path"""
    relieved_peak: float = np.nan
    """largest of the torque-aware path; NaN where the mode was not asked for"""
    relieved: float = np.nan
    """its length [rad]"""
    relief_seconds: float = np.nan


def run(problem: LegProblem, method: str, *, number: int, seed: int, relief: ReliefConfig | None) -> Run:
    """Plan, smooth, check; the randomness is keyed by seed and number."""
    collision, (lower, upper) = problem.collision(), problem.box()
    rng, checker = np.random.default_rng([seed, number]), CountingChecker(refusal=collision.refusal)
    start = time.perf_counter()
    found = plan(method, problem.start, problem.goal, lower, upper, checker, rng, SblConfig())
    seconds = time.perf_counter() - start
    if isinstance(found, NoPath):
        return Run(solved=False, reason=found.reason, seconds=seconds, checks=checker.count)
    start = time.perf_counter()
    smoothed = smooth(found, collision.is_free, SmoothingConfig())
    smoothing_seconds = time.perf_counter() - start
    if not smoothed.confirmed:
        return Run(solved=False, reason="thin", seconds=seconds, checks=checker.count)
    spec = load_spec(problem.robot)
    peak = hanging_torque(spec, problem.leg, problem.world_from_hex)
    path, relieved, relief_seconds = smoothed.waypoints, None, np.nan
    if relief is not None:
        start = time.perf_counter()
        relieved = relieve(path, peak, collision.is_free, spec.lower, spec.upper, rng, relief).waypoints
        relief_seconds = time.perf_counter() - start
    finished = [path] if relieved is None else [path, relieved]
    tolerances = [
        free_corner_tolerance(p, [collision.is_free] * (len(p) - 1), most=CORNER_TOLERANCE, spacing=FINE) for p in finished
    ]
    driven = [blended(p, tolerance) for p, tolerance in zip(finished, tolerances, strict=True)]
    looked_at = [q for p in driven for q in p.at(np.linspace(0.0, p.length, 2 + int(p.length / FINE)))]
    return Run(
        solved=True,
        reason="",
        seconds=seconds,
        checks=checker.count,
        raw=path_length(found),
        smoothed=path_length(path),
        smoothing_seconds=smoothing_seconds,
        collides=any(not EdgeCheck(a, b).is_free(collision.is_free, FINE) for p in finished for a, b in itertools.pairwise(p))
        or not all(collision.is_free(q) for q in looked_at),
        corner_tolerance=tolerances[0],
        swing=_swing_time(spec, path, tolerances[0]) if method == "sbl" else None,
        ends=float(peak(np.array([problem.start, problem.goal])).max()),
        peak=path_peak(path, peak),
        relieved_peak=np.nan if relieved is None else path_peak(relieved, peak),
        relieved=np.nan if relieved is None else path_length(relieved),
        relief_seconds=relief_seconds,
    )


def _swing_time(spec: RobotSpec, path: np.ndarray, tolerance: float) -> SwingTime:
    start = time.perf_counter()
    motion = leg_timing(spec, path, corner_tolerance=tolerance)
    samples = np.array(list(motion.samples(PERIOD)))
    seconds = time.perf_counter() - start
    plain = constant_speed(path, spec.speed_unloaded, PERIOD)
    toppra, toppra_seconds = toppra_figures(motion, spec)
    return SwingTime(
        duration=motion.duration, timing_seconds=seconds, peak=peak_acceleration(samples, path[0], PERIOD),
        constant_speed=PERIOD * len(plain), constant_speed_peak=peak_acceleration(plain, path[0], PERIOD),
        toppra=toppra, toppra_seconds=toppra_seconds,
    )  # fmt: skip


def measure(
    problems: Sequence[LegProblem], methods: Sequence[str], *, seed: int, torque: bool, told: Callable[[str], None]
) -> dict[str, list[Run]]:
    """All planners on all problems; only SBL's paths are relieved, if `torque`. `told` hears of each run's planner."""
    runs: dict[str, list[Run]] = {method: [] for method in methods}
    spec = load_spec(problems[0].robot)
    leg_timing(spec, np.stack([spec.lower, spec.upper]), corner_tolerance=CORNER_TOLERANCE)  # compiled once, in nobody's time
    for number, problem in enumerate(problems):
        for method in methods:
            relief = ReliefConfig() if torque and method == "sbl" else None
            runs[method].append(run(problem, method, number=number, seed=seed, relief=relief))
            told(method)
    return runs


def rows(runs: dict[str, list[Run]], problems: Sequence[LegProblem]) -> list[Row]:
    """The table's rows: all problems together, then each robot's alone for SBL."""
    out: list[Row] = []
    peer = _median_seconds(runs[PEER]) if PEER in runs else None
    for method, its in runs.items():
        out += _planner_rows(method, its, peer if method != PEER else None)
    if "sbl" in runs:
        if np.isfinite([r.relieved for r in runs["sbl"]]).any():
            out += _relief_rows(runs["sbl"])
        for robot in dict.fromkeys(p.robot for p in problems):
            out += _swing_rows(robot, [r for r, p in zip(runs["sbl"], problems, strict=True) if p.robot == robot and r.solved])
        for robot in dict.fromkeys(p.robot for p in problems):
            own = [r for r, p in zip(runs["sbl"], problems, strict=True) if p.robot == robot]
            out.append(row(f"sbl, {robot}: problems solved", float(np.mean([r.solved for r in own])), "share", target=SOLVED))
            out.append(row(f"sbl, {robot}: time to plan, median", _median_seconds(own), "s", target=MEDIAN))
    return out


def _planner_rows(method: str, its: list[Run], peer: float | None) -> list[Row]:
    ours, solved = method == "sbl", [r for r in its if r.solved]
    seconds = np.array([r.seconds for r in its])
    raw, short = (np.array([getattr(r, name) for r in solved]) for name in ("raw", "smoothed"))
    peaks = np.array([r.peak for r in solved])
    name = f"{method}, {len(its)} problems"
    return [
        row(f"{name}: solved", len(solved) / len(its), "share", target=SOLVED if ours else ""),
        row(
            f"{method}: time to plan, median", float(np.median(seconds)), "s", target=MEDIAN if ours else "",
            peer_name=None if peer is None else PEER, peer=peer,
        ),
        row(f"{method}: time to plan, 95th percentile", float(np.quantile(seconds, 0.95)), "s", target=P95 if ours else ""),
        row(f"{method}: state checks, median", float(np.median([r.checks for r in its])), ""),
        row(f"{method}: length before smoothing, mean", _mean(raw), "rad"),
        row(f"{method}: length after smoothing, mean", _mean(short), "rad"),
        row(f"{method}: smoothing shortens all paths together by", _share(raw, short), "share", target=SHORTER if ours else ""),
        row(f"{method}: time to smooth, median", _median([r.smoothing_seconds for r in solved]), "s"),
        row(f"{method}: finished paths that collide at {FINE} rad", float(sum(r.collides for r in solved)), "", target="<= 0"),
        row(f"{method}: peak static torque, median", _median(peaks), "of the limit"),
        row(f"{method}: peak static torque, largest", float(peaks.max()) if len(peaks) else None, "of the limit"),
    ]  # fmt: skip


def _swing_rows(robot: str, its: list[Run]) -> list[Row]:
    swings = [r.swing for r in its if r.swing is not None]
    if not swings:
        return []
    by = {name: np.array([getattr(s, name) for s in swings]) for name in SwingTime.__dataclass_fields__}
    found = np.isfinite(by["toppra"])
    limit = load_spec(robot).acceleration_unloaded
    name, jumps = f"{robot}, {len(swings)} swings", "constant speed, with jumps"
    return [
        row(f"{name}: duration, mean", float(by["duration"].mean()), "s", peer_name=jumps, peer=float(by["constant_speed"].mean())),
        row(f"{name}: duration over constant speed's, largest", float((by["duration"] / by["constant_speed"]).max()), "1"),
        row(f"{name}: acceleration commanded, largest", float(by["peak"].max()), "rad/s2", target=f"<= {limit * (1 + 1e-6):.7g}",
            peer_name=jumps, peer=float(by["constant_speed_peak"].max())),
        row(f"{name}: those that cut corners by the whole tolerance",
            float(np.mean([r.corner_tolerance == CORNER_TOLERANCE for r in its])), "share"),
        row(f"{name}: swings that stop at corners", float(sum(r.corner_tolerance == 0.0 for r in its)), ""),
        row(f"{name}: duration where toppra finds one ({int(found.sum())}), mean", _mean(by["duration"][found]), "s",
            target="<= 1.001", of="ratio", peer_name="toppra", peer=_mean(by["toppra"][found])),
        row(f"{name}: time to find it, median", float(np.median(by["timing_seconds"])), "s", target="<= 0.02",
            peer_name="toppra", peer=float(np.median(by["toppra_seconds"]))),
        row(f"{name}: time to find it, 95th percentile", float(np.quantile(by["timing_seconds"], 0.95)), "s", target="<= 0.02",
            peer_name="toppra", peer=float(np.quantile(by["toppra_seconds"], 0.95))),
    ]  # fmt: skip


def _relief_rows(its: list[Run]) -> list[Row]:
    solved = [r for r in its if r.solved]
    heavy = [r for r in solved if r.peak - r.ends > EXCESS]
    left = [(r.relieved_peak - r.ends) / (r.peak - r.ends) for r in heavy]
    extra = [r.relieved / r.smoothed - 1.0 for r in solved if r.smoothed > 0.0]
    # Ends that saturate are the problem's, not the path's.
    worst = [r.relieved_peak for r in solved]
    name = "torque-aware"
    return [
        row(f"{name}: largest peak static torque", max(worst, default=None), "of the limit", target=STATIC),
        row(
            f"{name}: excess over the ends' torque left, median of {len(heavy)} paths where it is above {EXCESS}", _median(left), "share",
            target=HALVED,
        ),
        row(f"{name}: length on top, largest", max(extra, default=None), "share", target=EXTRA),
        row(f"{name}: time on top, median where there is excess", _median([r.relief_seconds for r in heavy]), "s"),
    ]  # fmt: skip


def _median_seconds(its: Sequence[Run]) -> float:
    return float(np.median([r.seconds for r in its]))


def _median(values: Sequence[float] | np.ndarray) -> float | None:
    return float(np.median(values)) if len(values) else None


def _mean(values: np.ndarray) -> float | None:
    return float(values.mean()) if len(values) else None


def _share(before: np.ndarray, after: np.ndarray) -> float | None:
    return float(1.0 - after.sum() / before.sum()) if len(before) and before.sum() > 0.0 else None
