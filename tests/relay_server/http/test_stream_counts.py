"""The count of open streams stays right, whenever their clients leave."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from twisted.internet.defer import Deferred
from twisted.internet.task import Clock

from relay_protocol.errors import NotFound, Unavailable
from relay_server.access import BadCredentials, Principal
from relay_server.http.limits import RequestLimits
from relay_server.ws.updates import UpdatesFactory
from tests.worlds.http_client import ANN, World
from tests.worlds.websocket_client import AUTH, Client, MemoryGate, MemorySession

PATH = "/api/v1/robots/stream"
BEARER = {"Authorization": "Bearer good"}


class SlowGate(MemoryGate):
    """Looks up a token, and then a right, as long as the test says."""

    def __init__(self) -> None:
        super().__init__()
        self.steps: list[Deferred[None]] = []
        self.error: Exception | None = None

    async def _step(self) -> None:
        self.steps.append(Deferred())
        await self.steps[-1]
        if self.error is not None:
            raise self.error

    async def bearer(self, token: str) -> Principal:
        await self._step()
        return ANN

    async def admit(self, principal: Principal, robot: str, address: str) -> Any:
        await self._step()
        self.admitted += 1
        return principal

    def goes_on(self) -> None:
        """Completes the pending look-ups."""
        for each in list(self.steps):
            if not each.called:
                each.callback(None)


class Lab:
    """Websockets of pages, with few streams for a user."""

    def __init__(self, streams: int = 0, rate: float = 0.0) -> None:
        self.clock = Clock()
        self.gate = SlowGate()
        self.limits = RequestLimits(rate, self.clock.seconds, streams)

    def comes(self, by_message: bool) -> Client:
        """A page that proves itself by a message, or in the handshake."""
        given: dict[str, Any] = {"clock": self.clock, "factory": UpdatesFactory}
        headers = {} if by_message else BEARER
        client = Client(self.gate, PATH, request_limits=self.limits, **given, **headers)
        if by_message:
            client.says(AUTH)
        return client


@pytest.mark.parametrize("by_message", [True, False])
@pytest.mark.parametrize("steps", [0, 1, 2])
def test_a_page_that_leaves_during_its_look_up_takes_no_place(by_message: bool, steps: int) -> None:
    """Leaving at any step, any number of times, leaves room for the next page."""
    lab = Lab(streams=1)
    for _ in range(3):
        client = lab.comes(by_message)
        for _ in range(steps):
            lab.gate.goes_on()
        client.transport.abortConnection()
        for _ in range(3):
            lab.gate.goes_on()
        assert not lab.limits._streams
    assert lab.gate.admitted == 0
    last = lab.comes(by_message)
    for _ in range(2):
        lab.gate.goes_on()
    last.run()
    assert len(lab.gate.sessions) == (4 if steps == 2 else 1)
    assert dict(lab.limits._streams) == {ANN.user_id: 1}


EVENTS = st.sampled_from(["bearer", "auth", "found", "found", "unknown", "down", "none", "drop", "seconds"])


@settings(deadline=None)
@given(st.lists(st.tuples(EVENTS, st.integers(0, 7)), max_size=40))
def test_the_count_equals_the_number_of_open_streams(events: list[tuple[str, int]]) -> None:
    lab = Lab(streams=3)
    clients: list[Client] = []
    errors = {"unknown": BadCredentials("unknown"), "down": Unavailable("down"), "none": NotFound("none")}
    for event, number in events:
        if event in ("bearer", "auth"):
            clients.append(lab.comes(event == "auth"))
        elif event == "drop" and clients:
            clients.pop(number % len(clients)).transport.abortConnection()
        elif event == "seconds":
            lab.clock.advance(number)
        else:
            lab.gate.error = errors.get(event)
            lab.gate.goes_on()
            lab.gate.error = None
        for each in clients:
            each.run()
        connected = sum(each.transport.connected for each in clients)
        assert lab.limits._streams.get(ANN.user_id, 0) <= connected
    for each in clients:
        each.transport.abortConnection()
    for _ in range(3):
        lab.gate.goes_on()
    assert not lab.limits._streams
    assert lab.gate.admitted == 0
    assert lab.limits.stream(ANN.user_id)


@pytest.mark.parametrize("cancels", [True, False])
def test_an_answer_whose_client_left_while_it_was_looked_up_takes_no_place(
    tmp_path: Path, cancels: bool
) -> None:
    """Even if the result arrives after the client has left."""
    world = World(tmp_path, streams=1)
    looked_up: list[Deferred[None]] = []

    async def token(token: str) -> Principal:
        # One that cannot be cancelled is found in the moment in which the client leaves.
        looked_up.append(Deferred() if cancels else Deferred(lambda found: found.callback(None)))
        await looked_up[-1]
        return dataclasses.replace(ANN)

    world.service.token = token  # type: ignore[method-assign]
    for _ in range(3):
        transport = world.connect()
        world.send(
            transport, b"GET /api/v1/robots/stream HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer ann\r\n\r\n"
        )
        transport.loseConnection()
        assert len(looked_up) > 0
        assert not world.site.limits._streams
    assert not world.clock.getDelayedCalls()


def test_a_flood_of_handshakes_is_refused_before_its_credentials_are_looked_up() -> None:
    """Pending handshakes count too. A known user counts separately."""
    clock = Clock()
    gate = MemoryGate()
    limits = RequestLimits(1.0, clock.seconds)

    def comes(token: str) -> Client:
        return Client(gate, clock=clock, request_limits=limits, Authorization=f"Bearer {token}")

    gate.wait = Deferred()
    waiting = [comes("wrong") for _ in range(10)]
    assert len(gate.asked) == 10
    for _ in range(5):
        assert comes("wrong").status == 429
    assert len(gate.asked) == 10
    gate.wait.callback(None)
    gate.wait = None
    for each in waiting:
        each.run()
        assert each.status == 401
    clock.advance(10)
    for _ in range(10):
        assert comes("good").status == 101
    assert comes("good").status == 429
    assert comes("wrong").status == 401
    assert isinstance(gate.sessions[0], MemorySession)
