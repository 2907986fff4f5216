"""A whole walk over links that lose, double, damage and delay: every step is done once, and the ground gets there."""

import numpy as np
import pytest

from athlete_twin.link import DelayedLink, LinkConfig
from athlete_twin.messages import CommandSequence
from athlete_twin.mock import MockAthlete
from athlete_twin.model.spec import load_spec
from envs.build import ground_agent
from envs.mission import Mission
from planner.decisions import Decision

GOAL = (0.6, 0.0)
BAD = {
    "clean": {},
    "lossy": {"loss": 0.2},
    "acknowledged": {"loss": 0.3, "retry_after": 11.0},
    "doubling": {"duplication": 0.4},
    "damaging": {"corruption": 0.15},
    "overtaking": {"jitter": 4.0, "reordering": True},
    "all_of_it": {"loss": 0.15, "duplication": 0.2, "corruption": 0.1, "jitter": 4.0, "reordering": True},
}


@pytest.mark.parametrize("kind", [pytest.param(kind, marks=[pytest.mark.slow] + [pytest.mark.ci] * (kind == "all_of_it")) for kind in BAD])
def test_a_walk_over_a_bad_link_does_each_step_once(kind):
    spec = load_spec("sdm_b")
    robot, taken = MockAthlete(spec), []
    accept = robot.executive.accept

    def noted(message, t):
        events = accept(message, t)
        if isinstance(message, CommandSequence) and events[0].status == "queued":
            taken.append(message.sequence_id)
        return events

    robot.executive.accept = noted
    agent = ground_agent(spec, "blind", goal=GOAL, seed=0)
    up, down = (LinkConfig(delay=5.0, bandwidth=b, **BAD[kind]) for b in (64e3, 2e6))
    mission = Mission(
        robot, up=DelayedLink(up, np.random.default_rng(3)), down=DelayedLink(down, np.random.default_rng(4)), agent=agent
    )
    approved = []
    while not mission.finished and mission.t < 20_000.0:
        mission.advance(20_000.0)
        if mission.wants_answer:
            approved.append(mission.standing.sequence.sequence_id)
            mission.answer(Decision(kind="approve"))
    assert mission.arrived is not None, (mission.no_step, mission.waiting_for)
    assert taken == sorted(set(taken)) == approved
    assert agent.steps_taken == len([n for n in taken if mission.approved[n].kind == "step"])
    assert mission.counts.faults == 0
    at = robot.truth().world_from_hex.translation[:2]
    assert np.linalg.norm(at - GOAL) < 0.3




@pytest.mark.parametrize("robot_id", ["sdm_b", "t12"])
@pytest.mark.slow
def test_a_robot_whose_first_word_is_lost_is_asked(robot_id):
    spec = load_spec(robot_id)
    robot, link = MockAthlete(spec), LinkConfig(delay=5.0, bandwidth=2e6)
    agent = ground_agent(spec, "blind", goal=GOAL, seed=0)
    down = DelayedLink(link, np.random.default_rng(4))
    mission = Mission(robot, up=DelayedLink(link, np.random.default_rng(3)), down=down, agent=agent)
    mission.advance(3.0)
    assert len(down.receive_raw(1e9)) == 1  # taken off the link: lost
    while not mission.wants_answer and mission.t < 200.0:
        mission.advance(mission.t + 1.0)
    assert mission.wants_answer and mission.counts.uplinks == 1
    mission.answer(Decision(kind="approve"))
    mission.advance(mission.t + 30.0)
    assert robot.executive.newest_seq == 1 and mission.counts.faults == 0
