"""``/api/v1/alerts`` on transports in memory."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import pytest

from relay_protocol.errors import NotFound
from relay_server.access import Principal
from relay_server.alerts.http import AlertEndpoints
from relay_server.alerts.rules import RuleRequest
from relay_server.alerts.schemas import AlertInfo
from relay_server.alerts.service import AlertCursor, TooManyRuleChanges
from tests.worlds.alerts import alert
from tests.worlds.http_client import World

HERE = "/api/v1/alerts"
ANN = {"Authorization": "Bearer ann"}


class FakeAlertService:
    """Records the arguments of each call."""

    def __init__(self) -> None:
        self.calls: list[tuple[object, ...]] = []

    async def all(
        self, principal: Principal, robot: str, open: bool | None, limit: int, before: AlertCursor | None
    ) -> list[AlertInfo]:
        """Three, or fewer if the limit is lower."""
        self.calls.append((principal.name, robot, open, limit, before))
        found = [alert(f"a{each}", last=1e9 - each / 3) for each in range(min(limit, 3))]
        return [AlertInfo.of(each, may_acknowledge=True, notification_count=1, notify=True) for each in found]

    async def acknowledge(self, principal: Principal, alert_id: str) -> dict[str, Any]:
        """There is one alert, a1."""
        if alert_id != "a1":
            raise NotFound("there is no such alert")
        return {"id": alert_id}

    async def rules(self, principal: Principal) -> dict[str, Any]:
        """There are no rules."""
        return {"rules": []}

    async def add_rule(self, principal: Principal, ask: RuleRequest, address: str) -> dict[str, Any]:
        """Accepts everything."""
        self.calls.append((principal.name, ask, address))
        return {"id": 7}

    async def remove_rule(self, principal: Principal, number: int, address: str) -> None:
        """Accepts everything."""
        self.calls.append((principal.name, number, address))

    async def test_rule(self, principal: Principal, number: int) -> dict[str, Any]:
        """Rule 8 was tested too often."""
        if number == 8:
            raise TooManyRuleChanges("you test rules", 11.5)
        return {"ok": True, "reason": ""}


@pytest.fixture
def service() -> FakeAlertService:
    return FakeAlertService()


@pytest.fixture
def world(tmp_path: Path, service: FakeAlertService) -> World:
    """A site with alerts."""
    made = World(tmp_path)
    made.router.add(AlertEndpoints(cast(Any, service)))
    return made


def test_endpoints_call_the_service(world: World, service: FakeAlertService) -> None:
    """Values of the query and of the body reach it."""
    listed = world.ask("GET", HERE, **ANN).json
    assert ([each["id"] for each in listed["alerts"]], listed["next"]) == (["a0", "a1", "a2"], None)
    world.ask("GET", f"{HERE}?robot=rover&open=true&limit=5", **ANN)
    world.ask("GET", f"{HERE}?open=false", **ANN)
    assert service.calls == [
        ("ann", "", None, 101, None),
        ("ann", "rover", True, 6, None),
        ("ann", "", False, 101, None),
    ]
    assert world.ask("POST", f"{HERE}/a1/acknowledge", **ANN).json == {"id": "a1"}
    assert world.ask("GET", f"{HERE}/rules", **ANN).json == {"rules": []}
    answer = world.ask("POST", f"{HERE}/rules", {"channel": "portal", "group_s": 30}, **ANN)
    assert (answer.status, answer.json) == (201, {"id": 7})
    assert service.calls[-1] == ("ann", RuleRequest("portal", group_s=30.0), "192.0.2.9")
    assert world.ask("DELETE", f"{HERE}/rules/7", **ANN).status == 204
    assert service.calls[-1] == ("ann", 7, "192.0.2.9")
    assert world.ask("DELETE", f"{HERE}/rules/{2**31 - 1}", **ANN).status == 204
    assert service.calls[-1] == ("ann", 2**31 - 1, "192.0.2.9")
    assert world.ask("POST", f"{HERE}/rules/7/test", **ANN).json["ok"]


def test_a_list_goes_on_where_it_ended(world: World, service: FakeAlertService) -> None:
    page = world.ask("GET", f"{HERE}?limit=2", **ANN).json
    assert [each["id"] for each in page["alerts"]] == ["a0", "a1"]
    world.ask("GET", f"{HERE}?limit=2&before={page['next']}", **ANN)
    assert service.calls[-1] == ("ann", "", None, 3, AlertCursor(1e9 - 1 / 3, "a1"))
    assert world.ask("GET", f"{HERE}?limit=3", **ANN).json["next"] is None


@pytest.mark.parametrize(
    ("method", "path", "body", "status"),
    [
        ("GET", f"{HERE}?before=a1", None, 400),
        ("GET", f"{HERE}?before=nan_a1", None, 400),
        ("GET", f"{HERE}?before=1e999_a1", None, 400),
        ("GET", f"{HERE}?before=1.5.2_a1", None, 400),
        ("GET", f"{HERE}?before=1.5_%00", None, 400),
        ("GET", f"{HERE}?before=1.5_{'a' * 33}", None, 400),
        ("GET", f"{HERE}?open=maybe", None, 400),
        ("GET", f"{HERE}?limit=0", None, 400),
        ("GET", f"{HERE}?limit=501", None, 400),
        ("GET", f"{HERE}?limit=0000000019999", None, 400),
        ("GET", f"{HERE}?limit=%D9%A1", None, 400),
        ("GET", f"{HERE}?limit=-1", None, 400),
        ("POST", f"{HERE}/a2/acknowledge", None, 404),
        ("GET", f"{HERE}/a1", None, 404),
        ("PUT", f"{HERE}/rules", None, 405),
        ("POST", f"{HERE}/rules", {"channel": "portal", "user": "bob"}, 400),
        ("POST", f"{HERE}/rules", {"channel": "portal", "group_s": 0}, 400),
        ("POST", f"{HERE}/rules", ["portal"], 400),
        ("DELETE", f"{HERE}/rules/x", None, 404),
        ("DELETE", f"{HERE}/rules/99999999999999999999", None, 404),
        ("POST", f"{HERE}/rules/8/test", None, 429),
    ],
)
def test_invalid_requests_get_problem_details(
    world: World, method: str, path: str, body: Any, status: int
) -> None:
    answer = world.ask(method, path, body, **ANN)
    assert (answer.status, answer.headers["content-type"]) == (status, "application/problem+json")
    if status == 429:
        assert answer.headers["retry-after"] == "12"


@pytest.mark.parametrize(
    ("method", "path"),
    [
        ("GET", ""), ("POST", "/a1/acknowledge"), ("GET", "/rules"), ("POST", "/rules"), ("DELETE", "/rules/7"),
        ("POST", "/rules/7/test"),
    ],
)  # fmt: skip
def test_requests_without_credentials_are_refused(
    world: World, service: FakeAlertService, method: str, path: str
) -> None:
    assert world.ask(method, HERE + path, {} if method == "POST" else None).status == 401
    if method != "GET":
        answer = world.ask(method, HERE + path, {}, Cookie="sb=ann", Origin="https://evil.example")
        assert answer.status == 403
    assert service.calls == []
