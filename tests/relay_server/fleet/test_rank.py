"""Work for many robots, a few at a time."""

from __future__ import annotations

from twisted.internet.defer import CancelledError, Deferred

from relay_server.common.concurrency import bounded_gather


class Field:
    """Robots that finish when the test says so."""

    def __init__(self) -> None:
        self.open: dict[str, Deferred[None]] = {}
        self.begun: list[str] = []
        self.given_up: list[str] = []

    async def do(self, name: str) -> None:
        """Lasts until the test ends it."""
        self.begun.append(name)
        self.open[name] = Deferred()
        try:
            await self.open[name]
        except CancelledError:
            self.given_up.append(name)
            raise

    def done(self, name: str) -> None:
        """Ends the work for one robot."""
        self.open.pop(name).callback(None)


def test_some_have_their_turn_at_a_time() -> None:
    """Each end starts the next, and the last end completes the whole."""
    field, over = Field(), []
    running = Deferred.fromCoroutine(bounded_gather("abcde", field.do, at_once=2))
    running.addCallback(over.append)
    assert field.begun == ["a", "b"]
    field.done("b")
    assert field.begun == ["a", "b", "c"]
    for name in "cda":
        field.done(name)
    assert not over
    field.done("e")
    assert over == [None]


def test_caller_that_gives_up_ends_what_has_begun() -> None:
    """Waiting robots are not started."""
    field, ends = Field(), []
    running = Deferred.fromCoroutine(bounded_gather("abcde", field.do, at_once=2))
    running.addErrback(lambda failure: ends.append(failure.type))
    running.cancel()
    assert sorted(field.given_up) == ["a", "b"]
    assert field.begun == ["a", "b"]
    assert ends == [CancelledError]


def test_failure_ends_the_others() -> None:
    """An unexpected error does not belong to a single robot."""
    field, ends = Field(), []
    running = Deferred.fromCoroutine(bounded_gather("abc", field.do, at_once=2))
    running.addErrback(lambda failure: ends.append(failure.type))
    field.open["a"].errback(ZeroDivisionError())
    assert field.given_up == ["b"]
    assert ends == [ZeroDivisionError]


def test_no_robots_are_done_at_once() -> None:
    over: list[None] = []
    Deferred.fromCoroutine(bounded_gather([], Field().do)).addCallback(over.append)
    assert over == [None]
