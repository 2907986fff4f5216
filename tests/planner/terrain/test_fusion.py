import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from athlete_twin.errors import ConfigError, TerrainError
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.camera import Pinhole, StereoCamera
from planner.perception.stereo import DepthImage
from planner.terrain.elevation import ElevationConfig, GridLayout, measure_cells
from planner.terrain.fusion import FusionConfig, TerrainMap

SMALL = GridLayout(origin_x=-1.0, origin_y=-1.0, cell=0.05, nx=41, ny=41)


def cloud(rng, height, *, n=20000, noise=0.01, spread=0.97):
    xy = rng.uniform(-spread, spread, (n, 2))
    z = height(xy[:, 0], xy[:, 1]) + rng.normal(0.0, noise, n)
    return np.column_stack([xy, z]), np.full(n, noise)


def flat(x, y):
    return np.zeros_like(x)


def test_flat_cells_have_no_bias():
    points, sigma = cloud(np.random.default_rng(1), flat, noise=0.02, n=60000)
    cells = measure_cells(points, sigma, layout=SMALL, config=ElevationConfig())
    assert abs(cells.height.mean()) < 0.001


def test_cell_statistics_equal_numpy():
    points, sigma = cloud(np.random.default_rng(2), lambda x, y: 0.1 * x, n=4000)
    config = ElevationConfig(upper_quantile=0.5)
    cells = measure_cells(points, sigma, layout=SMALL, config=config)
    flat_index, _ = SMALL.flat_index(points[:, :2])
    for index, height, count, centroid in zip(cells.index, cells.height, cells.count, cells.centroid, strict=True):
        inside = points[flat_index == index]
        assert len(inside) == count
        np.testing.assert_allclose(height, np.median(inside[:, 2]), atol=1e-12)
        np.testing.assert_allclose(centroid, inside[:, :2].mean(axis=0))


def test_rock_is_not_averaged_away():
    """Two of five points on a rock's top: the cell has the rock's height."""
    rng = np.random.default_rng(3)
    z = np.where(np.arange(100) < 40, 0.30, 0.0) + rng.normal(0.0, 0.005, 100)
    points = np.column_stack([rng.uniform(-0.02, 0.02, (100, 2)), z])
    cells = measure_cells(points, np.full(100, 0.005), layout=SMALL, config=ElevationConfig())
    assert cells.height[0] > 0.28
    assert cells.variance[0] > 0.1**2


def test_stray_point_makes_no_spike():
    rng = np.random.default_rng(4)
    z = rng.normal(0.0, 0.005, 20)
    z[7] = 1.0
    points = np.column_stack([rng.uniform(-0.02, 0.02, (20, 2)), z])
    cells = measure_cells(points, np.full(20, 0.005), layout=SMALL, config=ElevationConfig())
    assert cells.height[0] < 0.02


def test_variance_shrinks_with_agreeing_views():
    rng = np.random.default_rng(5)
    terrain = TerrainMap(SMALL, config=FusionConfig())
    variances = []
    for _ in range(4):
        terrain.fuse_points(*cloud(rng, flat))
        variances.append(np.median(terrain.fused().variance[5:-5, 5:-5]))
    assert all(b < a for a, b in itertools.pairwise(variances))


def test_fused_height_is_nearer_than_one_view():
    rng = np.random.default_rng(6)
    shape = lambda x, y: 0.1 * np.sin(3 * x) * np.cos(2 * y)  # noqa: E731
    terrain = TerrainMap(SMALL, config=FusionConfig())
    errors = []
    truth = shape(*np.meshgrid(*SMALL.grid(np.zeros((41, 41))).centres(), indexing="ij"))
    for _ in range(6):
        terrain.fuse_points(*cloud(rng, shape, noise=0.03))
        errors.append(np.nanstd(terrain.fused().grid.heights - truth))
    assert errors[-1] < 0.6 * errors[0]


def test_unknown_stays_unknown():
    terrain = TerrainMap(SMALL, config=FusionConfig())
    assert terrain.fused().unknown.all()
    points, sigma = cloud(np.random.default_rng(7), flat)
    left = points[:, 0] < 0.0
    terrain.fuse_points(points[left], sigma[left])
    fused = terrain.fused()
    assert np.isnan(fused.grid.heights[22:]).all()
    assert fused.unknown[22:].all() and not fused.unknown[2:19, 2:-2].any()
    assert np.isinf(fused.variance[22:]).all()


def test_leg_fragment_seen_once_is_overridden():
    rng = np.random.default_rng(8)
    terrain = TerrainMap(SMALL, config=FusionConfig())
    fragment = lambda x, y: np.where(np.hypot(x, y) < 0.15, 0.4, 0.0)  # noqa: E731
    terrain.fuse_points(*cloud(rng, fragment))
    assert terrain.fused().grid.sample(np.zeros(2)) > 0.3
    terrain.fuse_points(*cloud(rng, flat))
    assert abs(terrain.fused().grid.sample(np.zeros(2))) < 0.02


def test_well_seen_ground_survives_one_fragment():
    rng = np.random.default_rng(9)
    terrain = TerrainMap(SMALL, config=FusionConfig())
    for _ in range(3):
        terrain.fuse_points(*cloud(rng, flat))
    terrain.fuse_points(*cloud(rng, lambda x, y: np.where(np.hypot(x, y) < 0.15, 0.4, 0.0)))
    assert abs(terrain.fused().grid.sample(np.zeros(2))) < 0.02


def test_moved_rock_is_unlearned_within_the_trust_limit():
    rng = np.random.default_rng(10)
    config = FusionConfig(trust_limit=3)
    terrain = TerrainMap(SMALL, config=config)
    for _ in range(8):
        terrain.fuse_points(*cloud(rng, lambda x, y: np.where(np.hypot(x, y) < 0.2, 0.3, 0.0)))
    for _ in range(3):
        terrain.fuse_points(*cloud(rng, flat))
    assert abs(terrain.fused().grid.sample(np.zeros(2))) < 0.02


def test_touched_ground_is_known():
    terrain = TerrainMap(SMALL, config=FusionConfig())
    terrain.set_known(np.array([[0.2, 0.1], [9.0, 9.0]]), np.array([0.07, 1.0]), radius=0.1, variance=1e-4)
    fused = terrain.fused()
    assert fused.grid.sample(np.array([0.2, 0.1])) == pytest.approx(0.07)
    assert 9 <= (~fused.unknown).sum() <= 16
    assert np.nanmax(fused.grid.heights) == pytest.approx(0.07)
    terrain.fuse_points(*cloud(np.random.default_rng(0), lambda x, y: np.full_like(x, 0.5)))
    assert terrain.fused().grid.sample(np.array([0.2, 0.1])) == pytest.approx(0.07, abs=0.01)


def test_snapshot_does_not_follow_the_map():
    terrain = TerrainMap(SMALL, config=FusionConfig())
    before = terrain.fused()
    terrain.fuse_points(*cloud(np.random.default_rng(0), flat))
    assert before.unknown.all()
    with pytest.raises(ValueError, match="read-only"):
        before.grid.heights[0, 0] = 1.0


@pytest.mark.parametrize("method", ["nearest", "highest", "smooth"])
def test_filling_leaves_no_gap_and_keeps_the_known(method):
    terrain = TerrainMap(SMALL, config=FusionConfig())
    points, sigma = cloud(np.random.default_rng(11), lambda x, y: 0.2 + 0.1 * y)
    keep = np.hypot(points[:, 0], points[:, 1]) > 0.4
    terrain.fuse_points(points[keep], sigma[keep])
    fused = terrain.fused()
    filled = fused.filled(method, margin=0.0)
    assert np.isfinite(filled.grid.heights).all()
    known = ~fused.unknown
    np.testing.assert_array_equal(filled.grid.heights[known], fused.grid.heights[known])
    np.testing.assert_array_equal(filled.unknown, fused.unknown)
    hole = np.s_[14:27, 14:27]
    guess = np.where(fused.unknown, filled.grid.heights, np.nan)[hole]
    assert np.nanmin(guess) > 0.1 and np.nanmax(guess) < 0.33


def test_highest_fill_is_nowhere_below_nearest():
    terrain = TerrainMap(SMALL, config=FusionConfig())
    points, sigma = cloud(np.random.default_rng(12), lambda x, y: 0.3 * np.sin(4 * x))
    keep = np.hypot(points[:, 0], points[:, 1]) > 0.4
    terrain.fuse_points(points[keep], sigma[keep])
    fused = terrain.fused()
    assert (fused.filled("highest").grid.heights >= fused.filled("nearest").grid.heights).all()


def depth_of_plane(height, pitch):
    camera = StereoCamera(
        name="hazcam_1",
        group="hazcam",
        baseline=0.15,
        eye=Pinhole.from_fov(512, 384, np.deg2rad(70.0)),
        link_from_camera=SE3.identity(),
    )
    forward, right = np.array([np.cos(pitch), 0.0, -np.sin(pitch)]), np.array([0.0, -1.0, 0.0])
    world_from_camera = SE3(np.column_stack([right, np.cross(forward, right), forward]), np.array([0.0, 0.0, height]))
    down = world_from_camera.rotate(camera.eye.rays())[..., 2]
    z = np.where(down < -0.05, -height / np.minimum(down, -0.05), np.nan)
    depth = DepthImage(
        camera=camera, eye=camera.eye, depth=z, sigma=z**2 * 0.003, grey=np.zeros((384, 512), dtype=np.uint8), t=0.0
    )
    return depth, world_from_camera


@pytest.mark.parametrize("outliers", ["neighbours", "statistical", "none"])
def test_depth_image_of_a_plane_fuses_to_the_plane(outliers):
    depth, world_from_camera = depth_of_plane(1.5, 0.8)
    terrain = TerrainMap.around(2.0, 0.0, config=FusionConfig(size_x=6.0, size_y=6.0, outliers=outliers))
    assert terrain.fuse(depth, world_from_camera) > 1000
    heights = terrain.fused().grid.heights
    assert np.nanmax(np.abs(heights)) < 1e-4


def test_stray_pixels_are_left_out():
    depth, world_from_camera = depth_of_plane(1.5, 0.8)
    rng = np.random.default_rng(13)
    depth.depth[rng.integers(10, 370, 400), rng.integers(10, 500, 400)] *= 0.6
    terrain = TerrainMap.around(2.0, 0.0, config=FusionConfig(size_x=6.0, size_y=6.0))
    terrain.fuse(depth, world_from_camera)
    assert np.nanmax(np.abs(terrain.fused().grid.heights)) < 0.01


@settings(max_examples=25, deadline=None)
@given(st.floats(-50, 50), st.floats(-50, 50), st.floats(0.03, 0.2))
def test_layout_is_centred_on_whole_cells(x, y, cell):
    layout = GridLayout.centred(x, y, size_x=4.0, size_y=3.0, cell=cell)
    assert abs(layout.origin_x + 0.5 * cell * (layout.nx - 1) - x) < 1.01 * cell
    assert abs(layout.origin_x / cell - round(layout.origin_x / cell)) < 1e-6
    index, inside = layout.flat_index(np.array([[x, y], [x + 10.0, y]]))
    assert inside.tolist() == [True, False] and index[1] == -1


def test_vague_cells_are_raised_by_what_their_sigma_exceeds_the_height_covered():
    terrain = TerrainMap(SMALL, config=FusionConfig())
    points, sigma = cloud(np.random.default_rng(13), lambda x, y: np.where(x > 0.2, 0.5, 0.0))
    keep = np.hypot(points[:, 0], points[:, 1]) > 0.3
    terrain.fuse_points(points[keep], sigma[keep])
    fused = terrain.fused().filled("highest")
    raised = fused.raised(3.0, over=0.05)
    clearance = 0.07
    known = ~fused.unknown
    # A clearance from the raised ground is the larger of that clearance and a base of 2 cm with 3 sigma.
    wanted = fused.grid.heights + np.maximum(clearance, 0.02 + 3.0 * fused.sigma)
    np.testing.assert_allclose((raised.grid.heights + clearance)[known], wanted[known], atol=1e-12)
    np.testing.assert_array_equal(raised.grid.heights[~known], fused.grid.heights[~known])
    edge = np.abs(SMALL.grid(fused.grid.heights).centres()[0] - 0.2) < SMALL.cell
    lift = raised.grid.heights - fused.grid.heights
    assert lift[edge][known[edge]].max() > 0.02 and np.median(lift[known]) == 0.0
    np.testing.assert_array_equal(fused.raised(0.0, over=0.05).grid.heights, fused.grid.heights)


def test_misuse_is_refused():
    with pytest.raises(ConfigError, match="must not be negative"):
        TerrainMap(SMALL, config=FusionConfig()).fused().raised(-1.0, over=0.05)
    with pytest.raises(ConfigError, match="outliers 'some'"):
        FusionConfig(outliers="some")
    with pytest.raises(ConfigError, match=r"fill 'zero'.*nearest"):
        TerrainMap(SMALL, config=FusionConfig()).fused().filled("zero")
    with pytest.raises(TerrainError, match="nothing to fill from"):
        TerrainMap(SMALL, config=FusionConfig()).fused().filled("nearest")
    with pytest.raises(TerrainError, match="as many sigmas"):
        measure_cells(np.zeros((3, 3)), np.zeros(2), layout=SMALL, config=ElevationConfig())
    with pytest.raises(TerrainError, match="positive size"):
        GridLayout(origin_x=0.0, origin_y=0.0, cell=0.0, nx=4, ny=4)
    with pytest.raises(ConfigError, match="upper_quantile"):
        ElevationConfig(upper_quantile=1.0)
    with pytest.raises(ConfigError, match="min_points"):
        ElevationConfig(min_points=0)
    with pytest.raises(ConfigError, match="trust_limit"):
        FusionConfig(trust_limit=0)
