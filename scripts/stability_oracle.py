"""Inverse kinematics by brute force: what a leg can reach, found without the closed form that the planner uses.

All joints of the leg are free within their limits, rolls included, and Pinocchio's forward kinematics is driven to the place by
scipy's bounded least squares from many starts. Slow, and nothing in it knows how the legs are built. What it finds is a proof; that
it finds nothing is none: with the leg turned back under the chassis thirteen starts may all end in other hollows. So whatever the
first search denies is searched again, from many more, whoever claims what of the place.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import pinocchio as pin
from scipy.optimize import least_squares

from athlete_twin.geometry.arrays import Vec3
from athlete_twin.model.kinematics import Kinematics
from athlete_twin.model.spec import LEGS

STARTS = 12
"""random ones; the middle of the limits comes first"""
PATIENT_STARTS = 150
"""of a second search, of every place that the first one denies"""
NEAR = 0.002
"""an axle so near its place is there [m]"""
PLUMB_DEG = 0.2
"""a last link so near its direction is plumb [deg]"""
TILT_WEIGHT = 1.0
"""metres that count as one radian"""


def reaches(
    kinematics: Kinematics,
    leg: int,
    wheel_in_hex: Vec3,
    plumb_in_hex: Vec3,
    *,
    rng: np.random.Generator,
    starts: int = STARTS,
    lean_deg: float = 0.0,
) -> bool:
    """Whether a search finds angles within limits that put the axle at a place with the last link along `plumb_in_hex`.

    Args:
        kinematics: of the drawings.
        leg: index 0 to 5.
        wheel_in_hex: the axle's place [m].
        plumb_in_hex: direction, of length 1.
        rng: of the starts.
        starts: random ones.
        lean_deg: by which the last link may be off that direction, any way [deg].
    """
    spec = kinematics.spec
    last = np.asarray(spec.wheel.offset) / np.linalg.norm(spec.wheel.offset)
    model, data, frame = _one_leg(kinematics, leg)
    free = 2.0 * np.sin(0.5 * np.deg2rad(lean_deg))

    def residual(q: np.ndarray) -> np.ndarray:
        pin.framesForwardKinematics(model, data, q)
        placed = data.oMf[frame]
        off = placed.rotation @ last - plumb_in_hex
        apart = float(np.linalg.norm(off))
        return np.concatenate([placed.translation - wheel_in_hex, TILT_WEIGHT * max(0.0, 1.0 - free / max(apart, 1e-12)) * off])

    def slopes(q: np.ndarray) -> np.ndarray:
        moves = pin.computeFrameJacobian(model, data, q, frame, pin.LOCAL_WORLD_ALIGNED)
        pin.updateFramePlacement(model, data, frame)
        direction = data.oMf[frame].rotation @ last
        turned = np.cross(moves[3:].T, direction).T
        off = direction - plumb_in_hex
        apart = max(float(np.linalg.norm(off)), 1e-12)
        kept = (1.0 - free / apart) * np.eye(3) + free * np.outer(off, off) / apart**3 if apart > free else np.zeros((3, 3))
        return np.concatenate([moves[:3], TILT_WEIGHT * kept @ turned])

    span = spec.upper - spec.lower
    for start in range(1 + starts):
        middle = 0.5 * (spec.lower + spec.upper)
        begin = middle if start == 0 else spec.lower + span * rng.uniform(0.02, 0.98, len(span))
        found = least_squares(residual, begin, jac=slopes, bounds=(spec.lower, spec.upper), max_nfev=60)
        apart, tilt = found.fun[:3], found.fun[3:] / TILT_WEIGHT
        if np.linalg.norm(apart) <= NEAR and np.linalg.norm(tilt) <= np.deg2rad(PLUMB_DEG):
            return True
    return False


@lru_cache(maxsize=32)
def _one_leg(kinematics: Kinematics, leg: int) -> tuple[Any, Any, int]:
    """Pinocchio's model of one leg alone, the others held: its configuration is the leg's angles, in their order."""
    whole, spec = kinematics.pin_model, kinematics.spec
    others = [whole.getJointId(f"joint_leg{other + 1}_{n}") for other in range(LEGS) if other != leg for n in spec.joint_names]
    model = pin.buildReducedModel(whole, others, pin.neutral(whole))
    order = [model.joints[model.getJointId(f"joint_leg{leg + 1}_{n}")].idx_q for n in spec.joint_names]
    if order != list(range(len(order))):
        raise RuntimeError(f"Pinocchio keeps the joints of leg {leg + 1} in the order {order}")
    return model, model.createData(), model.getFrameId(f"wheel{leg + 1}", pin.FrameType.BODY)
