"""``/api/v1/fleet``: one order to many robots, answered line by line; and the same on the relay's local socket."""

from __future__ import annotations

from collections.abc import Callable, Coroutine
from typing import Any, Protocol

from klein import Klein
from twisted.internet.defer import Deferred
from twisted.web.resource import IResource
from twisted.web.server import Request
from werkzeug.exceptions import HTTPException

from relay_protocol import jsontext
from relay_protocol.errors import SwitchboardError
from relay_server.access import Principal
from relay_server.clock import Clock, cancel
from relay_server.edges.api import STREAMED, Api, body_of
from relay_server.fleet import LOCAL, Order, Plan, Result

STALL_SECONDS = 30.0
"""Who takes nothing of the answer for so long is cut, and the order with him."""


class Desk(Protocol):
    """What is asked; see :class:`relay_server.fleet.FleetDesk`."""

    async def groups(self, asker: Principal) -> list[dict[str, Any]]:
        """Groups of robots."""

    async def plan(self, asker: Principal, order: Order, address: str) -> Plan:
        """Which robots an order means."""

    async def carry_out(
        self, plan: Plan, begin: Callable[[], None], tell: Callable[[Result], Coroutine[Any, Any, None]]
    ) -> None:
        """Do it."""


class FleetApi:
    """Orders of users, for one request."""

    app = Klein()

    def __init__(self, clock: Clock, desk: Desk, api: Api) -> None:
        self._clock = clock
        self._desk = desk
        self._api = api

    @app.route("/", methods=["POST"])
    def order(self, request: Request) -> Any:
        return self._api.answer(request, self._order(request), lasts=is_stop(request))

    async def _order(self, request: Request) -> Any:
        order = body_of(request, Order)
        # Whatever is ordered: rights are judged anew when a robot has its turn.
        principal = await self._api.principal(request, urgent=True)
        address = getattr(request.getClientAddress(), "host", "local")
        return await _carry_out(self._clock, self._desk, request, order, principal, address)

    @app.route("/groups", methods=["GET"])
    def groups(self, request: Request) -> Any:
        return self._api.answer(request, self._groups(request))

    async def _groups(self, request: Request) -> Any:
        return {"groups": await self._desk.groups(await self._api.principal(request))}

    @app.handle_errors(HTTPException)
    def unrouted(self, request: Request, failure: Any) -> bytes:
        answer: bytes = self._api.unrouted(request, failure)
        return answer


def beside(clock: Clock, desk: Desk, api: Api) -> IResource:
    """What serves the addresses of orders to many robots."""
    resource: IResource = FleetApi(clock, desk, api).app.resource()
    return resource


async def local(clock: Clock, desk: Desk, request: Request) -> Any:
    """The order of whoever may open the relay's local socket, who owns all robots.

    :raises SwitchboardError: it can't be begun, in words
    """
    return await _carry_out(clock, desk, request, body_of(request, Order), LOCAL, "local")


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
    clock: Clock, desk: Desk, request: Request, order: Order, asker: Principal, address: str
) -> Any:
    """Carry out an order, and tell of it line by line as long as somebody listens."""
    plan = await desk.plan(asker, order, address)
    lines = _Lines(clock, request, plan)
    try:
        await desk.carry_out(plan, lines.begin, lines.tell)
        lines.end()
    finally:
        lines.close()
    return STREAMED


class _Lines:
    """An answer in lines of JSON, no faster than it is taken: Twisted's push producer."""

    def __init__(self, clock: Clock, request: Request, plan: Plan) -> None:
        self._clock = clock
        self._request = request
        self._plan = plan
        self._began = clock.seconds()
        self._ok = self._failed = 0
        self._open = False
        self._paused = False
        self._waiting: list[Deferred[None]] = []

    async def tell(self, result: Result) -> None:
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
