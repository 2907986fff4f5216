"""Single steps: no gait cycle, each step is chosen by itself from the pose the robot has now.

[SunSpiral2012] s3.1: in 2008 FootFall "planned commands for single steps"; the operator picked the leg, then a place for it
among those that were stable, reachable and seen. Gaits that order the legs came later (s5.3.1). What the operator of then went
by is not told. Here it is what s5.3.1 asks of all footfalls, most forward progress: the leg goes first whose wheel is farthest
behind where it would step on open ground. No order is kept, and nobody counts who has stepped: a leg that finds no step is
passed over, and the next one asked.

Every step takes a wheel onward by `min_step` at least and never farther than the search radius beyond its place, so wheels that
the chassis does not follow run out of steps: the robot goes on or says why not.
"""

from __future__ import annotations

import numpy as np

from athlete_twin.geometry.arrays import PerLeg, Vec2, Wheels
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.spec import LEGS, RobotSpec
from planner.gait.skeleton import GaitConfig, nominal_footfall, reverse_wave

SAME_LAG = 1e-3
"""wheels whose lags differ by less are level: the reverse wave decides between them [m]"""


def lags(
    spec: RobotSpec, config: GaitConfig, *, world_from_hex: SE3, contacts_in_world: Wheels, heading: Vec2, remaining: float
) -> PerLeg:
    """How far each wheel is behind where it would step on open ground, along the heading, shape (6,) [m].

    Args:
        spec: the drawings.
        config: of the gait.
        world_from_hex: believed chassis.
        contacts_in_world: of the wheels [m].
        heading: direction of travel in world, of length 1.
        remaining: distance of the chassis from its goal [m].
    """
    return np.array([
        (
            nominal_footfall(spec, config, leg=leg, world_from_hex=world_from_hex, heading=heading, remaining=remaining)
            - contacts_in_world[leg, :2]
        ) @ heading
        for leg in range(LEGS)
    ])  # fmt: skip


def by_lag(spec: RobotSpec, lag: PerLeg, heading_in_hex: Vec2) -> list[int]:
    """All legs, the one farthest behind first; of level ones as in the reverse wave."""
    wave = reverse_wave(spec, heading_in_hex)
    return sorted(wave, key=lambda leg: -round(float(lag[leg]) / SAME_LAG))
