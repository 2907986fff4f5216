"""The window follows the robot: size and time of a look stay, what lies inside stays, what it leaves is forgotten."""

import time

import numpy as np
import pytest

from athlete_twin.errors import ConfigError
from planner.terrain.fusion import FusionConfig, TerrainMap

CONFIG = FusionConfig(size_x=8.0, size_y=8.0)


def rolling(x, y):
    return 0.1 * np.sin(0.9 * x) * np.cos(1.1 * y)


def look_ahead(rng, x):
    """Ground from 0.5 m to 3 m ahead."""
    xy = np.column_stack([rng.uniform(x + 0.5, x + 3.0, 60000), rng.uniform(-1.5, 1.5, 60000)])
    return np.column_stack([xy, rolling(xy[:, 0], xy[:, 1]) + rng.normal(0.0, 0.005, len(xy))]), np.full(len(xy), 0.006)


def test_a_hundred_metres_cost_no_more_memory_or_time_than_ten():
    rng = np.random.default_rng(0)
    terrain = TerrainMap.around(0.0, 0.0, config=CONFIG)
    sizes, seconds = [], []
    for k in range(201):
        x = 0.5 * k
        start = time.process_time()
        terrain.follow(x, 0.0)
        terrain.fuse_points(*look_ahead(rng, x), t=float(k), origin_in_world=np.array([x, 0.0, 1.7]))
        seconds.append(time.process_time() - start)
        state = vars(terrain._cells)
        sizes.append(sum(v.nbytes for v in state.values()))
    assert len(set(sizes)) == 1
    assert np.median(seconds[-20:]) < 2.0 * np.median(seconds[5:25])
    fused = terrain.fused()
    assert fused.grid.shape == (160, 160)
    x, y = fused.grid.centres()
    true = rolling(*np.meshgrid(x, y, indexing="ij"))
    assert abs(x.mean() - 100.0) <= CONFIG.follow_fraction * CONFIG.size_x + 0.1
    assert np.nanpercentile(np.abs(fused.grid.heights - true), 99) < 0.02
    behind = (x > 98.0) & (x < 100.0)
    assert np.isfinite(fused.grid.heights[np.ix_(behind, np.abs(y) < 1.3)]).all(), "seen before, out of view, still there"


def test_moving_the_window_changes_no_height_inside_it():
    rng = np.random.default_rng(1)
    terrain = TerrainMap.around(0.0, 0.0, config=CONFIG)
    terrain.fuse_points(*look_ahead(rng, 0.0), t=3.0)
    before, places = terrain.fused(), np.column_stack([rng.uniform(0.7, 2.8, 500), rng.uniform(-1.2, 1.2, 500)])
    assert not terrain.follow(1.5, 0.3)
    assert terrain.follow(2.0, -1.7)
    after = terrain.fused()
    np.testing.assert_allclose(after.grid.sample(places), before.grid.sample(places), atol=1e-12)
    assert np.isfinite(after.seen).sum() == (after.count > 0).sum() == (before.count > 0).sum()
    assert terrain.follow(500.0, 0.0) and terrain.fused().unknown.all()


def test_a_window_that_would_never_or_always_move_is_refused():
    with pytest.raises(ConfigError, match=r"follow_fraction is 0.7, must be above 0 and below 0.5"):
        FusionConfig(follow_fraction=0.7)
    with pytest.raises(ConfigError, match="passed_rays and ray_stride are 3 and 0"):
        FusionConfig(ray_stride=0)
    with pytest.raises(ConfigError, match="must be 0 or more"):
        FusionConfig(sigma_common=-1.0)
