"""Robots and users of several realms, on both databases."""

from __future__ import annotations

from typing import Any

import pytest
from sqlalchemy.orm import Session

from relay_db import queries
from relay_db.engine import Database
from relay_protocol.errors import Invalid, NotFound, Refused
from relay_protocol.rights import Level

HASH = "argon2id$whatever"
NOW = 1000.0


def _labs(s: Session) -> Any:
    """lab1 with a robot ``mobile``, lab2 with a user ``ann`` and an administrator ``root``."""
    for realm in ("lab1", "lab2"):
        queries.add_realm(s, realm)
    ann = queries.add_user(s, "ann", None, realm="lab2")
    root = queries.add_user(s, "root", None, admin=True, realm="lab2")
    return queries.add_robot(s, "mobile", realm="lab1"), ann, root


def _log_in(s: Session, user_id: int, token: str) -> int:
    """With the password whose hash is :data:`HASH`."""
    return queries.open_session(s, user_id, token * 64, password_hash=HASH, expires=NOW + 60, now=NOW)


def test_a_shared_robot_is_found_in_each_of_its_realms(database: Database) -> None:
    with database.begin() as s:
        mobile, _, _ = _labs(s)
        assert queries.find_robot(s, "mobile", "lab2") is None
        queries.share_robot(s, mobile.id, "lab2")
        assert [queries.find_robot(s, "mobile", each) for each in ("lab1", "lab2", "default")] == [
            mobile,
            mobile,
            None,
        ]
        assert [queries.list_robots(s, each) for each in ("lab1", "lab2", None)] == [[mobile]] * 3
        assert queries.robot_shares(s) == {mobile.id: frozenset({"lab2"})}
        assert [queries.realm_size(s, each).robots for each in ("lab1", "lab2")] == [1, 1]
        assert mobile.full == "mobile@lab1"


def test_rights_on_a_shared_robot_are_given_in_each_realm(database: Database) -> None:
    """Not before it is shared; the lists of a realm have only its own rights."""
    with database.begin() as s:
        mobile, ann, root = _labs(s)
        luigi = queries.add_user(s, "luigi", None, realm="lab1")
        queries.grant_right(s, mobile.id, "owner", user_id=luigi.id, allow=["call:/a"])
        with pytest.raises(Invalid, match="not belong to the realm"):
            queries.grant_right(s, mobile.id, "viewer", user_id=ann.id)
        assert queries.grants_for(s, root.id, mobile.id) == []
        queries.share_robot(s, mobile.id, "lab2")
        queries.grant_right(s, mobile.id, "viewer", user_id=ann.id)
        assert [each.level for each in queries.grants_for(s, ann.id, mobile.id)] == [Level.VIEWER]
        assert [robot for robot, _ in queries.robots_with_grants(s, ann.id)] == [mobile]
        assert [each.level for each in queries.grants_for(s, root.id, mobile.id)] == [Level.OWNER]
        assert [each.user for each in queries.list_right_holders(s, "lab1")] == ["luigi"]
        assert [each.user for each in queries.list_right_holders(s, "lab2", robot_id=mobile.id)] == ["ann"]
        assert [queries.count_patterns(s, realm=each) for each in ("lab1", "lab2")] == [1, 0]
        assert [queries.realm_size(s, each).rights for each in ("lab1", "lab2")] == [1, 1]
        assert [(each.user, each.realm) for each in queries.list_rights(s, robot_id=mobile.id)] == [
            ("ann", "lab2"),
            ("luigi", "lab1"),
        ]


def test_unsharing_removes_rights_groups_and_entries_of_the_realm(database: Database) -> None:
    """Rights, memberships in groups, and registry entries; those of its own realm stay."""
    with database.begin() as s:
        mobile, ann, root = _labs(s)
        luigi = queries.add_user(s, "luigi", None, realm="lab1")
        queries.share_robot(s, mobile.id, "lab2")
        crew, cleaners = queries.add_group(s, "crew", "lab2"), queries.add_robot_group(s, "cleaners", "lab2")
        queries.grant_right(s, mobile.id, "viewer", user_id=ann.id)
        queries.grant_right(s, mobile.id, "viewer", group_id=crew.id)
        queries.grant_right(s, mobile.id, "viewer", user_id=luigi.id)
        queries.add_to_robot_group(s, cleaners.id, mobile.id)
        queries.unshare_robot(s, mobile.id, "lab2")
        assert [each.user for each in queries.list_rights(s)] == ["luigi"]
        found = queries.find_robot_group(s, "cleaners", "lab2")
        assert found is not None and found.robots == ()
        assert queries.find_robot(s, "mobile", "lab2") is None
        assert [queries.grants_for(s, each.id, mobile.id) for each in (ann, root)] == [[], []]
        with pytest.raises(NotFound, match="not belong to the realm"):
            queries.unshare_robot(s, mobile.id, "lab2")


def test_robots_are_shared_where_their_name_is_free(database: Database) -> None:
    """Once, with an existing realm; a robot stays in its own realm."""
    with database.begin() as s:
        mobile, _, _ = _labs(s)
        other = queries.add_robot(s, "mobile", realm="lab2")
        with pytest.raises(Invalid, match="another robot"):
            queries.share_robot(s, mobile.id, "lab2")
        queries.remove_robot(s, other.id)
        queries.share_robot(s, mobile.id, "lab2")
        for realm in ("lab1", "lab2"):
            with pytest.raises(Invalid, match="already"):
                queries.share_robot(s, mobile.id, realm)
            with pytest.raises(Invalid, match="already"):
                queries.add_robot(s, "mobile", realm=realm)
        with pytest.raises(NotFound, match="no such realm"):
            queries.share_robot(s, mobile.id, "lab3")
        with pytest.raises(NotFound, match="no such robot"):
            queries.share_robot(s, 99, "lab2")
        with pytest.raises(Refused, match="own realm"):
            queries.unshare_robot(s, mobile.id, "lab1")


def test_a_realm_with_a_robot_of_another_stays(database: Database) -> None:
    """Until the robot is unshared or removed."""
    with database.begin() as s:
        mobile, ann, root = _labs(s)
        for each in (ann, root):
            queries.remove_user(s, each.id)
        queries.share_robot(s, mobile.id, "lab2")
        with pytest.raises(Refused, match="robots"):
            queries.remove_realm(s, "lab2")
        queries.remove_robot(s, mobile.id)
        queries.remove_realm(s, "lab2")
        assert queries.robot_shares(s) == {}


def test_keys_are_handed_in_under_the_own_realm(database: Database) -> None:
    """A code is not valid under the robot's name elsewhere."""
    with database.begin() as s:
        mobile, _, _ = _labs(s)
        queries.share_robot(s, mobile.id, "lab2")
        queries.issue_enrolment_code(s, mobile.id, "c" * 64, NOW + 60)
        key = "c" * 64, b"k" * 32, "f" * 64, "tests", NOW
        with pytest.raises(Refused):
            queries.redeem_enrolment_code(s, "mobile", *key, realm="lab2")
        assert queries.redeem_enrolment_code(s, "mobile", *key, realm="lab1") == mobile
        assert queries.robot_key(s, "mobile", "f" * 64, "lab2") is None
        assert queries.robot_key(s, "mobile", "f" * 64, "lab1") is not None


def test_a_linked_account_has_the_password_of_the_home_account(database: Database) -> None:
    with database.begin() as s:
        queries.add_realm(s, "lab1")
        toad = queries.add_user(s, "toad", HASH, admin=True)
        guest = queries.add_linked_account(s, toad.id, "lab1")
        assert (guest.full, guest.home, guest.admin) == ("toad@lab1", "toad", False)
        assert queries.find_user(s, "toad", "lab1") == guest
        assert guest.password_hash == HASH
        _log_in(s, guest.id, "e")
        for number, user in enumerate((toad, guest)):
            queries.create_token(s, user.id, f"{number}" * 64, kind="session", expires=None, now=NOW)
        with pytest.raises(Refused, match="change it there"):
            queries.set_password(s, guest.id, "another")
        queries.set_password(s, toad.id, "another")
        assert queries.list_tokens(s) == []
        with pytest.raises(Refused):
            _log_in(s, guest.id, "f")
        found = queries.get_user(s, guest.id)
        assert found is not None and found.password_hash == "another"


def test_disabling_a_user_disables_linked_accounts(database: Database) -> None:
    with database.begin() as s:
        for realm in ("lab1", "lab2"):
            queries.add_realm(s, realm)
        toad = queries.add_user(s, "toad", HASH)
        guest = queries.add_linked_account(s, toad.id, "lab1")
        rover = queries.add_robot(s, "rover", realm="lab1")
        queries.grant_right(s, rover.id, "viewer", user_id=guest.id)
        token = queries.create_token(s, guest.id, "a" * 64, kind="access", expires=None, now=NOW)
        assert queries.token_is_live(s, token, NOW)
        queries.set_disabled(s, toad.id, True)
        found = queries.get_user(s, guest.id)
        assert found is not None and found.disabled
        assert not queries.user_is_live(s, guest.id)
        assert not queries.token_is_live(s, token, NOW)
        assert queries.principal_by_token(s, "a" * 64, NOW) is None
        assert queries.grants_for(s, guest.id, rover.id) == []
        with pytest.raises(Refused):
            _log_in(s, guest.id, "b")
        queries.set_disabled(s, toad.id, False)
        queries.set_disabled(s, guest.id, True)
        assert [queries.user_is_live(s, each.id) for each in (toad, guest)] == [True, False]
        queries.add_linked_account(s, guest.id, "lab2")
        queries.remove_user(s, toad.id)
        assert queries.list_users(s) == []


def test_linked_accounts_are_found_by_any_of_them(database: Database) -> None:
    with database.begin() as s:
        for realm in ("lab1", "lab2"):
            queries.add_realm(s, realm)
        toad = queries.add_user(s, "toad", HASH)
        guest = queries.add_linked_account(s, toad.id, "lab1")
        queries.add_user(s, "toad", HASH, realm="lab2")
        for each in (toad, guest):
            found = [
                queries.linked_account_in(s, each.id, realm) for realm in ("default", "lab1", "lab2", "lab3")
            ]
            assert [account and account.id for account in found] == [toad.id, guest.id, None, None]
        with pytest.raises(Invalid, match="already"):
            queries.add_linked_account(s, toad.id, "lab2")
        with pytest.raises(NotFound):
            queries.add_linked_account(s, toad.id, "lab3")
