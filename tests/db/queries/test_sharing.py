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
    """By the password whose hash is :data:`HASH`."""
    return queries.open_session(s, user_id, token * 64, password_hash=HASH, expires=NOW + 60, now=NOW)


def test_a_shared_robot_is_found_in_each_of_its_realms(database: Database) -> None:
    """As the same one, with its own realm; nowhere else."""
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
    """Before it is shared none can be; and the lists of a realm have only those that are held in it."""
    with database.begin() as s:
        mobile, ann, root = _labs(s)
        luigi = queries.add_user(s, "luigi", None, realm="lab1")
        queries.grant_right(s, mobile.id, "owner", user_id=luigi.id, allow=["call:/a"])
        with pytest.raises(Invalid, match="not of the realm"):
            queries.grant_right(s, mobile.id, "viewer", user_id=ann.id)
        assert queries.grants_for(s, root.id, mobile.id) == []
        queries.share_robot(s, mobile.id, "lab2")
        queries.grant_right(s, mobile.id, "viewer", user_id=ann.id)
        assert [each.level for each in queries.grants_for(s, ann.id, mobile.id)] == [Level.VIEWER]
        assert [robot for robot, _ in queries.robots_with_grants(s, ann.id)] == [mobile]
        assert [each.level for each in queries.grants_for(s, root.id, mobile.id)] == [Level.OWNER]
        assert [each.user for each in queries.right_places(s, "lab1")] == ["luigi"]
        assert [each.user for each in queries.right_places(s, "lab2", robot_id=mobile.id)] == ["ann"]
        assert [queries.count_patterns(s, realm=each) for each in ("lab1", "lab2")] == [1, 0]
        assert [queries.realm_size(s, each).rights for each in ("lab1", "lab2")] == [1, 1]
        assert [(each.user, each.realm) for each in queries.list_rights(s, robot_id=mobile.id)] == [
            ("ann", "lab2"),
            ("luigi", "lab1"),
        ]


def test_what_a_realm_has_of_a_robot_goes_when_it_is_shared_no_more(database: Database) -> None:
    """Rights, places in groups, entries of the directory; those of its own realm stay."""
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
        with pytest.raises(NotFound, match="not of the realm"):
            queries.unshare_robot(s, mobile.id, "lab2")


def test_robots_are_shared_where_their_name_is_free(database: Database) -> None:
    """Once, with a realm that there is; and from their own they are not taken."""
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
    """Until it is taken out, or removed altogether."""
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
    """A code is no good under the name that the robot has elsewhere."""
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


def test_a_guest_has_the_password_of_his_own_account(database: Database) -> None:
    """And no rights but those of the account; a new password is one for both, and ends the sessions of both."""
    with database.begin() as s:
        queries.add_realm(s, "lab1")
        toad = queries.add_user(s, "toad", HASH, admin=True)
        guest = queries.add_guest(s, toad.id, "lab1")
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


def test_who_is_shut_out_is_so_everywhere(database: Database) -> None:
    """And a guest that is shut out is so in his realm alone; who is removed goes with all of his accounts."""
    with database.begin() as s:
        for realm in ("lab1", "lab2"):
            queries.add_realm(s, realm)
        toad = queries.add_user(s, "toad", HASH)
        guest = queries.add_guest(s, toad.id, "lab1")
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
        queries.add_guest(s, guest.id, "lab2")
        queries.remove_user(s, toad.id)
        assert queries.list_users(s) == []


def test_accounts_of_one_person_are_found_by_any_of_them(database: Database) -> None:
    """In each realm its own; nobody else of the same name counts."""
    with database.begin() as s:
        for realm in ("lab1", "lab2"):
            queries.add_realm(s, realm)
        toad = queries.add_user(s, "toad", HASH)
        guest = queries.add_guest(s, toad.id, "lab1")
        queries.add_user(s, "toad", HASH, realm="lab2")
        for each in (toad, guest):
            found = [queries.account_in(s, each.id, realm) for realm in ("default", "lab1", "lab2", "lab3")]
            assert [account and account.id for account in found] == [toad.id, guest.id, None, None]
        with pytest.raises(Invalid, match="already"):
            queries.add_guest(s, toad.id, "lab2")
        with pytest.raises(NotFound):
            queries.add_guest(s, toad.id, "lab3")
