"""Services of Foxglove clients, by websocket bytes."""

from __future__ import annotations

import json
import struct
from typing import Any

import pytest

from relay_protocol import link
from relay_protocol.ros_types import TypeRegistry
from relay_server.sessions.session_quota import SessionQuota
from tests.worlds.foxglove_client import Foxglove, FoxgloveWorld
from tests.worlds.relay import ADD, TRIGGER

TRIGGER_REQUEST = b"\x00\x01\x00\x00\x00"


def services(client: Foxglove) -> dict[str, dict[str, Any]]:
    """Services that were advertised since the last time, by name."""
    return {
        each["name"]: each for message in client.took("advertiseServices") for each in message["services"]
    }


def calls(client: Foxglove, service: int, call: int, payload: bytes, encoding: bytes = b"cdr") -> None:
    """Call a service."""
    client.sends_binary(struct.pack("<BIII", 2, service, call, len(encoding)) + encoding + payload)


def test_services_carry_both_halves_of_the_definition(world: FoxgloveWorld) -> None:
    client = world.client(deny=("call:/vault/*",))
    world.settle(client)
    found = services(client)
    assert {"/reset", "/relay/stop"} <= found.keys()
    assert "/vault/open" not in found
    assert not [name for name in found if name.startswith("/rosapi/")]
    reset = found["/reset"]
    assert reset["type"] == TRIGGER
    assert reset["response"] == {
        "encoding": "cdr",
        "schemaName": "std_srvs/srv/Trigger_Response",
        "schemaEncoding": "ros2msg",
        "schema": "bool success\nstring message\n",
    }
    assert reset["request"]["schema"].strip() == ""


def test_a_call_in_cdr_is_answered_in_cdr(world: FoxgloveWorld) -> None:
    client = world.client()
    world.settle(client)
    number = services(client)["/reset"]["id"]
    calls(client, number, 1, TRIGGER_REQUEST)
    (call,) = world.link.take(link.CallService)
    assert call.service == "/reset"
    world.channel.message(
        link.ServiceResponse(
            id=call.id, result=True, cdr=world.cdr(f"{TRIGGER}_Response", success=True, message="ok")
        )
    )
    (answer,) = [each for each in client.take() if isinstance(each, bytes)]
    head = struct.pack("<BIII", 3, number, 1, 3) + b"cdr"
    assert answer == head + bytes.fromhex("00010000" + "01000000" + "03000000" + "6f6b00")


def test_the_relays_own_services_are_called_as_others(world: FoxgloveWorld) -> None:
    client = world.client()
    world.settle(client)
    calls(client, services(client)["/relay/stop"]["id"], 5, b'{"why":"test"}', b"json")
    world.clock.advance(0)
    (answer,) = [each for each in client.take() if isinstance(each, bytes)]
    assert answer[:13] == struct.pack("<BIII", 3, struct.unpack_from("<I", answer, 1)[0], 5, 4)
    assert json.loads(answer[17:])["success"] is True
    world.clock.advance(1)
    assert "the robot is stopped; it takes no commands until it is resumed" in client.statuses()


@pytest.mark.parametrize(
    ("service", "encoding", "payload", "words"),
    [
        ("/nowhere", b"cdr", TRIGGER_REQUEST, "there is no service"),
        ("/reset", b"protobuf", b"", "the encoding 'protobuf' is none of cdr, json"),
        ("/add", b"cdr", b"\x00\x01\x00\x00\x01", "AddTwoInts"),
        ("/add", b"json", b'{"a":1', "not JSON"),
        ("/add", b"json", b'{"a":NaN}', "a must be an integer, not NaN"),
        ("/relay/release_control", b"json", b'{"x":NaN}', "NaN and infinity are no arguments"),
        ("/add", b"json", b"}" * 3000, "not JSON"),
        ("/relay/release_control", b"json", b"}" * 70_000, "65536 bytes"),
    ],
)
def test_a_call_that_can_not_be_made_fails_with_a_reason(
    world: FoxgloveWorld, service: str, encoding: bytes, payload: bytes, words: str
) -> None:
    world.registry.graph(
        world.robot, link.Graph(services={"/add": link.Service(types=[ADD], providers=["/adder"])})
    )
    client = world.client()
    world.settle(client)
    number = services(client).get(service, {"id": 9999})["id"]
    calls(client, number, 4, payload, encoding)
    world.clock.advance(0)
    messages: list[Any] = client.take()
    (failure,) = [each for each in messages if each["op"] == "serviceCallFailure"]
    assert (failure["serviceId"], failure["callId"]) == (number, 4)
    assert words in failure["message"]
    assert [each for each in messages if each["op"] == "status" and words in each["message"]]


def test_calls_that_wait_are_limited_but_not_a_stop(world: FoxgloveWorld) -> None:
    client = world.client()
    world.settle(client)
    found = services(client)
    for call in range(33):
        calls(client, found["/reset"]["id"], call, TRIGGER_REQUEST)
    (failure,) = client.took("serviceCallFailure")
    assert failure["callId"] == 32
    calls(client, found["/relay/stop"]["id"], 99, b"{}", b"json")
    world.clock.advance(0)
    assert [each for each in client.take() if isinstance(each, bytes)]


@pytest.mark.parametrize(
    ("encoding", "payload"),
    [
        (b"cdr", b""),
        (b"cdr", b"\x00\x01"),
        (b"cdr", b"\x00\x07\x00\x00" + bytes(100)),
        (b"json", b""),
        (b"json", b"}" * 3000),
        (b"json", b'{"x":"' + b"x" * 70_000 + b'"}'),
        (b"protobuf", b"junk"),
    ],
)
def test_a_stop_with_arguments_that_can_not_be_read_stops(
    world: FoxgloveWorld, encoding: bytes, payload: bytes
) -> None:
    client = world.client()
    world.settle(client)
    calls(client, services(client)["/relay/stop"]["id"], 5, payload, encoding)
    world.clock.advance(0)
    assert world.people[0].controller.snapshot.stopped is not None
    assert [each for each in client.take() if isinstance(each, bytes)]


def test_a_used_up_quota_holds_back_messages_but_not_a_stop(world: FoxgloveWorld) -> None:
    client = world.client()
    world.settle(client)
    found = services(client)
    channel = {"id": 1, "topic": "/chatter", "encoding": "json", "schemaName": "std_msgs/String"}
    client.sends("advertise", channels=[channel])
    client.take()
    requests = world.people[0].quota.user.requests
    requests.spend(requests.left)
    client.publishes(1, b"no JSON")
    calls(client, found["/reset"]["id"], 1, b"}" * 3000, b"json")
    messages: list[Any] = client.take()
    assert len(messages) == 3
    assert all("used up" in each["message"] for each in messages)
    calls(client, found["/relay/stop"]["id"], 2, b"{}" + b" " * 5000, b"json")
    world.clock.advance(0)
    assert [each for each in client.take() if isinstance(each, bytes)]


def test_the_time_to_read_a_long_binary_message_is_counted(
    world: FoxgloveWorld, monkeypatch: pytest.MonkeyPatch
) -> None:
    client = world.client()
    world.settle(client)
    number = services(client)["/reset"]["id"]
    counting: list[bool] = []
    monkeypatch.setattr(SessionQuota, "check", lambda quota: counting.append(quota.being_timed))
    for length in (10, 5000):
        calls(client, number, 1, b"{}" + b" " * length, b"json")
    assert counting[0] is False
    assert counting[-1] is True


def test_the_time_to_encode_an_answer_is_counted(
    world: FoxgloveWorld, monkeypatch: pytest.MonkeyPatch
) -> None:
    client = world.client()
    world.settle(client)
    number = services(client)["/reset"]["id"]
    calls(client, number, 1, TRIGGER_REQUEST)
    values = world.cdr(f"{TRIGGER}_Response", success=True, message="ok")
    from_json = TypeRegistry.from_json

    def costly(*args: Any) -> bytes:
        world.worked += 0.01
        return from_json(*args)

    monkeypatch.setattr(TypeRegistry, "from_json", costly)
    left = world.people[0].quota.user.requests.left
    (call,) = world.link.take(link.CallService)
    world.channel.message(link.ServiceResponse(id=call.id, result=True, cdr=values))
    assert left - world.people[0].quota.user.requests.left >= 0.01


def test_a_service_of_two_types_stays_when_their_order_changes(world: FoxgloveWorld) -> None:
    client = world.client()
    world.settle(client)
    assert services(client)["/reset"]["type"] == TRIGGER
    for types in ([TRIGGER, ADD], [ADD, TRIGGER]):
        service = link.Service(types=types, providers=["/base"])
        world.registry.graph(world.robot, link.Graph(services={"/reset": service}))
        assert not client.took("unadvertiseServices")


def test_a_failed_call_has_one_status(world: FoxgloveWorld) -> None:
    client = world.client(deny=("call:/reset",))
    world.settle(client)
    found = services(client)
    assert "/reset" not in found
    client.take()
    calls(client, found["/relay/resume"]["id"], 1, b'{"why":7}', b"json")
    world.clock.advance(0)
    messages: list[Any] = client.take()
    assert [each["op"] for each in messages].count("serviceCallFailure") == 1
    (status,) = [each for each in messages if each["op"] == "status"]
    assert status["message"].startswith("call /relay/resume: ")
    assert status["id"] == "call:/relay/resume"
