import numpy as np
import pytest

from athlete_twin.errors import ConfigError, TerrainError
from athlete_twin.geometry.grid import HeightGrid
from planner.footfall import METHODS, REASONS, FootfallConfig, footprint, score_footfalls

CELL, WHEEL = 0.05, 0.242


def _grid(heights, cell=CELL):
    return HeightGrid(origin_x=0.0, origin_y=0.0, cell=cell, heights=heights)


def _score(heights, *, cell=CELL, variance=1e-4, wheel_radius=WHEEL, **config):
    spread = np.broadcast_to(variance, heights.shape).astype(float)
    config.setdefault("deviations", 0.0)  # costs of the heights as they are, unless a test asks
    return score_footfalls(_grid(heights, cell), spread, wheel_radius=wheel_radius, config=FootfallConfig(**config))


def _veto_at(scored, i, j):
    return REASONS[scored.veto[i, j]]


def test_flat_ground_is_free_except_where_the_map_ends():
    scored = _score(np.full((40, 40), 0.7))
    k = footprint(0.75 * WHEEL, CELL).shape[0] // 2
    inner = (slice(k, -k), slice(k, -k))
    assert scored.allowed[inner].all()
    assert scored.contact_height[inner] == pytest.approx(0.7)
    assert scored.cost[inner] == pytest.approx(0.0, abs=1e-12)
    assert _veto_at(scored, 0, 0) == "unknown"


def test_unknown_ground_under_the_wheel_is_refused_and_one_lost_cell_is_not():
    heights = np.zeros((60, 60))
    heights[20, 20] = np.nan
    heights[38:43, 38:43] = np.nan
    scored = _score(heights)
    assert _veto_at(scored, 20, 20) == "ok"
    assert scored.contact_height[20, 20] == pytest.approx(0.0)
    assert _veto_at(scored, 40, 40) == "unknown"
    assert np.isnan(scored.cost[40, 40])
    assert np.isnan(scored.contact_height[40, 40])
    strict = _score(heights, max_unknown_fraction=0.0)
    assert _veto_at(strict, 20, 20) == "unknown"


@pytest.mark.parametrize("method", METHODS)
def test_a_wholly_unknown_map_is_refused_everywhere(method):
    scored = _score(np.full((30, 30), np.nan), method=method)
    assert (scored.veto == REASONS.index("unknown")).all()
    assert np.isnan(scored.cost).all()


@pytest.mark.parametrize("method", METHODS)
def test_a_foot_smaller_than_a_cell_finds_every_cell_flat(method):
    heights = 0.05 * np.random.default_rng(6).normal(size=(30, 30))
    assert _score(heights, method=method, footprint_diameter=0.04).cost == pytest.approx(0.0, abs=1e-12)


def test_slopes_are_measured_and_refused_beyond_the_limit():
    x = CELL * np.arange(40)[:, None] * np.ones((1, 40))
    gentle, steep = (_score(np.tan(np.deg2rad(angle)) * x) for angle in (15.0, 25.0))
    assert np.rad2deg(gentle.slope[20, 20]) == pytest.approx(15.0)
    assert _veto_at(gentle, 20, 20) == "ok"
    assert _veto_at(steep, 20, 20) == "steep"
    # The axle of a wheel on a slope stands R / cos over the plane, not R.
    expected = np.tan(np.deg2rad(15.0)) * x[20, 20] + WHEEL * (1 / np.cos(np.deg2rad(15.0)) - 1)
    assert gentle.contact_height[20, 20] == pytest.approx(expected)


@pytest.mark.parametrize("heading", [0.0, 0.4, 1.1])
def test_a_smooth_slope_is_not_rough(heading):
    x, y = np.meshgrid(CELL * np.arange(40), CELL * np.arange(40), indexing="ij")
    heights = np.tan(np.deg2rad(19.0)) * (np.cos(heading) * x + np.sin(heading) * y)
    assert _veto_at(_score(heights, max_height_range=1e-6, max_mean_gap=1e-6), 20, 20) == "ok"


def test_a_stone_under_the_wheel_is_rough():
    heights = np.zeros((40, 40))
    heights[20, 20] = 0.12
    scored = _score(heights)
    assert _veto_at(scored, 20, 20) == "rough"
    assert _veto_at(_score(heights, max_height_range=0.2, max_mean_gap=0.2), 20, 20) == "ok"


def test_a_rock_beside_the_wheel_is_refused_as_far_as_the_hull_and_its_clearance_reach():
    heights = np.zeros((60, 60))
    heights[40, 30] = 0.40
    scored = _score(heights)
    vetoes = {40 - i: _veto_at(scored, i, 30) for i in range(30, 40)}
    reach = WHEEL + 0.05
    for cells, reason in vetoes.items():
        distance = cells * CELL
        if distance > reach + 1e-9:
            assert reason == "ok"
        elif distance > 0.75 * WHEEL:
            assert reason == "step_beside"
        else:
            assert reason in ("rough", "steep")


def test_flank_veto_equals_a_loop_over_the_hull():
    rng = np.random.default_rng(7)
    heights = np.zeros((40, 40))
    heights[rng.integers(0, 40, 25), rng.integers(0, 40, 25)] = rng.uniform(0.02, 0.4, 25)
    open_limits = {"max_height_range": 9.0, "max_mean_gap": 9.0, "max_slope_deg": 89.0}
    scored = _score(heights, **open_limits)
    for i, j in rng.integers(8, 32, (150, 2)):
        touched = False
        for u in range(40):
            for v in range(40):
                d = CELL * np.hypot(u - i, v - j)
                if 0.75 * WHEEL < d <= WHEEL + 0.05 + 1e-9:
                    hull = WHEEL - np.sqrt(WHEEL**2 - max(0.0, d - 0.05) ** 2)
                    touched |= bool(heights[u, v] > scored.contact_height[i, j] + hull + 0.05)
        assert (_veto_at(scored, i, j) == "step_beside") == touched


def test_a_low_stone_beside_the_wheel_does_no_harm():
    heights = np.zeros((60, 60))
    heights[36, 30] = 0.06
    assert _veto_at(_score(heights), 30, 30) == "ok"


def test_uncertain_heights_are_refused():
    assert _veto_at(_score(np.zeros((30, 30)), variance=0.05**2), 15, 15) == "uncertain"
    assert _veto_at(_score(np.zeros((30, 30)), variance=0.03**2), 15, 15) == "ok"


@pytest.mark.parametrize("lost", [np.nan, np.inf])
@pytest.mark.parametrize("method", METHODS)
def test_a_height_of_which_nobody_knows_how_sure_it_is_counts_as_unknown(method, lost):
    heights = 0.01 * np.random.default_rng(9).normal(size=(60, 60))
    unknown, spread = heights.copy(), np.full(heights.shape, 1e-4)
    unknown[38:43, 38:43] = np.nan
    unknown[20, 20] = np.nan
    spread[np.isnan(unknown)] = lost
    scored = _score(heights, variance=spread, method=method, deviations=1.0)
    assert _veto_at(scored, 40, 40) == "unknown"
    assert _veto_at(scored, 20, 20) == "ok"
    expected = _score(unknown, method=method, deviations=1.0)
    assert scored.veto.tobytes() == expected.veto.tobytes()
    assert np.array_equal(scored.cost, expected.cost, equal_nan=True)
    assert np.array_equal(scored.contact_height, expected.contact_height, equal_nan=True)


def test_an_unknown_cell_never_hides_that_the_others_are_uncertain():
    heights, spread = np.zeros((30, 30)), np.full((30, 30), 0.041**2)
    spread[15, 15] = np.nan
    assert _veto_at(_score(heights, variance=spread), 15, 15) == "uncertain"
    assert _veto_at(_score(heights, variance=np.where(np.isnan(spread), np.nan, 0.039**2)), 15, 15) == "ok"


def test_reason_at_a_point_is_the_cell_it_lies_in():
    scored = _score(np.zeros((30, 30)))
    assert scored.reason_at(np.array([0.75, 0.75])) == "ok"
    assert scored.reason_at(np.array([-5.0, 0.75])) == "unknown"


@pytest.mark.parametrize("method", METHODS)
def test_what_is_refused_does_not_depend_on_the_method(method):
    rng = np.random.default_rng(3)
    heights = 0.03 * rng.normal(size=(60, 70)) + np.linspace(0.0, 1.2, 70) ** 2
    heights[rng.random(heights.shape) < 0.04] = np.nan
    spread = rng.uniform(1e-5, 3e-3, heights.shape)
    scored, reference = (
        score_footfalls(_grid(heights), spread, wheel_radius=WHEEL, config=FootfallConfig(method=m, deviations=d))
        for m, d in ((method, 2.0), ("free_volume", 0.0))
    )
    assert len(np.unique(reference.veto)) == len(REASONS)
    assert scored.veto.tobytes() == reference.veto.tobytes()
    assert scored.contact_height.tobytes() == reference.contact_height.tobytes()
    assert scored.slope.tobytes() == reference.slope.tobytes()
    assert (np.isnan(scored.cost) == (scored.veto == REASONS.index("unknown"))).all()


@pytest.mark.parametrize("method", METHODS)
def test_unknown_cells_under_a_wheel_cost_as_their_neighbours_do(method):
    heights = 0.02 * np.random.default_rng(8).normal(size=(30, 30))
    lost = heights.copy()
    lost[15, 16] = np.nan
    k = footprint(0.75 * WHEEL, CELL).shape[0] // 2
    around = np.delete(heights[15 - k : 16 + k, 16 - k : 17 + k].ravel(), (2 * k + 1) ** 2 // 2)
    filled = heights.copy()
    filled[15, 16] = around.mean()
    assert _score(lost, method=method).cost[10:20, 10:20] == pytest.approx(_score(filled, method=method).cost[10:20, 10:20])
    wary = {"deviations": 1.0, "asv_slope_deg": 1e-3}
    known, unknown = (_score(h, method=method, variance=1e-6, **wary).cost[15, 15] for h in (filled, lost))
    assert unknown > known  # it may be as wrong as max_sigma allows


def test_the_ambler_s_foot_is_a_disc_of_30_cm_under_any_wheel():
    heights = 0.02 * np.random.default_rng(4).normal(size=(40, 40))
    costs = [_score(heights, footprint_diameter=0.30, wheel_radius=r).cost for r in (0.2, 0.4)]
    assert np.array_equal(*costs, equal_nan=True)
    own = _score(heights, footprint_fraction=0.15 / WHEEL).cost
    assert np.array_equal(costs[0], own, equal_nan=True)


@pytest.mark.parametrize("limit", ["max_sigma", "max_slope_deg", "max_height_range", "max_mean_gap", "flank_clearance", "flank_tolerance"])
@pytest.mark.parametrize("value", [-0.1, float("nan"), float("inf")])
def test_limits_that_mean_nothing_are_named_with_their_value(limit, value):
    with pytest.raises(ConfigError, match=f"{limit} is {value}"):
        FootfallConfig(**{limit: value})


@pytest.mark.parametrize("value", [-0.1, 1.0, float("nan")])
def test_a_share_of_unknown_ground_that_means_nothing_is_named(value):
    with pytest.raises(ConfigError, match=f"max_unknown_fraction is {value}"):
        FootfallConfig(max_unknown_fraction=value)


def test_a_slope_limit_of_a_wall_is_refused():
    with pytest.raises(ConfigError, match=r"max_slope_deg is 90\.0, must be below 90"):
        FootfallConfig(max_slope_deg=90.0)


def test_variance_counts_unless_it_is_asked_not_to():
    heights = 0.02 * np.random.default_rng(10).normal(size=(40, 40))
    spread = np.full(heights.shape, 1e-6)
    spread[:, 20:] = 4e-4
    grid = _grid(np.concatenate([heights[:, :20], heights[:, 19::-1]], axis=1))  # mirrored about the middle, less sure beyond it
    scored = score_footfalls(grid, spread, wheel_radius=WHEEL, config=FootfallConfig())
    assert (scored.cost[5:-5, 28:35] > scored.cost[5:-5, 11:4:-1]).all()
    blind = score_footfalls(grid, spread, wheel_radius=WHEEL, config=FootfallConfig(deviations=0.0))
    assert blind.cost[5:-5, 28:35] == pytest.approx(blind.cost[5:-5, 11:4:-1])


def test_wrong_use_is_refused():
    with pytest.raises(ConfigError, match="'guess' is not one of max_min, plane_fit, support_area"):
        FootfallConfig(method="guess")
    with pytest.raises(ConfigError, match="disc, square"):
        FootfallConfig(shape="oval")
    with pytest.raises(ConfigError, match="max_sigma is 0"):
        FootfallConfig(max_sigma=0.0)
    with pytest.raises(ConfigError, match="footprint_fraction is 3"):
        FootfallConfig(footprint_fraction=3.0)
    with pytest.raises(ConfigError, match="max_unknown_fraction is 1"):
        FootfallConfig(max_unknown_fraction=1.0)
    with pytest.raises(TerrainError, match=r"variance is -0\.0001 m2 at cell \(3, 4\), must not be negative; NaN or infinite"):
        spread = np.full((30, 30), 1e-4)
        spread[3, 4] *= -1.0
        _score(np.zeros((30, 30)), variance=spread)
    with pytest.raises(TerrainError, match="wheel radius is inf"):
        _score(np.zeros((30, 30)), wheel_radius=float("inf"))
    with pytest.raises(TerrainError, match=r"map of \(4, 4\) cells is smaller than a footprint of \(7, 7\) cells"):
        _score(np.zeros((4, 4)))
    with pytest.raises(TerrainError, match=r"map of \(30, 4\) cells is smaller"):
        _score(np.zeros((30, 4)), footprint_diameter=0.30)
    with pytest.raises(TerrainError, match="wheel radius is 0"):
        _score(np.zeros((30, 30)), wheel_radius=0.0)
    with pytest.raises(TerrainError, match="variance has shape"):
        score_footfalls(_grid(np.zeros((30, 30))), np.zeros((3, 3)), wheel_radius=WHEEL, config=FootfallConfig())
