"""Files with a size limit, and the repair of unfinished ones."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from rosbags.interfaces import QosDurability, QosLiveliness, QosReliability
from rosbags.rosbag2.storage_mcap import McapReader

from relay_protocol.ros_types import TypeRegistry
from relay_server.recordings.mcap_file import (
    CHUNKS,
    McapChannel,
    McapFile,
    McapFileFull,
    chunk_bytes,
    repair_file,
)
from tests.worlds.mcap_reader import (
    CHATTER,
    WORDS,
    profile,
    read,
    value_by_mcap_ros2,
    value_by_rosbags,
)
from tests.worlds.relay import text


def write(path: Path, count: int, *, finish: bool = True, track: McapChannel = CHATTER) -> None:
    """Writes this many messages, each in its own chunk."""
    with path.open("wb") as stream:
        file = McapFile(stream, 10**6, track.encoding == "cdr")
        for number in range(count):
            file.add(track, number, number, text(f"{number}"))
            file.flush()
        if finish:
            file.finish()


def test_a_file_holds_what_was_added(tmp_path: Path) -> None:
    """Each channel has its type and definition, and each message both times, in the profile of ROS 2."""
    path = tmp_path / "a.mcap"
    with path.open("wb") as stream:
        file = McapFile(stream, 10**6, ros=True)
        file.add(CHATTER, 5, 3, text("a"))
        file.add(WORDS, 6, 6, b'{"data":"b"}')
        file.add(CHATTER._replace(topic="/other"), 7, 7, text("c"))
        file.finish()
        assert file.size == path.stat().st_size
    first, second, third = read(path)
    assert first == ("/chatter", "std_msgs/msg/String", "ros2msg", b"string data\n", 5, 3, text("a"))
    assert (second.encoding, second.body) == ("jsonschema", b'{"data":"b"}')
    # Foxglove and Lichtblick refuse a schema without properties.
    assert json.loads(second.schema) == {"type": "object", "properties": {}}
    assert third.topic == "/other"
    assert profile(path) == "ros2"


FIBONACCI = "int32 order\n---\nint32[] sequence\n---\nint32[] sequence\n"
SET_BOOL = "bool data\n---\nbool success\nstring message\n"
SPELLED = f"""\
Header header
some_msgs/msg/Point[2] corners # as a robot's author may write it
{"=" * 80}
MSG: some_msgs/msg/Point
float64 x
{"=" * 80}
MSG: std_msgs/msg/Header
builtin_interfaces/msg/Time stamp
string frame_id
"""


@pytest.mark.parametrize(
    ("source", "definition", "name", "message", "value"),
    [
        (
            "some_msgs/action/Fibonacci",
            FIBONACCI,
            "some_msgs/action/Fibonacci_FeedbackMessage",
            b'{"feedback":{"sequence":[3,4]}}',
            lambda found: list(found.feedback.sequence) == [3, 4],
        ),
        (
            "std_srvs/srv/SetBool",
            SET_BOOL,
            "std_srvs/srv/SetBool_Event",
            b'{"info":{"sequence_number":7},"response":[{"message":"on"}]}',
            lambda found: (found.info.sequence_number, found.response[0].message) == (7, "on"),
        ),
        (
            "some_msgs/msg/Square",
            SPELLED,
            "some_msgs/msg/Square",
            b'{"header":{"stamp":{"sec":1,"nanosec":2}},"corners":[{"x":1.5},{"x":2.5}]}',
            lambda found: (found.header.stamp.sec, [each.x for each in found.corners]) == (1, [1.5, 2.5]),
        ),
    ],
    ids=lambda value: value.rpartition("/")[2] if isinstance(value, str) and value.count("/") == 2 else "",
)
def test_other_readers_decode_types_without_a_file_of_their_own(
    tmp_path: Path, source: str, definition: str, name: str, message: bytes, value: Callable[[Any], bool]
) -> None:
    """Their schemas are written as .msg files are: types are ``package/Name``, after a line of ``=`` too."""
    types = TypeRegistry()
    types.add(source, definition)
    body, whole = types.from_json(name, message, 0), types.full_text(name)
    path = tmp_path / "a.mcap"
    with path.open("wb") as stream:
        file = McapFile(stream, 10**6, ros=True)
        file.add(McapChannel("/derived", name, "cdr", whole), 1, 1, body)
        file.finish()
    (written,) = read(path)
    assert written.schema == whole.encode()
    assert not re.search("/(msg|srv|action)/", whole)
    assert value(value_by_rosbags(written.schema, written.body))
    assert value(value_by_mcap_ros2(written.schema, written.body))
    again = TypeRegistry()
    again.add(name, whole)
    assert again.to_json(name, body) == types.to_json(name, body)


def test_a_topic_whose_definition_changes_becomes_another_channel(tmp_path: Path) -> None:
    """Each message keeps the definition that was valid when it arrived."""
    path = tmp_path / "a.mcap"
    with path.open("wb") as stream:
        file = McapFile(stream, 10**6, ros=True)
        file.add(CHATTER, 1, 1, text("a"))
        file.add(CHATTER._replace(definition="string data\nint8 more\n"), 2, 2, text("b"))
        file.finish()
    assert [each.schema for each in read(path)] == [b"string data\n", b"string data\nint8 more\n"]


@pytest.mark.parametrize("broken", [False, True])
def test_latched_topic_is_played_as_latched(tmp_path: Path, broken: bool) -> None:
    """Each channel has its publishers' QoS, as rosbag2 reads it; this includes repaired files."""
    path = tmp_path / "a.mcap"
    with path.open("wb") as stream:
        file = McapFile(stream, 10**6, ros=True)
        for number, track in enumerate((CHATTER, CHATTER._replace(topic="/map", latched=True), CHATTER)):
            file.add(track, number, number, text(f"{number}"))
        file.flush()
        if not broken:
            file.finish()
            assert file.size == path.stat().st_size
    if broken:
        assert repair_file(path, lambda: False) == 3
    assert [each.body for each in read(path)] == [text("0"), text("1"), text("2")]
    reader = McapReader(path)
    reader.open()
    try:
        offered = {each.topic: each.ext.offered_qos_profiles for each in reader.connections}  # type: ignore[union-attr]
    finally:
        reader.close()
    (latched,) = offered["/map"]
    assert (latched.durability, latched.reliability) == (
        QosDurability.TRANSIENT_LOCAL,
        QosReliability.RELIABLE,
    )
    assert (latched.liveliness, latched.lifespan.sec) == (QosLiveliness.AUTOMATIC, 9223372036)
    assert offered["/chatter"] == []
    with path.open("rb") as stream:
        assert [each.name for each in make_reader(stream).iter_metadata()] == ["rosbag2"]


@pytest.mark.parametrize("size", [10, 1000, 100_000])
@pytest.mark.parametrize("flush", [False, True])
def test_a_file_is_never_larger_than_its_limit(tmp_path: Path, size: int, flush: bool) -> None:
    """Neither with incompressible data nor with many chunks; most of the space is used."""
    path, limit = tmp_path / "a.mcap", 1_000_000
    body = os.urandom(size)
    with path.open("wb") as stream:
        file = McapFile(stream, limit, ros=True)
        with pytest.raises(McapFileFull):
            for number in range(100_000):
                track = CHATTER._replace(topic=f"/t{number % 50}", latched=number % 2 == 0)
                file.add(track, number, number, body)
                if flush:
                    file.flush()
        file.finish()
    assert path.stat().st_size <= limit
    assert len(read(path)) == file.messages


@pytest.mark.parametrize("size", [0, 10**9, 10**11])
def test_a_large_file_has_large_chunks(size: int) -> None:
    """The largest file must not have more chunks than fit in memory; each chunk fits as well."""
    assert size / chunk_bytes(size) < CHUNKS + 1
    assert 512 * 1024 <= chunk_bytes(size) < 7 * 10**6


@pytest.mark.parametrize("cut", [1, 9, 40, 200])
def test_whole_chunks_of_a_file_are_kept(tmp_path: Path, cut: int) -> None:
    """For any place where it breaks off."""
    path = tmp_path / "a.mcap"
    write(path, 10, finish=False)
    whole = path.read_bytes()
    path.write_bytes(whole[:-cut])
    kept = repair_file(path, lambda: False)
    bodies = [each.body for each in read(path)]
    assert bodies == [text(f"{number}") for number in range(len(bodies))]
    assert kept == len(bodies) >= 8
    assert profile(path) == "ros2"
    assert list(tmp_path.iterdir()) == [path]


def test_a_whole_file_stays_what_it_is(tmp_path: Path) -> None:
    """Its messages are read once; the relay may have been killed before it stored the end."""
    path = tmp_path / "a.mcap"
    write(path, 3, track=WORDS)
    before = read(path)
    assert repair_file(path, lambda: False) == 3
    assert read(path) == before
    assert profile(path) == ""


@pytest.mark.parametrize("left", [b"", b"\x89MCAP", os.urandom(5000)])
def test_an_unreadable_file_is_replaced_by_an_empty_one(tmp_path: Path, left: bytes) -> None:
    """At least it can be opened."""
    path = tmp_path / "a.mcap"
    path.write_bytes(left)
    assert repair_file(path, lambda: False) == 0
    assert read(path) == []


def test_repair_stops_when_requested(tmp_path: Path) -> None:
    """The file stays as it was."""
    path = tmp_path / "a.mcap"
    write(path, 10, finish=False)
    before = path.read_bytes()
    assert repair_file(path, lambda: True) is None
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]
