"""Walks a robot and keeps, of every motion, what the preview said before it and what truly happened."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from athlete_twin.geometry.se3 import SE3
from athlete_twin.link import DelayedLink, downlink, uplink
from athlete_twin.messages import encode
from athlete_twin.model.spec import load_spec
from athlete_twin.robot import SimulatedRobot, TruthView
from athlete_twin.world.scenario import load_scenario
from envs.build import ground_agent, mock, twin
from envs.mission import Mission
from planner.agent import GroundAgent
from planner.belief import Belief
from planner.decisions import Decision, Proposal
from planner.preview.preview import Preview


@dataclass(frozen=True, eq=False, kw_only=True)
class Foreseen:
    """A motion: what was believed and proposed, the preview, and the truth while it was carried out."""

    belief: Belief
    proposal: Proposal
    preview: Preview
    seconds: float
    """that the preview took, by the wall clock [s]"""
    world_from_hex: SE3
    """the true chassis at its begin"""
    wheels_at_first: np.ndarray
    """true axles at its begin, shape (6, 3) [m]"""
    times: list[float] = field(default_factory=list)
    """after it has begun on board [s]"""
    wheels: list[np.ndarray] = field(default_factory=list)
    """true axles then, shape (6, 3) [m]"""
    faults: list[str] = field(default_factory=list)
    """that the executive told of"""

    def errors(self, against: Literal["world", "chassis", "motion"], *, datum: float = 0.0) -> np.ndarray:
        """Distances of the foreseen axles from the true ones, shape (n, 6) [m].

        Args:
            against: "world", as the ground believes it, its errors of where the robot is included; "chassis", from where it truly
                stood at the begin; "motion", besides less what was wrong about each axle at the begin: the preview's own error.
            datum: height of the believed world's origin in the true one [m].
        """
        true_from_believed = SE3.from_translation(np.array([0.0, 0.0, datum]))
        if against != "world":
            true_from_believed = self.world_from_hex.compose(self.belief.world_from_hex.inverse())
        foreseen = [true_from_believed.apply(self.preview.at(t).wheels_in_world) for t in self.times]
        off = np.array(foreseen).reshape(-1, 6, 3) - np.array(self.wheels).reshape(-1, 6, 3)
        if against == "motion":
            off -= true_from_believed.apply(self.preview.wheels_in_world[0]) - self.wheels_at_first
        return np.asarray(np.linalg.norm(off, axis=-1))


class Walk:
    """A robot in a scenario, its ground approving everything, without delay."""

    def __init__(
        self, robot: str, scenario: str, *, seed: int, variant: str = "integrated", body: str = "twin", bearing_deg: float = 0.0
    ) -> None:
        spec, field_ = load_spec(robot), load_scenario(scenario)
        self.robot: SimulatedRobot
        self.robot, grid = mock(spec, field_) if body == "mock" else twin(spec, field_, seed)
        bearing = np.deg2rad(bearing_deg)
        goal = (float(field_.goal_distance * np.cos(bearing)), float(field_.goal_distance * np.sin(bearing)))
        agent = ground_agent(spec, variant, goal=goal, seed=seed)
        assert isinstance(agent, GroundAgent)
        self.agent = agent
        up, down = DelayedLink(uplink(0.0), np.random.default_rng([seed, 1])), DelayedLink(downlink(0.0), np.random.default_rng([seed, 2]))
        self.mission = Mission(self.robot, up=up, down=down, agent=agent, on_truth=self._saw)
        self.datum = float(np.mean(grid.sample(self.robot.truth().wheels_in_world[:, :2])))
        self._now: Foreseen | None = None
        self._begun = 0.0

    def motions(self, *, most: int, time_limit: float = 20_000.0) -> Iterator[Foreseen]:
        """One motion after the other, until the ground stops or `most` are done."""
        mission, faults = self.mission, 0
        for _ in range(most):
            while not mission.wants_answer:
                if mission.finished or mission.t >= time_limit:
                    return
                mission.advance(time_limit)
            proposal, belief = mission.standing, self.agent.belief
            assert proposal is not None and belief is not None
            started = time.perf_counter()
            preview = self.agent.preview(proposal.sequence, belief, proposal.terrain)
            seconds, truth = time.perf_counter() - started, self.robot.truth()
            self._now = Foreseen(
                belief=belief, proposal=proposal, preview=preview, seconds=seconds,
                world_from_hex=truth.world_from_hex, wheels_at_first=truth.wheels_in_world.copy(),
            )  # fmt: skip
            # A preview's time runs from when the sequence has come up: its bits have to leave first.
            self._begun = mission.t + 8.0 * len(encode(proposal.sequence)) / mission.up.config.bandwidth
            mission.answer(Decision(kind="approve"))
            while not (mission.wants_answer or mission.finished or mission.t >= time_limit):
                mission.advance(time_limit)
            if mission.counts.faults > faults and mission.last_fault is not None:
                faults = mission.counts.faults
                self._now.faults.append(f"{mission.last_fault.code}: {mission.last_fault.text}")
            yield self._now

    def _saw(self, truth: TruthView) -> None:
        if self._now is not None and truth.t > self._begun:
            self._now.times.append(truth.t - self._begun)
            self._now.wheels.append(truth.wheels_in_world.copy())
