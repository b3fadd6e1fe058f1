"""The cases of the smoke test of Foxglove's own bridge (foxglove-sdk, ``smoke_test.cpp``), on a real ROS 2
graph.

Its other cases are elsewhere: assets in ``test_foxglove.py`` and ``test_foxglove_graph.py``, the connection
graph in ``test_foxglove_graph.py``, and a missing service in ``tests/relay_server/foxglove/test_services.py``.
"""

from __future__ import annotations

import json
import struct
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from tests.worlds.foxglove_connection import FoxgloveConnection, opened
from tests.worlds.processes import Process, ros_environment
from tests.worlds.waiting import wait_for

PEER = Path(__file__).parent / "clients" / "bridge_peer.py"
HELLO = b"\x00\x01\x00\x00" + struct.pack("<I", 12) + b"hello world\x00"
SET_BOOL = b"\x00\x01\x00\x00\x01"
SET_BOOL_ANSWER = b"\x00\x01\x00\x00\x01\x00\x00\x00" + struct.pack("<I", 6) + b"hello\x00"
ALL = {
    "/node_1.string_param",
    "/node_1.deletable_param",
    "/node_2.int_array_param",
    "/node_2.float_param",
    "/node_2.float_array_param",
    "/node_2.int_param",
}


@pytest.fixture(scope="module")
def peer(world: Any) -> Iterator[Process]:
    """Nodes in the robot's graph."""
    node = Process(
        [sys.executable, str(PEER)], world.robot.folder, "bridge-peer", ros_environment(world.robot.domain)
    )
    try:
        node.wait_to_say("READY")
        yield node
    finally:
        node.stop()


@pytest.fixture
def clients(world: Any, peer: Process) -> Iterator[list[FoxgloveConnection]]:
    """Three operators."""
    with ExitStack() as stack:
        yield [stack.enter_context(opened(world.relay.url("rover"), world.operator)) for _ in range(3)]


@pytest.fixture
def client(clients: list[FoxgloveConnection]) -> FoxgloveConnection:
    """The first of them, once it has received the parameters."""
    wait_for("the nodes' parameters can be read", lambda: clients[0].parameters().keys() >= ALL)
    return clients[0]


def test_clients_one_after_another_get_the_latched_message(clients: list[FoxgloveConnection]) -> None:
    for client in clients:
        subscription = client.subscribe("/pub_topic")
        assert client.sample(subscription) == HELLO
        client.send("unsubscribe", subscriptionIds=[subscription])


def test_clients_at_the_same_time_get_the_latched_message(clients: list[FoxgloveConnection]) -> None:
    subscriptions = [client.subscribe("/pub_topic") for client in clients]
    for client, subscription in zip(clients, subscriptions, strict=True):
        assert client.sample(subscription) == HELLO


def test_the_message_of_each_latched_publisher_arrives(clients: list[FoxgloveConnection]) -> None:
    wanted = {f"hello {number}" for number in range(15)}
    for client in clients:
        subscription, found = client.subscribe("/latched"), set()
        while found != wanted:
            body = client.sample(subscription)
            found.add(body[8:].rstrip(b"\0").decode())


def string(text: str, encoding: str) -> bytes:
    """A std_msgs/String."""
    if encoding == "json":
        return json.dumps({"data": text}).encode()
    return b"\x00\x01\x00\x00" + struct.pack("<I", len(text) + 1) + text.encode() + b"\x00"


@pytest.mark.parametrize("topic", ["/other_topic", "/some_topic"])
@pytest.mark.parametrize("encoding", ["cdr", "json"])
def test_a_message_reaches_a_node_also_beside_another_publisher(
    peer: Process, clients: list[FoxgloveConnection], topic: str, encoding: str
) -> None:
    client, text = clients[0], f"{encoding} on {topic}"
    body = string(text, encoding)
    client.channel(topic)
    channel = {"id": 1, "topic": topic, "encoding": encoding, "schemaName": "std_msgs/msg/String"}
    client.send("advertise", channels=[channel | {"schema": ""}])

    def arrives() -> bool:
        client.connection.send(struct.pack("<BI", 1, 1) + body)
        return f"HEARD {text}" in peer.out.read_text()

    # The node has to discover the new publisher first.
    wait_for("the message arrives", arrives)
    client.send("unadvertise", channelIds=[1])


@pytest.mark.parametrize("encoding", ["cdr", "json"])
def test_a_message_between_advertise_and_unadvertise_reaches_a_node(
    world: Any, peer: Process, encoding: str
) -> None:
    """As the Publish panel and programs send one, all three messages at once, on a new connection."""
    text = f"once in {encoding}"
    channel = {"id": 1, "topic": "/other_topic", "encoding": encoding, "schemaName": "std_msgs/String"}
    with opened(world.relay.url("rover"), world.operator) as client:
        client.send("advertise", channels=[channel])
        client.connection.send(struct.pack("<BI", 1, 1) + string(text, encoding))
        client.send("unadvertise", channelIds=[1])
        wait_for("the message arrives", lambda: f"HEARD {text}" in peer.out.read_text())


def test_parameters_are_read(client: FoxgloveConnection) -> None:
    assert client.parameters("/foo_1.non_existing_parameter", "/foo_2.non_existing.nested_parameter") == {}
    assert client.parameters("node_2.int_param") == {"node_2.int_param": 123}
    assert client.parameters("node_1.string_param", "node_2.int_array_param") == {
        "node_1.string_param": "hello",
        "node_2.int_array_param": [1, 2, 3],
    }


def test_clients_at_the_same_time_read_all_parameters(
    clients: list[FoxgloveConnection], client: FoxgloveConnection
) -> None:
    for each in clients:
        each.send("getParameters", parameterNames=[], id="all")
    for each in clients:
        assert each.values("all").keys() >= ALL


def test_parameters_are_set_and_read_again(client: FoxgloveConnection) -> None:
    names = ("node_1.string_param", "node_2.int_array_param")
    for text, numbers in (("world", [4, 5, 6]), ("hello", [1, 2, 3])):
        entries = [{"name": names[0], "value": text}, {"name": names[1], "value": numbers}]
        client.send("setParameters", parameters=entries)
        wait_for(
            "they are set",
            lambda wanted=[text, numbers]: list(client.parameters(*names).values()) == wanted,
        )
    assert client.set({"name": names[0], "value": "hello"}) == {names[0]: "hello"}


def test_parameters_with_a_fraction_are_set_by_integers(client: FoxgloveConnection) -> None:
    entries = (
        {"name": "node_2.float_param", "value": 10, "type": "float64"},
        {"name": "node_2.float_array_param", "value": [3, 2, 1], "type": "float64_array"},
    )
    assert client.set(*entries) == {"node_2.float_param": 10.0, "node_2.float_array_param": [3.0, 2.0, 1.0]}


def test_a_parameter_is_unset(client: FoxgloveConnection) -> None:
    name = "node_1.deletable_param"
    assert client.set({"name": name}) == {}
    assert client.set({"name": name, "value": True}) == {name: True}


def test_changes_of_a_followed_parameter_come_until_it_is_not(client: FoxgloveConnection) -> None:
    name, other = "node_1.string_param", "/node_2.int_param"
    client.send("subscribeParameterUpdates", parameterNames=[name])
    client.send("setParameters", parameters=[{"name": name, "value": "foo"}])
    while not client.changes:
        client.receive()
    client.send("unsubscribeParameterUpdates", parameterNames=[name])
    client.send("subscribeParameterUpdates", parameterNames=[other])
    assert client.set({"name": name, "value": "hello"}) == {name: "hello"}
    client.send("setParameters", parameters=[{"name": other, "value": 123}])
    while len(client.changes) < 2:
        client.receive()
    assert client.changes == [(name, "foo"), (other, 123)]


def test_a_service_is_advertised_and_answers_clients_at_the_same_time(
    clients: list[FoxgloveConnection],
) -> None:
    for client in clients:
        while "/foo_service" not in client.services:
            client.receive()
    service = clients[0].services["/foo_service"]
    assert service["type"] == "std_srvs/srv/SetBool"
    assert service["request"]["schema"].startswith("bool data")
    assert service["response"]["schema"].startswith("bool success")
    for client in clients:
        number = client.services["/foo_service"]["id"]
        client.connection.send(struct.pack("<BIII", 2, number, 123, 3) + b"cdr" + SET_BOOL)
    for client in clients:
        number = client.services["/foo_service"]["id"]
        answer = client.until(lambda each: isinstance(each, bytes) and each[0] == 3)
        assert answer == struct.pack("<BIII", 3, number, 123, 3) + b"cdr" + SET_BOOL_ANSWER
