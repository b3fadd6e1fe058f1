"""One camera while somebody watches it: its newest picture, for every stream that wants it."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Protocol

from relay_protocol.errors import Invalid
from relay_protocol.limits import LABEL
from robot_client.camera.frame import Frame
from robot_client.camera.ipc import CameraSeen
from robot_client.twisted_types import DelayedCall, ReactorClock

LOOK_EVERY = 1.0
"""Seconds between two looks at what the camera gives."""

HOLDS = 2.5
"""Pictures' time: without one for so long a camera counts as silent, and its latest picture as past."""

UNKNOWN = 10.0
"""Seconds for which a picture holds that is the only one so far. The relay can't tell its age when a stream begins with
it, and adds its own time for such a picture."""

SLOW = 2.0
"""Seconds between pictures from which on a camera counts as slow."""

_STEADY = 0.1
"""Part by which a rate may waver without being told anew."""


class Origin(Protocol):
    """What gives the pictures."""

    @property
    def latched(self) -> bool:
        """Whether who comes later gets the latest one, however old it is."""

    def close(self) -> None:
        """Give no more."""


class LatestFrame:
    """Hands a camera's pictures from its thread to the reactor's, the newest alone.

    :param camera: its name
    :param from_thread: of the reactor, to call there
    :param on_seen: told what the pictures are like, when that changes
    """

    def __init__(
        self,
        camera: str,
        clock: ReactorClock,
        from_thread: Callable[[Callable[[], None]], object],
        on_seen: Callable[[CameraSeen], None],
    ) -> None:
        self.camera = camera
        self.source: Origin
        self.fps = 0.0
        """Pictures per second, as they came of late; 0 before there were two, and when none comes any more."""
        self.listeners: set[Callable[[Frame], None]] = set()
        self._clock = clock
        self._from_thread = from_thread
        self._on_seen = on_seen
        self._lock = threading.Lock()
        self._newest: Frame | None = None
        self._kept: Frame | None = None
        self._since: float | None = None
        """When the picture came from which on they are counted."""
        self._count = 0
        """Of those after it."""
        self._last = 0.0
        """When the last of them came."""
        self._rate = 0.0
        """As measured, also when none comes any more."""
        self._latest: Frame | None = None
        self._seen: CameraSeen | None = None
        self._timer: DelayedCall = clock.callLater(LOOK_EVERY, self._look)

    def put(self, shot: Frame) -> None:
        """A picture came; from any thread."""
        with self._lock:
            waiting = self._newest is not None
            self._newest = shot
            if self._since is None:
                self._since = shot.arrived
            else:
                self._count += 1
            self._last = shot.arrived
        if not waiting:
            self._from_thread(self._deliver)

    def keep(self, shot: Frame) -> None:
        """A picture came that must not be shown at present; from any thread."""
        with self._lock:
            self._kept = shot

    def speak(self) -> None:
        """Pictures may be shown again: of those that come but once the last one that was kept is."""
        with self._lock:
            kept, self._kept = self._kept, None
            newest = self._newest or self._latest
        if kept is not None and self.source.latched and (newest is None or newest.stamp < kept.stamp):
            self.put(kept.again(self._clock.seconds()))

    def latest(self) -> Frame | None:
        """The latest picture, as long as it is what the camera shows: until the next one is long overdue."""
        shot = self._latest
        if shot is None or self.source.latched:
            return shot
        holds = HOLDS / self._rate if self._rate else UNKNOWN
        return shot if self._clock.seconds() - shot.arrived <= holds else None

    @property
    def slow(self) -> bool:
        """Whether the next picture may be a while off, as far as one can tell."""
        now = self._clock.seconds()
        self._measure(now)
        with self._lock:
            alone, last = not self._rate and not self._count, self._last
        return alone or now - last > SLOW or (self._rate > 0 and 1 / self._rate > SLOW)

    def close(self) -> None:
        """Nobody watches any more: what was seen last is told, with the time."""
        self.abandon()
        self._measure(self._clock.seconds())
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
        self._measure(self._clock.seconds())
        self._timer = self._clock.callLater(LOOK_EVERY, self._look)
        self._tell()

    def _measure(self, now: float) -> None:
        """Find out the rate by the time between pictures, which tells it also where there are few."""
        with self._lock:
            since, count, last = self._since, self._count, self._last
            if since is None or (last <= since and now - since <= self._patience):
                return
            # After a silence they are counted anew.
            self._since, self._count = (last if last > since else None), 0
        if last > since:
            rate = count / (last - since)
            self._rate = rate if not self.fps else self._rate + 0.5 * (rate - self._rate)
            self.fps = float(f"{self._rate:.3g}")
        else:
            self.fps = 0.0

    @property
    def _patience(self) -> float:
        """Seconds without a picture after which the camera counts as silent."""
        return max(HOLDS / self.fps, HOLDS * LOOK_EVERY) if self.fps else float("inf")

    def _tell(self, *, last: bool = False) -> None:
        if self._latest is None:
            return
        try:
            encoding, width, height = self._latest.look()
        except Invalid:
            return  # the streams say why
        seen = CameraSeen(
            camera=self.camera,
            encoding=encoding[:LABEL],
            width=width,
            height=height,
            fps=self.fps,
            at=round(self._latest.stamp / 1e9, 3),
        )
        if last or self._seen is None or _differ(self._seen, seen):
            self._seen = seen
            self._on_seen(seen)


def _differ(old: CameraSeen, new: CameraSeen) -> bool:
    same = (old.encoding, old.width, old.height) == (new.encoding, new.width, new.height)
    return not same or abs(new.fps - old.fps) > _STEADY * old.fps
