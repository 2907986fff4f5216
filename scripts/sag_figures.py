"""Calibration of the contact springs from what was read of some robots, and how well it foretells stances they had not taken.

Per individual: the tyre's own constant from the axles; one for all feet by exhaustive search below it; a constant for each
wheel from six poses; and for a robot with docks one constant for the feet and one for the docks. Each is judged on the individual's
random stances by the heights of the chassis' corners. `rows` gives the benchmark's rows.

The true tyre stiffens under load, so its constant is given twice: where the robot stands on six wheels, as the ground
believes its axles, and over all calibration stances, which is the bound of the search.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from bench_table import Row, row
from sag_lifts import WANTED, LiftScore, score_docked_lift, score_lift
from sag_stances import SIX_POSES, Individual
from sag_yard import INSTRUMENT_SIGMA, Reading

from athlete_twin.model.kinematics import kinematics
from athlete_twin.model.spec import LEGS, RobotSpec, load_spec
from planner.sag.docked import docked_pieces
from planner.sag.identify import (
    StiffnessFit,
    WheelFit,
    identify_per_wheel,
    identify_stiffness,
    identify_tyre,
    predict_heights,
)
from planner.sag.identify_docks import DockFit, identify_docks, predict_docked_heights
from planner.sag.sag_model import FootSprings, solve_sag

MEAN, LARGEST, MEAN_PER_WHEEL = "<= 0.012", "<= 0.05", "<= 0.006"
"""targets [m]: of one constant, of SDM-B's largest error, of SDM-B with a constant for each wheel"""
PAPER = {"sdm_b": "0.012", "t12": "0.009"}
"""mean error that [SunSpiral2012] s5.1.2-5.1.3 found on the real robots, in the stances that they calibrated with [m]"""


@dataclass(frozen=True, eq=False, kw_only=True)
class Calibration:
    """What one individual's calibration stances say, and the errors on its random ones."""

    individual: Individual
    one: StiffnessFit
    wheels: WheelFit
    tyre: float
    """over all calibration stances [N/m]"""
    standing_tyre: float
    """on six wheels [N/m]"""
    docks: DockFit | None
    """None for a robot without docks"""
    errors: dict[str, np.ndarray]
    """predicted less read heights of the random stances by model ("one", "wheels", "docks"), each shape (n, 6) [m]"""
    lifts: tuple[LiftScore, ...]
    """of every leg by every method"""


def calibrated(individual: Individual) -> Calibration:
    """Find the constants of one robot and hold them against its random stances."""
    spec, kin = load_spec(individual.robot), kinematics(individual.robot)
    ratio, known = spec.believed_lateral_ratio, individual.calibration
    stances = [reading.stance for reading in known]
    tyre = _tyre(known, spec)
    one = identify_stiffness(stances, upper=tyre, lateral_ratio=ratio)
    wheels = identify_per_wheel(
        stances[SIX_POSES], start=one.stiffness, instrument_sigma=INSTRUMENT_SIGMA, lateral_ratio=ratio
    )
    models: dict[str, Callable[[Reading], np.ndarray]] = {
        "one": lambda r: predict_heights(r.stance, stiffness_z=np.full(LEGS, one.stiffness), lateral_ratio=ratio),
        "wheels": lambda r: predict_heights(r.stance, stiffness_z=wheels.stiffness_z, lateral_ratio=ratio),
    }
    docks = None
    if spec.decks:
        pieces = [docked_pieces(kin, reading.motors) for reading in known]
        docks = fit = identify_docks(stances, pieces, start=one.stiffness, lateral_ratio=ratio)
        models["docks"] = lambda r: predict_docked_heights(
            r.stance, docked_pieces(kin, r.motors), stiffness=fit.stiffness, twist_stiffness=fit.twist_stiffness, lateral_ratio=ratio
        )
    lifts = [
        score_lift(curve, known[0], known[1 + curve.leg], stiffness=one.stiffness, lateral_ratio=ratio)
        for curve in individual.curves
    ]
    if docks is not None:
        lifts += [
            (
                score_docked_lift(
                    curve, known[0], known[1 + curve.leg], docked_pieces(kin, known[1 + curve.leg].motors), fit=docks, lateral_ratio=ratio
                ),
            )
            for curve in individual.curves
        ]
    return Calibration(
        individual=individual, one=one, wheels=wheels, docks=docks, tyre=tyre, standing_tyre=_tyre(known[:1], spec),
        errors={name: np.array([model(r) - r.stance.heights for r in individual.random]) for name, model in models.items()},
        lifts=tuple(score for scores in lifts for score in scores),
    )  # fmt: skip


def rows(calibrations: Sequence[Calibration]) -> list[Row]:
    """The sag rows of the benchmark, robot by robot."""
    out: list[Row] = []
    for robot in dict.fromkeys(c.individual.robot for c in calibrations):
        out += _rows(robot, [c for c in calibrations if c.individual.robot == robot])
    return out


def _rows(robot: str, found: Sequence[Calibration]) -> list[Row]:
    count = sum(len(c.individual.random) for c in found)
    refused = sum(len(c.individual.refused) for c in found)
    name = f"{robot}, {count} random stances of {len(found)} individuals"
    out = [
        row(f"{robot}: constant of a foot, one for all, mean of the individuals", _mean(c.one.stiffness for c in found), "N/m"),
        row(f"{robot}: constant of the tyre alone, all stances", _mean(c.tyre for c in found), "N/m"),
        row(f"{robot}: constant of the tyre alone, on six wheels", _mean(c.standing_tyre for c in found), "N/m"),
        row(f"{robot}: stances that the drawings allow and the robot refused", float(refused), "1"),
        row(
            f"{robot}: mean error in the calibration's own stances (published: {PAPER[robot]})",
            _mean(c.one.mean_error for c in found), "m",
        ),
        row(f"{name}: mean error, one constant", _error(found, "one"), "m", target=MEAN),
        row(
            f"{name}: largest error, one constant", _error(found, "one", largest=True), "m",
            target=LARGEST if robot == "sdm_b" else "",
        ),
        row(
            f"{name}: mean error, a constant a wheel", _error(found, "wheels"), "m",
            target=MEAN_PER_WHEEL if robot == "sdm_b" else "",
        ),
        row(f"{name}: largest error, a constant a wheel", _error(found, "wheels", largest=True), "m"),
    ]  # fmt: skip
    for wheels in (6, 5, 4):
        out.append(row(f"{name}: mean error on {wheels} wheels, one constant", _error(found, "one", wheels=wheels), "m"))
    if any(c.docks for c in found):
        twist = _mean(c.docks.twist_stiffness for c in found if c.docks)
        out += [
            row(f"{robot}: constant of a dock", twist, "N m/rad"),
            row(
                f"{name}: mean error, one constant and two dock angles", _error(found, "docks"), "m",
                peer_name="without docks", peer=_error(found, "one"),
            ),
            row(
                f"{name}: largest error, one constant and two dock angles", _error(found, "docks", largest=True), "m",
                peer_name="without docks", peer=_error(found, "one", largest=True),
            ),
        ]  # fmt: skip
    methods = dict.fromkeys(score.method for c in found for score in c.lifts)
    return out + [r for method in methods for r in _lift_rows(robot, method, found)]


def _lift_rows(robot: str, method: str, found: Sequence[Calibration]) -> list[Row]:
    scores = [score for c in found for score in c.lifts if score.method == method]
    clearance = np.array([s.clearance for s in scores])
    name = f"{robot}, {len(scores)} lifts, {method}"
    return [
        row(f"{name}: true clearance where {WANTED} m was wanted, mean", float(clearance.mean()), "m"),
        row(f"{name}: least true clearance", float(clearance.min()), "m"),
        row(f"{name}: lift-off height, mean error", _mean(abs(s.lift_off_error) for s in scores), "m"),
        row(f"{name}: touch-down height, mean error", _mean(abs(s.touch_down_error) for s in scores), "m"),
    ]


def _tyre(known: Sequence[Reading], spec: RobotSpec) -> float:
    """From the axles; what each carries hardly depends on the springs, so the drawings' do."""
    springs = FootSprings.from_spec(spec)
    loads, heights = [], []
    for reading in known:
        s = reading.stance
        solution = solve_sag(
            s.feet_in_hex, s.com_in_hex, s.weight, stiffness_z=springs.stiffness_z, lateral_ratio=springs.lateral_ratio,
            lifts=s.lifts, gravity_in_hex=s.gravity_in_hex,
        )  # fmt: skip
        loads.append(np.linalg.norm(solution.forces, axis=1)[reading.standing])
        heights.append(reading.axle_heights[reading.standing])
    return identify_tyre(np.concatenate(loads), np.concatenate(heights), wheel_radius=spec.wheel.radius)


def _error(found: Sequence[Calibration], model: str, *, largest: bool = False, wheels: int | None = None) -> float:
    """Of all corners of all random stances, or of those on so many wheels; NaN where there are none [m]."""
    each = [
        error
        for c in found
        for error, reading in zip(c.errors[model], c.individual.random, strict=True)
        if wheels is None or int(reading.standing.sum()) == wheels
    ]
    if not each:
        return float("nan")
    return float(np.abs(each).max() if largest else np.abs(each).mean())


def _mean(values: Iterable[float]) -> float:
    collected = list(values)
    return float(np.mean(collected)) if collected else float("nan")
