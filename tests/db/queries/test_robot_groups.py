"""Groups of robots, on both databases."""

from __future__ import annotations

import pytest

from relay_db import queries
from relay_db.engine import Database
from relay_protocol.errors import Invalid, NotFound


def test_a_group_has_its_robots_by_name(database: Database) -> None:
    """Each once, after repeated additions too; the group is found in any case."""
    with database.begin() as s:
        group = queries.add_robot_group(s, "Cleaners")
        for name in ("cleaner-2", "cleaner-1", "other"):
            queries.add_robot(s, name)
        for name in ("cleaner-2", "cleaner-1", "cleaner-2"):
            robot = queries.find_robot(s, name)
            assert robot is not None
            queries.add_to_robot_group(s, group.id, robot.id)
        found = queries.find_robot_group(s, "CLEANERS")
        assert found == queries.RobotGroupRecord(group.id, "cleaners", "default", ("cleaner-1", "cleaner-2"))
        empty = queries.add_robot_group(s, "all-others")
        assert queries.list_robot_groups(s) == [empty, found]
        assert queries.list_robot_groups(s, "elsewhere") == []
        assert queries.robot_group_names(s, "Default") == {"cleaners": group.id, "all-others": empty.id}
        assert queries.robot_group_names(s, "elsewhere") == {}
        assert queries.robots_of_groups(s, [group.id]) == {group.id: ("cleaner-1", "cleaner-2")}


def test_robots_leave_and_groups_go(database: Database) -> None:
    """A removed robot leaves its groups; a removed group keeps its robots."""
    with database.begin() as s:
        group = queries.add_robot_group(s, "cleaners")
        one, two = queries.add_robot(s, "one"), queries.add_robot(s, "two")
        queries.add_to_robot_group(s, group.id, one.id)
        queries.add_to_robot_group(s, group.id, two.id)
        assert queries.remove_from_robot_group(s, group.id, one.id)
        assert not queries.remove_from_robot_group(s, group.id, one.id)
        queries.remove_robot(s, two.id)
        assert queries.find_robot_group(s, "cleaners") == group
        queries.add_to_robot_group(s, group.id, one.id)
        queries.remove_robot_group(s, group.id)
        assert queries.find_robot_group(s, "cleaners") is None
        assert queries.find_robot(s, "one") == one
        with pytest.raises(NotFound):
            queries.remove_robot_group(s, group.id)


def test_impossible_value_is_refused(database: Database) -> None:
    with database.begin() as s:
        before = queries.revision(s)
        group = queries.add_robot_group(s, "cleaners")
        assert queries.revision(s) == before
        for name in ("Cleaners", "", "a b\n"):
            with pytest.raises(Invalid):
                queries.add_robot_group(s, name)
        with pytest.raises(NotFound, match="realm"):
            queries.add_robot_group(s, "more", "nowhere")
        queries.add_realm(s, "plant")
        far = queries.add_robot(s, "far", realm="plant")
        with pytest.raises(Invalid, match="not belong to the realm"):
            queries.add_to_robot_group(s, group.id, far.id)
        for pair in ((group.id, -1), (-1, far.id)):
            with pytest.raises(NotFound):
                queries.add_to_robot_group(s, *pair)
        assert queries.find_robot_group(s, "\x00") is None
