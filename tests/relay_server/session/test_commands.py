"""Commands carry their source, and pass only while it controls the robot."""

from __future__ import annotations

from typing import Any

import pytest

from relay_protocol import link
from relay_protocol.link.motion import Order
from relay_protocol.rights import Level
from relay_server.control.audit import Actor
from relay_server.control.types import ControlRules
from relay_server.sessions import publishing as module
from relay_server.sessions import service_calls
from tests.relay_server.memory import FIBONACCI, STRING, TRIGGER, TWIST, Person, World

STOP = {"linear": {"x": 0.0}}
GO = {"linear": {"x": 0.5}}
NOT_DONE = "robot rover did not answer within 3 s"


def describe(world: World, **motion: Any) -> None:
    """What the robot counts as motion."""
    world.registry.described(world.robot, link.Describe(motion=link.MotionPolicy(types=[TWIST], **motion)))


def at_work(world: World, encoding: str = "json") -> None:
    """The robot is there; somebody keeps its channel open."""
    world.robot_comes(encodings=[encoding])
    world.person(Level.VIEWER, user=99, name="watcher")
    world.robot_joins()


def driver(world: World, name: str, user: int, level: Level = Level.OPERATOR) -> Person:
    """Somebody who advertises and wants to hear of errors."""
    person = world.person(level, user=user, name=name)
    person.says("set_level", level="error")
    person.says("advertise", topic="/cmd_vel", type=TWIST)
    return person


def drive(person: Person, msg: Any = GO) -> None:
    """A fresh command."""
    person.session._pinging.ping()
    person.answers_pings()
    person.says("publish", topic="/cmd_vel", msg=msg)


def silent(world: World) -> list[Order]:
    """The robot answers no order from now on; what it is ordered."""
    ordered: list[Order] = []
    world.control.obeys = ordered.append
    return ordered


def obey(world: World, order: Order) -> None:
    """It has done this one."""
    world.desks.of(world.robot).told(link.Done(id=order.id))


@pytest.mark.parametrize("encoding", ["json", "cdr"])
def test_commands_carry_the_number_of_their_connection(world: World, encoding: str) -> None:
    """To topics that count as motion; what goes elsewhere is a sample."""
    at_work(world, encoding)
    ann = driver(world, "ann", 1)
    ann.says("advertise", topic="/chatter", type=STRING)
    world.define()
    drive(ann)
    ann.says("publish", topic="/chatter", msg={"data": "hello"})
    assert [source for _, _, source, _ in world.link.commands] == [ann.session.number]
    assert len(world.link.samples) == 2
    (control,) = world.control.all(link.Control)
    assert (control.holder, control.user, control.level) == (ann.session.number, "ann", "operator")


def test_a_robot_says_at_last_what_it_counts_as_motion(world: World) -> None:
    """A topic it advertises with motion gets commands, though its description did not say so."""
    at_work(world)
    ann = world.person(user=1)
    ann.says("advertise", topic="/chatter", type=STRING)
    (ask,) = world.link.all(link.Advertise)
    world.channel.message(
        link.Advertised(number=ask.number, topic="/chatter", type=STRING, encoding="json", motion=True)
    )
    ann.says("publish", topic="/chatter", msg={"data": "hello"})
    assert [source for _, _, source, _ in world.link.commands] == [ann.session.number]


def test_the_newest_command_waits_until_the_robot_has_agreed(world: World) -> None:
    """What came before it is dropped: a program that publishes once is obeyed, and nothing is done twice."""
    at_work(world)
    ordered = silent(world)
    ann = driver(world, "ann", 1)
    drive(ann, {"linear": {"x": 0.4}})
    drive(ann, GO)
    assert world.link.commands == []
    assert len(ordered) == 1
    obey(world, ordered[0])
    assert [body for *_, body in world.link.commands] == [b'{"linear": {"x": 0.5}}']
    drive(ann)
    assert len(world.link.commands) == 2


def test_a_command_that_waited_too_long_is_dropped(world: World) -> None:
    """Its age is that of its sending."""
    at_work(world)
    ordered = silent(world)
    ann = driver(world, "ann", 1)
    drive(ann)
    world.wait(1.0, ann)
    obey(world, ordered[0])
    assert world.link.commands == []
    assert ann.session.stale_commands == 1


def test_what_waited_is_dropped_when_the_robot_does_not_agree(world: World) -> None:
    """And the client is told."""
    at_work(world)
    silent(world)
    ann = driver(world, "ann", 1)
    drive(ann)
    world.wait(3.1, ann)
    assert world.link.commands == []
    assert f"you did not get control of rover: {NOT_DONE}" in ann.told()
    assert not ann.session.publishing._waiting


def test_others_are_told_who_controls_the_robot(world: World) -> None:
    """Their commands go nowhere, until it is given back."""
    at_work(world)
    ann, bob = driver(world, "ann", 1), driver(world, "bob", 2, Level.OWNER)
    drive(ann)
    drive(bob)
    assert bob.told() == ["robot rover is controlled by ann; ask for it with /relay/take_control"]
    assert bob.session.refusals == 1
    world.desks.of(world.robot).release(ann.session, "")
    drive(bob)
    assert [source for _, _, source, _ in world.link.commands] == [ann.session.number, bob.session.number]


def take(person: Person) -> None:
    """Take control explicitly."""
    person.says("call_service", service="/relay/take_control")
    (answer,) = person.hears("service_response")
    assert answer["values"]["success"], answer


def passed(world: World) -> list[int]:
    """Whose commands have come to the robot; they are forgotten."""
    sources = [source for _, _, source, _ in world.link.commands]
    world.link.commands.clear()
    return sources


def losing(world: World) -> Person:
    """Somebody who drives, whom an owner has taken control from, and who has not noticed."""
    at_work(world)
    ann = driver(world, "ann", 1)
    drive(ann)
    world.desks.of(world.robot).release(ann.session, "", Actor("olga", "user:olga"))
    for _ in range(20):
        world.wait(0.1, ann)
        drive(ann)
    assert passed(world) == [ann.session.number]
    return ann


def test_who_never_let_go_moves_nothing_by_taking_control(world: World) -> None:
    """However long he goes on; half a second of silence is letting go."""
    ann = losing(world)
    take(ann)
    for _ in range(10):
        drive(ann)
        assert "let go first: you went on commanding /cmd_vel" in ann.told()[0]
        world.wait(0.1, ann)
    assert passed(world) == []
    world.wait(0.5, ann)
    drive(ann)
    drive(ann)
    assert passed(world) == [ann.session.number] * 2


def test_a_link_that_stalls_is_no_letting_go(world: World) -> None:
    """What it holds up may have been sent without a pause; a ping answered since would tell that it was not."""
    ann = losing(world)
    world.robot.description = link.Describe(motion=link.MotionPolicy(types=[TWIST], deadline_ms=2000))
    take(ann)
    drive(ann)
    world.wait(1.0)
    ann.says("publish", topic="/cmd_vel", msg=GO)
    assert ["let go first" in each for each in ann.told()] == [True, True]
    assert passed(world) == []
    world.wait(0.7, ann)
    drive(ann)
    assert passed(world) == [ann.session.number]


def test_a_zero_is_letting_go(world: World) -> None:
    """With control, and before."""
    ann = losing(world)
    take(ann)
    drive(ann)
    assert passed(world) == []
    drive(ann, STOP)
    drive(ann)
    assert passed(world) == [ann.session.number] * 2
    world.desks.of(world.robot).release(ann.session, "", Actor("olga", "user:olga"))
    drive(ann)
    drive(ann, STOP)
    take(ann)
    drive(ann)
    assert len(passed(world)) == 2


def test_who_holds_on_until_control_is_granted_lets_go_first(world: World) -> None:
    """His commands were refused while another drove; a command that waits for the robot's word waits in vain."""
    at_work(world)
    ann, bob = driver(world, "ann", 1), driver(world, "bob", 2)
    drive(ann)
    bob.says("call_service", service="/relay/take_control")
    drive(bob)
    ordered = silent(world)
    world.desks.of(world.robot).grant(ann.session, "")
    drive(bob)
    obey(world, ordered[-1])
    assert "let go first" in bob.told()[-1]
    assert passed(world) == [ann.session.number]
    drive(bob, STOP)
    drive(bob)
    assert passed(world) == [bob.session.number] * 2


def test_commands_that_are_too_old_or_go_to_a_robot_that_is_away_are_no_letting_go(world: World) -> None:
    """Nothing is known of a hand that they come from but that it is there."""
    ann = losing(world)
    for _ in range(4):
        world.clock.pump([0.3])
        ann.says("publish", topic="/cmd_vel", msg=GO)
    ann.says("publish", topic="/cmd_vel", msg=STOP)
    assert ann.session.stale_commands == 4
    take(ann)
    drive(ann)
    assert "let go first" in ann.told()[-1]
    world.wait(0.6, ann)
    drive(ann)
    assert passed(world) == [ann.session.number]
    world.robot_goes()
    drive(ann)
    world.robot_comes(encodings=["json"])
    world.robot_joins()
    take(ann)
    drive(ann)
    assert "let go first" in ann.told()[-1]
    assert passed(world) == []


def test_a_new_connection_that_takes_control_begins_at_once(world: World) -> None:
    """Nobody has commanded by it in vain."""
    ann = losing(world)
    ann.session.end()
    again = driver(world, "ann", 1)
    take(again)
    drive(again)
    assert passed(world) == [again.session.number]


def test_who_suppresses_a_topic_need_not_let_go_of_it(world: World) -> None:
    """Programs that do command on and on."""
    at_work(world)
    ann, olga = driver(world, "ann", 1), driver(world, "olga", 2, Level.OWNER)
    drive(ann)
    drive(olga)
    by = Actor("olga", "user:olga")
    world.desks.of(world.robot).subsuming.suppress(by, [olga.session.number], "/cmd_vel", 200)
    drive(olga)
    assert passed(world) == [ann.session.number, olga.session.number]


def test_a_zero_takes_no_free_robot(world: World) -> None:
    """It is passed on, as the robot has the last word; the first command that moves takes it."""
    at_work(world)
    ann = driver(world, "ann", 1)
    for _ in range(3):
        drive(ann, STOP)
    assert world.control.all(link.Control) == []
    assert passed(world) == [ann.session.number] * 3
    assert ann.told() == []
    drive(ann)
    assert [each.holder for each in world.control.all(link.Control)] == [ann.session.number]


def test_a_zero_takes_back_a_command_that_waits_for_control(world: World) -> None:
    """The hand has let go meanwhile."""
    at_work(world)
    ordered = silent(world)
    ann = driver(world, "ann", 1)
    drive(ann)
    drive(ann, STOP)
    obey(world, ordered[0])
    assert [body for *_, body in world.link.commands] == [b'{"linear": {"x": 0.0}}']


def test_a_zero_takes_nothing_from_anybody(world: World) -> None:
    """Nor from the user's own other connection, which a command would take it from."""
    at_work(world)
    ann, second, bob = driver(world, "ann", 1), driver(world, "ann", 1), driver(world, "bob", 2)
    drive(ann)
    world.wait(3, ann, second, bob)
    for each in (second, bob):
        drive(each, STOP)
        assert "controlled by ann" in each.told()[0]
    assert passed(world) == [ann.session.number]
    drive(second)
    assert passed(world) == [second.session.number]


def test_what_moves_by_its_name_may_be_a_goal_when_all_is_zero(world: World) -> None:
    """So it takes control as any command does."""
    at_work(world)
    describe(world, topics=["/goal_pose"])
    ann = driver(world, "ann", 1)
    ann.says("publish", topic="/goal_pose", type=STRING, msg={"data": ""})
    assert [each.holder for each in world.control.all(link.Control)] == [ann.session.number]


@pytest.mark.parametrize(
    ("msg", "stopped", "held"), [(GO, False, True), (STOP, False, False), (GO, True, False)]
)
def test_only_commands_that_move_the_robot_keep_control_of_it(
    world: World, msg: Any, stopped: bool, held: bool
) -> None:
    """A program that says zero all day has it no longer than one that is silent; nor who commands a stopped robot."""
    at_work(world)
    ann = driver(world, "ann", 1)
    take(ann)
    if stopped:
        world.desks.of(world.robot).told(link.Safety(stopped=link.Stopped(by="bob", since=1.0)))
    for _ in range(61):
        world.wait(10, ann)
        drive(ann, msg)
    lost = [why for kind, _, why, _ in world.record.notes if kind == "control.lost"]
    assert lost == ([] if held else ["no command for 600 s"])
    assert len(passed(world)) >= 59


def test_who_has_gone_on_commanding_a_stopped_robot_has_not_let_go_by_leaving(world: World) -> None:
    """What keeps no control is a hand on the stick all the same."""
    at_work(world)
    ann = driver(world, "ann", 1)
    drive(ann)
    world.desks.of(world.robot).told(link.Safety(stopped=link.Stopped(by="bob", since=1.0)))
    world.wait(5, ann)
    drive(ann)
    ann.session.end()
    again = driver(world, "ann", 1)
    drive(again)
    assert "let go for 0.5 s" in again.told()[-1]


def test_control_ends_with_the_session(world: World) -> None:
    """The robot is told before anybody else gets it; a lost robot is taken anew."""
    at_work(world)
    ann, bob = driver(world, "ann", 1), driver(world, "bob", 2)
    drive(ann)
    ann.session.end()
    drive(bob)
    assert [each.holder for each in world.control.all(link.Control)] == [
        ann.session.number,
        0,
        bob.session.number,
    ]
    world.robot_goes()
    world.robot_comes(encodings=["json"])
    world.robot_joins()
    drive(bob)
    assert world.control.all(link.Control) == [], "he has not let go"
    world.clock.advance(0.6)
    drive(bob)
    assert [each.holder for each in world.control.all(link.Control)] == [bob.session.number]


def test_who_may_publish_there_but_not_control_does_not_command(world: World) -> None:
    """The right to control is another one."""
    at_work(world)
    ann = world.person(deny=("control:/",), user=1)
    ann.says("set_level", level="error")
    ann.says("advertise", topic="/cmd_vel", type=TWIST)
    drive(ann)
    assert "denied to you by 'control:/'" in ann.told()[0]
    assert world.link.commands == []


def test_who_suppresses_a_topic_commands_it(world: World) -> None:
    """The holder's commands go to the robot too, which judges them."""
    at_work(world)
    ann, olga = driver(world, "ann", 1), driver(world, "olga", 2, Level.OWNER)
    drive(ann)
    by = Actor("olga", "user:olga")
    world.desks.of(world.robot).subsuming.suppress(by, [olga.session.number], "/cmd_vel", 200)
    drive(olga)
    drive(ann)
    assert [source for _, _, source, _ in world.link.commands] == [
        each.session.number for each in (ann, olga, ann)
    ]
    world.wait(1.0, ann, olga)
    drive(olga)
    assert "controlled by ann" in olga.told()[-1]


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
def test_who_vanishes_while_he_drives_loses_control_of_a_moving_robot(
    world: World, last: list[Any], silent: float, moving: bool
) -> None:
    """Seconds after the robot has stopped itself; not who has said zero, or answered pings since it stands."""
    at_work(world)
    ann = driver(world, "ann", 1)
    ann.says("call_service", service="/relay/take_control")
    desk = world.desks.of(world.robot)
    for each in last:
        drive(ann, each)
    desk.told(link.Safety(holder=ann.session.number, moving=last[0] is not STOP))
    world.clock.advance(0.4)
    desk.told(link.Safety(holder=ann.session.number))
    if silent:
        world.wait(silent, ann)
    world.wait(10.0)
    assert ann.client.closed is not None
    assert world.record.notes[-1][0] == "control.lost"
    assert world.record.notes[-1][3] == {"moving": moving}


def test_where_control_is_explicit_commands_are_told_what_to_do(world: World) -> None:
    """None of them takes it."""
    world.desks._rules = ControlRules(explicit=True)
    at_work(world)
    ann = driver(world, "ann", 1)
    drive(ann)
    assert "take control first" in ann.told()[0]
    ann.says("call_service", service="/relay/take_control")
    drive(ann)
    assert len(world.link.commands) == 1


def test_a_route_is_kept_while_nobody_else_takes_control(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A robot that tells that it moves changes nothing about whose commands pass."""
    at_work(world)
    ann = driver(world, "ann", 1)
    drive(ann)
    drive(ann)
    looked: list[str] = []
    real = module.PublishHandler._find
    monkeypatch.setattr(
        module.PublishHandler, "_find", lambda self, ask: (looked.append(ask.topic), real(self, ask))[1]
    )
    drive(ann)
    world.desks.of(world.robot).told(link.Safety(holder=ann.session.number, moving=True))
    drive(ann)
    assert looked == []
    world.desks.of(world.robot).told(link.Safety(stopped=link.Stopped(by="bob", since=1.0)))
    drive(ann)
    assert looked == ["/cmd_vel"]


def test_commands_that_wait_are_bounded(world: World) -> None:
    """In number of topics and in size; what can't wait is told."""
    at_work(world)
    describe(world, topics=["/arm/*"])
    ordered = silent(world)
    ann = driver(world, "ann", 1)
    for number in range(module.WAITING_TOPICS + 1):
        ann.says("publish", topic=f"/arm/j{number}", type=STRING, msg={"data": "go"})
    assert "a command to /arm/j16 can't wait for it" in ann.told()[0]
    ann.says("publish", topic="/arm/j0", msg={"data": "x" * module.WAITING_BYTES})
    assert "can't wait" in ann.told()[0]
    assert len(ordered) == 1


def test_a_call_that_moves_the_robot_takes_control(world: World) -> None:
    """It goes when the robot has agreed, and says from whom it is; others are refused."""
    at_work(world)
    describe(world, services=["/reset"])
    ordered = silent(world)
    ann, bob = driver(world, "ann", 1), driver(world, "bob", 2)
    ann.says("call_service", service="/reset", type=TRIGGER)
    assert world.link.all(link.CallService) == []
    obey(world, ordered[0])
    (call,) = world.link.all(link.CallService)
    assert call.source == ann.session.number
    bob.says("call_service", id="b", service="/reset", type=TRIGGER)
    (answer,) = bob.hears("service_response")
    assert answer["result"] is False
    assert "controlled by ann" in answer["values"]


def test_a_call_that_moves_nothing_says_from_whom_it_is_too(world: World) -> None:
    """It needs no control."""
    at_work(world)
    ann = driver(world, "ann", 1)
    ann.says("call_service", service="/reset", type=TRIGGER)
    (call,) = world.link.all(link.CallService)
    assert call.source == ann.session.number
    assert world.control.all(link.Control) == []


def test_a_goal_that_moves_the_robot_takes_control_and_keeps_it(world: World) -> None:
    """It is a command for as long as it is pursued; its hidden service is no way around."""
    at_work(world)
    describe(world, actions=["/dock"])
    ann, bob = driver(world, "ann", 1), driver(world, "bob", 2)
    ann.says("send_action_goal", id="g", action="/dock", action_type=FIBONACCI, args={"order": 1})
    (goal,) = world.link.all(link.SendActionGoal)
    assert goal.source == ann.session.number
    bob.says("send_action_goal", id="g", action="/dock", action_type=FIBONACCI, args={"order": 1})
    (answer,) = bob.hears("action_result")
    assert "controlled by ann" in answer["values"]
    bob.says("call_service", service="/dock/_action/send_goal", type=TRIGGER)
    assert "controlled by ann" in bob.hears("service_response")[0]["values"]
    world.wait(700, ann, bob)
    assert world.desks.of(world.robot).lease.held_by(ann.session)
    world.channel.message(link.ActionResult(id=goal.id, status=4, result=False, reason="done"))
    world.wait(700, ann, bob)
    assert world.desks.of(world.robot).lease.holder is None


def test_who_has_used_up_his_share_may_still_stop_and_let_go(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever else he has asked for: a stop waits for nobody's budget, nor for calls that wait already."""
    at_work(world)
    ann = driver(world, "ann", 1)
    drive(ann)
    monkeypatch.setattr(service_calls, "CALLS", 1)
    ann.says("call_service", service="/reset", type=TRIGGER)
    ann.says("call_service", id="more", service="/reset", type=TRIGGER)
    assert "calls of this connection are waiting" in ann.hears("service_response")[0]["values"]
    ann.session.allowance.requests.spend(3.0)
    ann.says("call_service", id="ping", service="/relay/ping")
    assert "your share" in ann.hears("service_response")[0]["values"]
    ann.says("call_service", id="stop", service="relay/stop")
    ann.says("call_service", id="go", service="/relay/release_control")
    assert [each["values"]["success"] for each in ann.hears("service_response")] == [True, True]
    assert len(world.control.all(link.Stop)) == 1
    assert world.desks.of(world.robot).lease.holder is None
