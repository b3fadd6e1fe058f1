"""A robot's ``control``, ``stop``, ``resume``, ``suppress``, ``inhibit`` and ``hold`` (SPEC section 1.7)."""

from __future__ import annotations

from collections.abc import Awaitable
from typing import Annotated, Any, Protocol, TypeVar

import msgspec
from klein import Klein
from msgspec import Meta
from twisted.web.resource import IResource
from twisted.web.server import Request
from werkzeug.exceptions import HTTPException
from werkzeug.exceptions import NotFound as NothingHere

from relay_protocol import jsontext
from relay_protocol.errors import SwitchboardError
from relay_protocol.limits import NAME, WORDS
from relay_server.access import Principal
from relay_server.common.freshness_tokens import HEADER, FreshnessTokens
from relay_server.common.tcp import enable_tcp_keepalive
from relay_server.control.audit import reason_of
from relay_server.control.commands import NotDone
from relay_server.control.service import StopResult, TakeResult
from relay_server.control.types import ControlReply
from relay_server.http.api import STREAMED, Api, body_of, is_empty
from relay_server.http.freshness_header import dated
from relay_server.http.method_not_allowed import not_taken
from relay_server.http.openapi.operation import PROBLEM, ApiOperation, described, header
from relay_server.http.openapi.operation import Response as Told
from relay_server.http.openapi.schemas import (
    ControlAnswer,
    ControlInfo,
    ControlTakeInfo,
    StopAnswer,
    StopProblem,
)
from relay_server.http.problems import problem
from relay_server.http.request_params import APPLIED, wait_preferred
from relay_server.http_sessions.pool import LINGER_SECONDS

T = TypeVar("T", bound=msgspec.Struct)

PARTS = ("control", "stop", "resume", "suppress", "inhibit", "hold")
"""The addresses below a robot's that are served here."""

ReasonText = Annotated[str, Meta(max_length=WORDS)]
Resource = Annotated[str, Meta(min_length=1, max_length=NAME)]


class Why(msgspec.Struct):
    """Body of what takes a reason and no more."""

    why: ReasonText = ""


class ControlReplyBody(msgspec.Struct):
    """Body of an answer to a request; without ``client`` to that of whoever asks now.

    :param client: the number of the connection that asks
    """

    why: ReasonText = ""
    client: Annotated[int, Meta(ge=0, lt=1 << 32)] = 0


class Suppress(msgspec.Struct):
    """Body of ``POST …/suppress``; times in milliseconds."""

    resource: Resource
    ms: int = 100


class Inhibit(msgspec.Struct, forbid_unknown_fields=True):
    """Body of ``POST …/inhibit`` and ``…/hold``; times in milliseconds."""

    resource: Resource
    ms: int = 1000


ROBOT = "/api/v1/robots/{robot}"

CHANGES = {
    "release": "Give control back, or a request for it",
    "grant": "Hand control over to who asks for it",
    "refuse": "Keep control",
}


def _change_of(what: str, words: str) -> ApiOperation:
    return ApiOperation(
        method="POST",
        path=f"{ROBOT}/control/{what}",
        tag="control",
        summary=words,
        more="For all connections of the caller.",
        body=Why if what == "release" else ControlReplyBody,
        optional=True,
        answers={200: Told("it is done", ControlAnswer)},
        errors=(409,),
    )


_DATED = {HEADER: "when this was answered; who resumes the robot gives it back"}

_TAKING = {
    HEADER: "when this was answered; the first command gives it back",
    APPLIED: "the wait that was preferred",
}

WHO = ApiOperation(
    method="GET",
    path=f"{ROBOT}/control",
    tag="control",
    summary="Who moves a robot",
    answers={200: Told("who does", ControlInfo, headers=_DATED)},
)
TAKE = ApiOperation(
    method="PUT",
    path=f"{ROBOT}/control",
    tag="control",
    summary="Take control of a robot, or ask who has it for it",
    more="By the connection that is kept for the token at this robot: commands that are sent to its topics with the "
    f"same token are the holder's then. It ends {LINGER_SECONDS:g} s after the latest request that used it, and "
    "control with it; who stays asks again before. 409 where somebody else asks already, or the request was not "
    "granted.",
    parameters=(header("Prefer", "`wait=` seconds for which an answer to the request is waited (RFC 7240)"),),
    body=Why,
    optional=True,
    answers={
        200: Told("the caller has control", ControlTakeInfo, headers=_TAKING),
        202: Told("who has control is asked for it", ControlTakeInfo, headers=_TAKING),
    },
    errors=(409,),
)
LET_GO = ApiOperation(
    method="DELETE",
    path=f"{ROBOT}/control",
    tag="control",
    summary="Give back the control that was taken here, or withdraw the request for it",
    more="What other connections of the caller have is left alone. Never held back.",
    answers={204: Told("that connection neither has control nor asks for it", headers=_DATED)},
)
STOP = ApiOperation(
    method="POST",
    path=f"{ROBOT}/stop",
    tag="control",
    summary="Stop a robot",
    more="For everybody with a right on it. No stop is refused for its reason, nor for how many there are.",
    body=Why,
    optional=True,
    answers={
        200: Told("it is stopped", StopAnswer, headers=_DATED),
        202: Told("it will be as soon as it can be reached", StopAnswer, headers=_DATED),
    },
    problems={409: Told("it is stopped, but for what is told", StopProblem, media=(PROBLEM,))},
)
RESUME = ApiOperation(
    method="POST",
    path=f"{ROBOT}/resume",
    tag="control",
    summary="Let a robot move again",
    more="For who holds control, and for owners: 412 (`stopped_since`) where the robot may have been stopped after the "
    "moment that is given back, 428 without one.",
    parameters=(header(HEADER, "that of the latest answer about the robot's control"),),
    body=Why,
    optional=True,
    answers={200: Told("it may move", StopAnswer, headers=_DATED)},
    errors=(409, 412, 428),
)


def _subsuming(part: str, body: type[msgspec.Struct], summary: str, more: str = "") -> ApiOperation:
    return ApiOperation(
        method="POST",
        path=f"{ROBOT}/{part}",
        tag="control",
        summary=summary,
        more=more,
        body=body,
        answers={200: Told("as it was asked", body)},
        errors=(409,),
    )


SUPPRESS = _subsuming("suppress", Suppress, "Command a topic for moments")
INHIBIT = _subsuming("inhibit", Inhibit, "Have a topic say nothing for a time")
HOLD = _subsuming(
    "hold",
    Inhibit,
    "Have a topic say its last value for a time",
    "What it says meanwhile nobody gets: in its place the last value before comes again.",
)


class ControlServicePort(Protocol):
    """What is asked about control; see :class:`relay_server.control.service.ControlService`."""

    async def control(self, principal: Principal, robot: str, address: str) -> dict[str, Any]:
        """Who moves a robot."""

    async def take(
        self, principal: Principal, robot: str, why: str, address: str, seconds: float
    ) -> TakeResult:
        """Take it, or ask for it."""

    async def let_go(self, principal: Principal, robot: str, address: str) -> None:
        """Give back what was taken so."""

    async def release(self, principal: Principal, robot: str, why: str, address: str) -> ControlReply:
        """Give control back."""

    async def grant(
        self, principal: Principal, robot: str, why: str, address: str, client: int
    ) -> ControlReply:
        """Hand it over."""

    async def refuse(
        self, principal: Principal, robot: str, why: str, address: str, client: int
    ) -> ControlReply:
        """Keep it."""

    async def stop(self, principal: Principal, robot: str, why: str, address: str) -> StopResult:
        """Stop the robot."""

    async def resume(self, principal: Principal, robot: str, why: str, address: str, sent: int) -> None:
        """Let it move again."""

    async def suppress(self, principal: Principal, robot: str, resource: str, ms: int, address: str) -> None:
        """Command a topic for moments."""

    async def inhibit(
        self, principal: Principal, robot: str, resource: str, ms: int, hold: bool, address: str
    ) -> None:
        """Have a topic say nothing for a time."""


class ControlResource:
    """Control of one robot, for one request.

    :param part: one of :data:`PARTS`
    """

    app = Klein()

    def __init__(
        self, desk: ControlServicePort, moments: FreshnessTokens, part: str, api: Api, robot: str
    ) -> None:
        self._desk = desk
        self._moments = moments
        self._part = part
        self._api = api
        self._robot = robot

    @app.route("/", methods=["GET", "PUT", "DELETE", "POST"])
    @described(WHO, TAKE, LET_GO, STOP, RESUME, SUPPRESS, INHIBIT, HOLD)
    def order(self, request: Request) -> Any:
        ways = {
            ("control", "GET"): self._control,
            ("control", "PUT"): self._take,
            ("control", "DELETE"): self._let_go,
            ("stop", "POST"): self._stop,
            ("resume", "POST"): self._resume,
            ("suppress", "POST"): self._suppress,
            ("inhibit", "POST"): self._inhibit,
            ("hold", "POST"): self._inhibit,
        }
        method = "GET" if request.method == b"HEAD" else request.method.decode()
        way = ways.get((self._part, method))
        if way is None:
            return self.other(request)
        # Who stops a robot and leaves has it stopped all the same.
        return self._answer(request, way(request), lasts=self._part == "stop")

    async def _control(self, request: Request) -> Any:
        return await self._desk.control(*await self._asked(request))

    async def _take(self, request: Request) -> Any:
        # Nobody is to be given control who has gone while he waits for it.
        enable_tcp_keepalive(request.channel.transport)
        principal, robot, address = await self._asked(request)
        why = _body(request, Why).why
        # Before it is asked for: what can't be read of a request keeps it from being done.
        seconds = wait_preferred(request) or 0.0
        taken = await self._desk.take(principal, robot, why, address, seconds)
        if not taken.answer.success:
            request.setResponseCode(202)
        return {**taken.answer._asdict(), "kept": LINGER_SECONDS, "control": taken.control}

    async def _let_go(self, request: Request) -> Any:
        # Which stops the robot.
        await self._desk.let_go(*await self._asked(request, stops=True))

    @app.route("/<any(release,grant,refuse):what>", methods=["POST"])
    @described(*(_change_of(what, words) for what, words in CHANGES.items()))
    def change(self, request: Request, what: str) -> Any:
        if self._part != "control":
            raise NothingHere
        return self._api.answer(request, self._change(request, what))

    async def _change(self, request: Request, what: str) -> Any:
        principal, robot, address = await self._asked(request)
        if what == "release":
            done = await self._desk.release(principal, robot, _body(request, Why).why, address)
        else:
            reply = _body(request, ControlReplyBody)
            do = self._desk.grant if what == "grant" else self._desk.refuse
            done = await do(principal, robot, reply.why, address, reply.client)
        return done._asdict()

    @app.route("/")
    @app.route("/<path:what>")
    def other(self, request: Request, what: str = "") -> Any:
        """No method of these addresses."""
        if what and (self._part != "control" or what not in CHANGES):
            raise NothingHere
        takes = ("GET", "PUT", "DELETE") if self._part == "control" and not what else ("POST",)
        return self._answer(request, not_taken(self._control(request), takes))

    async def _stop(self, request: Request) -> Any:
        why = _reason(request)
        principal, robot, address = await self._asked(request, stops=True)
        outcome = await self._desk.stop(principal, robot, why, address)
        if outcome.failed:
            request.setHeader(HEADER, self._moments.now())
            request.write(problem(request, 409, outcome.failed, code=NotDone.code, stopped=outcome.stopped))
            return STREAMED
        if not outcome.done:
            request.setResponseCode(202)
        return {"stopped": outcome.stopped}

    async def _resume(self, request: Request) -> Any:
        principal, robot, address = await self._asked(request)
        sent = self._moments.needed(request.getHeader(HEADER))
        await self._desk.resume(principal, robot, _body(request, Why).why, address, sent)
        return {"stopped": None}

    async def _suppress(self, request: Request) -> Any:
        principal, robot, address = await self._asked(request)
        ask = body_of(request, Suppress)
        await self._desk.suppress(principal, robot, ask.resource, ask.ms, address)
        return msgspec.to_builtins(ask)

    async def _inhibit(self, request: Request) -> Any:
        principal, robot, address = await self._asked(request)
        ask = body_of(request, Inhibit)
        await self._desk.inhibit(principal, robot, ask.resource, ask.ms, self._part == "hold", address)
        return msgspec.to_builtins(ask)

    def _answer(self, request: Request, work: Awaitable[Any], *, lasts: bool = False) -> Any:
        """Answer with the moment at which that is done; see :meth:`relay_server.http.api.Api.answer`."""

        return self._api.answer(request, dated(request, self._moments, work), lasts=lasts)

    async def _asked(self, request: Request, *, stops: bool = False) -> tuple[Principal, str, str]:
        """Who asks, about which robot, from where."""
        principal = await self._api.principal(request, urgent=stops, passes=stops)
        return principal, self._robot, getattr(request.getClientAddress(), "host", "local")

    @app.handle_errors(HTTPException)
    def unrouted(self, request: Request, failure: Any) -> bytes:
        answer: bytes = self._api.unrouted(request, failure)
        return answer


def _body(request: Request, kind: type[T]) -> T:
    """What may be left out as a whole: nobody who stops a robot should have to think of a header."""
    return kind() if is_empty(request) else body_of(request, kind)


def _reason(request: Request) -> str:
    """Why a robot is stopped. A body that can't be read gives no reason, and is none to let it go on moving."""
    try:
        said = jsontext.decode_any(request.content.read())
    except SwitchboardError:
        return ""
    return reason_of(said.get("why")) if isinstance(said, dict) else ""


def below(desk: ControlServicePort, moments: FreshnessTokens, part: str, api: Api, robot: str) -> IResource:
    """What serves one of the addresses below a robot's."""
    resource: IResource = ControlResource(desk, moments, part, api, robot).app.resource()
    return resource
