"""Modules as resources: the nodes that rosapi shows, what they do, and both as graphs."""

from __future__ import annotations

from typing import Any

import pytest
import pytest_twisted
from rdflib import RDF, RDFS, SOSA, SSN, XSD, Literal, Namespace, URIRef
from rdflib.compare import isomorphic

from relay_db import queries
from relay_protocol import link
from relay_protocol.errors import NotFound, Unavailable
from relay_server.http.media_types import FORMS, MediaType
from relay_server.http.rdf.encode import members_graph, module_graph
from relay_server.http.rdf.serialize import read, write
from relay_server.http_sessions.pool import SessionPool
from relay_server.relay_node import rosapi
from relay_server.resources.location import ResourceLocation
from relay_server.resources.nodes import NO_MODULE, NodeService
from relay_server.resources.page import PageQuery
from relay_server.resources.service import RequestOrigin
from tests.relay_server.front_desk import HERE, Desk
from tests.relay_server.memory import STRING

NODES = ["/base", "/logger", "/relay", "/rosapi", "/talker", "/vault"]
PLACE = ResourceLocation("https://robots.example:8443", "rover")
ROBOT = "https://robots.example:8443/api/v1/robots/rover"
OWN = Namespace("https://robots.example:8443/api/v1/vocabulary/switchboard#")
BASE = {
    "name": "/arm/base",
    "publishes": ["/arm/odom", "/tf"],
    "subscribes": ["/cmd_vel"],
    "services": ["/reset"],
}
IDLE: dict[str, Any] = {"name": "/idle", "publishes": [], "subscribes": [], "services": []}


@pytest.fixture
def guests(front: Desk) -> SessionPool:
    """Those who come by HTTP to a rover that is there."""
    front.world.robot_comes()
    return SessionPool(front.world.clock, front.desk, front.world.now_ns)


async def ann(front: Desk, scope: str | None = None) -> RequestOrigin:
    """Ann, by a token for no more than a scope."""
    return RequestOrigin(await front.by_token(front.ann, scope), "rover", HERE)


@pytest_twisted.ensureDeferred
async def test_a_page_of_modules(front: Desk, guests: SessionPool) -> None:
    """In the order of their names, by name, some at a time; the relay's own nodes are among them."""
    desk, asker = NodeService(guests), await ann(front)

    async def names(**listing: Any) -> tuple[list[str], str]:
        page = await desk.members(asker, PageQuery(**listing))
        assert page["online"]
        return [each["name"] for each in page["modules"]], page["next"]

    assert await names() == (NODES, "")
    assert await names(limit=2, after="/base") == (["/logger", "/relay"], "/relay")
    assert await names(name="/*er") == (["/logger", "/talker"], "")
    with pytest.raises(NotFound):
        await desk.members(asker._replace(robot="hidden"), PageQuery())


@pytest_twisted.ensureDeferred
async def test_one_module_is_told_as_on_the_page(front: Desk, guests: SessionPool) -> None:
    """With or without the slash at its beginning."""
    desk, asker = NodeService(guests), await ann(front)
    base = {"name": "/base", "publishes": [], "subscribes": ["/cmd_vel"], "services": ["/reset"]}
    assert await desk.module(asker, "base") == await desk.module(asker, "/base") == base
    assert base in (await desk.members(asker, PageQuery()))["modules"]
    for name in ("none", "/chatter", "", "no name"):
        with pytest.raises(NotFound, match=NO_MODULE):
            await desk.module(asker, name)
    with pytest.raises(NotFound):
        await desk.module(asker._replace(robot="hidden"), "base")


@pytest.mark.parametrize("level", ["viewer", "operator"])
@pytest.mark.parametrize("deny", [(), ("*:/secret", "*:/vault/*"), ("*:/[!c]*",)], ids=str)
@pytest.mark.parametrize("scope", [None, "subscribe:/chatter"])
@pytest_twisted.ensureDeferred
async def test_nobody_is_shown_more_than_by_rosapi(
    front: Desk, guests: SessionPool, level: str, deny: tuple[str, ...], scope: str | None
) -> None:
    """Nor less, whatever his rights and his token are for."""
    with front.store.database.begin() as session:
        queries.grant_right(session, front.rover.id, level, user_id=front.ann.id, deny=deny)
    asker = await ann(front, scope)
    told = (await NodeService(guests).members(asker, PageQuery()))["modules"]
    async with guests.at(*asker) as guest:
        ask = rosapi.SERVICES
        names = (await ask["/rosapi/nodes"](guest.session, None))["nodes"]
        details = [await ask["/rosapi/node_details"](guest.session, {"node": name}) for name in names]
    assert names == NODES == [each["name"] for each in told]
    assert details == [
        {"publishing": each["publishes"], "subscribing": each["subscribes"], "services": each["services"]}
        for each in told
    ]


@pytest_twisted.ensureDeferred
async def test_who_may_hear_one_topic_sees_no_other(front: Desk, guests: SessionPool) -> None:
    """Of the robot's: all nodes, since their names are no secret, but nothing else that they do."""
    asker = await ann(front, "subscribe:/chatter")
    told = {each["name"]: each for each in (await NodeService(guests).members(asker, PageQuery()))["modules"]}
    assert told["/talker"]["publishes"] == told["/logger"]["subscribes"] == ["/chatter"]
    for name in ("/base", "/vault"):
        assert told[name] == {"name": name, "publishes": [], "subscribes": [], "services": []}


@pytest_twisted.ensureDeferred
async def test_nodes_come_and_go_with_the_graph(front: Desk, guests: SessionPool) -> None:
    """What a robot says twice is told once; of a robot that is away nothing is known but the relay's own."""
    desk, asker = NodeService(guests), await ann(front)
    topic = link.Topic(types=[STRING], publishers=["/new", "/new"])
    front.world.registry.graph(front.world.robot, link.Graph(topics={"/said": topic}, nodes={"/new": {}}))
    assert (await desk.module(asker, "new"))["publishes"] == ["/said"]
    front.world.registry.graph(front.world.robot, link.Graph(nodes={"/new": None}))
    with pytest.raises(NotFound):
        await desk.module(asker, "new")
    front.world.robot_goes()
    page = await desk.members(asker, PageQuery())
    assert [each["name"] for each in page["modules"]] == ["/relay", "/rosapi"] and not page["online"]
    with pytest.raises(Unavailable, match="offline"):
        await desk.module(asker, "base")


@pytest.mark.parametrize("form", FORMS[1:])
def test_a_module_is_a_system(form: MediaType) -> None:
    """What it does is told by the addresses of that; where it runs nobody knows."""
    graph = module_graph(BASE, PLACE)
    node = URIRef(f"{ROBOT}/modules/arm/base")
    assert set(graph.objects(node, RDF.type)) == {OWN.Module, SSN.System}
    assert graph.value(node, OWN.name) == Literal("/arm/base", datatype=XSD.string)
    assert set(graph.objects(node, OWN.publishes)) == {
        URIRef(f"{ROBOT}/topics/arm/odom"),
        URIRef(f"{ROBOT}/topics/tf"),
    }
    assert graph.value(node, OWN.subscribes) == URIRef(f"{ROBOT}/topics/cmd_vel")
    assert graph.value(node, OWN.services) == URIRef(f"{ROBOT}/services/reset")
    assert (node, SOSA.isHostedBy, None) not in graph
    assert isomorphic(read(write(graph, form), form, str(node)), graph)


@pytest.mark.parametrize("form", FORMS[1:])
def test_modules_are_members_of_their_collection(form: MediaType) -> None:
    """With what they do, as where one is told alone."""
    graph = members_graph("modules", {"modules": [BASE, IDLE], "next": "", "online": True}, PLACE)
    collection = URIRef(f"{ROBOT}/modules")
    members = {URIRef(f"{ROBOT}/modules/arm/base"), URIRef(f"{ROBOT}/modules/idle")}
    assert set(graph.objects(collection, RDFS.member)) == members
    assert all((each, RDF.type, OWN.Module) in graph for each in members)
    alone = module_graph(BASE, PLACE)
    alone.remove((None, RDF.type, SSN.System))
    assert set(alone) <= set(graph)
    assert isomorphic(read(write(graph, form), form, str(collection)), graph)
