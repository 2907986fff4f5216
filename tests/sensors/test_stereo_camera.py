import cv2
import numpy as np
import pytest

from athlete_twin.errors import CameraError, ConfigError
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.appearance import visual_parts
from athlete_twin.model.kinematics import kinematics
from athlete_twin.model.spec import load_spec
from athlete_twin.model.stance import regular_stance
from athlete_twin.sensors.renderer import Renderer
from athlete_twin.sensors.stereo_camera import (
    READ_ELECTRONS,
    RESPONSE,
    WHITE_ELECTRONS,
    StereoRig,
    develop,
    metered_exposure,
)
from athlete_twin.world.terrain import build_terrain, load_scenario

SPEC = load_spec("sdm_b")
WORLD_FROM_HEX = SE3.from_translation(np.array([0.0, 0.0, 1.75]))
NO_ERROR = {c.name: SE3.identity() for c in SPEC.cameras}


@pytest.fixture(scope="module")
def renderer():
    terrain = build_terrain(load_scenario("rock_field"), 0, clear_xy=np.zeros((0, 2)), clear_radius=0.3)
    return Renderer(terrain, [])


def rig(renderer, seed=0, error=NO_ERROR):
    return StereoRig(SPEC, renderer, seed=seed, camera_error=error)


def test_disparity_fits_the_baseline(renderer):
    pair = rig(renderer).capture(["hazcam_2"], 2, {}, world_from_hex=WORLD_FROM_HEX, index=0)["hazcam_2"][0]
    camera = SPEC.camera("hazcam_2")
    eye = camera.eye.binned(2)
    truth = renderer.render(WORLD_FROM_HEX.compose(camera.hex_from_camera), eye, renderer.place({}))
    matcher = cv2.StereoSGBM_create(0, 96, 5, 200, 800, 1, 31, 10, 100, 2, cv2.STEREO_SGBM_MODE_SGBM_3WAY)
    disparity = matcher.compute(pair.left, pair.right).astype(float) / 16.0
    seen = np.s_[:, 100:]
    found = disparity[seen] > 1.0
    depth = eye.focal_px * camera.baseline / disparity[seen][found]
    assert found.mean() > 0.9
    error = depth - truth.depth[seen][found]
    # A fifth of a pixel at 2.5 m is 1.4 cm with this baseline and binning.
    assert np.median(np.abs(error)) < 0.015
    assert abs(np.median(error)) < 0.01


def test_a_shot_knows_what_it_truly_shows(renderer):
    shot = rig(renderer).capture(["navcam_2"], 4, {}, world_from_hex=WORLD_FROM_HEX, index=0)["navcam_2"][0]
    view = shot.truth(camera="navcam_2", t=3.0, wheels_in_world=np.zeros((6, 3)))
    ground = view.label == 1
    points = view.points_in_world[ground]
    # Half a pixel at grazing incidence is a few centimetres of height.
    error = points[:, 2] - renderer.terrain.grid.sample(points[:, :2])
    assert np.median(np.abs(error)) < 0.01
    back, depth = SPEC.camera("navcam_2").eye.binned(4).project(shot.world_from_left.inverse().apply(points[:50]))
    np.testing.assert_allclose(np.rint(back)[:, ::-1], np.argwhere(ground)[:50])
    np.testing.assert_allclose(depth, view.depth[ground][:50], rtol=1e-6)


def test_noise_is_paired_across_requests_and_differs_between_them(renderer):
    one, two = rig(renderer), rig(renderer)
    alone = one.capture(["navcam_1"], 4, {}, world_from_hex=WORLD_FROM_HEX, index=7)["navcam_1"][0]
    among = two.capture(["hazcam_1", "navcam_1"], 4, {}, world_from_hex=WORLD_FROM_HEX, index=7)["navcam_1"][0]
    later = one.capture(["navcam_1"], 4, {}, world_from_hex=WORLD_FROM_HEX, index=8)["navcam_1"][0]
    assert alone.left.tobytes() == among.left.tobytes()
    assert alone.right.tobytes() == among.right.tobytes()
    assert alone.left.tobytes() != later.left.tobytes()
    assert alone.left.dtype == np.uint8
    assert alone.left.shape == (192, 256)


def test_mounting_error_moves_both_eyes_together(renderer):
    error = NO_ERROR | {"hazcam_1": SE3.from_rotvec(np.array([0.0, 0.01, 0.0]), np.array([0.005, 0.0, 0.0]))}
    true_pose = rig(renderer, error=error).true_pose("hazcam_1")
    drawn = SPEC.camera("hazcam_1").hex_from_camera
    moved = drawn.inverse().compose(true_pose)
    assert np.linalg.norm(moved.translation) == pytest.approx(0.005)
    assert np.linalg.norm(moved.rotvec()) == pytest.approx(0.01)
    straight = rig(renderer).capture(["hazcam_1"], 4, {}, world_from_hex=WORLD_FROM_HEX, index=0)["hazcam_1"][0]
    turned = rig(renderer, error=error).capture(["hazcam_1"], 4, {}, world_from_hex=WORLD_FROM_HEX, index=0)["hazcam_1"][0]
    assert straight.left.tobytes() != turned.left.tobytes()


def test_noise_grows_as_photons_do_and_falls_with_binning():
    rng = np.random.default_rng(0)
    grey = {level: develop(np.full((200, 200), level, np.float32), 1e-3, binning=1, rng=rng) for level in (0.5, 1.5)}
    binned = develop(np.full((200, 200), 1.5, np.float32), 1e-3, binning=2, rng=rng)
    assert grey[1.5].mean() == pytest.approx(255 * 0.75, abs=0.5)
    assert grey[1.5].std() > 1.4 * grey[0.5].std()
    # Half the noise, plus what rounding to whole grey values adds.
    assert binned.std() == pytest.approx(np.hypot(0.5 * grey[1.5].std(), 0.15), rel=0.15)


def test_exposure_brings_bright_ground_just_below_white():
    radiance = np.random.default_rng(1).uniform(0.05, 0.4, (90, 120)).astype(np.float32)
    image = develop(radiance, metered_exposure(radiance), binning=1, rng=np.random.default_rng(0))
    assert 200 < np.percentile(image, 97) < 240
    assert (image == 255).mean() < 0.01


def test_unusable_requests_are_refused(renderer):
    with pytest.raises(ConfigError, match="camera 'navcam_9' is not on sdm_b"):
        rig(renderer).capture(["navcam_9"], 2, {}, world_from_hex=WORLD_FROM_HEX, index=0)
    with pytest.raises(CameraError, match="camera_error lacks navcam_1"):
        StereoRig(SPEC, renderer, seed=0, camera_error={})
    with pytest.raises(CameraError, match="exposure is -1"):
        develop(np.zeros((8, 8), np.float32), -1.0, binning=1, rng=np.random.default_rng(0))


def test_a_bracket_is_one_scene_at_several_exposures(renderer):
    one = rig(renderer).capture(["hazcam_1"], 4, {}, world_from_hex=WORLD_FROM_HEX, index=3)["hazcam_1"]
    shots = rig(renderer).capture(
        ["hazcam_1"], 4, {}, world_from_hex=WORLD_FROM_HEX, index=3, brackets=(1.0, 0.25, 4.0)
    )["hazcam_1"]
    assert len(one) == 1 and len(shots) == 3
    assert np.array_equal(shots[0].left, one[0].left)  # the first is what a single one would be, noise included
    assert [s.exposure / one[0].exposure for s in shots] == pytest.approx([1.0, 0.25, 4.0])
    told = (shots[0].left > 60) & (shots[0].left < 200)
    ratio = shots[1].left[told].astype(float) / shots[0].left[told]
    assert np.median(ratio) == pytest.approx(0.25, abs=0.01)
    assert (shots[2].left == 255).mean() > 0.3
    scaled = shots[0].left.astype(float)[told] * 0.25
    assert np.std(shots[1].left[told] - scaled) > 0.3  # noise of its own


def test_12_bits_tell_what_8_round_away():
    radiance = np.full((200, 200), 0.2, np.float32) + np.linspace(0.0, 1e-2, 200, dtype=np.float32)
    images = {
        bits: develop(radiance, 1e-3, binning=4, bits=bits, rng=np.random.default_rng(1)) for bits in (8, 12)
    }
    assert images[8].dtype == np.uint8 and images[12].dtype == np.uint16
    assert len(np.unique(images[12])) > 5 * len(np.unique(images[8]))
    assert images[12].mean() / 4095 == pytest.approx(images[8].mean() / 255, rel=0.01)
    assert develop(np.full((8, 8), 99.0, np.float32), 1.0, binning=1, bits=12, rng=np.random.default_rng(0)).max() == 4095
    with pytest.raises(CameraError, match="10 bits"):
        develop(radiance, 1e-3, binning=1, bits=10, rng=np.random.default_rng(0))


def test_photon_noise_is_that_of_its_electrons():
    """Poisson's: the variance of a pixel is its mean in electrons, with the reading's on top."""
    for level in (0.1, 0.5, 1.0):
        image = develop(np.full((400, 400), level, np.float32), 1e-3, binning=1, bits=12, rng=np.random.default_rng(2))
        electrons = image.astype(float) * WHITE_ELECTRONS / 4095.0
        expected = level * 1e-3 * RESPONSE * WHITE_ELECTRONS
        assert electrons.mean() == pytest.approx(expected, rel=0.01)
        rounding = (WHITE_ELECTRONS / 4095.0) ** 2 / 12.0
        assert electrons.var() == pytest.approx(expected + READ_ELECTRONS**2 + rounding, rel=0.03)


def test_a_toolcam_sees_the_ground_beside_its_wheel_and_moves_with_the_leg(renderer):
    spec, kin = load_spec("sdm_b"), kinematics("sdm_b")
    camera = next(c for c in spec.cameras if c.group == "toolcam" and c.link.startswith("leg1"))
    joints = regular_stance(spec)
    poses = {n: WORLD_FROM_HEX.compose(p) for n, p in kin.link_poses(joints).items()}
    shot = rig(renderer).capture([camera.name], 4, poses, world_from_hex=WORLD_FROM_HEX, index=0)[camera.name][0]
    wheel = poses["wheel1"].translation
    truth = shot.truth(camera=camera.name, t=0.0, wheels_in_world=np.tile(wheel, (6, 1)))
    ground = np.isin(truth.label, (1, 2))
    assert ground.mean() > 0.5
    assert np.nanmedian(np.linalg.norm(truth.points_in_world[ground][:, :2] - wheel[:2], axis=1)) < 0.8


@pytest.mark.slow
@pytest.mark.ci
def test_truth_tells_which_leg_a_pixel_shows():
    spec, kin = load_spec("sdm_b"), kinematics("sdm_b")
    terrain = build_terrain(load_scenario("rock_field"), 0, clear_xy=np.zeros((0, 2)), clear_radius=0.3)
    both = Renderer(terrain, visual_parts(spec))
    poses = {n: WORLD_FROM_HEX.compose(p) for n, p in kin.link_poses(regular_stance(spec)).items()}
    shot = rig(both).capture(["hazcam_2"], 4, poses, world_from_hex=WORLD_FROM_HEX, index=0)["hazcam_2"][0]
    legs = shot.seen.leg
    assert legs.dtype == np.int8
    assert ((legs >= 0) <= (shot.seen.label == 3)).all()
    assert (legs == 0).sum() > 100  # the one at 180 deg looks across the body at leg 1
