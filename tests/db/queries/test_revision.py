"""The counter that notifies a running relay of changed rights."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from sqlalchemy.orm import Session

from relay_db import queries
from relay_db.engine import Database

HASH = "a" * 64
KEY = b"k" * 32


@pytest.fixture
def filled(database: Database) -> Database:
    """One of each, all with the number 1: user, group, robot, right, token, code; and an empty realm."""
    with database.begin() as s:
        ann, lab = queries.add_user(s, "ann", None), queries.add_group(s, "lab")
        rover = queries.add_robot(s, "rover")
        queries.add_realm(s, "empty")
        queries.add_member(s, lab.id, ann.id)
        queries.grant_right(s, rover.id, "viewer", user_id=ann.id)
        token = queries.create_token(s, ann.id, HASH, kind="access", expires=None, now=1.0)
        queries.issue_enrolment_code(s, rover.id, HASH, expires=10.0)
        assert (ann.id, lab.id, rover.id, token) == (1, 1, 1, 1)
    return database


CHANGES: dict[str, Callable[[Session], object]] = {
    "a realm is added": lambda s: queries.add_realm(s, "plant"),
    "a realm is removed": lambda s: queries.remove_realm(s, "empty"),
    "a user is added": lambda s: queries.add_user(s, "bob", None),
    "a password is set": lambda s: queries.set_password(s, 1, "x"),
    "a user is disabled": lambda s: queries.set_disabled(s, 1, True),
    "a user becomes admin": lambda s: queries.set_admin(s, 1, True),
    "a user is removed": lambda s: queries.remove_user(s, 1),
    "a group is added": lambda s: queries.add_group(s, "ops"),
    "a group is removed": lambda s: queries.remove_group(s, 1),
    "a user leaves a group": lambda s: queries.remove_member(s, 1, 1),
    "a user joins a group": lambda s: queries.add_member(
        s, queries.add_group(s, "x").id, queries.add_user(s, "y", None).id
    ),
    "a robot is added": lambda s: queries.add_robot(s, "arm"),
    "a robot is removed": lambda s: queries.remove_robot(s, 1),
    "a key is enrolled": lambda s: queries.redeem_enrolment_code(s, "rover", HASH, KEY, "ff", "", 1.0),
    "a right is granted": lambda s: queries.grant_right(s, 1, "owner", group_id=1),
    "a right is revoked": lambda s: queries.revoke_right(s, 1, user_id=1),
    "a token is revoked": lambda s: queries.revoke_token(s, 1),
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_changes_of_access_count_up_the_revision(
    filled: Database, change: Callable[[Session], object]
) -> None:
    """In the same transaction as the change itself."""
    with filled.begin() as s:
        before = queries.revision(s)
        change(s)
        assert queries.revision(s) > before


def test_a_revoked_key_counts_the_revision_up(filled: Database) -> None:
    """A link that uses it must be cut."""
    with filled.begin() as s:
        queries.redeem_enrolment_code(s, "rover", HASH, KEY, "ff", "", 1.0)
        before = queries.revision(s)
        queries.revoke_key(s, 1, "ff", 2.0)
        assert queries.revision(s) > before


def test_other_changes_leave_the_revision(filled: Database) -> None:
    with filled.begin() as s:
        before = queries.revision(s)
        queries.store_events(s, [queries.NewStoredEvent("default", 1.0, "relay", "online", None, None, "{}")])
        queries.append_audit(s, at=1.0, actor="a", action="b", target="c")
        queries.create_token(s, 1, "b" * 64, kind="session", expires=None, now=1.0)
        queries.issue_enrolment_code(s, 1, "c" * 64, expires=10.0)
        assert queries.revision(s) == before


def test_a_change_that_is_rolled_back_does_not_count(filled: Database) -> None:
    """The relay has nothing to apply."""
    with filled.reading() as s:
        before = queries.revision(s)
    with pytest.raises(ZeroDivisionError), filled.begin() as s:
        queries.remove_user(s, 1)
        raise ZeroDivisionError
    with filled.reading() as s:
        assert queries.revision(s) == before
        assert queries.user_is_live(s, 1)
