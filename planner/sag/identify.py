"""Spring constants from measured chassis corner and axle heights ([SunSpiral2012] s5.1.2-5.1.3).

A robot is calibrated again after a change by a few stances (all wheels down, one leg lifted, ...) in which the heights
of the chassis corners were measured. Three answers: one constant for all feet by exhaustive search, every candidate below
an upper bound, the tyre's own, being tried and the one with the least mean error over all points taken; a constant for
each wheel by least squares; and, where axle heights were measured too, the tyre's own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.optimize import least_squares

from athlete_twin.errors import SagError
from athlete_twin.geometry.arrays import PerLeg, Points3, Vec3, Wheels
from athlete_twin.model.spec import LEGS
from planner.sag.sag_model import DOWN, SagSolution, solve_sag

MOST_APART = 4.0
"""factor by which a wheel's constant may differ from the search's start: beyond it no tyre of a set is"""
FALLEN = 1.0
"""error that a stance counts with where the springs do not hold it [m]"""


@dataclass(frozen=True, eq=False, kw_only=True)
class MeasuredStance:
    """One stance and the heights that were measured in it."""

    feet_in_hex: Wheels
    """where the springs hold the feet, without sag, shape (6, 3) [m]"""
    com_in_hex: Vec3
    """[m]"""
    weight: float
    """with payload [N]"""
    lifts: PerLeg
    """height of each foot over its contact point without sag, shape (6,) [m]"""
    corners_in_hex: Points3
    """points on the chassis, shape (c, 3) [m]"""
    heights: np.ndarray
    """measured heights of these points, shape (c,) [m]"""
    origin_height: float
    """height of the hex origin if nothing sagged, above what `heights` are measured from [m]"""
    gravity_in_hex: Vec3 = field(default_factory=lambda: DOWN.copy())
    """where gravity points"""

    def __post_init__(self) -> None:
        if len(self.corners_in_hex) == 0 or np.shape(self.heights) != (len(self.corners_in_hex),):
            raise SagError(f"{len(self.corners_in_hex)} corners need as many heights, got {np.shape(self.heights)}")
        if not np.isfinite(self.heights).all():
            raise SagError("measured heights must be finite; leave out the corners that were not measured")


@dataclass(frozen=True, eq=False, kw_only=True)
class StiffnessFit:
    """The best constant and how well it explains the measurements."""

    stiffness: float
    """along gravity, the same under every foot [N/m]"""
    mean_error: float
    """mean absolute error over all corners of all stances [m]"""
    max_error: float
    """largest absolute error [m]"""
    candidates: np.ndarray
    """constants tried, shape (n,) [N/m]"""
    mean_errors: np.ndarray
    """mean absolute error of each, shape (n,); infinite where a stance has no solution [m]"""


@dataclass(frozen=True, eq=False, kw_only=True)
class WheelFit:
    """A constant for each wheel and how well they explain the measurements."""

    stiffness_z: PerLeg
    """along gravity, shape (6,) [N/m]"""
    relative_sigma: PerLeg
    """one sigma over the constant, shape (6,), from the instrument's error alone"""
    mean_error: float
    """mean absolute error over all corners of all stances [m]"""
    max_error: float
    """largest absolute error [m]"""


def corner_heights(stance: MeasuredStance, solution: SagSolution) -> np.ndarray:
    """Predicted heights of a stance's corners, shape (c,) [m]."""
    up = -np.asarray(stance.gravity_in_hex, dtype=float) / np.linalg.norm(stance.gravity_in_hex)
    return np.asarray(stance.origin_height + solution.unsagged_from_sagged.apply(stance.corners_in_hex) @ up)


def predict_heights(stance: MeasuredStance, *, stiffness_z: PerLeg, lateral_ratio: float) -> np.ndarray:
    """Corner heights (c,) with given springs [m]; minus infinity when the springs do not hold the stance."""
    solution = solve_sag(
        stance.feet_in_hex,
        stance.com_in_hex,
        stance.weight,
        stiffness_z=stiffness_z,
        lateral_ratio=lateral_ratio,
        lifts=stance.lifts,
        gravity_in_hex=stance.gravity_in_hex,
    )
    if not solution.converged:
        return np.full(len(stance.corners_in_hex), -np.inf)
    return corner_heights(stance, solution)


def identify_stiffness(
    stances: Sequence[MeasuredStance],
    *,
    upper: float,
    lower: float = 2000.0,
    step: float = 250.0,
    lateral_ratio: float = 0.5,
) -> StiffnessFit:
    """The constant with the least mean error over all measured corners.

    Args:
        stances: what was measured.
        upper: bound that the constant stays at or below: the tyre's own constant, since legs only add compliance [N/m].
        lower: where the search begins [N/m]; there a robot of 850 kg sinks 0.7 m.
        step: distance of candidates [N/m].
        lateral_ratio: horizontal over vertical stiffness, not searched: heights hardly tell it.
    """
    if not stances:
        raise SagError("no stance was measured; a few are needed, such as all wheels down and one leg lifted")
    if not (0.0 < lower < upper and step > 0.0):
        raise SagError(f"search from {lower} to {upper} N/m in steps of {step} N/m has no candidate")
    candidates = np.arange(lower, upper + 1e-9 * upper, step)
    mean_errors, max_errors = np.empty(len(candidates)), np.empty(len(candidates))
    for place, stiffness in enumerate(candidates):
        springs = np.full(6, stiffness)
        errors = np.concatenate(
            [np.abs(predict_heights(s, stiffness_z=springs, lateral_ratio=lateral_ratio) - s.heights) for s in stances]
        )
        mean_errors[place], max_errors[place] = float(errors.mean()), float(errors.max())
    best = int(np.argmin(mean_errors))
    if not np.isfinite(mean_errors[best]):
        raise SagError(f"no constant from {lower} to {upper} N/m holds all {len(stances)} stances")
    return StiffnessFit(
        stiffness=float(candidates[best]),
        mean_error=float(mean_errors[best]),
        max_error=float(max_errors[best]),
        candidates=candidates,
        mean_errors=mean_errors,
    )


def identify_per_wheel(
    stances: Sequence[MeasuredStance], *, start: float, instrument_sigma: float, lateral_ratio: float = 0.5
) -> WheelFit:
    """A constant for each wheel by least squares: unequal tyres are what one constant leaves over ([SunSpiral2012] s5.1.2).

    Args:
        stances: what was measured; each wheel must carry in some stance more than in another. Six poses do.
        start: constant to begin from, such as `identify_stiffness` gives [N/m].
        instrument_sigma: of one measured height [m].
        lateral_ratio: horizontal over vertical stiffness.
    """
    if not (np.isfinite(start) and start > 0.0):
        raise SagError(f"search begins at {start} N/m, must be positive; identify_stiffness gives a start")
    if not (np.isfinite(instrument_sigma) and instrument_sigma > 0.0):
        raise SagError(f"the instrument's sigma is {instrument_sigma} m, must be positive")
    if 3 * len(stances) < LEGS:
        raise SagError(f"{len(stances)} stances tell three heights each, six constants need at least {LEGS // 3} stances")

    def errors(logarithms: np.ndarray) -> np.ndarray:
        springs = start * np.exp(logarithms)
        each = [predict_heights(s, stiffness_z=springs, lateral_ratio=lateral_ratio) - s.heights for s in stances]
        return np.asarray(np.maximum(np.concatenate(each), -FALLEN))

    bound = float(np.log(MOST_APART))
    found = least_squares(errors, np.zeros(LEGS), bounds=(-bound, bound))
    if float(np.abs(found.fun).max()) >= FALLEN:
        raise SagError(f"springs near {start:.0f} N/m do not hold all {len(stances)} stances; begin from stiffer ones")
    values, axes = np.linalg.eigh(found.jac.T @ found.jac)
    if values[0] < 1e-9 * values[-1]:
        weak = int(np.argmax(np.abs(axes[:, 0]))) + 1
        raise SagError(f"the stances do not tell the constant of wheel {weak}: lift its leg, or its opposite, in one of them")
    covariance = (axes / values) @ axes.T * instrument_sigma**2
    return WheelFit(
        stiffness_z=start * np.exp(found.x),
        relative_sigma=np.sqrt(np.diag(covariance)),
        mean_error=float(np.abs(found.fun).mean()),
        max_error=float(np.abs(found.fun).max()),
    )


def identify_tyre(loads: np.ndarray, axle_heights: np.ndarray, *, wheel_radius: float) -> float:
    """The tyre's own constant [N/m]: what loaded axles stand lower than a wheel's radius, by least squares.

    The paper read SDM-B's axles for this (s5.1.2). Legs and joints play no part in it. Of a tyre that stiffens under load the
    constant is a secant, load over depth at the loads given: from six wheels down it may be less than a foot's constant, tyre
    and leg in series, that was found over stances with legs lifted, where each wheel carries more.

    Args:
        loads: believed, of n loaded wheels [N].
        axle_heights: measured above the ground under each, shape (n,) [m].
        wheel_radius: unloaded [m].
    """
    drops = wheel_radius - np.asarray(axle_heights, dtype=float)
    loads = np.asarray(loads, dtype=float)
    if loads.shape != drops.shape or len(loads) == 0 or not (np.isfinite(loads).all() and np.isfinite(drops).all()):
        raise SagError(f"{loads.shape} loads and {drops.shape} axle heights must be as many, at least one, and finite")
    # Heights carry the error, so drops are fitted to loads: drop = load / k.
    compliance = float(drops @ loads / (loads @ loads)) if (loads > 0.0).any() else 0.0
    if compliance <= 0.0:
        raise SagError("the measured axles do not stand lower under load: no tyre is so stiff; check the ground they are measured from")
    return 1.0 / compliance
