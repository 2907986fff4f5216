"""Convex polygons in plan view: hulls, signed distances, intersections. Support polygons are built from these.

A signed distance is positive inside. A set of points that spans no area (two points, or all on one line) has no
inside: its signed distance is zero on it and negative elsewhere. The points need no order, and points inside the hull
do no harm.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from jaxtyping import Float, Integer
from numba import njit

from athlete_twin.errors import SupportError
from athlete_twin.geometry.arrays import Points2, Vec2

COLLINEAR = 1e-9
"""distance below which a point lies on a line [m]: far below any tyre's width, far above rounding"""


def convex_hull(points: Points2) -> Integer[np.ndarray, " k"]:
    """Indices of the corners of the convex hull, counter-clockwise from the lowest x.

    Two indices when all points lie on one line, one when they coincide.
    """
    points = _checked(points)
    order = np.lexsort((points[:, 1], points[:, 0]))
    lower = _chain(points, order)
    upper = _chain(points, order[::-1])
    corners = lower[:-1] + upper[:-1]
    if not corners or np.ptp(points[corners], axis=0).max() < COLLINEAR:
        corners = [int(order[0])]
    return np.array(corners, dtype=np.int64)


def signed_distance(point: Vec2, corners: Points2) -> float:
    """Distance of a point to the border of the hull of `corners` [m], positive inside, negative outside."""
    return float(_signed_distance(point[0], point[1], _checked(corners), -1))


def signed_distances(points: Points2, corners: Float[np.ndarray, "n m 2"]) -> Float[np.ndarray, " n"]:
    """Row by row the signed distance of `points` (n, 2) to the hulls of `corners` (n, m, 2) [m]."""
    _check_rows(points, corners)
    return np.asarray(_signed_distances(_float(points), _float(corners)))


def conservative_distance(point: Vec2, corners: Points2) -> float:
    """Signed distance of a point to the intersection of the hulls with each corner removed in turn [m].

    Exact inside and on the border. Outside it is the distance to the hull that is farthest away, which is at most the
    distance to the intersection. An intersection without area gives at most zero.
    """
    return float(_conservative_distance(point[0], point[1], _checked(corners)))


def conservative_distances(points: Points2, corners: Float[np.ndarray, "n m 2"]) -> Float[np.ndarray, " n"]:
    """Row by row the conservative distance of `points` (n, 2) to sets of corners (n, m, 2) [m]."""
    _check_rows(points, corners)
    return np.asarray(_conservative_distances(_float(points), _float(corners)))


def intersect_convex(first: Points2, second: Points2) -> Points2:
    """Corners of the intersection of two convex polygons given counter-clockwise, shape (k, 2); k is 0 when empty."""
    polygon = [np.asarray(p, dtype=float) for p in first]
    for start, end in zip(second, np.roll(second, -1, axis=0), strict=True):
        edge = end - start
        side = [float(edge[0] * (p[1] - start[1]) - edge[1] * (p[0] - start[0])) for p in polygon]
        clipped: list[np.ndarray] = []
        for i, p in enumerate(polygon):
            before, here = side[i - 1], side[i]
            if before * here < 0.0:
                clipped.append(polygon[i - 1] + (before / (before - here)) * (p - polygon[i - 1]))
            if here >= 0.0:
                clipped.append(p)
        polygon = clipped
    return np.array(polygon).reshape(-1, 2)


def area(corners: Points2) -> float:
    """Area of a polygon given counter-clockwise [m2]."""
    x, y = corners[:, 0], corners[:, 1]
    return float(0.5 * np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))


def _chain(points: np.ndarray, order: np.ndarray) -> list[int]:
    """One side of Andrew's monotone chain."""
    chain: list[int] = []
    for index in order:
        while len(chain) >= 2:
            a, b, p = points[chain[-2]], points[chain[-1]], points[index]
            edge = b - a
            if edge[0] * (p[1] - a[1]) - edge[1] * (p[0] - a[0]) > COLLINEAR * float(np.hypot(edge[0], edge[1])):
                break
            chain.pop()
        chain.append(int(index))
    return chain


def _float(values: np.ndarray) -> np.ndarray:
    """A contiguous copy: numba would compile once more for a read-only array."""
    return np.array(values, dtype=np.float64, order="C")


def _checked(points: np.ndarray) -> np.ndarray:
    points = _float(points)
    if points.ndim != 2 or points.shape[1] != 2 or len(points) < 1:
        raise SupportError(f"corners have shape {points.shape}, need (n, 2) with n at least 1")
    if not np.isfinite(points).all():
        raise SupportError(f"corners must be finite, {int(np.sum(~np.isfinite(points)))} values are not")
    return points


def _check_rows(points: np.ndarray, corners: np.ndarray) -> None:
    if points.ndim != 2 or corners.ndim != 3 or len(points) != len(corners) or corners.shape[1] < 1:
        raise SupportError(f"points of shape {points.shape} need corners (n, m, 2) row by row, got {corners.shape}")


@njit(cache=True)
@no_type_check
def _signed_distance(px, py, corners, skipped):
    """Tries every ordered pair as an edge: with at most six corners that is cheaper than sorting them."""
    n = corners.shape[0]
    nearest, inside, solid, edges = np.inf, True, False, 0
    for i in range(n):
        if i == skipped:
            continue
        for j in range(n):
            if j in (i, skipped):
                continue
            ex, ey = corners[j, 0] - corners[i, 0], corners[j, 1] - corners[i, 1]
            length = np.sqrt(ex * ex + ey * ey)
            if length < 1e-9:
                continue
            ex, ey = ex / length, ey / length
            border, farthest = True, 0.0
            for k in range(n):
                if k in (skipped, i, j):
                    continue
                left = ex * (corners[k, 1] - corners[i, 1]) - ey * (corners[k, 0] - corners[i, 0])
                if left < -1e-9:
                    border = False
                    break
                farthest = max(farthest, left)
            if not border:
                continue
            edges += 1
            solid = solid or farthest > 1e-9
            dx, dy = px - corners[i, 0], py - corners[i, 1]
            left, along = ex * dy - ey * dx, ex * dx + ey * dy
            if left < 0.0:
                inside = False
            over = max(0.0, -along, along - length)
            nearest = min(nearest, np.sqrt(left * left + over * over))
    if edges == 0:
        for i in range(n):
            if i != skipped:
                nearest = min(nearest, np.sqrt((px - corners[i, 0]) ** 2 + (py - corners[i, 1]) ** 2))
    if inside and solid:
        return nearest
    return 0.0 - nearest


@njit(cache=True)
@no_type_check
def _conservative_distance(px, py, corners):
    least = np.inf
    if corners.shape[0] == 1:
        return -np.inf
    for removed in range(corners.shape[0]):
        least = min(least, _signed_distance(px, py, corners, removed))
    return least


@njit(cache=True)
@no_type_check
def _signed_distances(points, corners):
    out = np.empty(points.shape[0])
    for row in range(points.shape[0]):
        out[row] = _signed_distance(points[row, 0], points[row, 1], corners[row], -1)
    return out


@njit(cache=True)
@no_type_check
def _conservative_distances(points, corners):
    out = np.empty(points.shape[0])
    for row in range(points.shape[0]):
        out[row] = _conservative_distance(points[row, 0], points[row, 1], corners[row])
    return out
