import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from athlete_twin.errors import ConfigError, TerrainError
from athlete_twin.geometry.grid import HeightGrid
from planner.footfall import METHODS, REASONS, FootfallConfig, footprint, score_footfalls

CELL, WHEEL = 0.05, 0.242
SIDE = 0.30
"""[m], the paper's foot"""
FINE = 0.30 / 61
"""[m], so that sums over cells come near the paper's integrals: 61 cells cover exactly the foot"""


def _grid(heights, cell=CELL):
    return HeightGrid(origin_x=0.0, origin_y=0.0, cell=cell, heights=heights)


def _score(heights, *, cell=CELL, variance=1e-4, wheel_radius=WHEEL, **config):
    spread = np.full(heights.shape, variance)
    return score_footfalls(_grid(heights, cell), spread, wheel_radius=wheel_radius, config=FootfallConfig(**config))


def _cost_of_profile(profile, method):
    """N_k of the paper's two-dimensional analysis: a profile along x over a square foot of 30 cm, in its middle."""
    x = FINE * (np.arange(61) - 30)
    heights = np.repeat(profile(x)[:, None], 61, axis=1)
    scored = _score(heights, cell=FINE, wheel_radius=SIDE, footprint_fraction=0.5, shape="square", method=method)
    return float(scored.cost[30, 30])


def _brute_force(heights, i, j, foot, method, cell):
    k = foot.shape[0] // 2
    under = heights[i - k : i + k + 1, j - k : j + k + 1][foot.astype(bool)]
    if method == "max_min":
        return under.max() - under.min()
    if method == "plane_fit":
        return np.mean((under - under.mean()) ** 2)
    return np.sum(under.max() - under) * cell**2


def _veto_at(scored, i, j):
    return REASONS[scored.veto[i, j]]


@settings(max_examples=15)
@given(seed=st.integers(0, 1000), shape=st.sampled_from(["disc", "square"]), method=st.sampled_from(METHODS))
def test_costs_equal_a_loop_over_the_footprint(seed, shape, method):
    rng = np.random.default_rng(seed)
    heights = 3.0 + rng.normal(0.0, 0.05, (25, 31))
    scored = _score(heights, shape=shape, method=method)
    foot = footprint(0.75 * WHEEL, CELL, shape=shape)
    k = foot.shape[0] // 2
    for i, j in rng.integers([k, k], [25 - k, 31 - k], (20, 2)):
        assert scored.cost[i, j] == pytest.approx(_brute_force(heights, i, j, foot, method, CELL), abs=1e-10)


def test_a_step_costs_what_the_paper_says():
    """[Caillas1989] s3.2.1: a step of height h that fills l of the foot's d."""
    h, filled = 0.08, 20
    d, length = SIDE, filled * FINE
    step = lambda x: np.where(np.arange(61) < filled, h, 0.0)  # noqa: E731
    assert _cost_of_profile(step, "max_min") == pytest.approx(h)
    # Printed h^2 / 2 l (d - l); the variance of a step is h^2 l (d - l) / d^2.
    assert _cost_of_profile(step, "plane_fit") == pytest.approx(h**2 * length * (d - length) / d**2)
    assert _cost_of_profile(step, "free_volume") / d == pytest.approx((d - length) * h)


def test_a_slope_costs_what_the_paper_says():
    tangent, d = np.tan(np.deg2rad(12.0)), SIDE
    slope = lambda x: tangent * x  # noqa: E731
    cells = 1.0 / 61  # centres of cells reach half a cell less far than the foot
    assert _cost_of_profile(slope, "max_min") == pytest.approx(d * tangent * (1 - cells))
    assert _cost_of_profile(slope, "plane_fit") == pytest.approx(d**2 / 12 * tangent**2, rel=1e-3)
    assert _cost_of_profile(slope, "free_volume") / d == pytest.approx(d**2 / 2 * tangent, rel=2 * cells)


@pytest.mark.parametrize("periods", [0.7, 1.0, 2.3])
def test_a_sinusoid_costs_what_the_paper_says(periods):
    """The paper's a is the amplitude in eqs for Plane Fit and Free Volume, where it leaves out the mean's square."""
    a, d = 0.03, SIDE
    f = periods / d
    wave = lambda x: a * np.sin(2 * np.pi * f * (x + 0.5 * d))  # noqa: E731
    mean = a * (1 - np.cos(2 * np.pi * periods)) / (2 * np.pi * periods)
    square = 0.5 * a**2 * (1 - np.sin(4 * np.pi * periods) / (4 * np.pi * periods))
    assert _cost_of_profile(wave, "plane_fit") == pytest.approx(square - mean**2, rel=2e-3)
    expected = a * d * (1 - (1 - np.cos(2 * np.pi * periods)) / (2 * np.pi * periods))
    assert _cost_of_profile(wave, "free_volume") / d == pytest.approx(expected, rel=5e-3)
    low = -a if periods >= 0.75 else a * np.sin(2 * np.pi * periods)
    assert _cost_of_profile(wave, "max_min") == pytest.approx(a - low, rel=1e-2)


def test_free_volume_tells_a_spike_from_a_wave_and_max_min_does_not():
    spike = lambda x: np.where(np.arange(61) == 30, 0.06, 0.0)  # noqa: E731
    wave = lambda x: 0.03 * np.sin(2 * np.pi * (np.arange(61) + 0.5) / 20)  # noqa: E731
    assert _cost_of_profile(spike, "max_min") == pytest.approx(_cost_of_profile(wave, "max_min"), rel=0.02)
    assert _cost_of_profile(wave, "free_volume") < 0.7 * _cost_of_profile(spike, "free_volume")


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


def test_a_wholly_unknown_map_is_refused_everywhere():
    assert (_score(np.full((30, 30), np.nan)).veto == REASONS.index("unknown")).all()


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


def test_reason_at_a_point_is_the_cell_it_lies_in():
    scored = _score(np.zeros((30, 30)))
    assert scored.reason_at(np.array([0.75, 0.75])) == "ok"
    assert scored.reason_at(np.array([-5.0, 0.75])) == "unknown"


def test_wrong_use_is_refused():
    with pytest.raises(ConfigError, match="max_min, plane_fit, free_volume"):
        FootfallConfig(method="guess")
    with pytest.raises(ConfigError, match="disc, square"):
        FootfallConfig(shape="oval")
    with pytest.raises(ConfigError, match="max_sigma is 0"):
        FootfallConfig(max_sigma=0.0)
    with pytest.raises(ConfigError, match="footprint_fraction is 3"):
        FootfallConfig(footprint_fraction=3.0)
    with pytest.raises(ConfigError, match="max_unknown_fraction is 1"):
        FootfallConfig(max_unknown_fraction=1.0)
    with pytest.raises(ConfigError, match="flank clearance"):
        FootfallConfig(flank_clearance=-0.1)
    with pytest.raises(TerrainError, match="smaller than a footprint"):
        _score(np.zeros((4, 4)))
    with pytest.raises(TerrainError, match="wheel radius is 0"):
        _score(np.zeros((30, 30)), wheel_radius=0.0)
    with pytest.raises(TerrainError, match="variance has shape"):
        score_footfalls(_grid(np.zeros((30, 30))), np.zeros((3, 3)), wheel_radius=WHEEL, config=FootfallConfig())
