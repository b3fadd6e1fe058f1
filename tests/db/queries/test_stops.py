"""Orders to stop are kept until the robot has confirmed them."""

from __future__ import annotations

import pytest

from relay_db import queries
from relay_db.engine import Database
from relay_protocol.errors import NotFound


def test_an_order_is_kept_until_it_is_told(database: Database) -> None:
    """What is written is read again, by robot and for all; told, it is gone."""
    with database.begin() as s:
        robot = queries.add_robot(s, "rover").id
        other = queries.add_robot(s, "mule").id
        order = queries.order_stop(s, robot, "ann", "smoke", 12.25)
    with database.reading() as s:
        assert queries.pending_stop(s, robot) == order == (robot, "ann", "smoke", 12.25)
        assert queries.pending_stop(s, other) is None
        assert queries.pending_stops(s) == [order]
    with database.begin() as s:
        assert queries.stop_told(s, robot, 12.25)
        assert not queries.stop_told(s, robot, 12.25)
        assert queries.pending_stops(s) == []


def test_a_newer_order_takes_the_place_of_the_older(database: Database) -> None:
    """That the older one was told does not end the newer one."""
    with database.begin() as s:
        robot = queries.add_robot(s, "rover").id
        queries.order_stop(s, robot, "ann", "smoke", 1.5)
        queries.order_stop(s, robot, "bob", "fire", 2.5)
        assert not queries.stop_told(s, robot, 1.5)
        order = queries.pending_stop(s, robot)
    assert order is not None
    assert (order.by, order.why) == ("bob", "fire")
    with database.begin() as s:
        assert queries.stop_told(s, robot)


def test_text_from_anyone_is_kept_printable_and_short(database: Database) -> None:
    """NUL and endless reasons do not reach the database."""
    with database.begin() as s:
        robot = queries.add_robot(s, "rover").id
        order = queries.order_stop(s, robot, "a\x00" * 300, "w\n" * 10_000, 1.0)
    with database.reading() as s:
        assert queries.pending_stop(s, robot) == order
    assert len(order.by) == 255
    assert len(order.why) == 4096
    assert order.why.isprintable()


def test_an_order_goes_with_its_robot(database: Database) -> None:
    """A robot that is removed leaves none, and one that never was gets none."""
    with database.begin() as s:
        robot = queries.add_robot(s, "rover").id
        queries.order_stop(s, robot, "ann", "", 1.0)
        queries.remove_robot(s, robot)
        assert queries.pending_stops(s) == []
        with pytest.raises(NotFound, match="no such robot"):
            queries.order_stop(s, robot, "ann", "", 1.0)
