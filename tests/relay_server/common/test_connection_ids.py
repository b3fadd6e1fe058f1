"""Connection ids are unique and carry no information."""

from __future__ import annotations

import pytest

from relay_server.common import connection_ids
from relay_server.common.connection_ids import MOST, ConnectionIds, unused_name


def test_no_number_is_given_twice_in_a_row_of_many() -> None:
    """A number in use or recently used is drawn again."""
    drawn = iter([7, 7, 8, 7, 8, 9])
    taken = ConnectionIds(lambda: next(drawn))
    assert [taken.take() for _ in range(3)] == [7, 8, 9]


def test_an_id_is_drawn_until_it_is_unused() -> None:
    """A released id may be given again."""
    drawn = iter("aabaa")
    taken = {unused_name("r#", (), lambda: next(drawn))}
    taken.add(unused_name("r#", taken, lambda: next(drawn)))
    assert taken == {"r#a", "r#b"}
    assert unused_name("r#", {"r#b"}, lambda: next(drawn)) == "r#a"


def test_numbers_of_long_ago_are_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    """The memory for recent numbers is bounded."""
    monkeypatch.setattr(connection_ids, "KEPT", 2)
    drawn = iter([1, 2, 3, 1])
    taken = ConnectionIds(lambda: next(drawn))
    assert [taken.take() for _ in range(4)] == [1, 2, 3, 1]


def test_they_say_nothing_of_how_many_there_were() -> None:
    """They are positive 32-bit integers in random order."""
    taken = ConnectionIds()
    given = [taken.take() for _ in range(1000)]
    assert all(0 < each <= MOST for each in given)
    assert given != sorted(given)
    assert len(set(given)) == 1000
