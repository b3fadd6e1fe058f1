"""Control of one robot: one connection at a time, and only after the robot has agreed."""

from __future__ import annotations

from math import inf
from typing import Any, NamedTuple

import pytest

from relay_protocol import link
from relay_protocol.errors import Refused, Unavailable
from relay_protocol.rights import Grant, Level, Rules
from relay_server.control import controller as module
from relay_server.control.actor import Actor
from relay_server.control.lease import LeaseState
from relay_server.control.orders import MAX_PENDING
from relay_server.control.types import REFUSED_SECONDS, ControlRules
from tests.worlds.control import Connection, ControlWorld, outcome, result


@pytest.fixture
def scene() -> ControlWorld:
    """A robot that is online and obeys."""
    return ControlWorld().online()


# --- taking control ---------------------------------------------------------------------------------------


def test_a_free_robot_is_taken_once_it_has_agreed(scene: ControlWorld) -> None:
    """The waiting request is answered then; the robot knows the controller and its level."""
    scene.link.silent = True
    ann = scene.connection()
    asked = outcome(scene.service.take(ann, "delivery"))
    (order,) = scene.link.orders(link.ControlGrant)
    assert (order.holder, order.user, order.level, order.why) == (ann.number, "ann", "operator", "delivery")
    assert (asked, scene.service.may_command(ann, "/cmd_vel")) == ([], False)
    scene.link.answers(order)
    assert asked[0].success
    assert scene.service.may_command(ann, "/cmd_vel")
    assert scene.record.notes == [("control.taken", "ann", "delivery", {"how": "taken"})]


def test_control_needs_the_right(scene: ControlWorld) -> None:
    """It is checked by level and by denying patterns."""
    viewer = scene.connection(level=Level.VIEWER)
    denied = scene.connection(level=Level.OWNER, deny=("control:/",))
    with pytest.raises(Refused, match="control on / needs the level operator"):
        result(scene.service.take(viewer, ""))
    with pytest.raises(Refused, match="denied to you"):
        result(scene.service.take(denied, ""))
    assert scene.link.holders == []


def test_a_robot_that_does_not_answer_is_free_again_and_the_request_fails(scene: ControlWorld) -> None:
    """The robot may have received the request, so it is notified that it has no controller."""
    scene.link.silent = True
    ann = scene.connection()
    asked = outcome(scene.service.take(ann, ""))
    scene.clock.advance(3.1)
    assert isinstance(asked[0], Unavailable)
    assert scene.service.lease.state is LeaseState.FREE
    assert scene.link.holders == [ann.number, 0]
    assert ann.reported == ["you did not get control of rover: robot rover did not answer within 3 s"]
    scene.link.answers(scene.link.orders(link.ControlGrant)[0])
    assert not scene.service.may_command(ann, "/cmd_vel"), "an answer that comes too late gives nothing"


def test_pending_take_counts_when_the_robot_does_not_answer(scene: ControlWorld) -> None:
    """The precautionary release does not withdraw the new control."""
    scene.link.silent = True
    ann, bob = scene.connection("ann"), scene.connection("bob")
    first, second = outcome(scene.service.take(ann, "")), outcome(scene.service.take(bob, ""))
    scene.clock.advance(3.1)
    assert isinstance(first[0], Unavailable)
    assert scene.link.holders == [ann.number, 0, bob.number]
    scene.link.answers(scene.link.orders(link.ControlGrant)[-1])
    assert second[0].success
    assert scene.service.lease.held_by(bob)
    assert scene.record.kinds == ["control.lost", "control.taken"]


def test_a_robot_that_refuses_is_free(scene: ControlWorld) -> None:
    """The error has the robot's reason."""
    scene.link.unable = "the key switch is off"
    (error,) = outcome(scene.service.take(scene.connection(), ""))
    assert "the key switch is off" in str(error)
    assert scene.service.lease.state is LeaseState.FREE


def test_a_robot_that_is_offline_can_not_be_taken() -> None:
    scene = ControlWorld()
    with pytest.raises(Unavailable, match="rover is offline"):
        result(scene.service.take(scene.connection(), ""))


def test_taking_again_changes_nothing(scene: ControlWorld) -> None:
    """The caller has control already."""
    ann = scene.holding()
    assert result(scene.service.take(ann, "")).success
    assert scene.link.holders == [ann.number]


def test_two_simultaneous_requests_are_distinguished(scene: ControlWorld) -> None:
    """The second one finds the robot controlled and becomes a control request."""
    scene.link.silent = True
    ann, bob = scene.connection("ann"), scene.connection("bob")
    first, second = outcome(scene.service.take(ann, "")), outcome(scene.service.take(bob, ""))
    scene.link.answers(scene.link.orders(link.ControlGrant)[0])
    assert first[0].success
    assert second[0] == (False, "ann has control and was asked for it")
    assert scene.service.lease.requested_by(bob)


def test_waiting_user_without_right_gets_no_control(scene: ControlWorld) -> None:
    """Rights are checked at the request and again when control is passed."""
    scene.link.silent = True
    ann, bob = scene.connection("ann"), scene.connection("bob")
    first, second = outcome(scene.service.take(ann, "")), outcome(scene.service.take(bob, ""))
    bob.permit.rules = Rules([Grant(Level.OPERATOR, deny=("control:/",))])
    scene.service.rights_changed(bob)
    scene.link.silent = False
    scene.link.unable = "the key switch is off"
    scene.link.answers(scene.link.orders(link.ControlGrant)[0])
    assert "key switch" in str(first[0])
    assert isinstance(second[0], Refused)
    assert bob.number not in scene.link.holders


def test_too_frequent_takes_are_refused(scene: ControlWorld) -> None:
    """Requests and commands count, over all connections of a user; other users are not limited."""
    ann, second = scene.connection("ann"), scene.connection("ann")
    second.permit = ann.permit
    for _ in range(10):
        for each in (ann, second):
            assert result(scene.service.take(each, "")).success
            scene.service.release(each, "")
    for ask in (
        lambda: result(scene.service.take(ann, "")),
        lambda: scene.service.acquire_by_command(second),
    ):
        with pytest.raises(Refused, match="too often: 5 times a second at most"):
            ask()
    assert result(scene.service.take(scene.connection("bob"), "")).success
    scene.clock.advance(0.2)
    assert not result(scene.service.take(ann, "")).success, "asked for, as bob has it"


# --- control requests -------------------------------------------------------------------------------------


def test_the_holder_passes_control_on(scene: ControlWorld) -> None:
    """No client moves the robot in between: it stops for the first before it obeys the second."""
    ann, bob = scene.holding("ann"), scene.connection("bob")
    assert not result(scene.service.take(bob, "my turn")).success
    assert ann.reported == ["bob asks for control of rover: my turn"]
    scene.link.silent = True
    assert scene.service.grant(ann, "").success
    assert not scene.service.may_command(ann, "/cmd_vel")
    assert not scene.service.may_command(bob, "/cmd_vel")
    scene.link.answers(scene.link.orders(link.ControlGrant)[-1])
    assert scene.service.may_command(bob, "/cmd_vel")
    assert scene.record.kinds == ["control.taken", "control.requested", "control.granted", "control.taken"]


def test_the_holder_keeps_it(scene: ControlWorld) -> None:
    """The requester gets the reason and may ask again later."""
    ann, bob = scene.holding("ann"), scene.connection("bob")
    result(scene.service.take(bob, ""))
    assert scene.service.refuse(ann, "in a narrow lane").success
    assert bob.reported == ["ann keeps control of rover: in a narrow lane"]
    assert scene.service.lease.request is None
    assert scene.service.may_command(ann, "/cmd_vel")
    assert scene.record.kinds[-1] == "control.refused"
    scene.clock.advance(REFUSED_SECONDS)
    assert not result(scene.service.take(bob, "")).success
    assert scene.service.lease.requested_by(bob)


def test_refused_client_does_not_retry_at_once(scene: ControlWorld) -> None:
    """This covers all connections of the user. Others may ask, and the user may ask another controller."""
    ann, bob, eve = scene.holding("ann"), scene.connection("bob"), scene.connection("eve")
    again = scene.connection("bob")
    again.permit = bob.permit
    result(scene.service.take(bob, ""))
    scene.service.refuse(ann, "")
    scene.clock.advance(0.5)
    for each in (bob, again):
        with pytest.raises(Refused, match="ann has just kept control of rover; ask again in 10 s"):
            result(scene.service.take(each, ""))
    assert scene.service.lease.request is None
    assert scene.record.kinds[-1] == "control.refused"
    result(scene.service.take(eve, ""))
    scene.service.grant(ann, "")
    assert not result(scene.service.take(bob, "")).success
    assert scene.service.lease.requested_by(bob)


def test_the_list_of_refused_users_is_bounded(scene: ControlWorld, monkeypatch: pytest.MonkeyPatch) -> None:
    """Beyond the limit the users who were refused first may ask again."""
    monkeypatch.setattr(module, "USERS", 2)
    ann = scene.holding("ann")
    asking = [scene.connection(name) for name in ("bob", "eve", "tom")]
    for each in asking:
        result(scene.service.take(each, ""))
        scene.service.refuse(ann, "")
    for each in asking[1:]:
        with pytest.raises(Refused):
            result(scene.service.take(each, ""))
    assert not result(scene.service.take(asking[0], "")).success


def test_an_answer_goes_to_the_client_that_requested(scene: ControlWorld) -> None:
    """Another user may have asked while the answer was under way; they get neither control nor a refusal by
    it.
    """
    ann, bob, olga = scene.holding("ann"), scene.connection("bob"), scene.connection("olga", Level.OWNER)
    result(scene.service.take(bob, ""))
    result(scene.service.take(olga, ""))
    words = "that request has ended; olga requests control now, and has no answer yet"
    assert scene.service.grant(ann, "", bob.number) == (False, words)
    assert scene.service.refuse(ann, "", bob.number) == (False, words)
    assert scene.service.lease.requested_by(olga)
    assert scene.service.grant(ann, "", olga.number).success
    assert scene.service.lease.held_by(olga)


def test_a_program_that_does_not_answer_loses_control_after_the_grace_time(scene: ControlWorld) -> None:
    """It took the robot by a command. A second request after that time gets control, and both clients are
    notified.
    """
    program, ann = scene.connection("program"), scene.connection("ann")
    result(scene.service.wait_for_control(program))
    assert not result(scene.service.take(ann, "")).success
    scene.clock.advance(29)
    answer = result(scene.service.take(ann, ""))
    assert answer == (
        False,
        "program has control and was asked for it already; after 1 s ask again to take over",
    )
    scene.clock.advance(1)
    assert result(scene.service.take(ann, "")) == (True, "you have control")
    assert scene.service.lease.held_by(ann)
    assert program.reported[-1] == "you have lost control of rover: ann has taken over"
    with pytest.raises(Refused, match=r"release the controls for 0\.5 s"):
        scene.service.acquire_by_command(program)


@pytest.mark.parametrize("how", ["asked", "granted", "asked once more"])
def test_own_control_request_is_not_taken_over(scene: ControlWorld, how: str) -> None:
    """Except by an owner."""
    ann, bob = scene.connection("ann"), scene.connection("bob")
    if how == "asked":
        result(scene.service.take(ann, ""))
    elif how == "granted":
        program = scene.connection("program")
        result(scene.service.wait_for_control(program))
        result(scene.service.take(ann, ""))
        scene.service.grant(program, "")
    else:
        result(scene.service.wait_for_control(ann))
        assert scene.service.lease.holder is not None
        assert scene.service.lease.holder.implicit
        assert result(scene.service.take(ann, "")) == (True, "you have control")
    assert not result(scene.service.take(bob, "")).success
    scene.clock.advance(31)
    assert not result(scene.service.take(bob, "")).success
    assert scene.service.lease.held_by(ann)


def test_only_the_holder_answers(scene: ControlWorld) -> None:
    """And only if there is a request."""
    ann, bob = scene.holding("ann"), scene.connection("bob")
    assert scene.service.grant(ann, "") == (False, "there is no request for control")
    result(scene.service.take(bob, ""))
    assert scene.service.grant(bob, "") == (False, "you have no control of this robot")
    assert scene.service.refuse(bob, "") == (False, "you have no control of this robot")


def test_control_request_of_an_owner_replaces_others(scene: ControlWorld) -> None:
    """The displaced client is notified."""
    scene.holding("ann")
    bob, eve = scene.connection("bob"), scene.connection("eve")
    olga, otto = scene.connection("olga", Level.OWNER), scene.connection("otto", Level.OWNER)
    result(scene.service.take(bob, ""))
    assert "bob asks for it already" in result(scene.service.take(eve, "")).message
    result(scene.service.take(olga, ""))
    assert scene.service.lease.requested_by(olga)
    assert bob.reported == ["olga asks for control of rover before you"]
    assert "olga asks for it already" in result(scene.service.take(otto, "")).message


def test_an_owner_takes_over_after_the_grace_time(scene: ControlWorld) -> None:
    """Not before, not without a request; others never do."""
    ann, olga = scene.holding("ann"), scene.connection("olga", Level.OWNER)
    assert not result(scene.service.take(olga, "")).success
    scene.clock.advance(29.9)
    assert "after 0 s ask again to take over" in result(scene.service.take(olga, "")).message
    scene.clock.advance(0.2)
    assert result(scene.service.take(olga, "danger")).success
    assert scene.service.may_command(olga, "/cmd_vel")
    assert ann.reported[-1] == "you have lost control of rover: olga has taken over"
    assert scene.record.kinds[-2:] == ["control.lost", "control.taken"]
    bob = scene.connection("bob")
    result(scene.service.take(bob, ""))
    scene.clock.advance(60)
    assert not result(scene.service.take(bob, "")).success
    assert scene.service.may_command(olga, "/cmd_vel")


def test_a_request_ends_with_its_connection_or_is_taken_back(scene: ControlWorld) -> None:
    """The controller keeps control."""
    ann = scene.holding("ann")
    for end in (scene.service.client_left, lambda client: scene.service.release(client, "")):
        bob = scene.connection("bob")
        result(scene.service.take(bob, ""))
        end(bob)
        assert scene.service.lease.request is None
        assert scene.service.may_command(ann, "/cmd_vel")


def test_every_end_of_a_request_is_on_record(scene: ControlWorld) -> None:
    """The audit entry has user and reason; no later answer is expected."""
    ann = scene.holding("ann")
    olga = scene.connection("olga", Level.OWNER)

    def asks() -> Connection:
        scene.clock.advance(5)
        bob = scene.connection("bob")
        assert not result(scene.service.take(bob, "")).success
        return bob

    def ended() -> tuple[str, str, str, dict[str, Any]]:
        (note,) = [each for each in scene.record.notes if each[0] in ("control.lapsed", "control.withdrawn")]
        scene.record.notes.clear()
        return note

    scene.service.release(asks(), "changed my mind")
    assert ended() == ("control.withdrawn", "bob", "changed my mind", {})
    scene.service.release(asks(), "enough", Actor("olga", "user:olga", olga.user))
    assert ended() == ("control.withdrawn", "olga", "enough", {"of": "bob"})
    scene.service.client_left(asks())
    assert ended() == ("control.lapsed", "bob", "the connection has ended", {})
    asks()
    result(scene.service.take(olga, ""))
    assert ended() == ("control.lapsed", "bob", "olga asks for it before", {})
    scene.service.client_left(olga)
    assert ended()[:2] == ("control.lapsed", "olga")
    bob = asks()
    second = scene.connection("ann")
    second.permit = ann.permit
    assert result(scene.service.take(second, "")).success
    assert ended() == ("control.lapsed", "bob", "ann gets it", {})
    assert bob.reported == ["your request for control of rover has ended: ann gets it"]
    asks()
    scene.service.client_left(second)
    assert ended() == ("control.lapsed", "bob", "the connection has ended", {})
    assert result(scene.service.take(ann, "")).success
    asks()
    scene.offline()
    assert ended() == ("control.lapsed", "bob", "the robot's link was lost", {})
    assert scene.service.lease.request is None


def test_an_answer_to_a_request_is_no_lapse(scene: ControlWorld) -> None:
    """Neither yes, no, nor an owner's taking over after the grace time counts as lapsed."""
    ann, bob, olga = scene.holding("ann"), scene.connection("bob"), scene.connection("olga", Level.OWNER)
    result(scene.service.take(bob, ""))
    scene.service.refuse(ann, "")
    scene.clock.advance(REFUSED_SECONDS)
    result(scene.service.take(bob, ""))
    scene.service.grant(ann, "")
    result(scene.service.take(olga, ""))
    scene.clock.advance(31)
    assert result(scene.service.take(olga, "")).success
    assert "control.lapsed" not in scene.record.kinds


def test_a_request_without_an_answer_expires(scene: ControlWorld) -> None:
    """Both clients are notified, it is audited, and others may ask; the controller keeps control."""
    ann, bob, eve = scene.holding("ann"), scene.connection("bob"), scene.connection("eve")
    result(scene.service.take(bob, "my turn"))
    scene.clock.advance(59.9)
    assert not result(scene.service.take(bob, "")).success
    assert "bob asks for it already" in result(scene.service.take(eve, "")).message
    scene.clock.advance(0.1)
    assert scene.service.lease.request is None
    assert bob.reported == [
        "your request for control of rover has ended: no answer within 60 s; request it again"
    ]
    assert ann.reported[-1] == "the request of bob for control of rover has ended: no answer within 60 s"
    assert scene.record.notes[-1] == ("control.lapsed", "bob", "no answer within 60 s", {})
    assert scene.service.may_command(ann, "/cmd_vel")
    result(scene.service.take(eve, ""))
    assert scene.service.lease.requested_by(eve)


def test_an_idle_owners_request_blocks_no_other_owner_for_long(scene: ControlWorld) -> None:
    """The next owner's request has the full grace time and lifetime again."""
    scene.holding("ann")
    olga, otto = scene.connection("olga", Level.OWNER), scene.connection("otto", Level.OWNER)
    result(scene.service.take(olga, ""))
    scene.clock.advance(60)
    assert not result(scene.service.take(otto, "")).success
    assert scene.service.lease.requested_by(otto)
    scene.clock.advance(30)
    assert not result(scene.service.take(olga, "")).success
    assert result(scene.service.take(otto, "")).success
    scene.clock.advance(120)
    assert scene.service.may_command(otto, "/cmd_vel")


# --- end of control ---------------------------------------------------------------------------------------


def test_released_control_is_free_once_the_robot_has_agreed(scene: ControlWorld) -> None:
    """A request made meanwhile waits, and gets control."""
    ann, bob = scene.holding("ann"), scene.connection("bob")
    scene.link.silent = True
    assert scene.service.release(ann, "done").success
    assert not scene.service.may_command(ann, "/cmd_vel")
    asked = outcome(scene.service.take(bob, ""))
    assert scene.link.holders == [ann.number, 0]
    scene.link.silent = False
    scene.link.answers(scene.link.orders(link.ControlGrant)[-1])
    assert asked[0].success
    assert scene.link.holders == [ann.number, 0, bob.number]
    assert scene.record.notes[1] == ("control.released", "ann", "done", {})


def test_a_robot_that_does_not_confirm_the_end_is_free_all_the_same(scene: ControlWorld) -> None:
    """No client's commands pass meanwhile."""
    ann = scene.holding()
    scene.link.silent = True
    scene.service.release(ann, "")
    scene.clock.advance(3.1)
    assert scene.service.lease.state is LeaseState.FREE


def test_release_without_control_does_nothing(scene: ControlWorld) -> None:
    """Another user's control stays too."""
    ann = scene.holding("ann")
    assert not scene.service.release(scene.connection("bob"), "").success
    assert scene.service.may_command(ann, "/cmd_vel")


def test_it_ends_with_the_connection(scene: ControlWorld) -> None:
    """This holds while the robot is being asked. The audit entry says whether it was moving."""
    ann = scene.holding()
    scene.service.message_received(link.MotionState(holder=ann.number, moving=True))
    scene.service.client_left(ann)
    assert scene.service.lease.state is LeaseState.FREE
    assert scene.record.notes[-1] == ("control.lost", "ann", "the connection has ended", {"moving": True})
    scene.link.silent = True
    bob = scene.connection("bob")
    outcome(scene.service.take(bob, ""))
    scene.service.client_left(bob)
    scene.link.silent = False
    for order in scene.link.orders(link.ControlGrant)[-2:]:
        scene.link.answers(order)
    assert scene.service.lease.state is LeaseState.FREE
    assert scene.link.holders[-2:] == [bob.number, 0]


@pytest.mark.parametrize(("alive", "moving"), [(1000.0, True), (1000.4, True), (1000.5, False), (inf, False)])
def test_lost_driver_loses_control_of_a_moving_robot(scene: ControlWorld, alive: float, moving: bool) -> None:
    """Even if the robot has stopped itself by then. This excludes clients that were active since or had
    released.
    """
    ann = scene.holding()
    scene.service.message_received(link.MotionState(holder=ann.number, moving=True))
    scene.clock.advance(0.4)
    scene.service.message_received(link.MotionState(holder=ann.number))
    scene.clock.advance(5.6)
    ann.alive = alive
    scene.service.client_left(ann)
    assert scene.record.notes[-1] == ("control.lost", "ann", "the connection has ended", {"moving": moving})


def test_new_controller_does_not_lose_control_for_the_previous_one(scene: ControlWorld) -> None:
    """Motion before the new controller took control was not theirs."""
    ann = scene.holding("ann")
    scene.service.message_received(link.MotionState(holder=ann.number, moving=True))
    scene.service.message_received(link.MotionState(holder=ann.number))
    scene.service.release(ann, "")
    bob = scene.holding("bob")
    bob.alive = scene.clock.seconds()
    scene.service.client_left(bob)
    assert scene.record.notes[-1] == ("control.lost", "bob", "the connection has ended", {"moving": False})


def test_it_ends_with_the_right(scene: ControlWorld) -> None:
    """The reason is given. A lower level that may still control keeps control, with other limits."""
    ann = scene.holding(level=Level.OWNER)
    ann.permit.rules = Rules([Grant(Level.OPERATOR)])
    scene.service.rights_changed(ann)
    assert scene.service.may_command(ann, "/cmd_vel")
    assert [order.level for order in scene.link.orders(link.ControlGrant)] == ["owner", "operator"]
    ann.permit.rules = Rules([Grant(Level.VIEWER)])
    scene.service.rights_changed(ann)
    assert not scene.service.may_command(ann, "/cmd_vel")
    assert scene.link.holders[-1] == 0
    assert "needs the level operator" in ann.reported[-1]


def test_control_ends_with_the_robots_link_and_is_acquired_again(scene: ControlWorld) -> None:
    """A robot that reconnects has no controller."""
    ann = scene.holding()
    scene.offline()
    assert scene.service.lease.state is LeaseState.FREE
    assert ann.reported == ["you have lost control of rover: the robot's link was lost"]
    assert scene.record.kinds == ["control.taken", "control.lost"]
    scene.online()
    assert scene.link.holders == []
    assert not scene.service.may_command(ann, "/cmd_vel")
    assert result(scene.service.take(ann, "")).success


def test_a_link_that_is_lost_while_the_robot_is_asked_ends_it(scene: ControlWorld) -> None:
    """The waiting client gets the error that the robot is offline."""
    scene.link.silent = True
    asked = outcome(scene.service.take(scene.connection(), ""))
    scene.offline()
    assert "offline" in str(asked[0])
    assert scene.service.lease.state is LeaseState.FREE


def test_control_ends_when_commands_stop(scene: ControlWorld) -> None:
    """The time counts from the latest command, and not while the robot moves."""
    ann = scene.holding()
    scene.clock.advance(500)
    ann.commanded = scene.clock.seconds()
    scene.clock.advance(599)
    scene.service.message_received(link.MotionState(holder=ann.number, moving=True))
    scene.clock.advance(2)
    assert scene.service.may_command(ann, "/cmd_vel")
    scene.service.message_received(link.MotionState(holder=ann.number))
    scene.clock.advance(601)
    assert scene.service.lease.state is LeaseState.FREE
    assert ann.reported == ["you have lost control of rover: no moving command for 600 s"]


def test_no_state_remains_at_the_end(scene: ControlWorld) -> None:
    """No timer runs for a robot without a controller."""
    ann = scene.holding()
    scene.service.release(ann, "")
    scene.clock.advance(1)
    assert not [call for call in scene.clock.getDelayedCalls() if call.active()]


def test_cancelled_waiter_does_not_affect_others(scene: ControlWorld) -> None:
    """A cancelled call leaves no pending lease."""
    from twisted.internet.defer import Deferred

    scene.link.silent = True
    ann = scene.connection()
    waiting = Deferred.fromCoroutine(scene.service.take(ann, "")).addErrback(lambda failure: None)
    waiting.cancel()
    scene.link.answers(scene.link.orders(link.ControlGrant)[0])
    assert scene.service.may_command(ann, "/cmd_vel")


def test_subscriber_may_unsubscribe_during_a_notification(scene: ControlWorld) -> None:
    """A client that is disconnected for reading nothing affects no other."""
    ann, bob, olga = scene.holding("ann"), scene.connection("bob"), scene.connection("olga", Level.OWNER)
    for each in (ann, bob, olga):
        each.when_told = lambda each=each: scene.service.client_left(each)
    result(scene.service.take(bob, ""))
    assert scene.service.lease.state is LeaseState.FREE, "she was told of the request, and left"
    ann, bob = scene.holding("ann"), scene.connection("bob")
    bob.when_told = lambda: scene.service.client_left(bob)
    result(scene.service.take(bob, ""))
    result(scene.service.take(olga, ""))
    assert scene.service.lease.requested_by(olga)
    scene.service.refuse(ann, "")
    assert scene.service.lease.held_by(ann)
    bob = scene.connection("bob")
    bob.when_told = lambda: scene.service.client_left(bob)
    scene.clock.advance(REFUSED_SECONDS)
    result(scene.service.take(bob, ""))
    ann.when_told = lambda: scene.service.client_left(ann)
    scene.service.client_left(ann)
    assert scene.service.lease.state is LeaseState.FREE
    ann = scene.holding("ann")
    ann.when_told = lambda: scene.service.client_left(ann)
    scene.offline()
    assert scene.service.lease.state is LeaseState.FREE
    assert scene.online().service.lease.state is LeaseState.FREE
    ann = scene.holding("ann", Level.OWNER)
    ann.when_told = lambda: scene.service.client_left(ann)
    second = scene.connection("ann")
    second.permit = ann.permit
    assert result(scene.service.take(second, "")).success
    assert scene.service.lease.held_by(second)


def test_a_robot_with_many_pending_orders_still_learns_that_control_is_free(
    scene: ControlWorld,
) -> None:
    """Both after a release and after an unanswered request."""
    ann = scene.holding()
    scene.link.silent = True
    for _ in range(MAX_PENDING):
        scene.service.orders.send(lambda id: link.Inhibit(id=id, resource="/x", ms=1, by="x")).addErrback(str)
    scene.service.release(ann, "")
    assert scene.link.holders == [ann.number, 0]
    scene.clock.advance(3.1)
    outcome(scene.service.take(ann, ""))
    for _ in range(MAX_PENDING):
        scene.service.orders.send(
            lambda id: link.Inhibit(id=id, resource="/x", ms=1, by="x"), seconds=60
        ).addErrback(str)
    scene.clock.advance(3.1)
    assert scene.link.holders == [ann.number, 0, ann.number, 0]


# --- commands ---------------------------------------------------------------------------------------------


def test_the_first_command_takes_a_free_robot(scene: ControlWorld) -> None:
    """It waits for the robot's answer; the audit entry says how control was taken."""
    scene.link.silent = True
    ann, bob = scene.connection("ann"), scene.connection("bob")
    assert scene.service.acquire_by_command(ann) is False
    assert scene.service.acquire_by_command(ann) is False
    assert len(scene.link.holders) == 1
    with pytest.raises(Refused, match="rover is controlled by ann"):
        scene.service.acquire_by_command(bob)
    scene.link.answers(scene.link.orders(link.ControlGrant)[0])
    assert scene.service.acquire_by_command(ann) is True
    assert ann.changes > 0
    assert scene.record.notes == [("control.taken", "ann", "its first command", {"how": "taken"})]


def test_losing_control_while_commanding_requires_a_release(scene: ControlWorld) -> None:
    """Further commands do not take it back; a control request does."""
    ann = scene.connection()
    assert not scene.service.acquire_by_command(ann)
    scene.service.release(ann, "", Actor("olga", "user:olga"))
    for _ in range(3):
        scene.clock.advance(0.4)
        with pytest.raises(Refused, match="release the controls for"):
            scene.service.acquire_by_command(ann)
    scene.clock.advance(0.6)
    assert not scene.service.acquire_by_command(ann)
    assert scene.service.lease.held_by(ann)
    scene.service.release(ann, "", Actor("olga", "user:olga"))
    assert result(scene.service.take(ann, "")).success


def test_asking_for_control_is_no_release(scene: ControlWorld) -> None:
    """A client with a pending request takes no control by further commands."""
    ann, bob = scene.holding("ann"), scene.connection("bob")
    scene.service.release(ann, "", Actor("olga", "user:olga"))
    result(scene.service.take(bob, ""))
    assert not result(scene.service.take(ann, "")).success
    scene.service.release(bob, "")
    with pytest.raises(Refused, match="release the controls for"):
        scene.service.acquire_by_command(ann)


def test_commands_to_an_offline_robot_require_a_release(scene: ControlWorld) -> None:
    """It must not move as soon as it is back."""
    ann = scene.connection()
    scene.service.published_while_offline(ann)
    with pytest.raises(Refused, match="release the controls"):
        scene.service.acquire_by_command(ann)
    scene.clock.advance(0.6)
    assert not scene.service.acquire_by_command(ann)


def test_reconnect_requires_a_release(scene: ControlWorld) -> None:
    """The joystick may still be held. A client that had released, or another user, takes control at once."""
    ann, again, bob = scene.holding("ann"), scene.connection("ann"), scene.connection("bob")
    again.permit = ann.permit
    ann.commanded = scene.clock.seconds()
    scene.service.client_left(ann)
    for _ in range(2):
        scene.clock.advance(0.4)
        with pytest.raises(Refused, match="release the controls for"):
            scene.service.acquire_by_command(again)
    third = scene.connection("ann")
    third.permit = ann.permit
    scene.service.client_left(again)
    with pytest.raises(Refused, match="release the controls for"):
        scene.service.acquire_by_command(third)
    scene.service.acquire_by_command(bob)
    assert scene.service.lease.held_by(bob)
    scene.service.release(bob, "")
    scene.clock.advance(0.6)
    scene.service.acquire_by_command(third)
    assert scene.service.lease.held_by(third)
    third.commanded = scene.clock.seconds()
    scene.service.release(third, "")
    scene.service.client_left(third)
    scene.service.acquire_by_command(ann)
    assert scene.service.lease.held_by(ann)
    scene.clock.advance(0.6)
    scene.service.client_left(ann)
    scene.service.acquire_by_command(again)
    assert scene.service.lease.held_by(again), "the latest command of ann was long ago"


class Returning(NamedTuple):
    """A client whose connection is lost and that may reconnect."""

    scene: ControlWorld
    gone: Connection

    def back(self, after: float) -> Connection:
        """Its new connection, this many seconds later."""
        self.scene.clock.advance(after)
        again = self.scene.connection(self.gone.name)
        again.permit = self.gone.permit
        return again


def driving(scene: ControlWorld) -> Returning:
    """A client that commands and is connected."""
    ann = scene.holding("ann")
    ann.commanded = ann.alive = scene.clock.seconds()
    return Returning(scene, ann)


def must_release_first(scene: ControlWorld, again: Connection) -> None:
    """Commands are refused until the client has paused."""
    for _ in range(20):
        with pytest.raises(Refused, match="release the controls for"):
            scene.service.acquire_by_command(again)
        scene.clock.advance(0.2)
    scene.clock.advance(0.5)
    scene.service.acquire_by_command(again)
    assert scene.service.lease.held_by(again)


@pytest.mark.parametrize("after", [0.0, 1.0, 4.9])
def test_reconnecting_does_not_count_as_releasing(scene: ControlWorld, after: float) -> None:
    """After a lost connection the joystick's position is unknown. A release or a control request on the new
    connection gets control.
    """
    ann = driving(scene)
    scene.service.client_left(ann.gone)
    again = ann.back(after)
    must_release_first(scene, again)


def test_control_is_granted_to_a_new_connection(scene: ControlWorld) -> None:
    """The client's session still rejects its continued commands."""
    ann = driving(scene)
    scene.service.client_left(ann.gone)
    again = ann.back(1.0)
    with pytest.raises(Refused, match="release the controls for"):
        scene.service.acquire_by_command(again)
    assert result(scene.service.take(again, "")).success


def test_reconnecting_after_a_close_or_release_needs_no_release(scene: ControlWorld) -> None:
    """A program may be started again, or the joystick was released for a while."""
    ann = driving(scene)
    scene.service.client_left(ann.gone, orderly=True)
    again = ann.back(0.6)
    scene.service.acquire_by_command(again)
    assert scene.service.lease.held_by(again)
    again.commanded = scene.clock.seconds()
    again.alive = again.commanded + 1.5
    scene.clock.advance(2.0)
    scene.service.client_left(again)
    last = ann.back(0.1)
    scene.service.acquire_by_command(last)
    assert scene.service.lease.held_by(last)


def test_command_that_waited_for_a_new_connection_moves_nothing(scene: ControlWorld) -> None:
    """Libraries send it at once. A client that returns this late does not count as driving, and its next
    command is accepted.
    """
    ann = driving(scene)
    scene.service.client_left(ann.gone)
    again = ann.back(60.0)
    with pytest.raises(Refused, match="may have waited"):
        scene.service.acquire_by_command(again)
    scene.clock.advance(0.5)
    scene.service.acquire_by_command(again)
    assert scene.service.lease.held_by(again)
    again.commanded = again.alive = scene.clock.seconds()
    scene.service.client_left(again)
    late = ann.back(301.0)
    scene.service.acquire_by_command(late)
    assert scene.service.lease.held_by(late)


def test_early_reconnect_requires_a_release(scene: ControlWorld) -> None:
    """The connection with control has become silent, and the new one opens while it still counts."""
    ann = driving(scene)
    again = ann.back(3.0)
    must_release_first(scene, again)


def test_a_command_never_takes_what_is_held(scene: ControlWorld) -> None:
    """Not even an owner's. The error names the controller."""
    scene.holding("ann")
    with pytest.raises(Refused, match=r"controlled by ann; ask for it with /relay/take_control"):
        scene.service.acquire_by_command(scene.connection("olga", Level.OWNER))


def test_users_take_control_from_their_own_connection(scene: ControlWorld) -> None:
    """A control request gets it at once; a command does when the other connection has stopped commanding and
    the robot stands.
    """
    first, second = scene.holding("ann"), scene.connection("ann")
    second.permit = first.permit
    first.commanded = scene.clock.seconds()
    with pytest.raises(Refused, match="controlled by ann"):
        scene.service.acquire_by_command(second)
    scene.clock.advance(2.1)
    scene.service.message_received(link.MotionState(holder=first.number, moving=True))
    with pytest.raises(Refused, match="controlled by ann"):
        scene.service.acquire_by_command(second)
    scene.service.message_received(link.MotionState(holder=first.number))
    scene.service.acquire_by_command(second)
    assert scene.service.may_command(second, "/cmd_vel")
    assert first.reported == [
        "you have lost control of rover: the same user commands from another connection"
    ]
    assert result(scene.service.take(first, "")).success
    assert scene.service.may_command(first, "/cmd_vel")


def test_where_control_is_explicit_no_command_takes_it() -> None:
    """The error says what to do."""
    scene = ControlWorld(ControlRules(explicit=True)).online()
    with pytest.raises(Refused, match="no client controls robot rover: take control first"):
        scene.service.acquire_by_command(scene.connection())
    assert scene.link.holders == []


def test_a_call_that_moves_waits_for_control(scene: ControlWorld) -> None:
    """It fails when the robot does not agree."""
    scene.link.silent = True
    asked = outcome(scene.service.wait_for_control(scene.connection()))
    assert asked == []
    scene.link.answers(scene.link.orders(link.ControlGrant)[0])
    assert asked == [None]
    refused = outcome(scene.service.wait_for_control(scene.connection("bob")))
    assert "controlled by ann" in str(refused[0])


# --- notifications ----------------------------------------------------------------------------------------


def test_changes_are_published_together_ten_times_a_second(scene: ControlWorld) -> None:
    """The first change is published at once; states between request and answer are not published."""
    reported: list[LeaseState] = []
    scene.service.changes.follow("me", lambda: reported.append(scene.service.lease.state))
    ann = scene.holding()
    scene.clock.advance(0)
    assert reported == [LeaseState.HELD]
    for moving in (True, False) * 5:
        scene.service.message_received(link.MotionState(holder=ann.number, moving=moving))
    scene.clock.advance(0.05)
    assert len(reported) == 1
    scene.clock.advance(0.06)
    assert len(reported) == 2
    scene.service.changes.forget("me")
    scene.service.release(ann, "")
    scene.clock.advance(1)
    assert len(reported) == 2


def test_decision_about_commands_is_one_object_without_changes(scene: ControlWorld) -> None:
    """Health reports and motion do not change it; another lease or a stop does."""
    standing = scene.service.snapshot
    scene.service.message_received(link.MotionState(moving=True))
    assert scene.service.snapshot is standing
    scene.service.message_received(link.MotionState(stopped=link.Stopped(by="ann", since=1.0)))
    assert scene.service.snapshot is not standing
