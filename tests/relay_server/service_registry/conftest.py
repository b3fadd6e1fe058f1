"""Fixtures for tests of the service registry."""

from __future__ import annotations

import pytest

from relay_server.common.database import AsyncDatabase
from tests.worlds.relay import Time
from tests.worlds.service_registry import Room


@pytest.fixture
def room(store: AsyncDatabase, time: Time) -> Room:
    """A registry without entries."""
    return Room(store, time)
