"""``/api/v1/fleet``: one order to many robots, answered line by line; and the same on the relay's local socket."""

from __future__ import annotations

import math
from collections.abc import Awaitable, Callable, Coroutine
from typing import Any, Protocol

from klein import Klein
from twisted.internet.defer import Deferred
from twisted.web.resource import IResource
from twisted.web.server import Request
from werkzeug.exceptions import HTTPException

from relay_protocol import jsontext
from relay_protocol.errors import SwitchboardError
from relay_protocol.realms import DEFAULT_REALM
from relay_server.access import Principal
from relay_server.common.clock import Clock, cancel
from relay_server.common.freshness_tokens import HEADER, FreshnessTokens
from relay_server.fleet.order import FleetStopOrder, Order
from relay_server.fleet.result import TaskResult
from relay_server.fleet.service import FleetPlan, local_of
from relay_server.http.api import STREAMED, Api, body_of
from relay_server.http.freshness_header import dated
from relay_server.http.idempotent_requests import see_no_key
from relay_server.http.openapi.operation import ApiOperation, Response, described, header
from relay_server.http.openapi.schemas import RobotGroupList
from relay_server.http.time_limit import allow

SENT_HEADER = "switchboard-sent"
"""Of requests on the local socket: when they were sent, nanoseconds of the machine's clock."""

_DIGITS = 20
_DATED = {HEADER: "when this was answered; what moves robots gives it back"}

STALL_SECONDS = 30.0
"""Who takes nothing of the answer for so long is cut, and the order with him."""


class FleetServicePort(Protocol):
    """What is asked; see :class:`relay_server.fleet.service.FleetService`."""

    async def groups(self, asker: Principal) -> list[dict[str, Any]]:
        """Groups of robots."""

    async def plan(self, asker: Principal, order: Order, address: str, sent: int | None = None) -> FleetPlan:
        """Which robots an order means."""

    async def carry_out(
        self,
        plan: FleetPlan,
        begin: Callable[[], None],
        tell: Callable[[TaskResult], Coroutine[Any, Any, None]],
    ) -> None:
        """Do it."""


class FleetResource:
    """Orders of users, for one request."""

    app = Klein()

    def __init__(self, clock: Clock, desk: FleetServicePort, moments: FreshnessTokens, api: Api) -> None:
        self._clock = clock
        self._desk = desk
        self._moments = moments
        self._api = api

    @app.route("/", methods=["POST"])
    @described(
        ApiOperation(
            method="POST",
            path="/api/v1/fleet",
            tag="fleet",
            summary="One order to many robots",
            more="The answer is an object a line: what is meant, what became of it on each robot, and a last one with "
            "`done`. A stop is never one order too many, and goes on when the client leaves.",
            parameters=(
                header(
                    HEADER, "that of the latest answer here, for what moves robots or lets them move again"
                ),
            ),
            body=Order,
            answers={200: Response("lines", media=("application/x-ndjson",), headers=_DATED)},
            errors=(404, 412, 428),
        )
    )
    def order(self, request: Request) -> Any:
        return self._answer(request, self._order(request), lasts=is_stop(request))

    async def _order(self, request: Request) -> Any:
        order = _order_of(request)
        if order.do != "stop":
            see_no_key(request)
        # Whatever is ordered: rights are judged anew when a robot has its turn.
        principal = await self._api.principal(request, urgent=True, passes=order.do == "stop")
        address = getattr(request.getClientAddress(), "host", "local")
        sent = None if order.do == "stop" else self._moments.read(request.getHeader(HEADER))
        # Before anything is sent on: the lines of the answer come with it.
        request.setHeader(HEADER, self._moments.now())
        return await _carry_out(self._clock, self._desk, request, order, principal, address, sent)

    @app.route("/groups", methods=["GET"])
    @described(
        ApiOperation(
            method="GET",
            path="/api/v1/fleet/groups",
            tag="fleet",
            summary="Groups of robots",
            answers={200: Response("groups", RobotGroupList, headers=_DATED)},
        )
    )
    def groups(self, request: Request) -> Any:
        return self._answer(request, self._groups(request))

    async def _groups(self, request: Request) -> Any:
        return {"groups": await self._desk.groups(await self._api.principal(request))}

    def _answer(self, request: Request, work: Awaitable[Any], *, lasts: bool = False) -> Any:
        # Each robot has a time of its own; what it does with it is in the answer.
        allow(request, math.inf)
        return self._api.answer(request, dated(request, self._moments, work), lasts=lasts)

    @app.handle_errors(HTTPException)
    def unrouted(self, request: Request, failure: Any) -> bytes:
        answer: bytes = self._api.unrouted(request, failure)
        return answer


def beside(clock: Clock, desk: FleetServicePort, moments: FreshnessTokens, api: Api) -> IResource:
    """What serves the addresses of orders to many robots."""
    resource: IResource = FleetResource(clock, desk, moments, api).app.resource()
    return resource


async def local(clock: Clock, desk: FleetServicePort, request: Request) -> Any:
    """The order of whoever may open the relay's local socket, who owns all robots; ``?realm=`` says which.

    :raises SwitchboardError: it can't be begun, in words
    """
    realm = request.args.get(b"realm", [DEFAULT_REALM.encode()])[0].decode(errors="replace")
    asker = local_of(realm)
    return await _carry_out(clock, desk, request, _order_of(request), asker, "local", sent_of(request))


def sent_of(request: Request) -> int | None:
    """When a request of the relay's own machine was sent, by the clock that both read, nanoseconds; ``None`` if it does
    not say. Nobody but the relay's own user comes here: he is believed.
    """
    said = request.getHeader(SENT_HEADER) or ""
    return int(said) if len(said) <= _DIGITS and said.isascii() and said.isdigit() else None


def _order_of(request: Request) -> Order:
    """The order that a request brings.

    :raises Invalid: its body is not said to be JSON
    :raises MalformedMessage: it is no order
    """
    return (
        body_of(request, FleetStopOrder).order
        if is_stop(request)
        else body_of(request, Order, ("args", "msg", "value"))
    )


def is_stop(request: Request) -> bool:
    """Whether a request brings an order to stop, which goes on when the client leaves; the body stays to be read."""
    try:
        said = jsontext.decode_any(request.content.read())
    except SwitchboardError:
        return False
    finally:
        request.content.seek(0)
    return isinstance(said, dict) and said.get("do") == "stop"


async def _carry_out(
    clock: Clock,
    desk: FleetServicePort,
    request: Request,
    order: Order,
    asker: Principal,
    address: str,
    sent: int | None,
) -> Any:
    """Carry out an order, and tell of it line by line as long as somebody listens.

    :param sent: as for :meth:`relay_server.fleet.service.FleetService.plan`
    """
    plan = await desk.plan(asker, order, address, sent)
    lines = _Lines(clock, request, plan)
    try:
        await desk.carry_out(plan, lines.begin, lines.tell)
        lines.end()
    finally:
        lines.close()
    return STREAMED


class _Lines:
    """An answer in lines of JSON, no faster than it is taken: Twisted's push producer."""

    def __init__(self, clock: Clock, request: Request, plan: FleetPlan) -> None:
        self._clock = clock
        self._request = request
        self._plan = plan
        self._began = clock.seconds()
        self._ok = self._failed = 0
        self._open = False
        self._paused = False
        self._waiting: list[Deferred[None]] = []

    async def tell(self, result: TaskResult) -> None:
        """One more line; returns when there is room for the next."""
        self._ok += result.outcome.ok
        self._failed += not result.outcome.ok
        self._line(result.told())
        while self._paused:
            await self._room()

    def end(self) -> None:
        """All is done: the last line."""
        self._line(
            {
                "done": True,
                "robots": len(self._plan.robots),
                "ok": self._ok,
                "failed": self._failed,
                "seconds": round(self._clock.seconds() - self._began, 3),
            }
        )

    def close(self) -> None:
        """Whatever came of it."""
        if self._open and not self._request._disconnected:
            self._request.unregisterProducer()
        self._open = False

    def begin(self) -> None:
        """The order begins: the first line. One that can't be begun is told by its status instead."""
        if self._request._disconnected:
            return
        self._open = True
        if self._plan.order.do == "stop":
            # It goes on without its client, and must not wait for him to take its lines.
            self._request.notifyFinish().addErrback(lambda _: self.resumeProducing())
        self._request.setHeader(b"content-type", b"application/x-ndjson")
        self._request.setHeader(b"cache-control", b"no-store")
        self._request.setHeader(b"x-accel-buffering", b"no")
        self._request.registerProducer(self, True)
        self._line(self._plan.told())

    def _line(self, message: dict[str, Any]) -> None:
        if not self._request._disconnected:
            self._request.write(jsontext.encode(message) + b"\n")

    # --- Twisted's push producer ---

    def pauseProducing(self) -> None:
        """The transport's buffer is full."""
        self._paused = True

    def resumeProducing(self) -> None:
        """The transport takes bytes again."""
        self._paused = False
        waiting, self._waiting = self._waiting, []
        for each in waiting:
            each.callback(None)

    def stopProducing(self) -> None:
        """The client has left; the request's own end follows."""

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
