"""NaN and infinity in the form of Python's ``json``, to the robot's graph and back."""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cbor2
import pytest

from tests.worlds.processes import Process, ros_environment, running
from tests.worlds.sync_client import Client
from tests.worlds.waiting import PATIENCE, wait_for

PEERS = Path(__file__).parent / "clients"
NESTED = "switchboard_test_interfaces/msg/Nested"
NAN, INF = math.nan, math.inf
MESSAGE: dict[str, Any] = {
    "primitives": {"single": NAN, "precise": -INF, "text": "NaN"},
    "arrays": [{"doubles": [NAN, INF, -INF]}, {}],
    "sequences": [{"singles": [INF, 0.5, NAN], "doubles": [NAN] * 3}],
    "pose": {"covariance": [NAN] * 36},
}


@pytest.fixture(scope="module")
def peer(world: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """A node with services and actions of every kind of field, and one with parameters."""
    environment = ros_environment(world.robot.domain)
    folder = tmp_path_factory.mktemp("peers")
    serving = Process(
        [sys.executable, str(PEERS / "everything_peer.py"), "serve", "/everything"], folder, "a", environment
    )
    arm = Process([sys.executable, str(PEERS / "rosapi_peer.py")], folder, "b", environment)
    with running(serving), running(arm):
        serving.wait_to_say('{"ready')
        arm.wait_to_say("READY")
        yield


def next_binary(client: Client) -> Any:
    """The next CBOR message."""
    end = time.monotonic() + PATIENCE
    while True:
        message = client.connection.recv(timeout=max(0.01, end - time.monotonic()))
        if isinstance(message, bytes):
            return cbor2.loads(message)


def floats(array: Any) -> list[float]:
    """The numbers of a typed array of little endian floats (RFC 8746)."""
    kind = {85: "f", 86: "d"}[array.tag]
    return list(memoryview(array.value).cast(kind))


def same(found: list[float], wanted: list[float]) -> bool:
    """Whether the numbers are equal, NaN included."""
    return all(a == b or (math.isnan(a) and math.isnan(b)) for a, b in zip(found, wanted, strict=True))


def test_a_message_has_them_in_every_field_of_floats(world: Any) -> None:
    """Single values, arrays, sequences and nested messages arrive unchanged."""
    assert "NaN" in json.dumps(MESSAGE)
    with world.operating() as client:
        client.send(op="advertise", topic="/nonfinite", type=NESTED)
        client.send(op="subscribe", topic="/nonfinite", type=NESTED, compression="cbor")
        # Until DDS has matched publisher and subscription.
        for _ in range(200):
            client.send(op="publish", topic="/nonfinite", msg=MESSAGE)
            try:
                message = cbor2.loads(client.connection.recv(timeout=0.1))["msg"]
                break
            except TimeoutError:
                continue
        primitives = message["primitives"]
        assert math.isnan(primitives["single"])
        assert primitives["precise"] == -INF
        assert primitives["text"] == "NaN"
        assert same(floats(message["arrays"][0]["doubles"]), [NAN, INF, -INF])
        assert same(floats(message["sequences"][0]["singles"]), [INF, 0.5, NAN])
        assert same(floats(message["pose"]["covariance"]), [NAN] * 36)


def test_they_are_arguments_of_a_call_and_a_goal(world: Any, peer: None) -> None:
    """The answer, the feedback and the result have them as null."""
    with world.operating() as client:
        wait_for("the service responds", lambda: client.call("/everything")["result"])
        response = client.call("/everything", {"request": MESSAGE, "words": []})
        assert response["result"], response
        values = response["values"]
        assert values["response"]["primitives"]["single"] is None
        assert values["response"]["pose"]["covariance"] == [None] * 36
        client.send(
            op="send_action_goal", id="g", action="/everything", feedback=True, args={"steps": 1, "goal": MESSAGE},
            action_type="switchboard_test_interfaces/action/Everything",
        )  # fmt: skip
        assert (
            client.until(op="action_feedback", id="g")["values"]["feedback"]["primitives"]["precise"] is None
        )
        result = client.until(op="action_result", id="g")
        assert result["values"]["result"]["sequences"][0]["doubles"] == [None] * 3


@pytest.mark.parametrize(
    ("service", "answer"), [("/lab/arm:speed", "null"), ("/lab/arm:speeds", "[null,null,null]")]
)
def test_a_parameter_that_is_nan_is_set_back_as_it_was_read(
    world: Any, peer: None, service: str, answer: str
) -> None:
    """In Python's form, and as it is read."""
    with world.operating() as client:
        written = json.dumps(json.loads(answer.replace("null", "NaN")))
        wait_for(
            "its node is known",
            lambda: client.call("/rosapi/get_param", {"name": service})["values"]["successful"],
        )
        before = client.call("/rosapi/get_param", {"name": service})["values"]["value"]
        for value in (written, answer, before):
            done = client.call("/rosapi/set_param", {"name": service, "value": value})["values"]
            assert done == {"successful": True, "reason": ""}
            expected = before if value == before else answer
            assert client.call("/rosapi/get_param", {"name": service})["values"]["value"] == expected


def test_elsewhere_they_are_refused_without_a_disconnect(world: Any) -> None:
    """After many more than a hundred such messages."""
    with world.operating() as client:
        for number in range(120):
            client.send(
                op="publish", id=number, topic="/nonfinite_int", type="std_msgs/msg/Int32", msg={"data": NAN}
            )
            words = client.until(op="status", id=number)["msg"]
            assert words == "publish /nonfinite_int: std_msgs/msg/Int32: data must be an integer, not NaN"
            client.send(op="subscribe", id=number, topic="/chatter", throttle_rate=INF)
            words = client.until(op="status", id=number)["msg"]
            assert words.startswith("throttle_rate: NaN and infinity are not JSON")
        client.send(op="call_service", id="own", service="/rosapi/topics", args={"x": -INF})
        assert client.until(op="service_response", id="own")["values"].startswith(
            "NaN and infinity are no arguments"
        )
