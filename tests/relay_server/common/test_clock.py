"""Concurrent requests for the same work share its runs."""

from __future__ import annotations

import pytest
import pytest_twisted
from twisted.internet.defer import CancelledError, Deferred
from twisted.python.failure import Failure

from relay_protocol.errors import Unavailable
from relay_server.common.concurrency import SingleFlight


class Work:
    """Work that lasts until the test ends it."""

    def __init__(self) -> None:
        self.begun: list[Deferred[None]] = []
        self.flight = SingleFlight(self._do)

    async def _do(self) -> None:
        self.begun.append(Deferred())
        await self.begun[-1]

    def ask(self) -> Deferred[None]:
        """Requests a run."""
        return Deferred.fromCoroutine(self.flight.run())


@pytest_twisted.ensureDeferred
async def test_concurrent_request_shares_the_next_run() -> None:
    """The current run began before the request."""
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
async def test_failure_reaches_all_waiting_callers() -> None:
    """The work is run again for the others."""
    work = Work()
    first, second = work.ask(), work.ask()
    work.begun[0].errback(Unavailable("the database does not answer"))
    with pytest.raises(Unavailable):
        await first
    work.begun[1].callback(None)
    await second


def test_failure_without_waiters_is_logged() -> None:
    work, asked = Work(), Deferred[None]()
    failed = Failure(Unavailable("the database does not answer"))
    asked.addErrback(lambda failure: None)
    assert work.flight._done(failed, [asked]) is None
    assert work.flight._done(failed, [asked]) is failed


@pytest_twisted.ensureDeferred
async def test_caller_that_gives_up_ends_it_for_no_other() -> None:
    """The run goes on for the other callers."""
    work = Work()
    left, stays = work.ask(), work.ask()
    left.cancel()
    with pytest.raises(CancelledError):
        await left
    assert not work.begun[0].called
    work.begun[0].callback(None)
    work.begun[1].callback(None)
    await stays
