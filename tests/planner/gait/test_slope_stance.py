"""Stances on slopes: what is found walks, reaches with what it is told to spare, and climbs more than a regular circle of feet."""

import numpy as np
import pytest

from athlete_twin.errors import PlanningError
from athlete_twin.model.reach import leg_ik
from athlete_twin.model.spec import load_spec
from planner.gait.clearance import first_strike, ground_of, plane_grid, reaches_with_spare
from planner.gait.cycle import gait_cycle, judge_cycle, judge_cycles
from planner.gait.limits import footing_on, steepest_slope
from planner.gait.slope_stance import NoSlopeStance, SlopeSearch, SlopeStance, foot_figure, stance_on, steepest_stance
from planner.motion.collision import CollisionConfig

AHEAD = np.array([1.0, 0.0])
QUICK = SlopeSearch(points=6, rounds=2, directions_deg=(30.0,), step_deg=4.0)


@pytest.fixture(scope="module")
def spec():
    return load_spec("sdm_b")


def test_cycles_judged_together_are_judged_as_each_alone(spec):
    footing = footing_on(np.deg2rad(3.0), AHEAD, deck="level")
    cycles = [gait_cycle(spec, AHEAD, stride=0.3, foot_radius=r, footing=footing) for r in (1.6, 1.9, 2.6)]
    for together, cycle in zip(judge_cycles(cycles), cycles, strict=True):
        alone = judge_cycle(cycle)
        for name in ("fraction", "margin", "cps_margin", "reaches", "phase", "swinging"):
            np.testing.assert_array_equal(getattr(together, name), getattr(alone, name))


def test_cycles_of_different_ground_are_not_judged_together(spec):
    with pytest.raises(PlanningError, match="must share robot, footing and groups"):
        sloping = gait_cycle(spec, AHEAD, stride=0.3, footing=footing_on(0.1, AHEAD, deck="level"))
        judge_cycles([gait_cycle(spec, AHEAD, stride=0.3), sloping])


def test_equal_lengths_are_the_regular_circle(spec):
    figure = foot_figure(spec, AHEAD, np.array([1.7, 1.7, 1.7, 1.0]))
    np.testing.assert_allclose(np.linalg.norm(figure, axis=1), 1.7)
    stretched = foot_figure(spec, AHEAD, np.array([1.7, 2.0, 1.5, 1.0]))
    np.testing.assert_allclose(stretched[:, 1], figure[:, 1])
    assert stretched[:, 0].max() == pytest.approx(2.0) and stretched[:, 0].min() == pytest.approx(-1.5)


@pytest.mark.slow
@pytest.mark.ci
def test_sdm_b_climbs_the_papers_slopes_with_the_deck_level_where_a_regular_circle_does_not(spec):
    """[SunSpiral2012] s5.3.4: 7 and 14 degrees, deck level."""
    assert np.rad2deg(steepest_slope(spec, AHEAD, stride=spec.stride, deck="level").value) < 7.0
    found = stance_on(spec, np.deg2rad(14.0), stride=spec.stride, deck="level", search=QUICK)
    assert isinstance(found, SlopeStance)
    assert judge_cycle(found.cycle).refusal(spec) == ""
    assert first_strike(found.cycle, ground_of(found.cycle)) is None


@pytest.mark.slow
def test_the_steepest_stance_walks_and_is_steeper_than_14_degrees(spec):
    found = steepest_stance(spec, stride=0.3, deck="level", search=QUICK)
    assert isinstance(found, SlopeStance) and found.angle >= np.deg2rad(14.0)
    assert judge_cycle(found.cycle).refusal(spec) == ""


def test_a_slope_too_steep_is_refused_with_counts(spec):
    found = stance_on(spec, np.deg2rad(60.0), stride=0.6, deck="level", search=QUICK)
    assert isinstance(found, NoSlopeStance) and "do not reach" in found.reason and found.tried > 1000


def test_spare_reach_is_what_a_wheel_may_be_off(spec):
    cycle = gait_cycle(spec, AHEAD, stride=0.3, foot_radius=1.95)
    assert reaches_with_spare(cycle, 0.02) and not reaches_with_spare(cycle, 1.0)
    rng = np.random.default_rng(1)
    for axles in cycle.swing_axles(2):
        for leg in range(6):
            off = rng.normal(size=3)
            _, ok = leg_ik(spec, leg, (axles[leg] - cycle.chassis[2] + 0.01 * off / np.linalg.norm(off))[None])
            assert ok[0]


def test_a_chassis_on_the_ground_strikes_it(spec):
    cycle = gait_cycle(spec, AHEAD, stride=0.1, chassis_height=1.75)
    assert first_strike(cycle, ground_of(cycle)) is None
    strict = ground_of(cycle, CollisionConfig(near_ground_clearance=1.7))
    assert "terrain" in str(first_strike(cycle, strict))


def test_the_plane_is_the_plane():
    normal = footing_on(np.deg2rad(14.0), AHEAD, deck="level").normal
    grid = plane_grid(normal)
    assert float(grid.sample(np.array([2.3, 1.1]))) == pytest.approx(2.3 * np.tan(np.deg2rad(14.0)))
    with pytest.raises(PlanningError, match="points down"):
        plane_grid(-normal)


@pytest.mark.parametrize("wrong", [{"low": 2.0}, {"shrink": 1.0}, {"points": 1}, {"directions_deg": ()}])
def test_a_search_without_room_is_refused(wrong):
    with pytest.raises(PlanningError):
        SlopeSearch(**wrong)
