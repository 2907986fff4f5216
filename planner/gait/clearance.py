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
from athlete_twin.model.reach import all_legs_ik, leg_ik
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


def reaches_with_spare(cycle: GaitCycle, spare: float) -> bool:
    """Whether all legs would reach at every judged moment if each wheel were off by `spare` [m], inward, outward, up or down.

    A real robot sags, its encoders are off and its steps end where the ground is; a stance at the edge of its reach does not
    survive that.
    """
    for k in range(cycle.phases):
        axles = np.concatenate([cycle.swing_axles(k), cycle.start[k][None], cycle.goal[k][None]]) - cycle.chassis[k]
        after = cycle.goal[k][None] - (cycle.chassis[k + 1] if k + 1 < cycle.phases else cycle.chassis[0] + cycle.advance)
        moments = np.concatenate([axles, after])
        for leg, hip in enumerate(cycle.spec.hips_in_hex):
            away = moments[:, leg] - hip
            outward = away * [1.0, 1.0, 0.0] / np.maximum(np.linalg.norm(away[:, :2], axis=1), 1e-9)[:, None]
            for off in (outward, -outward, np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, -1.0])):
                _, reaches = leg_ik(cycle.spec, leg, moments[:, leg] + spare * off, last_link_in_hex=-cycle.footing.up)
                if not reaches.all():
                    return False
    return True


def ground_of(cycle: GaitCycle, config: CollisionConfig | None = None) -> BodyCollision:
    """The robot over the even ground of a cycle."""
    return BodyCollision(cycle.spec, plane_grid(cycle.footing.normal), CollisionConfig() if config is None else config)
