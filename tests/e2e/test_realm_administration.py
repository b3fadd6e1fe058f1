"""An administrator manages their own realm over HTTP: changes apply at once, and other realms do not exist
for them.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus

from relay_server.http.openapi.document import document
from relay_server.http.openapi.http import operations
from tests.worlds.http_requests import ask, log_in
from tests.worlds.two_realms import REALM, TwoRealms

PASSWORD = "correct horse"
BODIES = {
    "users": {"name": "new"},
    "users/{name}": {"disabled": True},
    "users/{name}/oauth-clients": {"label": "new"},
    "groups": {"name": "new"},
    "robots": {"name": "new"},
    "robots/{name}": {"description": "new"},
    "robot-groups": {"name": "new"},
    "rights/{name}/{holder}": {"level": "viewer"},
}


class World(TwoRealms):
    """``mole`` is a user, a group, a robot and a group of robots of lab2 and of the default realm."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        for end in ("@lab2", ""):
            self.tokens[f"mole{end}"] = self.relay.user(f"mole{end}")
            self.relay.cli("group", "add", f"mole{end}")
            self.relay.cli("robot", "add", f"mole{end}")
            self.relay.cli("robot", "group", "add", f"mole{end}", f"mole{end}")


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    """Both realms, for all tests."""
    made = World(tmp_path_factory.mktemp("administration"))
    yield made
    made.stop()


def of_a_realm() -> list[tuple[str, str]]:
    """All operations below the realm's address, by the API's own description."""
    paths = document(operations(), "1", "session")["paths"]
    return [
        (method.upper(), path.removeprefix(REALM))
        for path in paths
        if path.startswith(REALM)
        for method in paths[path]
    ]


def test_a_user_is_added_given_a_right_and_cut_when_it_is_taken(world: World) -> None:
    """The new user logs in, sees the robot and uses it; then the websocket ends, and the robot is not found."""
    made = world.ask("root@lab1", "POST", "/users", {"name": "Luigi", "password": PASSWORD})
    assert (made.status, made.headers["Location"]) == (201, f"{REALM}/users/luigi")
    reported = {"user": "luigi", "admin": False, "disabled": False, "password": True, "guest": False}
    assert made.json == {**reported, "groups": []}
    assert PASSWORD.encode() not in made.body
    port = world.relay.http_port
    cookie = {"Cookie": log_in(port, "luigi@lab1", PASSWORD)}
    assert ask(port, "GET", "/api/v1/robots", headers=cookie).json["robots"] == []
    given = world.ask("root@lab1", "PUT", "/rights/mobile/luigi", {"level": "operator"})
    assert (given.status, given.headers["Location"]) == (201, f"{REALM}/rights/mobile/luigi")
    assert world.ask("root@lab1", "PUT", "/rights/mobile/luigi", {"level": "operator"}).status == 200
    shown = ask(port, "GET", "/api/v1/robots", headers=cookie).json["robots"]
    assert [(each["name"], each["level"]) for each in shown] == [("mobile", "operator")]
    token = world.relay.token("luigi@lab1")
    with world.relay.connect("mobile", token) as client:
        assert client.call("/where")["result"]
        world.do("DELETE", "/rights/mobile/luigi")
        # It was closed before the answer; frames under way are awaited.
        with pytest.raises(ConnectionClosed):
            while True:
                client.receive()
    assert ask(port, "GET", "/api/v1/robots", headers=cookie).json["robots"] == []
    world.do("PATCH", "/users/luigi", {"password": "another horse"})
    assert ask(port, "GET", "/api/v1/robots", headers=cookie).status == 401
    assert ask(port, "GET", "/api/v1/robots", token=token).status == 200
    (access,) = world.do("GET", "/users/luigi/tokens")["tokens"]
    world.do("DELETE", f"/tokens/{access['id']}")
    assert ask(port, "GET", "/api/v1/robots", token=token).status == 401
    world.do("DELETE", "/users/luigi")
    assert world.ask("root@lab1", "GET", "/users/luigi").status == 404
    entries = [
        each for each in world.log() if "luigi" in each["target"] and each["actor"].startswith("user:")
    ]
    assert {(each["actor"], each["origin"]) for each in entries if each["action"] != "login"} == {
        ("user:root@lab1", "127.0.0.1")
    }
    assert {"user.add", "right.grant", "right.revoke", "user.password", "user.remove"} <= {
        each["action"] for each in entries
    }
    assert PASSWORD not in world.relay.log and PASSWORD not in json.dumps(entries)


def test_a_group_and_a_robot_are_added_and_used(world: World) -> None:
    """The robot enrols with the code of the answer; its key is listed and retired, and then it is cut."""
    world.do("POST", "/users", {"name": "peach"})
    world.do("POST", "/groups", {"name": "crew"})
    world.do("PUT", "/groups/crew/members/peach")
    assert world.do("GET", "/groups/crew") == {"group": "crew", "members": ["peach"]}
    made = world.ask("root@lab1", "POST", "/robots", {"name": "arm", "description": "on the bench"})
    assert (made.status, made.headers["Location"], made.json["keys"]) == (201, f"{REALM}/robots/arm", 0)
    world.do("PUT", "/rights/arm/@crew", {"level": "viewer", "deny": ["call:/x"]})
    (right,) = world.do("GET", "/rights?robot=arm&user=peach")["rights"]
    assert right == {
        "holder": "@crew",
        "robot": "arm",
        "level": "viewer",
        "allow": [],
        "deny": ["call:/x"],
    }
    token = world.relay.token("peach@lab1")
    seen = ask(world.relay.http_port, "GET", "/api/v1/robots", token=token).json["robots"]
    assert [each["name"] for each in seen] == ["arm"]
    (key,) = world.do("GET", "/robots/mobile/keys")["keys"]
    world.do("DELETE", f"/robots/mobile/keys/{key['fingerprint']}")
    assert world.relay.state_of("mobile@lab1") == "offline"
    assert world.do("GET", "/robots/mobile")["keys"] == 0
    assert world.do("POST", "/robots/mobile/code")["enrolment_code"] != made.json["enrolment_code"]
    for each in (
        "/rights/arm/@crew",
        "/groups/crew/members/peach",
        "/groups/crew",
        "/robots/arm",
        "/users/peach",
    ):
        world.do("DELETE", each)
    assert world.do("GET", "/rights")["rights"] == []


@pytest.mark.parametrize(("method", "path"), of_a_realm())
def test_non_administrator_is_refused(world: World, method: str, path: str) -> None:
    """For any request, to existing and missing resources: because of the user, or of the token's scope."""
    if "narrow" not in world.tokens:
        reported = world.relay.cli("token", "create", "root@lab1", "--scope", "owner")
        world.tokens["narrow"] = reported["token"]
    at = path.replace("{", "").replace("}", "")
    for who in ("mole", "mole@lab2", "narrow"):
        answer = world.ask(who, method, at, BODIES.get(path.removeprefix("/")))
        assert (answer.status, answer.json["code"]) == (403, "refused"), who
        assert "administrators" in answer.json["detail"]


@pytest.mark.parametrize(("method", "path"), [each for each in of_a_realm() if "{" in each[1]])
def test_resource_of_another_realm_is_answered_as_missing(world: World, method: str, path: str) -> None:
    """Users, groups, robots and their groups, rights, tokens: the same answers to administrators of any other
    realm.
    """
    foreign = world.do("GET", "/users/mole/tokens", who="root@lab2")["tokens"][0]["id"]
    said = []
    for name, id in (("mole", foreign), ("nobody", "0" * 16), ("mole@lab2", foreign)):
        at = path.replace("{name}", name).replace("{id}", id).replace("{fingerprint}", "0" * 16)
        at = at.replace("{user}", name).replace("{holder}", name).replace("{member}", name)
        at = at.replace("{key}", "swc_0")
        answer = world.ask("root@lab1", method, at, BODIES.get(path.removeprefix("/")))
        said.append((answer.status, answer.body))
    assert len(set(said)) == 1 and said[0][0] == 404
    assert ask(world.relay.http_port, "GET", "/api/v1/robots", token=world.tokens["mole@lab2"]).status == 200


def test_lists_hold_nothing_of_other_realms(world: World) -> None:
    """Nor do the realm's numbers."""
    for part in ("users", "groups", "robots", "robot-groups", "rights"):
        assert b"mole" not in world.ask("root@lab1", "GET", f"/{part}?limit=1000").body
    before = world.do("GET", "")
    world.do("POST", "/users", {"name": "more"}, who="root@lab2")
    assert world.do("GET", "") == before and before["realm"] == "lab1"
    world.do("DELETE", "/users/more", who="root@lab2")


def test_the_last_administrator_stays(world: World) -> None:
    """Removing themselves is refused with advice, since another administrator could do it."""
    for method, body in (("DELETE", None), ("PATCH", {"disabled": True}), ("PATCH", {"admin": False})):
        answer = world.ask("root@lab1", method, "/users/root", body)
        assert (answer.status, answer.json["code"]) == (409, "refused")
        assert "ask another one" in answer.json["detail"]
    world.do("POST", "/users", {"name": "boss", "admin": True})
    world.tokens["boss@lab1"] = world.relay.token("boss@lab1")
    world.do("PATCH", "/users/boss", {"admin": False})
    assert world.ask("boss@lab1", "GET", "").status == 403
    world.do("PATCH", "/users/boss", {"disabled": True})
    assert world.ask("boss@lab1", "GET", "").status == 401
    world.do("DELETE", "/users/boss")


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
        ("/users/root/oauth-clients", {"scope": "fly"}, 400, "invalid"),
        ("/users/root/oauth-clients", {"scope": "x" * 4097}, 400, "malformed"),
        ("/users/root/oauth-clients", {"label": "x" * 256}, 400, "malformed"),
        ("/users/root/oauth-clients", {"secret": "chosen"}, 400, "malformed"),
    ],
)
def test_unusable_names_cannot_be_added(world: World, path: str, body: Any, status: int, code: str) -> None:
    """The error has the reason, with bare names."""
    answer = world.ask("root@lab1", "POST", path, body)
    assert (answer.status, answer.json["code"]) == (status, code)
    assert "@lab1" not in answer.json["detail"].replace("toad@lab1", "")
    assert world.ask("root@lab1", "GET", "/users/bob").status == 404


def test_a_slash_in_a_name_is_not_taken_for_another_name(world: World) -> None:
    """Addresses lose a leading slash, so a name that begins with one is refused here."""
    world.relay.cli("user", "add", "/dora@lab1", "--no-password")
    world.do("POST", "/users", {"name": "dora"})
    assert world.ask("root@lab1", "DELETE", "/users/%2Fdora").status == 404
    assert world.do("GET", "/users/dora")["user"] == "dora"
    world.do("DELETE", "/users/dora")
    world.relay.cli("user", "remove", "/dora@lab1", "--yes")


def test_a_page_of_another_site_changes_nothing(world: World) -> None:
    """A cookie is not enough for changes; a listed Origin is needed."""
    port = world.relay.http_port
    cookie = log_in(port, "root@lab1", PASSWORD)
    strange = world.ask("", "POST", "/groups", {"name": "x"}, Cookie=cookie, Origin="http://evil.example")
    assert (strange.status, strange.json["code"]) == (403, "refused")
    own = {"Cookie": cookie, "Origin": f"http://127.0.0.1:{port}"}
    assert world.ask("", "POST", "/groups", {"name": "x"}, **own).status == 201
    changed = world.ask("", "PATCH", "/users/root", {"password": PASSWORD}, **own)
    assert changed.status == 200 and world.ask("", "GET", "", **own).status == 200
    assert world.ask("", "DELETE", "/groups/x", **own).status == 204


def test_a_token_without_rights_shows_no_robot(world: World) -> None:
    """An administrator of one realm has no rights in the other."""
    with pytest.raises(InvalidStatus):
        world.relay.connect("mole", world.tokens["root@lab1"])


@pytest.mark.parametrize(
    ("path", "body"),
    [
        ("/users", {"name": "a\ufffd"}),
        ("/groups", {"name": "a\ufffd"}),
        ("/robots", {"name": "a\ufffd"}),
        ("/robot-groups", {"name": "a\ufffd"}),
        ("/users/mole/oauth-clients", {"label": "a\ufffd"}),
    ],
)
def test_a_name_with_the_mark_of_bytes_that_are_no_text_is_refused(
    world: World, path: str, body: Any
) -> None:
    """Two names that differ only in such bytes would be equal."""
    answer = world.ask("root@lab2", "POST", path, body)
    assert answer.status == 400, answer.body
