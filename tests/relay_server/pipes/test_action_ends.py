"""Pipes whose ends are actions: goals, results, control and stop."""

from __future__ import annotations

from typing import Any

import pytest
import pytest_twisted

from relay_db import queries
from relay_protocol import link
from relay_protocol.errors import Invalid, Refused
from relay_server.pipes.schemas import FieldMapping, NewPipe, PipeEnd
from relay_server.pipes.service import PipeUser
from tests.worlds.pipes import PipeScene, settled
from tests.worlds.relay import FIBONACCI, STRING, text, words

CHATTER = PipeEnd("rover", "/chatter")
COPY = PipeEnd("rover", "/copy", STRING)
COUNT = PipeEnd("rover", action="/count")
ORDER = FieldMapping("data", "order", table={"two": 2, "three": 3, "four": 4})
GOALS = NewPipe(name="copy", source=CHATTER, target=COUNT, fields=[ORDER])
RESULTS = NewPipe(name="results", source=COUNT, target=COPY, fields=[FieldMapping("sequence[1]", "data")])


async def begin(scene: PipeScene, *pipes: NewPipe, moving: bool = False) -> PipeUser:
    """ann's pipes run, on a robot with ``/count``."""
    actions = {"/count": link.Service(types=[FIBONACCI], providers=["/counter"])}
    motion = link.MotionPolicy(actions=["/count"], deadline_ms=500) if moving else None
    return await scene.begin_with(link.Graph(full=False, actions=actions), motion, *pipes)


def goals(scene: PipeScene) -> list[int]:
    """The orders of all goals so far."""
    found = scene.world.link.all(link.SendActionGoal)
    return [scene.world.fields(f"{FIBONACCI}_Goal", each.cdr)["order"] for each in found]


def ends(scene: PipeScene, number: int, status: int = 4) -> None:
    """The robot ends a goal."""
    goal = scene.world.link.all(link.SendActionGoal)[number]
    body = scene.world.cdr(f"{FIBONACCI}_Result", sequence=[0, 7])
    scene.world.channel.message(link.ActionResult(id=goal.id, status=status, result=True, cdr=body))


def cancelled(scene: PipeScene) -> int:
    return len(scene.world.link.all(link.CancelActionGoal))


@pytest_twisted.ensureDeferred
async def test_a_message_sends_a_goal_the_newest_follows_and_results_are_carried(scene: PipeScene) -> None:
    ann = await begin(scene, GOALS, RESULTS)
    assert [(await scene.state(ann, each))[0] for each in ("copy", "results")] == ["running"] * 2
    for each in ("two", "three", "four"):
        scene.sends(text(each))
    assert goals(scene) == [2]
    ends(scene, 0)
    assert (goals(scene), [words(each) for each in scene.carried]) == ([2, 4], ["7"])
    ends(scene, 1, status=6)
    found = await scene.service.pipe(ann, "copy")
    assert (found.state, found.messages, found.drops) == ("running", 1, 2)
    assert (found.why, len(scene.carried)) == ("/count: the goal was aborted", 1)


@pytest_twisted.ensureDeferred
async def test_a_goal_is_cancelled_when_the_pipe_is_stopped(scene: PipeScene) -> None:
    ann = await begin(scene, GOALS)
    scene.sends(text("two"))
    await scene.service.stop_pipe(ann, "copy")
    scene.passes(0.01)
    assert cancelled(scene) == 1


@pytest_twisted.ensureDeferred
async def test_an_action_needs_the_right_to_call_it(scene: PipeScene) -> None:
    ann = await begin(scene, GOALS, RESULTS)
    front = scene.front
    await front.store.write(
        queries.grant_right, front.rover.id, "operator", user_id=front.ann.id, deny=["call:/count"]
    )
    await front.access.refresh()
    await settled(scene)
    for name in ("copy", "results"):
        state, why = await scene.state(ann, name)
        assert (state, "/count" in why) == ("refused", True)


@pytest_twisted.ensureDeferred
async def test_an_action_that_is_not_there_is_waited_for(scene: PipeScene) -> None:
    ann = await begin(scene, NewPipe(name="copy", source=CHATTER, target=PipeEnd("rover", action="/later")))
    assert await scene.state(ann) == ("waiting", "waiting for action /later of robot rover")


async def stopped(scene: PipeScene) -> None:
    scene.front.bus.publish("robot.stopped", scene.world.robot.robot_id)


async def aborted(scene: PipeScene) -> None:
    ends(scene, 0, status=6)


@pytest.mark.parametrize("over", [stopped, aborted])
@pytest_twisted.ensureDeferred
async def test_a_goal_that_moves_the_robot_needs_control_and_ends_with_a_stop(
    scene: PipeScene, over: Any
) -> None:
    ann = await begin(scene, GOALS, moving=True)
    scene.pongs()
    scene.sends(text("two"))
    scene.passes(0.01)
    holder = scene.world.controllers.of(scene.world.robot).lease.holder
    assert holder is not None and holder.client.address == "pipe copy"
    assert (goals(scene), (await scene.service.pipe(ann, "copy")).moves) == ([2], True)
    await over(scene)
    await settled(scene)
    assert (await scene.state(ann))[0] == "refused"
    scene.passes(30)
    assert goals(scene) == [2]


@pytest_twisted.ensureDeferred
async def test_settings_that_can_not_be_used_are_refused(scene: PipeScene) -> None:
    ann = await begin(scene, GOALS)
    for new, reason in (
        (NewPipe(name="x", source=COUNT, target=COPY), "carry fields"),
        (NewPipe(name="x", source=COUNT, target=COPY, fields=RESULTS.fields, rate=1.0), "with a rate"),
    ):
        with pytest.raises(Invalid, match=reason):
            await scene.service.add(ann, new)
    back = NewPipe(name="x", source=COUNT, target=PipeEnd("rover", "/chatter", STRING), fields=RESULTS.fields)
    with pytest.raises(Refused, match="feed itself"):
        await scene.service.add(ann, back)
