"""The most even loads that balance allows, and how far the wheels must be pushed or drawn for them.

With more than three wheels on the ground, weight and centre of mass fix only three sums of the loads: force and two
moments. The rest are internal loads. On springs they follow from the feet's heights, since load is compression times
constant, so that small vertical offsets of the wheels set them. Most even means the least sum of squares: the least
peak would put all it can on the wheels beside the lifted one and leave the opposite one bare (a regular hexagon: 1/4,
1/4, 0 instead of 5/18, 1/6, 1/9 of the weight). On even springs and level ground this is what the springs do by
themselves, for their energy is the same sum; offsets mend uneven tyres and wheels that stand too high or too low.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq, nnls

from athlete_twin.geometry.arrays import Points2, Vec2

SMALL_OFFSETS = 1e-4
"""weight of the offsets beside the loads, both in units of one wheel's share: of equally even ways the smallest is taken"""
SLACK = 1e-9
"""by which a bound may be missed, in the same units"""


@dataclass(frozen=True, eq=False, kw_only=True)
class Spread:
    """Loads of n standing wheels and what makes them."""

    loads: np.ndarray
    """vertical, shape (n,) [N]"""
    offsets: np.ndarray
    """of the wheels along up, shape (n,) [m]"""


def spread_loads(
    places: Points2,
    loads: np.ndarray,
    *,
    compressions: np.ndarray,
    stiffness: np.ndarray,
    offsets: np.ndarray,
    max_offset: float,
    min_load: float,
) -> Spread | None:
    """The least sum of squared loads that balances as the present loads do; None where the bounds allow none at all.

    The chassis is free to follow: whatever the offsets do to it as a plane is mended by its pose. Exact for vertical
    springs, [SunSpiral2012] eq. 12 with n wheels.

    Args:
        places: of the wheels seen from above, shape (n, 2) [m].
        loads: at present, shape (n,) [N].
        compressions: of the springs at present, shape (n,), negative for a wheel over its ground [m].
        stiffness: spring constants, shape (n,) [N/m].
        offsets: present ones, shape (n,) [m].
        max_offset: either way [m].
        min_load: of every wheel [N].
    """
    n = len(places)
    balance = np.column_stack([np.ones(n), places - places.mean(axis=0)]).T
    u, s, vt = np.linalg.svd(balance)
    even = vt[:3].T @ ((u.T @ (balance @ loads)) / s)
    free = vt[3:].T
    if n == 3:
        bare = even < min_load
        return None if bare.any() else Spread(loads=even, offsets=np.zeros(3))
    # Loads are even + free z, compressions plane - (ground + offsets): eliminating the plane leaves z by the offsets.
    ground = -(compressions + offsets)
    share, unit = float(even.mean()), float(even.mean() / stiffness.mean())
    pull = np.linalg.solve(free.T @ (free / stiffness[:, None]), free.T)
    z_at_zero = -pull @ (ground + even / stiffness)
    matrix = np.vstack([-pull * unit / share, SMALL_OFFSETS * np.eye(n)])
    wanted = np.append(-z_at_zero / share, np.zeros(n))
    by_offset = -free @ pull * unit / share
    bounds = np.vstack([by_offset, np.eye(n), -np.eye(n)])
    least = np.concatenate([(min_load - even - free @ z_at_zero) / share, np.full(2 * n, -max_offset / unit)])
    x = bounded_least_squares(matrix, wanted, bounds, least)
    if x is None:
        return None
    wheel_offsets = np.clip(x * unit, -max_offset, max_offset)
    return Spread(loads=even + free @ (z_at_zero - pull @ wheel_offsets), offsets=wheel_offsets)


def bounded_least_squares(
    matrix: np.ndarray, wanted: np.ndarray, bounds: np.ndarray, least: np.ndarray
) -> np.ndarray | None:
    """The x that minimises |matrix x - wanted| under bounds x >= least; None where no x is within the bounds.

    Lawson and Hanson (1974), ch. 23: as a least distance in rotated coordinates, which is one non-negative problem.

    Args:
        matrix: of full column rank, shape (m, n).
        wanted: shape (m,).
        bounds: shape (k, n).
        least: shape (k,).
    """
    q, r = np.linalg.qr(matrix)
    turned = q.T @ wanted
    x = np.linalg.solve(r, turned)
    if (bounds @ x >= least - SLACK).all():
        return np.asarray(x)
    rows = np.linalg.solve(r.T, bounds.T).T
    short = least - rows @ turned
    size = np.maximum(np.linalg.norm(rows, axis=1), 1e-300)
    rows, short = rows / size[:, None], short / size
    reach = float(np.abs(short).max())
    stacked = np.vstack([rows.T, short / reach])
    target = np.append(np.zeros(len(turned)), 1.0)
    multipliers, _ = nnls(stacked, target)
    left = stacked @ multipliers - target
    if abs(left[-1]) < 1e-12:
        return None
    x = np.linalg.solve(r, turned - reach * left[:-1] / left[-1])
    return np.asarray(x) if (bounds @ x >= least - 1e-6).all() else None


def shift_towards_even(com: Vec2, places: Points2, com_by_shift: np.ndarray, radius: float) -> Vec2:
    """Shift of the chassis within a radius after which balance asks for the least sum of squared loads [m].

    The loads that balance are even where the CoM is over the mean of the wheels, and their squares grow with its
    distance from there by the wheels' inverse second moments.

    Args:
        com: now, seen from above [m].
        places: of the standing wheels, shape (n, 2) [m].
        com_by_shift: movement of the CoM by the shift of the chassis, shape (2, 2): much less than one where legs are heavy.
        radius: of the shift [m].
    """
    if radius == 0.0:
        return np.zeros(2)
    centre = places.mean(axis=0)
    spread = (places - centre).T @ (places - centre)
    weighted = np.linalg.solve(spread, com_by_shift)
    matrix, wanted = com_by_shift.T @ weighted, weighted.T @ (centre - com)
    shift = np.linalg.solve(matrix, wanted)
    if np.linalg.norm(shift) <= radius:
        return np.asarray(shift)
    values, vectors = np.linalg.eigh(matrix)
    along = vectors.T @ wanted

    def excess(damping: float) -> float:
        return float(np.linalg.norm(along / (values + damping))) - radius

    damping = brentq(excess, 0.0, float(np.linalg.norm(along)) / radius, xtol=1e-16, rtol=1e-14)
    return np.asarray(vectors @ (along / (values + damping)))
