"""Two realms on one relay: both may use the same names, and neither can see, reach or infer resources of the
other.
"""

from __future__ import annotations

import http.client
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from websockets.exceptions import InvalidStatus

from relay_server.http.openapi.document import document
from relay_server.http.openapi.http import operations
from tests.worlds.http_requests import ROBOT_BODIES, Answer, ask, log_in
from tests.worlds.relay_process import Relay
from tests.worlds.robot_process import Robot
from tests.worlds.small_robot import SmallRobot
from tests.worlds.waiting import wait_for

PASSWORD = "correct horse"
LABS = ("lab1", "lab2")


class World:
    """A relay with two realms. Each has a robot ``mobile``, an operator ``toad`` and an administrator ``root``; the
    second also has a robot ``secret`` and a user ``mole``.
    """

    def __init__(self, folder: Path) -> None:
        self.relay = Relay(folder)
        self.tokens: dict[str, str] = {}
        self.robots: dict[str, SmallRobot] = {}
        for lab in LABS:
            self.relay.cli("realm", "add", lab)
            self.tokens[f"toad@{lab}"] = self.relay.user(f"toad@{lab}")
            self.tokens[f"root@{lab}"] = self.relay.user(f"root@{lab}", admin=True)
            self.enter(f"mobile@{lab}")
            self.relay.cli("right", "grant", f"toad@{lab}", f"mobile@{lab}", "operator")
        self.tokens["mole@lab2"] = self.relay.user("mole@lab2")
        self.enter("secret@lab2")

    def enter(self, name: str) -> None:
        """A robot that answers ``/where`` connects."""
        self.robots[name] = SmallRobot(self.relay, name, {"/where": lambda *_: {"message": name}}).comes()

    def ask(self, who: str, method: str, path: str, body: Any = None, **headers: str) -> Answer:
        """The answer to a user's request."""
        sent = {name.replace("_", "-"): value for name, value in headers.items()}
        return ask(self.relay.http_port, method, path, body, headers=sent, token=self.tokens[who])

    def stop(self) -> None:
        for each in self.robots.values():
            each.goes()
        self.relay.stop()


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    """Both realms, for all tests."""
    made = World(tmp_path_factory.mktemp("realms"))
    yield made
    made.stop()


# --- names ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("lab", LABS)
def test_a_name_belongs_to_the_callers_realm(world: World, lab: str) -> None:
    """Both toads call a service of ``mobile``, by websocket and over HTTP, and each reaches the robot of
    their own realm.
    """
    who, robot = f"toad@{lab}", world.robots[f"mobile@{lab}"]
    before = len(robot.calls)
    with world.relay.connect("mobile", world.tokens[who]) as client:
        assert client.call("/where")["values"]["message"] == f"mobile@{lab}"
    answer = world.ask(who, "POST", "/api/v1/robots/mobile/services/where", {})
    assert (answer.status, answer.json["values"]["message"]) == (200, f"mobile@{lab}")
    assert len(robot.calls) == before + 2


@pytest.mark.parametrize("lab", LABS)
def test_users_see_the_robots_of_their_realm(world: World, lab: str) -> None:
    """An administrator sees all of them, an operator those with a right; no user sees robots of another
    realm.
    """
    of_root = {"lab1": {"mobile"}, "lab2": {"mobile", "secret"}}[lab]
    for who, expected in ((f"root@{lab}", of_root), (f"toad@{lab}", {"mobile"})):
        reported = world.ask(who, "GET", "/api/v1/robots").json["robots"]
        assert {each["name"] for each in reported} == expected


def test_a_name_without_a_realm_is_of_the_default_one(world: World) -> None:
    """There is no toad in it, and the robot's operator cannot log in with the bare name."""
    port = world.relay.http_port
    origin = {"Origin": f"http://127.0.0.1:{port}"}
    for user in ("toad", "toad@lab2x", "toad@", "toad@lab1@lab2"):
        body = {"user": user, "password": PASSWORD}
        answer = ask(port, "POST", "/api/v1/session", body, headers=origin)
        assert (answer.status, answer.json["code"]) == (401, "bad_credentials"), user
    cookie = log_in(port, "Toad@LAB1", PASSWORD)
    reported = ask(port, "GET", "/api/v1/session", headers={"Cookie": cookie, **origin}).json
    assert (reported["user"], reported["realm"], reported["admin"]) == ("toad", "lab1", False)


def test_oauth_knows_realms(world: World) -> None:
    """A token for the password of ``toad@lab1`` belongs to that realm; elsewhere it is neither known nor
    revoked.
    """
    port = world.relay.http_port
    form = {"Content-Type": "application/x-www-form-urlencoded"}
    granted = _form(port, "/oauth/token", f"grant_type=password&username=toad@lab1&password={PASSWORD}", form)
    assert granted.status == 200, granted.body
    token = granted.json["access_token"]
    for who, active in (("toad@lab1", True), ("root@lab2", False), ("toad@lab2", False)):
        asking = {**form, "Authorization": f"Bearer {world.tokens[who]}"}
        assert _form(port, "/oauth/introspect", f"token={token}", asking).json["active"] is active
    stranger = {**form, "Authorization": f"Bearer {world.tokens['root@lab2']}"}
    assert _form(port, "/oauth/revoke", f"token={token}", stranger).status == 200
    assert ask(port, "GET", "/api/v1/robots", token=token).status == 200
    own = {**form, "Authorization": f"Bearer {world.tokens['toad@lab1']}"}
    reported = _form(port, "/oauth/introspect", f"token={token}", own).json
    assert (reported["sub"], reported["realm"]) == ("toad@lab1", "lab1")


def _form(port: int, path: str, body: str, headers: dict[str, str]) -> Answer:
    """An OAuth form."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=30)
    try:
        connection.request("POST", path, body.replace(" ", "+"), headers)
        return Answer(connection.getresponse())
    finally:
        connection.close()


# --- isolation --------------------------------------------------------------------------------------------

SAID_TO_ALL = {
    ("get", "/robots/{robot}"),
    ("get", "/robots/{robot}/video/ws"),
    ("get", "/robots/{robot}/video/stream_viewer"),
    ("get", "/api/v1/robots/{robot}/goals/{id}"),
    ("delete", "/api/v1/robots/{robot}/goals/{id}"),
    ("post", "/api/v1/robots/{robot}/goals/{id}/cancel"),
}
"""What is no question of the robot: what speaks at a websocket's address, a page that shows what is asked for, and
one's own goals, of which there is none.
"""


def of_a_robot() -> list[tuple[str, str]]:
    """All operations of the HTTP API on a robot, by its own description."""
    paths = document(operations(), "1", "session")["paths"]
    return [(method, path) for path in paths if "{robot}" in path for method in paths[path]]


@pytest.mark.parametrize(("method", "path"), of_a_robot())
def test_a_robot_of_another_realm_is_not_found(world: World, method: str, path: str) -> None:
    """For each request the answer equals that for a missing name, not that of the own robot."""
    moment = world.ask("root@lab1", "GET", "/api/v1/robots/mobile/services").headers["switchboard-freshness"]

    def answer(name: str) -> Answer:
        at = path.replace("{robot}", name).replace("{name}", "mode").replace("{id}", "0" * 32)
        query = "?topic=/camera" if path.startswith("/robots/") else ""
        end = path.partition("{robot}/")[2]
        body = None if method == "get" else ROBOT_BODIES.get(end, {})
        return world.ask("root@lab1", method.upper(), at + query, body, switchboard_freshness=moment)

    others, nobodys, own = (answer(name) for name in ("secret", "nobody", "mobile"))
    assert _without_names(others) == _without_names(nobodys)
    assert (_without_names(own)[:2] != _without_names(others)[:2]) is ((method, path) not in SAID_TO_ALL)
    if path.endswith("/stop"):
        world.relay.cli("resume", "mobile@lab1")


def _without_names(answer: Answer) -> tuple[Any, ...]:
    """An answer without its varying parts: the requested name, and the time."""
    changing = {"date", "switchboard-freshness", "ratelimit", "ratelimit-policy", "content-length"}
    headers = sorted((name.lower(), value) for name, value in answer.headers.items())
    body = re.sub(rb"secret|nobody|mobile", b"*", answer.body)
    return answer.status, body, [each for each in headers if each[0] not in changing]


def test_a_websocket_does_not_disclose_that_a_robot_exists(world: World) -> None:
    """The refusal equals that for a missing name."""
    reported = []
    for name in ("secret", "nobody"):
        with pytest.raises(InvalidStatus) as refused:
            world.relay.connect(name, world.tokens["root@lab1"])
        body = refused.value.response.body or b""
        reported.append((refused.value.response.status_code, re.sub(rb"secret|nobody", b"*", body)))
    assert reported[0] == reported[1]


def test_registrations_stay_in_their_realm(world: World) -> None:
    """The service registry of one realm shows no entries of the other, whose addresses are not found."""
    entry = {"kind": "service", "name": "speech", "address": "http://10.0.0.9/", "ttl": 600}
    made = world.ask("toad@lab2", "POST", "/api/v1/directory", entry)
    assert made.status == 201
    assert _names(world.ask("mole@lab2", "GET", "/api/v1/directory?kind=service")) == ["speech"]
    assert _names(world.ask("mole@lab2", "GET", "/api/v1/directory?realm=lab2&kind=service")) == ["speech"]
    for query in ("?kind=service&name=spe*", "?realm=lab2", "?name=speech"):
        assert _names(world.ask("root@lab1", "GET", f"/api/v1/directory{query}")) == []
    place = made.headers["Location"]
    strange = re.sub(r"[^/]+$", lambda found: found[0][::-1], place)
    there, nowhere = (world.ask("root@lab1", "GET", each) for each in (place, strange))
    assert (there.status, there.json["code"]) == (nowhere.status, nowhere.json["code"]) == (404, "not_found")


def _names(answer: Answer) -> list[str]:
    return [each["name"] for each in answer.json["entries"]]


def test_events_are_remembered_in_their_realm(world: World) -> None:
    """Neither events, nor their count, nor their numbers disclose the other realm."""
    numbers = []
    for lab in LABS:
        event = {"kind": "coffee", "data": {"in": lab}}
        numbers.append(world.ask(f"toad@{lab}", "POST", "/api/v1/events", event).json)
    assert [each["data"] for each in numbers] == [{"in": lab} for lab in LABS]
    for lab in LABS:
        reported = world.ask(f"root@{lab}", "GET", "/api/v1/events?kind=coffee&limit=1000").json["events"]
        assert [each["data"] for each in reported] == [{"in": lab}]
        count = world.ask(f"root@{lab}", "GET", "/api/v1/events?kind=coffee&count=true").json["count"]
        assert count == 1
    before = world.ask("toad@lab1", "POST", "/api/v1/events", {"kind": "tick"}).json["id"]
    for _ in range(3):
        world.ask("toad@lab2", "POST", "/api/v1/events", {"kind": "tock"})
    world.ask("toad@lab1", "POST", "/api/v1/events", {"kind": "tick"})
    own = world.ask("root@lab1", "GET", "/api/v1/events?limit=1000").json["events"]
    since = sorted(each["id"] for each in own if each["id"] >= before)
    assert since == list(range(before, before + len(since)))
    assert "tock" not in {each["kind"] for each in own}


def test_a_failed_login_is_logged_in_the_realm_where_it_was_tried(world: World) -> None:
    """For unknown users too; no other realm gets the event, whether the named one exists or not."""
    port = world.relay.http_port
    origin = {"Origin": f"http://127.0.0.1:{port}"}
    for user in ("toad@lab2", "ghost@lab2", "ghost@lab9"):
        body = {"user": user, "password": "wrong"}
        assert ask(port, "POST", "/api/v1/session", body, headers=origin).status == 401

    def tried(who: str) -> set[str]:
        events = world.ask(who, "GET", "/api/v1/events?kind=login.refused&limit=1000").json["events"]
        return {each["data"]["user"] for each in events if "ghost" in each["data"]["user"]}

    wait_for("it is remembered", lambda: tried("root@lab2"))
    assert tried("root@lab2") == {"ghost@lab2"}
    assert tried("root@lab1") == set()


@pytest.mark.parametrize("order", [{"do": "stop"}, {"do": "call", "service": "/where"}])
def test_an_order_to_all_robots_means_those_of_the_callers_realm(world: World, order: dict[str, Any]) -> None:
    """Patterns and names of the other realm count as unmatched."""
    others = [robot for name, robot in world.robots.items() if name.endswith("lab2")]
    calls = [len(robot.calls) for robot in others]
    body = {"robots": ["*", "secret", "nobody"], **order}
    answer = world.ask("root@lab1", "POST", "/api/v1/fleet", body)
    head, *results = [json.loads(line) for line in answer.body.splitlines()]
    assert head["robots"] == ["mobile"]
    assert head["unmatched"] == ["secret", "nobody"]
    assert [(each["robot"], each["ok"]) for each in results if "robot" in each] == [("mobile", True)]
    assert [len(robot.calls) for robot in others] == calls
    assert [robot.stopped for robot in others] == [None, None]
    world.relay.cli("resume", "mobile@lab1")


def test_the_machines_administrator_reaches_all_realms_by_full_names(world: World) -> None:
    """``switchboard stop mobile@lab2`` stops that one, and ``status`` shows full names."""
    reported = world.relay.cli("stop", "mobile@lab2")
    assert [(each["robot"], each["done"]) for each in reported["robots"]] == [("mobile@lab2", True)]
    stopped = {name: robot.stopped is not None for name, robot in world.robots.items()}
    assert stopped == {"mobile@lab1": False, "mobile@lab2": True, "secret@lab2": False}
    world.relay.cli("resume", "mobile@lab2")
    shown = {each["name"] for each in world.relay.cli("status")["robots"]}
    assert shown >= {"mobile@lab1", "mobile@lab2", "secret@lab2"}
    answer = world.relay.cli("robot", "call", "mobile@lab2", "/where")
    assert [(each["robot"], each["values"]["message"]) for each in answer["results"]] == [
        ("mobile@lab2",) * 2
    ]
    assert world.robots["mobile@lab2"].calls


def test_a_daemon_enrols_and_dials_with_its_realm(world: World) -> None:
    """``switchboard-robot`` uses the full name; the realm's administrator sees the short one."""
    robot = Robot(world.relay, "rover@lab2")
    try:
        reported = {
            each["name"]: each["state"]
            for each in world.ask("root@lab2", "GET", "/api/v1/robots").json["robots"]
        }
        assert reported["rover"] == "online"
        of_others = world.ask("root@lab1", "GET", "/api/v1/robots").json["robots"]
        assert [each["name"] for each in of_others] == ["mobile"]
    finally:
        robot.stop()
        world.relay.cli("robot", "remove", "rover@lab2", "--yes")


def test_rights_do_not_cross_realms(world: World) -> None:
    """A right of one realm's user on another's robot is refused with a reason."""
    done = world.relay.run_cli("right", "grant", "toad@lab1", "secret@lab2", "viewer")
    assert done.returncode != 0
    assert "not belong to the realm of the holder" in done.stderr


def test_the_audit_log_names_the_realm(world: World) -> None:
    """Users and robots have their full names."""
    world.relay.cli("stop", "mobile@lab1")
    world.relay.cli("resume", "mobile@lab1")
    assert world.ask("toad@lab1", "POST", "/api/v1/robots/mobile/stop", {"why": "a test"}).status == 200
    world.relay.cli("resume", "mobile@lab1")

    def entries() -> list[dict[str, Any]]:
        reported = world.relay.cli("audit", "list", "--limit", "1000")
        return [each for each in reported if each["actor"] == "user:toad@lab1"]

    wait_for("it is on record", lambda: [each for each in entries() if each["action"] == "robot.stopped"])
    assert {each["target"] for each in entries() if each["action"] == "robot.stopped"} == {"mobile@lab1"}


def test_numbers_of_the_whole_relay_are_for_its_own_administrators(world: World) -> None:
    """Administrators of other realms may not read them, since they count all realms."""
    assert world.ask("root@lab1", "GET", "/metrics").status == 403
    world.tokens["root"] = world.relay.user("root", admin=True)
    assert world.ask("root", "GET", "/metrics").status == 200
    assert world.ask("root", "GET", "/api/v1/robots").json["robots"] == []


def test_a_realm_with_users_is_not_removed(world: World) -> None:
    """An empty one is removed with its events; one with users or robots is refused with a reason."""
    done = world.relay.run_cli("realm", "remove", "lab1", "--yes")
    assert done.returncode != 0
    assert "there are users and robots in the realm 'lab1'" in done.stderr
    world.relay.cli("realm", "add", "lab3")
    token = world.relay.user("ann@lab3")
    assert ask(world.relay.http_port, "POST", "/api/v1/events", {"kind": "x"}, token=token).status == 201
    world.relay.cli("user", "remove", "ann@lab3", "--yes")
    world.relay.cli("realm", "remove", "lab3", "--yes")
    assert {each["realm"] for each in world.relay.cli("realm", "list")} == {"default", "lab1", "lab2"}
    wait_for(
        "her token ends with her",
        lambda: ask(world.relay.http_port, "GET", "/api/v1/events", token=token).status == 401,
    )
