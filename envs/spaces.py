"""Spaces of the environments, and the way between them and messages. Actions are normalised to [-1, 1].

A learner sees arrays; whoever holds message objects sends those instead (`UplinkEnv.step_message`).
"""

from __future__ import annotations

from typing import Any

import cv2
import gymnasium as gym
import numpy as np

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
from envs.action_fields import Action, flags, one_of, units

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
"""age of what has not come down yet, and the longest time shown [s]"""
FAR = 1e4
"""bound of places in world [m]"""

RECEIPTS = ("none", *RECEIPT_STATES)
FAULTS = (
    "none", "torque_limit", "tilt", "no_contact", "contact_not_broken", "unreachable", "bad_command", "brown_out", "swing_contact",
    "ratchet_slip", "other",
)  # fmt: skip
STATES = ("unknown", *EXECUTIVE_STATES)

Observation = dict[str, Any]


def uplink_action_space(spec: RobotSpec, cameras: tuple[str, ...]) -> gym.spaces.Dict:
    """What can go up in one step, as `UplinkEnv` documents it. Without cameras there is no key for them."""
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
            **({"cameras": gym.spaces.MultiBinary(len(cameras))} if cameras else {}),
        }
    )


def command_of(action: Action, spec: RobotSpec, cameras: tuple[str, ...]) -> Command | None:
    """The command an action means; None for nothing, a stop, or an image request that names no camera.

    Only the fields that the kind uses are read. What lies outside [-1, 1] is taken as the bound; what is no number, not
    finite or of another shape raises `CommandError` with the field's name.
    """
    kind = KINDS[one_of(action, "kind", len(KINDS))]
    if kind == "joint_move":
        angles = spec.lower + 0.5 * (units(action, "joints", spec.dof) + 1.0) * (spec.upper - spec.lower)
        return JointMove(leg=one_of(action, "leg", LEGS), waypoints=angles[None])
    if kind == "leg_move":
        leg, guard = one_of(action, "leg", LEGS), GUARD_NAMES[one_of(action, "guard", len(GUARD_NAMES))]
        target = stance_wheels_in_hex(spec)[leg] + WHEEL_SPAN * units(action, "wheel", 3)
        share = spec.mass * 9.81 / LEGS
        load = CONTACT_SHARE * share if guard == "contact" else 0.0
        return LegMove(leg=leg, wheel_in_hex=target, guard=guard, contact_load=load)
    if kind == "body_move":
        shift, turn = units(action, "shift", 3), units(action, "turn", 3)
        return BodyMove(translation_in_hex=SHIFT_SPAN * shift, rotvec_in_hex=TURN_SPAN * turn)
    if kind == "drive":
        return Drive(translation_in_hex=DRIVE_SPAN * units(action, "drive", 2), speed=spec.drive_speed)
    if kind == "images" and cameras:
        named = tuple(c for c, wanted in zip(cameras, flags(action, "cameras", len(cameras)), strict=True) if wanted)
        return ImageRequest(cameras=named, binning=BINNING) if named else None
    return None


def downlink_space(spec: RobotSpec, cameras: tuple[str, ...]) -> gym.spaces.Dict:
    """What has come down by now, each with its age, as `UplinkEnv` documents it."""
    bounds: dict[str, gym.spaces.Space] = {
        "t": _box(0.0, NEVER, (1,)),
        "goal_in_world": _box(-FAR, FAR, (2,)),
        "telemetry_age": _box(0.0, NEVER, (1,)),
        **{name: _box(-bound, bound, shape) for name, (bound, shape) in _telemetry_bounds(spec).items()},
        "executive_state": gym.spaces.Discrete(len(STATES)),
        "receipt": gym.spaces.Discrete(len(RECEIPTS)),
        "receipt_of": _box(-1.0, NEVER, (1,)),
        "fault": gym.spaces.Discrete(len(FAULTS)),
        "fault_age": _box(0.0, NEVER, (1,)),
    }
    if cameras:
        n, (height, width) = len(cameras), image_size(spec, cameras)
        bounds |= {
            "image_present": gym.spaces.MultiBinary(n),
            "image_age": _box(0.0, NEVER, (n,)),
            "left": gym.spaces.Box(0, 255, (n, height, width), np.uint8),
            "right": gym.spaces.Box(0, 255, (n, height, width), np.uint8),
        }
    return gym.spaces.Dict(bounds)


class DownlinkView:
    """Keeps what the last of each kind of message said, as arrays, and hands out copies."""

    def __init__(self, spec: RobotSpec, cameras: tuple[str, ...], goal: tuple[float, float]) -> None:
        self.spec, self.cameras = spec, cameras
        self._bounds = {name: bound for name, (bound, _) in _telemetry_bounds(spec).items()}
        self._kept: dict[str, np.ndarray] = {"goal_in_world": bounded(goal, FAR)}
        self._kept |= {name: np.zeros(shape, np.float32) for name, (_, shape) in _telemetry_bounds(spec).items()}
        self._counts = {"executive_state": np.int64(0), "receipt": np.int64(0), "fault": np.int64(0)}
        self._kept["receipt_of"] = np.full(1, -1.0, np.float32)
        self._said_at: dict[str, float] = {}
        """when telemetry, fault and each camera's pair were made [s]"""
        self._newest: dict[str, int] = {}
        """highest `seq` of each kind of message, and of each camera's pairs: a link may reorder"""
        if cameras:
            slots = (len(cameras), *image_size(spec, cameras))
            self._kept |= {"left": np.zeros(slots, np.uint8), "right": np.zeros(slots, np.uint8)}

    def take(self, message: Message) -> None:
        """Remember a message that has come down, unless a newer one of its kind came before."""
        kind = message.topic + getattr(message, "camera", "")
        if isinstance(message, StereoPair) and message.bracket:
            return  # a slot shows the first exposure of a bracket
        if message.seq < self._newest.get(kind, 0):
            return
        self._newest[kind] = message.seq
        if isinstance(message, Telemetry):
            for name, bound in self._bounds.items():
                value = message.torques / self.spec.torque_limits if name == "torques" else getattr(message, name)
                self._kept[name] = bounded(value, bound)
            self._counts["executive_state"] = np.int64(STATES.index(message.executive_state))
            self._said_at["telemetry"] = message.t
        elif isinstance(message, Receipt):
            self._counts["receipt"] = np.int64(RECEIPTS.index(message.status))
            self._kept["receipt_of"] = np.full(1, min(message.sequence_id, NEVER), np.float32)
        elif isinstance(message, Fault):
            self._counts["fault"] = np.int64(FAULTS.index(message.code if message.code in FAULTS else "other"))
            self._said_at["fault"] = message.t
        elif isinstance(message, StereoPair) and message.camera in self.cameras:
            self._said_at[message.camera] = message.t
            for side, image in (("left", message.left), ("right", message.right)):
                slot = self._kept[side][self.cameras.index(message.camera)]
                grey = (image >> (message.bits - 8)).astype(np.uint8)
                slot[:] = cv2.resize(grey, slot.shape[::-1], interpolation=cv2.INTER_AREA)

    def observation(self, t: float) -> Observation:
        """What has come down by mission time `t` [s]."""
        out: Observation = {name: kept.copy() for name, kept in self._kept.items()}
        out |= self._counts
        out["t"] = np.array([min(t, NEVER)], np.float32)
        out["telemetry_age"] = np.array([self._age("telemetry", t)], np.float32)
        out["fault_age"] = np.array([self._age("fault", t)], np.float32)
        if self.cameras:
            out["image_present"] = np.array([c in self._said_at for c in self.cameras], np.int8)
            out["image_age"] = np.array([self._age(c, t) for c in self.cameras], np.float32)
        return out

    def _age(self, name: str, t: float) -> float:
        return min(max(t - self._said_at[name], 0.0), NEVER) if name in self._said_at else NEVER


def chosen_cameras(spec: RobotSpec, cameras: tuple[str, ...] | list[str] | None) -> tuple[str, ...]:
    """Names of the cameras an environment shows: those given, none of an empty tuple, all of the robot by default."""
    if cameras is None:
        return tuple(c.name for c in spec.cameras)
    return tuple(spec.camera(name).name for name in cameras)


def image_size(spec: RobotSpec, cameras: tuple[str, ...]) -> tuple[int, int]:
    """Height and width of a picture in observations [px]."""
    eye = spec.camera(cameras[0]).eye.binned(BINNING)
    return eye.height_px, eye.width_px


def _unit(n: int) -> gym.spaces.Box:
    return gym.spaces.Box(-1.0, 1.0, (n,), np.float32)


def _box(low: float, high: float, shape: tuple[int, ...]) -> gym.spaces.Box:
    return gym.spaces.Box(low, high, shape, np.float32)


def bounded(values: Any, bound: float) -> np.ndarray:
    """Values as float32 within plus and minus a bound: rounded to float32 the bound itself may lie outside a space."""
    limit = np.float32(bound)
    single = np.asarray(values, dtype=np.float32)
    return np.asarray(np.minimum(np.maximum(single, -limit), limit))


def _telemetry_bounds(spec: RobotSpec) -> dict[str, tuple[float, tuple[int, ...]]]:
    """Bound and shape of each field that an observation takes from telemetry."""
    per_joint = (LEGS, spec.dof)
    return {
        "joints": (2 * np.pi, per_joint),
        "motors": (2 * np.pi, per_joint),
        "torques": (10.0, per_joint),
        "attitude_rpy": (2 * np.pi, (3,)),
        "rates": (10.0, (3,)),
        "acceleration": (100.0, (3,)),
    }
