"""Shares of the processor: what is used up comes back with time, and nobody uses up what is another's."""

from __future__ import annotations

import pytest
from twisted.internet.task import Clock

from relay_protocol import json_cost
from relay_protocol.rights import Level
from relay_server.common import close_codes, cpu_quota
from relay_server.common.cpu_quota import Quota, UserQuotas
from relay_server.sessions import service_calls
from relay_server.sessions import session as core
from tests.relay_server.memory import Person, World

QUESTION = {"service": "/rosapi/topics", "id": "q"}


def test_what_is_spent_comes_back_with_time() -> None:
    """At its share of the time, up to the reserve; what is done last may overdraw it."""
    clock = Clock()
    mine = Quota(0.25, 1.0, clock.seconds)
    mine.spend(3.0)
    assert mine.left == -2.0
    clock.advance(4.0)
    assert mine.left == -1.0
    clock.advance(100.0)
    assert mine.left == 1.0


def test_a_clock_that_is_set_back_gives_and_takes_nothing() -> None:
    """What was left stays."""
    now = [100.0]
    mine = Quota(0.25, 1.0, lambda: now[0])
    mine.spend(0.5)
    now[0] = 0.0
    assert mine.left == 0.5
    now[0] = 1.0
    assert mine.left == 0.75


def test_one_user_cannot_use_up_the_forms_of_all() -> None:
    """His own share is less; others go on until the share of all is used up."""
    worked = [0.0]
    budgets = UserQuotas(lambda: 0.0, lambda: worked[0])
    one, two, three = budgets.of(1), budgets.of(2), budgets.of(3)
    assert budgets.of(1) is one
    with one.forming():
        worked[0] += cpu_quota.FORMS_RESERVE * 0.9
    assert one.may_form and two.may_form
    with two.forming():
        worked[0] += cpu_quota.FORMS_RESERVE * 0.2
    assert not three.may_form
    assert cpu_quota.FORMS_OF_USER < cpu_quota.FORMS


def busy(world: World, work: float, user: int = 7) -> None:
    """The user's requests took so many seconds of work."""
    world.budgets.of(user).requests.spend(work)


def answer(person: Person) -> str:
    """What a question is answered: its words when it is refused."""
    person.says("call_service", **QUESTION)
    (reply,) = person.hears("service_response")
    return "" if reply["result"] else str(reply["values"])


def test_who_has_used_up_his_share_is_refused_until_there_is_some_left(world: World) -> None:
    """Over all connections of the user; another user's questions are answered."""
    first, second, other = world.person(), world.person(), world.person(user=8)
    assert answer(first) == ""
    busy(world, cpu_quota.REQUESTS_RESERVE + 0.5)
    for each in (first, second):
        assert answer(each).startswith("too much at once: your share of the relay's processor is used up")
    assert answer(other) == ""
    world.clock.advance(2.1)
    assert answer(second) == ""


def test_the_time_a_request_takes_is_counted(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also when it fails, and once although parts of it are counted themselves."""
    person = world.person()

    def slow(session: object, ask: object) -> None:
        world.worked += 0.25
        raise ZeroDivisionError

    monkeypatch.setattr(service_calls.ServiceCallHandler, "call", slow)
    before = person.session.allowance.requests.left
    with pytest.raises(ZeroDivisionError):
        person.says("call_service", args="x" * 2 * core.SMALL, **QUESTION)
    assert person.session.allowance.requests.left == pytest.approx(before - 0.25)


def test_what_is_small_to_publish_and_what_takes_back_is_always_done(world: World) -> None:
    """A robot must be stopped, and a goal cancelled, whatever else was asked for; long messages have to wait."""
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
    person.says("publish", topic="/cmd_vel", msg={}, id="x" * core.SMALL)
    assert len(world.link.samples) == sent + 1
    person.says("unsubscribe", topic="/chatter")
    assert not world.channel.ends().subscribes
    person.says("cancel_action_goal", action="/dock", id="g")
    told = person.told()
    assert told[0].startswith("too much at once")
    assert told[1] == "no goal of yours with the id 'g' is under way"


@pytest.mark.parametrize(
    ("op", "answered"),
    [({"op": "call_service", "service": "/a"}, True), ({"op": "publish", "topic": "/a"}, False)],
)
def test_a_large_message_is_not_read_while_the_share_is_used_up(
    world: World, monkeypatch: pytest.MonkeyPatch, op: dict[str, str], answered: bool
) -> None:
    """It is refused by its ``id``, and is no message that is none; a small one is read."""
    person = world.person()
    person.says("set_level", level="error")
    read: list[int] = []
    decode = core.rosbridge.decode
    monkeypatch.setattr(core.rosbridge, "decode", lambda data: read.append(len(data)) or decode(data))
    busy(world, cpu_quota.REQUESTS_RESERVE + 0.5)
    for _ in range(2 * core.MALFORMED):
        person.says(**op, id="q", args={"data": "x" * json_cost.COUNTED})
    assert read == []
    assert person.client.closed is None
    said = [each["values"] for each in person.hears("service_response")] if answered else person.told()
    assert said and said[0].startswith("too much at once")
    person.says("unsubscribe", topic="/a")
    assert len(read) == 1


def test_a_message_of_too_many_parts_is_refused_by_its_id(world: World) -> None:
    """The client stays."""
    person = world.person()
    for _ in range(2 * core.MALFORMED):
        person.says("call_service", service="/a", id="q", args=[{}] * 60_000)
    assert person.client.closed is None
    (reply, *_) = person.hears("service_response")
    assert reply["id"] == "q"
    assert "objects and arrays" in reply["values"]


def test_who_is_far_over_his_share_is_cut(world: World) -> None:
    """It is remembered when he comes back; some seconds later he is welcome."""
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
def test_what_is_refused_is_counted_too(world: World, junk: dict[str, str]) -> None:
    """Small as it is, the relay has read it and answered."""
    person = world.person()
    before = person.session.allowance.requests.left
    person.says(**junk)
    assert person.session.allowance.requests.left < before


def test_long_arguments_for_the_relay_are_refused(world: World) -> None:
    """Its own services need few; to read many lists takes long."""
    person = world.person()
    person.says("call_service", args=["x" * service_calls.LOCAL_BYTES], **QUESTION)
    (reply,) = person.hears("service_response")
    assert reply["result"] is False
    assert str(service_calls.LOCAL_BYTES) in reply["values"]
