"""``/api/v1/robots/<robot>/people`` on transports in memory."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.worlds.http_client import World

HERE = "/api/v1/robots/rover/people"
ANN = {"Authorization": "Bearer ann"}


@pytest.fixture
def world(tmp_path: Path) -> World:
    """A site with connected users."""
    return World(tmp_path)


def test_users_of_a_robot_are_requested_by_known_clients(world: World) -> None:
    """Only with credentials, and only by GET."""
    answer = world.ask("GET", HERE, **ANN)
    assert (answer.status, answer.json) == (200, {"robot": "rover", "people": [{"user": "ann"}]})
    assert answer.headers["cache-control"] == "no-store"
    assert world.ask("GET", HERE).status == 401
    assert world.ask("GET", "/api/v1/robots/tank/people", **ANN).status == 404
    for method, path, status in (("POST", HERE, 405), ("GET", f"{HERE}/ann", 404)):
        refused = world.ask(method, path, **ANN)
        assert (refused.status, refused.headers["content-type"]) == (status, "application/problem+json")
