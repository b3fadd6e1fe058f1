"""The queue for a slow receiver."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st

from relay_server.common import send_queue as module
from relay_server.common.send_queue import Lasting, SendQueue

MIB = 1024 * 1024


class Receiver:
    """A send queue with a transport that takes bytes only on request."""

    def __init__(self) -> None:
        self.now = 0.0
        self.got: list[bytes] = []
        self.cut = 0
        self.takes = 10**9
        self.outbox = SendQueue(self._write, lambda: self.now, self._overflow)

    def _write(self, message: bytes) -> None:
        assert self.outbox.paused_since is None, "written while paused"
        self.got.append(message)
        self.takes -= 1
        if self.takes == 0:
            self.outbox.pause()

    def _overflow(self) -> None:
        self.cut += 1

    def resume(self, takes: int = 10**9) -> list[bytes]:
        """Lets some messages through; returns them."""
        self.got, self.takes = [], takes
        self.outbox.resume()
        return self.got


def paused() -> Receiver:
    """A receiver that takes no bytes."""
    receiver = Receiver()
    receiver.outbox.pause()
    return receiver


def test_it_returns_whether_a_message_passes() -> None:
    """It returns whether a message passes directly: only while the transport is open and not paused."""
    outbox = Receiver().outbox
    said = [outbox.passing]
    for change in (outbox.pause, outbox.resume, outbox.pause, outbox.close, outbox.resume):
        change()
        said.append(outbox.passing)
    assert said == [True, False, True, False, False, False]


def test_fast_receiver_gets_messages_directly() -> None:
    """Messages are not queued while the transport takes bytes."""
    receiver = Receiver()
    receiver.outbox.send_reliable(b"a")
    receiver.outbox.send_droppable("t", b"b")
    assert receiver.got == [b"a", b"b"]
    assert receiver.outbox.waiting_bytes == 0


def test_control_goes_before_data_and_keeps_its_order() -> None:
    """After a pause replies are sent first, in their order."""
    receiver = paused()
    receiver.outbox.send_droppable("t", b"data")
    receiver.outbox.send_reliable(b"one")
    receiver.outbox.send_reliable(b"two")
    assert receiver.resume() == [b"one", b"two", b"data"]


def test_topics_take_turns() -> None:
    """A topic with many samples does not delay one with few."""
    receiver = paused()
    for number in range(3):
        receiver.outbox.send_droppable("busy", b"busy%d" % number)
    receiver.outbox.send_droppable("rare", b"rare")
    assert receiver.resume() == [b"busy0", b"rare", b"busy1", b"busy2"]


def test_turns_go_on_where_they_were_when_the_transport_fills_again() -> None:
    """Pauses change neither order nor turns."""
    receiver = paused()
    for number in range(3):
        receiver.outbox.send_droppable("a", b"a%d" % number)
        receiver.outbox.send_droppable("b", b"b%d" % number)
    got = [*receiver.resume(1), *receiver.resume(2), *receiver.resume()]
    assert got == [b"a0", b"b0", b"a1", b"b1", b"a2", b"b2"]


def test_the_newest_samples_survive_the_depth() -> None:
    """The oldest are dropped and counted."""
    receiver = paused()
    for number in range(10):
        receiver.outbox.send_droppable("t", b"%d" % number, depth=3)
    assert receiver.outbox.dropped == 7
    assert receiver.resume() == [b"7", b"8", b"9"]


def test_a_depth_below_one_keeps_the_newest() -> None:
    """A client may ask for any queue length; this must not empty the queue while it is read."""
    receiver = paused()
    receiver.outbox.send_droppable("t", b"old", depth=0)
    receiver.outbox.send_droppable("t", b"new", depth=-5)
    assert receiver.resume() == [b"new"]


def test_samples_older_than_the_age_limit_are_dropped_but_the_newest_stays() -> None:
    """A burst of old samples after a pause is avoided, and each topic's last sample is kept."""
    receiver = paused()
    receiver.outbox.send_droppable("t", b"old")
    receiver.outbox.send_droppable("t", b"older than a second")
    receiver.outbox.send_droppable("u", b"last")
    receiver.now += module.DATA_AGE + 1
    assert receiver.resume() == [b"older than a second", b"last"]
    assert receiver.outbox.dropped == 1
    assert receiver.outbox.waiting_bytes == 0


def test_the_fullest_topic_loses_samples_first() -> None:
    """A point cloud does not displace the joint states."""
    receiver = paused()
    receiver.outbox.send_droppable("small", b"s1")
    receiver.outbox.send_droppable("small", b"s2")
    for _ in range(8):
        receiver.outbox.send_droppable("cloud", bytes(MIB // 2))
    assert receiver.outbox.waiting_bytes <= module.DATA_BYTES
    assert [each for each in receiver.resume() if len(each) == 2] == [b"s1", b"s2"]


def test_single_large_samples_of_many_topics_stay_within_twice_the_bound() -> None:
    """The bytes for one slow receiver are limited for any mix of sizes and topics."""
    receiver = paused()
    for number in range(8):
        receiver.outbox.send_droppable(number, b"small")
        receiver.outbox.send_droppable(number, bytes(3 * MIB + MIB // 2))
        assert receiver.outbox.waiting_bytes <= 2 * module.DATA_BYTES


def test_a_sample_larger_than_all_bounds_has_room_alone() -> None:
    """For example a point cloud beside a few poses for a slow client; a second one is dropped and counted."""
    receiver = paused()
    receiver.outbox.send_droppable("pose", bytes(100))
    receiver.outbox.send_droppable("cloud", bytes(20 * MIB))
    receiver.outbox.send_droppable("cloud", bytes(18 * MIB))
    receiver.outbox.send_droppable("other", bytes(18 * MIB))
    assert receiver.outbox.drops == {"cloud": 1, "other": 1}
    assert sorted(map(len, receiver.resume())) == [100, 18 * MIB]


class Mesh:
    """A message that is rendered when it is sent."""

    size = 20 * MIB


def test_an_undroppable_message_waits_however_much_data_waits() -> None:
    """It leaves data its room, and is sent in turn with it."""
    receiver = paused()
    outbox = receiver.outbox
    outbox.render = lambda key, message: b"mesh" if isinstance(message, Mesh) else None
    for number in range(4):
        outbox.send_droppable(number, bytes(MIB // 2))
    outbox.send_undroppable("mesh", Mesh())
    for number in range(4):
        outbox.send_droppable(number + 4, bytes(MIB // 2))
    assert outbox.waiting_bytes == 4 * MIB
    assert [len(each) for each in receiver.resume(5)] == 4 * [MIB // 2] + [4]
    assert (outbox.drops, outbox.waiting_bytes) == ({}, 2 * MIB)


def test_a_receiver_whose_replies_pile_up_is_cut_once() -> None:
    """Control messages are never dropped, so over the limit the receiver is disconnected and its queue is
    freed.
    """
    receiver = paused()
    for _ in range(module.CONTROL_MESSAGES + 5):
        receiver.outbox.send_reliable(b"reply")
    assert receiver.cut == 1
    assert receiver.outbox.waiting_bytes == 0
    assert receiver.resume() == []


def test_few_large_replies_cut_too() -> None:
    """The limit is in bytes as well."""
    receiver = paused()
    for _ in range(3):
        receiver.outbox.send_reliable(bytes(MIB))
    assert receiver.cut == 1


def test_a_forgotten_topic_frees_its_bytes() -> None:
    """Samples of a topic without subscriptions are discarded."""
    receiver = paused()
    receiver.outbox.send_droppable("t", b"12345")
    receiver.outbox.send_droppable("u", b"1")
    receiver.outbox.forget("t")
    receiver.outbox.forget("never seen")
    assert receiver.outbox.waiting_bytes == 1
    assert receiver.resume() == [b"1"]


def test_a_closed_outbox_writes_nothing_any_more() -> None:
    """Neither queued nor later messages are written."""
    receiver = paused()
    receiver.outbox.send_reliable(b"a")
    receiver.outbox.close()
    receiver.outbox.send_droppable("t", b"b")
    receiver.outbox.send_reliable(b"c")
    assert receiver.resume() == []
    assert receiver.outbox.waiting_bytes == 0


STEPS = st.lists(
    st.one_of(
        st.tuples(st.just("data"), st.integers(0, 4), st.integers(0, 3 * MIB), st.integers(-1, 6)),
        st.tuples(st.just("control"), st.integers(0, 300_000)),
        st.tuples(st.just("pause")),
        st.tuples(st.just("resume"), st.integers(1, 6)),
        st.tuples(st.just("forget"), st.integers(0, 4)),
        st.tuples(st.just("wait"), st.floats(0, 2)),
    ),
    max_size=40,
)


@given(STEPS)
@settings(deadline=None, max_examples=150)
def test_the_account_of_waiting_bytes_never_drifts(steps: list[tuple[str, int, int, int]]) -> None:
    """After random operations the counted bytes are those in the queue, within limits, and newest last."""
    receiver = Receiver()
    box = receiver.outbox
    for serial, (what, *values) in enumerate(steps):
        if what == "data":
            box.send_droppable(values[0], serial.to_bytes(4, "big") + bytes(values[1]), values[2])
        elif what == "control":
            box.send_reliable(serial.to_bytes(4, "big") + bytes(values[0]))
        elif what == "resume":
            receiver.resume(values[0])
        elif what == "pause":
            box.pause()
        elif what == "forget":
            box.forget(values[0])
        else:
            receiver.now += values[0]
        waiting = sum(size for queue in box._data.values() for _, size, _, _ in queue.samples)
        assert box.waiting_bytes == waiting + sum(map(len, box._control or ()))
        assert all(queue.samples for queue in box._data.values())
        assert waiting <= 2 * module.DATA_BYTES
        assert sum(map(len, box._control or ())) <= module.CONTROL_BYTES
    receiver.resume()
    assert box.waiting_bytes == 0


def test_drops_are_counted_by_topic() -> None:
    """For all reasons; the count of an unsubscribed topic starts at zero again."""
    receiver = Receiver()
    outbox = receiver.outbox
    outbox.pause()
    for number in range(3):
        outbox.send_droppable("a", b"%d" % number, 1)
        outbox.send_droppable("b", b"%d" % number)
    receiver.now += module.DATA_AGE * 2
    outbox.resume()
    assert outbox.drops == {"a": 2, "b": 2}
    assert outbox.dropped == 4
    outbox.forget("a")
    assert outbox.drops == {"b": 2}


def thin(large: int = 1000) -> Receiver:
    """A receiver behind a slow connection with a full window."""
    receiver = Receiver()
    receiver.outbox.set_limits(large, 300_000.0)
    receiver.outbox.window_filled(large=True)
    return receiver


def released(receiver: Receiver) -> list[bytes]:
    """Messages that are sent when the window has room again."""
    receiver.got = []
    receiver.outbox.window_has_room()
    return receiver.got


def test_held_topic_is_no_stall() -> None:
    """A full window does not mean that the receiver has stalled. No sample passes meanwhile."""
    receiver = thin()
    receiver.outbox.send_reliable(b"answer")
    receiver.outbox.send_droppable("t", b"sample")
    assert (receiver.got, receiver.outbox.paused_since, receiver.outbox.passing) == ([], None, False)
    assert released(receiver) == [b"answer", b"sample"]


def test_small_samples_go_before_large_ones_on_a_thin_connection() -> None:
    """All small samples go first, in any order of arrival."""
    receiver = thin()
    receiver.outbox.send_droppable("cloud", bytes(5000))
    for number in range(3):
        receiver.outbox.send_droppable("pose", b"%d" % number)
    receiver.now += 0.2
    assert released(receiver) == [b"0", b"1", b"2"]


def test_a_large_sample_that_held_up_others_leaves_them_as_much_time() -> None:
    """The next large sample waits while small ones pass. Then the newest of its topic is sent."""
    receiver = thin()
    outbox = receiver.outbox
    outbox.send_droppable("pose", b"waited")
    receiver.now += 0.4
    assert released(receiver) == [b"waited"]
    outbox.send_droppable("cloud", b"a" * 5000, depth=1)
    receiver.now += 0.3
    outbox.send_droppable("cloud", b"b" * 5000, depth=1)
    outbox.send_droppable("pose", b"now")
    assert receiver.got == [b"waited", b"now"]
    assert 0 < outbox.large_allowed_in <= 0.11
    receiver.now += outbox.large_allowed_in
    outbox.allow_large()
    assert receiver.got[2:] == [b"b" * 5000]
    assert outbox.passing


def test_a_large_topic_alone_has_the_whole_connection() -> None:
    """No other sample waited, so there is no pause."""
    receiver = thin()
    receiver.now += 0.4
    receiver.outbox.send_droppable("cloud", bytes(5000))
    assert len(released(receiver)) == 1
    assert receiver.outbox.large_allowed_in == 0


def test_small_samples_without_end_do_not_hold_off_a_large_one_for_ever() -> None:
    """After 1 s the large one goes first."""
    receiver = thin()
    outbox = receiver.outbox
    outbox.pause()
    outbox.window_has_room()
    outbox.send_droppable("cloud", bytes(5000))
    sent: list[bytes] = []
    for number in range(20):
        outbox.send_droppable("pose", b"%d" % number)
        sent += receiver.resume(1)
        receiver.now += 0.1
    assert 5 < [len(each) for each in sent].index(5000) < 15


def test_of_a_stream_only_the_last_moments_are_sent_on_a_thin_connection() -> None:
    """Of a burst of events at most 1 s is sent."""
    receiver = thin()
    for number in range(10):
        receiver.outbox.send_droppable("pose", b"%d" % number)
        receiver.now += 0.05
    for number in range(4):
        receiver.outbox.send_droppable("event", b"e%d" % number)
    receiver.now += 0.31
    got = released(receiver)
    assert [each for each in got if each[:1] == b"e"] == [b"e0", b"e1", b"e2", b"e3"]
    assert [each for each in got if each[:1] != b"e"] == [b"6", b"7", b"8", b"9"]
    assert receiver.outbox.drops == {"pose": 6}


def test_lasting_samples_do_not_become_stale() -> None:
    receiver = paused()
    for n in range(6):
        receiver.outbox.send_droppable("stream", b"s%d" % n)
        receiver.outbox.send_droppable("map", b"m%d" % n, lasting=Lasting(2, all_ages=True))
    receiver.now = 5.0
    receiver.outbox.set_limits(1000, 10_000.0)
    got = receiver.resume()
    assert [each for each in got if each[:1] == b"m"] == [b"m%d" % n for n in range(6)]
    assert [each for each in got if each[:1] == b"s"] == [b"s5"]


def test_of_one_publisher_the_newest_do_not_become_stale() -> None:
    receiver = paused()
    for n in range(8):
        receiver.outbox.send_droppable("map", b"m%d" % n, lasting=Lasting(5))
    receiver.now = 5.0
    receiver.outbox.set_limits(1000, 10_000.0)
    assert receiver.resume() == [b"m3", b"m4", b"m5", b"m6", b"m7"]


def test_lasting_samples_are_evicted_after_others() -> None:
    receiver = paused()
    for _ in range(3):
        receiver.outbox.send_droppable("map", bytes(MIB // 2), lasting=Lasting(2, all_ages=True))
    for n in range(4):
        receiver.outbox.send_droppable("stream", bytes([n]) * (MIB // 4))
    assert [len(each) for each in receiver.resume()].count(MIB // 2) == 3
    receiver.outbox.pause()
    for _ in range(20):
        receiver.outbox.send_droppable("map", bytes(MIB // 2), lasting=Lasting(2, all_ages=True))
    assert receiver.outbox.waiting_bytes <= 2 * MIB


def test_a_sample_of_each_publisher_of_a_latched_topic_arrives() -> None:
    """However many bytes they have together, within a bound, and whatever depth the client requests."""
    receiver = paused()
    receiver.outbox.send_droppable("stream", b"s")
    for n in range(12):
        receiver.outbox.send_droppable("map", bytes([n]) * 500_000, 1, lasting=Lasting(10, all_ages=True))
    for n in range(5):
        receiver.outbox.send_droppable("stream", bytes([n]) * (MIB // 2))
    got = receiver.resume()
    assert [each[0] for each in got if len(each) == 500_000] == list(range(2, 12))
    assert [each[0] for each in got if len(each) == MIB // 2] == [1, 2, 3, 4]
    receiver.outbox.pause()
    for n in range(20):
        receiver.outbox.send_droppable("map", bytes([n]) * MIB, lasting=Lasting(20, all_ages=True))
    assert [each[0] for each in receiver.resume()] == list(range(4, 20))


def middling_wait(receiver: Receiver) -> None:
    """Ten topics of 20 kB wait on a slow connection."""
    receiver.outbox.set_limits(30_000, 300_000.0)
    for n in range(10):
        receiver.outbox.send_droppable(f"middling {n}", b"m%d" % n + bytes(20_000))


def test_small_samples_pass_middling_ones_on_a_slow_connection() -> None:
    receiver = paused()
    middling_wait(receiver)
    receiver.outbox.send_droppable("pose", b"pose")
    got = receiver.resume()
    assert got[0] == b"pose"
    assert [each[:2] for each in got[1:]] == [b"m%d" % n for n in range(10)]


def test_middling_samples_come_in_turn_with_many_small_ones() -> None:
    receiver = paused()
    middling_wait(receiver)
    for n in range(100):
        receiver.outbox.send_droppable(f"small {n}", b"s" * 1000)
    got = [each[:1] for each in receiver.resume()]
    assert got.index(b"m") in range(10, 20)
    assert got[:80].count(b"m") == 4
    assert (got.count(b"m"), got.count(b"s")) == (10, 100)
