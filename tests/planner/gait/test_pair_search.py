"""Two opposite legs at once on small maps: both steps keep the rule on four wheels, land in turn, and the executive walks them."""

from dataclasses import replace

import numpy as np
import pytest

from athlete_twin.assets import named_toml, read_toml
from athlete_twin.errors import ConfigError
from athlete_twin.geometry.polygon import signed_distance
from athlete_twin.messages import BodyMove, JointMove, LegMove
from planner.config import planner_config
from planner.decisions import NoStep
from planner.gait.pair_search import search_pair
from planner.gait.skeleton import nominal_footfall, opposite, stride
from planner.gait.step_plan import StepPlan
from planner.gait.step_search import StepRequest, search_step
from planner.preview.foresee import foresee
from planner.sequence import as_sequence, step_commands

AHEAD = np.array([1.0, 0.0])
FIRST = 0


def pair(robot, ground, *, config=None, first=FIRST, **changes) -> StepPlan | NoStep:
    a, b = (StepRequest(**({"leg": leg, "heading": AHEAD, "remaining": 10.0} | changes)) for leg in (first, opposite(robot.spec, first)))
    return search_pair(
        robot.kin, robot.springs, robot.belief, ground, a, b, config=config or robot.config.step, payload_kg=0.0,
        rng=np.random.default_rng(0),
    )  # fmt: skip


PLANS: dict[str, StepPlan | NoStep] = {}
"""on open ground, by robot: one search serves all tests"""


@pytest.fixture
def plan(robot, on, field) -> StepPlan:
    name = robot.spec.name
    if name not in PLANS:
        PLANS[name] = pair(robot, on(robot, field()))
    found = PLANS[name]
    assert isinstance(found, StepPlan), found
    return found


def test_opposite_legs_are_half_a_turn_apart(robot):
    for leg in range(6):
        across = opposite(robot.spec, leg)
        assert opposite(robot.spec, across) == leg
        assert np.allclose(robot.spec.hips_in_hex[across, :2], -robot.spec.hips_in_hex[leg, :2], atol=1e-6)


def test_both_legs_step_to_the_gaits_own_places_and_the_chassis_goes_a_third_of_the_stride(robot, plan):
    assert [part.leg for part in plan.parts] == [FIRST, opposite(robot.spec, FIRST)]
    for part in plan.parts:
        target = nominal_footfall(
            robot.spec, robot.config.step.gait, leg=part.leg, world_from_hex=robot.belief.world_from_hex, heading=AHEAD, remaining=10.0
        )
        assert np.linalg.norm(part.footfall_in_world[:2] - target) < 0.10
    forward = robot.belief.world_from_hex.rotate(plan.shift.translation_in_hex)[0]
    assert forward == pytest.approx(plan.shift.fraction * stride(robot.spec, robot.config.step.gait) / 3, abs=1e-9)
    assert plan.shift.fraction > 0.0


def test_four_wheels_carry_within_the_rule_while_both_are_in_the_air(robot, plan):
    joints = robot.belief.joints.copy()
    for part in plan.parts:
        joints[part.leg] = part.swing[-1]
    com = plan.companion.world_from_hex_swing.apply(robot.kin.com_in_hex(joints))
    standing = [leg for leg in range(6) if leg not in (part.leg for part in plan.parts)]
    margin = signed_distance(com[:2], robot.belief.contacts_in_world[standing, :2])
    assert margin >= robot.spec.min_support_margin
    assert plan.swing_margin <= margin + 1e-9


def test_commands_lift_both_before_either_swings_and_shift_last(plan):
    commands = step_commands(plan)
    assert [type(c) for c in commands] == [LegMove, LegMove, JointMove, JointMove, LegMove, LegMove, BodyMove]
    assert [getattr(c, "guard", "") for c in commands[:2] + commands[4:6]] == ["break_contact"] * 2 + ["contact"] * 2
    assert [c.leg for c in commands[:6]] == [part.leg for part in plan.parts] * 3


def test_the_first_leg_is_lifted_as_high_as_it_needs_alone(robot, on, field, plan):
    alone = search_step(
        robot.kin, robot.springs, robot.belief, on(robot, field()), StepRequest(leg=FIRST, heading=AHEAD, remaining=10.0),
        config=robot.config.step, payload_kg=0.0, rng=np.random.default_rng(0),
    )  # fmt: skip
    assert isinstance(alone, StepPlan)
    assert plan.lift_in_hex is not None and alone.lift_in_hex is not None
    assert plan.lift_in_hex[2] >= alone.lift_in_hex[2] - 1e-3


def test_the_second_leg_reaches_its_ground_from_a_chassis_that_stands_on_five(robot, plan):
    two = plan.companion
    end = robot.belief.world_from_hex.apply(two.descent_in_hex)
    bottom = end[2] - robot.spec.wheel.radius
    touch = robot.config.step.touchdown.search_depth
    # Commanded from the unsagged chassis: below the ground by the search depth and, at most, what springs give way.
    assert two.footfall_in_world[2] - 0.6 < bottom < two.footfall_in_world[2] - touch + 0.02


def test_its_own_preview_finds_no_fault(robot, on, field, plan):
    commands = step_commands(plan)
    sequence = as_sequence(commands, robot_id=robot.spec.name, sequence_id=0, t=0.0)
    preview = foresee(robot.kin, robot.belief, sequence, terrain=on(robot, field()).filled, springs=robot.springs)
    assert preview.faults == ()


def test_what_refuses_one_leg_refuses_the_pair(robot, on, field):
    config = robot.config.step
    strict = replace(config, stability=replace(config.stability, min_margin=5.0))
    found = pair(robot, on(robot, field()), config=strict)
    assert isinstance(found, NoStep)
    assert found.reason.startswith("legs 1 and 4 together: no stable, reachable footfall")
    assert found.refused["swing_margin"] > 0


def test_springs_that_hold_no_four_wheels_are_told(robot, on, field):
    far = replace(robot.belief, planted=np.array([True, True, False, False, True, True]))
    found = search_pair(
        robot.kin, robot.springs, far, on(robot, field()), *(StepRequest(leg=leg, heading=AHEAD, remaining=10.0) for leg in (0, 3)),
        config=robot.config.step, payload_kg=0.0, rng=np.random.default_rng(0),
    )  # fmt: skip
    assert isinstance(found, NoStep)


def test_a_stance_that_breaks_the_rule_with_all_wheels_down_is_refused(robot, on, field):
    config = robot.config.step
    strict = replace(config, stability=replace(config.stability, all_down="energy", min_energy=50.0))
    found = pair(robot, on(robot, field()), config=strict)
    assert isinstance(found, NoStep)
    assert found.reason == "legs 1 and 4 together: landed_margin" and found.refused == {"landed_margin": 1}


def test_a_gait_that_lifts_two_is_refused_beside_one_that_sways(robot):
    content = read_toml(named_toml("variants", "blind")) | {"gait": "opposite_pairs", "body_motion": "sway"}
    with pytest.raises(ConfigError, match="body_motion = 'sway' makes ready for one leg, gait = 'opposite_pairs' lifts two"):
        planner_config(content, robot.spec, name="both")


def test_a_gait_that_lifts_two_is_refused_beside_a_fusion_that_lifts_one(robot):
    content = read_toml(named_toml("variants", "lift_and_image")) | {"gait": "opposite_pairs"}
    with pytest.raises(ConfigError, match="gait = 'opposite_pairs' lifts two legs, fusion = 'lift_and_image' one to look"):
        planner_config(content, robot.spec, name="both")
