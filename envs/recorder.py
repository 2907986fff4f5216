"""One trial as an MCAP file: what was true, what crossed the link, what the ground believed, what the operator saw.

Written as the trial runs. What a method of the recorder took is a chunk of its own and with the operating system when
the method returns: a process killed at any moment leaves a file that holds all it was given, however long its last plan
took. The log time is mission time: for the uplink when it left, for the downlink when it arrived; the publish time of a
downlink is when the robot made it. Messages of the link are kept without loss: `recording.recorded_downlinks` gives back
what the ground saw, in order, so that planning can be repeated without the robot.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, cast

import numpy as np
from mcap.writer import Writer

from athlete_twin.errors import RecordingError
from athlete_twin.geometry.grid import HeightGrid
from athlete_twin.messages import Message
from athlete_twin.model.spec import LEGS, RobotSpec
from athlete_twin.robot import CollisionView, TrackView, TruthView
from envs.schemas import (
    Json,
    compressed_image,
    frame_transform,
    grid_message,
    joint_states,
    link_line,
    nanoseconds,
    point_cloud,
    poses_in_frame,
    schema,
)
from planner.decisions import Decision, Proposal

MAP_REACH = 4.0
"""of the believed map kept with each proposal, about the chassis: T12's foot radius and a step [m]"""


LONGEST_SPAN = 1.0
"""of mission time that is joined into one record [s]"""


class Recorder:
    """Writes one trial's MCAP file."""

    def __init__(self, path: Path, *, metadata: Mapping[str, str] | None = None, spec: RobotSpec | None = None) -> None:
        """Create the file.

        Args:
            path: of the file, written anew.
            metadata: what names the trial, and all that is needed to run it again.
            spec: drawings whose joints the true motion is told by; without them no motion can be recorded.
        """
        self.path = path
        try:
            self._file = path.open("wb")
        except OSError as e:
            raise RecordingError(f"{path}: cannot be written: {e.strerror}; choose a folder you may write to") from e
        self._writer = Writer(self._file)
        self._writer.start(profile="", library="athlete_twin")
        if metadata:
            self._writer.add_metadata("trial", dict(metadata))
        self._names = () if spec is None else joint_names(spec)
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._counts: dict[str, int] = {}
        self._link = hashlib.sha256()
        self._span: tuple[str, float, float] | None = None
        self._open = True
        self._writer.flush()

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
        self._put(topic, content, t, kind=kind, made=made)
        self._writer.flush()

    def attach(self, name: str, data: bytes, *, media_type: str) -> None:
        """Keep a file inside the recording, such as the URDF that viewers draw the robot by."""
        self._writer.add_attachment(create_time=0, log_time=0, name=name, media_type=media_type, data=data)
        self._writer.flush()

    @property
    def link_sha256(self) -> str:
        """Hash over all that crossed the link so far, as `recording.link_sha256` finds it in the file."""
        return self._link.hexdigest()

    def result(self, figures: Mapping[str, str]) -> None:
        """What came of it, for whoever runs it again."""
        self._writer.add_metadata("result", dict(figures))
        self._writer.flush()

    def link(self, message: Message, raw: bytes, t: float) -> None:
        """A message that left upwards or arrived from above at mission time `t` [s], with its encoded bytes."""
        head, content, blobs = _split(raw)
        content["crc32"] = head["crc32"]
        # As it crossed, NaN and all: its checksum is over these very characters.
        self._put(message.topic, content, t, made=message.t, data=json.dumps(content, separators=(",", ":")).encode())
        for side, png in zip(("left", "right"), blobs, strict=False):
            camera = getattr(message, "camera", "camera")
            image = compressed_image(message.t, f"camera_{camera}", png)
            self._put(f"{message.topic}/{side}", image, t, kind="foxglove.CompressedImage", made=message.t)
        self._writer.flush()

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
        self._put("/truth/chassis", transform, point.t, kind="foxglove.FrameTransform")
        # The mock's decks do not twist: it says nothing of them.
        angles = np.concatenate([np.ravel(point.joints), getattr(point, "docks", np.zeros(0))])
        joints = joint_states(point.t, self._names[: len(angles)], angles)
        self._put("/truth/joints", joints, point.t, kind="foxglove.JointStates")
        self._writer.flush()

    def booked(self, bin_: str, begin: float, end: float) -> None:
        """The mission time from `begin` to `end` [s] counts as motion, ground, operator or link.

        Neighbours are joined until they make a second: what is not written a killed recording does not have.
        """
        if end <= begin:
            return
        if self._span is not None and self._span[0] == bin_ and abs(begin - self._span[2]) < 1e-6:
            begin = self._span[1]
        else:
            self._end_span()
        self._span = (bin_, begin, end)
        if end - begin >= LONGEST_SPAN:
            self._end_span()

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
            "together": [{"leg": p.leg, "footfall_in_world": p.footfall_in_world} for p in proposal.together],
            "sequence_id": proposal.sequence.sequence_id,
            "predicted_margin": proposal.predicted_margin,
            "predicted_sag": proposal.predicted_sag,
            "predicted_torque_fraction": proposal.predicted_torque_fraction,
            "predicted_clearance": proposal.predicted_clearance,
            "unknown_share": proposal.unknown_share,
            "text": proposal.text,
            "faults": [asdict(fault) for fault in proposal.preview.faults],
        }
        self._put("/operator/shown", content, t)
        transform = frame_transform(t, "world", "hex_believed", proposal.world_from_hex)
        self._put("/ground/chassis", transform, t, kind="foxglove.FrameTransform")
        poses = poses_in_frame(t, "world", proposal.preview.world_from_hex)
        self._put("/ground/preview", poses, t, kind="foxglove.PosesInFrame")
        preview = proposal.preview
        self._put("/ground/preview_joints", {"index": proposal.index, "times": preview.times, "joints": preview.joints}, t)
        grid, ok = cropped(proposal)
        self._put("/ground/terrain", grid_message(t, grid, {"footfall_ok": ok}), t, kind="foxglove.Grid")
        self._writer.flush()

    def decision(self, proposal: Proposal, decision: Decision, t: float, *, seconds: float) -> None:
        """The operator's answer, given at `t` [s] after `seconds`."""
        content = {
            "proposal": proposal.index,
            "kind": decision.kind,
            "reason": decision.reason,
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

    def seen(self, points_in_world: np.ndarray, t: float, *, made: float) -> None:
        """Points, shape (n, 3) [m], that the ground at `t` [s] believes to have seen in a picture made at `made` [s]."""
        self.write("/ground/points", point_cloud(made, "world", points_in_world), t, kind="foxglove.PointCloud", made=made)

    def _put(
        self, topic: str, content: Json, t: float, *, kind: str = "", made: float | None = None, data: bytes | None = None
    ) -> None:
        """One message into the open chunk, which public methods end; `data` where its bytes are given already."""
        data = _encoded(content) if data is None else data
        made = t if made is None else made
        if topic.startswith(("/uplink/", "/downlink/")):
            self._link.update(link_line(topic, t, made, data))
        count = self._counts.get(topic, 0)
        self._counts[topic] = count + 1
        self._writer.add_message(
            channel_id=self._channel(topic, kind or "athlete_twin" + topic.replace("/", ".")),
            log_time=nanoseconds(t),
            publish_time=nanoseconds(made),
            data=data,
            sequence=count,
        )

    def _channel(self, topic: str, kind: str) -> int:
        if topic not in self._channels:
            if kind not in self._schemas:
                text = json.dumps(schema(kind)).encode()
                self._schemas[kind] = self._writer.register_schema(name=kind, encoding="jsonschema", data=text)
            self._channels[topic] = self._writer.register_channel(
                topic=topic, message_encoding="json", schema_id=self._schemas[kind]
            )
        return self._channels[topic]


def joint_names(spec: RobotSpec) -> tuple[str, ...]:
    """Names of all joints in the order of the track's angles: legs first, then docks, as in the URDF."""
    legs = [f"leg{leg + 1}_{name}" for leg in range(LEGS) for name in spec.joint_names]
    docks = [f"{deck.name.replace('deck', 'dock')}_{turn}" for deck in spec.decks for turn in ("bend", "twist")]
    return (*legs, *docks)


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


def _encoded(content: Json) -> bytes:
    """JSON, which knows no NaN and no infinity: viewers refuse them, null says that there is no figure."""
    try:
        return json.dumps(content, separators=(",", ":"), default=_plain, allow_nan=False).encode()
    except ValueError:
        loose = json.loads(json.dumps(content, default=_plain), parse_constant=lambda _constant: None)
        return json.dumps(loose, separators=(",", ":")).encode()


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"{type(value).__name__} cannot be recorded")
