"""The rows of `bench_gait.py` that the twin walks on slopes and at its longest strides.

A stance is planned with reach to spare, for a robot sags and its encoders are off; the planned slope is then walked, and where
the twin does not finish, gentler ones until it does. Nothing is corrected on the way, so drift and slip are those of one cycle.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from bench_table import Row, row
from gait_figures import AHEAD, PAIRS, SLOPES_DEG, Gaits, told
from gait_yard import GaitYard, WalkedCycle
from sag_yard import StanceRefusedError

from athlete_twin.world.scenario import load_scenario
from planner.gait.cycle import gait_cycle, judge_cycle
from planner.gait.limits import DECKS, longest_stride
from planner.gait.slope_stance import NoSlopeStance, SlopeSearch, SlopeStance, stance_on, steepest_stance

SPARE, CLEARANCE = 0.05, 0.12
"""of reach, and between ground and hull, in every planned stance that is walked: the robot sags by so much [m]"""
SHARES = (1.0, 0.5)
"""of the robot's stride, tried on the paper's slopes until the twin finishes"""
LIFT = {"sdm_b": 0.25, "t12": 0.45}
"""of a swinging wheel: T12 sags by 0.35 m before its wheels break contact on slopes, SDM-B by less than 0.15 m [m]"""
SAND, HARD = "slope_14", "calibration_yard"
"""the paper's loose sand on a hard base (friction 0.45), and concrete (0.75)"""
FRICTION = 0.75
"""of concrete; a slope as steep as its arctangent lets any wheel slide that carries its share straight down"""
GENTLER = 0.85
"""of a slope or stride that was not finished, the next one tried"""
TRIES = 5


@dataclass(frozen=True, kw_only=True)
class Walk:
    """One cycle on one slope, planned and walked."""

    angle_deg: float
    stance: SlopeStance
    walked: WalkedCycle


def slope_rows(gaits: Gaits, seed: int) -> Iterator[Row]:
    """A cycle on the paper's slopes, on their soil, and on the steepest planned ones, on concrete, by attitude of the deck."""
    search = SlopeSearch(spare=SPARE, clearance=CLEARANCE)
    for deck in DECKS:
        for degrees in SLOPES_DEG:
            for share in SHARES:
                rows = _slope(gaits, seed, degrees, deck, SAND, share * gaits.stride)
                yield from rows
                if rows[0]["met"]:
                    break
        best = steepest_stance(gaits.spec, stride=gaits.stride, deck=deck, search=search, lift=LIFT[gaits.spec.name])
        if isinstance(best, NoSlopeStance):
            yield row(f"{gaits.spec.name}: twin, steepest slope, deck {deck}: no, {best.reason}", None, "deg")
            continue
        planned = float(np.floor(np.rad2deg(best.angle)))
        tried = min(planned, float(np.floor(GENTLER * np.rad2deg(np.arctan(FRICTION)))))
        for _ in range(TRIES):
            rows = _slope(gaits, seed, tried, deck, HARD, gaits.stride, best)
            yield from rows
            if rows[0]["met"]:
                break
            tried = float(np.floor(GENTLER * tried))
        name = f"{gaits.spec.name}: twin, steepest slope walked, deck {deck}, stride {gaits.stride:g} m, concrete"
        yield row(name, tried if rows[0]["met"] else None, "deg", peer_name="planned", peer=planned)


def walk_slope(
    gaits: Gaits, seed: int, degrees: float, deck: str, soil: str, stride: float, hint: SlopeStance | None = None
) -> Walk | NoSlopeStance:
    """Plan the stance of least torque on a slope and have the twin walk a cycle.

    Raises:
        StanceRefusedError: the robot does not even stand there.
    """
    stance = stance_on(
        gaits.spec, np.deg2rad(degrees), stride=stride, deck=deck, search=SlopeSearch(spare=SPARE, clearance=CLEARANCE),
        lift=LIFT[gaits.spec.name], hint=hint,
    )  # fmt: skip
    if isinstance(stance, NoSlopeStance):
        return stance
    yard = GaitYard.beginning(stance.cycle, seed, load_scenario(soil))
    try:
        return Walk(angle_deg=degrees, stance=stance, walked=yard.walk(stance.cycle))
    finally:
        yard.close()


def _slope(
    gaits: Gaits, seed: int, degrees: float, deck: str, soil: str, stride: float, hint: SlopeStance | None = None
) -> list[Row]:
    """The first row says by its verdict whether the cycle was finished without a strike and within every joint's torque."""
    what = f"{gaits.spec.name}: twin, {degrees:g} deg, deck {deck}, {'sand' if soil == SAND else 'concrete'}, stride {stride:g} m"
    try:
        found = walk_slope(gaits, seed, degrees, deck, soil, stride, hint)
    except StanceRefusedError as e:
        return [row(f"{what}, advance: no, it does not stand: {e}", 0.0, "m", target="> 0")]
    if isinstance(found, NoSlopeStance):
        return [row(f"{what}, advance: no, {found.reason}", None, "m", target="> 0")]
    walked, stance = found.walked, found.stance
    gaits.slopes_walked[f"{degrees:g} deg, deck {deck}"] = walked
    ended = f", ended in {walked.ended_by}" if walked.ended_by else ""
    struck = f", struck {', '.join(walked.struck)}" if walked.struck else ""
    done = row(f"{what}, advance, {told(stance)}{ended}{struck}", walked.advance, "m", peer_name="planned", peer=stride,
               target="> 0")  # fmt: skip
    done["met"] = not walked.ended_by and not walked.struck and walked.peak <= 1.0
    return [
        done,
        row(f"{what}, peak torque", 100.0 * walked.peak, "%", peer_name="planned", peer=100.0 * stance.verdict.peak),
        row(f"{what}, drift to the side", walked.side, "m"),
        row(f"{what}, longest slip of a standing wheel (the paper: under 0.05 m at 14 deg)", walked.slip, "m"),
    ]


def stride_rows(gaits: Gaits, seed: int) -> Iterator[Row]:
    """The longest planned stride, or the longest of a few shorter ones that the twin finishes, one leg at a time and in pairs."""
    for groups, how in ((None, "one leg at a time"), (PAIRS, "opposite legs together")):
        planned = longest_stride(gaits.spec, AHEAD, groups=groups).value
        for stride in _shorter(planned):
            cycle = gait_cycle(gaits.spec, AHEAD, stride=stride, groups=groups)
            yard = GaitYard(gaits.spec.name, seed)
            try:
                walked = yard.walk(cycle)
            finally:
                yard.close()
            what = f"{gaits.spec.name}: twin, stride {stride:.2f} m of {planned:.2f} m planned, {how}"
            ended = f", ended in {walked.ended_by}" if walked.ended_by else ""
            struck = f", struck {', '.join(walked.struck)}" if walked.struck else ""
            done = row(f"{what}, advance{ended}{struck}", walked.advance, "m", peer_name="planned", peer=stride, target="> 0")
            done["met"] = not walked.ended_by and not walked.struck and walked.peak <= 1.0
            peak = 100.0 * judge_cycle(cycle).peak
            yield done
            yield row(f"{what}, peak torque", 100.0 * walked.peak, "%", peer_name="planned", peer=peak)
            if done["met"]:
                break


def _shorter(longest: float) -> Iterator[float]:
    """The longest stride, rounded down to centimetres, then ever shorter ones [m]."""
    for k in range(TRIES):
        yield float(np.floor(100.0 * longest * GENTLER**k) / 100.0)
