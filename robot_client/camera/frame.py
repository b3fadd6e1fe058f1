"""Pictures on their way from a camera to a stream; what is wanted of the next one, and what came of it."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:  # numpy and OpenCV may not be there, and who asked is told so
    from robot_client.camera.formats import Raw


class FrameFormat(NamedTuple):
    """What a picture is like: its encoding, and pixels each way."""

    encoding: str
    width: int
    height: int


class Frame:
    """One picture of a camera. Several streams may want it at once, from threads; it is decoded for all of them once.

    :param stamp: the robot's wall clock when it came, nanoseconds
    :param arrived: the same moment, seconds of the process's clock
    :param look: says what it is like, or raises :class:`Invalid`
    :param read: gives its pixels, or raises :class:`Invalid`
    :param jpeg: gives the camera's own JPEG where it makes one, or raises :class:`Invalid`
    """

    def __init__(
        self,
        stamp: int,
        arrived: float,
        look: Callable[[], FrameFormat],
        read: Callable[[], Raw],
        jpeg: Callable[[], bytes | None] = lambda: None,
    ) -> None:
        self.stamp = stamp
        self.arrived = arrived
        self.look = look
        self.jpeg = jpeg
        self._read = read
        self._raw: Raw | None = None
        self._lock = threading.Lock()

    def again(self, now: float) -> Frame:
        """The same picture as if it had come now, but for its stamp: it is no fault of the uplink's how old it is.

        :param now: seconds of the process's clock
        """
        return Frame(self.stamp, now, self.look, self.raw, self.jpeg)

    def raw(self) -> Raw:
        """Its pixels, not to be written to.

        :raises Invalid: they can't be read
        """
        with self._lock:
            if self._raw is None:
                self._raw = self._read()
            return self._raw


class EncodeRequest(NamedTuple):
    """How the next picture is wanted by the pace.

    :param scale: of each side
    :param reduced: whether it is less than was asked for
    :param key: whether it must stand alone
    :param fps: pictures per second to be expected, 0 if unknown
    """

    quality: int
    scale: float
    reduced: bool
    key: bool
    fps: float


class Encoded(NamedTuple):
    """A picture to be sent.

    :param encoding: of the camera's own
    """

    body: bytes
    width: int
    height: int
    encoding: str
