"""What waits on the way to the relay."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st
from twisted.internet.task import Clock

from relay_protocol.frames import FrameDecoder, SampleFrame
from robot_client.uplink import LANE_BYTES, MAX_BYTES, Uplink


def bodies(uplink: Uplink) -> list[bytes]:
    out = []
    while chunk := uplink.take(2**16):
        for frame in FrameDecoder(2**25).feed(b"".join(chunk)):
            assert isinstance(frame, SampleFrame)
            out.append(frame.body)
    return out


def uplink(clock: Clock, throttle: float = 0.0, latched: bool = False) -> Uplink:
    made = Uplink(clock.seconds)
    made.open(1, throttle, latched)
    return made


def test_samples_pass_in_order() -> None:
    """While the transport takes data, nothing is lost or reordered."""
    link = uplink(Clock())
    for number in range(1000):
        link.offer(1, number, b"%d" % number)
    assert bodies(link) == [b"%d" % number for number in range(1000)]
    assert link.dropped == 0


def test_newest_picture_survives_a_full_transport() -> None:
    """Of big samples only the newest waits; the others are counted."""
    link = uplink(Clock())
    link.paused = True
    for number in range(10):
        link.offer(1, 0, bytes([number]) * LANE_BYTES)
    assert link.take(2**16) == []
    link.paused = False
    assert bodies(link) == [bytes([9]) * LANE_BYTES]
    assert link.dropped == 9


def test_small_samples_wait_out_a_short_pause() -> None:
    """A burst of small samples is not lost to a pause of half a second."""
    clock = Clock()
    link = uplink(clock)
    link.paused = True
    for number in range(500):
        link.offer(1, 0, b"%d" % number)
        clock.advance(0.001)
    link.paused = False
    assert len(bodies(link)) == 500


def test_old_samples_go() -> None:
    """What waited for more than a second is dropped."""
    clock = Clock()
    link = uplink(clock)
    link.paused = True
    link.offer(1, 0, b"old")
    clock.advance(1.5)
    link.offer(1, 0, b"new")
    link.paused = False
    assert bodies(link) == [b"new"]
    assert link.dropped == 1


def test_last_of_a_latched_topic_stays() -> None:
    """The only message of a map is kept however long the transport is full."""
    clock = Clock()
    link = uplink(clock, latched=True)
    link.paused = True
    link.offer(1, 0, b"map")
    clock.advance(60)
    link.trim()
    link.paused = False
    assert bodies(link) == [b"map"]


@given(st.lists(st.tuples(st.integers(1, 8), st.integers(0, 2**20)), max_size=60))
def test_waiting_is_bounded(offers: list[tuple[int, int]]) -> None:
    """Whatever comes while the transport is full, no more than 4 MiB wait, and nothing is uncounted."""
    link = Uplink(Clock().seconds)
    for number in range(1, 9):
        link.open(number)
    link.paused = True
    for number, size in offers:
        link.offer(number, 0, bytes(size))
        assert link.waiting <= MAX_BYTES
    link.paused = False
    assert len(bodies(link)) + link.dropped == len(offers)
    assert link.waiting == 0


def test_throttle_keeps_the_last_of_a_burst() -> None:
    """Of a burst the first passes at once and the last when its time has come."""
    clock = Clock()
    link = uplink(clock, throttle=0.5)
    for number in range(5):
        link.offer(1, 0, b"%d" % number)
    assert bodies(link) == [b"0"]
    assert link.next_due() == 0.5
    clock.advance(0.5)
    link.release()
    assert bodies(link) == [b"4"]
    assert link.next_due() is None
    assert link.dropped == 0


def test_throttle_can_change() -> None:
    """A subscription whose throttle is lowered lets its held sample go earlier."""
    clock = Clock()
    link = uplink(clock, throttle=10.0)
    link.offer(1, 0, b"a")
    link.offer(1, 0, b"b")
    link.open(1, 0.1)
    assert link.next_due() is not None
    clock.advance(0.11)
    link.release()
    assert bodies(link) == [b"a", b"b"]


def test_sample_over_the_relays_limit_is_dropped() -> None:
    """A sample the relay would refuse is not sent, and counted."""
    link = Uplink(Clock().seconds, frame_limit=100)
    link.open(1)
    link.offer(1, 0, bytes(88))
    link.offer(1, 0, bytes(87))
    assert [len(body) for body in bodies(link)] == [87]
    assert (link.dropped, link.oversized) == (1, 1)


def test_closed_subscription_leaves_nothing() -> None:
    """What waits of an ended subscription is gone, and later samples are passed over."""
    link = uplink(Clock())
    link.offer(1, 0, b"x")
    link.close(1)
    link.offer(1, 0, b"y")
    assert bodies(link) == []
    assert link.waiting == 0
