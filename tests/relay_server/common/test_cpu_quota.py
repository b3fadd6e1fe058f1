"""CPU quotas refill with time, and no user can use up another user's quota."""

from __future__ import annotations

import pytest
from twisted.internet.task import Clock

from relay_protocol import json_cost
from relay_protocol.rights import Level
from relay_server.common import close_codes, cpu_quota
from relay_server.common.cpu_quota import CpuQuota, UserQuotas
from relay_server.sessions import rosbridge_port, service_calls, websocket_port
from tests.worlds.relay import Person, World

QUESTION = {"service": "/rosapi/topics", "id": "q"}


def test_quota_refills_with_time() -> None:
    """It refills up to a limit; the last request may overdraw it."""
    clock = Clock()
    mine = CpuQuota(0.25, 1.0, clock.seconds)
    mine.spend(3.0)
    assert mine.left == -2.0
    clock.advance(4.0)
    assert mine.left == -1.0
    clock.advance(100.0)
    assert mine.left == 1.0


def test_a_clock_that_is_set_back_gives_and_takes_nothing() -> None:
    """The remaining quota is unchanged."""
    now = [100.0]
    mine = CpuQuota(0.25, 1.0, lambda: now[0])
    mine.spend(0.5)
    now[0] = 0.0
    assert mine.left == 0.5
    now[0] = 1.0
    assert mine.left == 0.75


def test_encodings_are_limited_per_user() -> None:
    """A user's quota is lower than that of all users; others go on until the latter is used up."""
    worked = [0.0]
    budgets = UserQuotas(lambda: 0.0, lambda: worked[0])
    one, two, three = budgets.of(1), budgets.of(2), budgets.of(3)
    assert budgets.of(1) is one
    with one.encoding():
        worked[0] += cpu_quota.ENCODINGS_RESERVE * 0.9
    assert one.may_encode and two.may_encode
    with two.encoding():
        worked[0] += cpu_quota.ENCODINGS_RESERVE * 0.2
    assert not three.may_encode
    assert cpu_quota.ENCODINGS_OF_USER < cpu_quota.ENCODINGS


def busy(world: World, work: float, user: int = 7) -> None:
    """The user's requests took this many seconds of CPU time."""
    world.budgets.of(user).requests.spend(work)


def answer(person: Person) -> str:
    """The error text of a request, or empty if it succeeds."""
    person.says("call_service", **QUESTION)
    (reply,) = person.received("service_response")
    return "" if reply["result"] else str(reply["values"])


def test_exhausted_quota_refuses_until_it_refills(world: World) -> None:
    """This applies to all connections of the user; another user's requests are answered."""
    first, second, other = world.person(), world.person(), world.person(user=8)
    assert answer(first) == ""
    busy(world, cpu_quota.REQUESTS_RESERVE + 0.5)
    for each in (first, second):
        assert answer(each).startswith("too much at once: your share of the relay's processor is used up")
    assert answer(other) == ""
    world.clock.advance(2.1)
    assert answer(second) == ""


def test_the_time_a_request_takes_is_counted(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    """It counts for failed requests too, and only once if parts are measured themselves."""
    person = world.person()

    def slow(session: object, ask: object) -> None:
        world.worked += 0.25
        raise ZeroDivisionError

    monkeypatch.setattr(service_calls.ServiceCallHandler, "call", slow)
    before = person.context.quota.user.requests.left
    with pytest.raises(ZeroDivisionError):
        person.says("call_service", args="x" * 2 * rosbridge_port.SMALL, **QUESTION)
    assert person.context.quota.user.requests.left == pytest.approx(before - 0.25)


def test_small_publications_and_releases_are_always_done(world: World) -> None:
    """Stopping a robot and cancelling a goal must always work; long messages have to wait."""
    world.robot_comes()
    person = world.person(Level.OPERATOR)
    world.robot_joins()
    person.says("subscribe", topic="/chatter")
    person.says("publish", topic="/cmd_vel", msg={})
    world.define()
    person.says("set_level", level="error")
    busy(world, cpu_quota.REQUESTS_RESERVE + 1.0)
    sent = len(world.link.samples)
    person.says("publish", topic="/cmd_vel", msg={})
    assert len(world.link.samples) == sent + 1
    person.says("publish", topic="/cmd_vel", msg={}, id="x" * rosbridge_port.SMALL)
    assert len(world.link.samples) == sent + 1
    person.says("unsubscribe", topic="/chatter")
    assert not world.channel.own_endpoints().subscribes
    person.says("cancel_action_goal", action="/dock", id="g")
    reported = person.reported()
    assert reported[0].startswith("too much at once")
    assert reported[1] == "no goal of yours with the id 'g' is under way"


@pytest.mark.parametrize(
    ("op", "answered"),
    [({"op": "call_service", "service": "/a"}, True), ({"op": "publish", "topic": "/a"}, False)],
)
def test_a_large_message_is_not_read_while_the_share_is_used_up(
    world: World, monkeypatch: pytest.MonkeyPatch, op: dict[str, str], answered: bool
) -> None:
    """It is refused with its ``id``; a small message is read."""
    person = world.person()
    person.says("set_level", level="error")
    read: list[int] = []
    decode = rosbridge_port.rosbridge.decode
    monkeypatch.setattr(
        rosbridge_port.rosbridge, "decode", lambda data: read.append(len(data)) or decode(data)
    )
    busy(world, cpu_quota.REQUESTS_RESERVE + 0.5)
    for _ in range(2 * websocket_port.MAX_MALFORMED):
        person.says(**op, id="q", args={"data": "x" * json_cost.COUNTED})
    assert read == []
    assert person.client.closed is None
    said = [each["values"] for each in person.received("service_response")] if answered else person.reported()
    assert said and said[0].startswith("too much at once")
    person.says("unsubscribe", topic="/a")
    assert len(read) == 1


def test_a_message_of_too_many_parts_is_refused_by_its_id(world: World) -> None:
    """The client stays connected."""
    person = world.person()
    for _ in range(2 * websocket_port.MAX_MALFORMED):
        person.says("call_service", service="/a", id="q", args=[{}] * 60_000)
    assert person.client.closed is None
    (reply, *_) = person.received("service_response")
    assert reply["id"] == "q"
    assert "objects and arrays" in reply["values"]


def test_client_far_over_its_quota_is_cut(world: World) -> None:
    """The relay remembers it when the user reconnects; some seconds later the user may connect."""
    person = world.person()
    busy(world, cpu_quota.REQUESTS_RESERVE + cpu_quota.DEBT)
    person.says("publish", topic="/nowhere", msg={})
    assert person.client.closed is not None
    assert person.client.closed[0] == close_codes.TOO_MANY_ERRORS
    again = world.person()
    assert answer(again).startswith("too much at once")
    again.session.end()
    world.clock.advance(cpu_quota.DEBT / cpu_quota.REQUESTS + 1)
    assert answer(world.person()) == ""


@pytest.mark.parametrize("junk", [{"op": "dance"}, {"op": "publish", "topic": "/nowhere"}])
def test_refused_requests_are_counted_too(world: World, junk: dict[str, str]) -> None:
    """A refusal also costs reading and answering."""
    person = world.person()
    before = person.context.quota.user.requests.left
    person.says(**junk)
    assert person.context.quota.user.requests.left < before


def test_long_arguments_for_the_relay_are_refused(world: World) -> None:
    """The relay's own services need few arguments, and long lists take time to read."""
    person = world.person()
    person.says("call_service", args=["x" * service_calls.OWN_BYTES], **QUESTION)
    (reply,) = person.received("service_response")
    assert reply["result"] is False
    assert str(service_calls.OWN_BYTES) in reply["values"]
