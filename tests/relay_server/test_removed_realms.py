"""Data of removed realms is deleted."""

from __future__ import annotations

import pytest_twisted

from relay_db import queries
from relay_server.common.database import AsyncDatabase
from relay_server.maintenance import RealmCaches


@pytest_twisted.ensureDeferred
async def test_a_realm_created_again_is_both_removed_and_present(store: AsyncDatabase) -> None:
    """Even if a realm of its name existed at each check."""
    reported: list[tuple[list[str], list[str]]] = []
    realms = RealmCaches(store, lambda gone, there: reported.append((sorted(gone), sorted(there))))
    await store.write(queries.add_realm, "lab")
    await store.write(queries.add_realm, "plant")
    await realms.refresh()
    await store.write(queries.remove_realm, "lab")
    await store.write(queries.add_realm, "lab")
    await realms.refresh()
    await store.write(queries.remove_realm, "plant")
    await realms.refresh()
    await realms.refresh()
    every = ["default", "lab", "plant"]
    assert reported == [([], every), (["lab"], every), (["plant"], every[:2]), ([], every[:2])]
