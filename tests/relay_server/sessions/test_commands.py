"""Commands carry their source, and pass only while it controls the robot."""

from __future__ import annotations

import json
from typing import Any

import pytest

from relay_protocol import link
from relay_protocol.link.motion import ControlOrder
from relay_protocol.rights import Level
from relay_server.control.actor import Actor
from relay_server.control.types import ControlRules
from relay_server.sessions import publishing as module
from relay_server.sessions import service_calls
from tests.worlds.relay import FIBONACCI, STRING, TRIGGER, TWIST, Person, World

STOP = {"linear": {"x": 0.0}}
GO = {"linear": {"x": 0.5}}
NOT_DONE = "robot rover did not answer within 3 s"


def describe(world: World, **motion: Any) -> None:
    """Sets the robot's motion policy."""
    world.registry.described(world.robot, link.Describe(motion=link.MotionPolicy(types=[TWIST], **motion)))


def at_work(world: World, encoding: str = "json") -> None:
    """The robot is online; a viewer keeps its channel open."""
    world.robot_comes(encodings=[encoding])
    world.person(Level.VIEWER, user=99, name="watcher")
    world.robot_joins()


def driver(world: World, name: str, user: int, level: Level = Level.OPERATOR) -> Person:
    """A client that advertises and receives errors."""
    person = world.person(level, user=user, name=name)
    person.says("set_level", level="error")
    person.says("advertise", topic="/cmd_vel", type=TWIST)
    return person


def drive(person: Person, msg: Any = GO) -> None:
    """Sends a fresh command."""
    person.rosbridge.ping()
    person.answers_pings()
    person.says("publish", topic="/cmd_vel", msg=msg)


def silent(world: World) -> list[ControlOrder]:
    """The robot answers no order from now on; returns its orders."""
    ordered: list[ControlOrder] = []
    world.control.obeys = ordered.append
    return ordered


def obey(world: World, order: ControlOrder) -> None:
    """The robot confirms this order."""
    world.controllers.of(world.robot).message_received(link.OrderResult(id=order.id))


@pytest.mark.parametrize("encoding", ["json", "cdr"])
def test_commands_carry_the_number_of_their_connection(world: World, encoding: str) -> None:
    """Only to topics that count as motion; other topics get samples."""
    at_work(world, encoding)
    ann = driver(world, "ann", 1)
    ann.says("advertise", topic="/chatter", type=STRING)
    world.define()
    drive(ann)
    ann.says("publish", topic="/chatter", msg={"data": "hello"})
    assert [source for _, _, source, _ in world.link.commands] == [ann.context.number]
    assert len(world.link.samples) == 2
    (control,) = world.control.all(link.ControlGrant)
    assert (control.holder, control.user, control.level) == (ann.context.number, "ann", "operator")


def test_a_robot_marks_a_motion_topic_when_it_advertises_it(world: World) -> None:
    """A topic that is advertised with motion gets commands, even if the description did not list it."""
    at_work(world)
    ann = world.person(user=1)
    ann.says("advertise", topic="/chatter", type=STRING)
    (ask,) = world.link.all(link.Advertise)
    world.channel.message(
        link.Advertised(number=ask.number, topic="/chatter", type=STRING, encoding="json", motion=True)
    )
    ann.says("publish", topic="/chatter", msg={"data": "hello"})
    assert [source for _, _, source, _ in world.link.commands] == [ann.context.number]


@pytest.mark.parametrize("number", ["NaN", "null"])
def test_a_command_that_is_not_finite_acquires_no_control(world: World, number: str) -> None:
    """Of a free robot. It counts as one that was refused."""
    at_work(world)
    ann = driver(world, "ann", 1)
    world.define()
    ann.rosbridge.ping()
    ann.answers_pings()
    ann.rosbridge.message(
        f'{{"op":"publish","topic":"/cmd_vel","msg":{{"linear":{{"x":{number}}}}}}}'.encode()
    )
    assert ann.reported() == [
        f"publish /cmd_vel: linear.x must be finite in a command that moves the robot, not {number}"
    ]
    assert world.control.all(link.ControlGrant) == []
    assert world.link.commands == []


def test_the_newest_command_waits_until_the_robot_has_agreed(world: World) -> None:
    """Earlier ones are dropped: a program that publishes once is obeyed, and no command is repeated."""
    at_work(world)
    ordered = silent(world)
    ann = driver(world, "ann", 1)
    drive(ann, {"linear": {"x": 0.4}})
    drive(ann, GO)
    assert world.link.commands == []
    assert len(ordered) == 1
    obey(world, ordered[0])
    assert [json.loads(body)["linear"]["x"] for *_, body in world.link.commands] == [0.5]
    drive(ann)
    assert len(world.link.commands) == 2


def test_a_command_that_waited_too_long_is_dropped(world: World) -> None:
    """Its age counts from its sending."""
    at_work(world)
    ordered = silent(world)
    ann = driver(world, "ann", 1)
    drive(ann)
    world.wait(1.0, ann)
    obey(world, ordered[0])
    assert world.link.commands == []
    assert ann.context.stale_commands == 1


def test_waiting_command_is_dropped_when_the_robot_refuses(world: World) -> None:
    """The client gets an error."""
    at_work(world)
    silent(world)
    ann = driver(world, "ann", 1)
    drive(ann)
    world.wait(3.1, ann)
    assert world.link.commands == []
    assert f"you did not get control of rover: {NOT_DONE}" in ann.reported()
    assert not ann.session.publish_handler._waiting


def test_refused_clients_learn_the_holder(world: World) -> None:
    """Their commands are dropped until control is released."""
    at_work(world)
    ann, bob = driver(world, "ann", 1), driver(world, "bob", 2, Level.OWNER)
    drive(ann)
    drive(bob)
    assert bob.reported() == ["robot rover is controlled by ann; ask for it with /relay/take_control"]
    assert bob.context.refusals == 1
    world.controllers.of(world.robot).release(ann.context, "")
    drive(bob)
    assert [source for _, _, source, _ in world.link.commands] == [ann.context.number, bob.context.number]


def take(person: Person) -> None:
    """Takes control explicitly."""
    person.says("call_service", service="/relay/take_control")
    (answer,) = person.received("service_response")
    assert answer["values"]["success"], answer


def passed(world: World) -> list[int]:
    """Sources of commands that have reached the robot since the last call."""
    sources = [source for _, _, source, _ in world.link.commands]
    world.link.commands.clear()
    return sources


def losing(world: World) -> Person:
    """A client that still commands after an owner has taken control from it."""
    at_work(world)
    ann = driver(world, "ann", 1)
    drive(ann)
    world.controllers.of(world.robot).release(ann.context, "", Actor("olga", "user:olga"))
    for _ in range(20):
        world.wait(0.1, ann)
        drive(ann)
    assert passed(world) == [ann.context.number]
    return ann


def test_taking_control_without_a_release_moves_nothing(world: World) -> None:
    """For any time of continued commands; a pause of half a second counts as a release."""
    ann = losing(world)
    take(ann)
    for _ in range(10):
        drive(ann)
        assert "release the controls first: you went on commanding /cmd_vel" in ann.reported()[0]
        world.wait(0.1, ann)
    assert passed(world) == []
    world.wait(0.5, ann)
    drive(ann)
    drive(ann)
    assert passed(world) == [ann.context.number] * 2


def test_a_link_that_stalls_is_no_release(world: World) -> None:
    """Delayed commands may have been sent without a pause; an answered ping would prove one."""
    ann = losing(world)
    world.robot.description = link.Describe(motion=link.MotionPolicy(types=[TWIST], deadline_ms=2000))
    take(ann)
    drive(ann)
    world.wait(1.0)
    ann.says("publish", topic="/cmd_vel", msg=GO)
    assert ["release the controls first" in each for each in ann.reported()] == [True, True]
    assert passed(world) == []
    world.wait(0.7, ann)
    drive(ann)
    assert passed(world) == [ann.context.number]


def test_a_zero_is_a_release(world: World) -> None:
    """With and without control."""
    ann = losing(world)
    take(ann)
    drive(ann)
    assert passed(world) == []
    drive(ann, STOP)
    drive(ann)
    assert passed(world) == [ann.context.number] * 2
    world.controllers.of(world.robot).release(ann.context, "", Actor("olga", "user:olga"))
    drive(ann)
    drive(ann, STOP)
    take(ann)
    drive(ann)
    assert len(passed(world)) == 2


def test_commanding_until_control_is_granted_requires_a_release(world: World) -> None:
    """The commands were refused while another client had control. A command that waits for the robot's answer
    is dropped.
    """
    at_work(world)
    ann, bob = driver(world, "ann", 1), driver(world, "bob", 2)
    drive(ann)
    bob.says("call_service", service="/relay/take_control")
    drive(bob)
    ordered = silent(world)
    world.controllers.of(world.robot).grant(ann.context, "")
    drive(bob)
    obey(world, ordered[-1])
    assert "release the controls first" in bob.reported()[-1]
    assert passed(world) == [ann.context.number]
    drive(bob, STOP)
    drive(bob)
    assert passed(world) == [bob.context.number] * 2


def test_old_commands_and_commands_to_an_offline_robot_are_no_release(world: World) -> None:
    """They only prove that the joystick is still held."""
    ann = losing(world)
    for _ in range(4):
        world.clock.pump([0.3])
        ann.says("publish", topic="/cmd_vel", msg=GO)
    ann.says("publish", topic="/cmd_vel", msg=STOP)
    assert ann.context.stale_commands == 4
    take(ann)
    drive(ann)
    assert "release the controls first" in ann.reported()[-1]
    world.wait(0.6, ann)
    drive(ann)
    assert passed(world) == [ann.context.number]
    world.robot_goes()
    drive(ann)
    world.robot_comes(encodings=["json"])
    world.robot_joins()
    take(ann)
    drive(ann)
    assert "release the controls first" in ann.reported()[-1]
    assert passed(world) == []


def test_a_new_connection_that_takes_control_begins_at_once(world: World) -> None:
    """No command on it has been refused."""
    ann = losing(world)
    ann.session.end()
    again = driver(world, "ann", 1)
    take(again)
    drive(again)
    assert passed(world) == [again.context.number]


def test_suppression_needs_no_release(world: World) -> None:
    """Suppressing programs command without pauses."""
    at_work(world)
    ann, olga = driver(world, "ann", 1), driver(world, "olga", 2, Level.OWNER)
    drive(ann)
    drive(olga)
    by = Actor("olga", "user:olga")
    world.controllers.of(world.robot).suppression.suppress(by, [olga.context.number], "/cmd_vel", 200)
    drive(olga)
    assert passed(world) == [ann.context.number, olga.context.number]


def test_a_zero_takes_no_free_robot(world: World) -> None:
    """It is passed on, and the robot decides. The first command that moves takes control."""
    at_work(world)
    ann = driver(world, "ann", 1)
    for _ in range(3):
        drive(ann, STOP)
    assert world.control.all(link.ControlGrant) == []
    assert passed(world) == [ann.context.number] * 3
    assert ann.reported() == []
    drive(ann)
    assert [each.holder for each in world.control.all(link.ControlGrant)] == [ann.context.number]


def test_a_zero_takes_back_a_command_that_waits_for_control(world: World) -> None:
    """The joystick has been released meanwhile."""
    at_work(world)
    ordered = silent(world)
    ann = driver(world, "ann", 1)
    drive(ann)
    drive(ann, STOP)
    obey(world, ordered[0])
    assert [json.loads(body)["linear"]["x"] for *_, body in world.link.commands] == [0.0]


def test_a_zero_takes_control_from_no_client(world: World) -> None:
    """This includes the user's own other connection, from which a command would take control."""
    at_work(world)
    ann, second, bob = driver(world, "ann", 1), driver(world, "ann", 1), driver(world, "bob", 2)
    drive(ann)
    world.wait(3, ann, second, bob)
    for each in (second, bob):
        drive(each, STOP)
        assert "controlled by ann" in each.reported()[0]
    assert passed(world) == [ann.context.number]
    drive(second)
    assert passed(world) == [second.context.number]


def test_motion_topic_of_other_type_may_carry_a_goal_of_zeros(world: World) -> None:
    """It takes control as any command does."""
    at_work(world)
    describe(world, topics=["/goal_pose"])
    ann = driver(world, "ann", 1)
    ann.says("publish", topic="/goal_pose", type=STRING, msg={"data": ""})
    assert [each.holder for each in world.control.all(link.ControlGrant)] == [ann.context.number]


@pytest.mark.parametrize(
    ("msg", "stopped", "held"), [(GO, False, True), (STOP, False, False), (GO, True, False)]
)
def test_only_commands_that_move_the_robot_keep_control_of_it(
    world: World, msg: Any, stopped: bool, held: bool
) -> None:
    """Zero commands do not, nor do commands to a stopped robot."""
    at_work(world)
    ann = driver(world, "ann", 1)
    take(ann)
    if stopped:
        world.controllers.of(world.robot).message_received(
            link.MotionState(stopped=link.Stopped(by="bob", since=1.0))
        )
    for _ in range(61):
        world.wait(10, ann)
        drive(ann, msg)
    lost = [why for kind, _, why, _ in world.record.notes if kind == "control.lost"]
    assert lost == ([] if held else ["no moving command for 600 s"])
    assert len(passed(world)) >= 59


def test_leaving_a_stopped_robot_is_no_release(world: World) -> None:
    """Commands that do not keep control still mean that the joystick is held."""
    at_work(world)
    ann = driver(world, "ann", 1)
    drive(ann)
    world.controllers.of(world.robot).message_received(
        link.MotionState(stopped=link.Stopped(by="bob", since=1.0))
    )
    world.wait(5, ann)
    drive(ann)
    ann.session.end()
    again = driver(world, "ann", 1)
    drive(again)
    assert "release the controls for 0.5 s" in again.reported()[-1]


def test_control_ends_with_the_session(world: World) -> None:
    """The robot is notified before another client gets control; after a lost robot control is taken again."""
    at_work(world)
    ann, bob = driver(world, "ann", 1), driver(world, "bob", 2)
    drive(ann)
    ann.session.end()
    drive(bob)
    assert [each.holder for each in world.control.all(link.ControlGrant)] == [
        ann.context.number,
        0,
        bob.context.number,
    ]
    world.robot_goes()
    world.robot_comes(encodings=["json"])
    world.robot_joins()
    drive(bob)
    assert world.control.all(link.ControlGrant) == [], "he has not let go"
    world.clock.advance(0.6)
    drive(bob)
    assert [each.holder for each in world.control.all(link.ControlGrant)] == [bob.context.number]


def test_commanding_needs_the_right_to_control(world: World) -> None:
    """The right to publish is not enough."""
    at_work(world)
    ann = world.person(deny=("control:/",), user=1)
    ann.says("set_level", level="error")
    ann.says("advertise", topic="/cmd_vel", type=TWIST)
    drive(ann)
    assert "denied to you by 'control:/'" in ann.reported()[0]
    assert world.link.commands == []


def test_suppression_gives_command_of_a_topic(world: World) -> None:
    """The controller's commands reach the robot too, which decides."""
    at_work(world)
    ann, olga = driver(world, "ann", 1), driver(world, "olga", 2, Level.OWNER)
    drive(ann)
    by = Actor("olga", "user:olga")
    world.controllers.of(world.robot).suppression.suppress(by, [olga.context.number], "/cmd_vel", 200)
    drive(olga)
    drive(ann)
    assert [source for _, _, source, _ in world.link.commands] == [
        each.context.number for each in (ann, olga, ann)
    ]
    world.wait(1.0, ann, olga)
    drive(olga)
    assert "controlled by ann" in olga.reported()[-1]


@pytest.mark.parametrize(
    ("last", "silent", "moving"),
    [
        ([GO], 0.0, True),
        ([GO, STOP], 0.0, False),
        ([GO], 2.0, False),
        ([STOP], 0.0, False),
        ([{"linear": {"x": 0.5}, "pad": [0] * 5000}], 0.0, True),
    ],
)
def test_lost_driver_loses_control_of_a_moving_robot(
    world: World, last: list[Any], silent: float, moving: bool
) -> None:
    """Some seconds after the robot has stopped itself. This excludes clients that sent zero or answered pings
    since it stands.
    """
    at_work(world)
    ann = driver(world, "ann", 1)
    ann.says("call_service", service="/relay/take_control")
    controller = world.controllers.of(world.robot)
    for each in last:
        drive(ann, each)
    controller.message_received(link.MotionState(holder=ann.context.number, moving=last[0] is not STOP))
    world.clock.advance(0.4)
    controller.message_received(link.MotionState(holder=ann.context.number))
    if silent:
        world.wait(silent, ann)
    world.wait(10.0)
    assert ann.client.closed is not None
    assert world.record.notes[-1][0] == "control.lost"
    assert world.record.notes[-1][3] == {"moving": moving}


def test_where_control_is_explicit_the_refusal_has_advice(world: World) -> None:
    """No command takes control."""
    world.controllers._rules = ControlRules(explicit=True)
    at_work(world)
    ann = driver(world, "ann", 1)
    drive(ann)
    assert "take control first" in ann.reported()[0]
    ann.says("call_service", service="/relay/take_control")
    drive(ann)
    assert len(world.link.commands) == 1


def test_a_decision_holds_while_no_other_client_takes_control(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A robot that reports motion does not change the decision."""
    at_work(world)
    ann = driver(world, "ann", 1)
    drive(ann)
    drive(ann)
    looked: list[str] = []
    real = module.PublishHandler._decide
    monkeypatch.setattr(
        module.PublishHandler, "_decide", lambda self, ask: (looked.append(ask.topic), real(self, ask))[1]
    )
    drive(ann)
    world.controllers.of(world.robot).message_received(
        link.MotionState(holder=ann.context.number, moving=True)
    )
    drive(ann)
    assert looked == []
    world.controllers.of(world.robot).message_received(
        link.MotionState(stopped=link.Stopped(by="bob", since=1.0))
    )
    drive(ann)
    assert looked == ["/cmd_vel"]


def test_commands_that_wait_are_bounded(world: World) -> None:
    """By topics and by size; commands over the limit get an error."""
    at_work(world)
    describe(world, topics=["/arm/*"])
    ordered = silent(world)
    ann = driver(world, "ann", 1)
    for number in range(module.WAITING_TOPICS + 1):
        ann.says("publish", topic=f"/arm/j{number}", type=STRING, msg={"data": "go"})
    assert "a command to /arm/j16 can't wait for it" in ann.reported()[0]
    ann.says("publish", topic="/arm/j0", msg={"data": "x" * module.WAITING_BYTES})
    assert "can't wait" in ann.reported()[0]
    assert len(ordered) == 1


def test_a_call_that_moves_the_robot_takes_control(world: World) -> None:
    """It is sent when the robot has agreed, with its client; other clients' calls are refused."""
    at_work(world)
    describe(world, services=["/reset"])
    ordered = silent(world)
    ann, bob = driver(world, "ann", 1), driver(world, "bob", 2)
    ann.says("call_service", service="/reset", type=TRIGGER)
    assert world.link.all(link.CallService) == []
    obey(world, ordered[0])
    (call,) = world.link.all(link.CallService)
    assert call.source == ann.context.number
    bob.says("call_service", id="b", service="/reset", type=TRIGGER)
    (answer,) = bob.received("service_response")
    assert answer["result"] is False
    assert "controlled by ann" in answer["values"]


def test_a_call_that_moves_nothing_names_its_client_too(world: World) -> None:
    """It needs no control."""
    at_work(world)
    ann = driver(world, "ann", 1)
    ann.says("call_service", service="/reset", type=TRIGGER)
    (call,) = world.link.all(link.CallService)
    assert call.source == ann.context.number
    assert world.control.all(link.ControlGrant) == []


def test_a_goal_that_moves_the_robot_takes_control_and_keeps_it(world: World) -> None:
    """It counts as a command while it is executed; its hidden services need control too."""
    at_work(world)
    describe(world, actions=["/dock"])
    ann, bob = driver(world, "ann", 1), driver(world, "bob", 2)
    ann.says("send_action_goal", id="g", action="/dock", action_type=FIBONACCI, args={"order": 1})
    (goal,) = world.link.all(link.SendActionGoal)
    assert goal.source == ann.context.number
    bob.says("send_action_goal", id="g", action="/dock", action_type=FIBONACCI, args={"order": 1})
    (answer,) = bob.received("action_result")
    assert "controlled by ann" in answer["values"]
    bob.says("call_service", service="/dock/_action/send_goal", type=TRIGGER)
    assert "controlled by ann" in bob.received("service_response")[0]["values"]
    world.wait(700, ann, bob)
    assert world.controllers.of(world.robot).lease.held_by(ann.context)
    world.channel.message(link.ActionResult(id=goal.id, status=4, result=False, reason="done"))
    world.wait(700, ann, bob)
    assert world.controllers.of(world.robot).lease.holder is None


def test_exhausted_quota_allows_stop_and_release(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    """A stop waits neither for a quota nor for pending calls."""
    at_work(world)
    ann = driver(world, "ann", 1)
    drive(ann)
    monkeypatch.setattr(service_calls, "CALLS", 1)
    ann.says("call_service", service="/reset", type=TRIGGER)
    ann.says("call_service", id="more", service="/reset", type=TRIGGER)
    assert "calls of this connection are waiting" in ann.received("service_response")[0]["values"]
    ann.context.quota.user.requests.spend(3.0)
    ann.says("call_service", id="ping", service="/relay/ping")
    assert "your share" in ann.received("service_response")[0]["values"]
    ann.says("call_service", id="stop", service="relay/stop")
    ann.says("call_service", id="go", service="/relay/release_control")
    assert [each["values"]["success"] for each in ann.received("service_response")] == [True, True]
    assert len(world.control.all(link.Stop)) == 1
    assert world.controllers.of(world.robot).lease.holder is None
