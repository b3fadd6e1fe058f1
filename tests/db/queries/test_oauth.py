"""OAuth clients, scopes and tokens that are refreshed, on both databases."""

from __future__ import annotations

import pytest

from relay_db import queries
from relay_db.engine import Database
from relay_db.queries import IssuedRecord, UserRecord
from relay_protocol.errors import Invalid, NotFound, Refused

ONE, TWO, THREE = "1" * 64, "2" * 64, "3" * 64
VERIFIER = "c" * 64


@pytest.fixture
def ann(database: Database) -> UserRecord:
    """A user with a password."""
    with database.begin() as s:
        return queries.add_user(s, "ann", "argon")


def family(database: Database, user: UserRecord, refresh: str, now: float = 1.0) -> int:
    """Begins a family."""
    with database.begin() as s:
        return queries.open_token_family(
            s, user.id, refresh, password_hash="argon", scope="viewer", expires=100.0, now=now
        )


def test_an_oauth_client_is_found_by_its_key(database: Database, ann: UserRecord) -> None:
    """With all its properties, unless its user is disabled."""
    with database.begin() as s:
        number = queries.add_oauth_client(s, ann.id, "key", VERIFIER, scope="viewer", label="report", now=5.0)
        record = queries.OAuthClientRecord(
            number, ann.id, "ann", "default", "key", VERIFIER, "viewer", "report", 5.0
        )
        assert queries.find_oauth_client(s, "key") == record
        assert queries.list_oauth_clients(s) == queries.list_oauth_clients(s, ann.id) == [record]
        assert queries.list_oauth_clients(s, ann.id + 1) == []
        for unknown in ("other", "", "\0", "\ud800", "schlüssel"):
            assert queries.find_oauth_client(s, unknown) is None
        queries.set_disabled(s, ann.id, True)
        assert queries.find_oauth_client(s, "key") is None


def test_an_oauth_client_needs_a_user_and_a_plain_label(database: Database, ann: UserRecord) -> None:
    with database.begin() as s:
        with pytest.raises(NotFound, match="no such user"):
            queries.add_oauth_client(s, 99, "key", VERIFIER, scope=None, label="", now=1.0)
        with pytest.raises(Invalid, match="label of an OAuth client"):
            queries.add_oauth_client(s, ann.id, "key", VERIFIER, scope=None, label="a\nb", now=1.0)


def test_a_user_has_a_bounded_number_of_oauth_clients(
    database: Database, ann: UserRecord, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One more is refused."""
    monkeypatch.setattr("relay_db.queries.oauth.MAX_OAUTH_CLIENTS", 1)
    with database.begin() as s:
        queries.add_oauth_client(s, ann.id, "one", VERIFIER, scope=None, label="", now=1.0)
        with pytest.raises(Invalid, match="may have 1 OAuth clients"):
            queries.add_oauth_client(s, ann.id, "two", VERIFIER, scope=None, label="", now=1.0)


def test_an_oauth_client_is_found_in_the_realm_of_its_user(database: Database, ann: UserRecord) -> None:
    with database.begin() as s:
        queries.add_realm(s, "lab")
        number = queries.add_oauth_client(s, ann.id, "key", VERIFIER, scope=None, label="", now=1.0)
        queries.set_disabled(s, ann.id, True)
        assert queries.find_oauth_client(s, "key") is None
        assert queries.oauth_client_in(s, "key", "Default") == number
        for key, realm in (("key", "lab"), ("key", "nowhere"), ("other", "default"), ("k\0", "default")):
            assert queries.oauth_client_in(s, key, realm) is None


def test_tokens_end_with_their_oauth_client(database: Database, ann: UserRecord) -> None:
    """Its removal counts as a change of rights."""
    with database.begin() as s:
        number = queries.add_oauth_client(s, ann.id, "key", VERIFIER, scope=None, label="", now=1.0)
        token = queries.create_token(
            s, ann.id, ONE, kind="access", expires=None, now=1.0, scope="viewer", oauth_client_id=number
        )
        principal = queries.principal_by_token(s, ONE, 2.0)
        assert principal is not None and principal.scope == "viewer"
        assert queries.issued_token(s, ONE, 2.0) == IssuedRecord(
            "access", ann.id, "ann", "default", "viewer", "key", 1.0, None, None
        )
        before = queries.revision(s)
        assert queries.remove_oauth_client(s, number)
        assert not queries.remove_oauth_client(s, number)
        assert not queries.token_is_live(s, token, 2.0)
        assert queries.revision(s) > before


def test_a_refresh_token_is_replaced(database: Database, ann: UserRecord) -> None:
    """The new one continues the old one; the family's access tokens stay valid."""
    number = family(database, ann, ONE)
    with database.begin() as s:
        queries.create_token(s, ann.id, "a" * 64, kind="access", expires=None, now=1.0, family_id=number)
        record = queries.refresh_token_family(s, ONE, TWO, 50.0)
        assert record == IssuedRecord("refresh", ann.id, "ann", "default", "viewer", None, 1.0, 100.0, number)
        assert queries.issued_token(s, ONE, 50.0) is None
        assert queries.issued_token(s, TWO, 50.0) == record
        assert queries.principal_by_token(s, "a" * 64, 50.0) is not None


def test_a_token_that_is_revoked_by_its_number_gets_no_successor(database: Database, ann: UserRecord) -> None:
    """Its refresh token ends too; those of other families do not."""
    number, other = family(database, ann, ONE), family(database, ann, THREE)
    with database.begin() as s:
        tokens = [
            queries.create_token(
                s, ann.id, each * 64, kind="access", expires=None, now=1.0, family_id=number_of
            )
            for each, number_of in (("a", number), ("b", number), ("c", other))
        ]
        assert queries.revoke_token(s, tokens[0])
        assert not queries.revoke_token(s, tokens[0])
        assert queries.refresh_token_family(s, ONE, TWO, 2.0) is None
        assert [each.id for each in queries.list_tokens(s, ann.id)] == [tokens[2]]
        assert queries.refresh_token_family(s, THREE, TWO, 2.0) is not None


def test_a_copied_refresh_token_ends_its_family(database: Database, ann: UserRecord) -> None:
    number = family(database, ann, ONE)
    with database.begin() as s:
        queries.create_token(s, ann.id, "a" * 64, kind="access", expires=None, now=1.0, family_id=number)
        queries.refresh_token_family(s, ONE, TWO, 2.0)
        before = queries.revision(s)
        assert queries.refresh_token_family(s, ONE, THREE, 3.0) is None
        assert queries.refresh_token_family(s, TWO, THREE, 3.0) is None
        assert queries.principal_by_token(s, "a" * 64, 3.0) is None
        assert queries.revision(s) > before


@pytest.mark.parametrize("presented", [TWO, "", "\0", "x"])
def test_invalid_refresh_tokens_are_rejected(database: Database, ann: UserRecord, presented: str) -> None:
    family(database, ann, ONE)
    with database.begin() as s:
        assert queries.refresh_token_family(s, presented, THREE, 2.0) is None
        assert queries.issued_token(s, ONE, 2.0) is not None


def test_an_expired_one_gives_nothing(database: Database, ann: UserRecord) -> None:
    family(database, ann, ONE)
    with database.begin() as s:
        assert queries.refresh_token_family(s, ONE, TWO, 100.0) is None
        queries.set_disabled(s, ann.id, True)
        assert queries.refresh_token_family(s, ONE, TWO, 50.0) is None
        assert queries.issued_token(s, ONE, 50.0) is None
        before = queries.revision(s)
        assert queries.purge_expired(s, 100.0) == 1
        # Tokens of the family may be cached elsewhere, so caches are invalidated.
        assert queries.revision(s) > before


def test_a_family_needs_the_password_that_was_proved(database: Database, ann: UserRecord) -> None:
    """A changed password begins none, and ends all existing ones."""
    family(database, ann, ONE)
    with database.begin() as s:
        queries.set_password(s, ann.id, "other")
        assert queries.issued_token(s, ONE, 2.0) is None
        with pytest.raises(Refused, match="changed while you logged in"):
            queries.open_token_family(s, ann.id, TWO, password_hash="argon", scope=None, expires=9.0, now=1.0)


def test_the_oldest_family_ends_first(
    database: Database, ann: UserRecord, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The number per user is limited."""
    monkeypatch.setattr("relay_db.queries.oauth.MAX_TOKEN_FAMILIES", 2)
    for each in (ONE, TWO, THREE):
        family(database, ann, each)
    with database.reading() as s:
        assert [queries.issued_token(s, each, 2.0) is not None for each in (ONE, TWO, THREE)] == [
            False,
            True,
            True,
        ]


@pytest.mark.parametrize("which", [ONE, TWO])
def test_a_revoked_refresh_token_takes_its_family_along(
    database: Database, ann: UserRecord, which: str
) -> None:
    number = family(database, ann, ONE)
    with database.begin() as s:
        queries.create_token(s, ann.id, "a" * 64, kind="access", expires=None, now=1.0, family_id=number)
        queries.refresh_token_family(s, ONE, TWO, 2.0)
        assert not queries.revoke_issued(s, which, "elsewhere")
        assert queries.revoke_issued(s, which, "default")
        assert not queries.revoke_issued(s, which, "default")
        assert queries.principal_by_token(s, "a" * 64, 3.0) is None


def test_a_revoked_access_token_is_alone(database: Database, ann: UserRecord) -> None:
    """Its family continues; a browser's session cannot be revoked this way."""
    number = family(database, ann, ONE)
    with database.begin() as s:
        queries.create_token(s, ann.id, "a" * 64, kind="access", expires=None, now=1.0, family_id=number)
        queries.create_token(s, ann.id, "b" * 64, kind="session", expires=None, now=1.0)
        assert queries.revoke_issued(s, "a" * 64, "default")
        assert not queries.revoke_issued(s, "b" * 64, "default")
        assert queries.issued_token(s, "b" * 64, 2.0) is None
        assert queries.issued_token(s, ONE, 2.0) is not None
