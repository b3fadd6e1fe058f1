"""The time limit of requests, on transports in memory."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from twisted.internet.defer import CancelledError, Deferred

from relay_server.access import Principal
from relay_server.http import request_fields
from relay_server.http.endpoint import ApiRequest, endpoint
from relay_server.http.limits import ROBOT_SECONDS
from tests.worlds.http_client import World, parse

SECONDS = 10.0


class Slow:
    """The database does not answer before the test says so."""

    def __init__(self, world: World) -> None:
        self.world = world
        self.ended = ""
        self.answer: Deferred[Any] = Deferred()
        world.site.limits.answer_seconds = SECONDS
        world.service.healthy = self._healthy  # type: ignore[method-assign]

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


def test_a_request_over_the_time_limit_gets_503(slow: Slow) -> None:
    """The work is cancelled, and the connection serves the next request."""
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
    """Neither does a client that leaves."""
    served, left = slow.ask(), slow.ask()
    left.loseConnection()
    assert slow.ended == "given up"
    served.loseConnection()
    assert not slow.world.clock.getDelayedCalls()


@pytest.mark.parametrize("leaves", [True, False])
def test_a_logout_is_completed(slow: Slow, leaves: bool) -> None:
    """Even after the client has left, or was answered that it takes too long."""
    ended: list[str] = []

    async def logout(principal: Principal) -> None:
        await slow.answer
        ended.append(principal.name)

    slow.world.service.logout = logout  # type: ignore[method-assign]
    transport = slow.world.connect()
    slow.world.send(
        transport, b"DELETE /api/v1/session HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer ann\r\n\r\n"
    )
    if leaves:
        transport.loseConnection()
    else:
        slow.world.clock.advance(SECONDS + 0.1)
        assert parse(transport.value()).json["code"] == "no_answer"
    assert not ended
    slow.answer.callback(None)
    assert ended == ["ann"]


def test_a_limit_of_zero_is_no_limit(slow: Slow) -> None:
    slow.world.site.limits.answer_seconds = 0
    transport = slow.ask()
    slow.world.clock.advance(25)
    assert transport.value() == b""


@pytest.mark.parametrize(("path", "seconds"), [("/api/v1/robots/rover/slow", ROBOT_SECONDS), ("/healthz", 0)])
def test_requests_about_a_robot_have_more_time(slow: Slow, path: str, seconds: float) -> None:
    """A channel may have to be opened first."""
    slow.world.router.add(Waiting(slow))
    transport = slow.ask(path)
    slow.world.clock.advance(SECONDS - 0.1)
    slow.world.clock.advance(seconds)
    assert transport.value() == b""
    slow.world.clock.advance(0.2)
    assert parse(transport.value()).status == 503


@pytest.mark.parametrize("sent", ["Prefer: wait=40\r\n", ""])
def test_a_preferred_wait_extends_the_time_limit(slow: Slow, sent: str) -> None:
    """RFC 7240 section 4.3."""
    slow.world.router.add(Waiting(slow))
    transport = slow.world.connect()
    head = f"GET /api/v1/robots/rover/slow HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer ann\r\n{sent}\r\n"
    slow.world.send(transport, head.encode())
    slow.world.clock.advance(SECONDS + ROBOT_SECONDS + 0.1)
    assert (transport.value() == b"") is bool(sent)
    slow.world.clock.advance(40)
    assert parse(transport.value()).status == 503


def test_an_answer_that_has_begun_is_not_cut(slow: Slow) -> None:
    """Streams continue."""
    transport = slow.ask("/api/v1/robots/stream")
    slow.world.clock.pump([1.0] * 60)
    assert transport.connected
    assert transport.value().count(b"event: robots") > 10


class Waiting:
    """An endpoint that waits for the test."""

    def __init__(self, slow: Slow) -> None:
        self.slow = slow

    @endpoint("GET", "/api/v1/robots/{robot}/slow", tag="robots", summary="Wait")
    async def wait(self, request: ApiRequest, robot: str) -> dict[str, str]:
        """As long as the sender prefers."""
        request_fields.wait_preferred(request.http)
        answer: dict[str, str] = await self.slow.answer
        return answer
