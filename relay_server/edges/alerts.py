"""``/api/v1/alerts``: what people should know, and the rules by which they are told."""

from __future__ import annotations

from typing import Any, Protocol

from klein import Klein
from twisted.web.resource import IResource
from twisted.web.server import Request
from werkzeug.exceptions import HTTPException

from relay_protocol.errors import Invalid, NotFound
from relay_server.access import Principal
from relay_server.alerts import Ask
from relay_server.edges.api import Api, body_of

MOST = 500
_ANSWERS = {"": None, "true": True, "false": False}


class Desk(Protocol):
    """What is asked about alerts; see :class:`relay_server.alerts.AlertDesk`."""

    async def all(
        self, principal: Principal, robot: str, open: bool | None, limit: int
    ) -> list[dict[str, Any]]:
        """Those the principal may know of."""

    async def acknowledge(self, principal: Principal, alert_id: str) -> dict[str, Any]:
        """The principal looks after one."""

    async def rules(self, principal: Principal) -> dict[str, Any]:
        """By which rules the principal is told."""

    async def add_rule(self, principal: Principal, ask: Ask, address: str) -> dict[str, Any]:
        """One more."""

    async def remove_rule(self, principal: Principal, number: int, address: str) -> None:
        """One less."""

    async def test_rule(self, principal: Principal, number: int) -> dict[str, Any]:
        """Send something by one."""


class AlertPages:
    """The addresses below ``/api/v1/alerts``."""

    app = Klein()

    def __init__(self, desk: Desk, api: Api) -> None:
        self._desk = desk
        self._api = api

    @app.route("/", methods=["GET"])
    def list(self, request: Request) -> Any:
        return self._api.answer(request, self._list(request))

    async def _list(self, request: Request) -> Any:
        principal = await self._api.principal(request)
        robot, lasts, limit = (_argument(request, name) for name in (b"robot", b"open", b"limit"))
        if lasts not in _ANSWERS:
            raise Invalid("'open' is true or false, or left out")
        if limit and not (
            limit.isascii() and limit.isdecimal() and len(limit) <= 9 and 1 <= int(limit) <= MOST
        ):
            raise Invalid(f"'limit' is a number from 1 to {MOST}")
        found = await self._desk.all(principal, robot, _ANSWERS[lasts], int(limit or 100))
        return {"alerts": found}

    @app.route("/<id>/acknowledge", methods=["POST"])
    def acknowledge(self, request: Request, id: str) -> Any:
        return self._api.answer(request, self._acknowledge(request, id))

    async def _acknowledge(self, request: Request, id: str) -> Any:
        return await self._desk.acknowledge(await self._api.principal(request), id)

    @app.route("/rules", methods=["GET"])
    def rules(self, request: Request) -> Any:
        return self._api.answer(request, self._rules(request))

    async def _rules(self, request: Request) -> Any:
        return await self._desk.rules(await self._api.principal(request))

    @app.route("/rules", methods=["POST"])
    def add(self, request: Request) -> Any:
        return self._api.answer(request, self._add(request))

    async def _add(self, request: Request) -> Any:
        principal = await self._api.principal(request)
        made = await self._desk.add_rule(principal, body_of(request, Ask), _address(request))
        request.setResponseCode(201)
        return made

    @app.route("/rules/<number>", methods=["DELETE"])
    def remove(self, request: Request, number: str) -> Any:
        return self._api.answer(request, self._remove(request, number))

    async def _remove(self, request: Request, number: str) -> Any:
        principal = await self._api.principal(request)
        await self._desk.remove_rule(principal, _number(number), _address(request))

    @app.route("/rules/<number>/test", methods=["POST"])
    def test(self, request: Request, number: str) -> Any:
        return self._api.answer(request, self._test(request, number))

    async def _test(self, request: Request, number: str) -> Any:
        return await self._desk.test_rule(await self._api.principal(request), _number(number))

    @app.handle_errors(HTTPException)
    def unrouted(self, request: Request, failure: Any) -> bytes:
        answer: bytes = self._api.unrouted(request, failure)
        return answer


def _argument(request: Request, name: bytes) -> str:
    values = request.args.get(name, [b""])
    return str(values[0].decode("utf-8", "replace"))


def _number(text: str) -> int:
    if not (text.isascii() and text.isdecimal() and len(text) <= 9):
        raise NotFound("the number of a rule is a number")
    return int(text)


def _address(request: Request) -> str:
    return str(getattr(request.getClientAddress(), "host", "local"))


def beside(desk: Desk, api: Api) -> IResource:
    """What serves ``/api/v1/alerts``."""
    resource: IResource = AlertPages(desk, api).app.resource()
    return resource
