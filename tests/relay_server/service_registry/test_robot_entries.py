"""Entries of robots in the service registry are read-only and follow the reader's rights."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import pytest
import pytest_twisted

from relay_db import queries
from relay_protocol import link
from relay_protocol.errors import NotFound, Refused
from relay_server.relay_node.visible_graph import graph_by_rules, visible_graph
from relay_server.robots.registry import RobotState
from relay_server.service_registry import robot_entries
from tests.worlds.relay import STRING, TRIGGER
from tests.worlds.service_registry import Room, read


@pytest.fixture
def there(room: Room) -> Room:
    """Rover is online, with two cameras."""
    room.world.robot_comes()
    cameras = [link.Camera(name="/usb", type=""), link.Camera(name="/eye", type="sensor_msgs/msg/Image")]
    room.world.registry.cameras(room.world.robot, link.Cameras(cameras=cameras))
    return room


async def of_rover(room: Room, who: str = "ann", **query: str) -> list[dict[str, Any]]:
    """Entries of rover."""
    return await room.all(who, robot="rover", **query)


@pytest_twisted.ensureDeferred
async def test_robots_and_what_they_have_are_entries(there: Room) -> None:
    """With the addresses of their resources."""
    (robot,) = await of_rover(there, kind="robot")
    assert robot == {
        "id": "robot:rover",
        "kind": "robot",
        "name": "rover",
        "robot": "rover",
        "address": "/api/v1/robots/rover",
        "description": "",
        "data": {"state": "online", "params": "/api/v1/robots/rover/params"},
        **dict.fromkeys(("user", "ttl", "registered", "expires")),
    }
    topics = {each["name"]: each for each in await of_rover(there, kind="topic")}
    assert topics["/chatter"]["address"] == "/api/v1/robots/rover/topics/chatter"
    assert (topics["/chatter"]["id"], topics["/chatter"]["data"]) == (
        "topic:rover:/chatter",
        {"types": [STRING]},
    )
    (reset,) = await of_rover(there, kind="service", name="/re[s]et")
    assert reset["address"] == "/api/v1/robots/rover/services/reset" and reset["data"] == {"types": [TRIGGER]}
    nodes = {each["name"]: each for each in await of_rover(there, kind="node")}
    assert nodes["/base"]["address"] == "/api/v1/robots/rover/nodes/base"
    assert (nodes["/base"]["id"], nodes["/base"]["data"]) == ("node:rover:/base", {})
    cameras = await of_rover(there, kind="camera")
    assert [(each["name"], each["data"]) for each in cameras] == [
        ("/eye", {"type": "sensor_msgs/msg/Image"}),
        ("/usb", {"type": ""}),
    ]
    assert cameras[0]["address"] == "/api/v1/robots/rover/cameras/eye"


@pytest_twisted.ensureDeferred
@pytest.mark.parametrize("deny", [[], ["*:/secret", "call:/vault/*", "view:/eye"]], ids=["all", "some"])
async def test_they_are_what_a_connection_of_the_reader_would_show(there: Room, deny: list[str]) -> None:
    """They equal the lists of resources."""
    ann = there.people["ann"]
    with there.store.database.begin() as s:
        queries.grant_right(s, 1, "operator", user_id=ann.user_id, deny=deny)
    await there.access.refresh()
    person = there.world.person(deny=tuple(deny))
    shown = visible_graph(person.session.client)
    for kind, members in (("topic", shown.topics), ("service", shown.services), ("action", shown.actions)):
        reported = await of_rover(there, kind=kind)
        assert {each["name"]: each["data"]["types"] for each in reported} == {
            name: each.types for name, each in members.items()
        }
    assert [each["name"] for each in await of_rover(there, kind="node")] == shown.nodes
    assert len(await of_rover(there, kind="camera")) == (1 if deny else 2)
    secret = [each for each in await of_rover(there) if each["name"] in ("/secret", "/vault/open")]
    assert len(secret) == (0 if deny else 2)


@pytest_twisted.ensureDeferred
async def test_visibility_follows_rights(there: Room) -> None:
    """A robot without a right is absent, and a viewer sees no services that they may not call."""
    assert {each["robot"] for each in await there.all("ann")} == {"rover"}
    assert {each["robot"] for each in await there.all("bob", kind="robot")} == {"hidden", "rover"}
    assert not any(each["name"] == "/reset" for each in await of_rover(there, "bob", kind="service"))
    assert await there.all(there.by_token("ann", "viewer@hidden"), kind="robot") == []
    (other,) = await there.all("cleo", kind="robot")
    assert other["data"]["state"] == "offline"


@pytest_twisted.ensureDeferred
async def test_a_robot_that_is_away_has_what_the_relay_offers(room: Room) -> None:
    """As in the lists of resources."""
    away = RobotState(9, "away", "default")
    ((_, rules),) = await room.access.robots(room.people["ann"])
    names = list(graph_by_rules(away, robot_entries.OwnEndpoints(), rules).services)
    assert [each["name"] for each in await of_rover(room, kind="service")] == names
    assert all(each.startswith(("/relay/", "/rosapi/")) for each in names)


@pytest_twisted.ensureDeferred
async def test_entry_is_read_by_its_id(there: Room) -> None:
    """It equals the list; no user may change it."""
    for reported in await of_rover(there):
        one = read(await there.service.one(there.people["ann"], reported["id"]))
        assert {name: one[name] for name in reported} == reported
    for id in (
        "topic:rover:/none",
        "topic:hidden:/chatter",
        "robot:hidden",
        "module:rover:/talker",
        "topic",
        "",
    ):
        with pytest.raises(NotFound):
            await there.service.one(there.people["ann"], id)
    for who in ("ann", "root"):
        with pytest.raises(Refused, match="cannot be changed or removed"):
            await there.put(who, "topic:rover:/chatter")
        with pytest.raises(Refused, match="cannot be changed or removed"):
            await there.remove(who, "robot:rover")
    with pytest.raises(NotFound):
        await there.remove("cleo", "topic:rover:/chatter")


@pytest_twisted.ensureDeferred
async def test_pages_join_all_in_one_order(there: Room, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each entry appears once, for any page size and any search limit."""
    await there.register("bob", name="/odd one", robot="hidden")
    for name in ("a", "z"):
        await there.register(name=name)
        await there.register(name=f"/{name}", robot="rover")
        await there.register(kind="zoo", name=name, robot="rover")
    whole = await there.all("bob", limit="1000")
    order = [(each["robot"] or "", each["kind"], each["name"], each["id"]) for each in whole]
    assert all(one < other for one, other in pairwise(order))
    assert len([each for each in whole if each["user"]]) == 7 and len(whole) > 90
    for limit in ("1", "7", "100"):
        assert await there.all("bob", limit=limit) == whole
    monkeypatch.setattr(robot_entries, "MAX_SCANNED", 45)
    for limit in ("2", "1000"):
        assert await there.all("bob", limit=limit) == whole
    wanted = [each for each in whole if each["name"].startswith("/")]
    assert await there.all("bob", name="/*", limit="3") == wanted


@pytest_twisted.ensureDeferred
async def test_an_entry_that_fits_far_behind_is_found_all_the_same(
    there: Room, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Pages before it are empty and have a cursor."""
    monkeypatch.setattr(robot_entries, "MAX_SCANNED", 25)
    await there.register(kind="zoo", name="needle", robot="rover")
    assert [each["kind"] for each in await there.all("bob", name="needle")] == ["zoo"]
    assert await there.all("bob", name="/cha*r") == [
        each for each in await there.all("bob", kind="topic") if each["name"] == "/chatter"
    ]
