"""An administrator sees to his own realm over HTTP: what he changes holds at once, and there is no other for him."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from switchboard_http import ask, log_in
from switchboard_labs import REALM, TwoRealms
from websockets.exceptions import ConnectionClosed, InvalidStatus

from relay_server.http.openapi.document import document
from relay_server.http.openapi.http import operations

PASSWORD = "correct horse"
BODIES = {
    "users": {"name": "new"},
    "users/{name}": {"disabled": True},
    "users/{name}/programs": {"label": "new"},
    "groups": {"name": "new"},
    "robots": {"name": "new"},
    "robots/{name}": {"description": "new"},
    "robot-groups": {"name": "new"},
    "rights/{name}/{holder}": {"level": "viewer"},
}


class Labs(TwoRealms):
    """``mole`` is a user, a group, a robot and a group of robots of lab2 and of the default realm."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        for end in ("@lab2", ""):
            self.tokens[f"mole{end}"] = self.relay.user(f"mole{end}")
            self.relay.cli("group", "add", f"mole{end}")
            self.relay.cli("robot", "add", f"mole{end}")
            self.relay.cli("robot", "group", "add", f"mole{end}", f"mole{end}")


@pytest.fixture(scope="module")
def labs(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Labs]:
    """Both of them, for all tests."""
    made = Labs(tmp_path_factory.mktemp("administration"))
    yield made
    made.stop()


def of_a_realm() -> list[tuple[str, str]]:
    """All that there is below the realm's address, by the API's own description."""
    paths = document(operations(), "1", "session")["paths"]
    return [
        (method.upper(), path.removeprefix(REALM))
        for path in paths
        if path.startswith(REALM)
        for method in paths[path]
    ]


def test_a_user_is_added_given_a_right_and_cut_when_it_is_taken(labs: Labs) -> None:
    """He logs in, sees the robot and works with it; then his websocket ends, and the robot is none for him."""
    made = labs.ask("root@lab1", "POST", "/users", {"name": "Luigi", "password": PASSWORD})
    assert (made.status, made.headers["Location"]) == (201, f"{REALM}/users/luigi")
    told = {"user": "luigi", "admin": False, "disabled": False, "password": True, "guest": False}
    assert made.json == {**told, "groups": []}
    assert PASSWORD.encode() not in made.body
    port = labs.relay.http_port
    cookie = {"Cookie": log_in(port, "luigi@lab1", PASSWORD)}
    assert ask(port, "GET", "/api/v1/robots", headers=cookie).json["robots"] == []
    given = labs.ask("root@lab1", "PUT", "/rights/mobile/luigi", {"level": "operator"})
    assert (given.status, given.headers["Location"]) == (201, f"{REALM}/rights/mobile/luigi")
    assert labs.ask("root@lab1", "PUT", "/rights/mobile/luigi", {"level": "operator"}).status == 200
    shown = ask(port, "GET", "/api/v1/robots", headers=cookie).json["robots"]
    assert [(each["name"], each["level"]) for each in shown] == [("mobile", "operator")]
    token = labs.relay.token("luigi@lab1")
    with labs.relay.connect("mobile", token) as client:
        assert client.call("/where")["result"]
        labs.do("DELETE", "/rights/mobile/luigi")
        # It was closed before that was answered; what is on its way is waited for.
        with pytest.raises(ConnectionClosed):
            while True:
                client.receive()
    assert ask(port, "GET", "/api/v1/robots", headers=cookie).json["robots"] == []
    labs.do("PATCH", "/users/luigi", {"password": "another horse"})
    assert ask(port, "GET", "/api/v1/robots", headers=cookie).status == 401
    assert ask(port, "GET", "/api/v1/robots", token=token).status == 200
    (access,) = labs.do("GET", "/users/luigi/tokens")["tokens"]
    labs.do("DELETE", f"/tokens/{access['id']}")
    assert ask(port, "GET", "/api/v1/robots", token=token).status == 401
    labs.do("DELETE", "/users/luigi")
    assert labs.ask("root@lab1", "GET", "/users/luigi").status == 404
    entries = [each for each in labs.log() if "luigi" in each["target"] and each["actor"].startswith("user:")]
    assert {(each["actor"], each["origin"]) for each in entries if each["action"] != "login"} == {
        ("user:root@lab1", "127.0.0.1")
    }
    assert {"user.add", "right.grant", "right.revoke", "user.password", "user.remove"} <= {
        each["action"] for each in entries
    }
    assert PASSWORD not in labs.relay.log and PASSWORD not in json.dumps(entries)


def test_a_group_and_a_robot_are_added_and_used(labs: Labs) -> None:
    """The robot enrols with the code of the answer, its key is listed and retired, and then it is cut."""
    labs.do("POST", "/users", {"name": "peach"})
    labs.do("POST", "/groups", {"name": "crew"})
    labs.do("PUT", "/groups/crew/members/peach")
    assert labs.do("GET", "/groups/crew") == {"group": "crew", "members": ["peach"]}
    made = labs.ask("root@lab1", "POST", "/robots", {"name": "arm", "description": "on the bench"})
    assert (made.status, made.headers["Location"], made.json["keys"]) == (201, f"{REALM}/robots/arm", 0)
    labs.do("PUT", "/rights/arm/@crew", {"level": "viewer", "deny": ["call:/x"]})
    (right,) = labs.do("GET", "/rights?robot=arm&user=peach")["rights"]
    assert right == {
        "holder": "@crew",
        "robot": "arm",
        "level": "viewer",
        "allow": [],
        "deny": ["call:/x"],
    }
    token = labs.relay.token("peach@lab1")
    seen = ask(labs.relay.http_port, "GET", "/api/v1/robots", token=token).json["robots"]
    assert [each["name"] for each in seen] == ["arm"]
    (key,) = labs.do("GET", "/robots/mobile/keys")["keys"]
    labs.do("DELETE", f"/robots/mobile/keys/{key['fingerprint']}")
    assert labs.relay.state_of("mobile@lab1") == "offline"
    assert labs.do("GET", "/robots/mobile")["keys"] == 0
    assert labs.do("POST", "/robots/mobile/code")["enrolment_code"] != made.json["enrolment_code"]
    for each in (
        "/rights/arm/@crew",
        "/groups/crew/members/peach",
        "/groups/crew",
        "/robots/arm",
        "/users/peach",
    ):
        labs.do("DELETE", each)
    assert labs.do("GET", "/rights")["rights"] == []


@pytest.mark.parametrize(("method", "path"), of_a_realm())
def test_who_is_no_administrator_is_refused(labs: Labs, method: str, path: str) -> None:
    """Whatever he asks for, there or not: by what he is, or by what his token is for."""
    if "narrow" not in labs.tokens:
        told = labs.relay.cli("token", "create", "root@lab1", "--scope", "owner")
        labs.tokens["narrow"] = told["token"]
    at = path.replace("{", "").replace("}", "")
    for who in ("mole", "mole@lab2", "narrow"):
        answer = labs.ask(who, method, at, BODIES.get(path.removeprefix("/")))
        assert (answer.status, answer.json["code"]) == (403, "refused"), who
        assert "administrators" in answer.json["detail"]


@pytest.mark.parametrize(("method", "path"), [each for each in of_a_realm() if "{" in each[1]])
def test_what_is_in_another_realm_is_answered_as_what_is_nowhere(labs: Labs, method: str, path: str) -> None:
    """Users, groups, robots and groups of them, rights, tokens: the same words, to any other realm's administrator."""
    foreign = labs.do("GET", "/users/mole/tokens", who="root@lab2")["tokens"][0]["id"]
    said = []
    for name, id in (("mole", foreign), ("nobody", "0" * 16), ("mole@lab2", foreign)):
        at = path.replace("{name}", name).replace("{id}", id).replace("{fingerprint}", "0" * 16)
        at = at.replace("{user}", name).replace("{holder}", name).replace("{member}", name)
        at = at.replace("{key}", "swp_0")
        answer = labs.ask("root@lab1", method, at, BODIES.get(path.removeprefix("/")))
        said.append((answer.status, answer.body))
    assert len(set(said)) == 1 and said[0][0] == 404
    assert ask(labs.relay.http_port, "GET", "/api/v1/robots", token=labs.tokens["mole@lab2"]).status == 200


def test_lists_hold_nothing_of_other_realms(labs: Labs) -> None:
    """Nor do the numbers of the realm."""
    for part in ("users", "groups", "robots", "robot-groups", "rights"):
        assert b"mole" not in labs.ask("root@lab1", "GET", f"/{part}?limit=1000").body
    before = labs.do("GET", "")
    labs.do("POST", "/users", {"name": "more"}, who="root@lab2")
    assert labs.do("GET", "") == before and before["realm"] == "lab1"
    labs.do("DELETE", "/users/more", who="root@lab2")


def test_the_last_administrator_stays(labs: Labs) -> None:
    """He can't take himself away, and is told what to do; one more of them could be."""
    for method, body in (("DELETE", None), ("PATCH", {"disabled": True}), ("PATCH", {"admin": False})):
        answer = labs.ask("root@lab1", method, "/users/root", body)
        assert (answer.status, answer.json["code"]) == (409, "refused")
        assert "have another one do it" in answer.json["detail"]
    labs.do("POST", "/users", {"name": "boss", "admin": True})
    labs.tokens["boss@lab1"] = labs.relay.token("boss@lab1")
    labs.do("PATCH", "/users/boss", {"admin": False})
    assert labs.ask("boss@lab1", "GET", "").status == 403
    labs.do("PATCH", "/users/boss", {"disabled": True})
    assert labs.ask("boss@lab1", "GET", "").status == 401
    labs.do("DELETE", "/users/boss")


@pytest.mark.parametrize(
    ("path", "body", "status", "code"),
    [
        ("/users", {"name": "root"}, 409, "taken"),
        ("/robots", {"name": "mobile"}, 409, "taken"),
        ("/users", {"name": "a/b"}, 400, "invalid"),
        ("/users", {"name": "x" * 256}, 400, "malformed"),
        ("/users", {"name": "bob", "password": "short"}, 400, "invalid"),
        ("/users", {"name": "bob", "password": "x" * 1025}, 400, "malformed"),
        ("/users", {"name": "bob", "root": True}, 400, "malformed"),
        ("/groups", {}, 400, "malformed"),
        ("/robots", {"name": "stream"}, 400, "invalid"),
        ("/robot-groups", {"name": "a/b"}, 400, "invalid"),
        ("/users/root/programs", {"scope": "fly"}, 400, "invalid"),
        ("/users/root/programs", {"scope": "x" * 4097}, 400, "malformed"),
        ("/users/root/programs", {"label": "x" * 256}, 400, "malformed"),
        ("/users/root/programs", {"secret": "chosen"}, 400, "malformed"),
    ],
)
def test_what_can_not_be_added(labs: Labs, path: str, body: Any, status: int, code: str) -> None:
    """The answer says why, with bare names."""
    answer = labs.ask("root@lab1", "POST", path, body)
    assert (answer.status, answer.json["code"]) == (status, code)
    assert "@lab1" not in answer.json["detail"].replace("toad@lab1", "")
    assert labs.ask("root@lab1", "GET", "/users/bob").status == 404


def test_a_slash_in_a_name_is_not_taken_for_another_name(labs: Labs) -> None:
    """Addresses lose one at their beginning: whoever has such a name on the command line is not somebody else here."""
    labs.relay.cli("user", "add", "/dora@lab1", "--no-password")
    labs.do("POST", "/users", {"name": "dora"})
    assert labs.ask("root@lab1", "DELETE", "/users/%2Fdora").status == 404
    assert labs.do("GET", "/users/dora")["user"] == "dora"
    labs.do("DELETE", "/users/dora")
    labs.relay.cli("user", "remove", "/dora@lab1", "--yes")


def test_a_page_of_another_site_changes_nothing(labs: Labs) -> None:
    """A cookie alone does not prove who changes something; an Origin that the relay lists has to come with it."""
    port = labs.relay.http_port
    cookie = log_in(port, "root@lab1", PASSWORD)
    strange = labs.ask("", "POST", "/groups", {"name": "x"}, Cookie=cookie, Origin="http://evil.example")
    assert (strange.status, strange.json["code"]) == (403, "refused")
    own = {"Cookie": cookie, "Origin": f"http://127.0.0.1:{port}"}
    assert labs.ask("", "POST", "/groups", {"name": "x"}, **own).status == 201
    changed = labs.ask("", "PATCH", "/users/root", {"password": PASSWORD}, **own)
    assert changed.status == 200 and labs.ask("", "GET", "", **own).status == 200
    assert labs.ask("", "DELETE", "/groups/x", **own).status == 204


def test_a_token_without_rights_shows_no_robot(labs: Labs) -> None:
    """What an administrator of one realm may do opens nothing of the other."""
    with pytest.raises(InvalidStatus):
        labs.relay.connect("mole", labs.tokens["root@lab1"])


@pytest.mark.parametrize(
    ("path", "body"),
    [
        ("/users", {"name": "a\ufffd"}),
        ("/groups", {"name": "a\ufffd"}),
        ("/robots", {"name": "a\ufffd"}),
        ("/robot-groups", {"name": "a\ufffd"}),
        ("/users/mole/programs", {"label": "a\ufffd"}),
    ],
)
def test_a_name_with_the_mark_of_bytes_that_are_no_text_is_refused(labs: Labs, path: str, body: Any) -> None:
    """Two that differ in such bytes would be one."""
    answer = labs.ask("root@lab2", "POST", path, body)
    assert answer.status == 400, answer.body
