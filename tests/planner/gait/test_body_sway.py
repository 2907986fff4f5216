"""Sway between steps: less torque for the swing that comes next, the footfalls where the straight gait has them."""

from dataclasses import replace

import numpy as np
import pytest

from athlete_twin.errors import ConfigError
from athlete_twin.geometry.polygon import conservative_distance
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.reach import all_legs_ik
from athlete_twin.model.statics import peak_torque_fraction
from planner.gait.body_sway import BodySwayConfig, NextSwing, best_sway, swing_fractions
from planner.gait.shift import NextLift, plan_shift
from planner.gait.skeleton import nominal_footfall
from planner.gait.step_plan import BodyShift, StepPlan
from planner.gait.step_search import StepRequest, on_path, search_step

AHEAD = np.array([1.0, 0.0])
DOWN = np.array([0.0, 0.0, -1.0])
MILLIMETRE = 1e-3
NEXT = 2
COMING = NextLift(leg=NEXT, load_change=np.zeros(6), height=0.0)
SWAY = BodySwayConfig()


def shift(robot, grid, *, remaining: float = 10.0, **what) -> BodyShift:
    step, belief = robot.config.step, robot.belief
    settings = {"upcoming": COMING, "sway": SWAY, "swayed": np.zeros(3), "limits": step.shift, "stability": step.stability} | what
    return plan_shift(
        robot.kin, belief, leg=0, landed_joints=belief.joints, contacts_in_world=belief.contacts_in_world,
        heading=AHEAD, remaining=remaining, behind=0.0, filled=grid, gait=step.gait, collision=step.collision, payload_kg=0.0, **settings,
    )  # fmt: skip


def end_of(robot, made: BodyShift) -> SE3:
    return robot.belief.world_from_hex.compose(SE3.from_rotvec(made.rotvec_in_hex, made.translation_in_hex))


def torque(robot, pose: SE3, wheels_in_world: np.ndarray, lifted: int) -> float:
    """Peak torque fraction with a leg lifted, by Pinocchio."""
    joints, ok = all_legs_ik(robot.spec, pose.inverse().apply(wheels_in_world), last_link_in_hex=pose.inverse().rotate(DOWN))
    assert ok.all()
    gravity = 9.80665 * pose.inverse().rotate(DOWN)
    return peak_torque_fraction(robot.kin, joints, supporting=np.arange(6) != lifted, gravity_in_hex=gravity)


def swing_of(robot, path: SE3) -> NextSwing:
    place = nominal_footfall(robot.spec, robot.config.step.gait, leg=NEXT, world_from_hex=path, heading=AHEAD, remaining=10.0)
    wheels = robot.belief.world_from_hex.apply(robot.kin.wheels_in_hex(robot.belief.joints))
    return NextSwing(axles_in_world=wheels, leg=NEXT, goal_in_world=np.append(place, robot.spec.wheel.radius))


def test_a_shift_with_sway_asks_less_of_the_joints_than_the_straight_one_by_another_reckoning(robot, field):
    straight, swayed = shift(robot, field(), sway=None, swayed=None), shift(robot, field())
    assert swayed.sway_in_hex.any() and not straight.sway_in_hex.any()
    ends = [end_of(robot, made) for made in (straight, swayed)]
    swing = swing_of(robot, ends[0])
    peaks = []
    for end in ends:
        over = swing.axles_in_world.copy()
        over[NEXT] = swing.goal_in_world + [0.0, 0.0, robot.spec.wheel.radius]
        peaks.append(max(torque(robot, end, swing.axles_in_world, NEXT), torque(robot, end, over, NEXT)))
    assert peaks[1] < 0.97 * peaks[0]
    # The rest of the shift is the straight one's.
    start = robot.belief.world_from_hex
    moved = ends[1].translation - start.rotate(swayed.sway_in_hex)
    assert moved == pytest.approx(ends[0].translation, abs=MILLIMETRE)
    assert swayed.rotvec_in_hex == pytest.approx(straight.rotvec_in_hex)


def test_a_swayed_chassis_stays_within_span_rule_and_clearance(robot, field):
    made = shift(robot, field())
    end, limit = end_of(robot, made), SWAY.span * robot.spec.chassis_height + MILLIMETRE
    assert np.abs(made.sway_in_hex).max() <= limit
    wheels = robot.belief.world_from_hex.apply(robot.kin.wheels_in_hex(robot.belief.joints))
    joints, ok = all_legs_ik(robot.spec, end.inverse().apply(wheels), last_link_in_hex=end.inverse().rotate(DOWN))
    assert ok.all()
    com = end.apply(robot.kin.com_in_hex(joints))[:2]
    assert conservative_distance(com, robot.belief.contacts_in_world[:, :2]) >= robot.config.step.stability.min_margin


def test_fractions_are_those_of_pinocchios_statics(robot):
    path = robot.belief.world_from_hex
    swing, lift = swing_of(robot, path), 0.2
    for displacement in (np.zeros(3), np.array([0.05, -0.04, 0.06])):
        (found,) = swing_fractions(robot.spec, path, displacement[None], swing, lift=lift, min_margin=0.0, payload_kg=0.0)
        pose = SE3(path.rotation, path.translation + displacement)
        after = swing.axles_in_world.copy()
        after[NEXT] = swing.goal_in_world
        moments = [torque(robot, pose, wheels, -1) for wheels in (swing.axles_in_world, after)]
        for share in (0.0, 0.5, 1.0):
            over = swing.axles_in_world + share * (after - swing.axles_in_world)
            over[NEXT, 2] = lift + max(swing.axles_in_world[NEXT, 2], after[NEXT, 2])
            moments.append(torque(robot, pose, over, NEXT))
        assert found == pytest.approx(max(moments), rel=1e-3)


def test_where_the_rule_allows_no_place_the_chassis_stays_on_its_path(robot):
    path = robot.belief.world_from_hex
    wish = best_sway(robot.spec, path, swing_of(robot, path), present=np.zeros(3), config=SWAY, min_margin=9.0, payload_kg=0.0)
    np.testing.assert_array_equal(wish, np.zeros(3))


@pytest.mark.parametrize("last", [{"remaining": 0.1}, {"upcoming": None}, {"sway": None}])
def test_the_last_shift_and_one_before_an_unknown_step_bring_the_chassis_back_to_its_path(robot, field, last):
    off = np.array([0.03, -0.05, 0.04])
    back = shift(robot, field(), swayed=off, **last)
    assert robot.belief.world_from_hex.rotate(back.sway_in_hex) == pytest.approx(-off, abs=MILLIMETRE)


@pytest.mark.slow
@pytest.mark.ci
def test_footfalls_lie_about_the_path_wherever_the_chassis_sways(robot, on, field):
    ground, off = on(robot, field()), np.array([0.08, -0.06, 0.05])
    step = replace(robot.config.step, sway=SWAY)

    def footfall(belief, swayed) -> np.ndarray:
        found = search_step(
            robot.kin, robot.springs, belief, ground, StepRequest(leg=0, heading=AHEAD, remaining=10.0, swayed=swayed),
            config=step, payload_kg=0.0, rng=np.random.default_rng(0),
        )  # fmt: skip
        assert isinstance(found, StepPlan), found
        return found.footfall_in_world[:2]

    pose = robot.belief.world_from_hex
    moved = SE3(pose.rotation, pose.translation + off)
    joints, ok = all_legs_ik(robot.spec, moved.inverse().apply(pose.apply(robot.kin.wheels_in_hex(robot.belief.joints))))
    assert ok.all()
    beside = replace(robot.belief, world_from_hex=moved, joints=joints, motors=joints)
    assert on_path(beside, off).translation == pytest.approx(pose.translation)
    np.testing.assert_allclose(footfall(beside, off), footfall(robot.belief, np.zeros(3)), atol=1e-6)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"span": 0.9}, r"span 0.9, down 0.03 and lift 1.0 must be within 0 to 0.5, 0 to 0.5, from 0"),
        ({"points": 4}, "points is 4, need an odd number from 3"),
        ({"shrink": 1.0}, "shrink 1.0 must be within 0 to 1, resolution positive, slack not negative"),
    ],
)
def test_settings_out_of_bounds_are_refused(settings, message):
    with pytest.raises(ConfigError, match=message):
        BodySwayConfig(**settings)
