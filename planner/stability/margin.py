"""How far a stance is from tipping over: support margins, conservative polygon, tip-over energies, stability rule.

Everything is in world, gravity along -z. Wheels are given by the points where they touch the ground, in any order.
The conservative support polygon (CPS) is the intersection of the support polygons with each supporting wheel removed in
turn ([SunSpiral2012] s3.3): inside it, any one wheel may fail. Tip-over energy is Hirose's (2001) normalised energy
stability margin: the height by which the centre of mass must rise to rotate over an edge.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from numba import njit

from athlete_twin.errors import SupportError
from athlete_twin.geometry.arrays import PerLegFlag, Points2, Points3, Vec3, Wheels
from athlete_twin.geometry.polygon import (
    conservative_distance,
    convex_hull,
    intersect_convex,
    signed_distance,
)

MARGINS = ("cps", "support", "energy")
"""what the rule with all wheels down measures: CPS margin, plain margin, or tip-over energy over the CPS"""


@dataclass(frozen=True, kw_only=True)
class StabilityVerdict:
    """What the stability rule says of one stance."""

    ok: bool
    reason: str
    """empty when ok; otherwise which margin, its value and its limit"""
    margin: float
    """plain support margin [m]"""
    cps_margin: float
    """margin to the conservative support polygon [m]"""
    energy: float
    """tip-over energy of the support polygon, per weight [m]"""
    cps_energy: float
    """tip-over energy with the worst wheel removed, per weight [m]"""


def support_margin(com_in_world: Vec3, wheels_in_world: Points3) -> float:
    """Distance, seen along gravity, from the CoM to the nearest support edge [m].

    Positive inside the support polygon, negative outside. Wheels on one line span no polygon: at most zero.
    """
    _check(com_in_world, wheels_in_world)
    return signed_distance(com_in_world[:2], wheels_in_world[:, :2])


def cps_margin(com_in_world: Vec3, wheels_in_world: Points3) -> float:
    """Distance, seen along gravity, from the CoM to the border of the conservative support polygon [m].

    The least of the margins with each wheel removed. With three wheels, or when the polygon is a point, at most zero.
    """
    _check(com_in_world, wheels_in_world)
    return conservative_distance(com_in_world[:2], wheels_in_world[:, :2])


def tip_over_energy(com_in_world: Vec3, wheels_in_world: Points3) -> float:
    """Height by which the CoM must rise to rotate over the easiest support edge [m]. Valid on slopes.

    Negative outside the support polygon: the height it has fallen from the top. Wheels on one line or in one place: at
    most zero.
    """
    _check(com_in_world, wheels_in_world)
    return float(_tip_over_energy(_float(com_in_world), _float(wheels_in_world), -1))


def cps_tip_over_energy(com_in_world: Vec3, wheels_in_world: Points3) -> float:
    """Tip-over energy with the worst wheel removed [m]: over every edge of every reduced polygon, the CPS's too."""
    _check(com_in_world, wheels_in_world)
    com, wheels = _float(com_in_world), _float(wheels_in_world)
    return float(min(_tip_over_energy(com, wheels, removed) for removed in range(len(wheels))))


def conservative_polygon(wheels_in_world: Points3) -> Points2:
    """Corners of the conservative support polygon in plan view, counter-clockwise; none when it is empty."""
    _check_count(wheels_in_world)
    plan = np.asarray(wheels_in_world[:, :2], dtype=float)
    corners: np.ndarray | None = None
    for removed in range(len(plan)):
        rest = np.delete(plan, removed, axis=0)
        hull = convex_hull(rest)
        if len(hull) < 3:
            return np.zeros((0, 2))
        corners = rest[hull] if corners is None else intersect_convex(corners, rest[hull])
        if len(corners) < 3:
            return np.zeros((0, 2))
    return np.zeros((0, 2)) if corners is None else corners


def stability_rule(
    com_in_world: Vec3,
    wheels_in_world: Wheels,
    *,
    supporting: PerLegFlag,
    min_margin: float,
    all_down_margin: str = "cps",
    min_energy: float = 0.0,
) -> StabilityVerdict:
    """Whether a stance keeps its margins.

    With all wheels down the chosen margin must be at least the minimum; while a leg swings the plain support margin of
    the remaining wheels must be at least `min_margin`. Then the CPS is reported and vetoes nothing: over five wheels of
    a regular stance it is zero at the centre.

    Args:
        com_in_world: believed centre of mass, the chassis sagged [m].
        wheels_in_world: contact points of all six wheels, shape (6, 3) [m].
        supporting: which wheels carry load, shape (6,).
        min_margin: for the plain margin, and for the CPS margin [m].
        all_down_margin: "cps", "support" or "energy"; with "energy" the CPS tip-over energy must reach `min_energy`.
        min_energy: only used by "energy" [m].
    """
    if all_down_margin not in MARGINS:
        raise SupportError(f"margin {all_down_margin!r} is not one of {', '.join(MARGINS)}")
    down = wheels_in_world[supporting]
    _check_count(down)
    plain, conservative = support_margin(com_in_world, down), cps_margin(com_in_world, down)
    energy, cps_energy = tip_over_energy(com_in_world, down), cps_tip_over_energy(com_in_world, down)
    checks = {
        "cps": ("CPS margin", conservative, min_margin),
        "support": ("support margin", plain, min_margin),
        "energy": ("CPS tip-over energy", cps_energy, min_energy),
    }
    name, value, limit = checks[all_down_margin] if bool(supporting.all()) else checks["support"]
    ok = value >= limit
    reason = "" if ok else f"{name} {value:.3f} m is below {limit:.3f} m on {len(down)} wheels"
    return StabilityVerdict(
        ok=ok, reason=reason, margin=plain, cps_margin=conservative, energy=energy, cps_energy=cps_energy
    )


def _check(com: np.ndarray, wheels: np.ndarray) -> None:
    """Refuses what has no margin: a place that is not a number compares as neither inside nor outside."""
    _check_count(wheels)
    if not (np.isfinite(com).all() and np.isfinite(wheels).all()):
        raise SupportError(f"centre of mass {com} and wheels must be finite, {int(np.sum(~np.isfinite(wheels)))} values of wheels are not")


def _check_count(wheels: np.ndarray) -> None:
    if len(wheels) < 3:
        raise SupportError(f"{len(wheels)} loaded wheels span no polygon, at least 3 do")


def _float(values: np.ndarray) -> np.ndarray:
    """A contiguous copy: numba would compile once more for a read-only array."""
    return np.array(values, dtype=np.float64, order="C")


@njit(cache=True)
@no_type_check
def _tip_over_energy(com, wheels, removed):
    """Least rise over all edges of the hull (plan view) of the wheels without the removed one."""
    n, least = wheels.shape[0], np.inf
    for i in range(n):
        for j in range(n):
            if i in (j, removed) or j == removed:
                continue
            ex, ey, ez = wheels[j, 0] - wheels[i, 0], wheels[j, 1] - wheels[i, 1], wheels[j, 2] - wheels[i, 2]
            plan, length = np.sqrt(ex * ex + ey * ey), np.sqrt(ex * ex + ey * ey + ez * ez)
            if plan < 1e-9:
                continue
            border = True
            for k in range(n):
                if k in (removed, i, j):
                    continue
                if (ex * (wheels[k, 1] - wheels[i, 1]) - ey * (wheels[k, 0] - wheels[i, 0])) / plan < -1e-9:
                    border = False
                    break
            if not border:
                continue
            # The CoM turns on a circle about the edge; its top lies in the vertical plane through the edge.
            dx, dy, dz = com[0] - wheels[i, 0], com[1] - wheels[i, 1], com[2] - wheels[i, 2]
            along = (dx * ex + dy * ey + dz * ez) / (length * length)
            rx, ry, rz = dx - along * ex, dy - along * ey, dz - along * ez
            rise = np.sqrt(rx * rx + ry * ry + rz * rz) * plan / length - rz
            inside = ex * dy - ey * dx >= 0.0
            least = min(least, rise if inside else -rise)
    if least == np.inf:  # no edge: all in one place, seen from above, and whatever the CoM does is a fall about it
        first = 1 if removed == 0 else 0
        dx, dy, dz = com[0] - wheels[first, 0], com[1] - wheels[first, 1], com[2] - wheels[first, 2]
        least = -(np.sqrt(dx * dx + dy * dy + dz * dz) - dz)
    return least
