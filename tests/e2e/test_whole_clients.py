"""roslibpy and roslib.js, unmodified, with all their features for ROS 2, in a real graph.

And node-wot and wotpy, without ROS, by the robot's Thing Description.

Their TF clients are left out: these use a node of their own (tf2_web_republisher) by topics, services and
actions like any other.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from tests.worlds.processes import Process, ros_environment
from tests.worlds.waiting import wait_for

TESTS = Path(__file__).parents[1]
CLIENTS = Path(__file__).parent / "clients"
ROSLIB = TESTS.parent / "web_client" / "node_modules" / "roslib" / "dist" / "RosLib.js"
FIXTURE = TESTS / "conformance" / "fixture_node.py"
NODE = [str(TESTS.parent / "scripts" / "with-node.sh"), "node"]
PYTHON_CLIENTS = TESTS.parent / ".venv" / "clients"

ROLE = "Counter-Turn-Signs"
ROLE_DOCUMENT = """
@prefix fierro: <fierro:> .
@prefix switchboard: <switchboard:> .
fierro:Counter-Turn-Signs a fierro:role ;
  fierro:subject fierro:Counter ; fierro:action fierro:Turn ; fierro:directObject fierro:Signs .
fierro:Counter fierro:data fierro:COUNT .
fierro:COUNT switchboard:resource "robots/rover/topics/conformance/counter#/data" .
fierro:Turn fierro:function fierro:INVERT, fierro:FIBONACCI .
fierro:FIBONACCI switchboard:resource "robots/rover/actions/conformance/fibonacci" .
fierro:INVERT switchboard:resource "robots/rover/services/conformance/invert" .
"""


@pytest.fixture(scope="module")
def owner(world: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """An owner of the robot, with the fixture node in its graph."""
    folder = tmp_path_factory.mktemp("fixture")
    node = Process([sys.executable, str(FIXTURE)], folder, "node", ros_environment(world.robot.domain))
    try:
        node.wait_to_say("READY")
        token = world.relay.user("owner-of-all")
        world.relay.cli("right", "grant", "owner-of-all", "rover", "owner")
        with world.relay.connect("rover", token) as client:

            def known() -> bool:
                names = client.call("/rosapi/services")["values"]["services"]
                actions = client.call("/rosapi/action_servers")["values"]["action_servers"]
                return "/conformance/do" in names and "/conformance/fibonacci" in actions

            wait_for("the fixture node is known", known)
        yield token
    finally:
        node.stop()


def run(*command: str, **environment: str) -> dict[str, Any]:
    environment = {**os.environ, **environment}
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False, env=environment)
    assert done.returncode == 0, done.stderr
    return dict(json.loads(done.stdout.strip().splitlines()[-1]))


def assert_throttled(said: list[int]) -> None:
    """Four samples of a counter of milliseconds, requested every 200 ms: without a throttle they would be 20
    ms apart.

    They are checked together, because a busy machine may delay one of them until the next.
    """
    assert len(said) >= 4
    assert said[3] - said[0] >= 300, said


def test_everything_roslib_js_can_do(world: Any, owner: str) -> None:
    """Lists, types, topics in every format, services and actions in both directions, parameters, status,
    closing.
    """
    seen = run(*NODE, str(CLIENTS / "all_of_roslib.mjs"), str(ROSLIB), world.relay.url("rover"), owner)
    assert {"/conformance/counter", "/scan"} <= set(seen["topics"])
    assert "/conformance/counter" in seen["topicsForType"]
    assert seen["topicType"] == "std_msgs/msg/Int64"
    assert "/conformance/invert" in seen["services"]
    assert "/conformance/invert" in seen["servicesForType"]
    assert seen["serviceType"] == "std_srvs/srv/SetBool"
    assert seen["requestFields"] == ["data"]
    assert seen["responseFields"] == ["success", "message"]
    assert "/conformance/fixture" in seen["nodes"]
    assert "/conformance/counter" in seen["node"]["publishing"]
    assert "/conformance/echo/in" in seen["node"]["subscribing"]
    assert "/conformance/invert" in seen["node"]["services"]
    assert "/conformance/fibonacci" in seen["actionServers"]
    assert set(seen["decoded"]) == {"linear", "angular"}
    assert "int64 data" in seen["rawType"]
    assert "/conformance/fixture:conformance.number" in seen["params"]
    for form in ("none", "png", "cbor"):
        assert seen[f"latched {form}"] == {"data": "still here"}
    raw = seen["latched cbor-raw"]
    assert (raw["secs"], raw["nsecs"]) == ("number", "number")
    assert bytes(raw["bytes"])[4:19] == b"\x0b\x00\x00\x00still here\x00"
    assert seen["echoed"] == {"data": "said by roslib.js"}
    assert_throttled(seen["throttled"])
    assert seen["publishers"] == ["/conformance/fixture"]
    assert seen["inverted"] == {"success": False, "message": "inverted"}
    assert "did not respond within 0.2 s" in seen["tooSlow"]
    assert "/nowhere does not exist" in seen["absent"]
    assert json.loads(seen["calledFromGraph"][0]) == {"success": True, "message": "from roslib.js"}
    assert seen["calledByOther"] == {"success": True, "message": "from roslib.js"}
    assert json.loads(seen["calledLater"][0]) == {"success": False, "message": "later"}
    assert seen["result"] == {"sequence": [0, 1, 1, 2, 3, 5]}
    assert seen["feedback"][-1] == {"sequence": [0, 1, 1, 2, 3, 5]}
    assert "sequence" in seen["cancelled"]
    assert "reject" in seen["rejected"]
    assert seen["served"] == {
        "accepted": True,
        "status": 4,
        "result": {"sequence": [0, 1, 1, 2]},
        "feedback": [{"sequence": [0, 1]}],
    }
    assert seen["servedFailed"]["status"] == 6
    assert (seen["servedCanceled"]["status"], seen["servedCanceled"]["result"]) == (5, {"sequence": [0]})
    assert seen["cancelWishes"] == 1
    assert (seen["before"], seen["after"]) == (7, 8)
    assert seen["set"]["successful"] is True
    assert "unknown op 'no_such_op'" in seen["status"]["msg"]
    assert seen["closed"] is True


def test_everything_roslibpy_can_do(world: Any, owner: str) -> None:
    """Lists, types, topics, services in both directions, actions, parameters, time.

    It can request PNG for a topic, but does not support the op ``png``; it can use actions but not offer
    them.
    """
    seen = run(sys.executable, str(CLIENTS / "all_of_roslibpy.py"), world.relay.url("rover"), owner)
    assert {"/conformance/counter", "/scan"} <= set(seen["topics"])
    assert "/conformance/counter" in seen["topics_for_type"]
    assert seen["topic_type"] == "std_msgs/msg/Int64"
    assert "/conformance/invert" in seen["services"]
    assert "/conformance/invert" in seen["services_for_type"]
    assert seen["service_type"] == "std_srvs/srv/SetBool"
    assert (seen["request"], seen["response"]) == (["data"], ["success", "message"])
    assert seen["message"] == ["linear", "angular"]
    assert "/conformance/fixture" in seen["nodes"]
    assert "/conformance/invert" in seen["node"]["services"]
    assert "/conformance/fibonacci" in seen["action_servers"]["action_servers"]
    assert "/conformance/fixture:conformance.number" in seen["params"]
    assert seen["time"]
    assert seen["latched"] == [{"data": "still here"}]
    assert_throttled(seen["throttled"])
    assert seen["echoed"] == {"data": "said by roslibpy"}
    assert seen["inverted"] == {"success": False, "message": "inverted"}
    assert seen["inverted later"] == {"success": True, "message": "inverted"}
    assert "/nowhere does not exist" in seen["absent"]
    assert json.loads(seen["called from graph"][0]) == {"success": False, "message": "from roslibpy"}
    assert seen["gone"] == ["0"]
    assert seen["result"]["values"] == {"sequence": [0, 1, 1, 2, 3, 5]}
    assert seen["feedback"] >= 3
    assert seen["cancelled"]["status"] == 5
    assert (seen["before"], seen["after"], seen["text"]) == (7, 9, "changed")


def test_what_node_wot_can_do(world: Any, owner: str) -> None:
    """Find, read, observe, write, invoke, query, cancel; node-wot 0.9 queries and cancels only by
    affordances.
    """
    base = f"http://127.0.0.1:{world.relay.http_port}"
    headers = {"Authorization": f"Bearer {owner}", "Content-Type": "text/turtle"}
    put = httpx.put(f"{base}/api/v1/roles/{ROLE}", content=ROLE_DOCUMENT, headers=headers)
    assert put.status_code in (200, 201, 428), put.text
    seen = run(*NODE, str(CLIENTS / "with_node_wot.mjs"), base, owner, "rover", ROLE)
    assert (seen["invalid"], seen["directoryError"]) == ({}, None)
    assert "rover" in seen["things"]
    assert seen["retrieved"] == "rover"
    assert {"header", "pose", "twist"} <= set(seen["odom"])
    assert seen["scan"] == "sensor_msgs/msg/LaserScan"
    assert seen["observed"] == sorted(set(seen["observed"]))
    assert seen["echoed"] == "written by node-wot"
    assert seen["inverted"] == {"success": False, "message": "inverted"}
    refused, released = seen["moved"]
    assert refused.startswith("Client error") and released is True
    assert seen["result"] == ["succeeded", [0, 1, 1, 2, 3, 5]]
    assert seen["cancelled"] == "canceled"
    assert (seen["parameter"], seen["image"]) == (True, [0xFF, 0xD8])
    assert seen["model"] == [
        "application/tm+json",
        ["role-state", "COUNT"],
        [
            *("start-role", "stop-role", "FIBONACCI", "stop-FIBONACCI"),
            *("INVERT", "start-INVERT", "stop-INVERT"),
        ],
    ]
    assert seen["element"] == ["COUNT", "number"]
    assert seen["called"] == {"success": True, "message": "inverted"}
    assert seen["executed"] == {"sequence": [0, 1, 1, 2, 3, 5]}
    assert seen["too long"].startswith("Client error")


def test_what_wotpy_can_do(world: Any, owner: str) -> None:
    """Read, observe, invoke, query, cancel; wotpy 0.18 cannot write with credentials."""
    base = f"http://127.0.0.1:{world.relay.http_port}"
    program = str(CLIENTS / "with_wotpy.py")
    seen = run(sys.executable, program, base, owner, "rover", PYTHONPATH=str(PYTHON_CLIENTS))
    assert {"header", "pose", "twist"} <= set(seen["odom"])
    observed = [each["data"] for each in seen["observed"]]
    assert observed == sorted(set(observed))
    assert seen["inverted"] == {"success": False, "message": "inverted"}
    assert seen["finished"] == ["succeeded", {"sequence": [0, 1, 1, 2, 3, 5]}]
    assert seen["cancelled"][0] == "canceled"
