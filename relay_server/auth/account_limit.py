"""Limits failed logins of one account over all networks that its user has never logged in from.

Many addresses do not help to guess a password then, and an attacker cannot lock a user out of networks that they have
logged in from. The database counts, so a restart forgets nothing, and all relays of a cluster count together.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable

from sqlalchemy.orm import Session

from relay_db import queries
from relay_server.auth.login_limiter import TooManyTries, network_of, person
from relay_server.common.database import AsyncDatabase

FAILURES_OF_ACCOUNT = 20
ACCOUNT_WINDOW = 3600.0
"""Seconds in which the failures count."""

REFRESH_SECONDS = 24 * 3600.0
"""A login from a known network is recorded if the last recorded one is older."""


class AccountLimit:
    """:param wall: Unix time in seconds"""

    def __init__(self, database: AsyncDatabase, wall: Callable[[], float]) -> None:
        self._database = database
        self._wall = wall

    async def count(self, account: str, user_id: int | None, address: str) -> int | None:
        """Count a try as a failure, before its password is checked.

        :param user_id: ``None``: there is no such user, which makes no difference to the client
        :returns: number of the failure; ``None``: the user has logged in from this network before
        :raises TooManyTries: there are :data:`FAILURES_OF_ACCOUNT` already
        :raises Unavailable: the database does not answer
        """
        if user_id is not None and await self._last_login(user_id, address) is not None:
            return None
        key = hashlib.sha256(person(account).encode("utf-8", "surrogatepass")).hexdigest()
        return await self._database.write(_count, key, self._wall())

    async def forgive(self, failure: int | None) -> None:
        """Take a failure back: no password was tried.

        :param failure: what :meth:`count` returned
        """
        if failure is not None:
            await self._database.write(queries.remove_login_failure, failure)

    async def succeeded(self, failure: int | None, user_id: int, address: str) -> None:
        """The password was right: take the failure back, and remember the network."""
        now = self._wall()
        last = None if failure is not None else await self._last_login(user_id, address)
        if last is None or now - last > REFRESH_SECONDS:
            await self._database.write(_succeed, failure, user_id, network_of(address), now)

    async def _last_login(self, user_id: int, address: str) -> float | None:
        return await self._database.read(queries.last_login_from, user_id, network_of(address))


def _count(s: Session, account: str, now: float) -> int:
    expiries = queries.login_failures(s, account, now)
    if len(expiries) >= FAILURES_OF_ACCOUNT:
        raise TooManyTries(min(expiries) - now)
    return queries.add_login_failure(s, account, now + ACCOUNT_WINDOW)


def _succeed(s: Session, failure: int | None, user_id: int, network: str, now: float) -> None:
    if failure is not None:
        queries.remove_login_failure(s, failure)
    queries.remember_login_network(s, user_id, network, now)
