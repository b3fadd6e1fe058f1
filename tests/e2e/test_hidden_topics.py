"""Topics below actions and services, and other hidden ones, in a real graph."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.worlds.processes import Process, ros_environment, running
from tests.worlds.sync_client import Client
from tests.worlds.waiting import wait_for

NODE = Path(__file__).parent / "clients" / "introspected.py"
FIBONACCI = "example_interfaces/action/Fibonacci"
TOPICS = {
    "/counted/_action/feedback": f"{FIBONACCI}_FeedbackMessage",
    "/counted/_action/status": "action_msgs/msg/GoalStatusArray",
    "/told/_service_event": "std_srvs/srv/SetBool_Event",
    "/lab/_whisper": "std_msgs/msg/String",
}
UUID, INFO = "unique_identifier_msgs/UUID", "service_msgs/ServiceEventInfo"
DERIVED = {
    f"{FIBONACCI}_FeedbackMessage": {"goal_id": UUID, "feedback": "example_interfaces/Fibonacci_Feedback"},
    f"{FIBONACCI}_SendGoal_Request": {"goal_id": UUID, "goal": "example_interfaces/Fibonacci_Goal"},
    f"{FIBONACCI}_SendGoal_Response": {"accepted": "boolean", "stamp": "builtin_interfaces/Time"},
    f"{FIBONACCI}_GetResult_Event": {
        "info": INFO, "request": "example_interfaces/Fibonacci_GetResult_Request",
        "response": "example_interfaces/Fibonacci_GetResult_Response",
    },
    f"{FIBONACCI}_Goal": {"order": "int32"},
    "std_srvs/srv/SetBool_Event": {
        "info": INFO, "request": "std_srvs/SetBool_Request", "response": "std_srvs/SetBool_Response",
    },
    "std_srvs/srv/SetBool_Response": {"success": "boolean", "message": "string"},
}  # fmt: skip


@pytest.fixture(scope="module", autouse=True)
def node(world: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """A node with a service with introspection and an action."""
    found = Process(
        [sys.executable, str(NODE)],
        tmp_path_factory.mktemp("node"),
        "node",
        ros_environment(world.robot.domain),
    )
    with running(found):
        found.wait_to_say("READY")
        with world.operating() as client:
            for topic, type_name in TOPICS.items():
                wait_for(f"{topic} is known", lambda t=topic, n=type_name: type_of(client, t) == n)
        yield


def type_of(client: Client, topic: str) -> str:
    """The type of a named topic in rosapi."""
    return str(client.call("/rosapi/topic_type", {"topic": topic})["values"]["type"])


@pytest.mark.parametrize("topic", TOPICS)
@pytest.mark.parametrize("typed", [True, False])
def test_a_hidden_topic_is_subscribed_to_when_it_is_named(world: Any, topic: str, typed: bool) -> None:
    """With and without its type."""
    with world.operating() as client:
        client.send(op="subscribe", topic=topic, **({"type": TOPICS[topic]} if typed else {}))
        seen = client.until(op="publish", topic=topic)["msg"]
    if topic.endswith("feedback"):
        assert seen["feedback"] == {"sequence": [0, 1]}
    elif topic.endswith("status"):
        assert set(seen["status_list"][0]) == {"goal_info", "status"}
    elif topic.endswith("event"):
        assert seen["info"]["event_type"] in range(4)
        assert set(seen) == {"info", "request", "response"}
    else:
        assert seen == {"data": "psst"}


def test_hidden_topics_are_not_listed(world: Any) -> None:
    """Neither by rosapi nor over HTTP nor as cameras; a named one can be read over HTTP too."""
    with world.operating() as client:
        listed = client.call("/rosapi/topics")["values"]["topics"]
        assert not [each for each in listed if "/_" in each]
        assert not client.call("/rosapi/topics_for_type", {"type": TOPICS["/told/_service_event"]})["values"][
            "topics"
        ]
    with world.over_http() as http:
        assert "/_" not in http.get("topics", params={"limit": 500}).text
        answer = http.get("topics/lab/_whisper", params={"wait": 20})
        assert answer.json()["value"] == {"data": "psst"}


@pytest.mark.parametrize("name", DERIVED)
def test_derived_types_of_services_and_actions_are_types(world: Any, name: str) -> None:
    """In rosapi's message details."""
    with world.operating() as client:
        first = client.call("/rosapi/message_details", {"type": name})["values"]["typedefs"][0]
        assert dict(zip(first["fieldnames"], first["fieldtypes"], strict=True)) == DERIVED[name]
        assert first["type"] == name.replace("/srv/", "/").replace("/action/", "/")


def test_services_of_an_action_have_details_too(world: Any) -> None:
    """Of their requests and responses."""
    with world.operating() as client:
        for part, wanted in (("request", ["goal_id"]), ("response", ["status", "result"])):
            answer = client.call(f"/rosapi/service_{part}_details", {"type": f"{FIBONACCI}_GetResult"})
            assert answer["values"]["typedefs"][0]["fieldnames"] == wanted


def test_service_events_need_the_right_to_call(world: Any) -> None:
    """Service events contain the calls' full content."""
    with world.relay.connect("rover", world.viewer) as client:
        client.send(op="set_level", level="error")
        client.send(op="subscribe", id="s", topic="/told/_service_event", type=TOPICS["/told/_service_event"])
        assert client.until(op="status", id="s")["msg"] == (
            "call on /told needs the level operator; you are viewer on this robot"
        )
        assert type_of(client, "/told/_service_event") == ""
        client.send(op="subscribe", topic="/counted/_action/feedback")
        client.until(op="publish", topic="/counted/_action/feedback")
