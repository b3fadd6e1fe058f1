"""Streams over TLS, which reports written bytes later."""

from __future__ import annotations

import time
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest_twisted
from twisted.internet import reactor, task
from twisted.logger import LogEvent, globalLogPublisher

from relay_protocol.errors import Unavailable
from relay_server.common.database import AsyncDatabase
from relay_server.listeners import ServerTls
from tests.relay_server.test_tls import make
from tests.worlds.video_site import CAMERA, STREAM, RawClient, Show, jpeg, until


@pytest_twisted.async_yield_fixture
async def show(store: AsyncDatabase, tmp_path: Path) -> AsyncIterator[Show]:
    """A relay with a certificate."""
    made = Show(store, ServerTls(*make(tmp_path, "relay")))
    yield made
    await made.end()


async def request(show: Show, window: int = 0) -> RawClient:
    """A client that requests the stream."""
    client = show.request(STREAM, window=window, tls=True)
    await client.asks_by_tls()
    return client


@pytest_twisted.ensureDeferred
async def test_frames_of_any_size_come_whole_and_in_order(show: Show) -> None:
    """TLS joins small ones and divides large ones."""
    control = show.robot_comes()
    client = await request(show)
    stream = await show.joined(control)
    for body in (jpeg(), jpeg(500_000), jpeg(20_000)):
        show.shows(stream, body, time.monotonic())
        if body == jpeg():
            assert (await client.head())[0] == 200
        assert (await client.part())[1] == body
    client.leave()
    await until(lambda: not stream.viewers)


@pytest_twisted.ensureDeferred
async def test_the_end_of_a_stream_leaves_nothing_behind(show: Show) -> None:
    """The last frame still arrives, and no abort follows the close."""
    reported: list[LogEvent] = []
    globalLogPublisher.addObserver(reported.append)
    control = show.robot_comes()
    client = await request(show)
    stream = await show.joined(control)
    show.shows(stream, jpeg(60_000))
    stream.close(Unavailable("no more"))
    assert (await client.head())[0] == 200
    assert (await client.part())[1] == jpeg(60_000)
    assert await client.closed(), "the relay did not wait for its last frame"
    client.leave()
    clock: Any = reactor
    await until(lambda: not any("abortConnection" in str(each) for each in clock.getDelayedCalls()))
    globalLogPublisher.removeObserver(reported.append)
    assert [each for each in reported if "log_failure" in each] == []


@pytest_twisted.ensureDeferred
async def test_a_fast_viewer_sees_all_and_a_stalled_one_is_cut(show: Show) -> None:
    """As without TLS."""
    control = show.robot_comes()
    fast, stalled = await request(show), await request(show, window=4096)
    stream = await show.joined(control)
    await until(lambda: len(stream.viewers) == 2)
    body = jpeg(20_000)
    show.shows(stream, body, time.monotonic())
    await fast.head()
    while len(stream.viewers) == 2:
        # A frame only follows when the fast viewer has this one.
        assert (await fast.part())[1] == body
        await task.deferLater(reactor, 0.05)  # type: ignore[arg-type]
        show.shows(stream, body, time.monotonic())
    await stalled.closed()
    await show.deny(CAMERA)
    await fast.closed()
