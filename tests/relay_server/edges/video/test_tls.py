"""Streams over TLS, which tells later what a connection takes."""

from __future__ import annotations

import time
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest_twisted
from switchboard_pulse import Pulse
from twisted.internet import reactor
from twisted.logger import LogEvent, globalLogPublisher

from relay_protocol.errors import Unavailable
from relay_server.common.database import AsyncDatabase
from relay_server.tls import ServerTls
from relay_server.video.multipart import LEAVING_SECONDS
from tests.relay_server.edges.video.show import CAMERA, STREAM, Looker, Show, jpeg, until
from tests.relay_server.test_tls import make


@pytest_twisted.async_yield_fixture
async def show(store: AsyncDatabase, tmp_path: Path) -> AsyncIterator[Show]:
    """A relay with a certificate."""
    made = Show(store, ServerTls(*make(tmp_path, "relay")))
    yield made
    await made.end()


async def looks(show: Show, window: int = 0) -> Looker:
    """Somebody who asks for the stream."""
    looker = show.looks(STREAM, window=window, tls=True)
    await looker.asks_by_tls()
    return looker


@pytest_twisted.ensureDeferred
async def test_pictures_of_any_size_come_whole_and_in_order(show: Show) -> None:
    """Small ones, which TLS joins, and large ones, which it cuts into pieces."""
    control = show.robot_comes()
    looker = await looks(show)
    stream = await show.joined(control)
    for body in (jpeg(), jpeg(500_000), jpeg(20_000)):
        show.shows(stream, body)
        if body == jpeg():
            assert (await looker.head())[0] == 200
        assert (await looker.part())[1] == body
    looker.leave()
    await until(lambda: not stream.viewers)


@pytest_twisted.ensureDeferred
async def test_the_end_of_a_stream_leaves_nothing_behind(show: Show) -> None:
    """The last picture still comes, and nobody aborts what is gone."""
    told: list[LogEvent] = []
    globalLogPublisher.addObserver(told.append)
    control = show.robot_comes()
    looker = await looks(show)
    stream = await show.joined(control)
    show.shows(stream, jpeg(60_000))
    stream.shut(Unavailable("no more"))
    assert (await looker.head())[0] == 200
    assert (await looker.part())[1] == jpeg(60_000)
    assert await looker.closed() < LEAVING_SECONDS
    looker.leave()
    clock: Any = reactor
    await until(lambda: not any("abortConnection" in str(each) for each in clock.getDelayedCalls()))
    globalLogPublisher.removeObserver(told.append)
    assert [each for each in told if "log_failure" in each] == []


@pytest_twisted.ensureDeferred
async def test_a_fast_viewer_sees_all_and_a_stalled_one_is_cut(show: Show) -> None:
    """As without TLS."""
    control = show.robot_comes()
    fast, stalled = await looks(show), await looks(show, window=4096)
    stream = await show.joined(control)
    await until(lambda: len(stream.viewers) == 2)
    began, pulse = time.monotonic(), Pulse()
    pulse.start()
    show.films(stream, jpeg(20_000))
    seen = len(await fast.parts(7.0))
    assert seen > 0.9 * (next(show.numbers) - 1) - 5
    await until(lambda: len(stream.viewers) == 1)
    assert time.monotonic() - began < 9 + pulse.lost()
    pulse.stop()
    assert await stalled.closed() < 1
    await show.deny(CAMERA)
    assert await fast.closed() < 1
