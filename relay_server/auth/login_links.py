"""Login links of one use, with which people get in to a relay where they have no password yet."""

from __future__ import annotations

import time

from relay_db import queries
from relay_protocol.errors import Invalid
from relay_protocol.realms import DEFAULT_REALM, parted
from relay_server.auth import passwords
from relay_server.common.database import AsyncDatabase

LINK_SECONDS = 3600.0


async def first_login(store: AsyncDatabase, url: str) -> str | None:
    """A link for the administrator of a relay nobody can log in to yet.

    :param url: where people go
    """
    users = await store.read(queries.list_users, DEFAULT_REALM)
    if any(user.password_hash is not None or user.name != "admin" for user in users):
        return None
    return await login_link(store, url, "admin", create=True)


async def login_link(store: AsyncDatabase, url: str, user: str, create: bool = False) -> str:
    """A link for a user.

    :param url: where people go
    :param user: ``toad@lab1``; without a realm one of the default one
    :param create: make the user, an administrator, when there is none
    :raises Invalid: no such user
    """
    name, realm = parted(user)
    record = await store.read(queries.find_user, name, realm)
    if record is None:
        if not create:
            raise Invalid(f"there is no user '{user}'")
        record = await store.write(queries.add_user, name, None, admin=True, realm=realm)
    code = passwords.new_token()
    now = time.time()
    await store.write(
        queries.create_token,
        record.id,
        passwords.token_hash(code),
        kind="login",
        label="login link",
        expires=now + LINK_SECONDS,
        now=now,
    )
    return f"{url}/login#code={code}"
