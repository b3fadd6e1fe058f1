"""How long viewers wait for frames: for their first, and for key frames of H.264."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Generic, TypeVar

from relay_protocol import link
from relay_server.common.clock import Clock, Timer, cancel

V = TypeVar("V")
"""A viewer."""

FIRST_FRAME_SECONDS = 10.0
"""Seconds after which a viewer without a frame gets an error. A viewer that has had a frame waits on."""

PART_SECONDS = 5.0
"""A viewer waits on while parts of a frame come at most this far apart: a large frame takes long on a thin
uplink."""

MAX_WAIT_SECONDS = 120.0
WAIT_FRAMES = 2.5
"""Where frames are rare, a viewer waits for this many intervals between frames, but at most MAX_WAIT_SECONDS.
"""

UNKNOWN_RATE_SECONDS = 30.0
"""A new viewer is shown the only frame of a camera without a rate if it is at most this old."""


def frame_interval(
    settings: link.VideoSettings, camera: link.Camera | None, playing: link.StreamStatus | None
) -> float:
    """Seconds between frames, at most 120, by the slowest rate requested or reported; 0 if no rate is known.

    :param camera: as the robot lists it
    :param playing: the status of the stream
    """
    # The rate of the frames that came counts first: the listed rate of a camera that has stopped falls for a
    # while.
    source = (playing.source_fps if playing is not None else 0.0) or (
        camera.fps if camera is not None else 0.0
    )
    rates = (settings.fps, source, playing.fps if playing is not None else 0.0)
    return min(max((1 / rate for rate in rates if rate > 0), default=0.0), MAX_WAIT_SECONDS)


class FirstFrameTimeout(Generic[V]):
    """The viewers that wait for their first frame.

    :param interval: seconds between frames, or 0 when it is not known or no frames can come
    :param timed_out: called with a viewer that waited too long, and for how many seconds
    """

    def __init__(
        self, clock: Clock, interval: Callable[[], float], timed_out: Callable[[V, float], None]
    ) -> None:
        self._clock = clock
        self._frame_interval = interval
        self._timed_out = timed_out
        self._timers: dict[V, Timer] = {}
        self._part_at = float("-inf")
        """When the last part of an incomplete frame came, monotonic seconds."""

    def part_received(self) -> None:
        """A part of a frame came, and more parts must follow."""
        self._part_at = self._clock.seconds()

    def start(self, viewer: V) -> None:
        since = self._clock.seconds()
        self._timers[viewer] = self._clock.callLater(FIRST_FRAME_SECONDS, self._check, viewer, since)

    def is_waiting(self, viewer: V) -> bool:
        """Whether the viewer has no frame yet."""
        return viewer in self._timers

    def stop(self, viewer: V) -> None:
        """The viewer has a frame, or has left."""
        cancel(self._timers.pop(viewer, None))

    def _check(self, viewer: V, since: float) -> None:
        now = self._clock.seconds()
        waited = now - since
        until = max(since + WAIT_FRAMES * self._frame_interval(), self._part_at + PART_SECONDS)
        left = min(until, since + MAX_WAIT_SECONDS) - now
        if left > 0:
            self._timers[viewer] = self._clock.callLater(left, self._check, viewer, since)
        else:
            self._timed_out(viewer, waited)


"""A viewer."""

KEY_SECONDS = 0.5
"""The robot is asked for key frames at most this often."""

MAX_KEY_SECONDS = 8.0
"""A viewer that drops frames again and again gets key frames after 0.5, 1, 2 s and so on, up to this pause.
"""

ALONE_KEY_SECONDS = 1.0
"""Longest pause of a viewer that watches alone, where another key frame costs no other viewer anything."""

STEADY_SECONDS = 10.0
"""A viewer that drops nothing for so long after a key frame keeps up; its earlier drops no longer count."""

_SLACK = 0.002
"""Seconds. Rounding must not delay a request to another turn of the reactor."""


class _Slow:
    """A viewer that dropped frames.

    :ivar pause: seconds between the next request for this viewer and the one after it
    :ivar holdoff: seconds after the last request in which this viewer causes no other one
    :ivar asked_at: time of the last request while the viewer waited, monotonic seconds
    :ivar shown_at: when the viewer got a key frame after its last drop; ``None`` until then
    """

    __slots__ = ("asked_at", "holdoff", "pause", "shown_at")

    def __init__(self) -> None:
        self.pause = KEY_SECONDS
        self.holdoff = 0.0
        self.asked_at = float("-inf")
        self.shown_at: float | None = None

    def requested(self, now: float) -> None:
        """The robot was asked while the viewer waited."""
        self.asked_at, self.holdoff = now, self.pause
        self.pause = min(2 * self.pause, MAX_KEY_SECONDS)

    def keeps_up(self, now: float) -> bool:
        """Whether the viewer has dropped nothing for :data:`STEADY_SECONDS`."""
        return self.shown_at is not None and now - self.shown_at >= STEADY_SECONDS


class Keyframes(Generic[V]):
    """The viewers of a stream that wait for a frame that can be decoded alone.

    Every frame of JPEG and PNG is one, so none is requested for them.

    :param request: asks the robot for a key frame
    :param shared: whether the stream has more than one viewer
    """

    def __init__(self, clock: Clock, request: Callable[[], None], shared: Callable[[], bool]) -> None:
        self._clock = clock
        self._request = request
        self._shared = shared
        self._waiting: set[V] = set()
        self._slow: dict[V, _Slow] = {}
        self._requested_at = float("-inf")
        self._timer: Timer | None = None
        self._due_at = 0.0

    def is_waiting(self, viewer: V) -> bool:
        """Whether the viewer can be shown nothing before the next key frame."""
        return viewer in self._waiting

    def add(self, viewers: Iterable[V]) -> None:
        """New viewers, or a new encoder, which begins with a key frame by itself."""
        self._waiting.update(viewers)

    def request(self, viewer: V) -> None:
        """The viewer needs a key frame as soon as possible, through no fault of its own."""
        self._waiting.add(viewer)
        self._request_at(self._requested_at + KEY_SECONDS)

    def frame_dropped(self, viewer: V) -> None:
        """The viewer was too slow for a frame that later frames depend on.

        The robot is asked when the viewer's pause is over. A key frame that comes earlier serves this viewer
        too.
        """
        slow = self._slow.get(viewer)
        if slow is None or slow.keeps_up(self._clock.seconds()):
            slow = self._slow[viewer] = _Slow()
        slow.shown_at = None
        self._waiting.add(viewer)
        self._request_at(max(self._earliest(viewer), self._requested_at + KEY_SECONDS))

    def keyframe_shown(self, viewer: V) -> None:
        """The viewer gets a key frame."""
        if viewer in self._waiting:
            self._waiting.discard(viewer)
            slow = self._slow.get(viewer)
            if slow is not None:
                slow.shown_at = self._clock.seconds()

    def remove(self, viewer: V) -> None:
        """The viewer has left."""
        self._waiting.discard(viewer)
        self._slow.pop(viewer, None)

    def cancel(self) -> None:
        """Stop asking: the stream has no link."""
        cancel(self._timer)

    # --- when the robot is asked ---------------------------------------------------------------------------

    def _request_at(self, due: float) -> None:
        """Ask at a time, unless a request is due earlier."""
        now = self._clock.seconds()
        if due <= now + _SLACK:
            self._request_now(now)
            return
        # The other viewers may leave meanwhile, and then the request is due earlier.
        due = min(due, now + ALONE_KEY_SECONDS)
        if self._timer is None or not self._timer.active() or due < self._due_at:
            cancel(self._timer)
            self._due_at = due
            self._timer = self._clock.callLater(due - now, self._check)

    def _check(self) -> None:
        """A viewer's pause is over; the viewer may have got its key frame meanwhile."""
        if self._waiting:
            earliest = min(self._earliest(viewer) for viewer in self._waiting)
            self._request_at(max(earliest, self._requested_at + KEY_SECONDS))

    def _earliest(self, viewer: V) -> float:
        slow = self._slow.get(viewer)
        if slow is None:
            return float("-inf")
        pause = slow.holdoff if self._shared() else min(slow.holdoff, ALONE_KEY_SECONDS)
        return slow.asked_at + pause

    def _request_now(self, now: float) -> None:
        cancel(self._timer)
        self._requested_at = now
        # One key frame serves all viewers that wait, so many slow ones cost no more than one.
        for viewer in self._waiting:
            slow = self._slow.get(viewer)
            if slow is not None:
                slow.requested(now)
        self._request()
