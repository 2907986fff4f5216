import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from athlete_twin.errors import ConfigError, SupportError
from athlete_twin.geometry.open3d_loader import open3d
from athlete_twin.geometry.se3 import SE3
from planner.perception.localise import AlignConfig, WheelFitConfig, align_to_map, fit_wheels, pose_from_wheels
from planner.terrain.elevation import GridLayout
from planner.terrain.fusion import FusionConfig, TerrainMap

ANGLES = np.deg2rad([0.0, 60.0, 120.0, 180.0, 240.0, 300.0])
WHEELS = np.column_stack([1.95 * np.cos(ANGLES), 1.95 * np.sin(ANGLES), np.full(6, -1.5)])
ALL = np.ones(6, dtype=bool)
LAYOUT = GridLayout(origin_x=-2.0, origin_y=-2.0, cell=0.05, nx=81, ny=81)


def bumps(x, y):
    return 0.12 * np.sin(2.1 * x + 0.4) * np.cos(1.7 * y) + 0.05 * np.sin(5.0 * y + x)


def cloud(seed, n=40000, noise=0.008, spread=1.9, shape=bumps):
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-spread, spread, (n, 2))
    return np.column_stack([xy, shape(xy[:, 0], xy[:, 1]) + rng.normal(0.0, noise, n)])


def fused(shape=bumps):
    terrain = TerrainMap(LAYOUT, config=FusionConfig())
    for seed in range(3):
        points = cloud(seed, shape=shape)
        terrain.fuse_points(points, np.full(len(points), 0.008))
    return terrain.fused()


@settings(max_examples=30, deadline=None)
@given(
    st.floats(-0.2, 0.2), st.floats(-0.2, 0.2), st.floats(-3.0, 3.0), st.floats(-5, 5), st.floats(-5, 5),
    st.sets(st.integers(0, 5), min_size=3),
)  # fmt: skip
def test_exact_wheels_give_the_exact_pose(roll, pitch, yaw, x, y, legs):
    truth = SE3.from_rpy(roll, pitch, yaw, np.array([x, y, 1.7]))
    planted = np.isin(np.arange(6), list(legs))
    wheels = WHEELS + np.array([[0.0, 0.0, 0.1 * (k % 3)] for k in range(6)])
    anchors = np.where(planted[:, None], truth.apply(wheels), np.nan)
    pose = pose_from_wheels(wheels, anchors, planted=planted, attitude_rpy=np.array([roll, pitch, yaw + 0.3]))
    np.testing.assert_allclose(pose.matrix(), truth.matrix(), atol=1e-6)


def test_wheels_correct_a_biased_attitude_and_it_corrects_them():
    truth = SE3.from_rpy(0.02, -0.03, 0.4, np.array([1.0, 2.0, 1.7]))
    attitude = np.array([0.02 + 0.004, -0.03, 0.4])
    fit = fit_wheels(WHEELS, truth.apply(WHEELS), planted=ALL, attitude_rpy=attitude)
    error = np.abs(fit.world_from_hex.rpy()[0] - 0.02)
    assert 0.0 < error < 0.003
    sagged = truth.apply(WHEELS) + np.array([[0, 0, 0.03]] * 2 + [[0, 0, 0.0]] * 4)
    wheels_only = fit_wheels(
        WHEELS, sagged, planted=ALL, attitude_rpy=truth.rpy(), config=WheelFitConfig(attitude_sigma=10.0)
    )
    both = fit_wheels(WHEELS, sagged, planted=ALL, attitude_rpy=truth.rpy())
    angle = [np.linalg.norm(f.world_from_hex.compose(truth.inverse()).rotvec()) for f in (wheels_only, both)]
    assert angle[1] < 0.7 * angle[0]


def test_slipped_wheel_is_outvoted():
    truth = SE3.from_rpy(0.0, 0.0, 0.2, np.array([0.5, 0.0, 1.7]))
    anchors = truth.apply(WHEELS)
    anchors[2] += np.array([0.15, -0.1, 0.0])
    fit = fit_wheels(WHEELS, anchors, planted=ALL, attitude_rpy=np.array([0.0, 0.0, 0.2]))
    assert np.linalg.norm(fit.world_from_hex.translation - truth.translation) < 0.015
    assert np.argmax(np.linalg.norm(fit.misfit, axis=1)) == 2


def test_two_wheels_are_refused():
    planted = np.array([True, True, False, False, False, False])
    with pytest.raises(SupportError, match="2 planted wheels"):
        pose_from_wheels(WHEELS, WHEELS, planted=planted, attitude_rpy=np.zeros(3))
    with pytest.raises(ConfigError, match="anchor_sigma"):
        WheelFitConfig(anchor_sigma=0.0)


def test_alignment_recovers_a_known_motion_on_bumps():
    points = cloud(9, spread=1.6)
    moved = SE3.from_rpy(0.004, -0.005, 0.01, np.array([0.04, -0.03, 0.02]))
    result = align_to_map(moved.inverse().apply(points), fused())
    assert result.accepted, result.reason
    left = result.correction.compose(moved.inverse())
    middle = left.apply(np.zeros(3))
    assert np.linalg.norm(middle) < 0.006
    assert np.linalg.norm(left.rotvec()) < 0.002
    assert result.rmse < 0.5 * result.rmse_before


def test_alignment_agrees_with_open3d():
    """Point-to-plane ICP on the raw points of both sides, unaware of any grid."""
    o3d = open3d()
    reference, points = cloud(1, noise=0.004), cloud(9, spread=1.6, noise=0.004)
    moved = SE3.from_rpy(0.004, -0.005, 0.01, np.array([0.03, -0.02, 0.02]))
    source = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(moved.inverse().apply(points)[::8]))
    target = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(reference)).voxel_down_sample(0.05)
    target.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(0.15, 30))
    icp = o3d.pipelines.registration.registration_icp(
        source, target, 0.1, np.eye(4), o3d.pipelines.registration.TransformationEstimationPointToPlane()
    )
    ours = align_to_map(moved.inverse().apply(points), fused()).correction
    difference = SE3.from_matrix(np.array(icp.transformation)).compose(ours.inverse())
    assert np.linalg.norm(difference.apply(np.zeros(3))) < 0.01
    assert np.linalg.norm(difference.rotvec()) < 0.004


def test_plane_gives_no_sideways_motion():
    plane = lambda x, y: np.zeros_like(x)  # noqa: E731
    points = cloud(9, spread=1.6, shape=plane) + np.array([0.05, -0.05, 0.03])
    result = align_to_map(points, fused(plane))
    assert result.accepted, result.reason
    np.testing.assert_allclose(result.correction.apply(np.zeros(3)), [0.0, 0.0, -0.03], atol=0.006)


def test_what_the_cameras_err_by_on_smooth_ground_does_not_hold_the_robot_where_it_was():
    """The same waves of 4 mm in every view, carried along by the robot: on smooth ground they look like a robot that stood still."""

    def seen(at, ground):
        xy = np.random.default_rng(7).uniform(-1.6, 1.6, (40000, 2))
        height = ground(xy[:, 0], xy[:, 1]) + 0.004 * np.sin(9.0 * (xy[:, 0] - at)) * np.cos(7.0 * xy[:, 1])
        return np.column_stack([xy, height])

    def found(ground, config=None):
        terrain = TerrainMap(LAYOUT, config=FusionConfig())
        terrain.fuse_points(seen(0.0, ground), np.full(40000, 0.004))
        return align_to_map(seen(0.10, ground), terrain.fused(), config=config)

    def yard(x, y):
        return 0.006 * np.sin(0.9 * x + 0.3 * y)

    fooled = found(yard, AlignConfig(least_relief=0.0))
    assert fooled.accepted and abs(fooled.correction.apply(np.zeros(3))[0]) > 0.03
    smooth = found(yard)
    assert np.abs(smooth.correction.apply(np.zeros(3))[:2]).max() < 2e-3 and not smooth.information[[2, 3, 4]].any()
    assert smooth.information[5, 5] > 0.0
    rough = found(bumps)
    assert np.abs(rough.correction.apply(np.zeros(3))[:2]).max() < 0.01 and (np.diag(rough.information) > 0.0).all()


def test_aligned_view_is_left_alone():
    result = align_to_map(cloud(9, spread=1.6), fused())
    assert np.linalg.norm(result.correction.apply(np.zeros(3))) < 0.004
    assert np.linalg.norm(result.correction.rotvec()) < 0.0015


def test_false_fits_are_refused_with_a_reason():
    terrain = fused()
    few = align_to_map(cloud(9, spread=0.2), terrain)
    assert not few.accepted and "overlap of" in few.reason
    np.testing.assert_array_equal(few.correction.matrix(), np.eye(4))
    far = align_to_map(cloud(9, spread=1.5) + np.array([0.0, 0.0, 0.6]), terrain)
    assert not far.accepted and far.reason
    other = align_to_map(cloud(9, spread=1.6, shape=lambda x, y: 0.3 * np.sin(9.0 * x) * np.sin(8.0 * y)), terrain)
    assert not other.accepted and "fit within" in other.reason


def test_empty_view_is_refused():
    result = align_to_map(np.zeros((0, 3)), fused())
    assert not result.accepted and "overlap of 0" in result.reason
