"""Whose turn it is: which legs a gait asks in which order, and what is tried with each before the next.

Place in the flow: belief, the guide's ways and who has stepped -> the tries that `agent` hands to the step search one by one. A
gait with cycles counts steps, and of the legs with fewest goes by the reverse wave; single steps go by how far a wheel lags.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np

from athlete_twin.geometry.arrays import PerLeg, Vec2, Vec3
from athlete_twin.model.spec import LEGS, RobotSpec
from planner.belief import Belief
from planner.gait.single_steps import by_lag, lags
from planner.gait.skeleton import GaitConfig, opposite, reverse_wave
from planner.gait.step_search import Ground, on_path
from planner.route.guide import Way


@dataclass(frozen=True, eq=False, kw_only=True)
class Try:
    """One search for a step."""

    way: Way
    leg: int
    """index 0 to 5"""
    cautious: bool
    """whether to keep clear of ground that nobody saw"""
    wide: bool
    """whether to look farther from the gait's place"""
    due: bool
    """whether it is the leg's turn and the way the first"""


@dataclass(frozen=True, eq=False, kw_only=True)
class Turns:
    """What decides the order of legs, as it is for one plan."""

    spec: RobotSpec
    gait: GaitConfig
    goal: Vec2
    """in world [m]"""
    stepped: Counter[int]
    """how often each leg has stepped"""
    swayed: Vec3 | None
    """by which the chassis is off its straight path, in world [m]; None without sway"""
    forced_leg: int | None
    """index of the leg that goes before all others: the operator's, or one that met a fault"""

    def tries(self, belief: Belief, ways: list[Way], in_air: np.ndarray, ground: Ground) -> list[Try]:
        """What to try in turn.

        On the first way, of the legs whose turn it is all are tried with caution, then farther from the gait's place, then both
        without caution, and only then others. Aside from it the legs whose turn it is are tried, near the gait's place.
        """
        first, aside = ways[0], ways[1:]
        return [
            *(
                Try(way=first, leg=leg, cautious=cautious, wide=wide, due=n == 0)
                for n, group in enumerate(self.order(belief, first.heading, in_air))
                for cautious in cautions(ground)
                for wide in (False, True)
                for leg in group
            ),
            *(
                Try(way=way, leg=leg, cautious=cautious, wide=False, due=False)
                for way in aside
                for cautious in cautions(ground)
                for leg in self.order(belief, way.heading, in_air)[0]
            ),
        ]

    def pairs(self, belief: Belief, heading: Vec2, in_air: np.ndarray) -> list[tuple[int, int]]:
        """Opposite legs whose turn it is, of a gait that has such steps and while nothing else comes first."""
        if self.gait.method != "opposite_pairs" or len(in_air) or self.forced_leg is not None:
            return []
        due = self.order(belief, heading, in_air)[0]
        return [(leg, opposite(self.spec, leg)) for n, leg in enumerate(due) if opposite(self.spec, leg) in due[n + 1 :]]

    def order(self, belief: Belief, heading: Vec2, in_air: np.ndarray) -> list[list[int]]:
        """Legs whose turn it is, then those that may go when none of these can."""
        # A leg in the air must come down before any other moves.
        if len(in_air):
            return [[int(in_air[0])]]
        if self.forced_leg is not None:
            return [[self.forced_leg], [leg for leg in range(LEGS) if leg != self.forced_leg]]
        if self.gait.method == "single_steps":
            lag, order = self._by_lag(belief, heading)
            behind = [leg for leg in order if lag[leg] >= self.gait.min_step]
            # A wheel that is where it would step goes farther only when no other can.
            return [behind, [leg for leg in order if leg not in behind]]
        heading_in_hex = (belief.world_from_hex.rotation.T @ np.append(heading, 0.0))[:2]
        wave = reverse_wave(self.spec, heading_in_hex / np.linalg.norm(heading_in_hex))
        fewest = min(self.stepped[leg] for leg in range(LEGS))
        due = [leg for leg in wave if self.stepped[leg] == fewest]
        # A leg ahead of its turn may step once, to let the chassis go on; twice would only run away from the others.
        return [due, [leg for leg in wave if self.stepped[leg] == fewest + 1]]

    def upcoming(self, belief: Belief, heading: Vec2, legs: tuple[int, ...]) -> list[int]:
        """All legs in the order in which their turns come, once `legs` have stepped."""
        if self.gait.method == "single_steps":
            return sorted(self._by_lag(belief, heading)[1], key=lambda other: other in legs)
        later = Counter(self.stepped) + Counter(legs)
        wave = reverse_wave(self.spec, (belief.world_from_hex.rotation.T @ np.append(heading, 0.0))[:2])
        return sorted(wave, key=lambda other: later[other])

    def _by_lag(self, belief: Belief, heading: Vec2) -> tuple[PerLeg, list[int]]:
        """How far each wheel is behind [m], and the legs in the order of that: what single steps go by."""
        chassis = on_path(belief, self.swayed)
        lag = lags(
            self.spec, self.gait, world_from_hex=chassis, contacts_in_world=belief.contacts_in_world, heading=heading,
            remaining=float(np.linalg.norm(self.goal - chassis.translation[:2])),
        )  # fmt: skip
        heading_in_hex = (belief.world_from_hex.rotation.T @ np.append(heading, 0.0))[:2]
        return lag, by_lag(self.spec, lag, heading_in_hex / np.linalg.norm(heading_in_hex))


def cautions(ground: Ground) -> tuple[bool, ...]:
    """With caution first, then without, where that makes a difference."""
    return (True, False) if ground.cautious is not ground.filled else (False,)
