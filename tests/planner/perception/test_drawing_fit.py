"""The drawing finds its place in the picture, says how sure it is, and stays put where the picture says nothing."""

from dataclasses import replace

import numpy as np
import pytest

from athlete_twin.errors import ConfigError
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.appearance import VisualPart
from planner.perception.drawing_fit import DrawingFitConfig, fit_drawing
from planner.perception.outline_search import drawn_outline, search
from planner.perception.robot_drawing import RobotDrawing, beside_drawn
from planner.perception.stereo import StereoConfig, match

LEGS = {"leg1": (2.0, 0.35), "wheel2": (2.3, -0.5)}
STEP = 2


def tube(link, radius=0.11, low=0.0, high=1.2, n=32):
    angle = np.linspace(0.0, 2.0 * np.pi, n, endpoint=False)
    ring = np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])
    vertices = np.vstack([np.column_stack([ring, np.full(n, z)]) for z in (low, high)])
    k, m = np.arange(n), (np.arange(n) + 1) % n
    sides = np.vstack([np.column_stack([k, m, k + n]), np.column_stack([m, m + n, k + n])])
    caps = np.vstack([np.column_stack([np.zeros(n - 2, int) + s, k[1:-1] + s, k[2:] + s]) for s in (0, n)])
    return VisualPart(
        link=link, link_from_part=SE3.identity(), vertices=vertices, triangles=np.vstack([sides, caps]),
        colour=np.full(3, 0.5), albedo=0.5,
    )  # fmt: skip


@pytest.fixture
def seen(synth):
    camera = synth.looking(1.5, 30.0)
    scene = synth.Scene([synth.Cylinder(x, y, 0.11, 0.0, 1.2) for x, y in LEGS.values()])
    depth = match(scene.pair(camera, SE3.identity()), camera, config=StereoConfig())
    drawing = RobotDrawing([tube(n) for n in LEGS], {n: SE3.from_translation(np.array([*xy, 0.0])) for n, xy in LEGS.items()})
    return depth, drawing


def fitted(seen, error, config=None):
    """Fit when the camera truly sits at `drawn_camera_from_true_camera = error`; median error of the outline before and after."""
    depth, drawing = seen
    believed = depth.camera.hex_from_camera.compose(error.inverse())
    eye = depth.eye.binned(STEP)
    view = drawing.view(believed, eye)
    fit = fit_drawing(depth, view, step=STEP, config=config or DrawingFitConfig())
    rows, columns = np.nonzero(view.drawn)
    points = eye.rays()[rows, columns] * view.depth[rows, columns][:, None]
    truth = depth.eye.project(error.inverse().apply(points))[0]
    before = np.linalg.norm(depth.eye.project(points)[0] - truth, axis=1)
    after = np.linalg.norm(depth.eye.project(fit.true_from_drawn.apply(points))[0] - truth, axis=1)
    return fit, points, float(np.median(before)), float(np.median(after))


def three_centimetres_and_a_degree(seed):
    rng = np.random.default_rng([seed, 42])
    turn, shift = rng.standard_normal(3), rng.standard_normal(3)
    return SE3.from_rotvec(np.deg2rad(1.0) * turn / np.linalg.norm(turn), 0.03 * shift / np.linalg.norm(shift))


@pytest.mark.parametrize("seed", range(8))
def test_three_centimetres_and_a_degree_are_found_to_two_pixels(seen, synth, seed):
    """In a depth that is true but for a centimetre of noise."""
    depth, drawing = seen
    camera = depth.camera
    scene = synth.Scene([synth.Cylinder(x, y, 0.11, 0.0, 1.2) for x, y in LEGS.values()])
    truth = scene.trace(camera.hex_from_camera, camera.eye)[0]
    noisy = truth + np.random.default_rng(seed).normal(0.0, 0.01, truth.shape)
    true = replace(depth, depth=noisy, sigma=np.where(np.isfinite(noisy), 0.01, np.nan))
    fit, _, before, after = fitted((true, drawing), three_centimetres_and_a_degree(seed))
    assert fit.points > 300
    assert after < 2.0
    assert after < 0.6 * before or before < 2.0


def test_in_a_matched_depth_the_error_is_halved(seen):
    """Matching frays a leg's outline, which the fit goes by: it helps in each case, and by half in most."""
    errors = [fitted(seen, three_centimetres_and_a_degree(seed))[2:] for seed in range(8)]
    assert all(after < before for before, after in errors)
    assert np.median([after / before for before, after in errors]) < 0.5


def test_a_right_belief_is_left_alone(seen):
    _, _, before, after = fitted(seen, SE3.identity())
    assert before == 0.0
    assert after < 1.0


def test_where_nothing_is_drawn_or_the_fit_is_off_the_belief_stays(seen):
    depth, drawing = seen
    away = SE3(np.eye(3), np.array([0.0, 0.0, 50.0]))
    nothing = fit_drawing(depth, drawing.view(away, depth.eye.binned(STEP)), step=STEP, config=DrawingFitConfig())
    off, *_ = fitted(seen, SE3.from_translation(np.array([0.03, 0.0, 0.0])), DrawingFitConfig(enabled=False))
    for fit in (nothing, off):
        np.testing.assert_array_equal(fit.true_from_drawn.matrix(), np.eye(4))
        assert fit.points == 0


def test_spread_is_that_of_sampled_motions(seen):
    fit, points, *_ = fitted(seen, SE3.identity())
    some = points[:: len(points) // 20]
    rng = np.random.default_rng(3)
    draws = rng.multivariate_normal(np.zeros(6), 1e-2 * fit.covariance, size=4000)
    eye = seen[0].eye
    pixels = np.stack([eye.project(SE3.from_rotvec(d[:3], d[3:]).apply(some))[0] for d in draws])
    sampled = 10.0 * pixels.std(axis=0).max(axis=1)
    np.testing.assert_allclose(fit.spread_px(some, eye.focal_px), sampled, rtol=0.06)


def test_outline_is_found_where_it_is_and_nowhere_else():
    depth = np.full((60, 80), 3.0)
    depth[:, 43:] = 1.5  # a leg whose left side lies between columns 42 and 43
    depth[40:, :] = 1.5  # below, something as near touches it
    depth[10:12, 42:44] = np.nan  # unknown between: the middle is taken
    places = np.array([[46.0, 20.0], [40.0, 20.0], [46.0, 50.0], [44.0, 11.0]])
    outward = np.tile([-1.0, 0.0], (4, 1))
    offset = search(depth, places, outward, np.full(4, 1.5), reach=8, stride=1.0)
    # Outward is to smaller columns: the outline at 42.5 lies 3.5 px outward of 46, 2.5 px inward of 40.
    np.testing.assert_allclose(offset[[0, 1]], [3.5, -2.5])
    assert np.isnan(offset[2])
    assert offset[3] == 1.5


def test_outline_leaves_the_borders_of_the_picture_out(seen):
    depth, drawing = seen
    view = drawing.view(depth.camera.hex_from_camera, depth.eye.binned(STEP))
    outline = drawn_outline(view, limit=200)
    assert 50 < len(outline.pixels) <= 200
    height, width = view.depth.shape
    assert (outline.pixels > 0).all()
    assert (outline.pixels < [width - 1, height - 1]).all()
    np.testing.assert_allclose(np.linalg.norm(outline.outward, axis=1), 1.0)
    outside = np.rint(outline.pixels + 3.0 * outline.outward).astype(int).clip(0, [width - 1, height - 1])
    assert view.drawn[outside[:, 1], outside[:, 0]].mean() < 0.1


def test_a_view_of_some_pixels_is_part_of_the_view_of_all(seen):
    depth, drawing = seen
    eye = depth.eye.binned(4)
    every = drawing.view(depth.camera.hex_from_camera, eye)
    only = np.zeros(every.depth.shape, dtype=bool)
    only[20:60, 30:70] = True
    some = drawing.view(depth.camera.hex_from_camera, eye, only=only)
    np.testing.assert_array_equal(some.depth[only], every.depth[only])
    np.testing.assert_array_equal(some.leg[only], every.leg[only])
    assert np.isnan(some.depth[~only]).all()
    assert set(np.unique(every.leg)) == {-2, 0, 1}
    assert len(every.normals) == every.drawn.sum()


def test_nearest_drawn_depth_is_that_of_brute_force():
    rng = np.random.default_rng(5)
    expected = np.where(rng.uniform(size=(30, 40)) < 0.03, rng.uniform(1.0, 4.0, (30, 40)), np.nan)
    outside, depth = beside_drawn(expected)
    at = np.argwhere(np.isfinite(expected))
    away = np.linalg.norm(np.indices(expected.shape).reshape(2, -1).T[:, None] - at[None], axis=2)
    np.testing.assert_allclose(outside.ravel(), away.min(axis=1), atol=0.2)
    # OpenCV measures along a 5 x 5 mask: where two are about as near it may take the other.
    taken = expected[tuple(at.T)]
    alike = (np.abs(depth.ravel()[:, None] - taken) < 1e-12) & (away < away.min(axis=1, keepdims=True) + 0.3)
    assert alike.any(axis=1).all()


def test_sigmas_of_nothing_are_refused():
    with pytest.raises(ConfigError, match=r"sigmas must be positive.*noise=0.0"):
        DrawingFitConfig(noise=0.0)
