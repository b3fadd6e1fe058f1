"""The session manager, with a real database."""

from __future__ import annotations

import pytest
import pytest_twisted

from relay_db import queries
from relay_protocol import link
from relay_protocol.errors import NotFound, Refused, SwitchboardError
from relay_server.access import LOOKUP_SECONDS, NO_ROBOT, NOT_LOOKED_UP, RECENT_READ_SECONDS, BadCredentials
from relay_server.auth import login_limiter
from relay_server.auth.authenticator import TicketPurpose, TooManyTries
from relay_server.common import close_codes
from relay_server.video.frames import VideoFrameInfo
from tests.worlds.control import outcome, result
from tests.worlds.relay import hangs
from tests.worlds.session_manager import HERE, SessionsWorld

HOST = "127.0.0.1:9090"


@pytest_twisted.ensureDeferred
async def test_logging_in_and_out_are_on_record(front: SessionsWorld) -> None:
    """A login has its method and address; a refused one has its reason, without the password."""
    await front.logged_in()
    with pytest.raises(BadCredentials):
        await front.logins.password("ann", "hunter2hunter2", HERE)
    (refused,) = front.events("login.refused")
    assert refused.data == {
        "user": "ann",
        "realm": "default",
        "address": HERE,
        "reason": "bad_credentials",
    }
    entry = (await front.store.read(queries.list_audit))[-1]
    assert (entry.actor, entry.action, entry.origin, entry.data) == (
        "user:ann",
        "login",
        HERE,
        {"how": "password"},
    )


@pytest_twisted.ensureDeferred
async def test_a_refused_login_is_of_the_realm_that_the_whole_name_gives(front: SessionsWorld) -> None:
    """For any spelling and length of the name; an invalid realm counts as none."""
    for user in ("toad@LAB1", f"{'x' * 63}@{'y' * 63}z", f"{'x' * 200}@lab1"):
        with pytest.raises(BadCredentials):
            await front.logins.password(user, "x", HERE)
    reported = {each.data["user"]: each.data["realm"] for each in front.events("login.refused")}
    assert reported == {"toad@LAB1": "lab1", f"{'x' * 63}@{'y' * 63}": "", "x" * 127: "lab1"}


@pytest_twisted.ensureDeferred
async def test_a_flood_of_logins_does_not_reach_the_database(front: SessionsWorld) -> None:
    """Logins over the limit are not audited, unlike those under it."""
    for _ in range(login_limiter.FAILURES):
        with pytest.raises(BadCredentials):
            await front.logins.password("nobody", "x", HERE)
    for _ in range(20):
        with pytest.raises(TooManyTries):
            await front.logins.password("nobody", "x", HERE)
    assert len(front.events("login.refused")) == login_limiter.FAILURES


@pytest_twisted.ensureDeferred
async def test_logging_out_cuts_what_was_opened_with_that_session(front: SessionsWorld) -> None:
    """Other sessions of the same user continue."""
    (first, token), (second, _) = await front.logged_in(), await front.logged_in()
    _, cut = await front.opens(first)
    _, kept = await front.opens(second)
    await front.logins.logout(first)
    assert cut.closed == (close_codes.UNAUTHENTICATED, "your session was ended; log in again")
    assert kept.closed is None
    with pytest.raises(BadCredentials):
        await front.logins.token(token)


@pytest_twisted.ensureDeferred
async def test_a_robot_without_rights_is_like_no_robot(front: SessionsWorld) -> None:
    """Websockets and tickets get the same error."""
    principal, _ = await front.logged_in()
    for robot in ("hidden", "nothing", "", "x" * 10_000, "\x00"):
        for asking in (
            front.service.admit(principal, robot, HERE),
            front.logins.issue_ticket(principal, TicketPurpose(robot)),
        ):
            with pytest.raises(NotFound) as reported:
                await asking
            assert str(reported.value) == NO_ROBOT
    assert not front.access._permits


@pytest_twisted.ensureDeferred
async def test_refused_client_leaves_no_state(front: SessionsWorld) -> None:
    """No permit is left of a client that disconnected before its session began."""
    principal, _ = await front.logged_in()
    front.service.release(await front.service.admit(principal, "rover", HERE))
    assert not front.access._permits
    assert not list(front.service)


@pytest_twisted.ensureDeferred
async def test_open_sessions_are_counted_shown_and_recorded(front: SessionsWorld) -> None:
    """A robot with clients is in use; afterwards no state is left."""
    principal, _ = await front.logged_in()
    changes: list[None] = []
    stop = front.service.on_change(lambda: changes.append(None))
    session, _ = await front.opens(principal)
    other, _ = await front.opens(principal)
    (view,) = await front.service.robots(principal)
    assert (view["name"], view["level"], view["description"]) == ("rover", "operator", "in the shed")
    assert [each["user"] for each in view["clients"]] == ["ann", "ann"]
    shown = next(each for each in front.service.status() if each["name"] == "rover" and each["clients"])
    assert shown["clients"][0]["address"] == HERE
    session.end()
    other.end()
    assert len(changes) == 4
    stop()
    assert (await front.service.robots(principal))[0]["clients"] == []
    assert not front.access._permits
    assert not list(front.service)
    assert len(front.events("client.joined")) == len(front.events("client.left")) == 2


class Wall:
    """A sink that ignores frames."""

    def picture(self, picture: VideoFrameInfo) -> None:
        """Ignores it."""

    def playing(self, playing: link.StreamStatus) -> None:
        """Ignores it."""

    def ended(self, error: SwitchboardError) -> None:
        """Ignores it."""


@pytest_twisted.ensureDeferred
async def test_camera_viewer_is_a_user_of_the_robot(front: SessionsWorld) -> None:
    """The robot is in use, and users and the administrator see the viewer; afterwards no state is left."""
    front.world.robot = front.service._registry.robot(front.rover.id, "rover", "default")
    front.world.robot_comes()
    principal, _ = await front.logged_in()
    changes: list[None] = []
    stop = front.service.on_change(lambda: changes.append(None))
    watching = await front.service.view(principal, "rover", "/eye", link.VideoSettings(), Wall(), HERE)
    (view,) = await front.service.robots(principal)
    since = front.world.registry._wall()
    assert (view["state"], view["clients"]) == (
        "in_use",
        [{"user": "ann", "since": since, "camera": "/eye"}],
    )
    (shown,) = [each for each in front.service.status() if each["state"] == "in_use"]
    assert shown["clients"] == []
    assert shown["viewers"] == [{"user": "ann", "address": HERE, "since": since, "camera": "/eye"}]
    watching.leave()
    assert len(changes) == 2
    stop()
    (view,) = await front.service.robots(principal)
    assert (view["state"], view["clients"]) == ("online", [])
    assert not front.access._permits


@pytest_twisted.ensureDeferred
async def test_shutdown_notifies_all_sessions_and_admits_no_client(front: SessionsWorld) -> None:
    """With the close code for a retry."""
    principal, _ = await front.logged_in()
    ends = [await front.opens(principal) for _ in range(3)]
    front.service.shutdown("the relay is going down")
    assert not front.service.accepting
    assert {client.closed for _, client in ends} == {(close_codes.GOING_AWAY, "the relay is going down")}
    assert not list(front.service)


@pytest_twisted.ensureDeferred
async def test_a_cookie_names_its_user_only_with_the_relays_own_origin(front: SessionsWorld) -> None:
    """Other cookies are ignored. Without the relay's own cookie, its own page gets an error to log in again."""
    principal, token = await front.logged_in()
    header, own = f"other=1; sb={token}", f"http://{HOST}"
    assert await front.logins.cookie(header, own, HOST) == principal
    for origin in (None, "null", "http://evil.example"):
        with pytest.raises(Refused):
            await front.logins.cookie(header, origin, HOST)
    for header in ("", "other=1", "sbx=1", ";;;=", "sb"):
        assert await front.logins.cookie(header, None, HOST) is None
        assert await front.logins.cookie(header, "http://evil.example", HOST) is None
    with pytest.raises(BadCredentials, match="session has ended"):
        await front.logins.cookie("", own, HOST)
    with pytest.raises(BadCredentials):
        await front.logins.cookie("sb=forged", own, HOST)


@pytest_twisted.ensureDeferred
async def test_health_is_whether_the_database_answers(
    front: SessionsWorld, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A hanging database is unhealthy until it answers again."""
    assert await front.service.healthy()
    with monkeypatch.context() as patch:
        patch.setattr(front.store._readers, "_most", 0)
        assert not await front.service.healthy()
    assert await front.service.healthy()


@pytest_twisted.ensureDeferred
async def test_proved_token_is_known_while_the_database_is_read(
    front: SessionsWorld, monkeypatch: pytest.MonkeyPatch
) -> None:
    """If the last check is too long ago, the database is asked again, as for unknown tokens."""
    principal, token = await front.logged_in()
    front.access.set_known_until(front.world.clock.seconds())
    monkeypatch.setattr(front.store, "read", hangs)
    assert result(front.logins.token(token)) == principal
    assert outcome(front.logins.token("unknown")) == []
    front.world.clock.advance(RECENT_READ_SECONDS)
    assert result(front.logins.token(token)) == principal
    front.world.clock.advance(0.1)
    assert outcome(front.logins.token(token)) == []
    front.access.set_known_until(front.world.clock.seconds())
    assert result(front.logins.token(token)) == principal


@pytest_twisted.ensureDeferred
async def test_logged_out_token_is_unknown(front: SessionsWorld) -> None:
    """For any age of the last check."""
    principal, token = await front.logged_in()
    front.access.set_known_until(front.world.clock.seconds())
    await front.logins.logout(principal)
    with pytest.raises(BadCredentials):
        await front.logins.token(token)


@pytest_twisted.ensureDeferred
async def test_stops_do_not_wait_for_the_database(
    front: SessionsWorld, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The token must be known from before and not revoked since; otherwise the error comes soon."""
    principal, token = await front.logged_in()
    ended, other = await front.logged_in()
    await front.logins.logout(ended)
    monkeypatch.setattr(front.store, "read", hangs)
    assert result(front.logins.token_from_memory(token)) == principal
    asked = [outcome(front.logins.token_from_memory(each)) for each in (other, "unknown")]
    front.world.clock.advance(LOOKUP_SECONDS - 0.1)
    assert asked == [[], []]
    front.world.clock.advance(0.1)
    assert [str(error) for (error,) in asked] == [NOT_LOOKED_UP] * 2
