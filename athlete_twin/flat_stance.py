"""How the mock stands: a chassis on six equal vertical springs on flat ground, its planted wheels where they are.

Compiled, and in plain numbers: it is solved at each control tick in which a joint moves, and arrays of six cost ten times as much.
"""

from __future__ import annotations

import math
from typing import no_type_check

import numba
import numpy as np

SETTLED = 1e-9
"""change of the chassis' height and tilt at which the springs balance [m, rad]"""
NEWTON_STEPS = 30
"""at most; three or four as a rule, most where a wheel leaves or meets the ground"""


@no_type_check
@numba.njit(cache=True)
def stand(wheels_in_hex, com_in_hex, height_tilt, radius, stiffness, weight, stance, place, anchors):  # type: ignore[no-untyped-def]
    """The robot at rest after its joints moved.

    Args:
        wheels_in_hex: axles, shape (6, 3) [m].
        com_in_hex: centre of mass, shape (3,) [m].
        height_tilt: height, roll and pitch of the chassis before, shape (3,) [m, rad].
        radius: of the wheels [m].
        stiffness: of each spring [N/m].
        weight: of the robot [N].
        stance: legs that are led as standing ones, shape (6,).
        place: x, y and yaw of the chassis before, shape (3,) [m, rad].
        anchors: where the wheels stand, shape (6, 2) [m].

    Returns:
        Height and tilt, loads (6,) [N], place, anchors, rotation and translation of `world_from_hex`, axles and centre of mass
        in world [m].
    """
    height_tilt, loads = balance(wheels_in_hex, com_in_hex, height_tilt, radius, stiffness, weight)
    level_from_hex = rolled_pitched(height_tilt[1], height_tilt[2])
    plan = _turned(wheels_in_hex, level_from_hex, 2)
    planted = stance & (loads > 0.0)
    if planted.sum() >= 2:
        place = fit_plan(plan, anchors, planted)
    world_from_level = yawed(place[2])
    rotation = np.empty((3, 3))
    for row in range(3):
        for column in range(3):
            rotation[row, column] = (
                world_from_level[row, 0] * level_from_hex[0, column]
                + world_from_level[row, 1] * level_from_hex[1, column]
                + world_from_level[row, 2] * level_from_hex[2, column]
            )
    translation = np.array([place[0], place[1], height_tilt[0]])
    axles = _turned(wheels_in_hex, rotation, 3) + translation
    com = _turned(com_in_hex.reshape((1, 3)), rotation, 3)[0] + translation
    stands = anchors.copy()
    for leg in range(len(stands)):
        if not planted[leg]:
            stands[leg, 0], stands[leg, 1] = axles[leg, 0], axles[leg, 1]
    return height_tilt, loads, place, stands, rotation, translation, axles, com


@no_type_check
@numba.njit(cache=True)
def balance(wheels_in_hex, com_in_hex, start, radius, stiffness, weight):  # type: ignore[no-untyped-def]
    """Height, roll and pitch of the chassis on six vertical springs, shape (3,), and the load on each wheel (6,) [N].

    Newton's method for small tilts from `start`; a wheel above the ground carries nothing.
    """
    height, roll, pitch = start[0], start[1], start[2]
    cx, cy, cz = com_in_hex[0], com_in_hex[1], com_in_hex[2]
    loads = np.zeros(len(wheels_in_hex))
    # How the three residuals change as the wheels sink with height, roll and pitch, by columns.
    m = np.empty(9)
    for _ in range(NEWTON_STEPS):
        cr, sr, cp, sp = math.cos(roll), math.sin(roll), math.cos(pitch), math.sin(pitch)
        com_x, com_y = cp * cx + sp * (sr * cy + cr * cz), cr * cy - sr * cz
        lift, about_x, about_y = -weight, 0.0, 0.0
        m[:] = 0.0
        for leg in range(len(wheels_in_hex)):
            x, y, z = wheels_in_hex[leg, 0], wheels_in_hex[leg, 1], wheels_in_hex[leg, 2]
            turned = sr * y + cr * z
            wx, wy, wz = cp * x + sp * turned, cr * y - sr * z, cp * turned - sp * x
            sink = radius - height - wz
            load = stiffness * sink if sink > 0.0 else 0.0
            loads[leg] = load
            arm_x, arm_y = wx - com_x, wy - com_y
            lift, about_x, about_y = lift + load, about_x + load * arm_y, about_y - load * arm_x
            # The weakly held rest keeps a hovering chassis solvable.
            spring = stiffness if sink > 0.0 else 1e-3 * stiffness
            for row, lever in enumerate((spring, spring * arm_y, -spring * arm_x)):
                m[row] -= lever
                m[3 + row] -= lever * wy
                m[6 + row] += lever * wx
        by_height, by_roll, by_pitch = _solved(m[0:3], m[3:6], m[6:9], (-lift, -about_x, -about_y))
        largest = max(abs(by_height), abs(by_roll), abs(by_pitch))
        scale = min(1.0, 0.05 / max(largest, 1e-12))
        height, roll, pitch = height + scale * by_height, roll + scale * by_roll, pitch + scale * by_pitch
        if scale * largest < SETTLED:
            break
    return np.array([height, roll, pitch]), loads


@no_type_check
@numba.njit(cache=True)
def fit_plan(points, places, used):  # type: ignore[no-untyped-def]
    """x, y and yaw that bring the used `points` (6, 2) onto their `places` (6, 2), least squares."""
    n = used.sum()
    px = py = qx = qy = 0.0
    for i in range(len(used)):
        if used[i]:
            px, py, qx, qy = px + points[i, 0], py + points[i, 1], qx + places[i, 0], qy + places[i, 1]
    px, py, qx, qy = px / n, py / n, qx / n, qy / n
    across = along = 0.0
    for i in range(len(used)):
        if used[i]:
            ax, ay, bx, by = points[i, 0] - px, points[i, 1] - py, places[i, 0] - qx, places[i, 1] - qy
            across += ax * by - ay * bx
            along += ax * bx + ay * by
    yaw = math.atan2(across, along)
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([qx - (c * px - s * py), qy - (s * px + c * py), yaw])


@no_type_check
@numba.njit(cache=True)
def rolled_pitched(roll, pitch):  # type: ignore[no-untyped-def]
    """Rotation matrix of `SE3.from_rpy(roll, pitch, 0)`."""
    cr, sr, cp, sp = math.cos(roll), math.sin(roll), math.cos(pitch), math.sin(pitch)
    return np.array([[cp, sp * sr, sp * cr], [0.0, cr, -sr], [-sp, cp * sr, cp * cr]])


@no_type_check
@numba.njit(cache=True)
def yawed(yaw):  # type: ignore[no-untyped-def]
    """Rotation matrix of `SE3.from_rpy(0, 0, yaw)`."""
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


@no_type_check
@numba.njit(cache=True)
def _turned(points, rotation, rows):  # type: ignore[no-untyped-def]
    """The first so many coordinates of points (n, 3) turned, shape (n, rows)."""
    out = np.empty((len(points), rows))
    for i in range(len(points)):
        for row in range(rows):
            out[i, row] = (
                rotation[row, 0] * points[i, 0] + rotation[row, 1] * points[i, 1] + rotation[row, 2] * points[i, 2]
            )
    return out


@no_type_check
@numba.njit(cache=True)
def _solved(a, b, c, right):  # type: ignore[no-untyped-def]
    """The solution of A x = right by Cramer's rule; A (3, 3) has the columns a, b and c."""
    whole = _determinant(a, b, c)
    return _determinant(right, b, c) / whole, _determinant(a, right, c) / whole, _determinant(a, b, right) / whole


@no_type_check
@numba.njit(cache=True)
def _determinant(u, v, w):  # type: ignore[no-untyped-def]
    return u[0] * (v[1] * w[2] - v[2] * w[1]) - u[1] * (v[0] * w[2] - v[2] * w[0]) + u[2] * (v[0] * w[1] - v[1] * w[0])
