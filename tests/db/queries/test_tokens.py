"""Tokens, on both databases."""

from __future__ import annotations

import threading

import pytest

from relay_db import queries
from relay_db.engine import Database
from relay_db.queries import PrincipalRecord, UserRecord
from relay_protocol.errors import Invalid, NotFound, Refused

HASH = "a" * 64


@pytest.fixture
def ann(database: Database) -> UserRecord:
    """A user."""
    with database.begin() as s:
        return queries.add_user(s, "ann", None, admin=True)


def test_a_token_stands_for_its_user(database: Database, ann: UserRecord) -> None:
    """Until it expires."""
    with database.begin() as s:
        token = queries.create_token(s, ann.id, HASH, kind="access", label="mine", expires=10.0, now=1.0)
    with database.reading() as s:
        principal = PrincipalRecord(ann.id, "ann", "default", True, token, 10.0)
        assert queries.principal_by_token(s, HASH, 9.9) == principal
        assert queries.principal_by_token(s, HASH, 10.0) is None
        assert queries.token_is_live(s, token, 9.9)
        assert not queries.token_is_live(s, token, 10.0)
        assert queries.principals_by_ids(s, {token, 99}, 9.9) == [principal]
        assert queries.principals_by_ids(s, {token, 99}, 10.0) == []
        assert queries.list_tokens(s) == [
            queries.TokenRecord(token, ann.id, "ann", "access", "mine", 1.0, 10.0)
        ]
        assert queries.list_tokens(s, user_id=99) == []


def test_a_token_serves_its_kind_only(database: Database, ann: UserRecord) -> None:
    """A login link is no access token, and a session counts only for sessions."""
    with database.begin() as s:
        queries.create_token(s, ann.id, HASH, kind="login", expires=None, now=1.0)
        queries.create_token(s, ann.id, "b" * 64, kind="session", expires=None, now=1.0)
    with database.reading() as s:
        assert queries.principal_by_token(s, HASH, 2.0) is None
        assert queries.principal_by_token(s, "b" * 64, 2.0, kinds=("access",)) is None
        assert queries.principal_by_token(s, "b" * 64, 2.0) is not None


def test_a_revoked_token_is_worthless(database: Database, ann: UserRecord) -> None:
    with database.begin() as s:
        token = queries.create_token(s, ann.id, HASH, kind="access", expires=None, now=1.0)
        assert queries.revoke_token(s, token)
        assert not queries.revoke_token(s, token)
        assert queries.principal_by_token(s, HASH, 2.0) is None
        assert not queries.token_is_live(s, token, 2.0)


def test_a_login_link_works_once(database: Database, ann: UserRecord) -> None:
    with database.begin() as s:
        queries.create_token(s, ann.id, HASH, kind="login", expires=10.0, now=1.0)
    start = threading.Barrier(2)
    got: list[PrincipalRecord | None] = []

    def use() -> None:
        start.wait(timeout=30)
        with database.begin() as s:
            got.append(queries.consume_login(s, HASH, 5.0))

    threads = [threading.Thread(target=use) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(timeout=30)
    assert [each.name for each in got if each is not None] == ["ann"]
    with database.begin() as s:
        assert queries.consume_login(s, HASH, 5.0) is None


def test_an_expired_login_link_is_worthless(database: Database, ann: UserRecord) -> None:
    with database.begin() as s:
        queries.create_token(s, ann.id, HASH, kind="login", expires=10.0, now=1.0)
        queries.create_token(s, ann.id, "b" * 64, kind="access", expires=None, now=1.0)
        assert queries.consume_login(s, HASH, 10.0) is None
        assert queries.consume_login(s, "b" * 64, 5.0) is None
        assert queries.principal_by_token(s, "b" * 64, 5.0) is not None


def test_a_purge_deletes_expired_tokens_and_codes(database: Database, ann: UserRecord) -> None:
    """Expired tokens, and expired and used codes; others stay."""
    key = b"k" * 32
    with database.begin() as s:
        rover, arm = queries.add_robot(s, "rover"), queries.add_robot(s, "arm")
        queries.create_token(s, ann.id, "1" * 64, kind="session", expires=5.0, now=1.0)
        lasting = queries.create_token(s, ann.id, "2" * 64, kind="access", expires=50.0, now=1.0)
        forever = queries.create_token(s, ann.id, "3" * 64, kind="access", expires=None, now=1.0)
        queries.issue_enrolment_code(s, rover.id, "4" * 64, expires=50.0)
        queries.redeem_enrolment_code(s, "rover", "4" * 64, key, "ff", "", 2.0)
        queries.issue_enrolment_code(s, rover.id, "5" * 64, expires=5.0)
        queries.issue_enrolment_code(s, arm.id, "6" * 64, expires=50.0)
        assert queries.purge_expired(s, 10.0) == 3
        assert [token.id for token in queries.list_tokens(s)] == [lasting, forever]
        assert queries.redeem_enrolment_code(s, "arm", "6" * 64, key, "ff", "", 11.0) == arm


def test_tokens_that_cannot_be_are_refused(database: Database, ann: UserRecord) -> None:
    with database.begin() as s:
        with pytest.raises(NotFound):
            queries.create_token(s, 99, HASH, kind="access", expires=None, now=1.0)
        with pytest.raises(Invalid, match="label"):
            queries.create_token(s, ann.id, HASH, kind="access", label="a\nb", expires=None, now=1.0)


def test_a_session_opens_only_while_the_password_is_the_one_that_was_verified(
    database: Database, ann: UserRecord
) -> None:

    def opens(stored: str | None) -> int:
        with database.begin() as s:
            return queries.open_session(s, ann.id, HASH, password_hash=stored, expires=9.0, now=1.0)

    first = opens(None)
    with database.begin() as s:
        assert [(each.id, each.kind) for each in queries.list_tokens(s)] == [(first, "session")]
        queries.set_password(s, ann.id, "hash")
    with pytest.raises(Refused, match="log in again"):
        opens(None)
    opens("hash")
    with database.begin() as s:
        queries.set_disabled(s, ann.id, True)
        queries.revoke_token(s, queries.list_tokens(s)[0].id)
    with pytest.raises(Refused):
        opens("hash")
    with database.begin() as s:
        assert not queries.list_tokens(s)
        queries.remove_user(s, ann.id)
    with pytest.raises(Refused):
        opens("hash")
