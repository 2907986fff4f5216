"""JSON schemas of what a recording holds: Foxglove's well-known ones where they exist, open objects elsewhere.

Foxglove Studio and its kind show the well-known ones without being told how. Every time stamp is mission time.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from typing import Any

import numpy as np

from athlete_twin.errors import RecordingError
from athlete_twin.geometry.grid import HeightGrid
from athlete_twin.geometry.se3 import SE3

Json = dict[str, Any]

_TIME = {"type": "object", "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}}}
_VECTOR = {"type": "object", "properties": {k: {"type": "number"} for k in "xyz"}}
_QUATERNION = {"type": "object", "properties": {k: {"type": "number"} for k in "xyzw"}}
_POSE = {"type": "object", "properties": {"position": _VECTOR, "orientation": _QUATERNION}}
_BYTES = {"type": "string", "contentEncoding": "base64"}
_TEXT = {"type": "string"}
_FIELD = {"type": "object", "properties": {"name": _TEXT, "offset": {"type": "integer"}, "type": {"type": "integer"}}}
_NUMBER = {"type": "number"}
_JOINT = {
    "type": "object",
    "properties": {"name": _TEXT, "position": _NUMBER, "velocity": _NUMBER, "acceleration": _NUMBER, "effort": _NUMBER},
    "required": ["name"],
}

FLOAT32, UINT8 = 7, 1
"""of Foxglove's PackedElementField"""

WELL_KNOWN: dict[str, Json] = {
    "foxglove.FrameTransform": {
        "timestamp": _TIME,
        "parent_frame_id": _TEXT,
        "child_frame_id": _TEXT,
        "translation": _VECTOR,
        "rotation": _QUATERNION,
    },
    "foxglove.PosesInFrame": {"timestamp": _TIME, "frame_id": _TEXT, "poses": {"type": "array", "items": _POSE}},
    "foxglove.CompressedImage": {"timestamp": _TIME, "frame_id": _TEXT, "data": _BYTES, "format": _TEXT},
    "foxglove.JointStates": {"timestamp": _TIME, "joints": {"type": "array", "items": _JOINT}},
    "foxglove.PointCloud": {
        "timestamp": _TIME,
        "frame_id": _TEXT,
        "pose": _POSE,
        "point_stride": {"type": "integer"},
        "fields": {"type": "array", "items": _FIELD},
        "data": _BYTES,
    },
    "foxglove.Grid": {
        "timestamp": _TIME,
        "frame_id": _TEXT,
        "pose": _POSE,
        "column_count": {"type": "integer"},
        "cell_size": {"type": "object", "properties": {k: {"type": "number"} for k in "xy"}},
        "row_stride": {"type": "integer"},
        "cell_stride": {"type": "integer"},
        "fields": {"type": "array", "items": _FIELD},
        "data": _BYTES,
    },
}
"""properties of the well-known schemas in use; all are required"""


def schema(name: str) -> Json:
    """JSON schema by its name: a well-known one, or an object of any content."""
    properties = WELL_KNOWN.get(name, {})
    return {"title": name, "type": "object", "properties": properties, "required": list(properties)}


def stamp(t: float) -> Json:
    """Mission time [s] as seconds and nanoseconds."""
    sec, nsec = divmod(nanoseconds(t), 1_000_000_000)
    return {"sec": sec, "nsec": nsec}


def nanoseconds(t: float) -> int:
    """Mission time [s] in whole nanoseconds."""
    return max(0, round(t * 1e9))


def link_line(topic: str, t: float, made: float, data: bytes) -> bytes:
    """What goes into the hash over a link for one message, with its log and publish times [s]."""
    return f"{topic} {nanoseconds(t)} {nanoseconds(made)} {len(data)}\n".encode() + data


def pose_json(outer_from_inner: SE3) -> Json:
    """A transform as Foxglove's Pose."""
    x, y, z = (float(v) for v in outer_from_inner.translation)
    qx, qy, qz, qw = (float(v) for v in outer_from_inner.quaternion_xyzw())
    return {"position": {"x": x, "y": y, "z": z}, "orientation": {"x": qx, "y": qy, "z": qz, "w": qw}}


def frame_transform(t: float, parent: str, child: str, parent_from_child: SE3) -> Json:
    """foxglove.FrameTransform."""
    pose = pose_json(parent_from_child)
    return {
        "timestamp": stamp(t),
        "parent_frame_id": parent,
        "child_frame_id": child,
        "translation": pose["position"],
        "rotation": pose["orientation"],
    }


def poses_in_frame(t: float, frame: str, frame_from_inner: tuple[SE3, ...]) -> Json:
    """foxglove.PosesInFrame."""
    return {"timestamp": stamp(t), "frame_id": frame, "poses": [pose_json(p) for p in frame_from_inner]}


def compressed_image(t: float, frame: str, png: bytes) -> Json:
    """foxglove.CompressedImage of PNG bytes."""
    return {"timestamp": stamp(t), "frame_id": frame, "data": base64.b64encode(png).decode(), "format": "png"}


def joint_states(t: float, names: Sequence[str], angles: np.ndarray) -> Json:
    """foxglove.JointStates: names as in the URDF, with their angles [rad]."""
    joints = [{"name": name, "position": float(angle)} for name, angle in zip(names, angles, strict=True)]
    return {"timestamp": stamp(t), "joints": joints}


def joint_angles(content: Json) -> dict[str, float]:
    """Angles of a recorded foxglove.JointStates by the joints' names, in their order [rad]."""
    try:
        return {joint["name"]: float(joint["position"]) for joint in content["joints"]}
    except (KeyError, TypeError, ValueError) as e:
        raise RecordingError(f"joint states hold no name and position for each joint: {e}") from e


def point_cloud(t: float, frame: str, points: np.ndarray) -> Json:
    """foxglove.PointCloud of points in a frame, shape (n, 3) [m]."""
    return {
        "timestamp": stamp(t),
        "frame_id": frame,
        "pose": pose_json(SE3.identity()),
        "point_stride": 12,
        "fields": [{"name": axis, "offset": 4 * k, "type": FLOAT32} for k, axis in enumerate("xyz")],
        "data": base64.b64encode(np.asarray(points, dtype="<f4").tobytes()).decode(),
    }


def points_from_message(content: Json) -> np.ndarray:
    """The points of a recorded foxglove.PointCloud, shape (n, 3) [m]."""
    try:
        return np.frombuffer(base64.b64decode(content["data"]), dtype="<f4").reshape(-1, 3).astype(float)
    except (KeyError, TypeError, ValueError) as e:
        raise RecordingError(f"point cloud cannot be read: {e}") from e


def grid_message(t: float, grid: HeightGrid, flags: dict[str, np.ndarray] | None = None) -> Json:
    """foxglove.Grid of heights in world, with further 0-or-1 fields of the grid's shape.

    Foxglove's rows run along y; a cell's pose is its corner, not its centre.
    """
    fields = [{"name": "height", "offset": 0, "type": FLOAT32}]
    columns: list[tuple[Any, ...]] = [("height", "<f4")]
    for k, name in enumerate(flags or {}):
        fields.append({"name": name, "offset": 4 + k, "type": UINT8})
        columns.append((name, "u1"))
    cells = np.zeros(grid.shape[::-1], dtype=columns)
    cells["height"] = grid.heights.T
    for name, values in (flags or {}).items():
        cells[name] = values.T
    corner = np.array([grid.origin_x - 0.5 * grid.cell, grid.origin_y - 0.5 * grid.cell, 0.0])
    return {
        "timestamp": stamp(t),
        "frame_id": "world",
        "pose": pose_json(SE3.from_translation(corner)),
        "column_count": grid.shape[0],
        "cell_size": {"x": grid.cell, "y": grid.cell},
        "row_stride": grid.shape[0] * cells.dtype.itemsize,
        "cell_stride": cells.dtype.itemsize,
        "fields": fields,
        "data": base64.b64encode(cells.tobytes()).decode(),
    }


def grid_from_message(content: Json) -> tuple[HeightGrid, dict[str, np.ndarray]]:
    """The heights and the further fields of a recorded foxglove.Grid."""
    try:
        columns = [(f["name"], "<f4" if f["type"] == FLOAT32 else "u1") for f in content["fields"]]
        cells = np.frombuffer(base64.b64decode(content["data"]), dtype=columns).reshape(-1, content["column_count"])
        cell = float(content["cell_size"]["x"])
        corner = content["pose"]["position"]
        grid = HeightGrid(
            origin_x=corner["x"] + 0.5 * cell,
            origin_y=corner["y"] + 0.5 * cell,
            cell=cell,
            heights=cells["height"].T.astype(float),
        )
    except (KeyError, TypeError, ValueError) as e:
        raise RecordingError(f"grid cannot be read: {e}") from e
    return grid, {name: cells[name].T.copy() for name, _ in columns[1:]}
