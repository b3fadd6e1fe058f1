"""What waits for a slow receiver."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st

from relay_server.common import send_queue as module
from relay_server.common.send_queue import SendQueue

MIB = 1024 * 1024


class Receiver:
    """An outbox with a transport that takes bytes only when it is told to."""

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
        """Let some messages through; what came."""
        self.got, self.takes = [], takes
        self.outbox.resume()
        return self.got


def paused() -> Receiver:
    """A receiver that takes nothing."""
    receiver = Receiver()
    receiver.outbox.pause()
    return receiver


def test_it_says_whether_what_is_sent_passes() -> None:
    """Only while the transport takes bytes and nobody has closed."""
    outbox = Receiver().outbox
    said = [outbox.passing]
    for change in (outbox.pause, outbox.resume, outbox.pause, outbox.close, outbox.resume):
        change()
        said.append(outbox.passing)
    assert said == [True, False, True, False, False, False]


def test_what_is_sent_to_a_fast_receiver_passes_straight_through() -> None:
    """Nothing waits while the transport takes bytes."""
    receiver = Receiver()
    receiver.outbox.control(b"a")
    receiver.outbox.data("t", b"b")
    assert receiver.got == [b"a", b"b"]
    assert receiver.outbox.waiting_bytes == 0


def test_control_goes_before_data_and_keeps_its_order() -> None:
    """After a pause replies come first, as they were given."""
    receiver = paused()
    receiver.outbox.data("t", b"data")
    receiver.outbox.control(b"one")
    receiver.outbox.control(b"two")
    assert receiver.resume() == [b"one", b"two", b"data"]


def test_topics_take_turns() -> None:
    """A topic with many samples does not hold up one with few."""
    receiver = paused()
    for number in range(3):
        receiver.outbox.data("busy", b"busy%d" % number)
    receiver.outbox.data("rare", b"rare")
    assert receiver.resume() == [b"busy0", b"rare", b"busy1", b"busy2"]


def test_turns_go_on_where_they_were_when_the_transport_fills_again() -> None:
    """Being paused in between changes neither order nor turns."""
    receiver = paused()
    for number in range(3):
        receiver.outbox.data("a", b"a%d" % number)
        receiver.outbox.data("b", b"b%d" % number)
    got = [*receiver.resume(1), *receiver.resume(2), *receiver.resume()]
    assert got == [b"a0", b"b0", b"a1", b"b1", b"a2", b"b2"]


def test_the_newest_samples_survive_the_depth() -> None:
    """The oldest give way, and are counted."""
    receiver = paused()
    for number in range(10):
        receiver.outbox.data("t", b"%d" % number, depth=3)
    assert receiver.outbox.dropped == 7
    assert receiver.resume() == [b"7", b"8", b"9"]


def test_a_depth_below_one_keeps_the_newest() -> None:
    """A client's queue length may be any number: it must not empty the queue under our feet."""
    receiver = paused()
    receiver.outbox.data("t", b"old", depth=0)
    receiver.outbox.data("t", b"new", depth=-5)
    assert receiver.resume() == [b"new"]


def test_samples_older_than_the_age_limit_give_way_but_the_newest_stays() -> None:
    """After a stall there is no burst of stale samples, and a topic's last word is not lost."""
    receiver = paused()
    receiver.outbox.data("t", b"old")
    receiver.outbox.data("t", b"older than a second")
    receiver.outbox.data("u", b"last")
    receiver.now += module.DATA_AGE + 1
    assert receiver.resume() == [b"older than a second", b"last"]
    assert receiver.outbox.dropped == 1
    assert receiver.outbox.waiting_bytes == 0


def test_the_fullest_topic_gives_way_to_the_others() -> None:
    """A point cloud does not push out the joint states."""
    receiver = paused()
    receiver.outbox.data("small", b"s1")
    receiver.outbox.data("small", b"s2")
    for _ in range(8):
        receiver.outbox.data("cloud", bytes(MIB // 2))
    assert receiver.outbox.waiting_bytes <= module.DATA_BYTES
    assert [each for each in receiver.resume() if len(each) == 2] == [b"s1", b"s2"]


def test_single_large_samples_of_many_topics_stay_within_twice_the_bound() -> None:
    """However sizes and topics fall: bytes of one slow receiver have a bound."""
    receiver = paused()
    for number in range(8):
        receiver.outbox.data(number, b"small")
        receiver.outbox.data(number, bytes(3 * MIB + MIB // 2))
        assert receiver.outbox.waiting_bytes <= 2 * module.DATA_BYTES


def test_a_sample_larger_than_all_bounds_has_room_alone() -> None:
    """An organised cloud beside a few poses, for a client that has just been slow; a second one gives way, counted."""
    receiver = paused()
    receiver.outbox.data("pose", bytes(100))
    receiver.outbox.data("cloud", bytes(20 * MIB))
    receiver.outbox.data("cloud", bytes(18 * MIB))
    receiver.outbox.data("other", bytes(18 * MIB))
    assert receiver.outbox.drops == {"cloud": 1, "other": 1}
    assert sorted(map(len, receiver.resume())) == [100, 18 * MIB]


def test_a_receiver_whose_replies_pile_up_is_cut_once() -> None:
    """Control is never dropped; over the bound the receiver must go, and nothing is kept for it."""
    receiver = paused()
    for _ in range(module.CONTROL_MESSAGES + 5):
        receiver.outbox.control(b"reply")
    assert receiver.cut == 1
    assert receiver.outbox.waiting_bytes == 0
    assert receiver.resume() == []


def test_few_large_replies_cut_too() -> None:
    """The bound is in bytes as well."""
    receiver = paused()
    for _ in range(3):
        receiver.outbox.control(bytes(MIB))
    assert receiver.cut == 1


def test_a_forgotten_topic_frees_its_bytes() -> None:
    """What waits of a topic nobody wants is let go."""
    receiver = paused()
    receiver.outbox.data("t", b"12345")
    receiver.outbox.data("u", b"1")
    receiver.outbox.forget("t")
    receiver.outbox.forget("never seen")
    assert receiver.outbox.waiting_bytes == 1
    assert receiver.resume() == [b"1"]


def test_a_closed_outbox_writes_nothing_any_more() -> None:
    """Neither what waited nor what comes later."""
    receiver = paused()
    receiver.outbox.control(b"a")
    receiver.outbox.close()
    receiver.outbox.data("t", b"b")
    receiver.outbox.control(b"c")
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
    """Whatever happens in whatever order: what is counted is what waits, within the bounds, and newest last."""
    receiver = Receiver()
    box = receiver.outbox
    for serial, (what, *values) in enumerate(steps):
        if what == "data":
            box.data(values[0], serial.to_bytes(4, "big") + bytes(values[1]), values[2])
        elif what == "control":
            box.control(serial.to_bytes(4, "big") + bytes(values[0]))
        elif what == "resume":
            receiver.resume(values[0])
        elif what == "pause":
            box.pause()
        elif what == "forget":
            box.forget(values[0])
        else:
            receiver.now += values[0]
        waiting = sum(size for queue in box._data.values() for _, size, _ in queue.samples)
        assert box.waiting_bytes == waiting + sum(map(len, box._control or ()))
        assert all(queue.samples for queue in box._data.values())
        assert waiting <= 2 * module.DATA_BYTES
        assert sum(map(len, box._control or ())) <= module.CONTROL_BYTES
    receiver.resume()
    assert box.waiting_bytes == 0


def test_drops_are_counted_by_topic() -> None:
    """However they came about; what is forgotten is counted from zero again."""
    receiver = Receiver()
    outbox = receiver.outbox
    outbox.pause()
    for number in range(3):
        outbox.data("a", b"%d" % number, 1)
        outbox.data("b", b"%d" % number)
    receiver.now += module.DATA_AGE * 2
    outbox.resume()
    assert outbox.drops == {"a": 2, "b": 2}
    assert outbox.dropped == 4
    outbox.forget("a")
    assert outbox.drops == {"b": 2}


def thin(large: int = 1000) -> Receiver:
    """A receiver behind a thin connection, whose window is full."""
    receiver = Receiver()
    receiver.outbox.limit(large, 300_000.0)
    receiver.outbox.hold(large=True)
    return receiver


def released(receiver: Receiver) -> list[bytes]:
    """What goes when there is room again."""
    receiver.got = []
    receiver.outbox.release()
    return receiver.got


def test_what_is_held_is_no_stall() -> None:
    """A full window says nothing about whether the receiver takes anything; nothing passes meanwhile."""
    receiver = thin()
    receiver.outbox.control(b"answer")
    receiver.outbox.data("t", b"sample")
    assert (receiver.got, receiver.outbox.paused_since, receiver.outbox.passing) == ([], None, False)
    assert released(receiver) == [b"answer", b"sample"]


def test_small_samples_go_before_large_ones_on_a_thin_connection() -> None:
    """All of them, whatever came first."""
    receiver = thin()
    receiver.outbox.data("cloud", bytes(5000))
    for number in range(3):
        receiver.outbox.data("pose", b"%d" % number)
    receiver.now += 0.2
    assert released(receiver) == [b"0", b"1", b"2"]


def test_a_large_sample_that_held_up_others_leaves_them_as_much_time() -> None:
    """The next large one waits, small ones pass at once meanwhile; then it goes, the newest of its topic."""
    receiver = thin()
    outbox = receiver.outbox
    outbox.data("pose", b"waited")
    receiver.now += 0.4
    assert released(receiver) == [b"waited"]
    outbox.data("cloud", b"a" * 5000, depth=1)
    receiver.now += 0.3
    outbox.data("cloud", b"b" * 5000, depth=1)
    outbox.data("pose", b"now")
    assert receiver.got == [b"waited", b"now"]
    assert 0 < outbox.opens_in <= 0.11
    receiver.now += outbox.opens_in
    outbox.open()
    assert receiver.got[2:] == [b"b" * 5000]
    assert outbox.passing


def test_a_large_topic_alone_has_the_whole_connection() -> None:
    """Nobody waited, so nobody is given time."""
    receiver = thin()
    receiver.now += 0.4
    receiver.outbox.data("cloud", bytes(5000))
    assert len(released(receiver)) == 1
    assert receiver.outbox.opens_in == 0


def test_small_samples_without_end_do_not_hold_off_a_large_one_for_ever() -> None:
    """After a second it goes first."""
    receiver = thin()
    outbox = receiver.outbox
    outbox.pause()
    outbox.release()
    outbox.data("cloud", bytes(5000))
    sent: list[bytes] = []
    for number in range(20):
        outbox.data("pose", b"%d" % number)
        sent += receiver.resume(1)
        receiver.now += 0.1
    assert 5 < [len(each) for each in sent].index(5000) < 15


def test_of_a_stream_only_the_last_moments_are_sent_on_a_thin_connection() -> None:
    """Of a burst, as events are, a second."""
    receiver = thin()
    for number in range(10):
        receiver.outbox.data("pose", b"%d" % number)
        receiver.now += 0.05
    for number in range(4):
        receiver.outbox.data("event", b"e%d" % number)
    receiver.now += 0.31
    got = released(receiver)
    assert [each for each in got if each[:1] == b"e"] == [b"e0", b"e1", b"e2", b"e3"]
    assert [each for each in got if each[:1] != b"e"] == [b"6", b"7", b"8", b"9"]
    assert receiver.outbox.drops == {"pose": 6}
