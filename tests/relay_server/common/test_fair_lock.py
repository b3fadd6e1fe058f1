"""A lock that serves users in turn."""

from __future__ import annotations

import pytest
import pytest_twisted
from twisted.internet.defer import CancelledError, Deferred

from relay_protocol.errors import NotFound, Unavailable
from relay_server.common.concurrency import MAX_OF_USER, MAX_WAITING, FairLock


class Bench:
    """Callers of the lock."""

    def __init__(self) -> None:
        self.lock = FairLock()
        self.had: list[int] = []

    def come(self, user: int, work: Deferred[None] | None = None) -> Deferred[None]:
        """Takes a turn for this time; None does not need the lock."""

        async def having() -> None:
            async with self.lock.hold(user):
                self.had.append(user)
                if work is None:
                    raise NotFound("nothing to do")
                await work

        return Deferred.fromCoroutine(having())


@pytest_twisted.ensureDeferred
async def test_all_of_them_are_few() -> None:
    """The waiting callers may finish at once."""
    bench, work = Bench(), Deferred[None]()
    first = bench.come(0, work)
    others = [bench.come(user) for user in range(1, MAX_WAITING)]
    with pytest.raises(Unavailable, match="too much"):
        await bench.come(MAX_WAITING)
    assert bench.had == [0]
    work.callback(None)
    await first
    for each in others:
        with pytest.raises(NotFound):
            await each
    assert bench.had == list(range(MAX_WAITING))


@pytest_twisted.ensureDeferred
async def test_those_of_one_user_are_fewer() -> None:
    """Until one of them is done."""
    bench, work = Bench(), Deferred[None]()
    waiting = [bench.come(7, work) for _ in range(MAX_OF_USER)]
    with pytest.raises(Unavailable, match="of your"):
        await bench.come(7)
    work.callback(None)
    for each in waiting:
        await each
    with pytest.raises(NotFound):
        await bench.come(7)


@pytest_twisted.ensureDeferred
async def test_gone_client_has_no_turn() -> None:
    """The next client gets the turn."""
    bench, work = Bench(), Deferred[None]()
    first, leaving, last = bench.come(1, work), bench.come(2), bench.come(3)
    leaving.cancel()
    work.callback(None)
    await first
    with pytest.raises(CancelledError):
        await leaving
    with pytest.raises(NotFound):
        await last
    assert bench.had == [1, 3]
