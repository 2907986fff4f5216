"""Paces and refusals of chassis places: closed forms on flat ground, loops over cells on rough ground."""

import numpy as np
import pytest

from athlete_twin.errors import ConfigError, PlanningError
from athlete_twin.geometry.grid import HeightGrid
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.spec import RobotSpec, load_spec
from planner.footfall import FootfallConfig, FootfallMap, score_footfalls
from planner.gait.skeleton import regular_places
from planner.route.places import CLEARANCE, NO_FOOTFALL, OK, Places, RouteConfig, places

N, MAP_CELL = 321, 0.05
TYPICAL = 0.0015


@pytest.fixture(params=["sdm_b", "t12"])
def spec(request) -> RobotSpec:
    return load_spec(request.param)


def flat() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    x = MAP_CELL * (np.arange(N) - N // 2)
    return (*np.meshgrid(x, x, indexing="ij"), np.zeros((N, N)))


def scored(spec: RobotSpec, heights: np.ndarray) -> tuple[HeightGrid, HeightGrid, FootfallMap]:
    low = -MAP_CELL * (N // 2)
    seen, filled = (
        HeightGrid(origin_x=low, origin_y=low, cell=MAP_CELL, heights=h) for h in (heights, np.nan_to_num(heights))
    )
    variance = np.where(np.isfinite(heights), 1e-4, np.inf)
    return seen, filled, score_footfalls(seen, variance, wheel_radius=spec.wheel.radius, config=FootfallConfig())


def over(spec: RobotSpec, heights: np.ndarray, *, goal=(3.0, 0.0), driving: bool = True, **settings) -> Places:
    seen, filled, footfalls = scored(spec, heights)
    pose = SE3(np.eye(3), np.array([0.0, 0.0, spec.chassis_height]))
    return places(
        spec, seen, filled, footfalls, pose, goal=np.array(goal), config=RouteConfig(**settings), typical_terrain=TYPICAL,
        driving=driving,
    )  # fmt: skip


def test_flat_ground_in_sight_costs_the_open_grounds_pace_and_may_be_driven(spec):
    ground = over(spec, flat()[2])
    here = ground.index(np.zeros(2))
    np.testing.assert_allclose(ground.walk[here], 55.0 * 6 / spec.stride, rtol=1e-6)
    np.testing.assert_allclose(ground.drive[here], 2.0 / spec.drive_speed)
    assert (ground.refusal == OK).all()
    assert np.isinf(over(spec, flat()[2], driving=False).drive).all()


def test_the_chassis_stands_on_a_place_and_start_goal_and_margin_are_covered(spec):
    ground = over(spec, flat()[2], goal=(20.0, -12.0), margin=2.5)
    np.testing.assert_allclose(ground.xy(*ground.index(np.zeros(2))), 0.0, atol=1e-12)
    low, high = ground.origin, ground.origin + ground.cell * (np.array(ground.shape) - 1)
    assert (low <= [-8.0, -14.5]).all() and (high >= [22.5, 8.0]).all()


def test_ground_that_nobody_saw_is_dearer_on_foot_cannot_be_driven_and_is_refused_only_near_the_robot(spec):
    heights = flat()[2]
    heights[flat()[0] > 1.0] = np.nan
    ground = over(spec, heights, goal=(14.0, 0.0), escape=0.0)
    far = ground.index(np.array([13.0, 0.0]))
    np.testing.assert_allclose(ground.walk[far], 1.3 * 55.0 * 6 / spec.stride, rtol=1e-6)
    assert np.isinf(ground.drive[far])
    beside = ground.index(np.array([1.0, 0.0]))
    assert ground.refusal[beside] == NO_FOOTFALL and ground.refusal[far] == OK


def test_shares_of_footfalls_are_those_counted_cell_by_cell(spec):
    x, y, heights = flat()
    rng = np.random.default_rng(3)
    for cx, cy in rng.uniform(-7.0, 7.0, (120, 2)):
        heights[np.hypot(x - cx, y - cy) < 0.2] = 0.15
    ground = over(spec, heights, terrain_weight=0.0, slope_weight=0.0, escape=0.0)
    _, filled, footfalls = scored(spec, heights)
    reach = RouteConfig().footfall_radius_fraction * spec.stride
    for place in ((0.0, 0.0), (1.4, -0.8), (-2.0, 1.0)):
        pose = SE3(np.eye(3), np.array([*place, spec.chassis_height]))
        shares = []
        for ix, iy in zip(*filled.index(regular_places(spec, pose))[:2], strict=True):
            disc = np.hypot(x - x[ix, iy], y - y[ix, iy]) <= reach + 1e-9
            shares.append(footfalls.allowed[disc].mean())
        at = ground.index(np.array(place))
        assert (ground.refusal[at] == NO_FOOTFALL) == (min(shares) < 0.05)
        expected = 55.0 * 6 / spec.stride * (2.0 - np.mean(shares))
        if ground.refusal[at] == OK:
            np.testing.assert_allclose(ground.walk[at], expected, rtol=1e-5)


def test_a_place_without_a_footfall_for_one_leg_names_the_leg(spec):
    x, y, heights = flat()
    pose = SE3(np.eye(3), np.array([2.0, 0.0, spec.chassis_height]))
    wheel = regular_places(spec, pose)[4]
    blocks = (np.hypot(x - wheel[0], y - wheel[1]) < 1.2) & ((np.round(x / 0.15) + np.round(y / 0.15)) % 2 == 0)
    heights[blocks] = 0.4
    ground = over(spec, heights, escape=0.0)
    assert ground.why(np.array([2.0, 0.0])) == "no_footfall for leg 5"


def test_a_rock_too_high_for_the_chassis_is_refused_under_it_and_one_of_usual_height_is_not(spec):
    x, y, heights = flat()
    rock = np.hypot(x - 3.0, y) < 0.3
    for height, refusal in ((0.9, OK), (1.6, CLEARANCE)):
        heights[rock] = height
        ground = over(spec, heights, goal=(6.0, 0.0))
        assert ground.refusal[ground.index(np.array([3.0, 0.0]))] == refusal


def test_a_curb_in_a_wheels_track_is_walked_over_not_driven(spec):
    x, _, heights = flat()
    heights[np.abs(x - 4.0) < 0.15] = 0.09
    ground = over(spec, heights, goal=(7.0, 0.0))
    front = regular_places(spec, SE3.identity())[:, 0].max()
    on_curb = ground.index(np.array([4.0 - front, 0.0]))
    assert np.isinf(ground.drive[on_curb]) and np.isfinite(ground.walk[on_curb])


def test_a_slope_too_steep_for_wheels_is_walked_and_steeper_ones_are_refused(spec):
    x, _, _ = flat()
    for degrees, drives, walks in ((5.0, True, True), (14.0, False, True), (24.0, False, False)):
        ground = over(spec, np.tan(np.deg2rad(degrees)) * x, escape=0.0)
        here = ground.index(np.array([1.0, 0.0]))
        assert (np.isfinite(ground.drive[here]), np.isfinite(ground.walk[here])) == (drives, walks)


def test_wrong_input_is_refused_with_the_value_and_the_limit(spec):
    with pytest.raises(PlanningError, match=r"the route's goal is \[nan  0\.\], need two finite lengths"):
        over(spec, flat()[2], goal=(np.nan, 0.0))
    with pytest.raises(PlanningError, match=r"a route of 300 m asks for 1556 x 81 places of 0\.2 m, allowed 100000"):
        over(spec, flat()[2], goal=(300.0, 0.0), max_places=100_000)


@pytest.mark.parametrize(
    "settings, message",
    [
        ({"cell": 0.0}, "cell is 0.0, must be positive"),
        ({"margin": -1.0}, "margin is -1.0, must be finite and not negative"),
        ({"step_seconds": np.inf}, "step_seconds is inf, must be positive and finite"),
        ({"min_footfalls": 0.0}, "min_footfalls is 0.0, must be above 0"),
        ({"drive_speed_fraction": 1.5}, "drive_speed_fraction is 1.5, must be at most 1"),
        ({"drive_slope_deg": 30.0}, "drive_slope_deg and max_slope_deg are 30.0 and 20.0"),
        ({"max_places": 1}, "max_places is 1, must be at least 4"),
    ],
)
def test_settings_out_of_bounds_are_refused(settings, message):
    with pytest.raises(ConfigError, match=message):
        RouteConfig(**settings)
