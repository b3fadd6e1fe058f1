"""Services and actions that clients of the relay advertise on the robot."""

from __future__ import annotations

from typing import Any

import pytest

from relay_protocol import link
from robot_client.channel.handler import MAX_OPEN
from robot_client.channel.offered_services import PENDING_BYTES
from robot_client.platforms.base import ABORTED, CANCELED, SUCCEEDED
from tests.worlds.memory_platform import MemoryActionServer, MemoryServiceServer
from tests.worlds.robot_channel import ChannelWorld

BODY = b"\0\1\0\0body"


@pytest.fixture
def world() -> ChannelWorld:
    return ChannelWorld()


def service(world: ChannelWorld) -> MemoryServiceServer:
    world.request(link.AdvertiseService(service="/sum", type="std_srvs/Trigger"))
    return world.platform.advertised_services["/sum"]


def action(world: ChannelWorld) -> MemoryActionServer:
    world.request(link.AdvertiseAction(action="/drive", type="pkg/Drive"))
    return world.platform.advertised_actions["/drive"]


def said(world: ChannelWorld, kind: type) -> list[Any]:
    return [each for each in world.writer.sent if isinstance(each, kind)]


def test_service_is_confirmed_with_its_full_type(world: ChannelWorld) -> None:
    """By the name that the relay used."""
    answer = world.request(link.AdvertiseService(service="/sum", type="std_srvs/Trigger"))
    assert answer == link.AdvertisedService(service="/sum", type="std_srvs/srv/Trigger")


def test_call_is_sent_to_the_relay_and_its_response_back_once(world: ChannelWorld) -> None:
    """By an id."""
    offered = service(world)
    offered.call(BODY)
    call = world.writer.sent[-1]
    assert call == link.CallService(
        id=call.id, service="/sum", type="std_srvs/srv/Trigger", cdr=link.to_base64(BODY)
    )
    for _ in range(2):
        world.channel.handle(link.ServiceResponse(id=call.id, result=True, cdr=link.to_base64(BODY)))
    assert offered.answers == [BODY]


def test_calls_have_ids_of_their_own(world: ChannelWorld) -> None:
    """They may be answered in any order."""
    offered = service(world)
    for number in range(3):
        offered.call(BODY + bytes([number]))
    ids = [each.id for each in said(world, link.CallService)]
    assert len(set(ids)) == 3
    for number in (2, 0, 1):
        body = link.to_base64(BODY + bytes([number]))
        world.channel.handle(link.ServiceResponse(id=ids[number], result=True, cdr=body))
    assert [each[-1] for each in offered.answers] == [2, 0, 1]


@pytest.mark.parametrize(
    "answer",
    [
        {"result": False, "reason": "the client left"},
        {"result": True},
        {"result": True, "cdr": "%%"},
        {"result": True, "cdr": link.to_base64(b"none")},
    ],
)
def test_failed_calls_and_invalid_responses_are_not_passed_on(
    world: ChannelWorld, answer: dict[str, Any]
) -> None:
    offered = service(world)
    offered.call(BODY)
    sent_before = len(world.writer.sent)
    world.channel.handle(link.ServiceResponse(id=world.writer.sent[-1].id, **answer))
    assert offered.answers == []
    assert len(world.writer.sent) == sent_before


def test_pending_calls_are_bounded(world: ChannelWorld) -> None:
    """In number and bytes."""
    offered = service(world)
    for _ in range(MAX_OPEN + 5):
        offered.call(BODY)
    calls = said(world, link.CallService)
    assert len(calls) == MAX_OPEN
    world.channel.handle(link.ServiceResponse(id=calls[0].id, result=False))
    offered.call(BODY)
    assert len(said(world, link.CallService)) == MAX_OPEN + 1
    world.request(link.UnadvertiseService(service="/sum"))
    large = service(world)
    world.writer.sent.clear()
    for _ in range(20):
        large.call(bytes(PENDING_BYTES // 8))
    assert len(said(world, link.CallService)) == 8


def test_request_too_large_for_the_link_is_not_sent(world: ChannelWorld) -> None:
    offered = service(world)
    sent_before = len(world.writer.sent)
    offered.call(bytes(2**24))
    assert len(world.writer.sent) == sent_before


def test_withdrawn_service_drops_its_calls(world: ChannelWorld) -> None:
    """The name is free again."""
    offered = service(world)
    offered.call(BODY)
    call = world.writer.sent[-1]
    world.channel.handle(link.UnadvertiseService(service="/sum"))
    world.channel.handle(link.UnadvertiseService(service="/sum"))
    world.channel.handle(link.ServiceResponse(id=call.id, result=True, cdr=link.to_base64(BODY)))
    assert offered.answers == []
    assert world.platform.advertised_services == {}
    assert isinstance(
        world.request(link.AdvertiseService(service="/sum", type="a/B")), link.AdvertisedService
    )


@pytest.mark.parametrize(
    ("request_", "what", "ref"),
    [
        (link.AdvertiseService(service="/there", type="a/B"), "advertise_service", "/there"),
        (link.AdvertiseService(service="/sum", type="a/B"), "advertise_service", "/sum"),
        (link.AdvertiseService(service="/new", type="no type"), "advertise_service", "/new"),
        (link.AdvertiseAction(action="/moves", type="a/B"), "advertise_action", "/moves"),
        (link.AdvertiseAction(action="/drive", type="a/B"), "advertise_action", "/drive"),
    ],
)
def test_failed_advertisement_has_the_reason(world: ChannelWorld, request_: Any, what: str, ref: str) -> None:
    """The name is used, here or on the robot, or the type is not valid."""
    world.platform.services["/there"] = lambda body: body
    world.platform.actions.add("/moves")
    service(world)
    action(world)
    answer = world.request(request_)
    assert isinstance(answer, link.Failed)
    assert (answer.request, answer.reference) == (what, ref)
    assert answer.reason


def test_goal_is_executed_by_the_client(world: ChannelWorld) -> None:
    """Feedback and one result are sent to the node that sent the goal."""
    offered = action(world)
    assert world.writer.sent[-1] == link.AdvertisedAction(action="/drive", type="pkg/action/Drive")
    goal = offered.send(BODY)
    asked = world.writer.sent[-1]
    assert asked == link.SendActionGoal(
        id=asked.id, action="/drive", type="pkg/action/Drive", feedback=True, cdr=link.to_base64(BODY)
    )
    cdr = link.to_base64(BODY)
    world.channel.handle(link.ActionFeedback(id=asked.id, cdr=cdr))
    for status in (SUCCEEDED, ABORTED):
        world.channel.handle(link.ActionResult(id=asked.id, status=status, result=True, cdr=cdr))
    world.channel.handle(link.ActionFeedback(id=asked.id, cdr=cdr))
    assert (goal.feedback_sent, goal.end) == ([BODY], (SUCCEEDED, BODY))


def test_cancel_is_passed_on_while_the_goal_is_executed(world: ChannelWorld) -> None:
    goal = action(world).send(BODY)
    id = world.writer.sent[-1].id
    goal.cancel()
    assert world.writer.sent[-1] == link.CancelActionGoal(id=id)
    world.channel.handle(link.ActionResult(id=id, status=CANCELED, result=False, reason="as you wish"))
    assert goal.end == (CANCELED, None)
    sent_before = len(world.writer.sent)
    goal.cancel()
    assert len(world.writer.sent) == sent_before


@pytest.mark.parametrize(
    "result",
    [
        {"result": False, "reason": "the client left"},
        {"result": True},
        {"result": True, "cdr": link.to_base64(b"none")},
    ],
)
def test_success_without_a_result_is_an_abort(world: ChannelWorld, result: dict[str, Any]) -> None:
    """Also with bytes that are no result."""
    goal = action(world).send(BODY)
    world.channel.handle(link.ActionResult(id=world.writer.sent[-1].id, status=SUCCEEDED, **result))
    assert goal.end == (ABORTED, None)


def test_invalid_feedback_is_dropped(world: ChannelWorld) -> None:
    goal = action(world).send(BODY)
    id = world.writer.sent[-1].id
    world.channel.handle(link.ActionFeedback(id=id, cdr=link.to_base64(b"none")))
    world.channel.handle(link.ActionFeedback(id=id))
    assert (goal.feedback_sent, goal.end) == ([], None)


def test_goals_are_bounded(world: ChannelWorld) -> None:
    """One more is aborted at once."""
    offered = action(world)
    goals = [offered.send(BODY) for _ in range(MAX_OPEN + 1)]
    assert goals[-1].end == (ABORTED, None)
    assert {each.end for each in goals[:-1]} == {None}


def test_withdrawn_action_aborts_its_goals(world: ChannelWorld) -> None:
    goal = action(world).send(BODY)
    world.channel.handle(link.UnadvertiseAction(action="/drive"))
    assert goal.end == (ABORTED, None)
    assert world.platform.advertised_actions == {}


def test_end_of_the_channel_withdraws_everything(world: ChannelWorld) -> None:
    service(world).call(BODY)
    goal = action(world).send(BODY)
    sent_before = len(world.writer.sent)
    world.channel.close()
    world.channel.close()
    assert (world.platform.advertised_services, world.platform.advertised_actions) == ({}, {})
    assert goal.end == (ABORTED, None)
    assert len(world.writer.sent) == sent_before
