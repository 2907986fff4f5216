"""How long a solve of the contact springs takes with six feet, beside SciPy's Levenberg-Marquardt on the same equations.

Stances are random: feet about their regular places, uneven springs, heights about their contact points, in half of them
one leg in the air. The peer is `scipy.optimize.least_squares(method="lm")` with finite differences, as one would
write eqs 4-12 of [SunSpiral2012] in numpy, from the same start; it runs in turn with ours, ten stances each. A second row gives SciPy our
compiled equations, so that only the derivatives and the iteration differ. Last comes the chassis pose before a lift,
each leg of stances with uneven springs. `bench_sag.py` prints the rows.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from bench_table import Row, row, show
from scipy.optimize import least_squares

from athlete_twin.model.kinematics import GRAVITY, kinematics
from athlete_twin.model.stance import regular_stance
from planner.sag.lift_pose import LiftPose, PoseConfig
from planner.sag.pose import optimise_pose
from planner.sag.sag_model import AIRBORNE, SOFT_CONTACT, FootSprings, SagSolution, solve_sag
from planner.sag.spring_equations import spring_equations

ROBOTS = ("sdm_b", "t12")
STANCES = 300
"""of each robot"""
TARGET_MS, TARGET_FASTER, TARGET_MM = "<= 1.0", ">= 30", "<= 0.1"
BLOCK = 10
"""stances that one solver works on before the next has them: in turn, but no solver's code pushes another's out of caches
before each solve"""
SPREAD = 0.12
"""of the feet about their regular places, one sigma [m]"""
SPREAD_LIFT = 0.01
"""of the feet's heights about their contact points, one sigma [m]"""
UNEVEN = 0.125
"""of the spring constants, one sigma: what +- 1 psi of 8 psi does, [SunSpiral2012] s5.1.4"""
POSE_ROUNDS, POSE_TARGET_MS = 10, "<= 10"
CLEARANCE = 0.2
"""asked for of the lifted wheel [m]"""
SOLVED = 1e-7
"""largest scaled residual at which SciPy's answer counts as one"""
PAIRS = np.array([(i, j) for i in range(6) for j in ((i + 1) % 6, (i + 2) % 6, 6)])
"""whose distances stay, eqs 6-8; 6 is the CoM"""


@dataclass(frozen=True, eq=False, kw_only=True)
class Stance:
    """One problem, as `solve_sag` takes it."""

    feet: np.ndarray
    com: np.ndarray
    weight: float
    springs: FootSprings
    lifts: np.ndarray

    def ours(self) -> SagSolution:
        """By the planner's solver."""
        return solve_sag(
            self.feet, self.com, self.weight, stiffness_z=self.springs.stiffness_z,
            lateral_ratio=self.springs.lateral_ratio, lifts=self.lifts,
        )  # fmt: skip


def rows(*, robots: tuple[str, ...] = ROBOTS, stances: int = STANCES) -> list[Row]:
    """Median milliseconds, how many times faster than SciPy, and the largest difference of the answers."""
    return [one for robot in robots for one in _rows(robot, stances)]


def _rows(robot: str, count: int) -> list[Row]:
    rng = np.random.default_rng(ROBOTS.index(robot))
    spent: list[np.ndarray] = []
    off: list[float] = []
    drawn = 0
    _block([_stance(robot, rng)])  # compiles
    while len(off) < count:
        times, apart = _block([_stance(robot, rng) for _ in range(BLOCK)])
        drawn += BLOCK
        spent.append(times[:, np.isfinite(apart)])
        off.extend(apart[np.isfinite(apart)])
    ours, in_numpy, compiled = (1e3 * float(t) for t in np.median(np.hstack(spent), axis=1))
    name = f"{robot} sag of {len(off)} stances"
    faster, scipy = "how many times faster", "scipy least_squares lm"
    return [
        row(f"{name}, median", ours, "ms", target=TARGET_MS, peer_name=scipy, peer=in_numpy),
        row(f"{name}, {faster} than {scipy}", in_numpy / ours, "x", target=TARGET_FASTER),
        row(f"{name}, {faster} than {scipy} on our compiled equations", compiled / ours, "x"),
        row(f"{name}, largest difference of a foot", 1e3 * max(off), "mm", target=TARGET_MM),
        row(f"{name}, of those drawn that both solve", 100.0 * len(off) / drawn, "%"),
        _pose_row(robot, rng),
    ]


def _pose_row(robot: str, rng: np.random.Generator) -> Row:
    kin = kinematics(robot)
    motors, times, found = regular_stance(kin.spec), [], 0
    for _ in range(POSE_ROUNDS):
        springs = _springs(robot, rng)
        for leg in range(6):
            pose, seconds = _timed(
                partial(optimise_pose, kin, motors, leg, springs=springs, clearance=CLEARANCE, config=PoseConfig())
            )
            found += isinstance(pose, LiftPose)
            times.append(1e3 * seconds)
    what = f"{robot} chassis pose before a lift, median of {len(times)} of which {found} have one"
    return row(what, float(np.median(times)), "ms", target=POSE_TARGET_MS)


def _stance(robot: str, rng: np.random.Generator) -> Stance:
    kin = kinematics(robot)
    spec = kin.spec
    joints = regular_stance(spec)
    lifts = rng.normal(0.0, SPREAD_LIFT, 6)
    if rng.random() < 0.5:
        lifts[rng.integers(6)] = AIRBORNE
    return Stance(
        feet=kin.wheels_in_hex(joints) + rng.normal(0.0, SPREAD, (6, 3)) * [1.0, 1.0, 0.5],
        com=kin.com_in_hex(joints) + rng.normal(0.0, 0.05, 3),
        weight=spec.mass * GRAVITY,
        springs=_springs(robot, rng),
        lifts=lifts,
    )


def _springs(robot: str, rng: np.random.Generator) -> FootSprings:
    drawn = FootSprings.from_spec(kinematics(robot).spec)
    stiffness = drawn.stiffness_z * np.maximum(0.5, 1.0 + rng.normal(0.0, UNEVEN, 6))
    return FootSprings(stiffness_z=stiffness, lateral_ratio=drawn.lateral_ratio)


def _block(stances: list[Stance]) -> tuple[np.ndarray, np.ndarray]:
    """Seconds of ours, of SciPy, of SciPy on compiled equations, (3, n), and how far our feet are from SciPy's, (n,) [m].

    The distance is not a number where ours says that there is no solution, or SciPy ended elsewhere.
    """
    begin, off = np.tile([0.0, 0.0, -1.0], 7), np.full(len(stances), np.nan)
    numpy_equations, compiled = [_numpy_equations(s) for s in stances], [_compiled_equations(s) for s in stances]
    ours = [_timed(s.ours) for s in stances]
    peers = [_timed(partial(least_squares, f, begin, method="lm")) for f in numpy_equations]
    others = [_timed(partial(least_squares, f, begin, method="lm")) for f in compiled]
    for i, (stance, (mine, _), (found, _)) in enumerate(zip(stances, ours, peers, strict=True)):
        if mine.converged and np.abs(found.fun).max() <= SOLVED:
            off[i] = np.abs(_scale(stance) * found.x.reshape(7, 3)[:6] - mine.displacements).max()
    return np.array([[seconds for _, seconds in run] for run in (ours, peers, others)]), off


def _timed(call: Callable[[], Any]) -> tuple[Any, float]:
    start = time.perf_counter()
    result = call()
    return result, time.perf_counter() - start


def _scale(stance: Stance) -> float:
    return stance.weight / float(stance.springs.stiffness_z.sum())


def _middle_and_size(stance: Stance) -> tuple[np.ndarray, float]:
    """Unsagged feet and CoM about the middle of the feet, shape (7, 3), and the feet's mean distance from there [m]."""
    middle = np.vstack([stance.feet, stance.com]) - stance.feet.mean(axis=0)
    return middle, float(np.linalg.norm(middle[:6], axis=1).mean())


def _numpy_equations(stance: Stance) -> Callable[[np.ndarray], np.ndarray]:
    """Eqs 4-12 as a function of 21 scaled displacements, gravity along -z, contact coming in as the planner's does."""
    r0, size = _middle_and_size(stance)
    scale, weight, k = _scale(stance), stance.weight, stance.springs.stiffness_z
    a, b = PAIRS.T
    before = np.linalg.norm(r0[a] - r0[b], axis=1)

    def left(x: np.ndarray) -> np.ndarray:
        d = scale * x.reshape(7, 3)
        p = r0 + d
        compression = -d[:6, 2] - stance.lifts
        s = np.clip(compression / SOFT_CONTACT, 0.0, 1.0)
        forces = np.empty((6, 3))
        forces[:, :2] = -(stance.springs.lateral_ratio * k * s * s * (3.0 - 2.0 * s))[:, None] * d[:6, :2]
        forces[:, 2] = k * np.maximum(compression, 0.0)
        force = forces.sum(axis=0) / weight - [0.0, 0.0, 1.0]
        moment = np.cross(p[:6], forces).sum(axis=0) / weight + np.cross(p[6], [0.0, 0.0, -1.0])
        return np.concatenate([force, moment / size, (np.linalg.norm(p[a] - p[b], axis=1) - before) / scale])

    return left


def _compiled_equations(stance: Stance) -> Callable[[np.ndarray], np.ndarray]:
    """The planner's own residuals as a function of 21 scaled displacements."""
    r0, size = _middle_and_size(stance)
    scale, weight, k = _scale(stance), stance.weight, stance.springs.stiffness_z.copy()
    ratio, lifts, derivatives = stance.springs.lateral_ratio, stance.lifts.copy(), np.empty((24, 21))

    def left(x: np.ndarray) -> np.ndarray:
        out = np.empty(24)
        spring_equations(
            x.reshape(7, 3), r0, weight, k, ratio, lifts, True, SOFT_CONTACT, size, scale, out, derivatives
        )
        return out

    return left


def main() -> None:
    """Prints the rows."""
    show(rows(), as_json="--json" in sys.argv[1:])


if __name__ == "__main__":
    main()
