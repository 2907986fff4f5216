"""Which way the gait goes: along the route, and where no leg finds a step that way, aside from it for a cycle.

`Belief`, `Ground` -> headings to try, the route's first. "straight" heads for the goal itself, as if there were no map.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np

from athlete_twin.errors import ConfigError, PlanningError
from athlete_twin.geometry.arrays import Vec2
from athlete_twin.model.spec import LEGS, RobotSpec
from planner.belief import Belief
from planner.gait.step_search import Ground
from planner.route.places import RouteConfig, places
from planner.route.search import NoRoute, Route, find_route

METHODS = ("straight", "map")


@dataclass(frozen=True, kw_only=True)
class HeadingConfig:
    """Which headings are tried where the route's gives no step."""

    aside_deg: tuple[float, ...] = (20.0, 40.0, 60.0)
    """to both sides, nearest first; none tries no other [deg]"""
    steps_aside: int = LEGS
    """a heading that gave a step is kept for so many"""

    def __post_init__(self) -> None:
        angles = np.asarray(self.aside_deg, dtype=float)
        if not (np.isfinite(angles).all() and (angles > 0.0).all() and (angles <= 180.0).all()):
            raise ConfigError(f"aside_deg is {self.aside_deg}, need angles above 0 and at most 180, or none")
        if len(angles) > 6:
            raise ConfigError(f"aside_deg has {len(angles)} angles, at most 6: each costs up to a dozen searches a side")
        if self.steps_aside < 1:
            raise ConfigError(f"steps_aside is {self.steps_aside}, must be at least 1")


@dataclass(frozen=True, kw_only=True)
class Way:
    """One heading for the gait."""

    heading: Vec2
    """unit vector in world"""
    aside: float
    """from the route, to the left [rad]"""
    remaining: float
    """of the way to the goal [m]"""


class Guide:
    """The route as it is now, and the turn aside that the last step took."""

    def __init__(
        self, spec: RobotSpec, goal: Vec2, *, method: str, driving: bool, config: RouteConfig, headings: HeadingConfig,
        typical_terrain: float,
    ) -> None:  # fmt: skip
        if method not in METHODS:
            raise ConfigError(f"route {method!r} is not one of {', '.join(METHODS)}")
        self._spec, self._goal, self._method, self._driving = spec, goal, method, driving
        self._config, self._headings, self._typical = config, headings, typical_terrain
        self._aside, self._steps_left = 0.0, 0
        self.heading: Vec2 | None = None
        """of the step found last"""
        self.route: Route | NoRoute | None = None
        """latest; None before the first, and when the way is straight"""

    def ways(self, belief: Belief, ground: Ground) -> list[Way]:
        """Headings to try, the best first."""
        self.route, heading, remaining = self._straight_on(belief, ground)
        offset = self._goal - belief.world_from_hex.translation[:2]
        aside = [s * np.deg2rad(a) for a in self._headings.aside_deg for s in (1.0, -1.0)]
        # Towards the goal's side first, where the route leaves it to the headings.
        if float(heading @ np.array([-offset[1], offset[0]])) > 0.0:
            aside = [-a for a in aside]
        kept = self._aside if self._steps_left > 0 else 0.0
        angles = [kept, *([0.0] if kept else []), *(a for a in aside if a != kept)]
        return [Way(heading=turned(heading, a), aside=a, remaining=remaining) for a in angles]

    def way_from(self, belief: Belief, ground: Ground, aside: float) -> Way:
        """The heading so far aside from the route from where the robot might stand; `route` stays what it is."""
        _, heading, remaining = self._straight_on(belief, ground)
        return Way(heading=turned(heading, aside), aside=aside, remaining=remaining)

    def took(self, way: Way) -> None:
        """A step was found that way: one aside from the route is kept for a while."""
        self.heading = way.heading
        if way.aside == 0.0:
            self._steps_left = 0
        elif self._steps_left > 0 and way.aside == self._aside:
            self._steps_left -= 1
        else:
            self._aside, self._steps_left = way.aside, self._headings.steps_aside - 1

    def _straight_on(self, belief: Belief, ground: Ground) -> tuple[Route | NoRoute | None, Vec2, float]:
        """The route, the heading along it, and what remains of it [m]."""
        offset = self._goal - belief.world_from_hex.translation[:2]
        distance = float(np.linalg.norm(offset))
        # At the goal itself, with a leg still to come down, any way is as good.
        heading = unit(offset) if distance > 1e-9 else belief.world_from_hex.rotation[:2, 0].copy()
        route = self._routed(belief, ground) if self._method == "map" and distance > 1e-9 else None
        if isinstance(route, Route):
            return route, route.heading(self._config.look_ahead), max(distance, route.length)
        return route, heading, distance

    def _routed(self, belief: Belief, ground: Ground) -> Route | NoRoute:
        here = belief.world_from_hex.translation[:2]
        try:
            grid = places(
                self._spec, ground.heights, ground.filled, ground.footfalls, belief.world_from_hex, goal=self._goal,
                config=self._config, typical_terrain=self._typical, driving=self._driving,
            )  # fmt: skip
            return find_route(grid, here, self._goal)
        except PlanningError as e:
            return NoRoute(reason=str(e))


def unit(way: Vec2) -> Vec2:
    """A direction of length one."""
    length = float(np.linalg.norm(way))
    if not (np.isfinite(length) and length > 0.0):
        raise PlanningError(f"the direction {way} has no length: a goal elsewhere would do")
    return np.asarray(way / length)


def turned(heading: Vec2, angle: float) -> Vec2:
    """A heading turned to the left by an angle [rad]."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([c * heading[0] - s * heading[1], s * heading[0] + c * heading[1]])


def refusals(found: list[tuple[Way, str, Counter[str]]]) -> tuple[str, Counter[str]]:
    """One line that says what refused each heading, once where it is the same, and the sum of candidates that each check refused."""
    total: Counter[str] = Counter()
    lines: dict[float, dict[str, None]] = {}
    for way, reason, refused in found:
        lines.setdefault(round(np.rad2deg(way.aside)), {})[reason] = None
        total.update(refused)
    if len({frozenset(reasons) for reasons in lines.values()}) == 1:
        on = f" (the same on {len(lines)} headings)" if len(lines) > 1 else ""
        return "; ".join(next(iter(lines.values()))) + on, total
    return " | ".join(f"{angle:+.0f} deg: " + "; ".join(reasons) for angle, reasons in lines.items()), total
