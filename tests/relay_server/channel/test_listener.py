"""Subscriptions of one client to one topic, merged."""

from __future__ import annotations

from typing import Any

from twisted.internet.task import Clock

from relay_protocol import rosbridge
from relay_protocol.ros_types import TypeRegistry
from relay_server.budget import Budgets
from relay_server.channel.listener import Listener
from relay_server.channel.sample import Converter, Sample
from relay_server.forms import Form


class Desk:
    """A receiver that keeps what it gets."""

    def __init__(self) -> None:
        self.got: list[Sample] = []
        self.plain_instead = 0
        self.allowance = Budgets(lambda: 0.0, lambda: 0.0).of(1)

    def deliver(self, listener: Listener, parcel: Sample) -> None:
        """Keep it."""
        self.got.append(parcel)

    def tell(self, level: str, text: str, id: rosbridge.Id = None) -> None:
        """Nobody listens."""


def listening(*asks: dict[str, Any]) -> tuple[Clock, Desk, Listener]:
    """A listener with these subscriptions; the clock and the receiver."""
    clock, desk = Clock(), Desk()
    listener = Listener(clock, desk, "/scan")
    for number, fields in enumerate(asks):
        add(listener, id=number, **fields)
    return clock, desk, listener


def add(listener: Listener, form: Form = Form(), **fields: Any) -> None:  # noqa: B008
    """One more subscription."""
    listener.add(rosbridge.Subscribe(**{"topic": "/scan", **fields}), form)


def sample() -> Sample:
    """Some sample."""
    return Sample(b"{}", 0, Converter(TypeRegistry(), "", "json", print))


def test_the_least_and_the_latest_count() -> None:
    """Least throttle, least size of fragments of those given, latest compression."""
    _, _, listener = listening(
        {"throttle_rate": 100, "form": Form("png", 500)},
        {"throttle_rate": 50, "form": Form("cbor", 0)},
        {"throttle_rate": 200, "form": Form("none", 300)},
    )
    assert listener.throttle == 0.05
    assert listener.wish.form == Form("none", 300)
    listener.remove("/scan", 2)
    assert listener.wish.form == Form("cbor", 500)
    listener.remove("/scan", 0)
    assert listener.wish.form == Form("cbor", 0)


def test_asking_again_is_the_latest() -> None:
    """The same id anew replaces the former, and counts as the latest."""
    _, _, listener = listening({"form": Form("png")}, {"form": Form("cbor")})
    add(listener, Form("cbor-raw"), id=0)
    assert listener.wish.form == Form("cbor-raw")
    listener.remove("/scan", 0)
    assert listener.wish.form == Form("cbor")


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
