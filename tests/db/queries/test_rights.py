"""Rights and what follows from them, on both databases."""

from __future__ import annotations

import pytest

from relay_db import queries
from relay_db.engine import Database
from relay_protocol.errors import Invalid, NotFound
from relay_protocol.rights import Grant, Level


def test_no_right_no_grant(database: Database) -> None:
    with database.begin() as s:
        ann, rover = queries.add_user(s, "ann", None), queries.add_robot(s, "rover")
        assert queries.grants_for(s, ann.id, rover.id) == []
        assert queries.robots_with_grants(s, ann.id) == []
        assert queries.grants_for(s, 99, rover.id) == []
        assert queries.grants_for(s, ann.id, 99) == []


def test_grants_come_from_the_user_and_its_groups(database: Database) -> None:
    """Each has its source; other users' and other robots' rights do not count."""
    with database.begin() as s:
        ann, bob = queries.add_user(s, "ann", None), queries.add_user(s, "bob", None)
        rover, arm = queries.add_robot(s, "rover"), queries.add_robot(s, "arm")
        queries.add_robot(s, "locked-away")
        lab, other = queries.add_group(s, "lab"), queries.add_group(s, "other")
        queries.add_member(s, lab.id, ann.id)
        queries.grant_right(s, rover.id, "viewer", user_id=ann.id, allow=["call:/reset"], deny=["*:/arm/*"])
        queries.grant_right(s, rover.id, Level.OPERATOR, group_id=lab.id)
        queries.grant_right(s, arm.id, "viewer", group_id=lab.id)
        queries.grant_right(s, rover.id, "owner", user_id=bob.id)
        queries.grant_right(s, rover.id, "owner", group_id=other.id)
        own = Grant(Level.VIEWER, ("call:/reset",), ("*:/arm/*",), "user ann")
        groups = Grant(Level.OPERATOR, (), (), "group lab")
        assert queries.grants_for(s, ann.id, rover.id) == [own, groups]
        assert queries.robots_with_grants(s, ann.id) == [
            (arm, [Grant(Level.VIEWER, (), (), "group lab")]),
            (rover, [own, groups]),
        ]


def test_an_admin_owns_every_robot_of_the_realm(database: Database) -> None:
    """Its own right with its denials counts too; other realms' robots do not."""
    with database.begin() as s:
        queries.add_realm(s, "plant")
        rover, abroad = queries.add_robot(s, "rover"), queries.add_robot(s, "rover", realm="plant")
        root = queries.add_user(s, "root", None, admin=True)
        owner = Grant(Level.OWNER, source="admin root")
        assert queries.grants_for(s, root.id, rover.id) == [owner]
        assert queries.grants_for(s, root.id, abroad.id) == []
        queries.grant_right(s, rover.id, "viewer", user_id=root.id, deny=["publish:/cmd_vel"])
        own = Grant(Level.VIEWER, (), ("publish:/cmd_vel",), "user root")
        assert queries.robots_with_grants(s, root.id) == [(rover, [owner, own])]
        queries.set_admin(s, root.id, False)
        assert queries.grants_for(s, root.id, rover.id) == [own]


def test_a_right_replaces_the_one_before(database: Database) -> None:
    """One holder has one right on one robot."""
    with database.begin() as s:
        ann, rover = queries.add_user(s, "ann", None), queries.add_robot(s, "rover")
        queries.grant_right(s, rover.id, "owner", user_id=ann.id, allow=["*:*"])
        queries.grant_right(s, rover.id, "viewer", user_id=ann.id)
        [right] = queries.list_rights(s)
    assert right == queries.RightRecord(
        right.id, rover.id, "rover", "default", "ann", None, Level.VIEWER, (), ()
    )


def test_a_right_is_revoked_from_its_holder_only(database: Database) -> None:
    with database.begin() as s:
        ann, rover = queries.add_user(s, "ann", None), queries.add_robot(s, "rover")
        lab = queries.add_group(s, "lab")
        queries.add_member(s, lab.id, ann.id)
        queries.grant_right(s, rover.id, "owner", user_id=ann.id)
        queries.grant_right(s, rover.id, "viewer", group_id=lab.id)
        assert queries.revoke_right(s, rover.id, user_id=ann.id)
        assert not queries.revoke_right(s, rover.id, user_id=ann.id)
        assert queries.grants_for(s, ann.id, rover.id) == [Grant(Level.VIEWER, (), (), "group lab")]
        assert queries.revoke_right(s, rover.id, group_id=lab.id)
        assert queries.list_rights(s) == []


def test_rights_are_listed_by_robot_and_holder(database: Database) -> None:
    """The list of a user includes the rights of its groups."""
    with database.begin() as s:
        ann, bob = queries.add_user(s, "ann", None), queries.add_user(s, "bob", None)
        rover, arm = queries.add_robot(s, "rover"), queries.add_robot(s, "arm")
        lab = queries.add_group(s, "lab")
        queries.add_member(s, lab.id, ann.id)
        queries.grant_right(s, rover.id, "viewer", user_id=ann.id)
        queries.grant_right(s, arm.id, "viewer", group_id=lab.id)
        queries.grant_right(s, rover.id, "owner", user_id=bob.id)

        def listed(**only: int) -> list[tuple[str, str | None]]:
            return [(each.robot, each.user or each.group) for each in queries.list_rights(s, **only)]

        assert listed() == [("arm", "lab"), ("rover", "ann"), ("rover", "bob")]
        assert listed(user_id=ann.id) == [("arm", "lab"), ("rover", "ann")]
        assert listed(robot_id=rover.id) == [("rover", "ann"), ("rover", "bob")]
        assert listed(group_id=lab.id) == [("arm", "lab")]


def test_rights_that_cannot_be_are_refused(database: Database) -> None:
    with database.begin() as s:
        queries.add_realm(s, "plant")
        ann, rover = queries.add_user(s, "ann", None), queries.add_robot(s, "rover")
        lab = queries.add_group(s, "lab")
        stranger = queries.add_user(s, "eve", None, realm="plant")
        for refused in (
            lambda: queries.grant_right(s, rover.id, "god", user_id=ann.id),
            lambda: queries.grant_right(s, rover.id, "viewer", user_id=ann.id, allow=["fly:/x"]),
            lambda: queries.grant_right(s, rover.id, "viewer", user_id=ann.id, deny=["call:x"]),
            lambda: queries.grant_right(s, rover.id, "viewer", user_id=ann.id, deny=["call:/\x1b"]),
            lambda: queries.grant_right(s, rover.id, "viewer", user_id=ann.id, deny=["call:/" + "x" * 600]),
            lambda: queries.grant_right(s, rover.id, "viewer", user_id=ann.id, deny=["call:/x"] * 65),
            lambda: queries.grant_right(s, rover.id, "viewer"),
            lambda: queries.grant_right(s, rover.id, "viewer", user_id=ann.id, group_id=lab.id),
            lambda: queries.grant_right(s, rover.id, "viewer", user_id=stranger.id),
            lambda: queries.revoke_right(s, rover.id),
        ):
            with pytest.raises(Invalid):
                refused()
        for missing in (
            lambda: queries.grant_right(s, 99, "viewer", user_id=ann.id),
            lambda: queries.grant_right(s, rover.id, "viewer", user_id=99),
            lambda: queries.grant_right(s, rover.id, "viewer", group_id=99),
        ):
            with pytest.raises(NotFound):
                missing()
        assert queries.list_rights(s) == []
