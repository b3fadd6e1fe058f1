"""``/api/v1/robots/<robot>/people`` on transports in memory."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import pytest

from relay_protocol.errors import NotFound
from relay_server.access import Principal
from relay_server.resources import people_http as module
from tests.relay_server.edges.http_client import World

HERE = "/api/v1/robots/rover/people"
ANN = {"Authorization": "Bearer ann"}


class Desk:
    """Knows one robot."""

    async def people(self, principal: Principal, robot: str) -> dict[str, Any]:
        """Who asks is there."""
        if robot != "rover":
            raise NotFound("there is no such robot, or you have no right on it")
        return {"robot": robot, "people": [{"user": principal.name}]}


@pytest.fixture
def world(tmp_path: Path) -> World:
    """A site with people."""
    made = World(tmp_path)
    made.below["people"] = partial(module.below, Desk())
    return made


def test_who_is_at_a_robot_is_asked_by_who_is_known(world: World) -> None:
    """With a credential, and only by looking."""
    answer = world.ask("GET", HERE, **ANN)
    assert (answer.status, answer.json) == (200, {"robot": "rover", "people": [{"user": "ann"}]})
    assert answer.headers["cache-control"] == "no-store"
    assert world.ask("GET", HERE).status == 401
    assert world.ask("GET", "/api/v1/robots/tank/people", **ANN).status == 404
    for method, path, status in (("POST", HERE, 405), ("GET", f"{HERE}/ann", 404)):
        refused = world.ask(method, path, **ANN)
        assert (refused.status, refused.headers["content-type"]) == (status, "application/problem+json")
