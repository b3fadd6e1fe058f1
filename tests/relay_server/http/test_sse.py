"""Live updates as server-sent events, on transports in memory."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from relay_server.access import Principal
from relay_server.http import live_updates
from relay_server.http.live_updates import COALESCE_SECONDS
from tests.worlds.http_client import ROOT, World, parse


@pytest.fixture
def world(tmp_path: Path) -> World:
    """A site with an empty portal."""
    return World(tmp_path)


def streaming(world: World) -> Any:
    """A client that follows the robots."""
    transport = world.connect()
    world.send(
        transport, b"GET /api/v1/robots/stream HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer ann\r\n\r\n"
    )
    assert parse(transport.value()).headers["content-type"] == "text/event-stream"
    return transport


def events(transport: Any) -> list[str]:
    """Names of the events that came since the last time."""
    lines = transport.value().decode().splitlines()
    transport.clear()
    return [line.removeprefix("event: ") for line in lines if line.startswith("event: ")]


def test_sources_are_events(world: World) -> None:

    async def alerts(principal: Principal) -> list[dict[str, Any]]:
        assert principal.name == "ann"
        return [{"id": "a1"}]

    world.events["alerts"] = alerts
    transport = streaming(world)
    assert b'event: robots\ndata: {"robots":[{"name":"rover","seen by":"ann"}]}\n\n' in transport.value()
    assert b'event: alerts\ndata: {"alerts":[{"id":"a1"}]}\n\n' in transport.value()


def test_changes_and_repetitions_are_sent(world: World) -> None:
    transport = streaming(world)
    events(transport)
    world.clock.advance(COALESCE_SECONDS)
    world.service.changed()
    assert events(transport) == []
    world.service.tokens["ann"] = ROOT
    world.clock.advance(COALESCE_SECONDS)
    world.service.changed()
    assert events(transport) == ["robots"]
    world.clock.pump([COALESCE_SECONDS, live_updates.QUIET_SECONDS])
    assert events(transport) == ["robots"]


def test_a_client_that_leaves_its_stream_leaves_nothing_behind(world: World) -> None:
    for seconds in (0.0, COALESCE_SECONDS):
        transport = streaming(world)
        world.clock.advance(seconds)
        transport.loseConnection()
        assert world.service.listeners == []
        world.clock.advance(0)
        assert not world.clock.getDelayedCalls()


def test_the_stream_ends_with_the_credentials(world: World) -> None:
    """The client gets the event ``ended``, so that it does not reconnect."""
    transport = streaming(world)
    del world.service.tokens["ann"]
    events(transport)
    world.clock.pump([COALESCE_SECONDS, live_updates.QUIET_SECONDS])
    assert events(transport) == ["ended"]
    assert world.service.listeners == []


def test_a_database_that_is_away_does_not_end_the_stream(world: World) -> None:
    """The stream sends ``unknown`` meanwhile, and the robots when they are known again."""
    transport = streaming(world)
    events(transport)
    world.service.up = False
    world.clock.pump([COALESCE_SECONDS, live_updates.QUIET_SECONDS])
    assert b'event: unknown\ndata: {"reason":"the database does not answer"}\n\n' in transport.value()
    transport.clear()
    world.service.up = True
    world.clock.pump([COALESCE_SECONDS, live_updates.QUIET_SECONDS])
    assert events(transport) == ["robots"]


def test_a_client_that_accepts_no_bytes_is_cut(world: World) -> None:
    transport = streaming(world)
    events(transport)
    transport.producer.pauseProducing()
    for _ in range(3):
        world.clock.advance(COALESCE_SECONDS)
        world.service.changed()
    assert transport.value() == b""
    assert transport.connected
    world.clock.advance(live_updates.STALL_SECONDS)
    assert not transport.connected
    assert world.service.listeners == []
