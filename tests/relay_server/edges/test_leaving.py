"""What becomes of an order to one robot when its client leaves, on transports in memory."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import pytest
from twisted.internet.defer import CancelledError, Deferred

from relay_server.access import Principal
from relay_server.common.freshness_tokens import HEADER, FreshnessTokens
from relay_server.control import http as control
from relay_server.control.service import StopResult, TakeResult
from relay_server.control.types import ControlReply
from tests.relay_server.edges.http_client import HOST, World

MOMENTS = FreshnessTokens(lambda: 1000)


class Console:
    """Does nothing before the test says so."""

    def __init__(self) -> None:
        self.go: Deferred[None] = Deferred()
        self.asked: list[tuple[str, str]] = []
        self.done: list[str] = []

    async def stop(self, principal: Principal, robot: str, why: str, address: str) -> StopResult:
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

    async def resume(self, principal: Principal, robot: str, why: str, address: str, sent: int) -> None:
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
    """Who is asked."""
    return Console()


@pytest.fixture
def world(tmp_path: Path, console: Any) -> World:
    """A site at which robots are stopped and resumed."""
    made = World(tmp_path)
    made.below.update({part: partial(control.below, console, MOMENTS, part) for part in control.PARTS})
    return made


def leaves(world: World, part: str, method: str = "POST") -> None:
    """Somebody gives an order, and is gone."""
    body = '{"why": "smoke"}'
    head = f"{method} /api/v1/robots/rover/{part} HTTP/1.1\r\nHost: {HOST}\r\nAuthorization: Bearer ann\r\n"
    head += (
        f"{HEADER}: {MOMENTS.now()}\r\nContent-Type: application/json\r\nContent-Length: {len(body)}\r\n\r\n"
    )
    transport = world.connect()
    world.send(transport, (head + body).encode())
    transport.loseConnection()


def test_a_stop_goes_on(world: World, console: Console) -> None:
    """Nobody is told of it, and it is done."""
    leaves(world, "stop")
    assert console.done == []
    console.go.callback(None)
    assert (console.asked, console.done) == ([("rover", "smoke")], ["done"])


def test_a_stop_begins_though_nobody_waits_for_it(
    world: World, console: Console, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Who it is from is found out after he has left, and why is not lost."""
    known: Deferred[Principal] = Deferred()
    for way in ("token", "urgent_token"):
        monkeypatch.setattr(world.desk, way, lambda token: known, raising=False)
    leaves(world, "stop")
    assert console.asked == []
    known.callback(world.desk.tokens["ann"])
    assert console.asked == [("rover", "smoke")]
    console.go.callback(None)
    assert console.done == ["done"]


@pytest.mark.parametrize(("method", "part"), [("POST", "resume"), ("PUT", "control")])
def test_anything_else_is_given_up(world: World, console: Console, method: str, part: str) -> None:
    """Nothing moves again for who does not see it, and who has gone waits for control no more."""
    leaves(world, part, method)
    assert console.asked == [("rover", "smoke")]
    assert console.done == ["given up"]
