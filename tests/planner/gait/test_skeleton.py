"""The skeleton gait: order, strides, and that on open ground it becomes periodic."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from athlete_twin.errors import ConfigError
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.spec import load_spec
from planner.gait.skeleton import GaitConfig, nominal_footfall, regular_places, reverse_wave, shift_per_step, stride

AHEAD = np.array([1.0, 0.0])


@pytest.mark.parametrize(("robot", "order"), [("sdm_b", [1, 2, 3, 4, 6, 5]), ("t12", [1, 2, 3, 6, 5, 4])])
def test_reverse_wave_goes_front_to_rear_left_side_first(robot, order):
    """[SunSpiral2012] s5.3.1; SDM-B's legs 1 and 4 lie on the line of travel and count as left (robot facts 12a)."""
    assert [leg + 1 for leg in reverse_wave(load_spec(robot), AHEAD)] == order


@given(st.floats(-np.pi, np.pi))
def test_every_heading_steps_every_leg_once(angle):
    order = reverse_wave(load_spec("sdm_b"), np.array([np.cos(angle), np.sin(angle)]))
    assert sorted(order) == list(range(6))


@pytest.mark.parametrize("robot", ["sdm_b", "t12"])
def test_on_open_ground_steps_and_shifts_are_alike_from_the_second_cycle_on(robot):
    """[SunSpiral2012] s5.3.1: periodic after the second cycle; here from the second one."""
    spec, config = load_spec(robot), GaitConfig()
    pose = SE3.from_translation(np.array([0.0, 0.0, spec.chassis_height]))
    feet, steps = regular_places(spec, pose), []
    for _cycle in range(4):
        for leg in reverse_wave(spec, AHEAD):
            target = nominal_footfall(spec, config, leg=leg, world_from_hex=pose, heading=AHEAD, remaining=50.0)
            steps.append(float(np.linalg.norm(target - feet[leg])))
            feet[leg] = target
            advance = shift_per_step(spec, config, remaining=50.0, behind=0.0)
            pose = SE3(pose.rotation, pose.translation + np.array([advance, 0.0, 0.0]))
    later = np.array(steps[6:])
    assert later == pytest.approx(np.full(len(later), spec.stride), abs=1e-9)
    assert pose.translation[0] == pytest.approx(4 * stride(spec, config))


def test_t12_advances_as_the_field_test_did():
    """[SunSpiral2012] s6: about a third of a body length a cycle: 1.2-1.4 m (robot facts 10, item 8)."""
    assert 1.2 <= stride(load_spec("t12"), GaitConfig()) <= 1.4


def test_shifts_end_at_the_goal_and_make_up_for_lost_ground_by_halves():
    spec, config = load_spec("sdm_b"), GaitConfig()
    assert shift_per_step(spec, config, remaining=0.03, behind=0.0) == 0.03
    assert shift_per_step(spec, config, remaining=9.0, behind=0.02) == pytest.approx(0.12)
    assert shift_per_step(spec, config, remaining=9.0, behind=9.0) == pytest.approx(0.15)


def test_places_turn_with_the_chassis():
    spec = load_spec("sdm_b")
    turned = SE3.from_rpy(0.0, 0.0, 0.3, np.array([1.0, 2.0, 1.75]))
    c, s = np.cos(0.3), np.sin(0.3)
    straight = regular_places(spec, SE3.identity())
    assert regular_places(spec, turned) == pytest.approx(straight @ np.array([[c, s], [-s, c]]) + [1.0, 2.0])


def test_a_silly_gait_is_refused():
    with pytest.raises(ConfigError, match="gait 'tripod' is not one of reverse_wave"):
        GaitConfig(method="tripod")
    with pytest.raises(ConfigError, match="stride_fraction is 9"):
        GaitConfig(stride_fraction=9.0)
