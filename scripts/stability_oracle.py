"""Inverse kinematics by brute force: what a leg can reach, found without the closed form that the planner uses.

All joints of the leg are free within their limits, rolls included, and Pinocchio's forward kinematics is driven to the place by
scipy's bounded least squares from many starts. Slow, and nothing in it knows how the legs are built. What it finds is a proof; that
it finds nothing is none: with the leg turned back under the chassis thirteen starts may all end in other hollows.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import least_squares

from athlete_twin.geometry.arrays import Vec3
from athlete_twin.model.kinematics import Kinematics

STARTS = 12
"""random ones; the middle of the limits comes first"""
PATIENT_STARTS = 150
"""of a second search, where the first one denies a place that somebody claims to reach"""
NEAR = 0.002
"""an axle so near its place is there [m]"""
PLUMB_DEG = 0.2
"""a last link so near its direction is plumb [deg]"""
TILT_WEIGHT = 1.0
"""metres that count as one radian"""


def reaches(
    kinematics: Kinematics, leg: int, wheel_in_hex: Vec3, plumb_in_hex: Vec3, *, rng: np.random.Generator, starts: int = STARTS
) -> bool:
    """Whether a search finds angles within limits that put the axle at a place with the last link along `plumb_in_hex`."""
    spec = kinematics.spec
    last = np.asarray(spec.wheel.offset) / np.linalg.norm(spec.wheel.offset)

    def residual(q: np.ndarray) -> np.ndarray:
        wheel = kinematics.leg_wheel(leg, q)
        direction = wheel.rotation @ last
        return np.concatenate([wheel.translation - wheel_in_hex, TILT_WEIGHT * (direction - plumb_in_hex)])

    span = spec.upper - spec.lower
    for start in range(1 + starts):
        middle = 0.5 * (spec.lower + spec.upper)
        begin = middle if start == 0 else spec.lower + span * rng.uniform(0.02, 0.98, len(span))
        found = least_squares(residual, begin, bounds=(spec.lower, spec.upper), max_nfev=60)
        apart, tilt = found.fun[:3], found.fun[3:] / TILT_WEIGHT
        if np.linalg.norm(apart) <= NEAR and np.linalg.norm(tilt) <= np.deg2rad(PLUMB_DEG):
            return True
    return False
