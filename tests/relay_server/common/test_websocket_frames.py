"""Websocket frames, as Autobahn and websockets read them."""

from __future__ import annotations

import itertools

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from websockets.frames import Frame, Opcode
from websockets.protocol import CLIENT, OPEN, Protocol

from relay_server.common import websocket_frames


@pytest.mark.parametrize("length", [0, 1, 125, 126, 127, 65535, 65536, 70000])
def test_a_message_is_read_back_whole(length: int) -> None:
    """At and around every length at which the header changes its form (RFC 6455 section 5.2)."""
    payload = bytes(index % 128 for index in range(length))
    reader = Protocol(CLIENT, state=OPEN, max_size=None)
    reader.receive_data(websocket_frames.text(payload) + websocket_frames.binary(payload))
    read = [(frame.opcode, bytes(frame.data), frame.fin) for frame in reader.events_received()]
    assert read == [(Opcode.TEXT, payload, True), (Opcode.BINARY, payload, True)]


@pytest.mark.parametrize("length", [0, 123, 124, 125, 126, 65532, 65533, 70000])
def test_pieces_make_the_same_frame_as_the_whole(length: int) -> None:
    """At and around every length at which the header changes its form."""
    body = b"x" * length
    assert websocket_frames.text_of(b"a", body, b"c") == websocket_frames.text(b"a" + body + b"c")


def test_a_ping_is_read_back() -> None:
    """Its payload is kept."""
    reader = Protocol(CLIENT, state=OPEN, max_size=None)
    reader.receive_data(websocket_frames.ping(b"12345678"))
    read = [(frame.opcode, bytes(frame.data)) for frame in reader.events_received()]
    assert read == [(Opcode.PING, b"12345678")]


@given(
    st.lists(st.binary(max_size=70_000), min_size=1, max_size=3), st.lists(st.integers(1, 30_000), min_size=1)
)
@settings(deadline=None, max_examples=50)
def test_messages_in_pieces_are_the_same_messages(payloads: list[bytes], sizes: list[int]) -> None:
    """For any division. A ping may be sent between two pieces (RFC 6455 section 5.4)."""
    pieces = websocket_frames.Fragments(b"".join(map(websocket_frames.binary, payloads)))
    reader = Protocol(CLIENT, state=OPEN, max_size=None)
    for size in itertools.cycle(sizes):
        if not pieces.left:
            break
        reader.receive_data(pieces.take(max(size, 50)))
        reader.receive_data(websocket_frames.ping(b"now"))
    assert reader.parser_exc is None
    joined, part = [], b""
    for frame in reader.events_received():
        assert isinstance(frame, Frame)
        if frame.opcode is Opcode.PING:
            continue
        assert len(frame.data) <= max(*sizes, 50)
        part += frame.data
        if frame.fin:
            joined.append(part)
            part = b""
    assert (joined, part) == (payloads, b"")
