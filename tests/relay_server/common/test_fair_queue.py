"""Reactor turns, one for each waiting user."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from relay_server.common.concurrency import FairQueue


class Turns:
    """A clock that runs the calls of one turn on request; calls added meanwhile belong to the next turn."""

    def __init__(self) -> None:
        self.due: list[Callable[..., object]] = []

    def seconds(self) -> float:
        return 0.0

    def callLater(self, delay: float, call: Callable[..., object], *args: Any) -> Any:
        """Schedules a call for the next turn."""
        assert not delay and not args
        self.due.append(call)

    def turn(self) -> None:
        """Runs one turn."""
        due, self.due = self.due, []
        for each in due:
            each()


def test_users_take_turns() -> None:
    """They take turns in order; the first user does not wait, and a client that has left delays no other."""
    turns = Turns()
    line = FairQueue(turns)
    had: list[int] = []

    def ask(number: int) -> Any:
        return line.wait().addCallbacks(lambda _: had.append(number), lambda _: None)

    ask(0)
    ask(1)
    ask(2)
    ask(3).cancel()
    ask(4)
    seen = []
    for _ in range(5):
        seen.append(list(had))
        turns.turn()
    assert seen == [[0], [0, 1], [0, 1, 2], [0, 1, 2], [0, 1, 2, 4]]
    ask(5)
    assert had[-1] == 5
    turns.turn()
    assert not turns.due
