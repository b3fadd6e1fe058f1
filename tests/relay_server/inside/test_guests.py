"""Connections that are kept for those who come by HTTP, on a real database."""

from __future__ import annotations

import msgspec
import pytest
import pytest_twisted

from relay_protocol import rosbridge
from relay_protocol.errors import NotFound, Refused, Unavailable
from relay_protocol.rights import Operation
from relay_server.access import Principal
from relay_server.http_sessions import pool as module
from relay_server.http_sessions.loopback_client import MaybeDone
from relay_server.http_sessions.pool import LINGER_SECONDS, SessionPool
from relay_server.sessions.manager import ShuttingDown
from relay_server.sessions.publishing import PublishHandler
from tests.relay_server.front_desk import HERE, Desk
from tests.relay_server.memory import TRIGGER
from tests.relay_server.steering import outcome


@pytest.fixture
def guests(front: Desk) -> SessionPool:
    """Those who come to it by HTTP."""
    return SessionPool(front.world.clock, front.desk, front.world.now_ns)


def passes(front: Desk, seconds: float) -> None:
    """Time, in steps between which pings are answered."""
    front.world.clock.pump([0.5] * round(seconds / 0.5))


async def once(guests: SessionPool, principal: Principal) -> int:
    """One request; the number of its connection."""
    async with guests.at(principal, "rover", HERE) as guest:
        return guest.session.number


@pytest_twisted.ensureDeferred
async def test_a_connection_is_kept_from_one_request_to_the_next(front: Desk, guests: SessionPool) -> None:
    """And ends when none has come for so long, with all that was there for it."""
    ann, _ = await front.logged_in()
    first = await once(guests, ann)
    passes(front, LINGER_SECONDS - 1)
    assert await once(guests, ann) == first
    passes(front, LINGER_SECONDS - 1)
    assert [each.number for each in front.desk] == [first]
    passes(front, 1)
    assert not list(front.desk) and not front.access._permits
    assert await once(guests, ann) != first


@pytest_twisted.ensureDeferred
async def test_it_does_not_end_while_a_request_is_answered(front: Desk, guests: SessionPool) -> None:
    """However long that takes; two at a time share it."""
    ann, _ = await front.logged_in()
    async with guests.at(ann, "rover", HERE) as guest:
        first = await once(guests, ann)
        passes(front, 10 * LINGER_SECONDS)
        assert first == guest.session.number
        assert guest.client.closed is None
        assert len(list(front.desk)) == 1


@pytest_twisted.ensureDeferred
async def test_each_token_has_its_own(front: Desk, guests: SessionPool) -> None:
    """One may be for less than the other."""
    (one, _), (other, _) = await front.logged_in(), await front.logged_in()
    assert await once(guests, one) != await once(guests, other)


@pytest_twisted.ensureDeferred
async def test_one_that_was_closed_is_not_used_again(front: Desk, guests: SessionPool) -> None:
    """Whoever has a right again comes in anew."""
    ann, _ = await front.logged_in()
    async with guests.at(ann, "rover", HERE) as guest:
        guest.session.close(4403, "your right was revoked")
        with pytest.raises(Refused, match="revoked"):
            guest.client.check()
    assert not list(front.desk)
    passes(front, 2 * LINGER_SECONDS)
    assert await once(guests, ann) != guest.session.number


@pytest_twisted.ensureDeferred
async def test_one_user_has_so_many(
    front: Desk, guests: SessionPool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Until one of them ends; who is turned away leaves nothing."""
    monkeypatch.setattr(module, "GUESTS", 1)
    (one, _), (other, _) = await front.logged_in(), await front.logged_in()
    await once(guests, one)
    with pytest.raises(Unavailable, match="the most one user"):
        await once(guests, other)
    assert len(front.access._permits) == 1
    passes(front, LINGER_SECONDS)
    await once(guests, other)


@pytest_twisted.ensureDeferred
async def test_nobody_comes_in_who_may_not_or_comes_too_late(front: Desk, guests: SessionPool) -> None:
    """No right, no robot, or no relay any more."""
    ann, _ = await front.logged_in()
    with pytest.raises(NotFound):
        async with guests.at(ann, "hidden", HERE):
            raise AssertionError
    front.desk.say_goodbye("the relay is going down")
    with pytest.raises(ShuttingDown):
        await once(guests, ann)
    with pytest.raises(ShuttingDown):
        async with guests.visit(ann, "rover", HERE):
            raise AssertionError
    assert not front.access._permits


@pytest_twisted.ensureDeferred
async def test_a_visit_counts_as_long_as_it_lasts(
    front: Desk, guests: SessionPool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Among those that are kept, and leaves nothing."""
    monkeypatch.setattr(module, "GUESTS", 2)
    ann, _ = await front.logged_in()
    await once(guests, ann)
    async with guests.visit(ann, "rover", HERE) as (session, _):
        assert len(list(front.desk)) == 2
        with pytest.raises(Unavailable, match="the most one user"):
            async with guests.visit(ann, "rover", HERE):
                raise AssertionError
    assert session not in list(front.desk)
    async with guests.visit(ann, "rover", HERE):
        pass
    assert len(front.access._permits) == 1


@pytest_twisted.ensureDeferred
async def test_what_is_not_dated_is_too_old(
    front: Desk, guests: SessionPool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whoever forgets to say since when moves nothing, though pings are answered at once."""
    ann, _ = await front.logged_in()
    passes(front, 5)
    async with guests.at(ann, "rover", HERE) as guest:
        ages: list[int] = []
        monkeypatch.setattr(
            PublishHandler, "publish", lambda self, ask: ages.append(guest.session.not_before)
        )
        guest.client.do(rosbridge.Publish(topic="/a"))
        guest.client.do(rosbridge.Publish(topic="/a"), since=5)
        assert ages == [0, 5]


@pytest_twisted.ensureDeferred
async def test_one_that_is_kept_goes_when_it_is_let_go(front: Desk, guests: SessionPool) -> None:
    """Once, however often that is said."""
    ann, _ = await front.logged_in()
    guest, leave = await guests.keep(ann, "rover", HERE)
    _, other = await guests.keep(ann, "rover", HERE)
    passes(front, 2 * LINGER_SECONDS)
    leave()
    leave()
    passes(front, 2 * LINGER_SECONDS)
    assert guest.client.closed is None
    other()
    passes(front, LINGER_SECONDS)
    assert not list(front.desk)


@pytest_twisted.ensureDeferred
async def test_who_waits_still_when_it_ends_is_told_so(front: Desk, guests: SessionPool) -> None:
    """Nothing that was asked of it comes any more."""
    ann, _ = await front.logged_in()
    front.world.robot_comes()
    async with guests.at(ann, "rover", HERE) as guest:
        call = outcome(guest.client.call("/reset", msgspec.Raw(b"{}"), TRIGGER, 300.0))
    passes(front, LINGER_SECONDS)
    (error,) = call
    assert isinstance(error, MaybeDone) and "has ended" in str(error)


@pytest_twisted.ensureDeferred
async def test_what_somebody_may_is_told_without_a_connection(front: Desk, guests: SessionPool) -> None:
    """By that which there is, where there is one; nothing is left of it."""
    ann, _ = await front.logged_in()
    async with guests.permit(ann, "rover", HERE) as permit:
        assert permit.judge(Operation.CALL, "/reset").allowed
        assert not list(front.desk)
    assert not front.access._permits
    async with guests.at(ann, "rover", HERE) as guest, guests.permit(ann, "rover", HERE) as permit:
        assert permit is guest.session.permit
    with pytest.raises(NotFound):
        async with guests.permit(ann, "hidden", HERE):
            raise AssertionError
