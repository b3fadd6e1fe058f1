"""The ``serverInfo`` of Foxglove clients, by websocket bytes: when a session begins."""

from __future__ import annotations

import struct
from typing import Any

import msgspec

from relay_protocol import link
from relay_protocol.rights import Level
from tests.worlds.foxglove_client import Foxglove, FoxgloveWorld
from tests.worlds.relay import GRAPH, MOTION, STRING, TEXTS


def test_simulated_time_is_sent_and_a_jump_back_begins_a_session(world: FoxgloveWorld) -> None:
    client = world.client()
    world.settle(client)
    first = client.took("serverInfo")[0]
    assert "time" not in first["capabilities"]
    world.registry.described(world.robot, msgspec.structs.replace(MOTION, sim_time=True))
    (info,) = client.took("serverInfo")
    assert "time" in info["capabilities"]
    assert info["sessionId"] == first["sessionId"]
    number = next(each.number for each in world.link.take(link.Subscribe) if each.topic == "/clock")
    world.subscribed(number, "rosgraph_msgs/msg/Clock")
    for sec in (5, 3):
        world.channel.sample(number, b"\x00\x01\x00\x00" + struct.pack("<iI", sec, 0), 1)
        world.clock.advance(0.1)
        taken = client.take()
        assert struct.pack("<BQ", 2, sec * 10**9) in taken
    again = next(each for each in taken if isinstance(each, dict))
    assert again["op"] == "serverInfo"
    assert again["sessionId"] != first["sessionId"]


def test_a_robot_that_registers_again_begins_a_session_and_statuses_are_repeated(
    world: FoxgloveWorld,
) -> None:
    client = world.client()
    world.settle(client)
    first = client.took("serverInfo")[0]
    world.people[0].notify("error", "publish /x: no", "publish:/x")
    world.registry.described(world.robot, msgspec.structs.replace(MOTION, distro="kilted"))
    assert not client.took("serverInfo")
    world.robot_goes()
    client.take()
    world.robot_comes()
    messages: list[Any] = client.take()
    again = [each for each in messages if each["op"] == "serverInfo"][-1]
    assert again["sessionId"] != first["sessionId"]
    assert again["metadata"]["ROS_DISTRO"] == "kilted"
    assert "publish /x: no" in [each["message"] for each in messages if each["op"] == "status"]


def test_a_session_goes_on_while_the_link_of_the_same_daemon_comes_back(world: FoxgloveWorld) -> None:
    started = msgspec.structs.replace(MOTION, started=1.7e9)
    world.registry.described(world.robot, started)
    client = world.client()
    sessions = {each["sessionId"] for each in client.took("serverInfo")}
    for _ in range(3):
        world.robot_goes()
        world.control = world.control_link()
        world.registry.registered(world.robot, world.control)
        world.registry.described(world.robot, started)
        world.registry.graph(world.robot, GRAPH)
    assert {each["sessionId"] for each in client.took("serverInfo")} <= sessions
    world.registry.described(world.robot, msgspec.structs.replace(started, started=1.7e9 + 60))
    (again,) = client.took("serverInfo")
    assert again["sessionId"] not in sessions


SIMULATED = msgspec.structs.replace(MOTION, sim_time=True)


def _announced(messages: list[Any]) -> list[dict[str, Any]]:
    """Channels and services that are announced, sorted."""
    fields = {"advertise": "channels", "advertiseServices": "services"}
    said = [each for each in messages if isinstance(each, dict) and each["op"] in fields]
    return sorted((entry for each in said for entry in each[fields[each["op"]]]), key=str)


def _settled(world: FoxgloveWorld) -> tuple[Foxglove, list[dict[str, Any]]]:
    """A client, and all that was announced to it."""
    client = world.client()
    world.settle(client)
    entries = _announced(client.take())
    assert {"/chatter", "/cmd_vel"} <= {each.get("topic") for each in entries}
    assert {"/reset", "/relay/stop"} <= {each.get("name") for each in entries}
    return client, entries


def test_after_another_server_info_everything_is_announced_again_with_equal_entries(
    world: FoxgloveWorld,
) -> None:
    """Lichtblick forgets the types at each; it takes a channel twice if the entries are equal."""
    client, entries = _settled(world)
    for description in (SIMULATED, msgspec.structs.replace(SIMULATED, started=1.7e9)):
        world.registry.described(world.robot, description)
        world.clock.advance(0)
        messages = client.take()
        assert next(each["op"] for each in messages if isinstance(each, dict)) == "serverInfo"
        assert _announced(messages) == entries
    world.clock.advance(1)
    assert not _announced(client.take())


def test_a_channel_that_ends_while_it_waits_to_be_announced_again_is_withdrawn(world: FoxgloveWorld) -> None:
    client, entries = _settled(world)
    numbers = {each.get("topic", each.get("name")): each["id"] for each in entries}
    world.registry.described(world.robot, SIMULATED)
    world.registry.graph(world.robot, link.Graph(topics={"/chatter": None}, services={"/reset": None}))
    world.clock.advance(0)
    messages = [each for each in client.take() if isinstance(each, dict)]
    ended = [each for each in messages if each["op"].startswith("unadvertise")]
    assert [{**each, "op": ""} for each in ended] == [
        {"op": "", "channelIds": [numbers["/chatter"]]},
        {"op": "", "serviceIds": [numbers["/reset"]]},
    ]
    assert {each.get("topic", each.get("name")) for each in _announced(messages)} == (
        numbers.keys() - {"/chatter", "/reset"}
    )


def test_a_definition_that_has_changed_is_not_announced_for_the_same_number(world: FoxgloveWorld) -> None:
    client, entries = _settled(world)
    world.robot.types.add(STRING, f"{TEXTS[STRING]}# more\n")
    world.registry.described(world.robot, SIMULATED)
    world.clock.advance(0)
    again = _announced(client.take())
    assert again == [each for each in entries if each.get("topic") not in ("/chatter", "/secret")]
    assert len(again) < len(entries)


def test_a_time_that_stands_still_is_sent_again_after_each_server_info(world: FoxgloveWorld) -> None:
    """Lichtblick forgets it, also in the same session."""
    client = world.client(Level.VIEWER)
    world.settle(client)
    world.registry.described(world.robot, SIMULATED)
    number = next(each.number for each in world.link.take(link.Subscribe) if each.topic == "/clock")
    world.subscribed(number, "rosgraph_msgs/msg/Clock")
    world.channel.sample(number, b"\x00\x01\x00\x00" + struct.pack("<iI", 5, 0), 1)
    world.clock.advance(0.1)
    before = client.took("serverInfo")[-1]
    world.gate.permits["ann"].rules = world.permit(Level.OPERATOR).rules
    world.clock.advance(1)
    messages: list[Any] = client.take()
    (at,) = [n for n, each in enumerate(messages) if isinstance(each, dict) and each["op"] == "serverInfo"]
    assert messages[at]["sessionId"] == before["sessionId"]
    assert "clientPublish" in messages[at]["capabilities"]
    assert messages[at + 1] == struct.pack("<BQ", 2, 5 * 10**9)
