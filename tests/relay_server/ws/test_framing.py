"""Framing by clients, as in sections 1 to 5 of the Autobahn testsuite's cases; 6 (UTF-8) and 7 (close) are in
test_websocket.py. A message is passed to the session in place of an echo.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import pytest
from websockets.utils import apply_mask

from relay_server.common import close_codes
from tests.worlds.websocket_client import Client, MemoryGate

CONT, TEXT, BINARY, CLOSE, PING, PONG = 0x0, 0x1, 0x2, 0x8, 0x9, 0xA
FIN = 0x80
PROTOCOL_ERROR = 1002
MASK = b"\x37\xfa\x21\x3d"
HELLO = b"Hello, world!"
DIVISIONS = {"whole": 0, "997 octets at a time": 997, "an octet at a time": 1}


def frame(opcode: int, payload: bytes = b"", *, fin: bool = True, reserved: int = 0) -> bytes:
    """A masked frame (RFC 6455 section 5.2), also one that is not allowed.

    :param reserved: the three reserved bits, from 0 to 7
    """
    first = (FIN if fin else 0) | reserved << 4 | opcode
    if len(payload) < 126:
        length = bytes([0x80 | len(payload)])
    elif len(payload) < 65536:
        length = bytes([0x80 | 126]) + len(payload).to_bytes(2, "big")
    else:
        length = bytes([0x80 | 127]) + len(payload).to_bytes(8, "big")
    return bytes([first]) + length + MASK + apply_mask(payload, MASK)


class Case(NamedTuple):
    """What a client sends, and what comes of it.

    :param messages: those the session gets before any end
    :param pongs: their payloads
    :param closed: the relay's close code; ``None``: the connection stays
    """

    sent: Sequence[bytes]
    messages: Sequence[bytes] = ()
    pongs: Sequence[bytes] = ()
    closed: int | None = None


def start(payload: bytes = b"") -> bytes:
    """The first frame of a fragmented text."""
    return frame(TEXT, payload, fin=False)


def more(payload: bytes = b"") -> bytes:
    """A frame of it that is neither the first nor the last."""
    return frame(CONT, payload, fin=False)


def last(payload: bytes = b"") -> bytes:
    """The last frame of it."""
    return frame(CONT, payload)


SIZES = (0, 1, 125, 126, 127, 128, 4096, 4097, 65_535, 65_536, 65_537, 300_000)
BYTES = bytes(range(256))[:125]

WHOLE = {f"1.1: a text of {size}": Case([frame(TEXT, b"*" * size)], [b"*" * size]) for size in SIZES}

BINARIES = {
    f"1.2: {size} bytes, which are no rosbridge": Case(
        [frame(BINARY, b"*" * size)], closed=close_codes.FORBIDDEN
    )
    for size in (0, 125, 126, 65_536)
}

CONTROL = {
    "2.1: a ping without a payload": Case([frame(PING)], pongs=[b""]),
    "2.2: a ping with a payload": Case([frame(PING, HELLO)], pongs=[HELLO]),
    "2.3: a ping with any octets": Case(
        [frame(PING, b"\x00\xff\xfe\xfd\xfc\xfb\x00\xff")], pongs=[b"\x00\xff\xfe\xfd\xfc\xfb\x00\xff"]
    ),
    "2.4: a ping of 125": Case([frame(PING, BYTES)], pongs=[BYTES]),
    "2.5: a ping of 126": Case([frame(PING, b"*" * 126)], closed=PROTOCOL_ERROR),
    "2.7: a pong that nobody asked for": Case([frame(PONG)]),
    "2.8: a pong with a payload": Case([frame(PONG, HELLO)]),
    "2.9: a pong, then a ping": Case([frame(PONG, HELLO), frame(PING, b"ping")], pongs=[b"ping"]),
    "2.10: ten pings": Case(
        [frame(PING, b"payload-%d" % each) for each in range(10)],
        pongs=[b"payload-%d" % each for each in range(10)],
    ),
}

RESERVED = {
    f"3.{bits}: reserved bits {bits:03b} of {name}": Case(
        [frame(TEXT, b"before"), frame(opcode, payload, reserved=bits), frame(PING)],
        [b"before"],
        closed=PROTOCOL_ERROR,
    )
    for bits in range(1, 8)
    for name, opcode, payload in (
        ("a text", TEXT, HELLO),
        ("a ping", PING, HELLO),
        ("a pong", PONG, HELLO),
        ("a close", CLOSE, b"\x03\xe8"),
    )
}

OPCODES = {
    f"4: opcode {opcode} {'with' if payload else 'without'} a payload": Case(
        [frame(TEXT, b"before"), frame(opcode, payload), frame(PING)], [b"before"], closed=PROTOCOL_ERROR
    )
    for opcode in (3, 4, 5, 6, 7, 11, 12, 13, 14, 15)
    for payload in (b"", HELLO)
}

FRAGMENTS = {
    "5.1: a ping in fragments": Case([frame(PING, b"a", fin=False), last(b"b")], closed=PROTOCOL_ERROR),
    "5.2: a pong in fragments": Case([frame(PONG, b"a", fin=False), last(b"b")], closed=PROTOCOL_ERROR),
    "5.3: a text in two fragments": Case([start(b"frag"), last(b"ment")], [b"fragment"]),
    "5.6: a ping between fragments": Case(
        [start(b"frag"), frame(PING, HELLO), last(b"ment")], [b"fragment"], [HELLO]
    ),
    "5.7: a pong between fragments": Case([start(b"frag"), frame(PONG, HELLO), last(b"ment")], [b"fragment"]),
    "5.9: a last frame without a first": Case([last(b"x"), frame(TEXT, HELLO)], closed=PROTOCOL_ERROR),
    "5.12: a frame in the middle without a first": Case(
        [more(b"x"), frame(TEXT, HELLO)], closed=PROTOCOL_ERROR
    ),
    "5.15: two fragments, then a last frame without a first": Case(
        [start(b"frag"), last(b"ment"), last(b"x"), frame(TEXT, HELLO)], [b"fragment"], closed=PROTOCOL_ERROR
    ),
    "5.18: a text within a fragmented text": Case(
        [start(b"frag"), frame(TEXT, b"ment")], closed=PROTOCOL_ERROR
    ),
    "5.18: a first frame within a fragmented text": Case(
        [start(b"frag"), start(b"ment")], closed=PROTOCOL_ERROR
    ),
    "5.19: pings between five fragments": Case(
        [
            start(b"1"),
            more(b"2"),
            frame(PING, b"one"),
            more(b"3"),
            more(b"4"),
            frame(PING, b"two"),
            last(b"5"),
        ],
        [b"12345"],
        [b"one", b"two"],
    ),
    "5: empty fragments": Case([start(), more(), last()], [b""]),
    "5: fragments of some size": Case([start(b"*" * 65_536), last(b"*" * 40_000)], [b"*" * 105_536]),
    "5: an empty last frame": Case([start(b"fragment"), more(), last()], [b"fragment"]),
    "5: two fragmented texts": Case([start(b"a"), last(b"b"), start(b"c"), last(b"d")], [b"ab", b"cd"]),
}

LENGTHS = {
    "a ping with a length in two octets": Case(
        [b"\x89\xfe\x00\x05" + MASK + b"12345"], closed=PROTOCOL_ERROR
    ),
    "a text with a length that needs no two octets": Case(
        [b"\x81\xfe\x00\x05" + MASK + b"12345"], closed=PROTOCOL_ERROR
    ),
    "a text with a length that needs no eight": Case(
        [b"\x81\xff" + (5).to_bytes(8, "big") + MASK + b"12345"], closed=PROTOCOL_ERROR
    ),
    "a text with a length above 63 bits": Case(
        [b"\x81\xff\xff" + bytes(7) + MASK + b"12345"], closed=PROTOCOL_ERROR
    ),
    "a text that is not masked": Case([b"\x81\x05Hello" + bytes(14)], closed=PROTOCOL_ERROR),
    "a ping that is not masked": Case([b"\x89\x00" + bytes(14)], closed=PROTOCOL_ERROR),
}

CASES = {**WHOLE, **BINARIES, **CONTROL, **RESERVED, **OPCODES, **FRAGMENTS, **LENGTHS}


@pytest.mark.parametrize("division", DIVISIONS)
@pytest.mark.parametrize("name", CASES)
def test_frames_have_the_effect_that_the_standard_demands(name: str, division: str) -> None:
    """However the network divides them."""
    case = CASES[name]
    gate = MemoryGate()
    client = Client(gate, Authorization="Bearer good")
    octets = b"".join(case.sent)
    step = DIVISIONS[division] or len(octets)
    for place in range(0, len(octets), step):
        client.core.writes.append(octets[place : place + step])
        client.run()
    (session,) = gate.sessions
    assert [each for each in session.got if isinstance(each, bytes)] == list(case.messages)
    assert client.pongs == list(case.pongs)
    assert client.closed == case.closed
    if case.closed is None:
        client.says("still here")
        assert session.got[-1] == b"still here"
    else:
        assert session.got[-1] == "end"
