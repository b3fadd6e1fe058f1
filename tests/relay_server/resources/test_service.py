"""Long conversions of resources run in another thread."""

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
from relay_server.common.cpu_quota import CpuQuota
from relay_server.in_process_sessions.pool import InProcessSessionPool, RobotCaller
from relay_server.resources.representations import ConversionPool
from relay_server.resources.service import RobotResourceService
from tests.worlds.session_manager import HERE, SessionsWorld
from tests.worlds.waiting import PATIENCE


@pytest.fixture
def threads() -> Iterator[ConversionPool]:
    """The pool of threads."""
    made = ConversionPool(reactor)
    made.start()
    yield made
    made.stop()


def working() -> str:
    """Some work; returns the thread's name."""
    sum(range(100_000))
    return threading.current_thread().name


def failing() -> str:
    """Work that fails."""
    working()
    raise Invalid("in vain")


class Slow:
    """Work that lasts until the test releases it."""

    def __init__(self) -> None:
        self.begun = 0
        self.go = threading.Event()

    def __call__(self) -> int:
        """Returns how many have begun."""
        self.begun += 1
        assert self.go.wait(PATIENCE)
        return self.begun

    def fail(self) -> None:
        """Work that fails when it is released."""
        self()
        raise Invalid("in vain")


class Asking(NamedTuple):
    """A resource service with requests by ann."""

    service: RobotResourceService
    caller: RobotCaller
    share: CpuQuota

    def made(self, work: Callable[[], Any]) -> Deferred[Any]:
        """Makes a request."""
        return Deferred.fromCoroutine(self.service.convert(self.caller, work))


async def asking(front: SessionsWorld, threads: ConversionPool) -> Asking:
    """Ann's rover is online."""
    front.world.robot_comes()
    pool = InProcessSessionPool(front.world.clock, front.service)
    service = RobotResourceService(front.world.clock, pool, threads, front.world.now_ns, front.wall)
    caller = RobotCaller(await front.by_token(front.ann), "rover", HERE)
    async with pool.at(caller) as pooled:
        return Asking(service, caller, pooled.client.quota.user.requests)


async def until(condition: Callable[[], Any]) -> None:
    """Runs the reactor until the condition holds."""
    until = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < until
        done: Deferred[None] = Deferred()
        reactor.callLater(0.005, done.callback, None)  # type: ignore[attr-defined]
        await done


@pytest_twisted.ensureDeferred
async def test_long_work_counts_for_the_requesting_user(
    front: SessionsWorld, threads: ConversionPool
) -> None:
    """Failed work counts too; a user without quota gets no more."""
    service, caller, share = await asking(front, threads)
    before = share.left
    assert await service.convert(caller, working) != threading.current_thread().name
    between = share.left
    assert between < before
    with pytest.raises(Invalid, match="in vain"):
        await service.convert(caller, failing)
    assert share.left < between
    share.spend(share.left + 1.0)
    with pytest.raises(Refused, match="share"):
        await service.convert(caller, working)


@pytest_twisted.ensureDeferred
async def test_limit_per_user_leaves_room_for_others(front: SessionsWorld, threads: ConversionPool) -> None:
    """A third conversion of a user is refused, even after earlier clients have left."""
    ann, slow = await asking(front, threads), Slow()
    with front.store.database.begin() as session:
        bob = queries.add_user(session, "bob", None)
        queries.grant_right(session, front.rover.id, "operator", user_id=bob.id)
    other = ann._replace(caller=ann.caller._replace(principal=await front.by_token(bob)))
    try:
        left, waits = ann.made(slow), ann.made(slow)
        await until(lambda: slow.begun)
        left.cancel()
        with pytest.raises(CancelledError):
            await left
        with pytest.raises(Unavailable, match="2 of your"):
            await ann.made(working)
        his = other.made(working)
        await until(lambda: ann.service._fair_lock._callers[bob.id])
    finally:
        slow.go.set()
    assert await waits == 2
    await his
    await ann.made(working)


@pytest_twisted.ensureDeferred
async def test_the_quota_is_checked_when_the_work_begins(
    front: SessionsWorld, threads: ConversionPool
) -> None:
    """Work that waited while the quota was used up is not done."""
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
async def test_a_relay_that_goes_down_makes_no_more(front: SessionsWorld, threads: ConversionPool) -> None:
    """Active work is finished; waiting work fails."""
    ann, slow = await asking(front, threads), Slow()
    try:
        first, second = ann.made(slow), ann.made(slow)
        await until(lambda: slow.begun)
        threads.close()
    finally:
        slow.go.set()
    assert await first == 1
    with pytest.raises(Unavailable, match="shutting down"):
        await second
    assert slow.begun == 1


@pytest_twisted.ensureDeferred
async def test_failure_for_a_gone_client_is_not_logged(front: SessionsWorld, threads: ConversionPool) -> None:
    reported: list[Any] = []

    def observe(event: LogEvent) -> None:
        if "log_failure" in event:
            reported.append(event["log_failure"])

    ann, slow = await asking(front, threads), Slow()
    globalLogPublisher.addObserver(observe)
    try:
        leaving = ann.made(slow.fail)
        await until(lambda: slow.begun)
        leaving.cancel()
        with pytest.raises(CancelledError):
            await leaving
        del leaving
        slow.go.set()
        await ann.made(working)
        # An unhandled error would be logged when its Deferred is collected.
        gc.collect()
    finally:
        slow.go.set()
        globalLogPublisher.removeObserver(observe)
    assert reported == []
