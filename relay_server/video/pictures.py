"""One picture of a stream, as the relay passes it on."""

from __future__ import annotations

import msgspec

STALE_SECONDS = 0.5
"""Age from which a picture is not shown any more, the least time on its way not counted."""

SPAN_SECONDS = 10.0
"""The least delay is that of the last one or two times this."""


class Picture(msgspec.Struct, frozen=True, gc=False):
    """One picture of a stream.

    :param number: of the stream, counted by the robot; a stream that was opened anew counts anew
    :param stamp: Unix seconds at the robot, when the camera's picture reached it
    :param good_until: the relay's monotonic clock, seconds; later it is not shown any more
    :param codec: ``jpeg``, ``png`` or ``h264``
    :param width: pixels
    :param height: pixels
    :param key: whether it stands alone; always true for JPEG and PNG
    """

    number: int
    stamp: float
    good_until: float
    codec: str
    width: int
    height: int
    key: bool
    body: bytes


class Lateness:
    """How much later pictures come than they might: after a stall of the network old ones come in a heap.

    The robot's clock and the relay's show different times; but what came with the least delay of late was hardly late.
    """

    __slots__ = ("_before", "_least", "_since")

    def __init__(self) -> None:
        self._since = float("-inf")
        self._least = self._before = float("inf")

    def of(self, stamp: float, now: float) -> float:
        """Seconds.

        :param stamp: the robot's clock when the camera's picture reached it
        :param now: a monotonic clock
        """
        delay = now - stamp
        if now - self._since >= SPAN_SECONDS:
            self._since, self._before, self._least = now, self._least, delay
        self._least = min(self._least, delay)
        return delay - min(self._least, self._before)
