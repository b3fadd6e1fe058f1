"""Supervision of the camera process: started for the first stream, restarted after failures, ended without
streams."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import msgspec
from twisted.internet.defer import Deferred, succeed
from twisted.logger import Logger

from relay_protocol.limits import CHANNEL_TICKET_SECONDS
from robot_client.alerts import MODULE, OnAlert, ignore_alert
from robot_client.camera.ipc import (
    CameraSeen,
    CameraSettings,
    CloseStream,
    InhibitTopics,
    LogLine,
    OpenStream,
    StreamAccepted,
    StreamEnded,
    camera_decoder,
    encode,
)
from robot_client.child_process import ChildProcess
from robot_client.twisted_types import DelayedCall

IDLE_SECONDS = 30.0
"""Seconds without a stream after which the process is ended; its start takes a second or two."""

SILENT_SECONDS = 20.0
"""Seconds without a message after which the process counts as frozen; its start may take some."""

CHECK_INTERVAL = 5.0
EXIT_SECONDS = 2.0
"""Seconds in which the process must exit before it is killed."""

RESTART = (0.5, 30.0)
"""Shortest and longest delay before a restart, seconds."""

STEADY = 30.0
"""Seconds after which the end of a process counts as the first failure again."""


class _RequestedStream(NamedTuple):
    """A requested stream, and since when, seconds."""

    request: OpenStream
    since: float


class CameraSupervisor:
    """Opens and closes streams in a process that lives while there are any.

    :param reactor: for processes and timers
    :param settings: first message to the process; after a restart ``settings.node`` gets a suffix
    """

    def __init__(self, reactor: Any, settings: CameraSettings) -> None:
        self.on_seen: Callable[[CameraSeen], None] = _ignore
        self.on_alert: OnAlert = ignore_alert
        self._reactor = reactor
        self._settings = settings
        self._process: ChildProcess | None = None
        self._streams: dict[str, _RequestedStream | None] = {}
        """Streams that the process was asked to open; ``None`` once it has accepted them."""
        self._waiting: dict[str, _RequestedStream] = {}
        self._inhibited: list[str] = []
        self._started = 0
        self._failures = 0
        self._loss_reported = False
        self._started_at = self._last_message = 0.0
        self._check_timer: DelayedCall | None = None
        self._retry_timer: DelayedCall | None = None
        self._idle_timer: DelayedCall | None = None
        self._exit_timer: DelayedCall | None = None
        self._stopped: Deferred[None] | None = None
        self._renewing = False
        self._log = Logger("camera")

    @property
    def pid(self) -> int | None:
        """Id of the process, ``None`` if it is not running."""
        return self._process.transport.pid if self._process is not None else None

    def open(self, request: OpenStream) -> None:
        """Open a stream, as soon as the process runs."""
        if self._stopped is None:
            self._open(_RequestedStream(request, self._reactor.seconds()))

    def _open(self, requested: _RequestedStream) -> None:
        request = requested.request
        _cancel(self._idle_timer)
        self._idle_timer = None
        if self._process is not None and self._exit_timer is None:
            self._streams[request.stream] = requested
            self._process.send(encode(request))
            return
        self._waiting[request.stream] = requested
        if self._process is None and self._retry_timer is None:
            self._start()

    def close(self, stream: str, reason: str) -> None:
        """Close a stream."""
        self._waiting.pop(stream, None)
        if stream in self._streams and self._process is not None:
            self._process.send(encode(CloseStream(stream=stream, reason=reason)))
        self._stream_closed(stream)

    def close_all(self, reason: str) -> None:
        """Close all streams."""
        for stream in {*self._streams, *self._waiting}:
            self.close(stream, reason)

    def inhibit(self, topics: Iterable[str]) -> None:
        """Set the inhibited topics."""
        self._inhibited = sorted(topics)
        if self._process is not None and self._exit_timer is None:
            self._process.send(encode(InhibitTopics(topics=self._inhibited)))

    @property
    def max_streams(self) -> int:
        """Most streams at a time."""
        return self._settings.streams

    def renew(self) -> None:
        """Replace the process by another, whose node finds all others; the relay requests its streams again."""
        if self._process is not None and self._stopped is None:
            self._renewing = True
            self._end_process()

    def stop(self) -> Deferred[None]:
        """End the process; fires when it has exited."""
        self._waiting.clear()
        _cancel(self._retry_timer)
        _cancel(self._idle_timer)
        if self._process is None:
            return succeed(None)
        self._stopped = Deferred()
        self._end_process()
        return self._stopped

    def on_line(self, line: bytes) -> None:
        """Handle a line of the process; lines of libraries in it are ignored."""
        try:
            message = camera_decoder.decode(line)
        except msgspec.MsgspecError:
            return
        self._last_message = self._reactor.seconds()
        self._resolve_loss("the camera process is running again")
        if isinstance(message, CameraSeen):
            self.on_seen(message)
        elif isinstance(message, StreamAccepted):
            if message.stream in self._streams:
                self._streams[message.stream] = None
        elif isinstance(message, StreamEnded):
            self._log.info("stream {name} ended: {reason}", name=message.stream, reason=message.reason)
            # A stream that is not accepted yet was opened again meanwhile: the one before it has ended.
            if self._streams.get(message.stream) is None:
                self._stream_closed(message.stream)
        elif isinstance(message, LogLine):
            {"error": self._log.error, "warn": self._log.warn}.get(message.level, self._log.info)(
                "{text}", text=message.text
            )

    def on_exit(self, reason: str) -> None:
        """Restart the process if it had streams; the relay requests its streams again."""
        self._process = None
        for timer in (self._check_timer, self._exit_timer, self._idle_timer):
            _cancel(timer)
        self._check_timer = self._exit_timer = self._idle_timer = None
        lost, self._streams = self._streams, {}
        if self._stopped is not None:
            self._stopped.callback(None)
            return
        for stream, requested in lost.items():
            if requested is not None:
                self._waiting.setdefault(stream, requested)
        renewing, self._renewing = self._renewing, False
        if lost and not renewing:
            steady = self._reactor.seconds() - self._started_at >= STEADY
            self._failures = 1 if steady else self._failures + 1
            self._loss_reported = True
            text = f"the camera process ended ({reason}); it is restarted when it is needed"
            self.on_alert("error", text, MODULE, "camera")
            shortest, longest = RESTART
            delay = min(longest, shortest * 2 ** min(self._failures - 1, 16))
            self._retry_timer = self._reactor.callLater(delay, self._restart)
        else:
            self._start()

    def _resolve_loss(self, text: str) -> None:
        if self._loss_reported:
            self._loss_reported = False
            self.on_alert("info", text, MODULE, "camera", over=True)

    def _restart(self) -> None:
        self._retry_timer = None
        self._start()

    def _start(self) -> None:
        """Start the process if a stream waits for it."""
        self._started_at = self._last_message = now = self._reactor.seconds()
        self._waiting = {
            name: each for name, each in self._waiting.items() if now - each.since < CHANNEL_TICKET_SECONDS
        }
        if not self._waiting:
            self._resolve_loss("the camera process is not needed any more")
            return
        self._process = process = ChildProcess(self)
        try:
            process.start(self._reactor, ["-m", "robot_client.camera.main"])
        except OSError as error:
            self._streams, self._waiting = dict(self._waiting), {}
            self.on_exit(f"it can't be started: {error.strerror}")
            return
        # DDS remembers a dead node for a while, and would take one of the same name for it.
        node = f"{self._settings.node}_{self._started}" if self._started else self._settings.node
        self._started += 1
        process.send(encode(msgspec.structs.replace(self._settings, node=node)))
        if self._inhibited:
            process.send(encode(InhibitTopics(topics=self._inhibited)))
        self._check_timer = self._reactor.callLater(CHECK_INTERVAL, self._check)
        waiting, self._waiting = self._waiting, {}
        for requested in waiting.values():
            self._open(requested)

    def _check(self) -> None:
        self._check_timer = None
        if self._process is None:
            return
        if self._reactor.seconds() - self._last_message > SILENT_SECONDS:
            self._log.warn("the camera process sends nothing any more; it is killed")
            self._process.kill()
            return
        self._check_timer = self._reactor.callLater(CHECK_INTERVAL, self._check)

    def _stream_closed(self, stream: str) -> None:
        self._streams.pop(stream, None)
        if (
            not self._streams
            and self._process is not None
            and self._idle_timer is None
            and self._exit_timer is None
        ):
            self._idle_timer = self._reactor.callLater(IDLE_SECONDS, self._end_process)

    def _end_process(self) -> None:
        self._idle_timer = None
        if self._process is not None and self._exit_timer is None:
            self._process.close()
            self._exit_timer = self._reactor.callLater(EXIT_SECONDS, self._process.kill)


def _ignore(*what: object) -> None:
    pass


def _cancel(timer: DelayedCall | None) -> None:
    if timer is not None and timer.active():
        timer.cancel()
