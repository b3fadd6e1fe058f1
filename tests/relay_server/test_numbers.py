"""Numbers of clients tell them apart, and nothing else."""

from __future__ import annotations

import pytest

from relay_server.common import connection_ids
from relay_server.common.connection_ids import MOST, ConnectionIds, name_of


def test_no_number_is_given_twice_in_a_row_of_many() -> None:
    """What was drawn before is drawn again, until it is long ago."""
    drawn = iter([7, 7, 8, 7, 8, 9])
    taken = ConnectionIds(lambda: next(drawn))
    assert [taken.take() for _ in range(3)] == [7, 8, 9]


def test_a_name_is_drawn_until_nobody_has_it() -> None:
    """Others may have it again when its bearer is gone."""
    drawn = iter("aabaa")
    taken = {name_of("r#", (), lambda: next(drawn))}
    taken.add(name_of("r#", taken, lambda: next(drawn)))
    assert taken == {"r#a", "r#b"}
    assert name_of("r#", {"r#b"}, lambda: next(drawn)) == "r#a"


def test_numbers_of_long_ago_are_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is remembered of them does not grow for ever."""
    monkeypatch.setattr(connection_ids, "KEPT", 2)
    drawn = iter([1, 2, 3, 1])
    taken = ConnectionIds(lambda: next(drawn))
    assert [taken.take() for _ in range(4)] == [1, 2, 3, 1]


def test_they_say_nothing_of_how_many_there_were() -> None:
    """They are positive, fit into 32 bits, and come in no order."""
    taken = ConnectionIds()
    given = [taken.take() for _ in range(1000)]
    assert all(0 < each <= MOST for each in given)
    assert given != sorted(given)
    assert len(set(given)) == 1000
