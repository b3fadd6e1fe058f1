"""Pipes whose ends are ports and functions of programs."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import msgspec
import pytest
import pytest_twisted
from twisted.internet.defer import Deferred

from relay_db import queries
from relay_protocol.errors import Invalid, Refused
from relay_server.common.errors import NotDone
from relay_server.icpi.programs import Program, PublishedValue
from relay_server.pipes.schemas import FieldMapping, NewPipe, PipeEnd
from relay_server.pipes.service import MAX_POLLS, PipeUser, pipe_user
from tests.worlds.pipes import PipeScene, settled
from tests.worlds.relay import STRING, TWIST, text, words
from tests.worlds.session_manager import HERE

CHATTER = PipeEnd("rover", "/chatter")
COPY = PipeEnd("rover", "/copy", STRING)
DRIVE = PipeEnd("rover", "/cmd_vel", TWIST)
POWER = PipeEnd(program="lamp", port="power")
BLINK = PipeEnd(program="lamp", function="blink")
SPEED = [FieldMapping("data", "linear.x", scale=0.5)]


class Lamp:
    """A program of a user that keeps the requests to it."""

    def __init__(self, scene: PipeScene, user: int) -> None:
        self.asked: list[tuple[str, ...]] = []
        self.answers: list[Deferred[str]] = []
        self._scene = scene
        self._user = user
        self.goes: Callable[[], None] = lambda: None
        self.comes()

    def comes(self) -> None:
        program = Program("lamp", frozenset({"power"}), frozenset({"blink"}), self._request, self._notify)
        self.goes = self._scene.programs.register(self._user, program)

    async def _request(self, function: str, args: Iterable[str], sender: str, seconds: float) -> str:
        assert (sender, seconds) == ("relay", 10.0)
        self.asked.append((function, *args))
        answer: Deferred[str] = Deferred()
        self.answers.append(answer)
        return await answer

    def _notify(self, function: str, args: Iterable[str], sender: str) -> None:
        raise AssertionError("a pipe waits for replies")

    def publishes(self, value: str, port: str = "power") -> int:
        now = self._scene.world.now_ns()
        return self._scene.programs.on_value(PublishedValue(self._user, "lamp", port, value, now))


async def begin(scene: PipeScene, *pipes: NewPipe) -> tuple[PipeUser, Lamp]:
    """ann's pipes run, with her lamp."""
    ann = await scene.begin()
    lamp = Lamp(scene, scene.front.ann.id)
    for each in pipes:
        await scene.service.add(ann, each)
    scene.joins()
    return ann, lamp


def pipe(source: PipeEnd, target: PipeEnd, *fields: FieldMapping, **more: Any) -> NewPipe:
    return NewPipe(name="copy", source=source, target=target, fields=list(fields), **more)


SETS = [
    (pipe(CHATTER, POWER, FieldMapping("data", "data", table={"on": True})), ("set", "power", "true")),
    (pipe(CHATTER, POWER, FieldMapping("data", "word.said")), ("set", "power", '{"word":{"said":"on"}}')),
    (pipe(CHATTER, POWER), ("set", "power", '"on"')),
    (pipe(CHATTER, BLINK), ("blink",)),
    (
        pipe(
            CHATTER,
            BLINK,
            FieldMapping("data", "how"),
            FieldMapping("data", "times", table={"on": 3, "x": 1}),
        ),
        ("blink", "on", "3"),
    ),
]


@pytest.mark.parametrize(("new", "asked"), SETS)
@pytest_twisted.ensureDeferred
async def test_messages_set_a_port_or_call_a_function(
    scene: PipeScene, new: NewPipe, asked: tuple[str, ...]
) -> None:
    ann, lamp = await begin(scene, new)
    assert await scene.state(ann) == ("running", "")
    scene.sends(text("on"))
    assert lamp.asked == [asked]
    lamp.answers[0].callback("")
    found = await scene.service.pipe(ann, "copy")
    assert (found.messages, found.drops, found.moves) == (1, 0, False)


@pytest_twisted.ensureDeferred
async def test_one_request_is_in_progress_and_a_refusal_is_shown(scene: PipeScene) -> None:
    ann, lamp = await begin(scene, pipe(CHATTER, POWER))
    for each in ("a", "b", "c"):
        scene.sends(text(each))
    lamp.answers[0].errback(NotDone("lamp: it is broken"))
    assert [each[2] for each in lamp.asked] == ['"a"', '"c"']
    found = await scene.service.pipe(ann, "copy")
    assert (found.state, found.why, found.drops) == ("running", "lamp: it is broken", 2)
    lamp.answers[1].callback("")
    scene.sends(text("x" * 9000))
    found = await scene.service.pipe(ann, "copy")
    assert (found.messages, "8192 bytes at most" in found.why) == (1, True)
    assert len(lamp.asked) == 2


@pytest_twisted.ensureDeferred
async def test_published_values_are_carried_as_messages(scene: PipeScene) -> None:
    ann, lamp = await begin(scene, pipe(POWER, COPY))
    assert await scene.state(ann) == ("running", "")
    assert [lamp.publishes(each) for each in ('"on"', '{"data": "off"}', "dim (half)")] == [1, 1, 1]
    assert lamp.publishes("[1]") == 1
    assert lamp.publishes('"on"', "other") == 0
    assert Lamp(scene, scene.front.ann.id + 1).publishes('"on"') == 0
    assert [words(each) for each in scene.carried] == ["on", "off", "dim (half)"]
    found = await scene.service.pipe(ann, "copy")
    assert (found.messages, found.drops, "data" in found.why, lamp.asked) == (3, 1, True, [])


@pytest_twisted.ensureDeferred
async def test_with_a_rate_a_port_is_asked_that_often(scene: PipeScene) -> None:
    _, lamp = await begin(scene, pipe(POWER, COPY, FieldMapping("data", "data", table={"1": "on"}), rate=2.0))
    assert lamp.asked == [("get", "power")]
    scene.passes(1.0)
    assert len(lamp.asked) == 1
    lamp.answers[0].callback("true")
    lamp.publishes("1")
    scene.passes(0.5)
    lamp.answers[1].callback("1")
    assert [words(each) for each in scene.carried] == ["on"]


@pytest_twisted.ensureDeferred
async def test_results_of_a_function_that_a_pipe_calls_go_on(scene: PipeScene) -> None:
    result = NewPipe(name="result", source=BLINK, target=COPY, fields=[FieldMapping("data", "data")])
    _, lamp = await begin(scene, pipe(CHATTER, BLINK), result)
    scene.sends(text("on"))
    lamp.answers[0].callback("7")
    assert [words(each) for each in scene.carried] == ["7"]


@pytest_twisted.ensureDeferred
async def test_it_waits_for_the_program(scene: PipeScene) -> None:
    ann, lamp = await begin(scene, pipe(CHATTER, POWER))
    lamp.goes()
    scene.passes(0.3)
    assert await scene.state(ann) == ("waiting", "waiting for program lamp, which is not connected")
    scene.sends(text("lost"))
    lamp.comes()
    scene.passes(0.3)
    assert await scene.state(ann) == ("running", "")
    scene.answers()
    scene.sends(text("on"))
    assert lamp.asked == [("set", "power", '"on"')]


@pytest_twisted.ensureDeferred
async def test_another_users_program_is_not_reached(scene: PipeScene) -> None:
    store = scene.front.store
    await begin(scene, pipe(CHATTER, COPY))
    bob = await store.write(queries.add_user, "bob", None)
    await store.write(queries.grant_right, scene.front.rover.id, "operator", user_id=bob.id)
    user = pipe_user(await scene.front.by_token(bob), HERE)
    await scene.service.add(user, NewPipe(name="bobs", source=POWER, target=COPY))
    scene.answers()
    assert await scene.state(user, "bobs") == ("waiting", "waiting for program lamp, which is not connected")


@pytest_twisted.ensureDeferred
async def test_it_ends_with_the_right_at_its_robot(scene: PipeScene) -> None:
    ann, lamp = await begin(scene, pipe(POWER, COPY))
    front = scene.front
    await front.store.write(
        queries.grant_right, front.rover.id, "operator", user_id=front.ann.id, deny=["publish:/copy"]
    )
    await front.access.refresh()
    await settled(scene)
    state, why = await scene.state(ann)
    assert (state, "/copy" in why) == ("refused", True)
    assert lamp.publishes('"on"') == 0


# --- programs that move the robot ----------------------------------------------------------------------------


async def stopped(scene: PipeScene, lamp: Lamp) -> None:
    scene.front.bus.publish("robot.stopped", scene.world.robot.robot_id)


async def disconnected(scene: PipeScene, lamp: Lamp) -> None:
    lamp.goes()
    scene.passes(0.3)


async def connected_again(scene: PipeScene, lamp: Lamp) -> None:
    lamp.goes()
    lamp.comes()
    lamp.publishes("1")


@pytest.mark.parametrize("ends", [stopped, disconnected, connected_again])
@pytest_twisted.ensureDeferred
async def test_a_program_drives_by_control_and_never_begins_again_by_itself(
    scene: PipeScene, ends: Any
) -> None:
    ann, lamp = await begin(scene, pipe(POWER, DRIVE, *SPEED))
    lamp.publishes("1")
    scene.passes(0.01)
    holder = scene.world.controllers.of(scene.world.robot).lease.holder
    assert holder is not None and holder.client.address == "pipe copy"
    carried = len(scene.carried)
    assert carried == 1
    await ends(scene, lamp)
    await settled(scene)
    assert (await scene.state(ann))[0] == "refused"
    lamp.publishes("1")
    scene.passes(30)
    lamp.publishes("1")
    assert len(scene.carried) == carried


# --- settings ------------------------------------------------------------------------------------------------

ENDS = [
    '{"robot": "rover"}',
    '{"robot": "rover", "topic": "/a", "port": "power"}',
    '{"robot": "rover", "program": "lamp", "port": "power"}',
    '{"program": "lamp"}',
    '{"program": "lamp", "port": "power", "function": "blink"}',
    '{"program": "lamp", "port": "power", "type": "std_msgs/msg/Bool"}',
    '{"topic": "/a"}',
]


@pytest.mark.parametrize("body", ENDS)
def test_an_end_is_at_a_robot_or_a_program(body: str) -> None:
    with pytest.raises(msgspec.ValidationError, match="or a 'program' and a 'port' or a 'function'"):
        msgspec.json.decode(body, type=PipeEnd)


@pytest_twisted.ensureDeferred
async def test_settings_that_can_not_be_used_are_refused(scene: PipeScene) -> None:
    ann, _ = await begin(scene, pipe(CHATTER, POWER))
    for new, reason in (
        (pipe(POWER, BLINK), "one end of a pipe is at a robot"),
        (pipe(POWER, COPY, rate=MAX_POLLS + 1), "a program can be called 50 times a second"),
    ):
        with pytest.raises(Invalid, match=reason):
            await scene.service.add(ann, new)
    with pytest.raises(Refused, match=r"feed itself \(back → copy → back\)"):
        await scene.service.add(
            ann, NewPipe(name="back", source=POWER, target=PipeEnd("rover", "/chatter", STRING))
        )


@pytest_twisted.ensureDeferred
async def test_a_program_without_the_port_refuses_the_pipe(scene: PipeScene) -> None:
    ann, _ = await begin(scene, pipe(CHATTER, PipeEnd(program="lamp", port="colour")))
    await settled(scene)
    assert await scene.state(ann) == ("refused", "program lamp has no port 'colour'; it has power")
