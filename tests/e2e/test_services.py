"""Services that clients offer to a robot's graph, called by real nodes and by other clients."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.robot_client.ros import Peer
from tests.worlds.processes import Process, ros_environment, running
from tests.worlds.relay_process import Relay
from tests.worlds.robot_process import Robot
from tests.worlds.sync_client import Client
from tests.worlds.waiting import PATIENCE, wait_for

CLIENTS = Path(__file__).parent / "clients"
EVERYTHING = "switchboard_test_interfaces/srv/Everything"
ADD = "example_interfaces/srv/AddTwoInts"


@pytest.fixture(scope="module")
def peer(world: Any) -> Iterator[Peer]:
    """A node of the robot, in its own process."""
    peer = Peer(ros_environment(world.robot.domain))
    yield peer
    peer.close()


def adds(client: Client, service: str, seconds: float = PATIENCE) -> dict[str, Any]:
    """Answers the next call with the sum; returns the call."""
    call = client.until(seconds, op="call_service", service=service)
    values = {"sum": call["args"]["a"] + call["args"]["b"]}
    client.send(op="service_response", service=service, id=call["id"], values=values, result=True)
    return call


def called_again(peer: Peer, client: Client) -> dict[str, Any] | None:
    """Makes the node call once more; returns the call if it arrived."""
    peer.do("call", "/again", 3, 4)
    try:
        return client.until(2.0, op="call_service", args={"a": 3, "b": 4})
    except TimeoutError:
        return None


def everything(world: Any, what: str, name: str) -> list[str]:
    """The command of a node with every kind of field."""
    return [sys.executable, str(CLIENTS / "everything_peer.py"), what, name]


def test_a_node_calls_a_service_of_a_client(world: Any, peer: Peer) -> None:
    """Repeatedly, also several calls at a time, answered in any order."""
    with world.operating() as client:
        client.send(op="advertise_service", service="/sum", type="example_interfaces/AddTwoInts")
        peer.do("call", "/sum", 2, 3)
        call = adds(client, "/sum")
        assert call.keys() == {"op", "id", "service", "args"}
        assert call["args"] == {"a": 2, "b": 3}
        peer.until(lambda: peer.reported("answer", "/sum"))
        assert peer.reported("answer", "/sum")[0]["sum"] == 5
        peer.do("call", "/sum", 10, 1)
        peer.do("call", "/sum", 20, 2)
        calls = [client.until(op="call_service") for _ in range(2)]
        for each in reversed(calls):
            values = {"sum": each["args"]["a"] + each["args"]["b"]}
            client.send(op="service_response", service="/sum", id=each["id"], values=values)
        peer.until(lambda: len(peer.reported("answer", "/sum")) == 3)
        assert {(each["a"], each["sum"]) for each in peer.reported("answer", "/sum")[1:]} == {
            (10, 11),
            (20, 22),
        }


def test_every_kind_of_field_passes(world: Any) -> None:
    """From the graph to JSON and back, unchanged."""
    with world.operating() as client:
        client.send(op="advertise_service", service="/mirror", type=EVERYTHING)
        node = subprocess.Popen(
            everything(world, "call", "/mirror"),
            stdout=subprocess.PIPE,
            text=True,
            env=ros_environment(world.robot.domain),
        )
        try:
            call = client.until(op="call_service", service="/mirror")
            assert call["args"]["words"] == ["one", "two"]
            request = call["args"]["request"]
            assert request["primitives"]["text"] == "Grüße 🤖"
            assert request["primitives"]["vast"] == 2**64 - 1
            values = {"response": request, "answers": [True, False, True]}
            client.send(op="service_response", service="/mirror", id=call["id"], values=values)
            out, _ = node.communicate(timeout=60)
        finally:
            node.kill()
            node.communicate()
        seen = json.loads(out.splitlines()[-1])
        assert seen["same"] is True
        assert seen["answers"] == [True, False, True]


def test_a_client_calls_a_service_with_every_kind_of_field(world: Any, tmp_path: Path) -> None:
    """It returns unchanged."""
    node = Process(
        everything(world, "serve", "/nodes_mirror"), tmp_path, "node", ros_environment(world.robot.domain)
    )
    with running(node), world.operating() as client:
        node.wait_to_say('{"ready"')
        asked = {"words": ["w"], "request": {"primitives": {"wide": "weit 🛰", "tiny": -128}, "last": 3}}
        answer = wait_for(
            "the node's service answers",
            lambda: (found := client.call("/nodes_mirror", asked))["result"] and found,
        )
        response = answer["values"]["response"]
        assert answer["values"]["answers"] == [True, False]
        assert response["last"] == 3
        assert (response["primitives"]["wide"], response["primitives"]["tiny"]) == ("weit 🛰", -128)
        assert response["primitives"]["text"] == "as said"


def test_a_client_that_leaves_takes_its_service_along(world: Any, peer: Peer) -> None:
    """The pending call is lost, as with any node that dies; the next client's service is found and answers."""
    with world.operating() as client:
        client.send(op="advertise_service", service="/brief", type=ADD)
        peer.do("call", "/brief", 1, 1)
        client.until(op="call_service", service="/brief")
    with world.operating() as client:
        # The name is free at once.
        client.send(op="advertise_service", service="/brief", type=ADD)
        peer.do("call", "/brief", 2, 2)
        assert adds(client, "/brief")["args"] == {"a": 2, "b": 2}
        peer.until(lambda: peer.reported("answer", "/brief"))
        assert [each["sum"] for each in peer.reported("answer", "/brief")] == [4]


def test_names_that_are_taken_are_refused(world: Any) -> None:
    """By another client, by the robot, by the relay; and with a type that the robot does not have."""
    with world.operating() as first, world.operating() as second:
        first.send(op="advertise_service", service="/taken", type=ADD)
        # A call of its own shows that the relay has handled earlier requests.
        first.send(op="call_service", service="/taken", args={"a": 1})
        adds(first, "/taken")
        for name, type_name, words in (
            ("/taken", ADD, "another client offers the service /taken already"),
            ("/reset", "std_srvs/srv/Trigger", "the robot offers the service /reset itself"),
            ("/rosapi/topics", ADD, "the relay's own"),
            ("/untyped", "no_such_package/srv/Nothing", "no_such_package"),
        ):
            second.send(op="advertise_service", service=name, type=type_name)
            assert words in second.until(op="status")["msg"]


def test_a_client_calls_a_client(world: Any) -> None:
    """Answers, failures with reasons, invalid arguments and a server that disconnects: every call is
    answered.
    """
    with world.operating() as server, world.operating() as caller:
        server.send(op="advertise_service", service="/between", type=ADD)
        server.send(op="call_service", service="/between", id="ready", args=[1])
        adds(server, "/between")
        server.until(op="service_response", id="ready")
        caller.send(op="call_service", service="/between", id=1, args={"a": 40, "b": 2})
        adds(server, "/between")
        assert caller.until(op="service_response", id=1)["values"] == {"sum": 42}
        caller.send(op="call_service", service="/between", id=2)
        call = server.until(op="call_service")
        assert call["args"] == {"a": 0, "b": 0}
        server.send(
            op="service_response", service="/between", id=call["id"], result=False, values="not today"
        )
        answer = caller.until(op="service_response", id=2)
        assert (answer["result"], answer["values"]) == (False, "not today")
        caller.send(op="call_service", service="/between", id=3, args={"c": 1})
        answer = caller.until(op="service_response", id=3)
        assert answer["result"] is False
        assert "c" in answer["values"]
        caller.send(op="call_service", service="/between", id=4)
        server.until(op="call_service")
        server.close()
        answer = caller.until(op="service_response", id=4)
        assert (answer["result"], answer["values"]) == (False, "the client that offered /between has left")


def test_offering_and_calling_a_service_need_rights(world: Any) -> None:
    """A viewer has neither."""
    with world.operating() as server, world.relay.connect("rover", world.viewer) as viewer:
        server.send(op="advertise_service", service="/judged", type=ADD)
        viewer.send(op="set_level", level="error")
        viewer.send(op="advertise_service", service="/viewers", type=ADD)
        assert "provide on /viewers" in viewer.until(op="status")["msg"]
        assert viewer.call("/judged")["result"] is False


def test_an_offer_is_made_again_when_the_robot_is_back(tmp_path: Path) -> None:
    """The daemon was killed during a call; the client notices only that."""
    relay = Relay(tmp_path, "--heartbeat", "0.5")
    with running(relay):
        token = relay.user("driver")
        robot = Robot(relay, "rover")
        relay.cli("right", "grant", "driver", "rover", "operator")
        peer = Peer(ros_environment(robot.domain))
        try:
            with relay.connect("rover", token) as client:
                client.send(op="advertise_service", service="/again", type=ADD)
                peer.do("call", "/again", 1, 2)
                lost = client.until(op="call_service")
                robot.daemon.kill()
                wait_for("the robot is away", lambda: relay.state_of("rover") == "offline")
                robot.start_daemon()
                robot.wait_online()
                client.send(op="service_response", service="/again", id=lost["id"], values={"sum": 3})
                # The node sees the dead server for a while; its calls are lost meanwhile, as in any ROS
                # graph.
                call = wait_for("a call comes through", lambda: called_again(peer, client), 60)
                client.send(op="service_response", service="/again", id=call["id"], values={"sum": 7})
                peer.until(lambda: any(each["a"] == 3 for each in peer.reported("answer", "/again")))
                assert peer.reported("answer", "/again")[-1]["sum"] == 7
        finally:
            peer.close()
            robot.stop()
