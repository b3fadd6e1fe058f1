"""Authentication by passwords, tokens, login links and tickets."""

from __future__ import annotations

from collections.abc import AsyncIterator, Iterator
from typing import Any

import pytest
import pytest_twisted
from sqlalchemy import func, select
from sqlalchemy.orm import Session
from twisted.internet import reactor
from twisted.internet.defer import Deferred

from relay_db import queries
from relay_db.models import LoginFailure
from relay_db.queries import UserRecord
from relay_protocol.errors import Unavailable
from relay_protocol.limits import TICKET_SECONDS
from relay_server.access import BadCredentials, Principal
from relay_server.auth import authenticator as module
from relay_server.auth import login_limiter, passwords
from relay_server.auth.account_limit import ACCOUNT_WINDOW, FAILURES_OF_ACCOUNT
from relay_server.auth.authenticator import Authenticator, TicketPurpose, TooManyTries
from relay_server.common.database import AsyncDatabase
from tests.worlds.relay import Time

PASSWORD = "correct horse"
HASHED = passwords.hash_password(PASSWORD)
HERE = "192.0.2.1"
ROVER = TicketPurpose("rover")


@pytest.fixture
def auth(store: AsyncDatabase, time: Time) -> Iterator[Authenticator]:
    """An authenticator on the reactor of the tests."""
    running = Authenticator(reactor, store, time, time)  # type: ignore[arg-type]
    running.start()
    yield running
    running.stop()


@pytest_twisted.async_yield_fixture
async def ann(store: AsyncDatabase) -> AsyncIterator[UserRecord]:
    """A user with a password."""
    yield await store.write(queries.add_user, "ann", HASHED)


@pytest.fixture
def quick_hash(monkeypatch: pytest.MonkeyPatch) -> None:
    """Passwords are compared without hashing."""
    monkeypatch.setattr(
        passwords, "verify_password", lambda password, stored: stored == HASHED and password == PASSWORD
    )


async def words(work: Any) -> str:
    """The message of a refused login."""
    with pytest.raises(BadCredentials) as reported:
        await work
    return str(reported.value)


async def token(
    store: AsyncDatabase, user: UserRecord, kind: Any = "access", expires: float | None = 5000.0
) -> str:
    """A fresh token of a user."""
    fresh = passwords.new_token()
    await store.write(
        queries.create_token, user.id, passwords.token_hash(fresh), kind=kind, expires=expires, now=1000.0
    )
    return fresh


@pytest_twisted.ensureDeferred
async def test_the_right_password_names_its_user(auth: Authenticator, ann: UserRecord) -> None:
    """Each spelling of the name works."""
    principal = await auth.password("Ann", PASSWORD, HERE)
    assert (principal.user_id, principal.name, principal.admin) == (ann.id, "ann", False)


@pytest_twisted.ensureDeferred
async def test_blanks_around_a_name_do_not_count(
    auth: Authenticator, ann: UserRecord, quick_hash: None
) -> None:
    """Neither for the user nor for the limit."""
    for name in (" ann", "ann ", "\tann@default\u00a0\n"):
        assert (await auth.password(name, PASSWORD, HERE)).user_id == ann.id
    for _ in range(login_limiter.FAILURES):
        await words(auth.password("ann ", "wrong", HERE))
    with pytest.raises(TooManyTries):
        await auth.password("ann", PASSWORD, HERE)


@pytest_twisted.ensureDeferred
async def test_names_that_no_account_can_have_share_no_limit_over_all_networks(
    auth: Authenticator, ann: UserRecord, quick_hash: None
) -> None:
    for number in range(FAILURES_OF_ACCOUNT):
        await words(auth.password("a b", "wrong", f"198.51.100.{number}"))
    with pytest.raises(TooManyTries):
        await auth.password("a b", "wrong", HERE)
    await words(auth.password("c d", "wrong", HERE))


@pytest_twisted.ensureDeferred
async def test_every_wrong_login_gets_the_same_answer(
    auth: Authenticator, store: AsyncDatabase, ann: UserRecord
) -> None:
    """Unknown user, wrong password, no password and disabled account are not distinguished."""
    await store.write(queries.add_user, "linkonly", None)
    off = await store.write(queries.add_user, "off", HASHED)
    await store.write(queries.set_disabled, off.id, True)
    reported = {
        await words(auth.password(user, password, HERE))
        for user, password in (
            ("ann", "wrong password"),
            ("nobody", PASSWORD),
            ("linkonly", PASSWORD),
            ("off", PASSWORD),
            ("not a name\x00", PASSWORD),
            ("\ud800", "\ud800"),
        )
    }
    assert reported == {"user or password is wrong"}


@pytest_twisted.ensureDeferred
async def test_the_limit_is_judged_before_anything_is_hashed(
    auth: Authenticator, ann: UserRecord, time: Time, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Over the limit even the right password is not checked; later, or from another network, it is."""
    hashed: list[str] = []

    def verify(password: str, stored: str | None) -> bool:
        hashed.append(password)
        return password == PASSWORD

    monkeypatch.setattr(passwords, "verify_password", verify)
    for _ in range(login_limiter.FAILURES):
        await words(auth.password("ann", "wrong", HERE))
    with pytest.raises(TooManyTries) as reported:
        await auth.password("ann", PASSWORD, HERE)
    assert reported.value.retry_after == login_limiter.WINDOW
    assert len(hashed) == login_limiter.FAILURES
    await auth.password("ann", PASSWORD, "198.51.100.1")
    time.now += login_limiter.WINDOW
    await auth.password("ann", PASSWORD, HERE)


@pytest_twisted.ensureDeferred
async def test_tries_at_the_same_time_count_too(
    auth: Authenticator, ann: UserRecord, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each try counts when it begins, so a burst cannot pass the limit."""
    monkeypatch.setattr(passwords, "verify_password", lambda password, stored: False)
    burst = [
        Deferred.fromCoroutine(auth.password("ann", "wrong", HERE)) for _ in range(login_limiter.FAILURES + 5)
    ]
    refused = []
    for each in burst:
        with pytest.raises((BadCredentials, TooManyTries)) as reported:
            await each
        refused.append(reported.type)
    assert refused.count(TooManyTries) == 5


@pytest_twisted.ensureDeferred
async def test_a_login_that_could_not_be_judged_counts_nothing(
    auth: Authenticator, ann: UserRecord, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A database that is away for a while locks out no user."""

    async def away(*args: Any) -> Any:
        raise Unavailable("the database does not answer")

    with monkeypatch.context() as patch:
        patch.setattr(auth._store, "read", away)
        for _ in range(login_limiter.FAILURES * 2):
            with pytest.raises(Unavailable):
                await auth.password("ann", PASSWORD, HERE)
    assert (await auth.password("ann", PASSWORD, HERE)).name == "ann"


async def guess(auth: Authenticator, account: str, tries: int = FAILURES_OF_ACCOUNT) -> None:
    """Wrong passwords for an account, each from a network of its own."""
    for number in range(tries):
        await words(auth.password(account, "wrong", f"203.0.113.{number}"))


async def limited(auth: Authenticator, account: str, address: str) -> float:
    """Seconds that an account has to wait at a network."""
    with pytest.raises(TooManyTries) as reported:
        await auth.password(account, PASSWORD, address)
    return reported.value.retry_after


@pytest.mark.parametrize("account", ["ann", "nobody"])
@pytest_twisted.ensureDeferred
async def test_an_account_has_a_limit_over_all_networks(
    auth: Authenticator, store: AsyncDatabase, ann: UserRecord, time: Time, account: str, quick_hash: None
) -> None:
    """All relays and later runs of one count together. Tries over the limit prolong nothing; others go on."""
    await store.write(queries.add_user, "bob", HASHED)
    other = Authenticator(reactor, store, time, time)  # type: ignore[arg-type]
    other.start()
    try:
        await guess(other, account, FAILURES_OF_ACCOUNT - 1)
        await words(auth.password(account.upper(), "wrong", "198.51.100.1"))
        for each in (auth, other):
            for _ in range(login_limiter.FAILURES + 1):
                assert await limited(each, account, HERE) == ACCOUNT_WINDOW
        assert (await auth.password("bob", PASSWORD, HERE)).name == "bob"
        time.now += ACCOUNT_WINDOW
        await words(other.password(account, "wrong", HERE))
    finally:
        other.stop()


@pytest.mark.parametrize("how", ["password", "link"])
@pytest_twisted.ensureDeferred
async def test_a_network_that_has_logged_in_is_not_locked_by_others(
    auth: Authenticator, store: AsyncDatabase, ann: UserRecord, time: Time, how: str, quick_hash: None
) -> None:
    """Failures there count for that network only; a success there unlocks no other."""
    if how == "password":
        await auth.password("ann", PASSWORD, HERE)
    else:
        await auth.open_session(await auth.login_code(await token(store, ann, "login"), HERE), HERE, how)
    await guess(auth, "ann")
    for _ in range(login_limiter.FAILURES):
        await words(auth.password("ann", "wrong", HERE))
    assert await limited(auth, "ann", HERE) == login_limiter.WINDOW
    time.now += login_limiter.WINDOW
    assert (await auth.password("ann", PASSWORD, HERE)).name == "ann"
    assert await limited(auth, "ann", "198.51.100.1") == ACCOUNT_WINDOW - login_limiter.WINDOW


@pytest_twisted.ensureDeferred
async def test_passwords_that_were_right_or_not_tried_do_not_count_for_the_account(
    auth: Authenticator, store: AsyncDatabase, ann: UserRecord, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Too many logins at once lock no user out."""

    async def busy(*args: Any) -> Any:
        raise Unavailable("too many users are logging in now; try again")

    with monkeypatch.context() as patch:
        patch.setattr(auth._hashing, "run", busy)
        with pytest.raises(Unavailable):
            await auth.password("ann", PASSWORD, HERE)
    await auth.password("ann", PASSWORD, HERE)
    assert await store.read(_all_failures) == 0


def _all_failures(s: Session) -> int:
    return s.scalar(select(func.count()).select_from(LoginFailure)) or 0


@pytest_twisted.ensureDeferred
async def test_tokens_prove_their_user_until_they_end(
    auth: Authenticator, store: AsyncDatabase, ann: UserRecord, time: Time
) -> None:
    """Access tokens and portal sessions work; login codes and unknown, revoked or expired tokens do not."""
    access, login = await token(store, ann), await token(store, ann, "login")
    principal = await auth.token(access)
    assert (principal.name, principal.expires) == ("ann", 5000.0)
    session = await auth.open_session(await auth.password("ann", PASSWORD, HERE), HERE, "password")
    assert (await auth.token(session)).name == "ann"
    reported = {await words(auth.token(each)) for each in (login, "unknown", "", "\ud800", "x" * 100_000)}
    await store.write(queries.revoke_token, principal.token_id)
    reported.add(await words(auth.token(access)))
    time.now += module.SESSION_SECONDS
    reported.add(await words(auth.token(session)))
    assert reported == {"the access token is unknown, expired or revoked"}


@pytest.mark.parametrize("how", ["password", "link"])
@pytest_twisted.ensureDeferred
async def test_a_login_does_not_outrun_a_changed_password(
    auth: Authenticator, store: AsyncDatabase, ann: UserRecord, how: str
) -> None:
    """A password that changes while it is checked opens no session, and no login is audited."""
    code = await token(store, ann, "login")
    login = await (auth.password("ann", PASSWORD, HERE) if how == "password" else auth.login_code(code, HERE))
    await auth.open_session(login, HERE, how)
    await store.write(queries.set_password, ann.id, passwords.hash_password("another one"))
    assert "log in again" in await words(auth.open_session(login, HERE, how))
    assert not await store.read(queries.list_tokens, ann.id)
    assert [entry.action for entry in await store.read(queries.list_audit)] == ["login"]


@pytest_twisted.ensureDeferred
async def test_a_login_that_can_not_be_put_on_record_opens_no_session(
    auth: Authenticator, store: AsyncDatabase, ann: UserRecord, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each open session has its login in the audit log."""
    login = await auth.password("ann", PASSWORD, HERE)

    def full(*_: Any, **__: Any) -> None:
        raise Unavailable("the disk is full")

    monkeypatch.setattr(queries, "append_audit", full)
    with pytest.raises(Unavailable):
        await auth.open_session(login, HERE, "password")
    assert not await store.read(queries.list_tokens, ann.id)


@pytest_twisted.ensureDeferred
async def test_a_login_link_is_good_once(auth: Authenticator, store: AsyncDatabase, ann: UserRecord) -> None:
    """Used, expired and unknown links get the same error. An access token is not a login link."""
    code = await token(store, ann, "login")
    old = await token(store, ann, "login", expires=1000.0)
    access = await token(store, ann)
    assert (await auth.login_code(code, HERE)).name == "ann"
    reported = {await words(auth.login_code(each, HERE)) for each in (code, old, access, "unknown")}
    assert reported == {"the login link is unknown, expired or already used; ask for a new one"}


@pytest_twisted.ensureDeferred
async def test_guessing_login_links_is_limited(
    auth: Authenticator, store: AsyncDatabase, ann: UserRecord, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The limit is per network; a valid link from another network works."""
    monkeypatch.setattr(login_limiter, "FAILURES_OF_NETWORK", 3)
    code = await token(store, ann, "login")
    for _ in range(3):
        await words(auth.login_code("guess", HERE))
    with pytest.raises(TooManyTries):
        await auth.login_code(code, HERE)
    assert (await auth.login_code(code, "198.51.100.1")).name == "ann"


# --- tickets ----------------------------------------------------------------------------------------------


@pytest_twisted.ensureDeferred
async def test_a_ticket_is_good_once_for_one_robot_and_a_minute(
    auth: Authenticator, store: AsyncDatabase, ann: UserRecord, time: Time
) -> None:
    """Every other use gets the same error and spends the ticket; checking it does not spend it."""
    principal = await auth.token(await token(store, ann))
    good, other, late = (auth.issue_ticket(principal, ROVER) for _ in range(3))
    assert (await auth.ticket(good, ROVER, spend=False)) == principal
    assert (await auth.ticket(good, ROVER)) == principal
    reported = {await words(auth.ticket(good, ROVER)), await words(auth.ticket("unknown", ROVER))}
    reported.add(await words(auth.ticket(other, TicketPurpose("tank"))))
    reported.add(await words(auth.ticket(other, ROVER)))
    time.now += TICKET_SECONDS
    reported.add(await words(auth.ticket(late, ROVER)))
    assert reported == {"the ticket is unknown, used, expired or for something else; ask for a new one"}


@pytest.mark.parametrize(
    ("opens", "asked", "good"),
    [
        (ROVER, TicketPurpose("rover", video=True, camera="/eye"), False),
        (TicketPurpose("rover", video=True), ROVER, False),
        (TicketPurpose("rover", video=True), TicketPurpose("rover", video=True), True),
        (TicketPurpose("rover", video=True), TicketPurpose("rover", video=True, camera="/eye"), True),
        (
            TicketPurpose("rover", video=True, camera="/eye"),
            TicketPurpose("rover", video=True, camera="/eye"),
            True,
        ),
        (
            TicketPurpose("rover", video=True, camera="/eye"),
            TicketPurpose("rover", video=True, camera="/eyes"),
            False,
        ),
        (TicketPurpose("rover", video=True, camera="/eye"), TicketPurpose("rover", video=True), False),
        (
            TicketPurpose("rover", video=True, camera="/eye"),
            TicketPurpose("tank", video=True, camera="/eye"),
            False,
        ),
    ],
)
def test_a_ticket_opens_what_it_is_for(opens: TicketPurpose, asked: TicketPurpose, good: bool) -> None:
    """A ticket for a picture does not allow driving, and a ticket for one camera shows no other camera."""
    assert opens.covers(asked) is good


@pytest_twisted.ensureDeferred
async def test_a_ticket_dies_with_the_session_that_asked_for_it(
    auth: Authenticator, store: AsyncDatabase, ann: UserRecord
) -> None:
    """Logging out makes the ticket invalid."""
    principal = await auth.token(await token(store, ann))
    ticket = auth.issue_ticket(principal, ROVER)
    await store.write(queries.revoke_token, principal.token_id)
    assert "has ended" in await words(auth.ticket(ticket, ROVER))


def test_tickets_are_bounded_also_for_each_user(
    auth: Authenticator, time: Time, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A user's oldest ticket is dropped for their newest one, or for other users' when the store is full.
    Expired tickets are removed.
    """
    monkeypatch.setattr(module, "TICKETS", 150)
    greedy = Principal(1, "greedy", "main", False, 1, None)
    others = [Principal(number, "x", "main", False, number, None) for number in range(2, 60)]
    for _ in range(1000):
        auth.issue_ticket(greedy, ROVER)
    assert len(auth._tickets) == module.TICKETS_OF_ONE
    held = list(auth._tickets)
    for other in others:
        auth.issue_ticket(other, ROVER)
    assert len(auth._tickets) == 150
    users = [each.principal.user_id for each in auth._tickets.values()]
    assert sorted(users) == [1] * 92 + list(range(2, 60))
    assert list(auth._tickets)[:92] == held[8:]
    time.now += TICKET_SECONDS
    auth.issue_ticket(others[0], ROVER)
    assert len(auth._tickets) == 1
