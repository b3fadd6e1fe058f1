"""Stored stops stay until the robot has confirmed them."""

from __future__ import annotations

import pytest

from relay_db import queries
from relay_db.engine import Database
from relay_protocol.errors import NotFound


def test_an_order_is_stored_until_it_is_confirmed(database: Database) -> None:
    with database.begin() as s:
        robot = queries.add_robot(s, "rover").id
        other = queries.add_robot(s, "mule").id
        order = queries.store_stop(s, robot, "ann", "smoke", 12.25)
    with database.reading() as s:
        assert queries.pending_stop(s, robot) == order == (robot, "ann", "smoke", 12.25, "")
        assert queries.pending_stop(s, other) is None
        assert queries.pending_stops(s) == [order]
    with database.begin() as s:
        assert queries.delete_stop(s, robot, 12.25)
        assert not queries.delete_stop(s, robot, 12.25)
        assert queries.pending_stops(s) == []
        revision = queries.revision(s)
        queries.store_stop(s, robot, "ann", "smoke", 13.25)
        assert queries.delete_stop(s, robot, 13.25)
        assert queries.revision(s) == revision
        queries.store_stop(s, robot, "ann", "smoke", 14.25)
        assert queries.delete_stop(s, robot, 14.25, announce=True)
        assert queries.revision(s) > revision


def test_a_newer_order_takes_the_place_of_the_older(database: Database) -> None:
    with database.begin() as s:
        robot = queries.add_robot(s, "rover").id
        queries.store_stop(s, robot, "ann", "smoke", 1.5)
        queries.store_stop(s, robot, "bob", "fire", 2.5)
        assert not queries.delete_stop(s, robot, 1.5)
        order = queries.pending_stop(s, robot)
    assert order is not None
    assert (order.by, order.why) == ("bob", "fire")
    with database.begin() as s:
        assert queries.delete_stop(s, robot)


def test_an_order_with_the_id_of_a_stored_one_is_not_stored_again(database: Database) -> None:
    with database.begin() as s:
        robot = queries.add_robot(s, "rover").id
        order = queries.store_stop(s, robot, "ann", "smoke", 1.5, "press-1")
        assert not queries.store_stop_once(s, robot, "ann", "smoke", 2.5, "press-1")
        assert queries.pending_stop(s, robot) == order
        revision = queries.revision(s)
        assert queries.store_stop_once(s, robot, "ann", "smoke", 2.5, "press-2")
        assert queries.store_stop_once(s, robot, "bob", "smoke", 3.5, "press-2")
        assert queries.store_stop_once(s, robot, "bob", "smoke", 4.5, "")
        assert queries.store_stop_once(s, robot, "bob", "smoke", 5.5, "")
        assert queries.revision(s) == revision + 4


def test_text_is_stored_printable_and_cut(database: Database) -> None:
    """NUL and endless reasons do not reach the database."""
    with database.begin() as s:
        robot = queries.add_robot(s, "rover").id
        order = queries.store_stop(s, robot, "a\x00" * 300, "w\n" * 10_000, 1.0)
    with database.reading() as s:
        assert queries.pending_stop(s, robot) == order
    assert len(order.by) == 255
    assert len(order.why) == 500
    assert order.why.isprintable()


def test_an_order_goes_with_its_robot(database: Database) -> None:
    """A removed robot has none, and an unknown one gets none."""
    with database.begin() as s:
        robot = queries.add_robot(s, "rover").id
        queries.store_stop(s, robot, "ann", "", 1.0)
        queries.remove_robot(s, robot)
        assert queries.pending_stops(s) == []
        with pytest.raises(NotFound, match="no such robot"):
            queries.store_stop(s, robot, "ann", "", 1.0)
