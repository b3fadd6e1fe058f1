"""What waits on the way to the relay."""

from __future__ import annotations

from typing import cast

from hypothesis import given
from hypothesis import strategies as st
from twisted.internet.task import Clock

from relay_protocol.frames import PART, SAMPLE, FrameDecoder, SampleFrame
from relay_protocol.limits import ROBOT_FRAME
from robot_client.channel.uplink import LANE_BYTES, MAX_BYTES, SLOW_LINK, TOO_LARGE, WHOLE, Uplink
from robot_client.channel.uplink import PART as PART_BYTES


def samples(uplink: Uplink) -> list[SampleFrame]:
    """All that waits, as the relay joins it."""
    decoder, out = FrameDecoder(ROBOT_FRAME), []
    while chunk := uplink.take(2**16):
        for frame in decoder.feed(b"".join(chunk)):
            assert isinstance(frame, SampleFrame)
            out.append(frame)
    assert decoder.buffered == 0
    return out


def bodies(uplink: Uplink) -> list[bytes]:
    return [each.body for each in samples(uplink)]


def kinds(chunk: list[bytes]) -> list[tuple[int, int]]:
    """Kind and number of each frame."""
    return [(frame[4], int.from_bytes(frame[5:9], "big")) for frame in chunk]


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


def test_large_sample_goes_in_parts() -> None:
    """A sample over 64 KiB goes in parts of 32 KiB, one at a time; a smaller one goes whole."""
    link = uplink(Clock())
    link.offer(1, 5, bytes(WHOLE))
    assert kinds(link.take(2**16)) == [(SAMPLE, 1)]
    body = bytes(range(256)) * 400
    link.offer(1, 6, body)
    chunks = [link.take(2**16) for _ in range(4)]
    assert [kinds(chunk) for chunk in chunks] == [[(PART, 1)]] * 4
    assert [len(chunk[0]) for chunk in chunks] == [25 + PART_BYTES] * 3 + [25 + len(body) - 3 * PART_BYTES]
    decoder = FrameDecoder(ROBOT_FRAME)
    assert decoder.feed(b"".join(b"".join(chunk) for chunk in chunks)) == [SampleFrame(1, 6, body)]
    assert link.take(2**16) == []


def test_small_samples_go_between_parts() -> None:
    """What is small waits for one part of a large sample at most, however large it is."""
    link = uplink(Clock())
    link.open(2)
    link.offer(1, 0, bytes(6_000_000))
    link.take(2**16)
    for number in range(100):
        link.offer(2, number, b"odometry")
        assert kinds(link.take(2**16)) == [(SAMPLE, 2), (PART, 1)]
    assert link.dropped == 0


def test_flood_of_small_samples_does_not_stop_a_large_one() -> None:
    """However many small samples wait, each look at them is followed by a part."""
    link = uplink(Clock())
    link.open(2)
    link.offer(1, 0, bytes(3 * PART_BYTES))
    for _ in range(1000):
        link.offer(2, 0, bytes(1000))
    assert [kinds(link.take(2**16))[-1] for _ in range(3)] == [(PART, 1)] * 3


def test_large_samples_take_turns() -> None:
    """Large samples of several subscriptions share the link part by part."""
    link = uplink(Clock())
    link.open(2)
    link.offer(1, 0, bytes(10 * PART_BYTES))
    link.offer(2, 0, bytes(3 * PART_BYTES))
    assert [kinds(link.take(2**16))[0][1] for _ in range(8)] == [1, 2, 1, 2, 1, 2, 1, 1]


def test_no_sample_overtakes_another_of_its_subscription() -> None:
    """A small sample behind a large one of the same subscription waits for it, one before it goes first."""
    link = uplink(Clock())
    link.offer(1, 1, b"before")
    link.offer(1, 2, bytes(WHOLE + 1))
    link.offer(1, 3, b"after")
    link.offer(1, 4, bytes(WHOLE + 1))
    assert [each.stamp for each in samples(link)] == [1, 2, 3, 4]


def test_sample_that_has_begun_is_finished() -> None:
    """While the transport is full a begun sample is neither replaced nor too old; what waits behind it is."""
    clock = Clock()
    link = uplink(clock)
    decoder = FrameDecoder(ROBOT_FRAME)
    link.offer(1, 0, bytes([0]) * 2 * LANE_BYTES)
    got = decoder.feed(b"".join(link.take(2**16)))
    link.paused = True
    for number in range(1, 10):
        clock.advance(0.5)
        link.offer(1, number, bytes([number]) * 2 * LANE_BYTES)
    link.paused = False
    while chunk := link.take(2**16):
        got += decoder.feed(b"".join(chunk))
    assert [each.body[0] for each in got] == [0, 9]
    assert link.dropped == 8


def test_old_large_sample_goes() -> None:
    """A large sample that could not begin for more than a second is dropped, also when nothing newer comes."""
    clock = Clock()
    link = uplink(clock)
    link.paused = True
    link.offer(1, 0, bytes(WHOLE + 1))
    clock.advance(1.5)
    link.paused = False
    assert bodies(link) == []
    assert link.dropped == 1


def test_closed_subscription_leaves_nothing_with_the_relay() -> None:
    """A sample that is broken off takes no memory of the relay: what was unfinished is ended."""
    link, decoder = uplink(Clock()), FrameDecoder(ROBOT_FRAME)
    link.offer(1, 7, bytes(PART_BYTES + WHOLE))
    decoder.feed(b"".join(link.take(2**16)))
    assert decoder.buffered
    link.close(1)
    assert decoder.feed(b"".join(link.take(2**16))) == [SampleFrame(1, 7, b"\0")]
    assert decoder.buffered == 0
    assert not link.ready


def test_unfinished_samples_fit_the_relay() -> None:
    """However many large samples there are, the unfinished ones together are no more than the relay holds."""
    link = Uplink(Clock().seconds, 2**20)
    for number in range(1, 41):
        link.open(number)
        link.offer(number, 0, bytes(300_000))
    decoder, got = FrameDecoder(2**20), []
    while chunk := link.take(2**16):
        got += decoder.feed(b"".join(chunk))
        assert decoder.buffered <= 2**20
    assert sorted(each.number for each in got if isinstance(each, SampleFrame)) == list(range(1, 41))


@given(
    st.lists(
        st.one_of(
            st.tuples(st.just("offer"), st.integers(1, 4), st.sampled_from([1, 70_000, 200_000, 900_000])),
            st.tuples(st.just("take"), st.integers(1, 3), st.just(0)),
            st.tuples(st.just("pause"), st.integers(0, 1), st.just(0)),
            st.tuples(st.just("wait"), st.integers(1, 900), st.just(0)),
            st.tuples(st.just("close"), st.integers(1, 4), st.just(0)),
        ),
        max_size=60,
    )
)
def test_what_arrives_is_whole_and_in_order(steps: list[tuple[str, int, int]]) -> None:
    """Whatever happens, the relay can join what it gets, in order within a subscription, and all else is counted."""
    clock, offered, closed = Clock(), 0, 0
    link, decoder = Uplink(clock.seconds, 2**20), FrameDecoder(2**20)
    got: list[SampleFrame] = []

    def take(times: int) -> None:
        for _ in range(times):
            got.extend(cast("list[SampleFrame]", decoder.feed(b"".join(link.take(2**16)))))

    for number in range(1, 5):
        link.open(number)
    for what, number, size in steps:
        if what == "offer":
            offered += 1
            link.offer(number, offered, bytes(size))
        elif what == "take":
            take(number)
        elif what == "pause":
            link.paused = bool(number)
        elif what == "wait":
            clock.advance(number / 1000)
        else:
            closed += 1
            link.close(number)
            link.open(number)
    link.paused = False
    while link.ready:
        take(1)
    assert decoder.buffered == 0
    assert link.waiting == 0
    for number in range(1, 5):
        stamps = [each.stamp for each in got if each.number == number and each.body != b"\0"]
        assert stamps == sorted(stamps)
    if not closed:
        assert len(got) + link.dropped == offered


def test_muted_subscription_sends_nothing_and_others_go_on() -> None:
    """Also what waited, or was held back by a throttle, is let go; what has begun is finished."""
    uplink = Uplink(lambda: 0.0)
    for number in (1, 2):
        uplink.open(number)
    uplink.open(3, throttle=1.0)
    uplink.offer(1, 0, bytes(3 * PART_BYTES))
    begun = uplink.take(1)
    for number in (1, 1, 2, 3, 3):
        uplink.offer(number, 0, b"x")
    for number in (1, 3):
        uplink.mute(number, hold=False)
        assert not uplink.offer(number, 0, b"y")
    left = begun
    while uplink.ready:
        left += uplink.take(1)
    frames = FrameDecoder(2**25).feed(b"".join(left))
    assert sorted((each.number, len(each.body)) for each in frames) == [(1, 3 * PART_BYTES), (2, 1)]
    assert (uplink.waiting, uplink.held, uplink.next_due()) == (0, 0, None)


def test_muted_subscription_with_hold_repeats_what_left_last() -> None:
    """What left, not what came; without any it says nothing."""
    uplink = Uplink(lambda: 0.0)
    uplink.open(1)
    uplink.mute(1, hold=True)
    assert not uplink.offer(1, 0, b"a")
    uplink.unmute(1)
    uplink.offer(1, 0, b"b")
    uplink.take(1)
    uplink.offer(1, 0, b"c")
    uplink.mute(1, hold=True)
    assert uplink.offer(1, 7, b"d")
    assert FrameDecoder(2**25).feed(b"".join(uplink.take(1))) == [SampleFrame(1, 7, b"b")]


def test_latched_samples_that_came_while_muted_go_afterwards() -> None:
    """All of them: each may be of another publisher, which does not publish again. Others are not made up for."""
    uplink = Uplink(lambda: 0.0)
    uplink.open(1, latched=True)
    uplink.open(2)
    for number in (1, 2):
        uplink.mute(number, hold=False)
        uplink.offer(number, 5, b"old")
        uplink.offer(number, 6, b"new")
    assert uplink.unmute(1)
    assert not uplink.unmute(2)
    went = FrameDecoder(2**25).feed(b"".join(uplink.take(100)))
    assert went == [SampleFrame(1, 5, b"old"), SampleFrame(1, 6, b"new")]


def test_latched_sample_is_newer_than_what_stood_for_it() -> None:
    """While the last value is held it goes by a stamp before that of the sample, which would be a repetition else."""
    uplink = Uplink(lambda: 0.0)
    uplink.open(1, latched=True)
    uplink.offer(1, 100, b"kept")
    uplink.take(1)
    uplink.mute(1, hold=True)
    uplink.offer(1, 200, b"new")
    uplink.offer(1, 300, b"newer")
    uplink.unmute(1)
    went = FrameDecoder(2**25).feed(b"".join(uplink.take(100)))
    assert [each.body for each in went] == [b"kept", b"kept", b"new", b"newer"]
    stamps = [each.stamp for each in went]
    assert stamps == sorted(set(stamps))
    assert stamps[2:] == [200, 300]


def test_muting_what_is_not_there_is_passed_over() -> None:
    """A subscription that has ended, or was never muted."""
    uplink = Uplink(lambda: 0.0)
    uplink.mute(1, hold=True)
    assert not uplink.unmute(1)
    uplink.open(1)
    assert not uplink.unmute(1)


HUGE = 3 * ROBOT_FRAME


def test_a_sample_larger_than_a_frame_goes_in_parts() -> None:
    """Up to the limit of samples; one at a time, and others go on beside it."""
    link = Uplink(Clock().seconds, ROBOT_FRAME, HUGE)
    for number in (1, 2, 3):
        link.open(number)
    decoder, out, most = FrameDecoder(ROBOT_FRAME), [], 0
    decoder.sample_limit = HUGE
    link.offer(1, 5, bytes(HUGE))
    out += decoder.feed(b"".join(link.take(2**16)))
    link.offer(2, 6, bytes(HUGE))
    link.offer(3, 7, bytes(100_000))
    while chunk := link.take(2**16):
        out += decoder.feed(b"".join(chunk))
        most = max(most, decoder.buffered)
    assert [(each.number, len(each.body)) for each in out if isinstance(each, SampleFrame)] == [
        (3, 100_000), (1, HUGE), (2, HUGE)
    ]  # fmt: skip
    assert most < HUGE + 200_000
    assert link.dropped == 0


def test_what_is_lost_is_told_by_subscription_and_reason() -> None:
    """How many, and how large: too large for the relay, or too much for the link."""
    link = Uplink(Clock().seconds, ROBOT_FRAME, HUGE)
    link.open(1)
    link.open(2)
    for size in (HUGE + 1, HUGE + 7):
        link.offer(1, 0, bytes(size))
    link.paused = True
    for _ in range(3):
        link.offer(2, 0, bytes(LANE_BYTES))
    told = {key: (loss.count, loss.size) for key, loss in link.lost.items()}
    assert told == {(1, TOO_LARGE): (2, HUGE + 7), (2, SLOW_LINK): (2, LANE_BYTES)}
    assert link.dropped == 4
