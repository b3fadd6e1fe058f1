"""The next frame for a viewer, and its rendering."""

from __future__ import annotations

import socket
import sys
from types import SimpleNamespace

import pytest

from relay_server.video import frames
from relay_server.video.frames import STALE_SECONDS, FrameQueue, RenderCache, VideoFrameInfo
from relay_server.video.viewer import Snapshot
from tests.worlds.relay import Time


def picture(
    number: int, at: float, codec: str = "jpeg", *, key: bool = True, size: int = 3
) -> VideoFrameInfo:
    """A frame with this time of arrival."""
    return VideoFrameInfo(number, 0.0, at + STALE_SECONDS, codec, 32, 24, key, bytes(size))


class Line:
    """Waiting frames, and the number of key frame requests."""

    def __init__(self, time: Time) -> None:
        self.asked = 0
        self.time = time
        self.waiting = FrameQueue(time, self._anew)

    def _anew(self) -> None:
        self.asked += 1

    def put(self, number: int, codec: str = "jpeg", *, key: bool = True, size: int = 3) -> None:
        """Adds a frame that arrives now."""
        self.waiting.put(picture(number, self.time(), codec, key=key, size=size))

    @property
    def taken(self) -> list[int]:
        """Numbers of the frames that are sent now."""
        return [each.number for each in self.waiting.take()]


@pytest.fixture
def line(time: Time) -> Line:
    """An empty queue."""
    return Line(time)


def test_the_newest_frame_takes_the_place_of_those_before(line: Line) -> None:
    """It is sent once."""
    for number in (1, 2, 3):
        line.put(number)
    assert (line.taken, line.taken) == ([3], [])


def test_a_frame_that_has_waited_too_long_is_not_sent(line: Line, time: Time) -> None:
    """The limit is 0.5 s."""
    line.put(1)
    time.now += STALE_SECONDS + 0.01
    assert line.taken == []
    line.put(2)
    time.now += STALE_SECONDS - 0.01
    assert line.taken == [2]


def test_a_snapshot_is_no_old_frame(time: Time) -> None:
    """It waits for a newer one."""
    snapshot = Snapshot(time)
    snapshot.frame_received(picture(1, time() - 2 * STALE_SECONDS))
    assert not snapshot.done.called
    snapshot.frame_received(picture(2, time()))
    assert snapshot.done.result.number == 2


def test_of_h264_all_go_since_the_last_that_stands_alone(line: Line) -> None:
    """Later frames depend on the earlier ones."""
    line.put(1, "h264")
    line.put(2, "h264", key=False)
    line.put(3, "h264")
    line.put(4, "h264", key=False)
    line.put(5, "h264", key=False)
    assert line.taken == [3, 4, 5]
    assert not line.asked


def test_after_a_dropped_h264_frame_a_key_frame_is_requested(line: Line, time: Time) -> None:
    """It was too old, or the queue too long."""
    line.put(1, "h264")
    time.now += STALE_SECONDS + 0.01
    line.put(2, "h264", key=False)
    assert (line.taken, line.asked) == ([], 1)
    line.put(3, "h264", size=frames.WAITING_BYTES)
    assert line.asked == 1
    line.put(4, "h264", key=False)
    assert (line.taken, line.asked) == ([], 2)


class ThinLine(Line):
    """H.264 at 30 frames per second over a slow link.

    :param per_kilobyte: seconds
    :param round_trip: seconds
    """

    def __init__(self, time: Time, per_kilobyte: float, round_trip: float = 0.0) -> None:
        super().__init__(time)
        self._per_kilobyte = per_kilobyte
        self._round_trip = round_trip
        self._free = time()
        self.ages: list[float] = []
        """Of the oldest picture of each batch when all of it was there, seconds."""
        self.keys = 0

    def runs(self, seconds: float, delta: int, key: int) -> None:
        """Each requested key frame is the next frame."""
        began, asked = self.time(), -1
        for number in range(round(seconds * 30)):
            self._until(began + number / 30)
            wanted, asked = self.asked > asked, self.asked
            self.put(number, "h264", key=wanted, size=key if wanted else delta)
            self._until(self.time())

    def _until(self, moment: float) -> None:
        """Sends the next frames as the link takes bytes."""
        while self._free <= moment:
            self.time.now = max(self._free, self.time.now)
            taken = self.waiting.take()
            if not taken:
                break
            size = sum(len(each.body) for each in taken)
            self._free = self.time.now + self._round_trip + size / 1000 * self._per_kilobyte
            self.keys += taken[0].key
            self.ages.append(self._free - (taken[0].good_until - STALE_SECONDS))
        self.time.now = moment


def test_over_a_thin_link_no_frame_of_h264_is_older_than_a_second(time: Time) -> None:
    """Waiting frames are sent only if they arrive soon; otherwise the next key frame is awaited."""
    line = ThinLine(time, per_kilobyte=1 / 100)
    line.runs(30, delta=8000, key=37_000)
    # The first key frame alone does not show the rate of the link.
    assert max(line.ages[2:]) < 1.05
    assert line.keys > 10


def test_a_key_frame_goes_over_the_thinnest_link(line: Line, time: Time) -> None:
    """It is sent without its successors, and the next one is requested."""
    for number, size in ((1, 10_000), (2, 40_000)):
        line.put(number, "h264", size=size)
        assert line.taken == [number]
        time.now += size / 20_000
    assert line.taken == []
    line.put(3, "h264", size=40_000)
    line.put(4, "h264", key=False)
    assert (line.taken, line.asked) == ([3], 1)


def test_a_long_round_trip_is_no_slow_link(time: Time) -> None:
    """A delay that does not depend on the size is ignored."""
    line = ThinLine(time, per_kilobyte=1 / 5000, round_trip=0.4)
    line.runs(30, delta=2000, key=30_000)
    assert (line.asked, line.keys) == (0, 1)


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere not all of it is known")
def test_a_disconnected_viewer_is_noticed_while_nothing_is_written() -> None:
    """Within a minute, not the usual two hours."""
    with socket.socket() as handle:
        assert frames.limit_send_buffer(SimpleNamespace(getHandle=lambda: handle)) is not None
        assert handle.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE)
        idle, between, times = (
            handle.getsockopt(socket.IPPROTO_TCP, each)
            for each in (socket.TCP_KEEPIDLE, socket.TCP_KEEPINTVL, socket.TCP_KEEPCNT)
        )
        assert idle + between * times <= 60


def test_frame_is_rendered_once_for_all() -> None:
    """Each frame is rendered again."""
    made: list[int] = []

    def make(each: VideoFrameInfo) -> bytes:
        made.append(each.number)
        return each.body

    shared = RenderCache(make)
    one, two = picture(1, 0.0), picture(2, 0.0)
    assert shared.rendered(one) is shared.rendered(one)
    shared.rendered(two)
    assert made == [1, 2]
