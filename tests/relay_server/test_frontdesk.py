"""What edges ask for, put together, on a real database."""

from __future__ import annotations

import pytest
import pytest_twisted

from relay_db import queries
from relay_protocol import link
from relay_protocol.errors import NotFound, Refused, SwitchboardError
from relay_server.access import IN_STEP_SECONDS, NO_ROBOT, BadCredentials
from relay_server.auth import login_limiter
from relay_server.auth.authenticator import TicketPurpose, TooManyTries
from relay_server.common import close_codes
from relay_server.sessions.manager import LOOKUP_SECONDS, NOT_LOOKED_UP
from relay_server.video.frames import VideoFrameInfo
from tests.relay_server.front_desk import HERE, Desk
from tests.relay_server.memory import hangs
from tests.relay_server.steering import outcome, result

HOST = "127.0.0.1:9090"


@pytest_twisted.ensureDeferred
async def test_logging_in_and_out_are_on_record(front: Desk) -> None:
    """A login with how and from where; a refused one with its reason, without the password."""
    await front.logged_in()
    with pytest.raises(BadCredentials):
        await front.desk.password("ann", "hunter2hunter2", HERE)
    (refused,) = await front.events("login.refused")
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
async def test_a_refused_login_is_of_the_realm_that_the_whole_name_gives(front: Desk) -> None:
    """However that is written, and however long the name is; what can be no realm is none."""
    for user in ("toad@LAB1", f"{'x' * 63}@{'y' * 63}z", f"{'x' * 200}@lab1"):
        with pytest.raises(BadCredentials):
            await front.desk.password(user, "x", HERE)
    told = {each.data["user"]: each.data["realm"] for each in await front.events("login.refused")}
    assert told == {"toad@LAB1": "lab1", f"{'x' * 63}@{'y' * 63}": "", "x" * 127: "lab1"}


@pytest_twisted.ensureDeferred
async def test_a_flood_of_logins_does_not_reach_the_database(front: Desk) -> None:
    """What is over the limit was recorded while under it."""
    for _ in range(login_limiter.FAILURES):
        with pytest.raises(BadCredentials):
            await front.desk.password("nobody", "x", HERE)
    for _ in range(20):
        with pytest.raises(TooManyTries):
            await front.desk.password("nobody", "x", HERE)
    assert len(await front.events("login.refused")) == login_limiter.FAILURES


@pytest_twisted.ensureDeferred
async def test_logging_out_cuts_what_was_opened_with_that_session(front: Desk) -> None:
    """Other sessions of the same user go on."""
    (first, token), (second, _) = await front.logged_in(), await front.logged_in()
    _, cut = await front.opens(first)
    _, kept = await front.opens(second)
    await front.desk.logout(first)
    assert cut.closed == (close_codes.UNAUTHENTICATED, "your session was ended; log in again")
    assert kept.closed is None
    with pytest.raises(BadCredentials):
        await front.desk.token(token)


@pytest_twisted.ensureDeferred
async def test_a_robot_without_rights_is_like_no_robot(front: Desk) -> None:
    """For websockets and for tickets: one and the same answer."""
    principal, _ = await front.logged_in()
    for robot in ("hidden", "nothing", "", "x" * 10_000, "\x00"):
        for asking in (
            front.desk.admit(principal, robot, HERE),
            front.desk.issue_ticket(principal, TicketPurpose(robot)),
        ):
            with pytest.raises(NotFound) as told:
                await asking
            assert str(told.value) == NO_ROBOT
    assert not front.access._permits


@pytest_twisted.ensureDeferred
async def test_who_is_turned_away_leaves_nothing(front: Desk) -> None:
    """No permit is kept of somebody who left before the session began."""
    principal, _ = await front.logged_in()
    front.desk.turn_away(await front.desk.admit(principal, "rover", HERE))
    assert not front.access._permits
    assert not list(front.desk)


@pytest_twisted.ensureDeferred
async def test_open_sessions_are_counted_shown_and_recorded(front: Desk) -> None:
    """A robot somebody works with is in use; afterwards nothing is left of them."""
    principal, _ = await front.logged_in()
    changes: list[None] = []
    stop = front.desk.on_change(lambda: changes.append(None))
    session, _ = await front.opens(principal)
    other, _ = await front.opens(principal)
    (view,) = await front.desk.robots(principal)
    assert (view["name"], view["level"], view["description"]) == ("rover", "operator", "in the shed")
    assert [each["user"] for each in view["clients"]] == ["ann", "ann"]
    shown = next(each for each in front.desk.status() if each["name"] == "rover" and each["clients"])
    assert shown["clients"][0]["address"] == HERE
    session.end()
    other.end()
    assert len(changes) == 4
    stop()
    assert (await front.desk.robots(principal))[0]["clients"] == []
    assert not front.access._permits
    assert not list(front.desk)
    assert len(await front.events("client.joined")) == len(await front.events("client.left")) == 2


class Wall:
    """A screen nobody looks at."""

    def picture(self, picture: VideoFrameInfo) -> None:
        """None comes."""

    def playing(self, playing: link.Playing) -> None:
        """Nor this."""

    def ended(self, error: SwitchboardError) -> None:
        """Nor this."""


@pytest_twisted.ensureDeferred
async def test_who_watches_a_camera_is_at_the_robot(front: Desk) -> None:
    """It is in use, and users and the administrator see by whom; afterwards nothing is left of it."""
    front.world.robot = front.desk._registry.presence(front.rover.id, "rover", "default")
    front.world.robot_comes()
    principal, _ = await front.logged_in()
    changes: list[None] = []
    stop = front.desk.on_change(lambda: changes.append(None))
    watching = await front.desk.viewing(principal, "rover", "/eye", link.VideoSettings(), Wall(), HERE)
    (view,) = await front.desk.robots(principal)
    since = front.world.registry._wall()
    assert (view["state"], view["clients"]) == (
        "in_use",
        [{"user": "ann", "since": since, "camera": "/eye"}],
    )
    (shown,) = [each for each in front.desk.status() if each["state"] == "in_use"]
    assert shown["clients"] == []
    assert shown["onlookers"] == [{"user": "ann", "address": HERE, "since": since, "camera": "/eye"}]
    watching.leave()
    assert len(changes) == 2
    stop()
    (view,) = await front.desk.robots(principal)
    assert (view["state"], view["clients"]) == ("online", [])
    assert not front.access._permits


@pytest_twisted.ensureDeferred
async def test_going_down_tells_everyone_and_lets_nobody_in(front: Desk) -> None:
    """With the code that says: again in a moment."""
    principal, _ = await front.logged_in()
    ends = [await front.opens(principal) for _ in range(3)]
    front.desk.say_goodbye("the relay is going down")
    assert not front.desk.accepting
    assert {client.closed for _, client in ends} == {(close_codes.GOING_AWAY, "the relay is going down")}
    assert not list(front.desk)


@pytest_twisted.ensureDeferred
async def test_a_cookie_names_its_user_only_with_the_relays_own_origin(front: Desk) -> None:
    """Among other cookies; without one of ours a page of our own is told to log in again."""
    principal, token = await front.logged_in()
    header, own = f"other=1; sb={token}", f"http://{HOST}"
    assert await front.desk.cookie(header, own, HOST) == principal
    for origin in (None, "null", "http://evil.example"):
        with pytest.raises(Refused):
            await front.desk.cookie(header, origin, HOST)
    for header in ("", "other=1", "sbx=1", ";;;=", "sb"):
        assert await front.desk.cookie(header, None, HOST) is None
        assert await front.desk.cookie(header, "http://evil.example", HOST) is None
    with pytest.raises(BadCredentials, match="session has ended"):
        await front.desk.cookie("", own, HOST)
    with pytest.raises(BadCredentials):
        await front.desk.cookie("sb=forged", own, HOST)


@pytest_twisted.ensureDeferred
async def test_health_is_whether_the_database_answers(front: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    """One that nobody gets through to is not well, and is again afterwards."""
    assert await front.desk.healthy()
    with monkeypatch.context() as patch:
        patch.setattr(front.store._readers, "_most", 0)
        assert not await front.desk.healthy()
    assert await front.desk.healthy()


@pytest_twisted.ensureDeferred
async def test_who_was_proved_is_known_while_the_database_is_looked_at(
    front: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where the last look is too long ago it is asked again; tokens that nobody has shown it is asked about anyway."""
    principal, token = await front.logged_in()
    front.access.in_step(front.world.clock.seconds())
    monkeypatch.setattr(front.store, "read", hangs)
    assert result(front.desk.token(token)) == principal
    assert outcome(front.desk.token("unknown")) == []
    front.world.clock.advance(IN_STEP_SECONDS)
    assert result(front.desk.token(token)) == principal
    front.world.clock.advance(0.1)
    assert outcome(front.desk.token(token)) == []
    front.access.in_step(front.world.clock.seconds())
    assert result(front.desk.token(token)) == principal


@pytest_twisted.ensureDeferred
async def test_who_has_logged_out_is_known_no_more(front: Desk) -> None:
    """However lately the database was looked at."""
    principal, token = await front.logged_in()
    front.access.in_step(front.world.clock.seconds())
    await front.desk.logout(principal)
    with pytest.raises(BadCredentials):
        await front.desk.token(token)


@pytest_twisted.ensureDeferred
async def test_who_stops_robots_need_not_wait_for_the_database(
    front: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where his token has proved him before and has not ended since; else that is told soon."""
    principal, token = await front.logged_in()
    ended, other = await front.logged_in()
    await front.desk.logout(ended)
    monkeypatch.setattr(front.store, "read", hangs)
    assert result(front.desk.urgent_token(token)) == principal
    asked = [outcome(front.desk.urgent_token(each)) for each in (other, "unknown")]
    front.world.clock.advance(LOOKUP_SECONDS - 0.1)
    assert asked == [[], []]
    front.world.clock.advance(0.1)
    assert [str(error) for (error,) in asked] == [NOT_LOOKED_UP] * 2
