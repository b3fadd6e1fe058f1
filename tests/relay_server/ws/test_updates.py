"""Live updates over a websocket: in memory, and on real sockets."""

from __future__ import annotations

import json
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import pytest
import pytest_twisted
from twisted.internet import reactor
from twisted.internet.defer import Deferred
from twisted.internet.task import Clock
from twisted.internet.threads import deferToThread
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from relay_protocol import limits
from relay_protocol.errors import NotFound
from relay_server.access import Principal
from relay_server.auth.origins import Origins
from relay_server.common import close_codes
from relay_server.http import live_updates
from relay_server.http.live_updates import Sources
from relay_server.ws.updates import MESSAGE_BYTES, STOPS, UpdatesAuth, UpdatesFactory
from tests.worlds.http_client import MemoryAuth, World
from tests.worlds.websocket_client import Client

PATH = "/api/v1/robots/stream"
ORIGIN = "http://relay:9090"
TOKEN = {"Authorization": "Bearer ann"}
ROBOTS = {"event": "robots", "data": {"robots": [{"name": "rover", "seen by": "ann"}]}}


class Stops:
    """Takes orders to stop; the payload ``{}`` has no robots."""

    def __init__(self) -> None:
        self.orders: list[tuple[str, bytes, str]] = []
        self.sends: list[Callable[[bytes], None]] = []
        self.waiting: list[Deferred[None]] = []

    async def carry_out(
        self, principal: Principal, payload: bytes, address: str, send: Callable[[bytes], None]
    ) -> None:
        if payload == b"{}":
            raise NotFound("the order matches no robot")
        self.orders.append((principal.name, payload, address))
        self.sends.append(send)
        wake: Deferred[None] = Deferred()
        self.waiting.append(wake)
        await wake


class Tab:
    """The websocket of one page on a transport in memory, with the relay's end."""

    def __init__(self, **headers: str) -> None:
        self.clock = Clock()
        self.service = MemoryAuth()
        sources = Sources(self.clock, {live_updates.FIRST: self.service.robots}, self.service.on_change)
        self.stops = Stops()
        self.gate = UpdatesAuth(
            self.clock,
            self.service,
            self.service.timing,
            Origins("http", [ORIGIN]),
            "sb",
            sources,
            self.stops,
        )
        self.client = Client(self.gate, PATH, clock=self.clock, factory=UpdatesFactory, **(headers or TOKEN))

    def passes(self, seconds: float) -> None:
        """Advances the clock while the client answers pings."""
        for _ in range(round(seconds * 16)):
            self.clock.advance(1 / 16)
            self.client.run()

    @property
    def events(self) -> list[Any]:
        """All events so far."""
        return [json.loads(each) for each in self.client.heard]

    def gone(self) -> bool:
        """Whether the relay has no state of it, including its place among the connections of its network."""
        self.clock.advance(10.0)
        self.client.run()
        left = (self.service.listeners, self.gate._open, self.client.cap._counts)
        return not (any(left) or self.client.transport.connected)


# --- authentication ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "headers", [TOKEN, {"subprotocol": "bearer.ann"}, {"Cookie": "sb=ann", "Origin": ORIGIN}]
)
def test_an_authenticated_page_gets_its_robots_at_once(headers: dict[str, str]) -> None:
    """A cookie needs a listed Origin."""
    assert Tab(**headers).events == [ROBOTS]


def test_auth_may_be_the_first_message() -> None:
    tab = Tab(**{"X-Any": "thing"})
    tab.client.says('{"op":"auth","mac":"ann"}')
    assert tab.events == [ROBOTS]


@pytest.mark.parametrize(
    ("path", "headers", "status", "code"),
    [
        (PATH, {"Authorization": "Bearer bad"}, 401, close_codes.UNAUTHENTICATED),
        (PATH, {"Cookie": "sb=ann"}, 403, close_codes.FORBIDDEN),
        (PATH + "?ticket=good", {}, 401, close_codes.UNAUTHENTICATED),
    ],
)
def test_a_refused_program_reads_a_status_and_a_browser_a_close_code(
    path: str, headers: dict[str, str], status: int, code: int
) -> None:
    """A cookie counts only with an Origin that is listed; a ticket opens one robot and nothing else."""
    gate = Tab().gate
    given: dict[str, Any] = {"clock": gate.clock, "factory": UpdatesFactory, **headers}
    assert Client(gate, path, **given).status == status
    browser = Client(gate, path, Origin="http://evil.example", **given)
    assert (browser.status, browser.closed) == (101, code)
    assert not browser.heard


def test_a_relay_that_shuts_down_closes_its_pages_and_refuses_others() -> None:
    tab = Tab()
    tab.gate.shutdown("the relay is going down")
    tab.client.run()
    assert tab.client.closed == close_codes.GOING_AWAY
    assert tab.gone()
    later = Client(tab.gate, PATH, clock=tab.clock, factory=UpdatesFactory, **TOKEN)
    assert later.status == 503


# --- while it is open -------------------------------------------------------------------------------------


def test_changes_and_unknown_states_are_sent() -> None:
    """By the same rules as server-sent events."""
    tab = Tab()
    tab.passes(1.0)
    tab.service.changed()
    tab.client.run()
    assert tab.events == [ROBOTS]
    tab.passes(live_updates.QUIET_SECONDS)
    assert tab.events == [ROBOTS, ROBOTS]
    tab.service.up = False
    tab.passes(live_updates.STREAM_SECONDS)
    assert tab.events[-1] == {"event": "unknown", "data": {"reason": "the database does not answer"}}


def test_it_ends_with_the_credentials() -> None:
    tab = Tab()
    tab.passes(1.0)
    del tab.service.tokens["ann"]
    tab.service.changed()
    tab.client.run()
    assert (tab.client.closed, tab.events) == (close_codes.UNAUTHENTICATED, [ROBOTS])
    assert tab.gone()


def test_a_message_is_an_order_to_stop_and_its_lines_are_events() -> None:
    tab = Tab()
    tab.client.says('{"robots":["*"],"do":"stop"}')
    [(user, payload, address)] = tab.stops.orders
    assert (user, json.loads(payload)["do"]) == ("ann", "stop")
    assert address
    tab.stops.sends[0](b'{"robot":"rover","ok":true}')
    tab.client.run()
    assert tab.events[1:] == [{"event": "order", "data": {"robot": "rover", "ok": True}}]


def test_a_stop_continues_when_its_page_is_gone() -> None:
    tab = Tab()
    tab.client.says("stop")
    tab.client.transport.loseConnection()
    assert tab.gone()
    [wake] = tab.stops.waiting
    tab.stops.sends[0](b"{}")
    wake.callback(None)


def test_a_stop_that_can_not_begin_closes_with_its_reason() -> None:
    tab = Tab()
    tab.client.says("{}")
    assert tab.client.closed == close_codes.NOT_FOUND
    assert tab.gone()


def test_a_page_has_few_stops_at_a_time() -> None:
    tab = Tab()
    for _ in range(STOPS):
        tab.client.says("stop")
    tab.stops.waiting.pop(0).callback(None)
    tab.client.says("stop")
    assert tab.client.closed is None
    tab.client.says("stop")
    assert tab.client.closed == close_codes.TOO_MANY_ERRORS
    assert len(tab.stops.orders) == STOPS + 1


def test_a_message_that_is_too_large_is_not_read() -> None:
    tab = Tab()
    tab.client.says("x" * (MESSAGE_BYTES + 1))
    assert tab.client.closed == close_codes.TOO_BIG
    assert not tab.stops.orders
    assert tab.gone()


@pytest.mark.parametrize("headers", [TOKEN, {"X-Any": "thing"}])
@pytest.mark.parametrize("fin", [True, False])
def test_text_that_is_not_utf8_closes_with_1007(headers: dict[str, str], fin: bool) -> None:
    """RFC 6455 section 8.1, before and after authentication."""
    tab = Tab(**headers)
    tab.client.core.send_text(b"\xff", fin)
    tab.client.run()
    assert tab.client.closed == close_codes.NOT_UTF8


def test_a_binary_message_closes_the_websocket() -> None:
    tab = Tab()
    tab.client.core.send_binary(b"x")
    tab.client.run()
    assert tab.client.closed == close_codes.FORBIDDEN
    assert tab.gone()


def test_a_page_that_answers_pings_stays() -> None:
    tab = Tab()
    tab.passes(limits.UNAUTHENTICATED_SECONDS * 3)
    assert tab.client.closed is None


def test_a_page_that_answers_no_ping_is_closed() -> None:
    tab = Tab()
    for _ in range(9):
        tab.clock.advance(1.0)
    tab.client.run()
    assert tab.client.closed == close_codes.TOO_SLOW
    assert tab.gone()


def test_a_page_that_accepts_nothing_is_closed() -> None:
    tab = Tab()
    tab.passes(1.0)
    before = len(tab.events)
    tab.client.end.pause()
    for _ in range(8):
        tab.service.changed()
        tab.passes(0.5)
    assert (len(tab.events), tab.client.closed) == (before, None)
    tab.passes(live_updates.STALL_SECONDS)
    assert (len(tab.events), tab.client.closed) == (before, close_codes.TOO_SLOW)
    assert tab.gone()


def test_a_page_that_accepts_bytes_again_stays() -> None:
    """It gets the present state."""
    tab = Tab()
    tab.passes(1.0)
    tab.client.end.pause()
    tab.passes(1.0)
    before = len(tab.events)
    tab.client.end.resume()
    tab.client.run()
    assert len(tab.events) == before + 1
    tab.passes(live_updates.STALL_SECONDS * 2)
    assert tab.client.closed is None


def test_a_page_that_leaves_leaves_nothing_behind() -> None:
    tab = Tab()
    tab.passes(1.0)
    tab.client.core.send_close()
    tab.client.run()
    assert tab.gone()
    for _ in range(100):
        tab.clock.advance(0.1)
    assert not tab.clock.getDelayedCalls()


def test_an_error_of_the_relay_closes_without_details() -> None:

    async def broken(principal: Any) -> list[dict[str, Any]]:
        raise RuntimeError("the secret of our insides")

    tab = Tab()
    tab.passes(1.0)
    (client,) = tab.gate._open
    client._updates._sources = Sources(tab.clock, {live_updates.FIRST: broken}, tab.service.on_change)
    tab.service.changed()
    tab.client.run()
    assert tab.client.closed == close_codes.INTERNAL
    assert tab.client.core.close_rcvd is not None
    assert "secret" not in tab.client.core.close_rcvd.reason
    assert tab.gone()


# --- on real sockets --------------------------------------------------------------------------------------


class ListeningSite:
    """A site that listens."""

    def __init__(self, folder: Path) -> None:
        clock: Any = reactor
        self.world = World(folder, clock=clock)
        self.listening = clock.listenTCP(0, self.world.site, interface="127.0.0.1")
        self.port: int = self.listening.getHost().port

    async def follows(self, **options: Any) -> ClientConnection:
        """Opens a websocket to the stream."""
        url = f"ws://127.0.0.1:{self.port}{PATH}"
        return await deferToThread(connect, url, close_timeout=2, **options)


@pytest_twisted.async_yield_fixture
async def served(tmp_path: Path) -> AsyncIterator[ListeningSite]:
    """Its own address is an allowed origin."""
    made = ListeningSite(tmp_path)
    yield made
    made.world.pages.shutdown("the test is over")
    await made.listening.stopListening()


async def next_event(page: ClientConnection) -> Any:
    """The next event."""
    return json.loads(await deferToThread(page.recv, 10))


@pytest_twisted.ensureDeferred
async def test_a_page_follows_at_the_address_of_the_stream(served: ListeningSite) -> None:
    """With its cookie and the relay's own origin, until its session ends."""
    origin: Any = f"http://127.0.0.1:{served.port}"
    page = await served.follows(additional_headers={"Cookie": "sb=ann"}, origin=origin)
    assert await next_event(page) == ROBOTS
    del served.world.service.tokens["ann"]
    served.world.service.changed()
    with pytest.raises(ConnectionClosed) as closed:
        while True:
            await next_event(page)
    assert closed.value.rcvd is not None
    assert closed.value.rcvd.code == close_codes.UNAUTHENTICATED
