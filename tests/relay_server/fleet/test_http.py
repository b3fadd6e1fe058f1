"""``/api/v1/fleet`` on transports in memory."""

from __future__ import annotations

import json
import math
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any, cast

import msgspec
import pytest
from twisted.internet.defer import CancelledError, Deferred
from twisted.logger import capturedLogs

from relay_db.queries import RobotRecord
from relay_protocol.errors import NotFound, Unavailable
from relay_server.access import Principal
from relay_server.cluster.forwarding import ForwardedClient
from relay_server.common.freshness_tokens import (
    HEADER,
    FreshnessTokenExpired,
    FreshnessTokenRequired,
    FreshnessTokens,
)
from relay_server.fleet import http as module
from relay_server.fleet.order import Order, TaskOutcome, TaskResult
from relay_server.fleet.service import FleetPlan
from relay_server.http.site import BoundedRequest
from tests.worlds.http_client import HOST, Transport, World, parse

HERE = "/api/v1/fleet"
MOMENTS = FreshnessTokens(lambda: 1000)
ANN = {"Authorization": "Bearer ann"}
STOP = {"robots": ["*"], "do": "stop"}
SET = {"robots": ["*"], "do": "set", "name": "/driver:speed", "value": 1}


class FakeFleet:
    """Selects two robots, which are done when the test says so."""

    def __init__(self) -> None:
        self.orders: list[tuple[str, Order, str]] = []
        self.earliest_sent: list[int | None] = []
        self.busy = False
        self.ended: list[str] = []
        self.tells: Callable[[TaskResult], Awaitable[None]] | None = None
        self.over: Deferred[None] = Deferred()

    async def groups(self, asker: Principal) -> list[dict[str, Any]]:
        return [{"name": "cleaners", "robots": ["rover"], "of": asker.name}]

    async def plan(
        self,
        asker: Principal,
        order: Order,
        address: str,
        earliest_sent: int | None = None,
        *,
        forwarded: bool = False,
    ) -> FleetPlan:
        """Two robots for any request."""
        order.check()
        if order.robots == ["nobody"]:
            raise NotFound("the order matches no robot that you have a right on")
        self.orders.append((asker.name, order, address))
        self.earliest_sent.append(earliest_sent)
        robots = {name: RobotRecord(1, name, "main", "") for name in ("rover", "tank")}
        return FleetPlan(order, asker, address, robots, ["x"])

    async def carry_out(
        self, plan: FleetPlan, begin: Callable[[], None], tell: Callable[[TaskResult], Awaitable[None]]
    ) -> None:
        """Lasts until the test ends it."""
        if self.busy:
            raise Unavailable("too many orders")
        begin()
        self.tells = tell
        try:
            await self.over
        except CancelledError:
            self.ended.append("given up")
            raise
        self.ended.append("done")

    def tell(self, robot: str, *outcome: Any) -> Deferred[None]:
        """Reports that one robot is done."""
        assert self.tells is not None

        async def reported() -> None:
            assert self.tells is not None
            await self.tells(TaskResult(robot, TaskOutcome(*outcome), 0.25))

        return Deferred.fromCoroutine(reported())


@pytest.fixture
def fake() -> FakeFleet:
    """The fleet service of the world."""
    return FakeFleet()


@pytest.fixture
def world(tmp_path: Path, fake: FakeFleet) -> World:
    """A site with fleet orders."""
    made = World(tmp_path, tokens=MOMENTS)
    made.router.add(module.FleetEndpoints(made.clock, cast(Any, fake), MOMENTS))
    return made


def ordered(world: World, order: dict[str, Any] = STOP) -> Transport:
    """A client orders all robots; the default is a stop."""
    transport = world.connect()
    body = json.dumps(order)
    head = f"POST {HERE} HTTP/1.1\r\nHost: {HOST}\r\nConnection: close\r\nAuthorization: Bearer ann\r\n"
    head += f"Content-Type: application/json\r\nContent-Length: {len(body)}\r\n\r\n"
    world.send(transport, (head + body).encode())
    return transport


def test_an_order_is_answered_line_by_line(world: World, fake: FakeFleet) -> None:
    """The selected robots come first, then each result, then the summary."""
    transport = ordered(world)
    assert b'"robots":["rover","tank"]' in transport.value()
    assert fake.orders[0][0::2] == ("ann", "192.0.2.9")
    fake.tell("tank", True, "", {"success": True})
    assert b'"tank","ok":true' in transport.value()
    fake.tell("rover", False, "it is offline")
    world.clock.advance(2)
    fake.over.callback(None)
    answer = parse(transport.value())
    assert (answer.status, answer.headers["content-type"]) == (200, "application/x-ndjson")
    nothing = {"message": "", "values": None, "pending": False, "seconds": 0.25}
    assert [json.loads(line) for line in answer.body.splitlines()] == [
        {"do": "stop", "robots": ["rover", "tank"], "unmatched": ["x"]},
        {"robot": "tank", "ok": True, **nothing, "values": {"success": True}},
        {"robot": "rover", "ok": False, **nothing, "message": "it is offline"},
        {"done": True, "robots": 2, "ok": 1, "failed": 1, "seconds": 2.0},
    ]


def test_an_order_that_can_not_begin_has_an_error_status(world: World, fake: FakeFleet) -> None:
    """It has a reason and no lines."""
    cases: list[tuple[dict[str, Any], int]] = [
        ({**STOP, "robots": ["nobody"]}, 404),
        ({**STOP, "do": "dance"}, 400),
        ({**STOP, "robots": "*"}, 400),
        ({**SET, "service": "/start"}, 400),
        ({**SET, "new": 1}, 400),
    ]
    for body, status in cases:
        answer = world.ask("POST", HERE, body, **ANN)
        assert (answer.status, answer.headers["content-type"]) == (status, "application/problem+json")
    fake.busy = True
    assert world.ask("POST", HERE, STOP, **ANN).status == 503
    assert world.ask("POST", HERE, STOP).status == 401
    assert world.ask("POST", HERE, STOP, Cookie="sb=ann").status == 403
    assert world.ask("GET", HERE, **ANN).status == 405
    assert world.ask("GET", f"{HERE}/other", **ANN).status == 404


def test_a_stop_starts_despite_unknown_fields(world: World, fake: FakeFleet) -> None:
    """An unknown field, perhaps of a later release, must not prevent a stop."""
    ordered(world, {**STOP, "new": 1, "service": "/start", "timeout": None, "why": "fire"})
    order = fake.orders[0][1]
    assert (order.do, order.robots, order.why) == ("stop", STOP["robots"], "fire")


def test_a_stop_starts_despite_nan(world: World, fake: FakeFleet) -> None:
    """Python writes it."""
    ordered(world, {**STOP, "why": math.nan, "speed": -math.inf})
    order = fake.orders[0][1]
    assert (order.do, order.why) == ("stop", "")


def test_disconnect_ends_the_order(world: World, fake: FakeFleet) -> None:
    """Robots that wait for their turn get no order."""
    ordered(world, SET).loseConnection()
    assert fake.ended == ["given up"]


def test_a_stop_goes_on_when_its_client_disconnects(world: World, fake: FakeFleet) -> None:
    """Its results are discarded, and it does not wait for the client to read them."""
    transport = ordered(world)
    transport.producer.pauseProducing()
    reported = fake.tell("rover", True)
    assert not reported.called
    transport.loseConnection()
    assert reported.called and fake.ended == []
    assert fake.tell("tank", True).called
    fake.over.callback(None)
    assert fake.ended == ["done"]
    assert not [each for each in world.clock.getDelayedCalls() if each.active()]


def test_a_stop_begins_though_its_client_has_left(
    world: World, fake: FakeFleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The client may disconnect while its token is being looked up."""
    known: Deferred[Principal] = Deferred()
    for method in ("token", "token_from_memory"):
        monkeypatch.setattr(world.service, method, lambda token: known, raising=False)
    ordered(world).loseConnection()
    assert fake.tells is None
    known.callback(world.service.tokens["ann"])
    assert fake.orders[0][1].do == "stop"
    assert fake.tell("rover", True).called
    fake.over.callback(None)
    assert fake.ended == ["done"]


def test_a_stop_that_fails_unheard_is_logged(world: World, fake: FakeFleet) -> None:
    """The operator of the relay can find the failure."""
    ordered(world).loseConnection()
    with capturedLogs() as logs:
        fake.over.errback(ZeroDivisionError())
    assert [each["log_failure"].type for each in logs if "log_failure" in each] == [ZeroDivisionError]


def test_reader_that_stalls_is_cut(world: World, fake: FakeFleet) -> None:
    """Results are not buffered in the relay's memory."""
    transport = ordered(world, SET)
    transport.producer.pauseProducing()
    took: list[str] = []
    fake.tell("rover", True).addCallback(lambda _: took.append("rover"))
    fake.tell("tank", True).addCallback(lambda _: took.append("tank"))
    assert not took
    transport.producer.resumeProducing()
    assert took == ["rover", "tank"]
    transport.producer.pauseProducing()
    fake.tell("rover", True).addErrback(lambda _: None)
    world.clock.advance(module.STALL_SECONDS)
    assert not transport.connected
    assert fake.ended == ["given up"]
    assert not [each for each in world.clock.getDelayedCalls() if each.active()]


def test_groups_are_listed(world: World) -> None:
    """They need credentials."""
    answer = world.ask("GET", f"{HERE}/groups", **ANN)
    assert answer.json == {"groups": [{"name": "cleaners", "robots": ["rover"], "of": "ann"}]}
    assert world.ask("GET", f"{HERE}/groups").status == 401


def test_an_order_is_dated_by_the_moment_it_gives_back(world: World, fake: FakeFleet) -> None:
    """Every answer has a token, while the order runs too; a stop needs none, and an invalid one does not
    delay it.
    """
    groups = world.ask("GET", f"{HERE}/groups", **ANN)
    assert groups.headers[HEADER] == MOMENTS.now()
    fake.over.callback(None)
    answer = world.ask("POST", HERE, SET, **ANN, **{HEADER: groups.headers[HEADER]})
    assert (answer.status, answer.headers[HEADER]) == (200, MOMENTS.now())
    for order, moment, status in ((SET, "", 200), (SET, "ff.0", 428), (STOP, "ff.0", 200)):
        dated = {HEADER: moment} if moment else {}
        answer = world.ask("POST", HERE, order, **ANN, **dated)
        assert (answer.status, answer.headers[HEADER]) == (status, MOMENTS.now())
    assert fake.earliest_sent == [1000, None, None]


def test_an_order_of_another_relay_is_as_much_older_as_that_says(
    world: World, fake: FakeFleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The token was made for that relay, after the order was sent."""
    ann = Principal(1, "ann", "main", False, 2, None)
    client = msgspec.structs.replace(ForwardedClient.of(ann, "192.0.2.1"), older_ns=400)
    monkeypatch.setattr(BoundedRequest, "forwarded_client", client)
    fake.over.callback(None)
    world.ask("POST", HERE, SET, **ANN, **{HEADER: MOMENTS.now()})
    assert fake.earliest_sent == [600]


@pytest.mark.parametrize(
    ("error", "status"), [(FreshnessTokenRequired("say when"), 428), (FreshnessTokenExpired("too old"), 412)]
)
def test_an_order_that_may_be_old_is_not_begun(
    world: World, fake: FakeFleet, monkeypatch: pytest.MonkeyPatch, error: Exception, status: int
) -> None:
    """The status says so."""

    async def plan(*_: object, **__: object) -> FleetPlan:
        raise error

    monkeypatch.setattr(fake, "plan", plan)
    answer = world.ask("POST", HERE, SET, **ANN)
    assert (answer.status, answer.json["detail"]) == (status, str(error))
    assert answer.headers[HEADER] == MOMENTS.now()
