"""Tokens of the OAuth service, with a real database."""

from __future__ import annotations

import base64
from collections.abc import Iterator
from typing import Any

import httpx
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
from relay_server.oauth.digest import WrongAddress
from relay_server.oauth.service import ACCESS_SECONDS, REFRESH_SECONDS, OAuthError, OAuthService, TokenRequest

HERE = "192.0.2.1"
PASSWORD = "correct horse"
KEY, SECRET = "swc_1", "swb_secret"


class World:
    """The service, ann with a password, and her OAuth client."""

    def __init__(self, store: AsyncDatabase) -> None:
        self.now = 1000.0
        self.store = store
        self.auth = Authenticator(reactor, store, lambda: self.now, lambda: self.now)  # type: ignore[arg-type]
        self.access = Access(store, lambda: self.now)
        bus = EventBus()
        self.reported: list[tuple[str, dict[str, Any]]] = []
        bus.subscribe(lambda event: self.reported.append((event.kind, event.data)))
        self.service = OAuthService(store, self.auth, self.access, bus, lambda: self.now, lambda: self.now)

    async def fill(self, scope: str | None = None) -> None:
        """Adds ann and her OAuth client."""
        ann = await self.store.write(queries.add_user, "ann", passwords.hash_password(PASSWORD))
        known = passwords.digest_ha1(KEY, SECRET)
        await self.store.write(
            queries.add_oauth_client, ann.id, KEY, known, scope=scope, label="", now=self.now
        )

    async def by_password(self, scope: str | None = None, password: str = PASSWORD) -> dict[str, Any]:
        """The answer to ann's password."""
        ask = TokenRequest("password", username="ann", password=password, scope=scope)
        return (await self.service.token(ask, None, HERE)).as_json()

    async def by_secret(self, scope: str | None = None, realm: str | None = None) -> dict[str, Any]:
        """The answer to her OAuth client's secret."""
        oauth_client = await self.service.authenticate_client("", "POST", "/", HERE, (KEY, SECRET))
        ask = TokenRequest("client_credentials", scope=scope, realm=realm)
        return (await self.service.token(ask, oauth_client, HERE)).as_json()

    async def joins(self, realm: str) -> None:
        """Ann gets an account in another realm."""
        with self.store.database.begin() as s:
            ann = queries.find_user(s, "ann")
            assert ann is not None
            queries.add_realm(s, realm)
            queries.add_linked_account(s, ann.id, realm)

    async def refreshed(self, token: str, scope: str | None = None) -> dict[str, Any]:
        """The answer to a refresh token."""
        ask = TokenRequest("refresh_token", refresh_token=token, scope=scope)
        return (await self.service.token(ask, None, HERE)).as_json()

    async def error(self, asking: Any) -> str:
        """The error of a failed request."""
        with pytest.raises(OAuthError) as caught:
            await asking
        return caught.value.error


@pytest.fixture
def there(store: AsyncDatabase) -> Iterator[World]:
    world = World(store)
    world.auth.start()
    yield world
    world.auth.stop()


@pytest_twisted.ensureDeferred
async def test_a_password_gives_a_token_and_one_to_go_on_with(there: World) -> None:
    """The access token acts as the user; it is audited."""
    await there.fill()
    reported = await there.by_password()
    assert reported["token_type"] == "Bearer" and reported["expires_in"] == ACCESS_SECONDS
    assert "scope" not in reported
    principal = await there.auth.token(reported["access_token"])
    assert (principal.name, principal.scope) == ("ann", None)
    [entry] = await there.store.read(queries.list_audit, limit=9)
    assert (entry.action, entry.actor, entry.data["how"]) == ("token.issue", "user:ann", "password")
    there.now += ACCESS_SECONDS
    with pytest.raises(BadCredentials):
        await there.auth.token(reported["access_token"])


@pytest_twisted.ensureDeferred
async def test_a_wrong_password_gives_none(there: World) -> None:
    """It makes an event; too many are refused before anything is hashed."""
    await there.fill()
    assert await there.error(there.by_password(password="wrong")) == "invalid_grant"
    said = {"user": "ann", "realm": "default", "address": HERE, "reason": "bad_credentials"}
    assert there.reported[-1] == ("login.refused", said)
    ask = TokenRequest("password", username=f"{'x' * 100}@LAB1", password="wrong")
    assert await there.error(there.service.token(ask, None, HERE)) == "invalid_grant"
    assert there.reported[-1] == ("login.refused", {**said, "user": f"{'x' * 100}@LAB1", "realm": "lab1"})
    for _ in range(FAILURES - 1):
        await there.error(there.by_password(password="wrong"))
    with pytest.raises(TooManyTries):
        await there.by_password()


@pytest_twisted.ensureDeferred
async def test_a_scope_is_given_as_it_was_asked_for(there: World) -> None:
    await there.fill()
    reported = await there.by_password("viewer operator@rover")
    assert reported["scope"] == "viewer operator@rover"
    assert str((await there.auth.token(reported["access_token"])).scope) == "viewer operator@rover"
    assert await there.error(there.by_password("king")) == "invalid_scope"


@pytest_twisted.ensureDeferred
async def test_a_refresh_token_is_used_once(there: World) -> None:
    """Each returns the next; a repeated one revokes all of them."""
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
    """Never for more; a refusal does not spend the token."""
    await there.fill()
    first = await there.by_password("operator")
    for scope in ("owner", "admin", "king"):
        assert await there.error(there.refreshed(first["refresh_token"], scope)) == "invalid_scope"
    second = await there.refreshed(first["refresh_token"], "viewer@rover")
    assert second["scope"] == "viewer@rover"
    assert (await there.refreshed(second["refresh_token"]))["scope"] == "operator"


@pytest_twisted.ensureDeferred
async def test_a_refresh_token_ends_by_itself(there: World) -> None:
    await there.fill()
    first = await there.by_password()
    there.now += REFRESH_SECONDS
    assert await there.error(there.refreshed(first["refresh_token"])) == "invalid_grant"


@pytest_twisted.ensureDeferred
async def test_an_oauth_client_gets_what_its_scope_allows(there: World) -> None:
    """All of it, or less. It gets no refresh token, since it has its secret."""
    await there.fill("operator@rover viewer")
    reported = await there.by_secret()
    assert reported["scope"] == "operator@rover viewer" and "refresh_token" not in reported
    assert (await there.by_secret("viewer@arm"))["scope"] == "viewer@arm"
    assert await there.error(there.by_secret("operator")) == "invalid_scope"


@pytest_twisted.ensureDeferred
async def test_invalid_grants_are_refused(there: World) -> None:
    """Each with the error code of the standard."""
    await there.fill()
    service = there.service
    for ask, error in (
        (TokenRequest("password"), "invalid_request"),
        (TokenRequest("refresh_token"), "invalid_request"),
        (TokenRequest("authorization_code"), "unsupported_grant_type"),
    ):
        assert await there.error(service.token(ask, None, HERE)) == error
    with pytest.raises(BadCredentials, match="key and secret: by Digest"):
        await service.token(TokenRequest("client_credentials"), None, HERE)


@pytest_twisted.ensureDeferred
async def test_an_oauth_client_that_was_removed_meanwhile_gets_none(there: World) -> None:
    """It was removed between its authentication and its token."""
    await there.fill()
    oauth_client = await there.service.authenticate_client("", "POST", "/", HERE, (KEY, SECRET))
    assert oauth_client is not None
    await there.store.write(queries.remove_oauth_client, oauth_client.id)
    with pytest.raises(BadCredentials):
        await there.service.token(TokenRequest("client_credentials"), oauth_client, HERE)


def basic(key: str, secret: str) -> str:
    """A header."""
    return "Basic " + base64.b64encode(f"{key}:{secret}".encode()).decode()


@pytest_twisted.ensureDeferred
async def test_guessing_a_secret_is_limited(there: World) -> None:
    """Before the secret is checked; an expired challenge does not count as a guess."""
    await there.fill()
    prove = there.service.authenticate_client
    assert await prove("", "POST", "/", HERE) is None
    assert (await prove(basic(KEY, SECRET), "POST", "/", HERE)) is not None
    for header in ("Basic", "Basic !", basic(KEY, "wrong"), basic("swc_2", SECRET)):
        with pytest.raises(BadCredentials):
            await prove(header, "POST", "/", HERE)
    for _ in range(FAILURES - 1):
        with pytest.raises(BadCredentials):
            await prove(basic(KEY, "wrong"), "POST", "/", HERE)
    with pytest.raises(TooManyTries):
        await prove(basic(KEY, SECRET), "POST", "/", HERE)
    assert (await prove(basic(KEY, SECRET), "POST", "/", "198.51.100.7")) is not None


@pytest_twisted.ensureDeferred
async def test_a_right_answer_for_another_address_is_no_guess(there: World) -> None:
    """Such as that of a proxy which strips a part of the path."""
    await there.fill()
    request = httpx.Request("POST", "https://relay/robots/oauth/token")
    flow = httpx.DigestAuth(KEY, SECRET).auth_flow(request)
    next(flow)
    challenge = {"www-authenticate": there.service.digest.challenge()}
    header = flow.send(httpx.Response(401, headers=challenge, request=request)).headers["authorization"]
    for _ in range(FAILURES + 1):
        with pytest.raises(WrongAddress, match="/robots/oauth/token"):
            await there.service.authenticate_client(header, "POST", "/oauth/token", HERE)
    assert await there.service.authenticate_client(basic(KEY, SECRET), "POST", "/", HERE) is not None
    assert not [data for kind, data in there.reported if kind == "login.refused"]


@pytest_twisted.ensureDeferred
async def test_a_wrong_secret_is_an_event_in_the_realm_of_the_oauth_client(there: World) -> None:
    await there.store.write(queries.add_realm, "lab")
    await there.fill()
    cleo = await there.store.write(queries.add_user, "cleo", None, realm="lab")
    known = passwords.digest_ha1("swc_lab", SECRET)
    await there.store.write(
        queries.add_oauth_client, cleo.id, "swc_lab", known, scope=None, label="", now=there.now
    )
    for key in (KEY, "swc_lab", "swc_2"):
        with pytest.raises(BadCredentials):
            await there.service.authenticate_client(basic(key, "wrong"), "POST", "/", HERE)
    reported = [
        (data["client_id"], data["realm"]) for kind, data in there.reported if kind == "login.refused"
    ]
    assert reported == [(KEY, "default"), ("swc_lab", "lab"), ("swc_2", None)]


@pytest_twisted.ensureDeferred
async def test_a_database_that_does_not_answer_is_no_guess(
    there: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    await there.fill()

    async def gone(*_: object) -> None:
        raise Unavailable("gone")

    with monkeypatch.context() as patched:
        patched.setattr(there.store, "read", gone)
        for _ in range(FAILURES + 1):
            with pytest.raises(Unavailable):
                await there.service.authenticate_client(basic(KEY, SECRET), "POST", "/", HERE)
    assert await there.service.authenticate_client(basic(KEY, SECRET), "POST", "/", HERE) is not None


@pytest_twisted.ensureDeferred
async def test_introspection_of_a_token(there: World) -> None:
    """The answer has the user, the scope and the remaining seconds."""
    await there.fill("viewer")
    reported = await there.by_secret()
    there.now += 100
    assert await there.service.introspect(reported["access_token"], "default") == {
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
    assert (await there.service.introspect(refresh, "default"))["token_type"] == "refresh_token"


@pytest_twisted.ensureDeferred
async def test_an_unknown_token_is_only_inactive(there: World) -> None:
    """Unknown, expired and other realms' tokens are not distinguished."""
    await there.fill()
    reported = await there.by_secret()
    inactive = {"active": False}
    assert await there.service.introspect("swb_unknown", "default") == inactive
    assert await there.service.introspect(reported["access_token"], "lab2") == inactive
    there.now += ACCESS_SECONDS
    assert await there.service.introspect(reported["access_token"], "default") == inactive


@pytest_twisted.ensureDeferred
async def test_a_revoked_token_is_over(there: World) -> None:
    await there.fill()
    robot = await there.store.write(queries.add_robot, "rover")
    ann = await there.store.read(queries.find_user, "ann")
    assert ann is not None
    await there.store.write(queries.grant_right, robot.id, "viewer", user_id=ann.id)
    reported = await there.by_password()
    permit = await there.access.permit(await there.auth.token(reported["access_token"]), robot)
    assert permit is not None
    ended: list[str] = []
    permit.on_revoke = lambda error: ended.append(error.code)
    await there.service.revoke("swb_unknown", "default")
    await there.service.revoke(reported["refresh_token"], "lab2")
    assert ended == []
    await there.service.revoke(reported["refresh_token"], "default")
    assert ended == ["bad_credentials"]


@pytest_twisted.ensureDeferred
async def test_an_oauth_client_ends_the_token_it_got_in_another_realm(there: World) -> None:
    await there.fill()
    await there.joins("lab2")
    token = (await there.by_secret(realm="lab2"))["access_token"]
    assert (await there.auth.token(token)).full == "ann@lab2"
    assert not (await there.service.introspect(token, "default"))["active"]
    assert not (await there.service.introspect(token, "default", "swc_2"))["active"]
    assert (await there.service.introspect(token, "default", KEY))["sub"] == "ann@lab2"
    for client_id in (None, "swc_2"):
        await there.service.revoke(token, "default", client_id)
        assert (await there.auth.token(token)).full == "ann@lab2"
    await there.service.revoke(token, "default", KEY)
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
    """In another realm other robots have these names. Such a token does not administer there either."""
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
    await there.fill()
    await there.store.write(queries.add_realm, "lab2")
    assert [await there.error(there.by_secret(realm=each)) for each in ("lab2", "lab3", "")] == [
        "invalid_target"
    ] * 3
