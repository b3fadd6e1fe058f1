"""Below ``/api/v1/robots/<robot>``: ``control``, ``stop``, ``resume``, ``suppress``, ``inhibit`` (SPEC section 1.7)."""

from __future__ import annotations

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
from relay_server.console import Outcome
from relay_server.control import Answer, NotDone, reason_of
from relay_server.edges.api import STREAMED, Api, body_of
from relay_server.edges.problems import problem

T = TypeVar("T", bound=msgspec.Struct)

PARTS = ("control", "stop", "resume", "suppress", "inhibit")
"""The addresses below a robot's that are served here."""

ReasonText = Annotated[str, Meta(max_length=WORDS)]
Resource = Annotated[str, Meta(min_length=1, max_length=NAME)]


class Why(msgspec.Struct):
    """Body of what takes a reason and no more."""

    why: ReasonText = ""


class Suppress(msgspec.Struct):
    """Body of ``POST …/suppress``; times in milliseconds."""

    resource: Resource
    ms: int = 100


class Inhibit(msgspec.Struct):
    """Body of ``POST …/inhibit``; times in milliseconds."""

    resource: Resource
    ms: int = 1000
    hold: bool = False


class Desk(Protocol):
    """What is asked about control; see :class:`relay_server.console.Console`."""

    async def control(self, principal: Principal, robot: str, address: str) -> dict[str, Any]:
        """Who moves a robot."""

    async def release(self, principal: Principal, robot: str, why: str, address: str) -> Answer:
        """Give control back."""

    async def grant(self, principal: Principal, robot: str, why: str, address: str) -> Answer:
        """Hand it over."""

    async def refuse(self, principal: Principal, robot: str, why: str, address: str) -> Answer:
        """Keep it."""

    async def stop(self, principal: Principal, robot: str, why: str, address: str) -> Outcome:
        """Stop the robot."""

    async def resume(self, principal: Principal, robot: str, why: str, address: str) -> None:
        """Let it move again."""

    async def suppress(self, principal: Principal, robot: str, resource: str, ms: int, address: str) -> None:
        """Command a topic for moments."""

    async def inhibit(
        self, principal: Principal, robot: str, resource: str, ms: int, hold: bool, address: str
    ) -> None:
        """Have a topic say nothing for a time."""


class RobotControl:
    """Control of one robot, for one request.

    :param part: one of :data:`PARTS`
    """

    app = Klein()

    def __init__(self, desk: Desk, part: str, api: Api, robot: str) -> None:
        self._desk = desk
        self._part = part
        self._api = api
        self._robot = robot

    @app.route("/", methods=["GET"])
    def control(self, request: Request) -> Any:
        self._only("control")
        return self._api.answer(request, self._control(request))

    async def _control(self, request: Request) -> Any:
        return await self._desk.control(*await self._asked(request))

    @app.route("/<any(release,grant,refuse):what>", methods=["POST"])
    def change(self, request: Request, what: str) -> Any:
        self._only("control")
        return self._api.answer(request, self._change(request, what))

    async def _change(self, request: Request, what: str) -> Any:
        principal, robot, address = await self._asked(request)
        do = {"release": self._desk.release, "grant": self._desk.grant, "refuse": self._desk.refuse}[what]
        return (await do(principal, robot, _body(request, Why).why, address))._asdict()

    @app.route("/", methods=["POST"])
    def order(self, request: Request) -> Any:
        self._only("stop", "resume", "suppress", "inhibit")
        orders = {
            "stop": self._stop,
            "resume": self._resume,
            "suppress": self._suppress,
            "inhibit": self._inhibit,
        }
        # Who stops a robot and leaves has it stopped all the same.
        return self._api.answer(request, orders[self._part](request), lasts=self._part == "stop")

    async def _stop(self, request: Request) -> Any:
        why = _reason(request)
        principal, robot, address = await self._asked(request, urgent=True)
        outcome = await self._desk.stop(principal, robot, why, address)
        if outcome.failed:
            request.write(problem(request, 409, outcome.failed, code=NotDone.code, stopped=outcome.stopped))
            return STREAMED
        if not outcome.done:
            request.setResponseCode(202)
        return {"stopped": outcome.stopped}

    async def _resume(self, request: Request) -> Any:
        principal, robot, address = await self._asked(request)
        await self._desk.resume(principal, robot, _body(request, Why).why, address)
        return {"stopped": None}

    async def _suppress(self, request: Request) -> Any:
        principal, robot, address = await self._asked(request)
        ask = body_of(request, Suppress)
        await self._desk.suppress(principal, robot, ask.resource, ask.ms, address)
        return msgspec.to_builtins(ask)

    async def _inhibit(self, request: Request) -> Any:
        principal, robot, address = await self._asked(request)
        ask = body_of(request, Inhibit)
        await self._desk.inhibit(principal, robot, ask.resource, ask.ms, ask.hold, address)
        return msgspec.to_builtins(ask)

    def _only(self, *parts: str) -> None:
        if self._part not in parts:
            raise NothingHere

    async def _asked(self, request: Request, *, urgent: bool = False) -> tuple[Principal, str, str]:
        """Who asks, about which robot, from where."""
        principal = await self._api.principal(request, urgent=urgent)
        return principal, self._robot, getattr(request.getClientAddress(), "host", "local")

    @app.handle_errors(HTTPException)
    def unrouted(self, request: Request, failure: Any) -> bytes:
        answer: bytes = self._api.unrouted(request, failure)
        return answer


def _body(request: Request, kind: type[T]) -> T:
    """What may be left out as a whole: nobody who stops a robot should have to think of a header."""
    request.content.seek(0)
    empty = not request.content.read(1)
    request.content.seek(0)
    return kind() if empty else body_of(request, kind)


def _reason(request: Request) -> str:
    """Why a robot is stopped. A body that can't be read gives no reason, and is none to let it go on moving."""
    try:
        said = jsontext.decode_any(request.content.read())
    except SwitchboardError:
        return ""
    return reason_of(said.get("why")) if isinstance(said, dict) else ""


def below(desk: Desk, part: str, api: Api, robot: str) -> IResource:
    """What serves one of the addresses below a robot's."""
    resource: IResource = RobotControl(desk, part, api, robot).app.resource()
    return resource
