"""Makes the frozen set of leg problems: 250 a robot, from free ground to a rock beside the leg.

    python scripts/build_leg_problems.py [--problems 250] [--seed 0] [--out assets]

A robot stands on wheels drawn about its regular stance, one leg in the air; start and goal are a step apart, both free. A problem is
kept when OMPL's RRTConnect solves it within 30,000 checks, SBL is never asked, and as long as no more than 38 % of those kept are
passed by the straight line in joint space, and no more than 38 % by the plain way up, over and down: each fails on 60 % at least.
Draws are keyed by their number, so that the set is the same whenever it is made.
"""

from __future__ import annotations

import itertools
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from leg_problems import DIGITS, FOLDER, MOST_ROCKS, ROBOTS, LegProblem, save_problems
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.kinematics import kinematics
from athlete_twin.model.reach import all_legs_ik, leg_ik
from athlete_twin.model.spec import RobotSpec, load_spec
from athlete_twin.model.stance import stance_wheels_in_hex
from planner.motion.checker import CountingChecker, EdgeCheck
from planner.motion.collision import LegCollision
from planner.motion.planners import plan
from planner.motion.sbl import NoPath, SblConfig

DOWN = np.array([0.0, 0.0, -1.0])
EASY = 0.38
"""share of the problems kept that a simple way may pass"""
CERTIFIER, BUDGET = "rrtconnect", 30_000
LEVELS = (0.10, 0.15, 0.30, 0.20, 0.25)
"""how often each level is drawn"""
RESOLUTION = 0.01
POINTS = 25
"""of a straight way of the wheel"""


@dataclass(frozen=True, kw_only=True)
class Options:
    """Draws, certifies and writes."""

    problems: int = 250
    """a robot"""
    seed: int = 0
    out: Path = FOLDER


def main(arguments: list[str] | None = None) -> int:
    """Runs the script; the exit status."""
    options = tyro.cli(Options, args=arguments, description=__doc__)
    if options.problems < 1 or options.seed < 0:
        sys.stderr.write(f"build_leg_problems: --problems {options.problems}, --seed {options.seed}: need 1 or more, and 0 or more\n")
        return 2
    kept: list[LegProblem] = []
    columns = (TextColumn("{task.description:8}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        for robot in ROBOTS:
            kept += collect(robot, options.problems, options.seed, progress)
    digest = save_problems(kept, options.out)
    for level in range(len(LEVELS)):
        sys.stdout.write(f"level {level}: {sum(p.level == level for p in kept)}\n")
    sys.stdout.write(f"{len(kept)} problems, {digest}\n")
    return 0


def collect(robot: str, wanted: int, seed: int, progress: Progress) -> list[LegProblem]:
    """The first draws that qualify."""
    kept: list[LegProblem] = []
    easy = {"straight": 0, "over": 0}
    task = progress.add_task(robot, total=wanted)
    for number in itertools.count():
        rng = np.random.default_rng([seed, ROBOTS.index(robot), number])
        problem = draw(robot, rng)
        if problem is None:
            continue
        collision = problem.collision()
        passed = {"straight": passes_straight(problem, collision), "over": passes_over(problem, collision)}
        # Some easy problems belong in the set, but never more than their share of it.
        if any(ok and easy[name] + 1 > EASY * (len(kept) + 1) for name, ok in passed.items()):
            continue
        if not certified(problem, collision, rng):
            continue
        for name, ok in passed.items():
            easy[name] += ok
        kept.append(problem)
        progress.advance(task)
        if len(kept) == wanted:
            share = {name: 1.0 - count / wanted for name, count in easy.items()}
            sys.stdout.write(f"{robot}: {number + 1} draws; straight fails on {share['straight']:.0%}, over on {share['over']:.0%}\n")
            return kept
    raise AssertionError  # never: the count does not end


def draw(robot: str, rng: np.random.Generator) -> LegProblem | None:
    """A stance with a leg in the air, rocks, and two places that the leg reaches without touching anything; None when it is not one."""
    spec = load_spec(robot)
    leg, level = int(rng.integers(6)), int(rng.choice(len(LEVELS), p=LEVELS))
    tilt = np.deg2rad(rng.uniform(-4.0, 4.0, 2))
    turned = SE3.from_rpy(float(tilt[0]), float(tilt[1]), float(rng.uniform(-np.pi, np.pi)))
    pose = SE3(turned.rotation, np.array([0.0, 0.0, spec.chassis_height + rng.uniform(-0.15, 0.10)]))
    wheels = pose.apply(stance_wheels_in_hex(spec))
    wheels[:, :2] += rng.uniform(-0.25, 0.25, (6, 2)) * spec.stride
    wheels[:, 2] = spec.wheel.radius
    hex_from_world = pose.inverse()
    down = hex_from_world.rotate(DOWN)
    joints, ok = all_legs_ik(spec, hex_from_world.apply(wheels), last_link_in_hex=down)
    if not ok.all():
        return None
    begin = wheels[leg] + [*rng.uniform(-0.3, 0.3, 2) * spec.stride, 0.0]
    way = rng.uniform(0.4, 1.2) * spec.stride * _direction(rng)
    ends = np.array([begin, begin + [*way, 0.0]])
    ends[:, 2] += rng.uniform(0.4, 1.0, 2) * spec.wheel.radius
    q, ok = leg_ik(spec, leg, hex_from_world.apply(ends), last_link_in_hex=down)
    if not ok.all():
        return None
    rocks = _rocks(spec, rng, level, ends, pose.apply(spec.hips_in_hex[leg]))
    problem = LegProblem(
        robot=robot, leg=leg, level=level, joints=joints, start=q[0], goal=q[1], world_from_hex=pose,
        middle=np.round(ends[:, :2].mean(axis=0), 2), rocks=rocks,
    )  # fmt: skip
    collision = problem.collision()
    return problem if collision.is_free(q[0]) and collision.is_free(q[1]) else None


def _rocks(spec: RobotSpec, rng: np.random.Generator, level: int, ends: np.ndarray, hip: np.ndarray) -> np.ndarray:
    """Rows of x, y, radius and height [m]."""
    middle, span = ends[:, :2].mean(axis=0), ends[1, :2] - ends[0, :2]
    across = np.array([-span[1], span[0]]) / np.linalg.norm(span)
    size = spec.wheel.radius
    rows: list[list[float]] = []
    if level in (1, 3):
        for _ in range(int(rng.integers(4, 9))):
            rows.append([*(middle + rng.uniform(-4.0, 4.0, 2) * size), *(size * rng.uniform([0.3, 0.2], [1.0, 1.2]))])
    if level >= 2:
        place = ends[0, :2] + rng.uniform(0.35, 0.65) * span + rng.normal(0.0, 0.5) * size * across
        rows.append([*place, size * rng.uniform(0.4, 1.2), size * rng.uniform(1.0, 4.5)])
    if level == 4:
        # Beside the line from hip to wheel, as high as the leg's upper links.
        t = rng.uniform(0.25, 0.8)
        end = ends[int(rng.integers(2)), :2]
        reach = end - hip[:2]
        side = np.array([-reach[1], reach[0]]) / np.linalg.norm(reach) * rng.choice([-1.0, 1.0])
        radius = size * rng.uniform(0.6, 1.5)
        rows.append([*(hip[:2] + t * reach + (radius + size * rng.uniform(0.4, 1.5)) * side), radius, rng.uniform(0.5, 1.3) * hip[2]])
    return np.round(np.array(rows[:MOST_ROCKS], dtype=float).reshape(-1, 4), DIGITS)


def passes_straight(problem: LegProblem, collision: LegCollision) -> bool:
    """Whether the straight line in joint space is free."""
    return EdgeCheck(problem.start, problem.goal).is_free(collision.is_free, RESOLUTION)


def passes_over(problem: LegProblem, collision: LegCollision) -> bool:
    """Whether the plain way is free: a wheel's diameter up from the higher end, over there, straight along, and down."""
    spec = load_spec(problem.robot)
    hex_from_world = problem.world_from_hex.inverse()
    axles = [kinematics(problem.robot).leg_wheel(problem.leg, q).translation for q in (problem.start, problem.goal)]
    ends = problem.world_from_hex.apply(np.array(axles))
    top = float(ends[:, 2].max()) + 2.0 * spec.wheel.radius
    corners = np.array([ends[0], [*ends[0, :2], top], [*ends[1, :2], top], ends[1]])
    s = np.linspace(0.0, 1.0, POINTS)[:, None]
    way = np.concatenate([a + s * (b - a) for a, b in itertools.pairwise(corners)])
    q, ok = leg_ik(spec, problem.leg, hex_from_world.apply(way), last_link_in_hex=hex_from_world.rotate(DOWN))
    if not ok.all():
        return False
    return all(EdgeCheck(a, b).is_free(collision.is_free, RESOLUTION) for a, b in itertools.pairwise(q))


def certified(problem: LegProblem, collision: LegCollision, rng: np.random.Generator) -> bool:
    """Whether a planner other than SBL finds a way."""
    lower, upper = problem.box()
    checker = CountingChecker(refusal=collision.refusal)
    found = plan(CERTIFIER, problem.start, problem.goal, lower, upper, checker, rng, SblConfig(max_checks=BUDGET))
    return not isinstance(found, NoPath)


def _direction(rng: np.random.Generator) -> np.ndarray:
    angle = rng.uniform(-np.pi, np.pi)
    return np.array([np.cos(angle), np.sin(angle)])


if __name__ == "__main__":
    sys.exit(main())
