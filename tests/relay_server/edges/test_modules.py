"""Modules over HTTP on transports in memory: which, in which form, and to whom."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from relay_protocol import link
from relay_protocol.errors import NotFound
from relay_server.access import Principal
from relay_server.common.freshness_tokens import HEADER, FreshnessTokens
from relay_server.http.media_types import FORMS
from relay_server.resources import nodes_http as module
from relay_server.resources.nodes import NodeService
from relay_server.resources.service import RequestOrigin
from tests.relay_server.edges.http_client import World
from tests.relay_server.memory import World as Robots

HERE = "/api/v1/robots/rover/modules"
ANN = {"Authorization": "Bearer ann"}
BASE = {"name": "/base", "publishes": [], "subscribes": ["/cmd_vel"], "services": ["/reset"]}
LOGGER = {"name": "/logger", "publishes": [], "subscribes": ["/chatter"], "services": []}


class Hall:
    """Keeps a connection to rover for whoever asks."""

    def __init__(self) -> None:
        self.robots = Robots()
        self.robots.robot_comes()
        self._session = self.robots.person(deny=("*:/secret", "*:/vault/*")).session

    @asynccontextmanager
    async def at(self, principal: Principal, robot: str, address: str) -> AsyncIterator[Any]:
        """It."""
        if robot != "rover":
            raise NotFound("there is no such robot, or you have no right on it")
        yield SimpleNamespace(session=self._session)


class Desk:
    """Makes what takes long."""

    async def made(self, asker: RequestOrigin, work: Callable[[], Any]) -> Any:
        """Here and now."""
        return work()


@pytest.fixture
def hall() -> Hall:
    """One robot."""
    return Hall()


@pytest.fixture
def world(tmp_path: Path, hall: Any) -> World:
    """A site with the modules of one robot."""
    made = World(tmp_path)
    desk: Any = Desk()
    made.below["modules"] = partial(module.below, NodeService(hall), FreshnessTokens(lambda: 1), desk)
    return made


@pytest.mark.parametrize("media", [each.media for each in FORMS])
@pytest.mark.parametrize("address", [HERE, f"{HERE}/logger"])
def test_modules_are_told_in_every_form(world: World, hall: Hall, address: str, media: str) -> None:
    """With a moment, and with a tag of that form by which they are known until something changes."""
    answer = world.ask("GET", address, Accept=media, **ANN)
    assert (answer.status, answer.headers["content-type"].partition(";")[0]) == (200, media)
    assert answer.headers[HEADER][:2] == "1." and answer.headers["vary"] == "Accept"
    assert b"/logger" in answer.body and b"/chatter" in answer.body
    known = {"Accept": media, "If_None_Match": answer.headers["etag"]}
    again = world.ask("GET", address, **known, **ANN)
    assert (again.status, again.body) == (304, b"")
    hall.robots.registry.graph(hall.robots.robot, link.Graph(topics={"/chatter": None}))
    assert world.ask("GET", address, **known, **ANN).status == 200


def test_a_page_of_modules_is_filtered(world: World) -> None:
    """By name, and by no type: there is none; what no page can be asked by is refused."""
    page = world.ask("GET", f"{HERE}?name=/[bl]*&limit=1", **ANN).json
    assert page == {"modules": [BASE], "next": "/base", "online": True}
    page = world.ask("GET", f"{HERE}?name=/[bl]*&after=/base", **ANN).json
    assert page == {"modules": [LOGGER], "next": "", "online": True}
    for wrong in ("type=x", "colour=red", "limit=0"):
        assert world.ask("GET", f"{HERE}?{wrong}", **ANN).status == 400


def test_one_module_is_told(world: World) -> None:
    """As far as who asks may see what it does."""
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
def test_what_is_not_there_is_told(
    world: World, method: str, path: str, headers: dict[str, str], status: int
) -> None:
    """As problem details."""
    answer = world.ask(method, path, **headers)
    assert (answer.status, answer.json["status"]) == (status, status)
