"""The cases of rosbridge_server's own tests of its websocket (``rosbridge_server/test/websocket``), through the relay.

Each test is named after its file there. Messages are compared as a whole where that file does so. Ids of requests to a
client are none of the client's concern, so they are not compared.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import cbor2
import pytest

from tests.robot_client.ros import Peer
from tests.worlds.processes import ros_environment
from tests.worlds.sync_client import Client
from tests.worlds.waiting import wait_for

STRING = "std_msgs/String"
FIBONACCI = "example_interfaces/Fibonacci"
SET_BOOL = "std_srvs/SetBool"
HELLO = {"success": True, "message": "Hello, world!"}


@pytest.fixture(scope="module")
def peer(world: Any) -> Iterator[Peer]:
    """A node of the robot."""
    peer = Peer(ros_environment(world.robot.domain))
    yield peer
    peer.close()


def connect(world: Any) -> Client:
    """A websocket of an operator."""
    client: Client = world.relay.connect("rover", world.operator)
    return client


def published(topic: str, text: str) -> dict[str, Any]:
    """The whole message that a subscriber receives."""
    return {"op": "publish", "topic": topic, "msg": {"data": text}}


def until_passed(peer: Peer, topic: str, text: str, *clients: Client) -> list[dict[str, Any]]:
    """The node publishes until each client has received one message; these messages.

    A publisher and a subscriber need some time to discover each other.
    """
    received = []
    for client in clients:
        while True:
            peer.do("publish", topic, text)
            try:
                received.append(client.receive(0.5))
                break
            except TimeoutError:
                pass
    return received


def answers(client: Client, goal: dict[str, Any], sequence: list[int]) -> None:
    """Sends the result of a goal."""
    about = {"action": goal["action"], "id": goal["id"]}
    client.send(op="action_result", **about, values={"sequence": sequence}, status=4, result=True)


def test_advertise_action(world: Any, peer: Peer) -> None:
    """Two goals of a node at a time."""
    with connect(world) as client:
        client.send(op="advertise_action", action="/suite/goals", type=FIBONACCI)
        peer.do("send", "/suite/goals", 3)
        peer.do("send", "/suite/goals", 5)
        goals = [client.receive(), client.receive()]
        for goal, order in zip(goals, (3, 5), strict=True):
            assert (goal["op"], goal["action"]) == ("send_action_goal", "/suite/goals")
            assert (goal["action_type"], goal["args"]) == (FIBONACCI, {"order": order})
        answers(client, goals[0], [0, 1, 1, 2])
        answers(client, goals[1], [0, 1, 1, 2, 3, 5])
        peer.until(lambda: len(peer.reported("result", "/suite/goals")) == 2)
    ends = {
        each["order"]: (each["status"], each["sequence"]) for each in peer.reported("result", "/suite/goals")
    }
    assert ends == {3: (4, [0, 1, 1, 2]), 5: (4, [0, 1, 1, 2, 3, 5])}


def test_advertise_action_feedback(world: Any, peer: Peer) -> None:
    with connect(world) as client:
        client.send(op="advertise_action", action="/suite/watched", type=FIBONACCI)
        peer.do("send", "/suite/watched", 5)
        goal = client.receive()
        assert goal["args"] == {"order": 5}
        about = {"action": "/suite/watched", "id": goal["id"]}
        client.send(op="action_feedback", **about, values={"sequence": [0, 1, 1, 2]})
        answers(client, goal, [0, 1, 1, 2, 3, 5])
        peer.until(lambda: peer.reported("result", "/suite/watched"))
        peer.until(lambda: peer.reported("feedback", "/suite/watched"))
    assert peer.reported("feedback", "/suite/watched")[0]["sequence"] == [0, 1, 1, 2]
    assert peer.reported("result", "/suite/watched")[0]["sequence"] == [0, 1, 1, 2, 3, 5]


def test_advertise_service(world: Any, peer: Peer) -> None:
    """Two calls of a node at a time."""
    with connect(world) as client:
        client.send(op="advertise_service", service="/suite/offered", type=SET_BOOL)
        peer.do("switch", "/suite/offered", True)
        peer.do("switch", "/suite/offered", False)
        calls = [client.receive(), client.receive()]
        assert [each["args"] for each in calls] == [{"data": True}, {"data": False}]
        for number, call in enumerate(calls, 1):
            about = {"service": "/suite/offered", "id": call["id"], "result": True}
            client.send(
                op="service_response", **about, values={"success": True, "message": f"Hello world {number}"}
            )
        peer.until(lambda: len(peer.reported("switched", "/suite/offered")) == 2)
    assert {each["data"]: each["message"] for each in peer.reported("switched", "/suite/offered")} == {
        True: "Hello world 1",
        False: "Hello world 2",
    }


def test_advertise_service_duplicate(world: Any, peer: Peer) -> None:
    """A client that offers a service of one that has left gets the next call."""
    with connect(world) as first:
        first.send(op="advertise_service", service="/suite/again", type=SET_BOOL)
        peer.do("switch", "/suite/again", True)
        call = first.receive()
        expected = {"op": "call_service", "service": "/suite/again", "args": {"data": True}}
        assert call == {**expected, "id": call["id"]}
    with connect(world) as second:
        second.send(op="advertise_service", service="/suite/again", type=SET_BOOL)
        peer.do("switch", "/suite/again", False)
        call = second.receive()
        assert call == {**expected, "args": {"data": False}, "id": call["id"]}
        values = {"success": True, "message": "Hello world 2"}
        second.send(op="service_response", service="/suite/again", id=call["id"], values=values, result=True)
        peer.until(lambda: [each for each in peer.reported("switched", "/suite/again") if not each["data"]])
    (end,) = [each for each in peer.reported("switched", "/suite/again") if not each["data"]]
    assert (end["success"], end["message"]) == (True, "Hello world 2")


def test_best_effort_publisher(world: Any, peer: Peer) -> None:
    peer.do("advertise", "/suite/best_effort", "best_effort")
    with connect(world) as client:
        client.send(op="subscribe", topic="/suite/best_effort", type=STRING)
        (message,) = until_passed(peer, "/suite/best_effort", "hello", client)
    assert message == published("/suite/best_effort", "hello")


def test_call_service(world: Any, peer: Peer) -> None:
    """One call, and two of a slow service with a short and a long timeout."""
    peer.do("serve", "/suite/hello", "hello")
    peer.do("serve", "/suite/hello_late", "hello_late")
    with connect(world) as client:
        for service in ("/suite/hello", "/suite/hello_late"):
            wait_for("the relay knows it", lambda service=service: client.call(service)["result"])
        client.send(op="call_service", service="/suite/hello", type=SET_BOOL, args={"data": True})
        answer = client.receive()
        assert (answer["op"], answer["service"]) == ("service_response", "/suite/hello")
        assert (answer["values"], answer["result"]) == (HELLO, True)
        late = {"service": "/suite/hello_late", "type": SET_BOOL, "args": {"data": True}}
        client.send(op="call_service", **late, timeout=0.1)
        client.send(op="call_service", **late, timeout=60)
        first, second = client.receive(), client.receive()
    assert (first["op"], first["service"], first["result"]) == (
        "service_response",
        "/suite/hello_late",
        False,
    )
    assert "0.1 s" in first["values"]
    assert (second["values"], second["result"]) == (HELLO, True)


def test_multiple_subscribers(world: Any, peer: Peer) -> None:
    """They subscribe before there is a publisher."""
    with connect(world) as first, connect(world) as second:
        for client in (first, second):
            client.send(op="subscribe", topic="/suite/many", type=STRING)
        peer.do("advertise", "/suite/many")
        assert (
            until_passed(peer, "/suite/many", "hello", first, second)
            == [published("/suite/many", "hello")] * 2
        )


def test_multiple_subscribers_raw(world: Any, peer: Peer) -> None:
    with connect(world) as first, connect(world) as second:
        for client in (first, second):
            client.send(op="subscribe", topic="/suite/raw", type=STRING, compression="cbor-raw")
        peer.do("advertise", "/suite/raw")
        for client in (first, second):
            message: dict[str, Any] = {}
            while not message:
                peer.do("publish", "/suite/raw", "hello")
                with contextlib.suppress(TimeoutError):
                    message = cbor2.loads(client.connection.recv(timeout=0.5))
            assert (message["op"], message["topic"]) == ("publish", "/suite/raw")
            # CDR: four bytes of header, the length with the final zero, the text, and padding.
            assert message["msg"]["bytes"][4:].startswith(b"\x06\0\0\0hello\0")


def test_send_action_goal(world: Any, peer: Peer) -> None:
    peer.do("act", "/suite/counts", "ok")
    with connect(world) as client:
        wait_for("the relay knows the action", lambda: "/suite/counts" in actions(client))
        goal = {"action": "/suite/counts", "action_type": FIBONACCI, "args": {"order": 6}}
        client.send(op="send_action_goal", **goal, feedback=True)
        *feedback, end = [client.receive() for _ in range(5)]
    counted = [0, 1, 1, 2, 3, 5]
    assert [(each["op"], each["values"]["sequence"]) for each in feedback] == [
        ("action_feedback", counted[:length]) for length in (3, 4, 5, 6)
    ]
    assert (end["op"], end["action"], end["status"], end["result"]) == (
        "action_result",
        "/suite/counts",
        4,
        True,
    )
    assert end["values"]["sequence"] == counted


def actions(client: Client) -> list[str]:
    """Actions that the relay knows."""
    found: list[str] = client.call("/rosapi/action_servers")["values"]["action_servers"]
    return found


def test_smoke(world: Any, peer: Peer) -> None:
    """Ten messages each way; the queue's length is that of roslib."""
    peer.do("listen", "/suite/up", "string")
    peer.do("advertise", "/suite/down")
    with connect(world) as client:
        client.send(op="subscribe", topic="/suite/down", type=STRING, queue_length=0)
        client.send(op="advertise", topic="/suite/up", type=STRING)
        until_passed(peer, "/suite/down", "first", client)
        wait_for(
            "the node receives",
            lambda: client.send(**published("/suite/up", "first")) or peer.heard("/suite/up"),
        )
        for _ in range(10):
            client.send(**published("/suite/up", "A" * 10))
            peer.do("publish", "/suite/down", "B" * 10)
        received: list[dict[str, Any]] = []
        while len(received) < 10:
            message = client.receive()
            if message["msg"]["data"] != "first":
                received.append(message)
        peer.until(lambda: len([each for each in peer.heard("/suite/up") if each["text"] == "A" * 10]) == 10)
    assert received == [published("/suite/down", "B" * 10)] * 10


def test_transient_local_publisher(world: Any, peer: Peer) -> None:
    """Each of three later subscribers receives the latched message."""
    peer.do("advertise", "/suite/latched", "latched")
    peer.do("publish", "/suite/latched", "hello")
    for _ in range(3):
        with connect(world) as client:
            client.send(op="subscribe", topic="/suite/latched", type=STRING)
            assert client.receive() == published("/suite/latched", "hello")
