"""One leg lifted and lowered slowly: where its wheel truly leaves the ground and meets it again, and what was foreseen.

Compared are the three ways of compensation: `none` takes the robot for rigid, `raise_terrain` lifts the map by 15 cm as in
2008, `springs` solves the contact-spring model with the individual's calibrated constant. Of a robot with docks a fourth
stands beside them: springs under the feet and in the docks.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from sag_yard import Reading, SagYard, StanceRefusedError

from athlete_twin.athlete import TruthState
from athlete_twin.model.spec import LEGS
from planner.sag.compensate import METHODS, SagConfig, predict_sag
from planner.sag.docked import Docks, Piece
from planner.sag.identify_docks import DockFit
from planner.sag.sag_model import FootSprings

SLOW = 0.1
"""of the usual speed: about 1 cm/s, at which springs and dampers keep up"""
WANTED = 0.10
"""clearance between wheel and ground that is asked for [m]"""


@dataclass(frozen=True, eq=False, kw_only=True)
class LiftCurve:
    """One leg's way up and down, sampled."""

    leg: int
    commanded: np.ndarray
    """height over the planted place on the way up, shape (n,) [m]"""
    clearance: np.ndarray
    """of the wheel over the ground, truly, shape (n,); negative while the tyre is pressed in [m]"""
    leaves_at: float
    """commanded height at which the wheel last bears load on the way up [m]"""
    touches_at: float
    """and first on the way down [m]"""


@dataclass(frozen=True, kw_only=True)
class LiftScore:
    """What one method foresaw of one lift."""

    method: str
    clearance: float
    """true, where `WANTED` was asked for; negative if the wheel has not left the ground [m]"""
    lift_off_error: float
    """foreseen less true commanded height of breaking contact [m]"""
    touch_down_error: float
    """foreseen less true commanded height of touching again [m]"""


def lift_curve(yard: SagYard, leg: int, *, by: float) -> LiftCurve:
    """Lift a leg of a standing robot by `by` [m] and put it back, watching the truth."""
    radius, up = yard.spec.wheel.radius, yard.up_in_hex
    planted = float(up @ yard.kin.wheels_in_hex(yard.robot.truth().motors)[leg])
    samples: list[tuple[float, float, float]] = []

    def watch(truth: TruthState) -> None:
        height = float(up @ yard.kin.wheels_in_hex(truth.motors)[leg]) - planted
        axle = truth.wheels_in_world[leg]
        ground = float(yard.robot.terrain.grid.sample(axle[None, :2])[0])
        samples.append((height, float(axle[2]) - ground - radius, float(truth.wheel_loads[leg])))

    yard.raise_leg(leg, by, slow=SLOW, watch=watch)
    rising = np.array(samples)
    samples.clear()
    yard.put_down(leg, slow=SLOW, watch=watch)
    falling = np.array(samples)
    bears, meets = np.flatnonzero(rising[:, 2] > 0.0), np.flatnonzero(falling[:, 2] > 0.0)
    if not (len(bears) and len(meets)):
        way = "up" if not len(bears) else "down"
        raise StanceRefusedError(f"the wheel bore no load on its way {way}, commanded over {by} m: it must stand before and after")
    return LiftCurve(
        leg=leg, commanded=rising[:, 0], clearance=rising[:, 1],
        leaves_at=float(rising[bears[-1], 0]), touches_at=float(falling[meets[0], 0]),
    )  # fmt: skip


def score_lift(
    curve: LiftCurve, standing: Reading, lifted: Reading, *, stiffness: float, lateral_ratio: float
) -> tuple[LiftScore, ...]:
    """What each method foresaw of a lift, from the stances that were read with the wheel down and up.

    Args:
        curve: what truly happened.
        standing: all wheels down.
        lifted: the leg in the air.
        stiffness: calibrated constant of all feet [N/m].
        lateral_ratio: horizontal over vertical stiffness.
    """
    stance, scores = standing.stance, []
    springs = FootSprings(stiffness_z=np.full(LEGS, stiffness), lateral_ratio=lateral_ratio)
    for method in METHODS:
        foreseen = predict_sag(
            stance.feet_in_hex, curve.leg, com_planted=stance.com_in_hex, com_airborne=lifted.stance.com_in_hex,
            weight=stance.weight, clearance=WANTED, springs=springs, config=SagConfig(method=method), lifts=stance.lifts,
            gravity_in_hex=stance.gravity_in_hex,
        )  # fmt: skip
        # A raised map puts the ground where it is not: contact is foreseen at its height.
        contact = foreseen.lift_to_break + foreseen.terrain_raise
        scores.append(_score(method, curve, contact=contact, commanded=foreseen.commanded_lift))
    return tuple(scores)


def score_docked_lift(
    curve: LiftCurve, standing: Reading, lifted: Reading, pieces: tuple[Piece, ...], *, fit: DockFit, lateral_ratio: float
) -> LiftScore:
    """The same of springs under the feet and in the docks; `pieces` hang on the docks with the leg in the air."""
    stance = standing.stance
    foreseen = predict_sag(
        stance.feet_in_hex, curve.leg, com_planted=stance.com_in_hex, com_airborne=lifted.stance.com_in_hex,
        weight=stance.weight, clearance=WANTED, config=SagConfig(), lifts=stance.lifts, gravity_in_hex=stance.gravity_in_hex,
        springs=FootSprings(stiffness_z=np.full(LEGS, fit.stiffness), lateral_ratio=lateral_ratio),
        docks=Docks(pieces=pieces, twist_stiffness=fit.twist_stiffness),
    )  # fmt: skip
    return _score("springs and docks", curve, contact=foreseen.lift_to_break, commanded=foreseen.commanded_lift)


def _score(method: str, curve: LiftCurve, *, contact: float, commanded: float) -> LiftScore:
    return LiftScore(
        method=method,
        clearance=float(np.interp(commanded, curve.commanded, curve.clearance)),
        lift_off_error=contact - curve.leaves_at,
        touch_down_error=contact - curve.touches_at,
    )
