"""Subscriptions of one client to one topic, merged."""

from __future__ import annotations

from typing import Any

from twisted.internet.task import Clock

from relay_protocol import rosbridge
from relay_protocol.ros_types import TypeRegistry
from relay_server.channels import client_subscription as module
from relay_server.channels.client_subscription import ClientSubscription
from relay_server.channels.encodings import MessageEncoding
from relay_server.channels.samples import Converter, Sample
from relay_server.common.cpu_quota import UserQuotas


class Desk:
    """A receiver that keeps what it gets."""

    def __init__(self) -> None:
        self.got: list[Sample] = []
        self.plain_instead = 0
        self.queued_bytes = 0
        self.drops = 0
        self.allowance = UserQuotas(lambda: 0.0, lambda: 0.0).of(1)

    def deliver(self, listener: ClientSubscription, parcel: Sample) -> None:
        """Keep it."""
        self.got.append(parcel)

    def dropped(self, listener: ClientSubscription) -> None:
        """Count it."""
        self.drops += 1

    def tell(self, level: str, text: str, id: rosbridge.Id = None) -> None:
        """Nobody listens."""


def listening(*asks: dict[str, Any]) -> tuple[Clock, Desk, ClientSubscription]:
    """A listener with these subscriptions; the clock and the receiver."""
    clock, desk = Clock(), Desk()
    listener = ClientSubscription(clock, desk, "/scan")
    for number, fields in enumerate(asks):
        add(listener, id=number, **fields)
    return clock, desk, listener


def add(listener: ClientSubscription, form: MessageEncoding = MessageEncoding(), **fields: Any) -> None:  # noqa: B008
    """One more subscription."""
    listener.add(rosbridge.Subscribe(**{"topic": "/scan", **fields}), form)


def sample(body: bytes = b"{}") -> Sample:
    """Some sample."""
    return Sample(body, 0, Converter(TypeRegistry(), "", "json", print))


def burst(listener: ClientSubscription, *bodies: bytes) -> None:
    """Samples that come at once."""
    for body in bodies:
        listener.offer(sample(body))


def bodies(desk: Desk) -> list[bytes]:
    """What has come."""
    return [each.body for each in desk.got]


def test_the_least_and_the_latest_count() -> None:
    """Least throttle, least size of fragments of those given, latest compression."""
    _, _, listener = listening(
        {"throttle_rate": 100, "form": MessageEncoding("png", 500)},
        {"throttle_rate": 50, "form": MessageEncoding("cbor", 0)},
        {"throttle_rate": 200, "form": MessageEncoding("none", 300)},
    )
    assert listener.throttle == 0.05
    assert listener.wish.form == MessageEncoding("none", 300)
    listener.remove("/scan", 2)
    assert listener.wish.form == MessageEncoding("cbor", 500)
    listener.remove("/scan", 0)
    assert listener.wish.form == MessageEncoding("cbor", 0)


def test_asking_again_is_the_latest() -> None:
    """The same id anew replaces the former, and counts as the latest."""
    _, _, listener = listening({"form": MessageEncoding("png")}, {"form": MessageEncoding("cbor")})
    add(listener, MessageEncoding("cbor-raw"), id=0)
    assert listener.wish.form == MessageEncoding("cbor-raw")
    listener.remove("/scan", 0)
    assert listener.wish.form == MessageEncoding("cbor")


def test_every_spelling_counts() -> None:
    """Each once, however often subscribed, until the last of it is gone; also without ids."""
    _, _, listener = listening()
    for topic, id in (("scan", None), ("/scan", None), ("scan", "a")):
        add(listener, topic=topic, id=id)
    assert listener.wish.names == ("scan", "/scan")
    assert listener.remove("scan", None)
    assert listener.wish.names == ("/scan", "scan")
    assert listener.remove("/scan", "a")
    assert listener.wish.names == ("/scan",)
    assert listener.remove("/scan", "never heard of")
    assert not listener.remove("/scan", None)


def test_a_shorter_throttle_counts_at_once() -> None:
    """What waits under the longer one is sent at the end of the shorter one."""
    clock, desk, listener = listening({"throttle_rate": 10_000})
    listener.offer(sample())
    listener.offer(sample())
    add(listener, id="quick", throttle_rate=100)
    clock.advance(0.05)
    assert len(desk.got) == 1
    clock.advance(0.05)
    assert len(desk.got) == 2


def test_a_longer_throttle_counts_at_once() -> None:
    """When the quick subscription goes, what waits waits for the slow one."""
    clock, desk, listener = listening({"throttle_rate": 1000}, {"throttle_rate": 100})
    listener.offer(sample())
    listener.offer(sample())
    listener.remove("/scan", 1)
    clock.advance(0.9)
    assert len(desk.got) == 1
    clock.advance(0.1)
    assert len(desk.got) == 2


def test_a_queue_is_sent_one_a_throttle() -> None:
    """In order; of more than its length the oldest give way and are counted."""
    clock, desk, listener = listening({"throttle_rate": 250, "queue_length": 3})
    burst(listener, b"0", b"1", b"2", b"3", b"4", b"5")
    for count in (1, 2, 3, 4, 4):
        assert len(desk.got) == count
        clock.advance(0.125)
        assert len(desk.got) == count
        clock.advance(0.125)
    assert bodies(desk) == [b"0", b"3", b"4", b"5"]
    assert (desk.drops, desk.queued_bytes) == (2, 0)
    assert not clock.getDelayedCalls()
    burst(listener, b"6", b"7")
    assert bodies(desk)[4:] == [b"6"]


def test_nothing_overtakes_a_queue() -> None:
    """Not even what comes when the throttle is over but the timer has not come yet."""
    clock, desk, listener = listening({"throttle_rate": 125, "queue_length": 5})
    burst(listener, b"0", b"1", b"2")
    clock.rightNow += 0.1875
    burst(listener, b"3")
    for _ in range(4):
        clock.advance(0.125)
    assert bodies(desk) == [b"0", b"1", b"2", b"3"]


def test_the_longest_queue_counts() -> None:
    """Of several subscriptions; when it ends, what is beyond the other's gives way."""
    clock, desk, listener = listening(
        {"throttle_rate": 125, "queue_length": 2}, {"throttle_rate": 125, "queue_length": 4}
    )
    burst(listener, b"0", b"1", b"2", b"3", b"4")
    listener.remove("/scan", 1)
    assert (listener.depth, desk.drops) == (2, 2)
    for _ in range(3):
        clock.advance(0.125)
    assert bodies(desk) == [b"0", b"3", b"4"]


def test_without_a_queue_the_newest_waits_and_nothing_is_dropped() -> None:
    """A throttle alone leaves out what the client does not want."""
    clock, desk, listener = listening({"throttle_rate": 125})
    burst(listener, b"0", b"1", b"2")
    clock.advance(0.125)
    assert bodies(desk) == [b"0", b"2"]
    assert (desk.drops, desk.queued_bytes) == (0, 0)


def test_a_queue_comes_whole_when_the_throttle_is_lifted() -> None:
    """In order, before what comes then, or at once when nothing comes."""
    clock, desk, listener = listening({"throttle_rate": 1250, "queue_length": 5})
    burst(listener, b"0", b"1", b"2")
    add(listener, id="now")
    burst(listener, b"3")
    assert bodies(desk) == [b"0", b"1", b"2", b"3"]
    listener.remove("/scan", "now")
    burst(listener, b"4", b"5", b"6")
    add(listener, id="now")
    clock.advance(0)
    assert bodies(desk)[4:] == [b"4", b"5", b"6"]
    assert not clock.getDelayedCalls()


def test_a_queue_is_bounded_in_bytes() -> None:
    """For one topic and for one client; the newest of each topic stays."""
    _, desk, listener = listening({"throttle_rate": 1250, "queue_length": 100})
    other = ClientSubscription(listener._clock, desk, "/other")
    add(other, throttle_rate=1000, queue_length=10)
    half = b"x" * (module.QUEUE_BYTES // 2)
    burst(listener, b"first", half, half, half)
    assert (desk.queued_bytes, desk.drops) == (2 * len(half), 1)
    burst(other, b"first", bytes(module.QUEUES_BYTES))
    assert desk.drops == 1
    burst(other, b"newest")
    assert (desk.queued_bytes, desk.drops) == (2 * len(half) + len(b"newest"), 2)
    other.close()
    listener.close()
    assert desk.queued_bytes == 0


def test_a_queue_has_a_longest_length() -> None:
    """Whatever is written."""
    _, desk, listener = listening({"throttle_rate": 1250, "queue_length": 10**30})
    burst(listener, *[b"{}"] * (module.QUEUE_LENGTH + 3))
    assert desk.queued_bytes == 2 * module.QUEUE_LENGTH
    assert desk.drops == 2


def test_nothing_of_a_queue_is_sent_after_the_end() -> None:
    """It is let go with its timer."""
    clock, desk, listener = listening({"throttle_rate": 125, "queue_length": 5})
    burst(listener, b"0", b"1", b"2")
    listener.close()
    assert not clock.getDelayedCalls()
    assert (bodies(desk), desk.queued_bytes) == ([b"0"], 0)


def test_a_latched_sample_passes_a_queue() -> None:
    """It is a late joiner's, of another publisher, and no throttle holds it."""
    _, desk, listener = listening({"throttle_rate": 125, "queue_length": 5})
    burst(listener, b"0", b"1")
    listener.replay(sample(b"latched"))
    assert bodies(desk) == [b"0", b"latched"]
