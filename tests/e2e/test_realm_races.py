"""Two administrators manage a realm at once: unseen changes are not overwritten, and known lists are not sent
again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest

from tests.worlds.http_requests import Answer, ask
from tests.worlds.relay_process import Relay

REALM = "/api/v1/realm"

Ask = Callable[..., Answer]


@pytest.fixture(scope="module")
def reported(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Ask]:
    """Sends requests of the administrators of a relay with a user ``wario`` and a robot ``cart`` about their
    realm.
    """
    relay = Relay(tmp_path_factory.mktemp("together"))
    tokens = {name: relay.user(name, admin=True) for name in ("one", "other")}
    relay.user("wario")
    relay.cli("robot", "add", "cart")
    relay.cli("right", "grant", "wario", "cart", "viewer")

    def reported(who: str, method: str, path: str, body: Any = None, **headers: str) -> Answer:
        sent = {name.replace("_", "-"): value for name, value in headers.items()}
        return ask(relay.http_port, method, f"{REALM}{path}", body, headers=sent, token=tokens[who])

    yield reported
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
def test_two_administrators_do_not_overwrite_each_other(
    reported: Ask, path: str, mine: Any, theirs: Any
) -> None:
    """A request with the tag of an older state fails; after reading again it succeeds."""
    method = "PUT" if path.startswith("/rights") else "PATCH"
    seen = reported("one", "GET", path).headers["ETag"]
    other = reported("other", method, path, theirs)
    assert other.status == 200
    late = reported("one", method, path, mine, If_Match=seen)
    assert (late.status, late.json["code"]) == (412, "not_as_before")
    now = reported("one", "GET", path, If_None_Match=seen)
    assert (now.status, now.json, now.headers["ETag"]) == (200, other.json, other.headers["ETag"])
    done = reported("one", method, path, mine, If_Match=now.headers["ETag"])
    assert done.status == 200 and done.json != now.json
    assert reported("one", "GET", path, If_None_Match=done.headers["ETag"]).status == 304
    # A request without a tag changes any state.
    again = {"disabled": False} if path.startswith("/users") else theirs
    assert reported("other", method, path, again).status == 200
    assert reported("one", "GET", path, If_None_Match=done.headers["ETag"]).status == 200


def test_a_right_is_given_only_where_there_is_none(reported: Ask) -> None:
    """With that condition; replacing needs an existing one."""
    path = "/rights/cart/one"
    assert reported("one", "GET", path).status == 404
    assert reported("one", "PUT", path, {"level": "operator"}, If_Match="*").status == 412
    assert reported("one", "GET", path).status == 404
    given = reported("one", "PUT", path, {"level": "operator"}, If_None_Match="*")
    assert (given.status, given.headers["Location"]) == (201, f"{REALM}{path}")
    assert reported("one", "GET", path, If_None_Match=given.headers["ETag"]).status == 304
    assert reported("other", "PUT", path, {"level": "owner"}, If_None_Match="*").status == 412
    assert reported("other", "PUT", path, {"level": "owner"}, If_Match="*").status == 200


@pytest.mark.parametrize("path", ["", "/users", "/groups", "/robots", "/robot-groups", "/rights"])
def test_a_page_that_is_known_is_not_sent_again(reported: Ask, path: str) -> None:
    """Until it changes."""
    tag = reported("one", "GET", path).headers["ETag"]
    known = reported("one", "GET", path, If_None_Match=tag)
    assert (known.status, known.body, known.headers["ETag"]) == (304, b"", tag)
    name = f"known-{path.strip('/') or 'all'}"
    for what in ("robots", "users", "groups", "robot-groups"):
        assert reported("other", "POST", f"/{what}", {"name": name}).status == 201
    assert reported("other", "PUT", f"/rights/{name}/{name}", {"level": "viewer"}).status == 201
    assert reported("one", "GET", path, If_None_Match=tag).status == 200
