"""How much higher the ground beside the wheels is seen than the wheels' contacts are believed.

The world's zero is the ground under the first six wheels. The axles' height over it follows from the tyres' belief, which
knows neither what the tyres give way beyond it nor how deep they stand in the soil: two centimetres on both robots, for
the whole trial. The first pictures see that ground: a plane through the cells round each wheel, read off at the axle,
lies above the believed contact by what the wheel stands deeper. Swells and rocks cancel over six wheels, and the
median leaves out a wheel beside a rock.
"""

from __future__ import annotations

import numpy as np

from athlete_twin.geometry.arrays import Points3
from planner.terrain.fusion import FusedTerrain

RING = (0.20, 0.60)
"""cells so far from a contact are read: nearer ones are the wheel's own, farther ones another ground [m]"""
LEAST_CELLS = 40
"""known, round one wheel: a quarter of the ring"""
LEAST_WHEELS = 3
SIGMA = 0.011
"""of the median over six wheels: the cameras' mountings; scatter over walks of seeds 100 to 102 of both robots [m]"""
CREDIBLE = 0.08
"""more than a tyre gives way and sinks in before the robot is stuck: the pictures are wrong [m]"""


def ground_over_contacts(terrain: FusedTerrain, contacts_in_world: Points3) -> float | None:
    """Median over the wheels of seen ground less believed contact [m]; None where too little is seen, or nothing credible.

    Args:
        terrain: made of pictures alone: cells set by touch would say what the contacts say.
        contacts_in_world: of standing wheels, shape (n, 3) [m].
    """
    x, y = terrain.grid.centres()
    heights = terrain.grid.heights
    over = []
    for contact in contacts_in_world:
        ix = np.flatnonzero(np.abs(x - contact[0]) <= RING[1])
        iy = np.flatnonzero(np.abs(y - contact[1]) <= RING[1])
        dx, dy = np.meshgrid(x[ix] - contact[0], y[iy] - contact[1], indexing="ij")
        z, distance = heights[np.ix_(ix, iy)], np.hypot(dx, dy)
        use = np.isfinite(z) & (distance >= RING[0]) & (distance <= RING[1])
        if use.sum() >= LEAST_CELLS:
            over.append(_level_at_middle(dx[use], dy[use], z[use]) - contact[2])
    if len(over) < LEAST_WHEELS:
        return None
    middle = float(np.median(over))
    return middle if abs(middle) <= CREDIBLE else None


def _level_at_middle(dx: np.ndarray, dy: np.ndarray, z: np.ndarray) -> float:
    """Height at the middle of a plane through cells, rocks left out by weight (L1 by reweighted least squares)."""
    design = np.column_stack([np.ones(len(z)), dx, dy])
    weight = np.ones(len(z))
    fit = np.zeros(3)
    for _ in range(10):
        root = np.sqrt(weight)
        fit = np.linalg.lstsq(design * root[:, None], z * root, rcond=None)[0]
        weight = 1.0 / np.maximum(np.abs(z - design @ fit), 0.005)
    return float(fit[0])
