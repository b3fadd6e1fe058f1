"""Turns of the reactor, one for each who waits."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from relay_server.common.fair_queue import FairQueue


class Turns:
    """A clock that makes the calls of one turn when it is told to; calls made meanwhile are of the next."""

    def __init__(self) -> None:
        self.due: list[Callable[..., object]] = []

    def seconds(self) -> float:
        """Time stands still."""
        return 0.0

    def callLater(self, delay: float, call: Callable[..., object], *args: Any) -> Any:
        """Call in the next turn."""
        assert not delay and not args
        self.due.append(call)

    def turn(self) -> None:
        """One turn."""
        due, self.due = self.due, []
        for each in due:
            each()


def test_each_has_a_turn_of_his_own() -> None:
    """In order; the first does not wait, and who has left takes a turn and holds up nobody."""
    turns = Turns()
    line = FairQueue(turns)
    had: list[int] = []

    def ask(number: int) -> Any:
        return line.turn().addCallbacks(lambda _: had.append(number), lambda _: None)

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
