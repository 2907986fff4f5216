"""Scenes are what they say: errors of the size asked for, rocks beside wheels, a raised leg in odd ones, the same bytes again."""

import sys
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

from athlete_twin.errors import ConfigError
from planner.perception.stereo import StereoConfig, match

sys.path.insert(0, str(Path(__file__).parents[2] / "scripts"))
try:
    masks, scenes = import_module("perception_masks"), import_module("perception_scenes")
finally:
    sys.path.pop(0)

ROW_KEYS = {"name", "ours", "unit", "peer_name", "peer", "ratio", "target", "met"}


def test_pose_error_has_its_size_in_a_direction_of_its_own():
    errors = [scenes.pose_error(seed, camera) for seed in (0, 1) for camera in ("hazcam_1", "hazcam_2")]
    for e in errors:
        assert np.linalg.norm(e.translation) == pytest.approx(scenes.POSE_ERROR)
        assert np.linalg.norm(e.rotvec()) == pytest.approx(scenes.ANGLE_ERROR)
    directions = np.array([e.translation / scenes.POSE_ERROR for e in errors])
    assert np.abs(directions @ directions.T - np.eye(4)).max() < 0.999
    np.testing.assert_array_equal(scenes.pose_error(1, "hazcam_2").matrix(), errors[3].matrix())


def test_merged_bracket_is_the_light_wherever_one_exposure_saw_it():
    light = np.geomspace(0.004, 0.9, 200)[None].repeat(3, axis=0)
    exposures = [0.25, 1.0, 4.0]
    shots = [np.clip(np.rint(255.0 * light / 0.25 * s / 4.0), 0, 255).astype(np.uint8) for s in exposures]
    grey = scenes.merged(shots, exposures).astype(float)
    expected = 255.0 * np.sqrt(light / 4.0)
    # A grey level of the longest exposure is the resolution in the dark, half a level of the result elsewhere.
    assert np.abs(grey - expected).max() < 2.5
    assert (np.diff(grey[0]) >= 0.0).all()


def test_scenes_that_do_not_exist_are_refused():
    with pytest.raises(ConfigError, match="scene -1 does not exist"):
        scenes.stand("sdm_b", -1)
    with pytest.raises(ConfigError, match="0 scenes measure nothing"):
        masks.rows(robots=("sdm_b",), scenes=0)


@pytest.mark.slow
def test_an_odd_scene_has_a_raised_leg_in_view_and_rocks_beside_wheels():
    scene = scenes.stand("sdm_b", 1)
    assert scene.raised is not None
    heights = scene.wheels_in_world[:, 2] - scene.terrain.grid.sample(scene.wheels_in_world[:, :2])
    assert heights[scene.raised] > 1.5 * scene.spec.wheel.radius
    assert (np.delete(heights, scene.raised) < 1.05 * scene.spec.wheel.radius).all()
    rocks = np.array([[r.x, r.y, 0.5 * r.diameter] for r in scene.terrain.rocks])
    gaps = np.linalg.norm(rocks[:, None, :2] - scene.wheels_in_world[None, :, :2], axis=2) - rocks[:, None, 2]
    assert np.count_nonzero((gaps < 0.4).any(axis=0)) >= 2
    seen = next(scenes.look(scene, 35.0, binning=4))
    view = scenes.taken(scene, seen, sun_deg=35.0, binning=4)
    assert np.count_nonzero(view.leg == scene.raised) > 100
    assert ((view.leg >= 0) <= (view.label == 3)).all()
    again = scenes.taken(scene, next(scenes.look(scene, 35.0, binning=4)), sun_deg=35.0, binning=4)
    np.testing.assert_array_equal(again.pair.left, view.pair.left)
    result = masks.masked_by("combined", view, match(view.pair, view.camera, config=StereoConfig()))
    assert result.mask[view.leg == scene.raised].mean() > 0.9


@pytest.mark.slow
def test_rows_have_the_benchmarks_shape():
    made = masks.rows(robots=("sdm_b",), scenes=1)
    assert all(set(r) == ROW_KEYS for r in made)
    assert any("the paper's failure" in r["name"] and r["peer_name"] == "watershed" for r in made)
    assert any(r["name"] == "sdm_b combined, sun 15 deg: terrain lost" and r["met"] is not None for r in made)
