"""Frames of a camera: one frame, what a stream needs of the next one, and the latest frame for all
streams."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple, Protocol

from relay_protocol.errors import Invalid
from relay_protocol.limits import LABEL_LENGTH
from robot_client.camera.ipc import CameraSeen
from robot_client.twisted_types import DelayedCall, ReactorClock

if TYPE_CHECKING:  # numpy and OpenCV may be missing, which is reported to the client
    from robot_client.camera.formats import RawImage

CHECK_INTERVAL = 1.0
"""Seconds between two measurements of a camera's rate."""

SILENT_PERIODS = 2.5
"""Frame periods without a frame after which a camera counts as silent, and its latest frame as outdated."""

FIRST_FRAME_SECONDS = 10.0
"""Seconds for which the only frame so far counts as current. The relay does not know its age when a stream
begins with it, and adds its own time for such a frame."""

SLOW_PERIOD = 2.0
"""Seconds between frames from which on a camera counts as slow."""

_RATE_TOLERANCE = 0.1
"""Relative change of the rate that is not reported."""


class FrameFormat(NamedTuple):
    """Encoding of a frame, and its size in pixels."""

    encoding: str
    width: int
    height: int


class EncodeRequest(NamedTuple):
    """Rate control's settings for the next frame.

    :param scale: factor for each side
    :param reduced: whether the settings are below what the client requested
    :param key: whether the frame must be decodable without others
    :param fps: expected frames per second, 0 if unknown
    """

    quality: int
    scale: float
    reduced: bool
    key: bool
    fps: float


class Encoded(NamedTuple):
    """An encoded frame.

    :param encoding: encoding of the camera's own frame
    """

    body: bytes
    width: int
    height: int
    encoding: str


class Frame:
    """One frame. Several streams may use it from several threads; it is decoded once for all of them.

    :param stamp: wall clock of the robot when it arrived, nanoseconds since 1970
    :param arrived: the same moment on the process's monotonic clock, seconds
    :param read_format: returns its format, or raises :class:`Invalid`
    :param decode: returns its pixels, or raises :class:`Invalid`
    :param jpeg: returns the camera's own JPEG if there is one, or raises :class:`Invalid`
    """

    def __init__(
        self,
        stamp: int,
        arrived: float,
        read_format: Callable[[], FrameFormat],
        decode: Callable[[], RawImage],
        jpeg: Callable[[], bytes | None] = lambda: None,
    ) -> None:
        self.stamp = stamp
        self.arrived = arrived
        self.read_format = read_format
        self.jpeg = jpeg
        self._decode = decode
        self._raw: RawImage | None = None
        self._lock = threading.Lock()

    def as_new(self, now: float) -> Frame:
        """The same frame as if it had arrived now, with its old stamp. So its age is not attributed to the
        uplink.

        :param now: the process's monotonic clock, seconds
        """
        return Frame(self.stamp, now, self.read_format, self.raw, self.jpeg)

    def raw(self) -> RawImage:
        """Its pixels; they must not be modified.

        :raises Invalid: they can't be decoded
        """
        with self._lock:
            if self._raw is None:
                self._raw = self._decode()
            return self._raw


class FrameSource(Protocol):
    """A subscription or an opened device that delivers frames."""

    @property
    def latched(self) -> bool:
        """Whether a late subscriber receives the latest frame, however old it is."""

    def close(self) -> None:
        """Stop delivering."""


class LatestFrame:
    """Passes a camera's frames from its thread to the reactor; only the newest is kept. :attr:`source` must
    be set.

    :param camera: its name
    :param call_from_thread: of the reactor
    :param on_seen: called when the camera's format or rate changed
    """

    def __init__(
        self,
        camera: str,
        clock: ReactorClock,
        call_from_thread: Callable[[Callable[[], None]], object],
        on_seen: Callable[[CameraSeen], None],
    ) -> None:
        self.camera = camera
        self.source: FrameSource
        self.fps = 0.0
        """Recent frames per second; 0 before the second frame, and when none arrives any more."""
        self.listeners: set[Callable[[Frame], None]] = set()
        self._clock = clock
        self._call_from_thread = call_from_thread
        self._on_seen = on_seen
        self._lock = threading.Lock()
        self._undelivered: Frame | None = None
        self._withheld: Frame | None = None
        self._since: float | None = None
        """Arrival of the frame after which frames are counted."""
        self._count = 0
        self._last_arrival = 0.0
        """Of the counted frames."""
        self._rate = 0.0
        """Measured rate; stays when no frame arrives any more."""
        self._latest: Frame | None = None
        self._seen: CameraSeen | None = None
        self._timer: DelayedCall = clock.callLater(CHECK_INTERVAL, self._check)

    def put(self, frame: Frame) -> None:
        """Deliver a frame; from any thread."""
        with self._lock:
            scheduled = self._undelivered is not None
            self._undelivered = frame
            if self._since is None:
                self._since = frame.arrived
            else:
                self._count += 1
            self._last_arrival = frame.arrived
        if not scheduled:
            self._call_from_thread(self._deliver)

    def withhold(self, frame: Frame) -> None:
        """Keep a frame that must not be shown now; from any thread."""
        with self._lock:
            self._withheld = frame

    def release(self) -> None:
        """Frames may be shown again. If the camera is latched, the last withheld frame is delivered."""
        with self._lock:
            withheld, self._withheld = self._withheld, None
            newest = self._undelivered or self._latest
        if withheld is not None and self.source.latched and (newest is None or newest.stamp < withheld.stamp):
            self.put(withheld.as_new(self._clock.seconds()))

    def latest(self) -> Frame | None:
        """The latest frame, unless the next one is long overdue."""
        frame = self._latest
        if frame is None or self.source.latched:
            return frame
        valid_for = SILENT_PERIODS / self._rate if self._rate else FIRST_FRAME_SECONDS
        return frame if self._clock.seconds() - frame.arrived <= valid_for else None

    @property
    def slow(self) -> bool:
        """Whether the next frame may take more than :data:`SLOW_PERIOD`."""
        now = self._clock.seconds()
        self._measure(now)
        with self._lock:
            single, last = not self._rate and not self._count, self._last_arrival
        return single or now - last > SLOW_PERIOD or (self._rate > 0 and 1 / self._rate > SLOW_PERIOD)

    def close(self) -> None:
        """Close the source; the last state is reported, with the time."""
        self.cancel()
        self._measure(self._clock.seconds())
        self._report(last=True)
        self.source.close()

    def cancel(self) -> None:
        """Stop the timer; for a camera whose source could not be opened."""
        self._timer.cancel()

    def _deliver(self) -> None:
        with self._lock:
            frame, self._undelivered = self._undelivered, None
        if frame is None:
            return
        first, self._latest = self._latest is None, frame
        if first:
            self._report()
        for listener in list(self.listeners):
            listener(frame)

    def _check(self) -> None:
        self._measure(self._clock.seconds())
        self._timer = self._clock.callLater(CHECK_INTERVAL, self._check)
        self._report()

    def _measure(self, now: float) -> None:
        """Measure the rate by the time between frames, which also works for few frames."""
        with self._lock:
            since, count, last = self._since, self._count, self._last_arrival
            if since is None or (last <= since and now - since <= self._silence_timeout):
                return
            # After a silence, counting starts over.
            self._since, self._count = (last if last > since else None), 0
        if last > since:
            rate = count / (last - since)
            self._rate = rate if not self.fps else self._rate + 0.5 * (rate - self._rate)
            self.fps = float(f"{self._rate:.3g}")
        else:
            self.fps = 0.0

    @property
    def _silence_timeout(self) -> float:
        """Seconds without a frame after which the camera counts as silent."""
        if not self.fps:
            return float("inf")
        return max(SILENT_PERIODS / self.fps, SILENT_PERIODS * CHECK_INTERVAL)

    def _report(self, *, last: bool = False) -> None:
        if self._latest is None:
            return
        try:
            encoding, width, height = self._latest.read_format()
        except Invalid:
            return  # the streams report why
        seen = CameraSeen(
            camera=self.camera,
            encoding=encoding[:LABEL_LENGTH],
            width=width,
            height=height,
            fps=self.fps,
            at=round(self._latest.stamp / 1e9, 3),
        )
        if last or self._seen is None or _differs(self._seen, seen):
            self._seen = seen
            self._on_seen(seen)


def _differs(old: CameraSeen, new: CameraSeen) -> bool:
    same = (old.encoding, old.width, old.height) == (new.encoding, new.width, new.height)
    return not same or abs(new.fps - old.fps) > _RATE_TOLERANCE * old.fps
