"""MJPEG: one answer that never ends, a picture a part (``multipart/x-mixed-replace``), as web_video_server has it.

The pictures are JPEG, or PNG where that was asked for.
"""

from __future__ import annotations

from typing import Any

from twisted.internet.defer import Deferred
from twisted.web.server import Request

from relay_protocol import link
from relay_protocol.errors import Refused, SwitchboardError
from relay_server.common.clock import Clock, Timer, cancel
from relay_server.common.push_producer import PushProducer
from relay_server.common.socket_writer import FlushScheduler, TransportWriter, writer_for
from relay_server.common.timers import PeriodicTimer, PeriodicTimers
from relay_server.video.frames import VideoFrameInfo
from relay_server.video.viewing import (
    CONTENT_TYPES,
    LOOK_SECONDS,
    STALL_SECONDS,
    AckTracker,
    FrameQueue,
    RenderCache,
    limit_send_buffer,
    replace_status,
)

# That of web_video_server: some programs look for it without reading the header.
_BOUNDARY = b"boundarydonotcross"
_MARK = b"--" + _BOUNDARY
_DELIMITER = _MARK + b"\r\n"
CONTENT_TYPE = b"multipart/x-mixed-replace; boundary=" + _BOUNDARY

AGAIN_SECONDS = 0.02
"""How often it is looked whether the last picture has arrived, while another one waits for that."""

LEAVING_SECONDS = 2.0
"""What was sent before the end has so long to go out; over TLS the peer, too, has to say something."""


def part(picture: VideoFrameInfo) -> bytes:
    """One part, and the delimiter behind it: browsers show a part when the next begins.

    :returns: nothing for a picture that holds the delimiter: browsers look for that, not at the length, and what
        follows it would be a part as the robot likes it, of the relay's own site
    """
    if _MARK in picture.body:
        return b""
    head = b"Content-Type: %b\r\nContent-Length: %d\r\nX-Timestamp: %.6f\r\n%b\r\n" % (
        CONTENT_TYPES[picture.codec],
        len(picture.body),
        picture.stamp,
        b"X-Reduced: %.3f\r\n" % picture.reduced if picture.reduced > 0 else b"",
    )
    return b"".join((head, picture.body, b"\r\n", _DELIMITER))


class Multipart:
    """The answer to one request: pictures as its connection takes them, until either side ends it.

    :param made: of :func:`part`, shared by all streams
    """

    def __init__(
        self, clock: Clock, rounds: PeriodicTimers, turns: FlushScheduler, made: RenderCache, request: Request
    ) -> None:
        self.done: Deferred[None] = Deferred()
        """Fires when the connection is closed from here; fails when there was nothing to see at all."""
        self._clock = clock
        self._rounds = rounds
        self._turns = turns
        self._made = made
        self._request = request
        self._transport: Any = request.channel.transport
        self._tcp: Any = None
        self._progress = AckTracker(None, clock.seconds)
        self._writer: TransportWriter | None = None
        self._waiting = FrameQueue(clock.seconds)
        self._round = PeriodicTimer(self._look, LOOK_SECONDS)
        self._full = False
        self._again: Timer | None = None

    # --- Screen -------------------------------------------------------------------------------------------

    def picture(self, picture: VideoFrameInfo) -> None:
        """It goes now, or when the last has been taken, unless another comes before."""
        self._waiting.put(picture)
        self._send()

    def playing(self, playing: link.Playing) -> None:
        """What they are like the pictures say themselves."""

    def instead(self, other: dict[str, Any]) -> None:
        """The head of the answer tells it; afterwards it can't be told any more."""
        if self._writer is None:
            replace_status(self._request, other)

    def ended(self, error: SwitchboardError) -> None:
        """In words if nothing was sent yet; else the connection says it by its end."""
        if self._writer is not None:
            # A right that is gone is gone for the rest of a picture too.
            self._close(abort=self._full and isinstance(error, Refused))
        elif not self.done.called:
            self.done.errback(error)

    def gone(self) -> None:
        """The client has left, or was told why there is nothing to see."""
        self._rest()

    # --- Pausable -----------------------------------------------------------------------------------------

    def pause(self) -> None:
        """Something is left of what was written."""
        self._full = True
        self._progress.sent()

    def resume(self) -> None:
        """All that was written has gone."""
        self._full = False
        self._send()

    # --- the connection -----------------------------------------------------------------------------------

    def _send(self) -> None:
        if self._full or self.done.called or not self._waiting:
            return
        if self._progress.under_way:
            # Twisted has nothing left of it, but the network may have seconds.
            if self._again is None:
                self._again = self._clock.callLater(AGAIN_SECONDS, self._look_again)
            return
        for picture in self._waiting.take():
            made = self._made.of(picture)
            if not made:
                continue
            writer = self._writer or self._begin()
            # TLS takes what it is given, and says only a turn later that it has something left.
            self._full = self._tcp is not None and self._tcp is not self._transport
            writer.write(made)
            # Whether the socket takes it decides which picture is next, so it is tried at once.
            writer.flush()
            self._progress.sent()

    def _look_again(self) -> None:
        self._again = None
        self._send()

    def _begin(self) -> TransportWriter:
        """The head of the answer. Not by :meth:`Request.write`, which would make a chunk of each part."""
        request, channel = self._request, self._request.channel
        self._tcp = limit_send_buffer(self._transport)
        self._progress = AckTracker(self._tcp, self._clock.seconds)
        if self._tcp is not None:
            # A picture is taken when nothing of it is left, so one byte is as full as many.
            self._tcp.bufferSize = 0
        writer = self._writer = writer_for(self._transport, self._turns)
        request.registerProducer(PushProducer(self), True)
        request.startedWriting = 1
        channel.persistent = False
        request.setHeader(b"connection", b"close")
        channel.writeHeaders(b"HTTP/1.1", b"200", b"OK", request.responseHeaders)
        writer.write(_DELIMITER)
        self._rounds.start(self._round)
        return writer

    def _look(self) -> None:
        stands = self._progress.stands()
        if stands >= STALL_SECONDS and (self._full or self._progress.under_way):
            self._close(abort=True)

    def _rest(self) -> None:
        self._round.stop()
        cancel(self._again)
        self._again = None

    def _close(self, abort: bool) -> None:
        """End the connection.

        :param abort: what was not taken yet goes no more
        """
        if self.done.called:
            return
        self._rest()
        self._request.unregisterProducer()
        if abort:
            self._transport.abortConnection()
        else:
            self._request.channel.loseConnection()
            leaving = self._clock.callLater(LEAVING_SECONDS, self._transport.abortConnection)
            # A connection by TLS that is gone can't be aborted.
            self._request.notifyFinish().addErrback(lambda _: cancel(leaving))
        self.done.callback(None)
