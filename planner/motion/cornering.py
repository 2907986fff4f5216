"""By how much a leg may cut the corners of its path: what the executive drives is checked, not the polyline alone.

Place in the flow: swing -> cornering -> sequence. The executive passes way-points on parabolas, as `leg_timing` gives them to both
sides. They leave the polyline by a tolerance that the command states; it is the largest of a few at which all of them are free.
Lines were checked when they were found. At tolerance zero the leg stops at each corner and the path is the polyline itself.
"""

from __future__ import annotations

from collections.abc import Sequence

from athlete_twin.geometry.arrays import LegPath
from athlete_twin.geometry.blended_path import blended
from planner.motion.checker import IsFree

HALVINGS = 4
"""of the tolerance before it is zero: a sixteenth of a hundredth moves a wheel by 2 mm"""


def free_corner_tolerance(waypoints: LegPath, edges_free: Sequence[IsFree], *, most: float, spacing: float) -> float:
    """The largest tolerance, `most` or a half of it and so on, at which no blend collides; zero where there is none [rad].

    Args:
        waypoints: shape (k, dof) [rad].
        edges_free: of each of the k - 1 edges, what a configuration must pass there; half a blend belongs to each.
        most: to begin with [rad].
        spacing: of the configurations checked [rad].
    """
    for halving in range(HALVINGS + 1):
        tolerance = most * 0.5**halving
        if tolerance > 0.0 and _is_free(waypoints, edges_free, tolerance, spacing):
            return tolerance
    return 0.0


def _is_free(waypoints: LegPath, edges_free: Sequence[IsFree], tolerance: float, spacing: float) -> bool:
    for corner, points in blended(waypoints, tolerance).blends(spacing):
        half = len(points) // 2
        # The middle is nearest to the corner, where both edges meet: it need pass but one of the two.
        if not all(edges_free[corner - 1](q) for q in points[:half]) or not all(edges_free[corner](q) for q in points[half + 1 :]):
            return False
        if not (edges_free[corner - 1](points[half]) or edges_free[corner](points[half])):
            return False
    return True
