"""One camera while somebody watches it: its newest picture, for every stream that wants it."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Protocol

from relay_protocol.errors import Invalid
from relay_protocol.limits import LABEL
from robot_client.camera.lines import Seen
from robot_client.camera.shot import Shot
from robot_client.reactors import Clock, Timer

LOOK_EVERY = 1.0
"""Seconds between two looks at what the camera gives."""

_STEADY = 0.1
"""Part by which a rate may waver without being told anew."""


class Closes(Protocol):
    """What gives the pictures."""

    def close(self) -> None:
        """Give no more."""


class Feed:
    """Hands a camera's pictures from its thread to the reactor's, the newest alone.

    :param camera: its name
    :param from_thread: of the reactor, to call there
    :param on_seen: told what the pictures are like, when that changes
    """

    def __init__(
        self,
        camera: str,
        clock: Clock,
        from_thread: Callable[[Callable[[], None]], object],
        on_seen: Callable[[Seen], None],
    ) -> None:
        self.camera = camera
        self.source: Closes
        self.fps = 0.0
        """Pictures per second, as they came of late."""
        self.listeners: set[Callable[[Shot], None]] = set()
        self._clock = clock
        self._from_thread = from_thread
        self._on_seen = on_seen
        self._lock = threading.Lock()
        self._newest: Shot | None = None
        self._count = 0
        self._latest: Shot | None = None
        self._seen: Seen | None = None
        self._looked = clock.seconds()
        self._timer: Timer = clock.callLater(LOOK_EVERY, self._look)

    def put(self, shot: Shot) -> None:
        """A picture came; from any thread."""
        with self._lock:
            waiting = self._newest is not None
            self._newest = shot
            self._count += 1
        if not waiting:
            self._from_thread(self._deliver)

    def close(self) -> None:
        """Nobody watches any more: what was seen last is told, with the time."""
        self.abandon()
        self._tell(last=True)
        self.source.close()

    def abandon(self) -> None:
        """Its pictures can't be had after all."""
        self._timer.cancel()

    def _deliver(self) -> None:
        with self._lock:
            shot, self._newest = self._newest, None
        if shot is None:
            return
        first, self._latest = self._latest is None, shot
        if first:
            self._tell()
        for listener in list(self.listeners):
            listener(shot)

    def _look(self) -> None:
        now = self._clock.seconds()
        with self._lock:
            count, self._count = self._count, 0
        rate = count / max(now - self._looked, 1e-3)
        self._looked = now
        self.fps = rate if not self.fps else self.fps + 0.5 * (rate - self.fps)
        self._timer = self._clock.callLater(LOOK_EVERY, self._look)
        self._tell()

    def _tell(self, *, last: bool = False) -> None:
        if self._latest is None:
            return
        try:
            encoding, width, height = self._latest.look()
        except Invalid:
            return  # the streams say why
        seen = Seen(
            camera=self.camera,
            encoding=encoding[:LABEL],
            width=width,
            height=height,
            fps=round(self.fps, 1),
            at=round(self._latest.stamp / 1e9, 3),
        )
        if last or self._seen is None or _differ(self._seen, seen):
            self._seen = seen
            self._on_seen(seen)


def _differ(old: Seen, new: Seen) -> bool:
    same = (old.encoding, old.width, old.height) == (new.encoding, new.width, new.height)
    return not same or abs(new.fps - old.fps) > _STEADY * max(old.fps, 1.0)
