"""What the tests of the directory share."""

from __future__ import annotations

import pytest

from relay_server.common.database import AsyncDatabase
from tests.relay_server.directory.room import Room
from tests.relay_server.memory import Time


@pytest.fixture
def room(store: AsyncDatabase, time: Time) -> Room:
    """Nothing is registered."""
    return Room(store, time)
