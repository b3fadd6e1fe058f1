"""Subscriptions of one client to one topic, merged."""

from __future__ import annotations

from typing import Any

import pytest
from twisted.internet.task import Clock

from relay_protocol import rosbridge
from relay_protocol.ros_types import TypeRegistry
from relay_server.channels import client_subscription as module
from relay_server.channels.client_subscription import ClientSubscription
from relay_server.channels.encodings import MessageEncoding
from relay_server.channels.samples import Converter, Sample


class MemorySubscriber:
    """A receiver that stores samples."""

    def __init__(self) -> None:
        self.got: list[Sample] = []
        self.plain_instead = 0
        self.queued_bytes = 0
        self.drops = 0

    def deliver(self, subscription: ClientSubscription, sample: Sample) -> None:
        """Stores it."""
        self.got.append(sample)

    def dropped(self, subscription: ClientSubscription) -> None:
        """Counts it."""
        self.drops += 1

    def notify(self, level: str, text: str, id: rosbridge.Id = None) -> None:
        """Ignores it."""


def listening(*asks: dict[str, Any]) -> tuple[Clock, MemorySubscriber, ClientSubscription]:
    """A subscription with these options, its clock and its receiver."""
    clock, subscriber = Clock(), MemorySubscriber()
    listener = ClientSubscription(clock, subscriber, "/scan")
    for number, fields in enumerate(asks):
        add(listener, id=number, **fields)
    return clock, subscriber, listener


def add(listener: ClientSubscription, form: MessageEncoding = MessageEncoding(), **fields: Any) -> None:  # noqa: B008
    """Adds a subscription."""
    listener.add(rosbridge.Subscribe(**{"topic": "/scan", **fields}), form)


def sample(body: bytes = b"{}") -> Sample:
    """A sample."""
    return Sample(body, 0, Converter(TypeRegistry(), "", "json", print))


def burst(listener: ClientSubscription, *bodies: bytes) -> None:
    """Samples that arrive at once."""
    for body in bodies:
        listener.receive(sample(body))


def bodies(subscriber: MemorySubscriber) -> list[bytes]:
    """Bodies of the received samples."""
    return [each.body for each in subscriber.got]


def test_the_least_and_the_latest_count() -> None:
    """The lowest throttle and fragment size, and the latest compression."""
    _, _, listener = listening(
        {"throttle_rate": 100, "form": MessageEncoding("png", 500)},
        {"throttle_rate": 50, "form": MessageEncoding("cbor", 0)},
        {"throttle_rate": 200, "form": MessageEncoding("none", 300)},
    )
    assert listener.throttle == 0.05
    assert listener.format.encoding == MessageEncoding("none", 300)
    listener.remove("/scan", 2)
    assert listener.format.encoding == MessageEncoding("cbor", 500)
    listener.remove("/scan", 0)
    assert listener.format.encoding == MessageEncoding("cbor", 0)


def test_asking_again_is_the_latest() -> None:
    """A repeated id replaces its former subscription and counts as the latest."""
    _, _, listener = listening({"form": MessageEncoding("png")}, {"form": MessageEncoding("cbor")})
    add(listener, MessageEncoding("cbor-raw"), id=0)
    assert listener.format.encoding == MessageEncoding("cbor-raw")
    listener.remove("/scan", 0)
    assert listener.format.encoding == MessageEncoding("cbor")


def test_every_spelling_counts() -> None:
    """Each spelling is sent once until its last subscription ends, with and without ids."""
    _, _, listener = listening()
    for topic, id in (("scan", None), ("/scan", None), ("scan", "a")):
        add(listener, topic=topic, id=id)
    assert listener.format.names == ("scan", "/scan")
    assert listener.remove("scan", None)
    assert listener.format.names == ("/scan", "scan")
    assert listener.remove("/scan", "a")
    assert listener.format.names == ("/scan",)
    assert listener.remove("/scan", "never heard of")
    assert not listener.remove("/scan", None)


def test_a_shorter_throttle_counts_at_once() -> None:
    """A sample that waits is sent at the end of the shorter throttle."""
    clock, subscriber, listener = listening({"throttle_rate": 10_000})
    listener.receive(sample())
    listener.receive(sample())
    add(listener, id="quick", throttle_rate=100)
    clock.advance(0.05)
    assert len(subscriber.got) == 1
    clock.advance(0.05)
    assert len(subscriber.got) == 2


def test_a_longer_throttle_counts_at_once() -> None:
    """When the fast subscription ends, a waiting sample waits for the slow one."""
    clock, subscriber, listener = listening({"throttle_rate": 1000}, {"throttle_rate": 100})
    listener.receive(sample())
    listener.receive(sample())
    listener.remove("/scan", 1)
    clock.advance(0.9)
    assert len(subscriber.got) == 1
    clock.advance(0.1)
    assert len(subscriber.got) == 2


def test_a_queue_is_sent_one_a_throttle() -> None:
    """Samples stay in order; the oldest beyond the queue length are dropped and counted."""
    clock, subscriber, listener = listening({"throttle_rate": 250, "queue_length": 3})
    burst(listener, b"0", b"1", b"2", b"3", b"4", b"5")
    for count in (1, 2, 3, 4, 4):
        assert len(subscriber.got) == count
        clock.advance(0.125)
        assert len(subscriber.got) == count
        clock.advance(0.125)
    assert bodies(subscriber) == [b"0", b"3", b"4", b"5"]
    assert (subscriber.drops, subscriber.queued_bytes) == (2, 0)
    assert not clock.getDelayedCalls()
    burst(listener, b"6", b"7")
    assert bodies(subscriber)[4:] == [b"6"]


def test_queue_is_not_overtaken() -> None:
    """Not even by a sample that arrives at the end of the throttle before its timer."""
    clock, subscriber, listener = listening({"throttle_rate": 125, "queue_length": 5})
    burst(listener, b"0", b"1", b"2")
    clock.rightNow += 0.1875
    burst(listener, b"3")
    for _ in range(4):
        clock.advance(0.125)
    assert bodies(subscriber) == [b"0", b"1", b"2", b"3"]


def test_the_longest_queue_counts() -> None:
    """When its subscription ends, samples beyond the next queue length are dropped."""
    clock, subscriber, listener = listening(
        {"throttle_rate": 125, "queue_length": 2}, {"throttle_rate": 125, "queue_length": 4}
    )
    burst(listener, b"0", b"1", b"2", b"3", b"4")
    listener.remove("/scan", 1)
    assert (listener.depth, subscriber.drops) == (2, 2)
    for _ in range(3):
        clock.advance(0.125)
    assert bodies(subscriber) == [b"0", b"3", b"4"]


@pytest.mark.parametrize("length", [0, 1])
def test_without_a_queue_the_newest_waits_and_nothing_is_dropped(length: int) -> None:
    """The robot then skips samples that the client does not need."""
    clock, subscriber, listener = listening({"throttle_rate": 125, "queue_length": length})
    burst(listener, b"0", b"1", b"2")
    clock.advance(0.125)
    assert bodies(subscriber) == [b"0", b"2"]
    assert (subscriber.drops, subscriber.queued_bytes) == (0, 0)
    assert listener.robot_throttle == 0.125


def test_a_queue_comes_whole_when_the_throttle_is_lifted() -> None:
    """Samples stay in order, before newer ones, or are sent at once."""
    clock, subscriber, listener = listening({"throttle_rate": 1250, "queue_length": 5})
    burst(listener, b"0", b"1", b"2")
    add(listener, id="now")
    burst(listener, b"3")
    assert bodies(subscriber) == [b"0", b"1", b"2", b"3"]
    listener.remove("/scan", "now")
    burst(listener, b"4", b"5", b"6")
    add(listener, id="now")
    clock.advance(0)
    assert bodies(subscriber)[4:] == [b"4", b"5", b"6"]
    assert not clock.getDelayedCalls()


def test_a_queue_is_bounded_in_bytes() -> None:
    """Per topic and per client; the newest sample of each topic stays."""
    _, subscriber, listener = listening({"throttle_rate": 1250, "queue_length": 100})
    other = ClientSubscription(listener._clock, subscriber, "/other")
    add(other, throttle_rate=1000, queue_length=10)
    half = b"x" * (module.QUEUE_BYTES // 2)
    burst(listener, b"first", half, half, half)
    assert (subscriber.queued_bytes, subscriber.drops) == (2 * len(half), 1)
    burst(other, b"first", bytes(module.QUEUES_BYTES))
    assert subscriber.drops == 1
    burst(other, b"newest")
    assert (subscriber.queued_bytes, subscriber.drops) == (2 * len(half) + len(b"newest"), 2)
    other.close()
    listener.close()
    assert subscriber.queued_bytes == 0


def test_a_queue_has_a_longest_length() -> None:
    _, subscriber, listener = listening({"throttle_rate": 1250, "queue_length": 10**30})
    burst(listener, *[b"{}"] * (module.QUEUE_LENGTH + 3))
    assert subscriber.queued_bytes == 2 * module.QUEUE_LENGTH
    assert subscriber.drops == 2


def test_queue_is_dropped_at_the_end() -> None:
    """Its timer is cancelled too."""
    clock, subscriber, listener = listening({"throttle_rate": 125, "queue_length": 5})
    burst(listener, b"0", b"1", b"2")
    listener.close()
    assert not clock.getDelayedCalls()
    assert (bodies(subscriber), subscriber.queued_bytes) == ([b"0"], 0)


def test_a_latched_sample_passes_a_queue() -> None:
    """It comes from another publisher for a late subscriber, so no throttle applies."""
    _, subscriber, listener = listening({"throttle_rate": 125, "queue_length": 5})
    burst(listener, b"0", b"1")
    listener.replay(sample(b"latched"))
    assert bodies(subscriber) == [b"0", b"latched"]
