"""Pipes that end at services: calls, replies, rights and limits."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest
import pytest_twisted

from relay_db import queries
from relay_protocol import link
from relay_protocol.errors import Invalid, Refused
from relay_server.pipes import service as module
from relay_server.pipes.schemas import FieldMapping, NewPipe, PipeEnd, PipeStatus
from relay_server.pipes.service import PipeUser, pipe_user
from relay_server.pipes.service_caller import CALL_SECONDS
from tests.worlds.pipes import PipeScene, settled
from tests.worlds.relay import ADD, STRING, text, words
from tests.worlds.session_manager import HERE

NUMBERS: dict[str, bool | float | str] = {"two": 2, "three": 3, "four": 4}
ADDER = PipeEnd("rover", service="/add")
RESET = PipeEnd("rover", service="/reset")
CHATTER = PipeEnd("rover", "/chatter")
COPY = PipeEnd("rover", "/copy", STRING)


def asks(name: str = "ask", **more: Any) -> NewPipe:
    """A pipe that calls ``/add`` with the number of each word."""
    mapping = FieldMapping("data", "a", table=NUMBERS)
    return NewPipe(**{"name": name, "source": CHATTER, "target": ADDER, "fields": [mapping], **more})


def answers(name: str = "answer", **more: Any) -> NewPipe:
    """A pipe that carries the sums of ``/add`` to a topic."""
    mapping = FieldMapping("sum", "data")
    return NewPipe(**{"name": name, "source": ADDER, "target": COPY, "fields": [mapping], **more})


async def begin(scene: PipeScene, *pipes: NewPipe, moving: bool = False) -> PipeUser:
    """ann's pipes run, on a robot with ``/add``."""
    services = {"/add": link.Service(types=[ADD], providers=["/base"])}
    motion = link.MotionPolicy(services=["/add"], deadline_ms=500) if moving else None
    return await scene.begin_with(link.Graph(full=False, services=services), motion, *pipes)


def called(scene: PipeScene) -> list[tuple[int, int]]:
    """Arguments of all calls of ``/add`` so far."""
    calls = scene.world.link.all(link.CallService)
    found = [scene.world.fields(f"{ADD}_Request", each.cdr) for each in calls if each.service == "/add"]
    return [(each["a"], each["b"]) for each in found]


def replies(scene: PipeScene, number: int, **fields: Any) -> None:
    """The robot answers a call of ``/add``."""
    call = [each for each in scene.world.link.all(link.CallService) if each.service == "/add"][number]
    given = {"result": True, "cdr": scene.world.cdr(f"{ADD}_Response", sum=7), **fields}
    scene.world.channel.message(link.ServiceResponse(id=call.id, **given))


async def status(scene: PipeScene, user: PipeUser, name: str = "ask") -> PipeStatus:
    return await scene.service.pipe(user, name)


@pytest_twisted.ensureDeferred
async def test_fields_become_arguments_and_the_reply_goes_to_a_topic_and_to_another_service(
    scene: PipeScene,
) -> None:
    ann = await begin(scene, asks(), answers(), NewPipe(name="then", source=ADDER, target=RESET))
    assert [(await scene.state(ann, each))[0] for each in ("ask", "answer", "then")] == ["running"] * 3
    scene.sends(text("two"))
    assert called(scene) == [(2, 0)]
    assert (await status(scene, ann)).messages == 0
    replies(scene, 0)
    assert [words(each) for each in scene.carried] == ["7"]
    scene.world.define()
    assert [each.service for each in scene.world.link.all(link.CallService)] == ["/add", "/reset"]
    assert (await status(scene, ann)).messages == 1
    kinds = [each.data["service"] for each in scene.front.events("call.begun")]
    assert kinds == ["/add", "/reset"]
    scene.sends(text("two"))
    assert len(called(scene)) == 2
    assert len(scene.front.events("call.begun")) == 2


@pytest_twisted.ensureDeferred
async def test_one_call_is_in_progress_and_the_newest_message_follows_it(scene: PipeScene) -> None:
    ann = await begin(scene, asks())
    for each in ("two", "three", "four"):
        scene.sends(text(each))
    assert called(scene) == [(2, 0)]
    found = await status(scene, ann)
    assert (found.state, found.drops, "still at work" in found.why) == ("running", 1, True)
    replies(scene, 0)
    assert called(scene) == [(2, 0), (4, 0)]
    replies(scene, 1)
    found = await status(scene, ann)
    assert (found.messages, found.drops, found.why) == (2, 1, "")


@pytest_twisted.ensureDeferred
async def test_errors_of_the_service_are_shown_and_the_next_message_calls_it_again(scene: PipeScene) -> None:
    ann = await begin(scene, asks(), answers())
    scene.sends(text("two"))
    replies(scene, 0, result=False, reason="it is jammed")
    assert await scene.state(ann, "ask") == ("running", "/add: it is jammed")
    scene.sends(text("two"))
    scene.passes(CALL_SECONDS + 2)
    assert "did not answer within 10 s" in (await scene.state(ann, "ask"))[1]
    scene.sends(text("one"))
    assert "'one' of 'data' is not in the table" in (await scene.state(ann, "ask"))[1]
    assert scene.carried == []
    scene.sends(text("three"))
    replies(scene, 2)
    found = await status(scene, ann)
    assert (found.state, found.why, found.messages, found.drops) == ("running", "", 1, 3)
    assert len(scene.carried) == 1


@pytest_twisted.ensureDeferred
async def test_a_service_that_is_not_there_is_waited_for(scene: PipeScene) -> None:
    ann = await begin(scene, asks(target=PipeEnd("rover", service="/later")))
    assert await scene.state(ann, "ask") == ("waiting", "waiting for service /later of robot rover")


@pytest.mark.parametrize("name", ["ask", "answer"])
@pytest_twisted.ensureDeferred
async def test_each_call_and_reply_needs_the_right_to_call(scene: PipeScene, name: str) -> None:
    ann = await begin(scene, asks(), answers())
    scene.sends(text("two"))
    scene.sends(text("three"))
    await scene.front.store.write(
        queries.grant_right,
        scene.front.rover.id,
        "operator",
        user_id=scene.front.ann.id,
        deny=["call:/add"],
    )
    await scene.front.access.refresh()
    replies(scene, 0)
    await settled(scene)
    state, why = await scene.state(ann, name)
    assert (state, "/add" in why) == ("refused", True)
    assert called(scene) == [(2, 0)]
    assert scene.carried == []


@pytest_twisted.ensureDeferred
async def test_replies_are_for_pipes_of_the_same_owner(scene: PipeScene) -> None:
    ann = await begin(scene, asks(), answers(name="own"))
    store = scene.front.store
    bob = await store.write(queries.add_user, "bob", None)
    await store.write(queries.grant_right, scene.front.rover.id, "operator", user_id=bob.id)
    user = pipe_user(await scene.front.by_token(bob), HERE)
    await scene.service.add(user, answers(name="other", target=PipeEnd("rover", "/other", STRING)))
    scene.answers()
    assert (await scene.state(user, "other"))[0] == "running"
    scene.sends(text("two"))
    replies(scene, 0)
    assert [(await status(scene, *each)).messages for each in ((ann, "own"), (user, "other"))] == [1, 0]


@pytest_twisted.ensureDeferred
async def test_with_a_rate_the_source_is_called_that_often_but_not_while_it_is_at_work(
    scene: PipeScene,
) -> None:
    ann = await begin(scene, answers(rate=2.0))
    assert called(scene) == [(0, 0)]
    scene.passes(1.0)
    assert len(called(scene)) == 1
    replies(scene, 0)
    for number in (2, 3):
        scene.passes(0.5)
        assert len(called(scene)) == number
        replies(scene, number - 1)
    assert [words(each) for each in scene.carried] == ["7"] * 3
    scene.passes(0.5)
    replies(scene, 3, result=False, reason="it is jammed")
    assert await scene.state(ann, "answer") == ("running", "/add: it is jammed")
    await scene.service.stop_pipe(ann, "answer")
    scene.passes(5)
    assert len(called(scene)) == 4


UNUSABLE = [
    (asks(target=PipeEnd("rover", service="/relay/stop")), "a service of the relay"),
    (answers(fields=[]), "carry fields"),
    (answers(rate=51.0), "50 times a second"),
    (NewPipe(name="x", source=ADDER, target=ADDER), "the same service"),
]


@pytest_twisted.ensureDeferred
async def test_settings_that_can_not_be_used_are_refused(scene: PipeScene) -> None:
    ann = await scene.begin()
    for pipe, reason in UNUSABLE:
        with pytest.raises(Invalid, match=reason):
            await scene.service.add(ann, pipe)


UNFIT = [
    (asks("a", fields=[FieldMapping("data", "a")]), "give a table"),
    (asks("b", fields=[FieldMapping("data", "sum", table=NUMBERS)]), "has no field 'sum'"),
    (answers("c", fields=[FieldMapping("a", "data")]), "has no field 'a'"),
    (asks("d", target=PipeEnd("rover", type="std_srvs/srv/Trigger", service="/add")), "has the type"),
]


@pytest_twisted.ensureDeferred
async def test_fields_that_do_not_fit_are_refused_before_a_call(scene: PipeScene) -> None:
    ann = await begin(scene, *(pipe for pipe, _ in UNFIT))
    await settled(scene)
    for pipe, reason in UNFIT:
        state, why = await scene.state(ann, pipe.name)
        assert (state, reason in why) == ("refused", True), why
    assert called(scene) == []


@pytest.mark.parametrize("body", ['{"robot": "rover"}', '{"robot": "rover", "topic": "/a", "service": "/b"}'])
def test_an_end_is_a_topic_or_a_service(body: str) -> None:
    with pytest.raises(msgspec.ValidationError, match="a 'topic', a 'service' or an 'action'"):
        msgspec.json.decode(body, type=PipeEnd)


@pytest_twisted.ensureDeferred
async def test_pipes_that_feed_each_other_by_a_service_are_a_cycle(scene: PipeScene) -> None:
    ann = await begin(scene, asks())
    back = answers(target=PipeEnd("rover", "/chatter", STRING))
    with pytest.raises(Refused, match=r"feed itself \(answer → ask → answer\)"):
        await scene.service.add(ann, back)


# --- services that move the robot ----------------------------------------------------------------------------


@pytest_twisted.ensureDeferred
async def test_a_call_that_moves_the_robot_takes_control_and_must_not_be_too_old(scene: PipeScene) -> None:
    ann = await begin(scene, asks(), moving=True)
    scene.pongs()
    scene.sends(text("two"))
    scene.passes(0.01)
    holder = scene.world.controllers.of(scene.world.robot).lease.holder
    assert holder is not None and (holder.client.name, holder.client.address) == ("ann", "pipe ask")
    assert called(scene) == [(2, 0)]
    # It waits for the first call until it is too old.
    scene.sends(text("three"))
    scene.passes(0.6)
    replies(scene, 0)
    found = await status(scene, ann)
    assert (called(scene), found.state, found.moves) == ([(2, 0)], "running", True)
    assert (found.drops, "may be older" in found.why) == (1, True)
    scene.pongs()
    scene.sends(text("four"))
    assert called(scene) == [(2, 0), (4, 0)]


async def stopped(scene: PipeScene) -> None:
    scene.front.bus.publish("robot.stopped", scene.world.robot.robot_id)


async def failed(scene: PipeScene) -> None:
    replies(scene, 0, result=False, reason="it is jammed")


async def offline(scene: PipeScene) -> None:
    scene.world.robot_goes()
    scene.passes(module.CHECK_SECONDS)


@pytest.mark.parametrize("ends", [stopped, failed, offline])
@pytest_twisted.ensureDeferred
async def test_it_ends_and_does_not_call_again_by_itself(scene: PipeScene, ends: Any) -> None:
    ann = await begin(scene, asks(), moving=True)
    scene.pongs()
    for each in ("two", "three"):
        scene.sends(text(each))
        scene.passes(0.01)
    await ends(scene)
    await settled(scene)
    assert (await scene.state(ann, "ask"))[0] == "refused"
    scene.passes(30)
    assert called(scene) == [(2, 0)]


@pytest_twisted.ensureDeferred
async def test_a_service_that_moves_its_robot_is_not_called_by_a_rate(scene: PipeScene) -> None:
    ann = await begin(scene, answers(rate=2.0), moving=True)
    await settled(scene)
    state, why = await scene.state(ann, "answer")
    assert (state, "can't be a source with a rate" in why) == ("refused", True)
    assert called(scene) == []
