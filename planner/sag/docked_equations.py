"""The balance of a robot whose decks twist on docks, compiled: what `docked` asks for hundreds of times a solution."""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit

from planner.sag.spring_equations import spring_forces

STEP = 1e-6
"""by which unknowns are varied for derivatives [m], [rad]"""


@njit(cache=True)
@no_type_check
def balance(x, feet, feet_hung, coms, coms_hung, loads, places, axes, twist, level, stiffness, ratio, lifts, soft, weight, size):
    """Residuals of forces, moments and dock torques, shape (6 + m,): over the weight, and over weight and `size`.

    Args:
        x: translation and rotation vector of the pallet, and the docks' angles, shape (6 + m,) [m, rad].
        feet: unsagged, shape (6, 3) [m].
        feet_hung: index of the piece of each, -1 for the pallet, shape (6,).
        coms: of the pieces and the pallet, unsagged, shape (m + 1, 3) [m].
        coms_hung: as `feet_hung`, shape (m + 1,).
        loads: their weights as forces, shape (m + 1, 3) [N].
        places: points of the docks' axes, shape (m, 3) [m].
        axes: their directions, shape (m, 3).
        twist: stiffness of a dock [N m/rad].
        level: rotation from hex to a frame with z upright, shape (3, 3).
        stiffness: of the feet, shape (6,) [N/m].
        ratio: horizontal over vertical stiffness.
        lifts: of the feet, shape (6,) [m].
        soft: compression over which horizontal springs come in [m].
        weight: of the whole robot [N].
        size: of the robot [m].
    """
    m = len(places)
    turn, shift = turned(x[3:6]), x[:3]
    stood, centres = placed(feet, feet_hung, x, places, axes), placed(coms, coms_hung, x, places, axes)
    forces = spring_forces(np.ascontiguousarray((stood - feet) @ level.T), stiffness, ratio, lifts, True, soft)[0] @ level
    out = np.zeros(6 + m)
    for i in range(m):
        out[6 + i] = -twist * x[6 + i]
    for group in range(2):
        points, on, hung = (stood, forces, feet_hung) if group == 0 else (centres, loads, coms_hung)
        for k in range(len(points)):
            out[:3] += on[k]
            out[3:6] += crossed(points[k] - shift, on[k])
            i = hung[k]
            if i >= 0:
                through = turn @ places[i] + shift
                out[6 + i] += np.dot(turn @ axes[i], crossed(points[k] - through, on[k]))
    out[:3] /= weight
    out[3:] /= weight * size
    return out


@njit(cache=True)
@no_type_check
def derivative(x, feet, feet_hung, coms, coms_hung, loads, places, axes, twist, level, stiffness, ratio, lifts, soft, weight, size):
    """Of `balance` by x, shape (n, n), by central differences of one absolute step: unknowns that begin at zero need no smaller one."""
    n = len(x)
    out = np.empty((n, n))
    for k in range(n):
        ahead, behind = x.copy(), x.copy()
        ahead[k] += STEP
        behind[k] -= STEP
        up = balance(
            ahead, feet, feet_hung, coms, coms_hung, loads, places, axes, twist, level, stiffness, ratio, lifts, soft, weight, size
        )
        down = balance(
            behind, feet, feet_hung, coms, coms_hung, loads, places, axes, twist, level, stiffness, ratio, lifts, soft, weight, size
        )
        out[:, k] = (up - down) / (2.0 * STEP)
    return out


@njit(cache=True)
@no_type_check
def placed(points, hung, x, places, axes):
    """Unsagged points (n, 3), each of a piece or (-1) of the pallet, turned by the docks and moved by the pallet's pose."""
    turn, shift = turned(x[3:6]), x[:3]
    out = np.empty_like(points)
    for k in range(len(points)):
        p = points[k].copy()
        i = hung[k]
        if i >= 0:
            p = turned(x[6 + i] * axes[i]) @ (p - places[i]) + places[i]
        out[k] = turn @ p + shift
    return out


@njit(cache=True)
@no_type_check
def turned(rotvec):
    """Rotation matrix of a rotation vector, shape (3, 3)."""
    angle = np.sqrt(np.dot(rotvec, rotvec))
    # sin(a)/a and (1 - cos(a))/a^2, by their series where these would lose digits.
    first = 1.0 - angle**2 / 6.0 if angle < 1e-4 else np.sin(angle) / angle
    second = 0.5 - angle**2 / 24.0 if angle < 1e-4 else (1.0 - np.cos(angle)) / angle**2
    x, y, z = rotvec
    k = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + first * k + second * (k @ k)


@njit(cache=True)
@no_type_check
def crossed(a, b):
    """Cross product of two vectors (3,)."""
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])
