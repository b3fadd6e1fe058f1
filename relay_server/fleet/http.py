"""``/api/v1/fleet``: an order to many robots, answered line by line; also for the relay's local socket."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import msgspec
from twisted.internet.defer import Deferred
from twisted.web.server import Request

from relay_protocol import jsontext, nonfinite
from relay_protocol.errors import SwitchboardError
from relay_protocol.realms import DEFAULT_REALM
from relay_server.common.clock import Clock, cancel
from relay_server.common.data_dir import SENT_HEADER, parse_sent
from relay_server.common.freshness_tokens import HEADER, FreshnessTokens
from relay_server.fleet.order import (
    FleetOrderEnd,
    FleetOrderStart,
    FleetRobotResult,
    FleetStopOrder,
    Order,
    RobotGroupList,
    TaskResult,
)
from relay_server.fleet.service import FleetPlan, FleetService, local_principal
from relay_server.http.endpoint import ApiRequest, Freshness, Streamed, endpoint
from relay_server.http.media_types import MediaType
from relay_server.http.openapi.operation import header
from relay_server.http.router import decode_body, refuse_key

BASE_PATH = "/api/v1/fleet"
LINES = MediaType("application/x-ndjson")
FleetLine = FleetOrderStart | FleetRobotResult | FleetOrderEnd

STALL_SECONDS = 30.0
"""Seconds without any byte accepted after which a client is cut. That ends its order, unless it is a stop."""

_ORDER = msgspec.json.Decoder(Order)
_STOP = msgspec.json.Decoder(FleetStopOrder)


def is_stop(content: bytes) -> bool:
    """Whether a body is an order to stop, which continues when the client disconnects."""
    try:
        body = jsontext.decode_any(nonfinite.mark_body(content))
    except SwitchboardError:
        return False
    return isinstance(body, dict) and body.get("do") == "stop"


def _is_stop(request: ApiRequest, names: Mapping[str, str]) -> bool:
    return is_stop(request.content())


class FleetEndpoints:
    """Orders to many robots."""

    def __init__(self, clock: Clock, service: FleetService, tokens: FreshnessTokens) -> None:
        self._clock = clock
        self._service = service
        self._tokens = tokens

    @endpoint(
        "POST",
        BASE_PATH,
        tag="fleet",
        summary="Give one order to many robots",
        more="The answer has one JSON object per line: first the selected robots, then the result of each robot, "
        "last one with `done`. A stop is never rate limited, and continues when the client disconnects.",
        returns="lines",
        forms=(LINES,),
        items=(FleetOrderStart, FleetRobotResult, FleetOrderEnd),
        raw_body=Order,
        parameters=(
            header(
                HEADER,
                "freshness token of the latest answer; needed by orders that move robots or resume them",
            ),
        ),
        freshness=Freshness.GIVEN,
        # Rights are judged again before the order goes to each robot.
        proved_from_memory=True,
        never_limited=_is_stop,
        shielded=is_stop,
        # Each robot has a time limit of its own.
        seconds=math.inf,
        errors=(404, 412, 428),
    )
    async def order(self, request: ApiRequest) -> Streamed:
        order = _order_of(request.http, request.content())
        earliest_sent = None
        if order.do != "stop":
            refuse_key(request)
            earliest_sent = self._tokens.read(request.http.getHeader(HEADER))
        principal, address = request.principal, request.address
        first = request.http.forwarded_client
        if first is not None and earliest_sent is not None:
            earliest_sent -= first.older_ns
        plan = await self._service.plan(principal, order, address, earliest_sent, forwarded=first is not None)

        async def run(http: Request) -> None:
            await _carry_out(self._clock, self._service, http, plan)

        return Streamed(LINES.media, run, counted=False)

    @endpoint(
        "GET",
        f"{BASE_PATH}/groups",
        tag="fleet",
        summary="Groups of robots",
        returns="groups",
        freshness=Freshness.GIVEN,
        seconds=math.inf,
    )
    async def groups(self, request: ApiRequest) -> RobotGroupList:
        return {"groups": await self._service.groups(request.principal)}


async def local(clock: Clock, service: FleetService, request: Request) -> Any:
    """Carry out the order of a client of the local socket, which has all rights on the robots of ``?realm=``.

    :raises SwitchboardError: the order cannot begin
    """
    realm = request.args.get(b"realm", [DEFAULT_REALM.encode()])[0].decode(errors="replace")
    order = _order_of(request, request.content.read())
    earliest_sent = parse_sent(request.getHeader(SENT_HEADER))
    plan = await service.plan(local_principal(realm), order, "local", earliest_sent)
    await _carry_out(clock, service, request, plan)


def _order_of(request: Request, content: bytes) -> Order:
    """The order in a body.

    :raises Invalid: the body is not declared as JSON
    :raises MalformedMessage: the body is not an order
    """
    content_type = request.getHeader("content-type")
    if is_stop(content):
        return decode_body(content_type, nonfinite.mark_body(content), _STOP).order
    return decode_body(content_type, content, _ORDER, ("args", "msg", "value"))


async def _carry_out(clock: Clock, service: FleetService, request: Request, plan: FleetPlan) -> None:
    """Carry out an order, and report each result as long as the client is connected."""
    lines = _Lines(clock, request, plan)
    try:
        await service.carry_out(plan, lines.begin, lines.report)
        lines.end()
    finally:
        lines.close()


class _Lines:
    """An answer in lines of JSON, written as fast as the client reads: Twisted's push producer."""

    def __init__(self, clock: Clock, request: Request, plan: FleetPlan) -> None:
        self._clock = clock
        self._request = request
        self._plan = plan
        self._began = clock.seconds()
        self._ok = self._failed = 0
        self._open = False
        self._paused = False
        self._waiting: list[Deferred[None]] = []

    async def report(self, result: TaskResult) -> None:
        """Write the result of a robot; returns when there is room for the next."""
        self._ok += result.outcome.ok
        self._failed += not result.outcome.ok
        self._line(result.line)
        while self._paused:
            await self._room()

    def end(self) -> None:
        """Write the last line."""
        self._line(
            FleetOrderEnd(
                done=True,
                robots=len(self._plan.robots),
                ok=self._ok,
                failed=self._failed,
                seconds=round(self._clock.seconds() - self._began, 3),
            )
        )

    def close(self) -> None:
        """Unregister from the request, after success or failure."""
        if self._open and not self._request._disconnected:
            self._request.unregisterProducer()
        self._open = False

    def begin(self) -> None:
        """Write the head of the answer and the first line. An order that cannot begin is answered by a status."""
        if self._request._disconnected:
            return
        self._open = True
        if self._plan.order.do == "stop":
            # A stop continues without its client, so it must not wait for lines to be read.
            self._request.notifyFinish().addErrback(lambda _: self.resumeProducing())
        self._request.setHeader(b"content-type", b"application/x-ndjson")
        self._request.setHeader(b"cache-control", b"no-store")
        self._request.setHeader(b"x-accel-buffering", b"no")
        self._request.registerProducer(self, True)
        self._line(self._plan.start)

    def _line(self, message: FleetLine) -> None:
        if not self._request._disconnected:
            self._request.write(jsontext.encode(message) + b"\n")

    # --- Twisted's push producer ---

    def pauseProducing(self) -> None:
        """The transport's buffer is full."""
        self._paused = True

    def resumeProducing(self) -> None:
        """The transport accepts bytes again."""
        self._paused = False
        waiting, self._waiting = self._waiting, []
        for each in waiting:
            each.callback(None)

    def stopProducing(self) -> None:
        """The client has disconnected; the request is notified too."""

    async def _room(self) -> None:
        wake: Deferred[None] = Deferred(self._waiting.remove)
        self._waiting.append(wake)
        timer = self._clock.callLater(STALL_SECONDS, self._cut)
        try:
            await wake
        finally:
            cancel(timer)

    def _cut(self) -> None:
        if not self._request._disconnected:
            self._request.transport.abortConnection()
