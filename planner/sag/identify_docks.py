"""One constant for all feet and one for the docks, from measured corner heights of a robot whose deck twists."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from athlete_twin.errors import SagError
from athlete_twin.model.spec import LEGS
from planner.sag.docked import Piece, solve_docked
from planner.sag.identify import FALLEN, MeasuredStance

SOFTEST, STIFFEST = 2e4, 2e7
"""twist stiffness of a dock that is searched [N m/rad]: below it the deck would hang, above it nothing is seen"""


@dataclass(frozen=True, eq=False, kw_only=True)
class DockFit:
    """The best two constants and how well they explain the measurements."""

    stiffness: float
    """along gravity, the same under every foot [N/m]"""
    twist_stiffness: float
    """of each dock [N m/rad]"""
    mean_error: float
    """mean absolute error over all corners of all stances [m]"""
    max_error: float
    """largest absolute error [m]"""


def predict_docked_heights(
    stance: MeasuredStance, pieces: tuple[Piece, ...], *, stiffness: float, twist_stiffness: float, lateral_ratio: float
) -> np.ndarray:
    """Corner heights with docks that twist, corner i being on leg i's deck, shape (6,) [m]; minus infinity if nothing holds."""
    sag = solve_docked(
        stance.feet_in_hex, stance.com_in_hex, stance.weight, pieces=pieces, twist_stiffness=twist_stiffness,
        stiffness_z=np.full(LEGS, stiffness), lateral_ratio=lateral_ratio, lifts=stance.lifts,
        gravity_in_hex=stance.gravity_in_hex,
    )  # fmt: skip
    if not sag.converged:
        return np.full(len(stance.corners_in_hex), -np.inf)
    up = -stance.gravity_in_hex / np.linalg.norm(stance.gravity_in_hex)
    return np.asarray(stance.origin_height + sag.place(stance.corners_in_hex, np.arange(LEGS)) @ up)


def identify_docks(
    stances: Sequence[MeasuredStance],
    pieces: Sequence[tuple[Piece, ...]],
    *,
    start: float,
    start_twist: float = 3e5,
    lateral_ratio: float = 0.5,
) -> DockFit:
    """The feet's and the docks' constant together, by least squares.

    Args:
        stances: what was measured; docks show where a leg beside one is lifted.
        pieces: what hangs on the docks in each stance, by `docked_pieces`.
        start: constant of a foot to begin from [N/m].
        start_twist: of a dock [N m/rad].
        lateral_ratio: horizontal over vertical stiffness.
    """
    if len(stances) != len(pieces) or not stances or not all(pieces):
        raise SagError(f"{len(stances)} stances and {len(pieces)} sets of pieces: each stance needs its own, with at least one dock")
    if not 0.0 < start < np.inf:
        raise SagError(f"search begins at {start} N/m, must be positive and finite; identify_stiffness gives a start")
    if not SOFTEST <= start_twist <= STIFFEST:
        raise SagError(f"search of the docks from {start_twist} N m/rad, must be within {SOFTEST:.0f} to {STIFFEST:.0f}")

    def errors(x: np.ndarray) -> np.ndarray:
        each = [
            predict_docked_heights(
                s, p, stiffness=float(np.exp(x[0])), twist_stiffness=float(np.exp(x[1])), lateral_ratio=lateral_ratio
            )
            - s.heights
            for s, p in zip(stances, pieces, strict=True)
        ]
        return np.asarray(np.maximum(np.concatenate(each), -FALLEN))

    bounds = (np.log([0.25 * start, SOFTEST]), np.log([4.0 * start, STIFFEST]))
    found = least_squares(errors, np.log([start, start_twist]), bounds=bounds)
    error = np.abs(found.fun)
    if float(error.max()) >= FALLEN:
        raise SagError(f"feet near {start:.0f} N/m with docks near {start_twist:.0f} N m/rad do not hold all {len(stances)} stances")
    return DockFit(
        stiffness=float(np.exp(found.x[0])), twist_stiffness=float(np.exp(found.x[1])),
        mean_error=float(error.mean()), max_error=float(error.max()),
    )  # fmt: skip
