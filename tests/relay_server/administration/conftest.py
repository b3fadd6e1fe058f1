"""For all tests of administration."""

from __future__ import annotations

import pytest

from relay_server.common.database import AsyncDatabase
from tests.relay_server.administration.office import Office


@pytest.fixture
def office(store: AsyncDatabase) -> Office:
    """Everybody."""
    return Office(store)
