"""Coming down: until the wheel carries its share, or open loop to the height where the sag method says that it does."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from athlete_twin.messages import LegMove, Receipt
from athlete_twin.mock import MockAthlete
from athlete_twin.model.kinematics import GRAVITY
from envs.build import variant_content
from planner.agent import GroundAgent
from planner.config import planner_config
from planner.decisions import Decision, Proposal
from planner.gait.step_plan import StepPlan
from planner.gait.step_search import StepRequest, search_step
from planner.preview.foresee import foresee
from planner.sequence import as_sequence, step_commands

SLOW = (pytest.mark.slow, pytest.mark.ci)
AHEAD = np.array([1.0, 0.0])
MILLIMETRE = 1e-3


def step(robot, ground, *, leg=1, **content) -> StepPlan:
    """A step of the plain variant with other methods."""
    config = planner_config(variant_content("blind")[1] | content, robot.spec, name="x").step
    found = search_step(
        robot.kin, robot.springs, robot.belief, ground, StepRequest(leg=leg, heading=AHEAD, remaining=9.0), config=config,
        payload_kg=0.0, rng=np.random.default_rng(0),
    )  # fmt: skip
    assert isinstance(found, StepPlan), found
    return found


@pytest.fixture
def open_ground(robot, on, field):
    return on(robot, field())


@pytest.mark.parametrize(("docks", "off"), [(False, 0.03), pytest.param(True, 0.05, marks=SLOW)])
@pytest.mark.parametrize("leg", [0, *(pytest.param(leg, marks=SLOW) for leg in (1, 2))])
def test_a_planned_descent_ends_where_the_wheel_stands_once_the_chassis_is_back_up(robot, open_ground, leg, docks, off):
    """By the sagged chassis that is below the ground; by the chassis that stands again it is as high as the other axles.

    The sag is foreseen for the place that the wheel leaves: where T12's deck twists on its dock, 4 cm less where it arrives.
    """
    plan = step(robot, open_ground, leg=leg, touchdown="planned", settings={"sag": {"docks": docks}})
    place = plan.footfall_in_world + [0.0, 0.0, robot.spec.wheel.radius]
    lowest = plan.world_from_leg_swing.apply(plan.descent_in_hex)
    np.testing.assert_allclose(place - lowest, [0.0, 0.0, plan.reload], atol=MILLIMETRE)
    assert plan.reload > 0.05
    standing = robot.belief.world_from_hex.apply(robot.kin.wheels_in_hex(robot.belief.motors))[:, 2].mean()
    assert robot.belief.world_from_hex.apply(plan.descent_in_hex)[2] == pytest.approx(standing, abs=off)


def test_the_two_touchdowns_differ_in_the_descent_alone(robot, open_ground):
    guarded, planned = (step(robot, open_ground, touchdown=how) for how in ("guarded", "planned"))
    down = [next(c for c in step_commands(plan) if isinstance(c, LegMove) and c.lands) for plan in (guarded, planned)]
    assert [c.guard for c in down] == ["contact", "place"]
    np.testing.assert_array_equal(guarded.swing, planned.swing)
    further = (down[0].wheel_in_hex - down[1].wheel_in_hex) @ robot.belief.world_from_hex.rotation.T[:, 2]
    assert -further == pytest.approx(robot.config.step.touchdown.search_depth, rel=0.02)


@pytest.mark.slow
@pytest.mark.ci
def test_without_a_model_of_the_sag_the_wheel_goes_to_the_ground_as_mapped(robot, open_ground):
    plan = step(robot, open_ground, touchdown="planned", sag="none")
    assert plan.reload == 0.0
    height = robot.belief.world_from_hex.apply(plan.descent_in_hex)[2]
    assert height == pytest.approx(plan.footfall_in_world[2] + robot.spec.wheel.radius, abs=MILLIMETRE)


@pytest.mark.slow
@pytest.mark.ci
@pytest.mark.parametrize("touchdown", ["guarded", "planned"])
def test_a_preview_of_either_ends_on_six_wheels_without_a_fault(robot, open_ground, touchdown):
    plan = step(robot, open_ground, touchdown=touchdown)
    sequence = as_sequence(step_commands(plan), robot_id=robot.spec.name, sequence_id=0, t=0.0)
    shown = foresee(robot.kin, robot.belief, sequence, terrain=open_ground.filled, springs=robot.springs)
    assert shown.faults == ()
    before, after = shown.wheels_in_world[0, :, 2], shown.wheels_in_world[-1, :, 2]
    np.testing.assert_allclose(after, before.mean(), atol=0.03)


@pytest.mark.slow
@pytest.mark.ci
def test_a_preview_over_a_hole_shows_the_wheel_in_the_air_and_no_fault_since_the_robot_feels_none(robot, open_ground, field):
    plan = step(robot, open_ground, touchdown="planned")
    sequence = as_sequence(step_commands(plan), robot_id=robot.spec.name, sequence_id=0, t=0.0)
    hole = field((*plan.footfall_in_world[:2], 0.35, -0.4))
    shown = foresee(robot.kin, robot.belief, sequence, terrain=hole, springs=robot.springs)
    assert "no_contact" not in {fault.code for fault in shown.faults}
    assert shown.wheels_in_world[-1, 1, 2] - robot.spec.wheel.radius > -0.3


@pytest.mark.slow
@pytest.mark.ci
def test_terrain_raised_as_in_2008_has_steps_that_lift_and_arrive_so_much_higher(robot, open_ground):
    plain, raised = (step(robot, open_ground, sag=how, touchdown="planned") for how in ("none", "raise_terrain"))
    wheel = [robot.kin.leg_wheel(1, plan.swing[-1]).translation for plan in (plain, raised)]
    up = robot.belief.world_from_hex.rotation.T[:, 2]
    assert (wheel[1] - wheel[0]) @ up == pytest.approx(0.15, abs=MILLIMETRE)
    assert (raised.lift_in_hex - plain.lift_in_hex) @ up == pytest.approx(0.15, abs=MILLIMETRE)
    np.testing.assert_allclose(raised.descent_in_hex, plain.descent_in_hex, atol=MILLIMETRE)


@pytest.fixture
def agent(robot):
    content = variant_content("blind")[1] | {"touchdown": "planned"}
    ground = GroundAgent(robot.spec, planner_config(content, robot.spec, name="x"), goal_in_world=np.array([3.0, 0.0]), seed=0)
    for message in MockAthlete(robot.spec).advance(1.0):
        ground.observe(message, 1.0)
    return ground


def test_the_ground_knows_that_a_placed_wheel_stands(agent):
    proposal = agent.next(1.0)
    assert isinstance(proposal, Proposal)
    sent = agent.decide(Decision(kind="approve"), 1.0)
    planted = []
    for index in range(3):
        done = {"command_index": index, "status": "completed", "sequence_id": sent.sequence_id}
        agent.observe(Receipt(seq=index, robot_id=agent.spec.name, t=2.0 + index, **done), 2.0 + index)
        planted.append(bool(agent._filter.planted[proposal.leg]))
    assert planted == [False, False, True]


@pytest.mark.slow
@pytest.mark.ci
def test_a_leg_in_the_air_is_set_down_where_it_is_as_deep_as_the_sag_asks_and_that_is_no_step(agent, robot):
    proposal = agent.next(1.0)
    plan, leg = agent._offer.plan, proposal.leg
    motors = agent.belief.motors.copy()
    axle = agent.kin.leg_wheel(leg, motors[leg])
    up = agent.belief.world_from_hex.rotation.T[:, 2]
    motors[leg] = _reached(agent, leg, axle.translation + 0.2 * up)
    raised = replace(agent.belief, motors=motors, joints=motors, planted=np.arange(6) != leg)
    down = agent._lower(plan, raised, agent._ground(agent.belief), 2.0).proposal
    (move,) = (c for c in down.sequence.commands if isinstance(c, LegMove))
    bottom = raised.world_from_hex.apply(move.wheel_in_hex)[2] - robot.spec.wheel.radius
    assert move.guard == "place" and bottom == pytest.approx(-plan.reload, abs=0.03)
    assert down.kind == "shift" and "at most" not in down.text


def _reached(agent, leg, axle):
    from athlete_twin.model.reach import leg_ik

    q, ok = leg_ik(agent.spec, leg, axle[None], last_link_in_hex=np.array([0.0, 0.0, -1.0]))
    assert ok[0]
    return q[0]


@pytest.mark.slow
@pytest.mark.ci
def test_the_mock_steps_open_loop_and_the_wheel_carries_about_its_share(robot, open_ground):
    plan, body = step(robot, open_ground, touchdown="planned"), MockAthlete(robot.spec)
    body.advance(0.1)
    body.receive(as_sequence(step_commands(replace(plan)), robot_id=robot.spec.name, sequence_id=1, t=0.0))
    heard: Counter[str] = Counter()
    while body.busy:
        heard.update(type(m).__name__ for m in body.advance(body.t + 5.0))
    assert heard["Fault"] == 0 and set(body.truth().phases) == {"stance"}
    share = robot.spec.mass * GRAVITY / 6.0
    assert 0.3 * share < body.truth().wheel_loads[plan.leg] < 2.0 * share
