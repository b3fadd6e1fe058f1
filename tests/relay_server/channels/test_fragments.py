"""Long text messages in fragments."""

from __future__ import annotations

import json

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from relay_protocol import rosbridge
from relay_server.channels import encodings
from relay_server.channels.encodings import MessageEncoding
from tests.worlds.relay import messages_in


def data_of(parts: list[bytes]) -> list[str]:
    """Data of the fragments in order; they must belong to one message."""
    decoded = [json.loads(part) for part in parts]
    assert {each["op"] for each in decoded} == {"fragment"}
    assert len({each["id"] for each in decoded}) == 1
    assert [each["num"] for each in decoded] == list(range(len(parts)))
    assert {each["total"] for each in decoded} == {len(parts)}
    return [each["data"] for each in decoded]


@settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.text(min_size=70), st.integers(64, 200))
def test_fragments_join_to_the_message(text: str, size: int) -> None:
    """Each fragment has at most the requested size."""
    message = json.dumps({"op": "publish", "msg": text}, ensure_ascii=False).encode("utf-8", "replace")
    parts = encodings.fragments_of(message, size)
    if len(message) <= size:
        assert parts == [message]
        return
    data = data_of(parts)
    assert "".join(data).encode() == message
    assert max(len(each.encode()) for each in data) <= size


def test_short_messages_stay_whole() -> None:
    """A message of exactly the fragment size is not divided."""
    message = b'{"op":"status"}'.ljust(100)
    assert encodings.fragments_of(message, 100) == [message]
    assert encodings.fragments_of(message, 0) == [message]
    assert len(encodings.fragments_of(message, 99)) == 2


def test_messages_have_their_own_ids() -> None:
    first, second = (json.loads(encodings.fragments_of(b"x" * 200, 100)[0])["id"] for _ in range(2))
    assert first != second


@pytest.mark.parametrize("letter", ["x", "é", "😀"])
def test_the_number_of_fragments_is_bounded(letter: str) -> None:
    """Fragments of a very long message are larger than requested."""
    message = (letter * 1_500_000).encode()
    parts = encodings.fragments_of(message, 64)
    assert len(parts) <= encodings.MAX_FRAGMENTS
    assert "".join(data_of(parts)).encode() == message


def test_frames_of_fragments_follow_each_other() -> None:
    """All fragments of a message are text frames in one entry of the send queue."""
    message = rosbridge.publish("/chatter", json.dumps({"data": "x" * 300}).encode())
    frames = messages_in(encodings.frames(message, MessageEncoding("none", 100)))
    assert len(frames) == 4
    assert {first for first, _ in frames} == {0x81}
    assert "".join(data_of([payload for _, payload in frames])).encode() == message


def test_a_png_is_divided_too() -> None:
    """The text that carries a PNG is a message like others."""
    message = rosbridge.publish("/chatter", json.dumps({"data": "x" * 300}).encode())
    frames = [payload for _, payload in messages_in(encodings.frames(message, MessageEncoding("png", 64)))]
    assert json.loads("".join(data_of(frames)))["op"] == "png"


def test_binary_messages_are_not_divided() -> None:
    """CBOR is sent whole for any fragment size."""
    message = json.dumps({"values": "x" * 300}).encode()
    assert [first for first, _ in messages_in(encodings.frames(message, MessageEncoding("cbor", 64)))] == [
        0x82
    ]
