"""Who controls one robot: one connection at a time, and only once the robot has agreed."""

from __future__ import annotations

from math import inf
from typing import Any, NamedTuple

import pytest

from relay_protocol import link
from relay_protocol.errors import Refused, Unavailable
from relay_protocol.rights import Grant, Level, Rules
from relay_server.control import controller as module
from relay_server.control import rearm
from relay_server.control.audit import Actor
from relay_server.control.commands import WAITING
from relay_server.control.lease import LeaseState
from relay_server.control.types import REST_SECONDS, ControlRules
from tests.relay_server.steering import Connection, Place, outcome, result


@pytest.fixture
def place() -> Place:
    """A robot that is online and does as it is told."""
    return Place().online()


# --- taking -----------------------------------------------------------------------------------------------


def test_a_free_robot_is_taken_once_it_has_agreed(place: Place) -> None:
    """Whoever waits is answered then, and the robot knows whom it obeys, and with what level."""
    place.link.silent = True
    ann = place.connection()
    asked = outcome(place.desk.take(ann, "delivery"))
    (order,) = place.link.orders(link.Control)
    assert (order.holder, order.user, order.level, order.why) == (ann.number, "ann", "operator", "delivery")
    assert (asked, place.desk.passes(ann, "/cmd_vel")) == ([], False)
    place.link.answers(order)
    assert asked[0].success
    assert place.desk.passes(ann, "/cmd_vel")
    assert place.record.notes == [("control.taken", "ann", "delivery", {"how": "taken"})]


def test_who_may_not_control_does_not_take_it(place: Place) -> None:
    """By level, and by a pattern that denies."""
    viewer = place.connection(level=Level.VIEWER)
    denied = place.connection(level=Level.OWNER, deny=("control:/",))
    with pytest.raises(Refused, match="control on / needs the level operator"):
        result(place.desk.take(viewer, ""))
    with pytest.raises(Refused, match="denied to you"):
        result(place.desk.take(denied, ""))
    assert place.link.holders == []


def test_a_robot_that_does_not_answer_is_free_again_and_its_asker_is_told(place: Place) -> None:
    """Should it have heard, it is told that nobody has control."""
    place.link.silent = True
    ann = place.connection()
    asked = outcome(place.desk.take(ann, ""))
    place.clock.advance(3.1)
    assert isinstance(asked[0], Unavailable)
    assert place.desk.lease.state is LeaseState.FREE
    assert place.link.holders == [ann.number, 0]
    assert ann.told == ["you did not get control of rover: robot rover did not answer within 3 s"]
    place.link.answers(place.link.orders(link.Control)[0])
    assert not place.desk.passes(ann, "/cmd_vel"), "an answer that comes too late gives nothing"


def test_who_waits_for_a_robot_that_does_not_answer_is_whom_it_obeys(place: Place) -> None:
    """What was taken back as a precaution is not taken back from him."""
    place.link.silent = True
    ann, bob = place.connection("ann"), place.connection("bob")
    first, second = outcome(place.desk.take(ann, "")), outcome(place.desk.take(bob, ""))
    place.clock.advance(3.1)
    assert isinstance(first[0], Unavailable)
    assert place.link.holders == [ann.number, 0, bob.number]
    place.link.answers(place.link.orders(link.Control)[-1])
    assert second[0].success
    assert place.desk.lease.held_by(bob)
    assert place.record.kinds == ["control.lost", "control.taken"]


def test_a_robot_that_refuses_is_free(place: Place) -> None:
    """In its own words."""
    place.link.unable = "the key switch is off"
    (error,) = outcome(place.desk.take(place.connection(), ""))
    assert "the key switch is off" in str(error)
    assert place.desk.lease.state is LeaseState.FREE


def test_a_robot_that_is_offline_can_not_be_taken() -> None:
    """The answer says so."""
    place = Place()
    with pytest.raises(Unavailable, match="rover is offline"):
        result(place.desk.take(place.connection(), ""))


def test_taking_again_changes_nothing(place: Place) -> None:
    """It is the caller's already."""
    ann = place.holding()
    assert result(place.desk.take(ann, "")).success
    assert place.link.holders == [ann.number]


def test_two_who_take_at_once_are_told_apart(place: Place) -> None:
    """The second finds it held, and asks for it."""
    place.link.silent = True
    ann, bob = place.connection("ann"), place.connection("bob")
    first, second = outcome(place.desk.take(ann, "")), outcome(place.desk.take(bob, ""))
    place.link.answers(place.link.orders(link.Control)[0])
    assert first[0].success
    assert second[0] == (False, "ann has control and was asked for it")
    assert place.desk.lease.requested_by(bob)


def test_who_loses_the_right_while_he_waits_does_not_get_it(place: Place) -> None:
    """Rights are judged when it is his turn, as when he asked."""
    place.link.silent = True
    ann, bob = place.connection("ann"), place.connection("bob")
    first, second = outcome(place.desk.take(ann, "")), outcome(place.desk.take(bob, ""))
    bob.permit.rules = Rules([Grant(Level.OPERATOR, deny=("control:/",))])
    place.desk.rights_changed(bob)
    place.link.silent = False
    place.link.unable = "the key switch is off"
    place.link.answers(place.link.orders(link.Control)[0])
    assert "key switch" in str(first[0])
    assert isinstance(second[0], Refused)
    assert bob.number not in place.link.holders


def test_who_takes_it_too_often_is_refused(place: Place) -> None:
    """By asking and by commands, from all connections of a user together; others are not."""
    ann, second = place.connection("ann"), place.connection("ann")
    second.permit = ann.permit
    for _ in range(10):
        for each in (ann, second):
            assert result(place.desk.take(each, "")).success
            place.desk.release(each, "")
    for ask in (lambda: result(place.desk.take(ann, "")), lambda: place.desk.claim(second)):
        with pytest.raises(Refused, match="too often: 5 times a second at most"):
            ask()
    assert result(place.desk.take(place.connection("bob"), "")).success
    place.clock.advance(0.2)
    assert not result(place.desk.take(ann, "")).success, "asked for, as bob has it"


# --- asking for it ----------------------------------------------------------------------------------------


def test_the_holder_hands_over(place: Place) -> None:
    """In between nobody moves the robot: it stops for the first before it obeys the second."""
    ann, bob = place.holding("ann"), place.connection("bob")
    assert not result(place.desk.take(bob, "my turn")).success
    assert ann.told == ["bob asks for control of rover: my turn"]
    place.link.silent = True
    assert place.desk.grant(ann, "").success
    assert not place.desk.passes(ann, "/cmd_vel")
    assert not place.desk.passes(bob, "/cmd_vel")
    place.link.answers(place.link.orders(link.Control)[-1])
    assert place.desk.passes(bob, "/cmd_vel")
    assert place.record.kinds == ["control.taken", "control.requested", "control.granted", "control.taken"]


def test_the_holder_keeps_it(place: Place) -> None:
    """The one who asked is told why, and may ask again in a while."""
    ann, bob = place.holding("ann"), place.connection("bob")
    result(place.desk.take(bob, ""))
    assert place.desk.refuse(ann, "in a narrow lane").success
    assert bob.told == ["ann keeps control of rover: in a narrow lane"]
    assert place.desk.lease.request is None
    assert place.desk.passes(ann, "/cmd_vel")
    assert place.record.kinds[-1] == "control.refused"
    place.clock.advance(REST_SECONDS)
    assert not result(place.desk.take(bob, "")).success
    assert place.desk.lease.requested_by(bob)


def test_who_was_refused_does_not_ask_again_at_once(place: Place) -> None:
    """By no connection of his; others ask, and somebody else he may ask as well."""
    ann, bob, eve = place.holding("ann"), place.connection("bob"), place.connection("eve")
    again = place.connection("bob")
    again.permit = bob.permit
    result(place.desk.take(bob, ""))
    place.desk.refuse(ann, "")
    place.clock.advance(0.5)
    for each in (bob, again):
        with pytest.raises(Refused, match="ann has just kept control of rover; ask again in 10 s"):
            result(place.desk.take(each, ""))
    assert place.desk.lease.request is None
    assert place.record.kinds[-1] == "control.refused"
    result(place.desk.take(eve, ""))
    place.desk.grant(ann, "")
    assert not result(place.desk.take(bob, "")).success
    assert place.desk.lease.requested_by(bob)


def test_users_who_rest_are_bounded(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of more than that those who were refused first may ask again."""
    monkeypatch.setattr(module, "USERS", 2)
    ann = place.holding("ann")
    asking = [place.connection(name) for name in ("bob", "eve", "tom")]
    for each in asking:
        result(place.desk.take(each, ""))
        place.desk.refuse(ann, "")
    for each in asking[1:]:
        with pytest.raises(Refused):
            result(place.desk.take(each, ""))
    assert not result(place.desk.take(asking[0], "")).success


def test_an_answer_goes_to_who_is_meant(place: Place) -> None:
    """Somebody else may have asked while it was on its way: he gets neither control nor a refusal by it."""
    ann, bob, olga = place.holding("ann"), place.connection("bob"), place.connection("olga", Level.OWNER)
    result(place.desk.take(bob, ""))
    result(place.desk.take(olga, ""))
    words = "who you mean asks for control no more; olga does, and has no answer yet"
    assert place.desk.grant(ann, "", bob.number) == (False, words)
    assert place.desk.refuse(ann, "", bob.number) == (False, words)
    assert place.desk.lease.requested_by(olga)
    assert place.desk.grant(ann, "", olga.number).success
    assert place.desk.lease.held_by(olga)


def test_a_program_that_answers_nobody_gives_way_after_the_grace_time(place: Place) -> None:
    """It took the robot by a command: who asks for it, and asks once more, has it. Both are told."""
    program, ann = place.connection("program"), place.connection("ann")
    result(place.desk.claimed(program))
    assert not result(place.desk.take(ann, "")).success
    place.clock.advance(29)
    answer = result(place.desk.take(ann, ""))
    assert answer == (
        False,
        "program has control and was asked for it already; after 1 s ask again to take over",
    )
    place.clock.advance(1)
    assert result(place.desk.take(ann, "")) == (True, "you have control")
    assert place.desk.lease.held_by(ann)
    assert program.told[-1] == "you have lost control of rover: ann has taken over"
    with pytest.raises(Refused, match=r"let go for 0\.5 s"):
        place.desk.claim(program)


@pytest.mark.parametrize("how", ["asked", "granted", "asked once more"])
def test_who_has_asked_for_control_himself_is_not_taken_over(place: Place, how: str) -> None:
    """But by an owner, as ever."""
    ann, bob = place.connection("ann"), place.connection("bob")
    if how == "asked":
        result(place.desk.take(ann, ""))
    elif how == "granted":
        program = place.connection("program")
        result(place.desk.claimed(program))
        result(place.desk.take(ann, ""))
        place.desk.grant(program, "")
    else:
        result(place.desk.claimed(ann))
        assert place.desk.lease.holder is not None
        assert place.desk.lease.holder.implicit
        assert result(place.desk.take(ann, "")) == (True, "you have control")
    assert not result(place.desk.take(bob, "")).success
    place.clock.advance(31)
    assert not result(place.desk.take(bob, "")).success
    assert place.desk.lease.held_by(ann)


def test_only_the_holder_answers(place: Place) -> None:
    """And only when somebody asks."""
    ann, bob = place.holding("ann"), place.connection("bob")
    assert place.desk.grant(ann, "") == (False, "nobody asks for control")
    result(place.desk.take(bob, ""))
    assert place.desk.grant(bob, "") == (False, "you have no control of this robot")
    assert place.desk.refuse(bob, "") == (False, "you have no control of this robot")


def test_one_asks_at_a_time_and_an_owner_goes_before_others(place: Place) -> None:
    """Who is displaced is told."""
    place.holding("ann")
    bob, eve = place.connection("bob"), place.connection("eve")
    olga, otto = place.connection("olga", Level.OWNER), place.connection("otto", Level.OWNER)
    result(place.desk.take(bob, ""))
    assert "bob asks for it already" in result(place.desk.take(eve, "")).message
    result(place.desk.take(olga, ""))
    assert place.desk.lease.requested_by(olga)
    assert bob.told == ["olga asks for control of rover before you"]
    assert "olga asks for it already" in result(place.desk.take(otto, "")).message


def test_an_owner_takes_over_after_the_grace_time(place: Place) -> None:
    """Not before, not without having asked, and nobody else does."""
    ann, olga = place.holding("ann"), place.connection("olga", Level.OWNER)
    assert not result(place.desk.take(olga, "")).success
    place.clock.advance(29.9)
    assert "after 0 s ask again to take over" in result(place.desk.take(olga, "")).message
    place.clock.advance(0.2)
    assert result(place.desk.take(olga, "danger")).success
    assert place.desk.passes(olga, "/cmd_vel")
    assert ann.told[-1] == "you have lost control of rover: olga has taken over"
    assert place.record.kinds[-2:] == ["control.lost", "control.taken"]
    bob = place.connection("bob")
    result(place.desk.take(bob, ""))
    place.clock.advance(60)
    assert not result(place.desk.take(bob, "")).success
    assert place.desk.passes(olga, "/cmd_vel")


def test_a_request_ends_with_its_connection_or_is_taken_back(place: Place) -> None:
    """The holder holds on."""
    ann = place.holding("ann")
    for end in (place.desk.left, lambda client: place.desk.release(client, "")):
        bob = place.connection("bob")
        result(place.desk.take(bob, ""))
        end(bob)
        assert place.desk.lease.request is None
        assert place.desk.passes(ann, "/cmd_vel")


def test_every_end_of_a_request_is_on_record(place: Place) -> None:
    """With whose it was and why; nobody is asked for anything afterwards."""
    ann = place.holding("ann")
    olga = place.connection("olga", Level.OWNER)

    def asks() -> Connection:
        place.clock.advance(5)
        bob = place.connection("bob")
        assert not result(place.desk.take(bob, "")).success
        return bob

    def ended() -> tuple[str, str, str, dict[str, Any]]:
        (note,) = [each for each in place.record.notes if each[0] in ("control.lapsed", "control.withdrawn")]
        place.record.notes.clear()
        return note

    place.desk.release(asks(), "changed my mind")
    assert ended() == ("control.withdrawn", "bob", "changed my mind", {})
    place.desk.release(asks(), "enough", Actor("olga", "user:olga", olga.user))
    assert ended() == ("control.withdrawn", "olga", "enough", {"of": "bob"})
    place.desk.left(asks())
    assert ended() == ("control.lapsed", "bob", "the connection has ended", {})
    asks()
    result(place.desk.take(olga, ""))
    assert ended() == ("control.lapsed", "bob", "olga asks for it before", {})
    place.desk.left(olga)
    assert ended()[:2] == ("control.lapsed", "olga")
    bob = asks()
    second = place.connection("ann")
    second.permit = ann.permit
    assert result(place.desk.take(second, "")).success
    assert ended() == ("control.lapsed", "bob", "ann gets it", {})
    assert bob.told == ["you ask for control of rover no more: ann gets it"]
    asks()
    place.desk.left(second)
    assert ended() == ("control.lapsed", "bob", "the connection has ended", {})
    assert result(place.desk.take(ann, "")).success
    asks()
    place.offline()
    assert ended() == ("control.lapsed", "bob", "the robot's link was lost", {})
    assert place.desk.lease.request is None


def test_an_answer_to_a_request_is_no_lapse(place: Place) -> None:
    """Neither yes nor no, nor what an owner takes after the grace time."""
    ann, bob, olga = place.holding("ann"), place.connection("bob"), place.connection("olga", Level.OWNER)
    result(place.desk.take(bob, ""))
    place.desk.refuse(ann, "")
    place.clock.advance(REST_SECONDS)
    result(place.desk.take(bob, ""))
    place.desk.grant(ann, "")
    result(place.desk.take(olga, ""))
    place.clock.advance(31)
    assert result(place.desk.take(olga, "")).success
    assert "control.lapsed" not in place.record.kinds


def test_a_request_that_nobody_answers_lapses(place: Place) -> None:
    """Both are told, it is on record, and somebody else may ask; the holder holds on."""
    ann, bob, eve = place.holding("ann"), place.connection("bob"), place.connection("eve")
    result(place.desk.take(bob, "my turn"))
    place.clock.advance(59.9)
    assert not result(place.desk.take(bob, "")).success
    assert "bob asks for it already" in result(place.desk.take(eve, "")).message
    place.clock.advance(0.1)
    assert place.desk.lease.request is None
    assert bob.told == ["you ask for control of rover no more: no answer within 60 s; ask again to go on"]
    assert ann.told[-1] == "bob asks for control of rover no more: no answer within 60 s"
    assert place.record.notes[-1] == ("control.lapsed", "bob", "no answer within 60 s", {})
    assert place.desk.passes(ann, "/cmd_vel")
    result(place.desk.take(eve, ""))
    assert place.desk.lease.requested_by(eve)


def test_an_idle_owners_request_blocks_no_other_owner_for_long(place: Place) -> None:
    """Who asks next has the grace time and the time of a request anew."""
    place.holding("ann")
    olga, otto = place.connection("olga", Level.OWNER), place.connection("otto", Level.OWNER)
    result(place.desk.take(olga, ""))
    place.clock.advance(60)
    assert not result(place.desk.take(otto, "")).success
    assert place.desk.lease.requested_by(otto)
    place.clock.advance(30)
    assert not result(place.desk.take(olga, "")).success
    assert result(place.desk.take(otto, "")).success
    place.clock.advance(120)
    assert place.desk.passes(otto, "/cmd_vel")


# --- how it ends ------------------------------------------------------------------------------------------


def test_what_is_given_back_is_free_once_the_robot_has_agreed(place: Place) -> None:
    """Who asks for it meanwhile waits, and gets it."""
    ann, bob = place.holding("ann"), place.connection("bob")
    place.link.silent = True
    assert place.desk.release(ann, "done").success
    assert not place.desk.passes(ann, "/cmd_vel")
    asked = outcome(place.desk.take(bob, ""))
    assert place.link.holders == [ann.number, 0]
    place.link.silent = False
    place.link.answers(place.link.orders(link.Control)[-1])
    assert asked[0].success
    assert place.link.holders == [ann.number, 0, bob.number]
    assert place.record.notes[1] == ("control.released", "ann", "done", {})


def test_a_robot_that_does_not_confirm_the_end_is_free_all_the_same(place: Place) -> None:
    """Nobody's commands pass meanwhile."""
    ann = place.holding()
    place.link.silent = True
    place.desk.release(ann, "")
    place.clock.advance(3.1)
    assert place.desk.lease.state is LeaseState.FREE


def test_who_has_none_gives_none_back(place: Place) -> None:
    """Nor does it end somebody else's."""
    ann = place.holding("ann")
    assert not place.desk.release(place.connection("bob"), "").success
    assert place.desk.passes(ann, "/cmd_vel")


def test_it_ends_with_the_connection(place: Place) -> None:
    """Also while the robot is being asked; the record says whether it was moving."""
    ann = place.holding()
    place.desk.told(link.Safety(holder=ann.number, moving=True))
    place.desk.left(ann)
    assert place.desk.lease.state is LeaseState.FREE
    assert place.record.notes[-1] == ("control.lost", "ann", "the connection has ended", {"moving": True})
    place.link.silent = True
    bob = place.connection("bob")
    outcome(place.desk.take(bob, ""))
    place.desk.left(bob)
    place.link.silent = False
    for order in place.link.orders(link.Control)[-2:]:
        place.link.answers(order)
    assert place.desk.lease.state is LeaseState.FREE
    assert place.link.holders[-2:] == [bob.number, 0]


@pytest.mark.parametrize(("alive", "moving"), [(1000.0, True), (1000.4, True), (1000.5, False), (inf, False)])
def test_who_vanished_while_he_drove_lost_control_of_a_robot_that_moved(
    place: Place, alive: float, moving: bool
) -> None:
    """Though it has stopped itself by the time that is known; not who was heard since, or had let go."""
    ann = place.holding()
    place.desk.told(link.Safety(holder=ann.number, moving=True))
    place.clock.advance(0.4)
    place.desk.told(link.Safety(holder=ann.number))
    place.clock.advance(5.6)
    ann.alive = alive
    place.desk.left(ann)
    assert place.record.notes[-1] == ("control.lost", "ann", "the connection has ended", {"moving": moving})


def test_who_has_not_moved_the_robot_does_not_lose_it_for_his_forerunner(place: Place) -> None:
    """What moved before he had control was not his."""
    ann = place.holding("ann")
    place.desk.told(link.Safety(holder=ann.number, moving=True))
    place.desk.told(link.Safety(holder=ann.number))
    place.desk.release(ann, "")
    bob = place.holding("bob")
    bob.alive = place.clock.seconds()
    place.desk.left(bob)
    assert place.record.notes[-1] == ("control.lost", "bob", "the connection has ended", {"moving": False})


def test_it_ends_with_the_right(place: Place) -> None:
    """With the reason; a lower level that still may control keeps it, with other limits."""
    ann = place.holding(level=Level.OWNER)
    ann.permit.rules = Rules([Grant(Level.OPERATOR)])
    place.desk.rights_changed(ann)
    assert place.desk.passes(ann, "/cmd_vel")
    assert [order.level for order in place.link.orders(link.Control)] == ["owner", "operator"]
    ann.permit.rules = Rules([Grant(Level.VIEWER)])
    place.desk.rights_changed(ann)
    assert not place.desk.passes(ann, "/cmd_vel")
    assert place.link.holders[-1] == 0
    assert "needs the level operator" in ann.told[-1]


def test_it_ends_with_the_robots_link_and_is_taken_anew(place: Place) -> None:
    """A robot that is back obeys nobody."""
    ann = place.holding()
    place.offline()
    assert place.desk.lease.state is LeaseState.FREE
    assert ann.told == ["you have lost control of rover: the robot's link was lost"]
    assert place.record.kinds == ["control.taken", "control.lost"]
    place.online()
    assert place.link.holders == []
    assert not place.desk.passes(ann, "/cmd_vel")
    assert result(place.desk.take(ann, "")).success


def test_a_link_that_is_lost_while_the_robot_is_asked_ends_it(place: Place) -> None:
    """Whoever waits is told that the robot is offline."""
    place.link.silent = True
    asked = outcome(place.desk.take(place.connection(), ""))
    place.offline()
    assert "offline" in str(asked[0])
    assert place.desk.lease.state is LeaseState.FREE


def test_it_ends_when_nobody_commands_any_more(place: Place) -> None:
    """Counted from the latest command, and not while the robot moves."""
    ann = place.holding()
    place.clock.advance(500)
    ann.commanded = place.clock.seconds()
    place.clock.advance(599)
    place.desk.told(link.Safety(holder=ann.number, moving=True))
    place.clock.advance(2)
    assert place.desk.passes(ann, "/cmd_vel")
    place.desk.told(link.Safety(holder=ann.number))
    place.clock.advance(601)
    assert place.desk.lease.state is LeaseState.FREE
    assert ann.told == ["you have lost control of rover: no command for 600 s"]


def test_nothing_is_left_when_all_is_over(place: Place) -> None:
    """No timer runs for a robot that nobody has."""
    ann = place.holding()
    place.desk.release(ann, "")
    place.clock.advance(1)
    assert not [call for call in place.clock.getDelayedCalls() if call.active()]


def test_whoever_stops_waiting_spoils_nothing(place: Place) -> None:
    """A call that is given up leaves no lease that waits for ever."""
    from twisted.internet.defer import Deferred

    place.link.silent = True
    ann = place.connection()
    waiting = Deferred.fromCoroutine(place.desk.take(ann, "")).addErrback(lambda failure: None)
    waiting.cancel()
    place.link.answers(place.link.orders(link.Control)[0])
    assert place.desk.passes(ann, "/cmd_vel")


def test_whoever_is_told_may_leave_by_that(place: Place) -> None:
    """A client that is cut because it reads nothing takes nothing down with it."""
    ann, bob, olga = place.holding("ann"), place.connection("bob"), place.connection("olga", Level.OWNER)
    for each in (ann, bob, olga):
        each.when_told = lambda each=each: place.desk.left(each)
    result(place.desk.take(bob, ""))
    assert place.desk.lease.state is LeaseState.FREE, "she was told of the request, and left"
    ann, bob = place.holding("ann"), place.connection("bob")
    bob.when_told = lambda: place.desk.left(bob)
    result(place.desk.take(bob, ""))
    result(place.desk.take(olga, ""))
    assert place.desk.lease.requested_by(olga)
    place.desk.refuse(ann, "")
    assert place.desk.lease.held_by(ann)
    bob = place.connection("bob")
    bob.when_told = lambda: place.desk.left(bob)
    place.clock.advance(REST_SECONDS)
    result(place.desk.take(bob, ""))
    ann.when_told = lambda: place.desk.left(ann)
    place.desk.left(ann)
    assert place.desk.lease.state is LeaseState.FREE
    ann = place.holding("ann")
    ann.when_told = lambda: place.desk.left(ann)
    place.offline()
    assert place.desk.lease.state is LeaseState.FREE
    assert place.online().desk.lease.state is LeaseState.FREE
    ann = place.holding("ann", Level.OWNER)
    ann.when_told = lambda: place.desk.left(ann)
    second = place.connection("ann")
    second.permit = ann.permit
    assert result(place.desk.take(second, "")).success
    assert place.desk.lease.held_by(second)


def test_a_robot_with_many_orders_to_answer_is_told_all_the_same_that_nobody_has_it(place: Place) -> None:
    """Given back, and after an answer that never came."""
    ann = place.holding()
    place.link.silent = True
    for _ in range(WAITING):
        place.desk.orders.give(lambda id: link.Inhibit(id=id, resource="/x", ms=1, by="x")).addErrback(str)
    place.desk.release(ann, "")
    assert place.link.holders == [ann.number, 0]
    place.clock.advance(3.1)
    outcome(place.desk.take(ann, ""))
    for _ in range(WAITING):
        place.desk.orders.give(
            lambda id: link.Inhibit(id=id, resource="/x", ms=1, by="x"), seconds=60
        ).addErrback(str)
    place.clock.advance(3.1)
    assert place.link.holders == [ann.number, 0, ann.number, 0]


# --- commands ---------------------------------------------------------------------------------------------


def test_the_first_command_takes_a_free_robot(place: Place) -> None:
    """It waits for the robot's word; the record says how control was taken."""
    place.link.silent = True
    ann, bob = place.connection("ann"), place.connection("bob")
    assert place.desk.claim(ann) is False
    assert place.desk.claim(ann) is False
    assert len(place.link.holders) == 1
    with pytest.raises(Refused, match="rover is controlled by ann"):
        place.desk.claim(bob)
    place.link.answers(place.link.orders(link.Control)[0])
    assert place.desk.claim(ann) is True
    assert ann.changes > 0
    assert place.record.notes == [("control.taken", "ann", "its first command", {"how": "taken"})]


def test_who_lost_it_in_the_middle_lets_go_first(place: Place) -> None:
    """Whoever goes on commanding does not get it back by that; asking for it is another thing."""
    ann = place.connection()
    assert not place.desk.claim(ann)
    place.desk.release(ann, "", Actor("olga", "user:olga"))
    for _ in range(3):
        place.clock.advance(0.4)
        with pytest.raises(Refused, match="let go for"):
            place.desk.claim(ann)
    place.clock.advance(0.6)
    assert not place.desk.claim(ann)
    assert place.desk.lease.held_by(ann)
    place.desk.release(ann, "", Actor("olga", "user:olga"))
    assert result(place.desk.take(ann, "")).success


def test_asking_for_control_is_no_letting_go(place: Place) -> None:
    """Who has asked and not got it takes nothing by going on."""
    ann, bob = place.holding("ann"), place.connection("bob")
    place.desk.release(ann, "", Actor("olga", "user:olga"))
    result(place.desk.take(bob, ""))
    assert not result(place.desk.take(ann, "")).success
    place.desk.release(bob, "")
    with pytest.raises(Refused, match="let go for"):
        place.desk.claim(ann)


def test_who_commands_a_robot_that_is_away_lets_go_first(place: Place) -> None:
    """It does not move the moment it is back."""
    ann = place.connection()
    place.desk.unheard(ann)
    with pytest.raises(Refused, match="let go"):
        place.desk.claim(ann)
    place.clock.advance(0.6)
    assert not place.desk.claim(ann)


def test_who_comes_back_by_another_connection_lets_go_first(place: Place) -> None:
    """The stick is where it was; who had let go, has given control back or is somebody else just takes it."""
    ann, again, bob = place.holding("ann"), place.connection("ann"), place.connection("bob")
    again.permit = ann.permit
    ann.commanded = place.clock.seconds()
    place.desk.left(ann)
    for _ in range(2):
        place.clock.advance(0.4)
        with pytest.raises(Refused, match="let go for"):
            place.desk.claim(again)
    third = place.connection("ann")
    third.permit = ann.permit
    place.desk.left(again)
    with pytest.raises(Refused, match="let go for"):
        place.desk.claim(third)
    place.desk.claim(bob)
    assert place.desk.lease.held_by(bob)
    place.desk.release(bob, "")
    place.clock.advance(0.6)
    place.desk.claim(third)
    assert place.desk.lease.held_by(third)
    third.commanded = place.clock.seconds()
    place.desk.release(third, "")
    place.desk.left(third)
    place.desk.claim(ann)
    assert place.desk.lease.held_by(ann)
    place.clock.advance(0.6)
    place.desk.left(ann)
    place.desk.claim(again)
    assert place.desk.lease.held_by(again), "the latest command of ann was long ago"


class Returning(NamedTuple):
    """Somebody whose connection is gone, and who may come back."""

    place: Place
    gone: Connection

    def back(self, after: float) -> Connection:
        """His new connection, so many seconds later."""
        self.place.clock.advance(after)
        again = self.place.connection(self.gone.name)
        again.permit = self.gone.permit
        return again


def driving(place: Place) -> Returning:
    """Somebody who commands, and is there."""
    ann = place.holding("ann")
    ann.commanded = ann.alive = place.clock.seconds()
    return Returning(place, ann)


def lets_go_first(place: Place, again: Connection) -> None:
    """However long he commands, he has the robot only after he has been silent."""
    for _ in range(20):
        with pytest.raises(Refused, match="let go for"):
            place.desk.claim(again)
        place.clock.advance(0.2)
    place.clock.advance(0.5)
    place.desk.claim(again)
    assert place.desk.lease.held_by(again)


@pytest.mark.parametrize("after", [0.0, 1.0, 4.9])
def test_to_connect_anew_is_no_letting_go(place: Place, after: float) -> None:
    """What was lost says nothing of the stick; who lets go by the new connection, or asks for control, has it."""
    ann = driving(place)
    place.desk.left(ann.gone)
    again = ann.back(after)
    lets_go_first(place, again)


def test_who_asks_for_control_by_a_new_connection_has_it(place: Place) -> None:
    """His session holds back what he goes on commanding."""
    ann = driving(place)
    place.desk.left(ann.gone)
    again = ann.back(1.0)
    with pytest.raises(Refused, match="let go for"):
        place.desk.claim(again)
    assert result(place.desk.take(again, "")).success


def test_who_closes_his_connection_or_had_let_go_comes_back_as_he_came_first(place: Place) -> None:
    """A program that is run again, and a hand that had been off the stick for a while."""
    ann = driving(place)
    place.desk.left(ann.gone, orderly=True)
    again = ann.back(0.6)
    place.desk.claim(again)
    assert place.desk.lease.held_by(again)
    again.commanded = place.clock.seconds()
    again.alive = again.commanded + 1.5
    place.clock.advance(2.0)
    place.desk.left(again)
    last = ann.back(0.1)
    place.desk.claim(last)
    assert place.desk.lease.held_by(last)


def test_what_may_have_waited_for_a_new_connection_moves_nothing(place: Place) -> None:
    """Libraries send it at once; who comes back so late is no driver any more, and begins a moment later."""
    ann = driving(place)
    place.desk.left(ann.gone)
    again = ann.back(60.0)
    with pytest.raises(Refused, match="may have waited"):
        place.desk.claim(again)
    place.clock.advance(0.5)
    place.desk.claim(again)
    assert place.desk.lease.held_by(again)
    again.commanded = again.alive = place.clock.seconds()
    place.desk.left(again)
    late = ann.back(301.0)
    place.desk.claim(late)
    assert place.desk.lease.held_by(late)


def test_who_comes_back_before_his_connection_is_known_to_be_lost_lets_go_first(place: Place) -> None:
    """The one that has control says nothing any more; the other opens while the first still counts."""
    ann = driving(place)
    again = ann.back(3.0)
    lets_go_first(place, again)


def test_users_who_are_remembered_are_bounded(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    """The oldest are forgotten first."""
    monkeypatch.setattr(rearm, "USERS", 2)
    gone = [place.connection(name) for name in ("ann", "bob", "eve")]
    for each in gone:
        place.desk.unheard(each)
        place.desk.left(each)
    place.desk.claim(gone[0])
    assert place.desk.lease.coming_to(gone[0]) or place.desk.lease.held_by(gone[0])
    place.desk.release(gone[0], "")
    with pytest.raises(Refused, match="let go for"):
        place.desk.claim(gone[2])


def test_a_command_never_takes_what_is_held(place: Place) -> None:
    """Not even an owner's; it is told who has it."""
    place.holding("ann")
    with pytest.raises(Refused, match=r"controlled by ann; ask for it with /relay/take_control"):
        place.desk.claim(place.connection("olga", Level.OWNER))


def test_a_user_takes_it_from_a_connection_of_his_own(place: Place) -> None:
    """By asking at once; by a command when the other one commands no more, and the robot stands."""
    first, second = place.holding("ann"), place.connection("ann")
    second.permit = first.permit
    first.commanded = place.clock.seconds()
    with pytest.raises(Refused, match="controlled by ann"):
        place.desk.claim(second)
    place.clock.advance(2.1)
    place.desk.told(link.Safety(holder=first.number, moving=True))
    with pytest.raises(Refused, match="controlled by ann"):
        place.desk.claim(second)
    place.desk.told(link.Safety(holder=first.number))
    place.desk.claim(second)
    assert place.desk.passes(second, "/cmd_vel")
    assert first.told == ["you have lost control of rover: the same user commands from another connection"]
    assert result(place.desk.take(first, "")).success
    assert place.desk.passes(first, "/cmd_vel")


def test_where_control_is_explicit_no_command_takes_it() -> None:
    """It is told what to do."""
    place = Place(ControlRules(explicit=True)).online()
    with pytest.raises(Refused, match="nobody controls robot rover: take control first"):
        place.desk.claim(place.connection())
    assert place.link.holders == []


def test_a_call_that_moves_waits_for_control(place: Place) -> None:
    """And fails when the robot does not agree."""
    place.link.silent = True
    asked = outcome(place.desk.claimed(place.connection()))
    assert asked == []
    place.link.answers(place.link.orders(link.Control)[0])
    assert asked == [None]
    refused = outcome(place.desk.claimed(place.connection("bob")))
    assert "controlled by ann" in str(refused[0])


# --- being told -------------------------------------------------------------------------------------------


def test_changes_are_told_together_ten_times_a_second(place: Place) -> None:
    """At once when it was quiet, and what is between the robot's being asked and its answer is not told."""
    told: list[LeaseState] = []
    place.desk.pushing.follow("me", lambda: told.append(place.desk.lease.state))
    ann = place.holding()
    place.clock.advance(0)
    assert told == [LeaseState.HELD]
    for moving in (True, False) * 5:
        place.desk.told(link.Safety(holder=ann.number, moving=moving))
    place.clock.advance(0.05)
    assert len(told) == 1
    place.clock.advance(0.06)
    assert len(told) == 2
    place.desk.pushing.forget("me")
    place.desk.release(ann, "")
    place.clock.advance(1)
    assert len(told) == 2


def test_what_commands_are_judged_by_is_one_object_while_nothing_changes(place: Place) -> None:
    """A health report or a moving robot is no change; another lease or a stop is."""
    standing = place.desk.standing
    place.desk.told(link.Safety(moving=True))
    assert place.desk.standing is standing
    place.desk.told(link.Safety(stopped=link.Stopped(by="ann", since=1.0)))
    assert place.desk.standing is not standing
