"""Login links for users without a password."""

from __future__ import annotations

import pytest
import pytest_twisted

from relay_db import queries
from relay_protocol.errors import Invalid
from relay_server.auth import passwords
from relay_server.auth.service import first_login, login_link
from relay_server.common.database import AsyncDatabase

URL = "https://relay.example.org"


async def user_of(store: AsyncDatabase, link: str) -> int:
    """The number of the user that a link logs in."""
    found = await store.write(queries.consume_login, passwords.token_hash(link.partition("#code=")[2]), 1.0)
    assert found is not None
    return found.user_id


@pytest_twisted.ensureDeferred
async def test_users_of_other_realms_admit_no_user_to_the_default_one(store: AsyncDatabase) -> None:
    """The first administrator gets a link until the default realm has a user."""
    await store.write(queries.add_realm, "lab")
    await store.write(queries.add_user, "admin", "hash", realm="lab")
    await store.write(queries.add_user, "toad", "hash", realm="lab")
    link = await first_login(store, URL)
    assert link is not None
    admin = await store.read(queries.find_user, "admin")
    assert admin is not None and admin.admin and await user_of(store, link) == admin.id
    await store.write(queries.add_user, "ann", None)
    assert await first_login(store, URL) is None


@pytest_twisted.ensureDeferred
async def test_a_link_is_for_the_user_of_the_realm_that_is_named(store: AsyncDatabase) -> None:
    """Users of the same name in other realms cannot use it."""
    await store.write(queries.add_realm, "lab")
    toad = await store.write(queries.add_user, "toad", None, realm="lab")
    assert await user_of(store, await login_link(store, URL, "toad@lab")) == toad.id
    with pytest.raises(Invalid, match="no user 'toad'"):
        await login_link(store, URL, "toad")
