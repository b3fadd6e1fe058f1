"""roslibpy and roslib.js, unmodified, with every feature they have for ROS 2, against a real graph.

Their TF clients are left out: they are clients of a node of their own (tf2_web_republisher) by topics, services and
actions like any other.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from switchboard_processes import Process, ros_environment
from switchboard_waiting import wait_for

TESTS = Path(__file__).parents[1]
CLIENTS = Path(__file__).parent / "clients"
ROSLIB = TESTS.parent / "web_client" / "node_modules" / "roslib" / "dist" / "RosLib.js"
FIXTURE = TESTS / "conformance" / "fixture_node.py"


@pytest.fixture(scope="module")
def owner(world: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """An owner of the robot, in whose graph the fixture node is."""
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


def run(*command: str) -> dict[str, Any]:
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    return dict(json.loads(done.stdout.strip().splitlines()[-1]))


def assert_throttled(said: list[int]) -> None:
    """Four samples of a counter of milliseconds, asked for every 200 ms: all of them would be 20 ms apart.

    Together, because a busy machine may delay one of them until the next.
    """
    assert len(said) >= 4
    assert said[3] - said[0] >= 300, said


def test_everything_roslib_js_can_do(world: Any, owner: str) -> None:
    """Lists, types, topics in every form, services and actions both ways, parameters, status, closing."""
    node = [str(TESTS.parent / "scripts" / "with-node.sh"), "node"]
    seen = run(*node, str(CLIENTS / "all_of_roslib.mjs"), str(ROSLIB), world.relay.url("rover"), owner)
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
    assert "did not answer within 0.2 s" in seen["tooSlow"]
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
    """Lists, types, topics, services both ways, actions, parameters, time.

    It lets a topic ask for PNG, and then does not know the op ``png``; its actions can't be offered, only used.
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
