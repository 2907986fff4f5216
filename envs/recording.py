"""Reads a trial's MCAP file, whole, cut short by a kill, or damaged.

A file that ends in the middle of a record was cut: everything before is given out. Anything else that is not as it was
written (a checksum, a count, a name) is a `RecordingError` that names the file and the byte. MCAP: a magic, then records of
an opcode, a length of eight bytes and so many bytes, then the magic again.
"""

from __future__ import annotations

import base64
import hashlib
import json
import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Metadata, Statistics
from mcap.records import Message as McapMessage
from mcap.stream_reader import breakup_chunk
from mcap.writer import MCAP0_MAGIC

from athlete_twin.errors import MessageError, RecordingError
from athlete_twin.messages import Message, decode
from envs.schemas import Json, link_line

HEAD = 9
"""opcode and length of a record [byte]"""
LARGEST_CHUNK = 2**30
"""no chunk of ours comes near: a larger size is damage [byte]"""
DAMAGE = (
    McapError, EOFError, ValueError, KeyError, IndexError, TypeError, AttributeError, OverflowError, MemoryError, struct.error,
    zstandard.ZstdError,
)  # fmt: skip
"""what parsing bytes that are not as they were written raises"""


@dataclass(frozen=True, kw_only=True)
class Recorded:
    """One line of a recording."""

    topic: str
    t: float
    """log time, mission [s]"""
    made: float
    """publish time, mission [s]"""
    content: Json
    data: bytes
    """the content as it stands in the file"""


def read_recording(path: Path) -> Iterator[Recorded]:
    """All messages of a recording in the order written; of one that was cut short, those that are whole."""
    channels: dict[int, str] = {}
    counts: dict[int, int] = {}
    for at, record in _records(path):
        if isinstance(record, Channel):
            channels[record.id] = record.topic
        elif isinstance(record, Statistics):
            if record.message_count != sum(counts.values()):
                raise _damaged(path, at, f"it held {record.message_count} messages, {sum(counts.values())} are left")
        elif isinstance(record, McapMessage):
            topic = channels.get(record.channel_id)
            if topic is None:
                raise _damaged(path, at, f"a message of channel {record.channel_id}, which was never described")
            if record.sequence != counts.get(record.channel_id, 0):
                raise _damaged(path, at, f"message {counts.get(record.channel_id, 0)} of {topic} is missing")
            counts[record.channel_id] = record.sequence + 1
            try:
                content = json.loads(record.data)
            except ValueError as e:
                raise _damaged(path, at, f"a message of {topic} is no JSON: {e}") from e
            if not isinstance(content, dict):
                raise _damaged(path, at, f"a message of {topic} is no JSON object")
            yield Recorded(
                topic=topic,
                t=record.log_time * 1e-9,
                made=record.publish_time * 1e-9,
                content=content,
                data=record.data,
            )


def recorded_metadata(path: Path, name: str) -> dict[str, str]:
    """The entries of a recording's metadata of that name; empty when it holds none."""
    out: dict[str, str] = {}
    for _, record in _records(path, opcodes=frozenset({Opcode.METADATA})):
        if isinstance(record, Metadata) and record.name == name:
            out = record.metadata
    return out


def recorded_attachments(path: Path) -> dict[str, bytes]:
    """What is attached to a recording, by its file name."""
    attached = _records(path, opcodes=frozenset({Opcode.ATTACHMENT}))
    return {record.name: record.data for _, record in attached if isinstance(record, Attachment)}


def link_sha256(path: Path) -> str:
    """Hash over all that crossed the link: topic, when it left or arrived, when it was made, content."""
    digest = hashlib.sha256()
    for line in read_recording(path):
        if line.topic.startswith(("/uplink/", "/downlink/")):
            digest.update(link_line(line.topic, line.t, line.made, line.data))
    return digest.hexdigest()


def recorded_downlinks(path: Path) -> list[tuple[float, Message]]:
    """When each downlink arrived [s] and the message itself, checksum verified, in order."""
    out: list[tuple[float, Message]] = []
    pending: tuple[Recorded, list[bytes]] | None = None
    for line in read_recording(path):
        if not line.topic.startswith("/downlink/"):
            continue
        try:
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
        except (MessageError, KeyError, ValueError) as e:
            raise RecordingError(f"{path}: {line.topic} at {line.t:.1f} s is damaged: {e}") from e
    return out


def _joined(line: Recorded, blobs: list[bytes]) -> Message:
    content = dict(line.content)
    crc32 = content.pop("crc32")
    text = json.dumps(content, separators=(",", ":")).encode()
    body = b"".join(len(part).to_bytes(4, "big") + part for part in (text, *blobs))
    head = json.dumps({"topic": line.topic, "crc32": crc32, "length": len(body)}).encode()
    return decode(head + b"\n" + body)


def _records(path: Path, *, opcodes: frozenset[int] | None = None) -> Iterator[tuple[int, Any]]:
    """The records of a file, those in chunks one by one, each with the byte at which it or its chunk begins."""
    try:
        file = path.open("rb")
    except OSError as e:
        raise RecordingError(f"{path}: {'no such recording' if isinstance(e, FileNotFoundError) else e.strerror}") from e
    with file:
        size = os.fstat(file.fileno()).st_size
        if file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
            raise RecordingError(f"{path}: is no MCAP file: its {size} bytes do not begin as one")
        whole = _ends_whole(file, size)
        at = len(MCAP0_MAGIC)
        while True:
            head = file.read(HEAD)
            opcode, length = struct.unpack("<BQ", head) if len(head) == HEAD else (0, 0)
            if len(head) < HEAD or at + HEAD + length > size:
                if whole:
                    raise _damaged(path, at, "a record is longer than the file")
                return
            try:
                known = Opcode(opcode)
            except ValueError as e:
                raise _damaged(path, at, f"no record is of kind {opcode}") from e
            if opcodes is None or opcode in opcodes:
                yield from ((at, record) for record in _parsed(path, at, opcode, file.read(length)))
            else:
                file.seek(length, os.SEEK_CUR)
            if known is Opcode.FOOTER:
                if at + HEAD + length + len(MCAP0_MAGIC) < size:
                    raise _damaged(path, at, "a footer that is not at the end")
                return
            at += HEAD + length


def _parsed(path: Path, at: int, opcode: int, content: bytes) -> list[Any]:
    """Records that one record holds: of a chunk those in it, of what no reader here needs none."""
    stream = ReadDataStream(BytesIO(content))
    try:
        match opcode:
            case Opcode.CHUNK:
                chunk = Chunk.read(stream)
                if chunk.uncompressed_size > LARGEST_CHUNK or _told_size(chunk) != chunk.uncompressed_size:
                    raise _damaged(path, at, f"a chunk says that it holds {chunk.uncompressed_size} bytes")
                return list(breakup_chunk(chunk, validate_crc=True))
            case Opcode.METADATA:
                return [Metadata.read(stream)]
            case Opcode.ATTACHMENT:
                return [Attachment.read(stream)]
            case Opcode.STATISTICS:
                return [Statistics.read(stream)]
    except DAMAGE as e:
        raise _damaged(path, at, f"{type(e).__name__} {e}".strip()) from e
    return []


def _told_size(chunk: Chunk) -> int:
    """What a chunk's data is to be unpacked to, by its own word [byte]."""
    if chunk.compression == "zstd":
        return int(zstandard.frame_content_size(chunk.data))
    return len(chunk.data) if not chunk.compression else chunk.uncompressed_size


def _ends_whole(file: BinaryIO, size: int) -> bool:
    """Whether the file was closed: it ends with the magic, and not just begins with it."""
    here = file.tell()
    file.seek(max(here, size - len(MCAP0_MAGIC)))
    ends = bool(file.read() == MCAP0_MAGIC)
    file.seek(here)
    return ends


def _damaged(path: Path, at: int, why: str) -> RecordingError:
    return RecordingError(f"{path}: damaged at byte {at}: {why}")
