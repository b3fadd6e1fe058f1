"""The edge towards robots: bytes of one TCP or TLS connection become frames and messages (SPEC section 2).

A connection begins in the role of :class:`Opening`. What the robot proves decides its role from then on: a control
link or the link of a channel.
"""

from __future__ import annotations

import socket
from collections import OrderedDict, deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IAddress
from twisted.internet.protocol import Factory, connectionDone
from twisted.internet.protocol import Protocol as TwistedProtocol
from twisted.logger import Logger
from twisted.python.failure import Failure

from relay_protocol import jsontext, limits, link
from relay_protocol.errors import MalformedMessage, PeerError, SwitchboardError, Unavailable
from relay_protocol.frames import (
    COMMAND,
    JSON,
    JSON_NUMBER,
    SAMPLE,
    CommandFrame,
    Frame,
    FrameDecoder,
    JsonFrame,
    PicturePart,
    SampleFrame,
    VideoFrame,
    encode_command,
    encode_part,
    encode_sample,
)
from relay_server.common.clock import Clock, Timer, cancel, looping
from relay_server.common.pacing import Pacer
from relay_server.common.push_producer import PushProducer
from relay_server.common.send_queue import SEGMENT, SendQueue
from relay_server.common.socket_writer import FlushScheduler, TransportWriter, writer_for
from relay_server.common.tcp import tcp_of
from relay_server.http.connection_limits import ConnectionLimits, Slot
from relay_server.robots.link_quality import LinkQuality, LinkQualityMeter

PINGS = 256
"""Pings without an answer that are remembered."""

REPLACED_SECONDS = 2.0
"""A link that a newer one has replaced is closed after so long at most."""

REQUEST_BYTES = 6 * limits.MIB
"""Calls, goals and answers of clients that may wait for a robot: one of the largest (:data:`limits.COMMAND_FRAME`), and
some small ones. A call that finds no room is refused to its caller, and the channel goes on."""

MEASURED_SECONDS = 1.0
"""A link whose quality is told is pinged at least so often."""


class LinkRole(Protocol):
    """What a robot's connection is for, at the moment."""

    def message(self, body: bytes) -> None:
        """A JSON message.

        :raises PeerError: it breaks the protocol
        """

    def sample(self, frame: SampleFrame) -> None:
        """A topic sample.

        :raises PeerError: it has no place here
        """

    def picture(self, frame: VideoFrame | PicturePart) -> None:
        """A picture or a part of one; few roles take any.

        :raises PeerError: it is none, or has no place here
        """
        raise MalformedMessage("pictures have a link of their own")

    def lost(self, reason: str) -> None:
        """The connection has ended."""


@dataclass(frozen=True)
class LinkTiming:
    """What can be set of a robot's connection.

    :param heartbeat: seconds between pings
    :param largest_sample: bytes of the largest sample a robot may send in parts
    """

    heartbeat: float
    largest_sample: int = limits.ROBOT_SAMPLE


class RobotConnection(TwistedProtocol):
    """One connection of a robot, whatever its role.

    :param clock: for deadlines and heartbeats
    :param clock_ns: the relay's monotonic clock, told to robots in ``pong`` and ``joined``
    :param first_role: makes the role a new connection begins with
    :param turns: shared by all robots' connections
    """

    log = Logger()
    transport: Any
    _writer: TransportWriter

    def __init__(
        self,
        clock: Clock,
        clock_ns: Callable[[], int],
        timing: LinkTiming,
        first_role: Callable[[RobotConnection], LinkRole],
        cap: ConnectionLimits,
        turns: FlushScheduler | None = None,
    ) -> None:
        self._clock = clock
        self._turns = turns or FlushScheduler(clock)
        self.clock_ns = clock_ns
        self.timing = timing
        self._cap = cap
        self._decoder = FrameDecoder(limits.HANDSHAKE_FRAME)
        self._role: LinkRole | None = first_role(self)
        self._deadline: Timer | None = None
        self._place: Slot | None = None
        self._unproven_bytes = 0
        self._waiting: deque[Frame] = deque()
        self._busy = False
        self._heard = clock.seconds()
        self._beating = looping(clock, self._beat)
        self._aborting: Timer | None = None
        self._pings: OrderedDict[int, Deferred[float] | None] = OrderedDict()
        self._meter = LinkQualityMeter()
        self._answered = 0
        self.on_round_trip: Callable[[float], None] = lambda seconds: None
        self._outbox = SendQueue(_nowhere, clock.seconds, self._overflow, REQUEST_BYTES)
        self._pacer: Pacer | None = None
        self.address = ""

    # --- Twisted ------------------------------------------------------------------------------------------

    def connectionMade(self) -> None:
        """A robot has dialled."""
        self.address = getattr(self.transport.getPeer(), "host", "")
        harden(self.transport)
        self._writer = writer_for(self.transport, self._turns)
        self._outbox.write = self._writer.write
        self.transport.registerProducer(PushProducer(self), True)
        if not self._cap.enter(self.address):
            self.refuse(link.Refused(reason="too many connections from your address", retry_after=10.0))
            return
        self._place = self._cap.stranger()
        if self._place is None:
            self.refuse(link.Refused(reason="too many robots dial at the same time", retry_after=10.0))
            return
        self._deadline = self._clock.callLater(limits.UNPROVEN_SECONDS, self._too_late)

    def dataReceived(self, data: bytes) -> None:
        """Bytes from the robot."""
        if self._role is None:
            return
        self._heard = self._clock.seconds()
        if self._deadline is not None:
            self._unproven_bytes += len(data)
            if self._unproven_bytes > limits.UNPROVEN_BYTES:
                self._break(MalformedMessage(f"more than {limits.UNPROVEN_BYTES} bytes before the proof"))
                return
        try:
            self._waiting += self._decoder.feed(data)
            self._work()
        except PeerError as error:
            self._break(error)

    def connectionLost(self, reason: Failure = connectionDone) -> None:
        """The connection is gone."""
        self._cap.leave(self.address)
        self._known()
        cancel(self._aborting)
        self._end(reason.getErrorMessage())

    @property
    def ended(self) -> bool:
        """Whether the connection is gone, or on its way out."""
        return self._role is None

    # --- for roles ----------------------------------------------------------------------------------------

    def pace(self, *, parts: bool) -> None:
        """Keep little on its way to the robot, so that pings and commands wait for little.

        :param parts: whether the robot takes samples in parts
        """
        tcp = tcp_of(self.transport)
        pieces = _Parts if parts else _Whole
        self._pacer = Pacer(
            self._writer, self._outbox, self._clock, self._turns.stalls.seconds, self._probe, pieces, tcp
        )

    def _probe(self) -> None:
        self._ping(None)

    def pause(self) -> None:
        """The transport's buffer is full."""
        self._outbox.pause()

    def resume(self) -> None:
        """The transport takes bytes again."""
        self._outbox.resume()
        if self._pacer is not None:
            self._pacer.go_on()

    def send(self, message: link.Message) -> None:
        """Queue a message that must not be lost.

        :raises Unavailable: it is a call, a goal or an answer, and too much waits for a slow robot already
        """
        frame = link.frame(message)
        if isinstance(message, _OF_CLIENTS) and not self._takes(message, len(frame)):
            raise Unavailable("the robot's link is too slow for what waits for it already; try again later")
        # A ping that counted against the budget would ask for another one.
        if self._role is not None and self._outbox.paused_since is None and isinstance(message, _AHEAD):
            self._writer.urgent(frame)
        else:
            self._outbox.control(frame)

    def _takes(self, message: link.Message, size: int) -> bool:
        """Whether there is room for what clients ask; a short answer finds it always."""
        return (size <= SEGMENT and not isinstance(message, _ASKED)) or self._outbox.has_room(size)

    def sample(self, number: int, stamp: int, body: bytes) -> None:
        """Queue a sample; when the robot is slow the newest survive."""
        frame = encode_sample(number, stamp, body)
        if self._outbox.passing:
            self._outbox.write(frame)
        else:
            self._outbox.data(number, frame)

    def command(self, number: int, stamp: int, source: int, body: bytes) -> None:
        """The same of a command, with the connection it comes from."""
        frame = encode_command(number, stamp, source, body)
        if self._outbox.passing:
            self._outbox.write(frame)
        else:
            self._outbox.data(number, frame, commands=True)
            if self._pacer is not None:
                self._pacer.commands()

    def newest(self, key: str, message: link.Message) -> None:
        """Queue a message of which, under one key, only the newest must survive."""
        self._outbox.data(key, link.frame(message), 1)

    def close(self, reason: str) -> None:
        """Say ``bye`` and end the connection."""
        if self._role is not None:
            self.send(link.Bye(reason=reason))
            self._hang_up(reason)

    def replaced(self, reason: str, answers: Callable[[], None]) -> None:
        """Say ``bye``, and end the connection as soon as the robot may have answered one more ping.

        :param answers: called if it does
        """
        if self._role is None:
            return

        def alive(_: float) -> None:
            answers()
            self._hang_up(reason)

        self._role.lost(reason)
        self._role = _Replaced(self)
        if self._beating.running:
            self._beating.stop()
        self.round_trip().addCallbacks(alive, lambda _: None)
        self.send(link.Bye(reason=reason))
        self._aborting = self._clock.callLater(REPLACED_SECONDS, self._hang_up, reason)

    def finish(self, reason: str) -> None:
        """All is said; end the connection."""
        if self._role is not None:
            self._hang_up(reason)

    def refuse(self, refusal: link.Refused) -> None:
        """Say no in words and end the connection."""
        if self._role is not None:
            self.log.info(
                "a robot at {address} is refused: {reason}",
                address=self.address,
                reason=refusal.reason,
                limited="robot refused",
            )
            self.send(refusal)
            self._hang_up(refusal.reason)

    def proven(
        self, role: LinkRole, frame_limit: int, *, measured: bool = False, sample_limit: int = 0
    ) -> None:
        """The robot is known; from now on the connection has this role, heartbeats run both ways.

        :param sample_limit: bytes of the largest sample that may come in parts; 0 for what fits into a frame
        :param measured: whether :meth:`reading` is going to be asked for
        """
        self._role = role
        self._decoder.limit = frame_limit
        self._decoder.sample_limit = sample_limit
        self._known()
        self._stop_deadline()
        often = min(self.timing.heartbeat, MEASURED_SECONDS) if measured else self.timing.heartbeat
        self._beating.start(often, now=True)

    def wait_for(self, work: Deferred[None]) -> None:
        """Hold further frames until ``work`` is done."""
        self._busy = True
        self.transport.pauseProducing()
        work.addErrback(self._broken_work)
        work.addBoth(self._go_on)

    def round_trip(self) -> Deferred[float]:
        """Ping the robot; seconds, or :class:`Unavailable` when the connection ends first."""
        waiting: Deferred[float] = Deferred()
        self._ping(waiting)
        return waiting

    def reading(self) -> LinkQuality:
        """How good the way to the robot is."""
        now = self.clock_ns()
        # Answers keep their order: what was asked before the latest that was answered is not waited for.
        out = [(now - sent) / 1e9 for sent in self._pings if sent > self._answered]
        return self._meter.reading(now / 1e9, out)

    # --- inside -------------------------------------------------------------------------------------------

    def _work(self) -> None:
        waiting = self._waiting
        while waiting and not self._busy and self._role is not None:
            frame = waiting.popleft()
            if isinstance(frame, SampleFrame):
                self._role.sample(frame)
            elif isinstance(frame, JsonFrame):
                self._role.message(frame.body)
            elif isinstance(frame, CommandFrame):
                raise MalformedMessage("commands go from the relay to the robot only")
            else:
                self._role.picture(frame)

    def heartbeat(self, message: link.Ping | link.Pong) -> None:
        """Ping and pong are the same in every role."""
        if isinstance(message, link.Ping):
            self.send(link.Pong(t=message.t, at=self.clock_ns()))
        elif message.t in self._pings:
            if self._pacer is not None:
                self._pacer.answered(message.t)
            waiting = self._pings.pop(message.t)
            now = self.clock_ns()
            seconds = (now - message.t) / 1e9
            self._meter.came_back(now / 1e9, seconds)
            self._answered = max(self._answered, message.t)
            self.on_round_trip(seconds)
            if waiting is not None:
                waiting.callback(seconds)

    def _ping(self, waiting: Deferred[float] | None) -> None:
        now = self.clock_ns()
        while now in self._pings:
            now += 1
        self._pings[now] = waiting
        while len(self._pings) > PINGS:
            self._give_up(self._pings.popitem(last=False)[1])
        if self._pacer is not None:
            self._pacer.probing(now)
        self.send(link.Ping(t=now))

    @staticmethod
    def _give_up(waiting: Deferred[float] | None) -> None:
        if waiting is not None:
            waiting.errback(Unavailable("the robot did not answer, or lost its connection"))

    def _beat(self) -> None:
        silent = self._clock.seconds() - self._heard
        if silent > self.timing.heartbeat * limits.HEARTBEATS_MISSED:
            self.log.info(
                "robot at {address} is silent for {silent:.1f} s", address=self.address, silent=silent
            )
            self._end(f"silent for {silent:.1f} s")
            self.transport.abortConnection()
            return
        self._ping(None)

    def _too_late(self) -> None:
        self._deadline = None
        self.refuse(
            link.Refused(reason=f"no proof of identity within {limits.UNPROVEN_SECONDS:g} s", retry_after=5.0)
        )

    def _broken_work(self, failure: Failure) -> None:
        error = failure.value
        if isinstance(error, PeerError):
            self._break(error)
        elif isinstance(error, SwitchboardError):
            retry = 5.0 if isinstance(error, Unavailable) else None
            self.refuse(link.Refused(reason=str(error), code=error.code, retry_after=retry))
        else:
            self.log.failure("opening a robot's link failed", failure)
            self.refuse(link.Refused(reason="the relay failed; its log tells more", retry_after=5.0))

    def _go_on(self, _: Any) -> None:
        self._busy = False
        if self.ended:
            return
        self.transport.resumeProducing()
        try:
            self._work()
        except PeerError as error:
            self._break(error)

    def _break(self, error: PeerError) -> None:
        self.log.warn(
            "the robot at {address} broke the protocol: {reason}",
            address=self.address,
            reason=str(error),
            limited="robot broke the protocol",
        )
        self.send(link.Refused(reason=str(error), code=error.code))
        self._hang_up(str(error))

    def _hang_up(self, reason: str) -> None:
        self._end(reason)
        cancel(self._aborting)
        self._writer.flush()
        # TLS would not shut down while a producer is registered.
        self.transport.unregisterProducer()
        self._aborting = self._clock.callLater(2.0, self.transport.abortConnection)
        self.transport.loseConnection()

    def _end(self, reason: str) -> None:
        role, self._role = self._role, None
        self._stop_deadline()
        if self._pacer is not None:
            self._pacer.stop()
        self._outbox.close()
        self._waiting.clear()
        if self._beating.running:
            self._beating.stop()
        pings, self._pings = self._pings, OrderedDict()
        for waiting in pings.values():
            self._give_up(waiting)
        if role is not None:
            role.lost(reason)

    def _known(self) -> None:
        if self._place is not None:
            self._place.give_back()

    def _stop_deadline(self) -> None:
        cancel(self._deadline)
        self._deadline = None

    def _overflow(self) -> None:
        self.log.warn("the robot at {address} takes nothing; it is cut", address=self.address)
        self._end("the robot takes nothing")
        self.transport.abortConnection()


class _Replaced(LinkRole):
    """The link of a robot that has a newer one: only the answer to a ping counts."""

    def __init__(self, connection: RobotConnection) -> None:
        self._connection = connection

    def message(self, body: bytes) -> None:
        """What is no answer to a ping is passed over."""
        message = jsontext.decode(link.robot_control_decoder, body)
        if isinstance(message, link.Pong):
            self._connection.heartbeat(message)

    def sample(self, frame: SampleFrame) -> None:
        """Passed over."""

    def picture(self, frame: VideoFrame | PicturePart) -> None:
        """Passed over."""

    def lost(self, reason: str) -> None:
        """It had been given up before."""


_AHEAD = (link.Ping, link.Pong, link.Bye, link.Refused)
"""Messages that do not wait for what a thin link has yet to carry."""

_ASKED = (link.CallService, link.SendActionGoal)
_OF_CLIENTS = (*_ASKED, link.ServiceResponse, link.ActionResult)
"""Messages as large and as many as clients make them."""


class _Whole:
    """A frame that is not divided."""

    divided = False

    def __init__(self, frame: bytes) -> None:
        self._frame = frame
        self.command = frame[4] == COMMAND

    @property
    def left(self) -> int:
        """Bytes that were not taken."""
        return len(self._frame)

    def take(self, most: int) -> bytes:
        """All of it."""
        frame, self._frame = self._frame, b""
        return frame


class _Parts(_Whole):
    """A frame that is divided where it is a sample or a message (SPEC section 2.1). Commands may go in between."""

    def __init__(self, frame: bytes) -> None:
        super().__init__(frame)
        self._number, self._stamp, self._at = 0, 0, 0
        self._body = memoryview(b"")
        if frame[4] == SAMPLE:
            (sample,) = FrameDecoder(len(frame)).feed(frame)
            assert isinstance(sample, SampleFrame)
            self._number, self._stamp, self._body = sample.number, sample.stamp, memoryview(sample.body)
        elif frame[4] == JSON and len(frame) > SEGMENT:
            self._number, self._body = JSON_NUMBER, memoryview(frame)[5:]
        self.divided = bool(self._body)

    @property
    def left(self) -> int:
        """Bytes of the message that were not taken."""
        return len(self._body) - self._at if self._body else super().left

    def take(self, most: int) -> bytes:
        """The next part, or all of what is not divided."""
        if not self._body:
            return super().take(most)
        begun, self._at = self._at, min(len(self._body), self._at + most)
        piece = bytes(self._body[begun : self._at])
        return encode_part(self._number, self._stamp, len(self._body), begun, piece)


def _nowhere(data: bytes) -> None:
    """Nobody has dialled yet."""


def harden(transport: Any) -> None:
    """Small messages go at once; a dead peer is noticed by the kernel too, where it can."""
    transport.setTcpNoDelay(True)
    transport.setTcpKeepAlive(True)
    while hasattr(transport, "transport") and not hasattr(transport.getHandle(), "setsockopt"):
        transport = transport.transport  # TLS wraps the socket
    handle = transport.getHandle()
    option = getattr(socket, "TCP_USER_TIMEOUT", None)
    if option is not None and hasattr(handle, "setsockopt"):
        handle.setsockopt(socket.IPPROTO_TCP, option, 10_000)


class RobotFactory(Factory):
    """Builds a :class:`RobotConnection` for each robot that dials."""

    noisy = False

    def __init__(self, build: Callable[[], RobotConnection]) -> None:
        self._build = build

    def buildProtocol(self, addr: IAddress | None) -> RobotConnection:
        """One connection."""
        connection = self._build()
        connection.factory = self
        return connection
