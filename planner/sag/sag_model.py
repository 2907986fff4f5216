"""The contact-spring model of sag: a rigid robot on six springs, one under each foot ([SunSpiral2012] s5.1.1).

Given where feet and centre of mass would be without weight ("unsagged"), where are they under it, and what does each
foot carry? Two forms. `solve_sag` (eqs 9-12) knows how far each foot has been lifted above its contact point, so that a
foot unloads gradually; its unknowns are the displacements of feet and CoM, the forces follow. `solve_loaded` (eqs 3-8)
takes feet as either loaded or not.

Signs. The paper measures +z downward; here everything is measured upward along `-gravity`. So a sagging foot has a
negative displacement, a lifted foot a positive lift, and eq. 12 reads `f_up = k (-displacement_up - lift)`. Eq. 3
prints displacement = force / k for the force of the foot on its spring; the force of the ground on the foot, which eqs
4 and 5 sum, has the opposite sign, as in eqs 10-12.

Two things the equations leave open. Eqs 10 and 11 drop the horizontal force at once when contact breaks, which leaves
some lifts without a solution; here the horizontal springs come in smoothly over the first millimetres of compression
and are the paper's beyond. And feet in one plane with the CoM at foot height make eqs 6-8 singular: they hold the
feet's heights together only through a CoM above them, as every walking robot's is.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from athlete_twin.errors import SagError
from athlete_twin.geometry.arrays import Mat3, PerLeg, PerLegFlag, Vec3, Wheels
from athlete_twin.geometry.polygon import signed_distance
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.spec import RobotSpec
from planner.sag.spring_equations import TOLERANCE, even_sink, levenberg_marquardt

AIRBORNE = float(np.inf)
"""lift of a foot that cannot touch the ground [m]"""
SOFT_CONTACT = 0.002
"""compression over which the horizontal springs come in [m]: small against centimetres of sag"""
SOFTENED = (0.05, 0.015, 0.005, SOFT_CONTACT)
"""compressions over which contact comes in on the second attempt, each starting from the one before [m]"""
MAX_TILT = 0.5
"""tilt by sag beyond which a balance of forces is that of a robot already lying over [rad]"""
DOWN = np.array([0.0, 0.0, -1.0])


@dataclass(frozen=True, eq=False, kw_only=True)
class FootSprings:
    """What the ground believes of the compliance: one linear spring a foot, [SunSpiral2012] eq. 3."""

    stiffness_z: PerLeg
    """along gravity, shape (6,) [N/m]"""
    lateral_ratio: float
    """horizontal over vertical stiffness"""

    def __post_init__(self) -> None:
        stiffness = np.array(self.stiffness_z, dtype=float)
        if stiffness.shape != (6,) or not (np.isfinite(stiffness).all() and (stiffness > 0.0).all()):
            raise SagError(f"spring constants are {stiffness} N/m, need six positive ones")
        if not (np.isfinite(self.lateral_ratio) and self.lateral_ratio > 0.0):
            raise SagError(f"lateral ratio is {self.lateral_ratio}, must be positive")
        stiffness.setflags(write=False)
        object.__setattr__(self, "stiffness_z", stiffness)

    @staticmethod
    def from_spec(spec: RobotSpec) -> FootSprings:
        """The same spring under every foot, as drawn."""
        return FootSprings(
            stiffness_z=np.full(6, spec.believed_foot_stiffness), lateral_ratio=spec.believed_lateral_ratio
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class SagSolution:
    """Forces and sagged pose. Only a solution whose status is "converged" may be believed."""

    forces: Wheels
    """of the ground on the feet, in hex, shape (6, 3) [N]; exactly zero for a foot above the ground"""
    displacements: Wheels
    """of the feet from their unsagged places, in the unsagged hex frame, shape (6, 3) [m]"""
    deflections: Wheels
    """of the springs, shape (6, 3) [m]: displacement less lift for a loaded foot, zero for one in the air"""
    com_displacement: Vec3
    """of the centre of mass, in the unsagged hex frame [m]"""
    unsagged_from_sagged: SE3
    """pose of the sagged chassis in the unsagged hex frame"""
    loaded: PerLegFlag
    """which feet carry load, shape (6,)"""
    residual: float
    """largest scaled residual; at most `TOLERANCE` when converged"""
    iterations: int
    status: str
    """"converged"; "tips": the CoM is outside the feet that could carry, the chassis turns by more than `MAX_TILT`, or the
    forces balance like a pencil on its tip, as over feet on one line: the least push makes it fall;
    "pulls": of `solve_loaded` alone, the ground would have to hold a foot down, so that it is not loaded in truth;
    "too_few_feet": fewer than three carry; "not_converged": the iteration ended elsewhere"""

    @property
    def converged(self) -> bool:
        """Whether the solution may be believed."""
        return self.status == "converged"


def solve_sag(
    feet_in_hex: Wheels,
    com_in_hex: Vec3,
    weight: float,
    *,
    stiffness_z: PerLeg,
    lateral_ratio: float,
    lifts: PerLeg,
    gravity_in_hex: Vec3 = DOWN,
    start: SagSolution | None = None,
) -> SagSolution:
    """Sag with gradual unloading, [SunSpiral2012] eqs 4-12, by Levenberg-Marquardt with analytic derivatives.

    Args:
        feet_in_hex: where the springs hold the feet, unsagged, shape (6, 3) [m].
        com_in_hex: centre of mass, unsagged [m].
        weight: of the robot with payload [N].
        stiffness_z: spring constants along gravity, shape (6,) [N/m].
        lateral_ratio: horizontal over vertical stiffness.
        lifts: height of each unsagged foot above the place where its spring begins to bear, shape (6,) [m]. Positive
            lifted (eq. 9), `AIRBORNE` out of the way; negative pressed in already, as after a touchdown that went on.
        gravity_in_hex: where gravity points; any length.
        start: a solution of a neighbouring problem to begin from. One that is not converged is not begun from, and where
            one leads to no solution a cold start is tried: it changes how long a solution takes, not whether there is one.
    """
    springs = FootSprings(stiffness_z=stiffness_z, lateral_ratio=lateral_ratio)
    lifts = np.asarray(lifts, dtype=float)
    if lifts.shape != (6,) or np.isnan(lifts).any() or np.isneginf(lifts).any():
        raise SagError(f"lifts are {lifts}, need six heights [m], or AIRBORNE")
    _check(feet_in_hex, com_in_hex, weight)
    level_from_hex = levelling(gravity_in_hex)
    feet, com = feet_in_hex @ level_from_hex.T, level_from_hex @ com_in_hex
    # Copies: numba compiles once more for arrays that are read-only or not contiguous.
    feet, stiffness, lifts, spent = np.ascontiguousarray(feet), springs.stiffness_z.copy(), lifts.copy(), 0
    cold = np.zeros((7, 3))
    cold[:, 2] = -even_sink(stiffness, lifts, float(weight))
    begins = [cold]
    if start is not None and start.converged:
        begins.insert(0, np.vstack([start.displacements, start.com_displacement]) @ level_from_hex.T)
    for begin in begins:
        for softness in ((SOFT_CONTACT,), SOFTENED):
            moved = begin
            for soft in softness:
                moved, forces, residual, iterations, firm = levenberg_marquardt(
                    feet, com, weight, stiffness, lateral_ratio, lifts, True, soft, moved
                )
                spent += iterations
            if residual <= TOLERANCE:
                break
        found = _solution(
            feet_in_hex, com_in_hex, moved @ level_from_hex, forces @ level_from_hex, lifts, residual, spent, firm, level_from_hex
        )
        if found.converged:
            break
    return found


def solve_loaded(
    feet_in_hex: Wheels,
    com_in_hex: Vec3,
    weight: float,
    *,
    stiffness_z: PerLeg,
    lateral_ratio: float,
    loaded: PerLegFlag,
    gravity_in_hex: Vec3 = DOWN,
) -> SagSolution:
    """Sag with feet either loaded or not, [SunSpiral2012] eqs 3-8.

    Only loaded feet enter the equations. Unknowns are their forces and the CoM; each force is held as the displacement
    force / k of eq. 3, which brings all unknowns to one size and changes nothing else. A loaded foot's spring also
    pulls: this form cannot let a foot go by itself, but says that one pulls.

    Args:
        feet_in_hex: where the springs hold the feet, unsagged, shape (6, 3) [m].
        com_in_hex: centre of mass, unsagged [m].
        weight: of the robot with payload [N].
        stiffness_z: spring constants along gravity, shape (6,) [N/m].
        lateral_ratio: horizontal over vertical stiffness.
        loaded: which feet carry, shape (6,), at least three.
        gravity_in_hex: where gravity points; any length.
    """
    springs = FootSprings(stiffness_z=stiffness_z, lateral_ratio=lateral_ratio)
    count = int(np.sum(loaded))
    if loaded.shape != (6,):
        raise SagError(f"flags of loaded feet have shape {loaded.shape}, need (6,)")
    if count < 3:
        raise SagError(f"{count} loaded feet carry no robot, at least 3 do")
    _check(feet_in_hex, com_in_hex, weight)
    level_from_hex = levelling(gravity_in_hex)
    feet, com = feet_in_hex[loaded] @ level_from_hex.T, level_from_hex @ com_in_hex
    stiffness = springs.stiffness_z[loaded]
    begin = np.zeros((count + 1, 3))
    begin[:, 2] = -weight / stiffness.sum()
    moved, forces, residual, iterations, firm = levenberg_marquardt(
        np.ascontiguousarray(feet), com, weight, stiffness, lateral_ratio, np.zeros(count), False, SOFT_CONTACT, begin
    )
    before = np.vstack([feet_in_hex[loaded], com_in_hex])
    pose = _rigid_fit(before, before + moved @ level_from_hex)
    displacements, all_forces = np.empty((7, 3)), np.zeros((6, 3))
    displacements[:6] = pose.apply(feet_in_hex) - feet_in_hex
    displacements[:6][loaded] = moved[:-1] @ level_from_hex
    displacements[6] = moved[-1] @ level_from_hex
    all_forces[loaded] = forces @ level_from_hex
    lifts = np.where(loaded, 0.0, AIRBORNE)
    return _solution(
        feet_in_hex, com_in_hex, displacements, all_forces, lifts, residual, iterations, firm, level_from_hex, pose
    )


def levelling(gravity_in_hex: Vec3) -> Mat3:
    """Rotation from hex to a frame whose z axis points against gravity."""
    size = math.sqrt(gravity_in_hex @ gravity_in_hex)
    if not (np.isfinite(size) and size > 0.0):
        raise SagError(f"gravity is {gravity_in_hex}, must be finite with a length")
    up = -np.asarray(gravity_in_hex, dtype=float) / size
    # Cross products written out: numpy's cost as much as the whole iteration.
    x, y, z = up
    side = np.array([0.0, z, -y] if abs(x) < 0.9 else [-z, 0.0, x])
    side /= math.sqrt(side @ side)
    a, b, c = side
    return np.array([[b * z - c * y, c * x - a * z, a * y - b * x], side, up])


def _check(feet: np.ndarray, com: np.ndarray, weight: float) -> None:
    if feet.shape != (6, 3) or com.shape != (3,) or not (np.isfinite(feet).all() and np.isfinite(com).all()):
        raise SagError(f"feet and CoM have shapes {feet.shape} and {com.shape}, need finite (6, 3) and (3,)")
    if not (np.isfinite(weight) and weight > 0.0):
        raise SagError(f"weight is {weight} N, must be positive")


def _rigid_fit(before: np.ndarray, after: np.ndarray) -> SE3:
    """The rigid motion that takes one set of points to the other, in the least-squares sense (Kabsch)."""
    centre, moved = before.sum(axis=0) / len(before), after.sum(axis=0) / len(after)
    u, _, vt = np.linalg.svd((after - moved).T @ (before - centre))
    (a, b, c), (d, e, f), (g, h, i) = (u @ vt).tolist()
    if a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) < 0.0:  # numpy's determinant takes longer than its SVD
        u[:, 2] = -u[:, 2]
    rotation = u @ vt
    return SE3(rotation, moved - rotation @ centre)


def _solution(
    feet: np.ndarray,
    com: np.ndarray,
    displacements: np.ndarray,
    forces: np.ndarray,
    lifts: np.ndarray,
    residual: float,
    iterations: int,
    firm: bool,
    level_from_hex: np.ndarray,
    pose: SE3 | None = None,
) -> SagSolution:
    loaded = (forces != 0.0).any(axis=1)
    up = level_from_hex[2]
    lifted = np.where(loaded, lifts, 0.0)[:, None] * up
    if pose is None:
        pose = _rigid_fit(np.vstack([feet, com]), np.vstack([feet, com]) + displacements)
    status = "converged"
    can_carry = np.isfinite(lifts)
    if residual > TOLERANCE:
        status = "tips" if _tips(feet[can_carry] @ level_from_hex.T, level_from_hex @ com) else "not_converged"
        if can_carry.sum() < 3:
            status = "too_few_feet"
    elif loaded.sum() < 3:
        status = "too_few_feet"
    elif not firm or float(up @ pose.rotation @ up) < np.cos(MAX_TILT):
        status = "tips"
    elif float((forces @ up).min()) < -TOLERANCE * float(np.abs(forces @ up).sum()):
        status = "tips" if _tips(feet[can_carry] @ level_from_hex.T, level_from_hex @ com) else "pulls"
    return SagSolution(
        forces=forces,
        displacements=displacements[:6],
        deflections=np.where(loaded[:, None], displacements[:6] + lifted, 0.0),
        com_displacement=displacements[6],
        unsagged_from_sagged=pose,
        loaded=loaded,
        residual=float(residual),
        iterations=int(iterations),
        status=status,
    )


def _tips(feet_level: np.ndarray, com_level: np.ndarray) -> bool:
    return len(feet_level) > 0 and signed_distance(com_level[:2].copy(), feet_level[:, :2].copy()) < 0.0
