"""``/api/v1/fleet`` on transports in memory."""

from __future__ import annotations

import json
from collections.abc import Awaitable, Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from twisted.internet.defer import CancelledError, Deferred
from twisted.logger import capturedLogs

from relay_db.queries import RobotRecord
from relay_protocol.errors import NotFound, Unavailable
from relay_server.access import Principal
from relay_server.common.freshness_tokens import (
    HEADER,
    FreshnessTokenExpired,
    FreshnessTokenRequired,
    FreshnessTokens,
)
from relay_server.fleet import http as module
from relay_server.fleet.order import Order
from relay_server.fleet.result import TaskOutcome, TaskResult
from relay_server.fleet.service import FleetPlan
from tests.relay_server.edges.http_client import HOST, Transport, World, parse

HERE = "/api/v1/fleet"
MOMENTS = FreshnessTokens(lambda: 1000)
ANN = {"Authorization": "Bearer ann"}
STOP = {"robots": ["*"], "do": "stop"}
SET = {"robots": ["*"], "do": "set", "name": "/driver:speed", "value": 1}


class Desk:
    """Means two robots, which are done when the test says so."""

    def __init__(self) -> None:
        self.orders: list[tuple[str, Order, str]] = []
        self.sent: list[int | None] = []
        self.busy = False
        self.ended: list[str] = []
        self.tells: Callable[[TaskResult], Awaitable[None]] | None = None
        self.over: Deferred[None] = Deferred()

    async def groups(self, asker: Principal) -> list[dict[str, Any]]:
        """One."""
        return [{"name": "cleaners", "robots": ["rover"], "of": asker.name}]

    async def plan(self, asker: Principal, order: Order, address: str, sent: int | None = None) -> FleetPlan:
        """Two robots, whatever is asked."""
        order.check()
        if order.robots == ["nobody"]:
            raise NotFound("the order means no robot that you have a right on")
        self.orders.append((asker.name, order, address))
        self.sent.append(sent)
        robots = {name: RobotRecord(1, name, "main", "") for name in ("rover", "tank")}
        return FleetPlan(order, asker, address, robots, ["x"])

    async def carry_out(
        self, plan: FleetPlan, begin: Callable[[], None], tell: Callable[[TaskResult], Awaitable[None]]
    ) -> None:
        """Until the test says that it is over."""
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
        """One robot is done."""
        assert self.tells is not None

        async def told() -> None:
            assert self.tells is not None
            await self.tells(TaskResult(robot, TaskOutcome(*outcome), 0.25))

        return Deferred.fromCoroutine(told())


@pytest.fixture
def desk() -> Desk:
    """Who is asked."""
    return Desk()


@pytest.fixture
def world(tmp_path: Path, desk: Desk) -> World:
    """A site that takes orders."""
    made = World(tmp_path)
    made.beside["fleet"] = partial(module.beside, made.clock, desk, MOMENTS)
    return made


def ordered(world: World, order: dict[str, Any] = STOP) -> Transport:
    """Somebody gives an order to all robots: to stop, where nothing else is said."""
    transport = world.connect()
    body = json.dumps(order)
    head = f"POST {HERE} HTTP/1.1\r\nHost: {HOST}\r\nConnection: close\r\nAuthorization: Bearer ann\r\n"
    head += f"Content-Type: application/json\r\nContent-Length: {len(body)}\r\n\r\n"
    world.send(transport, (head + body).encode())
    return transport


def test_an_order_is_answered_line_by_line(world: World, desk: Desk) -> None:
    """The robots that are meant at once, each as it is done, and the sum."""
    transport = ordered(world)
    assert b'"robots":["rover","tank"]' in transport.value()
    assert desk.orders[0][0::2] == ("ann", "192.0.2.9")
    desk.tell("tank", True, "", {"success": True})
    assert b'"tank","ok":true' in transport.value()
    desk.tell("rover", False, "it is offline")
    world.clock.advance(2)
    desk.over.callback(None)
    answer = parse(transport.value())
    assert (answer.status, answer.headers["content-type"]) == (200, "application/x-ndjson")
    nothing = {"message": "", "values": None, "pending": False, "seconds": 0.25}
    assert [json.loads(line) for line in answer.body.splitlines()] == [
        {"do": "stop", "robots": ["rover", "tank"], "unmatched": ["x"]},
        {"robot": "tank", "ok": True, **nothing, "values": {"success": True}},
        {"robot": "rover", "ok": False, **nothing, "message": "it is offline"},
        {"done": True, "robots": 2, "ok": 1, "failed": 1, "seconds": 2.0},
    ]


def test_an_order_that_can_not_be_begun_is_told_by_its_status(world: World, desk: Desk) -> None:
    """In words, before any line."""
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
    desk.busy = True
    assert world.ask("POST", HERE, STOP, **ANN).status == 503
    assert world.ask("POST", HERE, STOP).status == 401
    assert world.ask("POST", HERE, STOP, Cookie="sb=ann").status == 403
    assert world.ask("GET", HERE, **ANN).status == 405
    assert world.ask("GET", f"{HERE}/other", **ANN).status == 404


def test_a_stop_is_begun_whatever_else_it_says(world: World, desk: Desk) -> None:
    """A field of a later release, or a typing error, keeps no robot moving."""
    ordered(world, {**STOP, "new": 1, "service": "/start", "timeout": None, "why": "fire"})
    order = desk.orders[0][1]
    assert (order.do, order.robots, order.why) == ("stop", STOP["robots"], "fire")


def test_who_hangs_up_ends_the_order(world: World, desk: Desk) -> None:
    """What has not begun is not done."""
    ordered(world, SET).loseConnection()
    assert desk.ended == ["given up"]


def test_a_stop_goes_on_whoever_hangs_up(world: World, desk: Desk) -> None:
    """Its results are told to nobody then, and wait for nobody, though the client took none of them before."""
    transport = ordered(world)
    transport.producer.pauseProducing()
    told = desk.tell("rover", True)
    assert not told.called
    transport.loseConnection()
    assert told.called and desk.ended == []
    assert desk.tell("tank", True).called
    desk.over.callback(None)
    assert desk.ended == ["done"]
    assert not [each for each in world.clock.getDelayedCalls() if each.active()]


def test_a_stop_begins_though_its_client_has_left(
    world: World, desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whoever leaves while the relay still finds out who he is has them stopped all the same."""
    known: Deferred[Principal] = Deferred()
    for way in ("token", "urgent_token"):
        monkeypatch.setattr(world.desk, way, lambda token: known, raising=False)
    ordered(world).loseConnection()
    assert desk.tells is None
    known.callback(world.desk.tokens["ann"])
    assert desk.orders[0][1].do == "stop"
    assert desk.tell("rover", True).called
    desk.over.callback(None)
    assert desk.ended == ["done"]


def test_a_stop_that_fails_unheard_is_logged(world: World, desk: Desk) -> None:
    """Who operates the relay learns that it went wrong."""
    ordered(world).loseConnection()
    with capturedLogs() as logs:
        desk.over.errback(ZeroDivisionError())
    assert [each["log_failure"].type for each in logs if "log_failure" in each] == [ZeroDivisionError]


def test_who_takes_nothing_holds_the_order_up_and_is_cut(world: World, desk: Desk) -> None:
    """Results wait where they come from, not in the relay's memory."""
    transport = ordered(world, SET)
    transport.producer.pauseProducing()
    took: list[str] = []
    desk.tell("rover", True).addCallback(lambda _: took.append("rover"))
    desk.tell("tank", True).addCallback(lambda _: took.append("tank"))
    assert not took
    transport.producer.resumeProducing()
    assert took == ["rover", "tank"]
    transport.producer.pauseProducing()
    desk.tell("rover", True).addErrback(lambda _: None)
    world.clock.advance(module.STALL_SECONDS)
    assert not transport.connected
    assert desk.ended == ["given up"]
    assert not [each for each in world.clock.getDelayedCalls() if each.active()]


def test_groups_are_told(world: World) -> None:
    """To who asks by a credential."""
    answer = world.ask("GET", f"{HERE}/groups", **ANN)
    assert answer.json == {"groups": [{"name": "cleaners", "robots": ["rover"], "of": "ann"}]}
    assert world.ask("GET", f"{HERE}/groups").status == 401


def test_without_orders_there_is_nothing_there(world: World) -> None:
    """As at any other address."""
    del world.beside["fleet"]
    assert world.ask("POST", HERE, STOP, **ANN).status == 404


def test_an_order_is_dated_by_the_moment_it_gives_back(world: World, desk: Desk) -> None:
    """Every answer has one, also while it still goes on; a stop needs none, and is not held up by what is none."""
    groups = world.ask("GET", f"{HERE}/groups", **ANN)
    assert groups.headers[HEADER] == MOMENTS.now()
    desk.over.callback(None)
    answer = world.ask("POST", HERE, SET, **ANN, **{HEADER: groups.headers[HEADER]})
    assert (answer.status, answer.headers[HEADER]) == (200, MOMENTS.now())
    for order, moment, status in ((SET, "", 200), (SET, "ff.0", 428), (STOP, "ff.0", 200)):
        dated = {HEADER: moment} if moment else {}
        answer = world.ask("POST", HERE, order, **ANN, **dated)
        assert (answer.status, answer.headers[HEADER]) == (status, MOMENTS.now())
    assert desk.sent == [1000, None, None]


@pytest.mark.parametrize(
    ("error", "status"), [(FreshnessTokenRequired("say when"), 428), (FreshnessTokenExpired("too old"), 412)]
)
def test_an_order_that_may_be_old_is_not_begun(
    world: World, desk: Desk, monkeypatch: pytest.MonkeyPatch, error: Exception, status: int
) -> None:
    """The answer says so by its status."""

    async def plan(*_: object) -> FleetPlan:
        raise error

    monkeypatch.setattr(desk, "plan", plan)
    answer = world.ask("POST", HERE, SET, **ANN)
    assert (answer.status, answer.json["detail"]) == (status, str(error))
    assert answer.headers[HEADER] == MOMENTS.now()
