"""The equations of the contact springs with their derivatives, and the Levenberg-Marquardt that solves them, compiled.

[SunSpiral2012] eqs 3-12 as `sag_model` states them: z upward, unknowns the displacements of n feet and then of the CoM,
(n + 1, 3). That file says what the model assumes; here is how it is computed.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit

TOLERANCE = 1e-9
"""largest residual of a solution: forces over weight, moments over weight and size, distances over the sag"""
MAX_ITERATIONS = 60
"""of one attempt; it takes 4 from a cold start when a solution is near"""


@njit(cache=True)
@no_type_check
def even_sink(stiffness, lifts, weight):
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


@njit(cache=True)
@no_type_check
def spring_forces(d, stiffness, lateral_ratio, lifts, unilateral, soft):
    """Forces on n feet displaced by d, z upward, and what their derivative needs: horizontal stiffness now, its change, who bears.

    The one place of the spring law, eqs 10-12 (`unilateral`) or eq. 3: d (n, 3), lifts (n,) and soft in metres, all float64
    and writable; forces (n, 3) [N], horizontal stiffness (n,) [N/m] and its derivative by compression, flags (n,).
    """
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
    forces, side, change, bears = spring_forces(d[:n], stiffness, lateral_ratio, lifts, unilateral, soft)
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
def levenberg_marquardt(feet, com, weight, stiffness, lateral_ratio, lifts, unilateral, soft, begin):
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
    forces, side, _, bears = spring_forces(d[:n], stiffness, lateral_ratio, lifts, unilateral, soft)
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
