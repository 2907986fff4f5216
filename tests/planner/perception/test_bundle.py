"""Injected mounting errors come back from overlapping views; views without overlap are left alone."""

import numpy as np
import pytest

from athlete_twin.errors import ConfigError
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.spec import load_spec
from planner.perception.bundle import BundleConfig, MountCalibration, View

TURN, SHIFT = np.deg2rad(0.2), 0.005


def ground(x, y):
    return 0.05 * np.sin(1.3 * x + 0.4) * np.cos(1.7 * y) + 0.03 * np.sin(4.1 * x - 2.0 * y)


def true_points(rng, world_from_camera, eye, *, reach, noise):
    """What a camera sees of the ground, in its own frame: points drawn on the ground, kept where its picture has them."""
    xy = world_from_camera.translation[:2] + rng.uniform(-0.7 * reach, 0.7 * reach, (500000, 2))
    points = np.column_stack([xy, ground(xy[:, 0], xy[:, 1])])
    in_camera = world_from_camera.inverse().apply(points)
    pixel, depth = eye.project(in_camera)
    seen = (depth > 0.5) & (depth < reach) & (np.abs(pixel - [eye.cx_px, eye.cy_px]) < [eye.width_px / 2, eye.height_px / 2]).all(axis=1)
    kept = in_camera[seen]
    return kept * (1.0 + rng.normal(0.0, noise, (len(kept), 1)) / np.linalg.norm(kept, axis=1, keepdims=True))


def looks(robot, cameras, seed, *, sets=1, refine=None):
    """Truth, calibration after the sets, and the refinements."""
    spec, rng = load_spec(robot), np.random.default_rng(seed)
    world_from_hex = SE3.from_translation(np.array([0.0, 0.0, spec.chassis_height]))
    error = {
        c.name: SE3.from_rotvec(rng.normal(0.0, TURN, 3), rng.normal(0.0, SHIFT, 3)) for c in spec.cameras
    }
    mounts = MountCalibration(tuple(c.name for c in spec.cameras), config=refine or BundleConfig())
    made = []
    for _ in range(sets):
        views = []
        for name in cameras:
            camera = spec.camera(name)
            drawn = world_from_hex.compose(camera.hex_from_camera)
            points = true_points(rng, drawn.compose(error[name]), camera.eye, reach=6.0, noise=0.01)
            believed = drawn.compose(mounts.correction(name))
            views.append(
                View(
                    camera=name, world_from_camera=believed, points_in_world=believed.apply(points),
                    sigma_z=np.full(len(points), 0.01),
                )
            )  # fmt: skip
        made.append(mounts.refine(views))
    return spec, error, mounts, made


def disagreement(spec, cameras, error, correction):
    """RMS over pairs of cameras of the height by which both put the same ground 3 m away, 1 m to the side, apart [m]."""
    spread = []
    for a in cameras:
        for b in cameras:
            if a >= b:
                continue
            apart = []
            for at in np.array([[1.5, 0.0, -1.5], [0.0, 1.5, -1.5], [-1.5, 0.0, -1.5], [0.0, -1.5, -1.5], [3.0, 3.0, -1.5]]):
                z = []
                for name in (a, b):
                    drawn = spec.camera(name).hex_from_camera
                    truth = drawn.compose(error[name]).inverse().apply(at)
                    z.append(drawn.compose(correction(name)).apply(truth)[2])
                apart.append(z[0] - z[1])
            spread.append(np.mean(np.square(apart)))
    return float(np.sqrt(np.mean(spread)))


@pytest.mark.slow
@pytest.mark.ci
def test_overlapping_hazcams_of_t12_recover_more_than_half_of_the_relative_error():
    ratios = []
    for seed in range(3):
        cameras = tuple(f"hazcam_{k}" for k in range(1, 7))
        spec, error, mounts, made = looks("t12", cameras, seed)
        assert made[0].cells > 1000 and made[0].rms_after < made[0].rms_before
        before = disagreement(spec, cameras, error, lambda _name: SE3.identity())
        ratios.append(disagreement(spec, cameras, error, mounts.correction) / before)
    assert max(ratios) < 0.5, ratios


@pytest.mark.slow
@pytest.mark.ci
def test_later_sets_do_not_undo_the_first():
    cameras = tuple(f"hazcam_{k}" for k in range(1, 7))
    spec, error, one, _ = looks("t12", cameras, 5, sets=1)
    _, _, three, _ = looks("t12", cameras, 5, sets=3)
    assert disagreement(spec, cameras, error, three.correction) < 1.2 * disagreement(spec, cameras, error, one.correction)


@pytest.mark.slow
@pytest.mark.ci
def test_sdm_b_with_its_poor_overlap_takes_no_harm():
    """Every pose's own error, over all cameras, does not grow, whatever little the views share."""
    for seed in range(3):
        spec = load_spec("sdm_b")
        names = tuple(c.name for c in spec.cameras if c.on_chassis)
        spec, error, mounts, _ = looks("sdm_b", names, seed)
        sizes = []
        for correction in (lambda _name: SE3.identity(), mounts.correction):
            left = [correction(n).inverse().compose(error[n]) for n in names]
            sizes.append(np.sum([np.sum((e.rotvec() / TURN) ** 2) + np.sum((e.translation / SHIFT) ** 2) for e in left]))
        assert sizes[1] < 1.05 * sizes[0], sizes


def test_one_view_alone_is_left_where_it_is():
    _, _, mounts, made = looks("t12", ("hazcam_1",), 0)
    assert made[0].cells == 0 and np.isnan(made[0].rms_before)
    np.testing.assert_array_equal(mounts.correction("hazcam_1").matrix(), np.eye(4))
    np.testing.assert_array_equal(mounts.correction("no such camera").matrix(), np.eye(4))


def test_the_gauge_is_fixed_by_the_prior():
    """All views off by the same shift of the world show nothing: nothing is corrected beyond noise."""
    spec, rng = load_spec("t12"), np.random.default_rng(0)
    mounts = MountCalibration(tuple(c.name for c in spec.cameras), config=BundleConfig())
    world_from_hex = SE3.from_translation(np.array([0.0, 0.0, spec.chassis_height]))
    views = []
    for k in range(1, 7):
        pose = world_from_hex.compose(spec.camera(f"hazcam_{k}").hex_from_camera)
        points = true_points(rng, pose, spec.camera(f"hazcam_{k}").eye, reach=6.0, noise=0.005)
        higher = SE3(pose.rotation, pose.translation + [0.0, 0.0, 0.03])
        views.append(
            View(
                camera=f"hazcam_{k}", world_from_camera=higher, points_in_world=higher.apply(points),
                sigma_z=np.full(len(points), 0.01),
            )
        )  # fmt: skip
    mounts.refine(views)
    assert max(np.linalg.norm(mounts.correction(v.camera).translation) for v in views) < 0.002


def test_wrong_settings_are_refused():
    with pytest.raises(ConfigError, match=r"mount_shift and mount_turn_deg are 0.0 and 0.2"):
        BundleConfig(mount_shift=0.0)
    with pytest.raises(ConfigError, match="refine 'all' is not one of mountings, none"):
        BundleConfig(refine="all")
    with pytest.raises(ConfigError, match="memory is 2"):
        BundleConfig(memory=2.0)
