"""A connection with slow pings, on a clock: order and pacing of messages."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from twisted.internet.task import Clock

from relay_protocol.pacing import FIRST
from relay_server.common import websocket_frames
from relay_server.common.pacing import STUCK_SECONDS, Pacer
from relay_server.common.send_queue import CONTROL_BYTES, READING_FACTOR, SendQueue
from relay_server.common.socket_writer import PassThroughWriter, Stalls

TICK = 0.005


class Wire:
    """A connection with this many bytes per second in both directions, and the relay's side of it."""

    def __init__(self, rate: float) -> None:
        self.clock = Clock()
        self.rate = rate
        self.free_at = 0.0
        self.in_flight: list[tuple[float, bytes]] = []
        self.came: list[tuple[float, bytes]] = []
        """When each frame was there."""
        self.pings = 0
        self.writer = PassThroughWriter(self)
        self.overflows = 0
        self.outbox = SendQueue(self.writer.write, self.clock.seconds, self.overflow)
        self.pacer = Pacer(
            self.writer,
            self.outbox,
            self.clock,
            self.clock.seconds,
            self.ping,
            websocket_frames.Fragments,
            None,
        )

    def overflow(self) -> None:
        """Counts overflows of answers."""
        self.overflows += 1

    def write(self, data: bytes) -> None:
        """As a transport."""
        self.free_at = max(self.free_at, self.clock.seconds()) + len(data) / self.rate
        self.in_flight.append((self.free_at, data))

    def ping(self) -> None:
        """As a session does."""
        self.pings += 1
        payload = self.pings.to_bytes(8, "big")
        self.pacer.probe_sent(payload)
        self.writer.write_beyond_budget(websocket_frames.ping(payload))

    def pass_time(self, seconds: float) -> None:
        """Delivers bytes as time passes, and answers pings."""
        for _ in range(round(seconds / TICK)):
            self.clock.advance(TICK)
            while self.in_flight and self.in_flight[0][0] <= self.clock.seconds():
                at, data = self.in_flight.pop(0)
                self.came.append((at, data))
                if data[0] == websocket_frames.PING:
                    self.pacer.probe_answered(data[2:])

    def payloads(self) -> list[bytes]:
        """Complete messages that arrived."""
        found, part = [], b""
        for _, frame in self.came:
            if frame[0] == websocket_frames.PING:
                continue
            head = 2 if frame[1] < 126 else 4 if frame[1] == 126 else 10
            part += frame[head:]
            if frame[0] & websocket_frames.FIN:
                found.append(part)
                part = b""
        return found


def test_a_fast_connection_gets_large_messages_whole_after_the_first_ones() -> None:
    """The window opens within some round trips; after that messages are neither lost nor divided."""
    wire = Wire(100e6)
    for number in range(10):
        wire.outbox.send_droppable("cloud", websocket_frames.text(b"%d" % number * 300_000))
        wire.pass_time(0.1)
    assert [len(each) for each in wire.payloads()] == [300_000] * 10
    whole = [frame for _, frame in wire.came if len(frame) > 300_000]
    assert len(whole) >= 5
    assert wire.outbox.dropped == 0


def test_a_ping_goes_between_the_pieces_of_a_large_message() -> None:
    """Its pong arrives long before the message is complete, which takes 10 s here."""
    wire = Wire(100_000)
    wire.ping()
    wire.pass_time(1)
    wire.outbox.send_droppable("cloud", websocket_frames.text(bytes(1_000_000)))
    wire.pass_time(2)
    sent = wire.clock.seconds()
    wire.ping()
    payload = wire.pings.to_bytes(8, "big")
    wire.pass_time(1)
    back = next(at for at, frame in wire.came if frame == websocket_frames.ping(payload))
    assert back - sent <= 0.3
    assert not wire.payloads()
    wire.pass_time(10)
    assert [len(each) for each in wire.payloads()] == [1_000_000]


def test_bytes_in_flight_are_bounded_before_the_first_measurement() -> None:
    """A connection without answers gets at most the first window."""
    wire = Wire(1.0)
    for _ in range(50):
        wire.outbox.send_droppable("cloud", websocket_frames.text(bytes(100_000)))
    assert sum(len(data) for _, data in wire.in_flight) <= 1.1 * FIRST
    assert wire.outbox.dropped > 0


def test_only_control_frames_follow_the_end() -> None:
    """An unfinished message is not continued after a close frame (RFC 6455 section 5.5.1)."""
    wire = Wire(100_000)
    wire.outbox.send_droppable("cloud", websocket_frames.text(bytes(1_000_000)))
    wire.pacer.stop()
    wire.outbox.close()
    before = len(wire.in_flight)
    wire.pass_time(20)
    assert {frame[0] for _, frame in wire.came[before:]} <= {websocket_frames.PING}


@pytest.mark.parametrize("sizes", [[50_000, 2_200_000], 12 * [1_000_000], 5000 * [100]])
def test_a_client_that_takes_bytes_is_not_cut_for_what_comes_at_once(sizes: list[int]) -> None:
    """The window holds bytes that the kernel would have taken, so it does not mean a slow client."""
    wire = Wire(100e6)
    for size in sizes:
        wire.outbox.send_reliable(websocket_frames.text(bytes(size)))
    wire.pass_time(3)
    assert [len(each) for each in wire.payloads()] == sizes
    assert not wire.overflows


def test_queue_for_a_client_is_bounded() -> None:
    """The limit is lower without pongs."""
    for seconds, most in ((0.0, READING_FACTOR * CONTROL_BYTES), (STUCK_SECONDS + 1, CONTROL_BYTES)):
        wire = Wire(1.0)
        wire.outbox.send_reliable(websocket_frames.text(bytes(100_000)))
        wire.pass_time(seconds)
        held = 0
        while not wire.overflows:
            held = wire.outbox.waiting_bytes
            wire.outbox.send_reliable(websocket_frames.text(bytes(100_000)))
        assert most - 200_000 <= held <= most
        assert wire.outbox.waiting_bytes == 0


@given(
    rate=st.sampled_from([30_000, 100_000, 1_000_000, 50_000_000]),
    sizes=st.lists(st.integers(0, 200_000), min_size=1, max_size=12),
    gap=st.sampled_from([0.0, 0.02, 0.3]),
)
@settings(deadline=None, max_examples=60)
def test_answers_of_any_size_arrive_in_order(rate: float, sizes: list[int], gap: float) -> None:
    """No answer is lost, and messages are not mixed."""
    wire = Wire(rate)
    sent = [bytes([65 + number]) * size for number, size in enumerate(sizes)]
    for payload in sent:
        wire.outbox.send_reliable(websocket_frames.text(payload))
        wire.pass_time(gap)
    wire.pass_time(3 + 3 * sum(sizes) / rate)
    assert wire.payloads() == sent
    assert wire.outbox.waiting_bytes == 0


def test_a_clock_that_does_not_run_while_the_reactor_stands_still() -> None:
    """A blocked reactor does not make its own ping late."""
    clock: Any = Clock()
    stalls = Stalls(clock)
    begun = stalls.seconds()
    for _ in range(100):
        clock.advance(0.01)
    assert abs(stalls.seconds() - begun - 1.0) < 0.03
    clock.rightNow += 3.0  # nothing was served meanwhile
    clock.advance(0.0)
    assert abs(stalls.seconds() - begun - 1.0) < 0.06
