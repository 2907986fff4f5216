"""The search for a step on small maps: towards the goal, inside the rule, out of the rock's way, or why there is none."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from athlete_twin.errors import ConfigError, PlanningError
from athlete_twin.geometry.grid import HeightGrid
from athlete_twin.geometry.polygon import conservative_distance, signed_distance
from athlete_twin.model.kinematics import GRAVITY
from athlete_twin.model.reach import leg_ik
from athlete_twin.model.statics import peak_torque_fraction
from planner.decisions import NoStep
from planner.gait.skeleton import nominal_footfall
from planner.gait.step_plan import StepPlan
from planner.gait.step_search import SearchConfig, StepRequest, TouchdownConfig, search_step

AHEAD = np.array([1.0, 0.0])
MIRROR = np.array([1.0, -1.0, 1.0])
MILLIMETRE = 1e-3
ROCK = {"sdm_b": (0.12, 0.30), "t12": (0.30, 0.80)}
"""radius and height of a rock that leaves places around it within the search [m]"""
LEGS = range(6)


def search(robot, ground, *, config=None, payload=0.0, **request):
    wanted = {"leg": 0, "heading": AHEAD, "remaining": 10.0} | request
    return search_step(
        robot.kin, robot.springs, robot.belief, ground, StepRequest(**wanted), config=config or robot.config.step,
        payload_kg=payload, rng=np.random.default_rng(0),
    )  # fmt: skip


def planned(robot, ground, **request) -> StepPlan:
    found = search(robot, ground, **request)
    assert isinstance(found, StepPlan), found
    return found


def mirrored(robot, leg: int) -> int:
    """The leg on the other side."""
    hips = robot.spec.hips_in_hex
    return int(np.argmin(np.linalg.norm(hips - hips[leg] * MIRROR, axis=1)))


@pytest.mark.parametrize("leg", LEGS)
def test_on_open_ground_every_leg_steps_to_the_gaits_own_place(robot, on, field, leg):
    plan = planned(robot, on(robot, field()), leg=leg)
    target = nominal_footfall(
        robot.spec, robot.config.step.gait, leg=leg, world_from_hex=robot.belief.world_from_hex, heading=AHEAD, remaining=10.0
    )
    assert np.linalg.norm(plan.footfall_in_world[:2] - target) < 0.10  # two cells
    assert (plan.footfall_in_world[:2] - robot.belief.contacts_in_world[leg, :2]) @ AHEAD > 0.2
    assert plan.shift.translation_in_hex @ robot.belief.world_from_hex.rotation.T[:, 0] > 0.05


@pytest.mark.parametrize("leg", LEGS)
def test_a_step_keeps_the_stability_rule_while_the_leg_swings_and_after(robot, on, field, leg):
    plan, belief, limit = planned(robot, on(robot, field()), leg=leg), robot.belief, robot.config.step.stability.min_margin
    contacts = belief.contacts_in_world[:, :2].copy()
    com = plan.world_from_hex_swing.apply(robot.kin.com_in_hex(belief.joints))[:2]
    swinging = signed_distance(com, np.delete(contacts, leg, axis=0))
    contacts[leg] = plan.footfall_in_world[:2]
    landed = belief.joints.copy()
    landed[leg] = plan.preview_joints[-1][leg]
    standing = conservative_distance(belief.world_from_hex.apply(robot.kin.com_in_hex(landed))[:2], contacts)
    assert plan.swing_margin == pytest.approx(swinging)
    assert plan.landed_margin == pytest.approx(standing)
    assert min(swinging, standing) >= limit


def test_the_way_down_ends_below_the_footfall_and_the_wheel_arrives_above_it(robot, on, field):
    plan, radius = planned(robot, on(robot, field()), leg=1), robot.spec.wheel.radius
    touch = robot.config.step.touchdown
    above = plan.world_from_leg_swing.apply(robot.kin.leg_wheel(1, plan.swing[-1]).translation)
    np.testing.assert_allclose(above[:2], plan.footfall_in_world[:2], atol=MILLIMETRE)
    assert above[2] == pytest.approx(plan.footfall_in_world[2] + (1.0 + touch.approach_clearance) * radius, abs=MILLIMETRE)
    lowest = plan.world_from_leg_swing.apply(plan.descent_in_hex)
    np.testing.assert_allclose(lowest[:2], plan.footfall_in_world[:2], atol=MILLIMETRE)
    assert plan.footfall_in_world[2] + radius - lowest[2] > touch.search_depth
    share = robot.spec.mass * GRAVITY / 6
    assert 0.3 * share < plan.contact_load < 2.0 * share


@pytest.mark.parametrize("leg", LEGS)
def test_after_the_step_the_wheel_stands_on_its_footfall_under_the_chassis_that_is_back_up(robot, on, field, leg):
    """Not where the sagged chassis of the swing would have it, which floats by all that the chassis has come up."""
    plan, radius = planned(robot, on(robot, field()), leg=leg), robot.spec.wheel.radius
    axle = plan.preview_world_from_hex[-1].apply(robot.kin.leg_wheel(leg, plan.preview_joints[-1][leg]).translation)
    np.testing.assert_allclose(axle, plan.footfall_in_world + [0.0, 0.0, radius], atol=MILLIMETRE)


@pytest.mark.parametrize("leg", LEGS)
@pytest.mark.slow
def test_a_mirrored_problem_has_the_mirrored_step(robot, on, field, leg):
    nominal = planned(robot, on(robot, field()), leg=leg).footfall_in_world
    rock = (nominal[0] + 0.04, nominal[1] - 0.05, *ROCK[robot.spec.name])
    aside = np.array([np.cos(0.07), np.sin(0.07)])  # off the grid's axes, so that no two places cost the same
    plan = planned(robot, on(robot, field(rock)), leg=leg, heading=aside)
    other_ground = on(robot, field((rock[0], -rock[1], *rock[2:])))
    other = planned(robot, other_ground, leg=mirrored(robot, leg), heading=MIRROR[:2] * aside)
    assert other.footfall_in_world == pytest.approx(MIRROR * plan.footfall_in_world, abs=MILLIMETRE)
    assert other.swing_margin == pytest.approx(plan.swing_margin, abs=MILLIMETRE)
    assert other.landed_margin == pytest.approx(plan.landed_margin, abs=5 * MILLIMETRE)
    # T12's hips differ by 6 mm from one side to the other: there a limit may cut the shift by a quarter more.
    wholes = [p.shift.translation_in_hex / p.shift.fraction for p in (plan, other)]
    assert wholes[1] == pytest.approx(MIRROR * wholes[0], abs=MILLIMETRE)
    assert abs(other.shift.fraction - plan.shift.fraction) <= (0.25 if robot.spec.decks else 0.0)


@pytest.mark.slow
@pytest.mark.ci
def test_a_rock_on_the_gaits_place_is_stepped_beside(robot, on, field):
    free = planned(robot, on(robot, field()), leg=1).footfall_in_world
    ground = on(robot, field((free[0], free[1], *ROCK[robot.spec.name])))
    found = planned(robot, ground, leg=1).footfall_in_world
    ix, iy, _ = ground.footfalls.grid.index(found[None, :2])
    assert ground.footfalls.veto[ix[0], iy[0]] == 0
    assert np.linalg.norm(found[:2] - free[:2]) > ROCK[robot.spec.name][0]
    assert found[2] == pytest.approx(0.0, abs=0.05)
    assert (found[:2] - robot.belief.contacts_in_world[1, :2]) @ AHEAD >= robot.config.step.gait.min_step


def test_no_step_goes_further_than_the_goal(robot, on, field):
    plan = planned(robot, on(robot, field()), leg=1, remaining=0.1)
    assert (plan.footfall_in_world[:2] - robot.belief.contacts_in_world[1, :2]) @ AHEAD < 0.1 + 0.075  # a cell and a half
    assert np.linalg.norm(plan.shift.translation_in_hex[:2]) <= 0.1 + MILLIMETRE


@pytest.mark.slow
@pytest.mark.ci
def test_a_refused_place_is_kept_away_from(robot, on, field):
    ground = on(robot, field())
    first = planned(robot, ground, leg=1).footfall_in_world[:2]
    second = planned(robot, ground, leg=1, refused_xy=first[None]).footfall_in_world[:2]
    assert 0.12 < np.linalg.norm(second - first) < 0.3


def test_the_operators_place_is_taken_where_it_can_be(robot, on, field):
    ground, place = on(robot, field()), robot.belief.contacts_in_world[1, :2] + [0.1, -0.1]
    assert np.linalg.norm(planned(robot, ground, leg=1, footfall_xy=place).footfall_in_world[:2] - place) < 0.075
    beside = search(robot, ground, leg=1, footfall_xy=robot.belief.contacts_in_world[2, :2])
    assert isinstance(beside, NoStep) and beside.refused["near_another_wheel"] > 0
    far = search(robot, ground, leg=1, footfall_xy=np.array([4.0, -2.0]))
    assert isinstance(far, NoStep) and far.reason == "no stable, reachable footfall for leg 2"
    assert far.refused["unreachable"] > 0


def test_ground_that_nobody_saw_is_swung_over_only_without_caution(robot, on, field):
    ground = on(robot, field())
    raised = HeightGrid(origin_x=-4.5, origin_y=-4.5, cell=0.05, heights=ground.heights.heights + 1.0)
    hidden = replace(ground, cautious=raised)
    found = search(robot, hidden)
    assert isinstance(found, NoStep) and found.reason == "no collision-free path for leg 1"
    assert found.refused["path_lift_collides"] == robot.config.step.search.tried
    planned(robot, hidden, cautious=False)


def no_step(robot, ground, **what) -> NoStep:
    found = search(robot, ground, **what)
    assert isinstance(found, NoStep), found
    return found


def test_no_step_says_which_check_refused_how_many(robot, on, field):
    ground, step = on(robot, field()), robot.config.step
    weak = no_step(robot, ground, config=replace(step, search=replace(step.search, max_torque_fraction=0.05)))
    assert weak.reason.startswith("lifting leg 1 asks ") and Counter(weak.refused) == {"torque": 1}
    unknown = replace(ground.heights, heights=np.full(ground.heights.shape, np.nan))
    dark = no_step(robot, on(robot, unknown))
    assert dark.reason == "no allowed footfall for leg 1 near the gait's" and dark.refused["unknown"] > 100
    shaky = no_step(robot, ground, config=replace(step, stability=replace(step.stability, min_margin=2.0)))
    assert shaky.reason == "no stable, reachable footfall for leg 1" and shaky.refused["swing_margin"] > 100


@pytest.mark.slow
@pytest.mark.ci
def test_a_variant_may_refuse_footfalls_that_overload_a_joint(robot, on, field):
    """Between the loads of the best and of the worst footfall a limit refuses some; Pinocchio says that the chosen one keeps it."""
    ground, step, leg = on(robot, field()), robot.config.step, 1

    def limited(fraction):
        config = replace(step, search=replace(step.search, footfall_torque_fraction=fraction))
        return search(robot, ground, leg=leg, config=config)

    def peak(plan):
        joints, hex_from_world = robot.belief.joints.copy(), plan.world_from_hex_swing.inverse()
        down = hex_from_world.rotate(np.array([0.0, 0.0, -GRAVITY]))
        axle = hex_from_world.apply(plan.footfall_in_world + [0.0, 0.0, robot.spec.wheel.radius])
        joints[leg] = leg_ik(robot.spec, leg, axle[None], last_link_in_hex=down)[0][0]
        stances = (np.arange(6) != leg, np.ones(6, dtype=bool))
        return max(peak_torque_fraction(robot.kin, joints, supporting=s, gravity_in_hex=down) for s in stances)

    free = planned(robot, ground, leg=leg)
    chosen = limited(peak(free) - 1e-3)
    assert isinstance(chosen, StepPlan)
    assert peak(chosen) <= peak(free) - 1e-3
    assert np.linalg.norm(chosen.footfall_in_world - free.footfall_in_world) > 0.04
    none = limited(0.05)
    assert isinstance(none, NoStep)
    assert none.reason == "leg 2 reaches no footfall that all joints can carry" and none.refused["footfall_torque"] > 20
    same = limited(10.0)
    np.testing.assert_array_equal(same.footfall_in_world, free.footfall_in_world)


def test_a_lift_beyond_the_legs_reach_is_no_step(robot, on, field):
    found = no_step(robot, on(robot, field()), extra_lift=4.0)
    assert found.reason == "leg 1 cannot lift high enough" and found.refused == {"lift_reach": 1}


@pytest.mark.parametrize("robot", ["sdm_b"], indirect=True)
def test_a_leg_that_the_springs_of_the_others_cannot_spare_is_not_lifted(robot, on, field):
    """Under fourteen tonnes the springs give way so far that the robot tips over."""
    found = no_step(robot, on(robot, field()), payload=1.4e4)
    assert found.reason == "leg 1 cannot be lifted: the springs say tips" and found.refused == {"tips": 1}


def test_unusable_settings_are_refused():
    with pytest.raises(ConfigError, match="step search needs a positive radius"):
        SearchConfig(radius_fraction=0.0)
    with pytest.raises(ConfigError, match=r"footfall_torque_fraction is 0\.0, must be positive"):
        SearchConfig(footfall_torque_fraction=0.0)
    with pytest.raises(ConfigError, match="touchdown 'blind' is not one of guarded"):
        TouchdownConfig(method="blind")
    with pytest.raises(ConfigError, match=r"load_fraction is 2\.0, must be within 0\.1 to 1"):
        TouchdownConfig(load_fraction=2.0)


@pytest.mark.parametrize("wrong, message", [
    ({"heading": np.zeros(2)}, "has length 0, must be 1"),
    ({"heading": np.array([np.nan, 1.0])}, "has length nan, must be 1"),
    ({"heading": np.array([3.0, 4.0])}, "has length 5, must be 1"),
    ({"remaining": np.nan}, "remaining way is nan m, must be finite"),
    ({"remaining": -1.0}, "remaining way is -1.0 m, must be finite and not negative"),
])  # fmt: skip
def test_a_way_that_is_none_is_refused(wrong, message):
    with pytest.raises(PlanningError, match=message):
        StepRequest(**({"leg": 0, "heading": AHEAD, "remaining": 1.0} | wrong))
