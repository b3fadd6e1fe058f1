"""Two administrators see to a realm at once: nobody overwrites what he has not seen, or reads twice what he knows."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest
from switchboard_http import Answer, ask
from switchboard_relay import Relay

REALM = "/api/v1/realm"

Ask = Callable[..., Answer]


@pytest.fixture(scope="module")
def told(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Ask]:
    """What administrators of a relay with a user ``wario`` and a robot ``cart`` are answered about their realm."""
    relay = Relay(tmp_path_factory.mktemp("together"))
    tokens = {name: relay.user(name, admin=True) for name in ("one", "other")}
    relay.user("wario")
    relay.cli("robot", "add", "cart")
    relay.cli("right", "grant", "wario", "cart", "viewer")

    def told(who: str, method: str, path: str, body: Any = None, **headers: str) -> Answer:
        sent = {name.replace("_", "-"): value for name, value in headers.items()}
        return ask(relay.http_port, method, f"{REALM}{path}", body, headers=sent, token=tokens[who])

    yield told
    relay.stop()


@pytest.mark.parametrize(
    ("path", "mine", "theirs"),
    [
        ("", {"events_days": 7}, {"events_days": 5}),
        ("/users/wario", {"disabled": True}, {"admin": True}),
        ("/robots/cart", {"description": "mine"}, {"description": "theirs"}),
        ("/rights/cart/wario", {"level": "owner"}, {"level": "operator", "deny": ["call:/x"]}),
    ],
)
def test_two_administrators_do_not_overwrite_each_other(told: Ask, path: str, mine: Any, theirs: Any) -> None:
    """Who says what he has seen is told that it is another by now; what he reads then he may change."""
    method = "PUT" if path.startswith("/rights") else "PATCH"
    seen = told("one", "GET", path).headers["ETag"]
    other = told("other", method, path, theirs)
    assert other.status == 200
    late = told("one", method, path, mine, If_Match=seen)
    assert (late.status, late.json["code"]) == (412, "not_as_before")
    now = told("one", "GET", path, If_None_Match=seen)
    assert (now.status, now.json, now.headers["ETag"]) == (200, other.json, other.headers["ETag"])
    done = told("one", method, path, mine, If_Match=now.headers["ETag"])
    assert done.status == 200 and done.json != now.json
    assert told("one", "GET", path, If_None_Match=done.headers["ETag"]).status == 304
    # Who names nothing has it changed however it is.
    again = {"disabled": False} if path.startswith("/users") else theirs
    assert told("other", method, path, again).status == 200
    assert told("one", "GET", path, If_None_Match=done.headers["ETag"]).status == 200


def test_a_right_is_given_only_where_there_is_none(told: Ask) -> None:
    """Where that is said; and in the place of one only where there is one."""
    path = "/rights/cart/one"
    assert told("one", "GET", path).status == 404
    assert told("one", "PUT", path, {"level": "operator"}, If_Match="*").status == 412
    assert told("one", "GET", path).status == 404
    given = told("one", "PUT", path, {"level": "operator"}, If_None_Match="*")
    assert (given.status, given.headers["Location"]) == (201, f"{REALM}{path}")
    assert told("one", "GET", path, If_None_Match=given.headers["ETag"]).status == 304
    assert told("other", "PUT", path, {"level": "owner"}, If_None_Match="*").status == 412
    assert told("other", "PUT", path, {"level": "owner"}, If_Match="*").status == 200


@pytest.mark.parametrize("path", ["", "/users", "/groups", "/robots", "/robot-groups", "/rights"])
def test_a_page_that_is_known_is_not_told_again(told: Ask, path: str) -> None:
    """Until it changes."""
    tag = told("one", "GET", path).headers["ETag"]
    known = told("one", "GET", path, If_None_Match=tag)
    assert (known.status, known.body, known.headers["ETag"]) == (304, b"", tag)
    name = f"known-{path.strip('/') or 'all'}"
    for what in ("robots", "users", "groups", "robot-groups"):
        assert told("other", "POST", f"/{what}", {"name": name}).status == 201
    assert told("other", "PUT", f"/rights/{name}/{name}", {"level": "viewer"}).status == 201
    assert told("one", "GET", path, If_None_Match=tag).status == 200
