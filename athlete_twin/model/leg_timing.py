"""How a leg goes through way-points in the air, and how long it takes: the same on the robot and on the ground.

The executive follows this motion; the planner checks its path for collisions and says its duration before it is sent.
"""

from __future__ import annotations

from jaxtyping import Float
from numpy import ndarray

from athlete_twin.geometry.blended_path import blended
from athlete_twin.geometry.time_optimal import TimedPath, time_optimal
from athlete_twin.model.spec import RobotSpec


def leg_timing(
    spec: RobotSpec, waypoints: Float[ndarray, "k dof"], *, corner_tolerance: float, speed_scale: float = 1.0
) -> TimedPath:
    """The motion of one leg in the air through way-points, from rest to rest; its `duration` [s].

    Args:
        spec: the drawings.
        waypoints: from where the leg is, shape (k, dof), k >= 1 [rad].
        corner_tolerance: by which corners may be cut; zero stops at each [rad].
        speed_scale: of the unloaded speed. Accelerations go with its square: the same motion, only slower.
    """
    return time_optimal(
        blended(waypoints, corner_tolerance),
        speed=spec.speed_unloaded * speed_scale,
        acceleration=spec.acceleration_unloaded * speed_scale**2,
    )
