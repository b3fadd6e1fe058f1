"""Connections that are pooled for HTTP requests, with a real database."""

from __future__ import annotations

import msgspec
import pytest
import pytest_twisted

from relay_protocol import link, rosbridge
from relay_protocol.errors import NotFound, Refused, Unavailable
from relay_protocol.rights import Operation
from relay_server.access import Principal
from relay_server.in_process_sessions import pool as module
from relay_server.in_process_sessions.in_process_port import MaybeDone
from relay_server.in_process_sessions.pool import LINGER_SECONDS, InProcessSessionPool, RobotCaller
from relay_server.sessions.manager import ShuttingDown
from relay_server.sessions.publishing import PublishHandler
from tests.worlds.control import outcome
from tests.worlds.relay import TRIGGER
from tests.worlds.session_manager import HERE, SessionsWorld


@pytest.fixture
def pool(front: SessionsWorld) -> InProcessSessionPool:
    """A session pool."""
    return InProcessSessionPool(front.world.clock, front.service)


def passes(front: SessionsWorld, seconds: float) -> None:
    """Lets time pass in steps, with answered pings."""
    front.world.clock.pump([0.5] * round(seconds / 0.5))


async def once(pool: InProcessSessionPool, principal: Principal) -> int:
    """Makes one request; returns the id of its connection."""
    async with pool.at(RobotCaller(principal, "rover", HERE)) as pooled:
        return pooled.client.number


@pytest_twisted.ensureDeferred
async def test_a_connection_is_kept_from_one_request_to_the_next(
    front: SessionsWorld, pool: InProcessSessionPool
) -> None:
    """It ends when it was idle for long enough, with all its state."""
    ann, _ = await front.logged_in()
    first = await once(pool, ann)
    passes(front, LINGER_SECONDS - 1)
    assert await once(pool, ann) == first
    passes(front, LINGER_SECONDS - 1)
    assert [each.number for each in front.service] == [first]
    passes(front, 1)
    assert not list(front.service) and not front.access._permits
    assert await once(pool, ann) != first


@pytest_twisted.ensureDeferred
async def test_it_does_not_end_while_a_request_is_answered(
    front: SessionsWorld, pool: InProcessSessionPool
) -> None:
    """For any duration; two concurrent requests share it."""
    ann, _ = await front.logged_in()
    async with pool.at(RobotCaller(ann, "rover", HERE)) as pooled:
        first = await once(pool, ann)
        passes(front, 10 * LINGER_SECONDS)
        assert first == pooled.client.number
        assert pooled.port.closed is None
        assert len(list(front.service)) == 1


@pytest_twisted.ensureDeferred
async def test_tokens_have_their_own(front: SessionsWorld, pool: InProcessSessionPool) -> None:
    """One may have fewer rights than another."""
    (one, _), (other, _) = await front.logged_in(), await front.logged_in()
    assert await once(pool, one) != await once(pool, other)


@pytest_twisted.ensureDeferred
async def test_closed_stream_is_not_reused(front: SessionsWorld, pool: InProcessSessionPool) -> None:
    """A user with a new right gets a new connection."""
    ann, _ = await front.logged_in()
    async with pool.at(RobotCaller(ann, "rover", HERE)) as pooled:
        pooled.session.close(4403, "your right was revoked")
        with pytest.raises(Refused, match="revoked"):
            pooled.port.check()
    assert not list(front.service)
    passes(front, 2 * LINGER_SECONDS)
    assert await once(pool, ann) != pooled.client.number


@pytest_twisted.ensureDeferred
async def test_number_is_limited_per_user(
    front: SessionsWorld, pool: InProcessSessionPool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Until one of them ends; a refused request leaves no state."""
    monkeypatch.setattr(module, "SESSIONS_PER_USER", 1)
    (one, _), (other, _) = await front.logged_in(), await front.logged_in()
    await once(pool, one)
    with pytest.raises(Unavailable, match="the most one user"):
        await once(pool, other)
    assert len(front.access._permits) == 1
    passes(front, LINGER_SECONDS)
    await once(pool, other)


@pytest_twisted.ensureDeferred
async def test_viewers_without_right_or_too_late_are_refused(
    front: SessionsWorld, pool: InProcessSessionPool
) -> None:
    """Because of a missing right, an unknown robot, or the relay's shutdown."""
    ann, _ = await front.logged_in()
    with pytest.raises(NotFound):
        async with pool.at(RobotCaller(ann, "hidden", HERE)):
            raise AssertionError
    front.service.shutdown("the relay is going down")
    with pytest.raises(ShuttingDown):
        await once(pool, ann)
    with pytest.raises(ShuttingDown):
        async with pool.unshared(RobotCaller(ann, "rover", HERE)):
            raise AssertionError
    assert not front.access._permits


@pytest_twisted.ensureDeferred
async def test_a_visit_counts_as_long_as_it_lasts(
    front: SessionsWorld, pool: InProcessSessionPool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It counts among the pooled connections, and leaves no state."""
    monkeypatch.setattr(module, "SESSIONS_PER_USER", 2)
    ann, _ = await front.logged_in()
    await once(pool, ann)
    async with pool.unshared(RobotCaller(ann, "rover", HERE)) as client:
        assert len(list(front.service)) == 2
        with pytest.raises(Unavailable, match="the most one user"):
            async with pool.unshared(RobotCaller(ann, "rover", HERE)):
                raise AssertionError
    assert client.client not in list(front.service)
    async with pool.unshared(RobotCaller(ann, "rover", HERE)):
        pass
    assert len(front.access._permits) == 1


@pytest_twisted.ensureDeferred
async def test_undated_command_is_too_old(
    front: SessionsWorld, pool: InProcessSessionPool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A command without a time moves no robot, even if pings are answered at once."""
    ann, _ = await front.logged_in()
    passes(front, 5)
    async with pool.at(RobotCaller(ann, "rover", HERE)) as pooled:
        ages: list[int] = []
        monkeypatch.setattr(
            PublishHandler, "publish", lambda self, ask: ages.append(pooled.client.earliest_sent)
        )
        pooled.port.perform(rosbridge.Publish(topic="/a"))
        pooled.port.perform(rosbridge.Publish(topic="/a"), earliest_sent=5)
        assert ages == [0, 5]


@pytest_twisted.ensureDeferred
async def test_retained_file_is_deleted_when_released(
    front: SessionsWorld, pool: InProcessSessionPool
) -> None:
    """Exactly once, for any number of releases."""
    ann, _ = await front.logged_in()
    pooled, leave = await pool.keep(RobotCaller(ann, "rover", HERE))
    _, other = await pool.keep(RobotCaller(ann, "rover", HERE))
    passes(front, 2 * LINGER_SECONDS)
    leave()
    leave()
    passes(front, 2 * LINGER_SECONDS)
    assert pooled.port.closed is None
    other()
    passes(front, LINGER_SECONDS)
    assert not list(front.service)


@pytest_twisted.ensureDeferred
async def test_waiting_client_is_notified_at_the_end(
    front: SessionsWorld, pool: InProcessSessionPool
) -> None:
    """Requests that wait on the connection end."""
    ann, _ = await front.logged_in()
    front.world.robot_comes()
    async with pool.at(RobotCaller(ann, "rover", HERE)) as pooled:
        call = outcome(pooled.port.call("/reset", msgspec.Raw(b"{}"), TRIGGER, 300.0))
    passes(front, LINGER_SECONDS)
    (error,) = call
    assert isinstance(error, MaybeDone) and "has ended" in str(error)


@pytest_twisted.ensureDeferred
async def test_rights_are_listed_without_a_connection(
    front: SessionsWorld, pool: InProcessSessionPool
) -> None:
    """An existing connection is used; no state is left."""
    ann, _ = await front.logged_in()
    async with pool.admitted(RobotCaller(ann, "rover", HERE)) as (permit, robot):
        assert permit.decide(Operation.CALL, "/reset").allowed
        assert not list(front.service)
    assert not front.access._permits
    async with (
        pool.at(RobotCaller(ann, "rover", HERE)) as pooled,
        pool.admitted(RobotCaller(ann, "rover", HERE)) as (permit, known),
    ):
        assert permit is pooled.client.permit
        assert known is robot is pooled.client.robot
    with pytest.raises(NotFound):
        async with pool.admitted(RobotCaller(ann, "hidden", HERE)):
            raise AssertionError


@pytest_twisted.ensureDeferred
async def test_the_relays_own_services_are_bounded_as_for_a_websocket(
    front: SessionsWorld, pool: InProcessSessionPool
) -> None:
    """The CPU quota and the size of arguments apply; refusals are counted."""
    ann, _ = await front.logged_in()
    async with pool.at(RobotCaller(ann, "rover", HERE)) as pooled:
        with pytest.raises(Refused, match="65536 bytes"):
            await pooled.port.call_own("/rosapi/get_param", {"name": "/a:b", "default_value": "x" * 65_536})
        pooled.client.quota.count_elsewhere(1.5)
        with pytest.raises(Refused, match="processor"):
            await pooled.port.call_own("/rosapi/get_param", {"name": "/a:b"})
        assert pooled.client.refusals == 2


@pytest_twisted.ensureDeferred
async def test_a_call_of_the_relays_own_services_ends_with_the_session(
    front: SessionsWorld, pool: InProcessSessionPool
) -> None:
    """Its caller gets an error."""
    ann, _ = await front.logged_in()
    front.world.robot_comes()
    front.world.robot.graph.services["/a/get_parameters"] = link.Service(
        types=["rcl_interfaces/srv/GetParameters"]
    )
    async with pool.at(RobotCaller(ann, "rover", HERE)) as pooled:
        call = outcome(pooled.port.call_own("/rosapi/get_param", {"name": "/a:b"}))
        assert call == []
        pooled.session.close(4403, "your right was revoked")
    (error,) = call
    assert isinstance(error, MaybeDone) and "revoked" in str(error)
