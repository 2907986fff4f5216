"""What a step of the uplink environment costs at the mock, with and without cameras, and where the time goes.

    python scripts/bench_env.py [--robots sdm_b t12] [--json]

"Nothing sent" lets a second of mission time pass. "Random actions" samples the action space at every step, so that nearly
every step sends a command, moves the robot and ends with what comes down. The peer is a bare Gymnasium environment of the same
spaces, which fills its observation with zeros: what Gymnasium itself costs. Both are the registered ids, with their
wrappers. Times are processor seconds (one thread), the median of some repeats; resets are not counted. The shares are those
of random actions without cameras, by the wall clock.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any
from unittest.mock import patch

import gymnasium as gym
import numpy as np
import tyro
from bench_table import Row, row, show

import envs.mission
from athlete_twin.errors import AthleteError, ConfigError
from envs.env import UplinkEnv
from envs.spaces import KINDS

IDS = {"sdm_b": "AthleteTwin/SdmB-Mock-v0", "t12": "AthleteTwin/T12-Mock-v0"}
BARE = "Bare-v0"
TARGET = "<= 200"
"""of a step without cameras [us]"""
UNIT = "us"
PEER = "bare Gymnasium environment of the same spaces"


@dataclass(frozen=True, kw_only=True)
class Options:
    """Measures and prints some rows a robot."""

    robots: tuple[str, ...] = ("sdm_b", "t12")
    steps: int = 1000
    """in a repeat"""
    repeats: int = 3
    json: bool = False
    """print one JSON object instead of the table"""


class Bare(gym.Env[dict[str, Any], dict[str, Any]]):
    """Spaces and nothing behind them."""

    def __init__(self, action_space: gym.spaces.Dict, observation_space: gym.spaces.Dict) -> None:
        self.action_space, self.observation_space = action_space, observation_space

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict[str, Any], dict[str, Any]]:
        """Zeros."""
        super().reset(seed=seed, options=options)
        return self._zeros(), {}

    def step(self, action: dict[str, Any]) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Zeros again."""
        del action
        return self._zeros(), 0.0, False, False, {}

    def _zeros(self) -> dict[str, Any]:
        return {
            name: np.int64(0) if isinstance(part, gym.spaces.Discrete) else np.zeros(part.shape, part.dtype)
            for name, part in self.observation_space.items()
        }


def main(arguments: list[str] | None = None) -> int:
    """Runs the script; the exit status."""
    options = tyro.cli(Options, args=arguments, description=__doc__)
    try:
        for robot in options.robots:
            if robot not in IDS:
                raise ConfigError(f"robot {robot!r} is not one of: {', '.join(IDS)}")
        rows = [r for robot in options.robots for r in _rows(robot, options)]
    except AthleteError as e:
        sys.stderr.write(f"bench_env: {' '.join(str(e).split())}\n")
        return 2
    show(rows, as_json=options.json)
    return 0


def _rows(robot: str, options: Options) -> list[Row]:
    rows = []
    for said, cameras, target in (("no cameras", (), TARGET), ("all cameras", None, "")):
        env = gym.make(IDS[robot], cameras=cameras)
        spaces = {"action_space": env.action_space, "observation_space": env.observation_space}
        bare = gym.make(gym.envs.registration.EnvSpec(id=BARE, entry_point=Bare, kwargs=spaces))
        for kind, actions in (("nothing sent", _nothing(env, options.steps)), ("random actions", _random(env, options.steps))):
            ours, peer = (_median(e, actions, options.repeats) for e in (env, bare))
            rows.append(row(f"{robot} step, {kind}, {said}", ours, UNIT, target=target, peer_name=PEER, peer=peer))
        if not cameras and cameras is not None:
            rows += _shares(robot, env, _random(env, options.steps))
        env.close()
    return rows


def _nothing(env: gym.Env, steps: int) -> list[dict[str, Any]]:
    env.action_space.seed(0)
    return [env.action_space.sample() | {"kind": np.int64(KINDS.index("nothing"))}] * steps


def _random(env: gym.Env, steps: int) -> list[dict[str, Any]]:
    env.action_space.seed(0)
    return [env.action_space.sample() for _ in range(steps)]


def _median(env: gym.Env, actions: list[dict[str, Any]], repeats: int) -> float:
    """Microseconds a step, the median of some repeats of the same episode; the first one warms up and does not count."""
    spent = []
    for _ in range(repeats + 1):
        env.reset(seed=0)
        used = 0.0
        for action in actions:
            begun = time.process_time()
            *_, terminated, truncated, _ = env.step(action)
            used += time.process_time() - begun
            if terminated or truncated:
                env.reset(seed=0)
        spent.append(1e6 * used / len(actions))
    return float(np.median(spent[1:]))


def _shares(robot: str, env: gym.Env, actions: list[dict[str, Any]]) -> list[Row]:
    """Percent of a step that each part takes."""
    base = env.unwrapped
    if not isinstance(base, UplinkEnv):
        raise ConfigError(f"{type(base).__name__} is no uplink environment")
    env.reset(seed=0)
    mission, spent = base.mission, dict[str, float]()

    def clocked(part: str, work: Callable[..., Any]) -> Callable[..., Any]:
        def timed(*args: Any, **kwargs: Any) -> Any:
            begun = time.perf_counter()
            out = work(*args, **kwargs)
            spent[part] = spent.get(part, 0.0) + time.perf_counter() - begun
            return out

        return timed

    link = "messages to and from bytes, links"
    parts: list[tuple[Any, str, str]] = [
        (mission.robot, "advance", "robot moves"), (base, "_judged", "reward, end, info"), (base, "_observation", "observation"),
    ]  # fmt: skip
    parts += [(way, name, link) for way in (mission.up, mission.down) for name in ("send", "receive_raw")]
    parts += [(mission.robot, "receive_raw", link), (envs.mission, "decode", link)]
    with ExitStack() as stack:
        for owner, name, part in parts:
            stack.enter_context(patch.object(owner, name, clocked(part, getattr(owner, name))))
        begun = time.perf_counter()
        for action in actions:
            *_, terminated, truncated, _ = env.step(action)
            if terminated or truncated:
                break
        whole = time.perf_counter() - begun
    spent["the rest, Gymnasium's wrappers among it"] = whole - sum(spent.values())
    return [row(f"{robot} step, random actions, share of: {part}", 100.0 * s / whole, "%") for part, s in spent.items()]


if __name__ == "__main__":
    sys.exit(main())
