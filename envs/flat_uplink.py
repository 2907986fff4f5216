"""The uplink environment for learners that want arrays: one vector of actions in [-1, 1], one vector of what came down.

For Stable-Baselines3 and its like, which take no dictionary as an action.
"""

from __future__ import annotations

from typing import Any, cast

import gymnasium as gym
import numpy as np

from athlete_twin.errors import ConfigError
from athlete_twin.model.spec import LEGS
from envs.action_fields import Action, units
from envs.env import UplinkEnv
from envs.spaces import FAULTS, GUARD_NAMES, KINDS, RECEIPTS, STATES, Observation

GOAL_SPAN = 10.0
"""of the goal's coordinates [m]"""
FRESH = 10.0
"""an age a [s] is shown as a / (a + FRESH): 0 is now, 1 is never"""
ACCELERATION_SPAN = 20.0
"""[m/s2]"""
TORQUE_SPAN = 2.0
"""of torques over their limits"""

Flat = np.ndarray | dict[str, np.ndarray]


class FlatUplink(gym.Wrapper[Flat, np.ndarray, Observation, Action]):
    """An `UplinkEnv` with flat spaces.

    **Action**: Box(-1, 1), float32, these in a row. A choice goes to the greatest of its numbers.

    | numbers | meaning |
    |---|---|
    | 7 | choose `kind`: nothing, joint move, leg move, body move, images, stop, drive |
    | 6 | choose `leg` |
    | 3 | choose `guard`: none, break contact, contact |
    | dof, 3, 3, 3, 2 | `joints`, `wheel`, `shift`, `turn`, `drive` as in `UplinkEnv` |
    | n | one for each camera: wanted when above 0; absent without cameras |

    **Observation**: Box(-1, 1), float32, these in a row; zero until something has come down.

    | numbers | meaning |
    |---|---|
    | 1 | mission time over the time limit |
    | 2 | goal in `world`, over 10 m |
    | 2 | age a [s] of telemetry and of the last fault, as a / (a + 10 s) |
    | 6 dof, 6 dof | `joints`, `motors`: -1 at the lower limit, 1 at the upper |
    | 6 dof | `torques` over twice their limits |
    | 3, 3, 3 | `attitude_rpy` over pi, `rates` [rad/s], `acceleration` over 20 m/s2, in `hex` |
    | 5, 7, 11 | one of `envs.spaces.STATES`, `RECEIPTS`, `FAULTS`: 1 where it applies |
    | n, n | with cameras: whether a picture has come, and its age as above |

    With cameras the observation is a Dict of this `vector` and of `pictures`: all left, then all right slots as channels,
    shape (2 n, h, w), uint8.
    """

    def __init__(self, env: gym.Env[Observation, Action]) -> None:
        if not isinstance(env.unwrapped, UplinkEnv):
            raise ConfigError(f"FlatUplink wraps an UplinkEnv, as 'AthleteTwin/SdmB-v0' makes it, not {type(env.unwrapped).__name__}")
        super().__init__(env)
        base = env.unwrapped
        self._spec, self._cameras, self._time_limit = base.drawings, base.cameras, base.time_limit
        n = len(self._cameras)
        self._parts = {"kind": len(KINDS), "leg": LEGS, "guard": len(GUARD_NAMES), "joints": self._spec.dof}
        self._parts |= {"wheel": 3, "shift": 3, "turn": 3, "drive": 2, "cameras": n}
        self.action_space = gym.spaces.Box(-1.0, 1.0, (sum(self._parts.values()),), np.float32)
        joints = LEGS * self._spec.dof
        size = 5 + 3 * joints + 9 + len(STATES) + len(RECEIPTS) + len(FAULTS) + 2 * n
        vector = gym.spaces.Box(-1.0, 1.0, (size,), np.float32)
        self.observation_space: gym.Space[Any] = vector
        if n:
            _, height, width = base.observation_space["left"].shape
            pictures = gym.spaces.Box(0, 255, (2 * n, height, width), np.uint8)
            self.observation_space = gym.spaces.Dict({"vector": vector, "pictures": pictures})

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Flat, dict[str, Any]]:
        """A fresh robot; nothing has come down yet."""
        observation, info = self.env.reset(seed=seed, options=options)
        return self.flat(observation), info

    def step(self, action: np.ndarray) -> tuple[Flat, float, bool, bool, dict[str, Any]]:
        """Send what the numbers say, and wait."""
        observation, reward, terminated, truncated, info = self.env.step(self.named(action))
        return self.flat(observation), float(reward), terminated, truncated, info

    def named(self, action: np.ndarray) -> Action:
        """The action of `UplinkEnv` that a row of numbers means."""
        numbers = units({"action": action}, "action", sum(self._parts.values()))
        ends = np.cumsum(list(self._parts.values()))
        out: Action = dict(zip(self._parts, np.split(numbers, ends[:-1]), strict=True))
        out |= {name: np.int64(np.argmax(out[name])) for name in ("kind", "leg", "guard")}
        out["cameras"] = (out["cameras"] > 0.0).astype(np.int8)
        return out

    def flat(self, observation: Observation) -> Flat:
        """An observation of `UplinkEnv` as numbers."""
        spec, o = self._spec, observation
        middle, half = 0.5 * (spec.upper + spec.lower), 0.5 * (spec.upper - spec.lower)
        known = o["telemetry_age"] < o["t"] + FRESH  # angles of zero mean something, nothing heard is shown as zeros
        row = [
            o["t"] / self._time_limit,
            o["goal_in_world"] / GOAL_SPAN,
            _aged(o["telemetry_age"]),
            _aged(o["fault_age"]),
            *(known * ((o[name] - middle) / half).ravel() for name in ("joints", "motors")),
            o["torques"].ravel() / TORQUE_SPAN,
            o["attitude_rpy"] / np.pi,
            o["rates"],
            o["acceleration"] / ACCELERATION_SPAN,
            *(_one_of(o[name], names) for name, names in _CHOICES.items()),
        ]
        if self._cameras:
            row += [o["image_present"], _aged(o["image_age"])]
        vector = np.clip(np.concatenate(row), -1.0, 1.0).astype(np.float32)
        if not self._cameras:
            return cast(np.ndarray, vector)
        return {"vector": vector, "pictures": np.concatenate([o["left"], o["right"]])}


_CHOICES = {"executive_state": STATES, "receipt": RECEIPTS, "fault": FAULTS}


def _aged(age: np.ndarray) -> np.ndarray:
    return np.asarray(age / (age + FRESH))


def _one_of(choice: Any, names: tuple[str, ...]) -> np.ndarray:
    out = np.zeros(len(names))
    out[int(choice)] = 1.0
    return out
