"""A leg that slipped through the mask once leaves nothing; rocks, and ground out of view, stay."""

import numpy as np
import pytest
from scipy import ndimage

from planner.terrain.elevation import GridLayout
from planner.terrain.fusion import FusionConfig, TerrainMap

LAYOUT = GridLayout(origin_x=-1.5, origin_y=-1.5, cell=0.05, nx=61, ny=61)
EYE = np.array([-2.0, 0.0, 1.6])


def low_rocks(x, y):
    """Three rocks of 8 to 12 cm on bare ground."""
    z = np.zeros_like(x)
    for cx, cy, height in ((0.5, 0.6, 0.12), (-0.6, -0.5, 0.08), (0.7, -0.7, 0.10)):
        z = np.maximum(z, height * np.sqrt(np.maximum(1.0 - ((x - cx) ** 2 + (y - cy) ** 2) / 0.15**2, 0.0)))
    return z


def look(rng, *, legs=(), n=60000, noise=0.006, keep=lambda _x, _y: True):
    """Points of the ground, some of them replaced by clusters of a leg (x, y, radius, height)."""
    xy = rng.uniform(-1.45, 1.45, (n, 2))
    xy = xy[np.broadcast_to(keep(xy[:, 0], xy[:, 1]), n)]
    z = low_rocks(xy[:, 0], xy[:, 1])
    for x, y, radius, height in legs:
        on = np.hypot(xy[:, 0] - x, xy[:, 1] - y) < radius
        z = np.where(on, height, z)
    return np.column_stack([xy, z + rng.normal(0.0, noise, len(xy))]), np.full(len(xy), noise)


def highest_over_truth(terrain):
    """By which a known cell stands over the highest true ground within 10 cm [m]."""
    fused = terrain.fused()
    x, y = fused.grid.centres()
    true = low_rocks(*np.meshgrid(x, y, indexing="ij"))
    return float(np.nanmax(fused.grid.heights - ndimage.maximum_filter(true, 5)))


@pytest.mark.parametrize("bad", [0, 1, 9, 19])
def test_clusters_of_a_leg_in_one_of_twenty_looks_leave_nothing_above_5_cm(bad):
    rng = np.random.default_rng(bad)
    legs = [(*rng.uniform(-1.2, 1.2, 2), rng.uniform(0.04, 0.12), rng.uniform(0.1, 0.9)) for _ in range(25)]
    terrain = TerrainMap(LAYOUT, config=FusionConfig())
    for k in range(21 if bad == 19 else 20):
        terrain.fuse_points(*look(rng, legs=legs if k == bad else ()), t=float(k), origin_in_world=EYE)
    assert highest_over_truth(terrain) < 0.05


def test_low_rocks_survive_twenty_looks():
    rng = np.random.default_rng(3)
    terrain = TerrainMap(LAYOUT, config=FusionConfig())
    for k in range(20):
        terrain.fuse_points(*look(rng), t=float(k), origin_in_world=EYE)
    for x, y, height in ((0.5, 0.6, 0.12), (-0.6, -0.5, 0.08), (0.7, -0.7, 0.10)):
        assert terrain.fused().grid.sample(np.array([x, y])) == pytest.approx(height, abs=0.015)


def test_rays_that_pass_through_a_ghost_remove_it_though_nothing_measures_its_cells():
    """The ghost's cells are never measured again: behind it ground is seen through it."""
    rng = np.random.default_rng(4)
    terrain = TerrainMap(LAYOUT, config=FusionConfig())
    terrain.fuse_points(*look(rng, legs=[(0.0, 0.0, 0.12, 0.5)]), t=0.0, origin_in_world=EYE)
    assert terrain.fused().grid.sample(np.zeros(2)) > 0.4
    beside = lambda x, y: np.hypot(x, y) > 0.25  # noqa: E731
    for k in range(3):
        terrain.fuse_points(*look(rng, keep=beside), t=1.0 + k, origin_in_world=EYE)
    assert highest_over_truth(terrain) < 0.05
    assert terrain.fused().unknown[30, 30], "what was taken back is unknown, not guessed"


def test_a_rock_that_hides_its_back_keeps_it():
    """Rays end on the rock's front or pass over it: none speaks against the back, which another view once saw."""
    rng = np.random.default_rng(5)
    box = lambda x, y: np.where((np.abs(x) < 0.2) & (np.abs(y) < 0.3), 0.3, 0.0)  # noqa: E731
    xy = rng.uniform(-1.45, 1.45, (60000, 2))
    points = np.column_stack([xy, box(xy[:, 0], xy[:, 1]) + rng.normal(0.0, 0.005, len(xy))])
    terrain = TerrainMap(LAYOUT, config=FusionConfig())
    terrain.fuse_points(points, np.full(len(points), 0.006))
    shadow = (points[:, 0] > -0.15) & (points[:, 0] < 0.7) & (np.abs(points[:, 1]) < 0.35)
    for _ in range(8):
        terrain.fuse_points(points[~shadow], np.full(int((~shadow).sum()), 0.006), origin_in_world=EYE)
    heights = terrain.fused().grid.heights[27:33, 26:35]
    assert np.isfinite(heights).all() and heights.min() > 0.25


def test_ground_out_of_view_survives_and_grows_old():
    rng = np.random.default_rng(6)
    terrain = TerrainMap(LAYOUT, config=FusionConfig())
    terrain.fuse_points(*look(rng), t=10.0)
    for k in range(20):
        terrain.fuse_points(*look(rng, keep=lambda x, _y: x > 0.0), t=100.0 + k)
    fused = terrain.fused()
    assert not fused.unknown[3:28, 3:-3].any()
    age = fused.age(120.0)
    assert np.all(age[3:28, 3:-3] == 110.0) and np.all(age[34:-3, 3:-3] == 1.0)
    assert np.isposinf(TerrainMap(LAYOUT, config=FusionConfig()).fused().age(5.0)).all()


@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf])
def test_numbers_that_are_none_leave_neither_hole_nor_spike(wrong):
    rng = np.random.default_rng(7)
    points, sigma = look(rng)
    spoilt, doubt = points.copy(), sigma.copy()
    spoilt[::40, 2], doubt[1::40] = wrong, wrong
    terrain = TerrainMap(LAYOUT, config=FusionConfig())
    terrain.fuse_points(spoilt, doubt, origin_in_world=EYE)
    inside = np.s_[2:-2, 2:-2]
    assert not terrain.fused().unknown[inside].any()
    assert highest_over_truth(terrain) < 0.03 and terrain.fused().grid.heights[inside].min() > -0.03
