"""The variant of 2010: the leg lifts off alone, with pictures, before its step is planned."""

from dataclasses import replace

import numpy as np
import pytest

from athlete_twin.assets import named_toml, read_toml
from athlete_twin.messages import ImageRequest, LegMove, Receipt
from athlete_twin.mock import MockAthlete
from athlete_twin.model.spec import load_spec
from planner.agent import GroundAgent
from planner.config import planner_config
from planner.decisions import Decision, Proposal

CAMERAS = {"sdm_b": 9, "t12": 12}


@pytest.fixture(params=["sdm_b", "t12"])
def agent(request) -> GroundAgent:
    """A ground that stands on flat ground it has seen, and has looked around."""
    spec = load_spec(request.param)
    config = planner_config(read_toml(named_toml("variants", "lift_and_image")), spec, name="lift_and_image")
    ground = GroundAgent(spec, config, goal_in_world=np.array([3.0, 0.0]), seed=0)
    for message in MockAthlete(spec).advance(1.0):
        ground.observe(message, 1.0)
    rng = np.random.default_rng(0)
    xy = rng.uniform(-7.0, 7.0, (600000, 2))
    ground.eyes.map.fuse_points(np.column_stack([xy, np.zeros(len(xy))]), np.full(len(xy), 0.01))
    assert ground.decide(Decision(kind="approve"), 1.0) is None
    look = ground.next(1.0)
    assert isinstance(look, Proposal) and "look around" in look.text
    ground.decide(Decision(kind="reject"), 1.0)
    return ground


def test_the_lift_off_goes_up_alone_with_pictures_of_all_cameras(agent):
    proposal = agent.next(2.0)
    assert isinstance(proposal, Proposal) and proposal.kind == "shift" and "lifts off" in proposal.text
    lift, look = proposal.sequence.commands
    assert isinstance(lift, LegMove) and lift.guard == "break_contact" and lift.leg == proposal.leg
    assert isinstance(look, ImageRequest) and len(look.cameras) == CAMERAS[agent.spec.name]
    assert proposal.predicted_margin >= agent.spec.min_support_margin


def test_the_leg_in_the_air_is_the_one_that_steps_next_and_a_lift_is_no_step(agent):
    proposal = agent.next(2.0)
    sequence = agent.decide(Decision(kind="approve"), 2.0)
    receipt = Receipt(
        seq=0, robot_id=agent.spec.name, t=3.0, sequence_id=sequence.sequence_id, command_index=0, status="completed"
    )
    agent.observe(receipt, 3.0)
    agent.observe(replace(receipt, command_index=-1), 3.0)
    assert not agent._filter.planted[proposal.leg] and agent._filter.planted.sum() == 5
    assert agent.steps_taken == 0 and agent.stepped[proposal.leg] == 0
    heading = np.array([1.0, 0.0])
    belief = replace(agent.belief, planted=agent._filter.planted)
    assert agent._order(belief, heading, np.flatnonzero(~belief.planted)) == [[proposal.leg]]


def test_a_lift_off_survives_an_edit_and_is_still_known_as_one(agent):
    proposal = agent.next(2.0)
    edit = Decision(kind="edit_footfall", footfall_in_world=np.array([2.0, 0.0, 0.0]))
    assert agent.decide(edit, 2.0) is None
    assert agent.next(2.0) is proposal
    sequence = agent.decide(Decision(kind="approve"), 2.0)
    receipt = Receipt(
        seq=0, robot_id=agent.spec.name, t=3.0, sequence_id=sequence.sequence_id, command_index=0, status="completed"
    )
    agent.observe(receipt, 3.0)
    assert not agent._filter.planted[proposal.leg]
