"""An administrator manages OAuth clients and groups of robots over HTTP: real relay, real robots, httpx."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from websockets.exceptions import ConnectionClosed

from tests.worlds.http_requests import ask
from tests.worlds.two_realms import LABS, REALM, TwoRealms


class World(TwoRealms):
    """In each realm a user ``toad`` who operates the robot, and an administrator's token for administration
    only: ``narrow@lab1``.
    """

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        for lab in LABS:
            narrow = self.relay.cli("token", "create", f"root@{lab}", "--scope", "admin")
            self.tokens[f"narrow@{lab}"] = narrow["token"]
            self.relay.user(f"toad@{lab}")
            self.relay.cli("right", "grant", f"toad@{lab}", f"mobile@{lab}", "operator")
        self.http = httpx.Client(base_url=f"http://127.0.0.1:{self.relay.http_port}")

    def token_for(self, oauth_client: Any, **fields: str) -> httpx.Response:
        """A token by client credentials."""
        auth = httpx.BasicAuth(oauth_client["key"], oauth_client["secret"])
        return self.http.post("/oauth/token", data={"grant_type": "client_credentials", **fields}, auth=auth)

    def stop(self) -> None:
        self.http.close()
        super().stop()


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    """Both realms, for all tests."""
    made = World(tmp_path_factory.mktemp("oauth_clients"))
    yield made
    made.stop()


def test_an_oauth_client_made_over_http_acts_until_it_is_removed(world: World) -> None:
    """It gets tokens by its secret, within its scope and its user's rights; its removal revokes all of them."""
    wanted = {"label": "caller", "scope": "viewer call:/where"}
    made = world.ask("root@lab1", "POST", "/users/toad/oauth-clients", wanted)
    oauth_client = made.json
    assert (made.status, made.headers["Location"]) == (201, f"{REALM}/oauth-clients/{oauth_client['key']}")
    assert {name: oauth_client[name] for name in wanted} == wanted
    (listed,) = world.do("GET", "/users/toad/oauth-clients")["oauth_clients"]
    assert listed == {name: value for name, value in oauth_client.items() if name != "secret"}
    assert world.do("GET", "")["oauth_clients"] == 1
    answer = world.token_for(oauth_client).json()
    assert answer["scope"] == wanted["scope"]
    port, token = world.relay.http_port, answer["access_token"]
    me = ask(port, "GET", "/api/v1/session", token=token).json
    assert (me["user"], me["realm"]) == ("toad", "lab1")
    with world.relay.connect("mobile", token) as client:
        assert client.call("/where")["values"] == {"message": "here"}
        world.do("DELETE", f"/oauth-clients/{oauth_client['key']}")
        # It was closed before the answer; frames under way are awaited.
        with pytest.raises(ConnectionClosed):
            while True:
                client.receive()
    assert ask(port, "GET", "/api/v1/session", token=token).status == 401
    assert world.token_for(oauth_client).status_code == 401
    assert world.do("GET", "/users/toad/oauth-clients")["oauth_clients"] == []
    assert world.ask("root@lab1", "DELETE", f"/oauth-clients/{oauth_client['key']}").status == 404
    entries = [each for each in world.log() if each["action"].startswith("oauth_client.")]
    assert {(each["action"], each["actor"], each["origin"]) for each in entries} == {
        ("oauth_client.add", "user:root@lab1", "127.0.0.1"),
        ("oauth_client.revoke", "user:root@lab1", "127.0.0.1"),
    }
    assert oauth_client["secret"] not in json.dumps(entries) and oauth_client["secret"] not in world.relay.log


def test_a_token_for_administration_alone_makes_no_oauth_client_but_revokes_one(world: World) -> None:
    """An OAuth client would have all rights of its user."""
    refused = world.ask("narrow@lab1", "POST", "/users/root/oauth-clients", {})
    assert (refused.status, refused.json["code"]) == (403, "refused")
    oauth_client = world.do("POST", "/users/toad/oauth-clients", {})
    assert oauth_client["scope"] is None
    assert world.ask("narrow@lab1", "DELETE", f"/oauth-clients/{oauth_client['key']}").status == 204
    assert world.token_for(oauth_client).status_code == 401


def test_a_group_of_robots_takes_one_order(world: World) -> None:
    """Made over HTTP, it is known to fleet orders and to the command line; removed, it selects no robot."""
    made = world.ask("narrow@lab1", "POST", "/robot-groups", {"name": "Upstairs"})
    assert (made.status, made.headers["Location"]) == (201, f"{REALM}/robot-groups/upstairs")
    assert world.ask("root@lab1", "POST", "/robot-groups", {"name": "upstairs"}).json["code"] == "taken"
    for _ in range(2):
        world.do("PUT", "/robot-groups/upstairs/members/mobile")
    group = {"group": "upstairs", "robots": ["mobile"]}
    assert world.do("GET", "/robot-groups/upstairs") == group
    assert group in world.do("GET", "/robot-groups")["robot_groups"]
    reported = world.relay.cli("robot", "group", "list", "--realm", "lab1")
    assert reported == [{"group": "upstairs@lab1", "robots": ["mobile@lab1"]}]
    done = world.relay.cli("robot", "call", "group:upstairs", "/where", "--realm", "lab1")
    assert [(each["robot"], each["ok"]) for each in done["results"]] == [("mobile@lab1", True)]
    world.do("DELETE", "/robot-groups/upstairs/members/mobile")
    assert world.ask("root@lab1", "DELETE", "/robot-groups/upstairs/members/mobile").status == 404
    world.do("DELETE", "/robot-groups/upstairs")
    assert world.ask("root@lab1", "GET", "/robot-groups/upstairs").status == 404
    entries = [each for each in world.log() if each["target"] == "upstairs@lab1"]
    assert sorted((each["action"], tuple(each["data"]["robots"])) for each in entries) == [
        ("robot.group.add", ()),
        ("robot.group.add", ("mobile@lab1",)),
        ("robot.group.remove", ()),
        ("robot.group.remove", ("mobile@lab1",)),
    ]


def test_the_retention_time_of_events_is_set(world: World) -> None:
    """The command line shows it too, and the other realm's stays; a token for administration only may not
    change it.
    """
    assert world.do("PATCH", "", {"events_days": 7})["events_days"] == 7
    assert world.do("GET", "", who="root@lab2")["events_days"] is None
    kept = {each["realm"]: each["events_days"] for each in world.relay.cli("realm", "list")}
    assert (kept["lab1"], kept["lab2"]) == (7, None)
    assert world.do("PATCH", "", {"events_days": None}) == world.do("GET", "")
    for body in ({"events_days": 0}, {"events_days": 1e6}, {"events_days": "7"}, {"days": 7}, {}):
        assert world.ask("root@lab1", "PATCH", "", body).status == 400
    assert world.ask("narrow@lab1", "PATCH", "", {"events_days": 7}).status == 403
    set_to = [
        each["data"] for each in world.log() if (each["action"], each["target"]) == ("realm.set", "lab1")
    ]
    assert sorted(map(str, set_to)) == ["{'events_days': 7.0}", "{'events_days': None}"]


def test_a_robot_is_described(world: World) -> None:
    """The command line shows it too."""
    reported = world.do("PATCH", "/robots/mobile", {"description": "on the bench"})
    assert reported == world.do("GET", "/robots/mobile") and reported["description"] == "on the bench"
    listed = {each["robot"]: each["description"] for each in world.relay.cli("robot", "list")}
    assert (listed["mobile@lab1"], listed["mobile@lab2"]) == ("on the bench", "")


def test_resource_of_another_realm_is_not_found(world: World) -> None:
    """Its administrator gets the answers for missing resources, for all requests, and nothing changes."""
    world.do("POST", "/users", {"name": "mole"})
    world.do("POST", "/robots", {"name": "digger"})
    world.do("POST", "/robot-groups", {"name": "diggers"})
    world.do("PUT", "/robot-groups/diggers/members/digger")
    oauth_client = world.do("POST", "/users/mole/oauth-clients", {})
    world.do("POST", "/robot-groups", {"name": "own"}, who="root@lab2")
    asked = [
        ("GET", "/users/{mole}/oauth-clients", None),
        ("POST", "/users/{mole}/oauth-clients", {}),
        ("DELETE", "/oauth-clients/{key}", None),
        ("GET", "/robot-groups/{diggers}", None),
        ("DELETE", "/robot-groups/{diggers}", None),
        ("PUT", "/robot-groups/{diggers}/members/mobile", None),
        ("PUT", "/robot-groups/own/members/{digger}", None),
        ("DELETE", "/robot-groups/own/members/{digger}", None),
        ("PATCH", "/robots/{digger}", {"description": "x"}),
    ]
    there = {"mole": "mole", "key": oauth_client["key"], "diggers": "diggers", "digger": "digger"}
    full = {name: value if name == "key" else f"{value}@lab1" for name, value in there.items()}
    nowhere = dict.fromkeys(there, "nobody")
    for method, path, body in asked:
        said = [
            world.ask("root@lab2", method, path.format(**names), body) for names in (there, full, nowhere)
        ]
        assert len({(each.status, each.body) for each in said}) == 1, path
        assert said[0].status == 404, path
    assert world.do("GET", "/robot-groups", who="root@lab2")["robot_groups"] == [
        {"group": "own", "robots": []}
    ]
    assert world.token_for(oauth_client).status_code == 200
    assert world.do("GET", "/robot-groups/diggers")["robots"] == ["digger"]


def test_oauth_client_cannot_act_as_a_linked_account(world: World) -> None:
    """Otherwise an administrator of the guest realm could act as the user in the home realm."""
    world.do("POST", "/users", {"name": "dora"})
    world.relay.cli("user", "join", "dora@lab1", "lab2")
    refused = world.ask("root@lab2", "POST", "/users/dora/oauth-clients", {})
    assert (refused.status, refused.json["code"]) == (403, "refused")
    oauth_client = world.do("POST", "/users/dora/oauth-clients", {})
    token = world.token_for(oauth_client, realm="lab2").json()["access_token"]
    me = ask(world.relay.http_port, "GET", "/api/v1/session", token=token).json
    assert (me["user"], me["realm"]) == ("dora", "lab2")
