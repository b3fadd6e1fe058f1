"""Tokens in the URL of a robot's websocket, for Foxglove and Lichtblick, which can send nothing but a URL.

Such a token works again and again, until it expires or is revoked. It opens the Foxglove websockets of one robot, and
nothing else. A URL is shown on screens and in lists of processes, so the token is limited to a viewer's rights, unless
its user has chosen more.
"""

from __future__ import annotations

import re
from collections import OrderedDict
from collections.abc import Callable

from relay_db import queries
from relay_server.access import BadCredentials, Principal, keep_newest
from relay_server.auth import passwords
from relay_server.auth.authenticator import TooManyTries
from relay_server.auth.login_limiter import LoginLimiter
from relay_server.common.database import AsyncDatabase

REMEMBERED = 10_000
"""Most hashes of tokens that are remembered as good, and as ended."""

ENDED = "the token in the URL is unknown, expired or revoked; make a new Foxglove URL"

_KINDS: tuple[queries.TokenKind, ...] = ("foxglove",)
_FORM = re.compile(rf"{passwords.TOKEN_PREFIX}[A-Za-z0-9_-]{{43}}\Z")


class UrlTokens:
    """Finds the principal of a token in a URL.

    Only tokens that were never seen count as failures of their network: a program repeats its URL every few seconds,
    and must not lock out others of its network after its token was revoked.

    :param refreshed: changes with each change of the database; see :attr:`relay_server.access.Access.refreshed`
    :param seconds: a monotonic clock
    :param wall: Unix time in seconds
    """

    def __init__(
        self,
        store: AsyncDatabase,
        refreshed: Callable[[], int],
        seconds: Callable[[], float],
        wall: Callable[[], float],
    ) -> None:
        self._store = store
        self._refreshed = refreshed
        self._wall = wall
        self._limiter = LoginLimiter(seconds)
        self._good: OrderedDict[str, int] = OrderedDict()
        """Hashes of tokens that were valid once."""
        self._ended: OrderedDict[str, int] = OrderedDict()
        """By the hash of a token, the state of the database in which it was not valid."""

    async def principal(self, token: str, address: str) -> Principal:
        """The principal of a token.

        :param address: of the client, for the limit on guesses
        :raises BadCredentials: unknown, expired, revoked, or its user is disabled
        :raises TooManyTries: too many unknown tokens came from the client's network; the database is not asked
        """
        if not _FORM.match(token):
            raise BadCredentials(ENDED)
        token_hash, refreshed = passwords.token_hash(token), self._refreshed()
        if self._ended.get(token_hash) == refreshed:
            raise BadCredentials(ENDED)
        if token_hash not in self._good and token_hash not in self._ended:
            wait = self._limiter.wait(None, address)
            if wait > 0:
                raise TooManyTries(wait)
        record = await self._store.read(queries.principal_by_token, token_hash, self._wall(), _KINDS)
        if record is None:
            if token_hash not in self._good and token_hash not in self._ended:
                self._limiter.failed(None, address)
            keep_newest(self._ended, token_hash, refreshed, REMEMBERED)
            raise BadCredentials(ENDED)
        keep_newest(self._good, token_hash, refreshed, REMEMBERED)
        self._ended.pop(token_hash, None)
        return Principal.of(record)
