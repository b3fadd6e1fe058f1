"""Work that many ask for is done one at a time, for all of them."""

from __future__ import annotations

import pytest
import pytest_twisted
from twisted.internet.defer import CancelledError, Deferred
from twisted.python.failure import Failure

from relay_protocol.errors import Unavailable
from relay_server.common.clock import SingleFlight


class Work:
    """It is under way until the test ends it."""

    def __init__(self) -> None:
        self.begun: list[Deferred[None]] = []
        self.turns = SingleFlight(self._do)

    async def _do(self) -> None:
        self.begun.append(Deferred())
        await self.begun[-1]

    def ask(self) -> Deferred[None]:
        """Somebody asks for it."""
        return Deferred.fromCoroutine(self.turns.ask())


@pytest_twisted.ensureDeferred
async def test_who_asks_meanwhile_shares_the_next_time() -> None:
    """What is under way began before they asked."""
    work = Work()
    first = work.ask()
    others = [work.ask(), work.ask()]
    assert len(work.begun) == 1
    work.begun[0].callback(None)
    await first
    assert len(work.begun) == 2 and not any(each.called for each in others)
    work.begun[1].callback(None)
    for each in others:
        await each
    assert len(work.begun) == 2
    work.ask()
    assert len(work.begun) == 3


@pytest_twisted.ensureDeferred
async def test_what_fails_fails_for_those_who_waited_for_it() -> None:
    """And is tried again for the others."""
    work = Work()
    first, second = work.ask(), work.ask()
    work.begun[0].errback(Unavailable("the database does not answer"))
    with pytest.raises(Unavailable):
        await first
    work.begun[1].callback(None)
    await second


def test_what_fails_when_all_have_left_is_left_to_the_log() -> None:
    """It is not swallowed."""
    work, asked = Work(), Deferred[None]()
    failed = Failure(Unavailable("the database does not answer"))
    asked.addErrback(lambda failure: None)
    assert work.turns._done(failed, [asked]) is None
    assert work.turns._done(failed, [asked]) is failed


@pytest_twisted.ensureDeferred
async def test_who_gives_up_ends_it_for_nobody() -> None:
    """It goes on, for the others and for the next."""
    work = Work()
    left, stays = work.ask(), work.ask()
    left.cancel()
    with pytest.raises(CancelledError):
        await left
    assert not work.begun[0].called
    work.begun[0].callback(None)
    work.begun[1].callback(None)
    await stays
