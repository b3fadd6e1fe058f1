"""The round trip to the relay as it is when nothing of ours stands in the way; one for all streams that go there.

What a ping measures on a thin link is how long pictures wait. So measurements show at any time that the way is shorter
than it was thought to be, but that it has become longer is only believed when it was asked for: no picture leaves until
all that are under way have their answers, then a few bytes go alone. BBR looks for its least round trip in the same way
(draft-cardwell-iccrg-bbr-congestion-control, ProbeRTT). It is asked for only when all measurements have been longer for
a while: where there is no queue the pings tell enough. And it is not asked for while something is under way that takes
long and is never given up: one large picture would hold up all streams, and it is why the measurements are longer.
"""

from __future__ import annotations

MARGIN = (0.02, 0.25)
"""Seconds, and part of the round trip, by which measurements waver on a link that is as it was; the more of them."""

DOUBT = 3.0
"""Seconds of nothing but longer measurements after which it is asked for: three pings."""

EVERY = 10.0
"""Seconds from one question to the next, at least: each costs a picture or two."""

PATIENCE = 1.0
"""Seconds that what is under way may take, once it is asked for; what takes longer is too much to wait for."""

LONGEST = 3.0
"""Seconds the answer may take. What left meanwhile would be there no sooner than the few bytes before it."""


class RttProbe:
    """What all streams to one relay know of the way there. Pure: times are given, in seconds of one clock."""

    def __init__(self) -> None:
        self.seconds = 0.0
        """The round trip, 0 before it is known."""
        self._known = False
        self._longer_since: float | None = None
        self._busy: set[object] = set()
        """The streams with something under way."""
        self._patient: set[object] = set()
        """Those of them that never give it up."""
        self._asking: float | None = None
        """Since when pictures are held back."""
        self._asker: object | None = None
        """The stream whose few bytes are on their way alone."""
        self._asked = self._ended = float("-inf")

    def measured(self, seconds: float, now: float) -> None:
        """A ping came back, perhaps behind pictures."""
        if not self._known or seconds < self.seconds:
            self.seconds, self._known = seconds, True
        if not longer(seconds, self.seconds):
            self._longer_since = None
        elif self._longer_since is None:
            self._longer_since = now

    def may_leave(self, now: float) -> bool:
        """Whether a picture may leave at present, as far as this goes."""
        if self._patient and self._asker is None:
            if self._asking is not None:
                self._end(now)
            return True
        if self._asking is None:
            if self._longer_since is None or now - self._longer_since < DOUBT or now - self._ended < EVERY:
                return True
            self._asking = now
        elif now - self._asking > (PATIENCE if self._asker is None else LONGEST):
            self._end(now)
            return True
        return self._is_empty()

    def leaves(self, stream: object, now: float, patient: bool = False) -> bool:
        """A picture of a stream begins to leave.

        :param patient: it is never given up, however long it takes
        :return: whether only a few bytes of it may, and no more before they have an answer
        """
        asks = self._asking is not None and self._is_empty()
        self._busy.add(stream)
        if patient:
            self._patient.add(stream)
        if asks:
            self._asker, self._asking, self._asked = stream, now, now
        return asks

    def answered(self, stream: object, now: float) -> None:
        """The few bytes of a stream are there."""
        if self._asker is stream:
            self.seconds, self._known = now - self._asked, True
            self._longer_since = None
            self._end(now)

    def idle(self, stream: object, now: float) -> None:
        """Nothing of a stream is under way any more."""
        self._busy.discard(stream)
        self._patient.discard(stream)
        if self._asker is stream:
            self._end(now)

    def _is_empty(self) -> bool:
        return self._asker is None and not self._busy

    def _end(self, now: float) -> None:
        self._asking = self._asker = None
        self._ended = now


def longer(seconds: float, than: float) -> bool:
    """Whether a round trip is so much longer than another one that it is not just wavering."""
    least, part = MARGIN
    return seconds > than + max(least, part * than)
