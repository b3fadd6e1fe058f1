"""The HTTP API and its OpenAPI document: schemathesis calls all documented operations of a real relay with a
robot.

Endless answers are left out (streams, websockets, files; ``lasts`` has the reasons), and so are operations by
which the relay sends to another machine.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import pytest
import requests
import schemathesis
from hypothesis import HealthCheck, settings
from playwright.sync_api import Browser, expect
from schemathesis.checks import load_all_checks
from schemathesis.specs.openapi.checks import (
    content_type_conformance,
    response_schema_conformance,
    status_code_conformance,
)

from relay_server.alerts.schemas import AlertsUpdate
from relay_server.fleet.order import FleetOrderEnd, FleetOrderStart, FleetRobotResult
from relay_server.http.openapi.document import document
from relay_server.http.openapi.http import operations
from relay_server.http.openapi.operation import Credential
from relay_server.sessions.presence import RobotsUpdate
from tests.worlds.http_requests import ask
from tests.worlds.relay_process import Relay
from tests.worlds.small_robot import SmallRobot
from tests.worlds.waiting import wait_for

EXAMPLES = 12
"""Requests of each operation by who owns the robot and administers the relay."""

FEWER = 3
"""By somebody who may only look."""

CHECKS = [content_type_conformance, response_schema_conformance, status_code_conformance]

KNOWN = ["/mode", "mode", "start", "/start", "relay/status", "base:speed", "nothing of that name"]
"""Names of what the robot has, and of what it has not."""

IN_REALM = {
    "name": ["bob", "crew", "arm", "nobody", "ann@lab1", "%", "\N{SNOWMAN}"],
    "user": ["bob", "nobody"],
    "holder": ["bob", "@crew", "@nobody"],
    "member": ["arm", "nobody"],
    "key": ["swc_nobody", "%"],
    "robot": ["arm", "nobody"],
}
"""Names in addresses of the realm."""

MOMENT = "switchboard-freshness"

SHORT = 0.2
"""Longest that a request waits for something, seconds."""


def starts(robot: SmallRobot, args: Any) -> dict[str, Any]:
    """A service that succeeds."""
    return {"success": True, "message": "it starts"}


def closed(schema: dict[str, Any]) -> dict[str, Any]:
    """Answers may have no undocumented fields."""
    return {**schema, "additionalProperties": False} if schema.get("properties") else schema


def asked() -> dict[str, Any]:
    """The OpenAPI document, limited to operations that a test can finish; the schemas of answers are closed."""
    reported = copy.deepcopy(document(operations(), "1", "session"))
    sent: set[str] = set()
    for path, methods in list(reported["paths"].items()):
        for method, each in list(methods.items()):
            if "x-lasts" in each:
                del methods[method]
                continue
            body = each.get("requestBody", {})
            # RDF bodies are written by hand in their own tests.
            body.get("content", {}).pop("text/turtle", None)
            for media in ("application/rdf+xml", "application/ld+json"):
                body.get("content", {}).pop(media, None)
            sent |= {
                str(of.get("schema", {}).get("$ref", "")).rpartition("/")[2]
                for of in body.get("content", {}).values()
            }
            # Only the relay's own values are freshness tokens.
            given = [one for one in each.get("parameters", []) if one["name"] != MOMENT]
            each["parameters"] = given
            for parameter in given:
                narrow(parameter)
                if path.startswith("/api/v1/realm") and parameter["name"] in IN_REALM:
                    # Neither the requesting user nor the robot of all other requests.
                    parameter["schema"] = {"enum": IN_REALM[parameter["name"]]}
        if not methods:
            del reported["paths"][path]
    schemas = reported["components"]["schemas"]
    for name in schemas.keys() - sent - {"VideoSettings"}:
        schemas[name] = closed(schemas[name])
    for name in ("ServiceCall", "Order"):
        schemas[name]["properties"]["timeout"]["maximum"] = SHORT
    schemas["Order"]["properties"]["robots"]["items"] = {"enum": ["rover", "r*", "nobody", "group:all"]}
    # No request leaves the machine.
    schemas["RuleRequest"]["properties"]["channel"] = {"enum": ["portal", "apprise", "pigeon"]}
    return reported


def narrow(parameter: dict[str, Any]) -> None:
    """Limits a parameter to existing names, and to no wait."""
    name = parameter["name"]
    if name == "robot" and parameter["in"] == "path":
        parameter["schema"] = {"enum": ["rover", "nobody"]}
    elif name == "name" and parameter["in"] == "path":
        parameter["schema"] = {"anyOf": [{"enum": KNOWN}, {"type": "string"}]}
    elif name == "number":
        parameter["schema"] = {"anyOf": [{"enum": ["1", "2"]}, {"type": "string"}]}
    elif name == "wait":
        parameter |= {"required": True, "schema": {"type": "number", "minimum": 0, "maximum": SHORT}}


@dataclass
class World:
    """A relay with a robot, an owner who administers the relay, and a viewer.

    :ivar spare: a token that may be revoked
    :ivar viewers: the viewer's, and one that may be revoked
    """

    relay: Relay
    token: str
    spare: str
    viewers: tuple[str, str]
    session: requests.Session = field(default_factory=requests.Session)

    @property
    def url(self) -> str:
        """The URL of the relay."""
        return f"http://127.0.0.1:{self.relay.http_port}"


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    """One for all operations: none breaks it for the others."""
    relay = Relay(tmp_path_factory.mktemp("openapi"), "--requests-per-second", "0")
    try:
        token = relay.user("ann", admin=True)
        robot = SmallRobot(relay, "rover", {"/start": starts})
        relay.cli("right", "grant", "ann", "rover", "owner")
        robot.comes()
        try:
            viewer = relay.user("vic")
            relay.cli("right", "grant", "vic", "rover", "viewer")
            world = World(relay, token, relay.token("ann"), (viewer, relay.token("vic")))
            yield world
            world.session.close()
        finally:
            robot.goes()
    finally:
        relay.stop()


SCHEMA = schemathesis.openapi.from_dict(
    asked(),
    config=schemathesis.Config.from_dict(
        {
            "generation": {"mode": "all", "deterministic": True, "with-security-parameters": False},
            "phases": {"coverage": {"enabled": False}, "examples": {"enabled": False}},
        }
    ),
)
load_all_checks()


@dataclass
class Visit:
    """A client that uses existing names and the latest freshness token."""

    world: World
    moment: dict[str, str] = field(default_factory=dict)

    def __call__(self, method: str, path: str, body: Any = None, **named: str) -> Any:
        """Sends a request, checks that the answer is documented, and returns its content.

        :param named: parts of the address
        """
        given = {} if body is None else {"body": body, "media_type": "application/json"}
        if path.startswith("/oauth"):
            given["media_type"] = "application/x-www-form-urlencoded"
        case = SCHEMA[path][method].Case(path_parameters={"robot": "rover", **named}, **given)
        proof = {"Authorization": f"Bearer {self.world.token}"} if path != "/oauth/token" else {}
        answer = case.call(
            base_url=self.world.url, headers={**proof, **self.moment}, session=self.world.session
        )
        assert answer.status_code < 300, answer.text
        if MOMENT in answer.headers:
            self.moment[MOMENT] = answer.headers[MOMENT][0]
        case.validate_response(answer, checks=CHECKS)
        return answer.json() if answer.content else None


def test_valid_request_is_answered_as_described(world: World) -> None:
    """Alerts, rules, recordings, events, orders and tokens from creation to removal."""
    visit, robot = Visit(world), "/api/v1/robots/{robot}"
    visit("POST", f"{robot}/stop", {"why": "to be told"})
    wait_for("the alert is told", lambda: visit("GET", "/api/v1/alerts")["alerts"])
    alert = visit("GET", "/api/v1/alerts")["alerts"][0]
    assert visit("POST", "/api/v1/alerts/{id}/acknowledge", id=alert["id"])["acknowledged"]["by"] == "ann"
    assert visit("GET", robot)["stopped"]["why"] == visit("GET", f"{robot}/control")["stopped"]["why"]
    visit("POST", f"{robot}/resume", {})
    quiet = {"from": "22:00", "to": "06:00"}
    rule = visit("POST", "/api/v1/alerts/rules", {"channel": "portal", "quiet": quiet})
    assert [each["id"] for each in visit("GET", "/api/v1/alerts/rules")["rules"]] == [rule["id"]]
    visit("POST", "/api/v1/alerts/rules/{number}/test", number=str(rule["id"]))
    visit("DELETE", "/api/v1/alerts/rules/{number}", number=str(rule["id"]))
    recording = visit("POST", f"{robot}/recordings", {"topics": ["/mode"]})
    visit("GET", f"{robot}/recordings")
    visit("GET", f"{robot}/recordings/{{id}}", id=recording["id"])
    assert visit("POST", f"{robot}/recordings/{{id}}/stop", id=recording["id"])["state"] == "complete"
    visit("DELETE", f"{robot}/recordings/{{id}}", id=recording["id"])
    visit("POST", "/api/v1/events", [{"kind": "greeted", "robot": "rover", "data": {"person": "ann"}}] * 2)
    visit("POST", "/api/v1/events", {"kind": "greeted"})
    assert len(visit("GET", "/api/v1/events")["events"]) > 3
    assert visit("POST", f"{robot}/services/{{name}}", {}, name="/start")["values"]["success"]
    start = visit("GET", f"{robot}/services/{{name}}", name="/start")
    assert start in visit("GET", f"{robot}/services")["services"] and start["types"]
    visit("POST", f"{robot}/topics/{{name}}", {"value": {"data": "dock"}}, name="mode")
    visit("POST", "/api/v1/tickets", {"robot": "rover", "for": "video", "camera": "/front"})
    base = visit("GET", f"{robot}/nodes/{{name}}", name="base")
    assert base in visit("GET", f"{robot}/nodes")["nodes"] and base["subscribes"] == ["/mode"]
    with world.relay.connect("rover", world.token):
        assert visit("GET", f"{robot}/people")["people"][0]["user"] == "ann"
    urls = f"{robot}/foxglove-urls"
    made = visit("POST", urls, {"label": "screen"})
    assert [each["id"] for each in visit("GET", urls)["urls"]] == [made["id"]]
    visit("DELETE", f"{urls}/{{id}}", id=made["id"])
    administer(visit, "/api/v1/realm")
    login = {"grant_type": "password", "username": "ann", "password": "correct horse"}
    token = visit("POST", "/oauth/token", login)["access_token"]
    assert visit("POST", "/oauth/introspect", {"token": token})["active"]
    visit("POST", "/oauth/revoke", {"token": token})


def administer(visit: Visit, realm: str) -> None:
    """All kinds of resources of a realm, from creation to removal."""
    assert visit("GET", realm)["realm"] == "default"
    visit("POST", f"{realm}/users", {"name": "bob", "password": "correct horse"})
    assert visit("PATCH", f"{realm}/users/{{name}}", {"admin": True}, name="bob")["admin"]
    visit("POST", f"{realm}/groups", {"name": "crew"})
    visit("PUT", f"{realm}/groups/{{name}}/members/{{user}}", name="crew", user="bob")
    assert visit("GET", f"{realm}/groups")["groups"] == [
        visit("GET", f"{realm}/groups/{{name}}", name="crew")
    ]
    assert visit("GET", f"{realm}/users/{{name}}", name="bob")["groups"] == ["crew"]
    visit("POST", f"{realm}/robots", {"name": "arm"})
    visit("POST", f"{realm}/robots/{{name}}/code", name="arm")
    assert visit("GET", f"{realm}/robots/{{name}}", name="arm") in visit("GET", f"{realm}/robots")["robots"]
    right = f"{realm}/rights/{{name}}/{{holder}}"
    for level in ("viewer", "operator"):
        visit("PUT", right, {"level": level, "deny": ["call:/x"]}, name="arm", holder="@crew")
    assert "@crew" in [each["holder"] for each in visit("GET", f"{realm}/rights")["rights"]]
    visit("DELETE", right, name="arm", holder="@crew")
    keys = visit("GET", f"{realm}/robots/{{name}}/keys", name="rover")["keys"]
    assert [each["retired"] for each in keys] == [None]
    tokens = visit("GET", f"{realm}/users/{{name}}/tokens", name="ann")["tokens"]
    assert {"access"} <= {each["kind"] for each in tokens}
    reported = visit("PATCH", f"{realm}/robots/{{name}}", {"description": "on the bench"}, name="arm")
    assert reported["description"] == "on the bench"
    oauth_clients = f"{realm}/users/{{name}}/oauth-clients"
    oauth_client = visit("POST", oauth_clients, {"label": "reader", "scope": "viewer"}, name="bob")
    assert oauth_client.pop("secret") and visit("GET", oauth_clients, name="bob")["oauth_clients"] == [
        oauth_client
    ]
    visit("DELETE", f"{realm}/oauth-clients/{{key}}", key=oauth_client["key"])
    visit("POST", f"{realm}/robot-groups", {"name": "upstairs"})
    place = f"{realm}/robot-groups/{{name}}/members/{{member}}"
    visit("PUT", place, name="upstairs", member="arm")
    group = visit("GET", f"{realm}/robot-groups/{{name}}", name="upstairs")
    assert group in visit("GET", f"{realm}/robot-groups")["robot_groups"] and group["robots"] == ["arm"]
    visit("DELETE", place, name="upstairs", member="arm")
    visit("DELETE", f"{realm}/robot-groups/{{name}}", name="upstairs")
    visit("DELETE", f"{realm}/groups/{{name}}/members/{{user}}", name="crew", user="bob")
    for what, name in (("users", "bob"), ("groups", "crew"), ("robots", "arm")):
        visit("DELETE", f"{realm}/{what}/{{name}}", name=name)
    assert "bob" not in [each["user"] for each in visit("GET", f"{realm}/users")["users"]]


def examples(most: int) -> settings:
    """A fixed set of this many examples for each operation."""
    return settings(
        max_examples=most,
        derandomize=True,
        database=None,
        deadline=None,
        suppress_health_check=list(HealthCheck),
    )


def see_described(case: Any, world: World, token: str, spare: str) -> None:
    """Sends a request, and checks that the answer is documented.

    :param spare: for operations that revoke the sent token
    """
    ends = (case.method, case.path) == ("DELETE", "/api/v1/session")
    headers = {"Authorization": f"Bearer {spare if ends else token}"}
    answer = case.call(base_url=world.url, headers=headers, session=world.session)
    assert answer.status_code not in (500, 501, 502), answer.text
    case.validate_response(answer, checks=CHECKS)


@SCHEMA.parametrize()
@examples(EXAMPLES)
def test_no_answer_is_undocumented(case: Any, world: World) -> None:
    """For valid and invalid requests: no failure, and no undocumented status, media type or field."""
    see_described(case, world, world.token, world.spare)


@SCHEMA.parametrize()
@examples(FEWER)
def test_no_refusal_is_undocumented(case: Any, world: World) -> None:
    """Nor are answers to a viewer."""
    see_described(case, world, *world.viewers)


def test_live_updates_are_as_described(world: World) -> None:
    types: dict[str, Any] = {"robots": RobotsUpdate, "alerts": AlertsUpdate}
    headers = {"Authorization": f"Bearer {world.token}"}
    received: dict[str, Any] = {}
    with requests.get(f"{world.url}/api/v1/robots/stream", headers=headers, stream=True) as answer:
        lines = filter(None, answer.iter_lines())
        while received.keys() != types.keys():
            event, data = (next(lines).partition(b": ")[2] for _ in range(2))
            received[event.decode()] = msgspec.json.decode(data, type=types[event.decode()])
    assert [each["name"] for each in received["robots"]["robots"]] == ["rover"]


def test_lines_of_an_order_are_as_described(world: World) -> None:
    headers = {"Authorization": f"Bearer {world.token}"}
    order = {"robots": ["rover", "nobody"], "do": "stop"}
    answer = requests.post(f"{world.url}/api/v1/fleet", json=order, headers=headers)
    start, result, end = answer.content.splitlines()
    assert msgspec.json.decode(start, type=FleetOrderStart).unmatched == ["nobody"]
    assert msgspec.json.decode(result, type=FleetRobotResult).ok
    assert msgspec.json.decode(end, type=FleetOrderEnd).ok == 1
    visit = Visit(world)
    # For a freshness token.
    visit("GET", "/api/v1/robots/{robot}/control")
    visit("POST", "/api/v1/robots/{robot}/resume", {})


def test_every_operation_has_its_address(world: World) -> None:
    """Unauthenticated requests get 401 if authentication is needed; no address is missing."""
    for each in operations():
        # An existing term; other requests need authentication.
        path = each.path.replace("{name}", "fields").replace("{", "").replace("}", "")
        answer = ask(world.relay.http_port, each.method, path)
        assert answer.status not in (404, 405, 500), each
        if each.credential in (Credential.USER, Credential.VIEWER, Credential.OAUTH_CLIENT_OR_USER):
            assert answer.status in (400, 401, 426), (each, answer.body)


@pytest.mark.parametrize("width", [390, 1280])
def test_the_page_is_for_phones_and_desks(browser: Browser, world: World, width: int) -> None:
    """It loads nothing from other hosts, violates no rule of the relay's policy, and fits the screen's width,
    with any parts open.
    """
    page = browser.new_page(viewport={"width": width, "height": 800})
    try:
        asked, said = list[str](), list[str]()
        page.on("request", lambda request: asked.append(request.url))
        page.on("console", lambda message: said.append(message.text))
        page.goto(f"{world.url}/api/docs")
        operation = page.locator("#post_robots_by_robot_stop")
        operation.locator("summary").click()
        expect(operation.get_by_text("application/problem+json").first).to_be_visible()
        operation.get_by_role("link", name="StopAnswer").first.click()
        expect(page.locator("#type-StopAnswer")).to_be_visible()
        page.evaluate("document.querySelectorAll('details').forEach(each => { each.open = true })")
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        assert all(each.startswith(world.url) for each in asked)
        assert not [each for each in said if "Content Security Policy" in each]
    finally:
        page.close()


def test_requests_are_limited_and_stops_are_not(tmp_path: Path) -> None:
    """With a real clock and a real robot: the remaining requests are shown, and a stop passes without any."""
    relay = Relay(tmp_path, "--requests-per-second", "0.01")
    try:
        token = relay.user("ann")
        robot = SmallRobot(relay, "rover", {"/start": starts})
        relay.cli("right", "grant", "ann", "rover", "operator")
        robot.comes()
        try:
            first = ask(relay.http_port, "GET", "/api/v1/robots", token=token)
            assert first.headers["RateLimit-Policy"] == '"user";q=1;w=100'
            refused = ask(relay.http_port, "GET", "/api/v1/robots", token=token)
            assert (refused.status, refused.headers["Content-Type"]) == (429, "application/problem+json")
            assert 1 <= int(refused.headers["Retry-After"]) <= 101
            for path in ("/api/v1/robots/rover/stop", "/api/v1/robots/rover/services/relay/stop"):
                for _ in range(3):
                    assert ask(relay.http_port, "POST", path, {}, token=token).status == 200
            order = {"robots": ["rover"], "do": "stop"}
            assert ask(relay.http_port, "POST", "/api/v1/fleet", order, token=token).status == 200
            assert robot.stopped is not None
        finally:
            robot.goes()
    finally:
        relay.stop()
