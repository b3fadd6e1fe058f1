"""Nodes as resources: the nodes of rosapi, their endpoints, and both as graphs."""

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
from relay_server.http.rdf.encode import members_graph, node_graph
from relay_server.http.rdf.serialize import read, write
from relay_server.in_process_sessions.pool import InProcessSessionPool, RobotCaller
from relay_server.relay_node import rosapi
from relay_server.resources.page import PageQuery
from relay_server.resources.robots_http import NO_NODE, NodeService
from relay_server.resources.states import ResourceLocation
from tests.worlds.relay import STRING
from tests.worlds.session_manager import HERE, SessionsWorld

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
def pool(front: SessionsWorld) -> InProcessSessionPool:
    """A session pool with rover online."""
    front.world.robot_comes()
    return InProcessSessionPool(front.world.clock, front.service)


async def ann(front: SessionsWorld, scope: str | None = None) -> RobotCaller:
    """Ann, with a token limited to a scope."""
    return RobotCaller(await front.by_token(front.ann, scope), "rover", HERE)


@pytest_twisted.ensureDeferred
async def test_a_page_of_nodes(front: SessionsWorld, pool: InProcessSessionPool) -> None:
    """Ordered and filtered by name, with a page size; the relay's own nodes are included."""
    nodes, caller = NodeService(pool), await ann(front)

    async def names(**listing: Any) -> tuple[list[str], str]:
        page = await nodes.members(caller, PageQuery(**listing))
        assert page["online"]
        return [each["name"] for each in page["nodes"]], page["next"]

    assert await names() == (NODES, "")
    assert await names(limit=2, after="/base") == (["/logger", "/relay"], "/relay")
    assert await names(name="/*er") == (["/logger", "/talker"], "")
    with pytest.raises(NotFound):
        await nodes.members(caller._replace(robot="hidden"), PageQuery())


@pytest_twisted.ensureDeferred
async def test_node_is_described_as_on_the_page(front: SessionsWorld, pool: InProcessSessionPool) -> None:
    """With or without the leading slash."""
    nodes, caller = NodeService(pool), await ann(front)
    base = {"name": "/base", "publishes": [], "subscribes": ["/cmd_vel"], "services": ["/reset"]}
    assert await nodes.node(caller, "base") == await nodes.node(caller, "/base") == base
    assert base in (await nodes.members(caller, PageQuery()))["nodes"]
    for name in ("none", "/chatter", "", "no name"):
        with pytest.raises(NotFound, match=NO_NODE):
            await nodes.node(caller, name)
    with pytest.raises(NotFound):
        await nodes.node(caller._replace(robot="hidden"), "base")


@pytest.mark.parametrize("level", ["viewer", "operator"])
@pytest.mark.parametrize("deny", [(), ("*:/secret", "*:/vault/*"), ("*:/[!c]*",)], ids=str)
@pytest.mark.parametrize("scope", [None, "subscribe:/chatter"])
@pytest_twisted.ensureDeferred
async def test_no_more_is_shown_than_by_rosapi(
    front: SessionsWorld, pool: InProcessSessionPool, level: str, deny: tuple[str, ...], scope: str | None
) -> None:
    """Nor less, for any rights and scopes."""
    with front.store.database.begin() as session:
        queries.grant_right(session, front.rover.id, level, user_id=front.ann.id, deny=deny)
    caller = await ann(front, scope)
    reported = (await NodeService(pool).members(caller, PageQuery()))["nodes"]
    async with pool.at(caller) as pooled:
        ask = rosapi.SERVICES
        names = (await ask["/rosapi/nodes"](pooled.client, None))["nodes"]
        details = [await ask["/rosapi/node_details"](pooled.client, {"node": name}) for name in names]
    assert names == NODES == [each["name"] for each in reported]
    assert details == [
        {"publishing": each["publishes"], "subscribing": each["subscribes"], "services": each["services"]}
        for each in reported
    ]


@pytest_twisted.ensureDeferred
async def test_topics_without_right_are_hidden(front: SessionsWorld, pool: InProcessSessionPool) -> None:
    """All nodes are listed, since their names are not secret; endpoints without the right are left out."""
    caller = await ann(front, "subscribe:/chatter")
    reported = {
        each["name"]: each for each in (await NodeService(pool).members(caller, PageQuery()))["nodes"]
    }
    assert reported["/talker"]["publishes"] == reported["/logger"]["subscribes"] == ["/chatter"]
    for name in ("/base", "/vault"):
        assert reported[name] == {"name": name, "publishes": [], "subscribes": [], "services": []}


@pytest_twisted.ensureDeferred
async def test_nodes_come_and_go_with_the_graph(front: SessionsWorld, pool: InProcessSessionPool) -> None:
    """Repeated entries are listed once; an offline robot has only the relay's own nodes."""
    nodes, caller = NodeService(pool), await ann(front)
    topic = link.Topic(types=[STRING], publishers=["/new", "/new"])
    front.world.registry.graph(front.world.robot, link.Graph(topics={"/said": topic}, nodes={"/new": {}}))
    assert (await nodes.node(caller, "new"))["publishes"] == ["/said"]
    front.world.registry.graph(front.world.robot, link.Graph(nodes={"/new": None}))
    with pytest.raises(NotFound):
        await nodes.node(caller, "new")
    front.world.robot_goes()
    page = await nodes.members(caller, PageQuery())
    assert [each["name"] for each in page["nodes"]] == ["/relay", "/rosapi"] and not page["online"]
    with pytest.raises(Unavailable, match="offline"):
        await nodes.node(caller, "base")


@pytest.mark.parametrize("form", FORMS[1:])
def test_a_node_is_a_system(form: MediaType) -> None:
    """Its endpoints are linked by address; its host is unknown."""
    graph = node_graph(BASE, PLACE)
    node = URIRef(f"{ROBOT}/nodes/arm/base")
    assert set(graph.objects(node, RDF.type)) == {OWN.Node, SSN.System}
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
def test_nodes_are_members_of_their_collection(form: MediaType) -> None:
    """With the same endpoints as in a single node."""
    graph = members_graph("nodes", {"nodes": [BASE, IDLE], "next": "", "online": True}, PLACE)
    collection = URIRef(f"{ROBOT}/nodes")
    members = {URIRef(f"{ROBOT}/nodes/arm/base"), URIRef(f"{ROBOT}/nodes/idle")}
    assert set(graph.objects(collection, RDFS.member)) == members
    assert all((each, RDF.type, OWN.Node) in graph for each in members)
    alone = node_graph(BASE, PLACE)
    alone.remove((None, RDF.type, SSN.System))
    assert set(alone) <= set(graph)
    assert isomorphic(read(write(graph, form), form, str(collection)), graph)
