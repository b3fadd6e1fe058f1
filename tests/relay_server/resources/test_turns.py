"""Who has the thread, and who waits for it."""

from __future__ import annotations

import pytest
import pytest_twisted
from twisted.internet.defer import CancelledError, Deferred

from relay_protocol.errors import NotFound, Unavailable
from relay_server.common.fair_lock import PIECES, WAITING, FairLock


class Bench:
    """Those who take turns."""

    def __init__(self) -> None:
        self.turns = FairLock()
        self.had: list[int] = []

    def come(self, user: int, work: Deferred[None] | None = None) -> Deferred[None]:
        """Have a turn for so long as that takes; without it, for nothing."""

        async def having() -> None:
            async with self.turns.turn(user):
                self.had.append(user)
                if work is None:
                    raise NotFound("nothing to do")
                await work

        return Deferred.fromCoroutine(having())


@pytest_twisted.ensureDeferred
async def test_all_of_them_are_few() -> None:
    """As many as wait may give their turns back at once."""
    bench, work = Bench(), Deferred[None]()
    first = bench.come(0, work)
    others = [bench.come(user) for user in range(1, WAITING)]
    with pytest.raises(Unavailable, match="too much"):
        await bench.come(WAITING)
    assert bench.had == [0]
    work.callback(None)
    await first
    for each in others:
        with pytest.raises(NotFound):
            await each
    assert bench.had == list(range(WAITING))


@pytest_twisted.ensureDeferred
async def test_those_of_one_user_are_fewer() -> None:
    """Until one is done."""
    bench, work = Bench(), Deferred[None]()
    waiting = [bench.come(7, work) for _ in range(PIECES)]
    with pytest.raises(Unavailable, match="of your"):
        await bench.come(7)
    work.callback(None)
    for each in waiting:
        await each
    with pytest.raises(NotFound):
        await bench.come(7)


@pytest_twisted.ensureDeferred
async def test_who_leaves_has_no_turn() -> None:
    """The next one has it."""
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
