"""Fixtures for tests of realm administration."""

from __future__ import annotations

import pytest

from relay_server.common.database import AsyncDatabase
from tests.worlds.realm_admin import RealmAdminWorld


@pytest.fixture
def world(store: AsyncDatabase) -> RealmAdminWorld:
    """A world with all users."""
    return RealmAdminWorld(store)
