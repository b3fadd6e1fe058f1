"""A robot's channel link on a slow connection: order of frames, age of commands, and refused messages."""

from __future__ import annotations

import json
import statistics

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from twisted.internet.address import IPv4Address
from twisted.internet.task import Clock

from relay_protocol import jsontext, limits, link
from relay_protocol.errors import Unavailable
from relay_protocol.frames import CommandFrame, Frame, FrameDecoder, JsonFrame, SampleFrame, encode_json
from relay_server.channels import encodings
from relay_server.common import send_queue
from relay_server.http.limits import ConnectionLimits
from relay_server.robots import connection as module
from relay_server.robots.connection import LinkHandler, LinkTiming, RobotConnection
from relay_server.sessions import service_calls
from tests.worlds.robot_links import Transport

TICK = 0.005


class Line(Transport):
    """A transport with this many bytes per second and an endless queue."""

    def __init__(self, clock: Clock, rate: float) -> None:
        super().__init__(peerAddress=IPv4Address("TCP", "192.168.1.1", 54321))
        self.clock = clock
        self.rate = rate
        self.free_at = 0.0
        self.in_flight: list[tuple[float, bytes]] = []

    def write(self, data: bytes) -> None:
        self.free_at = max(self.free_at, self.clock.seconds()) + len(data) / self.rate
        self.in_flight.append((self.free_at, data))


class Channel(LinkHandler):
    """Both sides of a channel link; the robot answers pings at once."""

    def __init__(self, rate: float, parts: bool = True, heartbeat: float = 1.25) -> None:
        self.clock = Clock()
        self.line = Line(self.clock, rate)
        self.connection = RobotConnection(
            self.clock, self.now, LinkTiming(heartbeat), lambda _: self, ConnectionLimits(3)
        )
        self.line.protocol = self.connection
        self.connection.makeConnection(self.line)
        self.connection.set_handler(self, limits.ROBOT_FRAME)
        self.connection.pace(parts=parts)
        self.decoder = FrameDecoder(limits.RELAY_FRAME)
        self.came: list[tuple[float, Frame]] = []
        self.pinged: list[float] = []
        """How long each ping took to the robot."""
        self.answers = True
        self.ended = ""

    def now(self) -> int:
        """In nanoseconds."""
        return round(self.clock.seconds() * 1e9)

    def message(self, body: bytes) -> None:
        """An answer to a ping."""
        message = jsontext.decode(link.robot_control_decoder, body)
        assert isinstance(message, link.Pong)
        self.connection.common_message(message)

    def sample(self, frame: SampleFrame) -> None:
        """Not used."""

    def lost(self, reason: str) -> None:
        """Stores the reason."""
        self.ended = reason

    def pass_time(self, seconds: float) -> None:
        """Delivers frames as time passes, and answers pings."""
        for _ in range(round(seconds / TICK)):
            self.clock.advance(TICK)
            while self.line.in_flight and self.line.in_flight[0][0] <= self.clock.seconds():
                at, data = self.line.in_flight.pop(0)
                for frame in self.decoder.feed(data):
                    self._arrived(at, frame)

    def _arrived(self, at: float, frame: Frame) -> None:
        if isinstance(frame, JsonFrame) and frame.body.startswith(b'{"op":"ping"'):
            sent = json.loads(frame.body)["t"]
            self.pinged.append(at - sent / 1e9)
            if self.answers:
                pong = encode_json(jsontext.encode(link.Pong(t=sent, at=1)))
                self.connection.dataReceived(pong)
        else:
            self.came.append((at, frame))

    def command(self, number: int = 7, size: int = 80) -> None:
        """Sends a command with the present time."""
        self.connection.message_sender(number, commands=True)(self.now(), 1, bytes(size))

    def call(self, id: int, size: int) -> None:
        """Sends a call with this many bytes of arguments as base64."""
        self.connection.send(link.CallService(id=str(id), service="/map", type="a/srv/B", cdr="x" * size))

    def commands(self) -> list[tuple[float, CommandFrame]]:
        """Commands that arrived, each with its time."""
        return [(at, frame) for at, frame in self.came if isinstance(frame, CommandFrame)]

    def ages(self) -> list[float]:
        """Ages of the arrived commands, in seconds."""
        return [at - frame.stamp / 1e9 for at, frame in self.commands()]

    def calls(self) -> list[int]:
        """Ids of the calls that arrived."""
        return [int(json.loads(frame.body)["id"]) for _, frame in self.came if isinstance(frame, JsonFrame)]


STEPS = st.lists(
    st.one_of(
        st.tuples(st.just("command"), st.integers(7, 8), st.sampled_from([80, 80, 80, 3000])),
        st.tuples(st.just("sample"), st.integers(1, 3), st.sampled_from([100, 5000, 100_000, 300_000])),
        st.tuples(st.just("call"), st.just(0), st.sampled_from([100, 100, 20_000, 500_000])),
        st.tuples(st.just("ping"), st.just(0), st.just(0)),
        st.tuples(st.just("wait"), st.just(0), st.integers(1, 60)),
        st.tuples(st.just("pause"), st.just(0), st.integers(1, 20)),
    ),
    min_size=5,
    max_size=80,
)


@given(rate=st.sampled_from([50_000, 100_000, 300_000, 5_000_000]), parts=st.booleans(), steps=STEPS)
@settings(deadline=None, max_examples=30)
def test_commands_of_a_publication_keep_their_order_and_so_do_messages(
    rate: float, parts: bool, steps: list[tuple[str, int, int]]
) -> None:
    """With any other traffic and any rate; no message is lost, and the newest command arrives."""
    # An undivided frame delays heartbeats too.
    channel = Channel(rate, parts, heartbeat=1.25 if parts else 60.0)
    calls, last = 0, {}
    for what, number, size in steps:
        if what == "command":
            channel.command(number, size)
            last[number] = channel.now()
        elif what == "sample":
            channel.connection.message_sender(number, commands=False)(channel.now(), 0, bytes(size))
        elif what == "call":
            calls += 1
            channel.call(calls, size)
        elif what == "ping":
            channel.connection.round_trip().addErrback(lambda _: None)
        elif what == "pause":
            channel.connection.pause()
            channel.pass_time(size * TICK)
            channel.connection.resume()
        else:
            channel.pass_time(size * TICK)
        channel.pass_time(TICK)
    channel.pass_time(5 + 8_000_000 / rate if rate < 1e6 else 20)
    assert not channel.ended
    for number in (7, 8):
        stamps = [frame.stamp for _, frame in channel.commands() if frame.number == number]
        assert stamps == sorted(stamps)
        assert stamps[-1:] == ([last[number]] if number in last else [])
    assert channel.calls() == list(range(1, calls + 1))


@pytest.mark.parametrize("rate", [50_000, 100_000, 150_000, 300_000])
def test_no_command_overtakes_another_or_waits_long_beside_large_samples(rate: float) -> None:
    """This includes the pauses for measurements; it excludes the first seconds, before the rate is known."""
    channel = Channel(rate)
    for tick in range(600):
        if tick % 2:
            channel.connection.message_sender(3, commands=False)(channel.now(), 0, bytes(100_000))
        channel.command()
        channel.pass_time(0.05)
    stamps = [frame.stamp for _, frame in channel.commands()]
    assert stamps == sorted(stamps)
    assert len(stamps) >= 580
    later = channel.ages()[160:]
    assert max(later) <= 0.3
    assert statistics.median(later) <= 0.2


@pytest.mark.parametrize("rate", [50_000, 300_000])
def test_no_command_waits_long_beside_many_small_samples(rate: float) -> None:
    """There are more samples than the link carries; it is emptied every few seconds for measurements."""
    channel = Channel(rate)
    for _ in range(1500):
        for number in (1, 2, 3):
            channel.connection.message_sender(number, commands=False)(
                channel.now(), 0, bytes(int(rate * 0.02 / 2))
            )
        channel.command()
        channel.pass_time(0.02)
    later = channel.ages()[400:]
    assert len(later) >= 1000
    assert max(later) <= 0.3


def test_commands_and_pings_pass_while_a_large_call_is_sent() -> None:
    """Its transmission takes seven seconds."""
    channel = Channel(300_000)
    for _ in range(40):
        channel.command()
        channel.pass_time(0.05)
    channel.call(1, 2_000_000)
    before = len(channel.commands()), len(channel.pinged)
    while not channel.calls():
        channel.command()
        channel.pass_time(0.05)
    assert channel.clock.seconds() <= 15
    assert len(channel.commands()) - before[0] >= 100
    assert max(channel.ages()) <= 0.3
    assert len(channel.pinged) - before[1] >= 20
    assert max(channel.pinged) <= 0.4


def test_a_call_without_room_is_refused_and_the_channel_continues() -> None:
    """Beside an upload. Accepted calls arrive whole, and other messages have their own limits."""
    channel = Channel(300_000)
    channel.connection.message_sender(3, commands=False)(channel.now(), 0, bytes(1_000_000))
    taken = refused = 0
    for number in range(1, 9):
        try:
            channel.call(number, 2_300_000)
            taken += 1
        except Unavailable as error:
            assert "too slow" in str(error)
            refused += 1
        channel.connection.send(link.Unsubscribe(number=number))
    assert (taken, refused) == (2, 6)
    channel.pass_time(25)
    assert not channel.ended
    ops = [json.loads(frame.body)["op"] for _, frame in channel.came if isinstance(frame, JsonFrame)]
    assert ops.count("call_service") == 2
    assert ops.count("unsubscribe") == 8


def test_small_calls_to_a_robot_that_takes_nothing_do_not_have_it_cut() -> None:
    """Calls over the limit are refused; the robot is disconnected when it answers no ping."""
    channel = Channel(1.0)
    channel.answers = False
    channel.connection.message_sender(3, commands=False)(channel.now(), 0, bytes(100_000))
    refused = 0
    for number in range(3000):
        try:
            channel.call(number, 10)
        except Unavailable:
            refused += 1
    channel.pass_time(3)
    channel.connection.send(link.Unsubscribe(number=1))
    assert refused >= 2000
    assert not channel.ended


def test_bounds_fit_together() -> None:
    """The largest body fits into a message that a robot accepts, and into the queues of the robot and of one
    client.
    """
    envelope = 4096
    assert encodings.LARGEST * 4 // 3 + envelope <= limits.RELAY_JSON_FRAME
    assert limits.RELAY_JSON_FRAME <= module.REQUEST_BYTES
    assert service_calls.CALL_BYTES * 4 // 3 + service_calls.CALLS * envelope <= module.REQUEST_BYTES
    assert limits.CLIENT_MESSAGE <= send_queue.READING_FACTOR * send_queue.CONTROL_BYTES
