"""Administrators' data of their realm, on both databases."""

from __future__ import annotations

import pytest

from relay_db import queries
from relay_db.engine import Database
from relay_db.queries import RightOnRobot
from relay_protocol.errors import Invalid, NotFound


def test_patterns_are_counted_in_a_realm_and_on_a_robot(database: Database) -> None:
    """Allowing and denying ones; rights without any count as zero."""
    with database.begin() as s:
        for realm in ("lab1", "lab2"):
            queries.add_realm(s, realm)
            ann = queries.add_user(s, "ann", None, realm=realm)
            crew = queries.add_group(s, "crew", realm)
            rover, arm = (queries.add_robot(s, name, realm=realm) for name in ("rover", "arm"))
            assert queries.count_patterns(s, realm=realm) == 0
            queries.grant_right(s, rover.id, "viewer", user_id=ann.id, allow=["call:/a"], deny=["call:/b"])
            queries.grant_right(s, rover.id, "viewer", group_id=crew.id, deny=["call:/c"])
            queries.grant_right(s, arm.id, "viewer", user_id=ann.id)
            queries.grant_right(s, arm.id, "viewer", group_id=crew.id, allow=["call:/d"])
        assert queries.count_patterns(s, realm="lab1") == 4
        assert [queries.count_patterns(s, realm="lab2", robot_id=each.id) for each in (rover, arm)] == [3, 1]
        assert queries.count_patterns(s, realm="nowhere") == 0


def test_places_of_rights_are_those_of_the_realm(database: Database) -> None:
    with database.begin() as s:
        queries.add_realm(s, "lab")
        ann, bob = (queries.add_user(s, name, None, realm="lab") for name in ("ann", "bob"))
        crew, rover = queries.add_group(s, "crew", "lab"), queries.add_robot(s, "rover", realm="lab")
        other = queries.add_user(s, "ann", None), queries.add_robot(s, "rover")
        queries.grant_right(s, other[1].id, "owner", user_id=other[0].id)
        queries.add_member(s, crew.id, ann.id)
        queries.grant_right(s, rover.id, "viewer", group_id=crew.id)
        queries.grant_right(s, rover.id, "operator", user_id=bob.id)
        group, own = sorted(queries.list_right_holders(s, "lab"))
        assert group == RightOnRobot(group.id, "rover", None, "crew")
        assert own == RightOnRobot(own.id, "rover", "bob", None)
        assert queries.list_right_holders(s, "lab", user_id=ann.id) == [group]
        assert queries.list_right_holders(s, "lab", robot_id=other[1].id) == []
        held = queries.get_right(s, rover.id, user_id=bob.id)
        assert held is not None and (held.id, held.level) == (own.id, "operator")
        assert queries.get_right(s, rover.id, user_id=ann.id) is None
        assert [each.id for each in queries.list_rights(s, ids=[group.id])] == [group.id]
        with pytest.raises(Invalid):
            queries.get_right(s, rover.id)


def test_how_much_is_in_a_realm(database: Database) -> None:
    """All its counts, without other realms."""
    with database.begin() as s:
        for realm, names in (("lab1", ("ann",)), ("lab2", ("ann", "bob"))):
            queries.add_realm(s, realm)
            users = [queries.add_user(s, name, None, realm=realm) for name in names]
            group, robots = queries.add_group(s, "crew", realm), queries.add_robot_group(s, "all", realm)
            for user in users:
                robot = queries.add_robot(s, user.name, realm=realm)
                queries.add_member(s, group.id, user.id)
                queries.grant_right(s, robot.id, "viewer", user_id=user.id)
                queries.add_to_robot_group(s, robots.id, robot.id)
                queries.add_oauth_client(s, user.id, user.full, "f" * 64, scope=None, label="", now=1.0)
        assert queries.realm_size(s, "lab1") == (1,) * 8
        assert queries.realm_size(s, "lab2") == (2, 1, 2, 2, 2, 2, 1, 2)
        assert queries.realm_size(s, "nowhere") == (0,) * 8


def test_a_robot_gets_a_new_description(database: Database) -> None:
    with database.begin() as s:
        rover = queries.add_robot(s, "rover", "old")
        queries.set_robot_description(s, rover.id, "new")
        with pytest.raises(Invalid, match="description of a robot"):
            queries.set_robot_description(s, rover.id, "a\nb")
        with pytest.raises(NotFound):
            queries.set_robot_description(s, rover.id + 1, "other")
        assert queries.find_robot(s, "rover") == rover._replace(description="new")


def test_whose_a_token_is(database: Database) -> None:
    with database.begin() as s:
        queries.add_realm(s, "lab")
        ann = queries.add_user(s, "ann", None, realm="lab")
        token = queries.create_token(s, ann.id, "a" * 64, kind="access", expires=None, now=1.0)
        assert queries.user_of_token(s, token) == "ann@lab"
        assert queries.user_of_token(s, token + 1) is None
        assert queries.user_of_oauth_client(s, 1) is None
