"""``switchboard user`` and ``switchboard group``."""

from __future__ import annotations

from typing import Any

import pytest

from relay_db import queries
from relay_db.engine import Database
from relay_server.auth.passwords import verify_password

PASSWORD = "correct horse"


def _stored_hash(cli: Any, name: str) -> str | None:
    database = Database(f"sqlite:///{cli.data}/switchboard.db")
    with database.reading() as s:
        found = queries.find_user(s, name)
    database.close()
    assert found is not None
    return found.password_hash


def test_a_user_is_added_with_a_password_from_stdin(cli: Any) -> None:
    """The first line without its line end is stored as a hash."""
    answer = cli.json("user", "add", "Ann", "--admin", "--password-stdin", stdin=f"{PASSWORD}\r\nsecond line")
    assert answer == {"user": "ann", "admin": True, "disabled": False, "password": True, "guest_of": None}
    assert verify_password(PASSWORD, _stored_hash(cli, "ann"))


def test_a_password_is_asked_for_twice_and_not_shown(cli: Any) -> None:
    """Different inputs are asked for again; no input is shown, and stdout has only JSON."""
    typed = f"{PASSWORD}\nsomething else\n{PASSWORD}\n{PASSWORD}\n"
    result = cli("user", "add", "ann", "--json", stdin=typed)
    assert result.exit_code == 0
    assert (
        result.stdout
        == '{"user": "ann", "admin": false, "disabled": false, "password": true, "guest_of": null}\n'
    )
    assert PASSWORD not in result.output
    assert result.stderr.count("Password") >= 2
    assert verify_password(PASSWORD, _stored_hash(cli, "ann"))


def test_a_user_without_a_password_has_none(cli: Any) -> None:
    assert cli.json("user", "add", "report", "--no-password")["password"] is False
    assert _stored_hash(cli, "report") is None
    assert "exclude" in cli.fails("user", "add", "x", "--no-password", "--password-stdin", code=2)


@pytest.mark.parametrize(
    ("stdin", "words"),
    [
        ("short\n", "at least 8"),
        ("", "no password came"),
        ("x" * 2000, "at most 1024"),
        ("\n", "no password"),
    ],
)
def test_an_invalid_password_adds_no_user(cli: Any, stdin: str, words: str) -> None:
    """The error does not repeat the password."""
    reported = cli.fails("user", "add", "ann", "--password-stdin", stdin=stdin)
    assert words in reported
    assert "short" not in reported
    assert cli.json("user", "list") == []


def test_a_password_that_is_no_text_is_refused(cli: Any) -> None:
    """It has bytes that are not UTF-8."""
    assert "UTF-8" in cli.fails("user", "add", "ann", "--password-stdin", stdin=b"\xff\xfe\xfd\xfc12345\n")


@pytest.mark.parametrize("option", ["--password", "-p", "--password=secret"])
def test_a_password_is_never_an_argument(cli: Any, option: str) -> None:
    result = cli("user", "add", "ann", option, "secretive")
    assert result.exit_code == 2
    assert cli.json("user", "list") == []


@pytest.mark.parametrize("name", ["a b", "a\x1b[2Jb", "a\nb", "", "@lab", "x" * 64, "a\u202eb", "\udcff"])
def test_a_name_that_cannot_be_is_refused_inertly(cli: Any, name: str) -> None:
    """The error contains no control characters of the name."""
    reported = cli.fails("user", "add", name, "--no-password")
    assert reported.startswith("Error: the name of a user must")
    assert reported.rstrip("\n").isprintable()


def test_a_name_in_another_case_is_the_same_user(cli: Any) -> None:
    """Adding Ann after ann is refused before a password is asked for; disabling ANN disables ann."""
    cli.user("ann")
    assert "already" in cli.fails("user", "add", "Ann")
    assert cli.json("user", "disable", "ANN")["user"] == "ann"


def test_users_are_listed(cli: Any) -> None:
    cli.user("bob")
    cli.user("ann", "--admin")
    cli.ok("user", "disable", "bob")
    table = cli.ok("user", "list")
    assert [line.split() for line in table.splitlines()[2:]] == [
        ["ann", "admin", "yes"],
        ["bob", "user,", "disabled", "yes"],
    ]
    assert [(each["user"], each["admin"], each["disabled"]) for each in cli.json("user", "list")] == [
        ("ann", True, False),
        ("bob", False, True),
    ]


def test_a_user_is_disabled_and_enabled(cli: Any) -> None:
    """Both print the new state."""
    cli.user("ann")
    assert cli.json("user", "disable", "ann")["disabled"] is True
    assert cli.json("user", "enable", "ann")["disabled"] is False


def test_a_password_is_changed(cli: Any) -> None:
    cli.user("ann")
    cli.ok("user", "passwd", "ann", "--password-stdin", stdin="battery staple\n")
    hashed = _stored_hash(cli, "ann")
    assert verify_password("battery staple", hashed)
    assert not verify_password(PASSWORD, hashed)
    assert "no user 'eve'" in cli.fails("user", "passwd", "eve")


def test_removing_asks_first(cli: Any) -> None:
    """No and end of input keep the user; yes and --yes remove it."""
    cli.user("ann")
    cli.user("bob")
    for answer in ("n\n", ""):
        result = cli("user", "remove", "ann", stdin=answer)
        assert (result.exit_code, result.stdout) == (1, "")
    assert len(cli.json("user", "list")) == 2
    result = cli("user", "remove", "ann", "--json", stdin="y\n")
    assert (result.exit_code, result.stdout) == (0, '{"user": "ann", "removed": true}\n')
    cli.ok("user", "remove", "bob", "--yes")
    assert cli.json("user", "list") == []


@pytest.mark.parametrize("command", ["disable", "enable", "remove", "passwd"])
def test_an_unknown_user_is_reported(cli: Any, command: str) -> None:
    """The error says how to list known users."""
    assert cli.fails("user", command, "eve") == "Error: there is no user 'eve'; see 'switchboard user list'\n"


def test_groups_are_joined_and_left(cli: Any) -> None:
    cli.user("ann")
    assert cli.json("group", "add", "Lab") == {"group": "lab", "members": []}
    assert cli.json("group", "join", "lab", "ann") == {"group": "lab", "members": ["ann"]}
    assert cli.json("group", "list") == [{"group": "lab", "members": ["ann"]}]
    assert "ann" in cli.ok("group", "list")
    assert cli.json("group", "leave", "lab", "ann") == {"group": "lab", "members": []}
    assert "not in group" in cli.fails("group", "leave", "lab", "ann")
    assert "no user" in cli.fails("group", "join", "lab", "eve")
    assert "no group" in cli.fails("group", "join", "ops", "ann")
    assert "already" in cli.fails("group", "add", "LAB")


def test_a_group_is_removed(cli: Any) -> None:
    """The command asks for confirmation."""
    cli.ok("group", "add", "lab")
    assert cli("group", "remove", "lab", stdin="n\n").exit_code == 1
    assert cli.json("group", "remove", "lab", "--yes") == {"group": "lab", "removed": True}
    assert cli.json("group", "list") == []
