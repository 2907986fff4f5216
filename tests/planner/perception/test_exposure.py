"""Brackets against the radiance they were taken of, and against OpenCV's merging."""

import dataclasses

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from athlete_twin.errors import CameraError, ConfigError
from athlete_twin.geometry.se3 import SE3
from athlete_twin.sensors.stereo_camera import RESPONSE, develop
from planner.perception.exposure import ExposureConfig, merged, radiances, toned
from planner.perception.stereo import StereoConfig, match

HERE = SE3.identity()


def taken(pair, left, right, exposure, *, bracket=0, bits=8, seed=3):
    """The pair as a camera of the twin takes these radiances."""
    rng = np.random.default_rng([seed, bracket])
    if bits == 8:
        images = [develop(r, exposure, binning=1, rng=rng) for r in (left, right)]
    else:
        images = [
            np.clip(np.rint(4095 * (r * exposure * RESPONSE + rng.normal(0, 0.002, r.shape))), 0, 4095).astype(np.uint16)
            for r in (left, right)
        ]
    return dataclasses.replace(pair, left=images[0], right=images[1], exposure=exposure, bits=bits, bracket=bracket)


@pytest.fixture
def half_in_shade(synth):
    """A plane whose right half lies in a shadow thirty times darker: camera, pair to fill, both radiances, the shade."""
    camera = synth.looking(1.5, 50.0)
    scene = synth.Scene()
    pair = scene.pair(camera, HERE, noise=0.0)
    light, shade = [], None
    for pose in (camera.hex_from_camera, camera.hex_from_right()):
        depth, grey, _ = scene.trace(pose, camera.eye)
        points = pose.apply(camera.eye.rays() * depth[..., None])
        dark = points[..., 1] < 0.0
        shade = dark if shade is None else shade
        light.append(np.where(dark, 1.0 / 30.0, 1.0) * grey / 255.0)
    return camera, scene, pair, light, shade


def test_single_8_bit_pair_passes_untouched(synth):
    pair = synth.Scene().pair(synth.looking(1.5, 50.0), HERE)
    assert merged([pair]) is pair


def test_merged_radiance_is_the_true_one(half_in_shade):
    _, _, pair, (left, right), shade = half_in_shade
    metered = 0.85 / (RESPONSE * left.max())
    bracket = [taken(pair, left, right, metered * m, bracket=k) for k, m in enumerate((1.0, 4.0, 16.0))]
    found, _ = radiances(bracket, config=ExposureConfig())
    relative = found.value / (left * RESPONSE) - 1.0
    assert found.told.mean() > 0.99
    assert abs(np.median(relative)) < 0.005
    assert np.median(np.abs(relative[shade])) < 0.02
    alone, _ = radiances(bracket[:1], config=ExposureConfig())
    assert np.median(np.abs(alone.value / (left * RESPONSE) - 1.0)[shade]) > 2.0 * np.median(np.abs(relative[shade]))


def test_merging_agrees_with_opencv(half_in_shade):
    _, _, pair, (left, right), _ = half_in_shade
    metered = 0.85 / (RESPONSE * left.max())
    bracket = [taken(pair, left, right, metered * m, bracket=k) for k, m in enumerate((1.0, 4.0, 16.0))]
    response = np.repeat(np.maximum(np.arange(256, dtype=np.float32), 1.0).reshape(256, 1, 1), 3, axis=2)
    colour = [cv2.cvtColor(p.left, cv2.COLOR_GRAY2BGR) for p in bracket]
    times = np.array([p.exposure for p in bracket], dtype=np.float32)
    theirs = cv2.createMergeDebevec().process(colour, times, response)[..., 0] / 255.0
    ours, _ = radiances(bracket, config=ExposureConfig())
    assert np.median(np.abs(ours.value / theirs - 1.0)) < 0.03


def test_bracket_gives_the_shade_its_depth(half_in_shade):
    camera, scene, pair, (left, right), shade = half_in_shade
    truth = scene.trace(camera.hex_from_camera, camera.eye)[0]
    metered = 0.85 / (RESPONSE * left.max())
    bracket = [taken(pair, left, right, metered * m, bracket=k) for k, m in enumerate((1.0, 4.0, 16.0))]
    right_share, lit_share = [], []
    for images in (bracket[:1], bracket):
        depth = match(merged(images), camera, config=StereoConfig())
        good = np.abs(depth.depth - truth) < 0.02
        right_share.append(good[shade].mean())
        lit_share.append(good[~shade].mean())
    assert right_share[1] > right_share[0] + 0.2
    assert lit_share[1] > lit_share[0] - 0.03


def test_deep_image_becomes_eight_bits_and_its_lit_half_the_same_plane(half_in_shade):
    camera, scene, pair, (left, right), shade = half_in_shade
    deep = taken(pair, left, right, 0.85 / (RESPONSE * left.max()), bits=12)
    with pytest.raises(CameraError, match=r"uint16.*exposure\.merged"):
        match(deep, camera, config=StereoConfig())
    shallow = merged([deep])
    assert shallow.left.dtype == np.uint8
    assert shallow.bits == 8
    depth = match(shallow, camera, config=StereoConfig())
    error = np.abs(depth.depth - scene.trace(camera.hex_from_camera, camera.eye)[0])
    assert np.nanmedian(error[~shade]) < 0.01


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), decades=st.floats(0.0, 4.0), dark=st.floats(1e-9, 1.0))
def test_curve_is_monotone_and_the_same_for_both_eyes(seed, decades, dark):
    light = 10.0 ** (decades * np.random.default_rng(seed).random((16, 24)))
    left, right = toned(light, light[::-1].copy(), dark=dark, config=ExposureConfig())
    order = np.argsort(light.ravel())
    assert (np.diff(left.ravel()[order].astype(int)) >= 0).all()
    assert np.array_equal(left[::-1], right)


def test_what_no_exposure_tells_is_marked_and_stays_bounded(half_in_shade):
    _, _, pair, (left, right), _ = half_in_shade
    burnt = taken(pair, 1e3 * left, 1e3 * right, 0.01)
    found, _ = radiances([burnt], config=ExposureConfig())
    assert not found.told.any()
    assert np.isfinite(found.value).all()


def test_brackets_that_do_not_belong_together_are_refused(synth):
    pair = synth.Scene().pair(synth.looking(1.5, 50.0), HERE)
    with pytest.raises(CameraError, match="no pairs"):
        merged([])
    with pytest.raises(CameraError, match="one camera and instant"):
        merged([pair, dataclasses.replace(pair, t=6.0)])
    with pytest.raises(CameraError, match="mixes sizes"):
        merged([pair, dataclasses.replace(pair, left=pair.left[:100], right=pair.right[:100])])
    with pytest.raises(CameraError, match="exposure"):
        merged([pair, dataclasses.replace(pair, exposure=0.0)])
    with pytest.raises(ConfigError, match="full_well"):
        ExposureConfig(full_well=-1.0)
    with pytest.raises(ConfigError, match="white_share"):
        ExposureConfig(white_share=1.5)
    with pytest.raises(ConfigError, match="percentiles"):
        ExposureConfig(low_percentile=99.9)
