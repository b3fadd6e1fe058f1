"""A stop reaches the robot, now or as soon as it is there."""

from __future__ import annotations

import pytest

from relay_db.queries import StopRecord
from relay_protocol import link
from relay_protocol.errors import Unavailable
from relay_server.cli import control_socket
from relay_server.control import stopping as module
from relay_server.control.audit import Actor
from relay_server.control.commands import NotDone
from relay_server.control.service import CONFIRM_SECONDS
from relay_server.control.stopping import SAME_SECONDS, STOP_SECONDS, StoppedSince
from relay_server.fleet import service as desk
from relay_server.sessions.manager import LOOKUP_SECONDS
from robot_client.motion.hardware import DYING, PATIENCE
from tests.relay_server.memory import World
from tests.relay_server.steering import Place, outcome, result

ANN = Actor("ann", "user:ann", 7, "192.0.2.7", 3)
BOB = Actor("bob", "user:bob", 8, "192.0.2.8", 4)
LATER = 1 << 62
"""Sent after all there was."""


def test_a_robot_that_is_there_is_stopped_at_once() -> None:
    """The order is on its way before anything is written; nothing is left to be told."""
    place = Place().online()
    assert result(place.desk.stopping.stop(ANN, "smoke")) is True
    (order,) = place.link.orders(link.Stop)
    assert (order.by, order.why) == ("ann", "smoke")
    assert place.record.stops == {}
    assert place.record.kinds == ["robot.stopped"]


def test_what_the_robot_has_done_is_known_before_it_says_so_of_itself() -> None:
    """Between its answer and its next word about itself nobody is told that it may move, or that it may not."""
    place = Place().online()
    result(place.desk.stopping.stop(ANN, "smoke"))
    stopped = place.desk.standing.stopped
    assert stopped is not None
    assert (stopped.by, stopped.why, stopped.told) == ("ann", "smoke", True)
    result(place.desk.stopping.resume(ANN, "", LATER))
    assert place.desk.standing.stopped is None
    place.offline()
    result(place.desk.stopping.stop(ANN, "smoke"))
    place.online()
    stopped = place.desk.standing.stopped
    assert stopped is not None
    assert stopped.told


def test_a_stop_is_the_same_before_and_after_it_is_confirmed() -> None:
    """The robot is told when it was ordered, to say that of itself: whoever resumes it meanwhile is not put off."""
    place = Place().online()
    place.link.silent = True
    place.desk.stopping.stop(ANN, "smoke")
    stopped = place.desk.stopping.stopped
    (order,) = place.link.orders(link.Stop)
    assert stopped is not None
    assert (stopped.told, order.at) == (False, stopped.since)
    place.link.answers(order)
    place.desk.told(link.Safety(stopped=link.Stopped(by=order.by, why=order.why, since=order.at)))
    assert place.desk.stopping.stopped == stopped._replace(told=True)


def test_a_stop_of_a_stopped_robot_is_told() -> None:
    """Who would let it move sees the latest who stopped it, until it may; the robot itself tells of the first alone."""
    place = Place().online()
    result(place.desk.stopping.stop(ANN, "smoke"))
    first = place.desk.standing.stopped
    assert first is not None
    place.clock.advance(60)
    result(place.desk.stopping.stop(BOB, "somebody is below"))
    place.desk.told(link.Safety(stopped=link.Stopped(by="ann", why="smoke", since=first.since)))
    then = place.desk.standing.stopped
    assert then is not None
    assert then.again == ("bob", "somebody is below", first.since + 60)
    assert then._replace(again=None) == first
    result(place.desk.stopping.resume(ANN, "", LATER))
    assert place.desk.standing.stopped is None
    result(place.desk.stopping.stop(ANN, ""))
    assert place.desk.standing.stopped.again is None


def test_one_press_that_comes_two_ways_is_told_once() -> None:
    """The robot gets both; that it is told by another moment ends a press to resume, as does what was asked before."""
    place = Place().online()
    stopping, by_http = place.desk.stopping, ANN._replace(address="192.0.2.9", connection=0)
    place.link.silent = True
    ways = [outcome(stopping.stop(ANN, "smoke"))]
    first = place.desk.standing.stopped
    before = place.now_ns()
    place.clock.advance(SAME_SECONDS)
    ways.append(outcome(stopping.stop(by_http, "smoke")))
    second = place.desk.standing.stopped
    assert first is not None and second is not None
    assert (second.by, second.why, second.again) == ("ann", "smoke", None)
    assert second.since == first.since + SAME_SECONDS
    for order in place.link.orders(link.Stop):
        place.link.answers(order)
        place.desk.told(link.Safety(stopped=link.Stopped(by="ann", why="smoke", since=first.since)))
        assert place.desk.standing.stopped == second._replace(told=True)
    assert ways == [[True], [True]]
    place.link.silent = False
    with pytest.raises(StoppedSince):
        result(stopping.resume(BOB, "", before))
    result(stopping.resume(BOB, "", LATER))
    result(stopping.stop(ANN, "smoke"))
    assert place.desk.standing.stopped._replace(since=first.since, told=False) == first


@pytest.mark.parametrize(
    ("actor", "why", "later"),
    [(BOB, "smoke", 0.0), (ANN, "fire", 0.0), (ANN, "smoke", SAME_SECONDS + 0.1)],
    ids=["by another", "for another reason", "later"],
)
def test_another_press_is_told(actor: Actor, why: str, later: float) -> None:
    """As what it is."""
    place = Place().online()
    result(place.desk.stopping.stop(ANN, "smoke"))
    place.clock.advance(later)
    result(place.desk.stopping.stop(actor, why))
    stopped = place.desk.standing.stopped
    assert stopped is not None and stopped.again is not None
    assert stopped.again[:2] == (actor.name, why)


def test_who_comes_between_the_two_ways_of_a_press_stays_named() -> None:
    """Though the later of them is the latest; it ends a press to resume as well."""
    place = Place().online()
    for actor in (ANN, BOB):
        result(place.desk.stopping.stop(actor, "smoke"))
        place.clock.advance(0.5)
    before = place.desk.standing.stopped
    result(place.desk.stopping.stop(ANN, "smoke"))
    stopped = place.desk.standing.stopped
    assert before is not None and stopped is not None
    assert stopped.since > before.since
    assert stopped._replace(since=before.since) == before


def test_a_stop_that_replaces_one_that_is_still_to_be_told_is_no_second_one() -> None:
    """A robot that is away is told of the latest; nobody is told of that twice."""
    place = Place()
    result(place.desk.stopping.stop(ANN, "smoke"))
    place.clock.advance(60)
    result(place.desk.stopping.stop(BOB, ""))
    stopped = place.desk.standing.stopped
    assert stopped is not None
    assert (stopped.by, stopped.again) == ("bob", None)


def test_until_the_robot_confirms_it_is_kept() -> None:
    """Everybody sees that it is ordered, and whether the robot says so itself."""
    place = Place().online()
    place.link.silent = True
    asked = outcome(place.desk.stopping.stop(ANN, "smoke"))
    assert list(place.record.stops) == [1]
    stopped = place.desk.standing.stopped
    assert stopped is not None
    assert (stopped.by, stopped.why, stopped.told) == ("ann", "smoke", False)
    place.desk.told(link.Safety(stopped=link.Stopped(by="ann", why="smoke", since=5.0)))
    place.link.answers(place.link.orders(link.Stop)[0])
    assert asked == [True]
    assert place.record.stops == {}
    stopped = place.desk.standing.stopped
    assert stopped == ("ann", "smoke", 5.0, True, None)


def test_a_robot_that_is_away_is_told_before_anything_else() -> None:
    """When it registers; and not again the next time."""
    place = Place()
    assert result(place.desk.stopping.stop(ANN, "smoke")) is False
    assert list(place.record.stops) == [1]
    place.online()
    assert isinstance(place.link.said[0], link.Stop)
    assert place.record.stops == {}
    place.offline()
    place.online()
    assert place.link.said == []


def test_a_robot_that_says_nothing_is_told_again_when_it_is_back() -> None:
    """Some seconds are waited, because hardware may take its time; then the asker knows that it is not done yet."""
    place = Place().online()
    place.link.silent = True
    asked = outcome(place.desk.stopping.stop(ANN, ""))
    place.clock.advance(STOP_SECONDS - 0.1)
    assert asked == []
    place.clock.advance(0.2)
    assert asked == [False]
    place.offline()
    place.online()
    assert len(place.link.orders(link.Stop)) == 1
    assert place.record.stops == {}


def test_a_stop_is_waited_for_as_long_as_it_may_take_a_robot() -> None:
    """In the middle of a resume it throws its switches twice, and the way there and back takes a moment; who waits for
    the relay waits longer.
    """
    assert 2 * (PATIENCE + DYING) + 1 <= STOP_SECONDS
    assert STOP_SECONDS < CONFIRM_SECONDS
    assert STOP_SECONDS + LOOKUP_SECONDS < desk.STOP_SECONDS
    assert CONFIRM_SECONDS + LOOKUP_SECONDS < control_socket._MOTION_SECONDS


def test_what_of_it_could_not_be_done_is_told_and_the_robot_is_stopped_all_the_same() -> None:
    """While it says that it stands it is not told again, and the order is kept until it is resumed."""
    place = Place().online()
    place.link.unable = "the contactor does not answer"
    with pytest.raises(NotDone, match="the contactor does not answer"):
        result(place.desk.stopping.stop(ANN, ""))
    assert list(place.record.stops) == [1]
    place.offline()
    place.online()
    place.desk.told(link.Safety(stopped=link.Stopped(by="ann", since=5.0)))
    assert place.link.said == []
    result(place.desk.stopping.resume(ANN, "", LATER))
    assert place.record.stops == {}


def test_a_robot_that_could_not_keep_its_stop_is_told_again_when_it_has_forgotten_it() -> None:
    """Each time it comes back without; nobody resumes it meanwhile."""
    place = Place().online()
    place.link.unable = "no space left on device"
    outcome(place.desk.stopping.stop(ANN, "smoke"))
    for _ in range(2):
        place.offline()
        with pytest.raises(Unavailable, match="may be stopped"):
            result(place.desk.stopping.resume(ANN, "", LATER))
        place.online()
        place.link.unable = "no space left on device"
        place.desk.told(link.Safety())
        place.desk.told(link.Safety())
        assert [order.why for order in place.link.orders(link.Stop)] == ["smoke"]
        assert list(place.record.stops) == [1]
    place.offline()
    place.online()
    place.desk.told(link.Safety())
    assert len(place.link.orders(link.Stop)) == 1
    assert place.record.stops == {}, "it has kept it this time"


def test_a_database_that_is_lost_keeps_nobody_from_stopping() -> None:
    """A robot that is there is stopped; of one that is away it is told that the order may be lost."""
    place = Place().online()
    place.record.fails = Unavailable("the database is locked")
    assert result(place.desk.stopping.stop(ANN, "")) is True
    place.offline()
    with pytest.raises(Unavailable, match="can't be kept for when it is back: the database is locked"):
        result(place.desk.stopping.stop(ANN, ""))
    place.online()
    assert len(place.link.orders(link.Stop)) == 1


def test_a_stop_keeps_the_holder() -> None:
    """Whoever had control has it when the robot is resumed."""
    place = Place().online()
    ann = place.holding()
    result(place.desk.stopping.stop(ANN, ""))
    assert place.desk.passes(ann, "/cmd_vel")
    assert result(place.desk.stopping.resume(ANN, "", LATER)) is None
    assert place.desk.passes(ann, "/cmd_vel")
    assert place.link.holders == [ann.number]


def test_resume_takes_back_a_stop_that_was_not_told() -> None:
    """The robot hears nothing of it when it comes."""
    place = Place()
    result(place.desk.stopping.stop(ANN, ""))
    result(place.desk.stopping.resume(ANN, "all clear", LATER))
    assert place.desk.standing.stopped is None
    assert place.record.stops == {}
    assert place.record.kinds == ["robot.stopped", "robot.resumed"]
    place.online()
    assert place.link.said == []


def test_a_robot_that_stopped_and_left_is_resumed_when_it_is_back() -> None:
    """Not before: only it can say that it may move again."""
    place = Place().online()
    result(place.desk.stopping.stop(ANN, ""))
    place.desk.told(link.Safety(stopped=link.Stopped(by="ann", since=5.0)))
    place.offline()
    with pytest.raises(Unavailable, match="offline, and stopped"):
        result(place.desk.stopping.resume(ANN, "", LATER))
    assert place.desk.standing.stopped is not None


def test_a_robot_that_is_away_and_was_told_nothing_is_not_resumed() -> None:
    """It may stand since before the relay began."""
    with pytest.raises(Unavailable, match="may be stopped: it can be resumed when it is back"):
        result(Place().desk.stopping.resume(ANN, "", LATER))


def test_what_the_robot_has_resumed_is_over_whatever_the_database_says() -> None:
    """Whoever asked is told so, it is on record, and nobody stops the robot again; the order goes when it can."""
    place = Place().online()
    place.link.unable = "the contactor does not answer"
    outcome(place.desk.stopping.stop(ANN, "smoke"))
    place.link.unable = ""
    place.record.fails = Unavailable("the database is locked")
    assert result(place.desk.stopping.resume(ANN, "all clear", LATER)) is None
    assert place.desk.standing.stopped is None
    assert place.record.kinds == ["robot.stopped", "robot.resumed"]
    place.offline()
    place.online()
    place.desk.told(link.Safety())
    assert place.link.said == []
    place.clock.advance(module.PUT_AWAY_SECONDS)
    assert list(place.record.stops) == [1]
    place.record.fails = None
    place.clock.advance(module.PUT_AWAY_SECONDS)
    assert place.record.stops == {}, "a later relay would stop the robot by it"


def test_a_stop_that_was_told_is_put_away_however_long_the_database_is_lost() -> None:
    """Else a later relay would stop a robot that was resumed meanwhile."""
    place = Place().online()
    place.link.silent = True
    asked = outcome(place.desk.stopping.stop(ANN, "smoke"))
    place.record.fails = Unavailable("the database is locked")
    place.link.answers(place.link.orders(link.Stop)[0])
    assert asked == [True]
    place.link.silent = False
    result(place.desk.stopping.resume(ANN, "", LATER))
    assert list(place.record.stops) == [1]
    place.record.fails = None
    place.clock.advance(module.PUT_AWAY_SECONDS)
    assert place.record.stops == {}


def test_a_stop_that_is_written_after_it_was_over_is_put_away() -> None:
    """The robot was resumed before the database had kept its order."""
    place = Place().online()
    place.record.hold = True
    place.link.unable = "the contactor does not answer"
    outcome(place.desk.stopping.stop(ANN, "smoke"))
    place.link.unable = ""
    result(place.desk.stopping.resume(ANN, "", LATER))
    (held,) = place.record.held
    held.callback(None)
    assert place.record.stops == {}


def test_an_order_of_the_database_that_is_over_is_put_away() -> None:
    """It was kept though nobody could say so at the time; one that waits for its robot stays."""
    place = Place().online()
    result(place.desk.stopping.stop(ANN, "smoke"))
    over = StopRecord(1, "ann", "smoke", place.wall())
    place.record.stops[1] = over
    assert not place.desk.stopping.expect(over, 0)
    assert place.record.stops == {}
    place.offline()
    result(place.desk.stopping.stop(ANN, "again"))
    assert not place.desk.stopping.expect(place.record.stops[1], 0)
    assert list(place.record.stops) == [1]


def test_a_stop_that_is_ordered_while_the_robot_resumes_stands() -> None:
    """What comes later counts."""
    place = Place()
    result(place.desk.stopping.stop(ANN, "one"))
    place.online()
    place.link.silent = True
    resuming = outcome(place.desk.stopping.resume(ANN, "", LATER))
    stopping = outcome(place.desk.stopping.stop(ANN, "two"))
    place.link.answers(place.link.orders(link.Resume)[0])
    assert resuming == [None]
    assert place.record.stops[1].why == "two"
    place.link.answers(place.link.orders(link.Stop)[-1])
    assert stopping == [True]


def test_orders_of_the_database_are_told_once() -> None:
    """Those that were given elsewhere; one that is dealt with already comes back only from a slow database."""
    place = Place().online()
    stopping = place.desk.stopping
    order = StopRecord(1, "root", "maintenance", 1.8e9)
    assert stopping.expect(order, 0)
    stopping.came()
    assert [each.why for each in place.link.orders(link.Stop)] == ["maintenance"]
    assert not stopping.expect(order, 0)
    assert not stopping.expect(None, 0)
    assert place.desk.standing.stopped == ("root", "maintenance", order.at, True, None)


def test_an_order_that_is_given_by_a_clock_that_was_set_back_counts() -> None:
    """Orders are told apart, not put in order, by their moments."""
    place = Place().online()
    result(place.desk.stopping.stop(ANN, ""))
    result(place.desk.stopping.resume(ANN, "", LATER))
    assert place.desk.stopping.expect(StopRecord(1, "root", "maintenance", 5.0), 0)
    assert place.desk.standing.stopped is not None
    assert not place.desk.stopping.expect(StopRecord(1, "root", "maintenance", 5.0), 0)


def test_a_stop_that_is_not_kept_is_not_said_to_be() -> None:
    """Of a robot that is away, one more than can be written at a time; what is being written is told."""
    place = Place()
    place.record.hold = True
    asked = [outcome(place.desk.stopping.stop(ANN, str(number))) for number in range(module.KEEPING + 1)]
    assert asked[:-1] == [[]] * module.KEEPING
    assert isinstance(asked[-1][0], Unavailable)
    assert "are being written already" in str(asked[-1][0])
    for held in place.record.held:
        held.callback(None)
    assert asked[:-1] == [[False]] * module.KEEPING
    place.online()
    assert [order.why for order in place.link.orders(link.Stop)] == [str(module.KEEPING - 1)]
    assert place.record.stops == {}


def test_many_who_stop_a_robot_that_does_not_answer_do_not_flood_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """It has been told."""
    monkeypatch.setattr(module, "AT_ONCE", 2)
    place = Place().online()
    place.link.silent = True
    for _ in range(5):
        outcome(place.desk.stopping.stop(ANN, ""))
    assert len(place.link.orders(link.Stop)) == 2


def test_who_stops_a_robot_again_and_again_does_not_fill_the_databases_queue() -> None:
    """The robot is told each time; what is written at a time is bounded, and long reasons are cut."""
    place = Place().online()
    place.link.silent = True
    place.record.hold = True
    for _ in range(3 * module.KEEPING):
        outcome(place.desk.stopping.stop(ANN, "x" * 5000))
    assert len(place.link.orders(link.Stop)) == 3 * module.KEEPING
    assert len(place.record.held) == module.KEEPING
    assert len(place.link.orders(link.Stop)[0].why) == 500


def test_who_stops_a_stopped_robot_again_and_again_does_not_fill_the_record() -> None:
    """The robot is told each time; others, and what stops a robot that may move, are on record all the same."""
    place = Place().online()
    ann, bob = Actor("ann", "user:ann", 1), Actor("bob", "user:bob", 2)
    for _ in range(50):
        assert result(place.desk.stopping.stop(ann, "smoke"))
    assert len(place.link.orders(link.Stop)) == 50
    assert place.record.kinds == ["robot.stopped"] * (1 + module.AGAIN_AT_ONCE)
    result(place.desk.stopping.stop(bob, "fire"))
    assert place.record.notes[-1][1:3] == ("bob", "fire")
    place.clock.advance(20)
    result(place.desk.stopping.stop(ann, ""))
    result(place.desk.stopping.stop(ann, ""))
    assert place.record.kinds == ["robot.stopped"] * (3 + module.AGAIN_AT_ONCE)
    for _ in range(5):
        result(place.desk.stopping.resume(bob, "", LATER))
        result(place.desk.stopping.stop(ann, "again"))
        assert place.record.notes[-1][:3] == ("robot.stopped", "ann", "again")
    assert place.record.stops == {}


def test_a_stop_that_waits_for_its_robot_is_on_record_a_few_times_a_minute() -> None:
    """The latest one is kept."""
    place = Place()
    ann = Actor("ann", "user:ann", 1)
    for number in range(50):
        assert not result(place.desk.stopping.stop(ann, f"the {number}"))
    assert place.record.kinds == ["robot.stopped"] * (1 + module.AGAIN_AT_ONCE)
    assert place.record.stops[1].why == "the 49"


def test_a_stop_is_not_lifted_by_what_was_asked_for_before_it() -> None:
    """However it was held up; whoever asks once more is heard."""
    place = Place().online()
    stopping = place.desk.stopping
    result(stopping.stop(ANN, "smoke"))
    asked = place.now_ns()
    place.clock.advance(60)
    result(stopping.stop(Actor("vic", "user:vic", 8), "a child"))
    with pytest.raises(StoppedSince, match="rover was stopped, or may have been, after you asked for this"):
        result(stopping.resume(ANN, "all clear", asked))
    assert place.link.orders(link.Resume) == []
    assert stopping.stopped is not None
    result(stopping.resume(ANN, "all clear", place.now_ns()))
    assert place.link.orders(link.Resume)
    assert stopping.stopped is None


def test_a_stop_that_the_robot_tells_of_counts_from_then_on() -> None:
    """By whomever it was stopped, and also one that came back stopped; that it goes on telling of it does not."""
    place = Place().online()
    asked = place.now_ns()
    place.clock.advance(1)
    stopped = link.Safety(stopped=link.Stopped(by="the robot", since=5.0))
    place.desk.told(stopped)
    told = place.now_ns()
    place.clock.advance(1)
    place.desk.told(stopped)
    with pytest.raises(StoppedSince):
        result(place.desk.stopping.resume(ANN, "", asked))
    result(place.desk.stopping.resume(ANN, "", told))


def test_a_stop_that_the_database_tells_of_counts_from_when_it_was_read() -> None:
    """Somebody at another machine has ordered it, when nobody here had asked for this robot yet."""
    world = World()
    asked = world.now_ns()
    world.clock.advance(1)
    order = StopRecord(1, "root", "maintenance", 5.0)
    world.desks.expect([order])
    read = world.now_ns()
    world.clock.advance(1)
    world.desks.expect([order])
    stopping = world.desks.of(world.robot).stopping
    with pytest.raises(StoppedSince):
        result(stopping.resume(ANN, "", asked))
    result(stopping.resume(ANN, "", read))
    assert stopping.stopped is None
