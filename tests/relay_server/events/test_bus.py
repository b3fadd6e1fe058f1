"""Subscribers of the event bus."""

from __future__ import annotations

from twisted.logger import capturedLogs

from relay_server.events.bus import BusEvent, EventBus


def test_every_subscriber_gets_every_event() -> None:
    """The source is the relay by default."""
    bus = EventBus()
    seen: list[BusEvent] = []
    other: list[BusEvent] = []
    bus.subscribe(seen.append)
    bus.publish("x", 1, "user:ann", n=1)
    bus.subscribe(other.append)
    bus.publish("y", n=2)
    assert seen == [BusEvent("x", 1, "user:ann", {"n": 1}), BusEvent("y", None, "relay", {"n": 2})]
    assert other == seen[1:]


def test_a_subscriber_that_fails_is_logged_and_disturbs_no_other() -> None:
    bus = EventBus()
    seen: list[str] = []

    def fails(event: BusEvent) -> None:
        raise KeyError(event.kind)

    bus.subscribe(fails)
    bus.subscribe(lambda event: seen.append(event.kind))
    with capturedLogs() as logs:
        bus.publish("x")
        bus.publish("y", 1)
    assert seen == ["x", "y"]
    assert [each["log_failure"].type for each in logs] == [KeyError, KeyError]
