"""Streams over TLS, which tells later what a connection takes."""

from __future__ import annotations

import time
from collections.abc import AsyncIterator
from pathlib import Path

import pytest_twisted

from relay_server.store import Store
from relay_server.tls import ServerTls
from tests.relay_server.edges.video.show import CAMERA, STREAM, Looker, Show, jpeg, until
from tests.relay_server.test_tls import make


@pytest_twisted.async_yield_fixture
async def show(store: Store, tmp_path: Path) -> AsyncIterator[Show]:
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
async def test_a_fast_viewer_sees_all_and_a_stalled_one_is_cut(show: Show) -> None:
    """As without TLS."""
    control = show.robot_comes()
    fast, stalled = await looks(show), await looks(show, window=4096)
    stream = await show.joined(control)
    await until(lambda: len(stream.viewers) == 2)
    began = time.monotonic()
    show.films(stream, jpeg(20_000))
    seen = len(await fast.parts(7.0))
    assert seen > 0.9 * (next(show.numbers) - 1) - 5
    await until(lambda: len(stream.viewers) == 1)
    assert time.monotonic() - began < 9
    assert await stalled.closed() < 1
    await show.deny(CAMERA)
    assert await fast.closed() < 1
