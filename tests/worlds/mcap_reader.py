"""Files read by MCAP's own library, and messages to write."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from mcap_ros2._dynamic import generate_dynamic
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from relay_server.recordings.mcap_file import McapChannel

CHATTER = McapChannel("/chatter", "std_msgs/msg/String", "cdr", "string data\n")
WORDS = McapChannel("/words", "std_msgs/msg/String", "json")


class Read(NamedTuple):
    """One message."""

    topic: str
    type: str
    encoding: str
    schema: bytes
    log_time: int
    publish_time: int
    body: bytes


def read(path: Path) -> list[Read]:
    """All messages of a complete file, with verified checksums and summary."""
    with path.open("rb") as stream:
        list(StreamReader(stream, validate_crcs=True).records)
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        found = []
        for schema, channel, message in reader.iter_messages():
            assert schema is not None
            times = (message.log_time, message.publish_time)
            assert channel.message_encoding == {"ros2msg": "cdr", "jsonschema": "json"}[schema.encoding]
            found.append(Read(channel.topic, schema.name, schema.encoding, schema.data, *times, message.data))
        assert summary.statistics.message_count == len(found)
        return found


_ANY = "any_msgs/msg/Any"
"""A name for any type: other readers refuse some names of services' and actions' messages, whatever the schema."""


def value_by_rosbags(schema: bytes, body: bytes) -> Any:
    """A message as rosbags decodes it by its schema."""
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(schema.decode(), _ANY))
    return store.deserialize_cdr(body, _ANY)


def value_by_mcap_ros2(schema: bytes, body: bytes) -> Any:
    """A message as mcap-ros2-support decodes it by its schema."""
    return generate_dynamic(_ANY, schema.decode())[_ANY](body)


def profile(path: Path) -> str:
    """The profile in the file's header."""
    with path.open("rb") as stream:
        return str(make_reader(stream).get_header().profile)
