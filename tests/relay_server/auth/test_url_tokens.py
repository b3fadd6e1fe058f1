"""Tokens in URLs: limits on guesses before the database is asked."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import pytest
import pytest_twisted

from relay_db import queries
from relay_server.access import BadCredentials
from relay_server.auth import login_limiter, passwords
from relay_server.auth.authenticator import TooManyTries
from relay_server.auth.url_tokens import UrlTokens
from relay_server.common.database import AsyncDatabase

HERE = "192.0.2.1"


class CountedReads:
    """A database that counts how often it is read."""

    def __init__(self, store: AsyncDatabase) -> None:
        self.store = store
        self.reads = 0

    async def read(self, query: Callable[..., Any], *args: Any) -> Any:
        self.reads += 1
        return await self.store.read(query, *args)


class Scene:
    """A user with one token in a URL of the robot rover."""

    def __init__(self, store: AsyncDatabase) -> None:
        self.reads = CountedReads(store)
        self.state, self.now = 0, 1000.0
        self.tokens = UrlTokens(
            cast(AsyncDatabase, self.reads),
            refreshed=lambda: self.state,
            seconds=lambda: self.now,
            wall=lambda: self.now,
        )
        self.token = passwords.new_token()
        with store.database.begin() as s:
            self.ann = queries.add_user(s, "ann", None, admin=True)
            self.rover = queries.add_robot(s, "rover")
            self.number = queries.create_token(
                s,
                self.ann.id,
                passwords.token_hash(self.token),
                kind="foxglove",
                expires=2000.0,
                now=1.0,
                scope="viewer",
                robot_id=self.rover.id,
            )

    async def refused(self, token: str, error: type[Exception] = BadCredentials) -> None:
        """A token that opens no connection."""
        with pytest.raises(error) as caught:
            await self.tokens.principal(token, HERE)
        assert len(token) < 10 or token not in str(caught.value)


@pytest_twisted.ensureDeferred
async def test_a_token_works_again_and_again_until_it_expires(store: AsyncDatabase) -> None:
    scene = Scene(store)
    for _ in range(3):
        found = await scene.tokens.principal(scene.token, HERE)
    assert (found.user_id, found.robot_id, str(found.scope), found.admin) == (
        scene.ann.id,
        scene.rover.id,
        "viewer",
        False,
    )
    scene.now = 2000.0
    await scene.refused(scene.token)


@pytest.mark.parametrize("token", ["", "x", "swb_", "swb_" + "a" * 42, "swb_" + "a" * 44, "swb_" + "ä" * 43])
@pytest_twisted.ensureDeferred
async def test_a_text_that_can_be_no_token_does_not_reach_the_database(
    store: AsyncDatabase, token: str
) -> None:
    scene = Scene(store)
    await scene.refused(token)
    assert scene.reads.reads == 0


@pytest.mark.parametrize("kind", ["access", "session", "login"])
@pytest_twisted.ensureDeferred
async def test_tokens_of_other_kinds_open_nothing(store: AsyncDatabase, kind: Any) -> None:
    scene, token = Scene(store), passwords.new_token()
    hashed = passwords.token_hash(token)
    await store.write(queries.create_token, scene.ann.id, hashed, kind=kind, expires=None, now=1.0)
    await scene.refused(token)


@pytest_twisted.ensureDeferred
async def test_guesses_of_a_network_are_limited_before_the_database_is_asked(store: AsyncDatabase) -> None:
    """Tokens that were valid before still work."""
    scene = Scene(store)
    await scene.tokens.principal(scene.token, HERE)
    for _ in range(login_limiter.FAILURES_OF_NETWORK):
        await scene.refused(passwords.new_token())
    before = scene.reads.reads
    await scene.refused(passwords.new_token(), TooManyTries)
    assert scene.reads.reads == before
    await scene.tokens.principal(scene.token, HERE)
    scene.now += login_limiter.WINDOW
    await scene.refused(passwords.new_token())


@pytest_twisted.ensureDeferred
async def test_a_revoked_token_that_is_sent_again_counts_as_no_guess(store: AsyncDatabase) -> None:
    """It is refused from memory until the database changes."""
    scene = Scene(store)
    await scene.tokens.principal(scene.token, HERE)
    await store.write(queries.revoke_token, scene.number)
    for _ in range(2 * login_limiter.FAILURES_OF_NETWORK):
        await scene.refused(scene.token)
    assert scene.reads.reads == 2
    scene.state += 1
    await scene.refused(scene.token)
    assert scene.reads.reads == 3
    await scene.refused(passwords.new_token())


@pytest_twisted.ensureDeferred
async def test_a_user_that_is_enabled_again_may_use_the_url_again(store: AsyncDatabase) -> None:
    scene = Scene(store)
    await store.write(queries.set_disabled, scene.ann.id, True)
    await scene.refused(scene.token)
    await store.write(queries.set_disabled, scene.ann.id, False)
    scene.state += 1
    assert (await scene.tokens.principal(scene.token, HERE)).user_id == scene.ann.id
