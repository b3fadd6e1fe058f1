"""Requests about one robot whose clients disconnect, on transports in memory."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from twisted.internet.defer import CancelledError, Deferred

from relay_server.access import Principal
from relay_server.common.freshness_tokens import HEADER, FreshnessTokens
from relay_server.control.gateway import TakeResult
from relay_server.control.http import ControlEndpoints
from relay_server.control.service import StopResult
from relay_server.control.types import ControlReply
from tests.worlds.http_client import HOST, World

MOMENTS = FreshnessTokens(lambda: 1000)


class Console:
    """Waits for the test before each call."""

    def __init__(self) -> None:
        self.go: Deferred[None] = Deferred()
        self.asked: list[tuple[str, str]] = []
        self.done: list[str] = []

    async def stop(
        self, principal: Principal, robot: str, why: str, address: str, stop_id: str
    ) -> StopResult:
        """Wait, then stop it."""
        self.asked.append((robot, why))
        await self._wait()
        return StopResult(True, {"by": principal.name})

    async def take(
        self, principal: Principal, robot: str, why: str, address: str, seconds: float
    ) -> TakeResult:
        """Wait, then take control."""
        self.asked.append((robot, why))
        await self._wait()
        return TakeResult(ControlReply(True, "you have control"), {})

    async def resume(
        self, principal: Principal, robot: str, why: str, address: str, earliest_sent: int
    ) -> None:
        """Wait, then resume it."""
        self.asked.append((robot, why))
        await self._wait()

    async def _wait(self) -> None:
        try:
            await self.go
        except CancelledError:
            self.done.append("given up")
            raise
        self.done.append("done")


@pytest.fixture
def console() -> Console:
    """The control service of the site."""
    return Console()


@pytest.fixture
def world(tmp_path: Path, console: Any) -> World:
    """A site with robots to stop and resume."""
    made = World(tmp_path, tokens=MOMENTS)
    made.router.add(ControlEndpoints(console))
    return made


def leaves(world: World, part: str, method: str = "POST") -> None:
    """A client sends an order and disconnects."""
    body = '{"why": "smoke"}'
    head = f"{method} /api/v1/robots/rover/{part} HTTP/1.1\r\nHost: {HOST}\r\nAuthorization: Bearer ann\r\n"
    head += (
        f"{HEADER}: {MOMENTS.now()}\r\nContent-Type: application/json\r\nContent-Length: {len(body)}\r\n\r\n"
    )
    transport = world.connect()
    world.send(transport, (head + body).encode())
    transport.loseConnection()


def test_a_stop_continues(world: World, console: Console) -> None:
    leaves(world, "stop")
    assert console.done == []
    console.go.callback(None)
    assert (console.asked, console.done) == ([("rover", "smoke")], ["done"])


def test_a_stop_begins_after_its_client_left(
    world: World, console: Console, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The user is looked up after the client has left, and the reason is kept."""
    known: Deferred[Principal] = Deferred()
    for way in ("token", "token_from_memory"):
        monkeypatch.setattr(world.service, way, lambda token: known, raising=False)
    leaves(world, "stop")
    assert console.asked == []
    known.callback(world.service.tokens["ann"])
    assert console.asked == [("rover", "smoke")]
    console.go.callback(None)
    assert console.done == ["done"]


@pytest.mark.parametrize(("method", "part"), [("POST", "resume"), ("PUT", "control")])
def test_other_requests_are_cancelled(world: World, console: Console, method: str, part: str) -> None:
    """No robot is resumed, and no control request stays, for a client that has left."""
    leaves(world, part, method)
    assert console.asked == [("rover", "smoke")]
    assert console.done == ["given up"]
