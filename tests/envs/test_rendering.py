"""What `render` shows: the robot from outside, where it truly is, in a picture or in a window."""

import os
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import RenderCollection

import envs  # noqa: F401
from athlete_twin.errors import ConfigError
from athlete_twin.model.spec import load_spec
from athlete_twin.sensors.onlooker import Posture
from envs import window
from envs.operator_env import OperatorEnv
from envs.outside_view import LOOK_AT, MARGIN, SIZE
from envs.spaces import KINDS

ROOT = Path(__file__).resolve().parents[2]
MOCKS = ("AthleteTwin/SdmB-Mock-v0", "AthleteTwin/T12-Mock-v0")
TWINS = ("AthleteTwin/SdmB-v0", "AthleteTwin/T12-v0")


def made(name, **kwargs):
    return gym.make(name, **{"render_mode": "rgb_array", "cameras": (), "link": 0.0, "scenario": "calibration_yard"} | kwargs)


def driven(env, metres, *, seconds=60):
    action = {name: np.zeros(part.shape, part.dtype) for name, part in env.action_space.items()}
    way = np.array([metres / 2.0, 0.0], np.float32)
    env.step(action | {"kind": np.int64(KINDS.index("drive")), "drive": way})
    for _ in range(seconds):
        env.step(action | {"kind": np.int64(0)})
        if not env.unwrapped.mission.robot.busy:
            return


@pytest.mark.parametrize("name", [*MOCKS, *(pytest.param(i, marks=(pytest.mark.slow, pytest.mark.ci)) for i in TWINS)])
def test_picture_shows_the_robot_where_it_truly_is(name):
    env = made(name, scenario={"AthleteTwin/SdmB-v0": "rock_field", "AthleteTwin/T12-v0": "black_point"}.get(name, "calibration_yard"))
    env.reset(seed=0)
    picture = env.render()
    assert picture.shape == (SIZE[1], SIZE[0], 3) and picture.dtype == np.uint8
    # Where the drawn wheels and the chassis are there is something else than bare ground, and far from them nothing else.
    view, truth = env.unwrapped._outside, env.unwrapped.mission.robot.truth()
    u, v = view._left_top(truth.world_from_hex.translation - [0.0, 0.0, (1.0 - LOOK_AT) * view._spec.chassis_height])
    bare = np.rint(view._canvas._sunny[v : v + SIZE[1], u : u + SIZE[0], ::-1])
    covered = np.abs(picture - bare).max(axis=2) > 20.0
    pixels, _ = view._frame.project(view._camera_from_world.apply(truth.wheels_in_world))
    shifted = np.rint(pixels + MARGIN - [u, v]).astype(int)
    assert all(covered[y - 4 : y + 5, x - 4 : x + 5].mean() > 0.5 for x, y in shifted)
    assert 0.1 < covered.mean() < 0.4 and not covered[:60, :60].any() and not covered[:60, -60:].any()
    assert picture[..., 0].mean() > picture[..., 2].mean() + 10.0, "red and blue are swapped: the ground is sand"
    env.close()


@pytest.mark.slow
@pytest.mark.ci
def test_picture_changes_where_the_robot_moves_and_nowhere_else():
    env = made(MOCKS[0])
    env.reset(seed=0)
    before = env.render()
    assert np.array_equal(env.render(), before)
    action = {name: np.zeros(part.shape, part.dtype) for name, part in env.action_space.items()}
    move = {"kind": np.int64(KINDS.index("leg_move")), "leg": np.int64(0), "wheel": np.array([0.0, 0.0, 0.4], np.float32)}
    env.step(action | move)
    for _ in range(10):
        env.step(action)
    changed = np.abs(env.render().astype(int) - before).max(axis=2) > 20
    assert 0.005 < changed.mean() < 0.3
    env.close()


@pytest.mark.slow
def test_onlooker_follows_with_the_lens_and_then_steps_along():
    env = made(MOCKS[0], time_limit=1e5)
    env.reset(seed=0)
    pictures = [env.render()]
    canvases = {id(env.unwrapped._outside._canvas)}
    for _ in range(4):
        driven(env, 2.0, seconds=200)
        pictures.append(env.render())
        canvases.add(id(env.unwrapped._outside._canvas))
        middle = pictures[-1][90:270, 160:480].mean(axis=2)
        assert np.mean(middle > 200.0) > 0.01, "the robot has left the picture"
    assert env.unwrapped.mission.robot.truth().world_from_hex.translation[0] > 7.0
    assert len(canvases) > 1
    env.close()


@pytest.mark.parametrize("robot", ["sdm_b", "t12"])
def test_links_of_the_mock_are_where_its_joints_put_them(robot):
    from athlete_twin.mock import MockAthlete

    mock = MockAthlete(load_spec(robot))
    truth = mock.truth()
    expected = Posture(mock.spec).link_poses(truth.world_from_hex, truth.joints, np.zeros(0))
    poses = mock.link_poses()
    assert set(poses) == set(expected)
    assert all(np.allclose(poses[n].matrix(), expected[n].matrix(), atol=1e-12) for n in poses)


def test_pictures_of_an_episode_are_collected_one_a_step():
    env = RenderCollection(made(MOCKS[0]))
    env.reset(seed=0)
    env.action_space.seed(0)
    for _ in range(4):
        env.step(env.action_space.sample())
    frames = env.render()
    assert len(frames) == 5 and all(f.shape == (SIZE[1], SIZE[0], 3) for f in frames)
    env.close()


@pytest.mark.slow
@pytest.mark.ci
def test_operator_environment_shows_the_same_robot(scripted):
    env = OperatorEnv("sdm_b", body="mock", render_mode="rgb_array", make_agent=lambda *_: scripted())
    env.reset(seed=0)
    plain = made(MOCKS[0], scenario="rock_field")
    plain.reset(seed=0)
    assert np.array_equal(env.render(), plain.render())
    env.close()


def test_pictures_a_second_make_the_mission_run_in_real_time():
    assert made(MOCKS[0]).metadata["render_fps"] == 1
    assert made(MOCKS[0], step_s=0.1).metadata["render_fps"] == 10
    assert made(MOCKS[0], step_s=30.0).metadata["render_fps"] == 1


def test_without_a_render_mode_nothing_is_shown():
    env = made(MOCKS[0], render_mode=None)
    env.reset(seed=0)
    assert env.unwrapped.render() is None
    env.close()


def test_render_before_reset_and_after_close_is_refused():
    env = made(MOCKS[0]).unwrapped
    with pytest.raises(ConfigError, match="not reset"):
        env.render()
    env.reset(seed=0)
    env.close()
    with pytest.raises(ConfigError, match=r"closed; reset\(\) opens it again"):
        env.render()


def test_without_pygame_a_window_is_refused_in_one_line_and_not_offered(monkeypatch):
    window.problem.cache_clear()
    monkeypatch.setattr(window.importlib.util, "find_spec", lambda name: None)
    try:
        with pytest.raises(ConfigError, match="opens no window here, Pygame is not installed: pip install pygame") as refusal:
            made(MOCKS[0], render_mode="human")
        assert "\n" not in str(refusal.value)
        env = made(MOCKS[0], render_mode=None)
        assert env.metadata["render_modes"] == ["rgb_array"]
        check_env(env.unwrapped)
    finally:
        window.problem.cache_clear()


WINDOWED = """
import sys
import gymnasium as gym
import envs  # noqa: F401
env = gym.make("AthleteTwin/SdmB-Mock-v0", render_mode="human", cameras=(), link=0.0)
env.reset(seed=0)
env.step(env.action_space.sample())
assert env.render() is None
import pygame
shown = pygame.surfarray.array3d(pygame.display.get_surface()).swapaxes(0, 1)
still = gym.make("AthleteTwin/SdmB-Mock-v0", render_mode="rgb_array", cameras=(), link=0.0)
still.reset(seed=0)
first = still.render()
assert shown.shape == first.shape and abs(shown.astype(int) - first).mean() < 10.0
env.reset(seed=1)
assert pygame.display.get_surface() is not None
env.close()
assert not pygame.display.get_init()
"""


def in_fresh_process(program, **variables):
    """A driver is chosen when Pygame is first asked, from the environment."""
    unset = {name: value for name, value in os.environ.items() if name not in ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER")}
    return subprocess.run([sys.executable, "-c", program], env=unset | variables, cwd=ROOT, capture_output=True, text=True, timeout=300)


@pytest.mark.slow
@pytest.mark.ci
def test_human_mode_draws_in_a_window_by_itself():
    pytest.importorskip("pygame", reason="the extra 'window' is not installed: pip install -e .[window]")
    done = in_fresh_process(WINDOWED, SDL_VIDEODRIVER="dummy")
    assert done.returncode == 0, done.stderr


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere there is a display")
def test_without_a_display_a_window_is_refused():
    pytest.importorskip("pygame", reason="the extra 'window' is not installed: pip install -e .[window]")
    done = in_fresh_process(WINDOWED)
    assert done.returncode == 1
    assert "render_mode 'human' opens no window here, no display is found: render_mode 'rgb_array' needs none" in done.stderr
