"""Users and groups, on both databases."""

from __future__ import annotations

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from relay_db import queries
from relay_db.engine import Database
from relay_db.queries import NewStoredEvent
from relay_protocol.errors import Invalid, NotFound, Refused
from relay_protocol.rights import Level

TOKEN = "b" * 64


def test_a_user_is_found_in_any_case(database: Database) -> None:
    with database.begin() as s:
        added = queries.add_user(s, "Ann", "hash", admin=True)
        assert queries.find_user(s, "ANN") == added
        assert queries.get_user(s, added.id) == added
    assert added == queries.UserRecord(added.id, "ann", "default", True, False, "hash")


def test_an_unknown_user_is_none(database: Database) -> None:
    with database.reading() as s:
        assert queries.find_user(s, "ann") is None
        assert queries.find_user(s, "ann", realm="elsewhere") is None
        assert queries.get_user(s, 1) is None
        assert not queries.user_is_live(s, 1)


def test_any_text_can_be_looked_for(database: Database) -> None:

    @settings(deadline=None, max_examples=50)
    @given(st.text())
    @example("\x00")
    @example("\ud800")
    def look_for(text: str) -> None:
        with database.reading() as s:
            assert queries.find_user(s, text) is None
            assert queries.find_user(s, "ann", realm=text) is None
            assert queries.find_group(s, text) is None
            assert queries.find_robot(s, text) is None
            assert queries.find_robot(s, "rover", realm=text) is None
            assert queries.robot_key(s, text, text) is None
            assert queries.robot_key(s, "rover", text) is None
            assert queries.principal_by_token(s, text, 1.0) is None

    look_for()


def test_only_an_empty_realm_is_removed(database: Database) -> None:
    with database.begin() as s:
        queries.add_realm(s, "Lab")
        ann = queries.add_user(s, "ann", None, realm="lab")
        rover = queries.add_robot(s, "rover", realm="lab")
        crew = queries.add_group(s, "crew", realm="lab")
        fleet = queries.add_robot_group(s, "fleet", realm="lab")
        queries.store_events(s, [NewStoredEvent("lab", 1.0, "app", "x", None, None, "{}")])
        for left, remove, id in (
            ("users and groups and robots and groups of robots", queries.remove_user, ann.id),
            ("groups and robots and groups of robots", queries.remove_group, crew.id),
            ("robots and groups of robots", queries.remove_robot, rover.id),
            ("groups of robots", queries.remove_robot_group, fleet.id),
        ):
            with pytest.raises(Refused, match=f"there are {left} in the realm 'lab'"):
                queries.remove_realm(s, "LAB")
            remove(s, id)
        queries.remove_realm(s, "LAB")
        assert [each.name for each in queries.list_realms(s)] == ["default"]
        with pytest.raises(NotFound):
            queries.remove_realm(s, "lab")
        with pytest.raises(Refused, match="cannot be removed"):
            queries.remove_realm(s, "default")
        queries.add_realm(s, "lab")
        assert queries.latest_event_number(s, "lab") == 0


def test_a_name_is_taken_once_per_realm(database: Database) -> None:
    """The same name in another realm is another user."""
    with database.begin() as s:
        queries.add_user(s, "ann", None)
        with pytest.raises(Invalid, match="already"):
            queries.add_user(s, "ANN", None)
        queries.add_realm(s, "plant")
        other = queries.add_user(s, "ann", None, realm="plant")
        assert queries.find_user(s, "ann", "plant") == other
        assert [user.realm for user in queries.list_users(s)] == ["default", "plant"]
        assert queries.list_users(s, "plant") == [other]


def test_a_realm_must_be_there(database: Database) -> None:
    """A user, group or robot of an unknown realm is refused."""
    with database.begin() as s:
        for add in (
            lambda: queries.add_user(s, "ann", None, realm="nowhere"),
            lambda: queries.add_group(s, "lab", realm="nowhere"),
            lambda: queries.add_robot(s, "rover", realm="nowhere"),
        ):
            with pytest.raises(NotFound, match="realm"):
                add()
        with pytest.raises(Invalid, match="already"):
            queries.add_realm(s, "Default")


def test_a_new_password_ends_browser_sessions_but_not_access_tokens(database: Database) -> None:
    with database.begin() as s:
        ann = queries.add_user(s, "ann", "old")
        make = {"expires": None, "now": 1.0}
        program = queries.create_token(s, ann.id, "1" * 64, kind="access", **make)
        here = queries.create_token(s, ann.id, "2" * 64, kind="session", **make)
        elsewhere = queries.create_token(s, ann.id, "3" * 64, kind="session", **make)
        link = queries.create_token(s, ann.id, "4" * 64, kind="login", **make)
        queries.set_password(s, ann.id, "new", keep_token=here)
        found = queries.find_user(s, "ann")
        assert found is not None
        assert found.password_hash == "new"
        live = {each for each in (program, here, elsewhere, link) if queries.token_is_live(s, each, 2.0)}
        assert live == {program, here}
        queries.set_password(s, ann.id, "newer")
        assert not queries.token_is_live(s, here, 2.0)


def test_a_disabled_user_is_out_until_enabled(database: Database) -> None:
    """Their tokens and rights are invalid until then."""
    with database.begin() as s:
        ann, rover = queries.add_user(s, "ann", None, admin=True), queries.add_robot(s, "rover")
        queries.grant_right(s, rover.id, "viewer", user_id=ann.id)
        token = queries.create_token(s, ann.id, TOKEN, kind="access", expires=None, now=1.0)

        def live() -> tuple[bool, bool, bool, int, int]:
            return (
                queries.user_is_live(s, ann.id),
                queries.token_is_live(s, token, 2.0),
                queries.principal_by_token(s, TOKEN, 2.0) is not None,
                len(queries.grants_for(s, ann.id, rover.id)),
                len(queries.robots_with_grants(s, ann.id)),
            )

        assert live() == (True, True, True, 2, 1)
        queries.set_disabled(s, ann.id, True)
        assert live() == (False, False, False, 0, 0)
        queries.set_disabled(s, ann.id, False)
        assert live() == (True, True, True, 2, 1)


def test_a_removed_user_leaves_nothing(database: Database) -> None:
    """Rights, memberships and tokens are removed with the user."""
    with database.begin() as s:
        ann, rover = queries.add_user(s, "ann", None), queries.add_robot(s, "rover")
        lab = queries.add_group(s, "lab")
        queries.add_member(s, lab.id, ann.id)
        queries.grant_right(s, rover.id, "owner", user_id=ann.id)
        queries.create_token(s, ann.id, TOKEN, kind="access", expires=None, now=1.0)
        queries.remove_user(s, ann.id)
        assert queries.find_user(s, "ann") is None
        assert queries.list_rights(s) == []
        assert queries.list_tokens(s) == []
        assert queries.list_groups(s) == [lab]


def test_changes_to_unknown_users_are_refused(database: Database) -> None:
    """Every change of a missing user or group gives an error."""
    with database.begin() as s:
        lab, ann = queries.add_group(s, "lab"), queries.add_user(s, "ann", None)
        for change in (
            lambda: queries.set_password(s, 99, "x"),
            lambda: queries.set_disabled(s, 99, True),
            lambda: queries.set_admin(s, 99, True),
            lambda: queries.remove_user(s, 99),
            lambda: queries.remove_group(s, 99),
            lambda: queries.add_member(s, 99, ann.id),
            lambda: queries.add_member(s, lab.id, 99),
        ):
            with pytest.raises(NotFound):
                change()


def test_a_group_lists_its_members(database: Database) -> None:
    """Joining twice has no further effect; leaving returns whether the user was a member."""
    with database.begin() as s:
        bob, ann = queries.add_user(s, "bob", None), queries.add_user(s, "ann", None)
        lab = queries.add_group(s, "Lab")
        for user in (bob, ann, ann):
            queries.add_member(s, lab.id, user.id)
        assert queries.find_group(s, "LAB") == lab._replace(members=("ann", "bob"))
        assert queries.remove_member(s, lab.id, bob.id)
        assert not queries.remove_member(s, lab.id, bob.id)
        assert queries.list_groups(s) == [lab._replace(members=("ann",))]
        with pytest.raises(Invalid, match="already"):
            queries.add_group(s, "lab")


def test_a_group_takes_only_users_of_its_realm(database: Database) -> None:
    with database.begin() as s:
        queries.add_realm(s, "plant")
        stranger = queries.add_user(s, "eve", None, realm="plant")
        lab = queries.add_group(s, "lab")
        with pytest.raises(Invalid, match="different realms"):
            queries.add_member(s, lab.id, stranger.id)
        assert queries.list_groups(s, "plant") == []


def test_a_removed_group_takes_its_rights_along(database: Database) -> None:
    """Members stay users, without the group's rights."""
    with database.begin() as s:
        ann, rover = queries.add_user(s, "ann", None), queries.add_robot(s, "rover")
        lab = queries.add_group(s, "lab")
        queries.add_member(s, lab.id, ann.id)
        queries.grant_right(s, rover.id, Level.OWNER, group_id=lab.id)
        queries.remove_group(s, lab.id)
        assert queries.user_is_live(s, ann.id)
        assert queries.grants_for(s, ann.id, rover.id) == []
