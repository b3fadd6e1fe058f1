"""Who has not got any picture yet, and how long he waits for one: longer where pictures are few."""

from __future__ import annotations

from collections.abc import Callable

from relay_protocol import link
from relay_server.common.clock import Clock, Timer, cancel
from relay_server.video.ports import ViewerPort

FIRST_PICTURE_SECONDS = 10.0
"""A viewer that has got no picture by then is told why; one that has got some waits on."""

COMING_SECONDS = 5.0
"""While parts of a picture come no further apart than this he waits on: a large one takes long on a thin uplink."""

MOST_SECONDS = 120.0
PATIENCE_PICTURES = 2.5
"""Where the camera, or what was asked for, is slow, he waits for so many pictures' time. He never waits longer than the
first of these."""

UNKNOWN_SECONDS = 30.0
"""For so long the only picture so far of a camera without a rate is shown to who comes."""


def between(settings: link.VideoSettings, camera: link.Camera | None, playing: link.Playing | None) -> float:
    """Seconds from one picture to the next, at most 120, by the slowest rate asked for or told; 0: nobody knows.

    :param camera: as the robot tells of it
    :param playing: what it sends
    """
    # What came with the pictures counts: that of a camera which has died only seems slow for a while.
    source = (playing.source_fps if playing is not None else 0.0) or (
        camera.fps if camera is not None else 0.0
    )
    rates = (settings.fps, source, playing.fps if playing is not None else 0.0)
    return min(max((1 / rate for rate in rates if rate > 0), default=0.0), MOST_SECONDS)


class FirstFrameTimeout:
    """Those who wait for their first picture.

    :param due: seconds from one picture to the next where they may come now; 0: not known, or there is nothing to come
    :param in_vain: told who has waited in vain, and for how many seconds
    """

    def __init__(
        self, clock: Clock, due: Callable[[], float], in_vain: Callable[[ViewerPort, float], None]
    ) -> None:
        self._clock = clock
        self._due = due
        self._in_vain = in_vain
        self._timers: dict[ViewerPort, Timer] = {}
        self._part_at = float("-inf")
        """When a part of a picture came that was not whole by it, monotonic seconds."""

    def coming(self) -> None:
        """A part of a picture came, and more of it has to."""
        self._part_at = self._clock.seconds()

    def begins(self, viewer: ViewerPort) -> None:
        """He waits from now on."""
        since = self._clock.seconds()
        self._timers[viewer] = self._clock.callLater(FIRST_PICTURE_SECONDS, self._look, viewer, since)

    def waits(self, viewer: ViewerPort) -> bool:
        """Whether he has got no picture yet."""
        return viewer in self._timers

    def ends(self, viewer: ViewerPort) -> None:
        """He has a picture, or has left."""
        cancel(self._timers.pop(viewer, None))

    def _look(self, viewer: ViewerPort, since: float) -> None:
        now = self._clock.seconds()
        waited = now - since
        until = max(since + PATIENCE_PICTURES * self._due(), self._part_at + COMING_SECONDS)
        left = min(until, since + MOST_SECONDS) - now
        if left > 0:
            self._timers[viewer] = self._clock.callLater(left, self._look, viewer, since)
        else:
            self._in_vain(viewer, waited)
