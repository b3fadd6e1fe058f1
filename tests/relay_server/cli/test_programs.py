"""``switchboard program``, and scopes of tokens."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from sqlalchemy.orm import Session

from relay_db import queries
from relay_db.engine import Database
from relay_server.auth.passwords import token_hash, verifier


@pytest.fixture
def ann(cli: Any) -> Any:
    """The command line, with a user."""
    cli.ok("user", "add", "ann", "--no-password")
    return cli


@contextmanager
def reading(cli: Any) -> Iterator[Session]:
    """Its database."""
    database = Database(f"sqlite:///{cli.data}/switchboard.db")
    with database.reading() as session:
        yield session
    database.close()


def test_a_program_is_added_with_a_secret_that_is_shown_once(ann: Any) -> None:
    """Only what it can be checked by is kept."""
    made = ann.json("program", "add", "ann", "--scope", "viewer operator@rover", "--label", "nightly")
    with reading(ann) as s:
        record = queries.find_program(s, made["key"])
    assert record is not None
    assert record.verifier == verifier(made["key"], made["secret"])
    assert (record.scope, record.label, record.user) == ("viewer operator@rover", "nightly", "ann")
    [listed] = ann.json("program", "list")
    assert listed["key"] == made["key"] and "secret" not in listed and "verifier" not in listed
    table = ann.ok("program", "list", "--user", "ann")
    assert "nightly" in table and made["secret"] not in table and record.verifier not in table


def test_a_program_is_revoked(ann: Any) -> None:
    """By its number, once."""
    number = str(ann.json("program", "add", "ann")["id"])
    assert ann.json("program", "revoke", number) == {"id": int(number), "revoked": True}
    assert "no program" in ann.fails("program", "revoke", number)
    assert ann.json("program", "list") == []


def test_a_program_needs_a_live_user_and_a_scope_that_can_be_read(ann: Any) -> None:
    """Else it is refused in words."""
    assert "no user" in ann.fails("program", "add", "eve")
    assert "is no scope" in ann.fails("program", "add", "ann", "--scope", "king")
    ann.ok("user", "disable", "ann")
    assert "is disabled" in ann.fails("program", "add", "ann")


def test_a_token_may_be_for_less_than_its_user_may(ann: Any) -> None:
    """Its scope is listed with it."""
    made = ann.json("token", "create", "ann", "--scope", "viewer@rover")
    with reading(ann) as s:
        principal = queries.principal_by_token(s, token_hash(made["token"]), time.time())
    assert principal is not None and principal.scope == "viewer@rover"
    assert ann.json("token", "list")[0]["scope"] == "viewer@rover"
    assert "is no scope" in ann.fails("token", "create", "ann", "--scope", "king")


def test_key_and_secret_stand_in_lines_of_their_own(ann: Any) -> None:
    """For people, who copy them; that the secret comes once is said beside."""
    result = ann("program", "add", "ann")
    assert [each.split()[0] for each in result.stdout.splitlines()] == ["key", "secret"]
    assert "not shown again" in result.stderr
