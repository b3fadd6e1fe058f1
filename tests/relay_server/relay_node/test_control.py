"""``/relay/…`` about control, as clients call it."""

from __future__ import annotations

from typing import Any

import pytest

from relay_protocol import link
from relay_protocol.rights import Grant, Level, Rules
from relay_server.control.service import CONFIRM_SECONDS, NOT_CONFIRMED
from relay_server.relay_node import control
from relay_server.relay_node.interfaces import OWN_SERVICES, TYPES
from tests.worlds.control import stopped_by
from tests.worlds.relay import STRING, Person, World
from tests.worlds.relay_node_calls import ask


@pytest.fixture
def people(world: World) -> dict[str, Person]:
    """Clients of three levels on a robot that is online."""
    world.robot_comes()
    levels = {"ann": Level.OPERATOR, "olga": Level.OWNER, "vic": Level.VIEWER}
    found = {
        name: world.person(level, user=number, name=name)
        for number, (name, level) in enumerate(levels.items(), 1)
    }
    world.robot_joins()
    return found


def reported(person: Person) -> dict[str, Any]:
    """The latest message of ``/relay/control``."""
    return dict(person.received("publish")[-1]["msg"])


def test_control_is_taken_asked_for_and_handed_over(world: World, people: dict[str, Person]) -> None:
    """By services like others."""
    ann, olga = people["ann"], people["olga"]
    assert ask(ann, "/relay/take_control", {"why": "delivery"}) == {
        "success": True,
        "message": "you have control",
    }
    assert ask(olga, "/relay/take_control", ["my turn"])["success"] is False
    assert ask(ann, "/relay/refuse_control")["success"] is True
    assert "ask again in 10 s" in ask(olga, "/relay/take_control")
    for _ in range(10):
        world.clock.advance(1)
        for each in people.values():
            each.answers_pings()
    assert ask(olga, "/relay/take_control")["success"] is False
    wrong, right = ({"client": each.context.number} for each in (ann, olga))
    assert "that request has ended" in ask(ann, "/relay/grant_control", wrong)["message"]
    assert "that request has ended" in ask(ann, "/relay/refuse_control", ["", 10**9])["message"]
    assert ask(ann, "/relay/grant_control", right)["success"] is True
    assert ask(ann, "/relay/release_control")["success"] is False
    assert ask(olga, "/relay/release_control")["success"] is True


def test_every_user_may_stop_but_not_resume(world: World, people: dict[str, Person]) -> None:
    """The controller and owners may resume."""
    assert ask(people["vic"], "/relay/stop", {"why": "smoke"}) == {
        "success": True,
        "message": "robot rover is stopped",
        "done": True,
        "stopped": stopped_by("vic", "smoke"),
    }
    (order,) = world.control.all(link.Stop)
    assert (order.by, order.why) == ("vic", "smoke")
    for name in ("vic", "ann"):
        assert "only the holder of control and the robot's owners" in ask(people[name], "/relay/resume")
    ask(people["ann"], "/relay/take_control")
    assert ask(people["ann"], "/relay/resume")["success"] is True
    assert ask(people["olga"], "/relay/resume")["success"] is True


def test_a_call_for_an_offline_robot_is_refused_with_a_reason(
    world: World, people: dict[str, Person]
) -> None:
    """A stop is stored. An impossible request is not a failure of the call."""
    world.robot_goes()
    assert ask(people["vic"], "/relay/stop") == {
        "success": True,
        "message": "robot rover will be stopped as soon as it can be reached",
        "done": False,
        "stopped": stopped_by("vic", confirmed=False),
    }
    assert ask(people["ann"], "/relay/take_control") == {
        "success": False,
        "message": "robot rover is offline",
    }
    assert list(world.record.stops) == [1]


def test_a_stop_done_in_part_is_answered_with_the_stopped_robot(
    world: World, people: dict[str, Person]
) -> None:
    world.control.obeys = lambda order: world.controllers.of(world.robot).message_received(
        link.OrderResult(id=order.id, ok=False, reason="no contactor")
    )
    answer = ask(people["vic"], "/relay/stop")
    assert (answer["success"], answer["done"]) == (False, False)
    assert answer["message"] == "robot rover is stopped, but a part of the stop failed: no contactor"
    assert answer["stopped"] == stopped_by("vic", confirmed=False)


def test_answer_to_a_stop_does_not_wait_for_a_database_that_hangs(
    world: World, people: dict[str, Person]
) -> None:
    """The result says that it is unknown whether the stop is stored."""
    world.robot_goes()
    world.record.hold = True
    people["vic"].says("call_service", id="stop", service="/relay/stop", args={})
    for _ in range(int(CONFIRM_SECONDS)):
        assert not people["vic"].received("service_response")
        world.clock.advance(1)
        people["vic"].answers_pings()
    (answer,) = people["vic"].received("service_response")
    assert answer["values"] == {"success": False, "message": NOT_CONFIRMED, "done": False, "stopped": None}


def test_suppressing_and_inhibiting_take_rights_of_their_own(world: World, people: dict[str, Person]) -> None:
    """Owners have them."""
    olga = people["olga"]
    assert ask(olga, "/relay/suppress", {"resource": "cmd_vel", "ms": 150.0})["success"] is True
    assert ask(olga, "/relay/inhibit", ["/chatter", 500, True])["success"] is True
    (suppress,) = world.control.all(link.Suppress)
    (inhibit,) = world.control.all(link.Inhibit)
    assert (suppress.resource, suppress.ms, suppress.sources) == ("/cmd_vel", 150, [olga.context.number])
    assert (inhibit.resource, inhibit.ms, inhibit.hold) == ("/chatter", 500, True)
    assert "needs the level owner" in ask(people["ann"], "/relay/suppress", {"resource": "/cmd_vel"})
    assert "needs the level owner" in ask(people["ann"], "/relay/inhibit", {"resource": "/chatter"})


@pytest.mark.parametrize(
    ("service", "args", "words"),
    [
        ("suppress", {}, "give 'resource'"),
        ("suppress", {"resource": "no name"}, "is no ROS name"),
        ("suppress", {"resource": "/x", "ms": 20}, "must be 50 to 200"),
        ("suppress", {"resource": "/x", "ms": "100"}, "must be a whole number"),
        ("inhibit", {"resource": "/x", "ms": True}, "must be a whole number"),
        ("inhibit", {"resource": "/x", "hold": 1}, "'hold' must be true or false"),
        ("inhibit", {"resource": "/x", "ms": 60_001}, "must be 1 to 60000"),
        ("take_control", {"why": 7}, "give 'why'"),
        ("grant_control", {"client": "bob"}, "must be a whole number"),
    ],
)
def test_arguments_that_make_no_sense_fail_the_call(
    world: World, people: dict[str, Person], service: str, args: Any, words: str
) -> None:
    """The robot receives no request."""
    assert words in ask(people["olga"], f"/relay/{service}", args)
    assert (
        not world.control.all(link.Suppress) + world.control.all(link.Inhibit) + world.control.all(link.Stop)
    )


@pytest.mark.parametrize(
    ("args", "why"),
    [
        ({"why": None}, ""),
        ({"why": 7}, ""),
        ({"why": ["smoke"]}, ""),
        ([None], ""),
        (["smoke"], "smoke"),
        (7, ""),
        ({"why": "x" * 5000}, "x" * 500),
        ({"why": "x" * 100_000}, ""),
    ],
)
def test_no_stop_is_refused_for_its_reason(
    world: World, people: dict[str, Person], args: Any, why: str
) -> None:
    """Invalid reasons are left out."""
    assert ask(people["vic"], "/relay/stop", args)["success"] is True
    assert [order.why for order in world.control.all(link.Stop)] == [why]


def test_controller_is_sent_at_once_and_with_every_change(world: World, people: dict[str, Person]) -> None:
    """Each client also gets its own rights."""
    ann, vic = people["ann"], people["vic"]
    for person in (ann, vic):
        person.says("subscribe", topic="/relay/control")
        assert reported(person)["state"] == "free"
    ask(ann, "/relay/take_control")
    world.clock.advance(0)
    mine, his = reported(ann), reported(vic)
    assert (mine["state"], mine["holder"]["user"], mine["holder"]["you"]) == ("held", "ann", True)
    assert (his["holder"]["client"], his["holder"]["you"]) == (ann.context.number, False)
    assert mine["you"] == {"client": ann.context.number, "may_control": True, "may_resume": True}
    assert his["you"] == {"client": vic.context.number, "may_control": False, "may_resume": False}
    world.clock.advance(1)
    assert ann.received("publish") == [], "nothing has changed"
    ann.says("unsubscribe", topic="/relay/control")
    ask(ann, "/relay/release_control")
    world.clock.advance(1)
    assert ann.received("publish") == []
    assert reported(vic)["state"] == "free"


def test_reports_of_the_robot_are_forwarded(world: World, people: dict[str, Person]) -> None:
    """A viewer gets no reports about topics that it may not use."""
    olga = people["olga"]
    blind = world.person(Level.VIEWER, deny=("subscribe:/secret",), user=9, name="blind")
    for person in (olga, blind):
        person.says("subscribe", topic="/relay/control")
    world.controllers.of(world.robot).message_received(
        link.MotionState(
            moving=True,
            stopped=link.Stopped(by="vic", why="smoke", since=5.0),
            suppressed=[link.Suppressed(resource="/cmd_vel", ms=80, sources=[4], by="olga")],
            inhibited=[link.Inhibited(resource="/secret", ms=900, hold=True, by="olga")],
            limits={"operator": link.Limits(linear=0.5)},
        )
    )
    world.clock.advance(0.2)
    seen = reported(olga)
    assert seen["moving"] is True
    assert seen["stopped"] == {"by": "vic", "why": "smoke", "since": 5.0, "confirmed": True, "again": None}
    assert seen["suppressed"] == [{"resource": "/cmd_vel", "ms": 80, "sources": [4], "by": "olga"}]
    assert seen["inhibited"] == [{"resource": "/secret", "ms": 900, "hold": True, "by": "olga"}]
    assert seen["limits"]["operator"]["linear"] == 0.5
    assert reported(blind)["inhibited"] == []


def test_status_has_the_holder_and_the_stop(world: World, people: dict[str, Person]) -> None:
    ann = people["ann"]
    ask(ann, "/relay/take_control")
    safety = link.MotionState(
        stopped=link.Stopped(by="vic", since=5.0),
        suppressed=[link.Suppressed(resource="/cmd_vel", sources=[9], by="runaway", ms=100)],
        inhibited=[link.Inhibited(resource="/chatter", hold=True, by="olga", ms=900)],
    )
    world.controllers.of(world.robot).message_received(safety)
    ann.says("subscribe", topic="/relay/status")
    status = reported(ann)
    assert status["control"] == {
        "state": "held",
        "holder": "ann",
        "you": True,
        "suppressed": [{"resource": "/cmd_vel", "by": "runaway", "hold": False}],
        "inhibited": [{"resource": "/chatter", "by": "olga", "hold": True}],
    }
    assert status["stopped"] is True


def test_a_changed_right_is_published(world: World, people: dict[str, Person]) -> None:
    """The client learns that it may not control; others learn that the robot is free."""
    ann, vic = people["ann"], people["vic"]
    ask(ann, "/relay/take_control")
    vic.says("subscribe", topic="/relay/control")
    ann.context.permit.rules = Rules([Grant(Level.VIEWER)])
    ann.context.permit.on_change()
    world.clock.advance(0.2)
    assert reported(vic)["state"] == "free"
    assert world.record.notes[-1][:2] == ("control.lost", "ann")


def test_every_service_has_a_type_and_a_handler(world: World, people: dict[str, Person]) -> None:
    """rosapi lists them like those of the robot."""
    shown = ask(people["vic"], "/rosapi/services")["services"]
    for name in control.ControlRosServices(world.control_service).handlers():
        assert name in shown
        assert TYPES.knows(OWN_SERVICES[name].types[0])
    details = ask(people["vic"], "/rosapi/message_details", {"type": "switchboard_msgs/Control"})
    assert details["typedefs"][0]["fieldnames"][:5] == ["robot", "state", "holder", "request", "stopped"]
    assert STRING not in shown


def test_a_resume_from_before_a_stop_does_not_lift_it(world: World, people: dict[str, Person]) -> None:
    """The resume was delayed: no ping has been answered since. After the next pong a resume is accepted."""
    olga = people["olga"]
    olga.answers_pings()
    world.clock.advance(0.05)
    ask(people["vic"], "/relay/stop", {"why": "a child"})
    assert "rover was stopped, or may have been, after you sent this" in ask(olga, "/relay/resume")
    assert not world.control.all(link.Resume)
    world.clock.advance(0.5)
    olga.answers_pings()
    assert ask(olga, "/relay/resume")["success"] is True
    assert world.control.all(link.Resume)


def test_user_of_a_stop_may_resume_at_once(world: World, people: dict[str, Person]) -> None:
    """The answer is followed by a ping, so a message sent after both is newer than the stop."""
    olga = people["olga"]
    olga.answers_pings()
    world.clock.advance(0.05)
    ask(olga, "/relay/stop")
    olga.answers_pings()
    assert ask(olga, "/relay/resume")["success"] is True


def test_user_notified_of_a_stop_may_resume_at_once(world: World, people: dict[str, Person]) -> None:
    """A ping follows each message about a stopped robot, and about a robot whose control is suspended."""
    olga = people["olga"]
    olga.says("subscribe", topic="/relay/control")
    pinged = []
    for order in ("/relay/take_control", "/relay/stop"):
        world.clock.advance(0.21)
        olga.received("publish")
        olga.client.pings.clear()
        ask(people["ann"], order)
        world.clock.advance(0)
        assert reported(olga)
        pinged.append(len(olga.client.pings))
    assert pinged == [0, 1]
    olga.answers_pings()
    assert ask(olga, "/relay/resume")["success"] is True
