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
from typing import no_type_check

import numpy as np
from numba import njit

from athlete_twin.errors import SagError
from athlete_twin.geometry.arrays import PerLeg, PerLegFlag, Vec3, Wheels
from athlete_twin.geometry.polygon import signed_distance
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.spec import RobotSpec

AIRBORNE = float(np.inf)
"""lift of a foot that cannot touch the ground [m]"""
SOFT_CONTACT = 0.002
"""compression over which the horizontal springs come in [m]: small against centimetres of sag"""
TOLERANCE = 1e-9
"""largest residual of a solution: forces over weight, moments over weight and size, distances over the sag"""
MAX_ITERATIONS = 60
"""of one attempt; it takes 4 from a cold start when a solution is near"""
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
        start: a solution of a neighbouring problem to begin from.
    """
    springs = FootSprings(stiffness_z=stiffness_z, lateral_ratio=lateral_ratio)
    lifts = np.asarray(lifts, dtype=float)
    if lifts.shape != (6,) or np.isnan(lifts).any() or np.isneginf(lifts).any():
        raise SagError(f"lifts are {lifts}, need six heights [m], or AIRBORNE")
    level_from_hex = _level_from_hex(feet_in_hex, com_in_hex, weight, gravity_in_hex)
    feet, com = feet_in_hex @ level_from_hex.T, level_from_hex @ com_in_hex
    # Copies: numba compiles once more for arrays that are read-only or not contiguous.
    feet, stiffness, lifts, spent = np.ascontiguousarray(feet), springs.stiffness_z.copy(), lifts.copy(), 0
    if start is None:
        begin = np.zeros((7, 3))
        begin[:, 2] = -_even_sink(stiffness, lifts, float(weight))
    else:
        begin = np.vstack([start.displacements, start.com_displacement]) @ level_from_hex.T
    for softness in ((SOFT_CONTACT,), SOFTENED):
        moved = begin
        for soft in softness:
            moved, forces, residual, iterations, firm = _levenberg_marquardt(
                feet, com, weight, stiffness, lateral_ratio, lifts, True, soft, moved
            )
            spent += iterations
        if residual <= TOLERANCE:
            break
    return _solution(
        feet_in_hex, com_in_hex, moved @ level_from_hex, forces @ level_from_hex, lifts, residual, spent, firm, level_from_hex
    )


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

    Only loaded feet enter the equations. Their unknowns are forces, scaled to displacements by eq. 3. A loaded foot's
    spring also pulls: this form cannot know that a foot lifts itself off.
    """
    springs = FootSprings(stiffness_z=stiffness_z, lateral_ratio=lateral_ratio)
    count = int(np.sum(loaded))
    if loaded.shape != (6,):
        raise SagError(f"flags of loaded feet have shape {loaded.shape}, need (6,)")
    if count < 3:
        raise SagError(f"{count} loaded feet carry no robot, at least 3 do")
    level_from_hex = _level_from_hex(feet_in_hex, com_in_hex, weight, gravity_in_hex)
    feet, com = feet_in_hex[loaded] @ level_from_hex.T, level_from_hex @ com_in_hex
    stiffness = springs.stiffness_z[loaded]
    begin = np.zeros((count + 1, 3))
    begin[:, 2] = -weight / stiffness.sum()
    moved, forces, residual, iterations, firm = _levenberg_marquardt(
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


def _level_from_hex(feet: np.ndarray, com: np.ndarray, weight: float, gravity: np.ndarray) -> np.ndarray:
    """Checks the arguments; rotation to a frame whose z axis points against gravity."""
    if feet.shape != (6, 3) or com.shape != (3,) or not (np.isfinite(feet).all() and np.isfinite(com).all()):
        raise SagError(f"feet and CoM have shapes {feet.shape} and {com.shape}, need finite (6, 3) and (3,)")
    if not (np.isfinite(weight) and weight > 0.0):
        raise SagError(f"weight is {weight} N, must be positive")
    size = math.sqrt(gravity @ gravity)
    if not (np.isfinite(size) and size > 0.0):
        raise SagError(f"gravity is {gravity}, must be finite with a length")
    up = -np.asarray(gravity, dtype=float) / size
    # Cross products written out: numpy's cost as much as the whole iteration.
    x, y, z = up
    side = np.array([0.0, z, -y] if abs(x) < 0.9 else [-z, 0.0, x])
    side /= math.sqrt(side @ side)
    a, b, c = side
    return np.array([[b * z - c * y, c * x - a * z, a * y - b * x], side, up])


@njit(cache=True)
@no_type_check
def _even_sink(stiffness, lifts, weight):
    """How far all feet must sink together until their springs carry the weight [m]: where the iteration begins."""
    order = np.argsort(lifts, kind="mergesort")
    carrying, pressed, sink = 0.0, 0.0, 0.0
    for place in range(len(order)):
        foot = order[place]
        if not np.isfinite(lifts[foot]):
            break
        carrying += stiffness[foot]
        pressed += stiffness[foot] * lifts[foot]
        sink = (weight + pressed) / carrying
        if place + 1 < len(order) and sink <= lifts[order[place + 1]]:
            break
    return sink


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
    if residual > TOLERANCE:
        can_carry = np.isfinite(lifts)
        status = "tips" if _tips(feet[can_carry] @ level_from_hex.T, level_from_hex @ com) else "not_converged"
        if can_carry.sum() < 3:
            status = "too_few_feet"
    elif loaded.sum() < 3:
        status = "too_few_feet"
    elif not firm or float(up @ pose.rotation @ up) < np.cos(MAX_TILT):
        status = "tips"
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


@njit(cache=True)
@no_type_check
def _spring_forces(d, stiffness, lateral_ratio, lifts, unilateral, soft):
    """Forces on n feet displaced by d, and what their derivative needs: horizontal stiffness now, and its change."""
    n = stiffness.shape[0]
    forces, side, change = np.zeros((n, 3)), np.zeros(n), np.zeros(n)
    bears = np.zeros(n, dtype=np.bool_)
    for i in range(n):
        compression = -d[i, 2] - lifts[i]
        if unilateral and compression <= 0.0:
            continue
        bears[i] = True
        side[i] = lateral_ratio * stiffness[i]
        if unilateral and compression < soft:
            s = compression / soft
            change[i] = -side[i] * 6.0 * s * (1.0 - s) / soft
            side[i] *= s * s * (3.0 - 2.0 * s)
        forces[i, 0] = -side[i] * d[i, 0]
        forces[i, 1] = -side[i] * d[i, 1]
        forces[i, 2] = stiffness[i] * compression
    return forces, side, change, bears


@njit(cache=True)
@no_type_check
def spring_equations(x, r0, weight, stiffness, lateral_ratio, lifts, unilateral, soft, size, scale, res, jac):
    """Writes scaled residuals of eqs 4-8 and their derivatives by the scaled displacements, of n feet and then the CoM.

    Public for checks and peers. x times `scale` are displacements (n + 1, 3) from r0 (n + 1, 3) [m], z upward, forces by
    eqs 10-12 (`unilateral`) or eq. 3; res is (6 + 3 n,): forces over weight, moments over weight and `size`, distances
    over `scale`; jac is (6 + 3 n, 3 n + 3).
    """
    n = stiffness.shape[0]
    d = x * scale
    p = r0 + d
    forces, side, change, bears = _spring_forces(d[:n], stiffness, lateral_ratio, lifts, unilateral, soft)
    res[:] = 0.0
    jac[:, :] = 0.0
    # Eq. 4 over the weight, eq. 5 over weight and size.
    res[2] = -1.0
    res[3] = -p[n, 1] / size
    res[4] = p[n, 0] / size
    jac[3, 3 * n + 1] = -scale / size
    jac[4, 3 * n] = scale / size
    g = np.zeros((3, 3))
    for i in range(n):
        fx, fy, fz = forces[i, 0] / weight, forces[i, 1] / weight, forces[i, 2] / weight
        px, py, pz = p[i, 0], p[i, 1], p[i, 2]
        res[0] += fx
        res[1] += fy
        res[2] += fz
        res[3] += (py * fz - pz * fy) / size
        res[4] += (pz * fx - px * fz) / size
        res[5] += (px * fy - py * fx) / size
        if not bears[i]:
            continue
        # g = d force / d displacement: the horizontal forces also change with compression while contact comes in.
        g[0, 0] = -side[i] / weight
        g[1, 1] = g[0, 0]
        g[2, 2] = -stiffness[i] / weight
        g[0, 2] = -change[i] * d[i, 0] / weight
        g[1, 2] = -change[i] * d[i, 1] / weight
        for c in range(3):
            col = 3 * i + c
            for row in range(3):
                jac[row, col] = g[row, c] * scale
            jac[3, col] = (py * g[2, c] - pz * g[1, c]) * scale / size
            jac[4, col] = (pz * g[0, c] - px * g[2, c]) * scale / size
            jac[5, col] = (px * g[1, c] - py * g[0, c]) * scale / size
        jac[3, 3 * i + 1] += fz * scale / size
        jac[3, 3 * i + 2] -= fy * scale / size
        jac[4, 3 * i + 2] += fx * scale / size
        jac[4, 3 * i] -= fz * scale / size
        jac[5, 3 * i] += fy * scale / size
        jac[5, 3 * i + 1] -= fx * scale / size
    # Eqs 6, 7 and 8: neighbours, every other foot, and the CoM keep their distances.
    row = 6
    for i in range(n):
        for kind in range(3):
            j = n if kind == 2 else (i + kind + 1) % n
            before, after = 0.0, 0.0
            for c in range(3):
                before += (r0[i, c] - r0[j, c]) ** 2
                after += (p[i, c] - p[j, c]) ** 2
            before, after = np.sqrt(before), np.sqrt(after)
            res[row] = (after - before) / scale
            for c in range(3):
                unit = (p[i, c] - p[j, c]) / max(after, 1e-12)
                jac[row, 3 * i + c] += unit
                jac[row, 3 * j + c] -= unit
            row += 1


@njit(cache=True)
@no_type_check
def _cholesky_solve(a, b):
    """Solves a x = b in place for a symmetric a; False when a is not positive definite."""
    n = a.shape[0]
    for i in range(n):
        for j in range(i + 1):
            s = a[i, j]
            for k in range(j):
                s -= a[i, k] * a[j, k]
            if i == j:
                if s <= 0.0:
                    return False
                a[i, i] = np.sqrt(s)
            else:
                a[i, j] = s / a[j, j]
    for i in range(n):
        s = b[i]
        for k in range(i):
            s -= a[i, k] * b[k]
        b[i] = s / a[i, i]
    for i in range(n - 1, -1, -1):
        s = b[i]
        for k in range(i + 1, n):
            s -= a[k, i] * b[k]
        b[i] = s / a[i, i]
    return True


@njit(cache=True)
@no_type_check
def _levenberg_marquardt(feet, com, weight, stiffness, lateral_ratio, lifts, unilateral, soft, begin):
    """Displacements (n + 1, 3), forces (n, 3), largest residual, iterations, whether the balance is a stable one.

    z is up; lengths in metres.
    """
    n = stiffness.shape[0]
    unknowns, rows = 3 * (n + 1), 6 + 3 * n
    # Moments are taken about the middle of the feet: far from it they would drown in rounding.
    centre = np.zeros(3)
    for i in range(n):
        centre += feet[i] / n
    r0 = np.empty((n + 1, 3))
    size = 0.0
    for i in range(n):
        r0[i] = feet[i] - centre
        size += np.sqrt(np.sum(r0[i] ** 2)) / n
    r0[n] = com - centre
    if size == 0.0:  # all feet in one point
        return begin, np.zeros((n, 3)), np.inf, 0, False
    scale = weight / np.sum(stiffness)
    x = begin / scale
    res, jac = np.empty(rows), np.empty((rows, unknowns))
    trial_res, trial_jac = np.empty(rows), np.empty((rows, unknowns))
    spring_equations(x, r0, weight, stiffness, lateral_ratio, lifts, unilateral, soft, size, scale, res, jac)
    cost, damping, iteration = np.sum(res**2), 1e-3, 0
    while iteration < MAX_ITERATIONS and np.max(np.abs(res)) > 0.01 * TOLERANCE and damping < 1e12:
        iteration += 1
        normal = jac.T @ jac
        step = -(jac.T @ res)
        for k in range(unknowns):
            normal[k, k] += damping * normal[k, k] + 1e-15
        if not _cholesky_solve(normal, step):
            damping = max(8.0 * damping, 1e-9)
            continue
        trial = x + step.reshape(n + 1, 3)
        spring_equations(
            trial, r0, weight, stiffness, lateral_ratio, lifts, unilateral, soft, size, scale, trial_res, trial_jac
        )
        trial_cost = np.sum(trial_res**2)
        if trial_cost < cost:
            x, cost = trial, trial_cost
            res, trial_res = trial_res, res
            jac, trial_jac = trial_jac, jac
            damping = max(0.05 * damping, 1e-14)
        else:
            if np.max(np.abs(step)) < 1e-13:
                break
            damping = max(8.0 * damping, 1e-9)
    d = x * scale
    forces, side, _, bears = _spring_forces(d[:n], stiffness, lateral_ratio, lifts, unilateral, soft)
    return d, forces, np.max(np.abs(res)), iteration, _firm(r0 + d, forces, side, stiffness, bears, size)


@njit(cache=True)
@no_type_check
def _firm(places, forces, side, stiffness, bears, size):
    """Whether every small motion of the rigid robot costs energy: its 6 x 6 stiffness about the CoM is positive definite.

    A turn by a moves a foot at r from the CoM by a x r + a x (a x r) / 2; the second term works against the foot's force,
    and for feet below a CoM it is the weight that pulls the robot over.
    """
    n = stiffness.shape[0]
    total, motion = np.zeros((6, 6)), np.zeros((3, 6))
    for i in range(n):
        if not bears[i]:
            continue
        r = (places[i] - places[n]) / size
        f = forces[i] / size
        for c in range(3):
            motion[c, c] = 1.0
        motion[0, 4], motion[0, 5] = r[2], -r[1]
        motion[1, 3], motion[1, 5] = -r[2], r[0]
        motion[2, 3], motion[2, 4] = r[1], -r[0]
        along = f[0] * r[0] + f[1] * r[1] + f[2] * r[2]
        for a in range(6):
            for b in range(6):
                total[a, b] += side[i] * (motion[0, a] * motion[0, b] + motion[1, a] * motion[1, b])
                total[a, b] += stiffness[i] * motion[2, a] * motion[2, b]
        for a in range(3):
            total[3 + a, 3 + a] += along
            for b in range(3):
                total[3 + a, 3 + b] -= 0.5 * (f[a] * r[b] + f[b] * r[a])
    return _cholesky_solve(total, np.zeros(6))
