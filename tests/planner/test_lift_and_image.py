"""The variant of 2010: the leg lifts off alone, with pictures, before its step is planned."""

from dataclasses import replace

import numpy as np
import pytest

from athlete_twin.assets import named_toml, read_toml
from athlete_twin.messages import ImageRequest, JointMove, LegMove, Receipt
from athlete_twin.mock import MockAthlete
from athlete_twin.model.spec import load_spec
from planner.agent import GroundAgent
from planner.config import planner_config
from planner.decisions import Decision, Proposal
from planner.stability.margin import support_margin

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
    lift, up, look = proposal.sequence.commands
    assert isinstance(lift, LegMove) and lift.guard == "break_contact" and lift.leg == proposal.leg
    assert isinstance(up, JointMove) and up.leg == lift.leg
    assert isinstance(look, ImageRequest) and len(look.cameras) == CAMERAS[agent.spec.name]
    assert proposal.predicted_margin >= agent.spec.min_support_margin


def test_the_leg_goes_straight_up_out_of_the_view(agent):
    proposal = agent.next(2.0)
    _, up, _ = proposal.sequence.commands
    before = agent.kin.leg_wheel(proposal.leg, agent.belief.motors[proposal.leg]).translation
    way = np.array([agent.kin.leg_wheel(proposal.leg, q).translation for q in up.waypoints]) - before
    assert way[-1, 2] == pytest.approx(agent.config.look.lift, abs=0.03)
    np.testing.assert_allclose(way[:, :2], 0.0, atol=2e-3)
    assert (np.diff(way[:, 2]) > 0.0).all()
    joints = agent.belief.joints.copy()
    joints[proposal.leg] = up.waypoints[-1]
    com = agent.belief.world_from_hex.apply(agent.kin.com_in_hex(joints))
    others = np.delete(agent.belief.contacts_in_world, proposal.leg, axis=0)
    assert support_margin(com, others) >= agent.spec.min_support_margin - 0.01


def test_a_raised_leg_without_a_step_comes_down_to_the_ground_and_no_higher(agent):
    """From half a metre up the usual search depth would end in the air."""
    proposal = agent.next(2.0)
    sequence = agent.decide(Decision(kind="approve"), 2.0)
    lift, belief = agent._attempts[proposal.leg], agent.belief
    motors = belief.motors.copy()
    motors[proposal.leg] = sequence.commands[1].waypoints[-1]
    planted = belief.planted.copy()
    planted[proposal.leg] = False
    raised = replace(belief, motors=motors, joints=motors, planted=planted)
    down = agent._lower(lift, raised, agent._ground(belief), 3.0).proposal.sequence.commands[0]
    bottom = belief.world_from_hex.apply(down.wheel_in_hex)[2] - agent.spec.wheel.radius
    assert bottom == pytest.approx(-agent.config.step.touchdown.search_depth, abs=0.03)


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
    assert agent._turns.order(belief, heading, np.flatnonzero(~belief.planted)) == [[proposal.leg]]


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
