"""Rate limits of requests, on transports in memory."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import pytest
from twisted.internet.task import Clock

from relay_server.control.http import ControlEndpoints
from relay_server.control.service import StopResult
from relay_server.http.limits import RequestLimits
from tests.worlds.http_client import World, parse
from tests.worlds.websocket_client import Client, MemoryGate

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


def test_an_answer_shows_the_remaining_requests(world: World) -> None:
    """The number grows again with time."""
    first = world.ask("GET", "/api/v1/session", **ANN)
    assert first.headers["ratelimit-policy"] == '"user";q=20;w=10'
    assert first.headers["ratelimit"] == '"user";r=19;t=1'
    assert world.ask("GET", "/api/v1/session", **ANN).headers["ratelimit"] == '"user";r=18;t=1'
    world.clock.advance(1)
    assert world.ask("GET", "/api/v1/session", **ANN).headers["ratelimit"] == '"user";r=19;t=1'


def test_requests_over_the_limit_get_429_with_the_time_to_wait(world: World) -> None:
    """Other users are served."""
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
def test_unauthenticated_requests_count_for_their_network(world: World, path: str, status: int) -> None:
    """Users of the same network have limits of their own."""
    for _ in range(BURST):
        answer = world.ask("GET", path)
        assert answer.status == status
        assert answer.headers["ratelimit-policy"] == '"network";q=20;w=10'
    assert world.ask("GET", path).status == 429
    assert world.ask("GET", "/api/v1/session", **ANN).status == 200


def test_a_login_counts_before_it_is_tried(world: World) -> None:
    """It counts for the network, whatever user it names."""
    for _ in range(BURST):
        world.ask("GET", "/healthz")
    assert world.ask("POST", "/api/v1/session", {"code": "once"}).status == 429


def test_stops_are_never_limited(world: World) -> None:
    """Other requests of the same user are."""
    stopping = Stopping()

    world.router.add(ControlEndpoints(cast(Any, stopping)))
    for _ in range(BURST + 1):
        world.ask("GET", "/api/v1/session", **ANN)
    for _ in range(BURST * 2):
        answer = world.ask("POST", "/api/v1/robots/rover/stop", **ANN)
        assert answer.status == 200
        assert "ratelimit" not in answer.headers
    assert stopping.stops == BURST * 2
    assert world.ask("GET", "/api/v1/session", **ANN).status == 429


def test_a_stop_without_valid_credentials_is_401_and_never_429(world: World) -> None:
    world.router.add(ControlEndpoints(cast(Any, Stopping())))
    for _ in range(BURST * 2):
        assert world.ask("POST", "/api/v1/robots/rover/stop").status == 401


def test_without_a_limit_nothing_is_counted(tmp_path: Path) -> None:
    """The answers have no headers about it either."""
    world = World(tmp_path)
    for _ in range(BURST * 2):
        answer = world.ask("GET", "/api/v1/session", **ANN)
        assert answer.status == 200
        assert "ratelimit" not in answer.headers


def test_a_handshake_counts_as_a_request_of_its_user_or_network() -> None:
    """Over the limit it is refused by 429 at once, also to a browser."""
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
    # Before the token is looked up the request counts for its network.
    assert status(Authorization="Bearer good") == 429
    clock.advance(BURST / RATE)
    for _ in range(BURST):
        assert status(Authorization="Bearer good") == 101
    assert status(Authorization="Bearer good") == 429
    clock.advance(1)
    assert status(Authorization="Bearer good") == 101


STREAM = b"GET /api/v1/robots/stream HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer %b\r\n\r\n"


def test_streams_of_one_user_are_limited(tmp_path: Path) -> None:
    """Other users can open theirs, and a stream that ends frees its place."""
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
    """A client that retries is served when a place is free."""
    world = World(tmp_path, streams=1)
    kept = world.connect()
    world.send(kept, STREAM % b"ann")
    for _ in range(5):
        assert world.ask("GET", "/api/v1/robots/stream", **ANN).status == 429
    kept.loseConnection()
    assert not world.site.limits._streams
