"""Websocket with bounded memory and time, whatever the client sends or does not read.

Autobahn implements RFC 6455; :class:`BoundedProtocol` adds bounds, and an orderly end of the connection.
"""

from __future__ import annotations

import functools
from typing import Any, Protocol

from autobahn.websocket.protocol import TrafficStats
from autobahn.websocket.utf8validator import Utf8Validator
from twisted.internet.protocol import connectionDone
from twisted.internet.tcp import Server

from relay_server.common import close_codes
from relay_server.common.clock import Clock, Timer, cancel
from relay_server.common.socket_writer import FlushScheduler, TransportWriter, writer_for
from relay_server.common.tcp import PushProducer, tcp_of
from relay_server.common.unfinished import PIECE_OVERHEAD, UnfinishedCount, time_limit
from relay_server.ws.fast_receive import FastProtocol

HANDSHAKE_ATTRIBUTES = (
    "http_headers",
    "http_request_data",
    "http_request_host",
    "http_request_params",
    "http_request_path",
    "http_request_uri",
    "http_response_data",
    "http_status_line",
    "utf8validator",
    "_transport_details",
    "_wskey",
    "websocket_extensions",
    "websocket_origin",
    "websocket_protocols",
)
"""Attributes of Autobahn that an open websocket does not need. The first fragment makes a validator again."""

MAX_PIECES = 16_384
"""Most frames of one message, and chunks of frames, together; empty ones take memory too."""

SMALL_PART = 4096
"""Parts of a frame with fewer bytes are joined."""

CLOSE_SECONDS = 2.0
"""Seconds until a closed connection is aborted if the client has not read what was sent."""

SLOW_CLOSE_SECONDS = 20.0
"""The same for a client that was closed because it reads nothing: only when it reads again it can learn why."""

REASON_BYTES = 123
"""Most bytes of the reason in a close frame (RFC 6455 section 5.5.1)."""


class BoundedFactory(Protocol):
    """The factory: what the websockets of one listening port share."""

    clock: Clock
    flushes: FlushScheduler
    traffic: TrafficStats


class BoundedProtocol(FastProtocol):
    """A websocket with bounds; the subclass sets the largest message."""

    factory: BoundedFactory
    _writer: TransportWriter
    inside_message = False
    """Autobahn's: whether some frames of a message have come, and not all."""
    unfinished: UnfinishedCount | None = None
    """Counts bytes of unfinished messages; ``None`` before authentication, where few are taken."""
    _unfinished_bytes = 0
    """Bytes that the unfinished message counts for."""
    _begun = 0.0
    """Seconds of the clock at which it began."""
    _message_timer: Timer | None = None
    """Runs from the first unfinished message, so that there is no timer for each."""

    def __init__(self) -> None:
        super().__init__()
        self._abort_timer: Timer | None = None
        self._buffer_full = False
        self._pending_ping: bytes | None = None

    def sendHttpErrorResponse(
        self, code: int, reason: str, responseHeaders: list[tuple[str, str]] | None = None
    ) -> None:
        """Refuse the handshake. Reasons may quote the request, so only printable characters reach the status line."""
        printable = "".join(each if each.isprintable() else "?" for each in reason)
        super().sendHttpErrorResponse(code, printable, responseHeaders)

    @functools.cached_property
    def utf8validator(self) -> Utf8Validator:
        """Made for the first fragmented text message; most connections never send one."""
        return Utf8Validator()

    def connectionMade(self) -> None:
        """The site has passed on a connection that requested a websocket."""
        self._writer = writer_for(self.transport, self.factory.flushes)
        super().connectionMade()

    def connectionLost(self, reason: Any = connectionDone) -> None:
        """The connection that began as an HTTP request is gone."""
        cancel(self._abort_timer)
        super().connectionLost(reason)
        # The connection may be part of a cycle, which is freed much later.
        self._drop_unfinished()
        self._unread = None
        self.data = b""
        cancel(self._message_timer)
        if self.unfinished is not None:
            self.unfinished.close()

    def limit_message_size(self, size: int) -> None:
        """Set the most bytes of a message."""
        self.maxFramePayloadSize = self.maxMessagePayloadSize = size

    def handshake_done(self) -> None:
        """Drop what only the handshake needed, and watch the transport's buffer from now on."""
        # They take kilobytes for each client.
        for name in HANDSHAKE_ATTRIBUTES:
            self.__dict__.pop(name, None)
        # A dictionary never shrinks, and the attributes of a session would have it grow to twice its size.
        self.__dict__ = dict(self.__dict__)
        # Autobahn makes both for each connection: figures that are not used, and a queue in place of which the writer
        # is used.
        self.trafficStats = self.factory.traffic
        self.send_queue = None
        # Until now Twisted's HTTP channel was the producer, with the small buffer of an unauthenticated connection.
        tcp = tcp_of(self.transport)
        if tcp is not None:
            vars(tcp).pop("bufferSize", None)
        self.transport.unregisterProducer()
        self.transport.registerProducer(PushProducer(self), True)

    # --- receiving ----------------------------------------------------------------------------------------

    def onMessageFrameBegin(self, length: int) -> None:
        """A frame of a message begins."""
        super().onMessageFrameBegin(length)
        self._check_pieces()
        # A last frame that has arrived whole is not held.
        if (self._passing_left or not self.current_frame.fin) and not self.failedByMe:
            self.hold(length)

    def onMessageEnd(self) -> None:
        """All frames of a message have come."""
        if self._unfinished_bytes:
            self.release()
        super().onMessageEnd()

    def onMessageFrameData(self, payload: bytes) -> None:
        """A part of a frame has come. Small parts are joined: a client's network may send few bytes at a time."""
        super().onMessageFrameData(payload)
        parts: list[Any] = self.frame_data
        if len(payload) < SMALL_PART and len(parts) > 1:
            small = parts.pop()
            if isinstance(parts[-1], bytearray):
                parts[-1] += small
            else:
                parts.append(bytearray(small))
        self._check_pieces()

    def _check_pieces(self) -> None:
        pieces = len(self.message_data) + len(self.frame_data)
        if pieces > MAX_PIECES and not self.failedByMe:
            self.wasMaxMessagePayloadSizeExceeded = True
            self._max_message_size_exceeded(
                pieces, MAX_PIECES, f"a message came in more than {MAX_PIECES} pieces"
            )

    def hold(self, size: int) -> bool:
        """Count a frame of an unfinished message; false if its user has too many bytes, so the connection fails."""
        if self.unfinished is None:
            return True
        size += PIECE_OVERHEAD
        if not self.unfinished.take(size):
            self._fail_unfinished(close_codes.TOO_BIG, self.unfinished.refusal)
            return False
        if not self._unfinished_bytes:
            self._begun = self.factory.clock.seconds()
        self._unfinished_bytes += size
        if self._message_timer is None:
            self._message_timer = self.factory.clock.callLater(time_limit(0), self._check_time)
        return True

    def release(self) -> None:
        """The message is complete, or dropped."""
        if self._unfinished_bytes and self.unfinished is not None:
            self.unfinished.give_back(self._unfinished_bytes)
        self._unfinished_bytes = 0

    def _check_time(self) -> None:
        self._message_timer = None
        if not self._unfinished_bytes or self.state != self.STATE_OPEN:
            return
        now, limit = self.factory.clock.seconds(), time_limit(self._unfinished_bytes)
        if now < self._begun + limit:
            self._message_timer = self.factory.clock.callLater(self._begun + limit - now, self._check_time)
        else:
            self._fail_unfinished(close_codes.TOO_SLOW, f"a message was not finished within {limit:.0f} s")

    def _fail_unfinished(self, code: int, reason: str) -> None:
        self._fail_connection(code, reason)
        frame = self._drop_unfinished()
        if frame is not None:
            # Autobahn keeps nothing more of a connection that has failed, but it must know where the frame ends.
            self._all_to_autobahn(bytes(frame), 0)

    def _drop_unfinished(self) -> bytearray | None:
        """Drop what has come of a message; returns the part of a frame that Autobahn has not read."""
        if self.inside_message:
            self.message_data: list[bytes] = []
            self.frame_data: list[bytes] = []
        frame = None
        if self._holding_frame:
            frame, self._unread = self._unread, None
            self._holding_frame = False
        self.release()
        return frame

    def _invalid_payload(self, reason: str) -> bool:
        """Fail the connection once for a message, so that the client can answer the close frame.

        Autobahn finds the end of invalid text invalid too, and then drops the connection. The close frame is lost with
        it if the kernel still holds unread bytes of the client.
        """
        return bool(self.state == self.STATE_OPEN and super()._invalid_payload(reason))

    def onPing(self, payload: bytes) -> None:
        """Answer a ping. While the buffer is full only the newest waits to be answered (RFC 6455 section 5.5.3).

        So answers to a flood of pings do not pile up here.
        """
        if self._buffer_full:
            self._pending_ping = payload
        else:
            super().onPing(payload)

    def pause(self) -> None:
        """The transport's buffer is full."""
        self._buffer_full = True

    def resume(self) -> None:
        """The transport takes bytes again."""
        self._buffer_full = False
        ping, self._pending_ping = self._pending_ping, None
        if ping is not None:
            self.onPing(ping)

    # --- sending ------------------------------------------------------------------------------------------

    def stop_sending(self) -> None:
        """Stop code that writes past Autobahn: nothing may follow a close frame (RFC 6455 section 5.5.1)."""

    def sendData(self, data: bytes, sync: bool = False, chopsize: int | None = None) -> None:
        """Send bytes of Autobahn in order with those that are written past it.

        After the handshake these are control frames, which may go between the frames of a message (RFC 6455 section
        5.4).
        """
        self._writer.write_beyond_budget(data)

    def send_close(self, code: int, reason: str) -> None:
        """Send a close frame; the reason is cut to :data:`REASON_BYTES`."""
        if code == close_codes.TOO_SLOW:
            self.closeHandshakeTimeout = SLOW_CLOSE_SECONDS
        text = reason.encode()[:REASON_BYTES].decode(errors="ignore")
        # Autobahn's sendClose takes no code that RFC 6455 itself defines, such as 1001 and 1009.
        self.sendCloseFrame(code=code, reasonUtf8=text.encode(), isReply=False)

    def sendCloseFrame(
        self, code: int | None = None, reasonUtf8: bytes | None = None, isReply: bool = False
    ) -> None:
        """Send a close frame, the relay's own or the answer to the client's."""
        super().sendCloseFrame(code, reasonUtf8, isReply)
        self.stop_sending()

    def dataReceived(self, data: bytes) -> None:
        """Read bytes unless the connection is being closed."""
        if self._abort_timer is None:
            super().dataReceived(data)

    def _closeConnection(self, abort: bool = False) -> None:
        self.stop_sending()
        self._writer.flush()
        # TLS would not shut down while a producer is registered.
        self.transport.unregisterProducer()
        if abort or self._abort_timer is not None:
            super()._closeConnection(abort)
            return
        self._abort_timer = self.factory.clock.callLater(CLOSE_SECONDS, self.transport.abortConnection)
        if type(self.transport) is Server and not self.transport.TLS:
            # Half-closed: were it closed both ways, the kernel would reset it for bytes that the client still sends,
            # such as pongs, and on a slow link the close frame would be lost.
            self.transport.loseWriteConnection()
        else:
            super()._closeConnection(abort)
