"""One robot in two realms: a real relay and robot, people of both realms, and a program that is of both."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from switchboard_client import Client
from switchboard_http import Answer, ask, log_in
from switchboard_relay import Relay
from switchboard_robot import Robot
from switchboard_waiting import PATIENCE, wait_for
from websockets.exceptions import ConnectionClosed, InvalidStatus

PASSWORD = "correct horse"
HERE = "/api/v1/robots/mobile"


class Labs:
    """Realms lab1 and lab2 with a ``toad`` each, who are two people, and a robot ``mobile`` of lab1."""

    def __init__(self, folder: Path) -> None:
        self.relay = Relay(folder)
        for lab in ("lab1", "lab2"):
            self.relay.cli("realm", "add", lab)
        self.tokens = {f"toad@{lab}": self.relay.user(f"toad@{lab}") for lab in ("lab1", "lab2")}
        self.tokens["root@lab2"] = self.relay.user("root@lab2", admin=True)
        self.robot = Robot(self.relay, "mobile@lab1")
        self.relay.cli("right", "grant", "toad@lab1", "mobile@lab1", "operator")

    def ask(self, who: str, method: str, path: str, body: Any = None) -> Answer:
        """What somebody is answered."""
        return ask(self.relay.http_port, method, path, body, token=self.tokens[who])

    def connect(self, who: str) -> Client:
        """Somebody's connection to the robot."""
        return self.relay.connect("mobile", self.tokens[who])

    def share(self, level: str = "operator") -> None:
        """The robot is one of lab2 too, and its toad has a right on it."""
        self.relay.cli("robot", "share", "mobile@lab1", "lab2")
        self.relay.cli("right", "grant", "toad@lab2", "mobile@lab2", level)
        wait_for("it is seen there", lambda: self.ask("toad@lab2", "GET", HERE + "/control").status == 200)

    def unshare(self) -> None:
        """It is not."""
        self.relay.cli("robot", "unshare", "mobile@lab1", "lab2", "--yes")

    def events(self, who: str, kind: str) -> list[dict[str, Any]]:
        """What somebody finds in the memory of his realm, the newest first."""
        found: list[dict[str, Any]] = self.ask(who, "GET", f"/api/v1/events?kind={kind}&limit=100").json[
            "events"
        ]
        return found

    def stop(self) -> None:
        """End everything."""
        self.robot.stop()
        self.relay.stop()


@pytest.fixture(scope="module")
def house(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Labs]:
    """Both realms, for all tests."""
    made = Labs(tmp_path_factory.mktemp("shared"))
    yield made
    made.stop()


@pytest.fixture
def labs(house: Labs) -> Iterator[Labs]:
    """The robot is shared for one test."""
    house.share()
    yield house
    if house.relay.cli("robot", "list", "--realm", "lab2"):
        house.unshare()


def test_people_of_both_realms_reach_the_robot(labs: Labs) -> None:
    """By the same name, over websocket and HTTP, as far as the rights of each go."""
    for who in ("toad@lab1", "toad@lab2"):
        with labs.connect(who) as client:
            client.send(op="subscribe", topic="/odom", type="nav_msgs/msg/Odometry")
            client.until(op="publish", topic="/odom")
        names = [each["name"] for each in labs.ask(who, "GET", "/api/v1/robots").json["robots"]]
        assert names == ["mobile"]
    levels = {
        who: labs.ask(who, "GET", "/api/v1/robots").json["robots"][0]["level"]
        for who in ("toad@lab2", "root@lab2")
    }
    assert levels == {"toad@lab2": "operator", "root@lab2": "owner"}
    (entry,) = [
        each
        for each in labs.ask("toad@lab2", "GET", "/api/v1/directory?kind=robot").json["entries"]
        if each["name"] == "mobile"
    ]
    assert labs.ask("toad@lab2", "GET", entry["address"]).json["name"] == "mobile"


def test_one_has_control_whatever_the_realm(labs: Labs) -> None:
    """Who has it is called by his full name; it is handed over across the border, and both realms remember it."""
    with labs.connect("toad@lab1") as one, labs.connect("toad@lab2") as two:
        wait_for("control is taken", lambda: one.call("/relay/take_control")["values"]["success"])
        told = labs.ask("toad@lab2", "GET", HERE + "/control").json
        assert (told["holder"]["user"], told["holder"]["you"]) == ("toad@lab1", False)
        assert labs.ask("toad@lab1", "GET", HERE + "/control").json["holder"]["you"]
        assert "toad@lab1" in two.call("/relay/take_control", {"why": "my turn"})["values"]["message"]
        asked = labs.ask("toad@lab1", "GET", HERE + "/control").json["request"]
        assert (asked["user"], asked["why"]) == ("toad@lab2", "my turn")
        assert one.call("/relay/grant_control")["values"]["success"]
        wait_for(
            "the other has it",
            lambda: labs.ask("toad@lab2", "GET", HERE + "/control").json["holder"]["you"],
        )
        people = labs.ask("toad@lab1", "GET", HERE + "/people").json["people"]
        assert {(each["user"], each["you"], each["control"]) for each in people} == {
            ("toad@lab1", True, False),
            ("toad@lab2", False, True),
        }
        assert two.call("/relay/release_control")["values"]["success"]

    def by_whom(who: str) -> set[tuple[Any, Any]]:
        granted = labs.events(who, "control.granted")
        return {(each["user"], each["data"].get("by")) for each in granted}

    wait_for("both remember it", lambda: by_whom("toad@lab1") and by_whom("toad@lab2"))
    assert by_whom("toad@lab1") == {("toad", None)}
    assert by_whom("toad@lab2") == {(None, "toad@lab1")}


def test_anybody_of_either_realm_stops_it(labs: Labs) -> None:
    """It stands for both, and both are told by whom."""
    labs.relay.cli("right", "grant", "toad@lab2", "mobile@lab2", "viewer")
    stopped = labs.ask("toad@lab2", "POST", HERE + "/stop", {"why": "in the way"})
    assert stopped.status == 200, stopped.body
    for who in ("toad@lab1", "toad@lab2"):
        told = labs.ask(who, "GET", HERE + "/control").json["stopped"]
        assert (told["by"], told["why"]) == ("toad@lab2", "in the way")
    labs.relay.cli("resume", "mobile@lab1")
    fleet = labs.ask("root@lab2", "POST", "/api/v1/fleet", {"robots": ["*"], "do": "stop"})
    assert '"mobile"' in fleet.body.decode()
    told = labs.ask("toad@lab1", "GET", HERE + "/control").json["stopped"]
    assert told["by"] == "root@lab2"
    labs.relay.cli("resume", "mobile@lab1")
    assert {"user:toad@lab2", "user:root@lab2"} <= {
        each["actor"]
        for each in labs.relay.cli("audit", "list", "--limit", "1000")
        if each["target"] == "mobile@lab1"
    }


def test_what_is_not_shared_stays_apart(labs: Labs) -> None:
    """What people of one realm write about the robot, register and record is for that realm."""
    event = {"kind": "coffee", "robot": "mobile", "data": {"cups": 2}}
    assert labs.ask("toad@lab1", "POST", "/api/v1/events", event).status in (200, 201)
    entry = {
        "kind": "service",
        "name": "speech",
        "robot": "mobile",
        "address": "http://10.0.0.9/",
        "ttl": 600,
    }
    assert labs.ask("toad@lab1", "POST", "/api/v1/directory", entry).status == 201
    body = {"topics": ["/odom"], "seconds": 60, "megabytes": 1}
    recording = labs.ask("toad@lab1", "POST", HERE + "/recordings", body)
    assert recording.status in (200, 201), recording.body
    place = f"{HERE}/recordings/{recording.json['id']}"
    for who, there in (("toad@lab1", 1), ("toad@lab2", 0), ("root@lab2", 0)):
        assert len(labs.events(who, "coffee")) == there
        found = labs.ask(who, "GET", "/api/v1/directory?kind=service&name=speech").json["entries"]
        assert len(found) == there
        assert len(labs.ask(who, "GET", HERE + "/recordings").json["recordings"]) == there
        assert labs.ask(who, "GET", place).status == (200 if there else 404)
    assert labs.ask("toad@lab1", "DELETE", place).status in (200, 204)
    names = {"mobile@lab2"}
    assert names.isdisjoint(each["robot"] for each in labs.relay.cli("right", "list"))


def test_who_is_let_out_is_cut_at_once(labs: Labs) -> None:
    """With the realm the rights go: what is open is closed, and the robot is one nobody has."""
    with labs.connect("toad@lab2") as client, labs.connect("toad@lab1") as other:
        client.call("/rosapi/topics")
        wait_for("control is taken", lambda: client.call("/relay/take_control")["values"]["success"])
        labs.unshare()
        with pytest.raises(ConnectionClosed):
            while True:
                client.receive()
        assert other.call("/rosapi/topics")["result"]
    for path in ("", "/control", "/topics", "/recordings"):
        there, nowhere = (
            labs.ask("root@lab2", "GET", f"/api/v1/robots/{name}{path}") for name in ("mobile", "nobody")
        )
        assert (there.status, there.json["detail"]) == (nowhere.status, nowhere.json["detail"])
    assert labs.ask("root@lab2", "GET", "/api/v1/robots").json["robots"] == []
    with pytest.raises(InvalidStatus):
        labs.connect("toad@lab2")
    wait_for(
        "control is free", lambda: labs.ask("toad@lab1", "GET", HERE + "/control").json["holder"] is None
    )
    lost = wait_for(
        "the loss is on record",
        lambda: [
            each
            for each in labs.relay.cli("audit", "list", "--limit", "1000")
            if each["action"] == "control.lost"
        ],
    )
    assert lost[-1]["actor"] == "user:toad@lab2"
    assert {each["data"].get("by") for each in labs.events("toad@lab1", "control.lost")} <= {
        "toad@lab2",
        None,
    }
    assert labs.events("toad@lab1", "control.lost")[0]["user"] is None
    # Though it is shared again: rights are given anew.
    labs.relay.cli("robot", "share", "mobile@lab1", "lab2")
    wait_for("its owner sees it", lambda: labs.ask("root@lab2", "GET", "/api/v1/robots").json["robots"])
    assert labs.ask("toad@lab2", "GET", "/api/v1/robots").json["robots"] == []


def test_both_realms_are_told_that_it_is_gone(labs: Labs) -> None:
    """The alert is one, and who acknowledges it is known to both."""
    labs.robot.daemon.kill()

    def gone(who: str) -> list[dict[str, Any]]:
        found: list[dict[str, Any]] = labs.ask(who, "GET", "/api/v1/alerts?open=true").json["alerts"]
        return [each for each in found if each["kind"] == "offline"]

    try:
        for who in ("toad@lab1", "toad@lab2"):
            (alert,) = wait_for("it is told", lambda who=who: gone(who))
            assert alert["robot"] == "mobile"
        assert labs.ask("toad@lab2", "POST", f"/api/v1/alerts/{alert['id']}/acknowledge", {}).status == 200
        (seen,) = gone("toad@lab1")
        assert "toad@lab2" in str(seen["acknowledged"])
    finally:
        labs.robot.start_daemon()
        labs.robot.wait_online()
    for who in ("toad@lab1", "toad@lab2"):
        wait_for("it is remembered", lambda who=who: labs.events(who, "robot.offline"))


def test_a_realms_administrator_does_not_administer_what_is_anothers(labs: Labs) -> None:
    """He gives rights on a robot that is shared with his realm, and neither enrols nor removes it; nor has a guest of
    his realm another password by him, or learns where that is changed.
    """
    realm = "/api/v1/realm"
    (robot,) = labs.ask("root@lab2", "GET", f"{realm}/robots").json["robots"]
    assert (robot["robot"], robot["guest"]) == ("mobile", True)
    for method, path in (("POST", "/code"), ("DELETE", ""), ("DELETE", "/keys/" + "0" * 16)):
        answer = labs.ask("root@lab2", method, f"{realm}/robots/mobile{path}")
        assert answer.status == 403, (path, answer.body)
    right = labs.ask("root@lab2", "PUT", f"{realm}/rights/mobile/toad", {"level": "viewer"})
    assert right.status in (200, 201), right.body
    held = labs.ask("root@lab2", "GET", f"{realm}/rights").json["rights"]
    assert [(each["holder"], each["level"]) for each in held] == [("toad", "viewer")]
    labs.relay.user("peach@lab1")
    labs.relay.cli("user", "join", "peach@lab1", "lab2")
    assert labs.ask("root@lab2", "GET", f"{realm}/users/peach").json["guest"]
    refused = labs.ask("root@lab2", "PATCH", f"{realm}/users/peach", {"password": "another one"})
    assert refused.status == 403
    assert b"lab1" not in refused.body
    labs.relay.cli("user", "remove", "peach@lab1", "--yes")


def test_one_person_has_an_account_in_each_realm(house: Labs) -> None:
    """One password; what it opens is of the realm that was named, and ends when the person is shut out at home."""
    relay = house.relay
    relay.user("luigi@lab2")
    relay.cli("user", "join", "luigi@lab2", "lab1")
    relay.cli("right", "grant", "luigi@lab1", "mobile@lab1", "viewer")
    origin = {"Origin": f"http://127.0.0.1:{relay.http_port}"}
    seen = {}
    for realm in ("lab1", "lab2"):
        cookie = log_in(relay.http_port, f"luigi@{realm}", PASSWORD)
        told = ask(relay.http_port, "GET", "/api/v1/session", headers={"Cookie": cookie, **origin}).json
        assert (told["user"], told["realm"]) == ("luigi", realm)
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


def test_a_program_acts_in_each_realm_of_its_user(house: Labs) -> None:
    """It asks for a token of the realm; one that its user is not of is refused like one that there is not."""
    relay = house.relay
    relay.user("bot@lab2")
    relay.cli("user", "join", "bot@lab2", "lab1")
    relay.cli("right", "grant", "bot@lab1", "mobile@lab1", "viewer")
    program = relay.cli("program", "add", "bot@lab2", "--label", "watcher")
    auth = httpx.DigestAuth(program["key"], program["secret"])

    def token(http: httpx.Client, **realm: str) -> httpx.Response:
        return http.post("/oauth/token", data={"grant_type": "client_credentials", **realm}, auth=auth)

    with httpx.Client(base_url=f"http://127.0.0.1:{relay.http_port}", timeout=PATIENCE) as http:
        for realm, robots in (({}, []), ({"realm": "lab2"}, []), ({"realm": "lab1"}, ["mobile"])):
            bearer = {"Authorization": f"Bearer {token(http, **realm).json()['access_token']}"}
            told = http.get("/api/v1/robots", headers=bearer).json()["robots"]
            assert [each["name"] for each in told] == robots
        refused = [token(http, realm=realm).json() for realm in ("default", "lab9")]
        assert refused[0] == refused[1]
        assert refused[0]["error"] == "invalid_target"
        relay.cli("user", "remove", "bot@lab1", "--yes")
        wait_for(
            "its token is worthless", lambda: http.get("/api/v1/robots", headers=bearer).status_code == 401
        )
    relay.cli("user", "remove", "bot@lab2", "--yes")
