"""One picture of a stream, as the relay passes it on."""

from __future__ import annotations

import msgspec

STALE_SECONDS = 0.5
"""Age from which a picture is not shown any more, the least time on its way not counted."""

OFTEN = 0.5
"""Pictures per second from which on the next one comes soon, and one that is late is not missed."""

SPAN_SECONDS = 10.0
"""The least delay is that of the last one or two times this."""

EVEN_SECONDS = 2.0
WAVER_SECONDS = 0.2
EVEN_PICTURES = 3
"""Pictures that come for so long, by delays that waver by no more than this, and at least so many, are not held up by
anything: the robot's clock was set, or their way is another one now."""


class VideoFrameInfo(msgspec.Struct, frozen=True, gc=False):
    """One picture of a stream.

    :param number: of the stream, counted by the robot; a stream that was opened anew counts anew
    :param stamp: Unix seconds at the robot, when the camera's picture reached it
    :param good_until: the relay's monotonic clock, seconds; later it is not shown any more
    :param codec: ``jpeg``, ``png`` or ``h264``
    :param width: pixels
    :param height: pixels
    :param key: whether it stands alone; always true for JPEG and PNG
    :param reduced: how far it is below what was asked for, 0 to 1
    """

    number: int
    stamp: float
    good_until: float
    codec: str
    width: int
    height: int
    key: bool
    body: bytes
    reduced: float = 0.0


class DelayEstimator:
    """How much later pictures come than they might: after a stall of the network old ones come in a heap.

    The robot's clock and the relay's show different times; but what came with the least delay of late was hardly late.
    What comes too late to be shown, and evenly so, is the new measure: else nobody saw anything once a clock was set.
    """

    __slots__ = ("_before", "_count", "_even_since", "_high", "_least", "_low", "_since")

    def __init__(self) -> None:
        self._since = float("-inf")
        self._least = self._before = float("inf")
        self._even_since = 0.0
        self._low = self._high = 0.0
        self._count = 0

    def of(self, stamp: float, now: float) -> float:
        """Seconds.

        :param stamp: the robot's clock when the camera's picture reached it
        :param now: a monotonic clock
        """
        delay = now - stamp
        if now - self._since >= SPAN_SECONDS:
            self._since, self._before, self._least = now, self._least, delay
        self._least = min(self._least, delay)
        late = delay - min(self._least, self._before)
        if late <= STALE_SECONDS:
            self._count = 0
        elif self._come_evenly(delay, now):
            self._since, self._before, self._least = now, float("inf"), self._low
            self._count = 0
            return delay - self._low
        return late

    def _come_evenly(self, delay: float, now: float) -> bool:
        """Whether the last pictures, which were all late, were so by much the same."""
        low, high = min(self._low, delay), max(self._high, delay)
        if self._count == 0 or high - low > WAVER_SECONDS:
            self._even_since, self._count, low, high = now, 0, delay, delay
        self._low, self._high = low, high
        self._count += 1
        return self._count >= EVEN_PICTURES and now - self._even_since >= EVEN_SECONDS
