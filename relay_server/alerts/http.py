"""``/api/v1/alerts``: alerts of robots, and the rules by which users are notified."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from relay_server.alerts.rules import RuleRequest
from relay_server.alerts.schemas import AlertInfo, AlertPage, RuleInfo, RuleList, RuleTest
from relay_server.alerts.service import AlertCursor, AlertService
from relay_server.http.endpoint import ApiRequest, Created, IdempotencyKey, endpoint

BASE_PATH = "/api/v1/alerts"
MAX_PAGE = 500


class AlertParameters(msgspec.Struct, frozen=True):
    """A selection of alerts.

    :param robot: only of this robot
    :param open: only open ones, or only ended ones
    :param limit: most alerts of an answer
    :param before: `next` of an earlier answer: the alerts behind that
    """

    robot: str = ""
    open: Literal["", "true", "false"] = ""
    limit: Annotated[int, Meta(ge=1, le=MAX_PAGE)] = 100
    before: str = ""


class AlertEndpoints:
    """Alerts, and the caller's rules."""

    def __init__(self, service: AlertService) -> None:
        self._service = service

    @endpoint("GET", BASE_PATH, tag="alerts", summary="Alerts, the latest first", returns="alerts")
    async def list(self, request: ApiRequest, query: AlertParameters) -> AlertPage:
        is_open = None if not query.open else query.open == "true"
        before = AlertCursor.parse(query.before) if query.before else None
        # One more than is sent: it shows whether there is a next page.
        found = await self._service.all(request.principal, query.robot, is_open, query.limit + 1, before)
        page = found[: query.limit]
        more = len(found) > query.limit
        return AlertPage(page, str(AlertCursor(page[-1].last, page[-1].id)) if more else None)

    @endpoint(
        "POST",
        f"{BASE_PATH}/{{id}}/acknowledge",
        tag="alerts",
        summary="Acknowledge an alert",
        more="For operators and owners.",
        returns="the alert",
    )
    async def acknowledge(self, request: ApiRequest, id: str) -> AlertInfo:
        return await self._service.acknowledge(request.principal, id)

    @endpoint(
        "GET",
        f"{BASE_PATH}/rules",
        tag="alerts",
        summary="The caller's rules, and the values that a rule may have",
        returns="rules",
    )
    async def rules(self, request: ApiRequest) -> RuleList:
        return await self._service.rules(request.principal)

    @endpoint(
        "POST",
        f"{BASE_PATH}/rules",
        tag="alerts",
        summary="Add a rule by which the caller is notified",
        returns="the rule",
        key=IdempotencyKey.REFUSED,
    )
    async def add(self, request: ApiRequest, body: RuleRequest) -> Created[RuleInfo]:
        return Created(await self._service.add_rule(request.principal, body, request.address))

    @endpoint(
        "DELETE",
        f"{BASE_PATH}/rules/{{number}}",
        tag="alerts",
        summary="Remove a rule",
        returns="deleted",
    )
    async def remove(self, request: ApiRequest, number: int) -> None:
        await self._service.remove_rule(request.principal, number, request.address)

    @endpoint(
        "POST",
        f"{BASE_PATH}/rules/{{number}}/test",
        tag="alerts",
        summary="Send a test alert now",
        returns="whether it arrived",
        key=IdempotencyKey.REFUSED,
    )
    async def test(self, request: ApiRequest, number: int) -> RuleTest:
        return await self._service.test_rule(request.principal, number)
