"""Load from a real ROS 2 publisher, at the pace of the machine: the guarantees hold, and memory does not grow."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import pytest

from relay_protocol.limits import MIB
from tests.worlds.ros_load import STRING, Counter, Publisher, Stalled, meter_of, status_of
from tests.worlds.sync_client import Client
from tests.worlds.waiting import wait_for

LEAST = 8000
RATE = 1000.0
WARM = 2000
FAST, THROTTLED = "fast-reader", "throttled-reader"


@dataclass
class Run:
    """Observations while the publisher was active."""

    sent: dict[str, Any] = field(default_factory=dict)
    fast: Counter | None = None
    throttled: Counter | None = None
    latched: str = ""
    seconds: float = 0.0
    """From before the throttled client subscribed until it had the last message."""
    stalled_ended: bool = False
    memory_warm: dict[str, int] = field(default_factory=dict)
    memory_most: dict[str, int] = field(default_factory=dict)
    memory_end: dict[str, int] = field(default_factory=dict)
    clients: dict[str, Any] = field(default_factory=dict)
    dropped_before: int = 0
    counted: int = 0
    """Messages that were dropped on their way to the fast client, as counted by the robot and the relay."""


@pytest.fixture(scope="module")
def run(world: Any) -> Iterator[Run]:
    """One run for all: a fast client, a throttled one, one that stalls, and a late one."""
    relay, robot = world.relay, world.robot
    # With its own user, so that connections of other tests do not count.
    staller, fast_one, throttled_one = (relay.user(name) for name in ("staller", FAST, THROTTLED))
    for name in ("staller", FAST, THROTTLED):
        relay.cli("right", "grant", name, "rover", "viewer")
    meter = meter_of(relay, robot)
    result = Run(dropped_before=status_of(relay, "rover")["health"]["dropped_samples"])
    publisher = Publisher(robot, LEAST, RATE)
    publisher.start()
    topics = {"small": 0, "big": 0, "unsure": 0}
    watcher = relay.connect("rover", fast_one)
    publisher.known_to(watcher)
    fast = result.fast = Counter(watcher, topics, publisher)
    begun = time.monotonic()
    throttled = result.throttled = Counter(
        relay.connect("rover", throttled_one), {"small": 500, "burst": 500}
    )
    try:
        wait_for("it is warm", lambda: fast.last("small") > WARM, 60)
        result.memory_warm = meter.memory()
        stalled = Stalled(relay, "rover", staller, ["small", "big"])
        stalled.is_cut(relay, "staller")
        result.memory_most = meter.memory()
        result.stalled_ended = stalled.ended()
        stalled.close()
        publisher.is_enough()
        sent = result.sent = publisher.sent()
        for name in ("small", "big"):
            wait_for(f"the last of {name} comes", lambda name=name: fast.last(name) == sent[name] - 1)
        for name in ("small", "burst"):
            wait_for(f"the last of {name} comes", lambda name=name: throttled.last(name) == sent[name] - 1)
        result.seconds = time.monotonic() - begun
        with relay.connect("rover", world.viewer) as late:
            result.latched = latched_of(late)
        result.memory_end = meter.memory()
        wait_for(
            "no bytes wait", lambda: all(each["waiting_bytes"] == 0 for each in clients_of(relay).values())
        )
        result.clients = clients_of(relay)
        dropped = status_of(relay, "rover")["health"]["dropped_samples"] - result.dropped_before
        result.counted = dropped + result.clients[FAST]["drops"]
        yield result
    finally:
        fast.stop()
        throttled.stop()
        publisher.stop()


def test_early_subscriber_loses_no_message(world: Any) -> None:
    """The robot's subscription changes to the new publisher's QoS without loss and without repetition."""
    publisher = Publisher(world.robot, 1000, RATE)
    publisher.is_enough()
    counter = Counter(
        world.relay.connect("rover", world.viewer),
        dict.fromkeys(("small", "big", "unsure", "burst"), 0),
        publisher,
    )
    try:
        publisher.start()
        sent = publisher.sent()
        for name in ("small", "big"):
            wait_for(f"the last of {name} comes", lambda name=name: counter.last(name) == sent[name] - 1)
            assert counter.lost(name) == []
            assert counter.in_order(name)
    finally:
        counter.stop()
        publisher.stop()


def clients_of(relay: Any) -> dict[str, Any]:
    """The clients of the robot in ``switchboard status`` by user."""
    return {each["user"]: each for each in status_of(relay, "rover")["clients"]}


def latched_of(client: Client) -> str:
    """The latched samples that a late subscriber gets."""
    client.send(op="subscribe", topic="/load/latched", type=STRING)
    return str(client.until(op="publish", topic="/load/latched")["msg"]["data"])


@pytest.mark.parametrize("name", ["small", "big"])
def test_all_bytes_arrive_in_order(run: Run, name: str) -> None:
    """From the first received message to the last sent one, every number is there, in order. A client that stands
    still for a second has some dropped, which are counted.
    """
    assert run.fast is not None
    assert run.fast.broken == ""
    assert len(run.fast.lost(name)) <= run.counted
    assert run.fast.in_order(name)
    assert len(run.fast.numbers[name]) > 0.8 * run.sent[name]


def test_a_best_effort_publisher_is_received(run: Run) -> None:
    """The subscription matches its QoS, and messages arrive in order."""
    assert run.fast is not None
    assert run.fast.in_order("unsure")
    assert run.fast.numbers["unsure"]


def test_a_throttled_client_gets_few_and_always_the_last(run: Run) -> None:
    """At most two a second with ``throttle_rate`` 500, in order, and the very last message arrives."""
    assert run.throttled is not None
    assert run.throttled.in_order("small")
    assert len(run.throttled.numbers["small"]) <= 2 * run.seconds + 3
    assert run.throttled.last("small") == run.sent["small"] - 1


def test_the_last_of_a_burst_passes_the_throttle_of_the_robot(run: Run) -> None:
    """With throttled clients only, the robot throttles itself, and sends the last of a burst."""
    assert run.throttled is not None
    assert run.throttled.last("burst") == run.sent["burst"] - 1
    assert len(run.throttled.numbers["burst"]) < run.sent["burst"] / 2


def test_a_late_joiner_gets_what_was_latched(run: Run) -> None:
    """It was published once, before any subscription, and is still sent at the end."""
    assert run.latched.startswith("000000000 ")


def test_a_client_that_reads_nothing_is_cut_and_costs_little(run: Run) -> None:
    """It costs less than 8 MiB; the fast client lost no message."""
    assert run.stalled_ended
    assert run.memory_most["relay"] - run.memory_warm["relay"] < 8 * MIB


def test_only_lost_messages_are_counted_as_dropped(run: Run) -> None:
    """In ``switchboard status``, of the relay and of the robot."""
    assert run.fast is not None
    assert run.clients[FAST]["drops"] <= sum(len(run.fast.lost(name)) for name in ("small", "big", "unsure"))


@pytest.mark.parametrize("process", ["relay", "daemon"])
def test_memory_stays_level(run: Run, process: str) -> None:
    """After ten thousand messages the process has its size of the beginning."""
    assert run.memory_end[process] - run.memory_warm[process] < 8 * MIB
