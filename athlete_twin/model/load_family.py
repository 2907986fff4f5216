"""All wheel forces that balance a stance: the zero-interaction ones and the null space around them, and the best of them.

Six equations of balance leave 3 m - 6 of the 3 m forces on m wheels open. `force_family` gives the least-norm member
([SunSpiral2012] s5.1.1: zero interaction) and a basis of the rest: legs that work against each other. Ground only pushes and
holds sideways by friction; `least_torque_loads` finds among the members that it can give the one whose largest joint torque
over its limit is least (s5.3.2: the null space of contact forces), a linear programme. The friction cone is replaced by a
pyramid inside it, so that what is found is never beyond the true cone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import null_space
from scipy.optimize import linprog

from athlete_twin.errors import SupportError
from athlete_twin.geometry.arrays import Joints, PerLegFlag, Points3, Vec3, Wheels
from athlete_twin.model.kinematics import GRAVITY, Kinematics
from athlete_twin.model.spec import LEGS
from athlete_twin.model.statics import DOWN, balance_matrix, patches_in_hex, torque_fractions, wheel_loads

SIDES = 12
"""of the pyramid inside the friction cone: it leaves out 3.4 % of the cone's width"""
INFEASIBLE = 2
"""status by which `linprog` says that it proved there is no solution; others than 0 are its own troubles"""


@dataclass(frozen=True, eq=False, kw_only=True)
class ForceFamily:
    """Forces in balance: `least_norm + (basis @ c).reshape(m, 3)` for any c."""

    least_norm: Points3
    """the zero-interaction member, shape (m, 3) [N]"""
    basis: np.ndarray
    """orthonormal, shape (3 m, 3 m - 6)"""


@dataclass(frozen=True, eq=False, kw_only=True)
class LoadSolution:
    """The best wheel forces of a stance, if there are any."""

    forces: Wheels
    """of the ground on all wheels, in hex, shape (6, 3), zero in the air [N]; NaN when infeasible"""
    peak_torque_fraction: float
    """largest joint torque of all legs over its limit; NaN when infeasible"""
    reason: str
    """empty when found; otherwise why no forces of the ground hold the stance, or that the solver gave up"""

    @property
    def feasible(self) -> bool:
        """Whether the ground can hold the stance."""
        return not self.reason


def force_family(contacts: Points3, com: Vec3, *, weight: float, gravity_direction: Vec3 = DOWN) -> ForceFamily:
    """The forces on m wheels that balance a weight; arguments as of `statics.wheel_loads`."""
    least = wheel_loads(contacts, com, weight=weight, gravity_direction=gravity_direction)
    return ForceFamily(least_norm=least, basis=null_space(balance_matrix(contacts, com), rcond=1e-9))


def least_torque_loads(
    kinematics: Kinematics,
    joints: Joints,
    *,
    supporting: PerLegFlag,
    friction: float,
    gravity_in_hex: Vec3 | None = None,
    payload_kg: float = 0.0,
    sides: int = SIDES,
) -> LoadSolution:
    """The forces of the ground that make the largest joint torque of a stance least.

    Args:
        kinematics: of the drawings.
        joints: shape (6, dof) [rad].
        supporting: which wheels stand, shape (6,).
        friction: coefficient between wheel and ground; the ground is square to gravity.
        gravity_in_hex: [m/s2]; down by default.
        payload_kg: [kg]
        sides: of the friction pyramid.
    """
    if not (np.isfinite(friction) and friction >= 0.0):
        raise SupportError(f"friction is {friction}, must be 0 or more")
    if sides < 3:
        raise SupportError(f"a friction pyramid has {sides} sides, needs at least 3")
    gravity = GRAVITY * DOWN if gravity_in_hex is None else np.asarray(gravity_in_hex, dtype=float)
    size = float(np.linalg.norm(gravity))
    standing = np.flatnonzero(supporting)
    spec = kinematics.spec
    contacts = patches_in_hex(kinematics, joints, gravity)
    weight = (spec.mass + payload_kg) * size
    com = kinematics.com_in_hex(joints, payload_kg)
    wheel_loads(contacts[standing], com, weight=weight, gravity_direction=gravity)  # refuses what no forces balance

    edges = _pyramid(-gravity / size, friction, sides)
    held, push = _torque_map(kinematics, joints, contacts, gravity)
    # Unknowns: how much of each edge each wheel takes, in units of the weight, then the largest fraction.
    count = len(standing) * sides
    balance = balance_matrix(contacts[standing], com) @ np.kron(np.eye(len(standing)), edges.T)
    wanted = np.concatenate([-gravity / size, np.zeros(3)])
    by_edge = weight * push[:, :, standing].reshape(held.size, -1) @ np.kron(np.eye(len(standing)), edges.T)
    rows = np.block([[by_edge, -np.ones((held.size, 1))], [-by_edge, -np.ones((held.size, 1))]])
    found = linprog(
        np.append(np.zeros(count), 1.0),
        A_ub=rows, b_ub=np.concatenate([-held.ravel(), held.ravel()]),
        A_eq=np.column_stack([balance, np.zeros(6)]), b_eq=wanted, bounds=(0.0, None), method="highs",
    )  # fmt: skip
    if not found.success:
        none = f"no pushing forces within friction {friction:g} on {len(standing)} wheels hold the stance"
        text = f"{none if found.status == INFEASIBLE else 'the solver gave up, so forces may exist'}: {found.message}"
        return LoadSolution(forces=np.full((LEGS, 3), np.nan), peak_torque_fraction=float("nan"), reason=text)
    forces = np.zeros((LEGS, 3))
    forces[standing] = weight * found.x[:count].reshape(len(standing), sides) @ edges
    fractions = torque_fractions(
        kinematics, joints, wheel_forces_in_hex=forces, contact_in_hex=contacts, gravity_in_hex=gravity
    )
    return LoadSolution(forces=forces, peak_torque_fraction=float(np.abs(fractions).max()), reason="")


def _pyramid(up: Vec3, friction: float, sides: int) -> np.ndarray:
    """Edges of a pyramid inside the friction cone, each with a unit upward part, shape (sides, 3)."""
    aside = np.cross(up, [1.0, 0.0, 0.0] if abs(up[0]) < 0.9 else [0.0, 1.0, 0.0])
    aside /= np.linalg.norm(aside)
    turn = 2.0 * np.pi * np.arange(sides) / sides
    return np.asarray(up + friction * (np.cos(turn)[:, None] * aside + np.sin(turn)[:, None] * np.cross(up, aside)))


def _torque_map(kinematics: Kinematics, joints: Joints, contacts: Wheels, gravity: Vec3) -> tuple[np.ndarray, np.ndarray]:
    """Torque fractions without wheel forces (6, dof), and their change by each wheel's force (6, dof, 6, 3) [1/N]."""

    def fractions(forces: Wheels) -> Joints:
        return torque_fractions(
            kinematics, joints, wheel_forces_in_hex=forces, contact_in_hex=contacts, gravity_in_hex=gravity
        )

    held = fractions(np.zeros((LEGS, 3)))
    push = np.zeros((LEGS, held.shape[1], LEGS, 3))
    for axis in range(3):
        unit = np.zeros((LEGS, 3))
        unit[:, axis] = 1.0
        change = fractions(unit) - held
        for leg in range(LEGS):
            push[leg, :, leg, axis] = change[leg]
    return held, push
