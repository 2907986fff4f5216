"""The stances in which an individual robot is read: a few known ones to calibrate it, random ones to be judged by.

Calibration: all wheels down, each leg lifted, opposite legs lifted, from the regular stance. Judgement: before each
stance one foot is put elsewhere and the chassis is moved, lowered, tilted and turned at random; then none, one or two legs are
lifted, in turn. What the drawings say would tip or saturate is drawn again; what the robot refuses is counted. A robot that refuses a
stance of the calibration is told as such, and costs nobody else's rows.
"""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from sag_lifts import LiftCurve, lift_curve
from sag_yard import DEEPEST, Reading, SagYard, StanceRefusedError

from athlete_twin.errors import AthleteError
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.reach import all_legs_ik, leg_ik
from athlete_twin.model.spec import LEGS

Drawn = TypeVar("Drawn")

CALIBRATION: tuple[tuple[int, ...], ...] = ((), (0,), (1,), (2,), (3,), (4,), (5,), (0, 3), (1, 4), (2, 5))
"""legs in the air, by index; as [SunSpiral2012] s5.1.2: none, one and two"""
SIX_POSES = slice(1, 7)
"""of them, those from which the constants of single wheels are found: each leg lifted once"""
RAISED = {"sdm_b": 0.35, "t12": 0.45}
"""commanded lift of a leg that shall be in the air, with certainty [m]"""
OVER = {"sdm_b": 0.30, "t12": 0.40}
"""and of one that shall be put elsewhere [m]"""
SIZE = {"sdm_b": 1.0, "t12": 1.6}
"""by which the random moves grow with the robot: about that of its legs"""
LEAST_MARGIN = 0.20
"""of the support polygon, by the drawings [m]"""
MOST_TORQUE = 0.65
"""static joint torque over its limit, by the drawings; the twin's legs also work against each other"""
EMERGENCY_TORQUE = 1.5
"""over the limit, that a robot may use to get its wheels down again after it refused something"""
DRAWS = 40
"""of one stance before none is taken to be possible from where the robot stands"""


@dataclass(frozen=True, eq=False, kw_only=True)
class Individual:
    """All readings of one robot."""

    robot: str
    seed: int
    calibration: tuple[Reading, ...]
    """in the order of `CALIBRATION`"""
    random: tuple[Reading, ...]
    refused: tuple[str, ...]
    """why the robot did not take stances that the drawings allowed"""
    curves: tuple[LiftCurve, ...]
    """of each leg that did lift slowly, from the regular stance"""
    unlifted: tuple[str, ...] = ()
    """why others did not"""


@dataclass(frozen=True, kw_only=True)
class Unmeasured:
    """A robot that did not take a stance it should be calibrated in: nothing can be said of its springs."""

    robot: str
    seed: int
    reason: str


def measure_individual(job: tuple[str, int, int]) -> Individual | Unmeasured:
    """Robot, seed, number of random stances: everything that is read of one individual. About 5 s a stance."""
    robot, seed, count = job
    try:
        yard = SagYard(robot, seed)
    except AthleteError as e:
        return Unmeasured(robot=robot, seed=seed, reason=str(e))
    try:
        calibration: list[Reading] = []
        for lifted in CALIBRATION:
            try:
                calibration.append(_read_lifted(yard, lifted))
            except AthleteError as e:
                legs = " and ".join(str(leg + 1) for leg in lifted) or "none"
                return Unmeasured(robot=robot, seed=seed, reason=f"stance with legs lifted: {legs}: {e}")
        curves, unlifted, stands = _lift_curves(yard)
        random, refused = _random_readings(yard, count) if stands else ((), ())
        return Individual(
            robot=robot, seed=seed, calibration=tuple(calibration), random=random, refused=refused, curves=curves, unlifted=unlifted
        )  # fmt: skip
    finally:
        yard.close()


def measure(jobs: list[tuple[str, int, int]]) -> Iterator[Individual | Unmeasured]:
    """The individuals in the order of the jobs, on as many processes as there are cores, at most two."""
    workers = min(2, len(os.sched_getaffinity(0)), len(jobs))
    if workers < 2:
        yield from map(measure_individual, jobs)
        return
    with multiprocessing.get_context("spawn").Pool(workers, maxtasksperchild=1) as pool:
        yield from pool.imap(measure_individual, jobs)


def _lift_curves(yard: SagYard) -> tuple[tuple[LiftCurve, ...], tuple[str, ...], bool]:
    """Curves of all legs that lift, why others do not, and whether the robot stands on all its wheels at the end."""
    curves: list[LiftCurve] = []
    unlifted: list[str] = []
    for leg in range(LEGS):
        try:
            curves.append(lift_curve(yard, leg, by=RAISED[yard.spec.name]))
        except StanceRefusedError as e:
            unlifted.append(f"leg {leg + 1}: {e}")
            if not _recovered(yard):
                return tuple(curves), (*unlifted, "it did not get up again: no further leg, no random stance"), False
    return tuple(curves), tuple(unlifted), True


def _random_readings(yard: SagYard, count: int) -> tuple[tuple[Reading, ...], tuple[str, ...]]:
    """Random stances that were read, and why the robot did not take others."""
    readings: list[Reading] = []
    refused: list[str] = []
    rng = np.random.default_rng([yard.seed, 4])
    while len(readings) < count and len(refused) <= count:
        try:
            _shuffle(yard, rng)
            readings.append(_read_lifted(yard, _drawn(lambda: _legs(yard, len(readings) % 3, rng), "legs to lift")))
        except StanceRefusedError as e:
            refused.append(str(e))
            if not _recovered(yard):
                break
    return tuple(readings), tuple(refused)


def _read_lifted(yard: SagYard, legs: tuple[int, ...]) -> Reading:
    """Lift some legs, read, and put them back."""
    for leg in legs:
        yard.raise_leg(leg, RAISED[yard.spec.name])
    reading = yard.read()
    for leg in reversed(legs):
        yard.put_down(leg)
    return reading


def _shuffle(yard: SagYard, rng: np.random.Generator) -> None:
    """One foot elsewhere, then the chassis; both about the regular stance, so that the robot does not wander off."""
    leg, path = _drawn(lambda: _foot(yard, rng), "foot to move")
    yard.move_foot(leg, path)
    yard.move_body(*_drawn(lambda: _pose(yard, rng), "pose of the chassis"))


def _foot(yard: SagYard, rng: np.random.Generator) -> tuple[int, np.ndarray] | None:
    """A leg and a path to another place, None if the drawings say that this cannot be."""
    spec = yard.spec
    leg = int(rng.integers(LEGS))
    radius = spec.foot_radius + SIZE[spec.name] * rng.uniform(-0.15, 0.15)
    azimuth = spec.foot_azimuths[leg] + rng.uniform(-0.14, 0.14)
    path = yard.foot_path(leg, radius * np.array([np.cos(azimuth), np.sin(azimuth)]), over=OVER[spec.name])
    reached = leg_ik(spec, leg, path, last_link_in_hex=-yard.up_in_hex)[1]
    return (leg, path) if reached.all() and _can_stand_without(yard, (leg,)) else None


def _pose(yard: SagYard, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray] | None:
    """Translation [m] and rotation [rad] of the chassis, None if a leg would not reach its wheel or could not be lifted."""
    spec, size = yard.spec, SIZE[yard.spec.name]
    axles, up = yard.axles, yard.up_in_hex
    middle = axles.mean(axis=0)
    height = spec.wheel.radius - float(middle @ up)
    translation = np.array([*(middle[:2] + size * rng.uniform(-0.08, 0.08, 2)), 0.0])
    translation[2] = spec.chassis_height + size * rng.uniform(-0.10, 0.05) - height
    level = np.array([-up[1], up[0], 0.0])
    rotvec = level + np.array([*rng.uniform(-0.04, 0.04, 2), rng.uniform(-0.06, 0.06)])
    hex_from_start = SE3.from_rotvec(rotvec, translation).inverse()
    placed, plumb = hex_from_start.apply(axles), hex_from_start.rotate(up)
    lifts = np.array([-DEEPEST, 0.0, RAISED[spec.name]])[:, None, None] * plumb
    reached = [all_legs_ik(spec, placed + lift, last_link_in_hex=-plumb)[1].all() for lift in lifts]
    return (translation, rotvec) if all(reached) else None


def _drawn(draw: Callable[[], Drawn | None], what: str) -> Drawn:
    """The first draw that is possible."""
    for _ in range(DRAWS):
        drawn = draw()
        if drawn is not None:
            return drawn
    raise StanceRefusedError(f"the drawings allow no {what} of {DRAWS} drawn")


def _legs(yard: SagYard, count: int, rng: np.random.Generator) -> tuple[int, ...] | None:
    """So many legs, None if the drawings do not let the robot lift them one after the other."""
    legs = tuple(int(leg) for leg in rng.choice(LEGS, count, replace=False))
    return legs if all(_can_stand_without(yard, legs[: k + 1]) for k in range(count)) else None


def _can_stand_without(yard: SagYard, legs: tuple[int, ...]) -> bool:
    return yard.margin_without(legs) > LEAST_MARGIN and yard.torque_without(legs) < MOST_TORQUE


def _recovered(yard: SagYard) -> bool:
    """Whether a robot that refused something stands on all its wheels again."""
    try:
        for leg in reversed(yard.lifted):
            yard.put_down(leg, torque=EMERGENCY_TORQUE)
        yard.level(torque=EMERGENCY_TORQUE)
    except StanceRefusedError:
        return False
    return True
