"""The order of samples on a slow link."""

from __future__ import annotations

import json
import socket
import time
from collections.abc import Iterator
from typing import Any

import pytest
import pytest_twisted
from twisted.internet import reactor
from twisted.internet.endpoints import TCP4ClientEndpoint
from twisted.internet.protocol import Factory
from twisted.internet.task import Clock
from twisted.internet.testing import StringTransport
from twisted.internet.threads import deferToThread

from relay_protocol import link
from relay_protocol.frames import JSON, PART, SAMPLE
from robot_client.channel.sample_queue import WriteScheduler
from robot_client.link.links import ChannelLink, Event, JoinedChannel
from robot_client.link.transport import MAX_WRITE, LinkProtocol
from tests.robot_client.ros import until

PICTURE = 6_000_000
CLOUD = 300_000


class SlowLink:
    """A transport that is full after one write, until a test empties it."""

    def __init__(self) -> None:
        self.clock = Clock()
        self.order: list[tuple[int, int]] = []
        self.sending = WriteScheduler(self, self.clock, lambda call: call(), 2**24)
        self.sending.queue.open(1)
        self.sending.queue.open(2)

    def send(self, message: link.Message) -> None:
        self.order.append((JSON, 0))

    @property
    def room(self) -> int:
        """As much as is written at once."""
        return MAX_WRITE

    def write(self, frames: list[bytes]) -> None:
        self.order += [(each[4], int.from_bytes(each[5:9], "big")) for each in frames]
        self.sending.pause()

    def turn(self) -> None:
        self.clock.advance(0.0)
        self.sending.resume()


@pytest.mark.parametrize("size", [CLOUD, PICTURE])
def test_small_sample_waits_for_one_part_of_a_large_one(size: int) -> None:
    slow = SlowLink()
    slow.sending.enqueue(1, bytes(size))
    slow.turn()
    while slow.sending.queue.ready:
        before = len(slow.order)
        slow.sending.enqueue(2, b"odometry")
        slow.turn()
        assert slow.order[before] == (SAMPLE, 2)
        assert slow.order[before + 1 :].count((PART, 1)) <= 1
    assert slow.order.count((PART, 1)) == -(-size // (32 * 1024))


class Robot:
    """The robot's end of a channel link."""

    def __init__(self) -> None:
        self.joined = False
        self.sending: Any = None

    def on_event(self, event: Event) -> None:
        self.joined = self.joined or isinstance(event, JoinedChannel)

    def on_lost(self, reason: Exception) -> None:
        pass

    def on_pause(self) -> None:
        self.sending.pause()

    def on_resume(self) -> None:
        self.sending.resume()


class Wire:
    """The writer of a scheduler."""

    def __init__(self, protocol: LinkProtocol) -> None:
        self.protocol = protocol

    def send(self, message: link.Message) -> None:
        self.protocol.link.send(message)
        self.protocol.flush()

    @property
    def room(self) -> int:
        """As much as is written at once."""
        return MAX_WRITE

    def write(self, frames: list[bytes]) -> None:
        self.protocol.write(frames)


@pytest.fixture
def listener() -> Iterator[socket.socket]:
    with socket.socket() as made:
        made.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 16 * 1024)
        made.bind(("127.0.0.1", 0))
        made.listen()
        made.settimeout(20)
        yield made


def read(relay: socket.socket) -> list[tuple[int, int]]:
    """Answers pings, and reads kind and number of each frame until a sample is complete; number 1 of JSON
    marks the response.
    """
    got: list[tuple[int, int]] = []
    buffer, finished = b"", False
    while not finished:
        buffer += relay.recv(65536)
        while len(buffer) >= 4 and len(buffer) >= 4 + int.from_bytes(buffer[:4], "big"):
            length = int.from_bytes(buffer[:4], "big")
            frame, buffer = buffer[: 4 + length], buffer[4 + length :]
            if frame[4] == JSON:
                message = json.loads(frame[5:])
                got.append((JSON, int(message["op"] == "failed")))
                if message["op"] == "ping":
                    relay.sendall(link.frame(link.Pong(t=message["t"], at=1)))
                continue
            got.append((frame[4], int.from_bytes(frame[5:9], "big")))
            if frame[4] == PART:
                total, offset = (int.from_bytes(frame[at : at + 4], "big") for at in (17, 21))
                finished = offset + length - 21 == total
    return got


@pytest_twisted.ensureDeferred
async def test_small_message_overtakes_an_image_on_a_real_connection(listener: socket.socket) -> None:
    """On TCP to a relay that reads late, an odometry sample and an answer arrive long before the end of a
    large image.
    """
    robot = Robot()
    port = listener.getsockname()[1]
    factory = Factory.forProtocol(
        lambda: LinkProtocol(ChannelLink("t", time.monotonic_ns, 60), lambda _: robot, reactor)
    )
    factory.noisy = False
    protocol = await TCP4ClientEndpoint(reactor, "127.0.0.1", port).connect(factory)
    relay, _ = listener.accept()
    relay.settimeout(20)
    try:
        wire = Wire(protocol)
        robot.sending = WriteScheduler(wire, reactor, lambda call: call(), 2**24)
        for number in (1, 2):
            robot.sending.queue.open(number)
        relay.sendall(link.frame(link.Joined(channel="c", at=1)))
        await until(lambda: robot.joined)
        robot.sending.enqueue(1, bytes(PICTURE))
        await until(lambda: robot.sending.queue.paused)
        robot.sending.enqueue(2, b"odometry")
        wire.send(link.Failed(request="get_type", reference="x", reason="no such type"))
        got = await deferToThread(read, relay)
    finally:
        protocol.transport.abortConnection()
        relay.close()
    for early in ((SAMPLE, 2), (JSON, 1)):
        assert got[got.index(early) :].count((PART, 1)) > 100


class OpenLink:
    """A channel link on a transport in memory, joined."""

    def __init__(self) -> None:
        self.clock = Clock()
        self.transport = StringTransport()
        owner: Any = Robot()
        channel = ChannelLink("t", lambda: int(self.clock.seconds() * 1e9), 2.0)
        self.protocol = LinkProtocol(channel, lambda _: owner, self.clock)
        self.protocol.makeConnection(self.transport)
        self.says(link.Joined(channel="c", at=1))

    def says(self, message: link.Message) -> None:
        self.protocol.dataReceived(link.frame(message))

    @property
    def ended(self) -> bool:
        return self.transport.disconnecting or self.transport.disconnected


def test_a_process_that_was_stopped_does_not_take_the_relay_for_silent() -> None:
    """It has not read what the relay sent meanwhile. A relay that is silent after that has lost the link."""
    end = OpenLink()
    end.clock.advance(30)
    assert not end.ended
    end.says(link.Ping(t=1))
    end.clock.pump([0.5] * 11)
    assert not end.ended
    end.clock.pump([0.5] * 4)
    assert end.ended
