"""A stop reaches the robot, now or when it connects."""

from __future__ import annotations

import pytest

from relay_db.queries import StopRecord
from relay_protocol import link
from relay_protocol.errors import Unavailable
from relay_server.access import LOOKUP_SECONDS
from relay_server.cli import admin_socket_client
from relay_server.control import stopping as module
from relay_server.control import stored_stops
from relay_server.control.actor import Actor, local_actor
from relay_server.control.service import CONFIRM_SECONDS
from relay_server.control.stop_fields import stop_id_of
from relay_server.control.stopping import STOP_SECONDS, StopIncomplete, StoppedSince
from relay_server.fleet import service as fleet
from robot_client.motion.hardware import KILL_SECONDS, SWITCH_SECONDS
from tests.worlds.control import ControlWorld, outcome, result
from tests.worlds.relay import World

ANN = Actor("ann", "user:ann", 7, "192.0.2.7", 3)
BOB = Actor("bob", "user:bob", 8, "192.0.2.8", 4)
LATER = 1 << 62
"""Sent after all there was."""


def test_a_robot_that_is_there_is_stopped_at_once() -> None:
    """The order is sent before anything is written; no stored stop is left."""
    scene = ControlWorld().online()
    assert result(scene.service.stopping.stop(ANN, "smoke")) is True
    (order,) = scene.link.orders(link.Stop)
    assert (order.by, order.why) == ("ann", "smoke")
    assert scene.record.stops == {}
    assert scene.record.kinds == ["robot.stopped"]


def test_robots_answer_counts_before_its_status() -> None:
    """Between its answer and its next status no client is notified of another state."""
    scene = ControlWorld().online()
    result(scene.service.stopping.stop(ANN, "smoke"))
    stopped = scene.service.snapshot.stopped
    assert stopped is not None
    assert (stopped.by, stopped.why, stopped.confirmed) == ("ann", "smoke", True)
    result(scene.service.stopping.resume(ANN, "", LATER))
    assert scene.service.snapshot.stopped is None
    scene.offline()
    result(scene.service.stopping.stop(ANN, "smoke"))
    scene.online()
    stopped = scene.service.snapshot.stopped
    assert stopped is not None
    assert stopped.confirmed


def test_a_stop_is_the_same_before_and_after_it_is_confirmed() -> None:
    """The robot gets the time of the order and reports it, so that a resume meanwhile is not refused."""
    scene = ControlWorld().online()
    scene.link.silent = True
    scene.service.stopping.stop(ANN, "smoke")
    stopped = scene.service.stopping.stopped
    (order,) = scene.link.orders(link.Stop)
    assert stopped is not None
    assert (stopped.confirmed, order.at) == (False, stopped.since)
    scene.link.answers(order)
    scene.service.message_received(
        link.MotionState(stopped=link.Stopped(by=order.by, why=order.why, since=order.at))
    )
    assert scene.service.stopping.stopped == stopped._replace(confirmed=True)


def test_a_stop_of_a_stopped_robot_is_sent() -> None:
    """The latest stop is shown until the robot is resumed; the robot itself reports only the first."""
    scene = ControlWorld().online()
    result(scene.service.stopping.stop(ANN, "smoke"))
    first = scene.service.snapshot.stopped
    assert first is not None
    scene.clock.advance(60)
    result(scene.service.stopping.stop(BOB, "somebody is below"))
    scene.service.message_received(
        link.MotionState(stopped=link.Stopped(by="ann", why="smoke", since=first.since))
    )
    then = scene.service.snapshot.stopped
    assert then is not None
    assert then.again == ("bob", "somebody is below", first.since + 60)
    assert then._replace(again=None) == first
    result(scene.service.stopping.resume(ANN, "", LATER))
    assert scene.service.snapshot.stopped is None
    result(scene.service.stopping.stop(ANN, ""))
    assert scene.service.snapshot.stopped.again is None


def test_a_stop_that_comes_twice_with_its_id_is_one_stop() -> None:
    """The robot receives both. The later of the two times invalidates an older resume, as for every stop."""
    scene = ControlWorld().online()
    stopping, by_http = scene.service.stopping, ANN._replace(address="192.0.2.9", connection=0)
    scene.link.silent = True
    results = [outcome(stopping.stop(ANN, "smoke", "press-1"))]
    first = scene.service.snapshot.stopped
    before = scene.now_ns()
    scene.clock.advance(10)
    results.append(outcome(stopping.stop(by_http, "", "press-1")))
    second = scene.service.snapshot.stopped
    assert first is not None and second is not None
    assert (second.by, second.again, second.since) == ("ann", None, first.since + 10)
    for order in scene.link.orders(link.Stop):
        scene.link.answers(order)
        scene.service.message_received(
            link.MotionState(stopped=link.Stopped(by="ann", why="smoke", since=first.since))
        )
        shown = second._replace(why="smoke", confirmed=True)
        assert scene.service.snapshot.stopped == shown
    assert results == [[True], [True]]
    assert (scene.record.kinds, scene.record.stop_events) == (["robot.stopped"], 1)
    scene.link.silent = False
    with pytest.raises(StoppedSince):
        result(stopping.resume(BOB, "", before))


@pytest.mark.parametrize(
    ("actor", "first", "second"),
    [
        (BOB, "press-1", "press-1"),
        (Actor("root", "cli:root"), "press-1", "press-1"),
        (ANN, "press-1", "press-2"),
        (ANN, "press-1", ""),
        (ANN, "", "press-1"),
        (ANN, "", ""),
    ],
    ids=["another user", "the command line", "another id", "id, none", "none, id", "no ids"],
)
def test_any_other_stop_is_a_second_one(actor: Actor, first: str, second: str) -> None:
    """Even at the same time and with the same reason."""
    scene = ControlWorld().online()
    result(scene.service.stopping.stop(ANN, "smoke", first))
    result(scene.service.stopping.stop(actor, "smoke", second))
    stopped = scene.service.snapshot.stopped
    assert stopped is not None and stopped.again is not None
    assert stopped.again[:2] == (actor.name, "smoke")
    assert scene.record.stop_events == len(scene.record.kinds) == 2


def test_an_id_stops_the_robot_again_after_it_was_resumed() -> None:
    """A delayed or repeated stop is never ignored."""
    scene = ControlWorld().online()
    for count in (1, 2):
        assert result(scene.service.stopping.stop(ANN, "smoke", "press-1"))
        assert len(scene.link.orders(link.Stop)) == count
        assert scene.service.snapshot.stopped is not None
        assert scene.record.stop_events == count
        result(scene.service.stopping.resume(BOB, "", LATER))


def test_an_id_stops_a_robot_that_has_reported_a_stop_of_its_own_again() -> None:
    """The robot's own stop began another standstill."""
    scene = ControlWorld().online()
    result(scene.service.stopping.stop(ANN, "smoke", "press-1"))
    scene.service.message_received(link.MotionState())
    scene.service.message_received(link.MotionState(stopped=link.Stopped(by="the robot", since=5.0)))
    result(scene.service.stopping.stop(ANN, "smoke", "press-1"))
    stopped = scene.service.snapshot.stopped
    assert stopped is not None and stopped.again is not None
    assert scene.record.stop_events == 2


def test_ids_of_one_user_are_bounded_and_leave_those_of_others_alone() -> None:
    """A user's oldest ids are removed first."""
    scene = ControlWorld().online()
    result(scene.service.stopping.stop(ANN, "smoke", "press-1"))
    for number in range(module.IDS_PER_USER + 1):
        result(scene.service.stopping.stop(BOB, "", f"bob-{number}"))
    events = scene.record.stop_events
    result(scene.service.stopping.stop(ANN, "smoke", "press-1"))
    result(scene.service.stopping.stop(BOB, "", f"bob-{module.IDS_PER_USER}"))
    assert scene.record.stop_events == events
    result(scene.service.stopping.stop(BOB, "", "bob-0"))
    assert scene.record.stop_events == events + 1


def test_users_whose_ids_are_remembered_are_bounded() -> None:
    """The least recent is removed first. This costs one more entry and never loses a stop."""
    ids = module.StopIds()
    actors = [Actor(f"user{n}", f"user:user{n}", n) for n in range(module.USERS + 1)]
    assert not any(ids.is_duplicate(each, "x") for each in actors)
    assert not ids.is_duplicate(actors[0], "x")
    assert ids.is_duplicate(actors[-1], "x")


@pytest.mark.parametrize("value", [None, 7, ["x"], "x" * 65, {"a": 1}])
def test_an_id_that_can_not_be_used_counts_as_none(value: object) -> None:
    """No stop is refused for its id."""
    assert stop_id_of(value) == ""
    assert stop_id_of("x" * 64) == "x" * 64


def test_a_second_stop_between_the_two_paths_of_a_stop_stays_named() -> None:
    """The later path invalidates an older resume too."""
    scene = ControlWorld().online()
    for actor in (ANN, BOB):
        result(scene.service.stopping.stop(actor, "smoke", "press-1"))
        scene.clock.advance(0.5)
    before = scene.service.snapshot.stopped
    result(scene.service.stopping.stop(ANN, "smoke", "press-1"))
    stopped = scene.service.snapshot.stopped
    assert before is not None and stopped is not None
    assert stopped.since > before.since
    assert stopped._replace(since=before.since) == before


def test_a_stop_that_replaces_an_unsent_one_is_no_second_stop() -> None:
    """An offline robot gets only the latest, and its clients are notified once."""
    scene = ControlWorld()
    result(scene.service.stopping.stop(ANN, "smoke"))
    scene.clock.advance(60)
    result(scene.service.stopping.stop(BOB, ""))
    stopped = scene.service.snapshot.stopped
    assert stopped is not None
    assert (stopped.by, stopped.again) == ("bob", None)


def test_it_is_stored_until_the_robot_confirms_it() -> None:
    """All clients see the order, and whether the robot has confirmed it."""
    scene = ControlWorld().online()
    scene.link.silent = True
    asked = outcome(scene.service.stopping.stop(ANN, "smoke"))
    assert list(scene.record.stops) == [1]
    stopped = scene.service.snapshot.stopped
    assert stopped is not None
    assert (stopped.by, stopped.why, stopped.confirmed) == ("ann", "smoke", False)
    scene.service.message_received(link.MotionState(stopped=link.Stopped(by="ann", why="smoke", since=5.0)))
    scene.link.answers(scene.link.orders(link.Stop)[0])
    assert asked == [True]
    assert scene.record.stops == {}
    stopped = scene.service.snapshot.stopped
    assert stopped == ("ann", "smoke", 5.0, True, None)


def test_an_offline_robot_gets_its_stop_before_anything_else() -> None:
    """It is sent when the robot registers, and only once."""
    scene = ControlWorld()
    assert result(scene.service.stopping.stop(ANN, "smoke")) is False
    assert list(scene.record.stops) == [1]
    scene.online()
    assert isinstance(scene.link.said[0], link.Stop)
    assert scene.record.stops == {}
    scene.offline()
    scene.online()
    assert scene.link.said == []


def test_an_unconfirmed_stop_is_sent_again_when_the_robot_is_back() -> None:
    """Hardware may be slow, so the caller waits some seconds; then the answer says that the stop is pending."""
    scene = ControlWorld().online()
    scene.link.silent = True
    asked = outcome(scene.service.stopping.stop(ANN, ""))
    scene.clock.advance(STOP_SECONDS - 0.1)
    assert asked == []
    scene.clock.advance(0.2)
    assert asked == [False]
    scene.offline()
    scene.online()
    assert len(scene.link.orders(link.Stop)) == 1
    assert scene.record.stops == {}


def test_a_stop_is_waited_for_as_long_as_it_may_take_a_robot() -> None:
    """A robot that is resuming switches its hardware twice, and transmission takes time. Clients wait longer
    than the relay.
    """
    assert 2 * (SWITCH_SECONDS + KILL_SECONDS) + 1 <= STOP_SECONDS
    assert STOP_SECONDS < CONFIRM_SECONDS
    assert CONFIRM_SECONDS + LOOKUP_SECONDS < fleet.STOP_OR_RESUME_SECONDS
    assert CONFIRM_SECONDS + LOOKUP_SECONDS < admin_socket_client._ORDER_SECONDS


def test_failed_parts_of_a_stop_are_reported_and_the_robot_is_stopped() -> None:
    """While the robot reports the stop it is not sent again; the order is kept until the robot is resumed."""
    scene = ControlWorld().online()
    scene.link.unable = "the contactor does not answer"
    words = "robot rover is stopped, but a part of the stop failed: the contactor does not answer"
    with pytest.raises(StopIncomplete, match=words):
        result(scene.service.stopping.stop(ANN, ""))
    assert list(scene.record.stops) == [1]
    scene.offline()
    scene.online()
    scene.service.message_received(link.MotionState(stopped=link.Stopped(by="ann", since=5.0)))
    assert scene.link.said == []
    result(scene.service.stopping.resume(ANN, "", LATER))
    assert scene.record.stops == {}


def test_a_stop_that_the_robot_could_not_store_is_sent_again() -> None:
    """It is sent each time the robot reconnects without it, unless it was resumed."""
    scene = ControlWorld().online()
    scene.link.unable = "no space left on device"
    outcome(scene.service.stopping.stop(ANN, "smoke"))
    for _ in range(2):
        scene.offline()
        with pytest.raises(Unavailable, match="may be stopped"):
            result(scene.service.stopping.resume(ANN, "", LATER))
        scene.online()
        scene.link.unable = "no space left on device"
        scene.service.message_received(link.MotionState())
        scene.service.message_received(link.MotionState())
        assert [order.why for order in scene.link.orders(link.Stop)] == ["smoke"]
        assert list(scene.record.stops) == [1]
    scene.offline()
    scene.online()
    scene.service.message_received(link.MotionState())
    assert len(scene.link.orders(link.Stop)) == 1
    assert scene.record.stops == {}, "it has kept it this time"


def test_stops_work_without_the_database() -> None:
    """An online robot is stopped. For an offline one the answer says that the order may be lost."""
    scene = ControlWorld().online()
    scene.record.fails = Unavailable("the database is locked")
    assert result(scene.service.stopping.stop(ANN, "")) is True
    scene.offline()
    with pytest.raises(Unavailable, match="cannot be stored for its return: the database is locked"):
        result(scene.service.stopping.stop(ANN, ""))
    scene.online()
    assert len(scene.link.orders(link.Stop)) == 1


def test_a_stop_keeps_the_holder() -> None:
    """The controller has control when the robot is resumed."""
    scene = ControlWorld().online()
    ann = scene.holding()
    result(scene.service.stopping.stop(ANN, ""))
    assert scene.service.may_command(ann, "/cmd_vel")
    assert result(scene.service.stopping.resume(ANN, "", LATER)) is None
    assert scene.service.may_command(ann, "/cmd_vel")
    assert scene.link.holders == [ann.number]


def test_resume_cancels_a_stop_that_was_not_sent() -> None:
    """The robot does not receive it."""
    scene = ControlWorld()
    result(scene.service.stopping.stop(ANN, ""))
    result(scene.service.stopping.resume(ANN, "all clear", LATER))
    assert scene.service.snapshot.stopped is None
    assert scene.record.stops == {}
    assert scene.record.kinds == ["robot.stopped", "robot.resumed"]
    scene.online()
    assert scene.link.said == []


def test_a_robot_that_stopped_and_left_is_resumed_when_it_is_back() -> None:
    """Not before: only the robot can confirm that it may move."""
    scene = ControlWorld().online()
    result(scene.service.stopping.stop(ANN, ""))
    scene.service.message_received(link.MotionState(stopped=link.Stopped(by="ann", since=5.0)))
    scene.offline()
    with pytest.raises(Unavailable, match="offline, and stopped"):
        result(scene.service.stopping.resume(ANN, "", LATER))
    assert scene.service.snapshot.stopped is not None


def test_an_offline_robot_without_an_order_is_not_resumed() -> None:
    """It may have been stopped before the relay started."""
    with pytest.raises(Unavailable, match="may be stopped: resume it when it is back"):
        result(ControlWorld().service.stopping.resume(ANN, "", LATER))


def test_resumed_stop_is_over_even_if_the_database_fails() -> None:
    """The answer confirms it, it is audited, and the robot is not stopped again. The stored order is removed
    later.
    """
    scene = ControlWorld().online()
    scene.link.unable = "the contactor does not answer"
    outcome(scene.service.stopping.stop(ANN, "smoke"))
    scene.link.unable = ""
    scene.record.fails = Unavailable("the database is locked")
    assert result(scene.service.stopping.resume(ANN, "all clear", LATER)) is None
    assert scene.service.snapshot.stopped is None
    assert scene.record.kinds == ["robot.stopped", "robot.resumed"]
    scene.offline()
    scene.online()
    scene.service.message_received(link.MotionState())
    assert scene.link.said == []
    scene.clock.advance(stored_stops.DELETE_RETRY_SECONDS)
    assert list(scene.record.stops) == [1]
    scene.record.fails = None
    scene.clock.advance(stored_stops.DELETE_RETRY_SECONDS)
    assert scene.record.stops == {}, "a later relay would stop the robot by it"


def test_a_sent_stop_is_cleared_when_the_database_returns() -> None:
    """Otherwise a later relay would stop a robot that was resumed meanwhile."""
    scene = ControlWorld().online()
    scene.link.silent = True
    asked = outcome(scene.service.stopping.stop(ANN, "smoke"))
    scene.record.fails = Unavailable("the database is locked")
    scene.link.answers(scene.link.orders(link.Stop)[0])
    assert asked == [True]
    scene.link.silent = False
    result(scene.service.stopping.resume(ANN, "", LATER))
    assert list(scene.record.stops) == [1]
    scene.record.fails = None
    scene.clock.advance(stored_stops.DELETE_RETRY_SECONDS)
    assert scene.record.stops == {}


def test_a_stop_that_is_written_after_it_was_over_is_put_away() -> None:
    """The robot was resumed before the database had stored the order."""
    scene = ControlWorld().online()
    scene.record.hold = True
    scene.link.unable = "the contactor does not answer"
    outcome(scene.service.stopping.stop(ANN, "smoke"))
    scene.link.unable = ""
    result(scene.service.stopping.resume(ANN, "", LATER))
    (held,) = scene.record.held
    held.callback(None)
    assert scene.record.stops == {}


def test_an_order_of_the_database_that_is_over_is_put_away() -> None:
    """It could not be removed earlier; an order that waits for its robot stays."""
    scene = ControlWorld().online()
    result(scene.service.stopping.stop(ANN, "smoke"))
    over = StopRecord(1, "ann", "smoke", scene.wall())
    scene.record.stops[1] = over
    assert not scene.service.stopping.add_stored(over, 0, 0)
    assert scene.record.stops == {}
    scene.offline()
    result(scene.service.stopping.stop(ANN, "again"))
    assert not scene.service.stopping.add_stored(scene.record.stops[1], 0, 0)
    assert list(scene.record.stops) == [1]


def test_a_stop_that_is_ordered_while_the_robot_resumes_stands() -> None:
    """The later order counts."""
    scene = ControlWorld()
    result(scene.service.stopping.stop(ANN, "one"))
    scene.online()
    scene.link.silent = True
    resuming = outcome(scene.service.stopping.resume(ANN, "", LATER))
    stopping = outcome(scene.service.stopping.stop(ANN, "two"))
    scene.link.answers(scene.link.orders(link.Resume)[0])
    assert resuming == [None]
    assert scene.record.stops[1].why == "two"
    scene.link.answers(scene.link.orders(link.Stop)[-1])
    assert stopping == [True]


def test_orders_of_the_database_are_sent_once() -> None:
    """Orders from other processes are sent; a stop that was handled already can only come from a slow
    database.
    """
    scene = ControlWorld().online()
    stopping = scene.service.stopping
    order = StopRecord(1, "root", "maintenance", 1.8e9)
    assert stopping.add_stored(order, 0, 0)
    stopping.robot_online()
    assert [each.why for each in scene.link.orders(link.Stop)] == ["maintenance"]
    assert not stopping.add_stored(order, 0, 0)
    assert not stopping.add_stored(None, 0, 0)
    assert scene.service.snapshot.stopped == ("root", "maintenance", order.at, True, None)


def test_an_order_of_the_database_and_one_of_the_admin_socket_with_one_id_are_one_stop() -> None:
    scene = ControlWorld().online()
    stopping = scene.service.stopping
    assert stopping.add_stored(StopRecord(1, "root", "smoke", 5.0, "press-1"), 0, 0)
    result(stopping.stop(local_actor("root"), "smoke", "press-1"))
    assert scene.record.stop_events == 0, "the command line has recorded it"
    assert scene.service.snapshot.stopped is not None and scene.service.snapshot.stopped.again is None
    result(stopping.stop(ANN, "smoke", "press-1"))
    assert scene.record.stop_events == 1, "ids are separate for each user"


def test_an_order_that_is_stored_after_the_robot_has_confirmed_it_is_not_sent_again() -> None:
    """The command line stores its order for all robots if one of them takes long. The time of the stop stays."""
    scene = ControlWorld().online()
    stopping = scene.service.stopping
    result(stopping.stop(local_actor("root"), "smoke", "press-1"))
    before = stopping.stopped
    scene.clock.advance(6)
    order = StopRecord(1, "root", "smoke", scene.wall(), "press-1")
    scene.record.stops[1] = order
    assert not stopping.add_stored(order, scene.now_ns(), scene.now_ns())
    assert len(scene.link.orders(link.Stop)) == 1
    assert (scene.record.stops, stopping.stopped) == ({}, before)
    result(stopping.resume(ANN, "", LATER))
    later = StopRecord(1, "root", "smoke", scene.wall() + 1, "press-2")
    assert stopping.add_stored(later, scene.now_ns(), scene.now_ns())


def test_an_order_that_is_given_by_a_clock_that_was_set_back_counts() -> None:
    """Times identify orders and do not sort them."""
    scene = ControlWorld().online()
    result(scene.service.stopping.stop(ANN, ""))
    result(scene.service.stopping.resume(ANN, "", LATER))
    assert scene.service.stopping.add_stored(StopRecord(1, "root", "maintenance", 5.0), 0, 0)
    assert scene.service.snapshot.stopped is not None
    assert not scene.service.stopping.add_stored(StopRecord(1, "root", "maintenance", 5.0), 0, 0)


def test_a_stop_that_is_not_stored_is_not_reported_as_stored() -> None:
    """For an offline robot the number of pending writes is bounded; the answer says that the stop was not
    stored.
    """
    scene = ControlWorld()
    scene.record.hold = True
    asked = [
        outcome(scene.service.stopping.stop(ANN, str(number)))
        for number in range(stored_stops.SAVES_AT_ONCE + 1)
    ]
    assert asked[:-1] == [[]] * stored_stops.SAVES_AT_ONCE
    assert isinstance(asked[-1][0], Unavailable)
    assert "are being written already" in str(asked[-1][0])
    for held in scene.record.held:
        held.callback(None)
    assert asked[:-1] == [[False]] * stored_stops.SAVES_AT_ONCE
    scene.online()
    assert [order.why for order in scene.link.orders(link.Stop)] == [str(stored_stops.SAVES_AT_ONCE - 1)]
    assert scene.record.stops == {}


def test_many_stops_do_not_flood_a_robot_that_does_not_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    """The robot has received the order."""
    monkeypatch.setattr(module, "ORDERS_AT_ONCE", 2)
    scene = ControlWorld().online()
    scene.link.silent = True
    for _ in range(5):
        outcome(scene.service.stopping.stop(ANN, ""))
    assert len(scene.link.orders(link.Stop)) == 2


def test_repeated_stops_do_not_fill_the_databases_queue() -> None:
    """Each stop is sent; pending writes are bounded, and long reasons are cut."""
    scene = ControlWorld().online()
    scene.link.silent = True
    scene.record.hold = True
    for _ in range(3 * stored_stops.SAVES_AT_ONCE):
        outcome(scene.service.stopping.stop(ANN, "x" * 5000))
    assert len(scene.link.orders(link.Stop)) == 3 * stored_stops.SAVES_AT_ONCE
    assert len(scene.record.held) == stored_stops.SAVES_AT_ONCE
    assert len(scene.link.orders(link.Stop)[0].why) == 500


def test_repeated_stops_of_a_robot_do_not_fill_the_audit_log() -> None:
    """Each stop is sent; stops by others, and stops of a robot that may move, are still audited."""
    scene = ControlWorld().online()
    ann, bob = Actor("ann", "user:ann", 1), Actor("bob", "user:bob", 2)
    for _ in range(50):
        assert result(scene.service.stopping.stop(ann, "smoke"))
    assert len(scene.link.orders(link.Stop)) == 50
    assert scene.record.kinds == ["robot.stopped"] * (1 + module.FURTHER_AUDITS_BURST)
    result(scene.service.stopping.stop(bob, "fire"))
    assert scene.record.notes[-1][1:3] == ("bob", "fire")
    scene.clock.advance(20)
    result(scene.service.stopping.stop(ann, ""))
    result(scene.service.stopping.stop(ann, ""))
    assert scene.record.kinds == ["robot.stopped"] * (3 + module.FURTHER_AUDITS_BURST)
    for _ in range(5):
        result(scene.service.stopping.resume(bob, "", LATER))
        result(scene.service.stopping.stop(ann, "again"))
        assert scene.record.notes[-1][:3] == ("robot.stopped", "ann", "again")
    assert scene.record.stops == {}


def test_a_stop_that_waits_for_its_robot_is_on_record_a_few_times_a_minute() -> None:
    """The latest one is stored."""
    scene = ControlWorld()
    ann = Actor("ann", "user:ann", 1)
    for number in range(50):
        assert not result(scene.service.stopping.stop(ann, f"the {number}"))
    assert scene.record.kinds == ["robot.stopped"] * (1 + module.FURTHER_AUDITS_BURST)
    assert scene.record.stops[1].why == "the 49"


def test_a_stop_is_not_lifted_by_what_was_asked_for_before_it() -> None:
    """A resume that was sent before the stop is refused, however long it was delayed. A new one is accepted."""
    scene = ControlWorld().online()
    stopping = scene.service.stopping
    result(stopping.stop(ANN, "smoke"))
    asked = scene.now_ns()
    scene.clock.advance(60)
    result(stopping.stop(Actor("vic", "user:vic", 8), "a child"))
    with pytest.raises(StoppedSince, match="rover was stopped, or may have been, after you sent this"):
        result(stopping.resume(ANN, "all clear", asked))
    assert scene.link.orders(link.Resume) == []
    assert stopping.stopped is not None
    result(stopping.resume(ANN, "all clear", scene.now_ns()))
    assert scene.link.orders(link.Resume)
    assert stopping.stopped is None


def test_a_stop_that_the_robot_reports_is_known_from_then_on() -> None:
    """This covers every source and a robot that returns stopped. Repeated reports change nothing."""
    scene = ControlWorld().online()
    asked = scene.now_ns()
    scene.clock.advance(1)
    stopped = link.MotionState(stopped=link.Stopped(by="the robot", since=5.0))
    scene.service.message_received(stopped)
    reported = scene.now_ns()
    scene.clock.advance(1)
    scene.service.message_received(stopped)
    with pytest.raises(StoppedSince):
        result(scene.service.stopping.resume(ANN, "", asked))
    result(scene.service.stopping.resume(ANN, "", reported))


def test_a_stop_from_the_database_is_known_once_it_was_read() -> None:
    """It was ordered at another machine, before any client of this relay used the robot."""
    world = World()
    asked = world.now_ns()
    world.clock.advance(1)
    order = StopRecord(1, "root", "maintenance", 5.0)
    world.record.stops[1] = order
    result(world.controllers.read_stored_stops())
    read = world.now_ns()
    world.clock.advance(1)
    result(world.controllers.read_stored_stops())
    stopping = world.controllers.of(world.robot).stopping
    with pytest.raises(StoppedSince):
        result(stopping.resume(ANN, "", asked))
    result(stopping.resume(ANN, "", read))
    assert stopping.stopped is None


def test_a_stop_that_another_relay_had_confirmed_is_over() -> None:
    """Its order is stored no longer: it is neither shown nor sent when the robot connects to this relay."""
    scene = ControlWorld()
    stopping = scene.service.stopping
    result(stopping.stop(ANN, "smoke"))
    scene.clock.advance(1)
    del scene.record.stops[1]
    assert not stopping.add_stored(None, scene.now_ns(), scene.now_ns())
    assert stopping.stopped is None
    scene.online()
    assert scene.link.orders(link.Stop) == []


def test_an_order_that_was_read_and_is_stored_no_longer_is_over() -> None:
    """The command line has stored it, and another relay had it confirmed."""
    scene = ControlWorld()
    stopping = scene.service.stopping
    assert stopping.add_stored(StopRecord(1, "root", "smoke", 5.0), scene.now_ns(), scene.now_ns())
    scene.clock.advance(1)
    stopping.add_stored(None, scene.now_ns(), scene.now_ns())
    assert stopping.stopped is None


@pytest.mark.parametrize("reason", ["being written", "not written", "read before", "online"])
def test_a_stop_is_not_over_because_it_is_not_stored_yet(reason: str) -> None:
    """Only a reading that began after it was stored shows that it is over; and never while its robot is here."""
    scene = ControlWorld()
    stopping = scene.service.stopping
    began = scene.now_ns()
    scene.clock.advance(1)
    if reason == "being written":
        scene.record.hold = True
    if reason == "not written":
        scene.record.fails = Unavailable("the disk is full")
    if reason == "online":
        scene.online()
        scene.link.silent = True
    ordered = outcome(stopping.stop(ANN, "smoke"))
    scene.clock.advance(1)
    read_at = began if reason == "read before" else scene.now_ns()
    stopping.add_stored(None, scene.now_ns(), read_at)
    assert stopping.stopped is not None, ordered
    if reason != "online":
        scene.online()
    assert scene.link.orders(link.Stop) != []


def test_the_end_of_an_order_that_was_read_is_announced() -> None:
    """So that the relay that has stored it knows. The end of one's own concerns no other relay."""
    scene = ControlWorld().online()
    stopping = scene.service.stopping
    assert stopping.add_stored(StopRecord(1, "root", "smoke", 5.0), 0, 0)
    scene.record.stops[1] = StopRecord(1, "root", "smoke", 5.0)
    stopping.send_pending()
    result(stopping.resume(ANN, "", LATER))
    result(stopping.stop(ANN, "again"))
    assert [announced for at, announced in scene.record.deleted if at == 5.0] == [True]
    assert {announced for at, announced in scene.record.deleted if at != 5.0} == {False}
