"""The leg mask's score counts what a hand counts on a drawn picture."""

import numpy as np
import pytest

from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.spec import load_spec
from athlete_twin.robot import ViewTruth
from envs.mask_score import MaskCounts, MaskScore, count_mask
from planner.eyes import Look
from planner.perception.self_mask import MaskedDepth
from planner.perception.stereo import DepthImage

SPEC = load_spec("sdm_b")
SHAPE = (40, 60)


def view(label: np.ndarray) -> ViewTruth:
    # A pixel shows a square centimetre of flat ground; a wheel stands at (0.2, 0.3).
    x, y = np.meshgrid(0.01 * np.arange(SHAPE[0]), 0.01 * np.arange(SHAPE[1]), indexing="ij")
    points = np.stack([x, y, np.zeros(SHAPE)], axis=-1)
    wheels = np.full((6, 3), 50.0)
    wheels[2] = [0.2, 0.3, 0.24]
    return ViewTruth(
        t=1.0, camera="navcam_1", label=label, leg=np.full(SHAPE, -1, np.int8), depth=np.full(SHAPE, 2.0),
        points_in_world=points, wheels_in_world=wheels,
    )  # fmt: skip


def image(depth: np.ndarray) -> DepthImage:
    camera = SPEC.camera("navcam_1")
    return DepthImage(
        camera=camera, eye=camera.eye.binned(8), depth=depth, sigma=0.01 * depth, grey=np.zeros(SHAPE, np.uint8), t=1.0
    )


def look(matched: np.ndarray, masked: np.ndarray, t: float = 1.0) -> Look:
    without = MaskedDepth(
        depth=image(masked), mask=~np.isfinite(masked), labels=np.zeros(SHAPE, np.int32), robot_labels=(),
        expected=np.full(SHAPE, np.nan),
    )  # fmt: skip
    return Look(
        camera="navcam_1", t=t, matched=image(matched), masked=without, world_from_camera=SE3.identity(), alignment=None,
        cells=0,
    )  # fmt: skip


def test_shares_leave_the_outline_and_pixels_without_depth_out():
    label = np.ones(SHAPE, dtype=np.uint8)
    label[:, 40:] = 3
    matched = np.full(SHAPE, 2.0)
    matched[0, :] = np.nan
    masked = matched.copy()
    masked[:, 50:] = np.nan  # of the robot's columns 42 to 59 ten are found
    masked[:13, :19] = np.nan  # and of the terrain's columns 0 to 37 some are lost
    score = MaskScore()
    score.saw(view(label))
    score.looked(look(matched, masked))
    summary = score.summary()
    assert summary["recall"] == pytest.approx(10 / 18)
    assert summary["terrain_lost"] == pytest.approx(12 * 19 / (39 * 38))
    assert 0.0 < summary["lost_near_wheels"] < 1.0


def test_a_wheel_far_away_is_not_near():
    score = MaskScore()
    score.saw(view(np.ones(SHAPE, dtype=np.uint8)))
    lost = np.full(SHAPE, 2.0)
    lost[39, :10] = np.nan  # 0.2 m and more from the axle, but within 0.4 m
    score.looked(look(np.full(SHAPE, 2.0), lost))
    assert score.counts.near == pytest.approx(SHAPE[0] * SHAPE[1])
    assert score.counts.near_removed == 10


def test_a_look_at_another_moment_and_no_look_at_all_count_nothing():
    score = MaskScore()
    score.saw(view(np.ones(SHAPE, dtype=np.uint8)))
    score.looked(look(np.ones(SHAPE), np.ones(SHAPE), t=2.0))
    assert score.summary() == {"recall": None, "terrain_lost": None, "lost_near_wheels": None}


def test_a_raised_leg_is_counted_apart_from_legs_on_the_ground():
    label = np.full(SHAPE, 3, dtype=np.uint8)
    leg = np.full(SHAPE, -1, dtype=np.int8)
    leg[:10], leg[10:30] = 4, 1
    removed = np.zeros(SHAPE, dtype=bool)
    removed[:5], removed[10:25] = True, True
    shown = {"label": label, "matched": np.ones(SHAPE), "removed": removed, "beside": np.zeros(SHAPE, dtype=bool)}
    counts = count_mask(**shown, leg=leg, raised=(4,))
    assert counts.share("raised") == pytest.approx(0.5)
    assert counts.share("standing") == pytest.approx(0.75)
    assert counts.share("robot") == pytest.approx(0.5)
    assert count_mask(**shown).share("raised") is None
    twice = counts + counts + MaskCounts()
    assert (twice.robot, twice.raised_removed) == (2 * counts.robot, 2 * counts.raised_removed)


def test_what_was_laid_flat_counts_as_removed():
    label = np.full(SHAPE, 3, dtype=np.uint8)
    score = MaskScore()
    score.saw(view(label))
    flat = look(np.ones(SHAPE), np.full(SHAPE, 1.5))
    flat.masked.mask[:20] = True
    score.looked(flat)
    assert score.summary()["recall"] == pytest.approx(0.5)
