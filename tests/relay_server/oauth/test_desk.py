"""Tokens as they are asked for, on a real database."""

from __future__ import annotations

import base64
from collections.abc import Iterator
from typing import Any

import pytest
import pytest_twisted
from twisted.internet import reactor

from relay_db import queries
from relay_protocol.errors import Unavailable
from relay_server.access import Access, BadCredentials
from relay_server.auth import passwords
from relay_server.auth.authenticator import Authenticator, TooManyTries
from relay_server.auth.login_limiter import FAILURES
from relay_server.common.database import AsyncDatabase
from relay_server.events.bus import EventBus
from relay_server.oauth.service import ACCESS_SECONDS, REFRESH_SECONDS, OAuthError, OAuthService, TokenRequest

HERE = "192.0.2.1"
PASSWORD = "correct horse"
KEY, SECRET = "swp_1", "swb_secret"


class World:
    """A desk, ann with a password, and a program of hers."""

    def __init__(self, store: AsyncDatabase) -> None:
        self.now = 1000.0
        self.store = store
        self.auth = Authenticator(reactor, store, lambda: self.now, lambda: self.now)  # type: ignore[arg-type]
        self.access = Access(store, lambda: self.now)
        journal = EventBus(store, lambda: self.now)
        self.told: list[tuple[str, dict[str, Any]]] = []
        journal.listen(lambda kind, robot, data: self.told.append((kind, data)))
        self.desk = OAuthService(store, self.auth, self.access, journal, lambda: self.now, lambda: self.now)

    async def fill(self, scope: str | None = None) -> None:
        """Ann and her program."""
        ann = await self.store.write(queries.add_user, "ann", passwords.hash_password(PASSWORD))
        known = passwords.verifier(KEY, SECRET)
        await self.store.write(queries.add_program, ann.id, KEY, known, scope=scope, label="", now=self.now)

    async def by_password(self, scope: str | None = None, password: str = PASSWORD) -> dict[str, Any]:
        """What ann gets."""
        ask = TokenRequest("password", username="ann", password=password, scope=scope)
        return (await self.desk.token(ask, None, HERE)).told()

    async def by_secret(self, scope: str | None = None, realm: str | None = None) -> dict[str, Any]:
        """What her program gets."""
        program = await self.desk.program("", "POST", "/", HERE, (KEY, SECRET))
        ask = TokenRequest("client_credentials", scope=scope, realm=realm)
        return (await self.desk.token(ask, program, HERE)).told()

    async def joins(self, realm: str) -> None:
        """Ann has an account in another realm, too."""
        with self.store.database.begin() as s:
            ann = queries.find_user(s, "ann")
            assert ann is not None
            queries.add_realm(s, realm)
            queries.add_guest(s, ann.id, realm)

    async def refreshed(self, token: str, scope: str | None = None) -> dict[str, Any]:
        """What follows on a refresh token."""
        ask = TokenRequest("refresh_token", refresh_token=token, scope=scope)
        return (await self.desk.token(ask, None, HERE)).told()

    async def error(self, asking: Any) -> str:
        """Of a request that fails."""
        with pytest.raises(OAuthError) as caught:
            await asking
        return caught.value.error


@pytest.fixture
def there(store: AsyncDatabase) -> Iterator[World]:
    """The world."""
    world = World(store)
    world.auth.start()
    yield world
    world.auth.stop()


@pytest_twisted.ensureDeferred
async def test_a_password_gives_a_token_and_one_to_go_on_with(there: World) -> None:
    """The access token acts as the user; it is on record."""
    await there.fill()
    told = await there.by_password()
    assert told["token_type"] == "Bearer" and told["expires_in"] == ACCESS_SECONDS
    assert "scope" not in told
    principal = await there.auth.token(told["access_token"])
    assert (principal.name, principal.scope) == ("ann", None)
    [entry] = await there.store.read(queries.list_audit, limit=9)
    assert (entry.action, entry.actor, entry.data["how"]) == ("token.issue", "user:ann", "password")
    there.now += ACCESS_SECONDS
    with pytest.raises(BadCredentials):
        await there.auth.token(told["access_token"])


@pytest_twisted.ensureDeferred
async def test_a_wrong_password_gives_none(there: World) -> None:
    """It is an event; too many are refused before anything is hashed."""
    await there.fill()
    assert await there.error(there.by_password(password="wrong")) == "invalid_grant"
    said = {"user": "ann", "realm": "default", "address": HERE, "reason": "bad_credentials"}
    assert there.told[-1] == ("login.refused", said)
    ask = TokenRequest("password", username=f"{'x' * 100}@LAB1", password="wrong")
    assert await there.error(there.desk.token(ask, None, HERE)) == "invalid_grant"
    assert there.told[-1] == ("login.refused", {**said, "user": f"{'x' * 100}@LAB1", "realm": "lab1"})
    for _ in range(FAILURES - 1):
        await there.error(there.by_password(password="wrong"))
    with pytest.raises(TooManyTries):
        await there.by_password()


@pytest_twisted.ensureDeferred
async def test_a_scope_is_given_as_it_was_asked_for(there: World) -> None:
    """And narrows what the token does."""
    await there.fill()
    told = await there.by_password("viewer operator@rover")
    assert told["scope"] == "viewer operator@rover"
    assert str((await there.auth.token(told["access_token"])).scope) == "viewer operator@rover"
    assert await there.error(there.by_password("king")) == "invalid_scope"


@pytest_twisted.ensureDeferred
async def test_a_refresh_token_is_used_once(there: World) -> None:
    """Each gives the next; one that comes again ends all of them."""
    await there.fill()
    first = await there.by_password("operator")
    second = await there.refreshed(first["refresh_token"])
    assert second["scope"] == "operator"
    await there.auth.token(second["access_token"])
    assert await there.error(there.refreshed(first["refresh_token"])) == "invalid_grant"
    assert await there.error(there.refreshed(second["refresh_token"])) == "invalid_grant"
    for each in (first, second):
        with pytest.raises(BadCredentials):
            await there.auth.token(each["access_token"])


@pytest_twisted.ensureDeferred
async def test_a_refreshed_token_may_be_for_less(there: World) -> None:
    """Never for more; what is refused for that costs nothing."""
    await there.fill()
    first = await there.by_password("operator")
    for scope in ("owner", "admin", "king"):
        assert await there.error(there.refreshed(first["refresh_token"], scope)) == "invalid_scope"
    second = await there.refreshed(first["refresh_token"], "viewer@rover")
    assert second["scope"] == "viewer@rover"
    assert (await there.refreshed(second["refresh_token"]))["scope"] == "operator"


@pytest_twisted.ensureDeferred
async def test_a_refresh_token_ends_by_itself(there: World) -> None:
    """After so long somebody has to log in."""
    await there.fill()
    first = await there.by_password()
    there.now += REFRESH_SECONDS
    assert await there.error(there.refreshed(first["refresh_token"])) == "invalid_grant"


@pytest_twisted.ensureDeferred
async def test_a_program_gets_what_its_scope_allows(there: World) -> None:
    """All of it, or less; it has its secret, and gets nothing to refresh."""
    await there.fill("operator@rover viewer")
    told = await there.by_secret()
    assert told["scope"] == "operator@rover viewer" and "refresh_token" not in told
    assert (await there.by_secret("viewer@arm"))["scope"] == "viewer@arm"
    assert await there.error(there.by_secret("operator")) == "invalid_scope"


@pytest_twisted.ensureDeferred
async def test_what_can_not_be_granted(there: World) -> None:
    """Each in the words of the standard."""
    await there.fill()
    desk = there.desk
    for ask, error in (
        (TokenRequest("password"), "invalid_request"),
        (TokenRequest("refresh_token"), "invalid_request"),
        (TokenRequest("authorization_code"), "unsupported_grant_type"),
    ):
        assert await there.error(desk.token(ask, None, HERE)) == error
    with pytest.raises(BadCredentials, match="prove the program"):
        await desk.token(TokenRequest("client_credentials"), None, HERE)


@pytest_twisted.ensureDeferred
async def test_a_program_that_was_removed_meanwhile_gets_none(there: World) -> None:
    """Between its proof and its token."""
    await there.fill()
    program = await there.desk.program("", "POST", "/", HERE, (KEY, SECRET))
    assert program is not None
    await there.store.write(queries.remove_program, program.id)
    with pytest.raises(BadCredentials):
        await there.desk.token(TokenRequest("client_credentials"), program, HERE)


def basic(key: str, secret: str) -> str:
    """A header."""
    return "Basic " + base64.b64encode(f"{key}:{secret}".encode()).decode()


@pytest_twisted.ensureDeferred
async def test_who_guesses_at_a_secret_is_soon_refused(there: World) -> None:
    """Before it is even looked at; a challenge that was too old is no guess."""
    await there.fill()
    prove = there.desk.program
    assert await prove("", "POST", "/", HERE) is None
    assert (await prove(basic(KEY, SECRET), "POST", "/", HERE)) is not None
    for header in ("Basic", "Basic !", basic(KEY, "wrong"), basic("swp_2", SECRET)):
        with pytest.raises(BadCredentials):
            await prove(header, "POST", "/", HERE)
    for _ in range(FAILURES - 1):
        with pytest.raises(BadCredentials):
            await prove(basic(KEY, "wrong"), "POST", "/", HERE)
    with pytest.raises(TooManyTries):
        await prove(basic(KEY, SECRET), "POST", "/", HERE)
    assert (await prove(basic(KEY, SECRET), "POST", "/", "198.51.100.7")) is not None


@pytest_twisted.ensureDeferred
async def test_a_wrong_secret_is_told_in_the_realm_of_the_program(there: World) -> None:
    """In none where nobody has such a program."""
    await there.store.write(queries.add_realm, "lab")
    await there.fill()
    cleo = await there.store.write(queries.add_user, "cleo", None, realm="lab")
    known = passwords.verifier("swp_lab", SECRET)
    await there.store.write(
        queries.add_program, cleo.id, "swp_lab", known, scope=None, label="", now=there.now
    )
    for key in (KEY, "swp_lab", "swp_2"):
        with pytest.raises(BadCredentials):
            await there.desk.program(basic(key, "wrong"), "POST", "/", HERE)
    told = [(data["program"], data["realm"]) for kind, data in there.told if kind == "login.refused"]
    assert told == [(KEY, "default"), ("swp_lab", "lab"), ("swp_2", None)]


@pytest_twisted.ensureDeferred
async def test_a_database_that_does_not_answer_is_no_guess(
    there: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nobody is locked out for its sake."""
    await there.fill()

    async def gone(*_: object) -> None:
        raise Unavailable("gone")

    with monkeypatch.context() as patched:
        patched.setattr(there.store, "read", gone)
        for _ in range(FAILURES + 1):
            with pytest.raises(Unavailable):
                await there.desk.program(basic(KEY, SECRET), "POST", "/", HERE)
    assert await there.desk.program(basic(KEY, SECRET), "POST", "/", HERE) is not None


@pytest_twisted.ensureDeferred
async def test_what_is_left_of_a_token(there: World) -> None:
    """Whose it is, what for, and how many seconds."""
    await there.fill("viewer")
    told = await there.by_secret()
    there.now += 100
    assert await there.desk.introspect(told["access_token"], "default") == {
        "active": True,
        "token_type": "Bearer",
        "username": "ann",
        "sub": "ann@default",
        "realm": "default",
        "iat": 1000,
        "scope": "viewer",
        "client_id": KEY,
        "exp": 4600,
        "expires_in": 3500,
    }
    refresh = (await there.by_password())["refresh_token"]
    assert (await there.desk.introspect(refresh, "default"))["token_type"] == "refresh_token"


@pytest_twisted.ensureDeferred
async def test_what_is_none_is_not_active_and_no_more_is_said(there: World) -> None:
    """An unknown one, an expired one, and that of another realm are the same."""
    await there.fill()
    told = await there.by_secret()
    inactive = {"active": False}
    assert await there.desk.introspect("swb_unknown", "default") == inactive
    assert await there.desk.introspect(told["access_token"], "lab2") == inactive
    there.now += ACCESS_SECONDS
    assert await there.desk.introspect(told["access_token"], "default") == inactive


@pytest_twisted.ensureDeferred
async def test_a_revoked_token_is_over(there: World) -> None:
    """What was opened with it is told at once; revoking nothing is no error."""
    await there.fill()
    robot = await there.store.write(queries.add_robot, "rover")
    ann = await there.store.read(queries.find_user, "ann")
    assert ann is not None
    await there.store.write(queries.grant_right, robot.id, "viewer", user_id=ann.id)
    told = await there.by_password()
    permit = await there.access.permit(await there.auth.token(told["access_token"]), robot)
    assert permit is not None
    ended: list[str] = []
    permit.on_revoke = lambda error: ended.append(error.code)
    await there.desk.revoke("swb_unknown", "default")
    await there.desk.revoke(told["refresh_token"], "lab2")
    assert ended == []
    await there.desk.revoke(told["refresh_token"], "default")
    assert ended == ["bad_credentials"]


@pytest_twisted.ensureDeferred
async def test_a_program_ends_the_token_it_got_in_another_realm(there: World) -> None:
    """It proves itself by its key: neither who asks in its realm otherwise, nor another program, can."""
    await there.fill()
    await there.joins("lab2")
    token = (await there.by_secret(realm="lab2"))["access_token"]
    assert (await there.auth.token(token)).full == "ann@lab2"
    assert not (await there.desk.introspect(token, "default"))["active"]
    assert not (await there.desk.introspect(token, "default", "swp_2"))["active"]
    assert (await there.desk.introspect(token, "default", KEY))["sub"] == "ann@lab2"
    for program in (None, "swp_2"):
        await there.desk.revoke(token, "default", program)
        assert (await there.auth.token(token)).full == "ann@lab2"
    await there.desk.revoke(token, "default", KEY)
    with pytest.raises(BadCredentials):
        await there.auth.token(token)


@pytest.mark.parametrize(
    ("scope", "asked", "error"),
    [
        ("operator@mobile", None, "invalid_scope"),
        ("operator@mobile viewer", "viewer", ""),
        ("viewer admin", None, "invalid_scope"),
        ("viewer call:/reset", None, ""),
        (None, "viewer@*", ""),
        (None, "viewer@rover", "invalid_scope"),
    ],
)
@pytest_twisted.ensureDeferred
async def test_a_scope_that_names_robots_is_for_those_of_ones_own_realm(
    there: World, scope: str | None, asked: str | None, error: str
) -> None:
    """In another one other robots have these names; nor does anybody administer there by it."""
    await there.fill(scope)
    await there.joins("lab2")
    for own in (None, "Default"):
        assert (await there.by_secret(asked, own))["access_token"]
    if error:
        assert await there.error(there.by_secret(asked, "lab2")) == error
    else:
        assert (await there.by_secret(asked, "lab2"))["access_token"]


@pytest_twisted.ensureDeferred
async def test_a_realm_that_the_user_is_not_of_is_like_one_that_there_is_not(there: World) -> None:
    """The program is told the same."""
    await there.fill()
    await there.store.write(queries.add_realm, "lab2")
    assert [await there.error(there.by_secret(realm=each)) for each in ("lab2", "lab3", "")] == [
        "invalid_target"
    ] * 3
