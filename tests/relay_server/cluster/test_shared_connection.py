"""Streams of bytes on one connection between two relays."""

from __future__ import annotations

import random
from struct import pack
from typing import Any

import pytest
from twisted.internet.protocol import Protocol
from twisted.internet.task import Clock
from twisted.internet.testing import StringTransport

from relay_server.cluster.shared_connection import (
    ACCEPTED,
    JOINED_BYTES,
    MOST_NUMBERS,
    MOST_UNANSWERED,
    MOST_UNREAD_BYTES,
    PING_SECONDS,
    READ_SECONDS,
    UNREAD_BYTES,
    SharedConnection,
    SharedConnectionRequest,
    StreamTransport,
)
from relay_server.common.socket_writer import FlushScheduler

SINGLE_BYTES = 11
"""Bytes of a frame for one stream, without data."""


class Peer(Protocol):
    """One end of a stream, which notes what comes."""

    transport: Any

    def __init__(self) -> None:
        self.came = b""
        self.lost = 0

    def dataReceived(self, data: bytes) -> None:
        self.came += data

    def connectionLost(self, reason: object = None) -> None:
        self.lost += 1


class Flow:
    """A producer that notes whether it may produce."""

    paused = False

    def pauseProducing(self) -> None:
        self.paused = True

    def resumeProducing(self) -> None:
        self.paused = False


class Pair:
    """The connection of a relay that connects (``door``) and one that accepts (``home``)."""

    def __init__(self) -> None:
        self.clock = Clock()
        self.accepted: list[Peer] = []
        flushes = FlushScheduler(self.clock)
        self.door = SharedConnection(self.clock, flushes)
        self.home = SharedConnection(self.clock, flushes, self._accept)
        self.wires = [StringTransport(), StringTransport()]
        for end, wire in zip((self.door, self.home), self.wires, strict=True):
            end.makeConnection(wire)
        self.bytes_down = 0

    def _accept(self, address: object) -> Peer:
        peer = Peer()
        self.accepted.append(peer)
        return peer

    def opened(self) -> tuple[Peer, Peer]:
        """Both ends of a new stream."""
        mine = Peer()
        self.door.open(mine)
        self.moves()
        return mine, self.accepted[-1]

    def moves(self, pieces: random.Random | None = None) -> None:
        """Let bytes pass until nothing more is under way."""
        while True:
            self.clock.advance(0)
            up, down = (wire.value() for wire in self.wires)
            if not up and not down:
                return
            self.bytes_down += len(down)
            for wire in self.wires:
                wire.clear()
            for data, end in ((up, self.home), (down, self.door)):
                at = 0
                while at < len(data):
                    size = len(data) if pieces is None else pieces.randint(1, 4000)
                    end.dataReceived(data[at : at + size])
                    at += size


@pytest.mark.parametrize("seed", range(8))
def test_each_stream_gets_its_bytes_in_order_however_they_are_divided(seed: int) -> None:
    """Also those that several streams share, and beside others in the same reactor turn."""
    chance = random.Random(seed)
    pair = Pair()
    ends = [pair.opened() for _ in range(6)]
    sent = {id(end): b"" for both in ends for end in both}
    for _ in range(40):
        shared = [chance.randbytes(chance.choice((1, 50, 5000, 40_000))) for _ in range(3)]
        for _ in range(chance.randint(1, 12)):
            both = chance.choice(ends)
            side = chance.randint(0, 1)
            data = chance.choice(shared)
            both[side].transport.write(data)
            sent[id(both[1 - side])] += data
        if chance.random() < 0.5:
            pair.clock.advance(chance.choice((0, 0, 1)))
            pair.moves(chance)
    pair.moves(chance)
    for both in ends:
        for end in both:
            assert end.came == sent[id(end)]


@pytest.mark.parametrize("size", [1000, 10_000, 100_000])
def test_what_many_streams_get_is_sent_once(size: int) -> None:
    pair = Pair()
    homes = [pair.opened()[1] for _ in range(MOST_NUMBERS + 10)]
    pair.bytes_down = 0
    sample = bytes(size)
    for home in homes:
        home.transport.write(sample)
    pair.moves()
    assert pair.bytes_down < 3 * len(sample) + 5 * len(homes)
    # The order of a stream comes before what can be shared.
    pair.bytes_down = 0
    first, second = homes[:2]
    for peer, data in ((first, sample), (second, b"x"), (first, b"y"), (second, sample)):
        peer.transport.write(data)
    pair.moves()


def test_streams_keep_their_own_order_beside_what_is_shared() -> None:
    pair = Pair()
    (one, first), (two, second) = pair.opened(), pair.opened()
    a, b = b"a" * 3, b"b" * 3
    for peer, data in ((first, a), (first, b), (second, b), (second, a), (first, a)):
        peer.transport.write(data)
    pair.moves()
    assert (one.came, two.came) == (a + b + a, b + a)


def test_small_messages_are_sent_at_once_and_those_that_follow_in_one_piece() -> None:
    pair = Pair()
    door, home = pair.opened()
    pair.clock.advance(1)
    home.transport.write(b"first")
    assert pair.wires[1].value().endswith(b"first")
    pair.wires[1].clear()
    for number in range(10):
        home.transport.write(b"%d" % number)
    assert pair.wires[1].value() == b""
    pair.clock.advance(0)
    assert pair.wires[1].value().endswith(b"0123456789")
    pair.door.dataReceived(pair.wires[1].value())
    assert door.came == b"0123456789"


def test_much_is_sent_before_the_end_of_the_turn() -> None:
    """So that it is known soon if the transport is full."""
    pair = Pair()
    (_, home), (_, other) = pair.opened(), pair.opened()
    home.transport.write(bytes(JOINED_BYTES))
    assert pair.wires[1].value() == b""
    other.transport.write(b"next")
    assert len(pair.wires[1].value()) > JOINED_BYTES


def test_a_stream_that_is_not_read_is_paused_alone() -> None:
    pair = Pair()
    (slow, home), (quick, other) = pair.opened(), pair.opened()
    flows = [Flow(), Flow()]
    for peer, flow in zip((home, other), flows, strict=True):
        peer.transport.registerProducer(flow, True)
    slow.transport.pauseProducing()
    for peer in (home, other):
        peer.transport.write(bytes(UNREAD_BYTES + 1))
    pair.moves()
    assert (slow.came, len(quick.came)) == (b"", UNREAD_BYTES + 1)
    assert [flow.paused for flow in flows] == [True, False]
    slow.transport.resumeProducing()
    assert slow.came == b""
    pair.moves()
    assert (len(slow.came), [flow.paused for flow in flows]) == (UNREAD_BYTES + 1, [False, False])


def test_a_full_connection_pauses_all_its_streams() -> None:
    pair = Pair()
    homes = [pair.opened()[1] for _ in range(3)]
    flows = [Flow() for _ in homes]
    for peer, flow in zip(homes[:2], flows, strict=False):
        peer.transport.registerProducer(flow, True)
    producer = pair.wires[1].producer
    producer.pauseProducing()
    homes[2].transport.registerProducer(flows[2], True)
    assert all(flow.paused for flow in flows)
    producer.resumeProducing()
    assert not any(flow.paused for flow in flows)


def test_streams_of_a_full_connection_have_their_turn() -> None:
    """Each writes as much as it may when it is resumed."""
    pair = Pair()
    homes = [pair.opened()[1] for _ in range(6)]
    producer = pair.wires[1].producer
    turns = [0] * len(homes)

    class Greedy(Flow):
        def __init__(self, number: int) -> None:
            self.number = number

        def resumeProducing(self) -> None:
            turns[self.number] += 1
            if sum(turns) % 2 == 0:
                producer.pauseProducing()

    producer.pauseProducing()
    for number, home in enumerate(homes):
        home.transport.registerProducer(Greedy(number), True)
    for _ in range(30):
        producer.resumeProducing()
        producer.pauseProducing()
    assert max(turns) - min(turns) <= 1


def test_a_stream_that_is_aborted_ends_at_once_though_it_is_not_read() -> None:
    pair = Pair()
    door, home = pair.opened()
    door.transport.pauseProducing()
    home.transport.write(bytes(70_000))
    pair.moves()
    home.transport.abortConnection()
    pair.moves()
    assert (door.came, door.lost, home.lost) == (b"", 1, 1)


@pytest.mark.parametrize("end", ["late", "lost"])
def test_the_last_bytes_of_a_stream_are_not_kept_for_ever(end: str) -> None:
    pair = Pair()
    door, home = pair.opened()
    door.transport.pauseProducing()
    home.transport.write(b"last words")
    home.transport.loseConnection()
    pair.moves()
    assert door.lost == 0
    if end == "late":
        pair.clock.advance(READ_SECONDS)
    else:
        pair.door.connectionLost()
    assert door.lost == 1
    pair.clock.advance(READ_SECONDS)
    assert (door.lost, pair.door._ending) == (1, set())


def test_a_stream_that_is_never_paused_is_ended() -> None:
    """The other relay does not do as it is asked to."""
    pair = Pair()
    door, home = pair.opened()
    door.transport.pauseProducing()
    for _ in range(MOST_UNREAD_BYTES // (1 << 20) + 1):
        home.transport.write(bytes(1 << 20))
        pair.moves()
    assert (door.lost, home.lost) == (1, 1)


def test_a_stream_ends_behind_its_bytes_and_others_go_on() -> None:
    pair = Pair()
    (door, home), (_, other) = pair.opened(), pair.opened()
    door.transport.pauseProducing()
    home.transport.write(b"last words")
    home.transport.loseConnection()
    home.transport.write(b"too late")
    pair.moves()
    assert (home.lost, door.came, door.lost) == (1, b"", 0)
    door.transport.resumeProducing()
    pair.moves()
    assert (door.came, door.lost, other.lost) == (b"last words", 1, 0)
    door.transport.write(b"no one is there")
    door.transport.loseConnection()
    pair.moves()
    assert (door.lost, home.came) == (1, b"")


def test_bytes_for_a_stream_that_was_closed_meanwhile_are_dropped() -> None:
    pair = Pair()
    door, home = pair.opened()
    home.transport.write(b"crosses")
    door.transport.abortConnection()
    pair.moves()
    assert (door.came, door.lost, home.lost) == (b"", 1, 1)


def test_a_protocol_that_fails_ends_its_stream_alone() -> None:
    pair = Pair()
    (door, home), (other, second) = pair.opened(), pair.opened()
    door.dataReceived = _fail  # type: ignore[method-assign]
    home.transport.write(b"x")
    second.transport.write(b"y")
    pair.moves()
    assert (home.lost, other.came) == (1, b"y")


def _fail(*_: object) -> None:
    raise ZeroDivisionError


def test_a_stream_that_fails_at_its_beginning_ends_alone() -> None:
    pair = Pair()
    door, home = pair.opened()
    refused, begun = Peer(), Peer()
    broken = Peer()
    broken.makeConnection = _fail  # type: ignore[method-assign]
    pair.home._accept = lambda _: broken
    pair.door.open(refused)
    pair.moves()
    pair.home._accept = pair._accept
    pair.door.open(begun)
    door.transport.write(b"x")
    pair.moves()
    assert (refused.lost, begun.lost, home.came) == (1, 0, b"x")


def test_the_end_of_the_connection_ends_all_streams() -> None:
    pair = Pair()
    ends = [pair.opened() for _ in range(3)]
    ends[0][0].connectionLost = _fail  # type: ignore[method-assign]
    notes: list[str] = []
    pair.door.on_lost = lambda: notes.append("lost")
    pair.door.connectionLost()
    assert ([door.lost for door, _ in ends], notes) == ([0, 1, 1], ["lost"])


def test_the_relay_that_connected_opens_streams_alone() -> None:
    pair = Pair()
    unwanted = Peer()
    pair.home.open(unwanted)
    pair.moves()
    assert (pair.door._streams, unwanted.lost) == ({}, 1)
    pair.home.dataReceived(pack("!BHII", 2, 1, 3, 99) + b"abc" + pack("!BHII", 77, 1, 3, 1) + b"abc")
    assert not pair.wires[1].disconnecting
    pair.home.dataReceived(b"")
    pair.home.dataReceived(pack("!BHI", 2, MOST_NUMBERS + 1, 0))
    assert pair.wires[1].disconnected


@pytest.mark.parametrize(
    ("answer", "status"),
    [(ACCEPTED, 101), (b"HTTP/1.1 403 Forbidden\r\n\r\n", 403), (b"x" * 20_000, 502)],
)
def test_a_relay_accepts_the_connection_or_not(answer: bytes, status: int) -> None:
    clock = Clock()
    shared = SharedConnection(clock, FlushScheduler(clock))
    statuses: list[int] = []
    request = SharedConnectionRequest(shared, b"GET /\r\n\r\n", statuses.append)
    wire = StringTransport()
    request.makeConnection(wire)
    assert wire.value() == b"GET /\r\n\r\n"
    request.dataReceived(answer[:5])
    request.dataReceived(answer[5:])
    assert statuses == [status]
    assert wire.disconnecting == (status != 101)
    assert (wire.producer is not None) == (status == 101)
    lost: list[bool] = []
    shared.on_lost = lambda: lost.append(True)
    request.connectionLost()
    assert statuses == ([status] if status == 101 else [status, 0])
    assert lost == ([True] if status == 101 else [])


def test_a_relay_that_is_silent_is_given_up() -> None:
    pair = Pair()
    mine, _ = pair.opened()
    for _ in range(3 * MOST_UNANSWERED):
        pair.clock.advance(PING_SECONDS)
        pair.moves()
    assert pair.bytes_down == 3 * MOST_UNANSWERED * SINGLE_BYTES
    for _ in range(MOST_UNANSWERED):
        pair.clock.advance(PING_SECONDS)
    # Any byte counts, and a late answer too.
    pair.moves()
    for _ in range(MOST_UNANSWERED):
        assert not pair.wires[0].disconnected
        pair.clock.advance(PING_SECONDS)
    pair.clock.advance(PING_SECONDS)
    assert pair.wires[0].disconnected
    assert not pair.wires[1].disconnected
    pair.door.connectionLost()
    assert mine.lost == 1
    assert not pair.clock.getDelayedCalls()


def test_what_a_relay_does_not_take_is_left_to_the_kernel() -> None:
    """Its answer would be as late as the bytes before the ping."""
    pair = Pair()
    pair.opened()
    pair.wires[0].producer.pauseProducing()
    for _ in range(3 * MOST_UNANSWERED):
        pair.clock.advance(PING_SECONDS)
        assert not pair.wires[0].disconnected


def test_a_stream_is_a_transport() -> None:
    pair = Pair()
    door, _ = pair.opened()
    transport: StreamTransport = door.transport
    transport.setTcpNoDelay(True)
    transport.setTcpKeepAlive(True)
    assert transport.getPeer() == pair.wires[0].getPeer()
    assert transport.getHost() == pair.wires[0].getHost()
    transport.writeSequence([b"a", b"b"])
    transport.stopProducing()
    pair.moves()
    assert pair.accepted[0].came == b"ab"


def test_what_the_other_relay_has_read_is_confirmed() -> None:
    """Not before it has, not after the time, and not when the connection ends; each question has its own answer."""
    pair = Pair()
    mine, other = pair.opened()
    confirmed: list[Any] = []
    mine.transport.write(b"stop")
    mine.transport.confirm(1.0).addCallback(lambda read: confirmed.append((read, other.came)))
    pair.clock.advance(0.5)
    mine.transport.write(b" again")
    mine.transport.confirm(1.0).addCallback(lambda read: confirmed.append((read, other.came)))
    pair.clock.advance(0.5)
    assert confirmed == [(False, b"")]
    pair.moves()
    assert confirmed == [(False, b""), (True, b"stop again")]
    mine.transport.confirm(1.0).addCallback(confirmed.append)
    mine.transport.loseConnection()
    mine.transport.confirm(1.0).addCallback(confirmed.append)
    assert confirmed[2:] == [False]
    pair.door.connectionLost()
    mine.transport.confirm(1.0).addCallback(confirmed.append)
    assert confirmed[2:] == [False, False, False]
    pair.clock.advance(0)
    assert not pair.clock.getDelayedCalls()


def test_a_confirmation_behind_other_bytes_is_waited_for_longer() -> None:
    """Not for ever: the way there may be cut, and not the way back."""
    pair = Pair()
    mine, other = pair.opened()
    confirmed: list[bool] = []
    for _ in range(2):
        mine.transport.confirm(1.0).addCallback(confirmed.append)
        pair.clock.advance(0.5)
        asked = pair.wires[0].value()
        pair.wires[0].clear()
        other.transport.write(b"sample")
        pair.moves()
        pair.clock.pump([0.25] * 4)
        assert confirmed == [True][: len(confirmed)]
        if not confirmed:
            pair.home.dataReceived(asked)
            pair.moves()
            assert confirmed == [True]
    pair.clock.pump([0.25] * 4)
    assert confirmed == [True, False]
