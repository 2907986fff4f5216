"""Actions that no space would sample: wrong shapes and types, NaN, infinity, extremes.

Each is either refused by the name of a field, with nothing changed, or done within the joints' limits; and from wherever it
led the legs can be commanded back to where they stood.
"""

import re
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

import envs
from athlete_twin.errors import CommandError
from athlete_twin.messages import CommandSequence, JointMove, Receipt, Stop
from athlete_twin.model.spec import LEGS
from athlete_twin.model.stance import regular_stance
from envs.operator_env import OperatorEnv

ROOT = Path(__file__).resolve().parents[2]
MANY = 10_000
QUICK = 300
BACK_EVERY = 500
"""actions between two ways back"""
ODD = (np.nan, np.inf, -np.inf, 0.0, -0.0, 1e-310, 1.0, -1.0, 1.0000001, 3.5, -7.0, 1e9, -1e9, 3.4e38, 1.7e308, 2**31, -(2**63))
THINGS = (None, "up", b"\0", [], {}, [[1.0], [1.0, 2.0]], object(), 1j, np.array("x"), np.array([None, 1]), True, 10**400)


def odd_array(rng, shape):
    """Of the right shape mostly, with odd values mostly."""
    if rng.random() < 0.15:
        shape = [(), (0,), (*shape, 1), (shape[0] + 1,) if shape else (2,), (3, 3)][rng.integers(5)]
    value = rng.uniform(-1.0, 1.0, shape)
    odd = rng.random(shape) < rng.choice([0.0, 0.0, 0.3])
    value = np.where(odd, rng.choice(ODD, shape), value)
    with np.errstate(over="ignore", invalid="ignore"):
        return value.astype(rng.choice(["f4", "f8", "f8", "f2", "i8", "u1", "?"], p=[0.4, 0.2, 0.2, 0.05, 0.05, 0.05, 0.05]))


def odd_action(rng, space):
    if isinstance(space, gym.spaces.Box):
        return odd_array(rng, space.shape)
    action = {}
    for name, part in space.items():
        if isinstance(part, gym.spaces.Discrete):
            action[name] = rng.integers(part.n) if rng.random() < 0.95 else rng.choice(ODD)
        else:
            action[name] = odd_array(rng, part.shape)
        if isinstance(part, gym.spaces.MultiBinary) and rng.random() < 0.8:
            action[name] = rng.integers(0, 2, part.shape).astype(np.int8)
        if rng.random() < 0.02:
            action[name] = THINGS[rng.integers(len(THINGS))]
    if rng.random() < 0.02:
        del action[rng.choice(list(action))]
    return action


def uplink(robot):
    return gym.make(f"AthleteTwin/{robot}-Mock-v0", link=0.2, cameras=("hazcam_1",), time_limit=1e6).unwrapped


def check_within_limits(env, tolerance=1e-6):
    spec, joints = env.unwrapped.drawings, env.unwrapped.mission.robot.truth().joints
    assert (joints >= spec.lower - tolerance).all() and (joints <= spec.upper + tolerance).all()


def check_way_back(env):
    """A stop, and then each leg is sent to where it stood at first: all arrive."""
    base, spec = env.unwrapped, env.unwrapped.drawings
    stance, mission = regular_stance(spec), base.mission
    base.step_message(Stop(seq=base._sequences, robot_id=spec.name, t=mission.t, reason="test"))
    number = base._sequences
    legs = tuple(JointMove(leg=leg, waypoints=stance[leg][None]) for leg in range(LEGS))
    # How hard a leg may push on the way is the sender's to say: the mock's wheels are dragged over its ground.
    *_, info = base.step_message(
        CommandSequence(
            seq=number, robot_id=spec.name, t=mission.t, sequence_id=number, commands=legs, max_torque_fraction=10.0, max_tilt=1.5,
            max_swing_force=1e6,
        )
    )  # fmt: skip
    said = list(info["messages"])
    for _ in range(2000):
        if any(_ends(m, number) for m in said):
            break
        said += base.step_message(None)[4]["messages"]
    ours = [m for m in said if isinstance(m, Receipt) and m.sequence_id == number]
    assert ours and ours[-1].status == "completed", [(m.status, m.text) for m in ours]
    assert np.allclose(mission.robot.truth().joints, stance, atol=1e-6)


def _ends(message, number):
    ours = isinstance(message, Receipt) and message.sequence_id == number
    return ours and (message.status in ("failed", "refused") or (message.status == "completed" and message.command_index < 0))


def fuzz(env, count, *, seed, back=check_way_back):
    """How many were done and how many refused."""
    rng = np.random.default_rng(seed)
    env.reset(seed=seed)
    done = refused = 0
    for k in range(count):
        action = odd_action(rng, env.action_space)
        before = env.unwrapped.mission.t, env.unwrapped.mission.counts.uplinks
        try:
            observation, reward, terminated, _, _ = env.step(action)
        except CommandError as e:
            assert re.match(r"action\['\w+'\] is |the action is ", str(e)) and "\n" not in str(e), str(e)
            assert (env.unwrapped.mission.t, env.unwrapped.mission.counts.uplinks) == before
            refused += 1
            continue
        done += 1
        assert env.observation_space.contains(observation) and np.isfinite(reward)
        check_within_limits(env)
        if terminated:
            env.reset(seed=seed + k)
        elif back and k % BACK_EVERY == BACK_EVERY - 1:
            back(env)
    return done, refused


COUNTS = [QUICK, pytest.param(MANY, marks=pytest.mark.slow)]


@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("robot", ["SdmB", "T12"])
@pytest.mark.slow
@pytest.mark.ci
def test_uplink_environment_takes_or_refuses_any_action(robot, count):
    env = uplink(robot)
    done, refused = fuzz(env, count, seed=1)
    assert min(done, refused) > count // 20
    check_way_back(env)


@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("robot", ["SdmB", "T12"])
@pytest.mark.slow
def test_flat_environment_takes_or_refuses_any_action(robot, count):
    env = envs.FlatUplink(uplink(robot))
    done, refused = fuzz(env, count, seed=2)
    assert min(done, refused) > count // 20
    check_way_back(env)


@pytest.mark.parametrize("count", [60, pytest.param(MANY, marks=pytest.mark.slow)])
@pytest.mark.parametrize("robot", ["sdm_b", "t12"])
def test_operator_environment_takes_or_refuses_any_action(robot, count, scripted):
    env = OperatorEnv(robot, body="mock", link=0.2, time_limit=1e6, make_agent=lambda *_: scripted(robot, steps=10**6))
    done, refused = fuzz(env, count, seed=3, back=None)
    assert min(done, refused) > count // 20


WHOLES = """
import gymnasium as gym, numpy as np, envs
from athlete_twin.errors import CommandError
plain = gym.make("AthleteTwin/SdmB-Mock-v0", cameras=()).unwrapped
for env in (plain, envs.FlatUplink(plain)):
    env.reset(seed=0)
    for thing in (None, "up", b"", [], {}, 7, 1j, [[1.0], [1.0, 2.0]], object(), np.array("x"), np.array([None, 1]), 10**400):
        try:
            env.step(thing)
        except CommandError as e:
            assert "action" in str(e) and chr(10) not in str(e), e
        else:
            raise AssertionError(f"{thing!r} was taken")
"""


def test_what_is_no_action_at_all_is_refused_as_such():
    # In a process of its own: here the annotations are enforced, and would refuse it first.
    done = subprocess.run([sys.executable, "-c", WHOLES], cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("robot", ["SdmB", "T12"])
def test_twin_takes_or_refuses_any_action(robot):
    env = gym.make(f"AthleteTwin/{robot}-v0", scenario="calibration_yard", link=0.2, cameras=(), time_limit=1e6).unwrapped
    done, refused = fuzz(env, QUICK, seed=4, back=None)
    assert min(done, refused) > QUICK // 20
