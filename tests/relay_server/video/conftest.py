"""A relay's site on a real port."""

from __future__ import annotations

from collections.abc import AsyncIterator

import pytest_twisted

from relay_server.common.database import AsyncDatabase
from tests.worlds.video_site import Show


@pytest_twisted.async_yield_fixture
async def show(store: AsyncDatabase) -> AsyncIterator[Show]:
    """An offline robot, and ann who may view it."""
    made = Show(store)
    yield made
    await made.end()
