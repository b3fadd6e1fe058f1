"""Programs and groups of robots that an administrator sees to over HTTP, with a real relay, real robots and httpx."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from switchboard_http import ask
from switchboard_labs import LABS, REALM, TwoRealms
from websockets.exceptions import ConnectionClosed


class Labs(TwoRealms):
    """In each realm a user ``toad`` who operates the robot, and a token of the administrator for administration alone:
    ``narrow@lab1``.
    """

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        for lab in LABS:
            narrow = self.relay.cli("token", "create", f"root@{lab}", "--scope", "admin")
            self.tokens[f"narrow@{lab}"] = narrow["token"]
            self.relay.user(f"toad@{lab}")
            self.relay.cli("right", "grant", f"toad@{lab}", f"mobile@{lab}", "operator")
        self.http = httpx.Client(base_url=f"http://127.0.0.1:{self.relay.http_port}")

    def token_for(self, program: Any, **fields: str) -> httpx.Response:
        """A token by client credentials."""
        auth = httpx.BasicAuth(program["key"], program["secret"])
        return self.http.post("/oauth/token", data={"grant_type": "client_credentials", **fields}, auth=auth)

    def stop(self) -> None:
        """End everything."""
        self.http.close()
        super().stop()


@pytest.fixture(scope="module")
def labs(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Labs]:
    """Both of them, for all tests."""
    made = Labs(tmp_path_factory.mktemp("programs"))
    yield made
    made.stop()


def test_a_program_made_over_http_acts_until_it_is_removed(labs: Labs) -> None:
    """It gets tokens by its secret, within its scope and what its user may; removed, all of them are worthless."""
    wanted = {"label": "caller", "scope": "viewer call:/where"}
    made = labs.ask("root@lab1", "POST", "/users/toad/programs", wanted)
    program = made.json
    assert (made.status, made.headers["Location"]) == (201, f"{REALM}/programs/{program['key']}")
    assert {name: program[name] for name in wanted} == wanted
    (listed,) = labs.do("GET", "/users/toad/programs")["programs"]
    assert listed == {name: value for name, value in program.items() if name != "secret"}
    assert labs.do("GET", "")["programs"] == 1
    answer = labs.token_for(program).json()
    assert answer["scope"] == wanted["scope"]
    port, token = labs.relay.http_port, answer["access_token"]
    me = ask(port, "GET", "/api/v1/session", token=token).json
    assert (me["user"], me["realm"]) == ("toad", "lab1")
    with labs.relay.connect("mobile", token) as client:
        assert client.call("/where")["values"] == {"message": "here"}
        labs.do("DELETE", f"/programs/{program['key']}")
        # It was closed before that was answered; what is on its way is waited for.
        with pytest.raises(ConnectionClosed):
            while True:
                client.receive()
    assert ask(port, "GET", "/api/v1/session", token=token).status == 401
    assert labs.token_for(program).status_code == 401
    assert labs.do("GET", "/users/toad/programs")["programs"] == []
    assert labs.ask("root@lab1", "DELETE", f"/programs/{program['key']}").status == 404
    entries = [each for each in labs.log() if each["action"].startswith("program.")]
    assert {(each["action"], each["actor"], each["origin"]) for each in entries} == {
        ("program.add", "user:root@lab1", "127.0.0.1"),
        ("program.revoke", "user:root@lab1", "127.0.0.1"),
    }
    assert program["secret"] not in json.dumps(entries) and program["secret"] not in labs.relay.log


def test_a_token_for_administration_alone_makes_no_program_but_revokes_one(labs: Labs) -> None:
    """By a program of his own its holder would have all that its user may."""
    refused = labs.ask("narrow@lab1", "POST", "/users/root/programs", {})
    assert (refused.status, refused.json["code"]) == (403, "refused")
    program = labs.do("POST", "/users/toad/programs", {})
    assert program["scope"] is None
    assert labs.ask("narrow@lab1", "DELETE", f"/programs/{program['key']}").status == 204
    assert labs.token_for(program).status_code == 401


def test_a_group_of_robots_takes_one_order(labs: Labs) -> None:
    """Made over HTTP it is known to who orders, and to the command line; removed, nothing is meant by it."""
    made = labs.ask("narrow@lab1", "POST", "/robot-groups", {"name": "Upstairs"})
    assert (made.status, made.headers["Location"]) == (201, f"{REALM}/robot-groups/upstairs")
    assert labs.ask("root@lab1", "POST", "/robot-groups", {"name": "upstairs"}).json["code"] == "taken"
    for _ in range(2):
        labs.do("PUT", "/robot-groups/upstairs/members/mobile")
    group = {"group": "upstairs", "robots": ["mobile"]}
    assert labs.do("GET", "/robot-groups/upstairs") == group
    assert group in labs.do("GET", "/robot-groups")["robot_groups"]
    told = labs.relay.cli("robot", "group", "list", "--realm", "lab1")
    assert told == [{"group": "upstairs@lab1", "robots": ["mobile@lab1"]}]
    done = labs.relay.cli("robot", "call", "group:upstairs", "/where", "--realm", "lab1")
    assert [(each["robot"], each["ok"]) for each in done["results"]] == [("mobile@lab1", True)]
    labs.do("DELETE", "/robot-groups/upstairs/members/mobile")
    assert labs.ask("root@lab1", "DELETE", "/robot-groups/upstairs/members/mobile").status == 404
    labs.do("DELETE", "/robot-groups/upstairs")
    assert labs.ask("root@lab1", "GET", "/robot-groups/upstairs").status == 404
    entries = [each for each in labs.log() if each["target"] == "upstairs@lab1"]
    assert sorted((each["action"], tuple(each["data"]["robots"])) for each in entries) == [
        ("robot.group.add", ()),
        ("robot.group.add", ("mobile@lab1",)),
        ("robot.group.remove", ()),
        ("robot.group.remove", ("mobile@lab1",)),
    ]


def test_how_long_events_are_kept_is_said(labs: Labs) -> None:
    """The command line tells it too, and that of another realm stays; a token for administration alone may not."""
    assert labs.do("PATCH", "", {"events_days": 7})["events_days"] == 7
    assert labs.do("GET", "", who="root@lab2")["events_days"] is None
    kept = {each["realm"]: each["events_days"] for each in labs.relay.cli("realm", "list")}
    assert (kept["lab1"], kept["lab2"]) == (7, None)
    assert labs.do("PATCH", "", {"events_days": None}) == labs.do("GET", "")
    for body in ({"events_days": 0}, {"events_days": 1e6}, {"events_days": "7"}, {"days": 7}, {}):
        assert labs.ask("root@lab1", "PATCH", "", body).status == 400
    assert labs.ask("narrow@lab1", "PATCH", "", {"events_days": 7}).status == 403
    set_to = [
        each["data"] for each in labs.log() if (each["action"], each["target"]) == ("realm.set", "lab1")
    ]
    assert sorted(map(str, set_to)) == ["{'events_days': 7.0}", "{'events_days': None}"]


def test_a_robot_is_described(labs: Labs) -> None:
    """The command line tells it too."""
    told = labs.do("PATCH", "/robots/mobile", {"description": "on the bench"})
    assert told == labs.do("GET", "/robots/mobile") and told["description"] == "on the bench"
    listed = {each["robot"]: each["description"] for each in labs.relay.cli("robot", "list")}
    assert (listed["mobile@lab1"], listed["mobile@lab2"]) == ("on the bench", "")


def test_what_is_in_another_realm_is_nowhere(labs: Labs) -> None:
    """Its administrator is answered as about what nobody has, whatever he asks for, and all of it stays."""
    labs.do("POST", "/users", {"name": "mole"})
    labs.do("POST", "/robots", {"name": "digger"})
    labs.do("POST", "/robot-groups", {"name": "diggers"})
    labs.do("PUT", "/robot-groups/diggers/members/digger")
    program = labs.do("POST", "/users/mole/programs", {})
    labs.do("POST", "/robot-groups", {"name": "own"}, who="root@lab2")
    asked = [
        ("GET", "/users/{mole}/programs", None),
        ("POST", "/users/{mole}/programs", {}),
        ("DELETE", "/programs/{key}", None),
        ("GET", "/robot-groups/{diggers}", None),
        ("DELETE", "/robot-groups/{diggers}", None),
        ("PUT", "/robot-groups/{diggers}/members/mobile", None),
        ("PUT", "/robot-groups/own/members/{digger}", None),
        ("DELETE", "/robot-groups/own/members/{digger}", None),
        ("PATCH", "/robots/{digger}", {"description": "x"}),
    ]
    there = {"mole": "mole", "key": program["key"], "diggers": "diggers", "digger": "digger"}
    full = {name: value if name == "key" else f"{value}@lab1" for name, value in there.items()}
    nowhere = dict.fromkeys(there, "nobody")
    for method, path, body in asked:
        said = [labs.ask("root@lab2", method, path.format(**names), body) for names in (there, full, nowhere)]
        assert len({(each.status, each.body) for each in said}) == 1, path
        assert said[0].status == 404, path
    assert labs.do("GET", "/robot-groups", who="root@lab2")["robot_groups"] == [
        {"group": "own", "robots": []}
    ]
    assert labs.token_for(program).status_code == 200
    assert labs.do("GET", "/robot-groups/diggers")["robots"] == ["digger"]


def test_nobody_makes_a_program_that_acts_as_a_guest(labs: Labs) -> None:
    """By it the administrator where he is a guest would be him in his own realm, too."""
    labs.do("POST", "/users", {"name": "dora"})
    labs.relay.cli("user", "join", "dora@lab1", "lab2")
    refused = labs.ask("root@lab2", "POST", "/users/dora/programs", {})
    assert (refused.status, refused.json["code"]) == (403, "refused")
    program = labs.do("POST", "/users/dora/programs", {})
    token = labs.token_for(program, realm="lab2").json()["access_token"]
    me = ask(labs.relay.http_port, "GET", "/api/v1/session", token=token).json
    assert (me["user"], me["realm"]) == ("dora", "lab2")
