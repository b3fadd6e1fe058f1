"""Many robots, some at a time."""

from __future__ import annotations

from twisted.internet.defer import CancelledError, Deferred

from relay_server.common.gather import bounded_gather


class Field:
    """Robots that are done when the test says so."""

    def __init__(self) -> None:
        self.open: dict[str, Deferred[None]] = {}
        self.begun: list[str] = []
        self.given_up: list[str] = []

    async def do(self, name: str) -> None:
        """Until the test says that it is done."""
        self.begun.append(name)
        self.open[name] = Deferred()
        try:
            await self.open[name]
        except CancelledError:
            self.given_up.append(name)
            raise

    def done(self, name: str) -> None:
        """It is done there."""
        self.open.pop(name).callback(None)


def test_some_have_their_turn_at_a_time() -> None:
    """The next when one is done; it is over with the last."""
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


def test_who_gives_up_ends_what_has_begun() -> None:
    """And nothing else begins."""
    field, ends = Field(), []
    running = Deferred.fromCoroutine(bounded_gather("abcde", field.do, at_once=2))
    running.addErrback(lambda failure: ends.append(failure.type))
    running.cancel()
    assert sorted(field.given_up) == ["a", "b"]
    assert field.begun == ["a", "b"]
    assert ends == [CancelledError]


def test_what_goes_wrong_ends_the_others() -> None:
    """An error that nobody foresaw is not one of a single robot."""
    field, ends = Field(), []
    running = Deferred.fromCoroutine(bounded_gather("abc", field.do, at_once=2))
    running.addErrback(lambda failure: ends.append(failure.type))
    field.open["a"].errback(ZeroDivisionError())
    assert field.given_up == ["b"]
    assert ends == [ZeroDivisionError]


def test_no_robots_are_done_at_once() -> None:
    """There is nothing to wait for."""
    over: list[None] = []
    Deferred.fromCoroutine(bounded_gather([], Field().do)).addCallback(over.append)
    assert over == [None]
