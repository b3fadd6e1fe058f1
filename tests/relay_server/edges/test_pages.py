"""The page's stream over a websocket: in memory where time matters, else on real sockets."""

from __future__ import annotations

import json
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest
import pytest_twisted
from twisted.internet import reactor
from twisted.internet.task import Clock
from twisted.internet.threads import deferToThread
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from relay_protocol import limits
from relay_server.auth.origins import Origins
from relay_server.common import close_codes
from relay_server.http import live_updates
from relay_server.http.update_sources import Sources
from relay_server.ws.updates import MESSAGE_BYTES, UpdatesFactory, UpdatesGate
from tests.relay_server.edges.http_client import MemoryDesk, World
from tests.relay_server.edges.websocket_client import Client

PATH = "/api/v1/robots/stream"
ORIGIN = "http://relay:9090"
TOKEN = {"Authorization": "Bearer ann"}
ROBOTS = {"event": "robots", "data": {"robots": [{"name": "rover", "seen by": "ann"}]}}


class Tab:
    """One page's websocket on a transport in memory, and the relay's end of it."""

    def __init__(self, **headers: str) -> None:
        self.clock = Clock()
        self.desk = MemoryDesk()
        sources = Sources(self.clock, {live_updates.FIRST: self.desk.robots}, self.desk.on_change)
        self.gate = UpdatesGate(self.clock, self.desk, Origins("http", [ORIGIN]), "sb", sources)
        self.client = Client(self.gate, PATH, clock=self.clock, factory=UpdatesFactory, **(headers or TOKEN))

    def passes(self, seconds: float) -> None:
        """Time, in which the client answers pings."""
        for _ in range(round(seconds * 16)):
            self.clock.advance(1 / 16)
            self.client.run()

    @property
    def told(self) -> list[Any]:
        """All events so far."""
        return [json.loads(each) for each in self.client.heard]

    def gone(self) -> bool:
        """Whether nothing is left of it in the relay, its place among the connections of its network neither."""
        self.clock.advance(10.0)
        self.client.run()
        left = (self.desk.listeners, self.gate._open, self.client.cap._counts)
        return not (any(left) or self.client.transport.connected)


# --- who comes in -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "headers", [TOKEN, {"subprotocol": "bearer.ann"}, {"Cookie": "sb=ann", "Origin": ORIGIN}]
)
def test_who_proves_himself_is_told(headers: dict[str, str]) -> None:
    """At once, what is his; a cookie counts with an Origin that is listed."""
    assert Tab(**headers).told == [ROBOTS]


def test_auth_may_be_the_first_message() -> None:
    """As everywhere."""
    tab = Tab(**{"X-Any": "thing"})
    tab.client.says('{"op":"auth","mac":"ann"}')
    assert tab.told == [ROBOTS]


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


def test_a_relay_that_is_going_down_tells_its_pages_and_lets_nobody_in() -> None:
    """They may come again in a moment."""
    tab = Tab()
    tab.gate.say_goodbye("the relay is going down")
    tab.client.run()
    assert tab.client.closed == close_codes.GOING_AWAY
    assert tab.gone()
    later = Client(tab.gate, PATH, clock=tab.clock, factory=UpdatesFactory, **TOKEN)
    assert later.status == 503


# --- while it is open -------------------------------------------------------------------------------------


def test_changes_are_told_and_so_is_what_is_not_known() -> None:
    """By the same rules as in server-sent events."""
    tab = Tab()
    tab.passes(1.0)
    tab.desk.changed()
    tab.client.run()
    assert tab.told == [ROBOTS]
    tab.passes(live_updates.QUIET_SECONDS)
    assert tab.told == [ROBOTS, ROBOTS]
    tab.desk.up = False
    tab.passes(live_updates.STREAM_SECONDS)
    assert tab.told[-1] == {"event": "unknown", "data": {"reason": "the database does not answer"}}


def test_it_ends_with_the_credentials() -> None:
    """As soon as the relay takes up that they have ended."""
    tab = Tab()
    tab.passes(1.0)
    del tab.desk.tokens["ann"]
    tab.desk.changed()
    tab.client.run()
    assert (tab.client.closed, tab.told) == (close_codes.UNAUTHENTICATED, [ROBOTS])
    assert tab.gone()


@pytest.mark.parametrize(
    ("size", "code"),
    [(1, close_codes.INVALID), (MESSAGE_BYTES + 1, close_codes.TOO_BIG), (0, close_codes.INVALID)],
)
def test_a_page_has_nothing_to_say(size: int, code: int) -> None:
    """What is larger than a few bytes is not read at all."""
    tab = Tab()
    tab.client.says("x" * size)
    assert tab.client.closed == code
    assert tab.gone()


@pytest.mark.parametrize("headers", [TOKEN, {"X-Any": "thing"}])
@pytest.mark.parametrize("fin", [True, False])
def test_text_that_is_not_utf8_closes_with_1007(headers: dict[str, str], fin: bool) -> None:
    """RFC 6455 section 8.1, before and after the proof."""
    tab = Tab(**headers)
    tab.client.core.send_text(b"\xff", fin)
    tab.client.run()
    assert tab.client.closed == close_codes.NOT_UTF8


def test_binary_messages_are_not_taken() -> None:
    """As everywhere."""
    tab = Tab()
    tab.client.core.send_binary(b"x")
    tab.client.run()
    assert tab.client.closed == close_codes.FORBIDDEN
    assert tab.gone()


def test_a_page_that_answers_pings_stays() -> None:
    """However long."""
    tab = Tab()
    tab.passes(limits.UNPROVEN_SECONDS * 3)
    assert tab.client.closed is None


def test_a_page_that_answers_no_ping_is_closed() -> None:
    """Its way may be lost, and nobody has said so."""
    tab = Tab()
    for _ in range(9):
        tab.clock.advance(1.0)
    tab.client.run()
    assert tab.client.closed == close_codes.TOO_SLOW
    assert tab.gone()


def test_a_page_that_takes_nothing_is_closed() -> None:
    """Nothing piles up for it meanwhile."""
    tab = Tab()
    tab.passes(1.0)
    before = len(tab.told)
    tab.client.end.pause()
    for _ in range(8):
        tab.desk.changed()
        tab.passes(0.5)
    assert (len(tab.told), tab.client.closed) == (before, None)
    tab.passes(live_updates.STALL_SECONDS)
    assert (len(tab.told), tab.client.closed) == (before, close_codes.TOO_SLOW)
    assert tab.gone()


def test_a_page_that_takes_again_stays() -> None:
    """It is told what is now."""
    tab = Tab()
    tab.passes(1.0)
    tab.client.end.pause()
    tab.passes(1.0)
    before = len(tab.told)
    tab.client.end.resume()
    tab.client.run()
    assert len(tab.told) == before + 1
    tab.passes(live_updates.STALL_SECONDS * 2)
    assert tab.client.closed is None


def test_a_page_that_leaves_leaves_nothing_behind() -> None:
    """Neither a listener nor a timer."""
    tab = Tab()
    tab.passes(1.0)
    tab.client.core.send_close()
    tab.client.run()
    assert tab.gone()
    for _ in range(100):
        tab.clock.advance(0.1)
    assert not tab.clock.getDelayedCalls()


def test_what_fails_in_the_relay_is_told_without_internals() -> None:
    """The page may try again later."""

    async def broken(principal: Any) -> list[dict[str, Any]]:
        raise RuntimeError("the secret of our insides")

    tab = Tab()
    tab.passes(1.0)
    (client,) = tab.gate._open
    client._telling._sources = Sources(tab.clock, {live_updates.FIRST: broken}, tab.desk.on_change)
    tab.desk.changed()
    tab.client.run()
    assert tab.client.closed == close_codes.INTERNAL
    assert tab.client.core.close_rcvd is not None
    assert "secret" not in tab.client.core.close_rcvd.reason
    assert tab.gone()


# --- on real sockets --------------------------------------------------------------------------------------


class House:
    """A site that listens."""

    def __init__(self, folder: Path) -> None:
        clock: Any = reactor
        self.world = World(folder, clock=clock)
        self.listening = clock.listenTCP(0, self.world.site, interface="127.0.0.1")
        self.port: int = self.listening.getHost().port

    async def follows(self, **options: Any) -> ClientConnection:
        """A websocket to the stream."""
        url = f"ws://127.0.0.1:{self.port}{PATH}"
        return await deferToThread(connect, url, close_timeout=2, **options)


@pytest_twisted.async_yield_fixture
async def house(tmp_path: Path) -> AsyncIterator[House]:
    """Its own relay is its own origin."""
    made = House(tmp_path)
    yield made
    made.world.pages.say_goodbye("the test is over")
    await made.listening.stopListening()


async def hears(page: ClientConnection) -> Any:
    """The next event."""
    return json.loads(await deferToThread(page.recv, 10))


@pytest_twisted.ensureDeferred
async def test_a_page_follows_at_the_address_of_the_stream(house: House) -> None:
    """With its cookie and the relay's own origin, for as long as its session counts."""
    origin: Any = f"http://127.0.0.1:{house.port}"
    page = await house.follows(additional_headers={"Cookie": "sb=ann"}, origin=origin)
    assert await hears(page) == ROBOTS
    del house.world.desk.tokens["ann"]
    house.world.desk.changed()
    with pytest.raises(ConnectionClosed) as closed:
        while True:
            await hears(page)
    assert closed.value.rcvd is not None
    assert closed.value.rcvd.code == close_codes.UNAUTHENTICATED
