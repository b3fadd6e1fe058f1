"""``/api/v1/alerts``: what people should know, and the rules by which they are told."""

from __future__ import annotations

from typing import Annotated, Any, Literal, Protocol

from klein import Klein
from msgspec import Meta
from twisted.web.resource import IResource
from twisted.web.server import Request
from werkzeug.exceptions import HTTPException

from relay_protocol.errors import Invalid, NotFound
from relay_server.access import Principal
from relay_server.alerts.rules import RuleRequest
from relay_server.alerts.service import AlertCursor
from relay_server.http.api import Api, body_of
from relay_server.http.conditional import answers, told_facts
from relay_server.http.idempotent_requests import see_no_key
from relay_server.http.openapi.operation import ApiOperation, Response, described, query
from relay_server.http.openapi.schemas import AlertInfo, AlertPage, RuleInfo, RuleList, Tested
from relay_server.http.request_params import KNOWN

MOST = 500
_ANSWERS = {"": None, "true": True, "false": False}


class AlertServicePort(Protocol):
    """What is asked about alerts; see :class:`relay_server.alerts.service.AlertService`."""

    async def all(
        self, principal: Principal, robot: str, open: bool | None, limit: int, before: AlertCursor | None
    ) -> list[dict[str, Any]]:
        """Those the principal may know of, the latest first."""

    async def acknowledge(self, principal: Principal, alert_id: str) -> dict[str, Any]:
        """The principal looks after one."""

    async def rules(self, principal: Principal) -> dict[str, Any]:
        """By which rules the principal is told."""

    async def add_rule(self, principal: Principal, ask: RuleRequest, address: str) -> dict[str, Any]:
        """One more."""

    async def remove_rule(self, principal: Principal, number: int, address: str) -> None:
        """One less."""

    async def test_rule(self, principal: Principal, number: int) -> dict[str, Any]:
        """Send something by one."""


class AlertResource:
    """The addresses below ``/api/v1/alerts``."""

    app = Klein()

    def __init__(self, desk: AlertServicePort, api: Api) -> None:
        self._desk = desk
        self._api = api

    @app.route("/", methods=["GET"])
    @described(
        ApiOperation(
            method="GET",
            path="/api/v1/alerts",
            tag="alerts",
            summary="Alerts, the latest first",
            parameters=(
                query("robot", "of this robot only"),
                query(
                    "open", "only those that last, or only those that are over", Literal["", "true", "false"]
                ),
                query(
                    "limit",
                    "most alerts of an answer; 100 where left out",
                    Annotated[int, Meta(ge=1, le=MOST)],
                ),
                query("before", "`next` of an earlier answer: what comes behind that"),
                KNOWN,
            ),
            answers=answers("alerts", AlertPage),
        )
    )
    def list(self, request: Request) -> Any:
        return self._api.answer(request, self._list(request))

    async def _list(self, request: Request) -> Any:
        principal = await self._api.principal(request)
        names = (b"robot", b"open", b"limit", b"before")
        robot, lasts, limit, before = (_argument(request, name) for name in names)
        if lasts not in _ANSWERS:
            raise Invalid("'open' is true or false, or left out")
        if limit and not (
            limit.isascii() and limit.isdecimal() and len(limit) <= 9 and 1 <= int(limit) <= MOST
        ):
            raise Invalid(f"'limit' is a number from 1 to {MOST}")
        most = int(limit or 100)
        # One more than is told: that there is more shall be told only where there is.
        found = await self._desk.all(
            principal, robot, _ANSWERS[lasts], most + 1, AlertCursor.parse(before) if before else None
        )
        told = found[:most]
        behind = str(_position(told[-1])) if len(found) > most else None
        return told_facts(request, {"alerts": told, "next": behind})

    @app.route("/<id>/acknowledge", methods=["POST"])
    @described(
        ApiOperation(
            method="POST",
            path="/api/v1/alerts/{id}/acknowledge",
            tag="alerts",
            summary="Look after an alert",
            more="For operators and owners.",
            answers={200: Response("the alert", AlertInfo)},
        )
    )
    def acknowledge(self, request: Request, id: str) -> Any:
        return self._api.answer(request, self._acknowledge(request, id))

    async def _acknowledge(self, request: Request, id: str) -> Any:
        return await self._desk.acknowledge(await self._api.principal(request), id)

    @app.route("/rules", methods=["GET"])
    @described(
        ApiOperation(
            method="GET",
            path="/api/v1/alerts/rules",
            tag="alerts",
            summary="The caller's rules, and what a rule may say here",
            answers={200: Response("rules", RuleList)},
        )
    )
    def rules(self, request: Request) -> Any:
        return self._api.answer(request, self._rules(request))

    async def _rules(self, request: Request) -> Any:
        return await self._desk.rules(await self._api.principal(request))

    @app.route("/rules", methods=["POST"])
    @described(
        ApiOperation(
            method="POST",
            path="/api/v1/alerts/rules",
            tag="alerts",
            summary="Be told of alerts by one more rule",
            body=RuleRequest,
            answers={201: Response("the rule", RuleInfo)},
        )
    )
    def add(self, request: Request) -> Any:
        return self._api.answer(request, self._add(request))

    async def _add(self, request: Request) -> Any:
        principal = await self._api.principal(request)
        see_no_key(request)
        made = await self._desk.add_rule(principal, body_of(request, RuleRequest), _address(request))
        request.setResponseCode(201)
        return made

    @app.route("/rules/<number>", methods=["DELETE"])
    @described(
        ApiOperation(
            method="DELETE",
            path="/api/v1/alerts/rules/{number}",
            tag="alerts",
            summary="Be told by this rule no more",
            answers={204: Response("deleted")},
        )
    )
    def remove(self, request: Request, number: str) -> Any:
        return self._api.answer(request, self._remove(request, number))

    async def _remove(self, request: Request, number: str) -> Any:
        principal = await self._api.principal(request)
        await self._desk.remove_rule(principal, _number(number), _address(request))

    @app.route("/rules/<number>/test", methods=["POST"])
    @described(
        ApiOperation(
            method="POST",
            path="/api/v1/alerts/rules/{number}/test",
            tag="alerts",
            summary="Send a made-up alert now",
            answers={200: Response("whether it arrived", Tested)},
        )
    )
    def test(self, request: Request, number: str) -> Any:
        return self._api.answer(request, self._test(request, number))

    async def _test(self, request: Request, number: str) -> Any:
        principal = await self._api.principal(request)
        see_no_key(request)
        return await self._desk.test_rule(principal, _number(number))

    @app.handle_errors(HTTPException)
    def unrouted(self, request: Request, failure: Any) -> bytes:
        answer: bytes = self._api.unrouted(request, failure)
        return answer


def _position(alert: dict[str, Any]) -> AlertCursor:
    return AlertCursor(alert["last"], alert["id"])


def _argument(request: Request, name: bytes) -> str:
    values = request.args.get(name, [b""])
    return str(values[0].decode("utf-8", "replace"))


def _number(text: str) -> int:
    if not (text.isascii() and text.isdecimal() and len(text) <= 10):
        raise NotFound("the number of a rule is a number")
    return int(text)


def _address(request: Request) -> str:
    return str(getattr(request.getClientAddress(), "host", "local"))


def beside(desk: AlertServicePort, api: Api) -> IResource:
    """What serves ``/api/v1/alerts``."""
    resource: IResource = AlertResource(desk, api).app.resource()
    return resource
