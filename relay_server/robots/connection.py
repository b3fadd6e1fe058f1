"""Robots' connections: the bytes of one TCP or TLS connection become frames and messages (SPEC 2).

A connection begins with a :class:`~relay_server.robots.link_handlers.HandshakeHandler`. The handshake decides its
further handler: control link, channel link, or link of a camera stream.
"""

from __future__ import annotations

import socket
from collections import OrderedDict, deque
from collections.abc import Callable, Hashable
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
    COMMAND_HEAD,
    JSON,
    JSON_NUMBER,
    SAMPLE,
    SAMPLE_HEAD,
    CommandFrame,
    FilePart,
    Frame,
    FrameDecoder,
    JsonFrame,
    SampleFrame,
    VideoFrame,
    VideoFramePart,
    encode_part,
    pack_command_head,
    pack_sample_head,
)
from relay_server.common.clock import Clock, Timer, cancel, looping
from relay_server.common.pacing import Pacer
from relay_server.common.send_queue import SEGMENT, SendQueue
from relay_server.common.socket_writer import FlushScheduler, TransportWriter, writer_for
from relay_server.common.tcp import PushProducer, tcp_of
from relay_server.http.limits import ConnectionLimits, Slot
from relay_server.robots.link_quality import LinkQuality, LinkQualityMeter

PINGS = 256
"""Most unanswered pings that are remembered."""

REPLACED_SECONDS = 2.0
"""Most seconds until a replaced link is closed."""

REQUEST_BYTES = 6 * limits.MIB
"""Most bytes of clients' calls, goals and answers that wait for a robot.

That is one of the largest (:data:`limits.RELAY_JSON_FRAME`) and some small ones. Further calls are refused.
"""

MEASURED_SECONDS = 1.0
"""Most seconds between pings of a link whose quality is shown."""


ON_EVERY_LINK = (link.Ping, link.Pong, link.Bye)
"""Messages that :meth:`RobotConnection.common_message` handles."""

TLS_HELLO = b"\x16\x03"
"""The first bytes of a peer that speaks TLS (RFC 8446 section 5.1). As a length of a frame they are far too large."""


class LinkHandler(Protocol):
    """Handles what one connection of a robot receives: messages and frames."""

    def message(self, body: bytes) -> None:
        """A JSON message.

        :raises PeerError: it breaks the protocol
        """

    def sample(self, frame: SampleFrame) -> None:
        """A topic sample.

        :raises PeerError: this handler takes none
        """

    def video_frame(self, frame: VideoFrame | VideoFramePart) -> None:
        """A camera frame or a part of one. Only the handler of a camera stream takes them.

        :raises PeerError: this handler takes none
        """
        raise MalformedMessage("camera frames go over the link of a camera stream")

    def file_part(self, frame: FilePart) -> None:
        """A part of a file. Only the handler of a file link takes them.

        :raises PeerError: this handler takes none
        """
        raise MalformedMessage("files go over the file link")

    def lost(self, reason: str) -> None:
        """The connection has ended."""


@dataclass(frozen=True)
class LinkTiming:
    """Settings of robots' connections.

    :param heartbeat: seconds between pings
    :param largest_sample: bytes of the largest sample a robot may send in parts
    """

    heartbeat: float
    largest_sample: int = limits.ROBOT_SAMPLE


class RobotConnection(TwistedProtocol):
    """One connection of a robot, whichever link it is.

    :param clock: for deadlines and heartbeats
    :param clock_ns: the relay's monotonic clock in nanoseconds, sent to robots in ``pong`` and ``joined``
    :param first_handler: makes the handler with which a new connection begins
    :param flushes: shared by all robots' connections
    """

    log = Logger()
    transport: Any
    _writer: TransportWriter

    def __init__(
        self,
        clock: Clock,
        clock_ns: Callable[[], int],
        timing: LinkTiming,
        first_handler: Callable[[RobotConnection], LinkHandler],
        connection_limits: ConnectionLimits,
        flushes: FlushScheduler | None = None,
    ) -> None:
        self._clock = clock
        self._flushes = flushes or FlushScheduler(clock)
        self.clock_ns = clock_ns
        self.timing = timing
        self._limits = connection_limits
        self._decoder = FrameDecoder(limits.HANDSHAKE_FRAME)
        self._handler: LinkHandler | None = first_handler(self)
        self._deadline: Timer | None = None
        self._slot: Slot | None = None
        self._unauthenticated_bytes = 0
        self._waiting: deque[Frame] = deque()
        self._suspended = False
        self._last_received = clock.seconds()
        self._heartbeat = looping(clock, self._beat)
        self._last_beat = 0.0
        self._aborting: Timer | None = None
        self._pings: OrderedDict[int, Deferred[float] | None] = OrderedDict()
        self._meter = LinkQualityMeter()
        self._answered = 0
        self.on_round_trip: Callable[[float], None] = lambda seconds: None
        self._send_queue = SendQueue(_not_connected, clock.seconds, self._overflow, REQUEST_BYTES)
        self._pacer: Pacer | None = None
        self._replies: deque[bytes] = deque()
        self.reply_bytes = 0
        """Bytes of replies that wait."""
        self.address = ""

    # --- Twisted ------------------------------------------------------------------------------------------

    def connectionMade(self) -> None:
        """A robot has dialled."""
        self.address = getattr(self.transport.getPeer(), "host", "")
        harden(self.transport)
        self._writer = writer_for(self.transport, self._flushes)
        self._send_queue.write = self._writer.write
        self.transport.registerProducer(PushProducer(self), True)
        if not self._limits.enter(self.address):
            self.refuse(link.Refused(reason="too many connections from your address", retry_after=10.0))
            return
        self._slot = self._limits.unauthenticated()
        if self._slot is None:
            self.refuse(link.Refused(reason="too many robots dial at the same time", retry_after=10.0))
            return
        self._deadline = self._clock.callLater(limits.UNAUTHENTICATED_SECONDS, self._not_authenticated)

    def dataReceived(self, data: bytes) -> None:
        """Bytes from the robot."""
        if self._handler is None:
            return
        self._last_received = self._clock.seconds()
        if self._deadline is not None:
            if not self._unauthenticated_bytes and data.startswith(TLS_HELLO):
                self._protocol_broken(MalformedMessage("it speaks TLS, and this port was started without"))
                return
            self._unauthenticated_bytes += len(data)
            if self._unauthenticated_bytes > limits.UNAUTHENTICATED_BYTES:
                self._protocol_broken(
                    MalformedMessage(f"more than {limits.UNAUTHENTICATED_BYTES} bytes before the proof")
                )
                return
        try:
            self._waiting += self._decoder.feed(data)
            self._handle_frames()
        except PeerError as error:
            self._protocol_broken(error)

    def connectionLost(self, reason: Failure = connectionDone) -> None:
        """The connection is gone."""
        self._limits.leave(self.address)
        self._release_slot()
        cancel(self._aborting)
        self._end(reason.getErrorMessage())

    @property
    def ended(self) -> bool:
        """Whether the connection is closed, or is being closed."""
        return self._handler is None

    # --- for handlers --------------------------------------------------------------------------------------

    def pace(self, *, parts: bool) -> None:
        """Bound what is in flight to the robot, so that pings and commands arrive soon.

        :param parts: whether the robot accepts samples in parts
        """
        tcp = tcp_of(self.transport)
        pieces = _FrameParts if parts else _WholeFrame
        self._pacer = Pacer(
            self._writer,
            self._send_queue,
            self._clock,
            self._flushes.stalls.seconds,
            self._probe,
            pieces,
            tcp,
        )

    def _probe(self) -> None:
        self._ping(None)

    def pause(self) -> None:
        """The transport's buffer is full."""
        self._send_queue.pause()

    def resume(self) -> None:
        """The transport's buffer has room again."""
        self._send_queue.resume()
        if self._pacer is not None:
            self._pacer.continue_sending()
        self._write_replies()

    def send(self, message: link.Message) -> None:
        """Queue a message that must not be lost.

        :raises Unavailable: it is a call, a goal or an answer, and a slow robot's queue is full
        """
        frame = link.frame(message)
        if isinstance(message, _OF_CLIENTS) and not self._has_room(message, len(frame)):
            raise Unavailable("the robot's link is too slow for what waits for it already; try again later")
        # Such a message does not count against the budget; a ping that did would cause another one.
        if (
            self._handler is not None
            and self._send_queue.paused_since is None
            and isinstance(message, _OVERTAKING)
        ):
            self._writer.write_beyond_budget(frame)
        else:
            self._send_queue.send_reliable(frame)

    def _has_room(self, message: link.Message, size: int) -> bool:
        """Whether the queue has room for a client's message. A short answer always has."""
        return (size <= SEGMENT and not isinstance(message, _REQUESTS)) or self._send_queue.has_room(size)

    def report_drops(self, on_drop: Callable[[Hashable, int], None]) -> None:
        """Report each message that is dropped because the link is slow.

        :param on_drop: called with the number of its publication, or another key of the send queue, and the number of
            the client's connection
        """
        self._send_queue.on_drop = on_drop

    def message_sender(
        self, number: int, convert: Callable[[bytes], bytes] = bytes, *, commands: bool
    ) -> Callable[[int, int, bytes], None]:
        """The function that frames and sends messages of one publication; a slow robot gets only the newest.

        Nearly all messages to robots are sent by it, so it frames them with as few calls as possible.

        :param convert: converts a body to the robot's encoding; ``bytes``: bodies are in that encoding
        :returns: a function of ``earliest_sent`` (the stamp of the frame), the number of the client's connection
            (sent with commands only, but reported of all that is dropped), and the body; it raises what ``convert``
            raises
        """
        queue = self._send_queue

        def send_command(earliest_sent: int, source: int, body: bytes) -> None:
            body = convert(body)
            frame = pack_command_head(len(body) + COMMAND_HEAD, COMMAND, number, earliest_sent, source) + body
            if queue.passing:
                queue.write(frame)
                return
            queue.send_droppable(number, frame, commands=True, source=source)
            if self._pacer is not None:
                self._pacer.send_commands()

        def send_sample(earliest_sent: int, source: int, body: bytes) -> None:
            body = convert(body)
            frame = pack_sample_head(len(body) + SAMPLE_HEAD, SAMPLE, number, earliest_sent) + body
            if queue.passing:
                queue.write(frame)
            else:
                queue.send_droppable(number, frame, source=source)

        return send_command if commands else send_sample

    def send_progress(self, number: int, body: bytes) -> None:
        """Queue the progress of a function that the robot has called, in place of an earlier one that waits."""
        frame = pack_sample_head(len(body) + SAMPLE_HEAD, SAMPLE, number, 0) + body
        self._send_queue.send_droppable(number, frame, 1)

    def send_reply(self, number: int, body: bytes) -> None:
        """Send a sample that must not be lost, also if it is large: it waits until the connection has room."""
        if self._handler is None:
            return
        # An older sample of this number is of no use after its reply.
        self._send_queue.forget(number)
        frame = pack_sample_head(len(body) + SAMPLE_HEAD, SAMPLE, number, 0) + body
        self._replies.append(frame)
        self.reply_bytes += len(frame)
        self._write_replies()

    def _write_replies(self) -> None:
        while self._replies and self._send_queue.passing:
            frame = self._replies.popleft()
            self.reply_bytes -= len(frame)
            self._send_queue.write(frame)

    def send_newest(self, key: str, message: link.Message) -> None:
        """Queue a message that replaces an older one with the same key."""
        self._send_queue.send_droppable(key, link.frame(message), 1)

    def close(self, reason: str) -> None:
        """Send ``bye`` and end the connection."""
        if self._handler is not None:
            self.send(link.Bye(reason=reason))
            self._hang_up(reason)

    def close_replaced(self, reason: str, answers: Callable[[], None]) -> None:
        """Send ``bye``, and end the connection once the robot had time to answer one more ping.

        :param answers: called if it answers
        """
        if self._handler is None:
            return

        def alive(_: float) -> None:
            answers()
            self._hang_up(reason)

        self._handler.lost(reason)
        self._handler = _Replaced(self)
        if self._heartbeat.running:
            self._heartbeat.stop()
        self.round_trip().addCallbacks(alive, lambda _: None)
        self.send(link.Bye(reason=reason))
        self._aborting = self._clock.callLater(REPLACED_SECONDS, self._hang_up, reason)

    def finish(self, reason: str) -> None:
        """End the connection after what is queued."""
        if self._handler is not None:
            self._hang_up(reason)

    def refuse(self, refusal: link.Refused) -> None:
        """Send a refusal and end the connection."""
        if self._handler is not None:
            self.log.info(
                "a robot at {address} is refused: {reason}",
                address=self.address,
                reason=refusal.reason,
                limited="robot refused",
            )
            self.send(refusal)
            self._hang_up(refusal.reason)

    def set_handler(
        self, handler: LinkHandler, frame_limit: int, *, measured: bool = False, sample_limit: int = 0
    ) -> None:
        """Set the handler of the connection, as the robot has proved its identity, and start heartbeats.

        :param sample_limit: bytes of the largest sample accepted in parts; 0 if samples must fit into a frame
        :param measured: whether :meth:`link_quality` is used
        """
        self._handler = handler
        self._decoder.limit = frame_limit
        self._decoder.sample_limit = sample_limit
        self._release_slot()
        self._stop_deadline()
        often = min(self.timing.heartbeat, MEASURED_SECONDS) if measured else self.timing.heartbeat
        self._last_beat = self._clock.seconds()
        self._heartbeat.start(often, now=True)

    def wait_for(self, work: Deferred[None]) -> None:
        """Handle no further frames until ``work`` is done."""
        self._suspended = True
        self.transport.pauseProducing()
        work.addErrback(self._work_failed)
        work.addBoth(self._resume_handling)

    def round_trip(self) -> Deferred[float]:
        """Ping the robot; fires with seconds, or fails with :class:`Unavailable` when the connection ends first."""
        waiting: Deferred[float] = Deferred()
        self._ping(waiting)
        return waiting

    def link_quality(self) -> LinkQuality:
        """The quality of the link to the robot."""
        now = self.clock_ns()
        # Answers keep their order, so pings older than the latest answered one will not be answered.
        out = [(now - sent) / 1e9 for sent in self._pings if sent > self._answered]
        return self._meter.link_quality(now / 1e9, out)

    # --- inside -------------------------------------------------------------------------------------------

    def _handle_frames(self) -> None:
        waiting = self._waiting
        while waiting and not self._suspended and self._handler is not None:
            frame = waiting.popleft()
            if isinstance(frame, SampleFrame):
                self._handler.sample(frame)
            elif isinstance(frame, JsonFrame):
                self._handler.message(frame.body)
            elif isinstance(frame, CommandFrame):
                raise MalformedMessage("commands go from the relay to the robot only")
            elif isinstance(frame, FilePart):
                self._handler.file_part(frame)
            else:
                self._handler.video_frame(frame)

    def common_message(self, message: link.Ping | link.Pong | link.Bye) -> None:
        """Handle a message that is the same on every link."""
        if isinstance(message, link.Bye):
            self.close("bye")
        elif isinstance(message, link.Ping):
            self.send(link.Pong(t=message.t, at=self.clock_ns()))
        elif message.t in self._pings:
            if self._pacer is not None:
                self._pacer.probe_answered(message.t)
            waiting = self._pings.pop(message.t)
            now = self.clock_ns()
            seconds = (now - message.t) / 1e9
            self._meter.answered(now / 1e9, seconds)
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
            self._ping_failed(self._pings.popitem(last=False)[1])
        if self._pacer is not None:
            self._pacer.probe_sent(now)
        self.send(link.Ping(t=now))

    @staticmethod
    def _ping_failed(waiting: Deferred[float] | None) -> None:
        if waiting is not None:
            waiting.errback(Unavailable("the robot did not answer, or lost its connection"))

    def _beat(self) -> None:
        now = self._clock.seconds()
        silent = now - self._last_received
        # What the robot has sent meanwhile is not read yet. A busy relay that closed links for that would be busier.
        late = now - self._last_beat > 2 * self.timing.heartbeat
        self._last_beat = now
        if silent > self.timing.heartbeat * limits.HEARTBEATS_MISSED and not late:
            self.log.info(
                "robot at {address} is silent for {silent:.1f} s", address=self.address, silent=silent
            )
            self._end(f"silent for {silent:.1f} s")
            self.transport.abortConnection()
            return
        try:
            self._decoder.drop_idle(now)
        except PeerError as error:
            self._protocol_broken(error)
            return
        self._ping(None)

    def _not_authenticated(self) -> None:
        self._deadline = None
        self.refuse(
            link.Refused(
                reason=f"no proof of identity within {limits.UNAUTHENTICATED_SECONDS:g} s", retry_after=5.0
            )
        )

    def _work_failed(self, failure: Failure) -> None:
        error = failure.value
        if isinstance(error, PeerError):
            self._protocol_broken(error)
        elif isinstance(error, SwitchboardError):
            retry = 5.0 if isinstance(error, Unavailable) else None
            self.refuse(link.Refused(reason=str(error), code=error.code, retry_after=retry))
        else:
            self.log.failure("opening a robot's link failed", failure)
            self.refuse(link.Refused(reason="the relay failed; see its log", retry_after=5.0))

    def _resume_handling(self, _: Any) -> None:
        self._suspended = False
        if self.ended:
            return
        self.transport.resumeProducing()
        try:
            self._handle_frames()
        except PeerError as error:
            self._protocol_broken(error)

    def _protocol_broken(self, error: PeerError) -> None:
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
        handler, self._handler = self._handler, None
        self._stop_deadline()
        if self._pacer is not None:
            self._pacer.stop()
        self._send_queue.drop_data()
        self._send_queue.close()
        self._replies.clear()
        self.reply_bytes = 0
        self._waiting.clear()
        # The connection may be part of a cycle, which is freed much later.
        self._decoder.clear()
        if self._heartbeat.running:
            self._heartbeat.stop()
        pings, self._pings = self._pings, OrderedDict()
        for waiting in pings.values():
            self._ping_failed(waiting)
        if handler is not None:
            handler.lost(reason)

    def _release_slot(self) -> None:
        if self._slot is not None:
            self._slot.release()

    def _stop_deadline(self) -> None:
        cancel(self._deadline)
        self._deadline = None

    def _overflow(self) -> None:
        self.log.warn("the robot at {address} accepts no data and is disconnected", address=self.address)
        self._end("the robot accepts no data")
        self.transport.abortConnection()


class _Replaced(LinkHandler):
    """A link that was replaced: only the answer to a ping is read."""

    def __init__(self, connection: RobotConnection) -> None:
        self._connection = connection

    def message(self, body: bytes) -> None:
        """Handle the answer to a ping; ignore all else."""
        message = jsontext.decode(link.robot_control_decoder, body)
        if isinstance(message, link.Pong):
            self._connection.common_message(message)

    def sample(self, frame: SampleFrame) -> None:
        """Ignored."""

    def video_frame(self, frame: VideoFrame | VideoFramePart) -> None:
        """Ignored."""

    def lost(self, reason: str) -> None:
        """Nothing is left to do."""


_OVERTAKING = (link.Ping, link.Pong, link.Bye, link.Refused)
"""Messages that overtake the queue of a slow link.

A stop is none: it must not overtake a :class:`link.Resume` sent before it, since that would end the stop.
"""

_REQUESTS = (link.CallService, link.SendActionGoal)
_OF_CLIENTS = (*_REQUESTS, link.ServiceResponse, link.ActionResult)
"""Messages whose size and number clients decide."""


class _WholeFrame:
    """A frame that is sent whole."""

    divided = False

    def __init__(self, frame: bytes) -> None:
        self._frame = frame
        self.command = frame[4] == COMMAND

    @property
    def left(self) -> int:
        """Bytes not sent yet."""
        return len(self._frame)

    def take(self, most: int) -> bytes:
        """The whole frame."""
        frame, self._frame = self._frame, b""
        return frame


class _FrameParts(_WholeFrame):
    """A sample or message that is sent in parts (SPEC 2.1), so that commands can go in between."""

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
        """Bytes of the message not sent yet."""
        return len(self._body) - self._at if self._body else super().left

    def take(self, most: int) -> bytes:
        """The next part, or a whole frame that is not divided."""
        if not self._body:
            return super().take(most)
        begun, self._at = self._at, min(len(self._body), self._at + most)
        piece = bytes(self._body[begun : self._at])
        return encode_part(self._number, self._stamp, len(self._body), begun, piece)


def _not_connected(data: bytes) -> None:
    """The writer of the send queue until the connection is made."""


def harden(transport: Any) -> None:
    """Send small messages at once, and let the kernel detect a dead peer where it can."""
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
