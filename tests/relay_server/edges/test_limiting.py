"""How many requests there may be, on transports in memory."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from twisted.internet.task import Clock
from twisted.web.resource import IResource

from relay_server.common.freshness_tokens import FreshnessTokens
from relay_server.control import http as control
from relay_server.control.service import StopResult
from relay_server.http.api import Api
from relay_server.http.rate_limits import RequestLimits
from tests.relay_server.edges.http_client import World, parse
from tests.relay_server.edges.websocket_client import Client, MemoryGate

RATE = 2.0
BURST = 20
ANN = {"Authorization": "Bearer ann"}


class Stopping:
    """Stops robots, and does nothing else."""

    def __init__(self) -> None:
        self.stops = 0

    async def stop(self, *asked: Any) -> StopResult:
        """Stop a robot."""
        self.stops += 1
        return StopResult(True, None)


@pytest.fixture
def world(tmp_path: Path) -> World:
    """A site on which two requests a second are allowed in the long run."""
    (tmp_path / "index.html").write_text("<!doctype html>")
    return World(tmp_path, rate=RATE, documented=True)


def test_an_answer_tells_what_is_left(world: World) -> None:
    """Of how many in how long; it grows again as time goes by."""
    first = world.ask("GET", "/api/v1/session", **ANN)
    assert first.headers["ratelimit-policy"] == '"user";q=20;w=10'
    assert first.headers["ratelimit"] == '"user";r=19;t=1'
    assert world.ask("GET", "/api/v1/session", **ANN).headers["ratelimit"] == '"user";r=18;t=1'
    world.clock.advance(1)
    assert world.ask("GET", "/api/v1/session", **ANN).headers["ratelimit"] == '"user";r=19;t=1'


def test_who_asks_too_much_is_refused_until_there_is_some_left(world: World) -> None:
    """By 429 with the time to wait; others are served."""
    for _ in range(BURST):
        assert world.ask("GET", "/api/v1/session", **ANN).status == 200
    refused = world.ask("GET", "/api/v1/session", **ANN)
    assert (refused.status, refused.json["code"]) == (429, "too_many_requests")
    assert refused.headers["content-type"] == "application/problem+json"
    assert refused.headers["retry-after"] == "1"
    assert refused.headers["ratelimit"] == '"user";r=0;t=10'
    assert world.ask("GET", "/api/v1/session", Authorization="Bearer root").status == 200
    world.clock.advance(float(refused.headers["retry-after"]))
    assert world.ask("GET", "/api/v1/session", **ANN).status == 200


@pytest.mark.parametrize(
    ("path", "status"),
    [
        ("/healthz", 200),
        ("/api/v1/session", 401),
        ("/api/openapi.json", 200),
        ("/api/docs", 200),
        ("/robots/rover", 200),
        ("/index.html", 200),
        ("/login", 200),
        ("/nothing", 404),
    ],
)
def test_who_is_not_known_counts_for_his_network(world: World, path: str, status: int) -> None:
    """Whatever he asks; who is known there has a share of his own."""
    for _ in range(BURST):
        answer = world.ask("GET", path)
        assert answer.status == status
        assert answer.headers["ratelimit-policy"] == '"network";q=20;w=10'
    assert world.ask("GET", path).status == 429
    assert world.ask("GET", "/api/v1/session", **ANN).status == 200


def test_a_login_counts_before_it_is_tried(world: World) -> None:
    """For the network, whoever it names."""
    for _ in range(BURST):
        world.ask("GET", "/healthz")
    assert world.ask("POST", "/api/v1/session", {"code": "once"}).status == 429


def test_no_stop_is_ever_held_back(world: World) -> None:
    """However much was asked before; all else of the same user is."""
    stopping = Stopping()

    def below(api: Api, robot: str) -> IResource:
        return control.below(stopping, FreshnessTokens(lambda: 1), "stop", api, robot)  # type: ignore[arg-type]

    world.below["stop"] = below
    for _ in range(BURST + 1):
        world.ask("GET", "/api/v1/session", **ANN)
    for _ in range(BURST * 2):
        answer = world.ask("POST", "/api/v1/robots/rover/stop", **ANN)
        assert answer.status == 200
        assert "ratelimit" not in answer.headers
    assert stopping.stops == BURST * 2
    assert world.ask("GET", "/api/v1/session", **ANN).status == 429


def test_who_can_not_prove_himself_is_told_so_by_a_stop(world: World) -> None:
    """By 401, not by how many there were."""
    world.below["stop"] = lambda api, robot: control.below(
        Stopping(), FreshnessTokens(lambda: 1), "stop", api, robot
    )  # type: ignore[arg-type]
    for _ in range(BURST * 2):
        assert world.ask("POST", "/api/v1/robots/rover/stop").status == 401


def test_without_a_limit_nothing_is_counted(tmp_path: Path) -> None:
    """Nor told."""
    world = World(tmp_path)
    for _ in range(BURST * 2):
        answer = world.ask("GET", "/api/v1/session", **ANN)
        assert answer.status == 200
        assert "ratelimit" not in answer.headers


def test_a_handshake_counts_as_a_request_of_its_user_or_network() -> None:
    """Over the limit it is refused by 429 at once, also where a browser asks."""
    gate = MemoryGate()
    clock = Clock()
    limits = RequestLimits(RATE, clock.seconds)

    def status(**headers: str) -> int:
        return Client(gate, clock=clock, request_limits=limits, **headers).status

    for _ in range(BURST):
        assert status(Authorization="Bearer wrong") == 401
    assert status(Authorization="Bearer wrong") == 429
    assert status() == 429
    assert status(Origin="http://127.0.0.1:9090") == 429
    # Before anybody has looked up a token it is one of that network.
    assert status(Authorization="Bearer good") == 429
    clock.advance(BURST / RATE)
    for _ in range(BURST):
        assert status(Authorization="Bearer good") == 101
    assert status(Authorization="Bearer good") == 429
    clock.advance(1)
    assert status(Authorization="Bearer good") == 101


STREAM = b"GET /api/v1/robots/stream HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer %b\r\n\r\n"


def test_streams_of_one_user_are_limited(tmp_path: Path) -> None:
    """The next is refused in words, others open theirs, and one that ends gives its place back."""
    world = World(tmp_path, streams=2)
    kept = [world.connect() for _ in range(2)]
    for each in kept:
        world.send(each, STREAM % b"ann")
    refused = world.ask("GET", "/api/v1/robots/stream", **ANN)
    assert (refused.status, refused.json["code"]) == (429, "too_many_streams")
    assert "2 streams open" in refused.json["detail"]
    assert refused.headers["content-type"] == "application/problem+json"
    other = world.connect()
    world.send(other, STREAM % b"root")
    assert parse(other.value()).status == 200
    kept[0].loseConnection()
    again = world.connect()
    world.send(again, STREAM % b"ann")
    assert parse(again.value()).status == 200
    for each in (kept[1], again, other):
        each.loseConnection()
    assert not world.site.limits._streams


def test_a_refused_stream_takes_no_place(tmp_path: Path) -> None:
    """A client that tries again and again is served when there is room."""
    world = World(tmp_path, streams=1)
    kept = world.connect()
    world.send(kept, STREAM % b"ann")
    for _ in range(5):
        assert world.ask("GET", "/api/v1/robots/stream", **ANN).status == 429
    kept.loseConnection()
    assert not world.site.limits._streams
