"""Spaces of the environments, and the way between them and messages. Actions are normalised to [-1, 1].

A learner sees arrays; whoever holds message objects sends those instead (`UplinkEnv.step_message`).
"""

from __future__ import annotations

from typing import Any

import cv2
import gymnasium as gym
import numpy as np

from athlete_twin.errors import ConfigError
from athlete_twin.messages import (
    EXECUTIVE_STATES,
    RECEIPT_STATES,
    BodyMove,
    Command,
    Drive,
    Fault,
    ImageRequest,
    JointMove,
    LegMove,
    Message,
    Receipt,
    StereoPair,
    Telemetry,
)
from athlete_twin.model.spec import LEGS, RobotSpec
from athlete_twin.model.stance import stance_wheels_in_hex

KINDS = ("nothing", "joint_move", "leg_move", "body_move", "images", "stop", "drive")
"""what the action's `kind` counts"""
GUARD_NAMES = ("none", "break_contact", "contact")
BINNING = 4
"""of pictures in observations and of those an action asks for"""
WHEEL_SPAN = 1.0
"""a leg move's target lies within so much of the normal stance along each axis [m]"""
SHIFT_SPAN = 0.5
"""largest chassis shift along each axis [m]"""
DRIVE_SPAN = 2.0
"""longest drive along x and y, at the robot's own speed [m]"""
TURN_SPAN = 0.2
"""largest chassis turn about each axis [rad]"""
CONTACT_SHARE = 0.4
"""of a wheel's share of the weight: the load that ends a guarded descent"""
NEVER = 1e6
"""age of what has not come down yet [s]"""

RECEIPTS = ("none", *RECEIPT_STATES)
FAULTS = (
    "none", "torque_limit", "tilt", "no_contact", "contact_not_broken", "unreachable", "bad_command", "brown_out", "swing_contact",
    "ratchet_slip",
)  # fmt: skip
STATES = ("unknown", *EXECUTIVE_STATES)

Action = dict[str, Any]
Observation = dict[str, Any]


def uplink_action_space(spec: RobotSpec, cameras: tuple[str, ...]) -> gym.spaces.Dict:
    """What can go up in one step: nothing, one command, an image request or a stop. Keys that a kind does not use are ignored."""
    return gym.spaces.Dict(
        {
            "kind": gym.spaces.Discrete(len(KINDS)),
            "leg": gym.spaces.Discrete(LEGS),
            "joints": _unit(spec.dof),
            "wheel": _unit(3),
            "guard": gym.spaces.Discrete(len(GUARD_NAMES)),
            "shift": _unit(3),
            "turn": _unit(3),
            "drive": _unit(2),
            "cameras": gym.spaces.MultiBinary(len(cameras)),
        }
    )


def command_of(action: Action, spec: RobotSpec, cameras: tuple[str, ...]) -> Command | None:
    """The command an action means; None for nothing, a stop, or an image request that names no camera."""
    kind = KINDS[int(action["kind"])]
    leg = int(action["leg"])
    if kind == "joint_move":
        unit = np.asarray(action["joints"], dtype=float)
        angles = spec.lower + 0.5 * (np.clip(unit, -1.0, 1.0) + 1.0) * (spec.upper - spec.lower)
        return JointMove(leg=leg, waypoints=angles[None])
    if kind == "leg_move":
        guard = GUARD_NAMES[int(action["guard"])]
        target = stance_wheels_in_hex(spec)[leg] + WHEEL_SPAN * np.clip(np.asarray(action["wheel"], dtype=float), -1, 1)
        share = spec.mass * 9.81 / LEGS
        load = CONTACT_SHARE * share if guard == "contact" else 0.0
        return LegMove(leg=leg, wheel_in_hex=target, guard=guard, contact_load=load)
    if kind == "body_move":
        shift, turn = (np.clip(np.asarray(action[k], dtype=float), -1.0, 1.0) for k in ("shift", "turn"))
        return BodyMove(translation_in_hex=SHIFT_SPAN * shift, rotvec_in_hex=TURN_SPAN * turn)
    if kind == "drive":
        way = DRIVE_SPAN * np.clip(np.asarray(action["drive"], dtype=float), -1.0, 1.0)
        return Drive(translation_in_hex=way, speed=spec.drive_speed)
    if kind == "images":
        named = tuple(c for c, wanted in zip(cameras, np.asarray(action["cameras"]), strict=True) if wanted)
        return ImageRequest(cameras=named, binning=BINNING) if named else None
    return None


def downlink_space(spec: RobotSpec, cameras: tuple[str, ...]) -> gym.spaces.Dict:
    """What has come down by now, each with its age."""
    height, width = image_size(spec, cameras)
    n = len(cameras)
    return gym.spaces.Dict(
        {
            "t": _box(0.0, np.inf, (1,)),
            "goal_in_world": _box(-np.inf, np.inf, (2,)),
            "telemetry_age": _box(0.0, NEVER, (1,)),
            "joints": _box(-2 * np.pi, 2 * np.pi, (LEGS, spec.dof)),
            "motors": _box(-2 * np.pi, 2 * np.pi, (LEGS, spec.dof)),
            "torques": _box(-10.0, 10.0, (LEGS, spec.dof)),
            "attitude_rpy": _box(-2 * np.pi, 2 * np.pi, (3,)),
            "rates": _box(-10.0, 10.0, (3,)),
            "acceleration": _box(-100.0, 100.0, (3,)),
            "executive_state": gym.spaces.Discrete(len(STATES)),
            "receipt": gym.spaces.Discrete(len(RECEIPTS)),
            "fault": gym.spaces.Discrete(len(FAULTS)),
            "fault_age": _box(0.0, NEVER, (1,)),
            "image_present": gym.spaces.MultiBinary(n),
            "image_age": _box(0.0, NEVER, (n,)),
            "left": gym.spaces.Box(0, 255, (n, height, width), np.uint8),
            "right": gym.spaces.Box(0, 255, (n, height, width), np.uint8),
        }
    )


class DownlinkView:
    """Keeps the last of each kind of message and turns it into an observation."""

    def __init__(self, spec: RobotSpec, cameras: tuple[str, ...], goal: tuple[float, float]) -> None:
        self.spec, self.cameras = spec, cameras
        self._goal = np.array(goal, dtype=np.float32)
        self._telemetry: Telemetry | None = None
        self._receipt: Receipt | None = None
        self._fault: Fault | None = None
        self._pairs: dict[str, StereoPair] = {}
        height, width = image_size(spec, cameras)
        self._images = np.zeros((2, len(cameras), height, width), dtype=np.uint8)

    def take(self, message: Message) -> None:
        """Remember a message that has come down."""
        if isinstance(message, Telemetry):
            self._telemetry = message
        elif isinstance(message, Receipt):
            self._receipt = message
        elif isinstance(message, Fault):
            self._fault = message
        elif isinstance(message, StereoPair) and message.camera in self.cameras and message.bracket == 0:
            self._pairs[message.camera] = message
            k = self.cameras.index(message.camera)
            size = self._images.shape[:1:-1]
            for side, image in enumerate((message.left, message.right)):
                grey = (image >> (message.bits - 8)).astype(np.uint8)
                self._images[side, k] = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)

    def observation(self, t: float) -> Observation:
        """What has come down by mission time `t` [s]. Torques are over their limits, the rest in SI units."""
        spec, last = self.spec, self._telemetry
        zeros = np.zeros((LEGS, spec.dof), dtype=np.float32)
        torques = zeros if last is None else np.clip(last.torques / spec.torque_limits, -10.0, 10.0)
        fault = self._fault.code if self._fault else "none"
        present = [c in self._pairs for c in self.cameras]
        ages = [t - self._pairs[c].t if c in self._pairs else NEVER for c in self.cameras]
        return {
            "t": _f32([t]),
            "goal_in_world": self._goal.copy(),
            "telemetry_age": _age(t, last),
            "joints": zeros if last is None else _bounded(last.joints, 2 * np.pi),
            "motors": zeros if last is None else _bounded(last.motors, 2 * np.pi),
            "torques": _f32(torques),
            "attitude_rpy": _f32(np.zeros(3)) if last is None else _bounded(last.attitude_rpy, 2 * np.pi),
            "rates": _f32(np.zeros(3)) if last is None else _bounded(last.rates, 10.0),
            "acceleration": _f32(np.zeros(3)) if last is None else _bounded(last.acceleration, 100.0),
            "executive_state": np.int64(STATES.index(last.executive_state) if last else 0),
            "receipt": np.int64(RECEIPTS.index(self._receipt.status) if self._receipt else 0),
            "fault": np.int64(FAULTS.index(fault)),
            "fault_age": _age(t, self._fault),
            "image_present": np.array(present, dtype=np.int8),
            "image_age": _f32(np.clip(ages, 0.0, NEVER)),
            "left": self._images[0].copy(),
            "right": self._images[1].copy(),
        }


def chosen_cameras(spec: RobotSpec, cameras: tuple[str, ...] | list[str] | None) -> tuple[str, ...]:
    """Names of the cameras an environment shows: those given, or all of the robot."""
    if cameras is None:
        return tuple(c.name for c in spec.cameras)
    if not cameras:
        raise ConfigError(f"cameras is empty; {spec.name} has: {', '.join(c.name for c in spec.cameras)}")
    return tuple(spec.camera(name).name for name in cameras)


def image_size(spec: RobotSpec, cameras: tuple[str, ...]) -> tuple[int, int]:
    """Height and width of a picture in observations [px]."""
    eye = spec.camera(cameras[0]).eye.binned(BINNING)
    return eye.height_px, eye.width_px


def _unit(n: int) -> gym.spaces.Box:
    return gym.spaces.Box(-1.0, 1.0, (n,), np.float32)


def _box(low: float, high: float, shape: tuple[int, ...]) -> gym.spaces.Box:
    return gym.spaces.Box(low, high, shape, np.float32)


def _f32(values: Any) -> np.ndarray:
    return np.asarray(values, dtype=np.float32)


def _bounded(values: np.ndarray, bound: float) -> np.ndarray:
    # Rounded to float32 the bound itself may lie outside the space.
    return np.asarray(np.clip(_f32(values), np.float32(-bound), np.float32(bound)))


def _age(t: float, message: Message | None) -> np.ndarray:
    return _f32([NEVER if message is None else min(max(t - message.t, 0.0), NEVER)])
