"""The daemon's side of its camera process: started when pictures are wanted, started again, ended when they are not."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import msgspec
from twisted.internet.defer import Deferred, succeed
from twisted.logger import Logger

from relay_protocol.limits import CHANNEL_TICKET_SECONDS
from robot_client.alerts import MODULE, OnAlert, nobody
from robot_client.camera.ipc import (
    CameraSeen,
    CameraSettings,
    CloseStream,
    LogLine,
    NoFrames,
    OpenStream,
    StreamAccepted,
    StreamEnded,
    answer_decoder,
    encode,
)
from robot_client.child import Child
from robot_client.twisted_types import DelayedCall

IDLE = 30.0
"""Seconds without a stream after which the process leaves: starting one takes a second or two."""

SILENT = 20.0
"""Seconds without a word after which it is taken for frozen; its start may take some."""

LOOK_EVERY = 5.0
LEAVE = 2.0
RESTART = (0.5, 30.0)
STEADY = 30.0
"""Seconds a process has to live for its end not to count as one more failure."""


class _WantedStream(NamedTuple):
    """A stream the relay wants, and since when, seconds."""

    line: OpenStream
    since: float


class CameraSupervisor:
    """Opens and closes streams in a process that is there while there are any.

    :param reactor: for processes and timers
    :param settings: its first line; nodes of later processes have names that begin with ``settings.node``
    """

    def __init__(self, reactor: Any, settings: CameraSettings) -> None:
        self.on_seen: Callable[[CameraSeen], None] = _ignored
        self.on_alert: OnAlert = nobody
        self._reactor = reactor
        self._settings = settings
        self._process: Child | None = None
        self._streams: dict[str, _WantedStream | None] = {}
        """What the process was told; ``None`` once it has taken note."""
        self._waiting: dict[str, _WantedStream] = {}
        self._silent: list[str] = []
        self._started = 0
        self._failures = 0
        self._missed = False
        """Whether people were told that it is gone."""
        self._began = self._heard = 0.0
        self._look: DelayedCall | None = None
        self._retry: DelayedCall | None = None
        self._idle: DelayedCall | None = None
        self._leaving: DelayedCall | None = None
        self._stopped: Deferred[None] | None = None
        self._log = Logger("camera")

    @property
    def pid(self) -> int | None:
        """Process that lives now."""
        return self._process.transport.pid if self._process is not None else None

    def open(self, line: OpenStream) -> None:
        """Have a stream; one that has to wait for the process waits."""
        if self._stopped is None:
            self._want(_WantedStream(line, self._reactor.seconds()))

    def _want(self, wanted: _WantedStream) -> None:
        line = wanted.line
        _cancel(self._idle)
        self._idle = None
        if self._process is not None and self._leaving is None:
            self._streams[line.stream] = wanted
            self._process.tell(encode(line))
            return
        self._waiting[line.stream] = wanted
        if self._process is None and self._retry is None:
            self._start()

    def close(self, stream: str, why: str) -> None:
        """Have it no more."""
        self._waiting.pop(stream, None)
        if stream in self._streams and self._process is not None:
            self._process.tell(encode(CloseStream(stream=stream, why=why)))
        self._gone(stream)

    def close_all(self, why: str) -> None:
        """Have none any more."""
        for stream in {*self._streams, *self._waiting}:
            self.close(stream, why)

    def silence(self, topics: Iterable[str]) -> None:
        """Let these topics say nothing, and all others speak."""
        self._silent = sorted(topics)
        if self._process is not None and self._leaving is None:
            self._process.tell(encode(NoFrames(topics=self._silent)))

    @property
    def most(self) -> int:
        """Streams the process makes at a time."""
        return self._settings.streams

    def stop(self) -> Deferred[None]:
        """Let the process leave; fires when it has."""
        self._waiting.clear()
        _cancel(self._retry)
        _cancel(self._idle)
        if self._process is None:
            return succeed(None)
        self._stopped = Deferred()
        self._leave()
        return self._stopped

    def heard(self, line: bytes) -> None:
        """The process said something, or something in it wrote where it speaks."""
        try:
            answer = answer_decoder.decode(line)
        except msgspec.MsgspecError:
            return
        self._heard = self._reactor.seconds()
        self._missed_no_more("the camera process is there again")
        if isinstance(answer, CameraSeen):
            self.on_seen(answer)
        elif isinstance(answer, StreamAccepted):
            if answer.stream in self._streams:
                self._streams[answer.stream] = None
        elif isinstance(answer, StreamEnded):
            self._log.info("stream {name} ended: {why}", name=answer.stream, why=answer.why)
            # What was not taken yet is a stream opened anew meanwhile: it is the one before that has ended.
            if self._streams.get(answer.stream) is None:
                self._gone(answer.stream)
        elif isinstance(answer, LogLine):
            {"error": self._log.error, "warn": self._log.warn}.get(answer.level, self._log.info)(
                "{text}", text=answer.text
            )

    def lost(self, why: str) -> None:
        """The process is gone. What it showed the relay asks for again."""
        self._process = None
        for timer in (self._look, self._leaving, self._idle):
            _cancel(timer)
        self._look = self._leaving = self._idle = None
        lost, self._streams = self._streams, {}
        if self._stopped is not None:
            self._stopped.callback(None)
            return
        for stream, wanted in lost.items():
            if wanted is not None:
                self._waiting.setdefault(stream, wanted)
        if lost:
            steady = self._reactor.seconds() - self._began >= STEADY
            self._failures = 1 if steady else self._failures + 1
            self._missed = True
            text = f"the camera process is gone ({why}); it is started again when it is needed"
            self.on_alert("error", text, MODULE, "camera")
            least, most = RESTART
            delay = min(most, least * 2 ** min(self._failures - 1, 16))
            self._retry = self._reactor.callLater(delay, self._start_again)
        else:
            self._start()

    def _missed_no_more(self, text: str) -> None:
        if self._missed:
            self._missed = False
            self.on_alert("info", text, MODULE, "camera", over=True)

    def _start_again(self) -> None:
        self._retry = None
        self._start()

    def _start(self) -> None:
        """Have a process, if there is anything for it to show."""
        self._began = self._heard = now = self._reactor.seconds()
        self._waiting = {
            name: each for name, each in self._waiting.items() if now - each.since < CHANNEL_TICKET_SECONDS
        }
        if not self._waiting:
            self._missed_no_more("the camera process is not needed any more")
            return
        self._process = process = Child(self)
        try:
            process.start(self._reactor, ["-m", "robot_client.camera.main"])
        except OSError as error:
            self._streams, self._waiting = dict(self._waiting), {}
            self.lost(f"it can't be started: {error.strerror}")
            return
        # The network remembers a dead node for a while; one of the same name would be mistaken for it.
        node = f"{self._settings.node}_{self._started}" if self._started else self._settings.node
        self._started += 1
        process.tell(encode(msgspec.structs.replace(self._settings, node=node)))
        if self._silent:
            process.tell(encode(NoFrames(topics=self._silent)))
        self._look = self._reactor.callLater(LOOK_EVERY, self._watch)
        waiting, self._waiting = self._waiting, {}
        for wanted in waiting.values():
            self._want(wanted)

    def _watch(self) -> None:
        self._look = None
        if self._process is None:
            return
        if self._reactor.seconds() - self._heard > SILENT:
            self._log.warn("the camera process says nothing any more; it is ended")
            self._process.kill()
            return
        self._look = self._reactor.callLater(LOOK_EVERY, self._watch)

    def _gone(self, stream: str) -> None:
        self._streams.pop(stream, None)
        if not self._streams and self._process is not None and self._idle is None and self._leaving is None:
            self._idle = self._reactor.callLater(IDLE, self._leave)

    def _leave(self) -> None:
        self._idle = None
        if self._process is not None and self._leaving is None:
            self._process.leave()
            self._leaving = self._reactor.callLater(LEAVE, self._process.kill)


def _ignored(*what: object) -> None:
    pass


def _cancel(timer: DelayedCall | None) -> None:
    if timer is not None and timer.active():
        timer.cancel()
