"""The chassis shift after a step: towards the goal, and never beyond reach, the stability rule or what stands in its way."""

from dataclasses import replace

import numpy as np
import pytest

from athlete_twin.geometry.polygon import conservative_distance, signed_distance
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.reach import all_legs_ik, leg_ik
from planner.gait.relax import RelaxConfig
from planner.gait.shift import LIFT_SPARE, NextLift, plan_shift
from planner.gait.skeleton import shift_per_step
from planner.gait.step_plan import BodyShift
from planner.motion.collision import BodyCollision

AHEAD = np.array([1.0, 0.0])
DOWN = np.array([0.0, 0.0, -1.0])
MILLIMETRE = 1e-3


def shift(robot, grid, *, belief=None, next_leg=None, next_change=None, next_height=0.0, **what) -> BodyShift:
    belief, step = belief or robot.belief, robot.config.step
    change = np.zeros(6) if next_change is None else next_change
    upcoming = None if next_leg is None else NextLift(leg=next_leg, load_change=change, height=next_height)
    settings = {
        "leg": 0, "heading": AHEAD, "remaining": 10.0, "behind": 0.0,
        "stability": step.stability, "limits": step.shift, "collision": step.collision,
    } | what  # fmt: skip
    settings["heading"] = np.asarray(settings["heading"])
    return plan_shift(
        robot.kin, belief, landed_joints=belief.joints, contacts_in_world=belief.contacts_in_world, filled=grid, gait=step.gait,
        payload_kg=0.0, upcoming=upcoming, **settings,
    )  # fmt: skip


def end_of(robot, made: BodyShift, belief=None) -> SE3:
    pose = (belief or robot.belief).world_from_hex
    return pose.compose(SE3.from_rotvec(made.rotvec_in_hex, made.translation_in_hex))


def margins_at(robot, pose: SE3) -> tuple[float, float]:
    """CPS margin, and the least support margin with one leg lifted [m], the wheels where they are."""
    belief = robot.belief
    wheels = pose.inverse().apply(belief.world_from_hex.apply(robot.kin.wheels_in_hex(belief.joints)))
    joints, ok = all_legs_ik(robot.spec, wheels, last_link_in_hex=pose.inverse().rotate(DOWN))
    assert ok.all()
    com, contacts = pose.apply(robot.kin.com_in_hex(joints))[:2], belief.contacts_in_world[:, :2]
    return conservative_distance(com, contacts), min(signed_distance(com, np.delete(contacts, k, axis=0)) for k in range(6))


@pytest.mark.parametrize("heading_deg", [0.0, 50.0, -135.0])
def test_on_open_ground_the_chassis_goes_its_share_of_a_stride_and_stays_inside_the_rule(robot, field, heading_deg):
    heading = np.array([np.cos(np.deg2rad(heading_deg)), np.sin(np.deg2rad(heading_deg))])
    made = shift(robot, field(), heading=heading)
    assert (made.fraction, made.cut_by) == (1.0, "")
    moved = end_of(robot, made).translation - robot.belief.world_from_hex.translation
    assert moved[:2] == pytest.approx(robot.spec.stride / 6 * heading, abs=MILLIMETRE)
    assert min(margins_at(robot, end_of(robot, made))) >= robot.config.step.stability.min_margin


def test_the_shift_ends_at_the_goal_and_makes_up_for_lost_ground(robot, field):
    assert np.linalg.norm(shift(robot, field(), remaining=0.03).translation_in_hex[:2]) == pytest.approx(0.03, abs=MILLIMETRE)
    wanted = shift_per_step(robot.spec, robot.config.step.gait, remaining=10.0, behind=0.04)
    assert np.linalg.norm(shift(robot, field(), behind=0.04).translation_in_hex[:2]) == pytest.approx(wanted, abs=MILLIMETRE)


def test_a_shift_is_shortened_until_the_rule_holds(robot, field):
    """The rule is set to what holds half-way between half and three quarters of the shift."""
    whole = end_of(robot, shift(robot, field())).translation - robot.belief.world_from_hex.translation
    between = SE3(robot.belief.world_from_hex.rotation, robot.belief.world_from_hex.translation + 0.625 * whole)
    strict = replace(robot.config.step.stability, min_margin=margins_at(robot, between)[0])
    made = shift(robot, field(), stability=strict)
    assert (made.fraction, made.cut_by) == (0.5, "CPS margin")
    assert margins_at(robot, end_of(robot, made))[0] >= strict.min_margin


def test_where_the_stance_itself_breaks_the_rule_nothing_moves(robot, field):
    made = shift(robot, field(), stability=replace(robot.config.step.stability, min_margin=5.0))
    assert (made.fraction, made.cut_by) == (0.0, "CPS margin")
    assert not made.translation_in_hex.any() and not made.rotvec_in_hex.any() and not made.wheel_offsets_in_hex.any()


def test_a_shift_out_of_reach_names_the_leg(robot, field):
    """A heading of twelve times its length stands for a giant's stride."""
    made = shift(robot, field(), heading=12.0 * AHEAD)
    assert made.cut_by.startswith("reach of leg ") and made.fraction < 1.0


def test_a_rock_in_front_of_the_chassis_cuts_the_shift(robot, field):
    """A pillar beside the foremost part of the chassis: what would touch it is named."""
    if robot.spec.decks:
        deck = robot.spec.decks[0].part
        front = deck.centre[:2] + [0.5 * deck.size[0], 0.0]
    else:
        front = 1.19 * np.array([np.cos(np.pi / 6), np.sin(np.pi / 6)])  # a face of the ring between legs 1 and 2
    outward = front / np.linalg.norm(front) if not robot.spec.decks else AHEAD
    made = shift(robot, field((*(front + (0.29 + 0.06) * outward), 0.30, 6.0)))
    assert made.fraction < 1.0
    assert made.cut_by and "margin" not in made.cut_by and "reach" not in made.cut_by


def test_a_mirrored_heading_has_the_mirrored_shift(robot, field):
    left, right = (shift(robot, field(), heading=np.array([0.8, side])) for side in (0.6, -0.6))
    assert right.translation_in_hex == pytest.approx([1.0, -1.0, 1.0] * left.translation_in_hex, abs=MILLIMETRE)
    assert right.fraction == left.fraction


@pytest.mark.parametrize(("low", "mended"), [(0.03, 0.03), (0.10, 0.06)])
def test_height_is_mended_by_what_the_motors_say_within_its_limit(robot, field, low, mended):
    wheels = robot.kin.wheels_in_hex(robot.belief.motors) + [0.0, 0.0, low]
    motors, ok = all_legs_ik(robot.spec, wheels)
    assert ok.all() and robot.config.step.shift.max_height == 0.06
    made = shift(robot, field(), belief=replace(robot.belief, motors=motors))
    assert made.translation_in_hex[2] == pytest.approx(mended, abs=MILLIMETRE)


def test_attitude_is_mended_within_its_limits(robot, field):
    pose, limits = robot.belief.world_from_hex, robot.config.step.shift
    tilted = SE3(SE3.from_rpy(0.02, -0.01, 0.02).rotation, pose.translation)
    belief = replace(robot.belief, world_from_hex=tilted)
    end = end_of(robot, shift(robot, field(), belief=belief), belief)
    assert np.linalg.norm(end.rpy()[:2]) <= np.deg2rad(limits.level_deck_deg) + MILLIMETRE
    assert end.rpy()[2] == pytest.approx(0.0, abs=MILLIMETRE)
    far = replace(robot.belief, world_from_hex=SE3(SE3.from_rpy(0.06, 0.0, 0.06).rotation, pose.translation))
    made = shift(robot, field(), belief=far)
    turned = end_of(robot, made, far).rpy()
    assert turned[0] == pytest.approx(0.06 - limits.max_tilt, abs=2e-3)
    assert turned[2] == pytest.approx(0.06 - limits.max_yaw, abs=2e-3)


def test_an_offset_beyond_reach_is_shortened_until_the_leg_reaches(robot, field):
    """Its wheel would go sideways by more than the stance leaves it; as much of that as the leg reaches is taken back."""
    push = np.zeros((6, 3))
    outward = robot.kin.wheels_in_hex(robot.belief.joints)[1] * [1.0, 1.0, 0.0]
    push[1] = 1e6 * outward / np.linalg.norm(outward)
    belief = replace(robot.belief, interaction=push)
    far = 0.5
    limits = replace(robot.config.step.shift, relax=RelaxConfig(max_offset=far))
    made = shift(robot, field(), belief=belief, limits=limits, remaining=0.0)
    end = end_of(robot, made, belief)
    wheels = end.inverse().apply(belief.world_from_hex.apply(robot.kin.wheels_in_hex(belief.motors)))
    _, ok = all_legs_ik(robot.spec, wheels + made.wheel_offsets_in_hex, last_link_in_hex=end.inverse().rotate(DOWN))
    assert ok.all()
    taken = np.linalg.norm(made.wheel_offsets_in_hex[1]) / far
    assert any(taken == pytest.approx(share, abs=1e-6) for share in (0.0, 0.25, 0.5, 0.75, 1.0))


LONG = 0.4
"""of a shift that takes a leg its room [m]"""


def over_a_foot(robot, by: float):
    """A leg, the way to its foot, and the belief with the chassis farther on that way [m], the feet as they are.

    Above SDM-B's feet a leg cannot fold enough; T12's, whose hips are 2 m higher, cannot reach all the way through the heights there.
    """
    leg, way = (0, AHEAD) if robot.spec.name == "sdm_b" else (1, np.array([0.0, 1.0]))
    belief, start = robot.belief, robot.belief.world_from_hex
    pose = SE3(start.rotation, start.translation + np.append(by * way, 0.0))
    joints, ok = all_legs_ik(robot.spec, pose.inverse().apply(start.apply(robot.kin.wheels_in_hex(belief.joints))))
    assert ok.all()
    return leg, way, replace(belief, world_from_hex=pose, joints=joints, motors=joints)


def long_shift(robot, grid, belief, leg: int, way, **what) -> BodyShift:
    """A shift of `LONG`, whatever it asks of the joints."""
    limits = replace(robot.config.step.shift, max_torque_fraction=9.0)
    return shift(robot, grid, belief=belief, next_leg=leg, heading=6.0 * LONG / robot.spec.stride * way, limits=limits, **what)


def test_the_chassis_does_not_go_on_over_a_leg_until_that_cannot_be_lifted(robot, field):
    """What its wheel can rise half-way between half and three quarters of the shift is asked of it."""
    leg, way, start = over_a_foot(robot, 0.0)
    room = [_room_above(robot, leg, over_a_foot(robot, share * LONG)[2].world_from_hex) for share in (0.0, 0.625, 1.0)]
    assert room[0] > room[1] > room[2] > LIFT_SPARE and long_shift(robot, field(), start, leg, way).fraction == 1.0
    made = long_shift(robot, field(), start, leg, way, next_height=room[1] - LIFT_SPARE)
    assert (made.fraction, made.cut_by) == (0.5, f"lift of leg {leg + 1}")
    stuck = long_shift(robot, field(), start, leg, way, next_height=room[0] + 0.1)
    assert (stuck.fraction, stuck.cut_by) == (0.0, f"lift of leg {leg + 1}")


def test_a_leg_that_cannot_be_lifted_yet_does_not_hold_the_chassis_where_going_on_frees_it(robot, field):
    leg, way, late = over_a_foot(robot, LONG)
    made = long_shift(robot, field(), late, leg, -way, next_height=_room_above(robot, leg, robot.belief.world_from_hex) + 0.2)
    assert (made.fraction, made.cut_by) == (1.0, "")


@pytest.mark.parametrize("robot", ["t12"], indirect=True)
def test_a_leg_folded_into_its_own_clearance_forbids_no_move_out_of_it(robot, field):
    """T12's foot 1 drawn in until two of its links are too near to each other; one way the next move parts them, one it does not."""
    body, wheels = BodyCollision(robot.spec, field(), robot.config.step.collision), robot.kin.wheels_in_hex(robot.belief.joints)
    inward = (robot.spec.hips_in_hex[0] - wheels[0]) * [1.0, 1.0, 0.0]
    inward /= np.linalg.norm(inward)

    def drawn_in(by: float) -> np.ndarray:
        joints, ok = all_legs_ik(robot.spec, wheels + by * inward * (np.arange(6) == 0)[:, None])
        assert ok.all()
        return joints

    by = next(by for by in np.arange(0.0, 1.2, 0.005) if body.first_collision(drawn_in(by), robot.belief.world_from_hex))
    joints, contacts = drawn_in(by), robot.belief.contacts_in_world.copy()
    contacts[0] += by * inward
    pair = body.first_collision(joints, robot.belief.world_from_hex)
    assert pair == "leg1_hip_pitch against leg1_knee_pitch"
    belief = replace(robot.belief, motors=joints, joints=joints, contacts_in_world=contacts)
    out, further = (shift(robot, field(), belief=belief, leg=1, heading=side * inward[:2]) for side in (1.0, -1.0))
    assert (out.fraction, out.cut_by) == (1.0, "") and further.fraction < 1.0


def _room_above(robot, leg: int, pose: SE3) -> float:
    """By how much the leg can raise its wheel straight up from where it stands, the chassis at `pose` [m], within 2 mm."""
    wheel = robot.belief.world_from_hex.apply(robot.kin.wheels_in_hex(robot.belief.joints))[leg]
    heights = np.arange(0.0, 4.0, 0.002)
    axles = pose.inverse().apply(wheel - heights[:, None] * DOWN)
    _, ok = leg_ik(robot.spec, leg, axles, last_link_in_hex=pose.inverse().rotate(DOWN))
    return float(heights[np.argmin(ok) - 1])
