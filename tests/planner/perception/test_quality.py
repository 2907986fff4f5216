"""What a camera can spoil is marked with its reason and never reaches the map."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from athlete_twin.assets import named_toml, read_toml
from athlete_twin.errors import CameraError, ConfigError
from athlete_twin.geometry.se3 import SE3
from athlete_twin.messages import StereoPair, Telemetry
from athlete_twin.model.camera import Pinhole, StereoCamera
from athlete_twin.model.kinematics import Kinematics
from athlete_twin.model.spec import load_spec
from athlete_twin.model.stance import regular_stance, stance_wheels_in_hex
from planner.belief import Belief
from planner.config import planner_config
from planner.eyes import Eyes
from planner.perception.quality import QualityConfig, judge
from planner.perception.stereo import DepthImage, StereoConfig, match
from planner.terrain.fusion import FusionConfig, TerrainMap

HERE = SE3.identity()


@pytest.fixture
def camera(synth):
    return synth.looking(1.5, 50.0, width=256, rows=192)


@pytest.fixture
def pair(synth, camera):
    return synth.Scene().pair(camera, HERE)


def spoilt(image, kind):
    out = image.copy()
    if kind == "black":
        out = np.random.default_rng(0).integers(0, 3, image.shape).astype(np.uint8)
    elif kind == "saturated":
        out[:, : int(0.6 * image.shape[1])] = 255
    elif kind == "constant":
        out[:] = 90
    elif kind == "truncated":
        out[int(0.7 * len(out)) :] = 128
    elif kind == "cut":
        out = out[:100]
    elif kind == "size":
        out = out[:, :100]
    return np.ascontiguousarray(out)


def test_good_pair_is_usable(pair, camera):
    assert judge(pair, camera).usable


@pytest.mark.parametrize("eye", ["left", "right"])
@pytest.mark.parametrize(
    ("kind", "text"),
    [("black", "is black"), ("saturated", "60% of"), ("constant", "constant"), ("truncated", "after row 134 of 192")],
)
def test_spoilt_eye_is_named_with_its_reason(pair, camera, kind, eye, text):
    verdict = judge(dataclasses.replace(pair, **{eye: spoilt(getattr(pair, eye), kind)}), camera)
    assert verdict.kind == kind
    assert text in verdict.reason
    assert eye in verdict.reason
    assert verdict.mendable == (kind in ("black", "saturated"))


def test_wrong_sizes_are_named(pair, camera):
    odd = dataclasses.replace(pair)
    object.__setattr__(odd, "left", spoilt(pair.left, "size"))  # types are enforced in tests, not over a link
    left_only = judge(odd, camera)
    assert left_only.kind == "size"
    assert "left is 100x192, right 256x192" in left_only.reason
    both = dataclasses.replace(pair, left=spoilt(pair.left, "cut"), right=spoilt(pair.right, "cut"))
    assert judge(both, camera).kind == "truncated"
    assert "need 256x192" in judge(both, camera).reason


def test_limits_outside_their_range_are_refused():
    with pytest.raises(ConfigError, match=r"saturated_share is 1\.5"):
        QualityConfig(saturated_share=1.5)


def test_negative_baseline_is_refused(camera):
    for baseline in (-0.15, 0.0, float("nan")):
        with pytest.raises(CameraError, match="baseline of camera hazcam_1"):
            dataclasses.replace(camera, baseline=baseline)
    with pytest.raises(CameraError, match="focal"):
        dataclasses.replace(camera.eye, focal_px=float("inf"))
    with pytest.raises(CameraError, match="principal point"):
        dataclasses.replace(camera.eye, cx_px=float("nan"))


@settings(max_examples=40, deadline=None)
@given(
    value=st.sampled_from([0.0, -1.0, np.inf, -np.inf, 2.0]),
    sigma=st.sampled_from([0.0, -0.01, np.nan, np.inf, 0.01]),
    at=st.tuples(st.integers(0, 191), st.integers(0, 255)),
)
def test_no_depth_that_would_make_a_hole_or_a_spike_can_be_made(value, sigma, at):
    eye = Pinhole.from_fov(256, 192, 1.2)
    camera = StereoCamera(name="c", group="hazcam", link_from_camera=HERE, baseline=0.15, eye=eye)
    depth, spread = np.full((192, 256), 2.0), np.full((192, 256), 0.01)
    depth[at], spread[at] = value, sigma
    grey = np.zeros((192, 256), np.uint8)
    if value == 2.0 and sigma == 0.01:
        DepthImage(camera=camera, eye=eye, depth=depth, sigma=spread, grey=grey, t=0.0)
    else:
        with pytest.raises(CameraError, match="1 pixels of c"):
            DepthImage(camera=camera, eye=eye, depth=depth, sigma=spread, grey=grey, t=0.0)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), kind=st.sampled_from(["noise", "saturated", "stripes", "other", "ramp"]))
def test_no_pair_of_images_makes_a_hole_in_the_map(seed, kind):
    eye = Pinhole.from_fov(256, 192, 1.2)
    c, s = np.cos(0.8), np.sin(0.8)
    down = SE3(np.array([[0.0, -s, c], [-1.0, 0.0, 0.0], [0.0, -c, -s]]), np.array([0.0, 0.0, 1.5]))
    camera = StereoCamera(name="c", group="hazcam", link_from_camera=down, baseline=0.15, eye=eye)
    rng = np.random.default_rng(seed)
    left = rng.integers(0, 256, (192, 256)).astype(np.uint8)
    right = np.roll(left, -int(rng.integers(0, 40)), axis=1)
    if kind == "saturated":
        left[:, 80:], right[:, 60:] = 255, 255
    elif kind == "stripes":
        left = np.tile((np.arange(256) % 7 * 30).astype(np.uint8), (192, 1))
        right = np.roll(left, 3, axis=1)
    elif kind == "other":
        right = rng.integers(0, 256, (192, 256)).astype(np.uint8)
    elif kind == "ramp":
        left = np.tile(np.arange(256, dtype=np.uint8), (192, 1))
        right = left.copy()
    zero = np.zeros((6, 6))
    state = Telemetry(
        seq=0, robot_id="test", t=5.0, joints=zero, motors=zero, torques=zero, attitude_rpy=np.zeros(3), rates=np.zeros(3),
        acceleration=np.zeros(3), executive_state="idle", sequence_id=-1, command_index=0,
    )  # fmt: skip
    pair = StereoPair(
        seq=0, robot_id="test", t=5.0, camera="c", binning=1, left=left, right=right, exposure=0.01, state=state
    )
    depth = match(pair, camera, config=StereoConfig())
    grid = TerrainMap.around(0.0, 0.0, config=FusionConfig())
    grid.fuse(depth, down)
    terrain = grid.fused()
    seen = terrain.count > 0
    assert np.isfinite(terrain.grid.heights[seen]).all()
    assert np.isfinite(terrain.variance[seen]).all()
    assert np.isnan(terrain.grid.heights[~seen]).all()
    assert (terrain.grid.heights[seen] < 1.5 + 7.0).all()


@pytest.fixture(scope="module")
def robot():
    spec = load_spec("sdm_b")
    joints = regular_stance(spec)
    content = read_toml(named_toml("variants", "integrated"))
    contacts = stance_wheels_in_hex(spec) - np.array([0.0, 0.0, spec.wheel.radius])
    world_from_hex = SE3.from_translation(np.array([0.0, 0.0, spec.chassis_height]))
    belief = Belief(
        t=5.0, joints=joints, motors=joints, world_from_hex=world_from_hex,
        contacts_in_world=world_from_hex.apply(contacts), planted=np.ones(6, dtype=bool), loads=np.full(6, 1400.0),
        interaction=np.zeros((6, 3)), forces=np.zeros((6, 3)), joint_stiffness=np.full(spec.dof, np.inf), fit_rmse=0.0,
    )  # fmt: skip
    return Kinematics(spec), planner_config(content, spec, name="integrated"), belief


def eyes_after(robot, pairs):
    kin, config, belief = robot
    eyes = Eyes(kin, config)
    eyes.take(pairs, belief)
    return eyes


@pytest.fixture
def looked(synth, robot):
    """Pairs of two cameras over the bare plane on which the robot stands."""
    kin, _, belief = robot
    state = dataclasses.replace(synth.telemetry(), joints=belief.joints, motors=belief.motors)
    pairs = [synth.Scene().pair(kin.spec.camera(n), belief.world_from_hex, binning=4) for n in ("hazcam_1", "hazcam_2")]
    return [dataclasses.replace(p, state=state) for p in pairs]


@pytest.mark.parametrize("kind", ["black", "saturated", "constant", "truncated", "cut", "size"])
def test_map_is_the_same_with_and_without_the_spoilt_pair(robot, looked, kind):
    bad = dataclasses.replace(looked[1], left=spoilt(looked[1].left, kind), right=spoilt(looked[1].right, kind))
    with_it, without = eyes_after(robot, [looked[0], bad]), eyes_after(robot, looked[:1])
    assert with_it.map.fused().grid.heights.tobytes() == without.map.fused().grid.heights.tobytes()
    assert [look.camera for look in with_it.looks] == ["hazcam_1"]
    assert [v.reason.split()[0] for v in with_it.unusable] == ["hazcam_2"]


def test_set_of_dead_cameras_leaves_the_map_empty(robot, looked):
    black = [dataclasses.replace(p, left=0 * p.left, right=0 * p.right) for p in looked]
    eyes = eyes_after(robot, black)
    assert eyes.map.fused().unknown.all()
    assert [v.kind for v in eyes.unusable] == ["black", "black"]


def test_bracket_becomes_one_look_and_its_white_exposure_is_no_fault(robot, looked):
    pair = looked[0]
    bright = dataclasses.replace(
        pair, left=_times(pair.left, 4), right=_times(pair.right, 4), exposure=4.0 * pair.exposure, bracket=1
    )
    assert judge(bright, robot[0].spec.camera(pair.camera)).kind == "saturated"
    eyes = eyes_after(robot, [pair, bright])
    assert len(eyes.looks) == 1
    assert not eyes.unusable
    alone = eyes_after(robot, [bright])
    assert not alone.looks
    assert alone.unusable[0].kind == "saturated"


def _times(image, factor):
    return np.clip(image.astype(int) * factor, 0, 255).astype(np.uint8)
