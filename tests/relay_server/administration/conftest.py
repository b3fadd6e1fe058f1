"""For all tests of administration."""

from __future__ import annotations

import pytest

from relay_server.store import Store
from tests.relay_server.administration.office import Office


@pytest.fixture
def office(store: Store) -> Office:
    """Everybody."""
    return Office(store)
