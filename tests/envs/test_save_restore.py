"""The same episode to the last bit: again, in another process, after going back, in vector environments.

Run as a program it prints the hash of one episode: `python tests/envs/test_save_restore.py AthleteTwin/SdmB-Mock-v0 300`.
"""

import hashlib
import os
import pickle
import subprocess
import sys
from functools import partial
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv

import envs  # noqa: F401
from athlete_twin.errors import ConfigError, PhysicsError
from athlete_twin.messages import plain
from envs.agent_maker import identity_of
from envs.operator_env import OperatorEnv
from envs.spaces import KINDS

ROOT = Path(__file__).resolve().parents[2]
MOCK, TWIN = "AthleteTwin/SdmB-Mock-v0", "AthleteTwin/SdmB-v0"
T12_MOCK, T12_TWIN = "AthleteTwin/T12-Mock-v0", "AthleteTwin/T12-v0"
SEED = 5
STEPS = 120
LONG = 10_000


def made(name=MOCK, **kwargs):
    twin = {} if "Mock" in name else {"scenario": "calibration_yard"}
    return gym.make(name, **{"link": 0.3, "cameras": ("hazcam_1",), "step_s": 0.2, "time_limit": 1e5} | twin | kwargs)


class Player:
    """Plays an environment by a script of random actions, and hashes all that comes back."""

    def __init__(self, env, seed=SEED):
        self.env, self.hash = env, hashlib.sha256()
        self.actions = np.random.default_rng(seed)
        self.heard = 0
        self.take(env.reset(seed=seed)[0])

    def play(self, steps):
        for _ in range(steps):
            observation, reward, terminated, truncated, info = self.env.step(self.action())
            self.take(observation)
            self.heard += len(info["messages"])
            self.hash.update(repr((reward, terminated, truncated, info["mission_time_s"], info["truth"])).encode())
            self.hash.update(repr([plain(m) for m in info["messages"]]).encode())
        return self.hash.hexdigest()

    def action(self):
        space, rng = self.env.action_space, self.actions
        action = {name: part.sample() for name, part in space.items()}
        for name, part in space.items():
            drawn = rng.uniform(-0.4, 0.4, part.shape) if isinstance(part, gym.spaces.Box) else rng.integers(0, 2, part.shape)
            action[name] = np.asarray(drawn, part.dtype)
        kinds = ("nothing", "body_move", "drive", "leg_move", "joint_move", "images", "stop")
        chances = (0.80, 0.08, 0.05, 0.02, 0.01, 0.02, 0.02)
        kind = kinds[rng.choice(len(kinds), p=chances)]
        return action | {"kind": np.int64(KINDS.index(kind)), "leg": np.int64(rng.integers(6)), "guard": np.int64(rng.integers(3))}

    def take(self, observation):
        for name in sorted(observation):
            self.hash.update(name.encode() + np.asarray(observation[name]).tobytes())

    def mark(self):
        return self.hash.copy(), self.actions.bit_generator.state

    def back_to(self, mark):
        self.hash, self.actions.bit_generator.state = mark[0].copy(), mark[1]


def in_fresh_process(name, steps):
    command = [sys.executable, str(Path(__file__).resolve()), name, str(steps)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, env=environment, timeout=3000, check=True)
    return done.stdout.strip().splitlines()[-1]


def check_a_branch(name, *, steps, branches):
    """Goes back to several moments, twice each, and carries one over to another environment; all ends are the same.

    Returns how many messages were heard.
    """
    env = made(name)
    player, spacing = Player(env), steps // (branches + 1)
    whole = Player(made(name)).play(steps)
    for _ in range(branches):
        player.play(spacing)
        state, mark = env.unwrapped.save_state(), player.mark()
        ahead = player.play(spacing)
        for _ in range(2):
            observation, _ = env.unwrapped.restore_state(state)
            player.back_to(mark)
            assert player.play(spacing) == ahead
        env.unwrapped.restore_state(state)
        player.back_to(mark)
    assert player.play(steps - branches * spacing) == whole
    other = made(name)
    other.reset()
    again, _ = other.unwrapped.restore_state(pickle.loads(pickle.dumps(state)))
    assert all(np.array_equal(again[k], observation[k]) for k in observation)
    player.env = other
    player.back_to(mark)
    assert player.play(steps - branches * spacing) == whole
    return player.heard


@pytest.mark.slow
def test_mock_goes_on_from_a_saved_moment_as_it_did():
    assert check_a_branch(MOCK, steps=STEPS, branches=3) > STEPS / 20


@pytest.mark.slow
@pytest.mark.ci
@pytest.mark.parametrize("name", [TWIN, T12_TWIN])
def test_twin_goes_on_from_a_saved_moment_as_it_did(name):
    assert check_a_branch(name, steps=120, branches=3) > 6


@pytest.mark.slow
def test_two_processes_and_a_reset_give_the_same_bits():
    env = made()
    player = Player(env)
    player.play(37)
    again = Player(env).play(STEPS)
    assert again == Player(made()).play(STEPS) == in_fresh_process(MOCK, STEPS)
    assert Player(made(), seed=6).play(STEPS) != again


@pytest.mark.slow
@pytest.mark.parametrize("name", [MOCK, TWIN, T12_MOCK, T12_TWIN])
def test_ten_thousand_steps_are_the_same_in_processes_after_reset_and_from_a_saved_moment(name):
    elsewhere = in_fresh_process(name, LONG)
    env = made(name)
    player = Player(env)
    player.play(50)
    player = Player(env)
    player.play(LONG // 2)
    state, mark = env.unwrapped.save_state(), player.mark()
    assert player.play(LONG // 2) == elsewhere
    env.unwrapped.restore_state(state)
    player.back_to(mark)
    assert player.play(LONG // 2) == elsewhere


@pytest.mark.slow
@pytest.mark.ci
def test_spoilt_observations_spoil_nothing():
    class Spoiler(gym.ObservationWrapper):
        def observation(self, observation):
            shown = {name: np.array(value) for name, value in observation.items()}
            for value in observation.values():
                if isinstance(value, np.ndarray):
                    value[...] = 77
            return shown

    assert Player(Spoiler(made())).play(STEPS) == Player(made()).play(STEPS)


@pytest.mark.parametrize(
    ("kind", "steps"),
    [
        (SyncVectorEnv, 10),
        pytest.param(AsyncVectorEnv, 30, marks=[pytest.mark.slow, pytest.mark.ci]),
        *(pytest.param(kind, LONG, marks=pytest.mark.slow) for kind in (SyncVectorEnv, AsyncVectorEnv)),
    ],
)
def test_vector_environments_show_what_single_ones_show(kind, steps):
    seeds = [SEED, SEED + 1]
    vector = kind([made, made])
    singles = [Player(made(), seed=seed) for seed in seeds]
    seen, _ = vector.reset(seed=seeds)
    scripts = [Player(made(), seed=seed) for seed in seeds]
    for _ in range(steps):
        actions = [script.action() for script in scripts]
        batch = {name: np.array([a[name] for a in actions]) for name in actions[0]}
        seen, rewards, _, _, infos = vector.step(batch)
        for i, single in enumerate(singles):
            observation, reward, _, _, info = single.env.step(actions[i])
            assert all(np.array_equal(seen[k][i], observation[k]) for k in observation)
            assert rewards[i] == reward and infos["truth"]["goal_distance_m"][i] == info["truth"]["goal_distance_m"]
    vector.close()


@pytest.mark.parametrize("name", [MOCK, T12_MOCK])
@pytest.mark.parametrize("steps", [10, *(pytest.param(steps, marks=pytest.mark.slow) for steps in (150, LONG))])
def test_any_step_of_an_episode_can_be_gone_back_to(name, steps):
    """Every now and then back to the step just left, some steps on: in the end the hash is that of going straight on."""
    rng = np.random.default_rng(steps)
    env, gone = made(name), 0
    player = Player(env)
    while gone < steps:
        ahead = int(min(rng.integers(1, 1 + max(steps // 20, 2)), steps - gone))
        state, mark = env.unwrapped.save_state(), player.mark()
        player.play(int(rng.integers(1, min(20, steps))))
        env.unwrapped.restore_state(state)
        player.back_to(mark)
        player.play(ahead)
        gone += ahead
    assert player.hash.hexdigest() == Player(made(name)).play(steps)


def test_restored_environment_draws_the_same_next_episode():
    env = made()
    Player(env).play(3)
    state = env.unwrapped.save_state()
    env.reset()
    seed = env.unwrapped.save_state().seed
    env.unwrapped.restore_state(state)
    env.reset()
    assert env.unwrapped.save_state().seed == seed


@pytest.mark.slow
def test_operator_environment_goes_back_by_running_again(scripted):
    def env():
        return OperatorEnv("sdm_b", body="mock", link=1.0, step_s=5.0, make_agent=lambda *_: scripted(steps=2))

    def play(player, count):
        return [player.step({"kind": np.int64(0)}) for _ in range(count)]

    first = env()
    first.reset(seed=3)
    play(first, 6)
    state = first.save_state()
    ahead = play(first, 12)
    for other in (first, env()):
        other.restore_state(state)
        for one, two in zip(ahead, play(other, 12), strict=True):
            assert all(np.array_equal(one[0][k], two[0][k]) for k in one[0]) and one[1:4] == two[1:4]
            assert one[4] == two[4]


def test_state_of_another_environment_is_refused():
    env = made()
    with pytest.raises(ConfigError, match="not reset"):
        env.unwrapped.save_state()
    env.reset(seed=1)
    state = env.unwrapped.save_state()
    with pytest.raises(ConfigError, match=r"saved with step_s 0\.2, this environment has 0\.5"):
        made(step_s=0.5).unwrapped.restore_state(state)


def test_state_of_an_environment_with_another_ground_is_refused(scripted, tmp_path):
    def env(steps):
        return OperatorEnv("sdm_b", body="mock", link=1.0, step_s=5.0, make_agent=lambda *_: scripted(steps=steps))

    def of(path):
        return OperatorEnv("sdm_b", body="mock", link=1.0, step_s=5.0, variant=str(path))

    mine = env(2)
    mine.reset(seed=3)
    state = mine.save_state()
    env(2).restore_state(state)
    with pytest.raises(ConfigError, match="saved with make_agent"):
        env(3).restore_state(state)
    with pytest.raises(ConfigError, match="saved with make_agent"):
        OperatorEnv("sdm_b", body="mock", link=1.0, step_s=5.0).restore_state(state)
    path = tmp_path / "own.toml"
    path.write_text('base = "blind"\n')
    theirs = of(path)
    theirs.reset(seed=3)
    state = theirs.save_state()
    of(path).restore_state(state)
    path.write_text('base = "integrated"\n')
    with pytest.raises(ConfigError, match="saved with variant's content"):
        of(path).restore_state(state)


@pytest.mark.parametrize(
    ("one", "other", "same"),
    [
        (partial(max, 1), partial(max, 1), True),
        (partial(max, 1), partial(max, 2), False),
        (partial(max, key=len), partial(min, key=len), False),
        (Player, Player, True),
        (Player, made, False),
    ],
)
def test_makers_of_grounds_are_told_apart_by_what_they_are_and_hold(one, other, same):
    assert (identity_of(one) == identity_of(other)) == same


def test_state_that_steps_alone_do_not_lead_to_is_refused():
    env = made()
    env.reset(seed=1)
    env.unwrapped.mission.advance(3.3)
    state = pickle.loads(pickle.dumps(env.unwrapped.save_state()))
    with pytest.raises(ConfigError, match=r"run again to 0\.0 s instead of 3\.3 s"):
        made().unwrapped.restore_state(state)


@pytest.mark.slow
def test_moment_that_the_body_cannot_save_is_run_again(monkeypatch):
    env = made()
    player = Player(env)
    player.play(40)

    def touching():
        raise PhysicsError("hex touches something")

    with monkeypatch.context() as patch:
        patch.setattr(env.unwrapped.mission.robot, "save", touching)
        state, mark = env.unwrapped.save_state(), player.mark()
    assert state.moment is None
    ahead = player.play(40)
    env.unwrapped.restore_state(state)
    player.back_to(mark)
    assert player.play(40) == ahead


if __name__ == "__main__":
    sys.stdout.write(Player(made(sys.argv[1])).play(int(sys.argv[2])) + "\n")
