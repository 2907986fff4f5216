"""What a cycle of the regular gait strikes: itself, or the even ground that it walks on.

Place in the flow: the limits of `limits` and `slope_stance` ask for reach, balance and torque; a stance that folds its legs or
goes low on a slope is looked at here too, by the same shapes and clearances as every other motion (`motion.collision`).
"""

from __future__ import annotations

import numpy as np

from athlete_twin.errors import PlanningError
from athlete_twin.geometry.arrays import Vec3
from athlete_twin.geometry.grid import HeightGrid
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.reach import all_legs_ik
from planner.gait.cycle import GaitCycle
from planner.motion.collision import BodyCollision, CollisionConfig

EXTENT, CELL = 8.0, 1.0
"""half the width of the ground looked at, and its cells: a plane needs no more [m]"""


def plane_grid(normal: Vec3) -> HeightGrid:
    """The plane through the origin with a normal, as heights."""
    if not normal[2] > 0.0:
        raise PlanningError(f"normal {normal} points down, the ground lies below the chassis")
    x = np.arange(-EXTENT, EXTENT + 0.5 * CELL, CELL)
    return HeightGrid(
        origin_x=-EXTENT, origin_y=-EXTENT, cell=CELL, heights=-(normal[0] * x[:, None] + normal[1] * x[None, :]) / normal[2]
    )


def first_strike(cycle: GaitCycle, body: BodyCollision, displacements: np.ndarray | None = None) -> str | None:
    """Names of two parts that come too close at a judged moment of a cycle that reaches, such as "hex against terrain".

    Args:
        cycle: what is walked.
        body: the robot over `plane_grid` of the cycle's footing, see `ground_of`.
        displacements: of the chassis in each phase, shape (k, 3) [m].
    """
    places = cycle.chassis if displacements is None else cycle.chassis + displacements
    for k in range(cycle.phases):
        for axles in (*cycle.swing_axles(k), cycle.goal[k]):
            joints, reaches = all_legs_ik(cycle.spec, axles - places[k], last_link_in_hex=-cycle.footing.up)
            if not reaches.all():
                return f"leg {int(np.argmin(reaches)) + 1} does not reach"
            hit = body.first_collision(joints, SE3.from_translation(places[k]))
            if hit is not None:
                return hit
    return None


def ground_of(cycle: GaitCycle, config: CollisionConfig | None = None) -> BodyCollision:
    """The robot over the even ground of a cycle."""
    return BodyCollision(cycle.spec, plane_grid(cycle.footing.normal), CollisionConfig() if config is None else config)
