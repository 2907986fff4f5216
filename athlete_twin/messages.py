"""Everything that crosses the link, as frozen messages with a time stamp: twin, mock and recording look the same.

Up goes a `CommandSequence` or a `Stop`; down come `Telemetry`, `StereoPair`, `Receipt` and `Fault`. `encode` gives the
bytes whose length the link charges for and which the recorder keeps; `decode` gives the message back, and refuses bytes
whose checksum does not match or whose fields are not what they should be.

Every message says for which robot or from which robot it is, and counts on: the executive takes a command sequence only
with a higher `seq` than any it took before. One that is damaged, for another robot, stale or repeated, or that finds the
queue full, is refused with a receipt that names the cause. A `Stop` is obeyed whatever its count, from anyone.

Commands speak of motor angles and of wheel positions that follow from them by the drawn kinematics: where the wheel
would be if nothing flexed ([SunSpiral2012] s5.1.1 calls it unsagged). Telemetry carries both sides of the wind-up.

Commands of the on-board executive. The public RAPID set has no limb commands, so their names are this project's own:

- `JointMove`: one leg along way-points in joint space. Free motion: the wheel must touch nothing.
- `LegMove`: one wheel along a straight line in hex, with a guard: `break_contact` (lift-off), `contact` (guarded
  descent: stop when the wheel carries the given load), `place` (down to the end of the line, whatever the wheel feels;
  it stands from then on), `none`.
- `BodyMove`: the chassis along a straight line while all wheels stay where they are.
- `Drive`: on the wheels along a straight line.
- `ImageRequest`: stereo pairs of the named cameras.
- `Wait`: nothing for a while.
"""

from __future__ import annotations

import json
import zlib
from dataclasses import dataclass, field, fields
from typing import Any, ClassVar

import cv2
import numpy as np

from athlete_twin.errors import AthleteError, CommandError, MessageError
from athlete_twin.geometry.arrays import Joints, RawImage, Vec3

FARTHEST = 1e3
"""that a command may name: what is farther is a mistake, and squares of it would overflow [m]"""
GUARDS = ("none", "break_contact", "contact", "place")
CORNER_TOLERANCE, MOST_CORNER_TOLERANCE = 0.01, 0.1
"""by which a joint move cuts its corners unless it says otherwise, and at most [rad]"""
LEAST_SPEED_SCALE = 1e-3
"""slower motions take hours; of full speed"""
BITS = (8, 12)
"""of a grey value"""
MAX_BRACKETS = 5
"""exposures of one request"""
RECEIPT_STATES = ("queued", "executing", "completed", "failed", "cancelled", "refused")
REFUSALS = ("damaged", "misaddressed", "stale", "repeated", "queue_full")
"""why a command was refused"""
EXECUTIVE_STATES = ("idle", "executing", "stopped", "fault")


class _ComparedByContent:
    """Equal are two of one class with equal fields; dataclasses' own comparison asks an array for its truth value."""

    def __eq__(self, other: object) -> bool:
        return type(other) is type(self) and all(_same(v, vars(other)[name]) for name, v in vars(self).items())

    def __hash__(self) -> int:
        return hash((type(self), *(v for v in vars(self).values() if isinstance(v, str | int | float))))


@dataclass(frozen=True, eq=False, kw_only=True)
class JointMove(_ComparedByContent):
    """Move one leg through way-points in joint space from rest to rest, each joint in step with the others."""

    kind: ClassVar[str] = "joint_move"
    leg: int
    """index 0 to 5"""
    waypoints: np.ndarray
    """motor angles (before the wind-up), shape (k, dof); the leg starts from where it is [rad]"""
    speed_scale: float = 1.0
    """of the unloaded joint speed, in (0, 1]; accelerations go with its square"""
    corner_tolerance: float = CORNER_TOLERANCE
    """by which the leg may cut the corners at way-points, 0 to 0.1; zero: it stops at each [rad]"""

    def __post_init__(self) -> None:
        _check_leg(self.leg)
        w = np.asarray(self.waypoints, dtype=float)
        if w.ndim != 2 or len(w) < 1 or not np.isfinite(w).all():
            raise CommandError(f"way-points have shape {w.shape}, need finite (k, dof) with k >= 1")
        _check_speed_scale(self.speed_scale)
        if not 0.0 <= self.corner_tolerance <= MOST_CORNER_TOLERANCE:
            raise CommandError(f"corner_tolerance {self.corner_tolerance} rad is outside 0 to {MOST_CORNER_TOLERANCE}")
        object.__setattr__(self, "waypoints", w)


@dataclass(frozen=True, eq=False, kw_only=True)
class LegMove(_ComparedByContent):
    """Move one wheel along a straight line in the hex frame, the last link keeping its direction."""

    kind: ClassVar[str] = "leg_move"
    leg: int
    """index 0 to 5"""
    wheel_in_hex: Vec3
    """where the axle shall arrive [m]"""
    guard: str = "none"
    """"none", "break_contact", "contact" or "place" """
    contact_load: float = 0.0
    """for guard "contact": the vertical load to stop at [N]"""
    speed_scale: float = 1.0
    """of the joint speed that applies, in (0, 1]"""

    def __post_init__(self) -> None:
        _check_leg(self.leg)
        target = np.asarray(self.wheel_in_hex, dtype=float)
        if target.shape != (3,) or not _near(target):
            raise CommandError(f"wheel target {target} must be a finite point within {FARTHEST:g} m")
        if self.guard not in GUARDS:
            raise CommandError(f"guard {self.guard!r} is not one of {', '.join(GUARDS)}")
        if self.guard == "contact" and not (np.isfinite(self.contact_load) and self.contact_load > 0.0):
            raise CommandError(f"guard 'contact' needs a positive contact_load, got {self.contact_load} N")
        _check_speed_scale(self.speed_scale)
        object.__setattr__(self, "wheel_in_hex", target)

    @property
    def lands(self) -> bool:
        """Whether it is a descent, after which the wheel is taken to stand."""
        return self.guard in ("contact", "place")


@dataclass(frozen=True, eq=False, kw_only=True)
class BodyMove(_ComparedByContent):
    """Move the chassis with all wheels planted, in a straight line and about one axis."""

    kind: ClassVar[str] = "body_move"
    translation_in_hex: Vec3
    """of the hex origin, in the hex frame at the start [m]"""
    rotvec_in_hex: Vec3 = field(default_factory=lambda: np.zeros(3))
    """rotation of the chassis, in the hex frame at the start [rad]"""
    wheel_offsets_in_hex: np.ndarray = field(default_factory=lambda: np.zeros((6, 3)))
    """extra shift of each axle by the end of the move, shape (6, 3): reloads or levels wheels [m]"""
    speed_scale: float = 1.0

    def __post_init__(self) -> None:
        for name, shape in (("translation_in_hex", (3,)), ("rotvec_in_hex", (3,)), ("wheel_offsets_in_hex", (6, 3))):
            value = np.asarray(getattr(self, name), dtype=float)
            if value.shape != shape or not _near(value):
                raise CommandError(f"{name} must be finite, within {FARTHEST:g}, with shape {shape}, got {value.tolist()}")
            object.__setattr__(self, name, value)
        _check_speed_scale(self.speed_scale)


@dataclass(frozen=True, eq=False, kw_only=True)
class Drive(_ComparedByContent):
    """Roll on all six wheels in a straight line: steer, roll, steer back. The chassis keeps its posture and heading."""

    kind: ClassVar[str] = "drive"
    translation_in_hex: np.ndarray
    """where to, shape (2,), in the hex plane [m]"""
    speed: float
    """of the chassis at most [m/s]"""

    def __post_init__(self) -> None:
        way = np.asarray(self.translation_in_hex, dtype=float)
        if way.shape != (2,) or not _near(way):
            raise CommandError(f"translation_in_hex must be two finite lengths within {FARTHEST:g} m, got {way}")
        if not (np.isfinite(self.speed) and self.speed > 0.0):
            raise CommandError(f"drive speed {self.speed} m/s must be positive")
        object.__setattr__(self, "translation_in_hex", way)


@dataclass(frozen=True, eq=False, kw_only=True)
class ImageRequest(_ComparedByContent):
    """Take stereo pairs of each named camera, all at the same time: one, or one for each exposure of a bracket."""

    kind: ClassVar[str] = "image_request"
    cameras: tuple[str, ...]
    binning: int = 2
    """pixels averaged along each axis: 1, 2 or 4"""
    bits: int = 8
    """of a grey value: 8 or 12"""
    brackets: tuple[float, ...] = (1.0,)
    """exposures, in multiples of the metered one, 1/64 to 64: what is white in one is told in another"""

    def __post_init__(self) -> None:
        if not self.cameras:
            raise CommandError("an image request names no camera")
        if self.binning not in (1, 2, 4):
            raise CommandError(f"binning {self.binning} is not one of 1, 2, 4")
        if self.bits not in BITS:
            raise CommandError(f"{self.bits} bits a grey value is not one of {', '.join(map(str, BITS))}")
        brackets = tuple(float(b) for b in self.brackets)
        if not 1 <= len(brackets) <= MAX_BRACKETS:
            raise CommandError(f"{len(brackets)} exposures make no bracket, need 1 to {MAX_BRACKETS}")
        if not all(1.0 / 64.0 <= b <= 64.0 for b in brackets):
            raise CommandError(f"exposures {brackets} must lie between 1/64 and 64 times the metered one")
        object.__setattr__(self, "cameras", tuple(self.cameras))
        object.__setattr__(self, "brackets", brackets)


@dataclass(frozen=True, eq=False, kw_only=True)
class Wait(_ComparedByContent):
    """Do nothing for `duration` [s]."""

    kind: ClassVar[str] = "wait"
    duration: float

    def __post_init__(self) -> None:
        if not (np.isfinite(self.duration) and 0.0 <= self.duration <= 3600.0):
            raise CommandError(f"wait of {self.duration} s is outside 0 to 3600 s")


Command = JointMove | LegMove | BodyMove | Drive | ImageRequest | Wait


@dataclass(frozen=True, eq=False, kw_only=True)
class Message(_ComparedByContent):
    """What every message carries."""

    topic: ClassVar[str] = ""
    seq: int
    """counts messages of this kind from one sender, from 0"""
    robot_id: str
    t: float
    """when it was made, mission time [s]"""

    def __post_init__(self) -> None:
        _check_count("seq", self.seq, least=0)
        if not isinstance(self.robot_id, str):
            raise MessageError(f"robot_id must be a name, got {self.robot_id!r}")
        if isinstance(self.t, bool) or not np.isfinite(self.t):
            raise MessageError(f"t is {self.t} s, must be finite")

    @property
    def crc32(self) -> int:
        """Checksum of the encoded body."""
        return zlib.crc32(_body(self))


@dataclass(frozen=True, eq=False, kw_only=True)
class CommandSequence(Message):
    """Commands to run one after the other. One sequence runs at a time; later ones wait for it in a queue of eight."""

    topic: ClassVar[str] = "/uplink/command_sequence"
    sequence_id: int
    """names the sequence in receipts and faults"""
    commands: tuple[Command, ...]
    max_torque_fraction: float = 1.0
    """the executive stops with a fault when a measured joint torque exceeds this fraction of its limit"""
    max_tilt: float = 0.35
    """and when the chassis tilts by more [rad]"""
    max_swing_force: float | None = None
    """and when a wheel that moves through the air feels more, by its leg's torques; None: the executive's own limit [N]"""

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_count("sequence_id", self.sequence_id, least=0)
        object.__setattr__(self, "commands", tuple(self.commands))
        for number, command in enumerate(self.commands):
            if not isinstance(command, Command):
                raise CommandError(f"commands[{number}] is a {type(command).__name__}, no command")
        for name, most in (("max_torque_fraction", 10.0), ("max_tilt", np.pi)):
            value = getattr(self, name)
            if not (np.isfinite(value) and 0.0 < value <= most):
                raise CommandError(f"{name} is {value}, must be above 0 and at most {most:g}")
        if self.max_swing_force is not None and not (np.isfinite(self.max_swing_force) and self.max_swing_force > 0.0):
            raise CommandError(f"max_swing_force {self.max_swing_force} N must be positive and finite, or None")


@dataclass(frozen=True, eq=False, kw_only=True)
class Stop(Message):
    """Stop all motion at once and forget the queue."""

    topic: ClassVar[str] = "/uplink/stop"
    reason: str = ""


@dataclass(frozen=True, eq=False, kw_only=True)
class Telemetry(Message):
    """What the robot measures of itself. No position, no contact flag, no wheel force: the ground infers them."""

    topic: ClassVar[str] = "/downlink/telemetry"
    joints: Joints
    """after the wind-up, absolute encoders, shape (6, dof) [rad]"""
    motors: Joints
    """before the wind-up, relative encoders [rad]"""
    torques: Joints
    """from the difference of the two; positive drives the joint towards positive angles [N m]"""
    attitude_rpy: Vec3
    """roll, pitch, yaw of the chassis; yaw is integrated from the start and drifts [rad]"""
    rates: Vec3
    """angular velocity in hex [rad/s]"""
    acceleration: Vec3
    """specific force in hex, about (0, 0, 9.81) at rest [m/s2]"""
    executive_state: str
    """"idle", "executing", "stopped" or "fault" """
    sequence_id: int
    """of the sequence in execution or last executed, -1 before the first"""
    command_index: int
    """of the command in execution, or the number of commands done"""


@dataclass(frozen=True, eq=False, kw_only=True)
class StereoPair(Message):
    """Two rectified images of one stereo camera, and the robot's state when they were taken."""

    topic: ClassVar[str] = "/downlink/stereo_pair"
    camera: str
    binning: int
    left: RawImage
    """grey, shape (h, w), linear in the light; 8 bits in uint8, 12 in uint16"""
    right: RawImage
    exposure: float
    """[s]"""
    state: Telemetry
    bits: int = 8
    """of a grey value: 8 or 12"""
    bracket: int = 0
    """which exposure of the request's bracket; all of one bracket have the same `t`"""

    @property
    def white(self) -> int:
        """Grey value of a saturated pixel."""
        return int(2**self.bits - 1)


@dataclass(frozen=True, eq=False, kw_only=True)
class Receipt(Message):
    """What became of a command."""

    topic: ClassVar[str] = "/downlink/receipt"
    sequence_id: int
    command_index: int
    """-1 for the sequence as a whole"""
    status: str
    """"queued", "executing", "completed", "failed", "cancelled" or "refused" """
    text: str = ""
    cause: str = ""
    """of a refusal, one of `REFUSALS`; a repeated command's receipt says nothing of the one that was taken"""


@dataclass(frozen=True, eq=False, kw_only=True)
class Fault(Message):
    """Why the executive stopped a sequence, or what it noticed outside one."""

    topic: ClassVar[str] = "/downlink/fault"
    code: str
    """"torque_limit", "tilt", "swing_contact", "no_contact", "contact_not_broken", "unreachable", "bad_command", "brown_out" or
    "ratchet_slip", after which the torques of the joint that the text names are not to be believed"""
    text: str
    sequence_id: int
    command_index: int
    leg: int
    """index 0 to 5, -1 when no leg is concerned"""


_KINDS: dict[str, type[Message]] = {c.topic: c for c in (CommandSequence, Stop, Telemetry, StereoPair, Receipt, Fault)}
_COMPACT = json.JSONEncoder(separators=(",", ":"))
_COMMANDS: dict[str, type] = {c.kind: c for c in (JointMove, LegMove, BodyMove, Drive, ImageRequest, Wait)}
_NAMES: dict[type, tuple[str, ...]] = {
    c: tuple(f.name for f in fields(c)) for c in (*_KINDS.values(), *_COMMANDS.values())
}
"""of the fields of each"""


def encode(message: Message) -> bytes:
    """The message as bytes: a line of JSON (with topic and crc32), then the images, losslessly compressed (PNG)."""
    body = _body(message)
    head = f'{{"topic":"{message.topic}","crc32":{zlib.crc32(body)},"length":{len(body)}}}\n'
    return head.encode() + body


def decode(raw: bytes) -> Message:
    """The message from its bytes; raises `MessageError` when they are damaged."""
    try:
        head_bytes, body = raw.split(b"\n", 1)
        head = json.loads(head_bytes)
        kind = _KINDS[head["topic"]]
        if len(body) != head["length"] or zlib.crc32(body) != head["crc32"]:
            raise MessageError(f"checksum of a {head['topic']} message does not match its {len(body)} bytes")
        text, blobs = _split_body(body)
        return kind(**{k: _from_plain(v, blobs) for k, v in json.loads(text).items()})
    except MessageError:
        raise
    except (AthleteError, ValueError, LookupError, TypeError, AttributeError, OverflowError, RecursionError, cv2.error) as e:
        raise MessageError(f"{len(raw)} bytes are not a message: {' '.join(str(e).split())}") from e


def plain(message: Message) -> dict[str, Any]:
    """The message as JSON-ready content, for a log: images become their sizes."""
    out = {name: _to_plain(getattr(message, name), None) for name in _NAMES[type(message)]}
    out["crc32"] = message.crc32
    return out


def _body(message: Message) -> bytes:
    blobs: list[bytes] = []
    content = {name: _to_plain(getattr(message, name), blobs) for name in _NAMES[type(message)]}
    text = _COMPACT.encode(content).encode()
    parts = [len(text).to_bytes(4, "big"), text]
    for blob in blobs:
        parts += [len(blob).to_bytes(4, "big"), blob]
    return b"".join(parts)


def _split_body(body: bytes) -> tuple[bytes, list[bytes]]:
    parts, at = [], 0
    while at < len(body):
        size = int.from_bytes(body[at : at + 4], "big")
        parts.append(body[at + 4 : at + 4 + size])
        at += 4 + size
    return parts[0], parts[1:]


def _to_plain(value: Any, blobs: list[bytes] | None) -> Any:
    if type(value) in (str, int, float):
        return value
    if isinstance(value, np.ndarray):
        if value.dtype in (np.uint8, np.uint16) and value.ndim == 2:
            if blobs is None:
                return {"image_size": list(value.shape)}
            ok, png = cv2.imencode(".png", value, [cv2.IMWRITE_PNG_COMPRESSION, 4])
            if not ok:
                raise MessageError(f"an image of shape {value.shape} cannot be compressed")
            blobs.append(png.tobytes())
            return {"png": len(blobs) - 1}
        return {"array": value.tolist()}
    if isinstance(value, Message):
        return {"message": value.topic, "fields": {n: _to_plain(getattr(value, n), blobs) for n in _NAMES[type(value)]}}
    if isinstance(value, tuple) and value and isinstance(value[0], Command):
        commands = [{n: _to_plain(getattr(c, n), blobs) for n in _NAMES[type(c)]} | {"kind": c.kind} for c in value]
        return {"commands": commands}
    if isinstance(value, tuple):
        return {"tuple": list(value)}
    if isinstance(value, np.generic):
        return value.item()
    return value


def _from_plain(value: Any, blobs: list[bytes]) -> Any:
    if not isinstance(value, dict):
        return value
    if "png" in value:
        return cv2.imdecode(np.frombuffer(blobs[value["png"]], dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    if "array" in value:
        return np.array(value["array"], dtype=float)
    if "message" in value:
        return _KINDS[value["message"]](**{k: _from_plain(v, blobs) for k, v in value["fields"].items()})
    if "commands" in value:
        return tuple(
            _COMMANDS[c["kind"]](**{k: _from_plain(v, blobs) for k, v in c.items() if k != "kind"})
            for c in value["commands"]
        )
    if "tuple" in value:
        return tuple(value["tuple"])
    return value


def _same(one: Any, other: Any) -> bool:
    if isinstance(one, np.ndarray):
        return isinstance(other, np.ndarray) and one.dtype == other.dtype and np.array_equal(one, other)
    if isinstance(one, tuple):
        return isinstance(other, tuple) and len(one) == len(other) and all(map(_same, one, other))
    return bool(one == other)


def _near(values: np.ndarray) -> bool:
    return bool((np.abs(values) <= FARTHEST).all())


def _check_leg(leg: int) -> None:
    if isinstance(leg, bool) or not isinstance(leg, int | np.integer) or not 0 <= leg < 6:
        raise CommandError(f"leg index {leg!r} is not a whole number from 0 to 5")


def _check_count(name: str, value: int, *, least: int) -> None:
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
        raise MessageError(f"{name} is {value!r}, must be a whole number from {least} on")


def _check_speed_scale(value: float) -> None:
    if not (np.isfinite(value) and LEAST_SPEED_SCALE <= value <= 1.0):
        raise CommandError(f"speed_scale is {value}, must be in [{LEAST_SPEED_SCALE}, 1]")
