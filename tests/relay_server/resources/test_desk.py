"""What takes long of a resource is done in another thread."""

from __future__ import annotations

import gc
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import pytest
import pytest_twisted
from twisted.internet import reactor
from twisted.internet.defer import CancelledError, Deferred
from twisted.logger import LogEvent, globalLogPublisher

from relay_db import queries
from relay_protocol.errors import Invalid, Refused, Unavailable
from relay_server.common.cpu_quota import Quota
from relay_server.http.negotiation import ConversionPool
from relay_server.http_sessions.pool import SessionPool
from relay_server.resources.service import RequestOrigin, RobotResourceService
from tests.harness.switchboard_waiting import PATIENCE
from tests.relay_server.front_desk import HERE, Desk


@pytest.fixture
def threads() -> Iterator[ConversionPool]:
    """Where it is done."""
    made = ConversionPool(reactor)
    made.start()
    yield made
    made.stop()


def working() -> str:
    """Some work; gives the thread's name."""
    sum(range(100_000))
    return threading.current_thread().name


def failing() -> str:
    """The same, in vain."""
    working()
    raise Invalid("in vain")


class Slow:
    """Work that goes on until it is let go."""

    def __init__(self) -> None:
        self.begun = 0
        self.go = threading.Event()

    def __call__(self) -> int:
        """How many have begun."""
        self.begun += 1
        assert self.go.wait(PATIENCE)
        return self.begun

    def fail(self) -> None:
        """The same, in vain."""
        self()
        raise Invalid("in vain")


class Asking(NamedTuple):
    """A desk, and who asks there: ann."""

    desk: RobotResourceService
    asker: RequestOrigin
    share: Quota

    def made(self, work: Callable[[], Any]) -> Deferred[Any]:
        """Ask for something."""
        return Deferred.fromCoroutine(self.desk.made(self.asker, work))


async def asking(front: Desk, threads: ConversionPool) -> Asking:
    """Ann's rover is there."""
    front.world.robot_comes()
    guests = SessionPool(front.world.clock, front.desk, front.world.now_ns)
    desk = RobotResourceService(front.world.clock, guests, threads, front.world.now_ns, front.wall)
    asker = RequestOrigin(await front.by_token(front.ann), "rover", HERE)
    async with guests.at(*asker) as guest:
        return Asking(desk, asker, guest.session.allowance.requests)


async def until(condition: Callable[[], Any]) -> None:
    """Let the reactor work until then."""
    until = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < until
        done: Deferred[None] = Deferred()
        reactor.callLater(0.005, done.callback, None)  # type: ignore[attr-defined]
        await done


@pytest_twisted.ensureDeferred
async def test_long_work_is_on_the_account_of_who_asks(front: Desk, threads: ConversionPool) -> None:
    """Also what fails; who has used up his share gets no more."""
    desk, asker, share = await asking(front, threads)
    before = share.left
    assert await desk.made(asker, working) != threading.current_thread().name
    between = share.left
    assert between < before
    with pytest.raises(Invalid, match="in vain"):
        await desk.made(asker, failing)
    assert share.left < between
    share.spend(share.left + 1.0)
    with pytest.raises(Refused, match="share"):
        await desk.made(asker, working)


@pytest_twisted.ensureDeferred
async def test_one_user_leaves_room_for_others(front: Desk, threads: ConversionPool) -> None:
    """What he asks for while two pieces of his wait or are made is refused, also where who asked has left."""
    ann, slow = await asking(front, threads), Slow()
    with front.store.database.begin() as session:
        bob = queries.add_user(session, "bob", None)
        queries.grant_right(session, front.rover.id, "operator", user_id=bob.id)
    other = ann._replace(asker=ann.asker._replace(principal=await front.by_token(bob)))
    try:
        left, waits = ann.made(slow), ann.made(slow)
        await until(lambda: slow.begun)
        left.cancel()
        with pytest.raises(CancelledError):
            await left
        with pytest.raises(Unavailable, match="2 of your"):
            await ann.made(working)
        his = other.made(working)
        await until(lambda: ann.desk._turns._pieces[bob.id])
    finally:
        slow.go.set()
    assert await waits == 2
    await his
    await ann.made(working)


@pytest_twisted.ensureDeferred
async def test_the_share_is_looked_at_when_it_is_his_turn(front: Desk, threads: ConversionPool) -> None:
    """What waited while it was used up is not made."""
    ann, slow = await asking(front, threads), Slow()
    try:
        first, second = ann.made(slow), ann.made(slow)
        await until(lambda: slow.begun)
        ann.share.spend(ann.share.left + 1.0)
    finally:
        slow.go.set()
    assert await first == 1
    with pytest.raises(Refused, match="share"):
        await second
    assert slow.begun == 1


@pytest_twisted.ensureDeferred
async def test_a_relay_that_goes_down_makes_no_more(front: Desk, threads: ConversionPool) -> None:
    """What is being made is finished; what waits for its turn fails."""
    ann, slow = await asking(front, threads), Slow()
    try:
        first, second = ann.made(slow), ann.made(slow)
        await until(lambda: slow.begun)
        threads.close()
    finally:
        slow.go.set()
    assert await first == 1
    with pytest.raises(Unavailable, match="going down"):
        await second
    assert slow.begun == 1


@pytest_twisted.ensureDeferred
async def test_what_fails_for_who_has_left_is_no_failure_of_the_relay(
    front: Desk, threads: ConversionPool
) -> None:
    """Nothing is left in the log."""
    told: list[Any] = []

    def hear(event: LogEvent) -> None:
        if "log_failure" in event:
            told.append(event["log_failure"])

    ann, slow = await asking(front, threads), Slow()
    globalLogPublisher.addObserver(hear)
    try:
        leaving = ann.made(slow.fail)
        await until(lambda: slow.begun)
        leaving.cancel()
        with pytest.raises(CancelledError):
            await leaving
        del leaving
        slow.go.set()
        await ann.made(working)
        # An error that nobody took is logged when it is forgotten.
        gc.collect()
    finally:
        slow.go.set()
        globalLogPublisher.removeObserver(hear)
    assert told == []
