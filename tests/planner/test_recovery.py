"""What a fault changes about the next attempt."""

import numpy as np
import pytest

from athlete_twin.messages import Fault, JointMove
from athlete_twin.model.kinematics import kinematics
from athlete_twin.model.stance import regular_stance
from planner.gait.step_plan import StepPlan
from planner.recovery import MAX_EXTRA_LIFT, Recovery, way_back
from planner.sequence import straighten_commands

PATH = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [2.0, 1.0]])


def fault(code: str) -> Fault:
    return Fault(seq=0, robot_id="sdm_b", t=1.0, code=code, text=code, sequence_id=1, command_index=1, leg=2)


@pytest.fixture
def plan() -> StepPlan:
    step = object.__new__(StepPlan)  # only the two fields that recovery reads
    object.__setattr__(step, "swing", PATH)
    object.__setattr__(step, "footfall_in_world", np.array([2.0, 1.0, 0.1]))
    return step


@pytest.mark.parametrize(
    "stopped_at, passed",
    [([0.4, 0.0], 1), ([1.02, 0.5], 2), ([1.6, 1.0], 3), ([-0.1, 0.0], 1), ([2.0, 1.0], 3)],
)
def test_the_way_back_passes_what_was_passed_in_reverse(stopped_at, passed):
    np.testing.assert_array_equal(way_back(PATH, np.array(stopped_at)), PATH[:passed][::-1])


def test_a_path_of_one_point_leads_back_to_it():
    np.testing.assert_array_equal(way_back(PATH[:1], np.array([5.0, 5.0])), PATH[:1])


def test_a_struck_wheel_goes_back_and_steps_elsewhere(plan):
    recovery = Recovery()
    recovery.fault(fault("swing_contact"), plan, np.array([1.0, 0.5]))
    np.testing.assert_array_equal(recovery.retreat, [[1.0, 0.0], [0.0, 0.0]])
    np.testing.assert_array_equal(recovery.refused_xy, [[2.0, 1.0]])
    assert recovery.extra_lift == 0.0


def test_a_wheel_that_kept_its_load_is_lifted_higher_but_not_for_ever(plan):
    recovery, lifts = Recovery(), []
    for _ in range(5):
        recovery.fault(fault("contact_not_broken"), plan, PATH[0])
        lifts.append(recovery.extra_lift)
    assert lifts == sorted(lifts)
    assert lifts[-1] == MAX_EXTRA_LIFT
    assert len(recovery.refused_xy) == 0


def test_a_wheel_without_ground_goes_down_twice_and_then_elsewhere(plan):
    recovery = Recovery()
    lowers = []
    for _ in range(3):
        recovery.fault(fault("no_contact"), plan, PATH[0])
        lowers.append(recovery.lowers)
        assert len(recovery.refused_xy) == (0 if lowers[-1] else 1)
    assert lowers == [True, True, False]


def test_after_a_gear_has_slipped_or_a_fault_nobody_has_heard_of_the_wheel_steps_elsewhere(plan):
    for code in ("ratchet_slip", "gremlins"):
        recovery = Recovery()
        recovery.fault(fault(code), plan, PATH[0])
        np.testing.assert_array_equal(recovery.refused_xy, [[2.0, 1.0]])
        assert recovery.retreat is None and not recovery.exhausted


def test_the_ground_gives_up_at_the_sixth_fault_and_starts_afresh_after_a_step(plan):
    recovery = Recovery()
    for _ in range(6):
        assert not recovery.exhausted
        recovery.fault(fault("torque_limit"), plan, PATH[0])
    assert recovery.exhausted
    recovery.reset()
    assert recovery == Recovery()


@pytest.mark.parametrize("robot", ["sdm_b", "t12"])
def test_a_leg_with_turned_rolls_is_straightened_where_its_wheel_is_before_it_goes_down(robot):
    kin, down = kinematics(robot), np.array([0.0, 0.0, -1.0])
    straight = regular_stance(kin.spec)[5]
    assert straighten_commands(kin, 5, straight, down, tolerance=0.03) == []
    turned = straight + np.deg2rad(9.0) * np.array([np.argmax(np.abs(j.axis)) == 0 for j in kin.spec.joints])
    (move,) = straighten_commands(kin, 5, turned, down, tolerance=0.03)
    assert isinstance(move, JointMove) and move.leg == 5
    (q,) = move.waypoints
    np.testing.assert_allclose(kin.leg_wheel(5, q).translation, kin.leg_wheel(5, turned).translation, atol=1e-6)
    np.testing.assert_allclose(kin.leg_wheel(5, q).rotation[:, 0], down, atol=1e-6)
    assert straighten_commands(kin, 5, q, down, tolerance=0.03) == []
