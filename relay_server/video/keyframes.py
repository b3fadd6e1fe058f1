"""Key frames of H.264: who can't be shown anything before the next one, and when the robot is asked for one.

A key frame is large, and everybody who watches gets it: who is too slow must not have one made again and again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

from relay_server.common.clock import Clock, Timer, cancel
from relay_server.video.ports import ViewerPort

KEY_SECONDS = 0.5
"""The robot is asked for a key frame no more often than this, whoever comes."""

MOST_KEY_SECONDS = 8.0
"""For who leaves out pictures again and again it is asked after 0.5, 1, 2 s and so on, at last only so often."""

ALONE_KEY_SECONDS = 1.0
"""Who watches alone waits no longer: a key frame more costs nobody else anything."""

STEADY_SECONDS = 10.0
"""Who leaves out nothing for so long after a key frame keeps up: what was before counts no more."""

_SLACK = 0.002
"""Seconds; rounding must not put a request off to another turn."""


class _Slow:
    """A viewer who has left out pictures.

    :ivar pause: seconds between the next request for him and the one after it
    :ivar paused: seconds after the last request in which he is not the reason of another one
    :ivar asked_at: when that was, monotonic seconds
    :ivar shown_at: when he got a key frame, if that was after he left out something
    """

    __slots__ = ("asked_at", "pause", "paused", "shown_at")

    def __init__(self) -> None:
        self.pause = KEY_SECONDS
        self.paused = 0.0
        self.asked_at = float("-inf")
        self.shown_at: float | None = None

    def asked(self, now: float) -> None:
        """The robot was asked while he waited."""
        self.asked_at, self.paused = now, self.pause
        self.pause = min(2 * self.pause, MOST_KEY_SECONDS)

    def kept_up(self, now: float) -> bool:
        """Whether he has left out nothing for long."""
        return self.shown_at is not None and now - self.shown_at >= STEADY_SECONDS


class Keyframes:
    """Who waits for a picture that stands alone. Of JPEG and PNG each does, and nobody asks for any.

    :param ask: asks the robot for a key frame
    :param shared: whether more than one watch now
    """

    def __init__(self, clock: Clock, ask: Callable[[], None], shared: Callable[[], bool]) -> None:
        self._clock = clock
        self._ask = ask
        self._shared = shared
        self._waiting: set[ViewerPort] = set()
        self._slow: dict[ViewerPort, _Slow] = {}
        self._asked = float("-inf")
        self._timer: Timer | None = None
        self._due = 0.0

    def waits(self, viewer: ViewerPort) -> bool:
        """Whether he can be shown nothing else."""
        return viewer in self._waiting

    def enters(self, viewers: Iterable[ViewerPort]) -> None:
        """They have seen nothing of what the robot's encoder makes; a new one begins with a key frame by itself."""
        self._waiting.update(viewers)

    def wants(self, viewer: ViewerPort) -> None:
        """He needs one as soon as can be, through no fault of his."""
        self._waiting.add(viewer)
        self._ask_at(self._asked + KEY_SECONDS)

    def left_out(self, viewer: ViewerPort) -> None:
        """He was too slow for a picture, without which the following are no use to him.

        The robot is asked for him when his pause is over; a key frame that comes earlier is his, too.
        """
        slow = self._slow.get(viewer)
        if slow is None or slow.kept_up(self._clock.seconds()):
            slow = self._slow[viewer] = _Slow()
        slow.shown_at = None
        self._waiting.add(viewer)
        self._ask_at(max(self._not_before(viewer), self._asked + KEY_SECONDS))

    def shown(self, viewer: ViewerPort) -> None:
        """He gets a picture that stands alone."""
        if viewer in self._waiting:
            self._waiting.discard(viewer)
            slow = self._slow.get(viewer)
            if slow is not None:
                slow.shown_at = self._clock.seconds()

    def leaves(self, viewer: ViewerPort) -> None:
        """He watches no more."""
        self._waiting.discard(viewer)
        self._slow.pop(viewer, None)

    def rest(self) -> None:
        """There is nobody to ask at present."""
        cancel(self._timer)

    # --- when the robot is asked ----------------------------------------------------------------------------

    def _ask_at(self, due: float) -> None:
        """Ask then, unless it is done earlier anyway."""
        now = self._clock.seconds()
        if due <= now + _SLACK:
            self._ask_now(now)
            return
        # The others may leave meanwhile, and then it is due earlier.
        due = min(due, now + ALONE_KEY_SECONDS)
        if self._timer is None or not self._timer.active() or due < self._due:
            cancel(self._timer)
            self._due = due
            self._timer = self._clock.callLater(due - now, self._look)

    def _look(self) -> None:
        """Somebody's pause is over; perhaps he has his key frame meanwhile."""
        if self._waiting:
            earliest = min(self._not_before(viewer) for viewer in self._waiting)
            self._ask_at(max(earliest, self._asked + KEY_SECONDS))

    def _not_before(self, viewer: ViewerPort) -> float:
        slow = self._slow.get(viewer)
        if slow is None:
            return float("-inf")
        pause = slow.paused if self._shared() else min(slow.paused, ALONE_KEY_SECONDS)
        return slow.asked_at + pause

    def _ask_now(self, now: float) -> None:
        cancel(self._timer)
        self._asked = now
        # The key frame is for all who wait, so that many slow ones cost no more than one.
        for viewer in self._waiting:
            slow = self._slow.get(viewer)
            if slow is not None:
                slow.asked(now)
        self._ask()
