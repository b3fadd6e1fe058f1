"""Nodes over HTTP on transports in memory: filters, formats and rights."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from relay_protocol import link
from relay_protocol.errors import NotFound
from relay_server.common.freshness_tokens import HEADER
from relay_server.http.media_types import FORMS
from relay_server.in_process_sessions.pool import RobotCaller
from relay_server.resources.robots_http import NodeEndpoints, NodeService
from tests.worlds.http_client import World
from tests.worlds.relay import World as Robots

HERE = "/api/v1/robots/rover/nodes"
ANN = {"Authorization": "Bearer ann"}
BASE = {"name": "/base", "publishes": [], "subscribes": ["/cmd_vel"], "services": ["/reset"]}
LOGGER = {"name": "/logger", "publishes": [], "subscribes": ["/chatter"], "services": []}


class FakeSessions:
    """Has one session on rover for all callers."""

    def __init__(self) -> None:
        self.robots = Robots()
        self.robots.robot_comes()
        self._context = self.robots.person(deny=("*:/secret", "*:/vault/*")).context

    @asynccontextmanager
    async def at(self, caller: RobotCaller) -> AsyncIterator[Any]:
        """That session."""
        if caller.robot != "rover":
            raise NotFound("there is no such robot, or you have no right on it")
        yield SimpleNamespace(client=self._context)


class FakeResources:
    """Converts at once."""

    async def convert(self, caller: RobotCaller, work: Callable[[], Any]) -> Any:
        """Converts it here."""
        return work()


@pytest.fixture
def sessions() -> FakeSessions:
    """One robot."""
    return FakeSessions()


@pytest.fixture
def world(tmp_path: Path, sessions: Any) -> World:
    """A site with the nodes of one robot."""
    made = World(tmp_path)
    fake: Any = FakeResources()
    made.router.add(NodeEndpoints(NodeService(sessions), fake))
    return made


@pytest.mark.parametrize("media", [each.media for each in FORMS])
@pytest.mark.parametrize("address", [HERE, f"{HERE}/logger"])
def test_nodes_are_served_in_every_media_type(
    world: World, sessions: FakeSessions, address: str, media: str
) -> None:
    """Each answer has a freshness token, and an entity tag for its format that lasts until a change."""
    answer = world.ask("GET", address, Accept=media, **ANN)
    assert (answer.status, answer.headers["content-type"].partition(";")[0]) == (200, media)
    assert answer.headers[HEADER][:2] == "1." and answer.headers["vary"] == "Accept"
    assert b"/logger" in answer.body and b"/chatter" in answer.body
    known = {"Accept": media, "If_None_Match": answer.headers["etag"]}
    again = world.ask("GET", address, **known, **ANN)
    assert (again.status, again.body) == (304, b"")
    sessions.robots.registry.graph(sessions.robots.robot, link.Graph(topics={"/chatter": None}))
    assert world.ask("GET", address, **known, **ANN).status == 200


def test_a_page_of_nodes_is_filtered(world: World) -> None:
    """By name, and not by type; other parameters are refused."""
    page = world.ask("GET", f"{HERE}?name=/[bl]*&limit=1", **ANN).json
    assert page == {"nodes": [BASE], "next": "/base", "online": True}
    page = world.ask("GET", f"{HERE}?name=/[bl]*&after=/base", **ANN).json
    assert page == {"nodes": [LOGGER], "next": "", "online": True}
    for wrong in ("type=x", "colour=red", "limit=0"):
        assert world.ask("GET", f"{HERE}?{wrong}", **ANN).status == 400


def test_node_is_described(world: World) -> None:
    """With the endpoints that the caller may see."""
    assert world.ask("GET", f"{HERE}/base", **ANN).json == BASE
    vault = world.ask("GET", f"{HERE}/vault", **ANN).json
    assert vault == {"name": "/vault", "publishes": [], "subscribes": [], "services": []}


@pytest.mark.parametrize(
    ("method", "path", "headers", "status"),
    [
        ("GET", HERE, {}, 401),
        ("GET", f"{HERE}/base", {}, 401),
        ("GET", f"{HERE}/other", ANN, 404),
        ("GET", f"{HERE}/no%20name", ANN, 404),
        ("GET", HERE.replace("rover", "other"), ANN, 404),
        ("GET", f"{HERE.replace('rover', 'other')}/base", ANN, 404),
        ("GET", HERE, {**ANN, "Accept": "image/png"}, 406),
        ("POST", HERE, ANN, 405),
        ("DELETE", f"{HERE}/base", ANN, 405),
    ],
)
def test_missing_resource_is_reported(
    world: World, method: str, path: str, headers: dict[str, str], status: int
) -> None:
    """As problem details."""
    answer = world.ask(method, path, **headers)
    assert (answer.status, answer.json["status"]) == (status, status)
