"""The local socket: HTTP over a unix socket that only the relay's own user can open (mode 0600)."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Any, Protocol

import msgspec
from klein import Klein
from twisted.internet.defer import CancelledError, Deferred
from twisted.web.server import Request

from relay_db.names import full_name_of
from relay_protocol import jsontext
from relay_protocol.errors import SwitchboardError
from relay_server.common.clock import shield
from relay_server.control.audit import reason_in
from relay_server.control.service import StopAllResult
from relay_server.fleet.http import is_stop, sent_of
from relay_server.http.problems import problem_of


class StopService(Protocol):
    """Who stops robots; see :class:`relay_server.control.service.ControlService`."""

    async def stop_here(self, robot: str | None, why: str, by: str) -> StopAllResult:
        """Stop a robot, or all."""

    async def resume_here(self, robot: str, why: str, by: str, sent: int) -> None:
        """Let one move again."""


class StopBody(msgspec.Struct):
    """Body of ``POST /stop`` and ``POST /resume``; without ``robot`` all are stopped.

    :param by: who is at the machine
    :param why: the reason, where it is one
    """

    by: str
    robot: str | None = None
    why: msgspec.Raw = msgspec.Raw(b"")

    @property
    def full(self) -> str | None:
        """The robot's name for the whole relay, however it was written."""
        return None if self.robot is None else full_name_of(self.robot)


_order_decoder = msgspec.json.Decoder(StopBody)


class AdminSocket:
    """``GET /status``, ``POST /refresh``, ``/stop``, ``/resume`` and ``/fleet`` for the admin command line.

    :param status: what the relay knows now
    :param refresh: takes up changes in the database at once
    :param order: carries out an order to many robots, and answers by itself
    """

    app = Klein()

    def __init__(
        self,
        status: Callable[[], dict[str, Any]],
        refresh: Callable[[], Awaitable[None]],
        order: Callable[[Request], Awaitable[object]],
        stopping: StopService,
    ) -> None:
        self._status = status
        self._refresh = refresh
        self._order = order
        self._stopping = stopping

    @app.route("/status", methods=["GET"])
    def status(self, request: Request) -> bytes:
        request.setHeader(b"content-type", b"application/json")
        return jsontext.encode(self._status())

    @app.route("/refresh", methods=["POST"])
    def refresh(self, request: Request) -> Deferred[bytes]:
        return Deferred.fromCoroutine(self._take_up(request))

    async def _take_up(self, request: Request) -> bytes:
        await self._refresh()
        request.setResponseCode(204)
        return b""

    @app.route("/stop", methods=["POST"])
    def stop(self, request: Request) -> Deferred[bytes]:
        return Deferred.fromCoroutine(self._told(request, self._stop(request)))

    async def _stop(self, request: Request) -> Any:
        order = jsontext.decode(_order_decoder, request.content.read())
        halted = await self._stopping.stop_here(order.full, reason_in(order.why), order.by)
        return halted._asdict()

    @app.route("/resume", methods=["POST"])
    def resume(self, request: Request) -> Deferred[bytes]:
        return Deferred.fromCoroutine(self._told(request, self._resume(request)))

    async def _resume(self, request: Request) -> Any:
        order = jsontext.decode(_order_decoder, request.content.read())
        # Of which nobody says when it was given, it is older than any stop.
        sent = sent_of(request) or 0
        await self._stopping.resume_here(order.full or "", reason_in(order.why), order.by, sent)
        return {}

    async def _told(self, request: Request, work: Awaitable[Any]) -> bytes:
        try:
            answer = jsontext.encode(await work)
        except SwitchboardError as error:
            return problem_of(request, error)
        request.setHeader(b"content-type", b"application/json")
        return answer

    @app.route("/fleet", methods=["POST"])
    def fleet(self, request: Request) -> Deferred[bytes]:
        lasts = is_stop(request)
        running = Deferred.fromCoroutine(self._carry_out(request))
        # Ctrl-C at the command line has klein end any other order.
        return shield(running) if lasts else running

    async def _carry_out(self, request: Request) -> bytes:
        try:
            await self._order(request)
        except SwitchboardError as error:
            return problem_of(request, error)
        except CancelledError:
            if not request._disconnected:
                raise
        return b""
