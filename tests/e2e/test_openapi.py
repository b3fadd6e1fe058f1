"""The HTTP API against its own description: schemathesis asks a real relay with a robot all that is described.

Left out is what has no end that one could wait for (streams, websockets, files; ``lasts`` says why of each), and what
would have the relay send something to another machine.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

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
from switchboard_http import ask
from switchboard_relay import Relay
from switchboard_small_robot import SmallRobot
from switchboard_waiting import wait_for

from relay_server.http.openapi.document import document
from relay_server.http.openapi.http import operations
from relay_server.http.openapi.operation import Credential

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
    "key": ["swp_nobody", "%"],
    "robot": ["arm", "nobody"],
}
"""Names in addresses of the realm."""

MOMENT = "switchboard-moment"

SHORT = 0.2
"""Longest that a request waits for something, seconds."""


def starts(robot: SmallRobot, args: Any) -> dict[str, Any]:
    """A service that succeeds."""
    return {"success": True, "message": "it starts"}


def closed(schema: dict[str, Any]) -> dict[str, Any]:
    """What is answered has no field that is not described."""
    return {**schema, "additionalProperties": False} if schema.get("properties") else schema


def asked() -> dict[str, Any]:
    """The description, narrowed to what a test can ask in its time; of answers nothing is left open."""
    told = copy.deepcopy(document(operations(), "1", "session"))
    sent: set[str] = set()
    for path, methods in list(told["paths"].items()):
        for method, each in list(methods.items()):
            if "x-lasts" in each:
                del methods[method]
                continue
            body = each.get("requestBody", {})
            # RDF is written by hand in its own tests.
            body.get("content", {}).pop("text/turtle", None)
            for media in ("application/rdf+xml", "application/ld+json"):
                body.get("content", {}).pop(media, None)
            sent |= {
                str(of["schema"].get("$ref", "")).rpartition("/")[2]
                for of in body.get("content", {}).values()
            }
            # Of all values none but the relay's own is a moment.
            given = [one for one in each.get("parameters", []) if one["name"] != MOMENT]
            each["parameters"] = given
            for parameter in given:
                narrow(parameter)
                if path.startswith("/api/v1/realm") and parameter["name"] in IN_REALM:
                    # Not the user who asks, nor the robot that all others ask about.
                    parameter["schema"] = {"enum": IN_REALM[parameter["name"]]}
        if not methods:
            del told["paths"][path]
    schemas = told["components"]["schemas"]
    for name in schemas.keys() - sent - {"VideoSettings"}:
        schemas[name] = closed(schemas[name])
    for name in ("Call", "Order"):
        schemas[name]["properties"]["timeout"]["maximum"] = SHORT
    schemas["Order"]["properties"]["robots"]["items"] = {"enum": ["rover", "r*", "nobody", "group:all"]}
    # Nothing leaves the machine.
    schemas["RuleRequest"]["properties"]["channel"] = {"enum": ["portal", "apprise", "pigeon"]}
    return told


def narrow(parameter: dict[str, Any]) -> None:
    """Have a parameter name what there is, and wait for nothing."""
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
class House:
    """A relay with a robot, somebody who owns it and administers the relay, and somebody who may only look.

    :ivar spare: a token that may end
    :ivar viewers: of who may only look, and one that may end
    """

    relay: Relay
    token: str
    spare: str
    viewers: tuple[str, str]
    session: requests.Session = field(default_factory=requests.Session)

    @property
    def url(self) -> str:
        """Where the relay is."""
        return f"http://127.0.0.1:{self.relay.http_port}"


@pytest.fixture(scope="module")
def house(tmp_path_factory: pytest.TempPathFactory) -> Iterator[House]:
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
            house = House(relay, token, relay.token("ann"), (viewer, relay.token("vic")))
            yield house
            house.session.close()
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
    """Somebody who knows what there is, and gives back the moment of the latest answer."""

    house: House
    moment: dict[str, str] = field(default_factory=dict)

    def __call__(self, method: str, path: str, body: Any = None, **named: str) -> Any:
        """Ask for something, see that the answer is as described, and give what is in it.

        :param named: what stands in the address
        """
        given = {} if body is None else {"body": body, "media_type": "application/json"}
        if path.startswith("/oauth"):
            given["media_type"] = "application/x-www-form-urlencoded"
        case = SCHEMA[path][method].Case(path_parameters={"robot": "rover", **named}, **given)
        proof = {"Authorization": f"Bearer {self.house.token}"} if path != "/oauth/token" else {}
        answer = case.call(
            base_url=self.house.url, headers={**proof, **self.moment}, session=self.house.session
        )
        assert answer.status_code < 300, answer.text
        if MOMENT in answer.headers:
            self.moment[MOMENT] = answer.headers[MOMENT][0]
        case.validate_response(answer, checks=CHECKS)
        return answer.json() if answer.content else None


def test_what_is_asked_rightly_is_answered_as_described(house: House) -> None:
    """Alerts, rules, recordings, events, orders and tokens from their beginning to their end."""
    visit, robot = Visit(house), "/api/v1/robots/{robot}"
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
    base = visit("GET", f"{robot}/modules/{{name}}", name="base")
    assert base in visit("GET", f"{robot}/modules")["modules"] and base["subscribes"] == ["/mode"]
    with house.relay.connect("rover", house.token):
        assert visit("GET", f"{robot}/people")["people"][0]["user"] == "ann"
    administer(visit, "/api/v1/realm")
    login = {"grant_type": "password", "username": "ann", "password": "correct horse"}
    token = visit("POST", "/oauth/token", login)["access_token"]
    assert visit("POST", "/oauth/introspect", {"token": token})["active"]
    visit("POST", "/oauth/revoke", {"token": token})


def administer(visit: Visit, realm: str) -> None:
    """All that there is in a realm, from its beginning to its end."""
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
    told = visit("PATCH", f"{realm}/robots/{{name}}", {"description": "on the bench"}, name="arm")
    assert told["description"] == "on the bench"
    programs = f"{realm}/users/{{name}}/programs"
    program = visit("POST", programs, {"label": "reader", "scope": "viewer"}, name="bob")
    assert program.pop("secret") and visit("GET", programs, name="bob")["programs"] == [program]
    visit("DELETE", f"{realm}/programs/{{key}}", key=program["key"])
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
    """So many of each operation, always the same."""
    return settings(
        max_examples=most,
        derandomize=True,
        database=None,
        deadline=None,
        suppress_health_check=list(HealthCheck),
    )


def see_described(case: Any, house: House, token: str, spare: str) -> None:
    """Ask, and see that the answer is one of those that are described.

    :param spare: for what ends the token that is sent
    """
    ends = (case.method, case.path) == ("DELETE", "/api/v1/session")
    headers = {"Authorization": f"Bearer {spare if ends else token}"}
    answer = case.call(base_url=house.url, headers=headers, session=house.session)
    assert answer.status_code not in (500, 501, 502), answer.text
    case.validate_response(answer, checks=CHECKS)


@SCHEMA.parametrize()
@examples(EXAMPLES)
def test_no_answer_is_undocumented(case: Any, house: House) -> None:
    """Whatever is asked, right or wrong: no failure, no status, media type or field that is not described."""
    see_described(case, house, house.token, house.spare)


@SCHEMA.parametrize()
@examples(FEWER)
def test_no_refusal_is_undocumented(case: Any, house: House) -> None:
    """Nor is what somebody is told who may only look."""
    see_described(case, house, *house.viewers)


def test_every_operation_has_its_address(house: House) -> None:
    """Who proves nobody is told so, where something has to be proved; nowhere is nothing."""
    for each in operations():
        # A word that there is; all else is asked about only by who has proved himself.
        path = each.path.replace("{name}", "fields").replace("{", "").replace("}", "")
        answer = ask(house.relay.http_port, each.method, path)
        assert answer.status not in (404, 405, 500), each
        if each.credential in (Credential.USER, Credential.VIEWER, Credential.ASKER):
            assert answer.status in (400, 401, 426), (each, answer.body)


@pytest.mark.parametrize("width", [390, 1280])
def test_the_page_is_for_phones_and_desks(browser: Browser, house: House, width: int) -> None:
    """It needs nothing of other hosts, breaks no rule of the relay's policy, and is no wider than the screen, however
    much of it is open."""
    page = browser.new_page(viewport={"width": width, "height": 800})
    try:
        asked, said = list[str](), list[str]()
        page.on("request", lambda request: asked.append(request.url))
        page.on("console", lambda message: said.append(message.text))
        page.goto(f"{house.url}/api/docs")
        operation = page.locator("#post_robots_by_robot_stop")
        operation.locator("summary").click()
        expect(operation.get_by_text("application/problem+json").first).to_be_visible()
        operation.get_by_role("link", name="StopAnswer").first.click()
        expect(page.locator("#type-StopAnswer")).to_be_visible()
        page.evaluate("document.querySelectorAll('details').forEach(each => { each.open = true })")
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        assert all(each.startswith(house.url) for each in asked)
        assert not [each for each in said if "Content Security Policy" in each]
    finally:
        page.close()


def test_requests_are_limited_and_stops_are_not(tmp_path: Path) -> None:
    """With a real clock and a real robot: what is left is told, and a stop passes when nothing is."""
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
