"""The relay of a cluster that each robot is connected to."""

from __future__ import annotations

import pytest

from relay_db import queries
from relay_db.engine import Database
from relay_protocol.errors import NotFound


def test_the_newest_connection_of_a_robot_counts(database: Database) -> None:
    with database.begin() as s:
        robot = queries.add_robot(s, "rover").id
        other = queries.add_robot(s, "mule").id
        assert queries.home_relays(s) == []
        assert queries.claim_home_relay(s, robot, "one") == 1
        assert queries.claim_home_relay(s, robot, "two") == 2
        assert queries.claim_home_relay(s, other, "two") == 1
        queries.release_home_relay(s, robot, "one", 1)
        queries.release_home_relay(s, robot, "two", 1)
        assert sorted(queries.home_relays(s)) == [(robot, "two", 2), (other, "two", 1)]
        assert [queries.home_relay(s, each) for each in (robot, other, 99)] == ["two", "two", ""]
        queries.release_home_relay(s, robot, "two", 2)
        assert queries.home_relay(s, robot) == ""
        assert sorted(queries.home_relays(s)) == [(robot, "", 2), (other, "two", 1)]
        assert queries.claim_home_relay(s, robot, "two") == 3


def test_a_removed_robot_has_no_home(database: Database) -> None:
    with database.begin() as s:
        robot = queries.add_robot(s, "rover").id
        queries.claim_home_relay(s, robot, "one")
        queries.remove_robot(s, robot)
        assert queries.home_relays(s) == []
        with pytest.raises(NotFound):
            queries.claim_home_relay(s, robot, "one")
