"""``switchboard right`` and ``switchboard token``."""

from __future__ import annotations

import time
from typing import Any

import pytest

from relay_db import queries
from relay_db.engine import Database
from relay_server.auth.passwords import token_hash


@pytest.fixture
def people(cli: Any) -> Any:
    """User ann, in group lab; robot rover."""
    cli.ok("user", "add", "ann", "--no-password")
    cli.ok("group", "add", "lab")
    cli.ok("group", "join", "lab", "ann")
    cli.ok("robot", "add", "rover")
    return cli


def test_rights_are_granted_and_listed(people: Any) -> None:
    """A second grant replaces the first."""
    people.ok("right", "grant", "ann", "rover", "owner")
    answer = people.json(
        "right",
        "grant",
        "ANN",
        "rover",
        "viewer",
        "--allow",
        "call:/reset",
        "--deny",
        "*:/arm/*",
        "--deny",
        "call:*",
    )
    own = {
        "holder": "ann",
        "robot": "rover",
        "level": "viewer",
        "allow": ["call:/reset"],
        "deny": ["*:/arm/*", "call:*"],
    }
    assert answer == own
    people.ok("right", "grant", "@lab", "rover", "operator")
    groups = {"holder": "@lab", "robot": "rover", "level": "operator", "allow": [], "deny": []}
    listed = people.json("right", "list")
    assert sorted(listed, key=lambda each: each["holder"]) == [groups, own]
    assert len(people.json("right", "list", "--user", "ann")) == 2
    assert len(people.json("right", "list", "--robot", "rover")) == 2
    table = people.ok("right", "list")
    assert "@lab" in table
    assert "*:/arm/* call:*" in table


def test_rights_are_revoked(people: Any) -> None:
    people.ok("right", "grant", "ann", "rover", "viewer")
    people.ok("right", "grant", "@lab", "rover", "viewer")
    assert people.json("right", "revoke", "ann", "rover") == {
        "holder": "ann",
        "robot": "rover",
        "revoked": True,
    }
    assert "ann has no right of its own on rover" in people.fails("right", "revoke", "ann", "rover")
    people.ok("right", "revoke", "@lab", "rover")
    assert people.json("right", "list") == []


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("eve", "rover", "viewer"), "no user 'eve'"),
        (("@ops", "rover", "viewer"), "no group 'ops'"),
        (("ann", "arm", "viewer"), "no robot 'arm'"),
        (("ann", "rover", "viewer", "--allow", "fly:/x"), "'fly:/x' is not a pattern"),
        (("ann", "rover", "viewer", "--deny", "call:x"), "must begin with /"),
    ],
)
def test_a_right_that_cannot_be_is_refused(people: Any, arguments: tuple[str, ...], words: str) -> None:
    assert words in people.fails("right", "grant", *arguments)
    assert people.json("right", "list") == []


def test_an_unknown_level_is_wrong_usage(people: Any) -> None:
    """The error lists the levels."""
    assert "viewer" in people.fails("right", "grant", "ann", "rover", "god", code=2)


def test_lists_of_unauthenticated_clients_are_refused(people: Any) -> None:
    assert "no robot" in people.fails("right", "list", "--robot", "arm")
    assert "no user" in people.fails("right", "list", "--user", "eve")
    assert "no user" in people.fails("token", "list", "--user", "eve")


def test_a_token_acts_as_its_user_until_it_expires(people: Any) -> None:
    before = time.time()
    answer = people.json("token", "create", "ann", "--ttl", "1h", "--label", "nightly")
    assert answer["expires_in"] == 3600
    database = Database(f"sqlite:///{people.data}/switchboard.db")
    with database.reading() as s:
        hashed = token_hash(answer["token"])
        principal = queries.principal_by_token(s, hashed, time.time())
        assert principal is not None
        assert principal.name == "ann"
        assert principal.expires is not None
        assert before + 3600 <= principal.expires <= time.time() + 3600
        assert queries.principal_by_token(s, hashed, time.time() + 3601) is None
    database.close()


def test_without_json_stdout_has_only_the_token(people: Any) -> None:
    """So that a shell can assign it to a variable."""
    result = people("token", "create", "ann")
    assert result.exit_code == 0
    assert result.stdout.startswith("swb_")
    assert result.stdout.count("\n") == 1
    assert "not shown again" in result.stderr


def test_tokens_are_listed_without_secrets(people: Any) -> None:
    """They have number, user, kind, times and label."""
    answer = people.json("token", "create", "ann", "--ttl", "90s", "--label", "[red]nightly")
    [listed] = people.json("token", "list")
    assert listed["expires"] - listed["created"] == pytest.approx(90)
    assert {name: listed[name] for name in ("id", "user", "kind", "label")} == {
        "id": answer["id"],
        "user": "ann",
        "kind": "access",
        "label": "[red]nightly",
    }
    table = people.ok("token", "list", "--user", "ann")
    assert "[red]nightly" in table
    assert answer["token"] not in table
    assert token_hash(answer["token"]) not in table


def test_a_token_is_revoked(people: Any) -> None:
    number = str(people.json("token", "create", "ann")["id"])
    assert people.json("token", "revoke", number) == {"id": int(number), "revoked": True}
    assert people.json("token", "list") == []
    assert f"no token {number}" in people.fails("token", "revoke", number)
    for wrong in ("x", "0", "99999999999999999999"):
        people.fails("token", "revoke", wrong, code=2)


@pytest.mark.parametrize("ttl", ["", "1", "1y", "-1h", "0s", "1h ", "99999w", "1e3s", "١h"])
def test_a_span_that_cannot_be_is_refused(people: Any, ttl: str) -> None:
    """The error shows a valid one."""
    assert "write 90s, 15m, 1h" in people.fails("token", "create", "ann", "--ttl", ttl)


def test_a_disabled_user_gets_no_token(people: Any) -> None:
    """It would not work."""
    people.ok("user", "disable", "ann")
    assert "disabled" in people.fails("token", "create", "ann")
