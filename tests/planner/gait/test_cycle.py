"""One period of the regular gait: it repeats itself, its limits end where its judge says no, and swaying leaves its footfalls."""

import numpy as np
import pytest

from athlete_twin.errors import PlanningError
from athlete_twin.model.kinematics import kinematics
from athlete_twin.model.reach import all_legs_ik
from athlete_twin.model.spec import load_spec
from athlete_twin.model.stance import stance_wheels_in_hex
from athlete_twin.model.statics import peak_torque_fraction
from planner.gait.cycle import SWING, gait_cycle, judge_cycle
from planner.gait.limits import STRIDE_DIGIT, footing_on, longest_stride, steepest_slope
from planner.gait.skeleton import reverse_wave
from planner.gait.sway import NoSway, SwayConfig, SwayGait, best_constant_pose, phase_fractions, sway_gait
from planner.stability.rigid_stance import Footing

AHEAD = np.array([1.0, 0.0])
PAIRS = ((0, 3), (1, 4), (2, 5))
DOWN = np.array([0.0, 0.0, -1.0])


@pytest.fixture(params=["sdm_b", "t12"])
def spec(request):
    return load_spec(request.param)


def _heading(degrees):
    return np.array([np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))])


@pytest.mark.parametrize("groups", [None, PAIRS], ids=["wave", "pairs"])
@pytest.mark.parametrize("degrees", [0.0, 75.0, -130.0])
def test_the_cycle_ends_as_it_began_one_stride_further(spec, degrees, groups):
    cycle = gait_cycle(spec, _heading(degrees), stride=spec.stride, groups=groups)
    assert cycle.groups == (groups or tuple((leg,) for leg in reverse_wave(spec, _heading(degrees))))
    np.testing.assert_allclose(cycle.goal[-1], cycle.start[0] + cycle.advance, atol=1e-12)
    np.testing.assert_allclose(cycle.goal[:-1], cycle.start[1:])
    np.testing.assert_allclose(cycle.advance, [*(spec.stride * _heading(degrees)), 0.0])
    # At its turn a foot is half a stride behind its regular place, and steps to half a stride ahead of it.
    regular = stance_wheels_in_hex(spec) + [0.0, 0.0, spec.chassis_height]
    for phase, group in enumerate(cycle.groups):
        for leg in group:
            under = cycle.start[phase, leg] - cycle.chassis[phase] + [0.0, 0.0, spec.chassis_height]
            np.testing.assert_allclose(under, regular[leg] - 0.5 * cycle.advance, atol=1e-12)


def test_the_judge_says_what_pinocchio_says_of_the_middle_of_a_swing(spec):
    kin, cycle = kinematics(spec.name), gait_cycle(spec, AHEAD, stride=spec.stride)
    verdict = judge_cycle(cycle)
    for phase in range(cycle.phases):
        worst = 0.0
        for axles in cycle.swing_axles(phase):
            joints, reaches = all_legs_ik(spec, axles - cycle.chassis[phase], last_link_in_hex=DOWN)
            assert reaches.all()
            worst = max(worst, peak_torque_fraction(kin, joints, supporting=cycle.standing(phase)))
        assert verdict.phase_peaks()[phase] == pytest.approx(worst, abs=1e-9)
    assert verdict.swinging.sum() == len(SWING) * cycle.phases
    assert verdict.refusal(spec) == ""


@pytest.mark.slow
@pytest.mark.ci
def test_the_longest_stride_passes_and_a_little_more_does_not(spec):
    found = longest_stride(spec, AHEAD)
    assert found.value > spec.stride and found.ended_by
    assert judge_cycle(gait_cycle(spec, AHEAD, stride=found.value)).refusal(spec) == ""
    assert judge_cycle(gait_cycle(spec, AHEAD, stride=found.value + STRIDE_DIGIT)).refusal(spec)


@pytest.mark.slow
def test_symmetric_headings_stride_alike():
    spec = load_spec("sdm_b")
    strides = [longest_stride(spec, _heading(d)).value for d in (0.0, 60.0, 120.0, 180.0, 240.0, 300.0)]
    np.testing.assert_allclose(strides, strides[0], atol=STRIDE_DIGIT)


@pytest.mark.parametrize("deck", ["level", "parallel"])
@pytest.mark.slow
@pytest.mark.ci
def test_the_steepest_slope_passes_and_a_steeper_one_does_not(spec, deck):
    found = steepest_slope(spec, AHEAD, stride=0.5 * spec.stride, deck=deck)
    assert np.deg2rad(2.0) < found.value < np.deg2rad(45.0)

    def judged(angle):
        return judge_cycle(gait_cycle(spec, AHEAD, stride=0.5 * spec.stride, footing=footing_on(angle, AHEAD, deck=deck)))

    assert judged(found.value).refusal(spec) == ""
    assert judged(found.value + np.deg2rad(0.2)).refusal(spec)


def test_a_parallel_deck_sees_a_slope_as_gravity_leaning_downhill():
    angle = np.deg2rad(10.0)
    level, parallel = footing_on(angle, AHEAD, deck="level"), footing_on(angle, AHEAD, deck="parallel")
    # Uphill is +x: the ground rises there, and what stands on it is pulled to -x.
    assert level.normal[0] < 0.0 < parallel.up[0]
    assert level.normal[0] == pytest.approx(-np.sin(angle)) and parallel.up[0] == pytest.approx(np.sin(angle))
    np.testing.assert_array_equal(parallel.normal, Footing().normal)
    assert gait_cycle(load_spec("sdm_b"), AHEAD, stride=0.6, footing=level).advance[2] == pytest.approx(0.6 * np.sin(angle))


@pytest.mark.slow
@pytest.mark.ci
def test_swaying_leaves_the_footfalls_keeps_the_rule_and_gains_a_fifth_on_the_reference():
    """[SunSpiral2012] s5.3.2: over 20 % more margin to saturation; robot facts 12a fix stance and stride."""
    spec = load_spec("sdm_b")
    cycle = gait_cycle(spec, AHEAD, stride=0.6, foot_radius=1.793, chassis_height=1.75)
    found = sway_gait(cycle, SwayConfig(resolution=0.01))
    assert isinstance(found, SwayGait)
    assert found.cycle is cycle
    assert found.gain >= 0.2
    assert found.sway.refusal(spec) == "" and found.sway.peak < found.reference.peak
    assert found.sway.swing_margin >= spec.min_support_margin
    # The search is a grid's; chance finds nothing better.
    rng = np.random.default_rng(3)
    drawn = rng.uniform(-0.35, 0.35, (300, 3)) * spec.chassis_height
    worst = max(range(cycle.phases), key=lambda k: found.sway.phase_peaks()[k])
    assert phase_fractions(cycle, worst, drawn).min() >= found.sway.peak - 0.01


def test_where_no_place_will_do_the_sway_says_which_phase():
    spec = load_spec("sdm_b")
    found = sway_gait(gait_cycle(spec, AHEAD, stride=4.0), SwayConfig(resolution=0.05))
    assert isinstance(found, NoSway) and found.reason.startswith("no place of the chassis in phase 1")


@pytest.mark.slow
def test_the_best_constant_pose_beats_the_drawings_own(spec):
    config = SwayConfig(points=3, resolution=0.1)
    found = best_constant_pose(spec, AHEAD, stride=spec.stride, config=config)
    assert found.verdict.peak <= judge_cycle(gait_cycle(spec, AHEAD, stride=spec.stride)).peak
    assert found.verdict.refusal(spec) == ""


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda s: gait_cycle(s, AHEAD, stride=0.5, groups=((0, 1), (2, 3))), "must hold each leg"),
        (lambda s: gait_cycle(s, AHEAD, stride=np.nan), "stride is nan m"),
        (lambda s: gait_cycle(s, np.zeros(2), stride=0.5), "has length 0, must be 1"),
        (lambda s: footing_on(0.1, AHEAD, deck="tilted"), "is not one of level, parallel"),
        (lambda s: footing_on(np.nan, AHEAD, deck="level"), "slope is nan deg"),
        (lambda s: SwayConfig(points=4), "odd number"),
    ],
)
def test_what_no_gait_is_made_of_is_refused(spec, make, text):
    with pytest.raises(PlanningError, match=text):
        make(spec)
