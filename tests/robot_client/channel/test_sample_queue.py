"""The queue of samples for the relay."""

from __future__ import annotations

from typing import cast

from hypothesis import given
from hypothesis import strategies as st
from twisted.internet.task import Clock

from relay_protocol.frames import PART, SAMPLE, FrameDecoder, SampleFrame
from relay_protocol.limits import MIB, ROBOT_FRAME
from robot_client.channel.sample_queue import (
    LARGE,
    MAX_BYTES,
    SLOW_LINK,
    SUBSCRIPTION_BYTES,
    TOO_LARGE,
    SampleQueue,
)
from robot_client.channel.sample_queue import PART as PART_BYTES


def samples(queue: SampleQueue) -> list[SampleFrame]:
    """All queued samples, as the relay joins their parts."""
    decoder, out = FrameDecoder(ROBOT_FRAME), []
    while chunk := queue.next_frames(2**16):
        for frame in decoder.feed(b"".join(chunk)):
            assert isinstance(frame, SampleFrame)
            out.append(frame)
    assert decoder.buffered == 0
    return out


def bodies(queue: SampleQueue) -> list[bytes]:
    return [each.body for each in samples(queue)]


def kinds(chunk: list[bytes]) -> list[tuple[int, int]]:
    """Kind and number of each frame."""
    return [(frame[4], int.from_bytes(frame[5:9], "big")) for frame in chunk]


def sample_queue(clock: Clock, throttle: float = 0.0, latched: bool = False) -> SampleQueue:
    made = SampleQueue(clock.seconds)
    made.open(1, throttle, latched)
    return made


def test_samples_pass_in_order() -> None:
    """While the transport has room."""
    queue = sample_queue(Clock())
    for number in range(1000):
        queue.enqueue(1, number, b"%d" % number)
    assert bodies(queue) == [b"%d" % number for number in range(1000)]
    assert queue.dropped == 0


def test_newest_image_survives_a_full_transport() -> None:
    """The others are counted as dropped."""
    queue = sample_queue(Clock())
    queue.paused = True
    for number in range(10):
        queue.enqueue(1, 0, bytes([number]) * SUBSCRIPTION_BYTES)
    assert queue.next_frames(2**16) == []
    queue.paused = False
    assert bodies(queue) == [bytes([9]) * SUBSCRIPTION_BYTES]
    assert queue.dropped == 9


def test_small_samples_survive_a_short_pause() -> None:
    clock = Clock()
    queue = sample_queue(clock)
    queue.paused = True
    for number in range(500):
        queue.enqueue(1, 0, b"%d" % number)
        clock.advance(0.001)
    queue.paused = False
    assert len(bodies(queue)) == 500


def test_samples_older_than_a_second_are_dropped() -> None:
    clock = Clock()
    queue = sample_queue(clock)
    queue.paused = True
    queue.enqueue(1, 0, b"old")
    clock.advance(1.5)
    queue.enqueue(1, 0, b"new")
    queue.paused = False
    assert bodies(queue) == [b"new"]
    assert queue.dropped == 1


def test_latched_samples_do_not_expire() -> None:
    clock = Clock()
    queue = sample_queue(clock, latched=True)
    queue.paused = True
    queue.enqueue(1, 0, b"map")
    clock.advance(60)
    queue.trim()
    queue.paused = False
    assert bodies(queue) == [b"map"]


@given(st.lists(st.tuples(st.integers(1, 8), st.integers(0, 2**20)), max_size=60))
def test_queue_is_bounded(offers: list[tuple[int, int]]) -> None:
    """At 4 MiB; every dropped sample is counted."""
    queue = SampleQueue(Clock().seconds)
    for number in range(1, 9):
        queue.open(number)
    queue.paused = True
    for number, size in offers:
        queue.enqueue(number, 0, bytes(size))
        assert queue.waiting <= MAX_BYTES
    queue.paused = False
    assert len(bodies(queue)) + queue.dropped == len(offers)
    assert queue.waiting == 0


def test_throttle_keeps_the_last_of_a_burst() -> None:
    """The first passes at once."""
    clock = Clock()
    queue = sample_queue(clock, throttle=0.5)
    for number in range(5):
        queue.enqueue(1, 0, b"%d" % number)
    assert bodies(queue) == [b"0"]
    assert queue.next_due() == 0.5
    clock.advance(0.5)
    queue.release_throttled()
    assert bodies(queue) == [b"4"]
    assert queue.next_due() is None
    assert queue.dropped == 0


def test_throttle_can_change() -> None:
    """A lower throttle lets the held sample pass earlier."""
    clock = Clock()
    queue = sample_queue(clock, throttle=10.0)
    queue.enqueue(1, 0, b"a")
    queue.enqueue(1, 0, b"b")
    queue.open(1, 0.1)
    assert queue.next_due() is not None
    clock.advance(0.11)
    queue.release_throttled()
    assert bodies(queue) == [b"a", b"b"]


def test_sample_over_the_relays_limit_is_dropped() -> None:
    queue = SampleQueue(Clock().seconds, frame_limit=100)
    queue.open(1)
    queue.enqueue(1, 0, bytes(88))
    queue.enqueue(1, 0, bytes(87))
    assert [len(body) for body in bodies(queue)] == [87]
    assert (queue.dropped, queue.oversized) == (1, 1)


def test_closed_subscription_drops_its_samples() -> None:
    queue = sample_queue(Clock())
    queue.enqueue(1, 0, b"x")
    queue.close(1)
    queue.enqueue(1, 0, b"y")
    assert bodies(queue) == []
    assert queue.waiting == 0


def test_large_sample_is_sent_in_parts() -> None:
    """One at a time."""
    queue = sample_queue(Clock())
    queue.enqueue(1, 5, bytes(LARGE))
    assert kinds(queue.next_frames(2**16)) == [(SAMPLE, 1)]
    body = bytes(range(256)) * 400
    queue.enqueue(1, 6, body)
    chunks = [queue.next_frames(2**16) for _ in range(4)]
    assert [kinds(chunk) for chunk in chunks] == [[(PART, 1)]] * 4
    assert [len(chunk[0]) for chunk in chunks] == [25 + PART_BYTES] * 3 + [25 + len(body) - 3 * PART_BYTES]
    decoder = FrameDecoder(ROBOT_FRAME)
    assert decoder.feed(b"".join(b"".join(chunk) for chunk in chunks)) == [SampleFrame(1, 6, body)]
    assert queue.next_frames(2**16) == []


def test_small_samples_pass_between_parts() -> None:
    queue = sample_queue(Clock())
    queue.open(2)
    queue.enqueue(1, 0, bytes(6_000_000))
    queue.next_frames(2**16)
    for number in range(100):
        queue.enqueue(2, number, b"odometry")
        assert kinds(queue.next_frames(2**16)) == [(SAMPLE, 2), (PART, 1)]
    assert queue.dropped == 0


def test_flood_of_small_samples_does_not_stop_a_large_one() -> None:
    queue = sample_queue(Clock())
    queue.open(2)
    queue.enqueue(1, 0, bytes(3 * PART_BYTES))
    for _ in range(1000):
        queue.enqueue(2, 0, bytes(1000))
    assert [kinds(queue.next_frames(2**16))[-1] for _ in range(3)] == [(PART, 1)] * 3


def test_large_samples_take_turns() -> None:
    """Part by part."""
    queue = sample_queue(Clock())
    queue.open(2)
    queue.enqueue(1, 0, bytes(10 * PART_BYTES))
    queue.enqueue(2, 0, bytes(3 * PART_BYTES))
    assert [kinds(queue.next_frames(2**16))[0][1] for _ in range(8)] == [1, 2, 1, 2, 1, 2, 1, 1]


def test_no_sample_overtakes_another_of_its_subscription() -> None:
    queue = sample_queue(Clock())
    queue.enqueue(1, 1, b"before")
    queue.enqueue(1, 2, bytes(LARGE + 1))
    queue.enqueue(1, 3, b"after")
    queue.enqueue(1, 4, bytes(LARGE + 1))
    assert [each.stamp for each in samples(queue)] == [1, 2, 3, 4]


def test_begun_sample_is_completed() -> None:
    """Samples behind it are replaced."""
    clock = Clock()
    queue = sample_queue(clock)
    decoder = FrameDecoder(ROBOT_FRAME)
    queue.enqueue(1, 0, bytes([0]) * 2 * SUBSCRIPTION_BYTES)
    got = decoder.feed(b"".join(queue.next_frames(2**16)))
    queue.paused = True
    for number in range(1, 10):
        clock.advance(0.5)
        queue.enqueue(1, number, bytes([number]) * 2 * SUBSCRIPTION_BYTES)
    queue.paused = False
    while chunk := queue.next_frames(2**16):
        got += decoder.feed(b"".join(chunk))
    assert [each.body[0] for each in got] == [0, 9]
    assert queue.dropped == 8


def test_large_sample_older_than_a_second_is_dropped() -> None:
    clock = Clock()
    queue = sample_queue(clock)
    queue.paused = True
    queue.enqueue(1, 0, bytes(LARGE + 1))
    clock.advance(1.5)
    queue.paused = False
    assert bodies(queue) == []
    assert queue.dropped == 1


def test_begun_sample_of_a_closed_subscription_is_cancelled() -> None:
    """So it takes no memory of the relay."""
    queue, decoder = sample_queue(Clock()), FrameDecoder(ROBOT_FRAME)
    queue.enqueue(1, 7, bytes(PART_BYTES + LARGE))
    decoder.feed(b"".join(queue.next_frames(2**16)))
    assert decoder.buffered
    queue.close(1)
    assert decoder.feed(b"".join(queue.next_frames(2**16))) == [SampleFrame(1, 7, b"\0")]
    assert decoder.buffered == 0
    assert not queue.ready


def test_begun_samples_fit_into_one_frame_together() -> None:
    queue = SampleQueue(Clock().seconds, 2**20)
    for number in range(1, 41):
        queue.open(number)
        queue.enqueue(number, 0, bytes(300_000))
    decoder, got = FrameDecoder(2**20), []
    while chunk := queue.next_frames(2**16):
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
def test_samples_arrive_whole_and_in_order(steps: list[tuple[str, int, int]]) -> None:
    """For any sequence of events; all others are counted."""
    clock, offered, closed = Clock(), 0, 0
    queue, decoder = SampleQueue(clock.seconds, 2**20), FrameDecoder(2**20)
    got: list[SampleFrame] = []

    def take(times: int) -> None:
        for _ in range(times):
            got.extend(cast("list[SampleFrame]", decoder.feed(b"".join(queue.next_frames(2**16)))))

    for number in range(1, 5):
        queue.open(number)
    for what, number, size in steps:
        if what == "offer":
            offered += 1
            queue.enqueue(number, offered, bytes(size))
        elif what == "take":
            take(number)
        elif what == "pause":
            queue.paused = bool(number)
        elif what == "wait":
            clock.advance(number / 1000)
        else:
            closed += 1
            queue.close(number)
            queue.open(number)
    queue.paused = False
    while queue.ready:
        take(1)
    assert decoder.buffered == 0
    assert queue.waiting == 0
    for number in range(1, 5):
        stamps = [each.stamp for each in got if each.number == number and each.body != b"\0"]
        assert stamps == sorted(stamps)
    if not closed:
        assert len(got) + queue.dropped == offered


def test_inhibited_subscription_sends_nothing() -> None:
    """A begun sample is completed, and others continue."""
    queue = SampleQueue(lambda: 0.0)
    for number in (1, 2):
        queue.open(number)
    queue.open(3, throttle=1.0)
    queue.enqueue(1, 0, bytes(3 * PART_BYTES))
    begun = queue.next_frames(1)
    for number in (1, 1, 2, 3, 3):
        queue.enqueue(number, 0, b"x")
    for number in (1, 3):
        queue.inhibit(number, hold=False)
        assert not queue.enqueue(number, 0, b"y")
    left = begun
    while queue.ready:
        left += queue.next_frames(1)
    frames = FrameDecoder(2**25).feed(b"".join(left))
    assert sorted((each.number, len(each.body)) for each in frames) == [(1, 3 * PART_BYTES), (2, 1)]
    assert (queue.waiting, queue.throttled, queue.next_due()) == (0, 0, None)


def test_held_subscription_repeats_the_last_sample_sent() -> None:
    """Without one it sends nothing."""
    queue = SampleQueue(lambda: 0.0)
    queue.open(1)
    queue.inhibit(1, hold=True)
    assert not queue.enqueue(1, 0, b"a")
    queue.end_inhibition(1)
    queue.enqueue(1, 0, b"b")
    queue.next_frames(1)
    queue.enqueue(1, 0, b"c")
    queue.inhibit(1, hold=True)
    assert queue.enqueue(1, 7, b"d")
    assert FrameDecoder(2**25).feed(b"".join(queue.next_frames(1))) == [SampleFrame(1, 7, b"b")]


def test_small_samples_pass_middling_ones_of_other_subscriptions() -> None:
    """A pose does not wait for ten pictures of 10 kB that a slow link has not taken yet. Each chunk has one of them."""
    queue = sample_queue(Clock())
    for number in range(2, 12):
        queue.open(number)
        queue.enqueue(number, 0, bytes(10_000))
    chunks = []
    for _ in range(3):
        queue.enqueue(1, 0, b"pose")
        queue.enqueue(2, 0, b"small, but of a topic with pictures that wait")
        chunks.append(kinds(queue.next_frames(4)))
    assert chunks == [[(SAMPLE, 1), (SAMPLE, number)] for number in (2, 3, 4)]
    order = [sample.number for sample in samples(queue)]
    assert order == [5, 6, 7, 8, 9, 10, 11, 2, 2, 2]


def test_middling_samples_are_dropped_as_others() -> None:
    """By age and bytes, and with their subscription."""
    clock = Clock()
    queue = sample_queue(clock)
    queue.open(2)
    queue.paused = True
    for number in range(40):
        queue.enqueue(1, number, bytes([number]) * 10_000)
    assert queue.waiting <= SUBSCRIPTION_BYTES
    queue.enqueue(2, 0, b"small")
    clock.advance(1.1)
    queue.enqueue(1, 0, bytes([50]) * 10_000)
    queue.enqueue(2, 0, bytes(10_000))
    queue.trim()
    queue.close(2)
    queue.paused = False
    assert [body[0] for body in bodies(queue)] == [50]
    assert queue.waiting == 0
    queue.enqueue(1, 0, b"small again")
    assert bodies(queue) == [b"small again"]


@given(
    st.lists(st.tuples(st.integers(1, 3), st.sampled_from([10, 3_000, 20_000])), max_size=30),
    st.integers(1, 40_000),
)
def test_each_subscription_keeps_its_order(sent: list[tuple[int, int]], room: int) -> None:
    """Small, middling and large samples overtake only those of other subscriptions."""
    queue = SampleQueue(Clock().seconds)
    decoder, got = FrameDecoder(ROBOT_FRAME), list[tuple[int, int]]()
    for number in (1, 2, 3):
        queue.open(number)
    for stamp, (number, size) in enumerate(sent):
        queue.enqueue(number, stamp, bytes(size))
        if stamp % 3 == 0:
            for frame in decoder.feed(b"".join(queue.next_frames(room))):
                assert isinstance(frame, SampleFrame)
                got.append((frame.number, frame.stamp))
    while chunk := queue.next_frames(room):
        for frame in decoder.feed(b"".join(chunk)):
            assert isinstance(frame, SampleFrame)
            got.append((frame.number, frame.stamp))
    for number in (1, 2, 3):
        assert [stamp for each, stamp in got if each == number] == [
            stamp for stamp, (each, _) in enumerate(sent) if each == number
        ]
    assert not queue.ready
    assert queue.waiting == 0


def test_a_latched_sample_of_each_publisher_survives_a_full_transport() -> None:
    """However large they are together, within a bound; more than the topic has publishers are replaced as others."""
    clock = Clock()
    queue = sample_queue(clock)
    queue.open(1, latched=True, publishers=10)
    queue.open(2)
    has_begun(queue, clock)
    queue.paused = True
    for number in range(12):
        queue.enqueue(1, number, bytes([number]) * 500_000)
        queue.enqueue(2, number, bytes([100 + number]) * 200_000)
    queue.trim()
    queue.paused = False
    got = [body[0] for body in bodies(queue)]
    assert [each for each in got if each < 100] == list(range(2, 12))
    assert [each for each in got if each >= 100] == [111]
    queue.paused = True
    for number in range(10):
        queue.enqueue(1, number, bytes([number]) * 2 * MIB)
    queue.paused = False
    assert [body[0] for body in bodies(queue)] == list(range(2, 10))


def has_begun(queue: SampleQueue, clock: Clock) -> None:
    """What the publishers of a latched topic kept has come, and some time has passed."""
    queue.enqueue(1, 0, b"kept")
    assert b"kept" in bodies(queue)
    clock.advance(1)


def test_all_latched_samples_of_one_publisher_survive_a_full_transport() -> None:
    """They come together when the subscription has just begun. What comes later is replaced by what is newer."""
    clock = Clock()
    queue = sample_queue(clock)
    queue.open(1, latched=True)
    clock.advance(5)
    queue.paused = True
    for number in range(10):
        queue.enqueue(1, number, bytes([number]) * 500_000)
    queue.trim()
    queue.paused = False
    assert [body[0] for body in bodies(queue)] == list(range(10))
    queue = sample_queue(clock)
    queue.open(1, latched=True)
    has_begun(queue, clock)
    queue.paused = True
    for number in range(10):
        queue.enqueue(1, number, bytes([number]) * 500_000)
    queue.paused = False
    assert [body[0] for body in bodies(queue)] == [9]


def test_repeated_samples_survive_a_full_transport_too() -> None:
    """They are of several publishers, and newer samples do not replace them."""
    clock = Clock()
    queue = sample_queue(clock)
    queue.open(1, latched=True, publishers=2)
    has_begun(queue, clock)
    queue.paused = True
    for number in range(1, 5):
        queue.enqueue_latched(1, number, bytes([number]) * 500_000)
    queue.enqueue_latched(1, 0, b"")
    for number in range(5, 9):
        queue.enqueue(1, number, bytes([number]) * 500_000)
    queue.paused = False
    assert [body[:1] for body in bodies(queue)] == [b"\1", b"\2", b"\3", b"\4", b"", b"\7", b"\x08"]


def test_an_inhibition_keeps_a_latched_sample_of_each_publisher() -> None:
    queue = sample_queue(Clock())
    queue.open(1, latched=True, publishers=10)
    queue.inhibit(1, hold=False)
    for number in range(11):
        queue.enqueue(1, number, bytes([number]) * 500_000)
    queue.end_inhibition(1)
    assert [body[0] for body in bodies(queue)] == list(range(1, 11))


def test_latched_samples_that_arrived_during_an_inhibition_are_sent_afterwards() -> None:
    """Each may be the only one of its publisher."""
    queue = SampleQueue(lambda: 0.0)
    queue.open(1, latched=True)
    queue.open(2)
    for number in (1, 2):
        queue.inhibit(number, hold=False)
        queue.enqueue(number, 5, b"old")
        queue.enqueue(number, 6, b"new")
    assert queue.end_inhibition(1)
    assert not queue.end_inhibition(2)
    went = FrameDecoder(2**25).feed(b"".join(queue.next_frames(100)))
    assert went == [SampleFrame(1, 5, b"old"), SampleFrame(1, 6, b"new")]


def test_latched_sample_has_a_later_stamp_than_its_replacement() -> None:
    queue = SampleQueue(lambda: 0.0)
    queue.open(1, latched=True)
    queue.enqueue(1, 100, b"kept")
    queue.next_frames(1)
    queue.inhibit(1, hold=True)
    queue.enqueue(1, 200, b"new")
    queue.enqueue(1, 300, b"newer")
    queue.end_inhibition(1)
    went = FrameDecoder(2**25).feed(b"".join(queue.next_frames(100)))
    assert [each.body for each in went] == [b"kept", b"kept", b"new", b"newer"]
    stamps = [each.stamp for each in went]
    assert stamps == sorted(set(stamps))
    assert stamps[2:] == [200, 300]


def test_inhibition_of_an_unknown_subscription_is_ignored() -> None:
    queue = SampleQueue(lambda: 0.0)
    queue.inhibit(1, hold=True)
    assert not queue.end_inhibition(1)
    queue.open(1)
    assert not queue.end_inhibition(1)


HUGE = 3 * ROBOT_FRAME


def test_sample_larger_than_a_frame_is_sent_in_parts() -> None:
    """One such sample at a time; others pass beside it."""
    queue = SampleQueue(Clock().seconds, ROBOT_FRAME, HUGE)
    for number in (1, 2, 3):
        queue.open(number)
    decoder, out, most = FrameDecoder(ROBOT_FRAME), [], 0
    decoder.sample_limit = HUGE
    queue.enqueue(1, 5, bytes(HUGE))
    out += decoder.feed(b"".join(queue.next_frames(2**16)))
    queue.enqueue(2, 6, bytes(HUGE))
    queue.enqueue(3, 7, bytes(100_000))
    while chunk := queue.next_frames(2**16):
        out += decoder.feed(b"".join(chunk))
        most = max(most, decoder.buffered)
    assert [(each.number, len(each.body)) for each in out if isinstance(each, SampleFrame)] == [
        (3, 100_000), (1, HUGE), (2, HUGE)
    ]  # fmt: skip
    assert most < HUGE + 200_000
    assert queue.dropped == 0


def test_losses_are_counted_by_subscription_and_reason() -> None:
    queue = SampleQueue(Clock().seconds, ROBOT_FRAME, HUGE)
    queue.open(1)
    queue.open(2)
    for size in (HUGE + 1, HUGE + 7):
        queue.enqueue(1, 0, bytes(size))
    queue.paused = True
    for _ in range(3):
        queue.enqueue(2, 0, bytes(SUBSCRIPTION_BYTES))
    losses = {key: (loss.count, loss.size) for key, loss in queue.losses.items()}
    assert losses == {(1, TOO_LARGE): (2, HUGE + 7), (2, SLOW_LINK): (2, SUBSCRIPTION_BYTES)}
    assert queue.dropped == 4
