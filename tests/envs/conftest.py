"""A ground that follows a script: one picture, then so many identical steps of leg 1 in place, then arrival."""

from __future__ import annotations

import numpy as np
import pytest

from athlete_twin.geometry.grid import HeightGrid
from athlete_twin.geometry.se3 import SE3
from athlete_twin.link import DelayedLink, LinkConfig
from athlete_twin.messages import (
    BodyMove,
    CommandSequence,
    Fault,
    ImageRequest,
    LegMove,
    Message,
    StereoPair,
    Telemetry,
)
from athlete_twin.mock import MockAthlete
from athlete_twin.model.kinematics import Kinematics
from athlete_twin.model.spec import load_spec
from athlete_twin.model.stance import regular_stance
from envs.mission import Mission
from planner.decisions import Action, Arrived, Decision, NoStep, Proposal, Uplink, Waiting
from planner.preview.foresee import posing

PLAN_SECONDS, PAIR_SECONDS = 2.0, 1.0


class ScriptedAgent:
    def __init__(self, robot: str = "sdm_b", steps: int = 1, shift: float = 0.03) -> None:
        self.spec = load_spec(robot)
        self.kin = Kinematics(self.spec)
        self.steps, self.shift = steps, shift
        self.ground_s = 0.0
        self.unusable_pairs: tuple[str, ...] = ()
        self.seen: list[tuple[float, Message]] = []
        self.decided: list[str] = []
        self._sequence = 0
        self._proposed = 0
        self._done = 0
        self._waiting = ""
        self._standing: Proposal | None = None

    def observe(self, message: Message, t: float) -> None:
        self.seen.append((t, message))
        if isinstance(message, StereoPair):
            self.ground_s += PAIR_SECONDS
        ours = isinstance(message, Telemetry) and message.sequence_id == self._sequence - 1
        if ours and message.executive_state == "idle":
            self._done += self._waiting == "a step"
            self._waiting = ""
        if isinstance(message, Fault):
            self._waiting = "fault"

    def next(self, t: float) -> Action:
        if self._standing is not None:
            return self._standing
        if self._waiting == "fault":
            return NoStep(reason="a fault", refused={"torque": 2})
        if self._waiting:
            return Waiting(reason=self._waiting)
        if self._sequence == 0:
            self._waiting = "pictures"
            return Uplink(sequence=self._made(t, (ImageRequest(cameras=("navcam_1",), binning=4),)))
        if self._done >= self.steps:
            return Arrived(text="believed at the goal")
        self.ground_s += PLAN_SECONDS
        self._standing = self._proposal(t)
        return self._standing

    def decide(self, decision: Decision, t: float) -> CommandSequence | None:
        self.decided.append(decision.kind)
        standing = self._standing
        if standing is None or decision.kind in ("wait", "stop"):
            return None
        self._standing = None
        if decision.kind != "approve":
            return None
        self._waiting = "a step"
        return standing.sequence

    def _proposal(self, t: float) -> Proposal:
        joints = regular_stance(self.spec)
        wheel = self.kin.wheels_in_hex(joints)[0]
        up = wheel + np.array([0.0, 0.0, 0.2])
        sequence = self._made(
            t,
            (
                LegMove(leg=0, wheel_in_hex=up, guard="break_contact"),
                LegMove(leg=0, wheel_in_hex=wheel - np.array([0.0, 0.0, 0.2]), guard="contact", contact_load=700.0),
                BodyMove(translation_in_hex=np.array([self.shift, 0.0, 0.0])),
            ),
        )
        n = 120
        terrain = HeightGrid(origin_x=-3.0, origin_y=-3.0, cell=0.05, heights=np.zeros((n, n)))
        pose = SE3.from_translation(np.array([0.0, 0.0, 1.67]))
        proposal = Proposal(
            index=self._proposed,
            t=t,
            kind="step",
            leg=0,
            footfall_in_world=np.array([wheel[0], wheel[1], 0.0]),
            sequence=sequence,
            preview=posing(self.kin, np.array([joints, joints]), (pose, pose), seconds=10.0),
            terrain=terrain,
            footfall_ok=np.ones((n, n), dtype=bool),
            cost=np.zeros((n, n)),
            world_from_hex=pose,
            predicted_margin=0.5,
            predicted_sag=0.07,
            text="leg 1 in place",
        )
        self._proposed += 1
        return proposal

    def _made(self, t: float, commands: tuple) -> CommandSequence:
        number = self._sequence
        self._sequence += 1
        return CommandSequence(seq=number, robot_id=self.spec.name, t=t, sequence_id=number, commands=commands)


def flat_grid() -> HeightGrid:
    return HeightGrid(origin_x=-8.0, origin_y=-8.0, cell=0.1, heights=np.zeros((161, 161)))


def mission(agent: ScriptedAgent | None, *, delay: float = 5.0, recorder=None, robot: str = "sdm_b") -> Mission:
    return Mission(
        MockAthlete(load_spec(robot)),
        up=DelayedLink(LinkConfig(delay=delay, bandwidth=64e3), np.random.default_rng(1)),
        down=DelayedLink(LinkConfig(delay=delay, bandwidth=2e6), np.random.default_rng(2)),
        agent=agent,
        recorder=recorder,
    )


@pytest.fixture(scope="session")
def scripted():
    return ScriptedAgent


@pytest.fixture(scope="session")
def make_mission():
    return mission


@pytest.fixture
def flat():
    return flat_grid()
