"""``switchboard oauth-client``, and scopes of tokens."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from sqlalchemy.orm import Session

from relay_db import queries
from relay_db.engine import Database
from relay_server.auth.passwords import digest_ha1, token_hash


@pytest.fixture
def ann(cli: Any) -> Any:
    """The command line, with a user."""
    cli.ok("user", "add", "ann", "--no-password")
    return cli


@contextmanager
def reading(cli: Any) -> Iterator[Session]:
    """The command line's database."""
    database = Database(f"sqlite:///{cli.data}/switchboard.db")
    with database.reading() as session:
        yield session
    database.close()


def test_an_oauth_client_is_added_with_a_secret_that_is_shown_once(ann: Any) -> None:
    made = ann.json("oauth-client", "add", "ann", "--scope", "viewer operator@rover", "--label", "nightly")
    with reading(ann) as s:
        record = queries.find_oauth_client(s, made["key"])
    assert record is not None
    assert record.digest_ha1 == digest_ha1(made["key"], made["secret"])
    assert (record.scope, record.label, record.user) == ("viewer operator@rover", "nightly", "ann")
    [listed] = ann.json("oauth-client", "list")
    assert listed["key"] == made["key"] and "secret" not in listed and "digest_ha1" not in listed
    table = ann.ok("oauth-client", "list", "--user", "ann")
    assert "nightly" in table and made["secret"] not in table and record.digest_ha1 not in table


def test_an_oauth_client_is_revoked(ann: Any) -> None:
    number = str(ann.json("oauth-client", "add", "ann")["id"])
    assert ann.json("oauth-client", "revoke", number) == {"id": int(number), "revoked": True}
    assert "no OAuth client" in ann.fails("oauth-client", "revoke", number)
    assert ann.json("oauth-client", "list") == []


def test_an_oauth_client_needs_a_live_user_and_a_scope_that_can_be_read(ann: Any) -> None:
    assert "no user" in ann.fails("oauth-client", "add", "eve")
    assert "is not a scope" in ann.fails("oauth-client", "add", "ann", "--scope", "king")
    ann.ok("user", "disable", "ann")
    assert "is disabled" in ann.fails("oauth-client", "add", "ann")


def test_a_token_may_be_for_less_than_its_user_may(ann: Any) -> None:
    """The list shows its scope."""
    made = ann.json("token", "create", "ann", "--scope", "viewer@rover")
    with reading(ann) as s:
        principal = queries.principal_by_token(s, token_hash(made["token"]), time.time())
    assert principal is not None and principal.scope == "viewer@rover"
    assert ann.json("token", "list")[0]["scope"] == "viewer@rover"
    assert "is not a scope" in ann.fails("token", "create", "ann", "--scope", "king")


def test_key_and_secret_stand_in_lines_of_their_own(ann: Any) -> None:
    result = ann("oauth-client", "add", "ann")
    assert [each.split()[0] for each in result.stdout.splitlines()] == ["key", "secret"]
    assert "not shown again" in result.stderr
