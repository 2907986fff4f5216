import dataclasses

import cv2
import numpy as np
import pytest

from athlete_twin.errors import CameraError, ConfigError
from athlete_twin.geometry.se3 import SE3
from planner.perception.stereo import StereoConfig, match

HERE = SE3.identity()


def test_depth_of_a_plane_is_the_closed_form(synth):
    camera = synth.looking(1.5, 50.0)
    scene = synth.Scene()
    depth = match(scene.pair(camera, HERE), camera, config=StereoConfig())
    truth = scene.trace(camera.hex_from_camera, camera.eye)[0]
    error = np.abs(depth.depth - truth)
    seen = np.isfinite(depth.depth)
    assert seen.mean() > 0.8
    assert np.median(error[seen]) < 0.01
    assert np.quantile(error[seen], 0.95) < 0.04


def test_back_projected_plane_lies_on_the_ground(synth):
    camera = synth.looking(1.5, 45.0)
    depth = match(synth.Scene().pair(camera, HERE), camera, config=StereoConfig())
    z = camera.hex_from_camera.apply(depth.points_in_camera())[..., 2]
    assert abs(np.nanmedian(z)) < 0.005


@pytest.mark.parametrize("noise", [1.0, 3.0])
@pytest.mark.parametrize("width", [512, 1024])
def test_sigma_describes_the_error(synth, width, noise):
    camera = synth.looking(1.2, 30.0, width=width, rows=3 * width // 4)
    scene = synth.Scene()
    depth = match(scene.pair(camera, HERE, noise=noise), camera, config=StereoConfig())
    z = np.abs(depth.depth - scene.trace(camera.hex_from_camera, camera.eye)[0]) / depth.sigma
    z = z[np.isfinite(z)]
    # A normal error: 0.683 and 0.954. A texture of another kind than the rendered soil that the constants come from.
    assert 0.55 < np.mean(z < 1.0) < 0.85
    assert np.mean(z < 2.0) > 0.88
    assert np.array_equal(np.isnan(depth.sigma), np.isnan(depth.depth))


def test_sigma_grows_with_the_square_of_depth(synth):
    camera = synth.looking(1.2, 30.0)
    config = StereoConfig(sigma_floor_px=0.5, noise_gain=0.0, roughness_gain=0.0)
    depth = match(synth.Scene().pair(camera, HERE, noise=0.0), camera, config=config)
    constant = depth.eye.focal_px * camera.baseline
    np.testing.assert_allclose(depth.sigma, depth.depth**2 * 0.5 / constant, rtol=1e-3)


def test_half_sized_search_finds_what_the_full_one_finds(synth):
    camera = synth.looking(1.5, 45.0, width=1024, rows=768)
    scene = synth.Scene([synth.Cylinder(2.0, 0.2, 0.15, 0.0, 0.5)])
    pair = scene.pair(camera, HERE)
    truth = scene.trace(camera.hex_from_camera, camera.eye)[0]
    whole = match(pair, camera, config=StereoConfig(full_width_px=2000))
    half = match(pair, camera, config=StereoConfig())
    errors = [np.abs(d.depth - truth) for d in (whole, half)]
    assert abs(np.isfinite(half.depth).mean() - np.isfinite(whole.depth).mean()) < 0.03
    assert np.nanmedian(errors[1]) < 1.1 * np.nanmedian(errors[0])
    assert np.nanquantile(errors[1], 0.98) < 0.05


@pytest.mark.parametrize("width", [512, 1024])
def test_threads_do_not_change_a_byte(synth, width):
    camera = synth.looking(1.5, 50.0, width=width, rows=3 * width // 4)
    pair = synth.Scene().pair(camera, HERE)
    before = cv2.getNumThreads()
    found = []
    try:
        for threads in (1, 2, 4):
            cv2.setNumThreads(threads)
            depth = match(pair, camera, config=StereoConfig())
            found.append(depth.depth.tobytes() + depth.sigma.tobytes())
    finally:
        cv2.setNumThreads(before)
    assert found[0] == found[1] == found[2]


def test_binned_pair_gives_the_same_plane(synth):
    camera = synth.looking(1.5, 50.0, width=1024, rows=768)
    scene = synth.Scene()
    depth = match(scene.pair(camera, HERE, binning=2), camera, config=StereoConfig())
    truth = scene.trace(camera.hex_from_camera, depth.eye)[0]
    assert depth.depth.shape == (384, 512)
    assert np.nanmedian(np.abs(depth.depth - truth)) < 0.01


def test_far_ground_is_seen_up_to_the_left_border(synth):
    camera = synth.looking(1.5, 50.0)
    depth = match(synth.Scene().pair(camera, HERE), camera, config=StereoConfig())
    shift = camera.eye.focal_px * camera.baseline / np.nanmedian(depth.depth)
    first = np.argmax(np.isfinite(depth.depth).mean(axis=0) > 0.5)
    assert first < 1.3 * shift


def test_textureless_ground_is_unknown(synth):
    camera = synth.looking(1.5, 50.0)
    pair = synth.Scene().pair(camera, HERE)
    rng = np.random.default_rng(0)
    flat = [np.clip(np.rint(rng.normal(30.0, 1.5, pair.left.shape)), 0, 255).astype(np.uint8) for _ in range(2)]
    depth = match(dataclasses.replace(pair, left=flat[0], right=flat[1]), camera, config=StereoConfig())
    assert np.isfinite(depth.depth).mean() < 0.02


def test_same_pair_gives_the_same_bytes(synth):
    camera = synth.looking(1.5, 50.0)
    pair = synth.Scene().pair(camera, HERE)
    first = match(pair, camera, config=StereoConfig())
    second = match(pair, camera, config=StereoConfig())
    assert first.depth.tobytes() == second.depth.tobytes()


def test_pair_of_another_camera_is_refused(synth):
    camera = synth.looking(1.5, 50.0)
    pair = synth.Scene().pair(camera, HERE)
    with pytest.raises(CameraError, match="comes from camera 'hazcam_9'"):
        match(dataclasses.replace(pair, camera="hazcam_9"), camera, config=StereoConfig())
    with pytest.raises(CameraError, match="need"):
        match(dataclasses.replace(pair, binning=2), camera, config=StereoConfig())


def test_bad_settings_are_refused(synth):
    with pytest.raises(ConfigError, match=r"fast.*3way"):
        StereoConfig(mode="fast")
    with pytest.raises(ConfigError, match="odd"):
        StereoConfig(block_px=4)
    with pytest.raises(ConfigError, match="depth_range of hazcam"):
        StereoConfig(depth_range={"hazcam": (2.0, 1.0)})
    camera = synth.looking(1.5, 50.0, group="periscope")
    with pytest.raises(ConfigError, match="periscope"):
        match(synth.Scene().pair(camera, HERE), camera, config=StereoConfig())
