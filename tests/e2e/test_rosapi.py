"""All of rosapi, called by unmodified clients for real nodes with types unknown to the relay."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from relay_server.relay_node.interfaces import SERVICES
from tests.worlds.processes import Process, ros_environment, running
from tests.worlds.relay_process import Relay
from tests.worlds.robot_process import Robot
from tests.worlds.sync_client import Client
from tests.worlds.waiting import wait_for

TESTS = Path(__file__).parents[1]
CLIENTS = Path(__file__).parent / "clients"
ROSLIB = TESTS.parent / "web_client" / "node_modules" / "roslib" / "dist" / "RosLib.js"
NESTED = "switchboard_test_interfaces/msg/Nested"
EVERYTHING = "switchboard_test_interfaces/srv/Everything"
WALK = "switchboard_test_interfaces/action/Everything"
CHANGES: list[list[Any]] = [
    ["/lab/arm:flag", False],
    ["/lab/arm:count", -5],
    ["/lab/arm:speed", 2],
    ["lab/arm:title", "neu 🤖"],
    ["/lab/arm:raw", [0, 7, 255]],
    ["/lab/arm:flags", [False]],
    ["/lab/arm:counts", []],
    ["/lab/arm:speeds", [1, 2.5]],
    ["/lab/arm:titles", ["x"]],
    ["/lab/arm:limits.low", 2],
]
BEFORE = [True, 3, 0.5, "Grüße", [1, 255], [True, False], [1, 2], [0.5, 1.5], ["a", "b"], 1]


@pytest.fixture(scope="module")
def lab(world: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """The shared world with two more nodes in its robot's graph."""
    folder = tmp_path_factory.mktemp("rosapi")
    peer = Process(
        [sys.executable, str(CLIENTS / "rosapi_peer.py")], folder, "peer", ros_environment(world.robot.domain)
    )
    with running(peer):
        peer.wait_to_say("READY")
        with world.relay.connect("rover", world.operator) as client:

            def known() -> bool:
                services = client.call("/rosapi/services")["values"]["services"]
                actions = client.call("/rosapi/action_servers")["values"]["action_servers"]
                wanted = {
                    f"{node}/{each}" for node in ("/lab/arm", "/vault/safe") for each in PARAMETER_SERVICES
                }
                return {*wanted, "/lab/everything", "/vault/open"} <= set(services) and len(actions) == 3

            wait_for("the nodes are known", known)
        yield world


PARAMETER_SERVICES = ("get_parameters", "set_parameters", "list_parameters")


def run(*command: str) -> dict[str, Any]:
    """The results of a client."""
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    return dict(json.loads(done.stdout.strip().splitlines()[-1]))


def lengths(typedef: dict[str, Any]) -> dict[str, int]:
    """The length of each field's array."""
    return dict(zip(typedef["fieldnames"], typedef["fieldarraylen"], strict=True))


QUESTIONS: list[tuple[str, dict[str, Any]]] = [
    ("topics", {}),
    ("topics_for_type", {"type": NESTED}),
    ("topic_type", {"topic": "/lab/nested"}),
    ("topics_and_raw_types", {}),
    ("services", {}),
    ("services_for_type", {"type": EVERYTHING}),
    ("service_type", {"service": "/lab/everything"}),
    ("service_node", {"service": "/lab/everything"}),
    ("service_providers", {"service": EVERYTHING}),
    ("nodes", {}),
    ("node_details", {"node": "/lab/arm"}),
    ("publishers", {"topic": "/lab/nested"}),
    ("subscribers", {"topic": "/lab/in"}),
    ("action_servers", {}),
    ("action_type", {"action": "/lab/walk"}),
    ("interfaces", {}),
    ("message_details", {"type": NESTED}),
    ("service_request_details", {"type": EVERYTHING}),
    ("service_response_details", {"type": EVERYTHING}),
    ("action_goal_details", {"type": WALK}),
    ("action_result_details", {"type": WALK}),
    ("action_feedback_details", {"type": WALK}),
    ("get_param", {"name": "/lab/arm:none", "default_value": "5"}),
    ("has_param", {"name": "/lab/arm:speed"}),
    ("set_param", {"name": "/lab/arm:fixed", "value": "1"}),
    ("delete_param", {"name": "/lab/arm:speed"}),
    ("get_param_names", {}),
    ("get_time", {}),
    ("get_ros_version", {}),
]


def test_roslibpy_asks_every_service_of_rosapi(lab: Any) -> None:
    """Each by its name and type, and parameters of every type by the client's own helper."""
    calls = [(f"/rosapi/{name}", SERVICES[f"/rosapi/{name}"].type, args) for name, args in QUESTIONS]
    assert {name for name, _, _ in calls} == {name for name in SERVICES if name.startswith("/rosapi/")}
    script = str(CLIENTS / "rosapi_with_roslibpy.py")
    url = lab.relay.url("rover")
    before = time.time()
    seen = run(sys.executable, script, url, lab.operator, json.dumps(calls), json.dumps(CHANGES))
    reported = {name: answer for (name, _), answer in zip(QUESTIONS, seen["answers"], strict=True)}
    _says_what_is_there(reported)
    _says_what_types_are(reported)
    assert reported["get_param"] == {"value": "5", "successful": True, "reason": ""}
    assert reported["has_param"] == {"exists": True}
    assert reported["set_param"]["successful"] is False
    assert "read-only" in reported["set_param"]["reason"]
    assert reported["delete_param"]["successful"] is False
    assert reported["delete_param"]["reason"]
    assert {"/lab/arm:limits.low", "/vault/safe:code", "/switchboard_sim:max_speed"} <= set(seen["names"])
    assert before - 1 <= seen["time"] <= time.time()
    assert reported["get_ros_version"] == {"version": 2, "distro": "jazzy"}
    for (name, new), before in zip(CHANGES, BEFORE, strict=True):
        assert seen["values"][name] == [before, new, before], name


def _says_what_is_there(reported: dict[str, Any]) -> None:
    topics = dict(zip(reported["topics"]["topics"], reported["topics"]["types"], strict=True))
    assert topics["/lab/nested"] == NESTED
    assert topics["/relay/status"] == "switchboard_msgs/msg/Status"
    assert not [name for name in topics if "/_" in name]
    assert set(reported["topics_for_type"]["topics"]) == {"/lab/nested", "/vault/gold"}
    assert reported["topic_type"] == {"type": NESTED}
    raw = reported["topics_and_raw_types"]
    text = raw["typedefs_full_text"][raw["topics"].index("/lab/nested")]
    assert "PoseWithCovariance pose" in text
    assert f"{'=' * 80}\nMSG: geometry_msgs/PoseWithCovariance\n" in text
    scan = raw["typedefs_full_text"][raw["topics"].index("/scan")]
    assert "float32[] ranges" in scan
    services = set(reported["services"]["services"])
    assert {"/lab/everything", "/reset", *SERVICES} <= services
    assert not [name for name in services if "/_" in name]
    assert reported["services_for_type"] == {"services": ["/lab/everything"]}
    assert reported["service_type"] == {"type": EVERYTHING}
    assert reported["service_node"] == {"node": "/lab/arm"}
    assert reported["service_providers"] == {"providers": ["/lab/arm"]}
    assert {"/lab/arm", "/vault/safe", "/switchboard_sim", "/relay", "/rosapi"} <= set(
        reported["nodes"]["nodes"]
    )
    assert "/lab/in" in reported["node_details"]["subscribing"]
    assert "/lab/nested" in reported["node_details"]["publishing"]
    assert "/lab/everything" in reported["node_details"]["services"]
    assert reported["publishers"] == {"publishers": ["/lab/arm"]}
    assert reported["subscribers"] == {"subscribers": ["/lab/arm"]}
    assert reported["action_servers"] == {
        "action_servers": ["/lab/walk", "/relay/run_function", "/vault/dig"]
    }
    assert reported["action_type"] == {"type": WALK}
    interfaces = reported["interfaces"]["interfaces"]
    assert {NESTED, EVERYTHING, WALK, "std_msgs/msg/String", "rosapi_msgs/srv/Topics"} <= set(interfaces)
    assert interfaces == sorted(interfaces)


def _says_what_types_are(reported: dict[str, Any]) -> None:
    typedefs = {each["type"].partition("/")[2]: each for each in reported["message_details"]["typedefs"]}
    nested = reported["message_details"]["typedefs"][0]
    assert nested["type"] == "switchboard_test_interfaces/Nested"
    assert lengths(nested) == {
        "header": -1, "primitives": -1, "arrays": 2, "sequences": 0, "bounded": 0, "nothing": -1, "times": 0,
        "patience": -1, "pose": -1, "last": -1,
    }  # fmt: skip
    assert nested["fieldtypes"][0] == "std_msgs/Header"
    assert nested["examples"] == ["{}", "{}", "[]", "[]", "[]", "{}", "[]", "{}", "{}", "0"]
    assert {"Header", "Time", "Duration", "Inner", "Pose", "Empty", "Quaternion"} <= set(typedefs)
    primitives = typedefs["Primitives"]
    examples = dict(zip(primitives["fieldnames"], primitives["examples"], strict=True))
    assert examples["flag"] == "True"
    assert (examples["precise"], examples["tiny"], examples["text"]) == ("2.25", "-7", "as said")
    constants = dict(zip(primitives["constnames"], primitives["constvalues"], strict=True))
    assert constants == {
        "OFF": "0", "ON": "1", "LOWEST": "-2147483648", "HALF": "0.5", "GREETING": "hi, there",
    }  # fmt: skip
    types = dict(zip(primitives["fieldnames"], primitives["fieldtypes"], strict=True))
    assert (types["flag"], types["raw"], types["letter"], types["single"]) == (
        "boolean",
        "octet",
        "uint8",
        "float",
    )
    parts = {
        "service_request_details": ("Everything_Request", {"request": -1, "words": 0}),
        "service_response_details": ("Everything_Response", {"response": -1, "answers": 0}),
        "action_goal_details": ("Everything_Goal", {"steps": -1, "goal": -1}),
        "action_result_details": ("Everything_Result", {"result": -1, "path": 0}),
        "action_feedback_details": ("Everything_Feedback", {"step": -1, "feedback": -1}),
    }
    for service, (name, fields) in parts.items():
        first, second = reported[service]["typedefs"][:2]
        assert first["type"] == f"switchboard_test_interfaces/{name}"
        assert lengths(first) == fields
        assert second == nested
    assert reported["service_request_details"]["typedefs"][0]["constnames"] == ["PLAIN"]


def test_roslib_js_asks_with_all_its_helpers(lab: Any) -> None:
    """Lists, types, nodes, actions and parameters, with roslib.js's helpers."""
    node = [str(TESTS.parent / "scripts" / "with-node.sh"), "node", str(CLIENTS / "rosapi_with_roslib.mjs")]
    seen = run(*node, str(ROSLIB), lab.relay.url("rover"), lab.operator, json.dumps(CHANGES))
    assert "/lab/nested" in seen["topics"]["topics"]
    assert "/lab/nested" in seen["topicsForType"]
    assert seen["topicType"] == NESTED
    assert len(seen["raw"]["typedefs_full_text"]) == len(seen["raw"]["topics"]) == len(seen["raw"]["types"])
    assert "/rosapi/topics" in seen["services"]
    assert seen["servicesForType"] == ["/lab/everything"]
    assert seen["serviceType"] == EVERYTHING
    assert seen["request"]["typedefs"][0]["fieldnames"] == ["request", "words"]
    assert seen["response"]["typedefs"][0]["fieldnames"] == ["response", "answers"]
    assert "/lab/arm" in seen["nodes"]
    assert "/lab/nested" in seen["node"]["publishing"]
    assert "/lab/arm:titles" in seen["params"]
    assert seen["actions"] == ["/lab/walk", "/relay/run_function", "/vault/dig"]
    decoded = seen["decoded"]
    assert decoded["header"] == {"stamp": {"sec": "int32", "nanosec": "uint32"}, "frame_id": "string"}
    assert decoded["sequences"][0]["inners"] == [{"id": "uint8", "weight": "double", "label": "string"}]
    assert decoded["pose"]["covariance"] == ["double"]
    assert seen["status"]["health"]["battery"] == "double"
    assert seen["publishers"] == ["/lab/arm"]
    for (name, new), before in zip(CHANGES, BEFORE, strict=True):
        assert seen["values"][name] == [before, new, before], name
    assert seen["deleted"]["successful"] is True
    assert "is not set" in seen["afterDelete"]
    assert "read-only" in seen["fixed"]
    assert "no node /nobody" in seen["absent"]


@pytest.fixture(scope="module")
def guest(lab: Any) -> Iterator[Client]:
    """An operator without rights on the vault."""
    token = lab.relay.user("guest")
    lab.relay.cli("right", "grant", "guest", "rover", "operator", "--deny", "*:/vault/*")
    with lab.relay.connect("rover", token) as client:
        yield client


VAULT = {"topic": "/vault/gold", "service": "/vault/open", "action": "/vault/dig", "name": "/vault/safe:code"}


@pytest.mark.parametrize("name", [name for name, _ in QUESTIONS])
def test_no_answer_shows_what_is_denied(guest: Client, name: str) -> None:
    """The nodes are listed because of their public topics; their names in the vault are not."""
    kinds = dict.fromkeys(
        ("service_request_details", "service_response_details", "services_for_type"), EVERYTHING
    )
    kind = WALK if name.startswith("action_") else kinds.get(name, NESTED)
    answer = guest.call(f"/rosapi/{name}", {**VAULT, "node": "/vault/safe", "type": kind, "value": "1"})
    assert answer["result"] is True, answer
    values = answer["values"]
    # A refusal repeats the requested name, whether it exists or not.
    assert ("is denied to you" in values.pop("reason", "")) is (values.get("successful") is False)
    assert values.get("exists") is not True
    text = json.dumps(values)
    assert not [
        each for each in ("/vault/gold", "/vault/open", "/vault/dig", "safe:code", "1234") if each in text
    ]


def test_a_viewer_has_no_parameters(lab: Any) -> None:
    """Viewers may call no service: the error says so, and no name is listed."""
    with lab.relay.connect("rover", lab.viewer) as client:
        answer = client.call("/rosapi/get_param", {"name": "/lab/arm:speed"})["values"]
        assert answer["successful"] is False
        assert "needs the level operator" in answer["reason"]
        assert client.call("/rosapi/get_param_names")["values"] == {"names": []}


def test_services_of_a_client_are_seen_by_others(lab: Any) -> None:
    """The robot leaves its own daemon out of its graph; the relay's node has the service until the client
    leaves.
    """
    with lab.relay.connect("rover", lab.operator) as other:

        def node_of(service: str) -> str:
            return str(other.call("/rosapi/service_node", {"service": service})["values"]["node"])

        with lab.relay.connect("rover", lab.operator) as client:
            client.send(op="advertise_service", service="/lab/offered", type=EVERYTHING)
            client.send(op="advertise_action", action="/lab/offered_too", type=WALK)
            wait_for("the service is offered", lambda: node_of("/lab/offered") == "/relay")
            kind = other.call("/rosapi/service_type", {"service": "/lab/offered"})["values"]
            assert kind == {"type": EVERYTHING}
            wait_for(
                "the action is offered",
                lambda: (
                    other.call("/rosapi/action_type", {"action": "/lab/offered_too"})["values"]["type"]
                    == WALK
                ),
            )
        wait_for("the service is gone", lambda: node_of("/lab/offered") == "")


def test_a_frozen_node_blocks_no_client(lab: Any, tmp_path: Path) -> None:
    """Its parameters are left out, the others are listed."""
    with lab.relay.connect("rover", lab.operator) as client:
        lab.robot.sim.signal(19)
        try:
            names = client.call("/rosapi/get_param_names")["values"]["names"]
        finally:
            lab.robot.sim.signal(18)
        assert "/lab/arm:speed" in names
        assert "/switchboard_sim:max_speed" not in names


def test_the_relays_time_of_a_simulated_robot_is_that_of_its_clock(tmp_path: Path) -> None:
    """A simulator that publishes ``/clock`` through the relay determines get_time, and stamps that clients
    leave out.
    """
    config = tmp_path / "robot.toml"
    config.write_text("[ros]\nuse_sim_time = true\n")
    relay = Relay(tmp_path / "relay")
    with running(relay):
        robot = Robot(relay, "sim", daemon_env={"SWITCHBOARD_ROBOT_CONFIG": str(config)})
        token = relay.user("simulator")
        relay.cli("right", "grant", "simulator", "sim", "operator")
        with running(robot), relay.connect("sim", token) as client, relay.connect("sim", token) as other:
            assert other.call("/rosapi/get_time")["values"]["time"]["sec"] == 0
            client.send(op="advertise", topic="/clock", type="rosgraph_msgs/msg/Clock")
            client.send(op="advertise", topic="/stamped", type="geometry_msgs/msg/PointStamped")
            other.send(op="subscribe", topic="/stamped", type="geometry_msgs/msg/PointStamped")

            def ticked() -> bool:
                client.send(op="publish", topic="/clock", msg={"clock": {"sec": 42, "nanosec": 7}})
                found = other.call("/rosapi/get_time")["values"]["time"]
                return (found["sec"], found["nanosec"]) == (42, 7)

            wait_for("the robot's clock is followed", ticked)

            def stamped() -> dict[str, Any] | None:
                client.send(op="publish", topic="/stamped", msg={"header": {"frame_id": "map"}})
                try:
                    return other.until(0.5, op="publish", topic="/stamped")
                except TimeoutError:
                    return None

            message = wait_for("a stamped message comes back", stamped)
            assert message["msg"]["header"]["stamp"] == {"sec": 42, "nanosec": 7}
            assert other.call("/rosapi/publishers", {"topic": "/clock"})["values"]["publishers"] == ["/relay"]
