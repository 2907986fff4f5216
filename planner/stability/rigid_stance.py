"""Many stances of a rigid robot at once: do all legs reach, what do the joints hold, how far is it from tipping.

Place in the flow: gait optimisation and slope studies, which ask about thousands of chassis places over given wheels. The
model is that of `model.statics`: zero-interaction forces ([SunSpiral2012] s5.1.1) on rigid contacts, last links plumb, and
gravity of every link; here vectorised over stances. Ground pushes only: a stance in which zero interaction would have it
pull is no stance.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from athlete_twin.errors import SupportError
from athlete_twin.geometry.arrays import PerLegFlag, Vec3
from athlete_twin.geometry.polygon import conservative_distances, signed_distances
from athlete_twin.model.kinematics import GRAVITY
from athlete_twin.model.leg_coms import leg_coms_in_hex
from athlete_twin.model.leg_torques import leg_torques
from athlete_twin.model.reach import leg_ik
from athlete_twin.model.spec import LEGS, RobotSpec
from planner.stability.stance_torque import zero_interaction

UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, eq=False, kw_only=True)
class Footing:
    """How the ground lies to the chassis, which keeps its attitude: both directions in hex."""

    normal: Vec3 = field(default_factory=lambda: UP.copy())
    """of the ground, out of it, of length 1"""
    up: Vec3 = field(default_factory=lambda: UP.copy())
    """against gravity, of length 1"""

    def __post_init__(self) -> None:
        for name in ("normal", "up"):
            size = float(np.linalg.norm(getattr(self, name)))
            if not abs(size - 1.0) < 1e-9:
                raise SupportError(f"{name} {getattr(self, name)} has length {size:g}, must be 1")
        if self.normal[2] <= 0.0:
            raise SupportError(f"normal {self.normal} points down, the ground lies below the chassis")


FLAT = Footing()


@dataclass(frozen=True, eq=False, kw_only=True)
class Stances:
    """What n stances are like. Where a leg does not reach, fractions are infinite and margins minus infinity."""

    reaches: np.ndarray
    """whether all legs do, shape (n, 6)"""
    fraction: np.ndarray
    """largest joint torque of each leg over its limit, shape (n, 6); all infinite where the ground would have to pull"""
    margin: np.ndarray
    """of the standing wheels' polygon, seen along gravity, shape (n,) [m]"""
    cps_margin: np.ndarray
    """to the conservative polygon, shape (n,) [m]"""

    @property
    def peak(self) -> np.ndarray:
        """Largest joint torque over its limit, shape (n,)."""
        return np.asarray(self.fraction.max(axis=1))


def rigid_stances(
    spec: RobotSpec, axles_in_hex: np.ndarray, *, standing: PerLegFlag, footing: Footing = FLAT, payload_kg: float = 0.0
) -> Stances:
    """Judge n stances that differ in where the axles are.

    Args:
        spec: the drawings.
        axles_in_hex: shape (n, 6, 3) [m].
        standing: which wheels carry, the same in all stances, shape (6,); at least three.
        footing: of the ground under the wheels; they touch a radius off their axles, against the normal.
        payload_kg: on the middle of the deck plane [kg]
    """
    if int(standing.sum()) < 3:
        raise SupportError(f"{int(standing.sum())} wheels stand, at least 3 carry a robot")
    n = len(axles_in_hex)
    down = -footing.up
    contacts = axles_in_hex - spec.wheel.radius * footing.normal
    angles, reaches = np.empty((n, LEGS, spec.dof)), np.empty((n, LEGS), dtype=bool)
    for leg in range(LEGS):
        angles[:, leg], reaches[:, leg] = leg_ik(spec, leg, axles_in_hex[:, leg], last_link_in_hex=down)
    fraction, margin, cps = np.full((n, LEGS), np.inf), np.full(n, -np.inf), np.full(n, -np.inf)
    rows = np.flatnonzero(reaches.all(axis=1))
    if len(rows):
        angles, contacts = angles[rows], contacts[rows]
        com = coms_in_hex(spec, angles, payload_kg)
        forces = np.zeros((len(rows), LEGS, 3))
        weight = (spec.mass + payload_kg) * GRAVITY
        forces[:, standing] = zero_interaction(contacts[:, standing], com, weight=weight, down=down)
        pushed = (forces[:, standing] @ footing.normal >= 0.0).all(axis=1)
        for leg in range(LEGS):
            torques = leg_torques(
                spec, leg, angles[:, leg], force_in_hex=forces[:, leg], contact_in_hex=contacts[:, leg], gravity_in_hex=GRAVITY * down
            )
            fraction[rows, leg] = np.where(pushed, np.abs(torques / spec.torque_limits).max(axis=1), np.inf)
        across = _plan_axes(footing.up)
        corners = contacts[:, standing] @ across
        margin[rows], cps[rows] = signed_distances(com @ across, corners), conservative_distances(com @ across, corners)
    return Stances(reaches=reaches, fraction=fraction, margin=margin, cps_margin=cps)


def coms_in_hex(spec: RobotSpec, angles: np.ndarray, payload_kg: float = 0.0) -> np.ndarray:
    """Centres of mass of n configurations (n, 6, dof) [rad], shape (n, 3) [m]."""
    moment = spec.body_mass * np.asarray(spec.body_com) + payload_kg * np.array([0.0, 0.0, spec.top_in_hex])
    for deck in spec.decks:
        moment = moment + deck.mass * np.asarray(deck.part.centre)
    legs = sum(leg_coms_in_hex(spec, leg, angles[:, leg]) for leg in range(LEGS))
    return np.asarray((moment + spec.leg_mass * legs) / (spec.mass + payload_kg))


def _plan_axes(up: Vec3) -> np.ndarray:
    """Two directions square to gravity, as columns, shape (3, 2)."""
    x = np.array([1.0, 0.0, 0.0]) - up[0] * up
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(up, x)])
