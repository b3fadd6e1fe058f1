"""``/relay/…`` about control, as clients call it."""

from __future__ import annotations

from typing import Any

import pytest

from relay_protocol import link
from relay_protocol.rights import Grant, Level, Rules
from relay_server.relay_node import control
from relay_server.relay_node.interfaces import OWN_SERVICES, TYPES
from tests.relay_server.local.asking import ask
from tests.relay_server.memory import STRING, Person, World


@pytest.fixture
def people(world: World) -> dict[str, Person]:
    """Three levels, at a robot that is there."""
    world.robot_comes()
    levels = {"ann": Level.OPERATOR, "olga": Level.OWNER, "vic": Level.VIEWER}
    found = {
        name: world.person(level, user=number, name=name)
        for number, (name, level) in enumerate(levels.items(), 1)
    }
    world.robot_joins()
    return found


def told(person: Person) -> dict[str, Any]:
    """The latest of what ``/relay/control`` said."""
    return dict(person.hears("publish")[-1]["msg"])


def test_control_is_taken_asked_for_and_handed_over(world: World, people: dict[str, Person]) -> None:
    """As services like others."""
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
    wrong, right = ({"client": each.session.number} for each in (ann, olga))
    assert "who you mean asks for control no more" in ask(ann, "/relay/grant_control", wrong)["message"]
    assert (
        "who you mean asks for control no more" in ask(ann, "/relay/refuse_control", ["", 10**9])["message"]
    )
    assert ask(ann, "/relay/grant_control", right)["success"] is True
    assert ask(ann, "/relay/release_control")["success"] is False
    assert ask(olga, "/relay/release_control")["success"] is True


def test_everybody_stops_but_not_everybody_resumes(world: World, people: dict[str, Person]) -> None:
    """Who has control and owners do."""
    assert ask(people["vic"], "/relay/stop", {"why": "smoke"}) == {
        "success": True,
        "message": "robot rover is stopped",
        "done": True,
    }
    (order,) = world.control.all(link.Stop)
    assert (order.by, order.why) == ("vic", "smoke")
    for name in ("vic", "ann"):
        assert "only who has control of the robot, and its owners" in ask(people[name], "/relay/resume")
    ask(people["ann"], "/relay/take_control")
    assert ask(people["ann"], "/relay/resume")["success"] is True
    assert ask(people["olga"], "/relay/resume")["success"] is True


def test_a_robot_that_is_away_is_answered_in_words(world: World, people: dict[str, Person]) -> None:
    """A stop is kept; what can't be done is no failure of the call."""
    world.robot_goes()
    assert ask(people["vic"], "/relay/stop") == {
        "success": True,
        "message": "robot rover will be stopped as soon as it can be reached",
        "done": False,
    }
    assert ask(people["ann"], "/relay/take_control") == {
        "success": False,
        "message": "robot rover is offline",
    }
    assert list(world.record.stops) == [1]


def test_a_stop_that_the_robot_could_not_do_all_of_is_not_told_as_done(
    world: World, people: dict[str, Person]
) -> None:
    """In the robot's words."""
    world.control.obeys = lambda order: world.desks.of(world.robot).told(
        link.Done(id=order.id, ok=False, reason="no contactor")
    )
    answer = ask(people["vic"], "/relay/stop")
    assert (answer["success"], answer["done"]) == (False, False)
    assert "no contactor" in answer["message"]


def test_suppressing_and_inhibiting_take_rights_of_their_own(world: World, people: dict[str, Person]) -> None:
    """Owners have them."""
    olga = people["olga"]
    assert ask(olga, "/relay/suppress", {"resource": "cmd_vel", "ms": 150.0})["success"] is True
    assert ask(olga, "/relay/inhibit", ["/chatter", 500, True])["success"] is True
    (suppress,) = world.control.all(link.Suppress)
    (inhibit,) = world.control.all(link.Inhibit)
    assert (suppress.resource, suppress.ms, suppress.sources) == ("/cmd_vel", 150, [olga.session.number])
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
    """And the robot hears nothing of it."""
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
    """What can't be used of it is left out."""
    assert ask(people["vic"], "/relay/stop", args)["success"] is True
    assert [order.why for order in world.control.all(link.Stop)] == [why]


def test_who_moves_the_robot_is_told_at_once_and_with_every_change(
    world: World, people: dict[str, Person]
) -> None:
    """To each who of them it is, and what it may."""
    ann, vic = people["ann"], people["vic"]
    for person in (ann, vic):
        person.says("subscribe", topic="/relay/control")
        assert told(person)["state"] == "free"
    ask(ann, "/relay/take_control")
    world.clock.advance(0)
    mine, his = told(ann), told(vic)
    assert (mine["state"], mine["holder"]["user"], mine["holder"]["you"]) == ("held", "ann", True)
    assert (his["holder"]["client"], his["holder"]["you"]) == (ann.session.number, False)
    assert mine["you"] == {"client": ann.session.number, "may_control": True, "may_resume": True}
    assert his["you"] == {"client": vic.session.number, "may_control": False, "may_resume": False}
    world.clock.advance(1)
    assert ann.hears("publish") == [], "nothing has changed"
    ann.says("unsubscribe", topic="/relay/control")
    ask(ann, "/relay/release_control")
    world.clock.advance(1)
    assert ann.hears("publish") == []
    assert told(vic)["state"] == "free"


def test_what_the_robot_tells_is_told_on(world: World, people: dict[str, Person]) -> None:
    """A viewer hears nothing of topics it may not use."""
    olga = people["olga"]
    blind = world.person(Level.VIEWER, deny=("subscribe:/secret",), user=9, name="blind")
    for person in (olga, blind):
        person.says("subscribe", topic="/relay/control")
    world.desks.of(world.robot).told(
        link.Safety(
            moving=True,
            stopped=link.Stopped(by="vic", why="smoke", since=5.0),
            suppressed=[link.Suppressed(resource="/cmd_vel", ms=80, sources=[4], by="olga")],
            inhibited=[link.Inhibited(resource="/secret", ms=900, hold=True, by="olga")],
            limits={"operator": link.Limits(linear=0.5)},
        )
    )
    world.clock.advance(0.2)
    seen = told(olga)
    assert seen["moving"] is True
    assert seen["stopped"] == {"by": "vic", "why": "smoke", "since": 5.0, "told": True, "again": None}
    assert seen["suppressed"] == [{"resource": "/cmd_vel", "ms": 80, "sources": [4], "by": "olga"}]
    assert seen["inhibited"] == [{"resource": "/secret", "ms": 900, "hold": True, "by": "olga"}]
    assert seen["limits"]["operator"]["linear"] == 0.5
    assert told(blind)["inhibited"] == []


def test_status_tells_who_has_control_and_that_it_is_stopped(world: World, people: dict[str, Person]) -> None:
    """In short."""
    ann = people["ann"]
    ask(ann, "/relay/take_control")
    safety = link.Safety(
        stopped=link.Stopped(by="vic", since=5.0),
        suppressed=[link.Suppressed(resource="/cmd_vel", sources=[9], by="runaway", ms=100)],
        inhibited=[link.Inhibited(resource="/chatter", hold=True, by="olga", ms=900)],
    )
    world.desks.of(world.robot).told(safety)
    ann.says("subscribe", topic="/relay/status")
    status = told(ann)
    assert status["control"] == {
        "state": "held",
        "holder": "ann",
        "you": True,
        "suppressed": [{"resource": "/cmd_vel", "by": "runaway", "hold": False}],
        "inhibited": [{"resource": "/chatter", "by": "olga", "hold": True}],
    }
    assert status["stopped"] is True


def test_a_right_that_changes_is_told(world: World, people: dict[str, Person]) -> None:
    """To who has it, that it may not control any more; to others that the robot is free."""
    ann, vic = people["ann"], people["vic"]
    ask(ann, "/relay/take_control")
    vic.says("subscribe", topic="/relay/control")
    ann.session.permit.rules = Rules([Grant(Level.VIEWER)])
    ann.session.permit.on_change()
    world.clock.advance(0.2)
    assert told(vic)["state"] == "free"
    assert world.record.notes[-1][:2] == ("control.lost", "ann")


def test_every_service_has_a_type_and_a_handler(people: dict[str, Person]) -> None:
    """rosapi shows them like those of the robot."""
    shown = ask(people["vic"], "/rosapi/services")["services"]
    for name in control.SERVICES:
        assert name in shown
        assert TYPES.knows(OWN_SERVICES[name].types[0])
    details = ask(people["vic"], "/rosapi/message_details", {"type": "switchboard_msgs/Control"})
    assert details["typedefs"][0]["fieldnames"][:5] == ["robot", "state", "holder", "request", "stopped"]
    assert STRING not in shown


def test_a_resume_from_before_a_stop_does_not_lift_it(world: World, people: dict[str, Person]) -> None:
    """It was held up on its way: no ping has come back since. With the next pong its sender is heard."""
    olga = people["olga"]
    olga.answers_pings()
    world.clock.advance(0.05)
    ask(people["vic"], "/relay/stop", {"why": "a child"})
    assert "rover was stopped, or may have been, after you asked for this" in ask(olga, "/relay/resume")
    assert not world.control.all(link.Resume)
    world.clock.advance(0.5)
    olga.answers_pings()
    assert ask(olga, "/relay/resume")["success"] is True
    assert world.control.all(link.Resume)


def test_who_has_just_stopped_it_may_resume_at_once(world: World, people: dict[str, Person]) -> None:
    """With the answer comes a ping: what its client sends after it has read both is no older than the stop."""
    olga = people["olga"]
    olga.answers_pings()
    world.clock.advance(0.05)
    ask(olga, "/relay/stop")
    olga.answers_pings()
    assert ask(olga, "/relay/resume")["success"] is True


def test_who_is_told_of_a_stop_may_resume_at_once(world: World, people: dict[str, Person]) -> None:
    """A ping comes with what is told of a robot that stands, and of one that may move none."""
    olga = people["olga"]
    olga.says("subscribe", topic="/relay/control")
    pinged = []
    for order in ("/relay/take_control", "/relay/stop"):
        world.clock.advance(0.21)
        olga.hears("publish")
        olga.client.pings.clear()
        ask(people["ann"], order)
        world.clock.advance(0)
        assert told(olga)
        pinged.append(len(olga.client.pings))
    assert pinged == [0, 1]
    olga.answers_pings()
    assert ask(olga, "/relay/resume")["success"] is True
