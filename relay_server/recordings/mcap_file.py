"""MCAP files: writing one up to a size limit, and repairing one that was not finished.

Sources: the MCAP format specification and its registry (mcap.dev/spec), profile ``ros2``; for what ``ros2
bag`` expects of channels, rosbag2_storage (``qos.cpp``) and rosbag2_storage_mcap (``mcap_storage.cpp``).
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

from mcap.records import Channel, Header, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import StreamReader
from mcap.well_known import MessageEncoding, Profile, SchemaEncoding
from mcap.writer import Writer

from relay_protocol.limits import KIB, MIB
from relay_server import VERSION

CHUNK_BYTES = 512 * KIB
"""Messages are compressed together in chunks of this size, or larger ones in a large file."""

CHUNKS = 16 * KIB
"""A file has about this many chunks at most: the index of each stays in memory until the end."""

RECORD_BYTES = 64 * MIB
"""Our records are never larger; a greater length is damage."""

_PER_MESSAGE = 64
"""Most bytes that a message takes beside its body, including the indexes."""

_PER_CHUNK = 256
_PER_CHUNK_AND_TRACK = 32
"""Most bytes that a chunk takes beside its messages, including the summary, and those for each channel in it.
"""

_END = 16 * KIB
"""Bytes of parts that occur once in a file, and of the growth of a chunk that cannot be compressed."""


_FOREVER = "{sec: 9223372036, nsec: 854775807}"

LATCHED = f"""\
- history: 1
  depth: 1
  reliability: 1
  durability: 1
  deadline: {_FOREVER}
  lifespan: {_FOREVER}
  liveliness: 1
  liveliness_lease_duration: {_FOREVER}
  avoid_ros_namespace_conventions: false
"""
"""The offer of a publisher that is reliable and transient local, in the numbers of ``rmw/types.h``.

``ros2 bag play`` must offer the same, otherwise subscribers of a map or a static transform do not get it. All
versions of rosbag2 read numbers; only later ones read names.
"""

ROSBAG2 = "rosbag2"
"""An empty metadata record of this name shows versions that read both that numbers are used."""


class McapChannel(NamedTuple):
    """Properties that all messages of one topic share.

    :param encoding: of the messages, ``cdr`` or ``json``
    :param definition: the text of the type with all types it contains; empty for JSON messages
    :param latched: publishers keep their last messages for late joiners
    """

    topic: str
    type: str
    encoding: str
    definition: str = ""
    latched: bool = False

    @property
    def offered(self) -> str:
        """The publishers' offer as rosbag2 stores it; empty for the default offer."""
        return LATCHED if self.latched else ""


def chunk_bytes(size: int) -> int:
    """Size of the chunks of a file that may have so many bytes."""
    return max(CHUNK_BYTES, size // CHUNKS)


class McapFileFull(Exception):
    """The file has no room for this message; nothing of it was written."""


class McapFile:
    """A file that is being written. It can be read only when it is finished.

    :param stream: an empty file
    :param limit: bytes of the whole file
    :param ros: whether messages are ROS 2 messages
    """

    def __init__(self, stream: BinaryIO, limit: int, ros: bool) -> None:
        self._stream = stream
        self._writer = Writer(stream, chunk_size=chunk_bytes(limit))
        self._limit = limit
        self._written = 0
        self._pending = 0
        self._summary = _END
        self._channels: dict[McapChannel, int] = {}
        self._numbered = False
        self._schemas: dict[tuple[str, str, bytes], int] = {}
        self.messages = 0
        self._writer.start(Profile.ROS2 if ros else "", f"switchboard {VERSION}")

    @property
    def size(self) -> int:
        """Bytes in the file, including those that will be written at the end."""
        return self._written + self._pending

    def add(self, track: McapChannel, log_time: int, publish_time: int, body: bytes) -> None:
        """Add a message.

        :param log_time: nanoseconds
        :param publish_time: nanoseconds
        :raises McapFileFull: it would make the file too large
        :raises OSError: the file cannot be written
        """
        # A new channel is written twice: where it is first used, and in the summary.
        fresh = 0 if track in self._channels else 2 * (len(str(track)) + len(track.offered) + _PER_MESSAGE)
        if self.size + self._summary + fresh + len(body) + _PER_MESSAGE > self._limit:
            raise McapFileFull
        self._summary += fresh
        channel = self._channel(track)
        self._pending += len(body) + _PER_MESSAGE
        self._writer.add_message(channel, log_time, body, publish_time, self.messages)
        self.messages += 1
        self._settle()

    def flush(self) -> None:
        """Hand everything to the operating system, so that it survives a crash of this process."""
        self._writer.flush()
        self._settle()

    def finish(self) -> None:
        """Write indexes and summary, and sync the file to the disk."""
        self._writer.finish()
        self._stream.flush()
        os.fsync(self._stream.fileno())
        self._written, self._pending = self._stream.tell(), 0

    def _settle(self) -> None:
        written = self._stream.tell()
        if written > self._written:
            # A chunk has been written.
            self._written, self._pending = written, 0
            self._summary += _PER_CHUNK + _PER_CHUNK_AND_TRACK * len(self._channels)

    def _channel(self, track: McapChannel) -> int:
        found = self._channels.get(track)
        if found is None:
            cdr = track.encoding == "cdr"
            encoding = SchemaEncoding.ROS2 if cdr else SchemaEncoding.JSONSchema
            text = track.definition.encode() if cdr else b'{"type": "object", "properties": {}}'
            found = self._channels[track] = self._writer.register_channel(
                track.topic,
                MessageEncoding.CDR if cdr else MessageEncoding.JSON,
                self._schema(track.type, encoding, text),
                {"offered_qos_profiles": track.offered} if cdr else {},
            )
            self._say_numbers(track)
        return found

    def _say_numbers(self, track: McapChannel) -> None:
        if track.offered and not self._numbered:
            self._numbered = True
            # Metadata is outside of chunks. The current chunk must be written first, for the sizes to be
            # right.
            self.flush()
            self._writer.add_metadata(ROSBAG2, {})
            self._settle()

    def _schema(self, name: str, encoding: str, text: bytes) -> int:
        key = (name, encoding, text)
        found = self._schemas.get(key)
        if found is None:
            found = self._schemas[key] = self._writer.register_schema(name, encoding, text)
        return found


def repair_file(path: Path, stopping: Callable[[], bool]) -> int | None:
    """Make an unfinished file readable: its intact records are copied to a new file, which replaces it.

    :param stopping: asked again and again; when true, the file is left as it was
    :returns: the number of messages, or ``None`` when it was stopped
    :raises OSError: there is no space, or no such file
    """
    fresh = path.with_suffix(".part")
    try:
        with path.open("rb") as damaged, fresh.open("wb") as stream:
            messages = _copy(damaged, stream, chunk_bytes(path.stat().st_size), stopping)
        if messages is not None:
            fresh.replace(path)
        return messages
    finally:
        fresh.unlink(missing_ok=True)


def _copy(damaged: BinaryIO, stream: BinaryIO, chunk_size: int, stopping: Callable[[], bool]) -> int | None:
    writer = Writer(stream, chunk_size=chunk_size)
    schemas, channels, messages, begun = {0: 0}, dict[int, int](), 0, False
    for record in _whole_records(damaged):
        if stopping():
            return None
        if isinstance(record, Header):
            writer.start(record.profile, f"switchboard {VERSION}")
            begun = True
        elif isinstance(record, Schema) and record.id not in schemas:
            schemas[record.id] = writer.register_schema(record.name, record.encoding, record.data)
        elif isinstance(record, Channel) and record.id not in channels:
            channels[record.id] = writer.register_channel(
                record.topic, record.message_encoding, schemas[record.schema_id], record.metadata
            )
        elif isinstance(record, Metadata):
            writer.add_metadata(record.name, record.metadata)
        elif isinstance(record, Message):
            at, published = record.log_time, record.publish_time
            writer.add_message(channels[record.channel_id], at, record.data, published, record.sequence)
            messages += 1
    if not begun:
        writer.start(Profile.ROS2, f"switchboard {VERSION}")
    writer.finish()
    stream.flush()
    os.fsync(stream.fileno())
    return messages


def _whole_records(stream: BinaryIO) -> Iterator[McapRecord]:
    """The records up to the first damage or the end."""
    records = iter(StreamReader(stream, validate_crcs=True, record_size_limit=RECORD_BYTES).records)
    while True:
        try:
            record = next(records)
        except Exception:
            # Readers and decompressors report damage by many kinds of exceptions.
            return
        yield record
