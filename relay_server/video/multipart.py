"""MJPEG: one endless response, one frame per part (``multipart/x-mixed-replace``), as web_video_server has
it.

Frames are JPEG, or PNG where that was requested.
"""

from __future__ import annotations

from typing import Any

from twisted.internet.defer import Deferred
from twisted.web.server import Request

from relay_protocol import link
from relay_protocol.errors import Refused, SwitchboardError
from relay_server.common.clock import Clock, PeriodicTimer, PeriodicTimers, Timer, cancel
from relay_server.common.socket_writer import FlushScheduler, TransportWriter, writer_for
from relay_server.common.tcp import PushProducer
from relay_server.video.frames import (
    CHECK_SECONDS,
    CONTENT_TYPES,
    FORWARDED_STALL_SECONDS,
    STALL_SECONDS,
    AckTracker,
    FrameQueue,
    RenderCache,
    VideoFrameInfo,
    limit_send_buffer,
    replace_status,
)

# As in web_video_server: some programs look for it without reading the header.
_BOUNDARY = b"boundarydonotcross"
_MARK = b"--" + _BOUNDARY
_DELIMITER = _MARK + b"\r\n"
CONTENT_TYPE = b"multipart/x-mixed-replace; boundary=" + _BOUNDARY

RETRY_SECONDS = 0.02
"""How often a waiting frame checks whether the one before it has arrived."""

CLOSING_SECONDS = 2.0
"""Seconds in which the last bytes can leave before the connection is aborted. Over TLS the peer has to answer too."""


def part(frame: VideoFrameInfo) -> bytes:
    """One part with the delimiter behind it, since browsers show a part when the next one begins.

    :returns: nothing for a frame that contains the delimiter: browsers look for that instead of the length,
        and the rest would be a part that the robot chooses, served by the relay's own site
    """
    if _MARK in frame.body:
        return b""
    head = b"Content-Type: %b\r\nContent-Length: %d\r\nX-Timestamp: %.6f\r\n%b\r\n" % (
        CONTENT_TYPES[frame.codec],
        len(frame.body),
        frame.stamp,
        b"X-Reduced: %.3f\r\n" % frame.reduced if frame.reduced > 0 else b"",
    )
    return b"".join((head, frame.body, b"\r\n", _DELIMITER))


class Multipart:
    """The response to one request: frames as fast as its connection takes them, until either side ends it.

    :param rendered: of :func:`part`, shared by all streams
    """

    def __init__(
        self,
        clock: Clock,
        timers: PeriodicTimers,
        flushes: FlushScheduler,
        rendered: RenderCache,
        request: Request,
    ) -> None:
        self.done: Deferred[None] = Deferred()
        """Fires when this side closes the connection; fails when there was no frame at all."""
        self._clock = clock
        self._timers = timers
        self._flushes = flushes
        self._rendered = rendered
        self._request = request
        self._transport: Any = request.channel.transport
        forwarded = getattr(request, "forwarded_client", None) is not None
        self._stall_seconds = FORWARDED_STALL_SECONDS if forwarded else STALL_SECONDS
        self._tcp: Any = None
        self._acks = AckTracker(None, clock.seconds)
        self._writer: TransportWriter | None = None
        self._queue = FrameQueue(clock.seconds)
        self._check_timer = PeriodicTimer(self._check, CHECK_SECONDS)
        self._full = False
        self._retry: Timer | None = None

    # --- FrameSink -----------------------------------------------------------------------------------------

    def frame_received(self, frame: VideoFrameInfo) -> None:
        self._queue.put(frame)
        self._send()

    def status_changed(self, playing: link.StreamStatus) -> None:
        """Ignored: each frame has headers with its own parameters."""

    def settings_differ(self, other: dict[str, Any]) -> None:
        """Set the header; it cannot change once it is sent."""
        if self._writer is None:
            replace_status(self._request, other)

    def ended(self, error: SwitchboardError) -> None:
        """Fails with the error if nothing was sent yet; otherwise the connection ends."""
        if self._writer is not None:
            # A revoked right ends the frame that is being sent too.
            self._close(abort=self._full and isinstance(error, Refused))
        elif not self.done.called:
            self.done.errback(error)

    def disconnected(self) -> None:
        """The client has left, or got an error."""
        self._stop_timers()

    # --- Pausable -----------------------------------------------------------------------------------------

    def pause(self) -> None:
        self._full = True
        self._acks.sent()

    def resume(self) -> None:
        self._full = False
        self._send()

    # --- the connection -----------------------------------------------------------------------------------

    def _send(self) -> None:
        if self._full or self.done.called or not self._queue:
            return
        if self._acks.in_flight:
            # Twisted has nothing left of it, but the network may have seconds of it.
            if self._retry is None:
                self._retry = self._clock.callLater(RETRY_SECONDS, self._send_again)
            return
        for frame in self._queue.take():
            rendered = self._rendered.rendered(frame)
            if not rendered:
                continue
            writer = self._writer or self._begin()
            # TLS takes everything, and reports only one turn later that something is left.
            self._full = self._tcp is not None and self._tcp is not self._transport
            writer.write(rendered)
            # Whether the socket takes it decides which frame is next, so it is tried at once.
            writer.flush()
            self._acks.sent()

    def _send_again(self) -> None:
        self._retry = None
        self._send()

    def _begin(self) -> TransportWriter:
        """Write the head of the response. Not by :meth:`Request.write`, which would make a chunk of each
        part."""
        request, channel = self._request, self._request.channel
        self._tcp = limit_send_buffer(self._transport)
        self._acks = AckTracker(self._tcp, self._clock.seconds)
        if self._tcp is not None:
            # A frame is taken when nothing of it is left, so one byte counts as full.
            self._tcp.bufferSize = 0
        writer = self._writer = writer_for(self._transport, self._flushes)
        request.registerProducer(PushProducer(self), True)
        request.startedWriting = 1
        channel.persistent = False
        request.setHeader(b"connection", b"close")
        channel.writeHeaders(b"HTTP/1.1", b"200", b"OK", request.responseHeaders)
        writer.write(_DELIMITER)
        self._timers.start(self._check_timer)
        return writer

    def _check(self) -> None:
        stands = self._acks.stalled_for()
        if stands >= self._stall_seconds and (self._full or self._acks.in_flight):
            self._close(abort=True)

    def _stop_timers(self) -> None:
        self._check_timer.stop()
        cancel(self._retry)
        self._retry = None

    def _close(self, abort: bool) -> None:
        """End the connection.

        :param abort: drop unsent bytes
        """
        if self.done.called:
            return
        self._stop_timers()
        self._request.unregisterProducer()
        if abort:
            self._transport.abortConnection()
        else:
            self._request.channel.loseConnection()
            leaving = self._clock.callLater(CLOSING_SECONDS, self._transport.abortConnection)
            # A TLS connection that is gone cannot be aborted.
            self._request.notifyFinish().addErrback(lambda _: cancel(leaving))
        self.done.callback(None)
