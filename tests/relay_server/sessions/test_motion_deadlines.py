"""Calls and goals that move the robot have the deadline of commands, after every wait."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest

from relay_protocol import link
from relay_protocol.link.motion import ControlOrder
from relay_protocol.rights import Level
from tests.worlds.relay import FIBONACCI, TRIGGER, TWIST, Person, World

ASKS = ["call", "goal", "hidden service"]


def describe(world: World) -> None:
    """The robot's motion policy."""
    motion = link.MotionPolicy(types=[TWIST], services=["/reset"], actions=["/dock"])
    world.registry.described(world.robot, link.Describe(motion=motion))


class Scene:
    """A robot whose service ``/reset`` and action ``/dock`` move it, while ``/lamp`` and ``/count`` do not."""

    def __init__(self, world: World) -> None:
        self.world = world
        world.robot_comes(encodings=["json"])
        world.person(Level.VIEWER, user=99, name="watcher")
        world.robot_joins()
        describe(world)
        self.ordered: list[ControlOrder] = []

    def person(self) -> Person:
        """A client that has answered its first ping."""
        person = self.world.person()
        person.says("set_level", level="error")
        self.fresh(person)
        return person

    def fresh(self, person: Person) -> None:
        """It answers a ping."""
        person.rosbridge.ping()
        person.answers_pings()

    def slow(self) -> None:
        """The robot answers no order from now on."""
        self.world.control.obeys = self.ordered.append

    def agrees(self) -> None:
        """The robot confirms its first order."""
        self.world.controllers.of(self.world.robot).message_received(link.OrderResult(id=self.ordered[0].id))

    def asked(self) -> list[Any]:
        """Calls and goals that reached the robot."""
        return [*self.world.link.all(link.CallService), *self.world.link.all(link.SendActionGoal)]


@pytest.fixture
def scene(world: World) -> Scene:
    """The robot is online, and a viewer keeps its channel open."""
    return Scene(world)


@pytest.mark.parametrize("number", ["NaN", "null"])
@pytest.mark.parametrize("moves", [True, False])
@pytest.mark.parametrize("how", ["call", "goal"])
def test_a_request_that_moves_the_robot_has_only_finite_numbers(
    scene: Scene, how: str, moves: bool, number: str
) -> None:
    """Others may have NaN; a robot that speaks JSON gets ``null`` then."""
    person = scene.person()
    args = f'{{"to":{{"x":[1,{number}]}}}}'
    if how == "goal":
        action = "/dock" if moves else "/count"
        text = (
            f'"op":"send_action_goal","id":"a","action":"{action}","action_type":"a/action/Own","args":{args}'
        )
    else:
        service = "/reset" if moves else "/lamp"
        text = f'"op":"call_service","id":"a","service":"{service}","type":"a/srv/Own","args":{args}'
    person.rosbridge.message(f"{{{text}}}".encode())
    scene.world.clock.advance(0.1)
    reported = person.reported()
    assert len(scene.asked()) == (not moves)
    assert reported == (
        [f"to.x[1] must be finite in a command that moves the robot, not {number}"] if moves else []
    )
    if moves:
        assert not scene.world.controllers.of(scene.world.robot).lease.held_by(person.context)


def ask(person: Person, how: str, moves: bool = True) -> None:
    """The client sends a request."""
    action, service = ("/dock", "/reset") if moves else ("/count", "/lamp")
    if how == "goal":
        person.says("send_action_goal", id="a", action=action, action_type=FIBONACCI, args={"order": 1})
    elif how == "call":
        person.says("call_service", id="a", service=service, type=TRIGGER)
    else:
        person.says("call_service", id="a", service=f"{action}/_action/send_goal", type=TRIGGER)


def reasons(person: Person) -> list[str]:
    """Reasons of its refused requests."""
    heard = [each for each in person.client.take() if each["op"] in ("service_response", "action_result")]
    assert not any(each["result"] for each in heard)
    return [each["values"] for each in heard]


@pytest.mark.parametrize("how", ASKS)
def test_possibly_old_command_is_dropped_without_taking_control(scene: Scene, how: str) -> None:
    """A client that has answered no ping for 4.5 s gets an error, which is counted; after a pong the command
    passes.
    """
    person = scene.person()
    scene.world.clock.advance(4.5)
    ask(person, how)
    (reason,) = reasons(person)
    assert "was refused: it may be 4500 ms old, by the last ping answered" in reason
    assert "the robot takes none older than 500 ms" in reason
    assert scene.asked() == []
    assert scene.world.control.all(link.ControlGrant) == []
    assert person.context.stale_commands == 1
    scene.fresh(person)
    ask(person, how)
    assert len(scene.asked()) == 1
    assert person.context.stale_commands == 1


@pytest.mark.parametrize("how", ASKS)
def test_up_to_the_robots_own_deadline_it_goes(scene: Scene, how: str) -> None:
    """The robot gets the earliest sending time, to decide itself."""
    person = scene.person()
    sent = scene.world.now_ns()
    scene.world.clock.advance(0.5)
    ask(person, how)
    (asked,) = scene.asked()
    assert asked.stamp == sent
    assert asked.source == person.context.number


@pytest.mark.parametrize("how", ASKS)
def test_message_without_motion_passes_at_any_age(scene: Scene, how: str) -> None:
    """With its stamp, since the robot alone decides what moves it."""
    person = scene.person()
    sent = scene.world.now_ns()
    scene.world.clock.advance(4.5)
    ask(person, how, moves=False)
    assert [each.stamp for each in scene.asked()] == [sent]
    assert person.context.stale_commands == 0


@pytest.mark.parametrize("how", ASKS)
@pytest.mark.parametrize(("seconds", "goes"), [(0.4, True), (0.6, False)])
def test_it_is_judged_again_when_it_has_waited_for_control(
    scene: Scene, how: str, seconds: float, goes: bool
) -> None:
    """Its age at that time counts; later messages of the client do not matter."""
    scene.slow()
    person = scene.person()
    ask(person, how)
    scene.world.clock.advance(seconds)
    scene.fresh(person)
    scene.agrees()
    assert bool(scene.asked()) is goes
    assert person.context.stale_commands == (0 if goes else 1)
    if not goes:
        assert "it may be 600 ms old" in reasons(person)[0]


@pytest.mark.parametrize("how", ASKS)
@pytest.mark.parametrize(("seconds", "goes"), [(0.4, True), (0.6, False)])
def test_it_is_judged_again_when_it_has_waited_for_the_channel(
    world: World, how: str, seconds: float, goes: bool
) -> None:
    """It must not reach a robot that connects late, nor take control again."""
    world.robot_comes(encodings=["json"])
    person = world.person()
    describe(world)
    ask(person, how)
    controller = world.controllers.of(world.robot)
    assert controller.lease.held_by(person.context)
    controller.release(person.context, "")
    world.clock.advance(seconds)
    robot = world.robot_joins()
    assert bool(robot.all(link.CallService) + robot.all(link.SendActionGoal)) is goes
    assert controller.lease.held_by(person.context) is goes
    assert person.context.stale_commands == (0 if goes else 1)
    assert len(reasons(person)) == (0 if goes else 1)


@pytest.mark.parametrize("how", ["call", "goal"])
def test_it_is_judged_again_when_it_has_waited_for_a_type(world: World, how: str) -> None:
    """The robot sent the definition late."""
    world.robot_comes(encodings=["cdr"])
    world.person(Level.VIEWER, user=99, name="watcher")
    world.robot_joins()
    describe(world)
    person = world.person()
    ask(person, how)
    world.clock.advance(0.6)
    world.define()
    assert not world.link.all(link.CallService)
    assert not world.link.all(link.SendActionGoal)
    assert "it may be 600 ms old" in reasons(person)[0]
    ask(person, how)
    assert person.context.stale_commands == 2, "it has answered no ping since"


def test_a_parameter_that_moves_the_robot_is_as_old_as_the_message_that_set_it(world: World) -> None:
    """This includes waiting for its type."""
    types = {"get": "rcl_interfaces/srv/GetParameters", "set": "rcl_interfaces/srv/SetParameters"}
    graph = link.Graph(
        full=True,
        services={
            f"/base/{verb}_parameters": link.Service(types=[name], providers=["/base"])
            for verb, name in types.items()
        },
        nodes={"/base": {}},
    )
    world.robot_comes(encodings=["json"], graph=graph)
    world.person(Level.VIEWER, user=99, name="watcher")
    world.robot_joins()
    motion = link.MotionPolicy(services=["/base/set_parameters"])
    world.registry.described(world.robot, link.Describe(motion=motion))
    person = world.person()
    person.says("call_service", service="/rosapi/set_param", args={"name": "/base:speed", "value": "1"})
    (asked,) = world.link.take(link.CallService)
    world.clock.advance(0.6)
    person.rosbridge.ping()
    person.answers_pings()
    values = msgspec.Raw(b'{"values": [{"type": 2}]}')
    world.channel.message(link.ServiceResponse(id=asked.id, result=True, values=values))
    assert not world.link.all(link.CallService)
    (answer,) = person.received("service_response")
    assert answer["values"]["successful"] is False
    assert "it may be 600 ms old" in answer["values"]["reason"]
    assert world.control.all(link.ControlGrant) == []
