"""Latched (transient-local) topics, from publishers in a real ROS 2 graph to clients and recordings."""

from __future__ import annotations

import io
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader

from tests.worlds.chaos_proxy import ChaosProxy
from tests.worlds.http_requests import ask
from tests.worlds.relay_process import Relay
from tests.worlds.robot_process import Robot
from tests.worlds.ros_peers import LATCHED, Speakers, speakers
from tests.worlds.sync_client import Client
from tests.worlds.waiting import wait_for

STRING = "std_msgs/msg/String"


@pytest.fixture(scope="module")
def nodes(world: Any) -> Iterator[Speakers]:
    """Nodes in the robot's graph."""
    with speakers(world.robot.domain) as made:
        yield made


@pytest.fixture
def clients(world: Any) -> Iterator[list[Client]]:
    """Three viewers."""
    found = [world.relay.connect("rover", world.viewer) for _ in range(3)]
    try:
        yield found
    finally:
        for client in found:
            client.close()


def known(client: Client, topic: str, publishers: int) -> None:
    """Waits until the relay knows this many publishing nodes."""

    def has_them() -> bool:
        return len(client.call("/rosapi/publishers", {"topic": topic})["values"]["publishers"]) == publishers

    wait_for(f"{topic} has {publishers} publishers", has_them)


def texts(client: Client, topic: str, count: int) -> list[str]:
    """The next messages on a topic."""
    return [client.until(op="publish", topic=topic)["msg"]["data"] for _ in range(count)]


def rest(client: Client, topic: str, seconds: float = 1.0) -> list[str]:
    """Further messages on a topic in this time, usually none."""
    found, end = [], time.monotonic() + seconds
    while (left := end - time.monotonic()) > 0:
        try:
            found.append(client.until(left, op="publish", topic=topic)["msg"]["data"])
        except TimeoutError:
            break
    return found


def test_every_publisher_has_its_last_one(nodes: Speakers, clients: list[Client]) -> None:
    """A, B and C publish, C twice: each client and each further subscription gets the latest of each, once."""
    topic = "/static"
    first, late, _ = clients
    for name in ("a", "b", "c"):
        nodes.publish(name, topic, name)
    known(first, topic, 3)
    first.send(op="subscribe", topic=topic, type=STRING, id="first")
    assert sorted(texts(first, topic, 3)) == ["a", "b", "c"]
    nodes.publish("c", topic, "c2")
    assert texts(first, topic, 1) == ["c2"]
    late.send(op="subscribe", topic=topic, type=STRING)
    assert sorted(texts(late, topic, 3)) == ["a", "b", "c2"]
    first.send(op="subscribe", topic=topic, type=STRING, id="second")
    assert sorted(texts(first, topic, 3)) == ["a", "b", "c2"]
    assert rest(first, topic) == rest(late, topic) == []
    nodes.publish("a", topic, "a2")
    assert texts(first, topic, 1) == texts(late, topic, 1) == ["a2"]


def test_depth_of_each_publisher_counts(nodes: Speakers, clients: list[Client]) -> None:
    """Five are kept of one, two of another: every client gets seven, those of each publisher in order."""
    topic = "/deep"
    nodes.publish("a", topic, *(f"a{number}" for number in range(8)), **{**LATCHED, "depth": 5})
    nodes.publish("b", topic, *(f"b{number}" for number in range(4)), **{**LATCHED, "depth": 2})
    known(clients[0], topic, 2)
    for client in clients:
        client.send(op="subscribe", topic=topic, type=STRING)
        came = texts(client, topic, 7)
        assert [each for each in came if each[0] == "a"] == ["a3", "a4", "a5", "a6", "a7"]
        assert [each for each in came if each[0] == "b"] == ["b2", "b3"]
    nodes.publish("b", topic, "b4")
    with_throttle = clients[2]
    assert texts(with_throttle, topic, 1) == ["b4"]
    with_throttle.send(op="unsubscribe", topic=topic)
    with_throttle.send(op="subscribe", topic=topic, type=STRING, throttle_rate=60_000)
    assert sorted(texts(with_throttle, topic, 7))[-2:] == ["b3", "b4"]


def test_latched_samples_go_with_their_publisher(nodes: Speakers, clients: list[Client]) -> None:
    """As in ROS 2: later clients get only the samples of remaining publishers."""
    topic = "/leaving"
    first, late, _ = clients
    for name in ("stays", "leaves"):
        nodes.publish(name, topic, name)
    known(first, topic, 2)
    first.send(op="subscribe", topic=topic, type=STRING)
    assert sorted(texts(first, topic, 2)) == ["leaves", "stays"]
    nodes.end("leaves")
    known(first, topic, 1)
    late.send(op="subscribe", topic=topic, type=STRING)
    assert texts(late, topic, 1) == ["stays"]
    assert rest(late, topic) == []


def test_client_that_waits_gets_each_sample_once(nodes: Speakers, clients: list[Client]) -> None:
    """Even if new publishers change the robot's subscription: latched, volatile, best effort."""
    client = clients[0]
    topics = [f"/waited{number}" for number in range(8)]
    for topic in topics:
        client.send(op="subscribe", topic=topic, type=STRING)
    client.call("/rosapi/topics")
    for topic in topics:
        nodes.publish("a", topic, "latched")
    nodes.publish("b", topics[0], "volatile", depth=5)
    nodes.publish("b", topics[1], "best effort", depth=5, reliability="best_effort")
    nodes.publish("b", topics[2], "latched too")
    came: dict[str, list[str]] = {topic: [] for topic in topics}
    end = time.monotonic() + 4.0
    while time.monotonic() < end or not all(came.values()):
        try:
            message = client.until(1.0, op="publish")
        except TimeoutError:
            continue
        came[message["topic"]].append(message["msg"]["data"])
    assert all(each.count("latched") == 1 for each in came.values()), came
    assert came[topics[2]].count("latched too") == 1


def test_recording_has_what_was_published_before_it(
    world: Any, nodes: Speakers, clients: list[Client]
) -> None:
    """Of every publisher, and no more."""
    topic = "/static_recorded"
    for name in ("a", "b", "c"):
        nodes.publish(name, topic, name)
    known(clients[0], topic, 3)
    clients[0].send(op="subscribe", topic=topic, type=STRING)
    texts(clients[0], topic, 3)
    nodes.publish("c", topic, "c2")
    texts(clients[0], topic, 1)
    path = "/api/v1/robots/rover/recordings"

    def asked(method: str, rest: str = "", body: Any = None) -> Any:
        return ask(world.relay.http_port, method, path + rest, body, token=world.operator)

    id = asked("POST", "", {"topics": [topic]}).json["id"]
    wait_for("three messages", lambda: asked("GET", f"/{id}").json["messages"] >= 3)
    done = asked("POST", f"/{id}/stop").json
    assert (done["messages"], done["drops"], done["problems"]) == (3, 0, [])
    messages = list(make_reader(io.BytesIO(asked("GET", f"/{id}/file").body)).iter_messages())
    assert sorted(message.data[8:].rstrip(b"\0") for _, _, message in messages) == [b"a", b"b", b"c2"]


def test_broken_link_repeats_nothing(tmp_path: Path) -> None:
    """After a reconnection clients get only samples published meanwhile."""
    topics = ("/one", "/two")
    relay = Relay(tmp_path)
    with ExitStack() as stack:
        stack.callback(relay.stop)
        proxy = ChaosProxy(relay.robots_port)
        stack.callback(proxy.close)
        robot = Robot(relay, "rover", port=proxy.port)
        stack.callback(robot.stop)
        viewer = relay.user("viewer")
        relay.cli("right", "grant", "viewer", "rover", "viewer")
        nodes = stack.enter_context(speakers(robot.domain))
        for topic in topics:
            nodes.publish("a", topic, "kept", depth=5, durability="transient_local")
        client = stack.enter_context(relay.connect("rover", viewer))
        known(client, topics[1], 1)
        for topic in topics:
            client.send(op="subscribe", topic=topic, type=STRING)
            assert texts(client, topic, 1) == ["kept"]
        for number in range(3):
            proxy.reset()
            # It can only arrive on a new link.
            nodes.publish("a", topics[0], f"meanwhile {number}")
            assert texts(client, topics[0], 1) == [f"meanwhile {number}"]
        assert rest(client, topics[1]) == rest(client, topics[0]) == []
        late = stack.enter_context(relay.connect("rover", viewer))
        late.send(op="subscribe", topic=topics[0], type=STRING)
        assert texts(late, topics[0], 4) == ["kept", *(f"meanwhile {number}" for number in range(3))]


def test_latched_publisher_among_others(nodes: Speakers, clients: list[Client]) -> None:
    """A volatile publisher on the topic does not hide the latched samples of others."""
    topic = "/mixed"
    nodes.publish("volatile", topic, depth=5)
    nodes.publish("latched", topic, "kept")
    known(clients[0], topic, 2)
    for client in clients[:2]:
        client.send(op="subscribe", topic=topic, type=STRING)
        assert texts(client, topic, 1) == ["kept"]
    nodes.publish("volatile", topic, "passing")
    for client in clients[:2]:
        assert texts(client, topic, 1) == ["passing"]
        assert rest(client, topic) == []


def test_every_client_that_latches_has_its_last_one(
    world: Any, nodes: Speakers, clients: list[Client]
) -> None:
    """As several nodes would: late nodes of the graph and late clients get one of each."""
    topic = "/tf_static_of_clients"
    with ExitStack() as stack:
        for name in ("a", "b"):
            client = stack.enter_context(world.relay.connect("rover", world.operator))
            client.send(op="advertise", topic=topic, type=STRING, latch=True)
            for number in range(2):
                client.send(op="publish", topic=topic, msg={"data": f"{name}{number}"})
        nodes.subscribe("early", topic, depth=10, durability="transient_local")
        wait_for("the last of both", lambda: {"a1", "b1"} <= set(nodes.heard("early")))
        nodes.subscribe("late", topic, depth=10, durability="transient_local")
        wait_for("one of each", lambda: sorted(nodes.heard("late")) == ["a1", "b1"])
        viewer = clients[0]
        viewer.send(op="subscribe", topic=topic, type=STRING)
        assert sorted(texts(viewer, topic, 2)) == ["a1", "b1"]
        assert rest(viewer, topic) == []
