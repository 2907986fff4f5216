"""Single steps: the leg farthest behind goes, and no order is kept."""

from dataclasses import replace

import numpy as np
import pytest

from envs.build import variant_content
from planner.agent import GroundAgent
from planner.config import planner_config
from planner.gait.single_steps import by_lag, lags
from planner.gait.skeleton import regular_places, reverse_wave, stride

AHEAD = np.array([1.0, 0.0])


def lag_of(robot, contacts, remaining=9.0):
    return lags(
        robot.spec, robot.config.step.gait, world_from_hex=robot.belief.world_from_hex, contacts_in_world=contacts, heading=AHEAD,
        remaining=remaining,
    )  # fmt: skip


def regular(robot):
    contacts = robot.belief.contacts_in_world.copy()
    contacts[:, :2] = regular_places(robot.spec, robot.belief.world_from_hex)
    return contacts


def test_in_the_regular_stance_all_wheels_are_half_a_stride_behind_and_the_wave_decides(robot):
    lag = lag_of(robot, regular(robot))
    np.testing.assert_allclose(lag, 0.5 * stride(robot.spec, robot.config.step.gait), atol=1e-9)
    assert by_lag(robot.spec, lag, AHEAD) == list(reverse_wave(robot.spec, AHEAD))


def test_the_leg_farthest_behind_goes_first_and_sideways_does_not_count(robot):
    contacts = regular(robot)
    contacts[:, 0] += [0.1, -0.2, 0.05, -0.1, 0.0, 0.15]
    contacts[2, 1] += 0.3
    lag = lag_of(robot, contacts)
    assert by_lag(robot.spec, lag, AHEAD) == [1, 3, 4, 2, 0, 5]
    before = 0.5 * stride(robot.spec, robot.config.step.gait)
    np.testing.assert_allclose(lag, before - (contacts - regular(robot))[:, 0], atol=1e-9)


def test_near_the_goal_nobody_is_behind_by_more_than_is_left(robot):
    assert lag_of(robot, regular(robot), remaining=0.07) == pytest.approx([0.07] * 6, abs=1e-9)


@pytest.fixture
def agent(robot):
    """A ground that takes single steps on a flat map, and believes the robot to stand."""
    content = variant_content("blind")[1] | {"gait": "single_steps"}
    ground = GroundAgent(robot.spec, planner_config(content, robot.spec, name="x"), goal_in_world=np.array([3.0, 0.0]), seed=0)
    ground._belief = robot.belief
    return ground


def order(agent, belief):
    return agent._turns.order(belief, AHEAD, np.flatnonzero(~belief.planted))


def moved(robot, **by):
    contacts = regular(robot)
    for leg, way in by.items():
        contacts[int(leg[1]), 0] += way
    return replace(robot.belief, contacts_in_world=contacts)


def test_who_has_stepped_before_does_not_matter(robot, agent):
    there = moved(robot, l4=-0.2)
    assert order(agent, there)[0][0] == 4
    agent.stepped[4] += 7
    assert order(agent, there)[0][0] == 4


def test_a_wheel_that_is_where_it_would_step_goes_on_only_when_no_other_can(robot, agent):
    half = 0.5 * stride(robot.spec, robot.config.step.gait)
    due, others = order(agent, moved(robot, l0=half, l1=half - 0.04))
    assert sorted(due) == [2, 3, 4, 5] and others == [1, 0]


def test_a_leg_in_the_air_comes_down_first_and_the_operators_leg_goes_before_the_rule(robot, agent):
    planted = np.ones(6, dtype=bool)
    planted[3] = False
    assert order(agent, replace(moved(robot, l4=-0.2), planted=planted)) == [[3]]
    agent._forced_leg = 2
    assert order(agent, moved(robot, l4=-0.2))[0] == [2]


def test_the_leg_that_steps_now_is_not_expected_next(robot, agent):
    upcoming = agent._turns.upcoming(moved(robot, l4=-0.2, l1=-0.1), AHEAD, (4,))
    assert upcoming[0] == 1 and upcoming[-1] == 4 and sorted(upcoming) == list(range(6))


def walked(robot, agent, *, stuck=(), steps=200):
    """Contacts and chassis after the rule alone has walked on open ground; legs that are stuck find no step.

    A chassis is held back by a wheel that would be left behind by more than a stride: as reach holds it.
    """
    belief, gait, took = moved(robot), robot.config.step.gait, []
    span = stride(robot.spec, gait)
    for _ in range(steps):
        remaining = float(np.linalg.norm(agent.goal - belief.world_from_hex.translation[:2]))
        if remaining <= gait.arrival_distance:
            return belief, took, "arrived"
        contacts = belief.contacts_in_world.copy()
        places = regular_places(robot.spec, belief.world_from_hex) + min(0.5 * span, remaining) * AHEAD
        onward = (places - contacts[:, :2]) @ AHEAD
        can = [leg for group in order(agent, belief) for leg in group if leg not in stuck]
        can = [leg for leg in can if onward[leg] >= min(gait.min_step, remaining)]
        if not can:
            return belief, took, "no step"
        took.append(can[0])
        contacts[can[0], :2] = places[can[0]]
        held = (contacts[:, 0] - regular_places(robot.spec, belief.world_from_hex)[:, 0] + span).min()
        pose = belief.world_from_hex
        on = type(pose)(pose.rotation, pose.translation + [min(span / 6.0, remaining, max(held, 0.0)), 0.0, 0.0])
        belief = replace(belief, contacts_in_world=contacts, world_from_hex=on)
        agent._belief = belief
    return belief, took, "still walking"


def test_on_open_ground_the_rule_reaches_the_goal_and_uses_every_leg(robot, agent):
    _, took, end = walked(robot, agent)
    assert end == "arrived"
    counts = np.bincount(took, minlength=6)
    assert counts.min() >= 1 and counts.max() - counts.min() <= 1, counts


@pytest.mark.parametrize("stuck", [(0,), (3, 5)])
def test_legs_that_never_find_a_step_end_the_walk_in_no_step_and_not_in_a_dance(robot, agent, stuck):
    belief, took, end = walked(robot, agent, stuck=stuck)
    assert end == "no step" and len(took) < 60
    went = belief.world_from_hex.translation[0] - robot.belief.world_from_hex.translation[0]
    assert went > 0.5 * stride(robot.spec, robot.config.step.gait)
    assert not set(took) & set(stuck)


def test_the_rule_is_documented_with_its_source():
    from planner.gait import single_steps

    assert "[SunSpiral2012] s3.1" in single_steps.__doc__
