"""Quality of service between clients and nodes of a real ROS 2 graph: all are matched, or a mismatch is
reported.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from tests.worlds.ros_peers import Speakers, speakers
from tests.worlds.sync_client import Client
from tests.worlds.waiting import wait_for

STRING = "std_msgs/msg/String"
STRICT: dict[str, dict[str, Any]] = {
    "volatile": {"depth": 10},
    "durable": {"depth": 10, "durability": "transient_local"},
    "deadline": {"depth": 10, "deadline": 0.5},
    "lease": {"depth": 10, "liveliness": "automatic", "liveliness_lease_duration": 3.0},
    "manual": {"depth": 10, "liveliness": "manual_by_topic", "liveliness_lease_duration": 5.0},
    "lossy": {"depth": 10, "reliability": "best_effort"},
}
"""Subscribers that can't all be matched by the same plain publisher."""


@pytest.fixture(scope="module")
def nodes(world: Any) -> Iterator[Speakers]:
    """Nodes in the robot's graph."""
    with speakers(world.robot.domain) as made:
        yield made


@pytest.fixture
def client(world: Any) -> Iterator[Client]:
    """An operator that receives warnings."""
    with world.relay.connect("rover", world.operator) as made:
        made.send(op="set_level", level="warning")
        yield made


def known(client: Client, topic: str, subscribers: int) -> None:
    """Waits until the relay knows this many subscribing nodes except itself."""

    def has_them() -> bool:
        found = client.call("/rosapi/subscribers", {"topic": topic})["values"]["subscribers"]
        return len(set(found) - {"/relay"}) == subscribers

    wait_for(f"{topic} has {subscribers} subscribers", has_them)


def publish_until(client: Client, topic: str, done: Any, what: str) -> None:
    """Publishes numbers until the condition holds."""
    numbers = iter(range(100_000))

    def published() -> bool:
        client.send(op="publish", topic=topic, msg={"data": str(next(numbers))})
        return bool(done())

    wait_for(what, published)


def test_a_publisher_serves_every_subscriber_there_is(nodes: Speakers, client: Client) -> None:
    """Durable, with a deadline, with liveliness, volatile and best effort, at once."""
    topic = "/commands"
    for name, qos in STRICT.items():
        nodes.subscribe(f"there_{name}", topic, **qos)
    known(client, topic, len(STRICT))
    client.send(op="advertise", topic=topic, type=STRING)
    publish_until(
        client, topic, lambda: all(nodes.heard(f"there_{name}") for name in STRICT), "all have heard it"
    )


def test_stricter_subscribers_that_come_later_are_served(nodes: Speakers, client: Client) -> None:
    """One after the other; earlier ones continue without repetitions."""
    topic = "/later_commands"
    nodes.subscribe("plain", topic, depth=100)
    known(client, topic, 1)
    client.send(op="advertise", topic=topic, type=STRING)
    publish_until(client, topic, lambda: nodes.heard("plain"), "the first has heard it")
    for name in ("durable", "deadline", "manual", "lease"):
        nodes.subscribe(f"later_{name}", topic, **STRICT[name])
        publish_until(client, topic, lambda name=name: nodes.heard(f"later_{name}"), f"{name} has heard it")
        client.send(op="publish", topic=topic, msg={"data": f"to all {name}"})
        wait_for("the first has heard it too", lambda name=name: f"to all {name}" in nodes.heard("plain"))
    assert [
        nodes.heard("plain").count(f"to all {name}") for name in STRICT if name not in ("volatile", "lossy")
    ] == [1] * 4


def test_latched_publication_reaches_stricter_subscribers(nodes: Speakers, client: Client) -> None:
    """A deadline needs a new publisher, which repeats the latched message."""
    topic = "/latched_commands"
    client.send(op="advertise", topic=topic, type=STRING, latch=True)
    client.send(op="publish", topic=topic, msg={"data": "kept"})
    client.call("/rosapi/topics")
    nodes.subscribe("strict_latched", topic, depth=1, durability="transient_local", deadline=1.0)
    wait_for("it came", lambda: nodes.heard("strict_latched") == ["kept"])
    nodes.subscribe("plain_latched", topic, depth=1, durability="transient_local")
    # The publisher that was replaced may still be there.
    wait_for("it came here too", lambda: set(nodes.heard("plain_latched")) == {"kept"})


def test_subscriber_without_matching_qos_is_reported(nodes: Speakers, client: Client) -> None:
    """By a warning with the id, and in the status, until it has gone."""
    topic = "/mismatched"
    nodes.subscribe("wants_durable", topic, depth=1, durability="transient_local")
    known(client, topic, 1)
    qos = {"durability": "volatile"}
    client.send(op="advertise", topic=topic, type=STRING, qos=qos, id="mine")
    reported = client.until(op="status", id="mine")
    assert reported["level"] == "warning"
    assert "/wants_durable: Volatile publisher and transient local subscription" in reported["msg"]
    client.send(op="subscribe", topic="/relay/status")

    def unmatched() -> Any:
        return client.until(op="publish", topic="/relay/status")["msg"]["unmatched"]

    (entry,) = unmatched()
    assert entry["topic"] == topic
    assert entry["nodes"][0].startswith("/wants_durable: ")
    nodes.end("wants_durable")
    wait_for("it is told no more", lambda: unmatched() == [])


def test_publisher_without_matching_qos_is_reported(nodes: Speakers, client: Client) -> None:
    """A client that insists on reliable gets nothing from a best-effort publisher, and a warning with the
    reason.
    """
    topic = "/lossy"
    nodes.publish("lossy_publisher", topic, depth=5, reliability="best_effort")
    wait_for(
        "it is known",
        lambda: client.call("/rosapi/publishers", {"topic": topic})["values"]["publishers"],
    )
    client.send(op="subscribe", topic=topic, type=STRING, id="one", qos={"reliability": "reliable"})
    reported = client.until(op="status", id="one")
    assert (reported["level"], "/lossy_publisher: " in reported["msg"]) == ("warning", True)
    client.send(op="subscribe", topic=topic, type=STRING, id="two")
    assert "/lossy_publisher: " in client.until(op="status", id="two")["msg"]


def test_a_driver_with_a_deadline_is_driven(world: Any, nodes: Speakers) -> None:
    """Motion topics offer the deadline of subscribers too; they stay volatile, which is reported."""
    topic = "/cmd_vel"
    nodes.subscribe("strict_driver", topic, kind="twist", depth=1, deadline=0.5)
    nodes.subscribe("durable_driver", topic, kind="twist", depth=1, durability="transient_local")
    with world.relay.connect("rover", world.operator) as driver:
        driver.send(op="set_level", level="warning")
        known(driver, topic, 3)
        driver.send(op="advertise", topic=topic, type="geometry_msgs/msg/Twist", id="drive")
        assert "/durable_driver: Volatile publisher" in driver.until(op="status", id="drive")["msg"]

        def driven() -> bool:
            driver.drive(0.1)
            return bool(nodes.heard("strict_driver"))

        wait_for("it is driven", driven)
    assert nodes.heard("durable_driver") == []
    for name in ("strict_driver", "durable_driver"):
        nodes.end(name)
    world.left_alone()


def test_services_of_other_qualities(nodes: Speakers, client: Client) -> None:
    """A best-effort one is called, also after a change of its QoS; one with durable requests is refused with
    a reason.
    """

    def called(service: str) -> Any:
        return client.call(service)["values"]

    for qos in ({"depth": 5, "reliability": "best_effort"}, {"depth": 5}):
        nodes.serve("lossy_server", "/lossy_service", **qos)
        wait_for(
            "it is called", lambda: called("/lossy_service") == {"success": True, "message": "lossy_server"}
        )
        nodes.end("lossy_server")
        wait_for("it is gone", lambda: "lossy_server" not in str(called("/lossy_service")))
    nodes.serve("keeping_server", "/keeping_service", depth=5, durability="transient_local")
    wait_for("it is refused", lambda: "transient_local" in called("/keeping_service"))
    assert "would execute old requests again" in called("/keeping_service")
