"""The fast path of receiving, compared with Autobahn's own."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import pytest
from autobahn.twisted.websocket import WebSocketServerFactory, WebSocketServerProtocol
from hypothesis import example, given, settings
from hypothesis import strategies as st
from twisted.internet.task import Clock
from twisted.internet.testing import StringTransport
from websockets.frames import Frame, Opcode
from websockets.utils import apply_mask as apply_mask_in_python

from relay_server.ws import fast_receive
from relay_server.ws.fast_receive import FastProtocol

LIMIT = 70_000
MESSAGE_LIMIT = 100_000
HANDSHAKE = (
    b"GET / HTTP/1.1\r\nHost: relay\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Key: MDEyMzQ1Njc4OWFiY2RlZg==\r\nSec-WebSocket-Version: 13\r\n\r\n"
)


class Wire(StringTransport):
    """TCP in memory that records how it was closed."""

    aborted = False

    def setTcpNoDelay(self, on: bool) -> None:
        """As TCP."""

    def abortConnection(self) -> None:
        self.aborted = True

    def unregisterProducer(self) -> None:
        """As TCP, which ignores a missing producer."""
        self.producer = None


class SlowClock(Clock):
    """A clock that advances with each reading."""

    step = 0.0

    def seconds(self) -> float:
        """Later each time."""
        self.rightNow += self.step
        return float(super().seconds())


class Recording:
    """Records callbacks, each with the answers sent before it."""

    def onOpen(self) -> None:
        self.events: list[Any] = []
        self.on_message: Callable[[bytes], None] = lambda payload: None

    def _note(self, *event: Any) -> None:
        self.events.append((*event, len(self.transport.value())))

    def onMessage(self, payload: bytes, isBinary: bool) -> None:
        assert type(payload) is bytes
        self._note("message", payload, isBinary)
        self.on_message(payload)

    def onPong(self, payload: bytes) -> None:
        self._note("pong", payload)

    def onClose(self, wasClean: bool, code: int | None, reason: str | None) -> None:
        self._note("close", wasClean, code, reason)


class Plain(Recording, WebSocketServerProtocol):
    """Autobahn without changes."""


class Fast(Recording, FastProtocol):
    """With the fast path."""


def opened(kind: type[Any], clock: Clock | None = None) -> Any:
    """A protocol after its handshake; sent bytes so far are discarded."""
    factory = WebSocketServerFactory(reactor=clock or Clock())
    factory.protocol = kind
    factory.setProtocolOptions(
        utf8validateIncoming=True,
        requireMaskedClientFrames=True,
        failByDrop=False,
        openHandshakeTimeout=0,
        closeHandshakeTimeout=1,
        autoPingInterval=0,
        maxFramePayloadSize=LIMIT,
        maxMessagePayloadSize=MESSAGE_LIMIT,
    )
    end = factory.buildProtocol(None)
    end.makeConnection(Wire())
    end.dataReceived(HANDSHAKE)
    assert end.state == end.STATE_OPEN
    end.transport.clear()
    return end


def outcome(end: Any) -> dict[str, Any]:
    """The observable state of a protocol, with its close state."""
    return {
        "events": end.events,
        "answered": end.transport.value(),
        "state": end.state,
        "closing": (end.transport.disconnecting, end.transport.aborted),
        "remote": (end.remoteCloseCode, end.remoteCloseReason),
        "local": (end.localCloseCode, end.localCloseReason),
        "failed": (end.failedByMe, end.closedByMe, end.droppedByMe, end.wasClean),
    }


def frame(
    payload: bytes = b"", opcode: int = 1, *, fin: bool = True, rsv: int = 0, mask: bytes | None = b"mask",
    announce: int | None = None, width: int | None = None,
) -> bytes:  # fmt: skip
    """A client's frame, valid or not.

    :param announce: another length than that of the payload
    :param width: bytes of the length field (1, 3 or 9)
    """
    length = len(payload) if announce is None else announce
    if width is None:
        width = 1 if length < 126 else 3 if length < 65536 else 9
    coded = {1: lambda: bytes([length & 127]), 3: lambda: b"\x7e" + length.to_bytes(2, "big"),
             9: lambda: b"\x7f" + length.to_bytes(8, "big")}[width]()  # fmt: skip
    head = bytes([(fin << 7) | (rsv << 4) | opcode, coded[0] | (0x80 if mask is not None else 0)]) + coded[1:]
    if mask is None:
        return head + payload
    return head + mask + (apply_mask_in_python(payload, mask) if payload else b"")


LENGTHS = st.sampled_from([0, 1, 7, 8, 9, 13, 14, 15, 100, 124, 125, 126, 127, 128, 300, 65535, 65536, LIMIT])
PAYLOADS = st.builds(
    lambda length, unit: (
        (unit * length).encode()[:length].decode(errors="ignore").ljust(length, "x").encode()[:length]
    ),
    LENGTHS,
    st.sampled_from(["a", "{7", "\xe4b", "\u20ac", "\U0001f916c"]),
)
MASKS = st.binary(min_size=4, max_size=4)
SHORT = st.text(max_size=31).map(str.encode)


def fragmented(parts: list[bytes], between: list[bytes], opcode: int) -> bytes:
    """A fragmented message with control frames in between."""
    frames = [
        frame(part, opcode if number == 0 else 0, fin=number == len(parts) - 1)
        for number, part in enumerate(parts)
    ]
    return b"".join(itertools.chain(*itertools.zip_longest(frames, between[: len(parts) - 1], fillvalue=b"")))


TEXTS = st.builds(lambda payload, mask: frame(payload, mask=mask), PAYLOADS, MASKS)
CONTROLS = st.builds(
    lambda payload, opcode, mask: frame(payload, opcode, mask=mask), SHORT, st.sampled_from([9, 10]), MASKS
)
FRAGMENTED = st.builds(
    fragmented,
    st.lists(SHORT | PAYLOADS, min_size=1, max_size=4),
    st.lists(CONTROLS, max_size=3),
    st.sampled_from([1, 2]),
)
BINARY = st.builds(lambda payload: frame(payload, 2), st.binary(max_size=125))
NOT_UTF8 = st.builds(
    lambda before, bad, after: before + bad + after,
    SHORT | PAYLOADS,
    st.sampled_from(
        [b"\xff", b"\x80", b"\xc0\xaf", b"\xe2\x82", b"\xed\xa0\x80", b"\xf4\x90\x80\x80", b"\xf0\x9f\xa4"]
    ),
    SHORT,
)
"""A stray byte, a continuation alone, an overlong form, characters that are cut, a surrogate, beyond U+10FFFF."""
BAD_TEXT = st.builds(frame, NOT_UTF8) | st.builds(
    lambda before, bad, after, between: fragmented([before, bad, after], between, 1),
    SHORT,
    NOT_UTF8,
    SHORT,
    st.lists(CONTROLS, max_size=2),
)


def close(code: int | None, reason: bytes) -> bytes:
    """A close frame."""
    return frame(b"" if code is None else code.to_bytes(2, "big") + reason, 8)


CLOSES = st.builds(
    close,
    st.sampled_from([None, 999, 1000, 1001, 1005, 3000, 4999, 5000]),
    st.sampled_from([b"", b"bye", b"\xff"]),
)
BITS = {
    "opcode": st.integers(0, 15),
    "fin": st.booleans(),
    "rsv": st.integers(0, 7),
    "mask": st.none() | MASKS,
}
ANNOUNCED = st.sampled_from(
    [0, 1, 125, 126, 65535, 65536, LIMIT + 1, MESSAGE_LIMIT + 1, 2**31, 2**63 - 1, 2**63, 2**64 - 1]
)
ODD = st.builds(
    frame, SHORT | PAYLOADS, announce=st.none() | ANNOUNCED, width=st.just(9), **BITS
) | st.builds(frame, SHORT, width=st.sampled_from([None, 3]), **BITS)
TOO_LONG = st.just(frame(bytes(LIMIT + 1))) | st.just(
    fragmented([bytes(LIMIT // 2)] * 3, [], 1) + frame(b"after")
)
STREAMS = st.lists(
    st.one_of(
        TEXTS,
        TEXTS,
        TEXTS,
        CONTROLS,
        FRAGMENTED,
        BINARY,
        CLOSES,
        ODD,
        TOO_LONG,
        BAD_TEXT,
        st.binary(max_size=20),
    ),
    max_size=8,
).map(b"".join)
CLEAN = st.lists(st.one_of(TEXTS, CONTROLS, FRAGMENTED, BINARY), max_size=8).map(b"".join)
CUTS = st.lists(st.integers(0, 400) | st.integers(0, 200_000), max_size=12)


def chunks(stream: bytes, cuts: list[int]) -> list[bytes]:
    """The stream, cut at these places."""
    places = sorted({0, len(stream), *(cut for cut in cuts if cut < len(stream))})
    return [stream[start:end] for start, end in itertools.pairwise(places)]


def complete(fast: Any, plain: Any) -> None:
    """Sends the rest of a text message in one frame, as the fast path needs it."""
    if fast._unread is not None and plain.failedByMe:
        rest = bytes(fast._bytes_needed - len(fast._unread))
        fast.dataReceived(rest)
        plain.dataReceived(rest)


@given(STREAMS, CUTS, st.booleans())
@settings(deadline=None, max_examples=150)
@example(frame(b"a" * 20) + frame(b"", 8) + frame(b"b" * 20), [], False)
@example(frame(b"a" * 20) + frame(b"b" * 20, mask=None) + frame(b"", 8), [], False)
@example(frame(b"a" * 20)[:-1], [], False)
@example(
    frame(b"a" * 20, fin=False) + frame(b"p", 9) + frame(b"b" * 20, 0) + frame(b"c" * 20), [3, 30], False
)
def test_any_input_has_the_same_effect_as_on_autobahn(stream: bytes, cuts: list[int], time_out: bool) -> None:
    """The same messages, pongs, answers and end, for any division."""
    clock = Clock()
    plain, fast = opened(Plain, clock), opened(Fast, clock)
    for chunk in chunks(stream, cuts):
        plain.dataReceived(chunk)
        fast.dataReceived(chunk)
    complete(fast, plain)
    if time_out:
        clock.advance(5)
    assert outcome(plain) == outcome(fast)


@given(CLEAN, CUTS)
@settings(deadline=None)
def test_cuts_make_no_difference(stream: bytes, cuts: list[int]) -> None:
    """Valid input means the same in one piece and in many."""
    whole, cut = opened(Fast), opened(Fast)
    whole.dataReceived(stream)
    for chunk in chunks(stream, cuts):
        cut.dataReceived(chunk)
    assert [event[:-1] for event in whole.events] == [event[:-1] for event in cut.events]
    assert whole.transport.value() == cut.transport.value()


@given(STREAMS, CUTS, st.floats(0.0001, 0.01))
@settings(deadline=None, max_examples=75)
def test_a_client_whose_time_is_up_goes_on_where_it_was(stream: bytes, cuts: list[int], step: float) -> None:
    """Pauses change neither content nor order."""
    plain, clock = opened(Plain), SlowClock()
    fast = opened(Fast, clock)
    clock.step = step
    for chunk in chunks(stream, cuts):
        plain.dataReceived(chunk)
        fast.dataReceived(chunk)
    clock.step = 0.0
    while fast._reading_paused:
        clock.advance(0)
    assert fast.transport.producerState != "paused" or fast.state == fast.STATE_CLOSED
    complete(fast, plain)
    clock.advance(0)
    # Chunks that arrive during a pause are joined, so only the order of callbacks can be compared, and the
    # end.
    if plain.state == plain.STATE_OPEN:
        assert outcome(plain) == outcome(fast)
    else:
        reported = [event[:-1] for event in plain.events]
        assert [event[:-1] for event in fast.events][: len(reported)] == reported


@pytest.mark.parametrize("byte_by_byte", [False, True])
def test_usual_frames_never_reach_autobahn(monkeypatch: pytest.MonkeyPatch, byte_by_byte: bool) -> None:
    """The fast path reads text messages and pongs, even if the network divides their payload."""
    end = opened(Fast)
    monkeypatch.setattr(end, "processData", lambda: pytest.fail("Autobahn was asked"))
    stream = b"".join(
        frame(b"x" * size, opcode) for size, opcode in [(200, 1), (8, 10), (126, 1), (65536, 1)]
    )
    if byte_by_byte:
        stream = frame(b"x" * 200)
        end.dataReceived(stream[:14])
        for place in range(14, len(stream)):
            end.dataReceived(stream[place : place + 1])
        assert [event[0] for event in end.events] == ["message"]
    else:
        end.dataReceived(stream)
        assert [event[0] for event in end.events] == ["message", "pong", "message", "message"]


@pytest.mark.parametrize("size", [3, 20, 200, 5_000, 65_600])
@pytest.mark.parametrize("bad", [b"\xff", b"\xc0\xaf", b"\xed\xa0\x80", b"\xe2\x82"])
def test_text_that_is_not_utf8_fails_the_connection_with_1007(size: int, bad: bytes) -> None:
    """RFC 6455 section 8.1: even after valid messages in the same chunk; later bytes are ignored."""
    end = opened(Fast)
    end.dataReceived(frame(b"before" * 3) + frame(b"x" * size + bad) + frame(b"after" * 3))
    assert [event[1] for event in end.events] == [b"before" * 3]
    assert end.transport.value()[2:4] == (1007).to_bytes(2, "big")


def test_a_fragmented_text_fails_at_its_first_bad_byte() -> None:
    """Before the end of the fragment and of the message."""
    end = opened(Fast)
    end.dataReceived(frame("\u20ac".encode()[:2], fin=False))
    assert end.state == end.STATE_OPEN
    end.dataReceived(
        frame("\u20ac".encode()[2:] + b"good", 0, fin=False) + frame(b"\xff" + b"x" * 900, 0)[:9]
    )
    assert end.transport.value()[2:4] == (1007).to_bytes(2, "big")


def test_a_pong_dates_just_what_follows_it() -> None:
    """Messages and pongs keep the client's order on both paths."""
    end = opened(Fast)
    end.dataReceived(
        frame(b"before" * 3)
        + frame(b"12345678", 10)
        + frame(b"after" * 3)
        + frame(b"short", 10)
        + frame(b"x")
    )
    assert [event[:2] for event in end.events] == [
        ("message", b"before" * 3), ("pong", b"12345678"), ("message", b"after" * 3), ("pong", b"short"),
        ("message", b"x"),
    ]  # fmt: skip


def test_bytes_after_our_close_go_to_autobahn() -> None:
    """A handler that closes in the middle of a chunk ends the fast path there."""
    outcomes = []
    for kind in (Plain, Fast):
        end = opened(kind)
        end.on_message = lambda payload, end=end: end.sendCloseFrame(4000, b"enough")
        end.dataReceived(frame(b"first" * 4) + frame(b"second" * 4) + frame(b"\x0f\xa0", 8))
        outcomes.append(outcome(end))
    assert outcomes[0] == outcomes[1]
    assert outcomes[0]["state"] == Plain.STATE_CLOSED


def test_a_flood_gives_others_their_turn() -> None:
    """After its time slice a client is not read until the next turn; its own order is kept."""
    clock = SlowClock()
    flooder, other = opened(Fast, clock), opened(Fast, clock)
    clock.step = fast_receive.SHARE_SECONDS / 10
    flooder.dataReceived(b"".join(frame(b"%020d" % number) for number in range(50)))
    assert 0 < len(flooder.events) < 20
    assert flooder.transport.producerState == "paused"
    other.dataReceived(frame(b"x" * 20))
    assert len(other.events) == 1
    while flooder._reading_paused:
        clock.advance(0)
    assert [event[1] for event in flooder.events] == [b"%020d" % number for number in range(50)]
    assert flooder.transport.producerState == "producing"


def test_a_client_whose_receiver_is_full_is_not_read_when_its_turn_comes_again() -> None:
    clock = SlowClock()
    flooder = opened(Fast, clock)
    clock.step = fast_receive.SHARE_SECONDS / 10
    flooder.dataReceived(b"".join(frame(b"%020d" % number) for number in range(50)))
    flooder.pause_reading()
    while flooder._reading_paused:
        clock.advance(0)
    assert flooder.transport.producerState == "paused"
    flooder.resume_reading()
    assert flooder.transport.producerState == "producing"
    flooder.dataReceived(b"".join(frame(b"%020d" % number) for number in range(50)))
    flooder.pause_reading()
    flooder.resume_reading()
    assert flooder.transport.producerState == "paused"


def test_slow_frames_have_the_same_share_of_time() -> None:
    """Fragments and pings count too."""
    clock = SlowClock()
    end = opened(Fast, clock)
    clock.step = fast_receive.SHARE_SECONDS / 10
    end.dataReceived(b"".join(frame(b"a", fin=False) + frame(b"b", 0) for _ in range(100)))
    assert 0 < len(end.events) < 20
    assert end.transport.producerState == "paused"


def test_a_failure_after_a_rest_cuts_the_connection(monkeypatch: pytest.MonkeyPatch) -> None:
    """As Twisted does when a protocol raises; the transport does not stay paused."""
    clock = SlowClock()
    end = opened(Fast, clock)
    clock.step = fast_receive.SHARE_SECONDS
    end.dataReceived(frame(b"x" * 20) * 5)
    failures: list[str] = []
    monkeypatch.setattr(
        end, "relay_log", type("Log", (), {"failure": lambda self, text: failures.append(text)})()
    )

    def broken(payload: bytes) -> None:
        raise RuntimeError("a fault of ours")

    end.on_message = broken
    clock.advance(0)
    assert end.transport.aborted
    assert len(failures) == 1


def test_disconnected_client_is_not_read_after_a_pause() -> None:
    """A closed connection causes no calls."""
    clock = SlowClock()
    end = opened(Fast, clock)
    clock.step = fast_receive.SHARE_SECONDS
    end.dataReceived(frame(b"x" * 20) * 5)
    before = len(end.events)
    end.dropConnection(abort=True)
    clock.advance(0)
    assert len(end.events) == before
    assert not clock.getDelayedCalls()


def test_a_message_that_trickles_in_costs_no_more_than_its_size() -> None:
    """Received bytes of a message are not copied again with each further byte."""
    end = opened(Fast)
    stream = frame(b"x" * LIMIT)
    end.dataReceived(stream[:100])
    buffer = end._unread
    for place in range(100, len(stream) - 1, 100):
        end.dataReceived(stream[place : min(place + 100, len(stream) - 1)])
    assert end._unread is buffer
    end.dataReceived(stream[-1:])
    assert [len(event[1]) for event in end.events] == [LIMIT]
    assert end._unread is None


def test_unmasking_is_done_in_c() -> None:
    """Wheels of the library have the compiled function; Python would be a hundred times slower."""
    assert type(fast_receive.apply_mask).__name__ == "builtin_function_or_method"


@given(st.binary(max_size=300), MASKS)
def test_both_implementations_of_unmasking_agree(payload: bytes, mask: bytes) -> None:
    """The Python version is for platforms without a wheel."""
    assert fast_receive.apply_mask(payload, mask) == (apply_mask_in_python(payload, mask) if payload else b"")
    assert fast_receive.apply_mask(memoryview(payload), mask) == fast_receive.apply_mask(payload, mask)


def test_the_names_are_those_of_the_standard() -> None:
    """First bytes of frames, compared with a library's table."""
    assert fast_receive._TEXT == 0x80 | Opcode.TEXT
    assert fast_receive._PONG == 0x80 | Opcode.PONG
    assert fast_receive._CLOSE == 0x80 | Opcode.CLOSE
    assert frame(b"payload", mask=None) == Frame(Opcode.TEXT, b"payload").serialize(mask=False)
