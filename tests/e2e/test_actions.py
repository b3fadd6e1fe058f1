"""Actions in both directions: real nodes execute goals of clients, clients execute goals of real nodes."""

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
from tests.worlds.sync_client import Client
from tests.worlds.waiting import wait_for

CLIENTS = Path(__file__).parent / "clients"
FIBONACCI = "example_interfaces/action/Fibonacci"
EVERYTHING = "switchboard_test_interfaces/action/Everything"
ACTIONS = {"/counts": "ok", "/endless": "forever", "/aborts": "abort", "/rejects": "reject"}


@pytest.fixture(scope="module")
def peer(world: Any) -> Iterator[Peer]:
    """A node of the robot with actions that succeed, never end, abort and reject."""
    peer = Peer(ros_environment(world.robot.domain))
    for name, kind in ACTIONS.items():
        peer.do("act", name, kind)
    with world.operating() as client:
        # The first goal needs no type when the relay knows the graph.
        wait_for("the relay knows the actions", lambda: known(client) >= set(ACTIONS))
    yield peer
    peer.close()


def known(client: Client) -> set[str]:
    """Actions in the relay's list."""
    return set(client.call("/rosapi/action_servers")["values"]["action_servers"])


def pursue(client: Client, action: str, **more: Any) -> list[dict[str, Any]]:
    """Sends a goal; yields its messages."""
    client.send(op="send_action_goal", action=action, id="g", args={"order": 5}, **more)
    return until_the_end(client)


def until_the_end(client: Client) -> list[dict[str, Any]]:
    """Messages about the goal ``g``, its result last."""
    reported = []
    while not reported or reported[-1]["op"] != "action_result":
        message = client.receive()
        if message.get("id") == "g" and message["op"] != "status":
            reported.append(message)
    return reported


# --- goals on the robot -----------------------------------------------------------------------------------


def test_pipes_send_goals_and_carry_feedback_and_results(world: Any, peer: Peer) -> None:
    owner, number = ("--owner", "operator"), ("--target-type", "std_msgs/msg/Int32")
    pipes = {
        "counted": ("rover:/counts{}", "rover:/counted", *number, "--field", "sequence[4]=data"),
        "seen": (
            "rover:/counts/_action/feedback",
            "rover:/seen",
            *number,
            "--field",
            "feedback.sequence[1]=data",
        ),
        "counts": ("rover:/odom", "rover:/counts{}", "--rate", "5", "--field", "header.stamp.sec=order*0+5"),
    }
    for name, settings in pipes.items():
        world.relay.cli("pipe", "add", name, *settings, *owner)
    with world.operating() as client:
        for topic, value in (("/counted", 3), ("/seen", 1)):
            client.send(op="subscribe", topic=topic, type="std_msgs/msg/Int32")
            assert client.until(op="publish", topic=topic)["msg"]["data"] == value
    for name in pipes:
        assert world.relay.cli("pipe", "show", name)["state"] == "running"
        world.relay.cli("pipe", "remove", name, "--yes")


def test_a_node_executes_a_clients_goal(world: Any, peer: Peer) -> None:
    """Feedback during the execution, then one result; the type may come from the graph."""
    with world.operating() as client:
        *feedback, end = pursue(client, "/counts", feedback=True)
        assert [each["values"]["sequence"] for each in feedback] == [
            [0, 1, 1], [0, 1, 1, 2], [0, 1, 1, 2, 3]
        ]  # fmt: skip
        assert (end["status"], end["result"]) == (4, True)
        assert end["values"] == {"sequence": [0, 1, 1, 2, 3]}
        assert [
            each["op"] for each in pursue(client, "counts", action_type="example_interfaces/Fibonacci")
        ] == ["action_result"]


def test_a_client_cancels_its_goal(world: Any, peer: Peer) -> None:
    """The node ends it, and its result still arrives."""
    with world.operating() as client:
        client.send(op="send_action_goal", action="/endless", id="g", args=[3], feedback=True)
        client.until(op="action_feedback", id="g")
        client.send(op="cancel_action_goal", action="/endless", id="g")
        end = until_the_end(client)[-1]
        assert (end["status"], end["result"], end["values"]) == (5, True, {"sequence": [0, 1, 1]})


def test_failed_goals_are_reported(world: Any, peer: Peer) -> None:
    """Aborted, rejected, unknown, invalid and denied goals: one result each."""
    with world.operating() as client, world.relay.connect("rover", world.viewer) as viewer:
        (aborted,) = pursue(client, "/aborts")
        assert aborted["status"] == 6
        (rejected,) = pursue(client, "/rejects")
        assert (rejected["status"], rejected["result"]) == (0, False)
        assert "reject" in rejected["values"]
        (unknown,) = pursue(client, "/nothing")
        assert unknown["values"] == "action /nothing does not exist on robot rover"
        client.send(op="send_action_goal", action="/counts", id="g", args={"order": "five"})
        (wrong,) = until_the_end(client)
        assert "order" in wrong["values"]
        (refused,) = pursue(viewer, "/counts")
        assert (refused["status"], refused["result"]) == (0, False)


def test_a_client_that_disconnects_leaves_no_goal(world: Any, peer: Peer) -> None:
    """The node is asked to cancel."""
    ended = len(peer.reported("ended", "/endless"))
    with world.operating() as client:
        client.send(op="send_action_goal", action="/endless", id="g", args=[3], feedback=True)
        client.until(op="action_feedback", id="g")
    peer.until(lambda: len(peer.reported("ended", "/endless")) > ended)
    assert peer.reported("ended", "/endless")[-1]["canceled"] is True


def test_a_right_that_is_taken_away_cancels_goals(world: Any, peer: Peer) -> None:
    """At once, for the node and for the client."""
    token = world.relay.user("counter")
    world.relay.cli("right", "grant", "counter", "rover", "operator")
    ended = len(peer.reported("ended", "/endless"))
    with world.relay.connect("rover", token) as client:
        client.send(op="send_action_goal", action="/endless", id="g", args=[3], feedback=True)
        client.until(op="action_feedback", id="g")
        world.relay.cli("right", "grant", "counter", "rover", "viewer")
        end = until_the_end(client)[-1]
        assert (end["status"], end["result"]) == (5, False)
    peer.until(lambda: len(peer.reported("ended", "/endless")) > ended)


def test_every_kind_of_field_passes_in_goals(world: Any, tmp_path: Path) -> None:
    """Goal, feedback and result, with a node on the other side."""
    command = [sys.executable, str(CLIENTS / "everything_peer.py"), "serve", "/everything"]
    node = Process(command, tmp_path, "node", ros_environment(world.robot.domain))
    with running(node), world.operating() as client:
        node.wait_to_say('{"ready"')
        wait_for("the relay knows the action", lambda: "/everything" in known(client))
        goal = {"primitives": {"wide": "weit 🛰", "vast": 2**64 - 1}, "last": 3}
        args = {"steps": 2, "goal": goal}
        client.send(op="send_action_goal", action="/everything", id="g", args=args, feedback=True)
        *feedback, end = until_the_end(client)
        assert [each["values"]["step"] for each in feedback] == [0, 1]
        assert (end["status"], end["values"]["path"]) == (4, [0.5, 1.5])
        for message in (feedback[0]["values"]["feedback"], end["values"]["result"]):
            assert (message["primitives"]["wide"], message["primitives"]["vast"]) == ("weit 🛰", 2**64 - 1)
            assert (message["last"], message["primitives"]["port"]) == (3, 9090)


# --- goals on clients -------------------------------------------------------------------------------------


def test_a_client_executes_a_nodes_goal(world: Any, peer: Peer) -> None:
    """With feedback and a result, as a node would."""
    with world.operating() as client:
        spelled = "example_interfaces/Fibonacci"
        client.send(op="advertise_action", action="/clients", type=spelled)
        peer.do("send", "/clients", 7)
        goal = client.until(op="send_action_goal", action="/clients")
        assert (goal["args"], goal["action_type"], goal["feedback"]) == ({"order": 7}, spelled, True)
        about = {"action": "/clients", "id": goal["id"]}
        client.send(op="action_feedback", **about, values={"sequence": [0, 1]})
        peer.until(lambda: peer.reported("feedback", "/clients"))
        assert peer.reported("feedback", "/clients")[0]["sequence"] == [0, 1]
        client.send(op="action_result", **about, values={"sequence": [0, 1, 1]}, result=True)
        peer.until(lambda: peer.reported("result", "/clients"))
        end = peer.reported("result", "/clients")[0]
        assert (end["status"], end["sequence"]) == (4, [0, 1, 1])


def test_a_node_cancels_a_goal_at_a_client(world: Any, peer: Peer) -> None:
    """The client is asked to end it, and reports how it ended."""
    with world.operating() as client:
        client.send(op="advertise_action", action="/stoppable", type=FIBONACCI)
        peer.do("send", "/stoppable", 7)
        goal = client.until(op="send_action_goal")
        peer.until(lambda: peer.reported("taken", "/stoppable"))
        peer.do("cancel", "/stoppable")
        assert client.until(op="cancel_action_goal")["id"] == goal["id"]
        about = {"action": "/stoppable", "id": goal["id"]}
        client.send(op="action_result", **about, status=5, values={"sequence": [0]}, result=True)
        peer.until(lambda: peer.reported("result", "/stoppable"))
        end = peer.reported("result", "/stoppable")[0]
        assert (end["status"], end["sequence"]) == (5, [0])


def test_the_node_is_notified_when_a_client_fails_or_disappears(world: Any, peer: Peer) -> None:
    """Its goals are aborted; so are goals with invalid answers."""
    with world.operating() as client:
        client.send(op="advertise_action", action="/mortal", type=FIBONACCI)
        for order, said in ((1, {"result": False, "values": "no"}), (2, {"values": {"sum": 1}}), (3, None)):
            peer.do("send", "/mortal", order)
            goal = client.until(op="send_action_goal")
            peer.until(lambda order=order: len(peer.reported("taken", "/mortal")) == order)
            if said is None:
                client.close()
            else:
                client.send(op="action_result", action="/mortal", id=goal["id"], **said)
            peer.until(lambda order=order: len(peer.reported("result", "/mortal")) == order)
    assert [(each["order"], each["status"]) for each in peer.reported("result", "/mortal")] == [
        (1, 6), (2, 6), (3, 6)
    ]  # fmt: skip


def test_a_node_sends_every_kind_of_field_to_a_client(world: Any) -> None:
    """It returns unchanged."""
    with world.operating() as client:
        client.send(op="advertise_action", action="/reflect", type=EVERYTHING)
        node = subprocess.Popen(
            [sys.executable, str(CLIENTS / "everything_peer.py"), "send", "/reflect"],
            stdout=subprocess.PIPE,
            text=True,
            env=ros_environment(world.robot.domain),
        )
        try:
            goal = client.until(op="send_action_goal")
            about, args = {"action": "/reflect", "id": goal["id"]}, goal["args"]
            for step in range(args["steps"]):
                client.send(op="action_feedback", **about, values={"step": step, "feedback": args["goal"]})
            values = {"result": args["goal"], "path": [0.25]}
            client.send(op="action_result", **about, values=values, result=True)
            out, _ = node.communicate(timeout=60)
        finally:
            node.kill()
            node.communicate()
        seen = json.loads(out.splitlines()[-1])
        assert seen == {"status": 4, "same": True, "path": [0.25], "steps": [0, 1], "feedback_same": True}


def test_a_client_executes_a_clients_goal(world: Any) -> None:
    """With feedback, cancelling and a result; if the server disconnects, the goal ends with a reason."""
    with world.operating() as server, world.operating() as asker:
        server.send(op="advertise_action", action="/shared", type=FIBONACCI)
        server.send(op="send_action_goal", action="/shared", id="own")
        server.until(op="send_action_goal")
        asker.send(op="send_action_goal", action="/shared", id="g", feedback=True)
        goal = server.until(op="send_action_goal")
        about = {"action": "/shared", "id": goal["id"]}
        server.send(op="action_feedback", **about, values={"sequence": [7]})
        assert asker.until(op="action_feedback")["values"] == {"sequence": [7]}
        asker.send(op="cancel_action_goal", action="/shared", id="g")
        server.until(op="cancel_action_goal", id=goal["id"])
        server.send(op="action_result", **about, status=5, values={}, result=True)
        (end,) = until_the_end(asker)
        assert (end["status"], end["values"]) == (5, {"sequence": []})
        asker.send(op="send_action_goal", action="/shared", id="g")
        server.until(op="send_action_goal")
        server.close()
        (end,) = until_the_end(asker)
        assert (end["status"], end["result"]) == (6, False)
        assert end["values"] == "the client that offered /shared has left"


# --- third-party clients ----------------------------------------------------------------------------------


def offering(command: list[str], tmp_path: Path) -> Process:
    """A client that prints when its offers are ready."""
    return Process(command, tmp_path, "client")


def last_words(client: Process) -> dict[str, Any]:
    """The results of a client, which must exit with 0."""
    assert client.popen.wait(120) == 0, client.log.read_text()[-2000:]
    return dict(json.loads(client.said().splitlines()[-1]))


def test_roslibpy_offers_a_service_and_sends_goals(world: Any, peer: Peer, tmp_path: Path) -> None:
    """``Service.advertise``, ``ActionClient.send_goal`` and ``cancel_goal``."""
    script = [sys.executable, str(CLIENTS / "offering_with_roslibpy.py"), world.relay.url("rover")]
    client = offering([*script, world.operator, "/py_sum", "/counts", "/endless"], tmp_path)
    with running(client):
        client.wait_to_say("offered")
        peer.do("call", "/py_sum", 4, 5)
        peer.until(lambda: peer.reported("answer", "/py_sum"))
        assert peer.reported("answer", "/py_sum")[0]["sum"] == 9
        seen = last_words(client)
    assert seen["request"] == {"a": 4, "b": 5}
    assert seen["result"] == {"status": 4, "values": {"sequence": [0, 1, 1, 2, 3]}}
    assert seen["cancelled"]["status"] == 5
    assert seen["feedback"][:3] == [[0, 1, 1], [0, 1, 1, 2], [0, 1, 1, 2, 3]]


def test_roslib_js_offers_a_service_and_an_action_and_sends_goals(
    world: Any, peer: Peer, tmp_path: Path
) -> None:
    """``Service.advertise``, ``Action.advertise`` with cancelling, ``sendGoal`` and ``cancelGoal``."""
    root = Path(__file__).parents[2]
    module = root / "web_client" / "node_modules" / "roslib" / "dist" / "RosLib.js"
    node = [str(root / "scripts" / "with-node.sh"), "node", str(CLIENTS / "offering_with_roslib.mjs")]
    names = ["/js_sum", "/js_counts", "/counts", "/endless"]
    client = offering([*node, str(module), world.relay.url("rover"), world.operator, *names], tmp_path)
    with running(client):
        client.wait_to_say("offered")
        peer.do("call", "/js_sum", 4, 5)
        peer.until(lambda: peer.reported("answer", "/js_sum"))
        assert peer.reported("answer", "/js_sum")[0]["sum"] == 9
        peer.do("send", "/js_counts", 6)
        peer.until(lambda: peer.reported("result", "/js_counts"))
        assert peer.reported("feedback", "/js_counts")[0]["sequence"] == [6]
        peer.do("send", "/js_counts", 100)
        peer.until(lambda: len(peer.reported("taken", "/js_counts")) == 2)
        peer.do("cancel", "/js_counts")
        peer.until(lambda: len(peer.reported("result", "/js_counts")) == 2)
        seen = last_words(client)
    assert [(each["status"], each["sequence"]) for each in peer.reported("result", "/js_counts")] == [
        (4, [0, 1, 6]), (5, [0])
    ]  # fmt: skip
    assert seen["request"] == {"a": 4, "b": 5}
    assert seen["asked_to_cancel"] is True
    assert seen["result"] == {"sequence": [0, 1, 1, 2, 3]}
    assert seen["feedback"] == [[0, 1, 1], [0, 1, 1, 2], [0, 1, 1, 2, 3]]
    assert "Action was canceled" in seen["failure"]
