"""One robot in two realms: a real relay and robot, users of both realms, and an OAuth client for both."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus

from tests.worlds.http_requests import Answer, ask, log_in
from tests.worlds.relay_process import Relay
from tests.worlds.robot_process import Robot
from tests.worlds.sync_client import Client
from tests.worlds.waiting import PATIENCE, wait_for

PASSWORD = "correct horse"
HERE = "/api/v1/robots/mobile"


class World:
    """Realms lab1 and lab2, each with its own user ``toad``, and a robot ``mobile`` of lab1."""

    def __init__(self, folder: Path) -> None:
        self.relay = Relay(folder)
        for lab in ("lab1", "lab2"):
            self.relay.cli("realm", "add", lab)
        self.tokens = {f"toad@{lab}": self.relay.user(f"toad@{lab}") for lab in ("lab1", "lab2")}
        self.tokens["root@lab2"] = self.relay.user("root@lab2", admin=True)
        self.robot = Robot(self.relay, "mobile@lab1")
        self.relay.cli("right", "grant", "toad@lab1", "mobile@lab1", "operator")

    def ask(self, who: str, method: str, path: str, body: Any = None) -> Answer:
        """The answer to a user's request."""
        return ask(self.relay.http_port, method, path, body, token=self.tokens[who])

    def connect(self, who: str) -> Client:
        """A user's connection to the robot."""
        return self.relay.connect("mobile", self.tokens[who])

    def share(self, level: str = "operator") -> None:
        """Shares the robot with lab2, where toad gets a right on it."""
        self.relay.cli("robot", "share", "mobile@lab1", "lab2")
        self.relay.cli("right", "grant", "toad@lab2", "mobile@lab2", level)
        wait_for("it is seen there", lambda: self.ask("toad@lab2", "GET", HERE + "/control").status == 200)

    def unshare(self) -> None:
        """Ends the sharing."""
        self.relay.cli("robot", "unshare", "mobile@lab1", "lab2", "--yes")

    def events(self, who: str, kind: str) -> list[dict[str, Any]]:
        """Events in the user's realm, newest first."""
        found: list[dict[str, Any]] = self.ask(who, "GET", f"/api/v1/events?kind={kind}&limit=100").json[
            "events"
        ]
        return found

    def stop(self) -> None:
        self.robot.stop()
        self.relay.stop()


@pytest.fixture(scope="module")
def two_realms(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    """Both realms, for all tests."""
    made = World(tmp_path_factory.mktemp("shared"))
    yield made
    made.stop()


@pytest.fixture
def world(two_realms: World) -> Iterator[World]:
    """The robot is shared for one test."""
    two_realms.share()
    yield two_realms
    if two_realms.relay.cli("robot", "list", "--realm", "lab2"):
        two_realms.unshare()


def test_users_of_both_realms_reach_the_robot(world: World) -> None:
    """By the same name, over websocket and HTTP, with each user's rights."""
    for who in ("toad@lab1", "toad@lab2"):
        with world.connect(who) as client:
            client.send(op="subscribe", topic="/odom", type="nav_msgs/msg/Odometry")
            client.until(op="publish", topic="/odom")
        names = [each["name"] for each in world.ask(who, "GET", "/api/v1/robots").json["robots"]]
        assert names == ["mobile"]
    levels = {
        who: world.ask(who, "GET", "/api/v1/robots").json["robots"][0]["level"]
        for who in ("toad@lab2", "root@lab2")
    }
    assert levels == {"toad@lab2": "operator", "root@lab2": "owner"}
    (entry,) = [
        each
        for each in world.ask("toad@lab2", "GET", "/api/v1/directory?kind=robot").json["entries"]
        if each["name"] == "mobile"
    ]
    assert world.ask("toad@lab2", "GET", entry["address"]).json["name"] == "mobile"


def test_control_is_held_by_one_user_of_all_realms(world: World) -> None:
    """The controller is shown by full name; control is handed over between realms, and both have the events."""
    with world.connect("toad@lab1") as one, world.connect("toad@lab2") as two:
        wait_for("control is taken", lambda: one.call("/relay/take_control")["values"]["success"])
        reported = world.ask("toad@lab2", "GET", HERE + "/control").json
        assert (reported["holder"]["user"], reported["holder"]["you"]) == ("toad@lab1", False)
        assert world.ask("toad@lab1", "GET", HERE + "/control").json["holder"]["you"]
        assert "toad@lab1" in two.call("/relay/take_control", {"why": "my turn"})["values"]["message"]
        asked = world.ask("toad@lab1", "GET", HERE + "/control").json["request"]
        assert (asked["user"], asked["why"]) == ("toad@lab2", "my turn")
        assert one.call("/relay/grant_control")["values"]["success"]
        wait_for(
            "the other has it",
            lambda: world.ask("toad@lab2", "GET", HERE + "/control").json["holder"]["you"],
        )
        people = world.ask("toad@lab1", "GET", HERE + "/people").json["people"]
        assert {(each["user"], each["you"], each["control"]) for each in people} == {
            ("toad@lab1", True, False),
            ("toad@lab2", False, True),
        }
        assert two.call("/relay/release_control")["values"]["success"]

    def by_whom(who: str) -> set[tuple[Any, Any]]:
        granted = world.events(who, "control.granted")
        return {(each["user"], each["data"].get("by")) for each in granted}

    wait_for("both remember it", lambda: by_whom("toad@lab1") and by_whom("toad@lab2"))
    assert by_whom("toad@lab1") == {("toad", None)}
    assert by_whom("toad@lab2") == {(None, "toad@lab1")}


def test_users_of_either_realm_stop_it(world: World) -> None:
    """It stands for both, and both see the user."""
    world.relay.cli("right", "grant", "toad@lab2", "mobile@lab2", "viewer")
    stopped = world.ask("toad@lab2", "POST", HERE + "/stop", {"why": "in the way"})
    assert stopped.status == 200, stopped.body
    for who in ("toad@lab1", "toad@lab2"):
        reported = world.ask(who, "GET", HERE + "/control").json["stopped"]
        assert (reported["by"], reported["why"]) == ("toad@lab2", "in the way")
    world.relay.cli("resume", "mobile@lab1")
    fleet = world.ask("root@lab2", "POST", "/api/v1/fleet", {"robots": ["*"], "do": "stop"})
    assert '"mobile"' in fleet.body.decode()
    reported = world.ask("toad@lab1", "GET", HERE + "/control").json["stopped"]
    assert reported["by"] == "root@lab2"
    world.relay.cli("resume", "mobile@lab1")

    def actors() -> set[str]:
        entries = world.relay.cli("audit", "list", "--limit", "1000")
        return {each["actor"] for each in entries if each["target"] == "mobile@lab1"}

    wait_for("both are in the audit log", lambda: {"user:toad@lab2", "user:root@lab2"} <= actors())


def test_unshared_robots_stay_apart(world: World) -> None:
    """Events, entries and recordings of a realm's users about the robot belong to that realm."""
    event = {"kind": "coffee", "robot": "mobile", "data": {"cups": 2}}
    assert world.ask("toad@lab1", "POST", "/api/v1/events", event).status in (200, 201)
    entry = {
        "kind": "service",
        "name": "speech",
        "robot": "mobile",
        "address": "http://10.0.0.9/",
        "ttl": 600,
    }
    assert world.ask("toad@lab1", "POST", "/api/v1/directory", entry).status == 201
    body = {"topics": ["/odom"], "seconds": 60, "megabytes": 1}
    recording = world.ask("toad@lab1", "POST", HERE + "/recordings", body)
    assert recording.status in (200, 201), recording.body
    place = f"{HERE}/recordings/{recording.json['id']}"
    for who, there in (("toad@lab1", 1), ("toad@lab2", 0), ("root@lab2", 0)):
        assert len(world.events(who, "coffee")) == there
        found = world.ask(who, "GET", "/api/v1/directory?kind=service&name=speech").json["entries"]
        assert len(found) == there
        assert len(world.ask(who, "GET", HERE + "/recordings").json["recordings"]) == there
        assert world.ask(who, "GET", place).status == (200 if there else 404)
    assert world.ask("toad@lab1", "DELETE", place).status in (200, 204)
    names = {"mobile@lab2"}
    assert names.isdisjoint(each["robot"] for each in world.relay.cli("right", "list"))


def test_user_without_rights_is_cut_at_once(world: World) -> None:
    """Without the sharing the rights end: connections are closed, and the robot is not found."""
    with world.connect("toad@lab2") as client, world.connect("toad@lab1") as other:
        client.call("/rosapi/topics")
        wait_for("control is taken", lambda: client.call("/relay/take_control")["values"]["success"])
        world.unshare()
        with pytest.raises(ConnectionClosed):
            while True:
                client.receive()
        assert other.call("/rosapi/topics")["result"]
    for path in ("", "/control", "/topics", "/recordings"):
        there, nowhere = (
            world.ask("root@lab2", "GET", f"/api/v1/robots/{name}{path}") for name in ("mobile", "nobody")
        )
        assert (there.status, there.json["detail"]) == (nowhere.status, nowhere.json["detail"])
    assert world.ask("root@lab2", "GET", "/api/v1/robots").json["robots"] == []
    with pytest.raises(InvalidStatus):
        world.connect("toad@lab2")
    wait_for(
        "control is free", lambda: world.ask("toad@lab1", "GET", HERE + "/control").json["holder"] is None
    )
    lost = wait_for(
        "the loss is on record",
        lambda: [
            each
            for each in world.relay.cli("audit", "list", "--limit", "1000")
            if each["action"] == "control.lost"
        ],
    )
    assert lost[-1]["actor"] == "user:toad@lab2"
    # Events are written some time after the audit.
    events = wait_for("the loss is an event", lambda: world.events("toad@lab1", "control.lost"))
    assert {each["data"].get("by") for each in events} <= {"toad@lab2", None}
    assert events[0]["user"] is None
    # A new sharing needs new rights.
    world.relay.cli("robot", "share", "mobile@lab1", "lab2")
    wait_for("its owner sees it", lambda: world.ask("root@lab2", "GET", "/api/v1/robots").json["robots"])
    assert world.ask("toad@lab2", "GET", "/api/v1/robots").json["robots"] == []


def test_both_realms_are_notified_of_the_removal(world: World) -> None:
    """There is one alert, and both see who acknowledged it."""
    world.robot.daemon.kill()

    def gone(who: str) -> list[dict[str, Any]]:
        found: list[dict[str, Any]] = world.ask(who, "GET", "/api/v1/alerts?open=true").json["alerts"]
        return [each for each in found if each["kind"] == "offline"]

    try:
        for who in ("toad@lab1", "toad@lab2"):
            (alert,) = wait_for("it is told", lambda who=who: gone(who))
            assert alert["robot"] == "mobile"
        assert world.ask("toad@lab2", "POST", f"/api/v1/alerts/{alert['id']}/acknowledge", {}).status == 200
        (seen,) = gone("toad@lab1")
        assert "toad@lab2" in str(seen["acknowledged"])
    finally:
        world.robot.start_daemon()
        world.robot.wait_online()
    for who in ("toad@lab1", "toad@lab2"):
        wait_for("it is remembered", lambda who=who: world.events(who, "robot.offline"))


def test_a_realms_administrator_does_not_administer_what_is_anothers(world: World) -> None:
    """They give rights on a robot that is shared with their realm, but neither enrol nor remove it. They
    cannot set a guest's password, nor learn where to.
    """
    realm = "/api/v1/realm"
    (robot,) = world.ask("root@lab2", "GET", f"{realm}/robots").json["robots"]
    assert (robot["robot"], robot["guest"]) == ("mobile", True)
    for method, path in (("POST", "/code"), ("DELETE", ""), ("DELETE", "/keys/" + "0" * 16)):
        answer = world.ask("root@lab2", method, f"{realm}/robots/mobile{path}")
        assert answer.status == 403, (path, answer.body)
    right = world.ask("root@lab2", "PUT", f"{realm}/rights/mobile/toad", {"level": "viewer"})
    assert right.status in (200, 201), right.body
    held = world.ask("root@lab2", "GET", f"{realm}/rights").json["rights"]
    assert [(each["holder"], each["level"]) for each in held] == [("toad", "viewer")]
    world.relay.user("peach@lab1")
    world.relay.cli("user", "join", "peach@lab1", "lab2")
    assert world.ask("root@lab2", "GET", f"{realm}/users/peach").json["guest"]
    refused = world.ask("root@lab2", "PATCH", f"{realm}/users/peach", {"password": "another one"})
    assert refused.status == 403
    assert b"lab1" not in refused.body
    world.relay.cli("user", "remove", "peach@lab1", "--yes")


def test_a_user_has_an_account_in_each_realm(two_realms: World) -> None:
    """One password for both; it authenticates in the named realm, until the user is disabled at home."""
    relay = two_realms.relay
    relay.user("luigi@lab2")
    relay.cli("user", "join", "luigi@lab2", "lab1")
    relay.cli("right", "grant", "luigi@lab1", "mobile@lab1", "viewer")
    origin = {"Origin": f"http://127.0.0.1:{relay.http_port}"}
    seen = {}
    for realm in ("lab1", "lab2"):
        cookie = log_in(relay.http_port, f"luigi@{realm}", PASSWORD)
        reported = ask(relay.http_port, "GET", "/api/v1/session", headers={"Cookie": cookie, **origin}).json
        assert (reported["user"], reported["realm"]) == ("luigi", realm)
        robots = ask(relay.http_port, "GET", "/api/v1/robots", headers={"Cookie": cookie, **origin}).json
        seen[realm] = [each["name"] for each in robots["robots"]]
    assert seen == {"lab1": ["mobile"], "lab2": []}
    with relay.connect("mobile", relay.token("luigi@lab1")) as client:
        client.call("/rosapi/topics")
        relay.cli("user", "disable", "luigi@lab2")
        with pytest.raises(ConnectionClosed):
            while True:
                client.receive()
    relay.cli("user", "remove", "luigi@lab2", "--yes")
    assert "luigi@lab1" not in {each["user"] for each in relay.cli("user", "list")}


def test_an_oauth_client_acts_in_each_realm_of_its_user(two_realms: World) -> None:
    """It requests a token of a realm; a realm without an account of its user is refused like a missing one."""
    relay = two_realms.relay
    relay.user("bot@lab2")
    relay.cli("user", "join", "bot@lab2", "lab1")
    relay.cli("right", "grant", "bot@lab1", "mobile@lab1", "viewer")
    oauth_client = relay.cli("oauth-client", "add", "bot@lab2", "--label", "watcher")
    auth = httpx.DigestAuth(oauth_client["key"], oauth_client["secret"])

    def token(http: httpx.Client, **realm: str) -> httpx.Response:
        return http.post("/oauth/token", data={"grant_type": "client_credentials", **realm}, auth=auth)

    with httpx.Client(base_url=f"http://127.0.0.1:{relay.http_port}", timeout=PATIENCE) as http:
        for realm, robots in (({}, []), ({"realm": "lab2"}, []), ({"realm": "lab1"}, ["mobile"])):
            bearer = {"Authorization": f"Bearer {token(http, **realm).json()['access_token']}"}
            reported = http.get("/api/v1/robots", headers=bearer).json()["robots"]
            assert [each["name"] for each in reported] == robots
        refused = [token(http, realm=realm).json() for realm in ("default", "lab9")]
        assert refused[0] == refused[1]
        assert refused[0]["error"] == "invalid_target"
        relay.cli("user", "remove", "bot@lab1", "--yes")
        wait_for(
            "its token is worthless", lambda: http.get("/api/v1/robots", headers=bearer).status_code == 401
        )
    relay.cli("user", "remove", "bot@lab2", "--yes")
