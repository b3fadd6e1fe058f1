"""Which picture is next, and what it is made into."""

from __future__ import annotations

import socket
import sys
from types import SimpleNamespace

import pytest

from relay_server.video import viewing
from relay_server.video.frames import STALE_SECONDS, VideoFrameInfo
from relay_server.video.snapshot import Snapshot
from relay_server.video.viewing import FrameQueue, RenderCache
from tests.relay_server.memory import Time


def picture(
    number: int, at: float, codec: str = "jpeg", *, key: bool = True, size: int = 3
) -> VideoFrameInfo:
    """One that arrived then."""
    return VideoFrameInfo(number, 0.0, at + STALE_SECONDS, codec, 32, 24, key, bytes(size))


class Line:
    """Pictures that wait, and how often a new beginning was asked for."""

    def __init__(self, time: Time) -> None:
        self.asked = 0
        self.time = time
        self.waiting = FrameQueue(time, self._anew)

    def _anew(self) -> None:
        self.asked += 1

    def put(self, number: int, codec: str = "jpeg", *, key: bool = True, size: int = 3) -> None:
        """A picture that comes now."""
        self.waiting.put(picture(number, self.time(), codec, key=key, size=size))

    @property
    def taken(self) -> list[int]:
        """Numbers of what goes now."""
        return [each.number for each in self.waiting.take()]


@pytest.fixture
def line(time: Time) -> Line:
    """Nothing waits."""
    return Line(time)


def test_the_newest_picture_takes_the_place_of_those_before(line: Line) -> None:
    """And goes once."""
    for number in (1, 2, 3):
        line.put(number)
    assert (line.taken, line.taken) == ([3], [])


def test_a_picture_that_has_waited_too_long_is_not_sent(line: Line, time: Time) -> None:
    """Half a second."""
    line.put(1)
    time.now += STALE_SECONDS + 0.01
    assert line.taken == []
    line.put(2)
    time.now += STALE_SECONDS - 0.01
    assert line.taken == [2]


def test_a_snapshot_is_no_old_picture(time: Time) -> None:
    """It waits for one that is not."""
    snapshot = Snapshot(time)
    snapshot.picture(picture(1, time() - 2 * STALE_SECONDS))
    assert not snapshot.done.called
    snapshot.picture(picture(2, time()))
    assert snapshot.done.result.number == 2


def test_of_h264_all_go_since_the_last_that_stands_alone(line: Line) -> None:
    """The later ones need those before."""
    line.put(1, "h264")
    line.put(2, "h264", key=False)
    line.put(3, "h264")
    line.put(4, "h264", key=False)
    line.put(5, "h264", key=False)
    assert line.taken == [3, 4, 5]
    assert not line.asked


def test_where_one_of_h264_is_left_out_a_new_beginning_is_asked_for(line: Line, time: Time) -> None:
    """Too old, or too much."""
    line.put(1, "h264")
    time.now += STALE_SECONDS + 0.01
    line.put(2, "h264", key=False)
    assert (line.taken, line.asked) == ([], 1)
    line.put(3, "h264", size=viewing.WAITING_BYTES)
    assert line.asked == 1
    line.put(4, "h264", key=False)
    assert (line.taken, line.asked) == ([], 2)


class ThinLine(Line):
    """H.264, 30 pictures a second, over a link that takes its time.

    :param per_kilobyte: seconds
    :param way: seconds there and back
    """

    def __init__(self, time: Time, per_kilobyte: float, way: float = 0.0) -> None:
        super().__init__(time)
        self._per_kilobyte = per_kilobyte
        self._way = way
        self._free = time()
        self.ages: list[float] = []
        """Of the oldest picture of each batch when all of it was there, seconds."""
        self.keys = 0

    def runs(self, seconds: float, delta: int, key: int) -> None:
        """Each key frame that is asked for is the next picture."""
        began, asked = self.time(), -1
        for number in range(round(seconds * 30)):
            self._until(began + number / 30)
            wanted, asked = self.asked > asked, self.asked
            self.put(number, "h264", key=wanted, size=key if wanted else delta)
            self._until(self.time())

    def _until(self, moment: float) -> None:
        """What the link has taken by then lets the next go."""
        while self._free <= moment:
            self.time.now = max(self._free, self.time.now)
            taken = self.waiting.take()
            if not taken:
                break
            size = sum(len(each.body) for each in taken)
            self._free = self.time.now + self._way + size / 1000 * self._per_kilobyte
            self.keys += taken[0].key
            self.ages.append(self._free - (taken[0].good_until - STALE_SECONDS))
        self.time.now = moment


def test_over_a_thin_link_no_picture_of_h264_is_older_than_a_second(time: Time) -> None:
    """What came meanwhile goes only as far as it is there soon; else one that stands alone is waited for."""
    line = ThinLine(time, per_kilobyte=1 / 100)
    line.runs(30, delta=8000, key=37_000)
    # The first key frame alone does not tell how fast the link is.
    assert max(line.ages[2:]) < 1.05
    assert line.keys > 10


def test_a_key_frame_goes_over_the_thinnest_link(line: Line, time: Time) -> None:
    """Alone; what followed it is left out, and the next one asked for."""
    for number, size in ((1, 10_000), (2, 40_000)):
        line.put(number, "h264", size=size)
        assert line.taken == [number]
        time.now += size / 20_000
    assert line.taken == []
    line.put(3, "h264", size=40_000)
    line.put(4, "h264", key=False)
    assert (line.taken, line.asked) == ([3], 1)


def test_a_long_way_is_no_thin_link(time: Time) -> None:
    """What takes the same time for little and much is left out of account."""
    line = ThinLine(time, per_kilobyte=1 / 5000, way=0.4)
    line.runs(30, delta=2000, key=30_000)
    assert (line.asked, line.keys) == (0, 1)


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere not all of it is known")
def test_a_viewer_who_vanished_is_noticed_while_nothing_is_written() -> None:
    """In a minute, not in the two hours that are usual."""
    with socket.socket() as handle:
        assert viewing.limit_send_buffer(SimpleNamespace(getHandle=lambda: handle)) is not None
        assert handle.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE)
        idle, between, times = (
            handle.getsockopt(socket.IPPROTO_TCP, each)
            for each in (socket.TCP_KEEPIDLE, socket.TCP_KEEPINTVL, socket.TCP_KEEPCNT)
        )
        assert idle + between * times <= 60


def test_what_is_made_of_a_picture_is_made_once_for_all() -> None:
    """Anew for another picture."""
    made: list[int] = []

    def make(each: VideoFrameInfo) -> bytes:
        made.append(each.number)
        return each.body

    shared = RenderCache(make)
    one, two = picture(1, 0.0), picture(2, 0.0)
    assert shared.of(one) is shared.of(one)
    shared.of(two)
    assert made == [1, 2]
