"""A websocket that takes no more memory and time than it must, whatever the client sends or does not take.

Autobahn speaks RFC 6455; here is what it leaves open or does otherwise.
"""

from __future__ import annotations

import functools
from typing import Any, Protocol

from autobahn.websocket.protocol import TrafficStats
from autobahn.websocket.utf8validator import Utf8Validator
from twisted.internet.protocol import connectionDone
from twisted.internet.tcp import Server

from relay_server.common.clock import Clock, Timer, cancel
from relay_server.common.push_producer import PushProducer
from relay_server.common.socket_writer import FlushScheduler, TransportWriter, writer_for
from relay_server.common.tcp import tcp_of
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
)
"""Attributes of Autobahn that an open websocket does not need; its validator is made again for the first fragment."""

PIECES = 16_384
"""Frames of one message, and chunks they came in: also the empty ones take memory."""

LEAVING_SECONDS = 2.0
"""What was sent before the end has so long to go out; a client that takes nothing would stay for ever."""

REASON_BYTES = 123
"""Room for words in a close frame (RFC 6455 section 5.5.1)."""


class Shared(Protocol):
    """What the websockets of one listening port have in common."""

    clock: Clock
    turns: FlushScheduler
    traffic: TrafficStats


class BoundedProtocol(FastProtocol):
    """See the module's text. How large a message may be is for the subclass to say."""

    factory: Shared
    _writer: TransportWriter

    def __init__(self) -> None:
        super().__init__()
        self._leaving: Timer | None = None
        self._full = False
        self._unanswered: bytes | None = None

    @functools.cached_property
    def utf8validator(self) -> Utf8Validator:
        """The state of a fragmented text message; most connections never send one."""
        return Utf8Validator()

    def connectionMade(self) -> None:
        """The site has handed over a connection that asked to become a websocket."""
        self._writer = writer_for(self.transport, self.factory.turns)
        super().connectionMade()

    def connectionLost(self, reason: Any = connectionDone) -> None:
        """The connection that began as an HTTP request is gone."""
        cancel(self._leaving)
        super().connectionLost(reason)

    def take_at_most(self, size: int) -> None:
        """A message may have so many bytes."""
        self.maxFramePayloadSize = self.maxMessagePayloadSize = size

    def begun(self) -> None:
        """The handshake is done: what was for it is let go, and the transport's fullness is minded here."""
        # Kilobytes for every client that nobody reads any more.
        for name in HANDSHAKE_ATTRIBUTES:
            self.__dict__.pop(name, None)
        # Of these every connection has its own: figures nobody asks for, and a queue for writes that are held back
        # (they go through the writer).
        self.trafficStats = self.factory.traffic
        self.send_queue = None
        # Twisted's HTTP channel was the producer of this transport until now, and its buffer was that of a stranger.
        tcp = tcp_of(self.transport)
        if tcp is not None:
            vars(tcp).pop("bufferSize", None)
        self.transport.unregisterProducer()
        self.transport.registerProducer(PushProducer(self), True)

    # --- what comes ---------------------------------------------------------------------------------------

    def onMessageFrameBegin(self, length: int) -> None:
        """One more frame of a message."""
        super().onMessageFrameBegin(length)
        self._check_pieces()

    def onMessageFrameData(self, payload: bytes) -> None:
        """One more piece of it."""
        super().onMessageFrameData(payload)
        self._check_pieces()

    def _check_pieces(self) -> None:
        pieces = len(self.message_data) + len(self.frame_data)
        if pieces > PIECES and not self.failedByMe:
            self.wasMaxMessagePayloadSizeExceeded = True
            self._max_message_size_exceeded(pieces, PIECES, f"a message came in more than {PIECES} pieces")

    def _invalid_payload(self, reason: str) -> bool:
        """Fail the connection once a message, so that the client can answer the close frame.

        Autobahn finds the end of invalid text invalid too. It drops the connection for that, and the close frame with
        it, if the kernel still holds unread bytes of the client.
        """
        return bool(self.state == self.STATE_OPEN and super()._invalid_payload(reason))

    def onPing(self, payload: bytes) -> None:
        """A ping of the client. One that takes nothing gets the latest answered when it does again.

        RFC 6455 section 5.5.3 allows that; the answers to a flood of pings must not pile up here.
        """
        if self._full:
            self._unanswered = payload
        else:
            super().onPing(payload)

    def pause(self) -> None:
        """The transport's buffer is full."""
        self._full = True

    def resume(self) -> None:
        """The transport takes bytes again."""
        self._full = False
        unanswered, self._unanswered = self._unanswered, None
        if unanswered is not None:
            self.onPing(unanswered)

    # --- what goes ----------------------------------------------------------------------------------------

    def nothing_more(self) -> None:
        """Nothing may follow a close frame (RFC 6455 section 5.5.1): whoever writes past Autobahn must cease now."""

    def sendData(self, data: bytes, sync: bool = False, chopsize: int | None = None) -> None:
        """What Autobahn itself sends, in order with what does not go through it: after the handshake control frames
        only, which may go between the frames of a message (RFC 6455 section 5.4).
        """
        self._writer.urgent(data)

    def say_close(self, code: int, reason: str) -> None:
        """Send a close frame, with as much of the reason as there is room for."""
        text = reason.encode()[:REASON_BYTES].decode(errors="ignore")
        # Autobahn's sendClose takes no code that RFC 6455 itself defines, such as 1001 and 1009.
        self.sendCloseFrame(code=code, reasonUtf8=text.encode(), isReply=False)

    def sendCloseFrame(
        self, code: int | None = None, reasonUtf8: bytes | None = None, isReply: bool = False
    ) -> None:
        """Our close, or the answer to the client's."""
        super().sendCloseFrame(code, reasonUtf8, isReply)
        self.nothing_more()

    def dataReceived(self, data: bytes) -> None:
        """Bytes. Nothing is read any more once the connection ends."""
        if self._leaving is None:
            super().dataReceived(data)

    def _closeConnection(self, abort: bool = False) -> None:
        self.nothing_more()
        self._writer.flush()
        # TLS would not shut down while a producer is registered.
        self.transport.unregisterProducer()
        if abort or self._leaving is not None:
            super()._closeConnection(abort)
            return
        self._leaving = self.factory.clock.callLater(LEAVING_SECONDS, self.transport.abortConnection)
        if type(self.transport) is Server and not self.transport.TLS:
            # What the client still sends, as answers to pings, would have the kernel reset a connection that is closed
            # both ways, and the close frame would be lost where the line is thin.
            self.transport.loseWriteConnection()
        else:
            super()._closeConnection(abort)
