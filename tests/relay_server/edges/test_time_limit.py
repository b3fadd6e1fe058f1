"""How long a request may take, on transports in memory."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from klein import Klein
from twisted.internet.defer import CancelledError, Deferred

from relay_server.http import request_params
from relay_server.http.time_limit import ROBOT_SECONDS
from tests.relay_server.edges.http_client import World, parse

SECONDS = 10.0


class Slow:
    """The database does not answer before the test says so."""

    def __init__(self, world: World) -> None:
        self.world = world
        self.ended = ""
        self.answer: Deferred[Any] = Deferred()
        world.site.limits.answer_seconds = SECONDS
        world.desk.healthy = self._healthy  # type: ignore[method-assign]

    async def _healthy(self) -> bool:
        try:
            return bool(await self.answer)
        except CancelledError:
            self.ended = "given up"
            raise

    def ask(self, path: str = "/healthz") -> Any:
        """A request that has to wait for it."""
        transport = self.world.connect()
        head = f"GET {path} HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer ann\r\n\r\n"
        self.world.send(transport, head.encode())
        return transport


@pytest.fixture
def slow(tmp_path: Path) -> Slow:
    """A site."""
    return Slow(World(tmp_path))


def test_a_request_that_takes_too_long_is_answered_in_words(slow: Slow) -> None:
    """503; the work is given up, and the connection serves the next request."""
    transport = slow.ask()
    slow.world.clock.advance(SECONDS - 0.1)
    assert transport.value() == b""
    slow.world.clock.advance(0.2)
    answer = parse(transport.value())
    assert (answer.status, answer.json["code"]) == (503, "no_answer")
    assert answer.headers["content-type"] == "application/problem+json"
    assert "Idempotency-Key" in answer.json["detail"]
    assert slow.ended == "given up"
    slow.world.clock.advance(0)
    transport.clear()
    slow.answer = Deferred()
    slow.answer.callback(True)
    slow.world.send(transport, b"GET /healthz HTTP/1.1\r\nHost: x\r\n\r\n")
    assert parse(transport.value()).status == 200


def test_an_answer_in_time_leaves_no_timer(slow: Slow) -> None:
    """Nor does a client that leaves."""
    served, left = slow.ask(), slow.ask()
    left.loseConnection()
    assert slow.ended == "given up"
    served.loseConnection()
    assert not slow.world.clock.getDelayedCalls()


def test_a_limit_of_nothing_is_none(slow: Slow) -> None:
    """As the setting says."""
    slow.world.site.limits.answer_seconds = 0
    transport = slow.ask()
    slow.world.clock.advance(25)
    assert transport.value() == b""


@pytest.mark.parametrize(("path", "seconds"), [("/api/v1/robots/rover/slow", ROBOT_SECONDS), ("/healthz", 0)])
def test_what_is_asked_of_a_robot_has_longer(slow: Slow, path: str, seconds: float) -> None:
    """A channel may have to be opened first."""
    slow.world.below["slow"] = lambda api, robot: waiting(api, slow)
    transport = slow.ask(path)
    slow.world.clock.advance(SECONDS - 0.1)
    slow.world.clock.advance(seconds)
    assert transport.value() == b""
    slow.world.clock.advance(0.2)
    assert parse(transport.value()).status == 503


@pytest.mark.parametrize("sent", ["Prefer: wait=40\r\n", ""])
def test_a_wait_that_the_client_prefers_comes_on_top(slow: Slow, sent: str) -> None:
    """RFC 7240."""
    slow.world.below["slow"] = lambda api, robot: waiting(api, slow)
    transport = slow.world.connect()
    head = f"GET /api/v1/robots/rover/slow HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer ann\r\n{sent}\r\n"
    slow.world.send(transport, head.encode())
    slow.world.clock.advance(SECONDS + ROBOT_SECONDS + 0.1)
    assert (transport.value() == b"") is bool(sent)
    slow.world.clock.advance(40)
    assert parse(transport.value()).status == 503


def test_an_answer_that_has_begun_is_not_cut(slow: Slow) -> None:
    """Streams go on."""
    transport = slow.ask("/api/v1/robots/stream")
    slow.world.clock.pump([1.0] * 60)
    assert transport.connected
    assert transport.value().count(b"event: robots") > 10


def waiting(api: Any, slow: Slow) -> Any:
    """A resource that waits for the test."""
    app = Klein()

    async def work(request: Any) -> Any:
        request_params.wait_preferred(request)
        return await slow.answer

    app.route("/")(lambda request: api.answer(request, work(request)))
    return app.resource()
