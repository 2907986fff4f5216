"""One trial as an MCAP file: what was true, what crossed the link, what the ground believed, what the operator saw.

Written as the trial runs, in small chunks: after an interruption or a kill the file is readable up to the last chunk.
The log time is mission time: for the uplink when it left, for the downlink when it arrived; the publish time of a
downlink is when the robot made it. Messages of the link are kept without loss: `recorded_downlinks` gives back what
the ground saw, in order, so that planning can be repeated without the robot.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
from mcap.exceptions import McapError
from mcap.records import Channel
from mcap.records import Message as McapMessage
from mcap.stream_reader import StreamReader
from mcap.writer import Writer

from athlete_twin.errors import RecordingError
from athlete_twin.geometry.grid import HeightGrid
from athlete_twin.messages import Message, decode
from athlete_twin.robot import CollisionView, TrackView, TruthView
from envs.schemas import (
    Json,
    compressed_image,
    frame_transform,
    grid_message,
    nanoseconds,
    poses_in_frame,
    schema,
)
from planner.decisions import Decision, Proposal

CHUNK = 64 * 1024
"""so much is lost at most when the process is killed [byte]"""
MAP_REACH = 4.0
"""of the believed map kept with each proposal, about the chassis: T12's foot radius and a step [m]"""


@dataclass(frozen=True, kw_only=True)
class Recorded:
    """One line of a recording."""

    topic: str
    t: float
    """log time, mission [s]"""
    made: float
    """publish time, mission [s]"""
    content: Json


class Recorder:
    """Writes one trial's MCAP file."""

    def __init__(self, path: Path, *, metadata: Mapping[str, str] | None = None) -> None:
        self.path = path
        try:
            self._file = path.open("wb")
        except OSError as e:
            raise RecordingError(f"{path}: cannot be written: {e.strerror}; choose a folder you may write to") from e
        self._writer = Writer(self._file, chunk_size=CHUNK)
        self._writer.start(profile="", library="athlete_twin")
        if metadata:
            self._writer.add_metadata("trial", dict(metadata))
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._counts: dict[str, int] = {}
        self._span: tuple[str, float, float] | None = None
        self._open = True

    def __enter__(self) -> Recorder:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Write the index; the file is complete afterwards."""
        if self._open:
            self._end_span()
            self._open = False
            self._writer.finish()
            self._file.close()

    def write(self, topic: str, content: Json, t: float, *, kind: str = "", made: float | None = None) -> None:
        """Append one message; `kind` names its schema, the topic's own by default."""
        count = self._counts.get(topic, 0)
        self._counts[topic] = count + 1
        self._writer.add_message(
            channel_id=self._channel(topic, kind or "athlete_twin" + topic.replace("/", ".")),
            log_time=nanoseconds(t),
            publish_time=nanoseconds(t if made is None else made),
            data=json.dumps(content, separators=(",", ":"), default=_plain).encode(),
            sequence=count,
        )

    def link(self, message: Message, raw: bytes, t: float) -> None:
        """A message that left upwards or arrived from above at mission time `t` [s], with its encoded bytes."""
        head, content, blobs = _split(raw)
        content["crc32"] = head["crc32"]
        self.write(message.topic, content, t, made=message.t)
        for side, png in zip(("left", "right"), blobs, strict=False):
            camera = getattr(message, "camera", "camera")
            image = compressed_image(message.t, f"camera_{camera}", png)
            self.write(f"{message.topic}/{side}", image, t, kind="foxglove.CompressedImage", made=message.t)

    def ground_truth(self, grid: HeightGrid) -> None:
        """The true surface, once."""
        self.write("/truth/terrain", grid_message(0.0, grid), 0.0, kind="foxglove.Grid")

    def truth(self, truth: TruthView, figures: Mapping[str, float | None]) -> None:
        """A sample of what is really so, with the margins that follow from it."""
        self.write(
            "/truth/state",
            {
                "t": truth.t,
                "joints": truth.joints,
                "torques": truth.torques,
                "wheel_loads": truth.wheel_loads,
                "wheels_in_world": truth.wheels_in_world,
                "com_in_world": truth.com_in_world,
                "phases": truth.phases,
                "peak_torque_fraction": truth.peak_torque_fraction,
                **figures,
            },
            truth.t,
        )

    def track(self, point: TrackView) -> None:
        """A sample of the true motion."""
        transform = frame_transform(point.t, "world", "hex", point.world_from_hex)
        self.write("/truth/chassis", transform, point.t, kind="foxglove.FrameTransform")
        docks = getattr(point, "docks", np.zeros(0))
        self.write("/truth/joints", {"t": point.t, "joints": point.joints, "docks": docks}, point.t)

    def booked(self, bin_: str, begin: float, end: float) -> None:
        """The mission time from `begin` to `end` [s] counts as motion, ground, operator or link; neighbours are joined."""
        if end <= begin:
            return
        if self._span is not None and self._span[0] == bin_ and abs(begin - self._span[2]) < 1e-6:
            self._span = (bin_, self._span[1], end)
            return
        self._end_span()
        self._span = (bin_, begin, end)

    def _end_span(self) -> None:
        if self._span is not None:
            bin_, begin, end = self._span
            self._span = None
            self.write("/truth/mission_time", {"bin": bin_, "begin": begin, "end": end}, end)

    def collision(self, collision: CollisionView) -> None:
        """A contact episode that should not be."""
        content = {
            "t": collision.t,
            "part": collision.part,
            "other": collision.other,
            "place_in_world": collision.place_in_world,
            "force": collision.force,
        }
        self.write("/truth/collision", content, collision.t)

    def proposal(self, proposal: Proposal, t: float) -> None:
        """What the operator is shown, and what the ground believes then."""
        content = {
            "index": proposal.index,
            "kind": proposal.kind,
            "leg": proposal.leg,
            "footfall_in_world": proposal.footfall_in_world,
            "sequence_id": proposal.sequence.sequence_id,
            "predicted_margin": _number(proposal.predicted_margin),
            "predicted_sag": _number(proposal.predicted_sag),
            "text": proposal.text,
        }
        self.write("/operator/shown", content, t)
        transform = frame_transform(t, "world", "hex_believed", proposal.world_from_hex)
        self.write("/ground/chassis", transform, t, kind="foxglove.FrameTransform")
        poses = poses_in_frame(t, "world", proposal.preview_world_from_hex)
        self.write("/ground/preview", poses, t, kind="foxglove.PosesInFrame")
        self.write("/ground/preview_joints", {"index": proposal.index, "joints": proposal.preview_joints}, t)
        grid, ok = cropped(proposal)
        self.write("/ground/terrain", grid_message(t, grid, {"footfall_ok": ok}), t, kind="foxglove.Grid")

    def decision(self, proposal: Proposal, decision: Decision, t: float, *, seconds: float) -> None:
        """The operator's answer, given at `t` [s] after `seconds`."""
        content = {
            "proposal": proposal.index,
            "kind": decision.kind,
            "footfall_in_world": decision.footfall_in_world,
            "leg": decision.leg,
            "cameras": decision.cameras,
            "duration": decision.duration,
            "seconds": seconds,
        }
        self.write("/operator/decision", content, t)

    def ground_says(self, kind: str, text: str, t: float, **more: Any) -> None:
        """What else the ground did: waited, arrived, found no step."""
        self.write("/ground/action", {"kind": kind, "text": text, **more}, t)

    def _channel(self, topic: str, kind: str) -> int:
        if topic not in self._channels:
            if kind not in self._schemas:
                text = json.dumps(schema(kind)).encode()
                self._schemas[kind] = self._writer.register_schema(name=kind, encoding="jsonschema", data=text)
            self._channels[topic] = self._writer.register_channel(
                topic=topic, message_encoding="json", schema_id=self._schemas[kind]
            )
        return self._channels[topic]


def cropped(proposal: Proposal, reach: float = MAP_REACH) -> tuple[HeightGrid, np.ndarray]:
    """The believed terrain within `reach` [m] of the believed chassis along x and y, and its green cells."""
    grid = proposal.terrain
    centre = proposal.world_from_hex.translation[:2]
    ix, iy, _ = grid.index(np.array([centre - reach, centre + reach]))
    sx, sy = (
        slice(int(min(ix[0], grid.shape[0] - 2)), int(max(ix[1], 1)) + 1),
        slice(int(min(iy[0], grid.shape[1] - 2)), int(max(iy[1], 1)) + 1),
    )
    part = HeightGrid(
        origin_x=grid.origin_x + sx.start * grid.cell,
        origin_y=grid.origin_y + sy.start * grid.cell,
        cell=grid.cell,
        heights=grid.heights[sx, sy].copy(),
    )
    return part, proposal.footfall_ok[sx, sy].copy()


def read_recording(path: Path) -> Iterator[Recorded]:
    """All messages of a recording in the order written; of one that was cut short, those that are whole."""
    channels: dict[int, str] = {}
    try:
        with path.open("rb") as file:
            for record in StreamReader(file).records:
                if isinstance(record, Channel):
                    channels[record.id] = record.topic
                elif isinstance(record, McapMessage):
                    yield Recorded(
                        topic=channels[record.channel_id],
                        t=record.log_time * 1e-9,
                        made=record.publish_time * 1e-9,
                        content=json.loads(record.data),
                    )
    except FileNotFoundError as e:
        raise RecordingError(f"{path}: no such recording") from e
    except (McapError, EOFError):
        # Cut off in the middle of a record: everything before it was given out.
        return


def recorded_downlinks(path: Path) -> list[tuple[float, Message]]:
    """When each downlink arrived [s] and the message itself, checksum verified, in order."""
    out: list[tuple[float, Message]] = []
    pending: tuple[Recorded, list[bytes]] | None = None
    for line in read_recording(path):
        if not line.topic.startswith("/downlink/"):
            continue
        if line.topic.endswith(("/left", "/right")):
            if pending is not None:
                pending[1].append(base64.b64decode(line.content["data"]))
                if len(pending[1]) == 2:
                    out.append((pending[0].t, _joined(pending[0], pending[1])))
                    pending = None
        elif "left" in line.content:
            pending = (line, [])
        else:
            out.append((line.t, _joined(line, [])))
    return out


def _split(raw: bytes) -> tuple[Json, Json, list[bytes]]:
    """Head, content and images of an encoded message."""
    head, body = raw.split(b"\n", 1)
    parts: list[bytes] = []
    at = 0
    while at < len(body):
        size = int.from_bytes(body[at : at + 4], "big")
        parts.append(body[at + 4 : at + 4 + size])
        at += 4 + size
    return cast(Json, json.loads(head)), cast(Json, json.loads(parts[0])), parts[1:]


def _joined(line: Recorded, blobs: list[bytes]) -> Message:
    content = dict(line.content)
    crc32 = content.pop("crc32")
    text = json.dumps(content, separators=(",", ":")).encode()
    body = b"".join(len(part).to_bytes(4, "big") + part for part in (text, *blobs))
    head = json.dumps({"topic": line.topic, "crc32": crc32, "length": len(body)}).encode()
    return decode(head + b"\n" + body)


def _number(value: float) -> float | None:
    """JSON knows no NaN."""
    return value if np.isfinite(value) else None


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"{type(value).__name__} cannot be recorded")
