"""Speeds are read and replaced in place, in every encoding."""

from __future__ import annotations

import struct

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_client.motion.velocity import STILL, TWIST, TWIST_STAMPED, Velocity, velocity_access

SIX = (1.0, -2.0, 3.0, 0.1, 0.2, -0.3)
VELOCITY = Velocity(SIX[:3], SIX[3:])
ORDERS = {b"\0\0": ">", b"\0\1": "<"}


def twist(head: bytes, six: tuple[float, ...] = SIX) -> bytes:
    return head + b"\0\0" + struct.pack(f"{ORDERS[head]}6d", *six)


def stamped(head: bytes, frame: bytes, six: tuple[float, ...] = SIX) -> bytes:
    order = ORDERS[head]
    body = struct.pack(f"{order}iII", 7, 8, len(frame)) + frame
    body += bytes(-len(body) % 8) + struct.pack(f"{order}6d", *six)
    return head + b"\0\0" + body


@pytest.mark.parametrize("head", list(ORDERS))
def test_speeds_of_a_twist_are_read_and_written(head: bytes) -> None:
    """In both byte orders; nothing else changes."""
    speeds = velocity_access(TWIST, "cdr")
    assert speeds is not None
    assert speeds.read(twist(head)) == VELOCITY
    assert speeds.write(twist(head), VELOCITY.times(2)) == twist(head, tuple(2 * each for each in SIX))


@given(st.sampled_from(list(ORDERS)), st.binary(max_size=40))
def test_speeds_of_a_stamped_twist_are_behind_its_frame(head: bytes, frame: bytes) -> None:
    """However long the name of the frame is."""
    speeds = velocity_access(TWIST_STAMPED, "cdr")
    assert speeds is not None
    assert speeds.read(stamped(head, frame)) == VELOCITY
    assert speeds.write(stamped(head, frame), STILL) == stamped(head, frame, (0.0,) * 6)


@given(st.sampled_from([TWIST, TWIST_STAMPED]), st.binary(max_size=90))
def test_malformed_commands_have_no_speeds(type: str, body: bytes) -> None:
    """Wrong length or encapsulation, or a frame name beyond the end."""
    speeds = velocity_access(type, "cdr")
    assert speeds is not None
    if speeds.read(body) is not None:  # by chance it is one
        assert body[0] == 0
        assert body[1] in (0, 1)
        assert len(body) >= 52


@pytest.mark.parametrize(
    "body", [twist(b"\0\1")[:-1], twist(b"\0\1") + b"\0", b"\0\7" + twist(b"\0\1")[2:], b"", b"\0\1\0\0"]
)
def test_truncated_commands_and_other_cdr_versions_have_no_speeds(body: bytes) -> None:
    """XCDR2 aligns doubles otherwise."""
    speeds = velocity_access(TWIST, "cdr")
    assert speeds is not None
    assert speeds.read(body) is None
    with pytest.raises(ValueError, match="speeds"):
        speeds.write(body, STILL)


def test_speeds_of_json_are_read_and_written() -> None:
    """A missing number is 0; other fields stay."""
    plain, with_header = velocity_access(TWIST, "json"), velocity_access(TWIST_STAMPED, "json")
    assert plain is not None
    assert with_header is not None
    assert plain.read(b'{"linear":{"x":1},"angular":{"z":-0.5}}') == Velocity((1, 0, 0), (0, 0, -0.5))
    assert plain.read(b"{}") == STILL
    body = b'{"header":{"frame_id":"base"},"twist":{"linear":{"x":1}}}'
    assert with_header.read(body) == Velocity((1, 0, 0), (0, 0, 0))
    made = msgspec.json.decode(with_header.write(body, Velocity((0.5, 0, 0), (0, 0, 0))))
    assert made["header"] == {"frame_id": "base"}
    assert made["twist"]["linear"]["x"] == 0.5


@pytest.mark.parametrize(
    "body",
    [
        b"",
        b"[]",
        b"7",
        b'{"linear":7}',
        b'{"linear":{"x":"1"}}',
        b'{"linear":{"x":true}}',
        b'{"linear":null}',
        b'{"linear":{"x":1' + b"0" * 400 + b"}}",
    ],
)
def test_malformed_json_has_no_speeds(body: bytes) -> None:
    speeds = velocity_access(TWIST, "json")
    assert speeds is not None
    assert speeds.read(body) is None


def test_other_types_have_no_speeds() -> None:
    assert velocity_access("sensor_msgs/msg/Joy", "cdr") is None
