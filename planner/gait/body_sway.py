"""Sway on actual footfalls: where the chassis should stand for the next swing so that the joints keep the most margin to saturation.

Place in the flow: `gait.shift` plans where the chassis goes on its straight path after a step; this says how far beside it, and above or
below. [SunSpiral2012] s5.3.2: the chassis is displaced in three dimensions, the footfalls stay, loads by zero interaction. `gait.sway`
does it for whole regular cycles; here the wheels stand where they stand, and only the swing that comes next is known: it lifts, goes
over to the gait's place for it, and comes down. The torques of that, and of standing before and after it, are what counts.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from athlete_twin.errors import ConfigError
from athlete_twin.geometry.arrays import Vec3, Wheels
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.spec import LEGS, RobotSpec
from planner.gait.sway import least_on_grid
from planner.stability.rigid_stance import Footing, rigid_stances

UP = np.array([0.0, 0.0, 1.0])
EASED = (0.0, 0.25, 0.5, 0.75, 1.0)
"""of the way from the present displacement to the best one"""


@dataclass(frozen=True, kw_only=True)
class BodySwayConfig:
    """How far to sway, how finely to search, and when it is worth it."""

    span: float = 0.10
    """largest displacement sideways, along and upwards, over the chassis height"""
    down: float = 0.03
    """downwards, over the chassis height: rocks lie below"""
    lift: float = 1.0
    """of the swinging wheel above its old and its new place, over its radius"""
    points: int = 5
    """of the grid along each axis; odd"""
    shrink: float = 0.55
    """of the grid from round to round"""
    resolution: float = 0.01
    """of the search [m]"""
    slack: float = 0.01
    """fraction of the limits that may be given away for a shorter way"""

    def __post_init__(self) -> None:
        if not (0.0 < self.span <= 0.5 and 0.0 <= self.down <= 0.5 and self.lift >= 0.0):
            raise ConfigError(f"span {self.span}, down {self.down} and lift {self.lift} must be within 0 to 0.5, 0 to 0.5, from 0")
        if self.points < 3 or self.points % 2 == 0:
            raise ConfigError(f"points is {self.points}, need an odd number from 3")
        if not (0.0 < self.shrink < 1.0 and self.resolution > 0.0 and self.slack >= 0.0):
            raise ConfigError(f"shrink {self.shrink} must be within 0 to 1, resolution positive, slack not negative")


@dataclass(frozen=True, eq=False, kw_only=True)
class NextSwing:
    """The swing that comes next, as far as it is known."""

    axles_in_world: Wheels
    """before it, shape (6, 3) [m]"""
    leg: int
    """index 0 to 5"""
    goal_in_world: Vec3
    """where its axle will stand [m]"""


def swing_fractions(
    spec: RobotSpec, path: SE3, displacements: np.ndarray, swing: NextSwing, *, lift: float, min_margin: float, payload_kg: float
) -> np.ndarray:
    """Largest torque fraction over a swing and the stances before and after it, shape (n,).

    Infinite where a leg does not reach, the ground would have to pull, or the stability rule is broken.

    Args:
        spec: the drawings.
        path: the chassis, not displaced.
        displacements: in world, shape (n, 3) [m].
        swing: what is judged.
        lift: of the wheel in the air [m].
        min_margin: of the stability rule [m].
        payload_kg: on the deck [kg].
    """
    before, after = swing.axles_in_world, swing.axles_in_world.copy()
    after[swing.leg] = swing.goal_in_world
    top = lift + max(before[swing.leg, 2], after[swing.leg, 2])
    over = []
    for share in (0.0, 0.5, 1.0):
        at = before.copy()
        at[swing.leg] = before[swing.leg] + share * (after[swing.leg] - before[swing.leg])
        at[swing.leg, 2] = top
        over.append(at)
    up = path.rotation[2] / np.linalg.norm(path.rotation[2])
    footing = Footing(normal=up, up=up)
    legs = np.arange(LEGS)
    worst = np.zeros(len(displacements))
    for axles, standing in ((np.array(over), legs != swing.leg), (np.array([before, after]), legs >= 0)):
        in_hex = (axles[None] - (path.translation + displacements)[:, None, None]) @ path.rotation
        stances = rigid_stances(spec, in_hex.reshape(-1, LEGS, 3), standing=standing, footing=footing, payload_kg=payload_kg)
        margin = stances.cps_margin if standing.all() else stances.margin
        fraction = np.where(margin >= min_margin, stances.peak, np.inf)
        worst = np.maximum(worst, fraction.reshape(len(displacements), -1).max(axis=1))
    return worst


def best_sway(
    spec: RobotSpec, path: SE3, swing: NextSwing, *, present: Vec3, config: BodySwayConfig, min_margin: float, payload_kg: float
) -> Vec3:
    """Displacement of the chassis from its path with the least torque fraction, in world [m]; zero where none is allowed.

    Args:
        spec: the drawings.
        path: the chassis after the shift, not displaced.
        swing: that comes next.
        present: displacement before the shift: what is as good, nearly, and nearer to it is taken [m].
        config: of the search.
        min_margin: of the stability rule [m].
        payload_kg: on the deck [kg].
    """
    span, height = config.span * spec.chassis_height, spec.chassis_height

    def judge(displacements: np.ndarray) -> np.ndarray:
        return swing_fractions(
            spec, path, displacements, swing, lift=config.lift * spec.wheel.radius, min_margin=min_margin, payload_kg=payload_kg
        )

    high = np.full(3, span)
    low = np.array([-span, -span, -config.down * height])
    best, least = least_on_grid(
        judge, low=low, high=high, points=config.points, shrink=config.shrink, resolution=config.resolution
    )
    if not np.isfinite(least):
        return np.zeros(3)
    eased = np.array([present + share * (best - present) for share in EASED])
    good = (judge(eased) <= least + config.slack) & ((eased >= low - 1e-9) & (eased <= high + 1e-9)).all(axis=1)
    return np.asarray(eased[int(np.argmax(good))] if good.any() else best)
