"""What is there no more is forgotten."""

from __future__ import annotations

import pytest_twisted

from relay_db import queries
from relay_server.change_watcher import RealmCaches
from relay_server.common.database import AsyncDatabase


@pytest_twisted.ensureDeferred
async def test_a_realm_that_was_made_anew_is_gone_and_there(store: AsyncDatabase) -> None:
    """Though one of its name was found whenever it was looked."""
    told: list[tuple[list[str], list[str]]] = []
    realms = RealmCaches(store, lambda gone, there: told.append((sorted(gone), sorted(there))))
    await store.write(queries.add_realm, "lab")
    await store.write(queries.add_realm, "plant")
    await realms.look()
    await store.write(queries.remove_realm, "lab")
    await store.write(queries.add_realm, "lab")
    await realms.look()
    await store.write(queries.remove_realm, "plant")
    await realms.look()
    await realms.look()
    every = ["default", "lab", "plant"]
    assert told == [([], every), (["lab"], every), (["plant"], every[:2]), ([], every[:2])]
