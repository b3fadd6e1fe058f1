"""Frames of websocket messages, as Autobahn and websockets read them."""

from __future__ import annotations

import pytest
from websockets.frames import Opcode
from websockets.protocol import CLIENT, OPEN, Protocol

from relay_server import wsframe


@pytest.mark.parametrize("length", [0, 1, 125, 126, 127, 65535, 65536, 70000])
def test_a_message_is_read_back_whole(length: int) -> None:
    """At and around every length at which the head changes its form (RFC 6455 section 5.2)."""
    payload = bytes(index % 128 for index in range(length))
    reader = Protocol(CLIENT, state=OPEN, max_size=None)
    reader.receive_data(wsframe.text(payload) + wsframe.binary(payload))
    read = [(frame.opcode, bytes(frame.data), frame.fin) for frame in reader.events_received()]
    assert read == [(Opcode.TEXT, payload, True), (Opcode.BINARY, payload, True)]


@pytest.mark.parametrize("length", [0, 123, 124, 125, 126, 65532, 65533, 70000])
def test_pieces_make_the_same_frame_as_the_whole(length: int) -> None:
    """At and around every length at which the head changes its form."""
    body = b"x" * length
    assert wsframe.text_of(b"a", body, b"c") == wsframe.text(b"a" + body + b"c")


def test_a_ping_is_read_back() -> None:
    """With its payload."""
    reader = Protocol(CLIENT, state=OPEN, max_size=None)
    reader.receive_data(wsframe.ping(b"12345678"))
    read = [(frame.opcode, bytes(frame.data)) for frame in reader.events_received()]
    assert read == [(Opcode.PING, b"12345678")]
