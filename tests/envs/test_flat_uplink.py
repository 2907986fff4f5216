import re
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env as gymnasiums_check

import envs
from athlete_twin.errors import CommandError, ConfigError
from envs.operator_env import OperatorEnv
from envs.spaces import FAULTS, KINDS, NEVER

MOCKS = ("AthleteTwin/SdmB-Mock-v0", "AthleteTwin/T12-Mock-v0")
CAMERAS = ((), ("hazcam_1", "navcam_1"))


def flat(name=MOCKS[0], **kwargs):
    return envs.FlatUplink(gym.make(name, **{"link": 0.2, "cameras": (), "time_limit": 60.0} | kwargs))


@pytest.mark.parametrize("cameras", CAMERAS)
@pytest.mark.parametrize("name", MOCKS)
def test_spaces_are_flat_bounded_and_kept(name, cameras):
    env = flat(name, cameras=cameras)
    box = env.action_space
    assert isinstance(box, gym.spaces.Box) and box.dtype == np.float32
    assert (box.low == -1.0).all() and (box.high == 1.0).all() and len(box.shape) == 1
    observation, _ = env.reset(seed=0)
    env.action_space.seed(0)
    for _ in range(30):
        assert env.observation_space.contains(observation)
        observation = env.step(env.action_space.sample())[0]


def test_gymnasiums_checker_finds_nothing():
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        gymnasiums_check(_as_one_env(flat(link=5.0)), skip_render_check=True, skip_close_check=True)
    assert [str(one.message) for one in told] == []


def _as_one_env(wrapped):
    """The wrapper as an environment of its own: the checker warns of wrappers as such."""

    class One(gym.Env):
        action_space, observation_space, metadata = wrapped.action_space, wrapped.observation_space, wrapped.metadata

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            return wrapped.reset(seed=seed, options=options)

        def step(self, action):
            return wrapped.step(action)

    return One()


def test_sheet_adds_up_to_the_shapes():
    env = flat(cameras=CAMERAS[1])
    dof, n = 6, 2
    action, observation = (part.split("**Observation**")[k] for k, part in enumerate([env.__doc__.split("**Action**")[1]] * 2))

    def total(sheet):
        cells = [line.split("|")[1] for line in sheet.splitlines() if re.match(r"\s*\|\s*(\d|n\b|dof)", line)]
        terms = [t.strip() for cell in cells for t in cell.split(",")]
        value = {"n": n, "dof": dof, "6 dof": 6 * dof}
        return sum(value[t] if t in value else int(t) for t in terms)

    assert total(action) == env.action_space.shape[0]
    assert total(observation) == env.observation_space["vector"].shape[0]


def test_numbers_mean_the_action_of_the_uplink_environment():
    env = flat(cameras=CAMERAS[1])
    numbers = np.full(env.action_space.shape, -0.5, np.float32)
    numbers[KINDS.index("body_move")] = 0.9
    numbers[7 + 4] = 0.1
    numbers[7 + 6 + 2] = 1.0
    numbers[7 + 6 + 3 + 6 + 3 : 7 + 6 + 3 + 6 + 6] = [0.1, 0.2, 0.3]
    numbers[-1] = 0.2
    named = env.named(numbers)
    assert (named["kind"], named["leg"], named["guard"]) == (KINDS.index("body_move"), 4, 2)
    np.testing.assert_allclose(named["shift"], [0.1, 0.2, 0.3], atol=1e-7)
    np.testing.assert_array_equal(named["cameras"], [0, 1])
    assert env.unwrapped.action_space.contains(
        {k: v.astype(np.float32) if v.dtype == float else v for k, v in named.items()}
    )


def test_same_episode_as_the_uplink_environment_shows():
    env, plain = flat(), gym.make(MOCKS[0], link=0.2, cameras=(), time_limit=60.0)
    seen, _ = env.reset(seed=2)
    expected, _ = plain.reset(seed=2)
    env.action_space.seed(2)
    for _ in range(20):
        np.testing.assert_array_equal(seen, env.flat(expected))
        action = env.action_space.sample()
        seen, reward, *_ = env.step(action)
        expected, other, *_ = plain.step(env.named(action))
        assert reward == other
    spec = env.unwrapped.drawings
    joints = 0.5 * (seen[5 : 5 + 36].reshape(6, 6) + 1.0) * (spec.upper - spec.lower) + spec.lower
    np.testing.assert_allclose(joints, expected["joints"], atol=1e-5)


def test_what_never_came_is_shown_as_zeros_of_full_age():
    env = flat(link=5.0)
    observation, _ = env.reset(seed=0)
    assert observation[3] == pytest.approx(NEVER / (NEVER + 10.0))
    assert not observation[5 : 5 + 3 * 36 + 9].any()
    assert observation[-len(FAULTS)] == 1.0


def test_numbers_that_are_none_are_refused_by_name():
    env = flat()
    env.reset(seed=0)
    for wrong in (np.full(env.action_space.shape, np.nan), np.zeros(3), np.full(env.action_space.shape, "up")):
        with pytest.raises(CommandError, match=rf"action\['action'\] is .*must be {env.action_space.shape[0]} finite numbers"):
            env.step(wrong)


def test_other_environments_are_refused():
    with pytest.raises(ConfigError, match=r"wraps an UplinkEnv.*not OperatorEnv"):
        envs.FlatUplink(OperatorEnv("sdm_b", body="mock"))


STABLE_BASELINES = "the extra 'rl' is not installed: pip install -e .[rl]"


@pytest.mark.parametrize("cameras", CAMERAS)
@pytest.mark.parametrize("name", MOCKS)
@pytest.mark.slow
@pytest.mark.ci
def test_stable_baselines_checker_finds_nothing(name, cameras):
    checker = pytest.importorskip("stable_baselines3.common.env_checker", reason=STABLE_BASELINES)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        checker.check_env(flat(name, cameras=cameras))


@pytest.mark.slow
@pytest.mark.ci
def test_ppo_trains_for_a_thousand_steps():
    baselines = pytest.importorskip("stable_baselines3", reason=STABLE_BASELINES)
    env = flat(link=0.0, step_s=0.2, time_limit=20.0)
    learner = baselines.PPO("MlpPolicy", env, n_steps=250, batch_size=50, seed=0, device="cpu")
    before = {k: v.clone() for k, v in learner.policy.state_dict().items()}
    learner.learn(1000)
    assert learner.num_timesteps == 1000
    assert all(bool(v.isfinite().all()) for v in learner.policy.state_dict().values())
    assert any(not v.equal(before[k]) for k, v in learner.policy.state_dict().items())
