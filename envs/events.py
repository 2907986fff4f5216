"""A recording as a list of events on one of two clocks: the robot's, or the operator's.

By the robot's clock stands what was true and when: its motion, what it sent at the moment it made it, what reached it at the
moment it did. By the operator's clock stands what was known and when: what had come down, what the ground made of it, what
was shown, decided and sent. Each event keeps both times; between them lies how old the news was.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from athlete_twin.errors import RecordingError
from athlete_twin.geometry.se3 import SE3
from envs.recording import Recorded, read_recording
from envs.schemas import Json, joint_angles

Clock = Literal["robot", "operator"]
NEVER = float("nan")


@dataclass(frozen=True, kw_only=True)
class Event:
    """Something that happened on one side and, for what crossed the link, became known on the other."""

    topic: str
    at_robot: float
    """when it was so, or reached the robot; NaN: never, or on the ground alone [s]"""
    at_operator: float
    """when the ground had it, or sent it; NaN: never, or on the robot alone [s]"""
    text: str
    """one line for people"""
    figures: dict[str, float | str] = field(default_factory=dict)
    """by column of a table; the unit ends the name"""

    def t(self, clock: Clock) -> float:
        """By one of the clocks [s]."""
        return self.at_robot if clock == "robot" else self.at_operator

    @property
    def age(self) -> float:
        """Between the two clocks; NaN for what did not cross the link [s]."""
        return abs(self.at_operator - self.at_robot)


def events(path: Path) -> list[Event]:
    """All events of a recording, in the order written. Pictures, maps and the true ground are left out."""
    lines = [r for r in read_recording(path) if not r.topic.endswith(("/left", "/right")) and r.topic not in SILENT]
    try:
        accepted = _accepted(lines)
        return [_event(line, accepted) for line in lines]
    except (KeyError, TypeError, ValueError, IndexError) as e:
        raise RecordingError(f"{path}: a message is not as this version writes them: {type(e).__name__} {e}") from e


def by_clock(every: list[Event], clock: Clock, *, begin: float = 0.0, end: float = np.inf) -> list[Event]:
    """What has a place on a clock between two mission times [s], in its order."""
    placed = [e for e in every if begin <= e.t(clock) <= end]
    return sorted(placed, key=lambda e: e.t(clock))


SILENT = frozenset({"/truth/terrain", "/ground/terrain", "/ground/points", "/ground/preview", "/ground/preview_joints"})


def _accepted(lines: list[Recorded]) -> dict[tuple[str, int], float]:
    """When uplinks reached the robot: sequences by the first receipt that names them, stops by the telemetry that follows."""
    out: dict[tuple[str, int], float] = {}
    stops = [line for line in lines if line.topic == "/uplink/stop"]
    for line in lines:
        if line.topic == "/downlink/receipt":
            out.setdefault(("sequence", line.content["sequence_id"]), line.made)
        elif line.topic == "/downlink/telemetry" and line.content["executive_state"] == "stopped":
            for stop in stops:
                if line.made >= stop.t:
                    out.setdefault(("stop", stop.content["seq"]), line.made)
    return out


def _event(line: Recorded, accepted: dict[tuple[str, int], float]) -> Event:
    side = line.topic.split("/")[1]
    text, figures = DESCRIBED.get(line.topic, _plain)(line.content)
    robot, operator = (line.made, line.t) if side == "downlink" else (line.t, NEVER) if side == "truth" else (NEVER, line.t)
    if line.topic == "/uplink/command_sequence":
        robot = accepted.get(("sequence", line.content["sequence_id"]), NEVER)
    elif line.topic == "/uplink/stop":
        robot = accepted.get(("stop", line.content["seq"]), NEVER)
    return Event(topic=line.topic, at_robot=robot, at_operator=operator, text=text, figures=figures)


Described = tuple[str, dict[str, float | str]]


def _plain(content: Json) -> Described:
    return str(content.get("text", content.get("kind", content.get("bin", "")))), {}


def _state(content: Json) -> Described:
    names = {
        "support_margin": "support_margin_m", "cps_margin": "cps_margin_m", "tip_over_energy": "tip_over_energy_m",
        "goal_distance": "goal_distance_m", "peak_torque_fraction": "peak_torque_fraction",
    }  # fmt: skip
    figures: dict[str, float | str] = {column: _number(content.get(name)) for name, column in names.items()}
    figures |= {f"load_wheel{k + 1}_n": float(load) for k, load in enumerate(content["wheel_loads"])}
    phases = [f"leg {k + 1} {phase}" for k, phase in enumerate(content["phases"]) if phase != "stance"]
    margin, goal = figures["support_margin_m"], figures["goal_distance_m"]
    return f"margin {margin:.2f} m, {goal:.2f} m to the goal{', ' if phases else ''}{', '.join(phases)}", figures


def _chassis(content: Json) -> Described:
    place, turn = content["translation"], content["rotation"]
    pose = SE3.from_quaternion(np.array([turn[k] for k in "xyzw"]), np.array([place[k] for k in "xyz"]))
    x, y, z = (float(v) for v in pose.translation)
    roll, pitch, yaw = (float(v) for v in pose.rpy())
    figures: dict[str, float | str] = {
        "x_m": x, "y_m": y, "z_m": z, "roll_rad": roll, "pitch_rad": pitch, "yaw_rad": yaw
    }  # fmt: skip
    return f"chassis at ({x:.3f}, {y:.3f}, {z:.3f}) m", figures


def _joints(content: Json) -> Described:
    return "joints", {f"{name}_rad": angle for name, angle in joint_angles(content).items()}


def _telemetry(content: Json) -> Described:
    state, sequence, command = content["executive_state"], content["sequence_id"], content["command_index"]
    figures: dict[str, float | str] = {
        "executive_state": state, "sequence_id": float(sequence), "command_index": float(command)
    }  # fmt: skip
    roll, pitch, yaw = content["attitude_rpy"]["array"]
    return f"{state}, sequence {sequence}, command {command}", figures | {"roll_rad": roll, "pitch_rad": pitch, "yaw_rad": yaw}


def _receipt(content: Json) -> Described:
    which = f"command {content['command_index']} of sequence" if content["command_index"] >= 0 else "sequence"
    said = f": {content['text']}" if content["text"] else ""
    return f"{which} {content['sequence_id']} {content['status']}{said}", {"sequence_id": float(content["sequence_id"])}


def _fault(content: Json) -> Described:
    return f"{content['code']}: {content['text']}", {"sequence_id": float(content["sequence_id"])}


def _pair(content: Json) -> Described:
    return f"pictures of {content['camera']}", {}


def _sequence(content: Json) -> Described:
    commands = ", ".join(c["kind"] for c in content["commands"]["commands"])
    return f"sequence {content['sequence_id']}: {commands}", {"sequence_id": float(content["sequence_id"])}


def _stop(content: Json) -> Described:
    return f"stop: {content['reason']}", {}


def _shown(content: Json) -> Described:
    names = {
        "predicted_margin": "predicted_margin_m", "predicted_sag": "predicted_sag_m",
        "predicted_torque_fraction": "predicted_torque_fraction", "predicted_clearance": "predicted_clearance_m",
        "unknown_share": "unknown_share",
    }  # fmt: skip
    figures: dict[str, float | str] = {column: _number(content[name]) for name, column in names.items()}
    return f"proposal {content['index']}: {content['text']}", figures | {"proposal": float(content["index"])}


def _decision(content: Json) -> Described:
    why = f" ({content['reason']})" if content["reason"] else ""
    figures: dict[str, float | str] = {
        "proposal": float(content["proposal"]), "decision": content["kind"], "decision_s": float(content["seconds"])
    }  # fmt: skip
    return f"proposal {content['proposal']}: {content['kind']}{why} after {content['seconds']:.1f} s", figures


def _booked(content: Json) -> Described:
    return f"{content['end'] - content['begin']:.2f} s of {content['bin']}", {}


def _collision(content: Json) -> Described:
    return f"{content['part']} touches {content['other']}, {content['force']:.0f} N", {}


def _action(content: Json) -> Described:
    what = content["outcome"] if content["kind"] == "outcome" else content["kind"]
    return f"{what}: {content['text']}", {}


def _number(value: Any) -> float:
    return NEVER if value is None else float(value)


DESCRIBED: dict[str, Callable[[Json], Described]] = {
    "/truth/state": _state,
    "/truth/chassis": _chassis,
    "/truth/joints": _joints,
    "/truth/mission_time": _booked,
    "/truth/collision": _collision,
    "/ground/chassis": _chassis,
    "/ground/action": _action,
    "/downlink/telemetry": _telemetry,
    "/downlink/receipt": _receipt,
    "/downlink/fault": _fault,
    "/downlink/stereo_pair": _pair,
    "/uplink/command_sequence": _sequence,
    "/uplink/stop": _stop,
    "/operator/shown": _shown,
    "/operator/decision": _decision,
}
"""what a topic's message says in a line and in figures"""
