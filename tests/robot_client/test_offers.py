"""Services and actions that clients of the relay offer to the robot."""

from __future__ import annotations

from typing import Any

import pytest

from relay_protocol import link
from robot_client.channel.advertisements import PENDING_BYTES
from robot_client.channel.parts import MAX_OPEN
from robot_client.platforms.base import ABORTED, CANCELED, SUCCEEDED
from robot_client.platforms.memory import MemoryAction, MemoryService
from tests.robot_client.scene import Scene

BODY = b"\0\1\0\0body"


@pytest.fixture
def scene() -> Scene:
    return Scene()


def service(scene: Scene) -> MemoryService:
    scene.ask(link.AdvertiseService(service="/sum", type="std_srvs/Trigger"))
    return scene.platform.offered["/sum"]


def action(scene: Scene) -> MemoryAction:
    scene.ask(link.AdvertiseAction(action="/drive", type="pkg/Drive"))
    return scene.platform.acted["/drive"]


def said(scene: Scene, kind: type) -> list[Any]:
    return [each for each in scene.wire.said if isinstance(each, kind)]


def test_service_is_confirmed_with_its_full_type(scene: Scene) -> None:
    """An offered service is confirmed by the name the relay used, with the full name of its type."""
    answer = scene.ask(link.AdvertiseService(service="/sum", type="std_srvs/Trigger"))
    assert answer == link.AdvertisedService(service="/sum", type="std_srvs/srv/Trigger")


def test_call_goes_to_the_relay_and_its_answer_back(scene: Scene) -> None:
    """A call from the graph goes out with an id; the answer of that id goes to the caller, once."""
    offered = service(scene)
    offered.call(BODY)
    call = scene.wire.said[-1]
    assert call == link.CallService(
        id=call.id, service="/sum", type="std_srvs/srv/Trigger", cdr=link.to_base64(BODY)
    )
    for _ in range(2):
        scene.channel.handle(link.ServiceResponse(id=call.id, result=True, cdr=link.to_base64(BODY)))
    assert offered.answers == [BODY]


def test_calls_have_ids_of_their_own(scene: Scene) -> None:
    """Calls under way are told apart, and may be answered in any order."""
    offered = service(scene)
    for number in range(3):
        offered.call(BODY + bytes([number]))
    ids = [each.id for each in said(scene, link.CallService)]
    assert len(set(ids)) == 3
    for number in (2, 0, 1):
        body = link.to_base64(BODY + bytes([number]))
        scene.channel.handle(link.ServiceResponse(id=ids[number], result=True, cdr=body))
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
def test_answer_that_is_none_is_not_passed_on(scene: Scene, answer: dict[str, Any]) -> None:
    """A failed call, and bytes that are no response, give the caller no answer and the relay no complaint."""
    offered = service(scene)
    offered.call(BODY)
    told = len(scene.wire.said)
    scene.channel.handle(link.ServiceResponse(id=scene.wire.said[-1].id, **answer))
    assert offered.answers == []
    assert len(scene.wire.said) == told


def test_calls_in_flight_are_bounded(scene: Scene) -> None:
    """Neither more calls nor more bytes than the bounds wait for clients; with an answer there is room again."""
    offered = service(scene)
    for _ in range(MAX_OPEN + 5):
        offered.call(BODY)
    calls = said(scene, link.CallService)
    assert len(calls) == MAX_OPEN
    scene.channel.handle(link.ServiceResponse(id=calls[0].id, result=False))
    offered.call(BODY)
    assert len(said(scene, link.CallService)) == MAX_OPEN + 1
    scene.ask(link.UnadvertiseService(service="/sum"))
    large = service(scene)
    scene.wire.said.clear()
    for _ in range(20):
        large.call(bytes(PENDING_BYTES // 8))
    assert len(said(scene, link.CallService)) == 8


def test_request_too_large_for_the_link_is_not_sent(scene: Scene) -> None:
    """A request that would cost the whole link, being over the relay's limit, is left out."""
    offered = service(scene)
    told = len(scene.wire.said)
    offered.call(bytes(2**24))
    assert len(scene.wire.said) == told


def test_withdrawn_service_is_answered_no_more(scene: Scene) -> None:
    """With its service a call under way is forgotten, and the name is free."""
    offered = service(scene)
    offered.call(BODY)
    call = scene.wire.said[-1]
    scene.channel.handle(link.UnadvertiseService(service="/sum"))
    scene.channel.handle(link.UnadvertiseService(service="/sum"))
    scene.channel.handle(link.ServiceResponse(id=call.id, result=True, cdr=link.to_base64(BODY)))
    assert offered.answers == []
    assert scene.platform.offered == {}
    assert isinstance(scene.ask(link.AdvertiseService(service="/sum", type="a/B")), link.AdvertisedService)


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
def test_what_can_not_be_offered_fails_in_words(scene: Scene, request_: Any, what: str, ref: str) -> None:
    """A name that is taken, here or on the robot, and a type that is none fail by name with the reason."""
    scene.platform.services["/there"] = lambda body: body
    scene.platform.actions.add("/moves")
    service(scene)
    action(scene)
    answer = scene.ask(request_)
    assert isinstance(answer, link.Failed)
    assert (answer.what, answer.ref) == (what, ref)
    assert answer.reason


def test_goal_is_pursued_by_the_client(scene: Scene) -> None:
    """A goal goes out with an id; feedback and one result of that id go to the one who wants it."""
    offered = action(scene)
    assert scene.wire.said[-1] == link.AdvertisedAction(action="/drive", type="pkg/action/Drive")
    goal = offered.send(BODY)
    asked = scene.wire.said[-1]
    assert asked == link.SendActionGoal(
        id=asked.id, action="/drive", type="pkg/action/Drive", feedback=True, cdr=link.to_base64(BODY)
    )
    cdr = link.to_base64(BODY)
    scene.channel.handle(link.ActionFeedback(id=asked.id, cdr=cdr))
    for status in (SUCCEEDED, ABORTED):
        scene.channel.handle(link.ActionResult(id=asked.id, status=status, result=True, cdr=cdr))
    scene.channel.handle(link.ActionFeedback(id=asked.id, cdr=cdr))
    assert (goal.said, goal.end) == ([BODY], (SUCCEEDED, BODY))


def test_cancel_is_passed_on_while_the_goal_is_pursued(scene: Scene) -> None:
    """Who wants a goal no more is heard by the client until the goal has ended."""
    goal = action(scene).send(BODY)
    id = scene.wire.said[-1].id
    goal.cancel()
    assert scene.wire.said[-1] == link.CancelActionGoal(id=id)
    scene.channel.handle(link.ActionResult(id=id, status=CANCELED, result=False, reason="as you wish"))
    assert goal.end == (CANCELED, None)
    told = len(scene.wire.said)
    goal.cancel()
    assert len(scene.wire.said) == told


@pytest.mark.parametrize(
    "result",
    [
        {"result": False, "reason": "the client left"},
        {"result": True},
        {"result": True, "cdr": link.to_base64(b"none")},
    ],
)
def test_success_without_a_result_is_an_abort(scene: Scene, result: dict[str, Any]) -> None:
    """A client that says succeeded and gives no result, or bytes that are none, has aborted the goal."""
    goal = action(scene).send(BODY)
    scene.channel.handle(link.ActionResult(id=scene.wire.said[-1].id, status=SUCCEEDED, **result))
    assert goal.end == (ABORTED, None)


def test_feedback_that_is_none_is_left_out(scene: Scene) -> None:
    """Bytes that are no feedback are left out, and the goal goes on."""
    goal = action(scene).send(BODY)
    id = scene.wire.said[-1].id
    scene.channel.handle(link.ActionFeedback(id=id, cdr=link.to_base64(b"none")))
    scene.channel.handle(link.ActionFeedback(id=id))
    assert (goal.said, goal.end) == ([], None)


def test_goals_are_bounded(scene: Scene) -> None:
    """A goal over the bound is aborted at once."""
    offered = action(scene)
    goals = [offered.send(BODY) for _ in range(MAX_OPEN + 1)]
    assert goals[-1].end == (ABORTED, None)
    assert {each.end for each in goals[:-1]} == {None}


def test_withdrawn_action_aborts_its_goals(scene: Scene) -> None:
    """With its action a goal under way is aborted."""
    goal = action(scene).send(BODY)
    scene.channel.handle(link.UnadvertiseAction(action="/drive"))
    assert goal.end == (ABORTED, None)
    assert scene.platform.acted == {}


def test_end_of_the_channel_takes_all_back(scene: Scene) -> None:
    """A channel that ends withdraws its services, aborts the goals of its actions, and says nothing more."""
    service(scene).call(BODY)
    goal = action(scene).send(BODY)
    told = len(scene.wire.said)
    scene.channel.close()
    scene.channel.close()
    assert (scene.platform.offered, scene.platform.acted) == ({}, {})
    assert goal.end == (ABORTED, None)
    assert len(scene.wire.said) == told
